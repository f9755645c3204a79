"""Bodies that nothing holds yet, before an increment: they are set down on what bears them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.optimize

from fenics_contact.checks.rigid_motions import RigidMotions, rubbing
from fenics_contact.contact.values import Status
from fenics_contact.parallel import agreed, gather_rows, global_max, global_min, global_sum
from fenics_contact.systems.full import FullSystem
from fenics_contact.types import Array

__all__ = ["Approach"]

# Contact forces that sum up to less than this share of the load on a free motion are none yet.
_IDLE = 1e-3
# The share of what a load drives that counts as most of it.
_MOST = 0.5
# The share of a motion at Γc that may go along a Γc that grips: of a body tilted by up to 0.2.
_ALONG = 0.05
# How far bodies are set down into their supports, by the largest gap: round-off is to leave none of
# the points that bear open, ten times the tolerance of the linear programme.
_INTO = 1e-9
# Relative sizes of motions at points, and of forces, that are none.
_FELT = 1e-10
# Where gaps are not linear in rigid motions a body is set down step by step, in the first of which
# it turns by this angle at most (radians), in each other one by half of that before; and the last
# step, by the largest gap, whose square is to be far below `_INTO`.
_TURN, _STEPS, _LAST = 0.2, 30, 1e-6


@dataclass(frozen=True)
class _Free:
    """The free motions of bodies where they are now, and what they meet there.

    Attributes:
        drive: Work of the load on them, by the largest, (n_free,).
        mass: Their products, (n_free, n_free).
        jumps: Of every contact what its points feel of them, (n_free, n_points, gdim).
    """

    drive: Array
    mass: Array
    jumps: list[Array]


class Approach:
    """Where bodies without contact come from and go to."""

    def __init__(self, full: FullSystem, motions: RigidMotions) -> None:
        """Take the present state for the one that bodies begin in."""
        self._full, self._motions = full, motions
        self._rest = full.state()

    def lead(self, load: Array, *, first: bool) -> bool:
        """Set bodies that nothing holds yet down, or move them to first touch. Collective.

        One that was released before rests wherever that ended, turned perhaps by more than the load
        will press it together: it starts again from where it began.

        Args:
            load: External forces at this rank's unknowns (force).
            first: Whether it is the first increment.

        Returns:
            Whether nothing was borne before.
        """
        full, motions = self._full, self._motions
        if not len(motions.free):
            return first
        cold = first
        for contact in full.contacts:
            contact.evaluate()
        # Of contact not the resultants: those of a body that friction has locked are zero.
        forces = [c.measure @ np.abs(c.values.total_traction).sum(axis=1) for c in full.contacts]
        borne = float(global_sum(full.unknowns.comm, sum(forces, 0.0)))
        outside = np.abs(motions.resultants(load)).max(initial=0.0)
        if borne < _IDLE * outside:
            cold = True
            self._go(np.where(full.constrained, full.state(), self._rest))
        touching = [bool(np.any(c.status != Status.OPEN)) for c in full.contacts]
        if not full.unknowns.comm.allreduce(any(touching)):
            self._set_down(load)
        return cold

    def _go(self, state: Array) -> None:
        """Make a state the present one. Collective."""
        self._full.set_state(state)
        for contact in self._full.contacts:
            contact.evaluate()

    def _set_down(self, load: Array) -> None:
        """Move bodies that touch nothing to where they rest, or to first touch. Collective.

        With finite kinematics slip is counted from there: points come down on other places of a
        curved support than are closest from above. With small displacements it is counted from the
        last commit as ever, and draws a body back by all that it went along Γc.
        """
        full = self._full
        aloft = full.state()
        finite = all(contact.finite for contact in full.contacts)
        for along in (_ALONG, np.inf) if finite else (_ALONG,):
            if self._lands(load, along):
                break
            self._go(aloft)
        else:
            free = self._free(load)
            way = None if free is None else self._to_first_touch(free)
            if way is None:
                return
            self._move(way)
        if not full.bulk.linear:
            full.update_stiffness()
        for contact in full.contacts:
            if contact.finite:
                contact.set_down()

    def _free(self, load: Array) -> _Free | None:
        """The free motions; None: the load drives none. Collective."""
        full, motions, comm = self._full, self._motions, self._full.unknowns.comm
        if full.bulk.linear:  # to which small rotations alone are rigid
            fields = motions.fields
            jumps = [motions.at_points(operator) for operator in full.operators]
        else:
            fields = motions.present_fields()
            jumps = [np.array([o.jump(field) for field in fields]) for o in full.operators]
        drive = global_sum(comm, fields @ load)
        most = np.abs(drive).max()
        mass = global_sum(comm, fields @ fields.T)
        return _Free(drive / most, mass, jumps) if most > 0 else None

    def _move(self, coefficients: Array) -> None:
        """Let free motions go on from here, by their coefficients, (n_free,). Collective."""
        full, motions = self._full, self._motions
        if full.bulk.linear:
            way = coefficients @ motions.fields
        else:
            way = motions.turned(coefficients @ motions.free)
        self._go(full.state() + np.where(full.constrained, 0.0, way))

    def _to_first_touch(self, free: _Free) -> Array | None:
        """The way by which the load leads to first touch; None: it meets nothing. Collective."""
        comm = self._full.unknowns.comm
        coefficients = agreed(comm, np.linalg.solve(free.mass, free.drive))
        coefficients /= np.abs(coefficients).max()
        way = np.inf
        for contact, jumps in zip(self._full.contacts, free.jumps, strict=True):
            values = contact.values
            jump = np.tensordot(coefficients, jumps, axes=1)
            closing = np.einsum("qd,qd->q", jump, values.normal)
            nearing = closing > _FELT
            ways = values.opening[nearing] / closing[nearing]
            way = min(way, global_min(comm, ways, empty=np.inf))
        return None if way == np.inf else way * coefficients

    # ---- to where a body rests -------------------------------------------------------------------

    def _lands(self, load: Array, along: float) -> bool:
        """Move rigid bodies to where they come to rest, if they do. Collective.

        One set down on an edge has to be turned: the load does not lead there.

        Args:
            load: As in `lead`.
            along: The largest share of a motion that may go along a Γc that grips.
        """
        full, comm = self._full, self._full.unknowns.comm
        gaps = [np.abs(c.values.gap[c.paired]).max(initial=0.0) for c in full.contacts]
        far = global_max(comm, np.array(gaps))
        if not 0 < far < np.inf:
            return False
        linear = full.bulk.linear and not any(contact.finite for contact in full.contacts)
        turn = np.inf if linear else _TURN
        for _ in range(_STEPS):
            free = self._free(load)
            landed = None if free is None else self._landed(free, far, turn, along)
            if landed is None or free is None:
                return False
            self._move(landed)
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
        motions, comm, drive = self._motions, self._full.unknowns.comm, free.drive
        grams: Array = np.zeros((2, len(drive), len(drive)))
        rows = []
        for contact, jumps in zip(self._full.contacts, free.jumps, strict=True):
            values, weights = contact.values, contact.quadrature.weights
            closing = np.einsum("mqd,qd->qm", jumps, values.normal)
            grams += [rubbing(contact, jumps, weights), (closing.T * weights) @ closing]
            rows.append(np.column_stack([closing, values.gap])[contact.paired])
        rubs, presses = global_sum(comm, grams)
        felt = rubs + presses
        if not np.trace(felt) > 0:
            return None
        felt += _FELT * np.trace(felt) * np.eye(len(felt))  # there are motions that nothing feels
        shares, vectors = scipy.linalg.eigh(rubs, felt)
        ways = agreed(comm, vectors[:, shares < along])
        work = drive @ ways
        if not len(work):
            return None
        led = work @ np.linalg.solve(ways.T @ free.mass @ ways, work)
        if not led > _MOST * (drive @ np.linalg.solve(free.mass, drive)):
            return None
        limits = gather_rows(comm, np.concatenate(rows))
        bounds, most = [limits[:, :-1] @ ways], [limits[:, -1] / far + _INTO]
        turning = motions.turns > 0
        if turn < np.inf and turning.any():
            angles = (motions.free[:, turning] / motions.turns[turning]).T @ ways
            bounds += [angles, -angles]
            most += [np.full(2 * len(angles), turn / far)]
        found = scipy.optimize.linprog(
            -work,
            A_ub=np.concatenate(bounds),
            b_ub=np.concatenate(most),
            bounds=(None, None),
            options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
        )
        return far * (ways @ agreed(comm, found.x)) if found.status == 0 else None
