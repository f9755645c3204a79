"""The quasi-Newton method: L-BFGS in rounds, H₀ made anew between them (section 5)."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
from petsc4py import PETSc

from fenics_contact import compat

__all__ = ["QuasiNewton"]

# Rounds in a row that do not lower the residual before the increment is given up: the potential may
# fall for long before the residual does.
_MAX_STALLS = 10
# Contact that bears less than this share of the residual an increment begins with tells nothing of
# which points will be closed.
_IDLE = 1e-3
# A round that ends with more than this times the lowest residual, or none, has gone astray: the
# next one starts where that was.
_ASTRAY = 1e3


class QuasiNewton:
    """The method, on the SNES, matrices and measures of a problem."""

    def __init__(self, problem: Any) -> None:
        """No H₀ yet.

        Args:
            problem: The `ContactProblem`.
        """
        self._problem = weakref.proxy(problem)
        self._has_h0 = self._refreshed = False

    def forget(self) -> None:
        """Say that the matrix of H₀ is gone, or was used for something else."""
        self._has_h0 = False

    def solve(self, stiffness_changed: bool) -> tuple[int, int]:
        """Solve the problem from its ``_solution`` on. Collective.

        Args:
            stiffness_changed: Whether the bulk's tangent is another one than in the last increment.

        Returns:
            Iterations, and the reason as SNES has them after a look at the residual itself.
        """
        problem, reasons = self._problem, PETSc.SNES.ConvergedReason
        snes, solution = problem.snes, problem._solution
        problem._compute_residual(solution, problem._function)
        norms = problem._norms
        borne = norms.force[norms.n_bodies :].max(initial=0.0)
        idle = self._refreshed and borne < _IDLE * norms.total
        if not self._has_h0 or stiffness_changed or idle:
            self._start()
            self._has_h0 = True
        else:
            problem._clear_pairs()
        iterations = stalls = 0
        best, kept = np.inf, solution.copy()
        while True:
            left = problem._max_it - iterations
            snes.setTolerances(max_it=min(problem._space.iterations_per_round, left))
            iterations += problem._callbacks.solve(snes, solution)[0]
            problem._compute_residual(solution, problem._function)
            residual = problem._norms.total
            if problem._norms.within(problem.rtol):
                return iterations, int(reasons.CONVERGED_FNORM_RELATIVE)
            if iterations >= problem._max_it:
                return iterations, int(reasons.DIVERGED_MAX_IT)
            if residual < best:
                stalls, best = 0, residual
                solution.copy(kept)
            else:
                stalls += 1
                if not residual <= _ASTRAY * best:
                    kept.copy(solution)
            if stalls >= _MAX_STALLS:
                lost = not np.isfinite(residual)
                failure = compat.NOT_FINITE if lost else int(reasons.DIVERGED_LINE_SEARCH)
                return iterations, failure
            if not self._refresh():
                return iterations, compat.NOT_FINITE

    def _start(self) -> None:
        """H₀ = (K + αK_n + φK_t)⁻¹, all of Γc closed and sticking (section 5). Collective."""
        problem = self._problem
        self._refreshed = False
        problem._clear_pairs(consistent=False)
        problem._assemble_matrix(problem._matrix(False), problem._stiffnesses(everywhere=True))

    def _refresh(self) -> bool:
        """Make H₀ anew from the status that the last round reached; False if none. Collective.

        With Coulomb friction it is the consistent tangent: what L-BFGS cannot build from pairs is
        the unsymmetric coupling of slip to pressure, and without it the residual wanders.
        """
        problem = self._problem
        problem._set_u(problem._solution)
        problem._update_bulk()
        if not np.isfinite(problem.bulk.scale):
            return False
        self._refreshed = True
        for contact in problem.contacts:
            contact.evaluate()
        problem._watch.note(problem._norms.total)
        consistent = not problem.has_potential and problem.motions.held(problem.operators)
        parts = problem._tangents() if consistent else problem._stiffnesses(everywhere=False)
        problem._clear_pairs(consistent=consistent)
        problem._assemble_matrix(problem._matrix(consistent), parts)
        return True
