"""Rays from Γc to what lies opposite, or back, on any number of ranks.

A normal meets many a surface, in front of the point and behind it: the other side of a plate, the
next but one of a pile of leaves. What lies behind is opposite only where the bodies penetrate each
other, and so only up to the depth that they may (`Admission`).
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

from fenics_contact.compat import sparse_matrix
from fenics_contact.obstacles.deformable import DeformableBody
from fenics_contact.parallel import gather_rows
from fenics_contact.surface.bodies import connected_bodies
from fenics_contact.surface.facets import FacetSet
from fenics_contact.surface.surface import SurfaceQuadrature, tagged_facets
from fenics_contact.tolerances import NEGLIGIBLE
from fenics_contact.types import Array, Index

__all__ = ["BEHIND", "REASONS", "Hits", "Partner", "Rays", "Side", "interpolation_matrix"]


# Of the height of a cell: how far behind its facet another one of its own body may lie (initial
# interference of a body with itself), and one whose cell shares a node with it (the lips of a
# slit, meshed differently).
_OWN, _JOINED = 0.5, 0.05
# Angle between the normals of a facet and of the surface at its corner (radian), up to which the
# facets stand for a smooth surface.
_SMOOTH = 0.5
# Why a point has no opposite, the likeliest last.
_NOTHING, _FAR, BEHIND, _ITSELF = range(4)
REASONS = {
    _NOTHING: "their normals do not meet the opposite surface",
    _FAR: "the opposite point is farther than search_distance",
    BEHIND: "the opposite point is behind them, deeper than max_initial_penetration",
    _ITSELF: "the opposite point is on the back of their own body",
}


class Side:
    """One of two surfaces, and what is known on every rank of all its facets.

    The constructor is collective.

    Args:
        body: Connected part of every node of this rank.

    Attributes:
        facets: Those of this rank.
        first: Number of this rank's first facet among all.
        own: The numbers of this rank's facets among all.
        height: Of every facet's cell over it, (n,) (length).
        length: The longest distance between two corners of the undeformed facet, (n,).
        body: Number of the connected part it bounds, (n,).
        vertices: Of its cell, global, (n, n_vertices).
        corners: Those of the facet, in their order around it, (n, n_corners).
        middle: Of the undeformed facet, (n, d).
    """

    def __init__(self, facets: FacetSet, body: Any) -> None:
        comm = facets.space.mesh.comm
        self.facets = facets
        corners = facets.moved_corners(None)
        between = np.linalg.norm(corners[:, :, None] - corners[:, None], axis=3)
        ranks = comm.allgather(
            (
                facets.vertices(),
                facets.corner_vertices(),
                body[facets.space.dofmap.list[facets.cells, 0]],
                facets.heights(),
                between.max(axis=(1, 2), initial=0.0),
                corners.mean(axis=1),
            )
        )
        self.vertices, self.corners, self.body, self.height, self.length, self.middle = (
            np.concatenate(parts) for parts in zip(*ranks, strict=True)
        )
        self.first = sum(len(vertices) for vertices, *_ in ranks[: comm.rank])
        self.own = slice(self.first, self.first + len(corners))

    @cached_property
    def faceting(self) -> Array:
        """How far from a smooth or a flat surface each of all facets may be (length). Collective.

        Of the undeformed surface: twice the height of the arc over its chord, by the angles between
        neighbours, and by those between the ends of a facet that is curved itself.
        """
        facets = self.facets
        comm, d = facets.space.mesh.comm, facets.space.mesh.topology.dim
        facet, place = facets.corners()
        corners = facets.moved_corners(None)
        n, n_corners = corners.shape[:2]
        normal = facets.normals(facet, place).reshape(n, n_corners + 1, d)[:, :-1]
        size = np.linalg.norm(corners - corners.mean(axis=1)[:, None], axis=2).max(axis=1)
        flat = _angle(normal, facets.mean_normals()[:, None])
        normal, size, flat = (gather_rows(comm, values) for values in (normal, size, flat))
        _, number = np.unique(self.corners, return_inverse=True)
        number = number.reshape(self.corners.shape)
        mean = np.zeros((number.max() + 1, d))
        np.add.at(mean, number, normal)
        mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-300)
        angle = _angle(mean[number], normal)
        angle[angle > _SMOOTH] = 0.0
        slack: Array = size * np.maximum(angle, flat).max(axis=1)
        return slack


class _Admission:
    """Which of what a point's normal meets is opposite it, see `DeformableBody`.

    All that is in front may be. Behind the point the other body may lie as deep as the larger of
    the two cells there is high, for no body is thinner than that; another facet of the point's own
    body half as deep, or if it lay in front before the bodies deformed. Facets whose cells share a
    node are opposite only where the body is notched or slit between them: at an edge or a tip they
    have the body between them.

    Args:
        obstacle: Bounds.
        sides: That of the points, and the one that is searched.
        facet: Of every point, its number among those of all ranks, (n,).
        undeformed: The points without displacement, (n, d).
        normal: The way to what is in front of them there, (n, d).
        deep: How deep the bodies penetrate each other at each of all facets (length).

    Attributes:
        reason: Why what was met does not count, the most telling of all, (n,).
    """

    def __init__(
        self,
        obstacle: DeformableBody,
        sides: tuple[Side, Side],
        facet: Any,
        undeformed: Array,
        normal: Array,
        deep: Array,
    ) -> None:
        self._obstacle, (self._from, self._to), self._facet = obstacle, sides, facet
        self._x, self._normal, self._deep = undeformed, normal, deep
        self.reason = np.full(len(normal), _NOTHING)

    def __call__(self, point: Any, facet: Any, place: Array, distance: Array) -> Any:
        """Which hits count."""
        one, other, release = self._from, self._to, self._obstacle.max_initial_penetration
        here, there = self._facet[point], facet + other.first
        height = one.height[here]
        near = np.abs(distance) <= self._obstacle.search_distance
        depth = np.maximum(height, other.height[there]) if release is None else release
        # What touches lies behind by round-off as often as in front.
        depth = np.maximum(depth, 2 * self._deep[here]) + NEGLIGIBLE * height
        ahead = distance >= -depth
        foreign = one.body[here] != other.body[there]
        same = np.flatnonzero(~foreign)
        if len(same):
            x, normal = self._x[point[same]], self._normal[point[same]]
            h, there = height[same], there[same]
            ends = one.vertices[here[same]][:, :, None] == other.vertices[there][:, None, :]
            joined = ends.any(axis=(1, 2))
            met, _ = other.facets.positions(facet[same], place[same])
            start = np.einsum("qd,qd->q", met - x, normal)
            middle = np.einsum("qd,qd->q", other.middle[there] - x, normal)
            own = _OWN * h if release is None else release
            foreign[same] = np.where(
                joined,
                np.minimum(start, middle) >= -_JOINED * h,
                np.maximum(start, distance[same]) >= -own,
            )
        reason = np.where(~foreign, _ITSELF, np.where(~ahead, BEHIND, _FAR))
        counts = near & ahead & foreign
        np.maximum.at(self.reason, point[~counts], reason[~counts])
        return counts


@dataclass(frozen=True)
class Partner:
    """What moves with the places met, (n, …); zeros where nothing was.

    Attributes:
        nodes: Of the displacement there, global numbers, (n, n_basis).
        weights: Of the nodes, and their derivatives by the facet's coordinates, (n, d, n_basis).
        tangents: Of the displaced surface by these, (n, d, d - 1) (length).
        before: The place in the bodies as they were displaced before, (n, d) (length).
        tangents_before: Likewise, (n, d, d - 1).
    """

    nodes: Index
    weights: Array
    tangents: Array
    before: Array
    tangents_before: Array


@dataclass(frozen=True)
class Hits:
    """What rays meet.

    Attributes:
        place: In the undeformed body, (n, d); NaN where nothing was met.
        distance: Along the ray, in the bodies as they were searched, (n,); likewise.
        facet: Among those of all ranks, (n,), or -1.
        reason: Why what else was met does not count, (n,).
        partner: What moves with it.
    """

    place: Array
    distance: Array
    facet: Index
    reason: Index
    partner: Partner

    def completed(self, rows: Index, others: Hits) -> Hits:
        """Return these hits with those of some rays replaced.

        Args:
            rows: Which ones, (m,).
            others: The hits of these, (m, …).
        """

        def completed(mine: Any, theirs: Any) -> Any:
            if isinstance(mine, Hits | Partner):
                names = [f.name for f in fields(mine)]
                pairs = {name: (getattr(mine, name), getattr(theirs, name)) for name in names}
                return type(mine)(**{name: completed(*pair) for name, pair in pairs.items()})
            values = mine.copy()
            values[rows] = theirs
            return values

        found: Hits = completed(self, others)
        return found

    def matrix(self, space: fem.FunctionSpace) -> PETSc.Mat:
        """Displacements of the places met, (d n, n_dofs); empty rows elsewhere. Collective."""
        met = np.flatnonzero(self.facet >= 0)
        nodes, weights = self.partner.nodes[met], self.partner.weights[met, 0]
        return interpolation_matrix(space, len(self.facet), met, nodes, weights)


class Rays:
    """Two surfaces that may touch, and what rays from one of them meet of the other.

    The constructor is collective, and collects both surfaces.

    Attributes:
        here: Γc, `Side`.
        there: The opposite surface.
        body: Connected part of every node of this rank.
        facet: Facet of Γc of every owned point, among those of this rank, (n_points,).

    Raises:
        ValueError: The opposite facets are no part of the boundary; see `ContactSurface`.
    """

    def __init__(
        self, obstacle: DeformableBody, quadrature: SurfaceQuadrature, space: fem.FunctionSpace
    ) -> None:
        mesh = space.mesh
        self._comm, self._d, self._space = mesh.comm, mesh.topology.dim, space
        self._obstacle = obstacle
        opposite = tagged_facets(mesh, obstacle.facet_tags, obstacle.tags)
        _, self.body = connected_bodies(space)
        self.here = Side(FacetSet(space, quadrature.surface.facets), self.body)
        self.there = Side(FacetSet(space, opposite), self.body)
        # The points of a facet are the dofs of a submesh cell.
        rows = quadrature.point_rows
        self.facet = np.empty(quadrature.n_points, dtype=np.int64)
        self.facet[rows.ravel()] = np.repeat(np.arange(len(rows)), rows.shape[1])

    def follow(
        self,
        facet: Index,
        place: Array,
        ray: Array,
        u: fem.Function | None,
        deep: Array,
        *,
        back: bool = False,
        undeformed: Array | None = None,
        before: fem.Function | None = None,
    ) -> Hits:
        """Follow rays from places on Γc to the opposite, or back from there. Collective.

        Args:
            facet: Of this rank, of every place, (n,).
            place: Reference coordinates on it, (n, d - 1).
            ray: Unit directions, (n, d).
            u: Displacement of the bodies; none: they are undeformed.
            deep: How deep they penetrate each other at each facet of all ranks (length).
            back: From the opposite to Γc.
            undeformed: The rays in the undeformed bodies, (n, d), where they are others.
            before: An earlier displacement, in which partners are asked for as well.
        """
        comm = self._comm
        sides = (self.there, self.here) if back else (self.here, self.there)
        source, target = sides
        x, _ = source.facets.positions(facet, place, u)
        start, _ = (x, None) if u is None else source.facets.positions(facet, place)
        counts = comm.allgather(len(x))
        normal = ray if undeformed is None else undeformed
        sent = x, ray, start, normal, facet + source.first
        x, ray, start, normal, number = (
            np.concatenate(parts) for parts in zip(*comm.allgather(sent), strict=True)
        )
        admission = _Admission(self._obstacle, sides, number, start, normal, deep)
        hit, where, distance = target.facets.search(x, ray, u, admission)
        comm.Allreduce(MPI.IN_PLACE, admission.reason, op=MPI.MAX)
        # The nearest over the ranks is met; of equals the lowest rank's.
        reached = np.array(comm.allgather(np.where(hit >= 0, np.abs(distance), np.inf)))
        mine = (np.argmin(reached, axis=0) == comm.rank) & (hit >= 0)
        starts = np.concatenate([[0], np.cumsum(counts)])
        messages = []
        for rank in range(comm.size):
            local = np.flatnonzero(mine[starts[rank] : starts[rank + 1]])
            points = starts[rank] + local
            known = self._known(target, hit[points], where[points], u, before)
            messages.append((local, distance[points], *known))
        received = zip(*comm.alltoall(messages), strict=True)
        local, *values = (np.concatenate(parts) for parts in received)
        n = counts[comm.rank]

        def spread(values: Any, empty: float) -> Any:
            rows = np.full((n, *values.shape[1:]), empty, dtype=values.dtype)
            rows[local] = values
            return rows

        distance, number, place, *partner = values
        return Hits(
            spread(place, np.nan),
            spread(distance, np.nan),
            spread(number, -1),
            admission.reason[starts[comm.rank] : starts[comm.rank + 1]],
            Partner(*(spread(v, 0) for v in partner)),
        )

    @staticmethod
    def _known(
        target: Side,
        facet: Index,
        where: Array,
        u: fem.Function | None,
        before: fem.Function | None,
    ) -> tuple[Any, ...]:
        """Number of facets met and place there, and the fields of `Partner`."""
        facets = target.facets
        nodes, weights = facets.interpolation(facet, where)
        place, _ = facets.positions(facet, where)
        first = facet + target.first, place, nodes, weights
        if before is None:
            return *first, *(np.zeros((len(facet), 0)) for _ in range(3))
        _, tangents = facets.positions(facet, where, u)
        return *first, tangents, *facets.positions(facet, where, before)


def _angle(one: Array, other: Array) -> Array:
    """Between unit vectors, by the chord: of its cosine half of the digits are lost."""
    chord = np.linalg.norm(one - other, axis=-1)
    return np.asarray(2 * np.arcsin(np.minimum(chord / 2, 1)), dtype=np.float64)


def interpolation_matrix(
    space: fem.FunctionSpace, n: int, rows: Any, nodes: Any, weights: Array
) -> PETSc.Mat:
    """Displacements at ``n`` places of this rank, some of which are interpolated. Collective."""
    d, bs = space.mesh.geometry.dim, space.dofmap.bs
    order = np.argsort(rows)
    filled = np.zeros(n, dtype=np.int64)
    filled[rows] = nodes.shape[1]
    columns = nodes[order][:, None, :] * bs + np.arange(d)[None, :, None]
    values = np.broadcast_to(weights[order][:, None, :], columns.shape)
    pointers = np.concatenate([[0], np.cumsum(np.repeat(filled, d))])
    n_columns = space.dofmap.index_map.size_local * bs
    return sparse_matrix(space.mesh.comm, n_columns, pointers, columns.ravel(), values.ravel())
