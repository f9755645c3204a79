"""Checkpoints: the committed state of a problem in a file, from which another run can continue.

The file is an archive of NumPy arrays. DOLFINx's own writers (ADIOS2, HDF5) store functions on the
cells of a mesh, but the history is defined at quadrature points of facets. Every value is stored
with its location (`places`), together with a fingerprint of the problem (`fingerprint`).
"""

from __future__ import annotations

import logging
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from dolfinx import fem
from mpi4py import MPI

from fenics_contact.histories.checkpoint_file import (
    FORMAT,
    StoredCheckpoint,
    check_finite,
    read_file,
    refuse,
    write_file,
)
from fenics_contact.histories.fingerprint import (
    changed_data,
    data_of,
    data_words,
    fixed_words,
    probe,
    why_another_scene,
)
from fenics_contact.histories.point_matching import (
    find,
    gather,
    layout_of,
    n_shared,
    node_places,
    parts_of,
    point_places,
    positions,
    rows_of,
    set_rows,
    unpack,
)
from fenics_contact.parallel import collective_errors, raise_collectively
from fenics_contact.problem import ContactProblem
from fenics_contact.types import Array

__all__ = [
    "StoredCheckpoint",
    "check_fields",
    "check_mismatch",
    "check_places",
    "exists",
    "load",
    "read",
    "save",
    "take_up",
]

logger = logging.getLogger("fenics_contact")


def exists(problem: ContactProblem, path: str | Path) -> bool:
    """Return whether a file of that name exists on rank 0. Collective."""
    comm = problem.u.function_space.mesh.comm
    found = None
    with collective_errors(comm):
        if comm.rank == 0:
            found = Path(path).exists()
    return bool(comm.bcast(found))


def save(
    problem: ContactProblem,
    path: str | Path,
    numbers: Sequence[float] = (),
    *,
    state_fields: Sequence[fem.Function] = (),
    notes: Any = None,
) -> None:
    """Write the committed state, with the present loads. Collective.

    The file is written under another name and then renamed, so that it is always complete. Solver
    data of earlier increments are discarded, so that this run and one that continues from the file
    have identical results (on several ranks, to the solver's tolerance, because the order of
    summation in MUMPS varies).

    Args:
        problem: A problem in its committed state.
        path: Name of the file (``.npz``).
        numbers: Numbers of the caller that `load` returns, such as the load parameter.
        state_fields: Functions of the caller that belong to the state: real values at points, in
            Lagrange or quadrature spaces on the mesh or a submesh of it.
        notes: Additional data of the caller, serialisable as JSON.

    Raises:
        ValueError: An increment is solved but not committed, the state is not finite, a function
            cannot be saved, or two nodes of the mesh coincide; raised on all ranks.
        OSError: The file cannot be written; the problem is unchanged. Raised on all ranks.
    """
    comm = problem.u.function_space.mesh.comm
    check_fields(problem, state_fields)
    check_places(problem)
    rows = _in_units(problem, problem.committed_rows())
    anew = [contact.contact_kinematics.updates_pairs for contact in problem.contacts]
    arrays = {
        "numbers": np.array(numbers, dtype=np.float64),
        "state": np.array([problem.increment, problem.expected_increments, *anew], np.float64),
        "motions": np.stack([problem.full.unknowns.motions(row) for row in rows]),
        **probe(problem),
    }
    for part in parts_of(problem):
        nodes = rows[:, part.dofs].reshape(len(rows), -1, part.space.dofmap.bs)
        arrays[part.name] = gather(comm, node_places(part.space), *nodes)
    scene: dict[str, Any] = {"format": FORMAT, "notes": notes, "contacts": {}}
    scene["fixed"], scene["data"] = fixed_words(problem, state_fields), data_words(problem)
    for contact in problem.contacts:
        data, values = data_of(contact), dict(contact.values.arrays)
        scene["contacts"][contact.name] = layout_of(data), layout_of(values)
        places = point_places(contact)
        arrays[f"contact {contact.name}"] = gather(comm, places, contact.history.rows(), data)
        arrays[f"values {contact.name}"] = gather(comm, places, values)
    for number, field in enumerate(state_fields):
        arrays[f"field {number}"] = gather(comm, node_places(field.function_space), rows_of(field))
    with collective_errors(comm):
        if comm.rank == 0:
            for name, array in arrays.items():
                check_finite(name, array, "the committed state is invalid and was not saved")
            write_file(Path(path), scene, arrays)
    problem.restart_solver()


def load(
    problem: ContactProblem,
    path: str | Path,
    *,
    state_fields: Sequence[fem.Function] = (),
    on_mismatch: str = "refuse",
) -> list[float]:
    """Load a saved state as the committed one. Collective.

    Loads, conditions and obstacles must be set as they were when it was saved; they are compared.

    Args:
        problem: A new problem like the one that was saved.
        path: Name of the file.
        state_fields: The functions given to `save`, in the same order; their values are set.
        on_mismatch: What to do if the file has other data (stiffness, laws and parameters,
            obstacles, conditions, loads): "refuse" it with an error, or "continue" with the data of
            the problem.

    Returns:
        The numbers given to `save`.

    Raises:
        ValueError: The file is damaged, no checkpoint, or of another mesh, element, quadrature
            rule, set of contacts or data; the problem is unchanged. Raised on all ranks.
        OSError: The file cannot be read; raised on all ranks.
    """
    check_mismatch(on_mismatch)
    stored = read(problem, path)
    take_up(problem, stored, state_fields=state_fields, on_mismatch=on_mismatch)
    return stored.numbers


def check_mismatch(on_mismatch: str) -> None:
    """Check that ``on_mismatch`` is "refuse" or "continue".

    Raises:
        ValueError: It is neither.
    """
    if on_mismatch not in ("refuse", "continue"):
        raise ValueError(f'on_mismatch is {on_mismatch!r}; it must be "refuse" or "continue"')


def check_fields(problem: ContactProblem, state_fields: Sequence[fem.Function]) -> None:
    """Check that functions can be saved with the state. Collective.

    Their dofs must be real values at points (Lagrange elements of any degree, continuous or not,
    and quadrature elements; scalar or blocked), on the mesh or a submesh of it.

    Raises:
        ValueError: A function cannot be saved; raised on all ranks.
    """
    comm = problem.u.function_space.mesh.comm
    for number, field in enumerate(state_fields):
        if not isinstance(field, fem.Function):
            raise ValueError(
                f"state_fields[{number}] is a {type(field).__name__}; it must be a fem.Function"
            )
        what, space = f"state_fields[{number}], {field.name!r},", field.function_space
        dofmap = space.dofmap
        n_nodes = dofmap.index_map.size_local + dofmap.index_map.num_ghosts
        if field is problem.u:
            raise ValueError(f"{what} is the displacement, which is always saved; omit it")
        if field.x.array.dtype != np.float64:
            raise ValueError(f"{what} has values of type {field.x.array.dtype}; use float64")
        if MPI.Comm.Compare(space.mesh.comm, comm) not in (MPI.IDENT, MPI.CONGRUENT):
            raise ValueError(f"{what} is on a mesh with another communicator; use the problem's")
        try:
            space.tabulate_dof_coordinates()
            whole = field.x.array.size == n_nodes * dofmap.index_map_bs
            pointwise = whole and dofmap.bs == dofmap.index_map_bs
            positions(space)
        except (RuntimeError, ValueError):
            pointwise = False
        if not pointwise:
            raise ValueError(
                f"{what} is in {space.ufl_element()}, whose dofs are not values at points; "
                "interpolate it to a Lagrange or quadrature space, and parts of a mixed function "
                "separately"
            )


_told_apart: weakref.WeakSet[ContactProblem] = weakref.WeakSet()


def check_places(problem: ContactProblem) -> None:
    """Check that the nodes of the mesh can be identified by their coordinates and cells.

    Collective.

    Raises:
        ValueError: Two nodes coincide, in cells that coincide; raised on all ranks.
    """
    if problem in _told_apart:
        return
    comm = problem.u.function_space.mesh.comm
    shared = n_shared(comm, node_places(parts_of(problem)[0].space), problem.full.scales.mesh_size)
    if shared:
        raise ValueError(
            f"{shared} nodes of the mesh coincide with others, in cells that coincide, so that a "
            "checkpoint could not distinguish their values; remove the duplicate cells, or use no "
            "checkpoint"
        )
    _told_apart.add(problem)


def read(problem: ContactProblem, path: str | Path) -> StoredCheckpoint:
    """Read a checkpoint file and check its integrity. Collective.

    Raises:
        ValueError: The file is damaged, or no checkpoint; raised on all ranks.
        OSError: The file cannot be read; raised on all ranks.
    """
    comm, path = problem.u.function_space.mesh.comm, Path(path)
    found = None
    with collective_errors(comm):
        if comm.rank == 0:
            found = read_file(path)
    scene, arrays = comm.bcast(found)
    return StoredCheckpoint(path, scene, arrays)


def take_up(
    problem: ContactProblem,
    stored: StoredCheckpoint,
    *,
    loads: Callable[[], None] | None = None,
    state_fields: Sequence[fem.Function] = (),
    on_mismatch: str = "refuse",
) -> None:
    """Make a state that `read` returned the committed one. Collective.

    Everything is checked before anything is set.

    Args:
        problem: A new problem like the one that was saved.
        stored: The state.
        loads: Function that sets the loads of that state. It is called after the file has been
            identified; if an error follows, the caller has to reset the loads.
        state_fields: The functions given to `save`, in the same order; their values are set.
        on_mismatch: "refuse" a file with other data, or "continue" with the data of the problem.

    Raises:
        ValueError: The file is of another mesh, element, quadrature rule, set of contacts or data;
            the problem is unchanged. Raised on all ranks.
    """
    comm = problem.u.function_space.mesh.comm
    check_fields(problem, state_fields)
    refuse(stored, why_another_scene(stored, problem, state_fields))
    size = problem.full.scales.mesh_size
    motions = stored.arrays["motions"]
    rows = np.zeros((len(motions), problem.full.unknowns.n_dofs))
    for part in parts_of(problem):
        nodes = find(comm, stored, part.name, node_places(part.space), size)
        # A rank may have no nodes, of which no shape can be told.
        width = nodes.shape[1] // len(motions)
        by_row = nodes.reshape(len(nodes), len(motions), width).swapaxes(0, 1)
        rows[:, part.dofs] = by_row.reshape(len(motions), len(nodes) * width)
    joined = (problem.full.unknowns.joined(row, motions[i]) for i, row in enumerate(rows))
    committed = _in_units(problem, np.stack(list(joined)), back=True)
    points, given = [], []
    for contact in problem.contacts:
        places, (data, layout) = point_places(contact), stored.scene["contacts"][contact.name]
        found = find(comm, stored, f"contact {contact.name}", places, size)
        n_history = contact.history.rows().shape[1]
        given.append(unpack(found[:, n_history:], data))
        values = unpack(find(comm, stored, f"values {contact.name}", places, size), layout)
        points.append((found[:, :n_history], values))
    own = []
    for number, field in enumerate(state_fields):
        places = node_places(field.function_space)
        own.append(find(comm, stored, f"field {number}", places, size))
    before = [field.x.array.copy() for field in state_fields]
    try:
        if loads is not None:
            loads()
        for field, row in zip(state_fields, own, strict=True):
            set_rows(field, row)
        with problem.at_state(committed[0]):
            differences = changed_data(stored, problem, committed, given)
        if on_mismatch == "refuse":
            refuse(
                stored,
                differences,
                ', or give on_mismatch="continue" to continue with the present data',
            )
    except BaseException as error:
        raise_collectively(comm, error)
        for field, array in zip(state_fields, before, strict=True):
            field.x.array[:] = array
        raise
    if differences and comm.rank == 0:
        logger.warning(
            "continuing from %s with changed data: %s", stored.path, "; ".join(differences)
        )
    problem.set_committed(committed, stored.arrays["state"], points)


def _in_units(problem: ContactProblem, rows: Array, *, back: bool = False) -> Array:
    """Rows of a committed state, those at dofs in the user's units, or ``back`` from them."""
    bulk, n, found = problem.full.bulk, problem.full.unknowns.n_dofs, rows.copy()
    for i in range(5):  # two rows of displacements, three of forces
        convert = bulk.from_units if (i < 2) != back else bulk.in_units
        found[i, :n] = convert(rows[i, :n])
    return found
