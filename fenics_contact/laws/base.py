"""Contact laws: return maps and potentials in UFL, without mesh and state.

A law maps the kinematics at a point of Γc (`PointKinematics`) to the tractions there
(`ContactTraction`), in two and three dimensions and for every obstacle. The traction on the body is
r_n n + τ, with n from the body to the obstacle and r_n ≤ 0 (> 0 only with `Foundation`). Equation
numbers (n) are those of docs/formulation.md, and [n] those of the source paper.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import ufl

from fenics_contact.laws.return_maps import positive_part
from fenics_contact.types import Expr, Values

__all__ = [
    "ContactTraction",
    "Law",
    "Parameters",
    "PointKinematics",
    "signorini",
    "signorini_potential",
]


@dataclass(frozen=True)
class PointKinematics:
    """The local kinematics at a point of Γc, the input of a contact law (UFL).

    Attributes:
        gap: Present normal gap g_N (length), s - u_n with small displacements, eq. (1) and (2). It
            is negative where the body penetrates, and includes the motion of the obstacle.
        normal: Unit normal n from the body to the obstacle, shape (gdim,).
        tangential_displacement: Tangential displacement u_t relative to the obstacle, eq. (1)
            (length), shape (gdim,); None if the law has no tangential traction.
        tangential_increment: Increment Δu_t since the last commit (length), shape (gdim,); None
            without friction.
        traction: Tangential traction τ_old at the last commit, eq. (7), or the multiplier λ_t,
            eq. (8) (stress), shape (gdim,); None without friction.
        multiplier: Multiplier λ_n ≥ 0 of the augmented Lagrangian, eq. (8) (stress); None with a
            penalty.
    """

    gap: Expr
    normal: Expr
    tangential_displacement: Expr | None = None
    tangential_increment: Expr | None = None
    traction: Expr | None = None
    multiplier: Expr | None = None


@dataclass(frozen=True)
class ContactTraction:
    """The tractions on the body at a point of Γc, the result of a contact law (UFL).

    The total traction is r_n n + τ, with the normal n from the body to the obstacle.

    Attributes:
        normal_traction: Normal traction r_n, negative in compression (stress).
        traction: Tangential traction τ (stress), shape (gdim,); None if the law has none.
        friction_bound: Friction bound, the size of the yield surface: μ p of Coulomb's law
            (stress); None without friction.
        slip: Slip increment Δβ ≥ 0 of each slip mode (length), eq. (7).
    """

    normal_traction: Expr
    traction: Expr | None = None
    friction_bound: Expr | None = None
    slip: tuple[Expr, ...] = ()


class Parameters(dict[str, Any]):
    """Parameters of a law by name (UFL)."""

    def __init__(self, law: Law, values: Mapping[str, Any]) -> None:
        super().__init__(values)
        self._law = type(law).__name__

    def __missing__(self, name: str) -> Any:
        """Raise a ValueError that lists the parameters of the law."""
        raise ValueError(
            f"{self._law} asks for a parameter {name!r}; its fields, which are its parameters, are "
            f"{sorted(self)}"
        )


class Law:
    """Base class of contact laws: tractions as a function of the local kinematics, in UFL.

    A subclass, with friction one of `FrictionLaw`, is a dataclass whose fields are the law's
    parameters. It defines `contact_traction`, `normal_potential` unless r_n = -k_n δ₋ with a
    parameter ``k_n``, and `positive`, the parameters that must not vanish. The defaults of all
    other members are those of frictionless unilateral contact.
    """

    @property
    def has_tangential(self) -> bool:
        """Whether the law has tangential tractions."""
        return self.has_friction

    @property
    def has_friction(self) -> bool:
        """Whether points can slip, so that there are tangential history variables."""
        return False

    @property
    def has_potential(self) -> bool:
        """Whether the tractions derive from a potential, so that the tangent is symmetric."""
        return True

    @property
    def has_normal_stiffness(self) -> bool:
        """Whether r_n depends on the gap; False if the normal traction is prescribed."""
        return True

    @property
    def has_own_normal(self) -> bool:
        """Whether r_n derives from a `normal_potential` of the subclass, not from k_n."""
        is_overridden = type(self).normal_potential is not Law.normal_potential
        return self.has_normal_stiffness and (is_overridden or "k_n" not in self.parameters())

    @property
    def has_tension(self) -> bool:
        """Whether r_n may be tensile where the gap is open; then no point has the status open."""
        return False

    @property
    def is_physical(self) -> bool:
        """Whether the stiffness is that of a physical layer, not a penalty for rigid contact."""
        return self.has_own_normal

    @property
    def positive(self) -> frozenset[str]:
        """Names of the parameters that must be greater than zero; the others may be zero."""
        return frozenset({"k_n", "k_t"})

    def parameters(self) -> dict[str, Any]:
        """Return the law's parameters by name, as the user gave them."""
        return dict(vars(self))

    def check_dimension(self, gdim: int) -> None:
        """Check that the law is defined in ``gdim`` dimensions.

        Raises:
            ValueError: The law is not defined in this dimension.
        """

    def check_complete(self) -> None:
        """Check that a subclass defines all that the solver and the verification need.

        Raises:
            ValueError: A method or parameter is missing.
        """
        name, parameters = type(self).__name__, self.parameters()
        if type(self).contact_traction is Law.contact_traction:
            raise ValueError(f"{name} is no law: a subclass of Law must define contact_traction()")
        if self.has_own_normal and type(self).normal_potential is Law.normal_potential:
            raise ValueError(
                f"{name} has no parameter k_n; it must define normal_potential(kinematics, "
                "parameters), whose derivative with respect to the gap is the normal traction: "
                "energies, solver and verification need it"
            )
        if self.has_tangential and "k_t" not in parameters:
            raise ValueError(
                f"{name} has tangential tractions, but no parameter k_t, the stiffness of sticking "
                "points (stress/length); add one"
            )

    def contact_traction(self, kinematics: PointKinematics, parameters: Values) -> ContactTraction:
        """Return the tractions at a point.

        Args:
            kinematics: The local kinematics.
            parameters: The values of `parameters`, as UFL.
        """
        raise NotImplementedError

    def normal_potential(self, kinematics: PointKinematics, parameters: Values) -> Expr:
        """Return the energy per area whose derivative with respect to the gap is r_n.

        By default it is ½ k_n ⟨u_n - s⟩₊² [19].
        """
        return signorini_potential(kinematics, parameters["k_n"])

    def normal_stiffness(self, kinematics: PointKinematics, parameters: Values) -> Expr:
        """Return -∂r_n/∂u_n where the gap is closed (stress/length)."""
        if not self.has_own_normal:
            return parameters["k_n"]
        gap = ufl.variable(kinematics.gap)
        density = self.normal_potential(replace(kinematics, gap=gap), parameters)
        return ufl.diff(ufl.diff(density, gap), gap)

    def potential(self, kinematics: PointKinematics, parameters: Values) -> Expr:
        """Return the energy per area whose derivative by the jump ⟦u⟧ is minus the traction.

        Raises:
            ValueError: The law has no potential.
        """
        if self.has_potential and not self.has_tangential:
            return self.normal_potential(kinematics, parameters)
        raise ValueError(
            f"{type(self).__name__} has no potential: frictional dissipation depends on the path; "
            "use step.energy, the energies of an increment"
        )

    def with_given_friction_bound(self) -> Law:
        """Return this law with a friction bound given by a parameter "friction_bound" ≥ 0 (stress).

        The tractions of the law returned have a potential. A law that has a potential is returned
        unchanged.
        """
        return self

    def n_modes(self, gdim: int) -> int:
        """Return the number of slip modes in ``gdim`` dimensions."""
        return 0

    def friction_bound(
        self, kinematics: PointKinematics, pressure: Expr, parameters: Values
    ) -> Expr:
        """Return the size of the yield surface under a contact pressure (stress), ≥ 0.

        `contact_traction` and the verification call it. It may depend on the kinematics, such as
        the slip distance of the increment. Limit analysis applies only to a bound μ p with μ from
        the parameters alone.

        Args:
            kinematics: The local kinematics.
            pressure: Contact pressure -r_n ≥ 0 (stress).
            parameters: The values of `parameters`, as UFL.
        """
        return ufl.as_ufl(0.0)

    def circumradius(self, parameters: Values) -> Expr | None:
        """Return the largest |τ| on the yield surface of friction bound 1; None if it is unknown.

        If it is unknown, limit analysis does not apply, and no load is rejected because of
        friction.
        """
        return None

    def tangential_stiffness(self, kinematics: PointKinematics, parameters: Values) -> Expr:
        """Return K_t of a sticking point (stress/length), shape (gdim, gdim), with K_t n = 0."""
        n = kinematics.normal
        return parameters["k_t"] * (ufl.Identity(len(n)) - ufl.outer(n, n))

    def elastic_displacement(
        self, kinematics: PointKinematics, traction: Expr, parameters: Values
    ) -> Expr:
        """Return K_t⁻¹ τ = -v_e (length), shape (gdim,), with the elastic displacement v_e [24]."""
        return traction / parameters["k_t"]

    def yield_functions(
        self, kinematics: PointKinematics, traction: Expr, bound: Expr, parameters: Values
    ) -> tuple[Expr, ...]:
        """Return the yield functions g_j(τ, bound) ≤ 0 of the slip modes (stress) [29].

        Slip is associated at a given bound: K_t⁻¹ Δτ = -(Δu_t + Σ Δβ_j ∂g_j/∂τ) [44]. The
        verification evaluates these functions, independently of the return map.
        """
        return ()

    def stored(
        self, kinematics: PointKinematics, response: ContactTraction, parameters: Values
    ) -> Expr:
        """Return the elastic energy per area, r_n²/2k_n or `normal_potential`, plus τ·K_t⁻¹τ/2.

        With multipliers it is the energy of the penalty part of the tractions, which vanishes at
        convergence.
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
        self, kinematics: PointKinematics, response: ContactTraction, parameters: Values
    ) -> Expr:
        """Return the frictional dissipation per area, -τ·(Δu_t + K_t⁻¹ Δτ) ≥ 0."""
        assert response.traction is not None
        assert kinematics.traction is not None and kinematics.tangential_increment is not None
        traction_change = response.traction - kinematics.traction
        elastic_change = self.elastic_displacement(kinematics, traction_change, parameters)
        return -ufl.dot(response.traction, kinematics.tangential_increment + elastic_change)


def signorini(kinematics: PointKinematics, k_n: Expr) -> Expr:
    """Return r_n of eq. (6), -k_n ⟨u_n - s⟩₊, or with a multiplier -⟨λ_n + k_n (u_n - s)⟩₊ (8)."""
    closing = -kinematics.gap
    if kinematics.multiplier is None:
        return -k_n * positive_part(closing)
    return -positive_part(kinematics.multiplier + k_n * closing)


def signorini_potential(kinematics: PointKinematics, k_n: Expr) -> Expr:
    """Return ½ k_n ⟨u_n - s⟩₊² [19], or with a multiplier ⟨λ_n + k_n (u_n - s)⟩₊²/(2 k_n)."""
    closing = -kinematics.gap
    if kinematics.multiplier is None:
        return k_n / 2 * positive_part(closing) ** 2
    return positive_part(kinematics.multiplier + k_n * closing) ** 2 / (2 * k_n)
