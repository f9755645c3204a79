"""General contact: search for all pairs of bodies that may come into contact."""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Sequence
from typing import Any, TypeAlias

import dolfinx
import numpy as np
import ufl
from dolfinx import fem

from fenics_contact.arguments import check_bool, check_instance, check_positive
from fenics_contact.contact.contact import Contact
from fenics_contact.joining import JoinedMesh
from fenics_contact.laws.base import Law
from fenics_contact.obstacles.deformable import DeformableBody
from fenics_contact.parallel import broadcast_from_root, collective_errors, warn
from fenics_contact.surface.bodies import connected_bodies
from fenics_contact.surface.displacement import Displacement
from fenics_contact.surface.facets import facet_cells
from fenics_contact.surface.proximity import Neighbours, find_neighbours
from fenics_contact.surface.surface import ContactSurface, tagged_facets
from fenics_contact.types import Index

__all__ = ["find_contact_pairs"]

logger = logging.getLogger("fenics_contact")

LawOf: TypeAlias = Law | Callable[[Hashable, Hashable], Law]

# Relative difference of mean facet sizes below which two meshes are equally fine.
_EQUAL_SIZE_RATIO = 0.01


def find_contact_pairs(
    u: fem.Function | ufl.core.expr.Expr,
    law: LawOf,
    distance: float,
    *,
    bodies: JoinedMesh | dolfinx.mesh.MeshTags | None = None,
    facet_tags: dolfinx.mesh.MeshTags | None = None,
    tags: int | Sequence[int] | None = None,
    slave_bodies: Sequence[Hashable] = (),
    self_contact: bool = False,
    update_pairs: str = "auto",
    max_initial_penetration: float | None = None,
    **options: Any,
) -> list[Contact]:
    """Find all pairs of bodies that may come into contact, and create their contacts. Collective.

    Facets of two bodies may come into contact if their normals face each other and they are within
    ``distance`` of each other, in any direction, in the undeformed bodies: give the initial gap
    plus the distance of sliding. The result is logged (logger ``fenics_contact``, level INFO, first
    rank).

    Γc is the side with the smaller mean facet size; if sizes differ by less than 1 %, the side
    with fewer facets; otherwise that of the first body. Stiffness is not considered: use
    ``slave_bodies`` to place Γc on the softer body.

    The search is made once, in the undeformed bodies. Bodies with an initial overlap of more than
    half the height of their cells are not found. `ContactProblem` refuses facets whose
    displacements are all prescribed: exclude them by ``facet_tags`` and ``tags``. A facet near
    several bodies belongs to several contacts; each of its points is in contact with one body at a
    time, and open in the other contacts.

    Args:
        u: Displacement, as for `Contact`.
        law: The law of all contacts, or a function that returns the law for the names of two
            bodies.
        distance: Largest distance of facets (length), > 0.
        bodies: The bodies: a `JoinedMesh`, or tags of all cells, one per body; by default the
            connected parts of the mesh, named 1, 2, … in the order of their smallest x.
        facet_tags: Together with ``tags``, the facets that may come into contact; by default the
            whole boundary.
        tags: Tag or tags of these facets.
        slave_bodies: Names of bodies on which Γc is placed, in order of precedence.
        self_contact: Whether a body may touch itself, too. Its facets are divided into two sides
            that face each other. If that is impossible, as in a closing hole, all of them are both
            Γc and opposite, and every contact is carried by two pairs.
        update_pairs: When pairs are updated, as for `DeformableBody`.
        max_initial_penetration: Largest initial penetration, as for `DeformableBody` (length).
        **options: Keyword arguments of every `Contact`, such as ``kinematics``.

    Returns:
        The contacts in the order of the bodies, named such as "1-2". If there are none, a warning
        is given.

    Raises:
        ValueError: An argument is invalid, a cell has no tag, or facets are not on the boundary.
    """
    _check(law, distance, bodies, facet_tags, tags, self_contact, options)
    space = Displacement(u, None, "find_contact_pairs").u.function_space
    mesh, comm = space.mesh, space.mesh.comm
    names, body_of_cell = _bodies(space, bodies)
    if isinstance(slave_bodies, str) or not isinstance(slave_bodies, Sequence):
        raise ValueError(
            f"slave_bodies is {slave_bodies!r}; it must be a list of bodies, of {names!r}"
        )
    unknown = [body for body in slave_bodies if body not in names]
    if unknown:
        raise ValueError(f"slave_bodies names {unknown!r}; the bodies are {names!r}")
    if facet_tags is None or tags is None:
        facets = _boundary(mesh)
    else:
        facets = tagged_facets(mesh, facet_tags, tags)
    label = body_of_cell[facet_cells(mesh, facets)]
    pairs = find_neighbours(space, facets, label, distance, self_contact=self_contact)
    if not pairs:
        warn(
            comm,
            f"find_contact_pairs: no two of the bodies {names} are within {distance:g}. Check the "
            "distance; bodies that overlap by more than half a cell are not found",
        )

    sides = [
        broadcast_from_root(comm, _side_of_surface(pair, names, slave_bodies)) for pair in pairs
    ]
    sets = [pair.facets[side] for pair, side in zip(pairs, sides, strict=True)]
    sets += [pair.facets[1 - side] for pair, side in zip(pairs, sides, strict=True)]
    pair_tags, tags_of = _tag_facets(mesh, sets)
    contacts = []
    for i, (pair, side) in enumerate(zip(pairs, sides, strict=True)):
        a, b = (names[number] for number in pair.bodies)
        if comm.rank == 0:
            logger.info("%s", _log_message(f"{a}-{b}", (a, b), pair, side))
        pair_law = law if isinstance(law, Law) else law(a, b)
        surface = ContactSurface(mesh, pair_tags, tags_of[i])
        obstacle = DeformableBody(
            pair_tags,
            tags_of[len(pairs) + i],
            update_pairs=update_pairs,
            max_initial_penetration=max_initial_penetration,
        )
        contacts.append(Contact(u, surface, obstacle, pair_law, name=f"{a}-{b}", **options))
    return contacts


def _check(
    law: object,
    distance: Any,
    bodies: Any,
    facet_tags: Any,
    tags: Any,
    self_contact: Any,
    options: dict[str, Any],
) -> None:
    """Check the arguments."""
    if not callable(law) or isinstance(law, type):
        check_instance("law", law, Law, "or a function of the names of two bodies")
    check_positive("distance", distance, "a length greater than zero")
    if bodies is not None and not isinstance(bodies, JoinedMesh | dolfinx.mesh.MeshTags):
        raise ValueError(
            f"bodies is a {type(bodies).__name__}; it must be a JoinedMesh, tags of all cells, or "
            "None for the connected parts of the mesh"
        )
    if (facet_tags is None) != (tags is None):
        raise ValueError("facet_tags and tags belong together; give both, or neither")
    check_bool("self_contact", self_contact)
    conflicting = [name for name in ("surface", "obstacle", "opposite") if name in options]
    if conflicting:
        raise ValueError(
            f"{' and '.join(conflicting)} given; find_contact_pairs finds both sides of every "
            "contact: omit it, or create a Contact with these sides"
        )
    if "name" in options:
        raise ValueError("name is given; contacts are named after their bodies: omit it")


def _bodies(
    space: fem.FunctionSpace, bodies: JoinedMesh | dolfinx.mesh.MeshTags | None
) -> tuple[list[Hashable], Index]:
    """Return the names of the bodies, and the number of the body of every cell. Collective.

    Raises:
        ValueError: The bodies are of another mesh, or do not cover this one.
    """
    mesh = space.mesh
    comm, d = mesh.comm, mesh.topology.dim
    cells = mesh.topology.index_map(d)
    n = cells.size_local + cells.num_ghosts
    if bodies is None:
        n_bodies, body_of_node = connected_bodies(space)
        return list(range(1, n_bodies + 1)), body_of_node[space.dofmap.list[:n, 0]]
    if isinstance(bodies, JoinedMesh):
        if bodies.mesh is not mesh:
            raise ValueError("bodies are joined in another mesh than that of u; use bodies.mesh")
        number = np.zeros(n, dtype=np.int64)
        for i, body in enumerate(bodies.bodies):
            number[np.isin(bodies.cells.values, bodies.body(body))] = i
        return list(bodies.bodies), number
    if bodies.dim != d:
        raise ValueError(
            f"bodies are tags on entities of dimension {bodies.dim}; give tags of the cells, which "
            f"have dimension {d}"
        )
    known = sorted(set().union(*comm.allgather(np.unique(bodies.values).tolist())))
    number = np.full(n, -1, dtype=np.int64)
    with collective_errors(comm):
        if bodies.indices.max(initial=-1) >= n:
            raise ValueError(
                f"bodies has a tag on cell {bodies.indices.max()}, and the mesh of u has {n} on "
                "this rank; give tags of its cells"
            )
    number[bodies.indices] = np.searchsorted(known, bodies.values)
    n_without = comm.allreduce(int(np.count_nonzero(number[: cells.size_local] < 0)))
    if n_without:
        raise ValueError(
            f"{n_without} cells have no tag in bodies; every cell must have the tag of its body"
        )
    return list(known), number


def _boundary(mesh: dolfinx.mesh.Mesh) -> Index:
    """Return the owned facets of the boundary, ascending. Collective."""
    d = mesh.topology.dim
    mesh.topology.create_connectivity(d - 1, d)
    exterior = np.sort(dolfinx.mesh.exterior_facet_indices(mesh.topology))
    return exterior[exterior < mesh.topology.index_map(d - 1).size_local]


def _side_of_surface(
    pair: Neighbours, names: Sequence[Hashable], slave_bodies: Sequence[Hashable]
) -> int:
    """Return the side on which Γc is placed, see `find_contact_pairs`."""
    ranks = [list(slave_bodies).index(names[i]) for i in pair.bodies if names[i] in slave_bodies]
    if ranks:
        return [names[i] for i in pair.bodies].index(slave_bodies[min(ranks)])
    first, second = pair.sizes
    if abs(first - second) > _EQUAL_SIZE_RATIO * max(first, second):
        return int(second < first)
    return int(pair.counts[1] < pair.counts[0])


def _tag_facets(
    mesh: dolfinx.mesh.Mesh, sets: Sequence[Index]
) -> tuple[dolfinx.mesh.MeshTags, list[list[int]]]:
    """Return one set of facet tags for all contacts, and the tags of each facet set. Collective.

    Forms of several contacts can be added only if they have the same tags.
    """
    facets = np.unique(np.concatenate([np.zeros(0, dtype=np.int32), *sets]))
    is_member = np.zeros((len(facets), len(sets)), dtype=np.bool_)
    for i, facet_set in enumerate(sets):
        is_member[:, i] = np.isin(facets, facet_set)
    known = sorted(set().union(*mesh.comm.allgather({tuple(row) for row in is_member.tolist()})))
    number = {row: tag for tag, row in enumerate(known, 1)}
    values = np.array([number[tuple(row)] for row in is_member.tolist()], dtype=np.int32)
    pair_tags = dolfinx.mesh.meshtags(mesh, mesh.topology.dim - 1, facets.astype(np.int32), values)
    return pair_tags, [[number[row] for row in known if row[i]] for i in range(len(sets))]


def _log_message(name: str, bodies: tuple[Hashable, Hashable], pair: Neighbours, side: int) -> str:
    """Return the log line of a contact."""
    note = "" if pair.separate else "; all facets are on both sides"
    return (
        f"{name}: Γc on {bodies[side]} with {pair.counts[side]} facets of mean size "
        f"{pair.sizes[side]:.3g}, opposite on {bodies[1 - side]} with {pair.counts[1 - side]} of "
        f"{pair.sizes[1 - side]:.3g}; {pair.least:.3g} to {pair.largest:.3g} apart{note}"
    )
