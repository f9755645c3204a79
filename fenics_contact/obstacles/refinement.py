"""Triangles of a smooth surface, halved towards it."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from fenics_contact.types import Array, Index, Mask

__all__ = ["refined", "weighted_normals"]

# Corners of the four triangles that one is halved to, among its own (0, 1, 2) and the middles of
# its edges (3, 4, 5); and their edges, two halves of each of its own, and 6 within it.
_PARTS = ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))
_EDGES = ((0, 6, 5), (1, 2, 6), (6, 3, 4), (6, 6, 6))
# Square of the sine of the angle below which an edge is so sharp that it stays.
_BLADE = 0.01


def refined(corners: Array, normals: Array, beyond: Index, times: int, sharp: float) -> Array:
    """Triangles whose edges are halved, new corners where a smooth surface has them.

    The middle of an edge lies on the cubic that its ends and the normals there give, that of the
    curved point-normal triangles of Vlachos, Peters, Boyd & Mitchell, Proc. I3D (2001) 159-166; so
    does its normal. Normals at a corner are the mean, weighted by angles, of the triangles that
    follow each other around it across edges that are not sharp. A sharp edge has two normals at
    its ends, and bends as both say.

    Args:
        corners: Of the triangles, (m, 3, 3).
        normals: Theirs, of length 1, or 0 where there is none, (m, 3).
        beyond: Number of the edge, 3 times that of its triangle plus its own, that is the other
            side of each edge; -1: none. (m, 3).
        times: How often.
        sharp: Angle between normals from which on an edge is sharp (radians).

    Returns:
        Corners of the new triangles, (4^times m, 3, 3), the same digits from both sides.
    """
    other = normals[beyond // 3]
    sharp_edge = np.einsum("ti,tki->tk", normals, other) < np.cos(sharp)
    at_corners = _corner_normals(corners, normals, beyond, (beyond < 0) | sharp_edge)
    # Normals of the other side where it is another surface, at both ends of every edge.
    ends = np.stack([3 * (beyond // 3) + (beyond % 3 + 1) % 3, beyond], axis=2)
    across = np.where(sharp_edge & (beyond >= 0), 1.0, 0.0)[:, :, None, None]
    across = across * at_corners.reshape(-1, 3)[ends]
    for _ in range(times):
        span = np.roll(corners, -1, axis=1) - corners
        end_normals = np.roll(at_corners, -1, axis=1)
        bend = _bend(span, at_corners, across[:, :, 0]) + _bend(-span, end_normals, across[:, :, 1])
        middle = (corners + np.roll(corners, -1, axis=1)) / 2 - bend / 8
        between = _between(span, at_corners, end_normals)
        beside = _between(span, across[:, :, 0], across[:, :, 1])
        halves = np.zeros((len(corners), 7, 2, 3))
        halves[:, 0:6:2, 0], halves[:, 0:6:2, 1] = across[:, :, 0], beside
        halves[:, 1:6:2, 0], halves[:, 1:6:2, 1] = beside, across[:, :, 1]
        points = np.concatenate([corners, middle], axis=1)
        directions = np.concatenate([at_corners, between], axis=1)
        corners = np.concatenate([points[:, part] for part in _PARTS])
        at_corners = np.concatenate([directions[:, part] for part in _PARTS])
        across = np.concatenate([halves[:, edges] for edges in _EDGES])
    return corners


def weighted_normals(corners: Array, normals: Array) -> Array:
    """Normals of triangles, (m, 3), times the angle at each of their corners, (m, 3, 3)."""
    spans = np.roll(corners, -1, axis=1) - corners
    weighted = np.empty_like(corners)
    for k in range(3):
        across = np.linalg.norm(np.cross(spans[:, k], spans[:, k - 1]), axis=1)
        angle = np.arctan2(across, -np.einsum("ij,ij->i", spans[:, k], spans[:, k - 1]))
        weighted[:, k] = angle[:, None] * normals
    return weighted


def _bend(span: Array, normal: Array, other: Array) -> Array:
    """The shortest vector with the span's parts along two normals, one of which may be 0."""
    cosine = np.sum(normal * other, axis=2, keepdims=True)
    one = np.sum(span * normal, axis=2, keepdims=True)
    two = np.sum(span * other, axis=2, keepdims=True)
    square = 1 - cosine**2
    bends = square > _BLADE
    along, aside = one - cosine * two, two - cosine * one
    bend = (along * normal + aside * other) / np.where(bends, square, 1.0)
    return np.asarray(np.where(bends, bend, 0.0))


def _between(span: Array, one: Array, two: Array) -> Array:
    """Normals in the middle of edges, of those at their ends; 0 between zeros."""
    both = one + two
    share = 2 * np.sum(span * both, axis=2) / np.sum(span**2, axis=2)
    turned = both - share[:, :, None] * span
    length = np.linalg.norm(turned, axis=2, keepdims=True)
    return np.asarray(turned / np.where(length > 0, length, 1.0))


def _corner_normals(corners: Array, normals: Array, beyond: Index, fixed: Mask) -> Array:
    """Unit normals at the corners of each triangle, (m, 3, 3)."""
    m, weighted = len(corners), weighted_normals(corners, normals)
    edge = np.flatnonzero(~fixed.ravel())
    back = beyond.ravel()[edge]
    after, back_after = (3 * (e // 3) + (e % 3 + 1) % 3 for e in (edge, back))
    # An edge runs the other way on its other side: its end is there the beginning.
    pairs = np.concatenate([edge, after]), np.concatenate([back_after, back])
    graph = coo_matrix((np.ones(len(pairs[0])), pairs), shape=(3 * m, 3 * m))
    _, group = connected_components(graph, directed=False)
    sums = np.zeros((group.max() + 1, 3))
    np.add.at(sums, group, weighted.reshape(-1, 3))
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    sums /= np.where(length > 0, length, 1.0)
    return np.asarray(sums[group].reshape(-1, 3, 3))
