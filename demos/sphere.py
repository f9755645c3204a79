"""Hertz contact in three dimensions: a ball on a block, and an elastic ball on a rigid plane.

Lengths in mm, stresses in MPa: steel, E = 210e3 and ν = 0.3, E* = E/(1-ν²), radius R = 1,
frictionless; quarters by symmetry, quadratic tetrahedra that grow with the distance from the
contact.

- "block": a rigid ball is moved by d into an elastic block, which is fixed 400 contact radii away.
- "ball": the lower half of an elastic ball is moved by d, at its equator, onto a rigid plane.

    python demos/sphere.py
    python demos/sphere.py --cases block --cells 12
    mpirun -n 2 python demos/sphere.py

Reference: Hertz. With the approach d of points far from the contact

    a = √(R d),    F = 4/3 E* √R d^{3/2},    p₀ = 3F/(2πa²),    p(r) = p₀ √(1 - r²/a²).

The theory assumes a small a/R. With d = 5e-5, a twentieth of a micrometre, a/R is 0.007, F is
0.11 N, and p₀ 1.04 GPa, at which hard steel is elastic. With ``--depth 0.01`` a/R is 0.1, and the
error of the theory is 2 % of the force (p₀ is 14.7 GPa, above the strength of any steel). The block
is compared with these functions of the depth. A half ball is stiffer than Hertz's half-space, again
by about a/R: its radius and peak are compared with those for the computed force,
a = (3FR/(4E*))^{1/3}. Any consistent units can be used. The exit code is 1 if force, radius or peak
differ by more than 2 %.
"""

from __future__ import annotations

import argparse
import sys
import time
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
from fenics_contact.elasticity import LinearElastic

R, E, NU = 1.0, 210e3, 0.3
E_STAR = E / (1 - NU**2)
FAR = 400  # size of the block relative to the contact radius
AT_X, AT_Y, HELD, CONTACT = 1, 2, 3, 4  # facets: the planes of symmetry, the far end, Γc
TOLERANCE = 0.02


def make_mesh(case: str, a: float, cells: int) -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags]:
    """Mesh a quarter of the block below z = 0, or of the half ball above, fine at the origin.

    Cells have the size a/``cells`` up to 1.3 a, and grow with the distance beyond. Collective.
    """
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 0)
        gmsh.model.add(case)
        if MPI.COMM_WORLD.rank == 0:
            occ = gmsh.model.occ
            height, radius = (0.0, FAR * a) if case == "block" else (R, R)
            body = occ.addSphere(0, 0, height, radius, -1, -np.pi / 2, 0, np.pi / 2)
            occ.synchronize()
            gmsh.model.addPhysicalGroup(3, [body], 1)
            groups: dict[int, list[int]] = {AT_X: [], AT_Y: [], HELD: [], CONTACT: []}
            for _, face in gmsh.model.getBoundary([(3, body)], oriented=False):
                low, high = np.split(np.array(gmsh.model.getBoundingBox(2, face)), 2)
                tight = 1e-4 * a
                flat = high[2] - low[2] < tight
                if high[0] < tight:
                    groups[AT_X].append(face)
                elif high[1] < tight:
                    groups[AT_Y].append(face)
                else:  # Γc is the flat face of the block, or the round face of the ball
                    groups[CONTACT if flat == (case == "block") else HELD].append(face)
            for tag, faces in groups.items():
                gmsh.model.addPhysicalGroup(2, faces, tag)

            def size(dim: int, tag: int, x: float, y: float, z: float, lc: float) -> float:
                return a / cells + 0.5 * max(0.0, np.sqrt(x**2 + y**2 + z**2) - 1.2 * a)

            gmsh.model.mesh.setSizeCallback(size)
            gmsh.model.mesh.generate(3)
            gmsh.model.mesh.setOrder(2)
        mesh, _, tags = fc.model_to_mesh(gmsh.model, MPI.COMM_WORLD)
        return mesh, tags
    finally:
        gmsh.finalize()


def hertz(case: str, depth: float, force: float) -> dict[str, float]:
    """Return Hertz's force, radius and peak for the depth, or for the ball's computed force."""
    if case == "ball":
        a = (0.75 * force * R / E_STAR) ** (1 / 3)
        return {"radius [mm]": a, "peak pressure [MPa]": 1.5 * force / (np.pi * a**2)}
    a, force = np.sqrt(R * depth), 4 / 3 * E_STAR * np.sqrt(R) * depth**1.5
    peak = 1.5 * force / (np.pi * a**2)
    return {"force [N]": force, "radius [mm]": a, "peak pressure [MPa]": peak}


def solve(
    arguments: argparse.Namespace, case: str
) -> tuple[fc.ContactProblem, LinearElastic, dict[str, Any]]:
    """Press, and compare with Hertz; forces are four times those on the quarter. Collective."""
    start = time.perf_counter()
    mesh, tags = make_mesh(case, np.sqrt(R * arguments.depth), arguments.cells)
    V = fem.functionspace(mesh, ("Lagrange", arguments.degree, (3,)))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    body = LinearElastic(u, E, NU, "3D")
    down = fem.Constant(mesh, PETSc.ScalarType(0.0))
    fixed = fem.Constant(mesh, PETSc.ScalarType(0.0))
    held = [(0, AT_X, fixed), (1, AT_Y, fixed)]
    obstacle: fc.Ball | fc.HalfSpace
    if case == "block":
        held += [(i, HELD, fixed) for i in range(3)]
        ball_moves = ufl.as_vector([0, 0, down])
        obstacle = fc.Ball(center=(0, 0, R), radius=R, displacement=ball_moves)
    else:
        held += [(2, HELD, down)]
        obstacle = fc.HalfSpace(point=(0, 0, 0), normal=(0, 0, 1))
    bcs = [
        fem.dirichletbc(value, fem.locate_dofs_topological(V.sub(i), 2, tags.find(tag)), V.sub(i))
        for i, tag, value in held
    ]
    law = fc.Frictionless(fc.RelativeStiffness(arguments.stiffness))
    contact = fc.Contact(u, fc.ContactSurface(mesh, tags, CONTACT), obstacle, law)
    problem = fc.ContactProblem(body.residual(v), u, bcs=bcs, contacts=[contact])
    (step,) = fc.increments(problem, down, 0.0, -arguments.depth)

    resultants = contact.resultants()
    force = 4 * abs(resultants.force[2])
    values = {
        "force [N]": force,
        "radius [mm]": float(np.sqrt(4 * resultants.area / np.pi)),
        "peak pressure [MPa]": resultants.max_pressure,
    }
    exact = hertz(case, arguments.depth, force)
    references = {name: (value, TOLERANCE) for name, value in exact.items()}
    result = {
        "case": case,
        "depth": arguments.depth,
        "references": output.compare(values, references),
        "force": force,
        "dofs": V.dofmap.index_map.size_global * 3,
        "iterations": step.iterations,
        "wall_seconds": time.perf_counter() - start,
    }
    if arguments.errors:
        budget = fc.estimate_errors(problem, body.stress, strain=body.strain(u))
        result["errors"] = budget.numbers()
    return problem, body, result


def draw(path: Path, runs: list[tuple[dict[str, Any], dict[str, np.ndarray]]]) -> None:
    """Plot computed and Hertz's pressure over the distance from the axis. On this rank."""
    with plotting.figure(path, len(runs)) as axes:
        for ax, (result, points) in zip(np.atleast_1d(axes), runs, strict=True):
            exact = hertz(result["case"], result["depth"], result["force"])
            a, p0 = exact["radius [mm]"], exact["peak pressure [MPa]"]
            r = np.linalg.norm(points["x"][:, :2], axis=1)
            near = r < 1.3 * a
            ax.plot(
                r[near],
                points["pressure"][near],
                ".",
                color="#1f5fa8",
                markersize=3,
                label="computed, at the points of the contact surface",
            )
            x = np.linspace(0, a, 200)
            ax.plot(x, p0 * np.sqrt(1 - (x / a) ** 2), "k--", label=f"Hertz, a = {a:.4g} mm")
            titles = {"block": "Rigid ball on a block", "ball": "Elastic ball on a rigid plane"}
            title = f"{titles[result['case']]}: F = {result['force']:.4g} N"
            ax.set(xlabel="r [mm]", ylabel="contact pressure [MPa]", title=title)
            ax.set(xlim=(0, 1.3 * a), ylim=(0, 1.2 * p0))
            ax.grid(alpha=0.25)
            ax.legend(loc="upper right")


def main() -> int:
    """Run all cases; return 0 if every reference is met."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--cases", nargs="+", choices=("block", "ball"), default=["block", "ball"])
    parser.add_argument("--depth", type=float, default=5e-5, help="approach d, mm")
    parser.add_argument("--cells", type=int, default=8, help="cells per contact radius")
    parser.add_argument("--degree", type=int, default=2, help="degree of the displacement")
    parser.add_argument("--stiffness", type=float, default=30, help="normal stiffness over E/h")
    parser.add_argument("--errors", action="store_true", help="estimate the errors, part by part")
    parser.add_argument("--output", type=Path, default=Path("output/sphere"), help="folder")
    arguments, _ = parser.parse_known_args()
    comm, drawn = MPI.COMM_WORLD, []
    for case in arguments.cases:
        problem, body, result = solve(arguments, case)
        fc.Writer(arguments.output / case, problem, stress=body.stress).write(arguments.depth)
        drawn.append((result, problem.contacts[0].gather()))
        if comm.rank == 0:
            print(f"{case}: {result['dofs']} dofs, {result['iterations']} iterations, ", end="")
            print(f"{result['wall_seconds']:.2f} s")
            print(output.table(result["references"]))
            if "errors" in result:
                print(fc.ErrorBudget(**result["errors"]))
    if comm.rank == 0:
        draw(arguments.output / "pressure.png", drawn)
    runs = [result for result, _ in drawn]
    output.write_json(arguments.output / "result.json", {"runs": runs}, comm)
    return 0 if all(e["passed"] for run in runs for e in run["references"].values()) else 1


if __name__ == "__main__":
    sys.exit(main())
