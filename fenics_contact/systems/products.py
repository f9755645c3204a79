"""Products DᵀBD, made often for one D: the stiffness of points in the unknowns that they feel."""

from __future__ import annotations

import numpy as np
import scipy.sparse
from petsc4py import PETSc

from fenics_contact.compat import sparse_matrix
from fenics_contact.types import Array

__all__ = ["PointProduct"]


class PointProduct:
    """DᵀBD for blocks B, one per point: every entry is a sum over fixed places of B.

    The unknowns are all on the first rank, the points where they are. What depends on D alone is
    found once; then a product costs a tenth of PETSc's. The constructor is collective.

    Args:
        felt_map: D, from the unknowns to the points, (n_points gdim, n).
        gdim: Rows of a point.
    """

    def __init__(self, felt_map: PETSc.Mat, gdim: int) -> None:
        self._comm = felt_map.comm.tompi4py()
        pointers, columns, values = felt_map.getValuesCSR()
        self._rows, n = felt_map.getSizes()[1]
        shape = felt_map.getLocalSize()[0], n
        whole = scipy.sparse.csr_matrix((values, columns, pointers), shape)
        whole.eliminate_zeros()
        n_points = shape[0] // gdim
        places, sources, factors = [], [], []
        for i in range(gdim):
            for j in range(gdim):
                left, right = whole[i::gdim], whole[j::gdim]
                # Every entry of a row on the left meets all entries of that row on the right.
                counts = np.diff(right.indptr)
                row = np.repeat(np.arange(n_points), np.diff(left.indptr))
                times = counts[row]
                first = np.repeat(np.arange(row.size), times)
                start = np.cumsum(times) - times
                second = np.repeat(right.indptr[row] - start, times) + np.arange(times.sum())
                places.append(left.indices[first].astype(np.int64) * n + right.indices[second])
                sources.append((row[first] * gdim + i) * gdim + j)
                factors.append(left.data[first] * right.data[second])
        mine, entry = np.unique(np.concatenate(places), return_inverse=True)
        self._sum = scipy.sparse.csr_matrix(
            (np.concatenate(factors), (entry.ravel(), np.concatenate(sources))),
            (mine.size, n_points * gdim * gdim),
        )
        # On the first rank the entries of all ranks, and where those of each go.
        shares = self._comm.gather(mine) or [mine[:0]]
        self._counts = [share.size for share in shares]
        entries, self._entry = np.unique(np.concatenate(shares), return_inverse=True)
        counts = np.bincount(entries // n, minlength=self._rows)
        self._pointers = np.concatenate([[0], np.cumsum(counts)])
        self._columns = entries % n

    def __call__(self, blocks: Array) -> PETSc.Mat:
        """The product, a new matrix (n, n), for blocks (n_points, gdim, gdim). Collective."""
        values = self._sum @ blocks.ravel()
        if self._comm.size > 1:
            parts = np.zeros(self._entry.size)
            self._comm.Gatherv(values, (parts, self._counts))
            values = np.bincount(self._entry, parts, minlength=self._columns.size)
        return sparse_matrix(self._comm, self._rows, self._pointers, self._columns, values)
