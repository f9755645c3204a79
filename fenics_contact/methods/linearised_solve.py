"""Linearised equations at a solution: response to additional loads or tractions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from petsc4py import PETSc

from fenics_contact.methods.callbacks import defer_interrupts
from fenics_contact.methods.equations import Equations
from fenics_contact.systems import dense, linear
from fenics_contact.types import Array

__all__ = ["linearised_solver", "solve_response"]

# Residuals relative to the change of the tractions at fixed displacements; the second is that of a
# failure. Displacements cancel most of this change if contact is stiff: 1e-3 is too large with
# k h/E = 2000 and multigrid.
_RESPONSE_RTOL, _FAILED_RTOL = 1e-4, 1e-2


@contextmanager
def linearised_solver(
    equations: Equations, springs: Sequence[Array], *, prescribed: Array | None = None
) -> Iterator[Callable[[Sequence[Array] | None], Array]]:
    """Solve with the bulk's tangent and given springs on Γc at the present state. Collective.

    The matrix of the consistent tangent is overwritten.

    Args:
        equations: The equations at a complete state.
        springs: Stiffness at the points of every contact, (n_points, gdim, gdim) each
            (stress/length).
        prescribed: Remaining change of the prescribed values, 0 elsewhere, over all unknowns of the
            full system (length); None: they have their new values.

    Yields:
        The solver, as in `ContactProblem.linearised`; its solutions exclude ``prescribed``.
    """
    system = equations.system
    rhs, solution = system.vector(), system.vector()
    ksp = PETSc.KSP().create(rhs.comm)

    def solve(tractions: Sequence[Array] | None) -> Array:
        rhs.set(0.0)
        if tractions is None:
            rhs.array[:] = system.bulk_force() + system.contact_force()
            if prescribed is not None:
                assert equations.full.stiffness is not None
                solution.array[:] = prescribed
                equations.full.stiffness.multAdd(solution, rhs, rhs)
        else:
            for operator, traction in zip(system.operators, tractions, strict=True):
                operator.add_force(rhs, traction)
        rhs.array[system.constrained] = 0.0
        rhs.scale(-1.0 / system.bulk.scale)
        with defer_interrupts():
            ksp.solve(rhs, solution)
        dense.raise_stored_error(ksp)
        if ksp.getConvergedReason() == PETSc.KSP.ConvergedReason.DIVERGED_PCSETUP_FAILED:
            raise ValueError(
                "the linearised equations are singular at this state: a body or a free obstacle is "
                "not constrained, as before the first solution or with open contact; use a state "
                "with loaded contact"
            )
        if ksp.getConvergedReason() < 0:
            raise RuntimeError(
                "the linearised problem at the solution did not converge (KSP reason "
                f"{ksp.getConvergedReason()}); use linear_solver='direct'"
            )
        return system.extend(solution.array_r.copy())

    try:
        matrices = (o.springs(s) for o, s in zip(system.operators, springs, strict=True))
        equations.assemble(equations.matrix(True), matrices)
        # The solver of the tangent may be one V-cycle; with a factorisation GMRES takes one
        # iteration.
        ksp.setOperators(equations.matrix(True))
        ksp.setType(PETSc.KSP.Type.GMRES)
        ksp.setPC(equations.solvers[True].getPC())
        ksp.setTolerances(rtol=1e-8, max_it=1000)
        yield solve
    finally:
        linear.reset_failed_factorisation(equations.solvers[True].getPC())
        for item in (ksp, rhs, solution):
            item.destroy()


def solve_response(
    equations: Equations,
    springs: Sequence[Array],
    tractions: Sequence[Array],
    *,
    consistent: bool,
) -> list[Array]:
    """Compute approximate changes of the jump at the points of every contact. Collective.

    The preconditioner is a matrix factored before, near the tangent of the solution.

    Args:
        equations: The equations at a solution.
        springs: Stiffness at the points of every contact, (n_points, gdim, gdim) each
            (stress/length).
        tractions: Additional tractions on the body, (n_points, gdim) each (stress).
        consistent: Whether the factored matrix is the consistent tangent, not H₀.
    """
    system = equations.system
    rhs, solution, diagonal = system.vector(), system.vector(), system.diagonal
    matrix = system.matrix(symmetric=False)
    ksp = PETSc.KSP().create(rhs.comm)
    try:
        if consistent not in equations.valid_matrices:  # before the first iteration
            equations.assemble(equations.matrix(consistent), equations.tangents())
        parts = (o.springs(k) for o, k in zip(system.operators, springs, strict=True))
        system.fill(matrix, parts)
        for operator, traction in zip(system.operators, tractions, strict=True):
            operator.add_force(rhs, traction)
        rhs.array[system.constrained] = 0.0
        rhs.scale(-1.0 / system.bulk.scale)
        ksp.setOperators(matrix)
        ksp.setType(PETSc.KSP.Type.FGMRES)
        ksp.getPC().setType("python")
        ksp.getPC().setPythonContext(_FactoredPreconditioner(equations.solvers[consistent]))
        ksp.setTolerances(rtol=_RESPONSE_RTOL, max_it=100)
        ksp.solve(rhs, solution)
        dense.raise_stored_error(equations.solvers[consistent])
        if ksp.getResidualNorm() > _FAILED_RTOL * rhs.norm():
            solution.set(np.nan)
        return [operator.jump(solution.array_r) for operator in system.operators]
    finally:
        system.diagonal = diagonal
        for item in (ksp, matrix, rhs, solution):
            item.destroy()


class _FactoredPreconditioner:
    """Preconditioner by the solver of a matrix with another active set."""

    def __init__(self, ksp: PETSc.KSP) -> None:
        ksp.setUp()
        self._pc = ksp.getPC()

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Apply the preconditioner."""
        self._pc.apply(x, y)
