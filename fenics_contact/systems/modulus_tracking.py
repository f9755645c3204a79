"""Young's modulus of a bulk form, for contact stiffnesses given as multiples of E/h."""

from __future__ import annotations

from collections.abc import Sequence

from dolfinx import fem

from fenics_contact.contact.contact import Contact
from fenics_contact.surface.displacement import Displacement
from fenics_contact.surface.modulus import cell_modulus
from fenics_contact.systems.bulk import Bulk

__all__ = ["TrackedModulus"]


class TrackedModulus:
    """Young's modulus E of the bulk form for the contacts that need it.

    The constructor is collective. A modulus given by the user is not changed.

    Args:
        bulk: The bulk form.
        displacement: The displacement in the form.
        contacts: Contacts of the problem.

    Attributes:
        present: One value per cell (stress); None: no contact needs it.
    """

    def __init__(self, bulk: Bulk, displacement: Displacement, contacts: Sequence[Contact]) -> None:
        self._bulk, self._displacement = bulk, displacement
        self._contacts = [c for c in contacts if c.inputs.needs_modulus]
        self.present: fem.Function | None = None
        self.measure()

    def measure(self) -> None:
        """Evaluate E from the bulk form and update the contacts. Collective."""
        if self._contacts:
            weight = self._contacts[0].inputs.weight
            self.restore(cell_modulus(self._bulk.tangent_form, self._displacement, weight))

    def restore(self, modulus: fem.Function | None) -> None:
        """Set E to an earlier value of ``present`` and update the contacts. Collective."""
        self.present = modulus
        if modulus is not None:
            for contact in self._contacts:
                contact.inputs.set_modulus(modulus)
