"""What points of Γc feel of displacements of any size, on a rigid obstacle that may turn.

Gap and normal are those at X + u, where the obstacle is now. Integrals are over the undeformed Γc:
tractions are nominal, forces per undeformed area. The map from unknowns to the points stays
that of small displacements; all that is nonlinear happens at the points.

The history is kept in the frame of the obstacle, which moves and turns with it: a point that rests
on a turning roller does not slip. Slip is the way of the foot, the point of the obstacle that is
closest, x + g n; the committed traction turns with the obstacle, and then from the old normal to
the new one by the smallest rotation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from ufl.algorithms.analysis import extract_constants, extract_type

from fenics_contact.contact.kinematics import Seen, combined, tangential
from fenics_contact.laws.base import ContactTraction, Law, PointKinematics
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

    def turned(self, vector: Any) -> Any:
        """A direction given in the frame."""
        return vector if self.rotation is None else ufl.dot(self.rotation[0], vector)

    def turned_back(self, vector: Any) -> Any:
        """A direction as it is in the frame."""
        if self.rotation is None:
            return vector
        return ufl.dot(ufl.transpose(self.rotation[0]), vector)


class ExactView:
    """How an obstacle is seen from points that have moved: by its own expressions."""

    def __init__(
        self,
        x: Any,
        frame: Frame,
        place: Callable[[Any], Placement],
        history: PointFields,
        multipliers: PointFields | None,
    ) -> None:
        """Take them.

        Args:
            x: Coordinates of the undeformed Γc.
            frame: Of the obstacle.
            place: Gap and direction at coordinates in the frame.
            history: The committed state, vectors in the frame.
            multipliers: Likewise.
        """
        self._x, self._frame, self._place = x, frame, place
        self._history, self._multipliers = history, multipliers

    def gap(self, jump: Any) -> Any:
        """Distance to the obstacle at X + u (UFL, length)."""
        return self._place(self._frame.into(self._x + jump)).gap

    def normal(self, jump: Any) -> Any:
        """Unit normal from body to obstacle there (UFL)."""
        return self._frame.turned(self._place(self._frame.into(self._x + jump)).normal)

    def relative(self, jump: Any) -> Any:
        """Displacement in the frame of the obstacle (UFL, length)."""
        if self._frame.rotation is None:  # not X less X
            return jump if self._frame.shift is None else jump - self._frame.shift
        return self._frame.into(self._x + jump) - self._x

    def framed(self, vector: Any) -> Any:
        """A direction as it is in that frame (UFL)."""
        return self._frame.turned_back(vector)

    def carried(self, name: str) -> Any:
        """What was committed, as the obstacle has carried it along (UFL).

        Args:
            name: "foot", its place minus X (length); "traction" and "normal", of the multipliers
                where there are any; "committed traction" and "committed normal".
        """
        if name == "foot":
            foot = self._history.ufl("jump")
            if self._frame.rotation is None:
                return foot if self._frame.shift is None else foot + self._frame.shift
            return self._frame.place(self._x + foot) - self._x
        kept = self._history
        if self._multipliers is not None and not name.startswith("committed "):
            kept = self._multipliers
        return self._frame.turned(kept.ufl(name.removeprefix("committed ")))


class SampledView:
    """The same by numbers at the points, and derivatives there: exact at `update`'s displacement.

    Laws are compiled for numbers at points, and serve every obstacle. Gap and normal are linear
    about the displacement that they were sampled at, so that the first derivatives of tractions
    are exact, too, curvature of the obstacle included.
    """

    def __init__(
        self,
        exact: ExactView,
        quadrature: SurfaceQuadrature,
        jump: fem.Function,
        *,
        turns: bool,
        friction: bool,
    ) -> None:
        """Compile. Collective.

        Args:
            exact: What to sample.
            quadrature: The points.
            jump: Displacement of the body there.
            turns: Whether the obstacle turns.
            friction: Whether there is any.
        """
        d = quadrature.surface.mesh.geometry.dim
        self._jump, self._turns = jump, turns
        moved = ufl.variable(jump)
        gap, normal = exact.gap(moved), exact.normal(moved)
        by_place = ufl.diff(normal, moved)
        expressions = {"gap": gap, "slope": ufl.diff(gap, moved), "normal": normal}
        expressions |= {f"turn {i}": by_place[i, :] for i in range(d)}
        expressions |= {"relative": exact.relative(moved)}
        if turns:
            unit = ufl.Identity(d)
            expressions |= {f"axis {i}": exact.framed(unit[:, i]) for i in range(d)}
        if friction:
            names = ("foot", "traction", "normal", "committed traction", "committed normal")
            expressions |= {f"carried {n}": exact.carried(n) for n in names}
        self._evaluate = PointEvaluator(quadrature, expressions)
        sizes = {name: e.ufl_shape[0] if e.ufl_shape else 0 for name, e in expressions.items()}
        self._fields = PointFields(quadrature, sizes | {"at": d})
        self._d = d

    def update(self) -> None:
        """Sample at the present displacement of the points. Collective."""
        found = self._evaluate()
        rows = self._jump.x.array.reshape(-1, self._d)
        self._fields.assign(found | {"at": rows[: len(found["gap"])]})

    def values(self, name: str) -> Array:
        """What was sampled by a name: "gap", "slope" (of the gap), "normal" …; a copy."""
        return self._fields.values(name)

    def turned(self, vectors: Array) -> Array:
        """Directions in the frame of the obstacle, as they are in space: (n_points, gdim)."""
        if not self._turns:
            return vectors
        axes = np.stack([self.values(f"axis {i}") for i in range(self._d)], axis=1)
        return np.asarray(np.einsum("qij,qj->qi", axes, vectors))

    def gap(self, jump: Any) -> Any:
        """See `ExactView.gap`."""
        field = self._fields.ufl
        return field("gap") + ufl.dot(field("slope"), jump - field("at"))

    def normal(self, jump: Any) -> Any:
        """See `ExactView.normal`."""
        field, change = self._fields.ufl, jump - self._fields.ufl("at")
        turn = [ufl.dot(field(f"turn {i}"), change) for i in range(self._d)]
        return field("normal") + ufl.as_vector(turn)

    def relative(self, jump: Any) -> Any:
        """See `ExactView.relative`."""
        return self._fields.ufl("relative") + self.framed(jump - self._fields.ufl("at"))

    def framed(self, vector: Any) -> Any:
        """See `ExactView.framed`."""
        if not self._turns:
            return vector
        return combined(vector, [self._fields.ufl(f"axis {i}") for i in range(self._d)])

    def carried(self, name: str) -> Any:
        """See `ExactView.carried`."""
        return self._fields.ufl(f"carried {name}")


class FiniteKinematics:
    """Displacements of any size relative to a rigid obstacle; see the module.

    As in small displacements a law sees s - u_n as the gap: u_n is what the gap s that Γc had at
    first, from where the obstacle is now, has lost.
    """

    def __init__(self, view: ExactView | SampledView, multipliers: PointFields | None) -> None:
        """Take how the obstacle is seen.

        Args:
            view: That.
            multipliers: λ_n and λ_t, which take the place of committed tractions.
        """
        self._view, self._multipliers = view, multipliers

    def felt(self, jump: Any, law: Law, seen: Seen) -> PointKinematics:
        """What a law sees of a displacement of the body (UFL)."""
        view = self._view
        gap, normal = view.gap(jump), view.normal(jump)
        total = increment = traction = multiplier = None
        if self._multipliers is not None:
            multiplier = self._multipliers.ufl("pressure")
        if law.has_friction:
            foot = jump + gap * normal
            total = tangential(seen.relative(jump), normal)
            increment = tangential(foot - view.carried("foot"), normal)
            traction = _turned(view.carried("traction"), view.carried("normal"), normal)
        return PointKinematics(gap, normal, total, increment, traction, multiplier)

    def told(
        self, jump: Any, law: Law, seen: Seen, felt: PointKinematics, response: ContactTraction
    ) -> dict[str, Any]:
        """What of it is told beside what laws see (UFL), by its name in `PointValues`."""
        view, normal = self._view, felt.normal
        told = {"normal": normal, "jump": view.relative(jump)}
        if law.has_friction:
            old = view.carried("committed traction"), view.carried("committed normal")
            told |= {
                "foot": view.relative(jump) + view.framed(felt.gap * normal),
                "framed_normal": view.framed(normal),
                "framed_traction": view.framed(response.traction),
                "carried_traction": _turned(*old, normal),
            }
        return told

    def framed(self, vector: Any) -> Any:
        """A direction as the history has it (UFL)."""
        return self._view.framed(vector)


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
