"""Solver for dense matrices S + C of which C changes, mostly at some of the unknowns only.

All of it is on the first rank; the others have no unknowns, and wait.
"""

from __future__ import annotations

import warnings

import numpy as np
import scipy.linalg
from petsc4py import PETSc

from fenics_contact.parallel import broadcast_from_root, collective_errors
from fenics_contact.types import Array, Index

__all__ = ["Sum", "UpdatedLU", "raise_stored_error"]


# Share of the unknowns up to which a change of C is a correction to the last factors.
_CORRECTED = 0.25
# Residual, relative, that a corrected solution may have before all is factored.
_ACCURATE = 1e-11


class Sum:
    """Context of a PETSc Mat, S + C.

    Attributes:
        fixed: S, (n, n).
        added: Rows, columns and values of C's entries.
        error: What `mult` ran into: PETSc carries no exception; see `raise_stored_error`.
    """

    def __init__(self) -> None:
        self.error: BaseException | None = None
        self.fixed: Array = np.zeros((0, 0))
        nothing = np.zeros(0, dtype=np.intp)
        self.added: tuple[Index, Index, Array] = nothing, nothing, np.zeros(0)

    def set_parts(self, fixed: Array, rows: Index, columns: Index, values: Array) -> None:
        """Say what the operator is; afterwards assemble the Mat, that its PC sees it.

        Args:
            fixed: S, (n, n): the same array as before as long as S is the same.
            rows: Of C's entries, each place at most once.
            columns: Likewise.
            values: The entries.
        """
        self.fixed, self.added = fixed, (rows, columns, values)

    def mult(self, matrix: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Multiply; into what is no number if that fails."""
        self._multiply(x, y, transposed=False)

    def multTranspose(self, matrix: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Multiply by the transpose, as SNES of trust regions does; likewise."""
        self._multiply(x, y, transposed=True)

    def _multiply(self, x: PETSc.Vec, y: PETSc.Vec, *, transposed: bool) -> None:
        try:
            y.array[:] = self.product(x.array_r, transposed=transposed)
        except BaseException as error:
            self.error = self.error or error
            y.set(np.nan)

    def product(self, state: Array, *, transposed: bool = False) -> Array:
        """(S + C) times a vector, or Sᵀ + Cᵀ, (n,)."""
        fixed, (rows, columns, values) = self.fixed, self.added
        if transposed:
            fixed, rows, columns = fixed.T, columns, rows
        added = np.bincount(rows, values * state[columns], minlength=state.size)
        return np.asarray(fixed @ state + added)


class UpdatedLU:
    """Context of the PC of a `Sum`: LU of all, corrected where C changes at few unknowns.

    From one iteration to the next a few points change between open, stick and slip. With E the
    unknowns that they reach and D the change of C there, the columns of (S + C)⁻¹ for E and a
    system as large as E make the solutions of S + C + D (Woodbury's identity).

    Attributes:
        error: As of `Sum`.
    """

    def __init__(self) -> None:
        self.error: BaseException | None = None
        self._operator = Sum()
        nothing: Array = np.zeros((0, 0))
        none: Index = np.zeros(0, dtype=np.intp)
        # LU of S + C, which S, and the entries of which C.
        self._factor = nothing, none
        self._factored: tuple[Array, Index, Index, Array] | None = None
        # Columns of the inverse, and of which unknowns; of these those that have changed since, the
        # change, and LU of the system that corrects by it.
        self._known, self._changed = none, none
        self._columns, self._answers, self._change = nothing, nothing, nothing
        self._core = nothing, none

    def raise_stored_error(self) -> None:
        """Raise what this, or the operator, ran into when PETSc called it last."""
        for part in (self, self._operator):
            error, part.error = part.error, None
            try:
                if error is not None:
                    raise error
            finally:
                del error  # it keeps this frame, which would keep it and all that solves

    def setUp(self, pc: PETSc.PC) -> None:
        """Factor, or find out what the last factors lack."""
        reasons = PETSc.PC.FailedReason
        self._operator = pc.getOperators()[1].getPythonContext()
        try:
            # Other ranks have no unknowns.
            regular = not len(self._operator.fixed) or self._correct() or self.factor_anew()
        except BaseException as error:
            self.error, regular = self.error or error, False
            self._factored = None
        regular = broadcast_from_root(pc.comm.tompi4py(), regular)
        pc.setFailedReason(reasons.NOERROR if regular else reasons.FACTOR_NUMERIC_ZEROPIVOT)

    def factor_anew(self) -> bool:
        """Factor S + C as it is now; whether it is regular."""
        fixed, (rows, columns, values) = self._operator.fixed, self._operator.added
        whole = fixed.copy(order="F")
        whole[rows, columns] += values
        self._factor = _factors(whole)
        regular = bool(np.all(np.diag(self._factor[0])))
        self._factored = (fixed, rows, columns, values) if regular else None
        self._changed = self._known = np.zeros(0, dtype=np.intp)
        self._columns = np.zeros((len(fixed), 0))
        return regular

    def _correct(self) -> bool:
        """Find the change since the last factorisation, if it is of few unknowns; whether it is."""
        if self._factored is None:
            return False
        fixed, *places, factored = self._factored
        rows, columns, values = self._operator.added
        if self._operator.fixed is not fixed or not all(
            map(np.array_equal, (rows, columns), places)
        ):
            return False
        change = values - factored
        matters = change != 0.0
        rows, columns = rows[matters], columns[matters]
        reached = np.union1d(rows, columns)
        new = np.setdiff1d(reached, self._known)
        if self._known.size + new.size > _CORRECTED * len(fixed):
            return False
        unit = np.zeros((len(fixed), new.size), order="F")
        unit[new, np.arange(new.size)] = 1.0
        made = scipy.linalg.lu_solve(self._factor, unit, overwrite_b=True, check_finite=False)
        self._columns = np.hstack([self._columns, made])
        self._known = np.concatenate([self._known, new])
        order = np.argsort(self._known)
        among = order[np.searchsorted(self._known, reached, sorter=order)]
        self._changed, self._answers = reached, self._columns[:, among]
        self._change = np.zeros((reached.size, reached.size))
        at = np.searchsorted(reached, rows), np.searchsorted(reached, columns)
        self._change[at] = change[matters]
        self._core = _factors(np.eye(reached.size) + self._answers[reached] @ self._change)
        return bool(np.all(np.diag(self._core[0])))

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Solve; with what is no number if that fails."""
        try:
            if y.array.size:
                y.array[:] = self._solve(x.array_r)
        except BaseException as error:
            self.error = self.error or error  # PETSc may go on for a while
            y.set(np.nan)

    def _solve(self, right: Array) -> Array:
        """Solve, and look whether a correction was good enough."""
        solution = scipy.linalg.lu_solve(self._factor, right, check_finite=False)
        if not self._changed.size:
            return solution
        at_changed = scipy.linalg.lu_solve(self._core, solution[self._changed], check_finite=False)
        solution -= self._answers @ (self._change @ at_changed)
        left = right - self._operator.product(solution)
        if not np.linalg.norm(left) <= _ACCURATE * np.linalg.norm(right):
            self.factor_anew()
            return scipy.linalg.lu_solve(self._factor, right, check_finite=False)
        return solution


def _factors(matrix: Array) -> tuple[Array, Index]:
    """LU of a matrix, which is used up; a zero pivot is looked for by the caller."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", scipy.linalg.LinAlgWarning)
        return scipy.linalg.lu_factor(matrix, overwrite_a=True, check_finite=False)


def raise_stored_error(ksp: PETSc.KSP) -> None:
    """Raise what the contexts of a solver ran into when PETSc called them last, if it has any.

    Collective: all ranks raise what one has.
    """
    context = ksp.getPC().getPythonContext() if ksp.getPC().getType() == "python" else None
    if isinstance(context, UpdatedLU):
        with collective_errors(ksp.comm.tompi4py()):
            context.raise_stored_error()
