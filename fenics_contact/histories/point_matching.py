"""Matching of stored values to nodes and quadrature points by location, on any number of ranks.

A location consists of the coordinates of a node or point and the mean midpoint of its cells, which
distinguishes coincident nodes (of two touching bodies, or the faces of a slit).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import basix
import dolfinx
import numpy as np
import scipy.spatial
from dolfinx import fem, la
from mpi4py import MPI

from fenics_contact import compat
from fenics_contact.contact.contact import Contact
from fenics_contact.histories.checkpoint_file import StoredCheckpoint, refuse
from fenics_contact.problem import ContactProblem
from fenics_contact.surface.facets import facet_cells
from fenics_contact.tolerances import NEGLIGIBLE
from fenics_contact.types import Array, Indices

__all__ = [
    "UnknownField",
    "column_layout",
    "count_coincident",
    "gather",
    "locate_nodes",
    "locate_points",
    "match_values",
    "nodal_values",
    "node_coordinates",
    "set_nodal_values",
    "split_columns",
    "split_unknowns",
]


def column_layout(data: dict[str, Array]) -> list[tuple[str, int]]:
    """Return the names and numbers of components of arrays, 0 for scalars."""
    return [(name, array.shape[1] if array.ndim > 1 else 0) for name, array in data.items()]


def split_columns(rows: Array, layout: Sequence[tuple[str, int]]) -> dict[str, Array]:
    """Split the columns of rows into arrays by name."""
    data, first = {}, 0
    for name, width in layout:
        data[name] = rows[:, first : first + width] if width else rows[:, first].copy()
        first += max(width, 1)
    return data


def gather(comm: MPI.Comm, locations: Array, *values: Array | dict[str, Array]) -> Array:
    """Gather rows of locations (n, width) and values (n, n_values) on rank 0. Collective."""
    columns = [locations]
    for part in values:
        columns += part.values() if isinstance(part, dict) else [part]
    gathered = comm.gather(np.column_stack(columns))
    return np.zeros((0, 0)) if gathered is None else np.concatenate(gathered)


def match_values(
    comm: MPI.Comm, stored: StoredCheckpoint, name: str, locations: Array, mesh_size: float
) -> Array:
    """Return the stored values at the locations of this rank, (n, n_values). Collective.

    Raises:
        ValueError: The stored locations are not those of all ranks, or two of them coincide; raised
            on all ranks.
    """
    table, width = stored.arrays[name], locations.shape[1]
    counts = comm.allgather(len(locations))
    missing, row = len(locations), np.zeros(0, dtype=np.int64)
    if len(table):
        distance, row = scipy.spatial.cKDTree(table[:, :width]).query(locations)
        missing = int(np.count_nonzero(distance > NEGLIGIBLE * mesh_size))
    missing = comm.allreduce(missing)
    if missing or len(table) != sum(counts):
        refuse(
            stored,
            [
                f"{name} is of another mesh, element or quadrature rule: {len(table)} locations in "
                f"the file, {sum(counts)} in the problem, {missing} of them not in the file"
            ],
        )
    used = np.concatenate(comm.allgather(row))
    if np.unique(used).size < used.size:
        refuse(stored, [f"{name} has several values at one location, which is ambiguous"])
    return table[row, width:]


def count_coincident(comm: MPI.Comm, locations: Array, mesh_size: float) -> int:
    """Return the number of pairs of coincident locations over all ranks. Collective."""
    gathered, n_pairs = gather(comm, locations), 0
    if len(gathered):
        n_pairs = len(
            scipy.spatial.cKDTree(gathered).query_pairs(
                NEGLIGIBLE * mesh_size, output_type="ndarray"
            )
        )
    return int(comm.bcast(n_pairs))


class UnknownField(NamedTuple):
    """A field of the unknowns: its collapsed space and the owned dofs in the whole space."""

    name: str
    space: fem.FunctionSpace
    dofs: Indices


def split_unknowns(problem: ContactProblem) -> list[UnknownField]:
    """Return the fields of the unknowns, the displacement first. Collective."""
    displacement = problem.displacement
    space, dofs = displacement.u.function_space, displacement.dofs
    if dofs is None:
        dofs = np.arange(displacement.n_owned, dtype=np.int32)
    parts = [UnknownField("nodes", space, dofs[: displacement.n_owned])]
    for number, (other, numbers) in enumerate(displacement.others, start=1):
        owned = other.dofmap.index_map.size_local * other.dofmap.index_map_bs
        parts.append(UnknownField(f"part {number}", other, numbers[:owned]))
    return parts


def node_coordinates(space: fem.FunctionSpace) -> Array:
    """Return coordinates of owned nodes, (n, gdim); ValueError if dofs are not values at points."""
    gdim, dofmap = space.mesh.geometry.dim, space.dofmap
    n_owned = dofmap.index_map.size_local
    try:
        is_bubble = space.element.basix_element.family == basix.ElementFamily.bubble
    except RuntimeError:  # quadrature elements are not Basix elements
        is_bubble = False
    if not is_bubble:
        return space.tabulate_dof_coordinates()[:n_owned, :gdim]
    if dofmap.dof_layout.num_dofs != 1:
        raise ValueError(
            f"dofs of {space.ufl_element()} are not values at points, and cannot be identified on "
            "other ranks; use bubble elements with one function per cell"
        )
    cells = dofmap.list[:, 0]
    x = np.zeros((n_owned + dofmap.index_map.num_ghosts, gdim))
    x[cells] = _cell_midpoints(space.mesh)[: len(cells)]
    return x[:n_owned]


def nodal_values(field: fem.Function) -> Array:
    """Return the values at the owned nodes, (n_nodes, bs), as a view."""
    dofmap = field.function_space.dofmap
    n_owned = dofmap.index_map.size_local
    return field.x.array.reshape(-1, dofmap.index_map_bs)[:n_owned]


def set_nodal_values(field: fem.Function, rows: Array) -> None:
    """Set the values at the owned nodes, (n_nodes, bs). Collective."""
    nodal_values(field)[:] = rows
    field.x.scatter_forward()


def _cell_midpoints(mesh: dolfinx.mesh.Mesh) -> Array:
    """Return the midpoints of this rank's cells, including ghosts, (n_cells, gdim)."""
    midpoints: Array = mesh.geometry.x[compat.geometry_dofmap(mesh)].mean(axis=1)
    return midpoints[:, : mesh.geometry.dim]


def locate_nodes(space: fem.FunctionSpace) -> Array:
    """Return coordinates and mean midpoint of the cells of owned nodes, (n, 2 gdim). Collective."""
    gdim, dofmap = space.mesh.geometry.dim, space.dofmap
    n_owned = dofmap.index_map.size_local
    n_cells = space.mesh.topology.index_map(space.mesh.topology.dim).size_local
    cells, midpoints = dofmap.list[:n_cells], _cell_midpoints(space.mesh)[:n_cells]
    total = la.vector(dofmap.index_map, gdim + 1)
    sums = total.array.reshape(-1, gdim + 1)
    sums[:] = 0.0
    rows = np.column_stack([midpoints, np.ones(n_cells)])
    np.add.at(sums, cells.ravel(), np.repeat(rows, cells.shape[1], axis=0))
    total.scatter_reverse(la.InsertMode.add)
    mean = sums[:n_owned, :gdim] / sums[:n_owned, gdim:]
    return np.hstack([node_coordinates(space), mean])


def locate_points(contact: Contact) -> Array:
    """Return the coordinates of owned points and midpoint of their cell, (n, 2 gdim)."""
    surface, rows = contact.surface, contact.quadrature.point_rows
    cells = facet_cells(surface.mesh, surface.facets)
    midpoints = np.empty_like(contact.points)
    midpoints[rows] = _cell_midpoints(surface.mesh)[cells][:, None]
    return np.hstack([contact.points, midpoints])
