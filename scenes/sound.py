"""A sound scene, to be spoilt in one respect."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from dolfinx import fem

import fenics_contact as fc
from scenes.blocks import Block, block

# Four layers of cells, so that on two and three ranks some rank has no part in a fault.
MESH = {"n": (2, 4)}


def pressed(**options: Any) -> Block:
    """A block pressed down with a pressure of one."""
    return block("quadrilateral", up=-1.0, **MESH, **options)


def coulomb(friction: Any = 0.3, k_n: Any = 1e4, k_t: Any = 1e3) -> fc.Coulomb:
    """A law that carries it."""
    return fc.Coulomb(friction, k_n=k_n, k_t=k_t)


def build_and_solve(
    scene: Block,
    law: Any = None,
    bcs: Sequence[fem.DirichletBC] | None = None,
    contact: dict | None = None,
    **options: Any,
) -> Callable[[], fc.Step]:
    """A call that makes the problem and solves it once."""

    def call() -> fc.Step:
        conditions = scene.rollers() if bcs is None else bcs
        problem, _ = scene.problem(law or coulomb(), conditions, contact=contact, **options)
        return problem.solve()

    return call
