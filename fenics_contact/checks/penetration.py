"""Penetration that the points of a contact resist, and what their tangent planes explain of it."""

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

# Penetration, as a share of the facet, up to which tangent planes at the points around explain more
# than these points resist: of a tilted facet the corner is 0.2 of it away from the nearest point.
# Less of it where no point resists anything.
PREDICTED_DEPTH, _PREDICTED_UNRESISTED = 0.15, 0.05
# Penetration, as a share of the facet, that two quadrature rules may differ by.
DEPTH_RESOLUTION = 0.02
# The largest penetration, as a share of the facet, that places without resistance may have been
# allowed at the last commit.
ALLOWED_BEFORE = PREDICTED_DEPTH + DEPTH_RESOLUTION
# Cosine of the angle between the normals of opposite sides of an obstacle: 120 degrees and more.
OPPOSITE_SIDES = -0.5


@dataclass(frozen=True)
class ResistedDepth:
    """How deep points are that the law resists, by the vertices of the facets that meet there.

    Attributes:
        vertices: Their global numbers, ascending, (n,).
        depth: The largest penetration of the points on the facets around, (n,) (length).
    """

    vertices: Index
    depth: Array

    @classmethod
    def of(cls, comm: MPI.Comm, vertices: Sequence[Index], depth: Sequence[Array]) -> ResistedDepth:
        """Of facets of all ranks. Collective.

        Args:
            comm: The ranks.
            vertices: Of facets of this rank their corners, (n, n_corners) each.
            depth: Of these facets, (n,) each (length).
        """
        number: Any = np.zeros(0, dtype=np.int64)
        value: Any = np.zeros(0)
        for corners, deep in zip(vertices, depth, strict=True):
            number = np.append(number, corners[deep > 0].ravel())
            value = np.append(value, np.repeat(deep[deep > 0], corners.shape[1]))
        number, value = (np.concatenate(comm.allgather(rows)) for rows in (number, value))
        unique, place = np.unique(number, return_inverse=True)
        largest = np.zeros(len(unique))
        np.maximum.at(largest, place, value)
        return cls(unique, largest)

    def at(self, vertices: Index) -> Array:
        """The largest at the corners of facets, (n, n_corners): (n,) (length), 0 if none."""
        if not len(self.vertices):
            return np.zeros(len(vertices))
        place = np.minimum(np.searchsorted(self.vertices, vertices), len(self.vertices) - 1)
        found = np.where(self.vertices[place] == vertices, self.depth[place], 0.0)
        return np.asarray(found.max(axis=1, initial=0.0))


def tangent_planes_around(
    comm: MPI.Comm, corners: Index, resisted: Array, through: Array, normal: Array
) -> tuple[Array, Array]:
    """Tangent planes that the points of facets see, and one from around each corner. Collective.

    The one is seen by the point that is deepest of those that the law resists on the facets there.
    Where what is opposite ends below a facet, no point of the facet itself may see it.

    Args:
        comm: The ranks.
        corners: Global numbers of the vertices of this rank's facets, (n, n_corners).
        resisted: Penetration at their points that the law resists, (n, n_points) (length).
        through: A place of the plane that each sees, (n, n_points, gdim) (length).
        normal: Outward unit normal of that, (n, n_points, gdim).

    Returns:
        Places and normals, (n, n_points + n_corners, gdim) each, NaN where there is none.
    """
    n, n_corners = corners.shape
    deepest = (np.arange(n), resisted.argmax(axis=1)) if n else (np.arange(0), np.arange(0))
    rows = np.column_stack([-resisted[deepest], through[deepest], normal[deepest]])
    seen = (rows[:, 0] < 0) & ~np.isnan(rows).any(axis=1)
    table = np.repeat(rows[seen], n_corners, axis=0)
    table = gather_rows(comm, np.column_stack([corners[seen].ravel(), table]))
    table = table[np.lexsort(table.T[::-1])]
    vertices, first = np.unique(table[:, 0], return_index=True)
    table = np.concatenate([table[first, 2:], np.full((1, table.shape[1] - 2), np.nan)])
    place = np.searchsorted(vertices, corners)
    place[np.append(vertices, np.nan)[place] != corners] = len(vertices)
    around = np.split(table[place], 2, axis=2)
    return np.append(through, around[0], axis=1), np.append(normal, around[1], axis=1)


def depth_below(place: Array, through: Array, normal: Array) -> Array:
    """How deep places are below the lowest of planes, (n,) (length); -inf without any.

    Args:
        place: (n, d).
        through: A place of each plane, (n, m, d), NaN where there is none.
        normal: Its outward unit normal, (n, m, d).
    """
    depth = -np.einsum("nqd,nqd->nq", place[:, None] - through, normal)
    return np.where(np.isnan(depth), -np.inf, depth).max(axis=1, initial=-np.inf)


def allowed_depth(resisted: Array, planes: Array, facet: Array, smaller: Array) -> Array:
    """Penetration that is allowed at places, (n,) (length).

    Args:
        resisted: That of the points around, (n,).
        planes: That by the tangent planes which these points see, (n,).
        facet: Size of the facet of Γc, (n,).
        smaller: Size of the smaller facet that meets there, (n,).
    """
    share = np.where(resisted > 0, PREDICTED_DEPTH, _PREDICTED_UNRESISTED)
    predicted = np.minimum(planes, resisted + share * facet)
    return np.maximum(resisted, predicted) + DEPTH_RESOLUTION * smaller


def dot(one: Array, other: Array) -> Array:
    """Products of vectors, (n,)."""
    return np.asarray(np.einsum("ni,ni->n", one, other))
