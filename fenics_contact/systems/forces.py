"""Forces at one state, from which energies follow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fenics_contact.types import Array, Index

__all__ = ["Forces"]


@dataclass(frozen=True)
class Forces:
    """Forces at one state, in coordinates of which the unknowns of all states are.

    Attributes:
        unknowns: Displacements and free motions on this rank.
        internal, external: Forces of the bulk, and loads with reactions, at the unknowns.
        label: Body or free obstacle of every unknown.
    """

    unknowns: Array
    internal: Array
    external: Array
    label: Index

    @classmethod
    def none(cls, unknowns: Array, label: Index) -> Forces:
        """No forces."""
        return cls(unknowns, np.zeros_like(unknowns), np.zeros_like(unknowns), label)
