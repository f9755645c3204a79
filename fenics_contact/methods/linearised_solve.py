"""The equations linearised about a solution: what more load or traction would change."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from petsc4py import PETSc

from fenics_contact.methods.callbacks import interrupts_held
from fenics_contact.methods.equations import Equations
from fenics_contact.systems import dense, linear
from fenics_contact.types import Array

__all__ = ["linearised", "respond"]


# Residual to which systems near the one factored last are solved.
_NEARBY = 1e-4
# Residual with which they are not solved at all.
_ROUGHLY = 1e-2


@contextmanager
def linearised(
    equations: Equations, springs: Sequence[Array], *, prescribed: Array | None = None
) -> Iterator[Callable[[Sequence[Array] | None], Array]]:
    """Solve with the bulk's tangent and given springs on Γc, about the present state.

    Collective. It takes the matrix of the consistent tangent.

    Args:
        equations: At a complete state.
        springs: Stiffness at the points of every contact, (n_points, gdim, gdim) each
            (stress/length).
        prescribed: By how much prescribed values are still to change, 0 elsewhere, over all
            unknowns, on which the system has to be (length); None: they have their new values.

    Yields:
        See `ContactProblem.linearised`; changes are without ``prescribed``.
    """
    system = equations.system
    right, left = system.vector(), system.vector()
    ksp = PETSc.KSP().create(right.comm)

    def solve(tractions: Sequence[Array] | None) -> Array:
        right.set(0.0)
        if tractions is None:
            right.array[:] = system.bulk_force() + system.contact_force()
            if prescribed is not None:
                assert equations.full.stiffness is not None
                left.array[:] = prescribed
                equations.full.stiffness.multAdd(left, right, right)
        else:
            for operator, traction in zip(system.operators, tractions, strict=True):
                operator.add_force(right, traction)
        right.array[system.constrained] = 0.0
        right.scale(-1.0 / system.bulk.scale)
        with interrupts_held():
            ksp.solve(right, left)
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
        return system.extended(left.array_r.copy())

    try:
        matrices = (o.springs(s) for o, s in zip(system.operators, springs, strict=True))
        equations.assemble(equations.matrix(True), matrices)
        # The tangent's own solver may be a V-cycle and no more; after a factorisation GMRES ends
        # with its first iteration.
        ksp.setOperators(equations.matrix(True))
        ksp.setType(PETSc.KSP.Type.GMRES)
        ksp.setPC(equations.solvers[True].getPC())
        ksp.setTolerances(rtol=1e-8, max_it=1000)
        yield solve
    finally:
        linear.forget_failure(equations.solvers[True].getPC())
        for item in (ksp, right, left):
            item.destroy()


def respond(
    equations: Equations,
    springs: Sequence[Array],
    tractions: Sequence[Array],
    *,
    consistent: bool,
) -> list[Array]:
    """Changes of the relative displacements at the points of every contact. Collective.

    To some digits: with a matrix factored before, which is the tangent near the solution.

    Args:
        equations: At a solution.
        springs: Stiffness at the points of every contact, (n_points, gdim, gdim) each
            (stress/length).
        tractions: What is added on the body, (n_points, gdim) each (stress).
        consistent: Whether the matrix is that of the consistent tangent, or else of H₀.
    """
    system = equations.system
    right, left, diagonal = system.vector(), system.vector(), system.diagonal
    matrix = system.matrix(symmetric=False)
    ksp = PETSc.KSP().create(right.comm)
    try:
        if consistent not in equations.filled:  # nothing was iterated yet
            equations.assemble(equations.matrix(consistent), equations.tangents())
        parts = (o.springs(k) for o, k in zip(system.operators, springs, strict=True))
        system.fill(matrix, parts)
        for operator, traction in zip(system.operators, tractions, strict=True):
            operator.add_force(right, traction)
        right.array[system.constrained] = 0.0
        right.scale(-1.0 / system.bulk.scale)
        ksp.setOperators(matrix)
        ksp.setType(PETSc.KSP.Type.FGMRES)
        ksp.getPC().setType("python")
        ksp.getPC().setPythonContext(_Nearby(equations.solvers[consistent]))
        ksp.setTolerances(rtol=_NEARBY, max_it=100)
        ksp.solve(right, left)
        dense.raise_stored_error(equations.solvers[consistent])
        if ksp.getResidualNorm() > _ROUGHLY * right.norm():
            left.set(np.nan)  # nothing is known
        return [operator.jump(left.array_r) for operator in system.operators]
    finally:
        system.diagonal = diagonal
        for item in (ksp, matrix, right, left):
            item.destroy()


class _Nearby:
    """A preconditioner: the solver of a matrix that differs by the status of some points."""

    def __init__(self, ksp: PETSc.KSP) -> None:
        ksp.setUp()
        self._pc = ksp.getPC()

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """For PETSc."""
        self._pc.apply(x, y)
