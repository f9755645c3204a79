"""Shallow ironing, converged: `demos/shallow_ironing.py` with one parameter varied at a time.

python verification/shallow_ironing.py            # computes missing runs, writes the page
python verification/shallow_ironing.py --jobs 2
python verification/shallow_ironing.py --page     # page and figures of the stored runs

Each run is a separate process. Rows and curves are stored at its end in
``verification/shallow_ironing.csv`` and ``shallow_ironing_curves.csv``; an interrupted study
continues with the missing runs. The script writes docs/shallow_ironing.md and its figures.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, fields, replace
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from demos.shallow_ironing import Setting, solve
from scenes.processes import ROOT, command, subprocess_environment
from verification import report
from verification import shallow_ironing_page as page

STUDY = ROOT / "verification" / "shallow_ironing.csv"
CURVES = STUDY.with_name("shallow_ironing_curves.csv")
PAGE = ROOT / "docs" / "shallow_ironing.md"
TIMEOUT = 7200.0  # s, of one run
# Interval in which V and H, which oscillate as facets pass the die, are fitted by a parabola.
WINDOW = (1.4, 1.6)
QUANTITIES = ("V(1)", "V(1.5)", "H(1.5)")
RESULTS = (
    *QUANTITIES,
    *("fitted V(1.5)", "fitted H(1.5)", "ripple of V", "ripple of H"),
    *("dofs", "increments done", "iterations", "most iterations", "processor seconds", "failure"),
)
COLUMNS = ("name", *(field.name for field in fields(Setting)), *RESULTS)
BASE = Setting(until=2.0)


def setting_on_mesh(size: float, increments: int, until: float = 1.6) -> Setting:
    """Return the base run on another mesh: equal stiffness, increments of a fifth of a facet."""
    stiffness = BASE.stiffness * size / BASE.size
    return replace(BASE, size=size, increments=increments, until=until, stiffness=stiffness)


def settings() -> dict[str, Setting]:
    """Return all runs by name, in order.

    Some variants are on the mesh of the base run, most others on a mesh coarser by a factor of √2.
    """
    short, coarse = replace(BASE, until=1.6), setting_on_mesh(0.283, 180)
    runs = {
        "base": BASE,
        "isochoric": replace(short, isochoric=True),
        "height 3": replace(short, height=3.0),
        "isochoric, height 3": replace(short, isochoric=True, height=3.0),
        "size 0.4": setting_on_mesh(0.4, 126),
        "size 0.283": coarse,
        "size 0.141": setting_on_mesh(0.141, 360),
        "size 0.1": setting_on_mesh(0.1, 500),
    }
    varied = {
        "augmented": replace(coarse, enforcement="augmented"),
        "a third of the stiffness": replace(coarse, stiffness=coarse.stiffness / 3),
        "Γc of slab": replace(coarse, side="slab"),
        "cells of the die twice as large": replace(coarse, finer=2 * coarse.finer),
        "cells of the die half as large": replace(coarse, finer=coarse.finer / 2),
        "80 increments of pressing": replace(coarse, pressing=80, until=1.0),
        "quadrature of degree 16": replace(coarse, quadrature=16),
        "360 increments of sliding": replace(coarse, increments=360),
        "height 5": replace(coarse, height=5.0),
        "friction 0.4": replace(coarse, friction=0.4),
        "die 100 times stiffer": replace(coarse, die=100 * BASE.die),
    }
    runs |= {f"{name}, size 0.283": setting for name, setting in varied.items()}
    degrees = {
        "degree 1, size 0.141": (1, setting_on_mesh(0.141, 360)),
        "degree 3, size 0.283": (3, coarse),
    }
    return runs | {name: replace(made, degree=degree) for name, (degree, made) in degrees.items()}


# ---- one run -------------------------------------------------------------------------------------


def evaluate(path: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return V and H at 1 and 1.5, their fits at 1.5, and the oscillation about the fit."""
    t = np.array([row["time"] for row in path])
    found = {}
    inside = (t > WINDOW[0] - 1e-9) & (t < WINDOW[1] + 1e-9)
    for name in "VH":
        values = np.array([row[name] for row in path])
        for at in (1.0, 1.5):
            here = np.abs(t - at) < 1e-9
            if here.any() and f"{name}({at:g})" in QUANTITIES:
                found[f"{name}({at:g})"] = float(values[here][0])
        if t[-1] > WINDOW[1] - 0.01:
            fit = np.polynomial.Polynomial.fit(t[inside], values[inside], 2)
            found[f"fitted {name}(1.5)"] = float(fit(1.5))
            found[f"ripple of {name}"] = float(np.abs(values[inside] - fit(t[inside])).max())
    return found


def run(setting: Setting) -> tuple[dict[str, Any], list[tuple[float, float, float]]]:
    """Solve one run; return the results of its row, and t, V, H of all increments."""
    start = time.process_time()
    path, _, _, dofs = solve(setting)
    iterations = [int(row["iterations"]) for row in path]
    row = evaluate(path) | {
        "dofs": dofs,
        "increments done": len(path),
        "iterations": sum(iterations),
        "most iterations": max(iterations),
        "processor seconds": round(time.process_time() - start, 1),
    }
    return row, [(row["time"], row["V"], row["H"]) for row in path]


def start_process(name: str) -> tuple[dict[str, Any], list[tuple[float, float, float]]]:
    """Run in a separate process; return a row with the failure if it does not end normally."""
    words = command(1, Path(__file__), "--one", name)
    try:
        done = subprocess.run(
            words, env=subprocess_environment(), capture_output=True, text=True, timeout=TIMEOUT
        )
        if done.returncode == 0:
            row, curve = json.loads(done.stdout.strip().splitlines()[-1])
            return row, curve
        failure = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
    except subprocess.TimeoutExpired:
        failure = f"time limit of {TIMEOUT:g} s"
    return {"failure": failure[:200]}, []


# ---- stored rows ---------------------------------------------------------------------------------


def append(path: Path, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Append rows to a file and flush it to disk; a new file gets a header."""
    new = not path.exists()
    with open(path, "a", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows([columns, *rows] if new else rows)
        file.flush()
        os.fsync(file.fileno())


def read_rows(path: Path) -> list[dict[str, str]]:
    """Return the rows of a file, or no rows if it does not exist."""
    return report.read(path) if path.exists() else []


def results() -> dict[str, dict[str, float]]:
    """Return the results by name of the run and of the quantity, without failed runs."""
    return {
        row["name"]: {name: float(row[name]) for name in RESULTS[:-1] if row[name]}
        for row in read_rows(STUDY)
        if not row["failure"]
    }


def curves() -> dict[str, np.ndarray]:
    """Return t, V and H of all increments, shape (n, 3), by name of the run."""
    found: dict[str, list[list[float]]] = {}
    for row in read_rows(CURVES):
        found.setdefault(row["name"], []).append([float(row[name]) for name in ("t", "V", "H")])
    return {name: np.array(points) for name, points in found.items()}


def study(names: Sequence[str], jobs: int) -> None:
    """Compute and store the missing runs among ``names``, ``jobs`` at a time."""
    done = {row["name"] for row in read_rows(STUDY)}
    lock = Lock()

    def make(name: str) -> None:
        row, curve = start_process(name)
        full = {"name": name} | asdict(settings()[name]) | row
        with lock:
            if curve:
                rows = [(name, *(f"{value:.7g}" for value in point)) for point in curve]
                append(CURVES, ("name", "t", "V", "H"), rows)
            append(STUDY, COLUMNS, [[full.get(column, "") for column in COLUMNS]])
        print(name, row, flush=True)

    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(make, [name for name in names if name not in done]))


def main() -> None:
    """Compute missing runs; write the page and its figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="runs to compute")
    parser.add_argument("--one", metavar="NAME", help="compute this run and print it as JSON")
    parser.add_argument("--page", action="store_true", help="only write page and figures")
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(run(settings()[arguments.one])))
        return
    if not arguments.page:
        study(arguments.only or list(settings()), arguments.jobs)
    rows = results()
    PAGE.write_text(page.page(rows))
    page.draw(PAGE.with_name("shallow-ironing.png"), rows, curves())
    page.draw_changes(PAGE.with_name("shallow-ironing-changes.png"), rows)


if __name__ == "__main__":
    sys.exit(main())
