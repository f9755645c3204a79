"""Newton's method on displacements and tractions of the points at once, however stiff contact is.

A stiff law answers a step of Newton's method that is a little too long by tractions that are much
too large, and a line search takes the step back. Here tractions s at the points are unknowns beside
the displacements g there, and the law is asked about both, in terms of a moderate stiffness c:

    s = R(s + c (g - C s)),    C = K⁻¹,

in which R is its return map, of a trial traction, and K its stiffness, k_n and k_t. Solutions are
those of s = R(K g), whatever c is. With c = K this is Newton's method as usual; for K → ∞ it is the
primal-dual active set method (P. Alart and A. Curnier, Comput. Methods Appl. Mech. Engrg. 92, 1991;
S. Hüeber, G. Stadler and B. Wohlmuth, SIAM J. Sci. Comput. 30, 2008), whose c is at choice. With c
as stiff as the bulk, points change their status by what body and tractions say of one another. R is
had from the law as it is, at the displacement C (s + c (g - C s)) = g - (1 - c C) e, where e = g -
C s tells by how much s and g do not fit. Tractions are eliminated point by point, so that systems
to be solved have the unknowns that they always have.

What it does that Newton's method does not: a point that slipped and is led back sticks before it
slips the other way, in a range of c and not of k_t, which a step hardly ever meets.

Steps are whole, and go where the status of the points says, wherever they came from: one that is
found again leads to the same ones again, with any c. Half a step leads out of such a cycle.
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
# Where linear systems are solved by iteration: by how much the residual falls from step to step
# does not tell how well they need be, since an error of the displacement is one of the traction by
# K. One that takes long is far from where the iteration ends.
_ITERATED = {
    "snes_ksp_ew_rtol0": 1e-4,
    "snes_ksp_ew_rtolmax": 1e-4,
    "snes_max_linear_solve_fail": _OPTIONS["snes_max_it"],
}
# A step as large as an earlier one is that one again, and this share of it is made.
_DAMPED = 0.5


class PrimalDual(StandaloneMethod):
    """The method.

    Attributes:
        snes: Newton's method, prefix "primal_dual_" behind the problem's.
    """

    is_newton_solution = True

    def __init__(self, context: SolverContext) -> None:
        equations = self._equations = context.equations
        self.snes, own = context.snes("primal_dual_", _OPTIONS, with_own=_ITERATED)
        self._newton = _MixedNewton(equations, self.snes, own_solver=own)

    def check(self) -> None:
        """See `StandaloneMethod.check`: friction by springs, of a linear bulk."""
        if not self.suits:
            raise ValueError(
                "method is 'primal_dual', which needs friction with stiffness k_n and k_t, small "
                "displacements, a linear bulk, and obstacles without unknown motions; use another "
                "method"
            )

    @property
    def suits(self) -> bool:
        """See `StandaloneMethod.suits`."""
        full = self._equations.full
        rubs = any(contact.law.has_friction for contact in full.contacts)
        return rubs and full.bulk.linear and all(_suits(contact) for contact in full.contacts)

    def solve(self) -> tuple[int, int]:
        """See `Method.solve`."""
        self._newton.attach(consistent=True)
        try:
            return self._newton.solve()
        finally:
            for contact in self._equations.contacts:
                contact.states.forget()  # it was evaluated elsewhere


class _MixedNewton(SnesMethod):
    """Newton's method on displacements and tractions."""

    def __init__(self, equations: Equations, snes: PETSc.SNES, *, own_solver: bool) -> None:
        super().__init__(equations, snes, lambda: False, own_solver=own_solver)
        self._points: list[_Points] = []
        self._share = 1.0  # c, by the stiffness of the law
        self._sizes: list[float] = []  # of the steps so far, as residuals
        self._damping = 1.0  # share of the step that is being made

    def solve(self) -> tuple[int, int]:
        """See `Method.solve`."""
        self._points = []
        try:
            return super().solve()
        finally:
            self._points = []

    def _compute_residual(self, x: PETSc.Vec, f: PETSc.Vec) -> None:
        """What the next step takes away, into ``f``. Collective."""
        equations, system = self._equations, self._equations.system
        if not self._points:
            self._share, self._sizes, self._damping = (
                1.0 / max(equations.stiffness_ratio(), 1.0),
                [],
                1.0,
            )
            equations.set_state(x)
            self._points = [_Points(operator) for operator in system.operators]
        equations.residual(x, f)  # of the law as it is: that it vanishes ends the iteration
        for points in self._points:
            points.follow(self._share, self._damping)
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
        again = any(abs(size - before) <= FLAT * before for before in self._sizes)
        self._damping = _DAMPED if again else 1.0
        self._sizes.append(size)
        f.scale(self._damping)

    def _compute_jacobian(self, x: PETSc.Vec, J: PETSc.Mat) -> None:
        tangents = (p.operator.tangent(PointTangent(p.tangent)) for p in self._points)
        self._equations.assemble(J, tangents)


def _suits(contact: Contact) -> bool:
    law = contact.law
    springs = law.has_normal_stiffness and "k_n" in law.positive
    springs = springs and not (law.has_own_normal or law.has_tension)
    rubs = law.has_friction or not law.has_tangential
    return springs and rubs and not (contact.finite or contact.motions)


class _Points:
    """The points of a contact, and the tractions there.

    Attributes:
        operator: What their displacements and forces are by.
        traction: On the body at the end of the next step if the points stay where they are,
            (n_points, gdim) (stress).
        tangent: By how much it changes as they move, (n_points, gdim, gdim) (stress/length).
    """

    def __init__(self, operator: ContactOperator) -> None:
        """Begin at the present state with what was borne at the last commit. Collective."""
        self.operator, self._share = operator, 1.0
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

    def follow(self, share: float, damping: float) -> None:
        """Let the tractions make the step that the displacement has made. Collective.

        Then the law is evaluated at the displacement that both of them tell.

        Args:
            share: c, by the stiffness of the law.
            damping: Share of the step that was made.
        """
        self._share = share
        contact, springs = self._contact, self._springs
        jump = contact.contact_kinematics.present_jump()
        moved = springs.felt(jump - self._jump)
        answer = _times(self.tangent, moved) - damping * self._correction
        self._misfit = self._misfit + moved - _times(springs.compliance, answer)
        self._jump = jump
        with contact.contact_kinematics.displaced((self._share - 1.0) * self._misfit):
            contact.evaluate()
            tangent = contact.effective_law.tangent().by_jump
        self._values = contact.values
        self.tangent = springs.exact(tangent, self._values)

    def linearise(self, *, everywhere: bool) -> None:
        """Set `traction` and `tangent` by what the law said.

        Args:
            everywhere: Take all points for closed and sticking: too few of them are to hold the
                body.
        """
        springs, values, share = self._springs, self._values, self._share
        trial, beyond = springs.trial(values)
        if everywhere:
            paired = values.paired > 0
            beyond[paired] = 0.0
            self.tangent = np.where(paired[:, None, None], springs.stiffness, self.tangent)
        stretched = share * _times(springs.stiffness, self._misfit)
        matrix = np.eye(self.tangent.shape[1])
        matrix = matrix + (share - 1.0) * self.tangent @ springs.compliance
        correction = np.linalg.solve(matrix, (beyond - stretched)[:, :, None])[:, :, 0]
        self._correction = np.asarray(correction, dtype=np.float64)
        self.tangent = np.asarray(share * np.linalg.solve(matrix, self.tangent), dtype=np.float64)
        self.traction = trial - stretched - self._correction


class _Springs:
    """The springs of a law, which its points are closed and stick by.

    Attributes:
        stiffness: Derivative of the traction by the displacement, (n_points, gdim, gdim)
            (stress/length); negative.
        compliance: Its inverse, across the normal none without friction (length/stress).
    """

    def __init__(self, values: PointValues, *, friction: bool) -> None:
        """Take them from values at the points; they do not change with the state."""
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

    def felt(self, vectors: Array) -> Array:
        """What of displacements they answer."""
        if self._friction:
            return vectors
        return np.sum(vectors * self._normal, axis=1)[:, None] * self._normal

    def exact(self, tangent: Array, values: PointValues) -> Array:
        """The tangent of the law without the round-off in its normal rows.

        The iteration divides by c/K. Friction has a normal part by as much as displacements are
        larger than those of the springs.
        """
        normal = values.normal
        closed = np.where(values.normal_traction < 0, values.normal_stiffness, 0.0)
        row = -closed[:, None] * normal - np.einsum("qi,qij->qj", normal, tangent)
        return tangent + normal[:, :, None] * row[:, None, :]

    def trial(self, values: PointValues) -> tuple[Array, Array]:
        """The traction if all points were closed and stuck, and what the law does not bear of it.

        The latter is zero where they are, and no difference there, for the reason that `exact` is
        for.

        Returns:
            Both (n_points, gdim) (stress).
        """
        normal = values.normal_stiffness * values.gap - values.multiplier
        stuck = values.old_traction - _times(values.tangential_stiffness, values.increment)
        lifted = np.where(values.normal_traction < 0, 0.0, normal)
        sticks = (values.friction_bound > 0) & ~values.slips
        slid = np.where(sticks[:, None], 0.0, values.tangential(stuck - values.traction))
        n = values.normal
        return normal[:, None] * n + stuck, lifted[:, None] * n + slid


def _times(blocks: Array, vectors: Array) -> Array:
    return np.asarray(np.einsum("qij,qj->qi", blocks, vectors))
