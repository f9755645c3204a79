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
from fenics_contact.systems.rigid_body_modes import RigidBodyModes, find_displaced
from fenics_contact.tolerances import NEGLIGIBLE
from fenics_contact.types import Array, Index, Mask

__all__ = ["UnconstrainedModes"]

_STEP_GAP_RATIO = 2.0  # step along an open mode relative to the gap, which half of it closes
_MIN_GAP_RATIO = 1e-64  # least gap relative to the mesh size; its inverse cube does not overflow


@dataclass(frozen=True)
class UnconstrainedModes:
    """Unconstrained rigid-body modes at an evaluated state, the same on every rank.

    Attributes:
        imbalance: Largest unbalanced fraction of the forces on a mode of every chain of bodies
            (`RigidBodyModes.find_chains`), 0 to 1, or NaN without such modes, (n_chains,).
        is_open: Chains with modes that are unconstrained even if all points stick, (n_chains,).
        vectors: The modes in the direction of the unbalanced force, (n_modes, n_free).
        force: Unbalanced generalised force, (n_modes,) (force).
        largest: Largest such force above round-off of every chain, or 0, (n_chains,) (force).
        chain: Chain of every mode, (n_modes,).
        at_points: Chain of every point by contact, (n_points,). The last chain is that of the
            points without a jump.
    """

    imbalance: Array
    is_open: Mask
    vectors: Array
    force: Array
    largest: Array
    chain: Index
    at_points: Sequence[Index]

    @classmethod
    def find(
        cls,
        motions: RigidBodyModes,
        scales: ReferenceScales,
        operators: Sequence[ContactOperator],
        load: Array,
        tractions: Sequence[Array],
        unloaded: Mask,
    ) -> UnconstrainedModes | None:
        """Find unconstrained modes and the forces on them; None: there are none. Collective.

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
        n, groups = len(motions.free), motions.groups()
        free_modes = motions.find_unconstrained(operators, closed_only=True, slips=True)
        free_modes = np.concatenate([free_modes, np.eye(n)[unloaded[groups]]])
        if not len(free_modes):
            return None
        free_modes /= np.abs(free_modes).max(axis=1)[:, None]
        jumps = [motions.jumps_at(operator) for operator in operators]
        chains = motions.find_chains(jumps)
        at_points = [np.max(find_displaced(j) * (chains[:, None] + 1), axis=0) - 1 for j in jumps]
        ratio, largest, is_open = np.full(n + 1, np.nan), np.zeros(n + 1), np.zeros(n + 1, bool)
        open_modes = motions.find_unconstrained(operators, closed_only=True)
        is_open[chains[unloaded[groups] | np.any(open_modes != 0.0, axis=0)]] = True
        resultant = free_modes @ motions.generalised_forces(load)
        contact_work = np.zeros((3, len(free_modes)))
        for operator, each, first in zip(operators, jumps, tractions, strict=True):
            contact = operator.contact
            modes = np.einsum("lm,mqd->lqd", free_modes, each)
            work, initial = (
                np.einsum("lqd,qd->lq", modes, t) for t in (contact.values.total_traction, first)
            )
            contact_work += np.stack([work, np.abs(work), np.abs(initial)]) @ contact.measure
        work, *sizes = scales.global_sum(contact_work)
        size = np.max([np.abs(resultant), *sizes], axis=0)
        member = np.argmax(np.abs(free_modes), axis=1)
        chain, round_off = chains[member], scales.round_off_of_groups[groups[member]]
        # A force that is round-off has no unbalanced fraction.
        size = np.where(size > round_off, size, 0.0)
        unbalanced = broadcast_from_root(motions.comm, np.where(size > 0.0, resultant + work, 0.0))
        force = np.abs(unbalanced)
        np.fmax.at(ratio, chain, np.minimum(force / np.where(size > 0.0, size, 1.0), 1.0))
        np.maximum.at(largest, chain, np.where(force > round_off, force, 0.0))
        vectors = np.where(unbalanced < 0.0, -1.0, 1.0)[:, None] * free_modes
        return cls(ratio, is_open, vectors, force, largest, chain, at_points)

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
        sums: Array = np.zeros((2, len(self.force)))
        points = []
        for number, (operator, mask) in enumerate(zip(operators, within, strict=True)):
            contact, values = operator.contact, operator.contact.values
            gap, closed = contact.gap / scales.mesh_size, contact.area * values.normal_stiffness
            apart = (contact.status == Status.OPEN) & (gap > 0.0) & (closed > 0.0)
            apart &= self.largest[self.at_points[number]] > 0.0
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
        by_gap, by_size = self.force / (size * squares), self.largest[self.chain] / (size * travels)
        ratios = []
        for apart, near, displaced, closed in points:
            stiffness = np.max(by_gap[:, None] * near, axis=0, initial=0.0)
            stiffness += np.max(by_size[:, None] * displaced, axis=0, initial=0.0)
            ratios.append(np.where(apart, stiffness / (stiffness + closed), 1.0))
        return ratios
