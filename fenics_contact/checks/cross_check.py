"""Cross-check of the contact forces with those that DOLFINx assembles from the boundary form."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import ufl

from fenics_contact.checks.verdict import ForceBalance
from fenics_contact.compiling import compile_form
from fenics_contact.contact.contact import Contact
from fenics_contact.parallel import global_sum, max_norm
from fenics_contact.surface.mass import assemble_values
from fenics_contact.tolerances import EVALUATION_ROUND_OFF
from fenics_contact.types import Array

__all__ = ["CrossCheck"]


class CrossCheck:
    """Compares nodal contact forces: sums over the points, and DOLFINx's assembly."""

    def __init__(self, contacts: Sequence[Contact]) -> None:
        self._contacts = contacts
        self._forms: dict[str, Any] = {}

    def compare(self) -> dict[str, ForceBalance]:
        """Compare the nodal forces of the solver with the assembled ones, by contact. Collective.

        The tolerance includes the round-off of the displacement times the contact stiffness.
        """
        balances = {}
        for contact in self._contacts:
            comm, values = contact.surface.mesh.comm, contact.values
            by_points, by_form = self._forces(contact)
            tangential = np.linalg.norm(values.tangential_stiffness, axis=(1, 2))
            stiffness = values.normal_stiffness + tangential
            magnitude = contact.pairs.displacement_size(values.jump) + np.abs(values.initial_gap)
            sensitivity = float(global_sum(comm, contact.measure @ (stiffness * magnitude)))
            d = values.x.shape[1]
            sizes = (max_norm(comm, f.reshape(-1, d)) for f in (by_points - by_form, by_points))
            residual, force = (float(size) for size in sizes)
            allowed = 1e-10 * force + EVALUATION_ROUND_OFF * sensitivity
            balances[contact.name] = ForceBalance(residual, force, allowed)
        return balances

    def _forces(self, contact: Contact) -> tuple[Array, Array]:
        """Return the nodal forces on the body with Γc at the present ``u``. Collective.

        Returns:
            Two arrays (n_owned_dofs,) (force): sums over the points, as in
            `ContactOperator.add_force`; and the boundary form (46, 55) assembled by DOLFINx, with
            ``u`` itself if the obstacle is rigid and has no unknown motion, else with the jump.
        """
        kinematics = contact.contact_kinematics
        kinematics.update()
        vector, forces = kinematics.pairs.own_map.createVecs()
        traction = contact.effective_law.own.evaluate_traction()
        forces.array[:] = (contact.area[:, None] * traction).ravel()
        kinematics.pairs.own_map.multTranspose(forces, vector)
        by_points = vector.array_r.copy()
        for item in (vector, forces):
            item.destroy()
        if contact.name not in self._forms:
            is_own = kinematics.is_rigid and not contact.motions
            displacement = contact.u if is_own else kinematics.local_jump
            form = contact.form_at(displacement, ufl.TestFunction(contact.u.function_space))
            self._forms[contact.name] = compile_form(-form, contact.entity_maps)
        return by_points, assemble_values(self._forms[contact.name])[: by_points.size].copy()
