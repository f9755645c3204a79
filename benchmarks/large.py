r"""Ball on a block in three dimensions, from thirty thousand to a million unknowns.

A rigid ball is pressed with friction, in one increment, on a quarter of an elastic block of linear
hexahedra; half of the cells of each edge lie on Γc, 1.5 contact radii wide. Timed, every run in a
process of its own, so that its peak memory is its own: one linear solve of the same body by
multigrid (the yardstick) and by a factorisation; this package as it chooses by itself, and as it is
told; and Newton's method as a user of DOLFINx writes it, by LU and by GMRES with multigrid. All to
1e-9 of the forces, the script's linear solves to PETSc's 1e-5. Meshes and compiled forms are not
counted.

    OMP_NUM_THREADS=1 python benchmarks/large.py
    OMP_NUM_THREADS=1 python benchmarks/large.py --cells 69 --runs "linear, multigrid" contact
    OMP_NUM_THREADS=1 python benchmarks/large.py --cells 32 47 --ranks 1 2 \
        --runs "contact, multigrid"

The force is compared with the finest mesh's, and with Hertz's F = 4/3 E* √R d^{3/2} for a
half-space without friction: the block is ten contact radii wide and held there, which stiffens it
by some a/L, and friction by two percent. "messages", "MB sent" and "reductions" are of one rank
(the largest) in the solution, as PETSc counts them; docs/parallel.md says what they are good for.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import dolfinx
import dolfinx.fem.petsc
import numpy as np
import scipy.optimize
import timing
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from fenics_contact import linear

COMM = MPI.COMM_WORLD
E, NU, FRICTION = 1.0, 0.3, 0.3
RADIUS, DEPTH = 8.0, 1.25e-3  # a = √(R d) = 0.1; the block's edge is 1
WIDTH = 0.15  # of Γc
FACTOR = 10.0  # k_n h/E = k_t h/E
TOLERANCE = 1e-9
YARDSTICK = "linear, multigrid"
CELLS = {31_944: 21, 107_811: 32, 331_776: 47, 1_029_000: 69}
# Factorisations of more unknowns than this are minutes, or do not fit.
MANY = 150_000


class Body:
    """A quarter of the block below z = 0 without contact, as a user of DOLFINx writes it."""

    def __init__(self, cells: int) -> None:
        """Mesh it, with ``cells`` along each edge. Collective."""
        edges = (cells,) * 3
        self.mesh = dolfinx.mesh.create_unit_cube(COMM, *edges, dolfinx.mesh.CellType.hexahedron)
        x = self.mesh.geometry.x
        x[:] = np.interp(x, np.linspace(0, 1, cells + 1), graded(cells))
        x[:, 2] *= -1
        self.h = WIDTH / (cells // 2)
        self.space = fem.functionspace(self.mesh, ("Lagrange", 1, (3,)))
        self.n_dofs = self.space.dofmap.index_map.size_global * 3
        facets = dolfinx.mesh.locate_entities_boundary(
            self.mesh, 2, lambda x: np.isclose(x[2], 0) & (np.max(x[:2], axis=0) < WIDTH + 1e-9)
        )
        values = np.ones(facets.size, dtype=np.int32)
        self.tags = dolfinx.mesh.meshtags(self.mesh, 2, np.sort(facets), values)
        far = [(i, lambda x: np.any(np.isclose(np.abs(x), 1), axis=0)) for i in range(3)]
        symmetry = [(i, lambda x, i=i: np.isclose(x[i], 0)) for i in range(2)]
        self.bcs = []
        for i, where in far + symmetry:
            found = dolfinx.mesh.locate_entities_boundary(self.mesh, 2, where)
            part = self.space.sub(i)
            dofs = fem.locate_dofs_topological(part, 2, found)
            self.bcs.append(fem.dirichletbc(PETSc.ScalarType(0.0), dofs, part))

    def bilinear(self, u: Any, v: Any) -> ufl.Form:
        """Linear elasticity."""
        G, lame = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
        e = ufl.sym(ufl.grad(u))
        stress = 2 * G * e + lame * ufl.tr(e) * ufl.Identity(3)
        return ufl.inner(stress, ufl.sym(ufl.grad(v))) * ufl.dx

    def ds(self) -> ufl.Measure:
        """On Γc, with the points that the package takes for linear displacements."""
        points = {"quadrature_degree": 2}
        return ufl.Measure("ds", self.mesh, subdomain_data=self.tags, metadata=points)(1)


def graded(cells: int) -> np.ndarray:
    """Places of the nodes on an edge: equal cells on Γc, then growing by a constant factor."""
    near = cells // 2
    h, away = WIDTH / near, np.arange(1, cells - near + 1)
    growth = scipy.optimize.brentq(lambda q: h * np.sum(q**away) - (1 - WIDTH), 1.0, 3.0)
    return np.concatenate([h * np.arange(near + 1), WIDTH + h * np.cumsum(growth**away)])


# ---- runs ----------------------------------------------------------------------------------------


def linear_solve(body: Body, kind: str) -> dict[str, Any]:
    """The body pressed on Γc by a given pressure: assemble, set up, solve."""
    v, w = ufl.TestFunction(body.space), ufl.TrialFunction(body.space)
    a, L = fem.form(body.bilinear(w, v)), fem.form(-v[2] * body.ds())
    matrix = fem.petsc.assemble_matrix(a, body.bcs)
    matrix.assemble()
    matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    b = fem.petsc.assemble_vector(L)
    b.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
    fem.petsc.set_bc(b, body.bcs)
    options = linear.options(kind, symmetric=True, accurate=True) | {"ksp_rtol": TOLERANCE}
    if kind == "multigrid":
        matrix.setNearNullSpace(linear.near_nullspace(body.space))
    ksp = solver(matrix, options)
    u = fem.Function(body.space)
    ksp.solve(b, u.x.petsc_vec)
    if ksp.getConvergedReason() <= 0:
        raise RuntimeError("the linear solve did not converge")
    return {"iterations": ksp.getIterationNumber()}


def solver(matrix: PETSc.Mat, options: dict[str, Any]) -> PETSc.KSP:
    """A linear solver with these options, set up."""
    ksp = PETSc.KSP().create(matrix.comm)
    ksp.setOperators(matrix)
    database = PETSc.Options()
    for name, value in options.items():
        database.setValue(name, value)
    ksp.setFromOptions()
    ksp.setUp()
    for name in options:
        database.delValue(name)
    return ksp


def package(body: Body, **options: Any) -> dict[str, Any]:
    """This package."""
    u, v = fem.Function(body.space), ufl.TestFunction(body.space)
    down = fem.Constant(body.mesh, 0.0)
    ball = fc.Ball((0, 0, RADIUS), RADIUS, displacement=ufl.as_vector([0, 0, down]))
    law = fc.Coulomb(FRICTION, k_n=fc.Scaled(FACTOR), k_t=fc.Scaled(FACTOR))
    contact = fc.Contact(u, fc.ContactSurface(body.mesh, body.tags, 1), ball, law)
    problem = fc.ContactProblem(body.bilinear(u, v), u, bcs=body.bcs, contacts=[contact], **options)
    down.value = -DEPTH
    step = problem.solve()
    resultants = step.contacts[contact.name]
    way = "condensed" if problem._condensed else problem._whole.linear_kind
    return {
        "way": f"{step.method}, {way}",
        "iterations": step.iterations,
        "force": 4 * resultants.normal_force,
        "peak pressure": resultants.max_pressure,
    }


def by_hand(body: Body, kind: str) -> dict[str, Any]:
    """A penalty form, its derivative and SNES, as in a script on top of DOLFINx."""
    u, v = fem.Function(body.space), ufl.TestFunction(body.space)
    k = FACTOR * E / body.h
    arm = ufl.SpatialCoordinate(body.mesh) - ufl.as_vector([0, 0, RADIUS - DEPTH])
    distance = ufl.sqrt(ufl.dot(arm, arm))
    n = -arm / distance  # from the body to the ball
    pressure = k * ufl.max_value(ufl.dot(u, n) - (distance - RADIUS), 0.0)
    jump = u + ufl.as_vector([0, 0, DEPTH])  # relative to the ball
    trial = -k * (jump - ufl.dot(jump, n) * n)
    size = ufl.sqrt(ufl.dot(trial, trial) + 1e-30)
    traction = ufl.conditional(
        ufl.lt(size, FRICTION * pressure), trial, FRICTION * pressure / size * trial
    )
    F = body.bilinear(u, v) - ufl.dot(traction - pressure * n, v) * body.ds()
    residual = fem.form(F)
    tangent = fem.form(ufl.derivative(F, u, ufl.TrialFunction(body.space)))
    matrix, b = fem.petsc.create_matrix(tangent), fem.petsc.create_vector(residual)
    forward = (PETSc.InsertMode.INSERT, PETSc.ScatterMode.FORWARD)

    def function(_: Any, x: PETSc.Vec, f: PETSc.Vec) -> None:
        x.copy(u.x.petsc_vec)
        u.x.petsc_vec.ghostUpdate(*forward)
        with f.localForm() as local:
            local.set(0.0)
        fem.petsc.assemble_vector(f, residual)
        f.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        fem.petsc.set_bc(f, body.bcs, x, -1.0)

    def jacobian(_: Any, x: PETSc.Vec, J: PETSc.Mat, P: PETSc.Mat) -> None:
        J.zeroEntries()
        fem.petsc.assemble_matrix(J, tangent, bcs=body.bcs)
        J.assemble()

    snes = PETSc.SNES().create(COMM)
    options: dict[str, Any] = {"snes_linesearch_type": "basic", "snes_rtol": TOLERANCE}
    options |= {"snes_max_it": 60, "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}
    options["ksp_type"] = "preonly"
    if kind == "multigrid":
        options |= {"ksp_type": "gmres", "pc_type": "gamg"}
        matrix.setNearNullSpace(linear.near_nullspace(body.space))
    database = PETSc.Options()
    for name, value in options.items():
        database.setValue(name, value)
    snes.setFunction(function, b)
    snes.setJacobian(jacobian, matrix)
    snes.setFromOptions()
    x = u.x.petsc_vec.copy()
    x.set(0.0)
    snes.solve(None, x)
    for name in options:
        database.delValue(name)
    function(snes, x, b)
    if snes.getConvergedReason() <= 0:
        return {"iterations": "none"}
    force = fem.assemble_scalar(fem.form(-4 * ufl.dot(traction - pressure * n, n) * body.ds()))
    return {"iterations": snes.getIterationNumber(), "force": COMM.allreduce(force)}


RUNS: dict[str, Callable[[Body], dict[str, Any]]] = {
    YARDSTICK: lambda body: linear_solve(body, "multigrid"),
    "linear, direct": lambda body: linear_solve(body, "direct"),
    "contact": package,
    "contact, multigrid": lambda body: package(body, linear_solver="multigrid"),
    "contact, multigrid, Newton": lambda body: package(
        body, linear_solver="multigrid", method="newton"
    ),
    "contact, condensed": lambda body: package(body, condensation=True),
    "by hand, GMRES + GAMG": lambda body: by_hand(body, "multigrid"),
    "by hand, LU": lambda body: by_hand(body, "direct"),
}
FACTORED = ("linear, direct", "contact, condensed", "by hand, LU")


# ---- one process for each ------------------------------------------------------------------------


def child(run: str, cells: int, repeat: int) -> None:
    """One run in this process; its row as JSON, the last line that rank 0 prints. Collective."""
    PETSc.Log.begin()
    start = time.perf_counter()
    RUNS[run](Body(6))
    first = time.perf_counter() - start
    body = Body(cells)
    times, before = [], counted()
    for _ in range(repeat):
        COMM.Barrier()
        start = time.perf_counter()
        row = RUNS[run](body)
        times.append(COMM.allreduce(time.perf_counter() - start, op=MPI.MAX))
    made = (counted() - before) / repeat
    flops, messages, sent, reductions = (COMM.allreduce(float(v), op=MPI.MAX) for v in made)
    row = {"run": run, "dofs": body.n_dofs, "ranks": COMM.size} | row
    row |= {"seconds": statistics.median(times), "GiB": timing.peak_memory()}
    row |= {"Gflop": flops / 1e9, "messages": messages, "MB sent": sent / 1e6}
    row |= {"reductions": reductions, "first use [s]": first}
    if COMM.rank == 0:
        print(json.dumps(row), flush=True)


def counted() -> np.ndarray:
    """Operations, messages, bytes sent and reductions of this rank so far, in solutions."""
    found = [PETSc.Log.Event(name).getPerfInfo() for name in ("KSPSolve", "SNESSolve")]
    # Linear solves inside of SNES are counted there.
    info = max(found, key=lambda item: item["flops"])
    return np.array([info[k] for k in ("flops", "numMessages", "messageLength", "numReductions")])


def start(run: str, cells: int, ranks: int, repeat: int) -> dict[str, Any]:
    """The row of a run in new processes."""
    command = [sys.executable, str(Path(__file__).resolve()), "--child", run]
    command += ["--cells", str(cells), "--repeat", str(repeat)]
    if ranks > 1:
        command = ["mpirun", "--oversubscribe", "-n", str(ranks), *command]
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("OMPI_COMM", "PMIX"))}
    done = subprocess.run(command, env=kept, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        return {"run": run, "ranks": ranks, "iterations": "failed", "seconds": float("nan")}
    return json.loads(done.stdout.strip().splitlines()[-1])


def main() -> None:
    """Run."""
    parser = timing.parser(__doc__, "large")
    parser.add_argument("--cells", type=int, nargs="*", help=f"along an edge; by default {CELLS}")
    parser.add_argument("--ranks", type=int, nargs="*", default=[1])
    parser.add_argument("--runs", nargs="*", choices=RUNS, default=list(RUNS))
    parser.add_argument("--child", choices=RUNS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        child(arguments.child, arguments.cells[0], arguments.repeat)
        return
    default = [12, 16] if arguments.short else list(CELLS.values())
    rows: list[dict[str, Any]] = []
    for cells in arguments.cells or default:
        n_dofs = 3 * (cells + 1) ** 3
        some = []
        for run in arguments.runs:
            if run in FACTORED and n_dofs > MANY:
                continue
            for ranks in arguments.ranks:
                if ranks > 1 and run == "contact, condensed":
                    continue
                repeat = 1 if n_dofs > MANY else arguments.repeat
                some.append(start(run, cells, ranks, repeat))
                print(some[-1], flush=True)
        for row in some:
            for name in (YARDSTICK, "linear, direct"):
                unit = [r["seconds"] for r in some if r["run"] == name and r["ranks"] == 1]
                if unit:
                    row[f"in solves ({name.split()[1]})"] = row["seconds"] / unit[0]
            one = [r for r in some if r["run"] == row["run"] and r["ranks"] == 1]
            if row["ranks"] > 1 and one:
                row["speed-up"] = one[0]["seconds"] / row["seconds"]
        rows += some
    finest = [row["force"] for row in rows if "force" in row]
    hertz = 4 / 3 * E / (1 - NU**2) * np.sqrt(RADIUS) * DEPTH**1.5
    for row in rows:
        if "force" in row:
            row["force/finest - 1"] = row["force"] / finest[-1] - 1
            row["force/Hertz - 1"] = row["force"] / hertz - 1
    title = f"Ball on a block, hexahedra, μ = {FRICTION:g}, k h/E = {FACTOR:g}"
    timing.write(arguments.output, "large", title, rows)
    series: dict[str, tuple[list[float], list[float]]] = {}
    memory: dict[str, tuple[list[float], list[float]]] = {}
    for row in rows:
        if row["ranks"] == 1 and "dofs" in row and row["iterations"] != "none":
            for picture, column in ((series, "seconds"), (memory, "GiB")):
                x, y = picture.setdefault(row["run"], ([], []))
                x.append(row["dofs"])
                y.append(row[column])
    timing.draw(arguments.output / "seconds.png", title, "unknowns", "seconds", series)
    timing.draw(arguments.output / "memory.png", title, "unknowns", "peak memory [GiB]", memory)


if __name__ == "__main__":
    main()
