"""The verdict on a solution: what it must satisfy, checked apart from the solver and the forms."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from fenics_contact.contact import Contact
from fenics_contact.parallel import global_max

__all__ = ["NotConverged", "Verdict", "check_laws"]

# The laws hold point by point up to rounding of their few operations.
_LAW_TOLERANCE = 1e-10


@dataclass(frozen=True)
class Verdict:
    """What was checked after a solve, the same on every rank.

    Attributes:
        residual: Norm of the free residual, recomputed by assembly (force).
        force: Norm of the largest of load, contact forces and reactions (force).
        tolerance: Largest residual that passes (force).
        imbalance: Largest component of load + contact + reactions (force).
        imbalance_tolerance: Largest imbalance that passes (force).
        laws: Largest violations by contact and by law, relative; see `check_laws`.
    """

    residual: float
    force: float
    tolerance: float
    imbalance: float
    imbalance_tolerance: float
    laws: dict[str, dict[str, float]] = field(default_factory=dict)

    @property
    def failures(self) -> list[str]:
        """What does not hold, in words; empty for a solution."""
        found = []
        # Twice: the solver's residual is a product with K, this one an assembly.
        if not self.residual <= 2 * self.tolerance:
            found.append(f"residual {self.residual:.3e} above {self.tolerance:.3e}")
        if not self.imbalance <= self.imbalance_tolerance:
            found.append(
                f"forces do not balance: {self.imbalance:.3e} above {self.imbalance_tolerance:.3e}"
            )
        for contact, laws in self.laws.items():
            found += [
                f"{contact}: {law} violated by {value:.3e} (relative)"
                for law, value in laws.items()
                if not value <= _LAW_TOLERANCE
            ]
        return found


def check_laws(contact: Contact) -> dict[str, float]:
    """Check the laws at every quadrature point by inequalities, not by the return map. Collective.

    Args:
        contact: An evaluated contact.

    Returns:
        Largest violations, relative to the largest value concerned: "complementarity"
        (eq. 6-11: r_n ≤ 0, δ± ≥ 0, δ₊δ₋ = 0, r_n δ₊ = 0, s - u_n = δ₊ - δ₋, r_n = -k_n δ₋) and,
        with friction, "cone" (|τ| ≤ limit), "slip" (eq. 44: Δτ = -k_t (Δu_t + g_τ·Δβ), Δβ ≥ 0)
        and "dissipation" (Δβ·g = 0, slip against τ). NaN where something is not finite.
    """
    comm = contact.surface.mesh.comm
    v = contact.values

    def worst(*violations: np.ndarray) -> float:
        return max(global_max(comm, np.abs(x)) for x in violations)

    def relative(value: float, *scales: np.ndarray) -> float:
        scale = worst(*scales)
        return value / scale if scale > 0 or not np.isfinite(scale) else value

    opening, penetration, r_n = v["opening"], v["penetration"], v["normal_traction"]
    length = (opening, penetration, v["gap"], v["normal_displacement"])
    kinematic = relative(
        worst(
            np.minimum(opening, 0),
            np.minimum(penetration, 0),
            np.minimum(opening, penetration),
            v["gap"] - v["normal_displacement"] - opening + penetration,
        ),
        *length,
    )
    found = {"complementarity": kinematic}
    if contact.law.unilateral:
        k_n = v["parameter k_n"]
        reaction = relative(worst(np.maximum(r_n, 0), r_n + k_n * penetration), r_n)
        found["complementarity"] = max(kinematic, reaction)
    if not contact.law.has_friction:
        return found

    tau, old, limit, k_t = v["traction"], v["old_traction"], v["limit"], v["parameter k_t"]
    beta, normal = v["slip_increment"], v["normal"]
    size = np.linalg.norm(tau, axis=1)
    # An open point keeps no traction and counts no slip, whatever it moves.
    bears = limit > 0
    missing = v["increment"] + (tau - old) / k_t[:, None]  # = -g_τ·Δβ (44)
    if beta.shape[1] == 2:
        tangent = np.column_stack([-normal[:, 1], normal[:, 0]])
        slipped = -(beta[:, 0] - beta[:, 1])[:, None] * tangent
    else:
        slipped = -beta * tau / np.where(size > 0, size, 1)[:, None]
    # Round-off in the increments is that of the displacements they are differences of.
    travel = (v["jump"], v["increment"], (tau - old) / k_t[:, None])
    found["cone"] = relative(worst(np.maximum(size - limit, 0)), limit)
    found["slip"] = relative(worst(np.minimum(beta, 0), (missing - slipped)[bears]), *travel)
    found["dissipation"] = relative(
        worst(
            beta.sum(axis=1) * (limit - size) * bears,
            np.maximum(np.sum(tau * missing, axis=1) * bears, 0),
        ),
        np.array([worst(limit) * worst(*travel)]),
    )
    return found


class NotConverged(RuntimeError):
    """No solution of an increment was found. u and history are as before the increment.

    Attributes:
        increment: Its number, from 1.
        reason: SNES reason (negative: diverged; positive: it claimed convergence).
        iterations: SNES iterations made.
        verdict: The last state, as checked.
    """

    def __init__(self, increment: int, reason: int, iterations: int, verdict: Verdict) -> None:
        """Compose the message: what happened, the numbers, and what to try."""
        self.increment, self.reason = increment, reason
        self.iterations, self.verdict = iterations, verdict
        what = "; ".join(verdict.failures) or "the last state passes the checks"
        super().__init__(
            f"increment {increment} did not converge: SNES reason {reason} after {iterations} "
            f"iterations; {what}; forces are of size {verdict.force:.3e}. Try smaller increments, "
            "a lower k_t, then a lower k_n, or method='newton'; -contact_snes_monitor shows the "
            "iterations"
        )
