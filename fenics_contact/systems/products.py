"""Products DᵀBD for many block-diagonal B and one D: stiffness of the points at the unknowns."""

from __future__ import annotations

import numpy as np
import scipy.sparse
from petsc4py import PETSc

from fenics_contact.compat import create_csr_matrix
from fenics_contact.types import Array

__all__ = ["PointProduct"]


class PointProduct:
    """DᵀBD for one block of B per point: every entry is a fixed linear combination of B.

    All unknowns are on the first rank, the points on any. The structure is computed once; a product
    then takes a tenth of PETSc's time. The constructor is collective.

    Args:
        jump_map: D, from the unknowns to the points, (n_points gdim, n).
        gdim: Number of rows of a point.
    """

    def __init__(self, jump_map: PETSc.Mat, gdim: int) -> None:
        self._comm = jump_map.comm.tompi4py()
        pointers, columns, values = jump_map.getValuesCSR()
        self._rows, n = jump_map.getSizes()[1]
        shape = jump_map.getLocalSize()[0], n
        matrix = scipy.sparse.csr_matrix((values, columns, pointers), shape)
        matrix.eliminate_zeros()
        n_points = shape[0] // gdim
        entries, sources, factors = [], [], []
        for i in range(gdim):
            for j in range(gdim):
                left, right = matrix[i::gdim], matrix[j::gdim]
                # Pairs of entries in equal rows on the left and on the right.
                counts = np.diff(right.indptr)
                row = np.repeat(np.arange(n_points), np.diff(left.indptr))
                repeats = counts[row]
                first = np.repeat(np.arange(row.size), repeats)
                start = np.cumsum(repeats) - repeats
                second = np.repeat(right.indptr[row] - start, repeats) + np.arange(repeats.sum())
                entries.append(left.indices[first].astype(np.int64) * n + right.indices[second])
                sources.append((row[first] * gdim + i) * gdim + j)
                factors.append(left.data[first] * right.data[second])
        own, entry = np.unique(np.concatenate(entries), return_inverse=True)
        self._sum = scipy.sparse.csr_matrix(
            (np.concatenate(factors), (entry.ravel(), np.concatenate(sources))),
            (own.size, n_points * gdim * gdim),
        )
        # Entries of all ranks on the first one, and their positions in the sum.
        parts = self._comm.gather(own) or [own[:0]]
        self._counts = [part.size for part in parts]
        all_entries, self._entry = np.unique(np.concatenate(parts), return_inverse=True)
        counts = np.bincount(all_entries // n, minlength=self._rows)
        self._pointers = np.concatenate([[0], np.cumsum(counts)])
        self._columns = all_entries % n

    def __call__(self, blocks: Array) -> PETSc.Mat:
        """Return the product, (n, n), for blocks (n_points, gdim, gdim). Collective."""
        values = self._sum @ blocks.ravel()
        if self._comm.size > 1:
            parts = np.zeros(self._entry.size)
            self._comm.Gatherv(values, (parts, self._counts))
            values = np.bincount(self._entry, parts, minlength=self._columns.size)
        return create_csr_matrix(self._comm, self._rows, self._pointers, self._columns, values)
