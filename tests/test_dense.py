"""The block solver of condensed problems against LU of the whole, by numpy."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from fenics_contact.dense import PartlyFactored

pytestmark = pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="dense matrices of one rank")
N = 40


def scene(symmetric, seed=1):
    """S, well conditioned, places on a line, and the solver behind a KSP."""
    rng = np.random.default_rng(seed)
    fixed = rng.normal(size=(N, N)) / N
    if symmetric:
        fixed = fixed + fixed.T
    fixed += 2 * np.eye(N)
    places = np.column_stack([np.arange(N) / N, np.zeros(N)])
    places[-1] = np.nan  # such as the motion of a support
    matrix = PETSc.Mat().createDense((N, N), comm=PETSc.COMM_SELF)
    matrix.assemble()
    ksp = PETSc.KSP().create(PETSc.COMM_SELF)
    ksp.setType("preonly")
    ksp.setOperators(matrix)
    ksp.pc.setType("python")
    solver = PartlyFactored(places)
    ksp.pc.setPythonContext(solver)
    return rng, fixed, matrix, ksp, solver


@pytest.mark.parametrize("symmetric", [True, False])
def test_solutions(symmetric):
    """A contact that grows, shrinks, leaves and covers all; then another S. 1e-12 by condition."""
    rng, fixed, matrix, ksp, solver = scene(symmetric)
    left_out = []
    for fixed_now in (fixed, fixed + 0.5 * np.eye(N)):
        for n in (3, 4, 9, 20, N - 2, 5, 0, 12):
            operator = fixed_now.copy()
            rows, columns = (a.ravel() for a in np.indices((n, n)))
            added = rng.normal(size=n * n) / N
            operator[rows, columns] += added
            matrix.assemble()  # says that it changed
            solver.set_parts(fixed_now, rows, columns, added)
            right = rng.normal(size=N)
            b, x = (PETSc.Vec().createSeq(N) for _ in range(2))
            b.array[:] = right
            ksp.solve(b, x)
            assert np.allclose(x.array, np.linalg.solve(operator, right), rtol=0, atol=1e-12)
            left_out.append(solver._out.size)
    assert max(left_out) > N / 2 and min(left_out) == 0


def test_a_part_that_cannot_be_eliminated():
    """Where O alone is singular all is factored: the whole is regular."""
    rng, fixed, _, ksp, solver = scene(True)
    fixed[30, 20:-1] = fixed[20:-1, 30] = 0.0  # held by the unknowns 0 to 19 alone
    solver.set_parts(fixed, np.arange(5), np.arange(5), np.zeros(5))
    b, x = (PETSc.Vec().createSeq(N) for _ in range(2))
    b.array[:] = right = rng.normal(size=N)
    ksp.solve(b, x)
    assert np.allclose(fixed @ x.array, right, rtol=0, atol=1e-10)


def test_a_zero_pivot_is_said():
    """As a diverged solution, which SNES understands, and once only."""
    _, fixed, matrix, ksp, solver = scene(True)
    every = np.indices((N, N)).reshape(2, -1)
    solver.set_parts(fixed, *every, -fixed.ravel())
    b, x = (PETSc.Vec().createSeq(N) for _ in range(2))
    b.array[:] = 1.0
    ksp.solve(b, x)
    assert ksp.getConvergedReason() == PETSc.KSP.ConvergedReason.DIVERGED_PCSETUP_FAILED
    matrix.assemble()
    solver.set_parts(fixed, *every, 0 * fixed.ravel())
    ksp.solve(b, x)
    assert ksp.getConvergedReason() > 0
    assert np.allclose(fixed @ x.array, 1.0, rtol=0, atol=1e-12)
