"""Selection of the dofs to retain: those of the points of Γc that may come into contact.

Dofs of points that stay open need not be retained. No bound on the displacement of an elastic body
is both safe and useful, so the candidates are the active points and the nearest others, as many as
are inexpensive. All of Γc is evaluated afterwards, and the selection enlarged if necessary.
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

__all__ = [
    "compute_contact_distances",
    "find_active_points",
    "find_coupled_dofs",
    "select_nearest_dofs",
]


def find_active_points(contact: Contact) -> Mask:
    """Return the mask of this rank's active points, (n_points,), as evaluated.

    A point with a given friction bound is active even if its gap is open.
    """
    values = contact.values
    # Comparisons with NaN are false.
    acts = np.any(np.abs(values.total_traction) > 0.0, axis=1) | (values.friction_bound > 0.0)
    return np.asarray((contact.status != Status.OPEN) | (acts & contact.pairs.paired))


def compute_contact_distances(contact: Contact) -> Array:
    """Return the distance of this rank's points from contact, (n_points,) (length).

    It is -∞ at active points, and at all points if the gap is prescribed, since the gap is then not
    closed by displacements. It is ∞ at points without an opposite point.
    """
    gap = np.where(contact.pairs.paired, contact.values.gap, np.inf)
    return np.where(find_active_points(contact) | contact.gap_prescribed, -np.inf, gap)


def find_coupled_dofs(
    operators: Sequence[ContactOperator],
    unknowns: Unknowns,
    points: Sequence[Mask] | None = None,
) -> Indices:
    """Return this rank's unknowns that the contacts couple, ascending. Collective.

    The points may be restricted by a mask for every operator.
    """
    coupled = np.zeros(unknowns.n_local, dtype=np.bool_)
    coupled[unknowns.n_dofs :] = True
    for number, operator in enumerate(operators):
        dofs = operator.possible_dofs if points is None else operator.find_dofs(points[number])
        coupled[dofs] = True
    return np.flatnonzero(coupled).astype(np.int32)


def select_nearest_dofs(
    operators: Sequence[ContactOperator],
    unknowns: Unknowns,
    away: Sequence[Array],
    wanted: int,
    round_off: float,
) -> Indices:
    """Return this rank's unknowns that the points nearest to contact couple. Collective.

    Args:
        operators: Contact operators over all unknowns.
        unknowns: All unknowns.
        away: `compute_contact_distances` of every contact.
        wanted: Largest number of unknowns on all ranks, exceeded only by those of active points and
            points with a gap of zero or less.
        round_off: Round-off of the distances: points that tie with the last one are included
            (length).
    """
    comm = unknowns.comm
    all_dofs = find_coupled_dofs(operators, unknowns)
    n_coupled = int(comm.allreduce(all_dofs.size))
    order = np.sort(gather_rows(comm, np.concatenate(away)))
    n_closed = int(np.count_nonzero(order <= round_off))
    n_paired = int(np.count_nonzero(order < np.inf))
    dofs, n_dofs = all_dofs, n_coupled
    n_points = n_paired
    while n_dofs > wanted and n_points > n_closed:
        n_points = max(n_closed, min(n_points * wanted // n_dofs, n_points - 1))
        cutoff = order[n_points - 1] + round_off if n_points else -np.inf
        dofs = find_coupled_dofs(operators, unknowns, [a <= cutoff for a in away])
        n_dofs = int(comm.allreduce(dofs.size))
    return dofs
