"""Verification of a rigid obstacle: distance gradient, depth and rotation per increment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import Status
from fenics_contact.parallel import global_max, global_min

__all__ = ["ObstacleCheck"]


# By how much the gradient of a distance may differ from 1 where contact is.
_SLOPE = 0.05
# Penetration by the radius of curvature that is left there: 1 is half of that of the obstacle.
_DEEP = 1.0
# Of the angle that an obstacle turns by in an increment (radians): a right one and round-off.
# Beyond two of them the straight way of a point leads backwards.
_TURN = np.pi / 2 + 1e-9


@dataclass(frozen=True)
class ObstacleCheck:
    """Verification of a contact with a rigid obstacle, the same on every rank.

    Attributes:
        slope: Length of the gradient of the distance at closed points, where it is farthest from 1;
            NaN if gap or gradient are no numbers.
        depth: With finite kinematics, the largest penetration divided by the distance from there to
            the centre of curvature of the obstacle.
        turn: Rotation of the obstacle in this increment, with friction (radians).
    """

    slope: float
    depth: float
    turn: float = 0.0

    @classmethod
    def of(cls, contact: Contact) -> ObstacleCheck:
        """Evaluate the obstacle of a contact at its evaluated state. Collective."""
        comm, closed = contact.surface.mesh.comm, contact.status != Status.OPEN
        slopes = contact.opposite.slope(contact.values)
        if contact.finite:
            # No law takes a gap for closed that is not a number, or has no normal.
            gap, _ = contact.opposite.true_placement(contact.values)
            slopes = np.where(np.isnan(gap), np.nan, slopes)
            closed |= ~(gap > 0) & np.isnan(slopes)
        slopes = slopes[closed]
        ends = global_min(comm, slopes, empty=1.0), global_max(comm, slopes, empty=1.0)
        slope = max(ends, key=lambda value: abs(value - 1.0))
        depth = 0.0
        curvature = contact.opposite.largest_curvature()
        if curvature is not None and not contact.obstacle.is_flat:
            depth = global_max(comm, (contact.values.penetration * curvature)[closed])
        rubs = contact.law.has_friction and comm.allreduce(int(closed.any())) > 0
        turn = abs(contact.opposite.turned_by(contact.values)) if rubs else 0.0
        return cls(slope, depth, turn)

    def failures(self, contact: str) -> list[str]:
        """Return the conditions that are violated, in words."""
        found = []
        if np.isnan(self.slope):
            found.append(
                f"{contact}: the distance of the obstacle, or its gradient, is not a number at a "
                "point of Γc; check its expression"
            )
        elif not abs(self.slope - 1.0) <= _SLOPE:
            found.append(
                f"{contact}: the gradient of the SignedDistance has length {self.slope:.3g} in the "
                "contact zone; it must be 1: divide the function by the length of its gradient"
            )
        if not self.depth <= _DEEP:
            found.append(
                f"{contact}: the penetration exceeds half of the radius of curvature of the "
                "obstacle, so that the closest point may be on its other side; increase k_n, or "
                'use enforcement="augmented"'
            )
        if not self.turn <= _TURN:
            found.append(
                f"{contact}: the obstacle rotates by {self.turn:.3g} rad in one increment, over "
                "which slip is a straight line; rotate it by no more than a right angle per "
                "increment"
            )
        return found
