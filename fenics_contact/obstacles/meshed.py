"""Rigid obstacles whose surface is given by facets."""

from __future__ import annotations

import hashlib
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fenics_contact.arguments import check_positive, is_number
from fenics_contact.obstacles.base import Rotation, Sample, SampledObstacle
from fenics_contact.obstacles.facets import Facets
from fenics_contact.obstacles.stl import read_stl
from fenics_contact.types import Array

__all__ = ["RigidSurface", "as_points", "fingerprint_of"]


class RigidSurface(SampledObstacle):
    """A rigid obstacle given by facets: triangles in space, a polyline in the plane.

    The normal is constant on each facet and jumps between facets, by less with ``halvings``. Points
    in the obstacle are pushed out through the closest facet. An open surface must extend beyond the
    contact: points whose closest point is on its boundary are outside.

    Args:
        points: Corners, (n_points, gdim) (length), the same on every rank; coincident ones are
            merged.
        facets: Indices of the corners of each facet, (n_facets, gdim): in space anticlockwise
            seen from outside, as in an STL file; in the plane with the obstacle on the left.
        halvings: Number of uniform refinements of the triangles, each into four, whose new corners
            lie on a smooth surface through the corners; each halves the angles between facets.
        sharp: Angle between neighbouring facets (radians) from which on their edge is an edge of
            the smooth surface, too, such as the rim of a cylinder.
        displacement: Rigid translation, as for `Obstacle`.
        rotation: Rotation, as for `Obstacle`.

    Attributes:
        facets: The refined surface, with its search tree.

    Raises:
        ValueError: Shapes or indices are invalid, or neighbours have opposite orientations.
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
        corners = as_points("points of the RigidSurface", points)
        numbers = np.asarray(facets)
        d = corners.shape[1]
        integral = numbers.dtype.kind in "iu"
        if numbers.ndim != 2 or numbers.shape[1] != d or not len(numbers) or not integral:
            raise ValueError(
                f"facets of the RigidSurface are {numbers.dtype} of shape {numbers.shape}; they "
                f"must be integers of shape (n_facets, {d}) with points in {d} dimensions"
            )
        if numbers.min() < 0 or numbers.max() >= len(corners):
            raise ValueError(
                f"facets of the RigidSurface have indices from {numbers.min()} to {numbers.max()}; "
                f"with {len(corners)} points they must be from 0 to {len(corners) - 1}"
            )
        is_integer = is_number(halvings) and isinstance(halvings, Integral)
        if not is_integer or halvings < 0 or (halvings and d == 2):
            raise ValueError(
                f"halvings of the RigidSurface is {halvings!r}; it must be an integer, at least 0, "
                "and 0 in the plane: use a RigidProfile for a smooth curve through points"
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
        """Read the surface from an STL file, binary or ASCII. Every rank reads it.

        Args:
            path: Name of the file.
            scale: Factor of its coordinates, such as 1e-3 for a file in mm and a mesh in m.
            halvings: Number of uniform refinements, as for the constructor.
            sharp: Angle of edges that remain sharp (radians), as for the constructor.
            displacement: Rigid translation, as for `Obstacle`.
            rotation: Rotation, as for `Obstacle`.

        Raises:
            ValueError: The file has no triangles, the scale is not a positive number, or
                neighbouring triangles have opposite orientations.
            OSError: The file cannot be read.
        """
        check_positive("scale", scale)
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
        """Dimension of space, 2 or 3."""
        return self.facets.points.shape[1]

    @property
    def fingerprint(self) -> str:
        """A string that identifies points and facets."""
        return fingerprint_of(self.facets.points, self.facets.facets)

    def sample(self, x: Array) -> Sample:
        """Return signed distance, normal and curvature (zero on facets) at points (n, gdim)."""
        return self.facets.sample(x)


def as_points(name: str, value: npt.ArrayLike) -> Array:
    """Return points as an array, after checking its shape, (n, 2) or (n, 3), and values.

    Raises:
        ValueError: The shape is another one, or numbers are not finite.
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
        raise ValueError(f"{name}: {bad} of the {len(points)} are not finite; all must be finite")
    return points


def fingerprint_of(*arrays: npt.NDArray[Any]) -> str:
    """Return a string that identifies the numbers in arrays."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.shape}{array.dtype.kind}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]
