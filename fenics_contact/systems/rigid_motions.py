"""The rigid motions of bodies and free obstacles, at unknowns and at the points of contacts."""

from __future__ import annotations

import weakref

import numpy as np
import scipy.linalg

from fenics_contact import compat
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.modes import rigid_motions
from fenics_contact.systems.operator import ContactOperator
from fenics_contact.systems.reference_scales import body_of_points
from fenics_contact.systems.system import System
from fenics_contact.tolerances import FLAT
from fenics_contact.types import Array, Index
from fenics_contact.wording import place_in_words

__all__ = ["RigidMotions"]


class RigidMotions:
    """Translations and rotations of every body of a mesh, and the free motions of obstacles.

    A body is a part of the mesh connected by its displacements. Rotations are about the body's
    middle and scaled by its size, so that every motion is a displacement of order one. The
    constructor is collective.

    Args:
        full: The system. Each free motion of an obstacle is a rigid motion of its own.

    Attributes:
        comm: The ranks.
        names: Name of every motion, those of the bodies first.
        turns: Which of these turn a body, and the size of it by which the angle has to be
            multiplied to be one of order one (length); 0 for the others.
        obstacle_turns: Which of these are rotations of obstacles, whose arms change with the state.
        of_bodies: Translations, then rotations, of the undeformed bodies: at each of this rank's
            unknowns those of its own body, (n_per_body, n_local).
    """

    def __init__(self, full: FullSystem) -> None:
        space, unknowns, scales = full.displacement.u.function_space, full.unknowns, full.scales
        n_owned = space.dofmap.index_map.size_local
        x = space.tabulate_dof_coordinates()[:n_owned, : full.gdim]
        self.comm, self._full, self._scales = unknowns.comm, full, scales
        self._n_bodies, self._centres, self._sizes = scales.n_bodies, scales.centre, scales.size
        self._displacement, self._unknowns, self._x = full.displacement, unknowns, x
        self.names: list[str] = []
        turns: list[float] = []
        for b, (centre, size) in enumerate(zip(self._centres, self._sizes, strict=True)):
            of = f" of body {b + 1}, near {place_in_words(centre)}" if self._n_bodies > 1 else ""
            for name in rigid_motions(x[:0], 1.0):
                self.names.append(name + of)
                turns.append(size if name.startswith("rotation") else 0.0)
        moving = [(contact.name, m) for contact in full.contacts for m in contact.motions]
        self.names += [f"{m.kind} {m.way} of the obstacle of {name}" for name, m in moving]
        obstacle_turns = [False] * len(turns) + [m.turns for _, m in moving]
        self.turns = np.array(turns + [0.0] * len(moving))
        self.obstacle_turns = np.array(obstacle_turns, dtype=np.bool_)
        self.of_bodies = self._of_bodies_at(x)
        self._travels: weakref.WeakKeyDictionary[ContactOperator, list[tuple[Index, Array]]]
        self._travels = weakref.WeakKeyDictionary()

    def _of_bodies_at(self, x: Array) -> Array:
        """`of_bodies`, with the nodes of this rank at places, (n_per_body, n_local)."""
        body = self._full.body[: len(x)]
        arm = (x - self._centres[body]) / self._sizes[body, None]
        nothing = np.zeros(self._unknowns.n_motions)
        motions = [self._over_unknowns(each, nothing) for each in rigid_motions(arm, 1.0).values()]
        return np.array(motions)

    def _over_unknowns(self, displacement: Array, obstacles: Array) -> Array:
        """Displacements of this rank's nodes, (n_nodes, gdim), and of the obstacles."""
        return self._unknowns.joined(self._displacement.within(displacement.ravel()), obstacles)

    def _by_part(self, coefficients: Array) -> tuple[Array, Array]:
        """Coefficients of all motions by body, (n_bodies, n_per_body), and by obstacle."""
        n_modes = self._n_bodies * len(self.of_bodies)
        return coefficients[:n_modes].reshape(self._n_bodies, -1), coefficients[n_modes:]

    def field(
        self, by_body: Array, obstacles: Array | None = None, *, of_bodies: Array | None = None
    ) -> Array:
        """The displacement by motions, at this rank's unknowns, (n_local,).

        Args:
            by_body: Coefficients of the first k motions of every body, (n_bodies, k).
            obstacles: Of the motions of obstacles; None: these are at rest.
            of_bodies: Motions of the bodies, if not of the undeformed ones; see the attribute.
        """
        motions = self.of_bodies if of_bodies is None else of_bodies
        n, label = self._unknowns.n_dofs, self._scales.label
        dofs = np.einsum("im,mi->i", by_body[label[:n]], motions[: by_body.shape[1], :n])
        still = np.zeros(self._unknowns.n_motions)
        return self._unknowns.joined(dofs, still if obstacles is None else obstacles)

    def by_body(self, system: System, values: Array, of_bodies: Array | None = None) -> Array:
        """Sums of values times the motions of each body, this rank's part.

        Args:
            system: The unknowns.
            values: At these.
            of_bodies: See `field`.

        Returns:
            Array (n_bodies, n_per_body).
        """
        motions, n = self.of_bodies if of_bodies is None else of_bodies, self._n_bodies
        products = [system.part(motion) * values for motion in motions]
        found = [np.bincount(system.label, p, minlength=n)[:n] for p in products]
        return np.stack(found, axis=1).astype(np.float64)  # of none NumPy counts integers

    def _sums(self, values: Array, of_bodies: Array | None = None) -> Array:
        """Sums of values at this rank's unknowns times all motions, (n_motions,)."""
        obstacles = np.zeros(self._unknowns.n_motions)
        if self._unknowns.has_motions_here:
            obstacles[:] = values[self._unknowns.n_dofs :]
        return np.append(self.by_body(self._full, values, of_bodies), obstacles)

    def turned(self, coefficients: Array) -> Array:
        """By how much unknowns change as bodies go on, and turn about their centres, from here.

        Rotations are of any size.

        Args:
            coefficients: Of all motions, (n_motions,).

        Returns:
            Over this rank's unknowns, (n_local,).
        """
        x, (by_body, obstacles) = self._places(), self._by_part(coefficients)
        way, d = np.zeros_like(x), x.shape[1]
        for b, of_body in enumerate(by_body):
            twist = np.zeros((d + 1, d + 1))  # of homogeneous coordinates
            here = np.vstack([np.zeros(d), np.eye(d)])
            kinds = np.array(list(rigid_motions(here, self._sizes[b]).values()))
            at = np.tensordot(of_body, kinds, axes=1)
            twist[:d, d], twist[:d, :d] = at[0], (at[1:] - at[0]).T
            change = scipy.linalg.expm(twist)[:d] - np.eye(d + 1)[:d]
            mine = self._full.body[: len(x)] == b
            way[mine] = (x[mine] - self._centres[b]) @ change[:, :d].T + change[:, d]
        return self._over_unknowns(way, obstacles)

    def _places(self) -> Array:
        """Of this rank's nodes now, (n_nodes, gdim) (length)."""
        n, d = self._x.shape
        return self._x + self._displacement.u.x.array[: n * d].reshape(n, d)

    def work(self, operator: ContactOperator, force: Array) -> Array:
        """Of forces at a contact's points, and of what answers them, on the motions of the bodies.

        That of the body with Γc follows from where the points are, not from the map by which the
        solver transfers forces. Collective.

        Args:
            operator: Of the contact, over all unknowns.
            force: On the body with Γc, (n_points, gdim) (force).

        Returns:
            This rank's part, (n_bodies, n_per_body) (force): translations, then rotations about
            the body's middle by its size.
        """
        if operator not in self._travels:
            self._travels[operator] = self._travels_at(operator)
        found: Array = np.zeros((self._n_bodies, len(self.of_bodies)))
        for body, travels in self._travels[operator]:
            np.add.at(found, body, np.einsum("mqd,qd->qm", travels, force))
        return found

    def _travels_at(self, operator: ContactOperator) -> list[tuple[Index, Array]]:
        """Bodies on both sides of points, and what these feel of their motions. Collective.

        Returns:
            Arrays (n_points,) and (n_per_body, n_points, gdim) for every side.
        """
        space, contact = self._displacement.u.function_space, operator.contact
        own = body_of_points(contact, space, self._full.body)
        arm = (contact.points - self._centres[own]) / self._sizes[own, None]
        travels = np.array(list(rigid_motions(arm, 1.0).values()))
        sides = [(own, travels)]
        if not contact.rigid:
            # The map says where the forces on the opposite act. Both sides may be one body's.
            # A point without an opposite feels none: a traction there would be left over.
            felt = np.array([operator.jump(motion) for motion in self.of_bodies])
            difference = operator.jump(self._scales.label.astype(np.float64))[:, 0]
            paired = contact.paired[:, None]
            opposite = np.where(contact.paired, own - np.rint(difference).astype(np.intp), own)
            sides.append((opposite, np.where(paired, felt - travels, 0.0)))
        if compat.geometry_element(space.mesh).degree > space.ufl_element().degree:
            # Straight displacements of curved cells have no rotations.
            for _, each in sides:
                each[space.mesh.geometry.dim :] = np.nan
        return sides

    def describe(self, coefficients: Array) -> str:
        """Name a motion by its share of each of all motions, (n_motions,)."""
        share = np.abs(coefficients) / np.abs(coefficients).max()
        terms = [
            name if s > 1 - FLAT else f"{s:.2g} of {name}"
            for name, s in zip(self.names, share, strict=True)
            if s > FLAT
        ]
        return " with ".join(terms)
