"""Between which points of two bodies an increment is solved: those opposite each other at its end.

With small displacements pairs of points are found in one state of the bodies and stay as they are
while the increment is solved. Where it ends points may have slid off their pairs; then it is solved
again between others. This is an iteration for the state in which pairs are found. It begins where
the increment will end if it goes on as the last one, and is relaxed by
Aitken's method [U. Küttler, W. A. Wall, Comput. Mech. 43 (2008) 61-72, eq. 44], contact by contact:
a body that is pushed along a curved surface answers to other pairs by more than their change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fenics_contact.contact.body import NEGLIGIBLE_SLIDE
from fenics_contact.contact.contact import Contact
from fenics_contact.contact.opposite import OppositeState
from fenics_contact.parallel import global_sum
from fenics_contact.systems.full import FullSystem
from fenics_contact.types import Array

__all__ = ["OppositePoints"]

# Number of times that pairs of a contact are found in an increment: with relaxation 2 to 4 do.
_MAX_PAIRINGS = 10
# Least and largest share of the way to where the increment ended, by relaxation.
_LEAST_SHARE, _LARGEST_SHARE = 0.1, 2.0


@dataclass(frozen=True)
class _Pairing:
    """How pairs of a contact were found last.

    Attributes:
        state: The state in which they were found.
        slide: How far points had slid from the pairs before, in sizes of their facets, (n_points,
            gdim); NaN where they did not transmit forces.
        depth: Of the points in the opposing body where the increment had ended, (n_points,)
            (length).
        share: Of the way from the state before to the end of the increment.
        number: How often they have been found in this increment after a solution.
        opposite: The pairs, and the committed jump between them.
    """

    state: Array
    slide: Array
    depth: Array
    share: float
    number: int
    opposite: OppositeState | None = None


class OppositePoints:
    """The iteration for the pairs of an increment.

    Attributes:
        contacts: Those whose pairs may be found anew.
        end: The state in which the increment ended between the pairs before; None: it is not solved
            yet.
    """

    def __init__(self, contacts: Sequence[Contact]) -> None:
        """Begin with the pairs of the committed state.

        Args:
            contacts: Of the problem, all or none.
        """
        self.end: Array | None = None
        self.contacts = [c for c in contacts if c.opposite.may_pair_anew]
        self._pairings: dict[str, _Pairing] = {}

    @property
    def replaced(self) -> bool:
        """Whether others are in the place of the committed pairs."""
        return bool(self._pairings)

    def expect(self, end: Array, full: FullSystem, committed: Array) -> None:
        """Find pairs where the increment is expected to end. Collective.

        Only of contacts of which points that transmit forces leave their pairs by then.

        Args:
            end: The state expected.
            full: The system on all unknowns.
            committed: The committed state, complete.
        """
        full.set_state(end)
        for contact in self.contacts:
            contact.evaluate()
        for contact in self.to_update():
            # That slide is of no solution, and says nothing of how the next one answers.
            unknown = np.full_like(contact.values.slide, np.nan)
            depth = contact.values.depth
            self._pairings[contact.name] = _Pairing(end, unknown, depth, share=1.0, number=0)
        self.find(full, committed)

    def to_update(self) -> list[Contact]:
        """Contacts of which points that transmit forces have left their pairs. Collective."""
        return [c for c in self._unfinished() if c.opposite.needs_new_pairs(c.values)]

    def to_update_for(self, names: Sequence[str]) -> list[Contact]:
        """Contacts whose pairs may cause a large small-displacement error. Collective.

        All of which points have slid; and those with the error if their pairs are committed ones,
        for points without a pair do not tell how far they have come.

        Args:
            names: Of contacts with a large error.
        """
        found: list[Contact] = []
        if not any(contact.name in names for contact in self.contacts):
            return found
        for contact in self._unfinished():
            slid = contact.opposite.largest_slide(contact.values) > NEGLIGIBLE_SLIDE
            if slid or (contact.name in names and contact.name not in self._pairings):
                found.append(contact)
        return found

    def _unfinished(self) -> list[Contact]:
        made = self._pairings
        return [
            c for c in self.contacts if c.name not in made or made[c.name].number < _MAX_PAIRINGS
        ]

    def choose_states(self, contacts: Sequence[Contact], end: Array) -> None:
        """Choose the states in which to find the pairs of evaluated contacts next. Collective.

        Args:
            contacts: The contacts.
            end: The state in which the increment has ended between the present pairs.
        """
        self.end = end
        for contact in contacts:
            values, last = contact.values, self._pairings.get(contact.name)
            slide = values.slide / contact.quadrature.facet_sizes[:, None]
            slide[~contact.opposite.transmitting_points(values)] = np.nan
            share, state, number = 1.0, end, 1
            if last is not None:
                change = slide - last.slide
                sums = [np.nansum(last.slide * change), np.nansum(change * change)]
                along, size = global_sum(contact.surface.mesh.comm, sums)
                if size > 0:
                    relaxed = -last.share * float(along / size)
                    share = min(max(relaxed, _LEAST_SHARE), _LARGEST_SHARE)
                state, number = last.state + share * (end - last.state), last.number + 1
            self._pairings[contact.name] = _Pairing(state, slide, values.depth, share, number)

    def find(self, full: FullSystem, committed: Array) -> None:
        """Find the pairs whose states were chosen. Collective.

        Args:
            full: The system on all unknowns.
            committed: The committed state, complete.
        """
        new = [c for c in self.contacts if self._is_chosen(c)]
        for contact in new:
            pairing = self._pairings[contact.name]
            full.set_state(pairing.state)
            contact.opposite.find_pairs(contact.displacement.u, pairing.depth)
        full.set_state(committed)
        for contact in new:
            contact.opposite.update_committed_jump()
            found = replace(self._pairings[contact.name], opposite=contact.opposite.state())
            self._pairings[contact.name] = found

    def _is_chosen(self, contact: Contact) -> bool:
        """Whether a state was chosen in which pairs are not found yet."""
        pairing = self._pairings.get(contact.name)
        return pairing is not None and pairing.opposite is None

    def begin(self, contacts: Sequence[Contact]) -> None:
        """Let an increment begin again, between the pairs found for it. Collective.

        Args:
            contacts: All contacts of the problem.
        """
        if not self._pairings:
            return
        for contact in contacts:
            contact.restore()
            pairing = self._pairings.get(contact.name)
            if pairing is not None and pairing.opposite is not None:
                contact.begin_between(pairing.opposite)
