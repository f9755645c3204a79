"""Obstacles: what Γc presses on. They give gap s and normal n at a point, as UFL or numbers.

n points **from the body to the obstacle**; s ≥ 0 is the distance along n that is still open. A
obstacle knows no mesh: numbers become constants of the mesh through the function that is passed in,
so that a new value never compiles a new form.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl

from fenics_contact.arguments import is_number
from fenics_contact.types import Array

__all__ = [
    "NOWHERE",
    "Motion",
    "Obstacle",
    "Placement",
    "Rotation",
    "Sample",
    "SampledObstacle",
    "ToUFL",
    "as_positive",
    "as_vector",
    "nonzero_vector",
]

ToUFL = Callable[[Any], ufl.core.expr.Expr]

# A coordinate whose square is still a number: a diverged state has points beyond.
NOWHERE = 1e100


@dataclass(frozen=True)
class Placement:
    """Where an obstacle is, seen from a point of Γc (UFL expressions).

    Attributes:
        gap: Distance along the normal, with the obstacle moved: s of eq. (3), in length.
        direction: From body to obstacle, of any length greater than zero.
    """

    gap: ufl.core.expr.Expr
    direction: ufl.core.expr.Expr

    @property
    def normal(self) -> ufl.core.expr.Expr:
        """The direction of length 1."""
        return self.direction / ufl.sqrt(ufl.dot(self.direction, self.direction))


@dataclass(frozen=True)
class Motion:
    """A rigid translation of an obstacle of which some components follow from the force on it.

    Per component of space one of the two is given, the other is None. ``Motion(force=(None, -5),
    displacement=(pull, None))`` is pressed down by 5 and pulled along as ``pull`` says.

    Args to the constructor:
        force: External force on the obstacle (force; in 2D force per thickness), numbers or scalar
            ``fem.Constant``; of a symmetric model the modelled part's share.
        displacement: Prescribed components (length), likewise; none: zero where no force is given.
    """

    force: Sequence[Any]
    displacement: Sequence[Any] | None = None

    def components(self, gdim: int) -> tuple[dict[int, Any], dict[int, Any]]:
        """Forces and prescribed displacements by component.

        Raises:
            ValueError: A component has both or is missing.
        """
        given = self.displacement if self.displacement is not None else (None,) * gdim
        lists = (v if isinstance(v, Sequence | np.ndarray) else () for v in (self.force, given))
        sizes = [len(v) for v in lists]
        if sizes != [gdim, gdim]:
            raise ValueError(
                f"Motion has {sizes[0]} forces and {sizes[1]} displacements; it must have "
                f"{gdim} of each on this mesh, None where the other one is given"
            )
        both = [i for i in range(gdim) if self.force[i] is not None and given[i] is not None]
        if both:
            raise ValueError(
                f"Motion gives force and displacement of component {both[0]}; give one of them, "
                "and None for the other"
            )
        forces = {i: f for i, f in enumerate(self.force) if f is not None}
        return forces, {
            i: 0.0 if given[i] is None else given[i] for i in range(gdim) if i not in forces
        }


@dataclass(frozen=True)
class Rotation:
    """A turn of an obstacle about an axis that is fixed in it, of any size.

    One of angle and moment is given, the other is None: ``Rotation(None, about, moment=0.0)`` turns
    as contact turns it, as a roller does. It needs ``Contact(kinematics="finite")``. The
    displacement of the obstacle moves the axis, too, whether it is prescribed or a `Motion`.

    Args to the constructor:
        angle: In radians, right-handed about the axis, in the plane anticlockwise: a number, or a
            scalar ``fem.Constant`` to be changed between increments. None where the moment is
            given; then it is found.
        about: A point of the axis where the obstacle has not been displaced, gdim numbers (length).
        axis: Its direction, three numbers of any length; in the plane none.
        moment: External moment on the obstacle about the axis, in the sense of the angle (force
            times length; in 2D per thickness), a number or scalar ``fem.Constant``; of a symmetric
            model the modelled part's share.
    """

    angle: Any
    about: Sequence[float]
    axis: Sequence[float] | None = None
    moment: Any = None

    def unit_axis(self, gdim: int) -> Array:
        """Direction of the axis, (3,); in the plane out of it.

        Raises:
            ValueError: There is an axis in the plane, or none in space.
        """
        if gdim == 2 and self.axis is not None:
            raise ValueError(f"axis of the Rotation is {self.axis!r}; in 2D it takes none")
        if gdim == 3 and self.axis is None:
            raise ValueError("axis of the Rotation is missing; in 3D give its direction")
        if self.axis is None:
            return np.array([0.0, 0.0, 1.0])
        found: Array = nonzero_vector("axis of the Rotation", self.axis, gdim)
        return found

    def matrix(self, gdim: int, angle: ufl.core.expr.Expr) -> ufl.core.expr.Expr:
        """R, which takes directions from where the obstacle began to where it is (gdim, gdim).

        Args:
            gdim: Dimension of the mesh.
            angle: As UFL, given or found.

        Raises:
            ValueError: There is an axis in the plane, or none in space; or the angle is no scalar.
        """
        x, y, z = (float(v) for v in self.unit_axis(gdim))
        if angle.ufl_shape != ():
            raise ValueError(
                f"angle of the Rotation has shape {angle.ufl_shape}; it must be a scalar (radians)"
            )
        c, s = ufl.cos(angle), ufl.sin(angle)
        if gdim == 2:
            return ufl.as_matrix([[c, -s], [s, c]])
        across = ufl.as_matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return ufl.Identity(3) + s * across + (1 - c) * ufl.dot(across, across)

    def turned(self, vectors: Array, angle: float | Array) -> Array:
        """Vectors turned by an angle (radians), one for all or one for each, (n, gdim)."""
        c, s = (np.reshape(f(angle), (-1, 1)) for f in (np.cos, np.sin))
        if self.axis is None:
            return np.asarray(c * vectors + s * self.rate(vectors))
        axis = self.unit_axis(3)
        along = np.outer(vectors @ axis, axis)
        return np.asarray(along + c * (vectors - along) + s * np.cross(axis, vectors))

    def rate(self, vectors: Array) -> Array:
        """By how much vectors that turn with the obstacle change by a unit angle, (n, gdim)."""
        if vectors.shape[1] == 2:
            return np.column_stack([-vectors[:, 1], vectors[:, 0]])
        return np.asarray(np.cross(self.unit_axis(3), vectors), dtype=np.float64)


class Obstacle:
    """A rigid obstacle: subclasses say where it is.

    Args to all of them: ``displacement``, the prescribed rigid translation (gdim numbers, a
    ``fem.Constant`` to be changed between increments, or a UFL vector, which may vary along Γc), or
    a `Motion` where the force on the obstacle is given; none means fixed. One that varies along Γc
    turns the obstacle without its normals: forces are off by about the angle, of which the verdict
    tells. ``rotation``, a `Rotation`: with finite
    kinematics alone.

    An obstacle that moves is moved by these alone. Where its place or gap is changed instead (a
    constant in ``point``, ``center`` or ``gap``), contact opens and closes as it should, but
    friction does not feel the part along Γc, nor do the energies count work: nothing tells such a
    change from one of shape.
    """

    displacement: Any = None
    rotation: Rotation | None = None

    def check_complete(self) -> None:
        """Refuse a subclass that does not say where the obstacle is.

        Raises:
            ValueError: It names what is missing.
        """
        self._check_said(Obstacle, place="its gap and direction, as UFL")

    def _check_said(self, abstract: type[Obstacle], **members: str) -> None:
        """Refuse members that are still those of a class that has them only to be replaced."""
        for member, meaning in members.items():
            if getattr(type(self), member) is getattr(abstract, member):
                raise ValueError(
                    f"{type(self).__name__} is no obstacle: a subclass of {abstract.__name__} must "
                    f"say its {member}: {meaning}"
                )

    @property
    def is_distance(self) -> bool:
        """Whether the direction of `place` is the gradient of its gap, as it was given."""
        return False

    @property
    def is_flat(self) -> bool:
        """Whether it is a plane: of one normal, with a gap that is linear in the place."""
        return False

    @property
    def smallest_radius(self) -> float:
        """Smallest radius of curvature where the obstacle is convex (length).

        Infinite where it is nowhere convex, or where the radius is not known as a number.
        """
        return np.inf

    def place(
        self, x: ufl.core.expr.Expr, shift: ufl.core.expr.Expr | None, to_ufl: ToUFL
    ) -> Placement:
        """Gap and direction at ``x`` with the obstacle translated by ``shift`` (None: not at all).

        Args:
            x: Coordinates of the point, shape (gdim,): of Γc, or with finite kinematics where it
                has moved to, seen from where the obstacle began.
            shift: The displacement of the obstacle, shape (gdim,).
            to_ufl: Turns numbers, constants and expressions into UFL.

        Raises:
            ValueError: Data that are not of the mesh's dimension or out of range.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class Sample:
    """What an obstacle says in numbers at n places.

    Attributes:
        distance: Signed distance, positive outside of the obstacle, (n,) (length).
        normal: Minus its gradient: unit vectors from body to obstacle, (n, gdim).
        curvature: Its second derivatives, (n, gdim, gdim) (1/length).
    """

    distance: Array
    normal: Array
    curvature: Array


class SampledObstacle(Obstacle):
    """A rigid obstacle that is known in numbers alone, from data: subclasses sample its distance.

    They are asked at the present places of the points of Γc in every evaluation, so that tractions
    and their derivatives are those of the distance itself. Subclasses have ``displacement`` and
    ``rotation`` as attributes; see `Obstacle`.
    """

    def check_complete(self) -> None:
        """See `Obstacle.check_complete`."""
        self._check_said(
            SampledObstacle,
            gdim="the dimension of space, 2 or 3",
            fingerprint="a word that tells its data from others",
            sample="distance, normal and curvature at places, in numbers",
        )

    @property
    def gdim(self) -> int:
        """Dimension of space, 2 or 3."""
        raise NotImplementedError

    @property
    def fingerprint(self) -> str:
        """A word that tells the data from others, the same on every rank."""
        raise NotImplementedError

    def sample(self, x: Array) -> Sample:
        """Distance, normal and curvature at places; not collective.

        Args:
            x: Finite coordinates where the obstacle has neither moved nor turned, (n, gdim), n ≥ 0;
                those of a trial of the solver may be far off. Distance and normal must be finite
                wherever they are.
        """
        raise NotImplementedError

    def sample_checked(self, x: Array) -> Sample:
        """`sample`, which may change its argument; NaN at places of a diverged state.

        Not collective.

        Raises:
            ValueError: Something has a wrong shape, or a distance or normal is not finite: a NaN
                would pass for a gap that is open.
        """
        there = np.abs(x).max(axis=1, initial=0.0) < NOWHERE
        given = self.sample(x[there])
        d, name = x.shape[1], type(self).__name__
        n = int(np.count_nonzero(there))
        shapes = {"distance": (n,), "normal": (n, d), "curvature": (n, d, d)}
        arrays = {}
        for what, shape in shapes.items():
            array = np.asarray(getattr(given, what), dtype=np.float64)
            if array.shape != shape:
                raise ValueError(
                    f"{name}: {what} of its sample has shape {array.shape}; {n} places in {d} "
                    f"dimensions need {shape}"
                )
            if what != "curvature":  # a round obstacle has none at its centre
                wrong = ~np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
                if wrong.any():
                    raise ValueError(
                        f"{name}: {what} of its sample is not finite at "
                        f"{x[there][wrong][0].tolist()}; an obstacle must have one at every place, "
                        "however far off"
                    )
            arrays[what] = np.full((len(x), *shape[1:]), np.nan)
            arrays[what][there] = array
        return Sample(**arrays)


def as_vector(name: str, value: Any, gdim: int) -> Any:
    """Check a point or direction given by numbers: ``gdim`` finite entries."""
    if isinstance(value, ufl.core.expr.Expr):
        if value.ufl_shape != (gdim,):
            raise ValueError(f"{name} has shape {value.ufl_shape}; the mesh needs ({gdim},)")
        return value
    entries = value if isinstance(value, Sequence | np.ndarray) else ()
    if len(entries) != gdim or not all(is_number(v) and np.isfinite(v) for v in entries):
        raise ValueError(f"{name} is {value!r}; it must be {gdim} finite numbers on this mesh")
    return np.asarray(value, dtype=np.float64)


def nonzero_vector(name: str, value: Any, gdim: int) -> Any:
    """Check a direction given by numbers: not of length zero. Its length does not matter."""
    value = as_vector(name, value, gdim)
    if isinstance(value, np.ndarray):
        length = np.linalg.norm(value)
        if length == 0.0:
            raise ValueError(f"{name} is {value.tolist()}; a direction of length zero has no sense")
        return value / length
    return value


def as_positive(name: str, value: Any) -> Any:
    """Check a length given by a number."""
    if isinstance(value, ufl.core.expr.Expr):
        return value
    if not (is_number(value) and np.isfinite(value) and value > 0):
        raise ValueError(f"{name} is {value!r}; it must be a number greater than zero")
    return value
