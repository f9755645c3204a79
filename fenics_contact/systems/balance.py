"""Force balance of every body, free obstacle and contact, relative to its own forces.

A body under a load of 1e-4 is thus solved as accurately as its neighbour under a load of 10. The
tolerance is never below the round-off of the internal forces and of forces that were unloaded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from fenics_contact.systems.partition import Partition, norms_by_part
from fenics_contact.systems.reference_scales import ReferenceScales
from fenics_contact.tolerances import EVALUATION_ROUND_OFF, MIN_FORCE, ROUND_OFF
from fenics_contact.types import Array, Index, Mask

__all__ = ["MAX_ROUND_OFF_RESIDUAL_RATIO", "InitialForces", "Norms", "Parts"]

# Largest displacement whose round-off is allowed, relative to the size of the body or to its
# displacement at the start: a diverging rigid motion must not widen the tolerance.
_MAX_DISPLACEMENT_RATIO = 1e3
# Largest round-off tolerance relative to the load or, without constraints, to the contact forces.
MAX_ROUND_OFF_RESIDUAL_RATIO = 1e-5


@dataclass(frozen=True)
class InitialForces:
    """Forces at the start of an increment, whose round-off may remain at its end.

    Attributes:
        terms: Magnitudes of the terms of K u, as norms, (n_bodies,) (force).
        contact: Norms of the committed contact forces, (n_contacts, n_bodies) (force).
    """

    terms: Array
    contact: Array


@dataclass(frozen=True)
class Norms:
    """Norms of one state by part: bodies, free obstacles, then contacts; equal on every rank.

    Attributes:
        residual: Norm over the free unknowns, (n_parts,) (force).
        force: Largest of the norms of load, reactions and contact forces, (n_parts,) (force).
        floor: Smallest tolerance, from round-off, (n_parts,) (force).
        round_off: Round-off of the internal forces of loaded parts, 0 for others, not limited by
            `MAX_ROUND_OFF_RESIDUAL_RATIO`, (n_parts,) (force).
        n_bodies: Number of bodies and free obstacles, which partition the unknowns.
    """

    residual: Array
    force: Array
    floor: Array
    round_off: Array
    n_bodies: int

    def tolerance(self, rtol: float) -> Array:
        """Return the tolerances of the residual, (n_parts,) (force)."""
        return np.maximum(rtol * self.force, self.floor)

    def excess(self, rtol: float) -> Array:
        """Return residual over tolerance, (n_parts,); infinite where a norm is not finite."""
        tolerance = self.tolerance(rtol)
        with np.errstate(all="ignore"):
            ratio = np.where(self.residual == 0.0, 0.0, self.residual / tolerance)
        finite = np.isfinite(self.residual) & np.isfinite(self.force) & np.isfinite(self.floor)
        return np.where(finite & ~np.isnan(ratio), ratio, np.inf)

    def is_within(self, rtol: float) -> bool:
        """Return whether the residual of every part is within its tolerance."""
        return bool(np.all(self.excess(rtol) <= 1.0))

    @property
    def is_round_off(self) -> Mask:
        """Mask of the bodies whose residual is round-off only, (n_bodies,)."""
        return np.asarray(self.residual <= self.floor)[: self.n_bodies]

    def exclude(self, bodies: Mask) -> Norms:
        """Return a copy with zero residuals of the bodies in a mask, (n_bodies,)."""
        residual = self.residual.copy()
        residual[: self.n_bodies][bodies] = 0.0
        return replace(self, residual=residual)

    @property
    def total(self) -> float:
        """Norm of the residual of all unknowns (force), a measure of progress only."""
        return _root_sum_square(self.residual[: self.n_bodies])


@dataclass(frozen=True)
class Parts:
    """The partition of the unknowns into bodies and free obstacles, and the dofs of the contacts.

    Attributes:
        comm: MPI communicator.
        partition: Bodies and free obstacles of this rank's unknowns.
        constrained: Mask of the unknowns with Dirichlet conditions, (n_local,).
        bodies: Names of bodies, then of free obstacles.
        contacts: Names of the contacts.
        coupled: Unknowns of this rank that each contact couples.
        pairs: Bodies and obstacles in contact with each other, for every contact, (n_pairs, 2); a
            body on a rigid obstacle is paired with itself.
        scales: Reference scales of the bodies.
        motions: Contact number of every free obstacle.
    """

    comm: MPI.Comm
    partition: Partition
    constrained: Mask
    bodies: Sequence[str]
    contacts: Sequence[str]
    coupled: Sequence[npt.NDArray[np.int32]]
    pairs: Sequence[Index]
    scales: ReferenceScales
    motions: Sequence[int]

    @property
    def names(self) -> list[str]:
        """Names of bodies, free obstacles and contacts."""
        return [*self.bodies, *self.contacts]

    @cached_property
    def _reactions(self) -> tuple[Index, Partition]:
        """Numbers of the unknowns with reactions, and their partition."""
        constrained = np.flatnonzero(self.constrained)
        return constrained, self.partition.restrict(constrained)

    @cached_property
    def _contact_dofs(self) -> tuple[Index, Partition]:
        """Numbers of the unknowns on which any contact acts, and their partition."""
        coupled = np.unique(np.concatenate([np.zeros(0, dtype=np.intp), *self.coupled]))
        return coupled, self.partition.restrict(coupled)

    @cached_property
    def _partitions(self) -> list[Partition]:
        """Partition of the unknowns that each contact couples."""
        return [self.partition.restrict(coupled) for coupled in self.coupled]

    def norms(
        self,
        residual: Array,
        contacts: Sequence[Array],
        load: Array,
        product: Array,
        outside: Array,
        start: InitialForces,
    ) -> Norms:
        """Evaluate the norms of residual and forces at one state. Collective.

        Args:
            residual: Residual including reactions, (n_local,).
            contacts: Contribution of every contact to it, (n_local,).
            load: External forces, (n_local,).
            product: Magnitude of the terms of K u, (n_local,).
            outside: Norms of load and product at unknowns outside of the system, (2, n_bodies).
            start: Forces at the start of the increment.
        """
        n, free, (constrained, reactions_on) = len(self.bodies), residual.copy(), self._reactions
        free[constrained] = 0.0
        any_contact, total_on = self._contact_dofs
        total = sum((force[any_contact] for force in contacts), np.zeros(any_contact.size))
        rows = [(free, self.partition), (residual[constrained], reactions_on), (total, total_on)]
        rows += [(load, self.partition), (product, self.partition)]
        for force, coupled, own in zip(contacts, self.coupled, self._partitions, strict=True):
            nodal = np.where(self.constrained[coupled], 0.0, force[coupled])
            rows += [(free[coupled], own), (nodal, own)]
        norms = norms_by_part(self.comm, n, rows)
        residuals, reactions, resultants, loads, terms = norms[:5]
        loads, terms = np.hypot(loads, outside[0]), np.hypot(terms, outside[1])
        local_residual, local_force = norms[5::2], norms[6::2]
        for body, number in zip(range(n - len(self.motions), n), self.motions, strict=True):
            # The resultant on a free obstacle may cancel; its contributions do not.
            resultants[body] = _root_sum_square(local_force[number])
        force = np.max([loads, reactions, resultants], axis=0)
        # The round-off of an unconstrained displacement may grow without bound.
        fixed = self.scales.constrained
        of_bodies = np.append(self.scales.force, np.full(len(self.motions), np.inf))
        bound = _MAX_DISPLACEMENT_RATIO * np.maximum(of_bodies, start.terms)
        terms = np.maximum(terms, start.terms)
        terms = np.where(fixed, terms, np.minimum(terms, bound))
        # A load at a zero of a sine is round-off.
        least = np.append(self.scales.min_force, np.zeros(len(self.motions)))
        loaded = loads > np.where(fixed, EVALUATION_ROUND_OFF * least, 0.0)
        round_off = np.maximum(EVALUATION_ROUND_OFF * terms, MIN_FORCE)
        untouched = self._of_untouched_groups(EVALUATION_ROUND_OFF * least, loaded, local_force)
        round_off = np.where(fixed, round_off, np.maximum(round_off, untouched))
        # The softer body limits the accuracy of a contact force.
        limits = np.tile(round_off, (len(contacts), 1))
        for row, pairs in zip(limits, self.pairs, strict=True):
            for first, second in (pairs.T, pairs.T[::-1]):
                np.minimum.at(row, first, round_off[second])
        active = local_force > np.maximum(limits, ROUND_OFF * force)
        limited = loaded | (active.any(axis=0) & ~fixed)
        # Unloaded contact forces leave their round-off.
        unloaded = EVALUATION_ROUND_OFF * np.maximum(start.contact - local_force, 0.0).max(
            axis=0, initial=0.0
        )
        cap, local_cap = (
            np.maximum(MAX_ROUND_OFF_RESIDUAL_RATIO * norm, unloaded)
            for norm in (force, local_force)
        )
        floor = np.where(limited, np.minimum(round_off, cap), round_off)
        floor = np.maximum(floor, MIN_FORCE)
        local_floor = np.where(active, np.minimum(round_off, local_cap), round_off)
        uncapped = np.where(
            active & (unloaded <= MAX_ROUND_OFF_RESIDUAL_RATIO * local_force), round_off, 0.0
        )
        governing = [
            _measure_contact(pairs, *rows)
            for pairs, *rows in zip(
                self.pairs, local_residual, local_force, local_floor, uncapped, strict=True
            )
        ]
        of_contacts = np.reshape(governing, (len(contacts), 4)).T
        significant = (loaded | active.any(axis=0)) & (
            unloaded <= MAX_ROUND_OFF_RESIDUAL_RATIO * force
        )
        of_bodies = np.array([residuals, force, floor, np.where(significant, round_off, 0.0)])
        residual, force, floor, round_off = np.concatenate([of_bodies, of_contacts], axis=1)
        return Norms(residual, force, floor, round_off, n)

    def _of_untouched_groups(self, negligible: Array, loaded: Mask, contacts: Array) -> Array:
        """Return the round-off of positions as a force where there is no other force, (n_bodies,).

        Bodies without load may touch by the round-off of their positions only. It is a force on the
        softest body of a group, and 0 for a group with a load or with larger contact forces.

        Args:
            negligible: Round-off of positions times stiffness, (n_bodies,) (force).
            loaded: Mask of the loaded bodies, (n_bodies,).
            contacts: Contact forces, (n_contacts, n_bodies) (force).
        """
        group, softest = self.scales.group, np.full(self.scales.n_groups, np.inf)
        np.minimum.at(softest, group[: self.scales.n_bodies], negligible[: self.scales.n_bodies])
        force = np.where(loaded, np.inf, contacts.max(axis=0, initial=0.0))
        largest: Array = np.zeros(self.scales.n_groups)
        np.maximum.at(largest, group, force)
        return np.asarray(np.where(largest <= softest, softest, 0.0)[group])


def _measure_contact(
    pairs: Index, residual: Array, force: Array, floor: Array, round_off: Array
) -> tuple[float, float, float, float]:
    """Return the four norms in `Norms` that are attributed to a contact.

    A contact force is known if one of its two bodies is free and in balance. The contact is
    measured at the pair whose better balanced body has the largest relative residual. An open
    contact has no norms of its own: its residual belongs to the body.

    Args:
        pairs: Bodies in contact with each other, (n_pairs, 2).
        residual: Residual at the dofs of the contact by body, (n_bodies,) (force).
        force: Contact force on the free dofs of each body, (n_bodies,) (force).
        floor: Smallest tolerance there, (n_bodies,) (force).
        round_off: Round-off of the internal forces there, (n_bodies,) (force).
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(force > 0, residual / force, np.inf)
    first, second = pairs.T
    balanced = np.where(relative[first] <= relative[second], first, second)
    balanced = balanced[force[balanced] > 0]
    if not balanced.size:
        return 0.0, 0.0, MIN_FORCE, 0.0
    body = balanced[np.argmax(relative[balanced])]
    return residual[body], force[body], max(floor[body], MIN_FORCE), round_off[body]


def _root_sum_square(values: Array) -> float:
    """Return the root of the sum of squares without overflow."""
    largest = float(np.max(values, initial=0.0))
    if not (largest > 0 and np.isfinite(largest)):
        return largest
    return largest * float(np.sqrt(np.sum((values / largest) ** 2)))
