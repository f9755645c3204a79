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
from scenes.comparison import is_close, nodal_values, point_values

COMM = MPI.COMM_WORLD

# Relative difference of two solutions. On several ranks MUMPS sums in the order in which messages
# arrive: runs differ by round-off, and the residual is only at most 1e-9 (relative).
STATE_TOLERANCE = 0.0 if COMM.size == 1 else 1e-7


def supporting_ball(d: int, displacement: Any = None, *, length: float = 1.0) -> fc.Ball:
    """Return a ball or disc of radius 2 ``length`` that touches the middle of a block's bottom."""
    center = np.full(d, 0.5 * length)
    center[-1] = -2.0 * length
    return fc.Ball(center, 2.0 * length, displacement=displacement)


class BlockOnBall:
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
        amplitude: float = 0.1,
        mesh: dict | None = None,
        contact: dict | None = None,
        **options: Any,
    ) -> None:
        """Create the unloaded problem, with lengths and stresses multiplied by the given factors.

        ``amplitude`` is that of sliding in `load`; ``mesh``, ``contact`` and the other options are
        arguments of `block_mesh`, of the contact, and of the problem.
        """
        d = dimension(cell)
        mesh = {"n": 4, "size": length * np.ones(d)} | (mesh or {})
        self.scene: Block = block(cell, degree, E=1000 * pressure, **mesh)
        self.push = [fem.Constant(self.scene.mesh, 0.0) for _ in range(d)]
        self.amplitude = amplitude
        bcs = [self.scene.dirichlet_bc(TOP, i, c) for i, c in enumerate(self.push)]
        stiffness = pressure / length
        if law is None:
            law = fc.Coulomb(0.3, k_n=2e4 * stiffness, k_t=1e4 * stiffness)
        contact = (contact or {}) | {"obstacle": supporting_ball(d, length=length)}
        self.problem, self.contact = self.scene.problem(law, bcs, contact=contact, **options)

    def set_top_displacement(self, side: float, down: float) -> None:
        """Set the displacement of the top."""
        self.push[0].value = side
        self.push[-1].value = -down

    def load(self, t: float) -> None:
        """Press until t = 1, slide until 2, and slide back until 4."""
        self.set_top_displacement(
            np.interp(t, [1, 2, 4], [0, self.amplitude, -self.amplitude]), 0.03 * min(t, 1.0)
        )


class ObliqueBlockOnBall(BlockOnBall):
    """A block on a ball whose top moves down, and half as far sideways, in proportion to t."""

    def load(self, t: float) -> None:
        """Set the displacement of the top at t; it is complete at t = 1."""
        self.set_top_displacement(0.015 * t, 0.03 * t)

    def run(self, **options: Any) -> list[fc.Step]:
        """Return all steps up to t = 1."""
        return list(fc.increments(self.problem, self.load, **options))


# Displacements (side, down) of the top: pressing, sliding, reversal beyond zero, and partial
# unloading.
PATH = [(0.0, 0.02), (0.002, 0.03), (0.02, 0.03), (0.016, 0.03), (-0.01, 0.03), (-0.01, 0.01)]


def solve_path(
    scene: BlockOnBall, length: float = 1.0, path: Sequence[tuple[float, float]] = PATH
) -> list[fc.Step]:
    """Solve and commit all increments of the path."""
    steps = []
    for side, down in path:
        scene.set_top_displacement(side * length, down * length)
        steps.append(scene.problem.solve())
        scene.problem.commit()
    return steps


def copy_state(scene: BlockOnBall) -> tuple[Array, ...]:
    """Return copies of this rank's displacement and contact history."""
    history = scene.contact.history.function.x.array.copy()
    return scene.scene.u.x.array.copy(), history


def loaded_block(
    cell: str,
    law: Any,
    method: str,
    *,
    side: float = 0.01,
    down: float = 0.03,
    n: int = 4,
    **options: Any,
) -> tuple[Block, fc.ContactProblem, fc.Contact]:
    """Return block, problem and contact of a loaded `BlockOnBall` that is not yet solved."""
    scene = BlockOnBall(law, cell=cell, mesh={"n": n}, method=method, **options)
    scene.set_top_displacement(side, down)
    return scene.scene, scene.problem, scene.contact


def have_equal_states(a: BlockOnBall, b: BlockOnBall, rtol: float) -> bool:
    """Return whether displacements and histories agree within ``rtol``; 0: bit for bit."""
    pairs = [
        [nodal_values(made.scene.u) for made in (a, b)],
        [point_values(made.contact, made.contact.history.rows()) for made in (a, b)],
    ]
    if rtol == 0.0:
        return all(np.array_equal(x, y) for x, y in pairs)
    return all(is_close(x, y, rtol) for x, y in pairs)


def fail_increments_above(scene: BlockOnBall, largest: float) -> list[float]:
    """Make increments fail if t grows by more than ``largest``; return the list of attempted t."""
    solve, attempted, committed_t = scene.problem.solve, [], [0.0]
    current_t = [0.0]
    load, commit = scene.load, scene.problem.commit

    def record_load(t):
        current_t[0] = t
        load(t)

    def failing_solve(**kwargs):
        attempted.append(current_t[0])
        if current_t[0] - committed_t[0] > largest:
            scene.problem.solver.main.max_it, max_iterations = 0, scene.problem.solver.main.max_it
            scene.problem.snes.setTolerances(max_it=0)
            scene.problem.solver.equations.has_solution_tangent = False  # a step can solve it
            try:
                return solve(**kwargs)
            finally:
                scene.problem.solver.main.max_it = max_iterations
                scene.problem.snes.setTolerances(max_it=max_iterations)
        return solve(**kwargs)

    def record_commit():
        commit()
        committed_t[0] = current_t[0]

    scene.load, scene.problem.solve, scene.problem.commit = (
        record_load,
        failing_solve,
        record_commit,
    )
    return attempted
