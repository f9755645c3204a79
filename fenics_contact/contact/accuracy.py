"""Accuracy: numerical parameters for a given relative error."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np

from fenics_contact.tolerances import ROUND_OFF

__all__ = ["DEFAULT_FACTOR", "PRESETS", "Accuracy"]

# k_n and k_t in units of E/h where nothing else is said.
DEFAULT_FACTOR = 10.0
# Relative errors that the words stand for.
PRESETS = {"draft": 5e-2, "standard": 1e-2, "fine": 1e-3}
# A penalty of κ E/h leaves up to 0.5/κ of force, friction or peak pressure where few cells
# bear, a tenth of that where twenty do (docs/effectivity.md, docs/enforcement.md); beyond ten
# multipliers are cheaper than stiffness. N increments leave 0.14/N of the half-cylinder's friction.
_PENALTY_ERROR, _INCREMENT_ERROR = 0.5, 0.14
_SOFTEST, _STIFFEST = 3.0, 10.0
# Shares of the error wanted: what multipliers leave of the penalty's, and the solver.
_LEFT, _SHARE = 0.2, 0.01


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
            ValueError: ``wanted`` is neither.
        """
        error = PRESETS.get(wanted) if isinstance(wanted, str) else wanted
        if error is None or not (np.ndim(error) == 0 and 1e-8 <= error <= 0.5):
            raise ValueError(
                f"accuracy is {wanted!r}; use one of {list(PRESETS)}, or the relative error of "
                "force and pressure, between 1e-8 and 0.5"
            )
        needed = _PENALTY_ERROR / error
        soft = needed <= _STIFFEST * (1 + ROUND_OFF)
        left = _LEFT * error / (_PENALTY_ERROR / _STIFFEST)
        return cls(
            error=float(error),
            factor=max(_SOFTEST, needed) if soft else _STIFFEST,
            enforcement="penalty" if soft else "augmented",
            tolerance=float(np.clip(left, 1e-8, 0.1)),
            rtol=float(np.clip(_SHARE * error, 1e-10, 1e-4)),
            increments=ceil(_INCREMENT_ERROR / error * (1 - ROUND_OFF)),
        )

    def __str__(self) -> str:
        """Return the parameters in words."""
        how = f"to {self.tolerance:.0e}, " if self.enforcement == "augmented" else ""
        return (
            f"{self.error:.2g} in force and pressure: {self.enforcement} enforcement {how}k = "
            f"{self.factor:g} E/h, residual {self.rtol:.0e}, {self.increments} increments with "
            "friction"
        )
