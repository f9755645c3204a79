"""Bodies, surfaces and contact pairs of the independent solver (`reference_solver`).

Nodes are numbered as in the displacement element.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import basix
import numpy as np
from numpy.polynomial import legendre

__all__ = ["Body", "Surface", "find_pairs", "integrate_penetration", "smooth_modulus"]

Array = np.ndarray
# Fraction of a facet that may lack an opposing facet; reference tolerance at the edges of facets.
_MAX_UNCOVERED_FRACTION = 1e-6
_EDGE_TOLERANCE = 1e-6


@dataclass(eq=False)
class Body:
    """Mesh, displacement element and stiffness matrix as arrays.

    Attributes:
        cell: Cell type.
        degree: Degree of the displacement.
        x: Geometry nodes of the mesh, (n_vertices, d) (length).
        vertices: Geometry nodes of every cell, in DOLFINx's order, (n_cells, n).
        nodes: Displacement nodes of every cell, (n_cells, m).
        nodes_x: Coordinates of the displacement nodes, (n_nodes, d) (length).
        body_numbers: Number of the body of every node, (n_nodes,).
        stiffness: K, (d n_nodes, d n_nodes) (force/length).
        geometry_degree: Degree of the cells' geometry, 1 or 2.
    """

    cell: str
    degree: int
    x: Array
    vertices: Array
    nodes: Array
    nodes_x: Array
    body_numbers: Array
    stiffness: Array
    geometry_degree: int = 1

    @property
    def d(self) -> int:
        """Dimension of space."""
        return int(self.x.shape[1])


class Surface:
    """Boundary facets of a body."""

    def __init__(self, body: Body, facets: Sequence[tuple[int, int]]) -> None:
        """Store facets, given as pairs of cell and local facet number."""
        self.body, self.d = body, body.d
        self.facets = list(facets)
        kind = basix.CellType[body.cell]
        self.simplex = body.cell in ("triangle", "tetrahedron")
        corners, topology = basix.geometry(kind), basix.topology(kind)[self.d - 1]
        self.cells = np.array([c for c, _ in self.facets], dtype=int)
        local = [topology[i] for _, i in self.facets]
        self.corner_vertices = np.array(
            [body.vertices[c][v] for c, v in zip(self.cells, local, strict=False)]
        )
        self._origin = np.array([corners[v[0]] for v in local])
        self._axes = np.array(
            [[corners[v[k]] - corners[v[0]] for k in range(1, self.d)] for v in local]
        )
        family = basix.ElementFamily.P
        variant = basix.LagrangeVariant.gll_warped
        self._map = basix.create_element(family, kind, body.geometry_degree, variant)
        self._element = basix.create_element(family, kind, body.degree, variant)
        middle = body.x[body.vertices[self.cells]].mean(axis=1)
        centre = self.position(*self.midpoints())[0]
        normal = self._area_vector(*self.midpoints())
        self._sign = np.sign(np.sum(normal * (centre - middle), axis=1))

    def midpoints(self) -> tuple[Array, Array]:
        """Return the number of every facet, and the reference coordinates of its midpoint."""
        at = 1 / self.d if self.simplex else 0.5
        return np.arange(len(self.facets)), np.full((len(self.facets), self.d - 1), at)

    def _cell_coordinates(self, facet: Array, xi: Array) -> Array:
        return self._origin[facet] + np.einsum("pk,pkd->pd", xi, self._axes[facet])

    def position(self, facet: Array, xi: Array, u: Array | None = None) -> tuple[Array, Array]:
        """Return coordinates, (n, d), and tangents, (n, d - 1, d), of points displaced by u.

        ``u`` has all dofs, or the displacements of the nodes of every point's cell, (n, m, d).
        """
        inside = self._cell_coordinates(facet, xi)
        table = _tabulate(self._map, 1, inside)
        corners = self.body.x[self.body.vertices[self.cells[facet]]]
        x = np.einsum("pk,pkd->pd", table[0], corners)
        slope = np.einsum("jpk,pkd->pjd", table[1:], corners)
        if u is not None:
            table = _tabulate(self._element, 1, inside)
            moved = u if u.ndim == 3 else self.local(facet, u)
            x = x + np.einsum("pk,pkd->pd", table[0], moved)
            slope = slope + np.einsum("jpk,pkd->pjd", table[1:], moved)
        return x, np.einsum("pkj,pjd->pkd", self._axes[facet], slope)

    def local(self, facet: Array, u: Array) -> Array:
        """Return the displacements of the nodes of the facets' cells, (n, m, d)."""
        return u.reshape(-1, self.d)[self.body.nodes[self.cells[facet]]]

    def shapes(self, facet: Array, xi: Array) -> Array:
        """Return the shape functions of the nodes of the facets' cells at points, (n, m)."""
        return _tabulate(self._element, 0, self._cell_coordinates(facet, xi))[0]

    def _area_vector(self, facet: Array, xi: Array, u: Array | None = None) -> Array:
        tangents = self.position(facet, xi, u)[1]
        if self.d == 2:
            return np.column_stack([tangents[:, 0, 1], -tangents[:, 0, 0]])
        return np.cross(tangents[:, 0], tangents[:, 1])

    def normal(self, facet: Array, xi: Array, u: Array | None = None) -> Array:
        """Return outward unit normals, (n, d)."""
        across = self._area_vector(facet, xi, u) * self._sign[facet][:, None]
        return across / np.linalg.norm(across, axis=1, keepdims=True)

    def interpolation(self, facet: Array, xi: Array) -> Array:
        """Return the interpolation matrix from nodes to points, (n, n_nodes)."""
        table = self.shapes(facet, xi)
        matrix = np.zeros((len(facet), len(self.body.nodes_x)))
        for row, (f, values) in enumerate(zip(facet, table, strict=False)):
            matrix[row, self.body.nodes[self.cells[f]]] += values
        return matrix

    def corners(self, u: Array | None = None) -> Array:
        """Return the corners in cyclic order, (n_facets, n_corners, d)."""
        at = np.vstack([np.zeros(self.d - 1), np.eye(self.d - 1)])
        if self.d == 3 and not self.simplex:
            at = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
        every = np.arange(len(self.facets))
        found = [self.position(every, np.tile(p, (len(every), 1)), u)[0] for p in at]
        return np.stack(found, axis=1)

    def lengths(self) -> Array:
        """Return the largest distance of two corners of every facet (length)."""
        corners = self.corners()
        offset = corners[:, :, None] - corners[:, None, :]
        return np.linalg.norm(offset, axis=3).max(axis=(1, 2), initial=0.0)

    def quadrature(self, degree: int, scheme: str) -> tuple[Array, Array, Array]:
        """Return facet, reference coordinates and weight (length^(d-1)) of quadrature points."""
        kind = {2: "interval", 3: "triangle" if self.simplex else "quadrilateral"}[self.d]
        if scheme == "vertex":
            points = basix.geometry(basix.CellType[kind])
            volume = {"interval": 1.0, "triangle": 0.5, "quadrilateral": 1.0}[kind]
            weights = np.full(len(points), volume / len(points))
        else:
            points, weights = basix.make_quadrature(basix.CellType[kind], degree)
        facet = np.repeat(np.arange(len(self.facets)), len(points))
        xi = np.tile(points, (len(self.facets), 1))
        size = np.linalg.norm(self._area_vector(facet, xi), axis=1)
        return facet, xi, np.tile(weights, len(self.facets)) * size

    def cell_heights(self) -> tuple[Array, Array]:
        """Return the height of the cell at every facet, and the size of the facet."""
        kind = basix.CellType[self.body.cell]
        middle = basix.geometry(kind).mean(axis=0, keepdims=True)
        slope = self._map.tabulate(1, middle)[1:, 0, :, 0]
        volume = []
        for c in self.cells:
            jacobian = slope @ self.body.x[self.body.vertices[c]]
            volume.append(abs(np.linalg.det(jacobian)) * basix.cell.volume(kind))
        size = np.linalg.norm(self._area_vector(*self.midpoints()), axis=1)
        size = size * (0.5 if self.d == 3 and self.simplex else 1.0)
        return (self.d if self.simplex else 1) * np.array(volume) / size, size

    def intersect(
        self, facet: Array, start: Array, ray: Array, u: Array | None = None
    ) -> tuple[Array, Array, Array]:
        """Intersect rays with facets: reference coordinates, signed distance, whether they meet."""
        xi = self.midpoints()[1][facet]
        distance, bad = np.zeros(len(facet)), np.zeros(len(facet), dtype=bool)
        moving = np.arange(len(facet))
        for _ in range(30):
            moved = u if u is None or u.ndim < 3 else u[moving]
            x, tangents = self.position(facet[moving], xi[moving], moved)
            direction = ray[moving]
            system = np.concatenate([np.swapaxes(tangents, 1, 2), -direction[:, :, None]], axis=2)
            rest = x - start[moving] - distance[moving, None] * direction
            size = np.prod(np.linalg.norm(system, axis=1), axis=1)
            flat = np.abs(np.linalg.det(system)) < 1e-12 * size
            bad[moving[flat]] = True
            system[flat], rest[flat] = np.eye(self.d), 0.0
            step = np.linalg.solve(system, -rest[..., None])[..., 0]
            now = np.clip(xi[moving] + step[:, :-1], -3, 4)
            change = np.abs(now - xi[moving]).max(axis=1, initial=0.0)
            xi[moving] = now
            distance[moving] += step[:, -1]
            moving = moving[(change >= 1e-14) & ~flat]
            if not len(moving):
                break
        x, tangents = self.position(facet, xi, u)
        size = np.linalg.norm(tangents, axis=2).max(axis=1)
        met = ~bad & (np.linalg.norm(x - start - distance[:, None] * ray, axis=1) < 1e-9 * size)
        met &= np.all(xi >= -_EDGE_TOLERANCE, axis=1)
        met &= (xi.sum(axis=1) if self.simplex else xi.max(axis=1)) <= 1 + _EDGE_TOLERANCE
        return xi, distance, met

    def nearest(
        self, start: Array, ray: Array, max_distance: float, u: Array | None
    ) -> tuple[Array, Array]:
        """Return the closest facet that faces each ray, or -1, and reference coordinates on it."""
        n, m = len(start), len(self.facets)
        facet = np.tile(np.arange(m), n)
        xi, distance, met = self.intersect(facet, np.repeat(start, m, 0), np.repeat(ray, m, 0), u)
        facing = np.sum(self.deformed_normal(facet, xi, u) * np.repeat(ray, m, 0), axis=1) < 0
        far = np.where(met & facing & (np.abs(distance) <= max_distance), np.abs(distance), np.inf)
        best = far.reshape(n, m).argmin(axis=1)
        row = np.arange(n) * m + best
        return np.where(np.isfinite(far[row]), best, -1), xi[row]

    def deformed_normal(self, facet: Array, xi: Array, u: Array | None) -> Array:
        """Return outward normals of the deformed facets, not of unit length."""
        return self._area_vector(facet, xi, u) * self._sign[facet][:, None]


def _tabulate(element: Any, derivatives: int, points: Array) -> Array:
    """Tabulate an element, (n_tables, n_points, dim), also at zero points, where Basix aborts."""
    if len(points):
        return element.tabulate(derivatives, points)[..., 0]
    return np.zeros((1 + derivatives * points.shape[1], 0, element.dim))


def smooth_modulus(surface: Surface, modulus: Array, facet: Array, xi: Array) -> Array:
    """Return E/h at points of Γc, smoothed over four facets as in `modulus_over_height`.

    Args:
        surface: Γc.
        modulus: Young's modulus at every facet (stress).
        facet: Facet of every point.
        xi: Reference coordinates of every point.

    Returns:
        (n_points,) (stress/length).
    """
    height, size = surface.cell_heights()
    d = surface.d
    kind = {2: "interval", 3: "triangle" if surface.simplex else "quadrilateral"}[d]
    element = basix.create_element(basix.ElementFamily.P, basix.CellType[kind], 1)
    vertices, numbered = np.unique(surface.corner_vertices, return_inverse=True)
    numbered = numbered.reshape(surface.corner_vertices.shape)
    points, weights = basix.make_quadrature(basix.CellType[kind], 6)
    table = element.tabulate(1, points)[..., 0]
    left, right = np.zeros((len(vertices),) * 2), np.zeros(len(vertices))
    for f, own in enumerate(numbered):
        length = 4.0 * size[f] ** (1 / (d - 1))
        every = np.full(len(points), f)
        tangents = surface.position(every, points)[1]
        for q, weight in enumerate(weights):
            metric = tangents[q] @ tangents[q].T
            area = weight * np.sqrt(np.linalg.det(metric))
            slope = table[1:, q]
            value = table[0, q]
            stiff = length**2 * slope.T @ np.linalg.solve(metric, slope)
            left[np.ix_(own, own)] += area * (np.outer(value, value) + stiff)
            right[own] += area * value * np.log(modulus[f] / height[f])
    smooth = np.exp(np.linalg.solve(left, right))
    at = element.tabulate(0, xi)[0, :, :, 0]
    return np.einsum("qk,qk->q", at, smooth[numbered[facet]])


# ---- pairs of surfaces ---------------------------------------------------------------------------


def find_pairs(
    slave: Surface,
    master: Surface,
    points: tuple[Array, Array],
    *,
    max_distance: float = np.inf,
    u: Array | None = None,
) -> tuple[Array, Array, Array]:
    """Return the contact pairs of the points of Γc, as the package's ``pairing`` defines them.

    Args:
        slave: Γc.
        master: The opposing surface.
        points: Facet and reference coordinates of every point.
        max_distance: Largest distance (length).
        u: Displacement at which pairs are found; None for the undeformed bodies.

    Returns:
        Interpolation matrix of the opposing displacement, (n_points, n_nodes); the gap in the
        undeformed bodies, (n_points,); and whether a point is paired, (n_points,).
    """
    facet, xi = points
    normal = slave.normal(facet, xi)
    hit, where = master.nearest(slave.position(facet, xi, u)[0], normal, max_distance, u)
    paired = hit >= 0
    gap = np.zeros(len(facet))
    gap[paired] = np.sum(
        (master.position(hit[paired], where[paired])[0] - slave.position(facet, xi)[0][paired])
        * normal[paired],
        axis=1,
    )
    matrix = np.zeros((len(facet), len(slave.body.nodes_x)))
    matrix[paired] = master.interpolation(hit[paired], where[paired])
    for f in range(len(slave.facets)):
        own = np.flatnonzero(facet == f)
        if not paired[own].all():
            continue
        pieces, weights = _cut_quadrature(slave, master, f, u)
        if not len(pieces):
            continue
        f_pieces = np.full(len(pieces), f)
        ray = slave.normal(f_pieces, pieces)
        met, at = master.nearest(slave.position(f_pieces, pieces, u)[0], ray, max_distance, u)
        if np.any(met < 0):
            continue
        basis = _complete_polynomials(slave, len(own))
        left, at_points = basis(pieces), basis(xi[own])
        gram = left.T @ (weights[:, None] * left)
        project = at_points @ np.linalg.solve(gram, left.T * weights)
        matrix[own] = project @ master.interpolation(met, at)
    return matrix, gap, paired


def integrate_penetration(surface: Surface, opposite: Surface, u: Array, weight: float) -> float:
    """Integrate the penetration of a surface into the opposing one along its normals."""
    facet, xi, weights = surface.quadrature(8, "default")
    normal = surface.normal(facet, xi)
    hit, where = opposite.nearest(surface.position(facet, xi)[0], normal, np.inf, None)
    met = hit >= 0
    facet, xi, normal, weights = facet[met], xi[met], normal[met], weights[met]
    ends = opposite.position(hit[met], where[met])[0] - surface.position(facet, xi)[0]
    moved = opposite.position(hit[met], where[met], u)[0] - surface.position(facet, xi, u)[0]
    gap = np.sum(ends * normal, axis=1)
    # A surface that is far behind in the undeformed configuration is another side of the body.
    near = gap > -0.3 * np.ptp(surface.body.x, axis=0).max()
    return float(weight * weights[near] @ np.maximum(-np.sum(moved * normal, axis=1)[near], 0.0))


def _complete_polynomials(surface: Surface, n_points: int) -> Any:
    """Return Legendre polynomials of the largest complete space of at most ``n_points`` members."""
    d = surface.d
    if d == 2:
        return lambda s: legendre.legvander(2 * s[:, 0] - 1, n_points - 1)
    k = 0
    if surface.simplex:
        while (k + 2) * (k + 3) // 2 <= n_points:
            k += 1
        powers = [(i, j) for i in range(k + 1) for j in range(k + 1 - i)]
    else:
        while (k + 2) ** 2 <= n_points:
            k += 1
        powers = [(i, j) for i in range(k + 1) for j in range(k + 1)]
    i, j = np.array(powers).T

    def basis(s: Array) -> Array:
        x, y = (legendre.legvander(2 * along - 1, k) for along in s.T)
        return x[:, i] * y[:, j]

    return basis


def _cut_quadrature(
    slave: Surface, master: Surface, f: int, u: Array | None
) -> tuple[Array, Array]:
    """Return points and weights of the intersections of facet f with the opposing facets."""
    corners, others = slave.corners(u)[f], master.corners(u)
    mean = slave.normal(*slave.midpoints())[f]
    facing = master.normal(*master.midpoints()) @ mean < 0
    points, weights = [], []
    if slave.d == 2:
        quadrature, shares = basix.make_quadrature(basix.CellType.interval, 12)
        origin, edge = corners[0], corners[1] - corners[0]
        across, covered = edge - (edge @ mean) * mean, 0.0
        for other in others[facing]:
            ends = np.clip((other - origin) @ across / (across @ across), 0, 1)
            low, high = ends.min(), ends.max()
            if high - low > 1e-9:
                covered += high - low
                points.append(origin + (low + (high - low) * quadrature) * edge)
                weights.append((high - low) * shares)
    else:
        quadrature, shares = basix.make_quadrature(basix.CellType.triangle, 12)
        first = corners[1] - corners[0]
        first = first - (first @ mean) * mean
        first /= np.linalg.norm(first)
        plane = np.column_stack([first, np.cross(mean, first)])
        window = _anticlockwise((corners - corners[0]) @ plane)
        size, covered = _area(window), 0.0
        for other in others[facing]:
            ring = _clip(_anticlockwise((other - corners[0]) @ plane), window)
            for i in range(1, len(ring) - 1):
                edges = np.array([ring[i] - ring[0], ring[i + 1] - ring[0]])
                twice = np.linalg.det(edges)
                covered += 0.5 * twice / size
                if twice > 1e-9 * size:
                    points.append(corners[0] + (ring[0] + quadrature @ edges) @ plane.T)
                    weights.append(twice * shares)
    if abs(covered - 1) > _MAX_UNCOVERED_FRACTION or not points:
        return np.zeros((0, slave.d - 1)), np.zeros(0)
    flat = np.concatenate(points)
    xi, _, _ = slave.intersect(np.full(len(flat), f), flat, np.tile(mean, (len(flat), 1)), u)
    return xi, np.concatenate(weights)


def _area(ring: Array) -> float:
    x, y = ring.T
    return float(0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


def _anticlockwise(ring: Array) -> Array:
    return ring if _area(ring) > 0 else ring[::-1]


def _clip(ring: Array, window: Array) -> Array:
    """Return the intersection of two convex polygons."""
    for start, end in zip(window, np.roll(window, -1, axis=0), strict=False):
        along, found = end - start, []
        side = [along[0] * (p[1] - start[1]) - along[1] * (p[0] - start[0]) for p in ring]
        for i, p in enumerate(ring):
            j = (i + 1) % len(ring)
            if side[i] >= 0:
                found.append(p)
            if (side[i] >= 0) != (side[j] >= 0):
                found.append(p + side[i] / (side[i] - side[j]) * (ring[j] - p))
        ring = np.array(found)
        if not len(ring):
            break
    return ring
