"""A deformable body as the obstacle: what of it lies opposite every point of Γc.

From a point b of Γc the normal is followed to the opposite surface (paper, section 2.1); where it
meets it, at the point a, stands u_a. That alone would load the opposite body unevenly where the
meshes do not match: a uniform pressure would not give the nodal forces of a uniform pressure. So,
on every facet of Γc, the opposite displacement is projected (L2) on the polynomials that the
facet's quadrature points carry, with integrals over the pieces into which the opposite facets cut
it. The result is one sparse matrix G, u_a = G u at the quadrature points; constant pressures pass
exactly (patch test), and so do constant and linear displacements.
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

from fenics_contact.compat import sparse_matrix
from fenics_contact.obstacles.deformable import DeformableBody
from fenics_contact.parallel import collective_errors, gather_rows, global_max, global_mean
from fenics_contact.surface.facets import tabulate
from fenics_contact.surface.projection import (
    cut_lines,
    cut_polygons,
    find_facing_pairs,
    find_near_pairs,
    polynomial_space,
)
from fenics_contact.surface.rays import BEHIND, Hits, Rays
from fenics_contact.surface.surface import SurfaceQuadrature
from fenics_contact.tolerances import FLAT
from fenics_contact.types import Array, Index

__all__ = ["Pairing", "PresentHits"]


# Of a distance, by the size of the coordinates that it is the difference of.
_ROUND_OFF = 16 * np.finfo(float).eps


@dataclass(frozen=True)
class PresentHits:
    """What the normals of the deformed Γc meet of the opposite surface.

    Attributes:
        u: Values of the displacement.
        facets: Facets of this rank whose lattice is among the places.
        facet, reference: Facet of this rank and reference coordinates of every place: the points,
            then those of `FacetSet.lattice`.
        normal: Outward unit normals there, (n, d).
        hits: What they meet.
    """

    u: Array
    facets: Index
    facet: Index
    reference: Array
    normal: Array
    hits: Hits


class Pairing:
    """The surface opposite Γc, ready to be paired with the points of Γc.

    The constructor is collective, and collects both surfaces.

    Attributes:
        rays: Both surfaces, and what rays from one meet of the other.
        round_off: Distances no larger than this are differences of coordinates and nothing else.

    Raises:
        ValueError: The opposite facets are no part of the boundary; see `ContactSurface`.
    """

    def __init__(
        self, obstacle: DeformableBody, quadrature: SurfaceQuadrature, space: fem.FunctionSpace
    ) -> None:
        mesh = space.mesh
        self._comm, self._d = mesh.comm, mesh.topology.dim
        self._obstacle, self._quadrature = obstacle, quadrature
        self.round_off = _ROUND_OFF * global_max(mesh.comm, np.abs(mesh.geometry.x))
        self.rays = rays = Rays(obstacle, quadrature, space)
        self._here, self._there = rays.here.facets, rays.there.facets
        self._sides, self._facet, self._space = (rays.here, rays.there), rays.facet, space
        self._place: Array | None = None
        self._present: PresentHits | None = None

    def pair(
        self, x: Array, normal: Array, u: fem.Function | None, penetration: Array
    ) -> tuple[PETSc.Mat, PETSc.Mat, Array, Any]:
        """Find the opposites of the points. Collective.

        Args:
            x: The points in the undeformed body, (n_points, d).
            normal: Unit normals from body to obstacle, (n_points, d).
            u: Displacement at which to pair; none: undeformed.
            penetration: Of the points as they have been paired, ≥ 0, (n_points,) (length).

        Returns:
            G, (d n_points, n_dofs); the same without projection, of the places that the normals
            meet; and the distance s along the normal between the paired places *in the undeformed
            bodies*, so that s - u_n is the present one; NaN without opposite. And why there is
            none, one of `rays.REASONS`, (n_points,).
        """
        place = self.located(x)
        deep = self.largest(penetration)
        if u is None:
            found, start = self.at_rest(place, x, normal)
            deep = np.maximum(deep, start)
        else:
            found = self.rays.follow(self._facet, place, normal, u, deep)
        paired = ~np.isnan(found.distance)
        gap = np.einsum("qd,qd->q", found.place - x, normal)
        gap[np.abs(gap) <= self.round_off] = 0.0
        away = np.zeros(len(self._here.cells))
        np.maximum.at(away, self._facet[paired], np.abs(found.distance[paired]))
        facet, other, places, weights, share = self._pieces(u, away)
        ray = self._here.normals(facet, places)
        pieces = self.rays.follow(facet, places, ray, u, deep)
        facet = self._only_met(facet, other, share, pieces.facet)
        # Facets that are not covered, or some of whose points look past the other body, keep
        # the interpolation at their points.
        cut = facet >= 0
        good = np.bincount(facet[cut], minlength=len(self._here.cells)) > 0
        good[facet[cut & (pieces.facet < 0)]] = False
        good[self._facet[~paired]] = False
        projection = self._projection(place, facet, places, weights, good)
        at_points, at_pieces = found.matrix(self._space), pieces.matrix(self._space)
        matrix = projection.matMult(at_pieces)
        keep, kept = at_points.createVecLeft(), at_points.copy()
        keep.array[:] = np.repeat(~good[self._facet], self._d)
        kept.diagonalScale(keep, None)
        matrix.axpy(1.0, kept, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        for item in (projection, at_pieces, kept, keep):
            item.destroy()
        return matrix, at_points, gap, found.reason

    def at_rest(self, place: Array, x: Array, normal: Array) -> tuple[Hits, Array]:
        """What the points meet in the undeformed bodies. Collective.

        Args:
            place: Of the points on their facets, (n_points, d - 1).
            x: Likewise, (n_points, d).
            normal: From body to obstacle, (n_points, d).

        Returns:
            That, and how deep the bodies are in each other at each of all facets of Γc (length).
        """
        none = np.zeros(len(self._sides[0].body))
        found = self.rays.follow(self._facet, place, normal, None, none)
        if self._obstacle.max_initial_penetration is None:
            inside = self._inside(x, found.reason == BEHIND)
            if self._comm.allreduce(np.count_nonzero(inside)):
                deep = none.copy()
                deep[self._sides[0].first + self._facet[inside]] = np.inf
                self._comm.Allreduce(MPI.IN_PLACE, deep, op=MPI.MAX)
                found = self.rays.follow(self._facet, place, normal, None, deep)
        return found, self.largest(np.nan_to_num(-found.distance))

    def largest(self, values: Array) -> Array:
        """The largest of the points' values on each of all facets of Γc, ≥ 0. Collective."""
        largest = np.zeros(len(self._here.cells))
        np.maximum.at(largest, self._facet, values)
        return np.concatenate(self._comm.allgather(largest))

    def nearby(
        self, u: fem.Function, before: fem.Function | None, depth: float
    ) -> tuple[Index, Index]:
        """Facets of this rank, of Γc and opposite, that may meet one of the other side. Collective.

        Beyond them no ray meets a body from inside, and nothing was crossed on the way.

        Args:
            u: Displacement of the bodies.
            before: That from which on they have gone straight on; None: they have always been here.
            depth: Largest penetration of the points (length).
        """
        comm, sides = self._comm, self._sides
        ends = [side.facets.bounding_balls(u) for side in sides]
        starts = ends if before is None else [side.facets.bounding_balls(before) for side in sides]
        ways = [end[0] - start[0] for start, end in zip(starts, ends, strict=True)]
        shift = global_mean(comm, ways[0])  # by which all have moved together
        balls = []
        for side, start, end, way in zip(sides, starts, ends, ways, strict=True):
            half = (way - shift) / 2
            radius = np.maximum(start[1], end[1]) + np.linalg.norm(half, axis=1)
            balls.append((end[0] - half, radius + side.height[side.own]))
        (one, reach), (other, size) = ([gather_rows(comm, v) for v in ball] for ball in balls)
        reach = reach + max(2 * depth, self._obstacle.max_initial_penetration or 0.0)
        tree = scipy.spatial.cKDTree(other)
        here, there = find_near_pairs(tree, one, reach + size.max(initial=0.0))
        close = np.linalg.norm(one[here] - other[there], axis=1) <= reach[here] + size[there]
        found = []
        for side, number in zip(self._sides, (here[close], there[close]), strict=True):
            mine = np.unique(number) - side.first
            found.append(mine[(mine >= 0) & (mine < len(side.facets.cells))])
        return found[0], found[1]

    def true_gap(self, x: Array, u: fem.Function, penetration: Array) -> tuple[Array, Array]:
        """Distance to the opposite along the normal of Γc, both deformed. Collective.

        Args:
            x: The points in the undeformed body, (n_points, d).
            u: Displacement of the bodies.
            penetration: As for `pair`.

        Returns:
            The distance, (n_points,) (length), NaN where there is no opposite; unit normals,
            (n_points, d).
        """
        n = len(self.located(x))
        found = self.present_hits(x, u, penetration)
        return found.hits.distance[:n], found.normal[:n].copy()

    def present_hits(
        self, x: Array, u: fem.Function, penetration: Array, facets: Index | None = None
    ) -> PresentHits:
        """What the present normals of Γc meet, at points and between; once a state. Collective.

        All is as for `true_gap`, and ``facets`` are those of this rank on whose lattice to look,
        too; by default those of the last call.
        """
        present = self._present
        known = present is not None and np.array_equal(present.u, u.x.array)
        if present is not None and facets is not None:
            known &= np.array_equal(present.facets, facets)
        if self._comm.allreduce(int(not known)) or present is None:
            facets = np.zeros(0, dtype=np.int64) if facets is None else facets
            facet, reference = self._here.lattice(facets)
            facet = np.concatenate([self._facet, facet])
            reference = np.concatenate([self.located(x), reference])
            normal = self._here.normals(facet, reference, u)
            undeformed = self._here.normals(facet, reference)
            deep = self.largest(penetration)
            hits = self.rays.follow(
                facet, reference, normal, u, deep, undeformed=undeformed, before=u
            )
            present = PresentHits(u.x.array.copy(), facets, facet, reference, normal, hits)
            self._present = present
        return present

    def located(self, x: Array) -> Array:
        """Reference coordinates of the points on their facets, (n_points, d - 1); found once.

        Args:
            x: The points in the undeformed body, (n_points, d).
        """
        if self._place is None:
            self._place = self._here.locate(self._facet, x)
        return self._place

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
                found[i] = np.any(self.rays.body[space.dofmap.list[cells.links(i), 0]] != body)
        comm.Allreduce(MPI.IN_PLACE, found, op=MPI.MAX)
        inside = np.zeros(len(x), dtype=np.bool_)
        start = sum(counts[: comm.rank])
        inside[doubtful] = found[start : start + counts[comm.rank]] > 0
        return inside

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
        doubtful = np.abs(np.bincount(facet, share, n) - 1) > FLAT
        doubtful[facet[here.body[here.first + facet] == there.body[other]]] = True
        if not doubtful.any():
            return facet
        ends = there.vertices[other][:, :, None] == there.vertices[hit][:, None, :]
        kept = ~doubtful[facet] | ((hit >= 0) & ends.any(axis=(1, 2)))
        full = np.abs(np.bincount(facet, share * kept, n) - 1) <= FLAT
        return np.where(kept & full[facet], facet, -1)

    def _projection(
        self, place: Array, facet: Any, places: Array, weights: Array, good: Any
    ) -> PETSc.Mat:
        """L2 projection, facet by facet, from the pieces' points to the quadrature points."""
        d = self._d
        rows = self._quadrature.point_rows
        basis = polynomial_space(self._here.kind, rows.shape[1])
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
        return sparse_matrix(self._comm, m * d, local.indptr, local.indices + first, local.data)

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
        pairs = find_facing_pairs(moved_here, mean, there, looks, away)
        facet, other, points, weights, share = cut(moved_here, mean, there, pairs, self._degree())
        return facet, other, here.locate(facet, points, u), weights, share

    def _degree(self) -> int:
        """Degree of the integrands on a piece: polynomial of the points times displacement.

        And times themselves. In space pieces are triangles: there functions of a quadrilateral's
        facet have twice the degree that they have along each of its sides.
        """
        degree = self._there.space.ufl_element().degree
        found = self._quadrature.degree + degree
        if self._d == 3 and not self._here.simplex:
            n_points = self._quadrature.point_rows.shape[1]
            own = polynomial_space(self._here.kind, n_points).degree
            found = max(found, 2 * (own + max(own, degree)))
        return int(found)
