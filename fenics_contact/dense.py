"""Solver for dense matrices S + C of which C changes, and acts on some of the unknowns only."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.linalg
import scipy.spatial
from petsc4py import PETSc

__all__ = ["PartlyFactored"]

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.integer[Any]]
Mask = npt.NDArray[np.bool_]

# So many more unknowns than C acts on, the nearest ones, are factored with it, that a contact has
# room to grow.
_MARGIN = 0.2
# Share of all unknowns above which none are left out.
_MOST = 0.9
# Smallest pivot, relative to the largest, of the part that is factored once.
_SINGULAR = 1e-9


class PartlyFactored:
    """Context of a PETSc PC, LU by blocks: what C does not act on is factored once.

    With A the unknowns on which C acts and some around them, and O the others, S_AA + C_AA less
    the constant S_AO S_OO⁻¹ S_OA is what remains to be factored for every C. It is as exact as
    LU of the whole. Where contact is open C is zero.

    Attributes:
        fixed: S, (n, n).
        added: Rows, columns and values of C's entries.
    """

    def __init__(self, places: Array) -> None:
        """Nothing is factored yet.

        Args:
            places: Where the unknowns are, (n, gdim); NaN for those nowhere, which are always in A.
        """
        self._places, self._nowhere = places, np.isnan(places).any(axis=1)
        self.fixed: Array = np.zeros((0, 0))
        self._acted: Mask = np.ones(len(places), dtype=np.bool_)
        nothing = np.zeros(0, dtype=np.intp)
        self.added: tuple[Index, Index, Array] = nothing, nothing, np.zeros(0)
        self._forget()

    def _forget(self) -> None:
        self._in: Index = np.arange(len(self._places))
        self._out: Index = np.zeros(0, dtype=np.intp)
        self._position: Index = self._in  # of the unknowns in A
        self._reduced = self.fixed

    def set_parts(self, fixed: Array, rows: Index, columns: Index, values: Array) -> None:
        """Say what the operator of the PC is, whenever it changes.

        Args:
            fixed: S, (n, n): the same array as before as long as S is the same.
            rows: Of C's entries, each place at most once.
            columns: Likewise.
            values: The entries.
        """
        if fixed is not self.fixed:
            self.fixed = fixed
            self._forget()
        self._acted[:] = self._nowhere
        self._acted[rows] = self._acted[columns] = True
        self.added = rows, columns, values

    def setUp(self, pc: PETSc.PC) -> None:
        """Factor."""
        n_acted, n = np.count_nonzero(self._acted), len(self._places)
        fits = not self._acted[self._out].any()
        roomy = self._in.size > (1 + _MARGIN) ** 2 * n_acted + 1
        if not fits or (roomy and n_acted < _MOST * n / (1 + _MARGIN)):
            self._divide()
        block = self._reduced.copy(order="F")
        rows, columns, values = self.added
        block[self._position[rows], self._position[columns]] += values
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", scipy.linalg.LinAlgWarning)
            self._factor = scipy.linalg.lu_factor(block, overwrite_a=True, check_finite=False)
        regular = np.all(np.diag(self._factor[0]))
        reasons = PETSc.PC.FailedReason
        pc.setFailedReason(reasons.NOERROR if regular else reasons.FACTOR_NUMERIC_ZEROPIVOT)

    def _divide(self) -> None:
        """Choose A anew and eliminate O."""
        self._forget()
        n, acted = len(self._places), np.flatnonzero(self._acted)
        wanted = int((1 + _MARGIN) * acted.size)
        near = np.flatnonzero(self._acted & ~self._nowhere)
        if wanted > _MOST * n or not near.size:
            return
        others = np.flatnonzero(~self._acted)
        distance, _ = scipy.spatial.cKDTree(self._places[near]).query(self._places[others])
        more = others[np.argsort(distance, kind="stable")[: wanted - acted.size]]
        inside = np.sort(np.concatenate([acted, more]))
        outside = np.setdiff1d(others, more)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", scipy.linalg.LinAlgWarning)
            corner = self.fixed[np.ix_(outside, outside)]
            factor = scipy.linalg.lu_factor(corner, check_finite=False)
        pivots = np.abs(np.diag(factor[0]))
        if not pivots.min() > _SINGULAR * pivots.max():
            return
        self._in, self._out, self._factor_out = inside, outside, factor
        self._coupling = self.fixed[np.ix_(inside, outside)]
        right = self.fixed[np.ix_(outside, inside)]
        self._extension = scipy.linalg.lu_solve(factor, right, check_finite=False)
        self._reduced = self.fixed[np.ix_(inside, inside)] - self._coupling @ self._extension
        self._position = np.full(n, -1)
        self._position[inside] = np.arange(inside.size)

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Solve."""
        right = x.array_r
        if not self._out.size:
            y.array[:] = scipy.linalg.lu_solve(self._factor, right, check_finite=False)
            return
        outside = scipy.linalg.lu_solve(self._factor_out, right[self._out], check_finite=False)
        rest = right[self._in] - self._coupling @ outside
        inside = scipy.linalg.lu_solve(self._factor, rest, check_finite=False)
        y.array[self._in] = inside
        y.array[self._out] = outside - self._extension @ inside
