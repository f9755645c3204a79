r"""Measure time and memory of a ball on a block in 3D, from 32 thousand to a million dofs.

The problem is that of ``ball.py`` in one increment. Each run is a new process, whose peak memory is
measured. The runs are one linear solve of the same body by multigrid, and this package with its
defaults. ``--runs`` selects others: the linear solve by factorisation, this package with other
options, and a hand-written Newton method in DOLFINx. Residuals are below 1e-9 of the forces; the
linear solves of the hand-written method use PETSc's default of 1e-5. Meshing and compilation are
not included.

    OMP_NUM_THREADS=1 python benchmarks/large.py              # seven minutes
    OMP_NUM_THREADS=1 python benchmarks/large.py --cells 69   # a million dofs only: five
    OMP_NUM_THREADS=1 python benchmarks/large.py --cells 47 --ranks 1 2

The force is compared with that on the finest mesh, and with Hertz's F = 4/3 E* √R d^{3/2} for a
frictionless half-space: the block is ten contact radii wide and constrained there, which stiffens
it by about a/L; friction adds 2 %. "messages", "MB sent" and "reductions" are PETSc's counts of
one rank (the largest) during the solution; ``parallel.py`` uses them in a model of the cost.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from benchmarks import costs, timing
from scenes import problems
from scenes.processes import run_json

COMM = MPI.COMM_WORLD
FRICTION = 0.3
RELATIVE_STIFFNESS = 10.0  # k_n h/E = k_t h/E
REFERENCE_RUN = "linear, multigrid"
DEFAULT = (REFERENCE_RUN, "contact")
CELLS = {31_944: 21, 107_811: 32, 331_776: 47, 1_029_000: 69}
# Most dofs that are factored; more take minutes, or do not fit into memory.
MAX_FACTORED_DOFS = 150_000
# Operations of a solution, and PETSc's events for each.
EVENTS = {
    "products with matrices": ("MatMult", "MatMultAdd", "MatMultTranspose"),
    "smoothing": ("MatSOR",),
    "set-up of multigrid": ("PCSetUp",),
    "reductions": ("VecNorm", "VecTDot", "VecDot", "VecMDot", "VecReduceComm"),
    "residuals": ("SNESFunctionEval",),
}

Run = Callable[[costs.Case], costs.Row]


def package(**options: Any) -> Run:
    """Return a run of this package."""
    return lambda case: case.package(FRICTION, **options)


def linear(kind: str) -> Run:
    """Return a run of one linear solve."""
    return lambda case: case.linear(kind)


def plain_dolfinx(kind: str) -> Run:
    """Return a run of the hand-written method in DOLFINx."""
    return lambda case: case.plain(FRICTION, kind)


RUNS: dict[str, Run] = {
    REFERENCE_RUN: linear("multigrid"),
    "linear, direct": linear("direct"),
    "contact": package(),
    "contact, multigrid": package(method="lbfgs", condensation=False, linear_solver="multigrid"),
    "contact, multigrid, Newton": package(method="newton", linear_solver="multigrid"),
    "contact, condensed": package(condensation=True),
    "by hand, GMRES + GAMG": plain_dolfinx("multigrid"),
    "by hand, LU": plain_dolfinx("direct"),
}
FACTORED_RUNS = ("linear, direct", "contact, condensed", "by hand, LU")


# ---- one process per run -------------------------------------------------------------------------


def run_in_process(run: str, cells: int, repeat: int) -> None:
    """Time one run and print its row as JSON, the last line of rank 0. Collective."""
    PETSc.Log.begin()
    start = time.perf_counter()
    RUNS[run](costs.Case(problems.ball_on_block(6), 1, RELATIVE_STIFFNESS))
    first = time.perf_counter() - start
    case = costs.Case(problems.ball_on_block(cells), 1, RELATIVE_STIFFNESS)
    times, before, spent = [], count_operations(), event_times()
    for _ in range(repeat):
        COMM.Barrier()
        start = time.perf_counter()
        row = RUNS[run](case)
        times.append(COMM.allreduce(time.perf_counter() - start, op=MPI.MAX))
    made, times_by_event = (count_operations() - before) / repeat, (event_times() - spent) / repeat
    flops, messages, sent, reductions = (COMM.allreduce(float(v), op=MPI.MAX) for v in made)
    row = {"run": run, "dofs": case.n_dofs, "ranks": COMM.size} | row
    row |= {"seconds": statistics.median(times), "GiB": timing.peak_memory()}
    row |= {"Gflop": flops / 1e9, "messages": messages, "MB sent": sent / 1e6}
    row |= {"reductions": reductions, "first run [s]": first}
    for name, seconds in zip(EVENTS, times_by_event, strict=True):
        row[f"{name} [s]"] = COMM.allreduce(float(seconds), op=MPI.MAX)
    if COMM.rank == 0:
        print(json.dumps(row), flush=True)


def count_operations() -> np.ndarray:
    """Return operations, messages, bytes sent and reductions of this rank in solves so far."""
    found = [PETSc.Log.Event(name).getPerfInfo() for name in ("KSPSolve", "SNESSolve")]
    # SNES includes its linear solves.
    info = max(found, key=lambda item: item["flops"])
    return np.array([info[k] for k in ("flops", "numMessages", "messageLength", "numReductions")])


def event_times() -> np.ndarray:
    """Return the seconds of this rank so far in each of `EVENTS`."""
    return np.array(
        [
            sum(PETSc.Log.Event(name).getPerfInfo()["time"] for name in names)
            for names in EVENTS.values()
        ]
    )


def start_process(run: str, cells: int, ranks: int, repeat: int) -> dict[str, Any]:
    """Return the row of a run in new processes."""
    words = ["--child", run, "--cells", cells, "--repeat", repeat]
    try:
        return run_json(ranks, Path(__file__).resolve(), *words)
    except subprocess.CalledProcessError:
        return {"run": run, "ranks": ranks, "iterations": "failed", "seconds": float("nan")}


def add_ratios(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Add times in linear solves on as many ranks, and speed-ups, to the rows of one mesh."""

    def of(run: str, ranks: int) -> float:
        return next((r["seconds"] for r in rows if (r["run"], r["ranks"]) == (run, ranks)), np.nan)

    for row in rows:
        for name in (REFERENCE_RUN, "linear, direct"):
            unit = of(name, row["ranks"])
            if not np.isnan(unit):
                row[f"linear solves ({name.split()[1]})"] = row["seconds"] / unit
        if row["ranks"] > 1:
            row["speed-up"] = of(row["run"], 1) / row["seconds"]
    return rows


def main() -> None:
    """Run the benchmark and write its results."""
    parser = timing.parser(__doc__, "large")
    parser.add_argument("--cells", type=int, nargs="*", help=f"per edge; default {CELLS}")
    parser.add_argument("--ranks", type=int, nargs="*", default=[1])
    parser.add_argument("--runs", nargs="*", choices=RUNS, default=list(DEFAULT))
    parser.add_argument("--child", choices=RUNS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        run_in_process(arguments.child, arguments.cells[0], arguments.repeat)
        return
    default = [12, 16] if arguments.short else list(CELLS.values())
    rows: list[dict[str, Any]] = []
    for cells in arguments.cells or default:
        n_dofs = 3 * (cells + 1) ** 3
        some = []
        for run in arguments.runs:
            if run in FACTORED_RUNS and n_dofs > MAX_FACTORED_DOFS:
                continue
            for ranks in arguments.ranks:
                repeat = 1 if n_dofs > MAX_FACTORED_DOFS else arguments.repeat
                some.append(start_process(run, cells, ranks, repeat))
                print(
                    f"{cells} cells, {run}, {ranks} ranks: {some[-1]['seconds']:.3g} s", flush=True
                )
        rows += add_ratios(some)
    finest = [row["force"] for row in rows if "force" in row]
    for row in rows:
        if "force" in row:
            # A quarter of the problem is modelled.
            row["force/finest - 1"] = row["force"] / finest[-1] - 1
            row["force/Hertz - 1"] = 4 * row["force"] / problems.hertz_force() - 1
    title = f"Ball on a block, hexahedra, μ = {FRICTION:g}, k h/E = {RELATIVE_STIFFNESS:g}"
    timing.write(arguments.output, "large", title, rows)


if __name__ == "__main__":
    main()
