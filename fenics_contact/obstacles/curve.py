"""Signed distance from a plane cubic spline, with normals and curvature."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from fenics_contact.obstacles.base import Sample
from fenics_contact.tolerances import NEGLIGIBLE
from fenics_contact.types import Array

__all__ = ["Curve"]


# Initial guesses of the projection: per given point and at least; the nearest ones are used.
_SAMPLES_PER_POINT, _MIN_SAMPLES, _N_STARTS = 16, 1000, 3
# Largest number of Newton or bisection steps: sufficient for bisection alone.
_MAX_STEPS = 80
# Difference of equal parameters relative to the curve length.
_SAME_PARAMETER_RATIO = 1e-13
# Smallest distance from the centre of curvature relative to the radius.
_MIN_CENTRE_RATIO = 1e-6


class Curve:
    """Cubic spline with chord-length parametrisation, with the obstacle on its left.

    Points whose closest point is an end of an open curve are outside. ``points`` are at least two
    interpolated points, (n, 2) (length), neighbours distinct, the last one connected to the first
    if ``closed``.
    """

    def __init__(self, points: Array, *, closed: bool) -> None:
        self.points = points
        if closed:
            points = np.concatenate([points, points[:1]])
        chords = np.linalg.norm(np.diff(points, axis=0), axis=1)
        knots = np.concatenate([[0.0], np.cumsum(chords)])
        kind = "periodic" if closed else "not-a-knot"
        self._closed, self._end = closed, float(knots[-1])
        self._position = CubicSpline(knots, points, bc_type=kind)
        self._slope, self._bend = self._position.derivative(1), self._position.derivative(2)
        n = max(_SAMPLES_PER_POINT * len(points), _MIN_SAMPLES)
        self._starts = np.linspace(0.0, self._end, n, endpoint=not closed)
        self._step = float(self._starts[1])
        self._tree = cKDTree(self._position(self._starts))

    def sample(self, x: Array) -> Sample:
        """Return signed distance, normal and curvature at points (n, 2)."""
        t = self._project(x)
        arm, along, bend = x - self._position(t), self._slope(t), self._bend(t)
        speed = np.linalg.norm(along, axis=1)
        along /= speed[:, None]
        outward = np.stack([along[:, 1], -along[:, 0]], axis=1)
        curvature = -np.einsum("ni,ni->n", bend, outward) / speed**2
        distance = np.einsum("ni,ni->n", arm, outward)
        curvature = curvature / np.maximum(1.0 + curvature * distance, _MIN_CENTRE_RATIO)
        if not self._closed:
            length = np.linalg.norm(arm, axis=1)
            off = np.minimum(t, self._end - t) <= _SAME_PARAMETER_RATIO * self._end
            off &= length > NEGLIGIBLE * self._end
            distance = np.where(off, length, distance)
            outward = np.where(off[:, None], arm / np.where(off, length, 1.0)[:, None], outward)
            along = np.stack([-outward[:, 1], outward[:, 0]], axis=1)
            curvature = np.where(off, 1.0 / np.where(off, length, 1.0), curvature)
        second = curvature[:, None, None] * np.einsum("ni,nj->nij", along, along)
        return Sample(distance, -outward, second)

    @property
    def smallest_radius(self) -> float:
        """Smallest radius of curvature of convex parts (length), infinite if there are none."""
        (x, y), (bend_x, bend_y) = self._slope(self._starts).T, self._bend(self._starts).T
        sharpest = float(np.max((x * bend_y - y * bend_x) / np.hypot(x, y) ** 3))
        return 1.0 / sharpest if sharpest > 0.0 else np.inf

    def _project(self, x: Array) -> Array:
        """Return the parameter of the closest point projection, (n,)."""
        nearest = np.asarray(self._tree.query(x, k=range(1, _N_STARTS + 1))[1], dtype=np.intp)
        starts = np.asarray(self._starts[nearest.ravel()], dtype=np.float64)
        t = self._minimise(np.repeat(x, _N_STARTS, axis=0), starts)
        t = t.reshape(nearest.shape)
        distance: Array = np.linalg.norm(x[:, None] - self._position(t), axis=2)
        # At equal distances, up to round-off, the smallest parameter is chosen.
        same = distance <= distance.min(axis=1, keepdims=True) + _SAME_PARAMETER_RATIO * self._end
        return np.min(np.where(same, t, np.inf), axis=1)

    def _minimise(self, x: Array, start: Array) -> Array:
        """Find local minima of the distance near starts by safeguarded Newton steps, (n,)."""
        # The bracket includes the neighbouring starts.
        reach = _N_STARTS * self._step
        low, high, t = start - reach, start + reach, start.copy()
        if not self._closed:
            low, high = np.maximum(low, 0.0), np.minimum(high, self._end)
        active = np.arange(len(x))
        for _ in range(_MAX_STEPS):
            current = t[active]
            arm, along = x[active] - self._position(current), self._slope(current)
            gradient = np.einsum("ni,ni->n", arm, along)
            curvature = np.einsum("ni,ni->n", arm, self._bend(current)) - np.sum(along**2, axis=1)
            low[active] = np.where(gradient > 0, current, low[active])
            high[active] = np.where(gradient > 0, high[active], current)
            lower, upper = low[active], high[active]
            newton = current - gradient / np.where(curvature < 0, curvature, -1.0)
            inside = (curvature < 0) & (newton >= lower) & (newton <= upper)
            t[active] = np.where(inside, newton, (lower + upper) / 2)
            unconverged = np.abs(t[active] - current) > _SAME_PARAMETER_RATIO * self._end / 4
            active = active[unconverged]
            if not len(active):
                break
        return np.mod(t, self._end) if self._closed else t
