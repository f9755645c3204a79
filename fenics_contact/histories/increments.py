"""Load histories: a load parameter is increased in committed increments."""

from __future__ import annotations

import dataclasses
import logging
import weakref
from collections.abc import Callable, Generator, Iterator, Sequence
from numbers import Real
from pathlib import Path

import numpy as np
from dolfinx import fem
from mpi4py import MPI

from fenics_contact.arguments import check_bool, check_instance, is_built_in
from fenics_contact.contact.contact import Contact
from fenics_contact.estimates.errors import quantities
from fenics_contact.failure import NotConverged
from fenics_contact.histories import checkpoint as states
from fenics_contact.histories.progress import ProgressBar
from fenics_contact.histories.table import Table
from fenics_contact.methods.attempt import Attempt
from fenics_contact.obstacles.base import SampledObstacle
from fenics_contact.parallel import collective_errors, global_sum, warn
from fenics_contact.problem import ContactProblem
from fenics_contact.results import files
from fenics_contact.step import Step
from fenics_contact.surface.dependence import Dependence
from fenics_contact.tolerances import NEGLIGIBLE
from fenics_contact.types import Array

__all__ = ["increments", "reads"]

logger = logging.getLogger("fenics_contact")

# Increments in a row without failure after which a cut one may grow again.
_PATIENCE = 2
# Towards a maximum of the load the displacement per load grows as 1/√(distance): from this factor
# on, by the mean of the history, a maximum is named where increments fail.
_LIMIT_POINT = 2.0


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
    recover_interior: str | int = "every",
    state_fields: Sequence[fem.Function] = (),
    on_mismatch: str = "refuse",
    csv: str | Path | None = None,
    progress: bool | str = False,
) -> Iterator[Step]:
    """Solve a load history: vary a load parameter from ``start`` to ``end``. Collective.

    The function returns an iterator; each increment is solved, verified and committed when the
    iterator is advanced, and nothing is solved before::

        for step in fc.increments(problem, pull, 0, 2.5, steps=5):
            print(step.summary())

    An increment that fails is halved repeatedly; after two successful increments the size is
    doubled again, up to the original one. All requested values of the load parameter are reached.

    Args:
        problem: The problem.
        load: A scalar constant in the bulk form, a boundary condition or an obstacle, which takes
            the value of the load parameter; or a function of the load parameter that sets
            everything that depends on it: constants, functions, forces on obstacles.
        start: The load parameter of the present state, for which nothing is solved.
        end: Load parameter of the last increment.
        steps: Number of equal increments, or the load parameters at the ends of the increments,
            monotonic up to ``end``. By default the number that the contacts' `Accuracy` sets, or 1.
        max_cuts: Largest number of successive halvings of an increment.
        estimate: Whether to estimate the error of the increment size: every increment is solved in
            one step, which is discarded, and in two halves, which are committed. The step of the
            second half has ``Step.increment_error``.
        checkpoint: File of the last committed state (``.npz``). If it exists when the history
            starts, the history continues after it. Several successive calls, such as loading and
            unloading, may share a file: a restarted program makes the same calls, and calls that
            are complete only set their last load. The last call may be extended or continue with
            other increments, but its arguments must agree with the increments already solved.
        checkpoint_every: Number of increments between checkpoints; the last increment is always
            saved.
        recover_interior: When the interior displacement is recovered after static condensation:
            "every" increment, at the "last" one, or a number n: at every n-th and the last.
            Increments without recovery cost much less. Their contact results are complete, but u
            away from Γc is not up to date (``Step.complete`` is False) until
            `ContactProblem.complete` is called. The interior is also recovered for every
            checkpoint, and in the increment after it.
        state_fields: Functions that belong to the state, such as plastic strains, and are saved in
            the checkpoint. The checkpoint is then written when the iterator is advanced, with the
            values that the loop body has assigned, and after the last increment when the loop ends
            normally. Increments that fail or are cut do not reset them: ``load`` is called again
            with the last committed load parameter.
        on_mismatch: What to do if the checkpoint has other data (stiffness, laws and parameters,
            obstacles, conditions, loads): "refuse" it with an error, or "continue" from its state
            with the present data.
        csv: File of a table with one row per increment (CSV), written after its commit: load
            parameter; forces, moment, area, numbers of points and largest pressure of every
            contact; energies; iterations; cuts; errors with ``estimate``. The header states the
            units. Rows after the last committed increment are replaced, and earlier ones remain, so
            that several calls may share a file. It must not be the checkpoint.
        progress: Whether to show a progress bar with the remaining time, in a terminal or a
            notebook; a string is its title. Needs tqdm.

    Yields:
        The `Step` after its commit. Its ``load`` is the load parameter, and its ``attempts``
        include those before the increment was cut.

    Raises:
        ValueError: An argument is invalid, at the call; or, at the first increment, the checkpoint
            is damaged, or of another problem, history or ``estimate``; problem and file are then
            unchanged.
        OSError: The checkpoint or the table cannot be read or written.
        NotConverged: An increment failed after ``max_cuts`` halvings; u, history and load are those
            of the last commit.
    """
    check_instance("problem", problem, ContactProblem)
    comm, set_load = problem.u.function_space.mesh.comm, _setter(load)
    for name, place in (("start", start), ("end", end)):
        if not (isinstance(place, Real) and np.isfinite(place)):
            raise ValueError(f"{name} is {place!r}; it must be a finite number")
    if start == end:
        raise ValueError(f"start and end are both {start!r}; they must differ")
    ends = _ends(start, end, problem.increments_wanted if steps is None else steps)
    whole = isinstance(recover_interior, int | np.integer) and recover_interior >= 1
    if recover_interior not in ("every", "last") and not whole:
        raise ValueError(
            f'recover_interior is {recover_interior!r}; it must be "every", "last", or an integer, '
            "at least 1"
        )
    for name, number, least in (
        ("max_cuts", max_cuts, 0),
        ("checkpoint_every", checkpoint_every, 1),
    ):
        if not isinstance(number, int | np.integer) or number < least:
            raise ValueError(f"{name} is {number!r}; it must be an integer, at least {least}")
    check_bool("estimate", estimate)
    states.check_mismatch(on_mismatch)
    if not isinstance(state_fields, Sequence):
        raise ValueError(
            f"state_fields is a {type(state_fields).__name__}; it must be a list of fem.Functions"
        )
    states.check_fields(problem, state_fields)
    if state_fields and checkpoint is None:
        raise ValueError("state_fields are saved in the checkpoint; give checkpoint=..., too")
    if not isinstance(checkpoint, str | Path | None):
        raise ValueError(f"checkpoint is {checkpoint!r}; it must be the name of a file")
    if isinstance(load, fem.Constant):
        _check_constant(problem, load, start, end)
    file = None if checkpoint is None else Path(checkpoint)
    if file is not None:
        states.check_places(problem)
    with collective_errors(comm):
        if file is not None and comm.rank == 0:
            files.check_folder("checkpoint", file)

    if not isinstance(progress, bool | str):
        raise ValueError(f"progress is {progress!r}; it must be True, False, or a title (str)")
    bar = None
    with collective_errors(comm):
        if progress and comm.rank == 0:
            bar = ProgressBar(progress if isinstance(progress, str) else "", start, end)

    def apply(value: float) -> None:
        with collective_errors(comm):
            set_load(value)
        if bar is not None:
            bar.lead(value)

    if not isinstance(csv, str | Path | None):
        raise ValueError(f"csv is {csv!r}; it must be the name of a file")
    table = None
    if csv is not None and file is not None and Path(csv).resolve() == file.resolve():
        raise ValueError(
            f"checkpoint and csv are both {csv}, and would overwrite each other; give two names"
        )
    if csv is not None:
        table = Table(Path(csv), problem, tuple(quantities(problem)) if estimate else ())
    leg = _LoadSegment(float(start), ends, float(start), estimate)
    every = max_cuts, checkpoint_every, recover_interior
    made = _history(problem, apply, leg, file, every, list(state_fields), on_mismatch, table)
    return _Started(made, comm, bar)


def reads(problem: ContactProblem, constant: fem.Constant) -> bool:
    """Return whether F, a Dirichlet condition or a contact of a problem depends on a constant.

    Collective.
    """
    full = problem.full
    if constant in full.bulk.form.constants():
        return True
    if any(_contact_reads(contact, constant) for contact in problem.contacts):
        return True
    value, prescribed = constant.value.copy(), list[Array]()
    try:
        for other in (value, value + 1.0):
            constant.value = other
            prescribed.append(full.prescribed_values())
    finally:
        constant.value = value
    return bool(full.unknowns.comm.allreduce(int(not np.array_equal(prescribed[0], prescribed[1]))))


def _contact_reads(contact: Contact, constant: fem.Constant) -> bool:
    """Return whether law, obstacle, gap or weight depend on a constant.

    Returns True if that cannot be decided: for a `SampledObstacle` and for user-defined laws.
    """
    seen = is_built_in(contact.law) and not isinstance(contact.obstacle, SampledObstacle)
    loads = [motion.load() for motion in contact.motions]
    return (
        not seen
        or contact.contact_kinematics.data.reads(constant)
        or any(f is constant for f in loads)
    )


def _check_constant(problem: ContactProblem, load: fem.Constant, start: float, end: float) -> None:
    """Warn of a load that nothing depends on, and of one that would jump. Collective."""
    comm, now = problem.u.function_space.mesh.comm, float(load.value)
    if not reads(problem, load):
        warn(
            comm,
            "load is a constant on which neither F, nor a Dirichlet condition, nor a contact "
            "depends, so that it has no effect; use the fem.Constant itself there, not its value",
        )
    if problem.increment and abs(now - start) > NEGLIGIBLE * max(abs(now), abs(end - start)):
        warn(
            comm,
            f"start is {start:g}, but the load is {now:g} after {problem.increment} increments: "
            f"the load path from there to {start:g} will not be solved; continue with "
            f"increments(problem, load, {now:g}, ...)",
        )


class _Started(Iterator[Step]):
    """Increments that are solved as they are asked for; warns if none ever is."""

    def __init__(
        self, steps: Generator[Step, None, None], comm: MPI.Comm, bar: ProgressBar | None
    ) -> None:
        self._steps, self._comm, self._asked, self._bar = steps, comm, False, bar

    def __next__(self) -> Step:
        self._asked = True
        if self._bar is None:
            return next(self._steps)
        with self._bar.shown():
            step = next(self._steps)
        assert step.load is not None
        self._bar.reach(step.load)
        return step

    def close(self) -> None:
        """End the history here, as for a generator: the last committed increment was the last."""
        self._asked = True
        self._steps.close()
        if self._bar is not None:
            self._bar.wipe()

    def __del__(self) -> None:
        if self._bar is not None:
            self._bar.wipe()
        if not self._asked:
            warn(
                self._comm,
                "increments(...) was called, but nothing was solved: iterate over the result, "
                "for step in increments(...)",
                category=RuntimeWarning,
            )


def _history(
    problem: ContactProblem,
    apply: Callable[[float], None],
    leg: _LoadSegment,
    checkpoint: Path | None,
    every: tuple[int, int, str | int],
    fields: Sequence[fem.Function],
    on_mismatch: str,
    table: Table | None,
) -> Generator[Step, None, None]:
    """What `increments` returns, its arguments checked. Collective."""
    (max_cuts, checkpoint_every, field), comm = every, problem.u.function_space.mesh.comm
    start, ends, estimate = leg.start, leg.ends, leg.estimate
    end = ends[-1]
    at = _Progress(start)
    error = dict.fromkeys(quantities(problem), 0.0) if estimate else {}
    calls, stored = _LoadProgramme([leg], True), None
    if checkpoint is not None:
        calls, stored = _place(problem, checkpoint, leg)
    if not calls.begun:
        logger.info("%s: increments %s are done", checkpoint, leg)
        apply(leg.reached)
        return
    if stored is None:
        problem.expected_increments = len(ends) * (3 if estimate else 1)
        apply(start)
    else:
        n = len(dataclasses.fields(_Progress))
        if len(stored.numbers) != n + len(error):
            raise ValueError(
                f"{checkpoint} was not written by such a load history; remove it to start again"
            )
        at = _Progress(*stored.numbers[:n])
        error = dict(zip(error, stored.numbers[n:], strict=True))
        try:
            states.take_up(
                problem,
                stored,
                loads=lambda: apply(at.load),
                state_fields=fields,
                on_mismatch=on_mismatch,
            )
        except BaseException:
            apply(start)
            raise
        ends = ends[leg.passed() :]
        logger.info("continuing from %s, at load %g", checkpoint, at.load)
    if checkpoint is not None:
        _calls[problem][checkpoint.absolute()] = calls
    watch = _Watch(problem, fields) if checkpoint is not None else None
    if table is not None:
        table.begin()

    def write() -> None:
        leg.reached = at.load
        numbers = [*dataclasses.astuple(at), *error.values()]
        assert checkpoint is not None
        notes = [dataclasses.asdict(each) for each in calls.legs]
        states.save(problem, checkpoint, numbers, state_fields=fields, notes=notes)

    direction = 1.0 if end >= start else -1.0
    unsaved = behind = 0
    failed: list[Attempt] = []
    halves: list[float] = []  # of an increment that was solved whole, with these results
    whole: dict[str, float] = {}
    for target in ends:
        while direction * (target - at.load) > 0:
            # A remainder that is next to nothing is taken along.
            within = abs(target - at.load) <= 1.01 * at.largest
            goal = target if within else at.load + direction * at.largest
            try:
                if estimate and not halves:
                    apply(goal)
                    problem.solve()
                    whole = quantities(problem)
                    problem.restore()
                    halves = [0.5 * (at.load + goal), goal]
                goal = halves[0] if halves else goal
                wanted = goal == end or field == "every" or estimate or behind + 1 == field
                apply(goal)
                step = problem.solve(recover_interior=wanted)
            except BaseException as failure:
                apply(at.load)
                halves = []
                if not isinstance(failure, NotConverged):
                    raise
                failed += failure.attempts
                if at.cuts == max_cuts:
                    failure.attempts = tuple(failed)
                    failure.add(at.limit_point())
                    problem.complete()
                    raise
                at.cut(abs(goal - at.load))
                failed.append(Attempt("cut", 0, f"to {at.largest:g}"))
                if comm.rank == 0:
                    logger.warning(
                        "increment %d, to load %g, did not converge: cut to size %g",
                        failure.increment,
                        goal,
                        at.largest,
                    )
                continue
            problem.commit()
            at.advance(goal, problem)
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
            tried, failed = (*failed, *step.attempts), []
            step = dataclasses.replace(step, load=goal, attempts=tried, increment_error=found)
            if table is not None:  # before the checkpoint, behind which rows are replaced
                table.add(step)
            # Halves belong together: between them the whole one's results would be lost.
            due = checkpoint is not None and (
                goal == end or (unsaved >= checkpoint_every and not halves)
            )
            if due:
                unsaved = behind = 0
            if due and not fields:
                write()
            leg.reached = goal
            if watch is not None:
                watch.look()
            yield step
            if watch is not None:
                watch.compare()
            if due and fields:
                apply(goal)  # what the loop may have set otherwise
                write()


@dataclasses.dataclass
class _LoadSegment:
    """What one call of `increments` asks for.

    Attributes:
        start: Load parameter at its start.
        ends: Those at the ends of its increments.
        reached: Where it stands.
        estimate: Whether errors are estimated.
    """

    start: float
    ends: list[float]
    reached: float
    estimate: bool

    def passed(self, reached: float | None = None) -> int:
        """How many of its ends lie behind a load parameter, by default where it stands."""
        reached = self.reached if reached is None else reached
        return sum(self._way(end - reached) <= self._round_off() for end in self.ends)

    def _way(self, difference: float) -> float:
        return difference if self.ends[-1] >= self.start else -difference

    def _round_off(self) -> float:
        return NEGLIGIBLE * abs(self.ends[-1] - self.start)

    def is_done(self) -> bool:
        return self.passed() == len(self.ends)

    def same(self, other: _LoadSegment, *, up_to: float | None = None) -> bool:
        """Whether another one asks for the same; if given, up to a load parameter."""
        n, m = len(self.ends), len(other.ends)
        if up_to is not None:
            within = -self._round_off() <= self._way(up_to - self.start)
            within &= self._way(up_to - self.ends[-1]) <= self._round_off()
            if not within:
                return False
            n, m = self.passed(up_to), other.passed(up_to)
        mine, theirs = [self.start, *self.ends[:n]], [other.start, *other.ends[:m]]
        return n == m and np.allclose(mine, theirs, rtol=0.0, atol=self._round_off())

    def __str__(self) -> str:
        """What it asks for, in words."""
        ends = ", ".join(f"{end:g}" for end in self.ends[:6])
        more = ", …" if len(self.ends) > 6 else ""
        return f"from {self.start:g} to {self.ends[-1]:g} by {len(self.ends)} ({ends}{more})"


@dataclasses.dataclass
class _LoadProgramme:
    """The calls of `increments` for a problem and a file.

    Attributes:
        legs: What they asked for.
        begun: Whether the problem has a state of this path; else all of them were done in the file.
    """

    legs: list[_LoadSegment]
    begun: bool


_calls: weakref.WeakKeyDictionary[ContactProblem, dict[Path, _LoadProgramme]]
_calls = weakref.WeakKeyDictionary()


def _place(
    problem: ContactProblem, checkpoint: Path, leg: _LoadSegment
) -> tuple[_LoadProgramme, states.StoredCheckpoint | None]:
    """Where in the load path of a file a call stands. Collective.

    Returns:
        The calls, this one included; and what is to be taken up, None where there is nothing. If
        the file has later ones, this one is done, and nothing is begun.

    Raises:
        ValueError: The file is of another path.
    """
    known = _calls.setdefault(problem, {}).setdefault(
        checkpoint.absolute(), _LoadProgramme([], False)
    )
    legs = known.legs
    # A loop that was left, or an increment that failed: the same call goes on.
    again = known.begun and not legs[-1].is_done() and leg.same(legs[-1], up_to=legs[-1].reached)
    earlier = legs[:-1] if again else legs
    there = (again or not known.begun) and states.exists(problem, checkpoint)
    if not there and (known.begun or not legs):
        return _LoadProgramme([*earlier, leg], True), None
    stored = states.read(problem, checkpoint) if there else None
    try:
        theirs = [_LoadSegment(**each) for each in stored.notes or ()] if stored else []
    except TypeError:  # notes of a caller of `checkpoint.save`
        theirs = []
    if again and len(theirs) <= len(earlier):  # nothing of it was saved
        return _LoadProgramme([*earlier, leg], True), None
    if len(theirs) <= len(earlier):
        raise ValueError(
            f"{checkpoint} has {len(theirs)} calls of increments(), and this is number "
            f"{len(earlier) + 1}: it was written by another program; remove it to start again"
        )
    there_leg = theirs[len(earlier)]
    if leg.estimate != there_leg.estimate:
        raise ValueError(
            f"{checkpoint} is of a history {'with' if there_leg.estimate else 'without'} estimate; "
            "use the same argument, or remove it to start again"
        )
    is_last = len(theirs) == len(earlier) + 1
    if not leg.same(there_leg, up_to=there_leg.reached if is_last else None):
        raise ValueError(
            f"{checkpoint} is of another load path: its call number {len(earlier) + 1} of "
            f"increments() goes {there_leg}, and is done up to {there_leg.reached:g}; this one "
            f"goes {leg}. Make the same calls in the same order (those that are done solve "
            "nothing), or remove it to start again"
        )
    leg.reached = there_leg.reached
    if is_last:
        return _LoadProgramme([*earlier, leg], True), stored
    known.legs.append(leg)
    return _LoadProgramme([*earlier, leg], False), None


class _Watch:
    """Looks for functions in the bulk form that the loop changes, and no checkpoint has."""

    def __init__(self, problem: ContactProblem, fields: Sequence[fem.Function]) -> None:
        kept = {id(problem.u), *(id(field) for field in fields)}
        coefficients = problem.full.bulk.form.coefficients()
        self._watched = [(f.name, Dependence([], [f])) for f in coefficients if id(f) not in kept]
        self._comm = problem.u.function_space.mesh.comm

    def look(self) -> None:
        """Note the values."""
        for _, function in self._watched:
            function.note()

    def compare(self) -> None:
        """Warn, once, of those that have changed since. Collective."""
        mine = [function.changed for _, function in self._watched]
        changed = np.any(self._comm.allgather(mine), axis=0)
        names = [self._watched[i][0] for i in np.flatnonzero(changed)]
        if names:
            self._watched = []
            warn(
                self._comm,
                f"{', '.join(names)} in the bulk form is changed between increments, but is not "
                "saved in the checkpoint, from which a history cannot continue correctly; give "
                "state_fields=[...]",
            )


@dataclasses.dataclass
class _Progress:
    """Where a history stands; numbers only, so that a checkpoint can hold it.

    Attributes:
        load: Load parameter of the last committed increment.
        last: Size of that increment; 0 before the first.
        largest: Largest size of the next one, infinite where none was cut.
        cuts: How often increments have been halved and not doubled since.
        successes: Increments since the last halving or doubling.
        change: Norm of the change of the unknowns in the last increment; 0 if it is unknown.
        way: Sum of these.
        travelled: Sum of the sizes of the increments where it is known.
    """

    load: float
    last: float = 0.0
    largest: float = np.inf
    cuts: float = 0
    successes: float = 0
    change: float = 0.0
    way: float = 0.0
    travelled: float = 0.0

    def cut(self, tried: float) -> None:
        self.largest, self.cuts, self.successes = tried / 2, self.cuts + 1, 0

    def advance(self, goal: float, problem: ContactProblem) -> None:
        """Take note of the increment to the load parameter goal that was committed. Collective."""
        self.last, self.load, self.change = goal - self.load, goal, 0.0
        change = problem.state.change
        if change is not None:
            squares = global_sum(problem.u.function_space.mesh.comm, float(change @ change))
            self.change = float(np.sqrt(squares))
            self.way += self.change
            self.travelled += abs(self.last)
        self.successes += 1
        if self.cuts and self.successes >= _PATIENCE:
            self.cuts, self.successes = self.cuts - 1, 0
            self.largest = 2 * self.largest if self.cuts else np.inf

    def limit_point(self) -> str:
        """What to try where the load seems to have a maximum; empty where it does not."""
        if not self.change * self.travelled > _LIMIT_POINT * self.way * abs(self.last):
            return ""
        grown = self.change * self.travelled / (self.way * abs(self.last))
        return (
            f"Displacements per load are {grown:.2g} times the mean of this history: the load may "
            "have a maximum here (a limit point, as in snap-through or separation); prescribe a "
            "displacement instead of a force"
        )


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
        with np.errstate(all="ignore"):
            ends = [start + (end - start) * (i / steps) for i in range(1, steps)] + [float(end)]
            ways = np.diff([start, *ends])
        if not (np.all(np.isfinite(ends)) and (np.all(ways > 0) or np.all(ways < 0))):
            raise ValueError(
                f"steps is {steps}; so many increments from start = {start!r} to end = {end!r} "
                "cannot be distinguished in double precision, or overflow: take fewer, or let the "
                "load parameter go from 0 to 1 and scale it in a function load"
            )
        return ends
    try:
        flat = np.ndim(steps) == 1
        ends = [float(value) for value in steps] if flat else []
    except (TypeError, ValueError):  # words, or rows of unequal length
        flat = False
    if not flat:
        raise ValueError(
            f"steps is {steps!r}; it must be an integer, or the load parameters at the "
            "ends of the increments"
        )
    ways = np.diff([start, *ends])
    if not ends or ends[-1] != end or not (np.all(ways > 0) or np.all(ways < 0)):
        raise ValueError(
            f"steps is {ends}; it must be an integer, or the ends of the increments, monotonic "
            f"from start = {start:g} to end = {end:g}"
        )
    return ends
