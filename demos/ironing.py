"""Ironing: a rigid cylinder pressed into an elastic block by a force, and dragged along it.

Plane strain; lengths in mm, stresses in MPa, forces per mm of thickness. The cylinder (R = 12) is
loaded by the force P = 4.5 and moved by 4 along a block (E = 1000, ν = 0.3, μ = 0.3), which is
fixed at its bottom and so large that it approximates a half-plane. The cylinder slides by sixteen
half-widths of the contact, over more than a hundred facets. Its height is unknown, given by P.

    python demos/ironing.py
    python demos/ironing.py --cells 4 --increments 20
    mpirun -n 2 python demos/ironing.py

Reference: a rigid cylinder that slides on an elastic half-plane (K. L. Johnson, Contact Mechanics,
section 7.2). With tan(πγ) = μ (1-2ν)/(2(1-ν)) and E* = E/(1-ν²)

    P = π a² E* (1 - 4γ²)/(4R),    p(x) = E*/(2R) cos(πγ) (a + x)^{1/2-γ} (a - x)^{1/2+γ},

with x in the sliding direction: slightly asymmetric, unlike Hertz's, as friction also displaces the
surface along the normal. The checks are half-width and peak (2 %), constancy of the peak during
sliding (1 %), T = μN and the vertical force P (1e-6), and the ratio of friction dissipation to the
work of the drag (1 %; the error of small displacements grows with a/R). The exit code is 1 if one
of them fails.
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

import fenics_contact as fc
from fenics_contact import output, plotting
from fenics_contact.elasticity import LinearElastic

E, NU, MU, R, P = 1000.0, 0.3, 0.3, 12.0, 4.5
SLIDE, SIZE = 4.0, 60.0  # displacement of the cylinder, size of the block
BOTTOM, TOP = 1, 2
E_STAR = E / (1 - NU**2)
GAMMA = np.arctan(MU * (1 - 2 * NU) / (2 * (1 - NU))) / np.pi
HALF_WIDTH = np.sqrt(4 * P * R / (np.pi * E_STAR * (1 - 4 * GAMMA**2)))


def sliding_pressure(x: np.ndarray) -> np.ndarray:
    """Return Johnson's pressure at x from the middle of the contact, along sliding (stress)."""
    a = HALF_WIDTH
    before, behind = np.clip(a + x, 0, None), np.clip(a - x, 0, None)
    skewed = before ** (0.5 - GAMMA) * behind ** (0.5 + GAMMA)
    return E_STAR / (2 * R) * np.cos(np.pi * GAMMA) * skewed


def make_mesh(cells: int) -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags]:
    """Mesh the block: ``cells`` per half-width at the path, coarser with distance. Collective."""
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 0)
        gmsh.model.add("block")
        if MPI.COMM_WORLD.rank == 0:
            occ, half, reach = gmsh.model.occ, SIZE / 2, SLIDE / 2 + 3 * HALF_WIDTH
            corners = [
                (-half, -half),
                (half, -half),
                (half, 0),
                (reach, 0),
                (-reach, 0),
                (-half, 0),
            ]
            points = [occ.addPoint(x, y, 0) for x, y in corners]
            lines = [
                occ.addLine(p, q) for p, q in zip(points, points[1:] + points[:1], strict=True)
            ]
            block = occ.addPlaneSurface([occ.addCurveLoop(lines)])
            occ.synchronize()
            gmsh.model.addPhysicalGroup(2, [block], 1)
            gmsh.model.addPhysicalGroup(1, [lines[0]], BOTTOM)
            gmsh.model.addPhysicalGroup(1, [lines[3]], TOP)

            def size(dim: int, tag: int, x: float, y: float, z: float, lc: float) -> float:
                along = max(0.0, abs(x) - reach)
                return HALF_WIDTH / cells + 0.25 * float(np.hypot(along, y))

            gmsh.model.mesh.setSizeCallback(size)
            gmsh.model.mesh.generate(2)
        mesh, _, tags = fc.model_to_mesh(gmsh.model, MPI.COMM_WORLD, gdim=2)
        return mesh, tags
    finally:
        gmsh.finalize()


def solve(
    arguments: argparse.Namespace,
) -> tuple[fc.ContactProblem, LinearElastic, list[dict[str, float]], dict[str, Any]]:
    """Press and drag, and return the results of every increment of dragging. Collective."""
    start = time.perf_counter()
    mesh, tags = make_mesh(arguments.cells)
    V = fem.functionspace(mesh, ("Lagrange", 2, (2,)))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    body = LinearElastic(u, E, NU, "plane strain")
    held = fem.locate_dofs_topological(V, 1, tags.find(BOTTOM))
    bcs = [fem.dirichletbc(np.zeros(2), held, V)]

    # The displacement of the cylinder is prescribed along x, and follows from the force along y.
    along, press = fem.Constant(mesh, 0.0), fem.Constant(mesh, 0.0)
    motion = fc.Motion(displacement=(along, None), force=(None, press))
    cylinder = fc.Cylinder(point=(-SLIDE / 2, R), radius=R, displacement=motion)
    surface = fc.ContactSurface(mesh, tags, TOP)
    stiffness = fc.RelativeStiffness(arguments.stiffness)
    contact = fc.Contact(u, surface, cylinder, fc.Coulomb(MU, stiffness, stiffness))
    problem = fc.ContactProblem(
        body.residual(v), u, bcs=bcs, contacts=[contact], method=arguments.solver
    )

    def load(t: float) -> None:
        """Press until t = 1, drag until t = 2."""
        press.value = -P * min(t, 1.0)
        along.value = SLIDE * max(t - 1.0, 0.0)

    ends = [0.5, 1.0, *(1 + np.arange(1, arguments.increments + 1) / arguments.increments)]
    history: Any = fc.increments(problem, load, 0.0, 2.0, steps=ends, progress="ironing")
    path, iterations, last = [], [], 0.0
    for step in history:
        iterations.append(step.iterations)
        if step.load <= 1.0:
            continue
        r = step.contacts["contact"]
        path.append(
            {
                "along": float(along.value),
                "depth": -float(contact.free_motion[1].value),
                "normal": r.normal_force,
                "tangential": r.tangential_force,
                "vertical": -r.force[1],
                "drag": r.force[0],
                "peak": r.max_pressure,
                "half_width": 0.5 * r.area,
                "stick": r.stick,
                "dissipation": step.energy.dissipation,
                "way": float(along.value) - last,
            }
        )
        last = float(along.value)
    info: dict[str, Any] = {
        "dofs": V.dofmap.index_map.size_global * 2,
        "facets_passed": float(SLIDE / HALF_WIDTH * arguments.cells),
        "iterations": iterations,
        "wall_seconds": time.perf_counter() - start,
    }
    if arguments.errors:
        budget = fc.estimate_errors(problem, body.stress, strain=body.strain(u))
        info["errors"] = budget.numbers()
    return problem, body, path, info


def compare(path: list[dict[str, float]]) -> dict[str, Any]:
    """Compare the steady second half of the path with its references."""
    steady = path[len(path) // 2 :]
    column = {name: np.array([row[name] for row in steady]) for name in steady[0]}
    peak = float(sliding_pressure(np.linspace(-HALF_WIDTH, HALF_WIDTH, 2001)).max())
    values = {
        "half-width [mm]": float(column["half_width"].mean()),
        "peak pressure [MPa]": float(column["peak"].mean()),
        "variation of the peak [MPa]": float(np.ptp(column["peak"])) / 2,
        "tangential / normal force": float((column["tangential"] / column["normal"]).mean()),
        "vertical force [N/mm]": float(column["vertical"].mean()),
        "dissipation / work of the drag force": float(
            column["dissipation"].sum() / (column["drag"] * column["way"]).sum()
        ),
    }
    references = {
        "half-width [mm]": (float(HALF_WIDTH), 0.02),
        "peak pressure [MPa]": (peak, 0.02),
        "variation of the peak [MPa]": (0.0, 0.01 * peak),
        "tangential / normal force": (MU, 1e-6),
        "vertical force [N/mm]": (P, 1e-6),
        "dissipation / work of the drag force": (1.0, 0.01),
    }
    return output.compare(values, references)


def draw(folder: Path, path: list[dict[str, float]], points: dict[str, np.ndarray]) -> None:
    """Plot the tractions at the end, and the forces along the path. On this rank."""
    with plotting.figure(folder / "ironing.png", 2) as (left, right):
        x = points["x"][:, 0]
        closed = points["pressure"] > 0
        middle = 0.5 * (x[closed].min() + x[closed].max())
        near = np.abs(x - middle) < 1.4 * HALF_WIDTH
        offset = (x[near] - middle) / HALF_WIDTH
        at = np.linspace(-1, 1, 401)
        exact = sliding_pressure(at * HALF_WIDTH)
        left.plot(offset, points["pressure"][near], ".", color="#1f5fa8", label="pressure p")
        left.plot(
            offset,
            np.abs(points["tangential_traction"][near, 0]),
            ".",
            color="#c4482f",
            label="friction |τ|",
        )
        left.plot(at, exact, "k--", label="half-plane: p")
        left.plot(at, MU * exact, "k:", label="half-plane: μp")
        left.set(xlabel="distance from the middle / a (way to the right)", ylabel="traction [MPa]")
        left.set(
            title=f"Rigid cylinder sliding, μ = {MU:g}, P = {P:g} N/mm",
            ylim=(0, 1.35 * exact.max()),
        )
        left.legend(loc="upper left")
        way = [row["along"] for row in path]
        for name, color, label in (
            ("vertical", "#1f5fa8", "vertical force"),
            ("drag", "#c4482f", "drag"),
        ):
            right.plot(way, [row[name] for row in path], ".-", color=color, label=label)
        right.axhline(P, color="k", ls="--", lw=1, label="P")
        right.axhline(MU * P, color="k", ls=":", lw=1, label="μP")
        right.set(xlabel="way of the cylinder [mm]", ylabel="force [N/mm]", ylim=(0, 1.25 * P))
        right.set(title=f"{len(path)} increments")
        right.legend(loc="center right")
        for ax in (left, right):
            ax.grid(alpha=0.25)


def main() -> int:
    """Run the demo, and write all results; return 0 if every reference is met."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--cells", type=int, default=8, help="cells per half-width of the contact")
    parser.add_argument("--increments", type=int, default=60, help="increments of the drag")
    parser.add_argument("--stiffness", type=float, default=40, help="k_n and k_t over E/h")
    parser.add_argument("--solver", default="newton", choices=("lbfgs", "newton", "alternating"))
    parser.add_argument("--errors", action="store_true", help="estimate the errors, part by part")
    parser.add_argument("--output", type=Path, default=Path("output/ironing"), help="folder")
    arguments, _ = parser.parse_known_args()
    problem, body, path, info = solve(arguments)
    comm, result = MPI.COMM_WORLD, {"references": compare(path)} | info | {"path": path}
    fc.Writer(arguments.output, problem, stress=body.stress).write(path[-1]["along"])
    points = problem.contacts[0].gather()
    if comm.rank == 0:
        print(output.table(result["references"]))
        if "errors" in result:
            print(fc.ErrorBudget(**result["errors"]))
        draw(arguments.output, path, points)
    output.write_json(arguments.output / "result.json", result, comm)
    return 0 if all(entry["passed"] for entry in result["references"].values()) else 1


if __name__ == "__main__":
    sys.exit(main())
