"""A condition that a verified solution satisfies."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Condition"]


@dataclass(frozen=True)
class Condition:
    """An error and its limit.

    Attributes:
        name: What is verified, in a few words.
        value: The error.
        limit: Largest error accepted, in the same unit.
        failure: Error text if the limit is exceeded.
    """

    name: str
    value: float
    limit: float
    failure: str

    @property
    def holds(self) -> bool:
        """Whether the error is at most the limit; a NaN is not."""
        return bool(self.value <= self.limit)
