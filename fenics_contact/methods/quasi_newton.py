"""L-BFGS with restarts, at which H₀ is assembled again (section 5)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from petsc4py import PETSc

from fenics_contact import compat
from fenics_contact.methods.equations import Equations
from fenics_contact.methods.method import SnesMethod

__all__ = ["QuasiNewton"]

# Consecutive restarts without a lower residual: the potential may decrease long before it does.
_MAX_STALLS = 10
_MAX_OVERLOAD_STALLS = 3  # with an overload of friction at the present pressures
# Ratio of contact force to initial residual below which H₀ ignores the initial active set.
_INACTIVE_FORCE_RATIO = 1e-3
# Ratio of residual to least residual above which the iteration has diverged and returns to the
# iterate of the least one.
_DIVERGED_RATIO = 1e3

_REASONS = PETSc.SNES.ConvergedReason


class QuasiNewton(SnesMethod):
    """L-BFGS; SNES iterates between restarts, with an iteration limit of its own."""

    def __init__(
        self, equations: Equations, snes: PETSc.SNES, can_hand_over: Callable[[], bool]
    ) -> None:
        super().__init__(equations, snes, can_hand_over)
        self._limit: int | None = None
        self._has_active_set = False

    @classmethod
    def main_options(cls) -> Mapping[str, Any]:
        """Return options of L-BFGS."""
        return {
            "snes_type": "qn",
            "snes_qn_type": "lbfgs",
            "snes_qn_scale_type": "jacobian",
            "snes_qn_restart_type": "none",  # Powell's uses K where K⁻¹ is meant
            "snes_qn_m": 20,
            "qn_mat_lmvm_eps": 0.0,  # else pairs are dropped by a test that depends on the units
        }

    @property
    def max_it(self) -> int:
        """Maximum number of iterations over all restarts."""
        return super().max_it if self._limit is None else self._limit

    @max_it.setter
    def max_it(self, limit: int) -> None:
        self._limit = limit

    def _compute_jacobian(self, x: PETSc.Vec, J: PETSc.Mat) -> None:
        """Do nothing: H₀ is assembled at restarts."""

    def solve(self) -> tuple[int, int]:
        """Solve the equations; the reason is that of the residual, not of SNES. Collective."""
        equations, snes = self._equations, self.snes
        limit = self._limit = self.max_it  # the limit of SNES is per restart from now on
        solution = equations.solution
        norms = equations.residual(solution, equations.function)
        contact_force = norms.force[norms.n_bodies :].max(initial=0.0)
        unloaded = contact_force < _INACTIVE_FORCE_RATIO * norms.total
        # Multigrid is inexpensive to set up again, a factorisation is reused.
        if (
            equations.uses_v_cycle
            or not equations.is_h0_current
            or (unloaded and self._has_active_set)
        ):
            self._assemble_first_h0(unloaded=unloaded)
        else:
            self._clear_updates(consistent=self.consistent)
        iterations = stalls = 0
        best, best_solution = np.inf, solution.copy()
        while True:
            remaining = limit - iterations
            snes.setTolerances(max_it=min(equations.system.iterations_per_restart, remaining))
            iterations += self._callbacks.solve(snes, solution)[0]
            residual = equations.residual(solution, equations.function).total
            if equations.is_converged():
                return iterations, int(_REASONS.CONVERGED_FNORM_RELATIVE)
            if iterations >= limit:
                return iterations, int(_REASONS.DIVERGED_MAX_IT)
            if residual < best:
                stalls, best = 0, residual
                solution.copy(best_solution)
            else:
                stalls += 1
                if not residual <= _DIVERGED_RATIO * best:
                    best_solution.copy(solution)
            if stalls >= _MAX_STALLS:
                diverged = not np.isfinite(residual)
                failure = (
                    compat.DIVERGED_NOT_FINITE if diverged else int(_REASONS.DIVERGED_LINE_SEARCH)
                )
                return iterations, failure
            if not self._assemble_h0():
                return iterations, compat.DIVERGED_NOT_FINITE
            stalled = stalls >= _MAX_OVERLOAD_STALLS and self.can_hand_over()
            if stalled and equations.find_overloads():
                return iterations, int(_REASONS.DIVERGED_LINE_SEARCH)

    def _assemble_first_h0(self, *, unloaded: bool) -> None:
        """Assemble H₀ with the initial active set, or with all of Γc sticking. Collective.

        With a prescribed displacement the initial penetration indicates the contact zone, which
        saves a third to a half of the iterations.

        Args:
            unloaded: Whether the contact force is negligible.
        """
        equations = self._equations
        self._clear_updates(consistent=False)
        equations.evaluate(equations.solution)
        self._has_active_set = not unloaded and equations.is_constrained()
        equations.assemble_h0(everywhere=not self._has_active_set)

    def _assemble_h0(self) -> bool:
        """Assemble H₀ with the present active set; return whether it is finite. Collective.

        With Coulomb friction it is the consistent tangent: updates of L-BFGS cannot represent the
        unsymmetric coupling of slip to pressure, without which it does not converge.
        """
        equations = self._equations
        equations.evaluate(equations.solution)
        if not np.isfinite(equations.full.bulk.scale):
            return False
        self._has_active_set = True
        tangent = not equations.has_potential and equations.is_constrained()
        springs = equations.stiffnesses(everywhere=False)
        parts = equations.regularised_tangents() if tangent else springs
        consistent = tangent and not equations.uses_v_cycle
        self._clear_updates(consistent=consistent)
        equations.assemble(equations.matrix(consistent), parts)
        return True

    def _clear_updates(self, *, consistent: bool) -> None:
        """Delete the L-BFGS updates, but not the factorisation, which reset() would delete, too."""
        self.snes.setKSP(PETSc.KSP().create(self.snes.comm))
        self.snes.reset()
        self.attach(consistent=consistent)
