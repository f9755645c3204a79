"""Bodies that no force holds go no farther than others push them.

Where no force acts along a rigid-body mode at the start of an increment, nor at its end, every
place is in equilibrium that no other body is in. A Newton step takes a body along by points that
are closed without a force: with a body that pushed it and goes back, or anywhere. The increment
ends in the place nearest to where it began instead: no force has moved the body farther.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fenics_contact.methods.equations import Equations
from fenics_contact.systems.least_motion import find_least_motion
from fenics_contact.tolerances import ROUND_OFF
from fenics_contact.types import Array

__all__ = ["move_unloaded_bodies"]

# Gaps are not linear in rigid motions where bodies turn, or are round: so many times they are taken
# to be linear, anew where that has led.
_LINEARISATIONS = 5


def move_unloaded_bodies(equations: Equations, part: Callable[[Array], Array]) -> bool:
    """Move bodies without force to where they have moved least in the increment. Collective.

    Groups of coupled bodies are moved one after another, and left in the solution if the equations
    do not hold where they are moved to. The contacts are evaluated at the end.

    Args:
        equations: With a solution in ``u``, at which the contacts are evaluated.
        part: Takes of all unknowns those that are up to date.

    Returns:
        Whether any have moved.
    """
    full, motions = equations.full, equations.motions
    if not len(motions.free):
        return False
    committed = [contact.states.committed.points for contact in full.contacts]
    present = [contact.values for contact in full.contacts]
    modes = motions.find_unloaded(full.operators, [committed, present])
    # Of a body with conditions that move it the least motion is not to stay where it is.
    change = np.where(full.constrained, full.state() - equations.initial_unknowns, 0.0)
    modes = modes[~motions.move_any(modes, full.scales.largest(change) > 0.0)]
    groups = motions.groups()[np.argmax(np.abs(modes), axis=1)] if len(modes) else np.zeros(0)
    moved = [_move(equations, part, modes[groups == n], int(n)) for n in np.unique(groups)]
    return any(moved)


def _move(equations: Equations, part: Callable[[Array], Array], modes: Array, group: int) -> bool:
    """Let some modes be as near to where the increment began as gaps permit. Collective.

    Args:
        equations: As in `move_unloaded_bodies`.
        part: Likewise.
        modes: Those of a group, in free motions, (n_modes, n_free).
        group: Which group of coupled parts they move.

    Returns:
        Whether the solution is there now.
    """
    full, motions, system = equations.full, equations.motions, equations.system
    solution, moved = full.state(), False
    least = ROUND_OFF * full.scales.size_of_groups[group]
    acting = [motions.has_force(n, c, c.values) for n, c in enumerate(full.contacts)]
    # Where a force acts these modes close no gap, but for round-off.
    free = [~normal for normal, _ in acting]
    for _ in range(_LINEARISATIONS):
        since = motions.fit(full.state() - equations.initial_unknowns, part)
        present = [contact.values for contact in full.contacts]
        change = find_least_motion(full, motions, modes, present, since, free)
        if change is None or np.abs(change).max() <= least:
            break
        way = motions.displacement(change)
        full.evaluate_at(full.state() + np.where(full.constrained, 0.0, way))
        moved = True
    if not moved:
        return False
    multipliers = []
    for contact, points in zip(full.contacts, acting, strict=True):
        if contact.multipliers is not None:
            multipliers.append((contact.multipliers, contact.multipliers.fields.rows()))
            contact.multipliers.drop(np.all(~points, axis=0))
    equations.residual_at(system.part(full.state()))
    full.evaluate_at(full.state())
    augmented = [contact for contact in full.contacts if contact.multipliers is not None]
    if equations.solved() and all(c.enforcement_error() <= c.tolerance for c in augmented):
        return True
    for each, rows in multipliers:
        each.fields.set_rows(rows)
    equations.residual_at(system.part(solution))
    full.evaluate_at(solution)
    return False
