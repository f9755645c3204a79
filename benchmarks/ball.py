"""A rigid ball on an elastic block, in space, with friction: what contact costs.

A quarter of the block by symmetry, hexahedra that grow with the distance from the contact, the ball
moved down in one increment. The runs are those of ``half_cylinder.py``. Errors are those of force
and peak pressure against a finer mesh, of ``--reference`` cells a side, solved by this package.

    OMP_NUM_THREADS=1 python benchmarks/ball.py
    OMP_NUM_THREADS=1 python benchmarks/ball.py --short
"""

from __future__ import annotations

from functools import partial
from typing import Any

import costs
import dolfinx
import numpy as np
import timing
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from fenics_contact import output

E, NU, R, DEPTH = 1000.0, 0.3, 2.0, 0.03
REACH = 0.4  # of Γc from the axis; the contact radius is 0.22
GRADING = 1.6
AT_X, AT_Y, BOTTOM, CONTACT = 1, 2, 3, 4


class Block:
    """The scene on one mesh; see `costs.Scene`."""

    def __init__(self, cells: int, stiffness: float, exact: dict[str, float]) -> None:
        """Mesh it, ``cells`` a side; k_n = k_t = ``stiffness`` E/h; errors against ``exact``."""
        self.mesh = dolfinx.mesh.create_box(
            MPI.COMM_WORLD, [[0, 0, -1], [1, 1, 0]], [cells] * 3, dolfinx.mesh.CellType.hexahedron
        )
        x = self.mesh.geometry.x
        x[:] = np.sign(x) * np.abs(x) ** GRADING
        self.height = (1 / cells) ** GRADING  # of the cells at the surface
        self.mesh.topology.create_entities(2)
        sides = {
            AT_X: lambda x: np.isclose(x[0], 0),
            AT_Y: lambda x: np.isclose(x[1], 0),
            BOTTOM: lambda x: np.isclose(x[2], -1),
            CONTACT: lambda x: np.isclose(x[2], 0) & (np.hypot(x[0], x[1]) < REACH),
        }
        found = {
            t: dolfinx.mesh.locate_entities_boundary(self.mesh, 2, s) for t, s in sides.items()
        }
        facets = np.concatenate(list(found.values()))
        values = np.repeat(np.array(list(found), dtype=np.int32), [len(f) for f in found.values()])
        order = np.argsort(facets)
        self.tags = dolfinx.mesh.meshtags(self.mesh, 2, facets[order], values[order])
        self.space = fem.functionspace(self.mesh, ("Lagrange", 1, (3,)))
        self.n_dofs = self.space.dofmap.index_map.size_global * 3
        self.n_contact_dofs = costs.contact_dofs(self.space, self.tags.find(CONTACT))
        self.stiffness, self.exact = stiffness, exact

    def held(self, tag: int, component: int, value: float = 0.0) -> fem.DirichletBC:
        """A displacement of one component on a side."""
        part = self.space.sub(component)
        dofs = fem.locate_dofs_topological(part, 2, self.tags.find(tag))
        return fem.dirichletbc(PETSc.ScalarType(value), dofs, part)

    def conditions(self) -> list[fem.DirichletBC]:
        """Symmetry, and the bottom held."""
        bottom = [self.held(BOTTOM, i) for i in range(3)]
        return [self.held(AT_X, 0), self.held(AT_Y, 1), *bottom]

    def bilinear(self, u: Any, v: Any) -> ufl.Form:
        """Isotropic elasticity."""
        mu, lame = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
        e = ufl.sym(ufl.grad(u))
        stress = 2 * mu * e + lame * ufl.tr(e) * ufl.Identity(3)
        return ufl.inner(stress, ufl.sym(ufl.grad(v))) * ufl.dx

    def linear(self) -> costs.Row:
        """All of Γc moved down."""
        v, w = ufl.TestFunction(self.space), ufl.TrialFunction(self.space)
        glued = [self.held(CONTACT, i, (0.0, 0.0, -DEPTH)[i]) for i in range(3)]
        none = ufl.dot(fem.Constant(self.mesh, np.zeros(3)), v) * ufl.dx
        u = fem.Function(self.space)
        return costs.linear_solve(self.bilinear(w, v), none, self.conditions() + glued, u)

    def plain(self, friction: float) -> costs.Row:
        """By hand."""
        u, v = fem.Function(self.space), ufl.TestFunction(self.space)
        k = fem.Constant(self.mesh, self.stiffness * E / self.height)
        mu = fem.Constant(self.mesh, friction)
        arm = ufl.as_vector([0, 0, R]) - ufl.SpatialCoordinate(self.mesh)
        distance = ufl.sqrt(ufl.dot(arm, arm))
        n = arm / distance
        relative = u - ufl.as_vector([0, 0, -DEPTH])
        normal = k * ufl.max_value(ufl.dot(relative, n) - (distance - R), 0.0)
        trial = -k * (relative - ufl.dot(relative, n) * n)
        size = ufl.sqrt(ufl.dot(trial, trial) + 1e-30)
        traction = -normal * n + trial * ufl.min_value(1.0, mu * normal / size)
        ds = ufl.Measure("ds", domain=self.mesh, subdomain_data=self.tags)(CONTACT)
        F = self.bilinear(u, v) - ufl.dot(traction, v) * ds
        # Hertz's force on the quarter, over the dofs that share it.
        hertz = E / (1 - NU**2) * np.sqrt(R) * DEPTH**1.5 / 3
        row = costs.newton(F, u, self.conditions(), hertz / np.sqrt(self.n_contact_dofs))
        if row["iterations"] == "none":
            return row
        middle = output.at_node(u, (0.0, 0.0, 0.0))[2]
        peak = float(k.value) * (middle + DEPTH)
        force = fem.assemble_scalar(fem.form(-traction[2] * ds))
        return row | self.errors({"force": force, "u_z": middle, "peak": peak})

    def package(self, friction: float, steps: int, field: str, **options: Any) -> costs.Row:
        """By this package."""
        u, v = fem.Function(self.space), ufl.TestFunction(self.space)
        down = fem.Constant(self.mesh, 0.0)
        ball = fc.Ball((0, 0, R), R, displacement=ufl.as_vector([0, 0, down]))
        k = fc.Scaled(self.stiffness)
        law: Any = fc.Coulomb(friction, k_n=k, k_t=k) if friction else fc.Frictionless(k_n=k)
        contact = fc.Contact(u, fc.ContactSurface(self.mesh, self.tags, CONTACT), ball, law)
        problem = fc.ContactProblem(
            self.bilinear(u, v), u, bcs=self.conditions(), contacts=[contact], **options
        )
        row = costs.increments(problem, down, -DEPTH, steps, field)
        if row["iterations"] == "none":
            return row
        middle = output.at_node(u, (0.0, 0.0, 0.0))[2]
        made = contact.resultants()
        self.results = {"force": -made.force[2], "u_z": middle, "peak": made.max_pressure}
        return row | self.errors(self.results)

    def errors(self, results: dict[str, float]) -> costs.Row:
        """Against the finer mesh."""
        return {
            f"error of {name} [%]": 100 * abs(results[name] / value - 1)
            for name, value in self.exact.items()
        }


def main() -> None:
    """Run."""
    parser = timing.parser(__doc__, "ball")
    parser.add_argument(
        "--cells", type=int, nargs="+", default=[7, 11, 16, 23, 32], help="a side; table: the last"
    )
    parser.add_argument("--reference", type=int, default=38, help="cells a side of the finer mesh")
    parser.add_argument("--friction", type=float, default=0.3)
    parser.add_argument("--increments", type=int, nargs="*", default=[1])
    parser.add_argument("--stiffness", type=float, default=10.0, help="k_n and k_t h/E")
    parser.add_argument("--only", default="", help="runs whose name contains this")
    arguments = parser.parse_args()
    if MPI.COMM_WORLD.size > 1:
        parser.error("the condensed problem takes one rank")
    sizes, finer = arguments.cells, arguments.reference
    if arguments.short:
        sizes, finer = [6, 8, 11], 14
    # Stiffer, so that the error of a finite stiffness is among those that are seen.
    reference = Block(finer, 3 * arguments.stiffness, {})
    reference.package(arguments.friction, 1, "last", condensation=True)

    def choose(scene: costs.Scene) -> dict[str, Any]:
        found = costs.runs(scene, [arguments.friction], arguments.increments, all_unknowns=True)
        return {n: r for n, r in found.items() if arguments.only in n or n == costs.YARDSTICK}

    scenes = {
        f"{n} cells a side": partial(Block, n, arguments.stiffness, reference.results)
        for n in sizes
    }
    title = f"Ball on a block, trilinear, k h/E = {arguments.stiffness:g}"
    costs.study("ball", title, scenes, choose, arguments)


if __name__ == "__main__":
    np.seterr(all="ignore")
    main()
