"""Penetration and tunnelling at the deformed positions: between points of Γc, and on their paths.

The contact law acts at the quadrature points of Γc, in the kinematics that the contact was given.
Here the geometry is taken where it is at the end of an increment, X + u, on all of Γc:

- *Depth.* At points, corners, middles of edges and of facets the penetration must not exceed that
  of the nearby points, which the law resists, by more than the tangent planes seen from these
  points explain.
- *Path.* In the increment no such place may enter an opposing body on one side and leave it, or be
  about to, on the other; and no point of a rigid obstacle that is near Γc may enter the body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from dolfinx import fem
from mpi4py import MPI

from fenics_contact.checks.body_probe import OpposingBodyProbe
from fenics_contact.checks.condition import Condition
from fenics_contact.checks.obstacle_probe import RigidObstacleProbe
from fenics_contact.checks.penetration import ResistedDepth
from fenics_contact.contact.contact import Contact
from fenics_contact.parallel import gather_rows
from fenics_contact.types import Array
from fenics_contact.wording import place_in_words

__all__ = ["Tunnelling", "TunnellingCheck"]

_Probe: TypeAlias = RigidObstacleProbe | OpposingBodyProbe


@dataclass(frozen=True)
class Tunnelling:
    """Penetration of one contact that its points do not resist; the same on every rank.

    Attributes:
        depth: Penetration at the place where it is largest beyond what is allowed (length).
        allowed: What is allowed there (length).
        place: That place of the undeformed surface, (gdim,) (length); None: there is none.
        crossed: A place that has crossed the obstacle in the increment; None: there is none.
    """

    depth: float = 0.0
    allowed: float = 0.0
    place: list[float] | None = None
    crossed: list[float] | None = None

    @classmethod
    def of(cls, comm: MPI.Comm, probe: _Probe, resisted: ResistedDepth) -> Tunnelling:
        """Verifier the places of one contact, by what the points of all resist. Collective."""
        depth, allowed = probe.depth(resisted)
        worst = _worst(comm, depth - allowed, np.column_stack([depth, allowed, probe.x]))
        through = probe.crossed(allowed)
        crossed = _worst(comm, np.ones(len(through)), through)
        return cls(
            depth=0.0 if worst is None else float(worst[0]),
            allowed=0.0 if worst is None else float(worst[1]),
            place=None if worst is None else [float(x) for x in worst[2:]],
            crossed=None if crossed is None else [float(x) for x in crossed],
        )

    def conditions(self, contact: str) -> list[Condition]:
        """The conditions on a contact of this name."""
        deep = (
            f"{contact}: what lies opposite penetrates between the quadrature points of Γc, by "
            f"{self.depth:.3e} near {place_in_words(self.place or [])} in the undeformed body, "
            f"where the points around explain {self.allowed:.3e}; refine Γc there or give "
            "ContactSurface a larger quadrature_degree; between two bodies let the finer surface "
            "be Γc, or add a second contact with the surfaces swapped"
        )
        through = (
            f"{contact}: in one increment a part of Γc has crossed what lies opposite, at "
            f"{place_in_words(self.crossed or [])} in the undeformed body; load in smaller steps "
            "(increments() cuts them by itself), and include in Γc and in the opposite surface all "
            "sides that may touch"
        )
        return [
            Condition(f"penetration between points, {contact}", self.depth, self.allowed, deep),
            Condition(f"tunnelling, {contact}", float(self.crossed is not None), 0.0, through),
        ]


class TunnellingCheck:
    """Looks at the contacts of a problem, again where they have moved by enough to find anything.

    No distance changes by more than the way. A place that was clear of a penetration that matters
    by more than it has moved since needs no second probe.
    """

    def __init__(self, contacts: Sequence[Contact]) -> None:
        """Take the contacts; of a gap that is prescribed the geometry is not looked at."""
        self._contacts = [
            c
            for c in contacts
            if not c.gap_prescribed and (not c.rigid or c.contact_kinematics.sampler is not None)
        ]
        # By contact the last probe of a committed state, and the last one.
        self._committed: dict[str, Any] = {}
        self._last: dict[str, Any] = {}

    def evaluate(self, before: fem.Function | None) -> dict[str, Tunnelling]:
        """Verifier the contacts, evaluated at the end of an increment, by their names. Collective.

        Without the displacement at the last commit paths are not followed.
        """
        if not self._contacts:
            return {}
        comm = self._contacts[0].surface.mesh.comm
        probes, moved = {}, []
        for contact in self._contacts:
            name = contact.name
            known = None if before is None else self._known(contact, before)
            if known is not None and known.is_valid_for(contact):
                probes[name] = known
                continue
            probe: _Probe = (
                RigidObstacleProbe(contact, before, known)
                if contact.rigid
                else OpposingBodyProbe(contact, before, known)
            )
            probes[name] = probe
            moved.append(name)
            self._last[name] = probe
        if not moved:
            return {name: Tunnelling() for name in probes}
        parts = [part for probe in probes.values() for part in probe.resisted]
        vertices, depth = zip(*parts, strict=True)
        resisted = ResistedDepth.of(comm, vertices, depth)
        return {
            name: Tunnelling.of(comm, probe, resisted) if name in moved else Tunnelling()
            for name, probe in probes.items()
        }

    def _known(self, contact: Contact, before: fem.Function) -> Any:
        """The last probe of a committed state; None if there is none. Collective."""
        comm, last = contact.surface.mesh.comm, self._last.get(contact.name)
        # A trial state that was refused may have the displacement, but not the obstacle's place.
        is_trial = last is None or not last.is_of_committed(contact, before)
        if comm.allreduce(int(is_trial)) == 0:
            self._committed[contact.name] = last
        return self._committed.get(contact.name)


def _worst(comm: MPI.Comm, excess: Array, rows: Array) -> Array | None:
    """The row, over all ranks, whose excess is largest, if it is positive. Collective."""
    chosen = excess > 0
    if not comm.allreduce(int(chosen.any())):
        return None
    found = gather_rows(comm, np.column_stack([excess, rows])[chosen])
    worst: Array = found[np.lexsort(found.T[::-1])][-1, 1:]
    return worst
