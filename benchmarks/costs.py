"""What contact costs in units of one linear solve: the yardsticks, and the study of a scene.

The yardsticks are what a user of DOLFINx writes: one linear solve, and a penalty form with Newton's
method (SNES ``newtonls``, the consistent tangent, MUMPS' LU in every step).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import dolfinx.fem.petsc  # noqa: F401
import timing
import ufl
from dolfinx import fem
from petsc4py import PETSc

import fenics_contact as fc

YARDSTICK = "one linear solve"
Row = timing.Row


class Scene(Protocol):
    """A body and its contact, of some size.

    Attributes:
        n_dofs, n_contact_dofs: Unknowns, and those of Γc.
    """

    n_dofs: int
    n_contact_dofs: int

    def linear(self) -> Row:
        """One linear solve of the body, glued to what it touches."""

    def plain(self, friction: float) -> Row:
        """By a penalty form of one's own, the load in one increment."""

    def package(self, friction: float, steps: int, field: str, **options: Any) -> Row:
        """By `fenics_contact`."""


def linear_solve(a: ufl.Form, L: ufl.Form, bcs: Sequence[fem.DirichletBC], u: fem.Function) -> Row:
    """Assemble, factor, solve; by Cholesky's method, half of the work of LU."""
    bilinear, linear = fem.form(a), fem.form(L)
    matrix = fem.petsc.assemble_matrix(bilinear, bcs)
    matrix.assemble()
    matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    b = fem.petsc.assemble_vector(linear)
    fem.petsc.apply_lifting(b, [bilinear], [bcs])
    b.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
    fem.petsc.set_bc(b, bcs)
    ksp = PETSc.KSP().create(matrix.comm)
    ksp.setOperators(matrix)
    _direct(ksp, "cholesky")
    ksp.solve(b, u.x.petsc_vec)
    return {"iterations": 1, "factorisations": 1}


def newton(F: ufl.Form, u: fem.Function, bcs: Sequence[fem.DirichletBC], size: float) -> Row:
    """Newton's method on a form with contact in it, from the present u.

    Args:
        F: Residual.
        u: Displacement.
        bcs: Conditions that u meets.
        size: Of the forces; the residual gets 1e-9 of it, as in the package.
    """
    residual = fem.form(F)
    tangent = fem.form(ufl.derivative(F, u, ufl.TrialFunction(u.function_space)))
    matrix, b = fem.petsc.create_matrix(tangent), fem.petsc.create_vector(residual)

    def assemble_residual(snes: PETSc.SNES, x: PETSc.Vec, f: PETSc.Vec) -> None:
        x.copy(u.x.petsc_vec)
        with f.localForm() as local:
            local.set(0.0)
        fem.petsc.assemble_vector(f, residual)
        fem.petsc.set_bc(f, bcs, x, alpha=-1.0)

    def assemble_tangent(snes: PETSc.SNES, x: PETSc.Vec, J: PETSc.Mat, P: PETSc.Mat) -> None:
        J.zeroEntries()
        fem.petsc.assemble_matrix(J, tangent, bcs=bcs)
        J.assemble()

    snes = PETSc.SNES().create(b.comm)
    snes.setType("newtonls")
    snes.setFunction(assemble_residual, b)
    snes.setJacobian(assemble_tangent, matrix)
    snes.setTolerances(rtol=0.0, atol=1e-9 * size, stol=0.0, max_it=60)
    snes.setOptionsPrefix("plain_")
    PETSc.Options().setValue("plain_snes_linesearch_type", "basic")  # `bt` often fails in contact
    snes.setFromOptions()
    _direct(snes.ksp, "lu")
    x = u.x.petsc_vec.copy()
    snes.solve(None, x)
    if snes.getConvergedReason() <= 0:
        return {"iterations": "none", "factorisations": snes.getIterationNumber()}
    return {"iterations": snes.getIterationNumber(), "factorisations": snes.getIterationNumber()}


def _direct(ksp: PETSc.KSP, kind: str) -> None:
    ksp.setType("preonly")
    ksp.pc.setType(kind)
    ksp.pc.setFactorSolverType("mumps")


def contact_dofs(space: fem.FunctionSpace, facets: Any) -> int:
    """Number of dofs on facets, on one rank."""
    tdim = space.mesh.topology.dim
    found = fem.locate_dofs_topological(space, tdim - 1, facets)
    return int(found.size * space.dofmap.bs)


def increments(problem: fc.ContactProblem, load: Any, end: float, steps: int, field: str) -> Row:
    """Lead the load to its end."""
    try:
        made = list(fc.increments(problem, load, 0.0, end, steps=steps, field=field, max_cuts=0))
    except fc.NotConverged:
        return {"iterations": "none", "factorisations": ""}
    return {
        "iterations": sum(step.iterations for step in made),
        "factorisations": sum(step.factorisations for step in made),
    }


def runs(
    scene: Scene, frictions: Sequence[float], histories: Sequence[int], *, all_unknowns: bool
) -> dict[str, Callable[[], Row]]:
    """What to time, by name.

    Args:
        scene: The scene.
        frictions: Coefficients.
        histories: Numbers of increments, of the cases with friction.
        all_unknowns: Whether histories are done on all unknowns, too, which takes minutes.
    """
    found: dict[str, Callable[[], Row]] = {YARDSTICK: scene.linear}
    ways: dict[str, dict[str, Any]] = {
        "condensed": {"condensation": True},
        "condensed, L-BFGS": {"condensation": True, "method": "lbfgs"},
        "all unknowns, L-BFGS": {"condensation": False, "method": "lbfgs"},
    }
    for friction in frictions:
        case = f"μ = {friction:g}"
        found[f"{case}: plain DOLFINx"] = lambda f=friction: scene.plain(f)
        for steps in histories if friction else [1]:
            for way, options in ways.items():
                if steps > 1 and not options["condensation"] and not all_unknowns:
                    continue
                fields = ("last",) if steps == 1 or "method" in options else ("last", "every")
                for field in fields:
                    name = f"{case}, {steps} increments: {way}"
                    if field == "every":
                        name += ", every field"
                    found[name] = lambda f=friction, s=steps, w=field, o=options: scene.package(
                        f, s, w, **o
                    )
    return found


def study(
    name: str,
    title: str,
    scenes: Mapping[str, Callable[[], Scene]],
    choose: Callable[[Scene], dict[str, Callable[[], Row]]],
    arguments: argparse.Namespace,
) -> None:
    """Time the runs of a scene in its sizes; write tables and plots.

    Args:
        name: Of the files.
        title: Of the tables.
        scenes: Make the scene in its sizes, smallest first; by the name of the size. The table
            is of the last.
        choose: The runs of a scene.
        arguments: Those of `timing.parser`.
    """
    everything: list[Row] = []
    waits: dict[str, float] = {}  # of the smallest scene, which compiles the forms
    for size, make in scenes.items():
        scene = make()
        chosen = choose(scene)
        rows = timing.measure(chosen, repeat=arguments.repeat, first=None if waits else chosen)
        waits = waits or {row["run"]: row.pop("first use [s]") for row in rows}
        rows = timing.in_units_of(rows, YARDSTICK, "linear solves")
        if size == list(scenes)[-1]:
            rows = [row | {"first use [s]": waits[row["run"]]} for row in rows]
            heading = f"{title}: {scene.n_dofs} dofs, {scene.n_contact_dofs} of the contact surface"
            heading += f", medians of {arguments.repeat}"
            timing.write(arguments.output, name, heading, rows)
        sizes = {"size": size, "dofs": scene.n_dofs, "contact dofs": scene.n_contact_dofs}
        everything += [sizes | row for row in rows]
    columns = ("dofs", "contact dofs", "run", "iterations", "seconds", "linear solves")
    short = [{column: row[column] for column in columns} for row in everything]
    timing.write(arguments.output, f"{name}_sizes", f"{title}: cost by size", short)
    for x in ("dofs", "contact dofs"):
        series = {}
        for run in dict.fromkeys(row["run"] for row in everything):
            mine = [row for row in everything if row["run"] == run and row["iterations"] != "none"]
            series[run] = [row[x] for row in mine], [row["seconds"] for row in mine]
        path = arguments.output / f"{name}_{x.replace(' ', '_')}.png"
        timing.draw(path, title, x, "seconds", series)
