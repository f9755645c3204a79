"""The least rigid-body motion that removes or prevents penetration of bodies.

Of all motions without negative linearised gaps it has the least mean square displacement of the
nodes. The solution of this least-distance problem is unique and independent of the axes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg
import scipy.optimize

from fenics_contact.contact.values import PointValues
from fenics_contact.parallel import broadcast_from_root, gather_rows
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.rigid_body_modes import RigidBodyModes
from fenics_contact.tolerances import FLAT, NEGLIGIBLE, ROUND_OFF
from fenics_contact.types import Array, Mask

__all__ = ["find_least_motion", "minimise_norm"]

# A solution longer than this relative to its limits counts as infeasible: a squeezed body would
# escape sideways along the small slope of deformed surfaces, where gaps are not linear.
_MAX_LENGTH_RATIO = 1e2
# Weight of rotations relative to their mean square displacement. Without it a body pulled along at
# one side would rotate.
_ROTATION_WEIGHT = 1e6


def find_least_motion(
    full: FullSystem,
    motions: RigidBodyModes,
    modes: Array,
    states: Sequence[PointValues],
    displacement: Array,
    among: Sequence[Mask],
    closed: Sequence[Array] | None = None,
) -> Array | None:
    """Find the change of modes for the least motion without negative gaps. Collective.

    Args:
        full: The system, at the state to change.
        motions: The rigid-body modes.
        modes: Modes that may change, combinations of the free modes, (n_modes, n_free).
        states: Values at the points of every contact at that state.
        displacement: Amplitudes of the free modes since the reference state, (n_free,) (length).
        among: Masks of the points that count, (n_points,) each.
        closed: Reduction of the gaps since ``states``, (n_points,) each (length).

    Returns:
        Change of these amplitudes, (n_free,) (length); None if the constraints are infeasible.
    """
    comm, scales = full.unknowns.comm, full.scales
    matrix = motions.present_matrix()
    at_points = motions.present_jumps(full.operators, matrix)
    rows = [np.zeros((0, len(modes) + 1))]
    closed = closed or [np.zeros(len(values.gap)) for values in states]
    points = zip(full.operators, at_points, states, among, closed, strict=True)
    for number, (operator, jumps, values, mask, reduction) in enumerate(points):
        size = scales.size_at_points(number)
        normal = np.where(np.isfinite(values.normal), values.normal, 0.0)
        closing = np.einsum("mqd,qd->qm", np.tensordot(modes, jumps, axes=1), normal)
        gap = values.gap - reduction
        is_coupled = mask & (values.paired > 0) & np.isfinite(gap)
        is_coupled &= np.abs(closing).max(axis=1, initial=0.0) > NEGLIGIBLE
        is_coupled &= operator.contact.law.has_normal_stiffness
        # A small gap remains, so that round-off causes no contact force.
        is_touching = (gap <= NEGLIGIBLE * size) & (gap >= -ROUND_OFF * size)
        limit = np.where(is_touching, 0.0, gap - NEGLIGIBLE * size)
        rows.append(np.column_stack([closing, limit])[is_coupled])
    limits = gather_rows(comm, np.concatenate(rows))
    mass = motions.present_gram(matrix)
    rotations = motions.free * (motions.rotation_length > 0.0)
    norm = modes @ (mass + _ROTATION_WEIGHT * mass.max() * rotations @ rotations.T)
    change = minimise_norm(norm @ modes.T, norm @ displacement, limits[:, :-1], limits[:, -1])
    change = broadcast_from_root(comm, change)
    return None if change is None else np.asarray(change @ modes, dtype=np.float64)


def minimise_norm(norm: Array, linear: Array, matrix: Array, limit: Array) -> Array | None:
    """Minimise x @ norm @ x / 2 + linear @ x subject to matrix @ x <= limit.

    The active set grows by the most violated row. The dual of its least-distance problem is one of
    non-negative least squares (C. L. Lawson and R. J. Hanson, Solving Least Squares Problems,
    chapter 23).

    Args:
        norm: Symmetric, positive definite, (n, n).
        linear: (n,).
        matrix: (n_rows, n).
        limit: (n_rows,).

    Returns:
        Array (n,); None if the constraints are infeasible.
    """
    lower = np.linalg.cholesky(norm)
    best = -scipy.linalg.cho_solve((lower, True), linear)
    # In terms of z, with x = best + lower.T^-1 z: rows @ z <= ends.
    rows = scipy.linalg.solve_triangular(lower, matrix.T, lower=True).T
    size = np.linalg.norm(rows, axis=1)
    keep = size > 0.0
    rows, ends = rows[keep] / size[keep, None], (limit - matrix @ best)[keep] / size[keep]
    scale = -ends.min(initial=0.0)
    z: Array = np.zeros(len(best))
    chosen: list[int] = []
    while len(rows) and scale > 0.0:
        exceeded = rows @ z - ends
        row = int(np.argmax(exceeded))
        if exceeded[row] <= ROUND_OFF * max(scale, float(np.abs(z).max())):
            break
        if row in chosen:
            return None
        chosen.append(row)
        dual = np.vstack([-rows[chosen].T, -ends[chosen] / scale])
        target = np.append(np.zeros(len(z)), 1.0)
        # `scipy.optimize.nnls` may stop too early (version 1.15).
        force = scipy.optimize.lsq_linear(dual, target, (0.0, np.inf), method="bvls", tol=1e-15).x
        residual = dual @ force - target
        if not -residual[-1] * _MAX_LENGTH_RATIO**2 > 1.0:
            return None
        # Least squares on the active rows is more accurate.
        active = np.array(chosen)[force > FLAT * force.max()]
        trials = [
            -scale * residual[:-1] / residual[-1],
            np.linalg.lstsq(rows[active], ends[active], rcond=None)[0],
        ]
        z = min(trials, key=lambda x: float((rows[chosen] @ x - ends[chosen]).max()))
    return np.asarray(best + scipy.linalg.solve_triangular(lower.T, z), dtype=np.float64)
