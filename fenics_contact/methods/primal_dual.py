"""Primal-dual active set method: semismooth Newton method for displacements and tractions.

With a stiff law a slightly too long Newton step gives much too large tractions, and the line search
rejects it. Here the tractions s at the points are unknowns in addition to the displacements g:

    s = R(s + c (g - C s)),    C = K⁻¹,

with the return map R of a trial traction, the stiffness K of the law (k_n and k_t), and a moderate
stiffness c. The solutions are those of s = R(K g) for any c. c = K is Newton's method, K → ∞ the
primal-dual active set method (P. Alart and A. Curnier, Comput. Methods Appl. Mech. Engrg. 92, 1991;
S. Hüeber, G. Stadler and B. Wohlmuth, SIAM J. Sci. Comput. 30, 2008). With c of the order of the
bulk's stiffness both displacements and tractions determine the status. R is the law evaluated at
C (s + c (g - C s)) = g - (1 - c C) e, with the misfit e = g - C s. Tractions are eliminated point
by point, so that linear systems are those of Newton's method.

Unlike in Newton's method, a point whose slip is reversed sticks first, in a range of c, not of k_t,
which a step would hardly ever meet.

Steps are full and depend only on the status of the points: a repeated status leads to a cycle,
which half a step leaves.
"""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from fenics_contact.contact.contact import Contact
from fenics_contact.contact.point_law import PointTangent
from fenics_contact.contact.values import PointValues
from fenics_contact.methods.equations import Equations
from fenics_contact.methods.method import SnesMethod, SolverContext, StandaloneMethod
from fenics_contact.systems.operator import ContactOperator
from fenics_contact.tolerances import FLAT
from fenics_contact.types import Array

__all__ = ["PrimalDual"]

_OPTIONS = {
    "snes_type": "newtonls",
    "snes_rtol": 0.0,
    "snes_stol": 0.0,
    "snes_atol": 0.0,
    "snes_max_it": 30,
    "snes_linesearch_type": "basic",
}
# For iterative linear solvers: the decrease of the residual is no measure of the required accuracy,
# since K multiplies an error of the displacement. Slow linear solutions occur far from the end.
_ITERATED = {
    "snes_ksp_ew_rtol0": 1e-4,
    "snes_ksp_ew_rtolmax": 1e-4,
    "snes_max_linear_solve_fail": _OPTIONS["snes_max_it"],
}
_CYCLE_DAMPING = 0.5  # factor of a step of equal norm to an earlier one, which indicates a cycle


class PrimalDual(StandaloneMethod):
    """Primal-dual active set method.

    Attributes:
        snes: Newton's method; its prefix ends in "primal_dual_".
    """

    is_newton_solution = True

    def __init__(self, context: SolverContext) -> None:
        equations = self._equations = context.equations
        self.snes, own = context.create_snes("primal_dual_", _OPTIONS, with_own=_ITERATED)
        self._newton = _MixedNewton(equations, self.snes, own_solver=own)

    def check(self) -> None:
        """Check that the problem has friction with finite stiffness and a linear bulk."""
        if not self.is_applicable:
            raise ValueError(
                "method is 'primal_dual', which needs friction with stiffness k_n and k_t, small "
                "displacements, a linear bulk, and obstacles without unknown motions; use another "
                "method"
            )

    @property
    def is_applicable(self) -> bool:
        """Whether the method applies to the problem."""
        full = self._equations.full
        has_friction = any(contact.law.has_friction for contact in full.contacts)
        return (
            has_friction
            and full.bulk.linear
            and all(_is_suitable(contact) for contact in full.contacts)
        )

    def solve(self) -> tuple[int, int]:
        """Solve the equations by full Newton steps. Collective."""
        self._newton.attach(consistent=True)
        try:
            return self._newton.solve()
        finally:
            for contact in self._equations.contacts:
                contact.states.forget()  # evaluated at other displacements


class _MixedNewton(SnesMethod):
    """Newton's method on displacements and tractions."""

    def __init__(self, equations: Equations, snes: PETSc.SNES, *, own_solver: bool) -> None:
        super().__init__(equations, snes, lambda: False, own_solver=own_solver)
        self._points: list[_Points] = []
        self._ratio = 1.0  # c / K
        self._sizes: list[float] = []  # norms of previous steps, as residuals
        self._damping = 1.0  # of the present step

    def solve(self) -> tuple[int, int]:
        """Solve the equations. Collective."""
        self._points = []
        try:
            return super().solve()
        finally:
            self._points = []

    def _compute_residual(self, x: PETSc.Vec, f: PETSc.Vec) -> None:
        """Compute the right-hand side of the next step into ``f``. Collective."""
        equations, system = self._equations, self._equations.system
        if not self._points:
            ratio = 1.0 / max(equations.stiffness_ratio(), 1.0)
            self._ratio, self._sizes, self._damping = ratio, [], 1.0
            equations.set_state(x)
            self._points = [_Points(operator) for operator in system.operators]
        equations.residual(x, f)  # of the original law, for the convergence test
        for points in self._points:
            points.update(self._ratio, self._damping)
        everywhere = not equations.is_constrained()
        for points in self._points:
            points.linearise(everywhere=everywhere)
        total = f.duplicate()
        total.array[:] = system.bulk_force()
        for points in self._points:
            points.operator.add_force(total, points.traction)
        total.array[system.constrained] = 0.0
        f.array[:] = total.array_r / (equations.full.bulk.scale * equations.length)
        total.destroy()
        size = f.norm()
        is_repeated = any(abs(size - before) <= FLAT * before for before in self._sizes)
        self._damping = _CYCLE_DAMPING if is_repeated else 1.0
        self._sizes.append(size)
        f.scale(self._damping)

    def _compute_jacobian(self, x: PETSc.Vec, J: PETSc.Mat) -> None:
        tangents = (p.operator.tangent(PointTangent(p.tangent)) for p in self._points)
        self._equations.assemble(J, tangents)


def _is_suitable(contact: Contact) -> bool:
    law = contact.law
    springs = law.has_normal_stiffness and "k_n" in law.positive
    springs = springs and not (law.has_own_normal or law.has_tension)
    has_friction = law.has_friction or not law.has_tangential
    return (
        springs and has_friction and not (contact.contact_kinematics.is_finite or contact.motions)
    )


class _Points:
    """The points of a contact, and their tractions.

    Attributes:
        operator: Operator of the contact.
        traction: Traction on the body after the next step at constant displacement,
            (n_points, gdim) (stress).
        tangent: Its derivative by the displacement, (n_points, gdim, gdim) (stress/length).
    """

    def __init__(self, operator: ContactOperator) -> None:
        """Initialise at the present state with the committed tractions. Collective."""
        self.operator, self._ratio = operator, 1.0
        contact = self._contact = operator.contact
        contact.evaluate()
        values = self._values = contact.values
        self._jump = contact.contact_kinematics.present_jump()
        self._springs = _Springs(values, friction=contact.law.has_friction)
        before: Array = np.zeros(len(self._jump))
        if contact.multipliers is None:
            before = contact.history.values("normal_traction") / values.normal_stiffness
        self._misfit = (before - values.gap)[:, None] * values.normal + values.increment
        self.traction = self._correction = np.zeros_like(self._jump)
        self.tangent: Array = np.zeros((*self._jump.shape, self._jump.shape[1]))

    def update(self, ratio: float, damping: float) -> None:
        """Update the tractions by the damped step; evaluate the law with c / K. Collective."""
        self._ratio = ratio
        contact, springs = self._contact, self._springs
        jump = contact.contact_kinematics.present_jump()
        step = springs.project(jump - self._jump)
        change = _multiply(self.tangent, step) - damping * self._correction
        self._misfit = self._misfit + step - _multiply(springs.compliance, change)
        self._jump = jump
        with contact.contact_kinematics.displaced((self._ratio - 1.0) * self._misfit):
            contact.evaluate()
            tangent = contact.effective_law.tangent().by_jump
        self._values = contact.values
        self.tangent = springs.remove_round_off(tangent, self._values)

    def linearise(self, *, everywhere: bool) -> None:
        """Compute `traction` and `tangent` from the law; ``everywhere``: all points stick."""
        springs, values, ratio = self._springs, self._values, self._ratio
        trial, excess = springs.trial_traction(values)
        if everywhere:
            paired = values.paired > 0
            excess[paired] = 0.0
            self.tangent = np.where(paired[:, None, None], springs.stiffness, self.tangent)
        elastic = ratio * _multiply(springs.stiffness, self._misfit)
        matrix = np.eye(self.tangent.shape[1])
        matrix = matrix + (ratio - 1.0) * self.tangent @ springs.compliance
        correction = np.linalg.solve(matrix, (excess - elastic)[:, :, None])[:, :, 0]
        self._correction = np.asarray(correction, dtype=np.float64)
        self.tangent = np.asarray(ratio * np.linalg.solve(matrix, self.tangent), dtype=np.float64)
        self.traction = trial - elastic - self._correction


class _Springs:
    """The penalty springs of sticking points, independent of the state.

    Attributes:
        stiffness: Derivative of the traction by the displacement, (n_points, gdim, gdim)
            (stress/length); negative.
        compliance: Its inverse, without friction only in normal direction (length/stress).
    """

    def __init__(self, values: PointValues, *, friction: bool) -> None:
        """Compute the springs from values at the points."""
        self._friction = friction
        self._normal = values.normal
        normal = np.einsum("qi,qj->qij", values.normal, values.normal)
        along = values.normal_stiffness[:, None, None] * normal
        if friction:
            self.stiffness = -(along + values.tangential_stiffness)
            self.compliance: Array = np.asarray(np.linalg.inv(self.stiffness), dtype=np.float64)
        else:
            self.stiffness = -along
            self.compliance = np.asarray(-normal / values.normal_stiffness[:, None, None])

    def project(self, vectors: Array) -> Array:
        """Return the components of displacements that deform the springs."""
        if self._friction:
            return vectors
        return np.sum(vectors * self._normal, axis=1)[:, None] * self._normal

    def remove_round_off(self, tangent: Array, values: PointValues) -> Array:
        """Return the tangent of the law without round-off in its normal rows.

        The iteration divides it by c/K, and large displacements give friction a normal part.
        """
        normal = values.normal
        closed = np.where(values.normal_traction < 0, values.normal_stiffness, 0.0)
        row = -closed[:, None] * normal - np.einsum("qi,qij->qj", normal, tangent)
        return tangent + normal[:, :, None] * row[:, None, :]

    def trial_traction(self, values: PointValues) -> tuple[Array, Array]:
        """Compute the trial traction, and its excess over the traction of the law.

        The excess is exactly zero at sticking points, without round-off.

        Returns:
            Both (n_points, gdim) (stress).
        """
        normal = values.normal_stiffness * values.gap - values.multiplier
        sticking = values.old_traction - _multiply(values.tangential_stiffness, values.increment)
        normal_excess = np.where(values.normal_traction < 0, 0.0, normal)
        sticks = (values.friction_bound > 0) & ~values.is_slipping
        slip_excess = np.where(sticks[:, None], 0.0, values.tangential(sticking - values.traction))
        n = values.normal
        return normal[:, None] * n + sticking, normal_excess[:, None] * n + slip_excess


def _multiply(blocks: Array, vectors: Array) -> Array:
    return np.asarray(np.einsum("qij,qj->qi", blocks, vectors))
