r"""Compare two ranks with one, and fit a model of the cost.

The ball on a block of ``large.py`` is solved by multigrid in several sizes on one and on two ranks:
one linear solve, and contact with friction in one increment by L-BFGS and by Newton's method. The
cost of a message, a reduction and a byte between two processes of the same machine is measured
separately, and so is the memory bandwidth per rank when both ranks copy at once. The model is

    T = c n/p + m (α + s/(m β)) + r γ log₂ p

for each iteration on p ranks with n dofs: c is fitted to the times on one rank; m, s and r,
the messages, bytes and reductions of a rank, are counted by PETSc.

    OMP_NUM_THREADS=1 python benchmarks/parallel.py            # ten minutes
    OMP_NUM_THREADS=1 python benchmarks/parallel.py --short
    python benchmarks/parallel.py --tables       # from stored measurements

Two tables extrapolate from 1 to 1,024 ranks and from 1e5 to 1e9 dofs: contact by multigrid, and the
interface of the ranks with static condensation. Another table lists the time by operation.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mpi4py import MPI

from benchmarks import large, timing
from fenics_contact import plotting
from scenes.processes import run_json
from verification import report

RUNS = ("linear, multigrid", "contact, multigrid", "contact, multigrid, Newton")
CELLS = (24, 32, 47)
# Neighbours of a subdomain if there are many ranks.
NEIGHBOURS = 6
Row = timing.Row


@dataclass(frozen=True)
class Machine:
    """Costs of communication, and of shared memory bandwidth.

    Attributes:
        alpha: Time of an empty message (s).
        beta: Bytes sent per second.
        gamma: Time of a reduction over two ranks (s).
        bus: Time of a memory copy while the other rank copies as well, relative to one alone.
    """

    alpha: float
    beta: float
    gamma: float
    bus: float = 1.0


# Assumed networks, one rank per memory bus.
NETWORKS = {
    "fast network": Machine(2e-6, 10e9, 4e-6),
    "Ethernet": Machine(50e-6, 0.1e9, 100e-6),
}


# Extrapolated tables: dofs and ranks; memory per rank (GiB), fewest dofs per rank, and longest
# elimination of an interface (s) that is listed.
SIZES = (1e5, 1e6, 1e7, 1e8, 1e9)
RANKS = (1, 4, 16, 64, 256, 1024)
MEMORY_PER_RANK, MIN_DOFS_PER_RANK, MAX_ELIMINATION_TIME = 16.0, 5000, 600.0


# ---- the machine ---------------------------------------------------------------------------------


def fit_message(sizes: Sequence[float], times: Sequence[float]) -> tuple[float, float]:
    """Fit α and β of T = α + s/β by least squares of the relative differences.

    Args:
        sizes: Bytes.
        times: Seconds.
    """
    t = np.asarray(times)
    columns = np.column_stack([1 / t, np.asarray(sizes) / t])
    (alpha, slope), *_ = np.linalg.lstsq(columns, np.ones_like(t), rcond=None)
    return float(alpha), float(1 / slope)


def measure_machine() -> Machine:
    """Measure the constants of the model on two ranks. Collective."""
    comm = MPI.COMM_WORLD
    other = 1 - comm.rank
    sizes, times = [8 * 4**k for k in range(10)], []
    for size in sizes:
        buffer, rounds = np.zeros(size, dtype=np.uint8), []
        for _ in range(200):
            comm.Barrier()
            start = time.perf_counter()
            if comm.rank == 0:
                comm.Send(buffer, other)
                comm.Recv(buffer, other)
            else:
                comm.Recv(buffer, other)
                comm.Send(buffer, other)
            rounds.append((time.perf_counter() - start) / 2)
        times.append(statistics.median(rounds))
    alpha, beta = fit_message(sizes, times)
    one, sums, waits = np.ones(1), np.empty(1), []
    for _ in range(5000):
        start = time.perf_counter()
        comm.Allreduce(one, sums)
        waits.append(time.perf_counter() - start)
    # Memory copies on one rank after the other, then on both at once.
    a, b = np.zeros(10_000_000), np.ones(10_000_000)
    alone = together = 0.0
    for turn in range(2):
        comm.Barrier()
        if comm.rank == turn:
            alone = _copy(a, b)
    comm.Barrier()
    together = _copy(a, b)
    bus = comm.allreduce(together / alone) / comm.size
    return Machine(alpha, beta, statistics.median(waits), max(1.0, bus))


def _copy(a: np.ndarray, b: np.ndarray) -> float:
    times = []
    for _ in range(15):
        start = time.perf_counter()
        a[:] = b
        times.append(time.perf_counter() - start)
    return statistics.median(times)


# ---- the model -----------------------------------------------------------------------------------


def predict_time(c: float, row: Row, machine: Machine) -> float:
    """Return the time of the model for the dofs, iterations and counts of a row.

    Args:
        c: Time per dof and iteration (s).
        row: "dofs", "ranks", "iterations"; "messages", "MB sent" and "reductions" of a rank.
        machine: Constants.
    """
    p = row["ranks"]
    work = c * row["dofs"] / p * row["iterations"]
    if p == 1:
        return work
    sent = row["messages"] * machine.alpha + row["MB sent"] * 1e6 / machine.beta
    return work * machine.bus + sent + row["reductions"] * machine.gamma * np.log2(p)


def fit_operations(rows: Sequence[Row]) -> float:
    """Fit c to the rows on one rank: geometric mean of the time per dof and iteration (s)."""
    each = [r["seconds"] / r["dofs"] / r["iterations"] for r in rows if r["ranks"] == 1]
    return float(np.exp(np.mean(np.log(each))))


def extrapolate_counts(rows: Sequence[Row], dofs: float, ranks: int) -> Row:
    """Extrapolate the counts of an iteration from two ranks to many.

    On two ranks the body is cut once, through about n^(2/3) dofs; on many every subdomain has
    `NEIGHBOURS` cuts through (n/p)^(2/3).
    """
    two = [r for r in rows if r["ranks"] == 2]
    counts = {
        name: statistics.median(r[name] / r["iterations"] for r in two)
        for name in ("messages", "reductions")
    }
    sent = statistics.median(r["MB sent"] / r["iterations"] / r["dofs"] ** (2 / 3) for r in two)
    cuts, through = (1, dofs) if ranks == 2 else (NEIGHBOURS, dofs / ranks)
    return {
        "dofs": dofs,
        "ranks": ranks,
        "iterations": 1,
        "messages": counts["messages"] * cuts,
        "MB sent": sent * cuts * through ** (2 / 3),
        "reductions": counts["reductions"],
    }


def speed_up(c: float, rows: Sequence[Row], dofs: float, ranks: int, machine: Machine) -> float:
    """Return the speed-up of the model."""
    return c * dofs / predict_time(c, extrapolate_counts(rows, dofs, ranks), machine)


# ---- tables --------------------------------------------------------------------------------------


def compare_ranks(rows: Sequence[Row], machine: Machine) -> list[Row]:
    """Return the table of measured times and the model, on one and two ranks."""
    found = []
    for run in dict.fromkeys(row["run"] for row in rows):
        mine = [row for row in rows if row["run"] == run]
        c = fit_operations(mine)
        for row in mine:
            new: Row = {name: row[name] for name in ("run", "dofs", "ranks", "iterations")}
            new["seconds"] = row["seconds"]
            new["model [s]"] = predict_time(c, row, machine)
            if row["ranks"] > 1:
                one = next(r for r in mine if (r["dofs"], r["ranks"]) == (row["dofs"], 1))
                new["speed-up"] = one["seconds"] / row["seconds"]
                new["speed-up, model"] = predict_time(c, one, machine) / new["model [s]"]
                new["messages and reductions [s]"] = predict_time(0.0, row, machine)
            new["GiB per rank"] = row["GiB"] / row["ranks"]
            new["kB per dof"] = row["GiB"] * 2**20 / row["dofs"]
            found.append(new)
    return found


def operations(rows: Sequence[Row]) -> list[Row]:
    """Return the table of times by operation, of the largest problem on one and two ranks."""
    largest = max(row["dofs"] for row in rows)
    found = []
    for run in dict.fromkeys(row["run"] for row in rows):
        by_ranks = {r["ranks"]: r for r in rows if r["run"] == run and r["dofs"] == largest}
        if set(by_ranks) != {1, 2}:
            continue
        one, two = by_ranks[1], by_ranks[2]
        times = {name: (one[f"{name} [s]"], two[f"{name} [s]"]) for name in large.EVENTS}
        times["all"] = one["seconds"], two["seconds"]
        for name, (t1, t2) in times.items():
            row: Row = {"run": run, "dofs": largest, "operation": name}
            row |= {"1 rank [s]": t1, "2 ranks [s]": t2, "fraction": t2 / two["seconds"]}
            found.append(row | {"speed-up": t1 / t2 if t1 and t2 else float("nan")})
    return found


def counts(rows: Sequence[Row]) -> list[Row]:
    """Return the table of operations and messages of a rank per iteration, on two ranks."""
    return [
        {
            "run": row["run"],
            "dofs": row["dofs"],
            "operations per dof": row["Gflop"] * 1e9 / row["iterations"] / row["dofs"] * 2,
            "messages": row["messages"] / row["iterations"],
            "MB sent": row["MB sent"] / row["iterations"],
            "reductions": row["reductions"] / row["iterations"],
        }
        for row in rows
        if row["ranks"] == 2
    ]


def extrapolate_speed_up(c: float, rows: Sequence[Row], here: Machine) -> list[Row]:
    """Return the table of speed-ups of the model on many ranks."""
    found = []
    for name, machine in NETWORKS.items():
        for dofs in (1e6, 1e7):
            row: Row = {"network": name, "dofs": f"{dofs:.0e}"}
            for ranks in (8, 64, 512):
                row[f"{ranks} ranks"] = speed_up(c, rows, dofs, ranks, machine)
            found.append(row)
    return found


def extrapolate_time(rows: Sequence[Row], c: float, machine: Machine) -> list[Row]:
    """Return the table of times of one increment with contact on many ranks, by the model.

    Args:
        rows: Contact by multigrid, measured on one and two ranks.
        c: Time per dof and iteration (s).
        machine: Constants.
    """
    iterations = max(row["iterations"] for row in rows)
    memory = min(
        row["GiB"] / row["dofs"] for row in rows
    )  # reached by the largest problem, where libraries matter least
    found = []
    for dofs in SIZES:
        row: Row = {"dofs": f"{dofs:.0e}"}
        for ranks in RANKS:
            one = {"dofs": dofs, "ranks": 1, "iterations": 1}
            each = extrapolate_counts(rows, dofs, ranks) if ranks > 1 else one
            name = f"{ranks} ranks [s]" if ranks > 1 else "1 rank [s]"
            if memory * dofs / ranks > MEMORY_PER_RANK:
                row[name] = "memory"
            elif dofs / ranks < MIN_DOFS_PER_RANK:
                row[name] = "too few"
            else:
                row[name] = iterations * predict_time(c, each, machine)
        found.append(row)
    return found


def interfaces() -> list[Row]:
    """Return the table of interfaces of the ranks in static condensation, for square and cube."""
    found = []
    for d, body in ((2, "square"), (3, "cube")):
        for dofs in SIZES:
            for ranks in RANKS[1:]:
                cuts = d * (ranks ** (1 / d) - 1)
                shared = d * cuts * (dofs / d) ** (1 - 1 / d)
                row: Row = {"body": body, "dofs": f"{dofs:.0e}", "ranks": ranks}
                row |= {"interface dofs": shared, "dense matrix [GiB]": 8 * shared**2 / 2**30}
                found.append(row | {"seconds at 20 Gflop/s": 2 / 3 * shared**3 / 20e9})
    return [row for row in found if row["seconds at 20 Gflop/s"] < MAX_ELIMINATION_TIME]


def draw(path: Path, rows: Sequence[Row], machine: Machine) -> None:
    """Plot the modelled and the measured speed-up over the number of ranks."""
    mine = [row for row in rows if row["run"] == RUNS[1]]
    c = fit_operations(mine)
    ranks = 2 ** np.arange(0, 11)
    with plotting.figure(path, size=(7.5, 5.0)) as axes:
        for number, dofs in enumerate((1e5, 1e6, 1e7)):
            for style, (name, network) in zip("-:", NETWORKS.items(), strict=True):
                values = [1.0] + [speed_up(c, mine, dofs, p, network) for p in ranks[1:]]
                label = f"{dofs:.0e} dofs, {name}"
                axes.loglog(ranks, values, style, color=f"C{number}", label=label)
        measured = [row["speed-up"] for row in mine if row["ranks"] == 2]
        axes.loglog([2] * len(measured), measured, "ko", label="measured, one machine")
        axes.loglog(ranks, ranks, color="0.7", linewidth=0.8, label="ideal")
        axes.set(title="Contact by L-BFGS and multigrid, model", xlabel="ranks")
        axes.set_ylabel("speed-up")
        axes.grid(alpha=0.25, which="both")
        axes.legend(fontsize=8)


def read_measurements(path: Path) -> list[Row]:
    """Read stored rows, and convert numbers."""

    def value(text: str) -> float | int | str:
        for kind in (int, float):
            try:
                return kind(text)
            except ValueError:
                pass
        return text

    return [{k: value(v) for k, v in row.items() if v} for row in report.read(path)]


def launch_machine() -> Machine:
    """Run `measure_machine` in two new processes."""
    return Machine(**run_json(2, Path(__file__).resolve(), "--machine"))


def write_tables(folder: Path, rows: list[Row], machine: Machine) -> None:
    """Write the tables and the figure from the measured rows."""
    c = {run: fit_operations([r for r in rows if r["run"] == run]) for run in RUNS}
    mine = [row for row in rows if row["run"] == RUNS[1]]
    operations_take = ", ".join(f"{1e6 * value:.2g} µs ({run})" for run, value in c.items())
    note = (
        f"α = {machine.alpha * 1e6:.2g} µs, β = {machine.beta / 1e9:.3g} GB/s, "
        f"γ = {machine.gamma * 1e6:.2g} µs between two ranks of this machine. A memory copy "
        f"takes {machine.bus:.2f} times as long while the other rank copies as well: memory-bound "
        f"operations are {2 / machine.bus:.2f} times as fast on two ranks. c, the time per dof and "
        f"iteration on one rank: {operations_take}."
    )
    timing.write(
        folder, "parallel_1", "Two ranks compared with one", compare_ranks(rows, machine), note
    )
    timing.write(
        folder, "parallel_2", "Time by operation", operations(rows),
        "Seconds of the slowest rank in PETSc's operations, which overlap: products and smoothing "
        "are also part of the set-up. Not included are the assembly of the matrix, the law on Γc "
        "and the set-up of forms.",
    )  # fmt: skip
    timing.write(
        folder, "parallel_3", "Operations of a rank per iteration, on two ranks", counts(rows)
    )
    title = "Speed-up on more ranks (model), contact by L-BFGS and multigrid"
    assumed = ", ".join(
        f"{name}: α = {m.alpha * 1e6:g} µs, β = {m.beta / 1e9:g} GB/s, γ = {m.gamma * 1e6:g} µs"
        for name, m in NETWORKS.items()
    )
    assumed = f"Assumed, {assumed}, one rank per memory bus, {NEIGHBOURS} neighbours. "
    assumed += "Idle ranks on coarse levels, and load imbalance, are not included."
    timing.write(
        folder, "parallel_4", title, extrapolate_speed_up(c[RUNS[1]], mine, machine), assumed
    )
    iterations = max(row["iterations"] for row in mine)
    title = "One increment with contact by L-BFGS and multigrid (model)"
    assumed = (
        f"The model on the fast network, with c as measured here and {iterations} iterations, the "
        "largest number measured, for all sizes: measured were up to 332,000 dofs. "
        f'"memory": more than {MEMORY_PER_RANK:g} GiB per rank; "too few": fewer than '
        f"{MIN_DOFS_PER_RANK} dofs per "
        "rank. Coarse levels on one rank, and load imbalance, are not included."
    )
    extrapolated = extrapolate_time(mine, c[RUNS[1]], NETWORKS["fast network"])
    timing.write(folder, "parallel_5", title, extrapolated, assumed)
    assumed = (
        "A square or cube cut into one subdomain per rank: interface dofs, their dense matrix on "
        "rank 0, and the 2/3 n³ operations of its elimination. Omitted are those of more than "
        f"{MAX_ELIMINATION_TIME:g} s."
    )
    title = "The interface of the ranks with static condensation (model)"
    timing.write(folder, "parallel_6", title, interfaces(), assumed)
    draw(folder / "speed_up.png", rows, machine)


def main() -> None:
    """Run the benchmark and write its results."""
    parser = timing.parser(__doc__, "parallel")
    parser.add_argument("--cells", type=int, nargs="*", default=list(CELLS))
    parser.add_argument("--machine", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument(
        "--tables", action="store_true", help="write tables and figure of stored measurements"
    )
    arguments = parser.parse_args()
    if arguments.tables:
        machine = Machine(**json.loads((arguments.output / "machine.json").read_text()))
        write_tables(
            arguments.output, read_measurements(arguments.output / "parallel.csv"), machine
        )
        return
    if arguments.machine:
        machine = measure_machine()
        if MPI.COMM_WORLD.rank == 0:
            print(json.dumps(machine.__dict__), flush=True)
        return
    rows: list[Row] = []
    for cells in (8, 10) if arguments.short else arguments.cells:
        repeat = 1 if 3 * (cells + 1) ** 3 > large.MAX_FACTORED_DOFS else arguments.repeat
        some = []
        for run in RUNS:
            for ranks in (1, 2):
                some.append(large.start_process(run, cells, ranks, repeat))
                print(
                    f"{cells} cells, {run}, {ranks} ranks: {some[-1]['seconds']:.3g} s", flush=True
                )
        rows += large.add_ratios(some)
    arguments.output.mkdir(parents=True, exist_ok=True)
    report.save(arguments.output / "parallel.csv", rows)
    failed = [row for row in rows if row["iterations"] in ("none", "failed")]
    if failed:
        sys.exit(f"failed: {failed}")
    machine = launch_machine()
    (arguments.output / "machine.json").write_text(json.dumps(machine.__dict__, indent=1) + "\n")
    write_tables(arguments.output, rows, machine)


if __name__ == "__main__":
    np.seterr(all="ignore")
    main()
