"""Where bodies can touch in this increment: the candidates among the points of Γc.

Users tag generously. Points that stay open take no part in the equations, and the unknowns that
they alone feel need not be kept. Which will close is not known before, and no bound on the motion
of an elastic body is both safe and of use. So the candidates are the points that bear now and those
nearest to bearing, as many as cost next to nothing. With what they lead to all of Γc is evaluated:
if the law acts elsewhere there have to be more of them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import Status
from fenics_contact.parallel import gather_rows
from fenics_contact.systems.operator import ContactOperator
from fenics_contact.systems.unknowns import Unknowns
from fenics_contact.types import Array, Indices, Mask

__all__ = ["active_points", "distances", "nearest", "touched"]


def active_points(contact: Contact) -> Mask:
    """At which of this rank's points the law acts, as evaluated, or would act on any slip.

    Friction of a given limit does so where the gap is open, too.
    """
    values = contact.values
    # What is not a number tells nothing.
    acts = np.any(np.abs(values.total_traction) > 0.0, axis=1) | (values.friction_bound > 0.0)
    return np.asarray((contact.status != Status.OPEN) | (acts & contact.paired))


def distances(contact: Contact) -> Array:
    """How far this rank's points are from bearing, as evaluated, (n_points,) (length).

    Minus infinity where the law acts, and at all points if the gap is prescribed: what closes it
    then is no motion. Infinity at points without an opposite.
    """
    gap = np.where(contact.paired, contact.values.gap, np.inf)
    return np.where(active_points(contact) | contact.gap_prescribed, -np.inf, gap)


def touched(
    operators: Sequence[ContactOperator],
    unknowns: Unknowns,
    points: Sequence[Mask] | None = None,
) -> Indices:
    """This rank's unknowns that contact feels or acts on, ascending. Collective.

    Args:
        operators: Over all unknowns.
        unknowns: These.
        points: For every operator the points at which there may be contact; None: all of Γc.
    """
    found = np.zeros(unknowns.n_local, dtype=np.bool_)
    found[unknowns.n_dofs :] = True
    for number, operator in enumerate(operators):
        mine = operator.reachable if points is None else operator.touched_by(points[number])
        found[mine] = True
    return np.flatnonzero(found).astype(np.int32)


def nearest(
    operators: Sequence[ContactOperator],
    unknowns: Unknowns,
    away: Sequence[Array],
    wanted: int,
    round_off: float,
) -> Indices:
    """This rank's unknowns that the nearest points touch, ascending. Collective.

    Args:
        operators: Over all unknowns.
        unknowns: These.
        away: `distances` of every contact.
        wanted: The most unknowns, on all ranks; more only where the law acts at more points.
        round_off: Of the distances: points as far away as the last that is taken are taken too
            (length).
    """
    comm = unknowns.comm
    everything = touched(operators, unknowns)
    n_touched = int(comm.allreduce(everything.size))
    order = np.sort(gather_rows(comm, np.concatenate(away)))
    n_acting = int(np.count_nonzero(order == -np.inf))
    n_paired = int(np.count_nonzero(order < np.inf))
    found, n_found = everything, n_touched
    n_points = n_paired
    while n_found > wanted and n_points > n_acting:
        # Points and unknowns are in proportion, but for those at the edge.
        n_points = max(n_acting, min(n_points * wanted // n_found, n_points - 1))
        farthest = order[n_points - 1] + round_off if n_points else -np.inf
        found = touched(operators, unknowns, [a <= farthest for a in away])
        n_found = int(comm.allreduce(found.size))
    return found
