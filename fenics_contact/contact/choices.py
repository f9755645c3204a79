"""Selection of kinematics and enforcement from the arguments of a `Contact`."""

from __future__ import annotations

from typing import Any

from fenics_contact.arguments import is_number
from fenics_contact.contact.accuracy import Accuracy
from fenics_contact.contact.body import BodyFinite, BodySmall
from fenics_contact.contact.rigid import RigidFinite, RigidSmall
from fenics_contact.laws.base import Law
from fenics_contact.laws.stiffness import NodalSprings
from fenics_contact.obstacles.base import Obstacle
from fenics_contact.obstacles.deformable import DeformableBody

__all__ = ["is_regularised", "select_enforcement", "select_kinematics"]

_ENFORCEMENTS = ("penalty", "augmented")
KinematicsClass = type[RigidSmall] | type[BodySmall] | type[RigidFinite]
# The classes for a rigid obstacle and for an opposing body, by kinematics.
_KINEMATICS: dict[str, tuple[KinematicsClass, KinematicsClass]] = {
    "small": (RigidSmall, BodySmall),
    "finite": (RigidFinite, BodyFinite),
}
# Default tolerance of the augmented Lagrangian method.
_DEFAULT_TOLERANCE = 1e-5


def select_kinematics(
    name: str, kinematics: str, obstacle: Obstacle, law: Law, gap: Any
) -> KinematicsClass:
    """Return the `ContactKinematics` class for the arguments of a `Contact`.

    Raises:
        ValueError: ``kinematics`` is unknown, or an argument is not available with it.
    """
    if kinematics not in _KINEMATICS:
        raise ValueError(
            f"{name}: kinematics is {kinematics!r}; use one of {tuple(_KINEMATICS)} (a "
            "tolerance of small displacements is ContactProblem(small_displacement_tolerance=...))"
        )
    rigid, body = _KINEMATICS[kinematics]
    kinematics_type = body if isinstance(obstacle, DeformableBody) else rigid
    if not kinematics_type.is_finite:
        if obstacle.rotation is not None:
            raise ValueError(
                f'{name}: a Rotation of the obstacle needs Contact(kinematics="finite"); for '
                "rotations below 0.01 rad you may give the displacement as a UFL vector instead, "
                "with a relative error of the forces of about the angle"
            )
        return kinematics_type
    if gap is not None:
        raise ValueError(
            f"{name}: gap is given, but with finite kinematics it follows from the positions of "
            "body and obstacle; omit it, and move the obstacle by its displacement"
        )
    if law.has_tangential and not law.has_friction:
        raise ValueError(
            f"{name}: {type(law).__name__} bonds points to fixed points of the obstacle, which is "
            "not available with finite kinematics; use a law with friction, or omit k_t"
        )
    return kinematics_type


def is_regularised(law: Law) -> bool:
    """Whether the stiffness regularises rigid contact, and is not that of physical springs."""
    springs = (isinstance(v, NodalSprings) for v in law.parameters().values())
    return not law.is_physical and not any(springs)


def select_enforcement(
    name: str, enforcement: str | None, tolerance: float | None, law: Law, accuracy: Accuracy | None
) -> tuple[bool, float]:
    """Return whether there are multipliers, and the tolerance, for the arguments of a `Contact`.

    Raises:
        ValueError: An argument is invalid, or the law has a physical stiffness.
    """
    if enforcement is None:
        enforcement = accuracy.enforcement if accuracy and is_regularised(law) else "penalty"
    if tolerance is None:
        tolerance = accuracy.tolerance if accuracy else _DEFAULT_TOLERANCE
    if enforcement not in _ENFORCEMENTS:
        raise ValueError(f"{name}: enforcement is {enforcement!r}; use one of {_ENFORCEMENTS}")
    if not (is_number(tolerance) and 0.0 < tolerance < 1.0):
        raise ValueError(f"{name}: tolerance is {tolerance!r}; it must be a number between 0 and 1")
    if enforcement == "penalty":
        return False, tolerance
    if not is_regularised(law):
        springs = [n for n, v in law.parameters().items() if isinstance(v, NodalSprings)]
        term = f"{springs[0]} by NodalSprings" if springs else type(law).__name__
        raise ValueError(
            f"{name}: {term} has a physical stiffness, which the augmented Lagrangian method would "
            'eliminate; use enforcement="penalty", or a law and stiffness that regularise rigid '
            "contact"
        )
    return True, tolerance
