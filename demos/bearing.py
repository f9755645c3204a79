"""Roller bearing: ten elastic bodies, eight of which are held by friction only.

Plane strain; lengths in mm, stresses in MPa, forces in N per mm of width. Eight steel rollers of
radius 4 lie between an inner ring (radii 15 and 20) and an outer one (28 and 34), with a clearance
of 0.002 on each side. The housing is rigid; a rigid shaft in the bore of the inner ring moves down
by 0.02 in five increments. Two rollers are loaded in the second increment, two more in the third;
the other four stay loose, without a cage. Contact pairs are found by `find_contact_pairs`, μ = 0.1.

    python demos/bearing.py
    python demos/bearing.py --size 0.01
    mpirun -n 2 python demos/bearing.py

References: the reaction in the housing is the force of the shaft, and the forces on every roller
are in balance (1e-6: the solver stops at 1e-9 of the forces). Hertz's half-width of the contact of
a loaded roller, 2 √(Q R / (π E*)), for its force Q (10 %: the contact has few facets). Roller loads
in proportion to δ^(10/9), A. Palmgren's law of line contact, with the approach δ of the rings less
the clearance (3 %: an empirical exponent, with rigid rings). The exit code is 1 if one is missed.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gmsh
import numpy as np
import ufl
from dolfinx import fem, la
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact import compat, output, plotting
from fenics_contact.elasticity import LinearElastic

E, NU, MU = 210e3, 0.3, 0.1
BORE, RACE, ROLLER, CLEARANCE, WALL, ROLLERS = 15.0, 20.0, 4.0, 0.002, 6.0, 8
PITCH = RACE + CLEARANCE + ROLLER  # radius of the rollers' centres
OUTER_RACE = PITCH + ROLLER + CLEARANCE
SHAFT, STEPS = 0.02, 5  # displacement of the shaft, and number of increments
HELD, FACING = 1, 2  # tags of the curve with prescribed displacements, and of those in contact
ANGLES = 2 * np.pi * (np.arange(ROLLERS) + 0.5) / ROLLERS - np.pi / 2  # from the x axis
RADIAL = np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
LOADED = (0, 1, ROLLERS - 2, ROLLERS - 1)
COMM = MPI.COMM_WORLD


def ring(
    centre: np.ndarray, radii: tuple[float, float], facing: str, near: np.ndarray, size: float
) -> tuple:
    """Mesh a ring, or a disc with inner radius 0, by triangles. Collective.

    Args:
        centre: The centre.
        radii: Inner and outer radius.
        facing: Which curve may come into contact, "inside" or "outside".
        near: Points near which triangles have the smallest size, (n, 2).
        size: This size.
    """
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        for name in ("ExtendFromBoundary", "FromPoints", "FromCurvature"):
            gmsh.option.setNumber(f"Mesh.MeshSize{name}", 0)
        gmsh.model.add("ring")
        if COMM.rank == 0:
            occ, (inner, outer) = gmsh.model.occ, radii
            body = [(2, occ.addDisk(*centre, 0, outer, outer))]
            if inner:
                body, _ = occ.cut(body, [(2, occ.addDisk(*centre, 0, inner, inner))])
            occ.synchronize()
            gmsh.model.addPhysicalGroup(2, [body[0][1]], 1)
            for _, curve in gmsh.model.getBoundary(body, oriented=False):
                low, _, _, high, _, _ = gmsh.model.getBoundingBox(1, curve)
                is_inside = high - low < inner + outer
                tag = FACING if is_inside == (facing == "inside") else HELD
                gmsh.model.addPhysicalGroup(1, [curve], tag)

            def cell_size(dim: int, tag: int, x: float, y: float, z: float, lc: float) -> float:
                away = float(np.min(np.hypot(*(near - [x, y]).T)))
                return min(1.0, ROLLER / 6 if not inner else 1.0, size + max(0.0, away / 4 - size))

            gmsh.model.mesh.setSizeCallback(cell_size)
            gmsh.model.mesh.generate(2)
        return fc.model_to_mesh(gmsh.model, COMM, gdim=2)
    finally:
        gmsh.finalize()


class Bearing:
    """The bearing, with the displacement of its shaft as load. The constructor is collective.

    Args:
        size: Size of the triangles at the contacts.
        rollers: Numbers of the rollers, from the load anticlockwise; by default all.

    Attributes:
        problem: The contact problem.
        steel: The elastic bodies.
        inside, outside: Contacts of the rollers with the inner and the outer ring.
    """

    def __init__(self, size: float, rollers: Sequence[int] = range(ROLLERS)) -> None:
        zero = np.zeros(2)
        parts = {
            "inner ring": ring(zero, (BORE, RACE), "outside", RACE * RADIAL, size),
            "outer ring": ring(
                zero, (OUTER_RACE, OUTER_RACE + WALL), "inside", OUTER_RACE * RADIAL, size
            ),
        }
        for number in rollers:
            way = RADIAL[number]
            near = np.outer([PITCH - ROLLER, PITCH + ROLLER], way)
            parts[f"roller {number + 1}"] = ring(PITCH * way, (0.0, ROLLER), "outside", near, size)
        joined = fc.join_meshes(parts)
        mesh = joined.mesh
        V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
        u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
        self.steel = LinearElastic(u, E, NU, "plane strain")
        self.shaft = fem.Constant(mesh, zero)
        bcs = []
        for name, value in (("inner ring", self.shaft), ("outer ring", fem.Constant(mesh, zero))):
            facets = joined.facets.find(joined.facet(name, HELD))
            dofs = fem.locate_dofs_topological(V, 1, facets)
            bcs.append(fem.dirichletbc(value, dofs, V))
        self.held = bcs[-1].dof_indices()[0]
        contacts = fc.find_contact_pairs(
            u,
            fc.Coulomb(MU),
            distance=0.1,
            bodies=joined,
            facet_tags=joined.facets,
            tags=[joined.facet(name, FACING) for name in parts],
            slave_bodies=[f"roller {number + 1}" for number in rollers],
        )
        self.inside, self.outside = contacts[: len(rollers)], contacts[len(rollers) :]
        self.problem = fc.ContactProblem(self.steel.residual(v), u, bcs=bcs, contacts=contacts)

    def load(self, t: float) -> None:
        """Move the shaft by a fraction of its displacement."""
        self.shaft.value[1] = -SHAFT * t

    def reaction(self) -> float:
        """Return the vertical force of the outer ring on the housing, from the stress. Collective.

        It is the residual of the bulk form at the dofs of the housing.
        """
        v = ufl.TestFunction(self.steel.u.function_space)
        forces = fem.assemble_vector(fem.form(self.steel.residual(v)))
        forces.scatter_reverse(la.InsertMode.add)
        held = self.held[self.held < forces.index_map.size_local * forces.block_size]
        return -float(COMM.allreduce(forces.array[held[held % 2 == 1]].sum()))


def solve(bearing: Bearing) -> list[dict[str, Any]]:
    """Move the shaft; return forces and numbers of iterations of every increment. Collective."""
    path = []
    for step in fc.increments(bearing.problem, bearing.load, steps=STEPS, progress="bearing"):
        inside, outside = (
            [contact.resultants() for contact in contacts]
            for contacts in (bearing.inside, bearing.outside)
        )
        path.append(
            {
                "displacement": SHAFT * step.load,
                "roller loads": [found.normal_force for found in inside],
                "inner": [found.force.tolist() for found in inside],
                "outer": [found.force.tolist() for found in outside],
                "contact lengths": [found.area for found in inside],
                "reaction": bearing.reaction(),
                "iterations": step.iterations,
            }
        )
    return path


def approach(displacement: float, roller: int) -> float:
    """Return the approach of rigid rings at a roller, less the clearance."""
    return -displacement * float(RADIAL[roller, 1]) - 2 * CLEARANCE


def compare(path: list[dict[str, Any]]) -> dict[str, Any]:
    """Compare the last increment with statics, Hertz and Palmgren."""
    last, radius = path[-1], 1 / (1 / ROLLER + 1 / RACE)
    inner, outer = np.array(last["inner"]), np.array(last["outer"])
    loads, lengths = (np.array(last[name]) for name in ("roller loads", "contact lengths"))
    modulus = E / (2 * (1 - NU**2))
    hertz = 4 * np.sqrt(loads * radius / (np.pi * modulus))
    least, most = sorted(LOADED, key=lambda roller: loads[roller])[:: len(LOADED) - 1]
    palmgren = (approach(SHAFT, least) / approach(SHAFT, most)) ** (10 / 9)
    worst = max(LOADED, key=lambda roller: abs(lengths[roller] / hertz[roller] - 1))
    values = {
        "reaction / shaft force": last["reaction"] / inner[:, 1].sum(),
        "unbalanced force of a roller": float(np.abs(inner + outer).max() / loads.max()),
        "contact length / Hertz, worst": lengths[worst] / hertz[worst],
        "load ratio / Palmgren": loads[least] / loads[most] / palmgren,
        "load of the loose rollers": float(np.delete(loads, LOADED).max() / loads.max()),
    }
    references = dict(
        zip(values, ((1.0, 1e-6), (0.0, 1e-6), (1.0, 0.1), (1.0, 0.03), (0.0, 1e-6)), strict=True)
    )
    return output.compare(values, references)


def von_mises(bearing: Bearing) -> tuple[np.ndarray, np.ndarray] | None:
    """Return triangles, (n, 3, 2), and their equivalent stress, on the first rank. Collective."""
    stress, mesh = bearing.steel.stress, bearing.steel.u.function_space.mesh
    deviator = stress - ufl.tr(stress) / 3 * ufl.Identity(3)
    equivalent = ufl.sqrt(1.5 * ufl.inner(deviator, deviator))
    cells = np.arange(mesh.topology.index_map(2).size_local, dtype=np.int32)
    values = fem.Expression(equivalent, np.array([[1 / 3, 1 / 3]])).eval(mesh, cells)
    corners = mesh.geometry.x[compat.geometry_dofmap(mesh)[cells], :2]
    parts = COMM.gather((corners, values.ravel()))
    if parts is None:
        return None
    triangles, values = (np.concatenate(part) for part in zip(*parts, strict=True))
    return triangles, values


def draw(file: Path, path: list[dict[str, Any]], stress: tuple[np.ndarray, np.ndarray]) -> None:
    """Draw equivalent stress and roller loads. On this rank."""
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import PowerNorm

    triangles, values = stress
    with plotting.figure(file, 2, (6.4, 5.6)) as (left, right):
        scale = PowerNorm(0.5, 0.0, np.quantile(values, 0.99))
        drawn = PolyCollection(triangles, array=values, cmap="viridis", norm=scale, ec="face")
        left.add_collection(drawn)
        left.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal", title="Equivalent stress")
        left.autoscale_view()
        label = "von Mises stress [MPa]"
        left.figure.colorbar(drawn, ax=left, label=label, shrink=0.8, extend="max")
        right.set(title="Load of the rollers", xlabel="approach of the rings - clearance [µm]")
        for roller, marker in ((0, "o"), (1, "s")):
            rows = [row for row in path if row["roller loads"][roller] > 0]
            x = [1e3 * approach(row["displacement"], roller) for row in rows]
            angle = np.degrees(ANGLES[roller]) + 90
            name = f"roller at {angle:.1f}° from the load"
            right.plot(x, [row["roller loads"][roller] for row in rows], marker, label=name)
        last = path[-1]
        largest = 1e3 * approach(last["displacement"], 0)
        x = np.linspace(0.0, largest, 100)
        line = last["roller loads"][0] * (x / largest) ** (10 / 9)
        right.plot(x, line, "k-", lw=1, label="∝ δ^(10/9), Palmgren")
        right.set(ylabel="load [N/mm]", xlim=(0, None), ylim=(0, None))
        right.grid(alpha=0.25)
        right.legend()


def main() -> int:
    """Load the bearing; return 0 if every reference is met."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--size", type=float, default=0.02, help="triangles at contacts (mm)")
    parser.add_argument("--output", type=Path, default=Path("output/bearing"), help="folder")
    arguments, _ = parser.parse_known_args()
    start = time.perf_counter()
    bearing = Bearing(arguments.size)
    path = solve(bearing)
    result: dict[str, Any] = {
        "references": compare(path),
        "dofs": bearing.steel.u.function_space.dofmap.index_map.size_global * 2,
        "path": path,
        "wall_seconds": time.perf_counter() - start,
    }
    fc.Writer(arguments.output, bearing.problem, stress=bearing.steel.stress).write(1.0)
    stress = von_mises(bearing)
    if stress is not None:
        print(output.table(result["references"]))
        draw(arguments.output / "bearing.png", path, stress)
    output.write_json(arguments.output / "result.json", result, COMM)
    return 0 if all(entry["passed"] for entry in result["references"].values()) else 1


if __name__ == "__main__":
    sys.exit(main())
