"""Who has to be in balance, and by which measure: every body, free obstacle and contact by its own.

A residual says nothing until it is compared with forces. Those of another body, of another contact
or of an earlier increment are no measure: a body loaded by 1e-4 beside one loaded by 10 would be
left to itself. But where forces are unloaded their round-off is left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from fenics_contact.parallel import global_sum
from fenics_contact.systems.reference_scales import ReferenceScales
from fenics_contact.tolerances import ROUND_OFF
from fenics_contact.types import Array, Index, Mask

__all__ = ["MOST_EXCUSED", "InitialForces", "Labels", "Norms", "Parts", "by_body"]

Labels = npt.NDArray[np.intp]

# Round-off of a product K u by the size of its terms, summed up row by row. A body that is carried
# along shows it: up to 14 eps on random tetrahedra of degree 2, 34 on a distorted mesh.
_ROUND_OFF = 40 * np.finfo(float).eps
# How far a body that no condition holds may be displaced, by its size or by how far it is as the
# increment starts, for round-off to excuse all that it leaves: 1e-11 of its stiffness. What
# diverges along a free motion excuses no more.
_FARTHEST = 1e3
# The largest share of forces that round-off excuses: of loads, of contact forces on a body that no
# condition holds, and on one of both sides of every contact.
MOST_EXCUSED = 1e-5
# Forces below which numbers have lost digits: what is left of a load that has been taken away.
_LEAST = np.finfo(float).tiny / np.finfo(float).eps


@dataclass(frozen=True)
class InitialForces:
    """Forces at the beginning of an increment, of which round-off may be left at its end.

    Attributes:
        terms: Norms of the product of matrix and unknowns, (n_bodies,) (force).
        pushes: Norms of the committed contact forces, (n_contacts, n_bodies) (force).
    """

    terms: Array
    pushes: Array


@dataclass(frozen=True)
class Norms:
    """Norms of one state by part, equal on every rank; bodies first, then obstacles and contacts.

    Attributes:
        residual: Of the free unknowns, (n_parts,) (force).
        force: Of the forces that act now, the largest of load, reactions and contact, (n_parts,).
        floor: What round-off excuses, (n_parts,) (force).
        round_off: That of the parts on which forces act that are more than what others left, all
            of it, 0 for others, (n_parts,) (force).
        n_bodies: Bodies and free obstacles, which share the unknowns between them.
    """

    residual: Array
    force: Array
    floor: Array
    round_off: Array
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
    def is_round_off(self) -> Mask:
        """Whose residual is round-off and nothing else, (n_bodies,)."""
        return np.asarray(self.residual <= self.floor)[: self.n_bodies]

    def without(self, bodies: Mask) -> Norms:
        """The same without the residuals of some bodies, by a mask, (n_bodies,)."""
        residual = self.residual.copy()
        residual[: self.n_bodies][bodies] = 0.0
        return replace(self, residual=residual)

    @property
    def total(self) -> float:
        """Residual of all unknowns (force): to see whether it falls, not whether it is small."""
        return _root(self.residual[: self.n_bodies])


@dataclass(frozen=True)
class Parts:
    """How the unknowns of a space are shared by bodies and free obstacles, and what contacts touch.

    Attributes:
        comm: The ranks.
        label: Body or free obstacle of every unknown of this rank, (n_local,).
        bodies: Names of bodies, then of free obstacles.
        contacts: Names of the contacts.
        touched: Unknowns of this rank that a contact feels or acts on, for every contact.
        pairs: Bodies and obstacles that a contact presses on each other, for every contact,
            (n_pairs, 2); a body on a rigid obstacle is paired with itself.
        scales: Reference scales of the bodies.
        motions: Of every free obstacle the number of its contact.
    """

    comm: MPI.Comm
    label: Labels
    bodies: Sequence[str]
    contacts: Sequence[str]
    touched: Sequence[npt.NDArray[np.int32]]
    pairs: Sequence[Index]
    scales: ReferenceScales
    motions: Sequence[int]

    @property
    def names(self) -> list[str]:
        """Names of the parts."""
        return [*self.bodies, *self.contacts]

    def norms(
        self,
        residual: Array,
        contacts: Sequence[Array],
        load: Array,
        product: Array,
        constrained: Mask,
        outside: Array,
        start: InitialForces,
    ) -> Norms:
        """Norms at one state. Collective.

        Args:
            residual: Forces that are left at the unknowns, reactions included, (n_local,).
            contacts: Of every contact the part that is its own, (n_local,).
            load: External forces, (n_local,).
            product: Size of the terms of the matrix times the unknowns, (n_local,).
            constrained: Mask of the unknowns with Dirichlet conditions.
            outside: Norms of load and product at unknowns outside of the space, (2, n_bodies).
            start: Forces at the beginning of the increment.
        """
        n, free = len(self.bodies), np.where(constrained, 0.0, residual)
        held = residual - free
        total = contacts[0] if len(contacts) == 1 else sum(contacts, np.zeros_like(residual))
        rows = [(v, self.label) for v in (free, held, total, load, product)]
        for force, touched in zip(contacts, self.touched, strict=True):
            bodies = self.label[touched]
            push = np.where(constrained, 0.0, force)[touched]
            rows += [(free[touched], bodies), (push, bodies)]
        found = _norms(self.comm, rows, n)
        left, reaction, contact, loads, terms = found[:5]
        loads, terms = np.hypot(loads, outside[0]), np.hypot(terms, outside[1])
        own, pushes = found[5::2], found[6::2]
        for body, number in zip(range(n - len(self.motions), n), self.motions, strict=True):
            # What acts on a free obstacle may cancel; what it is the sum of does not.
            contact[body] = _root(pushes[number])
        force = np.max([loads, reaction, contact], axis=0)
        # A displacement that nothing holds may grow without bounds, and would excuse anything.
        fixed = self.scales.held
        of_bodies = np.append(self.scales.force, np.full(len(self.motions), np.inf))
        farthest = _FARTHEST * np.maximum(of_bodies, start.terms)
        terms = np.maximum(terms, start.terms)
        terms = np.where(fixed, terms, np.minimum(terms, farthest))
        round_off = np.maximum(_ROUND_OFF * terms, _LEAST)
        # A contact force is as exact as the softer of both bodies has it.
        exact = np.tile(round_off, (len(contacts), 1))
        for row, pairs in zip(exact, self.pairs, strict=True):
            for one, other in (pairs.T, pairs.T[::-1]):
                np.minimum.at(row, one, round_off[other])
        acts = pushes > np.maximum(exact, ROUND_OFF * force)
        # What a sine leaves of a load at its zeros, and moves no digit where conditions hold all.
        none = np.append(_ROUND_OFF * self.scales.least_force, np.zeros(len(self.motions)))
        loaded = loads > np.where(fixed, none, 0.0)
        limited = loaded | (acts.any(axis=0) & ~fixed)
        # Contact forces that are unloaded leave their round-off.
        unloaded = _ROUND_OFF * np.maximum(start.pushes - pushes, 0.0).max(axis=0, initial=0.0)
        most, most_of_contacts = (
            np.maximum(MOST_EXCUSED * acting, unloaded) for acting in (force, pushes)
        )
        floor = np.where(limited, np.minimum(round_off, most), round_off)
        floor = np.maximum(floor, _LEAST)
        floors = np.where(acts, np.minimum(round_off, most_of_contacts), round_off)
        blurs = np.where(acts & (unloaded <= MOST_EXCUSED * pushes), round_off, 0.0)
        sides = [
            _governing(pairs, *rows)
            for pairs, *rows in zip(self.pairs, own, pushes, floors, blurs, strict=True)
        ]
        of_contacts = np.reshape(sides, (len(contacts), 4)).T
        acted_on = (loaded | acts.any(axis=0)) & (unloaded <= MOST_EXCUSED * force)
        of_bodies = np.array([left, force, floor, np.where(acted_on, round_off, 0.0)])
        residual, force, floor, round_off = np.concatenate([of_bodies, of_contacts], axis=1)
        return Norms(residual, force, floor, round_off, n)


def _governing(
    pairs: Index, left: Array, push: Array, floor: Array, round_off: Array
) -> tuple[float, float, float, float]:
    """What a contact is judged by: the four attributes of `Norms`.

    What it does is known if one of both bodies is in balance, and not prescribed. So it is judged
    by the pair whose better side is worst. An open contact has no measure of its own: what is left
    is its body's.

    Args:
        pairs: Bodies that it presses on each other, (n_pairs, 2).
        left: Residual where it touches each, (n_bodies,) (force).
        push: Its force on what is free there, (n_bodies,) (force).
        floor: What round-off excuses there, (n_bodies,) (force).
        round_off: All of it, (n_bodies,) (force).
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(push > 0, left / push, np.inf)
    one, other = pairs.T
    better = np.where(relative[one] <= relative[other], one, other)
    better = better[push[better] > 0]
    if not better.size:
        return 0.0, 0.0, _LEAST, 0.0
    body = better[np.argmax(relative[better])]
    return left[body], push[body], max(floor[body], _LEAST), round_off[body]


def by_body(comm: MPI.Comm, vectors: Sequence[Array], label: Labels, n_bodies: int) -> Array:
    """Norms of vectors over this rank's unknowns, (n_vectors, n_bodies). Collective.

    Args:
        comm: The ranks.
        vectors: (n_local,) each.
        label: Body of every unknown, (n_local,).
        n_bodies: Their number.
    """
    return _norms(comm, [(v, label) for v in vectors], n_bodies)


def _root(values: Array) -> float:
    """Root of the sum of squares, without overflow."""
    largest = float(np.max(values, initial=0.0))
    if not (largest > 0 and np.isfinite(largest)):
        return largest
    return largest * float(np.sqrt(np.sum((values / largest) ** 2)))


def _norms(comm: MPI.Comm, rows: Sequence[tuple[Array, Labels]], n: int) -> Array:
    """Norms of vectors by the label of each entry, (n_vectors, n). Collective.

    Squares neither overflow nor vanish. A vector with an entry that is not finite has no norm that
    is trusted: NaN for all labels.
    """
    largest = np.array([np.abs(values).max(initial=0.0) for values, _ in rows])
    largest[np.isnan(largest)] = np.inf  # the maximum of MPI has no rule for NaN
    comm.Allreduce(MPI.IN_PLACE, largest, op=MPI.MAX)
    size = np.where((largest > 0.0) & np.isfinite(largest), largest, 1.0)
    squares = np.zeros((len(rows), n))
    with np.errstate(all="ignore"):
        for found, (values, label), unit in zip(squares, rows, size, strict=True):
            found[:] = np.bincount(label, (values / unit) ** 2, minlength=n)
        norms = size[:, None] * np.sqrt(global_sum(comm, squares))
    return np.where(np.isfinite(largest)[:, None], norms, np.nan)
