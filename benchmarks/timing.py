"""What the benchmarks share: repeated timing, tables, fitted power laws and their plots.

A benchmark times named runs one after another, `repeat` times around, so that what else the machine
does falls on all of them; medians are reported, in seconds and in units of one of the runs. What
every run makes the first time, which is to compile its forms, is timed apart on a small problem.
"""

from __future__ import annotations

import argparse
import csv
import math
import resource
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from fenics_contact import plotting

Row = dict[str, Any]
Runs = Mapping[str, Callable[[], Row]]
Series = Mapping[str, tuple[Sequence[float], Sequence[float]]]


def parser(documentation: str | None, folder: str) -> argparse.ArgumentParser:
    """The options that every benchmark has: ``--output``, ``--repeat`` and ``--short``."""
    made = argparse.ArgumentParser(
        description=(documentation or "").split("\n\n")[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    made.add_argument("--output", type=Path, default=Path("output/benchmarks") / folder)
    made.add_argument("--repeat", type=int, default=3, help="times every run is timed")
    made.add_argument("--short", action="store_true", help="small problems: a minute in all")
    return made


def measure(
    runs: Runs, *, repeat: int = 3, first: Runs | None = None, once: float = math.inf
) -> list[Row]:
    """Time runs by name. Collective; times are those of the slowest rank.

    Args:
        runs: Each does its work and returns what else belongs in its row of the table.
        repeat: How often.
        first: The same names with small problems, each run once before: what that takes is in
            "first use [s]", which is the compilation of the forms if no cache has them.
        once: Runs that took longer than this are not repeated (s).

    Returns:
        One row a run: "run", what the last repetition returned, "seconds" (the median), "spread"
        (largest over smallest), and with ``first`` "first use [s]".
    """
    before = {name: _timed(run)[0] for name, run in (first or {}).items()}
    times: dict[str, list[float]] = {name: [] for name in runs}
    found: dict[str, Row] = {}
    for _ in range(repeat):
        for name, run in runs.items():
            if max(times[name], default=0.0) > once:
                continue
            seconds, found[name] = _timed(run)
            times[name].append(seconds)
    rows = []
    for name, made in times.items():
        row: Row = {"run": name} | found[name]
        row |= {"seconds": statistics.median(made), "spread": max(made) / min(made)}
        if name in before:
            row["first use [s]"] = before[name]
        rows.append(row)
    return rows


def _timed(run: Callable[[], Row]) -> tuple[float, Row]:
    MPI.COMM_WORLD.Barrier()
    start = time.perf_counter()
    row = run()
    return MPI.COMM_WORLD.allreduce(time.perf_counter() - start, op=MPI.MAX), row


def in_units_of(rows: list[Row], yardstick: str, column: str) -> list[Row]:
    """The rows with one more column: their seconds over those of the run ``yardstick``."""
    unit = next(row["seconds"] for row in rows if row["run"] == yardstick)
    return [row | {column: row["seconds"] / unit} for row in rows]


def peak_memory() -> float:
    """Largest resident memory of the processes of all ranks so far, summed, in GiB. Collective."""
    mine = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return MPI.COMM_WORLD.allreduce(mine) / 2**20


def fit(x: Sequence[float], y: Sequence[float]) -> tuple[float, float]:
    """Factor c and exponent p of y = c x^p by least squares of the logarithms."""
    exponent, logarithm = np.polyfit(np.log(x), np.log(y), 1)
    return float(np.exp(logarithm)), float(exponent)


def write(folder: Path, name: str, title: str, rows: Iterable[Row], notes: str = "") -> None:
    """Write ``name``.csv, all digits, and ``name``.md, a table; print the table. On rank 0."""
    if MPI.COMM_WORLD.rank:
        return
    rows = list(rows)
    text = "\n".join([f"## {title}", "", *table(rows), *(["", notes] if notes else [])]) + "\n"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.md").write_text(text)
    save(folder / f"{name}.csv", rows)
    print(text, flush=True)


def table(rows: Sequence[Row]) -> list[str]:
    """Lines of a table in Markdown; columns are all those of the rows."""
    columns = list(dict.fromkeys(column for row in rows for column in row))
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    return lines + ["| " + " | ".join(_shown(r.get(c, "")) for c in columns) + " |" for r in rows]


def save(path: Path, rows: Sequence[Row]) -> None:
    """Write rows as CSV, with all their digits."""
    columns = list(dict.fromkeys(column for row in rows for column in row))
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def read(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV, as they are written there."""
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def _shown(value: Any) -> str:
    if not isinstance(value, float):
        return str(value)
    return "–" if math.isnan(value) else f"{value:.4g}"


def draw(path: Path, title: str, x: str, y: str, series: Series, *, fitted: bool = True) -> None:
    """Plot series over logarithmic axes, by default with their fitted power laws. On rank 0.

    Args:
        path: The picture.
        title: Of it.
        x: Name of the abscissa.
        y: Name of the ordinate.
        series: Values (x, y) by name; the law fitted to them stands in the legend.
        fitted: Whether the values follow a law.
    """
    if MPI.COMM_WORLD.rank:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with plotting.figure(path, size=(10.0, 5.0)) as axes:
        for number, (name, (at, values)) in enumerate(series.items()):
            marker = "osv"[number // 10 % 3]  # colours are ten
            (points,) = axes.loglog(at, values, marker, markersize=4, label=name)
            if fitted and len(set(at)) > 2:
                factor, exponent = fit(at, values)
                ends = np.array([min(at), max(at)], dtype=np.float64)
                line = ("-", "--", ":")[number // 10 % 3]
                axes.loglog(ends, factor * ends**exponent, line, color=points.get_color())
                points.set_label(f"{name}: exponent {exponent:.2f}")
        axes.set(title=title, xlabel=x, ylabel=y)
        axes.grid(alpha=0.25, which="both")
        axes.figure.legend(fontsize=8, loc="outside right upper")
