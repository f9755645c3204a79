"""Whether a body opposite passes through Γc between the points of Γc."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fenics_contact.contact.contact import Contact
from fenics_contact.contact.pairs import Holding
from fenics_contact.contact.values import Status
from fenics_contact.parallel import global_max
from fenics_contact.types import Array

__all__ = ["passing", "unseen_penetration"]

# Less than this share of the penetration where the increment starts is none.
_LEFT = 1e-6


def unseen_penetration(
    contact: Contact, others: Sequence[Contact] = (), *, stiffness: float = 0.0
) -> tuple[float, Array]:
    """How deep the opposite passes through Γc between the points of Γc. Collective.

    Corners and middles of the opposite's facets are followed back to Γc, with the pairs as they
    are and at the last evaluated state. Where one lies deeper than any point of the contacts,
    while no point of the facet that it passes through nor of its neighbours is closed, nothing
    holds it up. Facets of curved surfaces may overlap by what they differ from these.

    Args:
        contact: The contact.
        others: Further contacts, whose points see the opposite where it is their Γc. Where Γc is
            theirs as well, its end may reach over one body between two points while the other
            holds it up: at the rim of Γc their closed points count, too. Inside, a body that no
            point of its own contact meets, such as a pin in a hole of the other, is passed through.
        stiffness: Of the bodies by area, about E/h times the contact's weight (force/length by
            area): what bears less than a millionth of it times the depth holds nothing up.

    Returns:
        The largest such depth (length), 0 if there is none or the support is rigid, and the
        place in the undeformed body, (gdim,).
    """
    if contact.rigid:
        return 0.0, np.zeros(contact.points.shape[1])
    comm, every = contact.surface.mesh.comm, (contact, *others)
    deepest = max(global_max(comm, c.values.penetration) for c in every)
    # Where a load is gone there is round-off of what it had pressed together.
    before = [c.committed().points for c in every]
    was = max((global_max(comm, points.penetration) for points in before if points), default=0.0)
    return contact.pairs.unseen_penetration(
        contact.values,
        max(deepest, _LEFT * was),
        [
            Holding(
                c.pairs.search,
                c.values,
                c.status != Status.OPEN,
                stiffness / global_max(comm, c.values.weight),
            )
            for c in every
            if c.pairs.search is not None
        ],
        gap_prescribed=contact.gap_prescribed,
    )


def passing(contacts: Sequence[Contact], stiffness: float) -> dict[str, tuple[float, list[float]]]:
    """`unseen_penetration` by the names of the contacts that have any. Collective.

    Args:
        contacts: The contacts.
        stiffness: See there.
    """
    found = {}
    for contact in contacts:
        others = [c for c in contacts if c is not contact]
        depth, place = unseen_penetration(contact, others, stiffness=stiffness)
        if not depth <= 0:
            found[contact.name] = depth, [float(x) for x in place]
    return found
