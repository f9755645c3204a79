"""Direct solver for dense matrices S + C, of which C changes mostly at few unknowns.

All unknowns are on the first rank.
"""

from __future__ import annotations

import warnings

import numpy as np
import scipy.linalg
from petsc4py import PETSc

from fenics_contact.parallel import broadcast_from_root, collective_errors
from fenics_contact.types import Array, Index

__all__ = ["SumOperator", "UpdatedLU", "raise_stored_error"]


# Largest ratio of changed unknowns to all up to which the factors are updated.
_MAX_UPDATE_RATIO = 0.25
# Relative residual of an updated solution above which all is factored again.
_UPDATE_RTOL = 1e-11


class SumOperator:
    """Context of a PETSc Mat, S + C.

    Attributes:
        fixed: S, (n, n).
        added: Rows, columns and values of the entries of C.
        error: Exception in `mult`, which PETSc does not propagate; see `raise_stored_error`.
    """

    def __init__(self) -> None:
        self.error: BaseException | None = None
        self.fixed: Array = np.zeros((0, 0))
        empty = np.zeros(0, dtype=np.intp)
        self.added: tuple[Index, Index, Array] = empty, empty, np.zeros(0)

    def set_parts(self, fixed: Array, rows: Index, columns: Index, values: Array) -> None:
        """Set S, (n, n), and the entries of C, each at most once; then assemble the Mat.

        An unchanged S must be the same array. The assembly lets PETSc set up the PC again.
        """
        self.fixed, self.added = fixed, (rows, columns, values)

    def mult(self, matrix: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Multiply by S + C; the result is NaN after an exception."""
        self._multiply(x, y, transposed=False)

    def multTranspose(self, matrix: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Multiply by the transpose, which SNES needs for trust regions."""
        self._multiply(x, y, transposed=True)

    def _multiply(self, x: PETSc.Vec, y: PETSc.Vec, *, transposed: bool) -> None:
        try:
            y.array[:] = self.product(x.array_r, transposed=transposed)
        except BaseException as error:
            self.error = self.error or error
            y.set(np.nan)

    def product(self, state: Array, *, transposed: bool = False) -> Array:
        """Return (S + C) times a vector, or (S + C)ᵀ times it, (n,)."""
        fixed, (rows, columns, values) = self.fixed, self.added
        if transposed:
            fixed, rows, columns = fixed.T, columns, rows
        added = np.bincount(rows, values * state[columns], minlength=state.size)
        return np.asarray(fixed @ state + added)


class UpdatedLU:
    """Context of the PC of a `Sum`: an LU factorisation with low-rank updates.

    Between iterations few points change their status. With D the change of C at the unknowns E, the
    columns of (S + C)⁻¹ at E and a system of the size of E give the solution for S + C + D
    (Woodbury's identity).

    Attributes:
        error: Exception in a callback, which PETSc does not propagate; see `raise_stored_error`.
    """

    def __init__(self) -> None:
        self.error: BaseException | None = None
        self._operator = SumOperator()
        empty: Array = np.zeros((0, 0))
        no_dofs: Index = np.zeros(0, dtype=np.intp)
        # LU factors of S + C; S, and rows, columns and values of C at that time.
        self._factor = empty, no_dofs
        self._factored: tuple[Array, Index, Index, Array] | None = None
        # Numbers of the known columns of the inverse and of the changed unknowns; these columns,
        # those of the changed unknowns, the change D, and LU factors of I + (S + C)⁻¹ D at E.
        self._column_dofs, self._changed_dofs = no_dofs, no_dofs
        self._columns, self._changed_columns, self._change = empty, empty, empty
        self._core = empty, no_dofs

    def raise_stored_error(self) -> None:
        """Raise the exception of the last callback here or in the operator."""
        for part in (self, self._operator):
            error, part.error = part.error, None
            try:
                if error is not None:
                    raise error
            finally:
                del error  # breaks the cycle of traceback and frame

    def setUp(self, pc: PETSc.PC) -> None:
        """Update the factors, or factor again."""
        reasons = PETSc.PC.FailedReason
        self._operator = pc.getOperators()[1].getPythonContext()
        try:
            # Only the first rank has unknowns.
            regular = not len(self._operator.fixed) or self._update_low_rank() or self.refactor()
        except BaseException as error:
            self.error, regular = self.error or error, False
            self._factored = None
        regular = broadcast_from_root(pc.comm.tompi4py(), regular)
        pc.setFailedReason(reasons.NOERROR if regular else reasons.FACTOR_NUMERIC_ZEROPIVOT)

    def refactor(self) -> bool:
        """Factor S + C; return whether it is regular."""
        fixed, (rows, columns, values) = self._operator.fixed, self._operator.added
        whole = fixed.copy(order="F")
        whole[rows, columns] += values
        self._factor = _factor_lu(whole)
        regular = bool(np.all(np.diag(self._factor[0])))
        self._factored = (fixed, rows, columns, values) if regular else None
        self._changed_dofs = self._column_dofs = np.zeros(0, dtype=np.intp)
        self._columns = np.zeros((len(fixed), 0))
        return regular

    def _update_low_rank(self) -> bool:
        """Update the solution by the change of C if it has low rank; return whether it does."""
        if self._factored is None:
            return False
        fixed, *places, factored = self._factored
        rows, columns, values = self._operator.added
        if self._operator.fixed is not fixed or not all(
            map(np.array_equal, (rows, columns), places)
        ):
            return False
        change = values - factored
        is_changed = change != 0.0
        rows, columns = rows[is_changed], columns[is_changed]
        dofs = np.union1d(rows, columns)
        new = np.setdiff1d(dofs, self._column_dofs)
        if self._column_dofs.size + new.size > _MAX_UPDATE_RATIO * len(fixed):
            return False
        unit = np.zeros((len(fixed), new.size), order="F")
        unit[new, np.arange(new.size)] = 1.0
        solved = scipy.linalg.lu_solve(self._factor, unit, overwrite_b=True, check_finite=False)
        self._columns = np.hstack([self._columns, solved])
        self._column_dofs = np.concatenate([self._column_dofs, new])
        order = np.argsort(self._column_dofs)
        indices = order[np.searchsorted(self._column_dofs, dofs, sorter=order)]
        self._changed_dofs, self._changed_columns = dofs, self._columns[:, indices]
        self._change = np.zeros((dofs.size, dofs.size))
        position = np.searchsorted(dofs, rows), np.searchsorted(dofs, columns)
        self._change[position] = change[is_changed]
        self._core = _factor_lu(np.eye(dofs.size) + self._changed_columns[dofs] @ self._change)
        return bool(np.all(np.diag(self._core[0])))

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Solve; the result is NaN after an exception."""
        try:
            if y.array.size:
                y.array[:] = self._solve(x.array_r)
        except BaseException as error:
            self.error = self.error or error  # PETSc may call again
            y.set(np.nan)

    def _solve(self, right: Array) -> Array:
        """Solve, and factor again if the residual of an updated solution is too large."""
        solution = scipy.linalg.lu_solve(self._factor, right, check_finite=False)
        if not self._changed_dofs.size:
            return solution
        at_changed = scipy.linalg.lu_solve(
            self._core, solution[self._changed_dofs], check_finite=False
        )
        solution -= self._changed_columns @ (self._change @ at_changed)
        residual = right - self._operator.product(solution)
        if not np.linalg.norm(residual) <= _UPDATE_RTOL * np.linalg.norm(right):
            self.refactor()
            return scipy.linalg.lu_solve(self._factor, right, check_finite=False)
        return solution


def _factor_lu(matrix: Array) -> tuple[Array, Index]:
    """Return the LU factors of a matrix, which is overwritten; zero pivots are not reported."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", scipy.linalg.LinAlgWarning)
        return scipy.linalg.lu_factor(matrix, overwrite_a=True, check_finite=False)


def raise_stored_error(ksp: PETSc.KSP) -> None:
    """Raise the exception that a Python context of a solver stored, on all ranks. Collective."""
    context = ksp.getPC().getPythonContext() if ksp.getPC().getType() == "python" else None
    if isinstance(context, UpdatedLU):
        with collective_errors(ksp.comm.tompi4py()):
            context.raise_stored_error()
