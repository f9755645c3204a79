"""Clutch: a rubber ring is pressed on a disc and rotated by 90°, far beyond full slip.

Two deformable neo-Hookean bodies in space; lengths in mm, stresses in MPa. The ring (radii 10 and
20, thickness 5, E = 10, ν = 0.3) is bonded to a rigid plate above it, the disc (radii 8 and 22,
thickness 5, E = 100, ν = 0.3) to one below; their meshes do not match. The plates approach each
other by 0.25, and then the upper one rotates about the shaft. μ = 0.3.

    python demos/clutch.py
    python demos/clutch.py --cells 3
    mpirun -n 2 python demos/clutch.py

References: the textbook torque for a uniform pressure, μ F 2/3 (b³ - a³)/(b² - a²) with the radii a
and b (2 %: the ring has 32 sides, and its pressure is not quite uniform); for the computed pressure
p, ∫ μ p r dA times cos(Δφ/2) in an increment Δφ, as slip is measured along the chord of the path
(1e-6, from 25° on: before, part of the slip is radial). The reaction torque at the disc's plate is
that of the contact (1e-6: the points of action of τ on ring and disc are p/k_n apart). A second run
also rotates the whole scene, by 69° about an oblique axis until the ring is at 25°: force and
torque are the same in every increment (1e-7: the solver stops at 1e-9 of the forces). The exit code
is 1 if one of them is missed.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import gmsh
import numpy as np
import ufl
from dolfinx import fem, la
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact import output, plotting
from fenics_contact.elasticity import NeoHookean

NU, MU = 0.3, 0.3
RING, DISC = (10.0, 20.0), (8.0, 22.0)  # inner and outer radius
THICK, DEPTH = 5.0, 0.25
MODULI = {"ring": 10.0, "disc": 100.0}
BOTTOM, TOP = 1, 2
# Angle of rotation at the ends of increments [°]: small ones at the onset of slip.
ANGLES = (*np.arange(0.25, 1.6, 0.25), 2.5, *np.arange(5.0, 91.0, 5.0))
STEADY = 25.0  # angle from which slip is circumferential [°]
SCENE_ANGLE, UNTIL = 1.2, 25.0  # rotation of the whole scene [rad], and of the ring meanwhile [°]
SHAFT = np.array([0.0, 0.0, 1.0])
TURN, SCENE_ROTATION = (fc.Rotation(0.0, (0, 0, 0), axis) for axis in (SHAFT, (1, 2, 2)))
# Lever arm of friction at full slip with a uniform pressure.
ARM = 2 / 3 * (RING[1] ** 3 - RING[0] ** 3) / (RING[1] ** 2 - RING[0] ** 2)


def annulus(radii: tuple[float, float], low: float, cells: tuple[int, int, int]) -> tuple:
    """Mesh a ring with numbers of hexahedra around, along the radius and through it. Collective."""
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.add("ring")
        if MPI.COMM_WORLD.rank == 0:
            geo, (around, across, through) = gmsh.model.geo, cells
            centre, ends = geo.addPoint(0, 0, low), []
            for angle in np.arange(4) * np.pi / 2:
                x, y = np.cos(angle), np.sin(angle)
                ends.append([geo.addPoint(r * x, r * y, low) for r in radii])
            rays = [geo.addLine(*pair) for pair in ends]
            sections = []
            for i, j in ((0, 1), (1, 2), (2, 3), (3, 0)):
                inner, outer = (geo.addCircleArc(ends[i][k], centre, ends[j][k]) for k in (0, 1))
                loop = geo.addCurveLoop([rays[i], outer, -rays[j], -inner])
                sections.append(geo.addPlaneSurface([loop]))
                for curve, n in ((inner, around // 4), (outer, around // 4), (rays[i], across)):
                    geo.mesh.setTransfiniteCurve(curve, n + 1)
            for section in sections:
                geo.mesh.setTransfiniteSurface(section)
                geo.mesh.setRecombine(2, section)
            bodies, tops = [], []
            for section in sections:
                made = geo.extrude([(2, section)], 0, 0, THICK, [through], recombine=True)
                tops.append(made[0][1])
                bodies.append(made[1][1])
            geo.synchronize()
            gmsh.model.addPhysicalGroup(3, bodies, 1)
            gmsh.model.addPhysicalGroup(2, sections, BOTTOM)
            gmsh.model.addPhysicalGroup(2, tops, TOP)
            gmsh.model.mesh.generate(3)
        return fc.model_to_mesh(gmsh.model, MPI.COMM_WORLD, gdim=3)
    finally:
        gmsh.finalize()


def solve(
    cells: int, until: float = ANGLES[-1], whole: float = 0.0
) -> tuple[list[dict[str, float]], fc.ContactProblem, NeoHookean]:
    """Press and rotate; return force and torque after each increment. Collective.

    Args:
        cells: Number of cells across the ring.
        until: Last angle of the ring [°].
        whole: Rotation of the whole scene meanwhile about an oblique axis [rad].
    """
    parts = {
        "disc": annulus(DISC, -THICK, (4 * round(3.5 * cells), cells + 1, 2)),
        "ring": annulus(RING, 0.0, (16 * cells, cells, 2)),
    }
    joined = fc.join_meshes(parts)
    mesh = joined.mesh
    V = fem.functionspace(mesh, ("Lagrange", 1, (3,)))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    rubber = NeoHookean(u, joined.by_body(MODULI), NU, "3D")
    plates = {}
    for body, tag in (("disc", BOTTOM), ("ring", TOP)):
        facets = joined.facets.find(joined.facet(body, tag))
        plates[body] = fem.Function(V), fem.locate_dofs_topological(V, 2, facets)
    bcs = [fem.dirichletbc(value, dofs) for value, dofs in plates.values()]
    contact = fc.Contact(
        u,
        fc.ContactSurface(mesh, joined.facets, joined.facet("ring", BOTTOM)),
        fc.DeformableBody(joined.facets, joined.facet("disc", TOP)),
        fc.Coulomb(MU),
        kinematics="finite",
        name="lining",
    )
    dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": 3})
    forces = fem.form(rubber.residual(v, dx))
    problem = fc.ContactProblem(rubber.residual(v, dx), u, bcs=bcs, contacts=[contact])
    held = plates["disc"][1]
    held = held[held < V.dofmap.index_map.size_local]
    x = V.tabulate_dof_coordinates()

    def with_all(vectors: np.ndarray, t: float) -> np.ndarray:
        """Return the vectors rotated with the whole scene at t."""
        return SCENE_ROTATION.rotate(vectors, whole * (t + 1) / (until + 1))

    def load(t: float) -> None:
        """Press until t = 0, then rotate by t degrees."""
        lowered = TURN.rotate(x, np.radians(max(t, 0))) - DEPTH * min(t + 1, 1) * SHAFT
        for body, place in (("disc", x), ("ring", lowered)):
            plates[body][0].x.array[:] = (with_all(place, t) - x).ravel()

    path, ends, before = [], [-0.5, 0.0, *(a for a in ANGLES if a <= until)], 0.0
    name = "scene turned" if whole else "scene at rest"
    history = fc.increments(problem, load, -1.0, until, steps=ends, progress=name)
    for step in history:
        shaft = with_all(SHAFT[None], step.load)[0]
        found = contact.resultants()
        radius = np.linalg.norm(np.cross(contact.places(), shaft), axis=1)
        slipping = float(contact.measure @ (MU * contact.pressure * radius))
        angle = max(step.load, 0.0)
        slipping *= np.cos(np.radians(angle - before) / 2)
        vector = fem.assemble_vector(forces)
        vector.scatter_reverse(la.InsertMode.add)
        reaction = vector.array.reshape(-1, 3)[held]
        moments = np.cross(reaction, (x + u.x.array.reshape(-1, 3))[held])
        path.append(
            {
                "angle": angle,
                "force": float(found.force @ shaft),
                "torque": -float(contact.moment((0, 0, 0)) @ shaft),
                "of all slipping": MPI.COMM_WORLD.allreduce(slipping),
                "held": MPI.COMM_WORLD.allreduce(float(moments.sum(axis=0) @ shaft)),
                "stick": found.stick,
                "slip": found.slip,
                "iterations": step.iterations,
            }
        )
        before = angle
    return path, problem, rubber


def compare(path: list[dict[str, float]], turned: list[dict[str, float]]) -> dict[str, Any]:
    """Compare the torque at full slip with its references, and the rotated scene with the fixed."""
    ratios = [r["torque"] / r["of all slipping"] for r in path if r["angle"] >= STEADY]
    last = path[-1]
    values = {
        "torque / uniform pressure theory": last["torque"] / (MU * last["force"] * ARM),
        "torque / ∫ μ p r, worst increment": max(ratios, key=lambda q: abs(q - 1)),
        "torque / reaction torque": last["torque"] / last["held"],
    }
    references = dict(zip(values, ((1.0, 0.02), (1.0, 1e-6), (1.0, 1e-6)), strict=True))
    for name in ("force", "torque"):
        pairs = zip(path[: len(turned)], turned, strict=True)
        apart = f"{name}, rotating frame, relative change"
        values[apart] = max(abs(a[name] - b[name]) for a, b in pairs) / last[name]
        references[apart] = (0.0, 1e-7)
    return output.compare(values, references)


def draw(file: Path, path: list[dict[str, float]]) -> None:
    """Plot torque over angle, at the onset of slip and of the whole history. On this rank."""
    rows = path[1:]
    with plotting.figure(file, 2) as (left, right):
        for ax, until in ((left, 2.0), (right, ANGLES[-1])):
            some = [row for row in rows if row["angle"] <= until + 1e-9]
            angle = [row["angle"] for row in some]
            ax.plot(angle, [row["torque"] / 1e3 for row in some], ".-", label="torque")
            slipping = [row["of all slipping"] / 1e3 for row in some]
            ax.plot(angle, slipping, "k:", label="μ ∫p r")
            even = [MU * row["force"] * ARM / 1e3 for row in some]
            ax.plot(angle, even, "k--", label="μ F arm")
            ax.set(xlabel="turn of the ring [°]", ylabel="torque [N m]", ylim=(0, None))
            ax.grid(alpha=0.25)
            ax.legend(loc="lower right")
        left.set(title="Slip begins")
        right.set(title=f"Ring on disc, μ = {MU:g}")


def main() -> int:
    """Rotate the ring in a fixed and a rotating scene; return 0 if every reference is met."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--cells", type=int, default=2, help="across the ring")
    parser.add_argument("--output", type=Path, default=Path("output/clutch"), help="folder")
    arguments, _ = parser.parse_known_args()
    start, comm = time.perf_counter(), MPI.COMM_WORLD
    path, problem, rubber = solve(arguments.cells)
    turned, *_ = solve(arguments.cells, UNTIL, SCENE_ANGLE)
    result: dict[str, Any] = {
        "references": compare(path, turned),
        "dofs": problem.u.function_space.dofmap.index_map.size_global * 3,
        "path": path,
        "scene turned": turned,
        "wall_seconds": time.perf_counter() - start,
    }
    fc.Writer(arguments.output, problem, stress=rubber.stress).write(ANGLES[-1])
    plotting.plot_pressure(arguments.output / "pressure.png", problem.contacts[0])
    if comm.rank == 0:
        print(output.table(result["references"]))
        draw(arguments.output / "clutch.png", path)
    output.write_json(arguments.output / "result.json", result, comm)
    return 0 if all(entry["passed"] for entry in result["references"].values()) else 1


if __name__ == "__main__":
    sys.exit(main())
