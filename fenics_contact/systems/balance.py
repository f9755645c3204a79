"""Who has to be in balance, and by which measure: every body, free support and contact by its own.

A residual says nothing until it is compared with forces. Those of another body, of another contact
or of an earlier increment are no measure: a body loaded by 1e-4 beside one loaded by 10 would be
left to itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from fenics_contact.types import Array, Mask

__all__ = ["Norms", "Parts", "by_body"]

Labels = npt.NDArray[np.intp]

# Sums of squares from here on, and up to one over it, have lost none of their terms.
_SMALL = 1e-200
# Round-off of a product K u by the size of its terms, summed up row by row. A body that is carried
# along shows it: up to 14 eps on random tetrahedra of degree 2, 34 on a distorted mesh.
_ROUND_OFF = 40 * np.finfo(float).eps
# Round-off excuses a residual up to this share of the forces on a body that has a load, not more: a
# displacement grown without bounds would excuse anything.
_MOST = 1e-5
# Forces below which numbers have lost digits: what is left of a load that has been taken away.
_LEAST = np.finfo(float).tiny / np.finfo(float).eps


@dataclass(frozen=True)
class Norms:
    """Norms of one state by part, equal on every rank; bodies first, then supports and contacts.

    Attributes:
        residual: Of the free unknowns, (n_parts,) (force).
        force: Of the forces that act now, the largest of load, reactions and contact, (n_parts,).
        floor: Round-off, which no iteration can undercut, (n_parts,) (force).
        n_bodies: Bodies and free supports, which share the unknowns between them.
    """

    residual: Array
    force: Array
    floor: Array
    n_bodies: int

    def tolerance(self, rtol: float) -> Array:
        """What passes, (n_parts,) (force)."""
        return np.maximum(rtol * self.force, self.floor)

    def excess(self, rtol: float) -> Array:
        """Residual over tolerance, (n_parts,); infinite where something is not finite."""
        tolerance = self.tolerance(rtol)
        with np.errstate(all="ignore"):
            ratio = np.where(self.residual == 0.0, 0.0, self.residual / tolerance)
        finite = np.isfinite(self.residual) & np.isfinite(self.force) & np.isfinite(self.floor)
        return np.where(finite & ~np.isnan(ratio), ratio, np.inf)

    def within(self, rtol: float) -> bool:
        """Whether every part is in balance."""
        return bool(np.all(self.excess(rtol) <= 1.0))

    @property
    def total(self) -> float:
        """Residual of all unknowns (force): to see whether it falls, not whether it is small."""
        return _root(self.residual[: self.n_bodies])


class Parts:
    """How the unknowns of a space are shared by bodies and free supports, and what contacts touch.

    Attributes:
        names: Of the parts.
        label: Body or free support of every unknown of this rank, (n_local,).
        n_bodies: Their number.
    """

    def __init__(
        self,
        comm: MPI.Comm,
        label: Labels,
        bodies: Sequence[str],
        contacts: Sequence[str],
        touched: Sequence[npt.NDArray[np.int32]],
        motions: Sequence[int],
    ) -> None:
        """Collect. Collective.

        Args:
            comm: The ranks.
            label: See the attribute.
            bodies: Names of bodies, then of free supports.
            contacts: Names of the contacts.
            touched: Unknowns of this rank that a contact feels or acts on, for every contact.
            motions: Of every free support the number of its contact.
        """
        self._comm, self.label, self._touched = comm, label, touched
        self.n_bodies = len(bodies)
        self._bodies: Labels | int = label if len(bodies) > 1 else 0
        self.names = [*bodies, *contacts]
        self._motions = list(motions)
        meets = np.zeros((len(contacts), self.n_bodies), dtype=np.bool_)
        for row, unknowns in zip(meets, touched, strict=True):
            row[label[unknowns]] = True
        # Bodies that a contact touches, on any rank.
        self._meets = np.any(comm.allgather(meets), axis=0)

    def norms(
        self,
        residual: Array,
        contacts: Sequence[Array],
        load: Array,
        product: Array,
        constrained: Mask,
        outside: Array,
        start: Array,
    ) -> Norms:
        """Norms at one state. Collective.

        Args:
            residual: Forces that are left at the unknowns, reactions included, (n_local,).
            contacts: Of every contact the part that is its own, (n_local,).
            load: External forces, (n_local,).
            product: Size of the terms of the matrix times the unknowns, (n_local,).
            constrained: Mask of the unknowns with Dirichlet conditions.
            outside: Norms of load and product at unknowns outside of the space, (2, n_bodies).
            start: Norms of the product where the increment began, (n_bodies,).
        """
        n, free = self.n_bodies, np.where(constrained, 0.0, residual)
        held = residual - free
        total = contacts[0] if len(contacts) == 1 else sum(contacts, np.zeros_like(residual))
        rows = [(v, self._bodies) for v in (free, held, total, load, product)]
        for number, (force, touched) in enumerate(zip(contacts, self._touched, strict=True)):
            rows += [(free[touched], n + number), (force[touched], n + number)]
        found = _norms(self._comm, rows, n + len(contacts))
        left, reaction, contact, loads, terms = found[:5, :n]
        loads, terms = np.hypot(loads, outside[0]), np.hypot(terms, outside[1])
        own = [found[5 + 2 * c, n + c] for c in range(len(contacts))]
        push = [found[6 + 2 * c, n + c] for c in range(len(contacts))]
        for body, number in zip(range(n - len(self._motions), n), self._motions, strict=True):
            # What acts on a free support may cancel; what it is the sum of does not.
            contact[body] = push[number]
        force = np.max([loads, reaction, contact], axis=0)
        floor = _ROUND_OFF * np.maximum(terms, start)
        floor = np.where(loads > 0, np.minimum(floor, _MOST * force), floor)
        floor = np.maximum(floor, _LEAST)
        # A body has the round-off of what it touches, too, where the other has gone far.
        floors = [floor[row].max(initial=0.0) for row in self._meets]
        for row, shared in zip(self._meets, floors, strict=True):
            floor = np.where(row, np.maximum(floor, shared), floor)
        # An open contact has no measure of its own: what is left there is its body's.
        own = [r if f > 0 else 0.0 for r, f in zip(own, push, strict=True)]
        return Norms(np.append(left, own), np.append(force, push), np.append(floor, floors), n)


def by_body(comm: MPI.Comm, vectors: Sequence[Array], label: Labels, n_bodies: int) -> Array:
    """Norms of vectors over this rank's unknowns, (n_vectors, n_bodies). Collective.

    Args:
        comm: The ranks.
        vectors: (n_local,) each.
        label: Body of every unknown, (n_local,).
        n_bodies: Their number.
    """
    return _norms(comm, [(v, label if n_bodies > 1 else 0) for v in vectors], n_bodies)


def _root(values: Array) -> float:
    """Root of the sum of squares, without overflow."""
    largest = float(np.max(values, initial=0.0))
    if not (largest > 0 and np.isfinite(largest)):
        return largest
    return largest * float(np.sqrt(np.sum((values / largest) ** 2)))


def _norms(comm: MPI.Comm, rows: Sequence[tuple[Array, Labels | int]], n: int) -> Array:
    """Norms of vectors by label, one for all or of each entry, (n_vectors, n). Collective.

    Squares neither overflow nor vanish.
    """
    mine = np.zeros((len(rows), n + 1))
    for found, (values, label) in zip(mine, rows, strict=True):
        if isinstance(label, int):
            square = float(values @ values)
            if _SMALL < square < 1 / _SMALL:
                found[label], found[n] = square, 1.0
                continue
        largest = np.abs(values).max(initial=0.0)
        found[n] = largest
        if largest > 0.0 and np.isfinite(largest):
            scaled = values / largest
            if isinstance(label, int):
                found[label] = scaled @ scaled
            else:
                found[:n] = np.bincount(label, scaled * scaled, minlength=n)
    if comm.size > 1:
        ranks = np.array(comm.allgather(mine))
    else:
        ranks = mine[None]
    largest = ranks[:, :, n].max(axis=0)
    safe = np.where(largest > 0, largest, 1.0)
    with np.errstate(invalid="ignore"):
        share = (ranks[:, :, n] / safe) ** 2
        norms = largest[:, None] * np.sqrt(np.sum(share[:, :, None] * ranks[:, :, :n], axis=0))
    # Whose entry was not finite cannot be told from here: none is trusted.
    return np.where(np.isfinite(largest)[:, None], norms, np.nan)
