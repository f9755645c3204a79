"""Rigid-body modes that Dirichlet conditions leave free, and which of them contact constrains."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.csgraph
from petsc4py import PETSc

from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import PointValues, Status
from fenics_contact.parallel import broadcast_from_root, global_sum
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.operator import ContactOperator
from fenics_contact.systems.rigid_motions import RigidMotions
from fenics_contact.tolerances import FLAT, NEGLIGIBLE, ROUND_OFF
from fenics_contact.types import Array, Index, Mask

__all__ = ["RigidBodyModes", "find_displaced", "tangential_gram"]


class RigidBodyModes(RigidMotions):
    """The free `RigidMotions`, and which of them contact constrains.

    Attributes:
        free: Coefficients of the free modes, (n_free, n_motions).
    """

    def __init__(self, full: FullSystem) -> None:
        super().__init__(full)
        self.free: Array = np.zeros((0, len(self.names)))
        self._jumps: weakref.WeakKeyDictionary[ContactOperator, Array]
        self._jumps = weakref.WeakKeyDictionary()

    def find_free(self, stiffness: PETSc.Mat, constrained: Mask) -> None:
        """Find the motions without bulk energy or Dirichlet conditions. Collective.

        Energies of the bulk tangent without conditions are relative to the stiffness of the body.
        """
        n_obstacles = self._unknowns.n_motions
        stiffest = np.append(self._scales.stiffness, np.ones(n_obstacles))
        stiffest = stiffest[self._scales.partition.label]
        rows = []
        work, image = stiffness.createVecs()
        for motion in self.of_bodies:
            work.array[:] = motion  # all bodies at once: the bulk does not couple them
            stiffness.mult(work, image)
            fixed = np.where(constrained, motion, 0.0)
            rows.append(self.by_body(image.array / stiffest + fixed))
        energy = np.moveaxis(global_sum(self.comm, np.array(rows)), 0, 2)
        free: list[Array] = []
        for body_energy, body_mass in zip(energy, self.gram_by_body(), strict=True):
            scale = 1 / np.sqrt(np.diag(body_mass))
            symmetric = (body_energy + body_energy.T) / 2
            values, vectors = np.linalg.eigh(symmetric * np.outer(scale, scale))
            # One clamped dof among N gives an eigenvalue of 1/N, far above round-off.
            free.append(_reduce_rows((vectors * scale[:, None])[:, values < ROUND_OFF].T))
        self._jumps.clear()
        # Motions of obstacles have no bulk energy.
        self.free = broadcast_from_root(
            self.comm, scipy.linalg.block_diag(*free, np.eye(n_obstacles))
        )
        self._scales.constrained = np.all(~np.hstack(self._moved_parts()), axis=0)
        for vector in (work, image):
            vector.destroy()

    def jumps_at(self, operator: ContactOperator) -> Array:
        """Return the jumps of the free modes, (n_free, n_points, gdim). Collective."""
        if operator not in self._jumps or operator.contact.free_angle is not None:
            gdim, n_points = len(self._centres[0]), operator.contact.quadrature.n_points
            jumps = [operator.jump(self.matrix.T @ row) for row in self.free]
            self._jumps[operator] = np.array(jumps).reshape(len(self.free), n_points, gdim)
        return self._jumps[operator]

    def _moved_parts(self) -> tuple[Mask, Mask]:
        """Return masks of the bodies, (n_free, n_bodies), and obstacles that free modes move."""
        n_per_body, moves = len(self.of_bodies), self.free != 0.0
        n_modes = self._n_bodies * n_per_body
        bodies = moves[:, :n_modes].reshape(-1, self._n_bodies, n_per_body).any(axis=2)
        return bodies, moves[:, n_modes:]

    def find_coupled_modes(self) -> Mask:
        """Return which free modes move a common part, a mask (n_free, n_free)."""
        parts = np.hstack(self._moved_parts()).astype(np.float64)
        return np.asarray(parts @ parts.T > 0)

    def find_chains(self, jumps: Sequence[Array]) -> Index:
        """Return the chain of every free mode, (n_free,). Collective.

        The modes of a chain move common parts, or have jumps at common points. Parts that only a
        constrained one connects, as loose rollers in a ring, are in different chains.

        Args:
            jumps: Jumps of the free modes by contact, (n_free, n_points, gdim).
        """
        common: Array = np.zeros((len(self.free), len(self.free)))
        for modes in jumps:
            displaced = find_displaced(modes).astype(np.float64)
            common += displaced @ displaced.T
        linked = (global_sum(self.comm, common) > 0.0) | self.find_coupled_modes()
        return np.asarray(scipy.sparse.csgraph.connected_components(linked)[1], dtype=np.intp)

    def find_body_modes(self) -> Mask:
        """Return which free modes move a body, a mask (n_free,)."""
        bodies, _ = self._moved_parts()
        return np.asarray(bodies.any(axis=1))

    def find_modes_of_bodies(self, bodies: Mask) -> Index:
        """Return the numbers of the free modes that move only chosen bodies."""
        moves, obstacles = self._moved_parts()
        return np.flatnonzero(
            moves.any(axis=1) & ~moves[:, ~bodies].any(axis=1) & ~obstacles.any(axis=1)
        )

    def project_on_free(self, modes: Array) -> Array:
        """Return a basis of the modes that are still free, (n_modes, n_free). Collective."""
        if not (len(modes) and len(self.free)):
            return np.zeros((0, len(self.free)))
        coefficients = np.linalg.lstsq(self.free.T, modes.T, rcond=None)[0].T
        error = np.abs(coefficients @ self.free - modes).max(axis=1)
        _, sizes, basis = np.linalg.svd(coefficients[error <= FLAT * np.abs(modes).max(axis=1)])
        rank = np.count_nonzero(sizes > NEGLIGIBLE * sizes.max(initial=0.0))
        return broadcast_from_root(self.comm, np.asarray(basis[:rank], dtype=np.float64))

    def find_modes_moving(self, modes: Array, bodies: Mask) -> Mask:
        """Return which modes, (n_modes, n_free), move any of the bodies, a mask (n_modes,)."""
        moves, _ = self._moved_parts()
        return np.asarray((modes != 0.0) @ moves[:, bodies].any(axis=1))

    def size_by_body(self, coefficients: Array) -> Array:
        """Return an upper bound of the displacement of every body, (n_bodies,) (length)."""
        return np.abs(self._split(coefficients @ self.free)[0]).sum(axis=1)

    def present_fields(self) -> Array:
        """Return the free modes at the present positions, (n_free, n_local)."""
        return np.asarray((self.present_matrix().T @ self.free.T).T)

    def present_jumps(
        self, operators: Sequence[ContactOperator], matrix: scipy.sparse.csc_matrix
    ) -> list[Array]:
        """Return the jumps of the free modes by contact, (n_free, n_points, gdim). Collective.

        ``matrix`` is the `present_matrix`.
        """
        if matrix is self.matrix:
            return [self.jumps_at(operator) for operator in operators]
        shape = len(self.free), -1, self._x.shape[1]
        fields = [matrix.T @ row for row in self.free]
        return [np.array([o.jump(field) for field in fields]).reshape(shape) for o in operators]

    def present_gram(self, matrix: scipy.sparse.csc_matrix) -> Array:
        """Return the products of free modes of a `present_matrix`, (n_free, n_free). Collective."""
        return np.asarray(self.free @ self.gram(matrix) @ self.free.T)

    def work_of_load(self, load: Array, matrix: scipy.sparse.csc_matrix) -> Array:
        """Return the work of a load on the free modes, 0 where it is round-off. Collective.

        Args:
            load: External forces at this rank's unknowns (force).
            matrix: The `present_matrix`.

        Returns:
            Array (n_free,) (force).
        """
        sums = np.stack([self.free @ (matrix @ load), self._bound_work(load)])
        return _without_round_off(*global_sum(self.comm, sums))

    def _bound_work(self, load: Array) -> Array:
        """Return this rank's part of a bound of the work of a load on free modes, (n_free,)."""
        # No motion displaces any dof of the undeformed bodies by more than one.
        sizes = self._scales.partition.absolute_sums(load)
        n_obstacles, n_per_body = self._unknowns.n_motions, len(self.of_bodies)
        repeats = np.append(np.full(self._n_bodies, n_per_body), np.ones(n_obstacles, dtype=int))
        return np.asarray(np.abs(self.free) @ np.repeat(sizes, repeats))

    def fit_modes(self, change: Array, part: Callable[[Array], Array]) -> Array:
        """Fit free modes to a change of this rank's unknowns, (n_free,). Collective.

        The function ``part`` selects the unknowns that are compared.
        """
        fields = np.array([part(field) for field in self.present_fields()])
        sums = global_sum(self.comm, np.column_stack([fields @ fields.T, fields @ part(change)]))
        coefficients = np.linalg.lstsq(sums[:, :-1], sums[:, -1], rcond=NEGLIGIBLE)[0]
        return np.asarray(broadcast_from_root(self.comm, coefficients), dtype=np.float64)

    def displacement(self, coefficients: Array) -> Array:
        """Return the change of the unknowns, (n_local,), for free modes from the present state.

        Rotations are finite unless the bulk is linear.
        """
        all_motions = coefficients @ self.free
        linear = self._full.bulk.linear
        return self.matrix.T @ all_motions if linear else self.rotate(all_motions)

    def is_constrained(self, operators: Sequence[ContactOperator]) -> bool:
        """Return whether active points constrain every free mode. Collective.

        Closed points are active, and tangentially also open points with a given friction bound.
        """
        return not (len(self.free) and self.find_unconstrained(operators, closed_only=True).size)

    def find_unconstrained(
        self,
        operators: Sequence[ContactOperator],
        *,
        closed_only: bool,
        slips: bool = False,
    ) -> Array:
        """Return the free modes that no contact constrains, (n_modes, n_free). Collective.

        The squared jumps are relative to the area of Γc on the bodies that a motion moves.

        Args:
            operators: Operators of evaluated contacts, over all unknowns.
            closed_only: Whether to count active points only, see `is_constrained`.
            slips: Whether slipping points do not constrain motions along their friction, even if
                the surface is slightly inclined by the deformation.
        """
        n_free = len(self.free)
        gram: Array = np.zeros((n_free, n_free))
        area: Array = np.zeros(n_free)
        same_body = self.find_coupled_modes().astype(np.float64)
        jumps = [self.jumps_at(operator) for operator in operators]
        for operator, modes in zip(operators, jumps, strict=True):
            contact, values = operator.contact, operator.contact.values
            normal = np.einsum("mqd,qd->mq", modes, values.normal)
            weights = contact.quadrature.weights
            if closed_only:
                weights = weights * (contact.status != Status.OPEN)
            area += ((same_body @ find_displaced(modes)) > 0) @ contact.quadrature.weights
            if contact.law.has_normal_stiffness:
                gram += (normal * weights) @ normal.T
            if slips:
                direction = _slip_direction(contact, values)
                modes = modes - np.einsum("mqd,qd->mq", modes, direction)[:, :, None] * direction
            gram += tangential_gram(contact, modes, closed_only=closed_only)
        gram, area = global_sum(self.comm, gram), global_sum(self.comm, area)
        tolerance = FLAT if slips else NEGLIGIBLE
        return self._null_space(gram, area, self.find_chains(jumps), tolerance)

    def find_unloaded(
        self,
        operators: Sequence[ContactOperator],
        states: Sequence[Sequence[PointValues | None]],
    ) -> Array:
        """Find the modes along which no contact force acts, (n_unloaded, n_free). Collective.

        Forces above round-off in any of the states count, and friction in all tangential
        directions. A group of coupled bodies is excluded if loaded points of it have lost their
        opposite points.

        Args:
            operators: Contact operators, over all unknowns.
            states: Values at the points of every contact in each state; None: there was no force.
        """
        n, scales = len(self.free), self._scales
        gram: Array = np.zeros((n, n))
        area: Array = np.zeros(n)
        unknown: Array = np.zeros(scales.n_groups)
        at_points = self.present_jumps(operators, self.present_matrix())
        for number, (operator, modes) in enumerate(zip(operators, at_points, strict=True)):
            contact, weights = operator.contact, operator.contact.quadrature.weights
            area += find_displaced(modes) @ weights
            group = scales.group_of_points(number)
            for values in (state[number] for state in states):
                if values is None:
                    continue
                active = self.has_force(number, contact, values)
                normal = np.where(np.isfinite(values.normal), values.normal, 0.0)
                normal_jumps = np.einsum("mqd,qd->mq", modes, normal)
                tangential = modes - normal_jumps[:, :, None] * normal
                gram += (normal_jumps * (weights * active[0])) @ normal_jumps.T
                gram += np.einsum("mqd,q,nqd->mn", tangential, weights * active[1], tangential)
                lost = (values.paired > 0) & ~contact.pairs.paired
                unknown[group[active.any(axis=0) & lost]] = 1.0
        gram, area, unknown = (global_sum(self.comm, part) for part in (gram, area, unknown))
        modes = self._null_space(gram, area, self.find_chains(at_points))
        return modes[~((modes != 0.0) @ (unknown[self.groups()] > 0.0))]

    def has_force(self, number: int, contact: Contact, values: PointValues) -> Mask:
        """Return where normal forces and friction exceed round-off, (2, n_points). Collective.

        Friction counts with at least its bound. A law with tension acts at all paired points.
        """
        friction = np.maximum(np.linalg.norm(values.traction, axis=1), values.friction_bound)
        forces = contact.measure * np.array([np.abs(values.normal_traction), friction])
        forces[np.isnan(forces)] = 0.0
        active = forces > self._scales.round_off_at_points(number, forces.max(axis=0))
        return np.asarray(active | (contact.law.has_tension & (values.paired > 0)))

    def _null_space(
        self, gram: Array, area: Array, chain: Index, tolerance: float = NEGLIGIBLE
    ) -> Array:
        """Return a basis of the null space of a Gram matrix, (n_modes, n_free). Collective.

        Args:
            gram: Products of the motions, weighted by area, (n_free, n_free).
            area: Area of the points at which each has a jump, (n_free,).
            chain: Chain of each, (n_free,).
            tolerance: Mean square jump relative to the motion below which it is in the null space.
        """
        scale = 1 / np.sqrt(np.where(area > 0, area, 1.0))
        gram = gram * np.outer(scale, scale)
        n = len(area)
        basis = [np.zeros((0, n))]
        for number in np.unique(chain):  # chains are decoupled
            members = np.flatnonzero(chain == number)
            sizes, eigenvectors = np.linalg.eigh(gram[np.ix_(members, members)])
            vectors = np.zeros((np.count_nonzero(sizes < tolerance), n))
            vectors[:, members] = (eigenvectors * scale[members, None])[:, sizes < tolerance].T
            basis.append(vectors)
        return broadcast_from_root(self.comm, np.concatenate(basis))

    def find_state_independent_modes(self) -> Index:
        """Return the numbers of the free modes except rotations of obstacles."""
        return np.flatnonzero(~np.any(self.free[:, self.is_obstacle_rotation] != 0.0, axis=1))

    @property
    def has_obstacle_rotations(self) -> bool:
        """Whether some free modes rotate obstacles, whose lever arms depend on the state."""
        return bool(self.is_obstacle_rotation.any())

    def generalised_forces(self, forces: Array) -> Array:
        """Return the work of forces on the free modes, (n_free,). Collective."""
        return global_sum(self.comm, self.free @ (self.matrix @ forces))

    def load_resultant(
        self, load: Array, operators: Sequence[ContactOperator]
    ) -> tuple[Array, Array]:
        """Return the generalised load, including prescribed contact pressures. Collective.

        Rotations of obstacles are excluded: pressure may have no moment.

        Args:
            load: External forces at this rank's unknowns (force).
            operators: Operators of evaluated contacts, over all unknowns.

        Returns:
            The generalised load, 0 where it is round-off, and a bound of its size, by mode of
            `find_state_independent_modes` (force).
        """
        rows = self.find_state_independent_modes()
        sums = np.stack([self.free @ (self.matrix @ load), self._bound_work(load)])[:, rows]
        for operator in operators:
            contact = operator.contact
            if not contact.law.has_normal_stiffness:
                force = contact.measure * contact.values.parameters["pressure"]
                normal = np.einsum(
                    "mqd,qd->mq", self.jumps_at(operator)[rows], contact.values.normal
                )
                sums += np.stack([-normal @ force, np.abs(normal) @ force])
        resultant, size = global_sum(self.comm, sums)
        return _without_round_off(resultant, size), size

    def groups(self) -> Index:
        """Return the group of coupled parts that each free mode moves, (n_free,)."""
        return np.asarray(self._scales.group[np.argmax(np.hstack(self._moved_parts()), axis=1)])

    def generalised_load(self, load: Array) -> Array:
        """Return the largest size of `load_resultant` by group, (n_groups,) (force). Collective."""
        largest: Array = np.zeros(self._scales.n_groups)
        resultants = self.load_resultant(load, ())[0]
        np.maximum.at(
            largest, self.groups()[self.find_state_independent_modes()], np.abs(resultants)
        )
        return largest


def find_displaced(jumps: Array) -> Mask:
    """Return which points modes displace, (n_modes, n_points), by jumps (n_modes, n_points, d)."""
    return np.asarray(np.abs(jumps).max(axis=2, initial=0.0) > NEGLIGIBLE)


def _without_round_off(work: Array, bound: Array) -> Array:
    """Return the work of a load on modes, 0 where it is negligible relative to its bound."""
    return np.where(np.abs(work) <= NEGLIGIBLE * bound, 0.0, work)


def _reduce_rows(rows: Array) -> Array:
    """Return the reduced row echelon form, with pivots by size, for short descriptions."""
    rows = rows.copy()
    pivots: list[int] = []
    for _ in range(len(rows)):
        remaining = [i for i in range(len(rows)) if i not in pivots]
        part = np.abs(rows[remaining])
        i, j = np.unravel_index(np.argmax(part), part.shape)
        pivot = remaining[int(i)]
        rows[pivot] /= rows[pivot, j]
        for other in range(len(rows)):
            if other != pivot:
                rows[other] -= rows[other, j] * rows[pivot]
        pivots.append(pivot)
    rows[np.abs(rows) < NEGLIGIBLE] = 0.0
    return rows / np.abs(rows).max(axis=1, initial=1.0)[:, None] if rows.size else rows


def _slip_direction(contact: Contact, values: PointValues) -> Array:
    """Return unit vectors along the friction of slipping points, or zero, (n_points, gdim).

    The traction is constant along it unless the friction bound depends on the motion.
    """
    size = np.linalg.norm(values.traction, axis=1)
    is_slipping = values.is_slipping & (size > 0) & contact.law.has_friction
    is_slipping &= not contact.effective_law.own.bound_depends_on_motion
    direction = values.traction * (is_slipping / np.where(is_slipping, size, 1.0))[:, None]
    return np.asarray(direction, dtype=np.float64)


def _resists_tangentially(contact: Contact, *, closed_only: bool) -> Mask:
    """Return the points that resist tangential motion, a mask (n_points,).

    With ``closed_only`` these are the active points, otherwise all that resist if closed.
    """
    values = contact.values
    resists = values.friction_bound_ratio > 0
    if closed_only:
        resists = resists & ((contact.status != Status.OPEN) | (values.friction_bound > 0))
    return np.asarray(resists)


def tangential_gram(contact: Contact, modes: Array, *, closed_only: bool) -> Array:
    """Return the Gram matrix of tangential jumps at the points that resist.

    Args:
        contact: An evaluated contact.
        modes: Jumps of the modes, (n, n_points, gdim).
        closed_only: As in `RigidBodyModes.find_unconstrained`.
    """
    if not contact.law.has_tangential:
        return np.zeros((len(modes), len(modes)))
    normal = contact.values.normal
    weights = contact.quadrature.weights * _resists_tangentially(contact, closed_only=closed_only)
    tangential = modes - np.einsum("mqd,qd->mq", modes, normal)[:, :, None] * normal
    return np.asarray(np.einsum("mqd,q,nqd->mn", tangential, weights, tangential), dtype=np.float64)
