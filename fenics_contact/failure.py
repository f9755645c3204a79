"""The error of an increment without a verified solution, with advice."""

from __future__ import annotations

from collections.abc import Sequence

from fenics_contact.checks.verdict import Verdict
from fenics_contact.methods.attempt import Attempt

__all__ = ["NotConverged"]


class NotConverged(RuntimeError):
    """An increment has no verified solution; u and history are unchanged.

    Args:
        increment: Number of the increment.
        reason: SNES reason of the last attempt.
        verdict: Verification of the last state.
        attempts: The attempts, in their order.
        prefix: Prefix of the PETSc options.
        stiffnesses: Names of the stiffness parameters to lower, in this order.
        driven: Whether a force acts on an obstacle.

    Attributes:
        increment: Number of the increment, from 1.
        reason: SNES reason of the last attempt (negative: diverged; positive: SNES converged, but
            the verification failed).
        iterations: Number of SNES iterations of all attempts.
        verdict: Verification of the last state.
        attempts: The attempts, in their order.
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
        driven: bool = False,
    ) -> None:
        self.increment, self.reason, self.verdict = increment, reason, verdict
        self.attempts = tuple(attempts)
        self.iterations = sum(attempt.iterations for attempt in attempts)
        self._remarks: list[str] = []
        failures = [*verdict.failures, *hidden_by_round_off(verdict)]
        failed = "; ".join(failures) or "the last state passes the verification"
        tried = ". ".join(str(attempt) for attempt in attempts)
        super().__init__(
            (
                f"increment {increment}: the solution after {self.iterations} iterations does not "
                "pass the verification: "
                if reason > 0
                else f"increment {increment} did not converge: SNES reason {reason} after "
                f"{self.iterations} iterations; "
            )
            + f"{failed}; the forces have magnitude {verdict.worst_equation.force:.3e}. "
            + f"Tried: {tried}. "
            + _advice(reason, verdict, attempts, stiffnesses, driven=driven)
            + f"; -{prefix}snes_monitor shows the iterations"
        )

    def add(self, remark: str) -> None:
        """Append a remark to the text, if it is not empty."""
        self._remarks += [remark] * bool(remark)

    def __str__(self) -> str:
        """Return the text with its remarks."""
        return ". ".join([super().__str__(), *self._remarks])


def hidden_by_round_off(verdict: Verdict) -> list[str]:
    """Return the equilibria whose tolerance is below round-off, as possible causes, in words."""
    return [
        f"the forces on {name} have a residual {balance.round_off_in_words}"
        for name, balance in verdict.equations.items()
        if balance.holds(2.0) and balance.is_below_round_off
    ]


# First word of `Overload.describe`.
_OVERLOAD = "overload:"
_ADVICE_LAW = (
    "The equations hold, but the contact law does not: check that contact_traction, friction_bound "
    "and normal_potential of a user-defined law are consistent"
)
_ADVICE_NOT_FINITE = (
    "The last state is not finite (NaN or inf): tractions and their derivatives of a user-defined "
    "law must be finite at every gap and slip; a root, or a power below 1, has no derivative at 0. "
    "Otherwise try smaller increments"
)
_ADVICE_OVERLOAD = (
    "Try a smaller load, more friction, or a Dirichlet condition that constrains this motion"
)

_ADVICE_FORCE = (
    "prescribe the displacement of the obstacle instead of the force on it, which may have a "
    "maximum, as in a snap fit"
)


def _advice(
    reason: int,
    verdict: Verdict,
    attempts: Sequence[Attempt],
    stiffnesses: Sequence[str],
    *,
    driven: bool,
) -> str:
    """Return advice for the kind of failure."""
    if reason > 0 and verdict.only_laws_fail:
        return _ADVICE_LAW
    if attempts and attempts[-1].outcome.startswith(_OVERLOAD):
        return _ADVICE_OVERLOAD
    if reason > 0:  # converged: a lower stiffness does not help
        return "Try what the failed checks say, or smaller increments"
    if not verdict.is_finite:
        return _ADVICE_NOT_FINITE
    lower = [f"a lower {name}" for name in stiffnesses]
    tries = ", then ".join([", ".join(["smaller increments", *lower[:-1]]), *lower[-1:]])
    return f"Try {tries}" + (f", or {_ADVICE_FORCE}" if driven else "")
