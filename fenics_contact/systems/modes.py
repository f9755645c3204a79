"""Displacements of rigid-body modes."""

from __future__ import annotations

import numpy as np

from fenics_contact.types import Array

__all__ = ["rigid_motions"]


def rigid_motions(arm: Array, size: float) -> dict[str, Array]:
    """Return the rigid-body modes of points at ``arm`` from the centre, (n, gdim), by name."""
    n, d = arm.shape
    motions = {}
    for i, axis in enumerate("xyz"[:d]):
        motions[f"translation along {axis}"] = np.broadcast_to(np.eye(d)[i], (n, d))
    for i, axis in enumerate("xyz"):
        j, k = (i + 1) % 3, (i + 2) % 3
        if max(j, k) < d:
            rotation = np.zeros((n, d))
            rotation[:, j], rotation[:, k] = -arm[:, k] / size, arm[:, j] / size
            motions[f"rotation about {axis}"] = rotation
    return motions
