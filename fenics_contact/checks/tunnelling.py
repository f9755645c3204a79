"""Penetration and tunnelling at the deformed positions: between points of Γc, and on their paths.

The contact law acts at the quadrature points of Γc, in the kinematics that the contact was given.
Here the geometry is taken where it is at the end of an increment, X + u, on all of Γc:

- *Depth.* At points, corners, middles of edges and of facets the penetration must not exceed that
  of the nearby points, which the law resists, by more than the tangent planes seen from these
  points explain.
- *Path.* In the increment no such place may enter an opposing body on one side and leave it, or be
  about to, on the other; and no point of a rigid obstacle that is near Γc may enter the body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from dolfinx import fem
from mpi4py import MPI

from fenics_contact.contact.contact import Contact
from fenics_contact.contact.obstacle_sampler import ObstacleSampler
from fenics_contact.contact.values import Status
from fenics_contact.parallel import gather_rows, global_max, global_mean, global_min
from fenics_contact.surface.crossings import MovingFacets, find_crossings, largest_depth_on_path
from fenics_contact.surface.facets import across
from fenics_contact.surface.rays import Hits, Rays, Side
from fenics_contact.types import Array, Index, Mask

__all__ = ["OpposingBodyProbe", "RigidObstacleProbe", "Tunnelling", "TunnellingCheck"]

# Penetration, as a share of the facet, up to which tangent planes at the points around explain more
# than these points resist: of a tilted facet the corner is 0.2 of it away from the nearest point.
# Less of it where no point resists anything.
_PREDICTED_DEPTH, _PREDICTED_UNRESISTED = 0.15, 0.05
# Penetration, as a share of the facet, that two quadrature rules may differ by.
_DEPTH_RESOLUTION = 0.02
# The largest penetration, as a share of the facet, that places without resistance may have been
# allowed at the last commit.
_ALLOWED_BEFORE = _PREDICTED_DEPTH + _DEPTH_RESOLUTION
# Cosine of the angle between the normals of opposite sides of an obstacle: 120 degrees and more.
_OPPOSITE_SIDES = -0.5
# Cosine of the angle between the normals of two faces that meet at an edge: 60 degrees and more.
_EDGE = 0.5
# Rotation (radians), and round-off, over which the displacement is taken as linear in time.
_LINEAR_ROTATION = np.pi / 2 + 1e-9
# Bisections of a path at the place where the normal turns to the opposite side.
_BISECTIONS = 20
# Steps along a facet towards the place that is deepest in an obstacle.
_DESCENT_STEPS = 12


@dataclass(frozen=True)
class ResistedDepth:
    """How deep points are that the law resists, by the vertices of the facets that meet there.

    Attributes:
        vertices: Their global numbers, ascending, (n,).
        depth: The largest penetration of the points on the facets around, (n,) (length).
    """

    vertices: Index
    depth: Array

    @classmethod
    def of(cls, comm: MPI.Comm, vertices: Sequence[Index], depth: Sequence[Array]) -> ResistedDepth:
        """Of facets of all ranks. Collective.

        Args:
            comm: The ranks.
            vertices: Of facets of this rank their corners, (n, n_corners) each.
            depth: Of these facets, (n,) each (length).
        """
        number: Any = np.zeros(0, dtype=np.int64)
        value: Any = np.zeros(0)
        for corners, deep in zip(vertices, depth, strict=True):
            number = np.append(number, corners[deep > 0].ravel())
            value = np.append(value, np.repeat(deep[deep > 0], corners.shape[1]))
        number, value = (np.concatenate(comm.allgather(rows)) for rows in (number, value))
        unique, place = np.unique(number, return_inverse=True)
        largest = np.zeros(len(unique))
        np.maximum.at(largest, place, value)
        return cls(unique, largest)

    def at(self, vertices: Index) -> Array:
        """The largest at the corners of facets, (n, n_corners): (n,) (length), 0 if none."""
        if not len(self.vertices):
            return np.zeros(len(vertices))
        place = np.minimum(np.searchsorted(self.vertices, vertices), len(self.vertices) - 1)
        found = np.where(self.vertices[place] == vertices, self.depth[place], 0.0)
        return np.asarray(found.max(axis=1, initial=0.0))


@dataclass(frozen=True)
class Tunnelling:
    """Penetration of one contact that its points do not resist; the same on every rank.

    Attributes:
        depth: Penetration at the place where it is largest beyond what is allowed (length).
        allowed: What is allowed there (length).
        place: That place of the undeformed surface, (gdim,) (length); None: there is none.
        crossed: A place that has crossed the obstacle in the increment; None: there is none.
    """

    depth: float = 0.0
    allowed: float = 0.0
    place: list[float] | None = None
    crossed: list[float] | None = None

    @classmethod
    def of(cls, comm: MPI.Comm, probe: Probe, resisted: ResistedDepth) -> Tunnelling:
        """Judge the places of one contact. Collective.

        Args:
            comm: The ranks.
            probe: Of the contact.
            resisted: By the points of all contacts.
        """
        depth, allowed = probe.depth(resisted)
        worst = _worst(comm, depth - allowed, np.column_stack([depth, allowed, probe.x]))
        through = probe.crossed(allowed)
        crossed = _worst(comm, np.ones(len(through)), through)
        return cls(
            depth=0.0 if worst is None else float(worst[0]),
            allowed=0.0 if worst is None else float(worst[1]),
            place=None if worst is None else [float(x) for x in worst[2:]],
            crossed=None if crossed is None else [float(x) for x in crossed],
        )

    def failures(self, contact: str) -> list[str]:
        """What does not hold, in words."""
        found = []
        if self.place is not None:
            found.append(
                f"{contact}: what lies opposite penetrates between the quadrature points of Γc, by "
                f"{self.depth:.3e} near {np.round(self.place, 6).tolist()} in the undeformed body, "
                f"where the points around explain {self.allowed:.3e}; refine Γc there or give "
                "ContactSurface a larger quadrature_degree; between two bodies let the finer "
                "surface be Γc, or add a second contact with the surfaces swapped"
            )
        if self.crossed is not None:
            found.append(
                f"{contact}: in one increment a part of Γc has crossed what lies opposite, at "
                f"{np.round(self.crossed, 6).tolist()} in the undeformed body; load in smaller "
                "steps (increments() cuts them by itself), and include in Γc and in the opposite "
                "surface all sides that may touch"
            )
        return found


class TunnellingCheck:
    """Looks at the contacts of a problem, again where they have moved by enough to find anything.

    No distance changes by more than the way. A place that was clear of a penetration that matters
    by more than it has moved since needs no second probe.
    """

    def __init__(self, contacts: Sequence[Contact]) -> None:
        """Take the contacts; of a gap that is prescribed the geometry is not looked at."""
        self._contacts = [
            c
            for c in contacts
            if not c.gap_prescribed and (not c.rigid or c.opposite.sampler is not None)
        ]
        # By contact the last probe of a committed state, and the last one.
        self._committed: dict[str, Any] = {}
        self._last: dict[str, Any] = {}

    def evaluate(self, before: fem.Function | None) -> dict[str, Tunnelling]:
        """Judge the contacts, evaluated at the end of an increment, by their names. Collective.

        Args:
            before: The displacement at the last commit; None: paths are not followed.
        """
        if not self._contacts:
            return {}
        comm = self._contacts[0].surface.mesh.comm
        probes, moved = {}, []
        for contact in self._contacts:
            name = contact.name
            known = None if before is None else self._known(contact, before)
            if known is not None and known.is_valid_for(contact):
                probes[name] = known
                continue
            probe: Probe = (
                RigidObstacleProbe(contact, before, known)
                if contact.rigid
                else OpposingBodyProbe(contact, before, known)
            )
            probes[name] = probe
            moved.append(name)
            self._last[name] = probe
        if not moved:
            return {name: Tunnelling() for name in probes}
        parts = [part for probe in probes.values() for part in probe.resisted]
        vertices, depth = zip(*parts, strict=True)
        resisted = ResistedDepth.of(comm, vertices, depth)
        return {
            name: Tunnelling.of(comm, probe, resisted) if name in moved else Tunnelling()
            for name, probe in probes.items()
        }

    def _known(self, contact: Contact, before: fem.Function) -> Any:
        """The last probe of a committed state; None if there is none. Collective."""
        comm, last = contact.surface.mesh.comm, self._last.get(contact.name)
        # A trial state that was refused may have the displacement, but not the obstacle's place.
        is_trial = last is None or not last.is_of_committed(contact, before)
        if comm.allreduce(int(is_trial)) == 0:
            self._committed[contact.name] = last
        return self._committed.get(contact.name)


def _worst(comm: MPI.Comm, excess: Array, rows: Array) -> Array | None:
    """The row, over all ranks, whose excess is largest, if it is positive. Collective."""
    chosen = excess > 0
    if not comm.allreduce(int(chosen.any())):
        return None
    found = gather_rows(comm, np.column_stack([excess, rows])[chosen])
    worst: Array = found[np.lexsort(found.T[::-1])][-1, 1:]
    return worst


class Probe(Protocol):
    """Places of the surfaces of a contact where the bodies have moved to.

    Attributes:
        x: Where they are on the undeformed surfaces, (n, gdim) (length).
        resisted: Corners of facets of this rank, (m, n_corners), and the penetration of their
            points that the law resists, (m,) (length).
    """

    x: Array
    resisted: list[tuple[Index, Array]]

    def is_of_committed(self, contact: Contact, before: fem.Function) -> bool:
        """Whether this rank's part is of the committed state, whose displacement is before."""

    def is_valid_for(self, contact: Contact) -> bool:
        """Whether nothing can be found at the present state that was not there. Collective."""

    def depth(self, resisted: ResistedDepth) -> tuple[Array, Array]:
        """Penetration at the places, and what is allowed there, (n,) (length). Collective."""

    def crossed(self, allowed: Array) -> Array:
        """Find the undeformed places, (n, gdim) (length), that crossed the opposite. Collective."""


@dataclass(frozen=True)
class _Surface:
    """The flat pieces of Γc.

    Attributes:
        facets: Those of this rank, at rest.
        allowed: Allowed depth below each of all, (n,) (length).
        corner: Its first corner, (n, gdim) (length).
        normal: Its outward unit normal, (n, gdim).
        middle: Its middle on the undeformed Γc, (n, gdim) (length).
    """

    facets: MovingFacets
    allowed: Array
    corner: Array
    normal: Array
    middle: Array


class RigidObstacleProbe:
    """Places of Γc in the frame of a rigid obstacle, at both ends of an increment.

    Attributes:
        x: Where the places are on the undeformed Γc, (n, gdim) (length).
        resisted: See `Probe`.
        points: The points in the frame of the obstacle, (n_points, gdim) (length).
        field: The nodes of Γc in that frame, (n_nodes, gdim) (length); see `FacetPlaces`.
    """

    def __init__(
        self,
        contact: Contact,
        before: fem.Function | None = None,
        known: RigidObstacleProbe | None = None,
    ) -> None:
        """Sample the obstacle at the places and, on each facet, where it is deepest. Collective.

        Args:
            contact: With a rigid obstacle.
            before: The displacement at the last commit; None: it is not known.
            known: An earlier probe, from which on paths were not followed yet.
        """
        opposite, values = contact.opposite, contact.values
        assert opposite.sampler is not None
        self._contact = contact
        self._places = places = contact.facet_places
        self._sampler: ObstacleSampler = opposite.sampler
        self._comm = contact.surface.mesh.comm
        self.points = values.x + values.jump
        self._law_normal = values.normal.copy()
        self._gap, self._normal = self._sampler.sample(self.points)
        self._shape = self._sampler.shape
        self._rotation = opposite.rotation_in_increment(values)
        self.field = self._in_frame(contact, contact.u)
        if known is not None and not opposite.turns:
            self._start = known.field
        else:
            self._start = places.at_nodes(
                values.x + opposite.committed_jump,
                contact.u if before is None else before,
                lambda rest: opposite.in_frame(rest, opposite.committed_angle),
            )
        self._facet, self._reference, self._distance, self._toward = self._deepest()
        self.x, _ = places.facets.positions(self._facet, self._reference)
        self._z = self._at(self.field)
        # What the points do not carry of the displacement they do not explain either.
        carried = places.points_are_nodes
        self._explained = self._z if carried else self._at(self._in_frame(contact, None))
        closed = contact.status != Status.OPEN
        # A penetration that the law knows of is its own matter, with no stiffness as well.
        deep = np.maximum(values.penetration, np.where(closed, -self._gap, 0.0))[places.rows]
        corners = places.facets.corner_vertices()
        self.resisted = [(corners, deep.max(axis=1, initial=0.0))]
        through = self.points + self._gap[:, None] * self._normal
        planes = through[places.rows], -self._normal[places.rows]
        self._planes = _with_those_around(self._comm, corners, deep, *planes)

    def _in_frame(self, contact: Contact, u: fem.Function | None) -> Array:
        """The nodes in the present frame of the obstacle; see `FacetPlaces.at_nodes`. Collective.

        Args:
            contact: The contact, evaluated.
            u: The displacement; None: of it no more than the points carry.
        """
        opposite, values = contact.opposite, contact.values
        return self._places.at_nodes(
            values.x + values.jump,
            u,
            lambda rest: opposite.in_frame(rest, opposite.angle(values)),
        )

    def _at(self, field: Array) -> Array:
        """A field of the nodes at the places."""
        return self._places.values(field, self._facet, self._reference)

    def _deepest(self) -> tuple[Index, Array, Array, Array]:
        """The places of Γc, then those that the obstacle comes closest to between them. Collective.

        From every place the tangential part of the way to the obstacle is followed along the facet:
        alternating projections, which end at the closest places of facet and obstacle.

        Returns:
            Facet, reference coordinates, distance (length), and unit normal towards the obstacle,
            (n, ...).
        """
        places, size = self._places, self._places.size
        facet, at, rows = places.facet, places.reference, places.rows.ravel()
        between = places.values(self.field, facet[rows.size :], at[rows.size :])
        # The points, which come first, are sampled already.
        known, more = (self._gap[rows], self._normal[rows]), self._sampler.sample(between)
        distance, normal = (np.concatenate(both) for both in zip(known, more, strict=True))
        found = [(facet, at, distance, normal)]
        # The distance changes by no more than the way: farther obstacles do not reach the facet.
        going: Mask = distance < size[facet]
        scale: Array = np.ones(len(facet))
        inverse, near = np.swapaxes(self._tangents(self.field), 1, 2), np.unique(facet[going])
        inverse[near] = np.linalg.pinv(np.swapaxes(inverse[near], 1, 2))
        for _ in range(_DESCENT_STEPS):
            facet, at, scale = facet[going], at[going], scale[going]
            distance, normal = distance[going], normal[going]
            step = (scale * np.maximum(distance, 0.1 * size[facet]))[:, None] * normal
            moved = at + np.einsum("nij,nj->ni", inverse[facet], step)
            moved = places.facets.clipped(moved)
            going = np.abs(moved - at).max(axis=1, initial=0.0) > 1e-3
            if not self._comm.allreduce(int(going.any())):
                break
            there, toward = self._sampler.sample(places.values(self.field, facet, moved))
            deeper = going & (there < distance - 1e-3 * size[facet])
            # The step has passed over what is narrower than it.
            scale = np.where(deeper, scale, scale / 2)
            at = np.where(deeper[:, None], moved, at)
            distance = np.where(deeper, there, distance)
            normal = np.where(deeper[:, None], toward, normal)
            found.append((facet[deeper], at[deeper], distance[deeper], normal[deeper]))
        facets, references, distances, normals = map(np.concatenate, zip(*found, strict=True))
        return facets, references, distances, normals

    def _tangents(self, field: Array) -> Array:
        """Edges of all facets in the obstacle's frame, (n_facets, gdim, gdim - 1) (length)."""
        n, d = len(self._places.size), field.shape[1]
        origin, *ends = (
            self._places.values(field, np.arange(n), np.broadcast_to(unit, (n, d - 1)))
            for unit in np.vstack([np.zeros(d - 1), np.eye(d - 1)])
        )
        return np.stack([end - origin for end in ends], axis=2)

    def _outward(self, field: Array) -> Array:
        """Outward unit normals at the first corners of all facets, (n_facets, gdim)."""
        every = np.arange(len(self._places.size))
        return self._places.facets.outward_normals(every, self._tangents(field))

    def is_of_committed(self, contact: Contact, before: fem.Function) -> bool:
        """See `Probe`: by where the points are in the frame of the obstacle."""
        committed = contact.values.x + contact.opposite.committed_jump
        is_shape = np.array_equal(self._shape, self._sampler.committed_shape)
        return bool(is_shape and np.array_equal(self.points, committed))

    def is_valid_for(self, contact: Contact) -> bool:
        """See `Probe`: of an obstacle that neither turns nor changes its shape."""
        known = np.array_equal(self._shape, self._sampler.shape) and not contact.opposite.turns
        moved = self._at(self._in_frame(contact, contact.u)) - self._z
        size = self._places.size[self._facet]
        clear = _DEPTH_RESOLUTION * size + self._distance
        # What has entered the body may go deeper.
        inside = _dot(np.nan_to_num(self._toward), self._outward(self.field)[self._facet]) < 0
        clear -= np.where(inside, _ALLOWED_BEFORE * size, 0.0)
        known = known and bool(np.all(np.linalg.norm(moved, axis=1) <= clear))
        # A point may have come to the opposite side of what is thinner.
        turned = _dot(contact.values.normal, self._law_normal) < _OPPOSITE_SIDES
        known = known and not turned.any()
        return self._comm.allreduce(int(not known)) == 0

    def depth(self, resisted: ResistedDepth) -> tuple[Array, Array]:
        """See `Probe`."""
        places = self._places
        deep = resisted.at(places.facets.corner_vertices())[self._facet]
        planes = _below(self._explained, *(p[self._facet] for p in self._planes))
        size = places.size[self._facet]
        allowed = _allowed(deep, planes, size, size)
        # Deeper in a flat cell it may be nearer to another surface, and `_entered_before` would not
        # know through which one it came.
        most = np.where(deep > 0, np.inf, places.facets.heights()[self._facet] / 2)
        allowed = np.minimum(allowed, most)
        return self._protrusion(allowed, size), allowed

    def _protrusion(self, allowed: Array, size: Array) -> Array:
        """How far the obstacle protrudes into the body at the places, (n,) (length). Collective.

        The shortest way out of an obstacle that is narrower than a facet leads aside, and is short
        however far it has pierced Γc. Its tip is looked for along the normal of Γc.
        """
        depth = -self._distance
        some = np.flatnonzero((depth > 0) & (depth <= allowed))
        facet, place, toward = self._facet[some], self._z[some], self._toward[some]
        # Half way through an obstacle there is no normal.
        depth[some[~(np.linalg.norm(toward, axis=1) > 0.5)]] = np.inf
        inward = -self._outward(self.field)[facet]
        aside = np.nan_to_num(toward - _dot(toward, inward)[:, None] * inward)
        length = np.linalg.norm(aside, axis=1, keepdims=True)
        aside *= size[some, None] / np.where(length > 0, length, 1.0)
        narrow = length[:, 0] > 0
        for way in (aside, -aside):
            narrow &= self._sampler.sample(place + way)[0] >= 0
        some, place, inward = some[narrow], place[narrow], inward[narrow]
        surface = self._surface(self.field, allowed) if self._comm.allreduce(len(some)) else None
        reach = allowed[some]
        while self._comm.allreduce(len(some)):
            assert surface is not None
            tip = place + reach[:, None] * inward
            beyond = self._sampler.sample(tip)[0] < 0
            beyond &= reach <= size[some] + allowed[some]
            beyond &= ~self._is_shallow(tip, -inward, surface)
            some, place, inward = some[beyond], place[beyond], inward[beyond]
            reach = reach[beyond] + _DEPTH_RESOLUTION * size[some]
            depth[some] = reach
        return depth

    def crossed(self, allowed: Array) -> Array:
        """Find the places of Γc that have crossed the obstacle in the increment. Collective.

        In the increment Γc moves along straight lines, while the obstacle rotates, and the
        constants in its distance change, at constant rates. Rotations by more than a right angle
        are divided into equal parts, as an obstacle may have passed through the body and be outside
        of it again at the end.
        """
        n = max(1, int(np.ceil(abs(self._rotation.angle) / _LINEAR_ROTATION)))
        parts = [self._crossed_between(k / n, (k + 1) / n, allowed) for k in range(n)]
        return np.concatenate(parts)

    def _points_at(self, time: float) -> Array:
        """The nodes of Γc at a time from 0 to 1 in the increment, in the frame of the obstacle."""
        if time in (0.0, 1.0):
            return self.field if time else self._start
        end = self._rotation.turned(self.field, 1.0)
        return self._rotation.turned(self._start + time * (end - self._start), -time)

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
        comm, size = self._comm, self._places.size[self._facet]
        field, field_end = self._points_at(since), self._points_at(until)
        start, end, distance_end, toward = self._at(field), self._z, self._distance, self._toward
        if until < 1.0:
            end = self._at(field_end)
            distance_end, toward = self._sampler.sample(end)
        toward = np.nan_to_num(toward)
        angle = abs(self._rotation.angle) * (until - since)
        way = np.linalg.norm(self._rotation.turned(end, until - since) - start, axis=1)
        radius = np.maximum(self._rotation.radius(start), self._rotation.radius(end))
        # A distance changes by no more than the path: what is farther away was not touched, and
        # what is inside of the body was outside, or inside by what was allowed.
        changed = not np.array_equal(self._sampler.committed_shape, self._shape)
        outward_end = self._outward(field_end)
        inside = _dot(toward, outward_end[self._facet]) < 0
        before = np.where(inside, _ALLOWED_BEFORE * size, 0.0)
        near = changed | ~(distance_end > way + angle * radius + before)
        # A diverged state is not finite, and is refused for its residual.
        near = np.flatnonzero(near & np.isfinite(way) & np.isfinite(distance_end))
        if not comm.allreduce(len(near)):
            return self.x[:0]
        start, end, toward = start[near], end[near], toward[near]
        distance, normal = self._sampler.sample(start, since)
        normal = np.nan_to_num(normal)
        feet = start + distance[:, None] * normal, end + distance_end[near, None] * toward
        points = points_end = np.concatenate(feet)
        if changed:
            points = np.concatenate([feet[0], self._nearest(feet[1], since)])
            points_end = np.concatenate([self._nearest(feet[0], until), feet[1]])
        facet, size = self._facet[near], size[near]
        inward, inward_end = -self._outward(field)[facet], -outward_end[facet]
        inside = _dot(normal, inward) * distance > 0
        entered = np.append(inside & (distance < 0), np.zeros(len(near), dtype=np.bool_))
        through = np.full(len(points), -1)
        through[: len(near)] = self._entered_before(
            feet[0], facet, -inward, inside & (distance >= 0), field
        )
        # Between times dt apart a path leaves its chord by no more than |x''| dt² / 8.
        bend = (angle**2 * radius + 2 * angle * way)[near] / size
        n = int(np.ceil(np.sqrt(global_max(comm, bend) / (8 * _DEPTH_RESOLUTION))))
        times: Any = np.linspace(since, until, max(n, 1) + 1)
        self._enter(points, points_end, entered, through, times)
        middles = self._too_deep(points_end, field_end, through, allowed)
        opposite = np.flatnonzero(_dot(normal, toward) < _OPPOSITE_SIDES)
        # On the way the tangent planes are not known.
        depth = (allowed[near] + _PREDICTED_DEPTH * size)[:, None]
        start, end = start + depth * inward, end + depth * inward_end
        passed = self._pass_through(start[opposite], end[opposite], since, until)
        passed |= entered[opposite]
        return np.concatenate([middles, self.x[near[opposite[passed]]]])

    def _nearest(self, points: Array, time: float) -> Array:
        """The nearest points of the obstacle at a time in the increment, (n, gdim). Collective."""
        distance, normal = self._sampler.sample(points, time)
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
        if self._comm.allreduce(int(some.any())):
            size, height = self._places.size[facet[some]], self._places.facets.heights()
            reach = np.minimum(_ALLOWED_BEFORE * size, height[facet[some]] / 2)
            facets = self._places.moving_facets(field, field)
            _, found[some] = self._below(points[some], outward[some], reach, facets)
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
            facets = self._places.moving_facets(fields[k], fields[k + 1])
            met = find_crossings(self._comm, points[k], points[k + 1], vertices, facets)
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
        if not self._comm.allreduce(len(start)):
            return found
        share = until - since
        distance, first = self._sampler.sample(start, since)
        distance_end, _ = self._sampler.sample(end, until)
        end = self._rotation.turned(end, share)
        length = np.linalg.norm(end - start, axis=1) + np.abs(distance) + np.abs(distance_end)
        resolution = length * 2.0 ** (2 - _BISECTIONS)
        low: Array = np.zeros(len(start))
        high: Array = np.ones(len(start))
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            place = start + middle[:, None] * (end - start)
            place = self._rotation.turned(place, -middle * share)
            distance, normal = self._sampler.sample(place, since + middle * share)
            # Into the half in which the obstacle is entered, or its normal turns.
            before = (distance >= 0) & (_dot(first, normal) > _OPPOSITE_SIDES)
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
        if not self._comm.allreduce(int((through >= 0).any())):
            return self.x[:0]
        surface = self._surface(field, allowed)
        depth = -_dot(points - surface.corner[through], surface.normal[through])
        rows = np.flatnonzero((through >= 0) & (depth > surface.allowed[through]))
        normal = surface.normal[through[rows]]
        depth, facet = self._below(points[rows], normal, 2 * depth[rows], surface.facets)
        deep = (facet >= 0) & (depth > surface.allowed[facet])
        deep &= ~self._is_shallow(points[rows], normal, surface)
        return np.asarray(surface.middle[np.unique(facet[deep])])

    def _surface(self, field: Array, allowed: Array) -> _Surface:
        """Collect the flat pieces of Γc on all ranks. Collective.

        Args:
            field: The nodes of Γc in the frame of the obstacle, (n_nodes, gdim) (length).
            allowed: Allowed depth at the places of this rank, (n_places,) (length).
        """
        most: Array = np.zeros(len(self._places.size))
        np.maximum.at(most, self._facet, allowed)
        facets, middles = self._places.moving_facets(field, field), self._places.piece_middles()
        most = np.repeat(most, len(middles) // max(len(most), 1))
        table = np.column_stack([most, facets.start[:, 0], facets.normals(), middles])
        table = gather_rows(self._comm, table)
        return _Surface(facets, table[:, 0], *np.split(table[:, 1:], 3, axis=1))

    def _is_shallow(self, points: Array, normal: Array, surface: _Surface) -> Mask:
        """Find points that are no deeper below another face than is allowed there. Collective.

        At an edge of the body what is deep below one face may have hardly entered the other one.
        Faces opposite to the first one do not count: what is close to them has gone through.

        Args:
            points: (n, gdim) (length).
            normal: Outward unit normal of the facet that each is deep below, (n, gdim).
            surface: Γc.
        """
        depth = -np.einsum("nmd,md->nm", points[:, None] - surface.corner, surface.normal)
        near = (depth >= 0) & (depth <= surface.allowed)
        cosine = normal @ surface.normal.T
        row, facet = np.nonzero(near & (cosine > _OPPOSITE_SIDES) & (cosine < _EDGE))
        reach = 2 * depth[row, facet] + _DEPTH_RESOLUTION * surface.allowed[facet]
        _, met = self._below(points[row], surface.normal[facet], reach, surface.facets)
        found = np.zeros(len(points), dtype=np.bool_)
        found[row[met == facet]] = True
        return found

    def _below(
        self, points: Array, outward: Array, reach: Array, facets: MovingFacets
    ) -> tuple[Array, Index]:
        """How deep points are below Γc, along outward directions. Collective.

        Beside Γc a point is below none of its facets.

        Args:
            points: (n, gdim) (length).
            outward: Unit vectors, (n, gdim).
            reach: How far Γc is looked for, (n,) (length).
            facets: Γc, at rest.

        Returns:
            The depth, (n,) (length), and the number of the facet among those of all ranks, (n,), -1
            for points that are not below Γc.
        """
        vertices, end = np.full((len(points), 1), -1), points + reach[:, None] * outward
        met = find_crossings(self._comm, points, end, vertices, facets)
        first = np.append(True, np.diff(met.place) > 0)[: len(met.place)] & ~met.inward
        place, depth, facet = met.place[first], np.zeros(len(points)), np.full(len(points), -1)
        depth[place], facet[place] = met.time[first] * reach[place], met.facet[first]
        return depth, facet


class OpposingBodyProbe:
    """Places of Γc and of the opposite surface, both where their bodies have moved to.

    Attributes:
        x: Where they are on the undeformed surfaces, those of Γc first, (n, gdim) (length).
        resisted: See `Probe`: on the facets of Γc, and on those opposite.
        u: The displacement.
    """

    def __init__(
        self, contact: Contact, before: fem.Function | None, known: OpposingBodyProbe | None = None
    ) -> None:
        """Follow the present normals of both surfaces to the other one. Collective.

        Args:
            contact: With another body.
            before: The displacement at the last commit; None: paths are not followed.
            known: An earlier probe, from which on paths were not followed yet.
        """
        search = contact.pairs.search
        assert search is not None
        self._search, self.u = search, contact.u.copy()
        self._before = before if known is None else known.u
        self._comm = contact.surface.mesh.comm
        self._rows = contact.quadrature.point_rows()
        values = contact.values
        here, there = search.rays.here, search.rays.there
        deepest = global_max(self._comm, values.depth)
        near, opposite = search.nearby(self.u, self._before, deepest)
        found = search.present_hits(values.x, values.normal, contact.u, values.depth, near)
        self._here = _Side(here, self.u, found.facet, found.reference)
        self._there = _Side(there, self.u, *there.facets.lattice(opposite))
        everywhere, n_back = np.arange(len(self._there.facet)), len(self._there.side.body)
        back = self._there.trace(search.rays, everywhere, self.u, np.full(n_back, deepest))
        before = global_max(self._comm, contact.history.values("penetration"))
        self._hits = self._with_lost(self._here, found.hits, before)
        self._back = self._with_lost(self._there, back, before)
        self.x = np.concatenate([self._here.undeformed, self._there.undeformed])
        n = contact.quadrature.n_points
        gap, partner = self._hits.distance[:n], self._hits.facet[:n]
        closed = contact.status != Status.OPEN
        deep = np.maximum(values.penetration, np.where(closed, -np.nan_to_num(gap), 0.0))
        met = (deep > 0) & (partner >= 0)
        self.resisted = [
            (
                here.corners[here.own],
                deep[self._rows].max(axis=1, initial=0.0),
            ),
            (there.corners[partner[met]], deep[met]),
        ]
        self._planes = self._tangent_planes(deep)
        # What lies aside of the normals may be nearer than what they meet.
        depth, allowed = self.depth(ResistedDepth.of(self._comm, [], []))
        # So may facets beyond the `nearby` ones, which are a height away at least.
        clear = allowed - np.maximum(depth, 0.0)
        heights = np.concatenate([here.height, there.height])
        self._clear = global_min(self._comm, np.append(clear, heights))

    def _with_lost(self, side: _Side, hits: Hits, deepest: float) -> Hits:
        """Find the opposite of places that were inside of the other body and lost it. Collective.

        Rays look as deep as the points are. A place that was inside may have gone deeper.

        Args:
            side: Where the places are.
            hits: What their rays meet.
            deepest: Penetration of the points at the last commit (length).
        """
        lost = np.flatnonzero(np.isnan(hits.distance))
        if self._before is None or not self._comm.allreduce(len(lost)):
            return hits
        rays, n = self._search.rays, len(side.side.body)
        was = side.trace(rays, lost, self._before, np.full(n, deepest))
        lost = lost[was.distance < 0]
        if not self._comm.allreduce(len(lost)):
            return hits
        return hits.completed(lost, side.trace(rays, lost, self.u, np.full(n, np.inf)))

    def is_of_committed(self, contact: Contact, before: fem.Function) -> bool:
        """See `Probe`."""
        return bool(np.array_equal(self.u.x.array, before.x.array))

    def is_valid_for(self, contact: Contact) -> bool:
        """See `Probe`: by the largest displacements on both surfaces since."""
        change = (contact.u.x.array - self.u.x.array).reshape(-1, self.x.shape[1])
        ways = [change[side.side.facets.nodes.ravel()] for side in (self._here, self._there)]
        common = global_mean(self._comm, np.concatenate(ways))
        most = (global_max(self._comm, np.linalg.norm(way - common, axis=1)) for way in ways)
        return bool(sum(most) <= self._clear)

    def depth(self, resisted: ResistedDepth) -> tuple[Array, Array]:
        """See `Probe`."""
        here, there, hits, back = self._here, self._there, self._hits, self._back
        on = np.concatenate([here.number, back.facet])  # the facet of Γc, of those of all ranks
        opposite = np.concatenate([hits.facet, there.number])
        resisted_here, resisted_there = (
            np.where(number >= 0, resisted.at(side.side.corners)[number], 0.0)
            for side, number in ((here, on), (there, opposite))
        )
        deep = np.maximum(resisted_here, resisted_there)
        edges = np.sqrt(self.x.shape[1] - 1)  # lengths are those of diagonals in space
        size, other = here.side.length[on] / edges, there.side.length[opposite] / edges
        slack = self._search.faceting(here.side)[on] + self._search.faceting(there.side)[opposite]
        met = ~np.isnan(np.concatenate([hits.distance, back.distance]))
        # A place opposite stands for the one of Γc that its normal meets.
        foot = there.place + np.nan_to_num(back.distance)[:, None] * there.normal
        planes = _below(np.concatenate([here.place, foot]), *(p[on] for p in self._planes))
        planes[on < 0] = -np.inf
        smaller = np.where(met, np.minimum(size, other), np.where(on >= 0, size, other))
        allowed = _allowed(deep, planes, size, smaller) + np.where(met, slack, 0.0)
        depth = np.concatenate([_depth(hits, here), _depth(back, there)])
        return np.where(met, depth, 0.0), allowed

    def _tangent_planes(self, resisted: Array) -> tuple[Array, Array]:
        """Those of the opposite surface, of the facets of all ranks. Collective.

        Args:
            resisted: Penetration at the points that the law resists, (n_points,) (length).

        Returns:
            See `_with_those_around`.
        """
        n, here = self._rows.size, self._here
        ray, normal = here.normal[:n], _normals(self._hits)[:n]
        through = here.place[:n] + self._hits.distance[:n, None] * ray
        normal = normal * -np.sign(_dot(normal, ray))[:, None]
        corners = here.side.corners[here.side.own]
        planes = through[self._rows], normal[self._rows]
        planes = _with_those_around(self._comm, corners, resisted[self._rows], *planes)
        through, normal = (gather_rows(self._comm, v) for v in planes)
        return through, normal

    def crossed(self, allowed: Array) -> Array:
        """See `Probe`.

        A place has crossed if it came in through a facet and is deeper than is allowed at the end,
        or has left the body through its opposite side.
        """
        if self._before is None:
            return self.x[:0]
        here, there, n = self._here, self._there, len(self._here.facet)
        # What both surfaces have in common of their motion crosses nothing.
        shift = global_mean(self._comm, here.place - here.at(self._before))
        found = [
            one.crossed(self._before, shift, other, allowed[part], _depth(hits, one))
            for one, other, part, hits in (
                (here, there, slice(n), self._hits),
                (there, here, slice(n, None), self._back),
            )
        ]
        return self.x[np.concatenate(found)]


class _Side:
    """Places of one of two surfaces in their deformed bodies.

    Attributes:
        side: The surface.
        facet, reference: Facet of this rank and reference coordinates of every place.
        number: Of the facet among those of all ranks, (n,).
        undeformed, place: Where the places are, (n, gdim) (length).
        normal: Outward unit normals of the deformed surface there, (n, gdim).
    """

    def __init__(self, side: Side, u: fem.Function, facet: Index, reference: Array) -> None:
        """Locate the places. Collective.

        Args:
            side: The surface.
            u: The displacement.
            facet: See the attributes.
            reference: See the attributes.
        """
        self._u, self.side = u, side
        self.facet, self.reference, self.number = facet, reference, side.first + facet
        self._comm = side.facets.space.mesh.comm
        self.undeformed, self.place = self.at(None), self.at(u)
        self.normal = side.facets.normals(facet, reference, u)

    def at(self, u: fem.Function | None) -> Array:
        """The places in the bodies displaced by u, (n, gdim) (length)."""
        return self.side.facets.positions(self.facet, self.reference, u)[0]

    def trace(self, rays: Rays, some: Index, u: fem.Function, deep: Array) -> Hits:
        """What the normals of the surface meet of the other one. Collective.

        Args:
            rays: Between both surfaces.
            some: Numbers of the places, (m,).
            u: Displacement of the bodies.
            deep: Penetration at each of all facets of the surface (length).
        """
        facet, reference = self.facet[some], self.reference[some]
        facets = self.side.facets
        return rays.follow(
            facet,
            reference,
            facets.normals(facet, reference, u),
            u,
            deep,
            back=self.side is rays.there,
            undeformed=facets.normals(facet, reference),
            before=u,  # for the tangents
        )

    def moving(self, before: fem.Function, shift: Array) -> MovingFacets:
        """The facets of this rank in the increment, its start moved by a shift."""
        side, facets = self.side, self.side.facets
        start, end = facets.moved_corners(before) + shift, facets.moved_corners(self._u)
        return MovingFacets(start, end, facets.outward, side.vertices[side.own])

    def crossed(
        self, before: fem.Function, shift: Array, other: _Side, allowed: Array, depth: Array
    ) -> Mask:
        """Which places have crossed the other surface, (n,). Collective.

        Args:
            before: Displacement at the last commit.
            shift: What both surfaces have in common of their motion, (gdim,) (length).
            other: The places of the other surface.
            allowed: Penetration that is allowed, (n,) (length).
            depth: Below what their normals meet, (n,) (length). Of those that are behind it this
                is all that counts: one that slides on along a curved surface leaves the facet
                through which it came in behind.
        """
        vertices = self.side.vertices[self.number]
        start = self.at(before) + shift
        facets = other.moving(before, shift)
        met = find_crossings(self._comm, start, self.place, vertices, facets)
        found = np.zeros(len(self.facet), dtype=np.bool_)
        n = len(met.place)
        first = np.append(True, np.diff(met.place) > 0)[:n]
        last = np.append(np.diff(met.place) > 0, True)[:n]
        place, leaves = met.place[last], ~met.inward[last]
        # Of a place that was inside from the start, through the side that its own normal met.
        entry = np.where(met.inward[first][:, None], met.normal[first], -self.normal[place])
        through = leaves & (_dot(entry, met.normal[last]) < _OPPOSITE_SIDES)
        found[place] = through
        known = depth[place] >= 0  # and compared with what is allowed
        deep = ~leaves & ~known & (met.depth[last] > allowed[place])
        # One that slides on and leaves the body sideways is deep below a facet that it has left.
        which, since = place[deep], met.time[last][deep]
        ends = start[which], self.place[which]
        path = largest_depth_on_path(self._comm, *ends, since, vertices[which], facets)
        found[which] |= path > allowed[which]
        return found


def _depth(hits: Hits, side: _Side) -> Array:
    """How deep places are below what their normals meet, (n,) (length); NaN where they meet none.

    A ray that grazes what it meets is longer than the place is deep below that.
    """
    return -hits.distance * abs(_dot(_normals(hits), side.normal))


def _normals(hits: Hits) -> Array:
    """Unit normals, of any sign, where rays have met a surface, (n, d); 0 where they have not."""
    normal = across(hits.partner.tangents)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.asarray(normal / np.where(length > 0, length, 1.0))


def _with_those_around(
    comm: MPI.Comm, corners: Index, resisted: Array, through: Array, normal: Array
) -> tuple[Array, Array]:
    """Tangent planes that the points of facets see, and one from around each corner. Collective.

    The one is seen by the point that is deepest of those that the law resists on the facets there.
    Where what is opposite ends below a facet, no point of the facet itself may see it.

    Args:
        comm: The ranks.
        corners: Global numbers of the vertices of this rank's facets, (n, n_corners).
        resisted: Penetration at their points that the law resists, (n, n_points) (length).
        through: A place of the plane that each sees, (n, n_points, gdim) (length).
        normal: Outward unit normal of that, (n, n_points, gdim).

    Returns:
        Places and normals, (n, n_points + n_corners, gdim) each, NaN where there is none.
    """
    n, n_corners = corners.shape
    deepest = (np.arange(n), resisted.argmax(axis=1)) if n else (np.arange(0), np.arange(0))
    rows = np.column_stack([-resisted[deepest], through[deepest], normal[deepest]])
    seen = (rows[:, 0] < 0) & ~np.isnan(rows).any(axis=1)
    table = np.repeat(rows[seen], n_corners, axis=0)
    table = gather_rows(comm, np.column_stack([corners[seen].ravel(), table]))
    table = table[np.lexsort(table.T[::-1])]
    vertices, first = np.unique(table[:, 0], return_index=True)
    table = np.concatenate([table[first, 2:], np.full((1, table.shape[1] - 2), np.nan)])
    place = np.searchsorted(vertices, corners)
    place[np.append(vertices, np.nan)[place] != corners] = len(vertices)
    around = np.split(table[place], 2, axis=2)
    return np.append(through, around[0], axis=1), np.append(normal, around[1], axis=1)


def _below(place: Array, through: Array, normal: Array) -> Array:
    """How deep places are below the lowest of planes, (n,) (length); -inf without any.

    Args:
        place: (n, d).
        through: A place of each plane, (n, m, d), NaN where there is none.
        normal: Its outward unit normal, (n, m, d).
    """
    depth = -np.einsum("nqd,nqd->nq", place[:, None] - through, normal)
    return np.where(np.isnan(depth), -np.inf, depth).max(axis=1, initial=-np.inf)


def _allowed(resisted: Array, planes: Array, facet: Array, smaller: Array) -> Array:
    """Penetration that is allowed at places, (n,) (length).

    Args:
        resisted: That of the points around, (n,).
        planes: That by the tangent planes which these points see, (n,).
        facet: Size of the facet of Γc, (n,).
        smaller: Size of the smaller facet that meets there, (n,).
    """
    share = np.where(resisted > 0, _PREDICTED_DEPTH, _PREDICTED_UNRESISTED)
    predicted = np.minimum(planes, resisted + share * facet)
    return np.maximum(resisted, predicted) + _DEPTH_RESOLUTION * smaller


def _dot(one: Array, other: Array) -> Array:
    """Products of vectors, (n,)."""
    return np.asarray(np.einsum("ni,ni->n", one, other))
