"""Mortar segmentation: intersections of slave and master facets, with quadrature points."""

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

__all__ = ["cut_lines", "cut_polygons", "find_facing_pairs", "find_near_pairs", "polynomial_space"]


def polynomial_space(kind: basix.CellType, n_points: int) -> Any:
    """Return the largest complete polynomial space on a facet with dimension ≤ ``n_points``."""
    chosen = None
    for degree in range(n_points):
        element = basix.create_element(
            basix.ElementFamily.P, kind, degree, basix.LagrangeVariant.legendre, discontinuous=True
        )
        if element.dim > n_points:
            break
        chosen = element
    return chosen


def find_facing_pairs(
    slave: Array, normal: Array, master: Array, master_normal: Array, distance: Array
) -> tuple[Any, Any]:
    """Find pairs of slave and master facets that face each other and may overlap.

    The bounding balls overlap if the distance along the normal is ignored. ``normal`` and
    ``master_normal`` are mean normals. The search radius includes ``distance``, the known distance
    of the slave facets from their opposite points.
    """
    if not (len(slave) and len(master)):
        return np.zeros(0, dtype=int), np.zeros(0, dtype=int)
    centre, other = slave.mean(axis=1), master.mean(axis=1)
    radius = np.linalg.norm(slave - centre[:, None], axis=2).max(axis=1)
    largest = np.linalg.norm(master - other[:, None], axis=2).max(initial=0.0)
    tree = scipy.spatial.cKDTree(other)
    nearest, _ = tree.query(centre)
    nearest = np.maximum(nearest, distance)
    reach = 1.01 * (np.hypot(nearest, radius + largest) + radius)
    first, second = find_near_pairs(tree, centre, reach)
    facing = np.einsum("pd,pd->p", normal[first], master_normal[second]) < 0
    return first[facing], second[facing]


def find_near_pairs(tree: scipy.spatial.cKDTree, centre: Array, reach: Array) -> tuple[Any, Any]:
    """Find the points of a tree within the radius ``reach``, (n,), of each centre, (n, d)."""
    found = tree.query_ball_point(centre, reach)
    counts = np.fromiter(map(len, found), dtype=np.int64, count=len(centre))
    second = np.fromiter(itertools.chain.from_iterable(found), np.int64, count=counts.sum())
    return np.repeat(np.arange(len(centre)), counts), second


def cut_lines(
    slave: Array, normal: Array, master: Array, pairs: tuple[Any, Any], degree: int
) -> tuple[Any, Any, Array, Array, Array]:
    """Cut slave facets at the ends of master facets in 2D, along the normals of the former.

    If the bodies are displaced, these need not be orthogonal to the facets.
    """
    rule, weights = basix.make_quadrature(basix.CellType.interval, degree)
    first, second = pairs
    origin, edge = slave[:, 0], slave[:, 1] - slave[:, 0]
    across = edge - np.einsum("fd,fd->f", edge, normal)[:, None] * normal
    ends = np.einsum("pkd,pd->pk", master[second] - origin[first][:, None], across[first])
    ends = (ends / np.einsum("fd,fd->f", across, across)[first][:, None]).clip(0, 1)
    low, size = ends.min(axis=1), ends.max(axis=1) - ends.min(axis=1)
    size = np.where(size > NEGLIGIBLE, size, 0.0)
    covered = np.bincount(first, size, len(slave)) >= 1 - FLAT
    overlap = np.flatnonzero((size > 0) & covered[first])
    low, size = low[overlap, None], size[overlap, None]
    facet, other = np.repeat(first[overlap], len(rule)), np.repeat(second[overlap], len(rule))
    position = (low + size * rule[None, :, 0]).ravel()
    weight = (size * weights[None]).ravel()
    return facet, other, origin[facet] + position[:, None] * edge[facet], weight, weight


def cut_polygons(
    slave: Array, normal: Array, master: Array, pairs: tuple[Any, Any], degree: int
) -> tuple[Any, Any, Array, Array, Array]:
    """Cut slave facets into triangles by polygon clipping in 3D."""
    rule, weights = basix.make_quadrature(basix.CellType.triangle, degree)
    first, second = pairs
    e1 = slave[:, 1] - slave[:, 0]
    e1 -= np.einsum("fd,fd->f", e1, normal)[:, None] * normal
    e1 /= np.linalg.norm(e1, axis=1, keepdims=True)
    plane = np.stack([e1, np.cross(normal, e1)], axis=2)
    origin = slave[:, 0]
    own = _orient(np.einsum("fkd,fde->fke", slave - origin[:, None], plane))
    shadow = np.einsum("pkd,pde->pke", master[second] - origin[first][:, None], plane[first])
    ring, count = _clip(_orient(shadow), own[first])
    # Convex polygons are divided into fans of triangles.
    spread = np.arange(1, ring.shape[1] - 1)
    corner = np.stack(
        [np.broadcast_to(ring[:, :1], ring[:, 1:-1].shape), ring[:, 1:-1], ring[:, 2:]], 2
    )
    edge = corner[:, :, 1:] - corner[:, :, :1]
    twice = np.where(spread < count[:, None] - 1, np.linalg.det(edge), 0.0)
    size = 2 * _signed_area(own)
    covered = np.bincount(first, twice.sum(axis=1), len(slave)) / size >= 1 - FLAT
    overlap = (twice > NEGLIGIBLE * size[first][:, None]) & covered[first][:, None]
    pair, fan = np.nonzero(overlap)
    inside = corner[pair, fan, None, 0] + np.einsum("qk,tke->tqe", rule, edge[pair, fan])
    facet, other = np.repeat(first[pair], len(rule)), np.repeat(second[pair], len(rule))
    points = origin[facet] + np.einsum("pe,pde->pd", inside.reshape(-1, 2), plane[facet])
    weight = (twice[pair, fan][:, None] * weights[None]).ravel()
    return facet, other, points, weight, 2 * weight / size[facet]


def _signed_area(polygons: Array) -> Array:
    """Return signed areas of polygons (n, k, 2)."""
    x, y = polygons[..., 0], polygons[..., 1]
    return 0.5 * np.sum(x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1), axis=1)


def _orient(polygons: Array) -> Array:
    """Orient polygons (n, k, 2) anticlockwise."""
    return np.where(_signed_area(polygons)[:, None, None] < 0, polygons[:, ::-1], polygons)


def _clip(subject: Array, window: Array) -> tuple[Array, npt.NDArray[np.intp]]:
    """Clip convex anticlockwise polygons (n, k, 2) by others (n, l, 2) (Sutherland–Hodgman).

    Returns:
        Corners, (n, m, 2), the first ``count`` of every row valid; count, (n,).
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
        fraction = side / np.where(crosses, side - next_side, 1.0)
        cut = points + fraction[..., None] * (next_point - points)
        keep = np.stack([valid & (side >= 0), crosses], axis=2)
        keep = keep.reshape(len(points), 2 * points.shape[1])
        both = np.stack([points, cut], axis=2).reshape(*keep.shape, 2)
        count = keep.sum(axis=1)
        order = np.argsort(~keep, axis=1, kind="stable")[:, : max(3, count.max(initial=0))]
        points = np.take_along_axis(both, order[..., None], axis=1)
    return points, count
