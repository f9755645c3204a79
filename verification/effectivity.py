"""How good the error estimates are: estimated over true errors, and docs/effectivity.md.

    python verification/effectivity.py
    python verification/effectivity.py --output /tmp/page.md

Part by part on the half-cylinder, where one cause of error at a time can be taken away; and as a
whole on all cases of the verification, coarser ones of the same among them, that have exact or
converged values for quantities of the budget. The exit code is 1 if the median of the effectivities
is outside of 0.3 to 3.
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fenics_contact as fc
from demos import hertz
from fenics_contact.estimates.errors import quantities
from scenes import problems
from scenes.elasticity import stress
from scenes.processes import ROOT
from verification import half_planes
from verification.cases import Case, Outcome
from verification.demonstrations import DEMOS, run, runs
from verification.run import CASES

PAGE = ROOT / "docs" / "effectivity.md"
USEFUL = (0.3, 3.0)
# A part's true errors smaller than this, relative, are no better known than the better solution is.
KNOWN = 1e-6


@dataclass(frozen=True)
class Row:
    """An estimate beside the error it is of, both relative to the quantity.

    A true error below ``known`` is no better known than its reference is.
    """

    scene: str
    part: str
    quantity: str
    estimated: float
    true: float
    known: float = 0.0

    @property
    def effectivity(self) -> float | None:
        """Estimated over true error, without signs; None where the true one is not known."""
        return abs(self.estimated / self.true) if abs(self.true) > self.known else None


def half_cylinder(
    *,
    h: float = 0.21,
    degree: int = 2,
    friction: float = 0.0,
    factor: float = 10.0,
    steps: int = 1,
    rtol: float = 1e-9,
) -> tuple[dict[str, float], fc.ErrorBudget]:
    """Quantities and error budget; stiffness ``factor`` E/h with h = 0.21 whatever the mesh."""
    body = problems.half_cylinder(friction, h)
    k = factor * body.E / 0.21
    law = fc.Coulomb(friction, k, k) if friction else fc.Frictionless(k)
    problem, _, u, load = problems.problem(
        body, degree, law, method="lbfgs", petsc_options={"snes_rtol": rtol}
    )
    *_, last = fc.increments(problem, load, 0.0, body.end, steps=steps, estimate=True)
    budget = fc.estimate_errors(
        problem, stress(u, body.E, body.nu), increment_error=last.increment_error
    )
    return quantities(problem), budget


def part(
    name: str, scene: str, rough: tuple[Any, fc.ErrorBudget], better: dict[str, float]
) -> Iterator[Row]:
    """One part of a budget against a solution without this error, for quantities that have it."""
    values, budget = rough
    for quantity, value in values.items():
        true = (value - better[quantity]) / value
        if abs(true) > KNOWN:
            yield Row(scene, name, quantity, budget.parts[name][quantity] / value, true)


def parts() -> Iterator[Row]:
    """One cause of error after the other, all else equal."""
    for friction in (0.0, 0.2):
        steps = 2 if friction else 1
        scene = f"μ = {friction:g}"
        for degree in (1, 2):
            given: dict[str, Any] = {"friction": friction, "degree": degree, "steps": steps}
            hard, _ = half_cylinder(factor=300, **given)
            for factor in (1, 3, 10):
                title = f"{scene}, degree {degree}, k h/E = {factor}"
                yield from part("enforcement", title, half_cylinder(factor=factor, **given), hard)
            fine, _ = half_cylinder(h=0.05, friction=friction, steps=steps)
            for h in (0.84, 0.42, 0.21):
                title = f"{scene}, degree {degree}, h = {h}"
                yield from part("discretisation", title, half_cylinder(h=h, **given), fine)
        exact, _ = half_cylinder(friction=friction, steps=steps)
        for rtol in (1e-2, 1e-3, 1e-4):
            rough = half_cylinder(friction=friction, steps=steps, rtol=rtol)
            yield from part("solver", f"{scene}, snes_rtol {rtol:g}", rough, exact)
    many, _ = half_cylinder(friction=0.2, steps=80)
    for steps in (1, 2, 4, 8):
        rough = half_cylinder(friction=0.2, steps=steps)
        rows = part("increments", f"μ = 0.2, {2 * steps} increments", rough, many)
        yield from (row for row in rows if row.quantity == "friction force")


# Peak of the half-cylinder with μ = 0.2: quadratic cells of 0.05 and 0.025 give 151.82 and 151.86
# in 80 increments, 151.87 in 160. The independent solution's 150.8 is known to 1 % only.
PEAK = 151.87
# Demo, options, exact or converged values, of the demo's own references by name or numbers, and how
# well they are known.
Truths = dict[str, str | float]
WHOLES: list[tuple[str, tuple[str, ...], Truths, float]] = [
    *(
        ("hertz", ("--friction", f, "--h", h, "--degree", p, "--increments", n), truth, 1e-3)
        for f, n, truth in (
            ("0", "1", {"peak pressure": 142.6}),
            ("0.2", "2", {"peak pressure": PEAK, "friction force": 34.17}),
            ("0.2", "10", {"peak pressure": PEAK, "friction force": 34.17}),
        )
        for h, p in (
            ("0.84", "2"),
            ("0.42", "1"),
            ("0.42", "2"),
            ("0.21", "1"),
            ("0.21", "2"),
            ("0.05", "2"),
        )
    ),
    *(
        ("hertz", ("--load", "1", "--friction", "0", "--h", h, "--degree", "2"), truth, 2.3e-3)
        for h in ("0.1", "0.04", "0.01")
        for truth in ({"peak pressure": hertz.hertz(1.0)[1]},)
    ),
    *(
        ("greco_block", ("--cells", n, "--degree", p), {"friction force": 1405.36}, 1e-4)
        for n, p in (("10", "1"), ("20", "1"), ("10", "2"), ("40", "2"))
    ),
    *(
        (
            "shrink_fit",
            ("--h", h, "--degree", p, "--stiffness", k),
            {"peak pressure": "pressure"},
            1e-6,
        )
        for h, p, k in (("2", "2", "100"), ("2", "2", "10"), ("1", "2", "10"))
    ),
    *(
        (
            "sphere",
            ("--depth", "4e-4", "--cells", n, "--stiffness", k),  # a/R = 0.02
            {"peak pressure": "peak", "normal force": "force"},
            1e-3,
        )
        for n, k in (("3", "3"), ("3", "10"), ("5", "3"), ("5", "10"), ("8", "10"))
    ),
    *(
        (
            "two_cylinders",
            ("--cells", n, "--stiffness", k),
            {"peak pressure": "largest pressure"},
            7.2e-3,
        )
        for n, k in (("5", "0.3"), ("5", "1"), ("5", "3"), ("10", "1"), ("40", "10"))
    ),
    *(
        (
            "ironing",
            ("--cells", n, "--stiffness", k, "--increments", "20"),
            {"peak pressure": "peak"},
            1e-3,
        )
        for n, k in (("3", "10"), ("4", "3"), ("4", "10"), ("4", "40"))
    ),
]


def of_demos() -> Iterator[Row]:
    """All parts together against exact or converged values."""
    for name, options, truths, known in WHOLES:
        for one in runs(run(name, *options, "--errors")):
            budget = fc.ErrorBudget(**one["errors"])
            references = one["references"]
            label = " ".join([name, one.get("kind") or one.get("case") or "", *options])
            for quantity, given in truths.items():
                value = budget.values[quantity]
                whole = quantity == "normal force" and name == "sphere"
                if whole and one["case"] != "block":
                    continue  # Hertz's relation of depth and force is that of the block
                if isinstance(given, str):
                    given = next(e["reference"] for n, e in references.items() if given in n)
                if whole:
                    given = given / 4  # a quarter is modelled
                true = (value - given) / value
                # The references are of small displacements, too.
                parts = {n: p for n, p in budget.parts.items() if n != "kinematics"}
                total = dataclasses.replace(budget, parts=parts).total[quantity]
                yield Row(label, "all", quantity, total, true, known)


def of_cases() -> Iterator[Row]:
    """The same of the cases without a demo; those of two curves coarser and softer, too."""

    def rows(title: str, made: Outcome) -> Iterator[Row]:
        for e in made.estimates() if made.estimates else ():
            yield Row(title, "all", e.quantity, e.estimated, e.true, e.known)

    for case in CASES:
        if not case.budget:
            yield from rows(case.name, case.run())
    for n in (32, 64):
        yield from rows(f"Wavy surface, {n} cells", half_planes.wavy(n))
    for h, k in ((1.0, 1.0), (2.0, 1.0), (2.0, 3.0)):
        yield from rows(f"Cylinder on block, h = {h:g}, k h/E = {k:g}", half_planes.cylinder(h, k))


def table(rows: list[Row]) -> list[str]:
    """Rows in Markdown."""
    lines = ["| scene | quantity | estimated | true | effectivity |", "|---|---|---|---|---|"]
    for row in rows:
        shown = "not known"
        if row.effectivity is not None:
            useful = USEFUL[0] <= row.effectivity <= USEFUL[1]
            shown = f"{row.effectivity:.2f}" if useful else f"**{row.effectivity:.2g}**"
        cells = [row.scene, row.quantity, f"{row.estimated:.2%}", f"{row.true:.2%}", shown]
        lines.append(f"| {' | '.join(cells)} |")
    return [*lines, ""]


def page(rows: list[Row]) -> str:
    """The page, medians first."""
    names = list(dict.fromkeys(row.part for row in rows))
    lines = [
        "# Effectivity of the error estimates",
        "",
        "Written by `python verification/effectivity.py`. Effectivity is estimated over true "
        f"error; values outside of {USEFUL[0]:g} to {USEFUL[1]:g} are bold. Errors are relative to "
        "the quantity. A part is compared with a solution in which its cause is next to absent and "
        "all else equal; all parts together (the root of the sum of their squares) with the exact "
        "or converged values of the verification. Where parts cancel in truth, that is too large. "
        "*Not known* are effectivities where the true error is below what the reference is known "
        "to: 0.1 % for converged values, (a/R)² for Hertz's; they are not counted. With friction "
        f"the half-cylinder's peak is that of finer meshes, {PEAK:g}.",
        "",
        "| part | estimates | median | useful |",
        "|---|---|---|---|",
    ]
    for name in names:
        found = effectivities(rows, name)
        useful = sum(USEFUL[0] <= e <= USEFUL[1] for e in found)
        lines.append(
            f"| {name} | {len(found)} | {statistics.median(found):.2f} | {useful} of {len(found)} |"
        )
    lines.append("")
    for name in names:
        title = "All parts together" if name == "all" else name.capitalize()
        lines += [f"## {title}", "", *table([row for row in rows if row.part == name])]
    lines += ["## Cases of the verification without estimates", ""]
    lines += ["| case | why |", "|---|---|"]
    lines += [f"| {case.name} | {case.budget} |" for case in without()]
    return "\n".join(lines) + "\n"


def effectivities(rows: list[Row], name: str) -> list[float]:
    """Those of a part that are known."""
    return [row.effectivity for row in rows if row.part == name and row.effectivity is not None]


def without() -> list[Case]:
    """Cases that have nothing to compare estimates with."""
    return [case for case in DEMOS + CASES if case.budget]


def main() -> int:
    """Compute and write; 0 if every median is useful."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--output", type=Path, default=PAGE, help="page to write")
    arguments = parser.parse_args()
    rows = []
    for source in (parts, of_demos, of_cases):
        for row in source():
            rows.append(row)
            print(f"{row.part}: {row.scene}, {row.quantity}: {row.effectivity}", flush=True)
    arguments.output.write_text(page(rows))
    medians = [statistics.median(effectivities(rows, name)) for name in {row.part for row in rows}]
    return int(not all(USEFUL[0] <= median <= USEFUL[1] for median in medians))


if __name__ == "__main__":
    sys.exit(main())
