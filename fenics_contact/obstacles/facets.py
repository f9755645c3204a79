"""Signed distance from a polyline or a mesh of triangles, with normals and curvature."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fenics_contact.obstacles.base import Sample
from fenics_contact.obstacles.refinement import refine, weighted_normals
from fenics_contact.obstacles.search import FacetSearch
from fenics_contact.tolerances import NEGLIGIBLE, ROUND_OFF
from fenics_contact.types import Array, Index, Mask

__all__ = ["Facets"]

# Largest resolved distance relative to the size of the surface. A negligible distance from an edge
# has no direction; at an edge or corner distances from facets are equal up to round-off.
_FAR_RATIO = 1e6


class Facets:
    """Signed distance from oriented segments in 2D or triangles in 3D.

    The sign at edges and corners is that of the angle-weighted pseudo-normal [Bærentzen & Aanæs,
    IEEE Trans. Vis. Comput. Graph. 11 (2005) 243-253]. The curvature outside of an edge is that of
    a circular cylinder, outside of a corner that of a ball. Points whose closest point is on the
    boundary of an open surface are outside.

    Args:
        halvings: Number of refinements of triangles towards a smooth surface.
        sharp: Angle from which on edges remain sharp (radians).

    Attributes:
        points: Distinct corners, (n_points, d) (length).
        facets: Corner numbers, anticlockwise seen from outside; in 2D with the outside on the
            right, (n_facets, d).
        closed: Whether the surface has no boundary.
        size: Largest coordinate (length).

    Raises:
        ValueError: No facet has a normal, or neighbours have opposite orientations.
    """

    def __init__(self, points: Array, facets: Index, halvings: int = 0, sharp: float = 0.0) -> None:
        self.points, self.facets = _merge_points(points, facets)
        if halvings:
            corners = self.points[self.facets]
            opposite = _find_opposite_edges(self.facets, self.points)
            parts = refine(corners, _facet_normals(corners)[0], opposite, halvings, sharp)
            d = points.shape[1]
            self.points, self.facets = _merge_points(
                parts.reshape(-1, d), np.arange(parts[:, :, 0].size).reshape(-1, d)
            )
        self.size = float(np.abs(self.points).max())
        corners = self.points[self.facets]
        normals, rows = _facet_normals(corners)
        if not rows.any():
            raise ValueError("no facet has an area: all are degenerate to points or lines")
        pseudo, boundary = self._pseudo_normals(corners, normals)
        self.closed = not boundary.any()
        # Degenerate facets are covered by the edges and corners of their neighbours.
        self._corners, self._normals, self._boundary = corners[rows], pseudo[rows], boundary[rows]
        self._spans = np.roll(self._corners, -1, axis=1) - self._corners
        self._search = FacetSearch(self._corners)

    def _pseudo_normals(self, corners: Array, normals: Array) -> tuple[Array, Mask]:
        """Return unit pseudo-normals of facets, edges (3D) and corners, and boundary flags.

        Shapes are (n_facets, n_features, d) and (n_facets, n_features); feature 0 is the facet.
        """
        m, d = self.facets.shape
        at_corners = np.zeros_like(self.points)
        boundary = np.zeros((m, 1 if d == 2 else 4), dtype=np.bool_)
        pseudo = normals[:, None, :]
        if d == 2:
            for k in range(2):
                np.add.at(at_corners, self.facets[:, k], normals)
            starts = np.bincount(self.facets[:, 0], minlength=len(self.points))
            ends = np.bincount(self.facets[:, 1], minlength=len(self.points))
            _check_order(starts, ends, self.points)
            boundary_points = starts != ends
        else:
            weighted = weighted_normals(corners, normals)
            for k in range(3):
                np.add.at(at_corners, self.facets[:, k], weighted[:, k])
            opposite = _find_opposite_edges(self.facets, self.points)
            neighbour = np.where(opposite < 0, -1, opposite // 3)
            neighbour_normals = np.where((neighbour >= 0)[:, :, None], normals[neighbour], 0.0)
            pseudo = np.concatenate([pseudo, pseudo + neighbour_normals], axis=1)
            boundary[:, 1:] = neighbour < 0
            boundary_points = np.zeros(len(self.points), dtype=np.bool_)
            for k in range(3):
                boundary_points[self.facets[neighbour[:, k] < 0][:, [k, (k + 1) % 3]]] = True
        pseudo = np.concatenate([pseudo, at_corners[self.facets]], axis=1)
        length = np.linalg.norm(pseudo, axis=2, keepdims=True)
        # Normals of two sheets back to back cancel.
        pseudo = np.where(length > NEGLIGIBLE, pseudo, normals[:, None, :])
        pseudo /= np.maximum(np.linalg.norm(pseudo, axis=2, keepdims=True), 1e-300)
        return pseudo, np.concatenate([boundary, boundary_points[self.facets]], axis=1)

    def sample(self, x: Array) -> Sample:
        """Return signed distance, normal and curvature at points (n, gdim)."""
        d = x.shape[1]
        # Points beyond the resolved distance are scaled back, and the remaining distance is added.
        reach = np.linalg.norm(x, axis=1)
        scale = _FAR_RATIO * self.size / np.maximum(reach, _FAR_RATIO * self.size)
        x, rest = scale[:, None] * x, (1.0 - scale) * reach
        facet = self._search.find_closest(x, self._distance, ROUND_OFF * self.size)
        projection, feature = self._project(x, facet)
        outward = self._normals[facet, feature]
        arm = x - projection
        length = np.linalg.norm(arm, axis=1)
        height = np.einsum("ij,ij->i", arm, outward)
        side = np.where((height >= 0) | self._boundary[facet, feature], 1.0, -1.0)
        on_facet = feature == 0
        distance = np.where(on_facet, height, side * length)
        far = ~on_facet & (length > NEGLIGIBLE * self.size)
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
        return np.linalg.norm(x - self._project(x, facet)[0], axis=1)

    def _project(self, x: Array, facet: Index) -> tuple[Array, Index]:
        """Project each point on one facet; return the closest points and their features."""
        corners, spans = self._corners[facet], self._spans[facet]
        d = x.shape[1]
        edges = 1 if d == 2 else 3
        arms = x[:, None, :] - corners[:, :edges]
        square = np.einsum("nki,nki->nk", spans[:, :edges], spans[:, :edges])
        fraction = np.einsum("nki,nki->nk", arms, spans[:, :edges]) / square
        fraction = np.clip(fraction, 0.0, 1.0)
        projections = corners[:, :edges] + fraction[:, :, None] * spans[:, :edges]
        if d == 2:
            fraction, projection = fraction[:, 0], projections[:, 0]
            distances = np.linalg.norm(x[:, None, :] - corners, axis=2)
            at_corner = distances <= ROUND_OFF * self.size
            starts, ends = (fraction <= 0.0) | at_corner[:, 0], (fraction >= 1.0) | at_corner[:, 1]
            return projection, np.where(starts, 1, np.where(ends, 2, 0))
        normal = self._normals[facet, 0]
        inward = np.cross(normal[:, None, :], spans)
        inside = np.all(np.einsum("nki,nki->nk", arms, inward) >= 0.0, axis=1)
        rows = np.arange(len(x))
        distances = np.linalg.norm(x[:, None, :] - projections, axis=2)
        best = np.argmin(distances, axis=1)
        inside &= distances[rows, best] > ROUND_OFF * self.size
        position = fraction[rows, best]
        reach = ROUND_OFF * self.size / np.sqrt(square[rows, best])
        starts, ends = position <= reach, position >= 1.0 - reach
        at_end = np.where(starts, 4 + best, 4 + (best + 1) % 3)
        feature = np.where(starts | ends, at_end, 1 + best)
        height = np.einsum("ni,ni->n", arms[:, 0], normal)
        in_plane = x - height[:, None] * normal
        projection = np.where(inside[:, None], in_plane, projections[rows, best])
        return projection, np.where(inside, 0, feature)


def _merge_points(points: Array, facets: Index) -> tuple[Array, Index]:
    """Merge equal corners and remove facets with coincident ones."""
    distinct, number = np.unique(points, axis=0, return_inverse=True)
    facets = number.reshape(-1)[facets]
    ordered = np.sort(facets, axis=1)
    return distinct, facets[np.all(ordered[:, 1:] > ordered[:, :-1], axis=1)]


def _facet_normals(corners: Array) -> tuple[Array, Mask]:
    """Return unit normals of facets, zero if degenerate, and a validity mask, (n, d), (n,)."""
    spans = np.roll(corners, -1, axis=1) - corners
    if corners.shape[2] == 2:
        normals: Array = np.stack([spans[:, 0, 1], -spans[:, 0, 0]], axis=1)
        valid = np.ones(len(corners), dtype=np.bool_)
    else:
        normals = np.asarray(np.cross(spans[:, 0], spans[:, 1]), dtype=np.float64)
        longest = np.sum(spans**2, axis=2).max(axis=1)
        valid = np.linalg.norm(normals, axis=1) > NEGLIGIBLE * longest
    length = np.where(valid, np.linalg.norm(normals, axis=1), np.inf)
    return normals / length[:, None], valid


def _find_opposite_edges(facets: Index, points: Array) -> Index:
    """Return the number of the opposite half-edge of every triangle edge, -1 if none, (n, 3)."""
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
    forward: npt.NDArray[np.integer], backward: npt.NDArray[np.integer], places: Array
) -> None:
    bad = np.flatnonzero((forward > 1) | (backward > 1))
    if len(bad):
        first = ", ".join(f"{v:.4g}" for v in places[bad[0]])
        raise ValueError(
            f"at {len(bad)} edges or corners, one of them at ({first}), neighbours have opposite "
            "orientations, or more than two facets meet: order the corners of every facet "
            "anticlockwise seen from outside of the obstacle (in the plane: with the obstacle on "
            "the left), give each facet once, and make bodies that touch each other separate "
            "obstacles"
        )
