"""Rigid obstacles whose surface is given by facets."""

from __future__ import annotations

import hashlib
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fenics_contact.arguments import is_number
from fenics_contact.obstacles.base import Rotation, Sample, SampledObstacle
from fenics_contact.obstacles.facets import Facets
from fenics_contact.obstacles.stl import read_stl
from fenics_contact.types import Array

__all__ = ["RigidSurface", "as_points", "fingerprint_of"]


class RigidSurface(SampledObstacle):
    """A rigid obstacle given by its surface: triangles in space, in the plane a polyline.

    Facets are flat: the normal jumps from one to the next, by less with ``halvings``. Points within
    the obstacle are pushed out through the closest facet. An open surface must reach beyond where
    contact may be: points from which its border is closest are outside.

    Attributes:
        facets: The surface, as it is searched.
    """

    def __init__(
        self,
        points: npt.ArrayLike,
        facets: npt.ArrayLike,
        *,
        halvings: int = 0,
        sharp: float = np.pi / 6,
        displacement: Any = None,
        rotation: Rotation | None = None,
    ) -> None:
        """Take the surface.

        Args:
            points: Corners, (n_points, gdim) (length), the same on every rank; equal ones are one.
            facets: Numbers of the corners of each facet, (n_facets, gdim): in space anticlockwise
                as seen from outside, as in an STL file; in the plane with the obstacle on the left
                of the way.
            halvings: How often the edges of triangles are halved, towards the smooth surface that
                they stand for: each makes four triangles of one, and angles half as large.
            sharp: Angle between neighbours (radians) from which on the edge is one of the surface
                itself, such as the rim of a cylinder.
            displacement: See `Obstacle`.
            rotation: Likewise.

        Raises:
            ValueError: Shapes or numbers are wrong, or neighbours are ordered against each other.
        """
        corners = as_points("points of the RigidSurface", points)
        numbers = np.asarray(facets)
        d = corners.shape[1]
        kind = numbers.dtype.kind in "iu"
        if numbers.ndim != 2 or numbers.shape[1] != d or not len(numbers) or not kind:
            raise ValueError(
                f"facets of the RigidSurface are {numbers.dtype} of shape {numbers.shape}; give "
                f"whole numbers of shape (n_facets, {d}) with points in {d} dimensions"
            )
        if numbers.min() < 0 or numbers.max() >= len(corners):
            raise ValueError(
                f"facets of the RigidSurface have numbers from {numbers.min()} to {numbers.max()}; "
                f"there are {len(corners)} points: give numbers from 0 to {len(corners) - 1}"
            )
        whole = is_number(halvings) and isinstance(halvings, Integral)
        if not whole or halvings < 0 or (halvings and d == 2):
            raise ValueError(
                f"halvings of the RigidSurface is {halvings!r}; it must be a whole number, zero or "
                "greater, and zero in the plane: a smooth curve through points is a RigidProfile"
            )
        if not (is_number(sharp) and 0 < sharp <= np.pi):
            raise ValueError(f"sharp is {sharp!r}; it must be an angle in radians, from 0 to pi")
        try:
            self.facets = Facets(corners, numbers.astype(np.intp), int(halvings), float(sharp))
        except ValueError as error:
            raise ValueError(f"RigidSurface: {error}") from None
        self.displacement, self.rotation = displacement, rotation

    @classmethod
    def from_stl(
        cls,
        path: str | Path,
        *,
        scale: float = 1.0,
        halvings: int = 0,
        sharp: float = np.pi / 6,
        displacement: Any = None,
        rotation: Rotation | None = None,
    ) -> RigidSurface:
        """The surface in an STL file, binary or ASCII. Every rank reads it.

        Args:
            path: Of the file.
            scale: Factor of its coordinates, such as 1e-3 for a file in mm and a mesh in m.
            halvings: See the constructor.
            sharp: Likewise.
            displacement: See `Obstacle`.
            rotation: Likewise.

        Raises:
            ValueError: The file has no triangles, or the scale is none; see the constructor, too.
            OSError: It cannot be read.
        """
        if not (is_number(scale) and np.isfinite(scale) and scale > 0):
            raise ValueError(f"scale is {scale!r}; it must be a number greater than zero")
        points, facets = read_stl(Path(path))
        return cls(
            scale * points,
            facets,
            halvings=halvings,
            sharp=sharp,
            displacement=displacement,
            rotation=rotation,
        )

    @property
    def gdim(self) -> int:
        """See `SampledObstacle.gdim`."""
        return self.facets.points.shape[1]

    @property
    def fingerprint(self) -> str:
        """See `SampledObstacle.fingerprint`."""
        return fingerprint_of(self.facets.points, self.facets.facets)

    def sample(self, x: Array) -> Sample:
        """See `SampledObstacle.sample`."""
        return self.facets.sample(x)


def as_points(name: str, value: npt.ArrayLike) -> Array:
    """Check points given by numbers: (n, 2) or (n, 3), finite, not all the same.

    Raises:
        ValueError: It says what was given.
    """
    points = np.asarray(value)
    shape = points.shape
    if points.dtype.kind not in "iuf" or len(shape) != 2 or shape[1] not in (2, 3) or shape[0] < 2:
        raise ValueError(
            f"{name} are {points.dtype} of shape {shape}; give numbers of shape (n, 2) in the "
            "plane or (n, 3) in space, n at least 2"
        )
    points = points.astype(np.float64)
    if not np.isfinite(points).all():
        bad = int(np.sum(~np.isfinite(points).all(axis=1)))
        raise ValueError(f"{name}: {bad} of the {len(points)} are not finite; give finite numbers")
    return points


def fingerprint_of(*arrays: npt.NDArray[Any]) -> str:
    """A word that tells the numbers in arrays from others."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.shape}{array.dtype.kind}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]
