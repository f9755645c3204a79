"""What a form depends on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from dolfinx import fem

from fenics_contact.types import Array

__all__ = ["Dependence"]


class Dependence:
    """Whether any of the numbers that a form depends on was changed since they were last noted.

    Args:
        constants: Constants of the form.
        coefficients: Coefficients of the form, without those that may change as they will.
    """

    def __init__(
        self, constants: Sequence[fem.Constant], coefficients: Sequence[fem.Function]
    ) -> None:
        # Views stay valid as long as what they are of.
        self._owners = (tuple(constants), tuple(coefficients))
        self._views = [np.ravel(c.value) for c in constants] + [f.x.array for f in coefficients]
        self._noted: Array | None = None

    @property
    def changed(self) -> bool:
        """Whether a number is another one than noted, on this rank; True if none was noted."""
        return self._noted is None or not np.array_equal(self._numbers(), self._noted)

    def has(self, constant: fem.Constant) -> bool:
        """Whether a constant is among them."""
        return any(constant is mine for mine in self._owners[0])

    def note(self) -> None:
        """Note the numbers as they are now."""
        self._noted = self._numbers()

    def forget(self) -> None:
        """Have nothing noted: for while what depends on them is not complete."""
        self._noted = None

    def _numbers(self) -> Array:
        return np.concatenate(self._views) if self._views else np.zeros(0)
