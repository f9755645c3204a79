"""Rigid motions of bodies and obstacles, at the unknowns and at contact points."""

from __future__ import annotations

import weakref

import numpy as np
import scipy.linalg
import scipy.sparse

from fenics_contact import compat
from fenics_contact.parallel import global_sum
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.modes import rigid_motions
from fenics_contact.systems.operator import ContactOperator
from fenics_contact.systems.reference_scales import body_of_points
from fenics_contact.systems.system import System
from fenics_contact.tolerances import FLAT
from fenics_contact.types import Array, Index
from fenics_contact.wording import format_point

__all__ = ["RigidMotions"]


class RigidMotions:
    """Translations and rotations of every body, and the unknown motions of obstacles.

    A body is a connected part of the mesh. Rotations are about its centre and scaled by its size,
    so that all motions are displacements of order one. The constructor is collective.

    Args:
        full: The system; each unknown motion of an obstacle is one rigid motion.

    Attributes:
        comm: MPI communicator.
        names: Name of every motion, those of the bodies first.
        rotation_length: Size of the body for its rotations, whose angle times size is of order one
            (length); 0 for other motions.
        is_obstacle_rotation: Mask of the rotations of obstacles, whose lever arms depend on the
            state.
        of_bodies: Translations, then rotations, of the undeformed bodies: at each of this rank's
            unknowns those of its own body, (n_per_body, n_local).
        matrix: All motions of the undeformed bodies, sparse, (n_motions, n_local): those of the
            first body, of the second, ..., and of the obstacles.
    """

    def __init__(self, full: FullSystem) -> None:
        space, unknowns, scales = full.displacement.u.function_space, full.unknowns, full.scales
        n_owned = space.dofmap.index_map.size_local
        x = space.tabulate_dof_coordinates()[:n_owned, : full.gdim]
        self.comm, self._full, self._scales = unknowns.comm, full, scales
        self._n_bodies, self._centres, self._sizes = scales.n_bodies, scales.centre, scales.size
        self._displacement, self._unknowns, self._x = full.displacement, unknowns, x
        self.names: list[str] = []
        lengths: list[float] = []
        for b, (centre, size) in enumerate(zip(self._centres, self._sizes, strict=True)):
            of = f" of body {b + 1}, near {format_point(centre)}" if self._n_bodies > 1 else ""
            for name in rigid_motions(x[:0], 1.0):
                self.names.append(name + of)
                lengths.append(size if name.startswith("rotation") else 0.0)
        obstacles = [(contact.name, m) for contact in full.contacts for m in contact.motions]
        self.names += [f"{m.kind} {m.way} of the obstacle of {name}" for name, m in obstacles]
        is_obstacle_rotation = [False] * len(lengths) + [m.turns for _, m in obstacles]
        self.rotation_length = np.array(lengths + [0.0] * len(obstacles))
        self.is_obstacle_rotation = np.array(is_obstacle_rotation, dtype=np.bool_)
        self.of_bodies = self._of_bodies_at(x)
        self.matrix = self._assemble_matrix(self.of_bodies)
        self._displacements: weakref.WeakKeyDictionary[ContactOperator, list[tuple[Index, Array]]]
        self._displacements = weakref.WeakKeyDictionary()

    def _of_bodies_at(self, x: Array) -> Array:
        """Return `of_bodies` for positions x of this rank's nodes, (n_per_body, n_local)."""
        body = self._full.body[: len(x)]
        arm = (x - self._centres[body]) / self._sizes[body, None]
        zero = np.zeros(self._unknowns.n_motions)
        motions = [self._assemble_field(each, zero) for each in rigid_motions(arm, 1.0).values()]
        return np.array(motions)

    def _assemble_matrix(self, of_bodies: Array) -> scipy.sparse.csc_matrix:
        """Return the `matrix` for motions of the bodies, (n_per_body, n_local)."""
        by_unknown = np.ascontiguousarray(of_bodies.T)
        n, (n_local, n_per_body) = self._unknowns.n_dofs, by_unknown.shape
        # On the rank of the obstacles every motion of one is an unknown.
        first = self._n_bodies * n_per_body
        unknown, motion = np.nonzero(by_unknown)
        rows = self._scales.partition.label[unknown] * n_per_body + motion
        rows = np.append(rows, first + np.arange(n_local - n))
        values = np.append(by_unknown[unknown, motion], np.ones(n_local - n))
        columns = np.append(unknown, np.arange(n, n_local))
        pointers = np.append(0, np.cumsum(np.bincount(columns, minlength=n_local)))
        shape = len(self.names), n_local
        return scipy.sparse.csc_matrix((values, rows, pointers), shape)

    def present_matrix(self) -> scipy.sparse.csc_matrix:
        """Return the motions at the present positions as `matrix`.

        For a linear bulk they are those of the undeformed bodies: only small rotations are rigid.
        """
        if self._full.bulk.linear:
            return self.matrix
        return self._assemble_matrix(self._of_bodies_at(self._node_positions()))

    def gram(self, matrix: scipy.sparse.csc_matrix) -> Array:
        """Return the products of all motions of a `matrix`, (n_motions, n_motions). Collective."""
        return np.asarray(global_sum(self.comm, (matrix @ matrix.T).toarray()))

    def gram_by_body(self) -> Array:
        """Return the products of the motions of every undeformed body with each other. Collective.

        Returns:
            Array (n_bodies, n_per_body, n_per_body).
        """
        n, k = self._n_bodies, len(self.of_bodies)
        blocks = self.gram(self.matrix)[: n * k, : n * k].reshape(n, k, n, k)
        return np.asarray(np.moveaxis(np.diagonal(blocks, axis1=0, axis2=2), -1, 0))

    def _assemble_field(self, displacement: Array, obstacles: Array) -> Array:
        """Return the unknowns for nodal displacements, (n_nodes, gdim), and obstacles."""
        return self._unknowns.joined(self._displacement.within(displacement.ravel()), obstacles)

    def _split(self, coefficients: Array) -> tuple[Array, Array]:
        """Split coefficients into those of bodies, (n_bodies, n_per_body), and of obstacles."""
        n_modes = self._n_bodies * len(self.of_bodies)
        return coefficients[:n_modes].reshape(self._n_bodies, -1), coefficients[n_modes:]

    def field(self, by_body: Array) -> Array:
        """Return the displacement field of motions at this rank's unknowns, (n_local,).

        Args:
            by_body: Coefficients of the first k motions of every undeformed body, (n_bodies, k).
        """
        coefficients = np.zeros((self._n_bodies, len(self.of_bodies)))
        coefficients[:, : by_body.shape[1]] = by_body
        return self.matrix.T @ np.append(coefficients, np.zeros(self._unknowns.n_motions))

    def by_body(self, values: Array) -> Array:
        """Return this rank's products of values with motions, (n_bodies, n_per_body)."""
        return self._split(self.matrix @ values)[0]

    def by_body_on(self, system: System, values: Array) -> Array:
        """Return `by_body` for values at all or the retained unknowns of a system. Collective."""
        if system is self._full:
            return self.by_body(values)
        n = self._n_bodies
        motions = (system.restrict(motion) for motion in self.of_bodies)
        return np.stack([system.partition.products(m, values)[:n] for m in motions], axis=1)

    def rotate(self, coefficients: Array) -> Array:
        """Return the change of the unknowns, (n_local,), for finite motions from the present state.

        The coefficients are of all motions, (n_motions,).
        """
        x, (by_body, obstacles) = self._node_positions(), self._split(coefficients)
        displacement, d = np.zeros_like(x), x.shape[1]
        for b, of_body in enumerate(by_body):
            twist = np.zeros((d + 1, d + 1))  # in homogeneous coordinates
            points = np.vstack([np.zeros(d), np.eye(d)])
            modes = np.array(list(rigid_motions(points, self._sizes[b]).values()))
            velocity = np.tensordot(of_body, modes, axes=1)
            twist[:d, d], twist[:d, :d] = velocity[0], (velocity[1:] - velocity[0]).T
            change = scipy.linalg.expm(twist)[:d] - np.eye(d + 1)[:d]
            nodes = self._full.body[: len(x)] == b
            displacement[nodes] = (x[nodes] - self._centres[b]) @ change[:, :d].T + change[:, d]
        return self._assemble_field(displacement, obstacles)

    def _node_positions(self) -> Array:
        """Return the present positions of this rank's nodes, (n_nodes, gdim) (length)."""
        n, d = self._x.shape
        return self._x + self._displacement.u.x.array[: n * d].reshape(n, d)

    def work(self, operator: ContactOperator, force: Array) -> Array:
        """Return the work of contact forces on the motions of the bodies on both sides. Collective.

        The motion of the slave side follows from the positions of the points, independently of the
        map that transfers the forces in the solver.

        Args:
            operator: Operator of the contact, over all unknowns.
            force: Forces on the slave body, (n_points, gdim) (force).

        Returns:
            This rank's part, (n_bodies, n_per_body) (force): translations, then rotations about the
            centre divided by the size.
        """
        if operator not in self._displacements:
            self._displacements[operator] = self._displacements_at(operator)
        result: Array = np.zeros((self._n_bodies, len(self.of_bodies)))
        for body, displacements in self._displacements[operator]:
            np.add.at(result, body, np.einsum("mqd,qd->qm", displacements, force))
        return result

    def _displacements_at(self, operator: ContactOperator) -> list[tuple[Index, Array]]:
        """Return bodies and their rigid displacements on both sides of the points. Collective.

        For every side they are arrays (n_points,) and (n_per_body, n_points, gdim).
        """
        space, contact = self._displacement.u.function_space, operator.contact
        slave = body_of_points(contact, space, self._full.body)
        arm = (contact.points - self._centres[slave]) / self._sizes[slave, None]
        displacements = np.array(list(rigid_motions(arm, 1.0).values()))
        sides = [(slave, displacements)]
        if not contact.contact_kinematics.is_rigid:
            # The jump map gives the displacement of the master side, which may be the same body.
            # Tractions at unpaired points stay unbalanced.
            jumps = np.array([operator.jump(motion) for motion in self.of_bodies])
            difference = operator.jump(self._scales.partition.label.astype(np.float64))[:, 0]
            paired = contact.pairs.paired[:, None]
            master = np.where(
                contact.pairs.paired, slave - np.rint(difference).astype(np.intp), slave
            )
            sides.append((master, np.where(paired, jumps - displacements, 0.0)))
        if compat.geometry_element(space.mesh).degree > space.ufl_element().degree:
            # Displacements of lower degree than the geometry contain no rotations.
            for _, each in sides:
                each[space.mesh.geometry.dim :] = np.nan
        return sides

    def describe(self, coefficients: Array) -> str:
        """Describe a combination of all motions, (n_motions,), in words."""
        fractions = np.abs(coefficients) / np.abs(coefficients).max()
        terms = [
            name if fraction > 1 - FLAT else f"{fraction:.2g} of {name}"
            for name, fraction in zip(self.names, fractions, strict=True)
            if fraction > FLAT
        ]
        return " with ".join(terms)
