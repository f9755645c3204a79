"""Kinematics of contact between Γc and a rigid obstacle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from fenics_contact.contact.contact_kinematics import ContactKinematics, ContactParts
from fenics_contact.contact.deformed import DeformedPlacement, VaryingMotion
from fenics_contact.contact.finite import (
    ExactGeometry,
    FiniteKinematics,
    Frame,
    SampledGeometry,
    check_known_everywhere,
    check_rigid,
    convected_history,
    depends_on_position,
    is_known_everywhere,
)
from fenics_contact.contact.inputs import is_varying
from fenics_contact.contact.obstacle_sampler import ObstacleSampler
from fenics_contact.contact.point_law import PointLaw, PointTangent
from fenics_contact.contact.sampled import SampledPlacement
from fenics_contact.contact.values import PointValues
from fenics_contact.obstacles.base import Placement, SampledObstacle
from fenics_contact.surface.surface import PointEvaluator
from fenics_contact.types import Array

__all__ = ["RigidFinite", "RigidSmall"]


class RigidSmall(ContactKinematics):
    """Small displacements relative to a rigid obstacle: gap and normal of the undeformed Γc.

    Raises:
        ValueError: Data of a `SampledObstacle` do not fit.
    """

    def __init__(self, parts: ContactParts) -> None:
        x, jump = ufl.SpatialCoordinate(parts.quadrature.surface.mesh), parts.new_jump()
        shift = parts.inputs.shift
        frame = displaced_frame = Frame(shift, None)
        self._varying: VaryingMotion | None = None
        if is_varying(shift):
            self._varying = VaryingMotion(parts.quadrature)
            displaced_frame = Frame(self._varying.displacement, None)
        undeformed, self._deformed = _sample_placements(parts, jump, frame, displaced_frame)
        if undeformed is None:
            placement = _displaced_placement(parts, x, frame)
        else:
            placement = undeformed.at(frame.into(x))
        super().__init__(parts, parts.new_pairs(), jump, placement, undeformed)
        if self._varying is not None and undeformed is None:
            placement = _displaced_placement(parts, x, displaced_frame)
        self._deformed_placement = DeformedPlacement(parts.quadrature, jump, placement)
        self.sampler = _sampler(parts)
        # For a distance with data on the mesh, which can be sampled on Γc only.
        self._gradient_error: PointEvaluator | None = None
        if self.sampler is None and parts.gap is None and _depends_on_position(parts):
            position = ufl.variable(frame.into(x))
            placement = _in_frame(parts, position)
            error = ufl.diff(placement.gap, position) + placement.normal
            self._gradient_error = PointEvaluator(parts.quadrature, {"error": error})

    @property
    def is_flat(self) -> bool:
        """Whether s - u_n is the true gap for any displacement, and the normal constant."""
        return self._parts.obstacle.is_flat and self._varying is None

    def gradient_error(self, values: PointValues) -> Array:
        """Return the gradient of the gap at X plus the unit normal, its norm. Collective."""
        if self.sampler is not None:
            position = values.x + values.jump - self.pairs.own_displacement()
            return self.sampler.gradient_error(position)
        if self._gradient_error is None:
            return super().gradient_error(values)
        return np.asarray(np.linalg.norm(self._gradient_error()["error"], axis=1))

    def true_placement(self, values: PointValues) -> tuple[Array, Array]:
        """Return gap and normal at the deformed position X + u. Collective."""
        self.update()
        if self._varying is not None:
            data = self.data.values
            jump = self.present_jump()
            self._varying.update(data["x"], data["obstacle"], data["normal"], jump)
        if self._deformed is not None:
            self._deformed.update()
            placement = self._deformed.values("distance"), self._deformed.values("normal")
        else:
            placement = self._deformed_placement()
        return placement if self._varying is None else self._varying.rotate(*placement)


class RigidFinite(ContactKinematics):
    """Finite displacements relative to a rigid obstacle that may move and rotate by any amount.

    Raises:
        ValueError: The obstacle is not known at every position, or it is not rigid.
    """

    is_finite = True

    def __init__(self, parts: ContactParts) -> None:
        inputs, quadrature = parts.inputs, parts.quadrature
        mesh = quadrature.surface.mesh
        frame, jump = Frame(inputs.shift, inputs.rotation), parts.new_jump()
        undeformed, self._deformed = _sample_placements(parts, jump, frame, frame)
        check_rigid(parts.name, inputs.shift, inputs.rotation)

        def placement_at(z: Any) -> Placement:
            return _in_frame(parts, z)

        x = ufl.SpatialCoordinate(mesh)
        if undeformed is None:
            check_known_everywhere(parts.name, placement_at, mesh)
        placement = (placement_at if undeformed is None else undeformed.at)(frame.into(x))
        placement = Placement(placement.gap, frame.rotate(placement.direction))
        super().__init__(parts, parts.new_pairs(), jump, placement, undeformed)
        convected: dict[str, Any] = {}
        if parts.law.has_friction:
            convected = convected_history(x, frame, parts.history, parts.multipliers)
        at_deformed = placement_at if self._deformed is None else self._deformed.at
        exact = ExactGeometry(x, frame, at_deformed, convected)
        self._geometry = SampledGeometry(exact, quadrature, jump, parts.history)
        self.in_form = FiniteKinematics(exact, parts.multipliers)
        self.at_points = FiniteKinematics(self._geometry, parts.multipliers)
        self.sampler = _sampler(parts)

    def update(self) -> None:
        """Update data, jump and samples to the present data and ``u``. Collective."""
        super().update()
        if self._deformed is not None:
            self._deformed.update()
        self._geometry.update()

    def outputs(self, arrays: Mapping[str, Array]) -> dict[str, Array]:
        """Return the fields of `ContactKinematics.outputs`, in the frame of the obstacle."""
        geometry = self._geometry
        normal, jump = geometry.values("normal"), geometry.values("relative")
        outputs = {"normal": normal, "jump": jump}
        if not self._parts.law.has_friction:
            return outputs
        outputs |= self._to_history_frame(arrays, normal)
        gap_vector = geometry.rotate(geometry.values("gap")[:, None] * normal, inverse=True)
        return outputs | {
            "projection_point": jump + gap_vector,
            "carried_traction": geometry.values("committed traction"),
        }

    def tangent(self, law: PointLaw) -> PointTangent:
        """Return the derivatives of a law's tractions at the present state. Collective."""
        tangent = super().tangent(law)
        rotation = self._parts.obstacle.rotation
        if self._parts.inputs.free_angle is None or rotation is None:
            return tangent
        return replace(tangent, by_rotation=rotation.rate(law.evaluate_traction()))

    def true_placement(self, values: PointValues) -> tuple[Array, Array]:
        """Return gap and normal at X + u, those of the contact itself. Collective."""
        self.update()
        return self._geometry.values("gap"), self._geometry.values("normal")

    def rotate(self, vectors: Array, *, inverse: bool = False) -> Array:
        """Return vectors rotated from the frame of the obstacle to space, or back."""
        return self._geometry.rotate(vectors, inverse=inverse)

    def gradient_error(self, values: PointValues) -> Array:
        """Return the gradient of the gap at X + u plus the unit normal, its norm. Collective."""
        if self._deformed is not None and self.sampler is not None:
            return self.sampler.gradient_error(self._deformed.values("position"))
        error = self._geometry.values("slope") + self._geometry.values("normal")
        return np.asarray(np.linalg.norm(error, axis=1))

    def largest_curvature(self) -> Array:
        """Return the largest principal curvature at X + u, (n_points,) (1/length)."""
        rows = [self._geometry.values(f"normal gradient {i}") for i in range(self._gdim)]
        gradient = -np.stack(rows, axis=1)
        curvature = (gradient + gradient.swapaxes(1, 2)) / 2
        largest = np.full(len(curvature), np.inf)
        finite = np.isfinite(curvature).all(axis=(1, 2))
        largest[finite] = np.linalg.eigvalsh(curvature[finite]).max(axis=1, initial=0.0)
        return largest

    def slip_reference(self, values: PointValues) -> dict[str, Array]:
        """Return the fields of the history at an evaluated state: projection point and normal."""
        return {"jump": values.projection_point, "normal": values.framed_normal}

    def reference_fields(self) -> dict[str, Array]:
        """Return projection point, minus X, and normal at the committed jump. Collective."""
        self.update_data()
        assert self.sampler is not None
        gap, normal = self.sampler.sample(self.data.values["x"] + self.committed_jump)
        return {"jump": self.committed_jump + gap[:, None] * normal, "normal": normal}


def _in_frame(parts: ContactParts, z: Any) -> Placement:
    """Return gap and direction of a rigid obstacle at a position in its frame (UFL)."""
    return parts.obstacle.placed(z, lambda v: parts.inputs.to_ufl("obstacle", v))


def _displaced_placement(parts: ContactParts, x: Any, frame: Frame) -> Placement:
    """Return gap and direction of a displaced rigid obstacle at the position x (UFL)."""
    placement = _in_frame(parts, frame.into(x))
    if frame.shift is None or _depends_on_position(parts):
        return placement
    # A gap that is given on Γc is that of the obstacle in its initial position.
    return replace(placement, gap=placement.gap + ufl.dot(frame.shift, placement.normal))


def _depends_on_position(parts: ContactParts) -> bool:
    """Whether the gap is a function of the position, rather than a field on Γc."""
    return depends_on_position(lambda z: _in_frame(parts, z), parts.quadrature.surface.mesh)


def _sampler(parts: ContactParts) -> ObstacleSampler | None:
    """Return a sampler of the obstacle; None if gap or normal are given on Γc only."""
    obstacle = parts.obstacle
    if isinstance(obstacle, SampledObstacle):
        return ObstacleSampler(parts.quadrature, obstacle)
    mesh = parts.quadrature.surface.mesh
    if parts.gap is not None or not is_known_everywhere(lambda z: _in_frame(parts, z), mesh):
        return None
    return ObstacleSampler(parts.quadrature, lambda z: _in_frame(parts, z))


def _sample_placements(
    parts: ContactParts, jump: fem.Function, frame: Frame, displaced_frame: Frame
) -> tuple[SampledPlacement | None, SampledPlacement | None]:
    """Return samples of a `SampledObstacle` at X and at X + u, otherwise None. Collective.

    Raises a ValueError if its data have another dimension, or differ between ranks.
    """
    obstacle, mesh = parts.obstacle, parts.quadrature.surface.mesh
    if not isinstance(obstacle, SampledObstacle):
        return None, None
    kind = type(obstacle).__name__
    d = mesh.geometry.dim
    if obstacle.gdim != d:
        raise ValueError(
            f"{parts.name}: the {kind} is given in {obstacle.gdim} dimensions, but the mesh has "
            f"{d}; its points must have {d} coordinates"
        )
    if len(set(mesh.comm.allgather(obstacle.fingerprint))) > 1:
        raise ValueError(
            f"{parts.name}: the data of the {kind} differ between ranks; they must be the same "
            "(read the file on all ranks, or broadcast its arrays)"
        )
    x = ufl.SpatialCoordinate(mesh)
    positions = (frame.into(x), displaced_frame.into(x + jump))
    undeformed, deformed = (SampledPlacement(parts.quadrature, obstacle, p) for p in positions)
    return undeformed, deformed
