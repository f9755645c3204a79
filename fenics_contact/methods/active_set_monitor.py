"""Chattering: points of Γc that change their status again and again, and nothing is gained."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import Status
from fenics_contact.parallel import gather_rows, global_sum
from fenics_contact.types import Array

__all__ = ["ActiveSetMonitor"]

# Changes of a point's status since the residual last fell that make it a chattering one, and the
# share by which it has to fall to count.
_CHANGES = 3
_FALL = 0.9


class ActiveSetMonitor:
    """Looks at the status of all points from iteration to iteration.

    Attributes:
        idle: Looks since the residual was at its least, without those of its present fall.
        tractions: Of every contact at the first look, (n_points, gdim) (stress).
    """

    def __init__(self, contacts: Sequence[Contact]) -> None:
        self._contacts = contacts
        n = sum(c.quadrature.n_points for c in contacts)
        self.idle = self._since = 0  # the latter with those of its present fall
        self._best = self._last = np.inf
        self.tractions: list[Array] = []
        self._status = np.full(n, -1, dtype=np.int8)
        self._changes = np.zeros(n, dtype=np.int64)
        self._seen = np.zeros((len(Status), n), dtype=np.bool_)

    def start(self) -> None:
        """Forget what was seen."""
        self.idle, self._since, self.tractions = 0, 0, []
        self._best = self._last = np.inf
        self._status[:], self._changes[:], self._seen[:] = -1, 0, False

    def note(self, residual: float) -> None:
        """Look at the contacts as evaluated.

        Args:
            residual: Norm of the residual there, the same on all ranks.
        """
        if not self._contacts:
            return
        if not self.tractions:
            self.tractions = [c.values.total_traction for c in self._contacts]
        status = np.concatenate([c.status for c in self._contacts])
        seen = status == np.arange(len(Status))[:, None]
        if residual < _FALL * self._best:
            self._best, self.idle, self._since = residual, 0, 0
            self._changes[:], self._seen = 0, seen
        else:
            self._since += 1
            if not residual < _FALL * self._last:
                self.idle = self._since
            self._changes += status != self._status
            self._seen |= seen
        self._status, self._last = status, residual

    def chattering(self) -> str:
        """How many points chatter, between what and where; empty if none does. Collective."""
        found, first = [], 0
        for contact in self._contacts:
            comm, n_points = contact.surface.mesh.comm, contact.quadrature.n_points
            part = slice(first, first + n_points)
            first += n_points
            restless = self._changes[part] >= _CHANGES
            n = int(global_sum(comm, np.count_nonzero(restless)))
            if not n:
                continue
            states = global_sum(comm, self._seen[:, part][:, restless].any(axis=1))
            closed = {} if contact.law.has_tangential else {Status.SLIP: "closed"}
            names = " and ".join(closed.get(s, s.name.lower()) for s in Status if states[s])
            rows = np.column_stack([-self._changes[part], contact.points])[restless]
            rows = gather_rows(comm, rows)
            worst = rows[np.lexsort(rows.T[::-1])][0, 1:]
            found.append(
                f"{contact.name} chatters: {n} of {int(global_sum(comm, n_points))} points keep "
                f"changing between {names}, most often at ({', '.join(f'{x:.4g}' for x in worst)})"
            )
        return "; ".join(found)
