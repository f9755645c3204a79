"""Which facets of which bodies may touch: those near each other that face each other."""

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
from fenics_contact.surface.projection import near_pairs
from fenics_contact.surface.rays import Side
from fenics_contact.tolerances import FLAT, NEGLIGIBLE, by_place
from fenics_contact.types import Array, Index, Mask

__all__ = ["Neighbours", "find_neighbours"]

# Of the height of the higher cell: how deep facets of two bodies may lie in each other. Half of it,
# so that no facet is behind one of a body that it lies in front of.
_DEEP = 0.5
# Facets that are searched from, and pairs that are measured, in one go, to bound the memory.
_AT_ONCE, _TOGETHER = 2000, 200_000


@dataclass(frozen=True)
class Neighbours:
    """Facets of two bodies, or of one, that may touch.

    Attributes:
        bodies: Their numbers, ascending.
        facets: Those of either body on this rank, ascending.
        counts: How many they are on all ranks.
        sizes: Mean diameter of them (length).
        least, largest: Distance of a facet from the nearest one of the other side (length).
        separate: Whether no facet is on both sides; it is where a body faces itself all around.
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
    """The facets of all ranks, one row each.

    Attributes:
        side: What is known of them.
        corners: In order around the facet, (n, n_corners, d).
        looks: Outward unit normal, (n, d).
        label: Number of its body, (n,).
        radius: Distance from the middle to the farthest corner, (n,).
    """

    side: Side
    corners: Array
    looks: Array
    label: Index
    radius: Array


def find_neighbours(
    space: fem.FunctionSpace, facets: Index, label: Index, distance: float, *, self_contact: bool
) -> list[Neighbours]:
    """Find the facets of bodies that may touch another one. Collective.

    Two facets may touch if they face each other, by their normals; if they are no farther apart
    than ``distance``, in whatever direction, so that bodies that slide by as much are found as
    well; and if each lies in front of the other, or, of two bodies, behind it by no more than half
    the height of a cell. Curved facets are taken as flat. In one connected part of the mesh, facets
    that share a vertex do not touch.

    Args:
        space: Of the displacement.
        facets: Exterior facets that this rank owns, (n,).
        label: Number of the body of each, (n,).
        distance: How near they must come (length).
        self_contact: Whether to look for facets of one and the same body as well.

    Returns:
        One item for each two bodies, in the order of their numbers: the same on all ranks.
    """
    comm, label = space.mesh.comm, np.asarray(label, dtype=np.int64)
    if not self_contact:
        corners = FacetSet(space, facets).moved_corners(None)
        near = _near_another(comm, corners, label, distance)
        facets, label = facets[near], label[near]
    mine = FacetSet(space, facets)
    side = Side(mine, connected_bodies(space)[1])
    corners = gather_rows(comm, mine.moved_corners(None))
    looks, label = gather_rows(comm, mine.mean_normals()), np.concatenate(comm.allgather(label))
    arms = np.linalg.norm(corners - side.middle[:, None], axis=2)
    every = _Facets(side, corners, looks, label, arms.max(axis=1, initial=0.0))
    first, diameter = side.first, 2 * every.radius
    pairs, away = _pairs(first + np.arange(len(facets)), every, distance, self_contact=self_contact)
    pairs, away = np.concatenate(comm.allgather(pairs)), gather_rows(comm, away)
    # Every pair was found from both sides, but for round-off.
    one, other = every.label[pairs[:, 0]], every.label[pairs[:, 1]]
    turned = (one > other) | ((one == other) & (pairs[:, 0] > pairs[:, 1]))
    pairs[turned] = pairs[turned][:, ::-1]
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    pairs, away = pairs[order], away[order]
    both = every.label[pairs]
    found = []
    for a, b in np.unique(both, axis=0):
        rows = np.all(both == (a, b), axis=1)
        sides = _sides(pairs[rows], side.middle, same=bool(a == b))
        far = np.full(len(every.label), np.inf)
        np.minimum.at(far, pairs[rows].ravel(), np.repeat(away[rows], 2))
        touched = np.union1d(*sides)
        local = [s[(s >= first) & (s < first + len(facets))] - first for s in sides]
        found.append(
            Neighbours(
                (int(a), int(b)),
                (np.sort(facets[local[0]]), np.sort(facets[local[1]])),
                (len(sides[0]), len(sides[1])),
                (float(diameter[sides[0]].mean()), float(diameter[sides[1]].mean())),
                float(far[touched].min()),
                float(far[touched].max()),
                len(np.intersect1d(*sides)) == 0,
            )
        )
    return found


def _near_another(comm: MPI.Comm, corners: Array, label: Index, distance: float) -> Mask:
    """Which facets are near the box of another body. Collective."""
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


def _pairs(
    mine: Index, every: _Facets, distance: float, *, self_contact: bool
) -> tuple[npt.NDArray[np.int64], Array]:
    """Pairs of facets that may touch, the first of which are this rank's: (m, 2), and distances."""
    pairs = [np.zeros((0, 2), dtype=np.int64)]
    distances: list[Array] = [np.zeros(0)]
    if len(every.label):
        middle, radius = every.side.middle, every.radius
        tree = scipy.spatial.cKDTree(middle)
        for start in range(0, len(mine), _AT_ONCE):
            some = mine[start : start + _AT_ONCE]
            reach = 1.01 * (distance + radius[some] + radius.max())
            one, other = near_pairs(tree, middle[some], reach)
            one = some[one]
            kept = np.einsum("pd,pd->p", every.looks[one], every.looks[other]) < -FLAT
            kept &= (every.label[one] != every.label[other]) | self_contact
            one, other = one[kept], other[kept]
            for k in range(0, len(one), _TOGETHER):
                f, g = one[k : k + _TOGETHER], other[k : k + _TOGETHER]
                away = _apart(every.corners[f], every.corners[g])
                good = (away <= distance) & _in_front(every, f, g)
                pairs.append(np.column_stack([f[good], g[good]]))
                distances.append(away[good])
    return np.concatenate(pairs), np.concatenate(distances)


def _in_front(every: _Facets, f: Index, g: Index) -> Mask:
    """Whether two facets lie in front of each other, or as deep as bodies may overlap."""
    side = every.side
    same = side.body[f] == side.body[g]
    shared = side.corners[f][:, :, None] == side.corners[g][:, None, :]
    deep = -_DEEP * np.maximum(side.height[f], side.height[g])
    deep = np.where(same, -2 * NEGLIGIBLE * every.radius[f], deep)
    front = ~(same & shared.any(axis=(1, 2)))
    for one, other in ((f, g), (g, f)):
        arm = every.corners[other] - side.middle[one][:, None]
        along = np.einsum("pkd,pd->pk", arm, every.looks[one]).max(axis=1, initial=-np.inf)
        front &= along >= deep
    return front


def _sides(pairs: Index, middle: Array, *, same: bool) -> tuple[Index, Index]:
    """The facets on either side.

    Those of one body are divided, so that none faces another one of its own side; where that cannot
    be they are all on both. Of what faces each other the facet of the lowest place, x first, is on
    the first side: numbers of facets are others on other ranks.
    """
    if not same:
        return np.unique(pairs[:, 0]), np.unique(pairs[:, 1])
    touched, number = np.unique(pairs, return_inverse=True)
    number = number.reshape(pairs.shape)
    ones = np.ones(len(pairs), dtype=np.int8)
    graph = scipy.sparse.coo_matrix((ones, number.T), (len(touched), len(touched))).tocsr()
    side = np.full(len(touched), -1)
    _, group = scipy.sparse.csgraph.connected_components(graph, directed=False)
    in_order = by_place(middle[touched])
    _, first = np.unique(group[in_order], return_index=True)
    for start in in_order[first]:
        order, before = scipy.sparse.csgraph.breadth_first_order(graph, start, directed=False)
        side[start] = 0
        for node in order[1:]:
            side[node] = 1 - side[before[node]]
    if np.any(side[number[:, 0]] == side[number[:, 1]]):
        return touched, touched
    return touched[side == 0], touched[side == 1]


def _apart(here: Array, there: Array) -> Array:
    """Distance of flat facets, (n, n_corners, d) each: of corners and middles from the other."""
    away = np.full(len(here), np.inf)
    for points, facet in ((here, there), (there, here)):
        middle = points.mean(axis=1, keepdims=True)
        for i in range(points.shape[1] + 1):
            point = np.concatenate([points, middle], axis=1)[:, i]
            away = np.minimum(away, _from_facet(point, facet))
    return away


def _from_facet(points: Array, corners: Array) -> Array:
    """Distance of each point, (n, d), from a segment, triangle or quadrilateral, (n, k, d)."""
    k, d = corners.shape[1:]
    if k == 4:
        halves = corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]
        return np.asarray(np.minimum(*(_from_facet(points, half) for half in halves)))
    edges = np.roll(corners, -1, axis=1) - corners
    arms = points[:, None] - corners
    share = np.einsum("nkd,nkd->nk", arms, edges) / np.einsum("nkd,nkd->nk", edges, edges)
    arms_left = arms - np.clip(share, 0.0, 1.0)[..., None] * edges
    away: Array = np.linalg.norm(arms_left, axis=2).min(axis=1)
    if d == 3:
        normal = np.cross(edges[:, 0], edges[:, 1])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        inward = np.cross(normal[:, None], edges)
        inside = np.all(np.einsum("nkd,nkd->nk", arms, inward) >= 0.0, axis=1)
        height = np.abs(np.einsum("nd,nd->n", arms[:, 0], normal))
        away = np.where(inside, height, away)
    return away
