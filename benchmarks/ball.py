"""A rigid ball on an elastic block, in space, with friction: what contact costs.

A quarter of the block by symmetry, hexahedra that grow with the distance from the contact, the
ball moved down in one increment: by this package as it chooses by itself, condensed, and on all
unknowns by multigrid; by a penalty form by hand in DOLFINx with Newton's method, every step by
MUMPS' LU or by GMRES with GAMG, told of the rigid motions; and one linear solve of the body, by
factorisation and by multigrid. Residuals end below 1e-9 of the forces in all of them. Meshing is
not counted, and the compiling of forms stands apart. Errors are those of force, peak pressure and
the displacement at the end of Γc against a finer mesh, of ``--reference`` cells a side and thrice
the stiffness, so that the error of a finite stiffness is among those that are seen.

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
    """What to time, by name."""
    return {
        costs.YARDSTICK: case.linear,
        f"{costs.YARDSTICK}, multigrid": partial(case.linear, "multigrid"),
        "by default": partial(case.package, friction),
        "condensed": partial(case.package, friction, condensation=True),
        "all unknowns, L-BFGS, multigrid": partial(
            case.package, friction, method="lbfgs", condensation=False, linear_solver="multigrid"
        ),
        **{name: partial(case.plain, friction, kind) for kind, name in costs.PLAIN.items()},
    }


def main() -> None:
    """Run."""
    parser = costs.parser(__doc__, "ball")
    parser.add_argument(
        "--cells", type=int, nargs="+", default=[7, 11, 16, 23, 32], help="a side; table: the last"
    )
    parser.add_argument("--reference", type=int, default=40, help="cells a side of the finer mesh")
    parser.add_argument("--friction", type=float, default=0.3)
    arguments = parser.parse_args()
    if MPI.COMM_WORLD.size > 1:
        parser.error("times here are of one rank; large.py takes several (--ranks)")
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
    cases = {f"{n} cells a side": partial(make, n) for n in sizes}
    costs.study("ball", title, cases, partial(runs, friction=arguments.friction), arguments)


if __name__ == "__main__":
    np.seterr(all="ignore")
    main()
