"""The law that acts at the points of Γc: a contact's own, or what stands in for it for a while."""

from __future__ import annotations

import ufl
from dolfinx import fem

from fenics_contact.contact.opposite import Opposite
from fenics_contact.contact.point_law import PointLaw, PointTangent
from fenics_contact.laws.base import Law
from fenics_contact.surface.surface import SurfaceQuadrature
from fenics_contact.types import Array, Mask

__all__ = ["ActingLaw"]


class ActingLaw:
    """A law at the points, where they are now; results of the contact stay as they are.

    Attributes:
        own: The law itself, at numbers at the points.
        in_form: The same as expressions on Γc.
        has_potential: Whether its tractions follow from a potential, and the tangent is symmetric.
    """

    def __init__(self, law: Law, opposite: Opposite, quadrature: SurfaceQuadrature) -> None:
        """Compile what evaluates all of it. Collective.

        Args:
            law: The law.
            opposite: What its points feel.
            quadrature: These.
        """
        self._law, self._opposite, self._quadrature = law, opposite, quadrature
        self._within = fem.Function(quadrature.space(), name="within")
        self._within.x.array[:] = 1.0
        self.in_form, self.own = opposite.laws(self._within)
        self.own.prepare()
        self._acting = self.own
        self._frozen: tuple[PointLaw, fem.Function] | None = None  # and the pressure in it
        # Tangent planes that turn with u leave friction without a potential.
        self._turns = opposite.follows or (opposite.is_finite and law.has_tangential)
        self.has_potential = law.has_potential and not self._turns

    @property
    def freezes(self) -> bool:
        """Whether there is a potential, at least under a given pressure."""
        return not self._turns and self._law.at_pressure(ufl.as_ufl(0.0)).has_potential

    def traction(self) -> Array:
        """r_n n + τ at the present ``u``, (n_points, gdim) (stress). Collective."""
        self._opposite.update()
        return self._acting.evaluate_traction()

    def tangent(self) -> PointTangent:
        """Derivatives of `traction` at the present ``u``. Collective."""
        self._opposite.update()
        return self._opposite.tangent(self._acting)

    def potential(self) -> Array:
        """Energy per area at the present ``u``, (n_points,) (stress times length). Collective.

        Raises:
            ValueError: The law has none.
        """
        self._opposite.update()
        return self._acting.evaluate_potential()

    def freeze(self, pressure: Array) -> None:
        """Let `Law.at_pressure` act. Collective.

        Args:
            pressure: ≥ 0, shape (n_points,) (stress).
        """
        if self.has_potential:
            return
        if self._frozen is None:
            given = fem.Function(self._quadrature.space(), name="pressure")
            parameters = {**self.own.seen.parameters, "pressure": given}
            law = self._law.at_pressure(given)
            self._frozen = self.own.with_law(law, parameters), given
        self._acting, given = self._frozen
        given.x.array[: self._quadrature.n_points] = pressure
        given.x.scatter_forward()

    def thaw(self) -> None:
        """Let the law itself act again."""
        self._acting = self.own

    def confine(self, points: Mask | None) -> None:
        """See `Contact.confine`. Collective."""
        self._within.x.array[: self._quadrature.n_points] = 1.0 if points is None else points
        self._within.x.scatter_forward()
