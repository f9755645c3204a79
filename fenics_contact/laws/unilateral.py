"""Frictionless unilateral contact, and elastic foundations."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real
from typing import Any

import ufl

from fenics_contact.arguments import check_bool
from fenics_contact.laws.base import (
    ContactTraction,
    Law,
    PointKinematics,
    signorini,
    signorini_potential,
)
from fenics_contact.laws.stiffness import RelativeStiffness
from fenics_contact.types import Expr, Values

__all__ = ["Foundation", "Frictionless"]


@dataclass(frozen=True)
class Frictionless(Law):
    """Frictionless unilateral contact, eq. (4) and (6).

    Args:
        k_n: Normal stiffness (stress/length): a number, constant or UFL expression,
            `RelativeStiffness`, or `NodalSprings`.
    """

    k_n: Any = RelativeStiffness()

    def contact_traction(self, kinematics: PointKinematics, parameters: Values) -> ContactTraction:
        """Return r_n = -k_n δ₋ by eq. (6)."""
        return ContactTraction(signorini(kinematics, parameters["k_n"]))


@dataclass(frozen=True)
class Foundation(Law):
    """An elastic foundation or tie: r_n = -k_n (u_n - s) and τ = -k_t u_t.

    The stiffness is that of a physical layer between body and obstacle, and zero where there is
    none. ``Foundation(k, k)`` is a *tie*: it bonds the body to the obstacle, or two bodies with
    non-matching meshes to each other. Use it with ``Contact(gap=0)``, or the initial gaps between
    facets are pulled shut. With `RelativeStiffness(10)` the tie opens about as much as a tenth of a
    cell deforms.

    Args:
        k_n: Normal stiffness (stress/length), ≥ 0: a number, constant or UFL expression,
            `RelativeStiffness` or `NodalSprings`.
        k_t: Tangential stiffness (stress/length), ≥ 0, given like k_n; zero by default.
        tension: Whether the foundation is bonded to the body and bears tension. If False, it acts
            only where the gap is closed; with k_t there is no potential then, because τ jumps
            where the gap closes.

    Raises:
        ValueError: ``tension`` is no bool.
    """

    k_n: Any
    k_t: Any = 0.0
    tension: bool = True
    is_physical = True
    positive = frozenset[str]()  # both stiffnesses may vanish

    def __post_init__(self) -> None:
        """Check ``tension``."""
        check_bool("tension of the Foundation", self.tension)

    @property
    def has_tangential(self) -> bool:
        """Whether the law has tangential tractions: if k_t is not the number 0."""
        return not (isinstance(self.k_t, Real) and self.k_t == 0)

    @property
    def has_potential(self) -> bool:
        """Whether the tractions derive from a potential: not with k_t and without tension."""
        return self.tension or not self.has_tangential

    @property
    def has_tension(self) -> bool:
        """Whether r_n is tensile where the gap is open, which is the argument ``tension``."""
        return self.tension

    def parameters(self) -> dict[str, Any]:
        """Return k_n, and k_t if there are tangential tractions, by name."""
        return {"k_n": self.k_n} | ({"k_t": self.k_t} if self.has_tangential else {})

    def contact_traction(self, kinematics: PointKinematics, parameters: Values) -> ContactTraction:
        """Return r_n = -k_n (u_n - s) and τ = -k_t u_t; without tension only if closed."""
        k_n, gap = parameters["k_n"], kinematics.gap
        r_n = k_n * gap if self.tension else signorini(kinematics, k_n)
        if not self.has_tangential:
            return ContactTraction(r_n)
        k_t = parameters["k_t"]
        if not self.tension:
            k_t = ufl.conditional(ufl.lt(gap, 0), k_t, 0)
        return ContactTraction(r_n, -k_t * kinematics.tangential_displacement)

    def stored(
        self, kinematics: PointKinematics, response: ContactTraction, parameters: Values
    ) -> Expr:
        """Return the elastic energy per area, -r_n (u_n - s)/2 - τ·u_t/2."""
        closing = -kinematics.gap
        stored = -response.normal_traction * closing / 2
        if response.traction is not None:
            stored -= ufl.dot(response.traction, kinematics.tangential_displacement) / 2
        return stored

    def potential(self, kinematics: PointKinematics, parameters: Values) -> Expr:
        """Return ½ k_n (u_n - s)² + ½ k_t |u_t|², or without tension ½ k_n ⟨u_n - s⟩₊² [19].

        Raises:
            ValueError: The law has k_t and no tension, and therefore no potential.
        """
        if not self.has_potential:
            raise ValueError(
                "Foundation has no potential with k_t and without tension, because τ jumps where "
                "the gap closes; set k_t=0 or tension=True"
            )
        if not self.tension:
            return signorini_potential(kinematics, parameters["k_n"])
        density = parameters["k_n"] / 2 * kinematics.gap**2
        if self.has_tangential:
            u_t = kinematics.tangential_displacement
            density += parameters["k_t"] / 2 * ufl.dot(u_t, u_t)
        return density
