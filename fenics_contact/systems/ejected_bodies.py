"""Bodies ejected by a Newton step: no force acts on them, and none has moved them there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fenics_contact.parallel import global_sum
from fenics_contact.systems.balance import MOST_EXCUSED, InitialForces, by_body
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.rigid_body_modes import RigidBodyModes
from fenics_contact.tolerances import FLAT
from fenics_contact.types import Array, Mask

__all__ = ["find_ejected_bodies"]

# Largest displacement of a body by that of all others. Blocks ejected from between two others had
# ten times as much; one that is let go springs back by as much as it changes its shape.
_MAX_RATIO = 3.0
# Mean square of the contact normals along a direction, from which on contact pushes along it: a
# slope of one in thirty.
_MIN_MEAN_SQUARE = 1e-3


def find_ejected_bodies(
    full: FullSystem,
    motions: RigidBodyModes,
    contacts: Sequence[Array],
    began: Array,
    start: InitialForces,
) -> dict[str, tuple[float, float, float]]:
    """Find bodies that no force acts on, far from where any has moved them. Collective.

    Such a body is in equilibrium wherever it is, and a Newton step that ejects it leaves no
    residual. Along the contact normals bodies push each other as far as they spring back, or as
    wedges do, many times as far. Along all other directions only friction takes a body along, as
    far as what is near it moves: other bodies, obstacles, prescribed values.

    Args:
        full: The system at its present state.
        motions: Rigid motions of the bodies.
        contacts: Forces of each at this rank's unknowns.
        began: The state in which the increment began.
        start: Forces at that state.

    Returns:
        By the name of a body its translation in the increment along directions that no contact
        normal has a part in, the limit of it, and the largest displacement nearby, or change of its
        shape (length).
    """
    scales, n = full.scales, full.scales.n_bodies
    loose = motions.unconstrained_bodies()
    if not loose.any():
        return {}
    # What has a load is not in equilibrium, and may be on its way to be set down.
    forces = by_body(full.unknowns.comm, [*contacts, full.load], full.label, full.n_bodies)
    force, committed = (each.sum(axis=0)[:n] for each in (forces, start.pushes))
    unloaded = loose & (scales.is_unloaded(force) | (force <= MOST_EXCUSED * committed))
    if not unloaded.any():
        return {}
    change, bodies = full.state() - began, motions.of_bodies[:, : full.gdim]
    sums = np.column_stack([bodies @ change, bodies[:, 0].sum(axis=1)])
    sums = global_sum(full.unknowns.comm, sums)
    if not np.isfinite(sums).all():
        return {}  # a diverged state has no residual either
    translation = sums[:, :-1] / sums[:, -1:]
    # Of an unloaded body the change of its shape, its rotation, and what is prescribed.
    shift = np.where(unloaded[:, None], translation, 0.0)
    other = change - np.where(full.constrained, 0.0, np.einsum("bd,bdi->i", shift, bodies))
    largest = scales.largest(np.where(np.any(bodies != 0.0, axis=(0, 1)), other, 0.0))
    obstacles = _obstacle_displacements(full, change)
    around = np.where(unloaded, obstacles, np.maximum(largest, obstacles))
    nearby = np.maximum(largest, obstacles)
    for body in np.flatnonzero(unloaded):
        nearby[body] = around[scales.coupled_with(int(body))].max(initial=nearby[body])
    limit = np.maximum(_MAX_RATIO * nearby, FLAT * scales.size)
    if not np.any(unloaded & (np.linalg.norm(translation, axis=1) > limit)):
        return {}
    projection = _off_contact_normals(full, scales.is_unloaded(committed))
    aside = np.linalg.norm(np.einsum("bij,bj->bi", projection, translation), axis=1)
    rows = np.stack([aside, limit, nearby], axis=1).tolist()
    ejected = np.flatnonzero(unloaded & (aside > limit))
    return {full.parts.names[body]: tuple(rows[body]) for body in ejected}


def _obstacle_displacements(full: FullSystem, change: Array) -> Array:
    """Largest displacement of rigid obstacles at the points of every body, (n_bodies,) (length).

    Since the last commit: that of the body minus that relative to the obstacle. Collective.

    Args:
        full: The system at its present state.
        change: Of its unknowns since the last commit.
    """
    scales = full.scales
    found: Array = np.zeros(scales.n_bodies)
    of_bodies = np.where(full.label < scales.n_bodies, change, 0.0)
    for number, operator in enumerate(full.operators):
        contact, opposite = operator.contact, operator.contact.opposite
        if opposite.is_rigid:
            # Within an iteration the values of the contact may be those of another state.
            opposite.update()
            relative = contact.acting.own.evaluate()["jump"] - opposite.committed_jump
            displacement = operator.jump(of_bodies) - opposite.turned(relative)
            length = np.linalg.norm(displacement, axis=1)
            found = np.maximum(found, scales.largest_at_points(number, length))
    return found


def _off_contact_normals(full: FullSystem, unloaded: Mask) -> Array:
    """Projections on the directions that the contact normals of a body have no part in. Collective.

    Of its points that transmitted force at the last commit, on either side; of all that had an
    opposite point if none did.

    Args:
        full: The system.
        unloaded: Bodies without contact force at the last commit, (n_bodies,).

    Returns:
        Array (n_bodies, gdim, gdim).
    """
    n, d = full.scales.n_bodies, full.gdim
    squares: Array = np.zeros((2, n, d, d))
    for number, operator in enumerate(full.operators):
        contact = operator.contact
        points = contact.states.committed.points or contact.values
        known = np.isfinite(points.normal).all(axis=1) & np.isfinite(points.normal_traction)
        known &= points.paired > 0
        normal = np.where(known[:, None], points.normal, 0.0)
        area = np.where(known, contact.measure, 0.0)
        force = area * np.where(known, np.abs(points.normal_traction), 0.0)
        products = np.einsum("qi,qj->qij", normal, normal)
        own, opposite = full.scales.sides[number]
        # A body that a contact couples with itself counts once.
        for body, counts in ((own, own < n), (opposite, (opposite != own) & (opposite < n))):
            for which, weight in enumerate((force, area)):
                share = weight[counts, None, None] * products[counts]
                np.add.at(squares[which], body[counts], share)
    squares = global_sum(full.unknowns.comm, squares)
    chosen = np.where(unloaded[:, None, None], squares[1], squares[0])
    total = np.trace(chosen, axis1=1, axis2=2)[:, None, None]
    mean, axes = np.linalg.eigh(chosen / np.where(total > 0, total, 1.0))
    axes = np.where((mean < _MIN_MEAN_SQUARE)[:, None, :], axes, 0.0)
    return np.asarray(axes @ axes.swapaxes(1, 2))
