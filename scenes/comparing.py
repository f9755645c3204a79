"""What is found on all ranks, and comparisons that fail on all of them together.

Every assertion looks at gathered data: a rank that failed alone would leave the others waiting.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import dolfinx
import dolfinx.fem.petsc
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from fenics_contact.compiling import compile_form
from fenics_contact.types import Array

# ---- assembly ------------------------------------------------------------------------------------


def compiled(form: ufl.Form, contact: fc.Contact | None = None) -> fem.Form:
    """The form as DOLFINx has it, with the entity maps that a contact's own forms take."""
    return compile_form(form, contact.entity_maps if contact else None)


def assemble_number(form: fem.Form, comm: MPI.Comm) -> float:
    """The number that a form without arguments is, on all ranks."""
    return comm.allreduce(fem.assemble_scalar(form))


def assemble_owned(form: fem.Form, space: fem.FunctionSpace) -> Array:
    """Assembled linear form at this rank's owned dofs."""
    f = fem.Function(space)
    fem.assemble_vector(f.x.array, form)
    f.x.scatter_reverse(dolfinx.la.InsertMode.add)
    return owned(f).copy()


def assemble_matrix(form: fem.Form) -> PETSc.Mat:
    """A bilinear form without conditions."""
    matrix = fem.petsc.create_matrix(form)
    fem.petsc.assemble_matrix(matrix, form)
    matrix.assemble()
    return matrix


def owned(f: fem.Function) -> Array:
    """Values at this rank's owned dofs."""
    dofmap = f.function_space.dofmap
    return f.x.array[: dofmap.index_map.size_local * dofmap.index_map_bs]


def set_owned(f: fem.Function, values: Array) -> None:
    """Set these values, and the ghosts with them."""
    owned(f)[:] = values
    f.x.scatter_forward()


def shared_folder(tmp_path: Path) -> Path:
    """Rank 0's folder, on all ranks."""
    return Path(MPI.COMM_WORLD.bcast(str(tmp_path)))


# ---- comparisons ---------------------------------------------------------------------------------


def gathered(comm: MPI.Comm, rows: Array) -> Array:
    """The rows of all ranks on all ranks."""
    return np.concatenate(comm.allgather(np.asarray(rows)), axis=0)


def sorted_by_place(places: Array, *columns: Array) -> Array:
    """Rows (place, columns) in the order of the places, to 1e-9 of their extent.

    For comparisons between meshes: two equal ones may be distributed differently.
    """
    size = float(np.abs(places).max(initial=0.0)) or 1.0
    order = np.lexsort(np.round(places / size, 9).T)
    return np.column_stack([places, *columns])[order]


def nodal(u: fem.Function) -> Array:
    """Values (all nodes, bs) at the owned nodes of all ranks, in the order of their places."""
    space = u.function_space
    d, bs = space.mesh.geometry.dim, space.dofmap.index_map_bs
    n = space.dofmap.index_map.size_local
    x, values = space.tabulate_dof_coordinates()[:n, :d], u.x.array.reshape(-1, bs)[:n]
    comm = space.mesh.comm
    return sorted_by_place(gathered(comm, x), gathered(comm, values))[:, d:]


def at_points(contact: fc.Contact, rows: Array) -> Array:
    """Rows (points, …) of all ranks, in the order of the points' places."""
    comm = contact.surface.mesh.comm
    d = contact.points.shape[1]
    return sorted_by_place(gathered(comm, contact.points), gathered(comm, rows))[:, d:]


def close(actual: Any, expected: Any, rtol: float, *, scale: float | None = None) -> bool:
    """Largest difference within ``rtol`` of the largest expected entry (or ``scale``)."""
    actual, expected = np.asarray(actual, dtype=float), np.asarray(expected, dtype=float)
    assert actual.shape == expected.shape
    if not actual.size:
        return True
    scale = float(np.abs(expected).max()) if scale is None else scale
    error = float(np.abs(actual - expected).max())
    if not error <= rtol * scale:
        print(f"largest difference {error:.3e} at scale {scale:.3e}: {error / scale:.3e}")
        return False
    return True


def identical(a: Iterable[Array], b: Iterable[Array]) -> bool:
    """Bit for bit, on all ranks."""
    same = all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))
    return bool(np.all(MPI.COMM_WORLD.allgather(same)))


def on_first(check: Callable[[], None]) -> None:
    """Run it on the first rank, fail on all of them. Collective."""
    error, comm = None, MPI.COMM_WORLD
    if comm.rank == 0:
        try:
            check()
        except AssertionError as caught:
            error = str(caught) or repr(caught)
    assert comm.bcast(error) is None


def raised_everywhere(
    call: Callable[[], Any],
    kind: type[Exception] | tuple[type[Exception], ...],
    *words: str,
    comm: MPI.Comm = MPI.COMM_WORLD,
) -> str:
    """Assert that every rank raises ``kind`` and that the text names all of ``words``."""
    error: Exception | None = None
    try:
        call()
    except Exception as caught:
        error = caught
    reports = comm.allgather(None if error is None else (type(error).__name__, str(error)))
    assert all(report is not None for report in reports), f"not raised on all ranks: {reports}"
    flags = comm.allgather(isinstance(error, kind))
    assert all(flags), f"wrong kind of error: {reports}"
    for word in words:
        assert all(word in text for _, text in reports), f"{word!r} is not named in {reports}"
    assert len({text for _, text in reports}) == 1, f"the ranks tell different stories: {reports}"
    return reports[0][1]


def same_field(
    f: fem.Function, expected: Callable[[Array], Array], rtol: float, *, scale: float | None = None
) -> bool:
    """Whether ``f`` is the interpolant of ``expected``, all ranks together."""
    reference = fem.Function(f.function_space)
    reference.interpolate(expected)
    comm = f.function_space.mesh.comm
    return close(gathered(comm, owned(f)), gathered(comm, owned(reference)), rtol, scale=scale)


def same_effort(iterations: Sequence[int], others: Sequence[int]) -> bool:
    """Whether as many increments took as many iterations each, but for one.

    By round-off the last iteration is just enough, or just not; what else makes more or fewer of
    them, as units in a setting of the solver, makes many.
    """
    return len(iterations) == len(others) and all(
        abs(a - b) <= 1 for a, b in zip(iterations, others, strict=True)
    )
