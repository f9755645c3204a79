"""Frictional contact for FEniCSx: contact as a boundary form, an answer that is checked."""

import fenics_contact.compat  # noqa: F401  # first: it refuses releases that are too old
from fenics_contact import elasticity
from fenics_contact._version import __version__
from fenics_contact.checks.step import Step
from fenics_contact.checks.verdict import Balance, NotConverged, Verdict
from fenics_contact.contact.accuracy import Accuracy
from fenics_contact.contact.contact import Contact
from fenics_contact.contact.general import contact_pairs
from fenics_contact.contact.values import Extent, Resultants, Status
from fenics_contact.estimates.adaptation import Level, adapt
from fenics_contact.estimates.errors import ErrorBudget, estimate_errors
from fenics_contact.histories import checkpoint
from fenics_contact.histories.increments import increments
from fenics_contact.histories.report import report
from fenics_contact.joining import Joined, join_meshes
from fenics_contact.laws.base import Kinematics, Law, Response
from fenics_contact.laws.friction import Coulomb, FrictionLaw, Tresca
from fenics_contact.laws.stiffness import Scaled, Springs
from fenics_contact.laws.unilateral import Foundation, Frictionless
from fenics_contact.meshes import model_to_mesh
from fenics_contact.problem import ContactProblem
from fenics_contact.results import output, plotting
from fenics_contact.results.animation import Animation
from fenics_contact.results.writer import Writer
from fenics_contact.supports.base import (
    Motion,
    Placement,
    Rotation,
    Sample,
    SampledSupport,
    Support,
)
from fenics_contact.supports.deformable import DeformableBody
from fenics_contact.supports.meshed import RigidSurface
from fenics_contact.supports.profile import RigidProfile
from fenics_contact.supports.rigid import Ball, Cylinder, HalfSpace, Obstacle
from fenics_contact.surface.surface import ContactSurface
from fenics_contact.systems.operator import ContactOperator

__all__ = [
    "Accuracy",
    "Animation",
    "Balance",
    "Ball",
    "Contact",
    "ContactOperator",
    "ContactProblem",
    "ContactSurface",
    "Coulomb",
    "Cylinder",
    "DeformableBody",
    "ErrorBudget",
    "Extent",
    "Foundation",
    "FrictionLaw",
    "Frictionless",
    "HalfSpace",
    "Joined",
    "Kinematics",
    "Law",
    "Level",
    "Motion",
    "NotConverged",
    "Obstacle",
    "Placement",
    "Response",
    "Resultants",
    "RigidProfile",
    "RigidSurface",
    "Rotation",
    "Sample",
    "SampledSupport",
    "Scaled",
    "Springs",
    "Status",
    "Step",
    "Support",
    "Tresca",
    "Verdict",
    "Writer",
    "__version__",
    "adapt",
    "checkpoint",
    "contact_pairs",
    "elasticity",
    "estimate_errors",
    "increments",
    "join_meshes",
    "model_to_mesh",
    "output",
    "plotting",
    "report",
]
