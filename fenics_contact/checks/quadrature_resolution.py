"""Resolution of the obstacle's curvature and of the opposing surface's boundary by the points."""

from __future__ import annotations

from fenics_contact.contact.contact import Contact
from fenics_contact.parallel import global_max, global_sum, warn
from fenics_contact.surface.surface import POINTS_PER_RADIUS
from fenics_contact.wording import percent

__all__ = ["warn_of_divided_facets", "warn_of_few_points"]

# Nodes needed to follow the obstacle along a facet, per quadrature point: twice the number at which
# the error of the force is 1 %, since the facets of a mesh differ.
_MAX_NODES_PER_POINT = 2.0
# Force on unresolved facets, relative to the normal force.
_UNRESOLVED_FORCE_RATIO = 0.1
# Half of the force at one point along each divided facet, relative to the normal force. For blocks
# on 2 to 10 facets the error from here on was 0.2 to 18 % of the force, 2 % in the median.
_DIVIDED_FORCE_RATIO = 0.08


def warn_of_few_points(contact: Contact) -> bool:
    """Warn if facets are too long for the obstacle's curvature; return whether so. Collective.

    If the radius is known when the contact is created, `ContactSurface` uses enough points.
    """
    quadrature, comm = contact.quadrature, contact.surface.mesh.comm
    curvature = contact.contact_kinematics.largest_curvature()
    if curvature is None or quadrature.asked:
        return False
    per_radius = curvature * quadrature.facet_sizes
    nodes = POINTS_PER_RADIUS * contact.displacement.degree * per_radius
    coarse = nodes > _MAX_NODES_PER_POINT * (quadrature.degree // 2 + 1)
    force = contact.measure * contact.pressure
    unresolved, whole = global_sum(comm, [force @ coarse, force.sum()])
    if not unresolved > _UNRESOLVED_FORCE_RATIO * whole:
        return False
    length = global_max(comm, per_radius[coarse & (contact.pressure > 0)])
    points = quadrature.default_degree(contact.displacement.degree) + 2
    warn(
        comm,
        f"{contact.name}: facets of Γc with {percent(unresolved / whole)} of the normal force are "
        f"{length:.2g} times as long as the radius of curvature of the obstacle, which their "
        "quadrature points do not resolve: the force is inaccurate. Use smaller facets, or "
        f"ContactSurface(quadrature_degree={round(POINTS_PER_RADIUS * length) * points - 2})",
    )
    return True


def warn_of_divided_facets(contact: Contact) -> bool:
    """Warn if the opposing surface ends within loaded facets; return whether so. Collective.

    The position of its boundary is resolved to half of the distance between two points.
    """
    if not contact.contact_kinematics.pairs_follow_bodies:
        return False
    comm, points = contact.surface.mesh.comm, contact.quadrature.point_rows
    paired = contact.values.paired[points]
    divided = paired.any(axis=1) & ~paired.all(axis=1)
    force = (contact.measure * contact.pressure)[points].sum(axis=1)
    divided_force, whole = global_sum(comm, [force @ divided, force.sum()])
    points_along = points.shape[1] ** (1 / (contact.points.shape[1] - 1))
    error = divided_force / (2 * points_along)
    if not error > _DIVIDED_FORCE_RATIO * whole:
        return False
    warn(
        comm,
        f"{contact.name}: facets of Γc over which the opposing surface ends carry "
        f"{percent(divided_force / whole)} of the normal force. Their quadrature points do not "
        f"resolve where it ends: the error of the force may be {percent(error / whole)}. Swap the "
        "surfaces, so that all points of Γc have an opposite point, or use smaller facets or a "
        "larger ContactSurface(quadrature_degree=...)",
    )
    return True
