"""Penalty, augmented Lagrangian and Nitsche's method: error and time on two scenes.

Scenes: the half-cylinder of ``demos/hertz.py`` without friction and with μ = 0.2 in one increment,
and the GRECO block, both of quadratic cells. Errors are against this package's solution by
multipliers on cells of half the size, whose own peak pressure and displacement are tabulated with
the published values; the pressure's error is that in the mean square over Γc. Nitsche's method is
here a UFL form and a Newton iteration by hand, each step a factorisation by MUMPS, as a user of
DOLFINx would write it: its stresses on Γc are those of the bulk form's cells, which a condensed
problem does not have. Meshing, and compiling forms, are not counted.

    OMP_NUM_THREADS=1 python benchmarks/enforcement.py

Writes tables, CSV files, and plots of error against time.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import dolfinx
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from fenics_contact import output
from fenics_contact.surface import PointEvaluator

sys.path.insert(0, str(Path(__file__).parent.parent / "demos"))
import greco_block
import hertz
import timing

PENALTIES = (1.0, 10.0, 100.0, 1e3, 1e4, 1e6)
NITSCHE = {
    "Nitsche 10 symmetric": (10.0, 1.0),
    "Nitsche 10 incomplete": (10.0, 0.0),
    "Nitsche 100 incomplete": (100.0, 0.0),
}
YARDSTICK = "penalty 10"
Array = np.ndarray


@dataclass
class Scene:
    """A body over the plane y = 0.

    Attributes:
        E, nu: Of the body, plane strain.
        contact_tag: Of the facets that may touch.
        friction: μ.
        load: Virtual work of the loads (v, ds).
        bcs: Conditions of a space.
        size: h of E/h for Nitsche's method.
        push: Displacement to start Newton's method by hand from.
        measure: The displacement to compare.
    """

    mesh: dolfinx.mesh.Mesh
    tags: dolfinx.mesh.MeshTags
    E: float
    nu: float
    contact_tag: int
    friction: float
    load: Callable[[Any, Any], Any]
    bcs: Callable[[fem.FunctionSpace], list[fem.DirichletBC]]
    size: float
    push: float
    measure: Callable[[fem.Function], float]


def held(tags: dolfinx.mesh.MeshTags, tag: int, V: fem.FunctionSpace) -> list[fem.DirichletBC]:
    """No displacement along x on a side."""
    dofs = fem.locate_dofs_topological(V.sub(0), 1, tags.find(tag))
    return [fem.dirichletbc(PETSc.ScalarType(0.0), dofs, V.sub(0))]


@cache
def half_cylinder(friction: float, h: float) -> Scene:
    """Cells that grow slowly, so that the displacement of the top has an error below 1e-6."""
    mesh, tags = hertz.make_mesh(h, 1.3 * hertz.hertz(hertz.PAPER_LOAD)[0], 2.5 * h, 12.5 * h)
    return Scene(
        mesh=mesh,
        tags=tags,
        E=hertz.E,
        nu=hertz.NU,
        contact_tag=hertz.CONTACT,
        friction=friction,
        load=lambda v, ds: -hertz.PAPER_LOAD * v[1] * ds(hertz.TOP),
        bcs=partial(held, tags, hertz.AXIS),
        size=h,
        push=0.05,
        measure=lambda u: float(output.at_node(u, (0.0, hertz.R))[1]),
    )


@cache
def block(friction: float, cells: int) -> Scene:
    """The GRECO block; its displacement is u_x of the left bottom corner (mm)."""
    g = greco_block
    mesh, tags = g.make_mesh(cells)
    return Scene(
        mesh=mesh,
        tags=tags,
        E=g.E,
        nu=g.NU,
        contact_tag=g.BOTTOM,
        friction=friction,
        load=lambda v, ds: g.SIDE_PRESSURE * v[0] * ds(g.LEFT) - g.TOP_PRESSURE * v[1] * ds(g.TOP),
        bcs=partial(held, tags, g.RIGHT),
        size=g.SIZE / cells,
        push=0.02,
        measure=lambda u: float(output.at_node(u, (0.0, 0.0))[0]),
    )


def stress(scene: Scene, u: Any) -> Any:
    """Plane strain."""
    G = scene.E / (2 * (1 + scene.nu))
    lame = scene.E * scene.nu / ((1 + scene.nu) * (1 - 2 * scene.nu))
    e = ufl.sym(ufl.grad(u))
    return 2 * G * e + lame * ufl.tr(e) * ufl.Identity(2)


def bulk(scene: Scene, u: Any, v: Any) -> Any:
    """Residual without contact."""
    ds = ufl.Measure("ds", domain=scene.mesh, subdomain_data=scene.tags)
    return ufl.inner(stress(scene, u), ufl.grad(v)) * ufl.dx - scene.load(v, ds)


@dataclass
class Found:
    """A solution on Γc: coordinate along it, pressure, penetration, shear, areas of the points."""

    displacement: float
    x: Array
    pressure: Array
    penetration: float
    shear: float
    measure: Array
    iterations: int

    def row(self, reference: Found) -> timing.Row:
        """What the table has of it."""
        order = np.argsort(reference.x)
        exact = np.interp(self.x, reference.x[order], reference.pressure[order])
        norm = np.sqrt(self.measure @ exact**2)
        peak = reference.pressure.max()
        row: timing.Row = {
            "displacement, error": abs(self.displacement / reference.displacement - 1),
            "peak pressure, error": abs(self.pressure.max() / peak - 1),
            "pressure, error": float(np.sqrt(self.measure @ (self.pressure - exact) ** 2) / norm),
        }
        if reference.shear:
            row["shear, error"] = abs(self.shear / reference.shear - 1)
        return row | {"penetration": self.penetration, "iterations": self.iterations}


def by_package(
    scene: Scene, stiffness: float, enforcement: str, tolerance: float = 1e-5, **options: Any
) -> Found:
    """Penalty or multipliers."""
    V = fem.functionspace(scene.mesh, ("Lagrange", 2, (2,)))
    u, v = fem.Function(V), ufl.TestFunction(V)
    k = fc.Scaled(stiffness)
    law: Any = fc.Coulomb(scene.friction, k, k) if scene.friction else fc.Frictionless(k)
    surface = fc.ContactSurface(scene.mesh, scene.tags, scene.contact_tag, **options)
    contact = fc.Contact(
        u, surface, fc.HalfSpace((0, 0), (0, 1)), law, enforcement=enforcement, tolerance=tolerance
    )
    problem = fc.ContactProblem(bulk(scene, u, v), u, bcs=scene.bcs(V), contacts=[contact])
    step = problem.solve()
    shear = contact.tangential_traction[:, 0]
    return Found(
        displacement=scene.measure(u),
        x=contact.points[:, 0],
        pressure=contact.pressure,
        penetration=step.contacts["contact"].max_penetration,
        shear=float(contact.measure @ shear),
        measure=contact.measure,
        iterations=step.iterations,
    )


class NewtonFailed(RuntimeError):
    """Newton's method by hand did not converge."""


def by_nitsche(scene: Scene, factor: float, share: float) -> Found:
    """Nitsche's method for contact with friction (Chouly, Hild), γ = kE/h.

    ∫ σ(u):ε(v) - θ ∫ σ(u)n·σ(v)n/γ + ∫ P(σ(u)n - γ jump)·(θ σ(v)n/γ - v) over Γc, P the projection
    onto pressures and tractions within the cone; θ = ``share``, 1: symmetric without friction.
    """
    V = fem.functionspace(scene.mesh, ("Lagrange", 2, (2,)))
    u, v = fem.Function(V), ufl.TestFunction(V)
    gamma = factor * scene.E / scene.size
    theta = fem.Constant(scene.mesh, share)
    surface = fc.ContactSurface(scene.mesh, scene.tags, scene.contact_tag)
    quadrature = surface.quadrature(2)
    n, t = ufl.as_vector([0.0, -1.0]), ufl.as_vector([1.0, 0.0])
    down = -(ufl.SpatialCoordinate(scene.mesh)[1] + u[1])  # u_n - s

    def on_surface(w: Any) -> tuple[Any, Any]:
        traction = ufl.dot(stress(scene, w), ufl.FacetNormal(scene.mesh))
        return ufl.dot(traction, n), ufl.dot(traction, t)

    (s_n, s_t), (sv_n, sv_t) = on_surface(u), on_surface(v)
    r_n = ufl.min_value(s_n - gamma * down, 0.0)
    tau = ufl.as_ufl(0.0)
    if scene.friction:
        limit = -scene.friction * r_n
        tau = ufl.max_value(-limit, ufl.min_value(s_t - gamma * u[0], limit))
    F = bulk(scene, u, v)
    F += theta / gamma * ((r_n - s_n) * sv_n + (tau - s_t) * sv_t) * quadrature.ds
    F -= (r_n * ufl.dot(v, n) + tau * v[0]) * quadrature.ds
    bcs = scene.bcs(V)
    residual = fem.form(F)
    tangent = fem.form(ufl.derivative(F, u, ufl.TrialFunction(V)))
    matrix = fem.petsc.create_matrix(tangent)
    ksp = PETSc.KSP().create(scene.mesh.comm)
    ksp.setOperators(matrix)
    ksp.setType("preonly")
    symmetric = share == 1.0 and not scene.friction
    ksp.getPC().setType("cholesky" if symmetric else "lu")
    if symmetric:
        matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    ksp.getPC().setFactorSolverType("mumps")
    u.x.array.reshape(-1, 2)[:, 1] = -scene.push
    fem.set_bc(u.x.array, bcs)
    step = u.x.petsc_vec.duplicate()
    size, iterations = 0.0, 0
    while True:
        b = fem.petsc.assemble_vector(residual)
        fem.petsc.set_bc(b, bcs, u.x.petsc_vec, alpha=-1.0)
        size = max(size, b.norm())
        if b.norm() <= 1e-9 * size:
            break
        if iterations == 60 or not np.isfinite(b.norm()):
            raise NewtonFailed
        matrix.zeroEntries()
        fem.petsc.assemble_matrix(matrix, tangent, bcs=bcs)
        matrix.assemble()
        ksp.solve(b, step)
        u.x.petsc_vec.axpy(-1.0, step)
        iterations += 1
    fields = {"x": ufl.SpatialCoordinate(scene.mesh), "p": -r_n, "tau": tau, "down": down}
    points = PointEvaluator(quadrature, fields)()
    return Found(
        displacement=scene.measure(u),
        x=points["x"][:, 0],
        pressure=points["p"],
        penetration=float(max(points["down"].max(), 0.0)),
        shear=float(quadrature.weights @ points["tau"]),
        measure=quadrature.weights,
        iterations=iterations,
    )


def methods(make: Callable[[], Scene]) -> dict[str, Callable[[], Found]]:
    """What to compare, by name."""
    found: dict[str, Callable[[], Found]] = {
        f"penalty {k:g}": lambda k=k: by_package(make(), k, "penalty") for k in PENALTIES
    }
    found["augmented 10"] = lambda: by_package(make(), 10.0, "augmented")
    found |= {name: lambda p=p: by_nitsche(make(), *p) for name, p in NITSCHE.items()}
    return found


def compare(
    name: str, make: Callable[[float], Scene], size: float, finer: float, folder: Path, repeat: int
) -> None:
    """One scene: a table and a plot."""
    reference = by_package(make(finer), 10.0, "augmented", tolerance=1e-8)
    coarse: Any = {"GRECO": 8}.get(name.split()[0], 0.5)

    def timed(run: Callable[[], Found]) -> timing.Row:
        try:
            return run().row(reference)
        except (fc.NotConverged, NewtonFailed):
            return {"iterations": "none"}

    runs, first = (
        {n: partial(timed, run) for n, run in methods(partial(make, s)).items()}
        for s in (size, coarse)
    )
    make(size)
    rows = timing.measure(runs, repeat=repeat, first=first)
    rows = timing.in_units_of(rows, YARDSTICK, "time / penalty 10")
    dofs = fem.functionspace(make(size).mesh, ("Lagrange", 2, (2,))).dofmap.index_map.size_global
    note = f"Reference: displacement {reference.displacement:.9g}, peak pressure "
    note += f"{reference.pressure.max():.7g}, shear {reference.shear:.7g}."
    stem = name.lower().replace(" ", "_").replace("=", "").replace("μ", "mu").replace(".", "")
    timing.write(folder, stem, f"{name}, {2 * dofs} dofs", rows, note)
    done = [row for row in rows if row["iterations"] != "none"]
    kinds = dict.fromkeys(row["run"].split()[0] for row in done)
    series = {
        kind: tuple(
            [row[column] for row in done if row["run"].startswith(kind)]
            for column in ("seconds", "displacement, error")
        )
        for kind in kinds
    }
    timing.draw(folder / f"{stem}.png", name, "seconds", "error of the displacement", series)


def main() -> None:
    """Run."""
    parser = timing.parser(__doc__, "enforcement")
    parser.add_argument("--h", type=float, default=0.02, help="cells of the half-cylinder")
    parser.add_argument("--cells", type=int, default=64, help="cells of a side of the block")
    arguments = parser.parse_args()
    if MPI.COMM_WORLD.size > 1:
        parser.error("times are of one rank")
    h, cells = (0.1, 16) if arguments.short else (arguments.h, arguments.cells)
    for friction in (0.0, 0.2):
        name = f"Half-cylinder μ = {friction:g}"
        cylinder = partial(half_cylinder, friction)
        compare(name, cylinder, h, h / 2, arguments.output, arguments.repeat)
    greco = partial(block, greco_block.FRICTION)
    compare("GRECO block", greco, cells, 2 * cells, arguments.output, arguments.repeat)


if __name__ == "__main__":
    np.seterr(all="ignore")
    main()
