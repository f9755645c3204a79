"""The law evaluated at the points: the law of the contact, or a modification of it by a solver."""

from __future__ import annotations

from dolfinx import fem

from fenics_contact.contact.contact_kinematics import ContactKinematics, ContactParts
from fenics_contact.contact.point_law import PointLaw, PointTangent
from fenics_contact.types import Array, Mask

__all__ = ["EffectiveLaw"]


class EffectiveLaw:
    """The law of a contact, possibly with a fixed friction bound or restricted to some points.

    The constructor is collective, and compiles the law. Results use the contact's own law.

    Attributes:
        own: The law of the contact, evaluated at the points.
        in_form: The law of the contact as expressions on Γc.
        has_potential: Whether its tractions derive from a potential (symmetric tangent).
    """

    def __init__(self, parts: ContactParts, kinematics: ContactKinematics) -> None:
        law, quadrature = parts.law, parts.quadrature
        self._law, self._kinematics, self._quadrature = law, kinematics, quadrature
        self._active = fem.Function(quadrature.space(), name="within")
        self._active.x.array[:] = 1.0
        self.in_form, self.own = kinematics.laws(self._active)
        self.own.prepare()
        self._effective_law = self.own
        self._fixed_law: tuple[PointLaw, fem.Function] | None = None  # with its friction bound
        # Friction has no potential if the tangent planes rotate with u.
        self._is_rotating = kinematics.pairs_follow_bodies or (
            kinematics.is_finite and law.has_tangential
        )
        self.has_potential = law.has_potential and not self._is_rotating

    @property
    def can_fix_friction_bound(self) -> bool:
        """Whether the law has a potential, at least with a given friction bound."""
        return not self._is_rotating and self._law.with_given_friction_bound().has_potential

    def traction(self) -> Array:
        """Return r_n n + τ at the present ``u``, (n_points, gdim) (stress). Collective."""
        self._kinematics.update()
        return self._effective_law.evaluate_traction()

    def tangent(self) -> PointTangent:
        """Return the derivatives of `traction` at the present ``u``. Collective."""
        self._kinematics.update()
        return self._kinematics.tangent(self._effective_law)

    def potential(self) -> Array:
        """Return the energy per area at the present ``u``, (n_points,) (stress·length). Collective.

        Raises a ValueError if the law has no potential.
        """
        self._kinematics.update()
        return self._effective_law.evaluate_potential()

    def fix_friction_bound(self, bound: Array) -> None:
        """Use a friction bound (n_points,) (stress), unless the law has a potential. Collective."""
        if self.has_potential:
            return
        if self._fixed_law is None:
            bound_field = fem.Function(self._quadrature.space(), name="friction_bound")
            parameters = {**self.own.geometry.parameters, "friction_bound": bound_field}
            law = self._law.with_given_friction_bound()
            self._fixed_law = self.own.with_law(law, parameters), bound_field
        self._effective_law, bound_field = self._fixed_law
        bound_field.x.array[: self._quadrature.n_points] = bound
        bound_field.x.scatter_forward()

    def release_friction_bound(self) -> None:
        """Evaluate the law of the contact again."""
        self._effective_law = self.own

    def restrict_to(self, points: Mask | None) -> None:
        """Restrict the law to some of the points, as `Contact.restrict_to` does. Collective."""
        self._active.x.array[: self._quadrature.n_points] = 1.0 if points is None else points
        self._active.x.scatter_forward()
