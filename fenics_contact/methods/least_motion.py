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
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.least_motion import least_motion
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
    linear = full.bulk.linear
    if not len(motions.free):
        return
    committed = [contact.states.committed.points for contact in full.contacts]
    present = [contact.values for contact in full.contacts]
    ways = motions.unloaded(full.operators, [committed, present])
    if not len(ways):
        return
    solution, moved = full.state(), False
    for _ in range(_STEPS):
        present = [contact.values for contact in full.contacts]
        since = motions.fitted(full.state() - equations.began, system.part, linear=linear)
        change = least_motion(full, motions, ways, present, since, clears=False)
        if change is None or np.abs(change).max() <= NEGLIGIBLE * full.scales.mesh_size:
            break
        way = motions.displaced(change, linear=linear)
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
