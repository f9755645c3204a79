"""Write the page of the benchmarks and its figures from the CSV files of the benchmarks."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import costs, targets, timing
from fenics_contact import plotting
from verification import report

Rows = Sequence[Mapping[str, str]]
STAMP = "stamp.json"
# Runs in the figure of cost over size, by problem.
SIZES = {
    "half_cylinder": (
        "one linear solve",
        "μ = 0.2, 1 increments: by default",
        "μ = 0.2, 40 increments: by default",
        f"μ = 0.2, 40 increments: by default{costs.LAST_INTERIOR}",
        "μ = 0.2: plain DOLFINx, LU",
    ),
    "ball": (
        "one linear solve",
        "one linear solve, multigrid",
        "by default",
        "plain DOLFINx, GMRES + GAMG",
        "plain DOLFINx, LU",
    ),
    "tagged": (
        "one linear solve",
        "1 increment",
        "10 increments",
        "plain DOLFINx, GMRES + GAMG",
    ),
}
TITLES = {
    "half_cylinder": "half-cylinder on a plane",
    "ball": "ball on a block, 3D",
    "tagged": "ball on a block, whole top face on Γc",
}


def write(folder: Path, page: Path) -> None:
    """Write the page, targets.csv and the figures of the benchmarks in a folder."""
    met = targets.table(folder)
    report.save(folder / "targets.csv", met)
    lines = ["# Benchmarks", "", *_targets(folder, met)]
    for section in (_cost, _large, _ranks, _parallel, _accuracy):
        try:
            lines += section(folder)
        except (FileNotFoundError, LookupError):
            continue  # not measured in this folder
    lines += report.text(
        "CPU times of five scripts of the documentation: [limits and costs](expect.md), "
        "[tasks.csv](benchmarks/tasks/tasks.csv). Written by `python benchmarks/run.py`; `--page` "
        "writes the page and its figures from the stored measurements."
    )
    here = folder.relative_to(page.parent).as_posix() if folder != page.parent else ""
    text = "\n".join(lines).rstrip() + "\n"
    page.write_text(text.replace("](benchmarks/", f"]({here}/" if here else "]("))


# ---- sections ------------------------------------------------------------------------------------


def _targets(folder: Path, met: Sequence[timing.Row]) -> list[str]:
    """Return the lines on the targets, missed ones first, and on the machine."""
    missed, reached, missing = (
        [row for row in met if row["met"] == answer]
        for answer in ("no", "yes", targets.NOT_MEASURED)
    )
    stamps = [json.loads(path.read_text()) for path in sorted(folder.glob(f"*/{STAMP}"))]
    lines = report.text(f"**{len(missed)} of {len(met)} targets are missed.**")
    if missing:
        lines += report.text(f"{len(missing)} targets were not measured.")
    if failed := [path.parent.name for path in folder.glob(f"*/{STAMP}") if _failed(path)]:
        lines += report.text(f"**Failed benchmarks: {', '.join(failed)}.**")
    if stamps:
        dates = sorted({stamp["date"] for stamp in stamps})
        machines = "; ".join(sorted({stamp["machine"] for stamp in stamps}))
        lines += report.text(
            "Times are in units of one linear solve of the same body, assembly included: with Γc "
            "fixed, by MUMPS' Cholesky factorisation. They are medians of 3 runs, of one run above "
            f"30 s. Meshing and compilation are not included. {machines}, OMP_NUM_THREADS 1, "
            f"{dates[0]}" + (f" to {dates[-1]}." if len(dates) > 1 else ".")
        )
    if missed or reached:
        draw_targets(folder / "targets.png", missed + reached)
        lines += ["![Measured values relative to their targets](benchmarks/targets.png)", ""]
    if missed:
        lines += ["## Missed targets", ""]
        body = [(r["problem"], r["quantity"], r["target"], f"{r['measured']:.3g}") for r in missed]
        lines += report.table(("problem", "quantity", "target", "measured"), body)
        lines += report.text("All targets are in [targets.csv](benchmarks/targets.csv).")
    return lines


def _failed(stamp: Path) -> bool:
    return bool(json.loads(stamp.read_text())["failed"])


def _cost(folder: Path) -> list[str]:
    """Return the section on the cost of contact relative to one linear solve."""
    tables = {name: report.read(folder / name / f"{name}_sizes.csv") for name in SIZES}
    draw_cost(folder / "cost.png", tables)
    lines = ["## Cost of contact", "", "![Time over dofs](benchmarks/cost.png)", ""]
    lines += report.text(
        '*Time over the number of dofs, with exponents of fitted power laws. "By default": method '
        "and linear solver as this package selects them. Plain DOLFINx: a hand-written penalty "
        "form, Newton's method with the consistent tangent.*",
        "Time of the largest problems, in linear solves:",
    )
    items = []
    for name, runs in SIZES.items():
        largest = max(int(row["dofs"]) for row in tables[name])
        solves = {r["run"]: r["linear solves"] for r in tables[name] if int(r["dofs"]) == largest}
        times = "; ".join(f"{run} {report.number(solves[run])}" for run in runs[1:])
        data = f"[sizes](benchmarks/{name}/{name}_sizes.csv), [runs](benchmarks/{name}/{name}.csv)"
        items.append(f"- **{TITLES[name]}**, {largest} dofs: {times} ({data})")
    joint = report.read(folder / "bolted_joint/bolted_joint.csv")
    refused = [row for row in joint if row["method"].startswith("refused")]
    solved = [float(row["linear solves"]) for row in joint if row not in refused]
    rollers = report.read(folder / "bearing/bearing.csv")
    finest = [row for row in rollers if row["dofs"] == rollers[-1]["dofs"]]
    increments = [float(row["linear solves"]) for row in finest]
    coarse = [float(row["linear solves"]) for row in rollers if row not in finest]
    coarser = report.number(max(coarse))
    refusals = " and ".join(report.number(row["linear solves"]) for row in refused)
    lines += report.text(
        *items,
        "- **bolted joint**, three bodies, quadratic tetrahedra, "
        f"{joint[0]['dofs']} dofs: {min(solved):.1f} to {max(solved):.1f} for an increment; "
        f"{refusals} for the refusal of a load above the friction limit, on one and two ranks, in "
        "linear solves of the bodies tied at the contacts "
        "([all runs](benchmarks/bolted_joint/bolted_joint.csv))",
        f"- **roller bearing**, ten bodies in sixteen contacts, {finest[0]['dofs']} dofs in the "
        f"plane: {report.number(min(increments))} to {report.number(max(increments))} for one of "
        f"{len(increments)} increments, in linear solves of the bodies tied, "
        f"{sum(int(row['iterations']) for row in finest)} iterations in all; at most {coarser} "
        "with coarser triangles ([all runs](benchmarks/bearing/bearing.csv))",
        '"Interior at the end": `increments(..., recover_interior="last")`. Newton iterations at '
        "large strains are in [finite.csv](benchmarks/finite/finite.csv).",
    )
    return lines


def _large(folder: Path) -> list[str]:
    """Return the section on the largest problems."""
    rows = report.read(folder / "large/large.csv")
    runs = {row["dofs"]: row for row in rows if row["run"] == "contact"}
    ratios = ", ".join(report.number(row["linear solves (multigrid)"]) for row in runs.values())
    largest = runs[max(runs, key=int)]
    return [
        "## Large",
        "",
        *report.text(
            "Ball on a block, μ = 0.3: an increment on one rank takes "
            f"{ratios} times as long as one linear solve by multigrid, with {', '.join(runs)} "
            f"dofs; the largest problem takes {report.number(largest['seconds'])} s and "
            f"{report.number(largest['GiB'])} GiB ([large.csv](benchmarks/large/large.csv))."
        ),
    ]


def _ranks(folder: Path) -> list[str]:
    """Return the section on the half-cylinder on two ranks."""
    rows = report.read(folder / "ranks/ranks.csv")
    two = [row for row in rows if row["ranks"] == "2"]
    gains = "; ".join(f"{row['run']} {report.number(row['speed-up'])}" for row in two)
    return [
        "## Ranks",
        "",
        *report.text(
            f"Speed-up of two ranks, half-cylinder, {two[0]['dofs']} dofs, static condensation: "
            f"{gains} ([ranks.csv](benchmarks/ranks/ranks.csv))."
        ),
    ]


def _parallel(folder: Path) -> list[str]:
    """Return the section on two ranks with multigrid, and on the model of the cost."""
    rows = report.read(folder / "parallel/parallel_1.csv")
    largest = max(rows, key=lambda row: int(row["dofs"]))["dofs"]
    gains = "; ".join(
        f"{row['run']} {report.number(row['speed-up'])} ({report.number(row['speed-up, model'])})"
        for row in rows
        if row["ranks"] == "2" and row["dofs"] == largest
    )
    return [
        "## Parallel",
        "",
        "![Speed-up over ranks](benchmarks/parallel/speed_up.png)",
        "",
        *report.text(
            "*[Model of the cost](parallel.md#a-model-of-the-cost), with constants of "
            "[this machine](benchmarks/parallel/machine.json); nothing was measured on more than "
            "two ranks.*",
            f"Speed-up of two ranks, ball on a block, {largest} dofs, measured and by the model: "
            f"{gains}.",
            "Data: [measurements](benchmarks/parallel/parallel.csv); "
            "[model](benchmarks/parallel/parallel_1.csv), "
            "[time by operation](benchmarks/parallel/parallel_2.csv), "
            "[operations and messages](benchmarks/parallel/parallel_3.csv); extrapolated "
            "[speed-ups](benchmarks/parallel/parallel_4.csv) and "
            "[times](benchmarks/parallel/parallel_5.csv); "
            "[interfaces of the ranks](benchmarks/parallel/parallel_6.csv) with static "
            "condensation.",
        ),
    ]


def _accuracy(folder: Path) -> list[str]:
    """Return the section on enforcement, quadrature and adaptive refinement."""
    draw_accuracy(folder / "accuracy.png", folder)
    return [
        "## Accuracy",
        "",
        "![Error of enforcement, quadrature and refinement](benchmarks/accuracy.png)",
        "",
        *report.text(
            "*Left: half-cylinder, μ = 0.2: the augmented Lagrangian takes the time of the "
            "penalty method. Nitsche's method, hand-written in DOLFINx and not condensed, is as "
            "accurate and takes six to seven times as long; without the symmetric term and with "
            "γ = 100 E/h it does not converge here. Middle: with quadratic displacements one Gauss "
            "point per edge, which the package no longer accepts, is too few; the default is 3, "
            "and a fourth point gains little. Right: cylinder on a block; adaptive refinement "
            "reaches the same error with a fourth to a seventh of the dofs.*",
            "Data: [GRECO block](benchmarks/enforcement/greco_block.csv), half-cylinder with "
            "[μ = 0](benchmarks/enforcement/half-cylinder_mu__0.csv) and "
            "[μ = 0.2](benchmarks/enforcement/half-cylinder_mu__02.csv); quadrature with "
            "[linear](benchmarks/quadrature/degree_1.csv) and "
            "[quadratic](benchmarks/quadrature/degree_2.csv) displacements; "
            "[refinement](benchmarks/adaptation/adaptation.csv).",
        ),
    ]


# ---- figures -------------------------------------------------------------------------------------


def draw_targets(path: Path, rows: Sequence[timing.Row]) -> None:
    """Plot measured values relative to their targets."""
    ratios = []
    for row in rows:
        sign, limit = row["target"].split()
        ratio = row["measured"] / float(limit)
        ratios.append(ratio if sign == "≤" else 1 / ratio)
    names = [f"{row['problem']}: {row['quantity']} {row['target']}" for row in rows]
    with plotting.figure(path, size=(10.0, 0.24 * len(rows) + 1.0)) as axes:
        for answer, colour, label in (("no", "C3", "missed"), ("yes", "C0", "met")):
            at = [i for i, row in enumerate(rows) if row["met"] == answer]
            values = [ratios[i] for i in at]
            axes.hlines(at, 1.0, values, color=colour, linewidth=2.0)
            axes.plot(values, at, "o", color=colour, label=label)
        axes.set_yticks(range(len(rows)), names, fontsize=7)
        axes.axvline(1.0, color="k", linewidth=1.0)
        axes.set(xscale="log", ylim=(len(rows) - 0.4, -0.6))
        _plain_ticks(axes.xaxis, (0.2, 0.5, 1.0, 2.0, 5.0))
        axes.set_xlabel("measured / target, inverse for speed-ups")
        axes.grid(alpha=0.25)
        axes.legend(loc="lower right", fontsize=8)


def draw_cost(path: Path, tables: Mapping[str, Rows]) -> None:
    """Plot time over dofs with fitted power laws."""
    with plotting.figure(path, len(SIZES), size=(5.0, 4.4)) as all_axes:
        for axes, (name, runs) in zip(all_axes, SIZES.items(), strict=True):
            for run, style in zip(runs, ("k.--", "C0o-", "C1s-", "C3v-", "C4^-"), strict=False):
                mine = [r for r in tables[name] if r["run"] == run and r["iterations"] != "none"]
                x, y = ([float(r[c]) for r in mine] for c in ("dofs", "seconds"))
                label = run
                if len(x) > 2:
                    label += f" ({timing.fit(x, y)[1]:.2f})"
                axes.loglog(x, y, style, markersize=4, label=label)
            axes.set(title=TITLES[name], xlabel="dofs", ylabel="time [s]")
            axes.set_ylim(top=30.0 * axes.get_ylim()[1])  # the legend is above the curves
            axes.grid(alpha=0.25, which="both")
            axes.legend(loc="upper left", fontsize=7)


def draw_accuracy(path: Path, folder: Path) -> None:
    """Plot errors by enforcement, quadrature and refinement."""
    enforcement = report.read(folder / "enforcement/half-cylinder_mu__02.csv")
    quadrature = report.read(folder / "quadrature/degree_2.csv")
    refinement = report.read(folder / "adaptation/adaptation.csv")
    with plotting.figure(path, 3, size=(4.8, 4.2)) as (left, middle, right):
        for kind, marker in (("penalty", "o"), ("augmented", "*"), ("Nitsche", "s")):
            mine = [r for r in enforcement if r["run"].startswith(kind)]
            mine = [r for r in mine if r["iterations"] != "none"]
            x, y = ([float(r[c]) for r in mine] for c in ("seconds", "displacement error"))
            left.loglog(x, y, marker, markersize=9 if marker == "*" else 5, label=kind)
            for row, place in zip(mine, zip(x, y, strict=True), strict=True):
                text = row["run"].removeprefix(kind).strip()
                below = "symmetric" in text or kind == "augmented"
                shift = (8, -4) if text == "10000" else (4, -9 if below else 4)
                left.annotate(text, place, shift, textcoords="offset points", fontsize=7)
        left.set(title="Enforcement (numbers: k_n h/E)", xlabel="time [s]", xscale="linear")
        left.set_xlim(0, 8.5)
        left.set_ylabel("relative error of the displacement")
        _draw_groups(middle, quadrature, _rule, "h", "pressure error")
        middle.set(
            title="Quadrature on Γc, degree 2", xlabel="h", ylabel="L² error of the pressure"
        )
        _plain_ticks(middle.xaxis, (0.05, 0.1, 0.2))
        _plain_ticks(middle.yaxis, (0.002, 0.005, 0.01, 0.02))
        _draw_groups(right, refinement, _refinement, "dofs", "error of the energy norm")
        right.set(title="Refinement", xlabel="dofs", ylabel="estimated error, energy norm")
        for axes in (left, middle, right):
            axes.grid(alpha=0.25, which="both")
            axes.legend(fontsize=7)


def _plain_ticks(axis: Any, values: Sequence[float]) -> None:
    """Label a logarithmic axis at some values only."""
    axis.set_ticks(values, labels=[f"{value:g}" for value in values])
    axis.set_ticks([], minor=True)


def _rule(row: Mapping[str, str]) -> str:
    names = {"penalty 10": "penalty 10 E/h", "augmented 10": "augmented Lagrangian"}
    known = names.get(row["enforcement"])
    return f"{known}, {row['rule']}" if known else ""


def _refinement(row: Mapping[str, str]) -> str:
    return f"μ = {float(row['μ']):g}, {row['refinement']}"


def _draw_groups(
    axes: Any, rows: Rows, group: Callable[[Mapping[str, str]], str], x: str, y: str
) -> None:
    """Plot a line for each group of rows, and omit rows of the group ""."""
    names = [name for name in dict.fromkeys(group(row) for row in rows) if name]
    for number, name in enumerate(names):
        mine = [row for row in rows if group(row) == name and row[y] != ""]
        at = [np.array([float(row[c]) for row in mine]) for c in (x, y)]
        line = "o-" if number < (len(names) + 1) // 2 else "s--"
        axes.loglog(*at, line, color=f"C{number % ((len(names) + 1) // 2)}", markersize=4)
        axes.lines[-1].set_label(name)
