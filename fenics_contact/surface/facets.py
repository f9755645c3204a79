"""Geometry of a set of facets: positions, normals and intersections with rays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import basix
import dolfinx
import numpy as np
import scipy.spatial
from dolfinx import fem

from fenics_contact import compat
from fenics_contact.tolerances import FLAT, ROUND_OFF
from fenics_contact.types import Array, Index, Mask

__all__ = ["FacetSet", "across", "facet_cells", "facet_nodes", "local_facets", "tabulate"]

# Rule that selects admissible hits by point, facet, reference coordinates and signed distance.
Rule: TypeAlias = Callable[[Index, Index, Array, Array], Mask]

# Nearest facets that are tested first for every point.
_FIRST_CANDIDATES = 12
_MAX_NEWTON_STEPS = 25
# Point-facet pairs tested at once, which limits the memory.
_PAIRS_PER_CHUNK = 2_000_000
# Radius of a curved facet relative to the distance of its farthest corner.
_CURVED_RADIUS_RATIO = 1.3


def facet_cells(mesh: dolfinx.mesh.Mesh, facets: Index) -> Index:
    """Return the cell of every exterior facet of this rank, (n_facets,)."""
    d = mesh.topology.dim
    mesh.topology.create_connectivity(d - 1, d)
    to_cell = mesh.topology.connectivity(d - 1, d)
    return to_cell.array[to_cell.offsets[facets]]


def local_facets(mesh: dolfinx.mesh.Mesh, facets: Index) -> Index:
    """Return the local number of every exterior facet in its cell, (n_facets,)."""
    d = mesh.topology.dim
    mesh.topology.create_connectivity(d, d - 1)
    n = len(basix.topology(basix.CellType[mesh.topology.cell_name()])[d - 1])
    of_cell = mesh.topology.connectivity(d, d - 1).array.reshape(-1, n)
    return np.argmax(of_cell[facet_cells(mesh, facets)] == facets[:, None], axis=1)


def facet_nodes(space: fem.FunctionSpace, facets: Index) -> Index:
    """Return the nodes of a space on every exterior facet of this rank, (n_facets, n_nodes)."""
    mesh, layout = space.mesh, space.dofmap.dof_layout
    fdim = mesh.topology.dim - 1
    n = len(basix.topology(basix.CellType[mesh.topology.cell_name()])[fdim])
    closures = np.array([layout.entity_closure_dofs(fdim, i) for i in range(n)])
    cells, local = facet_cells(mesh, facets), local_facets(mesh, facets)
    return space.dofmap.list[cells[:, None], closures[local]]


class FacetSet:
    """Facets of this rank, parametrised by reference coordinates ξ of dimension d - 1.

    Methods take the local facet of every point, (n,), with ξ, (n, d - 1), and a displacement u.

    Args:
        space: Displacement space.
        facets: Facets of this rank, (n_facets,).

    Attributes:
        cells: Cell of every facet, (n_facets,).
        nodes: Local numbers of the displacement nodes on every facet, (n_facets, n_nodes).
        kind: Cell type of the facets.
        simplex: Whether the cells are simplices.
        outward: Sign of the facet's own orientation relative to the outward one, (n_facets,).
    """

    def __init__(self, space: fem.FunctionSpace, facets: Index) -> None:
        mesh = space.mesh
        self.space, self._x, self._d = space, mesh.geometry.x, mesh.topology.dim
        d = self._d
        self.cells, self.nodes = facet_cells(mesh, facets), facet_nodes(space, facets)
        local = local_facets(mesh, facets)
        cell_type = basix.CellType[mesh.topology.cell_name()]
        geometry, topology = basix.geometry(cell_type), basix.topology(cell_type)
        corners = np.array([geometry[vertices] for vertices in topology[d - 1]])
        origins = corners[:, 0]
        edges = np.swapaxes(corners[:, 1:d] - corners[:, :1], 1, 2)
        self._origin, self._edges = origins[local], edges[local]
        self.simplex = cell_type in (basix.CellType.triangle, basix.CellType.tetrahedron)
        self.kind = basix.CellType.interval
        if d == 3:
            self.kind = basix.CellType["triangle" if self.simplex else "quadrilateral"]
        vertices = basix.geometry(self.kind)
        ring = [0, 1, 3, 2] if d == 3 and not self.simplex else list(range(d))
        self._corners, self._middle = vertices[ring], vertices.mean(axis=0, keepdims=True)
        self._at_corners = np.array(topology[d - 1])[local][:, ring]
        self._geometry_basis = compat.geometry_element(mesh)
        self._basis = space.element.basix_element
        self._nodes = compat.geometry_dofmap(mesh)[self.cells]
        self._dofs = space.dofmap.list[self.cells]
        on_facet, tangents = self.positions(*self.combine(self._middle))
        table = tabulate(self._geometry_basis, 0, geometry.mean(axis=0)[None])[0, 0, :, 0]
        inside = np.einsum("k,pkd->pd", table, self._x[self._nodes][:, :, :d])
        self.outward = _orientation(tangents, on_facet - inside)

    def combine(self, points: Array, facets: Index | None = None) -> tuple[Index, Array]:
        """Combine facets, by default all, with reference points: (n m,), (n m, d - 1)."""
        facets = np.arange(len(self.cells)) if facets is None else facets
        return np.repeat(facets, len(points)), np.tile(points, (len(facets), 1))

    def _in_cell(self, facet: Index, xi: Array) -> Array:
        """Map reference coordinates of facets to those of their cells, (n, d)."""
        along = self._edges[facet] @ xi[:, :, None]
        return np.asarray(self._origin[facet] + along[:, :, 0])

    def _weights(self, basis: Any, facet: Index, points: Array) -> Array:
        """Tabulate a cell basis and its derivatives by ξ at points of the cell, (n, d, n_basis)."""
        table = np.swapaxes(tabulate(basis, 1, points)[..., 0], 0, 1)
        slopes = np.swapaxes(self._edges[facet], 1, 2) @ table[:, 1:]
        return np.concatenate([table[:, :1], slopes], axis=1)

    def positions(
        self, facet: Index, xi: Array, u: fem.Function | None = None
    ) -> tuple[Array, Array]:
        """Return positions x(ξ), (n, d), and tangents ∂x/∂ξ, (n, d, d - 1), displaced by ``u``."""
        points = self._in_cell(facet, xi)
        nodes = self._x[self._nodes[facet]][:, :, : self._d]
        found = self._weights(self._geometry_basis, facet, points) @ nodes
        if u is not None:
            values = u.x.array.reshape(-1, self.space.dofmap.bs)[self._dofs[facet]]
            found += self._weights(self._basis, facet, points) @ values
        return found[:, 0], np.swapaxes(found[:, 1:], 1, 2)

    def normals(self, facet: Index, xi: Array, u: fem.Function | None = None) -> Array:
        """Return outward unit normals of the body displaced by ``u``, (n, d)."""
        return self.outward_normals(facet, self.positions(facet, xi, u)[1])

    def outward_normals(self, facet: Index, tangents: Array) -> Array:
        """Return outward unit normals, (n, d), from tangents as returned by `positions`."""
        outward = self.outward[facet, None] * across(tangents)
        return np.asarray(outward / np.linalg.norm(outward, axis=1, keepdims=True))

    def displaced_corners(self, u: fem.Function | None) -> Array:
        """Return the corners displaced by ``u``, (n_facets, n_corners, d)."""
        corners, _ = self.positions(*self.combine(self._corners), u)
        return corners.reshape(len(self.cells), len(self._corners), self._d)

    def bounding_balls(self, u: fem.Function | None) -> tuple[Array, Array]:
        """Return bounding balls of the displaced facets: centres, (n_facets, d), and radii."""
        middle, _ = self.positions(*self.combine(self._middle), u)
        arms = np.linalg.norm(self.displaced_corners(u) - middle[:, None], axis=2)
        return middle, _CURVED_RADIUS_RATIO * arms.max(axis=1, initial=0.0)

    def mean_normals(self) -> Array:
        """Return outward unit normals at the facets' centres, (n_facets, d)."""
        return self.normals(*self.combine(self._middle))

    def corners(self) -> tuple[Index, Array]:
        """Return all facets with their corners and centres: facets, (n,), and ξ, (n, d - 1)."""
        return self.combine(np.vstack([self._corners, self._middle]))

    def lattice(self, facets: Index | None = None) -> tuple[Index, Array]:
        """Combine facets, by default all, with ξ of corners, edge midpoints and centres."""
        points = np.vstack([self._corners, self._middle])
        if self._d == 3:
            edges = (self._corners + np.roll(self._corners, -1, axis=0)) / 2
            points = np.vstack([points, edges])
        return self.combine(points, facets)

    def flat_pieces(self, degree: int) -> Array:
        """Return reference corners of the flat pieces of a facet, (n, n_corners, d - 1)."""
        corner = self._corners
        if degree == 1:
            return corner[None]
        if self._d == 2:
            return np.array([[[0.0], [0.5]], [[0.5], [1.0]]])
        edge = (corner + np.roll(corner, -1, axis=0)) / 2
        previous = np.roll(edge, 1, axis=0)
        if self.simplex:
            return np.concatenate([np.stack([corner, edge, previous], axis=1), edge[None]])
        middle = np.broadcast_to(self._middle, edge.shape)
        return np.stack([corner, edge, middle, previous], axis=1)

    def clipped(self, reference: Array) -> Array:
        """Clip reference coordinates, (n, d - 1), to the facet."""
        inside = np.clip(reference, 0.0, 1.0)
        if self.simplex:
            inside /= np.maximum(inside.sum(axis=1, keepdims=True), 1.0)
        return inside

    def corner_vertices(self) -> Index:
        """Return global vertex numbers of the facets, (n_facets, n_corners)."""
        return np.take_along_axis(self.vertices(), self._at_corners, axis=1)

    def heights(self) -> Array:
        """Return the heights of the cells over their facets, (n_facets,) (length)."""
        middle, _ = self.positions(*self.combine(self._middle))
        arm = middle[:, None] - self._x[self._nodes][:, :, : self._d]
        depth: Array = np.einsum("fkd,fd->fk", arm, self.mean_normals())
        return depth.max(axis=1, initial=0.0)

    def vertices(self) -> Index:
        """Return global vertex numbers of the cells, as displacement nodes, (n_facets, n)."""
        n = len(basix.topology(basix.CellType[self.space.mesh.topology.cell_name()])[0])
        layout = self.space.dofmap.dof_layout
        local = self._dofs[:, [layout.entity_dofs(0, i)[0] for i in range(n)]]
        nodes = self.space.dofmap.index_map.local_to_global(local.ravel().astype(np.int32))
        return nodes.reshape(local.shape)

    def interpolation(self, facet: Index, xi: Array) -> tuple[Index, Array]:
        """Return global displacement nodes, (n, n_basis), and their weights at points.

        The weights, (n, d, n_basis), are basis functions and their derivatives by ξ.
        """
        local = self._dofs[facet]
        nodes = self.space.dofmap.index_map.local_to_global(local.ravel().astype(np.int32))
        weights = self._weights(self._basis, facet, self._in_cell(facet, xi))
        return nodes.reshape(local.shape), weights

    def search(
        self, x: Array, ray: Array, u: fem.Function | None, accept: Rule
    ) -> tuple[Index, Array, Array]:
        """Find the nearest facet of this rank that each ray hits and that faces its origin.

        Rays have origins ``x`` and unit directions, (n, d), and extend to both sides.

        Returns:
            Facet or -1, (n,); reference coordinates, (n, d - 1); signed distance, (n,).
        """
        n, d, n_facets = len(x), self._d, len(self.cells)
        best = (np.full(n, -1), np.zeros((n, d - 1)), np.full(n, np.inf))
        if n_facets == 0 or n == 0:
            return best
        middle, radius = self.bounding_balls(u)
        near = min(_FIRST_CANDIDATES, n_facets)
        distances, candidates = scipy.spatial.cKDTree(middle).query(x, k=[*range(1, near + 1)])
        point, facet = np.repeat(np.arange(n), near), candidates.reshape(-1)
        arm = middle[facet] - x[point]
        along = np.einsum("nd,nd->n", arm, ray[point])
        lateral = np.linalg.norm(arm - along[:, None] * ray[point], axis=1)
        candidate = lateral <= radius[facet]
        self._update_nearest(x, ray, (point[candidate], facet[candidate]), u, best, accept)
        if near == n_facets:
            return best
        # Facets nearer than a hit have centres closer than its distance plus their radius.
        no_hit = best[0] < 0
        uncertain = ~no_hit & (distances[:, -1] < np.abs(best[2]) + radius.max())
        for rows in (np.flatnonzero(no_hit), np.flatnonzero(uncertain)):
            step = max(1, _PAIRS_PER_CHUNK // n_facets)
            for i in range(0, len(rows), step):
                chunk = rows[i : i + step]
                along, lateral = _ray_distances(middle, x[chunk], ray[chunk])
                candidate = lateral <= radius[None]
                candidate &= np.abs(along) <= np.abs(best[2][chunk, None]) + radius[None]
                row, facet = np.nonzero(candidate)
                self._update_nearest(x, ray, (chunk[row], facet), u, best, accept)
        return best

    def _update_nearest(
        self, x: Array, ray: Array, pairs: tuple[Index, Index], u: Any, best: Any, accept: Rule
    ) -> None:
        """Intersect pairs of rays and facets and store the nearest hits in ``best``."""
        point, facet = pairs
        xi, distance, hit, tangents = self.intersect(facet, x[point], ray[point], u)
        facing = self.outward[facet] * _orientation(tangents, ray[point]) < 0
        rows = np.flatnonzero(hit & facing)
        rows = rows[accept(point[rows], facet[rows], xi[rows], distance[rows])]
        point, facet, xi, distance = point[rows], facet[rows], xi[rows], distance[rows]
        order = np.lexsort((facet, np.abs(distance), point))
        chosen = order[np.append(True, np.diff(point[order]) > 0)[: len(order)]]
        chosen = chosen[np.abs(distance[chosen]) < np.abs(best[2][point[chosen]])]
        for target, values in zip(best, (facet, xi, distance), strict=True):
            target[point[chosen]] = values[chosen]

    def locate(self, facet: Index, x: Array, u: fem.Function | None = None) -> Array:
        """Project points on their facets along undeformed mean normals; return ξ, (n, d - 1)."""
        return self.intersect(facet, x, self.mean_normals()[facet], u)[0]

    def intersect(
        self, facet: Index, x: Array, ray: Array, u: fem.Function | None = None
    ) -> tuple[Array, Array, Mask, Array]:
        """Intersect rays with given facets by Newton's method, all at once.

        Returns:
            Reference coordinates, (n, d - 1); signed distances, (n,); whether the facet was hit,
            (n,); tangents as returned by `positions`.
        """
        d = self._d
        xi: Array = self._middle.repeat(len(facet), axis=0)
        distance: Array = np.zeros(len(facet))
        singular = np.zeros(len(facet), dtype=bool)
        rows: Index = np.arange(len(facet))  # not converged
        for _ in range(_MAX_NEWTON_STEPS):
            position, tangents = self.positions(facet[rows], xi[rows], u)
            residual = position - x[rows] - distance[rows, None] * ray[rows]
            system = np.concatenate([tangents, -ray[rows, :, None]], axis=2)
            # Facets parallel to the ray have a singular system and are never hit.
            size = np.prod(np.linalg.norm(system, axis=1), axis=1)
            singular[rows] = np.abs(np.linalg.det(system)) < ROUND_OFF * size
            system[singular[rows]] = np.eye(d)
            residual[singular[rows]] = 0.0
            step = np.linalg.solve(system, -residual[..., None])[..., 0]
            # Iterates are limited to the neighbourhood of the facet, outside of which curved facets
            # are meaningless. An iterate that stays has converged or is at that limit.
            old = xi[rows]
            xi[rows] = np.clip(old + step[:, :-1], -1.0, 2.0)
            distance[rows] += step[:, -1]
            rows = rows[np.any(np.abs(xi[rows] - old) >= 1e-13, axis=1)]
            if not len(rows):
                break
        position, tangents = self.positions(facet, xi, u)
        residual = np.linalg.norm(position - x - distance[:, None] * ray, axis=1)
        size = np.linalg.norm(tangents, axis=1).max(axis=1, initial=0.0)
        # The tolerance makes neighbours overlap, so that no ray passes between them.
        hit = ~singular & (residual <= 1e-10 * size) & np.all(xi >= -FLAT, axis=1)
        if self.simplex:
            hit &= xi.sum(axis=1) <= 1 + FLAT
        else:
            hit &= np.all(xi <= 1 + FLAT, axis=1)
        return xi, distance, hit, tangents


def tabulate(element: Any, derivatives: int, points: Array) -> Array:
    """Tabulate a Basix element, also at zero points, for which Basix aborts."""
    if len(points):
        return element.tabulate(derivatives, points)
    n_tables = (1, 1 + points.shape[1])[derivatives]
    return np.zeros((n_tables, 0, element.dim, 1))


def across(tangents: Array) -> Array:
    """Return vectors normal to tangents (n, d, d - 1), positively oriented with them, (n, d)."""
    if tangents.shape[1] == 2:
        return np.column_stack([-tangents[:, 1, 0], tangents[:, 0, 0]])
    return np.asarray(np.cross(tangents[:, :, 0], tangents[:, :, 1]), dtype=np.float64)


def _ray_distances(middle: Array, x: Array, ray: Array) -> tuple[Array, Array]:
    """Return axial and lateral distances of points (m, d) from unit rays at x, (n, d): (n, m)."""
    origin = middle.mean(axis=0)  # reduces cancellation
    points, starts = middle - origin, x - origin
    along = ray @ points.T - np.sum(starts * ray, axis=1)[:, None]
    square = np.sum(starts**2, axis=1)[:, None] + np.sum(points**2, axis=1) - 2 * starts @ points.T
    return along, np.sqrt(np.maximum(square - along**2, 0.0))


def _orientation(tangents: Array, direction: Array) -> Array:
    """Return the signs of directions relative to oriented facets, (n,)."""
    return np.sign(np.linalg.det(np.concatenate([tangents, direction[:, :, None]], axis=2)))
