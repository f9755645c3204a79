"""Pieces into which the facets opposite cut those of Γc, and the integrals over them."""

from __future__ import annotations

import itertools
from typing import Any

import basix
import numpy as np
import numpy.typing as npt
import scipy.sparse
import scipy.spatial

from fenics_contact.tolerances import FLAT, NEGLIGIBLE
from fenics_contact.types import Array

__all__ = ["cut_lines", "cut_polygons", "facing_pairs", "near_pairs", "polynomials"]


def polynomials(kind: basix.CellType, n_points: int) -> Any:
    """The largest complete polynomial space on a facet that ``n_points`` points can carry."""
    chosen = None
    for degree in range(n_points):
        element = basix.create_element(
            basix.ElementFamily.P, kind, degree, basix.LagrangeVariant.legendre, discontinuous=True
        )
        if element.dim > n_points:
            break
        chosen = element
    return chosen


def facing_pairs(
    here: Array, mean: Array, there: Array, looks: Array, away: Array
) -> tuple[Any, Any]:
    """Pairs of facets that face each other and may overlap along the normal.

    Their bounding balls overlap once the distance along the normal is ignored; ``mean`` and
    ``looks`` are the facets' mean normals.

    Nearest first would miss far bodies: the balls are compared around the nearest neighbours, and
    as far ``away`` as the opposites are known to be.
    """
    if not (len(here) and len(there)):
        return np.zeros(0, dtype=int), np.zeros(0, dtype=int)
    centre, other = here.mean(axis=1), there.mean(axis=1)
    radius = np.linalg.norm(here - centre[:, None], axis=2).max(axis=1)
    largest = np.linalg.norm(there - other[:, None], axis=2).max(initial=0.0)
    tree = scipy.spatial.cKDTree(other)
    nearest, _ = tree.query(centre)
    nearest = np.maximum(nearest, away)
    reach = 1.01 * (np.hypot(nearest, radius + largest) + radius)
    first, second = near_pairs(tree, centre, reach)
    facing = np.einsum("pd,pd->p", mean[first], looks[second]) < 0
    return first[facing], second[facing]


def near_pairs(tree: scipy.spatial.cKDTree, centre: Array, reach: Array) -> tuple[Any, Any]:
    """Pairs of places (n, d) and of those in a tree, no farther than each one's reach, (n,)."""
    found = tree.query_ball_point(centre, reach)
    counts = np.fromiter(map(len, found), dtype=np.int64, count=len(centre))
    second = np.fromiter(itertools.chain.from_iterable(found), np.int64, count=counts.sum())
    return np.repeat(np.arange(len(centre)), counts), second


def cut_lines(
    here: Array, mean: Array, there: Array, pairs: tuple[Any, Any], degree: int
) -> tuple[Any, Any, Array, Array, Array]:
    """Cut the facets of a plane problem at the ends of the opposite ones."""
    rule, shares = basix.make_quadrature(basix.CellType.interval, degree)
    first, second = pairs
    origin, edge = here[:, 0], here[:, 1] - here[:, 0]
    ends = np.einsum("pkd,pd->pk", there[second] - origin[first][:, None], edge[first])
    ends = (ends / np.einsum("fd,fd->f", edge, edge)[first][:, None]).clip(0, 1)
    low, size = ends.min(axis=1), ends.max(axis=1) - ends.min(axis=1)
    size = np.where(size > NEGLIGIBLE, size, 0.0)
    covered = np.bincount(first, size, len(here)) >= 1 - FLAT
    kept = np.flatnonzero((size > 0) & covered[first])
    low, size = low[kept, None], size[kept, None]
    facet, other = np.repeat(first[kept], len(rule)), np.repeat(second[kept], len(rule))
    along = (low + size * rule[None, :, 0]).ravel()
    weight = (size * shares[None]).ravel()
    return facet, other, origin[facet] + along[:, None] * edge[facet], weight, weight


def cut_polygons(
    here: Array, mean: Array, there: Array, pairs: tuple[Any, Any], degree: int
) -> tuple[Any, Any, Array, Array, Array]:
    """Cut the facets of a spatial problem into triangles, by polygons in the facet's plane."""
    rule, shares = basix.make_quadrature(basix.CellType.triangle, degree)
    first, second = pairs
    # Coordinates in the plane of every facet.
    e1 = here[:, 1] - here[:, 0]
    e1 -= np.einsum("fd,fd->f", e1, mean)[:, None] * mean
    e1 /= np.linalg.norm(e1, axis=1, keepdims=True)
    plane = np.stack([e1, np.cross(mean, e1)], axis=2)
    origin = here[:, 0]
    own = _anticlockwise(np.einsum("fkd,fde->fke", here - origin[:, None], plane))
    shadow = np.einsum("pkd,pde->pke", there[second] - origin[first][:, None], plane[first])
    ring, count = _clip(_anticlockwise(shadow), own[first])
    # Convex polygons are fans of triangles around their first corners.
    spread = np.arange(1, ring.shape[1] - 1)
    corner = np.stack(
        [np.broadcast_to(ring[:, :1], ring[:, 1:-1].shape), ring[:, 1:-1], ring[:, 2:]], 2
    )
    edge = corner[:, :, 1:] - corner[:, :, :1]
    twice = np.where(spread < count[:, None] - 1, np.linalg.det(edge), 0.0)
    size = 2 * _area(own)
    covered = np.bincount(first, twice.sum(axis=1), len(here)) / size >= 1 - FLAT
    kept = (twice > NEGLIGIBLE * size[first][:, None]) & covered[first][:, None]
    pair, fan = np.nonzero(kept)
    inside = corner[pair, fan, None, 0] + np.einsum("qk,tke->tqe", rule, edge[pair, fan])
    facet, other = np.repeat(first[pair], len(rule)), np.repeat(second[pair], len(rule))
    points = origin[facet] + np.einsum("pe,pde->pd", inside.reshape(-1, 2), plane[facet])
    weight = (twice[pair, fan][:, None] * shares[None]).ravel()
    return facet, other, points, weight, 2 * weight / size[facet]


def _area(polygons: Array) -> Array:
    """Signed area of polygons (n, k, 2)."""
    x, y = polygons[..., 0], polygons[..., 1]
    return 0.5 * np.sum(x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1), axis=1)


def _anticlockwise(polygons: Array) -> Array:
    """Polygons (n, k, 2) turned so that their area is positive."""
    return np.where(_area(polygons)[:, None, None] < 0, polygons[:, ::-1], polygons)


def _clip(subject: Array, window: Array) -> tuple[Array, npt.NDArray[np.intp]]:
    """Intersect pairs of convex anticlockwise polygons (Sutherland and Hodgman), all at once.

    Args:
        subject: Corners, (n, k, 2).
        window: Corners, (n, l, 2).

    Returns:
        Corners, (n, m, 2), of which the first ``count`` of every row hold; count, (n,).
    """
    points = subject
    count = np.full(len(subject), subject.shape[1])
    for e in range(window.shape[1]):
        start, end = window[:, e, None], window[:, (e + 1) % window.shape[1], None]
        along, arm = end - start, points - start
        side = along[..., 0] * arm[..., 1] - along[..., 1] * arm[..., 0]
        number = np.arange(points.shape[1])
        following = np.where(number + 1 < count[:, None], number + 1, 0)
        next_side = np.take_along_axis(side, following, axis=1)
        next_point = np.take_along_axis(points, following[..., None], axis=1)
        valid = number < count[:, None]
        crosses = valid & ((side >= 0) != (next_side >= 0))
        share = side / np.where(crosses, side - next_side, 1.0)
        cut = points + share[..., None] * (next_point - points)
        keep = np.stack([valid & (side >= 0), crosses], axis=2)
        keep = keep.reshape(len(points), 2 * points.shape[1])
        both = np.stack([points, cut], axis=2).reshape(*keep.shape, 2)
        count = keep.sum(axis=1)
        order = np.argsort(~keep, axis=1, kind="stable")[:, : max(3, count.max(initial=0))]
        points = np.take_along_axis(both, order[..., None], axis=1)
    return points, count
