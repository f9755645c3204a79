"""Places of both surfaces of a contact between bodies, where these have moved to."""

from __future__ import annotations

import numpy as np
from dolfinx import fem

from fenics_contact.checks.penetration import (
    OPPOSITE_SIDES,
    ResistedDepth,
    allowed_depth,
    depth_below,
    dot,
    tangent_planes_around,
)
from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import Status
from fenics_contact.parallel import gather_rows, global_max, global_mean, global_min
from fenics_contact.surface.crossings import MovingFacets, find_crossings, largest_depth_on_path
from fenics_contact.surface.facets import across
from fenics_contact.surface.rays import Hits, Rays, Side
from fenics_contact.types import Array, Index, Mask

__all__ = ["OpposingBodyProbe"]


class OpposingBodyProbe:
    """Places of Γc and of the opposite surface, both where their bodies have moved to.

    The constructor follows the present normals of both surfaces to the other one. It is collective.

    Args:
        before: The displacement at the last commit; None: paths are not followed.
        known: An earlier probe, from which on paths were not followed yet.

    Attributes:
        x: Where they are on the undeformed surfaces, those of Γc first, (n, gdim) (length).
        resisted: On the facets of Γc, and on those opposite: corners of facets, (m, n_corners), and
            the penetration of points there that the law resists, (m,) (length).
        u: The displacement.
    """

    def __init__(
        self, contact: Contact, before: fem.Function | None, known: OpposingBodyProbe | None = None
    ) -> None:
        search = contact.pairs.search
        assert search is not None
        self._search, self.u = search, contact.u.copy()
        self._before = before if known is None else known.u
        self._comm = contact.surface.mesh.comm
        self._rows = contact.quadrature.point_rows
        values = contact.values
        here, there = search.rays.here, search.rays.there
        deepest = global_max(self._comm, values.depth)
        near, opposite = search.nearby(self.u, self._before, deepest)
        found = search.present_hits(values.x, contact.u, values.depth, near)
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

    def is_at_commit(self, contact: Contact, before: fem.Function) -> bool:
        """Whether this rank's displacement is that of the last commit."""
        return bool(np.array_equal(self.u.x.array, before.x.array))

    def is_valid_for(self, contact: Contact) -> bool:
        """Whether nothing can be found at the present state that was not there. Collective.

        Both surfaces must have moved less since than they are clear of each other.
        """
        change = (contact.u.x.array - self.u.x.array).reshape(-1, self.x.shape[1])
        ways = [change[side.side.facets.nodes.ravel()] for side in (self._here, self._there)]
        common = global_mean(self._comm, np.concatenate(ways))
        most = (global_max(self._comm, np.linalg.norm(way - common, axis=1)) for way in ways)
        return bool(sum(most) <= self._clear)

    def depth(self, resisted: ResistedDepth) -> tuple[Array, Array]:
        """Penetration at the places, and what is allowed there, (n,) (length). Collective."""
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
        slack = here.side.faceting[on] + there.side.faceting[opposite]
        met = ~np.isnan(np.concatenate([hits.distance, back.distance]))
        # A place opposite stands for the one of Γc that its normal meets.
        foot = there.place + np.nan_to_num(back.distance)[:, None] * there.normal
        planes = depth_below(np.concatenate([here.place, foot]), *(p[on] for p in self._planes))
        planes[on < 0] = -np.inf
        smaller = np.where(met, np.minimum(size, other), np.where(on >= 0, size, other))
        allowed = allowed_depth(deep, planes, size, smaller) + np.where(met, slack, 0.0)
        depth = np.concatenate([_depth(hits, here), _depth(back, there)])
        return np.where(met, depth, 0.0), allowed

    def _tangent_planes(self, resisted: Array) -> tuple[Array, Array]:
        """Those of the opposite surface, of the facets of all ranks, see `tangent_planes_around`.

        Collective.

        Args:
            resisted: Penetration at the points that the law resists, (n_points,) (length).
        """
        n, here = self._rows.size, self._here
        ray, normal = here.normal[:n], _normals(self._hits)[:n]
        through = here.place[:n] + self._hits.distance[:n, None] * ray
        normal = normal * -np.sign(dot(normal, ray))[:, None]
        corners = here.side.corners[here.side.own]
        planes = through[self._rows], normal[self._rows]
        planes = tangent_planes_around(self._comm, corners, resisted[self._rows], *planes)
        through, normal = (gather_rows(self._comm, v) for v in planes)
        return through, normal

    def crossed(self, allowed: Array) -> Array:
        """Find the undeformed places, (n, gdim) (length), that crossed the opposite. Collective.

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
    """Places of one of two surfaces in the bodies displaced by u. The constructor is collective.

    Attributes:
        side: The surface.
        facet, reference: Facet of this rank and reference coordinates of every place.
        number: Of the facet among those of all ranks, (n,).
        undeformed, place: Where the places are, (n, gdim) (length).
        normal: Outward unit normals of the deformed surface there, (n, gdim).
    """

    def __init__(self, side: Side, u: fem.Function, facet: Index, reference: Array) -> None:
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
        through = leaves & (dot(entry, met.normal[last]) < OPPOSITE_SIDES)
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
    return -hits.distance * abs(dot(_normals(hits), side.normal))


def _normals(hits: Hits) -> Array:
    """Unit normals, of any sign, where rays have met a surface, (n, d); 0 where they have not."""
    normal = across(hits.partner.tangents)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.asarray(normal / np.where(length > 0, length, 1.0))
