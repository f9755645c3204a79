"""Least motion of unloaded bodies.

Along a rigid-body mode without force at the start and end of an increment every position without
penetration is in equilibrium, and Newton's method may end in any. The solution is moved to the one
nearest to the start of the increment.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fenics_contact.methods.equations import Equations
from fenics_contact.systems.least_motion import find_least_motion
from fenics_contact.tolerances import ROUND_OFF
from fenics_contact.types import Array

__all__ = ["move_unloaded_bodies"]

_MAX_LINEARISATIONS = 5  # of the gaps with respect to rigid motions


def move_unloaded_bodies(equations: Equations, part: Callable[[Array], Array]) -> bool:
    """Move unloaded bodies to the position of least motion in the increment. Collective.

    Groups of coupled bodies are moved in turn, and restored if the equations are not satisfied. The
    contacts are evaluated at the end.

    Args:
        equations: The equations with a solution in ``u``, at which the contacts are evaluated.
        part: Restrict a vector of all unknowns to those that are up to date.

    Returns:
        Whether any have moved.
    """
    full, motions = equations.full, equations.motions
    if not len(motions.free):
        return False
    committed = [contact.states.committed.points for contact in full.contacts]
    present = [contact.values for contact in full.contacts]
    modes = motions.find_unloaded(full.operators, [committed, present])
    # Not bodies displaced by Dirichlet conditions.
    change = np.where(full.constrained, full.state() - equations.initial_unknowns, 0.0)
    modes = modes[~motions.find_modes_moving(modes, full.scales.largest(change) > 0.0)]
    groups = motions.groups()[np.argmax(np.abs(modes), axis=1)] if len(modes) else np.zeros(0)
    results = [
        _minimise_motion(equations, part, modes[groups == n], int(n)) for n in np.unique(groups)
    ]
    return any(results)


def _minimise_motion(
    equations: Equations, part: Callable[[Array], Array], modes: Array, group: int
) -> bool:
    """Minimise the motion along unloaded modes of a group; return whether it moved. Collective."""
    full, motions, system = equations.full, equations.motions, equations.system
    solution, has_moved = full.state(), False
    tolerance = ROUND_OFF * full.scales.size_of_groups[group]
    active = [motions.has_force(n, c, c.values) for n, c in enumerate(full.contacts)]
    # At points with a force these modes close no gap, except for round-off.
    free = [~normal for normal, _ in active]
    for _ in range(_MAX_LINEARISATIONS):
        motion = motions.fit_modes(full.state() - equations.initial_unknowns, part)
        present = [contact.values for contact in full.contacts]
        change = find_least_motion(full, motions, modes, present, motion, free)
        if change is None or np.abs(change).max() <= tolerance:
            break
        displacement = motions.displacement(change)
        full.evaluate_at(full.state() + np.where(full.constrained, 0.0, displacement))
        has_moved = True
    if not has_moved:
        return False
    multipliers = []
    for contact, points in zip(full.contacts, active, strict=True):
        if contact.multipliers is not None:
            multipliers.append((contact.multipliers, contact.multipliers.fields.rows()))
            contact.multipliers.reset_unloaded(np.all(~points, axis=0))
    equations.residual_at(system.restrict(full.state()))
    full.evaluate_at(full.state())
    augmented = [contact for contact in full.contacts if contact.multipliers is not None]
    if equations.is_converged() and all(c.enforcement_error() <= c.tolerance for c in augmented):
        return True
    for each, rows in multipliers:
        each.fields.set_rows(rows)
    equations.residual_at(system.restrict(solution))
    full.evaluate_at(solution)
    return False
