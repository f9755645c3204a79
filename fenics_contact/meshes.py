"""Conversion of gmsh models and of arrays to DOLFINx meshes with tags."""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Integral
from typing import Any

import basix.ufl
import dolfinx
import numpy as np
import numpy.typing as npt
import ufl
from mpi4py import MPI

from fenics_contact import compat
from fenics_contact.joining import exchange_rows, tag_facets
from fenics_contact.parallel import collective_errors
from fenics_contact.tolerances import ROUND_OFF
from fenics_contact.types import Array, Index

__all__ = ["mesh_from_arrays", "model_to_mesh"]

# Geometric degree by number of nodes, for every supported cell type.
_DEGREES = {
    "triangle": {3: 1, 6: 2},
    "quadrilateral": {4: 1, 9: 2},
    "tetrahedron": {4: 1, 10: 2},
    "hexahedron": {8: 1, 27: 2},
}
_NODE_ORDERS = ("vtk", "gmsh", "dolfinx")
_LARGEST_TAG = np.iinfo(np.int32).max
_MAX_ROWS_IN_ERROR = 3


def model_to_mesh(
    model: Any, comm: MPI.Comm, rank: int = 0, gdim: int = 3
) -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags, dolfinx.mesh.MeshTags]:
    """Create a distributed mesh from a gmsh model. Collective.

    The function has the same result with every DOLFINx release from 0.9 on, and refuses models that
    DOLFINx would convert incompletely.

    Args:
        model: A meshed ``gmsh.model``, in which every cell, and every facet that is to have a tag,
            is in one physical group. It is used on ``rank`` only.
        comm: Communicator of the mesh.
        rank: The rank that has the model.
        gdim: Dimension of space and of the body, 2 or 3; in 2D the coordinate z is dropped.

    Returns:
        The mesh, with coordinates in ``gdim`` dimensions and the geometric degree of the model; the
        tags of all cells; and the tags of the facets in physical groups, which may be empty. A tag
        is the number of the physical group.

    Raises:
        ValueError: Cells are missing, in no group, in two groups or of several types, or node
            numbers are not contiguous; raised on all ranks.
    """
    with collective_errors(comm):
        if comm.rank == rank:
            _check_gmsh_model(model, gdim)
    mesh, cell_tags, facet_tags = compat.gmsh_data(model, comm, rank, gdim)
    if facet_tags is None:
        empty = np.empty(0, dtype=np.int32)
        facet_tags = dolfinx.mesh.meshtags(mesh, gdim - 1, empty, empty)
    return mesh, cell_tags, facet_tags


def _check_gmsh_model(model: Any, gdim: int) -> None:
    """Refuse models that DOLFINx would convert incompletely, or that fail on one rank only."""
    dimensions = sorted({dim for dim, _ in model.getPhysicalGroups()})
    if not dimensions or dimensions[-1] != gdim:
        raise ValueError(
            f"the physical groups of the gmsh model have the dimensions {dimensions}, but gdim is "
            f"{gdim}: add its cells to a group by gmsh.model.addPhysicalGroup({gdim}, [...])"
        )
    for dim, what in ((gdim, "cells"), (gdim - 1, "facets")):
        types: set[int] = set()
        groups: dict[int, list[int]] = {}
        for _, group in model.getPhysicalGroups(dim):
            for entity in model.getEntitiesForPhysicalGroup(dim, group):
                groups.setdefault(entity, []).append(group)
        n_grouped = 0
        for entity in groups:
            kinds, numbers, _ = model.mesh.getElements(dim, entity)
            types.update(kinds)
            n_grouped += sum(len(of_type) for of_type in numbers)
        n_all = sum(len(of_type) for of_type in model.mesh.getElements(dim)[1])
        if dim == gdim and n_all == 0:
            raise ValueError(
                f"the gmsh model has no cells: call gmsh.model.mesh.generate({gdim}) first"
            )
        shared = next((tags for tags in groups.values() if len(tags) > 1), None)
        if shared:
            names = [f"{group} {model.getPhysicalName(dim, group)!r}" for group in shared]
            raise ValueError(
                f"some {what} of the gmsh model are in two physical groups, "
                f"{' and '.join(names)}, but can have one tag only: put them into one group, and "
                f"give both tags where both are meant, ContactSurface(mesh, tags, {shared}) or "
                f"dx({tuple(shared)})"
            )
        if dim == gdim and n_grouped < n_all:
            raise ValueError(
                f"{n_all - n_grouped} of the {n_all} cells of the gmsh model are in no physical "
                f"group and would be lost: add gmsh.model.addPhysicalGroup({gdim}, [...])"
            )
        if len(types) > 1:
            names = [model.mesh.getElementProperties(kind)[0] for kind in sorted(types)]
            raise ValueError(
                f"the {what} of the gmsh model are of several types, {', '.join(names)}; all must "
                "be of one type"
            )
    nodes = model.mesh.getNodes()[0]
    if len(nodes) != nodes.max():
        raise ValueError(
            f"the gmsh model has {len(nodes)} nodes with numbers up to {nodes.max()}: call "
            "gmsh.model.mesh.renumberNodes() first"
        )


# ---- plain arrays --------------------------------------------------------------------------------


def mesh_from_arrays(
    comm: MPI.Comm,
    points: npt.ArrayLike | None,
    cells: npt.ArrayLike | None,
    *,
    cell_type: str | dolfinx.mesh.CellType,
    facets: Mapping[int, npt.ArrayLike] | None = None,
    cell_tags: npt.ArrayLike | None = None,
    node_order: str = "vtk",
    rank: int = 0,
) -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags, dolfinx.mesh.MeshTags]:
    """Create a mesh with cell and facet tags from arrays, distributed over the ranks. Collective.

    The arrays are those that meshio and most mesh readers return. They are read on ``rank`` alone;
    on the other ranks they are ignored and may be None. Points that belong to no cell, such as
    reference points of Abaqus, are dropped.

    Args:
        comm: The ranks that share the mesh.
        points: Coordinates, shape (n_points, gdim), with gdim the dimension of the cells.
        cells: Indices into ``points``, from 0, shape (n_cells, n_nodes). Cells of first or second
            order with all nodes of the Lagrange element, no incomplete (serendipity) ones.
        cell_type: "triangle", "quadrilateral", "tetrahedron" or "hexahedron", on all ranks.
        facets: For every tag the facets that have it, as indices into ``points``, shape (n_facets,
            n_nodes), vertices first, in any order. Further nodes of second-order facets are
            ignored. Interior facets may have tags, too.
        cell_tags: One whole number per cell, shape (n_cells,). By default all cells have the
            tag 0.
        node_order: Numbering of the nodes in a cell: "vtk" (also that of meshio and Abaqus), "gmsh"
            or "dolfinx", on all ranks. For linear triangles and tetrahedra all are the same.
        rank: The rank that has the arrays.

    Returns:
        The mesh, the tags of its cells, one for each, and the tags of its facets.

    Raises:
        ValueError: Arrays of the wrong shape or type, indices out of range, facets that belong to
            no cell or have two tags, or cells that are degenerate or whose nodes are in another
            order. On all ranks.
    """
    kind = getattr(cell_type, "name", cell_type)
    if kind not in _DEGREES:
        raise ValueError(
            f"cell_type is {cell_type!r}; it must be one of {tuple(_DEGREES)}. Meshes of several "
            "cell types are not supported"
        )
    if node_order not in _NODE_ORDERS:
        raise ValueError(f"node_order is {node_order!r}; it must be one of {_NODE_ORDERS}")
    if not 0 <= rank < comm.size:
        raise ValueError(f"rank is {rank!r}; it must be one of the {comm.size} ranks, from 0")
    shape = basix.CellType[kind]
    gdim = len(basix.topology(shape)) - 1
    local_facets = np.array(basix.topology(shape)[gdim - 1])

    x: Array = np.zeros((0, gdim))
    nodes: Index = np.zeros((0, 0), dtype=np.int64)
    rows: Index = np.zeros((0, 1 + len(local_facets)), dtype=np.int64)
    facet_ids: list[int] = []
    with collective_errors(comm):
        if comm.rank == rank:
            x = _points(points, gdim, kind)
            nodes = _cells(cells, len(x), kind)
            nodes = nodes[:, _to_dolfinx(kind, nodes.shape[1], node_order)]
            _check_jacobians(x, nodes, kind, node_order)
            rows = np.zeros((len(nodes), rows.shape[1]), dtype=np.int64)
            rows[:, 0] = _cell_tags(cell_tags, len(nodes))
            facet_ids = _fill_facet_rows(rows[:, 1:], facets, nodes[:, local_facets], len(x))
            used, nodes = np.unique(nodes, return_inverse=True)
            x, nodes = x[used], nodes.reshape(len(rows), -1)
    n_nodes, facet_ids = comm.bcast((nodes.shape[1], facet_ids), root=rank)
    nodes = nodes.reshape(-1, n_nodes)

    element = basix.ufl.element(
        "Lagrange", kind, _DEGREES[kind][n_nodes], basix.LagrangeVariant.equispaced, shape=(gdim,)
    )
    mesh = dolfinx.mesh.create_mesh(
        comm,
        cells=nodes,
        x=x,
        e=ufl.Mesh(element),
        partitioner=compat.cell_partitioner(dolfinx.mesh.GhostMode.none),
    )
    rows = exchange_rows(comm, rows, np.asarray(mesh.topology.original_cell_index))
    all_cells = np.arange(len(rows), dtype=np.int32)
    tags_of_cells = dolfinx.mesh.meshtags(mesh, gdim, all_cells, rows[:, 0].astype(np.int32))
    numbered = tag_facets(mesh, rows[:, 1:])
    values = np.array(facet_ids, dtype=np.int32)[numbered.values - 1]
    tags_of_facets = dolfinx.mesh.meshtags(mesh, gdim - 1, numbered.indices, values)
    mesh.topology.create_connectivity(gdim - 1, gdim)  # for Dirichlet conditions on tagged facets
    return mesh, tags_of_cells, tags_of_facets


def _integers(what: str, values: Any, n_columns: str) -> Index:
    """Convert to a two-dimensional array of whole numbers."""
    try:
        array = np.asarray(values)
    except ValueError:
        array = np.empty(0, dtype=object)  # rows of different lengths
    if array.ndim != 2 or array.dtype.kind not in "iu":
        raise ValueError(
            f"{what} has shape {array.shape} and type {array.dtype}; give whole numbers of shape "
            f"(n, {n_columns}), the indices of points"
        )
    return array.astype(np.int64)


def _check_range(what: str, indices: Index, n_points: int) -> None:
    """Raise ValueError for indices of points that do not exist."""
    if indices.size == 0 or (indices.min() >= 0 and indices.max() < n_points):
        return
    hint = "; indices count from 0: subtract 1" if indices.max() == n_points else ""
    raise ValueError(
        f"{what} has indices from {indices.min()} to {indices.max()}, and there are {n_points} "
        f"points, 0 to {n_points - 1}{hint}"
    )


def _points(points: Any, gdim: int, kind: str) -> Array:
    """Convert and check the coordinates."""
    try:
        x = np.asarray(points, dtype=np.float64)
    except (TypeError, ValueError):
        x = np.empty(0)
    if x.ndim != 2 or x.shape[1] != gdim:
        hint = ""
        if x.ndim == 2 and x.shape[1] > gdim:
            hint = f": give points[:, :{gdim}] if the mesh lies in that plane"
        raise ValueError(
            f"points has shape {np.shape(x)}; a mesh of cell type {kind} needs coordinates of "
            f"shape (n_points, {gdim}){hint}"
        )
    if not np.isfinite(x).all():
        bad = np.flatnonzero(~np.isfinite(x).all(axis=1))
        raise ValueError(
            f"points has {len(bad)} rows that are not finite, the first is number {bad[0]}; give "
            "finite coordinates"
        )
    return x


def _cells(cells: Any, n_points: int, kind: str) -> Index:
    """Convert and check the nodes of the cells."""
    nodes = _integers("cells", cells, "n_nodes")
    known = _DEGREES[kind]
    if len(nodes) == 0:
        raise ValueError(f"cells has shape {nodes.shape}; give one cell at least")
    if nodes.shape[1] not in known:
        raise ValueError(
            f"cells has {nodes.shape[1]} nodes per cell, and a {kind} has one of {tuple(known)}: "
            "mesh with these, incomplete (serendipity) cells are not supported"
        )
    _check_range("cells", nodes, n_points)
    ordered = np.sort(nodes, axis=1)
    collapsed = np.flatnonzero((ordered[:, 1:] == ordered[:, :-1]).any(axis=1))
    if len(collapsed):
        raise ValueError(
            f"{len(collapsed)} cells have a point twice, the first is cells[{collapsed[0]}] = "
            f"{nodes[collapsed[0]].tolist()}; remove collapsed cells, or mesh without them"
        )
    return nodes


def _to_dolfinx(kind: str, n_nodes: int, order: str) -> Index:
    """Return the column of each node of a cell in the numbering of DOLFINx."""
    if order == "dolfinx":
        return np.arange(n_nodes)
    utils = dolfinx.io.utils
    permutation = utils.cell_perm_gmsh if order == "gmsh" else utils.cell_perm_vtk
    cell = getattr(dolfinx.mesh.CellType, kind)
    return np.asarray(permutation(cell, n_nodes), dtype=np.int64)


def _check_jacobians(x: Array, nodes: Index, kind: str, node_order: str) -> None:
    """Raise ValueError for cells without volume or with nodes in another order.

    The Jacobian determinant has one sign at all vertices, and edge nodes are near midpoints.
    """
    shape, gdim = basix.CellType[kind], x.shape[1]
    degree = _DEGREES[kind][nodes.shape[1]]
    element = basix.create_element(
        basix.ElementFamily.P, shape, degree, basix.LagrangeVariant.equispaced
    )
    gradients = element.tabulate(1, basix.geometry(shape))[1:, :, :, 0]  # (gdim, points, nodes)
    corners = x[nodes]
    jacobians = np.einsum("dpn,cni->cpid", gradients, corners)
    det = np.linalg.det(jacobians)
    diameter = np.linalg.norm(np.ptp(corners, axis=1), axis=1)
    det = det / np.maximum(diameter, np.finfo(float).tiny)[:, None] ** gdim
    small = np.flatnonzero(np.abs(det).max(axis=1) <= ROUND_OFF)
    if len(small):
        raise ValueError(
            f"{len(small)} cells have no volume, the first is cells[{small[0]}] with the points "
            f"{corners[small[0]].tolist()}; remove them, or mesh without them"
        )
    invalid = det.min(axis=1) * det.max(axis=1) <= 0
    edges = np.array(basix.topology(shape)[1])
    for edge, dofs in zip(edges, element.entity_dofs[1], strict=True):
        ends = corners[:, edge]
        for node in dofs:
            offset = corners[:, node] - ends.mean(axis=1)
            half_length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / 2
            invalid |= np.linalg.norm(offset, axis=1) >= half_length
    bad = np.flatnonzero(invalid)
    if len(bad):
        raise ValueError(
            f"{len(bad)} of {len(nodes)} cells have a Jacobian determinant that changes sign, or "
            f"an edge node far from the middle of its edge, the first is cells[{bad[0]}]; if it "
            f"is all of them, their nodes are not in the order node_order={node_order!r}: give "
            f"another of {_NODE_ORDERS}; else the cells are too distorted"
        )


def _cell_tags(cell_tags: Any, n_cells: int) -> Index:
    """Convert and check the tags of the cells."""
    if cell_tags is None:
        return np.zeros(n_cells, dtype=np.int64)
    values = np.asarray(cell_tags)
    if values.shape != (n_cells,) or values.dtype.kind not in "iu":
        raise ValueError(
            f"cell_tags has shape {values.shape} and type {values.dtype}; give one whole number "
            f"for each of the {n_cells} cells, shape ({n_cells},)"
        )
    if np.abs(values).max() > _LARGEST_TAG:
        raise ValueError(f"cell_tags go up to {np.abs(values).max()}; give {_LARGEST_TAG} at most")
    return values.astype(np.int64)


def _fill_facet_rows(rows: Index, facets: Any, of_cells: Index, n_points: int) -> list[int]:
    """Write 1 plus the position of its tag into ``rows`` for each tagged facet; return the tags.

    ``rows`` are zeros on entry, (n_cells, n_facets); ``of_cells`` are the vertices of the facets of
    all cells, (n_cells, n_facets, n_vertices).
    """
    if facets is None:
        return []
    if not isinstance(facets, Mapping):
        raise ValueError(
            f"facets is a {type(facets).__name__}; give a dict, {{tag: indices of shape "
            "(n_facets, n_vertices)}"
        )
    k = of_cells.shape[2]
    ids: list[int] = []
    given, numbers = [], []
    for tag, values in facets.items():
        is_integer = isinstance(tag, Integral) and not isinstance(tag, bool)
        if not (is_integer and abs(int(tag)) <= _LARGEST_TAG):
            raise ValueError(
                f"facets has the tag {tag!r}; tags must be whole numbers, {_LARGEST_TAG} at most"
            )
        what = f"facets[{tag}]"
        ids.append(int(tag))
        if np.size(values) == 0:
            continue
        indices = _integers(what, values, str(k))
        if indices.shape[1] < k:
            raise ValueError(
                f"{what} has {indices.shape[1]} points per facet, and facets of these cells have "
                f"{k} vertices; give shape (n_facets, {k})"
            )
        _check_range(what, indices, n_points)
        given.append(np.sort(indices[:, :k], axis=1))
        numbers.append(np.full(len(indices), len(ids)))
    if not given:
        return ids
    tagged, number = np.concatenate(given), np.concatenate(numbers)
    # Only facets whose vertices all belong to tagged facets are candidates.
    on_tagged = np.zeros(n_points, dtype=np.bool_)
    on_tagged[tagged] = True
    cell, facet = np.nonzero(on_tagged[of_cells].all(axis=2))
    candidates = np.sort(of_cells[cell, facet], axis=1)
    _, inverse = np.unique(np.concatenate([tagged, candidates]), axis=0, return_inverse=True)
    inverse = inverse.ravel()
    key, candidate_key = inverse[: len(tagged)], inverse[len(tagged) :]
    _check_known_facets(tagged, number, ~np.isin(key, candidate_key), ids)
    tag_of_key = np.zeros(inverse.max() + 1, dtype=np.int64)
    tag_of_key[key] = number
    clashes = np.flatnonzero(tag_of_key[key] != number)
    if len(clashes):
        first = clashes[0]
        pair = ids[number[first] - 1], ids[tag_of_key[key[first]] - 1]
        raise ValueError(
            f"{len(clashes)} facets have two tags, such as {tagged[first].tolist()} with {pair[0]} "
            f"and {pair[1]}; leave them in one, and name both where both are meant, as "
            f"ContactSurface(mesh, tags, {list(pair)}) and ds({pair}) do"
        )
    rows[cell, facet] = tag_of_key[candidate_key]
    return ids


def _check_known_facets(tagged: Index, number: Index, unknown: Any, ids: list[int]) -> None:
    """Raise ValueError for tagged facets that belong to no cell."""
    if not unknown.any():
        return
    first = number[unknown][0]
    bad = tagged[unknown & (number == first)]
    raise ValueError(
        f"facets[{ids[first - 1]}] has {len(bad)} facets that belong to no cell, with the vertices "
        f"{bad[:_MAX_ROWS_IN_ERROR].tolist()}; give facets of the cells by the same indices of "
        "points, vertices first"
    )
