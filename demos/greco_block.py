"""The GRECO block: a frictional benchmark with open, slipping and sticking parts.

A block 40 mm x 40 mm, plane strain, E = 130 GPa, ν = 0.2, on a rigid plane with friction μ = 1, is
pressed on its top by f = 50 MPa and on its left side by F = 150 MPa; u_x = 0 on its right side
(Raous et al.; Code_Aster SSNV128). On its bottom the left part opens, the middle slips, and the
right part sticks.

    python demos/greco_block.py
    python demos/greco_block.py --cells 64 --increments 10

As the gap is zero and the load proportional, the number of increments does not matter. The exit
code is 1 if the displacements differ from the converged ones by more than 0.3 %.
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
from petsc4py import PETSc

import fenics_contact as fc
from fenics_contact import output, plotting

SIZE, E, NU, FRICTION = 40.0, 130e3, 0.2, 1.0  # mm, MPa
TOP_PRESSURE, SIDE_PRESSURE = 50.0, 150.0
BOTTOM, RIGHT, TOP, LEFT = 1, 2, 3, 4

PLACES = np.array([0.0, 1.25, 5.0, 7.5, 11.25])
# u_x on y = 0 in µm at these positions: converged, with exact complementarity; and Code_Aster's.
CONVERGED = np.array([28.603, 27.226, 22.868, 19.807, 15.414])
CODE_ASTER = np.array([28.598, 27.208, 22.827, 19.792, 15.406])
SHEAR = 1405.36  # N/mm, converged
TOLERANCE = 0.003


def make_mesh(cells: int) -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags]:
    """Mesh the block, finer towards the left bottom corner where it opens. Collective."""
    mesh = dolfinx.mesh.create_rectangle(
        MPI.COMM_WORLD, [(0, 0), (SIZE, SIZE)], (cells, cells), dolfinx.mesh.CellType.quadrilateral
    )
    x = mesh.geometry.x
    x[:, :2] = SIZE * (0.4 * x[:, :2] / SIZE + 0.6 * (x[:, :2] / SIZE) ** 2)
    sides = ((BOTTOM, 1, 0.0), (RIGHT, 0, SIZE), (TOP, 1, SIZE), (LEFT, 0, 0.0))
    found = [
        dolfinx.mesh.locate_entities_boundary(mesh, 1, lambda x, i=i, at=at: np.isclose(x[i], at))
        for _, i, at in sides
    ]
    facets = np.concatenate(found)
    values = np.repeat(np.int32([s[0] for s in sides]), [len(f) for f in found])
    order = np.argsort(facets)
    return mesh, dolfinx.mesh.meshtags(mesh, 1, facets[order], values[order])


def solve(arguments: argparse.Namespace) -> tuple[fc.ContactProblem, dict[str, Any]]:
    """Load the block, and compare with the references. Collective."""
    start = time.perf_counter()
    mesh, tags = make_mesh(arguments.cells)
    increments = arguments.increments
    V = fem.functionspace(mesh, ("Lagrange", arguments.degree, (2,)))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    shear, lame = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
    load = fem.Constant(mesh, PETSc.ScalarType(0.0))
    epsilon = ufl.sym(ufl.grad(u))
    stress = 2 * shear * epsilon + lame * ufl.tr(epsilon) * ufl.Identity(2)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags)
    F = ufl.inner(stress, ufl.sym(ufl.grad(v))) * ufl.dx
    F += load * (TOP_PRESSURE * v[1] * ds(TOP) - SIDE_PRESSURE * v[0] * ds(LEFT))
    held = fem.locate_dofs_topological(V.sub(0), 1, tags.find(RIGHT))
    bcs = [fem.dirichletbc(PETSc.ScalarType(0.0), held, V.sub(0))]

    surface = fc.ContactSurface(mesh, tags, BOTTOM)
    law = fc.Coulomb(FRICTION, k_n=fc.RelativeStiffness(30), k_t=fc.RelativeStiffness(10))
    contact = fc.Contact(u, surface, fc.HalfSpace(point=(0, 0), normal=(0, 1)), law)
    problem = fc.ContactProblem(F, u, bcs=bcs, contacts=[contact], method="newton")
    options = {"steps": increments, "estimate": arguments.errors, "progress": "GRECO block"}
    made = list(fc.increments(problem, load, 0.0, 1.0, **options))

    resultants = contact.resultants()
    moved = 1e3 * along_bottom(u)
    result = {
        "displacements_um": moved.tolist(),
        "places_mm": PLACES.tolist(),
        "references": {"converged": CONVERGED.tolist(), "Code_Aster QUAD8": CODE_ASTER.tolist()},
        "largest_error": float(np.abs(moved / CONVERGED - 1).max()),
        "normal_force": resultants.normal_force,
        "tangential_force": float(-resultants.force[0]),
        "zones_mm": zones(contact),
        "dofs": V.dofmap.index_map.size_global * 2,
        "increments": increments,
        "iterations": [step.iterations for step in made],
        "converged_reasons": [step.reason for step in made],
        "wall_seconds": time.perf_counter() - start,
    }
    if arguments.errors:
        budget = fc.estimate_errors(problem, stress, increment_error=made[-1].increment_error)
        result["errors"] = budget.numbers()
    return problem, result


def along_bottom(u: fem.Function) -> np.ndarray:
    """Return u_x at `PLACES` on the bottom, interpolated between the nodes. Collective."""
    space = u.function_space
    n_owned = space.dofmap.index_map.size_local
    x = space.tabulate_dof_coordinates()[:n_owned]
    rows = np.column_stack([x[:, 0], u.x.array.reshape(-1, 2)[:n_owned, 0]])[x[:, 1] < 1e-9 * SIZE]
    rows = np.concatenate(space.mesh.comm.allgather(rows))
    rows = rows[np.argsort(rows[:, 0])]
    return np.interp(PLACES, rows[:, 0], rows[:, 1])


def zones(contact: fc.Contact) -> dict[str, list[float]]:
    """Return the extent along x of the open, slipping and sticking parts. Collective."""
    points = contact.gather()
    return {
        status.name.lower(): [float(x.min()), float(x.max())]
        for status in fc.Status
        if (x := points["x"][points["status"] == status, 0]).size
    }


def report(result: dict[str, Any]) -> None:
    """Print the results and the references."""
    its = result["iterations"]
    print(
        f"{result['dofs']} dofs, {result['increments']} increments, {sum(its)} iterations, "
        f"{result['wall_seconds']:.2f} s"
    )
    print(f"{'x [mm]':>10}{'u_x [µm]':>12}{'converged':>12}{'Code_Aster':>12}{'error':>10}")
    for x, u, good, aster in zip(
        PLACES, result["displacements_um"], CONVERGED, CODE_ASTER, strict=True
    ):
        print(f"{x:10.2f}{u:12.3f}{good:12.3f}{aster:12.3f}{u / good - 1:10.2%}")
    print(f"normal force {result['normal_force']:.3f} N/mm (2000), friction", end=" ")
    print(f"{result['tangential_force']:.2f} N/mm ({SHEAR})")
    for name, (low, high) in result["zones_mm"].items():
        print(f"{name:>8}: {low:.2f} to {high:.2f} mm")
    if "errors" in result:
        print(fc.ErrorBudget(**result["errors"]))


def main() -> int:
    """Run the benchmark; return 0 if its references are met."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--cells", type=int, default=40, help="cells along each side")
    parser.add_argument("--degree", type=int, default=2, help="degree of the displacement")
    parser.add_argument("--increments", type=int, default=1, help="load increments")
    parser.add_argument("--errors", action="store_true", help="estimate the errors, part by part")
    parser.add_argument("--output", type=Path, default=Path("output/greco_block"), help="folder")
    arguments, _ = parser.parse_known_args()
    problem, result = solve(arguments)
    (contact,) = problem.contacts
    comm, folder = MPI.COMM_WORLD, arguments.output
    if comm.rank == 0:
        folder.mkdir(parents=True, exist_ok=True)
        report(result)
    comm.barrier()
    output.write_json(folder / "result.json", result, comm)
    fc.Writer(folder, problem).write(1)
    plotting.plot_deformation(
        folder / "mesh.png",
        contact.u,
        title="GRECO block",
        magnification=100,
        contacts=[contact],
    )
    points = contact.gather()
    if comm.rank == 0:
        plotting.plot_tractions(folder / "traction.png", points, title="GRECO block, μ = 1")
    return 0 if result["largest_error"] <= TOLERANCE else 1


if __name__ == "__main__":
    sys.exit(main())
