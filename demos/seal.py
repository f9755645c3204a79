"""Seal: a rubber ring closed by a lid, between flat plates and in a groove.

Axisymmetric, nearly incompressible neo-Hookean rubber (ν = 0.4999), Taylor-Hood elements for
displacement and pressure; lengths in mm, stresses in MPa, forces per mm of the ring. A rigid lid
compresses the ring (section D = 5, mean radius 15, E = 6) by a quarter of D. The ring lies on a
plate, where it can expand freely, or in a groove of width 1.15 D, a rigid profile with rounded
corners, whose outer wall it touches. All contacts are frictionless.

    python demos/seal.py
    python demos/seal.py --cells 12
    mpirun -n 2 python demos/seal.py

References: for the ring between plates P. B. Lindley's formula (Compression characteristics of
laterally-unrestrained rubber O-rings, J. Inst. Rubber Ind. 1, 1967), with the squeeze c, the
displacement of the lid divided by D,

    F = E D (1.25 c^1.5 + 50 c^6),

a fit for rings, here from c = 0.15 on (5 %; a narrower contact is stiffer than any power of c); and
Hertz's peak pressure for the computed force at the first squeeze, 0.02 (3 %: the half-width is
R/10, about a facet of the finer mesh). For both seals the forces on lid and bed are equal (1e-6),
and cells of half the size change the force by less than 1 % and the peak by less than 2 %. The exit
code is 1 if one of them is missed.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import basix.ufl
import dolfinx
import gmsh
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact import output, plotting
from fenics_contact.elasticity import NeoHookean

D, E, NU, RING = 5.0, 6.0, 0.4999, 15.0
R = D / 2
WIDTH, CORNER = 1.15 * D, 0.1 * D  # width of the groove, radius of its corners
CLOSING = (0.02, 0.05, *(0.025 * np.arange(3, 11)))  # c at the ends of increments
SQUEEZE = CLOSING[-1]
RIM = 1


def lindley(c: Any) -> Any:
    """Return the force on a ring between flat plates at the squeeze c (force per length)."""
    return E * D * (1.25 * c**1.5 + 50 * c**6)


def groove() -> np.ndarray:
    """Return points of the groove, from the outer wall to the inner wall, (n, 2)."""
    side = np.linspace(1.3 * D, CORNER, 40, endpoint=False)
    turn = np.linspace(0, np.pi / 2, 24, endpoint=False)
    floor = WIDTH / 2 - CORNER
    wall = np.column_stack([np.full_like(side, WIDTH / 2), side])
    corner = CORNER * np.column_stack([np.cos(turn), 1 - np.sin(turn)]) + [floor, 0]
    outer = np.concatenate([wall, corner, [[x, 0.0] for x in np.linspace(floor, 0, 20)]])
    inner = outer[-2::-1] * [-1, 1]
    return np.concatenate([outer, inner]) + np.array([RING, 0.0])


@dataclass
class Run:
    """The results for one seal.

    Attributes:
        squeeze: c after every increment.
        lid, bed: Forces of the lid, downwards, and of plate or groove, upwards, divided by the
            undeformed length of the ring (force per length).
        peak: Largest true pressure under the lid.
        place: Present radius r of the points under the lid at the end.
        pressure: True pressure at these points.
    """

    name: str
    cells: int
    problem: fc.ContactProblem
    rubber: NeoHookean
    dofs: int
    squeeze: list[float] = field(default_factory=list)
    lid: list[float] = field(default_factory=list)
    bed: list[float] = field(default_factory=list)
    peak: list[float] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)
    place: np.ndarray = field(default_factory=lambda: np.empty(0))
    pressure: np.ndarray = field(default_factory=lambda: np.empty(0))


def make_mesh(cells: int) -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags]:
    """Mesh the section with curved cells, ``cells`` per radius, coarser inside. Collective."""
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 0)
        gmsh.model.add("section")
        if MPI.COMM_WORLD.rank == 0:
            occ = gmsh.model.occ
            rim = occ.addCircle(RING, R, 0, R)
            occ.addCurveLoop([rim], 1)
            section = occ.addPlaneSurface([1])
            occ.synchronize()

            def size(dim: int, tag: int, x: float, y: float, z: float, lc: float) -> float:
                inside = R - float(np.hypot(x - RING, y - R))
                return R / cells + 0.4 * max(0.0, inside)

            gmsh.model.mesh.setSizeCallback(size)
            gmsh.model.addPhysicalGroup(2, [section], 1)
            gmsh.model.addPhysicalGroup(1, [rim], RIM)
            gmsh.model.mesh.generate(2)
            gmsh.model.mesh.setOrder(2)
        mesh, _, tags = fc.model_to_mesh(gmsh.model, MPI.COMM_WORLD, gdim=2)
        return mesh, tags
    finally:
        gmsh.finalize()


def solve(name: str, cells: int) -> Run:
    """Compress a seal, and return its results. Collective."""
    mesh, tags = make_mesh(cells)
    shape = mesh.topology.cell_name()
    displacements = basix.ufl.element("P", shape, 2, shape=(2,))
    W = fem.functionspace(
        mesh, basix.ufl.mixed_element([displacements, basix.ufl.element("P", shape, 1)])
    )
    w = fem.Function(W)
    (u, p), (v, q) = ufl.split(w), ufl.TestFunctions(W)
    rubber = NeoHookean(u, E, NU, "axisymmetric", pressure=p)
    dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": 4})

    closing = fem.Constant(mesh, 0.0)
    lid = fc.HalfSpace((0, D), (0, -1), displacement=ufl.as_vector([0, -closing]))
    bed = fc.RigidProfile(groove()) if name == "in a groove" else fc.HalfSpace((0, 0), (0, 1))
    surface = fc.ContactSurface(mesh, tags, RIM)
    contacts = [
        fc.Contact(
            u,
            surface,
            obstacle,
            fc.Frictionless(fc.RelativeStiffness(50)),
            kinematics="finite",
            weight=rubber.weight,
            name=called,
        )
        for called, obstacle in (("lid", lid), ("bed", bed))
    ]
    # Only the two contacts constrain the ring.
    problem = fc.ContactProblem(rubber.residual(v, dx, q=q), w, contacts=contacts)

    length = 2 * np.pi * RING
    run = Run(name, cells, problem, rubber, W.dofmap.index_map.size_global)
    ends = D * np.array(CLOSING)
    history: Any = fc.increments(problem, closing, 0.0, ends[-1], steps=ends, progress=name)
    for step in history:
        run.iterations.append(step.iterations)
        run.squeeze.append(step.load / D)
        run.lid.append(-float(contacts[0].resultants().force[1]) / length)
        run.bed.append(float(contacts[1].resultants().force[1]) / length)
        run.place, run.pressure = under(contacts[0])
        run.peak.append(float(run.pressure.max()))
    return run


def under(contact: fc.Contact) -> tuple[np.ndarray, np.ndarray]:
    """Return present r and true pressure of closed points, sorted by r. Collective."""
    r, along = contact.points[:, 0], contact.pairs.own_displacement()[:, 0]
    # The area stretches along the section and circumferentially.
    pressure = contact.pressure / (contact.area_stretch() * (1 + along / r))
    closed = contact.pressure > 0
    rows = MPI.COMM_WORLD.allgather(np.stack([(r + along)[closed], pressure[closed]]))
    place, pressure = np.concatenate(rows, axis=1)
    order = np.argsort(place)
    return place[order], pressure[order]


def compare(runs: list[Run]) -> dict[str, Any]:
    """Compare the finer mesh with formulas, and the coarser mesh with the finer one."""
    values, references = {}, {}
    coarse, fine = runs[::2], runs[1::2]
    plates = fine[0]
    for c in (0.15, 0.2, 0.25):
        name = f"force at c = {c:g} [N/mm]"
        values[name] = plates.lid[int(np.argmin(np.abs(np.array(plates.squeeze) - c)))]
        references[name] = (float(lindley(c)), 0.05)
    # Hertz for a cylinder of radius R on a rigid plane, in plane strain.
    star = E / (1 - NU**2)
    values["peak at c = 0.02 [MPa]"] = plates.peak[0]
    references["peak at c = 0.02 [MPa]"] = (
        float(np.sqrt(plates.lid[0] * star / (np.pi * R))),
        0.03,
    )
    for one, other in zip(coarse, fine, strict=True):
        values[f"reaction of the base / lid, {one.name}"] = one.bed[-1] / one.lid[-1]
        references[f"reaction of the base / lid, {one.name}"] = (1.0, 1e-6)
        values[f"force [N/mm], {one.name}"] = one.lid[-1]
        references[f"force [N/mm], {one.name}"] = (other.lid[-1], 0.01)
        values[f"peak [MPa], {one.name}"] = one.peak[-1]
        references[f"peak [MPa], {one.name}"] = (other.peak[-1], 0.02)
    return output.compare(values, references)


def draw(path: Path, runs: list[Run]) -> None:
    """Plot force over squeeze, and pressure under the lid at the end. On this rank."""
    with plotting.figure(path, 2) as (left, right):
        at = np.linspace(0, SQUEEZE, 100)
        left.plot(at, lindley(at), "k--", label="Lindley, between plates")
        for run, colour in zip(runs[1::2], ("#1f5fa8", "#c4482f"), strict=True):
            left.plot(run.squeeze, run.lid, ".-", color=colour, label=run.name)
            right.plot(run.place - RING, run.pressure, ".-", color=colour, label=run.name)
        left.set(xlabel="squeeze c = closing / D [–]", ylabel="force of the lid [N per mm of ring]")
        left.set(title=f"O-ring, D = {D:g} mm, E = {E:g} MPa, ν = {NU:g}")
        right.set(xlabel="r - mean radius of the ring [mm]", ylabel="true pressure [MPa]")
        right.set(title=f"Pressure under the lid at c = {SQUEEZE:g}", ylim=(0, None))
        for ax in (left, right):
            ax.grid(alpha=0.25)
            ax.legend()


def main() -> int:
    """Compress both seals on two meshes, write results; return 0 if every reference is met."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument(
        "--cells", type=int, default=6, help="per radius at the rim; and twice as many"
    )
    parser.add_argument("--output", type=Path, default=Path("output/seal"), help="folder")
    arguments, _ = parser.parse_known_args()
    start, number = time.perf_counter(), arguments.cells
    runs = [
        solve(name, n) for name in ("between plates", "in a groove") for n in (number, 2 * number)
    ]
    comm, last = MPI.COMM_WORLD, runs[-1]
    result: dict[str, Any] = {
        "references": compare(runs),
        "dofs": last.dofs,
        "iterations": [run.iterations for run in runs],
        "squeeze": last.squeeze,
        "forces": {run.name: run.lid for run in runs[1::2]},
        "wall_seconds": time.perf_counter() - start,
    }
    fc.Writer(arguments.output, last.problem, stress=last.rubber.stress).write(CLOSING[-1])
    plotting.plot_deformation(
        arguments.output / "section.png",
        runs[-2].problem.displacement.u,
        title="In a groove, one with the lid closed",
    )
    if comm.rank == 0:
        print(output.table(result["references"]))
        draw(arguments.output / "seal.png", runs)
    output.write_json(arguments.output / "result.json", result, comm)
    return 0 if all(entry["passed"] for entry in result["references"].values()) else 1


if __name__ == "__main__":
    sys.exit(main())
