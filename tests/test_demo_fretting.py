"""The demo of fretting of two cylinders, run as a script, against Mindlin's cycle."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from mpi4py import MPI

from scenes.processes import reference_values, run_demo

pytestmark = [
    pytest.mark.demo,
    pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts processes of its own"),
]


def energy(friction_ratio: float) -> float:
    """Return Mindlin's energy: 8 times the area between chord and δ(q); P = 10, μ = 0.2."""
    limit, stiffness = 2.0, math.pi * 200 / (2 * 0.91)

    def bend(s: float) -> float:
        return limit / stiffness * (1 - s) * math.log(1 - s)

    n = 20000
    below = sum(bend(friction_ratio * (i + 0.5) / n) for i in range(n)) * friction_ratio / n
    return 8 * limit * (friction_ratio * bend(friction_ratio) / 2 - below)


def test_fretting_loop_agrees_with_mindlin(tmp_path: Path) -> None:
    """Loop area within 1 %, dissipation within 0.5 % of Mindlin's energy; the loop closes.

    The trapezoidal rule with eight increments per quarter loses 0.4 % of the area; the dissipation
    at the points has no such error. After a load reversal slip starts from zero again.
    """
    result = run_demo("fretting", tmp_path)
    computed = reference_values(result)
    assert computed["loop area [mJ/mm]"] == pytest.approx(energy(0.7), rel=0.01)
    assert computed["dissipated energy [mJ/mm]"] == pytest.approx(energy(0.7), rel=0.005)
    assert computed["closing error of the loop / width"] <= 1e-4
    # Traction in the centre at the reversal, less twice that of half the force: p₀ = 9.3514.
    centre = 0.2 * 9.3514 * ((1 - math.sqrt(0.3)) - 2 * (1 - math.sqrt(0.65)))
    assert computed["residual shear traction at q = 0, centre [MPa]"] == pytest.approx(
        centre, rel=0.03
    )
    # At a load reversal all points stick, and Newton's method starts from the last state.
    # Measured: 3 and 2 iterations; 67 and 67 if a step on the last tangent is the predictor.
    rows = result["rows"]
    assert rows[9]["force"] < rows[8]["force"] and rows[25]["force"] > rows[24]["force"]
    assert rows[9]["iterations"] <= 6 and rows[25]["iterations"] <= 6
    # Measured: 86, and 158 without any predictor.
    assert sum(row["iterations"] for row in rows) <= 120
    assert (tmp_path / "loop.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_two_ranks_agree(tmp_path: Path) -> None:
    """Two ranks give the results of one to 1e-6; the residual is at most 1e-9 of the forces."""
    options = ("--cells", "16", "--increments", "5")
    serial = run_demo("fretting", tmp_path / "1", *options)
    parallel = run_demo("fretting", tmp_path / "2", *options, ranks=2)
    assert reference_values(parallel) == pytest.approx(reference_values(serial), rel=1e-6, abs=1e-6)
