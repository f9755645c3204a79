"""The quadrature of Γc: accuracy and oscillation of the pressure by its degree and scheme.

Half-cylinder of ``demos/hertz.py`` without friction, cells of linear and quadratic displacements;
Gauss points, 1 to p + 2 on an edge (degree 1 to 2p + 3; the default, 2p, is p + 1 points), and the
vertices; enforced by the penalty at 10 and at 1000 E/h, and by multipliers. The reference is the
solution by multipliers of quadratic cells a quarter of the smallest size here. Two measures of the
pressure: its error in the mean square, and its largest error in the middle of the contact
(x < 0.85 a), where it is smooth: an oscillation.

    OMP_NUM_THREADS=1 python benchmarks/quadrature.py

Writes tables, CSV files, and plots of the pressure's error against h.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

import fenics_contact as fc
from benchmarks import timing
from scenes import problems

ENFORCEMENTS: dict[str, tuple[float, str]] = {
    "penalty 10": (10.0, "penalty"),
    "penalty 1000": (1000.0, "penalty"),
    "augmented 10": (10.0, "augmented"),
}
MIDDLE = 0.85 * 2.127  # a of the independent solution


def solve(
    h: float, degree: int, stiffness: float, enforcement: str, **rule: Any
) -> tuple[fc.Contact, fc.Step]:
    """The half-cylinder under its whole load."""
    body = problems.half_cylinder(0.0, h)
    choices = {"enforcement": enforcement}
    problem, contact, _, load = problems.problem(
        body, degree, stiffness, choices=choices, rule=rule
    )
    load.value = body.end
    return contact, problem.solve()


def rules(degree: int) -> dict[str, dict[str, Any]]:
    """Rules by name; two degrees in a row have the same points on an edge."""
    gauss = {f"Gauss {n}": {"quadrature_degree": 2 * n - 1} for n in range(1, degree + 3)}
    return gauss | ({"vertex": {"quadrature_scheme": "vertex"}} if degree == 1 else {})


def study(degree: int, sizes: list[float], folder: Path) -> None:
    """One table and one plot for the displacements of a degree."""
    fine, _ = solve(min(sizes) / 4, 2, 10.0, "augmented")
    order = np.argsort(fine.points[:, 0])
    x, exact = fine.points[order, 0], fine.pressure[order]
    rows: list[timing.Row] = []
    for name, (stiffness, enforcement) in ENFORCEMENTS.items():
        for rule, options in rules(degree).items():
            for h in sizes:
                row: timing.Row = {"enforcement": name, "rule": rule, "h": h}
                rows.append(row)
                try:
                    contact, step = solve(h, degree, stiffness, enforcement, **options)
                except fc.NotConverged:
                    row["iterations"] = "none"
                    continue
                at, measure = contact.points[:, 0], contact.measure
                wanted = np.interp(at, x, exact)
                error = contact.pressure - wanted
                square = np.sqrt(measure @ error**2 / (measure @ wanted**2))
                row |= {
                    "pressure, error": float(square),
                    "oscillation": float(np.abs(error[at < MIDDLE]).max() / exact.max()),
                    "penetration": step.contacts["contact"].max_penetration,
                    "rounds": step.augmentations,
                    "iterations": step.iterations,
                }
    title = f"Quadrature of Γc, displacements of degree {degree}"
    timing.write(folder, f"degree_{degree}", title, rows)
    series: dict[str, Any] = {}
    for row in rows:
        if "oscillation" in row and row["enforcement"] != "penalty 1000":
            at, values = series.setdefault(f"{row['enforcement']}, {row['rule']}", ([], []))
            at.append(row["h"])
            values.append(row["pressure, error"])
    timing.draw(folder / f"degree_{degree}.png", title, "h", "error of the pressure", series)


def main() -> None:
    """Run."""
    arguments = timing.parser(__doc__, "quadrature").parse_args()
    if MPI.COMM_WORLD.size > 1:
        raise SystemExit("run it on one rank")
    sizes = [0.2, 0.1] if arguments.short else [0.2, 0.1, 0.05]
    for degree in (1, 2):
        study(degree, sizes, arguments.output)


if __name__ == "__main__":
    np.seterr(all="ignore")
    main()
