"""Checkpoints: the committed state of a problem in a file, from which another run can continue.

The file is an archive of NumPy arrays. DOLFINx's own writers (ADIOS2, HDF5) store functions on the
cells of a mesh, but the history is defined at quadrature points of facets. Every value is stored
with its location (`point_matching`), and with a fingerprint of the problem (`fingerprint`).
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
    compare_data,
    compare_model,
    describe_data,
    describe_model,
    point_data,
    probe,
)
from fenics_contact.histories.point_matching import (
    column_layout,
    count_coincident,
    gather,
    locate_nodes,
    locate_points,
    match_values,
    nodal_values,
    node_coordinates,
    set_nodal_values,
    split_columns,
    split_unknowns,
)
from fenics_contact.histories.restart import at_state, committed_rows, continue_from_rows
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
    "load_restart",
    "read",
    "save",
]

logger = logging.getLogger("fenics_contact")


def exists(problem: ContactProblem, path: str | Path) -> bool:
    """Return whether a file of that name exists on rank 0. Collective."""
    comm = problem.u.function_space.mesh.comm
    file_exists = None
    with collective_errors(comm):
        if comm.rank == 0:
            file_exists = Path(path).exists()
    return bool(comm.bcast(file_exists))


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
    rows = _convert_units(problem, committed_rows(problem))
    updated = [contact.contact_kinematics.updates_pairs for contact in problem.contacts]
    arrays = {
        "numbers": np.array(numbers, dtype=np.float64),
        "state": np.array([problem.increment, problem.expected_increments, *updated], np.float64),
        "motions": np.stack([problem.full.unknowns.motions(row) for row in rows]),
        **probe(problem),
    }
    for part in split_unknowns(problem):
        nodes = rows[:, part.dofs].reshape(len(rows), -1, part.space.dofmap.bs)
        arrays[part.name] = gather(comm, locate_nodes(part.space), *nodes)
    scene: dict[str, Any] = {"format": FORMAT, "notes": notes, "contacts": {}}
    scene["fixed"], scene["data"] = describe_model(problem, state_fields), describe_data(problem)
    for contact in problem.contacts:
        data, values = point_data(contact), dict(contact.values.arrays)
        scene["contacts"][contact.name] = column_layout(data), column_layout(values)
        points = locate_points(contact)
        arrays[f"contact {contact.name}"] = gather(comm, points, contact.history.rows(), data)
        arrays[f"values {contact.name}"] = gather(comm, points, values)
    for number, field in enumerate(state_fields):
        locations = locate_nodes(field.function_space)
        arrays[f"field {number}"] = gather(comm, locations, nodal_values(field))
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
    load_restart(problem, stored, state_fields=state_fields, on_mismatch=on_mismatch)
    return stored.numbers


def check_mismatch(on_mismatch: str) -> None:
    """Raise ValueError unless ``on_mismatch`` is "refuse" or "continue"."""
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
            is_collapsed = field.x.array.size == n_nodes * dofmap.index_map_bs
            has_nodal_dofs = is_collapsed and dofmap.bs == dofmap.index_map_bs
            node_coordinates(space)
        except (RuntimeError, ValueError):
            has_nodal_dofs = False
        if not has_nodal_dofs:
            raise ValueError(
                f"{what} is in {space.ufl_element()}, whose dofs are not values at points; "
                "interpolate it to a Lagrange or quadrature space, and parts of a mixed function "
                "separately"
            )


_problems_with_distinct_nodes: weakref.WeakSet[ContactProblem] = weakref.WeakSet()


def check_places(problem: ContactProblem) -> None:
    """Check that nodes can be identified by their coordinates and cells. Collective.

    Raises:
        ValueError: Two nodes coincide, in cells that coincide; raised on all ranks.
    """
    if problem in _problems_with_distinct_nodes:
        return
    comm = problem.u.function_space.mesh.comm
    locations = locate_nodes(split_unknowns(problem)[0].space)
    n_equal = count_coincident(comm, locations, problem.full.scales.mesh_size)
    if n_equal:
        raise ValueError(
            f"{n_equal} nodes of the mesh coincide with others, in cells that coincide, so that a "
            "checkpoint could not distinguish their values; remove the duplicate cells, or use no "
            "checkpoint"
        )
    _problems_with_distinct_nodes.add(problem)


def read(problem: ContactProblem, path: str | Path) -> StoredCheckpoint:
    """Read a checkpoint file and check its integrity. Collective.

    Raises:
        ValueError: The file is damaged, or no checkpoint; raised on all ranks.
        OSError: The file cannot be read; raised on all ranks.
    """
    comm, path = problem.u.function_space.mesh.comm, Path(path)
    content = None
    with collective_errors(comm):
        if comm.rank == 0:
            content = read_file(path)
    scene, arrays = comm.bcast(content)
    return StoredCheckpoint(path, scene, arrays)


def load_restart(
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
    refuse(stored, compare_model(stored, problem, state_fields))
    size = problem.full.scales.mesh_size
    motions = stored.arrays["motions"]
    rows = np.zeros((len(motions), problem.full.unknowns.n_dofs))
    for part in split_unknowns(problem):
        nodes = match_values(comm, stored, part.name, locate_nodes(part.space), size)
        width = nodes.shape[1] // len(motions)
        by_row = nodes.reshape(len(nodes), len(motions), width).swapaxes(0, 1)
        rows[:, part.dofs] = by_row.reshape(len(motions), len(nodes) * width)
    joined = (problem.full.unknowns.joined(row, motions[i]) for i, row in enumerate(rows))
    committed = _convert_units(problem, np.stack(list(joined)), back=True)
    points, given = [], []
    for contact in problem.contacts:
        locations, (data, layout) = locate_points(contact), stored.scene["contacts"][contact.name]
        matched = match_values(comm, stored, f"contact {contact.name}", locations, size)
        n_history = contact.history.rows().shape[1]
        given.append(split_columns(matched[:, n_history:], data))
        values = match_values(comm, stored, f"values {contact.name}", locations, size)
        points.append((matched[:, :n_history], split_columns(values, layout)))
    field_values = []
    for number, field in enumerate(state_fields):
        locations = locate_nodes(field.function_space)
        field_values.append(match_values(comm, stored, f"field {number}", locations, size))
    previous = [field.x.array.copy() for field in state_fields]
    try:
        if loads is not None:
            loads()
        for field, values_at_nodes in zip(state_fields, field_values, strict=True):
            set_nodal_values(field, values_at_nodes)
        with at_state(problem, committed[0]):
            differences = compare_data(stored, problem, committed, given)
        if on_mismatch == "refuse":
            refuse(
                stored,
                differences,
                ', or give on_mismatch="continue" to continue with the present data',
            )
    except BaseException as error:
        raise_collectively(comm, error)
        for field, array in zip(state_fields, previous, strict=True):
            field.x.array[:] = array
        raise
    if differences and comm.rank == 0:
        logger.warning(
            "continuing from %s with changed data: %s", stored.path, "; ".join(differences)
        )
    continue_from_rows(problem, committed, stored.arrays["state"], points)


def _convert_units(problem: ContactProblem, rows: Array, *, back: bool = False) -> Array:
    """Convert rows of a committed state at dofs to the user's units, or ``back`` from them."""
    bulk, n, converted = problem.full.bulk, problem.full.unknowns.n_dofs, rows.copy()
    for i in range(5):  # two rows of displacements, three of forces
        convert = bulk.from_units if (i < 2) != back else bulk.in_units
        converted[i, :n] = convert(rows[i, :n])
    return converted
