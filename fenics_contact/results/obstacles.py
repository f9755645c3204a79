"""Where rigid obstacles are, for pictures and files: the zero level of their gap on a grid."""

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

# Points of the grid along each axis, by dimension.
_POINTS = {2: 161, 3: 41}
# Edges of a simplex whose ends are on both sides, by the dimension and the number of corners that
# are inside, these first: those of each simplex of the level.
_CROSSED: dict[tuple[int, int], list[tuple[tuple[int, int], ...]]] = {
    (2, 1): [((0, 1), (0, 2))],
    (2, 2): [((0, 2), (1, 2))],
    (3, 1): [((0, 1), (0, 2), (0, 3))],
    (3, 2): [((0, 2), (0, 3), (1, 3)), ((0, 2), (1, 3), (1, 2))],
    (3, 3): [((0, 3), (1, 3), (2, 3))],
}


class ObstacleShape:
    """The surface of a contact's rigid obstacle where it is now, in a box. On the calling rank."""

    def __init__(self, contact: Contact) -> None:
        self._obstacle, self._d = contact.obstacle, contact.surface.mesh.geometry.dim
        n = _POINTS[self._d] ** self._d
        element = basix.ufl.element("Lagrange", "interval", 1, shape=(self._d,))
        # A chain of intervals: the first node of each is a point of the grid, and of the mesh
        # nothing but the coordinates there is wanted.
        cells = np.arange(n)[:, None] + np.arange(2)
        x = np.zeros((n + 1, self._d))
        x[:, 0] = np.arange(n + 1)
        self._mesh = dolfinx.mesh.create_mesh(
            MPI.COMM_SELF, cells=cells.astype(np.int64), x=x, e=ufl.Mesh(element)
        )
        self._cells = np.arange(n, dtype=np.int32)
        self._factor = fem.Constant(self._mesh, 1.0)
        inputs, place = contact.inputs, ufl.SpatialCoordinate(self._mesh)
        shift = None if inputs.shift is None else self._factor * inputs.shift
        seen: Any = Frame(shift, inputs.rotation).into(place)
        if not isinstance(self._obstacle, SampledObstacle):
            seen = self._obstacle.placed(seen, _to_ufl(contact)).gap
        self._given = [c for c in extract_constants(ufl.as_ufl(seen)) if c is not self._factor]
        self._own = [fem.Constant(self._mesh, c.value.copy()) for c in self._given]
        replaced = ufl.replace(seen, dict(zip(self._given, self._own, strict=True)))
        self._seen = compile_expression(replaced, np.zeros((1, 1)))

    @staticmethod
    def is_known(contact: Contact) -> bool:
        """Whether the obstacle has a place of its own: gaps on Γc, and bodies, have none."""
        if not contact.rigid or contact.gap_prescribed:
            return False
        if isinstance(contact.obstacle, SampledObstacle):
            return True
        anywhere = fem.Constant(contact.surface.mesh, np.zeros(contact.surface.mesh.geometry.dim))
        gap = contact.obstacle.placed(anywhere, _to_ufl(contact)).gap
        fixed = extract_type(gap, (ufl.SpatialCoordinate, ufl.Coefficient))
        return anywhere in extract_constants(gap) and not fixed

    def state(self) -> Array:
        """All numbers that say where the obstacle is now, (n,)."""
        return np.concatenate([np.zeros(0), *(np.ravel(c.value) for c in self._given)])

    def __call__(self, box: Array, magnification: float = 1.0, state: Array | None = None) -> Array:
        """Segments, in space triangles, by their corners, (n, d, d) (length).

        Args:
            box: Least and largest coordinates, (2, d).
            magnification: Factor of the obstacle's displacement, as the body's is drawn.
            state: What `state` gave at the time that is wanted; None: now.
        """
        n = _POINTS[self._d]
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
        """Of points in space, (n,) (length)."""
        self._mesh.geometry.x[geometry_dofmap(self._mesh)[:, 0], : self._d] = points
        seen = np.asarray(self._seen.eval(self._mesh, self._cells), dtype=np.float64)
        if isinstance(self._obstacle, SampledObstacle):
            return self._obstacle.sample_checked(seen.reshape(points.shape)).distance
        return seen.ravel()


def _to_ufl(contact: Contact) -> Any:
    return lambda value: contact.inputs.to_ufl("obstacle", value)


def shapes_of(contacts: Sequence[Contact]) -> list[ObstacleShape]:
    """Those of contacts whose obstacles have a place of their own."""
    return [ObstacleShape(contact) for contact in contacts if ObstacleShape.is_known(contact)]


def box_about(places: Array, margin: float) -> Array:
    """Least and largest coordinates of places, (…, d), and some of their extent beyond: (2, d)."""
    places = places.reshape(-1, places.shape[-1])
    low, high = places.min(axis=0), places.max(axis=0)
    reach = margin * (high - low).max()
    return np.stack([low - reach, high + reach])


def zero_level(points: Array, values: Array) -> Array:
    """Where values on a grid pass through zero, by linear functions on simplices of its cells.

    Args:
        points: Of a grid of n points along each axis, (n, …, n, d), d = 2 or 3.
        values: (n, …, n), negative inside.

    Returns:
        Corners of segments, in space of triangles, (m, d, d).
    """
    d, n = points.shape[-1], points.shape[0]
    number = np.arange(n**d).reshape((n,) * d)
    first = number[(slice(-1),) * d].ravel()
    steps = n ** np.arange(d - 1, -1, -1)
    # Of every cell the simplices along whose edges the coordinates grow one after another.
    ways = [np.cumsum([0, *steps[list(order)]]) for order in itertools.permutations(range(d))]
    simplices = np.concatenate([first[:, None] + way for way in ways])
    x, v = points.reshape(-1, d), values.ravel()
    inside = v[simplices] < 0
    count = inside.sum(axis=1)
    found = [np.zeros((0, d, d))]
    for (dim, k), parts in _CROSSED.items():
        if dim != d:
            continue
        some = simplices[count == k]
        some = np.take_along_axis(some, np.argsort(~inside[count == k], axis=1), axis=1)
        for part in parts:
            corners = []
            for i, j in part:
                a, b = some[:, i], some[:, j]
                share = v[a] / (v[a] - v[b])
                corners.append(x[a] + share[:, None] * (x[b] - x[a]))
            found.append(np.stack(corners, axis=1))
    return np.concatenate(found)
