"""A square-thread screw rotates below a rubber nut: torque and axial force.

The flank of the thread is a helicoid about the z-axis, z = P θ, P = lead/(2π) = 3. The nut is
represented by one block at the mean radius R = 10, of width 1, length 2 and height 1, whose foot is
the same helicoid: E = 10, ν = 0.45, neo-Hookean, with a fixed top. The screw is pressed against it
by 0.05 along the axis; then it rotates by 1.2 rad and advances by P per radian, as in a fixed nut
when a load is lowered. Then it rotates back, as when a load is raised. Lengths in mm, stresses in
MPa.

    python demos/screw.py
    python demos/screw.py --friction 0.2

References: without friction the work of the torque is that of the axial force, M = F P, at every
angle, to round-off. With friction the textbook solution of a square-thread screw, M = F R tan(α ±
φ) with tan α = P/R and tan φ = μ, plus for raising and minus for lowering. Its tolerance is 3e-4
F R: a centre of pressure that is off by 0.01 of the width of the block changes the torque by
μ F R/1000, and the finite width by another (1/20)²/3 μ F R. The exit code is 1 if one is missed.
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
from tqdm import tqdm

import fenics_contact as fc
from fenics_contact import output, plotting
from fenics_contact.elasticity import NeoHookean

E, NU, R, P = 10.0, 0.45, 10.0, 3.0
WIDTH, LENGTH, HEIGHT = 1.0, 2.0, 1.0
DEPTH, TURN = 0.05, 1.2
WITHIN = 3e-4  # tolerance of M / (F R)
CLEARANCE = 1e-5  # initial gap: without it the chords of the foot would penetrate the thread
PRESSED, TURNED = 2, 12  # increments of pressing, and of the rotation in each direction
FOOT, TOP = 1, 2


def make_mesh(n: tuple[int, int, int]) -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags]:
    """Mesh the block with its foot on the thread, and tag foot and top. Collective."""
    low, high = (R - WIDTH / 2, -LENGTH / 2, 0.0), (R + WIDTH / 2, LENGTH / 2, HEIGHT)
    mesh = dolfinx.mesh.create_box(MPI.COMM_WORLD, [low, high], n, dolfinx.mesh.CellType.hexahedron)
    sides = [
        dolfinx.mesh.locate_entities_boundary(mesh, 2, lambda x, z=z: np.isclose(x[2], z))
        for z in (0.0, HEIGHT)
    ]
    facets, values = np.concatenate(sides), np.repeat([FOOT, TOP], [len(s) for s in sides])
    order = np.argsort(facets)
    tags = dolfinx.mesh.meshtags(mesh, 2, facets[order], values[order].astype(np.int32))
    x = mesh.geometry.x
    x[:, 2] += P * np.arctan2(x[:, 1], x[:, 0]) * (1 - x[:, 2] / HEIGHT)
    return mesh, tags


def thread(x: Any) -> Any:
    """Return the distance to the flank, to first order in the distance (UFL)."""
    above = x[2] + CLEARANCE - P * ufl.atan2(x[1], x[0])
    return above / ufl.sqrt(1 + P**2 / (x[0] ** 2 + x[1] ** 2))


def solve(
    friction: float, n: tuple[int, int, int]
) -> tuple[list[dict[str, float]], fc.ContactProblem, NeoHookean]:
    """Press, lower and raise; return force and torque after each increment. Collective."""
    mesh, tags = make_mesh(n)
    V = fem.functionspace(mesh, ("Lagrange", 1, (3,)))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    rubber = NeoHookean(u, E, NU, "3D")
    top = fem.locate_dofs_topological(V, 2, tags.find(TOP))
    bcs = [fem.dirichletbc(np.zeros(3), top, V)]
    angle, shift = fem.Constant(mesh, 0.0), fem.Constant(mesh, np.zeros(3))
    turn = fc.Rotation(angle, about=(0, 0, 0), axis=(0, 0, 1))
    screw = fc.SignedDistance(thread, displacement=shift, rotation=turn)
    law = fc.Coulomb(friction) if friction else fc.Frictionless()
    surface = fc.ContactSurface(mesh, tags, FOOT)
    contact = fc.Contact(u, surface, screw, law, kinematics="finite", name="flank")
    problem = fc.ContactProblem(rubber.residual(v), u, bcs=bcs, contacts=[contact])

    way = [(0.0, DEPTH * i / PRESSED) for i in range(1, PRESSED + 1)]
    way += [(TURN * i / TURNED, DEPTH) for i in range(1, TURNED + 1)]
    way += [(TURN * (1 - i / TURNED), DEPTH) for i in range(1, TURNED + 1)]
    path = []
    for turned, pressed in tqdm(way, disable=None):
        angle.value, shift.value[2] = turned, P * turned + pressed
        problem.solve()
        problem.commit()
        found, moment = contact.resultants(), contact.moment((0, 0, 0))
        path.append(
            {
                "angle": turned,
                "force": float(found.force[2]),
                "torque": float(moment[2]),
                "stick": found.stick,
                "slip": found.slip,
            }
        )
    return path, problem, rubber


def compare(
    free: list[dict[str, float]], path: list[dict[str, float]], friction: float
) -> dict[str, Any]:
    """Compare the torques with the textbook's; those on the nut oppose those on the screw."""
    alpha, phi = np.arctan2(P, R), np.arctan(friction)
    lowered, raised = path[PRESSED + TURNED - 1], path[-1]
    values = {
        "μ = 0: largest |M / (F P) - 1|": max(
            abs(abs(row["torque"] / row["force"]) / P - 1) for row in free
        ),
        "raising, M / (F R)": -raised["torque"] / (raised["force"] * R),
        "lowering, M / (F R)": -lowered["torque"] / (lowered["force"] * R),
    }
    references = {
        "μ = 0: largest |M / (F P) - 1|": (0.0, 1e-9),
        "raising, M / (F R)": (float(np.tan(alpha + phi)), WITHIN / np.tan(alpha + phi)),
        "lowering, M / (F R)": (float(np.tan(alpha - phi)), WITHIN / np.tan(alpha - phi)),
    }
    return output.compare(values, references)


def draw(file: Path, runs: dict[float, list[dict[str, float]]]) -> None:
    """Plot torque / (force x radius) along the path. On this rank."""
    with plotting.figure(file, 2) as (left, right):
        for friction, path in runs.items():
            steps = np.arange(1, len(path) + 1)
            ratio = [-row["torque"] / (row["force"] * R) for row in path]
            (line,) = left.plot(steps, ratio, ".-", label=f"μ = {friction:g}")
            for sign in (1, -1):
                level = np.tan(np.arctan2(P, R) + sign * np.arctan(friction))
                left.axhline(level, color=line.get_color(), ls=":", lw=1)
            right.plot(steps, [row["force"] for row in path], ".-", label=f"μ = {friction:g}")
        left.set(ylabel="M / (F R) [–]", title="Torque; dotted: tan(α ± φ)")
        right.set(ylabel="F [N]", title="Axial force on the nut")
        for ax in (left, right):
            ax.set(xlabel="increment: pressed, lowered, raised [–]")
            ax.grid(alpha=0.25)
            ax.legend()


def main() -> int:
    """Run without and with friction, write all results; return 0 if every reference is met."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--friction", type=float, default=0.1, help="μ")
    parser.add_argument("--cells", type=int, default=4, help="along the width and the height")
    parser.add_argument("--output", type=Path, default=Path("output/screw"), help="folder")
    arguments, _ = parser.parse_known_args()
    start = time.perf_counter()
    n = (arguments.cells, 2 * arguments.cells, arguments.cells)
    free, *_ = solve(0.0, n)
    path, problem, rubber = solve(arguments.friction, n)
    comm = MPI.COMM_WORLD
    result: dict[str, Any] = {
        "references": compare(free, path, arguments.friction),
        "path": path,
        "without friction": free,
        "wall_seconds": time.perf_counter() - start,
    }
    fc.Writer(arguments.output, problem, stress=rubber.stress).write(1.0)
    if comm.rank == 0:
        print(output.table(result["references"]))
        draw(arguments.output / "screw.png", {0.0: free, arguments.friction: path})
    plotting.plot_pressure(arguments.output / "pressure.png", problem.contacts[0])
    output.write_json(arguments.output / "result.json", result, comm)
    return 0 if all(entry["passed"] for entry in result["references"].values()) else 1


if __name__ == "__main__":
    sys.exit(main())
