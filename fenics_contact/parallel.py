"""Collective errors and warnings, and small reductions and gathers over the ranks."""

from __future__ import annotations

import logging
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from fenics_contact.types import Array

__all__ = [
    "all_finite",
    "broadcast_from_root",
    "collective_errors",
    "gather_on_root",
    "gather_rows",
    "global_max",
    "global_mean",
    "global_min",
    "global_sum",
    "max_norm",
    "raise_collectively",
    "warn",
]


logger = logging.getLogger("fenics_contact")

# Seconds that a failing rank waits for the others to fail, too, and the tag of their messages.
ABORT_TIMEOUT = 30.0
_TAG = 7351


def raise_collectively(comm: MPI.Comm, error: BaseException) -> None:
    """Return if all ranks have failed; else abort all ranks after `ABORT_TIMEOUT` seconds.

    If a rank fails alone, the others wait for it in a collective call for ever (deadlock). Failing
    ranks notify each other by point-to-point messages, which do not match that call.
    """
    others = [rank for rank in range(comm.size) if rank != comm.rank]
    requests = [comm.Isend(b"", rank, _TAG) for rank in others]
    requests += [comm.Irecv(bytearray(1), rank, _TAG) for rank in others]
    deadline = time.monotonic() + ABORT_TIMEOUT
    while not MPI.Request.Testall(requests):
        if time.monotonic() > deadline:
            logger.critical(
                "rank %d failed while the others were waiting for it: aborting all ranks",
                comm.rank,
                exc_info=error,
            )
            comm.Abort(1)
        time.sleep(1e-4)


@contextmanager
def collective_errors(comm: MPI.Comm) -> Iterator[None]:
    """Raise an error of one rank inside the block on every rank. Collective at its end.

    The block must not communicate: a rank that raises leaves it early, and the others would wait.

    Raises:
        BaseException: The error of this rank, or else one with the text of the first rank that
            raised: ValueError, TypeError, MemoryError or OSError if it was one, else RuntimeError.
    """
    if comm.size == 1:
        yield
        return
    error: BaseException | None = None
    try:
        yield
    except BaseException as caught:  # an interrupt on one rank, too
        error = caught
    reports = comm.allgather(
        None if error is None else (type(error), str(error) or type(error).__name__)
    )
    first = next((report for report in reports if report is not None), None)
    if first is None:
        return
    if error is not None:
        raise error
    kind, text = first
    if issubclass(kind, OSError):
        raise OSError(text)
    raise (kind(text) if kind in (ValueError, TypeError, MemoryError) else RuntimeError(text))


def warn(comm: MPI.Comm, text: str, *, category: type[Warning] = UserWarning) -> None:
    """Warn in the log of the first rank and by a Python warning on every rank, with equal texts.

    The Python warning is on every rank because a filter may turn it into an error. The log is
    needed because FFCx redirects Python warnings to its own logger. There is no communication.
    """
    if comm.rank == 0:
        logger.warning(text)
    warnings.warn(text, category, stacklevel=3)


def broadcast_from_root(comm: MPI.Comm, value: Any) -> Any:
    """Return the first rank's value on all ranks. Collective.

    Decisions based on a redundant computation need it: round-off may differ between ranks even for
    equal input, and with it the basis of a null space or the side of a threshold.
    """
    return comm.bcast(value) if comm.size > 1 else value


def global_sum(comm: MPI.Comm, values: npt.ArrayLike) -> Array:
    """Return the sum of an array over the ranks, same shape. Collective."""
    return np.asarray(comm.allreduce(np.asarray(values, dtype=np.float64), op=MPI.SUM))


def global_max(comm: MPI.Comm, values: Array, empty: float = 0.0) -> float:
    """Return the largest entry over the ranks; ``empty`` without entries; NaN wins. Collective."""
    largest = float(values.max()) if values.size else -np.inf
    if comm.size > 1:  # MPI.MAX is undefined for NaN
        largest = float(np.max(comm.allgather(largest)))
    return empty if largest == -np.inf else largest


def global_min(comm: MPI.Comm, values: Array, empty: float = 0.0) -> float:
    """Return the smallest entry over the ranks; ``empty`` without entries; NaN wins. Collective."""
    return -global_max(comm, -np.asarray(values), -empty)


def global_mean(comm: MPI.Comm, vectors: Array) -> Array:
    """Return the mean of the rows of all ranks, (d,); zero without rows. Collective."""
    sums = global_sum(comm, [*vectors.sum(axis=0), len(vectors)])
    return np.asarray(sums[:-1] / max(sums[-1], 1.0))


def max_norm(comm: MPI.Comm, vectors: Array) -> float:
    """Return the largest Euclidean norm of rows (n, gdim), or magnitude of scalars (n,).

    Collective. The result is 0 without rows; NaN wins.
    """
    with np.errstate(over="ignore"):  # diverged states
        lengths = np.abs(vectors) if vectors.ndim == 1 else np.linalg.norm(vectors, axis=1)
    return global_max(comm, lengths)


def all_finite(comm: MPI.Comm, values: Array) -> bool:
    """Return whether the values of all ranks are finite. Collective."""
    return bool(comm.allreduce(bool(np.isfinite(values).all()), op=MPI.LAND))


def gather_rows(comm: MPI.Comm, rows: Array) -> Array:
    """Stack the rows of all ranks, in the order of the ranks, on all ranks. Collective."""
    return np.concatenate(comm.allgather(rows), axis=0)


def gather_on_root(comm: MPI.Comm, *rows: npt.NDArray[Any]) -> list[npt.NDArray[Any]] | None:
    """Stack rows of all ranks, by rank, on the first one; return None on the others. Collective."""
    parts = comm.gather(rows)
    return None if parts is None else [np.concatenate(part) for part in zip(*parts, strict=True)]
