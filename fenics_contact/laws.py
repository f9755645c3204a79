"""Contact laws: pure UFL return maps and potentials. No mesh, no state.

A law maps the kinematics of a point of Γc (`Kinematics`) to the reactions there (`Response`). One
definition serves two and three dimensions and every support. Signs are the paper's: the traction on
the body is r_n n + τ, with n from the body to the support and r_n ≤ 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, TypeAlias

import ufl

__all__ = ["Coulomb", "Frictionless", "Kinematics", "Law", "Response", "Scaled", "Tresca"]

Expr: TypeAlias = ufl.core.expr.Expr


@dataclass(frozen=True)
class Scaled:
    """A stiffness per area as a multiple of E/h, Young's modulus over the height of the cell there.

    E comes from the bulk form itself, h is the cell's height over its facet on Γc, so that the
    penetration is about 1/factor of the elastic displacement over the first layer of cells.
    """

    factor: float

    def __post_init__(self) -> None:
        """Refuse a factor that is no positive number."""
        if not (0.0 < self.factor < float("inf")):
            raise ValueError(f"factor is {self.factor!r}; it must be a number greater than zero")


@dataclass(frozen=True)
class Kinematics:
    """What a law sees at a point (UFL).

    Attributes:
        gap: Initial gap s (length), the motion of the support included.
        normal_displacement: u_n of eq. (2).
        normal: Unit normal n from body to support, shape (gdim,).
        tangential_increment: Δu_t since the last commit, shape (gdim,); None without friction.
        traction: Tangential traction τ at the last commit, shape (gdim,); None without friction.
    """

    gap: Expr
    normal_displacement: Expr
    normal: Expr
    tangential_increment: Expr | None = None
    traction: Expr | None = None


@dataclass(frozen=True)
class Response:
    """The reactions at a point (UFL).

    Attributes:
        normal_traction: r_n ≤ 0 (stress).
        opening: δ₊ ≥ 0 (length), eq. (6).
        penetration: δ₋ ≥ 0 (length), eq. (6).
        traction: τ (stress), shape (gdim,); None without friction.
        limit: Largest |τ| that friction bears (stress); None without friction.
        slip: Δβ ≥ 0 of each slip mode (length), eq. (44).
    """

    normal_traction: Expr
    opening: Expr
    penetration: Expr
    traction: Expr | None = None
    limit: Expr | None = None
    slip: tuple[Expr, ...] = ()


class Law:
    """A contact law.

    Attributes:
        has_friction: Whether tangential state is needed at all.
        has_potential: Whether the reactions are the gradient of a potential (symmetric tangent).
        unilateral: Whether r_n answers the gap; False where the normal traction is prescribed.
    """

    has_friction: ClassVar[bool]
    has_potential: ClassVar[bool]
    unilateral: bool = True

    def parameters(self) -> dict[str, Any]:
        """The law's parameters by name, as the user gave them."""
        return dict(vars(self))

    def response(self, kinematics: Kinematics, parameters: Mapping[str, Expr]) -> Response:
        """The reactions; ``parameters`` are those of `parameters`, as UFL."""
        raise NotImplementedError

    def potential(self, kinematics: Kinematics, parameters: Mapping[str, Expr]) -> Expr:
        """Potential per area whose derivative by the displacement is minus the traction."""
        raise ValueError(
            f"{type(self).__name__} has no potential: its slip is not associated (eq. 46)"
        )

    def stored(self, response: Response, parameters: Mapping[str, Expr]) -> Expr:
        """Energy per area in the springs, r_n²/2k_n + |τ|²/2k_t."""
        stored = ufl.as_ufl(0.0)
        if self.unilateral:
            stored += response.normal_traction**2 / (2 * parameters["k_n"])
        if response.traction is not None:
            stored += ufl.dot(response.traction, response.traction) / (2 * parameters["k_t"])
        return stored

    def dissipated(
        self, kinematics: Kinematics, response: Response, parameters: Mapping[str, Expr]
    ) -> Expr:
        """Work per area of friction on the slip of the increment, -τ·(Δu_t + Δτ/k_t) ≥ 0."""
        assert response.traction is not None
        assert kinematics.traction is not None and kinematics.tangential_increment is not None
        stretched = (response.traction - kinematics.traction) / parameters["k_t"]
        return -ufl.dot(response.traction, kinematics.tangential_increment + stretched)

    @staticmethod
    def n_modes(gdim: int) -> int:
        """Slip modes: ± in the plane (eq. 29), the one cone in space."""
        return 2 if gdim == 2 else 1


def positive_part(value: Expr) -> Expr:
    """⟨value⟩₊, with the derivative 0 at the kink."""
    return ufl.conditional(ufl.gt(value, 0), value, 0)


def signorini(kinematics: Kinematics, k_n: Expr) -> tuple[Expr, Expr, Expr]:
    """Regularised normal law, eq. (6-11): r_n, δ₊, δ₋ in closed form, point by point."""
    opening = positive_part(kinematics.gap - kinematics.normal_displacement)
    penetration = positive_part(kinematics.normal_displacement - kinematics.gap)
    return -k_n * penetration, opening, penetration


def signorini_potential(kinematics: Kinematics, k_n: Expr) -> Expr:
    """½ k_n ⟨u_n - s⟩₊², eq. (19)."""
    return k_n / 2 * positive_part(kinematics.normal_displacement - kinematics.gap) ** 2


def _trial_traction(kinematics: Kinematics, k_t: Expr) -> Expr:
    """τ* = τ - k_t Δu_t: what adherence alone would give, eq. (44)."""
    return kinematics.traction - k_t * kinematics.tangential_increment


def _tangent_2d(normal: Expr) -> Expr:
    return ufl.as_vector([-normal[1], normal[0]])


def return_map(kinematics: Kinematics, limit: Expr, k_t: Expr) -> tuple[Expr, tuple[Expr, ...]]:
    """Traction and slip of the increment, eq. (41-45), given the largest |τ|.

    In the plane the two modes g = (τ - limit, -τ - limit), eq. (29), which needs no norm and is
    piecewise linear; in space the cone |τ| - limit.

    Returns:
        τ at the end of the increment, shape (gdim,), and Δβ of each mode.
    """
    trial = _trial_traction(kinematics, k_t)
    if trial.ufl_shape == (2,):
        tangent = _tangent_2d(kinematics.normal)
        along = ufl.dot(trial, tangent)
        modes = (along - limit, -along - limit)
        clipped = ufl.conditional(
            ufl.gt(modes[0], 0), limit, ufl.conditional(ufl.gt(modes[1], 0), -limit, along)
        )
        return clipped * tangent, tuple(positive_part(g) / k_t for g in modes)
    # The norm is only used, and only differentiated, where it exceeds the limit: never at zero.
    size = ufl.sqrt(ufl.dot(trial, trial))
    slips = ufl.gt(size, limit)
    traction = ufl.conditional(slips, limit / size, 1) * trial
    return traction, (ufl.conditional(slips, (size - limit) / k_t, 0),)


@dataclass(frozen=True)
class Frictionless(Law):
    """Unilateral contact without friction, eq. (6-20).

    Args to the constructor:
        k_n: Normal stiffness (stress/length): a number, constant or UFL expression, or `Scaled`.
    """

    k_n: Any = Scaled(10.0)
    has_friction: ClassVar[bool] = False
    has_potential: ClassVar[bool] = True

    def response(self, kinematics: Kinematics, parameters: Mapping[str, Expr]) -> Response:
        """See `Law.response`."""
        return Response(*signorini(kinematics, parameters["k_n"]))

    def potential(self, kinematics: Kinematics, parameters: Mapping[str, Expr]) -> Expr:
        """Eq. (19)."""
        return signorini_potential(kinematics, parameters["k_n"])


@dataclass(frozen=True)
class Coulomb(Law):
    """Unilateral contact with Coulomb friction, eq. (21-50).

    Args to the constructor:
        friction: Friction coefficient μ ≥ 0: a number, constant or UFL expression over Γc.
        k_n: Normal stiffness (stress/length); see `Frictionless`.
        k_t: Tangential stiffness (stress/length), likewise.
    """

    friction: Any
    k_n: Any = Scaled(10.0)
    k_t: Any = Scaled(10.0)
    has_friction: ClassVar[bool] = True
    has_potential: ClassVar[bool] = False

    def response(self, kinematics: Kinematics, parameters: Mapping[str, Expr]) -> Response:
        """See `Law.response`. Where the gap is open τ = 0, and moving is not slipping."""
        r_n, opening, penetration = signorini(kinematics, parameters["k_n"])
        limit = -parameters["friction"] * r_n
        traction, slip = return_map(kinematics, limit, parameters["k_t"])
        closed = ufl.gt(penetration, 0)
        slip = tuple(ufl.conditional(closed, mode, 0) for mode in slip)
        return Response(r_n, opening, penetration, traction, limit, slip)


@dataclass(frozen=True)
class Tresca(Law):
    """Friction whose limit μ p does not depend on the contact pressure (Duvaut-Lions, section 3).

    Args to the constructor:
        friction: Friction coefficient μ ≥ 0.
        pressure: The normal force per area p ≥ 0 (stress) that sets the limit.
        k_n: Normal stiffness (stress/length); see `Frictionless`.
        k_t: Tangential stiffness (stress/length).
        unilateral: True: the normal reaction is that of unilateral contact, and only the limit
            of friction is prescribed. False: the normal traction on the body *is* -p, gap or not
            (eq. 43); k_n is not used.
    """

    friction: Any
    pressure: Any
    k_n: Any = Scaled(10.0)
    k_t: Any = Scaled(10.0)
    unilateral: bool = True
    has_friction: ClassVar[bool] = True
    has_potential: ClassVar[bool] = True

    def parameters(self) -> dict[str, Any]:
        """See `Law.parameters`."""
        names = ("friction", "pressure", "k_t") + (("k_n",) if self.unilateral else ())
        return {name: getattr(self, name) for name in names}

    def response(self, kinematics: Kinematics, parameters: Mapping[str, Expr]) -> Response:
        """See `Law.response`."""
        limit = parameters["friction"] * parameters["pressure"]
        traction, slip = return_map(kinematics, limit, parameters["k_t"])
        k_n = parameters["k_n"] if self.unilateral else ufl.as_ufl(0)
        r_n, opening, penetration = signorini(kinematics, k_n)
        if not self.unilateral:
            r_n = -parameters["pressure"]
        return Response(r_n, opening, penetration, traction, limit, slip)

    def potential(self, kinematics: Kinematics, parameters: Mapping[str, Expr]) -> Expr:
        """Eq. (19) and (43): in Δu_t it is ½|τ*|²/k_t up to the limit, linear beyond."""
        k_t = parameters["k_t"]
        limit = parameters["friction"] * parameters["pressure"]
        trial = _trial_traction(kinematics, k_t)
        squared = ufl.dot(trial, trial)
        slips = ufl.gt(squared, limit**2)
        tangential = (
            ufl.conditional(slips, limit * ufl.sqrt(squared) - limit**2 / 2, squared / 2) / k_t
        )
        if not self.unilateral:
            return tangential + parameters["pressure"] * kinematics.normal_displacement
        return tangential + signorini_potential(kinematics, parameters["k_n"])
