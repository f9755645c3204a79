"""Loads that friction cannot bear, by limit analysis with the pressures that were found.

Of a body that the load would move along a rigid motion r contact takes at most
D(r) = ∫ limit |r_t|, where limit (μ p) is given and r does not press the body into its opposite.
There is an equilibrium under given limits if no such motion has load · r > D(r): elasticity has no
say, for it does no work on rigid motions. The worst of them is sought by cutting planes: D is
convex, and the motions are few.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize
from mpi4py import MPI

from fenics_contact.parallel import broadcast_from_root, global_max, global_sum
from fenics_contact.systems.operator import ContactOperator
from fenics_contact.systems.rigid_body_modes import RigidBodyModes
from fenics_contact.tolerances import NEGLIGIBLE
from fenics_contact.types import Array, Index

__all__ = ["CLEARLY", "Overload", "find_overload"]

# From this factor of an `Overload` on friction is too little even by pressures that are not exact.
CLEARLY = 1.02
# Steps of the search, and how close to the worst motion it ends.
_STEPS, _NEAR = 200, 1e-3
# Motions are of order one; where friction takes nothing of one, the search is kept within this.
_FAR = 1e4
# Share of the largest motion below which one is not named.
_SLIGHT = 0.02


@dataclass(frozen=True)
class Overload:
    """A rigid motion by which the load outdoes friction.

    Attributes:
        motion: Its name.
        load: What the load does along it (force).
        borne: What friction takes of that at most (force).
    """

    motion: str
    load: float
    borne: float

    @property
    def factor(self) -> float:
        """How many times the limits of friction the load needs; infinite where there are none."""
        return self.load / self.borne if self.borne > 0 else np.inf

    def in_words(self) -> str:
        """What outdoes what."""
        return (
            f"overload: along the {self.motion} the load is {self.load:.4g}, but friction under "
            f"the present pressures can balance at most {self.borne:.4g}"
        )


def find_overload(
    motions: RigidBodyModes, operators: Sequence[ContactOperator], load: Array
) -> Overload | None:
    """The worst motion by which the load outdoes friction at its present limits. Collective.

    Groups of bodies that no contact couples are looked at apart. Whatever is found does; where the
    search is not at its end there may be worse.

    Args:
        motions: Which of them are free.
        operators: Of evaluated contacts, over all unknowns.
        load: External forces at this rank's unknowns (force).

    Returns:
        None where friction can bear the load, or nothing can be told: obstacles that turn, places
        that follow the bodies, tangential forces without limit, friction bounds that depend on
        the motion itself.
    """
    if motions.turning:
        return None
    (wanted, _), groups = motions.load_resultant(load, operators), motions.groups()
    found: list[Overload] = []
    for group in np.unique(groups):
        overload = _worst_motion(motions, operators, np.flatnonzero(groups == group), wanted)
        if overload is not None:
            found.append(overload)
    return max(found, key=lambda overload: overload.factor) if found else None


def _worst_motion(
    motions: RigidBodyModes, operators: Sequence[ContactOperator], rows: Index, wanted: Array
) -> Overload | None:
    """`find_overload` for the free motions of one group, by their numbers. Collective.

    Args:
        motions: See `find_overload`.
        operators: See `find_overload`.
        rows: Numbers of the motions, (n,).
        wanted: Work of the load on all free motions (force).
    """
    comm, wanted = motions.comm, wanted[rows]
    size = np.abs(wanted).max(initial=0.0)
    if not size > 0:
        return None
    coupled = []
    for operator in operators:
        modes = motions.at_points(operator)[rows]
        if global_max(comm, np.abs(modes)) > 0.0:
            coupled.append((operator.contact, modes))
    contacts = [contact for contact, _ in coupled]
    rubbing = [c for c in contacts if c.law.has_friction]
    unlimited = any(c.law.has_tangential and not c.law.has_friction for c in contacts)
    unlimited |= any(c.effective_law.own.bound_depends_on_motion for c in rubbing)
    if unlimited or not rubbing or any(c.finite or c.law.has_tension for c in contacts):
        return None
    finite = all(
        np.isfinite(v).all()
        for c in rubbing
        for v in (c.values.bound_of_law, c.values.circumradius)
    )
    if not comm.allreduce(finite, op=MPI.LAND):  # unknown, or of a state that has gone astray
        return None
    sliding, approaching = [], []
    for contact, modes in coupled:
        normal = contact.values.normal
        along = np.einsum("mqd,qd->mq", modes, normal)
        if contact.law.has_normal_stiffness:
            approaching.append(along[:, contact.paired])
        if contact.law.has_friction:
            across = modes - along[:, :, None] * normal
            # An open point may close: it counts with the bound that the law has without pressure.
            bound = contact.values.bound_of_law * contact.values.circumradius
            sliding.append((across, contact.measure * bound))
    closing = np.concatenate(approaching or [np.zeros((len(wanted), 0))], axis=1)

    def taken(motion: Array) -> tuple[float, Array]:
        """D and its derivative."""
        found: Array = np.zeros(1 + len(motion))
        for across, limit in sliding:
            slip = np.tensordot(motion, across, axes=1)
            way = np.linalg.norm(slip, axis=1)
            direction = slip / np.maximum(way, np.finfo(float).tiny)[:, None]
            found[0] += limit @ way
            found[1:] += np.einsum("mqd,qd,q->m", across, direction, limit)
        found = global_sum(comm, found)
        return float(found[0]), found[1:]

    # All in units of the load; D ≤ 1 bounds the motion, and the load does on it what it can.
    planes: list[Array] = []
    bounds: list[float] = []
    worst, most = None, 0.0
    motion: Array = wanted / size
    for _ in range(_STEPS):
        borne, slope = taken(motion)
        planes.append(slope / size)
        bounds.append(1.0)
        pressed = motion @ closing
        largest = np.abs(motion).max()
        deepest = global_max(comm, pressed, empty=0.0)
        if deepest > NEGLIGIBLE * largest:
            first = comm.allgather(pressed.size > 0 and pressed.max() == deepest).index(True)
            row = closing[:, np.argmax(pressed)] if comm.rank == first else None
            planes.append(comm.bcast(row, root=first))
            bounds.append(0.0)
        elif wanted @ motion > most * borne:
            most = float(wanted @ motion) / borne if borne > 0 else np.inf
            worst = motion / largest
        made = scipy.optimize.linprog(
            -wanted / size, A_ub=planes, b_ub=bounds, bounds=(-_FAR, _FAR)
        )
        status, motion = broadcast_from_root(comm, (made.status, made.x))
        if status != 0 or wanted @ motion / size <= max(1.0, most * (1 + _NEAR)):
            break
    if worst is None or most <= 1.0:
        return None
    named = np.where(np.abs(worst) < _SLIGHT, 0.0, worst) @ motions.free[rows]
    return Overload(motions.describe(named), float(wanted @ worst), taken(worst)[0])
