"""The committed state of a problem, and the trial state of an increment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fenics_contact.checks.energy import EnergyState
from fenics_contact.contact.contact import Contact
from fenics_contact.contact.states import ContactState, ContactTrial
from fenics_contact.types import Array

__all__ = ["State", "Trial"]


@dataclass(frozen=True)
class State:
    """A committed state with the history variables, from which an increment starts.

    Attributes:
        unknowns: This rank's displacements, then the unknown motions of obstacles (length).
        contacts: The state of every contact.
        load: External forces at the unknowns (force).
        energy: Forces and energies.
        load_change: Change of the external forces in the last increment (force).
        change: Change of the unknowns in the last increment (length), None if unknown.
        interior: Vector that recovers the interior displacement; None if it is up to date.
        increment: Number of committed increments.
    """

    unknowns: Array
    contacts: tuple[ContactState, ...]
    load: Array
    energy: EnergyState
    load_change: Array
    change: Array | None = None
    interior: Array | None = None
    increment: int = 0

    def check_contacts(self, contacts: Sequence[Contact]) -> None:
        """Raise a ValueError if a contact has been committed elsewhere since."""
        for contact, state in zip(contacts, self.contacts, strict=True):
            contact.states.check_unchanged(state)


@dataclass(frozen=True)
class Trial:
    """A solved and verified state that is not committed, with the attributes of a `State`."""

    unknowns: Array
    contacts: tuple[ContactTrial, ...]
    load: Array
    energy: EnergyState
    interior: Array | None
