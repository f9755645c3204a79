"""Unilateral contact without friction, and elastic foundations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any

import ufl

from fenics_contact.laws.base import (
    ContactTraction,
    Law,
    PointKinematics,
    signorini,
    signorini_potential,
)
from fenics_contact.laws.stiffness import RelativeStiffness
from fenics_contact.types import Expr

__all__ = ["Foundation", "Frictionless"]


@dataclass(frozen=True)
class Frictionless(Law):
    """Unilateral contact without friction, eq. (6-20).

    Args to the constructor:
        k_n: Normal stiffness (stress/length): a number, constant or UFL expression,
            `RelativeStiffness`, or `NodalSprings`.
    """

    k_n: Any = RelativeStiffness()

    def contact_traction(
        self, kinematics: PointKinematics, parameters: Mapping[str, Expr]
    ) -> ContactTraction:
        """See `Law.contact_traction`."""
        return ContactTraction(*signorini(kinematics, parameters["k_n"]))


@dataclass(frozen=True)
class Foundation(Law):
    """An elastic foundation, bond or tie: r_n = -k_n (u_n - s) and τ = -k_t u_t, from the start.

    The stiffness is physical here, that of a layer between body and obstacle (paper, 2.1). It may
    be zero where there is none. ``Foundation(k, k)`` is a *tie*: it bonds the body to the obstacle,
    or two bodies to each other, whose meshes need not match. ``Contact(gap=0)`` with it, or gaps
    between facets are pulled shut. With `RelativeStiffness(10)` it opens as a tenth of a cell does.

    Args to the constructor:
        k_n: Normal stiffness (stress/length), zero or greater; see `Frictionless`.
        k_t: Tangential stiffness (stress/length), likewise; zero by default.
        tension: True: the foundation is bonded to the body, and pulls as it pushes. False: it acts
            where the gap is closed and nowhere else; with k_t there is no potential then, since τ
            jumps where the gap closes.
    """

    k_n: Any
    k_t: Any = 0.0
    tension: bool = True

    @property
    def has_tangential(self) -> bool:
        """See `Law.has_tangential`."""
        return not (isinstance(self.k_t, Real) and self.k_t == 0)

    @property
    def has_potential(self) -> bool:
        """See `Law.has_potential`."""
        return self.tension or not self.has_tangential

    @property
    def has_tension(self) -> bool:
        """See `Law.has_tension`."""
        return self.tension

    @property
    def is_physical(self) -> bool:
        """See `Law.is_physical`."""
        return True

    @property
    def positive(self) -> frozenset[str]:
        """See `Law.positive`: both may be zero, where there is no layer."""
        return frozenset()

    def parameters(self) -> dict[str, Any]:
        """See `Law.parameters`."""
        return {"k_n": self.k_n} | ({"k_t": self.k_t} if self.has_tangential else {})

    def contact_traction(
        self, kinematics: PointKinematics, parameters: Mapping[str, Expr]
    ) -> ContactTraction:
        """See `Law.contact_traction`."""
        r_n, opening, penetration = signorini(kinematics, parameters["k_n"])
        if self.tension:
            r_n = parameters["k_n"] * kinematics.gap
        if not self.has_tangential:
            return ContactTraction(r_n, opening, penetration)
        k_t = parameters["k_t"]
        if not self.tension:
            k_t = ufl.conditional(ufl.gt(penetration, 0), k_t, 0)
        traction = -k_t * kinematics.tangential_displacement
        return ContactTraction(r_n, opening, penetration, traction)

    def stored(
        self, kinematics: PointKinematics, response: ContactTraction, parameters: Mapping[str, Expr]
    ) -> Expr:
        """See `Law.stored`; by displacements, since k_t may be zero."""
        closing = -kinematics.gap
        stored = -response.normal_traction * closing / 2
        if response.traction is not None:
            stored -= ufl.dot(response.traction, kinematics.tangential_displacement) / 2
        return stored

    def potential(self, kinematics: PointKinematics, parameters: Mapping[str, Expr]) -> Expr:
        """½ k_n (u_n - s)² + ½ k_t |u_t|², or eq. (19) without tension."""
        if not self.has_potential:
            raise ValueError(
                "Foundation has no potential with k_t and without tension: τ jumps where the gap "
                "closes; set k_t=0 or tension=True where one is needed"
            )
        if not self.tension:
            return signorini_potential(kinematics, parameters["k_n"])
        density = parameters["k_n"] / 2 * kinematics.gap**2
        if self.has_tangential:
            u_t = kinematics.tangential_displacement
            density += parameters["k_t"] / 2 * ufl.dot(u_t, u_t)
        return density
