"""Compare iterations, factorisations and time of five methods on five frictional problems.

    python benchmarks/methods.py

The problems are the half-cylinder of the demo (μ = 0.2, ten increments), a cylinder dragged over a
block (μ = 0.3, ten increments) and, in 3D, a ball pressed into a block and dragged (μ = 0.3, five
increments), each at moderate and at high contact stiffness; and, with finite kinematics, a linear
elastic block dragged over a slab (μ = 0.3, twenty increments) in 2D and in 3D, at two moderate
stiffnesses, by the methods that support finite kinematics. There is no fallback: for a method that
fails, the table states the increment. It is printed in Markdown and written as CSV. Times are those
of the solution, medians of ``--repeat`` runs (of one run above five seconds), without compilation.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from functools import partial

import dolfinx
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from benchmarks import timing
from demos import ironing
from scenes import bodies, problems
from scenes.elasticity import dirichlet_bc, displacement_space
from scenes.tags import at_coordinate, at_interface, plane, tag_by_nodes

METHODS = ("lbfgs", "newton", "continuation", "alternating", "primal_dual")
STIFFNESSES = (10.0, 1000.0)
FINITE_METHODS, FINITE_STIFFNESSES = ("lbfgs", "newton", "continuation"), (1.0, 10.0)
# Runs that take longer are not repeated (s).
MAX_REPEATED_TIME = 5.0
Loading = tuple[fc.ContactProblem, Callable[[float], None], int]


def half_cylinder(method: str, stiffness: float) -> Loading:
    """Create the half-cylinder, the paper's first example, with quadratic triangles."""
    body = problems.half_cylinder(0.2, 0.1)
    problem, _, _, pressure = problems.problem(body, 2, stiffness, method=method, fallback=False)

    def load(t: float) -> None:
        pressure.value = body.final_load * t

    return problem, load, 10


def dragged_cylinder(method: str, stiffness: float) -> Loading:
    """Create the problem of demos/ironing.py with the indentation prescribed, not the force."""
    mesh, tags = ironing.make_mesh(6)
    u = fem.Function(displacement_space(mesh, 2))
    body = fc.elasticity.LinearElastic(u, ironing.E, ironing.NU, "plane strain")
    move = fem.Constant(mesh, np.zeros(2))
    cylinder = fc.Cylinder((-1.0, ironing.R), ironing.R, displacement=move)
    k = fc.RelativeStiffness(stiffness)
    law = fc.Coulomb(ironing.MU, k, k)
    problem = dragged(body, tags, (ironing.BOTTOM, ironing.TOP), cylinder, law, method)

    def load(t: float) -> None:
        move.value[:] = 2.0 * max(t - 0.2, 0.0), -0.0143 * min(5 * t, 1.0)

    return problem, load, 10


def dragged_ball(method: str, stiffness: float) -> Loading:
    """Create a ball on a block of hexahedra with linear displacements."""
    mesh = dolfinx.mesh.create_box(
        MPI.COMM_WORLD, [[-1, -1, -1], [1, 1, 0]], (16, 16, 8), dolfinx.mesh.CellType.hexahedron
    )
    u = fem.Function(displacement_space(mesh, 1))
    body = fc.elasticity.LinearElastic(u, 1000.0, 0.3, "3D")
    move = fem.Constant(mesh, np.zeros(3))
    ball = fc.Ball((0, 0, 2.0), 2.0, displacement=move)
    k = fc.RelativeStiffness(stiffness)
    tags = tag_by_nodes(mesh, {1: plane(2, -1), 2: plane(2, 0)})
    problem = dragged(body, tags, (1, 2), ball, fc.Coulomb(0.3, k, k), method)

    def load(t: float) -> None:
        move.value[:] = 0.2 * max(t - 0.2, 0.0), 0.0, -0.05 * min(5 * t, 1.0)

    return problem, load, 5


def dragged(
    body: fc.elasticity.LinearElastic,
    tags: dolfinx.mesh.MeshTags,
    ends: tuple[int, int],
    obstacle: fc.Obstacle,
    law: fc.Coulomb,
    method: str,
) -> fc.ContactProblem:
    """Create the problem of a body clamped at one end and touched by an obstacle at the other."""
    u, (held, touched) = body.u, ends
    bcs = [dirichlet_bc(u, tags, held, i) for i in range(len(u))]
    contact = fc.Contact(u, fc.ContactSurface(u.function_space.mesh, tags, touched), obstacle, law)
    F = body.residual(ufl.TestFunction(u.function_space))
    return fc.ContactProblem(F, u, bcs=bcs, contacts=[contact], method=method, fallback=False)


def dragged_block(
    method: str | None, stiffness: float, *, d: int = 2, fallback: bool = False
) -> Loading:
    """Create a block 0.5 wide, pressed into a slab 1 wide and dragged by 0.25, within its ends."""
    n, m = ((24, 13), (12, 7))[d - 2]  # nodes of block and slab do not coincide
    across = [np.linspace(0, 1, n + 1)] * (d - 1), [np.linspace(0.1, 0.6, m + 1)] * (d - 1)
    upright = np.linspace(0, 0.5, n // 2 + 1), np.linspace(0.5, 1, m + 1)
    floor, lower, upper, top = 1, 2, 3, 4
    faces = {
        floor: at_coordinate(d - 1, 0.0),
        lower: at_interface(d - 1, 0.5, above=False),
        upper: at_interface(d - 1, 0.5, above=True),
        top: at_coordinate(d - 1, 1.0),
    }
    axes = [[*sideways, up] for sideways, up in zip(across, upright, strict=True)]
    made = bodies.Bodies(bodies.boxes(axes, faces), 1000.0, 0.3, degree=4 - d)
    side, down = made.constant(), made.constant()
    made.prescribe(floor, *range(d))
    made.prescribe(top, 0, value=side)
    made.prescribe(top, *range(1, d - 1))
    made.prescribe(top, d - 1, value=down)
    k = fc.RelativeStiffness(stiffness)
    contact = made.contact(upper, lower, fc.Coulomb(0.3, k, k), kinematics="finite")
    problem = made.problem(contact, method=method, fallback=fallback)

    def load(t: float) -> None:
        side.value, down.value = 0.25 * max(t - 0.25, 0.0) / 0.75, -0.03 * min(4 * t, 1.0)

    return problem, load, 20


SCENES = {
    "half-cylinder": (half_cylinder, METHODS, STIFFNESSES),
    "dragged cylinder": (dragged_cylinder, METHODS, STIFFNESSES),
    "dragged ball": (dragged_ball, METHODS, STIFFNESSES),
    "dragged block": (dragged_block, FINITE_METHODS, FINITE_STIFFNESSES),
    "dragged block, space": (partial(dragged_block, d=3), FINITE_METHODS, FINITE_STIFFNESSES),
}


def measure(repeats: int) -> Iterator[dict[str, object]]:
    """Solve all problems, and yield one row for each method and stiffness."""
    for scene, (make, methods, stiffnesses) in SCENES.items():
        for stiffness in stiffnesses:
            for method in methods:
                times, outcome, iterations, factorisations = [], "converged", 0, 0
                for _ in range(repeats):
                    if max(times, default=0.0) > MAX_REPEATED_TIME:
                        break
                    problem, load, steps = make(method, stiffness)
                    iterations = factorisations = 0
                    start = time.perf_counter()
                    try:
                        for step in fc.increments(problem, load, steps=steps, max_cuts=0):
                            iterations += step.iterations
                            factorisations += step.factorisations
                    except fc.NotConverged as error:
                        iterations += error.iterations
                        outcome = f"failed at increment {error.increment}"
                    times.append(time.perf_counter() - start)
                yield {
                    "scene": scene,
                    "k_n h/E": stiffness,
                    "method": method,
                    "outcome": outcome,
                    "iterations": iterations,
                    "factorisations": factorisations,
                    "seconds": round(statistics.median(times), 3),
                }


def main() -> None:
    """Run the benchmark and write its results."""
    parser = timing.parser(__doc__, "methods")
    arguments = parser.parse_args()
    rows = []
    for row in measure(1 if arguments.short else arguments.repeat):
        rows.append(row)
        print(*row.values(), sep="  ", flush=True)
    title = "Four methods on five scenes with friction"
    timing.write(arguments.output, "methods", title, rows)


if __name__ == "__main__":
    main()
