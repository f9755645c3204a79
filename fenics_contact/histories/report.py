"""Report of a load history and its last state as one HTML page."""

from __future__ import annotations

import base64
import datetime
import os
import tempfile
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from dolfinx import fem

from fenics_contact.arguments import check_instance, check_positive
from fenics_contact.contact.contact import Contact
from fenics_contact.estimates.errors import ErrorBudget
from fenics_contact.histories import table
from fenics_contact.installation import information
from fenics_contact.laws.stiffness import NodalSprings, RelativeStiffness
from fenics_contact.markup import html_table
from fenics_contact.parallel import collective_errors, global_max
from fenics_contact.problem import ContactProblem
from fenics_contact.results import drawing, files, plotting
from fenics_contact.results.obstacles import shapes_of
from fenics_contact.step import Step
from fenics_contact.types import Array

__all__ = ["report"]

# Largest displacement after magnification, and round-off of coordinates, relative to the mesh size.
_MAGNIFIED_RATIO, _ROUND_OFF_RATIO = 0.05, float(np.finfo(float).eps)
# Labels of the energies in legends.
_ENERGIES = {
    "work": "work of loads and motions",
    "elastic": "elastic energy",
    "springs": "contact springs (k_n, k_t)",
    "dissipation": "dissipation by friction",
    "remainder": "remainder",
}
_REMAINDER = (
    "The work of an increment is computed with the mean of the forces at its two ends. Changes of "
    "contact within an increment, and contact springs released at opening, leave a remainder. It "
    "decreases with the increment size; if it is large compared with the work, the increments are "
    "too large for accurate energies."
)
_STYLE = """
body { font: 15px/1.5 sans-serif; color: #1a1a1a; max-width: 72rem; margin: 2rem auto;
  padding: 0 1rem; }
h1, h2, h3 { line-height: 1.2; } h2 { border-bottom: 1px solid #bbb; margin-top: 2.2rem; }
table { border-collapse: collapse; margin: 1rem 0; font-variant-numeric: tabular-nums; }
caption { text-align: left; font-weight: bold; padding: .2rem 0; white-space: nowrap; }
th, td { border-bottom: 1px solid #ddd; padding: .2rem .7rem; text-align: right; }
th:first-child { text-align: left; font-weight: normal; }
thead th, thead th:first-child { font-weight: bold; border-bottom: 1px solid #666; }
.words td, .words th { text-align: left; }
.words td { overflow-wrap: anywhere; }
.pictures { display: grid; grid-template-columns: repeat(auto-fit, minmax(24rem, 1fr));
  gap: 1rem; }
figure { margin: 0; } figure img { max-width: 100%; }
.pictures figure:only-child { max-width: 42rem; }
figcaption { color: #444; font-size: .9em; }
.holds { border-left: 5px solid #2a8a3a; padding-left: .8rem; }
.fails { border-left: 5px solid #b02020; padding-left: .8rem; }
@media print {
  @page { margin: 16mm; }
  body { font-size: 10pt; max-width: none; margin: 0; padding: 0; }
  .pictures { grid-template-columns: 1fr 1fr; }
  h2, h3, caption, thead { break-after: avoid; } figure, tr { break-inside: avoid; }
}
"""


def report(
    problem: ContactProblem,
    steps: Step | Sequence[Step],
    folder: str | os.PathLike[str],
    *,
    csv: str | os.PathLike[str] | None = None,
    stress: Any = None,
    budget: ErrorBudget | None = None,
    title: str = "Contact",
    units: tuple[str, str, str] = ("mm", "N", "MPa"),
    magnification: float | None = None,
    view: tuple[float, float] | None = None,
) -> Path:
    """Write a self-contained report, ``report.html``. Collective.

    It contains the verdict; the deformed body; tractions, gap, slip and status of every contact
    with their extents; curves of forces, moments, areas and energies over the history; iterations;
    the error budget; the numerical settings; and the versions of all software. The file is replaced
    only when it is complete.

    Args:
        problem: The problem in the state of the last step, committed or not.
        steps: The steps returned by `increments` or `ContactProblem.solve`, in their order, or the
            last one.
        folder: Folder of the file, created if necessary.
        csv: Table that `increments` wrote for the same history, from which the curves are drawn, so
            that they include earlier runs. By default they are drawn from ``steps``.
        stress: UFL tensor (3, 3) on the body, whose von Mises stress colours the deformed body.
        budget: Result of `estimate_errors` for this state.
        title: Heading.
        units: Units of length, force and stress; those of moments and energies are force times
            length. In the plane without weight, forces, moments, areas and energies are per unit
            thickness, and the report states it.
        magnification: Factor of the displacements drawn; by default 1 with finite kinematics, and
            otherwise large enough to be visible.
        view: Elevation and azimuth of the camera in degrees, in space.

    Returns:
        The path of the file.

    Raises:
        ValueError: An argument is invalid, or steps or table are of another history; raised on all
            ranks.
        OSError: The folder cannot be created or written to, or the table cannot be read; raised on
            all ranks.
    """
    check_instance("problem", problem, ContactProblem)
    steps = [steps] if isinstance(steps, Step) else steps
    _check(problem, steps, folder, csv, budget, title, units, magnification)
    drawing.check_view(view)
    comm, path = problem.u.function_space.mesh.comm, Path(folder) / "report.html"
    evaluator = drawing.ShapeEvaluator(problem.displacement.u, stress)  # checks the stress
    rows: list[dict[str, str]] = []
    with ExitStack() as stack:
        scratch = Path()
        with collective_errors(comm):
            if comm.rank == 0:
                drawing.pyplot()  # raises an error without matplotlib
                files.make_folder(path.parent)
                scratch = Path(stack.enter_context(tempfile.TemporaryDirectory()))
                rows = _collect_rows(problem, steps, csv)
        problem.complete()
        problem.displacement.update()
        page = _Page(scratch, units, view, per_thickness=table.is_per_thickness(problem))
        if magnification is None:
            magnification = _choose_magnification(problem)
        _add_state(page, problem, steps[-1], evaluator, magnification)
        for contact in problem.contacts:
            _add_contact(page, contact, steps[-1], magnification)
        with collective_errors(comm):
            if comm.rank == 0:
                _add_history(page, problem, rows)
        _add_errors(page, budget)
        _add_settings(page, problem, steps[-1])
        versions = information(comm).items()
        page.add_table("Versions", ("component", "version"), versions)
        with collective_errors(comm):
            if comm.rank == 0:
                with files.atomic_write(path) as temporary:
                    temporary.write_text(page.text(title), encoding="utf-8")
    return path


def _check(
    problem: ContactProblem,
    steps: Any,
    folder: Any,
    csv: Any,
    budget: Any,
    title: Any,
    units: Any,
    magnification: Any,
) -> None:
    """Raise ValueError for invalid arguments, on all ranks."""
    if not isinstance(steps, Sequence) or not all(isinstance(step, Step) for step in steps):
        raise ValueError(
            f"steps is a {type(steps).__name__}; it must be a Step, or a list of them, such as "
            "list(increments(...))"
        )
    if not steps:
        raise ValueError(
            "steps is empty: nothing was solved, and there is no state to report; if the "
            "checkpoint is complete, remove it or extend the load history"
        )
    names = [contact.name for contact in problem.contacts]
    numbers = [step.increment for step in steps]
    now = (problem.increment, problem.increment + 1)  # committed, or only solved
    if (
        list(steps[-1].contacts) != names
        or numbers[-1] not in now
        or min(np.diff(numbers), default=1) < 1
    ):
        raise ValueError(
            f"steps are of the increments {numbers} and of contacts {list(steps[-1].contacts)}, "
            f"but the problem, of contacts {names}, is at increment {problem.increment}; give its "
            "steps in their order up to the last one"
        )
    for name, value in (("folder", folder), ("csv", csv)):
        if not (isinstance(value, str | os.PathLike) or (name == "csv" and value is None)):
            kind = {"folder": "folder", "csv": "file"}[name]
            raise ValueError(f"{name} is {value!r}; it must be the name of a {kind}")
    if budget is not None:
        check_instance("budget", budget, ErrorBudget)
    check_instance("title", title, str)
    if not (
        isinstance(units, tuple | list)
        and len(units) == 3
        and all(isinstance(unit, str) for unit in units)
    ):
        raise ValueError(
            f'units is {units!r}; it must be three strings, such as ("mm", "N", "MPa")'
        )
    if magnification is not None:
        check_positive("magnification", magnification)


class _Page:
    """The HTML page, in parts. Only the page of the first rank is written.

    Attributes:
        length, force, stress: Units.
        view: Elevation and azimuth of the camera, in space.
        per_thickness: Whether there are integrals per unit thickness.
    """

    def __init__(
        self,
        scratch: Path,
        units: tuple[str, str, str],
        view: tuple[float, float] | None,
        *,
        per_thickness: bool,
    ) -> None:
        self.length, self.force, self.stress = units
        self.view, self.per_thickness = view, per_thickness
        self._scratch, self._parts = scratch, [""]
        self._pictures = 0

    def add(self, *parts: str) -> None:
        """Append HTML."""
        self._parts += parts

    def add_heading(self, text: str, level: int = 2) -> None:
        """Append a heading, escaped."""
        self.add(f"<h{level}>{escape(text)}</h{level}>")

    def unit_suffix(self, per_thickness: bool) -> str:
        """Return the suffix of the unit of an integral."""
        return f"/{self.length}" if per_thickness else ""

    def add_table(self, title: str, header: Sequence[str], rows: Iterable[tuple[str, ...]]) -> None:
        """Append a table of texts."""
        self.add('<div class="words">', html_table(title, header, rows), "</div>")

    def next_path(self) -> Path:
        """Return the file of the next picture."""
        self._pictures += 1
        return self._scratch / f"{self._pictures}.png"

    def picture(self, path: Path, caption: str) -> str:
        """Return HTML with the embedded picture; "" without a file (on the other ranks)."""
        if not path.exists():
            return ""
        data = base64.b64encode(path.read_bytes()).decode()
        text = escape(caption)
        return (
            f'<figure><img alt="{text}" src="data:image/png;base64,{data}">'
            f"<figcaption>{text}</figcaption></figure>"
        )

    def add_pictures(self, *figures: str) -> None:
        """Append pictures side by side, if the page is wide enough."""
        self.add('<div class="pictures">', *figures, "</div>")

    def text(self, title: str) -> str:
        """Return the whole page."""
        head = (
            f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}'
            '</title><meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<style>{_STYLE}</style></head><body><h1>{escape(title)}</h1>"
        )
        now = datetime.datetime.now(datetime.timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
        units = f"Lengths in {self.length}, forces in {self.force}, stresses in {self.stress}."
        if self.per_thickness:
            units += f" Forces, moments, areas and energies are per {self.length} of thickness."
        footer = f"<p>{escape(units)} Written {now}.</p></body></html>"
        return "\n".join([head, *self._parts, footer, ""])


def _collect_rows(
    problem: ContactProblem, steps: Sequence[Step], csv: str | os.PathLike[str] | None
) -> list[dict[str, str]]:
    """Return the rows of the table, or of the steps. On the first rank."""
    if csv is None:
        names = table.columns(problem)
        return [
            dict(zip(names, map(str, table.row_values(problem, step)), strict=True))
            for step in steps
        ]
    rows = table.read_rows(Path(csv), problem)
    if int(rows[-1]["increment"]) != steps[-1].increment:
        raise ValueError(
            f"csv is {csv}, whose last increment is {rows[-1]['increment']}, but the last "
            f"step is of increment {steps[-1].increment}; give the table of the same history"
        )
    return rows


def _choose_magnification(problem: ContactProblem) -> float:
    """Return a factor 1, 2 or 5 times 10ⁿ that makes displacements visible. Collective."""
    u, comm = problem.displacement.u, problem.u.function_space.mesh.comm
    largest = global_max(comm, np.abs(u.x.array))
    size = problem.full.scales.mesh_size
    if (
        any(contact.contact_kinematics.is_finite for contact in problem.contacts)
        or not largest > _ROUND_OFF_RATIO * size
    ):
        return 1.0
    upper_bound = _MAGNIFIED_RATIO * size / largest
    power = 10.0 ** np.floor(np.log10(upper_bound))
    return float(max(1.0, power * max(n for n in (1, 2, 5) if n * power <= upper_bound)))


def _add_state(
    page: _Page,
    problem: ContactProblem,
    step: Step,
    evaluator: drawing.ShapeEvaluator,
    magnification: float,
) -> None:
    """Add the verdict in words, resultants and the deformed body. Collective."""
    failures = step.verdict.failures
    where = f"Increment {step.increment}" + (
        "" if step.load is None else f", at load {step.load:.6g}"
    )
    if failures:
        page.add(f'<p class="fails">{escape(where)}: the verification failed.</p>')
    else:
        checked = ["equilibrium", "the balance of forces and moments"]
        checked += ["the contact laws at every point"] if step.verdict.laws else []
        checked += ["the penetration left by multipliers"] if step.verdict.enforcement else []
        checked += ["the rigid obstacles"] if step.verdict.obstacles else []
        small = [c.name for c in problem.contacts if not c.contact_kinematics.is_finite]
        known = step.verdict.small_displacement_error
        checked += ["that displacements are small"] if any(n in known for n in small) else []
        residual = f"The residual is {step.verdict.relative_residual:.1e} of the forces."
        if not step.verdict.is_loaded:
            residual = "All forces are zero."
        page.add(
            f'<p class="holds">{escape(where)}: the verification passed. Evaluated independently '
            f"of the solver: {', '.join(checked)}. {residual}</p>"
        )
    page.add(step._repr_html_())
    page.add_heading("Deformed body")
    path = page.next_path()
    body = evaluator()
    with collective_errors(problem.u.function_space.mesh.comm):
        if body is not None:
            units = page.length, page.stress
            obstacles = shapes_of(problem.contacts)
            figure = drawing.draw_deformation(body, units, "", magnification, obstacles, page.view)
            drawing.save(figure, path)
    scale = "" if magnification == 1 else f", displacements × {magnification:g}"
    page.add_pictures(page.picture(path, f"Original and deformed mesh{scale}"))


def _add_contact(page: _Page, contact: Contact, step: Step, magnification: float) -> None:
    """Add tractions, gap, slip, status and extents of a contact. Collective."""
    page.add_heading(f"Contact: {contact.name}")
    if not step.verdict.equations[contact.name].is_loaded:
        page.add("<p>The contact force is zero; tractions other than zero are round-off.</p>")
    units = {"length": page.length, "stress": page.stress}
    pictures = []
    if contact.points.shape[1] == 2:
        path = page.next_path()
        plotting.plot_along(path, contact, **units)
        pictures.append(page.picture(path, "Pressure, friction, gap and slip at quadrature points"))
    else:
        for field, caption in (
            ("pressure", "Pressure"),
            ("friction", "Tangential traction"),
            ("gap", "Gap"),
            ("slip", "Slip"),
        ):
            path = page.next_path()
            options = {"magnification": magnification, "view": page.view}
            plotting.plot_field(path, contact, field, **units, **options)  # type: ignore[arg-type]
            pictures.append(page.picture(path, f"{caption}, mean value per facet"))
    path = page.next_path()
    plotting.plot_status(
        path, contact, length=page.length, magnification=magnification, view=page.view
    )
    pictures.append(page.picture(path, "Status of most points of each facet"))
    page.add_pictures(*pictures)
    extents = step.contacts[contact.name].extents
    rows = [
        (
            state,
            f"{extents[state].area:.6g}",
            _format_point(extents[state].low),
            _format_point(extents[state].high),
        )
        for state in table.STATES
    ]
    area = f"area [{page.length}²{page.unit_suffix(contact.inputs.per_thickness)}]"
    header = ("state", area, f"from [{page.length}]", f"to [{page.length}]")
    page.add(html_table("Extents on the undeformed surface", header, rows))


def _format_point(x: Array) -> str:
    return "–" if np.isnan(x).any() else "(" + ", ".join(f"{value:.6g}" for value in x) + ")"


def _add_history(page: _Page, problem: ContactProblem, rows: list[dict[str, str]]) -> None:
    """Add curves over the load, or over the increments without a load. On the first rank."""
    page.add_heading("History")
    first, last = rows[0]["increment"], rows[-1]["increment"]
    page.add(f"<p>Increments {first} to {last}, {_sum_column(rows, 'iterations'):.0f} iterations, ")
    page.add(f"{_sum_column(rows, 'cuts'):.0f} cuts.</p>")
    increments = _column(rows, "increment")
    x, abscissa = _column(rows, "load"), "load"
    if np.isnan(x).any():
        x, abscissa = increments, "increment"
    pictures = []
    for contact in problem.contacts:
        path, d = page.next_path(), contact.surface.mesh.geometry.dim
        with plotting.figure(path, columns=3, size=(4.6, 3.6)) as (forces, moments, areas):
            for axis in table.AXES[:d]:
                values = _column(rows, table.column(contact, f"force {axis}", "force"))
                forces.plot(x, values, ".-", label=f"force {axis}")
            name = table.column(contact, "friction as the sum of sizes", "force")
            forces.plot(x, _column(rows, name), "k:", label="friction ∫|τ|")
            for axis in table.AXES if d == 3 else "z":
                name = table.column(contact, f"moment {axis} about the origin", "force length")
                moments.plot(x, _column(rows, name), ".-", label=f"moment {axis}")
            for state in table.STATES:
                values = _column(rows, table.column(contact, f"area in {state}", "area"))
                areas.plot(x, values, ".-", label=state)
            suffix = page.unit_suffix(contact.inputs.per_thickness)
            forces.set(ylabel=f"force on the body [{page.force}{suffix}]")
            moments.set(ylabel=f"moment about the origin [{page.force} {page.length}{suffix}]")
            areas.set(ylabel=f"area [{page.length}²{suffix}]")
            for axes in (forces, moments, areas):
                axes.set(xlabel=abscissa)
                axes.locator_params(axis="x", nbins=6)
                axes.ticklabel_format(scilimits=(-3, 4))
                axes.grid(alpha=0.25)
                axes.legend(fontsize="small")
        pictures.append(page.picture(path, f"{contact.name}: forces, moments and areas"))
    page.add(*pictures)  # each as wide as the page
    path = page.next_path()
    with plotting.figure(path, columns=2, size=(6.4, 3.6)) as (solver, energy):
        solver.bar(increments, _column(rows, "iterations"), color=drawing.COLOURS["pressure"])
        cuts = _column(rows, "cuts")
        for number, times in zip(increments[cuts > 0], cuts[cuts > 0], strict=True):
            solver.annotate(f"cut {times:.0f}×", (number, 0.0), rotation=90, ha="center")
        solver.set(xlabel="increment", ylabel="iterations")
        for name in table.ENERGIES:
            sums = np.cumsum(_column(rows, table.energy_column(problem, name)))
            energy.plot(increments, sums, ".-", label=_ENERGIES[name])
        suffix = page.unit_suffix(page.per_thickness)
        energy.set(xlabel="increment", ylabel=f"energy [{page.force} {page.length}{suffix}]")
        energy.legend(fontsize="small")
        for axes in (solver, energy):
            axes.grid(alpha=0.25)
            axes.locator_params(axis="x", integer=True)
    page.add(page.picture(path, "Iterations of the increments; cumulative work and energies"))
    page.add(f"<p>{escape(_REMAINDER)}</p>")


def _column(rows: list[dict[str, str]], name: str) -> Array:
    """Return the numbers of a column; NaN for missing values."""
    return np.array([float(row[name] or "nan") for row in rows])


def _sum_column(rows: list[dict[str, str]], name: str) -> float:
    return float(_column(rows, name).sum())


def _add_errors(page: _Page, budget: ErrorBudget | None) -> None:
    """Add the error budget, if it is given."""
    page.add_heading("Errors")
    if budget is None:
        page.add("<p>Not estimated: give report(..., budget=estimate_errors(problem, stress)).</p>")
    else:
        page.add(budget._repr_html_())


def _add_settings(page: _Page, problem: ContactProblem, step: Step) -> None:
    """Add the verdict in numbers, the attempts and the numerical settings. Collective."""
    page.add_heading("Verification")
    page.add(step.verdict._repr_html_())
    page.add_heading("Settings")
    space = problem.u.function_space
    mesh = space.mesh
    kind = mesh.topology.cell_name()
    rows = [
        ("cells", f"{mesh.topology.index_map(mesh.topology.dim).size_global} of kind {kind}"),
        ("unknowns", str(space.dofmap.index_map.size_global * space.dofmap.index_map_bs)),
        ("ranks", str(mesh.comm.size)),
        ("method of the last increment", step.method),
        ("attempts of the last increment", "; ".join(map(str, step.attempts))),
        ("accuracy", "not given" if problem.accuracy is None else str(problem.accuracy)),
    ]
    if not all(contact.contact_kinematics.is_finite for contact in problem.contacts):
        rows.append(
            (
                "tolerance of the small-displacement error",
                f"{problem.small_displacement_tolerance:g}",
            )
        )
    page.add_table("Problem", ("setting", "value"), rows)
    for contact in problem.contacts:
        topology = contact.surface.submesh.topology
        n_facets = topology.index_map(topology.dim).size_global
        rows = [
            ("law", type(contact.law).__name__),
            ("obstacle", type(contact.obstacle).__name__),
            ("kinematics", contact.kinematics),
            ("enforcement", _describe_enforcement(contact)),
            ("facets", str(n_facets)),
        ]
        given = contact.law.parameters()
        for name in {**given, **contact.parameters}:
            rows.append((name, _describe_parameter(given.get(name), contact.parameters.get(name))))
        page.add_table(f"Contact: {contact.name}", ("setting", "value"), rows)


def _describe_enforcement(contact: Contact) -> str:
    if contact.multipliers is None:
        return "penalty"
    return f"augmented, tolerance {contact.tolerance:g} of the largest traction"


def _describe_parameter(given: Any, constant: fem.Constant | None) -> str:
    """Describe a parameter of a law or obstacle, and its present value if it is a number."""
    if isinstance(given, NodalSprings):
        return f"{given.k:g} per node"
    if constant is None:
        return "expression"
    number = ", ".join(f"{x:g}" for x in np.ravel(constant.value))
    return f"{number} E/h" if isinstance(given, RelativeStiffness) else number
