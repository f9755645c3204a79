"""Contact operator: the sparse matrix D from the unknowns to the jump at the points of Γc.

D maps the unknowns to the jump of the displacement at the quadrature points, the contact law maps
the jump to tractions, and -Dᵀ, weighted by the quadrature weights, maps tractions to nodal forces,
eq. (10). The law is evaluated on Γc only, whatever the element of the bulk.

D is constant except for one column: the derivative of the jump with respect to the angle of an
obstacle that is rotated by a moment is -ω × r at the present position. The unknown is the length L
times the angle, so that this column is divided by L.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from petsc4py import PETSc

from fenics_contact.compat import create_csr_matrix
from fenics_contact.contact.contact import Contact
from fenics_contact.contact.point_law import PointTangent
from fenics_contact.parallel import global_sum
from fenics_contact.systems.products import PointProduct
from fenics_contact.systems.unknowns import DofSubset, Unknowns
from fenics_contact.types import Array, Indices, Mask

__all__ = ["ContactOperator"]


class ContactOperator:
    """Residual and tangent of a contact over the unknowns, assembled with the matrix D, eq. (10).

    Use it to add a contact to a nonlinear solver of your own. It remains valid as long as the pairs
    and the unknowns do not change. The constructor is collective.

    Args:
        contact: The contact, whose present state is used.
        unknowns: Unknowns of a problem, or a selection of them; by default the dofs of the
            displacement function.
        first_motion: Number of this contact's first unknown motion among all unknown motions.

    Attributes:
        contact: The contact.
        unknowns: The unknowns of all vectors and matrices.
        within: Mask of this rank's points that depend on selected unknowns only, (n_points,). The
            jump and the tractions of other points are zero here. None: all points of all ranks.
    """

    def __init__(
        self, contact: Contact, unknowns: Unknowns | None = None, first_motion: int = 0
    ) -> None:
        self.contact = contact
        displacement = contact.displacement
        self.unknowns = unknowns or Unknowns(displacement.whole.function_space)
        self._gdim = contact.surface.mesh.geometry.dim
        self._first = self.unknowns.first_motion + first_motion
        jump_map = self.unknowns.widen(displacement.expand_columns(contact.pairs.jump_map))
        self._of_bodies = _drop_zeros(jump_map)
        self.within = self._find_within()
        self._motions: PETSc.Mat | None = None
        self._map = self._of_bodies
        self._restrict_rows(self._of_bodies)
        if contact.free_motion:
            self._motions = self._motion_map()
            self._restrict_rows(self._motions)
            self._map = self._of_bodies.copy()
            different = PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN
            self._map.axpy(-1.0, self._motions, different)
        # Number of the angle's unknown, if any, and L.
        self._angle: int | None = None
        self._length = 1.0
        for number, motion in enumerate(contact.motions):
            if motion.turns:
                self._angle, self._length = self._first + number, motion.length
        self._at_points = self._map.createVecLeft()

    def _find_within(self) -> Mask | None:
        """Return the mask ``within``, or None if all points are within. Collective.

        With finite kinematics all unknowns that pairs may couple are selected, except round-off of
        functions that are zero on facets.
        """
        if (
            not isinstance(self.unknowns, DofSubset)
            or self.contact.contact_kinematics.pairs_follow_bodies
        ):
            return None
        pointers, columns, values = self.contact.pairs.jump_map.getValuesCSR()
        row = np.repeat(np.arange(pointers.size - 1), np.diff(pointers))
        is_lost = (values != 0.0) & ~self.unknowns.contains(columns)
        within = np.ones(self.contact.quadrature.n_points, dtype=np.bool_)
        within[row[is_lost] // self._gdim] = False
        return within if self.unknowns.comm.allreduce(int(not within.all())) else None

    def _restrict_rows(self, matrix: PETSc.Mat) -> None:
        """Set the rows of points that are not within to zero. Collective."""
        if self.within is not None:
            rows = matrix.createVecLeft()
            rows.array[:] = np.repeat(self.within, self._gdim)
            matrix.diagonalScale(rows, None)
            rows.destroy()

    def _motion_map(self) -> PETSc.Mat:
        """Create the map from the unknowns to the motion of the obstacle. Collective."""
        contact, d = self.contact, self._gdim
        n, components = contact.quadrature.n_points, list(contact.free_motion)
        counts = np.tile(np.isin(np.arange(d), components), n)
        columns = np.tile(self._first + np.arange(len(components)), n)
        pointers = np.concatenate([[0], np.cumsum(counts)])
        ones = np.ones(columns.size)
        return create_csr_matrix(self.unknowns.comm, self.unknowns.n_local, pointers, columns, ones)

    @cached_property
    def coupled_dofs(self) -> Indices:
        """This rank's unknowns that the contact couples, ascending. Collective."""
        return self.find_dofs(np.ones(self.contact.quadrature.n_points, dtype=np.bool_))

    @property
    def possible_dofs(self) -> Indices:
        """This rank's unknowns that the contact may couple, now or later. Collective."""
        pairs, displacement = self.contact.pairs, self.contact.displacement
        if not self.contact.contact_kinematics.pairs_follow_bodies:
            return self.coupled_dofs
        reach = self.unknowns.widen(displacement.expand_columns(pairs.coupling_map))
        return self._coupled(reach, np.ones(reach.getLocalSize()[0]))

    def find_dofs(self, chosen: Mask) -> Indices:
        """Return this rank's unknowns that chosen points couple, ascending. Collective."""
        return self._coupled(self._map, np.repeat(chosen, self._gdim))

    def _coupled(self, matrix: PETSc.Mat, rows: Array | Mask) -> Indices:
        """Return the columns with an entry in chosen rows, and the angle. Collective."""
        pointers, columns, values = matrix.getValuesCSR()
        pattern = (values != 0.0).astype(np.float64)
        indicator = create_csr_matrix(
            matrix.comm, matrix.getLocalSize()[1], pointers, columns, pattern
        )
        points, counts = indicator.createVecLeft(), indicator.createVecRight()
        points.array[:] = rows
        indicator.multTranspose(points, counts)
        coupled = counts.array_r > 0.0
        if self._angle is not None and self.unknowns.has_motions_here:
            coupled[self._angle - self.unknowns.first] = True
        for item in (indicator, points, counts):
            item.destroy()
        return np.flatnonzero(coupled).astype(np.int32)

    def jump(self, values: Array) -> Array:
        """Return the displacement relative to the obstacle at the points, D u. Collective.

        Args:
            values: This rank's unknowns, (n_local,) (length).

        Returns:
            Array (n_points, gdim) (length).
        """
        vector = self._map.createVecRight()
        vector.array[:] = values
        self._map.mult(vector, self._at_points)
        vector.destroy()
        jump = self._at_points.array_r.reshape(-1, self._gdim).copy()
        if self._angle is not None:
            angle = self.unknowns.motions(values)[self._angle - self.unknowns.first_motion]
            jump -= angle * self._arms()
        return jump

    def add_force(self, residual: PETSc.Vec, traction: Array | None = None) -> None:
        """Add minus the nodal forces of the contact tractions to a residual. Collective.

        Args:
            residual: Vector over the unknowns, to which the forces are added (force).
            traction: Tractions on the body, (n_points, gdim) (stress); by default those of the law
                at the present ``u``, which adds the assembled `Contact.form`.
        """
        if traction is None:
            traction = self.contact.effective_law.traction()
        force = self.contact.area[:, None] * traction
        self._at_points.array[:] = -force.ravel()
        self._map.multTransposeAdd(self._at_points, residual, residual)
        if self._angle is not None:
            moment = float(global_sum(self.unknowns.comm, np.sum(self._arms() * force)))
            if self.unknowns.has_motions_here:
                residual.array[self._angle - self.unknowns.first] += moment

    def springs(self, stiffness: Array) -> PETSc.Mat:
        """Assemble a stiffness at the points, Dᵀ W k D. Collective.

        Args:
            stiffness: Stiffness k at the points, (n_points, gdim, gdim) (stress/length).

        Returns:
            A new matrix over the unknowns (force/length).
        """
        blocks = self.contact.area[:, None, None] * stiffness
        follows = self.contact.contact_kinematics.pairs_follow_bodies  # then D changes each time
        if isinstance(self.unknowns, DofSubset) and self._angle is None and not follows:
            return self._product(blocks)
        if self._angle is None:
            return self._assemble_product(blocks, self._map)
        present = self._present_map(self._angle)
        product = self._assemble_product(blocks, present)
        present.destroy()
        return product

    def tangent(self, tangent: PointTangent | None = None) -> PETSc.Mat:
        """Assemble the consistent tangent, the derivative of `add_force`. Collective.

        Args:
            tangent: Derivatives of the tractions; by default those of the law at the present ``u``.

        Returns:
            A new matrix over the unknowns (force/length).
        """
        tangent = tangent or self.contact.effective_law.tangent()
        local = self.contact.pairs.local_map
        if local is not None:  # finite sliding; see `FiniteSlidingPairs.tangent`
            lifted = self.unknowns.widen(self.contact.displacement.expand_columns(local))
            return self._assemble_product(
                -self.contact.area[:, None, None] * tangent.by_jump, lifted
            )
        if tangent.by_rotation is not None and self._angle is not None:
            product = self.springs(-tangent.by_jump)
            self._add_rotation(product, tangent.by_rotation, self._angle)
            return product
        if tangent.by_shift is None:
            return self.springs(-tangent.by_jump)
        # The normals at a moving obstacle may rotate, so that ∂/∂shift is not -∂/∂jump.
        area = -self.contact.area[:, None, None]
        jumps = self._block_diagonal(area * tangent.by_jump, self._map)
        shifts = self._block_diagonal(area * tangent.by_shift, self._map)
        right, by_shift = jumps.matMult(self._of_bodies), shifts.matMult(self._motions)
        right.axpy(1.0, by_shift, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        product = self._map.transposeMatMult(right)
        for item in (jumps, shifts, right, by_shift):
            item.destroy()
        return product

    # ---- an obstacle that is rotated by a moment -------------------------------------------------

    def _arms(self) -> Array:
        """Return ω × r / L, minus the derivative of the jump by the angle times L. Collective.

        Returns:
            Array (n_points, gdim); zero where a point is not within.
        """
        arms = np.asarray(
            self.contact.contact_kinematics.rotation_derivative() / self._length, dtype=np.float64
        )
        return arms if self.within is None else np.where(self.within[:, None], arms, 0.0)

    def _present_map(self, column: int) -> PETSc.Mat:
        """Create D at the present angle. Collective."""
        arms = self._arms()
        rows = np.arange(arms.size, dtype=np.int32)
        column_map = self._column_matrix(arms.size, column, rows, -arms.ravel())
        present = self._map.copy()
        present.axpy(1.0, column_map, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        column_map.destroy()
        return present

    def _column_matrix(self, n_rows: int, column: int, rows: Indices, values: Array) -> PETSc.Mat:
        """Create a matrix with one nonzero column, in given local rows, ascending."""
        pointers = np.searchsorted(rows, np.arange(n_rows + 1))
        columns, unknowns = np.full(len(values), column), self.unknowns
        return create_csr_matrix(unknowns.comm, unknowns.n_local, pointers, columns, values)

    def _add_rotation(self, product: PETSc.Mat, rotated: Array, column: int) -> None:
        """Add the rotation of tractions and arms with the obstacle to DᵀBD. Collective.

        With w = ω × T / L and e = ω × r / L the angle changes T by w at a fixed jump, and the
        moment T·e by -w·du, since its arm moves with u. So w enters the row and the column of the
        angle, and e·w the diagonal.

        Args:
            product: Matrix that is added to.
            rotated: ω × T, (n_points, gdim) (stress).
            column: Number of the angle.
        """
        nodal = self.contact.area[:, None] * rotated / self._length
        diagonal = float(global_sum(self.unknowns.comm, np.sum(self._arms() * nodal)))
        self._at_points.array[:] = nodal.ravel()
        forces = self._map.createVecRight()
        self._map.multTranspose(self._at_points, forces)
        if self.unknowns.has_motions_here:
            forces.array[column - self.unknowns.first] = -diagonal / 2
        n = self.unknowns.n_local
        column_part = self._column_matrix(
            n, column, self.coupled_dofs, forces.array_r[self.coupled_dofs]
        )
        row_part = column_part.copy().transpose()
        for part in (column_part, row_part):
            product.axpy(-1.0, part, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
            part.destroy()
        forces.destroy()

    @cached_property
    def _product(self) -> PointProduct:
        return PointProduct(self._map, self._gdim)

    def _assemble_product(self, blocks: Array, jump_map: PETSc.Mat) -> PETSc.Mat:
        """Return DᵀBD for one block per point and a map D. Collective.

        Two products take half the time of PETSc's triple product.
        """
        diagonal, transposed = self._block_diagonal(blocks, jump_map), PETSc.Mat()
        jump_map.transpose(transposed)
        right = diagonal.matMult(jump_map)
        product = transposed.matMult(right)
        for item in (diagonal, transposed, right):
            item.destroy()
        return product

    def _block_diagonal(self, blocks: Array, matrix: PETSc.Mat) -> PETSc.Mat:
        """Create a block-diagonal matrix over a matrix's rows, without zero blocks."""
        d = blocks.shape[1]
        first, _ = matrix.getOwnershipRange()
        nonzero = np.any(blocks != 0.0, axis=(1, 2))
        columns = first + d * np.flatnonzero(nonzero)[:, None, None] + np.arange(d)[None, None, :]
        columns = np.broadcast_to(columns, (len(columns), d, d))
        pointers = np.insert(np.cumsum(np.repeat(d * nonzero, d)), 0, 0)
        n_rows, entries = matrix.getLocalSize()[0], blocks[nonzero].ravel()
        return create_csr_matrix(self.unknowns.comm, n_rows, pointers, columns.ravel(), entries)


def _drop_zeros(matrix: PETSc.Mat) -> PETSc.Mat:
    """Return a matrix without stored zeros, as of basis functions that vanish on Γc. Collective."""
    pointers, columns, values = matrix.getValuesCSR()
    nonzero = values != 0.0
    pointers, n_columns = np.append(0, np.cumsum(nonzero))[pointers], matrix.getLocalSize()[1]
    return create_csr_matrix(matrix.comm, n_columns, pointers, columns[nonzero], values[nonzero])
