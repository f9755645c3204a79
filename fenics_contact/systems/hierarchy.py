"""Multigrid with low-rank updates of its levels where contact changes the matrix.

The set-up of PETSc's multigrid costs ten V-cycles. A change of status changes the rows of Γc alone,
and the matrix of each coarser level by PᵀΔP, in the rows of the prolongation P that are affected.
The result equals a new set-up with the same prolongations, for a fraction of a V-cycle.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from petsc4py import PETSc

from fenics_contact.systems.operator import ContactOperator
from fenics_contact.types import Indices

__all__ = ["Hierarchy"]


class Hierarchy:
    """The levels of a solver's multigrid, updated by `follow`.

    Attributes:
        set_ups: Number of complete set-ups.
    """

    def __init__(self) -> None:
        self.set_ups = 0
        self._stiffness: tuple[int, int] | None = None  # handle and state of the Mat
        self._rows: PETSc.IS | None = None
        self._block: PETSc.Mat | None = None

    def follow(
        self,
        ksp: PETSc.KSP,
        matrix: PETSc.Mat,
        stiffness: PETSc.Mat,
        operators: Sequence[ContactOperator],
    ) -> None:
        """Update the levels of a solver to its present matrix. Collective.

        Args:
            ksp: The solver.
            matrix: Bulk stiffness plus contact, the same object as in the last call.
            stiffness: Bulk stiffness; if it has changed, all levels are set up again.
            operators: Contact operators, which couple the same unknowns as in the last call.
        """
        pc, present = ksp.getPC(), (stiffness.handle, stiffness.stateGet())
        if self._rows is None:
            coupled = [
                np.empty(0, dtype=np.int32),
                *(operator.coupled_dofs for operator in operators),
            ]
            self._rows = _global_rows(matrix, np.unique(np.concatenate(coupled)))
        block = matrix.createSubMatrix(self._rows, self._rows)
        if pc.getType() == PETSc.PC.Type.GAMG and self._block and present == self._stiffness:
            self._block.aypx(-1.0, block, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
            _update_coarse_levels(pc, self._rows, self._block)
        else:
            pc.setReusePreconditioner(False)
            ksp.setOperators(matrix)
            ksp.setUp()
            self.set_ups += 1
        pc.setReusePreconditioner(True)
        if self._block:
            self._block.destroy()
        self._block, self._stiffness = block, present


def _update_coarse_levels(pc: PETSc.PC, rows: PETSc.IS, change: PETSc.Mat) -> None:
    """Add a change of rows and columns of the finest level to all others. Collective."""
    for level in range(pc.getMGLevels() - 1, 0, -1):
        prolongation = pc.getMGInterpolation(level)
        first, end = prolongation.getOwnershipRangeColumn()
        columns = PETSc.IS().createStride(end - first, first, 1, comm=prolongation.comm)
        product = change.PtAP(prolongation.createSubMatrix(rows, columns))
        coarse, _ = pc.getMGSmoother(level - 1).getOperators()
        coarse.axpy(1.0, product, PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
        pointers, *_ = product.getValuesCSR()
        rows = _global_rows(product, np.flatnonzero(np.diff(pointers)).astype(np.int32))
        change = product.createSubMatrix(rows, rows)


def _global_rows(matrix: PETSc.Mat, local: Indices) -> PETSc.IS:
    """Return an index set of some of this rank's rows. Collective."""
    first, _ = matrix.getOwnershipRange()
    return PETSc.IS().createGeneral((first + local).astype(PETSc.IntType), comm=matrix.comm)
