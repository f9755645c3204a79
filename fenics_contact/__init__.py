"""Frictional contact for FEniCSx: contact laws, boundary forms, and a solver with verification."""

import fenics_contact.compat  # noqa: F401  # first: it refuses releases that are too old
from fenics_contact import elasticity
from fenics_contact._version import __version__
from fenics_contact.checks.verdict import ForceBalance, Verdict
from fenics_contact.contact.accuracy import Accuracy
from fenics_contact.contact.contact import Contact
from fenics_contact.contact.general_contact import find_contact_pairs
from fenics_contact.contact.values import Resultants, Status, ZoneExtent
from fenics_contact.estimates.adaptation import AdaptationLevel, adapt
from fenics_contact.estimates.errors import ErrorBudget, estimate_errors
from fenics_contact.failure import NotConverged
from fenics_contact.histories import checkpoint
from fenics_contact.histories.increments import increments
from fenics_contact.histories.report import report
from fenics_contact.joining import JoinedMesh, join_meshes
from fenics_contact.laws.base import ContactTraction, Law, PointKinematics
from fenics_contact.laws.compliance import NormalCompliance
from fenics_contact.laws.friction import Coulomb, FrictionLaw, Tresca
from fenics_contact.laws.stiffness import NodalSprings, RelativeStiffness
from fenics_contact.laws.unilateral import Foundation, Frictionless
from fenics_contact.meshes import mesh_from_arrays, model_to_mesh
from fenics_contact.obstacles.base import (
    Motion,
    Obstacle,
    Placement,
    Rotation,
    Sample,
    SampledObstacle,
)
from fenics_contact.obstacles.deformable import DeformableBody
from fenics_contact.obstacles.meshed import RigidSurface
from fenics_contact.obstacles.profile import RigidProfile
from fenics_contact.obstacles.rigid import (
    Ball,
    Cylinder,
    HalfSpace,
    PrescribedGap,
    RoundedCone,
    SignedDistance,
)
from fenics_contact.problem import ContactProblem
from fenics_contact.results import output, plotting
from fenics_contact.results.animation import Animation
from fenics_contact.results.writer import Writer
from fenics_contact.step import Step
from fenics_contact.surface.surface import ContactSurface
from fenics_contact.systems.operator import ContactOperator

__all__ = [
    "Accuracy",
    "AdaptationLevel",
    "Animation",
    "Ball",
    "Contact",
    "ContactOperator",
    "ContactProblem",
    "ContactSurface",
    "ContactTraction",
    "Coulomb",
    "Cylinder",
    "DeformableBody",
    "ErrorBudget",
    "ForceBalance",
    "Foundation",
    "FrictionLaw",
    "Frictionless",
    "HalfSpace",
    "JoinedMesh",
    "Law",
    "Motion",
    "NodalSprings",
    "NormalCompliance",
    "NotConverged",
    "Obstacle",
    "Placement",
    "PointKinematics",
    "PrescribedGap",
    "RelativeStiffness",
    "Resultants",
    "RigidProfile",
    "RigidSurface",
    "Rotation",
    "RoundedCone",
    "Sample",
    "SampledObstacle",
    "SignedDistance",
    "Status",
    "Step",
    "Tresca",
    "Verdict",
    "Writer",
    "ZoneExtent",
    "__version__",
    "adapt",
    "checkpoint",
    "elasticity",
    "estimate_errors",
    "find_contact_pairs",
    "increments",
    "join_meshes",
    "mesh_from_arrays",
    "model_to_mesh",
    "output",
    "plotting",
    "report",
]
