"""Finite sliding between deformable bodies: kinematics at the points of Γc, eq. (3).

A point X of Γc, now at x = X + u, has the opposite point y on its present normal n: x + g n = y
with the gap g. The traction T of a point, per undeformed area, acts on the master as -T. With the
displacement w at the last commit, and the normal n₀ and the position y_w of the present opposite
point at that time, the total slip is

    V = y_w - (X + w(X) + g n₀).

It needs no history of the pairs and is invariant to rigid-body motions of both bodies together. V
and the committed traction are rotated by R, the rotation in the polar decomposition of the
surface's deformation since the commit (tangents and normal).

All of these are functions of the 2 d² local unknowns q = (u(X), ∂u(X), u(Y), ∂u(Y)) of the point, ∂
along the surfaces: the tangent is a matrix by q, point by point, between sparse maps to q.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from petsc4py import PETSc

from fenics_contact.compat import create_csr_matrix
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
    """Γc at the committed displacement: positions, normals and dual tangents (1/length)."""

    x: Array
    normal: Array
    along: Array


@dataclass(frozen=True)
class _Present:
    """Γc and the opposite points at the present displacement.

    Attributes:
        along: Dual tangent vectors a^α, (n_points, d, d - 1) (1/length).
        normal: Unit normals, (n_points, d).
        gap: Gap along the normal, (n_points,) (length); 0 at unpaired points.
        hits: Intersections of the normals with the opposing surface.
        total_slip: V, (n_points, d) (length).
        rotation, stretch: R and Rᵀ F of the surface since the commit, (n_points, d, d).
    """

    along: Array
    normal: Array
    gap: Array
    hits: Hits
    total_slip: Array
    rotation: Array
    stretch: Array


class FiniteSlidingPairs(Pairs):
    """Pairs that follow the bodies: `update` finds them again whenever the displacement changes.

    The constructor is collective, and collects the surfaces.

    Attributes:
        local_jump: Independent variables of the laws: "gap" (length), "normal", "slip" R (V -
            history) (length), and "traction", from which the return map starts (stress).
    """

    def __init__(
        self, name: str, u: fem.Function, quadrature: SurfaceQuadrature, obstacle: DeformableBody
    ) -> None:
        super().__init__(name, u, quadrature, obstacle)
        assert self.search is not None
        self._rays = self.search.rays
        d = self._gdim
        self._committed_u = u.copy()
        self.local_jump = PointFields(quadrature, {"gap": 0, "normal": d, "slip": d, "traction": d})
        self._reference: tuple[Array, Array] | None = None
        self._undeformed: tuple[Array, Array] | None = None
        self._committed: _Committed | None = None
        self._present: _Present | None = None
        self._last_u: Array | None = None
        self._local_map: PETSc.Mat | None = None

    def update(self, x: Array, normal: Array, history: PointFields, traction: PointFields) -> None:
        """Find the opposite points at the present displacement; update `local_jump`. Collective.

        Positions and normals are undeformed; the return map starts from ``traction``, the history
        or multipliers.
        """
        if self._reference is None:
            assert self.search is not None
            xi = self.search.located(x)
            self._reference = xi, normal
            hits, depth = self.search.at_rest(xi, x, normal)
            self._undeformed = np.nan_to_num(hits.distance), depth
        changed = self._last_u is None or not np.array_equal(self._last_u, self._u.x.array)
        if self._mesh.comm.allreduce(int(changed)) or self._present is None:
            self._last_u = self._u.x.array.copy()
            self._find(history)
        self._update_local_jump(history, traction)

    def _find(self, history: PointFields) -> None:
        """Find the opposite points at the present displacement. Collective."""
        assert self._reference is not None and self._undeformed is not None
        assert self.search is not None and self.indicator is not None
        side, facet, (xi, undeformed) = self._rays.slave.facets, self._rays.facet, self._reference
        if self._committed is None:
            x, tangents = side.positions(facet, xi, self._committed_u)
            normal = side.outward_normals(facet, tangents)
            self._committed = _Committed(x, normal, _reciprocal(tangents)[0])
        committed = self._committed
        _, tangents = side.positions(facet, xi, self._u)
        along, is_plane = _reciprocal(tangents)
        self.is_degenerate = bool(self._mesh.comm.allreduce(int(not is_plane.all())))
        normal = side.outward_normals(facet, tangents)
        depth = self.search.largest(history.values("penetration"))
        if not global_max(self._mesh.comm, np.abs(self._committed_u.x.array)) > 0:
            depth = np.maximum(depth, self._undeformed[1])
        hits = self._rays.trace(
            facet, xi, normal, self._u, depth, undeformed=undeformed, before=self._committed_u
        )
        paired = hits.facet >= 0
        # Of bodies in contact without pressure, round-off would close half of the points.
        is_distant = paired & ~(np.abs(hits.distance) <= self.search.round_off)
        gap = np.where(is_distant, hits.distance, 0.0)
        total_slip = hits.partner.before - committed.x - gap[:, None] * committed.normal
        total_slip[~paired] = 0.0
        gradient = np.einsum("qia,qja->qij", tangents, committed.along)
        gradient += normal[:, :, None] * committed.normal[:, None, :]
        rotation = _polar_rotation(gradient)
        stretch = np.einsum("qji,qjk->qik", rotation, gradient)
        self._present = _Present(along, normal, gap, hits, total_slip, rotation, stretch)
        self._set_pairs(hits.matrix(self._u.function_space), paired)
        if self.n_updates == 1:
            self._warn_of_unpaired(hits.reason)
        self._local_map = None

    def jump_increment(self) -> Array:
        """Return the jump since the last commit between the present pairs. Collective."""
        increment = self._u.copy()
        increment.x.array[:] -= self._committed_u.x.array
        return self._product(self.jump_map, increment)

    def _update_local_jump(self, history: PointFields, traction: PointFields) -> None:
        """Update `local_jump` from the present pairs and the initial tractions. Collective."""
        assert self._present is not None
        present = self._present
        slip, start = np.zeros_like(present.normal), np.zeros_like(present.normal)
        if "traction" in history:
            slip = self.rotate(present.total_slip - history.values("jump"))
            start = self.rotate(traction.values("traction"))
        fields = {"gap": present.gap, "normal": present.normal, "slip": slip, "traction": start}
        self.local_jump.assign(fields)

    @cached_property
    def coupling_map(self) -> PETSc.Mat:
        """Map from ``u`` to the nodes on the facets of both surfaces. Collective."""
        assert self.search is not None
        space, sides = self._u.function_space, (self._rays.slave, self._rays.master)
        local = np.concatenate([side.facets.nodes for side in sides])
        nodes = space.dofmap.index_map.local_to_global(local.ravel().astype(np.int32))
        all_rows, nodes = np.arange(len(local)), nodes.reshape(local.shape)
        return interpolation_matrix(space, len(local), all_rows, nodes, np.ones(local.shape))

    @property
    def total_slip(self) -> Array:
        """Total slip V, (n_points, d) (length)."""
        assert self._present is not None
        return self._present.total_slip.copy()

    def rotate(self, vectors: Array, *, inverse: bool = False) -> Array:
        """Return vectors rotated by R from the committed bodies, or back, (n_points, d)."""
        assert self._present is not None
        subscripts = "qij,qi->qj" if inverse else "qij,qj->qi"
        return np.asarray(np.einsum(subscripts, self._present.rotation, vectors))

    def commit(self) -> None:
        """Make the present displacement the committed one."""
        self._committed_u.x.array[:] = self._u.x.array
        self._reset()

    def _reset(self) -> None:
        self._committed = self._present = None

    def is_at_commit(self) -> bool:
        """Whether the present displacement is the committed one. Collective."""
        increment = np.abs(self._u.x.array - self._committed_u.x.array)
        return not global_max(self._mesh.comm, increment) > 0

    def state(self) -> PairsState:
        """Return the committed displacement, from which the pairs follow."""
        pairing = np.zeros(0), self._committed_u.copy(), None
        return PairsState(self.jump_map, None, self.paired, self.n_unpaired, *pairing)

    def set_state(self, state: PairsState) -> None:
        """Restore the committed displacement from `state`. Collective."""
        assert state.pairing_displacement is not None
        self._committed_u.x.array[:] = state.pairing_displacement.x.array
        self._reset()

    @property
    def undeformed_gap(self) -> Array:
        """Gap of the undeformed Γc, 0 at unpaired points, (n_points,) (length)."""
        assert self._undeformed is not None
        return self._undeformed[0]

    def true_gap(self, values: PointValues) -> tuple[Array, Array]:
        """Return gap and normal of the pairs, which are at X + u. Collective."""
        return np.where(self.paired, values.gap, np.nan), values.normal.copy()

    # ---- derivatives -----------------------------------------------------------------------------

    @property
    def local_map(self) -> PETSc.Mat:
        """Map from ``u`` to the local unknowns, (2 d² n_points, n_dofs). Collective."""
        if self._local_map is None:
            self._local_map = self._make_local_map()
        return self._local_map

    def _make_local_map(self) -> PETSc.Mat:
        assert self._reference is not None and self._present is not None
        slave, facet, xi = self._rays.slave.facets, self._rays.facet, self._reference[0]
        space, d, n = self._u.function_space, self._gdim, len(xi)
        partner = self._present.hits.partner
        nodes, weights = slave.interpolation(facet, xi)
        # (n, 2 d) functionals of each component: value and slopes of the slave, then the master.
        values = np.concatenate([weights, partner.weights], axis=1)
        all_nodes = np.concatenate(
            [np.broadcast_to(v[:, None], (n, d, v.shape[1])) for v in (nodes, partner.nodes)],
            axis=1,
        )
        bs = space.dofmap.bs
        values = np.repeat(values[:, :, None], d, axis=2)
        columns = all_nodes[:, :, None] * bs + np.arange(d)[None, None, :, None]
        mask = np.abs(values) > ROUND_OFF
        pointers = np.concatenate([[0], np.cumsum(mask.sum(axis=3).ravel())])
        n_columns = space.dofmap.index_map.size_local * bs
        return create_csr_matrix(space.mesh.comm, n_columns, pointers, columns[mask], values[mask])

    def tangent(self, by_local_jump: Array, traction: Array, history: PointFields) -> Array:
        """Return the derivative of the point forces by the local unknowns, (n_points, 2 d², 2 d²).

        The rows of u(X) and u(Y) have the variation of the traction, those of ∂u(Y) the motion of
        the opposite point along its surface.

        Args:
            by_local_jump: Derivative of the traction by `local_jump`, (n_points, d, 1 + 3 d).
            traction: Traction on the body, (n_points, d) (stress).
            history: The committed state.
        """
        assert self._present is not None and self._committed is not None
        present, committed, d = self._present, self._committed, self._gdim
        n, m = len(present.gap), 2 * d * d
        partner = present.hits.partner
        slave_rows, slave_slopes = slice(0, d), slice(d, d * d)
        master_rows, master_slopes = slice(d * d, d * d + d), slice(d * d + d, m)
        # δn = -a^α (n·δa_α)
        normal = np.zeros((n, d, m))
        normal_by_slopes = -np.einsum("qia,qk->qiak", present.along, present.normal)
        normal[:, :, slave_slopes] = normal_by_slopes.reshape(n, d, d * (d - 1))
        # a_α δξ_α - n δg = δu(X) + g δn - δu(Y)
        right = present.gap[:, None, None] * normal
        right[:, :, slave_rows] += np.eye(d)
        right[:, :, master_rows] -= np.eye(d)
        system = np.concatenate([partner.tangents, -present.normal[:, :, None]], axis=2)
        system[(present.hits.facet < 0) | ~_unit_gram(system)[1]] = np.eye(d)
        solved = np.linalg.solve(system, right)
        slide, gap = solved[:, :-1], solved[:, -1]
        slip_variation = np.einsum("qia,qam->qim", partner.tangents_before, slide)
        slip_variation -= committed.normal[:, :, None] * gap[:, None, :]
        parts = [gap[:, None], normal]
        if "traction" in history:
            slip = present.total_slip - history.values("jump")
            start = np.einsum("qji,qj->qi", present.rotation, self.local_jump.values("traction"))
            spin = self._rotation_variation(normal, slave_slopes)
            zeros = np.zeros_like(slip_variation)
            for vector, variation in ((slip, slip_variation), (start, zeros)):
                variation = variation + _cross(spin, vector)
                parts.append(np.einsum("qij,qjm->qim", present.rotation, variation))
        else:
            parts += [np.zeros((n, d, m))] * 2
        traction_variation = by_local_jump @ np.concatenate(parts, axis=1)
        blocks = np.zeros((n, m, m))
        blocks[:, slave_rows] += traction_variation
        blocks[:, master_rows] -= traction_variation
        blocks[:, master_slopes] -= np.einsum("qi,qam->qaim", traction, slide).reshape(
            n, d * (d - 1), m
        )
        blocks[present.hits.facet < 0] = 0.0
        return blocks

    def _rotation_variation(self, normal: Array, slave_slopes: slice) -> Array:
        """Return Rᵀ δR as axial vectors, in the plane as angles, (n_points, 3 or 1, 2 d²).

        X U + U X = W - Wᵀ with W = Rᵀ δF and the stretch U has the axial vector (tr U - U) x.
        """
        assert self._present is not None and self._committed is not None
        present, committed, d = self._present, self._committed, self._gdim
        if d == 2:
            angle = present.normal[:, :1] * normal[:, 1] - present.normal[:, 1:] * normal[:, 0]
            return np.asarray(angle[:, None])
        n = len(normal)
        gradient = np.einsum("qim,qj->qijm", normal, committed.normal)
        unit = np.eye(d)
        by_slopes = np.einsum("ik,qja->qijak", unit, committed.along).reshape(n, d, d, 2 * d)
        gradient[..., slave_slopes] += by_slopes
        w = np.einsum("qji,qjkm->qikm", present.rotation, gradient)
        skew = w - np.swapaxes(w, 1, 2)
        axial = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
        trace = np.trace(present.stretch, axis1=1, axis2=2)
        return np.linalg.solve(trace[:, None, None] * unit - present.stretch, axial)


@dataclass(frozen=True)
class FiniteSlidingKinematics:
    """`LocalKinematics` at `FiniteSlidingPairs.local_jump`; multipliers replace tractions."""

    multipliers: PointFields | None

    def __call__(self, jump: Any, law: Law, geometry: PointGeometry) -> PointKinematics:
        """Return the local kinematics at the values of `FiniteSlidingPairs.local_jump` (UFL)."""
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


def _unit_gram(vectors: Array) -> tuple[Array, Mask]:
    """Return the Gram matrix of vectors (n, d, m) made unit, and whether they are independent."""
    with np.errstate(all="ignore"):
        unit = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
        gram = np.einsum("qia,qib->qab", unit, unit)
        return gram, np.atleast_1d(np.linalg.det(gram) > ROUND_OFF)


def _reciprocal(tangents: Array) -> tuple[Array, Mask]:
    """Return dual vectors a^α with a^α·a_β = δ_αβ, (n, d, d - 1), and where a plane is spanned."""
    gram, is_plane = _unit_gram(tangents)
    gram[~is_plane] = np.eye(gram.shape[1])
    size = np.linalg.norm(tangents, axis=1, keepdims=True)
    unit = np.zeros_like(tangents)
    np.divide(tangents, size, out=unit, where=is_plane[:, None, None])
    dual = np.swapaxes(np.linalg.solve(gram, np.swapaxes(unit, 1, 2)), 1, 2)
    return np.divide(dual, size, out=np.zeros_like(dual), where=is_plane[:, None, None]), is_plane


def _polar_rotation(gradient: Array) -> Array:
    """Return the rotations of deformation gradients, (n, d, d); the identity if not finite."""
    finite = np.atleast_1d(np.isfinite(gradient).all(axis=(1, 2)))
    gradient = np.where(finite[:, None, None], gradient, np.eye(gradient.shape[1]))
    left, _, right = np.linalg.svd(gradient)
    return np.asarray(left @ right)


def _cross(rotations: Array, vectors: Array) -> Array:
    """Return infinitesimal rotations (axial vectors) times vectors (n, d): (n, d, m)."""
    if rotations.shape[1] == 1:
        perpendicular = np.column_stack([-vectors[:, 1], vectors[:, 0]])
        return perpendicular[:, :, None] * rotations
    return np.asarray(np.cross(rotations, vectors[:, :, None], axis=1), dtype=np.float64)
