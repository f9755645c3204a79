"""Solver for dense matrices S + C of which C changes, and acts on some of the unknowns only.

All of it is on the first rank; the others have no unknowns, and wait.
"""

from __future__ import annotations

import warnings

import numpy as np
import scipy.linalg
import scipy.spatial
from petsc4py import PETSc

from fenics_contact.parallel import agreed, collective_errors
from fenics_contact.tolerances import ROUND_OFF
from fenics_contact.types import Array, Index, Mask

__all__ = ["PartlyFactored", "Sum", "raise_kept"]


# So many more unknowns than C acts on, the nearest ones, are factored with it, that a contact has
# room to grow.
_MARGIN = 0.5
# Share of all unknowns above which none are left out.
_MOST = 0.9
# Share of the unknowns of A up to which a change of C is a correction to the last factors.
_CORRECTED = 0.25
# Residual, relative, that a corrected solution may have before all is factored.
_ACCURATE = 1e-11


class Sum:
    """Context of a PETSc Mat, S + C.

    Attributes:
        fixed: S, (n, n).
        added: Rows, columns and values of C's entries.
        error: What `mult` ran into: PETSc carries no exception; see `raise_kept`.
    """

    def __init__(self) -> None:
        """Nothing yet; see `set_parts`."""
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
            y.array[:] = self._product(x.array_r, transposed)
        except BaseException as error:
            self.error = self.error or error
            y.set(np.nan)

    def _product(self, state: Array, transposed: bool) -> Array:
        fixed, (rows, columns, values) = self.fixed, self.added
        if transposed:
            fixed, rows, columns = fixed.T, columns, rows
        added = np.bincount(rows, values * state[columns], minlength=state.size)
        return np.asarray(fixed @ state + added)


class PartlyFactored:
    """Context of the PC of a `Sum`, LU by blocks: what C does not act on is factored once.

    With A the unknowns on which C acts and some around them, and O the others, S_AA + C_AA less
    the constant S_AO S_OO⁻¹ S_OA is what remains to be factored for every C. It is as exact as
    LU of the whole. Where contact is open C is zero. While C differs in few places from what was
    factored last, the factors are corrected.

    Attributes:
        error: As of `Sum`.
        outside: The unknowns in O.
    """

    def __init__(self, places: Array) -> None:
        """Nothing is factored yet.

        Args:
            places: Where the unknowns are, (n, gdim); NaN for those nowhere, which are always in A.
        """
        nothing: Array = np.zeros((0, 0))
        nowhere: Index = np.zeros(0, dtype=np.intp)
        factors = nothing, nowhere
        self.error: BaseException | None = None
        self._places, self._nowhere = places, np.any(np.isnan(places), axis=1)
        self._acted: Mask = self._nowhere  # the unknowns that must be in A
        self._operator = Sum()
        self._fixed = self._operator.fixed
        self._pattern = self._operator.added[:2]
        # The unknowns in A, those in O, and the places in A of those that are there.
        self._in: Index = np.arange(len(places))
        self.outside, self._position = nowhere, self._in
        # LU of S_OO; S_AO; S_OO⁻¹ S_OA; and what they leave of S_AA.
        self._factor_out, self._coupling, self._extension = factors, nothing, nothing
        self._reduced = self._fixed
        # LU of that with C, and the values of C in it.
        self._factor = factors
        self._factored: Array | None = None
        # Columns of its inverse: those known, and of which unknowns; those for the unknowns that
        # have changed, the change, and LU of the system that corrects by it.
        self._known, self._columns = nowhere, nothing
        self._changed, self._answers, self._change = nowhere, nothing, nothing
        self._core = factors

    def raise_kept(self) -> None:
        """Raise what this, or the operator, ran into when PETSc called it last."""
        for part in (self, self._operator):
            error, part.error = part.error, None
            try:
                if error is not None:
                    raise error
            finally:
                del error  # it keeps this frame, which would keep it and all that solves

    def _forget(self) -> None:
        self._in = np.arange(len(self._places))
        self.outside, self._position = np.zeros(0, dtype=np.intp), self._in
        self._reduced, self._factored = self._fixed, None

    def setUp(self, pc: PETSc.PC) -> None:
        """Factor, or find out what the last factors lack."""
        reasons = PETSc.PC.FailedReason
        self._operator = pc.getOperators()[1].getPythonContext()
        try:
            regular = self._set_up()
        except BaseException as error:
            self.error, regular = self.error or error, False
            self._factored = None
        regular = agreed(pc.comm.tompi4py(), regular)
        pc.setFailedReason(reasons.NOERROR if regular else reasons.FACTOR_NUMERIC_ZEROPIVOT)

    def _set_up(self) -> bool:
        """Do so for the present operator; whether it is regular."""
        if not len(self._places):
            return True
        if self._operator.fixed is not self._fixed:
            self._fixed = self._operator.fixed
            self._forget()
        rows, columns, values = self._operator.added
        if not all(map(np.array_equal, (rows, columns), self._pattern)):
            self._pattern, self._factored = (rows, columns), None
        acts = values != 0.0
        self._acted = self._nowhere.copy()
        self._acted[rows[acts]] = self._acted[columns[acts]] = True
        n_acted, n = np.count_nonzero(self._acted), len(self._places)
        fits = not self._acted[self.outside].any()
        roomy = self._in.size > (1 + _MARGIN) ** 2 * n_acted + 1
        if not fits or (roomy and n_acted < _MOST * n / (1 + _MARGIN)):
            self._divide()
        return self._correct() or self.factor_anew()

    def factor_anew(self) -> bool:
        """Factor the block of A as it is now; whether it is regular."""
        block = self._reduced.copy(order="F")
        rows, columns, values = self._present()
        block[rows, columns] += values
        self._factor = _factors(block)
        regular = bool(np.all(np.diag(self._factor[0])))
        self._factored = self._operator.added[2] if regular else None
        self._changed = self._known = np.zeros(0, dtype=np.intp)
        self._columns = np.zeros((self._in.size, 0))
        return regular

    def _present(self) -> tuple[Index, Index, Array]:
        """C within A: rows, columns and values."""
        rows, columns, values = self._operator.added
        acts = values != 0.0
        return self._position[rows[acts]], self._position[columns[acts]], values[acts]

    def _correct(self) -> bool:
        """Find the change since the last factorisation, if it is of few unknowns; whether it is.

        From one iteration to the next a few points change between open, stick and slip. With E the
        unknowns they reach and D the change of C there, the columns of A⁻¹ for E and a system as
        large as E make the solutions of A + D (Woodbury's identity).
        """
        if self._factored is None:
            return False
        rows, columns, values = self._operator.added
        change = values - self._factored
        matters = change != 0.0
        rows, columns = self._position[rows[matters]], self._position[columns[matters]]
        reached = np.union1d(rows, columns)
        new = np.setdiff1d(reached, self._known)
        if self._known.size + new.size > _CORRECTED * self._in.size:
            return False
        unit = np.zeros((self._in.size, new.size), order="F")
        unit[new, np.arange(new.size)] = 1.0
        made = scipy.linalg.lu_solve(self._factor, unit, overwrite_b=True, check_finite=False)
        self._columns = np.hstack([self._columns, made])
        self._known = np.concatenate([self._known, new])
        order = np.argsort(self._known)
        among = order[np.searchsorted(self._known, reached, sorter=order)]
        self._changed, self._answers = reached, self._columns[:, among]
        self._change = np.zeros((reached.size, reached.size))
        places = np.searchsorted(reached, rows), np.searchsorted(reached, columns)
        self._change[places] = change[matters]
        self._core = _factors(np.eye(reached.size) + self._answers[reached] @ self._change)
        return bool(np.all(np.diag(self._core[0])))

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
        factor = _factors(self._fixed[np.ix_(outside, outside)])
        pivots = np.abs(np.diag(factor[0]))
        if not pivots.min() > ROUND_OFF * pivots.max():
            return
        self._in, self.outside, self._factor_out = inside, outside, factor
        self._coupling = self._fixed[np.ix_(inside, outside)]
        right = self._fixed[np.ix_(outside, inside)]
        self._extension = scipy.linalg.lu_solve(factor, right, check_finite=False)
        self._reduced = self._fixed[np.ix_(inside, inside)] - self._coupling @ self._extension
        self._position = np.full(n, -1)
        self._position[inside] = np.arange(inside.size)

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Solve; with what is no number if that fails."""
        try:
            self._apply(x.array_r, y.array)
        except BaseException as error:
            self.error = self.error or error  # PETSc may go on for a while
            y.set(np.nan)

    def _apply(self, right: Array, solution: Array) -> None:
        if not len(self._places):
            return
        if not self.outside.size:
            solution[:] = self._solve(right)
            return
        outside = scipy.linalg.lu_solve(self._factor_out, right[self.outside], check_finite=False)
        rest = right[self._in] - self._coupling @ outside
        inside = self._solve(rest)
        solution[self._in] = inside
        solution[self.outside] = outside - self._extension @ inside

    def _solve(self, right: Array) -> Array:
        """Solve with the block of A, and look whether a correction was good enough."""
        solution = scipy.linalg.lu_solve(self._factor, right, check_finite=False)
        if not self._changed.size:
            return solution
        at_changed = scipy.linalg.lu_solve(self._core, solution[self._changed], check_finite=False)
        solution -= self._answers @ (self._change @ at_changed)
        rows, columns, values = self._present()
        added = np.bincount(rows, values * solution[columns], minlength=right.size)
        left = right - self._reduced @ solution - added
        if not np.linalg.norm(left) <= _ACCURATE * np.linalg.norm(right):
            self.factor_anew()
            return scipy.linalg.lu_solve(self._factor, right, check_finite=False)
        return solution


def _factors(matrix: Array) -> tuple[Array, Index]:
    """LU of a matrix, which is used up; a zero pivot is looked for by the caller."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", scipy.linalg.LinAlgWarning)
        return scipy.linalg.lu_factor(matrix, overwrite_a=True, check_finite=False)


def raise_kept(ksp: PETSc.KSP) -> None:
    """Raise what the contexts of a solver ran into when PETSc called them last, if it has any.

    Collective: all ranks raise what one has.
    """
    context = ksp.getPC().getPythonContext() if ksp.getPC().getType() == "python" else None
    if isinstance(context, PartlyFactored):
        with collective_errors(ksp.comm.tompi4py()):
            context.raise_kept()
