"""The quasi-Newton method: L-BFGS in rounds, H₀ made anew between them (section 5)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from petsc4py import PETSc

from fenics_contact import compat
from fenics_contact.methods.equations import Equations
from fenics_contact.methods.method import SnesMethod

__all__ = ["QuasiNewton"]

# Rounds in a row that do not lower the residual before the increment is given up: the potential may
# fall for long before the residual does.
_MAX_STALLS = 10
# The same where friction does not bear the load by the present pressures.
_FEW_STALLS = 3
# Contact that bears less than this share of the residual an increment begins with tells nothing of
# which points will be closed.
_IDLE = 1e-3
# A round that ends with more than this times the lowest residual, or none, has gone astray: the
# next one starts where that was.
_ASTRAY = 1e3

_REASONS = PETSc.SNES.ConvergedReason


class QuasiNewton(SnesMethod):
    """The method; SNES makes a round, whose limit of iterations is its own."""

    def __init__(
        self, equations: Equations, snes: PETSc.SNES, can_hand_over: Callable[[], bool]
    ) -> None:
        super().__init__(equations, snes, can_hand_over)
        self._limit: int | None = None
        self._refreshed = False

    @classmethod
    def main_options(cls) -> Mapping[str, Any]:
        """See `Method.main_options`."""
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
        """Iterations in all before it is given up."""
        return super().max_it if self._limit is None else self._limit

    @max_it.setter
    def max_it(self, limit: int) -> None:
        self._limit = limit

    def _compute_jacobian(self, x: PETSc.Vec, J: PETSc.Mat) -> None:
        """H₀ is made between the rounds, and kept during one."""

    def solve(self) -> tuple[int, int]:
        """See `Method.solve`. The reason is after a look at the residual itself."""
        equations, snes = self._equations, self.snes
        limit = self._limit = self.max_it  # SNES has that of a round from now on
        solution = equations.solution
        norms = equations.residual(solution, equations.function)
        borne = norms.force[norms.n_bodies :].max(initial=0.0)
        idle = borne < _IDLE * norms.total
        # Multigrid follows at once, a factorisation is kept.
        if equations.uses_v_cycle or not equations.is_h0_current or (idle and self._refreshed):
            self._start(idle=idle)
        else:
            self._clear_pairs(consistent=self.consistent)
        iterations = stalls = 0
        best, kept = np.inf, solution.copy()
        while True:
            left = limit - iterations
            snes.setTolerances(max_it=min(equations.system.iterations_per_round, left))
            iterations += self._callbacks.solve(snes, solution)[0]
            residual = equations.residual(solution, equations.function).total
            if equations.solved():
                return iterations, int(_REASONS.CONVERGED_FNORM_RELATIVE)
            if iterations >= limit:
                return iterations, int(_REASONS.DIVERGED_MAX_IT)
            if residual < best:
                stalls, best = 0, residual
                solution.copy(kept)
            else:
                stalls += 1
                if not residual <= _ASTRAY * best:
                    kept.copy(solution)
            if stalls >= _MAX_STALLS:
                lost = not np.isfinite(residual)
                failure = compat.NOT_FINITE if lost else int(_REASONS.DIVERGED_LINE_SEARCH)
                return iterations, failure
            if not self._refresh():
                return iterations, compat.NOT_FINITE
            may_hand_over = stalls >= _FEW_STALLS and self.can_hand_over()
            if may_hand_over and equations.find_overload() is not None:
                return iterations, int(_REASONS.DIVERGED_LINE_SEARCH)

    def _start(self, *, idle: bool) -> None:
        """Begin with H₀ of the status at the start, or of all of Γc where that tells nothing.

        Collective. A rigid ball on a block, pressed by a given depth, overlaps where it is going
        to touch: a third to a half of the iterations are saved.

        Args:
            idle: Whether contact bears next to nothing there.
        """
        equations = self._equations
        self._clear_pairs(consistent=False)
        equations.evaluate(equations.solution)
        self._refreshed = not idle and equations.is_constrained()
        equations.assemble_h0(everywhere=not self._refreshed)

    def _refresh(self) -> bool:
        """Make H₀ anew from the status that the last round reached; False if none. Collective.

        With Coulomb friction it is the consistent tangent: what L-BFGS cannot build from pairs is
        the unsymmetric coupling of slip to pressure, and without it the residual wanders.
        """
        equations = self._equations
        equations.evaluate(equations.solution)
        if not np.isfinite(equations.full.bulk.scale):
            return False
        self._refreshed = True
        tangent = not equations.has_potential and equations.is_constrained()
        springs = equations.stiffnesses(everywhere=False)
        parts = equations.regularised_tangents() if tangent else springs
        consistent = tangent and not equations.uses_v_cycle
        self._clear_pairs(consistent=consistent)
        equations.assemble(equations.matrix(consistent), parts)
        return True

    def _clear_pairs(self, *, consistent: bool) -> None:
        """Forget the pairs of L-BFGS and keep the factorisation, which reset() would drop too."""
        self.snes.setKSP(PETSc.KSP().create(self.snes.comm))
        self.snes.reset()
        self.attach(consistent=consistent)
