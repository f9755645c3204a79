"""What another run needs of the last commit at a system's unknowns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from fenics_contact.systems.bulk import Bulk
from fenics_contact.systems.unknowns import Unknowns
from fenics_contact.types import Array, Mask

__all__ = ["N_ROWS", "CommittedState"]

# How many arrays a state has over the unknowns: displacements, then forces, then masks.
_DISPLACEMENTS, _FORCES, _MASKS = 2, 3, 2
N_ROWS = _DISPLACEMENTS + _FORCES + _MASKS


@dataclass(frozen=True)
class CommittedState:
    """A committed state, all arrays over this rank's unknowns, (n_local,).

    Attributes:
        state: Values of the unknowns.
        change: Of these in the last increment.
        internal: Internal forces at them (force).
        external: External ones.
        load_change: Of the external ones in the last increment.
        kept: Mask of those kept when condensed.
        constrained: Mask of those with Dirichlet conditions.
        increment: Number of increments so far.
        expected: How many of them were expected.
        pairs_anew: Of each contact whether its pairs are found anew.
    """

    state: Array
    change: Array
    internal: Array
    external: Array
    load_change: Array
    kept: Mask
    constrained: Mask
    increment: int
    expected: int
    pairs_anew: tuple[bool, ...]

    @property
    def numbers(self) -> Array:
        """What is not an array, in one of floats, (2 + n_contacts,)."""
        return np.array([self.increment, self.expected, *self.pairs_anew], dtype=np.float64)

    def rows(self, unknowns: Unknowns, bulk: Bulk) -> Array:
        """The arrays in the user's units, (N_ROWS, n_local)."""
        forces = (self.internal, self.external, self.load_change)
        found = np.stack((self.state, self.change, *forces, self.kept, self.constrained))
        return _converted(found.astype(np.float64), unknowns, bulk, back=False)

    @classmethod
    def from_rows(
        cls, rows: Array, numbers: Sequence[float] | Array, unknowns: Unknowns, bulk: Bulk
    ) -> Self:
        """What gave these `rows` and `numbers`."""
        increment, expected, *anew = (int(number) for number in numbers)
        arrays = _converted(rows, unknowns, bulk, back=True)
        state, change, internal, external, load_change = arrays[:-_MASKS]
        kept, constrained = arrays[-_MASKS:] > 0
        return cls(
            state,
            change,
            internal,
            external,
            load_change,
            kept,
            constrained,
            increment,
            expected,
            pairs_anew=tuple(bool(found) for found in anew),
        )


def _converted(rows: Array, unknowns: Unknowns, bulk: Bulk, *, back: bool) -> Array:
    """Displacements and forces of the body in the user's units, or ``back`` from them."""
    n, found = unknowns.n_dofs, rows.copy()
    convert = (bulk.in_units, bulk.from_units)
    for i in range(N_ROWS - _MASKS):
        found[i, :n] = convert[(i < _DISPLACEMENTS) != back](rows[i, :n])
    return found
