"""The pairs of a contact: quadrature points of Γc and their opposite points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from dolfinx import fem
from petsc4py import PETSc

from fenics_contact.contact.values import PointValues
from fenics_contact.obstacles.base import Obstacle
from fenics_contact.obstacles.deformable import DeformableBody
from fenics_contact.parallel import global_mean, global_sum, warn
from fenics_contact.surface.pairing import Pairing
from fenics_contact.surface.rays import REASONS
from fenics_contact.surface.surface import SurfaceQuadrature
from fenics_contact.types import Array, Index, Mask

__all__ = ["Pairs", "PairsState"]


@dataclass(frozen=True)
class PairsState:
    """The attributes of `Pairs` that an update changes."""

    jump_map: PETSc.Mat
    opposite_map: PETSc.Mat | None
    paired: Mask
    n_unpaired: int
    distance: Array
    pairing_displacement: fem.Function | None
    pairing_jump: Array | None


class Pairs:
    """Opposite points, and the sparse map from the dofs to the jump at the quadrature points.

    On a rigid obstacle every point is paired, and there is no opposite map, distance, indicator or
    search. The constructor is collective, and collects the surfaces; `find` finds the pairs.

    Attributes:
        own_map: Map from ``u`` to the displacement of the points, (n_points gdim, n_dofs).
        jump_map: Map from ``u`` to the jump, of the same shape; it depends on the pairs.
        opposite_map: Map to the displacement of the points that the normals meet, not projected;
            None if pairs follow the bodies.
        paired: Mask of this rank's points that have an opposite point, (n_points,).
        n_unpaired: Number of points without an opposite point, on all ranks.
        n_updates: Number of updates of the pairs.
        distance: Distance to the opposite point, a function at the points.
        indicator: 1 at paired points, 0 at others, a function at the points.
        search: Search of the opposing surface.
        pairing_displacement, pairing_jump: Displacement in which the pairs were found, and its
            jump, (n_points, gdim) (length); None for the undeformed bodies.
        is_degenerate: Whether Γc has no tangent plane at a point of any rank, in a diverged trial
            state of pairs that follow the bodies.
    """

    def __init__(
        self, name: str, u: fem.Function, quadrature: SurfaceQuadrature, obstacle: Obstacle
    ) -> None:
        self._name, self._u, self._quadrature = name, u, quadrature
        self._mesh = quadrature.surface.mesh
        self._gdim = self._mesh.geometry.dim
        self.own_map = quadrature.interpolation_matrix(u.function_space)
        self.jump_map: PETSc.Mat = self.own_map
        self.opposite_map: PETSc.Mat | None = None
        self.paired = np.ones(quadrature.n_points, dtype=np.bool_)
        self.n_unpaired = self.n_updates = 0
        self.search: Pairing | None = None
        self.distance: fem.Function | None = None
        self.indicator: fem.Function | None = None
        self.pairing_displacement: fem.Function | None = None
        self.pairing_jump: Array | None = None
        self.is_degenerate = False
        if isinstance(obstacle, DeformableBody):
            self.search = Pairing(obstacle, quadrature, u.function_space)
            self.distance = fem.Function(quadrature.space(), name="distance")
            self.indicator = fem.Function(quadrature.space(), name="paired")

    def find(self, x: Array, normal: Array, depth: Array, u: fem.Function | None) -> None:
        """Find the opposite points in ``u``, or None; points without one are open. Collective.

        Positions x and normals are those of the undeformed Γc, (n_points, gdim); the depth is that
        of the points in the opposing body in ``u``, (n_points,) (length).
        """
        assert self.search and self.distance and self.indicator
        opposite, self.opposite_map, distance, reasons = self.search.pair(x, normal, u, depth)
        self.distance.x.array[: len(distance)] = np.nan_to_num(distance)
        self.distance.x.scatter_forward()
        self._set_pairs(opposite, ~np.isnan(distance))
        self.pairing_displacement = None if u is None else u.copy()
        self.pairing_jump = None if u is None else self._product(self.jump_map, u)
        if self.n_updates == 1:  # later, bodies that slide off each other have more and more
            self._warn_of_unpaired(reasons)

    def _set_pairs(self, opposite: PETSc.Mat, paired: Mask) -> None:
        """Set mask and opposite map of the pairs; the map is destroyed. Collective."""
        assert self.indicator
        self.paired = paired
        self.indicator.x.array[: len(paired)] = paired
        self.indicator.x.scatter_forward()
        jump_map = self.own_map.copy()
        mask = jump_map.createVecLeft()
        mask.array[:] = np.repeat(self.paired, self._gdim)
        jump_map.diagonalScale(mask, None)
        jump_map.axpy(-1.0, opposite, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        opposite.destroy()
        mask.destroy()
        self.jump_map = jump_map
        self.n_updates += 1
        self.n_unpaired = int(global_sum(self._mesh.comm, np.count_nonzero(~paired)))

    def _warn_of_unpaired(self, reasons: Index) -> None:
        """Warn if more than half of the points have no opposite point, with reasons. Collective."""
        comm, n = self._mesh.comm, self._quadrature.n_points
        local = [np.count_nonzero(~self.paired & (reasons == reason)) for reason in REASONS]
        *counts, total = (int(number) for number in global_sum(comm, [*local, n]))
        if 2 * self.n_unpaired > total:
            text = [f"{k}: {why}" for k, why in zip(counts, REASONS.values(), strict=True) if k]
            warn(
                comm,
                f"{self._name}: {self.n_unpaired} of the {total} points of Γc have no opposite "
                f"point and are open ({'; '.join(text)}). Check the tags of Γc and of the opposite "
                "surface, search_distance and max_initial_penetration of the DeformableBody",
            )

    def displacement_size(self, jump: Array) -> Array:
        """Return |u| + |⟦u⟧| at the points, the scale of the round-off of the jump. Collective.

        Args:
            jump: The jump, (n_points, gdim) (length).
        """
        sizes = (np.linalg.norm(each, axis=1) for each in (self.own_displacement(), jump))
        return np.asarray(sum(sizes))

    def state(self) -> PairsState:
        """Return a copy of the pairs."""
        distance = np.zeros(0) if self.distance is None else self.distance.x.array.copy()
        maps, pairing = (
            (self.jump_map, self.opposite_map),
            (self.pairing_displacement, self.pairing_jump),
        )
        return PairsState(*maps, self.paired, self.n_unpaired, distance, *pairing)

    def set_state(self, state: PairsState) -> None:
        """Restore the pairs from `state`. Collective."""
        if self.jump_map is state.jump_map:
            return
        assert self.distance and self.indicator
        self.jump_map, self.opposite_map = state.jump_map, state.opposite_map
        self.paired, self.n_unpaired = state.paired, state.n_unpaired
        self.pairing_displacement, self.pairing_jump = (
            state.pairing_displacement,
            state.pairing_jump,
        )
        self.n_updates += 1  # results of the pairs in between are out of date
        self.distance.x.array[:] = state.distance
        self.indicator.x.array[: self._quadrature.n_points] = self.paired
        self.indicator.x.scatter_forward()

    @property
    def coupling_map(self) -> PETSc.Mat:
        """Map from ``u`` whose columns are the dofs that the pairs may couple. Collective."""
        return self.jump_map

    @property
    def local_map(self) -> PETSc.Mat | None:
        """Map from ``u`` to the local unknowns of derivatives; None if these are by `jump_map`."""
        return None

    def depth(self, normal_displacement: Array) -> Array:
        """Return the penetration into the opposing body without ``gap``, (n_points,) (length)."""
        assert self.distance is not None
        depth = normal_displacement - self.distance.x.array[: self._quadrature.n_points]
        return np.where(self.paired, np.maximum(depth, 0.0), 0.0)

    def displacement_since_pairing(self) -> Array:
        """Return the displacement since pairing relative to the mean of the opposing surface.

        It has shape (n_points, gdim) (length). Collective.
        """
        assert self.search is not None
        change = self._u.copy()
        if self.pairing_displacement is not None:
            change.x.array[:] -= self.pairing_displacement.x.array
        nodes = self.search.rays.master.facets.nodes.ravel()
        mean = global_mean(self._mesh.comm, change.x.array.reshape(-1, self._gdim)[nodes])
        return self._product(self.own_map, change) - mean

    def own_displacement(self) -> Array:
        """Return the displacement of the body of Γc, (n_points, gdim) (length). Collective."""
        return self._product(self.own_map, self._u)

    def _product(self, matrix: PETSc.Mat, u: fem.Function) -> Array:
        """Return a map to the points times u, (n_points, gdim) (length). Collective."""
        product = matrix.createVecLeft()
        matrix.mult(u.x.petsc_vec, product)
        values: Array = product.array_r.reshape(-1, self._gdim).copy()
        product.destroy()
        return values

    def true_gap(self, values: PointValues) -> tuple[Array, Array]:
        """Return gap and normal as in `ContactKinematics.true_placement`. Collective."""
        assert self.search is not None
        depth = self.depth(values.normal_displacement)
        return self.search.true_gap(values.x, self._u, depth)

    def linear_gap(self, normal: Array) -> Array:
        """Return the linearised gap with the opposite displacement not projected, (n_points,).

        It is comparable with `true_gap`, and undefined at unpaired points. Collective.
        """
        assert self.distance and self.opposite_map
        jump = self.own_displacement() - self._product(self.opposite_map, self._u)
        return self.distance.x.array[: len(jump)] - np.sum(jump * normal, axis=1)
