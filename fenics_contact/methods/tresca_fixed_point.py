"""Fixed-point iteration on the friction bound of a sequence of Tresca problems.

Coulomb's law has no potential, but contact with a given friction bound has one (Signorini with
Tresca or Duvaut-Lions, section 3): Newton's method with a line search on the energy minimises it,
however stiff the contact is. Its pressure gives the next bound. Convergence is linear with a
constant active set, and slower with larger friction.

With an overload the subproblems have no solution. Bodies then slide against soft springs, with the
friction of the last pressures. The overload persists if the pressures of their equilibrium, too,
allow less friction than the load requires.

The paper instead alternates between normal and tangential problems, in each of which a body that
only contact constrains has unconstrained modes.
"""

from __future__ import annotations

import logging
import weakref
from collections.abc import Mapping
from itertools import chain
from typing import Any

import numpy as np
from petsc4py import PETSc

from fenics_contact.contact.contact import Contact
from fenics_contact.methods.equations import Equations
from fenics_contact.methods.limit_analysis import Overload, support_stiffness
from fenics_contact.methods.method import SnesMethod, SolverContext, StandaloneMethod
from fenics_contact.parallel import global_max
from fenics_contact.types import Array

__all__ = ["TrescaFixedPoint"]

logger = logging.getLogger("fenics_contact")

_OPTIONS = {
    "snes_type": "newtonls",
    "snes_rtol": 0.0,
    "snes_stol": 0.0,
    "snes_atol": 0.0,
    "snes_max_it": 200,
    "snes_linesearch_type": "bt",
    "snes_linesearch_max_it": 40,
}
# Newton steps without line search, for decreases below the round-off of the energy.
_FINISH = _OPTIONS | {"snes_max_it": 5, "snes_linesearch_type": "basic"}
# Round-off of the energy by its terms, and residual by the forces below which a decrease of the
# energy may be round-off. With 40 eps the search ends too early at a stiffness of 1e5 E/h.
_ENERGY_ROUND_OFF, _LINE_SEARCH_RTOL = 10 * np.finfo(float).eps, 1e-6
_MAX_CYCLES = 200
_MAX_ITERATIONS = 1000  # Newton iterations of all cycles
_MAX_STALLS = 20  # consecutive cycles without a lower residual
# Stalled cycles after which the relaxation of the bound is halved, and its least value.
_STALLS_TO_RELAX = 2
_MIN_RELAXATION = 1 / 8
# First slip of overloaded bodies against springs, relative to their size, and largest deformation
# relative to the slip. With a larger one the slip is increased tenfold: friction across the sliding
# direction reduces the pressure in a groove (by a tenth with a deformation of a twentieth).
_FIRST_SLIP_RATIO, _MAX_DEFORMATION_RATIO, _SLIP_GROWTH = 1e-2, 1e-2, 10.0
# An overload is final if the balanced fraction of the load changes in a cycle by less than this
# fraction of the missing one.
_FINAL_CHANGE_RATIO = 0.1
_SUBPROBLEM_RTOL = 1e-2  # residual of a subproblem relative to that of the complete law
_SLIP_STIFFNESS_RATIO = 1e-6  # of k_t, regularises the matrix of slipping bodies

_REASONS = PETSc.SNES.ConvergedReason


class TrescaFixedPoint(StandaloneMethod):
    """Fixed-point iteration on the friction bound.

    Attributes:
        snes: Newton's method for the subproblems; its prefix ends in "alternating_".
    """

    def __init__(self, context: SolverContext) -> None:
        self._equations = context.equations
        self._search = _Search(context, "alternating_", _OPTIONS)
        self._finish = _Minimisation(context, "finishing_", _FINISH)
        self.snes = self._search.snes

    def solve(self) -> tuple[int, int]:
        """Solve the equations; return all Newton iterations and the reason. Collective."""
        equations = self._equations
        if not self.is_applicable:
            return 0, int(_REASONS.DIVERGED_LINE_SEARCH)
        for method in (self._search, self._finish):
            method.attach(consistent=False)
        iterations = stalls = 0
        last_overload: Overload | None = None
        slip_ratio = _FIRST_SLIP_RATIO
        slides = False
        best = np.inf
        relaxation = 1.0
        try:
            residual = self._compute_residual_norm()
            bound: Array = self._evaluate_friction_bound()
            for cycle in range(_MAX_CYCLES):
                # Without any resistance there is no bound to support a body by.
                overloads = [o for o in equations.find_overloads() if np.isfinite(o.factor)]
                overload = overloads[0] if overloads else None
                final = slides and _is_final(overload, last_overload)
                # A bound independent of the pressure does not change.
                if overload and (equations.has_potential or final):
                    logger.debug("%d cycles, %d Newton iterations: overload", cycle, iterations)
                    equations.overload = overload
                    return iterations, int(_REASONS.DIVERGED_LINE_SEARCH)
                last_overload = overload
                full = equations.full
                support = support_stiffness(full.operators, overloads, full.scales, slip_ratio)
                ends = np.cumsum([c.quadrature.n_points for c in equations.contacts])[:-1]
                parts = zip(equations.contacts, np.split(bound, ends), support, strict=True)
                for contact, bound_at_points, springs in parts:
                    contact.effective_law.fix_friction_bound(bound_at_points, springs)
                rtol = 0.0 if equations.has_potential else _SUBPROBLEM_RTOL
                self._search.atol = self._finish.atol = rtol * residual
                iterations += self._minimise()
                if overload:
                    slides = _deformation_ratio(equations, overload) <= _MAX_DEFORMATION_RATIO
                    slip_ratio *= 1.0 if slides else _SLIP_GROWTH
                residual = self._compute_residual_norm()
                if equations.is_converged():
                    logger.debug("%d cycles, %d Newton iterations", cycle + 1, iterations)
                    return iterations, int(_REASONS.CONVERGED_FNORM_RELATIVE)
                stalls = 0 if residual < best else stalls + 1
                best = min(best, residual)
                if not np.isfinite(residual) or stalls > _MAX_STALLS or equations.has_potential:
                    return iterations, int(_REASONS.DIVERGED_LINE_SEARCH)
                if iterations > _MAX_ITERATIONS:
                    return iterations, int(_REASONS.DIVERGED_MAX_IT)
                if stalls and stalls % _STALLS_TO_RELAX == 0:
                    relaxation = max(relaxation / 2, _MIN_RELAXATION)
                bound = bound + relaxation * (self._evaluate_friction_bound() - bound)
            return iterations, int(_REASONS.DIVERGED_MAX_IT)
        finally:
            equations.is_h0_current = False
            for contact in equations.contacts:
                contact.effective_law.release_friction_bound()

    def check(self) -> None:
        """Check that the problem with a given friction bound has a potential."""
        if self._equations.full.displacement.is_mixed:
            raise ValueError(
                "method is 'alternating', but u is a part of a mixed function, whose equations are "
                "a saddle-point problem, not a minimisation; use another method"
            )
        refused = self._without_potential()
        if refused:
            laws = ", ".join(type(c.law).__name__ for c in refused)
            why = "not even with a given friction bound"
            if all(c.contact_kinematics.is_finite for c in refused):
                why = "with finite kinematics, because the tangent planes rotate"
            raise ValueError(
                f"method is 'alternating', but {laws} has no potential, {why}, so that there is "
                "nothing to minimise; use another method"
            )

    @property
    def is_applicable(self) -> bool:
        """Whether the method applies to the problem."""
        mixed = self._equations.full.displacement.is_mixed
        return bool(self._equations.contacts) and not mixed and not self._without_potential()

    def _without_potential(self) -> list[Contact]:
        return [c for c in self._equations.contacts if not c.effective_law.can_fix_friction_bound]

    def _evaluate_friction_bound(self) -> Array:
        """Evaluate the friction bound of all contacts at the local points (stress)."""
        equations = self._equations
        equations.full.evaluate()
        return np.concatenate([contact.values.friction_bound for contact in equations.contacts])

    def _compute_residual_norm(self) -> float:
        """Compute the norm of the residual with the complete law."""
        equations = self._equations
        for contact in equations.contacts:
            contact.effective_law.release_friction_bound()
        return float(equations.residual(equations.solution, equations.function).total)

    def _minimise(self) -> int:
        """Solve the subproblem with a line search on the energy, then without; iterations."""
        iterations, reason = self._search.solve()
        if reason <= 0:
            # The last digits of the residual are below the round-off of the energy.
            iterations += self._finish.solve()[0]
        return iterations


def _deformation_ratio(equations: Equations, overload: Overload) -> float:
    """Return the deformation of overloaded bodies relative to their displacement. Collective."""
    full, system, motions = equations.full, equations.system, equations.motions
    change = full.state() - equations.initial_unknowns
    rigid = motions.displacement(motions.fit_modes(change, system.restrict))
    largest = [system.partition.largest(system.restrict(v)) for v in (change - rigid, change)]
    in_group = full.scales.group == overload.group
    deformation, displacement = (
        global_max(full.unknowns.comm, values[in_group]) for values in largest
    )
    return deformation / displacement if displacement > 0.0 else np.inf


def _is_final(overload: Overload | None, last: Overload | None) -> bool:
    """Return whether the resistance has converged in consecutive cycles with an overload."""
    if overload is None or last is None:
        return False
    balanced, before = 1.0 / overload.factor, 1.0 / last.factor
    return abs(balanced - before) < _FINAL_CHANGE_RATIO * (1.0 - balanced)


class _Minimisation(SnesMethod):
    """Newton's method for the subproblems, with the matrix of H₀.

    The constructor is collective.

    Args:
        context: Data to construct the SNES.
        part: Part of the prefix of the SNES after the problem's.
        options: Options of the SNES.

    Attributes:
        goal: Tolerance of the residual of the present subproblem (force).
    """

    def __init__(self, context: SolverContext, part: str, options: Mapping[str, Any]) -> None:
        snes, own = context.create_snes(part, options, consistent=False)
        super().__init__(context.equations, snes, lambda: False, own_solver=own)
        self.atol = 0.0

    def converged(self) -> int:
        """Return the SNES reason of the convergence test."""
        equations = self._equations
        converged = equations.norms.total <= self.atol or equations.is_converged()
        return int(_REASONS.CONVERGED_FNORM_RELATIVE if converged else _REASONS.ITERATING)

    def _compute_jacobian(self, x: PETSc.Vec, J: PETSc.Mat) -> None:
        equations = self._equations
        equations.evaluate(x)
        if not equations.is_constrained():
            equations.assemble(J, equations.stiffnesses(everywhere=True))
            return
        # If all points slip, bodies constrained by friction have unconstrained modes.
        springs = (
            o.springs(o.contact.values.springs(0.0, _SLIP_STIFFNESS_RATIO))
            for o in equations.system.operators
            if o.contact.effective_law.support is None
        )
        equations.assemble(J, chain(equations.tangents(), springs))


class _Search(_Minimisation):
    """Newton's method with a line search on the energy, for a linear bulk."""

    def __init__(self, context: SolverContext, part: str, options: Mapping[str, Any]) -> None:
        super().__init__(context, part, options)
        # Potential at the last state, and at the last iterate.
        self._energy = self._last_energy = np.inf

    def attach(self, *, consistent: bool) -> None:
        """Set callbacks, objective and the linear solver in SNES."""
        super().attach(consistent=consistent)
        this: _Search = weakref.proxy(self)
        if self._equations.full.bulk.linear:
            self._callbacks.set_objective(self.snes, lambda x: this._compute_energy(x))

    def solve(self) -> tuple[int, int]:
        """Solve the subproblem. Collective."""
        self._energy = self._last_energy = np.inf
        return super().solve()

    def _compute_energy(self, x: PETSc.Vec) -> float:
        self._energy = self._equations.energy(x)
        return self._energy

    def converged(self) -> int:
        """Return the SNES reason, also an end at the round-off of the energy. Collective."""
        reason, ongoing = super().converged(), int(_REASONS.ITERATING)
        if reason == ongoing and self._equations.is_converged(_LINE_SEARCH_RTOL):
            return int(_REASONS.DIVERGED_LINE_SEARCH)
        if reason != ongoing or not np.isfinite(self._energy):
            return reason
        decrease = self._last_energy - self._energy
        self._last_energy = self._energy
        if decrease <= _ENERGY_ROUND_OFF * self._equations.energy_size():
            return int(_REASONS.DIVERGED_LINE_SEARCH)
        return ongoing
