"""Load histories: loads led through their values, one committed increment after another."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from dolfinx import fem

from fenics_contact import checkpoint as files
from fenics_contact.problem import ContactProblem, Step
from fenics_contact.verdict import NotConverged, Rung

__all__ = ["increments"]

logger = logging.getLogger("fenics_contact")

# Increments in a row without failure after which a cut one may grow again.
_PATIENCE = 2


def increments(
    problem: ContactProblem,
    load: fem.Constant | Callable[[float], None],
    start: float = 0.0,
    end: float = 1.0,
    *,
    steps: int | Sequence[float] = 1,
    max_cuts: int = 6,
    checkpoint: str | Path | None = None,
    checkpoint_every: int = 1,
) -> Iterator[Step]:
    """Lead the load parameter from ``start`` to ``end``; solve and commit increments. Collective.

    An increment that does not converge is halved, and halved again; after two that do it is doubled
    until it has its size again. All of the parameter's values that were asked for are met.

    Args:
        problem: The problem.
        load: A scalar constant in the bulk form, a boundary condition or a support, which takes
            the value of the load parameter; or a function that sets whatever depends on it:
            constants, functions, the forces on supports.
        start: The load parameter now; not solved for.
        end: Its value at the last increment.
        steps: Number of equal increments; or the ends of the increments themselves, monotonic
            from ``start`` to ``end``.
        max_cuts: How often an increment may be halved.
        checkpoint: File to keep the last committed state in (``.npz``). If it is there when the
            history starts, the history goes on behind it; see `checkpoint.save`.
        checkpoint_every: Write it after every so many increments, and after the last.

    Yields:
        The step, after its commit; ``load`` is its load parameter, and ``rungs`` has what was tried
        before the increment was cut, too.

    Raises:
        ValueError: ``load`` is no scalar constant or function, or ``steps`` has no sense.
        NotConverged: An increment failed even when cut; u, history and load are those of the last
            committed one.
    """
    ends = _ends(start, end, steps)
    apply = _setter(load)
    at = _Progress(float(start))
    if checkpoint is not None and files.exists(problem, checkpoint):
        at = _Progress(*files.load(problem, checkpoint))
        logger.info("going on from %s, at load %g", checkpoint, at.load)
    apply(at.load)
    if problem.increment:
        problem.take_up_loads()
    direction = 1.0 if end >= start else -1.0
    unsaved = 0
    failed: list[Rung] = []
    for target in ends:
        while direction * (target - at.load) > 0:
            # A remainder that is next to nothing is taken along.
            within = abs(target - at.load) <= 1.01 * at.largest
            goal = target if within else at.load + direction * at.largest
            try:
                apply(goal)
                step = problem.solve(ahead=(goal - at.load) / at.last if at.last else 1.0)
            except BaseException as error:
                apply(at.load)
                if not isinstance(error, NotConverged):
                    raise
                failed += error.rungs
                if at.cuts == max_cuts:
                    error.rungs = tuple(failed)
                    raise
                at.cut(abs(goal - at.load))
                failed.append(Rung("cut", 0, f"to {at.largest:g}"))
                if problem.u.function_space.mesh.comm.rank == 0:
                    logger.warning(
                        "increment %d, to load %g, did not converge: cut to %g",
                        error.increment,
                        goal,
                        at.largest,
                    )
                continue
            problem.commit()
            at.advance(goal)
            unsaved += 1
            if checkpoint is not None and (unsaved >= checkpoint_every or goal == ends[-1]):
                files.save(problem, checkpoint, dataclasses.astuple(at))
                unsaved = 0
            tried, failed = (*failed, *step.rungs), []
            yield dataclasses.replace(step, load=goal, rungs=tried)


@dataclasses.dataclass
class _Progress:
    """Where a history stands; numbers only, so that a checkpoint can hold it.

    Attributes:
        load: Load parameter of the last committed increment.
        last: Size of that increment; 0 before the first.
        largest: Largest size of the next one, infinite where none was cut.
        cuts: How often increments have been halved and not doubled since.
        successes: Increments since the last halving or doubling.
    """

    load: float
    last: float = 0.0
    largest: float = np.inf
    cuts: float = 0
    successes: float = 0

    def cut(self, tried: float) -> None:
        self.largest, self.cuts, self.successes = tried / 2, self.cuts + 1, 0

    def advance(self, goal: float) -> None:
        self.last, self.load = goal - self.load, goal
        self.successes += 1
        if self.cuts and self.successes >= _PATIENCE:
            self.cuts, self.successes = self.cuts - 1, 0
            self.largest = 2 * self.largest if self.cuts else np.inf


def _setter(load: fem.Constant | Callable[[float], None]) -> Callable[[float], None]:
    if isinstance(load, fem.Constant):
        if load.value.ndim:
            raise ValueError(f"load has shape {load.value.shape}; it must be a scalar fem.Constant")

        def assign(value: float) -> None:
            load.value = value

        return assign
    if not callable(load):
        raise ValueError(
            f"load is a {type(load).__name__}; it must be a scalar fem.Constant, or a function of "
            "the load parameter that sets the loads"
        )
    return load


def _ends(start: float, end: float, steps: int | Sequence[float]) -> list[float]:
    """Ends of the increments that are asked for."""
    if isinstance(steps, int | np.integer):
        if steps < 1:
            raise ValueError(f"steps is {steps}; it must be at least 1")
        return [start + (end - start) * (i / steps) for i in range(1, steps)] + [float(end)]
    ends = [float(value) for value in steps]
    ways = np.diff([start, *ends])
    if not ends or ends[-1] != end or not (np.all(ways > 0) or np.all(ways < 0)):
        raise ValueError(
            f"steps is {ends}; it must be a number, or the ends of the increments, rising or "
            f"falling from start = {start:g} to end = {end:g}"
        )
    return ends
