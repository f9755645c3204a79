"""Contact laws of the independent solver (`reference_solver`), evaluated at points in NumPy."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

__all__ = ["Law", "dot", "project_onto_polygon"]

Array = np.ndarray


@dataclass
class Law:
    """A contact law given by its parameters, which are those of the package's ``laws``.

    Attributes:
        kind: "frictionless", "coulomb", "tresca" or "foundation".
        friction, pressure, transverse, modes, direction: Parameters of `Coulomb` and `Tresca`.
        tension, unilateral: Parameters of `Foundation` and `Tresca`.
    """

    kind: str
    friction: float = 0.0
    pressure: float = 0.0
    transverse: float | None = None
    modes: int | None = None
    direction: Sequence[float] | None = None
    tension: bool = False
    unilateral: bool = True
    _cached_basis: tuple[Any, ...] = field(
        default=(None, ()), init=False, repr=False, compare=False
    )

    @property
    def has_friction(self) -> bool:
        """Whether points can slip."""
        return self.kind in ("coulomb", "tresca")

    @property
    def has_normal(self) -> bool:
        """Whether r_n depends on the gap."""
        return self.kind != "tresca" or self.unilateral

    @property
    def is_unique(self) -> bool:
        """Whether tractions derive from a convex potential, so that an increment is unique."""
        if self.kind == "foundation":
            return self.tension
        return self.kind != "coulomb" or self.friction == 0.0

    def normal_traction(self, k_n: Array, overclosure: Array, pressure: Array | None) -> Array:
        """Return r_n for the overclosure u_n - s and the multiplier ``pressure``, if any."""
        if not self.has_normal:
            return np.full(overclosure.shape, -self.pressure, dtype=overclosure.dtype)
        elastic = k_n * overclosure + (0.0 if pressure is None else pressure)
        if self.tension:
            return -elastic
        return -np.where(elastic.real > 0, elastic, 0)

    def tangent_basis(self, n: Array) -> tuple[Array, ...]:
        """Return unit tangents, (n, d) each; in space along and across the friction direction."""
        if n is not self._cached_basis[0]:  # the array is the same until the obstacle moves
            self._cached_basis = n, self._tangents(n)
        return self._cached_basis[1]

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

    def tangential_traction(
        self,
        k_t: Array,
        n: Array,
        slip_increment: Array,
        old_traction: Array,
        displacement: Array,
        r_n: Array,
        overclosure: Array,
        prescribed_bound: Array | None,
    ) -> Array:
        """Return τ, (n, d), for Δu_t, the committed τ and u_t, (n, d) each.

        Δu_t, u_t, r_n and the overclosure may have an additional first axis.
        ``prescribed_bound`` replaces the friction bound of the law.
        """
        if self.kind == "foundation":
            tau = -k_t[:, None] * displacement
            return tau if self.tension else np.where((overclosure.real > 0)[..., None], tau, 0)
        if not self.has_friction:
            return np.zeros_like(slip_increment)
        bound = (
            -self.friction * r_n
            if self.kind == "coulomb"
            else 0 * r_n + self.friction * self.pressure
        )
        if prescribed_bound is not None:
            bound = 0 * r_n + prescribed_bound
        if n.shape[1] == 2:
            (tangent,) = self.tangent_basis(n)
            trial = dot(old_traction - k_t[:, None] * slip_increment, tangent)
            value = np.where(trial.real > bound.real, bound, trial)
            value = np.where(trial.real < -bound.real, -bound, value)
            return value[..., None] * tangent
        first, second = self.tangent_basis(n)
        ratio = 1.0 if self.transverse is None else self.transverse / self.friction
        # The cone is a circle or polygon in σ = (τ₁, τ₂/r), and K_t is k_t diag(1, r²).
        trial = np.stack(
            [
                dot(old_traction, first) - k_t * dot(slip_increment, first),
                dot(old_traction, second) / ratio - k_t * ratio * dot(slip_increment, second),
            ],
            axis=-1,
        )
        if self.modes is not None:
            sigma = project_onto_polygon(trial, bound, self.modes)
        else:
            sigma = _project_onto_circle(trial, bound)
        return sigma[..., :1] * first + ratio * sigma[..., 1:] * second

    def stiffness(self, k_t: Array, n: Array) -> Array:
        """Return the tangential stiffness K_t, (n, d, d)."""
        d = n.shape[1]
        if self.transverse is None:
            return k_t[:, None, None] * (np.eye(d) - n[:, :, None] * n[:, None, :])
        first, second = self.tangent_basis(n)
        ratio = (self.transverse / self.friction) ** 2
        both = (
            first[:, :, None] * first[:, None, :] + ratio * second[:, :, None] * second[:, None, :]
        )
        return k_t[:, None, None] * both

    def elastic_slip(self, k_t: Array, n: Array, tau: Array) -> Array:
        """Return the elastic slip K_t⁻¹ τ, (n, d)."""
        along = k_t[:, None, None] * n[:, :, None] * n[:, None, :]
        return np.linalg.solve(self.stiffness(k_t, n) + along, tau[..., None])[..., 0]


def dot(one: Array, other: Array) -> Array:
    """Return scalar products along the last axis, without conjugation of complex vectors."""
    return np.einsum("...i,...i->...", one, other)


def _project_onto_circle(trial: Array, bound: Array) -> Array:
    size = np.sqrt(dot(trial, trial))
    out = size.real > bound.real
    return np.where(out[..., None], (bound / np.where(out, size, 1.0))[..., None] * trial, trial)


@functools.cache
def _polygon_sides(modes: int) -> tuple[Array, Array, float]:
    """Return normals and directions of a polygon's sides, (modes, 2), and half of their length."""
    angles = 2 * np.pi * np.arange(modes) / modes
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return normals, np.stack([-normals[:, 1], normals[:, 0]], axis=1), float(np.tan(np.pi / modes))


def project_onto_polygon(trial: Array, bound: Array, modes: int) -> Array:
    """Return the closest point of a regular polygon, from the closest points of all its sides."""
    normals, along, half = _polygon_sides(modes)
    bound = bound[..., None]
    inside = np.all((trial @ normals.T).real <= bound.real, axis=-1)
    if np.all(inside):
        return trial + 0 * bound
    y, end = trial @ along.T, half * bound
    y = np.where(y.real > end.real, end, y)
    y = np.where(y.real < -end.real, -end, y)
    candidates = bound[..., None] * normals + y[..., None] * along
    # By |x|² - 2 x·trial, because squared distances from a trial far outside lose all digits.
    nearest = (dot(candidates, candidates) - 2 * dot(candidates, trial[..., None, :])).real.argmin(
        axis=-1
    )
    found = np.take_along_axis(candidates, nearest[..., None, None], axis=-2)[..., 0, :]
    return np.where(inside[..., None], trial, found)
