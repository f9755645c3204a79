"""Checks of arguments; the errors state what was given and what is expected."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

__all__ = [
    "check_bool",
    "check_cells",
    "check_instance",
    "check_positive",
    "is_built_in",
    "is_number",
    "listed",
]

_CELL_TYPES = ("triangle", "quadrilateral", "tetrahedron", "hexahedron")


def check_bool(name: str, value: Any) -> None:
    """Raise ValueError unless an argument is True or False (Python or NumPy)."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} is {value!r}; it must be True or False")


def check_cells(name: str, kind: str) -> None:
    """Raise ValueError for cells with facets of several types, such as prisms and pyramids."""
    if kind not in _CELL_TYPES:
        raise ValueError(f"{name} has cells of type {kind}; use one of {_CELL_TYPES}")


def is_built_in(item: object) -> bool:
    """Return whether the class of an object belongs to this package."""
    return type(item).__module__.split(".")[0] == __name__.split(".")[0]


def is_number(value: Any) -> bool:
    """Return whether a value is a real number (Python or NumPy), not a string or bool."""
    if not isinstance(value, int | float | np.number | np.ndarray):
        return False
    return np.ndim(value) == 0 and np.asarray(value).dtype.kind in "iuf"


def check_positive(
    name: str,
    value: Any,
    expected: str = "a number greater than zero",
    *,
    infinite: bool = False,
) -> None:
    """Raise ValueError unless an argument is a positive number, finite unless ``infinite``."""
    if not (is_number(value) and value > 0 and (infinite or value < np.inf)):
        raise ValueError(f"{name} is {value!r}; it must be {expected}")


def check_instance(name: str, value: Any, kind: type, advice: str = "") -> None:
    """Raise ValueError, with the advice at its end, unless an argument is an instance of kind."""
    if isinstance(value, kind):
        return
    advice = f"; {advice}" if advice else ""
    if isinstance(value, type) and issubclass(value, kind):
        class_name = value.__name__
        raise ValueError(
            f"{name} is the class {class_name}; give an instance, {class_name}(...){advice}"
        )
    article = "an" if kind.__name__[0] in "AEIOU" else "a"
    raise ValueError(
        f"{name} is a {type(value).__name__}; it must be {article} {kind.__name__}{advice}"
    )


def listed(name: str, values: Iterable[Any], kind: type) -> list[Any]:
    """Return the values as a list; raise ValueError unless all are instances of ``kind``."""
    if isinstance(values, kind):
        raise ValueError(f"{name} is a single {kind.__name__}; give a list, {name}=[...]")
    if not isinstance(values, Iterable):
        raise ValueError(
            f"{name} is {values!r}; it must be a list of {kind.__name__} objects, {name}=[...]"
        )
    items = list(values)
    for i, item in enumerate(items):
        check_instance(f"{name}[{i}]", item, kind)
    return items
