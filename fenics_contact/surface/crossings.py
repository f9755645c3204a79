"""Crossings of moving points and moving facets within an increment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.spatial
from numpy.polynomial.polynomial import polyval

from fenics_contact.parallel import gather_rows, global_max, global_min
from fenics_contact.surface.facets import across
from fenics_contact.surface.projection import find_near_pairs
from fenics_contact.tolerances import NEGLIGIBLE
from fenics_contact.types import Array, Index, Mask

__all__ = ["Crossings", "MovingFacets", "find_crossings", "max_penetration_on_path"]

_BISECTION_STEPS = 40
_MAX_PATH_SAMPLES = 1000


@dataclass(frozen=True)
class MovingFacets:
    """Flat facets of this rank at both ends of an increment.

    Attributes:
        start, end: Corners in their order around the facet, (m, n_corners, d) (length).
        sign: Sign of the normal given by the corners' order relative to the outward one, (m,).
        vertices: Global vertex numbers of the facets' cells, (m, n_vertices).
    """

    start: Array
    end: Array
    sign: Array
    vertices: Index

    def simplices(self) -> list[list[int]]:
        """Return the local corner numbers of the simplices that make up a facet."""
        if self.start.shape[2] == 2:
            return [[0, 1]]
        return [[0, 1, 2], [0, 2, 3]][: self.start.shape[1] - 2]

    def normals(self) -> Array:
        """Outward unit normals at the end of the increment, (m, d)."""
        edges = self.end[:, 1 : self.end.shape[2]] - self.end[:, :1]
        return _normalise(self.sign[:, None] * across(np.swapaxes(edges, 1, 2)))


@dataclass(frozen=True)
class Crossings:
    """Facets crossed by the points of this rank, ascending by point and time.

    Attributes:
        place: Number of the point on this rank, (n,).
        time: Time as a fraction of the increment, (n,).
        inward: Whether the point enters the body through the facet, (n,).
        normal: Outward unit normal of the facet at that time, (n, d).
        depth: Depth of the point below the facet's plane at the end, (n,) (length).
        facet: Global number of the facet, (n,).
    """

    place: Index
    time: Array
    inward: Mask
    normal: Array
    depth: Array
    facet: Index


def find_crossings(
    comm: Any, start: Array, end: Array, vertices: Index, facets: MovingFacets
) -> Crossings:
    """Find the facets of all ranks that the points of this rank cross. Collective.

    Points and facet corners move along straight lines. Facets that share a vertex with the cell of
    a point are excluded: a body does not cross itself there.

    Args:
        comm: Communicator.
        start: Initial points, (n, d) (length).
        end: Final points, (n, d) (length).
        vertices: Global vertex numbers of the cell of each point, (n, n_vertices).
        facets: Facets of this rank.
    """
    first = comm.exscan(len(start)) or 0
    d = start.shape[1]
    starts, ends = (gather_rows(comm, rows) for rows in (start, end))
    local = _find_local_crossings(starts, ends, np.concatenate(comm.allgather(vertices)), facets)
    local[:, -1] += comm.exscan(len(facets.start)) or 0
    found = gather_rows(comm, local)
    number = found[:, 0].astype(np.int64) - first
    own = (number >= 0) & (number < len(start))
    found, number = found[own], number[own]
    order = np.lexsort((found[:, -1], found[:, 1], number))
    found = found[order]
    time, inward, depth, normal = found[:, 1], found[:, 2] > 0, found[:, 3], found[:, 4 : 4 + d]
    return Crossings(number[order], time, inward, normal, depth, found[:, -1].astype(np.int64))


def max_penetration_on_path(
    comm: Any, start: Array, end: Array, since: Array, vertices: Index, facets: MovingFacets
) -> Array:
    """Return the largest penetration depth of this rank's points on their paths. Collective.

    The depth is sampled at times between which no point moves by more than half a facet, from
    ``since`` on, (n,); other arguments as for `find_crossings`. It is measured from the nearest
    facet whose lateral distance does not exceed its normal distance: points may leave the body
    where there are no facets.

    Returns:
        Depth, (n,) (length); 0 for points below no facet, infinite if paths are too long.
    """
    first, n = comm.exscan(len(start)) or 0, len(start)
    start, end, since = (gather_rows(comm, rows) for rows in (start, end, since))
    if not len(start):
        return np.zeros(0)
    vertices = np.concatenate(comm.allgather(vertices))
    point, facet = _find_candidates(start, end, vertices, facets)
    corners = [facets.start[facet], facets.end[facet]]
    edges = [np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2) for x in corners]
    smallest = global_min(comm, np.stack(edges), empty=np.inf)
    lengths = np.linalg.norm(end - start, axis=1)[point]
    lengths = lengths + np.linalg.norm(corners[1] - corners[0], axis=2).max(axis=1, initial=0.0)
    steps = 2 * global_max(comm, lengths) / smallest if smallest > 0 else np.inf
    if not steps <= _MAX_PATH_SAMPLES:
        return np.full(n, np.inf)
    times = np.linspace(0.0, 1.0, 1 + int(np.ceil(steps)))[1:]
    moving = [
        _Pairs.from_facets(start[point], end[point], facets, facet, simplex)
        for simplex in facets.simplices()
    ]
    nearest: Array = np.full((len(times), len(start)), np.inf)
    for number, time in enumerate(map(float, times)):
        rows = np.flatnonzero(since[point] <= time)
        for pairs in moving:
            distance = pairs.distance(rows, time)
            is_near = pairs.lateral_distance(rows, np.full(len(rows), time)) <= np.abs(distance)
            order = np.argsort(-np.abs(distance[is_near]), kind="stable")
            found: Array = np.full(len(start), np.inf)
            found[point[rows[is_near]][order]] = distance[is_near][order]
            row = nearest[number]
            nearest[number] = np.where(np.abs(found) < np.abs(row), found, row)
    gathered = np.array(comm.allgather(nearest))
    closest = np.abs(gathered).argmin(axis=0)[None]
    nearest = np.take_along_axis(gathered, closest, axis=0)[0]
    depth = -np.where(np.isfinite(nearest), nearest, 0.0).min(axis=0, initial=0.0)
    return depth[first : first + n]


def _find_candidates(
    start: Array, end: Array, vertices: Index, facets: MovingFacets
) -> tuple[Index, Index]:
    """Return pairs of a point and a facet of this rank whose paths come near each other."""
    empty: Index = np.zeros(0, dtype=np.int64)
    if not (len(start) and len(facets.start)):
        return empty, empty
    d = start.shape[1]
    # Bounding balls of the paths of points and facets.
    centre, radius = _bounding_balls(np.stack([start, end], axis=1))
    corners = np.concatenate([facets.start, facets.end], axis=1)
    middle, reach = _bounding_balls(corners)
    # The set of more varied sizes searches, which yields fewer candidates.
    point: Any
    facet: Any
    finite = np.flatnonzero(np.isfinite(radius))  # an obstacle may have no normal
    if not len(finite):
        return empty, empty
    longest, widest = radius[finite].max(), reach.max()
    if np.mean((reach + longest) ** (d - 1)) < np.mean((radius[finite] + widest) ** (d - 1)):
        tree = scipy.spatial.cKDTree(centre[finite])
        facet, point = find_near_pairs(tree, middle, reach + longest)
    else:
        tree = scipy.spatial.cKDTree(middle)
        point, facet = find_near_pairs(tree, centre[finite], radius[finite] + widest)
    point = finite[point]
    near = np.linalg.norm(centre[point] - middle[facet], axis=1) <= radius[point] + reach[facet]
    near &= ~(vertices[point][:, :, None] == facets.vertices[facet][:, None, :]).any(axis=(1, 2))
    return point[near], facet[near]


def _find_local_crossings(start: Array, end: Array, vertices: Index, facets: MovingFacets) -> Array:
    """Return rows (point, time, inward, depth, normal, facet) for facets of this rank."""
    d = start.shape[1]
    empty: Array = np.zeros((0, 5 + d))
    point, facet = _find_candidates(start, end, vertices, facets)
    if not len(point):
        return empty
    found = [empty]
    for simplex in facets.simplices():
        moving = _Pairs.from_facets(start[point], end[point], facets, facet, simplex)
        rows, time, inward = moving.find_plane_crossings()
        on_facet = moving.is_on_facet(rows, time)
        rows, time, inward = rows[on_facet], time[on_facet], inward[on_facet]
        normal, depth = moving.normal(rows, time), -moving.distance(rows)
        columns = point[rows], time, np.where(inward, 1.0, -1.0), depth, normal, facet[rows]
        found.append(np.column_stack(columns))
    return np.concatenate(found)


@dataclass(frozen=True)
class _Pairs:
    """Pairs of a moving point, (n, d), and a moving simplex, (n, d, d)."""

    start: Array
    end: Array
    corners_start: Array
    corners_end: Array
    sign: Array

    @classmethod
    def from_facets(
        cls, start: Array, end: Array, facets: MovingFacets, facet: Index, simplex: list[int]
    ) -> _Pairs:
        """Pair points with one simplex of each of the given facets."""
        corners = facets.start[facet][:, simplex], facets.end[facet][:, simplex]
        return cls(start, end, *corners, facets.sign[facet])

    def _relative_position(self, time: Array | float, rows: Index | slice) -> tuple[Array, Array]:
        """Return vectors from the first corner to the point and tangents, (n, d), (n, d - 1, d)."""
        t: Array = np.reshape(time, (-1, 1))
        point = (1 - t) * self.start[rows] + t * self.end[rows]
        t = t[:, :, None]
        corners = (1 - t) * self.corners_start[rows] + t * self.corners_end[rows]
        return point - corners[:, 0], corners[:, 1:] - corners[:, :1]

    def _scaled_normal(self, tangents: Array, rows: Index | slice) -> Array:
        """Return outward normals, not normalised."""
        return self.sign[rows][:, None] * across(np.swapaxes(tangents, 1, 2))

    def signed_volume(self, time: Array | float, rows: Index | slice = slice(None)) -> Array:
        """Return normal distance times facet area, negative behind the facet, (n,)."""
        arm, tangents = self._relative_position(time, rows)
        return np.asarray(np.sum(arm * self._scaled_normal(tangents, rows), axis=1))

    def normal(self, rows: Index, time: Array) -> Array:
        """Return outward unit normals, (n, d)."""
        return _normalise(self._scaled_normal(self._relative_position(time, rows)[1], rows))

    def distance(self, rows: Index, time: float = 1.0) -> Array:
        """Return the signed distance from the plane of the facet at a time, (n,) (length)."""
        arm, _ = self._relative_position(time, rows)
        return np.asarray(np.sum(arm * self.normal(rows, np.full(len(rows), time)), axis=1))

    def find_plane_crossings(self) -> tuple[Index, Array, Mask]:
        """Return the pairs that cross the plane of the facet, the times, and whether inwards.

        `signed_volume` is a polynomial of degree d in time, monotone between its extrema: each
        interval contains at most one crossing.
        """
        d = self.start.shape[1]
        times = np.arange(d + 1) / d
        values = np.stack([self.signed_volume(time) for time in times])
        cubic = np.zeros((4, len(self.start)))  # ascending powers
        cubic[: d + 1] = np.linalg.solve(np.vander(times, increasing=True), values)
        with np.errstate(all="ignore"):
            half = -(
                cubic[2] + np.copysign(np.sqrt(cubic[2] ** 2 - 3 * cubic[1] * cubic[3]), cubic[2])
            )
            extrema = np.clip(np.nan_to_num([half / (3 * cubic[3]), cubic[1] / half]), 0.0, 1.0)
        knots = np.stack([np.zeros_like(half), *np.sort(extrema, axis=0), np.ones_like(half)])
        front = np.stack([values[0], *polyval(knots[1:3], cubic, tensor=False), values[-1]]) >= 0
        part, rows = np.nonzero(front[1:] != front[:-1])
        low, high, inward = knots[part, rows], knots[part + 1, rows], front[part, rows]
        for _ in range(_BISECTION_STEPS):
            middle = (low + high) / 2
            same = (polyval(middle, cubic[:, rows], tensor=False) >= 0) == inward
            low, high = np.where(same, middle, low), np.where(same, high, middle)
        return rows, high, inward

    def is_on_facet(self, rows: Index, time: Array) -> Mask:
        """Return whether the point lies on the facet at its time, (n,)."""
        lambdas, _ = self._barycentric(rows, time)
        return np.asarray(np.all(lambdas >= -NEGLIGIBLE, axis=1))

    def lateral_distance(self, rows: Index, time: Array) -> Array:
        """Return the distance of the points from the facet within its plane, (n,) (length)."""
        lambdas, heights = self._barycentric(rows, time)
        return np.asarray(np.max(-lambdas * heights, axis=1, initial=0.0))

    def _barycentric(self, rows: Index, time: Array) -> tuple[Array, Array]:
        """Return barycentric coordinates, -inf for degenerate facets, and heights, (n, d)."""
        arm, tangents = self._relative_position(time, rows)
        gram = np.einsum("nid,njd->nij", tangents, tangents)
        size = np.trace(gram, axis1=1, axis2=2)
        regular = np.abs(np.linalg.det(gram)) > 1e-24 * size ** gram.shape[1]
        gram[~regular] = np.eye(gram.shape[1])
        inverse = np.linalg.inv(gram)
        at = np.einsum("nij,njd,nd->ni", inverse, tangents, arm)
        lambdas = np.column_stack([1.0 - at.sum(axis=1), at])
        slopes = np.column_stack([inverse.sum(axis=(1, 2)), np.einsum("nii->ni", inverse)])
        lambdas[~regular] = -np.inf
        return lambdas, 1.0 / np.sqrt(slopes)


def _bounding_balls(points: Array) -> tuple[Array, Array]:
    """Return centres, (n, d), and radii, (n,), of bounding balls of points, (n, k, d)."""
    centre = (points.min(axis=1) + points.max(axis=1)) / 2
    return centre, np.linalg.norm(points - centre[:, None], axis=2).max(axis=1)


def _normalise(vectors: Array) -> Array:
    """Normalise vectors (n, d); zero vectors of degenerate facets remain zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, np.finfo(float).tiny))
