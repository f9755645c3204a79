"""Distance and normal of a rigid obstacle at any position."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from ufl.algorithms.analysis import extract_constants

from fenics_contact.obstacles.base import Placement, Sample, SampledObstacle
from fenics_contact.parallel import collective_errors
from fenics_contact.surface.surface import PointEvaluator, SurfaceQuadrature
from fenics_contact.types import Array

__all__ = ["ObstacleSampler"]

# Step of difference quotients, relative to the distance; at edges the slope is half of it.
_STEP_RATIO = 0.05
# Smallest step relative to the coordinates, whose round-off is 1e-5 of it.
_MIN_STEP_RATIO = 1e-11


class ObstacleSampler:
    """Evaluates a rigid obstacle at positions in its own frame; compiled at the first evaluation.

    The shape of the obstacle depends on the constants in its distance, which may change between
    increments; between committed and present shape they are interpolated linearly.

    Args:
        quadrature: The points of Γc, whose function space the compiled form uses.
        obstacle: Gap and direction at a position in its frame (UFL), or a `SampledObstacle`.
    """

    def __init__(
        self,
        quadrature: SurfaceQuadrature,
        obstacle: Callable[[Any], Placement] | SampledObstacle,
    ) -> None:
        self._quadrature, self._obstacle = quadrature, obstacle
        self._comm = quadrature.surface.mesh.comm
        self._constants: list[Any] = []
        self._committed_constants: list[Any] = []
        self._evaluator: PointEvaluator | None = None
        if isinstance(obstacle, SampledObstacle):
            return
        mesh = quadrature.surface.mesh
        self._position = fem.Function(quadrature.space(mesh.geometry.dim), name="place")
        self._time = fem.Function(quadrature.space(1), name="time")
        position = ufl.variable(self._position)
        placement = obstacle(position)
        fields = {"gap": placement.gap, "normal": placement.normal}
        fields["gradient"] = ufl.diff(placement.gap, position)
        constants = {c for part in fields.values() for c in extract_constants(part)}
        self._constants = sorted(constants, key=lambda c: c.count())
        self._committed_constants = [fem.Constant(mesh, c.value.copy()) for c in self._constants]
        pairs = zip(self._constants, self._committed_constants, strict=True)
        time = self._time[0]
        interpolated = {c: (1 - time) * committed + time * c for c, committed in pairs}
        self._expressions = {name: ufl.replace(part, interpolated) for name, part in fields.items()}

    @property
    def shape(self) -> Array:
        """The present values of the constants in the obstacle's distance, (n,)."""
        return _values(self._constants)

    @property
    def committed_shape(self) -> Array:
        """The values of these constants at the last commit, (n,)."""
        return _values(self._committed_constants)

    @committed_shape.setter
    def committed_shape(self, shape: Array) -> None:
        first = 0
        for constant in self._committed_constants:
            last = first + constant.value.size
            constant.value[...] = shape[first:last].reshape(constant.value.shape)
            first = last

    def sample(self, position: Array, time: Array | float = 1.0) -> tuple[Array, Array]:
        """Return signed distances, (n,) (length), and unit normals to the obstacle. Collective.

        Args:
            position: Positions in the obstacle's frame, (n, gdim) (length); n may differ between
                ranks.
            time: From 0, the committed shape, to 1, the present one, one value or (n,).
        """
        if isinstance(self._obstacle, SampledObstacle):
            with collective_errors(self._comm):
                sample = self._obstacle.sample_checked(position)
            return sample.distance, sample.normal
        distance, normal, _ = self._sample(position, time)
        return distance, normal

    def gradient_error(self, position: Array) -> Array:
        """Return the norm of the gradient of the distance plus the normal, (n,). Collective."""
        if isinstance(self._obstacle, SampledObstacle):
            with collective_errors(self._comm):
                sample = self._obstacle.sample_checked(position)
                gradient, normal = _gradient(self._obstacle, position, sample), sample.normal
        else:
            _, normal, gradient = self._sample(position, 1.0)
        return np.asarray(np.linalg.norm(gradient + normal, axis=1))

    def _sample(self, position: Array, time: Array | float) -> tuple[Array, Array, Array]:
        """Return distance, normal and gradient of an obstacle in UFL. Collective."""
        n, d = position.shape
        if self._evaluator is None:
            self._evaluator = PointEvaluator(self._quadrature, self._expressions)
        time = np.broadcast_to(time, n)
        # The form evaluates as many positions at a time as Γc has points.
        batch_size = max(self._quadrature.n_points, 1)
        batches = max(self._comm.allgather(-(-n // batch_size) if self._quadrature.n_points else 0))
        distance, normal, gradient = np.zeros(n), np.zeros((n, d)), np.zeros((n, d))
        for k in range(batches):
            batch = slice(k * batch_size, (k + 1) * batch_size)
            for field, rows in ((self._position, position[batch]), (self._time, time[batch])):
                field.x.array[: rows.size] = rows.ravel()
                field.x.scatter_forward()
            values, m = self._evaluator(), len(position[batch])
            distance[batch], normal[batch] = values["gap"][:m], values["normal"][:m]
            gradient[batch] = values["gradient"][:m]
        return distance, normal, gradient


def _values(constants: Sequence[fem.Constant]) -> Array:
    """Return the concatenated values of constants, (n,)."""
    return np.concatenate([np.zeros(0), *(np.ravel(c.value) for c in constants)])


def _gradient(obstacle: SampledObstacle, x: Array, sample: Sample) -> Array:
    """Return the gradient of a sampled distance by difference quotients, (n, gdim).

    Towards the closest point of the surface the slope of a distance is -1, and sideways it is 0 on
    at least one side, even at edges. The gradient is minus the normal where the step would be below
    the round-off of the coordinates.
    """
    length = np.linalg.norm(sample.normal, axis=1, keepdims=True)
    unit = sample.normal / np.where(length > 0, length, np.nan)
    gradient, step = -unit, _STEP_RATIO * np.abs(sample.distance)
    resolved = step > _MIN_STEP_RATIO * np.abs(x).max(axis=1, initial=0.0)
    resolved &= np.isfinite(unit[:, 0])
    x, unit, step = x[resolved], unit[resolved], step[resolved]
    distance = sample.distance[resolved]
    axes = np.linalg.svd(unit[:, None, :])[2]  # the rows after the first are tangents
    axes[:, 0] = np.copysign(1.0, distance)[:, None] * unit
    components = np.zeros_like(unit)
    for k in range(x.shape[1]):
        slope: Array = np.full(len(x), np.inf)
        for signed in (step, -step) if k else (step,):
            displaced = obstacle.sample_checked(x + signed[:, None] * axes[:, k]).distance
            quotient = (displaced - distance) / signed
            slope = np.where(np.abs(quotient) < np.abs(slope), quotient, slope)
        components += slope[:, None] * axes[:, k]
    gradient[resolved] = components
    return gradient
