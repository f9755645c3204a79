"""Signed distance from a smooth curve in the plane, with normals and curvature."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from fenics_contact.obstacles.base import Sample
from fenics_contact.types import Array

__all__ = ["Curve"]


# Places on the curve by point given, and at least: one of those nearest is where a search starts.
_PLACES, _LEAST, _STARTS = 16, 1000, 3
# By bisection alone a place is found to the last digit.
_STEPS = 80
# Of the length of the curve: how well a place on it is known, and from where on directions are.
_SAME, _AT_END = 1e-13, 1e-9
# Least of the distance to the centre of curvature, by its radius, that is divided by.
_CENTRE = 1e-6


class Curve:
    """The cubic spline through points over their chords, the obstacle on the left of its way.

    Places from which an end of an open curve is closest are outside.

    Args:
        closed: Whether it goes on from the last point to the first.

    Attributes:
        points: What it goes through, at least two, neighbours distinct, (n, 2) (length).
    """

    def __init__(self, points: Array, *, closed: bool) -> None:
        self.points = points
        if closed:
            points = np.concatenate([points, points[:1]])
        chords = np.linalg.norm(np.diff(points, axis=0), axis=1)
        knots = np.concatenate([[0.0], np.cumsum(chords)])
        kind = "periodic" if closed else "not-a-knot"
        self._closed, self._end = closed, float(knots[-1])
        self._place = CubicSpline(knots, points, bc_type=kind)
        self._slope, self._bend = self._place.derivative(1), self._place.derivative(2)
        n = max(_PLACES * len(points), _LEAST)
        self._starts = np.linspace(0.0, self._end, n, endpoint=not closed)
        self._step = float(self._starts[1])
        self._tree = cKDTree(self._place(self._starts))

    def sample(self, x: Array) -> Sample:
        """Return signed distance, normal and curvature at points (n, 2)."""
        t = self._closest(x)
        arm, along, bend = x - self._place(t), self._slope(t), self._bend(t)
        speed = np.linalg.norm(along, axis=1)
        along /= speed[:, None]
        outward = np.stack([along[:, 1], -along[:, 0]], axis=1)
        curvature = -np.einsum("ni,ni->n", bend, outward) / speed**2
        distance = np.einsum("ni,ni->n", arm, outward)
        curvature = curvature / np.maximum(1.0 + curvature * distance, _CENTRE)
        if not self._closed:
            length = np.linalg.norm(arm, axis=1)
            off = np.minimum(t, self._end - t) <= _SAME * self._end
            off &= length > _AT_END * self._end
            distance = np.where(off, length, distance)
            outward = np.where(off[:, None], arm / np.where(off, length, 1.0)[:, None], outward)
            along = np.stack([-outward[:, 1], outward[:, 0]], axis=1)
            curvature = np.where(off, 1.0 / np.where(off, length, 1.0), curvature)
        second = curvature[:, None, None] * np.einsum("ni,nj->nij", along, along)
        return Sample(distance, -outward, second)

    @property
    def smallest_radius(self) -> float:
        """Smallest radius of curvature where the obstacle is convex, infinite if nowhere."""
        (x, y), (bend_x, bend_y) = self._slope(self._starts).T, self._bend(self._starts).T
        sharpest = float(np.max((x * bend_y - y * bend_x) / np.hypot(x, y) ** 3))
        return 1.0 / sharpest if sharpest > 0.0 else np.inf

    def _closest(self, x: Array) -> Array:
        """Of every point the parameter of the closest place, (n,)."""
        found = np.asarray(self._tree.query(x, k=range(1, _STARTS + 1))[1], dtype=np.intp)
        starts = np.asarray(self._starts[found.ravel()], dtype=np.float64)
        t = self._descend(np.repeat(x, _STARTS, axis=0), starts)
        t = t.reshape(found.shape)
        away: Array = np.linalg.norm(x[:, None] - self._place(t), axis=2)
        # Of places at the same distance the first, whatever the last digit.
        same = away <= away.min(axis=1, keepdims=True) + _SAME * self._end
        return np.min(np.where(same, t, np.inf), axis=1)

    def _descend(self, x: Array, start: Array) -> Array:
        """Places at which the distance is least, near starts: (n,)."""
        # So far that all starts beside one such place lead to it.
        reach = _STARTS * self._step
        low, high, t = start - reach, start + reach, start.copy()
        if not self._closed:
            low, high = np.maximum(low, 0.0), np.minimum(high, self._end)
        moving = np.arange(len(x))
        for _ in range(_STEPS):
            here = t[moving]
            arm, along = x[moving] - self._place(here), self._slope(here)
            ahead = np.einsum("ni,ni->n", arm, along)
            fall = np.einsum("ni,ni->n", arm, self._bend(here)) - np.sum(along**2, axis=1)
            low[moving] = np.where(ahead > 0, here, low[moving])
            high[moving] = np.where(ahead > 0, high[moving], here)
            down, up = low[moving], high[moving]
            newton = here - ahead / np.where(fall < 0, fall, -1.0)
            inside = (fall < 0) & (newton >= down) & (newton <= up)
            t[moving] = np.where(inside, newton, (down + up) / 2)
            moved = np.abs(t[moving] - here) > _SAME * self._end / 4
            moving = moving[moved]
            if not len(moving):
                break
        return np.mod(t, self._end) if self._closed else t
