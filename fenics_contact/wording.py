"""Percentages and positions in messages."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["format_point", "percent"]


def percent(ratio: float) -> str:
    """Return a ratio in per cent, with two digits, or as an integer from 99.5 % on."""
    return f"{100 * ratio:.2g} %" if abs(ratio) < 0.995 else f"{100 * ratio:.0f} %"


def format_point(place: npt.ArrayLike) -> str:
    """Return coordinates as a list, rounded to six digits of the largest one."""
    x = np.asarray(place, dtype=np.float64)
    largest = np.abs(x).max(initial=0.0)
    digits = 5 - int(np.floor(np.log10(largest))) if 0.0 < largest < np.inf else 0
    return str((np.round(x, digits) + 0.0).tolist())
