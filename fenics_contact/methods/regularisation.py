"""Stiffness for rigid-body modes that contact leaves free: what a Newton step along them needs.

Where points of a body are open, or slip, its tangent may be singular. What is added to it vanishes
with the forces on these modes that are not in balance, so that convergence stays superlinear
(Levenberg-Marquardt).
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

# Gaps that a step goes through along a mode that is open: half of it touches, as well.
_BEYOND = 2.0
# Gaps by the size of the mesh that are taken for no smaller: their cubes do not overflow.
_LEAST_GAP = 1e-64


@dataclass(frozen=True)
class UnconstrainedModes:
    """Rigid-body modes that contact leaves free at an evaluated state, the same on every rank.

    Attributes:
        share: The largest share of the forces on a mode of every group of coupled parts that is not
            in balance, 0 to 1, or NaN where it has no such mode, (n_groups,).
        is_open: Which groups have modes that would be free if no point slipped, (n_groups,).
        ways: The modes along what is not in balance, in free motions, (n_modes, n_free).
        force: That, (n_modes,) (force).
        group: Their groups, (n_modes,).
    """

    share: Array
    is_open: Mask
    ways: Array
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
        idle: Mask,
    ) -> UnconstrainedModes:
        """Find them, and the forces on them. Collective.

        The tangent of friction is none along the friction of a slipping point.

        Args:
            motions: The rigid-body modes.
            scales: Reference scales of the bodies.
            operators: Of evaluated contacts, over all unknowns.
            load: External forces at this rank's unknowns (force).
            tractions: Of every contact where the iteration began, (n_points, gdim) (stress): what
                is let go bears less and less, and is compared with what it bore.
            idle: Groups of which all modes count as free, (n_groups,).
        """
        n = len(motions.free)
        share, groups = np.full(scales.n_groups, np.nan), motions.groups()
        loose = motions.unconstrained(operators, closed_only=True, slips=True)
        if not len(loose) and not idle.any():
            return cls(share, idle, np.zeros((0, n)), np.zeros(0), np.zeros(0, dtype=np.intp))
        stuck = motions.unconstrained(operators, closed_only=True)
        is_open = idle.copy()
        is_open[groups[np.argmax(np.abs(stuck), axis=1)]] = True
        loose = np.concatenate([loose, np.eye(n)[idle[groups]]])
        loose /= np.abs(loose).max(axis=1)[:, None]
        resultant = loose @ motions.generalised_forces(load)
        borne = np.zeros((3, len(loose)))
        for operator, first in zip(operators, tractions, strict=True):
            contact = operator.contact
            modes = np.einsum("lm,mqd->lqd", loose, motions.at_points(operator))
            work, then = (
                np.einsum("lqd,qd->lq", modes, t) for t in (contact.values.total_traction, first)
            )
            borne += np.stack([work, np.abs(work), np.abs(then)]) @ contact.measure
        work, *sizes = scales.global_sum(borne)
        size = np.max([np.abs(resultant), *sizes], axis=0)
        group = groups[np.argmax(np.abs(loose), axis=1)]
        # Sums of round-off count as no force: no share of them would ever be in balance.
        size = np.where(size > scales.round_off_of_groups[group], size, 0.0)
        left = broadcast_from_root(motions.comm, np.where(size > 0.0, resultant + work, 0.0))
        part = np.abs(left) / np.where(size > 0.0, size, 1.0)
        np.fmax.at(share, group, np.minimum(part, 1.0))
        ways = np.where(left < 0.0, -1.0, 1.0)[:, None] * loose
        return cls(share, is_open, ways, np.abs(left), group)

    def closing(
        self,
        motions: RigidBodyModes,
        scales: ReferenceScales,
        operators: Sequence[ContactOperator],
        within: Sequence[Mask | None],
    ) -> list[Array]:
        """Secant stiffness of open points, with which a step closes the nearest gap. Collective.

        Springs k = F near³/(2 w² Σ near²) bear the force F on a mode that approaches the points by
        w if it goes twice as far as each is open, the nearest ones most of it; near = w/gap. Half
        of the step, which a line search takes next, touches, too. Besides, all points that a mode
        moves get as much as ends a step along it after twice the size of the mesh. All are in
        series with the stiffness of closed points, which then bear the force.

        Args:
            motions: The rigid-body modes.
            scales: Reference scales of the bodies.
            operators: Of evaluated contacts, over all unknowns.
            within: Masks of the points that may close, (n_points,) each; None: all.

        Returns:
            By contact, by the stiffness of a closed point, 0 to 1, (n_points,); 1 where there is no
            gap, or no force that is more than round-off.
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
            gap = np.where(apart, np.maximum(gap, _LEAST_GAP), 1.0)
            modes = np.einsum("lm,mqd->lqd", self.ways, motions.at_points(operator))
            modes *= apart[:, None]
            approach = np.einsum("lqd,qd->lq", modes, values.normal)
            near = np.where(approach > NEGLIGIBLE, approach, 0.0) / gap
            travel = np.sum(modes**2, axis=2)
            sums += np.stack([np.sum(near**2, axis=1), np.sum(travel, axis=1)])
            points.append((apart, near / gap**2, travel > NEGLIGIBLE, np.where(apart, closed, 1.0)))
        sums = scales.global_sum(sums)
        squares, travels = np.where(sums > 0.0, sums, 1.0)
        size = _BEYOND * scales.mesh_size
        by_gap, by_size = self.force / (size * squares), largest[self.group] / (size * travels)
        found = []
        for apart, near, moved, closed in points:
            stiffness = np.max(by_gap[:, None] * near, axis=0, initial=0.0)
            stiffness += np.max(by_size[:, None] * moved, axis=0, initial=0.0)
            found.append(np.where(apart, stiffness / (stiffness + closed), 1.0))
        return found
