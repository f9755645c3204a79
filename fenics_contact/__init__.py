"""Frictional contact for FEniCSx: contact as a boundary form, an answer that is checked."""

import fenics_contact.compat  # noqa: F401  # first: it refuses releases that are too old
from fenics_contact import elasticity
from fenics_contact._version import __version__
from fenics_contact.accuracy import Accuracy
from fenics_contact.adaptation import Level, adapt
from fenics_contact.contact import Contact, Resultants, Status
from fenics_contact.errors import ErrorBudget, estimate_errors
from fenics_contact.laws import (
    Coulomb,
    Foundation,
    FrictionLaw,
    Frictionless,
    Kinematics,
    Law,
    Response,
    Scaled,
    Springs,
    Tresca,
)
from fenics_contact.operators import ContactOperator
from fenics_contact.pairing import DeformableBody
from fenics_contact.problem import ContactProblem, Step
from fenics_contact.stepping import increments
from fenics_contact.supports import Ball, Cylinder, HalfSpace, Motion, Obstacle
from fenics_contact.surface import ContactSurface
from fenics_contact.verdict import NotConverged, Verdict

__all__ = [
    "Accuracy",
    "Ball",
    "Contact",
    "ContactOperator",
    "ContactProblem",
    "ContactSurface",
    "Coulomb",
    "Cylinder",
    "DeformableBody",
    "ErrorBudget",
    "Foundation",
    "FrictionLaw",
    "Frictionless",
    "HalfSpace",
    "Kinematics",
    "Law",
    "Level",
    "Motion",
    "NotConverged",
    "Obstacle",
    "Response",
    "Resultants",
    "Scaled",
    "Springs",
    "Status",
    "Step",
    "Tresca",
    "Verdict",
    "__version__",
    "adapt",
    "elasticity",
    "estimate_errors",
    "increments",
]
