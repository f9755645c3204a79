"""Cross-check of the contact forces with those that DOLFINx assembles from the boundary form."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import ufl

from fenics_contact.checks.verdict import ForceBalance
from fenics_contact.compiling import compile_form
from fenics_contact.contact.contact import Contact
from fenics_contact.parallel import global_sum, longest
from fenics_contact.surface.mass import assembled
from fenics_contact.types import Array

__all__ = ["CrossCheck"]


# Round-off of displacements that two routes add up in different orders, by their size.
_ROUND_OFF = 100 * np.finfo(float).eps


class CrossCheck:
    """Compares the forces of contacts by two routes."""

    def __init__(self, contacts: Sequence[Contact]) -> None:
        self._contacts = contacts
        self._forms: dict[str, Any] = {}

    def compare(self) -> dict[str, ForceBalance]:
        """Nodal forces on Γc as the solver has them against those of the boundary form. Collective.

        Both have the round-off of the displacement, by as much as the springs are stiff.
        """
        found = {}
        for contact in self._contacts:
            comm, values = contact.surface.mesh.comm, contact.values
            mine, other = self._forces(contact)
            across = np.linalg.norm(values.tangential_stiffness, axis=(1, 2))
            stiffness = values.normal_stiffness + across
            terms = contact.moved() + np.abs(values.initial_gap)
            blur = float(global_sum(comm, contact.measure @ (stiffness * terms)))
            d = values.x.shape[1]
            sizes = (longest(comm, f.reshape(-1, d)) for f in (mine - other, mine))
            residual, force = (float(size) for size in sizes)
            allowed = 1e-10 * force + _ROUND_OFF * blur
            found[contact.name] = ForceBalance(residual, force, allowed)
        return found

    def _forces(self, contact: Contact) -> tuple[Array, Array]:
        """Nodal forces on the body with Γc at the present ``u``. Collective.

        Returns:
            (n_owned_dofs,) each (force): as `ContactOperator.add_force` has them, by sums over the
            points; and as DOLFINx assembles the boundary form (46, 55), in which ``u`` itself
            stands where the obstacle is rigid and no motion of it is unknown, and the jump at the
            points otherwise.
        """
        opposite = contact.contact_kinematics
        opposite.update()
        vector, forces = opposite.pairs.own_map.createVecs()
        traction = contact.effective_law.own.evaluate_traction()
        forces.array[:] = (contact.area[:, None] * traction).ravel()
        opposite.pairs.own_map.multTranspose(forces, vector)
        by_points = vector.array_r.copy()
        for item in (vector, forces):
            item.destroy()
        if contact.name not in self._forms:
            displacement = (
                contact.u if contact.rigid and not contact.motions else opposite.local_jump
            )
            form = contact.form_at(displacement, ufl.TestFunction(contact.u.function_space))
            self._forms[contact.name] = compile_form(-form, contact.entity_maps)
        return by_points, assembled(self._forms[contact.name])[: by_points.size].copy()
