"""Measure the cost of a rigid ball on a block in 3D whose whole top face is Γc, with friction.

The block is a cube of linear tetrahedra; the ball is moved down in one increment and in ten. At the
end a sixteenth of the top face is in contact. Compared are this package with its defaults, a
hand-written penalty form in DOLFINx with Newton's method and GMRES with GAMG, and one linear solve
of the body by factorisation and by multigrid. All residuals are below 1e-9 of the forces. Meshing
is not included, and the compilation of forms is timed separately.

    OMP_NUM_THREADS=1 python benchmarks/tagged.py            # four minutes
    OMP_NUM_THREADS=1 python benchmarks/tagged.py --short
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
    package = partial(case.package, friction)
    return {
        costs.REFERENCE_RUN: case.linear,
        f"{costs.REFERENCE_RUN}, multigrid": partial(case.linear, "multigrid"),
        "1 increment": package,
        "10 increments": partial(package, 10),
        f"10 increments{costs.LAST_INTERIOR}": partial(package, 10, "last"),
        costs.PLAIN["multigrid"]: partial(case.plain, friction, "multigrid"),
    }


def main() -> None:
    """Run the benchmark and write its results."""
    parser = costs.parser(__doc__, "tagged")
    parser.add_argument("--cells", type=int, nargs="+", default=[12, 20, 30], help="cells per side")
    parser.add_argument("--friction", type=float, default=0.3)
    arguments = parser.parse_args()
    if MPI.COMM_WORLD.size > 1:
        parser.error("runs on one rank")
    sizes = [6, 10, 14] if arguments.short else arguments.cells

    def make(cells: int) -> costs.Case:
        return costs.Case(problems.ball_on_tagged_block(cells), 1, arguments.stiffness)

    title = f"Ball on a block, whole top face on Γc, linear tetrahedra, μ = {arguments.friction:g}"
    title += f", k h/E = {arguments.stiffness:g}"
    cases = {f"{n} cells per side": partial(make, n) for n in sizes}
    costs.study("tagged", title, cases, partial(runs, friction=arguments.friction), arguments)


if __name__ == "__main__":
    np.seterr(all="ignore")
    main()
