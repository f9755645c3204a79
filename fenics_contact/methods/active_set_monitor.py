"""Detection of chattering: points of Γc that change their status repeatedly without progress."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import Status
from fenics_contact.parallel import gather_rows, global_sum
from fenics_contact.types import Array

__all__ = ["ActiveSetMonitor"]

# Status changes since the residual last decreased from which on a point chatters.
_CHATTERING_CHANGES = 3
# Ratio to the previous residual below which a residual counts as a decrease.
_DECREASE_RATIO = 0.9


class ActiveSetMonitor:
    """Residual and status of all points over the iterations of one solution.

    Attributes:
        n_stalled: Iterations since the least residual, without those of a decrease in progress.
        initial_tractions: Of every contact at the first iterate, (n_points, gdim) (stress).
    """

    def __init__(self, contacts: Sequence[Contact]) -> None:
        self._contacts = contacts
        n = sum(c.quadrature.n_points for c in contacts)
        self.n_stalled = self._since = 0  # the latter with those of a decrease in progress
        self._best = self._last = np.inf
        self.initial_tractions: list[Array] = []
        self._status = np.full(n, -1, dtype=np.int8)
        self._changes = np.zeros(n, dtype=np.int64)
        self._status_mask = np.zeros((len(Status), n), dtype=np.bool_)

    def reset(self) -> None:
        """Clear the record before a solution."""
        self.n_stalled, self._since, self.initial_tractions = 0, 0, []
        self._best = self._last = np.inf
        self._status[:], self._changes[:], self._status_mask[:] = -1, 0, False

    def record(self, residual: float) -> None:
        """Record the status of the evaluated contacts, at a residual equal on all ranks."""
        if not self._contacts:
            return
        if not self.initial_tractions:
            self.initial_tractions = [c.values.total_traction for c in self._contacts]
        status = np.concatenate([c.status for c in self._contacts])
        status_mask = status == np.arange(len(Status))[:, None]
        if residual < _DECREASE_RATIO * self._best:
            self._best, self.n_stalled, self._since = residual, 0, 0
            self._changes[:], self._status_mask = 0, status_mask
        else:
            self._since += 1
            if not residual < _DECREASE_RATIO * self._last:
                self.n_stalled = self._since
            self._changes += status != self._status
            self._status_mask |= status_mask
        self._status, self._last = status, residual

    def describe_chattering(self) -> str:
        """Describe number, status and location of chattering points, if any. Collective."""
        descriptions, first = [], 0
        for contact in self._contacts:
            comm, n_points = contact.surface.mesh.comm, contact.quadrature.n_points
            part = slice(first, first + n_points)
            first += n_points
            chatters = self._changes[part] >= _CHATTERING_CHANGES
            n = int(global_sum(comm, np.count_nonzero(chatters)))
            if not n:
                continue
            states = global_sum(comm, self._status_mask[:, part][:, chatters].any(axis=1))
            closed = {} if contact.law.has_tangential else {Status.SLIP: "closed"}
            names = " and ".join(closed.get(s, s.name.lower()) for s in Status if states[s])
            rows = np.column_stack([-self._changes[part], contact.points])[chatters]
            rows = gather_rows(comm, rows)
            where = rows[np.lexsort(rows.T[::-1])][0, 1:]
            descriptions.append(
                f"{contact.name} chatters: {n} of {int(global_sum(comm, n_points))} points keep "
                f"changing between {names}, most often at ({', '.join(f'{x:.4g}' for x in where)})"
            )
        return "; ".join(descriptions)
