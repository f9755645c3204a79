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
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from tqdm import tqdm

import fenics_contact as fc
from benchmarks import costs, timing
from benchmarks.trade_page import draw, page, slug
from benchmarks.trade_scenes import (
    COLUMNS,
    COMPILED,
    QUANTITIES,
    Scene,
    Setting,
    all_scenes,
    short_scenes,
    sweep,
)
from fenics_contact.contact.accuracy import PRESETS
from scenes import problems
from scenes.problems import Body

Row = timing.Row
HERE = Path(__file__).parent
DOCS = HERE.parent / "docs"
# Runs that take longer than this are not repeated (s).
LONG = 3.0
# A history is given up after this time (s).
LIMIT = 20.0


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
        stiffness = {"k_n": fc.RelativeStiffness(setting.k_n)}
        if body.friction:
            stiffness["k_t"] = fc.RelativeStiffness(setting.k_n * setting.k_t)
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
        "rounds": sum(step.augmentations for step in steps),
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
        draw(target.with_name(f"{target.stem}-{slug(one.name)}.png"), one, rows)
    write(target.with_suffix(".csv"), rows)
    advice = "" if arguments.short else (HERE / "trade_advice.md").read_text()
    target.write_text(page(scenes, rows, target.stem, __doc__ or "", advice))
    print(target)


if __name__ == "__main__":
    np.seterr(all="ignore")
    main()
