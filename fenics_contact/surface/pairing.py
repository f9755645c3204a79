"""A deformable body as the support: what of it lies opposite every point of Γc.

From a point b of Γc the normal is followed to the opposite surface (paper, section 2.1); where it
meets it, at the point a, stands u_a. That alone would load the opposite body unevenly where the
meshes do not match: a uniform pressure would not give the nodal forces of a uniform pressure. So,
on every facet of Γc, the opposite displacement is projected (L2) on the polynomials that the
facet's quadrature points carry, with integrals over the pieces into which the opposite facets cut
it. The result is one sparse matrix G, u_a = G u at the quadrature points; constant pressures pass
exactly (patch test), and so do constant and linear displacements.

A normal meets many a surface, in front of the point and behind it: the other side of a plate, the
next but one of a pile of leaves. What lies behind is opposite only where the bodies penetrate each
other, and so only up to the depth that they may (`_Admission`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import dolfinx
import dolfinx.geometry
import numpy as np
import scipy.sparse
import scipy.spatial
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

from fenics_contact.parallel import collective_errors, gather_rows, global_max
from fenics_contact.supports.deformable import DeformableBody
from fenics_contact.surface.bodies import connected_bodies
from fenics_contact.surface.facets import FacetSet, tabulate
from fenics_contact.surface.projection import (
    COVERED,
    cut_lines,
    cut_polygons,
    facing_pairs,
    polynomials,
)
from fenics_contact.surface.surface import SurfaceQuadrature, tagged_facets
from fenics_contact.types import Array

__all__ = ["REASONS", "LookBack", "Pairing"]


# Of the height of a cell: how far behind its facet another one of its own body may lie (initial
# interference of a body with itself), and one whose cell shares a node with it (the lips of a
# slit, meshed differently).
_OWN, _JOINED = 0.5, 0.05
# Of a distance, by the size of the coordinates that it is the difference of.
_ROUND_OFF = 16 * np.finfo(float).eps
# Angle between the normals of a facet and of the surface at its corner (radian), up to which the
# facets stand for a smooth surface.
_SMOOTH = 0.5
# Why a point has no opposite, the likeliest last.
_NOTHING, _FAR, _BEHIND, _ITSELF = range(4)
REASONS = {
    _NOTHING: "their normals meet nothing",
    _FAR: "what they meet is out of reach",
    _BEHIND: "what they meet lies behind them, deeper than release",
    _ITSELF: "what they meet is the back of their own body",
}


class _Side:
    """One of two surfaces, and what is known on every rank of all its facets.

    Attributes:
        facets: Those of this rank.
        first: Number of this rank's first facet among all.
        height: Of every facet's cell over it, (n,) (length).
        body: Number of the connected part it bounds, (n,).
        vertices: Of its cell, global, (n, n_vertices).
        middle: Of the undeformed facet, (n, d).
    """

    def __init__(self, facets: FacetSet, body: Any) -> None:
        """Gather. Collective.

        Args:
            facets: Of this rank.
            body: Part of every node of this rank.
        """
        comm = facets.space.mesh.comm
        self.facets = facets
        own = facets.vertices()
        corners = facets.moved_corners(None)
        self.first = comm.exscan(len(own)) or 0
        self.vertices = np.concatenate(comm.allgather(own))
        self.body = np.concatenate(comm.allgather(body[facets.space.dofmap.list[facets.cells, 0]]))
        self.height = np.concatenate(comm.allgather(facets.heights()))
        self.middle = gather_rows(comm, corners.mean(axis=1))


class _Admission:
    """Which of what a point's normal meets is opposite it, see `DeformableBody`.

    All that is in front may be. Behind the point the other body may lie as deep as the larger of
    the two cells there is high, for no body is thinner than that; another facet of the point's own
    body half as deep, or if it lay in front before the bodies deformed. Facets whose cells share a
    node are opposite only where the body is notched or slit between them: at an edge or a tip they
    have the body between them.

    Attributes:
        reason: Why what was met does not count, the most telling of all, (n,).
    """

    def __init__(
        self,
        support: DeformableBody,
        sides: tuple[_Side, _Side],
        facet: Any,
        undeformed: Array,
        ray: Array,
        deep: Array,
    ) -> None:
        """Set the points.

        Args:
            support: Bounds.
            sides: That of the points, and the one that is searched.
            facet: Of every point, its number among those of all ranks, (n,).
            undeformed: The points without displacement, (n, d).
            ray: (n, d).
            deep: How deep the bodies penetrate each other at each of all facets (length).
        """
        self._support, (self._from, self._to), self._facet = support, sides, facet
        self._x, self._ray, self._deep = undeformed, ray, deep
        self.reason = np.full(len(ray), _NOTHING)

    def __call__(self, point: Any, facet: Any, place: Array, distance: Array) -> Any:
        """Which hits count."""
        one, other, release = self._from, self._to, self._support.release
        here, there = self._facet[point], facet + other.first
        height = one.height[here]
        near = np.abs(distance) <= self._support.search_distance
        depth = np.maximum(height, other.height[there]) if release is None else release
        depth = np.maximum(depth, 2 * self._deep[here])
        ahead = distance >= -depth
        foreign = one.body[here] != other.body[there]
        same = np.flatnonzero(~foreign)
        if len(same):
            x, ray = self._x[point[same]], self._ray[point[same]]
            h, there = height[same], there[same]
            ends = one.vertices[here[same]][:, :, None] == other.vertices[there][:, None, :]
            joined = ends.any(axis=(1, 2))
            met, _ = other.facets.positions(facet[same], place[same])
            start = np.einsum("qd,qd->q", met - x, ray)
            middle = np.einsum("qd,qd->q", other.middle[there] - x, ray)
            own = _OWN * h if release is None else release
            foreign[same] = np.where(
                joined,
                np.minimum(start, middle) >= -_JOINED * h,
                np.maximum(start, distance[same]) >= -own,
            )
        reason = np.where(~foreign, _ITSELF, np.where(~ahead, _BEHIND, _FAR))
        counts = near & ahead & foreign
        np.maximum.at(self.reason, point[~counts], reason[~counts])
        return counts


@dataclass(frozen=True)
class _Hits:
    """What rays meet.

    Attributes:
        matrix: Displacements of the places met, (d n, n_dofs); empty rows where nothing was.
        place: In the undeformed body, (n, d); NaN where nothing was met.
        distance: Along the ray, in the bodies as they were searched, (n,); likewise.
        facet: Among those of all ranks, (n,), or -1.
        reason: Why what else was met does not count, (n,).
    """

    matrix: PETSc.Mat
    place: Array
    distance: Array
    facet: Any
    reason: Any


@dataclass(frozen=True)
class LookBack:
    """What of Γc lies opposite corners and middles of the opposite's facets, on this rank.

    Attributes:
        place: Of the corner or middle, undeformed, (n, d).
        source: Its facet of this rank's mesh, (n,).
        facet: The facet of Γc that it sees, among those of all ranks, (n,).
        distance: Between the two undeformed bodies along the normal of the opposite, (n,).
        slack: By how much flat facets of curved surfaces may overlap (length), (n,).
        approach: From displacements to what the distance loses, (n, n_dofs).
    """

    place: Array
    source: Any
    facet: Any
    distance: Array
    slack: Array
    approach: PETSc.Mat


class Pairing:
    """The surface opposite Γc, ready to be paired with the points of Γc.

    Attributes:
        facets: This rank's facets of it.
        surface: Γc.
        round_off: Distances no larger than this are differences of coordinates and nothing else.
    """

    def __init__(
        self, support: DeformableBody, quadrature: SurfaceQuadrature, space: fem.FunctionSpace
    ) -> None:
        """Collect both surfaces. Collective.

        Raises:
            ValueError: The opposite facets are no part of the boundary; see `ContactSurface`.
        """
        mesh = space.mesh
        self._comm, self._d = mesh.comm, mesh.topology.dim
        self._support, self._quadrature = support, quadrature
        self.round_off = _ROUND_OFF * global_max(mesh.comm, np.abs(mesh.geometry.x))
        facets = tagged_facets(mesh, support.facet_tags, support.tags)
        self._there = FacetSet(space, facets)
        self._here = FacetSet(space, quadrature.surface.facets)
        _, body = connected_bodies(space)
        self._sides = _Side(self._here, body), _Side(self._there, body)
        self._body, self.facets, self.surface = body, facets, quadrature.surface
        # Facet of Γc of every owned point: the points of a facet are the dofs of a submesh cell.
        rows = quadrature.point_rows()
        self._facet = np.empty(quadrature.n_points, dtype=np.int64)
        self._facet[rows.ravel()] = np.repeat(np.arange(len(rows)), rows.shape[1])

    def pair(
        self, x: Array, normal: Array, u: fem.Function | None, penetration: Array
    ) -> tuple[PETSc.Mat, Array, Any]:
        """Find the opposites of the points. Collective.

        Args:
            x: The points in the undeformed body, (n_points, d).
            normal: Unit normals from body to support, (n_points, d).
            u: Displacement at which to pair; none: undeformed.
            penetration: Of the points as they have been paired, ≥ 0, (n_points,) (length).

        Returns:
            G, (d n_points, n_dofs), and the distance s along the normal between the paired places
            *in the undeformed bodies*, so that s - u_n is the present one; NaN without opposite.
            And why there is none, one of `REASONS`, (n_points,).
        """
        place, _, _ = self._here.meet(self._facet, x, normal)
        deep = np.maximum(self.largest(penetration), 0.0)
        found = self._find(self._facet, place, normal, u, deep)
        if u is None and self._support.release is None:
            inside = self._inside(x, found.reason == _BEHIND)
            if self._comm.allreduce(np.count_nonzero(inside)):
                deep[self._sides[0].first + self._facet[inside]] = np.inf
                self._comm.Allreduce(MPI.IN_PLACE, deep, op=MPI.MAX)
                found.matrix.destroy()
                found = self._find(self._facet, place, normal, u, deep)
        paired = ~np.isnan(found.distance)
        gap = np.einsum("qd,qd->q", found.place - x, normal)
        gap[np.abs(gap) <= self.round_off] = 0.0
        away = np.zeros(len(self._here.cells))
        np.maximum.at(away, self._facet[paired], np.abs(found.distance[paired]))
        facet, other, places, weights, share = self._pieces(u, away)
        ray = self._here.normals(facet, places)
        pieces = self._find(facet, places, ray, u, deep)
        facet = self._only_met(facet, other, share, pieces.facet)
        # Facets that are not covered, or some of whose points look past the other body, keep
        # the interpolation at their points.
        kept = facet >= 0
        good = np.bincount(facet[kept], minlength=len(self._here.cells)) > 0
        good[facet[kept & (pieces.facet < 0)]] = False
        good[self._facet[~paired]] = False
        projection = self._projection(place, facet, places, weights, good)
        matrix = projection.matMult(pieces.matrix)
        keep = found.matrix.createVecLeft()
        keep.array[:] = np.repeat(~good[self._facet], self._d)
        found.matrix.diagonalScale(keep, None)
        matrix.axpy(1.0, found.matrix, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        for item in (projection, pieces.matrix, found.matrix, keep):
            item.destroy()
        return matrix, gap, found.reason

    def look_back(self, u: fem.Function | None, penetration: float) -> LookBack:
        """Follow the normals of the opposite back to Γc. Collective.

        Args:
            u: Displacement of the bodies; none: they are undeformed.
            penetration: The largest between them (length).
        """
        here, there = self._sides
        facet, place = self._there.corners()
        ray = self._there.normals(facet, place)
        found = self._find(facet, place, ray, u, np.full(len(there.body), penetration), back=1)
        x, _ = self._there.positions(facet, place)
        nodes, weights = self._there.interpolation(facet, place)
        n, space = len(facet), self._there.space
        own = _interpolation_matrix(space, n, np.arange(n), nodes, weights)
        own.axpy(-1.0, found.matrix, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        kept = np.flatnonzero(found.facet >= 0)
        first, _ = own.getOwnershipRange()
        columns = first + self._d * kept[:, None] + np.arange(self._d)
        along = PETSc.Mat().createAIJ(
            ((len(kept), None), (n * self._d, None)),
            csr=(
                np.arange(0, columns.size + 1, self._d, dtype=PETSc.IntType),
                columns.ravel().astype(PETSc.IntType),
                ray[kept].ravel(),
            ),
            comm=self._comm,
        )
        approach = along.matMult(own)
        for item in (along, own, found.matrix):
            item.destroy()
        hit = found.facet[kept]
        return LookBack(
            x[kept],
            self.facets[facet[kept]],
            hit,
            np.einsum("qd,qd->q", found.place - x, ray)[kept],
            self._slack(here)[hit] + self._slack(there)[there.first + facet[kept]],
            approach,
        )

    def _slack(self, side: _Side) -> Array:
        """How far from a smooth or a flat surface each of all facets may be (length). Collective.

        Twice the height of the arc over its chord, by the angles between neighbours, and by those
        between the ends of a facet that is curved itself.
        """
        facets, comm = side.facets, self._comm
        n = len(facets.cells)
        facet, place = facets.corners()
        corners = facets.moved_corners(None)
        normal = facets.normals(facet, place).reshape(n, corners.shape[1] + 1, self._d)[:, :-1]
        size = np.linalg.norm(corners - corners.mean(axis=1)[:, None], axis=2).max(axis=1)
        vertex = np.concatenate(comm.allgather(facets.corner_vertices()))
        flat = _angle(normal, facets.mean_normals()[:, None])
        normal, size, flat = (gather_rows(comm, values) for values in (normal, size, flat))
        _, number = np.unique(vertex, return_inverse=True)
        number = number.reshape(vertex.shape)
        mean = np.zeros((number.max() + 1, self._d))
        np.add.at(mean, number, normal)
        mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-300)
        angle = _angle(mean[number], normal)
        angle[angle > _SMOOTH] = 0.0
        slack: Array = size * np.maximum(angle, flat).max(axis=1)
        return slack

    def facets_near(self, chosen: Any) -> Any:
        """Which of all facets of Γc share a node with chosen ones of this rank. Collective.

        Args:
            chosen: Mask over this rank's points of Γc.
        """
        here = self._sides[0]
        facets = here.first + np.unique(self._facet[chosen])
        facets = np.unique(np.concatenate(self._comm.allgather(facets)))
        corners = np.concatenate(self._comm.allgather(self._here.corner_vertices()))
        return np.isin(corners, corners[facets]).any(axis=1)

    def facets_among(self, other: Pairing) -> Any:
        """Which of all facets of Γc are of the opposite surface of another contact. Collective."""
        mine = np.isin(self._quadrature.surface.facets, other.facets)
        return np.concatenate(self._comm.allgather(mine))

    def largest(self, values: Array) -> Array:
        """The largest of the points' values on each of all facets of Γc. Collective."""
        largest = np.full(len(self._here.cells), -np.inf)
        np.maximum.at(largest, self._facet, values)
        return np.concatenate(self._comm.allgather(largest))

    def true_gap(
        self, x: Array, along: Array, u: fem.Function, penetration: Array
    ) -> tuple[Array, Array]:
        """Distance to the opposite along the normal of Γc, both deformed. Collective.

        Args:
            x: The points in the undeformed body, (n_points, d).
            along: Its normals there, (n_points, d).
            u: Displacement of the bodies.
            penetration: As for `pair`.

        Returns:
            The distance, (n_points,) (length), NaN where there is no opposite; unit normals,
            (n_points, d).
        """
        place, _, _ = self._here.meet(self._facet, x, along)
        normal = self._here.normals(self._facet, place, u)
        deep = np.maximum(self.largest(penetration), 0.0)
        found = self._find(self._facet, place, normal, u, deep)
        found.matrix.destroy()
        return found.distance, normal

    def linear_gap(
        self,
        x: Array,
        along: Array,
        at: fem.Function | None,
        penetration: Array,
        u: fem.Function,
        own: Array,
    ) -> Array:
        """The linearised gap s - u_n with the displacement opposite as it is, not projected.

        To compare with `true_gap`, which is of points as well. Collective.

        Args:
            x: The points in the undeformed body, (n_points, d).
            along: Unit normals, (n_points, d).
            at: Displacement at which pairs were found; none: in the undeformed bodies.
            penetration: As for `pair`.
            u: The displacement now.
            own: Of the points, (n_points, d).

        Returns:
            (n_points,) (length), NaN where there is no opposite.
        """
        place, _, _ = self._here.meet(self._facet, x, along)
        deep = np.maximum(self.largest(penetration), 0.0)
        found = self._find(self._facet, place, along, at, deep)
        product = found.matrix.createVecLeft()
        found.matrix.mult(u.x.petsc_vec, product)
        jump = own - product.array_r.reshape(own.shape)
        for item in (product, found.matrix):
            item.destroy()
        return np.asarray(np.sum((found.place - x - jump) * along, axis=1), dtype=np.float64)

    def _inside(self, x: Array, doubtful: Any) -> Any:
        """Which points of Γc lie in another undeformed body: (n_points,). Collective.

        Args:
            x: (n_points, d).
            doubtful: The points to look at, (n_points,).
        """
        comm, space = self._comm, self._here.space
        mesh, side = space.mesh, self._sides[0]
        mine = np.zeros((np.count_nonzero(doubtful), 3))
        mine[:, : self._d] = x[doubtful]
        counts = comm.allgather(len(mine))
        points: Array = gather_rows(comm, mine)
        bodies = np.concatenate(comm.allgather(side.body[side.first + self._facet[doubtful]]))
        found = np.zeros(len(points), dtype=np.int64)
        if len(points) and len(space.dofmap.list):
            tree = dolfinx.geometry.bb_tree(mesh, self._d)
            near = dolfinx.geometry.compute_collisions_points(tree, points)
            cells = dolfinx.geometry.compute_colliding_cells(mesh, near, points)
            for i, body in enumerate(bodies):
                found[i] = np.any(self._body[space.dofmap.list[cells.links(i), 0]] != body)
        comm.Allreduce(MPI.IN_PLACE, found, op=MPI.MAX)
        inside = np.zeros(len(x), dtype=np.bool_)
        start = sum(counts[: comm.rank])
        inside[doubtful] = found[start : start + counts[comm.rank]] > 0
        return inside

    def _find(
        self,
        facet: Any,
        place: Array,
        ray: Array,
        u: fem.Function | None,
        deep: Array,
        back: int = 0,
    ) -> _Hits:
        """Follow rays from places on Γc to the opposite, or back from there. Collective.

        Args:
            facet: Of this rank, of every place, (n,).
            place: Reference coordinates on it, (n, d - 1).
            ray: Unit directions, (n, d).
            u: Displacement of the bodies; none: they are undeformed.
            deep: How deep they penetrate each other at each facet of all ranks (length).
            back: 1: from the opposite to Γc.
        """
        comm, d = self._comm, self._d
        source, target = self._sides[back], self._sides[1 - back]
        space = target.facets.space
        x, _ = source.facets.positions(facet, place, u)
        start, _ = (x, None) if u is None else source.facets.positions(facet, place)
        counts = comm.allgather(len(x))
        sent = x, ray, start, facet + source.first
        x, ray, start, number = (
            np.concatenate(parts) for parts in zip(*comm.allgather(sent), strict=True)
        )
        admission = _Admission(self._support, (source, target), number, start, ray, deep)
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
            nodes, weights = target.facets.interpolation(hit[points], where[points])
            places, _ = target.facets.positions(hit[points], where[points])
            numbers = hit[points] + target.first
            messages.append((local, nodes, weights, places, distance[points], numbers))
        local, nodes, weights, places, distance, numbers = (
            np.concatenate(parts) for parts in zip(*comm.alltoall(messages), strict=True)
        )
        n = counts[comm.rank]
        found = _Hits(
            _interpolation_matrix(space, n, local, nodes, weights),
            np.full((n, d), np.nan),
            np.full(n, np.nan),
            np.full(n, -1),
            admission.reason[starts[comm.rank] : starts[comm.rank + 1]],
        )
        found.place[local], found.distance[local], found.facet[local] = places, distance, numbers
        return found

    def _only_met(self, facet: Any, other: Any, share: Array, hit: Any) -> Any:
        """Drop pieces cut by facets that are not opposite, where there may be such ones.

        Args:
            facet: Of Γc, of every piece's points, (m,).
            other: Facet of all ranks that cut it, (m,).
            share: Of the facet, that the point stands for, (m,).
            hit: Facet of all ranks that the point meets, or -1, (m,).

        Returns:
            ``facet`` with -1 where the piece is dropped, or all that is left is not a facet full.
        """
        here, there = self._sides
        n = len(self._here.cells)
        doubtful = np.abs(np.bincount(facet, share, n) - 1) > COVERED
        doubtful[facet[here.body[here.first + facet] == there.body[other]]] = True
        if not doubtful.any():
            return facet
        ends = there.vertices[other][:, :, None] == there.vertices[hit][:, None, :]
        kept = ~doubtful[facet] | ((hit >= 0) & ends.any(axis=(1, 2)))
        full = np.abs(np.bincount(facet, share * kept, n) - 1) <= COVERED
        return np.where(kept & full[facet], facet, -1)

    def _projection(
        self, place: Array, facet: Any, places: Array, weights: Array, good: Any
    ) -> PETSc.Mat:
        """L2 projection, facet by facet, from the pieces' points to the quadrature points."""
        d = self._d
        rows = self._quadrature.point_rows()
        basis = polynomials(d, self._here.simplex, rows.shape[1])
        order = np.argsort(facet, kind="stable")
        bounds = np.searchsorted(facet[order], np.arange(len(rows) + 1))
        at_points = tabulate(basis, 0, place)[0, :, :, 0]
        at_pieces = tabulate(basis, 0, places)[0, :, :, 0]
        lines, columns, values = [], [], []
        with collective_errors(self._comm):  # a facet's matrix may be singular
            for f in np.flatnonzero(good):
                own = order[bounds[f] : bounds[f + 1]]
                weighted = weights[own, None] * at_pieces[own]
                inverse = np.linalg.solve(at_pieces[own].T @ weighted, weighted.T)
                lines.append(np.repeat(rows[f], len(own)))
                columns.append(np.tile(own, rows.shape[1]))
                values.append((at_points[rows[f]] @ inverse).ravel())
        n, m = self._quadrature.n_points, len(places)
        empty = np.zeros(0, dtype=np.int64)
        local = scipy.sparse.csr_matrix(
            (
                np.concatenate([np.zeros(0), *values]),
                (np.concatenate([empty, *lines]), np.concatenate([empty, *columns])),
            ),
            (n, m),
        )
        local = scipy.sparse.kron(local, np.eye(d), format="csr")
        first = self._comm.scan(m * d) - m * d
        return PETSc.Mat().createAIJ(
            ((n * d, None), (m * d, None)),
            csr=(
                local.indptr.astype(PETSc.IntType),
                (local.indices + first).astype(PETSc.IntType),
                local.data,
            ),
            comm=self._comm,
        )

    def _pieces(self, u: fem.Function | None, away: Array) -> tuple[Any, Any, Array, Array, Array]:
        """Cut the facets of Γc along the opposite ones: points with weights on the pieces.

        Facets are cut as if they were flat, along their mean normals; of curved ones only the cuts
        are a little off. Uncovered facets have no points.

        Args:
            u: Displacement of the bodies.
            away: How far the facets' points are from their opposites, (n_facets,) (length).

        Returns:
            Facet of Γc, (m,); the one that cuts it, among those of all ranks, (m,); place on it,
            (m, d - 1); weight, (m,); and that as a share of the facet, (m,).
        """
        here, d = self._here, self._d
        moved_here, moved_there = here.moved_corners(u), self._there.moved_corners(u)
        there = gather_rows(self._comm, moved_there)
        looks = gather_rows(self._comm, self._there.mean_normals())
        mean = here.mean_normals()
        cut = cut_lines if d == 2 else cut_polygons
        pairs = facing_pairs(moved_here, mean, there, looks, away)
        facet, other, points, weights, share = cut(moved_here, mean, there, pairs, self._degree())
        places, _, _ = here.meet(facet, points, mean[facet], u)
        return facet, other, places, weights, share

    def _degree(self) -> int:
        """Degree of the integrands on a piece: polynomial of the points times displacement.

        And times themselves. In space pieces are triangles: there functions of a quadrilateral's
        facet have twice the degree that they have along each of its sides.
        """
        degree = self._there.space.ufl_element().degree
        found = self._quadrature.degree + degree
        if self._d == 3 and not self._here.simplex:
            n_points = self._quadrature.point_rows().shape[1]
            own = polynomials(self._d, self._here.simplex, n_points).degree
            found = max(found, 2 * (own + max(own, degree)))
        return int(found)


def _angle(one: Array, other: Array) -> Array:
    """Between unit vectors, by the chord: of its cosine half of the digits are lost."""
    chord = np.linalg.norm(one - other, axis=-1)
    return np.asarray(2 * np.arcsin(np.minimum(chord / 2, 1)), dtype=np.float64)


def _interpolation_matrix(
    space: fem.FunctionSpace, n: int, rows: Any, nodes: Any, weights: Array
) -> PETSc.Mat:
    """Displacements at ``n`` places of this rank, some of which are interpolated. Collective."""
    d, bs = space.mesh.geometry.dim, space.dofmap.bs
    order = np.argsort(rows)
    filled = np.zeros(n, dtype=np.int64)
    filled[rows] = nodes.shape[1]
    columns = nodes[order][:, None, :] * bs + np.arange(d)[None, :, None]
    values = np.broadcast_to(weights[order][:, None, :], columns.shape)
    return PETSc.Mat().createAIJ(
        ((n * d, None), (space.dofmap.index_map.size_local * bs, None)),
        csr=(
            np.concatenate([[0], np.cumsum(np.repeat(filled, d))]).astype(PETSc.IntType),
            columns.ravel().astype(PETSc.IntType),
            values.ravel(),
        ),
        comm=space.mesh.comm,
    )
