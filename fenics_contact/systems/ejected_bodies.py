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
    sight of all others leaves no residual. What its load has pressed in may come out as far as it
    went in.

    Args:
        full: The system at its present state.
        motions: Rigid motions of the bodies.
        contacts: Forces of each at this rank's unknowns.
        began: The state in which the increment began.

    Returns:
        By its name how far a body has gone, how far it may, and how far anything else of what it
        may touch has, it has changed its shape, or its load had moved it before (length).
    """
    scales = full.scales
    looked_at = motions.unconstrained_bodies()
    if not looked_at.any():
        return {}
    # What has a load is not in equilibrium, and may be on its way to be set down.
    forces = sum((np.abs(f) for f in contacts), np.abs(full.load))
    gone = looked_at & scales.is_unloaded(scales.sums(forces))
    if not gone.any():
        return {}
    change, bodies = full.state() - began, motions.of_bodies[:, : full.gdim]
    ways, before, count = global_sum(
        full.unknowns.comm, np.stack([bodies @ change, bodies @ began, bodies.sum(axis=-1)])
    )
    ways /= count
    before = np.where(scales.unloaded, 0.0, np.linalg.norm(before / count, axis=1))
    # Of a body that has gone away it is the change of its shape, its turn, or what is prescribed.
    shift = np.where(gone[:, None], ways, 0.0)
    others = change - np.where(full.constrained, 0.0, np.einsum("bd,bdi->i", shift, bodies))
    most = scales.largest(np.where(np.any(bodies != 0.0, axis=(0, 1)), others, 0.0))
    obstacles = _obstacle_motions(full, change)
    nearby = np.where(gone, obstacles, np.maximum(most, obstacles))
    found = {}
    for b in np.flatnonzero(gone):
        way = float(np.linalg.norm(ways[b]))
        own = max(most[b], before[b], obstacles[b])
        rest = float(nearby[scales.coupled_with(int(b))].max(initial=own))
        limit = max(_FAR * rest, FLAT * float(scales.size[b]))
        if way > limit:
            found[full.parts.names[b]] = way, limit, rest
    return found


def _obstacle_motions(full: FullSystem, change: Array) -> Array:
    """How far rigid obstacles have moved at the points of every body, (n_bodies,) (length).

    Collective. It is what the displacement relative to the obstacle has not changed by with that
    of the body.

    Args:
        full: The system at its present state.
        change: Of its unknowns since the last commit.
    """
    scales = full.scales
    found: Array = np.zeros(scales.n_bodies)
    of_bodies = np.where(full.label < scales.n_bodies, change, 0.0)
    for number, operator in enumerate(full.operators):
        opposite = operator.contact.opposite
        if not opposite.follows:
            relative = operator.contact.values.jump - opposite.committed_jump
            motion = np.linalg.norm(operator.jump(of_bodies) - relative, axis=1)
            found = np.maximum(found, scales.largest_at_points(number, motion))
    return found
