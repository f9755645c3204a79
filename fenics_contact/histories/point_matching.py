"""Values with where they belong, so that any number of ranks finds them again.

A place is that of a node or point, and the middle of the cells around it, which tells apart what
shares a place (two bodies that touch, the faces of a slit).
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
    "Part",
    "find",
    "gather",
    "layout_of",
    "n_shared",
    "node_places",
    "parts_of",
    "point_places",
    "positions",
    "rows_of",
    "set_rows",
    "unpack",
]


def layout_of(data: dict[str, Array]) -> list[tuple[str, int]]:
    """Names and numbers of components, 0 for scalars."""
    return [(name, array.shape[1] if array.ndim > 1 else 0) for name, array in data.items()]


def unpack(rows: Array, layout: Sequence[tuple[str, int]]) -> dict[str, Array]:
    """The columns of rows by name."""
    data, first = {}, 0
    for name, width in layout:
        data[name] = rows[:, first : first + width] if width else rows[:, first].copy()
        first += max(width, 1)
    return data


def gather(comm: MPI.Comm, places: Array, *values: Array | dict[str, Array]) -> Array:
    """Rows of places and values of all ranks on rank 0, nothing on the others. Collective.

    Args:
        comm: Of the ranks.
        places: Of this rank, (n, width).
        values: Columns at them, (n, n_values) each, or several by name.
    """
    columns = [places]
    for part in values:
        columns += part.values() if isinstance(part, dict) else [part]
    gathered = comm.gather(np.column_stack(columns))
    return np.zeros((0, 0)) if gathered is None else np.concatenate(gathered)


def find(comm: MPI.Comm, stored: StoredCheckpoint, name: str, places: Array, size: float) -> Array:
    """The stored values at given places, (n, n_values). Collective.

    Args:
        comm: Of the ranks.
        stored: Has rows of places and values under a name, as `gather` gave them.
        name: The name.
        places: Those of this rank, (n, width).
        size: Of the mesh (length).

    Raises:
        ValueError: The stored places are not those of all ranks, or two of them are the same. On
            all ranks.
    """
    table, width = stored.arrays[name], places.shape[1]
    counts = comm.allgather(len(places))
    missing, row = len(places), np.zeros(0, dtype=np.int64)
    if len(table):
        distance, row = scipy.spatial.cKDTree(table[:, :width]).query(places)
        missing = int(np.count_nonzero(distance > NEGLIGIBLE * size))
    missing = comm.allreduce(missing)
    if missing or len(table) != sum(counts):
        refuse(
            stored,
            [
                f"{name} is of another mesh, element or quadrature rule, {len(table)} places in "
                f"the file and {sum(counts)} here, of which {missing} are not in it"
            ],
        )
    used = np.concatenate(comm.allgather(row))
    if np.unique(used).size < used.size:
        refuse(stored, [f"{name} has several values at one place, which cannot be told apart"])
    return table[row, width:]


def n_shared(comm: MPI.Comm, places: Array, size: float) -> int:
    """How many places of all ranks are where another one is. Collective.

    Args:
        comm: Of the ranks.
        places: Of this rank, (n, width).
        size: See `find`.
    """
    every, found = gather(comm, places), 0
    if len(every):
        found = len(
            scipy.spatial.cKDTree(every).query_pairs(NEGLIGIBLE * size, output_type="ndarray")
        )
    return int(comm.bcast(found))


class Part(NamedTuple):
    """Of what is solved for: a space of its own, and the numbers of this rank's dofs."""

    name: str
    space: fem.FunctionSpace
    dofs: Indices


def parts_of(problem: ContactProblem) -> list[Part]:
    """The displacement first. Collective."""
    displacement = problem.displacement
    space, dofs = displacement.u.function_space, displacement.dofs
    if dofs is None:
        dofs = np.arange(displacement.n_owned, dtype=np.int32)
    found = [Part("nodes", space, dofs[: displacement.n_owned])]
    for number, (other, numbers) in enumerate(displacement.others, start=1):
        owned = other.dofmap.index_map.size_local * other.dofmap.index_map_bs
        found.append(Part(f"part {number}", other, numbers[:owned]))
    return found


def positions(space: fem.FunctionSpace) -> Array:
    """Coordinates of the owned nodes, (n, gdim).

    Raises:
        ValueError: Values are at no places.
    """
    gdim, dofmap = space.mesh.geometry.dim, space.dofmap
    n_owned = dofmap.index_map.size_local
    try:
        bubbles = space.element.basix_element.family == basix.ElementFamily.bubble
    except RuntimeError:  # a quadrature element has none
        bubbles = False
    if not bubbles:
        return space.tabulate_dof_coordinates()[:n_owned, :gdim]
    if dofmap.dof_layout.num_dofs != 1:
        raise ValueError(
            f"dofs of {space.ufl_element()} are not values at points, and cannot be identified on "
            "other ranks; use bubble elements with one function per cell"
        )
    cells = dofmap.list[:, 0]
    places = np.zeros((n_owned + dofmap.index_map.num_ghosts, gdim))
    places[cells] = _middles(space.mesh)[: len(cells)]
    return places[:n_owned]


def rows_of(field: fem.Function) -> Array:
    """Values at the owned nodes, (n_nodes, bs)."""
    dofmap = field.function_space.dofmap
    n_owned = dofmap.index_map.size_local
    return field.x.array.reshape(-1, dofmap.index_map_bs)[:n_owned]


def set_rows(field: fem.Function, rows: Array) -> None:
    """Set what `rows_of` gave. Collective."""
    rows_of(field)[:] = rows
    field.x.scatter_forward()


def _middles(mesh: dolfinx.mesh.Mesh) -> Array:
    """Middles of this rank's cells, ghosts included, (n_cells, gdim)."""
    middles: Array = mesh.geometry.x[compat.geometry_dofmap(mesh)].mean(axis=1)
    return middles[:, : mesh.geometry.dim]


def node_places(space: fem.FunctionSpace) -> Array:
    """Coordinates of the owned nodes and mean middle of their cells, (n, 2 gdim). Collective."""
    gdim, dofmap = space.mesh.geometry.dim, space.dofmap
    n_owned = dofmap.index_map.size_local
    n_cells = space.mesh.topology.index_map(space.mesh.topology.dim).size_local
    cells, middles = dofmap.list[:n_cells], _middles(space.mesh)[:n_cells]
    total = la.vector(dofmap.index_map, gdim + 1)
    sums = total.array.reshape(-1, gdim + 1)
    sums[:] = 0.0
    rows = np.column_stack([middles, np.ones(n_cells)])
    np.add.at(sums, cells.ravel(), np.repeat(rows, cells.shape[1], axis=0))
    total.scatter_reverse(la.InsertMode.add)
    mean = sums[:n_owned, :gdim] / sums[:n_owned, gdim:]
    return np.hstack([positions(space), mean])


def point_places(contact: Contact) -> Array:
    """Coordinates of the owned points and middle of their cell, (n, 2 gdim). Collective."""
    surface, rows = contact.surface, contact.quadrature.point_rows
    cells = facet_cells(surface.mesh, surface.facets)
    middles = np.empty_like(contact.points)
    middles[rows] = _middles(surface.mesh)[cells][:, None]
    return np.hstack([contact.points, middles])
