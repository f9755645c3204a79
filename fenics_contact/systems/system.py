"""The discrete equations of bulk and contact on a set of unknowns.

`FullSystem` has all unknowns, `CondensedSystem` those retained by static condensation. Methods use
the common interface in this module.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from dolfinx import fem
from petsc4py import PETSc

from fenics_contact.contact.contact import Contact
from fenics_contact.parallel import global_max
from fenics_contact.systems.balance import InitialForces, Norms, Parts
from fenics_contact.systems.bulk import Bulk
from fenics_contact.systems.forces import Forces
from fenics_contact.systems.operator import ContactOperator
from fenics_contact.systems.partition import Partition, norms_by_part
from fenics_contact.systems.reference_scales import ReferenceScales
from fenics_contact.systems.unknowns import Unknowns
from fenics_contact.types import Array, Mask

__all__ = ["System"]

# Largest rotation of a free obstacle in an increment.
_MAX_ROTATION = np.pi / 2


class System(ABC):
    """States, forces and matrices over some unknowns of a problem. The constructor is collective.

    Attributes:
        u: The solution function.
        gdim: Dimension of space.
        unknowns: The unknowns of the system.
        bulk: The bulk form.
        contacts: The contacts.
        constrained: Mask of this rank's unknowns with Dirichlet conditions.
        prescribed: Values at them, in the present increment.
        load: External forces at the unknowns (force).
        outside: Norms of load and round-off magnitude at unknowns outside of the system, (2,
            n_bodies).
        partition: Bodies and free obstacles of this rank's unknowns.
        n_bodies: Number of bodies and free obstacles.
        scales: Reference scales of the bodies.
        linear_kind: Solver of linear systems, one of `linear.KINDS`.
        coordinate_id: Identifies the coordinates of `forces`.
        ready: Whether `fill` can be called; otherwise `update` is necessary.
    """

    linear_kind = "direct"
    coordinate_id: object
    ready: bool
    scales: ReferenceScales

    def __init__(
        self,
        u: fem.Function,
        unknowns: Unknowns,
        bulk: Bulk,
        contacts: Sequence[Contact],
        constrained: Mask,
        partition: Partition,
    ) -> None:
        self.u, self.unknowns, self.bulk = u, unknowns, bulk
        self.gdim: int = u.function_space.mesh.geometry.dim
        self.contacts, self.constrained = contacts, constrained
        self.partition, self.n_bodies = partition, partition.n_parts
        self.prescribed: Array = np.zeros(int(constrained.sum()))
        self.load: Array = np.zeros(unknowns.n_local)
        self._diagonal: Array | None = None  # of the matrix filled last
        self.outside: Array = np.zeros((2, self.n_bodies))
        self._motions = [motion for contact in contacts for motion in contact.motions]
        self._contact_vector = unknowns.vector()
        counts = [len(contact.motions) for contact in contacts]
        self._first_motions = [sum(counts[:i]) for i in range(len(counts))]
        # Operator of every contact and the number of its pairs.
        self._operators: dict[int, tuple[int, ContactOperator]] = {}
        self._parts: tuple[list[int], Parts] | None = None
        self._coordinate_bounds: tuple[list[int], Array] | None = None

    @property
    @abstractmethod
    def iterations_per_restart(self) -> int:
        """Iterations of L-BFGS between two assemblies of H₀."""

    @property
    def diagonal(self) -> Array:
        """Diagonal of the matrix assembled last, or of the bulk (force/length). Collective."""
        return self.bulk_diagonal() if self._diagonal is None else self._diagonal

    @diagonal.setter
    def diagonal(self, diagonal: Array) -> None:
        self._diagonal = diagonal

    # ---- contact and force balance ---------------------------------------------------------------

    @property
    def operators(self) -> list[ContactOperator]:
        """The contact operators for the present pairs. Collective.

        Pairs that follow the bodies are updated to the present ``u``. An operator is replaced if,
        and only if, the pairs of its contact have changed.
        """
        for contact in self.contacts:
            if contact.contact_kinematics.pairs_follow_bodies:
                contact.contact_kinematics.update()
        for i, contact in enumerate(self.contacts):
            number = contact.pairs.n_updates
            if i not in self._operators or self._operators[i][0] != number:
                operator = ContactOperator(contact, self.unknowns, self._first_motions[i])
                self._operators[i] = number, operator
        return [self._operators[i][1] for i in range(len(self.contacts))]

    @property
    def parts(self) -> Parts:
        """The partition into bodies, obstacles and contacts, for the present pairs. Collective."""
        pairings = [c.pairs.n_updates for c in self.contacts]
        if self._parts is None or self._parts[0] != pairings:
            moving = [(n, m.way) for n, c in enumerate(self.contacts) for m in c.motions]
            n = self.n_bodies - len(moving)
            bodies = [f"body {b + 1}" if n > 1 else "the body" for b in range(n)]
            bodies += [f"obstacle of {self.contacts[c].name} {way}" for c, way in moving]
            coupled = [operator.coupled_dofs for operator in self.operators]
            scales = self.scales
            parts = Parts(
                self.unknowns.comm,
                self.partition,
                self.constrained,
                bodies,
                [c.name for c in self.contacts],
                coupled,
                [scales.pairs(o, i, self.partition.label) for i, o in enumerate(self.operators)],
                scales,
                [c for c, _ in moving],
            )
            self._parts = pairings, parts
        return self._parts[1]

    def contact_forces(self, *, evaluated: bool = False) -> list[Array]:
        """Return the residual contributions of each contact, (n_local,) each. Collective.

        Args:
            evaluated: Whether to use the tractions of the last `Contact.evaluate` instead of those
                of the law with its present data.
        """
        return [
            self._nodal_force(operator, operator.contact.traction if evaluated else None)
            for operator in self.operators
        ]

    def _nodal_force(self, operator: ContactOperator, traction: Array | None) -> Array:
        """Return the residual contribution of tractions, (n_local,). Collective."""
        self._contact_vector.set(0.0)
        operator.add_force(self._contact_vector, traction)
        return np.array(self._contact_vector.array_r)

    def contact_force(self) -> Array:
        """Return the residual contribution of all contacts, (n_local,). Collective."""
        return sum(self.contact_forces(), np.zeros(self.unknowns.n_local))

    def norms(self, total: Array, contacts: Sequence[Array], start: InitialForces) -> Norms:
        """Evaluate the norms of residual and forces at the present state, by part. Collective.

        Args:
            total: The residual including reactions, (n_local,) (force).
            contacts: Contribution of every contact, (n_local,) each.
            start: Forces at the start of the increment.
        """
        return self.parts.norms(
            total,
            contacts,
            self.load,
            self.roundoff_magnitude(self.state()),
            self.outside,
            start,
        )

    def initial_forces(self) -> InitialForces:
        """Return the forces of the committed state, without internal ones. Collective."""
        forces = [np.zeros(self.unknowns.n_local) for _ in self.contacts]
        for operator, force in zip(self.operators, forces, strict=True):
            points = operator.contact.states.committed.points
            if points is not None:
                nodal = self._nodal_force(operator, points.total_traction)
                force[:] = np.where(self.constrained, 0.0, nodal)
        return InitialForces(np.zeros(self.n_bodies), self.by_body(*forces))

    @property
    def is_restricted(self) -> bool:
        """Whether some points of Γc depend on unknowns outside of the system. Collective."""
        return any(operator.within is not None for operator in self.operators)

    @contextmanager
    def restricted_contacts(self) -> Iterator[None]:
        """Restrict the contacts inside of the block to points within the system. Collective.

        The jump at the others is unknown until `complete`.
        """
        restricted = [o for o in self.operators if o.within is not None]
        try:
            for operator in restricted:
                operator.contact.restrict_to(operator.within)
            yield
        finally:
            for operator in restricted:
                operator.contact.restrict_to()

    # ---- states ----------------------------------------------------------------------------------

    def vector(self) -> PETSc.Vec:
        """Create a vector over the unknowns. Collective."""
        return self.unknowns.vector()

    def roundoff_magnitude(self, state: Array) -> Array:
        """Return the magnitude of the terms of K u, which bounds its round-off (force). Collective.

        Finite kinematics sum up coordinates, and contact of two bodies the displacements of both.
        """
        size = np.abs(state)
        for operator in self.operators:
            if not operator.contact.contact_kinematics.is_rigid:
                coupled = operator.coupled_dofs
                size[coupled] = global_max(self.unknowns.comm, size[coupled])
        return np.asarray(self.diagonal * (size + self._largest_coordinates()))

    def _largest_coordinates(self) -> Array:
        """Return the largest coordinate at dofs of finite contacts, 0 elsewhere. Collective."""
        pairings = [c.pairs.n_updates for c in self.contacts]
        if self._coordinate_bounds is None or self._coordinate_bounds[0] != pairings:
            bounds = np.zeros(self.unknowns.n_local)
            for operator in self.operators:
                if operator.contact.contact_kinematics.is_finite:
                    points = np.abs(operator.contact.points)
                    bounds[operator.coupled_dofs] = global_max(self.unknowns.comm, points)
            self._coordinate_bounds = [c.pairs.n_updates for c in self.contacts], bounds
        return self._coordinate_bounds[1]

    def by_body(self, *vectors: Array) -> Array:
        """Return the norms of vectors by body, (n_vectors, n_bodies). Collective."""
        rows = [(vector, self.partition) for vector in vectors]
        return norms_by_part(self.unknowns.comm, self.n_bodies, rows)

    def motions(self) -> Array:
        """Return the present free motions of obstacles, on every rank."""
        return np.array([motion.value for motion in self._motions])

    def set_motions(self, state: Array) -> None:
        """Set the free motions of obstacles from a state. Collective."""
        for motion, value in zip(self._motions, self.unknowns.motions(state), strict=True):
            motion.set_value(value)

    def is_over_rotated(self) -> bool:
        """Return whether a free obstacle has rotated by a right angle or more in the increment.

        Solutions are not unique beyond: after a full turn its points are at the same positions.
        """
        angles = (
            float(contact.free_angle.value) - contact.contact_kinematics.committed_angle
            for contact in self.contacts
            if contact.free_angle is not None
        )
        return any(not abs(angle) < _MAX_ROTATION for angle in angles)

    def is_degenerate(self) -> bool:
        """Return whether Γc has lost its tangent plane at a point."""
        return any(contact.pairs.is_degenerate for contact in self.contacts)

    @abstractmethod
    def state(self) -> Array:
        """Return the present unknowns of this rank, a copy."""

    @abstractmethod
    def set_state(self, state: Array) -> None:
        """Set the present unknowns. Collective."""

    def restrict(self, state: Array) -> Array:
        """Restrict a state of all unknowns to this system. Collective."""
        return state

    def extend(self, change: Array) -> Array:
        """Extend a change of the unknowns of this system to all. Collective."""
        return change

    # ---- an increment ----------------------------------------------------------------------------

    @abstractmethod
    def begin(self, load: Array) -> None:
        """Start an increment under a load, with the Dirichlet values in u. Collective."""

    @property
    def pending_field(self) -> Array | None:
        """Data for `complete` in this increment; None: no unknowns are outside."""
        return None

    def complete(self, field: Array | None) -> None:
        """Recover the unknowns outside of the system from those inside. Collective.

        The field is the `pending_field` of the increment that determined those inside.
        """
        return

    @abstractmethod
    def forces(self, bulk: Array, reaction: Array) -> Forces:
        """Return the forces at the present state, in the coordinates of ``coordinate_id``.

        Args:
            bulk: Residual of the bulk, (n,) (force).
            reaction: Forces at the constrained unknowns, zero at others, (n,) (force).
        """

    def present_forces(self, bulk: Array | None = None) -> Forces:
        """Return `forces` with the reactions in equilibrium with the bulk residual. Collective."""
        bulk = self.bulk_force() if bulk is None else bulk
        return self.forces(bulk, np.where(self.constrained, bulk + self.contact_force(), 0.0))

    @abstractmethod
    def forget(self) -> None:
        """Drop data of earlier increments that could change the round-off of the next."""

    @abstractmethod
    def bulk_force(self) -> Array:
        """Return the residual of the bulk and of free obstacles, without contact. Collective."""

    @abstractmethod
    def bulk_energy(self) -> float:
        """Return this rank's potential of a linear bulk and its loads, up to a constant."""

    # ---- matrices --------------------------------------------------------------------------------

    def update(self) -> int:
        """Update the bulk tangent; return the number of factorisations. Collective."""
        return 0

    @abstractmethod
    def matrix(self, *, symmetric: bool) -> PETSc.Mat:
        """Create a matrix for `fill`, whose values will be symmetric or not. Collective."""

    @abstractmethod
    def bulk_diagonal(self) -> Array:
        """Return the diagonal of the bulk tangent at this rank's unknowns (force/length)."""

    @abstractmethod
    def linear_solver(self, *, symmetric: bool, accurate: bool) -> dict[str, Any]:
        """Return the options of the solver for `matrix`."""

    def prepare(self, ksp: PETSc.KSP, matrix: PETSc.Mat) -> None:
        """Set a matrix of `matrix` in a solver. Collective."""
        ksp.setOperators(matrix)

    @property
    def pattern_changes(self) -> bool:
        """Whether the sparsity pattern of `fill` changes from one matrix to the next."""
        return False

    @abstractmethod
    def fill(self, matrix: PETSc.Mat, contacts: Iterable[PETSc.Mat]) -> int:
        """Assemble bulk and contact tangents with Dirichlet conditions, dimensionless. Collective.

        The contact tangents are destroyed. The result is the number of sparse factorisations that
        solving with the matrix takes.
        """
