"""Detection of changed constants and coefficients of a form."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from dolfinx import fem

from fenics_contact.types import Array

__all__ = ["Dependence"]


class Dependence:
    """Constants and coefficients of a form, compared with their last recorded values.

    Args:
        constants: Constants of the form.
        coefficients: Coefficients of the form whose changes matter.
    """

    def __init__(
        self, constants: Sequence[fem.Constant], coefficients: Sequence[fem.Function]
    ) -> None:
        # The views are valid as long as their owners exist.
        self._owners = (tuple(constants), tuple(coefficients))
        self._views = [np.ravel(c.value) for c in constants] + [f.x.array for f in coefficients]
        self._recorded: Array | None = None

    @property
    def changed(self) -> bool:
        """Whether a value on this rank differs from the record; True without a record."""
        return self._recorded is None or not np.array_equal(self._values(), self._recorded)

    def has(self, constant: fem.Constant) -> bool:
        """Return whether the form depends on a constant."""
        return any(constant is own for own in self._owners[0])

    def note(self) -> None:
        """Record the present values."""
        self._recorded = self._values()

    def forget(self) -> None:
        """Discard the record, as long as results that depend on the values are incomplete."""
        self._recorded = None

    def _values(self) -> Array:
        return np.concatenate(self._views) if self._views else np.zeros(0)
