"""A block on a rigid ball, pressed and slid back and forth: points are open, stick and slip."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.types import Array
from scenes.blocks import TOP, Block, block, dimension
from scenes.comparing import at_points, close, nodal

COMM = MPI.COMM_WORLD

# Relative difference of two solutions. On several ranks MUMPS sums in the order in which messages
# arrive: runs differ by round-off, and the residual is only at most 1e-9 (relative).
SAME = 0.0 if COMM.size == 1 else 1e-7


def cushion(d: int, displacement: Any = None, *, length: float = 1.0) -> fc.Ball:
    """Return a ball or disc of radius 2 ``length`` that touches the middle of a block's bottom."""
    center = np.full(d, 0.5 * length)
    center[-1] = -2.0 * length
    return fc.Ball(center, 2.0 * length, displacement=displacement)


class Rub:
    """A block on a ball, with a prescribed displacement of its top.

    Attributes:
        scene: The block.
        push: Displacement of the top, one constant per component.
        contact, problem: The contact and its problem.
    """

    def __init__(
        self,
        law: Any = None,
        *,
        cell: str = "quadrilateral",
        degree: int = 1,
        length: float = 1.0,
        pressure: float = 1.0,
        reach: float = 0.1,
        mesh: dict | None = None,
        contact: dict | None = None,
        **options: Any,
    ) -> None:
        """Create the unloaded problem, with lengths and stresses multiplied by the given factors.

        ``reach`` is the amplitude of sliding in `load`; ``mesh``, ``contact`` and the other options
        are arguments of `block_mesh`, of the contact, and of the problem.
        """
        d = dimension(cell)
        mesh = {"n": 4, "size": length * np.ones(d)} | (mesh or {})
        self.scene: Block = block(cell, degree, E=1000 * pressure, **mesh)
        self.push = [fem.Constant(self.scene.mesh, 0.0) for _ in range(d)]
        self.reach = reach
        bcs = [self.scene.hold(TOP, i, c) for i, c in enumerate(self.push)]
        stiffness = pressure / length
        if law is None:
            law = fc.Coulomb(0.3, k_n=2e4 * stiffness, k_t=1e4 * stiffness)
        contact = (contact or {}) | {"obstacle": cushion(d, length=length)}
        self.problem, self.contact = self.scene.problem(law, bcs, contact=contact, **options)

    def move(self, side: float, down: float) -> None:
        """Set the displacement of the top."""
        self.push[0].value = side
        self.push[-1].value = -down

    def load(self, t: float) -> None:
        """Press until t = 1, slide until 2, and slide back until 4."""
        self.move(np.interp(t, [1, 2, 4], [0, self.reach, -self.reach]), 0.03 * min(t, 1.0))


class Aslant(Rub):
    """A block on a ball whose top moves down, and half as far sideways, in proportion to t."""

    def load(self, t: float) -> None:
        """Set the displacement of the top at t; it is complete at t = 1."""
        self.move(0.015 * t, 0.03 * t)

    def run(self, **options: Any) -> list[fc.Step]:
        """Return all steps up to t = 1."""
        return list(fc.increments(self.problem, self.load, **options))


# Displacements (side, down) of the top: pressing, sliding, reversal beyond zero, and partial
# unloading.
PATH = [(0.0, 0.02), (0.002, 0.03), (0.02, 0.03), (0.016, 0.03), (-0.01, 0.03), (-0.01, 0.01)]


def walk(
    made: Rub, length: float = 1.0, path: Sequence[tuple[float, float]] = PATH
) -> list[fc.Step]:
    """Solve and commit all increments of the path."""
    steps = []
    for side, down in path:
        made.move(side * length, down * length)
        steps.append(made.problem.solve())
        made.problem.commit()
    return steps


def snapshot(made: Rub) -> tuple[Array, ...]:
    """Return copies of this rank's displacement and contact history."""
    history = made.contact.history.function.x.array.copy()
    return made.scene.u.x.array.copy(), history


def pressed(
    cell: str,
    law: Any,
    method: str,
    *,
    side: float = 0.01,
    down: float = 0.03,
    n: int = 4,
    **options: Any,
) -> tuple[Block, fc.ContactProblem, fc.Contact]:
    """Return block, problem and contact of a loaded `Rub` that is not yet solved."""
    made = Rub(law, cell=cell, mesh={"n": n}, method=method, **options)
    made.move(side, down)
    return made.scene, made.problem, made.contact


def same_states(a: Rub, b: Rub, rtol: float) -> bool:
    """Return whether displacements and histories agree within ``rtol``; 0: bit for bit."""
    pairs = [
        [nodal(made.scene.u) for made in (a, b)],
        [at_points(made.contact, made.contact.history.rows()) for made in (a, b)],
    ]
    if rtol == 0.0:
        return all(np.array_equal(x, y) for x, y in pairs)
    return all(close(x, y, rtol) for x, y in pairs)


def limited(made: Rub, largest: float) -> list[float]:
    """Make increments fail if t grows by more than ``largest``; return the list of attempted t."""
    solve, tried, at = made.problem.solve, [], [0.0]
    now = [0.0]
    load, commit = made.load, made.problem.commit

    def note(t):
        now[0] = t
        load(t)

    def choosy(**kwargs):
        tried.append(now[0])
        if now[0] - at[0] > largest:
            made.problem.solver.main.max_it, kept = 0, made.problem.solver.main.max_it
            made.problem.snes.setTolerances(max_it=0)
            made.problem.solver.predictor.predict = False  # its result can be the solution
            try:
                return solve(**kwargs)
            finally:
                made.problem.solver.main.max_it = kept
                made.problem.snes.setTolerances(max_it=kept)
        return solve(**kwargs)

    def keep():
        commit()
        at[0] = now[0]

    made.load, made.problem.solve, made.problem.commit = note, choosy, keep
    return tried
