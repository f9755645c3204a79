"""Verification of a rigid obstacle: gradient of its distance, penetration and rotation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fenics_contact.checks.condition import Condition
from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import Status
from fenics_contact.parallel import global_max
from fenics_contact.tolerances import NEGLIGIBLE

__all__ = ["MAX_ROTATION", "ObstacleCheck"]


# Largest difference between the gradient of a distance and minus its unit normal.
_MAX_GRADIENT_ERROR = 0.05
# Penetration relative to the distance from the centre of curvature: 1 is half of the radius.
_MAX_CURVATURE_DEPTH_RATIO = 1.0
# Largest rotation of an obstacle in one increment, and over which displacements are linear in time
# (radians): a right angle and round-off. Beyond two right angles the straight path of a point leads
# backwards.
MAX_ROTATION = np.pi / 2 + NEGLIGIBLE


@dataclass(frozen=True)
class ObstacleCheck:
    """Verification of a contact with a rigid obstacle, the same on every rank.

    Attributes:
        obstacle: The class of the obstacle.
        gradient_error: Largest difference between the gradient of the gap and minus the normal, at
            closed points; NaN if gap or gradient is NaN; 0 for a gap prescribed on Γc.
        depth: With finite kinematics, the largest penetration divided by the distance from there to
            the centre of curvature of the obstacle.
        rotation: Rotation of the obstacle in this increment, with friction (radians).
    """

    obstacle: str
    gradient_error: float
    depth: float
    rotation: float = 0.0

    @classmethod
    def of(cls, contact: Contact) -> ObstacleCheck:
        """Evaluate the obstacle of a contact at its evaluated state. Collective."""
        comm, closed = contact.surface.mesh.comm, contact.status != Status.OPEN
        errors, depth = contact.contact_kinematics.gradient_error(contact.values), 0.0
        if contact.contact_kinematics.is_finite:
            # A NaN gap, or one without a normal, is not closed by any law.
            gap, _ = contact.contact_kinematics.true_placement(contact.values)
            errors = np.where(np.isnan(gap), np.nan, errors)
            closed |= ~(gap > 0) & np.isnan(errors)
        error = global_max(comm, errors[closed])
        curvature = contact.contact_kinematics.largest_curvature()
        if curvature is not None and not contact.obstacle.is_flat:
            depth = global_max(comm, (contact.values.penetration * curvature)[closed])
        has_friction = contact.law.has_friction and comm.allreduce(int(closed.any())) > 0
        angle = 0.0
        if has_friction:
            turn = contact.contact_kinematics.rotation_in_increment(contact.values)
            angle = abs(turn.angle)
        return cls(type(contact.obstacle).__name__, error, depth, angle)

    def conditions(self, contact: str) -> list[Condition]:
        """Return the conditions on a contact of this name."""
        distance = (
            f"in the contact zone the gradient of the gap of the {self.obstacle} differs by "
            f"{self.gradient_error:.3g} from minus its unit normal; it must be a distance, with a "
            "gradient of length 1, and its direction minus the gradient: divide the function by "
            "the length of its gradient, or prescribe a gap along another direction by "
            "PrescribedGap"
        )
        if np.isnan(self.gradient_error):
            distance = (
                "the distance of the obstacle, or its gradient, is not a number at a point of Γc; "
                "check its expression"
            )
        deep = (
            "the penetration exceeds half of the radius of curvature of the obstacle, so that the "
            "closest point may be on its other side; increase k_n, or use "
            'enforcement="augmented"'
        )
        rotation = (
            f"the obstacle rotates by {self.rotation:.3g} rad in one increment, over which slip "
            "is a straight line; rotate it by no more than a right angle per increment"
        )
        return [
            Condition(f"{name}, {contact}", value, limit, f"{contact}: {failure}")
            for name, value, limit, failure in (
                ("gradient of the gap", self.gradient_error, _MAX_GRADIENT_ERROR, distance),
                ("depth by radius of curvature", self.depth, _MAX_CURVATURE_DEPTH_RATIO, deep),
                ("rotation of the obstacle", self.rotation, MAX_ROTATION, rotation),
            )
        ]
