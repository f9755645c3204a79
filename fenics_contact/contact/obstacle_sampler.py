"""Distance and normal of a rigid obstacle at any place, in numbers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from dolfinx import fem
from ufl.algorithms import extract_coefficients
from ufl.algorithms.analysis import extract_constants

from fenics_contact.obstacles.base import Placement, SampledObstacle
from fenics_contact.parallel import collective_errors
from fenics_contact.surface.surface import PointEvaluator, SurfaceQuadrature
from fenics_contact.types import Array

__all__ = ["ObstacleSampler"]


class ObstacleSampler:
    """Evaluates a rigid obstacle at places in its own frame; compiled at the first evaluation."""

    def __init__(
        self,
        quadrature: SurfaceQuadrature,
        obstacle: Callable[[Any], Placement] | SampledObstacle,
    ) -> None:
        """Bind the obstacle.

        Args:
            quadrature: The points of Γc, whose function space the compiled form uses.
            obstacle: Gap and direction at a place in the obstacle's frame (UFL), or the obstacle
                itself where it is known in numbers.
        """
        self._quadrature, self._obstacle = quadrature, obstacle
        self._comm = quadrature.surface.mesh.comm
        self._place: fem.Function | None = None
        self._data: list[Any] | None = []
        self._evaluate: PointEvaluator | None = None

    def data(self) -> Array | None:
        """What the obstacle's shape depends on as it is now; None where it varies in space.

        Known once it has been sampled: numbers, (n,).
        """
        if self._data is None:
            return None
        return np.concatenate([np.zeros(0), *(np.ravel(c.value) for c in self._data)])

    def sample(self, place: Array) -> tuple[Array, Array]:
        """Signed distances, and unit normals from body to obstacle. Collective.

        Args:
            place: In the obstacle's frame, (n, gdim) (length); n may differ from rank to rank.

        Returns:
            (n,) (length) and (n, gdim).
        """
        if isinstance(self._obstacle, SampledObstacle):
            with collective_errors(self._comm):
                found = self._obstacle.sample_checked(place)
            return found.distance, found.normal
        n, d = place.shape
        if self._place is None or self._evaluate is None:
            self._place = fem.Function(self._quadrature.space(d), name="place")
            placement = self._obstacle(self._place)
            parts = placement.gap, placement.normal
            fields = {f for part in parts for f in extract_coefficients(part)} - {self._place}
            constants = {c for part in parts for c in extract_constants(part)}
            self._data = None if fields else sorted(constants, key=lambda c: c.count())
            self._evaluate = PointEvaluator(
                self._quadrature, {"gap": placement.gap, "normal": placement.normal}
            )
        # The form has as many slots as Γc has points: the places go through it in batches.
        size = max(self._quadrature.n_points, 1)
        batches = max(self._comm.allgather(-(-n // size) if self._quadrature.n_points else 0))
        distance, normal = np.zeros(n), np.zeros((n, d))
        for k in range(batches):
            some = place[k * size : (k + 1) * size]
            self._place.x.array[: some.size] = some.ravel()
            self._place.x.scatter_forward()
            values = self._evaluate()
            distance[k * size : (k + 1) * size] = values["gap"][: len(some)]
            normal[k * size : (k + 1) * size] = values["normal"][: len(some)]
        return distance, normal
