"""Penetration between the quadrature points of Γc, and tunnelling, at the positions X + u.

- *Depth.* At points, corners, and midpoints of edges and facets the penetration must not exceed
  that of the nearby quadrature points by more than gap and normals there predict.
- *Path.* Within an increment no such position may pass through an opposing body, and no point of
  a rigid obstacle near Γc may enter the body.
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
from fenics_contact.wording import format_point

__all__ = ["Tunnelling", "TunnellingCheck"]

_Probe: TypeAlias = RigidObstacleProbe | OpposingBodyProbe


@dataclass(frozen=True)
class Tunnelling:
    """Penetration of one contact that the law does not resist; the same on every rank.

    Attributes:
        depth: Penetration at the position where it exceeds the allowed one most (length).
        allowed: Allowed penetration there (length).
        place: That position on the undeformed surface, (gdim,) (length); None without an excess.
        crossed: A position that has crossed the obstacle in the increment; None if none has.
    """

    depth: float = 0.0
    allowed: float = 0.0
    place: list[float] | None = None
    crossed: list[float] | None = None

    @classmethod
    def of(cls, comm: MPI.Comm, probe: _Probe, resisted: ResistedDepth) -> Tunnelling:
        """Verify one contact, given the penetration that all contacts resist. Collective."""
        depth, allowed = probe.depth(resisted)
        worst = _find_worst(comm, depth - allowed, np.column_stack([depth, allowed, probe.x]))
        positions = probe.find_crossed(allowed)
        crossed = _find_worst(comm, np.ones(len(positions)), positions)
        return cls(
            depth=0.0 if worst is None else float(worst[0]),
            allowed=0.0 if worst is None else float(worst[1]),
            place=None if worst is None else [float(x) for x in worst[2:]],
            crossed=None if crossed is None else [float(x) for x in crossed],
        )

    def conditions(self, contact: str) -> list[Condition]:
        """Return the conditions on a contact of this name."""
        too_deep = (
            f"{contact}: the obstacle penetrates between the quadrature points of Γc, by "
            f"{self.depth:.3e} near {format_point(self.place or [])} in the undeformed body, "
            f"where the points around allow {self.allowed:.3e}; refine Γc there or give "
            "ContactSurface a larger quadrature_degree; between two bodies let the finer surface "
            "be Γc, or add a second contact with the surfaces swapped"
        )
        has_crossed = (
            f"{contact}: in one increment a part of Γc has crossed the obstacle, at "
            f"{format_point(self.crossed or [])} in the undeformed body; load in smaller steps "
            "(increments() cuts them by itself), and include in Γc and in the opposite surface all "
            "sides that may touch"
        )
        return [
            Condition(f"penetration between points, {contact}", self.depth, self.allowed, too_deep),
            Condition(f"tunnelling, {contact}", float(self.crossed is not None), 0.0, has_crossed),
        ]


class TunnellingCheck:
    """Verifies the contacts of a problem, and reuses probes while displacements are small.

    A distance changes by no more than the displacement: a position with a larger clearance needs
    no second probe.
    """

    def __init__(self, contacts: Sequence[Contact]) -> None:
        """Select the contacts whose gap follows from the geometry."""
        self._contacts = [
            c
            for c in contacts
            if not c.gap_prescribed
            and (not c.contact_kinematics.is_rigid or c.contact_kinematics.sampler is not None)
        ]
        # The last probe of a committed state, and the last one, by contact.
        self._committed: dict[str, Any] = {}
        self._last: dict[str, Any] = {}

    def evaluate(self, before: fem.Function | None) -> dict[str, Tunnelling]:
        """Verify the evaluated contacts, and their paths from the state ``before``. Collective."""
        if not self._contacts:
            return {}
        comm = self._contacts[0].surface.mesh.comm
        probes, renewed = {}, []
        for contact in self._contacts:
            name = contact.name
            committed = None if before is None else self._committed_probe(contact, before)
            if committed is not None and committed.is_valid_for(contact):
                probes[name] = committed
                continue
            probe: _Probe = (
                RigidObstacleProbe(contact, before, committed)
                if contact.contact_kinematics.is_rigid
                else OpposingBodyProbe(contact, before, committed)
            )
            probes[name] = probe
            renewed.append(name)
            self._last[name] = probe
        if not renewed:
            return {name: Tunnelling() for name in probes}
        parts = [part for probe in probes.values() for part in probe.resisted]
        vertices, depth = zip(*parts, strict=True)
        resisted = ResistedDepth.of(comm, vertices, depth)
        return {
            name: Tunnelling.of(comm, probe, resisted) if name in renewed else Tunnelling()
            for name, probe in probes.items()
        }

    def _committed_probe(self, contact: Contact, before: fem.Function) -> Any:
        """Return the last probe of a committed state, or None. Collective."""
        comm, last = contact.surface.mesh.comm, self._last.get(contact.name)
        # A rejected trial state may have this displacement with another position of the obstacle.
        is_trial = last is None or not last.is_at_commit(contact, before)
        if comm.allreduce(int(is_trial)) == 0:
            self._committed[contact.name] = last
        return self._committed.get(contact.name)


def _find_worst(comm: MPI.Comm, excess: Array, rows: Array) -> Array | None:
    """Return the row of the largest positive excess on all ranks, or None. Collective."""
    positive = excess > 0
    if not comm.allreduce(int(positive.any())):
        return None
    table = gather_rows(comm, np.column_stack([excess, rows])[positive])
    worst: Array = table[np.lexsort(table.T[::-1])][-1, 1:]
    return worst
