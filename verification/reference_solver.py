"""A second solution of frictional contact in plain NumPy, to judge the package by.

It shares nothing with the package but DOLFINx's stiffness and load vector: points, weights and
normals of Γc, pairs of surfaces, L2 projection, laws, history, condensation and solver are made
here, dense and by brute force, for problems of some hundred unknowns. What is solved is what the
package's docstrings define: laws at quadrature points (`laws`), supports (`supports`), pairs
(`pairing`), multipliers (`multipliers`).

Arrays are those of one rank. Numbers of nodes are those of the displacement element.
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import basix
import numpy as np
import scipy.linalg

__all__ = [
    "Body",
    "ContactModel",
    "Law",
    "Problem",
    "State",
    "Surface",
    "pair",
    "smooth_modulus",
]

Array = np.ndarray
# Step of the derivatives by complex numbers: exact, whatever its size.
_STEP = 1e-60
# Facets are covered if no more than this share of them is not.
_COVERED = 1e-6
_OVERLAP = 1e-6
# Systems whose condition is better than its inverse are solved by elimination.
_WELL = 1e-8


# ---- geometry ------------------------------------------------------------------------------------


@dataclass(eq=False)
class Body:
    """Mesh, element and stiffness as arrays.

    Attributes:
        cell: Name of the cells.
        degree: Of the displacement.
        x: Geometry nodes of the mesh, the vertices among them, (n_vertices, d) (length).
        vertices: Of every cell, in DOLFINx's order, (n_cells, n).
        bent: Degree of the cells' geometry, 1 or 2.
        nodes: Displacement nodes of every cell, (n_cells, m).
        places: Coordinates of the displacement nodes, (n_nodes, d) (length).
        parts: Number of the connected part that every node is in, (n_nodes,).
        stiffness: K, (d n_nodes, d n_nodes) (force/length).
    """

    cell: str
    degree: int
    x: Array
    vertices: Array
    nodes: Array
    places: Array
    parts: Array
    stiffness: Array
    bent: int = 1

    @property
    def d(self) -> int:
        """Dimension."""
        return int(self.x.shape[1])


class Surface:
    """Facets with straight edges, each by its cell and its number there."""

    def __init__(self, body: Body, facets: Sequence[tuple[int, int]]) -> None:
        """Take facets of a body."""
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
        self._map = basix.create_element(family, kind, body.bent, variant)
        self._element = basix.create_element(family, kind, body.degree, variant)
        middle = body.x[body.vertices[self.cells]].mean(axis=1)
        centre = self.place(*self.middles())[0]
        normal = self._across(*self.middles())
        self._sign = np.sign(np.sum(normal * (centre - middle), axis=1))

    def middles(self) -> tuple[Array, Array]:
        """Every facet, and the reference coordinates of its middle."""
        at = 1 / self.d if self.simplex else 0.5
        return np.arange(len(self.facets)), np.full((len(self.facets), self.d - 1), at)

    def _in_cell(self, facet: Array, xi: Array) -> Array:
        return self._origin[facet] + np.einsum("pk,pkd->pd", xi, self._axes[facet])

    def place(self, facet: Array, xi: Array, u: Array | None = None) -> tuple[Array, Array]:
        """Coordinates, (n, d), and tangents, (n, d - 1, d), of places, displaced by u.

        That is of all dofs, or has the displacements of the cells' nodes, (n, m, d).
        """
        inside = self._in_cell(facet, xi)
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
        """Displacements of the nodes of the facets' cells, (n, m, d)."""
        return u.reshape(-1, self.d)[self.body.nodes[self.cells[facet]]]

    def shapes(self, facet: Array, xi: Array) -> Array:
        """Values of the shape functions of these nodes at places, (n, m)."""
        return _tabulate(self._element, 0, self._in_cell(facet, xi))[0]

    def _across(self, facet: Array, xi: Array, u: Array | None = None) -> Array:
        tangents = self.place(facet, xi, u)[1]
        if self.d == 2:
            return np.column_stack([tangents[:, 0, 1], -tangents[:, 0, 0]])
        return np.cross(tangents[:, 0], tangents[:, 1])

    def normal(self, facet: Array, xi: Array, u: Array | None = None) -> Array:
        """Outward unit normals, (n, d)."""
        across = self._across(facet, xi, u) * self._sign[facet][:, None]
        return across / np.linalg.norm(across, axis=1, keepdims=True)

    def interpolation(self, facet: Array, xi: Array) -> Array:
        """From values at the nodes to those at places: (n, n_nodes)."""
        table = self.shapes(facet, xi)
        matrix = np.zeros((len(facet), len(self.body.places)))
        for row, (f, values) in enumerate(zip(facet, table, strict=False)):
            matrix[row, self.body.nodes[self.cells[f]]] += values
        return matrix

    def corners(self, u: Array | None = None) -> Array:
        """Corners in cyclic order, (n_facets, n_corners, d)."""
        at = np.vstack([np.zeros(self.d - 1), np.eye(self.d - 1)])
        if self.d == 3 and not self.simplex:
            at = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
        every = np.arange(len(self.facets))
        places = [self.place(every, np.tile(p, (len(every), 1)), u)[0] for p in at]
        return np.stack(places, axis=1)

    def rule(self, degree: int, scheme: str) -> tuple[Array, Array, Array]:
        """Facet, reference coordinates and weight (length^(d-1)) of every point of Γc."""
        kind = {2: "interval", 3: "triangle" if self.simplex else "quadrilateral"}[self.d]
        if scheme == "vertex":
            points = basix.geometry(basix.CellType[kind])
            volume = {"interval": 1.0, "triangle": 0.5, "quadrilateral": 1.0}[kind]
            weights = np.full(len(points), volume / len(points))
        else:
            points, weights = basix.make_quadrature(basix.CellType[kind], degree)
        facet = np.repeat(np.arange(len(self.facets)), len(points))
        xi = np.tile(points, (len(self.facets), 1))
        size = np.linalg.norm(self._across(facet, xi), axis=1)
        return facet, xi, np.tile(weights, len(self.facets)) * size

    def heights(self) -> tuple[Array, Array]:
        """Height of the cell over every facet, and the facet's size."""
        kind = basix.CellType[self.body.cell]
        middle = basix.geometry(kind).mean(axis=0, keepdims=True)
        slope = self._map.tabulate(1, middle)[1:, 0, :, 0]
        volume = []
        for c in self.cells:
            jacobian = slope @ self.body.x[self.body.vertices[c]]
            volume.append(abs(np.linalg.det(jacobian)) * basix.cell.volume(kind))
        size = np.linalg.norm(self._across(*self.middles()), axis=1)
        size = size * (0.5 if self.d == 3 and self.simplex else 1.0)
        return (self.d if self.simplex else 1) * np.array(volume) / size, size

    def meet(
        self, facet: Array, start: Array, ray: Array, u: Array | None = None
    ) -> tuple[Array, Array, Array]:
        """Where rays meet facets, pair by pair: coordinates, signed distance, whether they do."""
        xi = self.middles()[1][facet]
        distance, bad = np.zeros(len(facet)), np.zeros(len(facet), dtype=bool)
        moving = np.arange(len(facet))
        for _ in range(30):
            moved = u if u is None or u.ndim < 3 else u[moving]
            x, tangents = self.place(facet[moving], xi[moving], moved)
            way = ray[moving]
            system = np.concatenate([np.swapaxes(tangents, 1, 2), -way[:, :, None]], axis=2)
            rest = x - start[moving] - distance[moving, None] * way
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
        x, tangents = self.place(facet, xi, u)
        size = np.linalg.norm(tangents, axis=2).max(axis=1)
        met = ~bad & (np.linalg.norm(x - start - distance[:, None] * ray, axis=1) < 1e-9 * size)
        met &= np.all(xi >= -_OVERLAP, axis=1)
        met &= (xi.sum(axis=1) if self.simplex else xi.max(axis=1)) <= 1 + _OVERLAP
        return xi, distance, met

    def nearest(
        self, start: Array, ray: Array, reach: float, u: Array | None
    ) -> tuple[Array, Array]:
        """The nearest facet that looks back along each ray, -1 without; coordinates on it."""
        n, m = len(start), len(self.facets)
        facet = np.tile(np.arange(m), n)
        xi, distance, met = self.meet(facet, np.repeat(start, m, 0), np.repeat(ray, m, 0), u)
        looks = np.sum(self.normal_moved(facet, xi, u) * np.repeat(ray, m, 0), axis=1) < 0
        far = np.where(met & looks & (np.abs(distance) <= reach), np.abs(distance), np.inf)
        best = far.reshape(n, m).argmin(axis=1)
        row = np.arange(n) * m + best
        return np.where(np.isfinite(far[row]), best, -1), xi[row]

    def normal_moved(self, facet: Array, xi: Array, u: Array | None) -> Array:
        """Outward normals of the displaced facets, not of unit length."""
        return self._across(facet, xi, u) * self._sign[facet][:, None]


def _tabulate(element: Any, derivatives: int, points: Array) -> Array:
    """Tabulate, also at no points at all, where basix aborts: (n_tables, n_points, dim)."""
    if len(points):
        return element.tabulate(derivatives, points)[..., 0]
    return np.zeros((1 + derivatives * points.shape[1], 0, element.dim))


def smooth_modulus(surface: Surface, modulus: Array, facet: Array, xi: Array) -> Array:
    """E/h at points of Γc, smoothed over four facets; see `accuracy.modulus_over_height`.

    Args:
        surface: Γc.
        modulus: Young's modulus of the cell behind every facet (stress).
        facet: Facet of every point.
        xi: Reference coordinates of every point.

    Returns:
        (n_points,) (stress/length).
    """
    height, size = surface.heights()
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
        tangents = surface.place(every, points)[1]
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


def pair(
    here: Surface,
    there: Surface,
    points: tuple[Array, Array],
    *,
    reach: float = np.inf,
    u: Array | None = None,
) -> tuple[Array, Array, Array]:
    """What lies opposite the points of Γc; see the docstring of the package's ``pairing``.

    Args:
        here: Γc.
        there: The opposite surface.
        points: Facet and reference coordinates of every point.
        reach: Largest distance.
        u: Displacement at which to pair; none: undeformed.

    Returns:
        Interpolation of the opposite displacement, (n_points, n_nodes); the distance in the
        undeformed bodies, (n_points,); whether there is an opposite, (n_points,).
    """
    facet, xi = points
    normal = here.normal(facet, xi)
    hit, where = there.nearest(here.place(facet, xi, u)[0], normal, reach, u)
    paired = hit >= 0
    gap = np.zeros(len(facet))
    gap[paired] = np.sum(
        (there.place(hit[paired], where[paired])[0] - here.place(facet, xi)[0][paired])
        * normal[paired],
        axis=1,
    )
    matrix = np.zeros((len(facet), len(here.body.places)))
    matrix[paired] = there.interpolation(hit[paired], where[paired])
    for f in range(len(here.facets)):
        own = np.flatnonzero(facet == f)
        if not paired[own].all():
            continue
        pieces, weights = _pieces(here, there, f, u)
        if not len(pieces):
            continue
        f_pieces = np.full(len(pieces), f)
        ray = here.normal(f_pieces, pieces)
        met, at = there.nearest(here.place(f_pieces, pieces, u)[0], ray, reach, u)
        if np.any(met < 0):
            continue
        basis = _polynomials(here, len(own))
        left, at_points = basis(pieces), basis(xi[own])
        gram = left.T @ (weights[:, None] * left)
        project = at_points @ np.linalg.solve(gram, left.T * weights)
        matrix[own] = project @ there.interpolation(met, at)
    return matrix, gap, paired


def penetration(here: Surface, there: Surface, u: Array, weight: float) -> float:
    """∫ of the penetration of ``here``, seen from it, by rays from many points."""
    facet, xi, weights = here.rule(8, "default")
    normal = here.normal(facet, xi)
    hit, where = there.nearest(here.place(facet, xi)[0], normal, np.inf, None)
    met = hit >= 0
    facet, xi, normal, weights = facet[met], xi[met], normal[met], weights[met]
    ends = there.place(hit[met], where[met])[0] - here.place(facet, xi)[0]
    moved = there.place(hit[met], where[met], u)[0] - here.place(facet, xi, u)[0]
    gap = np.sum(ends * normal, axis=1)
    # What lies behind from the start is another surface.
    near = gap > -0.3 * np.ptp(here.body.x, axis=0).max()
    return float(weight * weights[near] @ np.maximum(-np.sum(moved * normal, axis=1)[near], 0.0))


def _polynomials(surface: Surface, n_points: int) -> Any:
    """Monomials of the largest complete space of polynomials that so many points carry."""
    d = surface.d
    if d == 2:
        return lambda s: s[:, :1] ** np.arange(n_points)
    k = 0
    if surface.simplex:
        while (k + 2) * (k + 3) // 2 <= n_points:
            k += 1
        powers = [(i, j) for i in range(k + 1) for j in range(k + 1 - i)]
    else:
        while (k + 2) ** 2 <= n_points:
            k += 1
        powers = [(i, j) for i in range(k + 1) for j in range(k + 1)]
    return lambda s: np.stack([s[:, 0] ** i * s[:, 1] ** j for i, j in powers], axis=1)


def _pieces(here: Surface, there: Surface, f: int, u: Array | None) -> tuple[Array, Array]:
    """Places on facet f, and weights, on the pieces into which the opposite facets cut it."""
    corners, others = here.corners(u)[f], there.corners(u)
    mean = here.normal(*here.middles())[f]
    looks = there.normal(*there.middles()) @ mean < 0
    points, weights = [], []
    if here.d == 2:
        rule, shares = basix.make_quadrature(basix.CellType.interval, 12)
        origin, edge = corners[0], corners[1] - corners[0]
        covered = 0.0
        for other in others[looks]:
            ends = np.clip((other - origin) @ edge / (edge @ edge), 0, 1)
            low, high = ends.min(), ends.max()
            if high - low > 1e-9:
                covered += high - low
                points.append(origin + (low + (high - low) * rule) * edge)
                weights.append((high - low) * shares)
    else:
        rule, shares = basix.make_quadrature(basix.CellType.triangle, 12)
        first = corners[1] - corners[0]
        first = first - (first @ mean) * mean
        first /= np.linalg.norm(first)
        plane = np.column_stack([first, np.cross(mean, first)])
        window = _anticlockwise((corners - corners[0]) @ plane)
        size, covered = _area(window), 0.0
        for other in others[looks]:
            ring = _clip(_anticlockwise((other - corners[0]) @ plane), window)
            for i in range(1, len(ring) - 1):
                edges = np.array([ring[i] - ring[0], ring[i + 1] - ring[0]])
                twice = np.linalg.det(edges)
                covered += 0.5 * twice / size
                if twice > 1e-9 * size:
                    points.append(corners[0] + (ring[0] + rule @ edges) @ plane.T)
                    weights.append(twice * shares)
    if abs(covered - 1) > _COVERED or not points:
        return np.zeros((0, here.d - 1)), np.zeros(0)
    flat = np.concatenate(points)
    xi, _, _ = here.meet(np.full(len(flat), f), flat, np.tile(mean, (len(flat), 1)), u)
    return xi, np.concatenate(weights)


def _area(ring: Array) -> float:
    x, y = ring.T
    return float(0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


def _anticlockwise(ring: Array) -> Array:
    return ring if _area(ring) > 0 else ring[::-1]


def _clip(ring: Array, window: Array) -> Array:
    """Intersection of two convex polygons."""
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


# ---- laws ----------------------------------------------------------------------------------------


@dataclass
class Law:
    """A law by its numbers; see the package's ``laws``.

    Attributes:
        kind: "frictionless", "coulomb", "tresca" or "foundation".
        friction, pressure, transverse, modes, direction: As there.
        tension, unilateral: As there.
    """

    kind: str
    friction: float = 0.0
    pressure: float = 0.0
    transverse: float | None = None
    modes: int | None = None
    direction: Sequence[float] | None = None
    tension: bool = False
    unilateral: bool = True
    _frame: tuple[Any, ...] = field(default=(None, ()), init=False, repr=False, compare=False)

    @property
    def slips(self) -> bool:
        """Whether there is friction."""
        return self.kind in ("coulomb", "tresca")

    @property
    def has_normal(self) -> bool:
        """Whether the pressure answers the gap."""
        return self.kind != "tresca" or self.unilateral

    @property
    def unique(self) -> bool:
        """Whether the tractions follow from a convex potential: an increment has one solution."""
        if self.kind == "foundation":
            return self.tension
        return self.kind != "coulomb" or self.friction == 0.0

    def normal(self, k_n: Array, closing: Array, pressure: Array | None) -> Array:
        """r_n from u_n - s; ``pressure``: multiplier."""
        if not self.has_normal:
            return np.full(closing.shape, -self.pressure, dtype=closing.dtype)
        elastic = k_n * closing + (0.0 if pressure is None else pressure)
        if self.tension:
            return -elastic
        return -np.where(elastic.real > 0, elastic, 0)

    def frame(self, n: Array) -> tuple[Array, ...]:
        """Unit tangents, (n, d) each: in space along the direction and across it."""
        if n is not self._frame[0]:  # normals are the same ones until the support moves
            self._frame = n, self._tangents(n)
        return self._frame[1]

    def _tangents(self, n: Array) -> tuple[Array, ...]:
        if n.shape[1] == 2:
            return (np.stack([-n[:, 1], n[:, 0]], axis=1),)
        if self.direction is None:
            along = (np.abs(n[:, 0].real) < 0.9)[:, None]
            direction = np.where(along, np.array([1.0, 0, 0]), np.array([0.0, 1, 0]))
        else:
            direction = np.asarray(self.direction, dtype=float)
        first = direction - np.sum(direction * n, axis=1)[:, None] * n
        first = first / np.sqrt(np.sum(first * first, axis=1))[:, None]
        return first, np.cross(n, first)

    def tangential(
        self,
        k_t: Array,
        n: Array,
        step: Array,
        old: Array,
        total: Array,
        r_n: Array,
        closing: Array,
        given: Array | None,
    ) -> Array:
        """τ from Δu_t, the old τ and u_t, all (n, d); ``given``: limit of friction.

        Δu_t, u_t, r_n and the closing may have one more axis, the first.
        """
        if self.kind == "foundation":
            tau = -k_t[:, None] * total
            return tau if self.tension else np.where((closing.real > 0)[..., None], tau, 0)
        if not self.slips:
            return np.zeros_like(step)
        limit = (
            -self.friction * r_n
            if self.kind == "coulomb"
            else 0 * r_n + self.friction * self.pressure
        )
        if given is not None:
            limit = 0 * r_n + given
        if n.shape[1] == 2:
            (tangent,) = self.frame(n)
            trial = _dot(old - k_t[:, None] * step, tangent)
            value = np.where(trial.real > limit.real, limit, trial)
            value = np.where(trial.real < -limit.real, -limit, value)
            return value[..., None] * tangent
        first, second = self.frame(n)
        ratio = 1.0 if self.transverse is None else self.transverse / self.friction
        # The limit is a circle or polygon in σ = (τ₁, τ₂/r), and K_t is k_t diag(1, r²).
        trial = np.stack(
            [
                _dot(old, first) - k_t * _dot(step, first),
                _dot(old, second) / ratio - k_t * ratio * _dot(step, second),
            ],
            axis=-1,
        )
        if self.modes is not None:
            sigma = nearest_in_polygon(trial, limit, self.modes)
        else:
            sigma = _nearest_in_circle(trial, limit)
        return sigma[..., :1] * first + ratio * sigma[..., 1:] * second

    def stiffness(self, k_t: Array, n: Array) -> Array:
        """K_t, (n, d, d)."""
        d = n.shape[1]
        if self.transverse is None:
            return k_t[:, None, None] * (np.eye(d) - n[:, :, None] * n[:, None, :])
        first, second = self.frame(n)
        ratio = (self.transverse / self.friction) ** 2
        both = (
            first[:, :, None] * first[:, None, :] + ratio * second[:, :, None] * second[:, None, :]
        )
        return k_t[:, None, None] * both

    def stretch(self, k_t: Array, n: Array, tau: Array) -> Array:
        """K_t⁻¹ τ, (n, d)."""
        along = k_t[:, None, None] * n[:, :, None] * n[:, None, :]
        return np.linalg.solve(self.stiffness(k_t, n) + along, tau[..., None])[..., 0]


def _norm(vector: Array) -> float:
    return math.sqrt(vector @ vector)


def _dot(one: Array, other: Array) -> Array:
    """Scalar products of vectors, which are the last axis; complex ones are not conjugated."""
    return np.einsum("...i,...i->...", one, other)


def _nearest_in_circle(trial: Array, limit: Array) -> Array:
    size = np.sqrt(_dot(trial, trial))
    out = size.real > limit.real
    return np.where(out[..., None], (limit / np.where(out, size, 1.0))[..., None] * trial, trial)


@functools.cache
def _sides(modes: int) -> tuple[Array, Array, float]:
    """Of a regular polygon: normals and directions of the sides, (modes, 2); half of a side."""
    angles = 2 * np.pi * np.arange(modes) / modes
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return normals, np.stack([-normals[:, 1], normals[:, 0]], axis=1), float(np.tan(np.pi / modes))


def nearest_in_polygon(trial: Array, limit: Array, modes: int) -> Array:
    """The nearest point of the polygon: of all its sides' nearest points the nearest one."""
    normals, along, half = _sides(modes)
    limit = limit[..., None]
    inside = np.all((trial @ normals.T).real <= limit.real, axis=-1)
    if np.all(inside):
        return trial + 0 * limit
    y, end = trial @ along.T, half * limit
    y = np.where(y.real > end.real, end, y)
    y = np.where(y.real < -end.real, -end, y)
    places = limit[..., None] * normals + y[..., None] * along
    # By |place|² - 2 place·trial: of a trial far outside, the squared distances are all the same.
    nearest = (_dot(places, places) - 2 * _dot(places, trial[..., None, :])).real.argmin(axis=-1)
    found = np.take_along_axis(places, nearest[..., None, None], axis=-2)[..., 0, :]
    return np.where(inside[..., None], trial, found)


# ---- a contact -----------------------------------------------------------------------------------


@dataclass(eq=False)
class State:
    """What a contact keeps from one increment to the next.

    Attributes:
        jump: Displacement relative to the support that Δu_t counts from, (n, d) (length).
        traction: τ, or with multipliers λ_t, (n, d) (stress).
        pressure: λ_n, (n,) (stress); None without multipliers.
        limit: Of friction, where it is taken for given, (n,) (stress).
    """

    jump: Array
    traction: Array
    pressure: Array | None = None
    limit: Array | None = None


@dataclass(eq=False)
class ContactModel:
    """Γc, its support and its law at points.

    Attributes:
        place: Function of the shift of the support, (d,): gap (n,) and unit normal (n, d).
        interpolation: From node values to the body's displacement, less the opposite one,
            (n_points, n_nodes).
        weights: (n,).
        k_n, k_t: Stiffness at the points, (n,).
        law: The law.
        paired: Points that may carry tractions, (n,).
        free: Components of the support's motion that follow from the force on it.
        project: L2 projection of the multipliers, (n, n); None without multipliers.
        repair: Pairs the points anew at a displacement; None where pairs stay.
        back: ∫ of the penetration as the opposite surface sees it at a displacement; None where
            the support is rigid.
    """

    x: Array
    place: Any
    interpolation: Array
    weights: Array
    k_n: Array
    k_t: Array
    law: Law
    paired: Array
    free: tuple[int, ...] = ()
    project: Array | None = None
    repair: Any = None
    back: Any = None
    _placed: tuple[Any, ...] = field(default=(None, b"", ()), init=False, repr=False)

    @property
    def d(self) -> int:
        """Dimension."""
        return int(self.x.shape[1])

    def start(self) -> State:
        """No traction, no slip."""
        zero = np.zeros_like(self.x)
        return State(zero, zero, None if self.project is None else np.zeros(len(zero)))

    def jump(self, u: Array) -> Array:
        """Displacement of the body, less that of the opposite one, (n, d)."""
        return self.interpolation @ u.reshape(-1, self.d)

    def placed(self, shift: Array) -> tuple[Array, Array]:
        """Gap and normal; the same arrays until the support moves or the pairs change."""
        if np.iscomplexobj(shift):
            return self.place(shift)
        if self._placed[0] is not self.place or self._placed[1] != shift.tobytes():
            self._placed = self.place, shift.tobytes(), self.place(shift)
        return self._placed[2]

    def respond(self, jump: Array, shift: Array, old: State) -> dict[str, Array]:
        """Tractions and what they follow from; of one jump (n, d), or of several, (m, n, d)."""
        gap, n = self.placed(shift)
        relative = jump - shift

        def across(vector: Array) -> Array:
            return vector - _dot(vector, n)[..., None] * n

        closing = _dot(jump, n) - gap
        step, before = across(relative - old.jump), across(old.traction)
        total = across(relative) if self.law.kind == "foundation" else relative
        r_n = self.law.normal(self.k_n, closing, old.pressure)
        tau = self.law.tangential(self.k_t, n, step, before, total, r_n, closing, old.limit)
        r_n, tau = np.where(self.paired, r_n, 0), np.where(self.paired[:, None], tau, 0)
        traction = r_n[..., None] * n + tau
        return {
            "normal": n,
            "closing": closing,
            "relative": relative,
            "step": step,
            "before": before,
            "r_n": r_n,
            "tau": tau,
            "traction": traction,
        }

    def derivatives(
        self, jump: Array, shift: Array, old: State, moves: Sequence[int] | None = None
    ) -> tuple[Array, Array]:
        """∂t/∂jump, (n, d, d), and ∂t/∂shift, (n, d, m); the last index is the component.

        ``moves``: components of the shift that are asked for; by default all of them.
        """
        turns = 1j * _STEP * np.eye(self.d)
        found = self.respond(jump + turns[:, None], shift, old)["traction"]
        by_jump = np.moveaxis(found.imag, 0, 2) / _STEP
        by_shift = np.zeros((len(jump), self.d, self.d if moves is None else len(moves)))
        for k, i in enumerate(range(self.d) if moves is None else moves):
            found = self.respond(jump + 0j, shift + turns[i], old)["traction"]
            by_shift[:, :, k] = found.imag / _STEP
        return by_jump, by_shift

    def augment(self, found: dict[str, Array], old: State) -> State:
        """One round: the multipliers that the tractions found make."""
        assert self.project is not None
        pressure = self.project @ -found["r_n"] if self.law.has_normal else 0 * found["r_n"]
        traction = self.project @ found["tau"] if self.law.slips else old.traction
        return State(old.jump, traction, pressure)

    def next_state(self, found: dict[str, Array], old: State) -> State:
        """History of the next increment; ``old`` with the multipliers it was found with."""
        if self.project is None:
            return State(found["relative"].copy(), found["tau"].copy())
        jump = found["relative"]
        if self.law.slips:
            borne = found["before"] - found["tau"]
            jump = jump - self.law.stretch(self.k_t, found["normal"], borne)
        return State(jump, old.traction.copy(), old.pressure)

    def stored(self, found: dict[str, Array]) -> float:
        """Energy of the springs, of penalty enforcement."""
        w, law = self.weights * self.paired, self.law
        if law.kind == "foundation":
            across = (
                found["relative"]
                - np.sum(found["relative"] * found["normal"], axis=1)[:, None] * found["normal"]
            )
            energy = -found["r_n"] * found["closing"] - np.sum(found["tau"] * across, axis=1)
            return float(w @ energy / 2)
        energy = found["r_n"] ** 2 / (2 * self.k_n) if law.has_normal else 0 * found["r_n"]
        if law.slips:
            stretch = law.stretch(self.k_t, found["normal"], found["tau"])
            energy = energy + np.sum(found["tau"] * stretch, axis=1) / 2
        return float(w @ energy)

    def dissipated(self, found: dict[str, Array]) -> float:
        """Work of friction on the slip of the increment, of penalty enforcement."""
        if not self.law.slips:
            return 0.0
        stretch = self.law.stretch(self.k_t, found["normal"], found["tau"] - found["before"])
        return float(
            -(self.weights * self.paired) @ np.sum(found["tau"] * (found["step"] + stretch), axis=1)
        )


# ---- the problem ---------------------------------------------------------------------------------


@dataclass(eq=False)
class Load:
    """What drives an increment.

    Attributes:
        force: Load vector, (N,) (force).
        fixed: Prescribed unknowns.
        values: Theirs (length).
        shifts: Of every contact the prescribed displacement of its support, (d,); zero where free.
        pushes: Of every contact the force on its support, (d,).
    """

    force: Array
    fixed: Array
    values: Array
    shifts: list[Array]
    pushes: list[Array]


class Failed(RuntimeError):
    """No solution was found here."""


class Reduced:
    """A linear problem on the unknowns of Γc and the free motions, the others eliminated.

    It holds while the pairs and the prescribed unknowns are the same.

    Attributes:
        kept, inner: Numbers of the unknowns of Γc that are free, n, and of those eliminated.
        stiffness: Of these n unknowns, then of m free motions, (n + m, n + m).
        closed: With all of Γc closed and sticking, to hold what nothing holds yet.
        scale: Root of the diagonal of that.
        maps: Of every contact, from the n unknowns to jumps, (n_points d, n).
        left: From all n + m unknowns to jumps less shifts, (n_points d, n + m).
        moves: Of every contact the columns of its motions there, and their components.
    """

    def __init__(self, problem: Problem, fixed: Array) -> None:
        """Eliminate what is neither on Γc nor prescribed."""
        d, stiff = problem.body.d, problem.body.stiffness
        self._fixed = fixed
        self._pairs = [c.interpolation for c in problem.contacts]
        felt, held = np.zeros(len(stiff), dtype=bool), np.zeros(len(stiff), dtype=bool)
        for pairs in self._pairs:
            felt |= np.repeat(np.any(pairs != 0, axis=0), d)
        held[fixed] = True
        self.kept, self.inner = np.flatnonzero(felt & ~held), np.flatnonzero(~felt & ~held)
        self._dragged = stiff[:, fixed]
        schur = stiff[np.ix_(self.kept, self.kept)]
        if len(self.inner):
            self._factor = scipy.linalg.cho_factor(stiff[np.ix_(self.inner, self.inner)])
            self._across = stiff[np.ix_(self.inner, self.kept)]
            self._recover = scipy.linalg.cho_solve(self._factor, self._across)
            schur = schur - self._across.T @ self._recover
        free = problem.motions()
        self.stiffness = scipy.linalg.block_diag(schur, np.zeros((len(free),) * 2))
        self.closed = self.stiffness.copy()
        self.maps, self.left, self.moves, self._ties = [], [], [], []
        for c, model in enumerate(problem.contacts):
            whole = np.kron(model.interpolation, np.eye(d))
            mine = [len(self.kept) + k for k, (o, _) in enumerate(free) if o == c]
            axes = [i for o, i in free if o == c]
            left = np.zeros((model.x.size, len(self.stiffness)))
            left[:, : len(self.kept)] = whole[:, self.kept]
            left[:, mine] = -np.tile(np.eye(d)[:, axes], (len(model.x), 1))
            self.maps.append(whole[:, self.kept])
            self.left.append(left)
            self.moves.append((mine, axes))
            self._ties.append(whole[:, fixed])
            springs = np.where(model.k_t > 0, model.k_t, model.k_n)
            springs = model.weights * np.maximum(model.k_n, springs)
            self.closed += left.T @ (np.repeat(springs, d)[:, None] * left)
        self.scale = np.sqrt(np.maximum(np.abs(np.diag(self.closed)), 1e-300))
        self._sizes = np.abs(self.stiffness), [np.abs(left) for left in self.left]
        self._load: Load | None = None

    def holds(self, problem: Problem, fixed: Array) -> bool:
        """Whether it is still this problem."""
        pairs = zip(problem.contacts, self._pairs, strict=True)
        return all(c.interpolation is p for c, p in pairs) and np.array_equal(fixed, self._fixed)

    def take(self, load: Load) -> tuple[Array, list[Array]]:
        """Forces on the n + m unknowns; jumps of what is prescribed alone, of every contact."""
        if load is not self._load:
            right = load.force - self._dragged @ load.values
            force = right[self.kept]
            if len(self.inner):
                self._first = scipy.linalg.cho_solve(self._factor, right[self.inner])
                force = force - self._across.T @ self._first
            pushes = [load.pushes[c][i] for c, (_, axes) in enumerate(self.moves) for i in axes]
            self._taken = np.concatenate([force, pushes]), [t @ load.values for t in self._ties]
            self._load = load
        return self._taken

    def fill(self, u: Array, kept: Array) -> None:
        """Set the kept unknowns, and those eliminated, of the load taken last."""
        u[self.kept] = kept
        if len(self.inner):
            u[self.inner] = self._first - self._recover @ kept

    def floor(self, z: Array, forces: list[Array]) -> float:
        """Size of all that the residual is summed of: rounding is a share of this."""
        stiff, left = self._sizes
        total = stiff @ np.abs(z)
        for across, force in zip(left, forces, strict=True):
            total += np.abs(force) @ across
        return _norm(total)

    def step(self, matrix: Array, rest: Array) -> Array:
        """Newton's step; that of closed springs where nothing holds the bodies."""
        system = matrix / self.scale[:, None] / self.scale
        right = -rest / self.scale
        size = np.abs(system).sum(axis=0).max(initial=0.0)
        factor, order, singular = scipy.linalg.lapack.dgetrf(system)
        if not singular and scipy.linalg.lapack.dgecon(factor, size)[0] > _WELL:
            return scipy.linalg.lapack.dgetrs(factor, order, right)[0] / self.scale
        if np.linalg.cond(system) > 1e13:
            system = self.closed / self.scale[:, None] / self.scale
        return np.linalg.lstsq(system, right, rcond=1e-15)[0] / self.scale


@dataclass(eq=False)
class Trial:
    """A place of Newton's method.

    Attributes:
        z: The n + m unknowns of `Reduced`.
        rest: Residual of these.
        size: The largest force.
        jumps, shifts, forces: Of every contact.
    """

    z: Array
    rest: Array
    size: float
    jumps: list[Array]
    shifts: list[Array]
    forces: list[Array]


def _change(new: list[State], old: list[State]) -> tuple[float, float]:
    """Largest change of multipliers, and the largest of them (stress)."""
    change = scale = 0.0
    for a, b in zip(new, old, strict=True):
        if a.pressure is not None:
            change = max(change, np.abs(a.pressure - b.pressure).max())
            change = max(change, np.abs(a.traction - b.traction).max())
            scale = max(scale, np.abs(a.pressure).max(), np.abs(a.traction).max())
    return change, scale


@dataclass(eq=False)
class Problem:
    """A linear bulk and contacts, dense."""

    body: Body
    contacts: list[ContactModel]
    _reduced: Reduced | None = field(default=None, init=False, repr=False)

    def motions(self) -> list[tuple[int, int]]:
        """Contact and component of every free motion."""
        return [(c, i) for c, m in enumerate(self.contacts) for i in m.free]

    def shifts(self, load: Load, motion: Array) -> list[Array]:
        """Displacements of the supports."""
        shifts = [np.array(s, dtype=motion.dtype) for s in load.shifts]
        for value, (c, i) in zip(motion, self.motions(), strict=False):
            shifts[c][i] = value
        return shifts

    def respond(self, u: Array, motion: Array, load: Load, old: list[State]) -> list[dict]:
        """Tractions of all contacts."""
        shifts = self.shifts(load, motion)
        return [
            c.respond(c.jump(u), s, o) for c, s, o in zip(self.contacts, shifts, old, strict=True)
        ]

    def contact_force(self, found: list[dict]) -> list[Array]:
        """Force of every contact on the bodies, (N,) each."""
        return [
            (c.interpolation.T @ (c.weights[:, None] * f["traction"])).ravel()
            for c, f in zip(self.contacts, found, strict=True)
        ]

    def stiffness(self, u: Array) -> Array:
        """K, that at a displacement."""
        return self.body.stiffness

    def residual(self, u: Array, load: Load, found: list[dict]) -> tuple[Array, Array]:
        """K u - f - contact on all unknowns, and force on supports not balanced."""
        total = self.body.stiffness @ u - load.force - sum(self.contact_force(found))
        motion = [
            (self.contacts[c].weights @ found[c]["traction"])[i] - load.pushes[c][i]
            for c, i in self.motions()
        ]
        return total, np.array(motion)

    def solve(
        self, u: Array, motion: Array, load: Load, old: list[State], *, rtol: float = 1e-12
    ) -> tuple[Array, Array, list[State]]:
        """One increment.

        Args:
            u: Where to start.
            motion: Likewise.
            load: At the end of the increment.
            old: History.
            rtol: Residual relative to the forces.

        Returns:
            u, motions, and the history with the multipliers that belong to the solution.

        Raises:
            Failed: Nothing was found.
        """
        if all(c.project is None for c in self.contacts):
            return *self.increment_of(u, motion, load, old, rtol), old
        for _ in range(3000):
            u, motion = self.increment_of(u, motion, load, old, rtol)
            found = self.respond(u, motion, load, old)
            new = [
                c.augment(f, o) if c.project is not None else o
                for c, f, o in zip(self.contacts, found, old, strict=True)
            ]
            change, scale = _change(new, old)
            old = new
            if change <= 1e-9 * scale:
                return u, motion, old
        raise Failed("multipliers do not settle")

    def increment_of(
        self, u: Array, motion: Array, load: Load, old: list[State], rtol: float
    ) -> tuple[Array, Array]:
        """Newton's method; where it fails, from where limits of friction have been led to rest."""
        try:
            return self._newton(u, motion, load, old, rtol)
        except (Failed, np.linalg.LinAlgError) as failure:
            if all(c.law.unique for c in self.contacts):
                raise
            last = failure
        pressures = [np.zeros(len(c.x)) for c in self.contacts]
        for attempt in range(25):
            frozen = [
                replace(o, limit=c.law.friction * p if c.law.kind == "coulomb" else None)
                for c, o, p in zip(self.contacts, old, pressures, strict=True)
            ]
            u, motion = self._newton(u, motion, load, frozen, rtol)
            found = self.respond(u, motion, load, frozen)
            pressures = [-f["r_n"] for f in found]
            if attempt in (2, 5, 10, 24):
                with contextlib.suppress(Failed):
                    return self._newton(u, motion, load, old, rtol)
        raise last

    def _reduce(self, fixed: Array) -> Reduced:
        if self._reduced is None or not self._reduced.holds(self, fixed):
            self._reduced = Reduced(self, fixed)
        return self._reduced

    def _tangent(self, reduced: Reduced, at: Trial, old: list[State]) -> Array:
        """Derivative of the residual."""
        d, matrix = self.body.d, reduced.stiffness.copy()
        for c, model in enumerate(self.contacts):
            mine, axes = reduced.moves[c]
            by_jump, by_shift = model.derivatives(at.jumps[c], at.shifts[c], old[c], axes)
            w, maps = model.weights[:, None, None], reduced.maps[c]
            felt = ((w * by_jump) @ maps.reshape(-1, d, maps.shape[1])).reshape(maps.shape)
            matrix[:, : maps.shape[1]] -= reduced.left[c].T @ felt
            if mine:
                turned = (w * by_shift).reshape(-1, len(axes))
                matrix[:, mine] -= reduced.left[c].T @ turned
        return matrix

    def _newton(
        self, u: Array, motion: Array, load: Load, old: list[State], rtol: float
    ) -> tuple[Array, Array]:
        """Newton's method on the unknowns of Γc, the others eliminated."""
        reduced = self._reduce(load.fixed)
        outside, rigid = reduced.take(load)
        d, n = self.body.d, len(reduced.kept)
        given = _norm(outside[:n])

        def evaluate(z: Array) -> Trial:
            inside = reduced.stiffness @ z
            rest, size = inside - outside, max(given, _norm(inside))
            shifts, jumps, forces = self.shifts(load, z[n:]), [], []
            for c, model in enumerate(self.contacts):
                jump = (reduced.maps[c] @ z[:n] + rigid[c]).reshape(-1, d)
                traction = model.respond(jump, shifts[c], old[c])["traction"]
                force = (model.weights[:, None] * traction).ravel()
                total = force @ reduced.left[c]
                rest -= total
                size = max(size, _norm(total[:n]))
                jumps.append(jump)
                forces.append(force)
            return Trial(z, rest, size, jumps, shifts, forces)

        convex = not self.motions() and all(
            c.law.unique or (o.limit is not None and c.law.kind == "coulomb")
            for c, o in zip(self.contacts, old, strict=True)
        )
        now = evaluate(np.concatenate([u[reduced.kept], motion]))
        best, since = (np.inf, now), 0
        for iteration in range(200):
            norm = _norm(now.rest)
            if norm < best[0]:
                since = iteration if norm < 0.5 * best[0] else since
                best = (norm, now)
            if norm <= rtol * now.size or norm <= 1e-14 * reduced.floor(now.z, now.forces):
                break
            if iteration > since + 40:
                break
            step = reduced.step(self._tangent(reduced, now, old), now.rest)
            share, slope = 1.0, now.rest @ step
            low, high = (0.0, slope), None
            first = _norm(now.rest / reduced.scale)
            # The paper's line search: the energy, of laws that have one, is least where its slope
            # along the step is zero. Nothing holds an open body: the share is doubled until
            # something does.
            for _ in range(60):
                trial, tried = evaluate(now.z + share * step), share
                lower = _norm(trial.rest / reduced.scale) < (1 - 0.1 * share) * first
                if lower and not convex:
                    break
                along = trial.rest @ step
                if abs(along) <= 0.3 * abs(slope):
                    break
                if along < 0:
                    low = (share, along)
                else:
                    high = (share, along)
                if high is None:
                    share *= 2.0
                else:
                    part = low[1] / (low[1] - high[1])
                    share = low[0] + np.clip(part, 0.1, 0.9) * (high[0] - low[0])
            if iteration % 9 == 8 and not convex:
                share = 1.0 if iteration % 18 == 8 else 0.37  # out of a cycle
            now = trial if share == tried else evaluate(now.z + share * step)
        norm, now = best
        if norm > 1e3 * rtol * now.size and norm > 1e-12 * reduced.floor(now.z, now.forces):
            raise Failed(f"residual {norm / max(now.size, 1e-300):.1e} of the forces")
        u = u.copy()
        u[load.fixed] = load.values
        reduced.fill(u, now.z[:n])
        return u, now.z[n:].copy()
