"""Whether points of Γc are too few for where it has come to lie: on short facets, over an end."""

from __future__ import annotations

from fenics_contact.contact.contact import Contact
from fenics_contact.parallel import global_max, global_sum, warn
from fenics_contact.surface.surface import FINEST_RULE, POINTS_PER_RADIUS

__all__ = ["warn_of_divided_facets", "warn_of_few_points"]

# Nodes of what lies opposite to a point of Γc, along a facet of this; twice as many as miss 1 % of
# the force, for facets of one mesh differ.
_NODES_PER_POINT = 2.0
# Of the normal force, what such points bear.
_SHARE = 0.1
# Of the normal force, half of what one point along each divided facet bears. Blocks on 2 to 10
# facets: from here on 0.2 to 18 % of the force were missing or too much, 2 % in the median.
_DIVIDED = 0.08


def warn_of_few_points(contact: Contact) -> bool:
    """Say that points of Γc are too few where they are now, and whether it was. Collective.

    `ContactSurface` counts them by the undeformed bodies, and `ContactProblem` warns of these: here
    it is of what slides onto finer facets, and of rigid supports whose radius was not known.

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
    most = global_max(comm, times[few & (contact.pressure > 0)])
    wanted = round(most) * (quadrature.default_degree(degree) + 2) - 2
    facets = (
        f"{contact.name}: facets of Γc that bear {100 * borne / whole:.2g} % of the normal force"
    )
    if contact.rigid:
        warn(
            comm,
            f"{facets} are {most / POINTS_PER_RADIUS:.2g} times as long as the radius of the "
            "support there, whose shape passes between their points: the force is wrong. Take "
            f"smaller facets, or give ContactSurface(quadrature_degree={wanted}), as many points "
            "as see it",
        )
        return True
    warn(
        comm,
        f"{facets} have come to lie on facets opposite {round(most)} times as short, which pass "
        "between their points: the force is too small. Swap the surfaces, so that the finer one "
        f"is Γc, or give ContactSurface(quadrature_degree={wanted}), as many points as the "
        "opposite facets take",
    )
    return True


def warn_of_divided_facets(contact: Contact) -> bool:
    """Say that an end of the opposite surface divides what bears, and whether it does. Collective.

    Points see whether it is there, and no more: where along a facet it ends is known to half of the
    distance between two points.

    Args:
        contact: At an evaluated state.
    """
    if not contact.opposite.follows:
        return False
    comm, points = contact.surface.mesh.comm, contact.quadrature.point_rows()
    paired = contact.values.paired[points]
    divided = paired.any(axis=1) & ~paired.all(axis=1)
    force = (contact.measure * contact.pressure)[points].sum(axis=1)
    borne, whole = global_sum(comm, [force @ divided, force.sum()])
    along = points.shape[1] ** (1 / (contact.points.shape[1] - 1))
    doubtful = borne / (2 * along)
    if not doubtful > _DIVIDED * whole:
        return False
    warn(
        comm,
        f"{contact.name}: facets of Γc over which the opposite surface ends bear "
        f"{100 * borne / whole:.2g} % of the normal force. Points on them see that it ends, not "
        f"where: the force may be wrong by {100 * doubtful / whole:.2g} %. Swap the surfaces, so "
        "that all points of Γc lie opposite the other, or take smaller facets or a larger "
        "ContactSurface(quadrature_degree=...)",
    )
    return True
