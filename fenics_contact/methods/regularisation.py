"""Regularisation of the consistent tangent along rigid-body modes that contact does not constrain.

With open or slipping points the tangent may be singular. The added stiffness vanishes with the
unbalanced forces on these modes: convergence remains superlinear (Levenberg-Marquardt).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fenics_contact.contact.values import Status
from fenics_contact.parallel import broadcast_from_root
from fenics_contact.systems.operator import ContactOperator
from fenics_contact.systems.reference_scales import ReferenceScales
from fenics_contact.systems.rigid_body_modes import RigidBodyModes
from fenics_contact.tolerances import NEGLIGIBLE
from fenics_contact.types import Array, Index, Mask

__all__ = ["UnconstrainedModes"]

_STEP_GAP_RATIO = 2.0  # step along an open mode relative to the gap, which half of it closes
_MIN_GAP_RATIO = 1e-64  # least gap relative to the mesh size; its inverse cube does not overflow


@dataclass(frozen=True)
class UnconstrainedModes:
    """Unconstrained rigid-body modes at an evaluated state, the same on every rank.

    Attributes:
        imbalance: Largest unbalanced fraction of the forces on a mode of every group of coupled
            bodies, 0 to 1, or NaN without such modes, (n_groups,).
        is_open: Groups with modes that are unconstrained even if all points stick, (n_groups,).
        vectors: The modes in the direction of the unbalanced force, (n_modes, n_free).
        force: Unbalanced generalised force, (n_modes,) (force).
        group: Group of every mode, (n_modes,).
    """

    imbalance: Array
    is_open: Mask
    vectors: Array
    force: Array
    group: Index

    @classmethod
    def find(
        cls,
        motions: RigidBodyModes,
        scales: ReferenceScales,
        operators: Sequence[ContactOperator],
        load: Array,
        tractions: Sequence[Array],
        unloaded: Mask,
    ) -> UnconstrainedModes:
        """Find unconstrained modes and the forces on them. Collective.

        The tangent of a slipping point is singular in the direction of its friction.

        Args:
            motions: The rigid-body modes.
            scales: Reference scales of the bodies.
            operators: Operators of evaluated contacts, over all unknowns.
            load: External forces at this rank's unknowns (force).
            tractions: Initial tractions of every contact, (n_points, gdim) (stress), part of the
                reference force: the present ones vanish when a body is released.
            unloaded: Groups of which all modes count as unconstrained, (n_groups,).
        """
        n = len(motions.free)
        ratio, groups = np.full(scales.n_groups, np.nan), motions.groups()
        free_modes = motions.find_unconstrained(operators, closed_only=True, slips=True)
        if not len(free_modes) and not unloaded.any():
            return cls(ratio, unloaded, np.zeros((0, n)), np.zeros(0), np.zeros(0, dtype=np.intp))
        open_modes = motions.find_unconstrained(operators, closed_only=True)
        is_open = unloaded.copy()
        is_open[groups[np.argmax(np.abs(open_modes), axis=1)]] = True
        free_modes = np.concatenate([free_modes, np.eye(n)[unloaded[groups]]])
        free_modes /= np.abs(free_modes).max(axis=1)[:, None]
        resultant = free_modes @ motions.generalised_forces(load)
        contact_work = np.zeros((3, len(free_modes)))
        for operator, first in zip(operators, tractions, strict=True):
            contact = operator.contact
            modes = np.einsum("lm,mqd->lqd", free_modes, motions.jumps_at(operator))
            work, initial = (
                np.einsum("lqd,qd->lq", modes, t) for t in (contact.values.total_traction, first)
            )
            contact_work += np.stack([work, np.abs(work), np.abs(initial)]) @ contact.measure
        work, *sizes = scales.global_sum(contact_work)
        size = np.max([np.abs(resultant), *sizes], axis=0)
        group = groups[np.argmax(np.abs(free_modes), axis=1)]
        # A force that is round-off has no unbalanced fraction.
        size = np.where(size > scales.round_off_of_groups[group], size, 0.0)
        unbalanced = broadcast_from_root(motions.comm, np.where(size > 0.0, resultant + work, 0.0))
        fraction = np.abs(unbalanced) / np.where(size > 0.0, size, 1.0)
        np.fmax.at(ratio, group, np.minimum(fraction, 1.0))
        vectors = np.where(unbalanced < 0.0, -1.0, 1.0)[:, None] * free_modes
        return cls(ratio, is_open, vectors, np.abs(unbalanced), group)

    def closing_stiffness(
        self,
        motions: RigidBodyModes,
        scales: ReferenceScales,
        operators: Sequence[ContactOperator],
        within: Sequence[Mask | None],
    ) -> list[Array]:
        """Compute the stiffness of open points with which a step closes the least gap. Collective.

        The springs k = F n³/(2 w² Σ n²), n = w/gap, balance the force F on a mode with the approach
        w at a step of twice the gap, so that half of the step, the next trial of the line search,
        closes the gap, too. All points displaced by a mode have an additional stiffness that limits
        steps along it to twice the size of the mesh. Both are in series with the stiffness of
        closed points.

        Args:
            motions: The rigid-body modes.
            scales: Reference scales of the bodies.
            operators: Operators of evaluated contacts, over all unknowns.
            within: Masks of the points that may close, (n_points,) each; None: all.

        Returns:
            By contact, ratio to the stiffness of a closed point, 0 to 1, (n_points,); 1 where there
            is no gap, or no force above round-off.
        """
        largest: Array = np.zeros(scales.n_groups)
        np.maximum.at(largest, self.group, self.force)
        largest[largest <= scales.round_off_of_groups] = 0.0
        sums: Array = np.zeros((2, len(self.force)))
        points = []
        for number, (operator, mask) in enumerate(zip(operators, within, strict=True)):
            contact, values = operator.contact, operator.contact.values
            gap, closed = contact.gap / scales.mesh_size, contact.area * values.normal_stiffness
            apart = (contact.status == Status.OPEN) & (gap > 0.0) & (closed > 0.0)
            apart &= largest[scales.group_of_points(number)] > 0.0
            if mask is not None:
                apart &= mask
            gap = np.where(apart, np.maximum(gap, _MIN_GAP_RATIO), 1.0)
            modes = np.einsum("lm,mqd->lqd", self.vectors, motions.jumps_at(operator))
            modes *= apart[:, None]
            approach = np.einsum("lqd,qd->lq", modes, values.normal)
            near = np.where(approach > NEGLIGIBLE, approach, 0.0) / gap
            travel = np.sum(modes**2, axis=2)
            sums += np.stack([np.sum(near**2, axis=1), np.sum(travel, axis=1)])
            points.append((apart, near / gap**2, travel > NEGLIGIBLE, np.where(apart, closed, 1.0)))
        sums = scales.global_sum(sums)
        squares, travels = np.where(sums > 0.0, sums, 1.0)
        size = _STEP_GAP_RATIO * scales.mesh_size
        by_gap, by_size = self.force / (size * squares), largest[self.group] / (size * travels)
        ratios = []
        for apart, near, displaced, closed in points:
            stiffness = np.max(by_gap[:, None] * near, axis=0, initial=0.0)
            stiffness += np.max(by_size[:, None] * displaced, axis=0, initial=0.0)
            ratios.append(np.where(apart, stiffness / (stiffness + closed), 1.0))
        return ratios
