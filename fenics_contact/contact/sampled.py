"""An obstacle that is known in numbers alone, as laws and forms see it: by its expansion (UFL)."""

from __future__ import annotations

from typing import Any

import numpy as np
import ufl

from fenics_contact.obstacles.base import NOWHERE, Placement, SampledObstacle
from fenics_contact.parallel import collective_errors
from fenics_contact.surface.fields import PointFields
from fenics_contact.surface.surface import PointEvaluator, SurfaceQuadrature
from fenics_contact.types import Array

__all__ = ["SampledPlaces"]


class SampledPlaces:
    """Distance and normal of an obstacle about the places where it was sampled last.

    The expansion is of second order, so that gap and normal are exact there, and their derivatives:
    what is solved with it is solved for the obstacle itself, as long as `update` is called where
    places have changed. The constructor is collective; `update` samples.

    Args:
        place: Where the points are, geometry from the obstacle, (gdim,) (UFL, length).
    """

    def __init__(
        self, quadrature: SurfaceQuadrature, obstacle: SampledObstacle, place: Any
    ) -> None:
        d = obstacle.gdim
        self._obstacle, self._comm = obstacle, quadrature.surface.mesh.comm
        self._evaluate = PointEvaluator(quadrature, {"place": place})
        sizes = {"place": d, "distance": 0, "normal": d} | {f"curvature {i}": d for i in range(d)}
        self._fields = PointFields(quadrature, sizes)
        self._at: Array = np.full((quadrature.n_points, d), np.nan)

    def update(self) -> None:
        """Sample where the points are now. Collective.

        Raises:
            ValueError: See `SampledObstacle.sample_checked`; on all ranks, as are its own errors.
        """
        place = self._evaluate()["place"]
        # A diverged iterate is nowhere.
        place[~(np.abs(place).max(axis=1, initial=0.0) < NOWHERE)] = np.nan
        changed = np.any(place != self._at, axis=1) & np.isfinite(place[:, 0])
        fields, d = {n: self._fields.values(n) for n in self._fields.names}, self._obstacle.gdim
        with collective_errors(self._comm):
            if changed.any():
                sample = self._obstacle.sample_checked(place[changed])
                fields["distance"][changed] = sample.distance
                fields["normal"][changed] = sample.normal
                for i in range(d):
                    fields[f"curvature {i}"][changed] = sample.curvature[:, i]
        self._fields.assign(fields | {"place": place})
        self._at = place

    def values(self, name: str) -> Array:
        """What was sampled last, "distance" or "normal", as the obstacle has it; a copy."""
        return self._fields.values(name)

    def at(self, place: Any) -> Placement:
        """Gap and direction at a place near those sampled (UFL)."""
        field = self._fields.ufl
        away = place - field("place")
        bend = ufl.as_vector(
            [ufl.dot(field(f"curvature {i}"), away) for i in range(self._obstacle.gdim)]
        )
        gap = field("distance") - ufl.dot(field("normal"), away) + ufl.dot(away, bend) / 2
        return Placement(gap, field("normal") - bend)
