"""Internal and external forces at one state, from which energies are computed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fenics_contact.systems.partition import Partition
from fenics_contact.types import Array

__all__ = ["Forces"]


@dataclass(frozen=True)
class Forces:
    """Internal and external forces at one state, in the coordinates of the unknowns.

    Attributes:
        unknowns: Displacements and free motions on this rank.
        internal, external: Forces of the bulk, and loads with reactions, at the unknowns.
        partition: Bodies and free obstacles of the unknowns.
    """

    unknowns: Array
    internal: Array
    external: Array
    partition: Partition

    @classmethod
    def zero(cls, unknowns: Array, partition: Partition) -> Forces:
        """Return zero forces at a state."""
        return cls(unknowns, np.zeros_like(unknowns), np.zeros_like(unknowns), partition)
