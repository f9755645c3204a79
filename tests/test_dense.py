"""The dense solver of condensed problems against numpy's LU factors of the whole matrix."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from fenics_contact.systems.dense import SumOperator, UpdatedLU

pytestmark = pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="dense matrices of one rank")
N = 40


def scene(symmetric, seed=1):
    """Return the generator, a well-conditioned S, the matrix, and the solver as a KSP."""
    rng = np.random.default_rng(seed)
    fixed = rng.normal(size=(N, N)) / N
    if symmetric:
        fixed = fixed + fixed.T
    fixed += 2 * np.eye(N)
    operator = SumOperator()
    matrix = PETSc.Mat().createPython((N, N), operator, comm=PETSc.COMM_SELF)
    matrix.setUp()
    ksp = PETSc.KSP().create(PETSc.COMM_SELF)
    ksp.setType("preonly")
    ksp.setOperators(matrix)
    ksp.pc.setType("python")
    ksp.pc.setPythonContext(UpdatedLU())
    return rng, fixed, matrix, ksp, operator


@pytest.mark.parametrize("symmetric", [True, False])
def test_solutions(symmetric):
    """Solutions agree to 1e-12 as contact grows, shrinks, vanishes and covers all, for two S.

    The matrices are well-conditioned.
    """
    rng, fixed, matrix, ksp, operator = scene(symmetric)
    for fixed_now in (fixed, fixed + 0.5 * np.eye(N)):
        for n in (3, 4, 9, 20, N - 2, 5, 0, 12):
            full = fixed_now.copy()
            rows, columns = (a.ravel() for a in np.indices((n, n)))
            added = rng.normal(size=n * n) / N
            full[rows, columns] += added
            operator.set_parts(fixed_now, rows, columns, added)
            matrix.assemble()  # marks it as changed
            right = rng.normal(size=N)
            b, x = (PETSc.Vec().createSeq(N) for _ in range(2))
            b.array[:] = right
            ksp.solve(b, x)
            assert np.allclose(x.array, np.linalg.solve(full, right), rtol=0, atol=1e-12)


@pytest.mark.parametrize("size", [1.0, 1e8])
def test_few_changes_update_the_factors(size, monkeypatch):
    """Solutions agree to 1e-9 as soft or stiff points close and open one by one.

    Soft points cause no new factorisation while few dofs have changed, and one if many have. If
    stiff points spoil the update, the residual triggers one.
    """
    rng, fixed, matrix, ksp, operator = scene(True)
    refactorisations = []
    solver = ksp.pc.getPythonContext()
    refactor = solver.refactor
    monkeypatch.setattr(solver, "refactor", lambda: refactorisations.append(1) or refactor())
    diagonal = np.arange(N)
    added = np.where(diagonal < 25, size, 0.0)
    counts = []
    for changed in ([], [3], [3, 4], [24], [1, 2, 5], [24], [], [23], range(12), [0]):
        added[list(changed)] = size - added[list(changed)]
        operator.set_parts(fixed, diagonal, diagonal, added.copy())
        matrix.assemble()
        right = rng.normal(size=N)
        b, x = (PETSc.Vec().createSeq(N) for _ in range(2))
        b.array[:] = right
        ksp.solve(b, x)
        assert np.allclose(x.array, np.linalg.solve(fixed + np.diag(added), right), 0, 1e-9)
        counts.append(len(refactorisations))
    if size > 1.0:
        assert counts[2] > 1
    else:
        assert counts[0] == 1 and counts[5] <= 2
        assert counts[-2] > counts[-3]


def test_operator_products():
    """S x + C x and the transposed product agree with numpy to round-off."""
    rng, fixed, matrix, _, operator = scene(False)
    values = rng.normal(size=3)
    operator.set_parts(fixed, np.array([1, 1, 7]), np.array([2, 1, 0]), values)
    x, y = (PETSc.Vec().createSeq(N) for _ in range(2))
    x.array[:] = rng.normal(size=N)
    matrix.mult(x, y)
    full = fixed.copy()
    full[[1, 1, 7], [2, 1, 0]] += values
    assert np.allclose(y.array, full @ x.array, rtol=0, atol=1e-13)
    matrix.multTranspose(x, y)
    assert np.allclose(y.array, full.T @ x.array, rtol=0, atol=1e-13)


def test_zero_pivot_is_reported():
    """A zero pivot is reported once only, as a diverged solution, which SNES understands."""
    _, fixed, matrix, ksp, operator = scene(True)
    indices = np.indices((N, N)).reshape(2, -1)
    operator.set_parts(fixed, *indices, -fixed.ravel())
    b, x = (PETSc.Vec().createSeq(N) for _ in range(2))
    b.array[:] = 1.0
    ksp.solve(b, x)
    assert ksp.getConvergedReason() == PETSc.KSP.ConvergedReason.DIVERGED_PCSETUP_FAILED
    operator.set_parts(fixed, *indices, 0 * fixed.ravel())
    matrix.assemble()
    ksp.solve(b, x)
    assert ksp.getConvergedReason() > 0
    assert np.allclose(fixed @ x.array, 1.0, rtol=0, atol=1e-12)
