"""The law that acts at the points of Γc: a contact's own, or what stands in for it for a while."""

from __future__ import annotations

from dolfinx import fem

from fenics_contact.contact.contact_kinematics import ContactKinematics, ContactParts
from fenics_contact.contact.point_law import PointLaw, PointTangent
from fenics_contact.types import Array, Mask

__all__ = ["EffectiveLaw"]


class EffectiveLaw:
    """A law at the points, where they are now; results of the contact stay as they are.

    The constructor is collective, and compiles what evaluates all of the law.

    Attributes:
        own: The law itself, at numbers at the points.
        in_form: The same as expressions on Γc.
        has_potential: Whether its tractions follow from a potential, and the tangent is symmetric.
    """

    def __init__(self, parts: ContactParts, opposite: ContactKinematics) -> None:
        law, quadrature = parts.law, parts.quadrature
        self._law, self._opposite, self._quadrature = law, opposite, quadrature
        self._within = fem.Function(quadrature.space(), name="within")
        self._within.x.array[:] = 1.0
        self.in_form, self.own = opposite.laws(self._within)
        self.own.prepare()
        self._effective_law = self.own
        self._fixed: tuple[PointLaw, fem.Function] | None = None  # and the friction bound in it
        # Tangent planes that turn with u leave friction without a potential.
        self._turns = opposite.follows or (opposite.is_finite and law.has_tangential)
        self.has_potential = law.has_potential and not self._turns

    @property
    def can_fix_friction_bound(self) -> bool:
        """Whether there is a potential, at least under a given friction bound."""
        return not self._turns and self._law.with_given_friction_bound().has_potential

    def traction(self) -> Array:
        """r_n n + τ at the present ``u``, (n_points, gdim) (stress). Collective."""
        self._opposite.update()
        return self._effective_law.evaluate_traction()

    def tangent(self) -> PointTangent:
        """Derivatives of `traction` at the present ``u``. Collective."""
        self._opposite.update()
        return self._opposite.tangent(self._effective_law)

    def potential(self) -> Array:
        """Energy per area at the present ``u``, (n_points,) (stress times length). Collective.

        Raises:
            ValueError: The law has none.
        """
        self._opposite.update()
        return self._effective_law.evaluate_potential()

    def fix_friction_bound(self, bound: Array) -> None:
        """Let the law act with a given friction bound, if it has no potential. Collective.

        Args:
            bound: ≥ 0, shape (n_points,) (stress).
        """
        if self.has_potential:
            return
        if self._fixed is None:
            given = fem.Function(self._quadrature.space(), name="friction_bound")
            parameters = {**self.own.geometry.parameters, "friction_bound": given}
            law = self._law.with_given_friction_bound()
            self._fixed = self.own.with_law(law, parameters), given
        self._effective_law, given = self._fixed
        given.x.array[: self._quadrature.n_points] = bound
        given.x.scatter_forward()

    def release_friction_bound(self) -> None:
        """Let the law itself act again."""
        self._effective_law = self.own

    def restrict_to(self, points: Mask | None) -> None:
        """See `Contact.restrict_to`. Collective."""
        self._within.x.array[: self._quadrature.n_points] = 1.0 if points is None else points
        self._within.x.scatter_forward()
