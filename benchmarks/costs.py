"""Measure the cost of contact in units of one linear solve of the same body.

`study` times a problem on several meshes. The reference solvers are those that a user of DOLFINx
would write: one linear solve, and a penalty form with Newton's method (SNES ``newtonls``,
consistent tangent) and LU by MUMPS or GMRES with GAMG.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import dolfinx.fem.petsc  # noqa: F401
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from benchmarks import timing
from fenics_contact.surface.surface import PointEvaluator
from fenics_contact.systems import linear
from scenes import problems
from scenes.elasticity import dirichlet_bc

REFERENCE_RUN = "one linear solve"
# Suffix of the names of histories with ``recover_interior="last"``.
LAST_INTERIOR = ", interior at the end"
PLAIN = {"direct": "plain DOLFINx, LU", "multigrid": "plain DOLFINx, GMRES + GAMG"}
# Residual relative to the forces in all runs; the default of the package.
TOLERANCE = 1e-9
# Runs that take longer are not repeated (s).
MAX_REPEATED_TIME = 30.0
Row = timing.Row

_FORWARD = (PETSc.InsertMode.INSERT, PETSc.ScatterMode.FORWARD)
_REVERSE = (PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)


@dataclass(frozen=True)
class Case:
    """A body and the runs that are timed on it.

    Attributes:
        body: The body.
        degree: Polynomial degree of the displacement.
        stiffness: k_n = k_t in units of E/h.
        errors: Returns the columns of errors, from friction, number of increments and the results
            "u", "peak" and "force"; none by default.
    """

    body: problems.ContactScene
    degree: int
    stiffness: float
    errors: Callable[[float, int, Row], Row] = lambda friction, steps, results: {}

    @cached_property
    def _space(self) -> fem.FunctionSpace:
        return problems.elasticity_problem(self.body, self.degree)[0].function_space

    @property
    def n_dofs(self) -> int:
        """Number of dofs."""
        return problems.n_dofs(self._space)

    @property
    def n_contact_dofs(self) -> int:
        """Number of dofs on Γc. Collective."""
        return problems.n_facet_dofs(self._space, self.body.tags.find(self.body.surface))

    def linear(self, kind: str = "direct") -> Row:
        """Solve the body once, without contact, by `linear_solve`."""
        return linear_solve(self.body, self.degree, kind)

    def plain(self, friction: float, kind: str = "direct") -> Row:
        """Solve a hand-written penalty form in one increment by `newton`."""
        body = replace(self.body, friction=friction)
        u, F, load, bcs = problems.elasticity_problem(body, self.degree)
        load.value = body.final_load
        pressure, traction = problems.reference_penalty_traction(body, u, load, self.stiffness)
        # The quadrature of the package, so that the results agree to all digits.
        points = {"quadrature_degree": 2 * self.degree}
        ds = ufl.Measure("ds", body.mesh, subdomain_data=body.tags, metadata=points)(body.surface)
        F -= ufl.dot(traction, ufl.TestFunction(u.function_space)) * ds
        if body.initial_displacement:
            for i, value in enumerate(body.initial_displacement):
                u.x.array[i :: len(u)] = value
        fem.set_bc(u.x.array, bcs)
        row = newton(F, u, bcs, body.force_scale / self.n_contact_dofs**0.5, kind)
        if row["iterations"] == "none":
            return row
        force = fem.assemble_scalar(fem.form(pressure * ds))
        results = {"u": body.displacement(u), "force": body.mesh.comm.allreduce(force)}
        rule = fc.ContactSurface(body.mesh, body.tags, body.surface).quadrature(self.degree)
        values = PointEvaluator(rule, {"pressure": pressure})()["pressure"]
        results["peak"] = body.mesh.comm.allreduce(values.max(initial=0.0), op=MPI.MAX)
        return row | results | self.errors(friction, 1, results)

    def package(self, friction: float, steps: int = 1, field: str = "every", **options: Any) -> Row:
        """Solve by `fenics_contact`; ``options`` are those of `ContactProblem`."""
        body = replace(self.body, friction=friction)
        problem, contact, u, load = problems.problem(body, self.degree, self.stiffness, **options)
        try:
            made = list(
                fc.increments(
                    problem,
                    load,
                    0.0,
                    body.final_load,
                    steps=steps,
                    recover_interior=field,
                    max_cuts=0,
                )
            )
        except fc.NotConverged:
            return {"iterations": "none", "factorisations": ""}
        kind = "condensed" if problem.solver.condensed else problem.full.linear_kind
        found = contact.resultants()
        results = {
            "u": body.displacement(u),
            "force": found.normal_force,
            "peak": found.max_pressure,
        }
        row: Row = {
            "solver": f"{made[-1].method}, {kind}",
            "iterations": sum(step.iterations for step in made),
            "factorisations": sum(step.factorisations for step in made),
        }
        return row | results | self.errors(friction, steps, results)


def linear_solve(body: problems.ContactScene, degree: int, kind: str = "direct") -> Row:
    """Assemble and solve a body with Γc fixed or loaded: the unit of time. Collective.

    Args:
        body: The body.
        degree: Polynomial degree of the displacement.
        kind: "direct": MUMPS' Cholesky factorisation, half the operations of LU; "multigrid":
            conjugate gradients with GAMG, to `TOLERANCE`.
    """
    u, residual, load, bcs = problems.elasticity_problem(body, degree)
    load.value = body.final_load
    if body.linear_solve_load_work:
        residual -= body.linear_solve_load_work(ufl.TestFunction(u.function_space), body.ds)
    bcs += [
        dirichlet_bc(u, body.tags, tag, i)
        for tag in body.linear_solve_fixed_facets
        for i in range(len(u))
    ]
    return solve_once(u, residual, bcs, kind)


def now() -> float:
    """Return the time when all ranks are here (s). Collective."""
    MPI.COMM_WORLD.Barrier()
    return time.perf_counter()


def time_of_tied_bodies(
    problem: fc.ContactProblem, u: fem.Function, residual: ufl.Form, repeat: int
) -> float:
    """Return the median time of one linear solve of bodies tied at all contacts (s). Collective.

    Args:
        problem: A problem, whose contacts are evaluated.
        u: Displacement, which becomes the solution.
        residual: Residual form of the bodies, linear in u.
        repeat: Number of runs.
    """
    operators = problem.full.operators
    ties = [o.springs(o.contact.values.springs(1.0, 1.0)) for o in operators]  # k_n and k_t
    times = []
    for _ in range(repeat + 1):
        start = now()
        solve_once(u, residual, problem.full.bcs, ties=ties)
        times.append(now() - start)
    return statistics.median(times[1:])  # the first run compiles the forms


def solve_once(
    u: fem.Function,
    residual: ufl.Form,
    bcs: Sequence[fem.DirichletBC],
    kind: str = "direct",
    ties: Sequence[PETSc.Mat] = (),
) -> Row:
    """Assemble and solve a problem that is linear in u, which becomes the solution. Collective.

    Args:
        u: Displacement.
        residual: Residual form F.
        bcs: Dirichlet conditions.
        kind: "direct" or "multigrid", as in `linear_solve`.
        ties: Matrices to be added, which tie bodies.
    """
    bilinear = fem.form(ufl.derivative(residual, u))
    matrix = fem.petsc.assemble_matrix(bilinear, bcs)
    matrix.assemble()
    for tie in ties:
        matrix.axpy(1.0, tie, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
    matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    b = fem.petsc.assemble_vector(fem.form(-residual))
    b.ghostUpdate(*_REVERSE)
    fem.petsc.set_bc(b, bcs)
    options = linear.options(kind, symmetric=True, accurate=True)
    if kind == "multigrid":
        matrix.setNearNullSpace(linear.near_nullspace(u.function_space))
        options |= {"ksp_rtol": TOLERANCE}
    ksp = PETSc.KSP().create(matrix.comm)
    ksp.setOperators(matrix)
    _configure(ksp, "yardstick_", options)
    ksp.solve(b, u.x.petsc_vec)
    reason, iterations = ksp.getConvergedReason(), ksp.getIterationNumber()
    for made in (ksp, matrix, b):
        made.destroy()
    if reason <= 0:
        raise RuntimeError(f"the linear solve did not converge: {reason}")
    return {"iterations": iterations, "factorisations": int(kind == "direct")}


def newton(
    F: ufl.Form,
    u: fem.Function,
    bcs: Sequence[fem.DirichletBC],
    size: float,
    kind: str = "direct",
    *,
    lift: bool = False,
) -> Row:
    """Solve a form by Newton's method, from the present u. Collective.

    Args:
        F: Residual form.
        u: Displacement.
        bcs: Dirichlet conditions, which u satisfies unless ``lift``.
        size: Norm of the forces; the residual is reduced to `TOLERANCE` of it.
        kind: "direct": LU by MUMPS; "multigrid": GMRES with GAMG and the rigid-body modes as
            near-nullspace, to PETSc's default of 1e-5 of the residual.
        lift: Whether the first step imposes the values of ``bcs``.
    """
    residual = fem.form(F)
    tangent = fem.form(ufl.derivative(F, u, ufl.TrialFunction(u.function_space)))
    matrix, b = fem.petsc.create_matrix(tangent), u.x.petsc_vec.duplicate()

    def assemble_residual(snes: PETSc.SNES, x: PETSc.Vec, f: PETSc.Vec) -> None:
        x.copy(u.x.petsc_vec)
        u.x.petsc_vec.ghostUpdate(*_FORWARD)
        with f.localForm() as local:
            local.set(0.0)
        fem.petsc.assemble_vector(f, residual)
        if lift:
            fem.petsc.apply_lifting(f, [tangent], [bcs], [x], alpha=-1.0)
        f.ghostUpdate(*_REVERSE)
        fem.petsc.set_bc(f, bcs, x, alpha=-1.0)

    def assemble_tangent(snes: PETSc.SNES, x: PETSc.Vec, J: PETSc.Mat, P: PETSc.Mat) -> None:
        J.zeroEntries()
        fem.petsc.assemble_matrix(J, tangent, bcs=bcs)
        J.assemble()

    snes = PETSc.SNES().create(b.comm)
    snes.setType("newtonls")
    snes.setFunction(assemble_residual, b)
    snes.setJacobian(assemble_tangent, matrix)
    snes.setTolerances(rtol=0.0, atol=TOLERANCE * size, stol=0.0, max_it=60)
    options = {"snes_linesearch_type": "basic"}  # `bt` often fails in contact
    if kind == "multigrid":
        matrix.setNearNullSpace(linear.near_nullspace(u.function_space))
        # The fastest of the variants tried. Jacobi smoothing needs twice the iterations at half the
        # cost; with tolerances that follow the residual Newton's method fails with contact.
        options |= {"ksp_type": "gmres", "pc_type": "gamg", "mg_levels_pc_type": "sor"}
    else:
        options |= {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}
    _configure(snes, "plain_", options)
    x = u.x.petsc_vec.copy()
    snes.solve(None, x)
    assemble_residual(snes, x, b)
    iterations, linear_iterations = snes.getIterationNumber(), snes.getLinearSolveIterations()
    done = snes.getConvergedReason() > 0
    for made in (snes, matrix, b, x):
        made.destroy()
    row: Row = {"iterations": iterations if done else "none", "factorisations": iterations}
    if kind == "multigrid":
        row |= {"factorisations": 0, "linear iterations": linear_iterations}
    return row


def _configure(solver: PETSc.KSP | PETSc.SNES, prefix: str, options: Mapping[str, Any]) -> None:
    """Set options of a solver; command-line options with the prefix take precedence."""
    database = PETSc.Options(prefix)
    mine = {name: value for name, value in options.items() if not database.hasName(name)}
    for name, value in mine.items():
        database[name] = value
    solver.setOptionsPrefix(prefix)
    solver.setFromOptions()
    if isinstance(solver, PETSc.KSP):
        solver.setUp()
    for name in mine:
        database.delValue(name)


def runs(
    case: Case, frictions: Sequence[float], histories: Sequence[int], *, all_unknowns: bool
) -> dict[str, Callable[[], Row]]:
    """Return the runs to time, by name.

    Args:
        case: The problem.
        frictions: Friction coefficients.
        histories: Numbers of increments of the runs with friction.
        all_unknowns: Whether several increments are also solved on all dofs, which takes minutes.
    """
    found: dict[str, Callable[[], Row]] = {REFERENCE_RUN: case.linear}
    variants: dict[str, dict[str, Any]] = {
        "by default": {},
        "condensed, L-BFGS": {"condensation": True, "method": "lbfgs"},
        "all dofs, L-BFGS": {"condensation": False, "method": "lbfgs"},
    }
    for friction in frictions:
        name = f"μ = {friction:g}"
        found[f"{name}: {PLAIN['direct']}"] = partial(case.plain, friction)
        for steps in histories if friction else [1]:
            for variant, options in variants.items():
                whole = not options.get("condensation", True)
                if steps > 1 and whole and not all_unknowns:
                    continue
                fields = ["every"] * (steps == 1 or variant == "by default")
                fields += ["last"] * (steps > 1)
                for field in fields:
                    run = f"{name}, {steps} increments: {variant}"
                    run += LAST_INTERIOR if field == "last" else ""
                    found[run] = partial(case.package, friction, steps, field, **options)
    return found


def parser(documentation: str | None, folder: str) -> argparse.ArgumentParser:
    """Return the options of a `study`: those of `timing.parser`, ``--stiffness``, ``--only``."""
    made = timing.parser(documentation, folder)
    made.add_argument("--stiffness", type=float, default=10.0, help="k_n h/E = k_t h/E")
    made.add_argument("--only", default="", help="runs whose name contains this")
    return made


def study(
    name: str,
    title: str,
    cases: Mapping[str, Callable[[], Case]],
    choose: Callable[[Case], dict[str, Callable[[], Row]]],
    arguments: argparse.Namespace,
) -> None:
    """Time the runs of a problem on several meshes; write the tables.

    Args:
        name: Stem of the files.
        title: Title of the tables.
        cases: Create the problem in its sizes, smallest first, by name of the size. The detailed
            table is of the last.
        choose: Returns the runs of a problem, of which ``--only`` selects some.
        arguments: Parsed options of `parser`.
    """
    everything: list[Row] = []
    waits: dict[str, float] = {}  # of first runs on the smallest mesh
    for size, make in cases.items():
        case = make()
        only = arguments.only
        chosen = {n: run for n, run in choose(case).items() if only in n or n == REFERENCE_RUN}
        rows = timing.measure(
            chosen, repeat=arguments.repeat, first=None if waits else chosen, once=MAX_REPEATED_TIME
        )
        waits = waits or {row["run"]: row.pop("first run [s]") for row in rows}
        rows = timing.in_units_of(rows, REFERENCE_RUN, "linear solves")
        if size == list(cases)[-1]:
            rows = [row | {"first run [s]": waits[row["run"]]} for row in rows]
            heading = f"{title}: {case.n_dofs} dofs, {case.n_contact_dofs} on Γc"
            heading += f", medians of {arguments.repeat} (one run above {MAX_REPEATED_TIME:g} s)"
            timing.write(arguments.output, name, heading, rows)
        sizes = {"size": size, "dofs": case.n_dofs, "contact dofs": case.n_contact_dofs}
        everything += [sizes | row for row in rows]
    columns = ("dofs", "contact dofs", "run", "iterations", "seconds", "linear solves")
    short = [{column: row[column] for column in columns} for row in everything]
    timing.write(arguments.output, f"{name}_sizes", f"{title}: cost by size", short)
