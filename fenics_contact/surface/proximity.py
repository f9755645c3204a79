"""Proximity search for general contact: facets that face each other within a distance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse
import scipy.spatial
from dolfinx import fem
from mpi4py import MPI

from fenics_contact.parallel import gather_rows
from fenics_contact.surface.bodies import connected_bodies
from fenics_contact.surface.facets import FacetSet
from fenics_contact.surface.projection import find_near_pairs
from fenics_contact.surface.rays import Side
from fenics_contact.tolerances import FLAT, NEGLIGIBLE, sort_by_coordinates
from fenics_contact.types import Array, Index, Mask

__all__ = ["Neighbours", "find_neighbours"]

# Admissible initial penetration of two facets relative to the height of the higher cell.
_PENETRATION_RATIO = 0.5
# Facets searched and pairs measured at once, which limits the memory.
_FACETS_PER_CHUNK, _PAIRS_PER_CHUNK = 2000, 200_000


@dataclass(frozen=True)
class Neighbours:
    """Facets of two bodies, or of one, that may touch.

    Attributes:
        bodies: Numbers of the bodies, ascending.
        facets: Facets of either side on this rank, ascending.
        counts: Number of facets of either side on all ranks.
        sizes: Mean facet diameter of either side (length).
        least, largest: Extreme distances of a facet from the nearest of the other side (length).
        separate: Whether no facet is on both sides, as where a body surrounds itself.
    """

    bodies: tuple[int, int]
    facets: tuple[Index, Index]
    counts: tuple[int, int]
    sizes: tuple[float, float]
    least: float
    largest: float
    separate: bool


@dataclass(frozen=True)
class _Facets:
    """The facets of all ranks.

    Attributes:
        side: Topology and sizes.
        corners: Corners in order, (n, n_corners, d) (length).
        normal: Outward unit normals, (n, d).
        label: Number of the body, (n,).
        radius: Distance of the farthest corner from the centre, (n,) (length).
    """

    side: Side
    corners: Array
    normal: Array
    label: Index
    radius: Array


def find_neighbours(
    space: fem.FunctionSpace, facets: Index, label: Index, distance: float, *, self_contact: bool
) -> list[Neighbours]:
    """Find the facets of bodies that may come into contact. Collective.

    Two facets are candidates if their normals face each other, their distance in any direction is
    at most ``distance``, and each lies in front of the other, or, on another body, behind it by at
    most half the height of a cell. Curved facets are taken as flat. Facets of one connected
    component that share a vertex are excluded.

    Args:
        space: Displacement space.
        facets: Exterior facets owned by this rank, (n,).
        label: Number of the body of each facet, (n,).
        distance: Largest distance (length).
        self_contact: Whether to include pairs of facets of the same body.

    Returns:
        One item per pair of bodies, in the order of their numbers, the same on all ranks.
    """
    comm, label = space.mesh.comm, np.asarray(label, dtype=np.int64)
    if not self_contact:
        corners = FacetSet(space, facets).displaced_corners(None)
        near = _is_near_other_body(comm, corners, label, distance)
        facets, label = facets[near], label[near]
    own = FacetSet(space, facets)
    side = Side(own, connected_bodies(space)[1])
    corners = gather_rows(comm, own.displaced_corners(None))
    normal, label = gather_rows(comm, own.mean_normals()), np.concatenate(comm.allgather(label))
    arms = np.linalg.norm(corners - side.middle[:, None], axis=2)
    surface = _Facets(side, corners, normal, label, arms.max(axis=1, initial=0.0))
    first, diameter = side.first, 2 * surface.radius
    pairs, away = _find_pairs(
        first + np.arange(len(facets)), surface, distance, self_contact=self_contact
    )
    pairs, away = np.concatenate(comm.allgather(pairs)), gather_rows(comm, away)
    # Pairs are found from both sides, apart from round-off.
    one, other = surface.label[pairs[:, 0]], surface.label[pairs[:, 1]]
    swap = (one > other) | ((one == other) & (pairs[:, 0] > pairs[:, 1]))
    pairs[swap] = pairs[swap][:, ::-1]
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    pairs, away = pairs[order], away[order]
    both = surface.label[pairs]
    found = []
    for a, b in np.unique(both, axis=0):
        rows = np.all(both == (a, b), axis=1)
        sides = _divide_sides(pairs[rows], side.middle, same=bool(a == b))
        far = np.full(len(surface.label), np.inf)
        np.minimum.at(far, pairs[rows].ravel(), np.repeat(away[rows], 2))
        candidates = np.union1d(*sides)
        local = [s[(s >= first) & (s < first + len(facets))] - first for s in sides]
        found.append(
            Neighbours(
                (int(a), int(b)),
                (np.sort(facets[local[0]]), np.sort(facets[local[1]])),
                (len(sides[0]), len(sides[1])),
                (float(diameter[sides[0]].mean()), float(diameter[sides[1]].mean())),
                float(far[candidates].min()),
                float(far[candidates].max()),
                len(np.intersect1d(*sides)) == 0,
            )
        )
    return found


def _is_near_other_body(comm: MPI.Comm, corners: Array, label: Index, distance: float) -> Mask:
    """Return which facets are near the bounding box of another body. Collective."""
    n = comm.allreduce(int(label.max(initial=-1)) + 1, op=MPI.MAX)
    low, high = corners.min(axis=1), corners.max(axis=1)
    boxes = np.full((2, n, corners.shape[2]), np.inf)
    np.minimum.at(boxes[0], label, low)
    np.minimum.at(boxes[1], label, -high)
    comm.Allreduce(MPI.IN_PLACE, boxes, op=MPI.MIN)
    near = np.zeros(len(low), dtype=np.bool_)
    for body in range(n):
        gap = np.maximum(boxes[0, body] - high, low + boxes[1, body])
        near |= (label != body) & np.all(gap <= distance, axis=1)
    return near


def _find_pairs(
    own: Index, surface: _Facets, distance: float, *, self_contact: bool
) -> tuple[npt.NDArray[np.int64], Array]:
    """Find candidate pairs of facets, the first owned by this rank, (m, 2), and distances."""
    pairs = [np.zeros((0, 2), dtype=np.int64)]
    distances: list[Array] = [np.zeros(0)]
    if len(surface.label):
        middle, radius = surface.side.middle, surface.radius
        tree = scipy.spatial.cKDTree(middle)
        for start in range(0, len(own), _FACETS_PER_CHUNK):
            chunk = own[start : start + _FACETS_PER_CHUNK]
            reach = 1.01 * (distance + radius[chunk] + radius.max())
            one, other = find_near_pairs(tree, middle[chunk], reach)
            one = chunk[one]
            facing = np.einsum("pd,pd->p", surface.normal[one], surface.normal[other]) < -FLAT
            facing &= (surface.label[one] != surface.label[other]) | self_contact
            one, other = one[facing], other[facing]
            for k in range(0, len(one), _PAIRS_PER_CHUNK):
                f, g = one[k : k + _PAIRS_PER_CHUNK], other[k : k + _PAIRS_PER_CHUNK]
                away = _facet_distance(surface.corners[f], surface.corners[g])
                valid = (away <= distance) & _is_in_front(surface, f, g)
                pairs.append(np.column_stack([f[valid], g[valid]]))
                distances.append(away[valid])
    return np.concatenate(pairs), np.concatenate(distances)


def _is_in_front(surface: _Facets, f: Index, g: Index) -> Mask:
    """Return whether facets lie in front of each other, up to the admissible penetration."""
    side = surface.side
    same = side.body[f] == side.body[g]
    shared = side.corners[f][:, :, None] == side.corners[g][:, None, :]
    limit = -_PENETRATION_RATIO * np.maximum(side.height[f], side.height[g])
    limit = np.where(same, -2 * NEGLIGIBLE * surface.radius[f], limit)
    front = ~(same & shared.any(axis=(1, 2)))
    for one, other in ((f, g), (g, f)):
        arm = surface.corners[other] - side.middle[one][:, None]
        along = np.einsum("pkd,pd->pk", arm, surface.normal[one]).max(axis=1, initial=-np.inf)
        front &= along >= limit
    return front


def _divide_sides(pairs: Index, middle: Array, *, same: bool) -> tuple[Index, Index]:
    """Divide the facets of candidate pairs into two sides.

    Facets of one body are divided so that none faces another of its own side; if that is
    impossible, all are on both sides. The facet of the lowest position is on the first side, which
    makes the result independent of the partition.
    """
    if not same:
        return np.unique(pairs[:, 0]), np.unique(pairs[:, 1])
    candidates, number = np.unique(pairs, return_inverse=True)
    number = number.reshape(pairs.shape)
    ones = np.ones(len(pairs), dtype=np.int8)
    graph = scipy.sparse.coo_matrix((ones, number.T), (len(candidates), len(candidates))).tocsr()
    side = np.full(len(candidates), -1)
    _, group = scipy.sparse.csgraph.connected_components(graph, directed=False)
    in_order = sort_by_coordinates(middle[candidates])
    _, first = np.unique(group[in_order], return_index=True)
    for start in in_order[first]:
        order, parent = scipy.sparse.csgraph.breadth_first_order(graph, start, directed=False)
        side[start] = 0
        for node in order[1:]:
            side[node] = 1 - side[parent[node]]
    if np.any(side[number[:, 0]] == side[number[:, 1]]):
        return candidates, candidates
    return candidates[side == 0], candidates[side == 1]


def _facet_distance(first: Array, second: Array) -> Array:
    """Return distances of flat facets, (n, n_corners, d) each, by their corners and centres."""
    away = np.full(len(first), np.inf)
    for points, facet in ((first, second), (second, first)):
        middle = points.mean(axis=1, keepdims=True)
        for i in range(points.shape[1] + 1):
            point = np.concatenate([points, middle], axis=1)[:, i]
            away = np.minimum(away, _point_distance(point, facet))
    return away


def _point_distance(points: Array, corners: Array) -> Array:
    """Return distances of points (n, d) from segments, triangles or quadrilaterals (n, k, d)."""
    k, d = corners.shape[1:]
    if k == 4:
        halves = corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]
        return np.asarray(np.minimum(*(_point_distance(points, half) for half in halves)))
    edges = np.roll(corners, -1, axis=1) - corners
    arms = points[:, None] - corners
    fraction = np.einsum("nkd,nkd->nk", arms, edges) / np.einsum("nkd,nkd->nk", edges, edges)
    remainder = arms - np.clip(fraction, 0.0, 1.0)[..., None] * edges
    away: Array = np.linalg.norm(remainder, axis=2).min(axis=1)
    if d == 3:
        normal = np.cross(edges[:, 0], edges[:, 1])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        inward = np.cross(normal[:, None], edges)
        inside = np.all(np.einsum("nkd,nkd->nk", arms, inward) >= 0.0, axis=1)
        height = np.abs(np.einsum("nd,nd->n", arms[:, 0], normal))
        away = np.where(inside, height, away)
    return away
