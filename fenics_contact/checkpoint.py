"""The committed state of a problem in a file, to go on from after whatever ended the run.

The file is an archive of NumPy arrays. DOLFINx's own writers (ADIOS2, HDF5) carry functions on the
cells of a mesh; the history lives at quadrature points of facets, for which they have no format.
Every value is stored with where it belongs, so that any number of ranks finds it again: the place
of its node or point, and the middle of the cells around it, which tells apart what shares a place
(two bodies that touch, the faces of a slit).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import dolfinx
import numpy as np
import numpy.typing as npt
import scipy.spatial
from dolfinx import fem, la
from mpi4py import MPI

from fenics_contact import files
from fenics_contact.contact import Contact
from fenics_contact.facets import facet_cells
from fenics_contact.parallel import collective_errors, gather_rows
from fenics_contact.problem import ContactProblem

__all__ = ["exists", "load", "save"]

Array = npt.NDArray[np.float64]

# Distance, relative to the mesh, within which a place is found again: computed on other ranks its
# coordinates differ by round-off.
_SAME = 1e-9


def exists(problem: ContactProblem, path: str | Path) -> bool:
    """Whether there is such a file, as rank 0 sees it. Collective."""
    comm = problem.u.function_space.mesh.comm
    return bool(comm.bcast(Path(path).is_file() if comm.rank == 0 else None))


def save(problem: ContactProblem, path: str | Path, numbers: Sequence[float] = ()) -> None:
    """Write the committed state. Collective.

    The file is complete or as before, whenever the program is ended: it is written under another
    name, and then renamed. What the solver knows from earlier increments is dropped, here as in a
    program that starts from the file, so that both go on with the same digits (on several ranks
    to the solver's tolerance: there MUMPS adds in the order in which messages come).

    Args:
        problem: At a committed state.
        path: The file (``.npz``).
        numbers: The caller's own, to be found again: the load parameter, for instance.

    Raises:
        OSError: It cannot be written; the problem is as before. On all ranks.
    """
    comm = problem.u.function_space.mesh.comm
    state, rate = problem.committed_state()
    arrays = {
        "numbers": np.array([problem.increment, *numbers]),
        "motions": np.stack([problem.unknowns.motions(v) for v in (state, rate)]),
        "nodes": _gather(problem, _node_places(problem.u.function_space), [state, rate]),
    }
    for contact in problem.contacts:
        rows = np.hstack([_point_places(contact), contact.history.rows()])
        arrays[f"contact {contact.name}"] = gather_rows(comm, rows)
    path = Path(path)
    with collective_errors(comm):
        if comm.rank == 0:
            _write(path, arrays)
    problem.restart_solver()


def load(problem: ContactProblem, path: str | Path) -> list[float]:
    """Make a saved state the committed one. Collective.

    Returns:
        The caller's numbers. To set the loads as they were is the caller's, too.

    Raises:
        ValueError: The file is that of another mesh, element, rule or set of contacts.
        OSError: It cannot be read.
    """
    space = problem.u.function_space
    comm = space.mesh.comm
    arrays: dict[str, Array] = {}
    with collective_errors(comm):
        if comm.rank == 0:
            with np.load(path, allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in archive.files}
    arrays = comm.bcast(arrays)
    wanted = {f"contact {c.name}" for c in problem.contacts} | {"numbers", "motions", "nodes"}
    if set(arrays) != wanted:
        raise ValueError(
            f"{path} holds {sorted(arrays)}, this problem has {sorted(wanted)}: it is the file of "
            "another problem; remove it to start anew"
        )
    size = problem.motions.size
    nodes = _find(comm, arrays["nodes"], _node_places(space), size, path)
    dofs = nodes.reshape(len(nodes), 2, -1)
    state, rate = (
        problem.unknowns.joined(dofs[:, i].ravel(), arrays["motions"][i]) for i in range(2)
    )
    for contact in problem.contacts:
        stored = arrays[f"contact {contact.name}"]
        rows = _find(comm, stored, _point_places(contact), size, path)
        contact.history.set_rows(rows)
    increment, *numbers = (float(value) for value in arrays["numbers"])
    problem.set_committed(state, rate, int(increment))
    return numbers


def _write(path: Path, arrays: dict[str, Array]) -> None:
    """Write the archive and put it in place."""
    with files.replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def _gather(problem: ContactProblem, places: Array, values: list[Array]) -> Array:
    """Rows of place and values of all owned nodes."""
    n_dofs, n_nodes = problem.unknowns.n_dofs, len(places)
    columns = [v[:n_dofs].reshape(n_nodes, -1) for v in values]
    return gather_rows(problem.u.function_space.mesh.comm, np.hstack([places, *columns]))


def _find(comm: MPI.Comm, stored: Array, places: Array, size: float, path: str | Path) -> Array:
    """The stored values at given places, (n, n_values). Collective."""
    width = places.shape[1]
    missing, row = len(places), np.zeros(0, dtype=np.int64)
    if stored.shape[1] > width and len(stored):
        distance, row = scipy.spatial.cKDTree(stored[:, :width]).query(places)
        missing = int(np.count_nonzero(distance > _SAME * size))
    missing = comm.allreduce(missing)
    if missing:
        raise ValueError(
            f"{path} is of another mesh, element or quadrature rule: {missing} places of this "
            "problem are not in it; remove it to start anew"
        )
    return stored[row, width:]


def _middles(mesh: dolfinx.mesh.Mesh) -> Array:
    """Middles of this rank's cells, ghosts included, (n_cells, gdim)."""
    return mesh.geometry.x[mesh.geometry.dofmap].mean(axis=1)[:, : mesh.geometry.dim]


def _node_places(space: fem.FunctionSpace) -> Array:
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
    return np.hstack([space.tabulate_dof_coordinates()[:n_owned, :gdim], mean])


def _point_places(contact: Contact) -> Array:
    """Coordinates of the owned points and middle of their cell, (n, 2 gdim). Collective."""
    surface, rows = contact.surface, contact.quadrature.point_rows()
    cells = facet_cells(surface.mesh, surface.facets)
    middles = np.empty_like(contact.points)
    middles[rows] = _middles(surface.mesh)[cells][:, None]
    return np.hstack([contact.points, middles])
