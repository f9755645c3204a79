"""Rolling: a rigid disc is pressed into rubber, rotated until it slips, and dragged.

Plane strain, neo-Hookean (E = 1000, ν = 0.3); lengths in mm, stresses in MPa, forces per mm of
thickness. The disc (R = 4) is pressed by 3, 30 % of the height, into a block 16 x 10 that is fixed
at its bottom. Then it rotates by 0.8: first all points stick, then slip begins at the edges of the
contact, finally all points slip. Then the disc is dragged by 2 without rotation. μ = 0.3.

    python demos/rolling.py
    mpirun -n 2 python demos/rolling.py

References: forces and torque of GetFEM 5.4.2 on the same mesh with the same penalty (1e4 normal,
1e3 tangential), at the ends of pressing, rotation and dragging (1e-7 of the normal force; all
increments are in verification/getfem_disc.py). A cross-check with this package: the block is moved
in the opposite direction instead of the disc, and the forces are the same (1e-10). The torque at
full slip, R times μ times the integral of the pressure (2 %: the penetration is p/k_n, up to 0.07).
The exit code is 1 if one of them is missed.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import dolfinx
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact import output, plotting
from fenics_contact.elasticity import NeoHookean

E, NU, MU, R = 1000.0, 0.3, 0.3, 4.0
WIDTH, HEIGHT, CELL = 16.0, 10.0, 0.5
DEPTH, TURN, SLIDE = 3.0, 0.8, 2.0
K_N, K_T = 1e4, 1e3
BOTTOM, TOP = 1, 2
# Pressing until t = 1, rotation until t = 2, dragging until t = 3.
TIMES = (*(np.arange(1, 13) / 12), *(1 + np.arange(1, 17) / 8))
# Drag, downward force of the disc, and torque on the block, by t.
GETFEM = {
    1.0: (0.0, 3003.797966, 0.0),
    2.0: (902.597361, 3106.755291, 4049.434181),
    3.0: (800.943243, 2959.589109, 3796.018173),
}


def solve(moved: str) -> tuple[list[dict[str, float]], fc.ContactProblem, NeoHookean, int]:
    """Press, rotate and drag; ``moved``, "disc" or "block", is moved along x. Collective."""
    corners, n = (
        [(-WIDTH / 2, 0.0), (WIDTH / 2, HEIGHT)],
        (round(WIDTH / CELL), round(HEIGHT / CELL)),
    )
    mesh = dolfinx.mesh.create_rectangle(
        MPI.COMM_WORLD, corners, n, dolfinx.mesh.CellType.quadrilateral
    )
    sides = [
        dolfinx.mesh.locate_entities_boundary(mesh, 1, lambda x, y=y: np.isclose(x[1], y))
        for y in (0.0, HEIGHT)
    ]
    facets, values = np.concatenate(sides), np.repeat([BOTTOM, TOP], [len(s) for s in sides])
    order = np.argsort(facets)
    tags = dolfinx.mesh.meshtags(mesh, 1, facets[order], values[order].astype(np.int32))

    V = fem.functionspace(mesh, ("Lagrange", 2, (2,)))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    rubber = NeoHookean(u, E, NU, "plane strain")
    held = fem.Function(V)
    bcs = [fem.dirichletbc(held, fem.locate_dofs_topological(V, 1, tags.find(BOTTOM)))]

    shift, angle = fem.Constant(mesh, np.zeros(2)), fem.Constant(mesh, 0.0)
    axis = (0.0, HEIGHT + R)
    disc = fc.Cylinder(axis, R, displacement=shift, rotation=fc.Rotation(angle, about=axis))
    surface = fc.ContactSurface(mesh, tags, TOP)
    contact = fc.Contact(u, surface, disc, fc.Coulomb(MU, K_N, K_T), kinematics="finite")
    # The quadrature of GetFEM: three points along each edge of a cell.
    dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": 4})
    problem = fc.ContactProblem(
        rubber.residual(v, dx),
        u,
        bcs=bcs,
        contacts=[contact],
        petsc_options={"snes_rtol": 1e-12},
    )

    def load(t: float) -> None:
        """Press until t = 1, rotate until 2, drag until 3."""
        along = SLIDE * max(t - 2.0, 0.0)
        shift.value[:] = along if moved == "disc" else 0.0, -DEPTH * min(t, 1.0)
        angle.value = TURN * float(np.clip(t - 1.0, 0.0, 1.0))
        held.interpolate(
            lambda x: np.stack([0 * x[0] - (along if moved == "block" else 0), 0 * x[0]])
        )

    path, words = [], f"{moved} moved"
    history = fc.increments(problem, load, 0.0, 3.0, steps=TIMES, progress=words)
    for step in history:
        r = step.contacts["contact"]
        path.append(
            {
                "time": step.load,
                "drag": float(r.force[0]),
                "normal": -float(r.force[1]),
                "torque": float(contact.moment(np.add(axis, shift.value))[0]),
                "pressure": r.normal_force,
                "stick": r.stick,
                "slip": r.slip,
                "iterations": step.iterations,
            }
        )
    return path, problem, rubber, V.dofmap.index_map.size_global * 2


def compare(path: list[dict[str, float]], other: list[dict[str, float]]) -> dict[str, Any]:
    """Compare the path with GetFEM's, and with that of the moved block."""
    values, references = {}, {}
    names = ("drag", "normal", "torque")
    for row in path:
        for name, reference in zip(names, GETFEM.get(round(row["time"], 9), ()), strict=False):
            label = f"{name}, t = {row['time']:g}"
            size = GETFEM[round(row["time"], 9)][1] * (R if name == "torque" else 1.0)
            values[label] = row[name]
            references[label] = (reference, 1e-7 * size / (reference or 1.0))
    last = max(row["normal"] for row in path)
    apart = [abs(a[n] - b[n]) for a, b in zip(path, other, strict=True) for n in names]
    values["moving block: change of force / force"] = max(apart) / last
    references["moving block: change of force / force"] = (0.0, 1e-10)
    sliding = next(row for row in path if row["stick"] == 0 and row["time"] > 1)
    values["torque / (μ R ∫p), full slip"] = sliding["torque"] / (MU * R * sliding["pressure"])
    references["torque / (μ R ∫p), full slip"] = (1.0, 0.02)
    return output.compare(values, references)


def draw(file: Path, path: list[dict[str, float]]) -> None:
    """Plot forces and torque, and numbers of sticking and slipping points. On this rank."""
    t = [row["time"] for row in path]
    with plotting.figure(file, 2) as (left, right):
        left.plot(t, [row["normal"] for row in path], ".-", label="force that presses")
        left.plot(t, [row["drag"] for row in path], ".-", label="drag")
        left.plot(t, [row["torque"] / R for row in path], ".-", label="torque / R")
        at = list(GETFEM)
        for k, scale in ((0, 1.0), (1, 1.0), (2, 1 / R)):
            numbers = [GETFEM[time][k] * scale for time in at]
            left.plot(at, numbers, "ko", fillstyle="none", label="GetFEM" if k == 0 else None)
        left.set(ylabel="force [N/mm]", title=f"Disc on rubber, μ = {MU:g}, pressed by 30 %")
        right.plot(t, [row["stick"] for row in path], ".-", label="sticking")
        right.plot(t, [row["slip"] for row in path], ".-", label="slipping")
        right.set(ylabel="points in contact [–]", title="State of the contact")
        for ax in (left, right):
            ax.set(xlabel="time: pressed to 1, turned to 2, dragged to 3 [–]")
            ax.grid(alpha=0.25)
            ax.legend()


def main() -> int:
    """Solve with moved disc and moved block, write results; return 0 if every reference is met."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--output", type=Path, default=Path("output/rolling"), help="folder")
    arguments, _ = parser.parse_known_args()
    start = time.perf_counter()
    path, problem, rubber, dofs = solve("disc")
    other, *_ = solve("block")
    comm = MPI.COMM_WORLD
    result: dict[str, Any] = {
        "references": compare(path, other),
        "dofs": dofs,
        "path": path,
        "wall_seconds": time.perf_counter() - start,
    }
    fc.Writer(arguments.output, problem, stress=rubber.stress).write(TIMES[-1])
    plotting.plot_deformation(
        arguments.output / "block.png", problem.u, title="Pressed, turned and dragged"
    )
    if comm.rank == 0:
        print(output.table(result["references"]))
        draw(arguments.output / "rolling.png", path)
    output.write_json(arguments.output / "result.json", result, comm)
    return 0 if all(entry["passed"] for entry in result["references"].values()) else 1


if __name__ == "__main__":
    sys.exit(main())
