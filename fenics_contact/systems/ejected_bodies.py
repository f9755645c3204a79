"""Bodies that nothing loads or touches any more, farther away than anything has pushed them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fenics_contact.parallel import global_sum
from fenics_contact.systems.balance import MOST_EXCUSED, InitialForces
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.rigid_body_modes import RigidBodyModes
from fenics_contact.tolerances import FLAT
from fenics_contact.types import Array

__all__ = ["find_ejected_bodies"]

# How many times as far as all else a body may go. Blocks thrown out from between two others went
# ten times as far; one that is let go springs back by as much as it changes its shape.
_FAR = 3.0
# Mean square of the normals along a direction, from which on contact pushes along it: a slope of
# one in thirty.
_PUSHED = 1e-3


def find_ejected_bodies(
    full: FullSystem,
    motions: RigidBodyModes,
    contacts: Sequence[Array],
    began: Array,
    start: InitialForces,
) -> dict[str, tuple[float, float, float]]:
    """Bodies that have gone away, and on which no force acts. Collective.

    Such a body is in equilibrium wherever it is, and a step of an iteration that throws it out of
    sight of all others leaves no residual. Along the normals of its contacts bodies push each other
    as far as they spring back, or as wedges do, many times as far. Along all other directions only
    friction takes a body along: as far as what is near it goes, obstacles and prescribed values
    included.

    Args:
        full: The system at its present state.
        motions: Rigid motions of the bodies.
        contacts: Forces of each at this rank's unknowns.
        began: The state in which the increment began.
        start: Forces at that state.

    Returns:
        By its name how far a body has gone, how far it may, and how far anything else that it may
        touch has, or its own change of shape (length).
    """
    scales = full.scales
    looked_at = motions.unconstrained_bodies()
    if not looked_at.any():
        return {}
    # What has a load is not in equilibrium, and may be on its way to be set down.
    forces = scales.sums(sum((np.abs(f) for f in contacts), np.abs(full.load)))
    borne = start.pushes.sum(axis=0)[: scales.n_bodies]
    gone = looked_at & (scales.is_unloaded(forces) | (forces <= MOST_EXCUSED * borne))
    if not gone.any():
        return {}
    change, bodies = full.state() - began, motions.of_bodies[:, : full.gdim]
    sums = np.column_stack([bodies @ change, bodies[:, 0].sum(axis=1)])
    sums = global_sum(full.unknowns.comm, sums)
    ways = sums[:, :-1] / sums[:, -1:]
    # Of a body that has gone away it is the change of its shape, its turn, or what is prescribed.
    shift = np.where(gone[:, None], ways, 0.0)
    others = change - np.where(full.constrained, 0.0, np.einsum("bd,bdi->i", shift, bodies))
    most = scales.largest(np.where(np.any(bodies != 0.0, axis=(0, 1)), others, 0.0))
    obstacles = _obstacle_motions(full, change)
    nearby = np.where(gone, obstacles, np.maximum(most, obstacles))
    rest = np.array(
        [
            nearby[scales.coupled_with(b)].max(initial=max(most[b], obstacles[b]))
            for b in range(scales.n_bodies)
        ]
    )
    limit = np.maximum(_FAR * rest, FLAT * scales.size)
    if not np.any(gone & (np.linalg.norm(ways, axis=1) > limit)):
        return {}
    way = np.linalg.norm(np.einsum("bij,bj->bi", _not_pushed(full, borne), ways), axis=1)
    found = np.flatnonzero(gone & (way > limit))
    rows = np.stack([way, limit, rest], axis=1).tolist()
    return {full.parts.names[b]: tuple(rows[b]) for b in found}


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


def _not_pushed(full: FullSystem, borne: Array) -> Array:
    """Projection of every body on the directions along which no contact pushes it. Collective.

    By the normals of the points that bore force at the last commit, or of all that have an
    opposite point if none of the body did.

    Args:
        full: The system.
        borne: Contact force on every body at the last commit, (n_bodies,) (force).

    Returns:
        Array (n_bodies, gdim, gdim).
    """
    n, d = full.scales.n_bodies, full.gdim
    normals: Array = np.zeros((2, n, d, d))
    for number, operator in enumerate(full.operators):
        contact = operator.contact
        points = contact.states.committed.points or contact.values
        known = (points.paired > 0) & np.isfinite(points.normal).all(axis=1)
        normal = np.where(known[:, None], points.normal, 0.0)
        area = np.where(known, contact.measure, 0.0)
        products = np.einsum("qi,qj->qij", normal, normal)
        own, other = full.scales.bodies_at_points(operator, number)
        for which, weight in enumerate((area * np.abs(points.normal_traction), area)):
            np.add.at(normals[which], own, weight[:, None, None] * products)
            met = (other != own) & (other < n)
            np.add.at(normals[which], other[met], weight[met, None, None] * products[met])
    normals = global_sum(full.unknowns.comm, normals)
    unloaded = full.scales.is_unloaded(borne)
    chosen = np.where(unloaded[:, None, None], normals[1], normals[0])
    total = np.trace(chosen, axis1=1, axis2=2)[:, None, None]
    squares, axes = np.linalg.eigh(chosen / np.where(total > 0, total, 1.0))
    axes = np.where((squares < _PUSHED)[:, None, :], axes, 0.0)
    return np.asarray(axes @ axes.swapaxes(1, 2))
