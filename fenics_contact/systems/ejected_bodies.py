"""Detection of bodies ejected by a Newton step: no force, and an unexplained displacement."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fenics_contact.parallel import global_sum
from fenics_contact.systems.balance import MAX_ROUND_OFF_RESIDUAL_RATIO, InitialForces
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.least_motion import find_least_motion
from fenics_contact.systems.rigid_body_modes import RigidBodyModes
from fenics_contact.tolerances import FLAT, ROUND_OFF
from fenics_contact.types import Array, Mask

__all__ = ["find_ejected_bodies"]

# Largest displacement of an unloaded body relative to all others. Blocks ejected from between two
# others had a ratio of ten; a released body recovers at most its deformation.
_EJECTION_RATIO = 3.0


def find_ejected_bodies(
    full: FullSystem,
    motions: RigidBodyModes,
    contacts: Sequence[Array],
    initial: Array,
    start: InitialForces,
) -> dict[str, tuple[float, float, float]]:
    """Find unloaded bodies displaced further than anything can have moved them. Collective.

    Such a body is in equilibrium anywhere, so that a Newton step that ejects it leaves no residual.
    Friction moves a body no further than its surroundings: other bodies, obstacles and prescribed
    values. Normal contact moves it by at most the least rigid-body motion from its position at the
    start of the increment that removes all penetration.

    Args:
        full: The system at its present state.
        motions: Rigid-body modes of the bodies.
        contacts: Forces of each contact at this rank's unknowns.
        initial: State at the start of the increment.
        start: Forces at that state.

    Returns:
        By body name its translation in the increment, its limit, and the largest displacement
        nearby, deformation, spring length or least motion (length).
    """
    scales, n = full.scales, full.scales.n_bodies
    unconstrained = ~scales.constrained[:n]
    if not unconstrained.any():
        return {}
    # A loaded body is not in equilibrium, and may be in initial positioning.
    forces = full.by_body(*contacts, full.load)
    force, committed = (each.sum(axis=0)[:n] for each in (forces, start.contact))
    negligible = (force <= ROUND_OFF * scales.force) | (
        force <= MAX_ROUND_OFF_RESIDUAL_RATIO * committed
    )
    unloaded = unconstrained & negligible
    if not unloaded.any():
        return {}
    change = full.state() - initial
    translations, counts = (motions.by_body(each) for each in (change, np.ones_like(change)))
    sums = np.column_stack([translations[:, : full.gdim], counts[:, 0]])
    sums = global_sum(full.unknowns.comm, sums)
    if not np.isfinite(sums).all():
        return {}  # a diverged state has no residual either
    translation = sums[:, :-1] / sums[:, -1:]
    # Deformation and rotation of unloaded bodies, and prescribed values.
    rigid = np.where(unloaded[:, None], translation, 0.0)
    other = change - np.where(full.constrained, 0.0, motions.field(rigid))
    largest = scales.largest(other)
    by_contact = _measure_contact_motion(full, change)
    in_group: Array = np.zeros(scales.n_groups)
    group = scales.group[:n]
    np.maximum.at(in_group, group, np.where(unloaded, by_contact, np.maximum(largest, by_contact)))
    nearby = np.maximum(largest, in_group[group])
    distance, minimum = np.linalg.norm(translation, axis=1), FLAT * scales.size
    if not np.any(unloaded & (distance > np.maximum(_EJECTION_RATIO * nearby, minimum))):
        return {}
    nearby = np.maximum(nearby, _measure_expulsion(full, motions, unloaded, initial))
    limit = np.maximum(_EJECTION_RATIO * nearby, minimum)
    rows = np.stack([distance, limit, nearby], axis=1).tolist()
    ejected = np.flatnonzero(unloaded & (distance > limit))
    return {full.parts.names[body]: tuple(rows[body]) for body in ejected}


def _measure_expulsion(
    full: FullSystem, motions: RigidBodyModes, bodies: Mask, initial: Array
) -> Array:
    """Return the least motion of bodies in a mask without penetration. Collective.

    It starts at the state at the start of the increment; the result is (n_bodies,) (length).
    """
    zero: Array = np.zeros(len(motions.free))
    modes = np.eye(len(zero))[motions.find_modes_of_bodies(bodies)]
    if not len(modes):
        return motions.size_by_body(zero)
    present = full.state()
    rigid = motions.fit_modes(present - initial, np.asarray) @ modes.T @ modes
    correction = motions.displacement(-rigid)
    full.set_state(present + np.where(full.constrained, 0.0, correction))
    # Within an iteration the stored values may belong to another state.
    states = [contact.states.evaluate_present() for contact in full.contacts]
    all_points = [np.ones(len(values.gap), np.bool_) for values in states]
    motion = find_least_motion(full, motions, modes, states, zero, all_points)
    full.set_state(present)
    for contact in full.contacts:
        contact.contact_kinematics.update()
    return motions.size_by_body(zero if motion is None else motion)


def _measure_contact_motion(full: FullSystem, change: Array) -> Array:
    """Return the largest displacement of every body that contact can cause, (n_bodies,) (length).

    It is the displacement of a rigid obstacle since the last commit, and the length of the contact
    springs at that commit, which a released body may recover. ``change`` is the change of the
    unknowns since the last commit. Collective.
    """
    scales = full.scales
    largest: Array = np.zeros(scales.n_bodies)
    of_bodies = np.where(full.partition.label < scales.n_bodies, change, 0.0)
    for number, operator in enumerate(full.operators):
        contact, kinematics = operator.contact, operator.contact.contact_kinematics
        length: Array = np.zeros(contact.quadrature.n_points)
        if (points := contact.states.committed.points) is not None:
            loaded = (points.normal_traction != 0) & np.isfinite(points.gap)
            length[loaded] = np.abs(points.gap[loaded])
        if kinematics.is_rigid:
            # Within an iteration the stored values may belong to another state.
            relative = contact.states.evaluate_present().jump - kinematics.committed_jump
            displacement = operator.jump(of_bodies) - kinematics.rotate(relative)
            length = np.maximum(length, np.linalg.norm(displacement, axis=1))
        largest = np.maximum(largest, scales.largest_at_points(number, length))
    return largest
