"""Places of Γc where they are in the frame of a rigid obstacle, and points of that in the body."""

from __future__ import annotations

import numpy as np
from dolfinx import fem

from fenics_contact.checks.obstacle_paths import ObstaclePaths
from fenics_contact.checks.penetration import (
    ALLOWED_BEFORE,
    DEPTH_RESOLUTION,
    OPPOSITE_SIDES,
    ResistedDepth,
    allowed_depth,
    depth_below,
    dot,
    tangent_planes_around,
)
from fenics_contact.checks.surface_pieces import SurfacePieces
from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import Status
from fenics_contact.types import Array, Index, Mask

__all__ = ["RigidObstacleProbe"]

# Steps along a facet towards the place that is deepest in an obstacle.
_DESCENT_STEPS = 12


class RigidObstacleProbe(ObstaclePaths):
    """Places of Γc in the frame of a rigid obstacle, at both ends of an increment.

    Attributes are those of `ObstaclePaths`, and
        resisted: See `Probe`.
        points: The points in the frame of the obstacle, (n_points, gdim) (length).
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

        Args:
            contact: The contact, evaluated.
            u: The displacement; None: of it no more than the points carry.
        """
        opposite, values = contact.opposite, contact.values
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

    def is_of_committed(self, contact: Contact, before: fem.Function) -> bool:
        """See `Probe`: by where the points are in the frame of the obstacle."""
        committed = contact.values.x + contact.opposite.committed_jump
        is_shape = np.array_equal(self._shape, self.sampler.committed_shape)
        return bool(is_shape and np.array_equal(self.points, committed))

    def is_valid_for(self, contact: Contact) -> bool:
        """See `Probe`: of an obstacle that neither turns nor changes its shape."""
        known = np.array_equal(self._shape, self.sampler.shape) and not contact.opposite.turns
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
        """See `Probe`."""
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
