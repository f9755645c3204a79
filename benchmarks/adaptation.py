"""Error over dofs: meshes refined everywhere against meshes refined where the error is made.

    python benchmarks/adaptation.py

A rigid cylinder (R = 4) pressed into a block of unit size, half of it modelled, in quadratic
triangles: without friction, and with μ = 0.3 in four increments. The error is that in the energy
norm as estimated; beside it what the contact force and the peak pressure come to.
"""

from __future__ import annotations

from functools import partial

import fenics_contact as fc
from benchmarks.timing import draw, parser, write
from scenes.indented import half_block, press


def main() -> None:
    """Refine both ways, write and draw."""
    arguments = parser(__doc__, "adaptation").parse_args()
    rows = []
    for friction in (0.0, 0.3):
        for way, share, levels in (("everywhere", 1.0, 5), ("where the error is", 0.5, 10)):
            if arguments.short:
                levels -= 2
            steps = 4 if friction else 1
            solve = partial(press, friction=friction, steps=steps)
            for level in fc.adapt(*half_block(4), solve, levels=levels, share=share):
                row = {"μ": friction, "refined": way, "dofs": level.dofs}
                row["error of the energy norm"] = level.budget.energy
                rows.append(row | level.budget.values)
    series: dict[str, tuple[list[float], list[float]]] = {}
    for row in rows:
        dofs, errors = series.setdefault(f"μ = {row['μ']:g}, {row['refined']}", ([], []))
        dofs.append(row["dofs"])
        errors.append(row["error of the energy norm"])
    title = "Cylinder on a block, quadratic triangles"
    write(arguments.output, "adaptation", f"{title}: refined everywhere and adapted", rows)
    draw(arguments.output / "adaptation.png", title, "dofs", "error, energy norm", series)


if __name__ == "__main__":
    main()
