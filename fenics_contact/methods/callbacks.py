"""SNES callbacks that store a Python exception and raise it after SNES has returned.

An exception inside a callback would become a PETSc error code and leave vectors locked. Instead the
residual is set to NaN, which ends SNES cleanly. Interrupts are deferred to the next callback.
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

__all__ = ["Callbacks", "defer_interrupts", "release_interrupt"]


class _Interrupt:
    """Handler and arguments of the deferred interrupt, global for all problems."""

    handler: Any = None
    arguments: tuple[Any, ...] = ()


def _defer(*arguments: Any) -> None:
    _Interrupt.arguments = arguments


@contextmanager
def defer_interrupts() -> Iterator[None]:
    """Defer Ctrl-C inside the block, in which PETSc calls Python, until `release_interrupt`."""
    handler = signal.getsignal(signal.SIGINT)
    main = threading.current_thread() is threading.main_thread()
    if handler is _defer or not callable(handler) or not main:
        yield
        return
    _Interrupt.handler, _Interrupt.arguments = handler, ()
    try:
        signal.signal(signal.SIGINT, _defer)
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        release_interrupt()


def release_interrupt() -> None:
    """Call the handler of a deferred interrupt, which usually raises KeyboardInterrupt."""
    arguments, _Interrupt.arguments = _Interrupt.arguments, ()
    if arguments:
        _Interrupt.handler(*arguments)


class Callbacks:
    """The callbacks of one SNES, without a reference to the SNES, which would be a cycle.

    Args:
        comm: The communicator of the SNES.
    """

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm = comm
        self._error: BaseException | None = None
        # The last residual, preceded by its x.
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
        """Set the callbacks of SNES, which must not refer to the SNES.

        Args:
            snes: The solver.
            residual: Compute the residual at x into f.
            vector: Vector for the residual.
            jacobian: Assemble the matrix at x.
            matrix: The matrix.
            reason: Return the SNES reason after ``residual``, called if the residual is finite.
        """

        def test(_: Any, iteration: int, norms: tuple[float, float, float]) -> int:
            not_finite = compat.DIVERGED_NOT_FINITE
            return (
                int(self._run(reason, otherwise=not_finite))
                if np.isfinite(norms[2])
                else not_finite
            )

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
        """Set a level function of the residual as the objective of the line search.

        Args:
            snes: The solver.
            residual: Compute the residual at x into f.
            vector: Vector for the residual, other than that of SNES.
            measure: Return the level of x and its finite residual.
        """

        def level(_: Any, x: PETSc.Vec) -> float:
            self._compute(residual, x, vector)
            finite = np.isfinite(vector.norm())
            return float(self._run(measure, x, vector, otherwise=np.nan)) if finite else np.nan

        snes.setObjective(level)

    def set_objective(self, snes: PETSc.SNES, energy: Callable[[PETSc.Vec], float]) -> None:
        """Set the energy as the objective of the line search."""
        snes.setObjective(lambda _, x: self._run(energy, x, otherwise=np.nan))

    def solve(self, snes: PETSc.SNES, x: PETSc.Vec) -> tuple[int, int]:
        """Solve from ``x`` by SNES. Collective.

        Returns:
            Iterations and reason.

        Raises:
            BaseException: The first exception raised by a callback.
            MemoryError: The factorisation ran out of memory.
        """
        try:
            with defer_interrupts():
                snes.solve(None, x)
        finally:
            self._last = ()  # the next solution may have other equations
            error, self._error = self._error, None
            try:
                if error is not None:
                    raise error
            finally:
                del error  # its traceback refers to this frame, which refers to the solvers
        dense.raise_stored_error(snes.getKSP())
        reason, pc = snes.getConvergedReason(), snes.getKSP().getPC()
        out_of_memory = reason <= 0 and self._comm.allreduce(linear.is_out_of_memory(pc))
        linear.reset_failed_factorisation(pc)
        if out_of_memory:
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
        """Return whether the last residual is that of x, as after a line search. Collective."""
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
