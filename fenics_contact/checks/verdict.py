"""The verdict on a solution: what it must satisfy, checked apart from the solver and the forms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fenics_contact.checks.kinematics import Linearisation
from fenics_contact.checks.obstacles import ObstacleCheck
from fenics_contact.checks.tunnelling import Tunnelling
from fenics_contact.contact.contact import Contact
from fenics_contact.markup import shown
from fenics_contact.parallel import global_max, global_min, longest
from fenics_contact.systems.balance import MOST_EXCUSED
from fenics_contact.types import Array

__all__ = ["Attempt", "ForceBalance", "NotConverged", "Verdict", "check_laws"]

# The laws hold point by point up to rounding of their few operations.
_LAW_TOLERANCE = 1e-10
# Round-off as a share of a place or a traction, in units of that tolerance.
_ROUND_OFF = 16 * np.finfo(float).eps / _LAW_TOLERANCE
# Share of the energy exchanged that friction may seem to give: by the mean of the tractions at both
# ends it does so where slip turns round within a long increment (6 % where a load aside is
# reversed at once); in a state that smaller increments do not lead to it is half or more.
_MAX_FRICTION_ENERGY_GAIN = 0.25
# A displacement by the size of the body, rigid motion apart, that no body with stiffness has: half
# of what its ends move apart.
_MOST_DEFORMED = 5.0


@dataclass(frozen=True)
class ForceBalance:
    """What is left of forces that should balance, and what it is judged by.

    Attributes:
        residual: What is left (force).
        force: Size of the forces of the present increment (force).
        tolerance: Largest residual that passes (force).
        round_off: Of what the stiffness sums up; 0 where no force acts, or it is not known (force).
    """

    residual: float
    force: float
    tolerance: float
    round_off: float = 0.0

    @property
    def is_loaded(self) -> bool:
        """Whether there are forces: more than the residual that passes, which none is told from."""
        return self.force > self.tolerance

    def holds(self, times: float = 1.0) -> bool:
        """Whether the residual passes, and all is finite."""
        finite = np.isfinite([self.residual, self.force, self.tolerance]).all()
        return bool(finite and self.residual <= times * self.tolerance)

    def excess(self) -> float:
        """Residual over tolerance; infinite where something is not finite."""
        if not self.holds(np.inf):
            return np.inf
        return self.residual / self.tolerance if self.residual > 0 else 0.0

    def __str__(self) -> str:
        """What is left, and what would pass."""
        found = f"{self.residual:.3e} above {self.tolerance:.3e}, of forces of {self.force:.3e}"
        if self.round_off > self.tolerance:
            found += (
                f", where its displacements leave a round-off of {self.round_off:.3e}: its "
                "stiffness, or how far it is carried, is too large beside the forces"
            )
        return found


@dataclass(frozen=True)
class Verdict:
    """What was checked after a solve, the same on every rank.

    Attributes:
        equations: Norms of the free residual, recomputed by assembly, by body, free obstacle and
            contact: each is judged by the forces that act on it in the present increment.
        sums: Largest component of load + contact + reactions, by body, and of their moments about
            its middle, by its size: contact by its tractions at the points and not by its nodal
            forces.
        laws: Largest violations by contact and by law, relative; see `check_laws`.
        enforcement: `Contact.enforcement_error` of the contacts with multipliers, by name.
        enforcement_tolerance: What passes, by name.
        obstacles: What is found of obstacles that are rigid or go far, by contact.
        tunnelling: Penetration that the points of a contact do not resist, and places that have
            crossed what lies opposite, by contact; see `Tunnelling`.
        kinematics: What taking displacements as small changes, relative, by contact.
        small_displacement_tolerance: What passes; where it is finite no body passes that is
            deformed by more than five times its size.
        deformation: Of every body its largest displacement, rigid motion apart, by its size, or by
            how far its Dirichlet values differ, if that is more.
        ejected_bodies: Bodies that nothing touches any more, how far they have gone, and how far
            anything else has (length), by their names; see `find_ejected_bodies`.
        friction_energy_gain: Share of the energy exchanged that friction has given; see
            `Energy.friction_energy_gain`.
        inverted: Whether cells of a nonlinear bulk are turned inside out.
        cross_check: By contact the largest difference of its nodal forces from those that DOLFINx
            assembles from the boundary form; empty where it was not asked for, see ``cross_check``
            of `ContactProblem`.
    """

    equations: dict[str, ForceBalance]
    sums: dict[str, ForceBalance]
    laws: dict[str, dict[str, float]] = field(default_factory=dict)
    enforcement: dict[str, float] = field(default_factory=dict)
    enforcement_tolerance: dict[str, float] = field(default_factory=dict)
    obstacles: dict[str, ObstacleCheck] = field(default_factory=dict)
    tunnelling: dict[str, Tunnelling] = field(default_factory=dict)
    kinematics: dict[str, Linearisation] = field(default_factory=dict)
    small_displacement_tolerance: float = np.inf
    deformation: dict[str, float] = field(default_factory=dict)
    ejected_bodies: dict[str, tuple[float, float]] = field(default_factory=dict)
    friction_energy_gain: float = 0.0
    inverted: bool = False
    cross_check: dict[str, ForceBalance] = field(default_factory=dict)

    @property
    def inexact(self) -> dict[str, float]:
        """Share of the forces on a body that is left by round-off, where it is more than 1e-5."""
        return {
            name: balance.residual / balance.force
            for name, balance in self.equations.items()
            if balance.residual > MOST_EXCUSED * balance.force and balance.round_off > 0
        }

    @property
    def residual(self) -> float:
        """That of the equations which hold least well (force)."""
        return self._worst(self.equations).residual

    @property
    def force(self) -> float:
        """What that residual is judged by (force)."""
        return self._worst(self.equations).force

    @property
    def tolerance(self) -> float:
        """Largest residual that passes there (force)."""
        return self._worst(self.equations).tolerance

    @property
    def imbalance(self) -> float:
        """Of the sums of forces the one that is balanced least well (force)."""
        return self._worst(self.sums).residual

    @property
    def imbalance_tolerance(self) -> float:
        """Largest imbalance that passes there (force)."""
        return self._worst(self.sums).tolerance

    @property
    def is_loaded(self) -> bool:
        """Whether forces act on a body, a free obstacle or a contact (`ForceBalance.is_loaded`)."""
        return any(balance.is_loaded for balance in self.equations.values())

    @property
    def relative_residual(self) -> float:
        """The largest residual relative to the forces it is judged by; 0 where there are none."""
        loaded = (balance for balance in self.equations.values() if balance.is_loaded)
        return max((balance.residual / balance.force for balance in loaded), default=0.0)

    @staticmethod
    def _worst(balances: dict[str, ForceBalance]) -> ForceBalance:
        return max(balances.values(), key=ForceBalance.excess)

    def _repr_html_(self) -> str:
        """What is left of what must vanish, and what passes, for notebooks."""
        balances = {f"equations, {name}": b for name, b in self.equations.items()}
        balances |= {f"sums of forces, {name}": b for name, b in self.sums.items()}
        balances |= {f"cross-check, {name}": b for name, b in self.cross_check.items()}
        rows = [(n, f"{b.residual:.2e}", f"{b.tolerance:.2e}") for n, b in balances.items()]
        for contact, laws in self.laws.items():
            for law, violation in laws.items():
                rows.append((f"{law}, {contact}", f"{violation:.2e}", f"{_LAW_TOLERANCE:.2e}"))
        for contact, error in self.enforcement.items():
            allowed = f"{self.enforcement_tolerance[contact]:.2e}"
            rows.append((f"enforcement, {contact}", f"{error:.2e}", allowed))
        failures = self.failures
        title = "Verdict: " + ("does not hold" if failures else "holds")
        return shown(title, ("check", "left", "passes"), rows, failures)

    @property
    def only_laws_fail(self) -> bool:
        """Whether all but laws holds, and some of these do not."""
        return bool(self.failures) and not replace(self, laws={}).failures

    @property
    def failures(self) -> list[str]:
        """What does not hold, in words; empty for a solution."""
        found = []
        # Twice: the solver's residual is a product with K, this one an assembly.
        for name, balance in self.equations.items():
            if not balance.holds(2.0):
                found.append(f"residual of {name} is {balance}")
        for name, balance in self.sums.items():
            if not balance.holds():
                found.append(f"forces on {name}, or their moments, do not balance: {balance}")
        for contact, balance in self.cross_check.items():
            if not balance.holds():
                found.append(
                    f"{contact}: forces differ from those of the boundary form as DOLFINx "
                    f"assembles it: {balance}"
                )
        for contact, laws in self.laws.items():
            found += [
                f"{contact}: {law} violated by {value:.3e} (relative)"
                for law, value in laws.items()
                if not value <= _LAW_TOLERANCE
            ]
        for contact, error in self.enforcement.items():
            allowed = self.enforcement_tolerance[contact]
            if not error <= allowed:
                found.append(
                    f"{contact}: penetration or elastic slip left, {error:.3e} of the largest "
                    f"traction in the springs, above {allowed:.3e}; a larger tolerance, or "
                    "k_n and k_t nearer to 10 E/h, take fewer rounds; where a Dirichlet condition "
                    "holds a node of Γc inside of the obstacle nothing undoes it: take such facets "
                    "out of Γc"
                )
        if not self.friction_energy_gain <= _MAX_FRICTION_ENERGY_GAIN:
            found.append(
                "friction would drive the slip, by "
                f"{100 * self.friction_energy_gain:.2g} % of the energy exchanged. Several "
                "states satisfy the equations; smaller increments lead to another one. Use smaller "
                "increments (increments() halves them where needed)"
            )
        for contact, change in self.kinematics.items():
            if self.small_displacement_tolerance == np.inf:
                continue
            if not np.isfinite(change.judged):
                found.append(
                    f"{contact}: how far displacements are too large to be taken as small cannot "
                    "be told, because the springs of contact at its points hold a body against "
                    "nothing; where friction alone holds it and all points slip, the load is at "
                    "its limit; hold it by a condition or a weak spring, or accept it: "
                    "ContactProblem(small_displacement_tolerance=inf)"
                )
            elif change.judged > self.small_displacement_tolerance:
                found.append(
                    f"{contact}: displacements are too large to be taken as small: with gap and "
                    "normals where the body has moved to, the contact force would differ by "
                    f"{100 * change.force:.2g} % and the pressure by "
                    f"{100 * change.pressure:.2g} %, above "
                    f"{100 * self.small_displacement_tolerance:.2g} %; "
                    "load in smaller steps, describe the motion as one of the obstacle, find pairs "
                    'anew (update_pairs="increment"), or accept it: '
                    "ContactProblem(small_displacement_tolerance=inf)"
                )
        for name, deformation in self.deformation.items():
            if self.small_displacement_tolerance == np.inf or deformation <= _MOST_DEFORMED:
                continue
            found.append(
                f"{name} is deformed by {deformation:.2g} times its size: nothing holds a part of "
                "it, or stiffness and loads are in other units than lengths; or accept it: "
                "ContactProblem(small_displacement_tolerance=inf)"
            )
        for name, (way, others) in self.ejected_bodies.items():
            found.append(
                f"{name} is thrown out: it has gone {way:.2g} and touches nothing, where nothing "
                f"else has moved by more than {others:.2g}; load in smaller steps (increments() "
                "cuts them by itself), bring bodies to touch first, or hold it by a weak spring"
            )
        if self.inverted:
            found.append(
                "cells are turned inside out, det(I + grad u) ≤ 0: no deformation of a body; load "
                "in smaller steps (increments() cuts them by itself), or refine the mesh there"
            )
        for contact, obstacle in self.obstacles.items():
            found += obstacle.failures(contact)
        for contact, tunnelling in self.tunnelling.items():
            found += tunnelling.failures(contact)
        return found


def check_laws(contact: Contact) -> dict[str, float]:
    """Check the laws at every quadrature point by inequalities, not by the return map. Collective.

    Args:
        contact: An evaluated contact.

    Returns:
        Largest violations, relative to the largest value concerned, or to the tolerance times
        which it is the round-off of the places of points (16 eps times the size of the mesh), where
        that is larger: displacements below it are none, and neither are tractions that they make,
        such as what is left when a load has gone. "complementarity"
        (eq. 6-11: r_n ≤ 0, δ± ≥ 0, δ₊δ₋ = 0, r_n δ₊ = 0, s - u_n = δ₊ - δ₋, r_n = -k_n δ₋;
        with multipliers r_n = -k_n (u_n - s) - λ_n where that is < 0; of a law with its own
        `normal_potential` r_n is minus the derivative of it by u_n instead), or
        where the law bears tension "stiffness" (r_n = -k_n (u_n - s)). With friction "friction
        bound" (it is `Law.friction_bound` at the pressure) and, by the law's yield functions g_j,
        "cone" (g_j ≤ 0), "slip" (eq. 44: Δβ ≥ 0, the change of the traction is that of adherence
        and associated slip, Δτ = -K_t (Δu_t + Σ Δβ_j ∂g_j/∂τ)) and "dissipation" (Δβ_j g_j = 0,
        slip against τ). With tangential tractions but no friction "stiffness" holds τ = -K_t u_t
        too, or τ = 0 where open. NaN where something is not finite.
    """
    comm = contact.surface.mesh.comm
    # Points without an opposite bear nothing, whatever they do.
    law, paired, v = contact.law, contact.paired, contact.values
    if not paired.all():
        v = v.at(paired)

    def worst(*violations: Array) -> float:
        return max(longest(comm, x) for x in violations)

    def relative(value: float, *scales: Array) -> float:
        scale = worst(*scales)
        return value / scale if scale > 0 or not np.isfinite(scale) else value

    x = contact.surface.mesh.geometry.x
    nowhere = np.full(1, _ROUND_OFF * (global_max(comm, x) - global_min(comm, x)))
    opening, penetration, r_n = v.opening, v.penetration, v.normal_traction
    length = (opening, penetration, v.initial_gap, v.normal_displacement, nowhere)
    violations = [
        relative(
            worst(
                np.minimum(opening, 0),
                np.minimum(penetration, 0),
                np.minimum(opening, penetration),
                v.initial_gap - v.normal_displacement - opening + penetration,
            ),
            *length,
        )
    ]
    acting = np.where(r_n != 0, v.normal_stiffness, 0.0)  # where none acts it may be infinite
    pressure = (r_n, nowhere * acting)
    if law.has_own_normal:
        pull = np.maximum(r_n, 0) if not law.has_tension else np.zeros_like(r_n)
        violations.append(relative(worst(pull, r_n - v.normal_reaction), *pressure))
    elif law.has_tension:
        elastic = v.parameters["k_n"] * (v.normal_displacement - v.initial_gap)
        violations.append(relative(worst(r_n + elastic), *pressure))
    elif law.has_normal_stiffness and contact.multipliers is not None:
        slack = -r_n - v.multiplier - v.parameters["k_n"] * (penetration - opening)
        violations.append(relative(worst(np.minimum(-r_n, slack)), v.multiplier, *pressure))
    elif law.has_normal_stiffness:
        elastic = v.parameters["k_n"] * penetration
        violations.append(relative(worst(np.maximum(r_n, 0), r_n + elastic), *pressure))
    violations.append(relative(worst(contact.traction[~paired]), contact.traction))
    found = {"stiffness" if law.has_tension else "complementarity": max(violations)}
    if not law.has_tangential:
        return found

    tau, stiffness = v.traction, contact.tangential_stiffness[paired]
    stiffest = np.linalg.norm(stiffness, axis=(1, 2))
    if not law.has_friction:
        elastic = np.einsum("qij,qj->qi", stiffness, contact.tangential_displacement[paired])
        if not law.has_tension:
            elastic[penetration <= 0] = 0.0
        violation = relative(worst(tau + elastic), tau, nowhere * stiffest)
        found["stiffness"] = max(found.get("stiffness", 0.0), violation)
        return found

    bound, beta = v.friction_bound, v.slip_increment
    functions, gradients = (rows[paired] for rows in contact.evaluate_yield())
    missing = contact.slip_vector()[paired]  # = -Σ Δβ_j ∂g_j/∂τ (44)
    change = missing - v.increment
    # An open point keeps no traction and counts no slip, whatever it moves.
    bears = bound > 0
    slipped = -np.einsum("qm,qmd->qd", beta, gradients)
    # Round-off of the traction is one of the slip by the springs, large where these are soft; that
    # of the increments is by the displacements which they are differences of.
    borne = np.linalg.norm(tau, axis=1)
    yields = np.divide(borne, stiffest, out=np.zeros_like(borne), where=stiffest > 0)
    travel = (v.jump, v.increment, change, nowhere, _ROUND_OFF * yields)
    found["cone"] = relative(worst(np.maximum(functions, 0)), bound)
    # Where nothing presses a law may bound friction by zero, whatever its bound without pressure.
    apart = np.where((r_n < 0) | (bound != 0.0), bound - v.bound_of_law, 0.0)
    found["friction bound"] = relative(worst(apart), bound)
    found["slip"] = relative(worst(np.minimum(beta, 0), (missing - slipped)[bears]), *travel)
    found["dissipation"] = relative(
        worst((beta * functions)[bears], np.maximum(np.sum(tau * missing, axis=1) * bears, 0)),
        np.array([worst(bound) * worst(*travel)]),
    )
    return found


@dataclass(frozen=True)
class Attempt:
    """One thing that was tried to solve an increment.

    Attributes:
        method: A method of `ContactProblem`; or "cut", where `increments` halved the increment.
        iterations: SNES iterations.
        outcome: "converged", or what went wrong, in words.
    """

    method: str
    iterations: int
    outcome: str

    def __str__(self) -> str:
        """For logs and messages."""
        iterations = f"{self.iterations} iteration{'s' if self.iterations != 1 else ''}"
        return f"{self.method}: {self.outcome} ({iterations})"


class NotConverged(RuntimeError):
    """No solution of an increment was found. u and history are as before the increment.

    Attributes:
        increment: Its number, from 1.
        reason: SNES reason of what was tried last (negative: diverged; positive: it claimed
            convergence).
        iterations: SNES iterations made.
        verdict: The last state, as checked.
        attempts: What was tried, in its order.
    """

    def __init__(
        self,
        increment: int,
        reason: int,
        verdict: Verdict,
        attempts: Sequence[Attempt] = (),
        *,
        prefix: str = "contact_",
        stiffnesses: Sequence[str] = ("k_t", "k_n"),
    ) -> None:
        """Compose the message: what happened, the numbers, and what to try.

        Args:
            increment: See the attributes.
            reason: See the attributes.
            verdict: See the attributes.
            attempts: See the attributes.
            prefix: Of the problem's options.
            stiffnesses: Parameters of the laws that may be lowered, what to try first.
        """
        self.increment, self.reason, self.verdict = increment, reason, verdict
        self.attempts = tuple(attempts)
        self.iterations = sum(attempt.iterations for attempt in attempts)
        what = "; ".join(verdict.failures) or "the last state passes the checks"
        tried = ". ".join(str(attempt) for attempt in attempts)
        super().__init__(
            f"increment {increment} did not converge: SNES reason {reason} after {self.iterations} "
            f"iterations; {what}; forces are of size {verdict.force:.3e}. Tried: {tried}. "
            + _advice(reason, verdict, attempts, stiffnesses)
            + f"; -{prefix}snes_monitor shows the iterations"
        )


# How `Overload.in_words` begins, and what no increment mends.
_OVERLOAD = "overload:"
_OF_A_LAW = (
    "The law itself does not hold where the equations do: of a law of your own look whether its "
    "response, friction_bound and normal_potential belong together"
)
_OF_OVERLOAD = "Try less load, more friction, or a condition that holds the body along this motion"


def _advice(
    reason: int, verdict: Verdict, attempts: Sequence[Attempt], stiffnesses: Sequence[str]
) -> str:
    """What to try, by what went wrong."""
    if reason > 0 and verdict.only_laws_fail:
        return _OF_A_LAW
    if attempts and attempts[-1].outcome.startswith(_OVERLOAD):
        return _OF_OVERLOAD
    lower = [f"a lower {name}" for name in stiffnesses]
    return "Try " + ", then ".join([", ".join(["smaller increments", *lower[:-1]]), *lower[-1:]])
