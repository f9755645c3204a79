"""Bounds of the penetration between quadrature points, from gap and normals at points nearby."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI

from fenics_contact.parallel import gather_rows
from fenics_contact.types import Array, Index

__all__ = [
    "ALLOWED_BEFORE",
    "DEPTH_RESOLUTION",
    "OPPOSITE_SIDES",
    "PREDICTED_DEPTH",
    "ResistedDepth",
    "allowed_depth",
    "dot",
    "gather_around",
    "predicted_depth",
]

# Depths relative to the size of the facet. If the points predict it, more penetration is allowed
# than that of the points around: the corner of a facet is 0.2 of its size away from the nearest one
# (of two), and a tilted facet is as deep there before the point is in contact. Tangent planes,
# which also predict a pin between the points, count as much only where a point is in contact.
PREDICTED_DEPTH, _DEPTH_BY_PLANES_OPEN = 0.2, 0.05
# Difference of the penetration between two quadrature rules.
DEPTH_RESOLUTION = 0.02
# Largest penetration that was allowed at the last commit where no point is in contact.
ALLOWED_BEFORE = PREDICTED_DEPTH + DEPTH_RESOLUTION
# Cosine of the angle between the normals of opposite sides of an obstacle: 120 degrees and more.
OPPOSITE_SIDES = -0.5


@dataclass(frozen=True)
class ResistedDepth:
    """Largest penetration resisted by the contact law, by vertex of the facets.

    Attributes:
        vertices: Global numbers of the vertices, ascending, (n,).
        depth: Largest penetration of the points on the facets around each, (n,) (length).
    """

    vertices: Index
    depth: Array

    @classmethod
    def of(cls, comm: MPI.Comm, vertices: Sequence[Index], depth: Sequence[Array]) -> ResistedDepth:
        """Gather the depth (n,) at facets with corners (n, n_corners) of all ranks. Collective."""
        number: Any = np.zeros(0, dtype=np.int64)
        value: Any = np.zeros(0)
        for corners, depths in zip(vertices, depth, strict=True):
            number = np.append(number, corners[depths > 0].ravel())
            value = np.append(value, np.repeat(depths[depths > 0], corners.shape[1]))
        number, value = (np.concatenate(comm.allgather(rows)) for rows in (number, value))
        unique, index = np.unique(number, return_inverse=True)
        largest = np.zeros(len(unique))
        np.maximum.at(largest, index, value)
        return cls(unique, largest)

    def at(self, vertices: Index) -> Array:
        """Return the largest depth at the corners (n, n_corners) of facets, (n,) (length)."""
        if not len(self.vertices):
            return np.zeros(len(vertices))
        index = np.minimum(np.searchsorted(self.vertices, vertices), len(self.vertices) - 1)
        depth = np.where(self.vertices[index] == vertices, self.depth[index], 0.0)
        return np.asarray(depth.max(axis=1, initial=0.0))


def gather_around(
    comm: MPI.Comm, corners: Index, resisted: Array, *fields: Array
) -> tuple[Array, ...]:
    """Collect fields at the points of every facet and at a point around each corner. Collective.

    For each corner the deepest point in contact on the facets around it is added: where the
    opposing surface ends below a facet, no point of the facet itself may have an opposite point.

    Args:
        comm: Communicator.
        corners: Global numbers of the vertices of this rank's facets, (n, n_corners).
        resisted: Penetration at their points that the law resists, (n, n_points) (length).
        fields: Fields at the points, (n, n_points, gdim) each.

    Returns:
        The fields, (n, n_points + n_corners, gdim) each, NaN without a point.
    """
    n, n_corners = corners.shape
    deepest = (np.arange(n), resisted.argmax(axis=1)) if n else (np.arange(0), np.arange(0))
    rows = np.column_stack([-resisted[deepest], *(field[deepest] for field in fields)])
    is_known = (rows[:, 0] < 0) & ~np.isnan(rows).any(axis=1)
    table = np.repeat(rows[is_known], n_corners, axis=0)
    table = gather_rows(comm, np.column_stack([corners[is_known].ravel(), table]))
    table = table[np.lexsort(table.T[::-1])]
    vertices, first = np.unique(table[:, 0], return_index=True)
    table = np.concatenate([table[first, 2:], np.full((1, table.shape[1] - 2), np.nan)])
    index = np.searchsorted(vertices, corners)
    index[np.append(vertices, np.nan)[index] != corners] = len(vertices)
    around = np.split(table[index], len(fields), axis=2)
    return tuple(np.append(*pair, axis=1) for pair in zip(fields, around, strict=True))


def predicted_depth(
    positions: Array, normals: Array, points: Array, origins: Array, point_normals: Array
) -> tuple[Array, Array]:
    """Predict the penetration at positions from points nearby; -inf without any.

    The gradient of the gap is the normal of the obstacle, and the gap at a position follows from
    that at a point by the trapezoidal rule: exactly on plane obstacles, to third order on curved
    ones. The tangent plane at the point bounds the penetration of convex obstacles, also at edges.

    Args:
        positions: The positions x, (n, gdim) (length).
        normals: Outward unit normals of the obstacle nearest to them, (n, gdim).
        points: Points around each position, (n, m, gdim) (length).
        origins: The points of the obstacle nearest to these, (n, m, gdim) (length); NaN without.
        point_normals: Outward unit normals of the obstacle there, (n, m, gdim).

    Returns:
        The penetration by the trapezoidal rule, and below tangent planes, (n,) each (length).
    """
    plane = np.einsum("nqd,nqd->nq", origins - positions[:, None], point_normals)
    change = np.nan_to_num(normals)[:, None] - point_normals
    curvature = 0.5 * np.einsum("nqd,nqd->nq", points - positions[:, None], change)
    by_rule, by_planes = (
        np.where(np.isnan(depth), -np.inf, depth).max(axis=1, initial=-np.inf)
        for depth in (plane + curvature, plane)
    )
    return by_rule, by_planes


def allowed_depth(
    resisted: Array, predicted: tuple[Array, Array], facet: Array, smaller: Array
) -> Array:
    """Return the penetration that is allowed between points, (n,) (length).

    Args:
        resisted: Penetration of the points around, (n,).
        predicted: `predicted_depth`, (n,) each.
        facet: Size of the facet of Γc, (n,).
        smaller: Size of the smaller one of the two opposing facets, (n,).
    """
    by_rule, by_planes = predicted
    limit = resisted + PREDICTED_DEPTH * facet
    limit_of_planes = np.where(resisted > 0, limit, _DEPTH_BY_PLANES_OPEN * facet)
    allowed = np.maximum(np.minimum(by_rule, limit), np.minimum(by_planes, limit_of_planes))
    return np.maximum(resisted, allowed) + DEPTH_RESOLUTION * smaller


def dot(one: Array, other: Array) -> Array:
    """Return the scalar products of vectors, (n,)."""
    return np.asarray(np.einsum("ni,ni->n", one, other))
