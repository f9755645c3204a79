"""The system on all unknowns of a problem."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import Any

import numpy as np
from dolfinx import fem
from petsc4py import PETSc

from fenics_contact.contact.contact import Contact
from fenics_contact.parallel import global_max, global_sum
from fenics_contact.surface.bodies import connected_bodies
from fenics_contact.surface.displacement import Displacement
from fenics_contact.systems import linear
from fenics_contact.systems.bulk import Bulk
from fenics_contact.systems.forces import Forces
from fenics_contact.systems.partition import Partition
from fenics_contact.systems.reference_scales import ReferenceScales
from fenics_contact.systems.system import System
from fenics_contact.systems.unknowns import Unknowns
from fenics_contact.types import Array, Mask

__all__ = ["FullSystem"]


class FullSystem(System):
    """All unknowns: the dofs of the solution function and the free motions of obstacles.

    Attributes:
        bcs: Dirichlet conditions.
        body: Body of every node of this rank, ghosts last.
        displacement: The displacement within the solution function.
        stiffness: Tangent of the bulk over all unknowns, after `update_stiffness`.
    """

    coordinate_id: object = "all unknowns"
    ready = True

    def __init__(
        self,
        displacement: Displacement,
        unknowns: Unknowns,
        bulk: Bulk,
        contacts: Sequence[Contact],
        constrained: Mask,
        bcs: Sequence[fem.DirichletBC],
    ) -> None:
        self.bcs = bcs
        u, space = displacement.whole, displacement.u.function_space
        n, body = connected_bodies(space)
        n_motions = sum(len(contact.motions) for contact in contacts)
        dofs = np.repeat(body, space.dofmap.bs)[: unknowns.n_dofs]
        if displacement.is_mixed:  # by the adjacent cells
            label = np.zeros(u.x.array.size, dtype=body.dtype)
            label[u.function_space.dofmap.list] = body[space.dofmap.list[:, :1]]
            dofs = label[: unknowns.n_dofs]
        self.displacement = displacement
        motions = (n + np.arange(n_motions)).astype(np.float64)
        label = unknowns.joined(dofs.astype(np.float64), motions).astype(np.intp)
        partition = Partition(label, n + n_motions)
        super().__init__(u, unknowns, bulk, contacts, constrained, partition)
        mask = displacement.within(np.ones(displacement.n_owned))
        self._is_displacement: Mask = unknowns.joined(mask, np.ones(n_motions)) > 0
        self.scales = ReferenceScales(
            displacement, body, partition, self._is_displacement, n_motions, contacts
        )
        self.stiffness: PETSc.Mat | None = None
        self._near_nullspace: PETSc.NullSpace | None = None
        self.body = body

    @property
    def iterations_per_restart(self) -> int:
        """Iterations of L-BFGS between two assemblies of H₀.

        Pairs from before a change of status help little. An iteration costs 1/15 to 1/35 of a
        factorisation, but several times as much as an update of the multigrid levels.
        """
        return 10 if self.linear_kind == "multigrid" else 20

    @cached_property
    def size_to_factor(self) -> float:
        """`linear.cube_size` of the bodies, in the plane the number of dofs. Collective."""
        if self.gdim != 3:
            return self.unknowns.first_motion
        u, degree = self.displacement.u, self.displacement.degree
        return linear.cube_size(u.function_space, self.body, degree)

    def update_stiffness(self) -> bool:
        """Assemble the bulk tangent if it may have changed; return whether it was. Collective."""
        changed = self.bulk.update()
        if self.stiffness is None or (changed and self.unknowns.n_motions):
            if self.stiffness is not None:
                self.stiffness.destroy()
            self.stiffness = self.unknowns.widen(self.bulk.stiffness, rows=True)
        return changed

    @contextmanager
    def stiffness_at_rest(self) -> Iterator[PETSc.Mat]:
        """Yield the bulk tangent at u = 0 over all unknowns. Collective."""
        with self.bulk.stiffness_at_rest() as stiffness:
            yield self.unknowns.widen(stiffness, rows=True)

    def state(self) -> Array:
        """Return the present unknowns of this rank, a copy."""
        values = self.bulk.in_units(self.u.x.array[: self.unknowns.n_dofs])
        return self.unknowns.joined(values, self.motions()) if self.unknowns.n_motions else values

    def present_load(self) -> Array:
        """Return the present external forces at this rank's unknowns (force). Collective."""
        return -self.with_obstacles(self.bulk.update_load())

    def prescribed_values(self) -> Array:
        """Return this rank's unknowns with the present values of the Dirichlet conditions."""
        values = self.u.x.array.copy()
        for bc in self.bcs:
            bc.set(values)
        unknowns = self.unknowns
        return unknowns.joined(
            self.bulk.in_units(values[: unknowns.n_dofs]), np.zeros(unknowns.n_motions)
        )

    def prescribe(self) -> None:
        """Set the Dirichlet values in u. Collective."""
        for bc in self.bcs:
            bc.set(self.u.x.array)
        self.u.x.scatter_forward()

    def set_state(self, state: Array) -> None:
        """Set the present unknowns. Collective."""
        n = self.unknowns.n_dofs
        self.u.x.array[:n] = self.bulk.from_units(state[:n])
        self.u.x.scatter_forward()
        self.displacement.update()
        self.set_motions(state)

    def evaluate_at(self, state: Array) -> None:
        """Set the present unknowns and evaluate the contacts. Collective."""
        self.set_state(state)
        self.evaluate()

    def evaluate(self) -> None:
        """Evaluate the contacts at the present state. Collective."""
        for contact in self.contacts:
            contact.evaluate()

    def displacement_at(self, state: Array) -> fem.Function:
        """Return the displacement of a state as a new function. Collective."""
        n = self.unknowns.n_dofs
        whole = fem.Function(self.u.function_space)
        whole.x.array[:n] = self.bulk.from_units(state[:n])
        whole.x.scatter_forward()
        if not self.displacement.is_mixed:
            return whole
        u = fem.Function(self.displacement.u.function_space)
        u.x.array[:] = whole.x.array[self.displacement.dofs]
        return u

    @cached_property
    def _cell_size(self) -> float:
        """Size of the largest cell (length). Collective."""
        mesh = self.u.function_space.mesh
        cells = np.arange(mesh.topology.index_map(mesh.topology.dim).size_local, dtype=np.int32)
        return global_max(mesh.comm, mesh.h(mesh.topology.dim, cells))

    def roundoff_magnitude(self, state: Array) -> Array:
        """Return the magnitude of the terms of K u, (n_local,) (force). Collective.

        A nonlinear bulk evaluates I + ∇u, whose round-off is that of 1 even at rest. The equations
        of other fields, such as an incompressibility constraint, sum up displacements.
        """
        terms = super().roundoff_magnitude(state)
        if not self.bulk.linear:
            terms = terms + self.diagonal * self._cell_size
        if not self.displacement.is_mixed:
            return terms
        largest = global_max(self.unknowns.comm, np.abs(state[self._is_displacement]))
        return np.where(self._is_displacement, terms, self.bulk.scale * largest)

    def begin(self, load: Array) -> None:
        """Start an increment under a load, with the Dirichlet values in u. Collective."""
        self.load = load
        self.prescribed = self.state()[self.constrained]

    def forces(self, bulk: Array, reaction: Array) -> Forces:
        """Return the forces at all unknowns."""
        return Forces(self.state(), bulk + self.load, self.load + reaction, self.partition)

    def forget(self) -> None:
        """Discard the diagonal, from which round-off is estimated."""
        self._diagonal = None

    def bulk_force(self) -> Array:
        """Return the residual of the bulk and of free obstacles. Collective."""
        return self.with_obstacles(self.bulk.residual())

    def product_force(self) -> Array:
        """Return K u minus the loads, for a linear bulk. Collective."""
        assert self.stiffness is not None
        state, image = self.unknowns.vector(), self.unknowns.vector()
        state.array[:] = self.state()
        self.stiffness.mult(state, image)
        force = np.asarray(image.array_r - self.load)
        for vector in (state, image):
            vector.destroy()
        return force

    def bulk_energy(self) -> float:
        """Return this rank's potential of a linear bulk and its loads, up to a constant."""
        # The potential is (F(u) + F(0))·u/2, since F(u) = K u + F(0).
        return float(0.5 * (self.bulk_force() - self.load) @ self.state())

    def with_obstacles(self, residual: Array) -> Array:
        """Append the residual of the free obstacles, minus their loads, to one of the dofs."""
        forces = [motion.force for c in self.contacts for motion in c.motions]
        return self.unknowns.joined(residual, -np.array(forces))

    def contact_force_sizes(self, *, committed: bool = False) -> Array:
        """Sum the magnitudes of contact forces by group, (n_groups,) (force). Collective.

        The groups are those of `ReferenceScales.group`. Resultants are no measure: those of a body
        that is locked by friction vanish. ``committed`` selects the committed forces.
        """
        total: Array = np.zeros(self.scales.n_groups)
        for number, contact in enumerate(self.contacts):
            points = contact.states.committed.points if committed else contact.values
            if points is not None:
                force = contact.measure * np.abs(points.total_traction).sum(axis=1)
                np.add.at(total, self.scales.group_of_points(number), force)
        return global_sum(self.unknowns.comm, total)

    @property
    def follows(self) -> bool:
        """Whether the pairs of a contact are updated with the displacement."""
        return any(contact.contact_kinematics.pairs_follow_bodies for contact in self.contacts)

    @property
    def pattern_changes(self) -> bool:
        """Whether the sparsity pattern of `fill` changes from one matrix to the next.

        It does if pairs are updated, and in three dimensions where contact couples bodies and the
        matrix is factored. Coupling open points there costs up to half a factorisation, a new
        pattern a tenth; in the plane it is the other way round.
        """
        couples = self.gdim == 3 and any(_has_coupling(c) for c in self.contacts)
        return self.follows or (couples and self.linear_kind == "direct")

    def matrix(self, *, symmetric: bool) -> PETSc.Mat:
        """Create a matrix for `fill`. Collective.

        Its pattern is that of the bulk and, with deformable or moving obstacles, of the pairs.
        """
        assert self.stiffness is not None
        different = PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN
        matrix = self.stiffness.copy()
        for operator in self.operators:
            if _has_coupling(operator.contact) and not self.pattern_changes:
                part = operator.springs(operator.contact.values.springs(1.0, 1.0))
                matrix.axpy(1.0, part, different)
                part.destroy()
        matrix.setOption(PETSc.Mat.Option.KEEP_NONZERO_PATTERN, True)
        matrix.setOption(PETSc.Mat.Option.SYMMETRIC, symmetric)
        # Rigid-body modes of obstacles and pressures are not treated.
        if matrix.getBlockSize() == self.gdim and not self.displacement.is_mixed:
            if self._near_nullspace is None:
                self._near_nullspace = linear.near_nullspace(self.u.function_space)
            matrix.setNearNullSpace(self._near_nullspace)
        return matrix

    def linear_solver(self, *, symmetric: bool, accurate: bool) -> dict[str, Any]:
        """Return the options of the solver for `matrix`."""
        return linear.options(self.linear_kind, symmetric=symmetric, accurate=accurate)

    def fill(self, matrix: PETSc.Mat, contacts: Iterable[PETSc.Mat]) -> int:
        """Add bulk and contact tangents with Dirichlet conditions, dimensionless. Collective."""
        assert self.stiffness is not None
        if self.pattern_changes:
            different = PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN
            total = self.stiffness.copy()
            for part in contacts:
                total.axpy(1.0, part, different)
                part.destroy()
            matrix.setPreallocationCSR(total.getValuesCSR())
            total.destroy()
        else:
            subset = PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN
            if any(_has_coupling(c) for c in self.contacts):
                matrix.zeroEntries()
                matrix.axpy(1.0, self.stiffness, subset)
            else:
                self.stiffness.copy(matrix, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
            for part in contacts:
                matrix.axpy(1.0, part, subset)
                part.destroy()
        start, _ = matrix.getOwnershipRange()
        rows = (start + np.flatnonzero(self.constrained)).astype(PETSc.IntType)
        scale = self.bulk.scale
        # Before the Dirichlet rows, whose entries are of the stiffest body.
        self.diagonal = _diagonal(matrix)
        matrix.zeroRowsColumns(rows, diag=scale)
        matrix.scale(1.0 / scale)
        return int(self.linear_kind == "direct")

    def bulk_diagonal(self) -> Array:
        """Return the diagonal of the bulk tangent at this rank's unknowns (force/length)."""
        assert self.stiffness is not None
        return _diagonal(self.stiffness)


def _has_coupling(contact: Contact) -> bool:
    """Return whether a contact couples unknowns that the bulk does not couple."""
    return not contact.contact_kinematics.is_rigid or bool(contact.motions)


def _diagonal(matrix: PETSc.Mat) -> Array:
    """Return the diagonal of this rank's rows, a copy. Collective."""
    diagonal = matrix.getDiagonal()
    values: Array = diagonal.array.copy()
    diagonal.destroy()
    return values
