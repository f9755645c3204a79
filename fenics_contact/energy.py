"""Where the work of the loads goes: elastic energy, contact springs, friction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from fenics_contact.contact import Contact
from fenics_contact.parallel import global_sum

__all__ = ["Energy", "EnergyState"]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Energy:
    """Energies of one increment (force times length; in 2D per thickness), equal on every rank.

    Works are means of the forces at both ends of the increment times the way between them.

    Attributes:
        work: Work of the loads, of Dirichlet values and of moving supports.
        elastic: Work of the internal forces: the change of elastic energy, exact for a linear bulk.
        springs: Change of the energy in the contact's springs, r_n²/2k_n + |τ|²/2k_t.
        dissipation: Work of friction on the slip, ≥ 0.
        remainder: What of the work is in none of them: contact that changes within the increment
            (gets less with smaller increments), and springs let go where contact opens.
        imbalance: Work minus elastic minus the work of all tractions on Γc: zero by equilibrium
            at both ends, up to the solver's tolerance.
    """

    work: float
    elastic: float
    springs: float
    dissipation: float
    remainder: float
    imbalance: float


@dataclass(frozen=True)
class EnergyState:
    """Forces and places at one state, on this rank; what lies between two is an `Energy`.

    Attributes:
        unknowns: Displacements and free motions.
        internal, external: Forces of the bulk, and loads with reactions, at the unknowns.
        contacts: Of each contact the tractions on the body, its displacement relative to the
            support, and that of the support as far as it is prescribed: (3, n_points, gdim).
        springs: Energy in the contact's springs on this rank.
    """

    unknowns: Array
    internal: Array
    external: Array
    contacts: list[Array]
    springs: float

    @classmethod
    def unloaded(cls, unknowns: Array, contacts: Sequence[Contact]) -> EnergyState:
        """No forces anywhere."""
        none = np.zeros_like(unknowns)
        ways = [np.stack([0 * c.points, c.values["jump"], c.values["shift"]]) for c in contacts]
        return cls(unknowns, none, none, ways, 0.0)

    @classmethod
    def at(
        cls, unknowns: Array, internal: Array, external: Array, contacts: Sequence[Contact]
    ) -> EnergyState:
        """The state that ``contacts`` have evaluated."""
        ways = [np.stack([c.traction, c.values["jump"], c.values["shift"]]) for c in contacts]
        springs = sum(float(c.measure @ c.values["stored"]) for c in contacts)
        return cls(unknowns, internal, external, ways, springs)

    def since(self, before: EnergyState, contacts: Sequence[Contact], comm: MPI.Comm) -> Energy:
        """Energies on the way from ``before`` to here. Collective."""
        way = self.unknowns - before.unknowns
        # Work, elastic, springs, dissipation, and work of the tractions.
        sums = np.zeros(5)
        sums[0] = 0.5 * (before.external + self.external) @ way
        sums[1] = 0.5 * (before.internal + self.internal) @ way
        sums[2] = self.springs - before.springs
        for contact, old, new in zip(contacts, before.contacts, self.contacts, strict=True):
            mean = contact.measure[:, None] * 0.5 * (old[0] + new[0])
            sums[0] += np.sum(mean * (new[2] - old[2]))
            sums[4] -= np.sum(mean * (new[1] - old[1]))
            if contact.law.has_friction:
                sums[3] += contact.measure @ contact.values["dissipated"]
        work, elastic, springs, dissipation, tractions = (float(v) for v in global_sum(comm, sums))
        remainder = work - elastic - springs - dissipation
        return Energy(work, elastic, springs, dissipation, remainder, work - elastic - tractions)
