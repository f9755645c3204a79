"""The unknowns of a problem: the dofs of the displacement, then the free motions of obstacles.

The motions are the last rows of the last rank, so that dofs keep their DOLFINx numbers.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from petsc4py import PETSc

from fenics_contact.compat import create_csr_matrix
from fenics_contact.systems.partition import Partition
from fenics_contact.types import Array, Index, Mask

__all__ = ["DofSubset", "Unknowns"]


class Unknowns:
    """The distribution of the unknowns over the ranks. The constructor is collective.

    Attributes:
        n_dofs: Number of dofs that this rank owns.
        n_motions: Number of free motions of obstacles on all ranks.
        n_local: Number of unknowns of this rank: its dofs, and on the last rank the motions.
        n_global: Number of unknowns on all ranks.
        first: Global number of the first unknown of this rank.
        first_motion: Global number of the first motion.
        motions_on: The rank that owns the motions.
        whole: All unknowns; a `DofSubset` refers to them.
        retained: Numbers of these unknowns among all of this rank, ascending.
    """

    def __init__(self, space: fem.FunctionSpace, n_motions: int = 0) -> None:
        dofmap = space.dofmap
        self.comm = space.mesh.comm
        self.whole: Unknowns = self
        self.n_dofs = dofmap.index_map.size_local * dofmap.index_map_bs
        self.n_motions = n_motions
        self.motions_on = self.comm.size - 1
        self.has_motions_here = n_motions > 0 and self.comm.rank == self.motions_on
        self.n_local = self.n_dofs + (n_motions if self.has_motions_here else 0)
        self.first = dofmap.index_map.local_range[0] * dofmap.index_map_bs
        self.first_motion = dofmap.index_map.size_global * dofmap.index_map_bs
        self.n_global = self.first_motion + n_motions
        self.retained: npt.NDArray[np.int32] = np.arange(self.n_local, dtype=np.int32)

    def vector(self) -> PETSc.Vec:
        """Create a vector over the unknowns. Collective."""
        return PETSc.Vec().createMPI((self.n_local, None), comm=self.comm)

    def joined(self, dofs: Array, motions: Array) -> Array:
        """Concatenate this rank's dofs and, on the rank that owns them, the motions."""
        return np.concatenate([dofs, motions]) if self.has_motions_here else dofs.copy()

    def motions(self, values: Array) -> Array:
        """Return the motions among the values of the unknowns, on every rank. Collective."""
        if self.n_motions == 0:
            return np.zeros(0)
        own = values[self.n_dofs :] if self.has_motions_here else None
        return np.asarray(self.comm.bcast(own, root=self.motions_on), dtype=np.float64)

    def gather(self, values: Array) -> Array:
        """Gather values at `retained` of every rank on the ranks of these unknowns. Collective.

        It is the identity except for a `DofSubset`.
        """
        return values

    def scatter(self, values: Array) -> Array:
        """Invert `gather`. Collective."""
        return values

    def widen(self, matrix: PETSc.Mat, *, rows: bool = False) -> PETSc.Mat:
        """Extend a matrix over the dofs by the motions, with zeros. Collective.

        Rows of motions get a diagonal entry, which PETSc needs for Dirichlet conditions.

        Args:
            matrix: Matrix over the dofs, returned itself if there are no motions.
            rows: Whether to extend the rows too, not the columns alone.
        """
        if self.n_motions == 0:
            return matrix
        pointers, columns, values = matrix.getValuesCSR()
        if rows:
            n_added = self.n_local - self.n_dofs
            diagonal = np.arange(n_added, dtype=columns.dtype)
            pointers = np.append(pointers, pointers[-1] + 1 + diagonal)
            columns = np.append(columns, self.first_motion + diagonal)
            values = np.append(values, np.zeros(n_added))
        return create_csr_matrix(self.comm, self.n_local, pointers, columns, values)


class DofSubset(Unknowns):
    """The retained dofs and all motions, all on the first rank. The constructor is collective.

    Args:
        whole: All unknowns.
        retained: Numbers of the retained unknowns among those of this rank, ascending.

    Attributes (besides those of `Unknowns`):
        numbers: Global numbers of the retained unknowns, ascending, on every rank.
    """

    def __init__(self, whole: Unknowns, retained: npt.NDArray[np.int32]) -> None:
        self.whole, self.retained, self.comm = whole, retained, whole.comm
        parts = self.comm.allgather(whole.first + retained.astype(np.int64))
        self._counts = [part.size for part in parts]
        self.numbers: npt.NDArray[np.int64] = np.concatenate(parts)
        self.first = 0
        self.n_motions, self.motions_on = whole.n_motions, 0
        self.has_motions_here = self.n_motions > 0 and self.comm.rank == 0
        self.n_global = self.numbers.size
        self.first_motion = self.n_global - self.n_motions
        is_first = self.comm.rank == 0
        self.n_local = self.n_global if is_first else 0
        self.n_dofs = self.first_motion if is_first else 0

    def gather(self, values: Array) -> Array:
        """Gather values at the retained unknowns on the first rank, (n_local,). Collective."""
        if self.comm.size == 1:
            return values
        result = np.zeros(self.n_local)
        self.comm.Gatherv(np.ascontiguousarray(values, dtype=np.float64), (result, self._counts))
        return result

    def gather_partition(self, partition: Partition) -> Partition:
        """Return the partition of the retained unknowns, on the first rank. Collective."""
        label = self.gather(partition.label[self.retained].astype(np.float64))
        return Partition(label.astype(np.intp), partition.n_parts)

    def scatter(self, values: Array) -> Array:
        """Scatter values from the first rank to the owners. Collective."""
        if self.comm.size == 1:
            return values
        result = np.zeros(self.retained.size)
        self.comm.Scatterv((np.ascontiguousarray(values, dtype=np.float64), self._counts), result)
        return result

    def contains(self, numbers: Index) -> Mask:
        """Return the mask of the global numbers that are retained."""
        return self._find(numbers)[1]

    def _find(self, numbers: Index) -> tuple[Index, Mask]:
        """Return positions among the retained unknowns and a mask of those that exist."""
        position = np.searchsorted(self.numbers, numbers)
        position[position == self.n_global] = 0
        return position, self.numbers[position] == numbers

    def widen(self, matrix: PETSc.Mat, *, rows: bool = False) -> PETSc.Mat:
        """Select the columns of the retained dofs, with zeros at the motions. Collective.

        Raises:
            NotImplementedError: With ``rows``.
        """
        if rows:
            raise NotImplementedError("rows of a selection")
        pointers, columns, values = matrix.getValuesCSR()
        position, is_retained = self._find(columns)
        pointers = np.concatenate([[0], np.cumsum(is_retained)])[pointers]
        return create_csr_matrix(
            self.comm, self.n_local, pointers, position[is_retained], values[is_retained]
        )
