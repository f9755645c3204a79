"""Compare L-BFGS and Newton's method for nonlinear bulks: rubber, mixed rubber, J2 plasticity.

    python benchmarks/nonlinear.py

A block 2 x 1 of quadratic triangles, clamped at its bottom, is under a disc of radius 0.8 that is
pressed in and then dragged with friction (μ = 0.3), in ten increments. Materials are neo-Hookean
rubber (ν = 0.3, indentation 0.15); the same with ν = 0.4999 and the pressure as an unknown; and J2
plasticity at small strains with linear hardening E/100 (indentation 0.02, far beyond a yield stress
of E/500), whose plastic strains are updated after each increment. The contact stiffness is 10 and
1000 E/h. There is neither fallback nor cut increment, so that failures of a method are recorded.
Times are those of all increments, medians of ``--repeat`` runs, without compilation.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import basix
import basix.ufl
import numpy as np
import ufl
from dolfinx import fem

import fenics_contact as fc
from benchmarks import timing
from scenes.rubber import Rubber, disc, rubber

METHODS = ("newton", "lbfgs")
STIFFNESSES = (10.0, 1000.0)
STEPS, E = 10, 1000.0
# Runs that take longer are not repeated (s).
MAX_REPEATED_TIME = 10.0
Made = tuple[Rubber, float, Callable[[], None]]


def hyperelastic(n: int) -> Made:
    """Create a block of compressible rubber."""
    return rubber("triangle", n=(2 * n, n), E=E), 0.15, lambda: None


def mixed_rubber(n: int) -> Made:
    """Create a block of nearly incompressible rubber, with the pressure as an unknown."""
    scene = rubber("triangle", n=(2 * n, n), E=E, nu=0.4999, mixed="Taylor-Hood")
    return scene, 0.15, lambda: None


def plastic(n: int) -> Made:
    """Create a block with J2 plasticity in plane strain, radial return at points of degree 2."""
    scene = rubber("triangle", n=(2 * n, n), E=E, linear=True)
    u, space = scene.u, scene.u.function_space
    shear, bulk, hardening, strength = E / 2.6, E / 1.2, E / 100, E / 500
    at_points = basix.ufl.quadrature_element("triangle", value_shape=(3, 3), degree=2)
    number = basix.ufl.quadrature_element("triangle", degree=2)
    strains = fem.Function(fem.functionspace(scene.mesh, at_points), name="plastic strain")
    accumulated_strain = fem.Function(fem.functionspace(scene.mesh, number), name="accumulated")
    epsilon = ufl.sym(ufl.grad(u))
    rows = [[epsilon[0, 0], epsilon[0, 1], 0], [epsilon[0, 1], epsilon[1, 1], 0], [0, 0, 0]]
    strain = ufl.as_tensor(rows)
    trial = 2 * shear * ufl.dev(strain - strains)
    size = ufl.sqrt(1.5 * ufl.inner(trial, trial) + (1e-9 * strength) ** 2)
    excess = ufl.max_value(size - strength - hardening * accumulated_strain, 0) / (
        3 * shear + hardening
    )
    flow = 1.5 * excess * trial / size
    stress = trial - 2 * shear * flow + bulk * ufl.tr(strain) * ufl.Identity(3)
    virtual = ufl.derivative(strain, u, ufl.TestFunction(space))
    scene.F = ufl.inner(stress, virtual) * ufl.dx(scene.mesh, degree=2)
    points, _ = basix.make_quadrature(basix.CellType.triangle, 2)
    grown = {strains: fem.Expression(strains + flow, points)}
    grown[accumulated_strain] = fem.Expression(accumulated_strain + excess, points)

    def update_strains() -> None:
        values = []
        for function, expression in grown.items():
            found = fem.Function(function.function_space)
            found.interpolate(expression)
            values.append(found.x.array)
        for function, array in zip(grown, values, strict=True):
            function.x.array[:] = array

    return scene, 0.02, update_strains


SCENES = {"neo-Hookean": hyperelastic, "with pressure": mixed_rubber, "J2": plastic}


def run(make: Callable[[int], Made], stiffness: float, method: str, n: int) -> timing.Row:
    """Solve one load history, and return its row."""
    scene, depth, update_strains = make(n)
    shift = fem.Constant(scene.mesh, np.zeros(2))
    k = fc.RelativeStiffness(stiffness)
    kinematics = "small" if depth < 0.1 else "finite"
    problem, _ = scene.problem(
        disc(scene, 0.8, displacement=shift),
        fc.Coulomb(0.3, k, k),
        contact={"kinematics": kinematics},
        small_displacement_tolerance=np.inf,
        method=method,
        fallback=False,
    )

    def load(t: float) -> None:
        shift.value[:] = depth * max(2 * t - 1, 0.0), -depth * min(2 * t, 1.0)

    iterations, outcome = [], "converged"
    try:
        for step in fc.increments(problem, load, steps=STEPS, max_cuts=0):
            iterations.append(step.iterations)
            update_strains()
    except fc.NotConverged as error:
        iterations.append(error.iterations)
        outcome = f"failed at increment {error.increment}"
    return {"outcome": outcome, "iterations": sum(iterations), "most": max(iterations)}


def main() -> None:
    """Run the benchmark and write its results."""
    arguments = timing.parser(__doc__, "nonlinear").parse_args()
    n, stiffnesses = (6, STIFFNESSES[:1]) if arguments.short else (24, STIFFNESSES)
    rows = []
    for scene, make in SCENES.items():
        for stiffness in stiffnesses:
            runs = {m: functools.partial(run, make, stiffness, m, n) for m in METHODS}
            first = {m: functools.partial(run, make, stiffness, m, 4) for m in METHODS}
            repeat = 1 if arguments.short else arguments.repeat
            for row in timing.measure(runs, repeat=repeat, first=first, once=MAX_REPEATED_TIME):
                summary = {"scene": scene, "k_n h/E": stiffness, "method": row["run"]}
                summary |= {k: row[k] for k in ("outcome", "iterations", "most", "seconds")}
                rows.append(summary)
                print(*summary.values(), sep="  ", flush=True)
    timing.write(arguments.output, "nonlinear", "L-BFGS and Newton with nonlinear bulks", rows)


if __name__ == "__main__":
    main()
