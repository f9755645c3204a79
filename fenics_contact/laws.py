"""Contact laws: pure UFL return maps and potentials. No mesh, no state.

A law maps the kinematics of a point of Γc (`Kinematics`) to the reactions there (`Response`). One
definition serves two and three dimensions and every support. Signs are the paper's: the traction on
the body is r_n n + τ, with n from the body to the support and r_n ≤ 0 (but for `Foundation`, which
may pull).

A law of one's own is a subclass of `Law`, or of `FrictionLaw` with friction, and a dataclass of its
parameters. It says `Law.response`; where r_n is not -k_n δ₋ of a parameter "k_n", also its
`normal_potential`, against which the verdict checks r_n; and the parameters that must not vanish,
`positive`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from numbers import Integral, Real
from typing import Any, TypeAlias

import ufl

__all__ = [
    "Coulomb",
    "Foundation",
    "FrictionLaw",
    "Frictionless",
    "Kinematics",
    "Law",
    "Response",
    "Scaled",
    "Springs",
    "Tresca",
]

Expr: TypeAlias = ufl.core.expr.Expr


@dataclass(frozen=True)
class Scaled:
    """A stiffness per area as a multiple of E/h, Young's modulus over the height of the cell there.

    E comes from the bulk form itself, h is the cell's height over its facet on Γc, so that the
    penetration is about 1/factor of the elastic displacement over the first layer of cells.

    Args to the constructor:
        factor: The multiple; by default that of the contact's ``accuracy``, or 10.
    """

    factor: float | None = None

    def __post_init__(self) -> None:
        """Refuse a factor that is no positive number."""
        if self.factor is None:
            return
        if not (isinstance(self.factor, Real) and 0.0 < self.factor < float("inf")):
            raise ValueError(f"factor is {self.factor!r}; it must be a number greater than zero")


@dataclass(frozen=True)
class Springs:
    """A stiffness as one spring for each node pair of Γc, the contact springs of section 4.

    At a vertex of Γc the stiffness per area is k over the area that the vertex stands for, the
    contact's weight included: the reactions of the vertex add up to k times its displacement,
    whatever the facets around it. Wants a surface with ``quadrature_scheme="vertex"``.

    Args to the constructor:
        k: Stiffness of one spring (force/length; per thickness in 2D without weight).
    """

    k: float

    def __post_init__(self) -> None:
        """Refuse a stiffness that is no positive number."""
        if not (isinstance(self.k, Real) and 0.0 < self.k < float("inf")):
            raise ValueError(
                f"k of the Springs is {self.k!r}; it must be a number greater than zero "
                "(force/length of one node pair)"
            )


@dataclass(frozen=True)
class Kinematics:
    """What a law sees at a point (UFL).

    Attributes:
        gap: Initial gap s (length), the motion of the support included.
        normal_displacement: u_n of eq. (2).
        normal: Unit normal n from body to support, shape (gdim,).
        tangential_displacement: u_t of eq. (21), relative to the support, shape (gdim,); None if
            the law gives no tangential traction.
        tangential_increment: Δu_t since the last commit, shape (gdim,); None without friction.
        traction: Tangential traction τ at the last commit, or the multiplier λ_t that replaces it,
            shape (gdim,); None without friction.
        multiplier: Pressure λ_n ≥ 0 that acts where the gap is closed and not penetrated; None
            under penalty enforcement, where there is none.
    """

    gap: Expr
    normal_displacement: Expr
    normal: Expr
    tangential_displacement: Expr | None = None
    tangential_increment: Expr | None = None
    traction: Expr | None = None
    multiplier: Expr | None = None


@dataclass(frozen=True)
class Response:
    """The reactions at a point (UFL).

    Attributes:
        normal_traction: r_n (stress).
        opening: δ₊ ≥ 0 (length), eq. (6).
        penetration: δ₋ ≥ 0 (length), eq. (6).
        traction: τ (stress), shape (gdim,); None if the law gives none.
        limit: μ p, the size of the yield surface (stress); None without friction.
        slip: Δβ ≥ 0 of each slip mode (length), eq. (44).
    """

    normal_traction: Expr
    opening: Expr
    penetration: Expr
    traction: Expr | None = None
    limit: Expr | None = None
    slip: tuple[Expr, ...] = ()


class Law:
    """A contact law. What a subclass does not say is as for unilateral contact without friction."""

    @property
    def has_tangential(self) -> bool:
        """Whether there are tangential tractions."""
        return self.has_friction

    @property
    def has_friction(self) -> bool:
        """Whether points slip, so that tangential state is needed."""
        return False

    @property
    def has_potential(self) -> bool:
        """Whether the reactions are the gradient of a potential (symmetric tangent)."""
        return True

    @property
    def has_normal_stiffness(self) -> bool:
        """Whether r_n answers the gap by k_n; False where the normal traction is prescribed."""
        return True

    @property
    def has_own_normal(self) -> bool:
        """Whether r_n follows from a `normal_potential` of the subclass, and not from k_n."""
        own = type(self).normal_potential is not Law.normal_potential
        return self.has_normal_stiffness and (own or "k_n" not in self.parameters())

    @property
    def has_tension(self) -> bool:
        """Whether r_n pulls where the gap is open: such points are never open."""
        return False

    @property
    def is_physical(self) -> bool:
        """Whether the stiffness is that of a layer that is there, and stands for no constraint."""
        return self.has_own_normal

    @property
    def positive(self) -> frozenset[str]:
        """Names of the parameters that must be greater than zero; the others may be zero."""
        return frozenset({"k_n", "k_t"})

    def parameters(self) -> dict[str, Any]:
        """The law's parameters by name, as the user gave them."""
        return dict(vars(self))

    def check_dimension(self, gdim: int) -> None:
        """Refuse what makes no sense in ``gdim`` dimensions.

        Raises:
            ValueError: It says what was given, and what is expected.
        """

    def check_complete(self) -> None:
        """Refuse a subclass that does not say what the solver and the verdict ask of it.

        Raises:
            ValueError: It says what is missing.
        """
        name, parameters = type(self).__name__, self.parameters()
        if type(self).response is Law.response:
            raise ValueError(f"{name} is no law: a subclass of Law must say its response")
        if self.has_own_normal and type(self).normal_potential is Law.normal_potential:
            raise ValueError(
                f"{name} has no parameter k_n; it must say its own normal_potential(kinematics, "
                "parameters), minus whose derivative by the normal displacement is the normal "
                "traction: energies, solver and verdict need it"
            )
        if self.has_tangential and "k_t" not in parameters:
            raise ValueError(
                f"{name} has tangential tractions, but no parameter k_t, the stiffness of points "
                "that stick (stress/length); add one"
            )

    def response(self, kinematics: Kinematics, parameters: Mapping[str, Expr]) -> Response:
        """The reactions; ``parameters`` are those of `parameters`, as UFL."""
        raise NotImplementedError

    def normal_potential(self, kinematics: Kinematics, parameters: Mapping[str, Expr]) -> Expr:
        """Energy per area of r_n, which is minus its derivative by u_n; by default eq. (19)."""
        return signorini_potential(kinematics, parameters["k_n"])

    def normal_stiffness(self, kinematics: Kinematics, parameters: Mapping[str, Expr]) -> Expr:
        """-∂r_n/∂u_n where the gap is closed (stress/length)."""
        if not self.has_own_normal:
            return parameters["k_n"]
        u_n = ufl.variable(kinematics.normal_displacement)
        density = self.normal_potential(replace(kinematics, normal_displacement=u_n), parameters)
        return ufl.diff(ufl.diff(density, u_n), u_n)

    def potential(self, kinematics: Kinematics, parameters: Mapping[str, Expr]) -> Expr:
        """Potential per area whose derivative by the displacement is minus the traction.

        Raises:
            ValueError: There is none.
        """
        if self.has_potential and not self.has_tangential:
            return self.normal_potential(kinematics, parameters)
        raise ValueError(
            f"{type(self).__name__} has no potential: its slip is not associated (eq. 46)"
        )

    def at_pressure(self, pressure: Expr) -> Law:
        """A law with a potential that is this one where ``pressure`` is the contact pressure.

        Args:
            pressure: Taken for given where this law has no potential, ≥ 0 (stress).
        """
        return self

    def n_modes(self, gdim: int) -> int:
        """Number of slip modes."""
        return 0

    def grip(self, parameters: Mapping[str, Expr]) -> Expr:
        """Bound of |τ|/p over all directions; not zero wherever motion along Γc is resisted."""
        return ufl.as_ufl(0.0)

    def tangential_stiffness(self, kinematics: Kinematics, parameters: Mapping[str, Expr]) -> Expr:
        """K_t of a sticking point (stress/length), shape (gdim, gdim), with K_t n = 0."""
        n = kinematics.normal
        return parameters["k_t"] * (ufl.Identity(len(n)) - ufl.outer(n, n))

    def elastic_displacement(
        self, kinematics: Kinematics, traction: Expr, parameters: Mapping[str, Expr]
    ) -> Expr:
        """K_t⁻¹ τ (length), shape (gdim,): minus the displacement v_e of eq. (24) without slip."""
        return traction / parameters["k_t"]

    def yield_functions(
        self, kinematics: Kinematics, traction: Expr, limit: Expr, parameters: Mapping[str, Expr]
    ) -> tuple[Expr, ...]:
        """g_j(τ, limit) ≤ 0 of each slip mode (stress), eq. (29), apart from the return map.

        Slip is associated with them: K_t⁻¹ Δτ = -(Δu_t + Σ Δβ_j ∂g_j/∂τ), eq. (44).
        """
        return ()

    def stored(
        self, kinematics: Kinematics, response: Response, parameters: Mapping[str, Expr]
    ) -> Expr:
        """Energy per area in the springs, r_n²/2k_n or `normal_potential`, and τ·K_t⁻¹τ/2.

        With multipliers the springs bear what these do not, in the end nothing.
        """
        stored = ufl.as_ufl(0.0)
        r_n, tau = response.normal_traction, response.traction
        if kinematics.multiplier is not None:
            r_n = r_n + kinematics.multiplier
            tau = None if tau is None else tau - kinematics.traction
        if self.has_own_normal:
            stored += self.normal_potential(kinematics, parameters)
        elif self.has_normal_stiffness:
            stored += r_n**2 / (2 * parameters["k_n"])
        if tau is not None:
            stored += ufl.dot(tau, self.elastic_displacement(kinematics, tau, parameters)) / 2
        return stored

    def dissipated(
        self, kinematics: Kinematics, response: Response, parameters: Mapping[str, Expr]
    ) -> Expr:
        """Work per area of friction on the slip of the increment, -τ·(Δu_t + K_t⁻¹ Δτ) ≥ 0."""
        assert response.traction is not None
        assert kinematics.traction is not None and kinematics.tangential_increment is not None
        change = response.traction - kinematics.traction
        stretched = self.elastic_displacement(kinematics, change, parameters)
        return -ufl.dot(response.traction, kinematics.tangential_increment + stretched)


def positive_part(value: Expr) -> Expr:
    """⟨value⟩₊, with the derivative 0 at the kink."""
    return ufl.conditional(ufl.gt(value, 0), value, 0)


def norm(vector: Expr) -> Expr:
    """|vector|, with the derivative 0 at zero."""
    squared = ufl.dot(vector, vector)
    return ufl.conditional(ufl.gt(squared, 0), ufl.sqrt(squared), 0)


def clip(value: Expr, limit: Expr) -> Expr:
    """The number between -limit and limit that is nearest to ``value``."""
    below = ufl.conditional(ufl.lt(value, -limit), -limit, value)
    return ufl.conditional(ufl.gt(value, limit), limit, below)


def signorini(kinematics: Kinematics, k_n: Expr) -> tuple[Expr, Expr, Expr]:
    """Regularised normal law, eq. (6-11): r_n, δ₊, δ₋ in closed form, point by point.

    With a multiplier r_n = -⟨λ_n + k_n (u_n - s)⟩₊: where λ_n = -r_n the law is exact.
    """
    closing = kinematics.normal_displacement - kinematics.gap
    opening = positive_part(kinematics.gap - kinematics.normal_displacement)
    penetration = positive_part(closing)
    if kinematics.multiplier is None:
        return -k_n * penetration, opening, penetration
    return -positive_part(kinematics.multiplier + k_n * closing), opening, penetration


def signorini_potential(kinematics: Kinematics, k_n: Expr) -> Expr:
    """½ k_n ⟨u_n - s⟩₊², eq. (19); with a multiplier ⟨λ_n + k_n (u_n - s)⟩₊²/(2 k_n)."""
    closing = kinematics.normal_displacement - kinematics.gap
    if kinematics.multiplier is None:
        return k_n / 2 * positive_part(closing) ** 2
    return positive_part(kinematics.multiplier + k_n * closing) ** 2 / (2 * k_n)


# ---- return maps: the closest point of the yield surface, and the excess of each mode ------------


def return_to_segment(trial: Expr, limit: Expr, tangent: Expr) -> tuple[Expr, tuple[Expr, ...]]:
    """In the plane: the two modes g = (τ - limit, -τ - limit), eq. (29).

    Needs no norm and is piecewise linear.

    Args:
        trial: τ*, what adherence alone would give, shape (2,).
        limit: μ p ≥ 0.
        tangent: Unit vector, shape (2,).

    Returns:
        τ, shape (2,), and k_t Δβ of each mode (stress).
    """
    along = ufl.dot(trial, tangent)
    excess = (positive_part(along - limit), positive_part(-along - limit))
    return clip(along, limit) * tangent, excess


def return_to_cone(trial: Expr, limit: Expr) -> tuple[Expr, tuple[Expr, ...]]:
    """In space: the one mode g = |τ| - limit; see `return_to_segment`."""
    # The norm is only used, and only differentiated, where it exceeds the limit: never at zero.
    size = ufl.sqrt(ufl.dot(trial, trial))
    slips = ufl.gt(size, limit)
    traction = ufl.conditional(slips, limit / size, 1) * trial
    return traction, (ufl.conditional(slips, size - limit, 0),)


def return_to_polygon(
    trial: Expr, limit: Expr, sides: list[tuple[Expr, Expr]]
) -> tuple[Expr, tuple[Expr, ...]]:
    """In space: g_j = τ·a_j - limit, the sides of a regular polygon (paper's fig. 3).

    With x = τ*·a_j, y = τ*·b_j and half a side H = limit tan(π/n), mode j is exceeded by
    ⟨x - limit - cot(2π/n) ⟨|y| - H⟩₊⟩₊: beyond the end of the side it shares the excess with its
    neighbour, which is the same formula for the other one. No sector has to be told.

    Args:
        trial: τ*, shape (3,).
        limit: Radius of the inscribed circle.
        sides: Outward unit normal a_j of every side, and the unit vector b_j along it.

    Returns:
        See `return_to_segment`.
    """
    half, share = math.tan(math.pi / len(sides)), 1 / math.tan(2 * math.pi / len(sides))
    traction, excess = trial, []
    for a, b in sides:
        x, y = ufl.dot(trial, a), ufl.dot(trial, b)
        over = positive_part(x - limit - share * positive_part(abs(y) - half * limit))
        # The closest point of this side: at a vertex both neighbours give the same.
        on_side = limit * a + clip(y, half * limit) * b
        traction = ufl.conditional(ufl.gt(over, 0), on_side, traction)
        excess.append(over)
    return traction, tuple(excess)


# ---- laws ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Frictionless(Law):
    """Unilateral contact without friction, eq. (6-20).

    Args to the constructor:
        k_n: Normal stiffness (stress/length): a number, constant or UFL expression, `Scaled`, or
            `Springs`.
    """

    k_n: Any = Scaled()

    def response(self, kinematics: Kinematics, parameters: Mapping[str, Expr]) -> Response:
        """See `Law.response`."""
        return Response(*signorini(kinematics, parameters["k_n"]))


@dataclass(frozen=True)
class Foundation(Law):
    """An elastic foundation: r_n = -k_n (u_n - s) and τ = -k_t u_t, both from the start.

    The stiffness is physical here, that of a layer between body and support (paper, 2.1).

    Args to the constructor:
        k_n: Normal stiffness (stress/length); see `Frictionless`.
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
        """See `Law.positive`: k_t may be zero."""
        return frozenset({"k_n"})

    def parameters(self) -> dict[str, Any]:
        """See `Law.parameters`."""
        return {"k_n": self.k_n} | ({"k_t": self.k_t} if self.has_tangential else {})

    def grip(self, parameters: Mapping[str, Expr]) -> Expr:
        """See `Law.grip`: there is no limit, so that this tells only where k_t is."""
        return parameters["k_t"]

    def response(self, kinematics: Kinematics, parameters: Mapping[str, Expr]) -> Response:
        """See `Law.response`."""
        r_n, opening, penetration = signorini(kinematics, parameters["k_n"])
        if self.tension:
            r_n = parameters["k_n"] * (kinematics.gap - kinematics.normal_displacement)
        if not self.has_tangential:
            return Response(r_n, opening, penetration)
        k_t = parameters["k_t"]
        if not self.tension:
            k_t = ufl.conditional(ufl.gt(penetration, 0), k_t, 0)
        traction = -k_t * kinematics.tangential_displacement
        return Response(r_n, opening, penetration, traction)

    def stored(
        self, kinematics: Kinematics, response: Response, parameters: Mapping[str, Expr]
    ) -> Expr:
        """See `Law.stored`; by displacements, since k_t may be zero."""
        closing = kinematics.normal_displacement - kinematics.gap
        stored = -response.normal_traction * closing / 2
        if response.traction is not None:
            stored -= ufl.dot(response.traction, kinematics.tangential_displacement) / 2
        return stored

    def potential(self, kinematics: Kinematics, parameters: Mapping[str, Expr]) -> Expr:
        """½ k_n (u_n - s)² + ½ k_t |u_t|², or eq. (19) without tension."""
        if not self.has_potential:
            raise ValueError(
                "Foundation has no potential with k_t and without tension: τ jumps where the gap "
                "closes; set k_t=0 or tension=True where one is needed"
            )
        if not self.tension:
            return signorini_potential(kinematics, parameters["k_n"])
        density = parameters["k_n"] / 2 * (kinematics.normal_displacement - kinematics.gap) ** 2
        if self.has_tangential:
            u_t = kinematics.tangential_displacement
            density += parameters["k_t"] / 2 * ufl.dot(u_t, u_t)
        return density


class FrictionLaw(Law):
    """What laws with friction share: the yield surface in the tangent plane, and slip.

    In the plane it is ±limit. In space it is the cone |τ| ≤ limit; with ``modes`` the regular
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

    def at_pressure(self, pressure: Expr) -> Law:
        """See `Law.at_pressure`: the pressure sets the limit of friction, and nothing else."""
        return self if self.has_potential else _AtPressure(self)

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

    def grip(self, parameters: Mapping[str, Expr]) -> Expr:
        """See `Law.grip`: the vertices of the polygon, the larger of the two frictions."""
        bound = parameters["friction"]
        if self.transverse_friction is not None:
            bound = ufl.max_value(bound, parameters["transverse_friction"])
        return bound if self.modes is None else bound / math.cos(math.pi / self.modes)

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

    def tangential_stiffness(self, kinematics: Kinematics, parameters: Mapping[str, Expr]) -> Expr:
        """See `Law.tangential_stiffness`: k_t B²."""
        if self.transverse_friction is None:
            return super().tangential_stiffness(kinematics, parameters)
        first, second = self._frame(kinematics.normal, parameters)
        ratio = parameters["transverse_friction"] / parameters["friction"]
        return parameters["k_t"] * (ufl.outer(first, first) + ratio**2 * ufl.outer(second, second))

    def elastic_displacement(
        self, kinematics: Kinematics, traction: Expr, parameters: Mapping[str, Expr]
    ) -> Expr:
        """See `Law.elastic_displacement`: B⁻² τ/k_t."""
        return self._stretched(traction, -2, kinematics.normal, parameters) / parameters["k_t"]

    def yield_functions(
        self, kinematics: Kinematics, traction: Expr, limit: Expr, parameters: Mapping[str, Expr]
    ) -> tuple[Expr, ...]:
        """See `Law.yield_functions`: eq. (29) in the plane, |σ| - limit or σ·a_j - limit."""
        n = kinematics.normal
        if len(n) == 2:
            along = ufl.dot(traction, _perpendicular(n))
            return along - limit, -along - limit
        sigma = self._stretched(traction, -1, n, parameters)
        if self.modes is None:
            return (norm(sigma) - limit,)
        return tuple(ufl.dot(sigma, a) - limit for a, _ in self._sides(n, parameters))

    def _return(
        self, kinematics: Kinematics, limit: Expr, parameters: Mapping[str, Expr]
    ) -> tuple[Expr, Expr, tuple[Expr, ...]]:
        """Return map of the increment in σ, eq. (41-45): σ*, σ and Δβ of each mode."""
        n, k_t = kinematics.normal, parameters["k_t"]
        trial = self._stretched(kinematics.traction, -1, n, parameters)
        trial = trial - k_t * self._stretched(kinematics.tangential_increment, 1, n, parameters)
        if len(n) == 2:
            sigma, excess = return_to_segment(trial, limit, _perpendicular(n))
        elif self.modes is None:
            sigma, excess = return_to_cone(trial, limit)
        else:
            sigma, excess = return_to_polygon(trial, limit, self._sides(n, parameters))
        return trial, sigma, tuple(e / k_t for e in excess)

    def slide(
        self, kinematics: Kinematics, limit: Expr, parameters: Mapping[str, Expr]
    ) -> tuple[Expr, tuple[Expr, ...]]:
        """τ at the end of the increment, shape (gdim,), and Δβ of each mode, eq. (41-45)."""
        _, sigma, slip = self._return(kinematics, limit, parameters)
        return self._stretched(sigma, 1, kinematics.normal, parameters), slip

    def sliding_potential(
        self, kinematics: Kinematics, limit: Expr, parameters: Mapping[str, Expr]
    ) -> Expr:
        """Minus its derivative by Δu_t is τ for a given limit: ½|σ*|²/k_t, linear beyond it.

        That is (|σ*|² - |σ* - σ|²)/(2 k_t), whose gradient by σ* is the closest point σ over k_t.
        """
        trial, sigma, _ = self._return(kinematics, limit, parameters)
        return ufl.dot(sigma, trial - sigma / 2) / parameters["k_t"]


class _AtPressure(FrictionLaw):
    """Another law, but for the limit of its friction, which is μ times a given "pressure"."""

    def __init__(self, law: FrictionLaw) -> None:
        self._law, self.friction, self.k_t = law, law.friction, law.k_t
        self.modes, self.direction = law.modes, law.direction
        self.transverse_friction = law.transverse_friction

    @property
    def has_potential(self) -> bool:
        """See `Law.has_potential`."""
        return True

    def response(self, kinematics: Kinematics, parameters: Mapping[str, Expr]) -> Response:
        """See `Law.response`."""
        limit = parameters["friction"] * parameters["pressure"]
        traction, slip = self.slide(kinematics, limit, parameters)
        found = self._law.response(kinematics, parameters)
        return replace(found, traction=traction, limit=limit, slip=slip)

    def potential(self, kinematics: Kinematics, parameters: Mapping[str, Expr]) -> Expr:
        """See `Law.potential`."""
        limit = parameters["friction"] * parameters["pressure"]
        normal = self._law.normal_potential(kinematics, parameters)
        return normal + self.sliding_potential(kinematics, limit, parameters)


def _perpendicular(normal: Expr) -> Expr:
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
    k_n: Any = Scaled()
    k_t: Any = Scaled()
    modes: int | None = None
    transverse_friction: Any = None
    direction: Any = None

    def response(self, kinematics: Kinematics, parameters: Mapping[str, Expr]) -> Response:
        """See `Law.response`. Where the gap is open τ = 0, and moving is not slipping."""
        r_n, opening, penetration = signorini(kinematics, parameters["k_n"])
        limit = -parameters["friction"] * r_n
        traction, slip = self.slide(kinematics, limit, parameters)
        closed = ufl.lt(r_n, 0)
        slip = tuple(ufl.conditional(closed, mode, 0) for mode in slip)
        return Response(r_n, opening, penetration, traction, limit, slip)


@dataclass(frozen=True)
class Tresca(FrictionLaw):
    """Friction whose limit μ p does not depend on the contact pressure (Duvaut-Lions, section 3).

    Args to the constructor:
        friction: Friction coefficient μ ≥ 0.
        pressure: The normal force per area p ≥ 0 (stress) that sets the limit.
        k_n: Normal stiffness (stress/length); see `Frictionless`.
        k_t: Tangential stiffness (stress/length).
        unilateral: True: the normal reaction is that of unilateral contact, and only the limit
            of friction is prescribed. False: the normal traction on the body *is* -p, gap or not
            (eq. 43); k_n is not used.
        modes, transverse_friction, direction: See `Coulomb`.
    """

    friction: Any
    pressure: Any
    k_n: Any = Scaled()
    k_t: Any = Scaled()
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

    def response(self, kinematics: Kinematics, parameters: Mapping[str, Expr]) -> Response:
        """See `Law.response`."""
        limit = parameters["friction"] * parameters["pressure"]
        traction, slip = self.slide(kinematics, limit, parameters)
        k_n = parameters["k_n"] if self.unilateral else ufl.as_ufl(0)
        r_n, opening, penetration = signorini(kinematics, k_n)
        if not self.unilateral:
            r_n = -parameters["pressure"]
        return Response(r_n, opening, penetration, traction, limit, slip)

    def potential(self, kinematics: Kinematics, parameters: Mapping[str, Expr]) -> Expr:
        """Eq. (19) and (43)."""
        limit = parameters["friction"] * parameters["pressure"]
        tangential = self.sliding_potential(kinematics, limit, parameters)
        if not self.unilateral:
            return tangential + parameters["pressure"] * kinematics.normal_displacement
        return tangential + signorini_potential(kinematics, parameters["k_n"])
