"""What points of Γc feel of a body that deforms as far as theirs: pairs at the present places.

A point X of Γc, now at x = X + u, looks along its present normal n and meets its partner y of the
opposite surface, x + g n = y; g is the gap. Integrals are over the undeformed Γc, and a point's
traction T acts on the partner as -T: the virtual work is -∫ T·(v(X) - v(Y)).

With w the displacement at the last commit, n₀ the normal and y_w the partner then,

    V = y_w - (X + w(X) + g n₀)

is the way in the committed bodies from where the point looked to where its present partner was: the
slip. It needs no history of partners, and a rigid motion of both bodies does not change it. V and
the committed traction are turned by R, the rotation of the surface from its committed tangents and
normal to the present ones (that of the polar decomposition, the turn about the normal included).

Of a point's 2 d² local unknowns q = (u(X), ∂u(X), u(Y), ∂u(Y)), ∂ along the surfaces, all of these
follow: the derivative by all unknowns is C by q, point by point, between sparse maps to q.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from petsc4py import PETSc

from fenics_contact.compat import sparse_matrix
from fenics_contact.contact.pairs import Pairs, PairsState
from fenics_contact.contact.point_geometry import PointGeometry, tangential
from fenics_contact.contact.values import PointValues
from fenics_contact.laws.base import Law, PointKinematics
from fenics_contact.obstacles.deformable import DeformableBody
from fenics_contact.parallel import global_max
from fenics_contact.surface.fields import PointFields
from fenics_contact.surface.rays import Hits, interpolation_matrix
from fenics_contact.surface.surface import SurfaceQuadrature
from fenics_contact.tolerances import ROUND_OFF
from fenics_contact.types import Array, Mask

__all__ = ["FiniteSlidingKinematics", "FiniteSlidingPairs"]


@dataclass(frozen=True)
class _Committed:
    """Γc in the bodies as they were committed, at its points.

    Attributes:
        x: Places, (n_points, d) (length).
        normal: (n_points, d).
        along: Reciprocals of the tangents, across the normal, (n_points, d, d - 1) (1/length).
    """

    x: Array
    normal: Array
    along: Array


@dataclass(frozen=True)
class _Present:
    """Γc and its partners at the present displacement, at its points.

    Attributes:
        along: As in `_Committed`.
        normal: (n_points, d).
        gap: Along it, (n_points,) (length); 0 without a partner.
        hits: What was met.
        way: V, (n_points, d) (length).
        rotation: R, (n_points, d, d).
        stretch: Of the surface from the committed to the present one, Rᵀ F, (n_points, d, d).
    """

    along: Array
    normal: Array
    gap: Array
    hits: Hits
    way: Array
    rotation: Array
    stretch: Array


class FiniteSlidingPairs(Pairs):
    """Pairs that follow the bodies: found anew wherever the displacement has changed.

    The constructor is collective, and collects the surfaces; `follow` finds the pairs.

    Attributes:
        felt: What laws see: "gap" (length), "normal", "slip" R (V - history) (length), "traction"
            from which the law's return map starts (stress).
    """

    def __init__(
        self, name: str, u: fem.Function, quadrature: SurfaceQuadrature, obstacle: DeformableBody
    ) -> None:
        super().__init__(name, u, quadrature, obstacle)
        assert self.search is not None
        self._rays = self.search.rays
        d = self._gdim
        self._before = u.copy()
        self.local_jump = PointFields(quadrature, {"gap": 0, "normal": d, "slip": d, "traction": d})
        self._where: tuple[Array, Array] | None = None
        self._at_rest: tuple[Array, Array] | None = None
        self._committed: _Committed | None = None
        self._present: _Present | None = None
        self._at: Array | None = None
        self._local: PETSc.Mat | None = None

    def follow(self, x: Array, normal: Array, history: PointFields, traction: PointFields) -> None:
        """Find the partners at the present displacement, and what follows from it. Collective.

        Args:
            x: Places of the points in the undeformed body, (n_points, d).
            normal: Of the undeformed Γc there.
            history: The committed state.
            traction: That, or multipliers: what the return map starts from.
        """
        if self._where is None:
            assert self.search is not None
            place = self.search.located(x)
            self._where = place, normal
            met, deep = self.search.at_rest(place, x, normal)
            self._at_rest = np.nan_to_num(met.distance), deep
        changed = self._at is None or not np.array_equal(self._at, self._u.x.array)
        if self._mesh.comm.allreduce(int(changed)) or self._present is None:
            self._at = self._u.x.array.copy()
            self._find(history)
        self._feel(history, traction)

    def _find(self, history: PointFields) -> None:
        """The partners at the present displacement. Collective."""
        assert self._where is not None and self._at_rest is not None
        assert self.search is not None and self.indicator is not None
        here, facet, (place, undeformed) = self._rays.here.facets, self._rays.facet, self._where
        if self._committed is None:
            x, tangents = here.positions(facet, place, self._before)
            normal = here.outward_normals(facet, tangents)
            self._committed = _Committed(x, normal, _reciprocal(tangents)[0])
        before = self._committed
        _, tangents = here.positions(facet, place, self._u)
        along, spans = _reciprocal(tangents)
        self.degenerate = bool(self._mesh.comm.allreduce(int(not spans.all())))
        normal = here.outward_normals(facet, tangents)
        deep = self.search.largest(history.values("penetration"))
        if not global_max(self._mesh.comm, np.abs(self._before.x.array)) > 0:
            deep = np.maximum(deep, self._at_rest[1])
        hits = self._rays.follow(
            facet, place, normal, self._u, deep, undeformed=undeformed, before=self._before
        )
        paired = hits.facet >= 0
        # Of bodies that touch the half of the points would be closed by round-off.
        apart = paired & ~(np.abs(hits.distance) <= self.search.round_off)
        gap = np.where(apart, hits.distance, 0.0)
        way = hits.partner.before - before.x - gap[:, None] * before.normal
        way[~paired] = 0.0
        gradient = np.einsum("qia,qja->qij", tangents, before.along)
        gradient += normal[:, :, None] * before.normal[:, None, :]
        rotation = _polar(gradient)
        stretch = np.einsum("qji,qjk->qik", rotation, gradient)
        self._present = _Present(along, normal, gap, hits, way, rotation, stretch)
        self._set_pairs(hits.matrix(self._u.function_space), paired)
        if self.number == 1:
            self._warn_of_unpaired(hits.reason)
        self._local = None

    def jump_increment(self) -> Array:
        """Displacement relative to the partner since the last commit, (n_points, d). Collective."""
        change = self._u.copy()
        change.x.array[:] -= self._before.x.array
        return self._product(self.jump_map, change)

    def _feel(self, history: PointFields, traction: PointFields) -> None:
        """What laws see, by the tractions to start from as they are. Collective."""
        assert self._present is not None
        now = self._present
        slip, start = np.zeros_like(now.normal), np.zeros_like(now.normal)
        if "traction" in history:
            slip = self.turned(now.way - history.values("jump"))
            start = self.turned(traction.values("traction"))
        values = {"gap": now.gap, "normal": now.normal, "slip": slip, "traction": start}
        self.local_jump.assign(values)

    @cached_property
    def reach(self) -> PETSc.Mat:
        """The nodes on the facets of both surfaces, facet by facet; see `Pairs.reach`."""
        assert self.search is not None
        space, sides = self._u.function_space, (self._rays.here, self._rays.there)
        local = np.concatenate([side.facets.nodes for side in sides])
        nodes = space.dofmap.index_map.local_to_global(local.ravel().astype(np.int32))
        every, nodes = np.arange(len(local)), nodes.reshape(local.shape)
        return interpolation_matrix(space, len(local), every, nodes, np.ones(local.shape))

    @property
    def way(self) -> Array:
        """V, (n_points, d) (length); see the module."""
        assert self._present is not None
        return self._present.way.copy()

    def turned(self, vectors: Array, *, back: bool = False) -> Array:
        """Vectors of the committed bodies as they have turned since, or back, (n_points, d)."""
        assert self._present is not None
        way = "qij,qi->qj" if back else "qij,qj->qi"
        return np.asarray(np.einsum(way, self._present.rotation, vectors))

    def commit(self) -> None:
        """Make the present displacement the committed one."""
        self._before.x.array[:] = self._u.x.array
        self._forget()

    def _forget(self) -> None:
        self._committed = self._present = None

    def is_at_commit(self) -> bool:
        """Whether the present displacement is the committed one. Collective."""
        change = np.abs(self._u.x.array - self._before.x.array)
        return not global_max(self._mesh.comm, change) > 0

    def state(self) -> PairsState:
        """See `Pairs.state`: all follows from the committed displacement."""
        found = np.zeros(0), self._before.copy(), None
        return PairsState(self.jump_map, None, self.paired, self.n_unpaired, *found)

    def set_state(self, state: PairsState) -> None:
        """See `Pairs.set_state`."""
        assert state.found_at is not None
        self._before.x.array[:] = state.found_at.x.array
        self._forget()

    @property
    def undeformed_gap(self) -> Array:
        """See `ContactKinematics.undeformed_gap`."""
        assert self._at_rest is not None
        return self._at_rest[0]

    def true_gap(self, values: PointValues) -> tuple[Array, Array]:
        """See `ContactKinematics.true_placement`: it is that of the pairs themselves."""
        return np.where(self.paired, values.gap, np.nan), values.normal.copy()

    # ---- derivatives -----------------------------------------------------------------------------

    @property
    def local_map(self) -> PETSc.Mat:
        """From ``u`` to the local unknowns of the points, (2 d² n_points, n_dofs). Collective."""
        if self._local is None:
            self._local = self._make_local_map()
        return self._local

    def _make_local_map(self) -> PETSc.Mat:
        assert self._where is not None and self._present is not None
        here, facet, place = self._rays.here.facets, self._rays.facet, self._where[0]
        space, d, n = self._u.function_space, self._gdim, len(place)
        partner = self._present.hits.partner
        nodes, weights = here.interpolation(facet, place)
        # (n, 2 d) functionals of each component, own before the partner's.
        values = np.concatenate([weights, partner.weights], axis=1)
        at = np.concatenate(
            [np.broadcast_to(v[:, None], (n, d, v.shape[1])) for v in (nodes, partner.nodes)],
            axis=1,
        )
        bs = space.dofmap.bs
        values = np.repeat(values[:, :, None], d, axis=2)
        columns = at[:, :, None] * bs + np.arange(d)[None, None, :, None]
        kept = np.abs(values) > ROUND_OFF
        pointers = np.concatenate([[0], np.cumsum(kept.sum(axis=3).ravel())])
        n_columns = space.dofmap.index_map.size_local * bs
        return sparse_matrix(space.mesh.comm, n_columns, pointers, columns[kept], values[kept])

    def tangent(self, by_felt: Array, traction: Array, history: PointFields) -> Array:
        """Derivative of the point's forces on its local unknowns by these.

        Args:
            by_felt: Derivative of the traction by `felt`, (n_points, d, 1 + 3 d).
            traction: On the body, (n_points, d) (stress).
            history: The committed state.

        Returns:
            (n_points, 2 d², 2 d²): rows of u(X) and u(Y) by what of the traction changes, those of
            ∂u(Y) by how the partner moves along its surface.
        """
        assert self._present is not None and self._committed is not None
        now, before, d = self._present, self._committed, self._gdim
        n, m = len(now.gap), 2 * d * d
        partner = now.hits.partner
        own, slopes = slice(0, d), slice(d, d * d)
        other, other_slopes = slice(d * d, d * d + d), slice(d * d + d, m)
        # δn = -a^α (n·δa_α)
        normal = np.zeros((n, d, m))
        across = -np.einsum("qia,qk->qiak", now.along, now.normal)
        normal[:, :, slopes] = across.reshape(n, d, d * (d - 1))
        # a_α δξ_α - n δg = δu(X) + g δn - δu(Y)
        right = now.gap[:, None, None] * normal
        right[:, :, own] += np.eye(d)
        right[:, :, other] -= np.eye(d)
        system = np.concatenate([partner.tangents, -now.normal[:, :, None]], axis=2)
        system[(now.hits.facet < 0) | ~_metric(system)[1]] = np.eye(d)
        solved = np.linalg.solve(system, right)
        slide, gap = solved[:, :-1], solved[:, -1]
        way = np.einsum("qia,qam->qim", partner.tangents_before, slide)
        way -= before.normal[:, :, None] * gap[:, None, :]
        parts = [gap[:, None], normal]
        if "traction" in history:
            ways = now.way - history.values("jump")
            started = np.einsum("qji,qj->qi", now.rotation, self.local_jump.values("traction"))
            turns = self._spin(normal, slopes)
            for vector, change in ((ways, way), (started, np.zeros_like(way))):
                moved = change + _crossed(turns, vector)
                parts.append(np.einsum("qij,qjm->qim", now.rotation, moved))
        else:
            parts += [np.zeros((n, d, m))] * 2
        change = by_felt @ np.concatenate(parts, axis=1)
        blocks = np.zeros((n, m, m))
        blocks[:, own] += change
        blocks[:, other] -= change
        blocks[:, other_slopes] -= np.einsum("qi,qam->qaim", traction, slide).reshape(
            n, d * (d - 1), m
        )
        blocks[now.hits.facet < 0] = 0.0
        return blocks

    def _spin(self, normal: Array, slopes: slice) -> Array:
        """Rᵀ δR as axial vectors, in the plane as angles: (n_points, 3 or 1, 2 d²).

        In space X U + U X = W - Wᵀ with W = Rᵀ δF and the stretch U; the axial vector of its left
        side is (tr U - U) x.
        """
        assert self._present is not None and self._committed is not None
        now, before, d = self._present, self._committed, self._gdim
        if d == 2:
            angle = now.normal[:, :1] * normal[:, 1] - now.normal[:, 1:] * normal[:, 0]
            return np.asarray(angle[:, None])
        n = len(normal)
        gradient = np.einsum("qim,qj->qijm", normal, before.normal)
        unit = np.eye(d)
        own = np.einsum("ik,qja->qijak", unit, before.along).reshape(n, d, d, 2 * d)
        gradient[..., slopes] += own
        w = np.einsum("qji,qjkm->qikm", now.rotation, gradient)
        skew = w - np.swapaxes(w, 1, 2)
        axial = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
        trace = np.trace(now.stretch, axis1=1, axis2=2)
        return np.linalg.solve(trace[:, None, None] * unit - now.stretch, axial)


@dataclass(frozen=True)
class FiniteSlidingKinematics:
    """Numbers of `FiniteSlidingPairs` stand for all that bodies do.

    Attributes:
        multipliers: λ_n and λ_t, which take the place of committed tractions.
    """

    multipliers: PointFields | None

    def __call__(self, jump: Any, law: Law, geometry: PointGeometry) -> PointKinematics:
        """What a law sees of `FiniteSlidingPairs.local_jump` (UFL)."""
        d = len(geometry.normal)
        normal, slip, start = (
            ufl.as_vector([jump[1 + part * d + i] for i in range(d)]) for part in range(3)
        )
        increment = traction = multiplier = None
        if self.multipliers is not None:
            multiplier = self.multipliers.ufl("pressure")
        if law.has_friction:
            increment, traction = tangential(slip, normal), tangential(start, normal)
        return PointKinematics(jump[0], normal, increment, increment, traction, multiplier)


def _metric(vectors: Array) -> tuple[Array, Mask]:
    """That of unit vectors along vectors (n, d, m), and where these span a space: (n,)."""
    with np.errstate(all="ignore"):
        unit = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
        metric = np.einsum("qia,qib->qab", unit, unit)
        return metric, np.atleast_1d(np.linalg.det(metric) > ROUND_OFF)


def _reciprocal(tangents: Array) -> tuple[Array, Mask]:
    """Vectors a^α with a^α·a_β = δ_αβ, in the tangent plane: (n, d, d - 1); or 0 of no plane.

    And where there is a tangent plane, (n,).
    """
    metric, spans = _metric(tangents)
    metric[~spans] = np.eye(metric.shape[1])
    size = np.linalg.norm(tangents, axis=1, keepdims=True)
    unit = np.zeros_like(tangents)
    np.divide(tangents, size, out=unit, where=spans[:, None, None])
    found = np.swapaxes(np.linalg.solve(metric, np.swapaxes(unit, 1, 2)), 1, 2)
    return np.divide(found, size, out=np.zeros_like(found), where=spans[:, None, None]), spans


def _polar(gradient: Array) -> Array:
    """The rotations in gradients, (n, d, d); none in what is not finite."""
    finite = np.atleast_1d(np.isfinite(gradient).all(axis=(1, 2)))
    gradient = np.where(finite[:, None, None], gradient, np.eye(gradient.shape[1]))
    left, _, right = np.linalg.svd(gradient)
    return np.asarray(left @ right)


def _crossed(turns: Array, vectors: Array) -> Array:
    """Small turns times vectors (n, d): (n, d, m)."""
    if turns.shape[1] == 1:
        across = np.column_stack([-vectors[:, 1], vectors[:, 0]])
        return across[:, :, None] * turns
    return np.asarray(np.cross(turns, vectors[:, :, None], axis=1), dtype=np.float64)
