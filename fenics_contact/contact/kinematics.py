"""What points of Γc feel of displacements: kinematics of small displacements.

Gap and normals are those of the undeformed body. The map from displacements to what a point feels
relative to its obstacle is constant (`ContactOperator`), and a linear bulk stays linear.
`FiniteKinematics` has the same methods.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import ufl

from fenics_contact.laws.base import ContactTraction, Law, PointKinematics
from fenics_contact.surface.fields import PointFields

__all__ = ["Seen", "SmallKinematics", "combined", "tangential"]


@dataclass(frozen=True)
class Seen:
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


class SmallKinematics:
    """Displacements that change neither the normals nor the place of the obstacle."""

    def __init__(self, history: PointFields, multipliers: PointFields | None) -> None:
        """Take the state that increments start from.

        Args:
            history: The committed state.
            multipliers: λ_n and λ_t, which take the place of committed tractions.
        """
        self._history, self._multipliers = history, multipliers

    def felt(self, jump: Any, law: Law, seen: Seen) -> PointKinematics:
        """What a law sees of a displacement of the body, relative to what lies opposite (UFL)."""
        normal = seen.normal
        total = increment = traction = multiplier = None
        old_traction = self._history
        if self._multipliers is not None:
            old_traction = self._multipliers
            multiplier = old_traction.ufl("pressure")

        if law.has_tangential:
            total = tangential(seen.relative(jump), normal)
        if law.has_friction:
            # The old traction and displacement are taken along the present normal: the obstacle
            # may have moved on since the last commit.
            increment = tangential(seen.relative(jump) - self._history.ufl("jump"), normal)
            traction = tangential(old_traction.ufl("traction"), normal)
        gap = seen.gap - ufl.dot(jump, normal)
        return PointKinematics(gap, normal, total, increment, traction, multiplier)

    def told(
        self, jump: Any, law: Law, seen: Seen, felt: PointKinematics, response: ContactTraction
    ) -> dict[str, Any]:
        """What of it is told beside what laws see (UFL), by its name in `PointValues`."""
        return {"jump": seen.relative(jump)}

    def framed(self, vector: Any) -> Any:
        """A direction as the history has it (UFL): in space."""
        return vector


def combined(vector: Any, axes: Sequence[Any]) -> Any:
    """The sum of axes times the components of a vector (UFL)."""
    return sum((vector[i] * axes[i] for i in range(1, len(axes))), vector[0] * axes[0])


def tangential(vector: Any, normal: Any) -> Any:
    """The part of a vector across a unit normal (UFL)."""
    return vector - ufl.dot(vector, normal) * normal
