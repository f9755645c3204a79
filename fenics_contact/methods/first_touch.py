"""Slip reference at first touch of surfaces that are apart when an increment starts.

A contact on several groups of coupled bodies is divided into one part per group.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize
from mpi4py import MPI

from fenics_contact.contact.contact import Contact
from fenics_contact.methods.equations import Equations
from fenics_contact.methods.linearised_solve import linearise_end
from fenics_contact.parallel import global_max, global_min
from fenics_contact.systems.full import FullSystem
from fenics_contact.types import Array, Mask

__all__ = ["set_slip_reference_at_touch"]

_TOUCHING_GAP_RATIO = 1e-6  # least gap at first touch, relative to the initial one


def set_slip_reference_at_touch(equations: Equations, start: Array) -> Array | None:
    """Set the slip reference of contacts that are apart initially to first touch. Collective.

    Until first touch the bodies move without these contacts, on a straight path for a linear bulk.

    Args:
        equations: The equations of the increment.
        start: The state at the start of the increment, with the prescribed values of that time.

    Returns:
        The state at the end if nothing touches; None if something does, or no contact is apart.
    """
    full, comm = equations.full, equations.full.unknowns.comm
    parts = [part for part in _divide_contacts(full) if part.is_unloaded(comm)]
    if not parts:
        return None
    present = full.state()
    full.evaluate_at(start)
    offsets = [p.contact.contact_kinematics.committed_offset(p.contact.values) for p in parts]
    apart = [
        (p, offset) for p, offset in zip(parts, offsets, strict=True) if p.is_apart(comm, offset)
    ]
    full.set_state(present)
    acting = _exclude([part for part, _ in apart])
    end = linearise_end(equations, acting, start) if apart else None
    expected = None
    if end is not None:
        paths = [_Path(full, *pair, start, end) for pair in apart]
        fractions = np.array([path.find_first_touch() for path in paths])
        groups = np.array([path.part.group for path in paths])
        for path, group in zip(paths, groups, strict=True):
            fraction = fractions[groups == group].min()
            if fraction < 1.0:
                path.evaluate_gap(fraction)
                path.part.contact.states.set_slip_reference(path.part.points)
        expected = end if fractions.min() == 1.0 else None
    full.evaluate_at(present)
    return expected


@dataclass(frozen=True)
class _Part:
    """The points of a contact on one group of coupled bodies.

    Attributes:
        contact: The contact.
        points: Mask of the local points, (n_points,).
        group: Number of the group.
    """

    contact: Contact
    points: Mask
    group: int

    def is_unloaded(self, comm: MPI.Comm) -> bool:
        """Return whether the committed normal traction vanishes. Collective."""
        pressure = np.abs(self.contact.history.values("normal_traction")[self.points])
        return not global_max(comm, pressure) > 0.0

    def is_apart(self, comm: MPI.Comm, offset: Array) -> bool:
        """Return whether the displaced part transmits no force and has open gaps. Collective.

        A facet on which the gap varies by more than its least value may touch between the points.
        """
        contact, gap = self.contact, self.evaluate_gap(offset)
        rows = contact.quadrature.point_rows
        forces = np.abs(contact.values.friction_bound) + np.abs(contact.values.normal_traction)
        least, most = gap[rows].min(axis=1), np.where(gap < np.inf, gap, -np.inf)[rows].max(axis=1)
        apart = global_min(comm, (2.0 * least - most)[least < np.inf], empty=0.0) > 0.0
        return apart and not global_max(comm, forces[self.points]) > 0.0

    def evaluate_gap(self, offset: Array) -> Array:
        """Evaluate the gaps of displaced points, (n_points,) (length). Collective.

        They are infinite at unpaired points and at points of other parts.
        """
        contact = self.contact
        with contact.contact_kinematics.displaced(offset):
            contact.evaluate()
        return np.where(contact.pairs.paired & self.points, contact.values.gap, np.inf)


def _divide_contacts(full: FullSystem) -> list[_Part]:
    """Divide the contacts with friction by groups of coupled bodies. Collective."""
    return [
        _Part(contact, points, group)
        for number, contact in enumerate(full.contacts)
        if contact.law.has_friction
        for group, points in full.scales.points_by_group(number).items()
    ]


def _exclude(parts: Sequence[_Part]) -> list[tuple[Contact, Mask]]:
    """Return the contacts of the parts with their points outside the parts."""
    acting: dict[int, tuple[Contact, Mask]] = {}
    for part in parts:
        _, points = acting.get(id(part.contact), (part.contact, np.ones_like(part.points)))
        acting[id(part.contact)] = part.contact, points & ~part.points
    return list(acting.values())


@dataclass(frozen=True)
class _Path:
    """Approach of the surfaces of a part in an increment without touch.

    Attributes:
        full: The system on all unknowns.
        part: The part.
        displacement: Displacement of its obstacle in the increment, (n_points, gdim) (length).
        start: The state at the start of the increment.
        end: The state at its end.
    """

    full: FullSystem
    part: _Part
    offset: Array
    start: Array
    end: Array

    def evaluate_gap(self, fraction: float) -> Array:
        """Evaluate the gaps at a fraction of the increment, (n_points,) (length). Collective."""
        self.full.set_state(self.start + fraction * (self.end - self.start))
        return self.part.evaluate_gap((1.0 - fraction) * self.offset)

    def find_first_touch(self) -> float:
        """Compute the fraction of the increment at first touch, 1 without touch. Collective."""
        comm = self.full.unknowns.comm
        at_start, at_end = self.evaluate_gap(0.0), self.evaluate_gap(1.0)
        touching = _TOUCHING_GAP_RATIO * global_min(comm, at_start, empty=np.inf)
        if not global_min(comm, at_end, empty=np.inf) < 0.0:
            return 1.0

        def least_gap(fraction: float) -> float:
            least = global_min(comm, self.evaluate_gap(fraction), empty=np.inf)
            return 0.0 if abs(least) <= touching else least

        closing = (at_end < 0.0) & (at_start < np.inf)
        ratios = at_start[closing] / (at_start[closing] - at_end[closing])
        fraction = global_min(comm, ratios, empty=0.5)  # exact where gaps are linear
        least = least_gap(fraction)
        if least == 0.0:
            return fraction
        bracket = (0.0, fraction) if least < 0.0 else (fraction, 1.0)
        return float(scipy.optimize.brentq(least_gap, *bracket))
