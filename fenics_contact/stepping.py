"""Load histories: loads led through their values, one committed increment after another."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from dolfinx import fem

from fenics_contact import checkpoint as files
from fenics_contact.errors import quantities
from fenics_contact.parallel import collective_errors
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
    steps: int | Sequence[float] | None = None,
    max_cuts: int = 6,
    estimate: bool = False,
    checkpoint: str | Path | None = None,
    checkpoint_every: int = 1,
    field: str | int = "every",
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
        steps: Number of equal increments, by default what the contacts' ``accuracy`` takes, or 1;
            or the ends of the increments themselves, monotonic from ``start`` to ``end``.
        max_cuts: How often an increment may be halved.
        estimate: Whether to tell the error that the size of the increments makes: every one is
            solved twice, whole, which is not committed, and in two halves, which are. The steps at
            the ends of whole ones have ``increment_error``.
        checkpoint: File to keep the last committed state in (``.npz``). If it is there when the
            history starts, the history goes on behind it; see `checkpoint.save`.
        checkpoint_every: Write it after every so many increments, and after the last.
        field: When all of u is found: "every" increment; at the "last" only; or a number: every so
            many increments, and at the last. Where the problem is condensed, increments in between
            save the larger part of their cost; there only the contacts' results are those of the
            increment, u is behind except on Γc until `ContactProblem.complete`, and
            ``Step.complete`` says so. Before a checkpoint is written u is completed.

    Yields:
        The step, after its commit; ``load`` is its load parameter, and ``rungs`` has what was tried
        before the increment was cut, too.

    Raises:
        ValueError: ``load`` is no scalar constant or function, ``steps`` or ``field`` has no sense,
            or the checkpoint is of a history without ``estimate``.
        NotConverged: An increment failed even when cut; u, history and load are those of the last
            committed one.
    """
    ends = _ends(start, end, problem.increments_wanted if steps is None else steps)
    if field not in ("every", "last") and not (isinstance(field, int | np.integer) and field >= 1):
        raise ValueError(f'field is {field!r}; it must be "every", "last", or a number from 1')
    comm = problem.u.function_space.mesh.comm
    set_load = _setter(load)
    problem.expect(len(ends) * (3 if estimate else 1))

    def apply(value: float) -> None:
        with collective_errors(comm):
            set_load(value)

    at = _Progress(float(start))
    error = dict.fromkeys(quantities(problem), 0.0) if estimate else {}
    if checkpoint is not None and files.exists(problem, checkpoint):
        n = len(dataclasses.fields(_Progress))
        numbers = files.load(problem, checkpoint)
        at = _Progress(*numbers[:n])
        if len(numbers) != n + len(error):
            raise ValueError(
                f"{checkpoint} is of a history {'without' if estimate else 'with'} estimate; go on "
                "in the same way, or remove it to start anew"
            )
        error = dict(zip(error, numbers[n:], strict=True))
        logger.info("going on from %s, at load %g", checkpoint, at.load)
    apply(at.load)
    if problem.increment:
        problem.take_up_loads()
    direction = 1.0 if end >= start else -1.0
    unsaved = behind = 0
    failed: list[Rung] = []
    halves: list[float] = []  # of an increment that was solved whole, with these results
    whole: dict[str, float] = {}
    for target in ends:
        while direction * (target - at.load) > 0:
            # A remainder that is next to nothing is taken along.
            within = abs(target - at.load) <= 1.01 * at.largest
            goal = target if within else at.load + direction * at.largest
            try:
                if estimate and not halves:
                    _solve_to(goal, problem, apply, at)
                    whole = quantities(problem)
                    problem.restore()
                    halves = [0.5 * (at.load + goal), goal]
                goal = halves[0] if halves else goal
                wanted = goal == ends[-1] or field == "every" or estimate or behind + 1 == field
                step = _solve_to(goal, problem, apply, at, field=wanted)
            except BaseException as failure:
                apply(at.load)
                halves = []
                if not isinstance(failure, NotConverged):
                    raise
                failed += failure.rungs
                if at.cuts == max_cuts:
                    failure.rungs = tuple(failed)
                    problem.complete()
                    raise
                at.cut(abs(goal - at.load))
                failed.append(Rung("cut", 0, f"to {at.largest:g}"))
                if comm.rank == 0:
                    logger.warning(
                        "increment %d, to load %g, did not converge: cut to %g",
                        failure.increment,
                        goal,
                        at.largest,
                    )
                continue
            problem.commit()
            at.advance(goal)
            halves = halves[1:]
            found = None
            if estimate and not halves:
                # Of first order in the size of the increments: half of the error of the whole one,
                # which is as much as the difference, is left in the halves.
                now = quantities(problem)
                error = {name: error[name] + whole[name] - now[name] for name in now}
                found = dict(error)
            behind = 0 if step.complete else behind + 1
            unsaved += 1
            # Halves belong together: between them the whole one's results would be lost.
            due = unsaved >= checkpoint_every and not halves
            if checkpoint is not None and (due or goal == ends[-1]):
                files.save(problem, checkpoint, [*dataclasses.astuple(at), *error.values()])
                unsaved = 0
            tried, failed = (*failed, *step.rungs), []
            yield dataclasses.replace(step, load=goal, rungs=tried, increment_error=found)


def _solve_to(
    goal: float,
    problem: ContactProblem,
    apply: Callable[[float], None],
    at: _Progress,
    *,
    field: bool = True,
) -> Step:
    """Solve for a load parameter from the last committed one. Collective."""
    apply(goal)
    return problem.solve(ahead=(goal - at.load) / at.last if at.last else 1.0, field=field)


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
