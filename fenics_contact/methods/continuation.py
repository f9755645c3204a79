"""Continuation in the stiffness of contact: softer problems first, each the start of the next.

Newton's method finds the solution of soft contact from far away, and that of stiff contact from the
solution of one that is a little softer: the points that are closed, stick and slip are nearly those
of the next one, and for a given status the equations are linear, or nearly so. Where a step of the
stiffness does not succeed, a smaller one may. Soft contact that has no solution says nothing of
stiffer contact, which given displacements squeeze more: it is passed over. A start that is as near
to the solution as that of a softer problem would be is not softened.
"""

from __future__ import annotations

import logging

import numpy as np
from petsc4py import PETSc

from fenics_contact.methods.method import SolverContext, StandaloneMethod

__all__ = ["Continuation"]

logger = logging.getLogger("fenics_contact")

# Iterations for one stiffness: with 60 in place of 25 none of 142 random scenes on which Newton's
# method fails was solved in addition, in 1.06 times the iterations.
_PATIENCE = 25
# Halvings of a step before what is left of it is taken, as nothing else follows. Newton's method as
# the first one does better to fail at once: with this rule for it, too, random scenes with 30 times
# the stiffness took 1747 iterations for 824.
_HALVINGS = 4
# Factor of the stiffness from one problem to the next, and the least that is tried.
_FACTOR = 10.0
_LEAST_FACTOR = 1.2
# Iterations in all before it is given up; what it solves takes 600 at most.
_MAX_ITERATIONS = 1000
# Residual of the softer problems, as a share of the forces: they are starts, not results.
_COARSE = 1e-3


class Continuation(StandaloneMethod):
    """The method.

    Attributes:
        snes: Newton's method for one stiffness, prefix "continuation_" behind the problem's.
        by_newton: Whether there was a solution the last time.
    """

    def __init__(self, context: SolverContext) -> None:
        self._equations = context.equations
        self._newton = context.newton("continuation_", {"snes_max_it": _PATIENCE})
        self._newton.most_halvings = _HALVINGS
        self.snes = self._newton.snes
        self.by_newton = False
        self._whole: list[float] = []  # of each contact

    def solve(self) -> tuple[int, int]:
        """See `Method.solve`. Iterations are those of all stiffnesses."""
        equations = self._equations
        self._newton.attach(consistent=True)
        self._whole = [float(c.inputs.stiffness_factor.value) for c in equations.contacts]
        # Softer than it is in any case: Newton's method alone is what failed.
        soft = 1.0 / max(equations.stiffness_ratio(), _FACTOR)
        # From a start as near as they are solved to, softer problems only lead away.
        equations.residual(equations.solution, equations.function)
        near = equations.solved(_COARSE)
        share = 1.0 if near else soft
        iterations, solved, factor, kept = 0, 0.0, _FACTOR, equations.solution.copy()
        try:
            while iterations <= _MAX_ITERATIONS:
                self._soften(share)
                equations.monitor.reset()
                made, reason = self._newton.solve()
                iterations += made
                self.by_newton = reason > 0
                if share == 1.0 and (reason > 0 or not (near or solved)):
                    return iterations, reason
                if reason > 0:
                    logger.debug("%.3g of the stiffness, %d iterations so far", share, iterations)
                    solved = share
                    equations.solution.copy(kept)
                else:
                    kept.copy(equations.solution)
                    if solved:
                        factor = np.sqrt(factor)
                if factor < _LEAST_FACTOR:
                    return iterations, reason
                if near:
                    near, share = False, soft
                else:
                    share = min(1.0, factor * (solved or share))
            return iterations, int(PETSc.SNES.ConvergedReason.DIVERGED_MAX_IT)
        finally:
            self._soften(1.0)
            equations.h0_is_made = False

    def _soften(self, share: float) -> None:
        """Let the contacts have a share of the stiffness they came with."""
        for contact, whole in zip(self._equations.contacts, self._whole, strict=True):
            contact.inputs.stiffness_factor.value = share * whole
        self._newton.coarse = _COARSE if share < 1.0 else 0.0
