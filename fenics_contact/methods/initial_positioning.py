"""Initial positioning: bodies that only contact constrains are moved to a rest position."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.optimize

from fenics_contact.contact.contact_kinematics import ObstacleMotion
from fenics_contact.contact.values import Status
from fenics_contact.parallel import (
    broadcast_from_root,
    gather_rows,
    global_max,
    global_min,
    global_sum,
)
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.least_motion import minimise_norm
from fenics_contact.systems.rigid_body_modes import RigidBodyModes, tangential_gram
from fenics_contact.tolerances import FLAT, NEGLIGIBLE, UNLOADED_FORCE_RATIO
from fenics_contact.types import Array, Index, Mask

__all__ = ["InitialPositioning"]

# Least ratio of the work of the load in modes towards contact to that in all modes.
_MIN_WORK_RATIO = 0.5
# Largest tangential fraction of a mode on Γc with friction, for tilts of up to 0.2.
_MAX_TANGENTIAL_FRACTION = 0.05
# Relative rank tolerance of the Gram matrix of modes at touching points.
_RANK_TOLERANCE = 1e-6
# Steps with nonlinear gaps: largest angle of the first (radians), which is halved in each step,
# their number, and ratio of the last to the largest gap, with a square far below `NEGLIGIBLE`.
_FIRST_ANGLE, _MAX_STEPS, _LAST_STEP_RATIO = 0.2, 30, 1e-6


@dataclass(frozen=True)
class _FreeModes:
    """Unconstrained free modes at the present state.

    Attributes:
        modes: Indices among all free modes, (n_free,).
        load: Generalised load relative to its largest component, (n_free,).
        gram: Gram matrix of the modes, (n_free, n_free).
        jumps: Jumps of the modes at the points of every contact, (n_free, n_points, gdim).
    """

    modes: Index
    load: Array
    gram: Array
    jumps: list[Array]


def _find_displaced(jumps: Array) -> Mask:
    """Return the mask of points displaced by modes with the jumps (n_free, n_points, gdim)."""
    return np.asarray(np.abs(jumps).max(axis=(0, 2), initial=0.0) > NEGLIGIBLE)


@dataclass(frozen=True)
class InitialPositioning:
    """Initial positioning of bodies without contact in an increment.

    Attributes:
        full: The system on all unknowns.
        motions: Rigid-body modes of the bodies.
        load: External forces at this rank's unknowns (force).
        before: The state with the previous values of the Dirichlet conditions.
    """

    full: FullSystem
    motions: RigidBodyModes
    load: Array
    before: Array

    def position_bodies(self, *, first: bool) -> bool:
        """Move unconstrained bodies to a rest position, or to first touch. Collective.

        A body released in an earlier increment starts from its present position.

        Args:
            first: Whether it is the first increment.

        Returns:
            Whether there was no contact force before.
        """
        full, motions = self.full, self.motions
        if not len(motions.free):
            return first
        full.evaluate()
        finite = all(contact.contact_kinematics.is_finite for contact in full.contacts)
        groups, load_size = motions.groups(), motions.generalised_load(self.load)
        contact_force = full.contact_force_sizes(committed=finite)
        unloaded = (contact_force < UNLOADED_FORCE_RATIO * load_size)[groups] & (not first)
        untouched = self._find_untouched()
        if first:
            present = full.state()
            with self._obstacles_at_start():
                full.evaluate_at(self.before)
                untouched = np.union1d(untouched, self._find_untouched())
            full.evaluate_at(present)
        if len(untouched) < len(motions.free) and motions.has_obstacle_rotations:
            # With touching bodies freely rotating obstacles are left to the iteration.
            untouched = untouched[motions.find_body_modes()[untouched]]
        modes = np.union1d(untouched, np.flatnonzero(unloaded))
        # Groups of coupled bodies are positioned separately; unloaded groups stay.
        for group in np.unique(groups[modes]):
            if load_size[group] > 0:
                self._position(modes[groups[modes] == group])
        return first or bool(unloaded.any())

    def _find_untouched(self) -> Index:
        """Find the free modes of bodies without closed points. Collective."""
        contacts, motions = self.full.contacts, self.motions
        touched: Array = np.zeros(len(motions.free))
        all_jumps = self._at_points(np.arange(len(motions.free)))
        for contact, jumps in zip(contacts, all_jumps, strict=True):
            closed = contact.status != Status.OPEN
            touched += (np.abs(jumps[:, closed]) > NEGLIGIBLE).any(axis=(1, 2))
        touched = global_sum(self.full.unknowns.comm, touched)
        # Rotations about a closed point do not displace it: consider all modes of a body.
        return np.flatnonzero(~(motions.find_coupled_modes() @ (touched > 0)))

    def _position(self, modes: Index) -> None:
        """Move bodies without contact to a rest position, or to first touch. Collective.

        The slip reference is the rest position at the start of the increment, before prescribed
        displacements and obstacles change. From there bodies follow the obstacles on which they
        rest, and come to the rest position at the end of the increment.
        """
        full = self.full
        initial = full.state()
        # A free obstacle approaches like a prescribed one: slip counts from its initial position.
        of_bodies = modes[self.motions.find_body_modes()[modes]]
        if len(of_bodies) and any(contact.law.has_friction for contact in full.contacts):
            coefficients = None
            with self._obstacles_at_start() as motions:
                full.evaluate_at(np.where(full.constrained, self.before, initial))
                if self._find_rest_position(modes):
                    coefficients = self._fit_obstacle_motion(modes, motions)
                    for contact, jumps in zip(
                        full.contacts, self._at_points(of_bodies), strict=True
                    ):
                        contact.states.set_slip_reference(_find_displaced(jumps))
            full.evaluate_at(initial)
            if coefficients is not None:
                self._displace(modes, coefficients)
        self._find_rest_position(modes)
        if not full.bulk.linear:
            full.update_stiffness()

    def _fit_obstacle_motion(self, modes: Index, obstacles: Sequence[ObstacleMotion]) -> Array:
        """Fit free modes to the motion of the touched obstacles by least squares. Collective."""
        gram: Array = np.zeros((len(modes), len(modes)))
        work: Array = np.zeros(len(modes))
        scales = self.full.scales
        for number, (contact, jumps, motion) in enumerate(
            zip(self.full.contacts, self._at_points(modes), obstacles, strict=True)
        ):
            touches = contact.values.opening <= FLAT * scales.size_at_points(number)
            weights = np.where(contact.pairs.paired & touches, contact.measure, 0.0)
            displacement = motion.of_points(contact.pairs.own_displacement())
            gram += np.einsum("mqd,q,nqd->mn", jumps, weights, jumps)
            work += np.einsum("mqd,q,qd->m", jumps, weights, displacement)
        comm = self.full.unknowns.comm
        gram, work = global_sum(comm, gram), global_sum(comm, work)
        return broadcast_from_root(comm, np.linalg.lstsq(gram, work, rcond=_RANK_TOLERANCE)[0])

    @contextlib.contextmanager
    def _obstacles_at_start(self) -> Iterator[list[ObstacleMotion]]:
        """Reset rigid obstacles to the last commit; yield their motions since. Collective."""
        self.full.evaluate_at(self.before)
        contacts = self.full.contacts
        motions = [
            contact.contact_kinematics.motion_in_increment(contact.values) for contact in contacts
        ]
        with contextlib.ExitStack() as back:
            for contact, motion in zip(contacts, motions, strict=True):
                back.enter_context(contact.contact_kinematics.displaced(motion))
            yield motions

    def _find_rest_position(self, modes: Index) -> bool:
        """Move bodies to a rest position, or to first touch; whether there is one. Collective."""
        start = self.full.state()
        for fraction in (_MAX_TANGENTIAL_FRACTION, np.inf):
            if self._move_to_rest(modes, fraction):
                return True
            self.full.evaluate_at(start)
        free = self._find_free_modes(modes)
        motion = None if free is None else self._compute_first_touch(free)
        if motion is not None:
            self._displace(modes, motion)
        return motion is not None

    def _at_points(self, modes: Index) -> list[Array]:
        """Return jumps of free modes by contact, (n_modes, n_points, gdim). Collective."""
        motions = self.motions
        jumps = motions.present_jumps(self.full.operators, motions.present_matrix())
        return [by_mode[modes] for by_mode in jumps]

    def _find_free_modes(self, modes: Index) -> _FreeModes | None:
        """Evaluate the free modes; None if they are unloaded. Collective."""
        motions, contacts = self.motions, self.full.contacts
        matrix = motions.present_matrix()
        load = motions.work_of_load(self.load, matrix)[modes]
        largest = np.abs(load).max()
        if not largest > 0:
            return None
        jumps = [
            contact.contact_kinematics.rotate_to_displaced(by_mode[modes])
            for contact, by_mode in zip(
                contacts, motions.present_jumps(self.full.operators, matrix), strict=True
            )
        ]
        gram = motions.present_gram(matrix)[np.ix_(modes, modes)]
        return _FreeModes(modes, load / largest, gram, jumps)

    def _displace(self, modes: Index, coefficients: Array) -> None:
        """Displace bodies by free modes with these coefficients. Collective."""
        full, motions = self.full, self.motions
        all_coefficients = np.zeros(len(motions.free))
        all_coefficients[modes] = coefficients
        displacement = motions.displacement(all_coefficients)
        full.evaluate_at(full.state() + np.where(full.constrained, 0.0, displacement))

    def _compute_first_touch(self, free: _FreeModes) -> Array | None:
        """Compute the motion to first touch in the direction of the load, if any. Collective."""
        comm = self.full.unknowns.comm
        coefficients = broadcast_from_root(comm, np.linalg.solve(free.gram, free.load))
        coefficients /= np.abs(coefficients).max()
        distance = np.inf
        for contact, jumps in zip(self.full.contacts, free.jumps, strict=True):
            values = contact.values
            jump = np.tensordot(coefficients, jumps, axes=1)
            closing = np.einsum("qd,qd->q", jump, values.normal)
            closes = closing > NEGLIGIBLE
            distances = values.opening[closes] / closing[closes]
            distance = min(distance, global_min(comm, distances, empty=np.inf))
        return None if distance == np.inf else distance * coefficients

    # ---- rest position ---------------------------------------------------------------------------

    def _move_to_rest(self, modes: Index, fraction: float) -> bool:
        """Move rigid bodies to a rest position; return whether there is one. Collective.

        ``fraction`` is the largest tangential fraction of a mode on Γc with friction.
        """
        full, comm = self.full, self.full.unknowns.comm
        free = self._find_free_modes(modes)
        if free is None:
            return False
        gaps = [
            np.abs(c.values.gap[c.pairs.paired & _find_displaced(jumps)]).max(initial=0.0)
            for c, jumps in zip(full.contacts, free.jumps, strict=True)
        ]
        scale = global_max(comm, np.array(gaps))
        if not 0 < scale < np.inf:
            return False
        linear = full.bulk.linear and not any(
            contact.contact_kinematics.is_finite for contact in full.contacts
        )
        max_angle = np.inf if linear else _FIRST_ANGLE
        for _ in range(_MAX_STEPS):
            free = self._find_free_modes(modes)
            motion = None if free is None else self._compute_rest(free, scale, max_angle, fraction)
            if motion is None or free is None:
                return False
            self._displace(modes, motion)
            steps = [np.tensordot(motion, jumps, axes=1) for jumps in free.jumps]
            lengths = np.array([np.abs(step).max(initial=0.0) for step in steps])
            if linear or global_max(comm, lengths) <= _LAST_STEP_RATIO * scale:
                return True
            max_angle /= 2
        return False

    def _compute_rest(
        self, free: _FreeModes, scale: float, max_angle: float, fraction: float
    ) -> Array | None:
        """Compute the rest position for linearised gaps. Collective.

        It maximises the work of the load subject to the gaps: a linear programme.

        Args:
            free: The free modes.
            scale: The largest gap (length).
            max_angle: The largest angle (radians).
            fraction: Largest tangential fraction of a mode on Γc with friction.

        Returns:
            Coefficients of the free modes; None: no mode is admissible, they have little of the
            work of the load, as in a corner, or are unbounded.
        """
        motions, comm, load = self.motions, self.full.unknowns.comm, free.load
        grams: Array = np.zeros((2, len(load), len(load)))
        rows = []
        for contact, jumps in zip(self.full.contacts, free.jumps, strict=True):
            values, weights = contact.values, contact.quadrature.weights
            closing = np.einsum("mqd,qd->qm", jumps, values.normal)
            tangential = tangential_gram(contact, jumps, closed_only=False)
            grams += [tangential, (closing.T * weights) @ closing]
            touchable = contact.pairs.paired & _find_displaced(jumps)
            rows.append(np.column_stack([closing, values.gap])[touchable])
        tangential, normal = global_sum(comm, grams)
        total = tangential + normal
        if not np.trace(total) > 0:
            return None
        # Some modes displace no point.
        total += NEGLIGIBLE * np.trace(total) * np.eye(len(total))
        fractions, vectors = scipy.linalg.eigh(tangential, total)
        basis = broadcast_from_root(comm, vectors[:, fractions < fraction])
        limits = gather_rows(comm, np.concatenate(rows))
        # Without modes that close no gap, along which round-off of the load would be unbounded.
        _, sigma, vt = np.linalg.svd(limits[:, :-1] @ basis, full_matrices=False)
        basis = broadcast_from_root(comm, basis @ vt[sigma > NEGLIGIBLE * sigma.max(initial=0.0)].T)
        work = load @ basis
        if not len(work):
            return None
        admissible = work @ np.linalg.solve(basis.T @ free.gram @ basis, work)
        if not admissible > _MIN_WORK_RATIO * (load @ np.linalg.solve(free.gram, load)):
            return None
        # Points with a contact force remain closed by ten times the tolerance of the programme.
        gaps = limits[:, -1] / scale + NEGLIGIBLE
        bounds, angle_ends = [limits[:, :-1] @ basis], []
        has_rotation = motions.rotation_length > 0
        if max_angle < np.inf and has_rotation.any():
            rotations = (
                motions.free[free.modes][:, has_rotation] / motions.rotation_length[has_rotation]
            )
            angles = rotations.T @ basis
            bounds += [angles, -angles]
            angle_ends += [np.full(2 * len(angles), max_angle / scale)]
        matrix, angle_limits = (
            np.concatenate(bounds),
            np.concatenate(angle_ends) if angle_ends else np.zeros(0),
        )
        # Obstacles may have moved into released bodies: remove penetration, or do not increase it.
        for normal_limit in (gaps, np.maximum(gaps, NEGLIGIBLE)):
            limit = np.concatenate([normal_limit, angle_limits])
            optimum = broadcast_from_root(comm, _maximise(work, matrix, limit))
            if optimum is not None or gaps.min() >= 0:
                break
        if optimum is None:
            return None
        # The maximum may not be unique: choose the least motion with the same active constraints,
        # up to a tenth of the initial penetration.
        solution, active = optimum[0], optimum[1] > 0.0
        sides = np.concatenate([matrix, -matrix[active]])
        limit = np.concatenate([limit, 0.1 * NEGLIGIBLE - limit[active]])
        gram = basis.T @ free.gram @ basis
        least = broadcast_from_root(comm, minimise_norm(gram, np.zeros(len(work)), sides, limit))
        return scale * (basis @ (solution if least is None else least))


def _maximise(work: Array, matrix: Array, limit: Array) -> tuple[Array, Array] | None:
    """Maximise work @ x subject to matrix @ x <= limit.

    Returns:
        x and the multipliers of the rows; None: infeasible or unbounded.
    """
    result = scipy.optimize.linprog(
        -work,
        A_ub=matrix,
        b_ub=limit,
        bounds=(None, None),
        options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
    )
    return (result.x, -result.ineqlin.marginals) if result.status == 0 else None
