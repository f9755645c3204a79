"""Solution of one increment: choice of system, linear solver and methods, and the fallbacks."""

from __future__ import annotations

import logging
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from petsc4py import PETSc

from fenics_contact import compat
from fenics_contact.arguments import check_bool, check_instance, is_number
from fenics_contact.contact.accuracy import Accuracy
from fenics_contact.methods.attempt import Attempt
from fenics_contact.methods.augmented_lagrangian import RESIDUAL_RATIO, solve_augmented_lagrangian
from fenics_contact.methods.continuation import Continuation
from fenics_contact.methods.equations import Equations
from fenics_contact.methods.linearised_solve import linearised_solver, solve_response
from fenics_contact.methods.load_balance import check_balance
from fenics_contact.methods.method import (
    Method,
    Newton,
    SnesMethod,
    SolverContext,
    StandaloneMethod,
)
from fenics_contact.methods.options import Defaults, take_command_line
from fenics_contact.methods.predictor import Predictor
from fenics_contact.methods.primal_dual import PrimalDual
from fenics_contact.methods.quasi_newton import QuasiNewton
from fenics_contact.methods.retained_dofs import RetainedDofs
from fenics_contact.methods.tresca_fixed_point import TrescaFixedPoint
from fenics_contact.systems import linear
from fenics_contact.systems.condensed import CondensedSystem
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.rigid_body_modes import RigidBodyModes
from fenics_contact.systems.solver_selection import linear_kind, reason_not_to_condense
from fenics_contact.systems.system import System
from fenics_contact.systems.unknowns import DofSubset
from fenics_contact.types import Array, Indices

__all__ = ["METHODS", "Settings", "Solver"]

logger = logging.getLogger("fenics_contact")

_DEFAULT_EXPECTED_INCREMENTS = 4

# Other SNES types need bounds, a hierarchy or a partition of the unknowns, without which they abort
# the program, or solve one linear system. The Newton types factor the consistent tangent.
_NEWTONS = ("newtonls", "newtontr", "newtontrdc")
_SNES_TYPES = (*_NEWTONS, "qn", "nrichardson", "ngmres", "ncg", "anderson")
_REASONS = PETSc.SNES.ConvergedReason
_OUTCOMES = {
    int(_REASONS.DIVERGED_LINEAR_SOLVE): "the matrix is singular",
    compat.DIVERGED_NOT_FINITE: "the residual is not finite",
    int(_REASONS.DIVERGED_MAX_IT): "iteration limit reached",
    int(_REASONS.DIVERGED_LINE_SEARCH): "no progress",
    int(_REASONS.DIVERGED_DTOL): "no progress",
}
_COMMON: dict[str, Any] = {
    "snes_rtol": 1e-9,
    "snes_stol": 0.0,
    "snes_max_it": 1000,
    # The paper's line search: |ρ·Ψ(ΔU + sρ)| ≤ c_L |ρ·Ψ(ΔU)|. The default of `cp`, one secant step,
    # takes three times the iterations, and fails at lower stiffness.
    "snes_linesearch_type": "cp",
    "snes_linesearch_rtol": 0.1,
    "snes_linesearch_max_it": 20,
    # After initial positioning no step needs to be long.
    compat.MAX_STEP_OPTION: 100.0,
    # `cp` takes |F·y| below this for convergence of SNES; the residual itself is tested here.
    "snes_linesearch_atol": 1e-300,
}
# Vector options, without prefix. With products of several vectors by BLAS, the default of PETSc
# 3.25, L-BFGS is not reproducible to the last digit.
_VECTORS: dict[str, Any] = {"vec_mdot_use_gemv": False}
# Options of a linear solver for the sparse matrices over all unknowns.
_LINEAR_SOLVER_OPTIONS = ("ksp_type", "pc_type", "pc_factor_mat_solver_type")
METHODS: dict[str, type[Method]] = {
    "lbfgs": QuasiNewton,
    "newton": Newton,
    "alternating": TrescaFixedPoint,
    "primal_dual": PrimalDual,
    "continuation": Continuation,
}
# Methods after a failure: the first for very stiff friction, in few iterations, the second for
# other problems. The third solved none of 420 random problems that the others failed on, but some
# released wedges, and it detects overloads, as of an interference fit before the first
# augmentation: it is the first if the load exceeds the friction limit under the last pressures.
_FALLBACKS = ("primal_dual", "continuation", "alternating")


@dataclass(frozen=True)
class Settings:
    """Arguments of `ContactProblem` for the solution.

    Raises:
        ValueError: An argument is invalid.
    """

    method: str | None
    alpha: float
    phi: float
    fallback: bool
    condensation: bool | None
    linear_solver: str | None
    petsc_options: Mapping[str, Any]
    prefix: str
    accuracy: Accuracy | None

    def __post_init__(self) -> None:
        """Check the arguments."""
        if self.method not in (None, *METHODS):
            raise ValueError(f"method is {self.method!r}; use one of {sorted(METHODS)}")
        if self.linear_solver not in (None, *linear.KINDS):
            raise ValueError(
                f"linear_solver is {self.linear_solver!r}; use one of {sorted(linear.KINDS)}, or "
                "None to choose by the size of the problem"
            )
        for name, fraction in (("alpha", self.alpha), ("phi", self.phi)):
            if not (is_number(fraction) and 0.0 <= fraction <= 1.0):
                raise ValueError(f"{name} is {fraction!r}; it must be a number between 0 and 1")
        check_bool("fallback", self.fallback)
        if self.condensation is not None:
            check_bool("condensation", self.condensation)
        check_instance("prefix", self.prefix, str)
        check_instance("petsc_options", self.petsc_options, Mapping)


class Solver:
    """Solver of the equations of an increment by one method, and by others after a failure.

    The constructor is collective.

    Args:
        full: The system on all unknowns.
        motions: Rigid-body modes of the bodies.
        settings: Arguments of the problem.

    Attributes:
        snes: The main SNES, with the user's options.
        equations: The equations.
        options: PETSc options, in the database only while they are read.
        method: Name of the first method.
        main: The method on the main SNES.
        condensed: Whether there is static condensation onto the retained unknowns.
        expected_increments: Number of increments expected.
        methods: Further methods, by name.
        predictor: Predictor of the initial guess.
    """

    def __init__(self, full: FullSystem, motions: RigidBodyModes, settings: Settings) -> None:
        self.equations = Equations(full, motions, alpha=settings.alpha, phi=settings.phi)
        self.expected_increments = _DEFAULT_EXPECTED_INCREMENTS
        self.predictor = Predictor(self.equations)
        self._full = full
        # A copy, as the caller may change the options.
        self._settings = replace(settings, petsc_options=dict(settings.petsc_options))
        self._comm = full.unknowns.comm
        self._reason_not_to_condense: str | None = None  # last reason not to condense
        self._pairings = self._present_pairings()  # of the system
        self._retained = RetainedDofs(full, unlimited=bool(settings.condensation))
        # Set by `_configure`, for the expected increments.
        self.options = Defaults()
        self._named_solvers: list[str] = []  # given options of linear solvers
        self.condensed = False
        self.method = settings.method or "lbfgs"
        self.methods: dict[str, StandaloneMethod] = {}
        self.snes: PETSc.SNES
        self.main: SnesMethod
        take_command_line(settings.prefix, self._comm)
        self._configure()

    @property
    def system(self) -> System:
        """The system that is solved."""
        return self.equations.system

    # ---- choices ---------------------------------------------------------------------------------

    def _configure(self) -> None:
        """Set up SNES and its two linear solvers: for H₀, and for the consistent tangent."""
        settings, prefix, equations = self._settings, self._settings.prefix, self.equations
        options = self.options = Defaults()
        options.set(_VECTORS, "")
        options.set_caller_options(settings.petsc_options, prefix)
        if settings.accuracy is not None:
            # Multipliers do not converge with residuals of the size of their tolerance.
            augmented = [c for c in self._full.contacts if c.multipliers is not None]
            least = [RESIDUAL_RATIO * c.tolerance for c in augmented]
            options.set({"snes_rtol": min(settings.accuracy.rtol, *least, 1.0)}, prefix)
            if self._comm.rank == 0:
                logger.info("accuracy %s", settings.accuracy)
        solvers = [part + name for part in ("", "tangent_") for name in _LINEAR_SOLVER_OPTIONS]
        self._named_solvers = [name for name in solvers if options.get(prefix + name) is not None]
        self.condensed = self._choose_condensation()
        self._full.linear_kind = self._choose_linear_solver()
        self._set_system()
        self.method = settings.method or _choose_method(self._full, condensed=self.condensed)
        snes_type = options.get(prefix + "snes_type")
        main_options = self._main_options()
        if snes_type not in (None, main_options.get("snes_type")):
            main_options |= _COMMON  # the method's line search is for its own SNES type
        options.set(main_options, prefix)
        snes_type = options.get(prefix + "snes_type")
        if snes_type is not None and snes_type not in _SNES_TYPES:
            raise ValueError(
                f"the option -{prefix}snes_type is {snes_type!r}, which is unknown or needs more "
                f"than residual and tangent; use one of {', '.join(_SNES_TYPES)}"
            )
        quasi_newton = snes_type == PETSc.SNES.Type.QN
        solver = self.system.linear_kind
        newton = linear.newton_options(solver)
        options.set(linear.quasi_newton_options(solver) if quasi_newton else newton, prefix)
        equations.uses_v_cycle = quasi_newton and solver == "multigrid"
        snes = self.snes = PETSc.SNES().create(self._comm)
        snes.setOptionsPrefix(prefix)
        snes.setType(snes_type)
        snes.setSolution(equations.solution)
        equations.solvers = {}
        for consistent in (False, True):
            # Tolerances that depend on the residual require a KSP created by SNES.
            is_snes_solver = consistent and not quasi_newton
            ksp = snes.getKSP() if is_snes_solver else PETSc.KSP().create(self._comm)
            part = prefix + ("tangent_" if consistent else "")
            ksp.setOptionsPrefix(part)
            symmetric = equations.is_symmetric(consistent)
            options.set(
                self.system.linear_solver(symmetric=symmetric, accurate=not quasi_newton), part
            )
            options.set_from_options(ksp)
            equations.solvers[consistent] = ksp
        this: Solver = weakref.proxy(self)  # without a reference cycle through SNES
        main = QuasiNewton if quasi_newton else Newton
        self.main = main(equations, snes, lambda: this.can_fall_back())
        self.equations.forget_matrices()
        self.main.attach(consistent=not quasi_newton)
        options.set_from_options(snes)
        options.set_up(snes)

        def newton_solver(symmetric: bool) -> dict[str, Any]:
            """Return options of a separate linear solver for Newton's method, if needed."""
            if not newton:
                return {}
            return self.system.linear_solver(symmetric=symmetric, accurate=True) | newton

        self.methods = {}
        context = SolverContext(equations, options, prefix, newton_solver)
        for name, kind in METHODS.items():
            if issubclass(kind, StandaloneMethod):
                self.methods[name] = kind(context)
        asked_for = self.methods.get(settings.method or "")
        if asked_for is not None:
            asked_for.check()
        equations.rtol = snes.getTolerances()[0]

    def set_expected_increments(self, increments: int) -> None:
        """Configure for a number of increments, before the first is solved. Collective."""
        if self.expected_increments != increments:
            self.expected_increments = increments
            if self._choose_condensation() != self.condensed:
                self._reconfigure()

    def _reconfigure(self) -> None:
        """Create SNES again, with the monitors of the previous one. Collective."""
        monitors = self.snes.getMonitor() or ()
        self._configure()
        for monitor, arguments, keywords in monitors:
            self.snes.setMonitor(monitor, arguments, keywords)

    def _choose_condensation(self) -> bool:
        """Return whether to use static condensation, and log a reason not to. Collective."""
        reason = reason_not_to_condense(
            self._full,
            wanted=self._settings.condensation,
            linear_solver=self._settings.linear_solver,
            named=self._named_solvers,
            increments=self.expected_increments,
            n_retained=self._retained.count,
        )
        if reason and reason != self._reason_not_to_condense and self._comm.rank == 0:
            logger.info("no static condensation: %s", reason)
        self._reason_not_to_condense = reason
        return reason is None

    def _choose_linear_solver(self) -> str:
        """Choose the linear solver for all unknowns, one of `linear.KINDS`. Collective."""
        kind, reason = linear_kind(
            self._full,
            wanted=self._settings.linear_solver,
            condensed=self.condensed,
            named=self._named_solvers,
            symmetric=self.equations.is_symmetric(False),
            tangent_symmetric=self.equations.is_symmetric(True),
        )
        if reason and self._comm.rank == 0 and not self.condensed:
            n = self._full.unknowns.first_motion
            logger.info("linear systems of %d unknowns, solver %s: %s", n, kind, reason)
        return kind

    # ---- the system ------------------------------------------------------------------------------

    def _set_system(self) -> None:
        """Set the system to solve: all unknowns, or the retained ones. Collective."""
        system: System = self._full
        if self.condensed:
            selection = DofSubset(self._full.unknowns, self._retained.indices)
            prefix = self._settings.prefix + "interior_"
            system = CondensedSystem(self._full, selection, prefix=prefix)
            if self._comm.rank == 0:
                n = self._full.unknowns.n_global
                logger.info("static condensation onto %d of %d unknowns", selection.n_global, n)
        self._pairings = self._present_pairings()
        with self.options.present():
            self.equations.set_system(system)

    def _present_pairings(self) -> list[int]:
        # With finite kinematics the matrices are always assembled again.
        return [
            0 if c.contact_kinematics.pairs_follow_bodies else c.pairs.n_updates
            for c in self._full.contacts
        ]

    def is_current(self) -> bool:
        """Return whether bulk and pairs are those of the last solution. Collective."""
        return self._full.bulk.is_current() and self._present_pairings() == self._pairings

    def update_system(self, stiffness_changed: bool) -> None:
        """Update the system after changes of the pairs and of the bulk's tangent. Collective."""
        if self._pairings != self._present_pairings():
            if not self.condensed or self._retained.extend():
                self._set_system()
            self._pairings = self._present_pairings()
            self._reset_matrices()
        if stiffness_changed or not self.system.ready:
            self.equations.factorisations += self.system.update()

    # ---- the retained dofs -----------------------------------------------------------------------

    def select_dofs(self) -> bool:
        """Select the retained unknowns; return whether to call `change_dofs`. Collective."""
        others = self.condensed and self._pairings != self._present_pairings()
        return self._retained.select_dofs(other_pairs=others)

    def needs_more_dofs(self, *, found: bool) -> bool:
        """Return whether contact acts on further unknowns, for `change_dofs` to add. Collective.

        Args:
            found: Whether there is a solution, with contacts evaluated on all of Γc.
        """
        if not self.system.is_restricted:
            return False
        required = self._retained.needs_more_dofs(self.system.operators, has_solution=found)
        # Only the full system may have an equilibrium of a body that only contact constrains.
        return required or (not found and len(self.equations.motions.free) > 0)

    def change_dofs(self, *, can_drop: bool) -> None:
        """Retain other unknowns, or solve the full system if that is cheaper. Collective.

        The state is that at the start of the increment.

        Args:
            can_drop: Whether the retained unknowns may be dropped if there are too many.
        """
        self._retained.update(can_drop=can_drop)
        if self._choose_condensation() != self.condensed:
            self._reconfigure()
        elif self.condensed:
            self._set_system()
            self._reset_matrices()

    def retain_dofs(self, retained: Indices) -> None:
        """Retain the unknowns of another run, all if it had no condensation. Collective."""
        is_condensed = self._comm.allreduce(retained.size) > 0
        switch = is_condensed != self.condensed and self._settings.condensation is None
        if is_condensed and self.condensed:
            self._retained.indices = retained
            self._set_system()
        elif switch and not self._retained.is_all:
            self._retained.indices = retained if is_condensed else self._retained.find_coupled()
            self._reconfigure()
        self._retained.is_selected = True

    def clear_history(self) -> None:
        """Delete data of earlier increments. Collective."""
        self.system.forget()
        self._reset_matrices()

    def recover_from_error(self) -> None:
        """Replace vectors and matrices left locked or incomplete by a PETSc error. Collective."""
        self.equations.set_system(self.system)
        self._reset_matrices()

    def _reset_matrices(self) -> None:
        """Create the matrices again, without factorisations. Collective."""
        self.snes.reset()
        self.equations.forget_matrices()
        self.main.attach(consistent=not isinstance(self.main, QuasiNewton))

    # ---- solving ---------------------------------------------------------------------------------

    def solve(
        self,
        *,
        was_unloaded: bool,
        stiffness_changed: bool,
        load_before: Array,
        balance: bool = True,
        fallback: bool = True,
    ) -> tuple[int, list[Attempt], int]:
        """Solve the increment, with augmentations. Collective.

        Args:
            was_unloaded: Whether there was no contact force before.
            stiffness_changed: Whether the bulk's tangent has changed since the last increment.
            load_before: External forces at this rank's unknowns in the committed state (force).
            balance: Whether to raise a ValueError for a load that contact cannot balance.
            fallback: Whether other methods may be tried after a failure.

        Returns:
            Reason of the last solution, attempts, and number of solutions.
        """
        equations = self.equations
        equations.initial_forces = self.system.initial_forces()
        equations.is_round_off_known, equations.overload = False, None
        equations.generalised_loads = equations.motions.generalised_load(self._full.load)

        def iterate(first: bool) -> tuple[int, list[Attempt]]:
            changed = first and stiffness_changed
            return self._iterate(first, was_unloaded, changed, balance=balance, fallback=fallback)

        return solve_augmented_lagrangian(equations, iterate, load_before)

    def _iterate(
        self,
        first: bool,
        was_unloaded: bool,
        stiffness_changed: bool,
        *,
        balance: bool,
        fallback: bool,
    ) -> tuple[int, list[Attempt]]:
        """Solve by one method after another; return reason and attempts. Collective."""
        equations = self.equations
        factored = equations.has_solution_tangent
        equations.monitor.reset()
        guess = self.predictor.choose_initial_guess(
            first_augmentation=first, was_unloaded=was_unloaded
        )
        start: Array = np.divide(guess, equations.length)
        attempts: list[Attempt] = []
        methods: Iterable[str] = self._methods_to_try(guess, fallback=fallback, balance=balance)
        if equations.overload is not None:
            # All have failed, and this method detects whether the overload persists.
            methods = ("alternating",)
        equations.overload = None
        for method in methods:
            equations.solution.array[:] = start
            equations.monitor.reset()
            if stiffness_changed:
                equations.is_h0_current = False
            iterations, reason = self.methods.get(method, self.main).solve()
            attempts.append(Attempt(method, iterations, _describe_outcome(reason, equations)))
            if reason > 0:
                equations.overload = None
                break
            if self._comm.rank == 0:
                logger.info("%s", attempts[-1])
        equations.set_state(equations.solution)
        own = self.methods.get(method)
        newton = self.snes.getType() in _NEWTONS if own is None else own.is_newton_solution
        newton = newton and not isinstance(self.main, QuasiNewton)
        n_iterations = sum(attempt.iterations for attempt in attempts[-1:])
        if reason > 0 and newton and (factored or n_iterations > 0):
            # With a linear bulk the step with this tangent is preferred even with a large residual,
            # which fails after continuation if the load falls to zero.
            self.predictor.store_solution(predict=own is None or not self._full.bulk.linear)
        return int(reason), attempts

    def _methods_to_try(self, guess: Array, *, fallback: bool, balance: bool) -> Iterator[str]:
        """Yield the method and its fallbacks. Collective.

        Raises:
            ValueError: Contact cannot balance the load, checked here for a nonlinear bulk.
        """
        yield self.method
        if fallback and balance and not self._full.bulk.linear:
            self.system.set_state(guess)
            self._full.evaluate()
            check_balance(self.equations.motions, self._full.load, self._full.operators)
        if fallback and self.can_fall_back():
            others = [name for name in _FALLBACKS if name != self.method]
            others = [name for name in others if self.methods[name].is_applicable]
            if "alternating" in others and self.equations.find_overloads():
                yield "alternating"
                if self.equations.overload is not None:
                    return  # the others would fail, too, in many more iterations
                others.remove("alternating")
            yield from others

    def can_fall_back(self) -> bool:
        """Return whether fallbacks may be tried: not if the caller limits the iterations."""
        return bool(
            self._settings.fallback and self.main.max_it >= self._main_options()["snes_max_it"]
        )

    def _main_options(self) -> dict[str, Any]:
        """Return default options of the main SNES."""
        return {**_COMMON, **METHODS[self.method].main_options()}

    # ---- linearised equations --------------------------------------------------------------------

    def linearised(
        self, springs: Sequence[Array], load: Array
    ) -> AbstractContextManager[Callable[[Sequence[Array] | None], Array]]:
        """Return `linearised_solver` at a complete state under an external load. Collective."""
        if self.select_dofs():
            self.change_dofs(can_drop=True)
        # Nothing is assembled after a restart at the end of a history.
        self.update_system(self._full.update_stiffness())
        self.system.begin(load)
        return linearised_solver(self.equations, springs)

    def respond(self, springs: Sequence[Array], tractions: Sequence[Array]) -> list[Array]:
        """Compute changes of the jumps by tractions, with the last factored matrix. Collective."""
        valid = self.equations.valid_matrices
        consistent = self.main.consistent or True in valid or False not in valid
        return solve_response(self.equations, springs, tractions, consistent=consistent)


def _choose_method(full: FullSystem, *, condensed: bool) -> str:
    """Choose Newton's method, or L-BFGS.

    L-BFGS is for linear bodies in space without condensation, where a factorisation costs dozens of
    iterations: it needs one per restart, not per iteration. A ball pressed on a block of 32,000 to
    a million unknowns takes 1.2 to 1.7 multigrid solutions, and two bolted plates a fifth of the
    time of Newton's method.
    """
    if condensed or not full.bulk.linear:
        return "newton"
    costly = full.gdim == 3 and not full.follows
    return "lbfgs" if costly or full.linear_kind == "multigrid" else "newton"


def _describe_outcome(reason: int, equations: Equations) -> str:
    """Describe the outcome of an attempt by its SNES reason. Collective."""
    if reason > 0:
        return "converged"
    if equations.overload is not None:
        return equations.overload.describe()
    description = _OUTCOMES.get(reason, f"SNES reason {reason}")
    return "; ".join(filter(None, (description, equations.monitor.describe_chattering())))
