"""Half-cylinder pressed on a rigid plane: Hertz contact, without and with friction.

The first example of Fancello, Feijóo and Zouain (section 6.1): a long half-cylinder, plane
strain, E = 1000, R = 8, ν = 0.3, loaded by a uniform pressure q = 30 on its flat top; friction
coefficient 0 and 0.2. By symmetry a quarter of the disc is modelled, with u_x = 0 on the axis; only
contact constrains it vertically. Any consistent units: here mm, N, MPa, forces per mm of thickness.

    python demos/hertz.py                                  # the paper's mesh, both frictions
    python demos/hertz.py --h 0.05 --degree 2 --friction 0.2 --increments 80
    python demos/hertz.py --load 1 --h 0.02 --friction 0   # narrow contact: Hertz's theory
    python demos/hertz.py --errors                         # error estimates, and what to change
    python demos/hertz.py --convergence                    # error against h
    python demos/hertz.py --solver auto                    # solver chosen by the package
    mpirun -n 2 python demos/hertz.py

Hertz's theory assumes a half-plane and a contact that is small relative to R. Here a/R = 0.26, and
the theory's pressure has an error of 1.6 %; the references are an independent solution of this body
with exact complementarity, on converged meshes. With friction the result depends on the load
history: one increment gives 14 % more shear than eighty.

The default solver is the paper's method, SNES in quasi-Newton mode (L-BFGS); ``--solver`` selects
another one. The exit code is 1 if a result differs from its reference by more than its tolerance.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dolfinx
import gmsh
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from fenics_contact import output, plotting

E, NU, R = 1000.0, 0.3, 8.0
PAPER_LOAD, PAPER_H = 30.0, 0.42  # 0.42: ten contact elements on the quarter, as in the paper
E_STAR = E / (1 - NU**2)
AXIS, TOP, ARC, CONTACT = 1, 2, 3, 4
CONTACT_ANGLE = np.pi / 6  # angle of the arc that is Γc

# Independent solution with exact complementarity, for the whole half-disc on converged meshes.
EXACT: dict[float, dict[str, Any]] = {
    0.0: {
        "peak_pressure": 142.6,
        "half_width": 2.127,
        "tangential_resultant": 0.0,
        "max_tangential_traction": 0.0,
        "top_centre_displacement": [0.0, -0.5181],
        "top_corner_displacement": [0.3332, -0.9947],
    },
    0.2: {
        "peak_pressure": 150.8,
        "half_width": 2.0855,
        "tangential_resultant": 34.17,
        "stick_half_width": 0.737 * 2.0855,
        "max_tangential_traction": 21.54,
        "top_centre_displacement": [0.0, -0.5204],
        "top_corner_displacement": [0.3283, -0.9828],
    },
}


def hertz(load: float) -> tuple[float, float]:
    """Return Hertz's half-width and peak pressure for the pressure ``load`` on the top."""
    force = 2 * R * load
    a = np.sqrt(4 * force * R / (np.pi * E_STAR))
    return a, 2 * force / (np.pi * a)


def make_mesh(
    h: float, fine: float, grading: float = 0.3, coarsest: float = R / 4
) -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags]:
    """Return a quarter disc touching y = 0 at the origin, with cells of size ``h`` up to ``fine``.

    Beyond x = ``fine`` they grow by ``grading`` times the distance, up to the size ``coarsest``.
    Cells are curved (second order), so that the gap is that of the circle. Collective.
    """
    comm = MPI.COMM_WORLD
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.add("quarter disc")
        if comm.rank == 0:
            occ = gmsh.model.occ
            bottom, corner = occ.addPoint(0, 0, 0), occ.addPoint(R, R, 0)
            centre = occ.addPoint(0, R, 0)
            edge = occ.addPoint(R * np.sin(CONTACT_ANGLE), R * (1 - np.cos(CONTACT_ANGLE)), 0)
            contact = occ.addCircleArc(bottom, centre, edge)
            arc = occ.addCircleArc(edge, centre, corner)
            top, axis = occ.addLine(corner, centre), occ.addLine(centre, bottom)
            disc = occ.addPlaneSurface([occ.addCurveLoop([contact, arc, top, axis])])
            occ.synchronize()
            gmsh.model.addPhysicalGroup(2, [disc], 1)
            for tag, line in ((AXIS, axis), (TOP, top), (ARC, arc), (CONTACT, contact)):
                gmsh.model.addPhysicalGroup(1, [line], tag)

            def size(dim: int, tag: int, x: float, y: float, z: float, lc: float) -> float:
                away = np.hypot(max(0.0, x - fine), max(0.0, y - fine / 2))
                return min(h + grading * away, max(h, coarsest))

            gmsh.model.mesh.setSizeCallback(size)
            gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 0)
            gmsh.model.mesh.generate(2)
            gmsh.model.mesh.setOrder(2)
        mesh, _, tags = fc.model_to_mesh(gmsh.model, comm, gdim=2)
        return mesh, tags
    finally:
        gmsh.finalize()


@dataclass
class Scene:
    """The unloaded half-cylinder with its contact problem."""

    problem: fc.ContactProblem
    contact: fc.Contact
    u: fem.Function
    stress: Any
    pressure: fem.Constant


def build(
    arguments: argparse.Namespace, friction: float, h: float, load: float, **options: Any
) -> Scene:
    """Create mesh, elasticity and contact, the mesh for the pressure ``load``. Collective.

    ``options`` are options of PETSc.
    """
    a, _ = hertz(load)
    mesh, tags = make_mesh(h, 1.3 * a)

    # The elasticity problem in plain DOLFINx.
    V = fem.functionspace(mesh, ("Lagrange", arguments.degree, (2,)))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    shear = fem.Constant(mesh, PETSc.ScalarType(E / (2 * (1 + NU))))
    lame = fem.Constant(mesh, PETSc.ScalarType(E * NU / ((1 + NU) * (1 - 2 * NU))))
    pressure = fem.Constant(mesh, PETSc.ScalarType(0.0))

    def epsilon(w: Any) -> Any:
        return ufl.sym(ufl.grad(w))

    stress = 2 * shear * epsilon(u) + lame * ufl.tr(epsilon(u)) * ufl.Identity(2)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags)
    F = ufl.inner(stress, epsilon(v)) * ufl.dx + pressure * v[1] * ds(TOP)
    on_axis = fem.locate_dofs_topological(V.sub(0), 1, tags.find(AXIS))
    bcs = [fem.dirichletbc(PETSc.ScalarType(0.0), on_axis, V.sub(0))]

    # Contact: law, contact surface and obstacle.
    stiffness = {n: k for n, k in (("k_n", arguments.k_n), ("k_t", arguments.k_t)) if k}
    law: fc.Coulomb | fc.Frictionless
    if friction > 0:
        law = fc.Coulomb(friction, **stiffness)
    else:
        law = fc.Frictionless(**{n: k for n, k in stiffness.items() if n == "k_n"})
    surface = fc.ContactSurface(mesh, tags, CONTACT)
    plane = fc.HalfSpace(point=(0, 0), normal=(0, 1))
    contact = fc.Contact(u, surface, plane, law, accuracy=arguments.accuracy)
    method = None if arguments.solver == "auto" else arguments.solver
    problem = fc.ContactProblem(
        F, u, bcs=bcs, contacts=[contact], method=method, petsc_options=options
    )
    return Scene(problem, contact, u, stress, pressure)


def solve(arguments: argparse.Namespace, friction: float) -> tuple[Scene, dict[str, Any]]:
    """Solve one case, and return its problem and results. Collective."""
    start = time.perf_counter()
    load = arguments.load
    scene = build(arguments, friction, arguments.h, load)
    # Without friction the state does not depend on the load path: one increment.
    steps = arguments.increments or (80 if friction > 0 else 1)
    if arguments.accuracy is not None and not arguments.increments:
        steps = scene.problem.default_increments
    words = f"μ = {friction:g}"
    history = fc.increments(
        scene.problem,
        scene.pressure,
        0.0,
        load,
        steps=steps,
        estimate=arguments.errors,
        progress=words,
    )
    begin = time.perf_counter()
    made = list(history)
    solved = time.perf_counter() - begin
    space = scene.u.function_space
    result = measure(scene.contact, scene.u) | {
        "friction": friction,
        "load": load,
        "h": arguments.h,
        "degree": arguments.degree,
        "increments": steps,
        "solver": arguments.solver,
        "methods": sorted({step.method for step in made}),
        "dofs": space.dofmap.index_map.size_global * 2,
        "cells": space.mesh.topology.index_map(2).size_global,
        "iterations": [step.iterations for step in made],
        "converged_reasons": [step.reason for step in made],
        "solve_seconds": solved,
        "wall_seconds": time.perf_counter() - start,
    }
    if arguments.errors:
        budget = fc.estimate_errors(
            scene.problem, scene.stress, increment_error=made[-1].increment_error
        )
        result["errors"] = budget.numbers()
    return scene, result


def measure(contact: fc.Contact, u: fem.Function) -> dict[str, Any]:
    """Return the results to compare with references. Collective."""
    points, resultants = contact.gather(), contact.resultants()
    x, status = points["x"][:, 0], points["status"]
    shear = np.abs(points["tangential_traction"][:, 0])
    half_width = crossing(x, points["gap"])
    # The stick zone ends where |τ| reaches the friction bound; their ratio is 1 at slipping points,
    # so that the end lies between the last sticking and the first slipping point.
    sticking = np.flatnonzero(status == fc.Status.STICK)
    last = int(sticking[-1]) if sticking.size else -1
    stick = 0.5 * (x[last] + x[last + 1]) if 0 <= last < len(x) - 1 else 0.0
    return {
        "peak_pressure": resultants.max_pressure,
        "half_width": half_width,
        "normal_resultant": resultants.normal_force,
        "tangential_resultant": resultants.tangential_force,
        "stick_half_width": stick,
        "max_tangential_traction": float(shear.max()),
        "top_centre_displacement": output.at_node(u, (0.0, R)).tolist(),
        "top_corner_displacement": output.at_node(u, (R, R)).tolist(),
    }


def crossing(x: np.ndarray, gap: np.ndarray) -> float:
    """Return x at zero gap, interpolated between the last closed and the first open point."""
    closed = np.flatnonzero(gap < 0)
    if closed.size == 0:
        return 0.0
    i = int(closed[-1])
    if i == len(x) - 1:
        raise SystemExit("all of the contact surface is closed: lower --load")
    return float(x[i] + (x[i + 1] - x[i]) * gap[i] / (gap[i] - gap[i + 1]))


def compare(result: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Compare the results with references, with tolerances that depend on the mesh.

    Tolerances are 0.4 % (with friction 1 %, because of the load increments), plus 0.5 h/(degree a)
    for tractions and forces, 0.15 h/(degree a) for displacements, and for positions the spacing of
    the points on Γc, or one cell of a linear mesh. The tolerance of the largest shear is 1 % more,
    since the load increments cause ripples in its profile, also in the reference.
    """
    friction, load = result["friction"], result["load"]
    a, p0 = hertz(load)
    if load == PAPER_LOAD and friction in EXACT and (friction == 0 or result["increments"] >= 80):
        source, references = "independent solution, exact complementarity", EXACT[friction]
    elif a / R <= 0.05 and friction == 0:
        source, references = "Hertz", {"peak_pressure": p0, "half_width": a}
    else:
        return {}
    base = 0.004 if friction == 0 else 0.01
    coarseness = result["h"] / (result["degree"] * a)
    cell = result["h"] if result["degree"] == 1 else result["h"] / (result["degree"] + 1)
    table = {}
    for name, value in references.items():
        error = float(np.max(np.abs(np.subtract(result[name], value))))
        size = float(np.max(np.abs(value)))
        if name in ("half_width", "stick_half_width"):
            tolerance = base * size + cell
        elif name.endswith("displacement"):
            tolerance = (base + 0.15 * coarseness) * size
        else:
            ripple = 0.01 if name == "max_tangential_traction" else 0.0
            tolerance = (base + ripple + 0.5 * coarseness) * size
        table[name] = {
            "value": value,
            "source": source,
            "error": error,
            "tolerance": tolerance,
            "passed": bool(error <= tolerance),
        }
    return table


def report(result: dict[str, Any]) -> None:
    """Print the results and their references."""
    a, p0 = hertz(result["load"])
    its = result["iterations"]
    increments = f"{len(its)} increment{'s' * (len(its) > 1)}"
    print(
        f"\nμ = {result['friction']:g}: {result['cells']} cells, {result['dofs']} dofs, "
        f"{increments}, {sum(its)} iterations (at most {max(its)} in one), "
        f"{result['wall_seconds']:.2f} s"
    )
    print(
        f"  Solver {result['solver']}: by {' and '.join(result['methods'])}, "
        f"{result['solve_seconds']:.2f} s for the increments alone"
    )
    print(f"  Hertz (half-plane): a = {a:.4f}, p0 = {p0:.2f}; here a/R = {a / R:.3f}")
    print(f"  {'in N, mm, MPa':26}{'result':>20}{'reference':>20}{'difference':>12}{'allowed':>10}")
    names = (
        "peak_pressure half_width tangential_resultant stick_half_width "
        "max_tangential_traction top_centre_displacement top_corner_displacement"
    ).split()
    for name in names:
        line = f"  {name:26}{show(result[name]):>20}"
        if name in result["references"]:
            entry = result["references"][name]
            line += f"{show(entry['value']):>20}{entry['error']:12.2g}{entry['tolerance']:10.2g}"
            line += "" if entry["passed"] else "  MISSED"
        print(line)
    if "errors" in result:
        print(f"\n{fc.ErrorBudget(**result['errors'])}")


def show(value: Any) -> str:
    """Format a number or a pair of numbers."""
    return " ".join(f"{v:.5g}" for v in np.atleast_1d(value))


def write(folder: Path, scene: Scene, result: dict[str, Any]) -> None:
    """Write figures and ParaView files of one case. Collective."""
    friction, load = result["friction"], result["load"]
    fc.Writer(folder, scene.problem, stress=scene.stress).write(load)
    title = f"Half-cylinder on a rigid plane, μ = {friction:g}, q = {load:g} MPa"
    plotting.plot_deformation(
        folder / "mesh.png", scene.u, title=title, contacts=scene.problem.contacts
    )
    points = scene.contact.gather()
    if scene.u.function_space.mesh.comm.rank:
        return
    a, p0 = hertz(load)
    xs = np.linspace(0, a, 200)
    ellipse = p0 * np.sqrt(1 - (xs / a) ** 2)
    curves = {"Hertz pressure": (xs, ellipse)}
    lines: dict[str, float] = {}
    marks: dict[str, float] = {}
    if friction > 0:
        curves[f"{friction:g} × Hertz pressure"] = (xs, friction * ellipse)
    if result["references"] and load == PAPER_LOAD:
        lines["reference peak pressure"] = EXACT[friction]["peak_pressure"]
        marks["reference half-width"] = EXACT[friction]["half_width"]
        if friction > 0:
            lines["reference max |τ|"] = EXACT[friction]["max_tangential_traction"]
            marks["reference stick zone"] = EXACT[friction]["stick_half_width"]
    plotting.plot_tractions(
        folder / "traction.png", points, curves=curves, lines=lines, marks=marks, title=title
    )


def convergence(arguments: argparse.Namespace) -> dict[str, Any]:
    """Compute pressure errors relative to Hertz for a narrow contact (a/R = 0.02), and their rate.

    The error arises mostly at the end of the contact, and depends on its position in a facet: on
    each mesh it is the root mean square over eight loads that move the end through one facet.
    Collective.
    """
    largest = 0.02 * R
    rows: list[dict[str, float]] = []
    for cells in (4, 8, 16, 32, 64):
        scene = build(arguments, 0.0, largest / cells, np.pi * E_STAR * largest**2 / (8 * R**2))
        errors = []
        for part in range(8):
            a = largest * (1 - part / (8 * cells))
            load = np.pi * E_STAR * a**2 / (8 * R**2)
            for _ in fc.increments(scene.problem, scene.pressure, 0.0, load):
                pass
            _, p0 = hertz(load)
            points = scene.contact.gather()
            exact = p0 * np.sqrt(np.maximum(0.0, 1 - (points["x"][:, 0] / a) ** 2))
            w = points["measure"]
            errors.append(
                (
                    np.sqrt(w @ (points["pressure"] - exact) ** 2 / (w @ exact**2)),
                    points["pressure"].max() / p0 - 1,
                    crossing(points["x"][:, 0], points["gap"]) / a - 1,
                )
            )
        pressure, peak, width = np.sqrt(np.mean(np.square(errors), axis=0))
        rows.append(
            {
                "cells_per_a": cells,
                "dofs": scene.u.function_space.dofmap.index_map.size_global * 2,
                "pressure_error": float(pressure),
                "peak_error": float(peak),
                "half_width_error": float(width),
            }
        )
    errors = np.log2([row["pressure_error"] for row in rows])
    rates = errors[:-1] - errors[1:]
    slope = float(-np.polyfit(np.log2([row["cells_per_a"] for row in rows]), errors, 1)[0])
    if MPI.COMM_WORLD.rank == 0:
        print(f"Degree {arguments.degree}, a/R = 0.02: relative errors against Hertz")
        print(
            f"{'cells per a':>12}{'dofs':>9}{'pressure (L2)':>16}{'rate':>7}{'peak':>10}{'a':>10}"
        )
        for row, rate in zip(rows, ["", *(f"{r:.2f}" for r in rates)], strict=True):
            print(
                f"{row['cells_per_a']:12d}{row['dofs']:9d}{row['pressure_error']:16.2e}{rate:>7}"
                f"{row['peak_error']:10.1e}{row['half_width_error']:10.1e}"
            )
        print(f"fitted rate {slope:.2f}")
    return {"rows": rows, "rate": slope, "degree": arguments.degree}


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--h", type=float, default=PAPER_H, help="cell size at the contact, mm")
    parser.add_argument("--degree", type=int, default=1, help="degree of the displacement")
    parser.add_argument(
        "--friction", type=float, nargs="+", default=[0.0, 0.2], help="friction coefficients"
    )
    parser.add_argument(
        "--increments", type=int, help="load increments; 1 without friction, 80 with it"
    )
    parser.add_argument("--load", type=float, default=PAPER_LOAD, help="pressure on the top, MPa")
    parser.add_argument(
        "--accuracy", help="draft, standard, fine or a relative error: sets all but the mesh"
    )
    parser.add_argument("--k-n", type=float, help="normal stiffness, MPa/mm; default 10 E/h")
    parser.add_argument("--k-t", type=float, help="tangential stiffness, MPa/mm; default 10 E/h")
    parser.add_argument(
        "--solver",
        choices=("lbfgs", "auto", "newton", "continuation", "alternating"),
        default="lbfgs",
        help="lbfgs: the paper's, SNES in quasi-Newton mode; auto: the package's own choice",
    )
    parser.add_argument("--errors", action="store_true", help="estimate the errors, part by part")
    parser.add_argument("--convergence", action="store_true", help="errors over h, and their rate")
    parser.add_argument("--output", type=Path, default=Path("output/hertz"), help="folder to write")
    # The command line may also have options of PETSc, such as -contact_snes_monitor.
    arguments, _ = parser.parse_known_args()
    if arguments.accuracy is not None and arguments.accuracy[0].isdigit():
        arguments.accuracy = float(arguments.accuracy)
    if not (arguments.h > 0 and arguments.degree >= 1 and arguments.load > 0):
        parser.error("--h and --load must be positive, --degree at least 1")
    return arguments


def main() -> int:
    """Run the requested study; return 0 if every reference is met."""
    arguments = parse()
    comm = MPI.COMM_WORLD
    if comm.rank == 0:
        arguments.output.mkdir(parents=True, exist_ok=True)
    comm.barrier()
    if arguments.convergence:
        study = convergence(arguments)
        output.write_json(arguments.output / "convergence.json", study, comm)
        # The pressure ends like a square root: on uniform meshes the L2 rate is at most 1 for every
        # degree.
        return 0 if study["rate"] > 0.7 else 1
    runs = []
    for friction in arguments.friction:
        scene, result = solve(arguments, friction)
        result["references"] = compare(result)
        several = len(arguments.friction) > 1
        folder = arguments.output / f"friction-{friction:g}" if several else arguments.output
        if comm.rank == 0:
            folder.mkdir(parents=True, exist_ok=True)
            report(result)
        comm.barrier()
        write(folder, scene, result)
        runs.append(result)
    # The last case is at the top level; `runs` has all cases.
    output.write_json(arguments.output / "result.json", {**runs[-1], "runs": runs}, comm)
    if comm.rank == 0:
        print(f"\nWritten to {arguments.output}/")
    passed = all(entry["passed"] for run in runs for entry in run["references"].values())
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
