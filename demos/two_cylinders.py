"""Two cylinders, pressed and then sheared: partial slip according to Cattaneo and Mindlin.

Two half-cylinders, R = 8 mm, E = 200 MPa, ν = 0.3, plane strain, μ = 0.2, both deformable, with
non-matching meshes. The lower one is fixed at its flat face. The upper one is constrained by
contact alone: a uniform pressure of 0.625 MPa on its flat face (P = 10 N/mm), then a shear traction
of 0.05851 MPa there (Q = 0.936 N/mm) along x, with a normal traction that is linear in x and
balances the moment of the shear about the contact.

The theory starts from a contact without shear, as in a symmetric problem. Friction is therefore
introduced after pressing; before, rollers on the axis x = 0 constrain the upper body. The two
phases are two problems with different Dirichlet conditions and one contact, which has the history.

    python demos/two_cylinders.py
    python demos/two_cylinders.py --cells 40 --increments 20
    mpirun -n 2 python demos/two_cylinders.py

Reference: Hertz for the pressure, a = 0.68078 mm and p₀ = 9.3514 MPa; and for the shear

    q(x) = μ p₀ [√(1 - x²/a²) - (c/a) √(1 - x²/c²)],    c/a = √(1 - Q/(μP)) = 0.72933,

where the second term is zero for |x| > c: the contact sticks in |x| < c and slips elsewhere. The
theory is for half-planes; here a/R = 0.085. The exit code is 1 if the half-widths of contact and
stick zone, or the largest pressure and shear, differ by more than 2 %, or the forces from the loads
by more than 1e-7.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
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

R, E, NU, FRICTION = 8.0, 200.0, 0.3, 0.2  # mm, MPa
PRESSURE, SHEAR = 0.625, 0.05851  # MPa on the flat face
P, Q = 2 * R * PRESSURE, 2 * R * SHEAR
A = np.sqrt(4 * P * (R / 2) / (np.pi * E / (2 * (1 - NU**2))))
PEAK = 2 * P / (np.pi * A)
C = A * np.sqrt(1 - Q / (FRICTION * P))
UPPER, LOWER, TOP, BASE, AXIS = 1, 2, 3, 4, 5  # facets: arcs, flat faces, x = 0 in the upper body
TOLERANCE, EQUILIBRIUM = 0.02, 1e-7


def cattaneo(x: np.ndarray) -> np.ndarray:
    """Return the reference shear traction at the positions ``x``."""
    full = np.sqrt(np.maximum(0, 1 - (x / A) ** 2))
    return FRICTION * PEAK * (full - C / A * np.sqrt(np.maximum(0, 1 - (x / C) ** 2)))


def make_mesh(cells: int) -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags]:
    """Mesh half-discs above and below the origin, with curved cells. Collective.

    Cells have the size a/``cells`` at the contact. Facets within 1.5 a of the origin may touch.
    """
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 0)
        gmsh.model.add("half-cylinders")
        if MPI.COMM_WORLD.rank == 0:
            occ, touching, flat, axis = gmsh.model.occ, [], [], []
            angle = np.arcsin(1.5 * A / R)
            for body, up in enumerate((1, -1), start=1):
                centre = occ.addPoint(0, up * R, 0)
                ring = [
                    occ.addPoint(R * np.sin(t), up * R * (1 - np.cos(t)), 0)
                    for t in (-np.pi / 2, -angle, 0, angle, np.pi / 2)
                ]
                arcs = [occ.addCircleArc(ring[i], centre, ring[i + 1]) for i in range(4)]
                lines = [occ.addLine(ring[4], centre), occ.addLine(centre, ring[0])]
                occ.addPlaneSurface([occ.addCurveLoop(arcs + lines)], body)
                touching.append(arcs[1:3])
                flat.append(lines)
                axis.append(occ.addLine(ring[2], centre))
            occ.synchronize()
            gmsh.model.mesh.embed(1, [axis[0]], 2, 1)
            gmsh.model.addPhysicalGroup(2, [1, 2], 1)
            for tag, group in enumerate([*touching, *flat, axis[:1]], start=1):
                gmsh.model.addPhysicalGroup(1, group, tag)

            def size(dim: int, tag: int, x: float, y: float, z: float, lc: float) -> float:
                away = np.hypot(max(0.0, abs(x) - 1.3 * A), max(0.0, abs(y) - 0.3 * A))
                coarser = 1.0 if y > 0 or (dim == 1 and tag in touching[0]) else 1.2
                return coarser * A / cells + 0.25 * away

            gmsh.model.mesh.setSizeCallback(size)
            gmsh.model.mesh.generate(2)
            gmsh.model.mesh.setOrder(2)
        mesh, _, tags = fc.model_to_mesh(gmsh.model, MPI.COMM_WORLD, gdim=2)
        return mesh, tags
    finally:
        gmsh.finalize()


@dataclass
class Pressed:
    """The cylinders after pressing, before the shear load.

    Attributes:
        problem, contact, body: Problem, contact and elastic law.
        shear: The shear traction on the upper flat face (MPa).
        deflection: Form of the displacement that is conjugate to the shear force (mm).
        step: The step of pressing.
    """

    problem: fc.ContactProblem
    contact: fc.Contact
    body: LinearElastic
    shear: fem.Constant
    deflection: fem.Form
    step: fc.Step


def press(cells: int, degree: int, stiffness: float) -> Pressed:
    """Create the cylinders and press them without shear. Collective."""
    mesh, tags = make_mesh(cells)
    V = fem.functionspace(mesh, ("Lagrange", degree, (2,)))
    u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
    body = LinearElastic(u, E, NU, "plane strain")
    pressure = fem.Constant(mesh, PETSc.ScalarType(0.0))
    shear = fem.Constant(mesh, PETSc.ScalarType(0.0))
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags)
    # The linear part has no resultant; its moment about the origin balances that of shear at y = R.
    along = ufl.as_vector([1, 3 * ufl.SpatialCoordinate(mesh)[0] / R])
    F = body.residual(v) + (pressure * v[1] - shear * ufl.dot(along, v)) * ds(TOP)
    clamped = fem.locate_dofs_topological(V, 1, tags.find(BASE))
    bcs = [fem.dirichletbc(np.zeros(2, dtype=PETSc.ScalarType), clamped, V)]

    law = fc.Coulomb(
        FRICTION, k_n=fc.RelativeStiffness(stiffness), k_t=fc.RelativeStiffness(stiffness)
    )
    surface = fc.ContactSurface(mesh, tags, UPPER)
    contact = fc.Contact(u, surface, fc.DeformableBody(tags, LOWER), law)
    # Pressing is frictionless with rollers on the axis; then friction constrains the upper body.
    friction = contact.parameters["friction"]
    friction.value = 0.0
    axis = fem.locate_dofs_topological(V.sub(0), 1, tags.find(AXIS))
    rollers = fem.dirichletbc(PETSc.ScalarType(0.0), axis, V.sub(0))
    pressing = fc.ContactProblem(F, u, bcs=[*bcs, rollers], contacts=[contact])
    (step,) = fc.increments(pressing, pressure, 0.0, PRESSURE)
    friction.value = FRICTION
    problem = fc.ContactProblem(F, u, bcs=bcs, contacts=[contact])
    deflection = fem.form(ufl.dot(along, u) / (2 * R) * ds(TOP))
    return Pressed(problem, contact, body, shear, deflection, step)


def solve(arguments: argparse.Namespace) -> tuple[Pressed, dict[str, Any]]:
    """Press and shear, and compare with the theory. Collective."""
    start = time.perf_counter()
    scene = press(arguments.cells, arguments.degree, arguments.stiffness)
    contact = scene.contact
    history = fc.increments(
        scene.problem, scene.shear, 0.0, SHEAR, steps=arguments.increments, progress="shear"
    )
    made = [scene.step, *history]

    points, resultants = contact.gather(), contact.resultants()
    extents = resultants.extents
    values = {
        "force along y [N/mm]": resultants.force[1],
        "force along x [N/mm]": -resultants.force[0],
        "half-width of contact [mm]": extents["contact"].area / 2,
        "half-width of stick zone [mm]": extents["stick"].area / 2,
        "largest pressure [MPa]": resultants.max_pressure,
        "largest shear [MPa]": float(np.abs(points["tangential_traction"][:, 0]).max()),
    }
    exact = (P, Q, A, C, PEAK, float(cattaneo(np.array(C))))
    allowed = (EQUILIBRIUM, EQUILIBRIUM, *(TOLERANCE,) * 4)
    references = dict(zip(values, zip(exact, allowed, strict=True), strict=True))
    result = {
        "references": output.compare(values, references),
        "dofs": contact.u.function_space.dofmap.index_map.size_global * 2,
        "increments": arguments.increments,
        "iterations": [step.iterations for step in made],
        "wall_seconds": time.perf_counter() - start,
    }
    if arguments.errors:
        body = scene.body
        budget = fc.estimate_errors(scene.problem, body.stress, strain=body.strain(body.u))
        result["errors"] = budget.numbers()
    return scene, result


def draw(folder: Path, points: dict[str, np.ndarray]) -> None:
    """Plot pressure and shear, then the shear alone, with the theory. On this rank."""
    x = np.linspace(-A, A, 801)
    ellipse = np.sqrt(1 - (x / A) ** 2)
    title = f"Pressed, then sheared: Q/(μP) = {Q / (FRICTION * P):.3f}"
    curves = {"Hertz": (x, PEAK * ellipse), "Cattaneo, Mindlin": (x, cattaneo(x))}
    marks = {"stick zone, reference": C}
    plotting.plot_tractions(
        folder / "traction.png", points, curves=curves, marks=marks, title=title
    )
    with plotting.figure(folder / "shear.png") as axes:
        shear = np.abs(points["tangential_traction"][:, 0])
        for status, colour in ((fc.Status.STICK, "#1f5fa8"), (fc.Status.SLIP, "#c8502a")):
            these = points["status"] == status
            label = f"computed, {status.name.lower()}"
            axes.plot(points["x"][these, 0], shear[these], ".", color=colour, label=label)
        axes.plot(x, cattaneo(x), "k-", linewidth=1, label="Cattaneo, Mindlin")
        axes.plot(x, FRICTION * PEAK * ellipse, "k--", linewidth=1, label="μ × Hertz")
        for side in (-C, C):
            axes.axvline(side, color="#2a8a3a", linestyle=":", label="± c" if side > 0 else None)
        axes.set(xlabel="x [mm]", ylabel="shear traction [MPa]", title=title, ylim=(0, None))
        axes.grid(alpha=0.25)
        axes.legend(loc="upper right", fontsize="small")


def main() -> int:
    """Run the demo; return 0 if every reference is met."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--cells", type=int, default=40, help="cells per half-width a")
    parser.add_argument("--degree", type=int, default=2, help="degree of the displacement")
    parser.add_argument("--increments", type=int, default=5, help="increments of the shear")
    parser.add_argument("--stiffness", type=float, default=10, help="contact stiffness over E/h")
    parser.add_argument("--errors", action="store_true", help="estimate the errors, part by part")
    parser.add_argument("--output", type=Path, default=Path("output/two_cylinders"), help="folder")
    arguments, _ = parser.parse_known_args()
    scene, result = solve(arguments)
    contact = scene.contact
    comm, folder = MPI.COMM_WORLD, arguments.output
    fc.Writer(folder, scene.problem, stress=scene.body.stress).write(SHEAR)
    output.write_json(folder / "result.json", result, comm)
    plotting.plot_deformation(folder / "mesh.png", contact.u, title="Two half-cylinders")
    points = contact.gather()
    if comm.rank == 0:
        its = result["iterations"]
        print(f"{result['dofs']} dofs, {len(its)} increments, {sum(its)} iterations, ", end="")
        print(f"{result['wall_seconds']:.2f} s")
        print(output.table(result["references"]))
        if "errors" in result:
            print(fc.ErrorBudget(**result["errors"]))
        draw(folder, points)
    return 0 if all(e["passed"] for e in result["references"].values()) else 1


if __name__ == "__main__":
    sys.exit(main())
