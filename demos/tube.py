"""Tube: pinched by two round bars until its inside closes, with self-contact.

Plane strain, neo-Hookean rubber (E = 3, ν = 0.45); lengths in mm, stresses in MPa, forces per mm of
the tube. A tube of mean radius R = 10 and thickness t = 2 is pinched, as in a valve, by two rigid
bars of radius 4, one from above and one from below, without friction. It takes the shape of an
eight, and its inside closes in the middle; then the bars press wall on wall. The whole inside is Γc
and its own obstacle: the opposite point is found on the same wall along the present normal.

    python demos/tube.py
    python demos/tube.py --cells 6
    mpirun -n 2 python demos/tube.py

References. The forces of the bars and between the walls are compared with a quarter of the tube,
whose inside is pressed on the plane of symmetry as on a rigid half-space (1e-3: normals of curved
walls do not end at mirror points). In the whole tube both walls have penalty springs, which
penetrate by twice the amount: a quarter of the stiffness gives the same pressure. The quarter is
compared with cells of half the size (1 %). The first increment is compared with Winkler's curved
beam under two opposite forces (S. Timoshenko, Strength of Materials; Roark's table of rings), whose
middle line becomes lower and wider by

    F R²/(E' t e) (π k₁/4 - 2 k₂²/π)    and    F R²/(E' t e) (k₁/2 - k₂ + 2 k₂²/π),

k₂ = 1 - e/R, k₁ = k₂ + 6/5 E'/G e/R, e = R - t/ln(outer/inner), E' = E/(1 - ν²) (1.5 %: half of
(t/R)², as sections do not stay plane, and an effect of the finite displacement of 1 % of R). The
exit code is 1 if a reference is missed.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, field
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
from fenics_contact.elasticity import NeoHookean

E, NU, R, T, BAR = 3.0, 0.45, 10.0, 2.0, 4.0
INNER, OUTER = R - T / 2, R + T / 2
AROUND = 6  # cells around a quarter, relative to those through the wall
K = 20.0  # penalty stiffness of the bars, and of the quarter on the plane [N/mm³]
# Approach of the bars at the ends of increments, and the values that are compared.
CLOSING = (0.1, *(float(c) for c in range(2, 18, 2)), 17.0, 17.5, 18.0, 18.5, 19.0)
SHOWN = (10.0, 18.5, 19.0)
MIRROR_TOLERANCE, CELLS, BEAM = 1e-3, 0.01, 0.015
WALL, RIM, LEVEL, UPRIGHT = 1, 2, 3, 4


def slopes() -> tuple[float, float]:
    """Return Winkler's vertical and horizontal compliance of the middle line (length²/force)."""
    modulus, shear = E / (1 - NU**2), E / (2 * (1 + NU))
    e = R - T / np.log(OUTER / INNER)
    k2 = 1 - e / R
    k1 = k2 + 1.2 * modulus / shear * e / R
    soft = R**2 / (modulus * T * e)
    lower = soft * (np.pi * k1 / 4 - 2 * k2**2 / np.pi)
    return float(lower), float(soft * (k1 / 2 - k2 + 2 * k2**2 / np.pi))


@dataclass
class Run:
    """The results of a whole tube, or of a quarter of it.

    Attributes:
        name: Name of the model.
        share: Modelled fraction of the force of each bar: 1, or 1/2.
        closing: Approach of the bars after every increment (length).
        force: Force of each bar on the whole tube (force/length).
        inside: Contact force between the walls (force/length).
        lower, wider: Change of height and width of the middle line (length).
        place, pressure: Present x of the points of the inner wall at the end, and pressure per
            undeformed area.
    """

    name: str
    share: float
    problem: fc.ContactProblem
    rubber: NeoHookean
    dofs: int
    closing: list[float] = field(default_factory=list)
    force: list[float] = field(default_factory=list)
    inside: list[float] = field(default_factory=list)
    lower: list[float] = field(default_factory=list)
    wider: list[float] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)
    place: np.ndarray = field(default_factory=lambda: np.empty(0))
    pressure: np.ndarray = field(default_factory=lambda: np.empty(0))


def make_mesh(cells: int, quarters: int) -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags]:
    """Mesh one or four quarters of the section, curved, ``cells`` through the wall. Collective."""
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.add("section")
        if MPI.COMM_WORLD.rank == 0:
            geo = gmsh.model.geo
            centre = geo.addPoint(0, 0, 0)
            ends = []
            for angle in np.arange(quarters + 1 if quarters < 4 else 4) * np.pi / 2:
                x, y = np.cos(angle), np.sin(angle)
                ends.append([geo.addPoint(r * x, r * y, 0) for r in (INNER, OUTER)])
            rays = [geo.addLine(*pair) for pair in ends]
            walls, rims, sections = [], [], []
            for i in range(quarters):
                j = (i + 1) % len(ends)
                wall, rim = (geo.addCircleArc(ends[i][k], centre, ends[j][k]) for k in (0, 1))
                loop = geo.addCurveLoop([rays[i], rim, -rays[j], -wall])
                section = geo.addPlaneSurface([loop])
                for arc in (wall, rim):
                    geo.mesh.setTransfiniteCurve(arc, AROUND * cells + 1)
                geo.mesh.setTransfiniteSurface(section)
                geo.mesh.setRecombine(2, section)
                walls.append(wall)
                rims.append(rim)
                sections.append(section)
            for ray in rays:
                geo.mesh.setTransfiniteCurve(ray, cells + 1)
            geo.synchronize()
            gmsh.model.addPhysicalGroup(2, sections, 1)
            groups = {WALL: walls, RIM: rims, LEVEL: rays[::2], UPRIGHT: rays[1::2]}
            for tag, lines in groups.items():
                gmsh.model.addPhysicalGroup(1, lines, tag)
            gmsh.model.mesh.generate(2)
            gmsh.model.mesh.setOrder(2)
        mesh, _, tags = fc.model_to_mesh(gmsh.model, MPI.COMM_WORLD, gdim=2)
        return mesh, tags
    finally:
        gmsh.finalize()


def solve(name: str, cells: int, quarters: int) -> Run:
    """Pinch a tube or a quarter of it, and return the results. Collective."""
    mesh, tags = make_mesh(cells, quarters)
    V = fem.functionspace(mesh, ("Lagrange", 2, (2,)))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    rubber = NeoHookean(u, E, NU, "plane strain")
    dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": 4})

    def held(tag: int, i: int) -> fem.DirichletBC:
        facets = tags.find(tag)
        return fem.dirichletbc(0.0, fem.locate_dofs_topological(V.sub(i), 1, facets), V.sub(i))

    closing = fem.Constant(mesh, 0.0)
    wall, rim = (fc.ContactSurface(mesh, tags, tag) for tag in (WALL, RIM))
    bars = {"upper": 1.0} if quarters == 1 else {"upper": 1.0, "lower": -1.0}
    obstacles: dict[str, Any] = {
        called: fc.Cylinder(
            (0, up * (OUTER + BAR)), BAR, displacement=ufl.as_vector([0, -up * closing / 2])
        )
        for called, up in bars.items()
    }
    contacts = [
        fc.Contact(u, rim, obstacle, fc.Frictionless(K), kinematics="finite", name=called)
        for called, obstacle in obstacles.items()
    ]
    # u_x = 0 at x = 0, which constrains the horizontal rigid-body mode of the whole tube.
    bcs = [held(UPRIGHT, 0)]
    if quarters == 1:
        bcs.append(held(LEVEL, 1))
        opposite: Any = fc.HalfSpace((0, 0), (0, 1))
        law = fc.Frictionless(K)
    else:
        opposite, law = fc.DeformableBody(tags, WALL), fc.Frictionless(K / 4)
    inside = fc.Contact(u, wall, opposite, law, kinematics="finite", name="inside")
    problem = fc.ContactProblem(rubber.residual(v, dx), u, bcs=bcs, contacts=[*contacts, inside])

    share = 0.5 if quarters == 1 else 1.0
    run = Run(name, share, problem, rubber, V.dofmap.index_map.size_global * 2)
    history = fc.increments(problem, closing, 0.0, CLOSING[-1], steps=CLOSING, progress=name)
    for step in history:
        run.closing.append(step.load)
        run.iterations.append(step.iterations)
        run.force.append(-float(contacts[0].resultants().force[1]) / share)
        # In the whole tube each of the two walls carries half of the pressure.
        run.inside.append(inside.resultants().normal_force / share)
        run.lower.append(-2 * float(output.at_node(u, (0.0, R))[1]))
        run.wider.append(2 * float(output.at_node(u, (R, 0.0))[0]))
    x = inside.points[:, 0] + inside.pairs.own_displacement()[:, 0]
    rows = MPI.COMM_WORLD.allgather(np.stack([x, inside.pressure * 2 * share]))
    run.place, run.pressure = np.concatenate(rows, axis=1)
    return run


def compare(whole: Run, quarter: Run, fine: Run) -> dict[str, Any]:
    """Compare the whole tube with its quarter and Winkler, and the quarter with finer cells."""
    values, references = {}, {}
    for c in SHOWN:
        i = CLOSING.index(c)
        values[f"force, compression {c:g} [N/mm]"] = whole.force[i]
        references[f"force, compression {c:g} [N/mm]"] = (quarter.force[i], MIRROR_TOLERANCE)
        values[f"force, quarter model, compression {c:g} [N/mm]"] = quarter.force[i]
        references[f"force, quarter model, compression {c:g} [N/mm]"] = (fine.force[i], CELLS)
    values["self-contact force at the end [N/mm]"] = whole.inside[-1]
    references["self-contact force at the end [N/mm]"] = (quarter.inside[-1], MIRROR_TOLERANCE)
    found = whole.lower[0] / whole.force[0], whole.wider[0] / whole.force[0]
    for name, value, known in zip(("vertical", "horizontal"), found, slopes(), strict=True):
        values[f"compliance, {name} [mm²/N]"] = value
        references[f"compliance, {name} [mm²/N]"] = (known, BEAM)
    return output.compare(values, references)


def draw(path: Path, whole: Run, quarter: Run) -> None:
    """Plot force over approach, and the self-contact pressure at the end. On this rank."""
    with plotting.figure(path, 2) as (left, right):
        left.plot(whole.closing, whole.force, ".-", label="bars")
        left.plot(whole.closing, whole.inside, ".-", label="wall on wall")
        left.plot(quarter.closing, quarter.force, "kx", label="quarter on a rigid plane")
        left.plot(quarter.closing, quarter.inside, "kx")
        stiff = 1 / slopes()[0]
        left.plot([0, 4], [0, 4 * stiff], "k--", lw=1, label="Winkler's beam")
        left.set(xlabel="closing of the bars [mm]", ylabel="force [N per mm of tube]")
        left.set(title=f"Tube, R = {R:g}, t = {T:g} mm, E = {E:g} MPa, ν = {NU:g}")
        for run, style in ((whole, "."), (quarter, "kx")):
            closed = (run.pressure > 0) & (run.place > -1e-9)
            right.plot(run.place[closed], run.pressure[closed], style, label=run.name)
        right.set(xlabel="x [mm]", ylabel="pressure inside, nominal [MPa]", ylim=(0, None))
        right.set(title=f"Wall on wall, closed by {CLOSING[-1]:g} mm")
        for ax in (left, right):
            ax.grid(alpha=0.25)
            ax.legend()


def main() -> int:
    """Pinch tube and quarters, and write all results; return 0 if every reference is met."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--cells", type=int, default=4, help="through the wall")
    parser.add_argument("--output", type=Path, default=Path("output/tube"), help="folder")
    arguments, _ = parser.parse_known_args()
    start, cells, comm = time.perf_counter(), arguments.cells, MPI.COMM_WORLD
    if cells < 2 or cells % 2:
        parser.error("there is to be a node in the middle of the wall: give an even number")
    whole = solve("tube", cells, 4)
    quarter, fine = solve("quarter", cells, 1), solve("quarter, fine", 2 * cells, 1)
    result: dict[str, Any] = {
        "references": compare(whole, quarter, fine),
        "dofs": whole.dofs,
        "iterations": [run.iterations for run in (whole, quarter, fine)],
        "closing": whole.closing,
        "forces": {run.name: run.force for run in (whole, quarter, fine)},
        "inside": {run.name: run.inside for run in (whole, quarter, fine)},
        "wall_seconds": time.perf_counter() - start,
    }
    fc.Writer(arguments.output, whole.problem, stress=whole.rubber.stress).write(CLOSING[-1])
    plotting.plot_pressure(
        arguments.output / "section.png",
        whole.problem.contacts[-1],
        title=f"Closed by {CLOSING[-1]:g} mm; springs of each wall bear half",
    )
    if comm.rank == 0:
        print(output.table(result["references"]))
        draw(arguments.output / "tube.png", whole, quarter)
    output.write_json(arguments.output / "result.json", result, comm)
    return 0 if all(entry["passed"] for entry in result["references"].values()) else 1


if __name__ == "__main__":
    sys.exit(main())
