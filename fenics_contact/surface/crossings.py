"""Where places that move cross facets that move, in the course of an increment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.spatial
from numpy.polynomial.polynomial import polyval

from fenics_contact.parallel import gather_rows, global_max, global_min
from fenics_contact.surface.facets import across
from fenics_contact.surface.projection import near_pairs
from fenics_contact.tolerances import NEGLIGIBLE
from fenics_contact.types import Array, Index, Mask

__all__ = ["Crossings", "MovingFacets", "find_crossings", "largest_depth_on_path"]

# Of the time at which the plane of a facet is crossed.
_BISECTIONS = 40
# Largest number of times at which the depth along paths is evaluated.
_MAX_PATH_TIMES = 1000


@dataclass(frozen=True)
class MovingFacets:
    """Facets of this rank at both ends of an increment, taken as flat.

    Attributes:
        start, end: Corners in their order around the facet, (m, n_corners, d) (length).
        sign: By which the normal of the corners' order points out of the body, (m,).
        vertices: Global numbers of the vertices of their cells, (m, n_vertices).
    """

    start: Array
    end: Array
    sign: Array
    vertices: Index

    def pieces(self) -> list[list[int]]:
        """Corners of the simplices that each of them is divided into."""
        if self.start.shape[2] == 2:
            return [[0, 1]]
        return [[0, 1, 2], [0, 2, 3]][: self.start.shape[1] - 2]

    def normals(self) -> Array:
        """Outward unit normals at the end of the increment, (m, d)."""
        edges = self.end[:, 1 : self.end.shape[2]] - self.end[:, :1]
        return _unit(self.sign[:, None] * across(np.swapaxes(edges, 1, 2)))


@dataclass(frozen=True)
class Crossings:
    """Crossings of this rank's places, ascending by place and time.

    Attributes:
        place: Number of the place on this rank, (n,).
        time: Share of the increment, (n,).
        inward: Whether the place comes into the body through the facet, (n,).
        normal: Outward unit normal of the facet at that time, (n, d).
        depth: How deep the place is at the end below the plane of the facet, (n,) (length).
        facet: Number of the facet among those of all ranks, (n,).
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
    """Find which facets of all ranks the places of this rank cross. Collective.

    Places and corners of facets go straight on. Facets with which a place shares a vertex are
    left out: a body does not cross itself there.

    Args:
        comm: The ranks.
        start: Of the places, (n, d) (length).
        end: Of the places, (n, d) (length).
        vertices: Global numbers of the vertices of the cell of each place, (n, n_vertices).
        facets: Those of this rank.
    """
    first = comm.exscan(len(start)) or 0
    d = start.shape[1]
    starts, ends = (gather_rows(comm, rows) for rows in (start, end))
    mine = _crossings(starts, ends, np.concatenate(comm.allgather(vertices)), facets)
    mine[:, -1] += comm.exscan(len(facets.start)) or 0
    found = gather_rows(comm, mine)
    number = found[:, 0].astype(np.int64) - first
    own = (number >= 0) & (number < len(start))
    found, number = found[own], number[own]
    order = np.lexsort((found[:, -1], found[:, 1], number))
    found = found[order]
    time, inward, depth, normal = found[:, 1], found[:, 2] > 0, found[:, 3], found[:, 4 : 4 + d]
    return Crossings(number[order], time, inward, normal, depth, found[:, -1].astype(np.int64))


def largest_depth_on_path(
    comm: Any, start: Array, end: Array, since: Array, vertices: Index, facets: MovingFacets
) -> Array:
    """How deep places of this rank get below the facets that they are under. Collective.

    At each of some times, between which none moves on by more than half of a facet, below the
    nearest facet that a place is in front of or behind, and no farther aside of than that: so deep
    was one that comes in through the surface and leaves the body sideways, where no facets are.

    Args:
        comm: The ranks.
        start: Of the places, (n, d) (length).
        end: Of the places, (n, d) (length).
        since: Time from which on to look, (n,).
        vertices: See `find_crossings`.
        facets: Those of this rank.

    Returns:
        (n,) (length); 0 for places that are under none, infinite where they move too far to tell.
    """
    first, n = comm.exscan(len(start)) or 0, len(start)
    start, end, since = (gather_rows(comm, rows) for rows in (start, end, since))
    if not len(start):
        return np.zeros(0)
    vertices = np.concatenate(comm.allgather(vertices))
    place, facet = _near(start, end, vertices, facets)
    corners = [facets.start[facet], facets.end[facet]]
    edges = [np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2) for x in corners]
    smallest = global_min(comm, np.stack(edges), empty=np.inf)
    ways = np.linalg.norm(end - start, axis=1)[place]
    ways = ways + np.linalg.norm(corners[1] - corners[0], axis=2).max(axis=1, initial=0.0)
    steps = 2 * global_max(comm, ways) / smallest if smallest > 0 else np.inf
    if not steps <= _MAX_PATH_TIMES:
        return np.full(n, np.inf)
    times = np.linspace(0.0, 1.0, 1 + int(np.ceil(steps)))[1:]
    moving = [
        _Pairs.of(start[place], end[place], facets, facet, piece) for piece in facets.pieces()
    ]
    nearest: Array = np.full((len(times), len(start)), np.inf)
    for number, time in enumerate(map(float, times)):
        rows = np.flatnonzero(since[place] <= time)
        for pairs in moving:
            distance = pairs.distance(rows, time)
            there = pairs.aside(rows, np.full(len(rows), time)) <= np.abs(distance)
            order = np.argsort(-np.abs(distance[there]), kind="stable")
            found: Array = np.full(len(start), np.inf)
            found[place[rows[there]][order]] = distance[there][order]
            row = nearest[number]
            nearest[number] = np.where(np.abs(found) < np.abs(row), found, row)
    everywhere = np.array(comm.allgather(nearest))
    of = np.abs(everywhere).argmin(axis=0)[None]
    nearest = np.take_along_axis(everywhere, of, axis=0)[0]
    depth = -np.where(np.isfinite(nearest), nearest, 0.0).min(axis=0, initial=0.0)
    return depth[first : first + n]


def _near(start: Array, end: Array, vertices: Index, facets: MovingFacets) -> tuple[Index, Index]:
    """Places and facets of this rank, pair by pair, whose ways come near each other."""
    none: Index = np.zeros(0, dtype=np.int64)
    if not (len(start) and len(facets.start)):
        return none, none
    d = start.shape[1]
    # Balls around the ways: of the places, and of the facets, whose corners they hold.
    centre, radius = _ball(np.stack([start, end], axis=1))
    corners = np.concatenate([facets.start, facets.end], axis=1)
    middle, reach = _ball(corners)
    # Most paths are far from all facets: only those that come near are compared one by one. Each
    # searches as far as the largest of the others reach: those that differ most in size search.
    place: Any
    facet: Any
    known = np.flatnonzero(np.isfinite(radius))  # not where an obstacle has no normal
    if not len(known):
        return none, none
    longest, widest = radius[known].max(), reach.max()
    if np.mean((reach + longest) ** (d - 1)) < np.mean((radius[known] + widest) ** (d - 1)):
        tree = scipy.spatial.cKDTree(centre[known])
        facet, place = near_pairs(tree, middle, reach + longest)
    else:
        tree = scipy.spatial.cKDTree(middle)
        place, facet = near_pairs(tree, centre[known], radius[known] + widest)
    place = known[place]
    near = np.linalg.norm(centre[place] - middle[facet], axis=1) <= radius[place] + reach[facet]
    near &= ~(vertices[place][:, :, None] == facets.vertices[facet][:, None, :]).any(axis=(1, 2))
    return place[near], facet[near]


def _crossings(start: Array, end: Array, vertices: Index, facets: MovingFacets) -> Array:
    """Rows of place, time, inward, depth, normal and facet, of facets of this rank."""
    d = start.shape[1]
    nothing: Array = np.zeros((0, 5 + d))
    place, facet = _near(start, end, vertices, facets)
    if not len(place):
        return nothing
    found = [nothing]
    for piece in facets.pieces():
        moving = _Pairs.of(start[place], end[place], facets, facet, piece)
        rows, time, inward = moving.through()
        met = moving.meets(rows, time)
        rows, time, inward = rows[met], time[met], inward[met]
        normal, depth = moving.normal(rows, time), -moving.distance(rows)
        columns = place[rows], time, np.where(inward, 1.0, -1.0), depth, normal, facet[rows]
        found.append(np.column_stack(columns))
    return np.concatenate(found)


@dataclass(frozen=True)
class _Pairs:
    """Places and flat facets, pair by pair: corners (n, d, d)."""

    start: Array
    end: Array
    corners_start: Array
    corners_end: Array
    sign: Array

    @classmethod
    def of(
        cls, start: Array, end: Array, facets: MovingFacets, facet: Index, piece: list[int]
    ) -> _Pairs:
        """Places, and pieces of the facets with these numbers."""
        corners = facets.start[facet][:, piece], facets.end[facet][:, piece]
        return cls(start, end, *corners, facets.sign[facet])

    def _at(self, time: Array | float, rows: Index | slice) -> tuple[Array, Array]:
        """Arms from the first corner to the place, (n, d), and tangents, (n, d - 1, d)."""
        t: Array = np.reshape(time, (-1, 1))
        place = (1 - t) * self.start[rows] + t * self.end[rows]
        t = t[:, :, None]
        corners = (1 - t) * self.corners_start[rows] + t * self.corners_end[rows]
        return place - corners[:, 0], corners[:, 1:] - corners[:, :1]

    def _across(self, tangents: Array, rows: Index | slice) -> Array:
        """Outward normals, of any length."""
        return self.sign[rows][:, None] * across(np.swapaxes(tangents, 1, 2))

    def side(self, time: Array | float, rows: Index | slice = slice(None)) -> Array:
        """Positive in front of the facet, negative behind it."""
        arm, tangents = self._at(time, rows)
        return np.asarray(np.sum(arm * self._across(tangents, rows), axis=1))

    def normal(self, rows: Index, time: Array) -> Array:
        """Outward unit normals, (n, d)."""
        return _unit(self._across(self._at(time, rows)[1], rows))

    def distance(self, rows: Index, time: float = 1.0) -> Array:
        """From the plane of the facet at a time, (n,) (length)."""
        arm, _ = self._at(time, rows)
        return np.asarray(np.sum(arm * self.normal(rows, np.full(len(rows), time)), axis=1))

    def through(self) -> tuple[Index, Array, Mask]:
        """Pairs of which the place goes through the plane of the facet, when, and whether inwards.

        `side` is a polynomial of degree d in time, and monotone between its turning points: in each
        part the plane is crossed once or not at all.
        """
        d = self.start.shape[1]
        times = np.arange(d + 1) / d
        values = np.stack([self.side(time) for time in times])
        cubic = np.zeros((4, len(self.start)))  # ascending powers
        cubic[: d + 1] = np.linalg.solve(np.vander(times, increasing=True), values)
        with np.errstate(all="ignore"):
            half = -(
                cubic[2] + np.copysign(np.sqrt(cubic[2] ** 2 - 3 * cubic[1] * cubic[3]), cubic[2])
            )
            turns = np.clip(np.nan_to_num([half / (3 * cubic[3]), cubic[1] / half]), 0.0, 1.0)
        knots = np.stack([np.zeros_like(half), *np.sort(turns, axis=0), np.ones_like(half)])
        front = np.stack([values[0], *polyval(knots[1:3], cubic, tensor=False), values[-1]]) >= 0
        part, rows = np.nonzero(front[1:] != front[:-1])
        low, high, inward = knots[part, rows], knots[part + 1, rows], front[part, rows]
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            same = (polyval(middle, cubic[:, rows], tensor=False) >= 0) == inward
            low, high = np.where(same, middle, low), np.where(same, high, middle)
        return rows, high, inward

    def meets(self, rows: Index, time: Array) -> Mask:
        """Whether the place is on the facet then."""
        shares, _ = self._barycentric(rows, time)
        return np.asarray(np.all(shares >= -NEGLIGIBLE, axis=1))

    def aside(self, rows: Index, time: Array) -> Array:
        """How far places are aside of the facet, in its plane, (n,) (length)."""
        shares, heights = self._barycentric(rows, time)
        return np.asarray(np.max(-shares * heights, axis=1, initial=0.0))

    def _barycentric(self, rows: Index, time: Array) -> tuple[Array, Array]:
        """Barycentric coordinates of places in the plane of the facet, and its heights, (n, d).

        Of degenerate facets they are infinitely far outside.
        """
        arm, tangents = self._at(time, rows)
        gram = np.einsum("nid,njd->nij", tangents, tangents)
        size = np.trace(gram, axis1=1, axis2=2)
        regular = np.abs(np.linalg.det(gram)) > 1e-24 * size ** gram.shape[1]
        gram[~regular] = np.eye(gram.shape[1])
        inverse = np.linalg.inv(gram)
        at = np.einsum("nij,njd,nd->ni", inverse, tangents, arm)
        shares = np.column_stack([1.0 - at.sum(axis=1), at])
        slopes = np.column_stack([inverse.sum(axis=(1, 2)), np.einsum("nii->ni", inverse)])
        shares[~regular] = -np.inf
        return shares, 1.0 / np.sqrt(slopes)


def _ball(points: Array) -> tuple[Array, Array]:
    """Centres, (n, d), and radii, (n,), of balls around points, (n, k, d)."""
    centre = (points.min(axis=1) + points.max(axis=1)) / 2
    return centre, np.linalg.norm(points - centre[:, None], axis=2).max(axis=1)


def _unit(vectors: Array) -> Array:
    """Vectors (n, d) at unit length; those of length zero, of degenerate facets, stay zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, np.finfo(float).tiny))
