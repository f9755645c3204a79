"""The committed state of a problem in a file, to go on from after whatever ended the run.

The file is an archive of NumPy arrays. DOLFINx's own writers (ADIOS2, HDF5) carry functions on the
cells of a mesh; the history lives at quadrature points of facets, for which they have no format.
Every value is stored with where it belongs (`places`), and with the state goes a fingerprint of the
scene (`fingerprint`).
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

from fenics_contact.histories.archive import (
    FORMAT,
    Stored,
    check_finite,
    read_file,
    refuse,
    write_file,
)
from fenics_contact.histories.fingerprint import (
    changed_data,
    data_words,
    fixed_words,
    probe,
    why_another_scene,
)
from fenics_contact.histories.places import (
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
from fenics_contact.parallel import collective_errors, fail_together
from fenics_contact.problem import ContactProblem
from fenics_contact.systems.committed import CommittedState

__all__ = [
    "Stored",
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
    """Whether there is something of that name, as rank 0 sees it. Collective."""
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
    """Write the committed state, with the loads as they are now. Collective.

    The file is complete or as before, whenever the program is ended: it is written under another
    name, and then renamed. What the solver knows from earlier increments is dropped, here as in a
    program that starts from the file, so that both go on with the same digits (on several ranks
    to the solver's tolerance: there MUMPS adds in the order in which messages come).

    Args:
        problem: At a committed state.
        path: The file (``.npz``).
        numbers: The caller's own, to be found again: the load parameter, for instance.
        state_fields: The caller's functions that belong to the state; see `check_fields`.
        notes: More of the caller's, of what JSON can hold.

    Raises:
        ValueError: The problem has a solved increment that is not committed, or a state that is
            not finite; or see `check_fields` and `check_places`.
        OSError: It cannot be written; the problem is as before. On all ranks.
    """
    comm = problem.u.function_space.mesh.comm
    check_fields(problem, state_fields)
    check_places(problem)
    committed = problem.committed_state()
    rows = committed.rows(problem.unknowns, problem.bulk)
    arrays = {
        "numbers": np.array(numbers, dtype=np.float64),
        "state": committed.numbers,
        "motions": np.stack([problem.unknowns.motions(row) for row in rows]),
        **probe(problem),
    }
    for part in parts_of(problem):
        nodes = rows[:, part.dofs].reshape(len(rows), -1, part.space.dofmap.bs)
        arrays[part.name] = gather(comm, node_places(part.space), *nodes)
    scene: dict[str, Any] = {"format": FORMAT, "notes": notes, "contacts": {}}
    scene["fixed"], scene["data"] = fixed_words(problem, state_fields), data_words(problem)
    for contact in problem.contacts:
        given, values = contact.given(), dict(contact.values.arrays)
        scene["contacts"][contact.name] = layout_of(given), layout_of(values)
        places = point_places(contact)
        arrays[f"contact {contact.name}"] = gather(comm, places, contact.history.rows(), given)
        arrays[f"values {contact.name}"] = gather(comm, places, values)
    for number, field in enumerate(state_fields):
        arrays[f"field {number}"] = gather(comm, node_places(field.function_space), rows_of(field))
    with collective_errors(comm):
        if comm.rank == 0:
            for name, array in arrays.items():
                check_finite(name, array, "the committed state is none; nothing is saved")
            write_file(Path(path), scene, arrays)
    problem.restart_solver()


def load(
    problem: ContactProblem,
    path: str | Path,
    *,
    state_fields: Sequence[fem.Function] = (),
    on_mismatch: str = "refuse",
) -> list[float]:
    """Make a saved state the committed one. Collective.

    The loads, conditions and obstacles must be set as they were: they are compared.

    Args:
        problem: That of the file, made anew.
        path: The file.
        state_fields: Those that were given to `save`, to be set; in the same order.
        on_mismatch: "refuse" a file whose state is one of other data than the problem's (stiffness,
            laws and their parameters, obstacles, conditions, loads), or "continue" from it with the
            data of the problem.

    Returns:
        The caller's numbers.

    Raises:
        ValueError: The file is damaged, none of `save`, or that of another mesh, element, rule or
            set of contacts, or of other data; the problem is as before. On all ranks.
        OSError: It cannot be read. On all ranks.
    """
    check_mismatch(on_mismatch)
    stored = read(problem, path)
    take_up(problem, stored, state_fields=state_fields, on_mismatch=on_mismatch)
    return stored.numbers


def check_mismatch(on_mismatch: str) -> None:
    """Refuse words that are none of the two.

    Raises:
        ValueError: It says which there are.
    """
    if on_mismatch not in ("refuse", "continue"):
        raise ValueError(f'on_mismatch is {on_mismatch!r}; it must be "refuse" or "continue"')


def check_fields(problem: ContactProblem, state_fields: Sequence[fem.Function]) -> None:
    """Refuse what cannot be saved with the state. Collective.

    That is every function but those of real values at points (Lagrange of any degree, continuous
    or not, quadrature elements; scalar or blocked), on the mesh or a submesh of it.

    Raises:
        ValueError: It names the field. On all ranks.
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
            raise ValueError(
                f"{what} is the function of the displacement, which is saved by itself"
            )
        if field.x.array.dtype != np.float64:
            raise ValueError(f"{what} has values of type {field.x.array.dtype}; save float64")
        if MPI.Comm.Compare(space.mesh.comm, comm) not in (MPI.IDENT, MPI.CONGRUENT):
            raise ValueError(f"{what} is on a mesh of other ranks than the problem's")
        try:
            space.tabulate_dof_coordinates()
            whole = field.x.array.size == n_nodes * dofmap.index_map_bs
            pointwise = whole and dofmap.bs == dofmap.index_map_bs
            positions(space)
        except (RuntimeError, ValueError):
            pointwise = False
        if not pointwise:
            raise ValueError(
                f"{what} is in {space.ufl_element()}, whose dofs are no values at points; "
                "interpolate it to a Lagrange or quadrature space, parts of a mixed one each into "
                "a function of its own"
            )


_told_apart: weakref.WeakSet[ContactProblem] = weakref.WeakSet()


def check_places(problem: ContactProblem) -> None:
    """Refuse a mesh whose nodes cannot be told apart by their places. Collective.

    Raises:
        ValueError: There are two nodes at one place with the same cells around. On all ranks.
    """
    if problem in _told_apart:
        return
    comm = problem.u.function_space.mesh.comm
    shared = n_shared(comm, node_places(parts_of(problem)[0].space), problem.full.scales.mesh_size)
    if shared:
        raise ValueError(
            f"{shared} nodes of the mesh are where others are, in cells that cover one another, so "
            "that a checkpoint could not tell their values apart; remove the cells that are there "
            "twice, or go without a checkpoint"
        )
    _told_apart.add(problem)


def read(problem: ContactProblem, path: str | Path) -> Stored:
    """Read and check a file by itself. Collective.

    Raises:
        ValueError: It is damaged, or none of `save`. On all ranks.
        OSError: It cannot be read. On all ranks.
    """
    comm, path = problem.u.function_space.mesh.comm, Path(path)
    found = None
    with collective_errors(comm):
        if comm.rank == 0:
            found = read_file(path)
    scene, arrays = comm.bcast(found)
    return Stored(path, scene, arrays)


def take_up(
    problem: ContactProblem,
    stored: Stored,
    *,
    loads: Callable[[], None] | None = None,
    state_fields: Sequence[fem.Function] = (),
    on_mismatch: str = "refuse",
) -> None:
    """Make what `read` gave the committed state. Collective.

    Everything is checked before anything is set.

    Args:
        problem: See `load`.
        stored: What was read.
        loads: Sets the loads as they were; called where the file may be that of the problem. If
            what follows fails, it is the caller's to take them back.
        state_fields: See `load`.
        on_mismatch: See `load`.

    Raises:
        ValueError: See `load`.
    """
    comm = problem.u.function_space.mesh.comm
    check_fields(problem, state_fields)
    refuse(stored, why_another_scene(stored, problem, state_fields))
    size = problem.full.scales.mesh_size
    motions = stored.arrays["motions"]
    rows = np.zeros((len(motions), problem.unknowns.n_dofs))
    for part in parts_of(problem):
        nodes = find(comm, stored, part.name, node_places(part.space), size)
        # A rank may have no nodes, of which no shape can be told.
        width = nodes.shape[1] // len(motions)
        by_row = nodes.reshape(len(nodes), len(motions), width).swapaxes(0, 1)
        rows[:, part.dofs] = by_row.reshape(len(motions), len(nodes) * width)
    joined = (problem.unknowns.joined(row, motions[i]) for i, row in enumerate(rows))
    committed = CommittedState.from_rows(
        np.stack(list(joined)), stored.arrays["state"], problem.unknowns, problem.bulk
    )
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
        with problem.at_state(committed.state):
            differences = changed_data(stored, problem, committed, given)
        if on_mismatch == "refuse":
            refuse(
                stored, differences, ', or give on_mismatch="continue" to go on with what is here'
            )
    except BaseException as error:
        fail_together(comm, error)
        for field, array in zip(state_fields, before, strict=True):
            field.x.array[:] = array
        raise
    if differences and comm.rank == 0:
        logger.warning(
            "going on from %s with changed data: %s", stored.path, "; ".join(differences)
        )
    problem.set_committed(committed, points)
