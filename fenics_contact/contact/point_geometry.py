"""Small-displacement kinematics at the points of Γc, eq. (1): normal and gap are undeformed.

The map from dofs to the jump at the points is constant, so that a linear bulk remains linear.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import ufl

from fenics_contact.laws.base import Law, PointKinematics
from fenics_contact.surface.fields import PointFields

__all__ = ["LocalKinematics", "PointGeometry", "SmallKinematics", "tangential"]


@dataclass(frozen=True)
class PointGeometry:
    """Geometry and parameters of a law at the points, independent of displacements (UFL).

    Attributes:
        gap: Initial gap, including the motion of the obstacle (length).
        normal: Unit normal from the body to the obstacle.
        shift: Displacement of the obstacle; None if it has none.
        parameters: Parameters of the law, by name.
    """

    gap: Any
    normal: Any
    shift: Any
    parameters: Mapping[str, Any]

    def relative(self, jump: Any) -> Any:
        """Return the displacement of the body relative to the obstacle (UFL)."""
        return jump if self.shift is None else jump - self.shift


# Local kinematics of a law at a jump (UFL).
LocalKinematics: TypeAlias = Callable[[Any, Law, PointGeometry], PointKinematics]


@dataclass(frozen=True)
class SmallKinematics:
    """`LocalKinematics` of small displacements; multipliers replace the committed tractions."""

    history: PointFields
    multipliers: PointFields | None

    def __call__(self, jump: Any, law: Law, geometry: PointGeometry) -> PointKinematics:
        """Return the local kinematics at a jump (UFL)."""
        normal = geometry.normal
        total = increment = traction = multiplier = None
        if self.multipliers is not None:
            multiplier = self.multipliers.ufl("pressure")
        if law.has_tangential:
            total = tangential(geometry.relative(jump), normal)
        if law.has_friction:
            # Old traction and jump are projected with the present normal, as obstacles may move.
            increment = tangential(geometry.relative(jump) - self.history.ufl("jump"), normal)
            traction = tangential((self.multipliers or self.history).ufl("traction"), normal)
        gap = geometry.gap - ufl.dot(jump, normal)
        return PointKinematics(gap, normal, total, increment, traction, multiplier)


def tangential(vector: Any, normal: Any) -> Any:
    """Return the part of a vector across a unit normal (UFL)."""
    return vector - ufl.dot(vector, normal) * normal
