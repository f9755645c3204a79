"""Rigid supports."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import ufl

from fenics_contact.supports.base import Placement, Support, as_positive, as_vector, nonzero_vector

__all__ = ["Ball", "Cylinder", "HalfSpace", "Obstacle", "ToUFL"]

ToUFL = Callable[[Any], ufl.core.expr.Expr]


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
        arm = x - to_ufl(as_vector("point of the HalfSpace", self.point, gdim))
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
        arm = x - to_ufl(as_vector("center of the Ball", self.center, gdim))
        return _round(
            arm, shift, to_ufl(as_positive("radius of the Ball", self.radius)), self.inside
        )


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
        arm = x - to_ufl(as_vector("point of the Cylinder", self.point, gdim))
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
            arm, shift, to_ufl(as_positive("radius of the Cylinder", self.radius)), self.inside
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
            is a penetration. A motion of the obstacle is no part of it: see `Support`.
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
