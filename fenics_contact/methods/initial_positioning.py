"""Bodies that nothing holds yet, before an increment: they are set down on what bears them."""

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
from fenics_contact.tolerances import FLAT, NEGLIGIBLE
from fenics_contact.types import Array, Index, Mask

__all__ = ["InitialPositioning"]

# Contact forces that sum up to less than this share of the load on a free motion are none yet.
_IDLE = 1e-3
# The share of what a load drives that counts as most of it.
_MOST = 0.5
# The share of a motion at Γc that may go along a Γc that grips: of a body tilted by up to 0.2.
_ALONG = 0.05
# Part of a free motion, squared, that points must feel to take a body along: less is round-off.
_SHARED = 1e-6
# Where gaps are not linear in rigid motions a body is set down step by step, in the first of which
# it turns by this angle at most (radians), in each other one by half of that before; and the last
# step, by the largest gap, whose square is to be far below `NEGLIGIBLE`.
_TURN, _STEPS, _LAST = 0.2, 30, 1e-6


@dataclass(frozen=True)
class _Free:
    """The free motions that nothing holds, of bodies where they are now, and what they meet there.

    Attributes:
        which: Their numbers among all free motions, (n_free,).
        drive: Work of the load on them, by the largest, (n_free,).
        mass: Their products, (n_free, n_free).
        jumps: Of every contact what its points feel of them, (n_free, n_points, gdim).
    """

    which: Index
    drive: Array
    mass: Array
    jumps: list[Array]


def _feeling(jumps: Array) -> Mask:
    """Which points feel any motions, by their jumps there, (n_free, n_points, gdim)."""
    return np.asarray(np.abs(jumps).max(axis=(0, 2), initial=0.0) > NEGLIGIBLE)


@dataclass(frozen=True)
class InitialPositioning:
    """Where bodies without contact come from and go to in an increment.

    Attributes:
        full: The system on all unknowns.
        motions: Rigid motions of the bodies.
        load: External forces at this rank's unknowns (force).
        before: The state before Dirichlet conditions took their present values.
    """

    full: FullSystem
    motions: RigidBodyModes
    load: Array
    before: Array

    def lead(self, *, first: bool) -> bool:
        """Set bodies that nothing holds yet down, or move them to first touch. Collective.

        One that was released before is set down from where it was left, for that may be far along
        its obstacle.

        Args:
            first: Whether it is the first increment.

        Returns:
            Whether nothing was borne before.
        """
        full, motions = self.full, self.motions
        if not len(motions.free):
            return first
        full.evaluate()
        finite = all(contact.finite for contact in full.contacts)
        groups, load_size = motions.groups(), motions.generalised_load(self.load)
        borne = full.contact_force_sizes(committed=finite)
        idle = (borne < _IDLE * load_size)[groups] & (not first)
        untouched = self._untouched()
        if first:
            here = full.state()
            with self._obstacles_at_start():
                full.evaluate_at(self.before)
                untouched = np.union1d(untouched, self._untouched())
            full.evaluate_at(here)
        if len(untouched) < len(motions.free) and motions.turning:
            # Where bodies touch, an obstacle that turns freely follows in the iteration.
            untouched = untouched[motions.of_any_body()[untouched]]
        which = np.union1d(untouched, np.flatnonzero(idle))
        # Groups of coupled bodies come to rest apart, and those without load stay.
        for group in np.unique(groups[which]):
            if load_size[group] > 0:
                self._set_down(which[groups[which] == group])
        return first or bool(idle.any())

    def _untouched(self) -> Index:
        """Free motions of what no closed point touches, by their numbers. Collective."""
        contacts, motions = self.full.contacts, self.motions
        touched: Array = np.zeros(len(motions.free))
        every = self._felt(np.arange(len(motions.free)))[1]
        for contact, jumps in zip(contacts, every, strict=True):
            closed = contact.status != Status.OPEN
            touched += (np.abs(jumps[:, closed]) > NEGLIGIBLE).any(axis=(1, 2))
        touched = global_sum(self.full.unknowns.comm, touched)
        # What turns about a point does not move there.
        return np.flatnonzero(~(motions.of_same_body() @ (touched > 0)))

    def _set_down(self, which: Index) -> None:
        """Move bodies that touch nothing to where they rest, or to first touch. Collective.

        Slip is counted from where they rest as the increment begins: before prescribed
        displacements, those of obstacles among them, change. They go along with the obstacles on
        which they rest then, and to where they rest at the end of the increment.

        Args:
            which: Numbers of their free motions.
        """
        full = self.full
        aloft = full.state()
        # An obstacle pressed by a force comes to a body as one that is led there does, and may be
        # led along by then: slip is counted from where its increment starts.
        of_bodies = which[self.motions.of_any_body()[which]]
        if len(of_bodies) and any(contact.law.has_friction for contact in full.contacts):
            along = None
            with self._obstacles_at_start() as motions:
                full.evaluate_at(np.where(full.constrained, self.before, aloft))
                if self._find_rest_position(which):
                    along = self._fit_obstacle_motion(which, motions)
                    for contact, jumps in zip(full.contacts, self._felt(of_bodies)[1], strict=True):
                        contact.states.set_slip_reference(_feeling(jumps))
            full.evaluate_at(aloft)
            if along is not None:
                self._move(which, along)
        self._find_rest_position(which)
        if not full.bulk.linear:
            full.update_stiffness()  # of a bulk that has turned

    def _fit_obstacle_motion(self, which: Index, obstacles: Sequence[ObstacleMotion]) -> Array:
        """Fit free motions to the motion of the obstacles that bodies touch. Collective.

        Least squares over the points in touch.

        Args:
            which: Numbers of their free motions.
            obstacles: Motion in the increment of the obstacle of every contact.

        Returns:
            Coefficients of the free motions.
        """
        gram: Array = np.zeros((len(which), len(which)))
        work: Array = np.zeros(len(which))
        scales = self.full.scales
        for number, (contact, jumps, motion) in enumerate(
            zip(self.full.contacts, self._felt(which)[1], obstacles, strict=True)
        ):
            touches = contact.values.opening <= FLAT * scales.size_at_points(number)
            weights = np.where(contact.paired & touches, contact.measure, 0.0)
            way = motion.of_points(contact.own_displacement())
            gram += np.einsum("mqd,q,nqd->mn", jumps, weights, jumps)
            work += np.einsum("mqd,q,qd->m", jumps, weights, way)
        comm = self.full.unknowns.comm
        gram, work = global_sum(comm, gram), global_sum(comm, work)
        return broadcast_from_root(comm, np.linalg.lstsq(gram, work, rcond=_SHARED)[0])

    @contextlib.contextmanager
    def _obstacles_at_start(self) -> Iterator[list[ObstacleMotion]]:
        """Evaluate contacts with rigid obstacles where they were at the last commit. Collective.

        Yields:
            Motion in the increment of the obstacle of every contact.
        """
        self.full.evaluate_at(self.before)
        contacts = self.full.contacts
        motions = [
            contact.contact_kinematics.motion_in_increment(contact.values) for contact in contacts
        ]
        with contextlib.ExitStack() as back:
            for contact, motion in zip(contacts, motions, strict=True):
                back.enter_context(contact.contact_kinematics.displaced(motion))
            yield motions

    def _find_rest_position(self, which: Index) -> bool:
        """Move bodies from here to where they rest, or to first touch. Collective.

        Args:
            which: Numbers of their free motions.

        Returns:
            Whether there is such a place.
        """
        here = self.full.state()
        for along in (_ALONG, np.inf):
            if self._lands(which, along):
                return True
            self.full.evaluate_at(here)
        free = self._free(which)
        way = None if free is None else self._to_first_touch(free)
        if way is not None:
            self._move(which, way)
        return way is not None

    def _felt(self, which: Index) -> tuple[Array, list[Array]]:
        """The free motions of these numbers at this rank's unknowns, and at points. Collective.

        Returns:
            (n_free, n_local), and for every contact (n_free, n_points, gdim).
        """
        fields, at_points = self.motions.present(self.full.operators)
        return fields[which], [jumps[which] for jumps in at_points]

    def _free(self, which: Index) -> _Free | None:
        """The free motions of these numbers; None: the load drives none. Collective."""
        comm = self.full.unknowns.comm
        fields, jumps = self._felt(which)
        drive = global_sum(comm, fields @ self.load)
        most = np.abs(drive).max()
        mass = global_sum(comm, fields @ fields.T)
        opposites = [contact.contact_kinematics for contact in self.full.contacts]
        jumps = [o.displaced_directions(j) for o, j in zip(opposites, jumps, strict=True)]
        return _Free(which, drive / most, mass, jumps) if most > 0 else None

    def _move(self, which: Index, coefficients: Array) -> None:
        """Let free motions of these numbers go on from here, by their coefficients. Collective."""
        full, motions = self.full, self.motions
        every = np.zeros(len(motions.free))
        every[which] = coefficients
        way = motions.displacement(every)
        full.evaluate_at(full.state() + np.where(full.constrained, 0.0, way))

    def _to_first_touch(self, free: _Free) -> Array | None:
        """The way by which the load leads to first touch; None: it meets nothing. Collective."""
        comm = self.full.unknowns.comm
        coefficients = broadcast_from_root(comm, np.linalg.solve(free.mass, free.drive))
        coefficients /= np.abs(coefficients).max()
        way = np.inf
        for contact, jumps in zip(self.full.contacts, free.jumps, strict=True):
            values = contact.values
            jump = np.tensordot(coefficients, jumps, axes=1)
            closing = np.einsum("qd,qd->q", jump, values.normal)
            nearing = closing > NEGLIGIBLE
            ways = values.opening[nearing] / closing[nearing]
            way = min(way, global_min(comm, ways, empty=np.inf))
        return None if way == np.inf else way * coefficients

    # ---- to where a body rests -------------------------------------------------------------------

    def _lands(self, which: Index, along: float) -> bool:
        """Move rigid bodies to where they come to rest, if they do. Collective.

        One set down on an edge has to be turned: the load does not lead there.

        Args:
            which: Numbers of their free motions.
            along: The largest share of a motion that may go along a Γc that grips.
        """
        full, comm = self.full, self.full.unknowns.comm
        free = self._free(which)
        if free is None:
            return False
        gaps = [
            np.abs(c.values.gap[c.paired & _feeling(jumps)]).max(initial=0.0)
            for c, jumps in zip(full.contacts, free.jumps, strict=True)
        ]
        far = global_max(comm, np.array(gaps))
        if not 0 < far < np.inf:
            return False
        linear = full.bulk.linear and not any(contact.finite for contact in full.contacts)
        turn = np.inf if linear else _TURN
        for _ in range(_STEPS):
            free = self._free(which)
            landed = None if free is None else self._landed(free, far, turn, along)
            if landed is None or free is None:
                return False
            self._move(which, landed)
            ways = [np.tensordot(landed, jumps, axes=1) for jumps in free.jumps]
            farthest = np.array([np.abs(way).max(initial=0.0) for way in ways])
            if linear or global_max(comm, farthest) <= _LAST * far:
                return True
            turn /= 2
        return False

    def _landed(self, free: _Free, far: float, turn: float, along: float) -> Array | None:
        """Where bodies come to rest. Collective.

        The load does there all the work that gaps allow, with small rotations: a linear programme.

        Args:
            free: The free motions.
            far: The largest gap (length).
            turn: The largest angle (radians).
            along: As in `_lands`.

        Returns:
            Coefficients of the free motions; None: such motions are none, are little of what the
            load drives, as those in a corner are, or do not end.
        """
        motions, comm, drive = self.motions, self.full.unknowns.comm, free.drive
        grams: Array = np.zeros((2, len(drive), len(drive)))
        rows = []
        for contact, jumps in zip(self.full.contacts, free.jumps, strict=True):
            values, weights = contact.values, contact.quadrature.weights
            closing = np.einsum("mqd,qd->qm", jumps, values.normal)
            rubs = tangential_gram(contact, jumps, closed_only=False)
            grams += [rubs, (closing.T * weights) @ closing]
            there = contact.paired & _feeling(jumps)
            rows.append(np.column_stack([closing, values.gap])[there])
        rubs, presses = global_sum(comm, grams)
        felt = rubs + presses
        if not np.trace(felt) > 0:
            return None
        # There are motions that nothing feels.
        felt += NEGLIGIBLE * np.trace(felt) * np.eye(len(felt))
        shares, vectors = scipy.linalg.eigh(rubs, felt)
        ways = broadcast_from_root(comm, vectors[:, shares < along])
        limits = gather_rows(comm, np.concatenate(rows))
        # What closes no gap, as to go along a corner, round-off of the load would take to no end.
        _, closes, kept = np.linalg.svd(limits[:, :-1] @ ways, full_matrices=False)
        ways = broadcast_from_root(
            comm, ways @ kept[closes > NEGLIGIBLE * closes.max(initial=0.0)].T
        )
        work = drive @ ways
        if not len(work):
            return None
        led = work @ np.linalg.solve(ways.T @ free.mass @ ways, work)
        if not led > _MOST * (drive @ np.linalg.solve(free.mass, drive)):
            return None
        # By ten times the tolerance of the linear programme no point that bears is left open.
        gaps = limits[:, -1] / far + NEGLIGIBLE
        bounds, most = [limits[:, :-1] @ ways], []
        turning = motions.turns > 0
        if turn < np.inf and turning.any():
            turns = motions.free[free.which][:, turning] / motions.turns[turning]
            angles = turns.T @ ways
            bounds += [angles, -angles]
            most += [np.full(2 * len(angles), turn / far)]
        matrix, ends = np.concatenate(bounds), np.concatenate(most) if most else np.zeros(0)
        # What was let go, obstacles may have moved into: it goes out, or no deeper where it cannot.
        for deep in (gaps, np.maximum(gaps, NEGLIGIBLE)):
            limit = np.concatenate([deep, ends])
            found = broadcast_from_root(comm, _maximise(work, matrix, limit))
            if found is not None or gaps.min() >= 0:
                break
        if found is None:
            return None
        # Many motions may do the same work: what no load leads anywhere, though gaps would let it
        # go, moves least. All of them leave those limits where they are that bear the load, here to
        # a tenth of what bodies are set down deeper than to touch.
        place, bearing = found[0], found[1] > 0.0
        both = np.concatenate([matrix, -matrix[bearing]])
        limit = np.concatenate([limit, 0.1 * NEGLIGIBLE - limit[bearing]])
        mass = ways.T @ free.mass @ ways
        least = broadcast_from_root(comm, minimise_norm(mass, np.zeros(len(work)), both, limit))
        return far * (ways @ (place if least is None else least))


def _maximise(work: Array, matrix: Array, limit: Array) -> tuple[Array, Array] | None:
    """Maximise work @ x where matrix @ x <= limit.

    Returns:
        That x, and the multipliers of the rows; None: there is no such x, or no most.
    """
    found = scipy.optimize.linprog(
        -work,
        A_ub=matrix,
        b_ub=limit,
        bounds=(None, None),
        options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
    )
    return (found.x, -found.ineqlin.marginals) if found.status == 0 else None
