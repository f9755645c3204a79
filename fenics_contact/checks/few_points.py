"""Whether Γc has come to lie on facets so short that they pass between its points."""

from __future__ import annotations

from fenics_contact.contact.contact import Contact
from fenics_contact.parallel import global_max, global_sum, warn
from fenics_contact.surface.surface import FINEST_RULE

__all__ = ["warn_of_few_points"]

# Nodes of what lies opposite to a point of Γc, along a facet of this; twice as many as miss 1 % of
# the force, for facets of one mesh differ.
_NODES_PER_POINT = 2.0
# Of the normal force, what such points bear.
_SHARE = 0.1


def warn_of_few_points(contact: Contact) -> bool:
    """Say that points of Γc are too few where they are now, and whether it was. Collective.

    `ContactSurface` counts them by the undeformed bodies, and `ContactProblem` warns of these: here
    it is of what slides onto finer facets.

    Args:
        contact: At an evaluated state.
    """
    quadrature, comm = contact.quadrature, contact.surface.mesh.comm
    times = contact.opposite.times_as_long()
    if times is None or quadrature.asked or quadrature.sparse is not None:
        return False
    if quadrature.degree >= FINEST_RULE[2]:  # enough, see there
        return False
    degree = contact.displacement.degree
    few = times * degree / (quadrature.degree // 2 + 1) > _NODES_PER_POINT
    force = contact.measure * contact.pressure
    borne, whole = global_sum(comm, [force @ few, force.sum()])
    if not borne > _SHARE * whole:
        return False
    most = round(global_max(comm, times[few & (contact.pressure > 0)]))
    wanted = most * (quadrature.default_degree(degree) + 2) - 2
    warn(
        comm,
        f"{contact.name}: facets of Γc that bear {100 * borne / whole:.2g} % of the normal force "
        f"have come to lie on facets opposite {most} times as short, which pass between their "
        "points: the force is too small. Swap the surfaces, so that the finer one is Γc, or give "
        f"ContactSurface(quadrature_degree={wanted}), as many points as the opposite facets take",
    )
    return True
