"""The least rigid-body motion by which bodies keep, or get, out of each other.

Of all motions that leave no gap negative it is the one with the least mean square displacement of
the nodes, in which bodies turn only where they have to: a least-distance problem, with one
solution, whatever the axes are. Gaps are taken to be linear in the motions.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg
import scipy.optimize

from fenics_contact.contact.values import PointValues
from fenics_contact.parallel import broadcast_from_root, gather_rows, global_sum
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.rigid_body_modes import RigidBodyModes
from fenics_contact.tolerances import FLAT, NEGLIGIBLE, ROUND_OFF
from fenics_contact.types import Array, Mask

__all__ = ["find_least_motion", "minimise_norm"]

# A least-distance problem with a solution this many times as long as its limits counts as one
# without: the residual that tells is round-off.
_LONGEST = 1e6
# Weight of a turn, by that of the mean square displacement it makes. By the latter alone a body
# that is held at a side, and led along with it, would turn to leave its other side behind.
_TURNING = 1e6


def find_least_motion(
    full: FullSystem,
    motions: RigidBodyModes,
    modes: Array,
    states: Sequence[PointValues],
    displacement: Array,
    among: Sequence[Mask],
    closed: Sequence[Array] | None = None,
) -> Array | None:
    """Find by how much modes are to change, so that the motion is least and no gap is negative.

    Collective.

    Args:
        full: The system, at the state from which they change.
        motions: The rigid-body modes.
        modes: Those that may change, in free motions, (n_modes, n_free).
        states: Of every contact the values at its points there.
        displacement: The motion made by then, in free motions, (n_free,) (length).
        among: Masks of the points that count, (n_points,) each.
        closed: By how much gaps are smaller by now than in ``states``, (n_points,) each (length).

    Returns:
        Change in free motions, (n_free,) (length); None: none leaves no gap negative.
    """
    comm, scales = full.unknowns.comm, full.scales
    fields, at_points = motions.present(full.operators)
    rows = [np.zeros((0, len(modes) + 1))]
    closed = closed or [np.zeros(len(values.gap)) for values in states]
    points = zip(full.operators, at_points, states, among, closed, strict=True)
    for number, (operator, jumps, values, mine, less) in enumerate(points):
        size = scales.size_at_points(number)
        normal = np.where(np.isfinite(values.normal), values.normal, 0.0)
        closing = np.einsum("mqd,qd->qm", np.tensordot(modes, jumps, axes=1), normal)
        gap = values.gap - less
        felt = mine & (values.paired > 0) & np.isfinite(gap)
        felt &= np.abs(closing).max(axis=1, initial=0.0) > NEGLIGIBLE
        felt &= operator.contact.law.has_normal_stiffness
        # A gap is left, so that round-off is no force; touching points are as near as they are.
        touches = (gap <= NEGLIGIBLE * size) & (gap >= -ROUND_OFF * size)
        limit = np.where(touches, 0.0, gap - NEGLIGIBLE * size)
        rows.append(np.column_stack([closing, limit])[felt])
    limits = gather_rows(comm, np.concatenate(rows))
    mass = global_sum(comm, fields @ fields.T)
    turns = motions.free * (motions.turns > 0.0)
    norm = modes @ (mass + _TURNING * mass.max() * turns @ turns.T)
    found = minimise_norm(norm @ modes.T, norm @ displacement, limits[:, :-1], limits[:, -1])
    found = broadcast_from_root(comm, found)
    return None if found is None else np.asarray(found @ modes, dtype=np.float64)


def minimise_norm(norm: Array, linear: Array, matrix: Array, limit: Array) -> Array | None:
    """Minimise x @ norm @ x / 2 + linear @ x where matrix @ x <= limit.

    With a growing set of rows, each time the one that is exceeded most. For those the dual of this
    least-distance problem is one of non-negative least squares (C. L. Lawson and R. J. Hanson,
    Solving Least Squares Problems, chapter 23).

    Args:
        norm: Symmetric, positive definite, (n, n).
        linear: (n,).
        matrix: (n_rows, n).
        limit: (n_rows,).

    Returns:
        Array (n,); None: there is no such x.
    """
    lower = np.linalg.cholesky(norm)
    best = -scipy.linalg.cho_solve((lower, True), linear)
    # Of z, with x = best + lower.T^-1 z: rows @ z <= ends.
    rows = scipy.linalg.solve_triangular(lower, matrix.T, lower=True).T
    size = np.linalg.norm(rows, axis=1)
    some = size > 0.0
    rows, ends = rows[some] / size[some, None], (limit - matrix @ best)[some] / size[some]
    far = -ends.min(initial=0.0)
    z: Array = np.zeros(len(best))
    chosen: list[int] = []
    while len(rows) and far > 0.0:
        exceeded = rows @ z - ends
        worst = int(np.argmax(exceeded))
        if exceeded[worst] <= ROUND_OFF * max(far, float(np.abs(z).max())):
            break
        if worst in chosen:
            return None
        chosen.append(worst)
        dual = np.vstack([-rows[chosen].T, -ends[chosen] / far])
        target = np.append(np.zeros(len(z)), 1.0)
        # SciPy's `nnls` ends before the least squares are reached (version 1.15).
        force = scipy.optimize.lsq_linear(dual, target, (0.0, np.inf), method="bvls", tol=1e-15).x
        left = dual @ force - target
        if not -left[-1] * _LONGEST**2 > 1.0:
            return None
        # It tells which rows are met with equality, of which the nearest solution is more exact.
        met = np.array(chosen)[force > FLAT * force.max()]
        found = [-far * left[:-1] / left[-1], np.linalg.lstsq(rows[met], ends[met], rcond=None)[0]]
        z = min(found, key=lambda way: float((rows[chosen] @ way - ends[chosen]).max()))
    return np.asarray(best + scipy.linalg.solve_triangular(lower.T, z), dtype=np.float64)
