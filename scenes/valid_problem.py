"""A valid contact problem, in which tests change one input to an invalid one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from dolfinx import fem

import fenics_contact as fc
from scenes.blocks import Block, block

# Four layers of cells, so that on two and three ranks a fault does not concern all ranks.
LAYERED_MESH = {"n": (2, 4)}


def pressed_block(**options: Any) -> Block:
    """Return a block with a pressure of 1 on its top."""
    return block("quadrilateral", up=-1.0, **LAYERED_MESH, **options)


def coulomb_law(friction: Any = 0.3, k_n: Any = 1e4, k_t: Any = 1e3) -> fc.Coulomb:
    """Return a valid Coulomb law for the pressed block."""
    return fc.Coulomb(friction, k_n=k_n, k_t=k_t)


def make_solve(
    scene: Block,
    law: Any = None,
    bcs: Sequence[fem.DirichletBC] | None = None,
    contact: dict | None = None,
    **options: Any,
) -> Callable[[], fc.Step]:
    """Return a function that creates the problem and solves it once."""

    def call() -> fc.Step:
        conditions = scene.rollers() if bcs is None else bcs
        problem, _ = scene.problem(law or coulomb_law(), conditions, contact=contact, **options)
        return problem.solve()

    return call
