"""A deformable body as the support: what of it lies opposite every point of Γc.

From a point b of Γc the normal is followed to the opposite surface (paper, section 2.1); where it
meets it, at the point a, stands u_a. That alone would load the opposite body unevenly where the
meshes do not match: a uniform pressure would not give the nodal forces of a uniform pressure. So,
on every facet of Γc, the opposite displacement is projected (L2) on the polynomials that the
facet's quadrature points carry, with integrals over the pieces into which the opposite facets cut
it. The result is one sparse matrix G, u_a = G u at the quadrature points; constant pressures pass
exactly (patch test), and so do constant and linear displacements.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import basix
import dolfinx
import numpy as np
import numpy.typing as npt
import scipy.sparse
import scipy.spatial
from dolfinx import fem
from petsc4py import PETSc

from fenics_contact.facets import FacetSet, tabulate
from fenics_contact.parallel import collective_errors, gather_rows
from fenics_contact.supports import Support
from fenics_contact.surface import SurfaceQuadrature, tagged_facets

__all__ = ["DeformableBody", "Opposite"]

Array = npt.NDArray[np.float64]

# Pieces of a facet smaller than this, relative to it, are left out; a facet is covered if what is
# left out is no more.
_SLIVER = 1e-9
_COVERED = 1e-6


@dataclass(frozen=True)
class DeformableBody(Support):
    """The support is another part of the same mesh and displacement space.

    Γc should be the surface of the softer or more finely meshed body. Forces on both are equal and
    opposite to round-off.

    Args to the constructor:
        facet_tags: Tags on the facets of the mesh.
        tags: Tag, or tags, of the opposite surface.
        reach: Points whose opposite lies farther (length) than this have none; no limit by default.
        update: "never": the pairs are those of the undeformed bodies; "increment": they are found
            anew in the deformed bodies at every commit, for slip over many facets. Normals stay
            those of the undeformed Γc (small rotations).
    """

    facet_tags: dolfinx.mesh.MeshTags
    tags: int | Sequence[int]
    reach: float = np.inf
    update: str = "never"

    def __post_init__(self) -> None:
        """Refuse what has no sense."""
        if not self.reach > 0:
            raise ValueError(f"reach is {self.reach!r}; it must be a length greater than zero")
        if self.update not in ("never", "increment"):
            raise ValueError(f"update is {self.update!r}; use 'never' or 'increment'")


class Opposite:
    """The surface opposite Γc, ready to be paired with the points of Γc."""

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
        facets = tagged_facets(mesh, support.facet_tags, support.tags)
        self._there = FacetSet(space, facets)
        self._here = FacetSet(space, quadrature.surface.facets)
        # Facet of Γc of every owned point: the points of a facet are the dofs of a submesh cell.
        rows = quadrature.point_rows()
        self._facet = np.empty(quadrature.n_points, dtype=np.int64)
        self._facet[rows.ravel()] = np.repeat(np.arange(len(rows)), rows.shape[1])

    def pair(self, x: Array, normal: Array, u: fem.Function | None) -> tuple[PETSc.Mat, Array]:
        """Find the opposites of the points. Collective.

        Args:
            x: The points in the undeformed body, (n_points, d).
            normal: Unit normals from body to support, (n_points, d).
            u: Displacement at which to pair; none: undeformed.

        Returns:
            G, (d n_points, n_dofs), and the distance s along the normal between the paired places
            *in the undeformed bodies*, so that s - u_n is the present one; NaN without opposite.
        """
        place, _, _ = self._here.meet(self._facet, x, normal)
        pointwise, opposite = self._find(self._facet, place, normal, u)
        paired = ~np.isnan(opposite[:, 0])
        gap = np.einsum("qd,qd->q", opposite - x, normal)
        facet, places, weights = self._pieces(u)
        ray = self._here.normals(facet, places)
        at_pieces, met = self._find(facet, places, ray, u)
        # Facets that are not covered, or some of whose points look past the other body, keep
        # the interpolation at their points.
        n_facets = len(self._here.cells)
        good = np.bincount(facet, minlength=n_facets) > 0
        good[facet[np.isnan(met[:, 0])]] = False
        good[self._facet[~paired]] = False
        projection = self._projection(place, facet, places, weights, good)
        matrix = projection.matMult(at_pieces)
        keep = pointwise.createVecLeft()
        keep.array[:] = np.repeat(~good[self._facet], self._d)
        pointwise.diagonalScale(keep, None)
        matrix.axpy(1.0, pointwise, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        for item in (projection, at_pieces, pointwise, keep):
            item.destroy()
        return matrix, gap

    def _find(
        self, facet: Any, place: Array, ray: Array, u: fem.Function | None
    ) -> tuple[PETSc.Mat, Array]:
        """Follow rays from places on Γc: interpolation matrix and undeformed places met."""
        comm, d, space = self._comm, self._d, self._there.space
        x, _ = self._here.positions(facet, place, u)
        counts = comm.allgather(len(x))
        everyone = np.concatenate(comm.allgather(x)), np.concatenate(comm.allgather(ray))
        hit, where, distance = self._there.search(*everyone, self._support.reach, u)
        # The nearest over the ranks is met; of equals the lowest rank's.
        reached = np.array(comm.allgather(np.where(hit >= 0, np.abs(distance), np.inf)))
        mine = (np.argmin(reached, axis=0) == comm.rank) & (hit >= 0)
        starts = np.concatenate([[0], np.cumsum(counts)])
        messages = []
        for rank in range(comm.size):
            local = np.flatnonzero(mine[starts[rank] : starts[rank + 1]])
            points = starts[rank] + local
            nodes, weights = self._there.interpolation(hit[points], where[points])
            places, _ = self._there.positions(hit[points], where[points])
            messages.append((local, nodes, weights, places))
        local, nodes, weights, places = (
            np.concatenate(parts) for parts in zip(*comm.alltoall(messages), strict=True)
        )
        n = len(x)
        order = np.argsort(local)
        filled = np.zeros(n, dtype=np.int64)
        filled[local] = nodes.shape[1]
        bs = space.dofmap.bs
        columns = nodes[order][:, None, :] * bs + np.arange(d)[None, :, None]
        values = np.broadcast_to(weights[order][:, None, :], columns.shape)
        matrix = PETSc.Mat().createAIJ(
            ((n * d, None), (space.dofmap.index_map.size_local * bs, None)),
            csr=(
                np.concatenate([[0], np.cumsum(np.repeat(filled, d))]).astype(PETSc.IntType),
                columns.ravel().astype(PETSc.IntType),
                values.ravel(),
            ),
            comm=comm,
        )
        met = np.full((n, d), np.nan)
        met[local] = places
        return matrix, met

    def _projection(
        self, place: Array, facet: Any, places: Array, weights: Array, good: Any
    ) -> PETSc.Mat:
        """L2 projection, facet by facet, from the pieces' points to the quadrature points."""
        d = self._d
        rows = self._quadrature.point_rows()
        basis = _polynomials(d, self._here.simplex, rows.shape[1])
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

    def _pieces(self, u: fem.Function | None) -> tuple[Any, Array, Array]:
        """Cut the facets of Γc along the opposite ones: points with weights on the pieces.

        Facets are cut as if they were flat, along their mean normals; of curved ones only the cuts
        are a little off. Uncovered facets have no points.

        Returns:
            Facet of Γc, (m,); place on it, (m, d - 1); weight, (m,).
        """
        here, d = self._here, self._d
        moved_here, moved_there = here.moved_corners(u), self._there.moved_corners(u)
        there = gather_rows(self._comm, moved_there)
        looks = gather_rows(self._comm, self._there.mean_normals())
        mean = here.mean_normals()
        cut = _cut_lines if d == 2 else _cut_polygons
        facet, points, weights = cut(moved_here, mean, there, looks, self._degree())
        places, _, _ = here.meet(facet, points, mean[facet], u)
        return facet, places, weights

    def _degree(self) -> int:
        """Degree of the integrands on a piece: polynomial of the points times displacement."""
        return self._quadrature.degree + self._there.space.ufl_element().degree


def _polynomials(d: int, simplex: bool, n_points: int) -> Any:
    """The largest complete polynomial space on a facet that ``n_points`` points can carry."""
    cell = basix.CellType.interval if d == 2 else basix.CellType.triangle
    if d == 3 and not simplex:
        cell = basix.CellType.quadrilateral
    chosen = None
    for degree in range(n_points):
        element = basix.create_element(
            basix.ElementFamily.P, cell, degree, basix.LagrangeVariant.legendre, discontinuous=True
        )
        if element.dim > n_points:
            break
        chosen = element
    return chosen


def _candidates(here: Array, mean: Array, there: Array, looks: Array) -> tuple[Any, Any]:
    """Pairs of facets that face each other and may overlap along the normal.

    Their bounding balls overlap once the distance along the normal is ignored; ``mean`` and
    ``looks`` are the facets' mean normals.

    Nearest first would miss far bodies: the balls are compared around the nearest neighbours.
    """
    if not (len(here) and len(there)):
        return np.zeros(0, dtype=int), np.zeros(0, dtype=int)
    centre, other = here.mean(axis=1), there.mean(axis=1)
    radius = np.linalg.norm(here - centre[:, None], axis=2).max(axis=1)
    largest = np.linalg.norm(there - other[:, None], axis=2).max(initial=0.0)
    tree = scipy.spatial.cKDTree(other)
    nearest, _ = tree.query(centre)
    found = tree.query_ball_point(centre, 1.01 * (np.hypot(nearest, radius + largest) + radius))
    first = np.repeat(np.arange(len(here)), [len(f) for f in found])
    second = np.concatenate([np.zeros(0, dtype=int), *(np.asarray(f, dtype=int) for f in found)])
    facing = np.einsum("pd,pd->p", mean[first], looks[second]) < 0
    return first[facing], second[facing]


def _cut_lines(
    here: Array, mean: Array, there: Array, looks: Array, degree: int
) -> tuple[Any, Array, Array]:
    """Cut the facets of a plane problem at the ends of the opposite ones."""
    rule, shares = basix.make_quadrature(basix.CellType.interval, degree)
    first, second = _candidates(here, mean, there, looks)
    facets, points, weights = [], [], []
    for f in np.unique(first):
        origin, edge = here[f, 0], here[f, 1] - here[f, 0]
        ends = (there[second[first == f]] - origin) @ edge / (edge @ edge)
        low, high = ends.min(axis=1).clip(0, 1), ends.max(axis=1).clip(0, 1)
        kept = high - low > _SLIVER
        low, high = low[kept], high[kept]
        if abs((high - low).sum() - 1) > _COVERED:
            continue
        along = (low[:, None] + (high - low)[:, None] * rule[None, :, 0]).ravel()
        facets.append(np.full(along.size, f))
        points.append(origin + along[:, None] * edge)
        weights.append(((high - low)[:, None] * shares[None]).ravel())
    return _join(facets, points, weights, 2)


def _cut_polygons(
    here: Array, mean: Array, there: Array, looks: Array, degree: int
) -> tuple[Any, Array, Array]:
    """Cut the facets of a spatial problem into triangles, by polygons in the facet's plane."""
    rule, shares = basix.make_quadrature(basix.CellType.triangle, degree)
    first, second = _candidates(here, mean, there, looks)
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
    covered = np.abs(np.bincount(first, twice.sum(axis=1), len(here)) / size - 1) <= _COVERED
    kept = (twice > _SLIVER * size[first][:, None]) & covered[first][:, None]
    pair, fan = np.nonzero(kept)
    inside = corner[pair, fan, None, 0] + np.einsum("qk,tke->tqe", rule, edge[pair, fan])
    facet = np.repeat(first[pair], len(rule))
    points = origin[facet] + np.einsum("pe,pde->pd", inside.reshape(-1, 2), plane[facet])
    return facet, points, (twice[pair, fan][:, None] * shares[None]).ravel()


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


def _join(facets: list[Any], points: list[Array], weights: list[Array], d: int) -> Any:
    return (
        np.concatenate([np.zeros(0, dtype=np.int64), *facets]),
        np.concatenate([np.zeros((0, d)), *points]),
        np.concatenate([np.zeros(0), *weights]),
    )
