"""Bodies ejected by a Newton step: no force acts on them, and none has moved them there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fenics_contact.parallel import global_sum
from fenics_contact.systems.balance import MOST_EXCUSED, InitialForces
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.least_motion import find_least_motion
from fenics_contact.systems.rigid_body_modes import RigidBodyModes
from fenics_contact.tolerances import FLAT, ROUND_OFF
from fenics_contact.types import Array, Mask

__all__ = ["find_ejected_bodies"]

# Largest displacement of a body by that of all others. Blocks ejected from between two others had
# ten times as much; one that is let go springs back by as much as it changes its shape.
_MAX_RATIO = 3.0


def find_ejected_bodies(
    full: FullSystem,
    motions: RigidBodyModes,
    contacts: Sequence[Array],
    began: Array,
    start: InitialForces,
) -> dict[str, tuple[float, float, float]]:
    """Find bodies that no force acts on, far from where any has moved them. Collective.

    Such a body is in equilibrium wherever it is, and a Newton step that ejects it leaves no
    residual. Friction takes it along as far as what is near it moves: other bodies, obstacles,
    prescribed values. Contact pushes it as far as it has to go to get out of these, a wedge many
    times as far as they move: the least motion from where it was, as the increment began, by which
    the gaps to all else, where and as it is now, are no longer negative. A body for which there is
    none bears force.

    Args:
        full: The system at its present state.
        motions: Rigid motions of the bodies.
        contacts: Forces of each at this rank's unknowns.
        began: The state in which the increment began.
        start: Forces at that state.

    Returns:
        By the name of a body its translation in the increment, the limit of it, and the largest
        displacement nearby, change of its shape or of contact springs, or least motion (length).
    """
    scales, n = full.scales, full.scales.n_bodies
    loose = ~scales.held[:n]
    if not loose.any():
        return {}
    # What has a load is not in equilibrium, and may be on its way to be set down.
    forces = full.by_body(*contacts, full.load)
    force, committed = (each.sum(axis=0)[:n] for each in (forces, start.pushes))
    idle = (force <= ROUND_OFF * scales.force) | (force <= MOST_EXCUSED * committed)
    unloaded = loose & idle
    if not unloaded.any():
        return {}
    change = full.state() - began
    shifts, counts = (motions.by_body(full, each) for each in (change, np.ones_like(change)))
    sums = np.column_stack([shifts[:, : full.gdim], counts[:, 0]])
    sums = global_sum(full.unknowns.comm, sums)
    if not np.isfinite(sums).all():
        return {}  # a diverged state has no residual either
    translation = sums[:, :-1] / sums[:, -1:]
    # Of an unloaded body the change of its shape, its rotation, and what is prescribed.
    shift = np.where(unloaded[:, None], translation, 0.0)
    other = change - np.where(full.constrained, 0.0, motions.field(shift))
    largest = scales.largest(other)
    opposite = _moved_opposite(full, change)
    around: Array = np.zeros(scales.n_groups)
    group = scales.group[:n]
    np.maximum.at(around, group, np.where(unloaded, opposite, np.maximum(largest, opposite)))
    nearby = np.maximum(largest, around[group])
    way, least = np.linalg.norm(translation, axis=1), FLAT * scales.size
    if not np.any(unloaded & (way > np.maximum(_MAX_RATIO * nearby, least))):
        return {}
    nearby = np.maximum(nearby, _pushed(full, motions, unloaded, began))
    limit = np.maximum(_MAX_RATIO * nearby, least)
    rows = np.stack([way, limit, nearby], axis=1).tolist()
    ejected = np.flatnonzero(unloaded & (way > limit))
    return {full.parts.names[body]: tuple(rows[body]) for body in ejected}


def _pushed(full: FullSystem, motions: RigidBodyModes, bodies: Mask, began: Array) -> Array:
    """How far what else has moved in an increment pushes bodies, (n_bodies,) (length). Collective.

    Args:
        full: The system at its present state.
        motions: Rigid motions of the bodies.
        bodies: Which of them are pushed, (n_bodies,).
        began: The state in which the increment began.
    """
    nothing: Array = np.zeros(len(motions.free))
    modes = np.eye(len(nothing))[motions.of_bodies_alone(bodies)]
    if not len(modes):
        return motions.size_by_body(nothing)
    present = full.state()
    since = motions.fit(present - began, np.asarray) @ modes.T @ modes
    back = motions.displacement(-since)
    full.set_state(present + np.where(full.constrained, 0.0, back))
    # Within an iteration the values of the contacts are kept: they may be of another state.
    states = [contact.states.evaluate_present() for contact in full.contacts]
    every = [np.ones(len(values.gap), np.bool_) for values in states]
    least = find_least_motion(full, motions, modes, states, nothing, every)
    full.set_state(present)
    for contact in full.contacts:
        contact.contact_kinematics.update()
    return motions.size_by_body(nothing if least is None else least)


def _moved_opposite(full: FullSystem, change: Array) -> Array:
    """How far contact may have moved every body at most, at its points, (n_bodies,) (length).

    By rigid obstacles their displacement since the last commit: that of the body minus that
    relative to the obstacle. By contact springs their change of length at that commit: a body that
    they are let go with springs back by it, one pulled by a bond, too. Collective.

    Args:
        full: The system at its present state.
        change: Of its unknowns since the last commit.
    """
    scales = full.scales
    found: Array = np.zeros(scales.n_bodies)
    of_bodies = np.where(full.label < scales.n_bodies, change, 0.0)
    for number, operator in enumerate(full.operators):
        contact, opposite = operator.contact, operator.contact.contact_kinematics
        length: Array = np.zeros(contact.quadrature.n_points)
        if (points := contact.states.committed.points) is not None:
            bore = (points.normal_traction != 0) & np.isfinite(points.gap)
            length[bore] = np.abs(points.gap[bore])
        if opposite.is_rigid:
            # Within an iteration the values of the contact may be those of another state.
            relative = contact.states.evaluate_present().jump - opposite.committed_jump
            displacement = operator.jump(of_bodies) - opposite.turned(relative)
            length = np.maximum(length, np.linalg.norm(displacement, axis=1))
        found = np.maximum(found, scales.largest_at_points(number, length))
    return found
