"""Linearised equations at a solution: response to additional loads or tractions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from petsc4py import PETSc

from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import Status
from fenics_contact.methods.callbacks import defer_interrupts
from fenics_contact.methods.equations import Equations
from fenics_contact.parallel import global_max
from fenics_contact.systems import dense, linear
from fenics_contact.types import Array, Mask

__all__ = ["linearise_end", "linearised_solver", "solve_response"]

# Residual of a response relative to the contact force, and of a failure, relative to this force or
# to the added forces, which are much larger if contact is stiff.
_RESPONSE_TOLERANCE, _MAX_RESPONSE_RESIDUAL = 1e-3, 1e-2


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
        A collective function that returns the change of this rank's unknowns due to tractions added
        on the body, one array (n_points, gdim) per contact, or for None due to the present
        residual; without ``prescribed``.
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


def linearise_end(
    equations: Equations, acting: Sequence[tuple[Contact, Mask]], start: Array
) -> Array | None:
    """Linearise the end of the increment with contacts restricted to some points. Collective.

    All other points that are closed in ``start`` stick.

    Args:
        equations: The equations of the increment.
        acting: Contacts and masks of their active points, (n_points,).
        start: The state at the start of the increment, with the previous prescribed values.

    Returns:
        The state; None if the other contacts do not constrain the bodies, or contact forces are not
        finite.
    """
    full, system, present = equations.full, equations.system, equations.full.state()
    change = None
    with system.restricted_contacts():
        try:
            for operator in system.operators:
                within = operator.within
                for contact, points in acting:
                    if contact is operator.contact:
                        contact.restrict_to(points if within is None else points & within)
            if not full.bulk.linear:  # new prescribed values may invert cells
                change = present - start
                full.set_state(start)
                full.update_stiffness()
            full.evaluate()
            largest = global_max(full.unknowns.comm, np.abs(system.contact_force()))
            if not (np.isfinite(largest) and equations.is_constrained()):
                return None
            closed = [contact.status != Status.OPEN for contact in full.contacts]
            springs = [c.values.springs(s, s) for c, s in zip(full.contacts, closed, strict=True)]
            with linearised_solver(equations, springs, prescribed=change) as solve:
                return present + solve(None)
        finally:
            equations.valid_matrices.discard(True)
            for contact, _ in acting:
                contact.restrict_to()
            full.set_state(present)
            if not full.bulk.linear:
                full.update_stiffness()


def solve_response(
    equations: Equations,
    springs: Sequence[Array],
    tractions: Sequence[Array],
    *,
    consistent: bool,
) -> list[Array]:
    """Compute approximate changes of the jump at the points of every contact. Collective.

    Equilibrium holds up to a thousandth of the contact force on every group of coupled bodies. The
    preconditioner is a matrix factored before, near the tangent of the solution.

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
        size = _size_by_group(equations, rhs.array_r)
        rhs.array[:] /= -size  # the matrix does not couple groups
        ksp.setOperators(matrix)
        ksp.setType(PETSc.KSP.Type.FGMRES)
        ksp.getPC().setType("python")
        ksp.getPC().setPythonContext(_FactoredPreconditioner(equations.solvers[consistent]))
        ksp.setTolerances(rtol=1e-12, atol=_RESPONSE_TOLERANCE, max_it=100)
        ksp.solve(rhs, solution)
        dense.raise_stored_error(equations.solvers[consistent])
        if not ksp.getResidualNorm() <= _MAX_RESPONSE_RESIDUAL * max(1.0, rhs.norm()):
            solution.set(np.nan)
        solution.array[:] *= size / system.bulk.scale
        return [operator.jump(solution.array_r) for operator in system.operators]
    finally:
        system.diagonal = diagonal
        for item in (ksp, matrix, rhs, solution):
            item.destroy()


def _size_by_group(equations: Equations, added: Array) -> Array:
    """Return the norm of the contact forces on the group of every unknown, (n_local,). Collective.

    Without contact force on a group it is the norm of the added forces.
    """
    system, scales = equations.system, equations.full.scales
    squares = np.zeros((2, scales.n_groups))
    for total, sizes in zip(squares, system.by_body(system.contact_force(), added), strict=True):
        np.add.at(total, scales.group, sizes**2)
    loaded, unloaded = np.sqrt(squares)
    size = np.where(loaded > scales.round_off_of_groups, loaded, unloaded)
    return np.asarray(np.where(size > 0.0, size, 1.0)[scales.group[system.partition.label]])


class _FactoredPreconditioner:
    """Preconditioner by the solver of a matrix with another active set."""

    def __init__(self, ksp: PETSc.KSP) -> None:
        ksp.setUp()
        self._pc = ksp.getPC()

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Apply the preconditioner."""
        self._pc.apply(x, y)
