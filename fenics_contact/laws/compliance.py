"""Normal compliance of a rough surface by a power law, with friction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import ufl

from fenics_contact.arguments import is_number
from fenics_contact.laws.base import ContactTraction, PointKinematics
from fenics_contact.laws.friction import FrictionLaw
from fenics_contact.laws.return_maps import positive_part
from fenics_contact.laws.stiffness import RelativeStiffness
from fenics_contact.types import Expr, Values

__all__ = ["NormalCompliance"]


@dataclass(frozen=True)
class NormalCompliance(FrictionLaw):
    """Normal compliance p = p₀ (δ₋/h)^m of rough surfaces, with Coulomb friction |τ| ≤ μ p.

    δ₋ is the approach of the surfaces from the first contact of their asperities (J. T. Oden and
    J. A. C. Martins, Comput. Methods Appl. Mech. Engrg. 52, 1985, who found 2 ≤ m ≤ 3.33 for
    metals). It is a physical law, not a penalty, and therefore not for ``enforcement="augmented"``.
    The stiffness vanishes at first contact: with m near 3 a body that only contact constrains takes
    some ten times as many iterations in the first increment as with m = 2.

    Args:
        friction: Friction coefficient μ ≥ 0: a number, constant or UFL expression over Γc.
        pressure: Pressure p₀ > 0 at the approach ``approach`` (stress).
        approach: Reference approach h > 0 (length).
        exponent: Exponent m ≥ 1: below 1 the stiffness would be infinite at first contact.
        k_t: Tangential stiffness (stress/length), `RelativeStiffness` or `NodalSprings`.
        modes: Number of sides of a polygonal friction cone, as for `Coulomb`.
        transverse_friction: Friction coefficient across ``direction``, as for `Coulomb`.
        direction: First principal direction of friction, as for `Coulomb`.

    Raises:
        ValueError: ``exponent`` is a number below 1, ``modes`` is below 3, or ``direction`` is
            missing or unused.
    """

    friction: Any
    pressure: Any
    approach: Any
    exponent: Any = 2.0
    k_t: Any = RelativeStiffness()
    modes: int | None = None
    transverse_friction: Any = None
    direction: Any = None

    def __post_init__(self) -> None:
        """Check the exponent, and the friction cone as for every friction law."""
        super().__post_init__()
        if is_number(self.exponent) and not self.exponent >= 1:
            raise ValueError(
                f"exponent of the NormalCompliance is {self.exponent!r}; it must be at least 1, or "
                "the stiffness is infinite at first contact"
            )

    @property
    def positive(self) -> frozenset[str]:
        """Names of the parameters that must be greater than zero: all but friction."""
        return super().positive | {"pressure", "approach", "exponent"}

    def contact_traction(self, kinematics: PointKinematics, parameters: Values) -> ContactTraction:
        """Return r_n = -p₀ (δ₋/h)^m and τ by eq. (7) with the bound μ p."""
        penetration = positive_part(-kinematics.gap)
        h, m = parameters["approach"], parameters["exponent"]
        p = parameters["pressure"] * (penetration / h) ** m
        bound = self.friction_bound(kinematics, p, parameters)
        traction, slip = self.return_map(kinematics, bound, parameters)
        closed = ufl.gt(penetration, 0)
        slip = tuple(ufl.conditional(closed, mode, 0) for mode in slip)
        return ContactTraction(-p, traction, bound, slip)

    def normal_potential(self, kinematics: PointKinematics, parameters: Values) -> Expr:
        """Return p₀ h (δ₋/h)^(m+1)/(m+1), whose derivative with respect to the gap is r_n."""
        h, m = parameters["approach"], parameters["exponent"]
        penetration = positive_part(-kinematics.gap)
        return parameters["pressure"] * h * (penetration / h) ** (m + 1) / (m + 1)
