"""Finite kinematics at the points of Γc on a rigid obstacle that may move and rotate, eq. (2).

Gap and normal are evaluated at X + u. Integrals are over the undeformed Γc, so that tractions are
nominal, and the map from dofs to the points is that of small displacements.

The history is kept in the frame of the obstacle: a point at rest on a rotating roller does not
slip. Slip is the tangential path of the projection point x + g n on the obstacle; the committed
traction rotates with the obstacle, and then from the old normal to the new one by the smallest
rotation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from ufl.algorithms.analysis import extract_constants, extract_type

from fenics_contact.contact.point_geometry import PointGeometry, tangential
from fenics_contact.laws.base import Law, PointKinematics
from fenics_contact.obstacles.base import Placement
from fenics_contact.surface.fields import PointFields
from fenics_contact.surface.surface import PointEvaluator, SurfaceQuadrature
from fenics_contact.tolerances import ROUND_OFF
from fenics_contact.types import Array

__all__ = [
    "ExactGeometry",
    "FiniteKinematics",
    "Frame",
    "SampledGeometry",
    "check_known_everywhere",
    "check_rigid",
    "convected_history",
    "depends_on_position",
    "is_known_everywhere",
]


@dataclass(frozen=True)
class Frame:
    """The frame of a rigid obstacle, a coordinate system that moves with it (UFL).

    Attributes:
        shift: Displacement of the obstacle; None if it has none.
        rotation: Rotation matrix and a point of the axis; None without rotation.
    """

    shift: Any
    rotation: tuple[Any, Any] | None

    def into(self, x: Any) -> Any:
        """Return the coordinates of a position in the frame."""
        z = x if self.shift is None else x - self.shift
        if self.rotation is None:
            return z
        matrix, about = self.rotation
        return ufl.dot(ufl.transpose(matrix), z - about) + about

    def to_space(self, z: Any) -> Any:
        """Return the position of coordinates in the frame."""
        if self.rotation is not None:
            matrix, about = self.rotation
            z = ufl.dot(matrix, z - about) + about
        return z if self.shift is None else z + self.shift

    def relative(self, x: Any, jump: Any) -> Any:
        """Return the displacement in the frame of a point displaced from x."""
        if self.rotation is None:  # without the round-off of x - x
            return jump if self.shift is None else jump - self.shift
        return self.into(x + jump) - x

    def rotate(self, vector: Any) -> Any:
        """Return a direction in space, given in the frame."""
        return vector if self.rotation is None else ufl.dot(self.rotation[0], vector)

    def rotate_back(self, vector: Any) -> Any:
        """Return a direction in the frame, given in space."""
        if self.rotation is None:
            return vector
        return ufl.dot(ufl.transpose(self.rotation[0]), vector)


@dataclass(frozen=True)
class DeformedGeometry:
    """Gap (length), normal and `convected_history` of an obstacle at a deformed position (UFL)."""

    gap: Any
    normal: Any
    convected: Mapping[str, Any]


@dataclass(frozen=True)
class ExactGeometry:
    """Gap and normal at deformed positions by the obstacle's own UFL expressions.

    Attributes:
        x: Coordinates of the undeformed Γc.
        frame: Frame of the obstacle.
        placement_at: Returns gap and direction at coordinates in the frame.
        convected: The `convected_history`; empty without friction.
    """

    x: Any
    frame: Frame
    placement_at: Callable[[Any], Placement]
    convected: Mapping[str, Any]

    def __call__(self, jump: Any) -> DeformedGeometry:
        """Return gap and normal at X + u."""
        placement = self.placement_at(self.frame.into(self.x + jump))
        return DeformedGeometry(placement.gap, self.frame.rotate(placement.normal), self.convected)


def convected_history(
    x: Any, frame: Frame, history: PointFields, multipliers: PointFields | None
) -> dict[str, Any]:
    """Return the committed fields of friction, convected with the obstacle since the commit (UFL).

    They are "projection_point", minus X (length), "traction" (stress) and "normal".
    """
    projection_point, traction_source = history.ufl("jump"), multipliers or history
    if frame.rotation is not None:
        projection_point = frame.to_space(x + projection_point) - x
    elif frame.shift is not None:
        projection_point = projection_point + frame.shift
    return {"projection_point": projection_point} | {
        name: frame.rotate(traction_source.ufl(name)) for name in ("traction", "normal")
    }


class SampledGeometry:
    """Linearisation of an `ExactGeometry` about the displacement sampled by `update`.

    Laws are compiled for values at the points, and serve every obstacle. Gap and normal are linear
    in the displacement, so that the first derivatives of tractions are exact, including the
    curvature of the obstacle. The constructor is collective.
    """

    def __init__(
        self,
        exact: ExactGeometry,
        quadrature: SurfaceQuadrature,
        jump: fem.Function,
        history: PointFields,
    ) -> None:
        d, frame = quadrature.surface.mesh.geometry.dim, exact.frame
        displaced = ufl.variable(jump)
        geometry = exact(displaced)
        normal_gradient, identity = ufl.diff(geometry.normal, displaced), ufl.Identity(d)
        expressions = {
            "gap": geometry.gap,
            "slope": ufl.diff(geometry.gap, displaced),
            "normal": geometry.normal,
        }
        expressions |= {f"normal gradient {i}": normal_gradient[i, :] for i in range(d)}
        expressions |= {"relative": frame.relative(exact.x, displaced)}
        if frame.rotation is not None:
            expressions |= {f"axis {i}": frame.rotate_back(identity[:, i]) for i in range(d)}
        expressions |= {f"convected {name}": value for name, value in geometry.convected.items()}
        if geometry.convected:
            traction, normal = (frame.rotate(history.ufl(n)) for n in ("traction", "normal"))
            traction = _rotate_with_normal(traction, normal, geometry.normal)
            expressions["committed traction"] = traction
        self._jump, self._d, self._convected = jump, d, list(geometry.convected)
        self._rotates = frame.rotation is not None
        self._evaluate = PointEvaluator(quadrature, expressions)
        sizes = {name: e.ufl_shape[0] if e.ufl_shape else 0 for name, e in expressions.items()}
        self._fields = PointFields(quadrature, sizes | {"at": d})

    def update(self) -> None:
        """Sample at the present displacement of the points. Collective."""
        samples = self._evaluate()
        jumps = self._jump.x.array.reshape(-1, self._d)
        self._fields.assign(samples | {"at": jumps[: len(samples["gap"])]})

    def values(self, name: str) -> Array:
        """Return a copy of samples: "gap", "slope" (of the gap), "normal" and others."""
        return self._fields.values(name)

    def rotate(self, vectors: Array, *, inverse: bool = False) -> Array:
        """Return vectors rotated from the obstacle's frame to space, or back, (n_points, d)."""
        if not self._rotates:
            return vectors
        axes = np.stack([self.values(f"axis {i}") for i in range(self._d)], axis=1)
        return np.asarray(np.einsum("qij,qi->qj" if inverse else "qij,qj->qi", axes, vectors))

    def __call__(self, jump: Any) -> DeformedGeometry:
        """Return gap and normal at X + u, linearised about the sampled displacement."""
        field, change = self._fields.ufl, jump - self._fields.ufl("at")
        gap = field("gap") + ufl.dot(field("slope"), change)
        normal_change = [ufl.dot(field(f"normal gradient {i}"), change) for i in range(self._d)]
        convected = {name: field(f"convected {name}") for name in self._convected}
        return DeformedGeometry(gap, field("normal") + ufl.as_vector(normal_change), convected)


@dataclass(frozen=True)
class FiniteKinematics:
    """`LocalKinematics` of finite displacements relative to a rigid obstacle.

    ``deformed`` returns gap and normal at a jump; multipliers replace the committed tractions.
    """

    deformed: Callable[[Any], DeformedGeometry]
    multipliers: PointFields | None

    def __call__(self, jump: Any, law: Law, geometry: PointGeometry) -> PointKinematics:
        """Return the local kinematics at a displacement of the body (UFL)."""
        deformed = self.deformed(jump)
        gap, n = deformed.gap, deformed.normal
        total = increment = traction = multiplier = None
        if self.multipliers is not None:
            multiplier = self.multipliers.ufl("pressure")
        if law.has_friction:
            convected = deformed.convected
            total = tangential(geometry.relative(jump), n)
            slip = jump + gap * n - convected["projection_point"]
            increment = tangential(slip, n)
            traction = _rotate_with_normal(convected["traction"], convected["normal"], n)
        return PointKinematics(gap, n, total, increment, traction, multiplier)


def _rotate_with_normal(vector: Any, committed_normal: Any, normal: Any) -> Any:
    """Return a vector rotated by the smallest rotation between unit normals, made tangential."""
    cosine = ufl.dot(committed_normal, normal)
    if len(normal) == 2:
        sine = committed_normal[0] * normal[1] - committed_normal[1] * normal[0]
        return tangential(cosine * vector + sine * ufl.perp(vector), normal)
    axis = ufl.cross(committed_normal, normal)
    along_axis = ufl.dot(axis, vector) / ufl.max_value(1 + cosine, ROUND_OFF)
    return tangential(cosine * vector + ufl.cross(axis, vector) + along_axis * axis, normal)


def check_rigid(name: str, shift: Any, rotation: tuple[Any, Any] | None) -> None:
    """Check that displacement and rotation are uniform; raise a ValueError if not."""
    varying_terms = (ufl.SpatialCoordinate, ufl.Coefficient)
    if rotation is not None and any(extract_type(ufl.as_ufl(e), varying_terms) for e in rotation):
        raise ValueError(
            f"{name}: the Rotation varies over Γc or depends on u, but the obstacle is rigid: give "
            "numbers or constants"
        )
    if shift is not None and extract_type(shift, varying_terms):
        raise ValueError(
            f"{name}: the displacement of the obstacle varies over Γc, but finite kinematics need "
            "a rigid obstacle: give numbers or constants, and rotate it by a Rotation"
        )


def check_known_everywhere(name: str, placement_at: Callable[[Any], Placement], mesh: Any) -> None:
    """Check that an obstacle is known at every position; raise a ValueError if not."""
    if not is_known_everywhere(placement_at, mesh):
        raise ValueError(
            f"{name}: the obstacle is given on the undeformed Γc, but finite kinematics need it at "
            "every point: give a SignedDistance(lambda x: ...) that uses no coordinates but its "
            "argument, or another rigid obstacle by numbers and constants"
        )


def is_known_everywhere(placement_at: Callable[[Any], Placement], mesh: Any) -> bool:
    """Whether gap and normal are functions of the position only (UFL)."""
    placement = placement_at(fem.Constant(mesh, np.zeros(mesh.geometry.dim)))
    parts = placement.gap, placement.direction
    varying = [extract_type(e, (ufl.SpatialCoordinate, ufl.Coefficient)) for e in parts]
    return not any(varying) and depends_on_position(placement_at, mesh)


def depends_on_position(placement_at: Callable[[Any], Placement], mesh: Any) -> bool:
    """Whether the gap is a function of the position, rather than a field on Γc."""
    anywhere = fem.Constant(mesh, np.zeros(mesh.geometry.dim))
    return anywhere in extract_constants(placement_at(anywhere).gap)
