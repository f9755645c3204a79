"""Positions of Γc in the frame of a rigid obstacle, and points of the obstacle in the body."""

from __future__ import annotations

from typing import Any

import numpy as np
from dolfinx import fem

from fenics_contact.checks.obstacles import MAX_ROTATION
from fenics_contact.checks.penetration import (
    ALLOWED_BEFORE,
    DEPTH_RESOLUTION,
    OPPOSITE_SIDES,
    PREDICTED_DEPTH,
    ResistedDepth,
    allowed_depth,
    dot,
    gather_around,
    predicted_depth,
)
from fenics_contact.checks.surface_pieces import SurfacePieces, depth_below_surface
from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import Status
from fenics_contact.parallel import global_max
from fenics_contact.surface.crossings import find_crossings
from fenics_contact.types import Array, Index, Mask

__all__ = ["RigidObstacleProbe"]

# Steps along a facet towards its deepest position in an obstacle.
_MAX_DESCENT_STEPS = 12
# Bisections of a path for the position at which the normal turns to the opposite side.
_BISECTIONS = 20


class RigidObstacleProbe:
    """Positions of Γc in the frame of a rigid obstacle, and their paths in an increment.

    The constructor samples the obstacle at `FacetSampling` and where it is deepest below each
    facet. It is collective.

    Args:
        before: Displacement at the last commit; None if unknown.
        committed: Probe of a committed state, up to which paths are verified.

    Attributes:
        x: Positions on the undeformed Γc, (n, gdim) (length).
        resisted: Corners of this rank's facets, (m, n_corners), and the penetration of their points
            that the law resists, (m,) (length).
        comm: Communicator.
        places: The sampling positions of Γc.
        sampler: The obstacle.
        rotation: Rotation of the obstacle in the increment.
        points: Quadrature points in the frame of the obstacle, (n_points, gdim) (length).
        start, field: Nodes of Γc at both ends of the increment, (n_nodes, gdim) (length).
        facet, reference: This rank's facet and reference coordinates of each position, (n, ...).
        z: Positions at the end of the increment, (n, gdim) (length).
        distance: Distance from the obstacle there, (n,) (length).
        toward: Unit normal towards the obstacle there, (n, gdim).
    """

    def __init__(
        self,
        contact: Contact,
        before: fem.Function | None = None,
        committed: RigidObstacleProbe | None = None,
    ) -> None:
        kinematics, values = contact.contact_kinematics, contact.values
        assert kinematics.sampler is not None
        self.places = places = contact.facet_sampling
        self.sampler = kinematics.sampler
        self.comm = contact.surface.mesh.comm
        self.points = values.x + values.jump
        self._law_normal = values.normal.copy()
        self._gap, self._normal = self.sampler.sample(self.points)
        self._shape = self.sampler.shape
        self.rotation = kinematics.rotation_in_increment(values)
        self.field = self._in_frame(contact, contact.u)
        if committed is not None and not kinematics.has_rotation:
            self.start = committed.field
        else:
            self.start = places.at_nodes(
                values.x + kinematics.committed_jump,
                contact.u if before is None else before,
                lambda rest: kinematics.in_frame(rest, kinematics.committed_angle),
            )
        self.facet, self.reference, self.distance, self.toward = self._find_deepest()
        self.x, _ = places.facets.positions(self.facet, self.reference)
        self.z = self._at(self.field)
        # Depths are predicted for the displacement that the points carry.
        self._carried_by_points = self._at(self._in_frame(contact, None))
        closed = contact.status != Status.OPEN
        # Penetration at the points is the law's, even without stiffness.
        resisted = np.maximum(values.penetration, np.where(closed, -self._gap, 0.0))[places.rows]
        corners = places.facets.corner_vertices()
        self.resisted = [(corners, resisted.max(axis=1, initial=0.0))]
        origins = self.points + self._gap[:, None] * self._normal
        fields = (field[places.rows] for field in (self.points, origins, -self._normal))
        self._around = gather_around(self.comm, corners, resisted, *fields)

    def _in_frame(self, contact: Contact, u: fem.Function | None) -> Array:
        """Return the nodes in the present frame of the obstacle. Collective.

        If the displacement u is None, it is that part which the points carry.
        """
        kinematics, values = contact.contact_kinematics, contact.values
        return self.places.at_nodes(
            values.x + values.jump,
            u,
            lambda rest: kinematics.in_frame(rest, kinematics.angle(values)),
        )

    def _find_deepest(self) -> tuple[Index, Array, Array, Array]:
        """Find the closest positions to the obstacle by alternating projections. Collective.

        Returns:
            Facet, reference coordinates, distance (length), and unit normal towards the obstacle,
            (n, ...), of the sampling positions and of all iterates.
        """
        places, size = self.places, self.places.size
        facet, reference, rows = places.facet, places.reference, places.rows.ravel()
        between = places.values(self.field, facet[rows.size :], reference[rows.size :])
        # The quadrature points, which come first, are sampled already.
        samples = (self._gap[rows], self._normal[rows]), self.sampler.sample(between)
        distance, normal = (np.concatenate(pair) for pair in zip(*samples, strict=True))
        iterates = [(facet, reference, distance, normal)]
        # An obstacle farther away than the size of a facet does not reach it.
        going: Mask = distance < size[facet]
        scale: Array = np.ones(len(facet))
        inverse, near = np.swapaxes(places.tangents(self.field), 1, 2), np.unique(facet[going])
        inverse[near] = np.linalg.pinv(np.swapaxes(inverse[near], 1, 2))
        for _ in range(_MAX_DESCENT_STEPS):
            facet, reference, scale = facet[going], reference[going], scale[going]
            distance, normal = distance[going], normal[going]
            step = (scale * np.maximum(distance, 0.1 * size[facet]))[:, None] * normal
            trial = reference + np.einsum("nij,nj->ni", inverse[facet], step)
            trial = places.facets.clipped(trial)
            going = np.abs(trial - reference).max(axis=1, initial=0.0) > 1e-3
            if not self.comm.allreduce(int(going.any())):
                break
            trial_distance, toward = self.sampler.sample(places.values(self.field, facet, trial))
            deeper = going & (trial_distance < distance - 1e-3 * size[facet])
            # A step that fails has passed over an obstacle that is narrower.
            scale = np.where(deeper, scale, scale / 2)
            reference = np.where(deeper[:, None], trial, reference)
            distance = np.where(deeper, trial_distance, distance)
            normal = np.where(deeper[:, None], toward, normal)
            iterates.append((facet[deeper], reference[deeper], distance[deeper], normal[deeper]))
        facets, references, distances, normals = map(np.concatenate, zip(*iterates, strict=True))
        return facets, references, distances, normals

    def is_at_commit(self, contact: Contact, before: fem.Function) -> bool:
        """Whether points and shape, in the obstacle's frame, are those of the last commit."""
        committed = contact.values.x + contact.contact_kinematics.committed_jump
        is_shape = np.array_equal(self._shape, self.sampler.committed_shape)
        return bool(is_shape and np.array_equal(self.points, committed))

    def is_valid_for(self, contact: Contact) -> bool:
        """Whether all positions have moved by less than their clearance since. Collective.

        The probe of an obstacle that rotates or changes its shape is not valid again.
        """
        valid = np.array_equal(self._shape, self.sampler.shape)
        valid = valid and not contact.contact_kinematics.has_rotation
        displacement = self._at(self._in_frame(contact, contact.u)) - self.z
        size = self.places.size[self.facet]
        clearance = DEPTH_RESOLUTION * size + self.distance
        # An obstacle that has entered the body may go deeper.
        inside = dot(np.nan_to_num(self.toward), self.places.outward(self.field)[self.facet]) < 0
        clearance -= np.where(inside, ALLOWED_BEFORE * size, 0.0)
        valid = valid and bool(np.all(np.linalg.norm(displacement, axis=1) <= clearance))
        # A point may have come to the opposite side of a thinner obstacle.
        reversed_normals = dot(contact.values.normal, self._law_normal) < OPPOSITE_SIDES
        valid = valid and not reversed_normals.any()
        return self.comm.allreduce(int(not valid)) == 0

    def depth(self, resisted: ResistedDepth) -> tuple[Array, Array]:
        """Return penetration and allowed penetration, (n,) each (length). Collective."""
        places = self.places
        around = resisted.at(places.facets.corner_vertices())[self.facet]
        points = (field[self.facet] for field in self._around)
        predicted = predicted_depth(self._carried_by_points, -self.toward, *points)
        for prediction in predicted:  # quadrature points resist themselves
            prediction[: places.rows.size] = 0.0
        size = places.size[self.facet]
        allowed = allowed_depth(around, predicted, size, size)
        # Deeper in a flat cell another surface may be nearer, and the facet of entry would not be
        # found.
        limit = np.where(around > 0, np.inf, places.facets.heights()[self.facet] / 2)
        allowed = np.minimum(allowed, limit)
        return self._protrusion(allowed, size), allowed

    def _protrusion(self, allowed: Array, size: Array) -> Array:
        """Return how far the obstacle protrudes into the body, (n,) (length). Collective.

        The distance to the surface of a narrow obstacle is short even if it has pierced Γc. Its tip
        is searched along the normal of Γc.
        """
        depth = -self.distance
        between = np.arange(len(depth)) >= self.places.rows.size  # not at quadrature points
        index = np.flatnonzero(between & (depth > 0) & (depth <= allowed))
        facet, place, toward = self.facet[index], self.z[index], self.toward[index]
        # In the middle of an obstacle there is no normal.
        depth[index[~(np.linalg.norm(toward, axis=1) > 0.5)]] = np.inf
        inward = -self.places.outward(self.field)[facet]
        narrow = self._is_narrow(place, toward, inward, size[index])
        index, place, inward = index[narrow], place[narrow], inward[narrow]
        surface = None
        if self.comm.allreduce(len(index)):
            surface = SurfacePieces.of(self.comm, self.places, self.field, self.facet, allowed)
        reach = allowed[index]
        while self.comm.allreduce(len(index)):
            assert surface is not None
            tip = place + reach[:, None] * inward
            beyond = self.sampler.sample(tip)[0] < 0
            beyond &= reach <= size[index] + allowed[index]
            beyond &= ~surface.is_shallow(tip, -inward)
            index, place, inward = index[beyond], place[beyond], inward[beyond]
            reach = reach[beyond] + DEPTH_RESOLUTION * size[index]
            depth[index] = reach
        return depth

    def _is_narrow(self, places: Array, toward: Array, inward: Array, size: Array) -> Mask:
        """Return whether the obstacle is narrower than facets at places inside of it. Collective.

        ``toward`` and ``inward`` are the unit normals of the obstacle and into the body,
        (n, gdim), ``size`` the sizes of the facets, (n,) (length).
        """
        sideways = np.nan_to_num(toward - dot(toward, inward)[:, None] * inward)
        length = np.linalg.norm(sideways, axis=1, keepdims=True)
        sideways *= size[:, None] / np.where(length > 0, length, 1.0)
        narrow = length[:, 0] > 0
        for direction in (sideways, -sideways):
            narrow &= self.sampler.sample(places + direction)[0] >= 0
        return np.asarray(narrow)

    def find_crossed(self, allowed: Array) -> Array:
        """Return the undeformed positions that crossed the obstacle in the increment. Collective.

        Γc moves along straight lines, the obstacle rotates and changes its shape at constant rates.
        A rotation by more than a right angle is divided, as it may have led through the body.
        """
        n = max(1, int(np.ceil(abs(self.rotation.angle) / MAX_ROTATION)))
        parts = [self._find_crossed_between(k / n, (k + 1) / n, allowed) for k in range(n)]
        return np.concatenate(parts)

    def _at(self, field: Array) -> Array:
        """Interpolate a field of the nodes at the positions."""
        return self.places.values(field, self.facet, self.reference)

    def _nodes_at(self, time: float) -> Array:
        """Return the nodes of Γc at a time from 0 to 1, in the frame of the obstacle."""
        if time in (0.0, 1.0):
            return self.field if time else self.start
        end = self.rotation.rotate(self.field, 1.0)
        return self.rotation.rotate(self.start + time * (end - self.start), -time)

    def _find_crossed_between(self, since: float, until: float, allowed: Array) -> Array:
        """Return the undeformed positions that cross the obstacle between two times. Collective.

        The points of the obstacle that are nearest to positions of Γc at either time are followed.
        They are at rest in its frame, or move straight from the old to the new surface if its shape
        changes. The result has

        - midpoints of facets, if a point enters the body, or has entered it before by the depth
          allowed then, and ends deeper below the facet than is allowed;
        - positions that end on the opposite side of the obstacle, if their point has been inside of
          the body, or the body has passed through the obstacle at the largest depth allowed.
        """
        comm, size = self.comm, self.places.size[self.facet]
        field, field_end = self._nodes_at(since), self._nodes_at(until)
        start, end, distance_end, toward = self._at(field), self.z, self.distance, self.toward
        if until < 1.0:
            end = self._at(field_end)
            distance_end, toward = self.sampler.sample(end)
        toward = np.nan_to_num(toward)
        angle = abs(self.rotation.angle) * (until - since)
        path = np.linalg.norm(self.rotation.rotate(end, until - since) - start, axis=1)
        radius = np.maximum(self.rotation.radius(start), self.rotation.radius(end))
        # A distance changes by no more than the path: positions farther away were not touched, and
        # those inside of the body were outside, or inside by the depth allowed.
        changed = not np.array_equal(self.sampler.committed_shape, self.sampler.shape)
        outward_end = self.places.outward(field_end)
        inside = dot(toward, outward_end[self.facet]) < 0
        before = np.where(inside, ALLOWED_BEFORE * size, 0.0)
        near = changed | ~(distance_end > path + angle * radius + before)
        # A diverged state is not finite, and fails by its residual.
        near = np.flatnonzero(near & np.isfinite(path) & np.isfinite(distance_end))
        if not comm.allreduce(len(near)):
            return self.x[:0]
        start, end, toward = start[near], end[near], toward[near]
        distance, normal = self.sampler.sample(start, since)
        normal = np.nan_to_num(normal)
        closest = start + distance[:, None] * normal, end + distance_end[near, None] * toward
        points = points_end = np.concatenate(closest)
        if changed:
            points = np.concatenate([closest[0], self._project_points(closest[1], since)])
            points_end = np.concatenate([self._project_points(closest[0], until), closest[1]])
        facet, size = self.facet[near], size[near]
        inward, inward_end = -self.places.outward(field)[facet], -outward_end[facet]
        inside = dot(normal, inward) * distance > 0
        entered = np.append(inside & (distance < 0), np.zeros(len(near), dtype=np.bool_))
        entry = np.full(len(points), -1)
        entry[: len(near)] = self._find_entry_pieces(
            closest[0], facet, -inward, inside & (distance >= 0), field
        )
        # Over a time dt a path deviates from its chord by at most |x''| dt² / 8.
        acceleration = (angle**2 * radius + 2 * angle * path)[near] / size
        n = int(np.ceil(np.sqrt(global_max(comm, acceleration) / (8 * DEPTH_RESOLUTION))))
        times: Any = np.linspace(since, until, max(n, 1) + 1)
        self._follow_points(points, points_end, entered, entry, times)
        middles = self._find_pierced_facets(points_end, field_end, entry, allowed)
        opposite = np.flatnonzero(dot(normal, toward) < OPPOSITE_SIDES)
        # Along the path the prediction is unknown. Quadrature points resist.
        between = near >= self.places.rows.size
        depth = (allowed[near] + np.where(between, PREDICTED_DEPTH * size, 0.0))[:, None]
        start, end = start + depth * inward, end + depth * inward_end
        passes = self._find_passages(start[opposite], end[opposite], since, until)
        passes |= entered[opposite]
        return np.concatenate([middles, self.x[near[opposite[passes]]]])

    def _project_points(self, points: Array, time: float) -> Array:
        """Return the nearest points of the obstacle at a time from 0 to 1. Collective."""
        distance, normal = self.sampler.sample(points, time)
        return points + distance[:, None] * np.nan_to_num(normal)

    def _find_entry_pieces(
        self, points: Array, facet: Index, outward: Array, some: Mask, field: Array
    ) -> Index:
        """Find the flat pieces of Γc through which points entered the body before. Collective.

        For each point of the obstacle, in its frame, ``facet`` is the nearest one of this rank, and
        ``outward`` its unit normal. The mask ``some`` selects points.

        Returns:
            Global numbers of the pieces, (n,); -1 for points that are outside, or below another
            surface of a thin body.
        """
        entry = np.full(len(points), -1)
        if self.comm.allreduce(int(some.any())):
            size, height = self.places.size[facet[some]], self.places.facets.heights()
            reach = np.minimum(ALLOWED_BEFORE * size, height[facet[some]] / 2)
            facets = self.places.moving_facets(field, field)
            _, entry[some] = depth_below_surface(
                self.comm, points[some], outward[some], reach, facets
            )
        return entry

    def _follow_points(
        self, start: Array, end: Array, entered: Mask, entry: Index, times: Array
    ) -> None:
        """Follow points of the obstacle through the facets of Γc. Collective.

        Args:
            start: Positions in the frame of the obstacle at the first time, (n, gdim) (length).
            end: Positions in its frame at the last time, (n, gdim) (length).
            entered: Mask of the points that have been inside of the body, (n,); updated.
            entry: Global number of the piece of Γc that each has entered, (n,), else -1; updated.
            times: Times between which Γc moves along straight lines in the obstacle's frame.
        """
        vertices = np.full((len(start), 1), -1)
        fractions = np.linspace(0.0, 1.0, len(times))[:, None, None]
        points, fields = start + fractions * (end - start), [self._nodes_at(t) for t in times]
        for k in range(len(times) - 1):
            facets = self.places.moving_facets(fields[k], fields[k + 1])
            hits = find_crossings(self.comm, points[k], points[k + 1], vertices, facets)
            entered[hits.place[hits.inward]] = True
            final = np.append(np.diff(hits.place) > 0, True)[: len(hits.place)]
            entry[hits.place[final]] = np.where(hits.inward, hits.facet, -1)[final]

    def _find_passages(self, start: Array, end: Array, since: float, until: float) -> Mask:
        """Return which paths lead through the obstacle, by bisection. Collective.

        ``start`` and ``end`` are positions in the frame of the obstacle at two times from 0 to 1,
        (n, gdim) (length).
        """
        passes = np.zeros(len(start), dtype=np.bool_)
        if not self.comm.allreduce(len(start)):
            return passes
        duration = until - since
        distance, first = self.sampler.sample(start, since)
        distance_end, _ = self.sampler.sample(end, until)
        end = self.rotation.rotate(end, duration)
        length = np.linalg.norm(end - start, axis=1) + np.abs(distance) + np.abs(distance_end)
        resolution = length * 2.0 ** (2 - _BISECTIONS)
        low: Array = np.zeros(len(start))
        high: Array = np.ones(len(start))
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            place = start + middle[:, None] * (end - start)
            place = self.rotation.rotate(place, -middle * duration)
            distance, normal = self.sampler.sample(place, since + middle * duration)
            # Continue in the half in which the obstacle is entered, or its normal turns.
            before = (distance >= 0) & (dot(first, normal) > OPPOSITE_SIDES)
            low, high = np.where(before, middle, low), np.where(before, high, middle)
            passes |= distance <= resolution
        return passes

    def _find_pierced_facets(
        self, points: Array, field: Array, entry: Index, allowed: Array
    ) -> Array:
        """Find the facets below which points are deeper than is allowed. Collective.

        For each point of the obstacle, in its frame, ``entry`` is the global number of the piece
        of Γc that it has entered, -1 if it is outside.

        Returns:
            Midpoints of the facets on the undeformed Γc, (m, gdim) (length).
        """
        if not self.comm.allreduce(int((entry >= 0).any())):
            return self.x[:0]
        surface = SurfacePieces.of(self.comm, self.places, field, self.facet, allowed)
        depth = -dot(points - surface.corner[entry], surface.normal[entry])
        rows = np.flatnonzero((entry >= 0) & (depth > surface.allowed[entry]))
        normal = surface.normal[entry[rows]]
        reach = 2 * depth[rows]
        depth, facet = depth_below_surface(self.comm, points[rows], normal, reach, surface.facets)
        is_too_deep = (facet >= 0) & (depth > surface.allowed[facet])
        is_too_deep &= ~surface.is_shallow(points[rows], normal)
        # The wall of a wide obstacle enters beside Γc. There the depth is the distance from it.
        above = points[rows] + depth[:, None] * normal
        distance, toward = self.sampler.sample(above)
        narrow = self._is_narrow(above, toward, -normal, surface.size[facet])
        is_too_deep &= narrow | (distance >= 0)
        return np.asarray(surface.middle[np.unique(facet[is_too_deep])])
