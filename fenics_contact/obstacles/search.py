"""Which of many facets may be closest to a point."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from fenics_contact.types import Array, Index

__all__ = ["FacetSearch"]

# Longest edge of pieces by the height of the triangle they are cut from; and how many more pieces
# than twice the triangles there may be.
_SLENDER, _MOST = 4.0, 200_000
# Corners of one search differ in the size of their pieces by less than this factor.
_GRADES = 4.0
# Corners that are looked at first; they suffice for most points.
_FIRST = 4
# Corners that are looked for together, and pairs of point and facet: some 100 MB.
_AT_ONCE, _TOGETHER = 500_000, 200_000


class FacetSearch:
    """Finds the facets that may be closest to points: all that are, and few others.

    A piece of a facet, none of whose points is farther than ρ from its nearest corner, has a corner
    no farther than √(d² + ρ²) from a place at the distance d. So trees of corners find it, one for
    pieces of about the same size. Slender triangles are cut into pieces.
    """

    def __init__(self, corners: Array) -> None:
        """Build it.

        Args:
            corners: Of segments in the plane or triangles in space, (m, d, d), m ≥ 1.
        """
        self._low, self._high = corners.min(axis=1), corners.max(axis=1)
        d = corners.shape[2]
        pieces, facet = _cut(corners) if d == 3 else (corners, np.arange(len(corners)))
        reach = np.sqrt(np.sum((np.roll(pieces, -1, axis=1) - pieces) ** 2, axis=2).max(axis=1))
        reach /= 2.0 if d == 2 else np.sqrt(3.0)
        places, number = np.unique(pieces.reshape(-1, d), axis=0, return_inverse=True)
        number = number.reshape(-1)
        largest = np.zeros(len(places))
        np.maximum.at(largest, number, np.repeat(reach, d))
        pairs = np.unique(np.stack([number, np.repeat(facet, d)], axis=1), axis=0)
        self._facets = np.asarray(pairs[:, 1], dtype=np.intp)
        self._first = np.searchsorted(pairs[:, 0], np.arange(len(places) + 1))
        grade = np.floor(np.log(largest.max() / largest) / np.log(_GRADES)).astype(np.intp)
        self._trees: list[tuple[cKDTree, Index, float]] = []
        for g in np.unique(grade):
            some = np.flatnonzero(grade == g)
            tree = cKDTree(places[some], leafsize=16, balanced_tree=False)
            self._trees.append((tree, some, float(largest[some].max())))

    def closest(
        self, x: Array, distance: Callable[[Array, Index], Array], tolerance: float
    ) -> Index:
        """The closest facet of each point: the first of those that are closest.

        Args:
            x: The points, (n, d).
            distance: Of points from one facet each, (n,).
            tolerance: Distances that differ by less are the same (length).
        """
        n, m = len(x), len(self._low)
        bound, far = np.full(n, np.inf), np.full(n, np.inf)
        firsts = []
        for tree, numbers, _ in self._trees:
            away, found = tree.query(x, k=range(1, _FIRST + 1))
            here = found < len(numbers)
            corner = np.full(found.shape, -1)
            corner[here] = numbers[found[here]]
            firsts.append((away, corner))
            far = np.minimum(far, away[:, 0])
        # The corners of all trees that are closest bound the distance.
        keys = []
        for away, corner in firsts:
            point = np.flatnonzero(away[:, 0] <= far)
            keys.append(self._around(point, corner[point, 0]))
        found_keys = np.unique(np.concatenate(keys))
        keys, distances = [found_keys], [self._distances(x, found_keys, distance)]
        np.minimum.at(bound, found_keys // m, distances[0])
        for (tree, numbers, reach), (away, corner) in zip(self._trees, firsts, strict=True):
            radius = np.sqrt((bound + tolerance) ** 2 + reach**2) * (1 + 1e-12)
            whole = away[:, -1] > radius
            point, column = np.nonzero(whole[:, None] & (away <= radius[:, None]))
            more = [self._near(x, bound + tolerance, point, corner[point, column])]
            rest = np.flatnonzero(~whole)
            count = tree.query_ball_point(x[rest], radius[rest], return_length=True)
            parts = np.flatnonzero(np.diff(np.cumsum(count) // _AT_ONCE)) + 1
            for some in np.split(rest, parts):
                lists = tree.query_ball_point(x[some], radius[some])
                points = np.repeat(some, [len(found) for found in lists])
                more.append(self._near(x, bound + tolerance, points, numbers[_joined(lists)]))
            found_keys = np.setdiff1d(np.concatenate(more), keys[0])
            keys.append(found_keys)
            distances.append(self._distances(x, found_keys, distance))
        point, facet = np.divmod(np.concatenate(keys), m)
        found = np.concatenate(distances)
        np.minimum.at(bound, point, found)
        same = found <= bound[point] + tolerance
        chosen = np.full(n, m, dtype=np.intp)
        np.minimum.at(chosen, point[same], facet[same])
        return chosen

    def _distances(self, x: Array, keys: Index, distance: Callable[[Array, Index], Array]) -> Array:
        """Of pairs of points and facets."""
        parts = np.array_split(keys, 1 + len(keys) // _TOGETHER)
        pairs = [np.divmod(part, len(self._low)) for part in parts]
        return np.concatenate([distance(x[point], facet) for point, facet in pairs])

    def _near(self, x: Array, bound: Array, points: Index, corners: Index) -> Index:
        """`_around`, without facets whose boxes are farther than the bounds of the points."""
        keys = np.unique(self._around(points, corners))
        point, facet = np.divmod(keys, len(self._low))
        away = np.maximum(self._low[facet] - x[point], x[point] - self._high[facet])
        square = np.sum(np.maximum(away, 0.0) ** 2, axis=1)
        return keys[square <= bound[point] ** 2 * (1 + 1e-12)]

    def _around(self, points: Index, corners: Index) -> Index:
        """Pairs of points and of all facets at a corner for each, as one number a pair."""
        counts = self._first[corners + 1] - self._first[corners]
        starts = np.repeat(self._first[corners] - np.cumsum(counts) + counts, counts)
        facets = self._facets[starts + np.arange(int(counts.sum()))]
        return np.repeat(points, counts) * len(self._low) + facets


def _joined(lists: npt.NDArray[np.object_]) -> Index:
    return np.concatenate([np.asarray(found, dtype=np.intp) for found in [[], *lists]])


def _cut(triangles: Array) -> tuple[Array, Index]:
    """Pieces of triangles, no longer than some heights of these, and the triangle of each."""
    facet, most = np.arange(len(triangles)), 2 * len(triangles) + _MOST
    edges = np.roll(triangles, -1, axis=1) - triangles
    longest = np.sqrt(np.sum(edges**2, axis=2).max(axis=1))
    height = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / longest
    while True:
        square = np.sum((np.roll(triangles, -1, axis=1) - triangles) ** 2, axis=2)
        slender = np.sqrt(square.max(axis=1)) / height[facet]
        cut = np.flatnonzero(slender > _SLENDER)
        cut = cut[np.argsort(-slender[cut], kind="stable")][: most - len(triangles)]
        if not len(cut):
            return triangles, facet
        k = np.argmax(square[cut], axis=1)
        a, b, c = (triangles[cut, (k + i) % 3] for i in range(3))
        middle = (a + b) / 2
        halves = [np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)]
        rest = np.ones(len(triangles), dtype=np.bool_)
        rest[cut] = False
        triangles = np.concatenate([triangles[rest], *halves])
        facet = np.concatenate([facet[rest], facet[cut], facet[cut]])
