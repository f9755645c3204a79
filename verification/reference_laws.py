"""Laws of the second solution, at points, as the package's docstrings define them.

See `reference_solver`.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

__all__ = ["Law", "dot", "nearest_in_polygon"]

Array = np.ndarray


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
        if n is not self._frame[0]:  # normals are the same ones until the obstacle moves
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
            trial = dot(old - k_t[:, None] * step, tangent)
            value = np.where(trial.real > limit.real, limit, trial)
            value = np.where(trial.real < -limit.real, -limit, value)
            return value[..., None] * tangent
        first, second = self.frame(n)
        ratio = 1.0 if self.transverse is None else self.transverse / self.friction
        # The limit is a circle or polygon in σ = (τ₁, τ₂/r), and K_t is k_t diag(1, r²).
        trial = np.stack(
            [
                dot(old, first) - k_t * dot(step, first),
                dot(old, second) / ratio - k_t * ratio * dot(step, second),
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


def dot(one: Array, other: Array) -> Array:
    """Scalar products of vectors, which are the last axis; complex ones are not conjugated."""
    return np.einsum("...i,...i->...", one, other)


def _nearest_in_circle(trial: Array, limit: Array) -> Array:
    size = np.sqrt(dot(trial, trial))
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
    nearest = (dot(places, places) - 2 * dot(places, trial[..., None, :])).real.argmin(axis=-1)
    found = np.take_along_axis(places, nearest[..., None, None], axis=-2)[..., 0, :]
    return np.where(inside[..., None], trial, found)
