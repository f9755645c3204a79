"""Selection of the unknowns retained in static condensation: those that contact may couple."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fenics_contact.systems.candidate_dofs import (
    compute_contact_distances,
    find_active_points,
    find_coupled_dofs,
    select_nearest_dofs,
)
from fenics_contact.systems.condensed import is_worthwhile, n_inexpensive, should_retain_all
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.operator import ContactOperator
from fenics_contact.tolerances import NEGLIGIBLE
from fenics_contact.types import Array, Indices

__all__ = ["RetainedDofs"]

# Of the number of retained dofs: each extension condenses again, and a dense factorisation of twice
# as many takes eight times as long.
_GROWTH_FACTOR = 1.5


class RetainedDofs:
    """The retained unknowns.

    They are all unknowns coupled by contact if these are few, otherwise those of the least gaps,
    and are extended when contact spreads. The constructor is collective.

    Args:
        full: The system on all unknowns.
        unlimited: Whether their number is not limited, as condensation was requested.

    Attributes:
        indices: Local indices, ascending.
        is_selected: Whether they were selected at the start of the first increment, or restored.
    """

    def __init__(self, full: FullSystem, *, unlimited: bool) -> None:
        self._full, self._unlimited = full, unlimited
        self.indices = self._select_nearest()
        self.is_selected = False
        # For `update`: the dofs to retain, or the distances of points from contact in the solution.
        self._next: Indices | None = None
        self._distances: list[Array] | None = None

    @property
    def count(self) -> int:
        """Number of retained unknowns on all ranks. Collective."""
        return self._count(self.indices)

    @property
    def is_all(self) -> bool:
        """Whether the coupled unknowns are few, so that all are retained. Collective."""
        return self._is_small(self.find_coupled())

    def find_coupled(self) -> Indices:
        """Find the local unknowns that contact couples with the present pairs. Collective."""
        return find_coupled_dofs(self._full.operators, self._full.unknowns)

    def _count(self, indices: Indices) -> int:
        return int(self._full.unknowns.comm.allreduce(indices.size))

    def _is_small(self, coupled: Indices) -> bool:
        return should_retain_all(
            self._full.unknowns.n_global, self._count(coupled), self._full.gdim
        )

    def _select_nearest(self, at_least: int = 0, gaps: Sequence[Array] | None = None) -> Indices:
        """Select about ``at_least`` unknowns of the points with the least gaps. Collective."""
        coupled = self.find_coupled()
        if self._is_small(coupled):
            return coupled
        if gaps is None:
            self._full.evaluate()
            gaps = [compute_contact_distances(contact) for contact in self._full.contacts]
        n_cheap = n_inexpensive(self._full.unknowns.n_global, self._full.gdim)
        return select_nearest_dofs(
            self._full.operators,
            self._full.unknowns,
            gaps,
            max(at_least, n_cheap),
            NEGLIGIBLE * self._full.scales.mesh_size,
        )

    def _select_more(self, gaps: Sequence[Array] | None, *, can_drop: bool) -> Indices:
        """Select more unknowns, without the present ones if ``can_drop`` and needed. Collective."""
        present, n = self.indices, self.count
        retained = present
        for at_least in (int(_GROWTH_FACTOR * n), 0):
            retained = np.union1d(present, self._select_nearest(at_least, gaps)).astype(np.int32)
            if self._count(retained) == n:
                retained = self.find_coupled()
            if self._unlimited or self._is_worthwhile(retained):
                return retained
        return self._select_nearest(0, gaps) if can_drop else retained

    def _is_worthwhile(self, retained: Indices) -> bool:
        return is_worthwhile(self._full.unknowns.n_global, self._count(retained), self._full.gdim)

    def extend(self) -> bool:
        """Add all unknowns coupled by new pairs if they are few. Collective.

        None are dropped, as a sliding body may return.

        Returns:
            Whether there are more unknowns.
        """
        coupled = self.find_coupled()
        if not self._is_small(coupled):
            return False
        n = self.count
        self.indices = np.union1d(self.indices, coupled).astype(np.int32)
        return self.count > n

    def select_dofs(self, *, other_pairs: bool) -> bool:
        """Select unknowns at the start of an increment; return whether to `update`. Collective.

        Args:
            other_pairs: Whether the pairs have changed since the last selection.
        """
        comm = self._full.unknowns.comm
        self._next = None
        if not self.is_selected:
            self.is_selected, indices = True, self._select_nearest()
            if comm.allreduce(int(not np.array_equal(indices, self.indices))):
                self._next = indices
        elif other_pairs and not self.is_all:
            active = [find_active_points(contact) for contact in self._full.contacts]
            required = find_coupled_dofs(self._full.operators, self._full.unknowns, active)
            if comm.allreduce(np.setdiff1d(required, self.indices).size):
                self._next = self._select_more(None, can_drop=True)
        return self._next is not None

    def needs_more_dofs(self, operators: Sequence[ContactOperator], *, has_solution: bool) -> bool:
        """Return whether contact acts on further unknowns; prepare `update`. Collective.

        Args:
            operators: Operators of the contacts over the retained unknowns.
            has_solution: Whether there is a solution, with contacts evaluated on all of Γc.
        """
        acts_outside = False
        for operator in operators:
            if operator.within is not None:
                acts_outside |= bool(
                    np.any(find_active_points(operator.contact) & ~operator.within)
                )
        self._next = None
        self._distances = (
            [compute_contact_distances(c) for c in self._full.contacts] if has_solution else None
        )
        return bool(self._full.unknowns.comm.allreduce(int(acts_outside)))

    def update(self, *, can_drop: bool) -> None:
        """Retain the unknowns required by `select_dofs` or `needs_more_dofs`. Collective.

        Args:
            can_drop: Whether the present ones may be dropped if there are too many.
        """
        self.indices = (
            self._select_more(self._distances, can_drop=can_drop)
            if self._next is None
            else self._next
        )
