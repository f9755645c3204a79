"""The solution of one increment: system, start, method, and what follows where that fails."""

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
from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import Status
from fenics_contact.methods.attempt import Attempt
from fenics_contact.methods.augmented_lagrangian import RESIDUAL_ERROR_RATIO, solve_augmented_lagrangian
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
from fenics_contact.parallel import global_max
from fenics_contact.systems import linear
from fenics_contact.systems.condensed import CondensedSystem
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.rigid_body_modes import RigidBodyModes
from fenics_contact.systems.solver_selection import linear_kind, reason_not_to_condense
from fenics_contact.systems.system import System
from fenics_contact.systems.unknowns import DofSubset
from fenics_contact.types import Array, Indices, Mask

__all__ = ["METHODS", "Settings", "Solver"]

logger = logging.getLogger("fenics_contact")

# Increments expected where nothing is said.
_EXPECTED = 4

# Others want bounds, a hierarchy or a partition of the unknowns, and end the program without them,
# or solve one linear system. The first ones factor the consistent tangent.
_NEWTONS = ("newtonls", "newtontr", "newtontrdc")
_SNES_TYPES = (*_NEWTONS, "qn", "nrichardson", "ngmres", "ncg", "anderson")
_REASONS = PETSc.SNES.ConvergedReason
_OUTCOMES = {
    int(_REASONS.DIVERGED_LINEAR_SOLVE): "the matrix is singular",
    compat.NOT_FINITE: "the residual is not finite",
    int(_REASONS.DIVERGED_MAX_IT): "iteration limit reached",
    int(_REASONS.DIVERGED_LINE_SEARCH): "no progress",
    int(_REASONS.DIVERGED_DTOL): "no progress",
}
_COMMON: dict[str, Any] = {
    "snes_rtol": 1e-9,
    "snes_stol": 0.0,
    "snes_max_it": 1000,
    # The paper's line search: |ρ·Ψ(ΔU + sρ)| ≤ c_L |ρ·Ψ(ΔU)|. With the single secant step that is
    # `cp`'s default it takes three times the iterations, and fails at stiffness it can solve.
    "snes_linesearch_type": "cp",
    "snes_linesearch_rtol": 0.1,
    "snes_linesearch_max_it": 20,
    # Bodies without contact are led to it before: no step of the iteration needs to be long.
    compat.LONGEST_STEP: 100.0,
    # `cp` takes |F·y| below this for convergence of the whole; the residual itself is tested here.
    "snes_linesearch_atol": 1e-300,
}
# Without prefix: of the vectors. By default PETSc takes products with several of them by BLAS: with
# PETSc 3.25 the last digits of L-BFGS changed so from a history to the same one again.
_VECTORS: dict[str, Any] = {"vec_mdot_use_gemv": False}
# Options that only make sense for the sparse matrices over all unknowns.
_NAMES_A_SOLVER = ("ksp_type", "pc_type", "pc_factor_mat_solver_type")
# By name.
METHODS: dict[str, type[Method]] = {
    "lbfgs": QuasiNewton,
    "newton": Newton,
    "alternating": TrescaFixedPoint,
    "primal_dual": PrimalDual,
    "continuation": Continuation,
}
# What takes over where a method fails: the first is for the stiffest friction, in few iterations,
# the second for all else. The third solved none of 420 random scenes behind the others, but wedges
# that are let go, and it finds overloads that no start shows: of a tight fit in the first round of
# multipliers, whose springs are soft.
_FALLBACKS = ("primal_dual", "continuation", "alternating")


@dataclass(frozen=True)
class Settings:
    """What the caller of `ContactProblem` says of the solution; see its arguments.

    Raises:
        ValueError: One of them has no sense.
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
        """Refuse what has no sense."""
        if self.method not in (None, *METHODS):
            raise ValueError(f"method is {self.method!r}; use one of {sorted(METHODS)}")
        if self.linear_solver not in (None, *linear.KINDS):
            raise ValueError(
                f"linear_solver is {self.linear_solver!r}; use one of {sorted(linear.KINDS)}, or "
                "None to choose by the size of the problem"
            )
        for name, share in (("alpha", self.alpha), ("phi", self.phi)):
            if not (is_number(share) and 0.0 <= share <= 1.0):
                raise ValueError(f"{name} is {share!r}; it must be a number between 0 and 1")
        check_bool("fallback", self.fallback)
        if self.condensation is not None:
            check_bool("condensation", self.condensation)
        check_instance("prefix", self.prefix, str)
        check_instance("petsc_options", self.petsc_options, Mapping)


class Solver:
    """Solves the equations of an increment by one method, and by others where that fails.

    The constructor is collective.

    Args:
        full: The system on all unknowns.
        motions: Rigid motions of the bodies.
        settings: What the caller says.

    Attributes:
        snes: The main SNES, with the user's options.
        equations: What is solved.
        options: PETSc options, present in the database only while they are read.
        method: Name of the method tried first.
        main: The method on the main SNES.
        condensed: Whether the unknowns that contact touches are iterated on alone.
        expected: How many increments are expected.
        methods: Further methods, by name.
        predictor: Where the iteration starts from.
    """

    def __init__(self, full: FullSystem, motions: RigidBodyModes, settings: Settings) -> None:
        self.equations = Equations(full, motions, alpha=settings.alpha, phi=settings.phi)
        self.expected_increments = _EXPECTED
        self.predictor = Predictor(self.equations)
        self._full = full
        # Which the caller may change later.
        self._settings = replace(settings, petsc_options=dict(settings.petsc_options))
        self._comm = full.unknowns.comm
        self._obstacle: str | None = None  # to condensation, as last said
        self._pairings = self._present_pairings()  # those of the system
        self._retained = RetainedDofs(full, unlimited=bool(settings.condensation))
        # What is chosen and made by `_configure`, for the increments that are expected.
        self.options = Defaults()
        self._named: list[str] = []  # options given that name a linear solver
        self.condensed = False
        self.method = settings.method or "lbfgs"
        self.methods: dict[str, StandaloneMethod] = {}
        self.snes: PETSc.SNES
        self.main: SnesMethod
        take_command_line(settings.prefix, self._comm)
        self._configure()

    @property
    def system(self) -> System:
        """The system that is iterated on."""
        return self.equations.system

    # ---- choices ---------------------------------------------------------------------------------

    def _configure(self) -> None:
        """Set up SNES and its two linear solvers: for H₀, and for the consistent tangent."""
        settings, prefix, equations = self._settings, self._settings.prefix, self.equations
        options = self.options = Defaults()
        options.set(_VECTORS, "")
        options.set_caller_options(settings.petsc_options, prefix)
        if settings.accuracy is not None:
            # Residuals as large as what multipliers may miss would make rounds that change nothing.
            augmented = [c for c in self._full.contacts if c.multipliers is not None]
            least = [RESIDUAL_ERROR_RATIO * c.tolerance for c in augmented]
            options.set({"snes_rtol": min(settings.accuracy.rtol, *least, 1.0)}, prefix)
            if self._comm.rank == 0:
                logger.info("accuracy %s", settings.accuracy)
        solvers = [part + name for part in ("", "tangent_") for name in _NAMES_A_SOLVER]
        self._named = [name for name in solvers if options.get(prefix + name) is not None]
        self.condensed = self._choose_condensation()
        self._full.linear_kind = self._choose_linear_solver()
        self._set_system()
        self.method = settings.method or self._choose_method()
        snes_type = options.get(prefix + "snes_type")
        main_options = self._main_options()
        if snes_type not in (None, main_options.get("snes_type")):
            main_options |= _COMMON  # the line search is for the type of the method
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
            # Tolerances that follow the residual are for a solver that SNES has made.
            own = consistent and not quasi_newton
            ksp = snes.getKSP() if own else PETSc.KSP().create(self._comm)
            part = prefix + ("tangent_" if consistent else "")
            ksp.setOptionsPrefix(part)
            symmetric = equations.is_symmetric(consistent)
            options.set(
                self.system.linear_solver(symmetric=symmetric, accurate=not quasi_newton), part
            )
            options.set_from_options(ksp)
            equations.solvers[consistent] = ksp
        this: Solver = weakref.proxy(self)  # SNES would keep what keeps it
        main = QuasiNewton if quasi_newton else Newton
        self.main = main(equations, snes, lambda: this.can_fall_back())
        self._forget_matrices()
        self.main.attach(consistent=not quasi_newton)
        options.set_from_options(snes)
        options.set_up(snes)

        def newton_solver(symmetric: bool) -> dict[str, Any]:
            """Options of one for Newton's method; none where that of H₀ or the tangent is one."""
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

    def expect(self, increments: int) -> None:
        """Choose for a number of increments, before the first is solved. Collective.

        SNES may be made anew, with the monitors that the one before had got.
        """
        if self.expected_increments != increments:
            self.expected_increments = increments
            if self._choose_condensation() != self.condensed:
                self._configure_anew()

    def _configure_anew(self) -> None:
        """Make SNES anew, with the monitors that the one before had got. Collective."""
        monitors = self.snes.getMonitor() or ()
        self._configure()
        for monitor, arguments, keywords in monitors:
            self.snes.setMonitor(monitor, arguments, keywords)

    def _choose_condensation(self) -> bool:
        """Whether to iterate on the unknowns that may be touched alone. Collective."""
        obstacle = reason_not_to_condense(
            self._full,
            wanted=self._settings.condensation,
            linear_solver=self._settings.linear_solver,
            named=self._named,
            increments=self.expected_increments,
            n_retained=self._retained.count,
        )
        if obstacle and obstacle != self._obstacle and self._comm.rank == 0:
            logger.info("no static condensation: %s", obstacle)
        self._obstacle = obstacle
        return obstacle is None

    def _choose_method(self) -> str:
        """Newton's method, or L-BFGS.

        L-BFGS is for linear bodies in space on all unknowns, where factors of a matrix cost dozens
        of iterations, and it needs one in a round, not one in every iteration: a ball pressed on a
        block, of 32,000 to a million unknowns, takes 1.2 to 1.7 linear solves by multigrid so, and
        two plates under a bolt a fifth of the time of Newton's method.
        """
        full = self._full
        if self.condensed or not full.bulk.linear:
            return "newton"
        costly = full.gdim == 3 and not full.follows
        return "lbfgs" if costly or full.linear_kind == "multigrid" else "newton"

    def _choose_linear_solver(self) -> str:
        """How to solve systems over all unknowns, one of `linear.KINDS`. Collective."""
        kind, reason = linear_kind(
            self._full,
            wanted=self._settings.linear_solver,
            condensed=self.condensed,
            named=self._named,
            symmetric=self.equations.is_symmetric(False),
            tangent_symmetric=self.equations.is_symmetric(True),
        )
        if reason and self._comm.rank == 0 and not self.condensed:
            n = self._full.unknowns.first_motion
            logger.info("linear systems of %d unknowns, solver %s: %s", n, kind, reason)
        return kind

    # ---- the system ------------------------------------------------------------------------------

    def _set_system(self) -> None:
        """Take the system to iterate on: all unknowns, or those to be retained. Collective."""
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
        # Matrices of pairs that follow the bodies are made for each anew, and no one is retained.
        return [0 if c.contact_kinematics.follows else c.pairs.number for c in self._full.contacts]

    def is_current(self) -> bool:
        """Whether bulk and pairs are those of the last solution. Collective."""
        return self._full.bulk.is_current() and self._present_pairings() == self._pairings

    def update_system(self, stiffness_changed: bool) -> None:
        """Follow changes of the pairs and of the bulk's tangent. Collective."""
        if self._pairings != self._present_pairings():
            if not self.condensed or self._retained.extend():
                self._set_system()
            self._pairings = self._present_pairings()
            self._make_matrices()
        if stiffness_changed or not self.system.ready:
            self.equations.factorisations += self.system.update()

    # ---- the retained dofs -----------------------------------------------------------------------

    def select_dofs(self) -> bool:
        """Whether an increment that starts here takes other unknowns; then `change`. Collective.

        That is so where the first one starts, and where those that bear have other opposites.
        """
        others = self.condensed and self._pairings != self._present_pairings()
        return self._retained.select_dofs(other_pairs=others)

    def needs_more_dofs(self, *, found: bool) -> bool:
        """Whether contact takes more unknowns than are retained: then `change`. Collective.

        Args:
            found: Whether there is a solution; if so contacts are evaluated on all of Γc.
        """
        if not self.system.confined:
            return False
        misses = self._retained.needs_more_dofs(self.system.operators, has_solution=found)
        # A body that nothing else holds may find no rest on what is retained.
        return misses or (not found and len(self.equations.motions.free) > 0)

    def change(self, *, anew: bool) -> None:
        """Keep other unknowns, or iterate on all where that is cheaper. Collective.

        The state is that in which the increment starts.

        Args:
            anew: Whether what is retained now may be dropped where all would be too much.
        """
        self._retained.update(can_drop=anew)
        if self._choose_condensation() != self.condensed:
            self._configure_anew()
        elif self.condensed:
            self._set_system()
            self._make_matrices()

    def keep(self, retained: Indices) -> None:
        """Iterate on the unknowns that another run had retained, on all if it had. Collective."""
        some = self._comm.allreduce(retained.size) > 0
        anew = some != self.condensed and self._settings.condensation is None
        if some and self.condensed:
            self._retained.indices = retained
            self._set_system()
        elif anew and not self._retained.is_all:
            self._retained.indices = retained if some else self._retained.find_coupled()
            self._configure_anew()
        self._retained.is_selected = True

    def restart(self) -> None:
        """Drop what is retained from earlier increments. Collective."""
        self.system.forget()
        self._make_matrices()

    def recover(self) -> None:
        """Replace what an error of PETSc may have left locked or half done. Collective."""
        self.equations.set_system(self.system)
        self._make_matrices()

    def _make_matrices(self) -> None:
        """New matrices for new couplings, or to forget all that was factored. Collective."""
        self.snes.reset()
        self._forget_matrices()
        self.main.attach(consistent=not isinstance(self.main, QuasiNewton))

    def _forget_matrices(self) -> None:
        self.equations.forget_matrices()
        self.predictor.invalidate_tangent()

    # ---- solving ---------------------------------------------------------------------------------

    def solve(
        self,
        *,
        cold: bool,
        stiffness_changed: bool,
        load_before: Array,
        balance: bool = True,
        fallback: bool = True,
    ) -> tuple[int, list[Attempt], int]:
        """Solve, let multipliers take over what the springs bear, and again. Collective.

        Args:
            cold: Whether nothing was borne before.
            stiffness_changed: Whether the bulk's tangent is another one than in the last increment.
            load_before: External forces at this rank's unknowns in the committed state (force).
            balance: Whether to raise a ValueError for a load that contact cannot balance.
            fallback: Whether other methods may be tried after a failure.

        Returns:
            Reason of the last solution, what was tried, and how many solutions there were.
        """
        equations = self.equations
        equations.start = self.system.initial_forces()
        equations.is_round_off_known, equations.overload = False, None
        equations.generalised_loads = equations.motions.generalised_load(self._full.load)

        def iterate(first_augmentation: bool) -> tuple[int, list[Attempt]]:
            changed = first_augmentation and stiffness_changed
            return self._iterate(first_augmentation, cold, changed, balance=balance, fallback=fallback)

        return solve_augmented_lagrangian(equations, iterate, load_before)

    def _iterate(
        self,
        first_augmentation: bool,
        cold: bool,
        stiffness_changed: bool,
        *,
        balance: bool,
        fallback: bool,
    ) -> tuple[int, list[Attempt]]:
        """Iterate by one method after another from the same start. Collective.

        Returns:
            Reason, and what was tried.
        """
        equations = self.equations
        factored = self.predictor.factored
        equations.monitor.reset()
        chosen = self.predictor.choose_initial_guess(first_augmentation=first_augmentation, cold=cold)
        start: Array = np.divide(chosen, equations.length)
        attempts: list[Attempt] = []
        methods: Iterable[str] = self._chain(start, fallback=fallback, balance=balance)
        if equations.overload is not None:
            # All have failed, and only it can tell whether multipliers bear what springs did not.
            methods = ("alternating",)
        equations.overload = None
        for method in methods:
            equations.solution.array[:] = start
            equations.monitor.reset()
            if stiffness_changed:
                equations.is_h0_current = False
            iterations, reason = self.methods.get(method, self.main).solve()
            attempts.append(Attempt(method, iterations, self._outcome(reason)))
            if reason > 0:
                equations.overload = None
                break
            if self._comm.rank == 0:
                logger.info("%s", attempts[-1])
        equations.set_state(equations.solution)
        own = self.methods.get(method)
        newton = self.snes.getType() in _NEWTONS if own is None else own.is_newton_solution
        newton = newton and not isinstance(self.main, QuasiNewton)
        made = sum(attempt.iterations for attempt in attempts[-1:])
        if reason > 0 and newton and (factored or made > 0):
            # With a linear bulk a start by the tangent comes first even where it is far off, which
            # a load that falls to nothing does not forgive after continuation.
            self.predictor.store_solution(predict=own is None or not self._full.bulk.linear)
        return int(reason), attempts

    def _chain(self, start: Array, *, fallback: bool, balance: bool) -> Iterator[str]:
        """The method, and those that follow while none converges. Collective.

        Raises:
            ValueError: Contact cannot balance the load on a nonlinear body (`check_balance`), which
                may change as the body deforms: it is checked after a failure alone.
        """
        yield self.method
        if fallback and balance and not self._full.bulk.linear:
            x = self.equations.solution.copy()  # which is judged if nothing follows
            x.array[:] = start
            self.equations.set_state(x)
            x.destroy()
            self._full.evaluate()
            check_balance(self.equations.motions, self._full.load, self._full.operators)
        if fallback and self.can_fall_back():
            others = (name for name in _FALLBACKS if name != self.method)
            yield from (name for name in others if self.methods[name].suits)

    def _outcome(self, reason: int) -> str:
        """What became of an attempt, in words. Collective."""
        if reason > 0:
            return "converged"
        if (overload := self.equations.overload) is not None:
            return overload.in_words()
        words = _OUTCOMES.get(reason, f"SNES reason {reason}")
        return "; ".join(filter(None, (words, self.equations.monitor.describe_chattering())))

    def can_fall_back(self) -> bool:
        """Whether to go on after a failure: not if iterations are rationed by the caller."""
        return bool(
            self._settings.fallback and self.main.max_it >= self._main_options()["snes_max_it"]
        )

    def _main_options(self) -> dict[str, Any]:
        """Those of the main SNES, where the caller says nothing."""
        return {**_COMMON, **METHODS[self.method].main_options()}

    # ---- the neighbourhood of a solution ---------------------------------------------------------

    def linearised(
        self, springs: Sequence[Array], load: Array
    ) -> AbstractContextManager[Callable[[Sequence[Array] | None], Array]]:
        """See `ContactProblem.linearised`, about a complete state under a load. Collective."""
        if self.select_dofs():
            self.change(anew=True)
        # After a history that was taken up and is at its end nothing has been assembled yet.
        self.update_system(self._full.update_stiffness())
        self.predictor.invalidate_tangent()  # the matrix that is about to be used is another one
        self.system.begin(load)
        return linearised_solver(self.equations, springs)

    def end_without(self, acting: Sequence[tuple[Contact, Mask]], start: Array) -> Array | None:
        """Where the increment would end, to first order, if some points did not act. Collective.

        All other points that are closed in ``start`` stick.

        Args:
            acting: Contacts, and which of their points do, (n_points,).
            start: The state in which it starts, prescribed values as they were.

        Returns:
            The state; None if the other contacts do not hold the bodies, or contact forces are
            not finite.
        """
        full, present = self._full, self._full.state()
        moved = None
        with self.system.restricted_contacts():
            try:
                for operator in self.system.operators:
                    within = operator.within
                    for contact, points in acting:
                        if contact is operator.contact:
                            contact.restrict_to(points if within is None else points & within)
                if not full.bulk.linear:  # a bulk that conditions have moved into may be inverted
                    moved = present - start
                    full.set_state(start)
                    full.update_stiffness()
                full.evaluate()
                largest = global_max(self._comm, np.abs(self.system.contact_force()))
                if not (np.isfinite(largest) and self.equations.is_constrained()):
                    return None
                closed = [contact.status != Status.OPEN for contact in full.contacts]
                springs = [
                    c.values.springs(s, s) for c, s in zip(full.contacts, closed, strict=True)
                ]
                self.predictor.invalidate_tangent()  # the matrix that is about to be used is another one
                with linearised_solver(self.equations, springs, prescribed=moved) as solve:
                    return present + solve(None)
            finally:
                self.equations.valid_matrices.discard(True)  # it is that of another state
                for contact, _ in acting:
                    contact.restrict_to()
                full.set_state(present)
                if not full.bulk.linear:
                    full.update_stiffness()

    def respond(self, springs: Sequence[Array], tractions: Sequence[Array]) -> list[Array]:
        """`neighbourhood.respond`, by the matrix factored last. Collective."""
        made = self.equations.valid_matrices
        consistent = self.main.consistent or True in made or False not in made
        return solve_response(self.equations, springs, tractions, consistent=consistent)
