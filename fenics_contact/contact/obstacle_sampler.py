"""Distance and normal of a rigid obstacle at any place, in numbers."""

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

# Step of the differences by the distance: sideways to an edge the slope is half of it.
_STEP = 0.05
# Least step by the coordinates: their round-off is 1e-5 of it.
_LEAST_STEP = 1e-11


class ObstacleSampler:
    """Evaluates a rigid obstacle at places in its own frame; compiled at the first evaluation.

    The obstacle's shape depends on the constants in its distance, which may change from one
    increment to the next; between the committed shape and the present one they go straight on.

    Args:
        quadrature: The points of Γc, whose function space the compiled form uses.
        obstacle: Gap and direction at a place in the obstacle's frame (UFL), or the obstacle
            itself where it is known in numbers.
    """

    def __init__(
        self,
        quadrature: SurfaceQuadrature,
        obstacle: Callable[[Any], Placement] | SampledObstacle,
    ) -> None:
        self._quadrature, self._obstacle = quadrature, obstacle
        self._comm = quadrature.surface.mesh.comm
        self._constants: list[Any] = []
        self._committed: list[Any] = []
        self._evaluate: PointEvaluator | None = None
        if isinstance(obstacle, SampledObstacle):
            return
        mesh = quadrature.surface.mesh
        self._place = fem.Function(quadrature.space(mesh.geometry.dim), name="place")
        self._time = fem.Function(quadrature.space(1), name="time")
        here = ufl.variable(self._place)
        placement = obstacle(here)
        parts = {"gap": placement.gap, "normal": placement.normal}
        parts["gradient"] = ufl.diff(placement.gap, here)
        constants = {c for part in parts.values() for c in extract_constants(part)}
        self._constants = sorted(constants, key=lambda c: c.count())
        self._committed = [fem.Constant(mesh, c.value.copy()) for c in self._constants]
        pairs = zip(self._constants, self._committed, strict=True)
        time = self._time[0]
        between = {c: (1 - time) * then + time * c for c, then in pairs}
        self._expressions = {name: ufl.replace(part, between) for name, part in parts.items()}

    @property
    def shape(self) -> Array:
        """The numbers that the obstacle's shape depends on, as they are now, (n,)."""
        return _values(self._constants)

    @property
    def committed_shape(self) -> Array:
        """The numbers that the obstacle's shape depended on at the last commit, (n,)."""
        return _values(self._committed)

    @committed_shape.setter
    def committed_shape(self, shape: Array) -> None:
        first = 0
        for constant in self._committed:
            last = first + constant.value.size
            constant.value[...] = shape[first:last].reshape(constant.value.shape)
            first = last

    def sample(self, place: Array, time: Array | float = 1.0) -> tuple[Array, Array]:
        """Signed distances, and unit normals from body to obstacle. Collective.

        Args:
            place: In the obstacle's frame, (n, gdim) (length); n may differ from rank to rank.
            time: From 0, the committed shape, to 1, the present one: (n,) or one for all.

        Returns:
            (n,) (length) and (n, gdim).
        """
        if isinstance(self._obstacle, SampledObstacle):
            with collective_errors(self._comm):
                found = self._obstacle.sample_checked(place)
            return found.distance, found.normal
        distance, normal, _ = self._sample(place, time)
        return distance, normal

    def gradient_error(self, place: Array) -> Array:
        """Difference of the gradient of the distance and minus the normal, (n,). Collective.

        Args:
            place: In the obstacle's frame, (n, gdim) (length).
        """
        if isinstance(self._obstacle, SampledObstacle):
            with collective_errors(self._comm):
                found = self._obstacle.sample_checked(place)
                gradient, normal = _gradient(self._obstacle, place, found), found.normal
        else:
            _, normal, gradient = self._sample(place, 1.0)
        return np.asarray(np.linalg.norm(gradient + normal, axis=1))

    def _sample(self, place: Array, time: Array | float) -> tuple[Array, Array, Array]:
        """See `sample`, of an obstacle given by UFL; the gradient of the distance, too."""
        n, d = place.shape
        if self._evaluate is None:
            self._evaluate = PointEvaluator(self._quadrature, self._expressions)
        time = np.broadcast_to(time, n)
        # The form has as many slots as Γc has points: the places go through it in batches.
        size = max(self._quadrature.n_points, 1)
        batches = max(self._comm.allgather(-(-n // size) if self._quadrature.n_points else 0))
        distance, normal, gradient = np.zeros(n), np.zeros((n, d)), np.zeros((n, d))
        for k in range(batches):
            some = slice(k * size, (k + 1) * size)
            for field, rows in ((self._place, place[some]), (self._time, time[some])):
                field.x.array[: rows.size] = rows.ravel()
                field.x.scatter_forward()
            values, m = self._evaluate(), len(place[some])
            distance[some], normal[some] = values["gap"][:m], values["normal"][:m]
            gradient[some] = values["gradient"][:m]
        return distance, normal, gradient


def _values(constants: Sequence[fem.Constant]) -> Array:
    """The values of constants one after the other, (n,)."""
    return np.concatenate([np.zeros(0), *(np.ravel(c.value) for c in constants)])


def _gradient(obstacle: SampledObstacle, x: Array, sample: Sample) -> Array:
    """Gradient of a distance known in numbers, by differences, (n, gdim). Not collective.

    Towards the closest point of the surface the slope of a distance is -1, and sideways it is 0 on
    one side at least, whatever edges the surface has. It is minus the normal where the step would
    be below the round-off of the coordinates.

    Args:
        obstacle: That has the distance.
        x: Where, (n, gdim) (length).
        sample: What it returned there.
    """
    length = np.linalg.norm(sample.normal, axis=1, keepdims=True)
    unit = sample.normal / np.where(length > 0, length, np.nan)
    gradient, step = -unit, _STEP * np.abs(sample.distance)
    resolved = step > _LEAST_STEP * np.abs(x).max(axis=1, initial=0.0)
    resolved &= np.isfinite(unit[:, 0])
    x, unit, step = x[resolved], unit[resolved], step[resolved]
    distance = sample.distance[resolved]
    axes = np.linalg.svd(unit[:, None, :])[2]  # the rows after the first are tangents
    axes[:, 0] = np.copysign(1.0, distance)[:, None] * unit
    found = np.zeros_like(unit)
    for k in range(x.shape[1]):
        slope: Array = np.full(len(x), np.inf)
        for signed in (step, -step) if k else (step,):
            moved = obstacle.sample_checked(x + signed[:, None] * axes[:, k]).distance
            one_sided = (moved - distance) / signed
            slope = np.where(np.abs(one_sided) < np.abs(slope), one_sided, slope)
        found += slope[:, None] * axes[:, k]
    gradient[resolved] = found
    return gradient
