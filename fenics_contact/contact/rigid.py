"""What lies opposite Γc where it is a rigid obstacle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from fenics_contact.contact.contact_kinematics import ContactKinematics, ContactParts
from fenics_contact.contact.deformed import DeformedPlaces, VaryingMotion
from fenics_contact.contact.finite import (
    ExactView,
    FiniteKinematics,
    Frame,
    SampledView,
    carried_history,
    check_places,
    check_rigid,
    depends_on_place,
    is_known_everywhere,
)
from fenics_contact.contact.inputs import varies
from fenics_contact.contact.obstacle_sampler import ObstacleSampler
from fenics_contact.contact.point_law import PointLaw, PointTangent
from fenics_contact.contact.sampled import SampledPlaces
from fenics_contact.contact.values import PointValues
from fenics_contact.obstacles.base import Placement, SampledObstacle
from fenics_contact.surface.surface import PointEvaluator
from fenics_contact.types import Array

__all__ = ["RigidFinite", "RigidSmall"]


class RigidSmall(ContactKinematics):
    """A rigid obstacle, geometry from the undeformed Γc.

    Raises:
        ValueError: Data of a `SampledObstacle` do not fit.
    """

    def __init__(self, parts: ContactParts) -> None:
        x, jump = ufl.SpatialCoordinate(parts.quadrature.surface.mesh), parts.new_jump()
        shift = parts.inputs.shift
        frame = moved = Frame(shift, None)
        self._varying: VaryingMotion | None = None
        if varies(shift):
            self._varying = VaryingMotion(parts.quadrature)
            moved = Frame(self._varying.moved, None)
        at_rest, self._moved = _sampled_places(parts, jump, frame, moved)
        if at_rest is None:
            placement = _placed(parts, x, frame)
        else:
            placement = at_rest.at(frame.into(x))
        super().__init__(parts, parts.new_pairs(), jump, placement, at_rest)
        if self._varying is not None and at_rest is None:
            placement = _placed(parts, x, moved)
        self._deformed = DeformedPlaces(parts.quadrature, jump, placement)
        self.sampler = _sampler(parts)
        # Of a distance with data on the mesh, which can be sampled on Γc alone.
        self._gradient_error: PointEvaluator | None = None
        if self.sampler is None and parts.gap is None and _depends_on_place(parts):
            here = ufl.variable(frame.into(x))
            placement = _in_frame(parts, here)
            error = ufl.diff(placement.gap, here) + placement.normal
            self._gradient_error = PointEvaluator(parts.quadrature, {"error": error})

    @property
    def is_flat(self) -> bool:
        """See `ContactKinematics`."""
        return self._parts.obstacle.is_flat and self._varying is None

    def gradient_error(self, values: PointValues) -> Array:
        """See `ContactKinematics`."""
        if self.sampler is not None:
            place = values.x + values.jump - self.pairs.own_displacement()
            return self.sampler.gradient_error(place)
        if self._gradient_error is None:
            return super().gradient_error(values)
        return np.asarray(np.linalg.norm(self._gradient_error()["error"], axis=1))

    def true_placement(self, values: PointValues) -> tuple[Array, Array]:
        """See `ContactKinematics`."""
        self.update()
        if self._varying is not None:
            data = self.data.values
            jump = self.present_jump()
            self._varying.update(data["x"], data["obstacle"], data["normal"], jump)
        if self._moved is not None:
            self._moved.update()
            found = self._moved.values("distance"), self._moved.values("normal")
        else:
            found = self._deformed()
        return found if self._varying is None else self._varying.turn(*found)


class RigidFinite(ContactKinematics):
    """A rigid obstacle that may move and turn by any amount, geometry from where Γc is now.

    Raises:
        ValueError: Its place is not known everywhere, or it is not rigid.
    """

    is_finite = True

    def __init__(self, parts: ContactParts) -> None:
        inputs, quadrature = parts.inputs, parts.quadrature
        mesh = quadrature.surface.mesh
        frame, jump = Frame(inputs.shift, inputs.rotation), parts.new_jump()
        at_rest, self._moved = _sampled_places(parts, jump, frame, frame)
        check_rigid(parts.name, inputs.shift, inputs.rotation)

        def place(z: Any) -> Placement:
            return _in_frame(parts, z)

        x = ufl.SpatialCoordinate(mesh)
        if at_rest is None:
            check_places(parts.name, place, mesh)
        here = (place if at_rest is None else at_rest.at)(frame.into(x))
        placement = Placement(here.gap, frame.turned(here.direction))
        super().__init__(parts, parts.new_pairs(), jump, placement, at_rest)
        carried: dict[str, Any] = {}
        if parts.law.has_friction:
            carried = carried_history(x, frame, parts.history, parts.multipliers)
        exact = ExactView(x, frame, place if self._moved is None else self._moved.at, carried)
        self._view = SampledView(exact, quadrature, jump, parts.history)
        self.in_form = FiniteKinematics(exact, parts.multipliers)
        self.at_points = FiniteKinematics(self._view, parts.multipliers)
        self.sampler = _sampler(parts)

    def update(self) -> None:
        """See `ContactKinematics`."""
        super().update()
        if self._moved is not None:
            self._moved.update()
        self._view.update()

    def outputs(self, arrays: Mapping[str, Array]) -> dict[str, Array]:
        """See `ContactKinematics`."""
        view, normal, jump = self._view, self._view.values("normal"), self._view.values("relative")
        told = {"normal": normal, "jump": jump}
        if not self._parts.law.has_friction:
            return told
        told |= self._framed(arrays, normal)
        way = view.turned(view.values("gap")[:, None] * normal, back=True)
        return told | {
            "projection_point": jump + way,
            "carried_traction": view.values("committed traction"),
        }

    def tangent(self, law: PointLaw) -> PointTangent:
        """See `ContactKinematics`."""
        tangent = super().tangent(law)
        rotation = self._parts.obstacle.rotation
        if self._parts.inputs.free_angle is None or rotation is None:
            return tangent
        return replace(tangent, spun=rotation.rate(law.evaluate_traction()))

    def true_placement(self, values: PointValues) -> tuple[Array, Array]:
        """See `ContactKinematics`."""
        self.update()
        return self._view.values("gap"), self._view.values("normal")

    def turned(self, vectors: Array, *, back: bool = False) -> Array:
        """See `ContactKinematics`: of the frame of the obstacle."""
        return self._view.turned(vectors, back=back)

    def gradient_error(self, values: PointValues) -> Array:
        """See `ContactKinematics`."""
        if self._moved is not None and self.sampler is not None:
            return self.sampler.gradient_error(self._moved.values("place"))
        error = self._view.values("slope") + self._view.values("normal")
        return np.asarray(np.linalg.norm(error, axis=1))

    def largest_curvature(self) -> Array:
        """See `ContactKinematics`."""
        turns = [self._view.values(f"turn {i}") for i in range(self._gdim)]
        by_place = -np.stack(turns, axis=1)
        curvature = (by_place + by_place.swapaxes(1, 2)) / 2
        largest = np.full(len(curvature), np.inf)
        known = np.isfinite(curvature).all(axis=(1, 2))
        largest[known] = np.linalg.eigvalsh(curvature[known]).max(axis=1, initial=0.0)
        return largest

    def projection_points(self, values: PointValues) -> dict[str, Array]:
        """See `ContactKinematics`."""
        return {"jump": values.projection_point, "normal": values.framed_normal}

    def start(self) -> dict[str, Array]:
        """See `ContactKinematics`: the projection_point, minus X, and the normal there."""
        self.update_data()
        assert self.sampler is not None
        gap, normal = self.sampler.sample(self.data.values["x"] + self.committed_jump)
        return {"jump": self.committed_jump + gap[:, None] * normal, "normal": normal}


def _in_frame(parts: ContactParts, z: Any) -> Placement:
    """Where a rigid obstacle is, geometry from a place in its frame (UFL)."""
    return parts.obstacle.placed(z, lambda v: parts.inputs.to_ufl("obstacle", v))


def _placed(parts: ContactParts, x: Any, frame: Frame) -> Placement:
    """Where a displaced rigid obstacle is, geometry from x (UFL)."""
    placement = _in_frame(parts, frame.into(x))
    if frame.shift is None or _depends_on_place(parts):
        return placement
    # What is given on Γc is given for the obstacle at rest.
    return replace(placement, gap=placement.gap + ufl.dot(frame.shift, placement.normal))


def _depends_on_place(parts: ContactParts) -> bool:
    """Whether the gap is a function of the place; else it is one on Γc."""
    return depends_on_place(lambda z: _in_frame(parts, z), parts.quadrature.surface.mesh)


def _sampler(parts: ContactParts) -> ObstacleSampler | None:
    """What evaluates the obstacle anywhere; None where gap or normal are given on Γc alone."""
    obstacle = parts.obstacle
    if isinstance(obstacle, SampledObstacle):
        return ObstacleSampler(parts.quadrature, obstacle)
    mesh = parts.quadrature.surface.mesh
    if parts.gap is not None or not is_known_everywhere(lambda z: _in_frame(parts, z), mesh):
        return None
    return ObstacleSampler(parts.quadrature, lambda z: _in_frame(parts, z))


def _sampled_places(
    parts: ContactParts, jump: fem.Function, frame: Frame, moved: Frame
) -> tuple[SampledPlaces | None, SampledPlaces | None]:
    """An obstacle known in numbers, from X and from X + u in its frames; else none. Collective.

    Raises:
        ValueError: Its data are of another dimension, or not the same on every rank.
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
    places = (frame.into(x), moved.into(x + jump))
    rest, deformed = (SampledPlaces(parts.quadrature, obstacle, place) for place in places)
    return rest, deformed
