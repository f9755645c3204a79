"""Joining of meshes of several bodies into one mesh, with new cell and facet tags."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import basix
import dolfinx
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem, la
from mpi4py import MPI

from fenics_contact import compat
from fenics_contact.arguments import check_cells, check_instance, is_number
from fenics_contact.parallel import collective_errors
from fenics_contact.types import Array, Index

__all__ = ["JoinedMesh", "exchange_rows", "join_meshes", "tag_facets"]

Part: TypeAlias = dolfinx.mesh.Mesh | Sequence[Any]
TagNumbers: TypeAlias = Mapping[Hashable, Mapping[int | None, int]]


@dataclass(frozen=True)
class JoinedMesh:
    """A mesh of several bodies that share no nodes, with new tags.

    Tags are numbered from 1, body by body, in ascending order of the old tags, so that no two
    bodies share a tag.

    Attributes:
        mesh: The mesh of all bodies.
        cells: Tags of all cells of this rank, including ghosts.
        facets: Tags of the facets that had a tag.
        bodies: Names of the bodies.
        cell_numbers: New cell tags by body and old tag; key None for cells without a tag.
        facet_numbers: New facet tags by body and old tag.
    """

    mesh: dolfinx.mesh.Mesh
    cells: dolfinx.mesh.MeshTags
    facets: dolfinx.mesh.MeshTags
    bodies: tuple[Hashable, ...]
    cell_numbers: TagNumbers
    facet_numbers: TagNumbers

    def body(self, body: Hashable) -> tuple[int, ...]:
        """Return all cell tags of a body, for a ``ufl.Measure``.

        Raises:
            ValueError: There is no such body.
        """
        return tuple(self._tags_of(self.cell_numbers, body).values())

    def cell(self, body: Hashable, tag: int) -> int:
        """Return the new tag of the cells that had ``tag`` in the mesh of a body.

        Raises:
            ValueError: There is no such body, or it has no such tag.
        """
        return self._tag_number("cell", self.cell_numbers, body, tag)

    def facet(self, body: Hashable, tag: int) -> int:
        """Return the new tag of the facets that had ``tag`` in the mesh of a body.

        Raises:
            ValueError: There is no such body, or it has no such tag.
        """
        return self._tag_number("facet", self.facet_numbers, body, tag)

    def by_body(self, values: Mapping[Hashable, float]) -> fem.Function:
        """Return a piecewise constant function with one value per body, such as a modulus.

        Collective.

        Args:
            values: A number for every body, by its name.

        Raises:
            ValueError: A body has no value, there is no such body, or a value is not a number.
        """
        if not isinstance(values, Mapping) or set(values) != set(self.bodies):
            given = list(values) if isinstance(values, Mapping) else values
            raise ValueError(
                f"values are given for {given!r}; they must be a dict with one number for each of "
                f"the bodies {list(self.bodies)!r}"
            )
        for body, value in values.items():
            if not is_number(value):
                raise ValueError(f"the value of body {body!r} is {value!r}; it must be a number")
        space = fem.functionspace(self.mesh, ("Discontinuous Lagrange", 0))
        field = fem.Function(space)
        of_cell = space.dofmap.list[self.cells.indices, 0]
        for body in self.bodies:
            field.x.array[of_cell[np.isin(self.cells.values, self.body(body))]] = values[body]
        return field

    def _tags_of(self, numbers: TagNumbers, body: Hashable) -> Mapping[int | None, int]:
        if body not in self.bodies:
            raise ValueError(f"there is no body {body!r}; the bodies are {list(self.bodies)!r}")
        return numbers[body]

    def _tag_number(self, what: str, numbers: TagNumbers, body: Hashable, tag: int) -> int:
        known = self._tags_of(numbers, body)
        if not isinstance(tag, Hashable) or tag is None or tag not in known:
            tags = [old for old in known if old is not None]
            raise ValueError(f"no {what} of body {body!r} had the tag {tag!r}; its tags are {tags}")
        return known[tag]


def join_meshes(parts: Mapping[Hashable, Part] | Iterable[Part]) -> JoinedMesh:
    """Join the meshes of several bodies into one mesh. Collective.

    Nodes are not merged: bodies that touch remain separate, and interact by contact only. DOLFINx
    redistributes all cells, without ghost cells.

    Args:
        parts: For every body its mesh, or (mesh, cell_tags, facet_tags) as returned by
            `model_to_mesh`; tags may be None or omitted. Either a dict by name of the body, or a
            list, for which the names are 0, 1, …. All meshes must have the same cell type,
            dimension, geometric degree and communicator.

    Returns:
        The mesh with its tags and their new numbers.

    Raises:
        ValueError: There are no parts, a part is invalid, meshes are incompatible, or tags have the
            wrong dimension or are not integers.
    """
    if isinstance(parts, Mapping):
        names, given = tuple(parts), list(parts.values())
    elif isinstance(parts, Iterable) and not isinstance(parts, str):
        given = list(parts)
        names = tuple(range(len(given)))
    else:
        raise ValueError(
            f"parts is a {type(parts).__name__}; it must be a list of bodies, or a dict by name"
        )
    if not given:
        raise ValueError("parts is empty; give at least one body")
    bodies = [_check_part(name, part) for name, part in zip(names, given, strict=True)]
    _check_compatible(names, [mesh for mesh, _, _ in bodies])
    first = bodies[0][0]
    comm, d = first.comm, first.topology.dim

    cells, x = _cells_and_nodes([mesh for mesh, _, _ in bodies])
    cell_numbers, facet_numbers, data = _renumber_tags(names, bodies)
    domain = ufl.Mesh(first.ufl_domain().ufl_coordinate_element())
    partitioner = compat.cell_partitioner(dolfinx.mesh.GhostMode.none)
    mesh = dolfinx.mesh.create_mesh(comm, cells=cells, x=x, e=domain, partitioner=partitioner)

    # The local order of nodes, and therefore of facets, is unchanged.
    data = exchange_rows(comm, data, np.asarray(mesh.topology.original_cell_index))
    all_cells = np.arange(len(data), dtype=np.int32)
    cell_tags = dolfinx.mesh.meshtags(mesh, d, all_cells, data[:, 0].astype(np.int32))
    facet_tags = tag_facets(mesh, data[:, 1:])
    mesh.topology.create_connectivity(d - 1, d)  # for Dirichlet conditions on tagged facets
    return JoinedMesh(mesh, cell_tags, facet_tags, names, cell_numbers, facet_numbers)


Body: TypeAlias = tuple[
    dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags | None, dolfinx.mesh.MeshTags | None
]


def _check_part(name: Hashable, part: Any) -> Body:
    """Return mesh, cell tags and facet tags of a body, or raise ValueError if they are invalid."""
    values = [part] if isinstance(part, dolfinx.mesh.Mesh) else part
    if not (isinstance(values, Sequence) and 1 <= len(values) <= 3):
        kinds = type(part).__name__
        if isinstance(values, Sequence):
            kinds += f" of ({', '.join(type(value).__name__ for value in values)})"
        raise ValueError(
            f"body {name!r} is a {kinds}; it must be a mesh, or (mesh, cell_tags, facet_tags)"
        )
    mesh, cell_tags, facet_tags = [*values, None, None][:3]
    check_instance(f"the mesh of body {name!r}", mesh, dolfinx.mesh.Mesh)
    check_cells(f"the mesh of body {name!r}", mesh.topology.cell_name())
    d = mesh.topology.dim
    for what, tags, dim in (("cell_tags", cell_tags, d), ("facet_tags", facet_tags, d - 1)):
        if tags is None:
            continue
        check_instance(f"{what} of body {name!r}", tags, dolfinx.mesh.MeshTags)
        if tags.dim != dim:
            raise ValueError(
                f"{what} of body {name!r} are on entities of dimension {tags.dim}, and must be on "
                f"those of dimension {dim}: give (mesh, cell_tags, facet_tags)"
            )
        if tags.values.dtype.kind != "i":
            raise ValueError(
                f"{what} of body {name!r} have values of type {tags.values.dtype}; they must be "
                "integers"
            )
    return mesh, cell_tags, facet_tags


def _check_compatible(names: Sequence[Hashable], meshes: Sequence[dolfinx.mesh.Mesh]) -> None:
    """Raise ValueError unless the meshes have the same cells, dimension and communicator."""

    def kind(mesh: dolfinx.mesh.Mesh) -> str:
        element = compat.geometry_element(mesh)
        cells = f"cells of type {mesh.topology.cell_name()} and geometric degree {element.degree}"
        # Up to degree 2 all variants have the same nodes.
        variant = f", nodes {element.lagrange_variant.name}" if element.degree > 2 else ""
        return f"{cells}{variant} in {mesh.geometry.dim} dimensions"

    for name, mesh in zip(names[1:], meshes[1:], strict=True):
        if kind(mesh) != kind(meshes[0]):
            raise ValueError(
                f"body {names[0]!r} has {kind(meshes[0])}, and body {name!r} has {kind(mesh)}: "
                "all must be the same"
            )
        comparison = MPI.Comm.Compare(mesh.comm, meshes[0].comm)
        if comparison not in (MPI.IDENT, MPI.CONGRUENT):
            raise ValueError(
                f"body {names[0]!r} is on {meshes[0].comm.size} ranks, and body {name!r} is on "
                f"{mesh.comm.size}, or on others: create all meshes with the same communicator"
            )


def _cells_and_nodes(meshes: Sequence[dolfinx.mesh.Mesh]) -> tuple[Index, Array]:
    """Return owned cells by global node numbers of the joined mesh, and owned nodes. Collective."""
    comm, d = meshes[0].comm, meshes[0].geometry.dim
    maps = [mesh.geometry.index_map() for mesh in meshes]
    n_own = np.array([nodes.size_local for nodes in maps])
    counts = np.array(comm.allgather(n_own)).reshape(comm.size, len(meshes))
    # Nodes are numbered rank by rank, and on each rank body by body.
    new = np.cumsum(counts).reshape(counts.shape) - counts
    old = np.cumsum(counts, axis=0) - counts
    cells = []
    for i, (mesh, nodes) in enumerate(zip(meshes, maps, strict=True)):
        n_nodes = nodes.size_local + nodes.num_ghosts
        owner = np.full(n_nodes, comm.rank)
        owner[nodes.size_local :] = nodes.owners
        number = nodes.local_to_global(np.arange(n_nodes, dtype=np.int32))
        number = number - old[owner, i] + new[owner, i]
        n_cells = mesh.topology.index_map(mesh.topology.dim).size_local
        cells.append(number[compat.geometry_dofmap(mesh)[:n_cells]])
    x = [mesh.geometry.x[:n, :d] for mesh, n in zip(meshes, n_own, strict=True)]
    return np.concatenate(cells).astype(np.int64), np.concatenate(x)


def _renumber_tags(
    names: Sequence[Hashable], bodies: Sequence[Body]
) -> tuple[TagNumbers, TagNumbers, Any]:
    """Renumber cell and facet tags; also return the new tags of owned cells. Collective.

    These are the tag of each cell and of its facets, or zero, (n_cells, 1 + n_facets).
    """
    cell_numbers: dict[Hashable, dict[int | None, int]] = {}
    facet_numbers: dict[Hashable, dict[int | None, int]] = {}
    rows, n_cell_tags, n_facet_tags = [], 0, 0
    for name, (mesh, cell_tags, facet_tags) in zip(names, bodies, strict=True):
        d = mesh.topology.dim
        cell_map = mesh.topology.index_map(d)
        n_cells, n_all = cell_map.size_local, cell_map.size_local + cell_map.num_ghosts
        known, numbers = _number_tags(mesh.comm, cell_tags, n_cell_tags)
        of_cell = _expand_tags(mesh.comm, f"cell_tags of body {name!r}", cell_tags, numbers, n_all)
        if mesh.comm.allreduce(int(np.count_nonzero(of_cell[:n_cells] == 0))):
            numbers[None] = n_cell_tags + len(known) + 1
            of_cell[of_cell == 0] = numbers[None]
        cell_numbers[name] = numbers
        n_cell_tags += len(numbers)

        mesh.topology.create_connectivity(d, d - 1)
        facet_map = mesh.topology.index_map(d - 1)
        n_all = facet_map.size_local + facet_map.num_ghosts
        known, numbers = _number_tags(mesh.comm, facet_tags, n_facet_tags)
        what = f"facet_tags of body {name!r}"
        of_facet = _expand_tags(mesh.comm, what, facet_tags, numbers, n_all)
        facet_numbers[name] = numbers
        n_facet_tags += len(numbers)
        facets = _cell_facets(mesh)[:n_cells]
        rows.append(np.column_stack([of_cell[:n_cells], of_facet[facets]]))
    return cell_numbers, facet_numbers, np.concatenate(rows)


def _number_tags(
    comm: MPI.Comm, tags: dolfinx.mesh.MeshTags | None, offset: int
) -> tuple[list[int], dict[int | None, int]]:
    """Return the sorted tags of all ranks, and their new numbers from offset + 1. Collective."""
    local = [] if tags is None else np.unique(tags.values).tolist()
    known = sorted(set().union(*comm.allgather(local)))
    return known, {tag: offset + 1 + i for i, tag in enumerate(known)}


def _expand_tags(
    comm: MPI.Comm,
    what: str,
    tags: dolfinx.mesh.MeshTags | None,
    numbers: Mapping[int | None, int],
    n: int,
) -> npt.NDArray[np.int64]:
    """Return the new tag of every entity of this rank, or 0, (n,). Collective."""
    new_tags = np.zeros(n, dtype=np.int64)
    with collective_errors(comm):
        if tags is not None and len(tags.indices):
            if tags.indices.max() >= n:
                raise ValueError(
                    f"{what} have the index {tags.indices.max()}, but the mesh has {n} entities: "
                    "give the tags of this mesh"
                )
            old, inverse = np.unique(tags.values, return_inverse=True)
            new_tags[tags.indices] = np.array([numbers[tag] for tag in old.tolist()])[inverse]
    return new_tags


def _cell_facets(mesh: dolfinx.mesh.Mesh) -> Index:
    """Return the facets of every cell of this rank, in the order of the reference cell."""
    d = mesh.topology.dim
    mesh.topology.create_connectivity(d, d - 1)
    of_cell = mesh.topology.connectivity(d, d - 1)
    n = len(basix.topology(basix.CellType[mesh.topology.cell_name()])[d - 1])
    return of_cell.array.reshape(-1, n)


def exchange_rows(comm: MPI.Comm, rows: Any, row_numbers: Index) -> Any:
    """Return rows (k, m) of a distributed array (n, m) by their global numbers (k,). Collective."""
    ends = np.cumsum(comm.allgather(len(rows)))
    first = int(ends[comm.rank]) - len(rows)
    owner = np.searchsorted(ends, row_numbers, side="right")
    requests = comm.alltoall([row_numbers[owner == rank] for rank in range(comm.size)])
    replies = comm.alltoall([rows[numbers - first] for numbers in requests])
    received = np.empty((len(row_numbers), rows.shape[1]), dtype=rows.dtype)
    for rank, reply in enumerate(replies):
        received[owner == rank] = reply
    return received


def tag_facets(mesh: dolfinx.mesh.Mesh, tags: Any) -> dolfinx.mesh.MeshTags:
    """Create facet tags from those of the facets of each cell, (n_cells, n), or 0. Collective."""
    d = mesh.topology.dim
    facets = _cell_facets(mesh)
    values = la.vector(mesh.topology.index_map(d - 1), 2)
    tag = values.array.reshape(-1, 2)
    # Only one of the two cells of an interior facet may have its tag.
    np.maximum.at(tag[:, 0], facets, tags)
    tag[:, 1] = tag[:, 0] > 0
    values.scatter_reverse(la.InsertMode.add)
    tag[:, 0] /= np.maximum(tag[:, 1], 1)
    values.scatter_forward()
    tagged = np.flatnonzero(tag[:, 0] > 0).astype(np.int32)
    return dolfinx.mesh.meshtags(mesh, d - 1, tagged, tag[tagged, 0].round().astype(np.int32))
