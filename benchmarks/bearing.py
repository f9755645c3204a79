"""Measure the cost of increments of a roller bearing: ten bodies in sixteen contacts.

``demos/bearing.py``: the shaft moves down in five increments, in which four of the rollers are
loaded one pair after the other; eight bodies are held by friction only, and four are loose. Times
are in units of one linear solve of the same bodies tied at all contacts (MUMPS' Cholesky
factorisation). Meshing and compilation are not included.

    OMP_NUM_THREADS=1 python benchmarks/bearing.py
    OMP_NUM_THREADS=1 python benchmarks/bearing.py --short
"""

from __future__ import annotations

import logging
import warnings

import numpy as np
import ufl

import fenics_contact as fc
from benchmarks import costs, timing
from demos import bearing
from fenics_contact.elasticity import LinearElastic
from scenes.problems import n_dofs


def solve(size: float, repeat: int) -> list[timing.Row]:
    """Load the bearing with triangles of a size at the contacts; return rows. Collective."""
    made = bearing.Bearing(size)
    u = made.steel.u.copy()
    v = ufl.TestFunction(u.function_space)
    F = LinearElastic(u, bearing.E, bearing.NU, "plane strain").residual(v) - v[1] * ufl.dx
    unit = costs.time_of_tied_bodies(made.problem, u, F, repeat)
    rows, start = [], costs.now()
    for step in fc.increments(made.problem, made.load, steps=bearing.STEPS):
        seconds = costs.now() - start
        loads = [contact.resultants().normal_force for contact in made.inside]
        rows.append(
            {
                "size": size,
                "dofs": n_dofs(u.function_space),
                "increment": step.increment,
                "loaded rollers": int(np.sum(np.array(loads) > 1e-6 * max(loads))),
                "iterations": step.iterations,
                "method": step.method,
                "seconds": seconds,
                "linear solves": seconds / unit,
            }
        )
        start = costs.now()
    return rows


def main() -> None:
    """Run the benchmark and write its results."""
    parser = timing.parser(__doc__, "bearing")
    parser.add_argument("--size", type=float, nargs="*", default=[0.02, 0.01], help="triangles")
    arguments = parser.parse_args()
    logging.getLogger("fenics_contact").setLevel(logging.ERROR)
    warnings.simplefilter("ignore")
    small = bearing.Bearing(0.1, (0,))
    for _ in fc.increments(small.problem, small.load, steps=1):
        pass  # compiles the forms
    sizes = [0.04] if arguments.short else arguments.size
    rows = [row for size in sizes for row in solve(size, arguments.repeat)]
    timing.write(arguments.output, "bearing", "Roller bearing, linear triangles, μ = 0.1", rows)


if __name__ == "__main__":
    np.seterr(all="ignore")
    main()
