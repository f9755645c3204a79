"""What a method of solution is: one solution by the main SNES, or by solvers of its own."""

from __future__ import annotations

import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from petsc4py import PETSc

from fenics_contact import compat
from fenics_contact.methods.callbacks import Callbacks
from fenics_contact.methods.equations import Equations
from fenics_contact.methods.options import Defaults
from fenics_contact.systems import linear
from fenics_contact.types import Array

__all__ = ["Method", "Newton", "SnesMethod", "SolverContext", "StandaloneMethod"]

# Least decrease of the level function along a step. Without any, Newton's method cycled between two
# states whose levels were 0.93 and 0.96 of each other's; with a quarter (Deuflhard's restricted
# monotonicity) it does not begin where one point is closed, from which levels fall to 0.83.
_DECREASE = 0.1
# Share of a step from which on it is the whole one, and no half: multigrid has it to a hundredth.
_WHOLE = 0.9
# Iterations without a lower residual, see `ActiveSetMonitor.n_stalled`, after which another method takes
# over.
_PATIENCE = 14
# What shows how a solver fares; under the problem's own prefix it is for those inside, too.
_MONITORS = ("snes_monitor", "snes_linesearch_monitor", "snes_converged_reason", "ksp_monitor")

_REASONS = PETSc.SNES.ConvergedReason


class Method(ABC):
    """A way to solve equations from a start: on the main SNES, or an `StandaloneMethod`."""

    @classmethod
    def main_options(cls) -> Mapping[str, Any]:
        """Options of the main SNES; by default none of its own."""
        return {}

    @abstractmethod
    def solve(self) -> tuple[int, int]:
        """Solve from ``solution`` of the equations on, which becomes what was found. Collective.

        Returns:
            Iterations, and the reason as SNES has them (positive: converged).
        """


@dataclass(frozen=True)
class SolverContext:
    """What methods with solvers of their own are made of, and do not keep: it leads to PETSc's.

    Attributes:
        equations: What to solve.
        defaults: What takes options.
        prefix: Of the problem's options.
        linear_solver: Options of a linear solver of one's own, for symmetric matrices or any; none:
            the one of the matrix will do.
    """

    equations: Equations
    defaults: Defaults
    prefix: str
    linear_solver: Callable[[bool], dict[str, Any]]

    def newton(self, part: str, options: Mapping[str, Any]) -> Newton:
        """Newton's method on a SNES of its own; `Newton.attach` before every solution. Collective.

        Args:
            part: What follows the prefix of the problem's options in that of this SNES.
            options: Those that differ from `Newton.main_options`.
        """
        snes, own = self.snes(part, {**Newton.main_options(), **options})
        return Newton(self.equations, snes, lambda: True, own_solver=own)

    def snes(
        self,
        part: str,
        options: Mapping[str, Any],
        *,
        consistent: bool = True,
        with_own: Mapping[str, Any] | None = None,
    ) -> tuple[PETSc.SNES, bool]:
        """A SNES of its own, and whether its linear solver is, too. Collective.

        Args:
            part: What follows the prefix of the problem's options in that of this SNES.
            options: Of it, that of a linear solver of its own apart.
            consistent: Whether it is for the consistent tangent, not for H₀.
            with_own: More of them where the linear solver is its own.
        """
        solver = self.linear_solver(self.equations.is_symmetric(consistent))
        prefix, defaults = self.prefix + part, self.defaults
        snes = PETSc.SNES().create(self.equations.full.unknowns.comm)
        snes.setOptionsPrefix(prefix)
        defaults.set({**options, **solver, **((with_own or {}) if solver else {})}, prefix)
        monitors = {name: defaults.get(self.prefix + name) for name in _MONITORS}
        defaults.set({k: v for k, v in monitors.items() if v is not None}, prefix)
        defaults.let_read(snes)
        return snes, bool(solver)


class StandaloneMethod(Method):
    """A method with solvers of its own; a new one is such a class, and a line in `METHODS`.

    `solve` starts from ``equations.solution`` and leaves there what it has found, with the data of
    the contacts as they were; it has converged where ``equations.solved()`` after an
    ``equations.residual``. Newton's method of `SolverContext.newton` does both: `Newton.attach` it
    before
    every solution, and return what its ``solve`` returns. It gives up after 14 iterations without
    a lower residual (`ActiveSetMonitor.n_stalled`), so that the methods that follow get their turn.

    Attributes:
        is_newton_solution: Whether Newton's method found the last solution, so that the consistent tangent
            is factored near it.
    """

    is_newton_solution = False

    @abstractmethod
    def __init__(self, context: SolverContext) -> None:
        """Set up what solves. Collective."""

    @property
    def suits(self) -> bool:
        """Whether `check` would pass, and there are contacts that it is for."""
        return True

    def check(self) -> None:
        """Look whether there is what it solves, where it was asked for.

        Raises:
            ValueError: It says why there is not.
        """
        return


class SnesMethod(Method):
    """A method on a SNES: the main one, whose options are the user's, or one of another method.

    Args:
        equations: What to solve.
        own_solver: Whether SNES keeps its own linear solver, not that of the matrix.

    Attributes:
        snes: The solver.
        gives_up: Whether to stop where the residual does not fall any more.
        coarse: Residual, as a share of the forces, that ends it before the tolerance does.
    """

    def __init__(
        self,
        equations: Equations,
        snes: PETSc.SNES,
        gives_up: Callable[[], bool],
        *,
        own_solver: bool = False,
    ) -> None:
        self.snes, self.gives_up, self.coarse_rtol = snes, gives_up, 0.0
        self._own_solver = own_solver
        self._function: PETSc.Vec | None = None  # of the system it is attached to
        self._equations = equations
        self._callbacks = Callbacks(equations.full.unknowns.comm)
        self.consistent = False

    @property
    def max_it(self) -> int:
        """Iterations in all before it is given up."""
        return int(self.snes.getTolerances()[3])

    @max_it.setter
    def max_it(self, limit: int) -> None:
        self.snes.setTolerances(max_it=limit)

    def attach(self, *, consistent: bool) -> None:
        """Give SNES its callbacks and the linear solver for H₀ or the consistent tangent."""
        self.consistent = consistent
        # Weak, so that SNES does not keep what keeps SNES: the garbage collector would free such a
        # cycle, at another time on every rank, and to free a factorisation is collective.
        this: SnesMethod = weakref.proxy(self)
        equations = self._equations
        if self._function not in (None, equations.function):
            self.snes.reset()
        self._function = equations.function
        if not self._own_solver:
            self.snes.setKSP(equations.solvers[consistent])
        self._callbacks.attach(
            self.snes,
            lambda x, f: this._compute_residual(x, f),
            equations.function,
            lambda x, J: this._compute_jacobian(x, J),
            equations.matrix(consistent),
            lambda: this.converged(),
        )

    def _compute_residual(self, x: PETSc.Vec, f: PETSc.Vec) -> None:
        self._equations.residual(x, f)

    def _compute_jacobian(self, x: PETSc.Vec, J: PETSc.Mat) -> None:
        self._equations.assemble_tangent(x, J)

    def solve(self) -> tuple[int, int]:
        """See `Method.solve`."""
        return self._callbacks.solve(self.snes, self._equations.solution)

    def converged(self) -> int:
        """Why SNES ends here, or that it goes on, as SNES has it."""
        if self._equations.solved(self.coarse_rtol):
            return int(_REASONS.CONVERGED_FNORM_RELATIVE)
        if self._equations.monitor.n_stalled > _PATIENCE and self.gives_up():
            return int(_REASONS.DIVERGED_LINE_SEARCH)
        return int(_REASONS.ITERATING)


class Newton(SnesMethod):
    """Newton's method with the consistent tangent.

    Attributes:
        max_halvings: Of a step that `_level` refuses, before what is left of it is taken: where a
            point is about to change its status no share of a step need lower anything. Infinite:
            the line search fails.
    """

    def __init__(
        self,
        equations: Equations,
        snes: PETSc.SNES,
        gives_up: Callable[[], bool],
        *,
        own_solver: bool = False,
    ) -> None:
        super().__init__(equations, snes, gives_up, own_solver=own_solver)
        self._iterate: tuple[PETSc.Vec, PETSc.Vec] | None = None  # and the residual there
        self._step: float | None = None  # norm of the correction there, once it is asked for
        self._trial: Array | None = None  # whose tangent the matrix holds, if not the iterate's
        self.max_halvings = np.inf
        self._trials = 0  # of the present step
        self._looks_ahead = False  # whether to ask for the correction after a whole step

    @classmethod
    def main_options(cls) -> Mapping[str, Any]:
        """See `Method.main_options`: steps are halved until `_level` falls."""
        return {
            "snes_type": "newtonls",
            "snes_stol": 0.0,
            "snes_max_it": 100,
            compat.LONGEST_STEP: 100.0,
            "snes_linesearch_type": "bt",
            "snes_linesearch_order": 1,
            "snes_linesearch_alpha": 0.0,
            "snes_linesearch_max_it": 40,
        }

    def attach(self, *, consistent: bool) -> None:
        """See `SnesMethod.attach`; a line search gets its level function."""
        super().attach(consistent=consistent)
        self._iterate = self._trial = None
        if self.snes.getType() != PETSc.SNES.Type.NEWTONLS:
            return
        this: Newton = weakref.proxy(self)
        self._callbacks.set_level_function(
            self.snes,
            lambda x, f: this._compute_residual(x, f),
            self._equations.function.duplicate(),
            lambda x, f: this._level(x, f),
        )

    def _compute_jacobian(self, x: PETSc.Vec, J: PETSc.Mat) -> None:
        trial, self._iterate, self._trial = self._trial, None, None
        different = trial is None or not np.array_equal(x.array_r, trial)
        if self._equations.full.unknowns.comm.allreduce(int(different)):
            super()._compute_jacobian(x, J)
        else:
            self._equations.note()

    def _level(self, x: PETSc.Vec, f: PETSc.Vec) -> float:
        """min(|J⁻¹f| / |J⁻¹f₀|, |f| / |f₀|)² of a residual f at a trial x. Collective.

        J is the tangent and f₀ the residual of the iterate from which the line search starts, where
        it asks first. The first ratio is the natural level function (P. Deuflhard, Newton Methods
        for Nonlinear Problems, 2004, section 3.3): a step is taken if the simplified Newton
        correction behind it is smaller than the step, by a tenth of the share of it that is tried.
        Where a slender body turns a linear step stretches it by the square of the angle, which
        takes forces orders of magnitude larger than to bend it, and where stiff contact closes a
        little too deep forces are large, too; the next correction is small. Where points change
        their status neither need fall along a step: it is taken if one does.

        Neither need fall where points close along a step, whose stiffness J does not have. On a
        linear bulk little else changes J: a whole step is taken, too, if the correction that
        follows, by the tangent at its end, is smaller. Where it is not, as between stick and slip,
        that is not tried again in this solution: it costs two factorisations.
        """
        if self._iterate is None:
            self._iterate, self._step = (x.copy(), f.copy()), None
            self._trials = 0
            return 1.0
        self._trials += 1
        if self._trials > self.max_halvings:
            return 0.0
        iterate, residual = self._iterate
        if residual.norm() == 0.0:  # what is left is round-off that no step takes away
            return 1.0
        fall = f.norm() / residual.norm()
        if fall <= 1.0 - _DECREASE:
            return float(fall * fall)
        if self._step is None:
            self._step = self._correction(residual)
        # Nor is the first step that is tried the whole one where that is too long.
        share = (x - iterate).norm() / self._step
        enough = 1.0 - _DECREASE * min(1.0, float(share))
        level = min(fall, self._correction(f) / self._step) / enough
        if level > 1.0 and share > _WHOLE and self._looks_ahead:
            tangent = self._equations.matrix(True)
            self._equations.assemble_tangent(x, tangent, trial=True)
            if self._correction(f) <= enough * self._step:
                self._trial = x.array_r.copy()
                return 0.0
            self._looks_ahead, self._trial = False, None
            self._equations.assemble_tangent(iterate, tangent, trial=True)
        return float(level * level)  # infinite where it overflows

    def _correction(self, f: PETSc.Vec) -> float:
        """Norm of the Newton correction of a residual by the present tangent. Collective."""
        ksp, correction = self.snes.getKSP(), f.duplicate()
        ksp.solve(f, correction)
        found = ksp.getConvergedReason() > 0
        linear.forget_failure(ksp.getPC())
        size = correction.norm() if found else np.inf
        correction.destroy()
        return float(size)

    def solve(self) -> tuple[int, int]:
        """See `Method.solve`."""
        self._iterate = self._trial = None
        self._looks_ahead = self._equations.full.bulk.linear
        iterations, reason = super().solve()
        # The line search `cp`, by option, takes a step across the residual, F·y = 0, for the end.
        if reason == _REASONS.CONVERGED_FNORM_ABS:
            reason = int(_REASONS.DIVERGED_LINE_SEARCH)
        return iterations, reason
