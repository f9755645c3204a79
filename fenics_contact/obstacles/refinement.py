"""Refinement of triangles towards a smooth surface by curved point-normal triangles."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from fenics_contact.types import Array, Index, Mask

__all__ = ["refine", "weighted_normals"]

# Corners of the four refined triangles among corners (0, 1, 2) and edge midpoints (3, 4, 5); their
# edges among the halves of the edges (0 to 5) and interior ones (6).
_CHILDREN = ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))
_EDGES = ((0, 6, 5), (1, 2, 6), (6, 3, 4), (6, 6, 6))
# Smallest squared sine of the angle between the normals at an edge that is curved.
_MIN_SINE_SQUARED = 0.01


def refine(corners: Array, normals: Array, opposite: Index, times: int, sharp: float) -> Array:
    """Refine triangles uniformly, with new corners on a smooth surface.

    Edge midpoints and their normals follow the cubic edges of curved point-normal triangles
    [Vlachos, Peters, Boyd & Mitchell, Proc. I3D (2001) 159-166]. Corner normals are angle-weighted
    means over triangles connected by edges that are not sharp. Sharp edges have two normals at
    their ends, and both determine the curve.

    Args:
        corners: Corners of the triangles, (m, 3, 3).
        normals: Unit normals, or zero for degenerate triangles, (m, 3).
        opposite: Opposite half-edge of each edge, 3 triangle + local edge, or -1, (m, 3).
        times: Number of refinements.
        sharp: Smallest angle between the normals at a sharp edge (radians).

    Returns:
        Corners of the new triangles, (4^times m, 3, 3), identical from both sides of an edge.
    """
    other = normals[opposite // 3]
    sharp_edge = np.einsum("ti,tki->tk", normals, other) < np.cos(sharp)
    at_corners = _corner_normals(corners, normals, opposite, (opposite < 0) | sharp_edge)
    # Normals of the other side of sharp edges, at both ends.
    ends = np.stack([3 * (opposite // 3) + (opposite % 3 + 1) % 3, opposite], axis=2)
    across = np.where(sharp_edge & (opposite >= 0), 1.0, 0.0)[:, :, None, None]
    across = across * at_corners.reshape(-1, 3)[ends]
    for _ in range(times):
        span = np.roll(corners, -1, axis=1) - corners
        end_normals = np.roll(at_corners, -1, axis=1)
        bend = _bend(span, at_corners, across[:, :, 0]) + _bend(-span, end_normals, across[:, :, 1])
        middle = (corners + np.roll(corners, -1, axis=1)) / 2 - bend / 8
        midpoint_normals = _midpoint_normal(span, at_corners, end_normals)
        across_midpoint = _midpoint_normal(span, across[:, :, 0], across[:, :, 1])
        halves = np.zeros((len(corners), 7, 2, 3))
        halves[:, 0:6:2, 0], halves[:, 0:6:2, 1] = across[:, :, 0], across_midpoint
        halves[:, 1:6:2, 0], halves[:, 1:6:2, 1] = across_midpoint, across[:, :, 1]
        points = np.concatenate([corners, middle], axis=1)
        directions = np.concatenate([at_corners, midpoint_normals], axis=1)
        corners = np.concatenate([points[:, part] for part in _CHILDREN])
        at_corners = np.concatenate([directions[:, part] for part in _CHILDREN])
        across = np.concatenate([halves[:, edges] for edges in _EDGES])
    return corners


def weighted_normals(corners: Array, normals: Array) -> Array:
    """Weight normals of triangles, (m, 3), by the angles at their corners, (m, 3, 3)."""
    spans = np.roll(corners, -1, axis=1) - corners
    weighted = np.empty_like(corners)
    for k in range(3):
        cross = np.linalg.norm(np.cross(spans[:, k], spans[:, k - 1]), axis=1)
        angle = np.arctan2(cross, -np.einsum("ij,ij->i", spans[:, k], spans[:, k - 1]))
        weighted[:, k] = angle[:, None] * normals
    return weighted


def _bend(span: Array, normal: Array, other: Array) -> Array:
    """Return the shortest vector with the span's components along two normals; one may be 0."""
    cosine = np.sum(normal * other, axis=2, keepdims=True)
    one = np.sum(span * normal, axis=2, keepdims=True)
    two = np.sum(span * other, axis=2, keepdims=True)
    square = 1 - cosine**2
    is_curved = square > _MIN_SINE_SQUARED
    first, second = one - cosine * two, two - cosine * one
    bend = (first * normal + second * other) / np.where(is_curved, square, 1.0)
    return np.asarray(np.where(is_curved, bend, 0.0))


def _midpoint_normal(span: Array, one: Array, two: Array) -> Array:
    """Return normals at edge midpoints from those at the ends; 0 for zero normals."""
    both = one + two
    factor = 2 * np.sum(span * both, axis=2) / np.sum(span**2, axis=2)
    reflected = both - factor[:, :, None] * span
    length = np.linalg.norm(reflected, axis=2, keepdims=True)
    return np.asarray(reflected / np.where(length > 0, length, 1.0))


def _corner_normals(corners: Array, normals: Array, opposite: Index, is_cut: Mask) -> Array:
    """Return unit normals at the corners of each triangle, (m, 3, 3)."""
    m, weighted = len(corners), weighted_normals(corners, normals)
    edge = np.flatnonzero(~is_cut.ravel())
    opposite_edge = opposite.ravel()[edge]
    next_corner, opposite_next = (3 * (e // 3) + (e % 3 + 1) % 3 for e in (edge, opposite_edge))
    # Opposite half-edges have opposite directions.
    pairs = np.concatenate([edge, next_corner]), np.concatenate([opposite_next, opposite_edge])
    graph = coo_matrix((np.ones(len(pairs[0])), pairs), shape=(3 * m, 3 * m))
    _, group = connected_components(graph, directed=False)
    sums = np.zeros((group.max() + 1, 3))
    np.add.at(sums, group, weighted.reshape(-1, 3))
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    sums /= np.where(length > 0, length, 1.0)
    return np.asarray(sums[group].reshape(-1, 3, 3))
