"""Measure accuracy versus cost: true error over time, with parameters varied on five problems.

Problems, errors and times are described on the page, docs/trade.md, which `trade_page.py` writes.

    OMP_NUM_THREADS=1 python benchmarks/trade.py            # ten minutes; writes docs/
    OMP_NUM_THREADS=1 python benchmarks/trade.py --short    # a minute; writes to --output only
    python benchmarks/trade.py --page                       # page and figures of docs/trade.csv

Rows are stored in the output folder as soon as they are computed; an interrupted study continues
from them, and ``--fresh`` discards them. Failed settings have rows, too.
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
from benchmarks.trade_page import draw, page
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
from scenes.problems import ContactScene
from verification import report

Row = timing.Row
HERE = Path(__file__).parent
DOCS = HERE.parent / "docs"
# Runs that take longer than this are not repeated (s).
MAX_REPEATED_TIME = 3.0
# Time limit of a load history (s).
TIME_LIMIT = 20.0


# ---- one run -------------------------------------------------------------------------------------


def solve(body: ContactScene, setting: Setting, limit: float = TIME_LIMIT) -> Row:
    """Solve the contact problem up to its full load; return the row without times."""
    made = problems.elasticity_problem(body, setting.degree)
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
    row: Row = {"dofs": problems.n_dofs(made[0].function_space)}
    steps: list[fc.Step] = []
    try:
        problem, contact, u, load = problems.problem(
            body,
            setting.degree,
            law,
            elasticity=made,
            contact_options=choices,
            surface_options=rule,
            method=None if setting.solver == "default" else setting.solver,
            petsc_options=options,
        )
        wanted = None if setting.accuracy and body.is_path_dependent else setting.increments
        start = time.perf_counter()
        for step in fc.increments(problem, load, 0.0, body.final_load, steps=wanted, max_cuts=2):
            steps.append(step)
            if limit and step.load != body.final_load and time.perf_counter() - start > limit:
                raise TimeoutError(
                    f"time limit of {limit:g} s, at {step.load / body.final_load:.0%}"
                )
    except (fc.NotConverged, TimeoutError, ValueError, MemoryError, PETSc.Error) as error:
        words = " ".join(str(error).split())
        return row | {"failure": f"{type(error).__name__}: {words[:150]}", "steps": len(steps)}
    resultants = contact.resultants()
    return row | {
        "steps": len(steps),
        "iterations": sum(step.iterations for step in steps),
        "augmentations": sum(step.augmentations for step in steps),
        "method": " ".join(sorted({step.method for step in steps})),
        "normal force": resultants.normal_force,
        "friction force": resultants.tangential_force,
        "peak pressure": resultants.max_pressure,
        "displacement": float(body.displacement(u)),
    }


def errors(row: Row, reference: Row) -> Row:
    """Return the relative errors of a row that has results, and the largest of them."""
    found = {
        f"{name} error": abs(float(row[name]) / float(reference[name]) - 1)
        for name in QUANTITIES
        if row.get(name) not in (None, "") and float(reference.get(name) or 0.0)
    }
    return found | ({"error": max(found.values())} if found else {})


def time_setting(one: Scene, setting: Setting, repeat: int, limit: float = TIME_LIMIT) -> Row:
    """Time a setting and the linear problem in turn, several times if fast; return the minima."""
    body = one.make(setting.h)
    runs = {
        "linear": lambda: costs.linear_solve(body, setting.degree),
        "contact": lambda: solve(body, setting, limit),
    }
    found = []
    for _ in range(repeat):
        found.append(timing.measure(runs, repeat=1))
        row = found[-1][1]
        if row["seconds"] > MAX_REPEATED_TIME or "failure" in row:
            break
    linear, contact = (np.array([rows[i]["seconds"] for rows in found]) for i in range(2))
    return row | {
        "seconds": float(contact.min()),
        "linear solve [s]": float(linear.min()),
    }


# ---- stored rows ---------------------------------------------------------------------------------


class Store:
    """Rows in a CSV file, each written when computed; an incomplete last line is removed."""

    def __init__(self, path: Path) -> None:
        """Read the stored rows.

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
        self.rows = report.read(path)
        if self.rows and tuple(self.rows[0]) != COLUMNS:
            raise ValueError(f"{path} has columns of another study; use --fresh")

    def find(self, role: str, setting: Setting) -> dict[str, str] | None:
        """Return the row of a setting, or None."""
        wanted = {"role": role} | {name: str(v) for name, v in asdict(setting).items()}
        return next((r for r in self.rows if all(r[k] == v for k, v in wanted.items())), None)

    def add(self, role: str, setting: Setting, row: Row) -> dict[str, str]:
        """Append a row, and flush it to disk."""
        full = {"role": role} | asdict(setting) | row
        with open(self.path, "a", newline="") as file:
            csv.DictWriter(file, COLUMNS, extrasaction="ignore", lineterminator="\n").writerow(full)
            file.flush()
            os.fsync(file.fileno())
        self.rows.append({name: str(full.get(name, "")) for name in COLUMNS})
        return self.rows[-1]


def add_relative_times(rows: Sequence[Row]) -> list[Row]:
    """Add times in units of the fastest linear solve of the same mesh."""
    units: dict[tuple[str, ...], float] = {}
    for row in rows:
        key = row["scene"], row["h"], row["degree"]
        units[key] = min(units.get(key, np.inf), float(row["linear solve [s]"]))
    return [
        row | {"time": str(float(row["seconds"]) / units[row["scene"], row["h"], row["degree"]])}
        for row in rows
    ]


def write(path: Path, rows: Sequence[Row]) -> None:
    """Write all rows to a new file."""
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def study(scenes: dict[str, Scene], store: Store, repeat: int, short: bool) -> None:
    """Compute the rows of the study that are not stored yet."""
    settings = [(one, setting) for one in scenes.values() for setting in sweep(one, short)]
    warm: set[tuple[Any, ...]] = set()
    quiet = None if MPI.COMM_WORLD.rank == 0 else True
    with tqdm(total=len(settings), disable=quiet, unit="run") as bar:
        for one, setting in settings:
            bar.set_description(one.name)
            if store.find("sweep", setting) is None:
                reference = find_reference(one, store)
                # Compile the forms on the coarsest mesh, before timing.
                forms = (one.name, *(getattr(setting, name) for name in COMPILED))
                if forms not in warm:
                    body = one.make(one.sizes[0])
                    costs.linear_solve(body, setting.degree)
                    solve(body, replace(setting, increments=min(2, setting.increments)))
                    warm.add(forms)
                row = time_setting(one, setting, repeat)
                store.add("sweep", setting, row | errors(row, reference))
            bar.update()


def find_reference(one: Scene, store: Store) -> Row:
    """Return exact values, or those of the reference solution, computed at first use."""
    if one.reference is None:
        return dict(one.published)
    row: Row | None = store.find("reference", one.reference)
    if row is None:
        row = time_setting(one, one.reference, 1, limit=0.0)
        if row.get("failure"):
            raise RuntimeError(f"the reference of {one.name} failed: {row['failure']}")
        row = store.add("reference", one.reference, row | errors(row, one.published))
    return row


def main() -> None:
    """Compute missing rows; write the page and its figures."""
    parser = timing.parser(__doc__, "trade")
    parser.add_argument("--page", action="store_true", help="only write the page of stored rows")
    parser.add_argument("--fresh", action="store_true", help="discard the rows of earlier runs")
    arguments = parser.parse_args()
    if MPI.COMM_WORLD.size > 1:
        parser.error("runs on one rank")
    scenes = short_scenes() if arguments.short else all_scenes()
    target = (arguments.output if arguments.short else DOCS) / "trade.md"
    if arguments.page:
        rows = report.read(target.with_suffix(".csv"))
    else:
        path = arguments.output / ("short.csv" if arguments.short else "rows.csv")
        if arguments.fresh:
            path.unlink(missing_ok=True)
        store = Store(path)
        study(scenes, store, arguments.repeat, arguments.short)
        rows = add_relative_times(store.rows)
        write(target.with_suffix(".csv"), rows)
    draw(target, scenes, rows)
    advice = "" if arguments.short else (HERE / "trade_advice.md").read_text()
    target.write_text(page(scenes, rows, target.stem, advice))
    print(target)


if __name__ == "__main__":
    np.seterr(all="ignore")
    main()
