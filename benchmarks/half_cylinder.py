"""Half-cylinder on a rigid plane: what contact costs in units of one linear solve.

The scene of ``demos/hertz.py``, without friction and with, in one increment and in forty: by this
package condensed and on all unknowns; by a penalty form written by hand in DOLFINx with Newton's
method, every step a factorisation by MUMPS; and one linear solve of the same body glued to the
plane. Meshing is not counted, and the compiling of forms stands apart; everything else is in the
times. Errors are those against the independent solution of the demo, with exact complementarity.

    OMP_NUM_THREADS=1 python benchmarks/half_cylinder.py
    OMP_NUM_THREADS=1 python benchmarks/half_cylinder.py --short
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Any

import costs
import numpy as np
import timing
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from fenics_contact import output

sys.path.insert(0, str(Path(__file__).parent.parent / "demos"))
import hertz  # the mesh and the numbers of the demo

# By this the half-cylinder, which nothing else holds, is pushed into the plane for a method that
# needs contact to start with.
PUSH = 0.05


class HalfCylinder:
    """The scene on one mesh; see `costs.Scene`."""

    def __init__(self, h: float, degree: int, stiffness: float) -> None:
        """Mesh it with cells of size ``h`` on Γc; k_n = k_t = ``stiffness`` E/h."""
        self.mesh, self.tags = hertz.make_mesh(h, 1.3 * hertz.hertz(hertz.PAPER_LOAD)[0])
        self.space = fem.functionspace(self.mesh, ("Lagrange", degree, (2,)))
        self.ds = ufl.Measure("ds", domain=self.mesh, subdomain_data=self.tags)
        self.n_dofs = self.space.dofmap.index_map.size_global * 2
        self.n_contact_dofs = costs.contact_dofs(self.space, self.tags.find(hertz.CONTACT))
        self.h, self.stiffness = h, stiffness

    def held(self, tag: int, component: int) -> fem.DirichletBC:
        """No displacement of one component on a side."""
        part = self.space.sub(component)
        dofs = fem.locate_dofs_topological(part, 1, self.tags.find(tag))
        return fem.dirichletbc(PETSc.ScalarType(0.0), dofs, part)

    def bilinear(self, u: Any, v: Any) -> ufl.Form:
        """Plane strain."""
        mu = hertz.E / (2 * (1 + hertz.NU))
        lame = hertz.E * hertz.NU / ((1 + hertz.NU) * (1 - 2 * hertz.NU))
        e = ufl.sym(ufl.grad(u))
        stress = 2 * mu * e + lame * ufl.tr(e) * ufl.Identity(2)
        return ufl.inner(stress, ufl.sym(ufl.grad(v))) * ufl.dx

    def load(self, pressure: fem.Constant, v: Any) -> ufl.Form:
        """Virtual work of the pressure on the top."""
        return -pressure * v[1] * self.ds(hertz.TOP)

    def linear(self) -> costs.Row:
        """Glued to the plane."""
        v, w = ufl.TestFunction(self.space), ufl.TrialFunction(self.space)
        pressure = fem.Constant(self.mesh, hertz.PAPER_LOAD)
        bcs = [self.held(hertz.AXIS, 0), self.held(hertz.CONTACT, 0), self.held(hertz.CONTACT, 1)]
        u = fem.Function(self.space)
        return costs.linear_solve(self.bilinear(w, v), self.load(pressure, v), bcs, u)

    def plain(self, friction: float) -> costs.Row:
        """By hand, in one increment."""
        u, v = fem.Function(self.space), ufl.TestFunction(self.space)
        pressure = fem.Constant(self.mesh, hertz.PAPER_LOAD)
        k = fem.Constant(self.mesh, self.stiffness * hertz.E / self.h)
        mu = fem.Constant(self.mesh, friction)
        ds = self.ds(hertz.CONTACT)
        gap = ufl.SpatialCoordinate(self.mesh)[1] + u[1]
        normal = k * ufl.max_value(-gap, 0.0)
        F = self.bilinear(u, v) - self.load(pressure, v) - normal * v[1] * ds
        if friction:
            limit = mu * normal
            F += ufl.max_value(-limit, ufl.min_value(k * u[0], limit)) * v[0] * ds
        u.x.array.reshape(-1, 2)[:, 1] = -PUSH
        size = fem.petsc.assemble_vector(fem.form(self.load(pressure, v))).norm()
        row = costs.newton(F, u, [self.held(hertz.AXIS, 0)], size)
        if row["iterations"] == "none":
            return row
        nodes = fem.locate_dofs_topological(self.space, 1, self.tags.find(hertz.CONTACT))
        height = self.space.tabulate_dof_coordinates()[nodes, 1]
        peak = -float(k.value) * float((height + u.x.array.reshape(-1, 2)[nodes, 1]).min())
        return row | self.errors(u, peak, friction, 1)

    def package(self, friction: float, steps: int, field: str, **options: Any) -> costs.Row:
        """By this package."""
        u, v = fem.Function(self.space), ufl.TestFunction(self.space)
        pressure = fem.Constant(self.mesh, 0.0)
        k = fc.Scaled(self.stiffness)
        law: Any = fc.Coulomb(friction, k_n=k, k_t=k) if friction else fc.Frictionless(k_n=k)
        F = self.bilinear(u, v) - self.load(pressure, v)
        surface = fc.ContactSurface(self.mesh, self.tags, hertz.CONTACT)
        contact = fc.Contact(u, surface, fc.HalfSpace((0, 0), (0, 1)), law)
        bcs = [self.held(hertz.AXIS, 0)]
        problem = fc.ContactProblem(F, u, bcs=bcs, contacts=[contact], **options)
        row = costs.increments(problem, pressure, hertz.PAPER_LOAD, steps, field)
        if row["iterations"] == "none":
            return row
        resultants = contact.resultants()
        row |= {"shear": resultants.tangential_force}
        return row | self.errors(u, resultants.max_pressure, friction, steps)

    def errors(self, u: fem.Function, peak: float, friction: float, steps: int) -> costs.Row:
        """Against the reference, which with friction is that of a load in many increments."""
        if (friction and steps < 40) or friction not in hertz.EXACT:
            return {}
        exact = hertz.EXACT[friction]
        down = exact["top_centre_displacement"][1]
        return {
            "error of u_y [%]": 100 * abs(output.at_node(u, (0.0, hertz.R))[1] / down - 1),
            "error of the peak [%]": 100 * abs(peak / exact["peak_pressure"] - 1),
        }


def main() -> None:
    """Run."""
    parser = timing.parser(__doc__, "half_cylinder")
    parser.add_argument(
        "--h",
        type=float,
        nargs="+",
        default=[0.25, 0.12, 0.06, 0.03, 0.0165],
        help="cell sizes on Γc; the table is of the last",
    )
    parser.add_argument("--degree", type=int, default=2)
    parser.add_argument("--friction", type=float, nargs="*", default=[0.0, 0.2])
    parser.add_argument("--increments", type=int, nargs="*", default=[1, 40])
    parser.add_argument("--stiffness", type=float, default=10.0, help="k_n and k_t h/E")
    parser.add_argument("--all", action="store_true", help="histories on all unknowns too")
    parser.add_argument("--only", default="", help="runs whose name contains this")
    arguments = parser.parse_args()
    if MPI.COMM_WORLD.size > 1:
        parser.error("the condensed problem takes one rank")
    sizes = [0.25, 0.12, 0.06] if arguments.short else arguments.h

    def choose(scene: costs.Scene) -> dict[str, Any]:
        found = costs.runs(
            scene, arguments.friction, arguments.increments, all_unknowns=arguments.all
        )
        return {n: r for n, r in found.items() if arguments.only in n or n == costs.YARDSTICK}

    scenes = {
        f"h = {h:g}": partial(HalfCylinder, h, arguments.degree, arguments.stiffness) for h in sizes
    }
    title = f"Half-cylinder, degree {arguments.degree}, k h/E = {arguments.stiffness:g}"
    costs.study("half_cylinder", title, scenes, choose, arguments)


if __name__ == "__main__":
    np.seterr(all="ignore")
    main()
