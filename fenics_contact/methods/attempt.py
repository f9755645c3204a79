"""Record of an attempt to solve an increment."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Attempt"]


@dataclass(frozen=True)
class Attempt:
    """An attempt to solve an increment by one method.

    Attributes:
        method: A method of `ContactProblem`; or "cut", if `increments` halved the increment.
        iterations: Number of SNES iterations.
        outcome: "converged", or the reason why the increment was solved again or not at all.
    """

    method: str
    iterations: int
    outcome: str

    def __str__(self) -> str:
        """Return method, outcome and iterations in words."""
        iterations = f"{self.iterations} iteration{'s' if self.iterations != 1 else ''}"
        return f"{self.method}: {self.outcome} ({iterations})"
