"""Surfaces of rigid obstacles for figures and files: the zero level set of the gap on a grid."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import basix.ufl
import dolfinx
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI
from ufl.algorithms.analysis import extract_constants, extract_type

from fenics_contact.compat import geometry_dofmap
from fenics_contact.compiling import compile_expression
from fenics_contact.contact.contact import Contact
from fenics_contact.contact.finite import Frame
from fenics_contact.obstacles.base import SampledObstacle
from fenics_contact.types import Array

__all__ = ["ObstacleShape", "box_about", "shapes_of", "zero_level"]

# Number of grid points per axis, by dimension.
_GRID_POINTS = {2: 161, 3: 41}
# Edges of a simplex that intersect the zero level, for each simplex of the level, by dimension and
# number of vertices inside; these vertices come first.
_INTERSECTED_EDGES: dict[tuple[int, int], list[tuple[tuple[int, int], ...]]] = {
    (2, 1): [((0, 1), (0, 2))],
    (2, 2): [((0, 2), (1, 2))],
    (3, 1): [((0, 1), (0, 2), (0, 3))],
    (3, 2): [((0, 2), (0, 3), (1, 3)), ((0, 2), (1, 3), (1, 2))],
    (3, 3): [((0, 3), (1, 3), (2, 3))],
}


class ObstacleShape:
    """The surface of a contact's rigid obstacle in a box. On the calling rank only."""

    def __init__(self, contact: Contact) -> None:
        self._obstacle, self._d = contact.obstacle, contact.surface.mesh.geometry.dim
        n = _GRID_POINTS[self._d] ** self._d
        element = basix.ufl.element("Lagrange", "interval", 1, shape=(self._d,))
        # A mesh of intervals to evaluate UFL; the first node of each is a grid point.
        cells = np.arange(n)[:, None] + np.arange(2)
        x = np.zeros((n + 1, self._d))
        x[:, 0] = np.arange(n + 1)
        self._mesh = dolfinx.mesh.create_mesh(
            MPI.COMM_SELF, cells=cells.astype(np.int64), x=x, e=ufl.Mesh(element)
        )
        self._cells = np.arange(n, dtype=np.int32)
        self._factor = fem.Constant(self._mesh, 1.0)
        inputs, position = contact.inputs, ufl.SpatialCoordinate(self._mesh)
        shift = None if inputs.shift is None else self._factor * inputs.shift
        # Position in the obstacle's frame, or the gap there.
        local: Any = Frame(shift, inputs.rotation).into(position)
        if not isinstance(self._obstacle, SampledObstacle):
            local = self._obstacle.placed(local, _to_ufl(contact)).gap
        self._given = [c for c in extract_constants(ufl.as_ufl(local)) if c is not self._factor]
        self._own = [fem.Constant(self._mesh, c.value.copy()) for c in self._given]
        replaced = ufl.replace(local, dict(zip(self._given, self._own, strict=True)))
        self._local = compile_expression(replaced, np.zeros((1, 1)))

    @staticmethod
    def is_known(contact: Contact) -> bool:
        """Return whether the surface is defined in space, not by a gap on Γc, and rigid."""
        if not contact.contact_kinematics.is_rigid or contact.gap_prescribed:
            return False
        if isinstance(contact.obstacle, SampledObstacle):
            return True
        anywhere = fem.Constant(contact.surface.mesh, np.zeros(contact.surface.mesh.geometry.dim))
        gap = contact.obstacle.placed(anywhere, _to_ufl(contact)).gap
        fixed = extract_type(gap, (ufl.SpatialCoordinate, ufl.Coefficient))
        return anywhere in extract_constants(gap) and not fixed

    def state(self) -> Array:
        """Return the values of all constants that determine the surface, (n,)."""
        return np.concatenate([np.zeros(0), *(np.ravel(c.value) for c in self._given)])

    def __call__(self, box: Array, magnification: float = 1.0, state: Array | None = None) -> Array:
        """Return the vertices of segments, or in space of triangles, (n, d, d) (length).

        Args:
            box: Smallest and largest coordinates, (2, d).
            magnification: Factor of the obstacle's displacement.
            state: Result of `state` at another time; by default the present one.
        """
        n = _GRID_POINTS[self._d]
        axes = [np.linspace(low, high, n) for low, high in box.T]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        self._factor.value = magnification
        numbers = self.state() if state is None else state
        for constant in self._own:
            size = constant.value.size
            constant.value = numbers[:size].reshape(constant.value.shape)
            numbers = numbers[size:]
        values = self._gap(points.reshape(-1, self._d))
        return zero_level(points, values.reshape(points.shape[:-1]))

    def _gap(self, points: Array) -> Array:
        """Return the gap at points, (n,) (length)."""
        self._mesh.geometry.x[geometry_dofmap(self._mesh)[:, 0], : self._d] = points
        local = np.asarray(self._local.eval(self._mesh, self._cells), dtype=np.float64)
        if isinstance(self._obstacle, SampledObstacle):
            return self._obstacle.sample_checked(local.reshape(points.shape)).distance
        return local.ravel()


def _to_ufl(contact: Contact) -> Any:
    return lambda value: contact.inputs.to_ufl("obstacle", value)


def shapes_of(contacts: Sequence[Contact]) -> list[ObstacleShape]:
    """Return the shapes of the contacts' rigid obstacles that can be drawn."""
    return [ObstacleShape(contact) for contact in contacts if ObstacleShape.is_known(contact)]


def box_about(points: Array, margin: float) -> Array:
    """Return the bounding box of points (…, d), extended by margin times its size, (2, d)."""
    points = points.reshape(-1, points.shape[-1])
    low, high = points.min(axis=0), points.max(axis=0)
    extension = margin * (high - low).max()
    return np.stack([low - extension, high + extension])


def zero_level(points: Array, values: Array) -> Array:
    """Return the zero level set of a function that is linear on simplices of a grid.

    Points (n, …, n, d) have values (n, …, n), negative inside. The result are the vertices of
    segments, or in space of triangles, (m, d, d).
    """
    d, n = points.shape[-1], points.shape[0]
    number = np.arange(n**d).reshape((n,) * d)
    first = number[(slice(-1),) * d].ravel()
    steps = n ** np.arange(d - 1, -1, -1)
    # Kuhn triangulation of every cell: one simplex per order of the axes.
    paths = [np.cumsum([0, *steps[list(order)]]) for order in itertools.permutations(range(d))]
    simplices = np.concatenate([first[:, None] + path for path in paths])
    x, v = points.reshape(-1, d), values.ravel()
    inside = v[simplices] < 0
    count = inside.sum(axis=1)
    level = [np.zeros((0, d, d))]
    for (dim, k), parts in _INTERSECTED_EDGES.items():
        if dim != d:
            continue
        cut = simplices[count == k]
        cut = np.take_along_axis(cut, np.argsort(~inside[count == k], axis=1), axis=1)
        for part in parts:
            corners = []
            for i, j in part:
                a, b = cut[:, i], cut[:, j]
                fraction = v[a] / (v[a] - v[b])
                corners.append(x[a] + fraction[:, None] * (x[b] - x[a]))
            level.append(np.stack(corners, axis=1))
    return np.concatenate(level)
