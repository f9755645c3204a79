"""Projection of the updates of tangential multipliers onto the free displacements.

Next to Dirichlet nodes, as on a plane of symmetry, the multiplier space is too rich: part of an
Uzawa update lies in the kernel of the coupling matrix restricted to the free dofs, is never
corrected, and grows until the friction bound at the edge of Γc is reached. The update is therefore
replaced by the closest jump of free displacements. The error at the edge is carried by the penalty
and decreases with the mesh size. Quadratic displacements with linear multipliers are rich enough.

Only dofs fixed relative to the obstacle are excluded. A Dirichlet condition that moves relative to
it prescribes a slip, at which friction has to reach its bound. Normal multipliers are not
projected: those at a node fixed inside the obstacle have to diverge.
"""

from __future__ import annotations

import numpy as np

from fenics_contact.parallel import global_max
from fenics_contact.surface.mass import create_mass_solver
from fenics_contact.systems.operator import ContactOperator
from fenics_contact.tolerances import ROUND_OFF
from fenics_contact.types import Array, Mask

__all__ = ["project_multiplier_updates"]


def project_multiplier_updates(operator: ContactOperator, state: Array, constrained: Mask) -> None:
    """Project the next update of the tangential multipliers. Collective.

    It is the update that `Contact.enforcement_error` measures and `Contact.augment` makes.

    Args:
        operator: Operator of an evaluated contact with multipliers, over all unknowns.
        state: These unknowns, (n_local,).
        constrained: Mask of the unknowns with Dirichlet conditions, (n_local,).
    """
    contact = operator.contact
    multipliers = contact.multipliers
    if multipliers is None or not multipliers.as_displacement or not contact.law.has_friction:
        return
    if contact.contact_kinematics.has_rotation:
        return
    fixed = _find_fixed_dofs(operator, state, constrained)
    if not global_max(operator.unknowns.comm, fixed.astype(np.float64)):
        return
    values, force = contact.values, operator.unknowns.vector()
    change = multipliers.tangential_update(values)
    tangential = np.eye(change.shape[1]) - np.einsum("qi,qj->qij", values.normal, values.normal)
    stiffness = operator.springs(tangential)
    operator.add_force(force, -values.tangential(change))
    free, projection = force.duplicate(), force.duplicate()
    free.array[:] = ~fixed
    force.pointwiseMult(free, force)
    # Rows of fixed dofs become empty, without forces.
    stiffness.diagonalScale(free, free)
    solver = create_mass_solver(stiffness, rtol=ROUND_OFF, atol=1e-300, max_it=500)
    solver.solve(force, projection)
    multipliers.exclude(change - values.tangential(operator.jump(projection.array_r)))
    for item in (force, stiffness, free, projection, solver):
        item.destroy()


def _find_fixed_dofs(operator: ContactOperator, state: Array, constrained: Mask) -> Mask:
    """Return the coupled unknowns that are fixed at the obstacle, a mask. Collective."""
    coupled = np.zeros(len(constrained), dtype=np.bool_)
    coupled[operator.coupled_dofs] = True
    shift = operator.unknowns.vector()
    operator.add_force(shift, np.abs(operator.contact.values.shift))
    fixed = coupled & constrained & (state == 0.0) & (shift.array_r == 0.0)
    shift.destroy()
    return fixed
