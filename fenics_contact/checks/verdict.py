"""The verdict on a solution: equations, laws and kinematics, independent of the solver."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from fenics_contact.checks.condition import Condition
from fenics_contact.checks.kinematics import SmallDisplacementError
from fenics_contact.checks.obstacles import ObstacleCheck
from fenics_contact.checks.tunnelling import Tunnelling
from fenics_contact.contact.contact import Contact
from fenics_contact.markup import html_table
from fenics_contact.parallel import global_max, global_min, max_norm
from fenics_contact.systems.balance import MAX_ROUND_OFF_RESIDUAL_RATIO
from fenics_contact.tolerances import EVALUATION_ROUND_OFF
from fenics_contact.types import Array
from fenics_contact.wording import percent

__all__ = ["ForceBalance", "Verdict", "check_laws"]

# Relative violation of the contact laws, which hold at every point up to round-off.
_LAW_TOLERANCE = 1e-10
_SCALED_ROUND_OFF = EVALUATION_ROUND_OFF / _LAW_TOLERANCE
# Energy supplied by friction relative to the energy exchanged: 6 % if a tangential load is reversed
# in one increment, half or more in states that smaller increments do not lead to.
_MAX_FRICTION_ENERGY_GAIN = 0.25
# Largest displacement of a body without its rigid-body motion, relative to its size: half of the
# relative displacement of its ends.
_MAX_DEFORMATION_RATIO = 5.0


@dataclass(frozen=True)
class ForceBalance:
    """The residual of an equilibrium, with the magnitude of its forces and its tolerance.

    Attributes:
        residual: Norm of the residual (force).
        force: Magnitude of the forces of the present increment (force).
        tolerance: Largest residual accepted (force).
        round_off: Round-off of the internal forces; 0 without forces, or if it is unknown (force).
    """

    residual: float
    force: float
    tolerance: float
    round_off: float = 0.0

    @property
    def is_loaded(self) -> bool:
        """Whether the forces exceed the tolerance of the residual."""
        return self.force > self.tolerance

    @property
    def is_finite(self) -> bool:
        """Whether residual, force and tolerance are finite numbers."""
        return bool(np.isfinite([self.residual, self.force, self.tolerance]).all())

    def holds(self, times: float = 1.0) -> bool:
        """Return whether the residual is finite and at most ``times`` the tolerance."""
        return self.is_finite and self.residual <= times * self.tolerance

    def condition(self, name: str, failure: str, times: float = 1.0) -> Condition:
        """Return the condition that the residual is at most ``times`` the tolerance."""
        residual = self.residual if self.is_finite else np.nan
        return Condition(name, residual, times * self.tolerance, failure)

    def excess(self) -> float:
        """Return the residual divided by the tolerance; infinite if a number is not finite."""
        if self.is_finite and self.residual == 0.0:
            return 0.0
        return self.residual / self.tolerance if self.is_finite and self.tolerance > 0.0 else np.inf

    def __str__(self) -> str:
        """Return residual, tolerance and forces in words."""
        text = f"{self.residual:.3e} above {self.tolerance:.3e}, of forces of {self.force:.3e}"
        return text + (f", {self.round_off_in_words}" if self.is_below_round_off else "")

    @property
    def is_below_round_off(self) -> bool:
        """Whether the tolerance is below the round-off of the internal forces."""
        return self.round_off > self.tolerance

    @property
    def round_off_in_words(self) -> str:
        """The round-off and its cause in words."""
        return (
            f"with a round-off of {self.round_off:.3e}: its stiffness, or its rigid-body "
            "displacement, is too large relative to the forces"
        )


@dataclass(frozen=True)
class Verdict:
    """The verification of a solution: residuals and errors, the same on every rank.

    `failures` is empty for a verified solution.

    Attributes:
        equations: By body, free obstacle and contact, the residual of the free dofs, assembled
            again, with the forces of the present increment and the tolerance.
        sums: By body, the resultant of loads, contact tractions and reactions, and their moment
            about the centre of the body divided by its size (force). Contact enters by the
            tractions at the quadrature points, not by nodal forces.
        laws: By contact and condition, the largest relative violation of the contact law.
        enforcement: By contact with multipliers, its `Contact.enforcement_error`.
        enforcement_tolerance: By contact with multipliers, the largest such error accepted.
        obstacles: By contact with a rigid obstacle, distance gradient, depth and rotation.
        tunnelling: By contact, the penetration between the quadrature points, and the points that
            have crossed the obstacle.
        small_displacement_error: By contact, the relative error due to the small-displacement
            assumption.
        small_displacement_tolerance: Largest small-displacement error accepted. If it is finite, no
            body may deform by more than five times its size.
        deformation: By body, the largest displacement without rigid-body motion, divided by the
            size of the body or the range of its Dirichlet values, whichever is larger; empty
            until the interior displacement is recovered.
        ejected_bodies: By ejected body, its displacement, the largest displacement accepted, and
            the largest one nearby (length).
        friction_energy_gain: Energy supplied by friction, relative to the energy exchanged.
        inverted: Whether cells of a nonlinear bulk are inverted, det(I + grad u) ≤ 0.
        cross_check: By contact, the largest difference of its nodal forces from those that DOLFINx
            assembles from the boundary form; empty without ``ContactProblem(cross_check=True)``.
    """

    equations: dict[str, ForceBalance]
    sums: dict[str, ForceBalance]
    laws: dict[str, dict[str, float]] = field(default_factory=dict)
    enforcement: dict[str, float] = field(default_factory=dict)
    enforcement_tolerance: dict[str, float] = field(default_factory=dict)
    obstacles: dict[str, ObstacleCheck] = field(default_factory=dict)
    tunnelling: dict[str, Tunnelling] = field(default_factory=dict)
    small_displacement_error: dict[str, SmallDisplacementError] = field(default_factory=dict)
    small_displacement_tolerance: float = np.inf
    deformation: dict[str, float] = field(default_factory=dict)
    ejected_bodies: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    friction_energy_gain: float = 0.0
    inverted: bool = False
    cross_check: dict[str, ForceBalance] = field(default_factory=dict)

    @property
    def inexact(self) -> dict[str, float]:
        """By body, the relative residual due to round-off, where it is above 1e-5."""
        return {
            name: balance.residual / balance.force
            for name, balance in self.equations.items()
            if balance.residual > MAX_ROUND_OFF_RESIDUAL_RATIO * balance.force
            and balance.round_off > 0
        }

    @property
    def worst_equation(self) -> ForceBalance:
        """The equation with the largest residual relative to its tolerance."""
        return max(self.equations.values(), key=ForceBalance.excess)

    @property
    def worst_sum(self) -> ForceBalance:
        """The sum of forces with the largest residual relative to its tolerance."""
        return max(self.sums.values(), key=ForceBalance.excess)

    @property
    def is_loaded(self) -> bool:
        """Whether forces act on a body, a free obstacle or a contact (`ForceBalance.is_loaded`)."""
        return any(balance.is_loaded for balance in self.equations.values())

    @property
    def relative_residual(self) -> float:
        """Largest residual relative to the forces; 0 without forces."""
        loaded = (balance for balance in self.equations.values() if balance.is_loaded)
        return max((balance.residual / balance.force for balance in loaded), default=0.0)

    def _repr_html_(self) -> str:
        """Return a table of errors and limits for notebooks."""
        conditions = self.conditions
        rows = [(each.name, f"{each.value:.2e}", f"{each.limit:.2e}") for each in conditions]
        failures = [each.failure for each in conditions if not each.holds]
        title = "Verdict: " + ("does not hold" if failures else "holds")
        return html_table(title, ("condition", "error", "limit"), rows, failures)

    @property
    def is_finite(self) -> bool:
        """Whether all residuals, forces and tolerances of the equations are finite numbers."""
        return all(balance.is_finite for balance in self.equations.values())

    @property
    def only_laws_fail(self) -> bool:
        """Whether only contact laws are violated."""
        return bool(self.failures) and self.failures == [
            each.failure for each in self._conditions_of_laws() if not each.holds
        ]

    @property
    def pairing_errors(self) -> list[str]:
        """Contacts whose small-displacement error may be due to their pairs."""
        errors, tolerance = self.small_displacement_error, self.small_displacement_tolerance
        return [name for name, error in errors.items() if error.is_due_to_pairs(tolerance)]

    @property
    def failures(self) -> list[str]:
        """The conditions that are violated, in words; empty for a verified solution."""
        return [each.failure for each in self.conditions if not each.holds]

    @property
    def conditions(self) -> list[Condition]:
        """All conditions of the verification."""
        # Twice the tolerance: the solver's residual is a product with K, this one is assembled.
        conditions = [
            balance.condition(f"equations, {name}", f"residual of {name} is {balance}", 2.0)
            for name, balance in self.equations.items()
        ]
        conditions += [
            balance.condition(
                f"sums of forces, {name}",
                f"forces on {name}, or their moments, do not balance: {balance}",
            )
            for name, balance in self.sums.items()
        ]
        conditions += [
            balance.condition(
                f"cross-check, {contact}",
                f"{contact}: the contact forces differ from those that DOLFINx assembles from the "
                f"boundary form: {balance}",
            )
            for contact, balance in self.cross_check.items()
        ]
        conditions += self._conditions_of_laws()
        for contact, error in self.enforcement.items():
            allowed = self.enforcement_tolerance[contact]
            failure = (
                f"{contact}: the augmented Lagrangian method has not converged: the penalty still "
                f"carries {error:.3e} of the largest traction, above {allowed:.3e}. Use a larger "
                "tolerance, or k_n and k_t closer to 10 E/h. If a Dirichlet condition prescribes a "
                "node of Γc inside of the obstacle, its penetration remains: take such facets out "
                "of Γc"
            )
            conditions.append(Condition(f"enforcement, {contact}", error, allowed, failure))
        gain, limit = self.friction_energy_gain, _MAX_FRICTION_ENERGY_GAIN
        failure = (
            f"friction supplies energy, {percent(gain)} of the energy "
            "exchanged: the equations have several solutions, and this one is not reached by a "
            "continuous load path. Use smaller increments (increments() halves them where needed)"
        )
        conditions.append(Condition("energy supplied by friction", gain, limit, failure))
        tolerance = self.small_displacement_tolerance
        for contact, change in self.small_displacement_error.items():
            conditions += change.conditions(contact, tolerance)
        for name, deformation in self.deformation.items() if tolerance < np.inf else ():
            failure = (
                f"{name} is deformed by {deformation:.2g} times its size: a part of it is not "
                "constrained, or the units of stiffness, loads and lengths are not consistent; or "
                "accept it: ContactProblem(small_displacement_tolerance=inf)"
            )
            value = float(np.nan_to_num(deformation))  # for a NaN the equations fail
            conditions.append(
                Condition(f"deformation, {name}", value, _MAX_DEFORMATION_RATIO, failure)
            )
        for name, (displacement, limit, others) in self.ejected_bodies.items():
            failure = (
                f"{name} is ejected: it has moved by {displacement:.2g} and has no contact force, "
                f"while no displacement nearby exceeds {others:.2g}. Use smaller increments "
                "(increments() halves them where needed), start with the bodies in contact, or "
                "constrain it by a weak spring"
            )
            conditions.append(
                Condition(f"displacement without force, {name}", displacement, limit, failure)
            )
        failure = (
            "cells are inverted, det(I + grad u) ≤ 0. Use smaller increments (increments() halves "
            "them where needed), or refine the mesh there"
        )
        conditions.append(Condition("inverted cells", float(self.inverted), 0.0, failure))
        for contact, obstacle in self.obstacles.items():
            conditions += obstacle.conditions(contact)
        for contact, tunnelling in self.tunnelling.items():
            conditions += tunnelling.conditions(contact)
        return conditions

    def _conditions_of_laws(self) -> list[Condition]:
        """Return the conditions of the contact laws."""
        return [
            Condition(
                f"{law}, {contact}",
                value,
                _LAW_TOLERANCE,
                f"{contact}: {law} violated by {value:.3e} (relative)",
            )
            for contact, laws in self.laws.items()
            for law, value in laws.items()
        ]


def check_laws(contact: Contact) -> dict[str, float]:
    """Evaluate the contact conditions at every quadrature point, without the return map.

    Collective. The contact is evaluated.

    Returns:
        The largest violation of each condition, relative to the largest of its terms; NaN if a term
        is not finite. The scale is at least the round-off of the coordinates (16 eps
        times the size of the mesh) divided by the tolerance, so that residual displacements and
        tractions below round-off do not count. The conditions are

        - "complementarity", eq. (6): s - u_n = δ₊ - δ₋, r_n ≤ 0 and r_n = -k_n δ₋; with multipliers
          r_n = -k_n (u_n - s) - λ_n where that is negative; with a `normal_potential` of the law,
          r_n is minus its derivative by u_n;
        - "stiffness" instead if the law has tension, r_n = -k_n (u_n - s); with tangential
          tractions but no friction also τ = -K_t u_t, or τ = 0 where open;
        - with friction, "friction bound": it is `Law.friction_bound` at the pressure; "cone":
          g_j ≤ 0 for the law's yield functions; "slip": Δβ ≥ 0 and
          Δτ = -K_t (Δu_t + Σ Δβ_j ∂g_j/∂τ) [44]; "dissipation": Δβ_j g_j = 0, slip against τ.
    """
    comm = contact.surface.mesh.comm
    # Points without a pair have no traction.
    law, paired, v = contact.law, contact.pairs.paired, contact.values
    if not paired.all():
        v = v.at(paired)

    def worst(*violations: Array) -> float:
        return max(max_norm(comm, x) for x in violations)

    def relative(value: float, *scales: Array) -> float:
        scale = worst(*scales)
        return value / scale if scale > 0 or not np.isfinite(scale) else value

    x = contact.surface.mesh.geometry.x
    round_off = np.full(1, _SCALED_ROUND_OFF * (global_max(comm, x) - global_min(comm, x)))
    r_n, gap, length = v.normal_traction, v.gap, (v.initial_gap, v.normal_displacement, round_off)
    violations = [relative(worst(v.initial_gap - v.normal_displacement - gap), gap, *length)]
    k_n = np.where(r_n != 0, v.normal_stiffness, 0.0)  # may be infinite without traction
    pressure = (r_n, round_off * k_n)
    if law.has_own_normal:
        tension = np.maximum(r_n, 0) if not law.has_tension else np.zeros_like(r_n)
        violations.append(relative(worst(tension, r_n - v.normal_reaction), *pressure))
    elif law.has_tension:
        elastic = v.parameters["k_n"] * (v.normal_displacement - v.initial_gap)
        violations.append(relative(worst(r_n + elastic), *pressure))
    elif law.has_normal_stiffness and contact.multipliers is not None:
        complement = -r_n - v.multiplier - v.parameters["k_n"] * -gap
        violations.append(relative(worst(np.minimum(-r_n, complement)), v.multiplier, *pressure))
    elif law.has_normal_stiffness:
        elastic = v.parameters["k_n"] * v.penetration
        violations.append(relative(worst(np.maximum(r_n, 0), r_n + elastic), *pressure))
    violations.append(relative(worst(contact.traction[~paired]), contact.traction))
    errors = {"stiffness" if law.has_tension else "complementarity": max(violations)}
    if not law.has_tangential:
        return errors

    tau, stiffness = v.traction, contact.values.tangential_stiffness[paired]
    stiffest = np.linalg.norm(stiffness, axis=(1, 2))
    if not law.has_friction:
        elastic = np.einsum("qij,qj->qi", stiffness, contact.tangential_displacement[paired])
        if not law.has_tension:
            elastic[v.penetration <= 0] = 0.0
        violation = relative(worst(tau + elastic), tau, round_off * stiffest)
        errors["stiffness"] = max(errors.get("stiffness", 0.0), violation)
        return errors

    bound, beta = v.friction_bound, v.slip_increment
    contact.contact_kinematics.update()
    functions, gradients = (rows[paired] for rows in contact.effective_law.own.evaluate_yield())
    missing = contact.slip_vector()[paired]  # = -Σ Δβ_j ∂g_j/∂τ (44)
    change = missing - v.increment
    # Open points have neither traction nor slip.
    closed = bound > 0
    slip = -np.einsum("qm,qmd->qd", beta, gradients)
    # Slip has the round-off of displacements, and of tractions divided by the stiffness.
    size = np.linalg.norm(tau, axis=1)
    elastic_slip = np.divide(size, stiffest, out=np.zeros_like(size), where=stiffest > 0)
    travel = (v.jump, v.increment, change, round_off, _SCALED_ROUND_OFF * elastic_slip)
    errors["cone"] = relative(worst(np.maximum(functions, 0)), bound)
    # Without pressure the bound may be zero instead of that of the law.
    difference = np.where((r_n < 0) | (bound != 0.0), bound - v.law_friction_bound, 0.0)
    errors["friction bound"] = relative(worst(difference), bound)
    errors["slip"] = relative(worst(np.minimum(beta, 0), (missing - slip)[closed]), *travel)
    errors["dissipation"] = relative(
        worst((beta * functions)[closed], np.maximum(np.sum(tau * missing, axis=1) * closed, 0)),
        np.array([worst(bound) * worst(*travel)]),
    )
    return errors
