"""Places of Γc where they are in the frame of a rigid obstacle, and points of that in the body."""

from __future__ import annotations

from typing import Any

import numpy as np
from dolfinx import fem

from fenics_contact.checks.penetration import (
    ALLOWED_BEFORE,
    DEPTH_RESOLUTION,
    OPPOSITE_SIDES,
    PREDICTED_DEPTH,
    ResistedDepth,
    allowed_depth,
    depth_below,
    dot,
    tangent_planes_around,
)
from fenics_contact.checks.surface_pieces import SurfacePieces, depth_below_surface
from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import Status
from fenics_contact.parallel import global_max
from fenics_contact.surface.crossings import find_crossings
from fenics_contact.types import Array, Index, Mask

__all__ = ["RigidObstacleProbe"]

# Steps along a facet towards the place that is deepest in an obstacle.
_DESCENT_STEPS = 12
# Rotation (radians), and round-off, over which the displacement is taken as linear in time.
_LINEAR_ROTATION = np.pi / 2 + 1e-9
# Bisections of a path at the place where the normal turns to the opposite side.
_BISECTIONS = 20


class RigidObstacleProbe:
    """Places of Γc in the frame of a rigid obstacle, and their paths in an increment.

    The constructor samples the obstacle at the places and, on each facet, where it is deepest. It
    is collective.

    Args:
        before: The displacement at the last commit; None: it is not known.
        known: An earlier probe, from which on paths were not followed yet.

    Attributes:
        x: The places on the undeformed Γc, (n, gdim) (length).
        resisted: Corners of the facets of this rank, (m, n_corners), and the penetration of their
            points that the law resists, (m,) (length).
        comm: The ranks.
        places: Of Γc.
        sampler: The obstacle.
        rotation: Of the obstacle in the increment.
        points: The points in the frame of the obstacle, (n_points, gdim) (length).
        start, field: The nodes of Γc at both ends, (n_nodes, gdim) (length); see `FacetPlaces`.
        facet, reference: Facet of this rank and reference coordinates of every place, (n, ...).
        z: The places at the end, (n, gdim) (length).
        distance: Of the obstacle there, (n,) (length).
        toward: Unit normal towards the obstacle there, (n, gdim).
    """

    def __init__(
        self,
        contact: Contact,
        before: fem.Function | None = None,
        known: RigidObstacleProbe | None = None,
    ) -> None:
        opposite, values = contact.contact_kinematics, contact.values
        assert opposite.sampler is not None
        self.places = places = contact.facet_places
        self.sampler = opposite.sampler
        self.comm = contact.surface.mesh.comm
        self.points = values.x + values.jump
        self._law_normal = values.normal.copy()
        self._gap, self._normal = self.sampler.sample(self.points)
        self._shape = self.sampler.shape
        self.rotation = opposite.rotation_in_increment(values)
        self.field = self._in_frame(contact, contact.u)
        if known is not None and not opposite.turns:
            self.start = known.field
        else:
            self.start = places.at_nodes(
                values.x + opposite.committed_jump,
                contact.u if before is None else before,
                lambda rest: opposite.in_frame(rest, opposite.committed_angle),
            )
        self.facet, self.reference, self.distance, self.toward = self._deepest()
        self.x, _ = places.facets.positions(self.facet, self.reference)
        self.z = self._at(self.field)
        # What the points do not carry of the displacement they do not explain either.
        self._explained = self._at(self._in_frame(contact, None))
        closed = contact.status != Status.OPEN
        # A penetration that the law knows of is its own matter, with no stiffness as well.
        deep = np.maximum(values.penetration, np.where(closed, -self._gap, 0.0))[places.rows]
        corners = places.facets.corner_vertices()
        self.resisted = [(corners, deep.max(axis=1, initial=0.0))]
        through = self.points + self._gap[:, None] * self._normal
        planes = through[places.rows], -self._normal[places.rows]
        self._planes = tangent_planes_around(self.comm, corners, deep, *planes)

    def _in_frame(self, contact: Contact, u: fem.Function | None) -> Array:
        """The nodes in the present frame of the obstacle; see `FacetPlaces.at_nodes`. Collective.

        Without u, the displacement, no more of it than the points carry.
        """
        opposite, values = contact.contact_kinematics, contact.values
        return self.places.at_nodes(
            values.x + values.jump,
            u,
            lambda rest: opposite.in_frame(rest, opposite.angle(values)),
        )

    def _deepest(self) -> tuple[Index, Array, Array, Array]:
        """The places of Γc, then those that the obstacle comes closest to between them. Collective.

        From every place the tangential part of the way to the obstacle is followed along the facet:
        alternating projections, which end at the closest places of facet and obstacle.

        Returns:
            Facet, reference coordinates, distance (length), and unit normal towards the obstacle,
            (n, ...).
        """
        places, size = self.places, self.places.size
        facet, at, rows = places.facet, places.reference, places.rows.ravel()
        between = places.values(self.field, facet[rows.size :], at[rows.size :])
        # The points, which come first, are sampled already.
        known, more = (self._gap[rows], self._normal[rows]), self.sampler.sample(between)
        distance, normal = (np.concatenate(both) for both in zip(known, more, strict=True))
        found = [(facet, at, distance, normal)]
        # The distance changes by no more than the way: farther obstacles do not reach the facet.
        going: Mask = distance < size[facet]
        scale: Array = np.ones(len(facet))
        inverse, near = (
            np.swapaxes(self.places.tangents(self.field), 1, 2),
            np.unique(facet[going]),
        )
        inverse[near] = np.linalg.pinv(np.swapaxes(inverse[near], 1, 2))
        for _ in range(_DESCENT_STEPS):
            facet, at, scale = facet[going], at[going], scale[going]
            distance, normal = distance[going], normal[going]
            step = (scale * np.maximum(distance, 0.1 * size[facet]))[:, None] * normal
            moved = at + np.einsum("nij,nj->ni", inverse[facet], step)
            moved = places.facets.clipped(moved)
            going = np.abs(moved - at).max(axis=1, initial=0.0) > 1e-3
            if not self.comm.allreduce(int(going.any())):
                break
            there, toward = self.sampler.sample(places.values(self.field, facet, moved))
            deeper = going & (there < distance - 1e-3 * size[facet])
            # The step has passed over what is narrower than it.
            scale = np.where(deeper, scale, scale / 2)
            at = np.where(deeper[:, None], moved, at)
            distance = np.where(deeper, there, distance)
            normal = np.where(deeper[:, None], toward, normal)
            found.append((facet[deeper], at[deeper], distance[deeper], normal[deeper]))
        facets, references, distances, normals = map(np.concatenate, zip(*found, strict=True))
        return facets, references, distances, normals

    def is_at_commit(self, contact: Contact, before: fem.Function) -> bool:
        """Whether points and shape of this rank are those of the last commit, in its frame."""
        committed = contact.values.x + contact.contact_kinematics.committed_jump
        is_shape = np.array_equal(self._shape, self.sampler.committed_shape)
        return bool(is_shape and np.array_equal(self.points, committed))

    def is_valid_for(self, contact: Contact) -> bool:
        """Whether nothing can be found at the present state that was not there. Collective.

        The obstacle must not turn or change its shape, and no place move more than it is clear.
        """
        known = (
            np.array_equal(self._shape, self.sampler.shape) and not contact.contact_kinematics.turns
        )
        moved = self._at(self._in_frame(contact, contact.u)) - self.z
        size = self.places.size[self.facet]
        clear = DEPTH_RESOLUTION * size + self.distance
        # What has entered the body may go deeper.
        inside = dot(np.nan_to_num(self.toward), self.places.outward(self.field)[self.facet]) < 0
        clear -= np.where(inside, ALLOWED_BEFORE * size, 0.0)
        known = known and bool(np.all(np.linalg.norm(moved, axis=1) <= clear))
        # A point may have come to the opposite side of what is thinner.
        turned = dot(contact.values.normal, self._law_normal) < OPPOSITE_SIDES
        known = known and not turned.any()
        return self.comm.allreduce(int(not known)) == 0

    def depth(self, resisted: ResistedDepth) -> tuple[Array, Array]:
        """Penetration at the places, and what is allowed there, (n,) (length). Collective."""
        places = self.places
        deep = resisted.at(places.facets.corner_vertices())[self.facet]
        planes = depth_below(self._explained, *(p[self.facet] for p in self._planes))
        size = places.size[self.facet]
        allowed = allowed_depth(deep, planes, size, size)
        # Deeper in a flat cell it may be nearer to another surface, and `_entered_before` would not
        # know through which one it came.
        most = np.where(deep > 0, np.inf, places.facets.heights()[self.facet] / 2)
        allowed = np.minimum(allowed, most)
        return self._protrusion(allowed, size), allowed

    def _protrusion(self, allowed: Array, size: Array) -> Array:
        """How far the obstacle protrudes into the body at the places, (n,) (length). Collective.

        The shortest way out of an obstacle that is narrower than a facet leads aside, and is short
        however far it has pierced Γc. Its tip is looked for along the normal of Γc.
        """
        depth = -self.distance
        some = np.flatnonzero((depth > 0) & (depth <= allowed))
        facet, place, toward = self.facet[some], self.z[some], self.toward[some]
        # Half way through an obstacle there is no normal.
        depth[some[~(np.linalg.norm(toward, axis=1) > 0.5)]] = np.inf
        inward = -self.places.outward(self.field)[facet]
        aside = np.nan_to_num(toward - dot(toward, inward)[:, None] * inward)
        length = np.linalg.norm(aside, axis=1, keepdims=True)
        aside *= size[some, None] / np.where(length > 0, length, 1.0)
        narrow = length[:, 0] > 0
        for way in (aside, -aside):
            narrow &= self.sampler.sample(place + way)[0] >= 0
        some, place, inward = some[narrow], place[narrow], inward[narrow]
        surface = None
        if self.comm.allreduce(len(some)):
            surface = SurfacePieces.of(self.comm, self.places, self.field, self.facet, allowed)
        reach = allowed[some]
        while self.comm.allreduce(len(some)):
            assert surface is not None
            tip = place + reach[:, None] * inward
            beyond = self.sampler.sample(tip)[0] < 0
            beyond &= reach <= size[some] + allowed[some]
            beyond &= ~surface.is_shallow(tip, -inward)
            some, place, inward = some[beyond], place[beyond], inward[beyond]
            reach = reach[beyond] + DEPTH_RESOLUTION * size[some]
            depth[some] = reach
        return depth

    def crossed(self, allowed: Array) -> Array:
        """Find the places of Γc that have crossed the obstacle in the increment. Collective.

        In the increment Γc moves along straight lines, while the obstacle rotates, and the
        constants in its distance change, at constant rates. Rotations by more than a right angle
        are divided into equal parts, as an obstacle may have passed through the body and be outside
        of it again at the end.
        """
        n = max(1, int(np.ceil(abs(self.rotation.angle) / _LINEAR_ROTATION)))
        parts = [self._crossed_between(k / n, (k + 1) / n, allowed) for k in range(n)]
        return np.concatenate(parts)

    def _at(self, field: Array) -> Array:
        """A field of the nodes at the places."""
        return self.places.values(field, self.facet, self.reference)

    def _points_at(self, time: float) -> Array:
        """The nodes of Γc at a time from 0 to 1 in the increment, in the frame of the obstacle."""
        if time in (0.0, 1.0):
            return self.field if time else self.start
        end = self.rotation.turned(self.field, 1.0)
        return self.rotation.turned(self.start + time * (end - self.start), -time)

    def _crossed_between(self, since: float, until: float, allowed: Array) -> Array:
        """Find the undeformed places that cross the obstacle between two times. Collective.

        Points of the obstacle are followed, those nearest to places of Γc at either time. In the
        frame of the obstacle they are at rest; where its shape changes they go straight between the
        old surface and the new one. It has crossed

        - a facet, if a point enters the body, or has entered it before by what was allowed then,
          and ends deeper below the facet than is allowed; its middle is returned;
        - a place that ends on the opposite side of the obstacle, if its point has been inside of
          the body, or what is below the place, by the largest depth that is explained, has passed
          through the obstacle.
        """
        comm, size = self.comm, self.places.size[self.facet]
        field, field_end = self._points_at(since), self._points_at(until)
        start, end, distance_end, toward = self._at(field), self.z, self.distance, self.toward
        if until < 1.0:
            end = self._at(field_end)
            distance_end, toward = self.sampler.sample(end)
        toward = np.nan_to_num(toward)
        angle = abs(self.rotation.angle) * (until - since)
        way = np.linalg.norm(self.rotation.turned(end, until - since) - start, axis=1)
        radius = np.maximum(self.rotation.radius(start), self.rotation.radius(end))
        # A distance changes by no more than the path: what is farther away was not touched, and
        # what is inside of the body was outside, or inside by what was allowed.
        changed = not np.array_equal(self.sampler.committed_shape, self.sampler.shape)
        outward_end = self.places.outward(field_end)
        inside = dot(toward, outward_end[self.facet]) < 0
        before = np.where(inside, ALLOWED_BEFORE * size, 0.0)
        near = changed | ~(distance_end > way + angle * radius + before)
        # A diverged state is not finite, and is refused for its residual.
        near = np.flatnonzero(near & np.isfinite(way) & np.isfinite(distance_end))
        if not comm.allreduce(len(near)):
            return self.x[:0]
        start, end, toward = start[near], end[near], toward[near]
        distance, normal = self.sampler.sample(start, since)
        normal = np.nan_to_num(normal)
        feet = start + distance[:, None] * normal, end + distance_end[near, None] * toward
        points = points_end = np.concatenate(feet)
        if changed:
            points = np.concatenate([feet[0], self._nearest(feet[1], since)])
            points_end = np.concatenate([self._nearest(feet[0], until), feet[1]])
        facet, size = self.facet[near], size[near]
        inward, inward_end = -self.places.outward(field)[facet], -outward_end[facet]
        inside = dot(normal, inward) * distance > 0
        entered = np.append(inside & (distance < 0), np.zeros(len(near), dtype=np.bool_))
        through = np.full(len(points), -1)
        through[: len(near)] = self._entered_before(
            feet[0], facet, -inward, inside & (distance >= 0), field
        )
        # Between times dt apart a path leaves its chord by no more than |x''| dt² / 8.
        bend = (angle**2 * radius + 2 * angle * way)[near] / size
        n = int(np.ceil(np.sqrt(global_max(comm, bend) / (8 * DEPTH_RESOLUTION))))
        times: Any = np.linspace(since, until, max(n, 1) + 1)
        self._enter(points, points_end, entered, through, times)
        middles = self._too_deep(points_end, field_end, through, allowed)
        opposite = np.flatnonzero(dot(normal, toward) < OPPOSITE_SIDES)
        # On the way the tangent planes are not known.
        depth = (allowed[near] + PREDICTED_DEPTH * size)[:, None]
        start, end = start + depth * inward, end + depth * inward_end
        passed = self._pass_through(start[opposite], end[opposite], since, until)
        passed |= entered[opposite]
        return np.concatenate([middles, self.x[near[opposite[passed]]]])

    def _nearest(self, points: Array, time: float) -> Array:
        """The nearest points of the obstacle at a time in the increment, (n, gdim). Collective."""
        distance, normal = self.sampler.sample(points, time)
        return points + distance[:, None] * np.nan_to_num(normal)

    def _entered_before(
        self, points: Array, facet: Index, outward: Array, some: Mask, field: Array
    ) -> Index:
        """Find the flat pieces of Γc through which points entered the body before. Collective.

        Args:
            points: Of the obstacle, in its frame, (n, gdim) (length).
            facet: Facet of this rank that each is nearest to, (n,).
            outward: Its outward unit normal, (n, gdim).
            some: Which of the points are looked at, (n,).
            field: The nodes of Γc in that frame, (n_nodes, gdim) (length).

        Returns:
            Their numbers among those of all ranks, (n,); -1 for points that are outside, or below
            another surface of a thin body.
        """
        found = np.full(len(points), -1)
        if self.comm.allreduce(int(some.any())):
            size, height = self.places.size[facet[some]], self.places.facets.heights()
            reach = np.minimum(ALLOWED_BEFORE * size, height[facet[some]] / 2)
            facets = self.places.moving_facets(field, field)
            _, found[some] = depth_below_surface(
                self.comm, points[some], outward[some], reach, facets
            )
        return found

    def _enter(self, start: Array, end: Array, entered: Mask, through: Index, times: Array) -> None:
        """Follow points of the obstacle through the facets of Γc. Collective.

        Args:
            start: In the frame of the obstacle at first, (n, gdim) (length).
            end: In that at last, (n, gdim) (length).
            entered: Which points are inside of the body at first, (n,); afterwards, which have
                been.
            through: The flat piece of Γc, of those of all ranks, through which each has entered the
                body, (n,); afterwards, too, and -1 for those that have left it.
            times: In the increment, between which Γc goes straight on in the obstacle's frame.
        """
        vertices = np.full((len(start), 1), -1)
        shares = np.linspace(0.0, 1.0, len(times))[:, None, None]
        points, fields = start + shares * (end - start), [self._points_at(t) for t in times]
        for k in range(len(times) - 1):
            facets = self.places.moving_facets(fields[k], fields[k + 1])
            met = find_crossings(self.comm, points[k], points[k + 1], vertices, facets)
            entered[met.place[met.inward]] = True
            final = np.append(np.diff(met.place) > 0, True)[: len(met.place)]
            through[met.place[final]] = np.where(met.inward, met.facet, -1)[final]

    def _pass_through(self, start: Array, end: Array, since: float, until: float) -> Mask:
        """Whether places pass through the obstacle, by bisection of their paths. Collective.

        Args:
            start: In the frame of the obstacle at first, (n, gdim) (length).
            end: In that at last, (n, gdim) (length).
            since: First time in the increment, from 0 to 1.
            until: Last time in the increment, from 0 to 1.
        """
        found = np.zeros(len(start), dtype=np.bool_)
        if not self.comm.allreduce(len(start)):
            return found
        share = until - since
        distance, first = self.sampler.sample(start, since)
        distance_end, _ = self.sampler.sample(end, until)
        end = self.rotation.turned(end, share)
        length = np.linalg.norm(end - start, axis=1) + np.abs(distance) + np.abs(distance_end)
        resolution = length * 2.0 ** (2 - _BISECTIONS)
        low: Array = np.zeros(len(start))
        high: Array = np.ones(len(start))
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            place = start + middle[:, None] * (end - start)
            place = self.rotation.turned(place, -middle * share)
            distance, normal = self.sampler.sample(place, since + middle * share)
            # Into the half in which the obstacle is entered, or its normal turns.
            before = (distance >= 0) & (dot(first, normal) > OPPOSITE_SIDES)
            low, high = np.where(before, middle, low), np.where(before, high, middle)
            found |= distance <= resolution
        return found

    def _too_deep(self, points: Array, field: Array, through: Index, allowed: Array) -> Array:
        """Find the facets below which points are deeper than is allowed there. Collective.

        Args:
            points: Of the obstacle, in its frame, (n, gdim) (length).
            field: The nodes of Γc in that frame, (n_nodes, gdim) (length).
            through: See `_enter`.
            allowed: Allowed depth at the places of this rank, (n_places,) (length).

        Returns:
            Their middles on the undeformed Γc, (m, gdim) (length).
        """
        if not self.comm.allreduce(int((through >= 0).any())):
            return self.x[:0]
        surface = SurfacePieces.of(self.comm, self.places, field, self.facet, allowed)
        depth = -dot(points - surface.corner[through], surface.normal[through])
        rows = np.flatnonzero((through >= 0) & (depth > surface.allowed[through]))
        normal = surface.normal[through[rows]]
        reach = 2 * depth[rows]
        depth, facet = depth_below_surface(self.comm, points[rows], normal, reach, surface.facets)
        deep = (facet >= 0) & (depth > surface.allowed[facet])
        deep &= ~surface.is_shallow(points[rows], normal)
        return np.asarray(surface.middle[np.unique(facet[deep])])
