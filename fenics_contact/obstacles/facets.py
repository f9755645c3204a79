"""Signed distance from a polyline or a mesh of triangles, with normals and curvature."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fenics_contact.obstacles.base import Sample
from fenics_contact.obstacles.refinement import refined, weighted_normals
from fenics_contact.obstacles.search import FacetSearch
from fenics_contact.types import Array, Index, Mask

__all__ = ["Facets"]

# Of the size of the surface: distance from an edge within which the direction to it is round-off;
# and difference of two distances that are the same, within which a place is at an edge or corner.
_AT_EDGE, _SAME = 1e-9, 1e-12
# Of that size, too: how far one may be away to be told from where exactly.
_AFAR = 1e6
# A facet of less than this share of its longest edge in height has no normal.
_FLAT = 1e-10


class Facets:
    """Segments in the plane or triangles in space, outwards where their order says.

    The sign at edges and corners is that of the pseudo-normal: the sum of the normals that meet
    there, each weighted by its angle [Bærentzen & Aanæs, IEEE Trans. Vis. Comput. Graph. 11 (2005)
    243-253]. Outside of an edge the distance is that from a line, with the curvature of a circle
    about it; from a corner that of a ball. Places from which the border of an open surface is
    closest are outside.

    Args:
        halvings: How often triangles are `refined` towards a smooth surface.
        sharp: Angle of edges that it keeps (radians).

    Attributes:
        points: Corners, (n_points, d) (length); equal ones that are given become one.
        facets: Their numbers, anticlockwise seen from outside; in the plane the outside is on the
            right of the way, (n_facets, d).
        closed: Whether the surface has no border.
        size: Its largest extent, or coordinate (length).

    Raises:
        ValueError: No facet has a normal, or neighbours are turned against each other.
    """

    def __init__(self, points: Array, facets: Index, halvings: int = 0, sharp: float = 0.0) -> None:
        self.points, self.facets = _welded(points, facets)
        if halvings:
            corners = self.points[self.facets]
            beyond = _beyond(self.facets, self.points)
            parts = refined(corners, _facet_normals(corners)[0], beyond, halvings, sharp)
            d = points.shape[1]
            self.points, self.facets = _welded(
                parts.reshape(-1, d), np.arange(parts[:, :, 0].size).reshape(-1, d)
            )
        self.size = float(np.abs(self.points).max())
        corners = self.points[self.facets]
        normals, has = _facet_normals(corners)
        if not has.any():
            raise ValueError("no facet has an area: all are degenerate to points or lines")
        whole, borders = self._pseudo_normals(corners, normals)
        self.closed = not borders.any()
        # Facets without a normal have their part at edges and corners: neighbours cover them.
        self._corners, self._normals, self._borders = corners[has], whole[has], borders[has]
        self._spans = np.roll(self._corners, -1, axis=1) - self._corners
        self._search = FacetSearch(self._corners)

    def _pseudo_normals(self, corners: Array, normals: Array) -> tuple[Array, Mask]:
        """Unit normals at a facet, its edges (in space) and its corners; which are a border.

        Returns:
            (n_facets, n_features, d) and (n_facets, n_features); feature 0 is the facet.
        """
        m, d = self.facets.shape
        at_corners = np.zeros_like(self.points)
        borders = np.zeros((m, 1 if d == 2 else 4), dtype=np.bool_)
        whole = normals[:, None, :]
        if d == 2:
            for k in range(2):
                np.add.at(at_corners, self.facets[:, k], normals)
            begins = np.bincount(self.facets[:, 0], minlength=len(self.points))
            ends = np.bincount(self.facets[:, 1], minlength=len(self.points))
            _check_order(begins, ends, self.points)
            at_border = begins != ends
        else:
            weighted = weighted_normals(corners, normals)
            for k in range(3):
                np.add.at(at_corners, self.facets[:, k], weighted[:, k])
            beyond = _beyond(self.facets, self.points)
            neighbour = np.where(beyond < 0, -1, beyond // 3)
            beside = np.where((neighbour >= 0)[:, :, None], normals[neighbour], 0.0)
            whole = np.concatenate([whole, whole + beside], axis=1)
            borders[:, 1:] = neighbour < 0
            at_border = np.zeros(len(self.points), dtype=np.bool_)
            for k in range(3):
                at_border[self.facets[neighbour[:, k] < 0][:, [k, (k + 1) % 3]]] = True
        whole = np.concatenate([whole, at_corners[self.facets]], axis=1)
        length = np.linalg.norm(whole, axis=2, keepdims=True)
        # Where two sheets lie back to back they cancel.
        whole = np.where(length > _FLAT, whole, normals[:, None, :])
        whole /= np.maximum(np.linalg.norm(whole, axis=2, keepdims=True), 1e-300)
        return whole, np.concatenate([borders, at_border[self.facets]], axis=1)

    def sample(self, x: Array) -> Sample:
        """Return signed distance, normal and curvature at points (n, gdim)."""
        d = x.shape[1]
        # From afar all facets are as far away as round-off can tell: the rest of the way is added.
        reach = np.linalg.norm(x, axis=1)
        share = _AFAR * self.size / np.maximum(reach, _AFAR * self.size)
        x, rest = share[:, None] * x, (1.0 - share) * reach
        facet = self._search.closest(x, self._distance, _SAME * self.size)
        foot, feature = self._foot(x, facet)
        outward = self._normals[facet, feature]
        arm = x - foot
        length = np.linalg.norm(arm, axis=1)
        along = np.einsum("ij,ij->i", arm, outward)
        side = np.where((along >= 0) | self._borders[facet, feature], 1.0, -1.0)
        on_facet = feature == 0
        distance = np.where(on_facet, along, side * length)
        far = ~on_facet & (length > _AT_EDGE * self.size)
        radius = np.where(far, distance, 1.0)
        slope = np.where(far[:, None], arm / radius[:, None], outward)
        across = np.eye(d) - np.einsum("ni,nj->nij", slope, slope)
        if d == 3:
            edge = (feature >= 1) & (feature <= 3)
            line = self._spans[facet, np.where(edge, feature - 1, 0)]
            line = np.where(edge[:, None], line / np.linalg.norm(line, axis=1)[:, None], 0.0)
            across -= np.einsum("ni,nj->nij", line, line)
        curvature = np.where(far[:, None, None], across / radius[:, None, None], 0.0)
        return Sample(distance + rest, -slope, curvature)

    def _distance(self, x: Array, facet: Index) -> Array:
        return np.linalg.norm(x - self._foot(x, facet)[0], axis=1)

    def _foot(self, x: Array, facet: Index) -> tuple[Array, Index]:
        """The closest point of one facet for each point, and the part of the facet it is on."""
        corners, spans = self._corners[facet], self._spans[facet]
        d = x.shape[1]
        edges = 1 if d == 2 else 3
        arms = x[:, None, :] - corners[:, :edges]
        square = np.einsum("nki,nki->nk", spans[:, :edges], spans[:, :edges])
        share = np.einsum("nki,nki->nk", arms, spans[:, :edges]) / square
        share = np.clip(share, 0.0, 1.0)
        feet = corners[:, :edges] + share[:, :, None] * spans[:, :edges]
        if d == 2:
            share, foot = share[:, 0], feet[:, 0]
            away = np.linalg.norm(x[:, None, :] - corners, axis=2)
            at = away <= _SAME * self.size
            begins, ends = (share <= 0.0) | at[:, 0], (share >= 1.0) | at[:, 1]
            return foot, np.where(begins, 1, np.where(ends, 2, 0))
        normal = self._normals[facet, 0]
        inward = np.cross(normal[:, None, :], spans)
        inside = np.all(np.einsum("nki,nki->nk", arms, inward) >= 0.0, axis=1)
        rows = np.arange(len(x))
        away = np.linalg.norm(x[:, None, :] - feet, axis=2)
        best = np.argmin(away, axis=1)
        inside &= away[rows, best] > _SAME * self.size
        along = share[rows, best]
        reach = _SAME * self.size / np.sqrt(square[rows, best])
        begins, ends = along <= reach, along >= 1.0 - reach
        at_end = np.where(begins, 4 + best, 4 + (best + 1) % 3)
        feature = np.where(begins | ends, at_end, 1 + best)
        height = np.einsum("ni,ni->n", arms[:, 0], normal)
        flat = x - height[:, None] * normal
        foot = np.where(inside[:, None], flat, feet[rows, best])
        return foot, np.where(inside, 0, feature)


def _welded(points: Array, facets: Index) -> tuple[Array, Index]:
    """Distinct corners, and the facets that have as many of them."""
    distinct, number = np.unique(points, axis=0, return_inverse=True)
    facets = number.reshape(-1)[facets]
    ordered = np.sort(facets, axis=1)
    return distinct, facets[np.all(ordered[:, 1:] > ordered[:, :-1], axis=1)]


def _facet_normals(corners: Array) -> tuple[Array, Mask]:
    """Unit normals of facets, zero where there is none, and where there are: (n, d), (n,)."""
    spans = np.roll(corners, -1, axis=1) - corners
    if corners.shape[2] == 2:
        normals: Array = np.stack([spans[:, 0, 1], -spans[:, 0, 0]], axis=1)
        has = np.ones(len(corners), dtype=np.bool_)
    else:
        normals = np.asarray(np.cross(spans[:, 0], spans[:, 1]), dtype=np.float64)
        longest = np.sum(spans**2, axis=2).max(axis=1)
        has = np.linalg.norm(normals, axis=1) > _FLAT * longest
    length = np.where(has, np.linalg.norm(normals, axis=1), np.inf)
    return normals / length[:, None], has


def _beyond(facets: Index, points: Array) -> Index:
    """Of every edge of triangles the number of its other side, -1 where there is none: (n, 3)."""
    start, end, n_points = facets, np.roll(facets, -1, axis=1), len(points)
    forward = (start * n_points + end).ravel()
    backward = (end * n_points + start).ravel()
    keys, first, counts = np.unique(forward, return_index=True, return_counts=True)
    middles = (points[keys // n_points] + points[keys % n_points]) / 2
    _check_order(counts, np.ones_like(counts), middles)
    place = np.minimum(np.searchsorted(keys, backward), len(keys) - 1)
    found = np.where(keys[place] == backward, first[place], -1)
    return np.asarray(found.reshape(-1, 3), dtype=np.intp)


def _check_order(
    ways: npt.NDArray[np.integer], back: npt.NDArray[np.integer], places: Array
) -> None:
    bad = np.flatnonzero((ways > 1) | (back > 1))
    if len(bad):
        first = ", ".join(f"{v:.4g}" for v in places[bad[0]])
        raise ValueError(
            f"at {len(bad)} edges or corners, one of them at ({first}), neighbours have opposite "
            "orientations, or more than two facets meet: order the corners of every facet "
            "anticlockwise seen from outside of the obstacle (in the plane: with the obstacle on "
            "the left), give each facet once, and make bodies that touch each other separate "
            "obstacles"
        )
