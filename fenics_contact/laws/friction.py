"""Friction: Coulomb's law and Tresca's, and what one's own has from them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from numbers import Integral
from typing import Any

import ufl

from fenics_contact.laws.base import (
    ContactTraction,
    Law,
    PointKinematics,
    signorini,
    signorini_potential,
)
from fenics_contact.laws.return_maps import (
    norm,
    return_to_cone,
    return_to_polygon,
    return_to_segment,
)
from fenics_contact.laws.stiffness import RelativeStiffness
from fenics_contact.types import Expr

__all__ = ["Coulomb", "FrictionLaw", "Tresca", "perpendicular"]


class FrictionLaw(Law):
    """What laws with friction share: the yield surface in the tangent plane, and slip.

    Its size is the `friction_bound`, which a subclass may replace; its shape is this:

    In the plane it is ±bound. In space it is the cone |τ| ≤ bound; with ``modes`` the regular
    polygon around that circle; with ``transverse_friction`` the cone (or polygon) is stretched
    across the direction by r = μ₂/μ₁. In σ = B⁻¹τ, B = diag(1, r), it is the unstretched one, and
    with K_t = k_t B² the closest point in the metric of K_t is the closest point in σ.
    """

    friction: Any
    k_t: Any
    modes: int | None = None
    transverse_friction: Any = None
    direction: Any = None

    def __post_init__(self) -> None:
        """Refuse a polygon of fewer than three sides, and a direction that is missing or unused.

        Raises:
            ValueError: It says what was given, and what is expected.
        """
        if self.modes is not None and not (isinstance(self.modes, Integral) and self.modes >= 3):
            raise ValueError(
                f"modes is {self.modes!r}; it must be a whole number, 3 or more: the sides of the "
                "polygon; leave it out for the cone"
            )
        if self.transverse_friction is not None and self.direction is None:
            raise ValueError(
                f"transverse_friction is {self.transverse_friction!r}, but direction is missing; "
                "give the direction that friction acts along, direction=(x, y, z)"
            )
        if self.direction is not None and self.modes is None and self.transverse_friction is None:
            raise ValueError(
                f"direction is {self.direction!r}, but the cone has none; give modes or "
                "transverse_friction with it, or leave it out"
            )

    @property
    def has_friction(self) -> bool:
        """See `Law.has_friction`."""
        return True

    @property
    def has_potential(self) -> bool:
        """See `Law.has_potential`: none where the limit follows the pressure."""
        return False

    @property
    def positive(self) -> frozenset[str]:
        """See `Law.positive`: the axes of an ellipse must not vanish."""
        axes = (
            {"friction", "transverse_friction"} if self.transverse_friction is not None else set()
        )
        return super().positive | axes

    def parameters(self) -> dict[str, Any]:
        """See `Law.parameters`: all but the number of sides, and what may be left out."""
        optional = ("transverse_friction", "direction")
        given = {n: v for n, v in vars(self).items() if not (v is None and n in optional)}
        given.pop("modes", None)
        return given

    def with_given_friction_bound(self) -> Law:
        """See `Law.with_given_friction_bound`."""
        return self if self.has_potential else _GivenBound(self)

    def check_dimension(self, gdim: int) -> None:
        """See `Law.check_dimension`."""
        for name in ("modes", "transverse_friction"):
            value = getattr(self, name)
            if gdim == 2 and value is not None:
                raise ValueError(
                    f"{name} is {value!r} on a mesh in two dimensions; friction along a line has "
                    "the two modes ± and no other: leave it out"
                )

    def n_modes(self, gdim: int) -> int:
        """Slip modes: ± in the plane (eq. 29), in space the one cone or the polygon's sides."""
        return 2 if gdim == 2 else self.modes or 1

    def friction_bound(
        self, kinematics: PointKinematics, pressure: Expr, parameters: Mapping[str, Expr]
    ) -> Expr:
        """See `Law.friction_bound`: μ p."""
        return parameters["friction"] * pressure

    def circumradius(self, parameters: Mapping[str, Expr]) -> Expr | None:
        """See `Law.circumradius`: of the polygon's vertices, and along the larger half-axis.

        A subclass with yield functions of its own has another surface.
        """
        if type(self).yield_functions is not FrictionLaw.yield_functions:
            return None
        radius = ufl.as_ufl(1.0 if self.modes is None else 1 / math.cos(math.pi / self.modes))
        if self.transverse_friction is None:
            return radius
        ratio = parameters["transverse_friction"] / parameters["friction"]
        return radius * ufl.max_value(1.0, ratio)

    def _frame(self, normal: Expr, parameters: Mapping[str, Expr]) -> tuple[Expr, Expr]:
        """Orthonormal vectors of the tangent plane, the first along the direction.

        Without a direction it is that of x, or of y where the normal is nearly along x.
        """
        if self.direction is None:
            x = ufl.conditional(ufl.lt(abs(normal[0]), 0.9), 1.0, 0.0)
            direction = ufl.as_vector([x, 1 - x, 0.0])
        else:
            direction = parameters["direction"]
        first = direction - ufl.dot(direction, normal) * normal
        first = first / ufl.sqrt(ufl.dot(first, first))
        return first, ufl.cross(normal, first)

    def _sides(self, normal: Expr, parameters: Mapping[str, Expr]) -> list[tuple[Expr, Expr]]:
        """Of each side of the polygon the outward normal, and the vector along it.

        The first side is across the direction.
        """
        assert self.modes is not None
        first, second = self._frame(normal, parameters)
        sides = []
        for j in range(self.modes):
            c, s = (f(2 * math.pi * j / self.modes) for f in (math.cos, math.sin))
            sides.append((c * first + s * second, -s * first + c * second))
        return sides

    def _stretched(
        self, vector: Expr, power: int, normal: Expr, parameters: Mapping[str, Expr]
    ) -> Expr:
        """B to a power, times a tangential vector."""
        if self.transverse_friction is None:
            return vector
        first, second = self._frame(normal, parameters)
        ratio = parameters["transverse_friction"] / parameters["friction"]
        return ufl.dot(vector, first) * first + ratio**power * ufl.dot(vector, second) * second

    def tangential_stiffness(
        self, kinematics: PointKinematics, parameters: Mapping[str, Expr]
    ) -> Expr:
        """See `Law.tangential_stiffness`: k_t B²."""
        if self.transverse_friction is None:
            return super().tangential_stiffness(kinematics, parameters)
        first, second = self._frame(kinematics.normal, parameters)
        ratio = parameters["transverse_friction"] / parameters["friction"]
        return parameters["k_t"] * (ufl.outer(first, first) + ratio**2 * ufl.outer(second, second))

    def elastic_displacement(
        self, kinematics: PointKinematics, traction: Expr, parameters: Mapping[str, Expr]
    ) -> Expr:
        """See `Law.elastic_displacement`: B⁻² τ/k_t."""
        return self._stretched(traction, -2, kinematics.normal, parameters) / parameters["k_t"]

    def yield_functions(
        self,
        kinematics: PointKinematics,
        traction: Expr,
        bound: Expr,
        parameters: Mapping[str, Expr],
    ) -> tuple[Expr, ...]:
        """See `Law.yield_functions`: eq. (29) in the plane, |σ| - bound or σ·a_j - bound."""
        n = kinematics.normal
        if len(n) == 2:
            along = ufl.dot(traction, perpendicular(n))
            return along - bound, -along - bound
        sigma = self._stretched(traction, -1, n, parameters)
        if self.modes is None:
            return (norm(sigma) - bound,)
        return tuple(ufl.dot(sigma, a) - bound for a, _ in self._sides(n, parameters))

    def _return(
        self, kinematics: PointKinematics, bound: Expr, parameters: Mapping[str, Expr]
    ) -> tuple[Expr, Expr, tuple[Expr, ...]]:
        """Return map of the increment in σ, eq. (41-45): σ*, σ and Δβ of each mode."""
        n, k_t = kinematics.normal, parameters["k_t"]
        trial = self._stretched(kinematics.traction, -1, n, parameters)
        trial = trial - k_t * self._stretched(kinematics.tangential_increment, 1, n, parameters)
        if len(n) == 2:
            sigma, excess = return_to_segment(trial, bound, perpendicular(n))
        elif self.modes is None:
            sigma, excess = return_to_cone(trial, bound)
        else:
            sigma, excess = return_to_polygon(trial, bound, self._sides(n, parameters))
        return trial, sigma, tuple(e / k_t for e in excess)

    def return_map(
        self, kinematics: PointKinematics, bound: Expr, parameters: Mapping[str, Expr]
    ) -> tuple[Expr, tuple[Expr, ...]]:
        """τ at the end of the increment, shape (gdim,), and Δβ of each mode, eq. (41-45)."""
        _, sigma, slip = self._return(kinematics, bound, parameters)
        return self._stretched(sigma, 1, kinematics.normal, parameters), slip

    def sliding_potential(
        self, kinematics: PointKinematics, bound: Expr, parameters: Mapping[str, Expr]
    ) -> Expr:
        """Minus its derivative by Δu_t is τ for a given bound: ½|σ*|²/k_t, linear beyond it.

        That is (|σ*|² - |σ* - σ|²)/(2 k_t), whose gradient by σ* is the closest point σ over k_t.
        """
        trial, sigma, _ = self._return(kinematics, bound, parameters)
        return ufl.dot(sigma, trial - sigma / 2) / parameters["k_t"]


class _GivenBound(FrictionLaw):
    """Another law with its friction bound given by the parameter "friction_bound"."""

    def __init__(self, law: FrictionLaw) -> None:
        self._law, self.friction, self.k_t = law, law.friction, law.k_t
        self.modes, self.direction = law.modes, law.direction
        self.transverse_friction = law.transverse_friction

    @property
    def has_potential(self) -> bool:
        """See `Law.has_potential`."""
        return True

    def contact_traction(
        self, kinematics: PointKinematics, parameters: Mapping[str, Expr]
    ) -> ContactTraction:
        """See `Law.contact_traction`."""
        bound = parameters["friction_bound"]
        traction, slip = self._law.return_map(kinematics, bound, parameters)
        found = self._law.contact_traction(kinematics, parameters)
        return replace(found, traction=traction, friction_bound=bound, slip=slip)

    def potential(self, kinematics: PointKinematics, parameters: Mapping[str, Expr]) -> Expr:
        """See `Law.potential`."""
        normal = self._law.normal_potential(kinematics, parameters)
        bound = parameters["friction_bound"]
        return normal + self._law.sliding_potential(kinematics, bound, parameters)


def perpendicular(normal: Expr) -> Expr:
    """A unit normal turned by a right angle, in two dimensions."""
    return ufl.as_vector([-normal[1], normal[0]])


@dataclass(frozen=True)
class Coulomb(FrictionLaw):
    """Unilateral contact with Coulomb friction, eq. (21-50).

    Args to the constructor:
        friction: Friction coefficient μ ≥ 0: a number, constant or UFL expression over Γc.
        k_n: Normal stiffness (stress/length); see `Frictionless`.
        k_t: Tangential stiffness (stress/length), likewise.
        modes: Sides of a polygonal cone around the circular one, 3 or more, in space only; by
            default the circular one.
        transverse_friction: Friction coefficient μ₂ > 0 across ``direction``, in space only;
            ``friction`` is then the one along it, and > 0 too: (τ₁/μ₁)² + (τ₂/μ₂)² ≤ p², with
            associated slip. The tangential stiffness is k_t along and k_t (μ₂/μ₁)² across: a
            metric of the regularisation, for which the return map has a closed form.
        direction: Of anisotropic friction, or that which the polygon's first side is across: three
            numbers or UFL, projected on the tangent plane.
    """

    friction: Any
    k_n: Any = RelativeStiffness()
    k_t: Any = RelativeStiffness()
    modes: int | None = None
    transverse_friction: Any = None
    direction: Any = None

    def contact_traction(
        self, kinematics: PointKinematics, parameters: Mapping[str, Expr]
    ) -> ContactTraction:
        """See `Law.contact_traction`. Where the gap is open τ = 0, and moving is not slipping."""
        r_n, opening, penetration = signorini(kinematics, parameters["k_n"])
        closed = ufl.lt(r_n, 0)
        bound = ufl.conditional(closed, self.friction_bound(kinematics, -r_n, parameters), 0)
        traction, slip = self.return_map(kinematics, bound, parameters)
        slip = tuple(ufl.conditional(closed, mode, 0) for mode in slip)
        return ContactTraction(r_n, opening, penetration, traction, bound, slip)


@dataclass(frozen=True)
class Tresca(FrictionLaw):
    """Friction whose limit μ p does not depend on the contact pressure (Duvaut-Lions, section 3).

    Args to the constructor:
        friction: Friction coefficient μ ≥ 0.
        pressure: The normal force per area p ≥ 0 (stress) that sets the limit.
        k_n: Normal stiffness (stress/length); see `Frictionless`.
        k_t: Tangential stiffness (stress/length).
        unilateral: True: the normal reaction is that of unilateral contact, and only the limit
            of friction is prescribed: it acts on all of Γc, whether a point touches or not (the
            classical problem of given friction). False: the normal traction on the body *is* -p,
            gap or not (eq. 43); k_n is not used.
        modes, transverse_friction, direction: See `Coulomb`.
    """

    friction: Any
    pressure: Any
    k_n: Any = RelativeStiffness()
    k_t: Any = RelativeStiffness()
    unilateral: bool = True
    modes: int | None = None
    transverse_friction: Any = None
    direction: Any = None

    @property
    def has_normal_stiffness(self) -> bool:
        """See `Law.has_normal_stiffness`."""
        return self.unilateral

    @property
    def has_potential(self) -> bool:
        """See `Law.has_potential`."""
        return True

    def parameters(self) -> dict[str, Any]:
        """See `Law.parameters`."""
        without = {"unilateral"} if self.unilateral else {"unilateral", "k_n"}
        return {n: v for n, v in super().parameters().items() if n not in without}

    def friction_bound(
        self, kinematics: PointKinematics, pressure: Expr, parameters: Mapping[str, Expr]
    ) -> Expr:
        """See `Law.friction_bound`: μ times the prescribed pressure, whatever the other is."""
        return parameters["friction"] * parameters["pressure"]

    def contact_traction(
        self, kinematics: PointKinematics, parameters: Mapping[str, Expr]
    ) -> ContactTraction:
        """See `Law.contact_traction`."""
        bound = self.friction_bound(kinematics, parameters["pressure"], parameters)
        traction, slip = self.return_map(kinematics, bound, parameters)
        k_n = parameters["k_n"] if self.unilateral else ufl.as_ufl(0)
        r_n, opening, penetration = signorini(kinematics, k_n)
        if not self.unilateral:
            r_n = -parameters["pressure"]
        return ContactTraction(r_n, opening, penetration, traction, bound, slip)

    def potential(self, kinematics: PointKinematics, parameters: Mapping[str, Expr]) -> Expr:
        """Eq. (19) and (43)."""
        bound = self.friction_bound(kinematics, parameters["pressure"], parameters)
        tangential = self.sliding_potential(kinematics, bound, parameters)
        if not self.unilateral:
            return tangential - parameters["pressure"] * kinematics.gap
        return tangential + signorini_potential(kinematics, parameters["k_n"])
