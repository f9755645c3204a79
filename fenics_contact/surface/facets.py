"""Geometry of a set of facets: places on them, and where rays meet them."""

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

# Of points, facets, places on them and signed distances: which of these hits count.
Rule: TypeAlias = Callable[[Index, Index, Array, Array], Mask]

# Facets tried first for every point, nearest first; more only where these need not be enough.
_NEAREST = 12
_NEWTON_STEPS = 25
# Pairs of points and facets looked at in one go, to bound the memory.
_CHUNK = 2_000_000
# How far from its middle a curved facet reaches, by the farthest of its corners.
_BENT = 1.3


def facet_cells(mesh: dolfinx.mesh.Mesh, facets: Index) -> Index:
    """The cell of every exterior facet of this rank, (n_facets,)."""
    d = mesh.topology.dim
    mesh.topology.create_connectivity(d - 1, d)
    to_cell = mesh.topology.connectivity(d - 1, d)
    return to_cell.array[to_cell.offsets[facets]]


def local_facets(mesh: dolfinx.mesh.Mesh, facets: Index) -> Index:
    """The number of every exterior facet of this rank in its cell, (n_facets,)."""
    d = mesh.topology.dim
    mesh.topology.create_connectivity(d, d - 1)
    n = len(basix.topology(basix.CellType[mesh.topology.cell_name()])[d - 1])
    of_cell = mesh.topology.connectivity(d, d - 1).array.reshape(-1, n)
    return np.argmax(of_cell[facet_cells(mesh, facets)] == facets[:, None], axis=1)


def facet_nodes(space: fem.FunctionSpace, facets: Index) -> Index:
    """The nodes of a space on every exterior facet of this rank, (n_facets, n_nodes)."""
    mesh, layout = space.mesh, space.dofmap.dof_layout
    fdim = mesh.topology.dim - 1
    n = len(basix.topology(basix.CellType[mesh.topology.cell_name()])[fdim])
    closures = np.array([layout.entity_closure_dofs(fdim, i) for i in range(n)])
    cells, local = facet_cells(mesh, facets), local_facets(mesh, facets)
    return space.dofmap.list[cells[:, None], closures[local]]


class FacetSet:
    """Facets of this rank, with reference coordinates of their own, of dimension d - 1.

    Args:
        space: Displacement space, for displaced places and its basis.
        facets: Facets of this rank, (n_facets,).

    Attributes:
        cells: Cell of every facet, (n_facets,).
        nodes: Of the displacement on every facet, numbered on this rank, (n_facets, n_nodes).
        kind: Of the facets, as Basix has it.
        simplex: Whether the cells are simplices.
        outward: Sign by which the facet's own orientation points out of the body, (n_facets,).
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
        places = basix.geometry(self.kind)
        ring = [0, 1, 3, 2] if d == 3 and not self.simplex else list(range(d))
        self._corners, self._middle = places[ring], places.mean(axis=0, keepdims=True)
        self._at_corners = np.array(topology[d - 1])[local][:, ring]
        self._geometry_basis = compat.geometry_element(mesh)
        self._basis = space.element.basix_element
        self._nodes = compat.geometry_dofmap(mesh)[self.cells]
        self._dofs = space.dofmap.list[self.cells]
        on_facet, tangents = self.positions(*self.each(self._middle))
        table = tabulate(self._geometry_basis, 0, geometry.mean(axis=0)[None])[0, 0, :, 0]
        inside = np.einsum("k,pkd->pd", table, self._x[self._nodes][:, :, :d])
        self.outward = _side(tangents, on_facet - inside)

    def each(self, places: Array, facets: Index | None = None) -> tuple[Index, Array]:
        """Facets, by default all, with each of the places, (m, d - 1): (n m,), (n m, d - 1)."""
        facets = np.arange(len(self.cells)) if facets is None else facets
        return np.repeat(facets, len(places)), np.tile(places, (len(facets), 1))

    def _in_cell(self, facet: Index, place: Array) -> Array:
        """Reference coordinates of the cell from those of the facet: (n, d)."""
        along = self._edges[facet] @ place[:, :, None]
        return np.asarray(self._origin[facet] + along[:, :, 0])

    def _weights(self, basis: Any, facet: Index, points: Array) -> Array:
        """Values of a basis, then derivatives by the facet's coordinates, (n, d, n_basis).

        Args:
            basis: Of the cells.
            facet: Facet of every point, (n,).
            points: Reference coordinates of the cell, (n, d).
        """
        table = np.swapaxes(tabulate(basis, 1, points)[..., 0], 0, 1)
        slopes = np.swapaxes(self._edges[facet], 1, 2) @ table[:, 1:]
        return np.concatenate([table[:, :1], slopes], axis=1)

    def positions(
        self, facet: Index, place: Array, u: fem.Function | None = None
    ) -> tuple[Array, Array]:
        """Places in space, (n, d), and their derivatives by the coordinates, (n, d, d - 1).

        Args:
            facet: Facet of every point, (n,).
            place: Reference coordinates on it, (n, d - 1).
            u: Displacement to add; none: the undeformed body.
        """
        points = self._in_cell(facet, place)
        nodes = self._x[self._nodes[facet]][:, :, : self._d]
        found = self._weights(self._geometry_basis, facet, points) @ nodes
        if u is not None:
            values = u.x.array.reshape(-1, self.space.dofmap.bs)[self._dofs[facet]]
            found += self._weights(self._basis, facet, points) @ values
        return found[:, 0], np.swapaxes(found[:, 1:], 1, 2)

    def normals(self, facet: Index, place: Array, u: fem.Function | None = None) -> Array:
        """Outward unit normals, (n, d), of the body displaced by ``u``."""
        return self.outward_normals(facet, self.positions(facet, place, u)[1])

    def outward_normals(self, facet: Index, tangents: Array) -> Array:
        """Outward unit normals, (n, d), across the tangents of `positions`."""
        outward = self.outward[facet, None] * across(tangents)
        return np.asarray(outward / np.linalg.norm(outward, axis=1, keepdims=True))

    def moved_corners(self, u: fem.Function | None) -> Array:
        """Corners displaced by ``u``, (n_facets, n_corners, d)."""
        places, _ = self.positions(*self.each(self._corners), u)
        return places.reshape(len(self.cells), len(self._corners), self._d)

    def balls(self, u: fem.Function | None) -> tuple[Array, Array]:
        """Balls around the facets displaced by ``u``: middles, (n_facets, d), and radii."""
        middle, _ = self.positions(*self.each(self._middle), u)
        away = np.linalg.norm(self.moved_corners(u) - middle[:, None], axis=2)
        return middle, _BENT * away.max(axis=1, initial=0.0)

    def mean_normals(self) -> Array:
        """Outward unit normals at the facets' middles, (n_facets, d)."""
        return self.normals(*self.each(self._middle))

    def corners(self) -> tuple[Index, Array]:
        """Every facet with each of its corners and its middle: (n,), places (n, d - 1)."""
        return self.each(np.vstack([self._corners, self._middle]))

    def lattice(self, facets: Index | None = None) -> tuple[Index, Array]:
        """Facets with their corners, the middles of their edges and their own middle.

        Args:
            facets: Which ones; by default all of this rank.

        Returns:
            The facets, (n,), and reference coordinates on them, (n, d - 1).
        """
        places = np.vstack([self._corners, self._middle])
        if self._d == 3:
            edges = (self._corners + np.roll(self._corners, -1, axis=0)) / 2
            places = np.vstack([places, edges])
        return self.each(places, facets)

    def flat_pieces(self, degree: int) -> Array:
        """Reference corners of the pieces, in order, that are taken as flat: (n, n_corners, d - 1).

        Args:
            degree: Of the polynomials on the facets; those of degree 1 are one piece.
        """
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
        """Reference coordinates of the places, (n, d - 1), moved onto the facet."""
        inside = np.clip(reference, 0.0, 1.0)
        if self.simplex:
            inside /= np.maximum(inside.sum(axis=1, keepdims=True), 1.0)
        return inside

    def corner_vertices(self) -> Index:
        """Global numbers of the facets' vertices, see `vertices`, (n_facets, n_corners)."""
        return np.take_along_axis(self.vertices(), self._at_corners, axis=1)

    def heights(self) -> Array:
        """How far the cells reach below their facets, (n_facets,) (length)."""
        middle, _ = self.positions(*self.each(self._middle))
        arm = middle[:, None] - self._x[self._nodes][:, :, : self._d]
        depth: Array = np.einsum("fkd,fd->fk", arm, self.mean_normals())
        return depth.max(axis=1, initial=0.0)

    def vertices(self) -> Index:
        """Global numbers of the cells' vertices, as nodes of the displacement: (n_facets, n)."""
        n = len(basix.topology(basix.CellType[self.space.mesh.topology.cell_name()])[0])
        layout = self.space.dofmap.dof_layout
        local = self._dofs[:, [layout.entity_dofs(0, i)[0] for i in range(n)]]
        nodes = self.space.dofmap.index_map.local_to_global(local.ravel().astype(np.int32))
        return nodes.reshape(local.shape)

    def interpolation(self, facet: Index, place: Array) -> tuple[Index, Array]:
        """Global nodes of the displacement at places, (n, n_basis), and their weights.

        The weights, (n, d, n_basis), are values, then derivatives by the places.
        """
        local = self._dofs[facet]
        nodes = self.space.dofmap.index_map.local_to_global(local.ravel().astype(np.int32))
        weights = self._weights(self._basis, facet, self._in_cell(facet, place))
        return nodes.reshape(local.shape), weights

    def search(
        self, x: Array, ray: Array, u: fem.Function | None, counts: Rule
    ) -> tuple[Index, Array, Array]:
        """The nearest facet of this rank that looks back along each ray.

        Args:
            x: Points, (n, d).
            ray: Unit directions, (n, d); facets behind the point are met too.
            u: Displacement of the facets; none: they are undeformed.
            counts: Which hits are taken.

        Returns:
            Facet or -1, (n,); place on it, (n, d - 1); signed distance along the ray, (n,).
        """
        n, d, n_facets = len(x), self._d, len(self.cells)
        best = (np.full(n, -1), np.zeros((n, d - 1)), np.full(n, np.inf))
        if n_facets == 0 or n == 0:
            return best
        middle, radius = self.balls(u)
        near = min(_NEAREST, n_facets)
        away, candidates = scipy.spatial.cKDTree(middle).query(x, k=[*range(1, near + 1)])
        point, facet = np.repeat(np.arange(n), near), candidates.reshape(-1)
        arm = middle[facet] - x[point]
        along = np.einsum("nd,nd->n", arm, ray[point])
        off = np.linalg.norm(arm - along[:, None] * ray[point], axis=1)
        hopeful = off <= radius[facet]
        self._keep_nearest(x, ray, (point[hopeful], facet[hopeful]), u, best, counts)
        if near == n_facets:
            return best
        # The nearest need not be the ones ahead: a long facet, or a far one. Where something was
        # met, all that is nearer has its middle within its own radius of there.
        missed = best[0] < 0
        unsure = ~missed & (away[:, -1] < np.abs(best[2]) + radius.max())
        for rows in (np.flatnonzero(missed), np.flatnonzero(unsure)):
            step = max(1, _CHUNK // n_facets)
            for i in range(0, len(rows), step):
                some = rows[i : i + step]
                along, off = _every_along_and_off(middle, x[some], ray[some])
                hopeful = off <= radius[None]
                hopeful &= np.abs(along) <= np.abs(best[2][some, None]) + radius[None]
                row, facet = np.nonzero(hopeful)
                self._keep_nearest(x, ray, (some[row], facet), u, best, counts)
        return best

    def _keep_nearest(
        self, x: Array, ray: Array, pairs: tuple[Index, Index], u: Any, best: Any, counts: Rule
    ) -> None:
        """Meet the facets of some pairs and keep the nearest hits in ``best``."""
        point, facet = pairs
        place, distance, met, tangents = self.meet(facet, x[point], ray[point], u)
        # Only a facet that looks back at the point can be opposite.
        facing = self.outward[facet] * _side(tangents, ray[point]) < 0
        good = np.flatnonzero(met & facing)
        good = good[counts(point[good], facet[good], place[good], distance[good])]
        point, facet, place, distance = point[good], facet[good], place[good], distance[good]
        order = np.lexsort((facet, np.abs(distance), point))
        chosen = order[np.append(True, np.diff(point[order]) > 0)[: len(order)]]
        chosen = chosen[np.abs(distance[chosen]) < np.abs(best[2][point[chosen]])]
        for target, values in zip(best, (facet, place, distance), strict=True):
            target[point[chosen]] = values[chosen]

    def locate(self, facet: Index, x: Array, u: fem.Function | None = None) -> Array:
        """Reference coordinates of places on their facets, (n, d - 1).

        Args:
            facet: Facet of every place, (n,).
            x: The places, (n, d); what is off the facet counts as if it were moved onto it along
                the mean normal of the undeformed facet.
            u: Displacement of the facets; none: they are undeformed.
        """
        return self.meet(facet, x, self.mean_normals()[facet], u)[0]

    def meet(
        self, facet: Index, x: Array, ray: Array, u: fem.Function | None = None
    ) -> tuple[Array, Array, Mask, Array]:
        """Where rays meet given facets, by Newton's method, all at once.

        Returns:
            Places, (n, d - 1); signed distances, (n,); whether the facet itself was met, (n,); and
            the tangents of `positions` there.
        """
        d = self._d
        place: Array = self._middle.repeat(len(facet), axis=0)
        distance: Array = np.zeros(len(facet))
        singular = np.zeros(len(facet), dtype=bool)
        rows: Index = np.arange(len(facet))  # those still on their way
        for _ in range(_NEWTON_STEPS):
            position, tangents = self.positions(facet[rows], place[rows], u)
            rest = position - x[rows] - distance[rows, None] * ray[rows]
            system = np.concatenate([tangents, -ray[rows, :, None]], axis=2)
            # A facet along the ray is never met; its singular system must not stop the others.
            size = np.prod(np.linalg.norm(system, axis=1), axis=1)
            singular[rows] = np.abs(np.linalg.det(system)) < ROUND_OFF * size
            system[singular[rows]] = np.eye(d)
            rest[singular[rows]] = 0.0
            step = np.linalg.solve(system, -rest[..., None])[..., 0]
            # Far outside, a curved facet may bend any way: stay near it. What does not move any
            # more has met the facet, or wants to leave there, now and in every further step.
            old = place[rows]
            place[rows] = np.clip(old + step[:, :-1], -1.0, 2.0)
            distance[rows] += step[:, -1]
            rows = rows[np.any(np.abs(place[rows] - old) >= 1e-13, axis=1)]
            if not len(rows):
                break
        position, tangents = self.positions(facet, place, u)
        rest = np.linalg.norm(position - x - distance[:, None] * ray, axis=1)
        size = np.linalg.norm(tangents, axis=1).max(axis=1, initial=0.0)
        # Neighbours overlap, so that no ray slips through between them.
        met = ~singular & (rest <= 1e-10 * size) & np.all(place >= -FLAT, axis=1)
        if self.simplex:
            met &= place.sum(axis=1) <= 1 + FLAT
        else:
            met &= np.all(place <= 1 + FLAT, axis=1)
        return place, distance, met, tangents


def tabulate(element: Any, derivatives: int, points: Array) -> Array:
    """Tabulate a basix element, also at no points at all, where basix aborts."""
    if len(points):
        return element.tabulate(derivatives, points)
    n_tables = (1, 1 + points.shape[1])[derivatives]
    return np.zeros((n_tables, 0, element.dim, 1))


def across(tangents: Array) -> Array:
    """Vectors across tangents (n, d, d - 1), (n, d), with which these are oriented positively."""
    if tangents.shape[1] == 2:
        return np.column_stack([-tangents[:, 1, 0], tangents[:, 0, 0]])
    return np.asarray(np.cross(tangents[:, :, 0], tangents[:, :, 1]), dtype=np.float64)


def _every_along_and_off(middle: Array, x: Array, ray: Array) -> tuple[Array, Array]:
    """How far places (m, d) are along each unit ray from x, (n, d), and aside of it: (n, m)."""
    origin = middle.mean(axis=0)  # from afar differences of squares would lose their digits
    there, here = middle - origin, x - origin
    along = ray @ there.T - np.sum(here * ray, axis=1)[:, None]
    away = np.sum(here**2, axis=1)[:, None] + np.sum(there**2, axis=1) - 2 * here @ there.T
    return along, np.sqrt(np.maximum(away - along**2, 0.0))


def _side(tangents: Array, direction: Array) -> Array:
    """Sign of directions against oriented facets: (n,)."""
    return np.sign(np.linalg.det(np.concatenate([tangents, direction[:, :, None]], axis=2)))
