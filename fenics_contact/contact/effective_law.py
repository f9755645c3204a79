"""The law evaluated at the points: the law of the contact, or a modification of it by a solver."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
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
        support: Stiffness of springs in addition to the law, (n_points, gdim, gdim)
            (stress/length), or None.
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
        self.support: Array | None = None
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
        traction = self._effective_law.evaluate_traction()
        if self.support is None:
            return traction
        return np.asarray(traction - np.einsum("qij,qj->qi", self.support, self._increment()))

    def tangent(self) -> PointTangent:
        """Return the derivatives of `traction` at the present ``u``. Collective."""
        self._kinematics.update()
        tangent = self._kinematics.tangent(self._effective_law)
        if self.support is None:
            return tangent
        by_shift = None if tangent.by_shift is None else tangent.by_shift + self.support
        return replace(tangent, by_jump=tangent.by_jump - self.support, by_shift=by_shift)

    def potential(self) -> Array:
        """Return the energy per area at the present ``u``, (n_points,) (stress·length). Collective.

        Raises a ValueError if the law has no potential.
        """
        self._kinematics.update()
        potential = self._effective_law.evaluate_potential()
        if self.support is None:
            return potential
        increment = self._increment()
        energy = np.einsum("qij,qi,qj->q", self.support, increment, increment) / 2
        return np.asarray(potential + energy)

    def _increment(self) -> Array:
        """Return the jump of the last update since the last commit, (n_points, gdim) (length)."""
        return self._kinematics.relative_jump() - self._kinematics.committed_jump

    def fix_friction_bound(self, bound: Array, support: Array | None = None) -> None:
        """Use a given friction bound, unless the law has a potential. Collective.

        Args:
            bound: Friction bound, (n_points,) (stress).
            support: Stiffness of springs in addition to the law, against the jump since the last
                commit, (n_points, gdim, gdim) (stress/length).
        """
        if self.has_potential:
            return
        self.support = support
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
        self._effective_law, self.support = self.own, None

    def restrict_to(self, points: Mask | None) -> None:
        """Restrict the law to some of the points, as `Contact.restrict_to` does. Collective."""
        self._active.x.array[: self._quadrature.n_points] = 1.0 if points is None else points
        self._active.x.scatter_forward()
