"""Where the support of a contact is, seen from where the body has moved to."""

from __future__ import annotations

import numpy as np
import ufl
from dolfinx import fem

from fenics_contact.supports.base import Placement
from fenics_contact.surface.surface import PointEvaluator, SurfaceQuadrature
from fenics_contact.types import Array

__all__ = ["DeformedPlaces"]


# Deviation of a gap's slope along the normal from -1 with which it is no distance.
_NO_DISTANCE = 0.5


class DeformedPlaces:
    """Gap and normal of a rigid support at X + u instead of X; compiled when first called."""

    def __init__(
        self, quadrature: SurfaceQuadrature, displacement: fem.Function, placement: Placement
    ) -> None:
        """Bind.

        Args:
            quadrature: The points.
            displacement: u at the points.
            placement: Of the support, seen from X.
        """
        self._quadrature, self._displacement, self._placement = quadrature, displacement, placement
        self._evaluate: PointEvaluator | None = None

    def __call__(self) -> tuple[Array, Array]:
        """See `Opposite.true_placement`. Collective."""
        if self._evaluate is None:
            x = ufl.SpatialCoordinate(self._quadrature.surface.mesh)
            moved = ufl.variable(x + self._displacement)
            gap, direction = (
                ufl.replace(e, {x: moved}) for e in (self._placement.gap, self._placement.direction)
            )
            normal = direction / ufl.sqrt(ufl.dot(direction, direction))
            slope = ufl.dot(ufl.diff(gap, moved), normal)
            self._evaluate = PointEvaluator(
                self._quadrature, {"gap": gap, "normal": normal, "slope": slope}
            )
        found = self._evaluate()
        # A distance falls along the normal as fast as one moves.
        told = np.abs(found["slope"] + 1) < _NO_DISTANCE
        return np.where(told, found["gap"], np.inf), found["normal"]
