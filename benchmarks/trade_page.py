"""What the rows of `benchmarks/trade.py` say: those that no other dominates, pictures, the page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import timing
from benchmarks.trade_scenes import KNOBS, QUANTITIES, Scene, Setting
from fenics_contact import plotting

Row = timing.Row
# A row dominates another if both its error and its time are smaller by this share.
MARGIN = 0.1


def turned(row: Row, base: Setting) -> tuple[str, ...]:
    """The knobs in which a row differs from the base point."""
    return tuple(name for name in KNOBS if row[name] != str(getattr(base, name)))


def describe(row: Row, base: Setting) -> str:
    """The same with their values, in words."""
    if row["accuracy"]:
        return f"accuracy = {row['accuracy']}"
    names = [name for name in turned(row, base) if name not in ("h", "degree")]
    return ", ".join(f"{name} = {_short(row[name])}" for name in names) or "base"


def comparable(row: Row, rows: Sequence[Row]) -> list[Row]:
    """Rows with a solution of the same scene, mesh and degree: times have the same unit."""
    same = ("scene", "h", "degree")
    return [r for r in rows if solved(r) and all(r[name] == row[name] for name in same)]


def solved(row: Row) -> bool:
    """Whether a row of the sweep has a solution."""
    return row["role"] == "sweep" and row["error"] != ""


def dominating(row: Row, rows: Sequence[Row], margin: float = MARGIN) -> list[Row]:
    """Those of the rows that have both less error and less time, each by the margin."""
    return [
        other
        for other in rows
        if all(float(other[c]) < (1 - margin) * float(row[c]) for c in ("error", "time"))
    ]


def front(rows: Sequence[Row]) -> list[Row]:
    """Rows that no other beats in both error and time, the quickest first."""
    kept: list[Row] = []
    for row in sorted(rows, key=lambda r: (float(r["time"]), float(r["error"]))):
        if not kept or float(row["error"]) < float(kept[-1]["error"]):
            kept.append(row)
    return kept


def draw(path: Path, one: Scene, rows: Sequence[Row]) -> None:
    """Error over time: the knobs on the base mesh, and all meshes in one unit."""
    base = one.base
    rows = [row for row in rows if row["scene"] == one.name and solved(row)]
    here = [r for r in rows if r["h"] == str(base.h) and r["degree"] == str(base.degree)]
    with plotting.figure(path, 2, size=(5.6, 4.4)) as (left, right):
        groups: dict[str, list[Row]] = {}
        for row in here:
            names = turned(row, base)
            group = "accuracy" if row["accuracy"] else names[0] if len(names) == 1 else "several"
            groups.setdefault(group if names else "base", []).append(row)
        for (name, some), marker in zip(groups.items(), "so^vD<>pPX*hd", strict=False):
            at = [[float(row[c]) for row in some] for c in ("time", "error")]
            size = 9 if name in ("accuracy", "base") else 5
            left.loglog(*at, marker, markersize=size, label=name, alpha=0.8)
        for row in groups.get("accuracy", []):
            place = float(row["time"]), float(row["error"])
            left.annotate(row["accuracy"], place, xytext=(6, 5), textcoords="offset points")
        best = front(here)
        at = [[float(row[c]) for row in best] for c in ("time", "error")]
        left.step(*at, "k-", where="post", linewidth=0.8, label="front")
        left.set(title=f"{one.name}, h = {_short(base.h)}", xlabel="time / linear solve")
        unit = np.median([float(row["linear solve [s]"]) for row in here])
        for degree, marker in (("1", "o"), ("2", "s")):
            for number, h in enumerate(one.sizes):
                some = [r for r in rows if r["h"] == str(h) and r["degree"] == degree]
                if some:
                    at = [
                        [float(row["seconds"]) / unit for row in some],
                        [float(row["error"]) for row in some],
                    ]
                    label = f"h = {_short(h)}, degree {degree}"
                    right.loglog(
                        *at, marker, color=f"C{number}", markersize=4, alpha=0.7, label=label
                    )
        right.set(title="all meshes", xlabel=f"time / linear solve of h = {_short(base.h)}")
        for axes in (left, right):
            axes.set_ylabel("largest relative error")
            axes.grid(alpha=0.25)
            axes.legend(fontsize=7)


def page(scenes: dict[str, Scene], rows: Sequence[Row], stem: str, about: str, advice: str) -> str:
    """Everything in Markdown: references, advice, pictures, fronts, knobs, failures.

    Args:
        scenes: By name.
        rows: Of the study.
        stem: Of the names of pictures.
        about: What the study is: its second paragraph and the third are shown.
        advice: What to choose.
    """
    lines = ["# Speed for accuracy", "", *_unwrapped(about)[1:3], "", advice.strip(), ""]
    lines += ["## References", ""]
    body = []
    for one in scenes.values():
        own = next((r for r in rows if r["scene"] == one.name and r["role"] == "reference"), None)
        for name, value in one.published.items():
            if not value:
                continue
            ours = f"{float(own[name]):.7g}" if own else "the exact value"
            how = f"h = {_short(own['h'])}, {own['increments']} increments" if own else ""
            body.append((one.name, name, ours, how, f"{value:.6g}", one.source))
    lines += _table(("scene", "quantity", "reference", "found with", "published", "source"), body)
    for one in scenes.values():
        lines += ["", f"## {one.name[0].upper()}{one.name[1:]}", ""]
        lines += [f"![Error against time, {one.name}]({stem}-{slug(one.name)}.png)", ""]
        here = comparable({"scene": one.name} | _key(one.base), rows)
        best = front(here)
        body = [(describe(row, one.base), *_numbers(row)) for row in best]
        body += [
            (f"{describe(row, one.base)} (not on the front)", *_numbers(row))
            for row in here
            if (row["accuracy"] or not turned(row, one.base)) and row not in best
        ]
        head = ("setting", "error", "largest in", "time", "iterations")
        lines += [f"The front at h = {_short(one.base.h)}, degree {one.base.degree}:", ""]
        lines += [*_table(head, body), "", "Mesh, degree and enforcement (error · time):", ""]
        lines += _grid(one, rows)
    lines += ["", "## Knob by knob", "", "Error · time · iterations, each knob alone turned away "]
    lines[-1] += "from the base point: " + _base(scenes) + "."
    for title, fixed, knob in (
        ("k_n, in units of E/h", {}, "k_n"),
        ("k_t, in units of k_n", {}, "k_t"),
        ("Quadrature of Γc, degree", {}, "quadrature"),
        ("Increments", {}, "increments"),
        ("snes_rtol", {}, "rtol"),
        ("Solver", {}, "solver"),
        ("k_n with multipliers", {"enforcement": "augmented"}, "k_n"),
        ("Tolerance of the multipliers", {"enforcement": "augmented"}, "tolerance"),
        ("accuracy=", {}, "accuracy"),
    ):
        found = _knob(scenes, rows, fixed, knob)
        if len(found) > 1:
            lines += ["", f"### {title}", "", *_table((knob, *scenes), found)]
    failed = [row for row in rows if row["failure"]]
    lines += ["", "## What broke", ""]
    body = [
        (
            row["scene"],
            f"h = {_short(row['h'])}, degree {row['degree']}, "
            + describe(row, scenes[row["scene"]].base),
            row["failure"],
            f"{float(row['time']):.3g}",
        )
        for row in failed
    ]
    lines += _table(("scene", "setting", "error", "time"), body) if body else ["Nothing."]
    return "\n".join(lines) + "\n"


def _unwrapped(text: str) -> list[str]:
    """Paragraphs."""
    return [paragraph + "\n" for paragraph in text.split("\n\n")]


def _table(head: Sequence[str], body: Sequence[Sequence[Any]]) -> list[str]:
    rows = ["| " + " | ".join(str(cell) for cell in row) + " |" for row in (head, *body)]
    return [rows[0], "|" + "---|" * len(head), *rows[1:]]


def _key(setting: Setting) -> Row:
    return {name: str(getattr(setting, name)) for name in KNOBS}


def _short(value: Any) -> str:
    try:
        return f"{float(value):.3g}"
    except ValueError:
        return str(value)


def slug(name: str) -> str:
    """A scene's name as a part of those of files."""
    return name.lower().replace(" ", "-").replace("μ=", "mu-").replace(".", "")


def _base(scenes: dict[str, Scene]) -> str:
    """The base point in words."""
    one = next(iter(scenes.values())).base
    found = [f"{name} = {_short(getattr(one, name))}" for name in KNOBS[1:]]
    return ", ".join(f for f in found if not f.startswith(("increments", "tolerance", "accuracy")))


def _numbers(row: Row) -> tuple[str, ...]:
    """Error, what it is largest in, time and iterations."""
    worst = next(n for n in QUANTITIES if row[f"{n}, error"] == row["error"])
    return f"{float(row['error']):.1e}", worst, f"{float(row['time']):.1f}", row["iterations"]


def _cell(row: Row | None, iterations: bool = True) -> str:
    if row is None:
        return "–"
    if row["failure"]:
        return f"fails · {float(row['time']):.1f}"
    error, _, time, count = _numbers(row)
    return " · ".join((error, time, count) if iterations else (error, time))


def _grid(one: Scene, rows: Sequence[Row]) -> list[str]:
    """Mesh by mesh, degrees and enforcements beside each other."""
    body = []
    kinds = [(degree, way) for degree in (1, 2) for way in ("penalty", "augmented")]
    for h in one.sizes:
        wanted = [
            replace(one.base, h=h, degree=degree, enforcement=enforcement)
            for degree, enforcement in kinds
        ]
        found = [_row_of(setting, rows) for setting in wanted]
        dofs = [row["dofs"] for row in (found[0], found[2]) if row]
        body.append((_short(h), " / ".join(dofs), *(_cell(row, False) for row in found)))
    return _table(("h", "dofs", *(f"degree {degree}, {way}" for degree, way in kinds)), body)


def _row_of(setting: Setting, rows: Sequence[Row]) -> Row | None:
    wanted = {"role": "sweep", "scene": setting.scene} | _key(setting)
    return next((row for row in rows if all(row[k] == v for k, v in wanted.items())), None)


def _knob(
    scenes: dict[str, Scene], rows: Sequence[Row], fixed: dict[str, Any], knob: str
) -> list[tuple[str, ...]]:
    """Values of a knob, and what they do in every scene."""
    values = {
        row[knob]
        for row in rows
        if row["role"] == "sweep"
        and set(turned(row, scenes[row["scene"]].base)) - {*fixed} == {knob}
    }
    values |= {str(getattr(one.base, knob)) for one in scenes.values()}
    order = sorted(values, key=lambda v: (0, float(v), v) if _is_number(v) else (1, 0.0, v))
    body = []
    for value in order:
        found = []
        for one in scenes.values():
            start = replace(one.base, **fixed)
            kind = type(getattr(start, knob))
            found.append(_row_of(replace(start, **{knob: kind(value)}), rows))
        if any(found):
            body.append((_short(value) if value else "none", *map(_cell, found)))
    return body


def _is_number(value: str) -> bool:
    try:
        float(value)
    except ValueError:
        return False
    return True
