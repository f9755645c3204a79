"""Measure the cost of increments of a bolted joint, and of the refusal of an overload.

Two plates and a bolt of quadratic tetrahedra (``scenes/bolted_joint.py``), connected by friction
only in three contacts between pairs of bodies, are preloaded in two increments, pulled to 2000 N in
four, then by a force 5 % above the friction limit, for which there is no equilibrium. Times are in
units of one linear solve of the same bodies tied at the three contacts, the alternative without a
contact solver (MUMPS' Cholesky factorisation on as many ranks). Meshing and compilation are not
included. There is no comparison with plain DOLFINx, which has no contact search.

    OMP_NUM_THREADS=1 python benchmarks/bolted_joint.py            # 55,000: 4 min on one rank
    OMP_NUM_THREADS=1 python benchmarks/bolted_joint.py --size 1.1 # 300,000
    OMP_NUM_THREADS=1 python benchmarks/bolted_joint.py --short
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import ufl
from mpi4py import MPI

import fenics_contact as fc
from benchmarks import costs, timing
from scenes import bolted_joint as joint
from scenes.elasticity import residual
from scenes.problems import n_dofs
from scenes.processes import run_json

COMM = MPI.COMM_WORLD
PRELOAD_END, PULL_END = 1.0, 3.0  # load parameter at the end of preload and pull
INCREMENT = 0.5
OVERLOAD_RATIO = 1.05  # relative to the friction limit
Row = timing.Row


def linear(made: joint.BoltedJoint, repeat: int) -> float:
    """Return the median time of one linear solve of the bodies, tied at the contacts (s)."""
    u = made.u.copy()
    v = ufl.TestFunction(u.function_space)
    F = residual(u, v, joint.E, joint.NU) - v[0] * ufl.dx
    return costs.time_of_tied_bodies(made.problem, u, F, repeat)


def run_in_process(size: float, degree: int, repeat: int) -> None:
    """Solve all increments, and print their rows as JSON, the last line of rank 0."""
    for _ in joint.BoltedJoint(8.0, degree=degree).increments(INCREMENT, steps=1):
        pass  # compiles the forms
    made = joint.BoltedJoint(size, degree=degree)
    unit = linear(made, repeat)
    common = {"dofs": n_dofs(made.u.function_space), "ranks": COMM.size}
    rows: list[Row] = []
    start = costs.now()
    for step in made.increments(PULL_END, steps=round(PULL_END / INCREMENT)):
        seconds = costs.now() - start
        preload = made.pull.value == 0.0
        what = "preload" if preload else f"pull {float(made.pull.value):g} N"
        rows.append({"increment": what, "iterations": step.iterations, "method": step.method})
        rows[-1] |= {"seconds": seconds, "linear solves": seconds / unit}
        start = costs.now()
    plates, head, _ = (contact.resultants() for contact in made.contacts)
    limit = joint.FRICTION * (plates.normal_force + head.normal_force)
    made.load(PRELOAD_END + OVERLOAD_RATIO * limit / 1000.0)
    start = costs.now()
    try:
        step = made.problem.solve()
        iterations, outcome = step.iterations, "solved"
    except fc.NotConverged as error:
        iterations = error.iterations
        outcome = "refused: " + ("overload" if "overload:" in str(error) else "no solution found")
    seconds = costs.now() - start
    what = f"pull {float(made.pull.value):.0f} N, above the friction limit"
    rows.append({"increment": what, "iterations": iterations, "method": outcome})
    rows[-1] |= {"seconds": seconds, "linear solves": seconds / unit}
    if COMM.rank == 0:
        print(json.dumps([common | row for row in rows]), flush=True)


def main() -> None:
    """Run the benchmark and write its results."""
    parser = timing.parser(__doc__, "bolted_joint")
    parser.add_argument("--size", type=float, nargs="*", default=[2.1], help="cell size (mm)")
    parser.add_argument("--degree", type=int, default=2)
    parser.add_argument("--ranks", type=int, nargs="*", default=[1, 2])
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        run_in_process(arguments.size[0], arguments.degree, arguments.repeat)
        return
    degree = 1 if arguments.short else arguments.degree
    rows: list[Row] = []
    for size in [5.0] if arguments.short else arguments.size:
        for ranks in arguments.ranks:
            words = ["--child", "--size", size, "--degree", degree, "--repeat", arguments.repeat]
            rows += run_json(ranks, Path(__file__).resolve(), *words)
            print(f"cells of {size:g} mm, {ranks} ranks: done", flush=True)
    title = f"Bolted joint, tetrahedra of degree {degree}, μ = {joint.FRICTION:g}"
    timing.write(arguments.output, "bolted_joint", title, rows)


if __name__ == "__main__":
    np.seterr(all="ignore")
    main()
