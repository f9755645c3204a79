"""Errors that every rank raises, and small reductions over the ranks."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

__all__ = ["collective_errors", "gather_rows", "global_max", "global_min", "global_sum"]


@contextmanager
def collective_errors(comm: MPI.Comm) -> Iterator[None]:
    """Raise on every rank what one rank raised inside the block. Collective at its end.

    The block must not communicate: a rank that raises leaves it early, and the others would wait.

    Raises:
        Exception: The error of this rank, or else the same type and text as on the first rank
            that raised (types that cannot be rebuilt from their text become RuntimeError).
    """
    if comm.size == 1:
        yield
        return
    error: Exception | None = None
    try:
        yield
    except Exception as caught:
        error = caught
    reports = comm.allgather(None if error is None else (type(error), str(error)))
    first = next((report for report in reports if report is not None), None)
    if first is None:
        return
    if error is not None:
        raise error
    kind, text = first
    raise (kind(text) if kind in (ValueError, TypeError) else RuntimeError(text))


def global_sum(comm: MPI.Comm, values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Sum of an array over the ranks, same shape. Collective."""
    return np.asarray(comm.allreduce(np.asarray(values, dtype=np.float64), op=MPI.SUM))


def global_max(comm: MPI.Comm, values: npt.NDArray[np.float64], empty: float = 0.0) -> float:
    """Largest entry over the ranks; ``empty`` where no rank has one; NaN wins. Collective."""
    local = float(np.max(values)) if values.size else -np.inf
    # max() of MPI has no rule for NaN, so it goes through a gather.
    largest = float(np.max(comm.allgather(local)))
    return empty if largest == -np.inf else largest


def global_min(comm: MPI.Comm, values: npt.NDArray[np.float64], empty: float = 0.0) -> float:
    """Smallest entry over the ranks; ``empty`` where no rank has one; NaN wins. Collective."""
    return -global_max(comm, -np.asarray(values), -empty)


def gather_rows(comm: MPI.Comm, rows: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Stack the rows of all ranks, in the order of the ranks, on all ranks. Collective."""
    return np.concatenate(comm.allgather(rows), axis=0)
