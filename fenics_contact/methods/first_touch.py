"""Contacts that begin an increment apart: slip is counted from first touch."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy.sparse.csgraph

from fenics_contact.contact.contact import Contact
from fenics_contact.parallel import global_max, global_min, global_sum
from fenics_contact.systems.full import FullSystem
from fenics_contact.types import Array, Index

__all__ = ["FirstTouch"]

# First touch is found where the least gap is below this share of the one at the start.
_TOUCHING_GAP_RATIO = 1e-6
# Evaluations by which it is found where gaps are not linear in the displacement.
_MAX_EVALUATIONS = 20


class FirstTouch:
    """Finds where in an increment surfaces that begin it apart touch.

    Until then they exert no forces on each other, so that the bodies go where load, prescribed
    displacements and other contacts take them: for a linear bulk straight on.

    Attributes:
        end: The state that this leads to where nothing touches; None where something does, or no
            contact is apart.
    """

    def __init__(self, full: FullSystem) -> None:
        """Nothing is apart.

        Args:
            full: The system on all unknowns.
        """
        self._full = full
        self.end: Array | None = None

    def count_slip(
        self, start: Array, end_without: Callable[[Sequence[Contact], Array], Array | None]
    ) -> None:
        """Let slip at contacts that are apart be counted from first touch. Collective.

        Args:
            start: The state in which the increment starts, prescribed values as they were.
            end_without: Finds the state in which it would end if some contacts did not act, from
                them and ``start``; None where nothing else holds the bodies.
        """
        full, self.end = self._full, None
        idle = [n for n, contact in enumerate(full.contacts) if self._is_idle(contact)]
        if not idle:
            return
        present = full.state()
        contacts = [full.contacts[n] for n in idle]
        full.set_state(start)
        for contact in contacts:
            contact.evaluate()
        ways = [contact.opposite.committed_offset(contact.values) for contact in contacts]
        apart = [
            n for n, given in enumerate(zip(contacts, ways, strict=True)) if self._is_apart(*given)
        ]
        contacts, ways = [contacts[n] for n in apart], [ways[n] for n in apart]
        full.set_state(present)
        end = end_without(contacts, start) if apart else None
        if end is not None:
            paths = [_Path(full, *given, start, end) for given in zip(contacts, ways, strict=True)]
            shares = np.array([path.first_touch() for path in paths])
            groups = self._groups()[np.array(idle)[apart]]
            for path, group in zip(paths, groups, strict=True):
                share = shares[groups == group].min()
                if share < 1.0:
                    path.gap(share)
                    path.contact.count_slip_from_here()
            self.end = end if shares.min() == 1.0 else None
        full.set_state(present)
        for contact in full.contacts:
            contact.evaluate()

    def _is_idle(self, contact: Contact) -> bool:
        """Whether a contact with friction bore nothing at the last commit. Collective."""
        if not contact.law.has_friction:
            return False
        borne = np.abs(contact.history.values("normal_traction"))
        return not global_max(self._full.unknowns.comm, borne) > 0.0

    def _is_apart(self, contact: Contact, way: Array) -> bool:
        """Whether a contact neither acts nor touches, displaced by a way. Collective.

        A facet along which the gap varies by more than its least at the points may touch between
        them, as a ball does that stands on a node.
        """
        comm, rows = self._full.unknowns.comm, contact.quadrature.point_rows()
        gap = _gap(contact, way)
        acting = np.abs(contact.values.friction_bound) + np.abs(contact.values.normal_traction)
        least, most = gap[rows].min(axis=1), np.where(gap < np.inf, gap, -np.inf)[rows].max(axis=1)
        apart = global_min(comm, (2.0 * least - most)[least < np.inf], empty=0.0) > 0.0
        return apart and not global_max(comm, acting) > 0.0

    def _groups(self) -> Index:
        """Number of the group of each contact, (n_contacts,): of bodies that contacts link.

        Collective.
        """
        full = self._full
        touches = np.array(
            [
                np.bincount(full.label[operator.touched], minlength=full.n_bodies) > 0
                for operator in full.operators
            ]
        )
        touches = global_sum(full.unknowns.comm, touches.astype(np.float64))
        _, group = scipy.sparse.csgraph.connected_components(touches @ touches.T)
        return np.asarray(group)


def _gap(contact: Contact, way: Array) -> Array:
    """Gaps of points displaced by a way, (n_points,) (length). Collective.

    Those of points without an opposite are infinite.
    """
    with contact.opposite.displaced(way):
        contact.evaluate()
    return np.where(contact.paired, contact.values.gap, np.inf)


class _Path:
    """How the surfaces of a contact approach each other as long as nothing touches.

    Attributes:
        contact: The contact.
    """

    def __init__(
        self, full: FullSystem, contact: Contact, way: Array, start: Array, end: Array
    ) -> None:
        """Take both ends.

        Args:
            full: The system on all unknowns.
            contact: The contact.
            way: Displacement of its obstacle in the increment, (n_points, gdim) (length).
            start: The state in which the increment starts.
            end: The state in which it would end.
        """
        self._full, self.contact, self._way = full, contact, way
        self._start, self._end = start, end

    def gap(self, share: float) -> Array:
        """Gaps at a share of the increment, evaluated there, (n_points,) (length). Collective."""
        self._full.set_state(self._start + share * (self._end - self._start))
        return _gap(self.contact, (1.0 - share) * self._way)

    def first_touch(self) -> float:
        """Share of the increment at which the least gap closes, 1 where none does. Collective."""
        comm = self._full.unknowns.comm
        low, high = 0.0, 1.0
        at_low, at_high = self.gap(low), self.gap(high)
        touching = _TOUCHING_GAP_RATIO * global_min(comm, at_low, empty=np.inf)
        if not global_min(comm, at_high, empty=np.inf) < 0.0:
            return 1.0
        share = 1.0
        for _ in range(_MAX_EVALUATIONS):
            closing = (at_high < 0.0) & (at_low < np.inf)
            ratios = at_low[closing] / (at_low[closing] - at_high[closing])
            share = low + (high - low) * global_min(comm, ratios, empty=0.5)
            now = self.gap(share)
            least = global_min(comm, now, empty=np.inf)
            if abs(least) <= touching:
                break
            if least < 0.0:
                high, at_high = share, now
            else:
                low, at_low = share, now
        return share
