"""Bodies that nothing loads or touches any more, farther away than anything has pushed them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fenics_contact.checks.rigid_motions import RigidMotions
from fenics_contact.parallel import global_sum
from fenics_contact.systems.full import FullSystem
from fenics_contact.types import Array

__all__ = ["strays"]

# Share of the forces by which a body is as stiff as the stiffest, turned by its size, that is none.
_NOTHING = 1e-12
# How many times as far as all else a body may go. Blocks thrown out from between two others went
# ten times as far; one that is let go springs back by as much as it changes its shape.
_FAR = 3.0
# Of the size of the mesh: what is no way at all.
_STILL = 1e-6


def strays(
    full: FullSystem, motions: RigidMotions, contacts: Sequence[Array], began: Array | None
) -> dict[str, tuple[float, float]]:
    """Bodies that have gone away, and on which no force acts. Collective.

    Such a body is in equilibrium wherever it is, and a step of an iteration that throws it out of
    sight of all others leaves no residual. A wedge that was pressed in may come out as far.

    Args:
        full: The system at its present state.
        motions: Rigid motions of the bodies.
        contacts: Forces of each at this rank's unknowns.
        began: The state in which the increment began; None: something was borne in it.

    Returns:
        By its name how far a body has gone, and how far anything else has (length). With rigid
        supports, whose points may go any way, and where something was borne, nothing is looked at.
    """
    if began is None:
        return {}
    loose = motions.loose()
    if not loose.any() or not all(contact.opposite.follows for contact in full.contacts):
        return {}
    comm, n = full.unknowns.comm, len(loose)
    # What has a load is not in equilibrium, and may be on its way to be set down.
    forces = sum((np.abs(f) for f in contacts), np.abs(full.load))
    borne = global_sum(comm, np.bincount(full.label, forces, minlength=n)[:n])
    gone = loose & (borne <= _NOTHING * full.bulk.scale * motions.size)
    if not gone.any():
        return {}
    change, bodies = full.state() - began, motions.of_bodies[:, : full.gdim]
    sums = global_sum(comm, np.column_stack([bodies @ change, bodies[:, 0].sum(axis=1)]))
    ways = sums[:, :-1] / sums[:, -1:]
    # Of a body that has gone away it is the change of its shape, or its turn.
    shift = np.where(gone[:, None], ways, 0.0)
    others = change - np.einsum("bd,bdi->i", shift, bodies)
    mine = np.any(bodies != 0.0, axis=1)  # displacements, of every body
    farthest = [np.abs(others[row]).max(initial=0.0) for row in mine]
    most = np.max(comm.allgather(farthest), axis=0)
    found = {}
    for b in np.flatnonzero(gone):
        way = float(np.linalg.norm(ways[b]))
        rest = float(np.append(most[~gone], most[b]).max())
        if way > max(_FAR * rest, _STILL * motions.size):
            found[full.parts.names[b]] = way, rest
    return found
