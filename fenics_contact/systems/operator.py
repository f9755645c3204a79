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

from fenics_contact.compat import sparse_matrix
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
            other points have no jump and no tractions here. None: there are no others on any rank.
    """

    def __init__(
        self, contact: Contact, unknowns: Unknowns | None = None, first_motion: int = 0
    ) -> None:
        self.contact = contact
        displacement = contact.displacement
        self.unknowns = unknowns or Unknowns(displacement.whole.function_space)
        self._gdim = contact.surface.mesh.geometry.dim
        self._first = self.unknowns.first_motion + first_motion
        felt = self.unknowns.widened(displacement.lifted(contact.pairs.jump_map))
        self._of_bodies = _without_zeros(felt)
        self.within = self._find_within()
        self._motions: PETSc.Mat | None = None
        self._map = self._of_bodies
        self._confine(self._of_bodies)
        if contact.free_motion:
            self._motions = self._motion_map()
            self._confine(self._motions)
            self._map = self._of_bodies.copy()
            different = PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN
            self._map.axpy(-1.0, self._motions, different)
        # Number of the angle among the unknowns, if there is one, and L.
        self._turn: int | None = None
        self._length = 1.0
        for number, motion in enumerate(contact.motions):
            if motion.turns:
                self._turn, self._length = self._first + number, motion.length
        self._at_points = self._map.createVecLeft()

    def _find_within(self) -> Mask | None:
        """Return the mask ``within``. Collective.

        With finite kinematics all unknowns that pairs may couple are selected, except round-off of
        functions that are zero on facets.
        """
        if not isinstance(self.unknowns, DofSubset) or self.contact.contact_kinematics.follows:
            return None
        pointers, columns, values = self.contact.pairs.jump_map.getValuesCSR()
        row = np.repeat(np.arange(pointers.size - 1), np.diff(pointers))
        lost = (values != 0.0) & ~self.unknowns.has(columns)
        within = np.ones(self.contact.quadrature.n_points, dtype=np.bool_)
        within[row[lost] // self._gdim] = False
        return within if self.unknowns.comm.allreduce(int(not within.all())) else None

    def _confine(self, matrix: PETSc.Mat) -> None:
        """Let the other points feel nothing. Collective."""
        if self.within is not None:
            rows = matrix.createVecLeft()
            rows.array[:] = np.repeat(self.within, self._gdim)
            matrix.diagonalScale(rows, None)
            rows.destroy()

    def _motion_map(self) -> PETSc.Mat:
        """The map from the unknowns to the free displacement of the obstacle. Collective."""
        contact, d = self.contact, self._gdim
        n, components = contact.quadrature.n_points, list(contact.free_motion)
        counts = np.tile(np.isin(np.arange(d), components), n)
        columns = np.tile(self._first + np.arange(len(components)), n)
        pointers = np.concatenate([[0], np.cumsum(counts)])
        ones = np.ones(columns.size)
        return sparse_matrix(self.unknowns.comm, self.unknowns.n_local, pointers, columns, ones)

    @cached_property
    def touched(self) -> Indices:
        """This rank's unknowns that the contact couples, ascending. Collective."""
        return self.touched_by(np.ones(self.contact.quadrature.n_points, dtype=np.bool_))

    @property
    def reachable(self) -> Indices:
        """This rank's unknowns that the contact may couple, now or later. Collective."""
        pairs, displacement = self.contact.pairs, self.contact.displacement
        if not self.contact.contact_kinematics.follows:
            return self.touched
        reach = self.unknowns.widened(displacement.lifted(pairs.reach))
        return self._coupled(reach, np.ones(reach.getLocalSize()[0]))

    def touched_by(self, chosen: Mask) -> Indices:
        """Return this rank's unknowns that some of its points couple, ascending. Collective."""
        return self._coupled(self._map, np.repeat(chosen, self._gdim))

    def _coupled(self, matrix: PETSc.Mat, rows: Array | Mask) -> Indices:
        """Columns of a matrix with an entry in chosen rows, and the angle. Collective."""
        pointers, columns, values = matrix.getValuesCSR()
        there = (values != 0.0).astype(np.float64)
        marks = sparse_matrix(matrix.comm, matrix.getLocalSize()[1], pointers, columns, there)
        points, counts = marks.createVecLeft(), marks.createVecRight()
        points.array[:] = rows
        marks.multTranspose(points, counts)
        felt = counts.array_r > 0.0
        if self._turn is not None and self.unknowns.has_motions_here:
            felt[self._turn - self.unknowns.first] = True
        for item in (marks, points, counts):
            item.destroy()
        return np.flatnonzero(felt).astype(np.int32)

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
        found = self._at_points.array_r.reshape(-1, self._gdim).copy()
        if self._turn is not None:
            turned = self.unknowns.motions(values)[self._turn - self.unknowns.first_motion]
            found -= turned * self._arms()
        return found

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
        if self._turn is not None:
            moment = float(global_sum(self.unknowns.comm, np.sum(self._arms() * force)))
            if self.unknowns.has_motions_here:
                residual.array[self._turn - self.unknowns.first] += moment

    def springs(self, stiffness: Array) -> PETSc.Mat:
        """Assemble a stiffness at the points, Dᵀ W k D. Collective.

        Args:
            stiffness: Stiffness k at the points, (n_points, gdim, gdim) (stress/length).

        Returns:
            A new matrix over the unknowns (force/length).
        """
        blocks = self.contact.area[:, None, None] * stiffness
        follows = self.contact.contact_kinematics.follows  # then nothing is worth to be prepared
        if isinstance(self.unknowns, DofSubset) and self._turn is None and not follows:
            return self._product(blocks)
        if self._turn is None:
            return self._sandwiched(blocks, self._map)
        present = self._present_map(self._turn)
        product = self._sandwiched(blocks, present)
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
        if local is not None:  # of pairs that follow the bodies; see `FiniteSlidingPairs.tangent`
            lifted = self.unknowns.widened(self.contact.displacement.lifted(local))
            return self._sandwiched(-self.contact.area[:, None, None] * tangent.by_jump, lifted)
        if tangent.spun is not None and self._turn is not None:
            product = self.springs(-tangent.by_jump)
            self._add_spin(product, tangent.spun, self._turn)
            return product
        if tangent.by_shift is None:
            return self.springs(-tangent.by_jump)
        # Where the obstacle moves its normals may turn: more than the opposite of ∂/∂jump.
        area = -self.contact.area[:, None, None]
        jumps = self._block_diagonal(area * tangent.by_jump, self._map)
        shifts = self._block_diagonal(area * tangent.by_shift, self._map)
        right, turned = jumps.matMult(self._of_bodies), shifts.matMult(self._motions)
        right.axpy(1.0, turned, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        product = self._map.transposeMatMult(right)
        for item in (jumps, shifts, right, turned):
            item.destroy()
        return product

    # ---- an obstacle that is turned by a moment --------------------------------------------------

    def _arms(self) -> Array:
        """ω × r / L at the points, what they feel of the angle's unknown but for the sign.

        Collective.

        Returns:
            (n_points, gdim); zero where a point is not within.
        """
        arms = np.asarray(
            self.contact.contact_kinematics.turning_rate() / self._length, dtype=np.float64
        )
        return arms if self.within is None else np.where(self.within[:, None], arms, 0.0)

    def _present_map(self, column: int) -> PETSc.Mat:
        """D as it is now, a new matrix. Collective."""
        arms = self._arms()
        every = np.arange(arms.size, dtype=np.int32)
        turn = self._one_column(arms.size, column, every, -arms.ravel())
        present = self._map.copy()
        present.axpy(1.0, turn, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        turn.destroy()
        return present

    def _one_column(self, n_rows: int, column: int, filled: Indices, values: Array) -> PETSc.Mat:
        """A matrix with values in one column alone, in some of this rank's rows, ascending."""
        pointers = np.searchsorted(filled, np.arange(n_rows + 1))
        columns, unknowns = np.full(len(values), column), self.unknowns
        return sparse_matrix(unknowns.comm, unknowns.n_local, pointers, columns, values)

    def _add_spin(self, product: PETSc.Mat, spun: Array, column: int) -> None:
        """Add to DᵀBD that tractions turn with the obstacle, and arms move. Collective.

        With w = ω × T / L and e = ω × r / L the angle changes T by w, besides what follows from the
        jump, and the moment is T·e, whose arm moves with u: T·(ω × du) = -w·du. So w makes the same
        entries to either side of the diagonal, and e·w on it.

        Args:
            product: Added to.
            spun: ω × T, (n_points, gdim) (stress).
            column: Number of the angle.
        """
        share = self.contact.area[:, None] * spun / self._length
        diagonal = float(global_sum(self.unknowns.comm, np.sum(self._arms() * share)))
        self._at_points.array[:] = share.ravel()
        forces = self._map.createVecRight()
        self._map.multTranspose(self._at_points, forces)
        if self.unknowns.has_motions_here:
            forces.array[column - self.unknowns.first] = -diagonal / 2
        n = self.unknowns.n_local
        own = self._one_column(n, column, self.touched, forces.array_r[self.touched])
        mirrored = own.copy().transpose()
        for part in (own, mirrored):
            product.axpy(-1.0, part, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
            part.destroy()
        forces.destroy()

    @cached_property
    def _product(self) -> PointProduct:
        return PointProduct(self._map, self._gdim)

    def _sandwiched(self, blocks: Array, felt_map: PETSc.Mat) -> PETSc.Mat:
        """DᵀBD for one block per point and a map D, a new matrix. Collective.

        By two products, which take half the time of PETSc's own for all three.
        """
        inner, across = self._block_diagonal(blocks, felt_map), PETSc.Mat()
        felt_map.transpose(across)
        right = inner.matMult(felt_map)
        product = across.matMult(right)
        for item in (inner, across, right):
            item.destroy()
        return product

    def _block_diagonal(self, blocks: Array, over: PETSc.Mat) -> PETSc.Mat:
        """One block per point, (n_points, d, d), over a matrix's rows; none where it is zero."""
        d = blocks.shape[1]
        first, _ = over.getOwnershipRange()
        there = np.any(blocks != 0.0, axis=(1, 2))
        columns = first + d * np.flatnonzero(there)[:, None, None] + np.arange(d)[None, None, :]
        columns = np.broadcast_to(columns, (len(columns), d, d))
        pointers = np.insert(np.cumsum(np.repeat(d * there, d)), 0, 0)
        n_rows, entries = over.getLocalSize()[0], blocks[there].ravel()
        return sparse_matrix(self.unknowns.comm, n_rows, pointers, columns.ravel(), entries)


def _without_zeros(matrix: PETSc.Mat) -> PETSc.Mat:
    """The same matrix without the zeros that are stored in it. Collective.

    Functions of nodes inside of a cell are none on its facets.
    """
    pointers, columns, values = matrix.getValuesCSR()
    there = values != 0.0
    pointers, n_columns = np.append(0, np.cumsum(there))[pointers], matrix.getLocalSize()[1]
    return sparse_matrix(matrix.comm, n_columns, pointers, columns[there], values[there])
