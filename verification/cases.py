"""Verification cases: quantities with references, and their registration."""

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
    """One quantity of a case and its reference.

    Attributes:
        quantity: Name, with the unit in brackets.
        obtained: Computed value.
        reference: Reference value.
        source: Source of the reference.
        tolerance: Largest error that passes, relative to the reference, absolute if that is 0.
    """

    quantity: str
    obtained: float
    reference: float
    source: str
    tolerance: float

    @property
    def error(self) -> float:
        """Error relative to the reference, absolute if that is 0."""
        return abs(self.obtained - self.reference) / (abs(self.reference) or 1.0)

    @property
    def is_met(self) -> bool:
        """Whether the error is within the tolerance; False for NaN."""
        return bool(self.error <= self.tolerance)


@dataclass(frozen=True)
class Estimate:
    """An error budget of a quantity whose exact value is known.

    Attributes:
        quantity: Name in the budget.
        budget: The budget.
        exact: Exact value of the modelled part.
        reference_uncertainty: Relative uncertainty of the exact value.
    """

    quantity: str
    budget: fc.ErrorBudget
    exact: float
    reference_uncertainty: float = 1e-9

    @property
    def true_error(self) -> float:
        """True error relative to the computed value."""
        value = self.budget.values[self.quantity]
        return (value - self.exact) / value

    @property
    def estimated(self) -> float:
        """Estimated error of all parts together, relative."""
        return self.budget.total[self.quantity]


@dataclass(frozen=True)
class Outcome:
    """The result of a case.

    Attributes:
        rows: Quantities.
        mesh: Description of the mesh.
        dofs: Number of dofs of the largest run.
        seconds: Wall time.
        estimates: Yields error estimates of the last state; collective. None if there is nothing
            to compare them with, see `Case.reason_without_estimates`.
    """

    rows: tuple[Row, ...]
    mesh: str
    dofs: int
    seconds: float = 0.0
    estimates: Callable[[], Iterator[Estimate]] | None = None

    @property
    def is_met(self) -> bool:
        """Whether every quantity meets its reference."""
        return all(row.is_met for row in self.rows)


@dataclass(frozen=True)
class Case:
    """A computation with references.

    Attributes:
        name: Title.
        reason: Reason of the tolerances.
        compute: Function that solves the case; collective.
        slow: Whether it takes more than some seconds.
        reason_without_estimates: Why error estimates cannot be compared with a true error.
    """

    name: str
    reason: str
    compute: Callable[[], Outcome]
    slow: bool = False
    reason_without_estimates: str = ""

    def run(self) -> Outcome:
        """Solve the case, and measure the time. Collective."""
        start = time.perf_counter()
        made = self.compute()
        return dataclasses.replace(made, seconds=time.perf_counter() - start)


_cases: list[Case] = []


def case(
    name: str, reason: str, *, slow: bool = False, reason_without_estimates: str = ""
) -> Callable[..., Callable[[], Outcome]]:
    """Register a computation as a case of its module."""

    def enter(compute: Callable[[], Outcome]) -> Callable[[], Outcome]:
        _cases.append(Case(name, reason, compute, slow, reason_without_estimates))
        return compute

    return enter


def cases_of(*modules: ModuleType) -> list[Case]:
    """Return the cases of modules, in the order of registration."""
    return [c for module in modules for c in _cases if c.compute.__module__ == module.__name__]
