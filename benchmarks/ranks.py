"""Measure the speed-up of this package and of plain DOLFINx on several ranks.

Timed are the half-cylinder of ``half_cylinder.py``, without and with friction, in one increment and
in 40, by this package with its defaults; one linear solve of the same body tied to the plane
(MUMPS' Cholesky factorisation); and a hand-written penalty form in DOLFINx with Newton's method and
MUMPS' LU. Meshing and compilation are not included. Times are those of the slowest rank, also in
units of one linear solve on one rank and on the same number of ranks.

    OMP_NUM_THREADS=1 python benchmarks/ranks.py                 # two minutes
    OMP_NUM_THREADS=1 python benchmarks/ranks.py --ranks 1 2 4 --h 0.0115
    OMP_NUM_THREADS=1 python benchmarks/ranks.py --short
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from mpi4py import MPI

from benchmarks import costs, timing
from scenes import problems
from scenes.processes import run_json

# k_n h/E = k_t h/E, and the degree of the displacement.
STIFFNESS, DEGREE = 10.0, 2
# Friction and increments.
HISTORIES = ((0.0, 1), (0.2, 1), (0.2, 40))
Row = timing.Row


def runs(case: costs.Case) -> dict[str, Callable[[], Row]]:
    """Return the runs to time, by name."""
    found: dict[str, Callable[[], Row]] = {costs.REFERENCE_RUN: case.linear}
    for friction in dict.fromkeys(friction for friction, _ in HISTORIES):
        name = f"μ = {friction:g}: {costs.PLAIN['direct']}"
        found[name] = partial(case.plain, friction)
    for friction, steps in HISTORIES:
        name, field = f"μ = {friction:g}, {steps} increments", "every"
        if steps > 1:
            name, field = name + costs.LAST_INTERIOR, "last"
        found[name] = partial(case.package, friction, steps, field)
    return found


def run_in_process(h: float, repeat: int) -> None:
    """Time all runs and print their rows as JSON, the last line of rank 0. Collective."""
    small, case = (
        costs.Case(problems.half_cylinder(0.0, size), DEGREE, STIFFNESS) for size in (0.25, h)
    )
    rows = timing.measure(
        runs(case), repeat=repeat, first=runs(small), once=costs.MAX_REPEATED_TIME
    )
    rows = [{"dofs": case.n_dofs, "ranks": MPI.COMM_WORLD.size} | row for row in rows]
    if MPI.COMM_WORLD.rank == 0:
        print(json.dumps(rows), flush=True)


def start_process(h: float, ranks: int, repeat: int) -> list[Row]:
    """Return the rows of a mesh size, measured in new processes."""
    return run_json(ranks, Path(__file__).resolve(), "--child", "--h", h, "--repeat", repeat)


def add_ratios(rows: list[Row]) -> list[Row]:
    """Return the rows of one size with times in linear solves and speed-ups."""

    def seconds(run: str, ranks: int) -> float:
        return next((r["seconds"] for r in rows if (r["run"], r["ranks"]) == (run, ranks)), np.nan)

    found = []
    for row in rows:
        new = {name: row[name] for name in ("dofs", "run", "ranks", "iterations", "seconds")}
        new["linear solves on one rank"] = row["seconds"] / seconds(costs.REFERENCE_RUN, 1)
        new["linear solves on as many ranks"] = row["seconds"] / seconds(
            costs.REFERENCE_RUN, row["ranks"]
        )
        new["speed-up"] = seconds(row["run"], 1) / row["seconds"]
        # The results do not depend on the number of ranks.
        new |= {name: row[name] for name in ("force", "peak") if name in row}
        found.append(new)
    return found


def main() -> None:
    """Run the benchmark and write its results."""
    parser = timing.parser(__doc__, "ranks")
    parser.add_argument("--h", type=float, nargs="*", default=[0.0165], help="cell size on Γc")
    parser.add_argument("--ranks", type=int, nargs="*", default=[1, 2])
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        run_in_process(arguments.h[0], arguments.repeat)
        return
    everything: list[Row] = []
    for h in [0.25, 0.12] if arguments.short else arguments.h:
        rows: list[Row] = []
        for ranks in arguments.ranks:
            rows += start_process(h, ranks, arguments.repeat)
            print(f"h = {h:g}, {ranks} ranks: done", flush=True)
        everything += add_ratios(rows)
    if any(row["iterations"] == "none" for row in everything):
        sys.exit(f"failed: {everything}")
    title = f"Half-cylinder on several ranks, degree {DEGREE}, k h/E = {STIFFNESS:g}"
    timing.write(arguments.output, "ranks", title, everything)


if __name__ == "__main__":
    np.seterr(all="ignore")
    main()
