"""Bodies that nothing holds yet, before an increment: they are moved to first touch."""

from __future__ import annotations

import numpy as np

from fenics_contact.checks.rigid_motions import RigidMotions
from fenics_contact.contact.values import Status
from fenics_contact.parallel import global_sum
from fenics_contact.systems.full import FullSystem
from fenics_contact.types import Array

__all__ = ["Approach"]

# Contact forces that sum up to less than this share of the load on a free motion are none yet.
_IDLE = 1e-3


class Approach:
    """Where bodies without contact come from and go to."""

    def __init__(self, full: FullSystem, motions: RigidMotions) -> None:
        """Take the present state for the one that bodies begin in."""
        self._full, self._motions = full, motions
        self._rest = full.state()

    def lead(self, load: Array, *, first: bool) -> bool:
        """Move bodies that nothing holds yet to first touch, along their load. Collective.

        One that was released before rests wherever that ended, turned perhaps by more than the load
        will press it together: it starts again from where it began.

        Args:
            load: External forces at this rank's unknowns (force).
            first: Whether it is the first increment.

        Returns:
            Whether nothing was borne before.
        """
        full, motions = self._full, self._motions
        if not len(motions.free):
            return first
        cold = first
        for contact in full.contacts:
            contact.evaluate()
        # Of contact not the resultants: those of a body that friction has locked are zero.
        forces = [c.measure @ np.abs(c.values.total_traction).sum(axis=1) for c in full.contacts]
        borne = float(global_sum(full.unknowns.comm, sum(forces, 0.0)))
        outside = np.abs(motions.resultants(load)).max(initial=0.0)
        if borne < _IDLE * outside:
            cold = True
            full.set_state(np.where(full.constrained, full.state(), self._rest))
            for contact in full.contacts:
                contact.evaluate()
        touching = [bool(np.any(c.status != Status.OPEN)) for c in full.contacts]
        if not full.unknowns.comm.allreduce(any(touching)):
            way = motions.approach(load, full.operators)
            if way is not None:
                full.set_state(full.state() + np.where(full.constrained, 0.0, way))
        return cold
