r"""Ball on a block in three dimensions, from thirty thousand to a million unknowns.

The scene of ``ball.py`` in one increment, every run in a process of its own, so that its peak
memory is its own: one linear solve of the same body by multigrid (the yardstick), and this package
as it chooses by itself. ``--runs`` names others: the linear solve by a factorisation, this package
as it is told, and Newton's method as a user of DOLFINx writes it. All to 1e-9 of the forces, the
script's linear solves to PETSc's 1e-5. Meshes and compiled forms are not counted.

    OMP_NUM_THREADS=1 python benchmarks/large.py              # seven minutes
    OMP_NUM_THREADS=1 python benchmarks/large.py --cells 69   # a million unknowns alone: five
    OMP_NUM_THREADS=1 python benchmarks/large.py --cells 47 --ranks 1 2

The force is compared with the finest mesh's, and with Hertz's F = 4/3 E* √R d^{3/2} for a
half-space without friction: the block is ten contact radii wide and held there, which stiffens it
by some a/L, and friction by two percent. "messages", "MB sent" and "reductions" are of one rank
(the largest) in the solution, as PETSc counts them; ``parallel.py`` makes a model of them.
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
from scenes.processes import answer

COMM = MPI.COMM_WORLD
FRICTION = 0.3
FACTOR = 10.0  # k_n h/E = k_t h/E
YARDSTICK = "linear, multigrid"
DEFAULT = (YARDSTICK, "contact")
CELLS = {31_944: 21, 107_811: 32, 331_776: 47, 1_029_000: 69}
# Factorisations of more unknowns than this are minutes, or do not fit.
MANY = 150_000
# Where the time of a solution goes, by PETSc's names.
EVENTS = {
    "products with matrices": ("MatMult", "MatMultAdd", "MatMultTranspose"),
    "smoothing": ("MatSOR",),
    "set-up of multigrid": ("PCSetUp",),
    "sums over all ranks": ("VecNorm", "VecTDot", "VecDot", "VecMDot", "VecReduceComm"),
    "residuals": ("SNESFunctionEval",),
}

Run = Callable[[costs.Case], costs.Row]


def package(**options: Any) -> Run:
    """This package."""
    return lambda case: case.package(FRICTION, **options)


def yardstick(kind: str) -> Run:
    """One linear solve."""
    return lambda case: case.linear(kind)


def by_hand(kind: str) -> Run:
    """A script on top of DOLFINx."""
    return lambda case: case.plain(FRICTION, kind)


RUNS: dict[str, Run] = {
    YARDSTICK: yardstick("multigrid"),
    "linear, direct": yardstick("direct"),
    "contact": package(),
    "contact, multigrid": package(method="lbfgs", condensation=False, linear_solver="multigrid"),
    "contact, multigrid, Newton": package(method="newton", linear_solver="multigrid"),
    "contact, condensed": package(condensation=True),
    "by hand, GMRES + GAMG": by_hand("multigrid"),
    "by hand, LU": by_hand("direct"),
}
FACTORED = ("linear, direct", "contact, condensed", "by hand, LU")


# ---- one process for each ------------------------------------------------------------------------


def child(run: str, cells: int, repeat: int) -> None:
    """One run in this process; its row as JSON, the last line that rank 0 prints. Collective."""
    PETSc.Log.begin()
    start = time.perf_counter()
    RUNS[run](costs.Case(problems.ball_on_block(6), 1, FACTOR))
    first = time.perf_counter() - start
    case = costs.Case(problems.ball_on_block(cells), 1, FACTOR)
    times, before, spent = [], counted(), events()
    for _ in range(repeat):
        COMM.Barrier()
        start = time.perf_counter()
        row = RUNS[run](case)
        times.append(COMM.allreduce(time.perf_counter() - start, op=MPI.MAX))
    made, shares = (counted() - before) / repeat, (events() - spent) / repeat
    flops, messages, sent, reductions = (COMM.allreduce(float(v), op=MPI.MAX) for v in made)
    row = {"run": run, "dofs": case.n_dofs, "ranks": COMM.size} | row
    row |= {"seconds": statistics.median(times), "GiB": timing.peak_memory()}
    row |= {"Gflop": flops / 1e9, "messages": messages, "MB sent": sent / 1e6}
    row |= {"reductions": reductions, "first use [s]": first}
    for name, seconds in zip(EVENTS, shares, strict=True):
        row[f"{name} [s]"] = COMM.allreduce(float(seconds), op=MPI.MAX)
    if COMM.rank == 0:
        print(json.dumps(row), flush=True)


def counted() -> np.ndarray:
    """Operations, messages, bytes sent and reductions of this rank so far, in solutions."""
    found = [PETSc.Log.Event(name).getPerfInfo() for name in ("KSPSolve", "SNESSolve")]
    # Linear solves inside of SNES are counted there.
    info = max(found, key=lambda item: item["flops"])
    return np.array([info[k] for k in ("flops", "numMessages", "messageLength", "numReductions")])


def events() -> np.ndarray:
    """Seconds of this rank so far in each of `EVENTS`."""
    return np.array(
        [
            sum(PETSc.Log.Event(name).getPerfInfo()["time"] for name in names)
            for names in EVENTS.values()
        ]
    )


def start(run: str, cells: int, ranks: int, repeat: int) -> dict[str, Any]:
    """The row of a run in new processes."""
    words = ["--child", run, "--cells", cells, "--repeat", repeat]
    try:
        return answer(ranks, Path(__file__).resolve(), *words)
    except subprocess.CalledProcessError:
        return {"run": run, "ranks": ranks, "iterations": "failed", "seconds": float("nan")}


def in_units(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of one mesh, with times in units of linear solves on as many ranks, and speed-ups."""

    def of(run: str, ranks: int) -> float:
        return next((r["seconds"] for r in rows if (r["run"], r["ranks"]) == (run, ranks)), np.nan)

    for row in rows:
        for name in (YARDSTICK, "linear, direct"):
            unit = of(name, row["ranks"])
            if not np.isnan(unit):
                row[f"in solves ({name.split()[1]})"] = row["seconds"] / unit
        if row["ranks"] > 1:
            row["speed-up"] = of(row["run"], 1) / row["seconds"]
    return rows


def main() -> None:
    """Run."""
    parser = timing.parser(__doc__, "large")
    parser.add_argument("--cells", type=int, nargs="*", help=f"along an edge; by default {CELLS}")
    parser.add_argument("--ranks", type=int, nargs="*", default=[1])
    parser.add_argument("--runs", nargs="*", choices=RUNS, default=list(DEFAULT))
    parser.add_argument("--child", choices=RUNS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        child(arguments.child, arguments.cells[0], arguments.repeat)
        return
    default = [12, 16] if arguments.short else list(CELLS.values())
    rows: list[dict[str, Any]] = []
    for cells in arguments.cells or default:
        n_dofs = 3 * (cells + 1) ** 3
        some = []
        for run in arguments.runs:
            if run in FACTORED and n_dofs > MANY:
                continue
            for ranks in arguments.ranks:
                repeat = 1 if n_dofs > MANY else arguments.repeat
                some.append(start(run, cells, ranks, repeat))
                print(
                    f"{cells} cells, {run}, {ranks} ranks: {some[-1]['seconds']:.3g} s", flush=True
                )
        rows += in_units(some)
    finest = [row["force"] for row in rows if "force" in row]
    for row in rows:
        if "force" in row:
            # The force is that on a quarter.
            row["force/finest - 1"] = row["force"] / finest[-1] - 1
            row["force/Hertz - 1"] = 4 * row["force"] / problems.hertz_force() - 1
    title = f"Ball on a block, hexahedra, μ = {FRICTION:g}, k h/E = {FACTOR:g}"
    timing.write(arguments.output, "large", title, rows)
    series: dict[str, tuple[list[float], list[float]]] = {}
    memory: dict[str, tuple[list[float], list[float]]] = {}
    for row in rows:
        if row["ranks"] == 1 and "dofs" in row and row["iterations"] != "none":
            for picture, column in ((series, "seconds"), (memory, "GiB")):
                x, y = picture.setdefault(row["run"], ([], []))
                x.append(row["dofs"])
                y.append(row[column])
    timing.draw(arguments.output / "seconds.png", title, "unknowns", "seconds", series)
    timing.draw(arguments.output / "memory.png", title, "unknowns", "peak memory [GiB]", memory)


if __name__ == "__main__":
    main()
