"""Targets for the cost of contact, compared with the measurements of the benchmarks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import costs
from verification import report

Row = dict[str, Any]
Rows = Sequence[dict[str, str]]
NOT_MEASURED = "not measured"


@dataclass(frozen=True)
class Target:
    """An upper or lower limit of a measured quantity.

    Attributes:
        problem: The problem that is solved.
        quantity: The quantity that is measured.
        table: CSV file in the output of the benchmarks.
        measure: Returns the value from its rows, and notes; raises `LookupError` if the run is
            missing.
        limit: The target.
        is_lower_limit: Whether the limit is a lower limit.
    """

    problem: str
    quantity: str
    table: str
    measure: Callable[[Rows], tuple[float, str]]
    limit: float
    is_lower_limit: bool = False

    def row(self, folder: Path) -> Row:
        """Return the target, the measured value, and whether it is met."""
        sign = "≥" if self.is_lower_limit else "≤"
        row: Row = {"problem": self.problem, "quantity": self.quantity}
        row |= {"target": f"{sign} {self.limit:.3g}"}
        try:
            value, note = self.measure(report.read(folder / self.table))
        except (LookupError, FileNotFoundError):
            return row | {"measured": "", "met": NOT_MEASURED, "notes": ""}
        met = value >= self.limit if self.is_lower_limit else value <= self.limit
        # The time of a failed run is NaN, which does not meet a limit.
        return row | {"measured": value, "met": "yes" if met else "no", "notes": note}


def measure_time_ratio(over: str, under: str, size: int = 0) -> Callable[[Rows], tuple[float, str]]:
    """Measure the time of a run relative to another, on one rank with ``size`` dofs or more."""

    def measure(rows: Rows) -> tuple[float, str]:
        one, other = (_find(rows, run, size) for run in (over, under))
        note = f"{one['iterations']} iterations"
        errors = [f"{k} {float(v):.2g}" for k, v in one.items() if k.startswith("error") and v]
        return _seconds(one) / _seconds(other), ", ".join([note, *errors])

    return measure


def measure_memory(run: str, size: int) -> Callable[[Rows], tuple[float, str]]:
    """Measure the peak memory of a run on one rank with ``size`` dofs or more (GiB)."""

    def measure(rows: Rows) -> tuple[float, str]:
        row = _find(rows, run, size)
        return float(row["GiB"]), f"{row['dofs']} dofs"

    return measure


def measure_speed_up(run: str, size: int) -> Callable[[Rows], tuple[float, str]]:
    """Measure the speed-up of two ranks with ``size`` dofs or more, and less than twice as many."""

    def measure(rows: Rows) -> tuple[float, str]:
        one, two = (_find(rows, run, size, ranks) for ranks in (1, 2))
        note = f"{two['dofs']} dofs, {one['iterations']} and {two['iterations']} iterations"
        return _seconds(one) / _seconds(two), note

    return measure


def measure_newton_iterations(
    problem: str, friction: str, other: str
) -> Callable[[Rows], tuple[float, str]]:
    """Measure Newton iterations with contact relative to the bulk alone (`benchmarks/finite.py`).

    Args:
        problem: Name of the problem there.
        friction: μ.
        other: "DOLFINx" or "package": solver of the bulk alone.
    """

    def measure(rows: Rows) -> tuple[float, str]:
        for row in rows:
            if (row["problem"], float(row["μ"]), row["run"]) == (
                problem,
                float(friction),
                "contact",
            ):
                note = f"{row['Newton iterations']} iterations, {row['dofs']} dofs"
                return float(row[f"iterations / {other}"]), note
        raise LookupError(problem)

    return measure


def measure_largest_cost(ranks: int) -> Callable[[Rows], tuple[float, str]]:
    """Measure the largest cost of a solved increment on ``ranks`` ranks, in linear solves."""

    def measure(rows: Rows) -> tuple[float, str]:
        mine = [row for row in rows if int(row["ranks"]) == ranks]
        found = [row for row in mine if not row["method"].startswith("refused")]
        if not found:
            raise LookupError(ranks)
        most = max(found, key=lambda row: float(row["linear solves"]))
        note = f"{most['dofs']} dofs, {most['increment']}, {most['iterations']} iterations"
        return float(most["linear solves"]), note

    return measure


def _find(rows: Rows, run: str, size: int, ranks: int = 1) -> dict[str, str]:
    for row in rows:
        if row["run"] == run and int(row.get("ranks") or 1) == ranks:
            if not size or size <= int(row.get("dofs") or 0) < 2 * size:
                return row
    raise LookupError(run)


def _seconds(row: dict[str, str]) -> float:
    """Return the seconds of a row, NaN for a failed run."""
    return float("nan") if row["iterations"] in ("none", "failed") else float(row["seconds"])


def _all() -> list[Target]:
    cylinder, ball = "half_cylinder/half_cylinder.csv", "ball/ball.csv"
    solve, lu, gamg = "one linear solve", "plain DOLFINx, LU", "plain DOLFINx, GMRES + GAMG"
    found = []
    for friction, increments, limit in (("0", 1, 1.0), ("0.2", 1, 1.3), ("0.2", 40, 2.0)):
        problem = f"half-cylinder, μ = {friction}, {increments} increment{'s' * (increments > 1)}"
        run = f"μ = {friction}, {increments} increments: by default"
        found.append(
            Target(problem, f"time / {solve}", cylinder, measure_time_ratio(run, solve), limit)
        )
        if increments == 1:
            plain = measure_time_ratio(run, f"μ = {friction}: {lu}")
            found.append(Target(problem, f"time / {lu}", cylinder, plain, 1 / 8))
    problem = "ball on a block, μ = 0.3"
    for other, limit in ((solve, 2.5), (lu, 1 / 6), (gamg, 1 / 2)):
        found.append(
            Target(problem, f"time / {other}", ball, measure_time_ratio("by default", other), limit)
        )
    tagged = measure_time_ratio("10 increments", solve)
    problem = "ball on a block, whole top face on Γc, 10 increments"
    found.append(Target(problem, f"time / {solve}", "tagged/tagged.csv", tagged, 2.5))
    for ranks in (1, 2):
        problem = f"bolted joint, worst increment, {ranks} rank{'s' * (ranks > 1)}"
        joint, tied = "bolted_joint/bolted_joint.csv", "time / one linear solve, bodies tied"
        found.append(Target(problem, tied, joint, measure_largest_cost(ranks), 1.5))
    for what, bodies in (
        ("disc", "rubber block under a disc"),
        ("two bodies", "two rubber blocks"),
    ):
        for friction in ("0", "0.3"):
            problem = f"{bodies}, μ = {friction}"
            for other in ("DOLFINx", "package"):
                measure = measure_newton_iterations(what, friction, other)
                target = f"Newton iterations / bulk alone ({other})"
                found.append(Target(problem, target, "finite/finite.csv", measure, 1.3))
    large, million = "large/large.csv", 1_000_000
    problem = "ball on a block, a million dofs"
    one = measure_time_ratio("contact", "linear, multigrid", million)
    found.append(Target(problem, "time / multigrid solve", large, one, 1.6))
    found.append(Target(problem, "memory [GiB]", large, measure_memory("contact", million), 20.0))
    for friction, increments in (("0", 1), ("0.2", 1), ("0.2", 40)):
        problem = f"half-cylinder, μ = {friction}, {increments} increment{'s' * (increments > 1)}"
        end = costs.LAST_INTERIOR if increments > 1 else ""
        two = measure_speed_up(f"μ = {friction}, {increments} increments{end}", 100_000)
        found.append(
            Target(
                problem, "speed-up of two ranks", "ranks/ranks.csv", two, 1.5, is_lower_limit=True
            )
        )
    for size in (100_000, 300_000):
        problem = f"ball on a block, {size} dofs or more"
        two = measure_speed_up("contact, multigrid", size)
        found.append(
            Target(
                problem,
                "speed-up of two ranks",
                "parallel/parallel.csv",
                two,
                1.5,
                is_lower_limit=True,
            )
        )
    return found


TARGETS: tuple[Target, ...] = tuple(_all())


def table(folder: Path, targets: Sequence[Target] = TARGETS) -> list[dict[str, Any]]:
    """Return the rows of all targets with the measurements in a folder."""
    return [target.row(folder) for target in targets]
