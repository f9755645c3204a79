"""Which unknowns are kept where a problem is condensed: those that contact may touch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fenics_contact.systems.candidates import acting, distances, nearest, touched
from fenics_contact.systems.condensed import all_kept, inexpensive, worthwhile
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.operator import ContactOperator
from fenics_contact.tolerances import NEGLIGIBLE
from fenics_contact.types import Array, Indices

__all__ = ["Kept"]


# What is kept grows by this factor, lest it grows often.
_GROWTH = 2


class Kept:
    """The unknowns that are kept.

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
        # For `change`: those to be kept, or how far points of the last solution were from bearing.
        self._next: Indices | None = None
        self._away: list[Array] | None = None

    @property
    def count(self) -> int:
        """How many, on all ranks. Collective."""
        return self._count(self.indices)

    @property
    def is_all(self) -> bool:
        """Whether contact touches so little now that all of it is kept. Collective."""
        return self._is_little(self.touched())

    def touched(self) -> Indices:
        """This rank's unknowns that contact touches now. Collective."""
        return touched(self._full.operators, self._full.unknowns)

    def _count(self, indices: Indices) -> int:
        return int(self._full.unknowns.comm.allreduce(indices.size))

    def _is_little(self, everything: Indices) -> bool:
        return all_kept(self._full.unknowns.n_global, self._count(everything), self._full.gdim)

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
        """More unknowns than are kept now. Collective.

        Contact that travels comes back, and all that was kept is so for as long as it pays.

        Args:
            away: See `_nearest`.
            anew: Whether those kept now may be dropped where they would be too many.
        """
        before, n = self.indices, self.count
        kept = before
        for at_least in (_GROWTH * n, 0):
            kept = np.union1d(before, self._nearest(at_least, away)).astype(np.int32)
            if self._count(kept) == n:
                kept = self.touched()
            if self._all_that_pay or self._pays(kept):
                return kept
        return self._nearest(0, away) if anew else kept

    def _pays(self, kept: Indices) -> bool:
        return worthwhile(self._full.unknowns.n_global, self._count(kept), self._full.gdim)

    def grows(self) -> bool:
        """Keep all that contact touches with other pairs, if that is little. Collective.

        A body that slides comes back to places where it was: what is kept grows only.

        Returns:
            Whether it has grown.
        """
        everything = self.touched()
        if not self._is_little(everything):
            return False
        n = self.count
        self.indices = np.union1d(self.indices, everything).astype(np.int32)
        return self.count > n

    def chooses(self, *, other_pairs: bool) -> bool:
        """Whether an increment that starts here takes other unknowns; then `change`. Collective.

        Args:
            other_pairs: Whether points have other opposites than those kept are of.
        """
        comm = self._full.unknowns.comm
        self._next = None
        if not self.chosen:
            self.chosen, found = True, self._nearest()
            if comm.allreduce(int(not np.array_equal(found, self.indices))):
                self._next = found
        elif other_pairs and not self.is_all:
            bearing = [acting(contact) for contact in self._full.contacts]
            needed = touched(self._full.operators, self._full.unknowns, bearing)
            if comm.allreduce(np.setdiff1d(needed, self.indices).size):
                self._next = self._grown(None, anew=True)
        return self._next is not None

    def misses(self, operators: Sequence[ContactOperator], *, found: bool) -> bool:
        """Whether contact acts on more unknowns than are kept. Collective.

        Args:
            operators: Contacts over those kept.
            found: Whether there is a solution; if so contacts are evaluated on all of Γc.
        """
        outside = False
        for operator in operators:
            if operator.within is not None:
                outside |= bool(np.any(acting(operator.contact) & ~operator.within))
        self._next = None
        self._away = [distances(c) for c in self._full.contacts] if found else None
        return bool(self._full.unknowns.comm.allreduce(int(outside)))

    def change(self, *, anew: bool) -> None:
        """Keep what `chooses` or `misses` found to be needed. Collective.

        Args:
            anew: Whether those kept now may be dropped where they would be too many.
        """
        self.indices = self._grown(self._away, anew=anew) if self._next is None else self._next
