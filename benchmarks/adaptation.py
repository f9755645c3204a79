"""Error over dofs: meshes refined everywhere against meshes refined where the error is made.

    python benchmarks/adaptation.py

A rigid cylinder (R = 4) pressed into a block of unit size, half of it modelled, in quadratic
triangles: without friction, and with μ = 0.3 in four increments. The error is that in the energy
norm as estimated; beside it what the contact force and the peak pressure come to.
"""

from __future__ import annotations

import numpy as np
import ufl
from dolfinx import fem, mesh
from dolfinx.mesh import GhostMode
from mpi4py import MPI

import fenics_contact as fc
from benchmarks import problems
from benchmarks.timing import draw, parser, write
from fenics_contact.elasticity import LinearElastic

E, NU, R, DEPTH, STIFFNESS = 1000.0, 0.3, 4.0, 0.01, 1e5
BASE, TOP, AXIS = 1, 2, 3


def half_block(n: int) -> tuple[mesh.Mesh, mesh.MeshTags]:
    """[0, 1] x [-1, 0], its base, top and axis tagged. Collective."""
    made = mesh.create_rectangle(
        MPI.COMM_WORLD, [(0, -1), (1, 0)], (n, n), ghost_mode=GhostMode.none
    )
    where = {
        tag: lambda x, i=i, at=at: np.isclose(x[i], at)
        for tag, i, at in ((BASE, 1, -1), (TOP, 1, 0), (AXIS, 0, 0))
    }
    return made, problems.sides(made, where)


def press(made: mesh.Mesh, tags: mesh.MeshTags, friction: float) -> tuple:
    """The problem, solved, its stress and its strain. Collective."""
    V = fem.functionspace(made, ("Lagrange", 2, (2,)))
    u, v = fem.Function(V), ufl.TestFunction(V)
    body = LinearElastic(u, E, NU, "plane strain")
    base = fem.locate_dofs_topological(V, 1, tags.find(BASE))
    axis = fem.locate_dofs_topological(V.sub(0), 1, tags.find(AXIS))
    bcs = [fem.dirichletbc(np.zeros(2), base, V), fem.dirichletbc(0.0, axis, V.sub(0))]
    down = fem.Constant(made, 0.0)
    cylinder = fc.Cylinder((0.0, R), R, displacement=ufl.as_vector([0, down]))
    law: fc.Coulomb | fc.Frictionless = fc.Frictionless(STIFFNESS)
    if friction:
        law = fc.Coulomb(friction, STIFFNESS, STIFFNESS)
    contact = fc.Contact(u, fc.ContactSurface(made, tags, TOP), cylinder, law)
    problem = fc.ContactProblem(body.residual(v), u, bcs=bcs, contacts=[contact], method="newton")
    list(fc.increments(problem, down, 0.0, -DEPTH, steps=4 if friction else 1))
    return problem, body.stress, body.strain(u)


def main() -> None:
    """Refine both ways, write and draw."""
    arguments = parser(__doc__, "adaptation").parse_args()
    rows = []
    for friction in (0.0, 0.3):
        for way, share, levels in (("everywhere", 1.0, 5), ("where the error is", 0.5, 10)):
            if arguments.short:
                levels -= 2
            solve = lambda made, tags, mu=friction: press(made, tags, mu)  # noqa: E731
            for level in fc.adapt(*half_block(4), solve, levels=levels, share=share):
                row = {"μ": friction, "refined": way, "dofs": level.dofs}
                row["error of the energy norm"] = level.budget.energy
                rows.append(row | level.budget.values)
    series: dict[str, tuple[list[float], list[float]]] = {}
    for row in rows:
        dofs, errors = series.setdefault(f"μ = {row['μ']:g}, {row['refined']}", ([], []))
        dofs.append(row["dofs"])
        errors.append(row["error of the energy norm"])
    title = "Cylinder on a block, quadratic triangles"
    write(arguments.output, "adaptation", f"{title}: refined everywhere and adapted", rows)
    draw(arguments.output / "adaptation.png", title, "dofs", "error, energy norm", series)


if __name__ == "__main__":
    main()
