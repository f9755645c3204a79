"""Capstan: a rubber band over a rotating drum that pulls it by friction.

Plane strain, neo-Hookean; lengths in mm, stresses in MPa, forces per mm of width. The band
(E = 10, ν = 0.45) lies on the upper half of a rigid drum (R = 10), its tails hang down on both
sides. A weight loads one of them with T1, the end of the other one is fixed. The drum rotates away
from the fixed end until the whole band slips, and further: the band is stretched by a tenth, and
the drum slides below it.

    python demos/capstan.py
    python demos/capstan.py --thickness 0.5 --cells 40
    mpirun -n 2 python demos/capstan.py

Reference: the capstan equation of Euler and Eytelwein, T2/T1 = exp(μφ), φ = π, for a band without
thickness. In a band of thickness t the tension acts at R + t/2, but friction at R: if the curvature
is constant, the moment on a piece of it is in equilibrium if (R + t/2) dT = μ R q dφ, with the
contact force q dφ. The exponent is therefore smaller than Eytelwein's by t/(2R) (relative); bending
at both ends of the contact has an effect of this order, too. The checks are that the exponent
differs by at most 1.25 t/(2R), that it tends to Eytelwein's with t (extrapolated from the two
thinnest bands; tolerance: the product of both t/R), p R/T in the middle of the drum (2 %, as q and
T differ for the thickest) and the torque, (T2 - T1)(R + t/2) (0.5 %). The exit code is 1 if one of
them fails.
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

E, NU, MU, R, TAIL = 10.0, 0.45, 0.3, 10.0, 10.0
STRAIN = 0.05  # T1 / (E t), so that bands of all thicknesses stretch equally
HELD, PULLED, INNER = 1, 2, 3
TIGHT = 0.995  # radius of the band relative to the drum's: initially in contact along the drum
EYTELWEIN = float(np.exp(MU * np.pi))
# Rotation of the drum (rad) at the ends of increments: small ones while slip spreads, then larger
# ones below the slipping band. Slip in an increment Δ is along its chord, so that the tangential
# friction lacks 1 - cos(Δ/2) of its magnitude: the last increment is small.
TURN = (*(0.01 * np.arange(1, 21)), 0.6, 1.2, 1.8, 2.4, 3.0, 3.01)


@dataclass
class Run:
    """The results for one band.

    Attributes:
        path: Rotation of the drum (rad) and T2/T1 after every increment.
        points: Result of `Contact.gather` at the end.
        angle: Angular position of the points on the drum at the end (rad), 0 on the side of T2.
        pressure: True pressure at the points, per deformed area.
        torque: Torque on the band.
    """

    thickness: float
    tension: float
    problem: fc.ContactProblem
    rubber: NeoHookean
    dofs: int
    path: list[tuple[float, float]] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)
    angle: np.ndarray = field(default_factory=lambda: np.empty(0))
    pressure: np.ndarray = field(default_factory=lambda: np.empty(0))
    torque: float = 0.0

    @property
    def ratio(self) -> float:
        """The ratio T2/T1 at the end."""
        return self.path[-1][1]


def make_mesh(thickness: float, cells: int) -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags]:
    """Mesh the band with cells curved like the drum, ``cells`` per quarter of it. Collective."""
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.add("band")
        if MPI.COMM_WORLD.rank == 0:
            geo, outer = gmsh.model.geo, R + thickness
            centre = geo.addPoint(0, 0, 0)
            # Five cross-sections, from the fixed end to the weight, and four pieces between them.
            sections = [
                (geo.addPoint(x * R, y, 0), geo.addPoint(x * outer, y * far, 0))
                for x, y, far in ((1, -TAIL, 1), (1, 0, 1), (0, R, outer / R), (-1, 0, 1))
            ]
            sections.append((geo.addPoint(-R, -TAIL, 0), geo.addPoint(-outer, -TAIL, 0)))
            across = [geo.addLine(*section) for section in sections]
            inner, pieces = [], []
            for i in range(4):
                (a, b), (c, d) = sections[i], sections[i + 1]
                if i in (1, 2):
                    low, high = geo.addCircleArc(a, centre, c), geo.addCircleArc(b, centre, d)
                else:
                    low, high = geo.addLine(a, c), geo.addLine(b, d)
                inner.append(low)
                loop = geo.addCurveLoop([across[i], high, -across[i + 1], -low])
                pieces.append(geo.addPlaneSurface([loop]))
                number = cells if i in (1, 2) else round(cells * TAIL / (R * np.pi / 2))
                for line in (low, high):
                    geo.mesh.setTransfiniteCurve(line, number + 1)
            for line in across:
                geo.mesh.setTransfiniteCurve(line, 3)
            for piece in pieces:
                geo.mesh.setTransfiniteSurface(piece)
                geo.mesh.setRecombine(2, piece)
            geo.synchronize()
            gmsh.model.addPhysicalGroup(2, pieces, 1)
            gmsh.model.addPhysicalGroup(1, [across[0]], HELD)
            gmsh.model.addPhysicalGroup(1, [across[-1]], PULLED)
            gmsh.model.addPhysicalGroup(1, inner, INNER)
            gmsh.model.mesh.generate(2)
            gmsh.model.mesh.setOrder(2)
        mesh, _, tags = fc.model_to_mesh(gmsh.model, MPI.COMM_WORLD, gdim=2)
        mesh.geometry.x[:] *= TIGHT
        return mesh, tags
    finally:
        gmsh.finalize()


def solve(thickness: float, cells: int) -> Run:
    """Apply the weight to the band, then rotate the drum. Collective."""
    mesh, tags = make_mesh(thickness, cells)
    V = fem.functionspace(mesh, ("Lagrange", 2, (2,)))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    rubber = NeoHookean(u, E, NU, "plane strain")
    weight, angle = fem.Constant(mesh, 0.0), fem.Constant(mesh, 0.0)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags)
    F = rubber.residual(v) + weight / thickness * v[1] * ds(PULLED)
    # Both ends have zero horizontal displacement.
    held = fem.locate_dofs_topological(V.sub(1), 1, tags.find(HELD))
    led = fem.locate_dofs_topological(
        V.sub(0), 1, np.concatenate([tags.find(HELD), tags.find(PULLED)])
    )
    bcs = [fem.dirichletbc(0.0, held, V.sub(1)), fem.dirichletbc(0.0, led, V.sub(0))]

    drum = fc.Cylinder((0, 0), R, rotation=fc.Rotation(angle, about=(0, 0)))
    surface = fc.ContactSurface(mesh, tags, INNER)
    # Twenty times the stiffness E t/R² of the band as a hoop under pressure. A stiffer penalty has
    # no advantage: the contact angle of the band does not depend on a small penetration.
    stiffness = 20 * E * thickness / R**2
    friction = fem.Constant(mesh, 0.0)  # frictionless until the weight acts
    law = fc.Coulomb(friction, stiffness, stiffness)
    contact = fc.Contact(u, surface, drum, law, kinematics="finite")
    problem = fc.ContactProblem(F, u, bcs=bcs, contacts=[contact])

    # T2 is minus the virtual work of the stresses in a unit displacement of the fixed end upwards.
    lift = fem.Function(V)
    lift.x.array[held] = 1.0
    reaction = fem.form(ufl.action(rubber.residual(v), lift))

    tension = STRAIN * E * thickness
    run = Run(thickness, tension, problem, rubber, V.dofmap.index_map.size_global * 2)
    for step in fc.increments(problem, weight, 0.0, tension):
        run.iterations.append(step.iterations)
    friction.value = MU
    turning = fc.increments(
        problem, angle, 0.0, TURN[-1], steps=TURN, progress=f"t = {thickness:g}"
    )
    for step in turning:
        run.iterations.append(step.iterations)
        drawn = -mesh.comm.allreduce(fem.assemble_scalar(reaction))
        run.path.append((step.load, drawn / tension))
    run.torque = float(contact.moment((0, 0))[0])
    run.angle, run.pressure = along_the_drum(contact)
    return run


def along_the_drum(contact: fc.Contact) -> tuple[np.ndarray, np.ndarray]:
    """Return angle and true pressure of closed points on all ranks, sorted by angle. Collective."""
    closed = contact.pressure > 0
    _, normal = contact.true_placement()  # into the drum
    angle = np.arctan2(-normal[closed, 1], -normal[closed, 0])
    pressure = (contact.pressure / contact.area_stretch())[closed]
    angle[angle < -np.pi / 2] += 2 * np.pi  # points on the tail with the weight
    rows = MPI.COMM_WORLD.allgather(np.stack([angle, pressure]))
    angle, pressure = np.concatenate(rows, axis=1)
    order = np.argsort(angle)
    return angle[order], pressure[order]


def compare(runs: list[Run]) -> dict[str, Any]:
    """Compare the bands with their references."""
    values, references = {}, {}
    for run in runs:
        t = f"t = {run.thickness:g}"
        values[f"ln(T2/T1), {t}"] = float(np.log(run.ratio))
        references[f"ln(T2/T1), {t}"] = (MU * np.pi, 1.25 * run.thickness / (2 * R))
        # In the middle, away from the ends of the contact, where the curvature changes.
        middle = np.abs(run.angle - np.pi / 2) < np.pi / 6
        tension = run.tension * run.ratio ** (1 - run.angle[middle] / np.pi)
        values[f"p R/T, {t}"] = float(np.mean(run.pressure[middle] * R / tension))
        references[f"p R/T, {t}"] = (1.0, 0.02)
        values[f"torque [N], {t}"] = abs(run.torque)
        arm = R + run.thickness / 2
        references[f"torque [N], {t}"] = ((run.ratio - 1) * run.tension * arm, 0.005)
    if len(runs) > 1:
        (thick, much), (thin, less) = ((run.thickness, np.log(run.ratio)) for run in runs[-2:])
        values["ln(T2/T1), t to 0"] = (thick * less - thin * much) / (thick - thin)
        references["ln(T2/T1), t to 0"] = (MU * np.pi, thick * thin / R**2)
    return output.compare(values, references)


def draw(path: Path, runs: list[Run]) -> None:
    """Plot pressure along the drum, and tension ratio over its rotation. On this rank."""
    with plotting.figure(path, 2) as (left, right):
        at = np.linspace(0, np.pi, 200)
        for run in runs:
            label = f"t = {run.thickness:g} mm"
            scaled = run.pressure * R / run.tension
            left.plot(np.degrees(run.angle), scaled, ".", ms=3, label=label)
            turn, ratio = np.degrees([a for a, _ in run.path]), [r for _, r in run.path]
            right.plot(turn, ratio, ".-", label=label)
        left.plot(np.degrees(at), np.exp(MU * (np.pi - at)), "k--", label="Eytelwein")
        left.set(xlabel="angle from the held side [°]", ylabel="true pressure p R / T1 [–]")
        left.set(title=f"Pressure on the drum, μ = {MU:g}", ylim=(0, 1.15 * EYTELWEIN))
        right.axhline(EYTELWEIN, color="k", ls="--", label="exp(μπ)")
        right.set(xlabel="turn of the drum [°]", ylabel="T2 / T1 [–]", ylim=(0.9, None))
        right.set(title="Tension of the held end over the weight")
        for ax in (left, right):
            ax.grid(alpha=0.25)
            ax.legend()


def main() -> int:
    """Rotate the drum below every band, write all results; return 0 if every reference is met."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument(
        "--thickness", type=float, nargs="+", default=[1.0, 0.5, 0.25], help="of the bands, mm"
    )
    parser.add_argument("--cells", type=int, default=16, help="cells on a quarter of the drum")
    parser.add_argument("--output", type=Path, default=Path("output/capstan"), help="folder")
    arguments, _ = parser.parse_known_args()
    start = time.perf_counter()
    runs = [solve(thickness, arguments.cells) for thickness in arguments.thickness]
    comm, last = MPI.COMM_WORLD, runs[-1]
    result: dict[str, Any] = {
        "references": compare(runs),
        "eytelwein": EYTELWEIN,
        "dofs": last.dofs,
        "iterations": [run.iterations for run in runs],
        "paths": [run.path for run in runs],
        "wall_seconds": time.perf_counter() - start,
    }
    fc.Writer(arguments.output, last.problem, stress=last.rubber.stress).write(TURN[-1])
    plotting.plot_deformation(
        arguments.output / "band.png", runs[0].problem.u, title=f"t = {runs[0].thickness:g} mm"
    )
    if comm.rank == 0:
        print(output.table(result["references"]))
        draw(arguments.output / "capstan.png", runs)
    output.write_json(arguments.output / "result.json", result, comm)
    return 0 if all(entry["passed"] for entry in result["references"].values()) else 1


if __name__ == "__main__":
    sys.exit(main())
