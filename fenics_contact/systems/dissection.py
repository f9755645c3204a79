"""Nested dissection of a rank's cells into substructures, merged in pairs by dense algebra.

MUMPS orders poorly when a Schur complement is requested, the more so the larger the matrix. In
three dimensions small substructures take fewer operations.
"""

from __future__ import annotations

import contextlib
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse
from petsc4py import PETSc

from fenics_contact.compat import create_csr_matrix
from fenics_contact.systems.substructure import SINGULAR, Substructure
from fenics_contact.types import Array, Index, Indices, Mask

__all__ = ["BlockFactorisation", "Dissection", "ForwardElimination"]

# Approximate number of unknowns in a substructure, in three dimensions.
_SUBSTRUCTURE_DOFS = 6000


@dataclass(frozen=True)
class ForwardElimination:
    """The forward elimination of forces on a subdomain.

    Attributes:
        inner: Values of the unknowns with those eliminated later at zero, (n,).
        reduced_rhs: Right-hand side of every unknown when it was eliminated, (n,).
    """

    inner: Array
    reduced_rhs: Array


class BlockFactorisation:
    """Elimination of the first block of a dense matrix, by Cholesky's factors L Lᵀ or by LU.

    LU is used if the matrix is not symmetric or not positive definite.

    Args:
        matrix: The matrix in Fortran order, overwritten.
        n: Size of the first block.
        symmetric: Whether the matrix is symmetric.

    Raises:
        RuntimeError: The first block is singular.
    """

    def __init__(self, matrix: Array, n: int, *, symmetric: bool) -> None:
        self._cholesky: Array | None = None
        self._lu: Any = None
        first, coupling = matrix[:n, :n], matrix[:n, n:]
        if symmetric and n:
            with contextlib.suppress(np.linalg.LinAlgError):
                self._cholesky = scipy.linalg.cholesky(first, lower=True, check_finite=False)
        # Coupling blocks, or L⁻¹ times the coupling and its transpose.
        if self._cholesky is not None:
            self._upper = self._solve_lower(coupling)
            self._lower = self._upper.T
            product = (self._lower @ self._upper).T  # symmetric, hence also Fortran order
        else:
            self._upper = coupling.copy(order="F")
            self._lower = matrix[n:, :n].copy(order="F")
            if n:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", scipy.linalg.LinAlgWarning)
                    self._lu = scipy.linalg.lu_factor(first, check_finite=False)
            product = np.asfortranarray(self._lower @ self.solve_fixed(self._upper))
        self._schur: Array = matrix[n:, n:] - product
        if not np.all(np.isfinite(self._schur)):
            raise RuntimeError(SINGULAR)

    def _solve_lower(self, force: Array, *, back: bool = False) -> Array:
        """Return L⁻¹ times a force, or L⁻ᵀ times it."""
        result = scipy.linalg.solve_triangular(
            self._cholesky, force, lower=True, trans=int(back), check_finite=False
        )
        return np.asarray(result)

    def release(self) -> Array:
        """Return the Schur complement, Fortran order, and drop it."""
        schur, self._schur = self._schur, np.zeros((0, 0))
        return schur

    def solve_fixed(self, force: Array) -> Array:
        """Return the eliminated unknowns under forces, with the others at zero."""
        if self._cholesky is not None:
            return self._solve_lower(self._solve_lower(force), back=True)
        if self._lu is None:  # the block is empty
            return np.zeros_like(force)
        return np.asarray(scipy.linalg.lu_solve(self._lu, force, check_finite=False))

    def reaction(self, state: Array) -> Array:
        """Return the forces on the others, fixed, for values of the eliminated unknowns."""
        return np.asarray(
            self._lower @ (state if self._cholesky is None else self._cholesky.T @ state)
        )

    def extend(self, others: Array) -> Array:
        """Return the harmonic extension of the others to the eliminated unknowns."""
        if self._cholesky is not None:
            return -self._solve_lower(self._upper @ others, back=True)
        return -self.solve_fixed(self._upper @ others)


@dataclass(frozen=True)
class _Step:
    """The elimination of a substructure, or of the separator of two.

    Attributes:
        eliminated: Numbers of the eliminated unknowns.
        others: Numbers of the adjacent unknowns, which are eliminated later.
        factors: Factorisation of the eliminated block.
    """

    eliminated: Index
    others: Index
    factors: Substructure | BlockFactorisation


class Dissection:
    """Elimination of a subdomain down to its boundary, on this rank alone.

    Args:
        stiffness: Stiffness of the subdomain, (n, n), taken over.
        coordinates: Coordinates of the unknowns, (n, gdim).
        symmetric: Whether the stiffness is symmetric.
        prefix: Options prefix of the factorisations.
        inner: Approximate number of unknowns in a substructure in three dimensions.

    Attributes:
        boundary: Numbers of the retained unknowns, ascending, (n_boundary,).
        schur: Their Schur complement, (n_boundary, n_boundary), Fortran order (force/length).

    Raises:
        RuntimeError: The stiffness is singular even with the boundary fixed.
        MemoryError: The factorisation ran out of memory.
    """

    def __init__(
        self,
        stiffness: PETSc.Mat,
        boundary: Indices,
        coordinates: Array,
        *,
        symmetric: bool,
        prefix: str = "",
        inner: int = _SUBSTRUCTURE_DOFS,
    ) -> None:
        n, self.boundary = stiffness.getSize()[0], boundary
        self._n, self._symmetric, self._prefix = n, symmetric, prefix
        self._steps: list[_Step] = []  # substructures first, children before parents
        # In the plane one substructure costs no more than a plain factorisation.
        parts = (n - boundary.size) / inner if coordinates.shape[1] == 3 else 1.0
        depth = round(np.log2(max(parts, 1.0)))
        if depth == 0:
            whole = Substructure(stiffness, boundary, symmetric=symmetric, prefix=prefix)
            interior = np.setdiff1d(np.arange(n), boundary, assume_unique=True)
            self._steps = [_Step(interior, boundary, whole)]
            self.schur: Array = whole.release()
            return
        pointers, columns, values = stiffness.getValuesCSR()
        matrix = scipy.sparse.csr_matrix((values, columns, pointers), (n, n))
        is_boundary = np.zeros(n, dtype=np.bool_)
        is_boundary[boundary] = True
        part, level = _dissect(matrix, coordinates, is_boundary, depth)
        fronts = [
            self._add_leaf(matrix, np.flatnonzero((part == p) & (level == 0)), level)
            for p in range(2**depth)
        ]
        for height in range(1, depth + 1):
            masks = [(level == height) & (part >> height == a) for a in range(len(fronts) // 2)]
            fronts = [
                self._add_node(matrix, np.flatnonzero(mask), level >= height, fronts[i : i + 2])
                for i, mask in zip(range(0, len(fronts), 2), masks, strict=True)
            ]
        [(rest, schur)] = fronts
        position = np.searchsorted(boundary, rest)
        self.schur = np.asfortranarray(matrix[boundary][:, boundary].toarray())
        self.schur.T[np.ix_(position, position)] += schur.T

    def _positions(self, chosen: Index) -> Index:
        """Return an array (n,) of positions among chosen unknowns, arbitrary at others."""
        position = np.zeros(self._n, dtype=np.int32)
        position[chosen] = np.arange(chosen.size)
        return position

    def _add_leaf(
        self, matrix: scipy.sparse.csr_matrix, inner: Index, level: Index
    ) -> tuple[Index, Array]:
        """Eliminate a substructure; return adjacent unknowns and Schur complement."""
        rows = matrix[inner]
        around = np.unique(rows.indices)
        around = around[level[around] > 0]
        if not inner.size:
            return around, np.zeros((0, 0))
        unknowns = np.concatenate([inner, around])
        n, size = inner.size, unknowns.size
        position = self._positions(unknowns)
        outer = matrix[around]
        is_inner = np.zeros(level.size, dtype=np.bool_)
        is_inner[inner] = True
        # Entries between adjacent unknowns are added where those are eliminated.
        to_inner = is_inner[outer.indices]
        counts = np.concatenate([[0], np.cumsum(to_inner)])[outer.indptr]
        columns = np.concatenate([rows.indices, outer.indices[to_inner]])
        local = scipy.sparse.csr_matrix(
            (
                np.concatenate([rows.data, outer.data[to_inner]]),
                position[columns],
                np.concatenate([rows.indptr, rows.indptr[-1] + counts[1:]]),
            ),
            (size, size),
        )
        local.sort_indices()
        factors = Substructure(
            create_csr_matrix(PETSc.COMM_SELF, size, local.indptr, local.indices, local.data),
            np.arange(n, size, dtype=np.int32),
            symmetric=self._symmetric,
            prefix=self._prefix,
        )
        self._steps.append(_Step(inner, around, factors))
        return around, factors.release()

    def _add_node(
        self,
        matrix: scipy.sparse.csr_matrix,
        eliminated: Index,
        present: Mask,
        parts: list[tuple[Index, Array]],
    ) -> tuple[Index, Array]:
        """Merge two parts and eliminate their separator; return the same as `_add_leaf`.

        ``present`` is the mask of the unknowns not eliminated yet, and ``parts`` are the results
        for both.
        """
        rows = matrix[eliminated]
        around = np.unique(np.concatenate([rows.indices, *(ids for ids, _ in parts)]))
        others = np.setdiff1d(around[present[around]], eliminated, assume_unique=True)
        n, size = eliminated.size, eliminated.size + others.size
        position = self._positions(np.concatenate([eliminated, others]))
        total = np.zeros((size, size), order="F")
        for ids, schur in parts:
            index = position[ids]
            total.T[np.ix_(index, index)] += schur.T  # both are in Fortran order
        is_present = present[rows.indices]
        row = np.repeat(np.arange(n), np.diff(rows.indptr))[is_present]
        total[row, position[rows.indices[is_present]]] += rows.data[is_present]
        back = matrix[others][:, eliminated].tocoo()
        total[n + back.row, back.col] += back.data
        factors = BlockFactorisation(total, n, symmetric=self._symmetric)
        self._steps.append(_Step(eliminated, others, factors))
        return others, factors.release()

    def release(self) -> Array:
        """Return `schur` and drop it."""
        schur, self.schur = self.schur, np.zeros((0, 0))
        return schur

    def eliminate(self, force: Array) -> ForwardElimination:
        """Return the forward elimination of forces, (n,), with the boundary fixed."""
        partial = ForwardElimination(np.zeros(self._n), force.copy())
        for step in self._steps:
            rhs = partial.reduced_rhs[step.eliminated]
            if rhs.any():
                partial.inner[step.eliminated] = state = step.factors.solve_fixed(rhs)
                partial.reduced_rhs[step.others] -= step.factors.reaction(state)
        return partial

    def back_substitute(self, boundary: Array, partial: ForwardElimination) -> Array:
        """Return all unknowns, (n,), for the boundary values, (n_boundary,)."""
        state = partial.inner.copy()
        state[self.boundary] = boundary
        for step in reversed(self._steps):
            others = state[step.others]
            if others.any():
                state[step.eliminated] += step.factors.extend(others)
        return state


def _dissect(
    matrix: scipy.sparse.csr_matrix, coordinates: Array, is_boundary: Mask, depth: int
) -> tuple[Index, Index]:
    """Bisect recursively along the longest side.

    Args:
        matrix: Matrix with a symmetric pattern, (n, n).
        coordinates: Coordinates of the unknowns, (n, gdim).
        is_boundary: Mask of the unknowns that belong to no part.
        depth: Number of bisections.

    Returns:
        Part number, from 0 to 2^depth, and level of every unknown, (n,) each. The level is 0 inside
        of a part, k on the separator of the halves of ``part >> k``, and depth + 1 on the boundary.
    """
    part = np.zeros(is_boundary.size, dtype=np.intp)
    inner = np.flatnonzero(~is_boundary)
    halves = [inner]
    for _ in range(depth):
        split = []
        for ids in halves:
            x = coordinates[ids]
            along = x[:, np.argmax(np.ptp(x, axis=0))] if ids.size else np.zeros(0)
            # Components at one node stay together.
            middle = np.median(along) if ids.size else 0.0
            above = along > middle
            part[ids] = 2 * part[ids] + above
            split += [ids[~above], ids[above]]
        halves = split
    level = np.where(is_boundary, depth + 1, 0)
    rows = np.repeat(np.arange(is_boundary.size), np.diff(matrix.indptr))
    columns = matrix.indices
    crosses = (part[rows] > part[columns]) & ~is_boundary[rows] & ~is_boundary[columns]
    rows, columns = rows[crosses], columns[crosses]
    for height in range(depth, 0, -1):
        p, q = part[rows], part[columns]
        cut = (p >> height == q >> height) & (p >> (height - 1) != q >> (height - 1))
        cut &= (level[rows] == 0) & (level[columns] == 0)
        level[rows[cut]] = height
    return part, level
