"""A system: unknowns, and the equations of bulk and contact on them.

There are two, side by side: `FullSystem` on all unknowns, and `CondensedSystem` on those that
contact touches, all others eliminated. What both have in common is here; what iterates on one of
them needs no more than this.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from petsc4py import PETSc

from fenics_contact.contact.contact import Contact
from fenics_contact.parallel import global_max
from fenics_contact.systems.balance import InitialForces, Norms, Parts, by_body
from fenics_contact.systems.bulk import Bulk
from fenics_contact.systems.forces import Forces
from fenics_contact.systems.operator import ContactOperator
from fenics_contact.systems.reference_scales import ReferenceScales
from fenics_contact.systems.unknowns import Unknowns
from fenics_contact.types import Array, Mask

__all__ = ["System"]

# How far an obstacle may turn in an increment whose angle is found: a right angle.
_TURN = np.pi / 2


class System(ABC):
    """States, forces and matrices over some unknowns of a problem. The constructor is collective.

    Attributes:
        u: What is solved for.
        gdim: Dimension of space.
        unknowns: The unknowns of the system.
        bulk: The bulk form.
        contacts: The contacts.
        constrained: Mask over this rank's unknowns: those with Dirichlet conditions.
        prescribed: Values at them, in the present increment.
        load: External forces at the unknowns (force).
        diagonal: Diagonal of the matrix assembled last (force/length).
        outside: Norms of load and of `terms` at unknowns outside of the system, (2, n_bodies).
        label: Body or free obstacle of every unknown of this rank, (n_local,).
        n_bodies: Their number.
        scales: Reference scales of the bodies.
        linear_kind: How linear systems are solved, one of `linear.KINDS`.
        coordinate_id: Of the coordinates that `forces` are in.
        ready: Whether `fill` can be called; else `update` comes first.
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
        label: npt.NDArray[np.intp],
        n_bodies: int,
    ) -> None:
        self.u, self.unknowns, self.bulk = u, unknowns, bulk
        self.gdim: int = u.function_space.mesh.geometry.dim
        self.contacts, self.constrained = contacts, constrained
        self.label, self.n_bodies = label, n_bodies
        self.prescribed: Array = np.zeros(int(constrained.sum()))
        self.load: Array = np.zeros(unknowns.n_local)
        self.diagonal: Array = np.zeros(unknowns.n_local)
        self.outside: Array = np.zeros((2, n_bodies))
        self._motions = [motion for contact in contacts for motion in contact.motions]
        self._contact_vector = unknowns.vector()
        counts = [len(contact.motions) for contact in contacts]
        self._first_motions = [sum(counts[:i]) for i in range(len(counts))]
        # Of every contact, with the number of the pairs that it was made for.
        self._operators: dict[int, tuple[int, ContactOperator]] = {}
        self._parts: tuple[list[int], Parts] | None = None
        self._touched: tuple[list[int], Array] | None = None

    @property
    @abstractmethod
    def iterations_per_round(self) -> int:
        """Iterations of L-BFGS after which H₀ is made anew from the status."""

    # ---- contact, and what has to be in balance --------------------------------------------------

    @property
    def operators(self) -> list[ContactOperator]:
        """What the contacts are over these unknowns, with the pairs as they are. Collective.

        Pairs that follow the bodies are found for the present ``u`` first. A contact whose pairs
        are others than before gets another operator, and it alone: no operator changes.
        """
        for contact in self.contacts:
            if contact.contact_kinematics.follows:
                contact.contact_kinematics.update()
        for i, contact in enumerate(self.contacts):
            number = contact.pairs.number
            if i not in self._operators or self._operators[i][0] != number:
                operator = ContactOperator(contact, self.unknowns, self._first_motions[i])
                self._operators[i] = number, operator
        return [self._operators[i][1] for i in range(len(self.contacts))]

    @property
    def parts(self) -> Parts:
        """What has to be in balance, for the present pairs. Collective."""
        pairings = [c.pairs.number for c in self.contacts]
        if self._parts is None or self._parts[0] != pairings:
            moving = [(n, m.way) for n, c in enumerate(self.contacts) for m in c.motions]
            n = self.n_bodies - len(moving)
            bodies = [f"body {b + 1}" if n > 1 else "the body" for b in range(n)]
            bodies += [f"obstacle of {self.contacts[c].name} {way}" for c, way in moving]
            touched = [operator.touched for operator in self.operators]
            scales = self.scales
            parts = Parts(
                self.unknowns.comm,
                self.label,
                bodies,
                [c.name for c in self.contacts],
                touched,
                [scales.pairs(o, i, self.label) for i, o in enumerate(self.operators)],
                scales,
                [c for c, _ in moving],
            )
            self._parts = pairings, parts
        return self._parts[1]

    def contact_forces(self, *, evaluated: bool = False) -> list[Array]:
        """Parts of the residual at the present state by contact, (n_local,) each. Collective.

        Args:
            evaluated: Whether tractions are those that `Contact.evaluate` found last, and not the
                law's with its data as they are now.
        """
        return [
            self._nodal_force(operator, operator.contact.traction if evaluated else None)
            for operator in self.operators
        ]

    def _nodal_force(self, operator: ContactOperator, traction: Array | None) -> Array:
        """See `ContactOperator.add_force`, (n_local,). Collective."""
        self._contact_vector.set(0.0)
        operator.add_force(self._contact_vector, traction)
        return np.array(self._contact_vector.array_r)

    def contact_force(self) -> Array:
        """Their sum, (n_local,). Collective."""
        return sum(self.contact_forces(), np.zeros(self.unknowns.n_local))

    def norms(self, total: Array, contacts: Sequence[Array], start: InitialForces) -> Norms:
        """How large residual and forces are at the present state, by part. Collective.

        Args:
            total: The residual with reactions, (n_local,) (force).
            contacts: Of every contact the part that is its own, (n_local,) each.
            start: Forces at the beginning of the increment.
        """
        return self.parts.norms(
            total,
            contacts,
            self.load,
            self.terms(self.state()),
            self.constrained,
            self.outside,
            start,
        )

    def initial_forces(self) -> InitialForces:
        """Forces in the committed state, those of the bulk not evaluated yet. Collective."""
        forces = [np.zeros(self.unknowns.n_local) for _ in self.contacts]
        for operator, force in zip(self.operators, forces, strict=True):
            points = operator.contact.states.committed.points
            if points is not None:
                nodal = self._nodal_force(operator, points.total_traction)
                force[:] = np.where(self.constrained, 0.0, nodal)
        return InitialForces(np.zeros(self.n_bodies), self.by_body(*forces))

    @property
    def confined(self) -> bool:
        """Whether there are points of Γc that feel unknowns outside of the system. Collective."""
        return any(operator.within is not None for operator in self.operators)

    @contextmanager
    def restricted_contacts(self) -> Iterator[None]:
        """Confine the contacts to what the system has of Γc inside of the block. Collective.

        What the others feel is not known before `complete`.
        """
        confined = [o for o in self.operators if o.within is not None]
        try:
            for operator in confined:
                operator.contact.restrict_to(operator.within)
            yield
        finally:
            for operator in confined:
                operator.contact.restrict_to()

    # ---- states ----------------------------------------------------------------------------------

    def vector(self) -> PETSc.Vec:
        """A new vector over the unknowns. Collective."""
        return self.unknowns.vector()

    def terms(self, state: Array) -> Array:
        """Size of what K u sums up in each row, whose round-off is left in it (force).

        With finite kinematics contact sums up places in the place of displacements, between two
        bodies the displacements of both. Collective.
        """
        size = np.abs(state)
        for operator in self.operators:
            if not operator.contact.rigid:
                touched = operator.touched
                size[touched] = global_max(self.unknowns.comm, size[touched])
        return np.asarray(self.diagonal * (size + self._coordinates()))

    def _coordinates(self) -> Array:
        """Largest coordinate of a finite contact at what it touches, 0 elsewhere. Collective."""
        pairings = [c.pairs.number for c in self.contacts]
        if self._touched is None or self._touched[0] != pairings:
            found = np.zeros(self.unknowns.n_local)
            for operator in self.operators:
                if operator.contact.finite:
                    points = np.abs(operator.contact.points)
                    found[operator.touched] = global_max(self.unknowns.comm, points)
            self._touched = [c.pairs.number for c in self.contacts], found
        return self._touched[1]

    def by_body(self, *vectors: Array) -> Array:
        """Norms of vectors over the unknowns, (n_vectors, n_bodies). Collective."""
        return by_body(self.unknowns.comm, vectors, self.label, self.n_bodies)

    def motions(self) -> Array:
        """The present free motions of obstacles, on every rank."""
        return np.array([motion.value for motion in self._motions])

    def set_motions(self, state: Array) -> None:
        """Make those of a state the present ones. Collective."""
        for motion, value in zip(self._motions, self.unknowns.motions(state), strict=True):
            motion.set_value(value)

    def is_twisted(self) -> bool:
        """Whether an obstacle that turns freely has turned too far.

        A turn further its points are where they were: to a solution there are others.
        """
        turns = (
            float(contact.free_angle.value) - contact.contact_kinematics.committed_angle
            for contact in self.contacts
            if contact.free_angle is not None
        )
        return any(not abs(turn) < _TURN for turn in turns)

    def is_degenerate(self) -> bool:
        """Whether Γc has lost its tangent plane somewhere; see `Pairs.degenerate`."""
        return any(contact.pairs.degenerate for contact in self.contacts)

    @abstractmethod
    def state(self) -> Array:
        """The present unknowns of this rank; a copy."""

    @abstractmethod
    def set_state(self, state: Array) -> None:
        """Make a state the present one. Collective."""

    def part(self, state: Array) -> Array:
        """What of a state of all unknowns is in this system, by default all of it. Collective."""
        return state

    def extended(self, change: Array) -> Array:
        """The change of all unknowns that one of those in this system brings along. Collective."""
        return change

    # ---- an increment ----------------------------------------------------------------------------

    @abstractmethod
    def begin(self, load: Array) -> None:
        """Start an increment under a load over all unknowns, u with its conditions. Collective."""

    @property
    def pending_field(self) -> Array | None:
        """What `complete` needs of the present increment; None: nothing is outside."""
        return None

    def complete(self, field: Array | None) -> None:
        """Find the unknowns outside of the system for those inside, if there are any. Collective.

        Args:
            field: What `pending_field` was in the increment that set those inside.
        """
        return

    @abstractmethod
    def forces(self, bulk: Array, reaction: Array) -> Forces:
        """For the energies: forces at the present state, in the coordinates of ``coordinate_id``.

        Args:
            bulk: Residual of the bulk, (n,) (force).
            reaction: Forces at the constrained unknowns, zero at others, (n,) (force).
        """

    def present_forces(self, bulk: Array | None = None) -> Forces:
        """`forces` of the present state, with the reactions that balance it. Collective.

        Args:
            bulk: Residual of the bulk, by default `bulk_force`.
        """
        bulk = self.bulk_force() if bulk is None else bulk
        return self.forces(bulk, np.where(self.constrained, bulk + self.contact_force(), 0.0))

    @abstractmethod
    def forget(self) -> None:
        """Drop what was retained of earlier increments and could show in the digits of the next."""

    @abstractmethod
    def bulk_force(self) -> Array:
        """The residual without contact's: the bulk's and the free obstacles'. Collective."""

    @abstractmethod
    def bulk_energy(self) -> float:
        """This rank's part of the potential of a linear bulk and its loads, up to a constant."""

    # ---- matrices --------------------------------------------------------------------------------

    def update(self) -> int:
        """Take the bulk's tangent as it is now; number of factorisations. Collective.

        By default `fill` takes it as it is.
        """
        return 0

    @abstractmethod
    def matrix(self, *, symmetric: bool) -> PETSc.Mat:
        """A new matrix for `fill`. Collective.

        Args:
            symmetric: Whether what will be filled in is symmetric.
        """

    @abstractmethod
    def bulk_diagonal(self) -> Array:
        """Diagonal of the bulk's tangent at this rank's unknowns, (n_local,) (force/length)."""

    @abstractmethod
    def linear_solver(self, *, symmetric: bool, accurate: bool) -> dict[str, Any]:
        """Options of the solver for `matrix`; see `linear.options`."""

    def prepare(self, ksp: PETSc.KSP, matrix: PETSc.Mat) -> None:
        """Give a solver a matrix of `matrix`. Collective."""
        ksp.setOperators(matrix)

    @property
    def pattern_changes(self) -> bool:
        """Whether what `fill` makes has another pattern each time."""
        return False

    @abstractmethod
    def fill(self, matrix: PETSc.Mat, contacts: Iterable[PETSc.Mat]) -> int:
        """Bulk tangent plus contact, conditions applied, dimensionless. Collective.

        Args:
            matrix: What to fill.
            contacts: Contact's part, used up.

        Returns:
            How many factorisations of sparse matrices this leads to.
        """
