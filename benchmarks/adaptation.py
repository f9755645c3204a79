"""Compare uniform and adaptive refinement: error in the energy norm over the number of dofs.

    python benchmarks/adaptation.py

A rigid cylinder (R = 4) is pressed into a unit block, half of which is modelled with quadratic
triangles: without friction, and with μ = 0.3 in four increments. The error in the energy norm is
estimated. The table also has contact force and peak pressure.
"""

from __future__ import annotations

from functools import partial

import fenics_contact as fc
from benchmarks.timing import parser, write
from scenes.indented_block import half_block, solve_indentation


def main() -> None:
    """Refine uniformly and adaptively, and write the table."""
    arguments = parser(__doc__, "adaptation").parse_args()
    rows = []
    for friction in (0.0, 0.3):
        for refinement, bulk_fraction, levels in (("uniform", 1.0, 5), ("adaptive", 0.5, 10)):
            if arguments.short:
                levels -= 2
            steps = 4 if friction else 1
            solve = partial(solve_indentation, friction=friction, steps=steps)
            for level in fc.adapt(*half_block(4), solve, levels=levels, share=bulk_fraction):
                row = {"μ": friction, "refinement": refinement, "dofs": level.dofs}
                row["error of the energy norm"] = level.budget.energy
                rows.append(row | level.budget.values)
    title = "Cylinder on a block, quadratic triangles: uniform and adaptive refinement"
    write(arguments.output, "adaptation", title, rows)


if __name__ == "__main__":
    main()
