"""What lies opposite Γc: where it is, and what the points feel of it.

|                     | a rigid obstacle (`rigid`) | another body (`body`) |
|---------------------|---------------------------|-----------------------|
| small displacements | `RigidSmall`           | `BodySmall`        |
| finite ones         | `RigidFinite`          | `BodyFinite`    |

Each samples at the points of Γc what laws are functions of there, and keeps what was committed of
it: the jump, the angle, the pairs.
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

from fenics_contact.contact.inputs import Inputs, check_given
from fenics_contact.contact.obstacle_sampler import ObstacleSampler
from fenics_contact.contact.pairs import Pairs, PairsState
from fenics_contact.contact.point_data import PointData
from fenics_contact.contact.point_geometry import LocalKinematics, PointGeometry, SmallKinematics
from fenics_contact.contact.point_law import PointLaw, PointTangent
from fenics_contact.contact.sampled import SampledPlaces
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
    """What a contact consists of; see there."""

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
        """Pairs that stay as they are found. Collective."""
        return Pairs(self.name, self.displacement.u, self.quadrature, self.obstacle)

    def new_jump(self) -> fem.Function:
        """A function at the points, for the displacement there."""
        gdim = self.quadrature.surface.mesh.geometry.dim
        return fem.Function(self.quadrature.space(gdim), name="jump")


@dataclass(frozen=True)
class KinematicsState:
    """What was committed of an `ContactKinematics`; see its attributes."""

    jump: Array
    angle: float
    pairs: PairsState
    shape: Array | None


@dataclass(frozen=True)
class IncrementalRotation:
    """Rotation of an obstacle in an increment, about an axis that does not move in it.

    Attributes:
        angle: By which the obstacle has turned (radians).
        about: A point of the axis, (gdim,) (length).
        rotation: Of the obstacle; None: it does not turn.
    """

    angle: float = 0.0
    about: Array | float = 0.0
    rotation: Rotation | None = None

    def turned(self, places: Array, share: Array | float) -> Array:
        """Places turned by shares of the angle, one for all or (n,): (n, gdim) (length)."""
        if self.rotation is None:
            return places
        return self.about + self.rotation.turned(places - self.about, share * self.angle)

    def directions(self, vectors: Array) -> Array:
        """Directions turned by the angle, (..., gdim)."""
        if self.rotation is None:
            return vectors
        turned = self.rotation.turned(vectors.reshape(-1, vectors.shape[-1]), self.angle)
        return turned.reshape(vectors.shape)

    def radius(self, places: Array) -> Array:
        """Distance of places from the axis, (n,) (length); 0 if the obstacle does not turn."""
        if self.rotation is None:
            return np.zeros(len(places))
        return np.asarray(np.linalg.norm(self.rotation.rate(places - self.about), axis=1))


@dataclass(frozen=True)
class ObstacleMotion:
    """Rigid motion of an obstacle, by which points of Γc are displaced with it.

    Where it puts them they meet the present obstacle as, without it, the one before the motion.

    Attributes:
        offset: Displacement of the points where `start` has them, (n_points, gdim) (length).
        turn: Rotation of the obstacle.
        start: Displacement of the body at the points, (n_points, gdim) (length).
    """

    offset: Array
    turn: IncrementalRotation = IncrementalRotation()
    start: Array | float = 0.0

    def of_points(self, jump: Array) -> Array:
        """Displacement by the motion at a displacement of the body, (n_points, gdim) (length)."""
        moved = jump - self.start
        return np.asarray(self.offset + (self.turn.directions(moved) - moved))


class ContactKinematics(ABC):
    """What lies opposite Γc, under one kinematics.

    The ``values`` that methods take are those of the last evaluation where nothing else is said.
    Constructors are collective, and compile what samples the points.

    Args:
        placement: Where the opposite is, geometry from the undeformed Γc.
        at_rest: Of an obstacle known in numbers, what has to be sampled for that.

    Attributes:
        pairs: What lies opposite each of the points.
        data: What was given, sampled at the points.
        jump: Displacement at the points relative to what lies opposite; that of a rigid obstacle is
            not in it.
        felt: What laws are functions of there: the jump, or what follows from it.
        given, sampled: What else laws see, as expressions on Γc, and as numbers at the points.
        in_form, at_points: LocalKinematics of laws in the form on Γc, and at numbers at the points.
        committed_jump: The jump at the last commit, that of the obstacle taken away, (n_points,
            gdim), between the places that are opposite each other now; zero before the first.
        committed_angle: By which the obstacle had turned then (radians).
        is_finite: Whether displacements may be of any size.
        is_rigid: Whether it is a rigid obstacle, whose reactions are external to the mesh.
        follows: Whether the pairs follow the bodies wherever they go.
        updates_pairs: Whether pairs are found anew, on the deformed bodies, at every commit and in
            increments in which bodies slide.
        sampler: What evaluates a rigid obstacle anywhere; None where it is known on Γc alone, or
            the opposite is another body.
    """

    is_finite = False
    is_rigid = True
    follows = False
    sampler: ObstacleSampler | None = None

    def __init__(
        self,
        parts: ContactParts,
        pairs: Pairs,
        jump: fem.Function,
        placement: Placement,
        at_rest: SampledPlaces | None = None,
    ) -> None:
        self.pairs, self.jump = pairs, jump
        self._parts, self._at_rest = parts, at_rest
        self._mesh = parts.quadrature.surface.mesh
        self._gdim = self._mesh.geometry.dim
        self.given = self._see(placement)
        self.data, self.sampled = self._sample(placement)
        self.local_jump = jump
        self.in_form: LocalKinematics = SmallKinematics(parts.history, parts.multipliers)
        self.at_points: LocalKinematics = self.in_form
        self.committed_jump: Array = np.zeros((parts.quadrature.n_points, self._gdim))
        self.committed_angle = 0.0
        self._displaced: ObstacleMotion | None = None

    # ---- construction ----------------------------------------------------------------------------

    def _see(self, placement: Placement) -> PointGeometry:
        """What laws see, as expressions on Γc."""
        inputs, gap = self._parts.inputs, self._parts.gap
        open_gap = placement.gap
        if gap is not None:
            open_gap = inputs.scalar("gap", gap)
            if inputs.shift is not None:
                open_gap = open_gap + ufl.dot(inputs.shift, placement.normal)
        return PointGeometry(open_gap, placement.normal, inputs.shift, inputs.law)

    def _sample(self, placement: Placement) -> tuple[PointData, PointGeometry]:
        """The same at the points, and more that is known there."""
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
        own = dict(given.parameters) | {"weight": inputs.weight}
        own |= {"displacement of the obstacle": expressions["shift"]}
        own |= {n: expressions[n] for n in ("angle", "about") if n in expressions}
        own |= {"gap": given.gap, "normal": direction}
        parts = self._parts
        check_given(parts.name, own, parts.quadrature, parts.displacement)
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

    def laws(self, within: fem.Function) -> tuple[PointLaw, PointLaw]:
        """The law in the form on Γc, and at numbers at the points.

        Args:
            within: 1 at the points that the latter is confined to, 0 at others.
        """
        law, quadrature, felt = self._parts.law, self._parts.quadrature, self.local_jump
        # With finite kinematics all follows from X + u less the motion: derivatives do, too.
        free = {} if self.is_finite else self._parts.inputs.free_shift
        here: dict[str, Any] = {"given": self.given, "free": free}
        paired = self.pairs.acts
        acts = within if paired is None else paired * within
        return (
            PointLaw(law, self.given, self.in_form, quadrature, felt, acts=paired, **here),
            PointLaw(law, self.sampled, self.at_points, quadrature, felt, acts=acts, **here),
        )

    # ---- the points ------------------------------------------------------------------------------

    def update(self) -> None:
        """Let the points be at the present ``u`` and data. Collective."""
        self.update_data()
        self._update_jump()

    def update_data(self) -> None:
        """Let what does not follow from ``u`` be as it was given last. Collective."""
        if self._at_rest is not None:
            self._at_rest.update()
        self.data.update()

    def _update_jump(self) -> None:
        """Let the displacement at the points be the present one. Collective."""
        displacement = self._parts.displacement
        displacement.follow()
        self.pairs.jump_map.mult(displacement.u.x.petsc_vec, self.jump.x.petsc_vec)
        if self._displaced is not None:
            rows = self.jump.x.array[: self.committed_jump.size].reshape(-1, self._gdim)
            rows += self._displaced.of_points(rows)
        self.jump.x.scatter_forward()

    @contextmanager
    def displaced(self, by: Array | ObstacleMotion) -> Iterator[None]:
        """Evaluate points at displaced positions, inside of the block.

        Args:
            by: Displacement of the points, (n_points, gdim) (length), or a motion of the obstacle.
        """
        self._displaced = by if isinstance(by, ObstacleMotion) else ObstacleMotion(by)
        try:
            yield
        finally:
            self._displaced = None

    def displaced_directions(self, vectors: Array) -> Array:
        """Directions of motions of the points as they are at displaced positions.

        Args:
            vectors: (..., n_points, gdim).
        """
        return vectors if self._displaced is None else self._displaced.turn.directions(vectors)

    def present_jump(self) -> Array:
        """Displacement relative to what lies opposite, or of the body alone. Collective."""
        self._update_jump()
        rows = self.jump.x.array.reshape(-1, self._gdim)
        return np.array(rows[: self._parts.quadrature.n_points])

    def outputs(self, arrays: Mapping[str, Array]) -> dict[str, Array]:
        """What else is known at the points, beside what a law told; see `PointValues`."""
        rows = self.jump.x.array.reshape(-1, self._gdim)[: self._parts.quadrature.n_points]
        return {"jump": rows - self.data.values.get("obstacle", 0.0)}

    def tangent(self, law: PointLaw) -> PointTangent:
        """Derivatives of a law's tractions where the points are. Collective."""
        return law.evaluate_tangent()

    # ---- where it is -----------------------------------------------------------------------------

    def undeformed_gap(self, values: PointValues) -> Array:
        """Gap of the undeformed Γc, 0 where nothing is opposite, (n_points,) (length)."""
        return values.initial_gap

    @abstractmethod
    def true_placement(self, values: PointValues) -> tuple[Array, Array]:
        """Gap and normal where the body has moved to: at X + u instead of X. Collective.

        With finite kinematics these are the gap and normal of the contact itself. Opposite another
        body they are by a search anew, in which the pairs stay as they are.

        Returns:
            Gap, (n_points,) (length): NaN where there is no opposite, and infinite where an
            `Obstacle` says no distance that could be told at other places; and unit normals from
            body to obstacle, (n_points, gdim).
        """

    def deviation(self, values: PointValues) -> tuple[Array, Array]:
        """True gap less the linearised one, and the true normal; see `true_placement`. Collective.

        Of a point that has no opposite in the linearised kinematics it is the true gap.

        Between facets that do not match it jumps from point to point. Nothing deviates where the
        true gap is not known.
        """
        gap, normal = self.true_placement(values)
        return np.where(np.isinf(gap), 0.0, gap - values.gap), normal

    @property
    def is_flat(self) -> bool:
        """Whether s - u_n is the true gap wherever the body moves, and the normal constant."""
        return False

    @property
    def turns(self) -> bool:
        """Whether the obstacle turns."""
        return self._parts.inputs.rotation is not None

    def turned(self, vectors: Array, *, back: bool = False) -> Array:
        """Directions in the frame of the history as they are in space, or back: (n_points, d)."""
        return vectors

    def _framed(self, arrays: Mapping[str, Array], normal: Array) -> dict[str, Array]:
        """Normal, traction and elastic slip in the frame of the history, (n_points, gdim) each."""
        framed = {"framed_normal": normal, "framed_traction": arrays["traction"]}
        if "elastic_slip" in arrays:
            framed["elastic_slip"] = arrays["elastic_slip"]
        return {name: self.turned(vectors, back=True) for name, vectors in framed.items()}

    def committed_offset(self, values: PointValues) -> Array:
        """Return the offset from the points to their committed places relative to the obstacle.

        At the committed ``u`` it is the displacement of a rigid obstacle since the last commit,
        (n_points, gdim) (length).
        """
        return self.turned(self.committed_jump - values.jump)

    def motion_in_increment(self, values: PointValues) -> ObstacleMotion:
        """Motion of a rigid obstacle since the last commit. Collective.

        Args:
            values: Of the last evaluation, at the committed ``u``.
        """
        turn = self.rotation_in_increment(values)
        return ObstacleMotion(self.committed_offset(values), turn, self.present_jump())

    def angle(self, values: PointValues | None = None) -> float:
        """By which the obstacle has turned since it began, 0 where it cannot (radians). Collective.

        Args:
            values: When; by default with the data as they were sampled last.
        """
        inputs = self._parts.inputs
        if inputs.free_angle is not None:
            return float(inputs.free_angle.value)
        if inputs.angle is None:
            return 0.0
        # The same at all points.
        arrays = self.data.values if values is None else values.arrays
        return global_max(self._mesh.comm, arrays["angle"])

    def turned_by(self, values: PointValues) -> float:
        """By which the obstacle has turned since the last commit (radians). Collective."""
        return self.angle(values) - self.committed_angle

    def turning_rate(self) -> Array:
        """Way by a unit angle of a turning obstacle's points where those of Γc are now. Collective.

        Returns:
            ω × r, with r from the axis as it is now, (n_points, gdim) (length).
        """
        rotation = self._parts.obstacle.rotation
        assert rotation is not None
        jump = self.present_jump()
        self.update_data()
        data = self.data.values
        return rotation.rate(data["x"] + jump - data["about"] - data.get("obstacle", 0.0))

    def gradient_error(self, values: PointValues) -> Array:
        """Difference of the gradient of a rigid obstacle's gap from minus the unit normal.

        At X with small displacements, at X + u with finite ones. Collective.

        Returns:
            (n_points,); 0 of a gap that is given on Γc, and between bodies.
        """
        return np.zeros(len(values.x))

    def in_frame(self, vectors: Array, angle: float) -> Array:
        """Vectors in the frame of the obstacle turned by an angle since it began, (n, gdim)."""
        rotation = self._parts.obstacle.rotation
        return vectors if rotation is None else rotation.turned(vectors, -angle)

    def rotation_in_increment(self, values: PointValues) -> IncrementalRotation:
        """Rotation of the obstacle since the last commit. Collective."""
        rotation = self._parts.obstacle.rotation
        if rotation is None:
            return IncrementalRotation()
        about = values.arrays["about"][:1]  # the same at all points
        return IncrementalRotation(self.turned_by(values), about, rotation)

    def largest_curvature(self) -> Array | None:
        """Largest principal curvature of a rigid obstacle at X + u, (n_points,) (1/length).

        0 where all are negative, infinite at a centre of curvature. None where displacements are
        taken as small, and between bodies.
        """
        return None

    # ---- pairs -----------------------------------------------------------------------------------

    @property
    def updates_pairs(self) -> bool:
        """See the class."""
        return False

    @property
    def can_update_pairs(self) -> bool:
        """Whether pairs are, or may come to be, other ones than those of the undeformed bodies."""
        return False

    def transmitting_points(self, values: PointValues) -> Mask:
        """Mask of the points that transmit forces to another body, (n_points,)."""
        return np.zeros(len(values.x), dtype=np.bool_)

    @property
    def slide_limit(self) -> float:
        """Largest slide that a solution may have, see `largest_slide`."""
        return np.inf

    def largest_slide(self, values: PointValues, of: PointValues | None = None) -> float:
        """Return the largest slide of points that transmit forces to another body. Collective.

        The slide is the tangential displacement relative to the opposing body since the pairs were
        found, divided by the size of the point's facet. It is 0 where pairs follow the bodies.

        Args:
            values: Of the last evaluation.
            of: Of the state in which the points transmit forces; by default the same.
        """
        return 0.0

    def needs_pair_update(self, values: PointValues) -> bool:
        """Whether `commit` will find pairs anew, for which it needs all of ``u``. Collective."""
        return False

    def needs_new_pairs(self, values: PointValues, of: PointValues | None = None) -> bool:
        """Whether points have left their pairs, or come to some. Collective.

        Those that transmit forces by more than `slide_limit`; and those without a pair that have
        moved by as much along the surface, if they would find one now. False where pairs stay or
        follow the bodies.

        Args:
            values: Of the last evaluation.
            of: Of the state in which the points transmit forces; by default the same.
        """
        return False

    def find_pairs(self, u: fem.Function | None, depth: Array) -> None:
        """Find what lies opposite the points; those without an opposite are open. Collective.

        On a rigid obstacle there is nothing to find.

        Args:
            u: Displacement in which to find it; None: the undeformed bodies.
            depth: Of the points in the opposite in ``u``, (n_points,) (length).
        """
        self.update()

    # ---- history ---------------------------------------------------------------------------------

    def reset_reference(self) -> bool:
        """Let ways be counted from the present ``u``; whether that is not where they were from.

        Collective.
        """
        jump = self.present_jump()
        differs = global_max(self._mesh.comm, np.abs(jump - self.committed_jump)) > 0
        self.committed_jump = jump
        return differs

    def start(self) -> dict[str, Array]:
        """What the history has of displacements at `committed_jump`, by name. Collective."""
        return {"jump": self.committed_jump}

    def projection_points(self, values: PointValues) -> dict[str, Array]:
        """What the history has of displacements at an evaluated state, by name. Collective."""
        return {"jump": values.projection_point}

    def committed_fields(self, fields: Mapping[str, Array]) -> dict[str, Array]:
        """What is found of a solution, as the history has it."""
        return dict(fields)

    def commit(self, values: PointValues) -> Array | None:
        """Make an evaluated state the committed one. Collective.

        Returns:
            By how much the jump is another as pairs were found anew, (n_points, gdim) (length);
            None: they were not.
        """
        self.set_reference(values)
        return None

    def set_reference(self, values: PointValues) -> None:
        """Let ways and angles be counted from an evaluated state. Collective."""
        self.committed_jump = values.jump
        self.committed_angle = self.angle(values)
        if self.sampler is not None:
            self.sampler.committed_shape = self.sampler.shape

    def update_committed_jump(self) -> Array:
        """Let ways be counted between pairs that were found anew; ``u`` is the committed one.

        Collective.

        Returns:
            By how much the jump is another, (n_points, gdim) (length).
        """
        before, self.committed_jump = self.committed_jump, self.present_jump()
        return self.committed_jump - before

    def resume(self, depth: Array, evaluate: Callable[[], PointValues], *, anew: bool) -> None:
        """Take the present ``u`` for the committed one, of another run. Collective.

        Args:
            depth: Of the points in the opposite then, (n_points,) (length).
            evaluate: Gives what is at the points now.
            anew: Whether pairs were found anew there, see `updates_pairs`.
        """
        self.set_reference(evaluate())

    def state(self) -> KinematicsState:
        """What was committed, for `set_state`."""
        shape = None if self.sampler is None else self.sampler.committed_shape
        return KinematicsState(self.committed_jump, self.committed_angle, self.pairs.state(), shape)

    def set_state(self, state: KinematicsState) -> None:
        """Make a state the committed one again. Collective."""
        self.committed_jump, self.committed_angle = state.jump, state.angle
        if self.sampler is not None and state.shape is not None:
            self.sampler.committed_shape = state.shape
        self.pairs.set_state(state.pairs)
