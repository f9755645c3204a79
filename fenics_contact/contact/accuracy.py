"""Accuracy: numerical parameters for a given relative error."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np

from fenics_contact.tolerances import ROUND_OFF

__all__ = ["DEFAULT_FACTOR", "PRESETS", "Accuracy"]

# Default k_n and k_t in units of E/h.
DEFAULT_FACTOR = 10.0
# Relative errors of the named accuracies.
PRESETS = {"draft": 5e-2, "standard": 1e-2, "fine": 1e-3}
# The relative error of force, friction or peak pressure is up to 0.5/κ with a penalty of κ E/h and
# few cells in contact, and a tenth of that with twenty cells (docs/effectivity.md,
# docs/enforcement.md). The error of the half-cylinder's friction in N increments is 0.14/N.
_PENALTY_ERROR, _INCREMENT_ERROR = 0.5, 0.14
# Stiffness in units of E/h; above the second one multipliers are cheaper.
_MIN_FACTOR, _MAX_FACTOR = 3.0, 10.0
# Errors of the augmented Lagrangian and of the solver, relative to the error wanted.
_PENALTY_PART_RATIO, _SOLVER_ERROR_RATIO = 0.2, 0.01


@dataclass(frozen=True)
class Accuracy:
    """Numerical parameters for a given relative error in contact force and pressure.

    They do not include the mesh size, which `estimate_errors` recommends.

    Attributes:
        error: The relative error.
        factor: Contact stiffness k_n and k_t in units of E/h.
        enforcement: "penalty" or "augmented".
        tolerance: Tolerance of the augmented Lagrangian method.
        rtol: Tolerance of the solver's residual relative to the forces.
        increments: Number of increments of a load history with friction; without it, one suffices.
    """

    error: float
    factor: float
    enforcement: str
    tolerance: float
    rtol: float
    increments: int

    @classmethod
    def of(cls, wanted: str | float) -> Accuracy:
        """Return the parameters for a relative error.

        Args:
            wanted: "draft" (5e-2), "standard" (1e-2), "fine" (1e-3), or the relative error, between
                1e-8 and 0.5.

        Raises:
            ValueError: ``wanted`` is neither a known name nor an error in this range.
        """
        error = PRESETS.get(wanted) if isinstance(wanted, str) else wanted
        if error is None or not (np.ndim(error) == 0 and 1e-8 <= error <= 0.5):
            raise ValueError(
                f"accuracy is {wanted!r}; use one of {list(PRESETS)}, or the relative error of "
                "force and pressure, between 1e-8 and 0.5"
            )
        factor = _PENALTY_ERROR / error
        penalty_suffices = factor <= _MAX_FACTOR * (1 + ROUND_OFF)
        tolerance = _PENALTY_PART_RATIO * error / (_PENALTY_ERROR / _MAX_FACTOR)
        return cls(
            error=float(error),
            factor=max(_MIN_FACTOR, factor) if penalty_suffices else _MAX_FACTOR,
            enforcement="penalty" if penalty_suffices else "augmented",
            tolerance=float(np.clip(tolerance, 1e-8, 0.1)),
            rtol=float(np.clip(_SOLVER_ERROR_RATIO * error, 1e-10, 1e-4)),
            increments=ceil(_INCREMENT_ERROR / error * (1 - ROUND_OFF)),
        )

    def __str__(self) -> str:
        """Return a description of the parameters for the log."""
        limit = f"to {self.tolerance:.0e}, " if self.enforcement == "augmented" else ""
        return (
            f"{self.error:.2g} in force and pressure: {self.enforcement} enforcement {limit}k = "
            f"{self.factor:g} E/h, residual {self.rtol:.0e}, {self.increments} increments with "
            "friction"
        )
