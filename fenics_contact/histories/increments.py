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
from fenics_contact.histories import checkpoint as checkpoints
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

__all__ = ["depends_on", "increments"]

logger = logging.getLogger("fenics_contact")

# Number of successive increments without failure after which a cut increment size is doubled.
_INCREMENTS_BEFORE_DOUBLING = 2
# Near a limit point the displacement per load grows as 1/√(distance). From this multiple of its
# mean over the history on, the error of a failed increment mentions a limit point.
_LIMIT_RATIO = 2.0


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
    for name, value in (("start", start), ("end", end)):
        if not (isinstance(value, Real) and np.isfinite(value)):
            raise ValueError(f"{name} is {value!r}; it must be a finite number")
    if start == end:
        raise ValueError(f"start and end are both {start!r}; they must differ")
    ends = _ends(start, end, problem.default_increments if steps is None else steps)
    is_interval = isinstance(recover_interior, int | np.integer) and recover_interior >= 1
    if recover_interior not in ("every", "last") and not is_interval:
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
    checkpoints.check_mismatch(on_mismatch)
    if not isinstance(state_fields, Sequence):
        raise ValueError(
            f"state_fields is a {type(state_fields).__name__}; it must be a list of fem.Functions"
        )
    checkpoints.check_fields(problem, state_fields)
    if state_fields and checkpoint is None:
        raise ValueError("state_fields are saved in the checkpoint; give checkpoint=..., too")
    if not isinstance(checkpoint, str | Path | None):
        raise ValueError(f"checkpoint is {checkpoint!r}; it must be the name of a file")
    if isinstance(load, fem.Constant):
        _check_constant(problem, load, start, end)
    file = None if checkpoint is None else Path(checkpoint)
    if file is not None:
        checkpoints.check_places(problem)
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
            bar.start_bar(value)

    if not isinstance(csv, str | Path | None):
        raise ValueError(f"csv is {csv!r}; it must be the name of a file")
    table = None
    if csv is not None and file is not None and Path(csv).resolve() == file.resolve():
        raise ValueError(
            f"checkpoint and csv are both {csv}, and would overwrite each other; give two names"
        )
    if csv is not None:
        table = Table(Path(csv), problem, tuple(quantities(problem)) if estimate else ())
    segment = _LoadSegment(float(start), ends, float(start), estimate)
    options = max_cuts, checkpoint_every, recover_interior
    history = _solve(problem, apply, segment, file, options, list(state_fields), on_mismatch, table)
    return _Steps(history, comm, bar)


def depends_on(problem: ContactProblem, constant: fem.Constant) -> bool:
    """Return whether F, a Dirichlet condition or a contact of a problem depends on a constant.

    Collective.
    """
    full = problem.full
    if constant in full.bulk.form.constants():
        return True
    if any(_contact_depends_on(contact, constant) for contact in problem.contacts):
        return True
    value, prescribed = constant.value.copy(), list[Array]()
    try:
        for other in (value, value + 1.0):
            constant.value = other
            prescribed.append(full.prescribed_values())
    finally:
        constant.value = value
    return bool(full.unknowns.comm.allreduce(int(not np.array_equal(prescribed[0], prescribed[1]))))


def _contact_depends_on(contact: Contact, constant: fem.Constant) -> bool:
    """Return whether a contact depends on a constant; True for user-defined laws and samples."""
    is_known = is_built_in(contact.law) and not isinstance(contact.obstacle, SampledObstacle)
    loads = [motion.load() for motion in contact.motions]
    return (
        not is_known
        or contact.contact_kinematics.data.depends_on(constant)
        or any(f is constant for f in loads)
    )


def _check_constant(problem: ContactProblem, load: fem.Constant, start: float, end: float) -> None:
    """Warn of a load constant without effect, and of a jump of the load. Collective."""
    comm, now = problem.u.function_space.mesh.comm, float(load.value)
    if not depends_on(problem, load):
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


class _Steps(Iterator[Step]):
    """Iterator over a load history, which warns if it is deleted before any iteration."""

    def __init__(
        self, steps: Generator[Step, None, None], comm: MPI.Comm, bar: ProgressBar | None
    ) -> None:
        self._steps, self._comm, self._is_used, self._bar = steps, comm, False, bar

    def __next__(self) -> Step:
        self._is_used = True
        if self._bar is None:
            return next(self._steps)
        with self._bar.show():
            step = next(self._steps)
        assert step.load is not None
        self._bar.update(step.load)
        return step

    def close(self) -> None:
        """End the history after the last committed increment, as ``close`` of a generator."""
        self._is_used = True
        self._steps.close()
        if self._bar is not None:
            self._bar.remove()

    def __del__(self) -> None:
        if self._bar is not None:
            self._bar.remove()
        if not self._is_used:
            warn(
                self._comm,
                "increments(...) was called, but nothing was solved: iterate over the result, "
                "for step in increments(...)",
                category=RuntimeWarning,
            )


def _solve(
    problem: ContactProblem,
    apply: Callable[[float], None],
    segment: _LoadSegment,
    checkpoint: Path | None,
    options: tuple[int, int, str | int],
    fields: Sequence[fem.Function],
    on_mismatch: str,
    table: Table | None,
) -> Generator[Step, None, None]:
    """Solve, commit and save the increments of a load history. Collective."""
    (max_cuts, checkpoint_every, recover), comm = options, problem.u.function_space.mesh.comm
    start, ends, estimate = segment.start, segment.ends, segment.estimate
    end = ends[-1]
    progress = _Progress(start)
    error = dict.fromkeys(quantities(problem), 0.0) if estimate else {}
    programme, stored = _LoadProgramme([segment], True), None
    if checkpoint is not None:
        programme, stored = _locate_segment(problem, checkpoint, segment)
    if not programme.has_state:
        logger.info("%s: increments %s are complete", checkpoint, segment)
        apply(segment.reached)
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
        progress = _Progress(*stored.numbers[:n])
        error = dict(zip(error, stored.numbers[n:], strict=True))
        try:
            checkpoints.load_restart(
                problem,
                stored,
                loads=lambda: apply(progress.load),
                state_fields=fields,
                on_mismatch=on_mismatch,
            )
        except BaseException:
            apply(start)
            raise
        ends = ends[segment.count_reached() :]
        logger.info("continuing from %s, at load %g", checkpoint, progress.load)
    if checkpoint is not None:
        _programmes[problem][checkpoint.absolute()] = programme
    monitor = _UnsavedCoefficients(problem, fields) if checkpoint is not None else None
    if table is not None:
        table.truncate()

    def write() -> None:
        segment.reached = progress.load
        numbers = [*dataclasses.astuple(progress), *error.values()]
        assert checkpoint is not None
        notes = [dataclasses.asdict(each) for each in programme.segments]
        checkpoints.save(problem, checkpoint, numbers, state_fields=fields, notes=notes)

    direction = 1.0 if end >= start else -1.0
    n_unsaved = n_skipped = 0
    failed_attempts: list[Attempt] = []
    halves: list[float] = []  # ends of the halves of an increment solved in one step
    one_step: dict[str, float] = {}  # results of that step
    for target in ends:
        while direction * (target - progress.load) > 0:
            # A remainder of up to 1 % is included.
            within = abs(target - progress.load) <= 1.01 * progress.max_size
            goal = target if within else progress.load + direction * progress.max_size
            try:
                if estimate and not halves:
                    apply(goal)
                    problem.solve()
                    one_step = quantities(problem)
                    problem.restore()
                    halves = [0.5 * (progress.load + goal), goal]
                goal = halves[0] if halves else goal
                is_due = goal == end or recover == "every" or estimate or n_skipped + 1 == recover
                apply(goal)
                step = problem.solve(recover_interior=is_due)
            except BaseException as failure:
                apply(progress.load)
                halves = []
                if not isinstance(failure, NotConverged):
                    raise
                failed_attempts += failure.attempts
                if progress.cuts == max_cuts:
                    failure.attempts = tuple(failed_attempts)
                    failure.add(progress.limit_point())
                    problem.complete()
                    raise
                progress.cut(abs(goal - progress.load))
                failed_attempts.append(Attempt("cut", 0, f"to {progress.max_size:g}"))
                if comm.rank == 0:
                    logger.warning(
                        "increment %d, to load %g, did not converge: cut to size %g",
                        failure.increment,
                        goal,
                        progress.max_size,
                    )
                continue
            problem.commit()
            progress.advance(goal, problem)
            halves = halves[1:]
            errors = None
            if estimate and not halves:
                # The error is of first order in the increment size. That of the two halves is half
                # of the error in one step, and equals the difference of the results.
                now = quantities(problem)
                error = {name: error[name] + one_step[name] - now[name] for name in now}
                errors = dict(error)
            n_skipped = 0 if step.complete else n_skipped + 1
            n_unsaved += 1
            attempts, failed_attempts = (*failed_attempts, *step.attempts), []
            step = dataclasses.replace(step, load=goal, attempts=attempts, increment_error=errors)
            if table is not None:  # before the checkpoint: rows after a checkpoint are replaced
                table.add(step)
            # No checkpoint between two halves: the results of the single step would be lost.
            save_now = checkpoint is not None and (
                goal == end or (n_unsaved >= checkpoint_every and not halves)
            )
            if save_now:
                n_unsaved = n_skipped = 0
            if save_now and not fields:
                write()
            segment.reached = goal
            if monitor is not None:
                monitor.record()
            yield step
            if monitor is not None:
                monitor.check()
            if save_now and fields:
                apply(goal)  # the loop may have changed the load
                write()


@dataclasses.dataclass
class _LoadSegment:
    """The load path of one call of `increments`; ``reached`` is its last committed load."""

    start: float
    ends: list[float]
    reached: float
    estimate: bool

    def count_reached(self, reached: float | None = None) -> int:
        """Return the number of ends up to a load parameter, by default the one reached."""
        reached = self.reached if reached is None else reached
        return sum(self._signed(end - reached) <= self._round_off() for end in self.ends)

    def _signed(self, difference: float) -> float:
        return difference if self.ends[-1] >= self.start else -difference

    def _round_off(self) -> float:
        return NEGLIGIBLE * abs(self.ends[-1] - self.start)

    def is_done(self) -> bool:
        return self.count_reached() == len(self.ends)

    def is_equal(self, other: _LoadSegment, *, up_to: float | None = None) -> bool:
        """Return whether another segment has the same increments; if given, up to a load."""
        n, m = len(self.ends), len(other.ends)
        if up_to is not None:
            within = -self._round_off() <= self._signed(up_to - self.start)
            within &= self._signed(up_to - self.ends[-1]) <= self._round_off()
            if not within:
                return False
            n, m = self.count_reached(up_to), other.count_reached(up_to)
        mine, theirs = [self.start, *self.ends[:n]], [other.start, *other.ends[:m]]
        return n == m and np.allclose(mine, theirs, rtol=0.0, atol=self._round_off())

    def __str__(self) -> str:
        """Describe the load path for messages."""
        ends = ", ".join(f"{end:g}" for end in self.ends[:6])
        more = ", …" if len(self.ends) > 6 else ""
        return f"from {self.start:g} to {self.ends[-1]:g} by {len(self.ends)} ({ends}{more})"


@dataclasses.dataclass
class _LoadProgramme:
    """Successive calls of `increments` for a checkpoint file, all complete if it has no state."""

    segments: list[_LoadSegment]
    has_state: bool


_programmes: weakref.WeakKeyDictionary[ContactProblem, dict[Path, _LoadProgramme]]
_programmes = weakref.WeakKeyDictionary()


def _locate_segment(
    problem: ContactProblem, checkpoint: Path, segment: _LoadSegment
) -> tuple[_LoadProgramme, checkpoints.StoredCheckpoint | None]:
    """Return the calls up to this one, and the checkpoint to be loaded, or None. Collective.

    Raises:
        ValueError: The file is of another load path.
    """
    known = _programmes.setdefault(problem, {}).setdefault(
        checkpoint.absolute(), _LoadProgramme([], False)
    )
    segments = known.segments
    # The same call may be repeated after its loop was left, or an increment failed.
    again = (
        known.has_state
        and not segments[-1].is_done()
        and segment.is_equal(segments[-1], up_to=segments[-1].reached)
    )
    earlier = segments[:-1] if again else segments
    has_file = (again or not known.has_state) and checkpoints.exists(problem, checkpoint)
    if not has_file and (known.has_state or not segments):
        return _LoadProgramme([*earlier, segment], True), None
    stored = checkpoints.read(problem, checkpoint) if has_file else None
    try:
        theirs = [_LoadSegment(**each) for each in stored.notes or ()] if stored else []
    except TypeError:  # notes of a caller of `checkpoint.save`
        theirs = []
    if again and len(theirs) <= len(earlier):  # nothing of this call was saved
        return _LoadProgramme([*earlier, segment], True), None
    if len(theirs) <= len(earlier):
        raise ValueError(
            f"{checkpoint} has {len(theirs)} calls of increments(), and this is number "
            f"{len(earlier) + 1}: it was written by another program; remove it to start again"
        )
    other = theirs[len(earlier)]
    if segment.estimate != other.estimate:
        raise ValueError(
            f"{checkpoint} is of a history {'with' if other.estimate else 'without'} estimate; "
            "use the same argument, or remove it to start again"
        )
    is_last = len(theirs) == len(earlier) + 1
    if not segment.is_equal(other, up_to=other.reached if is_last else None):
        raise ValueError(
            f"{checkpoint} is of another load path: its call number {len(earlier) + 1} of "
            f"increments() goes {other}, and is complete up to {other.reached:g}; this one goes "
            f"{segment}. Make the same calls in the same order (complete ones solve nothing), or "
            "remove it to start again"
        )
    segment.reached = other.reached
    if is_last:
        return _LoadProgramme([*earlier, segment], True), stored
    known.segments.append(segment)
    return _LoadProgramme([*earlier, segment], False), None


class _UnsavedCoefficients:
    """Functions in the bulk form that are not saved in the checkpoint, and must not change."""

    def __init__(self, problem: ContactProblem, fields: Sequence[fem.Function]) -> None:
        saved = {id(problem.u), *(id(field) for field in fields)}
        coefficients = problem.full.bulk.form.coefficients()
        self._unsaved = [(f.name, Dependence([], [f])) for f in coefficients if id(f) not in saved]
        self._comm = problem.u.function_space.mesh.comm

    def record(self) -> None:
        """Record the present values."""
        for _, function in self._unsaved:
            function.note()

    def check(self) -> None:
        """Warn once of functions that the loop body has changed. Collective."""
        local = [function.changed for _, function in self._unsaved]
        changed = np.any(self._comm.allgather(local), axis=0)
        names = [self._unsaved[i][0] for i in np.flatnonzero(changed)]
        if names:
            self._unsaved = []
            warn(
                self._comm,
                f"{', '.join(names)} in the bulk form is changed between increments, but is not "
                "saved in the checkpoint, from which a history cannot continue correctly; give "
                "state_fields=[...]",
            )


@dataclasses.dataclass
class _Progress:
    """State of the increment control; numbers only, because it is saved in checkpoints.

    Attributes:
        load: Load parameter of the last committed increment.
        size: Size of that increment; 0 before the first.
        max_size: Largest size of the next increment, infinite unless increments were cut.
        cuts: Number of halvings that have not been reversed.
        successes: Number of increments since the last halving or doubling.
        change: Norm of the change of the unknowns in the last increment; 0 if unknown.
        total_change: Sum of these norms.
        total_size: Sum of the sizes of the increments with known change.
    """

    load: float
    size: float = 0.0
    max_size: float = np.inf
    cuts: float = 0
    successes: float = 0
    change: float = 0.0
    total_change: float = 0.0
    total_size: float = 0.0

    def cut(self, size: float) -> None:
        self.max_size, self.cuts, self.successes = size / 2, self.cuts + 1, 0

    def advance(self, goal: float, problem: ContactProblem) -> None:
        """Record a committed increment to the load parameter ``goal``. Collective."""
        self.size, self.load, self.change = goal - self.load, goal, 0.0
        change = problem.state.change
        if change is not None:
            squares = global_sum(problem.u.function_space.mesh.comm, float(change @ change))
            self.change = float(np.sqrt(squares))
            self.total_change += self.change
            self.total_size += abs(self.size)
        self.successes += 1
        if self.cuts and self.successes >= _INCREMENTS_BEFORE_DOUBLING:
            self.cuts, self.successes = self.cuts - 1, 0
            self.max_size = 2 * self.max_size if self.cuts else np.inf

    def limit_point(self) -> str:
        """Return advice if the load seems to have a maximum, else an empty string."""
        if not self.change * self.total_size > _LIMIT_RATIO * self.total_change * abs(self.size):
            return ""
        ratio = self.change * self.total_size / (self.total_change * abs(self.size))
        return (
            f"Displacements per load are {ratio:.2g} times the mean of this history: the load may "
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
    """Return the load parameters at the ends of the requested increments."""
    if isinstance(steps, int | np.integer):
        if steps < 1:
            raise ValueError(f"steps is {steps}; it must be at least 1")
        with np.errstate(all="ignore"):
            ends = [start + (end - start) * (i / steps) for i in range(1, steps)] + [float(end)]
            sizes = np.diff([start, *ends])
        if not (np.all(np.isfinite(ends)) and (np.all(sizes > 0) or np.all(sizes < 0))):
            raise ValueError(
                f"steps is {steps}; so many increments from start = {start!r} to end = {end!r} "
                "cannot be distinguished in double precision, or overflow: take fewer, or let the "
                "load parameter go from 0 to 1 and scale it in a function load"
            )
        return ends
    try:
        is_list = np.ndim(steps) == 1
        ends = [float(value) for value in steps] if is_list else []
    except (TypeError, ValueError):  # strings, or rows of unequal length
        is_list = False
    if not is_list:
        raise ValueError(
            f"steps is {steps!r}; it must be an integer, or the load parameters at the "
            "ends of the increments"
        )
    sizes = np.diff([start, *ends])
    if not ends or ends[-1] != end or not (np.all(sizes > 0) or np.all(sizes < 0)):
        raise ValueError(
            f"steps is {ends}; it must be an integer, or the ends of the increments, monotonic "
            f"from start = {start:g} to end = {end:g}"
        )
    return ends
