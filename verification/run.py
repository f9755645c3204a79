"""Compute the cases of the verification and write their page."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import dolfinx
from petsc4py import PETSc

import fenics_contact as fc
from scenes.processes import ROOT
from verification import axisymmetric, half_planes, solids, statics
from verification.cases import Case, Outcome, cases_of
from verification.demonstrations import DEMOS

CASES = cases_of(statics, half_planes, axisymmetric, solids)
PAGE = ROOT / "docs" / "verification.md"


def number(value: float) -> str:
    """A number short enough for a table."""
    return f"{value:.6g}"


def section(case: Case, made: Outcome | str) -> list[str]:
    """The lines of one case; a text is the error it failed with."""
    lines = [f"## {case.name}", ""]
    if isinstance(made, str):
        return [*lines, f"**FAILED:** {made}", ""]
    size = f"{made.dofs} dofs, " if made.dofs else ""
    lines += [f"{made.mesh}; {size}{made.seconds:.1f} s. Tolerance: {case.reason}.", ""]
    lines += [
        "| quantity | reference | source | tolerance | obtained | error | |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in made.rows:
        cells = [
            row.quantity.replace("|", "\\|"),
            number(row.reference),
            row.source.replace("|", "\\|"),
            f"{row.tolerance:.2g}",
            number(row.obtained),
            f"{row.error:.1e}",
            "met" if row.passed else "**MISSED**",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return [*lines, ""]


def page(results: list[tuple[Case, Outcome | str]]) -> str:
    """The whole page."""
    rows = [row for _, made in results if isinstance(made, Outcome) for row in made.rows]
    met = sum(row.passed for row in rows)
    failed = [case.name for case, made in results if isinstance(made, str)]
    seconds = sum(made.seconds for _, made in results if isinstance(made, Outcome))
    versions = f"DOLFINx {dolfinx.__version__}, PETSc {'.'.join(map(str, PETSc.Sys.getVersion()))}"
    lines = [
        "# Verification",
        "",
        "Written by `python verification/run.py`. Tolerances and errors are relative to the "
        "reference, and absolute where that is 0. *Exact complementarity* marks values of an "
        "independent computation without penalty, on converged meshes.",
        "",
        f"**{met} of {len(rows)} quantities in {len(results)} cases meet their references**, in "
        f"{seconds:.0f} s on one process (fenics_contact {fc.__version__}, {versions}).",
    ]
    if failed:
        lines += ["", f"**Cases that failed: {', '.join(failed)}.**"]
    missed = [
        f"{case.name}: {row.quantity}"
        for case, made in results
        if isinstance(made, Outcome)
        for row in made.rows
        if not row.passed
    ]
    if missed:
        lines += ["", f"**Missed: {'; '.join(missed)}.**"]
    lines.append("")
    for case, made in results:
        lines += section(case, made)
    return "\n".join(lines)


def main() -> int:
    """Run the cases; 0 if all references are met."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--only", nargs="+", metavar="WORD", help="cases with one of these words")
    parser.add_argument("--output", type=Path, help=f"page to write (default: {PAGE.name} of docs)")
    arguments = parser.parse_args()
    words = [word.lower() for word in arguments.only or [""]]
    chosen = [c for c in DEMOS + CASES if any(word in c.name.lower() for word in words)]
    if not chosen:
        parser.error(f"no case has one of the words {words}")
    if arguments.only and not arguments.output:
        parser.error("a page of some cases alone wants another --output")
    results: list[tuple[Case, Outcome | str]] = []
    for case in chosen:
        try:
            made: Outcome | str = case.run()
        except Exception as error:
            made = f"{type(error).__name__}: {error}"
        results.append((case, made))
        print("\n".join(section(case, made)), flush=True)
    (arguments.output or PAGE).write_text(page(results).rstrip() + "\n")
    good = all(isinstance(made, Outcome) and made.passed for _, made in results)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
