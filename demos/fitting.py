"""A male-female fitting of two plates: oblique flanks transmit a tensile load, with friction.

The second example of Fancello, Feijóo and Zouain (section 6.2): plates of thickness 6.4 mm, plane
stress, E = 240 daN/mm², ν = 0.38, μ = 0.2. The male plate's head sits in a slot of the female one,
whose top is fixed vertically; a traction F = 0.02656 daN/mm² pulls the male one at its lower face.
Both are deformable, their meshes do not match, and the flanks touch without gap.

The paper gives seven lengths, a = 87, b = 65, c = 43, d = 148, e = 60, f = 40, g = 89 mm; the
figure that defines them is lost. This demo therefore does not reproduce the paper's table, but
solves a fitting of the same kind with the following definitions, each of them an option:

    a  width of the head at its top            d  width of the female plate
    b  width of the head at half its height,   e  length of the shank below the head
       the mean of a and c: not free           f  height of the head, and of the flanks
    c  width of the neck and the shank         g  height of the female plate above the neck

The checks hold for every such geometry. With the flanks at the angle θ to the load P, the product
of F, the thickness and c,

- the vertical contact force on the male plate and the reaction at the top equal P;
- each flank's normal force N is P/(2 sin θ) without friction, and with it between
  P/(2 (sin θ + μ cos θ)) and P/(2 (sin θ - μ cos θ));
- as the gap is zero, displacements are proportional to the load, and the same in five increments as
  in one.

    python demos/fitting.py
    python demos/fitting.py --friction 0.4 --f 60
    mpirun -n 2 python demos/fitting.py

The exit code is 1 if equilibrium is violated by more than 1e-7, the bounds at all, or the last two
conditions by more than 1e-8.
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

E, NU, THICKNESS, LOAD = 240.0, 0.38, 6.4, 0.02656  # daN, mm
CLEARANCE = 2.0  # mm between head and slot, above the flanks
HEAD, SLOT, TOP, PULLED, AXIS = 1, 2, 3, 4, 5
EQUILIBRIUM, SAME = 1e-7, 1e-8


def make_mesh(g: argparse.Namespace) -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags]:
    """Mesh the right half of both plates; neck at y = 0, axis at x = 0. Collective."""
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 0)
        gmsh.model.add("fitting")
        if MPI.COMM_WORLD.rank == 0:
            geo, neck, top, roof = gmsh.model.geo, g.c / 2, g.a / 2, g.f + CLEARANCE
            # Corners anticlockwise, and the tag of the side from each corner to the next.
            male = [(0, -g.e, PULLED), (neck, -g.e, 0), (neck, 0, HEAD)]
            male += [(top, g.f, 0), (0, g.f, AXIS)]
            female = [(neck, 0, 0), (g.d / 2, 0, 0), (g.d / 2, g.g, TOP), (0, g.g, AXIS)]
            female += [(0, roof, 0), (top, roof, 0), (top, g.f, SLOT)]
            groups: dict[int, list[int]] = {}
            first = []
            for body, corners in enumerate((male, female), start=1):
                points = [geo.addPoint(x, y, 0) for x, y, _ in corners]
                ends = zip(points, [*points[1:], points[0]], strict=True)
                lines = [geo.addLine(p, q) for p, q in ends]
                geo.addPlaneSurface([geo.addCurveLoop(lines)], body)
                for line, (_, _, tag) in zip(lines, corners, strict=True):
                    groups.setdefault(tag, []).append(line)
                first += lines if body == 1 else []
            geo.synchronize()
            gmsh.model.addPhysicalGroup(2, [1, 2], 1)
            for tag, lines in groups.items():
                if tag:
                    gmsh.model.addPhysicalGroup(1, lines, tag)
            way = np.array([top - neck, g.f]) / np.hypot(top - neck, g.f)

            def size(dim: int, tag: int, x: float, y: float, z: float, lc: float) -> float:
                along = np.clip((x - neck) * way[0] + y * way[1], 0, np.hypot(top - neck, g.f))
                away = np.hypot(x - neck - along * way[0], y - along * way[1])
                own = tag == 1 if dim == 2 else tag in first
                return (1.0 if own else 1.23) * g.h + 0.2 * away

            gmsh.model.mesh.setSizeCallback(size)
            gmsh.model.mesh.generate(2)
        mesh, _, tags = fc.model_to_mesh(gmsh.model, MPI.COMM_WORLD, gdim=2)
        return mesh, tags
    finally:
        gmsh.finalize()


class Fitting:
    """The fitting on a mesh, which can be loaded repeatedly from the unloaded state."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        """Create mesh and elasticity. Collective."""
        self.mesh, self.tags = make_mesh(arguments)
        V = fem.functionspace(self.mesh, ("Lagrange", arguments.degree, (2,)))
        self.u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
        self.body = LinearElastic(self.u, E, NU, "plane stress", thickness=THICKNESS)
        self.load = fem.Constant(self.mesh, PETSc.ScalarType(0.0))
        ds = ufl.Measure("ds", domain=self.mesh, subdomain_data=self.tags)
        self.F = self.body.residual(v) + self.body.weight * self.load * v[1] * ds(PULLED)
        self.held = fem.locate_dofs_topological(V.sub(1), 1, self.tags.find(TOP))
        axis = fem.locate_dofs_topological(V.sub(0), 1, self.tags.find(AXIS))
        zero = PETSc.ScalarType(0.0)
        self.bcs = [
            fem.dirichletbc(zero, self.held, V.sub(1)),
            fem.dirichletbc(zero, axis, V.sub(0)),
        ]

    def pull(
        self, friction: float, load: float, steps: int = 1
    ) -> tuple[fc.ContactProblem, np.ndarray]:
        """Load the unloaded fitting; return problem and copied displacements. Collective."""
        self.u.x.array[:] = 0.0
        contact = fc.Contact(
            self.u,
            fc.ContactSurface(self.mesh, self.tags, HEAD),
            fc.DeformableBody(self.tags, SLOT),
            fc.Coulomb(friction) if friction > 0 else fc.Frictionless(),
            weight=self.body.weight,
        )
        problem = fc.ContactProblem(
            self.F,
            self.u,
            bcs=self.bcs,
            contacts=[contact],
            method="newton",
            petsc_options={"snes_rtol": 1e-12},  # displacements are compared to 1e-8
        )
        list(fc.increments(problem, self.load, 0.0, load, steps=steps))
        return problem, self.u.x.array.copy()

    def reaction(self) -> float:
        """Return the vertical reaction at the fixed top. Collective."""
        residual = fem.Function(self.u.function_space)
        fem.assemble_vector(residual.x.array, fem.form(self.F))
        residual.x.scatter_reverse(dolfinx.la.InsertMode.add)
        index_map = self.u.function_space.dofmap.index_map
        owned = self.held[self.held < 2 * index_map.size_local]
        return self.mesh.comm.allreduce(float(residual.x.array[owned].sum()))


def differ(comm: MPI.Comm, one: np.ndarray, other: np.ndarray) -> float:
    """Return the largest difference relative to the largest entry. Collective."""
    gap, size = np.abs(one - other).max(initial=0.0), np.abs(one).max(initial=0.0)
    return comm.allreduce(gap, op=MPI.MAX) / comm.allreduce(size, op=MPI.MAX)


def draw(
    path: Path, arguments: argparse.Namespace, drawn: list[tuple[str, dict[str, Any]]]
) -> None:
    """Plot pressure and friction along the flank. On this rank."""
    corner = np.array([arguments.c / 2, 0.0])
    with plotting.figure(path) as axes:
        for colour, (label, points) in zip(("#9a9a9a", "#1f5fa8"), drawn, strict=True):
            s = np.linalg.norm(points["x"] - corner, axis=1)
            order = np.argsort(s)
            pressure = points["pressure"][order]
            axes.plot(s[order], pressure, ".-", color=colour, label=f"pressure, {label}")
            if points["tangential_traction"].any():
                size = np.linalg.norm(points["tangential_traction"], axis=1)[order]
                axes.plot(s[order], size, ".-", color="#c8502a", label=f"friction, {label}")
        title = "Flank of the fitting under its pull"
        axes.set(xlabel="distance from the neck along the flank [mm]", title=title)
        axes.set(ylabel="traction [daN/mm²]", ylim=(0, None))
        axes.grid(alpha=0.25)
        axes.legend()


def main() -> int:
    """Pull without and with friction; return 0 if all checks pass."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    lengths = {
        "a": (87.0, "top of the head"),
        "c": (43.0, "neck and shank"),
        "d": (148.0, "female plate"),
        "e": (60.0, "length of the shank"),
        "f": (40.0, "height of the head"),
        "g": (89.0, "height of the female plate"),
    }
    for name, (value, text) in lengths.items():
        parser.add_argument(f"--{name}", type=float, default=value, help=f"{text}, mm")
    parser.add_argument("--friction", type=float, default=0.2)
    parser.add_argument("--h", type=float, default=1.0, help="cell size along the flank, mm")
    parser.add_argument("--degree", type=int, default=2, help="degree of the displacement")
    parser.add_argument("--increments", type=int, default=5, help="of the run that has several")
    parser.add_argument("--output", type=Path, default=Path("output/fitting"), help="folder")
    arguments, _ = parser.parse_known_args()
    if not (arguments.d > arguments.a > arguments.c and arguments.g > arguments.f + CLEARANCE):
        parser.error(f"the fitting needs d > a > c and g > f + {CLEARANCE:g}")
    start, comm, folder = time.perf_counter(), MPI.COMM_WORLD, arguments.output
    fitting, friction = Fitting(arguments), arguments.friction
    angle = np.arctan2((arguments.a - arguments.c) / 2, arguments.f)
    half = LOAD * THICKNESS * arguments.c / 2

    smooth = fitting.pull(0.0, LOAD)[0].contacts[0]
    drawn = [("μ = 0", smooth.gather())]
    without = smooth.resultants().normal_force
    _, twice = fitting.pull(friction, 2 * LOAD)
    _, often = fitting.pull(friction, LOAD, arguments.increments)
    problem, once = fitting.pull(friction, LOAD)
    (contact,) = problem.contacts
    drawn.append((f"μ = {friction:g}", contact.gather()))
    forces = contact.resultants()
    normal = forces.normal_force
    sine, part = np.sin(angle), friction * np.cos(angle)
    least, most = half / (sine + part), half / (sine - part) if sine > part else np.inf
    values = {
        "vertical force on a flank [daN]": forces.force[1],
        "half of the top reaction [daN]": fitting.reaction(),
        "normal force, μ = 0 [daN]": without,
        "normal force below the lower bound, relative": max(0.0, 1 - normal / least),
        "normal force above the upper bound, relative": max(0.0, normal / most - 1),
        "twice the load, relative difference": differ(comm, 2 * once, twice),
        f"{arguments.increments} increments, relative difference": differ(comm, once, often),
    }
    exact = (half, half, half / sine, 0.0, 0.0, 0.0, 0.0)
    allowed = (EQUILIBRIUM,) * 5 + (SAME,) * 2
    references = dict(zip(values, zip(exact, allowed, strict=True), strict=True))
    result = {
        "references": output.compare(values, references),
        "flank_angle_degrees": float(np.degrees(angle)),
        "pull": 2 * half,
        "normal_force": normal,
        "normal_force_bounds": [least, most if np.isfinite(most) else None],
        "tangential_force": forces.tangential_force,
        "lateral_thrust": -forces.force[0],
        "closed_length": forces.area / THICKNESS,
        "largest_pressure": forces.max_pressure,
        "dofs": fitting.u.function_space.dofmap.index_map.size_global * 2,
        "wall_seconds": time.perf_counter() - start,
    }
    fc.Writer(folder, problem, stress=fitting.body.stress).write(LOAD)
    output.write_json(folder / "result.json", result, comm)
    title = f"Male-female fitting (right half), μ = {friction:g}"
    plotting.plot_deformation(folder / "mesh.png", fitting.u, title=title, magnification=50)
    if comm.rank == 0:
        draw(folder / "flank.png", arguments, drawn)
        print(f"{result['dofs']} dofs, {result['wall_seconds']:.2f} s")
        print(f"flanks at {np.degrees(angle):.2f}° to the pull of {2 * half:.6g} daN", end=", ")
        print(f"μ = {friction:g}")
        print(f"N = {normal:.6g} per flank, statics allows {least:.6g} to {most:.6g};", end=" ")
        print(f"T = {forces.tangential_force:.6g}, thrust {-forces.force[0]:.6g} daN")
        print(f"{result['closed_length']:.2f} mm of {arguments.f / np.cos(angle):.2f} mm closed")
        print(output.table(result["references"]))
    return 0 if all(e["passed"] for e in result["references"].values()) else 1


if __name__ == "__main__":
    sys.exit(main())
