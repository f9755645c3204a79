"""Tapered pin: pressed into a hub, released and pulled out, dry and lubricated.

Axisymmetric, lengths in mm, stresses in MPa, forces in N. A solid steel pin stands in the taper
1:50 of a thick steel hub (slope of the flanks t = tan α = 0.01, mean radius 10, length 40, outer
radius 30), without pressure. It is driven in by s = 2, until its ends are level with those of the
hub: its flank slides over several facets of the bore and reaches the interference s t = 0.02.

    python demos/tapered_pin.py
    python demos/tapered_pin.py --slope 0.02 --oil 0.01
    mpirun -n 2 python demos/tapered_pin.py

Three histories: dry (μ = 0.15 > t) with prescribed displacements of both ends of the pin, in, and
back until the pin is out; dry with a force, half of it on each end, that is applied and removed;
and the same with oil between pin and hub (μ = 0.005 < t), which is injected to separate joints.

References: Lamé's thick rings, applied to slices along the taper. The ends of the hub are on
rollers (plane strain); those of the pin are prescribed (plane strain) or free (plane stress).
Friction strains the pin antisymmetrically about its middle, which does not change the mean over the
joint; the pressure varies along the joint, with dry friction by an eighth at the ends. With Q the
radial force on the whole joint, pressure times area is Q / (cos α (1 ∓ μ t)), the upper sign for
insertion, and the forces are

    in: Q tan(φ + α),    out: Q tan(φ - α),    tan φ = μ.

With μ > t the pin remains when the force is removed, and must be pulled. With μ < t the extraction
force is negative: only a push of more than tan(α - φ) / tan(α + φ), a third of the insertion force,
keeps the pin in, and below it the pin comes out in proportion to the force.

Lamé's slices are valid if pin and hub are level, at the end of the insertion; there the tolerance
is 0.5 %: axial displacements of the flanks change the interference by 0.2 %, cells and penalty by
0.1 %. Before, each of the uncovered ends, of length e, is loaded by the adjacent material, and the
joint is stiffer by up to e over its length. The exit code is 1 if a reference is missed.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import dolfinx
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact import output, plotting
from fenics_contact.elasticity import LinearElastic

E, NU, OVERSIZE = 210e3, 0.3, 0.02
R, OUTER, LENGTH = 10.0, 30.0, 40.0
BOTTOM, TOP, INSIDE, OUTSIDE = 1, 2, 3, 4
REVERSAL = 0.006  # displacement of a friction reversal, relative to the insertion
N_REVERSAL = 6


@dataclass(frozen=True)
class Joint:
    """The reference solution of a joint by Lamé's slices.

    Attributes:
        slope: Slope of the flanks, tan α.
        friction: Friction coefficient μ.
        free_ends: Whether the ends of the pin are free: plane stress, otherwise plane strain.
    """

    slope: float
    friction: float
    free_ends: bool

    @property
    def insertion(self) -> float:
        """The insertion that produces the full interference (length)."""
        return OVERSIZE / self.slope

    def lame(self, s: float, z: np.ndarray) -> np.ndarray:
        """Return the radial traction between pin and hub at the heights ``z`` (stress)."""
        r = R + self.slope * (z - LENGTH / 2)
        modulus, nu = E / (1 - NU**2), NU / (1 - NU)  # for plane strain
        hub = ((OUTER**2 + r**2) / (OUTER**2 - r**2) + nu) / modulus
        pin = (1 - NU) / E if self.free_ends else (1 - nu) / modulus
        return s * self.slope / (r * (hub + pin))

    def pressure(self, s: float, z: np.ndarray, direction: int) -> np.ndarray:
        """Return the pressure on the flank (stress).

        ``direction`` is 1 for insertion and -1 for extraction.
        """
        return self.lame(s, z) / (1 - direction * self.friction * self.slope)

    def mean_pressure(self, s: float, direction: int) -> float:
        """Return the mean pressure over the area of the joint (stress)."""
        z = np.linspace(0, LENGTH, 201)
        r = R + self.slope * (z - LENGTH / 2)
        return float(np.trapezoid(r * self.pressure(s, z, direction), z) / np.trapezoid(r, z))

    def force(self, s: float, direction: int) -> float:
        """Return the force on the pin at the insertion ``s``; a push is positive (force).

        ``direction`` is 1 for insertion and -1 for extraction.
        """
        z = np.linspace(0, LENGTH, 201)
        r = R + self.slope * (z - LENGTH / 2)
        covered = 1 - (self.insertion - s) / LENGTH
        radial = covered * float(np.trapezoid(2 * np.pi * r * self.lame(s, z), z))
        return radial * self.tangent(direction)

    def tangent(self, direction: int) -> float:
        """Return the ratio tan(α ± φ) of axial to radial force."""
        t, m = self.slope, direction * self.friction
        return (t + m) / (1 - t * m)


@dataclass
class Scene:
    """Pin and hub, their contact, and the results.

    Attributes:
        joint: The reference solution.
        displacement: Prescribed axial displacement of the ends of the pin (length).
        traction: Traction on both ends of the pin, downwards (stress).
        path: Load parameter, insertion and push after every increment; a pull is negative.
        pressures: By name, heights of the points of the joint, and their pressure.
    """

    joint: Joint
    steel: LinearElastic
    problem: fc.ContactProblem
    displacement: fem.Constant
    traction: fem.Constant
    path: list[tuple[float, float, float]] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)
    pressures: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    mean_pressure: dict[str, float] = field(default_factory=dict)
    dissipation: float = 0.0

    def solve_increments(self, steps: list[float]) -> None:
        """Solve increments that end at ``steps``. Collective.

        These are insertions, or, with free ends, fractions of the full insertion force.
        """
        joint, contact = self.joint, self.problem.contacts[0]
        area = np.pi * sum(
            (R + joint.slope * (z - LENGTH / 2)) ** 2
            for z in (joint.insertion, joint.insertion + LENGTH)
        )
        most = joint.force(joint.insertion, 1)

        def load(value: float) -> None:
            if joint.free_ends:
                self.traction.value = value * most / area
            else:
                self.displacement.value = -value

        start = self.path[-1][0] if self.path else 0.0
        words = f"μ = {joint.friction:g}, {'force' if joint.free_ends else 'way'}"
        history = fc.increments(self.problem, load, start, steps[-1], steps=steps, progress=words)
        for step in history:
            # Friction strains the pin antisymmetrically: the mean does not change.
            ends = [
                output.at_node(self.problem.u, (0.0, z))[1]
                for z in (joint.insertion, joint.insertion + LENGTH)
            ]
            push = float(contact.resultants().force[1])
            self.path.append((step.load, -float(np.mean(ends)), push))
            self.iterations.append(step.iterations)
            self.dissipation += step.energy.dissipation

    def store_pressure(self, name: str) -> None:
        """Store the present pressure along the joint. Collective."""
        points = self.problem.contacts[0].gather()
        order = np.argsort(points["x"][:, 1])
        z, pressure = points["x"][order, 1] - self.path[-1][1], points["pressure"][order]
        self.pressures[name] = (z, pressure)
        area = 2 * np.pi * R * LENGTH * np.hypot(1, self.joint.slope)
        self.mean_pressure[name] = float(points["pressure"] @ points["measure"] / area)

    def at(self, load: float) -> tuple[float, float]:
        """Return insertion and push at the last time that the load parameter was ``load``."""
        return next((s, f) for q, s, f in reversed(self.path) if abs(q - load) < 1e-9)


def block(
    flanks: tuple[tuple[float, float], tuple[float, float]],
    heights: tuple[float, float],
    cells: tuple[int, int],
) -> tuple[dolfinx.mesh.Mesh, None, dolfinx.mesh.MeshTags]:
    """Mesh a section between two flanks, each a radius at z = LENGTH/2 and a slope. Collective."""
    low, high = heights
    mesh = dolfinx.mesh.create_rectangle(
        MPI.COMM_WORLD, [(0, low), (1, high)], cells, dolfinx.mesh.CellType.quadrilateral
    )
    facets = dolfinx.mesh.locate_entities_boundary(mesh, 1, lambda x: np.isfinite(x[0]))
    x, z, _ = dolfinx.mesh.compute_midpoints(mesh, 1, facets).T
    sides = [np.isclose(z, low), np.isclose(z, high), np.isclose(x, 0), np.isclose(x, 1)]
    tags = np.select(sides, [BOTTOM, TOP, INSIDE, OUTSIDE]).astype(np.int32)
    share, z = mesh.geometry.x[:, 0].copy(), mesh.geometry.x[:, 1]
    inner, outer = (r + slope * (z - LENGTH / 2) for r, slope in flanks)
    mesh.geometry.x[:, 0] = inner + (outer - inner) * share
    return mesh, None, dolfinx.mesh.meshtags(mesh, 1, facets, tags)


def make(joint: Joint, cells: int) -> Scene:
    """Create pin and hub at first contact, the pin higher by the full insertion. Collective."""
    # Cells of the pin, which has Γc, are half as long as those of the hub: with equal cells the
    # pressure scatters three times as much.
    flank, finer = (R, joint.slope), round(2.1 * cells)
    parts = {
        "hub": block((flank, (OUTER, 0.0)), (0.0, LENGTH), (6, cells)),
        "pin": block(((0.0, 0.0), flank), (joint.insertion, joint.insertion + LENGTH), (3, finer)),
    }
    joined = fc.join_meshes(parts)
    mesh = joined.mesh
    V = fem.functionspace(mesh, ("Lagrange", 2, (2,)))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    # Small strains, as in Lamé's solution: the axial rigid-body motion of the pin does not matter.
    steel = LinearElastic(u, E, NU, "axisymmetric")
    displacement, traction = fem.Constant(mesh, 0.0), fem.Constant(mesh, 0.0)
    ends = tuple(joined.facet("pin", tag) for tag in (BOTTOM, TOP))
    rollers = tuple(joined.facet("hub", tag) for tag in (BOTTOM, TOP))

    def hold(i: int, tags: tuple[int, ...], value: Any) -> fem.DirichletBC:
        facets = np.concatenate([joined.facets.find(tag) for tag in tags])
        return fem.dirichletbc(value, fem.locate_dofs_topological(V.sub(i), 1, facets), V.sub(i))

    bcs = [hold(1, rollers, 0.0), hold(0, (joined.facet("pin", INSIDE),), 0.0)]
    F = steel.residual(v)
    if joint.free_ends:
        ds = ufl.Measure("ds", domain=mesh, subdomain_data=joined.facets)
        F += steel.weight * traction * v[1] * ds(ends)
    else:
        bcs.append(hold(1, ends, displacement))
    contact = fc.Contact(
        u,
        fc.ContactSurface(mesh, joined.facets, joined.facet("pin", OUTSIDE)),
        fc.DeformableBody(joined.facets, joined.facet("hub", INSIDE)),
        # A normal stiffness of 10 E/h would reduce the interference by 1 %. The low tangential one
        # yields by less than 1 µm, and friction reversals need fewer increments.
        fc.Coulomb(joint.friction, fc.RelativeStiffness(100), fc.RelativeStiffness(1)),
        kinematics="finite",
        weight=steel.weight,
    )
    problem = fc.ContactProblem(F, u, bcs=bcs, contacts=[contact], method="newton")
    return Scene(joint, steel, problem, displacement, traction)


def press_by_displacement(joint: Joint, cells: int) -> Scene:
    """Press the pin in and pull it out by prescribed displacements. Collective."""
    scene, s = make(joint, cells), joint.insertion
    # Increments of a fifth of a facet; during the friction reversal, of 0.001 of the insertion.
    number = 2 * int(np.ceil(s / (0.4 * LENGTH / cells)))
    insertions = [s * i / number for i in range(1, number + 1)]
    scene.solve_increments(insertions)
    scene.store_pressure("pushed")
    scene.solve_increments(
        [s * (1 - REVERSAL * i / N_REVERSAL) for i in range(1, 2 * N_REVERSAL + 1)]
    )
    scene.store_pressure("pulled")
    scene.solve_increments([*(x for x in reversed(insertions) if x < 0.98 * s), 0.0, -0.02 * s])
    return scene


def press_by_force(joint: Joint, cells: int) -> Scene:
    """Press the pin in by a force and remove the force. Collective.

    Load parameters are fractions of the full insertion force.
    """
    scene = make(joint, cells)
    scene.solve_increments([0.1 * i for i in range(1, 11)])
    scene.store_pressure("pushed")
    if joint.friction > joint.slope:
        scene.solve_increments([0.75, 0.5, 0.25, 0.0])
    else:
        hold = joint.tangent(-1) / joint.tangent(1)
        # From a tenth above the holding force to zero in equal steps.
        scene.solve_increments([1.1 * hold, *(hold * i / 10 for i in range(9, -1, -1))])
    return scene


def compare(dry: Scene, pushed: Scene, oiled: Scene) -> dict[str, Any]:
    """Compare the results with Lamé's and Coulomb's."""
    entries: dict[str, tuple[float, float, float]] = {}  # value, reference, tolerance
    joint, s = dry.joint, dry.joint.insertion
    # Length of each uncovered end at half depth, relative to the length of the joint.
    bare = s / 2 / LENGTH
    for name, way in (("pushed", 1), ("pulled", -1)):
        at = s if way == 1 else s * (1 - 2 * REVERSAL)
        value = dry.mean_pressure[name]
        motion = "insertion" if way == 1 else "extraction"
        entries[f"mean pressure, {motion} [MPa]"] = (value, joint.mean_pressure(at, way), 0.005)
        value = abs(dry.at(at)[1])
        entries[f"dry, {motion} force [N]"] = (value, abs(joint.force(at, way)), 0.005)
        # At half depth: the first such increment in insertion, the last one in extraction.
        rows = dry.path if way == 1 else dry.path[::-1]
        value = next(abs(f) for q, _, f in rows if abs(q - s / 2) < 1e-9)
        entries[f"dry, {motion} force at half depth [N]"] = (
            value,
            abs(joint.force(s / 2, way)),
            bare,
        )
    _, places, forces = np.array([(0.0, 0.0, 0.0), *dry.path]).T
    gone = int(np.argmax((places < s) & (forces < 0) & (np.arange(len(places)) > 0)))
    share = np.interp(0.0, forces[gone : gone - 2 : -1], places[gone : gone - 2 : -1]) / s
    entries["dry, relative depth after release"] = (float(share), 1.0, 0.005)
    entries["dry, force when extracted [N]"] = (forces[-1], 0.0, 1e-6 * joint.force(s, 1))
    work = float(np.trapezoid(forces, places))
    entries["external work / dissipation"] = (work / dry.dissipation, 1.0, 0.01)

    way = pushed.at(1.0)[0]
    entries["dry, prescribed force: depth [mm]"] = (way, s, 0.01)
    entries["dry, prescribed force: relative depth after release"] = (
        pushed.at(0.0)[0] / way,
        1.0,
        0.005,
    )
    way, hold = oiled.at(1.0)[0], oiled.joint.tangent(-1) / oiled.joint.tangent(1)
    entries["lubricated: depth [mm]"] = (way, s, 0.005)
    entries["lubricated: relative depth, holding force"] = (
        oiled.at(1.1 * hold)[0] / way,
        1.0,
        0.005,
    )
    for share in (0.5, 0.2):
        name = f"lubricated: relative depth, {share:g} of the holding force"
        entries[name] = (oiled.at(hold * share)[0] / way, share, (1 - share) * s / LENGTH)
    entries["lubricated: relative depth after release"] = (oiled.at(0.0)[0] / way, 0.0, 1e-6)
    # Between non-matching cells a stiff penalty makes the pressure scatter from point to point.
    z, pressure = oiled.pressures["pushed"]
    share = pressure / oiled.joint.pressure(s, z, 1)
    tenths = [share[np.floor(10 * z / LENGTH) == i].mean() for i in range(1, 9)]
    uneven = float(np.abs(np.array(tenths) - 1).max())
    entries["lubricated: variation of the pressure, 80 % of the length"] = (uneven, 0.0, 0.02)
    return output.compare(
        {name: value for name, (value, _, _) in entries.items()},
        {name: (reference, tolerance) for name, (_, reference, tolerance) in entries.items()},
    )


def draw(path: Path, dry: Scene, pushed: Scene, oiled: Scene) -> None:
    """Plot pressure along the joint, and forces over insertion. On this rank."""
    joint, s = dry.joint, dry.joint.insertion
    z = np.linspace(0, LENGTH, 200)
    x = np.linspace(0, s, 100)
    with plotting.figure(path, 3, (5.2, 4.6)) as (left, middle, right):
        colours = {"pushed": "#1f5fa8", "pulled": "#c8502a"}
        for name, colour in colours.items():
            left.plot(*dry.pressures[name], ".", ms=3, color=colour, label=f"dry, {name}")
        left.plot(*oiled.pressures["pushed"], ".", ms=3, color="#4a9a4a", label="oil, pushed")
        left.plot(z, joint.pressure(s, z, 1), "k--", label="Lamé, pin led")
        left.plot(z, oiled.joint.pressure(s, z, 1), "k:", label="Lamé, ends free")
        left.set(xlabel="height in the hub [mm]", ylabel="contact pressure [MPa]")
        left.set(title=f"Pressure along the joint, oversize {OVERSIZE:g} mm", ylim=(0, None))
        left.legend()
        _, places, forces = np.array([(0.0, 0.0, 0.0), *dry.path]).T
        middle.plot(places, forces / 1e3, ".-", color="#1f5fa8", label="led in and out")
        _, places, forces = np.array([(0.0, 0.0, 0.0), *pushed.path]).T
        middle.plot(places, forces / 1e3, "x", color="#c8502a", label="by force, ends free")
        _, places, forces = np.array([(0.0, 0.0, 0.0), *oiled.path]).T
        right.plot(places, forces / 1e3, ".-", color="#4a9a4a", label="pushed, released")
        for ax, one in ((middle, joint), (right, oiled.joint)):
            for direction in (1, -1):
                known = [one.force(at, direction) / 1e3 for at in x]
                label = "Q tan(φ ± α)" if direction == 1 else None
                ax.plot(x, known, "k--", lw=1, label=label)
            ax.axhline(0, color="k", lw=0.5)
            ax.set(xlabel="way of the pin s [mm]", ylabel="push (pull below zero) [kN]")
            ax.legend(loc="upper left")
        middle.set(title=f"Dry, μ = {joint.friction:g} > tan α = {joint.slope:g}: it stays")
        right.set(title=f"Oil, μ = {oiled.joint.friction:g} < tan α: it comes out")
        for ax in (left, middle, right):
            ax.grid(alpha=0.25)


def main() -> int:
    """Press the pin in and out in three cases; return 0 if every reference is met."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--slope", type=float, default=0.01, help="of the flanks, tan α")
    parser.add_argument("--friction", type=float, default=0.15, help="dry, above the slope")
    parser.add_argument("--oil", type=float, default=0.005, help="friction below the slope")
    parser.add_argument("--cells", type=int, default=40, help="of the hub along the joint")
    parser.add_argument("--output", type=Path, default=Path("output/tapered_pin"), help="folder")
    arguments, _ = parser.parse_known_args()
    slope, friction, oil = arguments.slope, arguments.friction, arguments.oil
    if not 0 < oil < slope < friction:
        parser.error("the pin needs 0 < oil < slope < friction")
    start, comm = time.perf_counter(), MPI.COMM_WORLD
    dry = press_by_displacement(Joint(slope, friction, free_ends=False), arguments.cells)
    pushed = press_by_force(Joint(slope, friction, free_ends=True), arguments.cells)
    oiled = press_by_force(Joint(slope, oil, free_ends=True), arguments.cells)
    result: dict[str, Any] = {
        "references": compare(dry, pushed, oiled),
        "dofs": dry.problem.u.function_space.dofmap.index_map.size_global * 2,
        "iterations": [one.iterations for one in (dry, pushed, oiled)],
        "paths": [one.path for one in (dry, pushed, oiled)],
        "wall_seconds": time.perf_counter() - start,
    }
    fc.Writer(arguments.output, pushed.problem, stress=pushed.steel.stress).write(1)
    if comm.rank == 0:
        print(f"{result['dofs']} dofs, {result['wall_seconds']:.1f} s")
        print(output.table(result["references"]))
        draw(arguments.output / "tapered_pin.png", dry, pushed, oiled)
    output.write_json(arguments.output / "result.json", result, comm)
    return 0 if all(entry["passed"] for entry in result["references"].values()) else 1


if __name__ == "__main__":
    sys.exit(main())
