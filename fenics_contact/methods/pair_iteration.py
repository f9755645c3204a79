"""Fixed-point iteration for the pairs of an increment with small-displacement kinematics.

Pairs are found in one state and fixed while the increment is solved. If points have slid off their
pairs at the end, new pairs are found and the increment is solved again. The first state is
extrapolated from the last increment; the others are relaxed by Aitken's method [U. Küttler, W. A.
Wall, Comput. Mech. 43 (2008) 61-72, eq. 44] for each contact, as new pairs on a curved surface may
displace a body by more than the pairs have changed.
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

__all__ = ["PairIteration"]

_MAX_PAIRINGS = 10  # of a contact in an increment; 2 to 4 usually suffice
_MIN_RELAXATION, _MAX_RELAXATION = 0.1, 2.0
# Largest extrapolation of the last increment, so that increments may double.
_MAX_INCREMENT_RATIO = 2.1


@dataclass(frozen=True)
class _Pairing:
    """The last pairing of a contact.

    Attributes:
        state: The state in which the pairs are found.
        slide: Slide from the previous pairs in their solution, by facet size, (n_points, gdim), NaN
            at points without force; None: no solution yet.
        depth: Depth of the points in the opposing body, solved or predicted, (n_points,) (length).
        relaxation: Relaxation factor from the previous state to the end of the increment.
        number: Number of pairings after a solution in this increment.
        kinematics: The pairs and their committed jump.
    """

    state: Array
    slide: Array | None
    depth: Array
    relaxation: float
    number: int
    kinematics: KinematicsState | None = None


class PairIteration:
    """Fixed-point iteration for the pairs of an increment.

    Args:
        full: The system on all unknowns.
        contacts: All contacts of the problem, or none.

    Attributes:
        contacts: The contacts whose pairs can be updated.
        predicted: Whether the present pairs are predicted.
        end: The state at the end of the increment with the previous pairs; None: not solved yet.
    """

    def __init__(self, full: FullSystem, contacts: Sequence[Contact]) -> None:
        self.end: Array | None = None
        self.predicted = False
        self._full = full
        self.contacts = [c for c in contacts if c.contact_kinematics.can_update_pairs]
        self._pairings: dict[str, _Pairing] = {}

    @property
    def replaced(self) -> bool:
        """Whether the committed pairs are replaced by others."""
        return bool(self._pairings)

    def predict(self, state: State, prescribed: Array, load: Array) -> None:
        """Find the pairs at the end of an increment extrapolated from the last one. Collective.

        They are predicted for contacts with updates at every commit whose points with committed
        forces need new pairs.

        Args:
            state: The complete committed state.
            prescribed: The unknowns with the present values of the Dirichlet conditions (length).
            load: The present external forces (force).
        """
        if state.change is None:
            return
        ratio = self._compute_increment_ratio(state, state.change, prescribed, load)
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

    def _compute_increment_ratio(
        self, state: State, change: Array, prescribed: Array, load: Array
    ) -> Array:
        """Compare loads and prescribed values of this increment with the last one. Collective.

        The ratio is a projection for every group of coupled bodies, with prescribed displacements
        weighted by the stiffness of the bulk.

        Returns:
            At the unknowns: 1 for equal increments; 0 if the last one was zero, or loads are
            reversed or grow much more.
        """
        full, n = self._full, self._full.unknowns.n_dofs
        prescribed_dofs, stiffness = full.constrained[:n], full.bulk.scale
        groups = full.scales.group[full.partition.label]

        def forces(displacement: Array, force: Array) -> Array:
            return np.where(prescribed_dofs, stiffness * displacement[:n], force[:n])

        total = forces(state.unknowns, state.load)
        last = forces(change, state.load_change)
        present = forces(prescribed - state.unknowns, load - state.load)
        products = (last * present, last * last, total * total)
        sums = [np.bincount(groups[:n], row, minlength=full.scales.n_groups) for row in products]
        product, size, largest = full.scales.global_sum(np.array(sums))
        known = size > NEGLIGIBLE**2 * largest
        ratio = product / np.where(known, size, 1.0)
        ratio[~(known & (ratio > 0.0) & (ratio < _MAX_INCREMENT_RATIO))] = 0.0
        return np.asarray(ratio[groups])

    def drop_prediction(self) -> bool:
        """Restore the committed pairs if others were predicted; return whether so."""
        predicted, self.predicted = self.predicted, False
        if predicted:
            self._pairings, self.end = {}, None
        return predicted

    def find_outdated(self) -> list[Contact]:
        """Return contacts that need new pairs (`ContactKinematics.needs_new_pairs`). Collective."""
        return [
            c
            for c in self.contacts
            if self._count_pairings(c) < _MAX_PAIRINGS
            and c.contact_kinematics.needs_new_pairs(c.values)
        ]

    def find_outdated_for(self, names: Sequence[str]) -> list[Contact]:
        """Return contacts whose pairs may cause a large small-displacement error. Collective.

        Their points have slid; or they have the error and pairs of an earlier increment, in which
        the slide of unpaired points is unknown.

        Args:
            names: Names of the contacts with a large error.
        """
        if not any(c.name in names for c in self.contacts):
            return []
        return [
            c
            for c in self.contacts
            if (number := self._count_pairings(c)) < _MAX_PAIRINGS
            and (
                c.contact_kinematics.largest_slide(c.values) > NEGLIGIBLE_SLIDE
                or (c.name in names and number == 0)
            )
        ]

    def _count_pairings(self, contact: Contact) -> int:
        """Return the number of pairings of a contact after a solution in this increment."""
        pairing = self._pairings.get(contact.name)
        return 0 if pairing is None else pairing.number

    def relax_states(self, contacts: Sequence[Contact], end: Array) -> None:
        """Set the states in which the next pairs of evaluated contacts are found. Collective.

        Args:
            contacts: The contacts.
            end: The state at the end of the increment with the present pairs.
        """
        self.end = end
        for contact in contacts:
            values, last = contact.values, self._pairings.get(contact.name)
            slide = values.slide / contact.quadrature.facet_sizes[:, None]
            slide[~contact.contact_kinematics.transmitting_points(values)] = np.nan
            relaxation, state, number = 1.0, end, 1
            if last is not None:
                number = last.number + 1
            if last is not None and last.slide is not None:
                change = slide - last.slide
                sums = [np.nansum(last.slide * change), np.nansum(change * change)]
                product, size = global_sum(contact.surface.mesh.comm, sums)
                if size > 0:
                    aitken = -last.relaxation * float(product / size)
                    relaxation = min(max(aitken, _MIN_RELAXATION), _MAX_RELAXATION)
                state = last.state + relaxation * (end - last.state)
            self._pairings[contact.name] = _Pairing(state, slide, values.depth, relaxation, number)

    def find(self, committed: Array) -> None:
        """Find the pairs in the states that were set. Collective.

        Args:
            committed: The complete committed state.
        """
        new = [c for c in self.contacts if self._is_pending(c)]
        for contact in new:
            pairing = self._pairings[contact.name]
            self._full.set_state(pairing.state)
            contact.contact_kinematics.find_pairs(contact.displacement.u, pairing.depth)
        self._full.set_state(committed)
        for contact in new:
            contact.contact_kinematics.update_committed_jump()
            pairing = replace(
                self._pairings[contact.name], kinematics=contact.contact_kinematics.state()
            )
            self._pairings[contact.name] = pairing

    def _is_pending(self, contact: Contact) -> bool:
        """Return whether the pairs of the last state are still to be found."""
        pairing = self._pairings.get(contact.name)
        return pairing is not None and pairing.kinematics is None

    def begin(self, contacts: Sequence[Contact]) -> None:
        """Restart the increment with the pairs found for it. Collective.

        Args:
            contacts: All contacts of the problem.
        """
        if not self._pairings:
            return
        for contact in contacts:
            contact.states.restore()
            pairing = self._pairings.get(contact.name)
            if pairing is not None and pairing.kinematics is not None:
                contact.states.start_with_pairs(pairing.kinematics)
