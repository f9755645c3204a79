"""The pairs of a contact: what lies opposite each of its points now."""

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
    """Pairs as they are: see the attributes of `Pairs`."""

    jump_map: PETSc.Mat
    opposite_map: PETSc.Mat | None
    paired: Mask
    n_unpaired: int
    distance: Array
    found_at: fem.Function | None
    pairing_jump: Array | None


class Pairs:
    """Opposites of the points, and the sparse map from displacements to jumps at the points.

    On a rigid obstacle there is nothing to find, and every point has its opposite. The constructor
    is collective, and collects the surfaces; `find` finds the pairs.

    Attributes:
        own_map: From ``u`` to the displacement of the points, (n_points gdim, n_dofs).
        jump_map: Likewise to that relative to what lies opposite; it changes with the pairs.
        opposite_map: To the displacement of the places that normals met, not projected; None on a
            rigid obstacle, and where pairs follow the bodies.
        paired: Which of this rank's points have an opposite, (n_points,).
        n_unpaired: Points without, on all ranks.
        number: How often opposites were found.
        distance: To the opposite, as a function at the points; None on a rigid obstacle.
        acts: 1 at points with an opposite, 0 at others, likewise.
        search: The surface opposite, to search; likewise.
        found_at: Displacement in which the present pairs were found; None: the undeformed bodies.
        found_jump: The jump then, (n_points, gdim) (length); likewise.
        degenerate: Whether pairs that follow the bodies find Γc without a tangent plane at some
            point of any rank: a trial state that has gone astray.
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
        self.n_unpaired = self.number = 0
        self.search: Pairing | None = None
        self.distance: fem.Function | None = None
        self.indicator: fem.Function | None = None
        self.found_at: fem.Function | None = None
        self.pairing_jump: Array | None = None
        self.degenerate = False
        if isinstance(obstacle, DeformableBody):
            self.search = Pairing(obstacle, quadrature, u.function_space)
            self.distance = fem.Function(quadrature.space(), name="distance")
            self.indicator = fem.Function(quadrature.space(), name="paired")

    def find(self, x: Array, normal: Array, depth: Array, u: fem.Function | None) -> None:
        """Find the opposites of all points; those without one are open. Collective.

        Args:
            x: Places of the points, (n_points, gdim).
            normal: Of the undeformed Γc there.
            depth: How deep the points are in the opposite in ``u``, (n_points,) (length).
            u: Displacement in which to find them; None: the undeformed bodies.
        """
        assert self.search and self.distance and self.indicator
        opposite, self.opposite_map, distance, why = self.search.pair(x, normal, u, depth)
        self.distance.x.array[: len(distance)] = np.nan_to_num(distance)
        self.distance.x.scatter_forward()
        self._set_pairs(opposite, ~np.isnan(distance))
        self.found_at = None if u is None else u.copy()
        self.pairing_jump = None if u is None else self._product(self.jump_map, u)
        if self.number == 1:  # of bodies that slide off each other more and more have none
            self._warn_of_unpaired(why)

    def _set_pairs(self, opposite: PETSc.Mat, paired: Mask) -> None:
        """Take the map to what is opposite (used up), and which points have it. Collective."""
        assert self.indicator
        self.paired = paired
        self.indicator.x.array[: len(paired)] = paired
        self.indicator.x.scatter_forward()
        relative = self.own_map.copy()
        mask = relative.createVecLeft()
        mask.array[:] = np.repeat(self.paired, self._gdim)
        relative.diagonalScale(mask, None)
        relative.axpy(-1.0, opposite, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        opposite.destroy()
        mask.destroy()
        self.jump_map = relative
        self.number += 1
        self.n_unpaired = int(global_sum(self._mesh.comm, np.count_nonzero(~paired)))

    def _warn_of_unpaired(self, why: Index) -> None:
        """Say so if more than half of the points have no opposite, and why. Collective."""
        comm, n = self._mesh.comm, self._quadrature.n_points
        lost = [np.count_nonzero(~self.paired & (why == reason)) for reason in REASONS]
        *counts, total = (int(number) for number in global_sum(comm, [*lost, n]))
        if 2 * self.n_unpaired > total:
            told = [f"{k}: {text}" for k, text in zip(counts, REASONS.values(), strict=True) if k]
            warn(
                comm,
                f"{self._name}: {self.n_unpaired} of the {total} points of Γc have no opposite "
                f"point and are open ({'; '.join(told)}). Check the tags of Γc and of the opposite "
                "surface, search_distance and max_initial_penetration of the DeformableBody",
            )

    def state(self) -> PairsState:
        """The pairs as they are; what is found later does not change it."""
        distance = np.zeros(0) if self.distance is None else self.distance.x.array.copy()
        maps, found = (self.jump_map, self.opposite_map), (self.found_at, self.pairing_jump)
        return PairsState(*maps, self.paired, self.n_unpaired, distance, *found)

    def set_state(self, state: PairsState) -> None:
        """Put back what `state` gave. Collective."""
        if self.jump_map is state.jump_map:
            return
        assert self.distance and self.indicator
        self.jump_map, self.opposite_map = state.jump_map, state.opposite_map
        self.paired, self.n_unpaired = state.paired, state.n_unpaired
        self.found_at, self.pairing_jump = state.found_at, state.pairing_jump
        self.number += 1  # what was made of the pairs in between is of others
        self.distance.x.array[:] = state.distance
        self.indicator.x.array[: self._quadrature.n_points] = self.paired
        self.indicator.x.scatter_forward()

    @property
    def reach(self) -> PETSc.Mat:
        """A map whose columns are the dofs that these pairs, or later ones, may couple.

        Collective. Of pairs that stay it is `jump_map`.
        """
        return self.jump_map

    @property
    def local_map(self) -> PETSc.Mat | None:
        """Map from ``u`` to what derivatives at the points are by; None: it is `jump_map`."""
        return None

    def depth(self, normal_displacement: Array) -> Array:
        """Depth of points in the opposite, whatever gap is prescribed: (n_points,) (length)."""
        assert self.distance is not None
        depth = normal_displacement - self.distance.x.array[: self._quadrature.n_points]
        return np.where(self.paired, np.maximum(depth, 0.0), 0.0)

    def displacement_since_pairing(self) -> Array:
        """How far points have moved relative to the surface opposite since pairs were found.

        Collective. That of the surface is the mean of its nodes.

        Returns:
            (n_points, gdim) (length).
        """
        assert self.search is not None
        change = self._u.copy()
        if self.found_at is not None:
            change.x.array[:] -= self.found_at.x.array
        nodes = self.search.rays.there.facets.nodes.ravel()
        other = global_mean(self._mesh.comm, change.x.array.reshape(-1, self._gdim)[nodes])
        return self._product(self.own_map, change) - other

    def own_displacement(self) -> Array:
        """Of the body that has Γc, at the points, (n_points, gdim) (length). Collective."""
        return self._product(self.own_map, self._u)

    def _product(self, matrix: PETSc.Mat, u: fem.Function) -> Array:
        """A map to the points times a displacement, (n_points, gdim) (length). Collective."""
        product = matrix.createVecLeft()
        matrix.mult(u.x.petsc_vec, product)
        values: Array = product.array_r.reshape(-1, self._gdim).copy()
        product.destroy()
        return values

    def true_gap(self, values: PointValues) -> tuple[Array, Array]:
        """See `ContactKinematics.true_placement`. Collective."""
        assert self.search is not None
        depth = self.depth(values.normal_displacement)
        return self.search.true_gap(values.x, self._u, depth)

    def linear_gap(self, normal: Array) -> Array:
        """Linearised gap with the displacement opposite as it is, not projected. Collective.

        To compare with `true_gap`, which is of points as well.

        Args:
            normal: Unit normals of the undeformed Γc, (n_points, gdim).

        Returns:
            (n_points,) (length); of no meaning where there is no opposite.
        """
        assert self.distance and self.opposite_map
        jump = self.own_displacement() - self._product(self.opposite_map, self._u)
        return self.distance.x.array[: len(jump)] - np.sum(jump * normal, axis=1)
