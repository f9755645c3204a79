"""Nested dissection agrees with dense algebra to 1e-10 of the largest entry."""

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from fenics_contact.systems.dissection import BlockFactorisation, Dissection
from scenes.comparison import is_close

pytestmark = pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="every rank does it by itself")


def lattice(n, d, *, symmetric=True, shift=0.0):
    """Create springs between adjacent nodes of a grid, with ``d`` components each.

    Returns:
        The dense stiffness and the coordinates of its dofs.
    """
    grid = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    distance = np.abs(grid[:, None] - grid[None]).max(axis=2)
    rng = np.random.default_rng(5)
    K = np.zeros((d * len(grid), d * len(grid)))
    for i, j in zip(*np.nonzero(np.triu(distance == 1)), strict=True):
        spring = rng.normal(size=(d, d))
        spring = spring @ spring.T + np.eye(d)
        ends = d * i + np.arange(d), d * j + np.arange(d)
        for a, b, sign in ((0, 0, 1), (1, 1, 1), (0, 1, -1), (1, 0, -1)):
            K[np.ix_(ends[a], ends[b])] += sign * spring
    if not symmetric:
        K += 0.1 * np.where(K != 0, rng.normal(size=K.shape), 0.0)
    K += (0.1 - shift) * np.eye(len(K))
    return K, np.repeat(grid.astype(float), d, axis=0)


def sparse(K):
    rows, columns = np.nonzero(K)
    pointers = np.searchsorted(rows, np.arange(len(K) + 1)).astype(PETSc.IntType)
    csr = pointers, columns.astype(PETSc.IntType), K[rows, columns]
    return PETSc.Mat().createAIJ(K.shape, csr=csr, comm=PETSc.COMM_SELF)


@pytest.mark.each
@pytest.mark.parametrize("inner", [10_000, 150, 40, 3])
@pytest.mark.parametrize(
    ("symmetric", "shift"),
    [(True, 0.0), (False, 0.0), (True, 9.0)],
    ids=["", "unsymmetric", "not definite"],
)
def test_dissection_agrees_with_dense_algebra(symmetric, shift, inner):
    """Schur complement and displacements under forces and boundary displacements agree.

    There are one, a few, or very many substructures.
    """
    K, places = lattice(5, 2, symmetric=symmetric, shift=shift)
    n = len(K)
    stays = np.flatnonzero((places[:, 2] == 0) | (places[:, 0] == 4)).astype(np.int32)
    inside = np.setdiff1d(np.arange(n), stays)
    dissection = Dissection(sparse(K), stays, places, symmetric=symmetric, inner=inner)
    inverse = np.linalg.inv(K[np.ix_(inside, inside)])
    away = K[np.ix_(stays, inside)] @ inverse
    schur = K[np.ix_(stays, stays)] - away @ K[np.ix_(inside, stays)]
    assert is_close(dissection.schur, schur, 1e-10)
    assert dissection.release().shape == schur.shape and not dissection.schur.size
    rng = np.random.default_rng(6)
    force, boundary = np.zeros(n), rng.normal(size=stays.size)
    force[inside] = rng.normal(size=inside.size)
    partial = dissection.eliminate(force)
    assert is_close(partial.reduced_rhs[stays], -away @ force[inside], 1e-10)
    for boundary_values, load in ((boundary, 0 * force), (0 * boundary, force), (boundary, force)):
        expected = np.zeros(n)
        expected[stays] = boundary_values
        expected[inside] = inverse @ (load[inside] - K[np.ix_(inside, stays)] @ boundary_values)
        assert is_close(
            dissection.back_substitute(boundary_values, dissection.eliminate(load)), expected, 1e-10
        )


def test_singular_block_is_refused():
    """A singular block to be eliminated raises instead of yielding NaN."""
    matrix = np.zeros((3, 3), order="F")
    matrix[2, 2] = 1.0
    with pytest.raises(RuntimeError, match="singular"):
        BlockFactorisation(matrix, 2, symmetric=True)
