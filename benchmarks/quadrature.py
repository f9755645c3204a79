"""Measure error and oscillation of the pressure by degree and scheme of the quadrature on Γc.

The half-cylinder of ``demos/hertz.py`` without friction is solved with linear and quadratic
displacements (degree p); with 2 to p + 2 Gauss points per edge (quadrature degree 3 to 2p + 3; the
default, 2p, has p + 1 points) and vertex quadrature; and with a penalty of 10 and 1000 E/h and the
augmented Lagrangian. The reference is the augmented Lagrangian solution with quadratic cells of a
quarter of the smallest size. Two errors of the pressure are measured: its L² error, and its largest
error for x < 0.85 a, where the pressure is smooth, called oscillation.

    OMP_NUM_THREADS=1 python benchmarks/quadrature.py
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
MIDDLE = 0.85 * 2.127  # half-width a of the independent solution


def solve(
    h: float, degree: int, stiffness: float, enforcement: str, **rule: Any
) -> tuple[fc.Contact, fc.Step]:
    """Solve the half-cylinder under full load."""
    body = problems.half_cylinder(0.0, h)
    choices = {"enforcement": enforcement}
    problem, contact, _, load = problems.problem(
        body, degree, stiffness, contact_options=choices, surface_options=rule
    )
    load.value = body.final_load
    return contact, problem.solve()


def rules(degree: int) -> dict[str, dict[str, Any]]:
    """Return the rules by name; degrees 2n - 2 and 2n - 1 have the same n points on an edge."""
    gauss = {f"Gauss {n}": {"quadrature_degree": 2 * n - 1} for n in range(2, degree + 3)}
    return gauss | ({"vertex": {"quadrature_scheme": "vertex"}} if degree == 1 else {})


def study(degree: int, sizes: list[float], folder: Path) -> None:
    """Write the table for one polynomial degree of the displacement."""
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
                    "pressure error": float(square),
                    "oscillation": float(np.abs(error[at < MIDDLE]).max() / exact.max()),
                    "penetration": step.contacts["contact"].max_penetration,
                    "augmentations": step.augmentations,
                    "iterations": step.iterations,
                }
    title = f"Quadrature on Γc, displacements of degree {degree}"
    timing.write(folder, f"degree_{degree}", title, rows)


def main() -> None:
    """Run the benchmark and write its results."""
    arguments = timing.parser(__doc__, "quadrature").parse_args()
    if MPI.COMM_WORLD.size > 1:
        raise SystemExit("runs on one rank")
    sizes = [0.2, 0.1] if arguments.short else [0.2, 0.1, 0.05]
    for degree in (1, 2):
        study(degree, sizes, arguments.output)


if __name__ == "__main__":
    np.seterr(all="ignore")
    main()
