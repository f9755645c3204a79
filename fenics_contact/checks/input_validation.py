"""Validation of displacement, Dirichlet conditions and contacts of a problem."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from itertools import combinations

import dolfinx
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

from fenics_contact import compat
from fenics_contact.arguments import is_number
from fenics_contact.contact.contact import Contact
from fenics_contact.parallel import all_finite, gather_rows, global_max, global_min, warn
from fenics_contact.surface.bodies import connected_bodies
from fenics_contact.surface.displacement import Displacement
from fenics_contact.surface.facets import facet_nodes
from fenics_contact.systems.unknowns import Unknowns
from fenics_contact.tolerances import ROUND_OFF
from fenics_contact.types import Array, Mask
from fenics_contact.wording import format_point

__all__ = [
    "check_contacts",
    "check_prescribed_values",
    "check_tolerance",
    "check_undeformed_geometry",
    "find_constrained_unknowns",
    "find_displacement",
]


logger = logging.getLogger("fenics_contact")

# Largest round-off of coordinates, relative to the smallest facet of Γc.
_MAX_COORDINATE_ROUND_OFF_RATIO = 2e-7
_ADVICE_FOR_MIXED_FUNCTION = (
    "; for a part of a mixed function use dirichletbc(value, dofs, W.sub(0)), where dofs = "
    "locate_dofs_topological((W.sub(0), V), ...) and V, _ = W.sub(0).collapse()"
)
_ADVICE_FOR_DISPLACEMENT = (
    "; use V = u.function_space, or V.sub(i) for a component: dirichletbc(value, dofs, V)"
)


def check_tolerance(tolerance: float) -> float:
    """Return the small-displacement tolerance, or raise a ValueError if it is not positive."""
    if not (is_number(tolerance) and tolerance > 0):
        raise ValueError(
            f"small_displacement_tolerance is {tolerance!r}; it must be a positive relative "
            "error, such as 0.2, or infinity to accept every increment"
        )
    return tolerance


def find_displacement(u: fem.Function, contacts: Sequence[Contact]) -> Displacement:
    """Return the displacement of the contacts. Collective.

    Raises:
        ValueError: The contacts differ in their displacements, or have another function than ``u``.
    """
    if isinstance(u, ufl.Form):
        raise ValueError("u is a Form; the arguments are ContactProblem(F, u): residual, function")
    if isinstance(u, ufl.core.expr.Expr) and not isinstance(u, fem.Function):
        raise ValueError(
            "problem: u is a part of a function or another expression; it must be the function "
            "that is solved for, the w of ufl.split(w)"
        )
    for contact in contacts:
        displacement, first = contact.displacement, contacts[0].displacement
        if displacement.whole is not u:
            raise ValueError(f"{contact.name}: its u is not the u of the problem; use the same")
        if not displacement.is_same_part(first):
            raise ValueError(
                f"{contact.name}: its u is another part of the mixed function than that of "
                f"{contacts[0].name}; all contacts must have the same displacement"
            )
    if contacts:
        return contacts[0].displacement
    if not isinstance(u, fem.Function):
        return Displacement(u, None, "problem")  # raises the error
    return Displacement.only(u, "problem")


def find_constrained_unknowns(
    bcs: Sequence[fem.DirichletBC], u: fem.Function, unknowns: Unknowns, *, mixed: bool
) -> Mask:
    """Return this rank's mask of unknowns with Dirichlet conditions, (n_local,). Collective.

    Raises:
        ValueError: A condition is on another function space.
    """
    mask = np.zeros(unknowns.n_local, dtype=np.bool_)
    for number, bc in enumerate(bcs):
        dofs, _ = bc.dof_indices()
        other_space = not compat.contains(u.function_space, bc.function_space)
        if unknowns.comm.allreduce(
            int(other_space or (dofs.size and dofs.max() >= u.x.array.size))
        ):
            advice = _ADVICE_FOR_MIXED_FUNCTION if mixed else _ADVICE_FOR_DISPLACEMENT
            raise ValueError(f"a Dirichlet condition is on another function space than u{advice}")
        # DOLFINx's number of owned dofs is wrong for blocked conditions.
        mask[dofs[dofs < unknowns.n_dofs]] = True
        if not unknowns.comm.allreduce(dofs.size):
            warn(
                unknowns.comm,
                f"bcs[{number}] has no effect: it has no dof on any rank; check the tag or the "
                "location by which its dofs were found",
            )
    return mask


def check_prescribed_values(bcs: Sequence[fem.DirichletBC], u: fem.Function) -> None:
    """Raise a ValueError on all ranks if a prescribed value is not finite. Collective."""
    comm, values = u.function_space.mesh.comm, np.zeros_like(u.x.array)
    for number, bc in enumerate(bcs):
        bc.set(values)
        if not all_finite(comm, values[bc.dof_indices()[0]]):
            raise ValueError(
                f"the Dirichlet condition bcs[{number}] has values that are not finite (NaN or inf)"
            )


def check_contacts(
    contacts: Sequence[Contact], displacement: Displacement, constrained: Mask
) -> None:
    """Check names, motions and free dofs of the contacts. Collective.

    Raises:
        ValueError: On all ranks, for equal names or motions, or a fully prescribed facet of Γc.
    """
    names = [c.name for c in contacts]
    if len(set(names)) != len(names):
        raise ValueError(f"contacts are named {names}; names must differ, Contact(name=...)")
    for one, other in combinations(contacts, 2):
        _check_shared(one, other)
    space = displacement.whole.function_space
    prescribed = fem.Function(space)
    n_owned = space.dofmap.index_map.size_local * space.dofmap.index_map_bs
    prescribed.x.array[:n_owned] = constrained[:n_owned]
    prescribed.x.scatter_forward()
    values = prescribed.x.array
    mask = values if displacement.dofs is None else values[displacement.dofs]
    for contact in contacts:
        n_facets = space.mesh.comm.allreduce(_count_constrained_facets(contact, mask))
        if n_facets:
            raise ValueError(
                f"{contact.name}: all displacements of {n_facets} facets of Γc are prescribed by "
                "Dirichlet conditions, so that contact has no unknowns there; remove these facets "
                "from Γc or from the condition"
            )


def _check_shared(one: Contact, other: Contact) -> None:
    """Raise a ValueError if two contacts share the force or moment on their obstacles."""
    displacements = one.obstacle.displacement, other.obstacle.displacement
    rotations = one.obstacle.rotation, other.obstacle.rotation
    for is_free, (first, second), load in (
        (bool(one.free_motion), displacements, "the same Motion, whose force"),
        (one.free_angle is not None, rotations, "the same Rotation, whose moment"),
    ):
        if is_free and first is second:
            raise ValueError(
                f"{one.name} and {other.name} have {load} would act twice, on two independent "
                "obstacles; for one obstacle use one Contact, on "
                "ContactSurface(mesh, tags, [1, 2]), otherwise give each its own"
            )


def _count_constrained_facets(contact: Contact, constrained: Array) -> int:
    """Return the number of this rank's facets of Γc with all displacements prescribed."""
    space, facets = contact.u.function_space, contact.surface.facets
    nodes: Mask = np.all(constrained.reshape(-1, space.dofmap.bs), axis=1)
    return int(np.count_nonzero(nodes[facet_nodes(space, facets)].all(axis=1)))


def check_undeformed_geometry(contacts: Sequence[Contact]) -> float:
    """Check the undeformed geometry and the input of the contacts. Collective.

    Warns of penetration, of too few quadrature points, and of obstacles of two contacts.

    Returns:
        Largest penetration of the undeformed body (length), without a prescribed interference.

    Raises:
        ValueError: Input out of range, or an obstacle inside of the body; on all ranks.
    """
    worst = 0.0
    for contact in contacts:
        comm = contact.surface.mesh.comm
        extent = global_max(comm, np.abs(contact.points))
        smallest = global_min(comm, contact.quadrature.facet_sizes, empty=np.inf)
        if not extent * np.finfo(np.float64).eps <= _MAX_COORDINATE_ROUND_OFF_RATIO * smallest:
            raise ValueError(
                f"{contact.name}: facets of Γc of size {smallest:.3g} have coordinates as large as "
                f"{extent:.3g}, too large for double precision; translate mesh and obstacles to "
                "the origin"
            )
        contact.check_input()
        _check_obstacle_outside(contact)
        contact.inputs.check_side(contact.values, gap_prescribed=contact.gap_prescribed)
        gap = global_min(comm, contact.contact_kinematics.undeformed_gap(contact.values))
        if gap < -ROUND_OFF * extent and not contact.gap_prescribed:
            worst = max(worst, -gap)
            if comm.rank == 0:
                logger.warning(
                    "%s: the undeformed body penetrates its obstacle by up to %g; prescribe an "
                    "intended interference by Contact(gap=...), else correct the geometry",
                    contact.name,
                    -gap,
                )
        _warn_of_few_points(contact)
    _warn_of_shared_obstacles(contacts)
    return worst


def _check_obstacle_outside(contact: Contact) -> None:
    """Raise a ValueError if an obstacle is inside of a body whose Γc faces away. Collective."""
    if contact.contact_kinematics.sampler is None:
        return
    mesh, values, places = contact.surface.mesh, contact.values, contact.facet_sampling
    comm, facets = mesh.comm, places.facets

    gap, normal = contact.contact_kinematics.sampler.sample(values.x)
    smallest = global_min(comm, contact.quadrature.facet_sizes, empty=np.inf)
    tolerance = _MAX_COORDINATE_ROUND_OFF_RATIO * smallest
    away = (values.facing < 0) & (gap > tolerance)
    if not comm.allreduce(int(away.any())):
        return
    n_bodies, body_of_node = connected_bodies(facets.space)
    nodes = facets.space.dofmap.list
    body = np.empty(len(values.x), dtype=np.int64)
    body[places.rows] = body_of_node[nodes[facets.cells, 0]][:, None]
    facing = np.full(n_bodies, -np.inf)
    np.maximum.at(facing, body, values.facing)
    comm.Allreduce(MPI.IN_PLACE, facing, op=MPI.MAX)
    away &= facing[body] < 0
    # Closest points of the obstacle, moved into it by the round-off.
    closest = values.x + (gap + tolerance)[:, None] * normal
    bodies, closest = np.concatenate(comm.allgather(body[away])), gather_rows(comm, closest[away])
    points = np.zeros((len(closest), 3))
    points[:, : closest.shape[1]] = closest
    enclosed = []
    if len(points) and len(nodes):
        tree = dolfinx.geometry.bb_tree(mesh, mesh.topology.dim)
        candidates = dolfinx.geometry.compute_collisions_points(tree, points)
        cells = dolfinx.geometry.compute_colliding_cells(mesh, candidates, points)
        around = (body_of_node[nodes[cells.links(k), 0]] for k in range(len(points)))
        enclosed = [k for k, colliding in enumerate(around) if bodies[k] in colliding]
    first = comm.allreduce(min(enclosed, default=len(closest)), op=MPI.MIN)
    if first < len(closest):
        raise ValueError(
            f"{contact.name}: the obstacle is inside of the undeformed body, as at "
            f"{format_point(closest[first])}, and all of the body's Γc faces away from it: "
            "check its position, its units and the direction of its normal"
        )


def _warn_of_few_points(contact: Contact) -> None:
    """Warn if the quadrature does not resolve the opposing facets or the element. Collective."""
    sparse = contact.quadrature.sparse
    if sparse is not None:
        warn(
            contact.surface.mesh.comm,
            f"{contact.name}: facets of Γc are {sparse.times} times as long as the opposite ones, "
            "which its quadrature points do not resolve: the force will be too small (between "
            "blocks by 1 to 26 %, most where few facets of Γc are loaded). Swap the surfaces, so "
            "that the finer one is Γc, or use "
            f"ContactSurface(quadrature_degree={sparse.degree})",
        )
    degree = contact.displacement.degree
    if contact.quadrature.at_vertices and degree > 1:
        warn(
            contact.surface.mesh.comm,
            f"{contact.name}: vertex quadrature has no points at the other nodes of elements of "
            f"degree {degree}, which penetrate freely: contact is too soft (a block with one and "
            "with two facets by 48 and by 24 %). Use elements of degree 1 or, without "
            "NodalSprings, the default quadrature_scheme",
        )


def _warn_of_shared_obstacles(contacts: Sequence[Contact]) -> None:
    """Warn of pairs of contacts with the same obstacle on the same facets. Collective."""
    if len(contacts) < 2:
        return
    comm, pairs = contacts[0].surface.mesh.comm, list(combinations(contacts, 2))
    counts = comm.allreduce(np.array([_count_shared_facets(*pair) for pair in pairs]))
    for (one, other), n_facets in zip(pairs, counts, strict=True):
        if n_facets:
            warn(
                comm,
                f"{one.name} and {other.name} have the same obstacle at {n_facets} facets of Γc, "
                "where their tractions add up like those of parallel springs; use one Contact, or "
                "remove these facets from one of them, unless both laws are meant to act together",
            )


def _count_shared_facets(one: Contact, other: Contact) -> int:
    """Return the number of this rank's facets on which two contacts have the same obstacle."""
    first, second = one.obstacle, other.obstacle
    if one.free_motion or other.free_motion:  # two independent obstacles
        return 0
    same = first.displacement is second.displacement or first.displacement == second.displacement
    if type(first) is not type(second) or first.rotation is not second.rotation or not np.all(same):
        return 0
    _, *shared = np.intersect1d(one.surface.facets, other.surface.facets, return_indices=True)
    geometry, facing = [], np.ones(len(shared[0]), dtype=np.bool_)
    for contact, rows in zip((one, other), shared, strict=True):
        points, values = contact.quadrature.point_rows[rows], contact.values
        # Means over the facet: quadrature rules and orders of the points differ.
        gap = contact.contact_kinematics.undeformed_gap(values)
        geometry.append([a[points].mean(axis=1) for a in (gap, values.normal)])
        facing &= np.all(values.paired[points], axis=1)
    gaps, normals = (np.abs(a - b) for a, b in zip(*geometry, strict=True))
    extent = np.abs(one.points).max(initial=0.0)
    coincide = (gaps <= ROUND_OFF * extent) & np.all(normals <= ROUND_OFF, axis=1)
    return int(np.count_nonzero(coincide & facing))
