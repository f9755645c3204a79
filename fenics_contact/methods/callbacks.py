"""Callbacks of SNES that keep an error until SNES has returned.

PETSc carries no exception of Python: what leaves a callback comes out as an error code of PETSc's
own, and leaves vectors locked behind it. So SNES is told that the residual is not a number, which
ends it in good order, and then the error is raised. An interrupt waits for the next callback.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from fenics_contact import compat
from fenics_contact.parallel import raise_collectively
from fenics_contact.systems import dense, linear
from fenics_contact.types import Array

__all__ = ["Callbacks", "interrupts_held", "release_interrupt"]


class _Interrupt:
    """An interrupt that waits, and what it was to do; there is one Ctrl-C for all problems."""

    handler: Any = None
    arguments: tuple[Any, ...] = ()


def _keep(*arguments: Any) -> None:
    _Interrupt.arguments = arguments


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Hold back Ctrl-C inside the block: Python would raise where PETSc has just called it.

    Nor must it tear apart what belongs together. `release_interrupt` lets it through.
    """
    handler = signal.getsignal(signal.SIGINT)
    main = threading.current_thread() is threading.main_thread()
    if handler is _keep or not callable(handler) or not main:
        yield
        return
    _Interrupt.handler, _Interrupt.arguments = handler, ()
    try:
        signal.signal(signal.SIGINT, _keep)
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        release_interrupt()


def release_interrupt() -> None:
    """Do what an interrupt that waits was to do, usually raise KeyboardInterrupt."""
    arguments, _Interrupt.arguments = _Interrupt.arguments, ()
    if arguments:
        _Interrupt.handler(*arguments)


class Callbacks:
    """The callbacks of one SNES, which is no part of it: SNES keeps them, and would keep itself.

    Args:
        comm: The ranks of the SNES.
    """

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm = comm
        self._error: BaseException | None = None
        # Where the residual was computed last, and it.
        self._last: tuple[Array, ...] = ()

    def attach(
        self,
        snes: PETSc.SNES,
        residual: Callable[[PETSc.Vec, PETSc.Vec], None],
        vector: PETSc.Vec,
        jacobian: Callable[[PETSc.Vec, PETSc.Mat], None],
        matrix: PETSc.Mat,
        reason: Callable[[], int],
    ) -> None:
        """Give SNES its callbacks, which must not keep the SNES.

        Args:
            snes: The solver.
            residual: Computes it at x, into f.
            vector: For the residual.
            jacobian: Assembles the matrix at x.
            matrix: That matrix.
            reason: Whether to end, by what ``residual`` left; only asked where that is finite.
        """

        def test(_: Any, iteration: int, norms: tuple[float, float, float]) -> int:
            lost = compat.NOT_FINITE
            return int(self._run(reason, otherwise=lost)) if np.isfinite(norms[2]) else lost

        snes.setFunction(lambda _, x, f: self._compute(residual, x, f), vector)
        snes.setJacobian(lambda _, x, J, P: self._run(jacobian, x, J), matrix)
        snes.setConvergenceTest(test)

    def set_level_function(
        self,
        snes: PETSc.SNES,
        residual: Callable[[PETSc.Vec, PETSc.Vec], None],
        vector: PETSc.Vec,
        measure: Callable[[PETSc.Vec, PETSc.Vec], float],
    ) -> None:
        """Give the line search of SNES a measure of the residual that it is to lower.

        Args:
            snes: The solver.
            residual: As for `attach`.
            vector: For the residual, not that of SNES.
            measure: Of x and a residual there that is finite.
        """

        def level(_: Any, x: PETSc.Vec) -> float:
            self._compute(residual, x, vector)
            finite = np.isfinite(vector.norm())
            return float(self._run(measure, x, vector, otherwise=np.nan)) if finite else np.nan

        snes.setObjective(level)

    def set_objective(self, snes: PETSc.SNES, energy: Callable[[PETSc.Vec], float]) -> None:
        """Give the line search of SNES what it is to lower."""
        snes.setObjective(lambda _, x: self._run(energy, x, otherwise=np.nan))

    def solve(self, snes: PETSc.SNES, x: PETSc.Vec) -> tuple[int, int]:
        """Let SNES solve from ``x`` on. Collective.

        Returns:
            Iterations and reason.

        Raises:
            BaseException: The first that a callback raised.
            MemoryError: The factorisation did not get its memory.
        """
        try:
            with interrupts_held():
                snes.solve(None, x)
        finally:
            self._last = ()  # another solution may be of other equations
            error, self._error = self._error, None
            try:
                if error is not None:
                    raise error
            finally:
                del error  # it keeps this frame, which would keep it and all that solves
        dense.raise_stored_error(snes.getKSP())
        reason, pc = snes.getConvergedReason(), snes.getKSP().getPC()
        refused = reason <= 0 and self._comm.allreduce(linear.refused_memory(pc))
        linear.forget_failure(pc)
        if refused:
            raise MemoryError(
                "out of memory in a factorisation: use more ranks, linear_solver='multigrid', or "
                "a coarser mesh; if options limit MUMPS, raise the limit (mat_mumps_icntl_14, "
                "mat_mumps_icntl_23)"
            )
        return snes.getIterationNumber(), reason

    def _compute(
        self, residual: Callable[[PETSc.Vec, PETSc.Vec], None], x: PETSc.Vec, f: PETSc.Vec
    ) -> None:
        if self._is_last(x):
            f.array[:] = self._last[1]
            return
        self._last = ()
        self._run(residual, x, f)
        if self._error is not None:
            f.set(np.nan)
        else:
            self._last = x.array_r.copy(), f.array_r.copy()

    def _is_last(self, x: PETSc.Vec) -> bool:
        """Whether the residual was computed last at just this x. Collective.

        Line searches ask for it once more at the step that they take, `cp` half of all times.
        """
        same = bool(self._last) and np.array_equal(x.array_r, self._last[0])
        return bool(self._comm.allreduce(not same) == 0)

    def _run(self, function: Callable[..., Any], *arguments: Any, otherwise: Any = None) -> Any:
        if self._error is None:
            try:
                release_interrupt()
                return function(*arguments)
            except BaseException as error:
                raise_collectively(self._comm, error)
                self._error = error
        return otherwise
