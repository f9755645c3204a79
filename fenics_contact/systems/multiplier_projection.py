"""Changes of tangential multipliers that displacements answer.

Multipliers are functions on Γc, and where a condition holds displacements, as on a plane of
symmetry, there are more of them than free displacements: some changes of them are forces that add
up to nothing at every free displacement. Nothing answers those, so that nothing ends them: they
grow from round to round until friction at the edge of Γc reaches its limit by them alone. They are
left out: what is kept of a change is the closest that a displacement of free unknowns makes at the
points. What is left of it at the edge stays with the springs, and falls with the mesh.

Of quadratic displacements, whose multipliers are linear, there are more than enough.

It is the conditions that hold a displacement at rest that this is for. One that moves relative to
the obstacle prescribes a slip, and friction has to reach its limit there; and one that holds a node
inside of the obstacle is refused, by the normal multipliers that nothing ends.
"""

from __future__ import annotations

import numpy as np

from fenics_contact.parallel import global_max
from fenics_contact.surface.mass import mass_solver
from fenics_contact.systems.operator import ContactOperator
from fenics_contact.tolerances import ROUND_OFF
from fenics_contact.types import Array, Mask

__all__ = ["project_multiplier_updates"]


def project_multiplier_updates(operator: ContactOperator, state: Array, constrained: Mask) -> None:
    """Let the next change of multipliers be without what displacements do not answer. Collective.

    The change is what `Contact.enforcement_error` measures, and what `Contact.augment` makes.

    Args:
        operator: Of an evaluated contact with multipliers, over all unknowns.
        state: These unknowns, (n_local,).
        constrained: Mask over them: those with Dirichlet conditions.
    """
    contact = operator.contact
    multipliers = contact.multipliers
    if multipliers is None or not multipliers.as_displacement or not contact.law.has_friction:
        return
    if contact.contact_kinematics.turns:
        return
    held = _at_rest(operator, state, constrained)
    if not global_max(operator.unknowns.comm, held.astype(np.float64)):
        return
    values, force = contact.values, operator.unknowns.vector()
    change = multipliers.tangential_change(values)
    across = np.eye(change.shape[1]) - np.einsum("qi,qj->qij", values.normal, values.normal)
    stiffness = operator.springs(across)
    operator.add_force(force, -values.tangential(change))
    free, closest = force.duplicate(), force.duplicate()
    free.array[:] = ~held
    force.pointwiseMult(free, force)
    # The rows of what is held are empty then, and nothing acts there.
    stiffness.diagonalScale(free, free)
    solver = mass_solver(stiffness, rtol=ROUND_OFF, atol=1e-300, max_it=500)
    solver.solve(force, closest)
    multipliers.leave_out(change - values.tangential(operator.jump(closest.array_r)))
    for item in (force, stiffness, free, closest, solver):
        item.destroy()


def _at_rest(operator: ContactOperator, state: Array, constrained: Mask) -> Mask:
    """Unknowns that the points feel and a condition keeps where the obstacle is. Collective."""
    touched = np.zeros(len(constrained), dtype=np.bool_)
    touched[operator.touched] = True
    moved = operator.unknowns.vector()
    operator.add_force(moved, np.abs(operator.contact.values.shift))
    held = touched & constrained & (state == 0.0) & (moved.array_r == 0.0)
    moved.destroy()
    return held
