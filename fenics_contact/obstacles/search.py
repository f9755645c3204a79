"""Search for the closest of many facets."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from fenics_contact.types import Array, Index

__all__ = ["FacetSearch"]

# Largest ratio of the longest edge of pieces to the height of their triangle, and largest number of
# pieces beyond twice the number of triangles.
_MAX_ASPECT_RATIO, _MAX_EXTRA_PIECES = 4.0, 200_000
# Ratio of the largest to the smallest piece size in one search tree.
_SIZE_RATIO = 4.0
# Nearest corners that are tested first; they suffice for most points.
_FIRST_CANDIDATES = 4
# Corners searched and pairs measured at once, which take about 100 MB.
_CORNERS_PER_CHUNK, _PAIRS_PER_CHUNK = 500_000, 200_000


class FacetSearch:
    """Search trees of corners that find the closest facets.

    If all points of a piece of a facet are within ρ of its nearest corner, a point at distance d
    from the piece has a corner within √(d² + ρ²). There is one tree per class of piece sizes;
    slender triangles are cut into pieces.

    Args:
        corners: Segments in 2D or triangles in 3D, (m, d, d), m ≥ 1.
    """

    def __init__(self, corners: Array) -> None:
        self._low, self._high = corners.min(axis=1), corners.max(axis=1)
        d = corners.shape[2]
        pieces, facet = _cut_slender(corners) if d == 3 else (corners, np.arange(len(corners)))
        reach = np.sqrt(np.sum((np.roll(pieces, -1, axis=1) - pieces) ** 2, axis=2).max(axis=1))
        reach /= 2.0 if d == 2 else np.sqrt(3.0)
        points, number = np.unique(pieces.reshape(-1, d), axis=0, return_inverse=True)
        number = number.reshape(-1)
        largest = np.zeros(len(points))
        np.maximum.at(largest, number, np.repeat(reach, d))
        pairs = np.unique(np.stack([number, np.repeat(facet, d)], axis=1), axis=0)
        self._facets = np.asarray(pairs[:, 1], dtype=np.intp)
        self._first = np.searchsorted(pairs[:, 0], np.arange(len(points) + 1))
        grade = np.floor(np.log(largest.max() / largest) / np.log(_SIZE_RATIO)).astype(np.intp)
        self._trees: list[tuple[cKDTree, Index, float]] = []
        for g in np.unique(grade):
            members = np.flatnonzero(grade == g)
            tree = cKDTree(points[members], leafsize=16, balanced_tree=False)
            self._trees.append((tree, members, float(largest[members].max())))

    def find_closest(
        self, x: Array, distance: Callable[[Array, Index], Array], tolerance: float
    ) -> Index:
        """Return the closest facet of each point, the first of equally close ones, (n,).

        Args:
            x: Points, (n, d).
            distance: Function that returns the distances of points from one facet each, (n,).
            tolerance: Difference of equal distances (length).
        """
        n, m = len(x), len(self._low)
        bound, far = np.full(n, np.inf), np.full(n, np.inf)
        nearest = []
        for tree, numbers, _ in self._trees:
            lengths, found = tree.query(x, k=range(1, _FIRST_CANDIDATES + 1))
            exists = found < len(numbers)
            corner = np.full(found.shape, -1)
            corner[exists] = numbers[found[exists]]
            nearest.append((lengths, corner))
            far = np.minimum(far, lengths[:, 0])
        # The facets at the closest corners of all trees bound the distance.
        keys = []
        for lengths, corner in nearest:
            point = np.flatnonzero(lengths[:, 0] <= far)
            keys.append(self._pair_keys(point, corner[point, 0]))
        found_keys = np.unique(np.concatenate(keys))
        keys, distances = [found_keys], [self._distances(x, found_keys, distance)]
        np.minimum.at(bound, found_keys // m, distances[0])
        for (tree, numbers, reach), (lengths, corner) in zip(self._trees, nearest, strict=True):
            radius = np.sqrt((bound + tolerance) ** 2 + reach**2) * (1 + 1e-12)
            complete = lengths[:, -1] > radius
            point, column = np.nonzero(complete[:, None] & (lengths <= radius[:, None]))
            more = [self._within(x, bound + tolerance, point, corner[point, column])]
            rest = np.flatnonzero(~complete)
            count = tree.query_ball_point(x[rest], radius[rest], return_length=True)
            parts = np.flatnonzero(np.diff(np.cumsum(count) // _CORNERS_PER_CHUNK)) + 1
            for chunk in np.split(rest, parts):
                lists = tree.query_ball_point(x[chunk], radius[chunk])
                points = np.repeat(chunk, [len(found) for found in lists])
                more.append(self._within(x, bound + tolerance, points, numbers[_stack(lists)]))
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
        """Return the distances of pairs of points and facets."""
        parts = np.array_split(keys, 1 + len(keys) // _PAIRS_PER_CHUNK)
        pairs = [np.divmod(part, len(self._low)) for part in parts]
        return np.concatenate([distance(x[point], facet) for point, facet in pairs])

    def _within(self, x: Array, bound: Array, points: Index, corners: Index) -> Index:
        """Return keys as `_pair_keys` of facets whose bounding boxes are within the bounds."""
        keys = np.unique(self._pair_keys(points, corners))
        point, facet = np.divmod(keys, len(self._low))
        lengths = np.maximum(self._low[facet] - x[point], x[point] - self._high[facet])
        square = np.sum(np.maximum(lengths, 0.0) ** 2, axis=1)
        return keys[square <= bound[point] ** 2 * (1 + 1e-12)]

    def _pair_keys(self, points: Index, corners: Index) -> Index:
        """Pair points with all facets at one corner each; a key is point × m + facet."""
        counts = self._first[corners + 1] - self._first[corners]
        starts = np.repeat(self._first[corners] - np.cumsum(counts) + counts, counts)
        facets = self._facets[starts + np.arange(int(counts.sum()))]
        return np.repeat(points, counts) * len(self._low) + facets


def _stack(lists: npt.NDArray[np.object_]) -> Index:
    return np.concatenate([np.asarray(found, dtype=np.intp) for found in [[], *lists]])


def _cut_slender(triangles: Array) -> tuple[Array, Index]:
    """Bisect slender triangles; return the pieces and the triangle of each."""
    facet, most = np.arange(len(triangles)), 2 * len(triangles) + _MAX_EXTRA_PIECES
    edges = np.roll(triangles, -1, axis=1) - triangles
    longest = np.sqrt(np.sum(edges**2, axis=2).max(axis=1))
    height = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / longest
    while True:
        square = np.sum((np.roll(triangles, -1, axis=1) - triangles) ** 2, axis=2)
        slender = np.sqrt(square.max(axis=1)) / height[facet]
        cut = np.flatnonzero(slender > _MAX_ASPECT_RATIO)
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
