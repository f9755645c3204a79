"""Surfaces that begin an increment apart: slip is counted from first touch.

A contact on several groups of coupled bodies counts for each of them by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize
from mpi4py import MPI

from fenics_contact.contact.contact import Contact
from fenics_contact.parallel import global_max, global_min
from fenics_contact.systems.full import FullSystem
from fenics_contact.types import Array, Mask

__all__ = ["set_slip_reference_at_touch"]

# First touch is found where the least gap is below this share of the one at the start.
_TOUCHING_GAP_RATIO = 1e-6


def set_slip_reference_at_touch(
    full: FullSystem,
    start: Array,
    end_without: Callable[[Sequence[tuple[Contact, Mask]], Array], Array | None],
) -> Array | None:
    """Let slip at contacts that begin an increment apart be counted from first touch. Collective.

    Until then they exert no forces on each other, so that the bodies go where load, prescribed
    displacements and other contacts take them: for a linear bulk straight on.

    Args:
        full: The system on all unknowns.
        start: The state in which the increment starts, prescribed values as they were.
        end_without: Finds the state in which it would end if contacts acted at some of their
            points alone, from these and ``start``; None where nothing else holds the bodies.

    Returns:
        The state that this leads to where nothing touches; None where something does, or no
        contact is apart.
    """
    comm = full.unknowns.comm
    parts = [part for part in _parts(full) if part.is_idle(comm)]
    if not parts:
        return None
    present = full.state()
    full.evaluate_at(start)
    ways = [part.contact.contact_kinematics.committed_offset(part.contact.values) for part in parts]
    apart = [(part, way) for part, way in zip(parts, ways, strict=True) if part.is_apart(comm, way)]
    full.set_state(present)
    end = end_without(_without([part for part, _ in apart]), start) if apart else None
    expected = None
    if end is not None:
        paths = [_Path(full, *given, start, end) for given in apart]
        shares = np.array([path.first_touch() for path in paths])
        groups = np.array([path.part.group for path in paths])
        for path, group in zip(paths, groups, strict=True):
            share = shares[groups == group].min()
            if share < 1.0:
                path.gap(share)
                path.part.contact.states.set_slip_reference(path.part.points)
        expected = end if shares.min() == 1.0 else None
    full.evaluate_at(present)
    return expected


@dataclass(frozen=True)
class _Part:
    """The points of a contact on one group of coupled bodies.

    Attributes:
        contact: The contact.
        points: Mask of this rank's points, (n_points,).
        group: Number of the group.
    """

    contact: Contact
    points: Mask
    group: int

    def is_idle(self, comm: MPI.Comm) -> bool:
        """Whether it bore nothing at the last commit. Collective."""
        borne = np.abs(self.contact.history.values("normal_traction")[self.points])
        return not global_max(comm, borne) > 0.0

    def is_apart(self, comm: MPI.Comm, way: Array) -> bool:
        """Whether it neither acts nor touches, displaced by a way. Collective.

        A facet along which the gap varies by more than its least at the points may touch between
        them, as a ball does that stands on a node.
        """
        contact, gap = self.contact, self.gap(way)
        rows = contact.quadrature.point_rows
        acting = np.abs(contact.values.friction_bound) + np.abs(contact.values.normal_traction)
        least, most = gap[rows].min(axis=1), np.where(gap < np.inf, gap, -np.inf)[rows].max(axis=1)
        apart = global_min(comm, (2.0 * least - most)[least < np.inf], empty=0.0) > 0.0
        return apart and not global_max(comm, acting[self.points]) > 0.0

    def gap(self, way: Array) -> Array:
        """Gaps of points displaced by a way, evaluated there, (n_points,) (length). Collective.

        Those of points without an opposite, and of other parts, are infinite.
        """
        contact = self.contact
        with contact.contact_kinematics.displaced(way):
            contact.evaluate()
        return np.where(contact.paired & self.points, contact.values.gap, np.inf)


def _parts(full: FullSystem) -> list[_Part]:
    """The contacts with friction, each divided by groups of coupled bodies. Collective."""
    return [
        _Part(contact, points, group)
        for number, contact in enumerate(full.contacts)
        if contact.law.has_friction
        for group, points in full.scales.parts_of(number).items()
    ]


def _without(parts: Sequence[_Part]) -> list[tuple[Contact, Mask]]:
    """The contacts, and which of their points still act if the parts do not."""
    acting: dict[int, tuple[Contact, Mask]] = {}
    for part in parts:
        _, points = acting.get(id(part.contact), (part.contact, np.ones_like(part.points)))
        acting[id(part.contact)] = part.contact, points & ~part.points
    return list(acting.values())


@dataclass(frozen=True)
class _Path:
    """How the surfaces of a part approach each other as long as nothing touches.

    Attributes:
        full: The system on all unknowns.
        part: The part.
        way: Displacement of its obstacle in the increment, (n_points, gdim) (length).
        start: The state in which the increment starts.
        end: The state in which it would end.
    """

    full: FullSystem
    part: _Part
    way: Array
    start: Array
    end: Array

    def gap(self, share: float) -> Array:
        """Gaps at a share of the increment, evaluated there, (n_points,) (length). Collective."""
        self.full.set_state(self.start + share * (self.end - self.start))
        return self.part.gap((1.0 - share) * self.way)

    def first_touch(self) -> float:
        """Share of the increment at which the least gap closes, 1 where none does. Collective."""
        comm = self.full.unknowns.comm
        at_start, at_end = self.gap(0.0), self.gap(1.0)
        touching = _TOUCHING_GAP_RATIO * global_min(comm, at_start, empty=np.inf)
        if not global_min(comm, at_end, empty=np.inf) < 0.0:
            return 1.0

        def least_gap(share: float) -> float:
            least = global_min(comm, self.gap(share), empty=np.inf)
            return 0.0 if abs(least) <= touching else least

        closing = (at_end < 0.0) & (at_start < np.inf)
        ratios = at_start[closing] / (at_start[closing] - at_end[closing])
        share = global_min(comm, ratios, empty=0.5)  # exact where gaps are linear
        least = least_gap(share)
        if least == 0.0:
            return share
        bracket = (0.0, share) if least < 0.0 else (share, 1.0)
        return float(scipy.optimize.brentq(least_gap, *bracket))
