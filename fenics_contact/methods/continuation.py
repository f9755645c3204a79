"""Continuation in the contact stiffness: solutions with increasing stiffness.

Newton's method converges for a low stiffness from a distant start, and for a higher one from the
solution of the previous stiffness, whose active set is nearly the same; for a given active set the
equations are (nearly) linear. After a failure the factor of the stiffness is reduced. A failure
before any solution raises the stiffness, since prescribed displacements may need more contact
force. A start with the residual of a softer problem is solved at full stiffness first.
"""

from __future__ import annotations

import logging

import numpy as np
from petsc4py import PETSc

from fenics_contact.methods.method import SolverContext, StandaloneMethod

__all__ = ["Continuation"]

logger = logging.getLogger("fenics_contact")

# Per stiffness: 60 solved no more of 142 random scenes on which Newton's method fails, with 1.06
# times the iterations.
_MAX_ITERATIONS_EACH = 25
# Halvings after which a step is taken, as no method follows. Newton's method as the first one fails
# instead: with this rule random scenes of 30 times the stiffness took 1747 iterations, not 824.
_MAX_HALVINGS = 4
# Factor of the stiffness between solutions, initial and least.
_INITIAL_FACTOR = 10.0
_MIN_FACTOR = 1.2
_MAX_ITERATIONS = 1000  # of all stiffnesses; successful continuations need 600 at most
_SOFT_RTOL = 1e-3  # relative residual of the softer problems


class Continuation(StandaloneMethod):
    """Continuation in the contact stiffness.

    Attributes:
        snes: Newton's method for one stiffness; its prefix ends in "continuation_".
        is_newton_solution: Whether the last solution has converged.
    """

    def __init__(self, context: SolverContext) -> None:
        self._equations = context.equations
        self._newton = context.newton("continuation_", {"snes_max_it": _MAX_ITERATIONS_EACH})
        self._newton.max_halvings = _MAX_HALVINGS
        self.snes = self._newton.snes
        self.is_newton_solution = False
        self._full_stiffness: list[float] = []  # factor of each contact

    def solve(self) -> tuple[int, int]:
        """Solve with increasing stiffness; the iterations are those of all stiffnesses."""
        equations = self._equations
        self._newton.attach(consistent=True)
        self._full_stiffness = [float(c.inputs.stiffness_factor.value) for c in equations.contacts]
        # Softer in any case, since Newton's method has failed at full stiffness.
        soft = 1.0 / max(equations.stiffness_ratio(), _INITIAL_FACTOR)
        equations.residual(equations.solution, equations.function)
        near = equations.is_converged(_SOFT_RTOL)
        ratio = 1.0 if near else soft
        iterations, solved, factor, last = 0, 0.0, _INITIAL_FACTOR, equations.solution.copy()
        try:
            while iterations <= _MAX_ITERATIONS:
                self._set_stiffness(ratio)
                equations.monitor.reset()
                n_iterations, reason = self._newton.solve()
                iterations += n_iterations
                self.is_newton_solution = reason > 0
                if ratio == 1.0 and (reason > 0 or not (near or solved)):
                    return iterations, reason
                if reason > 0:
                    logger.debug("%.3g of the stiffness, %d iterations so far", ratio, iterations)
                    solved = ratio
                    equations.solution.copy(last)
                else:
                    last.copy(equations.solution)
                    if solved:
                        factor = np.sqrt(factor)
                if factor < _MIN_FACTOR:
                    return iterations, reason
                if near:
                    near, ratio = False, soft
                else:
                    ratio = min(1.0, factor * (solved or ratio))
            return iterations, int(PETSc.SNES.ConvergedReason.DIVERGED_MAX_IT)
        finally:
            self._set_stiffness(1.0)
            equations.is_h0_current = False

    def _set_stiffness(self, ratio: float) -> None:
        """Set a fraction of the original stiffness in all contacts."""
        for contact, factor in zip(self._equations.contacts, self._full_stiffness, strict=True):
            contact.inputs.stiffness_factor.value = ratio * factor
        self._newton.coarse_rtol = _SOFT_RTOL if ratio < 1.0 else 0.0
