"""Compilation of forms and expressions, with a message if it takes long."""

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
    "compile_by_quadrature_rule",
    "compile_expression",
    "compile_form",
    "compile_timer",
    "default_print_options",
]

logger = logging.getLogger("fenics_contact")
# Seconds up to which a form came from the cache, and from which a message is shown.
_CACHE_HIT_SECONDS, _MESSAGE_SECONDS = 0.1, 3.0


def compile_form(form: ufl.Form, entity_maps: Any = None) -> fem.Form:
    """Compile a UFL form, or load it from DOLFINx's cache. Collective.

    A message is shown once, in the log (INFO) or on a terminal, if compilation takes long.
    """
    start = time.perf_counter()
    compiled = fem.form(form, entity_maps=entity_maps or None)
    compile_timer.add(time.perf_counter() - start)
    return compiled


def compile_by_quadrature_rule(form: ufl.Form) -> list[fem.Form]:
    """Compile a UFL form as a sum of forms with one integral type and quadrature rule each.

    Collective. DOLFINx 0.9 silently drops one of two integrals with different quadrature rules over
    a tag if one of them is over other tags, too (DOLFINx issue 3735).
    """
    parts: dict[tuple[str, str], list[ufl.Integral]] = {}
    for integral in form.integrals():
        rule = repr(sorted(integral.metadata().items()))
        parts.setdefault((integral.integral_type(), rule), []).append(integral)
    return [compile_form(ufl.Form(part)) for part in parts.values()]


def compile_expression(expression: Any, points: npt.NDArray[np.float64]) -> fem.Expression:
    """Compile a UFL expression at points of the reference cell, shape (n_points, tdim). Collective.

    FFCx derives its name from the printed points, which must not be rounded.
    """
    with default_print_options():
        return fem.Expression(expression, points)


def default_print_options() -> AbstractContextManager[Any]:
    """Restore NumPy's default print options, on which names in Basix and FFCx depend."""
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
    """Total compilation time of this process."""

    def __init__(self) -> None:
        self._seconds, self._message_shown = 0.0, False

    def add(self, seconds: float) -> None:
        """Add the time of a compilation; show a message if the total exceeds the limit."""
        if seconds > _CACHE_HIT_SECONDS:
            self._seconds += seconds
        if self._message_shown or self._seconds < _MESSAGE_SECONDS or MPI.COMM_WORLD.rank:
            return
        self._message_shown = True
        text = (
            "compiling forms; later runs find them in the cache, "
            f"{dolfinx.jit.get_options()['cache_dir']}"
        )
        if logger.isEnabledFor(logging.INFO):
            logger.info(text)
        elif sys.stderr.isatty():
            print(f"\r\x1b[K{text}", file=sys.stderr)  # overwrites a progress bar


compile_timer = CompileTimer()
