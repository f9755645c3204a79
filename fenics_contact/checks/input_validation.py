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
from fenics_contact.contact.contact import Contact
from fenics_contact.parallel import all_finite, gather_rows, global_max, global_min, warn
from fenics_contact.surface.bodies import connected_bodies
from fenics_contact.surface.displacement import Displacement
from fenics_contact.surface.facets import facet_nodes
from fenics_contact.systems.unknowns import Unknowns
from fenics_contact.tolerances import ROUND_OFF
from fenics_contact.types import Array, Mask
from fenics_contact.wording import place_in_words

__all__ = [
    "check_contacts",
    "check_start",
    "check_values",
    "constrained_unknowns",
    "find_displacement",
]


logger = logging.getLogger("fenics_contact")

# Largest round-off of coordinates, relative to the facets of Γc.
_COORDINATE_ROUND_OFF = 2e-7
# How parts of a mixed function are prescribed.
_OF_A_PART = (
    "; for a part of a mixed function use dirichletbc(value, dofs, W.sub(0)), where dofs = "
    "locate_dofs_topological((W.sub(0), V), ...) and V, _ = W.sub(0).collapse()"
)
_OF_U = "; use V = u.function_space, or V.sub(i) for a component: dirichletbc(value, dofs, V)"


def find_displacement(u: fem.Function, contacts: Sequence[Contact]) -> Displacement:
    """That of the contacts, which must be of ``u`` and the same for all. Collective.

    Raises:
        ValueError: It is not.
    """
    if isinstance(u, ufl.Form):
        raise ValueError("u is a Form; the arguments are ContactProblem(F, u): residual, function")
    if isinstance(u, ufl.core.expr.Expr) and not isinstance(u, fem.Function):
        raise ValueError(
            "problem: u is a part of a function or another expression; it must be the function "
            "that is solved for, the w of ufl.split(w)"
        )
    for contact in contacts:
        found, first = contact.displacement, contacts[0].displacement
        if found.whole is not u:
            raise ValueError(f"{contact.name}: its u is not the u of the problem; use the same")
        if not found.same_part(first):
            raise ValueError(
                f"{contact.name}: its u is another part of the mixed function than that of "
                f"{contacts[0].name}; all contacts must have the same displacement"
            )
    if contacts:
        return contacts[0].displacement
    if not isinstance(u, fem.Function):
        return Displacement(u, None, "problem")  # refuses it
    return Displacement.only(u, "problem")


def constrained_unknowns(
    bcs: Sequence[fem.DirichletBC], u: fem.Function, unknowns: Unknowns, *, mixed: bool
) -> Mask:
    """This rank's unknowns with Dirichlet conditions, (n_local,). Collective.

    The displacement may be a part of a mixed function ``u``.

    Raises:
        ValueError: A condition is of another function.
    """
    mask = np.zeros(unknowns.n_local, dtype=np.bool_)
    for number, bc in enumerate(bcs):
        dofs, _ = bc.dof_indices()
        # A scalar space, or a collapsed part, may have as many nodes and other numbers of dofs.
        other = not compat.contains(u.function_space, bc.function_space)
        if unknowns.comm.allreduce(int(other or (dofs.size and dofs.max() >= u.x.array.size))):
            advice = _OF_A_PART if mixed else _OF_U
            raise ValueError(f"a Dirichlet condition is on another function space than u{advice}")
        # Their number of owned dofs, which comes with them, is wrong for blocked conditions.
        mask[dofs[dofs < unknowns.n_dofs]] = True
        if not unknowns.comm.allreduce(dofs.size):
            warn(
                unknowns.comm,
                f"bcs[{number}] has no effect: it has no dof on any rank; check the tag or the "
                "location by which its dofs were found",
            )
    return mask


def check_values(bcs: Sequence[fem.DirichletBC], u: fem.Function) -> None:
    """Refuse prescribed values that are no numbers. Collective.

    Raises:
        ValueError: On all ranks.
    """
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
    """Refuse contacts of one name or one free motion, and Γc where all is prescribed. Collective.

    Raises:
        ValueError: On all ranks.
    """
    names = [c.name for c in contacts]
    if len(set(names)) != len(names):
        raise ValueError(f"contacts are named {names}; names must differ, Contact(name=...)")
    for one, other in combinations(contacts, 2):
        _check_shared(one, other)
    space = displacement.whole.function_space
    held = fem.Function(space)
    n_owned = space.dofmap.index_map.size_local * space.dofmap.index_map_bs
    held.x.array[:n_owned] = constrained[:n_owned]
    held.x.scatter_forward()
    mask = held.x.array if displacement.dofs is None else held.x.array[displacement.dofs]
    for contact in contacts:
        n_held = space.mesh.comm.allreduce(_facets_held(contact, mask))
        if n_held:
            raise ValueError(
                f"{contact.name}: all displacements of {n_held} facets of Γc are prescribed by "
                "Dirichlet conditions, so that contact has no unknowns there; remove these facets "
                "from Γc or from the condition"
            )


def _check_shared(one: Contact, other: Contact) -> None:
    """Refuse one force or moment for the obstacles of two contacts, which move each on its own."""
    moved = one.obstacle.displacement, other.obstacle.displacement
    turned = one.obstacle.rotation, other.obstacle.rotation
    for free, (mine, theirs), what in (
        (bool(one.free_motion), moved, "the same Motion, whose force"),
        (one.free_angle is not None, turned, "the same Rotation, whose moment"),
    ):
        if free and mine is theirs:
            raise ValueError(
                f"{one.name} and {other.name} have {what} would act twice, on two independent "
                "obstacles; for one obstacle use one Contact, on "
                "ContactSurface(mesh, tags, [1, 2]), otherwise give each its own"
            )


def _facets_held(contact: Contact, constrained: Array) -> int:
    """Number of this rank's facets of Γc all of whose displacements are prescribed."""
    space, facets = contact.u.function_space, contact.surface.facets
    held: Mask = np.all(constrained.reshape(-1, space.dofmap.bs), axis=1)
    return int(np.count_nonzero(held[facet_nodes(space, facets)].all(axis=1)))


def check_start(contacts: Sequence[Contact]) -> float:
    """Refuse input out of range; warn of what makes forces wrong without an error. Collective.

    These are bodies in their obstacles, points too few for what is opposite, one obstacle twice.

    Returns:
        Largest penetration of the undeformed body (length), 0 if none; an interference by a
        prescribed gap is none.

    Raises:
        ValueError: On all ranks.
    """
    worst = 0.0
    for contact in contacts:
        comm = contact.surface.mesh.comm
        extent = global_max(comm, np.abs(contact.points))
        smallest = global_min(comm, contact.quadrature.facet_sizes, empty=np.inf)
        if not extent * np.finfo(np.float64).eps <= _COORDINATE_ROUND_OFF * smallest:
            raise ValueError(
                f"{contact.name}: facets of Γc of size {smallest:.3g} have coordinates as large as "
                f"{extent:.3g}, too large for double precision; translate mesh and obstacles to "
                "the origin"
            )
        contact.check_input()
        _refuse_enclosed(contact)
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
    _warn_of_doubles(contacts)
    return worst


def _refuse_enclosed(contact: Contact) -> None:
    """Refuse a rigid obstacle inside of an undeformed body whose Γc all faces away. Collective.

    Raises:
        ValueError: On all ranks.
    """
    if contact.contact_kinematics.sampler is None:
        return
    mesh, values, places = contact.surface.mesh, contact.values, contact.facet_places
    comm, facets = mesh.comm, places.facets
    # Paths are followed from where the obstacle has not been displaced.
    gap, normal = contact.contact_kinematics.sampler.sample(values.x)
    # Points of the obstacle's surface, and by round-off inside of it.
    smallest = global_min(comm, contact.quadrature.facet_sizes, empty=np.inf)
    inside = _COORDINATE_ROUND_OFF * smallest
    away = (values.facing < 0) & (gap > inside)
    if not comm.allreduce(int(away.any())):
        return
    n_bodies, of_node = connected_bodies(facets.space)
    nodes = facets.space.dofmap.list
    body = np.empty(len(values.x), dtype=np.int64)
    body[places.rows] = of_node[nodes[facets.cells, 0]][:, None]
    facing = np.full(n_bodies, -np.inf)
    np.maximum.at(facing, body, values.facing)
    comm.Allreduce(MPI.IN_PLACE, facing, op=MPI.MAX)
    away &= facing[body] < 0
    feet = values.x + (gap + inside)[:, None] * normal
    of_foot, feet = np.concatenate(comm.allgather(body[away])), gather_rows(comm, feet[away])
    points = np.zeros((len(feet), 3))
    points[:, : feet.shape[1]] = feet
    enclosed = []
    if len(points) and len(nodes):
        tree = dolfinx.geometry.bb_tree(mesh, mesh.topology.dim)
        near = dolfinx.geometry.compute_collisions_points(tree, points)
        cells = dolfinx.geometry.compute_colliding_cells(mesh, near, points)
        met = (of_node[nodes[cells.links(k), 0]] for k in range(len(points)))
        enclosed = [k for k, bodies in enumerate(met) if of_foot[k] in bodies]
    first = comm.allreduce(min(enclosed, default=len(feet)), op=MPI.MIN)
    if first < len(feet):
        raise ValueError(
            f"{contact.name}: the obstacle is inside of the undeformed body, as at "
            f"{place_in_words(feet[first])}, and all of the body's Γc faces away from it: "
            "check its place, its units and the direction of its normal"
        )


def _warn_of_few_points(contact: Contact) -> None:
    """Say of how many facets opposite the points of one of Γc are not enough. Collective."""
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


def _warn_of_doubles(contacts: Sequence[Contact]) -> None:
    """Say which two contacts share the force of what is one obstacle. Collective."""
    if len(contacts) < 2:
        return
    comm, pairs = contacts[0].surface.mesh.comm, list(combinations(contacts, 2))
    shared = comm.allreduce(np.array([_n_doubled(*pair) for pair in pairs]))
    for (one, other), n_facets in zip(pairs, shared, strict=True):
        if n_facets:
            warn(
                comm,
                f"{one.name} and {other.name} have the same obstacle at {n_facets} facets of Γc, "
                "where their tractions add up like those of parallel springs; use one Contact, or "
                "remove these facets from one of them, unless both laws are meant to act together",
            )


def _n_doubled(one: Contact, other: Contact) -> int:
    """Facets of this rank where two obstacles of one kind that move as one are at one place."""
    mine, theirs = one.obstacle, other.obstacle
    if one.free_motion or other.free_motion:  # each moves by its own force
        return 0
    moved = mine.displacement is theirs.displacement or mine.displacement == theirs.displacement
    if type(mine) is not type(theirs) or mine.rotation is not theirs.rotation or not np.all(moved):
        return 0
    _, *shared = np.intersect1d(one.surface.facets, other.surface.facets, return_indices=True)
    places, facing = [], np.ones(len(shared[0]), dtype=np.bool_)
    for contact, rows in zip((one, other), shared, strict=True):
        points, values = contact.quadrature.point_rows[rows], contact.values
        # Means, as rules may differ, and the order of points on a facet does.
        gap = contact.contact_kinematics.undeformed_gap(values)
        places.append([a[points].mean(axis=1) for a in (gap, values.normal)])
        facing &= np.all(values.paired[points], axis=1)
    gaps, normals = (np.abs(a - b) for a, b in zip(*places, strict=True))
    extent = np.abs(one.points).max(initial=0.0)
    same = (gaps <= ROUND_OFF * extent) & np.all(normals <= ROUND_OFF, axis=1)
    return int(np.count_nonzero(same & facing))
