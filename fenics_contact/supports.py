"""What Γc presses on. A support says, by UFL alone, the gap s and the normal n at a point of Γc.

n points **from the body to the support**; s ≥ 0 is the distance along n that is still open. A
support knows no mesh: numbers become constants of the mesh through the function that is passed in,
so that a new value never compiles a new form.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl

from fenics_contact.arguments import is_number

__all__ = ["Ball", "Cylinder", "HalfSpace", "Motion", "Obstacle", "Placement", "Support"]

ToUFL = Callable[[Any], ufl.core.expr.Expr]


@dataclass(frozen=True)
class Placement:
    """Where a support is, seen from a point of Γc (UFL expressions).

    Attributes:
        gap: Distance along the normal, with the support moved: s of eq. (3), in length.
        direction: From body to support, of any length greater than zero.
    """

    gap: ufl.core.expr.Expr
    direction: ufl.core.expr.Expr


@dataclass(frozen=True)
class Motion:
    """A rigid translation of a support of which some components follow from the force on it.

    Per component of space one of the two is given, the other is None. ``Motion(force=(None, -5),
    displacement=(pull, None))`` is pressed down by 5 and pulled along as ``pull`` says.

    Args to the constructor:
        force: External force on the support (force; in 2D force per thickness), numbers or scalar
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


class Support:
    """A rigid support: subclasses say where it is.

    Args to all of them: ``displacement``, the prescribed rigid translation (gdim numbers, a
    ``fem.Constant`` to be changed between increments, or a UFL vector), or a `Motion` where the
    force on the support is given; none means fixed.
    """

    displacement: Any = None

    @property
    def is_flat(self) -> bool:
        """Whether s - u_n is the true gap wherever the body moves, and the normal constant."""
        return False

    def place(
        self, x: ufl.core.expr.Expr, shift: ufl.core.expr.Expr | None, to_ufl: ToUFL
    ) -> Placement:
        """Gap and direction at ``x`` with the support translated by ``shift`` (None: not at all).

        Args:
            x: Coordinates of the point of Γc, shape (gdim,).
            shift: The displacement of the support, shape (gdim,).
            to_ufl: Turns numbers, constants and expressions into UFL.

        Raises:
            ValueError: Data that are not of the mesh's dimension or out of range.
        """
        raise NotImplementedError


def _vector(name: str, value: Any, gdim: int) -> Any:
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
    value = _vector(name, value, gdim)
    if isinstance(value, np.ndarray):
        length = np.linalg.norm(value)
        if length == 0.0:
            raise ValueError(f"{name} is {value.tolist()}; a direction of length zero has no sense")
        return value / length
    return value


def _positive(name: str, value: Any) -> Any:
    """Check a length given by a number."""
    if isinstance(value, ufl.core.expr.Expr):
        return value
    if not (is_number(value) and np.isfinite(value) and value > 0):
        raise ValueError(f"{name} is {value!r}; it must be a number greater than zero")
    return value


@dataclass(frozen=True)
class HalfSpace(Support):
    """A rigid half-space: the plane through ``point``, ``normal`` pointing out of it.

    The body stands on the side the normal points to: a floor has the normal (0, 1).
    """

    point: Sequence[float]
    normal: Sequence[float]
    displacement: Any = None

    @property
    def is_flat(self) -> bool:
        """See `Support.is_flat`."""
        given = (self.point, self.normal)
        return not any(isinstance(value, ufl.core.expr.Expr) for value in given)

    def place(self, x: Any, shift: Any, to_ufl: ToUFL) -> Placement:
        """Gap (x - point - shift)·normal; see `Support.place`."""
        gdim = x.ufl_shape[0]
        normal = to_ufl(nonzero_vector("normal of the HalfSpace", self.normal, gdim))
        normal = normal / ufl.sqrt(ufl.dot(normal, normal))
        arm = x - to_ufl(_vector("point of the HalfSpace", self.point, gdim))
        if shift is not None:
            arm = arm - shift
        return Placement(ufl.dot(arm, normal), -normal)


@dataclass(frozen=True)
class Ball(Support):
    """A rigid ball (a disc in 2D), or with ``inside=True`` the cavity around the body."""

    center: Sequence[float]
    radius: float
    inside: bool = False
    displacement: Any = None

    def place(self, x: Any, shift: Any, to_ufl: ToUFL) -> Placement:
        """Gap |x - center - shift| - radius (negated inside); see `Support.place`."""
        gdim = x.ufl_shape[0]
        arm = x - to_ufl(_vector("center of the Ball", self.center, gdim))
        return _round(arm, shift, to_ufl(_positive("radius of the Ball", self.radius)), self.inside)


@dataclass(frozen=True)
class Cylinder(Support):
    """A rigid circular cylinder through ``point`` along ``axis``; in 2D the axis is out of plane.

    With ``inside=True`` it is the bore around the body.
    """

    point: Sequence[float]
    radius: float
    axis: Sequence[float] | None = None
    inside: bool = False
    displacement: Any = None

    def place(self, x: Any, shift: Any, to_ufl: ToUFL) -> Placement:
        """Gap: distance from the axis minus radius (negated inside); see `Support.place`."""
        gdim = x.ufl_shape[0]
        arm = x - to_ufl(_vector("point of the Cylinder", self.point, gdim))
        if gdim == 2 and self.axis is not None:
            raise ValueError(f"axis of the Cylinder is {self.axis!r}; in 2D it takes none")
        if gdim == 3:
            if self.axis is None:
                raise ValueError("axis of the Cylinder is missing; in 3D give its direction")
            axis = to_ufl(nonzero_vector("axis of the Cylinder", self.axis, gdim))
            axis = axis / ufl.sqrt(ufl.dot(axis, axis))
            arm = arm - ufl.dot(arm, axis) * axis
            if shift is not None:
                shift = shift - ufl.dot(shift, axis) * axis
        return _round(
            arm, shift, to_ufl(_positive("radius of the Cylinder", self.radius)), self.inside
        )


def _round(arm: Any, shift: Any, radius: Any, inside: bool) -> Placement:
    if shift is not None:
        arm = arm - shift
    distance = ufl.sqrt(ufl.dot(arm, arm))
    if inside:
        return Placement(radius - distance, arm)
    return Placement(distance - radius, -arm)


@dataclass(frozen=True)
class Obstacle(Support):
    """Any rigid obstacle, by its gap and normal as numbers, constants, functions or UFL.

    Args to the constructor:
        gap: Distance that is open along ``normal`` before any displacement, in length; negative
            is a penetration.
        normal: From the body to the obstacle, of any length greater than zero, shape (gdim,).
        displacement: See `Support`; its part along ``normal`` adds to the gap.
    """

    gap: Any
    normal: Any
    displacement: Any = None

    def place(self, x: Any, shift: Any, to_ufl: ToUFL) -> Placement:
        """The given gap, plus the support's own motion along the normal; see `Support.place`."""
        gdim = x.ufl_shape[0]
        direction = to_ufl(nonzero_vector("normal of the Obstacle", self.normal, gdim))
        gap = to_ufl(self.gap)
        if gap.ufl_shape != ():
            raise ValueError(f"gap of the Obstacle has shape {gap.ufl_shape}; it must be a scalar")
        if shift is not None:
            gap = gap + ufl.dot(shift, direction) / ufl.sqrt(ufl.dot(direction, direction))
        return Placement(gap, direction)
