"""Gap and direction of a `SampledObstacle` in UFL, by a second-order expansion."""

from __future__ import annotations

from typing import Any

import numpy as np
import ufl

from fenics_contact.obstacles.base import MAX_COORDINATE, Placement, SampledObstacle
from fenics_contact.parallel import collective_errors
from fenics_contact.surface.fields import PointFields
from fenics_contact.surface.surface import PointEvaluator, SurfaceQuadrature
from fenics_contact.types import Array

__all__ = ["SampledPlacement"]


class SampledPlacement:
    """Second-order expansion of an obstacle's distance about the positions sampled last (UFL).

    Gap, normal and their first derivatives are exact there, so that a solution with the expansion
    is one for the obstacle itself, provided that `update` is called after every change of the
    position, a UFL vector in the frame of the obstacle (length). The constructor is collective.
    """

    def __init__(
        self, quadrature: SurfaceQuadrature, obstacle: SampledObstacle, position: Any
    ) -> None:
        d = obstacle.gdim
        self._obstacle, self._comm = obstacle, quadrature.surface.mesh.comm
        self._evaluate = PointEvaluator(quadrature, {"position": position})
        sizes = {"position": d, "distance": 0, "normal": d} | {
            f"curvature {i}": d for i in range(d)
        }
        self._fields = PointFields(quadrature, sizes)
        self._sampled_at: Array = np.full((quadrature.n_points, d), np.nan)

    def update(self) -> None:
        """Sample at the present positions of the points. Collective.

        Raises:
            ValueError: The samples are invalid; raised on all ranks, as are errors of the obstacle.
        """
        position = self._evaluate()["position"]
        # Diverged iterates are not sampled.
        position[~(np.abs(position).max(axis=1, initial=0.0) < MAX_COORDINATE)] = np.nan
        changed = np.any(position != self._sampled_at, axis=1) & np.isfinite(position[:, 0])
        fields, d = {n: self._fields.values(n) for n in self._fields.names}, self._obstacle.gdim
        with collective_errors(self._comm):
            if changed.any():
                sample = self._obstacle.sample_checked(position[changed])
                fields["distance"][changed] = sample.distance
                fields["normal"][changed] = sample.normal
                for i in range(d):
                    fields[f"curvature {i}"][changed] = sample.curvature[:, i]
        self._fields.assign(fields | {"position": position})
        self._sampled_at = position

    def values(self, name: str) -> Array:
        """Return a copy of the samples by name, "distance" or "normal" in the obstacle's frame."""
        return self._fields.values(name)

    def at(self, position: Any) -> Placement:
        """Return gap and direction at a position near the sampled one (UFL)."""
        field = self._fields.ufl
        offset = position - field("position")
        change = ufl.as_vector(
            [ufl.dot(field(f"curvature {i}"), offset) for i in range(self._obstacle.gdim)]
        )
        gap = field("distance") - ufl.dot(field("normal"), offset) + ufl.dot(offset, change) / 2
        return Placement(gap, field("normal") - change)
