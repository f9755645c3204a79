"""Where the obstacle of a contact is, geometry from where the body has moved to."""

from __future__ import annotations

import numpy as np
import ufl
from dolfinx import fem

from fenics_contact.obstacles.base import Placement
from fenics_contact.surface.fields import PointFields
from fenics_contact.surface.surface import PointEvaluator, SurfaceQuadrature
from fenics_contact.tolerances import FLAT
from fenics_contact.types import Array

__all__ = ["DeformedPlaces", "VaryingMotion"]


# Deviation of a gap's slope along the normal from -1 with which it is no distance.
_NO_DISTANCE = 0.5


class DeformedPlaces:
    """Gap and normal of a rigid obstacle at X + u instead of X; compiled when first called.

    Args:
        displacement: u at the points.
        placement: Of the obstacle, geometry from X, but displaced as it is where X has moved to.
    """

    def __init__(
        self, quadrature: SurfaceQuadrature, displacement: fem.Function, placement: Placement
    ) -> None:
        self._quadrature, self._displacement, self._placement = quadrature, displacement, placement
        self._evaluate: PointEvaluator | None = None

    def __call__(self) -> tuple[Array, Array]:
        """See `ContactKinematics.true_placement`. Collective."""
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


class VaryingMotion:
    """A prescribed displacement w of an obstacle that varies along Γc.

    It turns and stretches the surface of the obstacle: a tangent t becomes t + ∇w t, so that the
    normal is along n - ∇wᵀ n, to first order, with the derivatives of w along the surface. The
    constructor is collective.

    Attributes:
        moved: w where the points have moved to, w + ∇w u (UFL), as of the last `update`.
    """

    def __init__(self, quadrature: SurfaceQuadrature) -> None:
        self._rows = quadrature.point_rows
        d = quadrature.surface.mesh.geometry.dim
        self._fields = PointFields(quadrature, {"moved": d})
        self.moved = self._fields.ufl("moved")
        self._slope: Array = np.zeros((quadrature.n_points, d, d))

    def update(self, x: Array, shift: Array, normal: Array, displacement: Array) -> None:
        """Take w at the points, and u. Collective.

        The derivatives are of the linear function of the place that is nearest to w at the points
        of each facet; one point alone tells none.

        Args:
            x: Places of the points, (n_points, gdim) (length).
            shift: w there, likewise.
            normal: Of the obstacle before it is displaced, (n_points, gdim).
            displacement: u there, (n_points, gdim) (length).
        """
        away, change = (v[self._rows] - v[self._rows].mean(axis=1)[:, None] for v in (x, shift))
        mean = normal[self._rows].mean(axis=1)
        away -= np.einsum("fqi,fi,fj->fqj", away, mean, mean)
        by_facet = (np.linalg.pinv(away, rcond=FLAT) @ change).swapaxes(1, 2)
        self._slope[self._rows] = by_facet[:, None]
        moved = shift + np.einsum("qij,qj->qi", self._slope, displacement)
        self._fields.assign({"moved": moved})

    def turn(self, gap: Array, normal: Array) -> tuple[Array, Array]:
        """Distance and normal of the displaced obstacle, from those before the rotation by w."""
        turned = normal - np.einsum("qij,qi->qj", self._slope, normal)
        length = np.linalg.norm(turned, axis=1)
        return gap / length, turned / length[:, None]
