"""Contact laws: pure UFL return maps and potentials. No mesh, no state.

A law maps the kinematics of a point of Γc (`PointKinematics`) to the reactions there
(`ContactTraction`). One definition serves two and three dimensions and every obstacle. Signs are
the paper's: the traction on the body is r_n n + τ, with n from the body to the obstacle and r_n ≤
0 (but for `Foundation`, which may pull).

A law of one's own is a subclass of `Law`, or of `FrictionLaw` with friction, and a dataclass of its
parameters. It says `Law.contact_traction`; where r_n is not -k_n δ₋ of a parameter "k_n", also its
`normal_potential`, against which the verdict checks r_n; and the parameters that must not vanish,
`positive`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import ufl

from fenics_contact.laws.return_maps import positive_part
from fenics_contact.types import Expr

__all__ = ["ContactTraction", "Law", "PointKinematics", "signorini", "signorini_potential"]


@dataclass(frozen=True)
class PointKinematics:
    """What a law sees at a point (UFL).

    Attributes:
        gap: Normal gap g_N = s - u_n (length): open where positive, penetrated where negative; the
            motion of the obstacle is included.
        normal: Unit normal n from body to obstacle, shape (gdim,).
        tangential_displacement: u_t of eq. (21), relative to the obstacle, shape (gdim,); None if
            the law gives no tangential traction.
        tangential_increment: Δu_t since the last commit, shape (gdim,); None without friction.
        traction: Tangential traction τ at the last commit, or the multiplier λ_t that replaces it,
            shape (gdim,); None without friction.
        multiplier: Pressure λ_n ≥ 0 that acts where the gap is closed and not penetrated; None
            under penalty enforcement, where there is none.
    """

    gap: Expr
    normal: Expr
    tangential_displacement: Expr | None = None
    tangential_increment: Expr | None = None
    traction: Expr | None = None
    multiplier: Expr | None = None


@dataclass(frozen=True)
class ContactTraction:
    """The reactions at a point (UFL).

    Attributes:
        normal_traction: r_n (stress).
        opening: δ₊ ≥ 0 (length), eq. (6).
        penetration: δ₋ ≥ 0 (length), eq. (6).
        traction: τ (stress), shape (gdim,); None if the law gives none.
        friction_bound: Size of the yield surface, μ p of Coulomb's law (stress); None without
            friction.
        slip: Δβ ≥ 0 of each slip mode (length), eq. (44).
    """

    normal_traction: Expr
    opening: Expr
    penetration: Expr
    traction: Expr | None = None
    friction_bound: Expr | None = None
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
        if type(self).contact_traction is Law.contact_traction:
            raise ValueError(f"{name} is no law: a subclass of Law must define contact_traction")
        if self.has_own_normal and type(self).normal_potential is Law.normal_potential:
            raise ValueError(
                f"{name} has no parameter k_n; it must say its own normal_potential(kinematics, "
                "parameters), whose derivative by the gap is the normal traction: energies, solver "
                "and verdict need it"
            )
        if self.has_tangential and "k_t" not in parameters:
            raise ValueError(
                f"{name} has tangential tractions, but no parameter k_t, the stiffness of points "
                "that stick (stress/length); add one"
            )

    def contact_traction(
        self, kinematics: PointKinematics, parameters: Mapping[str, Expr]
    ) -> ContactTraction:
        """The reactions; ``parameters`` are those of `parameters`, as UFL."""
        raise NotImplementedError

    def normal_potential(self, kinematics: PointKinematics, parameters: Mapping[str, Expr]) -> Expr:
        """Energy per area whose derivative by the gap is r_n; by default eq. (19)."""
        return signorini_potential(kinematics, parameters["k_n"])

    def normal_stiffness(self, kinematics: PointKinematics, parameters: Mapping[str, Expr]) -> Expr:
        """-∂r_n/∂u_n where the gap is closed (stress/length)."""
        if not self.has_own_normal:
            return parameters["k_n"]
        gap = ufl.variable(kinematics.gap)
        density = self.normal_potential(replace(kinematics, gap=gap), parameters)
        return ufl.diff(ufl.diff(density, gap), gap)

    def potential(self, kinematics: PointKinematics, parameters: Mapping[str, Expr]) -> Expr:
        """Potential per area whose derivative by the displacement is minus the traction.

        Raises:
            ValueError: There is none.
        """
        if self.has_potential and not self.has_tangential:
            return self.normal_potential(kinematics, parameters)
        raise ValueError(
            f"{type(self).__name__} has no potential: what friction takes depends on the way "
            "there; the energies of an increment are in step.energy"
        )

    def with_given_friction_bound(self) -> Law:
        """This law with its friction bound given by a parameter "friction_bound" ≥ 0 (stress).

        Tractions of such a law have a potential. A law that has one is returned as it is.
        """
        return self

    def n_modes(self, gdim: int) -> int:
        """Number of slip modes."""
        return 0

    def friction_bound(
        self, kinematics: PointKinematics, pressure: Expr, parameters: Mapping[str, Expr]
    ) -> Expr:
        """Size of the yield surface under a contact pressure (stress), ≥ 0.

        It is all that is known of the strength of friction: the `contact_traction` and the checks
        call it. It may depend on the kinematics, as on the slip distance of the increment. What is
        μ p, with μ from the parameters alone, bounds tangential forces by normal ones; no other
        bound does.

        Args:
            kinematics: Of the point.
            pressure: -r_n ≥ 0 (stress).
            parameters: Of the law, as UFL.
        """
        return ufl.as_ufl(0.0)

    def circumradius(self, parameters: Mapping[str, Expr]) -> Expr | None:
        """Largest |τ| on the yield surface of friction bound 1; None where it is not known.

        Where it is not known no load is refused because of friction.
        """
        return None

    def tangential_stiffness(
        self, kinematics: PointKinematics, parameters: Mapping[str, Expr]
    ) -> Expr:
        """K_t of a sticking point (stress/length), shape (gdim, gdim), with K_t n = 0."""
        n = kinematics.normal
        return parameters["k_t"] * (ufl.Identity(len(n)) - ufl.outer(n, n))

    def elastic_displacement(
        self, kinematics: PointKinematics, traction: Expr, parameters: Mapping[str, Expr]
    ) -> Expr:
        """K_t⁻¹ τ (length), shape (gdim,): minus the displacement v_e of eq. (24) without slip."""
        return traction / parameters["k_t"]

    def yield_functions(
        self,
        kinematics: PointKinematics,
        traction: Expr,
        bound: Expr,
        parameters: Mapping[str, Expr],
    ) -> tuple[Expr, ...]:
        """g_j(τ, bound) ≤ 0 of each slip mode (stress), eq. (29), apart from the return map.

        Slip is associated with them: K_t⁻¹ Δτ = -(Δu_t + Σ Δβ_j ∂g_j/∂τ), eq. (44).
        """
        return ()

    def stored(
        self, kinematics: PointKinematics, response: ContactTraction, parameters: Mapping[str, Expr]
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
        self, kinematics: PointKinematics, response: ContactTraction, parameters: Mapping[str, Expr]
    ) -> Expr:
        """Work per area of friction on the slip of the increment, -τ·(Δu_t + K_t⁻¹ Δτ) ≥ 0."""
        assert response.traction is not None
        assert kinematics.traction is not None and kinematics.tangential_increment is not None
        change = response.traction - kinematics.traction
        stretched = self.elastic_displacement(kinematics, change, parameters)
        return -ufl.dot(response.traction, kinematics.tangential_increment + stretched)


def signorini(kinematics: PointKinematics, k_n: Expr) -> tuple[Expr, Expr, Expr]:
    """Regularised normal law, eq. (6-11): r_n, δ₊, δ₋ in closed form, point by point.

    With a multiplier r_n = -⟨λ_n + k_n (u_n - s)⟩₊: where λ_n = -r_n the law is exact.
    """
    closing = -kinematics.gap
    opening = positive_part(kinematics.gap)
    penetration = positive_part(closing)
    if kinematics.multiplier is None:
        return -k_n * penetration, opening, penetration
    return -positive_part(kinematics.multiplier + k_n * closing), opening, penetration


def signorini_potential(kinematics: PointKinematics, k_n: Expr) -> Expr:
    """½ k_n ⟨u_n - s⟩₊², eq. (19); with a multiplier ⟨λ_n + k_n (u_n - s)⟩₊²/(2 k_n)."""
    closing = -kinematics.gap
    if kinematics.multiplier is None:
        return k_n / 2 * positive_part(closing) ** 2
    return positive_part(kinematics.multiplier + k_n * closing) ** 2 / (2 * k_n)
