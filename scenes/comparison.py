"""Assembly on all ranks, and collective comparisons.

Assertions compare gathered data and fail on all ranks: a failure on one rank alone would leave the
others waiting.
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


def compile_with_maps(form: ufl.Form, contact: fc.Contact | None = None) -> fem.Form:
    """Return the compiled form, with the entity maps of the forms of the contact."""
    return compile_form(form, contact.entity_maps if contact else None)


def assemble_scalar(form: fem.Form, comm: MPI.Comm) -> float:
    """Return the integral of a form without arguments, summed over all ranks."""
    return comm.allreduce(fem.assemble_scalar(form))


def assemble_owned(form: fem.Form, space: fem.FunctionSpace) -> Array:
    """Return the assembled linear form at this rank's owned dofs."""
    f = fem.Function(space)
    fem.assemble_vector(f.x.array, form)
    f.x.scatter_reverse(dolfinx.la.InsertMode.add)
    return owned_values(f).copy()


def assemble_matrix(form: fem.Form) -> PETSc.Mat:
    """Return the matrix of a bilinear form without Dirichlet conditions."""
    matrix = fem.petsc.create_matrix(form)
    fem.petsc.assemble_matrix(matrix, form)
    matrix.assemble()
    return matrix


def owned_values(f: fem.Function) -> Array:
    """Return a view of the values at this rank's owned dofs."""
    dofmap = f.function_space.dofmap
    return f.x.array[: dofmap.index_map.size_local * dofmap.index_map_bs]


def set_owned(f: fem.Function, values: Array) -> None:
    """Set the values at the owned dofs, and update the ghosts."""
    owned_values(f)[:] = values
    f.x.scatter_forward()


def shared_folder(tmp_path: Path) -> Path:
    """Return the folder of rank 0 on all ranks."""
    return Path(MPI.COMM_WORLD.bcast(str(tmp_path)))


# ---- comparisons ---------------------------------------------------------------------------------


def gather(comm: MPI.Comm, rows: Array) -> Array:
    """Return the rows of all ranks, on all ranks."""
    return np.concatenate(comm.allgather(np.asarray(rows)), axis=0)


def sort_by_coordinates(places: Array, *columns: Array) -> Array:
    """Return rows (coordinates, columns) sorted by coordinates rounded to 1e-9 of the largest.

    Results on equal meshes with different distributions become comparable.
    """
    size = float(np.abs(places).max(initial=0.0)) or 1.0
    order = np.lexsort(np.round(places / size, 9).T)
    return np.column_stack([places, *columns])[order]


def nodal_values(u: fem.Function) -> Array:
    """Return values (all nodes, bs) of all ranks, sorted by the coordinates of the nodes."""
    space = u.function_space
    d, bs = space.mesh.geometry.dim, space.dofmap.index_map_bs
    n = space.dofmap.index_map.size_local
    x, values = space.tabulate_dof_coordinates()[:n, :d], u.x.array.reshape(-1, bs)[:n]
    comm = space.mesh.comm
    return sort_by_coordinates(gather(comm, x), gather(comm, values))[:, d:]


def point_values(contact: fc.Contact, rows: Array) -> Array:
    """Return rows (points, …) of all ranks, sorted by the coordinates of the points."""
    comm = contact.surface.mesh.comm
    d = contact.points.shape[1]
    return sort_by_coordinates(gather(comm, contact.points), gather(comm, rows))[:, d:]


def is_close(actual: Any, expected: Any, rtol: float, *, scale: float | None = None) -> bool:
    """Return whether differences are within ``rtol`` of the largest expected entry or ``scale``."""
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


def are_identical(a: Iterable[Array], b: Iterable[Array]) -> bool:
    """Return whether the arrays are equal bit for bit on all ranks."""
    same = all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))
    return bool(np.all(MPI.COMM_WORLD.allgather(same)))


def check_on_first_rank(check: Callable[[], None]) -> None:
    """Run a check on the first rank; if it fails, fail on all ranks. Collective."""
    error, comm = None, MPI.COMM_WORLD
    if comm.rank == 0:
        try:
            check()
        except AssertionError as caught:
            error = str(caught) or repr(caught)
    assert comm.bcast(error) is None


def assert_raised_on_all_ranks(
    call: Callable[[], Any],
    kind: type[Exception] | tuple[type[Exception], ...],
    *words: str,
    comm: MPI.Comm = MPI.COMM_WORLD,
) -> str:
    """Assert that all ranks raise ``kind`` with the same text, which has all ``words``."""
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


def is_interpolant(
    f: fem.Function, expected: Callable[[Array], Array], rtol: float, *, scale: float | None = None
) -> bool:
    """Return whether ``f`` is the interpolant of ``expected``, compared on all ranks."""
    reference = fem.Function(f.function_space)
    reference.interpolate(expected)
    comm = f.function_space.mesh.comm
    return is_close(
        gather(comm, owned_values(f)), gather(comm, owned_values(reference)), rtol, scale=scale
    )


def have_similar_iterations(iterations: Sequence[int], others: Sequence[int]) -> bool:
    """Return whether the iterations of every increment differ by at most one.

    Round-off decides whether a last iteration is needed. Other causes, such as a setting of the
    solver that depends on units, change the number of iterations by more than one.
    """
    return len(iterations) == len(others) and all(
        abs(a - b) <= 1 for a, b in zip(iterations, others, strict=True)
    )
