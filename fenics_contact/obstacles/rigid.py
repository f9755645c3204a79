"""Rigid obstacles in UFL: half-space, ball, cylinder, cone, signed distance, prescribed gap."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from fenics_contact.arguments import check_bool, is_number
from fenics_contact.obstacles.base import (
    Obstacle,
    Placement,
    Rotation,
    ToUFL,
    as_axis,
    as_positive,
    as_vector,
    nonzero_vector,
)

__all__ = [
    "Ball",
    "Cylinder",
    "HalfSpace",
    "PrescribedGap",
    "RoundedCone",
    "SignedDistance",
]


@dataclass(frozen=True)
class HalfSpace(Obstacle):
    """A rigid half-space, bounded by a plane.

    Args:
        point: A point of the plane, gdim numbers (length).
        normal: Normal of the plane, of any length, pointing out of the half-space to the body: a
            floor has the normal (0, 1).
        displacement: Rigid translation, as for `Obstacle`.
        rotation: Rotation, as for `Obstacle`.
    """

    point: Sequence[float]
    normal: Sequence[float]
    displacement: Any = None
    rotation: Rotation | None = None

    @property
    def is_flat(self) -> bool:
        """Whether the obstacle is a plane given by numbers."""
        given = (self.point, self.normal)
        return not any(isinstance(value, ufl.core.expr.Expr) for value in given)

    def place(self, x: Any, to_ufl: ToUFL) -> Placement:
        """Return the gap (x - point)·normal and the direction -normal."""
        gdim = x.ufl_shape[0]
        normal = to_ufl(nonzero_vector("normal of the HalfSpace", self.normal, gdim))
        normal = normal / ufl.sqrt(ufl.dot(normal, normal))
        arm = x - to_ufl(as_vector("point of the HalfSpace", self.point, gdim))
        return Placement(ufl.dot(arm, normal), -normal)


@dataclass(frozen=True)
class Ball(Obstacle):
    """A rigid ball, in 2D a disc, or a spherical cavity.

    Args:
        center: Centre, gdim numbers (length).
        radius: Radius, > 0 (length).
        inside: Whether the body is inside of the sphere, which is then a cavity.
        displacement: Rigid translation, as for `Obstacle`.
        rotation: Rotation, as for `Obstacle`.
    """

    center: Sequence[float]
    radius: float
    inside: bool = False
    displacement: Any = None
    rotation: Rotation | None = None

    @property
    def smallest_radius(self) -> float:
        """Radius (length); infinite for a cavity, or if it is not known as a number."""
        return _convex_radius(self.radius, self.inside)

    def place(self, x: Any, to_ufl: ToUFL) -> Placement:
        """Return the gap |x - center| - radius, negated inside, and the direction."""
        gdim = x.ufl_shape[0]
        check_bool("inside of the Ball", self.inside)
        arm = x - to_ufl(as_vector("center of the Ball", self.center, gdim))
        return _round(arm, to_ufl(as_positive("radius of the Ball", self.radius)), self.inside)


@dataclass(frozen=True)
class Cylinder(Obstacle):
    """A rigid circular cylinder, in 2D a disc, or a cylindrical bore.

    Args:
        point: A point of the axis, gdim numbers (length).
        radius: Radius, > 0 (length).
        axis: Direction of the axis, three numbers of any length; None in 2D, where the axis is
            normal to the plane.
        inside: Whether the body is inside of the cylinder, which is then a bore.
        displacement: Rigid translation, as for `Obstacle`.
        rotation: Rotation, as for `Obstacle`.
    """

    point: Sequence[float]
    radius: float
    axis: Sequence[float] | None = None
    inside: bool = False
    displacement: Any = None
    rotation: Rotation | None = None

    @property
    def smallest_radius(self) -> float:
        """Radius (length); infinite for a bore, or if it is not known as a number."""
        return _convex_radius(self.radius, self.inside)

    def place(self, x: Any, to_ufl: ToUFL) -> Placement:
        """Return the distance from the axis minus radius, negated inside, and the direction.

        Raises:
            ValueError: ``axis`` is given in 2D or missing in 3D, or data are out of range.
        """
        gdim = x.ufl_shape[0]
        check_bool("inside of the Cylinder", self.inside)
        arm = x - to_ufl(as_vector("point of the Cylinder", self.point, gdim))
        axis = as_axis("axis of the Cylinder", self.axis, gdim)
        if axis is not None:
            axis = to_ufl(axis)
            axis = axis / ufl.sqrt(ufl.dot(axis, axis))
            arm = arm - ufl.dot(arm, axis) * axis
        return _round(arm, to_ufl(as_positive("radius of the Cylinder", self.radius)), self.inside)


@dataclass(frozen=True)
class RoundedCone(Obstacle):
    """A rigid cone with a spherical tip, in 2D a wedge with a round tip.

    It is an indenter: Rockwell's has a half-angle of 60° and a tip radius of 0.2 mm. The flank is
    tangent to the sphere, and has no end.

    Args:
        tip: Outermost point of the tip, gdim numbers (length).
        axis: Direction from the tip into the cone, gdim numbers of any length.
        half_angle: Angle between axis and flank (radians), between 0 and π/2.
        radius: Radius of the tip, > 0 (length).
        displacement: Rigid translation, as for `Obstacle`.
        rotation: Rotation, as for `Obstacle`.
    """

    tip: Sequence[float]
    axis: Sequence[float]
    half_angle: float
    radius: float
    displacement: Any = None
    rotation: Rotation | None = None

    @property
    def smallest_radius(self) -> float:
        """Radius of the tip (length); infinite if it is not known as a number."""
        return _convex_radius(self.radius, inside=False)

    def place(self, x: Any, to_ufl: ToUFL) -> Placement:
        """Return the signed distance and minus its gradient.

        With the coordinates z along the axis and ρ across it, from the centre of the tip, the
        distance is √(ρ² + z²) - r where the tip is closest, ρ sin α + z cos α < 0, and
        ρ cos α - z sin α - r where the flank is.

        Raises:
            ValueError: ``half_angle`` is not between 0 and π/2, or data are out of range.
        """
        gdim, angle = x.ufl_shape[0], as_positive("half_angle of the RoundedCone", self.half_angle)
        if is_number(angle) and not angle < np.pi / 2:
            raise ValueError(
                f"half_angle of the RoundedCone is {self.half_angle!r}; it must be less than π/2 "
                "(radians), a right angle"
            )
        radius = to_ufl(as_positive("radius of the RoundedCone", self.radius))
        axis = to_ufl(nonzero_vector("axis of the RoundedCone", self.axis, gdim))
        axis = axis / ufl.sqrt(ufl.dot(axis, axis))
        tip = to_ufl(as_vector("tip of the RoundedCone", self.tip, gdim))
        c, s = ufl.cos(to_ufl(angle)), ufl.sin(to_ufl(angle))
        position = ufl.variable(x)
        arm = position - tip - radius * axis
        z = ufl.dot(arm, axis)
        radial = arm - z * axis
        # The derivative of ρ does not exist on the axis, where the distance from the tip is used.
        rho = ufl.sqrt(ufl.dot(radial, radial))
        gap = ufl.conditional(
            ufl.lt(rho * s + z * c, 0),
            ufl.sqrt(ufl.dot(arm, arm)) - radius,
            rho * c - z * s - radius,
        )
        return Placement(gap, -ufl.diff(gap, position))


def _convex_radius(radius: Any, inside: bool) -> float:
    """Return the radius of a convex surface if it is a number, else infinity."""
    if isinstance(radius, fem.Constant) and not radius.ufl_shape:
        radius = float(radius.value)
    return float(radius) if is_number(radius) and radius > 0.0 and not inside else np.inf


def _round(arm: Any, radius: Any, inside: bool) -> Placement:
    distance = ufl.sqrt(ufl.dot(arm, arm))
    if inside:
        return Placement(radius - distance, arm)
    return Placement(distance - radius, -arm)


@dataclass(frozen=True)
class SignedDistance(Obstacle):
    """A rigid obstacle of any shape, given by its signed distance at every point.

    The gap of a point is g_N = d(x) and the normal n = -∇d(x), eq. (2): at the undeformed position
    with small displacements, at x = X + u with finite kinematics. For example,
    ``SignedDistance(lambda x: ufl.sqrt(x[0] ** 2 + x[1] ** 2) - 1)`` is a disc of radius 1.

    Args:
        distance: Function of the position x, a UFL vector, that returns the signed distance d from
            the obstacle (UFL scalar, length), positive outside. Its gradient must have length 1
            near the contact.
        displacement: Rigid translation, as for `Obstacle`.
        rotation: Rotation, as for `Obstacle`.

    Raises:
        TypeError: ``distance`` is not callable.
    """

    distance: Callable[[Any], Any]
    displacement: Any = None
    rotation: Rotation | None = None

    def __post_init__(self) -> None:
        """Check that the distance is a function."""
        if not callable(self.distance):
            raise TypeError(
                f"distance of the SignedDistance is {self.distance!r}; it must be a function of x, "
                "such as lambda x: x[1]"
            )

    def place(self, x: Any, to_ufl: ToUFL) -> Placement:
        """Return the signed distance at x and minus its gradient.

        Raises:
            ValueError: The function fails, does not return a UFL scalar, or does not depend on x.
        """
        name = "distance of the SignedDistance"
        position = ufl.variable(x)
        try:
            gap = ufl.as_ufl(self.distance(position))
        except Exception as error:
            raise ValueError(
                f"{name} fails at a position x of {x.ufl_shape[0]} components: "
                f"{type(error).__name__}: {error}; it must be a function of x that returns a UFL "
                "scalar, such as lambda x: x[1]"
            ) from error
        _check_scalar(name, gap)
        gradient = ufl.diff(gap, position)
        if isinstance(gradient, ufl.constantvalue.Zero):
            raise ValueError(
                f"{name} is {gap}, which does not depend on x, so that there is no normal; use the "
                "argument of the function, as in lambda x: x[1]"
            )
        return Placement(gap, -gradient)


@dataclass(frozen=True)
class PrescribedGap(Obstacle):
    """A rigid obstacle given by the initial gap and the contact normal on the undeformed Γc.

    Finite kinematics evaluate the gap at the deformed positions: they need a `SignedDistance`.

    Args:
        gap: Initial gap s along ``normal`` (length), negative where the body penetrates: a number,
            constant, function or UFL expression over Γc, without the motion of the obstacle.
        normal: Direction from the body to the obstacle, of any length greater than zero, (gdim,).
        displacement: Rigid translation, as for `Obstacle`; its component along ``normal`` is added
            to the gap.
        rotation: Rotation, as for `Obstacle`.
    """

    gap: Any
    normal: Any
    displacement: Any = None
    rotation: Rotation | None = None

    def place(self, x: Any, to_ufl: ToUFL) -> Placement:
        """Return the prescribed gap and the direction."""
        direction = nonzero_vector("normal of the PrescribedGap", self.normal, x.ufl_shape[0])
        direction = to_ufl(direction)
        gap = to_ufl(self.gap)
        _check_scalar("gap of the PrescribedGap", gap)
        return Placement(gap, direction)


def _check_scalar(name: str, value: Any) -> None:
    if value.ufl_shape != ():
        raise ValueError(f"{name} has shape {value.ufl_shape}; it must be a scalar")
