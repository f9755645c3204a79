"""Shares and places as messages say them, in any units."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["percent", "place_in_words"]


def percent(share: float) -> str:
    """A share in per cent: two digits, or all before the point."""
    return f"{100 * share:.2g} %" if abs(share) < 0.995 else f"{100 * share:.0f} %"


def place_in_words(place: npt.ArrayLike) -> str:
    """Coordinates to six digits of the largest, as a list."""
    x = np.asarray(place, dtype=np.float64)
    largest = np.abs(x).max(initial=0.0)
    digits = 5 - int(np.floor(np.log10(largest))) if 0.0 < largest < np.inf else 0
    return str((np.round(x, digits) + 0.0).tolist())
