"""Measure the cost of a half-cylinder on a rigid plane relative to one linear solve.

The problem is that of ``demos/hertz.py``, without and with friction, in one increment and in 40.
Compared are this package with its defaults, with static condensation and L-BFGS, and on all dofs; a
hand-written penalty form in DOLFINx with Newton's method and MUMPS' LU; and one linear solve of the
same body tied to the plane. Meshing is not included, and the compilation of forms is timed
separately. Errors are relative to the independent solution of the demo (exact complementarity);
with friction in one increment, to this package's augmented Lagrangian solution on a finer mesh.

    OMP_NUM_THREADS=1 python benchmarks/half_cylinder.py
    OMP_NUM_THREADS=1 python benchmarks/half_cylinder.py --short
"""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import numpy as np
from mpi4py import MPI

from benchmarks import costs
from scenes import problems
from scenes.problems import hertz

# Fewest increments that are compared with the independent solution.
MIN_COMPARED_INCREMENTS = 40


@cache
def one_increment(friction: float, h: float) -> dict[str, float]:
    """Return the augmented Lagrangian solution of one increment on quadratic cells of size h."""
    body = problems.half_cylinder(friction, h)
    choices = {"enforcement": "augmented", "tolerance": 1e-7}
    problem, contact, u, load = problems.problem(body, 2, 10.0, contact_options=choices)
    load.value = body.final_load
    problem.solve()
    return {"u": body.displacement(u), "peak": contact.resultants().max_pressure}


def errors(finer: float, friction: float, steps: int, results: costs.Row) -> costs.Row:
    """Return the errors of the displacement of the top and of the peak pressure (%)."""
    if friction and steps < MIN_COMPARED_INCREMENTS:
        exact = one_increment(friction, finer)
    elif friction in hertz.EXACT:
        values = hertz.EXACT[friction]
        exact = {"u": values["top_centre_displacement"][1], "peak": values["peak_pressure"]}
    else:
        return {}
    return {
        "error of u_y [%]": 100 * abs(results["u"] / exact["u"] - 1),
        "error of the peak [%]": 100 * abs(results["peak"] / exact["peak"] - 1),
    }


def main() -> None:
    """Run the benchmark and write its results."""
    parser = costs.parser(__doc__, "half_cylinder")
    parser.add_argument(
        "--h",
        type=float,
        nargs="+",
        default=[0.25, 0.12, 0.06, 0.03, 0.0165, 0.0115],
        help="cell sizes on Γc",
    )
    parser.add_argument("--degree", type=int, default=2)
    parser.add_argument("--friction", type=float, nargs="*", default=[0.0, 0.2])
    parser.add_argument("--increments", type=int, nargs="*", default=[1, MIN_COMPARED_INCREMENTS])
    parser.add_argument("--all", action="store_true", help="40 increments on all dofs, too")
    arguments = parser.parse_args()
    if MPI.COMM_WORLD.size > 1:
        parser.error("runs on one rank; for several see ranks.py")
    sizes = [0.25, 0.12, 0.06] if arguments.short else arguments.h
    finer = min(sizes) / 1.5
    for friction in arguments.friction:
        if friction and min(arguments.increments) < MIN_COMPARED_INCREMENTS:
            one_increment(friction, finer)

    def make(h: float) -> costs.Case:
        body = problems.half_cylinder(0.0, h)
        return costs.Case(body, arguments.degree, arguments.stiffness, partial(errors, finer))

    def choose(case: costs.Case) -> dict[str, Any]:
        return costs.runs(
            case, arguments.friction, arguments.increments, all_unknowns=arguments.all
        )

    title = f"Half-cylinder, degree {arguments.degree}, k h/E = {arguments.stiffness:g}"
    cases = {f"h = {h:g}": partial(make, h) for h in sizes}
    costs.study("half_cylinder", title, cases, choose, arguments)


if __name__ == "__main__":
    np.seterr(all="ignore")
    main()
