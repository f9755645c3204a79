"""Between which points of two bodies an increment is solved: those opposite each other at its end.

With small displacements pairs of points are found in one state of the bodies and stay as they are
while the increment is solved. Where it ends points may have slid off their pairs; then it is solved
again between others. This is an iteration for the state in which pairs are found. It begins with a
predictor, the state in which the increment ends if it goes on as the last one, and is relaxed by
Aitken's method [U. Küttler, W. A. Wall, Comput. Mech. 43 (2008) 61-72, eq. 44], contact by contact:
a body that is pushed along a curved surface answers to other pairs by more than their change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fenics_contact.contact.body import NEGLIGIBLE_SLIDE
from fenics_contact.contact.contact import Contact
from fenics_contact.contact.contact_kinematics import KinematicsState
from fenics_contact.parallel import global_sum
from fenics_contact.state import State
from fenics_contact.systems.full import FullSystem
from fenics_contact.tolerances import NEGLIGIBLE
from fenics_contact.types import Array

__all__ = ["OppositePoints"]

# Number of times that pairs of a contact are found in an increment: with relaxation 2 to 4 do.
_MAX_PAIRINGS = 10
# Least and largest share of the way to where the increment ended, by relaxation.
_LEAST_SHARE, _LARGEST_SHARE = 0.1, 2.0
# Largest extrapolation of the last increment, doubled ones included: beyond, contact hardly goes on
# as it did.
_MAX_RATIO = 2.1


@dataclass(frozen=True)
class _Pairing:
    """How pairs of a contact were found last.

    Attributes:
        state: The state in which they were found.
        slide: How far points had slid from the pairs before in the solution between them, in sizes
            of their facets, (n_points, gdim), NaN where they did not transmit forces; None: there
            is no solution yet.
        depth: Of the points in the opposing body there, or by the predictor, (n_points,) (length).
        share: Of the way from the state before to the end of the increment.
        number: How often they have been found in this increment after a solution.
        opposite: The pairs, and the committed jump between them.
    """

    state: Array
    slide: Array | None
    depth: Array
    share: float
    number: int
    kinematics: KinematicsState | None = None


class OppositePoints:
    """The iteration for the pairs of an increment.

    Args:
        full: The system on all unknowns.
        contacts: Of the problem, all or none.

    Attributes:
        contacts: Those of them whose pairs may be found anew.
        predicted: Whether the first pairs are predicted ones.
        end: The state in which the increment ended between the pairs before; None: it is not solved
            yet.
    """

    def __init__(self, full: FullSystem, contacts: Sequence[Contact]) -> None:
        self.end: Array | None = None
        self.predicted = False
        self._full = full
        self.contacts = [c for c in contacts if c.contact_kinematics.can_update_pairs]
        self._pairings: dict[str, _Pairing] = {}

    @property
    def replaced(self) -> bool:
        """Whether others are in the place of the committed pairs."""
        return bool(self._pairings)

    def predict(self, state: State, prescribed: Array, load: Array) -> None:
        """Find the pairs of where the increment ends if it goes on as the last one. Collective.

        Of those contacts whose pairs are found anew at every commit, and need new ones by then for
        the points that transmit forces in the committed state.

        Args:
            state: The committed state, complete.
            prescribed: The unknowns with the present values of the Dirichlet conditions (length).
            load: The present external forces (force).
        """
        if state.change is None:
            return
        ratio = self._increment_ratio(state, state.change, prescribed, load)
        if not self._full.unknowns.comm.allreduce(int(ratio.any())):
            return
        end = state.unknowns + ratio * state.change
        self._full.set_state(end)
        for contact in self.contacts:
            before = contact.states.committed.points
            if before is None or not contact.contact_kinematics.updates_pairs:
                continue
            contact.evaluate()
            if contact.contact_kinematics.needs_new_pairs(contact.values, before):
                self._pairings[contact.name] = _Pairing(end, None, contact.values.depth, 1.0, 0)
        self.predicted = self.replaced
        self.find(state.unknowns)

    def _increment_ratio(
        self, state: State, change: Array, prescribed: Array, load: Array
    ) -> Array:
        """Loads and prescribed values of this increment relative to the last one's. Collective.

        By projection, of every group of interacting bodies. Prescribed displacements count by the
        stiffness of the bulk.

        Returns:
            At the unknowns: 1 in equal increments; 0 where the last one had none, or loads turn
            round or grow by much more.
        """
        full, n = self._full, self._full.unknowns.n_dofs
        held, stiffness = full.constrained[:n], full.bulk.scale
        groups = full.scales.group[full.label]

        def forces(displacement: Array, force: Array) -> Array:
            return np.where(held, stiffness * displacement[:n], force[:n])

        whole = forces(state.unknowns, state.load)
        last = forces(change, state.load_change)
        now = forces(prescribed - state.unknowns, load - state.load)
        products = (last * now, last * last, whole * whole)
        sums = [np.bincount(groups[:n], row, minlength=full.scales.n_groups) for row in products]
        along, size, largest = full.scales.global_sum(np.array(sums))
        known = size > NEGLIGIBLE**2 * largest
        ratio = along / np.where(known, size, 1.0)
        ratio[~(known & (ratio > 0.0) & (ratio < _MAX_RATIO))] = 0.0
        return np.asarray(ratio[groups])

    def drop_prediction(self) -> bool:
        """Go back to the committed pairs if others were predicted; whether so."""
        predicted, self.predicted = self.predicted, False
        if predicted:
            self._pairings, self.end = {}, None
        return predicted

    def to_update(self) -> list[Contact]:
        """Contacts that need new pairs, see `ContactKinematics.needs_new_pairs`. Collective."""
        return [
            c
            for c in self.contacts
            if self._number_of(c) < _MAX_PAIRINGS and c.contact_kinematics.needs_new_pairs(c.values)
        ]

    def to_update_for(self, names: Sequence[str]) -> list[Contact]:
        """Contacts whose pairs may cause a large small-displacement error. Collective.

        All of which points have slid; and those with the error if their pairs are not of this
        increment, for points without a pair do not tell how far they have come.

        Args:
            names: Of contacts with a large error.
        """
        if not any(c.name in names for c in self.contacts):
            return []
        return [
            c
            for c in self.contacts
            if (number := self._number_of(c)) < _MAX_PAIRINGS
            and (
                c.contact_kinematics.largest_slide(c.values) > NEGLIGIBLE_SLIDE
                or (c.name in names and number == 0)
            )
        ]

    def _number_of(self, contact: Contact) -> int:
        """How often its pairs have been found in this increment after a solution."""
        pairing = self._pairings.get(contact.name)
        return 0 if pairing is None else pairing.number

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
            slide[~contact.contact_kinematics.transmitting_points(values)] = np.nan
            share, state, number = 1.0, end, 1
            if last is not None:
                number = last.number + 1
            if last is not None and last.slide is not None:
                change = slide - last.slide
                sums = [np.nansum(last.slide * change), np.nansum(change * change)]
                along, size = global_sum(contact.surface.mesh.comm, sums)
                if size > 0:
                    relaxed = -last.share * float(along / size)
                    share = min(max(relaxed, _LEAST_SHARE), _LARGEST_SHARE)
                state = last.state + share * (end - last.state)
            self._pairings[contact.name] = _Pairing(state, slide, values.depth, share, number)

    def find(self, committed: Array) -> None:
        """Find the pairs whose states were chosen. Collective.

        Args:
            committed: The committed state, complete.
        """
        new = [c for c in self.contacts if self._is_chosen(c)]
        for contact in new:
            pairing = self._pairings[contact.name]
            self._full.set_state(pairing.state)
            contact.contact_kinematics.find_pairs(contact.displacement.u, pairing.depth)
        self._full.set_state(committed)
        for contact in new:
            contact.contact_kinematics.update_committed_jump()
            found = replace(
                self._pairings[contact.name], kinematics=contact.contact_kinematics.state()
            )
            self._pairings[contact.name] = found

    def _is_chosen(self, contact: Contact) -> bool:
        """Whether a state was chosen in which pairs are not found yet."""
        pairing = self._pairings.get(contact.name)
        return pairing is not None and pairing.kinematics is None

    def begin(self, contacts: Sequence[Contact]) -> None:
        """Let an increment begin again, between the pairs found for it. Collective.

        Args:
            contacts: All contacts of the problem.
        """
        if not self._pairings:
            return
        for contact in contacts:
            contact.states.restore()
            pairing = self._pairings.get(contact.name)
            if pairing is not None and pairing.kinematics is not None:
                contact.states.begin_between(pairing.kinematics)
