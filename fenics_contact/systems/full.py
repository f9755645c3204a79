"""What the iteration runs on: all unknowns of a problem. `condense` has the other space."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from petsc4py import PETSc

from fenics_contact.contact.contact import Contact
from fenics_contact.surface.bodies import connected_bodies
from fenics_contact.systems import linear
from fenics_contact.systems.balance import Parts, by_body
from fenics_contact.systems.bulk import Bulk
from fenics_contact.systems.forces import Forces
from fenics_contact.systems.operator import ContactOperator, contact_operators
from fenics_contact.systems.unknowns import Unknowns

__all__ = ["FullSystem"]

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


class FullSystem:
    """All unknowns: states, forces and matrices over them.

    Attributes:
        unknowns: The unknowns of the space.
        constrained: Mask over this rank's unknowns: those with Dirichlet conditions.
        prescribed: Values at them, in the present increment.
        load: External forces at them (force).
        diagonal: Diagonal of the matrix assembled last (force/length).
        outside: Norms of load and of `terms` at unknowns outside of the space, (2, n_bodies).
        reach: Largest displacement whose round-off counts (length).
        label: Body or free support of every unknown of this rank, (n_local,).
        n_bodies: Their number.
        iterations_per_round: Iterations of L-BFGS after which H₀ is made anew from the status: one
            costs 1/15 to 1/35 of a factorisation, and pairs taken across changes of status are
            worth little.
        ready: Whether `fill` can be called; else `update` comes first.
        linear_kind: How linear systems are solved, one of `linear.KINDS`.
        mark: Of the coordinates that `forces` are in.
    """

    iterations_per_round = 20
    linear_kind = "direct"

    def __init__(
        self,
        u: fem.Function,
        unknowns: Unknowns,
        bulk: Bulk,
        contacts: Sequence[Contact],
        constrained: Mask,
    ) -> None:
        """Take over the parts of a problem. Collective."""
        self.u, self.unknowns, self.bulk = u, unknowns, bulk
        self.contacts, self.constrained = contacts, constrained
        self.motions = [c for contact in contacts for c in contact.free_motion.values()]
        self.prescribed: Array = np.zeros(int(constrained.sum()))
        self.load = np.zeros(unknowns.n_local)
        self.diagonal = np.zeros(unknowns.n_local)
        self._label_unknowns()
        self.outside: Array = np.zeros((2, self.n_bodies))
        self.reach = np.inf
        self._parts: tuple[list[int], Parts] | None = None
        self.ready = True
        self._near_nullspace: PETSc.NullSpace | None = None
        self.mark: object = FullSystem
        self._contact_vector = unknowns.vector()
        self._operators: tuple[list[int], list[ContactOperator]] | None = None

    @property
    def operators(self) -> list[ContactOperator]:
        """What the contacts are over these unknowns, with the pairs as they are. Collective."""
        pairings = [c.pairings for c in self.contacts]
        if self._operators is None or self._operators[0] != pairings:
            self._operators = pairings, contact_operators(self.contacts, self.unknowns)
        return self._operators[1]

    def _label_unknowns(self) -> None:
        """Tell bodies and free supports apart. Collective."""
        n, body = connected_bodies(self.u.function_space)
        dofs = np.repeat(body, len(self.u))[: self.unknowns.n_dofs]
        motions = n + np.arange(len(self.motions))
        label = self.unknowns.joined(dofs.astype(np.float64), motions.astype(np.float64))
        self.label = label.astype(np.intp)
        self.n_bodies = n + len(self.motions)

    @property
    def parts(self) -> Parts:
        """What has to be in balance, for the present pairs. Collective."""
        pairings = [c.pairings for c in self.contacts]
        if self._parts is None or self._parts[0] != pairings:
            moving = [(n, i) for n, c in enumerate(self.contacts) for i in c.free_motion]
            n = self.n_bodies - len(moving)
            bodies = [f"body {b + 1}" if n > 1 else "the body" for b in range(n)]
            bodies += [f"support of {self.contacts[c].name} along {'xyz'[i]}" for c, i in moving]
            touched = [operator.touched for operator in self.operators]
            names = [c.name for c in self.contacts]
            parts = Parts(
                self.unknowns.comm, self.label, bodies, names, touched, [c for c, _ in moving]
            )
            self._parts = pairings, parts
        return self._parts[1]

    def vector(self) -> PETSc.Vec:
        """A new vector over the unknowns. Collective."""
        return self.unknowns.vector()

    def linear_solver(self, *, symmetric: bool, accurate: bool) -> dict[str, Any]:
        """Options of the solver for `matrix`; see `linear.options`."""
        return linear.options(self.linear_kind, symmetric=symmetric, accurate=accurate)

    def update(self, stiffness: PETSc.Mat) -> int:
        """Take a new bulk tangent over all unknowns; number of factorisations. Collective."""
        return 0

    def terms(self, state: Array) -> Array:
        """Size of what K u sums up in each row, whose round-off is left in it (force)."""
        return np.asarray(self.diagonal * np.clip(state, -self.reach, self.reach))

    def by_body(self, *vectors: Array) -> Array:
        """Norms of vectors over the unknowns, (n_vectors, n_bodies). Collective."""
        return by_body(self.unknowns.comm, vectors, self.label, self.n_bodies)

    def state(self) -> Array:
        """The present unknowns of this rank; a copy."""
        motions = np.array([float(c.value) for c in self.motions])
        return self.unknowns.joined(self.u.x.array[: self.unknowns.n_dofs], motions)

    def set_state(self, state: Array) -> None:
        """Make a state the present one. Collective."""
        self.u.x.array[: self.unknowns.n_dofs] = state[: self.unknowns.n_dofs]
        self.u.x.scatter_forward()
        self._set_motions(state)

    def _set_motions(self, state: Array) -> None:
        for constant, value in zip(self.motions, self.unknowns.motions(state), strict=True):
            constant.value = value

    def part(self, state: Array) -> Array:
        """What of a state of all unknowns is in this space."""
        return state

    def extended(self, change: Array) -> Array:
        """The change of all unknowns that one of those in this space brings along. Collective."""
        return change

    def begin(self, load: Array) -> None:
        """Start an increment under a load over all unknowns, u with its conditions. Collective."""
        self.load = load
        self.prescribed = self.state()[self.constrained]

    @property
    def pending_field(self) -> Array | None:
        """What `complete` needs of the present increment; None: nothing is outside."""
        return None

    def complete(self, field: Array | None) -> None:
        """Find the unknowns outside of the space for those inside. Collective.

        Args:
            field: What the attribute was in the increment that set those inside.
        """

    def forces(self, bulk: Array, reaction: Array) -> Forces:
        """For the energies: forces at the present state, in the coordinates of ``mark``.

        Args:
            bulk: Residual of the bulk, (n,) (force).
            reaction: Forces at the constrained unknowns, zero at others, (n,) (force).
        """
        return Forces(self.state(), bulk + self.load, self.load + reaction)

    def forget(self) -> None:
        """Drop what was kept of earlier increments and could show in the digits of the next."""

    def contact_forces(self) -> list[Array]:
        """Parts of the residual at the present state by contact, (n_local,) each. Collective."""
        forces = []
        for operator in self.operators:
            self._contact_vector.set(0.0)
            operator.add_force(self._contact_vector)
            forces.append(self._contact_vector.array_r.copy())
        return forces

    def contact_force(self) -> Array:
        """Their sum, (n_local,). Collective."""
        return sum(self.contact_forces(), np.zeros(self.unknowns.n_local))

    def bulk_force(self) -> Array:
        """The rest of the residual: the bulk's, and the forces on free supports. Collective."""
        return self.with_supports(self.bulk.residual())

    def bulk_energy(self) -> float:
        """This rank's part of the potential of a linear bulk and its loads, up to a constant."""
        # F(u) = K u + F(0), so that it is (F(u) + F(0))·u/2.
        return float(0.5 * (self.bulk_force() - self.load) @ self.state())

    def with_supports(self, residual: Array) -> Array:
        """A residual over the dofs with that of the free supports, which their forces are."""
        forces = [f for c in self.contacts for f in _numbers(c.applied_force)]
        return self.unknowns.joined(residual, -np.array(forces))

    def matrix(self, stiffness: PETSc.Mat, *, symmetric: bool) -> PETSc.Mat:
        """A new matrix for `fill`. Collective.

        Its pattern is that of the bulk and, with deformable or moving supports, of the pairs.

        Args:
            stiffness: Bulk tangent over all unknowns.
            symmetric: Whether what will be filled in is symmetric.
        """
        different = PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN
        matrix = stiffness.copy()
        for operator in self.operators:
            if operator.contact.couples:
                part = operator.springs(operator.contact.springs(1.0, 1.0))
                matrix.axpy(1.0, part, different)
                part.destroy()
        matrix.setOption(PETSc.Mat.Option.KEEP_NONZERO_PATTERN, True)
        matrix.setOption(PETSc.Mat.Option.SYMMETRIC, symmetric)
        if matrix.getBlockSize() == len(self.u):  # no supports move freely
            if self._near_nullspace is None:
                self._near_nullspace = linear.near_nullspace(self.u.function_space)
            matrix.setNearNullSpace(self._near_nullspace)
        return matrix

    def prepare(self, ksp: PETSc.KSP, matrix: PETSc.Mat) -> None:
        """Give a solver a matrix of `matrix`. Collective."""
        ksp.setOperators(matrix)

    def fill(self, matrix: PETSc.Mat, stiffness: PETSc.Mat, contacts: Iterable[PETSc.Mat]) -> int:
        """Bulk tangent plus contact, conditions applied, dimensionless. Collective.

        Args:
            matrix: What to fill.
            stiffness: Bulk tangent over all unknowns.
            contacts: Contact's part, used up.

        Returns:
            How many factorisations of sparse matrices this leads to.
        """
        subset = PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN
        if not any(c.couples for c in self.contacts):
            stiffness.copy(matrix, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        else:
            matrix.zeroEntries()
            matrix.axpy(1.0, stiffness, subset)
        for part in contacts:
            matrix.axpy(1.0, part, subset)
            part.destroy()
        start, _ = matrix.getOwnershipRange()
        rows = (start + np.flatnonzero(self.constrained)).astype(PETSc.IntType)
        scale = self.bulk.scale
        matrix.zeroRowsColumns(rows, diag=scale)
        diagonal = matrix.getDiagonal()
        self.diagonal = diagonal.array.copy()
        diagonal.destroy()
        matrix.scale(1.0 / scale)
        return int(self.linear_kind == "direct")


def _numbers(forces: Mapping[int, Any]) -> list[float]:
    """Values of numbers and scalar constants."""
    return [float(f.value if isinstance(f, fem.Constant) else f) for f in forces.values()]
