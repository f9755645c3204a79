"""Solve the verification cases, and write docs/verification.csv, its page and its figure.

python verification/run.py
python verification/run.py --only punch wavy --output /tmp/page.md
python verification/run.py --page

``--only`` replaces the rows of some cases; ``--page`` writes the page of the stored rows. The exit
code is 1 if a quantity misses its reference or a case fails.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import dolfinx
import numpy as np
from petsc4py import PETSc

import fenics_contact as fc
from fenics_contact import plotting
from scenes.processes import ROOT
from verification import axisymmetric, half_planes, report, solids, statics
from verification.cases import Case, Outcome, cases_of
from verification.demonstrations import DEMOS

CASES = cases_of(statics, half_planes, axisymmetric, solids)
PAGE = ROOT / "docs" / "verification.md"
FAILED = "FAILED"
# Errors below this, of statics and exact solutions, are drawn at this value.
SMALLEST_DRAWN_ERROR = 1e-16
Row = dict[str, str]


def rows_of(case: Case, outcome: Outcome | str) -> list[Row]:
    """Return the rows of a case; ``outcome`` is the error message if the case has failed."""
    petsc = ".".join(map(str, PETSc.Sys.getVersion()))
    versions = f"fenics_contact {fc.__version__}, DOLFINx {dolfinx.__version__}, PETSc {petsc}"
    common = {"basis": case.reason, "versions": versions}
    if isinstance(outcome, str):
        return [{"case": case.name, "quantity": FAILED, "source": outcome} | common]
    numbers = {"dofs": str(outcome.dofs), "seconds": f"{outcome.seconds:.1f}"}
    return [
        {
            "case": case.name,
            "quantity": row.quantity,
            "reference": repr(float(row.reference)),
            "source": row.source,
            "tolerance": repr(float(row.tolerance)),
            "obtained": repr(float(row.obtained)),
            "error": repr(float(row.error)),
            "mesh": outcome.mesh,
        }
        | numbers
        | common
        for row in outcome.rows
    ]


def is_met(row: Row) -> bool:
    """Whether the error is within the tolerance; False for NaN and for a failed case."""
    return row["quantity"] != FAILED and float(row["error"]) <= float(row["tolerance"])


def page(rows: list[Row]) -> str:
    """Return the page in Markdown."""
    values = [row for row in rows if row["quantity"] != FAILED]
    cases = list(dict.fromkeys(row["case"] for row in rows))
    seconds = {row["case"]: float(row["seconds"]) for row in values}
    lines = ["# Verification", ""]
    lines += report.text(
        f"**{sum(map(is_met, values))} of {len(values)} quantities in {len(cases)} cases meet "
        f"their references**, in {sum(seconds.values()):.0f} s on one process "
        f"({rows[0]['versions']})."
    )
    if failed := [row["case"] for row in rows if row["quantity"] == FAILED]:
        lines += report.text(f"**Failed cases: {'; '.join(failed)}.**")
    if missed := [f"{r['case']}: {r['quantity']}" for r in values if not is_met(r)]:
        lines += report.text(f"**Missed: {'; '.join(missed)}.**")
    lines += report.text(
        "References are closed forms, published benchmarks, other programs, and statics. *Exact "
        "complementarity* marks an independent solution without penalty on converged meshes. "
        "Errors and tolerances are relative to the reference, absolute where it is zero. All "
        "values, tolerances with their reasons, meshes and times are in "
        "[verification.csv](verification.csv).",
    )
    lines += ["![Errors and tolerances of all quantities, by case](verification.png)", ""]
    lines += report.text(
        "*Left: errors; those below 1e-16 are drawn at 1e-16. Right: errors relative to the "
        "tolerance of each quantity.*"
    )
    body = []
    for case in cases:
        mine = [row for row in rows if row["case"] == case]
        sources = "; ".join(dict.fromkeys(row["source"] for row in mine))
        if mine[0]["quantity"] == FAILED:
            body.append((case, sources, FAILED, "", "", "", ""))
            continue
        worst = max(mine, key=_over_tolerance)
        body.append(
            (
                case if all(map(is_met, mine)) else f"**{case}: missed**",
                sources,
                len(mine),
                worst["quantity"],
                f"{float(worst['error']):.1e}",
                f"{float(worst['tolerance']):.2g}",
                mine[0]["dofs"] if mine[0]["dofs"] != "0" else "",
            )
        )
    lines += ["The quantity with the largest error relative to its tolerance, of every case:", ""]
    head = ("case", "references", "quantities", "worst quantity", "error", "tolerance", "dofs")
    lines += report.table(head, body)
    lines += report.text(
        "Written by `python verification/run.py`; `--page` writes the page and its figure from "
        "the stored values."
    )
    return "\n".join(lines).rstrip() + "\n"


def _over_tolerance(row: Row) -> float:
    error, tolerance = float(row["error"]), float(row["tolerance"])
    return error / tolerance if tolerance else float(error > 0)


def draw(path: Path, rows: list[Row]) -> None:
    """Draw the errors, and the errors relative to their tolerances, one line per case."""
    values = [row for row in rows if row["quantity"] != FAILED]
    cases = list(dict.fromkeys(row["case"] for row in values))
    at = [cases.index(row["case"]) for row in values]
    errors = np.array([float(row["error"]) for row in values])
    ratios = np.array([_over_tolerance(row) for row in values])
    size = (6.5, 0.26 * len(cases) + 1.0)
    with plotting.figure(path, 2, size=size) as (left, right):
        left.semilogx(np.maximum(errors, SMALLEST_DRAWN_ERROR), at, "o", markersize=4, alpha=0.6)
        left.set_yticks(range(len(cases)), cases, fontsize=7)
        left.set_xlabel("error relative to the reference")
        right.semilogx(np.maximum(ratios, 1e-10), at, "o", markersize=4, alpha=0.6)
        right.axvline(1.0, color="k")
        right.set_yticks(range(len(cases)), [])
        right.set(xlabel="error / tolerance (line: 1)", xlim=(5e-11, 5))
        for axes in (left, right):
            axes.set_ylim(len(cases) - 0.4, -0.6)
            axes.grid(alpha=0.25)


def main() -> int:
    """Solve the cases and write the results; return 0 if all references are met."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="+", metavar="WORD", help="cases with one of these words")
    parser.add_argument(
        "--output", type=Path, help="page to write; the CSV file is written to the same directory"
    )
    parser.add_argument("--page", action="store_true", help="only write the page of stored values")
    arguments = parser.parse_args()
    path = arguments.output or PAGE
    data = path.with_suffix(".csv")
    words = [word.lower() for word in arguments.only or [""]]
    chosen = [c for c in DEMOS + CASES if any(word in c.name.lower() for word in words)]
    if not chosen:
        parser.error(f"no case has one of the words {words}")
    stored = report.read(data) if data.exists() and (arguments.page or arguments.only) else []
    rows: list[Row] = []
    for case in DEMOS + CASES:
        if arguments.page or case not in chosen:
            rows += [row for row in stored if row["case"] == case.name]
            continue
        try:
            outcome: Outcome | str = case.run()
        except Exception as error:
            outcome = f"{type(error).__name__}: {error}"
        new = rows_of(case, outcome)
        rows += new
        for row in new:
            print("met" if is_met(row) else "MISSED", *row.values(), sep="; ", flush=True)
    report.save(data, rows)
    path.write_text(page(rows))
    draw(path.with_suffix(".png"), rows)
    return int(not all(map(is_met, rows)))


if __name__ == "__main__":
    sys.exit(main())
