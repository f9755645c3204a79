"""Bodies that nothing loads or touches any more, farther away than anything has pushed them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fenics_contact.parallel import global_sum
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.rigid_body_modes import RigidBodyModes
from fenics_contact.tolerances import FLAT
from fenics_contact.types import Array

__all__ = ["find_ejected_bodies"]

# How many times as far as all else a body may go. Blocks thrown out from between two others went
# ten times as far; one that is let go springs back by as much as it changes its shape.
_FAR = 3.0


def find_ejected_bodies(
    full: FullSystem, motions: RigidBodyModes, contacts: Sequence[Array], began: Array
) -> dict[str, tuple[float, float, float]]:
    """Bodies that have gone away, and on which no force acts. Collective.

    Such a body is in equilibrium wherever it is, and a step of an iteration that throws it out of
    sight of all others leaves no residual. A wedge that was pressed in may come out as far: only a
    body that bore nothing at the start of the increment is looked at, and none that a contact with
    a rigid obstacle touches, whose points may go any way.

    Args:
        full: The system at its present state.
        motions: Rigid motions of the bodies.
        contacts: Forces of each at this rank's unknowns.
        began: The state in which the increment began.

    Returns:
        By its name how far a body has gone, how far it may, and how far anything else of the bodies
        that it may touch has, or its own change of shape (length).
    """
    scales = full.scales
    fixed = [not contact.opposite.follows for contact in full.contacts]
    looked_at = (
        motions.unconstrained_bodies() & scales.unloaded & ~scales.touching[fixed].any(axis=0)
    )
    if not looked_at.any():
        return {}
    # What has a load is not in equilibrium, and may be on its way to be set down.
    forces = sum((np.abs(f) for f in contacts), np.abs(full.load))
    gone = looked_at & scales.is_unloaded(scales.sums(forces))
    if not gone.any():
        return {}
    change, bodies = full.state() - began, motions.of_bodies[:, : full.gdim]
    sums = np.column_stack([bodies @ change, bodies[:, 0].sum(axis=1)])
    sums = global_sum(full.unknowns.comm, sums)
    ways = sums[:, :-1] / sums[:, -1:]
    # Of a body that has gone away it is the change of its shape, or its turn.
    shift = np.where(gone[:, None], ways, 0.0)
    others = change - np.einsum("bd,bdi->i", shift, bodies)
    most = scales.largest(np.where(np.any(bodies != 0.0, axis=(0, 1)), others, 0.0))
    found = {}
    for b in np.flatnonzero(gone):
        way = float(np.linalg.norm(ways[b]))
        rest = float(most[~gone & scales.coupled_with(int(b))].max(initial=most[b]))
        limit = max(_FAR * rest, FLAT * float(scales.size[b]))
        if way > limit:
            found[full.parts.names[b]] = way, limit, rest
    return found
