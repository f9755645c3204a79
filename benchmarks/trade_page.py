"""Evaluate the rows of `benchmarks/trade.py`: non-dominated settings, figures and the page."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks import timing
from benchmarks.trade_scenes import PARAMETERS, Scene, Setting
from fenics_contact import plotting
from fenics_contact.contact.accuracy import PRESETS
from verification import report

Row = timing.Row
# A row dominates another if both its error and its time are smaller by this fraction.
DOMINANCE_MARGIN = 0.1
ENFORCEMENTS = (("penalty", "o-"), ("augmented", "s--"))


def find_changed_parameters(row: Row, base: Setting) -> tuple[str, ...]:
    """Return the parameters in which a row differs from the base setting."""
    return tuple(name for name in PARAMETERS if row[name] != str(getattr(base, name)))


def describe(row: Row, base: Setting) -> str:
    """Return the changed parameters with their values as text."""
    if row["accuracy"]:
        return f"accuracy = {row['accuracy']}"
    names = [name for name in find_changed_parameters(row, base) if name not in ("h", "degree")]
    return ", ".join(f"{name} = {_short(row[name])}" for name in names) or "base"


def find_comparable(row: Row, rows: Sequence[Row]) -> list[Row]:
    """Return the solved rows of a row's problem, mesh and degree: their times have one unit."""
    same = ("scene", "h", "degree")
    return [r for r in rows if is_solved(r) and all(r[name] == row[name] for name in same)]


def is_solved(row: Row) -> bool:
    """Whether a row of the parameter study has a solution."""
    return row["role"] == "sweep" and row["error"] != ""


def find_dominating(row: Row, rows: Sequence[Row], margin: float = DOMINANCE_MARGIN) -> list[Row]:
    """Return the rows whose error and time are both smaller by the margin."""
    return [
        other
        for other in rows
        if all(float(other[c]) < (1 - margin) * float(row[c]) for c in ("error", "time"))
    ]


def pareto_front(rows: Sequence[Row]) -> list[Row]:
    """Return the non-dominated rows (Pareto front), fastest first."""
    found: list[Row] = []
    for row in sorted(rows, key=lambda r: (float(r["time"]), float(r["error"]))):
        if not found or float(row["error"]) < float(found[-1]["error"]):
            found.append(row)
    return found


# ---- page ----------------------------------------------------------------------------------------


def page(scenes: Mapping[str, Scene], rows: Sequence[Row], stem: str, advice: str) -> str:
    """Return the page in Markdown.

    Args:
        scenes: Problems by name.
        rows: Rows of the study.
        stem: Stem of the names of CSV file and figures.
        advice: Recommendations.
    """
    lines = ["# Accuracy versus cost", ""]
    lines += report.text(
        "Five problems: the half-cylinder without friction and with μ = 0.2 (20 increments), the "
        "GRECO block, a rigid ball on a block in 3D, and the shrink fit of two rings. One "
        "parameter at a time is varied from a base setting (" + _base(scenes) + "); mesh size, "
        "degree and enforcement are varied together. The error is the largest of the relative "
        "errors of normal force, friction force, peak pressure and a displacement. The time is in "
        "units of one linear solve of the same mesh and degree (assembly, factorisation and "
        "solution with Γc fixed), both the fastest of several runs; meshing and compilation are "
        f"not included. All {sum(r['role'] == 'sweep' for r in rows)} runs are in "
        f"[{stem}.csv]({stem}.csv)."
    )
    lines += advice.strip().splitlines()
    lines += ["", "## Settings", "", f"![Error over time, by setting]({stem}.png)", ""]
    lines += report.text(
        "*Error over time on the base mesh, each point one changed parameter. Line: settings that "
        "no other dominates. Large markers: base setting and the presets of `accuracy=`.*"
    )
    names = [*PRESETS, *dict.fromkeys(r["accuracy"] for r in rows)]
    body = []
    for name in dict.fromkeys(["", *names]):
        found = [_row_of(replace(one.base, accuracy=name), rows) for one in scenes.values()]
        if any(found):
            body.append((name or "none (base)", *map(_cell, found)))
    lines += ["Error · time · iterations with the presets:", ""]
    lines += report.table(("accuracy=", *scenes), body)
    lines += ["## Stiffness and increments", "", f"![Parameters]({stem}-parameters.png)", ""]
    lines += report.text(
        "*Error and iterations over the stiffness (solid: penalty, dashed: augmented Lagrangian), "
        "and error over the number of increments of the problems with friction.*"
    )
    lines += ["## Mesh, degree and enforcement", "", f"![Meshes]({stem}-meshes.png)", ""]
    lines += report.text("*Error over the number of dofs, by degree and enforcement.*")
    lines += ["## Failed settings", ""]
    body = [
        (
            row["scene"],
            f"h = {_short(row['h'])}, degree {row['degree']}, "
            + describe(row, scenes[row["scene"]].base),
            row["failure"],
            f"{float(row['time']):.3g}",
        )
        for row in rows
        if row["failure"]
    ]
    lines += report.table(("problem", "setting", "error", "time"), body) if body else ["None.", ""]
    lines += ["## References", ""]
    lines += report.text(
        "Errors of the shrink fit are relative to Lamé's solution; the others are relative to a "
        "solution of this package on a finer mesh with the augmented Lagrangian method and tight "
        "tolerances, which agrees with published values:"
    )
    lines += report.table(
        ("problem", "reference", "published", "largest difference", "of"),
        [_reference(one, rows) for one in scenes.values() if one.reference],
    )
    lines += report.text(
        "Written by `OMP_NUM_THREADS=1 python benchmarks/trade.py` (ten minutes); `--page` writes "
        "the page and its figures from the stored runs."
    )
    return "\n".join(lines).rstrip() + "\n"


def _reference(one: Scene, rows: Sequence[Row]) -> tuple[str, ...]:
    """Return the reference of a problem and its largest difference from published values."""
    (own,) = (r for r in rows if r["scene"] == one.name and r["role"] == "reference")
    differences = {
        name: abs(float(own[name]) / value - 1) for name, value in one.published.items() if value
    }
    worst = max(differences, key=differences.__getitem__)
    how = f"h = {_short(own['h'])}, {own['increments']} increments"
    return one.name, how, one.source, f"{differences[worst]:.1e}", worst


def _short(value: Any) -> str:
    try:
        return f"{float(value):.3g}"
    except ValueError:
        return str(value)


def _base(scenes: Mapping[str, Scene]) -> str:
    """Return the base setting as text."""
    one = next(iter(scenes.values())).base
    left_out = ("h", "increments", "tolerance", "accuracy")
    units = {"k_n": " E/h", "k_t": " k_n"}
    return ", ".join(
        f"{name} = {_short(getattr(one, name))}{units.get(name, '')}"
        for name in PARAMETERS
        if name not in left_out
    )


def _cell(row: Row | None) -> str:
    """Return error, time and iterations as text."""
    if row is None:
        return "–"
    if row["failure"]:
        return f"fails · {float(row['time']):.1f}"
    return f"{float(row['error']):.1e} · {float(row['time']):.1f} · {row['iterations']}"


def _row_of(setting: Setting, rows: Sequence[Row]) -> Row | None:
    wanted = {name: str(getattr(setting, name)) for name in ("scene", *PARAMETERS)}
    wanted["role"] = "sweep"
    return next((row for row in rows if all(row[k] == v for k, v in wanted.items())), None)


# ---- figures -------------------------------------------------------------------------------------


def draw(target: Path, scenes: Mapping[str, Scene], rows: Sequence[Row]) -> None:
    """Draw the figures of the page ``target``."""
    _grid(target.with_suffix(".png"), scenes, lambda axes, one: _draw_settings(axes, one, rows))
    _grid(
        target.with_name(f"{target.stem}-meshes.png"),
        scenes,
        lambda axes, one: _draw_meshes(axes, one, rows),
    )
    _draw_parameters(target.with_name(f"{target.stem}-parameters.png"), scenes, rows)


def _grid(path: Path, scenes: Mapping[str, Scene], draw_one: Callable[[Any, Scene], None]) -> None:
    """Draw a panel for each problem, and their common legend in the last panel."""
    with plotting.figure(path, size=(13.0, 7.6)) as axes:
        figure = axes.figure
        axes.remove()
        panels = figure.subplots(2, 3).ravel()
        legend: dict[str, Any] = {}
        for panel, one in zip(panels, scenes.values(), strict=False):
            draw_one(panel, one)
            panel.grid(alpha=0.25)
            handles, labels = panel.get_legend_handles_labels()
            legend |= dict(zip(labels, handles, strict=True))
        for panel in panels[len(scenes) :]:
            panel.axis("off")
        panels[-1].legend(legend.values(), legend.keys(), loc="center", fontsize=10)


def _draw_settings(axes: Any, one: Scene, rows: Sequence[Row]) -> None:
    """Plot error over time of all settings on the base mesh."""
    base = one.base
    here = find_comparable({"scene": one.name, "h": str(base.h), "degree": str(base.degree)}, rows)
    groups: dict[str, list[Row]] = {}
    for row in here:
        names = find_changed_parameters(row, base)
        group = names[0] if len(names) == 1 else "several" if names else "base"
        groups.setdefault(f"accuracy = {row['accuracy']}" if row["accuracy"] else group, []).append(
            row
        )
    presets = [f"accuracy = {name}" for name in (*PRESETS, "0.003", "1e-4")]
    others = [name for name in PARAMETERS if name != "accuracy"]
    for number, name in enumerate(("base", *presets, *others, "several")):
        some = groups.get(name, [])
        if some:
            at = [[float(row[c]) for row in some] for c in ("time", "error")]
            large = number <= len(presets)
            style = {"color": f"C{number % 10}", "markersize": 9 if large else 5, "alpha": 0.8}
            axes.loglog(*at, "sD^v<>ophd*XP8H.+"[number], label=name, **style)
    best = pareto_front(here)
    at = [[float(row[c]) for row in best] for c in ("time", "error")]
    axes.step(*at, "k-", where="post", linewidth=0.8, label="not dominated")
    axes.set(title=f"{one.name}, h = {_short(base.h)}", xlabel="time / linear solve")
    axes.set_ylabel("largest relative error")
    low, high = axes.get_xlim()
    ticks: list[float] = []
    for x in (1.8, 2, 2.2, 2.5, 3, 4, 5, 6, 7, 8, 9, 10, 20, 30, 50, 100):
        if low < x < high and (not ticks or x / ticks[-1] > (high / low) ** 0.08):
            ticks.append(x)
    axes.xaxis.set_ticks(ticks, labels=[f"{x:g}" for x in ticks])
    axes.xaxis.set_ticks([], minor=True)


def _draw_meshes(axes: Any, one: Scene, rows: Sequence[Row]) -> None:
    """Plot error over dofs by degree and enforcement."""
    for degree in (1, 2):
        for enforcement, line in ENFORCEMENTS:
            settings = [
                replace(one.base, h=h, degree=degree, enforcement=enforcement) for h in one.sizes
            ]
            found = [row for setting in settings if (row := _row_of(setting, rows))]
            found = [row for row in found if is_solved(row)]
            at = [[float(row[c]) for row in found] for c in ("dofs", "error")]
            label = f"degree {degree}, {enforcement}"
            axes.loglog(*at, line, color=f"C{degree - 1}", markersize=5, label=label)
    axes.set(title=one.name, xlabel="dofs", ylabel="largest relative error")


def _draw_parameters(path: Path, scenes: Mapping[str, Scene], rows: Sequence[Row]) -> None:
    """Plot error and iterations over the stiffness, and error over the number of increments."""
    with plotting.figure(path, 3, size=(4.8, 4.2)) as (left, middle, right):
        for number, one in enumerate(scenes.values()):
            for enforcement, line in ENFORCEMENTS:
                start = replace(one.base, enforcement=enforcement)
                found = _varied(start, "k_n", rows)
                at = [float(row["k_n"]) for row in found]
                label = one.name if enforcement == "penalty" else None
                style = {"color": f"C{number}", "markersize": 4, "label": label}
                left.loglog(at, [float(row["error"]) for row in found], line, **style)
                middle.loglog(at, [float(row["iterations"]) for row in found], line, **style)
            if one.has_friction:
                found = _varied(one.base, "increments", rows)
                at = [float(row["increments"]) for row in found]
                errors = [float(row["error"]) for row in found]
                right.loglog(at, errors, "o-", color=f"C{number}", label=one.name)
        left.set(xlabel="k_n h/E", ylabel="largest relative error")
        middle.set(xlabel="k_n h/E", ylabel="iterations")
        right.set(xlabel="number of increments", ylabel="largest relative error")
        for axes in (left, middle, right):
            axes.grid(alpha=0.25)
        for axes in (middle, right):
            axes.legend(fontsize=7)


def _varied(base: Setting, name: str, rows: Sequence[Row]) -> list[Row]:
    """Return the solved rows that differ from a setting in one parameter, sorted by it."""
    kind = type(getattr(base, name))
    values = sorted({kind(row[name]) for row in rows if row["scene"] == base.scene})
    found = [_row_of(replace(base, **{name: value}), rows) for value in values]
    return [row for row in found if row and is_solved(row)]
