"""What points of Γc feel of displacements: kinematics of small displacements.

Gap and normals are those of the undeformed body. The map from displacements to what a point feels
relative to its obstacle is constant (`ContactOperator`), and a linear bulk stays linear.
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
    """What a law sees of a point apart from displacements (UFL).

    Attributes:
        gap: Initial gap, the motion of the obstacle included (length).
        normal: Unit normal from body to obstacle.
        shift: Displacement of the obstacle; None: it has none.
        parameters: Of the law, by name.
    """

    gap: Any
    normal: Any
    shift: Any
    parameters: Mapping[str, Any]

    def relative(self, jump: Any) -> Any:
        """Displacement of the body relative to the obstacle (UFL)."""
        return jump if self.shift is None else jump - self.shift


# What a law sees of a displacement of the body relative to what lies opposite (all UFL).
LocalKinematics: TypeAlias = Callable[[Any, Law, PointGeometry], PointKinematics]


@dataclass(frozen=True)
class SmallKinematics:
    """Displacements that change neither the normals nor the place of the obstacle.

    Attributes:
        history: The committed state.
        multipliers: λ_n and λ_t, which take the place of committed tractions.
    """

    history: PointFields
    multipliers: PointFields | None

    def __call__(self, jump: Any, law: Law, geometry: PointGeometry) -> PointKinematics:
        """What a law sees of a displacement of the body, relative to what lies opposite (UFL)."""
        normal = geometry.normal
        total = increment = traction = multiplier = None
        if self.multipliers is not None:
            multiplier = self.multipliers.ufl("pressure")
        if law.has_tangential:
            total = tangential(geometry.relative(jump), normal)
        if law.has_friction:
            # The old traction and displacement are taken along the present normal: the obstacle
            # may have moved on since the last commit.
            increment = tangential(geometry.relative(jump) - self.history.ufl("jump"), normal)
            traction = tangential((self.multipliers or self.history).ufl("traction"), normal)
        gap = geometry.gap - ufl.dot(jump, normal)
        return PointKinematics(gap, normal, total, increment, traction, multiplier)


def tangential(vector: Any, normal: Any) -> Any:
    """The part of a vector across a unit normal (UFL)."""
    return vector - ufl.dot(vector, normal) * normal
