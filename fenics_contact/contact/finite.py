"""What points of Γc feel of displacements of any size, on a rigid obstacle that may turn.

Gap and normal are those at X + u, where the obstacle is now. Integrals are over the undeformed Γc:
tractions are nominal, forces per undeformed area. The map from unknowns to the points stays
that of small displacements; all that is nonlinear happens at the points.

The history is kept in the frame of the obstacle, which moves and turns with it: a point that rests
on a turning roller does not slip. Slip is the tangential path of the projection
point x + g n, the closest point of the obstacle; the committed traction rotates with the obstacle,
and then from the old normal to the new one by the smallest rotation.
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
    "ExactView",
    "FiniteKinematics",
    "Frame",
    "SampledView",
    "carried_history",
    "check_places",
    "check_rigid",
    "depends_on_place",
    "is_known_everywhere",
]


@dataclass(frozen=True)
class Frame:
    """Where a rigid obstacle has moved to: coordinates that move with it (UFL).

    Attributes:
        shift: Its displacement; None: none.
        rotation: Matrix of its turn, and a point of the axis; None: it does not turn.
    """

    shift: Any
    rotation: tuple[Any, Any] | None

    def into(self, x: Any) -> Any:
        """Coordinates in the frame, of a place."""
        z = x if self.shift is None else x - self.shift
        if self.rotation is None:
            return z
        matrix, about = self.rotation
        return ufl.dot(ufl.transpose(matrix), z - about) + about

    def place(self, z: Any) -> Any:
        """The place of coordinates in the frame."""
        if self.rotation is not None:
            matrix, about = self.rotation
            z = ufl.dot(matrix, z - about) + about
        return z if self.shift is None else z + self.shift

    def relative(self, x: Any, jump: Any) -> Any:
        """Displacement in the frame, of a point displaced from x."""
        if self.rotation is None:  # not x less x
            return jump if self.shift is None else jump - self.shift
        return self.into(x + jump) - x

    def turned(self, vector: Any) -> Any:
        """A direction given in the frame."""
        return vector if self.rotation is None else ufl.dot(self.rotation[0], vector)

    def turned_back(self, vector: Any) -> Any:
        """A direction as it is in the frame."""
        if self.rotation is None:
            return vector
        return ufl.dot(ufl.transpose(self.rotation[0]), vector)


@dataclass(frozen=True)
class View:
    """What a point that has moved sees of a rigid obstacle (UFL).

    Attributes:
        gap: Distance to the obstacle at X + u (length).
        normal: Unit normal from body to obstacle there.
        carried: What was committed, as the obstacle has carried it along, see `carried_history`;
            empty without friction.
    """

    gap: Any
    normal: Any
    carried: Mapping[str, Any]


@dataclass(frozen=True)
class ExactView:
    """How an obstacle is geometry from points that have moved: by its own expressions.

    Attributes:
        x: Coordinates of the undeformed Γc.
        frame: The frame of the obstacle.
        place: Gap and direction at coordinates in the frame.
        carried: What was committed, see `View`.
    """

    x: Any
    frame: Frame
    place: Callable[[Any], Placement]
    carried: Mapping[str, Any]

    def __call__(self, jump: Any) -> View:
        """What is geometry from X + u."""
        placement = self.place(self.frame.into(self.x + jump))
        return View(placement.gap, self.frame.turned(placement.normal), self.carried)


def carried_history(
    x: Any, frame: Frame, history: PointFields, multipliers: PointFields | None
) -> dict[str, Any]:
    """What was committed with friction, as the obstacle has carried it along since (UFL).

    Returns:
        "projection_point", its place minus X (length); "traction" (stress) and
        "normal", of the multipliers where there are any.
    """
    projection_point, kept = history.ufl("jump"), multipliers or history
    if frame.rotation is not None:
        projection_point = frame.place(x + projection_point) - x
    elif frame.shift is not None:
        projection_point = projection_point + frame.shift
    return {"projection_point": projection_point} | {
        name: frame.turned(kept.ufl(name)) for name in ("traction", "normal")
    }


class SampledView:
    """The same by numbers at the points, and derivatives there: exact at `update`'s displacement.

    Laws are compiled for numbers at points, and serve every obstacle. Gap and normal are linear
    about the displacement that they were sampled at, so that the first derivatives of tractions
    are exact, too, curvature of the obstacle included. The constructor is collective.

    Args:
        jump: Displacement of the body there.
        history: The committed state, vectors in the frame of the obstacle.
    """

    def __init__(
        self,
        exact: ExactView,
        quadrature: SurfaceQuadrature,
        jump: fem.Function,
        history: PointFields,
    ) -> None:
        d, frame = quadrature.surface.mesh.geometry.dim, exact.frame
        moved = ufl.variable(jump)
        geometry = exact(moved)
        by_place, unit = ufl.diff(geometry.normal, moved), ufl.Identity(d)
        expressions = {
            "gap": geometry.gap,
            "slope": ufl.diff(geometry.gap, moved),
            "normal": geometry.normal,
        }
        expressions |= {f"turn {i}": by_place[i, :] for i in range(d)}
        expressions |= {"relative": frame.relative(exact.x, moved)}
        if frame.rotation is not None:
            expressions |= {f"axis {i}": frame.turned_back(unit[:, i]) for i in range(d)}
        expressions |= {f"carried {name}": value for name, value in geometry.carried.items()}
        if geometry.carried:
            old, before = (frame.turned(history.ufl(n)) for n in ("traction", "normal"))
            expressions["committed traction"] = _turned(old, before, geometry.normal)
        self._jump, self._d, self._carried = jump, d, list(geometry.carried)
        self._turns = frame.rotation is not None
        self._evaluate = PointEvaluator(quadrature, expressions)
        sizes = {name: e.ufl_shape[0] if e.ufl_shape else 0 for name, e in expressions.items()}
        self._fields = PointFields(quadrature, sizes | {"at": d})

    def update(self) -> None:
        """Sample at the present displacement of the points. Collective."""
        found = self._evaluate()
        rows = self._jump.x.array.reshape(-1, self._d)
        self._fields.assign(found | {"at": rows[: len(found["gap"])]})

    def values(self, name: str) -> Array:
        """What was sampled by a name: "gap", "slope" (of the gap), "normal" …; a copy."""
        return self._fields.values(name)

    def turned(self, vectors: Array, *, back: bool = False) -> Array:
        """Directions in the frame of the obstacle as they are in space, or back, (n_points, d)."""
        if not self._turns:
            return vectors
        axes = np.stack([self.values(f"axis {i}") for i in range(self._d)], axis=1)
        return np.asarray(np.einsum("qij,qi->qj" if back else "qij,qj->qi", axes, vectors))

    def __call__(self, jump: Any) -> View:
        """What is geometry from X + u, near the displacement that was sampled."""
        field, change = self._fields.ufl, jump - self._fields.ufl("at")
        gap = field("gap") + ufl.dot(field("slope"), change)
        turn = [ufl.dot(field(f"turn {i}"), change) for i in range(self._d)]
        carried = {name: field(f"carried {name}") for name in self._carried}
        return View(gap, field("normal") + ufl.as_vector(turn), carried)


@dataclass(frozen=True)
class FiniteKinematics:
    """Displacements of any size relative to a rigid obstacle; see the module.

    Attributes:
        view: How the obstacle is geometry from displaced points.
        multipliers: λ_n and λ_t, which take the place of committed tractions.
    """

    view: Callable[[Any], View]
    multipliers: PointFields | None

    def __call__(self, jump: Any, law: Law, geometry: PointGeometry) -> PointKinematics:
        """What a law sees of a displacement of the body (UFL)."""
        view = self.view(jump)
        total = increment = traction = multiplier = None
        if self.multipliers is not None:
            multiplier = self.multipliers.ufl("pressure")
        if law.has_friction:
            carried, projection_point = view.carried, jump + view.gap * view.normal
            total = tangential(geometry.relative(jump), view.normal)
            increment = tangential(projection_point - carried["projection_point"], view.normal)
            traction = _turned(carried["traction"], carried["normal"], view.normal)
        return PointKinematics(view.gap, view.normal, total, increment, traction, multiplier)


def _turned(vector: Any, before: Any, normal: Any) -> Any:
    """A vector turned with a unit normal by the smallest rotation; what is left along it goes."""
    cosine = ufl.dot(before, normal)
    if len(normal) == 2:
        sine = before[0] * normal[1] - before[1] * normal[0]
        return tangential(cosine * vector + sine * ufl.perp(vector), normal)
    axis = ufl.cross(before, normal)
    share = ufl.dot(axis, vector) / ufl.max_value(1 + cosine, ROUND_OFF)
    return tangential(cosine * vector + ufl.cross(axis, vector) + share * axis, normal)


def check_rigid(name: str, shift: Any, rotation: tuple[Any, Any] | None) -> None:
    """Refuse an obstacle that is displaced or turned by other amounts at other points.

    Raises:
        ValueError: It says what to give.
    """
    varies = (ufl.SpatialCoordinate, ufl.Coefficient)
    if rotation is not None and any(extract_type(ufl.as_ufl(e), varies) for e in rotation):
        raise ValueError(
            f"{name}: the Rotation varies over Γc or depends on u, but the obstacle is rigid: give "
            "numbers or constants"
        )
    if shift is not None and extract_type(shift, varies):
        raise ValueError(
            f"{name}: the displacement of the obstacle varies over Γc, but finite kinematics need "
            "a rigid obstacle: give numbers or constants, and rotate it by a Rotation"
        )


def check_places(name: str, place: Callable[[Any], Placement], mesh: Any) -> None:
    """Refuse an obstacle that says where it is on the undeformed Γc alone.

    Raises:
        ValueError: It says what to give.
    """
    if not is_known_everywhere(place, mesh):
        raise ValueError(
            f"{name}: the obstacle is given on the undeformed Γc, but finite kinematics need it at "
            "every point: give a SignedDistance(lambda x: ...) that uses no coordinates but its "
            "argument, or another rigid obstacle by numbers and constants"
        )


def is_known_everywhere(place: Callable[[Any], Placement], mesh: Any) -> bool:
    """Whether gap and normal follow from the place alone, wherever it is (UFL)."""
    placement = place(fem.Constant(mesh, np.zeros(mesh.geometry.dim)))
    parts = placement.gap, placement.direction
    fixed = [extract_type(e, (ufl.SpatialCoordinate, ufl.Coefficient)) for e in parts]
    return not any(fixed) and depends_on_place(place, mesh)


def depends_on_place(place: Callable[[Any], Placement], mesh: Any) -> bool:
    """Whether the gap follows from the place at all: a gap that is given on Γc does not."""
    anywhere = fem.Constant(mesh, np.zeros(mesh.geometry.dim))
    return anywhere in extract_constants(place(anywhere).gap)
