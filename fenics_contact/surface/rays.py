"""Ray tracing between Γc and an opposing surface, distributed over the ranks.

A normal may hit several surfaces, in front of the point and behind it. Hits behind it are
admissible only up to a bound of the penetration.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

from fenics_contact.compat import create_csr_matrix
from fenics_contact.obstacles.deformable import DeformableBody
from fenics_contact.parallel import gather_rows
from fenics_contact.surface.bodies import connected_bodies
from fenics_contact.surface.facets import FacetSet
from fenics_contact.surface.surface import SurfaceQuadrature, tagged_facets
from fenics_contact.tolerances import NEGLIGIBLE
from fenics_contact.types import Array, Index

__all__ = ["BEHIND", "REASONS", "Hits", "Partner", "Rays", "Side", "interpolation_matrix"]


# Admissible penetration in self-contact relative to the cell height: in general, and for cells that
# share a node, such as at the tip of a slit.
_SELF_PENETRATION_RATIO, _SLIT_PENETRATION_RATIO = 0.5, 0.05
# Largest angle between the normals of a facet and of a smooth surface at its corners (radians).
_MAX_SMOOTH_ANGLE = 0.5
# Reasons for unpaired points, in ascending priority.
_NO_HIT, _TOO_FAR, BEHIND, _OWN_BODY = range(4)
REASONS = {
    _NO_HIT: "their normals do not meet the opposite surface",
    _TOO_FAR: "the opposite point is farther than search_distance",
    BEHIND: "the opposite point is behind them, deeper than max_initial_penetration",
    _OWN_BODY: "the opposite point is on the back of their own body",
}


class Side:
    """One of two surfaces, with data of all its facets on every rank.

    The constructor is collective.

    Args:
        body: Connected component of every node of this rank.

    Attributes:
        facets: Facets of this rank.
        first: Global number of this rank's first facet.
        own: Global numbers of this rank's facets.
        height: Height of the cell over every facet, (n,) (length).
        length: Largest distance between two corners of the undeformed facet, (n,) (length).
        body: Number of the connected component, (n,).
        vertices: Global vertex numbers of the cell, (n, n_vertices).
        corners: Global vertex numbers of the facet in their order around it, (n, n_corners).
        middle: Centre of the undeformed facet, (n, d) (length).
    """

    def __init__(self, facets: FacetSet, body: Any) -> None:
        comm = facets.space.mesh.comm
        self.facets = facets
        corners = facets.displaced_corners(None)
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
        """Faceting tolerance of all facets, (n,) (length). Collective.

        It is twice the height of the arc over its chord, by the angles between the undeformed
        normals of neighbours and within curved facets.
        """
        facets = self.facets
        comm, d = facets.space.mesh.comm, facets.space.mesh.topology.dim
        facet, xi = facets.corners()
        corners = facets.displaced_corners(None)
        n, n_corners = corners.shape[:2]
        normal = facets.normals(facet, xi).reshape(n, n_corners + 1, d)[:, :-1]
        size = np.linalg.norm(corners - corners.mean(axis=1)[:, None], axis=2).max(axis=1)
        flat = _angle(normal, facets.mean_normals()[:, None])
        normal, size, flat = (gather_rows(comm, values) for values in (normal, size, flat))
        _, number = np.unique(self.corners, return_inverse=True)
        number = number.reshape(self.corners.shape)
        mean = np.zeros((number.max() + 1, d))
        np.add.at(mean, number, normal)
        mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-300)
        angle = _angle(mean[number], normal)
        angle[angle > _MAX_SMOOTH_ANGLE] = 0.0
        tolerance: Array = size * np.maximum(angle, flat).max(axis=1)
        return tolerance


class _Admissibility:
    """Rule that selects the admissible hits of rays.

    All hits in front are admissible. Behind the point, hits on another body are admissible up to
    the height of the higher cell; hits on the point's own body up to half of it, or if they were in
    front in the undeformed configuration. Facets whose cells share a node are admissible only at a
    notch or slit, not at an edge or a tip.

    Args:
        obstacle: Opposing body with its search bounds.
        sides: Side of the points and side that is searched.
        facet: Global facet number of every point, (n,).
        undeformed: Undeformed points, (n, d).
        normal: Unit normals of the undeformed surface, (n, d).
        penetration_bound: Penetration at each of all facets (length).

    Attributes:
        reason: Reason for the rejection of hits, of the highest priority, (n,).
    """

    def __init__(
        self,
        obstacle: DeformableBody,
        sides: tuple[Side, Side],
        facet: Any,
        undeformed: Array,
        normal: Array,
        penetration_bound: Array,
    ) -> None:
        self._obstacle, (self._from, self._to), self._facet = obstacle, sides, facet
        self._x, self._normal, self._penetration_bound = undeformed, normal, penetration_bound
        self.reason = np.full(len(normal), _NO_HIT)

    def __call__(self, point: Any, facet: Any, xi: Array, distance: Array) -> Any:
        """Return which hits are admissible."""
        one, other, limit = self._from, self._to, self._obstacle.max_initial_penetration
        source, target = self._facet[point], facet + other.first
        height = one.height[source]
        near = np.abs(distance) <= self._obstacle.search_distance
        depth = np.maximum(height, other.height[target]) if limit is None else limit
        # Points in contact may be behind by round-off.
        depth = np.maximum(depth, 2 * self._penetration_bound[source]) + NEGLIGIBLE * height
        within_bound = distance >= -depth
        opposing = one.body[source] != other.body[target]
        same = np.flatnonzero(~opposing)
        if len(same):
            x, normal = self._x[point[same]], self._normal[point[same]]
            h, target = height[same], target[same]
            shared = one.vertices[source[same]][:, :, None] == other.vertices[target][:, None, :]
            joined = shared.any(axis=(1, 2))
            hit, _ = other.facets.positions(facet[same], xi[same])
            start = np.einsum("qd,qd->q", hit - x, normal)
            middle = np.einsum("qd,qd->q", other.middle[target] - x, normal)
            own = _SELF_PENETRATION_RATIO * h if limit is None else limit
            opposing[same] = np.where(
                joined,
                np.minimum(start, middle) >= -_SLIT_PENETRATION_RATIO * h,
                np.maximum(start, distance[same]) >= -own,
            )
        reason = np.where(~opposing, _OWN_BODY, np.where(~within_bound, BEHIND, _TOO_FAR))
        admissible = near & within_bound & opposing
        np.maximum.at(self.reason, point[~admissible], reason[~admissible])
        return admissible


@dataclass(frozen=True)
class Partner:
    """Interpolation and geometry at the hits, (n, …); zero without a hit.

    Attributes:
        nodes: Global numbers of the displacement nodes, (n, n_basis).
        weights: Basis functions and their derivatives by ξ, (n, d, n_basis).
        tangents: Tangents ∂x/∂ξ of the displaced surface, (n, d, d - 1) (length).
        before: Position at an earlier displacement, (n, d) (length).
        tangents_before: Tangents at the earlier displacement, (n, d, d - 1) (length).
    """

    nodes: Index
    weights: Array
    tangents: Array
    before: Array
    tangents_before: Array


@dataclass(frozen=True)
class Hits:
    """Hits of rays on a surface.

    Attributes:
        place: Undeformed position of the hit, (n, d) (length); NaN without a hit.
        distance: Signed distance along the ray at the displacement of the search, (n,) (length);
            NaN without a hit.
        facet: Global facet number, or -1, (n,).
        reason: Reason for the rejection of other hits, (n,).
        partner: Interpolation and geometry at the hits.
    """

    place: Array
    distance: Array
    facet: Index
    reason: Index
    partner: Partner

    def completed(self, rows: Index, others: Hits) -> Hits:
        """Return the hits with ``rows``, (m,), replaced by ``others``, (m, …)."""

        def replace(mine: Any, theirs: Any) -> Any:
            if isinstance(mine, Hits | Partner):
                names = [f.name for f in fields(mine)]
                pairs = {name: (getattr(mine, name), getattr(theirs, name)) for name in names}
                return type(mine)(**{name: replace(*pair) for name, pair in pairs.items()})
            values = mine.copy()
            values[rows] = theirs
            return values

        replaced: Hits = replace(self, others)
        return replaced

    def matrix(self, space: fem.FunctionSpace) -> PETSc.Mat:
        """Return the interpolation matrix of the hits, (d n, n_dofs), else zero. Collective."""
        rows = np.flatnonzero(self.facet >= 0)
        nodes, weights = self.partner.nodes[rows], self.partner.weights[rows, 0]
        return interpolation_matrix(space, len(self.facet), rows, nodes, weights)


class Rays:
    """Ray tracing between two surfaces that may come into contact.

    The constructor is collective, and gathers both surfaces.

    Attributes:
        here: Slave side, Γc.
        there: Master side, the opposing surface.
        body: Connected component of every node of this rank.
        facet: Local facet of Γc of every owned point, (n_points,).

    Raises:
        ValueError: The opposing facets are not a part of the boundary.
    """

    def __init__(
        self, obstacle: DeformableBody, quadrature: SurfaceQuadrature, space: fem.FunctionSpace
    ) -> None:
        mesh = space.mesh
        self._comm, self._d, self._space = mesh.comm, mesh.topology.dim, space
        self._obstacle = obstacle
        opposite = tagged_facets(mesh, obstacle.facet_tags, obstacle.tags)
        _, self.body = connected_bodies(space)
        self.slave = Side(FacetSet(space, quadrature.surface.facets), self.body)
        self.master = Side(FacetSet(space, opposite), self.body)
        rows = quadrature.point_rows
        self.facet = np.empty(quadrature.n_points, dtype=np.int64)
        self.facet[rows.ravel()] = np.repeat(np.arange(len(rows)), rows.shape[1])

    def trace(
        self,
        facet: Index,
        xi: Array,
        ray: Array,
        u: fem.Function | None,
        penetration_bound: Array,
        *,
        back: bool = False,
        undeformed: Array | None = None,
        before: fem.Function | None = None,
    ) -> Hits:
        """Trace rays from Γc to the opposing surface, or back. Collective.

        Args:
            facet: Local facet of every origin, (n,).
            xi: Reference coordinates on it, (n, d - 1).
            ray: Unit directions, (n, d).
            u: Displacement of the bodies; None: undeformed.
            penetration_bound: Penetration at each facet of all ranks (length).
            back: Whether to trace from the opposing surface to Γc.
            undeformed: Directions in the undeformed bodies, (n, d); None: ``ray``.
            before: Earlier displacement at which the hits are evaluated, too.
        """
        comm = self._comm
        sides = (self.master, self.slave) if back else (self.slave, self.master)
        source, target = sides
        x, _ = source.facets.positions(facet, xi, u)
        start, _ = (x, None) if u is None else source.facets.positions(facet, xi)
        n_rays = comm.allgather(len(x))
        normal = ray if undeformed is None else undeformed
        sent = x, ray, start, normal, facet + source.first
        x, ray, start, normal, number = (
            np.concatenate(parts) for parts in zip(*comm.allgather(sent), strict=True)
        )
        rule = _Admissibility(self._obstacle, sides, number, start, normal, penetration_bound)
        hit, xi_hit, distance = target.facets.search(x, ray, u, rule)
        comm.Allreduce(MPI.IN_PLACE, rule.reason, op=MPI.MAX)
        # The nearest hit of all ranks counts, on the lowest rank if distances are equal.
        distances = np.array(comm.allgather(np.where(hit >= 0, np.abs(distance), np.inf)))
        nearest = (np.argmin(distances, axis=0) == comm.rank) & (hit >= 0)
        offsets = np.concatenate([[0], np.cumsum(n_rays)])
        messages = []
        for rank in range(comm.size):
            local = np.flatnonzero(nearest[offsets[rank] : offsets[rank + 1]])
            points = offsets[rank] + local
            evaluated = self._evaluate_hits(target, hit[points], xi_hit[points], u, before)
            messages.append((local, distance[points], *evaluated))
        received = zip(*comm.alltoall(messages), strict=True)
        local, *values = (np.concatenate(parts) for parts in received)
        n = n_rays[comm.rank]

        def scatter(values: Any, empty: float) -> Any:
            rows = np.full((n, *values.shape[1:]), empty, dtype=values.dtype)
            rows[local] = values
            return rows

        distance, number, position, *partner = values
        return Hits(
            scatter(position, np.nan),
            scatter(distance, np.nan),
            scatter(number, -1),
            rule.reason[offsets[comm.rank] : offsets[comm.rank + 1]],
            Partner(*(scatter(v, 0) for v in partner)),
        )

    @staticmethod
    def _evaluate_hits(
        target: Side,
        facet: Index,
        xi_hit: Array,
        u: fem.Function | None,
        before: fem.Function | None,
    ) -> tuple[Any, ...]:
        """Return global facets and undeformed positions of hits, and the fields of `Partner`."""
        facets = target.facets
        nodes, weights = facets.interpolation(facet, xi_hit)
        position, _ = facets.positions(facet, xi_hit)
        first = facet + target.first, position, nodes, weights
        if before is None:
            return *first, *(np.zeros((len(facet), 0)) for _ in range(3))
        _, tangents = facets.positions(facet, xi_hit, u)
        return *first, tangents, *facets.positions(facet, xi_hit, before)


def _angle(one: Array, other: Array) -> Array:
    """Return the angle between unit vectors, by the chord, which is accurate for small angles."""
    chord = np.linalg.norm(one - other, axis=-1)
    return np.asarray(2 * np.arcsin(np.minimum(chord / 2, 1)), dtype=np.float64)


def interpolation_matrix(
    space: fem.FunctionSpace, n: int, rows: Any, nodes: Any, weights: Array
) -> PETSc.Mat:
    """Build the interpolation matrix of ``n`` points, zero except in ``rows``. Collective."""
    d, bs = space.mesh.geometry.dim, space.dofmap.bs
    order = np.argsort(rows)
    n_entries = np.zeros(n, dtype=np.int64)
    n_entries[rows] = nodes.shape[1]
    columns = nodes[order][:, None, :] * bs + np.arange(d)[None, :, None]
    values = np.broadcast_to(weights[order][:, None, :], columns.shape)
    pointers = np.concatenate([[0], np.cumsum(np.repeat(n_entries, d))])
    n_columns = space.dofmap.index_map.size_local * bs
    return create_csr_matrix(space.mesh.comm, n_columns, pointers, columns.ravel(), values.ravel())
