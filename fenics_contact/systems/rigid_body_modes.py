"""Rigid-body modes: those that Dirichlet conditions leave free, and whether contact holds them."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence

import numpy as np
import scipy.linalg
from petsc4py import PETSc

from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import PointValues, Status
from fenics_contact.parallel import broadcast_from_root, global_sum
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.operator import ContactOperator
from fenics_contact.systems.rigid_motions import RigidMotions
from fenics_contact.tolerances import FLAT, NEGLIGIBLE, ROUND_OFF
from fenics_contact.types import Array, Index, Mask

__all__ = ["RigidBodyModes", "tangential_gram"]


class RigidBodyModes(RigidMotions):
    """Those of the `RigidMotions` that are free, and what contact holds of them.

    Attributes:
        free: Coefficients of the free motions, shape (n_free, n_motions).
    """

    def __init__(self, full: FullSystem) -> None:
        super().__init__(full)
        self.free: Array = np.zeros((0, len(self.names)))
        self._jumps: weakref.WeakKeyDictionary[ContactOperator, Array]
        self._jumps = weakref.WeakKeyDictionary()

    def find_free(self, stiffness: PETSc.Mat, constrained: Mask) -> None:
        """Find the motions with no bulk energy that no Dirichlet condition holds. Collective.

        The energy of each is relative to the stiffness of the body that it moves.

        Args:
            stiffness: Bulk tangent without conditions.
            constrained: Mask over this rank's unknowns.
        """
        n_obstacles, system = self._unknowns.n_motions, self._full
        stiffest = np.append(self._scales.stiffness, np.ones(n_obstacles))[self._scales.label]
        gram = []
        work, image = stiffness.createVecs()
        for motion in self.of_bodies:
            work.array[:] = motion  # of all bodies at once: the bulk does not couple them
            stiffness.mult(work, image)
            held = np.where(constrained, motion, 0.0)
            energy = self.by_body(system, image.array / stiffest + held)
            gram.append([energy, self.by_body(system, motion)])
        energy, mass = np.moveaxis(global_sum(self.comm, np.array(gram)), 0, 3)
        free: list[Array] = []
        for of_body, mass_of_body in zip(energy, mass, strict=True):
            scale = 1 / np.sqrt(np.diag(mass_of_body))
            symmetric = (of_body + of_body.T) / 2
            values, vectors = np.linalg.eigh(symmetric * np.outer(scale, scale))
            # One clamped dof among N gives 1/N, and round-off is below any.
            free.append(_plain((vectors * scale[:, None])[:, values < ROUND_OFF].T))
        self._jumps.clear()
        # Motions of obstacles have no bulk energy.
        self.free = broadcast_from_root(
            self.comm, scipy.linalg.block_diag(*free, np.eye(n_obstacles))
        )
        self._scales.held = np.all(~np.hstack(self._moved()), axis=0)
        for vector in (work, image):
            vector.destroy()

    def at_points(self, operator: ContactOperator) -> Array:
        """Jumps of the free motions at a contact's points: (n_free, n_points, gdim). Collective."""
        if operator not in self._jumps or operator.contact.free_angle is not None:
            gdim, n_points = len(self._centres[0]), operator.contact.quadrature.n_points
            found = [operator.jump(self.field(*self._by_part(row))) for row in self.free]
            self._jumps[operator] = np.array(found).reshape(len(self.free), n_points, gdim)
        return self._jumps[operator]

    def _moved(self) -> tuple[Mask, Mask]:
        """Which bodies every free motion moves, (n_free, n_bodies), and which obstacles."""
        n_per_body, moves = len(self.of_bodies), self.free != 0.0
        n_modes = self._n_bodies * n_per_body
        bodies = moves[:, :n_modes].reshape(-1, self._n_bodies, n_per_body).any(axis=2)
        return bodies, moves[:, n_modes:]

    def of_same_body(self) -> Mask:
        """Which two of the free motions are of one body, (n_free, n_free)."""
        parts = np.hstack(self._moved()).astype(np.float64)
        return np.asarray(parts @ parts.T > 0)

    def of_any_body(self) -> Mask:
        """Which of the free motions are not those of obstacles alone, (n_free,)."""
        bodies, _ = self._moved()
        return np.asarray(bodies.any(axis=1))

    def of_bodies_alone(self, bodies: Mask) -> Index:
        """Numbers of the free motions that move some of these bodies and nothing else."""
        moves, obstacles = self._moved()
        return np.flatnonzero(
            moves.any(axis=1) & ~moves[:, ~bodies].any(axis=1) & ~obstacles.any(axis=1)
        )

    def in_free(self, modes: Array) -> Array:
        """A basis of those of some modes that are free now, in free motions, (n_modes, n_free).

        Collective.

        Args:
            modes: In all motions, (n_given, n_motions).
        """
        if not (len(modes) and len(self.free)):
            return np.zeros((0, len(self.free)))
        found = np.linalg.lstsq(self.free.T, modes.T, rcond=None)[0].T
        off = np.abs(found @ self.free - modes).max(axis=1)
        _, sizes, basis = np.linalg.svd(found[off <= FLAT * np.abs(modes).max(axis=1)])
        rank = np.count_nonzero(sizes > NEGLIGIBLE * sizes.max(initial=0.0))
        return broadcast_from_root(self.comm, np.asarray(basis[:rank], dtype=np.float64))

    def move_any(self, modes: Array, bodies: Mask) -> Mask:
        """Which modes move some of these bodies, (n_modes,).

        Args:
            modes: In free motions, (n_modes, n_free).
            bodies: (n_bodies,).
        """
        moves, _ = self._moved()
        return np.asarray((modes != 0.0) @ moves[:, bodies].any(axis=1))

    def size_by_body(self, coefficients: Array) -> Array:
        """At most how far free motions displace every body, (n_bodies,) (length).

        Args:
            coefficients: Of the free motions, (n_free,) (length).
        """
        return np.abs(self._by_part(coefficients @ self.free)[0]).sum(axis=1)

    def present_fields(self) -> Array:
        """The free motions of the bodies where they are now, about the same centres.

        Where the bulk is linear, of the undeformed ones: to it small rotations alone are rigid.

        Returns:
            At this rank's unknowns, (n_free, n_local).
        """
        of_bodies = None if self._full.bulk.linear else self._of_bodies_at(self._places())
        found = [self.field(*self._by_part(row), of_bodies=of_bodies) for row in self.free]
        return np.array(found).reshape(len(self.free), self._unknowns.n_local)

    def present(self, operators: Sequence[ContactOperator]) -> tuple[Array, list[Array]]:
        """The free motions at this rank's unknowns, and at points of contacts. Collective.

        Args:
            operators: Of the contacts, over all unknowns.

        Returns:
            `present_fields`, and for every contact their jumps, (n_free, n_points, gdim).
        """
        fields = self.present_fields()
        if self._full.bulk.linear:
            return fields, [self.at_points(operator) for operator in operators]
        shape = len(self.free), -1, self._x.shape[1]
        found = [np.array([o.jump(field) for field in fields]) for o in operators]
        return fields, [jumps.reshape(shape) for jumps in found]

    def fit(self, change: Array, part: Callable[[Array], Array]) -> Array:
        """Find the free motions nearest to a change of this rank's unknowns, (n_free,). Collective.

        Args:
            change: The change.
            part: Takes those unknowns that are compared.
        """
        fields = np.array([part(field) for field in self.present_fields()])
        sums = global_sum(self.comm, np.column_stack([fields @ fields.T, fields @ part(change)]))
        found = np.linalg.lstsq(sums[:, :-1], sums[:, -1], rcond=NEGLIGIBLE)[0]
        return np.asarray(broadcast_from_root(self.comm, found), dtype=np.float64)

    def displacement(self, coefficients: Array) -> Array:
        """By how much unknowns change as free motions go on from here, (n_local,).

        Rotations are of any size, but to a linear bulk.

        Args:
            coefficients: Of the free motions, (n_free,).
        """
        of_all = coefficients @ self.free
        linear = self._full.bulk.linear
        return self.field(*self._by_part(of_all)) if linear else self.turned(of_all)

    def is_constrained(self, operators: Sequence[ContactOperator]) -> bool:
        """Whether the points at which contact acts now hold every free motion. Collective.

        Those that are closed, and along Γc those with a friction bound: one that does not depend on
        pressure is one of open points, too.

        Args:
            operators: Of evaluated contacts, over all unknowns.
        """
        return not (len(self.free) and self.unconstrained(operators, closed_only=True).size)

    def unconstrained(
        self,
        operators: Sequence[ContactOperator],
        *,
        closed_only: bool,
        slips: bool = False,
    ) -> Array:
        """What no contact feels of the free motions, (n_loose, n_free). Collective.

        Their jumps are squared and relative to the area of Γc that belongs to the bodies they move.

        Args:
            operators: Of evaluated contacts, over all unknowns.
            closed_only: Whether the points at which contact acts now alone feel any, see
                `is_constrained`.
            slips: Whether those that slip feel no motion along their friction, nor what the slopes
                of flat surfaces add to it, those of bodies that are strained.
        """
        n_free = len(self.free)
        gram: Array = np.zeros((n_free, n_free))
        area: Array = np.zeros(n_free)
        together = self.of_same_body().astype(np.float64)
        for operator in operators:
            contact, values = operator.contact, operator.contact.values
            modes = self.at_points(operator)
            along = np.einsum("mqd,qd->mq", modes, values.normal)
            weights = contact.quadrature.weights
            if closed_only:
                weights = weights * (contact.status != Status.OPEN)
            felt = np.abs(modes).max(axis=2, initial=0.0) > NEGLIGIBLE
            area += ((together @ felt) > 0) @ contact.quadrature.weights
            if contact.law.has_normal_stiffness:
                gram += (along * weights) @ along.T
            if slips:
                way = _slip(contact, values)
                modes = modes - np.einsum("mqd,qd->mq", modes, way)[:, :, None] * way
            gram += tangential_gram(contact, modes, closed_only=closed_only)
        gram, area = global_sum(self.comm, gram), global_sum(self.comm, area)
        return self._null_space(gram, area, FLAT if slips else NEGLIGIBLE)

    def find_unloaded(
        self,
        operators: Sequence[ContactOperator],
        states: Sequence[Sequence[PointValues | None]],
    ) -> Array:
        """Find the modes along which no contact force acts, (n_unloaded, n_free). Collective.

        None but round-off, in any of some states. Friction acts in all directions along Γc. Where
        points that bore force have no opposite point any more, nothing is known of what was there:
        none of that group of coupled bodies counts.

        Args:
            operators: Of the contacts, over all unknowns.
            states: Values at the points of every contact in each; None: there was no force.
        """
        n, scales = len(self.free), self._scales
        gram: Array = np.zeros((n, n))
        area: Array = np.zeros(n)
        unknown: Array = np.zeros(scales.n_groups)
        at_points = self.present(operators)[1]
        for number, (operator, modes) in enumerate(zip(operators, at_points, strict=True)):
            contact, weights = operator.contact, operator.contact.quadrature.weights
            felt = np.abs(modes).max(axis=2, initial=0.0) > NEGLIGIBLE
            area += felt @ weights
            group = scales.group_of_points(number)
            for values in (state[number] for state in states):
                if values is None:
                    continue
                acts = self.has_force(number, contact, values)
                normal = np.where(np.isfinite(values.normal), values.normal, 0.0)
                along = np.einsum("mqd,qd->mq", modes, normal)
                across = modes - along[:, :, None] * normal
                gram += (along * (weights * acts[0])) @ along.T
                gram += np.einsum("mqd,q,nqd->mn", across, weights * acts[1], across)
                unknown[group[acts.any(axis=0) & (values.paired > 0) & ~contact.paired]] = 1.0
        gram, area, unknown = (global_sum(self.comm, part) for part in (gram, area, unknown))
        found = self._null_space(gram, area)
        return found[~((found != 0.0) @ (unknown[self.groups()] > 0.0))]

    def has_force(self, number: int, contact: Contact, values: PointValues) -> Mask:
        """Whether forces act at points, but for round-off: normal ones and friction, (2, n_points).

        That of friction is as large as its bound. A law that bears tension acts at all points with
        an opposite. Collective.

        Args:
            number: Of the contact.
            contact: The contact.
            values: At its points.
        """
        friction = np.maximum(np.linalg.norm(values.traction, axis=1), values.friction_bound)
        forces = contact.measure * np.array([np.abs(values.normal_traction), friction])
        forces[np.isnan(forces)] = 0.0
        acts = forces > self._scales.round_off_at_points(number, forces.max(axis=0))
        return np.asarray(acts | (contact.law.has_tension & (values.paired > 0)))

    def _null_space(self, gram: Array, area: Array, least: float = NEGLIGIBLE) -> Array:
        """Combinations of free motions that a sum over points does not feel, (n_found, n_free).

        Collective.

        Args:
            gram: Products of the motions by what is felt, weighted by area, (n_free, n_free).
            area: Of the points that feel each, (n_free,).
            least: Mean square jump, relative to that of the motion, which counts as felt.
        """
        scale = 1 / np.sqrt(np.where(area > 0, area, 1.0))
        gram = gram * np.outer(scale, scale)
        n, groups = len(area), self.groups()
        loose = [np.zeros((0, n))]
        for group in np.unique(groups):  # no vector is of several
            mine = np.flatnonzero(groups == group)
            sizes, vectors = np.linalg.eigh(gram[np.ix_(mine, mine)])
            found = np.zeros((np.count_nonzero(sizes < least), n))
            found[:, mine] = (vectors * scale[mine, None])[:, sizes < least].T
            loose.append(found)
        return broadcast_from_root(self.comm, np.concatenate(loose))

    def straight(self) -> Index:
        """Numbers of the free motions but for those by which obstacles turn."""
        return np.flatnonzero(~np.any(self.free[:, self.obstacle_turns] != 0.0, axis=1))

    @property
    def turning(self) -> bool:
        """Whether some are rotations of obstacles, whose arms change with the state."""
        return bool(self.obstacle_turns.any())

    def generalised_forces(self, forces: Array) -> Array:
        """Work of forces at this rank's unknowns on the free motions, (n_free,). Collective."""
        return global_sum(self.comm, self.free @ self._sums(forces))

    def load_resultant(
        self, load: Array, operators: Sequence[ContactOperator]
    ) -> tuple[Array, Array]:
        """Work of a load and of normal tractions that a law prescribes on the free motions.

        But for those by which obstacles turn: what presses may have no moment. Collective.

        Args:
            load: External forces at this rank's unknowns (force).
            operators: Of evaluated contacts, over all unknowns.

        Returns:
            It, 0 where it is round-off, and what the load could do at most, were all of it
            along the mode: (n_straight,) (force).
        """
        rows = self.straight()
        at_most = self._sums(np.abs(load), np.abs(self.of_bodies))
        sums = np.stack([self.free @ self._sums(load), np.abs(self.free) @ at_most])[:, rows]
        for operator in operators:
            contact = operator.contact
            if not contact.law.has_normal_stiffness:
                force = contact.measure * contact.values.parameters["pressure"]
                along = np.einsum(
                    "mqd,qd->mq", self.at_points(operator)[rows], contact.values.normal
                )
                sums += np.stack([-along @ force, np.abs(along) @ force])
        resultant, size = global_sum(self.comm, sums)
        return np.where(np.abs(resultant) <= NEGLIGIBLE * size, 0.0, resultant), size

    def groups(self) -> Index:
        """Group of coupled parts that each free motion moves, (n_free,)."""
        return np.asarray(self._scales.group[np.argmax(np.hstack(self._moved()), axis=1)])

    def generalised_load(self, load: Array) -> Array:
        """The largest `load_resultant` of a load, by size, (n_groups,) (force). Collective."""
        largest: Array = np.zeros(self._scales.n_groups)
        resultants = self.load_resultant(load, ())[0]
        np.maximum.at(largest, self.groups()[self.straight()], np.abs(resultants))
        return largest


def _plain(rows: Array) -> Array:
    """The same space, each row with a 1 where all others have none: as few names as can be."""
    rows = rows.copy()
    done: list[int] = []
    for _ in range(len(rows)):
        open_rows = [i for i in range(len(rows)) if i not in done]
        part = np.abs(rows[open_rows])
        i, j = np.unravel_index(np.argmax(part), part.shape)
        pivot = open_rows[int(i)]
        rows[pivot] /= rows[pivot, j]
        for other in range(len(rows)):
            if other != pivot:
                rows[other] -= rows[other, j] * rows[pivot]
        done.append(pivot)
    rows[np.abs(rows) < NEGLIGIBLE] = 0.0
    return rows / np.abs(rows).max(axis=1, initial=1.0)[:, None] if rows.size else rows


def _slip(contact: Contact, values: PointValues) -> Array:
    """Along the friction of the points that slip against it, of length 1 or 0, (n_points, gdim).

    The traction there is constant along it, but where the friction bound depends on the motion.
    """
    size = np.linalg.norm(values.traction, axis=1)
    slips = values.slips & (size > 0) & contact.law.has_friction
    slips &= not contact.effective_law.own.bound_depends_on_motion
    way = values.traction * (slips / np.where(slips, size, 1.0))[:, None]
    return np.asarray(way, dtype=np.float64)


def _resists_tangentially(contact: Contact, *, closed_only: bool) -> Mask:
    """Where Γc resists motion along it, (n_points,).

    Args:
        contact: Evaluated.
        closed_only: Whether that is where it acts now: closed, or with a friction bound all the
            same; or where it would if all of it were closed.
    """
    values = contact.values
    resists = values.friction_bound_ratio > 0
    if closed_only:
        resists = resists & ((contact.status != Status.OPEN) | (values.friction_bound > 0))
    return np.asarray(resists)


def tangential_gram(contact: Contact, modes: Array, *, closed_only: bool) -> Array:
    """Products along Γc, where it resists, of n motions by their jumps, (n, n_points, gdim).

    Args:
        contact: Evaluated.
        modes: The jumps.
        closed_only: As in `RigidBodyModes.unconstrained`.
    """
    if not contact.law.has_tangential:
        return np.zeros((len(modes), len(modes)))
    normal = contact.values.normal
    weights = contact.quadrature.weights * _resists_tangentially(contact, closed_only=closed_only)
    across = modes - np.einsum("mqd,qd->mq", modes, normal)[:, :, None] * normal
    return np.asarray(np.einsum("mqd,q,nqd->mn", across, weights, across), dtype=np.float64)
