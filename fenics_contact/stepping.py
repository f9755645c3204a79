"""Load histories: a constant led through its values, one committed increment after another."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from dolfinx import fem

from fenics_contact.problem import ContactProblem, Step

__all__ = ["increments"]


def increments(
    problem: ContactProblem, load: fem.Constant, start: float, end: float, *, steps: int = 1
) -> Iterator[Step]:
    """Lead ``load`` from ``start`` to ``end`` in equal steps; solve and commit each. Collective.

    Args:
        problem: The problem.
        load: A scalar constant in the bulk form, a boundary condition or a support.
        start: Its value now; not solved for.
        end: Its value at the last increment.
        steps: Number of increments.

    Yields:
        The step, after its commit.

    Raises:
        ValueError: ``load`` is no scalar constant, or ``steps`` < 1.
        NotConverged: An increment failed; u, history and load are those of the last committed one.
    """
    if load.value.ndim:
        raise ValueError(f"load has shape {load.value.shape}; it must be a scalar fem.Constant")
    if steps < 1:
        raise ValueError(f"steps is {steps}; it must be at least 1")
    load.value = start
    for i in range(1, steps + 1):
        committed = float(load.value)
        load.value = start + (end - start) * (i / steps)
        try:
            step = problem.solve()
        except BaseException:
            load.value = committed
            raise
        problem.commit()
        yield dataclasses.replace(step, load=float(load.value))
