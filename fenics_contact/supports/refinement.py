"""Triangles of a smooth surface, halved towards it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from fenics_contact.types import Array, Mask

__all__ = ["refined"]

Numbers = npt.NDArray[np.intp]

# Corners and edges of the four triangles that one is halved to, among its corners (0, 1, 2) and the
# middles of its edges (3, 4, 5); an edge within it is -1.
_PARTS = ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))
_EDGES = ((0, -1, 2), (0, 1, -1), (-1, 1, 2), (-1, -1, -1))


def refined(corners: Array, normals: Array, beyond: Numbers, times: int, sharp: float) -> Array:
    """Triangles whose edges are halved, new corners where a smooth surface has them.

    The middle of an edge lies on the cubic that its ends and the normals there give, that of the
    curved point-normal triangles of Vlachos, Peters, Boyd & Mitchell, Proc. I3D (2001) 159-166; so
    does its normal. Normals at a corner are the mean, weighted by angles, of the triangles that
    follow each other around it across edges that are not sharp. Sharp edges and borders stay.

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
    fixed = (beyond < 0) | (np.einsum("ti,tki->tk", normals, other) < np.cos(sharp))
    at_corners = _corner_normals(corners, normals, beyond, fixed)
    for _ in range(times):
        ends, end_normals = np.roll(corners, -1, axis=1), np.roll(at_corners, -1, axis=1)
        span, both = ends - corners, at_corners + end_normals
        one = np.einsum("tki,tki->tk", span, at_corners)[:, :, None] * at_corners
        two = np.einsum("tki,tki->tk", -span, end_normals)[:, :, None] * end_normals
        middle = (corners + ends) / 2 - np.where(fixed[:, :, None], 0.0, (one + two) / 8)
        share = 2 * np.einsum("tki,tki->tk", span, both) / np.sum(span**2, axis=2)
        turned = both - share[:, :, None] * span
        turned /= np.linalg.norm(turned, axis=2, keepdims=True)
        points = np.concatenate([corners, middle], axis=1)
        directions = np.concatenate([at_corners, turned], axis=1)
        within = np.concatenate([fixed, np.zeros((len(fixed), 1), dtype=np.bool_)], axis=1)
        corners = np.concatenate([points[:, part] for part in _PARTS])
        at_corners = np.concatenate([directions[:, part] for part in _PARTS])
        fixed = np.concatenate([within[:, edges] for edges in _EDGES])
    return corners


def _corner_normals(corners: Array, normals: Array, beyond: Numbers, fixed: Mask) -> Array:
    """Unit normals at the corners of each triangle, (m, 3, 3)."""
    m = len(corners)
    spans = np.roll(corners, -1, axis=1) - corners
    weighted = np.empty_like(corners)
    for k in range(3):
        across = np.linalg.norm(np.cross(spans[:, k], spans[:, k - 1]), axis=1)
        angle = np.arctan2(across, -np.einsum("ij,ij->i", spans[:, k], spans[:, k - 1]))
        weighted[:, k] = angle[:, None] * normals
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
