"""Rigid obstacles bounded by a smooth profile, in 3D extruded or revolved."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fenics_contact.arguments import check_bool
from fenics_contact.obstacles.base import (
    Rotation,
    Sample,
    SampledObstacle,
    as_vector,
    nonzero_vector,
)
from fenics_contact.obstacles.curve import Curve
from fenics_contact.obstacles.meshed import as_points, fingerprint_of
from fenics_contact.tolerances import NEGLIGIBLE
from fenics_contact.types import Array

__all__ = ["RigidProfile"]


class RigidProfile(SampledObstacle):
    """A rigid obstacle whose surface is a cubic spline through points, extruded or revolved in 3D.

    The spline has no corners: use a `RigidSurface` for a profile with corners. An open profile must
    extend beyond the contact: points whose closest point is one of its ends are outside.

    Args:
        points: Successive points of the surface, (n, gdim) (length), with the obstacle on the left;
            the same on every rank. In space give ``extruded`` or ``turned``, too.
        closed: Whether the last point is connected to the first.
        extruded: Direction of extrusion, three numbers of any length; left is as seen against it.
        turned: A point of the axis of revolution and its direction, three numbers each; left is in
            the half-plane with the axis upwards and the points on its right. If an open profile
            begins or ends on the axis, the surface is smooth there.
        displacement: Rigid translation, as for `Obstacle`.
        rotation: Rotation, as for `Obstacle`.

    Raises:
        ValueError: Shapes or numbers are invalid, or successive points coincide.
    """

    def __init__(
        self,
        points: npt.ArrayLike,
        *,
        closed: bool = False,
        extruded: Sequence[float] | None = None,
        turned: tuple[Sequence[float], Sequence[float]] | None = None,
        displacement: Any = None,
        rotation: Rotation | None = None,
    ) -> None:
        given = as_points("points of the RigidProfile", points)
        check_bool("closed of the RigidProfile", closed)
        self._gdim = given.shape[1]
        options = [v for v in (extruded, turned) if v is not None]
        if len(options) != self._gdim - 2:
            raise ValueError(
                "a RigidProfile needs neither extruded nor turned with points in the plane, and "
                f"one of them with points in space; it has points in {self._gdim} dimensions, "
                f"extruded={extruded!r} and turned={turned!r}"
            )
        self._section: _Extrusion | _Revolution | None = None
        if extruded is not None:
            self._section = _Extrusion(extruded)
        elif turned is not None:
            self._section = _Revolution(turned)
        if self._section is not None:
            given = self._section.plane(given)
        if isinstance(self._section, _Revolution) and not closed:
            given, closed = _mirror_at_axis(given)
        if closed and np.array_equal(given[0], given[-1]):
            given = given[:-1]
        following = np.roll(given, -1, axis=0) if closed else given[1:]
        same = np.flatnonzero(np.all(following == given[: len(following)], axis=1))
        if len(same) or len(given) < 2 + closed:
            raise ValueError(
                f"points of the RigidProfile: of {len(given)} in its plane, those with the indices "
                f"{same.tolist()} coincide with the next one; give at least {2 + closed} "
                "distinct points, in their order on the surface"
            )
        self.curve = Curve(given, closed=closed)
        ends = [a for option in options for a in np.ravel(np.asarray(option, dtype=np.float64))]
        self._fingerprint = fingerprint_of(given, np.array([float(closed), *ends]))
        self.displacement, self.rotation = displacement, rotation

    @property
    def gdim(self) -> int:
        """Dimension of space, 2 or 3."""
        return self._gdim

    @property
    def fingerprint(self) -> str:
        """A string that identifies points, extrusion and axis."""
        return self._fingerprint

    @property
    def smallest_radius(self) -> float:
        """Smallest radius of curvature of the convex parts of the profile (length)."""
        return self.curve.smallest_radius

    def sample(self, x: Array) -> Sample:
        """Return signed distance, normal and curvature at points (n, gdim)."""
        if self._section is None:
            return self.curve.sample(x)
        return self._section.lift(x, self.curve.sample(self._section.plane(x)))


class _Extrusion:
    """Section normal to the direction of extrusion."""

    def __init__(self, direction: Sequence[float]) -> None:
        axis = nonzero_vector("extruded of the RigidProfile", direction, 3)
        # A right-handed basis, from the coordinate axis with the largest angle to the direction.
        first = np.eye(3)[np.argmin(np.abs(axis))]
        first = first - (first @ axis) * axis
        first /= np.linalg.norm(first)
        self._axes = np.stack([first, np.cross(axis, first)])

    def plane(self, x: Array) -> Array:
        """Return coordinates in the section, (n, 2)."""
        return np.asarray(x @ self._axes.T)

    def lift(self, x: Array, flat: Sample) -> Sample:
        """Map a sample of the section to 3D."""
        curvature = np.einsum("ai,nab,bj->nij", self._axes, flat.curvature, self._axes)
        return Sample(flat.distance, flat.normal @ self._axes, curvature)


class _Revolution:
    """Meridian half-plane of an axis of revolution."""

    def __init__(self, axis: tuple[Sequence[float], Sequence[float]]) -> None:
        if not isinstance(axis, Sequence) or len(axis) != 2:
            raise ValueError(
                f"turned of the RigidProfile is {axis!r}; it must be a point of the axis and its "
                "direction, such as ((0, 0, 0), (0, 0, 1))"
            )
        self._origin = as_vector("point in turned of the RigidProfile", axis[0], 3)
        self._axis = nonzero_vector("direction in turned of the RigidProfile", axis[1], 3)

    def _cylindrical_coordinates(self, x: Array) -> tuple[Array, Array, Array]:
        """Return cylindrical coordinates: height, radius and radial unit vectors."""
        arm = x - self._origin
        height = arm @ self._axis
        out = arm - height[:, None] * self._axis
        radius = np.linalg.norm(out, axis=1)
        off_axis = radius > NEGLIGIBLE * np.linalg.norm(arm, axis=1)
        # On the axis, any normal direction is used.
        normal = np.cross(self._axis, np.eye(3)[np.argmin(np.abs(self._axis))])
        out[~off_axis] = normal / np.linalg.norm(normal)
        out[off_axis] /= radius[off_axis, None]
        return height, np.where(off_axis, radius, 0.0), out

    def plane(self, x: Array) -> Array:
        """Return coordinates in the half-plane, (n, 2)."""
        height, radius, _ = self._cylindrical_coordinates(x)
        return np.stack([radius, height], axis=1)

    def lift(self, x: Array, flat: Sample) -> Sample:
        """Map a sample of the half-plane to 3D."""
        _, radius, out = self._cylindrical_coordinates(x)
        axes = np.stack([out, np.broadcast_to(self._axis, out.shape)], axis=1)
        normal = np.einsum("na,nai->ni", flat.normal, axes)
        curvature = np.einsum("nai,nab,nbj->nij", axes, flat.curvature, axes)
        # Circumferential curvature; on the axis equal to that of the profile.
        off_axis = radius > 0.0
        slope = -flat.normal[:, 0] / np.where(off_axis, radius, 1.0)
        circumferential = np.where(off_axis, slope, flat.curvature[:, 0, 0])
        tangent = np.cross(self._axis, out)
        curvature += circumferential[:, None, None] * np.einsum("ni,nj->nij", tangent, tangent)
        return Sample(flat.distance, normal, curvature)


def _mirror_at_axis(points: Array) -> tuple[Array, bool]:
    """Mirror an open profile at the axis where it ends there; return whether it is closed."""
    size = np.abs(points).max()
    starts, ends = (points[i, 0] <= NEGLIGIBLE * size for i in (0, -1))
    mirror = points[::-1] * np.array([-1.0, 1.0])
    if starts and ends:
        return np.concatenate([points, mirror[1:-1]]), True
    if starts:
        return np.concatenate([mirror[:-1], points]), False
    if ends:
        return np.concatenate([points, mirror[1:]]), False
    return points, False
