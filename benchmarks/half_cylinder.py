"""Half-cylinder on a rigid plane: what contact costs in units of one linear solve.

Times, in one run and one after another, on the scene of ``demos/hertz.py``: one linear solve of the
same body glued to the plane; Newton's method on a penalty form as written by hand in DOLFINx, every
step a factorisation by MUMPS; and this package on all unknowns and condensed, by L-BFGS and
Newton. Meshing and the compiling of forms are not counted, everything else is.

    OMP_NUM_THREADS=1 python benchmarks/half_cylinder.py --h 0.0165 --repeat 5

Writes a table in Markdown and a CSV file.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc

sys.path.insert(0, str(Path(__file__).parent.parent / "demos"))
import hertz  # the mesh and the numbers of the demo
import timing

# By this the half-cylinder, which nothing else holds, is pushed into the plane for methods that
# need contact to start with.
PUSH = 0.05
YARDSTICK = "one linear solve"


class Body:
    """The half-cylinder without contact, as a user of DOLFINx writes it."""

    def __init__(self, h: float, degree: int) -> None:
        """Mesh it."""
        self.mesh, self.tags = hertz.make_mesh(h, 1.3 * hertz.hertz(hertz.PAPER_LOAD)[0])
        self.space = fem.functionspace(self.mesh, ("Lagrange", degree, (2,)))
        self.ds = ufl.Measure("ds", domain=self.mesh, subdomain_data=self.tags)
        self.n_dofs = self.space.dofmap.index_map.size_global * 2
        self.h = h

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


def linear_solve(body: Body) -> dict[str, Any]:
    """The body glued to the plane: assemble, factor, solve."""
    v, w = ufl.TestFunction(body.space), ufl.TrialFunction(body.space)
    pressure = fem.Constant(body.mesh, hertz.PAPER_LOAD)
    bcs = [body.held(hertz.AXIS, 0), body.held(hertz.CONTACT, 0), body.held(hertz.CONTACT, 1)]
    a, L = fem.form(body.bilinear(w, v)), fem.form(body.load(pressure, v))
    matrix = fem.petsc.assemble_matrix(a, bcs)
    matrix.assemble()
    matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    b = fem.petsc.assemble_vector(L)
    fem.petsc.apply_lifting(b, [a], [bcs])
    b.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
    fem.petsc.set_bc(b, bcs)
    ksp = direct(matrix, "cholesky")
    u = fem.Function(body.space)
    ksp.solve(b, u.x.petsc_vec)
    return {"iterations": 1, "factorisations": 1}


def direct(matrix: PETSc.Mat, kind: str) -> PETSc.KSP:
    """One factorisation by MUMPS."""
    ksp = PETSc.KSP().create(matrix.comm)
    ksp.setOperators(matrix)
    ksp.setType("preonly")
    ksp.getPC().setType(kind)
    ksp.getPC().setFactorSolverType("mumps")
    return ksp


def by_hand(body: Body, friction: float) -> dict[str, Any]:
    """A penalty form and Newton's method, 60 lines of DOLFINx; the load in one increment."""
    u, v = fem.Function(body.space), ufl.TestFunction(body.space)
    pressure = fem.Constant(body.mesh, hertz.PAPER_LOAD)
    k_n = k_t = 10 * hertz.E / body.h
    ds = body.ds(hertz.CONTACT)
    gap = ufl.SpatialCoordinate(body.mesh)[1] + u[1]
    normal = k_n * ufl.max_value(-gap, 0.0)
    F = body.bilinear(u, v) - body.load(pressure, v) - normal * v[1] * ds
    if friction:
        limit = friction * normal
        F += ufl.max_value(-limit, ufl.min_value(k_t * u[0], limit)) * v[0] * ds
    bcs = [body.held(hertz.AXIS, 0)]
    residual = fem.form(F)
    tangent = fem.form(ufl.derivative(F, u, ufl.TrialFunction(body.space)))
    matrix = fem.petsc.create_matrix(tangent)
    ksp = direct(matrix, "lu" if friction else "cholesky")
    if not friction:
        matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    u.x.array.reshape(-1, 2)[:, 1] = -PUSH
    step = u.x.petsc_vec.duplicate()
    size = 0.0
    for iteration in range(60):
        b = fem.petsc.assemble_vector(residual)
        fem.petsc.set_bc(b, bcs, u.x.petsc_vec, alpha=-1.0)
        norm = b.norm()
        size = max(size, fem.petsc.assemble_vector(fem.form(body.load(pressure, v))).norm())
        if norm <= 1e-9 * size:
            return {"iterations": iteration, "factorisations": iteration}
        matrix.zeroEntries()
        fem.petsc.assemble_matrix(matrix, tangent, bcs=bcs)
        matrix.assemble()
        ksp.solve(b, step)
        u.x.petsc_vec.axpy(-1.0, step)
    return {"iterations": "none", "factorisations": 60}


def package(body: Body, friction: float, steps: int, **options: Any) -> dict[str, Any]:
    """The same by this package."""
    u, v = fem.Function(body.space), ufl.TestFunction(body.space)
    pressure = fem.Constant(body.mesh, 0.0)
    factor = fc.Scaled(options.pop("stiffness"))
    law: Any = fc.Frictionless(k_n=factor)
    if friction:
        law = fc.Coulomb(friction, k_n=factor, k_t=factor)
    F = body.bilinear(u, v) - body.load(pressure, v)
    surface = fc.ContactSurface(body.mesh, body.tags, hertz.CONTACT)
    contact = fc.Contact(u, surface, fc.HalfSpace((0, 0), (0, 1)), law)
    bcs = [body.held(hertz.AXIS, 0)]
    problem = fc.ContactProblem(F, u, bcs=bcs, contacts=[contact], **options)
    try:
        made = list(fc.increments(problem, pressure, 0.0, hertz.PAPER_LOAD, steps=steps))
    except fc.NotConverged:
        return {"iterations": "none", "factorisations": ""}
    return {
        "iterations": sum(s.iterations for s in made),
        "factorisations": sum(s.factorisations for s in made),
        "shear": round(made[-1].contacts["contact"].tangential_force, 4),
    }


def methods(body: Body, arguments: argparse.Namespace) -> dict[str, Callable[[], dict[str, Any]]]:
    """What to time, by name."""
    found: dict[str, Callable[[], dict[str, Any]]] = {YARDSTICK: lambda: linear_solve(body)}
    for friction in arguments.friction:
        found[f"by hand, Newton + MUMPS, μ = {friction:g}"] = lambda f=friction: by_hand(body, f)
        for steps in arguments.increments if friction else [1]:
            for method in ("lbfgs", "newton"):
                for condensed in (False, True):
                    if steps > 1 and not condensed and not arguments.all:
                        continue  # minutes
                    where = "condensed" if condensed else "all unknowns"
                    name = f"{method}, {where}, μ = {friction:g}, {steps} increments"
                    found[name] = lambda f=friction, s=steps, m=method, c=condensed: package(
                        body, f, s, method=m, condensation=c, stiffness=arguments.stiffness
                    )
    return found


def main() -> None:
    """Run."""
    parser = timing.parser(__doc__, "half_cylinder")
    parser.add_argument("--h", type=float, default=0.0165, help="cell size on Γc")
    parser.add_argument("--degree", type=int, default=2)
    parser.add_argument("--friction", type=float, nargs="*", default=[0.0, 0.2])
    parser.add_argument("--increments", type=int, nargs="*", default=[1, 40])
    parser.add_argument("--stiffness", type=float, default=10.0, help="k_n and k_t h/E")
    parser.add_argument("--all", action="store_true", help="histories on all unknowns too")
    parser.add_argument("--only", help="methods whose name contains this")
    arguments = parser.parse_args()
    if MPI.COMM_WORLD.size > 1:
        parser.error("the condensed problem takes one rank")

    body = Body(0.1 if arguments.short else arguments.h, arguments.degree)
    chosen = {
        name: run
        for name, run in methods(body, arguments).items()
        if not arguments.only or arguments.only in name or name == YARDSTICK
    }
    small = methods(Body(0.5, arguments.degree), arguments)
    first = {name: run for name, run in small.items() if name in chosen}
    rows = timing.measure(chosen, repeat=arguments.repeat, first=first)
    title = f"Half-cylinder, {body.n_dofs} dofs, degree {arguments.degree}, h = {body.h:g}, "
    title += f"k h/E = {arguments.stiffness:g}, medians of {arguments.repeat}"
    rows = timing.in_units_of(rows, YARDSTICK, "linear solves")
    timing.write(arguments.output, "half_cylinder", title, rows)


if __name__ == "__main__":
    np.seterr(all="ignore")
    main()
