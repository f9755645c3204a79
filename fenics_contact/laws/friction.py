"""Friction laws of Coulomb and Tresca, and their common base class."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from numbers import Integral
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
from fenics_contact.laws.return_maps import (
    norm,
    return_to_cone,
    return_to_polygon,
    return_to_segment,
)
from fenics_contact.laws.stiffness import RelativeStiffness
from fenics_contact.types import Expr, Values

__all__ = ["Coulomb", "FrictionLaw", "Tresca", "perpendicular"]


class FrictionLaw(Law):
    """Base class of friction laws: the yield surface in the tangent plane, and the return map (7).

    The size of the yield surface is `friction_bound`, which a subclass may override. In the plane
    it is |τ| ≤ bound. In space it is the circular cone |τ| ≤ bound; with ``modes``, the regular
    polygon around that circle; with ``transverse_friction``, the cone or polygon stretched across
    ``direction`` by r = μ₂/μ₁. In σ = B⁻¹τ with B = diag(1, r) it is not stretched, and with
    K_t = k_t B² the closest point in the metric of K_t is the closest point in σ.
    """

    friction: Any
    k_t: Any
    modes: int | None = None
    transverse_friction: Any = None
    direction: Any = None
    has_friction = True
    has_potential = False  # as the bound depends on the pressure

    def __post_init__(self) -> None:
        """Check the number of the polygon's sides, and that a direction is given where needed.

        Raises:
            ValueError: There are fewer than three sides, or the direction is missing or unused.
        """
        if self.modes is not None and not (isinstance(self.modes, Integral) and self.modes >= 3):
            raise ValueError(
                f"modes is {self.modes!r}; it must be an integer, at least 3, the number of sides "
                "of the polygonal cone; omit it for the circular cone"
            )
        if self.transverse_friction is not None and self.direction is None:
            raise ValueError(
                f"transverse_friction is {self.transverse_friction!r}, but direction is missing; "
                "give the first principal direction of friction, direction=(x, y, z)"
            )
        if self.direction is not None and self.modes is None and self.transverse_friction is None:
            raise ValueError(
                f"direction is {self.direction!r}, but the circular cone has none; give modes or "
                "transverse_friction too, or omit it"
            )

    @property
    def positive(self) -> frozenset[str]:
        """Names of the parameters that must be greater than zero.

        With ``transverse_friction`` both friction coefficients belong to them.
        """
        axes = (
            {"friction", "transverse_friction"} if self.transverse_friction is not None else set()
        )
        return super().positive | axes

    def parameters(self) -> dict[str, Any]:
        """Return the parameters by name, without ``modes`` and without those that are not given."""
        optional = ("transverse_friction", "direction")
        given = {n: v for n, v in vars(self).items() if not (v is None and n in optional)}
        given.pop("modes", None)
        return given

    def with_given_friction_bound(self) -> Law:
        """Return this law with a friction bound given by a parameter "friction_bound" (stress)."""
        return self if self.has_potential else _GivenBoundLaw(self)

    def check_dimension(self, gdim: int) -> None:
        """Check that ``modes`` and ``transverse_friction`` are given in space only.

        Raises:
            ValueError: One of them is given in two dimensions.
        """
        for name in ("modes", "transverse_friction"):
            value = getattr(self, name)
            if gdim == 2 and value is not None:
                raise ValueError(
                    f"{name} is {value!r} on a mesh in two dimensions, where friction has the two "
                    "slip modes ±; omit it"
                )

    def n_modes(self, gdim: int) -> int:
        """Return the number of slip modes: 2 in the plane [29], in space 1 or the polygon's sides.

        In the plane they are the two directions of slip.
        """
        return 2 if gdim == 2 else self.modes or 1

    def friction_bound(
        self, kinematics: PointKinematics, pressure: Expr, parameters: Values
    ) -> Expr:
        """Return the friction bound μ p (stress)."""
        return parameters["friction"] * pressure

    def circumradius(self, parameters: Values) -> Expr | None:
        """Return the largest |τ| on the yield surface of friction bound 1.

        It is the distance of the polygon's vertices along the larger half-axis; None if a subclass
        defines its own yield functions.
        """
        if type(self).yield_functions is not FrictionLaw.yield_functions:
            return None
        radius = ufl.as_ufl(1.0 if self.modes is None else 1 / math.cos(math.pi / self.modes))
        if self.transverse_friction is None:
            return radius
        ratio = parameters["transverse_friction"] / parameters["friction"]
        return radius * ufl.max_value(1.0, ratio)

    def _frame(self, normal: Expr, parameters: Values) -> tuple[Expr, Expr]:
        """Return orthonormal tangent vectors, the first along the projected direction.

        Without ``direction`` the x axis is projected, or the y axis if the normal is nearly along
        x.
        """
        if self.direction is None:
            x = ufl.conditional(ufl.lt(abs(normal[0]), 0.9), 1.0, 0.0)
            direction = ufl.as_vector([x, 1 - x, 0.0])
        else:
            direction = parameters["direction"]
        first = direction - ufl.dot(direction, normal) * normal
        first = first / ufl.sqrt(ufl.dot(first, first))
        return first, ufl.cross(normal, first)

    def _sides(self, normal: Expr, parameters: Values) -> list[tuple[Expr, Expr]]:
        """Return the outward normal and tangent of each side; the first normal is ``direction``."""
        assert self.modes is not None
        first, second = self._frame(normal, parameters)
        sides = []
        for j in range(self.modes):
            c, s = (f(2 * math.pi * j / self.modes) for f in (math.cos, math.sin))
            sides.append((c * first + s * second, -s * first + c * second))
        return sides

    def _stretch(self, vector: Expr, power: int, normal: Expr, parameters: Values) -> Expr:
        """Return B^power times a tangential vector."""
        if self.transverse_friction is None:
            return vector
        first, second = self._frame(normal, parameters)
        ratio = parameters["transverse_friction"] / parameters["friction"]
        return ufl.dot(vector, first) * first + ratio**power * ufl.dot(vector, second) * second

    def tangential_stiffness(self, kinematics: PointKinematics, parameters: Values) -> Expr:
        """Return K_t = k_t B² of a sticking point (stress/length), shape (gdim, gdim)."""
        if self.transverse_friction is None:
            return super().tangential_stiffness(kinematics, parameters)
        first, second = self._frame(kinematics.normal, parameters)
        ratio = parameters["transverse_friction"] / parameters["friction"]
        return parameters["k_t"] * (ufl.outer(first, first) + ratio**2 * ufl.outer(second, second))

    def elastic_displacement(
        self, kinematics: PointKinematics, traction: Expr, parameters: Values
    ) -> Expr:
        """Return the elastic displacement K_t⁻¹ τ = B⁻² τ/k_t (length), shape (gdim,)."""
        return self._stretch(traction, -2, kinematics.normal, parameters) / parameters["k_t"]

    def yield_functions(
        self, kinematics: PointKinematics, traction: Expr, bound: Expr, parameters: Values
    ) -> tuple[Expr, ...]:
        """Return the yield functions of the slip modes (stress).

        They are ±τ - bound in the plane [29], |σ| - bound on the circular cone and σ·a_j - bound
        on a polygonal one, with the outward normals a_j of its sides.
        """
        n = kinematics.normal
        if len(n) == 2:
            along = ufl.dot(traction, perpendicular(n))
            return along - bound, -along - bound
        sigma = self._stretch(traction, -1, n, parameters)
        if self.modes is None:
            return (norm(sigma) - bound,)
        return tuple(ufl.dot(sigma, a) - bound for a, _ in self._sides(n, parameters))

    def _return_in_sigma(
        self, kinematics: PointKinematics, bound: Expr, parameters: Values
    ) -> tuple[Expr, Expr, tuple[Expr, ...]]:
        """Return σ*, σ and Δβ of each mode by the return map in σ, eq. (7)."""
        n, k_t = kinematics.normal, parameters["k_t"]
        trial = self._stretch(kinematics.traction, -1, n, parameters)
        trial = trial - k_t * self._stretch(kinematics.tangential_increment, 1, n, parameters)
        if len(n) == 2:
            sigma, excess = return_to_segment(trial, bound, perpendicular(n))
        elif self.modes is None:
            sigma, excess = return_to_cone(trial, bound)
        else:
            sigma, excess = return_to_polygon(trial, bound, self._sides(n, parameters))
        return trial, sigma, tuple(e / k_t for e in excess)

    def return_map(
        self, kinematics: PointKinematics, bound: Expr, parameters: Values
    ) -> tuple[Expr, tuple[Expr, ...]]:
        """Return τ at the end of the increment, shape (gdim,), and Δβ of each mode, eq. (7)."""
        _, sigma, slip = self._return_in_sigma(kinematics, bound, parameters)
        return self._stretch(sigma, 1, kinematics.normal, parameters), slip

    def sliding_potential(
        self, kinematics: PointKinematics, bound: Expr, parameters: Values
    ) -> Expr:
        """Return the potential (|σ*|² - |σ* - σ|²)/(2 k_t) of τ = -∂/∂Δu_t for a given bound."""
        trial, sigma, _ = self._return_in_sigma(kinematics, bound, parameters)
        return ufl.dot(sigma, trial - sigma / 2) / parameters["k_t"]


class _GivenBoundLaw(FrictionLaw):
    """A friction law with a friction bound given by the parameter "friction_bound"."""

    has_potential = True

    def __init__(self, law: FrictionLaw) -> None:
        self._law, self.friction, self.k_t = law, law.friction, law.k_t
        self.modes, self.direction = law.modes, law.direction
        self.transverse_friction = law.transverse_friction

    def contact_traction(self, kinematics: PointKinematics, parameters: Values) -> ContactTraction:
        """Return the tractions of the law, with τ returned to the given friction bound."""
        bound = parameters["friction_bound"]
        traction, slip = self._law.return_map(kinematics, bound, parameters)
        result = self._law.contact_traction(kinematics, parameters)
        return replace(result, traction=traction, friction_bound=bound, slip=slip)

    def potential(self, kinematics: PointKinematics, parameters: Values) -> Expr:
        """Return the energy per area of the normal tractions and of given friction."""
        normal = self._law.normal_potential(kinematics, parameters)
        bound = parameters["friction_bound"]
        return normal + self._law.sliding_potential(kinematics, bound, parameters)


def perpendicular(normal: Expr) -> Expr:
    """Return a unit normal rotated by a right angle, in two dimensions."""
    return ufl.as_vector([-normal[1], normal[0]])


@dataclass(frozen=True)
class Coulomb(FrictionLaw):
    """Unilateral contact with Coulomb friction, |τ| ≤ μ p, regularised by eq. (6) and (7).

    Args:
        friction: Friction coefficient μ ≥ 0: a number, constant or UFL expression over Γc.
        k_n: Normal stiffness (stress/length): a number, constant or UFL expression,
            `RelativeStiffness`, by default 10 E/h, or `NodalSprings`.
        k_t: Tangential stiffness (stress/length), given like k_n; by default 10 E/h.
        modes: Number of sides, at least 3, of a polygonal friction cone circumscribed about the
            circular one, in space only; by default the cone is circular.
        transverse_friction: Friction coefficient μ₂ > 0 across ``direction``, in space only;
            ``friction`` is then μ₁ > 0 along it: (τ₁/μ₁)² + (τ₂/μ₂)² ≤ p², with slip normal to
            this ellipse. The tangential stiffness is k_t along ``direction`` and k_t (μ₂/μ₁)²
            across it, for which the return map has a closed form.
        direction: First principal direction of anisotropic friction, or the normal of the
            polygon's first side: three numbers or UFL, projected onto the tangent plane.

    Raises:
        ValueError: ``modes`` is below 3, or ``direction`` is missing or unused.
    """

    friction: Any
    k_n: Any = RelativeStiffness()
    k_t: Any = RelativeStiffness()
    modes: int | None = None
    transverse_friction: Any = None
    direction: Any = None

    def contact_traction(self, kinematics: PointKinematics, parameters: Values) -> ContactTraction:
        """Return the tractions by eq. (6) and (7); where the gap is open, τ = 0 and Δβ = 0."""
        r_n = signorini(kinematics, parameters["k_n"])
        closed = ufl.lt(r_n, 0)
        bound = ufl.conditional(closed, self.friction_bound(kinematics, -r_n, parameters), 0)
        traction, slip = self.return_map(kinematics, bound, parameters)
        slip = tuple(ufl.conditional(closed, mode, 0) for mode in slip)
        return ContactTraction(r_n, traction, bound, slip)


@dataclass(frozen=True)
class Tresca(FrictionLaw):
    """Tresca friction |τ| ≤ μ p with a given pressure p (Duvaut and Lions) [43].

    Args:
        friction: Friction coefficient μ ≥ 0.
        pressure: Given pressure p ≥ 0 (stress) of the friction bound μ p.
        k_n: Normal stiffness (stress/length): a number, constant or UFL expression,
            `RelativeStiffness` or `NodalSprings`.
        k_t: Tangential stiffness (stress/length), given like k_n.
        unilateral: Whether the normal traction is that of unilateral contact. The friction bound
            then acts on all of Γc, also where the gap is open (the classical problem of given
            friction). If False, the normal traction on the body is -p everywhere, and k_n is not
            used.
        modes: Number of sides of a polygonal friction cone, as for `Coulomb`.
        transverse_friction: Friction coefficient across ``direction``, as for `Coulomb`.
        direction: First principal direction of friction, as for `Coulomb`.

    Raises:
        ValueError: ``modes`` is below 3, ``direction`` is missing or unused, or ``unilateral`` is
            no bool.
    """

    friction: Any
    pressure: Any
    k_n: Any = RelativeStiffness()
    k_t: Any = RelativeStiffness()
    unilateral: bool = True
    modes: int | None = None
    transverse_friction: Any = None
    direction: Any = None
    has_potential = True

    def __post_init__(self) -> None:
        """Check ``unilateral``, and the friction cone as for every friction law."""
        super().__post_init__()
        check_bool("unilateral of the Tresca", self.unilateral)

    @property
    def has_normal_stiffness(self) -> bool:
        """Whether r_n depends on the gap, which is the argument ``unilateral``."""
        return self.unilateral

    def parameters(self) -> dict[str, Any]:
        """Return the parameters by name; k_n is one of them only if ``unilateral``."""
        without = {"unilateral"} if self.unilateral else {"unilateral", "k_n"}
        return {n: v for n, v in super().parameters().items() if n not in without}

    def friction_bound(
        self, kinematics: PointKinematics, pressure: Expr, parameters: Values
    ) -> Expr:
        """Return the friction bound, μ times the given pressure (stress)."""
        return parameters["friction"] * parameters["pressure"]

    def contact_traction(self, kinematics: PointKinematics, parameters: Values) -> ContactTraction:
        """Return the tractions: r_n by eq. (6) or -p, and τ by eq. (7) with the bound μ p."""
        bound = self.friction_bound(kinematics, parameters["pressure"], parameters)
        traction, slip = self.return_map(kinematics, bound, parameters)
        r_n = -parameters["pressure"]
        if self.unilateral:
            r_n = signorini(kinematics, parameters["k_n"])
        return ContactTraction(r_n, traction, bound, slip)

    def potential(self, kinematics: PointKinematics, parameters: Values) -> Expr:
        """Return the energy per area of unilateral contact [19] and of given friction [43]."""
        bound = self.friction_bound(kinematics, parameters["pressure"], parameters)
        tangential = self.sliding_potential(kinematics, bound, parameters)
        if not self.unilateral:
            return tangential - parameters["pressure"] * kinematics.gap
        return tangential + signorini_potential(kinematics, parameters["k_n"])
