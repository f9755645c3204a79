"""Whether admissible contact forces can balance a load, before any iteration.

A body that contact alone holds is ordinary. One that nothing will ever hold, or a load that pulls
it off its obstacle, has no solution.
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
from fenics_contact.types import Array, Index

__all__ = ["check_balance", "find_free_modes", "unbalanced"]

# Generalised forces relative to the largest that the load could exert, and entries of unit modes at
# the points, that are zero.
_BALANCED, _FELT = 1e-8, 1e-10
# Directions by which the friction cone is enclosed in space: a polygon around the circle, so that a
# balance that exists is never denied.
_CONE_SIDES = 64
# As many of these, of all points and directions alike, nearly always balance what all of them do.
_SOME_RAYS = 2000


def find_free_modes(modes: RigidBodyModes, full: FullSystem) -> None:
    """Find the rigid-body modes that are free with the present data of the bulk. Collective.

    Args:
        modes: The modes.
        full: The system on all unknowns, its contacts evaluated.

    Raises:
        ValueError: No contact resists one of them, even if all of Γc were closed; it names it.
    """
    with full.stiffness_at_rest() as stiffness:
        full.scales.measure_stiffness(stiffness)
        modes.find_free(stiffness, full.constrained)
    loose = modes.unconstrained(full.operators, closed_only=False) @ modes.free
    if loose.size:
        motions = "; ".join(modes.describe(row) for row in loose)
        finite = any(contact.finite for contact in full.contacts)
        order = " to first order" if finite else ""
        raise ValueError(
            f"neither Dirichlet conditions nor contact constrain this rigid-body mode{order}: "
            f"{motions}. Add a Dirichlet condition that constrains it, or friction"
        )
    full.bulk.note_data()


def check_balance(modes: RigidBodyModes, load: Array, operators: Sequence[ContactOperator]) -> None:
    """Refuse a load whose resultant no admissible contact forces can balance. Collective.

    The contact may push anywhere on Γc, and rub within the friction cone: a necessary condition
    only, but it finds a body pulled off its obstacle, tipped over its edge or pushed along it.
    Bodies that no contact couples are looked at apart.

    Args:
        modes: The free rigid-body modes.
        load: External forces at this rank's unknowns (force).
        operators: Of evaluated contacts, over all unknowns.

    Raises:
        ValueError: It gives the resultant and the mode.
    """
    rows = modes.straight()  # arms turn with an obstacle: what it cannot bear here it may there
    resultant, size = modes.load_resultant(load, operators)
    if not resultant.any():
        return
    comm = modes.comm
    mine = [_admissible_forces(o, modes.at_points(o)[rows]) for o in operators]
    every = gather_rows(comm, np.concatenate([np.zeros((0, len(rows))), *mine]))
    felt = (np.abs(every) > _FELT).astype(np.float64)
    couples = felt.T @ felt + modes.of_same_body()[np.ix_(rows, rows)]
    n_groups, label = scipy.sparse.csgraph.connected_components(couples, directed=False)
    beyond: list[str] = []
    for group in (np.flatnonzero(label == number) for number in range(n_groups)):
        largest = np.abs(resultant[group]).max()
        if largest == 0.0:
            continue
        direction, rays = -resultant[group] / largest, every[:, group]
        # Unit columns: a ray's length has no meaning, and badly scaled ones spoil the solution. One
        # of rounding only, such as of tangential forces on a mode across them, is none.
        length = np.linalg.norm(rays, axis=1)
        rays = rays[length > _FELT] / length[length > _FELT, None]
        rest = broadcast_from_root(comm, unbalanced(rays.T, direction)) if len(rays) else 1.0
        allowed = _BALANCED * max(1.0, size[group].max() / largest)
        if rest > allowed:
            limits = broadcast_from_root(comm, _largest_forces(rays.T, direction)) + 0.0  # no -0
            beyond += _describe(modes, rows[group], direction, limits, allowed, largest)
    if beyond:
        raise ValueError(
            "no contact force can balance the load: its resultant along the free motion "
            f"{', and along '.join(beyond)}. Contact forces are compressive and within the "
            "friction cone. Check the sign and magnitude of the load, and the normals, "
            "or add a Dirichlet condition"
        )


def _describe(
    modes: RigidBodyModes,
    rows: Index,
    wanted: Array,
    limits: Array,
    allowed: float,
    largest: float,
) -> list[str]:
    """What of a resultant, relative to its largest component, contact cannot bear, in words."""
    named = [modes.describe(modes.free[row]) for row in rows]
    # NaN: not even the other components can be borne.
    found = [
        f"({name}) is {-largest * force:.6g}, of which contact can balance at most "
        f"{largest * limit:.6g} with the other components unchanged"
        for name, force, limit in zip(named, wanted, limits, strict=True)
        if abs(force) > limit + allowed
    ]
    worst = int(np.argmax(np.abs(wanted)))
    return found or [f"({named[worst]}) is {-largest * wanted[worst]:.6g}"]


def _admissible_forces(operator: ContactOperator, modes: Array) -> Array:
    """Generalised forces of every admissible direction at this rank's points, (n_rays, n_modes).

    Args:
        operator: Of the contact.
        modes: At its points, (n_modes, n_points, gdim).
    """
    contact, values = operator.contact, operator.contact.values
    normal, law = values.normal, contact.law
    d = normal.shape[1]
    directions = []
    if law.has_tangential:
        if d == 2:
            around = [np.column_stack([-normal[:, 1], normal[:, 0]])]
            around.append(-around[0])
        else:
            around = _around(normal)
        ratio = values.friction_bound_ratio[:, None]
        ratio = ratio if d == 2 else ratio / np.cos(np.pi / _CONE_SIDES)
        bounded = np.isfinite(ratio)  # by the normal force
        pushes = -_bearing_normals(contact) * law.has_normal_stiffness
        directions = [
            np.where(bounded, pushes + np.where(bounded, ratio, 0.0) * t, t) for t in around
        ]
    if law.has_normal_stiffness:
        pushes = -_bearing_normals(contact)
        directions += [pushes, -pushes] if law.has_tension else [pushes]
    rays = [np.einsum("mqd,qd->qm", modes, direction) for direction in directions]
    return np.concatenate([np.zeros((0, len(modes))), *rays])


def unbalanced(rays: Array, resultant: Array) -> float:
    """The least Σ|resultant - rays·x| over x ≥ 0; rays (n_free, n_rays) of unit length.

    Least squares without negatives find at once that there is nothing left, of some of the rays
    quicker than of all, but where there is they may end far from their optimum: then a linear
    programme, which takes ten times as long.
    """
    m, n = rays.shape
    for tried in (rays[:, :: n // _SOME_RAYS + 1], rays):
        try:
            forces = scipy.optimize.nnls(tried, resultant)[0]
        except RuntimeError:
            continue  # too many iterations
        if np.abs(tried @ forces - resultant).sum() < _BALANCED:
            return 0.0
    tolerance = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    found = scipy.optimize.linprog(
        np.concatenate([np.zeros(n), np.ones(2 * m)]),
        A_eq=np.hstack([rays, np.eye(m), -np.eye(m)]),
        b_eq=resultant,
        options=tolerance,
    )
    # What the programme cannot tell is left to the solution itself to show.
    return float(found.fun) if found.status == 0 else 0.0


def _largest_forces(rays: Array, wanted: Array) -> Array:
    """The largest of each component of a force that rays can make, all others as wanted, (n_free,).

    Of the sign that is wanted; NaN where the others alone cannot be made.

    Args:
        rays: (n_free, n_rays) of unit length.
        wanted: The force, (n_free,).
    """
    found = np.full(len(wanted), np.nan)
    if not rays.size:
        return found
    for i, value in enumerate(wanted):
        rest = np.where(np.arange(len(wanted)) == i, 0.0, wanted)
        along = np.zeros((len(wanted), 1))
        along[i] = -1.0 if value >= 0 else 1.0
        cost = np.append(np.zeros(rays.shape[1]), -1.0)
        made = scipy.optimize.linprog(cost, A_eq=np.hstack([rays, along]), b_eq=rest)
        if made.status == 0:
            found[i] = made.x[-1]
    return found


def _bearing_normals(contact: Contact) -> Array:
    """Normals at the points, zero where k_n is: there is no foundation there, (n_points, gdim)."""
    values = contact.values
    bears = np.asarray(values.parameters.get("k_n", 1.0)) > 0
    return np.where(bears[..., None], values.normal, 0.0)


def _around(normal: Array) -> list[Array]:
    """Unit vectors around each normal in space, `_CONE_SIDES` of them."""
    least = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    first = np.cross(normal, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normal, first)
    angles = 2 * np.pi * np.arange(_CONE_SIDES) / _CONE_SIDES
    return [np.cos(a) * first + np.sin(a) * second for a in angles]
