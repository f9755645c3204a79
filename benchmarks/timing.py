"""Repeated timing, CSV files and fitted power laws for the benchmarks.

A benchmark times named runs in turn, `repeat` times, so that other load of the machine affects them
equally. Medians are reported, in seconds and in units of one of the runs. The first run of each,
which compiles its forms, is timed separately on a small problem.
"""

from __future__ import annotations

import argparse
import math
import resource
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from verification import report

Row = dict[str, Any]
Runs = Mapping[str, Callable[[], Row]]


def parser(documentation: str | None, folder: str) -> argparse.ArgumentParser:
    """Return the parser of a benchmark: ``--output``, ``--repeat`` and ``--short``."""
    made = argparse.ArgumentParser(
        description=(documentation or "").split("\n\n")[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    made.add_argument("--output", type=Path, default=Path("output/benchmarks") / folder)
    made.add_argument("--repeat", type=int, default=3, help="number of timed runs")
    made.add_argument("--short", action="store_true", help="small problems: about a minute")
    return made


def measure(
    runs: Runs, *, repeat: int = 3, first: Runs | None = None, once: float = math.inf
) -> list[Row]:
    """Time runs by name. Collective; times are those of the slowest rank.

    Args:
        runs: Each solves a problem and returns the other columns of its row.
        repeat: Number of timed repetitions.
        first: The same names with small problems, each run once before. Its time is in
            "first run [s]", mostly the compilation of the forms if they are not cached.
        once: Runs that take longer than this are not repeated (s).

    Returns:
        One row per run: "run", the columns of the last repetition, "seconds" (median), "spread"
        (largest over smallest time), and with ``first`` "first run [s]".
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
            row["first run [s]"] = before[name]
        rows.append(row)
    return rows


def _timed(run: Callable[[], Row]) -> tuple[float, Row]:
    MPI.COMM_WORLD.Barrier()
    start = time.perf_counter()
    row = run()
    return MPI.COMM_WORLD.allreduce(time.perf_counter() - start, op=MPI.MAX), row


def in_units_of(rows: list[Row], reference_run: str, column: str) -> list[Row]:
    """Add a column to the rows: seconds relative to those of the run ``reference_run``."""
    unit = next(row["seconds"] for row in rows if row["run"] == reference_run)
    return [row | {column: row["seconds"] / unit} for row in rows]


def peak_memory() -> float:
    """Return the largest resident memory of all ranks so far, summed (GiB). Collective."""
    mine = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return MPI.COMM_WORLD.allreduce(mine) / 2**20


def fit(x: Sequence[float], y: Sequence[float]) -> tuple[float, float]:
    """Fit factor c and exponent p of y = c x^p by least squares of the logarithms."""
    exponent, logarithm = np.polyfit(np.log(x), np.log(y), 1)
    return float(np.exp(logarithm)), float(exponent)


def write(folder: Path, name: str, title: str, rows: Iterable[Row], notes: str = "") -> None:
    """Write ``name``.csv with all digits, and print the rows as a table, on rank 0."""
    if MPI.COMM_WORLD.rank:
        return
    rows = list(rows)
    folder.mkdir(parents=True, exist_ok=True)
    report.save(folder / f"{name}.csv", rows)
    print(f"## {title}", "", *table(rows), notes, sep="\n", flush=True)


def table(rows: Sequence[Row]) -> list[str]:
    """Return the lines of a table in Markdown; the columns are those of any row."""
    columns = list(dict.fromkeys(column for row in rows for column in row))
    return report.table(columns, [[_shown(row.get(c, "")) for c in columns] for row in rows])


def _shown(value: Any) -> str:
    if not isinstance(value, float):
        return str(value)
    return "–" if math.isnan(value) else f"{value:.4g}"
