"""General contact: all contacts between bodies that may touch, found by their distance."""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Sequence
from typing import Any, TypeAlias

import dolfinx
import numpy as np
import ufl
from dolfinx import fem

from fenics_contact.arguments import check_instance, is_number
from fenics_contact.contact.contact import Contact
from fenics_contact.joining import JoinedMesh
from fenics_contact.laws.base import Law
from fenics_contact.obstacles.deformable import DeformableBody
from fenics_contact.parallel import agreed, collective_errors, warn
from fenics_contact.surface.bodies import connected_bodies
from fenics_contact.surface.displacement import Displacement
from fenics_contact.surface.facets import facet_cells
from fenics_contact.surface.proximity import Neighbours, find_neighbours
from fenics_contact.surface.surface import ContactSurface, tagged_facets
from fenics_contact.types import Index

__all__ = ["find_contact_pairs"]

logger = logging.getLogger("fenics_contact")

LawOf: TypeAlias = Law | Callable[[Hashable, Hashable], Law]

# Meshes whose facets differ in size by less are equally fine.
_AS_FINE = 0.01


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
    """Find which bodies of a mesh may touch, and make a contact of each two. Collective.

    Facets of two bodies may touch if their normals face each other and they come within
    ``distance``, in whatever direction, of each other in the undeformed bodies: give what is open
    between bodies that are to meet, and add the way that they slide. What is found is logged
    (``fenics_contact``, level INFO, first rank).

    Γc is the side whose facets are smaller on the mean; of sides as fine (to 1 %) that with fewer
    facets, of which no point looks past the other; or else that of the first body. A stiffness
    cannot be known here: where the softer body is to have Γc, say so by ``slave_bodies``.

    Bodies are looked at once, undeformed; where they overlap from the start by more than half the
    height of their cells no contact is found. Facets all of whose displacements are prescribed can
    have no contact, and `ContactProblem` refuses them: leave them out by ``facet_tags`` and
    ``tags``.

    A facet that is near several bodies is part of several contacts: each of its points meets one
    body at a time, and is open in the other contacts.

    Args:
        u: Displacement, as `Contact` takes it.
        law: The reactions, of all contacts; or a function of the names of two bodies that gives
            theirs.
        distance: How near facets must come to count (length), greater than zero.
        bodies: What the bodies are: joined meshes, or tags of all cells, a body each; by default
            the connected parts of the mesh, which are called 1, 2, … by their places, lowest x
            first.
        facet_tags: With ``tags``: only facets with these tags may touch; by default all of the
            boundary.
        tags: The tag, or tags, meant.
        slave_bodies: Names of bodies that are to have Γc, the first before the others.
        self_contact: Whether a body may touch itself, too. Its facets are divided into two sides
            that face each other. Where that cannot be, as in a hole that closes, all of them are
            Γc and all opposite: every two places are then two pairs, which share what they bear.
        update_pairs: Of the `DeformableBody` opposite.
        max_initial_penetration: Of the `DeformableBody` opposite.
        **options: For every `Contact`, such as ``kinematics`` and ``enforcement``.

    Returns:
        The contacts in the order of the bodies, named by them, such as "1-2": empty if none are so
        near, which gives a warning.

    Raises:
        ValueError: An argument is none of these, a cell has no tag, or facets are no part of the
            boundary; and what `Contact` refuses.
    """
    _check(law, distance, bodies, facet_tags, tags, self_contact, options)
    space = Displacement(u, None, "find_contact_pairs").u.function_space
    mesh, comm = space.mesh, space.mesh.comm
    names, of_cell = _bodies(space, bodies)
    if isinstance(slave_bodies, str) or not isinstance(slave_bodies, Sequence):
        raise ValueError(
            f"slave_bodies is {slave_bodies!r}; give a list of names of bodies, which are {names!r}"
        )
    unknown = [body for body in slave_bodies if body not in names]
    if unknown:
        raise ValueError(f"slave_bodies names {unknown!r}; the bodies are {names!r}")
    if facet_tags is None or tags is None:
        facets = _boundary(mesh)
    else:
        facets = tagged_facets(mesh, facet_tags, tags)
    label = of_cell[facet_cells(mesh, facets)]
    found = find_neighbours(space, facets, label, distance, self_contact=self_contact)
    if not found:
        warn(
            comm,
            f"find_contact_pairs: no two of the bodies {names} are within {distance:g}. Check the "
            "distance; bodies that overlap by more than half a cell are not found either",
        )

    on = [agreed(comm, _side_of_surface(pair, names, slave_bodies)) for pair in found]
    roles = [pair.facets[side] for pair, side in zip(found, on, strict=True)]
    roles += [pair.facets[1 - side] for pair, side in zip(found, on, strict=True)]
    marks, tags_of = _marked(mesh, roles)
    contacts = []
    for i, (pair, side) in enumerate(zip(found, on, strict=True)):
        a, b = (names[number] for number in pair.bodies)
        if comm.rank == 0:
            logger.info("%s", _told(f"{a}-{b}", (a, b), pair, side))
        chosen = law if isinstance(law, Law) else law(a, b)
        surface = ContactSurface(mesh, marks, tags_of[i])
        obstacle = DeformableBody(
            marks,
            tags_of[len(found) + i],
            update_pairs=update_pairs,
            max_initial_penetration=max_initial_penetration,
        )
        contacts.append(Contact(u, surface, obstacle, chosen, name=f"{a}-{b}", **options))
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
    """Refuse what has no sense."""
    if not callable(law) or isinstance(law, type):
        check_instance("law", law, Law, "or a function of the names of two bodies")
    if not (is_number(distance) and 0.0 < distance < np.inf):
        raise ValueError(f"distance is {distance!r}; it must be a length greater than zero")
    if bodies is not None and not isinstance(bodies, JoinedMesh | dolfinx.mesh.MeshTags):
        raise ValueError(
            f"bodies is a {type(bodies).__name__}; give what join_meshes returned, tags of all "
            "cells, or nothing for the connected parts of the mesh"
        )
    if (facet_tags is None) != (tags is None):
        raise ValueError("facet_tags and tags belong together; give both, or none for all facets")
    if not isinstance(self_contact, bool | np.bool_):
        raise ValueError(
            f"self_contact is {self_contact!r}; give True where a body may touch itself, else False"
        )
    own = [name for name in ("surface", "obstacle", "opposite") if name in options]
    if own:
        raise ValueError(
            f"{' and '.join(own)} given; find_contact_pairs finds both sides of every "
            "contact: leave it out, or make a Contact of these sides"
        )
    if "name" in options:
        raise ValueError("name is given; contacts have the names of their bodies: leave it out")


def _bodies(
    space: fem.FunctionSpace, bodies: JoinedMesh | dolfinx.mesh.MeshTags | None
) -> tuple[list[Hashable], Index]:
    """Names of the bodies, and the number of that of every cell of this rank. Collective.

    Raises:
        ValueError: They are of another mesh, or do not cover this one.
    """
    mesh = space.mesh
    comm, d = mesh.comm, mesh.topology.dim
    cells = mesh.topology.index_map(d)
    n = cells.size_local + cells.num_ghosts
    if bodies is None:
        n_bodies, of_node = connected_bodies(space)
        return list(range(1, n_bodies + 1)), of_node[space.dofmap.list[:n, 0]]
    if isinstance(bodies, JoinedMesh):
        if bodies.mesh is not mesh:
            raise ValueError("bodies are joined in another mesh than that of u; make u on theirs")
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
            f"{n_without} cells have no tag in bodies; tag all of them, by the body they are of"
        )
    return list(known), number


def _boundary(mesh: dolfinx.mesh.Mesh) -> Index:
    """Owned facets of the boundary, ascending. Collective."""
    d = mesh.topology.dim
    mesh.topology.create_connectivity(d - 1, d)
    exterior = np.sort(dolfinx.mesh.exterior_facet_indices(mesh.topology))
    return exterior[exterior < mesh.topology.index_map(d - 1).size_local]


def _side_of_surface(
    pair: Neighbours, names: Sequence[Hashable], slave_bodies: Sequence[Hashable]
) -> int:
    """Which of the two sides is Γc, see `find_contact_pairs`."""
    wanted = [list(slave_bodies).index(names[i]) for i in pair.bodies if names[i] in slave_bodies]
    if wanted:
        return [names[i] for i in pair.bodies].index(slave_bodies[min(wanted)])
    one, other = pair.sizes
    if abs(one - other) > _AS_FINE * max(one, other):
        return int(other < one)
    return int(pair.counts[1] < pair.counts[0])


def _marked(
    mesh: dolfinx.mesh.Mesh, roles: Sequence[Index]
) -> tuple[dolfinx.mesh.MeshTags, list[list[int]]]:
    """One tag for the facets of each set of roles, and the tags of every role. Collective.

    One set of tags for all contacts, so that their forms can be added.
    """
    facets = np.unique(np.concatenate([np.zeros(0, dtype=np.int32), *roles]))
    has = np.zeros((len(facets), len(roles)), dtype=np.bool_)
    for i, role in enumerate(roles):
        has[:, i] = np.isin(facets, role)
    known = sorted(set().union(*mesh.comm.allgather({tuple(row) for row in has.tolist()})))
    number = {row: tag for tag, row in enumerate(known, 1)}
    values = np.array([number[tuple(row)] for row in has.tolist()], dtype=np.int32)
    marks = dolfinx.mesh.meshtags(mesh, mesh.topology.dim - 1, facets.astype(np.int32), values)
    return marks, [[number[row] for row in known if row[i]] for i in range(len(roles))]


def _told(name: str, bodies: tuple[Hashable, Hashable], pair: Neighbours, side: int) -> str:
    """A line for the log."""
    both = "" if pair.separate else "; all of them are on both sides"
    return (
        f"{name}: Γc on {bodies[side]} with {pair.counts[side]} facets of mean size "
        f"{pair.sizes[side]:.3g}, opposite on {bodies[1 - side]} with {pair.counts[1 - side]} of "
        f"{pair.sizes[1 - side]:.3g}; {pair.least:.3g} to {pair.largest:.3g} apart{both}"
    )
