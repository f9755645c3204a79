"""Anderson acceleration of the augmentations, jointly for all contacts of coupled bodies.

An augmentation (Uzawa iteration) is a fixed-point iteration λ ← G(λ) with the residual G(λ) - λ.
The accelerated update combines the last G(λ) with coefficients of sum 1 that minimise the combined
residual (doi:10.1137/10078356X). Multipliers of one contact change the tractions of another, so all
contacts of coupled bodies share the coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from mpi4py import MPI

from fenics_contact.contact.contact import Contact
from fenics_contact.parallel import global_sum
from fenics_contact.systems.reference_scales import ReferenceScales
from fenics_contact.tolerances import NEGLIGIBLE, ROUND_OFF
from fenics_contact.types import Array

__all__ = ["Acceleration"]

_DEPTH = 6  # number of earlier augmentations combined with the last one


class Acceleration:
    """Accelerated augmentations of the contacts of a problem in one increment.

    Args:
        contacts: All contacts of the problem.
        scales: Reference scales of the bodies.
    """

    def __init__(self, contacts: Sequence[Contact], scales: ReferenceScales) -> None:
        numbered = [
            (n, c, c.multipliers) for n, c in enumerate(contacts) if c.multipliers is not None
        ]
        self._augmented = [(contact, multipliers) for _, contact, multipliers in numbered]
        self._group = np.concatenate([scales.group_of_points(number) for number, *_ in numbered])
        self._weights = np.concatenate([c.quadrature.weights for c, _ in self._augmented])
        self._ends = np.cumsum([c.quadrature.n_points for c, _ in self._augmented])[:-1]
        mesh = numbered[0][1].surface.mesh
        self._comm, self._n_columns = mesh.comm, 1 + mesh.geometry.dim
        # λ and G(λ) of the last augmentations, (2, n_points, n_columns) each, by group.
        self._sequences: list[list[Array]] = [[] for _ in range(scales.n_groups)]

    def augment(self) -> None:
        """Update the multipliers of evaluated contacts. Collective."""
        pairs = [multipliers.augmented(c.values) for c, multipliers in self._augmented]
        more = [self._n_columns - pair.shape[2] for pair in pairs]
        padded = [np.pad(p, ((0, 0), (0, 0), (0, n))) for p, n in zip(pairs, more, strict=True)]
        last = np.concatenate(padded, axis=1)
        # Residuals are relative to the tractions of their part of Γc, like the enforcement error.
        results = zip(self._augmented, pairs, strict=True)
        sizes = np.concatenate(
            [multipliers.largest_on_parts(pair[1]) for (_, multipliers), pair in results]
        )
        largest = np.zeros(len(self._sequences))
        np.maximum.at(largest, self._group, sizes)
        self._comm.Allreduce(MPI.IN_PLACE, largest, op=MPI.MAX)
        scale = np.maximum(sizes, NEGLIGIBLE * largest[self._group])
        weights = np.sqrt(self._weights) / np.where(scale > 0.0, scale, 1.0)
        next_multipliers = last[1].copy()
        for group, sequence in enumerate(self._sequences):
            in_group = self._group == group
            sequence.append(last[:, in_group])
            next_multipliers[in_group] = self._combine(sequence, weights[in_group, None])
        for (contact, multipliers), part in zip(
            self._augmented, np.split(next_multipliers, self._ends), strict=True
        ):
            multipliers.assign(part, contact.values)
            contact.states.forget()

    def _combine(self, sequence: list[Array], weights: Array) -> Array:
        """Combine the last augmentations of one group. Collective.

        The sequence restarts if the residual grows, as after changes of the active set; obsolete
        entries are deleted. The next multipliers are (n_points, n_columns) (stress).
        """
        del sequence[: -1 - _DEPTH]
        old, new = np.swapaxes(sequence, 0, 1)
        residuals = new - old
        scaled = weights * np.concatenate([np.diff(residuals, axis=0), residuals[-2:]])
        flat = scaled.reshape(len(scaled), -1)
        products = global_sum(self._comm, flat @ flat.T)
        if len(sequence) == 1 or products[-1, -1] > products[-2, -2]:
            del sequence[:-1]
            return np.asarray(new[-1])
        gram, rhs = products[:-2, :-2], products[:-2, -1]
        norms = np.sqrt(np.maximum(np.diag(gram), np.finfo(np.float64).tiny))
        gram = gram / np.outer(norms, norms)
        coefficients = np.linalg.lstsq(gram, rhs / norms, rcond=ROUND_OFF)[0] / norms
        return np.asarray(new[-1] - np.tensordot(coefficients, np.diff(new, axis=0), axes=1))
