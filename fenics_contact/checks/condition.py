"""A condition that a verified solution satisfies."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Condition"]


@dataclass(frozen=True)
class Condition:
    """An error and its limit.

    Attributes:
        name: Of what, in a word or two.
        value: The error.
        limit: The largest one accepted, in the same unit.
        failure: What to say if it is larger.
    """

    name: str
    value: float
    limit: float
    failure: str

    @property
    def holds(self) -> bool:
        """Whether the error is a number that is not above the limit."""
        return bool(self.value <= self.limit)
