"""Products DᵀBD, made often for one D: the stiffness of points in the unknowns that they feel."""

from __future__ import annotations

import numpy as np
import scipy.sparse
from petsc4py import PETSc

from fenics_contact.types import Array

__all__ = ["PointProduct"]


class PointProduct:
    """DᵀBD for blocks B, one per point: every entry is a sum over fixed places of B. One rank only.

    What depends on D alone is found once; then a product costs a tenth of PETSc's.
    """

    def __init__(self, felt_map: PETSc.Mat, gdim: int) -> None:
        """Find which places of B go where.

        Args:
            felt_map: D, from the unknowns to the points, (n_points gdim, n).
            gdim: Rows of a point.
        """
        pointers, columns, values = felt_map.getValuesCSR()
        shape = felt_map.getSize()
        whole = scipy.sparse.csr_matrix((values, columns, pointers), shape)
        whole.eliminate_zeros()
        n_points, n = shape[0] // gdim, shape[1]
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
        entries, entry = np.unique(np.concatenate(places), return_inverse=True)
        self._sum = scipy.sparse.csr_matrix(
            (np.concatenate(factors), (entry.ravel(), np.concatenate(sources))),
            (entries.size, n_points * gdim * gdim),
        )
        counts = np.bincount(entries // n, minlength=n)
        self._pointers = np.concatenate([[0], np.cumsum(counts)]).astype(PETSc.IntType)
        self._columns = (entries % n).astype(PETSc.IntType)
        self._size = n

    def __call__(self, blocks: Array) -> PETSc.Mat:
        """The product, a new matrix (n, n), for blocks (n_points, gdim, gdim)."""
        return PETSc.Mat().createAIJ(
            (self._size, self._size),
            csr=(self._pointers, self._columns, self._sum @ blocks.ravel()),
            comm=PETSc.COMM_SELF,
        )
