"""Compare error and time of penalty, augmented Lagrangian and Nitsche's method.

The problems are the half-cylinder of ``demos/hertz.py`` without friction and with μ = 0.2 in one
increment, and the GRECO block, both with quadratic cells. Errors are relative to this package's
augmented Lagrangian solution on cells of half the size; the pressure error is the L² norm on Γc.
Nitsche's method is a hand-written UFL form with Newton's method in DOLFINx, each step factored by
MUMPS: it needs the stresses of the cells at Γc, which a condensed problem does not have. Meshing
and compilation are not included.

    OMP_NUM_THREADS=1 python benchmarks/enforcement.py
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import dolfinx.fem.petsc  # noqa: F401
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from benchmarks import timing
from fenics_contact.surface.surface import PointEvaluator
from fenics_contact.types import Array
from scenes import problems
from scenes.problems import ContactScene

PENALTIES = (1.0, 10.0, 100.0, 1e3, 1e4, 1e6)
NITSCHE = {
    "Nitsche 10 symmetric": (10.0, 1.0),
    "Nitsche 10 incomplete": (10.0, 0.0),
    "Nitsche 100 incomplete": (100.0, 0.0),
}
REFERENCE_RUN = "penalty 10"
# Runs that take longer are not repeated (s).
MAX_REPEATED_TIME = 5.0


@dataclass
class SurfaceSolution:
    """A solution on Γc: coordinates, pressure, penetration, friction force, quadrature weights."""

    displacement: float
    x: Array
    pressure: Array
    penetration: float
    friction_force: float
    measure: Array
    iterations: int

    def row(self, reference: SurfaceSolution) -> timing.Row:
        """Return the row of the table."""
        order = np.argsort(reference.x)
        exact = np.interp(self.x, reference.x[order], reference.pressure[order])
        norm = np.sqrt(self.measure @ exact**2)
        peak = reference.pressure.max()
        row: timing.Row = {
            "displacement error": abs(self.displacement / reference.displacement - 1),
            "peak pressure error": abs(self.pressure.max() / peak - 1),
            "pressure error": float(np.sqrt(self.measure @ (self.pressure - exact) ** 2) / norm),
        }
        if reference.friction_force:
            row["friction force error"] = abs(self.friction_force / reference.friction_force - 1)
        return row | {"penetration": self.penetration, "iterations": self.iterations}


def solve_package(
    body: ContactScene, stiffness: float, enforcement: str, tolerance: float = 1e-5
) -> SurfaceSolution:
    """Solve by the penalty or the augmented Lagrangian method of the package."""
    choices = {"enforcement": enforcement, "tolerance": tolerance}
    problem, contact, u, load = problems.problem(body, 2, stiffness, contact_options=choices)
    load.value = body.final_load
    step = problem.solve()
    shear = contact.tangential_traction[:, 0]
    return SurfaceSolution(
        displacement=body.displacement(u),
        x=contact.points[:, 0],
        pressure=contact.pressure,
        penetration=step.contacts["contact"].max_penetration,
        friction_force=float(contact.measure @ shear),
        measure=contact.measure,
        iterations=step.iterations,
    )


class NewtonFailed(RuntimeError):
    """The hand-written Newton method did not converge."""


def solve_nitsche(body: ContactScene, factor: float, theta: float) -> SurfaceSolution:
    """Solve by Nitsche's method for frictional contact (Chouly, Hild), γ = ``factor`` E/h.

    ∫ σ(u):ε(v) - θ ∫ σ(u)n·σ(v)n/γ + ∫ P(σ(u)n - γ jump)·(θ σ(v)n/γ - v) over Γc, where
    P projects onto pressures and tractions within the friction cone; θ = ``theta``, and θ = 1 is
    symmetric without friction.
    """
    u, F, load, bcs = problems.elasticity_problem(body, 2)
    load.value = body.final_load
    V = u.function_space
    v = ufl.TestFunction(V)
    gamma = factor * body.E / body.h
    elastic = body.elastic(u)
    weight = fem.Constant(body.mesh, theta)
    surface = fc.ContactSurface(body.mesh, body.tags, body.surface)
    quadrature = surface.quadrature(2)
    n = ufl.as_vector([0.0, -1.0])
    down = -(ufl.SpatialCoordinate(body.mesh)[1] + u[1])  # u_n - s

    def on_surface(w: Any) -> tuple[Any, Any]:
        stress = elastic.stress_of(w)
        normal = ufl.FacetNormal(body.mesh)
        traction = [sum(stress[i, j] * normal[j] for j in range(2)) for i in range(2)]
        return -traction[1], traction[0]

    (s_n, s_t), (sv_n, sv_t) = on_surface(u), on_surface(v)
    r_n = ufl.min_value(s_n - gamma * down, 0.0)
    tau = ufl.as_ufl(0.0)
    if body.friction:
        limit = -body.friction * r_n
        tau = ufl.max_value(-limit, ufl.min_value(s_t - gamma * u[0], limit))
    F += weight / gamma * ((r_n - s_n) * sv_n + (tau - s_t) * sv_t) * quadrature.ds
    F -= (r_n * ufl.dot(v, n) + tau * v[0]) * quadrature.ds
    residual = fem.form(F)
    tangent = fem.form(ufl.derivative(F, u, ufl.TrialFunction(V)))
    matrix = fem.petsc.create_matrix(tangent)
    ksp = PETSc.KSP().create(body.mesh.comm)
    ksp.setOperators(matrix)
    ksp.setType("preonly")
    symmetric = theta == 1.0 and not body.friction
    ksp.getPC().setType("cholesky" if symmetric else "lu")
    if symmetric:
        matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    ksp.getPC().setFactorSolverType("mumps")
    u.x.array.reshape(-1, 2)[:] = body.initial_displacement
    fem.set_bc(u.x.array, bcs)
    step = u.x.petsc_vec.duplicate()
    size, iterations = 0.0, 0
    while True:
        b = fem.petsc.assemble_vector(residual)
        fem.petsc.set_bc(b, bcs, u.x.petsc_vec, alpha=-1.0)
        size = max(size, b.norm())
        if b.norm() <= 1e-9 * size:
            break
        if iterations == 60 or not np.isfinite(b.norm()):
            raise NewtonFailed
        matrix.zeroEntries()
        fem.petsc.assemble_matrix(matrix, tangent, bcs=bcs)
        matrix.assemble()
        ksp.solve(b, step)
        u.x.petsc_vec.axpy(-1.0, step)
        iterations += 1
    fields = {"x": ufl.SpatialCoordinate(body.mesh), "p": -r_n, "tau": tau, "down": down}
    points = PointEvaluator(quadrature, fields)()
    return SurfaceSolution(
        displacement=body.displacement(u),
        x=points["x"][:, 0],
        pressure=points["p"],
        penetration=float(max(points["down"].max(), 0.0)),
        friction_force=float(quadrature.weights @ points["tau"]),
        measure=quadrature.weights,
        iterations=iterations,
    )


def methods(make: Callable[[], ContactScene]) -> dict[str, Callable[[], SurfaceSolution]]:
    """Return the methods to compare, by name."""
    found: dict[str, Callable[[], SurfaceSolution]] = {
        f"penalty {k:g}": lambda k=k: solve_package(make(), k, "penalty") for k in PENALTIES
    }
    found["augmented 10"] = lambda: solve_package(make(), 10.0, "augmented")
    found |= {name: lambda p=p: solve_nitsche(make(), *p) for name, p in NITSCHE.items()}
    return found


def compare(
    name: str,
    make: Callable[[Any], ContactScene],
    size: float,
    finer: float,
    folder: Path,
    repeat: int,
) -> None:
    """Solve one problem by all methods, and write its table."""
    reference = solve_package(make(finer), 10.0, "augmented", tolerance=1e-8)
    coarse: Any = {"GRECO": 8}.get(name.split()[0], 0.5)

    def timed(run: Callable[[], SurfaceSolution]) -> timing.Row:
        try:
            return run().row(reference)
        except (fc.NotConverged, NewtonFailed):
            return {"iterations": "none"}

    runs, first = (
        {n: partial(timed, run) for n, run in methods(partial(make, s)).items()}
        for s in (size, coarse)
    )
    make(size)
    rows = timing.measure(runs, repeat=repeat, first=first, once=MAX_REPEATED_TIME)
    rows = timing.in_units_of(rows, REFERENCE_RUN, "time / penalty 10")
    dofs = problems.n_dofs(problems.elasticity_problem(make(size), 2)[0].function_space)
    note = f"Reference: displacement {reference.displacement:.9g}, peak pressure "
    note += f"{reference.pressure.max():.7g}, friction force {reference.friction_force:.7g}."
    stem = name.lower().replace(" ", "_").replace("=", "").replace("μ", "mu").replace(".", "")
    timing.write(folder, stem, f"{name}, {dofs} dofs", rows, note)


def main() -> None:
    """Run the benchmark and write its results."""
    parser = timing.parser(__doc__, "enforcement")
    parser.add_argument("--h", type=float, default=0.02, help="cell size of the half-cylinder")
    parser.add_argument("--cells", type=int, default=64, help="cells per side of the block")
    arguments = parser.parse_args()
    if MPI.COMM_WORLD.size > 1:
        parser.error("runs on one rank")
    h, cells = (0.1, 16) if arguments.short else (arguments.h, arguments.cells)
    for friction in (0.0, 0.2):
        name = f"Half-cylinder μ = {friction:g}"
        cylinder = partial(problems.half_cylinder, friction, smooth=True)
        compare(name, cylinder, h, h / 2, arguments.output, arguments.repeat)
    compare(
        "GRECO block", problems.greco_block, cells, 2 * cells, arguments.output, arguments.repeat
    )


if __name__ == "__main__":
    np.seterr(all="ignore")
    main()
