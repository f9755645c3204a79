"""Pairing of Γc with a deformable body by normal projection and a segmented L2 projection.

The displacement u_a of the opposing (master) body at the points of Γc (slave) is one sparse matrix,
u_a = G u. On every slave facet the master displacement is L2-projected on the polynomials that its
quadrature points determine, with integrals over the segments cut by the master facets. Constant
pressures (patch test) and linear displacements are transferred exactly on non-matching meshes.
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

from fenics_contact.compat import create_csr_matrix
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
from fenics_contact.tolerances import EVALUATION_ROUND_OFF, FLAT
from fenics_contact.types import Array, Index

__all__ = ["Pairing", "PresentHits"]


@dataclass(frozen=True)
class PresentHits:
    """Hits of the normals of the deformed Γc on the opposing surface.

    Attributes:
        u: Values of the displacement.
        facets: Facets of this rank whose lattice is included.
        facet, reference: Facet of this rank and reference coordinates of every origin: the points,
            then those of `FacetSet.lattice`.
        normal: Outward unit normals, (n, d).
        hits: Hits of the normals.
    """

    u: Array
    facets: Index
    facet: Index
    reference: Array
    normal: Array
    hits: Hits


class Pairing:
    """Search for the points opposite those of Γc on a deformable body.

    The constructor is collective, and gathers both surfaces.

    Attributes:
        rays: Ray tracing between both surfaces.
        round_off: Round-off of distances (length).

    Raises:
        ValueError: The opposing facets are not a part of the boundary.
    """

    def __init__(
        self, obstacle: DeformableBody, quadrature: SurfaceQuadrature, space: fem.FunctionSpace
    ) -> None:
        mesh = space.mesh
        self._comm, self._d = mesh.comm, mesh.topology.dim
        self._obstacle, self._quadrature = obstacle, quadrature
        self.round_off = EVALUATION_ROUND_OFF * global_max(mesh.comm, np.abs(mesh.geometry.x))
        self.rays = rays = Rays(obstacle, quadrature, space)
        self._slave, self._master = rays.slave.facets, rays.master.facets
        self._sides, self._facet, self._space = (rays.slave, rays.master), rays.facet, space
        self._xi: Array | None = None
        self._hits: PresentHits | None = None

    def pair(
        self, x: Array, normal: Array, u: fem.Function | None, penetration: Array
    ) -> tuple[PETSc.Mat, PETSc.Mat, Array, Any]:
        """Pair the points with the opposing body. Collective.

        Args:
            x: Undeformed points, (n_points, d).
            normal: Unit normals from body to obstacle, (n_points, d).
            u: Displacement at which to pair; None: undeformed.
            penetration: Penetration of the points in their last pairing, ≥ 0, (n_points,) (length).

        Returns:
            G, (d n_points, n_dofs); the interpolation at the opposite points, without projection;
            the gap s along the normal *of the undeformed pair*, NaN if unpaired, so that s - u_n is
            the present gap; and the reason for unpaired points, a key of `rays.REASONS`.
        """
        xi = self.located(x)
        penetration_bound = self.largest(penetration)
        if u is None:
            hits, start = self.at_rest(xi, x, normal)
            penetration_bound = np.maximum(penetration_bound, start)
        else:
            hits = self.rays.trace(self._facet, xi, normal, u, penetration_bound)
        paired = ~np.isnan(hits.distance)
        gap = np.einsum("qd,qd->q", hits.place - x, normal)
        gap[np.abs(gap) <= self.round_off] = 0.0
        distance = np.zeros(len(self._slave.cells))
        np.maximum.at(distance, self._facet[paired], np.abs(hits.distance[paired]))
        facet, other, points, weights, fraction = self._cut_facets(u, distance)
        ray = self._slave.normals(facet, points)
        segments = self.rays.trace(facet, points, ray, u, penetration_bound)
        facet = self._drop_false_segments(facet, other, fraction, segments.facet)
        # Facets that are not covered, or have unpaired points, use interpolation at their points.
        cut = facet >= 0
        projected = np.bincount(facet[cut], minlength=len(self._slave.cells)) > 0
        projected[facet[cut & (segments.facet < 0)]] = False
        projected[self._facet[~paired]] = False
        projection = self._build_projection(xi, facet, points, weights, projected)
        at_points, at_segments = hits.matrix(self._space), segments.matrix(self._space)
        matrix = projection.matMult(at_segments)
        mask, interpolated = at_points.createVecLeft(), at_points.copy()
        mask.array[:] = np.repeat(~projected[self._facet], self._d)
        interpolated.diagonalScale(mask, None)
        matrix.axpy(1.0, interpolated, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        for item in (projection, at_segments, interpolated, mask):
            item.destroy()
        return matrix, at_points, gap, hits.reason

    def at_rest(self, xi: Array, x: Array, normal: Array) -> tuple[Hits, Array]:
        """Trace normals of undeformed points x with reference coordinates ξ. Collective.

        Returns:
            Hits, and the initial penetration at each of all facets of Γc (length).
        """
        zero = np.zeros(len(self._sides[0].body))
        hits = self.rays.trace(self._facet, xi, normal, None, zero)
        if self._obstacle.max_initial_penetration is None:
            inside = self._points_inside(x, hits.reason == BEHIND)
            if self._comm.allreduce(np.count_nonzero(inside)):
                penetration_bound = zero.copy()
                penetration_bound[self._sides[0].first + self._facet[inside]] = np.inf
                self._comm.Allreduce(MPI.IN_PLACE, penetration_bound, op=MPI.MAX)
                hits = self.rays.trace(self._facet, xi, normal, None, penetration_bound)
        return hits, self.largest(np.nan_to_num(-hits.distance))

    def largest(self, values: Array) -> Array:
        """Return the maximum of point values on each of all facets of Γc, ≥ 0. Collective."""
        largest = np.zeros(len(self._slave.cells))
        np.maximum.at(largest, self._facet, values)
        return np.concatenate(self._comm.allgather(largest))

    def find_candidate_facets(
        self, u: fem.Function, before: fem.Function | None, depth: float
    ) -> tuple[Index, Index]:
        """Find local facets of both sides that may penetrate or have crossed others. Collective.

        Args:
            u: Displacement of the bodies.
            before: Displacement at the start of their straight motion; None: no motion.
            depth: Largest penetration of the points (length).
        """
        comm, sides = self._comm, self._sides
        ends = [side.facets.bounding_balls(u) for side in sides]
        starts = ends if before is None else [side.facets.bounding_balls(before) for side in sides]
        translations = [end[0] - start[0] for start, end in zip(starts, ends, strict=True)]
        shift = global_mean(comm, translations[0])  # common translation
        balls = []
        for side, start, end, translation in zip(sides, starts, ends, translations, strict=True):
            half = (translation - shift) / 2
            radius = np.maximum(start[1], end[1]) + np.linalg.norm(half, axis=1)
            balls.append((end[0] - half, radius + side.height[side.own]))
        (one, reach), (other, size) = ([gather_rows(comm, v) for v in ball] for ball in balls)
        reach = reach + max(2 * depth, self._obstacle.max_initial_penetration or 0.0)
        tree = scipy.spatial.cKDTree(other)
        slave, master = find_near_pairs(tree, one, reach + size.max(initial=0.0))
        close = np.linalg.norm(one[slave] - other[master], axis=1) <= reach[slave] + size[master]
        found = []
        for side, number in zip(self._sides, (slave[close], master[close]), strict=True):
            local = np.unique(number) - side.first
            found.append(local[(local >= 0) & (local < len(side.facets.cells))])
        return found[0], found[1]

    def true_gap(self, x: Array, u: fem.Function, penetration: Array) -> tuple[Array, Array]:
        """Compute present gaps along the normals of the deformed Γc. Collective.

        Returns:
            Gaps, (n_points,) (length), NaN if unpaired; unit normals, (n_points, d).
        """
        n = len(self.located(x))
        found = self.trace_present(x, u, penetration)
        return found.hits.distance[:n], found.normal[:n].copy()

    def trace_present(
        self, x: Array, u: fem.Function, penetration: Array, facets: Index | None = None
    ) -> PresentHits:
        """Trace the present normals of Γc at the points and on the lattice of facets. Collective.

        The result is cached until the displacement changes. ``facets`` are those of the last call
        by default.
        """
        present = self._hits
        is_current = present is not None and np.array_equal(present.u, u.x.array)
        if present is not None and facets is not None:
            is_current &= np.array_equal(present.facets, facets)
        if self._comm.allreduce(int(not is_current)) or present is None:
            facets = np.zeros(0, dtype=np.int64) if facets is None else facets
            facet, reference = self._slave.lattice(facets)
            facet = np.concatenate([self._facet, facet])
            reference = np.concatenate([self.located(x), reference])
            normal = self._slave.normals(facet, reference, u)
            undeformed = self._slave.normals(facet, reference)
            penetration_bound = self.largest(penetration)
            hits = self.rays.trace(
                facet, reference, normal, u, penetration_bound, undeformed=undeformed, before=u
            )
            present = PresentHits(u.x.array.copy(), facets, facet, reference, normal, hits)
            self._hits = present
        return present

    def located(self, x: Array) -> Array:
        """Return reference coordinates of the undeformed points, (n_points, d - 1), cached."""
        if self._xi is None:
            self._xi = self._slave.locate(self._facet, x)
        return self._xi

    def _points_inside(self, x: Array, doubtful: Any) -> Any:
        """Return which of the points selected by a mask lie in another body. Collective."""
        comm, space = self._comm, self._slave.space
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

    def _drop_false_segments(self, facet: Any, other: Any, fraction: Array, hit: Any) -> Any:
        """Drop segments cut by facets that are not opposite, where the cover is ambiguous.

        ``other`` is the master facet that cuts a segment, ``hit`` that hit by the normal. Returns
        ``facet`` with -1 for dropped segments and for facets that are then not covered.
        """
        slave, master = self._sides
        n = len(self._slave.cells)
        doubtful = np.abs(np.bincount(facet, fraction, n) - 1) > FLAT
        doubtful[facet[slave.body[slave.first + facet] == master.body[other]]] = True
        if not doubtful.any():
            return facet
        ends = master.vertices[other][:, :, None] == master.vertices[hit][:, None, :]
        valid = ~doubtful[facet] | ((hit >= 0) & ends.any(axis=(1, 2)))
        full = np.abs(np.bincount(facet, fraction * valid, n) - 1) <= FLAT
        return np.where(valid & full[facet], facet, -1)

    def _build_projection(
        self, xi: Array, facet: Any, points: Array, weights: Array, projected: Any
    ) -> PETSc.Mat:
        """Build the facetwise L2 projection from segment points to quadrature points."""
        d = self._d
        rows = self._quadrature.point_rows
        basis = polynomial_space(self._slave.kind, rows.shape[1])
        order = np.argsort(facet, kind="stable")
        bounds = np.searchsorted(facet[order], np.arange(len(rows) + 1))
        at_points = tabulate(basis, 0, xi)[0, :, :, 0]
        at_segments = tabulate(basis, 0, points)[0, :, :, 0]
        lines, columns, values = [], [], []
        with collective_errors(self._comm):  # mass matrices may be singular
            for f in np.flatnonzero(projected):
                segment_points = order[bounds[f] : bounds[f + 1]]
                weighted = weights[segment_points, None] * at_segments[segment_points]
                inverse = np.linalg.solve(at_segments[segment_points].T @ weighted, weighted.T)
                lines.append(np.repeat(rows[f], len(segment_points)))
                columns.append(np.tile(segment_points, rows.shape[1]))
                values.append((at_points[rows[f]] @ inverse).ravel())
        n, m = self._quadrature.n_points, len(points)
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
        return create_csr_matrix(self._comm, m * d, local.indptr, local.indices + first, local.data)

    def _cut_facets(
        self, u: fem.Function | None, distance: Array
    ) -> tuple[Any, Any, Array, Array, Array]:
        """Cut the facets of Γc along the opposing ones and return quadrature points.

        Facets are cut as flat ones along their mean normals, which for curved facets is
        approximate. Uncovered facets have no points.

        Args:
            u: Displacement of the bodies.
            distance: Distance of the facets' points from their opposite points, (n_facets,).

        Returns:
            Slave facet, (m,); global master facet, (m,); slave reference coordinates, (m, d - 1);
            weight, (m,); weight as a fraction of the facet's area, (m,).
        """
        slave, d = self._slave, self._d
        slave_corners, local_corners = slave.displaced_corners(u), self._master.displaced_corners(u)
        master_corners = gather_rows(self._comm, local_corners)
        master_normal = gather_rows(self._comm, self._master.mean_normals())
        normal = slave.mean_normals()
        cut = cut_lines if d == 2 else cut_polygons
        pairs = find_facing_pairs(slave_corners, normal, master_corners, master_normal, distance)
        facet, other, points, weights, fraction = cut(
            slave_corners, normal, master_corners, pairs, self._integration_degree()
        )
        return facet, other, slave.locate(facet, points, u), weights, fraction

    def _integration_degree(self) -> int:
        """Return the degree of products of point polynomials with displacements or themselves.

        On triangles, functions of quadrilateral facets have twice the degree.
        """
        degree = self._master.space.ufl_element().degree
        found = self._quadrature.degree + degree
        if self._d == 3 and not self._slave.simplex:
            n_points = self._quadrature.point_rows.shape[1]
            own = polynomial_space(self._slave.kind, n_points).degree
            found = max(found, 2 * (own + max(own, degree)))
        return int(found)
