"""Sums, norms and largest values of forces and displacements by body and free obstacle."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import scipy.linalg.blas
from mpi4py import MPI

from fenics_contact.parallel import global_sum
from fenics_contact.types import Array, Index, Mask

__all__ = ["Partition", "norms_by_part"]


class Partition:
    """The parts to which the entries of a vector belong.

    Entries are selected by slices where a part is contiguous, as with a single body: masks and
    weighted counts take ten times as long.

    Args:
        label: Part of every entry, (n,).
        n_parts: Number of parts.

    Attributes:
        label: Part of every entry, (n,).
        n_parts: Number of parts.
        sizes: Number of entries of every part, (n_parts,).
    """

    def __init__(self, label: npt.NDArray[np.intp], n_parts: int) -> None:
        self.label, self.n_parts = label, n_parts
        order = np.argsort(label, kind="stable")
        ends = np.searchsorted(label[order], np.arange(n_parts + 1))
        self.sizes: Array = np.diff(ends).astype(np.float64)
        self._entries = [_as_slice(order[i:j]) for i, j in pairwise(ends)]

    def restrict(self, entries: Index | Mask) -> Partition:
        """Return the partition of some entries, given by numbers or a mask."""
        return Partition(self.label[entries], self.n_parts)

    def _split(self, values: Array) -> list[Array]:
        """Return the values of every part."""
        return [values[entries] for entries in self._entries]

    def absolute_sums(self, values: Array) -> Array:
        """Return the sums of absolute values, (n,), by part, (n_parts,)."""
        return np.array([np.abs(part).sum() for part in self._split(values)], dtype=np.float64)

    def products(self, one: Array, other: Array) -> Array:
        """Return the scalar products of two vectors, (n,), by part, (n_parts,)."""
        parts = zip(self._split(one), self._split(other), strict=True)
        return np.array([a @ b for a, b in parts], dtype=np.float64)

    def norms(self, values: Array) -> Array:
        """Return the Euclidean norms of values, (n,), by part, (n_parts,), without overflow."""
        parts = self._split(values)
        return np.array([scipy.linalg.blas.dnrm2(p) if p.size else 0.0 for p in parts])

    def largest(self, values: Array) -> Array:
        """Return the largest absolute values of (n,) by part, (n_parts,)."""
        parts = self._split(values)
        return np.array([np.abs(part).max(initial=0.0) for part in parts], dtype=np.float64)

    def scale(self, values: Array, factors: Array) -> Array:
        """Return values, (n,), times the factor of their part, (n_parts,)."""
        result = values.copy()
        for entries, factor in zip(self._entries, factors, strict=True):
            result[entries] *= factor
        return result


def norms_by_part(comm: MPI.Comm, n_parts: int, rows: Sequence[tuple[Array, Partition]]) -> Array:
    """Return the norms of vectors by part, over all ranks, (n_vectors, n_parts). Collective.

    They are scaled against overflow and underflow. The norms of a vector with an entry that is not
    finite are NaN for all parts.
    """
    local = np.array([partition.norms(values) for values, partition in rows]).reshape(-1, n_parts)
    largest = local.max(axis=1, initial=0.0)
    largest[np.isnan(largest)] = np.inf  # the maximum of MPI has no rule for NaN
    comm.Allreduce(MPI.IN_PLACE, largest, op=MPI.MAX)
    scales = np.where((largest > 0.0) & np.isfinite(largest), largest, 1.0)[:, None]
    with np.errstate(all="ignore"):
        norms = scales * np.sqrt(global_sum(comm, (local / scales) ** 2))
    return np.where(np.isfinite(largest)[:, None], norms, np.nan)


def _as_slice(entries: Index) -> slice | Index:
    """Return the slice of consecutive numbers, or the numbers themselves."""
    if entries.size and entries[-1] - entries[0] == entries.size - 1:
        return slice(entries[0], entries[-1] + 1)
    return entries
