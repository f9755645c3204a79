"""Positions on both surfaces of a contact between two bodies, in the deformed bodies."""

from __future__ import annotations

import numpy as np
from dolfinx import fem

from fenics_contact.checks.penetration import (
    OPPOSITE_SIDES,
    ResistedDepth,
    allowed_depth,
    dot,
    gather_around,
    predicted_depth,
)
from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import Status
from fenics_contact.parallel import gather_rows, global_max, global_mean, global_min
from fenics_contact.surface.crossings import MovingFacets, find_crossings, max_penetration_on_path
from fenics_contact.surface.facets import across
from fenics_contact.surface.rays import Hits, Rays, Side
from fenics_contact.types import Array, Index, Mask

__all__ = ["OpposingBodyProbe"]


class OpposingBodyProbe:
    """Positions on Γc (slave) and on the opposing surface (master) in the deformed bodies.

    The constructor is collective: it traces the present normals of both surfaces to the other one.

    Args:
        before: Displacement at the last commit; None: paths are not verified.
        committed: Probe of a committed state, up to which paths are verified.

    Attributes:
        x: Undeformed positions, those of Γc first, (n, gdim) (length).
        resisted: For Γc and for the master surface, the corners of facets, (m, n_corners), and the
            penetration of points there that the law resists, (m,) (length).
        u: The displacement.
    """

    def __init__(
        self,
        contact: Contact,
        before: fem.Function | None,
        committed: OpposingBodyProbe | None = None,
    ) -> None:
        search = contact.pairs.search
        assert search is not None
        self._search, self.u = search, contact.u.copy()
        self._before = before if committed is None else committed.u
        self._comm = contact.surface.mesh.comm
        self._rows = contact.quadrature.point_rows
        values = contact.values
        slave, master = search.rays.slave, search.rays.master
        deepest = global_max(self._comm, values.depth)
        near, opposing = search.find_candidate_facets(self.u, self._before, deepest)
        present = search.trace_present(values.x, contact.u, values.depth, near)
        self._slave = _Surface(slave, self.u, present.facet, present.reference)
        self._master = _Surface(master, self.u, *master.facets.lattice(opposing))
        everywhere, n_facets = np.arange(len(self._master.facet)), len(self._master.side.body)
        hits = self._master.trace(search.rays, everywhere, self.u, np.full(n_facets, deepest))
        before = global_max(self._comm, contact.history.values("penetration"))
        self._slave_hits = self._extend_hits(self._slave, present.hits, before)
        self._master_hits = self._extend_hits(self._master, hits, before)
        self.x = np.concatenate([self._slave.undeformed, self._master.undeformed])
        n = contact.quadrature.n_points
        gap, partner = self._slave_hits.distance[:n], self._slave_hits.facet[:n]
        closed = contact.status != Status.OPEN
        resisted = np.maximum(values.penetration, np.where(closed, -np.nan_to_num(gap), 0.0))
        paired = (resisted > 0) & (partner >= 0)
        self.resisted = [
            (slave.corners[slave.own], resisted[self._rows].max(axis=1, initial=0.0)),
            (master.corners[partner[paired]], resisted[paired]),
        ]
        self._around = self._gather_points(resisted)
        # Facets beside the normals may be nearer than the hits; those beyond the `nearby` ones are
        # at least a height away.
        depth, allowed = self.depth(ResistedDepth.of(self._comm, [], []))
        clearance = allowed - np.maximum(depth, 0.0)
        heights = np.concatenate([slave.height, master.height])
        self._clearance = global_min(self._comm, np.append(clearance, heights))

    def _extend_hits(self, surface: _Surface, hits: Hits, deepest: float) -> Hits:
        """Trace positions without a hit that were inside of the other body further. Collective.

        ``deepest`` is the largest penetration of the points at the last commit (length).
        """
        lost = np.flatnonzero(np.isnan(hits.distance))
        if self._before is None or not self._comm.allreduce(len(lost)):
            return hits
        rays, n = self._search.rays, len(surface.side.body)
        committed = surface.trace(rays, lost, self._before, np.full(n, deepest))
        lost = lost[committed.distance < 0]
        if not self._comm.allreduce(len(lost)):
            return hits
        return hits.completed(lost, surface.trace(rays, lost, self.u, np.full(n, np.inf)))

    def is_at_commit(self, contact: Contact, before: fem.Function) -> bool:
        """Whether this rank's displacement is that of the last commit."""
        return bool(np.array_equal(self.u.x.array, before.x.array))

    def is_valid_for(self, contact: Contact) -> bool:
        """Whether both surfaces have moved by less than their clearance since. Collective."""
        change = (contact.u.x.array - self.u.x.array).reshape(-1, self.x.shape[1])
        changes = [change[one.side.facets.nodes.ravel()] for one in (self._slave, self._master)]
        common = global_mean(self._comm, np.concatenate(changes))
        lengths = (global_max(self._comm, np.linalg.norm(c - common, axis=1)) for c in changes)
        return bool(sum(lengths) <= self._clearance)

    def depth(self, resisted: ResistedDepth) -> tuple[Array, Array]:
        """Return penetration and allowed penetration, (n,) each (length). Collective."""
        slave, master, hits = self._slave, self._master, self._master_hits
        # Facets of all ranks: of Γc, and opposing ones.
        on_slave = np.concatenate([slave.number, hits.facet])
        on_master = np.concatenate([self._slave_hits.facet, master.number])
        around_slave, around_master = (
            np.where(number >= 0, resisted.at(surface.side.corners)[number], 0.0)
            for surface, number in ((slave, on_slave), (master, on_master))
        )
        around = np.maximum(around_slave, around_master)
        edges = np.sqrt(self.x.shape[1] - 1)  # in three dimensions lengths are those of diagonals
        size, other = slave.side.length[on_slave] / edges, master.side.length[on_master] / edges
        faceting = slave.side.faceting[on_slave] + master.side.faceting[on_master]
        paired = ~np.isnan(np.concatenate([self._slave_hits.distance, hits.distance]))
        # For positions of the master surface, the prediction is that at their projections onto Γc.
        projection = master.place + np.nan_to_num(hits.distance)[:, None] * master.normal
        positions = np.concatenate([slave.place, projection])
        normals = np.concatenate([_opposite_normals(self._slave_hits, slave), master.normal])
        points = (field[on_slave] for field in self._around)
        predicted = predicted_depth(positions, normals, *points)
        for prediction in predicted:
            prediction[on_slave < 0] = -np.inf
        smaller = np.where(paired, np.minimum(size, other), np.where(on_slave >= 0, size, other))
        allowed = allowed_depth(around, predicted, size, smaller) + np.where(paired, faceting, 0.0)
        depth = np.concatenate([_depth(self._slave_hits, slave), _depth(hits, master)])
        return np.where(paired, depth, 0.0), allowed

    def _gather_points(self, resisted: Array) -> tuple[Array, ...]:
        """Gather points, opposite points and normals there at all facets of Γc. Collective.

        See `gather_around`; ``resisted`` is the penetration that the law resists, (n_points,).
        """
        n, slave = self._rows.size, self._slave
        points = slave.place[:n]
        origins = points + self._slave_hits.distance[:n, None] * slave.normal[:n]
        fields = points, origins, _opposite_normals(self._slave_hits, slave)[:n]
        corners = slave.side.corners[slave.side.own]
        rows = self._rows
        around = gather_around(self._comm, corners, resisted[rows], *(f[rows] for f in fields))
        return tuple(gather_rows(self._comm, field) for field in around)

    def find_crossed(self, allowed: Array) -> Array:
        """Return the undeformed positions that crossed the other surface, (n, gdim). Collective.

        A position has crossed if it entered through a facet and is deeper than is allowed at the
        end, or has left the body through its opposite side.
        """
        if self._before is None:
            return self.x[:0]
        slave, master, n = self._slave, self._master, len(self._slave.facet)
        # The mean translation of both surfaces is removed.
        shift = global_mean(self._comm, slave.place - slave.at(self._before))
        masks = [
            one.find_crossed(self._before, shift, other, allowed[part], _depth(hits, one))
            for one, other, part, hits in (
                (slave, master, slice(n), self._slave_hits),
                (master, slave, slice(n, None), self._master_hits),
            )
        ]
        return self.x[np.concatenate(masks)]


class _Surface:
    """Positions on one surface in the bodies displaced by u. The constructor is collective.

    Attributes:
        side: The surface.
        facet, reference: This rank's facet and reference coordinates of every position.
        number: Global number of the facet, (n,).
        undeformed, place: Undeformed and deformed positions, (n, gdim) (length).
        normal: Outward unit normals of the deformed surface there, (n, gdim).
    """

    def __init__(self, side: Side, u: fem.Function, facet: Index, reference: Array) -> None:
        self._u, self.side = u, side
        self.facet, self.reference, self.number = facet, reference, side.first + facet
        self._comm = side.facets.space.mesh.comm
        self.undeformed, self.place = self.at(None), self.at(u)
        self.normal = side.facets.normals(facet, reference, u)

    def at(self, u: fem.Function | None) -> Array:
        """Return the positions in the bodies displaced by u, (n, gdim) (length)."""
        return self.side.facets.positions(self.facet, self.reference, u)[0]

    def trace(self, rays: Rays, some: Index, u: fem.Function, bound: Array) -> Hits:
        """Trace the normals of the surface to the other one. Collective.

        ``some`` has the indices of the positions, (m,), ``bound`` the penetration bound of every
        facet of the surface (length).
        """
        facet, reference = self.facet[some], self.reference[some]
        facets = self.side.facets
        return rays.trace(
            facet,
            reference,
            facets.normals(facet, reference, u),
            u,
            bound,
            back=self.side is rays.master,
            undeformed=facets.normals(facet, reference),
            before=u,  # for the tangents
        )

    def moving_facets(self, before: fem.Function, shift: Array) -> MovingFacets:
        """Return this rank's facets in the increment, with their start moved by a shift."""
        side, facets = self.side, self.side.facets
        start, end = facets.displaced_corners(before) + shift, facets.displaced_corners(self._u)
        return MovingFacets(start, end, facets.outward, side.vertices[side.own])

    def find_crossed(
        self, before: fem.Function, shift: Array, other: _Surface, allowed: Array, depth: Array
    ) -> Mask:
        """Return which positions have crossed the other surface, (n,). Collective.

        Args:
            before: Displacement at the last commit.
            shift: Mean translation of both surfaces, (gdim,) (length).
            other: The other surface.
            allowed: Allowed penetration, (n,) (length).
            depth: Penetration along the normals, (n,) (length), NaN without a hit. If it is
                positive, the depth below the facet of entry does not count: a position may slide
                on along a curved surface.
        """
        vertices = self.side.vertices[self.number]
        start = self.at(before) + shift
        facets = other.moving_facets(before, shift)
        hits = find_crossings(self._comm, start, self.place, vertices, facets)
        crossed = np.zeros(len(self.facet), dtype=np.bool_)
        n = len(hits.place)
        first = np.append(True, np.diff(hits.place) > 0)[:n]
        last = np.append(np.diff(hits.place) > 0, True)[:n]
        place, leaves = hits.place[last], ~hits.inward[last]
        # A position that was inside from the start has entered through the side at its normal.
        entry = np.where(hits.inward[first][:, None], hits.normal[first], -self.normal[place])
        crossed[place] = leaves & (dot(entry, hits.normal[last]) < OPPOSITE_SIDES)
        penetrates = depth[place] >= 0  # compared with the allowed depth elsewhere
        is_too_deep = ~leaves & ~penetrates & (hits.depth[last] > allowed[place])
        # A position that slides sideways off the body is deep below a facet that it has left.
        index, since = place[is_too_deep], hits.time[last][is_too_deep]
        ends = start[index], self.place[index]
        path = max_penetration_on_path(self._comm, *ends, since, vertices[index], facets)
        crossed[index] |= path > allowed[index]
        return crossed


def _depth(hits: Hits, surface: _Surface) -> Array:
    """Return the depth below the surface hit by the normals, (n,) (length), NaN without a hit."""
    return -hits.distance * abs(dot(_normals(hits), surface.normal))


def _opposite_normals(hits: Hits, surface: _Surface) -> Array:
    """Return the outward unit normals of the surface hit by the normals of another, (n, d)."""
    normal = _normals(hits)
    return normal * -np.sign(dot(normal, surface.normal))[:, None]


def _normals(hits: Hits) -> Array:
    """Return unit normals, of any sign, at the hits of rays, (n, d); 0 without a hit."""
    normal = across(hits.partner.tangents)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.asarray(normal / np.where(length > 0, length, 1.0))
