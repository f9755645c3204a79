"""Compiled forms and expressions, and a word to who waits for them."""

from __future__ import annotations

import logging
import sys
import time
from contextlib import AbstractContextManager
from typing import Any

import dolfinx
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from mpi4py import MPI

__all__ = [
    "CompileTimer",
    "compile_by_rule",
    "compile_expression",
    "compile_form",
    "printed_as_ever",
    "waiting",
]

logger = logging.getLogger("fenics_contact")
# Seconds: what takes less was in the cache; when a user wonders.
_FROM_CACHE, _LONG = 0.1, 3.0


def compile_form(form: ufl.Form, entity_maps: Any = None) -> fem.Form:
    """Compile a UFL form with the entity maps of its submeshes. Collective.

    What has been compiled before, in any run, is in DOLFINx's cache. If all that is not takes more
    than some seconds, it is said once what the program is doing: at level INFO, or to a terminal.
    """
    start = time.perf_counter()
    compiled = fem.form(form, entity_maps=entity_maps or None)
    waiting.add(time.perf_counter() - start)
    return compiled


def compile_by_rule(form: ufl.Form) -> list[fem.Form]:
    """Compile a UFL form in parts that add up to it, of one kind of integral and one rule each.

    Collective. Of two integrals over a tag with different quadrature rules DOLFINx 0.9 assembles
    one, without a word, where one of them is over other tags, too (DOLFINx issue 3735).
    """
    parts: dict[tuple[str, str], list[ufl.Integral]] = {}
    for integral in form.integrals():
        rule = repr(sorted(integral.metadata().items()))
        parts.setdefault((integral.integral_type(), rule), []).append(integral)
    return [compile_form(ufl.Form(part)) for part in parts.values()]


def compile_expression(expression: Any, points: npt.NDArray[np.float64]) -> fem.Expression:
    """Compile a UFL expression at points of the reference cell, shape (n_points, tdim). Collective.

    FFCx names it by its points as they are printed: with few digits another one's name.
    """
    with printed_as_ever():
        return fem.Expression(expression, points)


def printed_as_ever() -> AbstractContextManager[Any]:
    """NumPy's own way of printing, in which Basix names quadrature elements, and FFCx expressions.

    To a name given under other ``np.set_printoptions`` the same element is another one.
    """
    return np.printoptions(
        precision=8,
        threshold=1000,
        edgeitems=3,
        linewidth=75,
        suppress=False,
        nanstr="nan",
        infstr="inf",
        formatter=None,
        sign="-",
        floatmode="maxprec",
        legacy=False,
    )


class CompileTimer:
    """Time that went into compilation in this process."""

    def __init__(self) -> None:
        self._seconds, self._said = 0.0, False

    def add(self, seconds: float) -> None:
        """Count it, and say so if it was not from the cache and has become long."""
        if seconds > _FROM_CACHE:
            self._seconds += seconds
        if self._said or self._seconds < _LONG or MPI.COMM_WORLD.rank:
            return
        self._said = True
        text = (
            "compiling forms; later runs find them in the cache, "
            f"{dolfinx.jit.get_options()['cache_dir']}"
        )
        if logger.isEnabledFor(logging.INFO):
            logger.info(text)
        elif sys.stderr.isatty():
            print(f"\r\x1b[K{text}", file=sys.stderr)  # in place of a bar's line


waiting = CompileTimer()
