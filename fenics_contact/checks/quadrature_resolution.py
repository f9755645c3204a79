"""Quadrature resolution: curvature of the obstacle, and the boundary of the opposite surface."""

from __future__ import annotations

from fenics_contact.contact.contact import Contact
from fenics_contact.parallel import global_max, global_sum, warn
from fenics_contact.surface.surface import POINTS_PER_RADIUS
from fenics_contact.wording import percent

__all__ = ["warn_of_divided_facets", "warn_of_few_points"]

# Nodes that would follow the obstacle along a facet, to a point of it: twice as many as miss 1 % of
# the force, for facets of one mesh differ.
_NODES_PER_POINT = 2.0
# Share of the normal force that such facets bear, from which on it is said.
_NOTABLE_SHARE = 0.1
# Of the normal force, half of what one point along each divided facet bears. Blocks on 2 to 10
# facets: from here on 0.2 to 18 % of the force were missing or too much, 2 % in the median.
_NOTABLE_ERROR = 0.08


def warn_of_few_points(contact: Contact) -> bool:
    """Warn if facets are too long for a rigid obstacle's curvature; whether they are. Collective.

    If the radius is known when the contact is created, `ContactSurface` uses enough points.
    """
    quadrature, comm = contact.quadrature, contact.surface.mesh.comm
    curvature = contact.contact_kinematics.largest_curvature()
    if curvature is None or quadrature.asked:
        return False
    per_radius = curvature * quadrature.facet_sizes
    nodes = POINTS_PER_RADIUS * contact.displacement.degree * per_radius
    few = nodes > _NODES_PER_POINT * (quadrature.degree // 2 + 1)
    force = contact.measure * contact.pressure
    borne, whole = global_sum(comm, [force @ few, force.sum()])
    if not borne > _NOTABLE_SHARE * whole:
        return False
    most = global_max(comm, per_radius[few & (contact.pressure > 0)])
    points = quadrature.default_degree(contact.displacement.degree) + 2
    warn(
        comm,
        f"{contact.name}: facets of Γc with {percent(borne / whole)} of the normal force are "
        f"{most:.2g} times as long as the radius of curvature of the obstacle, which their "
        "quadrature points do not resolve: the force is inaccurate. Use smaller facets, or "
        f"ContactSurface(quadrature_degree={round(POINTS_PER_RADIUS * most) * points - 2})",
    )
    return True


def warn_of_divided_facets(contact: Contact) -> bool:
    """Warn if the opposite surface's boundary divides loaded facets; whether it does. Collective.

    Its position along a facet is resolved to half of the distance between two quadrature points.
    """
    if not contact.contact_kinematics.follows:
        return False
    comm, points = contact.surface.mesh.comm, contact.quadrature.point_rows
    paired = contact.values.paired[points]
    divided = paired.any(axis=1) & ~paired.all(axis=1)
    force = (contact.measure * contact.pressure)[points].sum(axis=1)
    borne, whole = global_sum(comm, [force @ divided, force.sum()])
    along = points.shape[1] ** (1 / (contact.points.shape[1] - 1))
    doubtful = borne / (2 * along)
    if not doubtful > _NOTABLE_ERROR * whole:
        return False
    warn(
        comm,
        f"{contact.name}: facets of Γc over which the opposite surface ends carry "
        f"{percent(borne / whole)} of the normal force. Their quadrature points do not resolve "
        f"where it ends: the error of the force may be {percent(doubtful / whole)}. Swap the "
        "surfaces, so that all points of Γc have an opposite point, or use smaller facets or a "
        "larger ContactSurface(quadrature_degree=...)",
    )
    return True
