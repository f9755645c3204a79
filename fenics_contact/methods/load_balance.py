"""Necessary conditions for equilibrium, before any iteration.

Rigid-body modes must be constrained, and admissible contact forces must be able to balance the load
on them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.optimize
import scipy.sparse.csgraph

from fenics_contact.contact.contact import Contact
from fenics_contact.parallel import broadcast_from_root, gather_rows
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.operator import ContactOperator
from fenics_contact.systems.rigid_body_modes import RigidBodyModes
from fenics_contact.tolerances import NEGLIGIBLE
from fenics_contact.types import Array, Index

__all__ = ["check_balance", "find_free_modes", "unbalanced"]

# Sides of the circumscribed polygon of the friction cone in space, which excludes no equilibrium.
_CONE_SIDES = 64
# A uniform sample of so many rays nearly always suffices.
_MAX_SAMPLED_RAYS = 2000


def find_free_modes(modes: RigidBodyModes, full: FullSystem) -> None:
    """Find the rigid-body modes that are free with the present data of the bulk. Collective.

    Args:
        modes: The modes.
        full: The system on all unknowns, with evaluated contacts.

    Raises:
        ValueError: A mode is unconstrained even if all of Γc is closed.
    """
    with full.stiffness_at_rest() as stiffness:
        full.scales.measure_stiffness(stiffness)
        modes.find_free(stiffness, full.constrained)
    unconstrained = modes.find_unconstrained(full.operators, closed_only=False) @ modes.free
    if unconstrained.size:
        motions = "; ".join(modes.describe(row) for row in unconstrained)
        finite = any(contact.contact_kinematics.is_finite for contact in full.contacts)
        order = " to first order" if finite else ""
        raise ValueError(
            f"neither Dirichlet conditions nor contact constrain this rigid-body mode{order}: "
            f"{motions}. Add a Dirichlet condition that constrains it, or friction"
        )
    full.bulk.note_data()


def check_balance(modes: RigidBodyModes, load: Array, operators: Sequence[ContactOperator]) -> None:
    """Check that admissible contact forces can balance the resultant of the load. Collective.

    Contact forces within the friction cone may act anywhere on Γc: a necessary condition, which a
    body violates that is pulled off, tipped over the edge of or pushed along its obstacle. Groups
    of coupled bodies are separate.

    Args:
        modes: The free rigid-body modes.
        load: External forces at this rank's unknowns (force).
        operators: Operators of evaluated contacts, over all unknowns.

    Raises:
        ValueError: The load cannot be balanced; with the resultant and the mode.
    """
    rows = (
        modes.find_state_independent_modes()
    )  # lever arms change with the rotation of an obstacle
    resultant, size = modes.load_resultant(load, operators)
    if not resultant.any():
        return
    comm = modes.comm
    local_rays = [_compute_admissible_forces(o, modes.jumps_at(o)[rows]) for o in operators]
    all_rays = gather_rows(comm, np.concatenate([np.zeros((0, len(rows))), *local_rays]))
    acts = (np.abs(all_rays) > NEGLIGIBLE).astype(np.float64)
    couples = acts.T @ acts + modes.find_coupled_modes()[np.ix_(rows, rows)]
    n_groups, label = scipy.sparse.csgraph.connected_components(couples, directed=False)
    failures: list[str] = []
    for group in (np.flatnonzero(label == number) for number in range(n_groups)):
        largest = np.abs(resultant[group]).max()
        if largest == 0.0:
            continue
        direction, rays = -resultant[group] / largest, all_rays[:, group]
        # Rays have unit length, for the conditioning; those of round-off are left out.
        length = np.linalg.norm(rays, axis=1)
        rays = rays[length > NEGLIGIBLE] / length[length > NEGLIGIBLE, None]
        residual = broadcast_from_root(comm, unbalanced(rays.T, direction)) if len(rays) else 1.0
        allowed = NEGLIGIBLE * max(1.0, size[group].max() / largest)
        if residual > allowed:
            limits = broadcast_from_root(comm, _maximise_forces(rays.T, direction)) + 0.0  # no -0
            failures += _describe(modes, rows[group], direction, limits, allowed, largest)
    if failures:
        raise ValueError(
            "no contact force can balance the load: its resultant along the free motion "
            f"{', and along '.join(failures)}. Contact forces are compressive and within the "
            "friction cone. Check the sign and magnitude of the load, and the normals, "
            "or add a Dirichlet condition"
        )


def _describe(
    modes: RigidBodyModes,
    rows: Index,
    direction: Array,
    limits: Array,
    allowed: float,
    largest: float,
) -> list[str]:
    """Describe the components of a resultant by its largest that contact cannot balance."""
    names = [modes.describe(modes.free[row]) for row in rows]
    # A limit is NaN if not even the other components can be balanced.
    descriptions = [
        f"({name}) is {-largest * force:.6g}, of which contact can balance at most "
        f"{largest * limit:.6g} with the other components unchanged"
        for name, force, limit in zip(names, direction, limits, strict=True)
        if abs(force) > limit + allowed
    ]
    worst = int(np.argmax(np.abs(direction)))
    return descriptions or [f"({names[worst]}) is {-largest * direction[worst]:.6g}"]


def _compute_admissible_forces(operator: ContactOperator, modes: Array) -> Array:
    """Compute generalised forces of the admissible directions at local points, (n_rays, n_modes).

    The modes are given at the points, (n_modes, n_points, gdim).
    """
    contact, values = operator.contact, operator.contact.values
    normal, law = values.normal, contact.law
    d = normal.shape[1]
    directions = []
    if law.has_tangential:
        if d == 2:
            tangents = [np.column_stack([-normal[:, 1], normal[:, 0]])]
            tangents.append(-tangents[0])
        else:
            tangents = _tangential_directions(normal)
        ratio = values.friction_bound_ratio[:, None]
        ratio = ratio if d == 2 else ratio / np.cos(np.pi / _CONE_SIDES)
        bounded = np.isfinite(ratio)
        pressure = -_stiff_normals(contact) * law.has_normal_stiffness
        directions = [
            np.where(bounded, pressure + np.where(bounded, ratio, 0.0) * t, t) for t in tangents
        ]
    if law.has_normal_stiffness:
        pressure = -_stiff_normals(contact)
        directions += [pressure, -pressure] if law.has_tension else [pressure]
    rays = [np.einsum("mqd,qd->qm", modes, direction) for direction in directions]
    return np.concatenate([np.zeros((0, len(modes))), *rays])


def unbalanced(rays: Array, resultant: Array) -> float:
    """Compute min Σ|resultant - rays·x| over x ≥ 0; rays (n_free, n_rays) of unit length.

    Non-negative least squares detect zero quickly, but otherwise may end far from the optimum: then
    a linear programme follows, which takes ten times as long.
    """
    m, n = rays.shape
    for sample in (rays[:, :: n // _MAX_SAMPLED_RAYS + 1], rays):
        try:
            forces = scipy.optimize.nnls(sample, resultant)[0]
        except RuntimeError:
            continue  # too many iterations
        if np.abs(sample @ forces - resultant).sum() < NEGLIGIBLE:
            return 0.0
    tolerance = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    solution = scipy.optimize.linprog(
        np.concatenate([np.zeros(n), np.ones(2 * m)]),
        A_eq=np.hstack([rays, np.eye(m), -np.eye(m)]),
        b_eq=resultant,
        options=tolerance,
    )
    # After a failure of the programme the load is accepted.
    return float(solution.fun) if solution.status == 0 else 0.0


def _maximise_forces(rays: Array, force: Array) -> Array:
    """Maximise each component of a force of the cone with the others prescribed, (n_free,).

    Each has the sign of ``force``, or is NaN if the others cannot be reached. The rays of the cone,
    (n_free, n_rays), have unit length.
    """
    largest = np.full(len(force), np.nan)
    if not rays.size:
        return largest
    for i, value in enumerate(force):
        rest = np.where(np.arange(len(force)) == i, 0.0, force)
        direction = np.zeros((len(force), 1))
        direction[i] = -1.0 if value >= 0 else 1.0
        cost = np.append(np.zeros(rays.shape[1]), -1.0)
        solution = scipy.optimize.linprog(cost, A_eq=np.hstack([rays, direction]), b_eq=rest)
        if solution.status == 0:
            largest[i] = solution.x[-1]
    return largest


def _stiff_normals(contact: Contact) -> Array:
    """Return the normals at the points, zero where k_n = 0, (n_points, gdim)."""
    values = contact.values
    is_stiff = np.asarray(values.parameters.get("k_n", 1.0)) > 0
    return np.where(is_stiff[..., None], values.normal, 0.0)


def _tangential_directions(normal: Array) -> list[Array]:
    """Return `_CONE_SIDES` tangential unit vectors around each normal in space."""
    least = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    first = np.cross(normal, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normal, first)
    angles = 2 * np.pi * np.arange(_CONE_SIDES) / _CONE_SIDES
    return [np.cos(a) * first + np.sin(a) * second for a in angles]
