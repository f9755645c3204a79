"""What accuracy costs: every knob turned on five scenes, true error against time.

Scenes: the half-cylinder without friction and with μ = 0.2, the GRECO block, a rigid ball on a
block in three dimensions, and the shrink fit of two rings. One knob after another is turned around
a base point, and mesh size, degree and enforcement together. Errors are the largest of the relative
errors of normal force, friction force, peak pressure and a displacement, against Lamé's solution
for the rings and else against a solution of this package on a far finer mesh with multipliers, a
tight tolerance and many increments, which is compared with published values. Times are in
units of one linear solve of the same mesh and degree (assembly, factorisation, solution, Γc held)
made in turn with the runs, the quickest of ``--repeat`` and for the unit of all; meshing and the
compiling of forms, done before, are not counted.

    OMP_NUM_THREADS=1 python benchmarks/trade.py            # ten minutes; writes docs/
    OMP_NUM_THREADS=1 python benchmarks/trade.py --short    # a minute; writes to --output only

Rows are kept in ``trade.csv`` of the output folder as they are done: a run that was killed goes on
there when started again; ``--fresh`` starts anew. A setting that fails is a row, too.
"""

from __future__ import annotations

import csv
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from tqdm import tqdm

import fenics_contact as fc
from benchmarks import costs, timing
from fenics_contact import plotting
from fenics_contact.contact.accuracy import PRESETS
from scenes import problems
from scenes.problems import (
    Body,
    ball_on_half_space,
    greco,
    greco_block,
    half_cylinder,
    hertz,
    rings,
    shrink_fit,
    sphere,
)

HERE = Path(__file__).parent
DOCS = HERE.parent / "docs"
Row = timing.Row
QUANTITIES = ("normal force", "friction force", "peak pressure", "displacement")
# Runs that take longer than this are not repeated (s).
LONG = 3.0
# A history is given up after this time (s).
LIMIT = 20.0
# A row dominates another if both its error and its time are smaller by this share.
MARGIN = 0.1


@dataclass(frozen=True)
class Setting:
    """One configuration: a scene, its mesh, and all knobs.

    Attributes:
        scene: Name of one of `SCENES`.
        h: Size of the cells at Γc: a length, for the ball in units of the contact radius.
        degree: Of the displacement.
        k_n: In units of E/h.
        k_t: In units of k_n.
        enforcement: "penalty" or "augmented".
        tolerance: Of augmented enforcement.
        quadrature: Degree of the rule on Γc, "vertex", or "default".
        increments: Equal ones.
        rtol: ``snes_rtol``.
        solver: Method of the problem: "lbfgs", "newton" or "default", the package's choice.
        accuracy: The preset that sets stiffness, enforcement and tolerances instead, if any.
    """

    scene: str
    h: float
    degree: int = 2
    k_n: float = 10.0
    k_t: float = 1.0
    enforcement: str = "penalty"
    tolerance: float = 1e-5
    quadrature: str = "default"
    increments: int = 1
    rtol: float = 1e-9
    solver: str = "default"
    accuracy: str = ""


# Knobs that change what is compiled.
COMPILED = ("degree", "enforcement", "quadrature", "accuracy")
KNOBS = tuple(field.name for field in fields(Setting) if field.name != "scene")
COLUMNS = (
    "role",
    "scene",
    *KNOBS,
    "failure",
    "dofs",
    "steps",
    "iterations",
    "rounds",
    "finished by",
)
COLUMNS += (*QUANTITIES, *(f"{name}, error" for name in QUANTITIES), "error")
COLUMNS += ("seconds", "linear solve [s]", "time")


@dataclass(frozen=True)
class Scene:
    """A body at all its mesh sizes.

    Attributes:
        name: Of it.
        make: The body of cells of a size.
        sizes: The meshes, coarsest first; ``base`` is one of them.
        reference: How the reference is found, or None where there is an exact solution.
        published: What others have, to set beside the reference.
        source: Where that is from.
    """

    name: str
    make: Callable[[float], Body]
    sizes: tuple[float, ...]
    base: Setting
    reference: Setting | None
    published: dict[str, float]
    source: str

    @property
    def has_friction(self) -> bool:
        """Whether its law has."""
        return self.make(self.sizes[0]).friction > 0


def scene(
    name: str,
    make: Callable[[float], Body],
    sizes: Sequence[float],
    base: float,
    finest: float | None,
    published: dict[str, float],
    source: str,
    increments: tuple[int, int] = (1, 1),
) -> Scene:
    """A scene whose reference has multipliers, tight tolerances and small increments."""
    start = Setting(name, base, increments=increments[0])
    tight = {"enforcement": "augmented", "tolerance": 1e-7, "rtol": 1e-10}
    reference = None
    if finest is not None:
        reference = replace(start, h=finest, increments=increments[1], **tight)
    return Scene(name, make, tuple(sizes), start, reference, published, source)


def all_scenes() -> dict[str, Scene]:
    """Those of the full study."""
    hertz_ball = sphere.hertz("block", 4e-4, 0.0)
    p, bore, _ = shrink_fit.lame("plane strain")
    sizes = (0.42, 0.2, 0.1, 0.05)
    exact = [hertz.EXACT[mu] for mu in (0.0, 0.2)]
    cylinder = [
        {
            "normal force": hertz.R * hertz.PAPER_LOAD,
            "friction force": values["tangential_resultant"],
            "peak pressure": values["peak_pressure"],
            "displacement": values["top_centre_displacement"][1],
        }
        for values in exact
    ]
    independent = "independent solution, exact complementarity"
    made = [
        scene(
            "half-cylinder",
            partial(half_cylinder, 0.0, smooth=True),
            sizes,
            0.05,
            0.025,
            cylinder[0],
            independent,
        ),
        scene(
            "half-cylinder μ=0.2",
            partial(half_cylinder, 0.2, smooth=True),
            sizes,
            0.05,
            0.025,
            cylinder[1],
            independent,
            (20, 320),
        ),
        scene(
            "GRECO block",
            lambda h: greco_block(round(greco.SIZE / h)),
            (5.0, 2.5, 1.25),
            1.25,
            40 / 96,
            {
                "normal force": 2000.0,
                "friction force": greco.SHEAR,
                "displacement": greco.CONVERGED[0],
            },
            independent,
        ),
        scene(
            "ball on block",
            lambda h: ball_on_half_space(round(1 / h)),
            (1 / 3, 1 / 4, 1 / 6),
            1 / 4,
            1 / 9,
            {
                "normal force": hertz_ball["force [N]"] / 4,
                "peak pressure": hertz_ball["peak pressure [MPa]"],
                "displacement": -4e-4,
            },
            "Hertz, a/R = 0.02",
        ),
        scene(
            "shrink fit",
            rings,
            (4.0, 2.0, 1.0, 0.5),
            1.0,
            None,
            {
                "normal force": p * np.pi / 2 * shrink_fit.JOINT,
                "peak pressure": p,
                "displacement": bore,
            },
            "Lamé, exact",
        ),
    ]
    return {one.name: one for one in made}


def short_scenes() -> dict[str, Scene]:
    """Coarse meshes of the half-cylinder."""
    made = []
    for one in list(all_scenes().values())[:2]:
        steps = 4 if one.has_friction else 1
        assert one.reference is not None
        base = replace(one.base, h=0.42, increments=steps)
        reference = replace(one.reference, h=0.2, increments=steps)
        made.append(replace(one, sizes=(0.42,), base=base, reference=reference))
    return {one.name: one for one in made}


def sweep(one: Scene, short: bool) -> list[Setting]:
    """Every setting of a scene once: knob by knob, and the grids."""
    base, friction = one.base, one.has_friction
    if short:
        return [
            base,
            replace(base, k_n=100.0),
            replace(base, enforcement="augmented"),
            replace(base, solver="newton"),
        ]
    knobs: dict[str, Sequence[Any]] = {
        "k_n": (0.1, 1.0, 100.0, 1e3, 1e4, 1e6),
        "quadrature": ("1", "3", "5", "7", "vertex"),
        "increments": (1, 2, 5, 10, 20, 40, 80) if friction else (1, 5),
        "rtol": (1e-2, 1e-3, 1e-4, 1e-6, 1e-12),
        "solver": ("lbfgs", "newton"),
        "accuracy": (*PRESETS, "0.003", *(() if one.make(one.sizes[0]).history else ("1e-4",))),
    }
    if friction:
        knobs["k_t"] = (0.01, 0.1, 10.0, 100.0)
    made = [base]
    for h in one.sizes:
        for degree in (1, 2):
            for enforcement in ("penalty", "augmented"):
                made.append(replace(base, h=h, degree=degree, enforcement=enforcement))
    made += [replace(base, **{name: v}) for name, values in knobs.items() for v in values]
    augmented = replace(base, enforcement="augmented")
    made += [replace(augmented, k_n=k) for k in (1.0, 100.0, 1e3)]
    made += [replace(augmented, tolerance=t) for t in (0.1, 1e-2, 1e-3, 1e-7)]
    made += [replace(augmented, tolerance=t, rtol=0.1 * t) for t in (1e-2, 1e-3)]
    made += [replace(base, degree=1, quadrature="vertex")]
    return list(dict.fromkeys(made))


# ---- one run -------------------------------------------------------------------------------------


def solve(body: Body, setting: Setting, limit: float = LIMIT) -> Row:
    """Make the contact problem and lead the load to its end: what its row has, but the time."""
    made = problems.parts(body, setting.degree)
    rule: dict[str, Any] = {}
    if setting.quadrature == "vertex":
        rule["quadrature_scheme"] = "vertex"
    elif setting.quadrature != "default":
        rule["quadrature_degree"] = int(setting.quadrature)
    stiffness: dict[str, Any] = {}
    choices: dict[str, Any] = {"accuracy": setting.accuracy}
    options: dict[str, Any] = {}
    if setting.accuracy not in ("", *PRESETS):
        choices["accuracy"] = float(setting.accuracy)
    elif not setting.accuracy:
        stiffness = {"k_n": fc.Scaled(setting.k_n)}
        if body.friction:
            stiffness["k_t"] = fc.Scaled(setting.k_n * setting.k_t)
        choices = {"enforcement": setting.enforcement, "tolerance": setting.tolerance}
        options = {"snes_rtol": setting.rtol}
    law: fc.Coulomb | fc.Frictionless
    if body.friction:
        law = fc.Coulomb(body.friction, **stiffness)
    else:
        law = fc.Frictionless(**stiffness)
    row: Row = {"dofs": problems.count(made[0].function_space)}
    steps: list[fc.Step] = []
    try:
        problem, contact, u, load = problems.problem(
            body,
            setting.degree,
            law,
            made=made,
            choices=choices,
            rule=rule,
            method=None if setting.solver == "default" else setting.solver,
            petsc_options=options,
        )
        wanted = None if setting.accuracy and body.history else setting.increments
        start = time.perf_counter()
        for step in fc.increments(problem, load, 0.0, body.end, steps=wanted, max_cuts=2):
            steps.append(step)
            if limit and step.load != body.end and time.perf_counter() - start > limit:
                raise TimeoutError(f"given up after {limit:g} s, at {step.load / body.end:.0%}")
    except (fc.NotConverged, TimeoutError, ValueError, MemoryError, PETSc.Error) as error:
        words = " ".join(str(error).split())
        return row | {"failure": f"{type(error).__name__}: {words[:150]}", "steps": len(steps)}
    resultants = contact.resultants()
    return row | {
        "steps": len(steps),
        "iterations": sum(step.iterations for step in steps),
        "rounds": sum(step.rounds for step in steps),
        "finished by": " ".join(sorted({step.method for step in steps})),
        "normal force": resultants.normal_force,
        "friction force": resultants.tangential_force,
        "peak pressure": resultants.max_pressure,
        "displacement": float(body.displacement(u)),
    }


def errors(row: Row, reference: Row) -> Row:
    """Relative errors of a row, and the largest of them; nothing for what has no value."""
    found = {
        f"{name}, error": abs(float(row[name]) / float(reference[name]) - 1)
        for name in QUANTITIES
        if row.get(name) not in (None, "") and float(reference.get(name) or 0.0)
    }
    return found | ({"error": max(found.values())} if found else {})


def timed(one: Scene, setting: Setting, repeat: int, limit: float = LIMIT) -> Row:
    """Solve in turn with the linear problem, quick ones several times: the least times.

    What else a machine does only ever adds to a time.
    """
    body = one.make(setting.h)
    runs = {
        "linear": lambda: costs.linear_solve(body, setting.degree),
        "contact": lambda: solve(body, setting, limit),
    }
    found = []
    for _ in range(repeat):
        found.append(timing.measure(runs, repeat=1))
        row = found[-1][1]
        if row["seconds"] > LONG or "failure" in row:
            break
    linear, contact = (np.array([rows[i]["seconds"] for rows in found]) for i in range(2))
    return row | {
        "seconds": float(contact.min()),
        "linear solve [s]": float(linear.min()),
    }


# ---- rows that survive ---------------------------------------------------------------------------


class Store:
    """Rows in a CSV file, each written as it is done; a line that was cut off is dropped."""

    def __init__(self, path: Path) -> None:
        """Read what is there.

        Raises:
            ValueError: The file has other columns.
        """
        self.path = path
        self.rows: list[dict[str, str]] = []
        path.parent.mkdir(parents=True, exist_ok=True)
        text = path.read_bytes() if path.exists() else b""
        whole = text[: text.rfind(b"\n") + 1]
        if not whole:
            write(path, [])
            return
        if len(whole) < len(text):
            os.truncate(path, len(whole))
        self.rows = read(path)
        if self.rows and tuple(self.rows[0]) != COLUMNS:
            raise ValueError(f"{path} has other columns than this study; start it with --fresh")

    def find(self, role: str, setting: Setting) -> dict[str, str] | None:
        """The row of a setting."""
        wanted = {"role": role} | {name: str(v) for name, v in asdict(setting).items()}
        return next((r for r in self.rows if all(r[k] == v for k, v in wanted.items())), None)

    def add(self, role: str, setting: Setting, row: Row) -> dict[str, str]:
        """Append a row, to the disk."""
        full = {"role": role} | asdict(setting) | row
        with open(self.path, "a", newline="") as file:
            csv.DictWriter(file, COLUMNS, extrasaction="ignore", lineterminator="\n").writerow(full)
            file.flush()
            os.fsync(file.fileno())
        self.rows.append({name: str(full.get(name, "")) for name in COLUMNS})
        return self.rows[-1]


def read(path: Path) -> list[dict[str, str]]:
    """The rows of a study."""
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def in_linear_solves(rows: Sequence[Row]) -> list[Row]:
    """The rows with their times in units of the quickest linear solve of the same mesh."""
    units: dict[tuple[str, ...], float] = {}
    for row in rows:
        key = row["scene"], row["h"], row["degree"]
        units[key] = min(units.get(key, np.inf), float(row["linear solve [s]"]))
    return [
        row | {"time": str(float(row["seconds"]) / units[row["scene"], row["h"], row["degree"]])}
        for row in rows
    ]


def write(path: Path, rows: Sequence[Row]) -> None:
    """All rows as a new file."""
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def study(scenes: dict[str, Scene], store: Store, repeat: int, short: bool) -> None:
    """Make the rows that are not there yet."""
    settings = [(one, setting) for one in scenes.values() for setting in sweep(one, short)]
    warm: set[tuple[Any, ...]] = set()
    quiet = None if MPI.COMM_WORLD.rank == 0 else True
    with tqdm(total=len(settings), disable=quiet, unit="run") as bar:
        for one, setting in settings:
            bar.set_description(one.name)
            if store.find("sweep", setting) is None:
                reference = find_reference(one, store)
                # What is compiled, and for what: on the coarsest mesh, before anything is timed.
                forms = (one.name, *(getattr(setting, name) for name in COMPILED))
                if forms not in warm:
                    body = one.make(one.sizes[0])
                    costs.linear_solve(body, setting.degree)
                    solve(body, replace(setting, increments=min(2, setting.increments)))
                    warm.add(forms)
                row = timed(one, setting, repeat)
                store.add("sweep", setting, row | errors(row, reference))
            bar.update()


def find_reference(one: Scene, store: Store) -> Row:
    """Exact values, or those of the reference solution, made at first use."""
    if one.reference is None:
        return dict(one.published)
    row: Row | None = store.find("reference", one.reference)
    if row is None:
        row = timed(one, one.reference, 1, limit=0.0)
        if row.get("failure"):
            raise RuntimeError(f"the reference of {one.name} failed: {row['failure']}")
        row = store.add("reference", one.reference, row | errors(row, one.published))
    return row


# ---- what the rows say ---------------------------------------------------------------------------


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


def page(scenes: dict[str, Scene], rows: Sequence[Row], stem: str, advice: str) -> str:
    """Everything in Markdown: references, advice, pictures, fronts, knobs, failures."""
    lines = ["# Speed for accuracy", "", *_unwrapped(__doc__ or "")[1:3], "", advice.strip(), ""]
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
        lines += [f"![Error against time, {one.name}]({stem}-{_slug(one.name)}.png)", ""]
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


def _slug(name: str) -> str:
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


def main() -> None:
    """Run what is missing, then draw and write."""
    parser = timing.parser(__doc__, "trade")
    parser.add_argument(
        "--page", type=Path, help="by default docs/trade.md; of a short run in the output folder"
    )
    parser.add_argument("--fresh", action="store_true", help="forget the rows of earlier runs")
    arguments = parser.parse_args()
    if MPI.COMM_WORLD.size > 1:
        parser.error("times are of one rank")
    scenes = short_scenes() if arguments.short else all_scenes()
    path = arguments.output / ("short.csv" if arguments.short else "rows.csv")
    if arguments.fresh:
        path.unlink(missing_ok=True)
    store = Store(path)
    study(scenes, store, arguments.repeat, arguments.short)
    target = arguments.page or (arguments.output if arguments.short else DOCS) / "trade.md"
    target.parent.mkdir(parents=True, exist_ok=True)
    rows = in_linear_solves(store.rows)
    for one in scenes.values():
        draw(target.with_name(f"{target.stem}-{_slug(one.name)}.png"), one, rows)
    write(target.with_suffix(".csv"), rows)
    advice = "" if arguments.short else (HERE / "trade_advice.md").read_text()
    target.write_text(page(scenes, rows, target.stem, advice))
    print(target)


if __name__ == "__main__":
    np.seterr(all="ignore")
    main()
