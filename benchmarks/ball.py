"""Measure the cost of a rigid ball on an elastic block in 3D relative to one linear solve.

A quarter of the block is modelled by symmetry, with hexahedra graded towards the contact, with
friction, in one increment. Compared are this package with its defaults, with static condensation,
and on all dofs with multigrid; a hand-written penalty form in DOLFINx with Newton's method, each
step solved by MUMPS' LU or by GMRES with GAMG and the rigid-body modes as near-nullspace; and one
linear solve of the body, by factorisation and by multigrid. All residuals are below 1e-9 of the
forces. Meshing is not included, and the compilation of forms is timed separately. Errors of force,
peak pressure and displacement at the end of Γc are relative to a finer mesh of ``--reference``
cells per side with three times the contact stiffness, so that the penalty error is included.

    OMP_NUM_THREADS=1 python benchmarks/ball.py              # ten minutes
    OMP_NUM_THREADS=1 python benchmarks/ball.py --short
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from mpi4py import MPI

from benchmarks import costs
from scenes import problems


def runs(case: costs.Case, friction: float) -> dict[str, Callable[[], costs.Row]]:
    """Return the runs to time, by name."""
    return {
        costs.REFERENCE_RUN: case.linear,
        f"{costs.REFERENCE_RUN}, multigrid": partial(case.linear, "multigrid"),
        "by default": partial(case.package, friction),
        "condensed": partial(case.package, friction, condensation=True),
        "all dofs, L-BFGS, multigrid": partial(
            case.package, friction, method="lbfgs", condensation=False, linear_solver="multigrid"
        ),
        **{name: partial(case.plain, friction, kind) for kind, name in costs.PLAIN.items()},
    }


def main() -> None:
    """Run the benchmark and write its results."""
    parser = costs.parser(__doc__, "ball")
    parser.add_argument(
        "--cells", type=int, nargs="+", default=[7, 11, 16, 23, 32], help="cells per side"
    )
    parser.add_argument("--reference", type=int, default=40, help="cells per side of the reference")
    parser.add_argument("--friction", type=float, default=0.3)
    arguments = parser.parse_args()
    if MPI.COMM_WORLD.size > 1:
        parser.error("runs on one rank; for several see large.py")
    sizes, finer = arguments.cells, arguments.reference
    if arguments.short:
        sizes, finer = [6, 8, 11], 14
    finest = costs.Case(problems.ball_on_block(finer), 1, 3 * arguments.stiffness)
    exact = finest.package(arguments.friction, linear_solver="multigrid")

    def errors(friction: float, steps: int, results: costs.Row) -> costs.Row:
        names = {"force": "force", "peak": "peak", "u": "u_z"}
        return {
            f"error of {shown} [%]": 100 * abs(results[name] / exact[name] - 1)
            for name, shown in names.items()
        }

    def make(cells: int) -> costs.Case:
        return costs.Case(problems.ball_on_block(cells), 1, arguments.stiffness, errors)

    title = f"Ball on a block, trilinear, μ = {arguments.friction:g}, k h/E = "
    title += f"{arguments.stiffness:g}"
    cases = {f"{n} cells per side": partial(make, n) for n in sizes}
    costs.study("ball", title, cases, partial(runs, friction=arguments.friction), arguments)


if __name__ == "__main__":
    np.seterr(all="ignore")
    main()
