"""Bodies that no force holds go no farther than others push them.

Where no force acts along a rigid-body mode at the start of an increment, nor at its end, every
place is in equilibrium that no other body is in. A Newton step takes a body along by points that
are closed without a force: with a body that pushed it and goes back, or anywhere. Of all these
places the nearest to where it was is where it is: nothing has moved it farther (as friction, or
inertia at rest, would have it).
"""

from __future__ import annotations

import numpy as np

from fenics_contact.methods.equations import Equations
from fenics_contact.methods.linear_programmes import least_sum
from fenics_contact.parallel import agreed, gather_rows, global_max, global_sum
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.rigid_body_modes import RigidBodyModes
from fenics_contact.tolerances import NEGLIGIBLE
from fenics_contact.types import Array

__all__ = ["move_least"]

# Gaps are not linear in rigid motions where bodies are large or round: so many times they are taken
# to be linear, anew where that has led.
_STEPS = 5


def move_least(equations: Equations) -> None:
    """Let bodies without force be as near to where the increment began as gaps permit. Collective.

    The contacts are evaluated at the solution, and are where this ends. If the equations do not
    hold there, the solution is left as it was.

    Args:
        equations: With a solution in ``u``.
    """
    full, motions, system = equations.full, equations.motions, equations.system
    if not len(motions.free):
        return
    committed = [contact.states.committed.points for contact in full.contacts]
    present = [contact.values for contact in full.contacts]
    ways = motions.unloaded(full.operators, [committed, present])
    if not len(ways):
        return
    solution, moved = full.state(), False
    for _ in range(_STEPS):
        change = _least_change(full, motions, ways, _since(equations))
        if change is None:
            break
        if full.bulk.linear:  # to which small rotations alone are rigid
            way = change @ motions.fields
        else:
            way = motions.turned(change @ motions.free)
        _go(full, full.state() + np.where(full.constrained, 0.0, way))
        moved = True
    if not moved:
        return
    equations.residual_at(system.part(full.state()))
    if not equations.solved():
        _go(full, solution)
        equations.residual_at(system.part(solution))


def _go(full: FullSystem, state: Array) -> None:
    full.set_state(state)
    for contact in full.contacts:
        contact.evaluate()


def _since(equations: Equations) -> Array:
    """How far every free motion has gone in the increment, (n_free,). Collective."""
    full, motions, system = equations.full, equations.motions, equations.system
    fields = motions.fields if full.bulk.linear else motions.present_fields()
    fields = np.array([system.part(field) for field in fields])
    change = system.part(full.state() - equations.began)
    sums = global_sum(full.unknowns.comm, np.column_stack([fields @ fields.T, fields @ change]))
    return np.asarray(np.linalg.lstsq(sums[:, :-1], sums[:, -1], rcond=NEGLIGIBLE)[0])


def _least_change(
    full: FullSystem, motions: RigidBodyModes, ways: Array, since: Array
) -> Array | None:
    """Change of the free motions with which the increment moves bodies least. Collective.

    Args:
        full: The system, evaluated.
        motions: The free motions.
        ways: Those without force, (n_ways, n_free).
        since: How far every free motion has gone in the increment, (n_free,).

    Returns:
        Array (n_free,); None: none is left, or there are no gaps that permit it.
    """
    comm = full.unknowns.comm
    moving = np.any(ways != 0.0, axis=0)
    far = np.abs(since[moving]).max(initial=0.0)
    if not NEGLIGIBLE * full.scales.mesh_size < far < np.inf:
        return None
    rows = [np.zeros((0, len(ways) + 1))]
    for number, operator in enumerate(full.operators):
        contact, values = operator.contact, operator.contact.values
        jumps = np.tensordot(ways, motions.at_points(operator), axes=1)
        normal = np.where(np.isfinite(values.normal), values.normal, 0.0)
        closing = np.einsum("mqd,qd->qm", jumps, normal)
        felt = contact.paired & (np.abs(closing).max(axis=1, initial=0.0) > NEGLIGIBLE)
        # No force acts along these motions: where one does they close no gap, but for round-off.
        felt &= ~motions.acting(number, contact, values)[0]
        gap = np.maximum(values.gap, 0.0)
        rows.append(np.column_stack([closing, gap])[felt])
    limits = gather_rows(comm, np.concatenate(rows))
    found = least_sum(limits[:, :-1], limits[:, -1] / far, ways.T[moving], since[moving] / far)
    found = agreed(comm, found)
    if found is None or global_max(comm, np.abs(found)) * far <= NEGLIGIBLE * full.scales.mesh_size:
        return None
    return np.asarray(far * (found @ ways), dtype=np.float64)
