"""Report of a load history and its last state as one HTML page, for screen and print."""

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

# Of the mesh's size, how far displacements are drawn at least; where they are less than the
# round-off of coordinates there is nothing to be seen.
_VISIBLE, _ROUND_OFF = 0.05, float(np.finfo(float).eps)
# What legends call the energies.
_ENERGIES = {
    "work": "work of loads and motions",
    "elastic": "elastic energy",
    "springs": "contact springs (k_n, k_t)",
    "dissipation": "dissipation by friction",
    "remainder": "remainder",
}
_REMAINDER = (
    "The work of an increment is that of the mean of the forces at its two ends. The remainder is "
    "the part of it that is in none of the other sums: contact that changes within an increment, "
    "and springs that are released where contact opens. It decreases with the increment size; if "
    "it is large compared with the work, the increments are too large for accurate energies."
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
    shape = drawing.ShapeOf(problem.displacement.u, stress)  # refuses stresses of other shapes
    rows: list[dict[str, str]] = []
    with ExitStack() as stack:
        scratch = Path()
        with collective_errors(comm):
            if comm.rank == 0:
                drawing.pyplot()  # whether it is there
                files.make_folder(path.parent)
                scratch = Path(stack.enter_context(tempfile.TemporaryDirectory()))
                rows = _rows(problem, steps, csv)
        problem.complete()
        problem.displacement.follow()
        page = _Page(scratch, units, view, per_thickness=table.is_per_thickness(problem))
        if magnification is None:
            magnification = _visible(problem)
        _state(page, problem, steps[-1], shape, magnification)
        for contact in problem.contacts:
            _contact(page, contact, steps[-1], magnification)
        with collective_errors(comm):
            if comm.rank == 0:
                _history(page, problem, rows)
        _errors(page, budget)
        _choices(page, problem, steps[-1])
        words = information(comm).items()
        page.words("Versions", ("what", "version"), words)
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
    """Refuse arguments without sense, on every rank alike.

    Raises:
        ValueError: It says what was given, and what is expected.
    """
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
    now = (problem.increment, problem.increment + 1)  # committed, or solved alone
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
            what = {"folder": "folder", "csv": "file"}[name]
            raise ValueError(f"{name} is {value!r}; it must be the name of a {what}")
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
    """Parts of the page one after another. What a rank but the first adds is dropped.

    Attributes:
        length, force, stress: Units.
        view: Where to look from in space.
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
        """HTML as it is."""
        self._parts += parts

    def heading(self, text: str, level: int = 2) -> None:
        """A heading, escaped."""
        self.add(f"<h{level}>{escape(text)}</h{level}>")

    def per(self, per_thickness: bool) -> str:
        """What the unit of an integral ends with."""
        return f"/{self.length}" if per_thickness else ""

    def words(self, title: str, header: Sequence[str], rows: Iterable[tuple[str, ...]]) -> None:
        """A table of words."""
        self.add('<div class="words">', html_table(title, header, rows), "</div>")

    def path(self) -> Path:
        """Where the next picture is to be drawn."""
        self._pictures += 1
        return self._scratch / f"{self._pictures}.png"

    def picture(self, path: Path, caption: str) -> str:
        """A picture that was drawn there, within the page."""
        if not path.exists():  # on the other ranks
            return ""
        data = base64.b64encode(path.read_bytes()).decode()
        told = escape(caption)
        return (
            f'<figure><img alt="{told}" src="data:image/png;base64,{data}">'
            f"<figcaption>{told}</figcaption></figure>"
        )

    def pictures(self, *figures: str) -> None:
        """Beside each other, where there is room."""
        self.add('<div class="pictures">', *figures, "</div>")

    def text(self, title: str) -> str:
        """All of it."""
        head = (
            f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}'
            '</title><meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<style>{_STYLE}</style></head><body><h1>{escape(title)}</h1>"
        )
        now = datetime.datetime.now(datetime.timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
        units = f"Lengths in {self.length}, forces in {self.force}, stresses in {self.stress}."
        if self.per_thickness:
            units += f" Forces, moments, areas and energies are per {self.length} of thickness."
        foot = f"<p>{escape(units)} Written {now}.</p></body></html>"
        return "\n".join([head, *self._parts, foot, ""])


def _rows(
    problem: ContactProblem, steps: Sequence[Step], csv: str | os.PathLike[str] | None
) -> list[dict[str, str]]:
    """Those of the table, or of the steps. On the first rank."""
    if csv is None:
        names = table.columns(problem)
        return [
            dict(zip(names, map(str, table.values(problem, step)), strict=True)) for step in steps
        ]
    rows = table.read(Path(csv), problem)
    if int(rows[-1]["increment"]) != steps[-1].increment:
        raise ValueError(
            f"csv is {csv}, whose last increment is {rows[-1]['increment']}, but the last "
            f"step is of increment {steps[-1].increment}; give the table of the same history"
        )
    return rows


def _visible(problem: ContactProblem) -> float:
    """A magnification, 1, 2 or 5 by a power of ten, with which displacements show. Collective."""
    u, comm = problem.displacement.u, problem.u.function_space.mesh.comm
    largest = global_max(comm, np.abs(u.x.array))
    size = problem.full.scales.mesh_size
    if any(contact.finite for contact in problem.contacts) or not largest > _ROUND_OFF * size:
        return 1.0
    wanted = _VISIBLE * size / largest
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(max(1.0, power * max(n for n in (1, 2, 5) if n * power <= wanted)))


def _state(
    page: _Page, problem: ContactProblem, step: Step, shape: drawing.ShapeOf, magnification: float
) -> None:
    """Verdict in words, resultants, the deformed body. Collective."""
    failures = step.verdict.failures
    where = f"Increment {step.increment}" + (
        "" if step.load is None else f", at load {step.load:.6g}"
    )
    if failures:
        page.add(f'<p class="fails">{escape(where)}: the state does not hold.</p>')
    else:
        checked = ["equilibrium", "the balance of forces and moments"]
        checked += ["the contact laws at every point"] if step.verdict.laws else []
        checked += ["the penetration left by multipliers"] if step.verdict.enforcement else []
        checked += ["the rigid obstacles"] if step.verdict.obstacles else []
        small = [c.name for c in problem.contacts if not c.finite]
        known = step.verdict.small_displacement_error
        checked += ["that displacements are small"] if any(n in known for n in small) else []
        residual = f"The residual is {step.verdict.relative_residual:.1e} of the forces."
        if not step.verdict.is_loaded:
            residual = "There are no forces."
        page.add(
            f'<p class="holds">{escape(where)}: the state holds. Verified independently of the '
            f"solver: {', '.join(checked)}. {residual}</p>"
        )
    page.add(step._repr_html_())
    page.heading("Deformed body")
    path = page.path()
    drawn = shape()
    with collective_errors(problem.u.function_space.mesh.comm):
        if drawn is not None:
            units = page.length, page.stress
            obstacles = shapes_of(problem.contacts)
            figure = drawing.deformed(drawn, units, "", magnification, obstacles, page.view)
            drawing.save(figure, path)
    told = "" if magnification == 1 else f", displacements × {magnification:g}"
    page.pictures(page.picture(path, f"Original and deformed mesh{told}"))


def _contact(page: _Page, contact: Contact, step: Step, magnification: float) -> None:
    """Tractions, gap, slip, status and extents. Collective."""
    page.heading(f"Contact: {contact.name}")
    if not step.verdict.equations[contact.name].is_loaded:
        page.add("<p>There is no contact force; tractions other than zero are round-off.</p>")
    units = {"length": page.length, "stress": page.stress}
    drawn = []
    if contact.points.shape[1] == 2:
        path = page.path()
        plotting.plot_along(path, contact, **units)
        drawn.append(page.picture(path, "Pressure, friction, gap and slip at the points"))
    else:
        for field, caption in (
            ("pressure", "Pressure"),
            ("friction", "Tangential traction"),
            ("gap", "Gap"),
            ("slip", "Slip"),
        ):
            path = page.path()
            shown_as = {"magnification": magnification, "view": page.view}
            plotting.plot_field(path, contact, field, **units, **shown_as)  # type: ignore[arg-type]
            drawn.append(page.picture(path, f"{caption}, means of the facets"))
    path = page.path()
    plotting.plot_status(
        path, contact, length=page.length, magnification=magnification, view=page.view
    )
    drawn.append(page.picture(path, "Status of most points of each facet"))
    page.pictures(*drawn)
    extents = step.contacts[contact.name].extents
    rows = [
        (
            state,
            f"{extents[state].area:.6g}",
            _place(extents[state].low),
            _place(extents[state].high),
        )
        for state in table.STATES
    ]
    area = f"area [{page.length}²{page.per(contact.inputs.per_thickness)}]"
    header = ("state", area, f"from [{page.length}]", f"to [{page.length}]")
    page.add(html_table("Extents on the undeformed surface", header, rows))


def _place(x: Array) -> str:
    return "–" if np.isnan(x).any() else "(" + ", ".join(f"{value:.6g}" for value in x) + ")"


def _history(page: _Page, problem: ContactProblem, rows: list[dict[str, str]]) -> None:
    """Curves over the load, or where it is not known over the increments. On the first rank."""
    page.heading("History")
    first, last = rows[0]["increment"], rows[-1]["increment"]
    page.add(f"<p>Increments {first} to {last}, {_total(rows, 'iterations'):.0f} iterations, ")
    page.add(f"{_total(rows, 'cuts'):.0f} cuts.</p>")
    increments = _column(rows, "increment")
    over, abscissa = _column(rows, "load"), "load"
    if np.isnan(over).any():
        over, abscissa = increments, "increment"
    drawn = []
    for contact in problem.contacts:
        path, d = page.path(), contact.surface.mesh.geometry.dim
        with plotting.figure(path, columns=3, size=(4.6, 3.6)) as (forces, moments, areas):
            for axis in table.AXES[:d]:
                values = _column(rows, table.column(contact, f"force {axis}", "force"))
                forces.plot(over, values, ".-", label=f"force {axis}")
            name = table.column(contact, "friction as the sum of sizes", "force")
            forces.plot(over, _column(rows, name), "k:", label="friction ∫|τ|")
            for axis in table.AXES if d == 3 else "z":
                name = table.column(contact, f"moment {axis} about the origin", "force length")
                moments.plot(over, _column(rows, name), ".-", label=f"moment {axis}")
            for state in table.STATES:
                values = _column(rows, table.column(contact, f"area in {state}", "area"))
                areas.plot(over, values, ".-", label=state)
            per = page.per(contact.inputs.per_thickness)
            forces.set(ylabel=f"force on the body [{page.force}{per}]")
            moments.set(ylabel=f"moment about the origin [{page.force} {page.length}{per}]")
            areas.set(ylabel=f"area [{page.length}²{per}]")
            for axes in (forces, moments, areas):
                axes.set(xlabel=abscissa)
                axes.locator_params(axis="x", nbins=6)
                axes.ticklabel_format(scilimits=(-3, 4))
                axes.grid(alpha=0.25)
                axes.legend(fontsize="small")
        drawn.append(page.picture(path, f"{contact.name}: forces, moments and areas"))
    page.add(*drawn)  # each as wide as the page
    path = page.path()
    with plotting.figure(path, columns=2, size=(6.4, 3.6)) as (solver, energy):
        solver.bar(increments, _column(rows, "iterations"), color=drawing.COLOURS["pressure"])
        cuts = _column(rows, "cuts")
        for number, times in zip(increments[cuts > 0], cuts[cuts > 0], strict=True):
            solver.annotate(f"cut {times:.0f}×", (number, 0.0), rotation=90, ha="center")
        solver.set(xlabel="increment", ylabel="iterations")
        for name in table.ENERGIES:
            sums = np.cumsum(_column(rows, table.energy_column(problem, name)))
            energy.plot(increments, sums, ".-", label=_ENERGIES[name])
        per = page.per(page.per_thickness)
        energy.set(xlabel="increment", ylabel=f"sum so far [{page.force} {page.length}{per}]")
        energy.legend(fontsize="small")
        for axes in (solver, energy):
            axes.grid(alpha=0.25)
            axes.locator_params(axis="x", integer=True)
    page.add(page.picture(path, "Iterations of the increments; work, and what became of it"))
    page.add(f"<p>{escape(_REMAINDER)}</p>")


def _column(rows: list[dict[str, str]], name: str) -> Array:
    """Numbers; NaN where there is none."""
    return np.array([float(row[name] or "nan") for row in rows])


def _total(rows: list[dict[str, str]], name: str) -> float:
    return float(_column(rows, name).sum())


def _errors(page: _Page, budget: ErrorBudget | None) -> None:
    """The budget, where there is one."""
    page.heading("Errors")
    if budget is None:
        page.add("<p>Not estimated: give report(..., budget=estimate_errors(problem, stress)).</p>")
    else:
        page.add(budget._repr_html_())


def _choices(page: _Page, problem: ContactProblem, step: Step) -> None:
    """Verdict in numbers, what was tried, and what was chosen. Collective."""
    page.heading("Checks")
    page.add(step.verdict._repr_html_())
    page.heading("What was chosen")
    space = problem.u.function_space
    mesh = space.mesh
    kind = mesh.topology.cell_name()
    rows = [
        ("cells", f"{mesh.topology.index_map(mesh.topology.dim).size_global} of kind {kind}"),
        ("unknowns", str(space.dofmap.index_map.size_global * space.dofmap.index_map_bs)),
        ("ranks", str(mesh.comm.size)),
        ("method of the last increment", step.method),
        ("attempts in it", "; ".join(map(str, step.attempts))),
        ("accuracy", "not given" if problem.accuracy is None else str(problem.accuracy)),
    ]
    if not all(contact.finite for contact in problem.contacts):
        rows.append(
            (
                "largest change of force or pressure by small displacements",
                f"{problem.small_displacement_tolerance:g}",
            )
        )
    page.words("Problem", ("what", "choice"), rows)
    for contact in problem.contacts:
        count = contact.surface.submesh.topology
        facets = count.index_map(count.dim).size_global
        rows = [
            ("law", type(contact.law).__name__),
            ("obstacle", type(contact.obstacle).__name__),
            ("kinematics", contact.kinematics),
            ("enforcement", _enforcement(contact)),
            ("facets", str(facets)),
        ]
        given = contact.law.parameters()
        for name in {**given, **contact.parameters}:
            rows.append((name, _parameter(given.get(name), contact.parameters.get(name))))
        page.words(f"Contact: {contact.name}", ("what", "choice"), rows)


def _enforcement(contact: Contact) -> str:
    if contact.multipliers is None:
        return "penalty"
    return f"augmented, to {contact.tolerance:g} of the largest traction"


def _parameter(given: Any, constant: fem.Constant | None) -> str:
    """Of a law or obstacle: how it was given, and its number as it is now, if it has one."""
    if isinstance(given, NodalSprings):
        return f"{given.k:g} for each node"
    if constant is None:
        return "given by an expression"
    number = ", ".join(f"{x:g}" for x in np.ravel(constant.value))
    return f"{number} E/h" if isinstance(given, RelativeStiffness) else number
