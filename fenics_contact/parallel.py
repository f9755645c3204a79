"""Errors that every rank raises, and small reductions over the ranks."""

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
    "gather_on_first",
    "gather_rows",
    "global_max",
    "global_mean",
    "global_min",
    "global_sum",
    "longest",
    "raise_collectively",
    "warn",
]


logger = logging.getLogger("fenics_contact")

# How long ranks that fail together may be apart (seconds), and the tag of their messages.
PATIENCE = 30.0
_TAG = 7351


def raise_collectively(comm: MPI.Comm, error: BaseException) -> None:
    """Come back where all ranks have failed; end all of them where this one is alone.

    A rank that fails where others do not is waited for by them in some collective call, for ever:
    no rank can go on, nor take back what was begun. The failures are told to one another by
    messages, which are not taken for a part of that call.
    """
    others = [rank for rank in range(comm.size) if rank != comm.rank]
    requests = [comm.Isend(b"", rank, _TAG) for rank in others]
    requests += [comm.Irecv(bytearray(1), rank, _TAG) for rank in others]
    end = time.monotonic() + PATIENCE
    while not MPI.Request.Testall(requests):
        if time.monotonic() > end:
            logger.critical(
                "rank %d failed while the others were waiting for it: aborting all ranks",
                comm.rank,
                exc_info=error,
            )
            comm.Abort(1)
        time.sleep(1e-4)


@contextmanager
def collective_errors(comm: MPI.Comm) -> Iterator[None]:
    """Raise on every rank what one rank raised inside the block. Collective at its end.

    The block must not communicate: a rank that raises leaves it early, and the others would wait.

    Raises:
        BaseException: The error of this rank, or else the same type and text as on the first rank
            that raised (those of OSError become that, and types that cannot be rebuilt from their
            text RuntimeError).
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
    """Warn: in the log of the first rank, and by a Python warning on every rank.

    On all of them, because a warning may have been made an error. In the log, because FFCx leads
    Python's warnings into one of its own, which nobody sees where logging has not been set up.
    Nothing is communicated: the text is the same on every rank.
    """
    if comm.rank == 0:
        logger.warning(text)
    warnings.warn(text, category, stacklevel=3)


def broadcast_from_root(comm: MPI.Comm, value: Any) -> Any:
    """The first rank's value, on all ranks. Collective.

    For what every rank computes of the same numbers and then decides by: factorisations of equal
    matrices may differ in the last digits, between machines or by where in memory they are, and
    with them the basis of a null space, or the side of a threshold.
    """
    return comm.bcast(value) if comm.size > 1 else value


def global_sum(comm: MPI.Comm, values: npt.ArrayLike) -> Array:
    """Sum of an array over the ranks, same shape. Collective."""
    return np.asarray(comm.allreduce(np.asarray(values, dtype=np.float64), op=MPI.SUM))


def global_max(comm: MPI.Comm, values: Array, empty: float = 0.0) -> float:
    """Largest entry over the ranks; ``empty`` where no rank has one; NaN wins. Collective."""
    largest = float(values.max()) if values.size else -np.inf
    if comm.size > 1:  # max() of MPI has no rule for NaN, so it goes through a gather
        largest = float(np.max(comm.allgather(largest)))
    return empty if largest == -np.inf else largest


def global_min(comm: MPI.Comm, values: Array, empty: float = 0.0) -> float:
    """Smallest entry over the ranks; ``empty`` where no rank has one; NaN wins. Collective."""
    return -global_max(comm, -np.asarray(values), -empty)


def global_mean(comm: MPI.Comm, vectors: Array) -> Array:
    """Mean of the rows of all ranks, (d,); zero if there are none. Collective."""
    sums = global_sum(comm, [*vectors.sum(axis=0), len(vectors)])
    return np.asarray(sums[:-1] / max(sums[-1], 1.0))


def longest(comm: MPI.Comm, vectors: Array) -> float:
    """Length of the longest row over the ranks, in any frame; 0 without rows; NaN wins. Collective.

    Args:
        comm: The ranks.
        vectors: (n, gdim); numbers, (n,), count by their size.
    """
    with np.errstate(over="ignore"):  # of a diverged state
        lengths = np.abs(vectors) if vectors.ndim == 1 else np.linalg.norm(vectors, axis=1)
    return global_max(comm, lengths)


def all_finite(comm: MPI.Comm, values: Array) -> bool:
    """Whether all of the ranks' values are numbers, and finite. Collective."""
    return bool(comm.allreduce(bool(np.isfinite(values).all()), op=MPI.LAND))


def gather_rows(comm: MPI.Comm, rows: Array) -> Array:
    """Stack the rows of all ranks, in the order of the ranks, on all ranks. Collective."""
    return np.concatenate(comm.allgather(rows), axis=0)


def gather_on_first(comm: MPI.Comm, *rows: npt.NDArray[Any]) -> list[npt.NDArray[Any]] | None:
    """Stack rows of all ranks as `gather_rows`, on the first; None on the others. Collective."""
    parts = comm.gather(rows)
    return None if parts is None else [np.concatenate(part) for part in zip(*parts, strict=True)]
