"""Bounds of the penetration between quadrature points, from points and tangent planes nearby."""

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
    "depth_below",
    "dot",
    "tangent_planes_around",
]

# Depths relative to the size of the facet. By tangent planes more penetration is allowed than that
# of the points around, by these amounts where a point is in contact and where none is: the corner
# of a tilted facet is 0.2 of its size away from the nearest point.
PREDICTED_DEPTH, _PREDICTED_DEPTH_OPEN = 0.15, 0.05
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


def tangent_planes_around(
    comm: MPI.Comm, corners: Index, resisted: Array, origin: Array, normal: Array
) -> tuple[Array, Array]:
    """Collect the obstacle's tangent planes at a facet's points and around its corners. Collective.

    For each corner the plane at the deepest point in contact on the facets around it is added:
    where the opposing surface ends below a facet, no point of the facet itself may have a plane.

    Args:
        comm: Communicator.
        corners: Global numbers of the vertices of this rank's facets, (n, n_corners).
        resisted: Penetration at their points that the law resists, (n, n_points) (length).
        origin: A position in the plane of each point, (n, n_points, gdim) (length).
        normal: Outward unit normal of the plane, (n, n_points, gdim).

    Returns:
        Positions and normals, (n, n_points + n_corners, gdim) each, NaN without a plane.
    """
    n, n_corners = corners.shape
    deepest = (np.arange(n), resisted.argmax(axis=1)) if n else (np.arange(0), np.arange(0))
    rows = np.column_stack([-resisted[deepest], origin[deepest], normal[deepest]])
    has_plane = (rows[:, 0] < 0) & ~np.isnan(rows).any(axis=1)
    table = np.repeat(rows[has_plane], n_corners, axis=0)
    table = gather_rows(comm, np.column_stack([corners[has_plane].ravel(), table]))
    table = table[np.lexsort(table.T[::-1])]
    vertices, first = np.unique(table[:, 0], return_index=True)
    table = np.concatenate([table[first, 2:], np.full((1, table.shape[1] - 2), np.nan)])
    index = np.searchsorted(vertices, corners)
    index[np.append(vertices, np.nan)[index] != corners] = len(vertices)
    around = np.split(table[index], 2, axis=2)
    return np.append(origin, around[0], axis=1), np.append(normal, around[1], axis=1)


def depth_below(positions: Array, origin: Array, normal: Array) -> Array:
    """Return the largest depth of positions (n, d) below planes, (n,) (length); -inf without any.

    ``origin`` has a position in each plane, (n, m, d), NaN without one, ``normal`` the normals.
    """
    depth = -np.einsum("nqd,nqd->nq", positions[:, None] - origin, normal)
    return np.where(np.isnan(depth), -np.inf, depth).max(axis=1, initial=-np.inf)


def allowed_depth(resisted: Array, planes: Array, facet: Array, smaller: Array) -> Array:
    """Return the penetration that is allowed between points, (n,) (length).

    Args:
        resisted: Penetration of the points around, (n,).
        planes: Depth below the tangent planes at these points, (n,).
        facet: Size of the facet of Γc, (n,).
        smaller: Size of the smaller one of the two opposing facets, (n,).
    """
    ratio = np.where(resisted > 0, PREDICTED_DEPTH, _PREDICTED_DEPTH_OPEN)
    predicted = np.minimum(planes, resisted + ratio * facet)
    return np.maximum(resisted, predicted) + DEPTH_RESOLUTION * smaller


def dot(one: Array, other: Array) -> Array:
    """Return the scalar products of vectors, (n,)."""
    return np.asarray(np.einsum("ni,ni->n", one, other))
