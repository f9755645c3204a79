"""What a case of the verification is, how it is measured, and how modules have some."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import ModuleType

import fenics_contact as fc

__all__ = ["Case", "Estimate", "Outcome", "Row", "case", "cases_of"]


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
class Estimate:
    """What an error budget says of a quantity whose exact value is known.

    Attributes:
        quantity: Its name in the budget.
        budget: The budget.
        exact: What the quantity should be, of the contact that is modelled.
        known: How far that can be off, relative.
    """

    quantity: str
    budget: fc.ErrorBudget
    exact: float
    known: float = 1e-9

    @property
    def true(self) -> float:
        """The error, relative to the value that was computed."""
        value = self.budget.values[self.quantity]
        return (value - self.exact) / value

    @property
    def estimated(self) -> float:
        """All parts together, relative."""
        return self.budget.total[self.quantity]


@dataclass(frozen=True)
class Outcome:
    """What a case gives.

    Attributes:
        rows: Its quantities.
        mesh: The cells, in words.
        dofs: Unknown displacements of the largest run.
        seconds: Wall time of all of it.
        estimates: Estimates the errors of the last state; collective. None if there is nothing to
            estimate, see `Case.budget`.
    """

    rows: tuple[Row, ...]
    mesh: str
    dofs: int
    seconds: float = 0.0
    estimates: Callable[[], Iterator[Estimate]] | None = None

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
        budget: Why there is no error that estimates could be compared with.
    """

    name: str
    reason: str
    compute: Callable[[], Outcome]
    slow: bool = False
    budget: str = ""

    def run(self) -> Outcome:
        """Compute and take the time. Collective."""
        start = time.perf_counter()
        made = self.compute()
        return dataclasses.replace(made, seconds=time.perf_counter() - start)


_cases: list[Case] = []


def case(
    name: str, reason: str, *, slow: bool = False, budget: str = ""
) -> Callable[..., Callable[[], Outcome]]:
    """Make a computation a case of its module."""

    def enter(compute: Callable[[], Outcome]) -> Callable[[], Outcome]:
        _cases.append(Case(name, reason, compute, slow, budget))
        return compute

    return enter


def cases_of(*modules: ModuleType) -> list[Case]:
    """The cases of modules, one module after the other."""
    return [c for module in modules for c in _cases if c.compute.__module__ == module.__name__]
