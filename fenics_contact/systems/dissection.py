"""A rank's cells, cut into substructures that are eliminated one after another and merged in pairs.

MUMPS orders badly where a Schur complement is asked for, the worse the larger the piece. In space
small pieces, merged by dense algebra as in nested dissection, take fewer operations than a large
one.
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

from fenics_contact.compat import sparse_matrix
from fenics_contact.systems.substructure import SINGULAR, Substructure
from fenics_contact.types import Array, Index, Indices, Mask

__all__ = ["Dissection", "Eliminated", "Partial"]

# Unknowns inside of a substructure, about, in three dimensions.
_INNER = 6000


@dataclass(frozen=True)
class Partial:
    """What forces make of a piece whose boundary is at rest.

    Attributes:
        inner: Displacement of every unknown with those eliminated after it at rest, (n,).
        pushed: Forces at the unknowns, as they were when these were eliminated, (n,).
    """

    inner: Array
    pushed: Array


class Eliminated:
    """Some unknowns of a dense matrix, eliminated.

    By Cholesky's factors L Lᵀ where it is symmetric and positive definite, which it need not be,
    and by LU otherwise.

    Args:
        matrix: Fortran order, those to be eliminated first; used.
        n: Their number.
        symmetric: Whether it is.

    Raises:
        RuntimeError: It is singular there.
    """

    def __init__(self, matrix: Array, n: int, *, symmetric: bool) -> None:
        self._lower: Array | None = None
        self._factors: Any = None
        first, coupling = matrix[:n, :n], matrix[:n, n:]
        if symmetric and n:
            with contextlib.suppress(np.linalg.LinAlgError):
                self._lower = scipy.linalg.cholesky(first, lower=True, check_finite=False)
        # What the others feel of those eliminated, and these of the others: L⁻¹ times the coupling
        # for both, or the coupling and its counterpart.
        if self._lower is not None:
            self._feel = self._half_solved(coupling)
            self._felt = self._feel.T
            taken = (self._felt @ self._feel).T  # symmetric, and so in Fortran order
        else:
            self._feel = coupling.copy(order="F")
            self._felt = matrix[n:, :n].copy(order="F")
            if n:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", scipy.linalg.LinAlgWarning)
                    self._factors = scipy.linalg.lu_factor(first, check_finite=False)
            taken = np.asfortranarray(self._felt @ self.at_rest(self._feel))
        self._left: Array = matrix[n:, n:] - taken
        if not np.all(np.isfinite(self._left)):
            raise RuntimeError(SINGULAR)

    def _half_solved(self, force: Array, *, back: bool = False) -> Array:
        """L⁻¹ times it, or L⁻ᵀ."""
        found = scipy.linalg.solve_triangular(
            self._lower, force, lower=True, trans=int(back), check_finite=False
        )
        return np.asarray(found)

    def release(self) -> Array:
        """The Schur complement of the others, (n_others, n_others), Fortran order, released."""
        left, self._left = self._left, np.zeros((0, 0))
        return left

    def at_rest(self, force: Array) -> Array:
        """Displacement of those eliminated under forces, the others at rest."""
        if self._lower is not None:
            return self._half_solved(self._half_solved(force), back=True)
        if self._factors is None:  # there are none
            return np.zeros_like(force)
        return np.asarray(scipy.linalg.lu_solve(self._factors, force, check_finite=False))

    def reaction(self, state: Array) -> Array:
        """Force that the others at rest feel for displacements of those eliminated."""
        return np.asarray(self._felt @ (state if self._lower is None else self._lower.T @ state))

    def carried(self, others: Array) -> Array:
        """Displacement of those eliminated that the others' brings along."""
        if self._lower is not None:
            return -self._half_solved(self._feel @ others, back=True)
        return -self.at_rest(self._feel @ others)


@dataclass(frozen=True)
class _Step:
    """Some unknowns eliminated: those inside of a substructure, or where two parts meet.

    Attributes:
        eliminated: Their numbers in the piece.
        others: Numbers of those around them, which are not eliminated yet.
        made: The elimination.
    """

    eliminated: Index
    others: Index
    made: Substructure | Eliminated


class Dissection:
    """A piece of a body with all but its boundary eliminated. Of this rank alone.

    Args:
        stiffness: Of this rank alone, (n, n); used.
        places: Where the unknowns are, (n, gdim).
        symmetric: Whether the stiffness is.
        prefix: Of the options of the factorisations.
        inner: Unknowns in a substructure, about, in three dimensions.

    Attributes:
        boundary: Numbers of the unknowns that stay, ascending, (n_boundary,).
        schur: What is left for them, (n_boundary, n_boundary), Fortran order (force/length).

    Raises:
        RuntimeError: The stiffness is singular even with the boundary held.
        MemoryError: There is not enough.
    """

    def __init__(
        self,
        stiffness: PETSc.Mat,
        boundary: Indices,
        places: Array,
        *,
        symmetric: bool,
        prefix: str = "",
        inner: int = _INNER,
    ) -> None:
        n, self.boundary = stiffness.getSize()[0], boundary
        self._n, self._symmetric, self._prefix = n, symmetric, prefix
        self._steps: list[_Step] = []  # substructures first, children before parents
        # In the plane one piece takes no more than a plain factorisation.
        parts = (n - boundary.size) / inner if places.shape[1] == 3 else 1.0
        depth = round(np.log2(max(parts, 1.0)))
        if depth == 0:
            whole = Substructure(stiffness, boundary, symmetric=symmetric, prefix=prefix)
            inside = np.setdiff1d(np.arange(n), boundary, assume_unique=True)
            self._steps = [_Step(inside, boundary, whole)]
            self.schur: Array = whole.release()
            return
        pointers, columns, values = stiffness.getValuesCSR()
        matrix = scipy.sparse.csr_matrix((values, columns, pointers), (n, n))
        stays = np.zeros(n, dtype=np.bool_)
        stays[boundary] = True
        part, level = _dissected(matrix, places, stays, depth)
        left = [
            self._add_leaf(matrix, np.flatnonzero((part == p) & (level == 0)), level)
            for p in range(2**depth)
        ]
        for height in range(1, depth + 1):
            between = [(level == height) & (part >> height == a) for a in range(len(left) // 2)]
            left = [
                self._add_node(matrix, np.flatnonzero(chosen), level >= height, left[i : i + 2])
                for i, chosen in zip(range(0, len(left), 2), between, strict=True)
            ]
        [(others, schur)] = left
        place = np.searchsorted(boundary, others)
        self.schur = np.asfortranarray(matrix[boundary][:, boundary].toarray())
        self.schur.T[np.ix_(place, place)] += schur.T

    def _positions(self, chosen: Index) -> Index:
        """Where unknowns of the piece are among those chosen; of others anything."""
        position = np.zeros(self._n, dtype=np.int32)
        position[chosen] = np.arange(chosen.size)
        return position

    def _add_leaf(
        self, matrix: scipy.sparse.csr_matrix, inner: Index, level: Index
    ) -> tuple[Index, Array]:
        """Eliminate the inner unknowns of a part; what is around, and what is left there."""
        rows = matrix[inner]
        around = np.unique(rows.indices)
        around = around[level[around] > 0]
        if not inner.size:
            return around, np.zeros((0, 0))
        unknowns = np.concatenate([inner, around])
        n, size = inner.size, unknowns.size
        position = self._positions(unknowns)
        back = matrix[around]
        inside = np.zeros(level.size, dtype=np.bool_)
        inside[inner] = True
        # What is between unknowns around is added where they are eliminated.
        mine = inside[back.indices]
        counts = np.concatenate([[0], np.cumsum(mine)])[back.indptr]
        columns = np.concatenate([rows.indices, back.indices[mine]])
        own = scipy.sparse.csr_matrix(
            (
                np.concatenate([rows.data, back.data[mine]]),
                position[columns],
                np.concatenate([rows.indptr, rows.indptr[-1] + counts[1:]]),
            ),
            (size, size),
        )
        own.sort_indices()
        made = Substructure(
            sparse_matrix(PETSc.COMM_SELF, size, own.indptr, own.indices, own.data),
            np.arange(n, size, dtype=np.int32),
            symmetric=self._symmetric,
            prefix=self._prefix,
        )
        self._steps.append(_Step(inner, around, made))
        return around, made.release()

    def _add_node(
        self,
        matrix: scipy.sparse.csr_matrix,
        eliminated: Index,
        present: Mask,
        parts: list[tuple[Index, Array]],
    ) -> tuple[Index, Array]:
        """Merge two parts and eliminate what is between them; the same as of a leaf.

        Args:
            matrix: Of the piece.
            eliminated: What is between them.
            present: Unknowns that are not eliminated yet.
            parts: What is around them and left there.
        """
        rows = matrix[eliminated]
        around = np.unique(np.concatenate([rows.indices, *(ids for ids, _ in parts)]))
        others = np.setdiff1d(around[present[around]], eliminated, assume_unique=True)
        n, size = eliminated.size, eliminated.size + others.size
        position = self._positions(np.concatenate([eliminated, others]))
        total = np.zeros((size, size), order="F")
        for ids, left in parts:
            place = position[ids]
            total.T[np.ix_(place, place)] += left.T  # in the order in which they are in memory
        now = present[rows.indices]
        row = np.repeat(np.arange(n), np.diff(rows.indptr))[now]
        total[row, position[rows.indices[now]]] += rows.data[now]
        back = matrix[others][:, eliminated].tocoo()
        total[n + back.row, back.col] += back.data
        made = Eliminated(total, n, symmetric=self._symmetric)
        self._steps.append(_Step(eliminated, others, made))
        return others, made.release()

    def release(self) -> Array:
        """`schur`, which is not retained any more."""
        schur, self.schur = self.schur, np.zeros((0, 0))
        return schur

    def push(self, force: Array) -> Partial:
        """What forces on all but the boundary, (n,), do with the boundary at rest."""
        found = Partial(np.zeros(self._n), force.copy())
        for step in self._steps:
            mine = found.pushed[step.eliminated]
            if mine.any():
                found.inner[step.eliminated] = state = step.made.at_rest(mine)
                found.pushed[step.others] -= step.made.reaction(state)
        return found

    def complete(self, boundary: Array, partial: Partial) -> Array:
        """Displacements of all unknowns, (n,).

        Args:
            boundary: Those of the boundary, (n_boundary,).
            partial: What forces have done.
        """
        state = partial.inner.copy()
        state[self.boundary] = boundary
        for step in reversed(self._steps):
            others = state[step.others]
            if others.any():
                state[step.eliminated] += step.made.carried(others)
        return state


def _dissected(
    matrix: scipy.sparse.csr_matrix, places: Array, stays: Mask, depth: int
) -> tuple[Index, Index]:
    """Cut in halves, each along its longest side, and these again.

    Args:
        matrix: Says what is coupled, (n, n); its pattern is symmetric.
        places: Where the unknowns are, (n, gdim).
        stays: Those that belong to no part.
        depth: How often.

    Returns:
        The number of its part, from 0 to 2^depth, and the level of every unknown, (n,) each: 0
        inside of a part, k where it is between halves of what has the number ``part >> k``, and
        above ``depth`` where it belongs to none.
    """
    part = np.zeros(stays.size, dtype=np.intp)
    inner = np.flatnonzero(~stays)
    halves = [inner]
    for _ in range(depth):
        cut = []
        for ids in halves:
            x = places[ids]
            along = x[:, np.argmax(np.ptp(x, axis=0))] if ids.size else np.zeros(0)
            # At one place all components are on the same side.
            middle = np.median(along) if ids.size else 0.0
            above = along > middle
            part[ids] = 2 * part[ids] + above
            cut += [ids[~above], ids[above]]
        halves = cut
    level = np.where(stays, depth + 1, 0)
    rows = np.repeat(np.arange(stays.size), np.diff(matrix.indptr))
    columns = matrix.indices
    crosses = (part[rows] > part[columns]) & ~stays[rows] & ~stays[columns]
    rows, columns = rows[crosses], columns[crosses]
    for height in range(depth, 0, -1):
        one, other = part[rows], part[columns]
        here = (one >> height == other >> height) & (one >> (height - 1) != other >> (height - 1))
        here &= (level[rows] == 0) & (level[columns] == 0)
        level[rows[here]] = height
    return part, level
