"""What a case of the verification is, how it is measured, and the list of all of them."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

__all__ = ["CASES", "Case", "Outcome", "Row", "case"]


@dataclass(frozen=True)
class Row:
    """One quantity of a case beside its reference.

    Attributes:
        quantity: Its name, unit in brackets.
        obtained: What the computation gave.
        reference: What it should be.
        source: Where the reference stands.
        tolerance: Largest error that passes, relative to the reference; absolute where that is 0.
    """

    quantity: str
    obtained: float
    reference: float
    source: str
    tolerance: float

    @property
    def error(self) -> float:
        """Relative to the reference; absolute where that is 0."""
        return abs(self.obtained - self.reference) / (abs(self.reference) or 1.0)

    @property
    def passed(self) -> bool:
        """False for results that are no numbers, too."""
        return bool(self.error <= self.tolerance)


@dataclass(frozen=True)
class Outcome:
    """What a case gives.

    Attributes:
        rows: Its quantities.
        mesh: The cells, in words.
        dofs: Unknown displacements of the largest run.
        seconds: Wall time of all of it.
    """

    rows: tuple[Row, ...]
    mesh: str
    dofs: int
    seconds: float = 0.0

    @property
    def passed(self) -> bool:
        """Whether every quantity meets its reference."""
        return all(row.passed for row in self.rows)


@dataclass(frozen=True)
class Case:
    """A computation with references.

    Attributes:
        name: Title.
        reason: Why the tolerance is what it is.
        compute: The computation; collective.
        slow: Takes more than some seconds.
    """

    name: str
    reason: str
    compute: Callable[[], Outcome]
    slow: bool = False

    def run(self) -> Outcome:
        """Compute and take the time. Collective."""
        start = time.perf_counter()
        made = self.compute()
        return Outcome(made.rows, made.mesh, made.dofs, time.perf_counter() - start)


CASES: list[Case] = []


def case(name: str, reason: str, *, slow: bool = False) -> Callable[..., Callable[[], Outcome]]:
    """Put a computation on the list."""

    def enter(compute: Callable[[], Outcome]) -> Callable[[], Outcome]:
        CASES.append(Case(name, reason, compute, slow))
        return compute

    return enter
