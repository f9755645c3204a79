"""Multigrid that follows its matrix where contact changes it, and is set up once.

The levels of PETSc's multigrid, and the maps between them, take as long to make as ten V-cycles.
What contact changes from one status to the next are the rows of Γc alone: each level's matrix takes
the change as the level above has it, PᵀΔP by the rows of the map P between them that are touched.
So it is the one that a new set-up with the same maps would give, for a small part of a V-cycle.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from petsc4py import PETSc

from fenics_contact.systems.operator import ContactOperator
from fenics_contact.types import Indices

__all__ = ["Hierarchy"]


class Hierarchy:
    """The levels of a solver's multigrid, as those of its matrix when `follow` was called last.

    Attributes:
        set_ups: How often all of them were made.
    """

    def __init__(self) -> None:
        self.set_ups = 0
        self._stiffness: tuple[int, int] | None = None  # which one, and how often it was changed
        self._rows: PETSc.IS | None = None
        self._block: PETSc.Mat | None = None

    def follow(
        self,
        ksp: PETSc.KSP,
        matrix: PETSc.Mat,
        stiffness: PETSc.Mat,
        operators: Sequence[ContactOperator],
    ) -> None:
        """Let a solver be one for what its matrix is now. Collective.

        Args:
            ksp: The solver.
            matrix: The stiffness, and the contacts in the unknowns that they touch. It must be the
                same as the last time.
            stiffness: That of the bulk; where it has changed all is set up anew.
            operators: Of the contacts; theirs must be the same unknowns as the last time.
        """
        pc, present = ksp.getPC(), (stiffness.handle, stiffness.stateGet())
        if self._rows is None:
            # Where there is no contact nothing changes.
            touched = [np.empty(0, dtype=np.int32), *(operator.touched for operator in operators)]
            self._rows = _numbers(matrix, np.unique(np.concatenate(touched)))
        block = matrix.createSubMatrix(self._rows, self._rows)
        if pc.getType() == PETSc.PC.Type.GAMG and self._block and present == self._stiffness:
            self._block.aypx(-1.0, block, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
            _take_down(pc, self._rows, self._block)
        else:
            pc.setReusePreconditioner(False)
            ksp.setOperators(matrix)
            ksp.setUp()
            self.set_ups += 1
        pc.setReusePreconditioner(True)
        if self._block:
            self._block.destroy()
        self._block, self._stiffness = block, present


def _take_down(pc: PETSc.PC, rows: PETSc.IS, change: PETSc.Mat) -> None:
    """Add a change of some rows and columns of the finest level to the coarser ones. Collective."""
    for level in range(pc.getMGLevels() - 1, 0, -1):
        prolongation = pc.getMGInterpolation(level)
        first, end = prolongation.getOwnershipRangeColumn()
        every = PETSc.IS().createStride(end - first, first, 1, comm=prolongation.comm)
        below = change.PtAP(prolongation.createSubMatrix(rows, every))
        coarse, _ = pc.getMGSmoother(level - 1).getOperators()
        coarse.axpy(1.0, below, PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
        pointers, *_ = below.getValuesCSR()
        rows = _numbers(below, np.flatnonzero(np.diff(pointers)).astype(np.int32))
        change = below.createSubMatrix(rows, rows)


def _numbers(matrix: PETSc.Mat, local: Indices) -> PETSc.IS:
    """Numbers among all rows of some of this rank's. Collective."""
    first, _ = matrix.getOwnershipRange()
    return PETSc.IS().createGeneral((first + local).astype(PETSc.IntType), comm=matrix.comm)
