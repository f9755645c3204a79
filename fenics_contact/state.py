"""The state of a problem: all that an increment starts from, and what it finds."""

from __future__ import annotations

from dataclasses import dataclass

from fenics_contact.checks.energy import EnergyState
from fenics_contact.contact.states import ContactState, ContactTrial
from fenics_contact.types import Array

__all__ = ["State", "Trial"]


@dataclass(frozen=True)
class State:
    """A committed state, the whole history of a problem.

    Attributes:
        unknowns: This rank's displacements, then the unknown motions of obstacles (length).
        contacts: The state of every contact.
        load: External forces at the unknowns (force).
        energy: Forces and energies.
        load_change: Of the external forces in the last increment (force).
        change: Of the unknowns in the last increment (length); None: there was none, or the
            interior was out of date.
        interior: What recovers the interior displacement after static condensation; None if the
            unknowns are up to date.
        increment: Number of increments so far.
    """

    unknowns: Array
    contacts: tuple[ContactState, ...]
    load: Array
    energy: EnergyState
    load_change: Array
    change: Array | None = None
    interior: Array | None = None
    increment: int = 0


@dataclass(frozen=True)
class Trial:
    """A solved and verified state that is not committed; for the attributes see `State`."""

    unknowns: Array
    contacts: tuple[ContactTrial, ...]
    load: Array
    energy: EnergyState
    interior: Array | None
