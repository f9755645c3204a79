"""Base classes of the solution methods, and Newton's method."""

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

# Least decrease of the level function along a step. With 0 Newton's method cycled between states
# with level ratios of 0.93 and 0.96; with 0.25 (Deuflhard's restricted monotonicity) it fails where
# one point is closed, with a ratio of 0.83.
_MIN_LEVEL_DECREASE = 0.1
# Least ratio of a full step to the correction, which multigrid computes to 1 %.
_FULL_STEP_RATIO = 0.9
_MAX_STALLED_ITERATIONS = 14  # `ActiveSetMonitor.n_stalled` at which another method takes over
# Options with the problem's prefix that also apply to the inner solvers.
_MONITORS = ("snes_monitor", "snes_linesearch_monitor", "snes_converged_reason", "ksp_monitor")

_REASONS = PETSc.SNES.ConvergedReason


class Method(ABC):
    """A solution method, on the main SNES or a `StandaloneMethod`."""

    @classmethod
    def main_options(cls) -> Mapping[str, Any]:
        """Return default options of the main SNES for this method."""
        return {}

    @abstractmethod
    def solve(self) -> tuple[int, int]:
        """Solve the equations from their ``solution``, which is overwritten. Collective.

        Returns:
            Iterations and SNES reason (positive: converged).
        """


@dataclass(frozen=True)
class SolverContext:
    """Data to construct a `StandaloneMethod`, which must not store them (PETSc reference cycles).

    Attributes:
        equations: The equations.
        defaults: Database of default options.
        prefix: Prefix of the problem's options.
        linear_solver: Return the options of a separate linear solver, by the symmetry of the
            matrix; empty: the linear solver of the matrix is used.
    """

    equations: Equations
    defaults: Defaults
    prefix: str
    linear_solver: Callable[[bool], dict[str, Any]]

    def newton(self, part: str, options: Mapping[str, Any]) -> Newton:
        """Create Newton's method on a new SNES; `attach` it before every solution. Collective.

        Args:
            part: Part of the prefix of this SNES after the problem's.
            options: Options that differ from `Newton.main_options`.
        """
        snes, own = self.create_snes(part, {**Newton.main_options(), **options})
        return Newton(self.equations, snes, lambda: True, own_solver=own)

    def create_snes(
        self,
        part: str,
        options: Mapping[str, Any],
        *,
        consistent: bool = True,
        with_own: Mapping[str, Any] | None = None,
    ) -> tuple[PETSc.SNES, bool]:
        """Create a SNES; return it, and whether it has a separate linear solver. Collective.

        Args:
            part: Part of the prefix of this SNES after the problem's.
            options: Options of the SNES.
            consistent: Whether the matrix is the consistent tangent, not H₀.
            with_own: Additional options with a separate linear solver.
        """
        solver = self.linear_solver(self.equations.is_symmetric(consistent))
        prefix, defaults = self.prefix + part, self.defaults
        snes = PETSc.SNES().create(self.equations.full.unknowns.comm)
        snes.setOptionsPrefix(prefix)
        defaults.set({**options, **solver, **((with_own or {}) if solver else {})}, prefix)
        monitors = {name: defaults.get(self.prefix + name) for name in _MONITORS}
        defaults.set({k: v for k, v in monitors.items() if v is not None}, prefix)
        defaults.set_from_options(snes)
        return snes, bool(solver)


class StandaloneMethod(Method):
    """A method with its own nonlinear solvers, registered in `METHODS`.

    `solve` starts from ``equations.solution`` and overwrites it, and restores the data of the
    contacts; it has converged if ``equations.is_converged()`` after ``equations.residual``. Reasons
    are those of SNES; ``DIVERGED_LINE_SEARCH`` is reported as "no progress". An iteration without
    SNES assembles ``equations.matrix(True)`` by `Equations.assemble_tangent`, and solves with
    ``equations.solvers[True]``. Newton's method of `SolverContext.newton` does all of this: call
    `Newton.attach` before every solution, and return the result of its ``solve``. It fails after 14
    iterations without a lower residual (`ActiveSetMonitor.n_stalled`), so that another method can
    take over.

    Attributes:
        is_newton_solution: Whether Newton's method computed the last solution, near which the
            consistent tangent is factored then.
    """

    is_newton_solution = False

    @abstractmethod
    def __init__(self, context: SolverContext) -> None:
        """Create the solvers. Collective."""

    @property
    def is_applicable(self) -> bool:
        """Whether the method applies to the problem, without `check` failing."""
        return True

    def check(self) -> None:
        """Check that the method, requested by the user, applies to the problem.

        Raises:
            ValueError: The method does not apply.
        """
        return


class SnesMethod(Method):
    """A method on a SNES: the main one, with the user's options, or one of another method.

    Args:
        equations: The equations.
        own_solver: Whether SNES has its own linear solver, not that of the matrix.

    Attributes:
        snes: The solver.
        can_hand_over: Return whether to stop when the residual stalls.
        coarse_rtol: Residual by the forces that suffices, if larger than the tolerance.
    """

    def __init__(
        self,
        equations: Equations,
        snes: PETSc.SNES,
        can_hand_over: Callable[[], bool],
        *,
        own_solver: bool = False,
    ) -> None:
        self.snes, self.can_hand_over, self.coarse_rtol = snes, can_hand_over, 0.0
        self._own_solver = own_solver
        self._function: PETSc.Vec | None = None  # residual of the attached system
        self._equations = equations
        self._callbacks = Callbacks(equations.full.unknowns.comm)
        self.consistent = False

    @property
    def max_it(self) -> int:
        """Maximum number of iterations."""
        return int(self.snes.getTolerances()[3])

    @max_it.setter
    def max_it(self, limit: int) -> None:
        self.snes.setTolerances(max_it=limit)

    def attach(self, *, consistent: bool) -> None:
        """Set callbacks and the linear solver, for H₀ or the consistent tangent, in SNES."""
        self.consistent = consistent
        # Weak: the garbage collector would free a cycle at different times on the ranks, and to
        # free a factorisation is collective.
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
        """Solve the equations by the SNES. Collective."""
        return self._callbacks.solve(self.snes, self._equations.solution)

    def converged(self) -> int:
        """Return the SNES reason of the convergence test, or that SNES iterates."""
        if self._equations.is_converged(self.coarse_rtol):
            return int(_REASONS.CONVERGED_FNORM_RELATIVE)
        if self._equations.monitor.n_stalled > _MAX_STALLED_ITERATIONS and self.can_hand_over():
            return int(_REASONS.DIVERGED_LINE_SEARCH)
        return int(_REASONS.ITERATING)


class Newton(SnesMethod):
    """Newton's method with the consistent tangent.

    Attributes:
        max_halvings: Halvings of a step after which it is taken without a decrease of the level,
            which need not exist at a change of status. Infinite: the line search fails.
    """

    def __init__(
        self,
        equations: Equations,
        snes: PETSc.SNES,
        can_hand_over: Callable[[], bool],
        *,
        own_solver: bool = False,
    ) -> None:
        super().__init__(equations, snes, can_hand_over, own_solver=own_solver)
        self._iterate: tuple[PETSc.Vec, PETSc.Vec] | None = None  # with its residual
        self._step_norm: float | None = None  # of its correction, on demand
        self._trial_point: Array | None = None  # of the assembled tangent, if not the iterate
        self.max_halvings = np.inf
        self._n_trials = 0  # of the present step
        self._use_end_tangent = False  # whether to try the tangent at the end of a full step

    @classmethod
    def main_options(cls) -> Mapping[str, Any]:
        """Return options by which steps are halved until the level function decreases."""
        return {
            "snes_type": "newtonls",
            "snes_stol": 0.0,
            "snes_max_it": 100,
            compat.MAX_STEP_OPTION: 100.0,
            "snes_linesearch_type": "bt",
            "snes_linesearch_order": 1,
            "snes_linesearch_alpha": 0.0,
            "snes_linesearch_max_it": 40,
        }

    def attach(self, *, consistent: bool) -> None:
        """Set callbacks, level function and the linear solver in SNES."""
        super().attach(consistent=consistent)
        self._iterate = self._trial_point = None
        if self.snes.getType() != PETSc.SNES.Type.NEWTONLS:
            return
        this: Newton = weakref.proxy(self)
        self._callbacks.set_level_function(
            self.snes,
            lambda x, f: this._compute_residual(x, f),
            self._equations.function.duplicate(),
            lambda x, f: this._compute_level(x, f),
        )

    def _compute_jacobian(self, x: PETSc.Vec, J: PETSc.Mat) -> None:
        trial, self._iterate, self._trial_point = self._trial_point, None, None
        different = trial is None or not np.array_equal(x.array_r, trial)
        if self._equations.full.unknowns.comm.allreduce(int(different)):
            super()._compute_jacobian(x, J)
        else:
            self._equations.record_iterate()

    def _compute_level(self, x: PETSc.Vec, f: PETSc.Vec) -> float:
        """Compute min(|J⁻¹f| / |J⁻¹f₀|, |f| / |f₀|)² of a residual f at a trial x. Collective.

        J is the tangent and f₀ the residual of the iterate, at which the line search evaluates
        first. The first ratio is the natural level function (P. Deuflhard, Newton Methods for
        Nonlinear Problems, 2004, section 3.3): a step is taken if the simplified Newton correction
        is smaller than the step, by a tenth of the damping. It ignores the large residuals of small
        errors: a slender body stretched by a linearised rotation, or stiff contact closed a little
        too deep. At changes of status one of the ratios has to decrease.

        Neither need decrease if points close along the step, whose stiffness is not in J. With a
        linear bulk a full step is also taken if the next correction, by the tangent at its end, is
        smaller. If not, as between stick and slip, this is not tried again in this solution, for it
        costs two factorisations.
        """
        if self._iterate is None:
            self._iterate, self._step_norm = (x.copy(), f.copy()), None
            self._n_trials = 0
            return 1.0
        self._n_trials += 1
        if self._n_trials > self.max_halvings:
            return 0.0
        iterate, residual = self._iterate
        if residual.norm() == 0.0:  # only excluded round-off is left
            return 1.0
        ratio = f.norm() / residual.norm()
        if ratio <= 1.0 - _MIN_LEVEL_DECREASE:
            return float(ratio * ratio)
        if self._step_norm is None:
            self._step_norm = self._compute_correction_norm(residual)
        # The first trial is shorter than the full step if that exceeds the limit.
        damping = (x - iterate).norm() / self._step_norm
        required = 1.0 - _MIN_LEVEL_DECREASE * min(1.0, float(damping))
        level = min(ratio, self._compute_correction_norm(f) / self._step_norm) / required
        if level > 1.0 and damping > _FULL_STEP_RATIO and self._use_end_tangent:
            tangent = self._equations.matrix(True)
            self._equations.assemble_tangent(x, tangent, trial=True)
            if self._compute_correction_norm(f) <= required * self._step_norm:
                self._trial_point = x.array_r.copy()
                return 0.0
            self._use_end_tangent, self._trial_point = False, None
            self._equations.assemble_tangent(iterate, tangent, trial=True)
        return float(level * level)  # infinite where it overflows

    def _compute_correction_norm(self, f: PETSc.Vec) -> float:
        """Compute the norm of J⁻¹f with the present tangent; infinite on failure. Collective."""
        ksp, correction = self.snes.getKSP(), f.duplicate()
        ksp.solve(f, correction)
        solved = ksp.getConvergedReason() > 0
        linear.reset_failed_factorisation(ksp.getPC())
        size = correction.norm() if solved else np.inf
        correction.destroy()
        return float(size)

    def solve(self) -> tuple[int, int]:
        """Solve the equations by Newton's method. Collective."""
        self._iterate = self._trial_point = None
        self._use_end_tangent = self._equations.full.bulk.linear
        iterations, reason = super().solve()
        # The line search `cp`, by option, takes F·y = 0 for convergence.
        if reason == _REASONS.CONVERGED_FNORM_ABS:
            reason = int(_REASONS.DIVERGED_LINE_SEARCH)
        return iterations, reason
