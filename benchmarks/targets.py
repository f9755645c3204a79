"""What contact is to cost, beside what the benchmarks measured."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import timing

Rows = Sequence[dict[str, str]]
NOT_MEASURED = "not measured"


@dataclass(frozen=True)
class Target:
    """One number to meet.

    Attributes:
        scene: What is solved.
        what: What is measured.
        table: The CSV, in the benchmarks' output.
        measure: Makes the number of its rows, and what else to say; raises `LookupError` where
            the run is not among them.
        limit: The number to meet.
        above: Whether it is to be exceeded.
    """

    scene: str
    what: str
    table: str
    measure: Callable[[Rows], tuple[float, str]]
    limit: float
    above: bool = False

    def row(self, folder: Path) -> timing.Row:
        """The target, what was measured, and whether it is met."""
        sign = "≥" if self.above else "≤"
        row: timing.Row = {"scene": self.scene, "target": f"{self.what} {sign} {self.limit:.3g}"}
        try:
            value, note = self.measure(timing.read(folder / self.table))
        except (LookupError, FileNotFoundError):
            return row | {"measured": "", "met": NOT_MEASURED, "with": ""}
        met = value >= self.limit if self.above else value <= self.limit
        # A run that failed has no time: NaN is neither above nor below.
        return row | {"measured": value, "met": "yes" if met else "no", "with": note}


def ratio(over: str, under: str, size: int = 0) -> Callable[[Rows], tuple[float, str]]:
    """Seconds of one run over those of another, on one rank, of at least ``size`` dofs."""

    def measure(rows: Rows) -> tuple[float, str]:
        one, other = (_find(rows, run, size) for run in (over, under))
        note = f"{one['iterations']} iterations"
        errors = [f"{k} {float(v):.2g}" for k, v in one.items() if k.startswith("error") and v]
        return _seconds(one) / _seconds(other), ", ".join([note, *errors])

    return measure


def memory(run: str, size: int) -> Callable[[Rows], tuple[float, str]]:
    """Peak memory of a run on one rank, of at least ``size`` dofs (GiB)."""

    def measure(rows: Rows) -> tuple[float, str]:
        row = _find(rows, run, size)
        return float(row["GiB"]), f"{row['dofs']} dofs"

    return measure


def speed_up(run: str, size: int) -> Callable[[Rows], tuple[float, str]]:
    """Two ranks against one, of at least ``size`` dofs, and less than twice as many."""

    def measure(rows: Rows) -> tuple[float, str]:
        one, two = (_find(rows, run, size, ranks) for ranks in (1, 2))
        note = f"{two['dofs']} dofs, {one['iterations']} and {two['iterations']} iterations"
        return _seconds(one) / _seconds(two), note

    return measure


def newton_steps(scene: str, friction: str, beside: str) -> Callable[[Rows], tuple[float, str]]:
    """Newton steps with contact over those of the bulk alone, of `benchmarks/finite.py`.

    Args:
        scene: As it is called there.
        friction: μ.
        beside: "plain" or "prescribed": by what the bulk alone is solved.
    """

    def measure(rows: Rows) -> tuple[float, str]:
        for row in rows:
            if (row["scene"], float(row["μ"]), row["run"]) == (scene, float(friction), "contact"):
                note = f"{row['Newton steps']} steps, {row['dofs']} dofs"
                return float(row[f"steps / {beside}"]), note
        raise LookupError(scene)

    return measure


def worst(ranks: int) -> Callable[[Rows], tuple[float, str]]:
    """Most linear solves of an increment that has a solution, on a number of ranks."""

    def measure(rows: Rows) -> tuple[float, str]:
        mine = [row for row in rows if int(row["ranks"]) == ranks]
        found = [row for row in mine if not row["way"].startswith("refused")]
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
    """NaN for a run that failed."""
    return float("nan") if row["iterations"] in ("none", "failed") else float(row["seconds"])


def _all() -> list[Target]:
    cylinder, ball = "half_cylinder/half_cylinder.csv", "ball/ball.csv"
    solve, lu, gamg = "one linear solve", "plain DOLFINx, LU", "plain DOLFINx, GMRES + GAMG"
    found = []
    for friction, increments, limit in (("0", 1, 1.0), ("0.2", 1, 1.3), ("0.2", 40, 2.0)):
        scene = f"half-cylinder, μ = {friction}, {increments} increments"
        run = f"μ = {friction}, {increments} increments: by default"
        found.append(Target(scene, "time / linear solve", cylinder, ratio(run, solve), limit))
        if increments == 1:
            plain = ratio(run, f"μ = {friction}: {lu}")
            found.append(Target(scene, f"time / {lu}", cylinder, plain, 1 / 8))
    scene = "ball on a block, μ = 0.3"
    for other, limit in ((solve, 2.5), (lu, 1 / 6), (gamg, 1 / 2)):
        found.append(Target(scene, f"time / {other}", ball, ratio("by default", other), limit))
    tagged = ratio("10 increments", solve)
    scene = "ball on a block, all of its top tagged, 10 increments"
    found.append(Target(scene, "time / linear solve", "tagged/tagged.csv", tagged, 2.5))
    for ranks in (1, 2):
        scene = f"plates under a bolt, each increment, {ranks} rank{'s' * (ranks > 1)}"
        joint = "bolted_joint/bolted_joint.csv"
        found.append(Target(scene, "time / linear solve", joint, worst(ranks), 3.0))
    for what in ("disc", "two bodies"):
        for friction in ("0", "0.3"):
            scene = f"rubber at large strains, {what}, μ = {friction}"
            for beside, name in (("plain", "plain DOLFINx's"), ("prescribed", "the package's")):
                steps = newton_steps(what, friction, beside)
                target = f"Newton steps / {name} without contact"
                found.append(Target(scene, target, "finite/finite.csv", steps, 1.3))
    large, million = "large/large.csv", 1_000_000
    scene = "ball on a block, a million dofs"
    one = ratio("contact", "linear, multigrid", million)
    found.append(Target(scene, "time / multigrid linear solve", large, one, 1.6))
    found.append(Target(scene, "memory [GiB]", large, memory("contact", million), 20.0))
    for friction, increments in (("0", 1), ("0.2", 1), ("0.2", 40)):
        scene = f"half-cylinder, μ = {friction}, {increments} increments"
        two = speed_up(f"μ = {friction}, {increments} increments", 100_000)
        found.append(
            Target(scene, "speed-up of two ranks", "ranks/ranks.csv", two, 1.5, above=True)
        )
    for size in (100_000, 300_000):
        scene = f"ball on a block, {size} dofs and more"
        two = speed_up("contact, multigrid", size)
        found.append(
            Target(scene, "speed-up of two ranks", "parallel/parallel.csv", two, 1.5, above=True)
        )
    return found


TARGETS: tuple[Target, ...] = tuple(_all())


def table(folder: Path, targets: Sequence[Target] = TARGETS) -> list[dict[str, Any]]:
    """All targets, of the CSV files that the benchmarks left in a folder."""
    return [target.row(folder) for target in targets]
