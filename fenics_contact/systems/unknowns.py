"""The unknowns of a problem: the dofs of the displacement, then the free motions of obstacles.

The motions stand at the end of the last rank's rows, so that the global numbers of the dofs are
those of DOLFINx with them and without them.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from petsc4py import PETSc

from fenics_contact.compat import sparse_matrix
from fenics_contact.types import Array, Index, Mask

__all__ = ["DofSubset", "Unknowns"]


class Unknowns:
    """How the unknowns lie on the ranks. The constructor is collective.

    Attributes:
        n_dofs: Dofs of the displacement that this rank owns.
        n_motions: Free motions of obstacles, in all.
        n_local: Unknowns of this rank: its dofs, and the motions on the last one.
        n_global: Unknowns of all ranks.
        first: Global number of the first one of this rank.
        first_motion: Global number of the first motion.
        motions_on: The rank that has them.
        whole: All unknowns, of which these may be a `DofSubset`.
        retained: Numbers of these among this rank's share of all, ascending.
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
        """A new vector over the unknowns. Collective."""
        return PETSc.Vec().createMPI((self.n_local, None), comm=self.comm)

    def joined(self, dofs: Array, motions: Array) -> Array:
        """This rank's unknowns, of its dofs and all motions."""
        return np.concatenate([dofs, motions]) if self.has_motions_here else dofs.copy()

    def motions(self, values: Array) -> Array:
        """The motions out of the ranks' unknowns, on every rank. Collective."""
        if self.n_motions == 0:
            return np.zeros(0)
        mine = values[self.n_dofs :] if self.has_motions_here else None
        return np.asarray(self.comm.bcast(mine, root=self.motions_on), dtype=np.float64)

    def gathered(self, values: Array) -> Array:
        """Values at this rank's unknowns, of those at `retained` on every rank. Collective.

        The same, but for a `DofSubset`.
        """
        return values

    def scattered(self, values: Array) -> Array:
        """The inverse of `gathered`. Collective."""
        return values

    def widened(self, matrix: PETSc.Mat, *, rows: bool = False) -> PETSc.Mat:
        """A matrix over the dofs as one over the unknowns, zero at the motions. Collective.

        Rows of motions have their diagonal entry: PETSc sets conditions in no others.

        Args:
            matrix: Its columns, and with ``rows`` its rows too, are dofs. Returned itself where
                there are no motions.
            rows: Whether the rows are widened too.
        """
        if self.n_motions == 0:
            return matrix
        pointers, columns, values = matrix.getValuesCSR()
        if rows:
            added = self.n_local - self.n_dofs
            more = np.arange(added, dtype=columns.dtype)
            pointers = np.append(pointers, pointers[-1] + 1 + more)
            columns = np.append(columns, self.first_motion + more)
            values = np.append(values, np.zeros(added))
        return sparse_matrix(self.comm, self.n_local, pointers, columns, values)


class DofSubset(Unknowns):
    """Some of the dofs and all of the motions, all of them on the first rank.

    The constructor is collective.

    Args:
        whole: All unknowns.
        retained: Numbers of the dofs and motions among this rank's, ascending.

    Attributes are those of `Unknowns`, and
        numbers: Of these unknowns among all of all ranks, ascending; the same on every rank.
    """

    def __init__(self, whole: Unknowns, retained: npt.NDArray[np.int32]) -> None:
        self.whole, self.retained, self.comm = whole, retained, whole.comm
        shares = self.comm.allgather(whole.first + retained.astype(np.int64))
        self._counts = [share.size for share in shares]
        self.numbers: npt.NDArray[np.int64] = np.concatenate(shares)
        self.first = 0
        self.n_motions, self.motions_on = whole.n_motions, 0
        self.has_motions_here = self.n_motions > 0 and self.comm.rank == 0
        self.n_global = self.numbers.size
        self.first_motion = self.n_global - self.n_motions
        here = self.comm.rank == 0
        self.n_local = self.n_global if here else 0
        self.n_dofs = self.first_motion if here else 0

    def gathered(self, values: Array) -> Array:
        """See `Unknowns.gathered`: on the first rank, (n_local,)."""
        if self.comm.size == 1:
            return values
        result = np.zeros(self.n_local)
        self.comm.Gatherv(np.ascontiguousarray(values, dtype=np.float64), (result, self._counts))
        return result

    def scattered(self, values: Array) -> Array:
        """See `Unknowns.scattered`: to the ranks whose they are."""
        if self.comm.size == 1:
            return values
        result = np.zeros(self.retained.size)
        self.comm.Scatterv((np.ascontiguousarray(values, dtype=np.float64), self._counts), result)
        return result

    def has(self, numbers: Index) -> Mask:
        """Which of all unknowns, by their global numbers, are among these."""
        return self._found(numbers)[1]

    def _found(self, numbers: Index) -> tuple[Index, Mask]:
        """Their places among these, and whether they are there."""
        position = np.searchsorted(self.numbers, numbers)
        position[position == self.n_global] = 0
        return position, self.numbers[position] == numbers

    def widened(self, matrix: PETSc.Mat, *, rows: bool = False) -> PETSc.Mat:
        """Of a matrix over the dofs the columns selected; zero at the motions; a new matrix.

        Collective.

        Raises:
            NotImplementedError: With ``rows``.
        """
        if rows:
            raise NotImplementedError("rows of a selection")
        pointers, columns, values = matrix.getValuesCSR()
        position, found = self._found(columns)
        pointers = np.concatenate([[0], np.cumsum(found)])[pointers]
        return sparse_matrix(self.comm, self.n_local, pointers, position[found], values[found])
