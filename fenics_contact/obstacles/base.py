"""Base classes of obstacles, which define gap s and normal n at a point of Γc.

n points **from the body to the obstacle**; s is the gap along n, ≥ 0 where open. Obstacles are
independent of the mesh: `Obstacle.place` receives a function that makes constants of numbers, so
that new values do not compile new forms.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl

from fenics_contact.arguments import check_positive, is_built_in, is_number
from fenics_contact.types import Array

__all__ = [
    "MAX_COORDINATE",
    "Motion",
    "Obstacle",
    "Placement",
    "Rotation",
    "Sample",
    "SampledObstacle",
    "ToUFL",
    "as_axis",
    "as_positive",
    "as_vector",
    "nonzero_vector",
]

ToUFL = Callable[[Any], ufl.core.expr.Expr]

# Largest coordinate at which obstacles are evaluated; points of diverged states may be beyond.
MAX_COORDINATE = 1e100


@dataclass(frozen=True)
class Placement:
    """Gap and contact normal of an obstacle at a point (UFL expressions).

    Attributes:
        gap: Gap s along the normal (length).
        direction: Direction from body to obstacle, of any length greater than zero.
    """

    gap: ufl.core.expr.Expr
    direction: ufl.core.expr.Expr

    @property
    def normal(self) -> ufl.core.expr.Expr:
        """The unit normal n, ``direction`` divided by its length."""
        return self.direction / ufl.sqrt(ufl.dot(self.direction, self.direction))


@dataclass(frozen=True)
class Motion:
    """A rigid translation of an obstacle, of which components with a given force are unknown.

    For every component a force, a displacement or neither (at rest) is given. An obstacle
    with ``Motion(force=(None, -5), displacement=(pull, None))`` is pressed down with force 5 and
    moved by ``pull`` in x.

    Args:
        force: External force on the obstacle (force; in 2D force per thickness), gdim numbers or
            scalar ``fem.Constant``; in a symmetric model, the part on the modelled half.
        displacement: Prescribed components (length), numbers or scalar ``fem.Constant``; by
            default zero where no force is given.
    """

    force: Sequence[Any]
    displacement: Sequence[Any] | None = None

    def components(self, gdim: int) -> tuple[dict[int, Any], dict[int, Any]]:
        """Return the given forces and the prescribed displacements, by number of the component.

        Raises:
            ValueError: A component has both, or the number of components is not ``gdim``.
        """
        given = self.displacement if self.displacement is not None else (None,) * gdim
        lists = (v if isinstance(v, Sequence | np.ndarray) else () for v in (self.force, given))
        sizes = [len(v) for v in lists]
        if sizes != [gdim, gdim]:
            raise ValueError(
                f"Motion has {sizes[0]} forces and {sizes[1]} displacements; on this mesh it must "
                f"have {gdim} of each, None where the other one is given"
            )
        both = [i for i in range(gdim) if self.force[i] is not None and given[i] is not None]
        if both:
            raise ValueError(
                f"Motion has force and displacement of component {both[0]}; give one of them, "
                "and None for the other"
            )
        forces = {i: f for i, f in enumerate(self.force) if f is not None}
        return forces, {
            i: 0.0 if given[i] is None else given[i] for i in range(gdim) if i not in forces
        }


@dataclass(frozen=True)
class Rotation:
    """A finite rotation of an obstacle about an axis that is fixed in the obstacle.

    Either angle or moment is given. ``Rotation(None, about, moment=0.0)`` is a free roller, rotated
    by friction. A rotation needs ``Contact(kinematics="finite")``. The displacement of the obstacle
    moves the axis, whether it is prescribed or a `Motion`.

    Args:
        angle: Angle (radians), right-handed about the axis, anticlockwise in the plane: a number or
            a scalar ``fem.Constant``. None if the moment is given: the angle is then unknown.
        about: A point of the axis before any displacement, gdim numbers (length).
        axis: Direction of the axis, three numbers of any length; None in the plane.
        moment: External moment on the obstacle about the axis, in the sense of the angle (force
            times length; in 2D per thickness): a number or a scalar ``fem.Constant``; in a
            symmetric model, the part on the modelled half.
    """

    angle: Any
    about: Sequence[float]
    axis: Sequence[float] | None = None
    moment: Any = None

    def unit_axis(self, gdim: int) -> Array:
        """Return the unit vector along the axis, (3,); in the plane, the one out of the plane.

        Raises:
            ValueError: ``axis`` is given in the plane, or missing in space.
        """
        axis = as_axis("axis of the Rotation", self.axis, gdim)
        return np.array([0.0, 0.0, 1.0]) if axis is None else np.asarray(axis)

    def matrix(self, gdim: int, angle: ufl.core.expr.Expr) -> ufl.core.expr.Expr:
        """Return the rotation matrix R, from initial to present directions, (gdim, gdim).

        Args:
            gdim: Dimension of the mesh.
            angle: Angle as UFL (radians).

        Raises:
            ValueError: ``axis`` is given in the plane, or missing in space, or the angle is not a
                scalar.
        """
        x, y, z = (float(v) for v in self.unit_axis(gdim))
        if angle.ufl_shape != ():
            raise ValueError(
                f"angle of the Rotation has shape {angle.ufl_shape}; it must be a scalar (radians)"
            )
        c, s = ufl.cos(angle), ufl.sin(angle)
        if gdim == 2:
            return ufl.as_matrix([[c, -s], [s, c]])
        skew = ufl.as_matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return ufl.Identity(3) + s * skew + (1 - c) * ufl.dot(skew, skew)

    def rotate(self, vectors: Array, angle: float | Array) -> Array:
        """Rotate vectors (n, gdim) by one angle, or by one angle each (radians)."""
        c, s = (np.reshape(f(angle), (-1, 1)) for f in (np.cos, np.sin))
        if self.axis is None:
            return np.asarray(c * vectors + s * self.rate(vectors))
        axis = self.unit_axis(3)
        along = np.outer(vectors @ axis, axis)
        return np.asarray(along + c * (vectors - along) + s * np.cross(axis, vectors))

    def rate(self, vectors: Array) -> Array:
        """Return axis × vectors, the derivative of rotated vectors by the angle, (n, gdim)."""
        if vectors.shape[1] == 2:
            return np.column_stack([-vectors[:, 1], vectors[:, 0]])
        return np.asarray(np.cross(self.unit_axis(3), vectors), dtype=np.float64)


class Obstacle:
    """Base class of obstacles, which define the gap and the normal at a point of Γc.

    Rigid obstacles define both by `place`; the opposing surface of a `DeformableBody` is found by a
    search. Move a rigid obstacle by ``displacement`` and ``rotation`` only. If a constant in its
    ``point``, ``center`` or ``gap`` is changed instead, contact opens and closes correctly, but the
    tangential part of the motion causes no slip, and the energies do not contain its work: it
    cannot be distinguished from a change of shape.

    Attributes:
        displacement: Prescribed rigid translation: gdim numbers, a ``fem.Constant`` that may be
            changed between increments, or a UFL vector; or a `Motion`, if the force on the obstacle
            is given; None: fixed. A displacement that varies along Γc rotates the obstacle but
            not its normals; the relative error of the forces is about the angle (radians), and
            is estimated after every increment.
        rotation: A `Rotation`, with finite kinematics only; None: no rotation.
    """

    displacement: Any = None
    rotation: Rotation | None = None

    def check_complete(self) -> None:
        """Check that a subclass defines `place`.

        Raises:
            ValueError: `place` is not defined.
        """
        self._check_members(Obstacle, place="its gap and direction, as UFL")

    def _check_members(self, abstract: type[Obstacle], **members: str) -> None:
        """Check that a subclass overrides abstract members."""
        for member, meaning in members.items():
            if getattr(type(self), member) is getattr(abstract, member):
                raise ValueError(
                    f"{type(self).__name__} is no obstacle: a subclass of {abstract.__name__} must "
                    f"define {member}: {meaning}"
                )

    @property
    def is_flat(self) -> bool:
        """Whether the obstacle is a plane, with a constant normal and a linear gap."""
        return False

    @property
    def smallest_radius(self) -> float:
        """Smallest convex radius of curvature (length); infinite if there is none or unknown."""
        return np.inf

    def place(self, x: ufl.core.expr.Expr, to_ufl: ToUFL) -> Placement:
        """Return gap and direction at a point.

        Args:
            x: Coordinates of the point in the frame of the obstacle, where that is neither
                displaced nor rotated, shape (gdim,): of the undeformed Γc, or with finite
                kinematics of the deformed one.
            to_ufl: Converts numbers, constants and expressions to UFL.

        Raises:
            ValueError: Data have the wrong dimension or are out of range.
        """
        raise NotImplementedError

    def placed(self, x: ufl.core.expr.Expr, to_ufl: ToUFL) -> Placement:
        """Return the result of `place` after checking it.

        Raises:
            ValueError: `place` fails, or returns no gap and direction of the mesh's dimension.
        """
        name, d = f"{type(self).__name__}.place", x.ufl_shape[0]
        try:
            found = self.place(x, to_ufl)
            if isinstance(found, Placement):
                found = Placement(ufl.as_ufl(found.gap), ufl.as_vector(found.direction))
                ufl.as_ufl(found.normal)  # fails for a zero direction
        except Exception as error:
            if is_built_in(self):
                raise
            raise ValueError(
                f"{name}(x, to_ufl) fails at a position x of {d} components: "
                f"{type(error).__name__}: {error}"
            ) from error
        if not isinstance(found, Placement):
            raise ValueError(
                f"{name} returns a {type(found).__name__}; it must return a Placement(gap, "
                "direction)"
            )
        gap, direction = found.gap.ufl_shape, found.direction.ufl_shape
        if gap != () or direction != (d,):
            raise ValueError(
                f"{name} returns a gap of shape {gap} and a direction of shape {direction}; they "
                f"must be () and ({d},)"
            )
        return found


@dataclass(frozen=True)
class Sample:
    """Signed distance of an obstacle and its derivatives at n points.

    Attributes:
        distance: Signed distance d, positive outside of the obstacle, (n,) (length).
        normal: Contact normal -∇d, unit vectors from body to obstacle, (n, gdim).
        curvature: Second derivatives of d, (n, gdim, gdim) (1/length).
    """

    distance: Array
    normal: Array
    curvature: Array


class SampledObstacle(Obstacle):
    """A rigid obstacle given by data; subclasses return its signed distance by `sample`.

    `sample` is called in every evaluation, at the present positions of the points of Γc, so that
    tractions and tangent are those of the exact distance. Subclasses have the attributes
    ``displacement`` and ``rotation`` of `Obstacle`.
    """

    def check_complete(self) -> None:
        """Check that a subclass defines `gdim`, `fingerprint` and `sample`.

        Raises:
            ValueError: One of them is not defined.
        """
        self._check_members(
            SampledObstacle,
            gdim="the dimension of space, 2 or 3",
            fingerprint="a string that identifies its data",
            sample="distance, normal and curvature at given points, in numbers",
        )

    @property
    def gdim(self) -> int:
        """Dimension of space, 2 or 3."""
        raise NotImplementedError

    @property
    def fingerprint(self) -> str:
        """A string that identifies the data, the same on every rank."""
        raise NotImplementedError

    def sample(self, x: Array) -> Sample:
        """Return signed distance, normal and curvature at points. Not collective.

        Args:
            x: Finite coordinates in the frame of the obstacle, (n, gdim), n ≥ 0. Trial states of
                the solver may be far from the obstacle; distance and normal must be finite there,
                too.
        """
        raise NotImplementedError

    def sample_checked(self, x: Array) -> Sample:
        """Return `sample` after checking shapes and values; NaN beyond `MAX_COORDINATE`.

        Not collective.

        Raises:
            ValueError: An array has the wrong shape, or a distance or normal is not finite.
        """
        valid = np.abs(x).max(axis=1, initial=0.0) < MAX_COORDINATE
        given = self.sample(x[valid])
        d, name = x.shape[1], type(self).__name__
        n = int(np.count_nonzero(valid))
        shapes = {"distance": (n,), "normal": (n, d), "curvature": (n, d, d)}
        arrays = {}
        for field, shape in shapes.items():
            array = np.asarray(getattr(given, field), dtype=np.float64)
            if array.shape != shape:
                raise ValueError(
                    f"{name}: {field} of its sample has shape {array.shape}; for {n} points in {d} "
                    f"dimensions it must be {shape}"
                )
            if field != "curvature":  # undefined at the centre of a ball
                wrong = ~np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
                if wrong.any():
                    raise ValueError(
                        f"{name}: {field} of its sample is not finite at "
                        f"{x[valid][wrong][0].tolist()}; it must be finite at every point, however "
                        "far from the obstacle"
                    )
            arrays[field] = np.full((len(x), *shape[1:]), np.nan)
            arrays[field][valid] = array
        return Sample(**arrays)


def as_vector(name: str, value: Any, gdim: int) -> Any:
    """Check a point or direction: UFL, or ``gdim`` finite numbers."""
    if isinstance(value, ufl.core.expr.Expr):
        if value.ufl_shape != (gdim,):
            raise ValueError(f"{name} has shape {value.ufl_shape}; the mesh needs ({gdim},)")
        return value
    entries = value if isinstance(value, Sequence | np.ndarray) else ()
    if len(entries) != gdim or not all(is_number(v) and np.isfinite(v) for v in entries):
        raise ValueError(f"{name} is {value!r}; it must be {gdim} finite numbers on this mesh")
    return np.asarray(value, dtype=np.float64)


def nonzero_vector(name: str, value: Any, gdim: int) -> Any:
    """Check a direction and normalise it if it is given by numbers."""
    value = as_vector(name, value, gdim)
    if isinstance(value, np.ndarray):
        largest = np.abs(value).max()
        if largest == 0.0:
            raise ValueError(f"{name} is {value.tolist()}; it must not have length zero")
        value = value / largest  # avoids overflow of squares
        return value / np.linalg.norm(value)
    return value


def as_axis(name: str, value: Any, gdim: int) -> Any:
    """Check the direction of an axis: `nonzero_vector` in 3D, None in 2D."""
    if gdim == 2 and value is not None:
        raise ValueError(f"{name} is {value!r}; omit it in 2D")
    if gdim == 3 and value is None:
        raise ValueError(f"{name} is missing; in 3D give its direction")
    return None if value is None else nonzero_vector(name, value, gdim)


def as_positive(name: str, value: Any) -> Any:
    """Check that a number is positive."""
    if not isinstance(value, ufl.core.expr.Expr):
        check_positive(name, value)
    return value
