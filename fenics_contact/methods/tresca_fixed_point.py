"""Minimum problems one after another: contact with friction of given limit, then a new limit.

Coulomb's law has no potential. With a given friction bound, unilateral contact with friction has
one (Signorini with Tresca or Duvaut-Lions, section 3): Newton's method with a line search on the
energy solves it however stiff it is. The pressure that comes out sets the next bound, until the
whole law holds. Each cycle gains a factor, which is constant once no point changes its status, and
the less the larger the friction is.

The paper's conclusion takes the normal and the tangential reaction apart, one given while the other
is sought. A body that contact alone holds is loose in either of these problems, and each has to
wait for the other where both change; here only the friction bound waits.
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
from fenics_contact.methods.limit_analysis import CLEAR_OVERLOAD_FACTOR
from fenics_contact.methods.method import SnesMethod, SolverContext, StandaloneMethod
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
# Newton steps without line search finish where the energy has no digits left.
_FINISH = _OPTIONS | {"snes_max_it": 5, "snes_linesearch_type": "basic"}
# Round-off of the energy, by the size of its terms; and residual, as a share of the forces, from
# which on its differences are not far above that: no line search tells a descent there.
_NOISE, _NEAR = 10 * np.finfo(float).eps, 1e-6
# Cycles, and Newton iterations in all, before it is given up; and cycles in a row that may pass
# without a lower residual.
_MAX_CYCLES = 200
_MAX_ITERATIONS = 1000
_MAX_STALLS = 20
# Cycles without a lower residual after which only half of the change of the limit is taken, and the
# least share: two cycles may undo one another.
_PATIENCE = 2
_LEAST = 1 / 8
# Where the load needs more friction than there is, the problem with the limit given has no solution
# but with this much more than it needs. It is believed after so many cycles in a row that find so;
# if that is clear, after the second, whose pressures are those of an equilibrium.
_MORE, _OVERLOADS = 1.01, 3
# Share of the whole law's residual to which a subproblem is solved: more would be lost again.
_INNER = 1e-2
# Share of k_t that keeps a slipping body in place in the matrix (not in the equations).
_STILL = 1e-6

_REASONS = PETSc.SNES.ConvergedReason


class TrescaFixedPoint(StandaloneMethod):
    """The method.

    Attributes:
        snes: Newton's method for the subproblems, prefix "alternating_" behind the problem's.
    """

    def __init__(self, context: SolverContext) -> None:
        self._equations = context.equations
        self._search = _Search(context, "alternating_", _OPTIONS)
        self._finish = _Minimisation(context, "finishing_", _FINISH)
        self.snes = self._search.snes

    def solve(self) -> tuple[int, int]:
        """See `Method.solve`. Iterations are Newton's, in all."""
        equations = self._equations
        if not self.suits:
            return 0, int(_REASONS.DIVERGED_LINE_SEARCH)
        for method in (self._search, self._finish):
            method.attach(consistent=False)
        iterations = stalls = overloads = 0
        best = np.inf
        relaxation = 1.0
        try:
            residual = self._residual()
            bound: Array = self._friction_bound()
            for cycle in range(_MAX_CYCLES):
                overload = equations.find_overload()
                needed = overload.factor if overload else 1.0
                overloads = overloads + 1 if 1.0 < needed < np.inf else 0
                # Limits that the pressure does not set are what they are.
                enough = 1 if equations.has_potential else 2 if needed > CLEAR_OVERLOAD_FACTOR else _OVERLOADS
                if overloads >= enough:
                    logger.debug("%d cycles, %d Newton iterations: overload", cycle, iterations)
                    equations.overload = overload
                    return iterations, int(_REASONS.DIVERGED_LINE_SEARCH)
                if overloads:
                    bound = _MORE * needed * bound
                ends = np.cumsum([c.quadrature.n_points for c in equations.contacts])[:-1]
                for contact, part in zip(equations.contacts, np.split(bound, ends), strict=True):
                    contact.effective_law.fix_friction_bound(part)
                share = 0.0 if equations.has_potential else _INNER
                self._search.goal = self._finish.goal = share * residual
                iterations += self._minimise()
                residual = self._residual()
                if equations.solved():
                    logger.debug("%d cycles, %d Newton iterations", cycle + 1, iterations)
                    return iterations, int(_REASONS.CONVERGED_FNORM_RELATIVE)
                stalls = 0 if residual < best else stalls + 1
                best = min(best, residual)
                if not np.isfinite(residual) or stalls > _MAX_STALLS or equations.has_potential:
                    return iterations, int(_REASONS.DIVERGED_LINE_SEARCH)
                if iterations > _MAX_ITERATIONS:
                    return iterations, int(_REASONS.DIVERGED_MAX_IT)
                if stalls and stalls % _PATIENCE == 0:
                    relaxation = max(relaxation / 2, _LEAST)
                bound = bound + relaxation * (self._friction_bound() - bound)
            return iterations, int(_REASONS.DIVERGED_MAX_IT)
        finally:
            equations.is_h0_current = False
            for contact in equations.contacts:
                contact.effective_law.release_friction_bound()

    def check(self) -> None:
        """Refuse problems without a potential: this method minimises energies."""
        if self._equations.full.displacement.mixed:
            raise ValueError(
                "method is 'alternating', but u is a part of a mixed function, whose equations are "
                "a saddle-point problem and no minimisation; use another method"
            )
        none = self._without_potential()
        if none:
            laws = ", ".join(type(c.law).__name__ for c in none)
            why = "not even with a given friction bound"
            if all(c.finite for c in none):
                why = "with finite kinematics, because the tangent planes rotate"
            raise ValueError(
                f"method is 'alternating', but {laws} has no potential, {why}, so that there is "
                "nothing to minimise; use another method"
            )

    @property
    def suits(self) -> bool:
        """See `StandaloneMethod.suits`."""
        mixed = self._equations.full.displacement.mixed
        return bool(self._equations.contacts) and not mixed and not self._without_potential()

    def _without_potential(self) -> list[Contact]:
        return [c for c in self._equations.contacts if not c.effective_law.can_fix_friction_bound]

    def _friction_bound(self) -> Array:
        """Friction bound of all contacts at this rank's points (stress)."""
        equations = self._equations
        equations.full.evaluate()
        return np.concatenate([contact.values.friction_bound for contact in equations.contacts])

    def _residual(self) -> float:
        """That of the whole law."""
        equations = self._equations
        for contact in equations.contacts:
            contact.effective_law.release_friction_bound()
        return float(equations.residual(equations.solution, equations.function).total)

    def _minimise(self) -> int:
        """Newton's method with the line search on the energy, then without any."""
        made, reason = self._search.solve()
        if reason <= 0:
            # The last digits of the residual are below the rounding of the energy.
            made += self._finish.solve()[0]
        return made


class _Minimisation(SnesMethod):
    """Newton's method for the problems that are solved one after another, with the matrix of H₀.

    The constructor is collective.

    Args:
        context: What it is made of.
        part: What follows the prefix of the problem's options in that of this one.
        options: Those of SNES.

    Attributes:
        goal: Residual to which the present one is solved (force).
    """

    def __init__(self, context: SolverContext, part: str, options: Mapping[str, Any]) -> None:
        snes, own = context.snes(part, options, consistent=False)
        super().__init__(context.equations, snes, lambda: False, own_solver=own)
        self.goal = 0.0

    def converged(self) -> int:
        """See `SnesMethod.converged`."""
        equations = self._equations
        converged = equations.norms.total <= self.goal or equations.solved()
        return int(_REASONS.CONVERGED_FNORM_RELATIVE if converged else _REASONS.ITERATING)

    def _compute_jacobian(self, x: PETSc.Vec, J: PETSc.Mat) -> None:
        equations = self._equations
        equations.evaluate(x)
        if not equations.is_constrained():
            equations.assemble(J, equations.stiffnesses(everywhere=True))
            return
        # Where all slips, what nothing but friction holds would be loose.
        still = (
            o.springs(o.contact.values.springs(0.0, _STILL)) for o in equations.system.operators
        )
        equations.assemble(J, chain(equations.tangents(), still))


class _Search(_Minimisation):
    """The same with a line search on the energy, where the bulk has one."""

    def __init__(self, context: SolverContext, part: str, options: Mapping[str, Any]) -> None:
        super().__init__(context, part, options)
        # Potential at the state asked for last, and where it was last found to have fallen.
        self._energy = self._reached = np.inf

    def attach(self, *, consistent: bool) -> None:
        """See `SnesMethod.attach`."""
        super().attach(consistent=consistent)
        this: _Search = weakref.proxy(self)
        if self._equations.full.bulk.linear:
            self._callbacks.set_objective(self.snes, lambda x: this._compute_energy(x))

    def solve(self) -> tuple[int, int]:
        """See `Method.solve`."""
        self._energy = self._reached = np.inf
        return super().solve()

    def _compute_energy(self, x: PETSc.Vec) -> float:
        self._energy = self._equations.energy(x)
        return self._energy

    def converged(self) -> int:
        """See `SnesMethod.converged`; an end, too, where the energy has no digits left. Collective.

        Differences of these tell no descent.
        """
        reason, ongoing = super().converged(), int(_REASONS.ITERATING)
        if reason == ongoing and self._equations.solved(_NEAR):
            return int(_REASONS.DIVERGED_LINE_SEARCH)
        if reason != ongoing or not np.isfinite(self._energy):
            return reason
        fallen = self._reached - self._energy
        self._reached = self._energy
        if fallen <= _NOISE * self._equations.energy_size():
            return int(_REASONS.DIVERGED_LINE_SEARCH)
        return ongoing
