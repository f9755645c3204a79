"""Checks of arguments, before any work: an error that says what was given and what is expected."""

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

_CELLS = ("triangle", "quadrilateral", "tetrahedron", "hexahedron")


def check_bool(name: str, value: Any) -> None:
    """Refuse what is neither True nor False, of Python or NumPy.

    Raises:
        ValueError: It names the argument, what it is, and what it must be.
    """
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} is {value!r}; it must be True or False")


def check_cells(name: str, kind: str) -> None:
    """Refuse cells whose facets are not all alike, as those of prisms and pyramids.

    Raises:
        ValueError: It says which cells are taken.
    """
    if kind not in _CELLS:
        raise ValueError(f"{name} has cells of type {kind}; use one of {_CELLS}")


def is_built_in(item: object) -> bool:
    """Whether its class is one of this package, and not of a user."""
    return type(item).__module__.split(".")[0] == __name__.split(".")[0]


def is_number(value: Any) -> bool:
    """Whether it is a real number, of Python or NumPy; a text or a truth value is none."""
    if not isinstance(value, int | float | np.number | np.ndarray):
        return False
    return np.ndim(value) == 0 and np.asarray(value).dtype.kind in "iuf"


def check_positive(
    name: str,
    value: Any,
    what: str = "a number greater than zero",
    *,
    infinite: bool = False,
) -> None:
    """Refuse what is no positive number; it may be ``infinite``.

    Raises:
        ValueError: It names the argument, what it is, and ``what`` it must be.
    """
    if not (is_number(value) and value > 0 and (infinite or value < np.inf)):
        raise ValueError(f"{name} is {value!r}; it must be {what}")


def check_instance(name: str, value: Any, kind: type, advice: str = "") -> None:
    """Refuse what is of another class.

    Raises:
        ValueError: It names the argument, what it is, and what it must be; the advice ends it.
    """
    if isinstance(value, kind):
        return
    advice = f"; {advice}" if advice else ""
    if isinstance(value, type) and issubclass(value, kind):
        made = value.__name__
        raise ValueError(f"{name} is the class {made}; give an instance, {made}(...){advice}")
    article = "an" if kind.__name__[0] in "AEIOU" else "a"
    raise ValueError(
        f"{name} is a {type(value).__name__}; it must be {article} {kind.__name__}{advice}"
    )


def listed(name: str, values: Iterable[Any], kind: type) -> list[Any]:
    """The values as a list, all of them of the class.

    Raises:
        ValueError: They are not; it says what was given.
    """
    if isinstance(values, kind):
        raise ValueError(f"{name} is a single {kind.__name__}; give a list, {name}=[...]")
    if not isinstance(values, Iterable):
        raise ValueError(
            f"{name} is {values!r}; it must be a list of {kind.__name__} objects, {name}=[...]"
        )
    found = list(values)
    for i, value in enumerate(found):
        check_instance(f"{name}[{i}]", value, kind)
    return found
