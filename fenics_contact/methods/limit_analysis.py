"""Limit analysis: loads beyond the friction limit at the present pressures.

Along a rigid-body mode r without penetration friction dissipates at most D(r) = ∫ bound |r_t|, with
the given bound (μp). An equilibrium with these bounds exists if load·r ≤ D(r) for every such r;
elastic forces do no work on rigid-body modes. As D is convex and the modes are few, the maximum of
load·r / D(r) is found by cutting planes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize
from mpi4py import MPI

from fenics_contact.contact.values import PointValues
from fenics_contact.parallel import broadcast_from_root, global_max, global_sum
from fenics_contact.systems.operator import ContactOperator
from fenics_contact.systems.reference_scales import ReferenceScales
from fenics_contact.systems.rigid_body_modes import RigidBodyModes
from fenics_contact.tolerances import NEGLIGIBLE
from fenics_contact.types import Array

__all__ = ["Overload", "find_overloads", "support_stiffness"]

# Cutting planes, and relative tolerance of the largest overload factor.
_MAX_PLANES, _FACTOR_TOLERANCE = 200, 1e-3
# Bound of the coefficients, which are of order one unless friction does not resist the mode.
_MAX_COEFFICIENT = 1e4
# Coefficient, relative to the largest, below which a motion is left out of the description.
_DESCRIBED_RATIO = 0.02


@dataclass(frozen=True)
class Overload:
    """A rigid-body mode along which the load exceeds the friction limit.

    Attributes:
        motion: Description of the mode.
        load: Generalised load (force).
        resistance: Largest generalised friction force (force).
        group: Group of coupled bodies, of `ReferenceScales.group`.
    """

    motion: str
    load: float
    resistance: float
    group: int

    @property
    def factor(self) -> float:
        """Load by resistance; infinite without resistance."""
        return self.load / self.resistance if self.resistance > 0 else np.inf

    def describe(self) -> str:
        """Describe the overload for log and errors."""
        return (
            f"overload: along the {self.motion} the load is {self.load:.4g}, but friction under "
            f"the present pressures can balance at most {self.resistance:.4g}"
        )


def find_overloads(
    motions: RigidBodyModes, operators: Sequence[ContactOperator], load: Array
) -> list[Overload]:
    """Find the modes along which the load exceeds the present friction limit most. Collective.

    If the search does not converge, the result has overloads, but perhaps not the largest.

    Args:
        motions: The rigid-body modes.
        operators: Operators of evaluated contacts, over all unknowns.
        load: External forces at this rank's unknowns (force).

    Returns:
        The largest overload of each group of coupled bodies, the largest first. There is none if
        friction can balance the load, or if limit analysis does not apply: rotating obstacles,
        curved ones with an unknown motion, finite kinematics, unlimited tangential forces, or
        friction bounds that depend on the motion.
    """
    if motions.has_obstacle_rotations:
        return []
    (resultant, _), groups = motions.load_resultant(load, operators), motions.groups()
    overloads: list[Overload] = []
    for group in np.unique(groups):
        overload = _find_worst(motions, operators, int(group), resultant)
        if overload is not None:
            overloads.append(overload)
    return sorted(overloads, key=lambda overload: -overload.factor)


def support_stiffness(
    operators: Sequence[ContactOperator],
    overloads: Sequence[Overload],
    scales: ReferenceScales,
    slip_ratio: float,
) -> list[Array | None]:
    """Return the stiffness of tangential springs that support overloaded bodies. Collective.

    Bodies slide by ``slip_ratio`` of their size against them, with the present friction bound.
    Raising the bound instead would also allow more friction across the sliding direction, and in a
    groove reduce the pressure.

    Returns:
        For each contact, (n_points, gdim, gdim) (stress/length); None without springs.
    """
    result: list[Array | None] = []
    for number, operator in enumerate(operators):
        contact, total = operator.contact, np.zeros(operator.contact.quadrature.n_points)
        if contact.law.has_friction:
            bound = _largest_friction(contact.values)
            slip = slip_ratio * scales.size_at_points(number)
            for overload in overloads:
                in_group = scales.group_of_points(number) == overload.group
                total += np.where(in_group, (overload.factor - 1.0) * bound / slip, 0.0)
        if not global_max(contact.surface.mesh.comm, total) > 0.0:
            result.append(None)
            continue
        normal = contact.values.normal
        tangential = np.eye(normal.shape[1]) - np.einsum("qi,qj->qij", normal, normal)
        result.append(total[:, None, None] * tangential)
    return result


def _find_worst(
    motions: RigidBodyModes, operators: Sequence[ContactOperator], group: int, load: Array
) -> Overload | None:
    """Find the largest overload along the free modes of a group of bodies. Collective."""
    comm, rows = motions.comm, np.flatnonzero(motions.groups() == group)
    load = load[rows]
    size = np.abs(load).max(initial=0.0)
    if not size > 0:
        return None
    coupled = []
    for operator in operators:
        modes = motions.jumps_at(operator)[rows]
        if global_max(comm, np.abs(modes)) > 0.0:
            coupled.append((operator.contact, modes))
    contacts = [contact for contact, _ in coupled]
    frictional = [c for c in contacts if c.law.has_friction]
    unlimited = any(c.law.has_tangential and not c.law.has_friction for c in contacts)
    unlimited |= any(c.effective_law.own.bound_depends_on_motion for c in frictional)
    # Normals change with finite motions, and with the position of a curved obstacle.
    normals_change = any(
        c.contact_kinematics.is_finite or (c.motions and not c.contact_kinematics.is_flat)
        for c in contacts
    )
    if unlimited or normals_change or not frictional or any(c.law.has_tension for c in contacts):
        return None
    finite = all(
        np.isfinite(v).all()
        for c in frictional
        for v in (c.values.law_friction_bound, c.values.circumradius)
    )
    if not comm.allreduce(finite, op=MPI.LAND):  # unknown bounds, or a diverged state
        return None
    sliding, approaching = [], []
    for contact, modes in coupled:
        normal = contact.values.normal
        normal_part = np.einsum("mqd,qd->mq", modes, normal)
        if contact.law.has_normal_stiffness:
            approaching.append(normal_part[:, contact.pairs.paired])
        if contact.law.has_friction:
            tangential = modes - normal_part[:, :, None] * normal
            # Open points may close: they have the bound of the law at zero pressure.
            sliding.append((tangential, contact.measure * _largest_friction(contact.values)))
    closing = np.concatenate(approaching or [np.zeros((len(load), 0))], axis=1)

    def dissipation(motion: Array) -> tuple[float, Array]:
        """Compute D and its gradient."""
        result: Array = np.zeros(1 + len(motion))
        for tangential, limit in sliding:
            slip = np.tensordot(motion, tangential, axes=1)
            length = np.linalg.norm(slip, axis=1)
            direction = slip / np.maximum(length, np.finfo(float).tiny)[:, None]
            result[0] += limit @ length
            result[1:] += np.einsum("mqd,qd,q->m", tangential, direction, limit)
        result = global_sum(comm, result)
        return float(result[0]), result[1:]

    # Maximise the generalised load subject to linearised D ≤ 1, in units of the load.
    planes: list[Array] = []
    bounds: list[float] = []
    worst, most = None, 0.0
    motion: Array = load / size
    for _ in range(_MAX_PLANES):
        resistance, slope = dissipation(motion)
        planes.append(slope / size)
        bounds.append(1.0)
        approach = motion @ closing
        largest = np.abs(motion).max()
        deepest = global_max(comm, approach, empty=0.0)
        if deepest > NEGLIGIBLE * largest:
            first = comm.allgather(approach.size > 0 and approach.max() == deepest).index(True)
            row = closing[:, np.argmax(approach)] if comm.rank == first else None
            planes.append(comm.bcast(row, root=first))
            bounds.append(0.0)
        elif load @ motion > most * resistance:
            most = float(load @ motion) / resistance if resistance > 0 else np.inf
            worst = motion / largest
        solution = scipy.optimize.linprog(
            -load / size, A_ub=planes, b_ub=bounds, bounds=(-_MAX_COEFFICIENT, _MAX_COEFFICIENT)
        )
        status, motion = broadcast_from_root(comm, (solution.status, solution.x))
        if status != 0 or load @ motion / size <= max(1.0, most * (1 + _FACTOR_TOLERANCE)):
            break
    if worst is None or most <= 1.0:
        return None
    described = np.where(np.abs(worst) < _DESCRIBED_RATIO, 0.0, worst) @ motions.free[rows]
    name, resistance = motions.describe(described), dissipation(worst)[0]
    return Overload(name, float(load @ worst), resistance, group)


def _largest_friction(values: PointValues) -> Array:
    """Return the largest tangential traction with the present pressures, (n_points,) (stress)."""
    return values.law_friction_bound * values.circumradius
