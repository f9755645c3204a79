"""Reference scales: what forces, displacements, energies and stiffness are compared with.

A quantity is zero, small or large relative to another one of the same body or of the same contact.
The largest one of a problem is no reference: what an unrelated body in the same mesh is, does or
bears must not change what is found of this one.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse.csgraph
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

from fenics_contact.contact.contact import Contact
from fenics_contact.parallel import global_sum
from fenics_contact.surface.displacement import Displacement
from fenics_contact.surface.facets import facet_cells
from fenics_contact.systems.operator import ContactOperator
from fenics_contact.tolerances import NEGLIGIBLE, ROUND_OFF
from fenics_contact.types import Array, Index, Mask

__all__ = ["ReferenceScales", "body_of_points"]


class ReferenceScales:
    """Reference quantities of every body and of every free obstacle, the same on every rank.

    Bodies come first, then the obstacles that move freely (together: the parts). Two of them are
    coupled in an increment if a point of a contact belongs to both. The constructor is collective.

    Args:
        displacement: In what is solved for.
        body: Body of every node of this rank, ghosts last.
        moves: Which of these unknowns are displacements or motions, (n_local,).
        n_motions: Number of free motions of obstacles, each of which is a part.
        contacts: Of the problem.

    Attributes:
        n_bodies: Number of bodies.
        label: Part of every unknown of this rank, (n_local,).
        centre: Middle of the bounding box of every body, (n_bodies, gdim) (length).
        size: Diagonal of that box, (n_bodies,) (length).
        cell_size: Mean size of its cells, (n_bodies,) (length).
        mesh_size: Diagonal of the bounding box of all bodies (length).
        stiffness: Largest entry of a body on the diagonal of the bulk's tangent, (n_bodies,)
            (force/length).
        least_force: Smallest such entry, but those that are none, times size, (n_bodies,) (force).
        group: Number of the group of coupled parts that a part belongs to, (n_parts,).
        touching: Which bodies a contact touches, with the pairs at the start of the increment,
            (n_contacts, n_bodies).
        held: Which parts Dirichlet conditions, or springs of the bulk, hold against every rigid
            motion, (n_parts,).
    """

    def __init__(
        self,
        displacement: Displacement,
        body: npt.NDArray[np.intp],
        label: npt.NDArray[np.intp],
        moves: Mask,
        n_motions: int,
        contacts: Sequence[Contact],
    ) -> None:
        space = displacement.u.function_space
        self._comm, self.label, self._moves = space.mesh.comm, label, moves
        n_bodies = self._comm.allreduce(int(body.max(initial=-1)), op=MPI.MAX) + 1
        n_owned, d = space.dofmap.index_map.size_local, space.mesh.geometry.dim
        x, mine = space.tabulate_dof_coordinates()[:n_owned, :d], body[:n_owned]
        corners = np.full((2, n_bodies, d), np.inf)
        for corner, sign in zip(corners, (1.0, -1.0), strict=True):
            np.minimum.at(corner, mine, sign * x)
        self._comm.Allreduce(MPI.IN_PLACE, corners, op=MPI.MIN)
        low, high = corners[0], -corners[1]
        self.n_bodies, self.centre = n_bodies, (low + high) / 2
        self.size: Array = np.linalg.norm(high - low, axis=1)
        self.mesh_size = float(np.linalg.norm(high.max(axis=0) - low.min(axis=0)))
        n_nodes = global_sum(self._comm, np.bincount(mine, minlength=n_bodies))
        self.cell_size = np.asarray(self.size / n_nodes ** (1 / d), dtype=np.float64)
        self.stiffness: Array = np.ones(n_bodies)
        self.least_force: Array = np.zeros(n_bodies)
        self.group: Index = np.arange(n_bodies + n_motions)
        self.touching: Mask = np.zeros((len(contacts), n_bodies), dtype=np.bool_)
        counts = np.cumsum([0] + [len(contact.motions) for contact in contacts])
        self._motions = [
            n_bodies + np.arange(first, last) for first, last in itertools.pairwise(counts)
        ]
        turns = [motion.turns for contact in contacts for motion in contact.motions]
        self._turning = n_bodies + np.flatnonzero(turns)
        self.held: Mask = np.ones(n_bodies + n_motions, dtype=np.bool_)
        self._own = [body_of_points(contact, space, body) for contact in contacts]
        self._coupled: list[int] | None = None  # numbers of the pairs whose coupling was found

    @property
    def force(self) -> Array:
        """Stiffness times size, (n_bodies,) (force)."""
        return self.stiffness * self.size

    def measure_stiffness(self, stiffness: PETSc.Mat) -> None:
        """Take the stiffness of the bodies from the bulk's tangent. Collective.

        Args:
            stiffness: Over all unknowns, without conditions.
        """
        diagonal = stiffness.getDiagonal()
        entries = diagonal.array_r.copy()
        diagonal.destroy()
        largest = self.largest(entries)
        inverse = self.largest(1.0 / np.where(entries > 0.0, entries, np.inf))
        self.stiffness = np.where(largest > 0, largest, 1.0)
        self.least_force = self.size / np.where(inverse > 0, inverse, np.inf)

    def largest(self, values: Array) -> Array:
        """Largest absolute value of every body, at its displacements, (n_bodies,). Collective.

        Args:
            values: At this rank's unknowns; those at others, such as pressures, do not count.
        """
        found: Array = np.zeros(len(self.group))
        np.maximum.at(found, self.label[self._moves], np.abs(values[self._moves]))
        self._comm.Allreduce(MPI.IN_PLACE, found, op=MPI.MAX)
        return found[: self.n_bodies]

    def largest_at_points(self, number: int, values: Array) -> Array:
        """Largest value of every body at the points of a contact, (n_bodies,). Collective.

        Args:
            number: Of the contact.
            values: At this rank's points, (n_points,), not negative.
        """
        found: Array = np.zeros(self.n_bodies)
        np.maximum.at(found, self._own[number], values)
        self._comm.Allreduce(MPI.IN_PLACE, found, op=MPI.MAX)
        return found

    def spread(self, values: Array, chosen: Mask) -> Array:
        """Largest less smallest of some values of every body, (n_bodies,). Collective.

        Args:
            values: At this rank's unknowns.
            chosen: Which of them count.
        """
        ends = np.full((2, len(self.group)), -np.inf)
        for end, sign in zip(ends, (1.0, -1.0), strict=True):
            np.maximum.at(end, self.label[chosen], sign * values[chosen])
        self._comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MAX)
        return np.maximum(ends.sum(axis=0), 0.0)[: self.n_bodies]

    def begin(self, operators: Sequence[ContactOperator]) -> None:
        """Find which parts are coupled. Collective.

        Args:
            operators: Of the contacts, over all unknowns, at the start of an increment.
        """
        if self._coupled == (coupled := [o.contact.pairs.number for o in operators]):
            return
        self._coupled, n = coupled, len(self.group)
        self.touching = np.zeros((len(operators), self.n_bodies), dtype=np.bool_)
        every: list[Any] = [np.zeros((0, 2), dtype=np.intp)]
        for number, operator in enumerate(operators):
            pairs = self.pairs(operator, number, self.label)
            self.touching[number, pairs[pairs < self.n_bodies]] = True
            every.append(pairs)
        links = np.concatenate(every)
        graph = scipy.sparse.coo_matrix((np.ones(len(links)), links.T), (n, n))
        _, self.group = scipy.sparse.csgraph.connected_components(graph, directed=False)

    @property
    def round_off_of_groups(self) -> Array:
        """Force on a group of coupled parts that is round-off, of its softest body, (n_groups,)."""
        found = np.full(self.n_groups, np.inf)
        np.minimum.at(found, self.group[: self.n_bodies], ROUND_OFF * self.force)
        return np.where(np.isfinite(found), found, 0.0)

    def round_off_at_points(self, number: int, forces: Array) -> Array:
        """Force at points of a contact that is round-off, by their group, (n_points,). Collective.

        Args:
            number: Of the contact.
            forces: Sizes of forces there, (n_points,) (force).
        """
        group, largest = self.group_of_points(number), np.zeros(self.n_groups)
        np.maximum.at(largest, group, np.where(np.isfinite(forces), forces, 0.0))
        self._comm.Allreduce(MPI.IN_PLACE, largest, op=MPI.MAX)
        return np.asarray(np.maximum(self.round_off_of_groups, NEGLIGIBLE * largest)[group])

    @property
    def size_of_groups(self) -> Array:
        """Size of the largest body of a group of coupled parts, (n_groups,) (length)."""
        found: Array = np.zeros(self.n_groups)
        np.maximum.at(found, self.group[: self.n_bodies], self.size)
        return found

    def size_at_points(self, number: int) -> Array:
        """`size_of_groups` at this rank's points of a contact, by its number, (n_points,)."""
        return np.asarray(self.size_of_groups[self.group_of_points(number)])

    @property
    def n_groups(self) -> int:
        """Number of groups of coupled parts."""
        return int(self.group.max()) + 1

    def global_sum(self, values: Array) -> Array:
        """Sum over all ranks. Collective."""
        return global_sum(self._comm, values)

    def group_of_points(self, number: int) -> Index:
        """Groups of the bodies with this rank's points of a contact, by its number, (n_points,)."""
        return np.asarray(self.group[self._own[number]])

    def parts_of(self, number: int) -> dict[int, Mask]:
        """Masks of this rank's points of a contact, (n_points,), by the group they are on.

        Collective; all ranks have the same groups, in the same order.
        """
        group = self.group_of_points(number)
        every = {n for each in self._comm.allgather(np.unique(group).tolist()) for n in each}
        return {n: group == n for n in sorted(every)}

    def modulus(self, number: int) -> float:
        """Stiffness of the bodies that a contact touches, by the size of their cells (stress)."""
        d, mine = self.centre.shape[1], self.touching[number]
        moduli = self.stiffness * self.cell_size ** (2 - d)
        return float(moduli[mine].max(initial=0.0))

    def pairs(self, operator: ContactOperator, number: int, label: Index) -> Index:
        """Parts that a contact presses on each other, (n_pairs, 2). Collective.

        A body that it presses on a rigid obstacle, or on nothing, is paired with itself.

        Args:
            operator: Of the contact, over some unknowns.
            number: Of the contact.
            label: Part of each of these unknowns.
        """
        own, n = self._own[number], len(self.group)
        # Of the number of the part as a displacement a jump is the difference of both sides.
        jump = operator.jump(np.where(np.isin(label, self._turning), 0.0, label + 1.0))
        opposite = np.rint(own[:, None] + 1 - jump).astype(np.intp) - 1
        opposite = np.where(opposite < 0, own[:, None], opposite)
        others = [*opposite.T, *(np.full_like(own, m) for m in self._motions[number])]
        mine = np.unique(np.concatenate([n * own + other for other in others]))
        return np.column_stack(divmod(np.unique(np.concatenate(self._comm.allgather(mine))), n))


def body_of_points(contact: Contact, space: fem.FunctionSpace, body: npt.NDArray[np.intp]) -> Index:
    """The body behind each of this rank's points of Γc, (n_points,)."""
    rows = contact.quadrature.point_rows
    cells = facet_cells(space.mesh, contact.surface.facets)
    own = np.zeros(contact.quadrature.n_points, dtype=np.intp)
    own[rows.ravel()] = np.repeat(body[space.dofmap.list[cells, 0]], rows.shape[1])
    return own
