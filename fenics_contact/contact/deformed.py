"""Gap and normal of a rigid obstacle with small displacements, evaluated at deformed positions."""

from __future__ import annotations

import numpy as np
import ufl
from dolfinx import fem

from fenics_contact.obstacles.base import Placement
from fenics_contact.surface.fields import PointFields
from fenics_contact.surface.surface import PointEvaluator, SurfaceQuadrature
from fenics_contact.tolerances import FLAT
from fenics_contact.types import Array

__all__ = ["DeformedPlacement", "VaryingMotion"]

# Deviation of the gap's derivative along the normal from -1 above which it is not a distance.
_SLOPE_TOLERANCE = 0.5


class DeformedPlacement:
    """Gap and normal of a rigid obstacle at X + u instead of X; compiled at the first call.

    The placement is a function of X that has the obstacle's displacement at X + u.
    """

    def __init__(
        self, quadrature: SurfaceQuadrature, displacement: fem.Function, placement: Placement
    ) -> None:
        self._quadrature, self._displacement, self._placement = quadrature, displacement, placement
        self._evaluate: PointEvaluator | None = None

    def __call__(self) -> tuple[Array, Array]:
        """Return gap and normal as in `ContactKinematics.true_placement`. Collective."""
        if self._evaluate is None:
            x = ufl.SpatialCoordinate(self._quadrature.surface.mesh)
            displaced = ufl.variable(x + self._displacement)
            gap, direction = (
                ufl.replace(e, {x: displaced})
                for e in (self._placement.gap, self._placement.direction)
            )
            normal = direction / ufl.sqrt(ufl.dot(direction, direction))
            slope = ufl.dot(ufl.diff(gap, displaced), normal)
            self._evaluate = PointEvaluator(
                self._quadrature, {"gap": gap, "normal": normal, "slope": slope}
            )
        samples = self._evaluate()
        is_distance = np.abs(samples["slope"] + 1) < _SLOPE_TOLERANCE
        return np.where(is_distance, samples["gap"], np.inf), samples["normal"]


class VaryingMotion:
    """A prescribed displacement w of an obstacle that varies along Γc.

    A tangent t becomes t + ∇w t, and to first order the normal is along n - ∇wᵀ n, with the surface
    gradient ∇w. The constructor is collective. `displacement` is w + ∇w u (UFL).
    """

    def __init__(self, quadrature: SurfaceQuadrature) -> None:
        self._rows = quadrature.point_rows
        d = quadrature.surface.mesh.geometry.dim
        self._fields = PointFields(quadrature, {"displacement": d})
        self.displacement = self._fields.ufl("displacement")
        self._gradient: Array = np.zeros((quadrature.n_points, d, d))

    def update(self, x: Array, shift: Array, normal: Array, displacement: Array) -> None:
        """Evaluate w at the deformed positions, from shift w and normal at the points. Collective.

        ∇w is the gradient of the linear least-squares fit of w at the points of each facet.
        """
        offset, change = (v[self._rows] - v[self._rows].mean(axis=1)[:, None] for v in (x, shift))
        mean_normal = normal[self._rows].mean(axis=1)
        offset -= np.einsum("fqi,fi,fj->fqj", offset, mean_normal, mean_normal)
        gradients = (np.linalg.pinv(offset, rcond=FLAT) @ change).swapaxes(1, 2)
        self._gradient[self._rows] = gradients[:, None]
        displaced_shift = shift + np.einsum("qij,qj->qi", self._gradient, displacement)
        self._fields.assign({"displacement": displaced_shift})

    def rotate(self, gap: Array, normal: Array) -> tuple[Array, Array]:
        """Return distance and normal of the displaced obstacle, from those before the rotation."""
        rotated = normal - np.einsum("qij,qi->qj", self._gradient, normal)
        length = np.linalg.norm(rotated, axis=1)
        return gap / length, rotated / length[:, None]
