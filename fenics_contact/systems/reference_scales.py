"""Reference scales of forces, displacements, energies and stiffness, by body.

A quantity is compared with others of the same body or contact, never with the largest of the
problem: unrelated bodies in the same mesh must not change the result for this one.
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
from fenics_contact.systems.partition import Partition
from fenics_contact.tolerances import NEGLIGIBLE, ROUND_OFF
from fenics_contact.types import Array, Index, Mask

__all__ = ["ReferenceScales", "body_of_points"]


class ReferenceScales:
    """Reference quantities of every body and free obstacle, the same on every rank.

    The parts are the bodies, then the free obstacles. Two of them are coupled in an increment if
    they share a contact point. The constructor is collective.

    Args:
        displacement: The displacement within the solution function.
        body: Body of every node of this rank, ghosts last.
        partition: Bodies and free obstacles of this rank's unknowns.
        is_displacement: Mask of the unknowns that are displacements or motions, (n_local,).
        n_motions: Number of free motions of obstacles, each of which is a part.
        contacts: Contacts of the problem.

    Attributes:
        n_bodies: Number of bodies.
        partition: Parts of this rank's unknowns.
        centre: Middle of the bounding box of every body, (n_bodies, gdim) (length).
        size: Diagonal of that box, (n_bodies,) (length).
        cell_size: Mean cell size, (n_bodies,) (length).
        mesh_size: Diagonal of the bounding box of all bodies (length).
        stiffness: Largest diagonal entry of the bulk tangent, (n_bodies,) (force/length).
        min_force: Smallest positive diagonal entry times size, (n_bodies,) (force).
        group: Group of coupled parts of every part, (n_parts,).
        contact_bodies: Mask of the bodies that a contact couples, with the pairs at the start of
            the increment, (n_contacts, n_bodies).
        constrained: Mask of the parts without free rigid-body modes, (n_parts,).
    """

    def __init__(
        self,
        displacement: Displacement,
        body: npt.NDArray[np.intp],
        partition: Partition,
        is_displacement: Mask,
        n_motions: int,
        contacts: Sequence[Contact],
    ) -> None:
        space = displacement.u.function_space
        self._comm, self.partition = space.mesh.comm, partition
        # Other fields, such as pressures, belong to no part.
        label = np.where(is_displacement, partition.label, -1)
        self._of_displacements = Partition(label, partition.n_parts)
        n_bodies = self._comm.allreduce(int(body.max(initial=-1)), op=MPI.MAX) + 1
        n_owned, d = space.dofmap.index_map.size_local, space.mesh.geometry.dim
        x, own = space.tabulate_dof_coordinates()[:n_owned, :d], body[:n_owned]
        corners = np.full((2, n_bodies, d), np.inf)
        for corner, sign in zip(corners, (1.0, -1.0), strict=True):
            np.minimum.at(corner, own, sign * x)
        self._comm.Allreduce(MPI.IN_PLACE, corners, op=MPI.MIN)
        low, high = corners[0], -corners[1]
        self.n_bodies, self.centre = n_bodies, (low + high) / 2
        self.size: Array = np.linalg.norm(high - low, axis=1)
        self.mesh_size = float(np.linalg.norm(high.max(axis=0) - low.min(axis=0)))
        n_nodes = global_sum(self._comm, np.bincount(own, minlength=n_bodies))
        self.cell_size = np.asarray(self.size / n_nodes ** (1 / d), dtype=np.float64)
        self.stiffness: Array = np.ones(n_bodies)
        self.min_force: Array = np.zeros(n_bodies)
        self.group: Index = np.arange(n_bodies + n_motions)
        self.contact_bodies: Mask = np.zeros((len(contacts), n_bodies), dtype=np.bool_)
        counts = np.cumsum([0] + [len(contact.motions) for contact in contacts])
        self._motions = [
            n_bodies + np.arange(first, last) for first, last in itertools.pairwise(counts)
        ]
        turns = [motion.turns for contact in contacts for motion in contact.motions]
        self._rotations = n_bodies + np.flatnonzero(turns)
        self.constrained: Mask = np.ones(n_bodies + n_motions, dtype=np.bool_)
        self._slave_bodies = [body_of_points(contact, space, body) for contact in contacts]
        self._pairings: list[int] | None = None  # pairs for which groups were found

    @property
    def force(self) -> Array:
        """Stiffness times size, (n_bodies,) (force)."""
        return self.stiffness * self.size

    def measure_stiffness(self, stiffness: PETSc.Mat) -> None:
        """Evaluate the stiffness of the bodies from the bulk tangent. Collective."""
        diagonal = stiffness.getDiagonal()
        entries = diagonal.array_r.copy()
        diagonal.destroy()
        largest = self.largest(entries)
        inverse = self.largest(1.0 / np.where(entries > 0.0, entries, np.inf))
        self.stiffness = np.where(largest > 0, largest, 1.0)
        self.min_force = self.size / np.where(inverse > 0, inverse, np.inf)

    def largest(self, values: Array) -> Array:
        """Return the largest absolute displacement of every body, (n_bodies,). Collective.

        Values of other fields, such as pressures, are ignored.
        """
        result = self._of_displacements.largest(values)
        self._comm.Allreduce(MPI.IN_PLACE, result, op=MPI.MAX)
        return result[: self.n_bodies]

    def largest_at_points(self, number: int, values: Array) -> Array:
        """Return the largest of values ≥ 0, (n_points,), by slave body, (n_bodies,). Collective."""
        result: Array = np.zeros(self.n_bodies)
        np.maximum.at(result, self._slave_bodies[number], values)
        self._comm.Allreduce(MPI.IN_PLACE, result, op=MPI.MAX)
        return result

    def spread(self, values: Array, chosen: Index) -> Array:
        """Return maximum minus minimum of chosen values of every body, (n_bodies,). Collective."""
        ends = np.full((2, len(self.group)), -np.inf)
        for end, sign in zip(ends, (1.0, -1.0), strict=True):
            np.maximum.at(end, self.partition.label[chosen], sign * values[chosen])
        self._comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MAX)
        return np.maximum(ends.sum(axis=0), 0.0)[: self.n_bodies]

    def begin(self, operators: Sequence[ContactOperator]) -> None:
        """Find the groups of coupled parts at the start of an increment. Collective."""
        if self._pairings == (pairings := [o.contact.pairs.n_updates for o in operators]):
            return
        self._pairings, n = pairings, len(self.group)
        self.contact_bodies = np.zeros((len(operators), self.n_bodies), dtype=np.bool_)
        all_pairs: list[Any] = [np.zeros((0, 2), dtype=np.intp)]
        for number, operator in enumerate(operators):
            pairs = self.pairs(operator, number, self.partition.label)
            self.contact_bodies[number, pairs[pairs < self.n_bodies]] = True
            all_pairs.append(pairs)
        links = np.concatenate(all_pairs)
        graph = scipy.sparse.coo_matrix((np.ones(len(links)), links.T), (n, n))
        _, self.group = scipy.sparse.csgraph.connected_components(graph, directed=False)

    @property
    def round_off_of_groups(self) -> Array:
        """Round-off of forces on each group, by its softest body, (n_groups,) (force)."""
        result = np.full(self.n_groups, np.inf)
        np.minimum.at(result, self.group[: self.n_bodies], ROUND_OFF * self.force)
        return np.where(np.isfinite(result), result, 0.0)

    def round_off_at_points(self, number: int, forces: Array) -> Array:
        """Return the round-off of forces at contact points, (n_points,) (force). Collective."""
        group, largest = self.group_of_points(number), np.zeros(self.n_groups)
        np.maximum.at(largest, group, np.where(np.isfinite(forces), forces, 0.0))
        self._comm.Allreduce(MPI.IN_PLACE, largest, op=MPI.MAX)
        return np.asarray(np.maximum(self.round_off_of_groups, NEGLIGIBLE * largest)[group])

    @property
    def size_of_groups(self) -> Array:
        """Size of the largest body of each group, (n_groups,) (length)."""
        result: Array = np.zeros(self.n_groups)
        np.maximum.at(result, self.group[: self.n_bodies], self.size)
        return result

    def size_at_points(self, number: int) -> Array:
        """Return `size_of_groups` at this rank's points of a contact, (n_points,)."""
        return np.asarray(self.size_of_groups[self.group_of_points(number)])

    @property
    def n_groups(self) -> int:
        """Number of groups of coupled parts."""
        return int(self.group.max()) + 1

    def global_sum(self, values: Array) -> Array:
        """Return the sum over all ranks. Collective."""
        return global_sum(self._comm, values)

    def group_of_points(self, number: int) -> Index:
        """Return the group of each of this rank's points of a contact, (n_points,)."""
        return np.asarray(self.group[self._slave_bodies[number]])

    def points_by_group(self, number: int) -> dict[int, Mask]:
        """Return masks of this rank's points of a contact, (n_points,), by group. Collective.

        All ranks have the same groups in the same order.
        """
        group = self.group_of_points(number)
        groups = {n for each in self._comm.allgather(np.unique(group).tolist()) for n in each}
        return {n: group == n for n in sorted(groups)}

    def modulus(self, number: int) -> float:
        """Return the largest stiffness over cell size of the bodies in a contact (stress)."""
        d, bodies = self.centre.shape[1], self.contact_bodies[number]
        moduli = self.stiffness * self.cell_size ** (2 - d)
        return float(moduli[bodies].max(initial=0.0))

    def pairs(self, operator: ContactOperator, number: int, label: Index) -> Index:
        """Return the pairs of parts in a contact, (n_pairs, 2). Collective.

        A body on a rigid obstacle, or without an opposite point, is paired with itself. The
        operator is over unknowns of the parts in ``label``.
        """
        slave, n = self._slave_bodies[number], len(self.group)
        # With part numbers as displacements, the jump is the difference of both sides.
        jump = operator.jump(np.where(np.isin(label, self._rotations), 0.0, label + 1.0))
        master = np.rint(slave[:, None] + 1 - jump).astype(np.intp) - 1
        master = np.where(master < 0, slave[:, None], master)
        masters = [*master.T, *(np.full_like(slave, m) for m in self._motions[number])]
        codes = np.unique(np.concatenate([n * slave + each for each in masters]))
        return np.column_stack(divmod(np.unique(np.concatenate(self._comm.allgather(codes))), n))


def body_of_points(contact: Contact, space: fem.FunctionSpace, body: npt.NDArray[np.intp]) -> Index:
    """Return the slave body of each of this rank's points of Γc, (n_points,)."""
    rows = contact.quadrature.point_rows
    cells = facet_cells(space.mesh, contact.surface.facets)
    own = np.zeros(contact.quadrature.n_points, dtype=np.intp)
    own[rows.ravel()] = np.repeat(body[space.dofmap.list[cells, 0]], rows.shape[1])
    return own
