"""The least rigid-body motion by which bodies keep, or get, out of each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fenics_contact.contact.values import PointValues
from fenics_contact.parallel import agreed, gather_rows
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.linear_programmes import least_sum
from fenics_contact.systems.rigid_body_modes import RigidBodyModes
from fenics_contact.tolerances import NEGLIGIBLE
from fenics_contact.types import Array

__all__ = ["least_motion"]


def least_motion(
    full: FullSystem,
    motions: RigidBodyModes,
    ways: Array,
    states: Sequence[PointValues],
    since: Array,
    *,
    clears: bool,
) -> Array | None:
    """Find the change of free motions after which they are least, and leave no gap negative.

    Gaps are taken to be linear in the motions. Collective.

    Args:
        full: The system.
        motions: The rigid-body modes.
        ways: Combinations of free motions that may change, (n_ways, n_free).
        states: Of every contact the values at its points, from where motions change.
        since: How far free motions have gone by then, (n_free,) (length).
        clears: Whether they open the points at which forces act, too; or take no part in these.

    Returns:
        Change of the free motions, (n_free,) (length); None: gaps permit none.
    """
    comm = full.unknowns.comm
    moving = np.any(ways != 0.0, axis=0)
    rows = [np.zeros((0, len(ways) + 1))]
    for number, (operator, values) in enumerate(zip(full.operators, states, strict=True)):
        jumps = np.tensordot(ways, motions.at_points(operator), axes=1)
        normal = np.where(np.isfinite(values.normal), values.normal, 0.0)
        closing = np.einsum("mqd,qd->qm", jumps, normal)
        felt = (values.paired > 0) & np.isfinite(values.gap)
        felt &= np.abs(closing).max(axis=1, initial=0.0) > NEGLIGIBLE
        felt &= operator.contact.law.has_normal_stiffness
        # Where no force acts a gap that is negative is so by round-off.
        acts = motions.acting(number, operator.contact, values)[0]
        gap = np.where(acts, values.gap, np.maximum(values.gap, 0.0))
        rows.append(np.column_stack([closing, gap])[felt if clears else felt & ~acts])
    limits = gather_rows(comm, np.concatenate(rows))
    # The linear programme is one of numbers of order one.
    far = max(np.abs(since[moving]).max(initial=0.0), -limits[:, -1].min(initial=0.0))
    if not 0.0 < far < np.inf:
        return np.zeros(ways.shape[1])
    found = least_sum(limits[:, :-1], limits[:, -1] / far, ways.T[moving], since[moving] / far)
    found = agreed(comm, found)
    return None if found is None else np.asarray(far * (found @ ways), dtype=np.float64)
