"""Augmentations with Anderson acceleration, of all contacts of coupled bodies at once.

An augmentation is a fixed-point iteration for the multipliers, whose residual is what it changes.
The next multipliers are the combination of the last results, with coefficients that add up to 1,
for which the combination of their residuals is least (doi:10.1137/10078356X). The multipliers of
one contact change what another bears, in a corner as much as what it bears itself: all contacts of
bodies that may touch have the same coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from mpi4py import MPI

from fenics_contact.contact.contact import Contact
from fenics_contact.parallel import global_sum
from fenics_contact.systems.reference_scales import ReferenceScales
from fenics_contact.tolerances import NEGLIGIBLE
from fenics_contact.types import Array

__all__ = ["Acceleration"]

# How many augmentations before the last are combined with it, and how well their residuals are to
# be told apart, relative and squared.
_DEPTH, _DISTINCT = 6, 1e-12


class Acceleration:
    """Augments the contacts of a problem in one increment.

    Args:
        contacts: All contacts of the problem.
        scales: Of their bodies.
    """

    def __init__(self, contacts: Sequence[Contact], scales: ReferenceScales) -> None:
        found = [(n, c, c.multipliers) for n, c in enumerate(contacts) if c.multipliers is not None]
        self._augmented = [(contact, multipliers) for _, contact, multipliers in found]
        self._group = np.concatenate([scales.group_of_points(number) for number, *_ in found])
        self._weights = np.concatenate([c.quadrature.weights for c, _ in self._augmented])
        self._ends = np.cumsum([c.quadrature.n_points for c, _ in self._augmented])[:-1]
        mesh = found[0][1].surface.mesh
        self._comm, self._n_columns = mesh.comm, 1 + mesh.geometry.dim
        # By group what the last augmentations were given and made, (2, n_points, n_columns) each.
        self._rounds: list[list[Array]] = [[] for _ in range(scales.n_groups)]

    def augment(self) -> None:
        """Change the multipliers of evaluated contacts. Collective."""
        pairs = [multipliers.augmented(c.values) for c, multipliers in self._augmented]
        more = [self._n_columns - pair.shape[2] for pair in pairs]
        padded = [np.pad(p, ((0, 0), (0, 0), (0, n))) for p, n in zip(pairs, more, strict=True)]
        last = np.concatenate(padded, axis=1)
        # Each part of Γc by its own tractions, as the error is measured: round-off apart.
        made = zip(self._augmented, pairs, strict=True)
        sizes = np.concatenate([multipliers.sizes(pair[1]) for (_, multipliers), pair in made])
        largest = np.zeros(len(self._rounds))
        np.maximum.at(largest, self._group, sizes)
        self._comm.Allreduce(MPI.IN_PLACE, largest, op=MPI.MAX)
        scale = np.maximum(sizes, NEGLIGIBLE * largest[self._group])
        weights = np.sqrt(self._weights) / np.where(scale > 0.0, scale, 1.0)
        rows = last[1].copy()
        for group, rounds in enumerate(self._rounds):
            mine = self._group == group
            rounds.append(last[:, mine])
            rows[mine] = self._combined(rounds, weights[mine, None])
        for (contact, multipliers), each in zip(
            self._augmented, np.split(rows, self._ends), strict=True
        ):
            multipliers.take(each, contact.values)
            contact.states.forget()

    def _combined(self, rounds: list[Array], weights: Array) -> Array:
        """Combine the last augmentations of one group. Collective.

        A residual that is larger than the one before, as where points have changed their status,
        begins a new sequence.

        Args:
            rounds: What they were given and made, (2, n_points, n_columns) (stress) each; those
                that are of no more use are dropped.
            weights: Of the residuals, (n_points, 1).

        Returns:
            The next multipliers, (n_points, n_columns) (stress).
        """
        del rounds[: -1 - _DEPTH]
        given, made = np.swapaxes(rounds, 0, 1)
        residuals = made - given
        scaled = weights * np.concatenate([np.diff(residuals, axis=0), residuals[-2:]])
        flat = scaled.reshape(len(scaled), -1)
        products = global_sum(self._comm, flat @ flat.T)
        if len(rounds) == 1 or products[-1, -1] > products[-2, -2]:
            del rounds[:-1]
            return np.asarray(made[-1])
        gram, right = products[:-2, :-2], products[:-2, -1]
        length = np.sqrt(np.maximum(np.diag(gram), np.finfo(np.float64).tiny))
        gram = gram / np.outer(length, length)
        share = np.linalg.lstsq(gram, right / length, rcond=_DISTINCT)[0] / length
        return np.asarray(made[-1] - np.tensordot(share, np.diff(made, axis=0), axes=1))
