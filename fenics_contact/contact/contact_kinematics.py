"""Kinematics of contact: gap, normal and jump at the points of Γc, and their committed state.

|                     | rigid obstacle (`rigid`) | opposing body (`body`) |
|---------------------|--------------------------|------------------------|
| small displacements | `RigidSmall`             | `BodySmall`            |
| finite sliding      | `RigidFinite`            | `BodyFinite`           |
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from fenics_contact.contact.inputs import Inputs, check_data
from fenics_contact.contact.obstacle_sampler import ObstacleSampler
from fenics_contact.contact.pairs import Pairs, PairsState
from fenics_contact.contact.point_data import PointData
from fenics_contact.contact.point_geometry import LocalKinematics, PointGeometry, SmallKinematics
from fenics_contact.contact.point_law import PointLaw, PointTangent
from fenics_contact.contact.sampled import SampledPlacement
from fenics_contact.contact.values import PointValues
from fenics_contact.laws.base import Law, Parameters
from fenics_contact.obstacles.base import Obstacle, Placement, Rotation
from fenics_contact.parallel import global_max
from fenics_contact.surface.displacement import Displacement
from fenics_contact.surface.fields import PointFields
from fenics_contact.surface.surface import SurfaceQuadrature
from fenics_contact.types import Array, Mask

__all__ = [
    "ContactKinematics",
    "ContactParts",
    "IncrementalRotation",
    "KinematicsState",
    "ObstacleMotion",
]


@dataclass(frozen=True)
class ContactParts:
    """The parts of a `Contact`, as described there."""

    name: str
    displacement: Displacement
    quadrature: SurfaceQuadrature
    obstacle: Obstacle
    law: Law
    inputs: Inputs
    gap: Any
    history: PointFields
    multipliers: PointFields | None

    def new_pairs(self) -> Pairs:
        """Return pairs that do not follow the bodies. Collective."""
        return Pairs(self.name, self.displacement.u, self.quadrature, self.obstacle)

    def new_jump(self) -> fem.Function:
        """Return a function at the quadrature points for the jump."""
        gdim = self.quadrature.surface.mesh.geometry.dim
        return fem.Function(self.quadrature.space(gdim), name="jump")


@dataclass(frozen=True)
class KinematicsState:
    """The committed state of a `ContactKinematics`: its jump, angle, pairs and sampler's shape."""

    jump: Array
    angle: float
    pairs: PairsState
    shape: Array | None


@dataclass(frozen=True)
class IncrementalRotation:
    """Rotation of an obstacle in an increment, about an axis that does not move in it.

    Attributes:
        angle: Rotation angle of the increment (radians).
        about: A point of the axis, (gdim,) (length).
        rotation: Rotation of the obstacle; None if it does not rotate.
    """

    angle: float = 0.0
    about: Array | float = 0.0
    rotation: Rotation | None = None

    def rotate(self, positions: Array, fraction: Array | float) -> Array:
        """Return positions rotated by fractions of the angle, one or (n,): (n, gdim) (length)."""
        if self.rotation is None:
            return positions
        return self.about + self.rotation.rotate(positions - self.about, fraction * self.angle)

    def directions(self, vectors: Array) -> Array:
        """Return directions rotated by the angle, (..., gdim)."""
        if self.rotation is None:
            return vectors
        turned = self.rotation.rotate(vectors.reshape(-1, vectors.shape[-1]), self.angle)
        return turned.reshape(vectors.shape)

    def radius(self, positions: Array) -> Array:
        """Return the distance of positions from the axis, (n,) (length); 0 without rotation."""
        if self.rotation is None:
            return np.zeros(len(positions))
        return np.asarray(np.linalg.norm(self.rotation.rate(positions - self.about), axis=1))


@dataclass(frozen=True)
class ObstacleMotion:
    """Rigid-body motion of an obstacle that displaces the points of Γc together with it.

    The displaced points have the gap to the present obstacle that the points had before the motion.

    Attributes:
        offset: Displacement of the points at ``start``, (n_points, gdim) (length).
        turn: Rotation of the obstacle.
        start: Displacement of the body at the points, (n_points, gdim) (length).
    """

    offset: Array
    turn: IncrementalRotation = IncrementalRotation()
    start: Array | float = 0.0

    def of_points(self, jump: Array) -> Array:
        """Return the displacement of the points at a jump, (n_points, gdim) (length)."""
        relative = jump - self.start
        return np.asarray(self.offset + (self.turn.directions(relative) - relative))


class ContactKinematics(ABC):
    """Base class of the kinematics of a contact.

    Arguments ``values`` are the values of the last evaluation unless stated otherwise. Constructors
    are collective, and compile the expressions that are evaluated at the points.

    Args:
        placement: Gap and direction of the obstacle as functions of the undeformed position.
        undeformed_sample: Samples of a `SampledObstacle` at the undeformed positions.

    Attributes:
        pairs: The pairs of quadrature points and opposite points.
        data: User data, sampled at the points.
        jump: Displacement of the body minus that of an opposing body (not of a rigid obstacle).
        local_jump: Independent variables of the laws: the jump, or functions of it.
        given, sampled: Geometry and parameters as expressions on Γc, and as values at the points.
        in_form, at_points: `LocalKinematics` in the form on Γc, and for values at the points.
        committed_jump: The jump at the last commit, relative to the obstacle and between the
            present pairs, (n_points, gdim); zero before the first commit.
        committed_angle: Rotation angle of the obstacle at the last commit (radians).
        is_finite: Whether the kinematics are finite.
        is_rigid: Whether the obstacle is rigid, so that its reactions are external forces.
        pairs_follow_bodies: Whether pairs are updated with every change of the displacement.
        sampler: Evaluates a rigid obstacle at any position; None if it is known on Γc only, or with
            an opposing body.
    """

    is_finite = False
    is_rigid = True
    pairs_follow_bodies = False
    sampler: ObstacleSampler | None = None

    def __init__(
        self,
        parts: ContactParts,
        pairs: Pairs,
        jump: fem.Function,
        placement: Placement,
        undeformed_sample: SampledPlacement | None = None,
    ) -> None:
        self.pairs, self.jump = pairs, jump
        self._parts, self._undeformed_sample = parts, undeformed_sample
        self._mesh = parts.quadrature.surface.mesh
        self._gdim = self._mesh.geometry.dim
        self.given = self._make_geometry(placement)
        self.data, self.sampled = self._make_point_data(placement)
        self.local_jump = jump
        self.in_form: LocalKinematics = SmallKinematics(parts.history, parts.multipliers)
        self.at_points: LocalKinematics = self.in_form
        self.committed_jump: Array = np.zeros((parts.quadrature.n_points, self._gdim))
        self.committed_angle = 0.0
        self._displaced: ObstacleMotion | None = None

    # ---- construction ----------------------------------------------------------------------------

    def _make_geometry(self, placement: Placement) -> PointGeometry:
        """Return geometry and parameters of the law as expressions on Γc."""
        inputs, gap = self._parts.inputs, self._parts.gap
        initial_gap = placement.gap
        if gap is not None:
            initial_gap = inputs.scalar("gap", gap)
            if inputs.shift is not None:
                initial_gap = initial_gap + ufl.dot(inputs.shift, placement.normal)
        return PointGeometry(initial_gap, placement.normal, inputs.shift, inputs.law)

    def _make_point_data(self, placement: Placement) -> tuple[PointData, PointGeometry]:
        """Return all data sampled at the points, and geometry and parameters from these."""
        inputs, direction, given = self._parts.inputs, placement.direction, self.given
        expressions = {
            "x": ufl.SpatialCoordinate(self._mesh),
            "normal": given.normal,
            "direction_length": ufl.sqrt(ufl.dot(direction, direction)),
            "facing": ufl.dot(given.normal, ufl.FacetNormal(self._mesh)),
            "weight": inputs.weight,
            "initial_gap": given.gap,
            "shift": inputs.prescribed_shift(),
        } | {f"parameter {n}": v for n, v in given.parameters.items()}
        if inputs.rotation is not None:
            d, matrix = self._gdim, inputs.rotation[0]
            expressions["about"] = inputs.rotation[1]
            if d == 3:
                expressions["axis"] = inputs.axis
            if inputs.free_angle is None:
                rows = [matrix[i, j] for i in range(d) for j in range(d)]
                expressions |= {"angle": inputs.angle, "turn": ufl.as_vector(rows)}
        user_data = dict(given.parameters) | {"weight": inputs.weight}
        user_data |= {"displacement of the obstacle": expressions["shift"]}
        user_data |= {n: expressions[n] for n in ("angle", "about") if n in expressions}
        user_data |= {"gap": given.gap, "normal": direction}
        parts = self._parts
        check_data(parts.name, user_data, parts.quadrature, parts.displacement)
        geometry = ["initial_gap", "normal", *(f"parameter {n}" for n in given.parameters)]
        if given.shift is not None:
            expressions["obstacle"] = given.shift
            geometry.append("obstacle")
        data = PointData(parts.name, parts.quadrature, expressions, geometry)
        sampled = PointGeometry(
            data.ufl("initial_gap"),
            data.ufl("normal"),
            None if given.shift is None else data.ufl("obstacle"),
            Parameters(parts.law, {n: data.ufl(f"parameter {n}") for n in given.parameters}),
        )
        return data, sampled

    def laws(self, active: fem.Function) -> tuple[PointLaw, PointLaw]:
        """Return the law in the form on Γc, and for values at ``active`` points (1, others 0)."""
        law, quadrature, jump = self._parts.law, self._parts.quadrature, self.local_jump
        # With finite kinematics derivatives by the motion follow from those by the jump.
        free_shift = {} if self.is_finite else self._parts.inputs.free_shift
        arguments: dict[str, Any] = {"surface_geometry": self.given, "free_shift": free_shift}
        paired = self.pairs.indicator
        mask = active if paired is None else paired * active
        return (
            PointLaw(law, self.given, self.in_form, quadrature, jump, mask=paired, **arguments),
            PointLaw(law, self.sampled, self.at_points, quadrature, jump, mask=mask, **arguments),
        )

    # ---- evaluation ------------------------------------------------------------------------------

    def update(self) -> None:
        """Update data and jump at the points to the present data and ``u``. Collective."""
        self.update_data()
        self._update_jump()

    def update_data(self) -> None:
        """Sample all data that do not depend on ``u``. Collective."""
        if self._undeformed_sample is not None:
            self._undeformed_sample.update()
        self.data.update()

    def _update_jump(self) -> None:
        """Evaluate the jump at the present ``u``. Collective."""
        displacement = self._parts.displacement
        displacement.update()
        self.pairs.jump_map.mult(displacement.u.x.petsc_vec, self.jump.x.petsc_vec)
        if self._displaced is not None:
            rows = self.jump.x.array[: self.committed_jump.size].reshape(-1, self._gdim)
            rows += self._displaced.of_points(rows)
        self.jump.x.scatter_forward()

    @contextmanager
    def displaced(self, by: Array | ObstacleMotion) -> Iterator[None]:
        """Evaluate points displaced by (n_points, gdim) (length) or by a motion, in a block."""
        self._displaced = by if isinstance(by, ObstacleMotion) else ObstacleMotion(by)
        try:
            yield
        finally:
            self._displaced = None

    def rotate_to_displaced(self, vectors: Array) -> Array:
        """Return directions (..., n_points, gdim) of point motions at the displaced positions."""
        return vectors if self._displaced is None else self._displaced.turn.directions(vectors)

    def present_jump(self) -> Array:
        """Return `jump` at the present ``u``, (n_points, gdim) (length). Collective."""
        self._update_jump()
        rows = self.jump.x.array.reshape(-1, self._gdim)
        return np.array(rows[: self._parts.quadrature.n_points])

    def outputs(self, arrays: Mapping[str, Array]) -> dict[str, Array]:
        """Return the fields of `PointValues` that follow from the kinematics, not from the law."""
        return {"jump": self.relative_jump()}

    def relative_jump(self) -> Array:
        """Return the jump of the last update relative to the obstacle, (n_points, gdim)."""
        rows = self.jump.x.array.reshape(-1, self._gdim)[: self._parts.quadrature.n_points]
        return np.asarray(rows - self.data.values.get("obstacle", 0.0))

    def tangent(self, law: PointLaw) -> PointTangent:
        """Return the derivatives of a law's tractions at the present state. Collective."""
        return law.evaluate_tangent()

    # ---- geometry --------------------------------------------------------------------------------

    def undeformed_gap(self, values: PointValues) -> Array:
        """Return the gap of the undeformed Γc, 0 at unpaired points, (n_points,) (length)."""
        return values.initial_gap

    @abstractmethod
    def true_placement(self, values: PointValues) -> tuple[Array, Array]:
        """Return gap and normal at the deformed position X + u. Collective.

        With finite kinematics these are the gap and normal of the contact itself. On an opposing
        body they are found by a separate search, which does not change the pairs.

        Returns:
            Gap, (n_points,) (length): NaN without an opposite point, infinite if the obstacle
            defines no distance away from Γc; and unit normals to the obstacle, (n_points, gdim).
        """

    def deviation(self, values: PointValues) -> tuple[Array, Array]:
        """Return the true gap minus the linearised gap, and the true normal. Collective.

        The deviation of a point that is unpaired in the linearised kinematics is its true gap, and
        that of an unknown true gap is zero. Between non-matching facets it jumps from point to
        point.
        """
        gap, normal = self.true_placement(values)
        return np.where(np.isinf(gap), 0.0, gap - values.gap), normal

    @property
    def is_flat(self) -> bool:
        """Whether s - u_n is the true gap for any displacement, and the normal constant."""
        return False

    @property
    def has_rotation(self) -> bool:
        """Whether the obstacle rotates."""
        return self._parts.inputs.rotation is not None

    def rotate(self, vectors: Array, *, inverse: bool = False) -> Array:
        """Return vectors rotated from the frame of the history to space, or back, (n_points, d)."""
        return vectors

    def _to_history_frame(self, arrays: Mapping[str, Array], normal: Array) -> dict[str, Array]:
        """Return normal, traction and elastic slip in the frame of the history."""
        framed = {"framed_normal": normal, "framed_traction": arrays["traction"]}
        if "elastic_slip" in arrays:
            framed["elastic_slip"] = arrays["elastic_slip"]
        return {name: self.rotate(vectors, inverse=True) for name, vectors in framed.items()}

    def committed_offset(self, values: PointValues) -> Array:
        """Return the offset to the committed positions relative to the obstacle (length).

        At the committed ``u`` it is the displacement of a rigid obstacle since the last commit.
        """
        return self.rotate(self.committed_jump - values.jump)

    def motion_in_increment(self, values: PointValues) -> ObstacleMotion:
        """Return the motion of a rigid obstacle from values at the committed ``u``. Collective."""
        turn = self.rotation_in_increment(values)
        return ObstacleMotion(self.committed_offset(values), turn, self.present_jump())

    def angle(self, values: PointValues | None = None) -> float:
        """Return the rotation angle of the obstacle from its start (radians). Collective.

        By default it is that of the data sampled last.
        """
        inputs = self._parts.inputs
        if inputs.free_angle is not None:
            return float(inputs.free_angle.value)
        if inputs.angle is None:
            return 0.0
        # It is equal at all points.
        arrays = self.data.values if values is None else values.arrays
        return global_max(self._mesh.comm, arrays["angle"])

    def rotation_derivative(self) -> Array:
        """Return ω × r at the points for a unit rotation, (n_points, gdim) (length). Collective."""
        rotation = self._parts.obstacle.rotation
        assert rotation is not None
        jump = self.present_jump()
        self.update_data()
        data = self.data.values
        return rotation.rate(data["x"] + jump - data["about"] - data.get("obstacle", 0.0))

    def gradient_error(self, values: PointValues) -> Array:
        """Return the norm of the gradient of the gap plus the unit normal, (n_points,). Collective.

        It is evaluated at X or, with finite kinematics, X + u; 0 for a given gap and between
        bodies.
        """
        return np.zeros(len(values.x))

    def in_frame(self, vectors: Array, angle: float) -> Array:
        """Return vectors in the frame of an obstacle rotated by an angle, (n, gdim)."""
        rotation = self._parts.obstacle.rotation
        return vectors if rotation is None else rotation.rotate(vectors, -angle)

    def rotation_in_increment(self, values: PointValues) -> IncrementalRotation:
        """Return the rotation of the obstacle since the last commit. Collective."""
        rotation = self._parts.obstacle.rotation
        if rotation is None:
            return IncrementalRotation()
        about = values.arrays["about"][:1]  # equal at all points
        return IncrementalRotation(self.angle(values) - self.committed_angle, about, rotation)

    def largest_curvature(self) -> Array | None:
        """Return the largest principal curvature of a rigid obstacle at X + u (1/length).

        It has shape (n_points,); 0 if all curvatures are negative, infinite at a centre of
        curvature. It is None with small displacements and between bodies.
        """
        return None

    # ---- pairs -----------------------------------------------------------------------------------

    @property
    def updates_pairs(self) -> bool:
        """Whether pairs are updated at every commit and where bodies slide."""
        return False

    @property
    def can_update_pairs(self) -> bool:
        """Whether pairs may be found on the deformed bodies, at a commit or within an increment."""
        return False

    def transmitting_points(self, values: PointValues) -> Mask:
        """Return a mask of the points that transmit forces to another body, (n_points,)."""
        return np.zeros(len(values.x), dtype=np.bool_)

    @property
    def slide_limit(self) -> float:
        """Largest admissible `largest_slide` of a solution."""
        return np.inf

    def largest_slide(self, values: PointValues, of: PointValues | None = None) -> float:
        """Return the largest slide of points that transmit forces in a state ``of``. Collective.

        The slide is the tangential displacement relative to the opposing body since the pairs were
        found, divided by the size of the point's facet. It is 0 where pairs follow the bodies.
        """
        return 0.0

    def needs_pair_update(self, values: PointValues) -> bool:
        """Whether `commit` will update the pairs, for which it needs all of ``u``. Collective."""
        return False

    def needs_new_pairs(self, values: PointValues, of: PointValues | None = None) -> bool:
        """Whether points have slid off their pairs, or could be paired now. Collective.

        It applies to points that transmit forces in a state ``of`` and slide by more than
        `slide_limit`, and to unpaired points that have slid as far, if they have an opposite point
        now.
        """
        return False

    def find_pairs(self, u: fem.Function | None, depth: Array) -> None:
        """Find the opposite points; points without one are open. Collective.

        Args:
            u: Displacement in which to find them; None for the undeformed bodies.
            depth: Penetration of the points into the opposing body in ``u``, (n_points,) (length).
        """
        self.update()

    # ---- history ---------------------------------------------------------------------------------

    def reset_reference(self) -> bool:
        """Measure slip from the present ``u``; return whether the reference changes. Collective."""
        jump = self.present_jump()
        has_changed = global_max(self._mesh.comm, np.abs(jump - self.committed_jump)) > 0
        self.committed_jump = jump
        return has_changed

    def reference_fields(self) -> dict[str, Array]:
        """Return the displacement fields of the history at `committed_jump`. Collective."""
        return {"jump": self.committed_jump}

    def slip_reference(self, values: PointValues) -> dict[str, Array]:
        """Return the displacement fields of the history at an evaluated state. Collective."""
        return {"jump": values.projection_point}

    def to_history(self, fields: Mapping[str, Array]) -> dict[str, Array]:
        """Return fields of a solution in the frame of the history."""
        return dict(fields)

    def commit(self, values: PointValues) -> Array | None:
        """Make an evaluated state the committed one; return the change of the jump. Collective.

        The change by an update of the pairs is (n_points, gdim) (length); None without update.
        """
        self.set_reference(values)
        return None

    def set_reference(self, values: PointValues) -> None:
        """Measure displacements and rotation from an evaluated state. Collective."""
        self.committed_jump = values.jump
        self.committed_angle = self.angle(values)
        if self.sampler is not None:
            self.sampler.committed_shape = self.sampler.shape

    def update_committed_jump(self) -> Array:
        """Evaluate the committed jump between new pairs; return its change (length). Collective."""
        previous, self.committed_jump = self.committed_jump, self.present_jump()
        return self.committed_jump - previous

    def resume(self, depth: Array, evaluate: Callable[[], PointValues], *, new_pairs: bool) -> None:
        """Make the present ``u`` the committed displacement of another run. Collective.

        Args:
            depth: Penetration of the points into the opposing body in that run, (n_points,)
                (length).
            evaluate: Function that returns the present values at the points.
            new_pairs: Whether that run updated pairs at this commit.
        """
        self.set_reference(evaluate())

    def state(self) -> KinematicsState:
        """Return the committed state, for `set_state`."""
        shape = None if self.sampler is None else self.sampler.committed_shape
        return KinematicsState(self.committed_jump, self.committed_angle, self.pairs.state(), shape)

    def set_state(self, state: KinematicsState) -> None:
        """Make a state the committed one. Collective."""
        self.committed_jump, self.committed_angle = state.jump, state.angle
        if self.sampler is not None and state.shape is not None:
            self.sampler.committed_shape = state.shape
        self.pairs.set_state(state.pairs)
