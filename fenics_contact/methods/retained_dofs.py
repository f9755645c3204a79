"""Which unknowns are retained where a problem is condensed: those that contact may touch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fenics_contact.systems.candidate_dofs import active_points, distances, nearest, touched
from fenics_contact.systems.condensed import all_retained, inexpensive, worthwhile
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.operator import ContactOperator
from fenics_contact.tolerances import NEGLIGIBLE
from fenics_contact.types import Array, Indices

__all__ = ["RetainedDofs"]


# What is retained grows by this factor, lest it grows often.
_GROWTH = 2


class RetainedDofs:
    """The unknowns that are retained.

    All that contact touches, if that is little; else those where bodies are nearest to each other,
    and more where it turns out that contact spreads beyond them. The constructor is collective.

    Args:
        full: The system on all unknowns.
        all_that_pay: Whether to keep however many there are, since the caller says so.

    Attributes:
        indices: This rank's, ascending.
        chosen: Whether they were chosen where the first increment starts, or given for it.
    """

    def __init__(self, full: FullSystem, *, all_that_pay: bool) -> None:
        self._full, self._all_that_pay = full, all_that_pay
        self.indices = self._nearest()
        self.chosen = False
        # For `change`: the dofs to retain, or the distances of the last solution's points from
        # contact.
        self._next: Indices | None = None
        self._away: list[Array] | None = None

    @property
    def count(self) -> int:
        """How many, on all ranks. Collective."""
        return self._count(self.indices)

    @property
    def is_all(self) -> bool:
        """Whether contact touches so little now that all of it is retained. Collective."""
        return self._is_little(self.touched())

    def touched(self) -> Indices:
        """This rank's unknowns that contact touches now. Collective."""
        return touched(self._full.operators, self._full.unknowns)

    def _count(self, indices: Indices) -> int:
        return int(self._full.unknowns.comm.allreduce(indices.size))

    def _is_little(self, everything: Indices) -> bool:
        return all_retained(self._full.unknowns.n_global, self._count(everything), self._full.gdim)

    def _nearest(self, at_least: int = 0, away: Sequence[Array] | None = None) -> Indices:
        """Unknowns to keep: where bodies are nearest to each other. Collective.

        Args:
            at_least: About how many, if they are more than come for nothing.
            away: How far points are from bearing; by default at the present state.
        """
        everything = self.touched()
        if self._is_little(everything):
            return everything
        if away is None:
            self._full.evaluate()
            away = [distances(contact) for contact in self._full.contacts]
        for_nothing = inexpensive(self._full.unknowns.n_global, self._full.gdim)
        return nearest(
            self._full.operators,
            self._full.unknowns,
            away,
            max(at_least, for_nothing),
            NEGLIGIBLE * self._full.scales.mesh_size,
        )

    def _grown(self, away: Sequence[Array] | None, *, anew: bool) -> Indices:
        """More unknowns than are retained now. Collective.

        Contact that travels comes back, and all that was retained is so for as long as it pays.

        Args:
            away: See `_nearest`.
            anew: Whether those retained now may be dropped where they would be too many.
        """
        before, n = self.indices, self.count
        retained = before
        for at_least in (_GROWTH * n, 0):
            retained = np.union1d(before, self._nearest(at_least, away)).astype(np.int32)
            if self._count(retained) == n:
                retained = self.touched()
            if self._all_that_pay or self._pays(retained):
                return retained
        return self._nearest(0, away) if anew else retained

    def _pays(self, retained: Indices) -> bool:
        return worthwhile(self._full.unknowns.n_global, self._count(retained), self._full.gdim)

    def grows(self) -> bool:
        """Keep all that contact touches with other pairs, if that is little. Collective.

        A body that slides comes back to places where it was: what is retained grows only.

        Returns:
            Whether it has grown.
        """
        everything = self.touched()
        if not self._is_little(everything):
            return False
        n = self.count
        self.indices = np.union1d(self.indices, everything).astype(np.int32)
        return self.count > n

    def select_dofs(self, *, other_pairs: bool) -> bool:
        """Whether an increment that starts here takes other unknowns; then `change`. Collective.

        Args:
            other_pairs: Whether points have other opposites than those retained are of.
        """
        comm = self._full.unknowns.comm
        self._next = None
        if not self.chosen:
            self.chosen, found = True, self._nearest()
            if comm.allreduce(int(not np.array_equal(found, self.indices))):
                self._next = found
        elif other_pairs and not self.is_all:
            bearing = [active_points(contact) for contact in self._full.contacts]
            needed = touched(self._full.operators, self._full.unknowns, bearing)
            if comm.allreduce(np.setdiff1d(needed, self.indices).size):
                self._next = self._grown(None, anew=True)
        return self._next is not None

    def needs_more_dofs(self, operators: Sequence[ContactOperator], *, found: bool) -> bool:
        """Whether contact acts on more unknowns than are retained. Collective.

        Args:
            operators: Contacts over those retained.
            found: Whether there is a solution; if so contacts are evaluated on all of Γc.
        """
        outside = False
        for operator in operators:
            if operator.within is not None:
                outside |= bool(np.any(active_points(operator.contact) & ~operator.within))
        self._next = None
        self._away = [distances(c) for c in self._full.contacts] if found else None
        return bool(self._full.unknowns.comm.allreduce(int(outside)))

    def change(self, *, anew: bool) -> None:
        """Keep what `select_dofs` or `needs_more_dofs` found to be needed. Collective.

        Args:
            anew: Whether those retained now may be dropped where they would be too many.
        """
        self.indices = self._grown(self._away, anew=anew) if self._next is None else self._next
