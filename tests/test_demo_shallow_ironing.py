"""The shallow ironing demo, run as its user runs it."""

from __future__ import annotations

from pathlib import Path

import pytest
from mpi4py import MPI

from scenes.processes import reference_values, run_demo

pytestmark = [
    pytest.mark.demo,
    pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts processes of its own"),
]


@pytest.mark.slow
def test_pressing_and_first_sliding(tmp_path: Path) -> None:
    """V(1) is in the published range, and all points slip soon afterwards.

    Sliding takes at most 8 iterations per increment on average.
    """
    options = ("--increments", "250", "--until", "1.06")
    result = run_demo("shallow_ironing", tmp_path, *options)
    assert 268.0 < reference_values(result)["V, t = 1"] < 332.0
    sliding = [row for row in result["path"] if row["time"] > 1.045]
    assert all(row["stick"] == 0 and row["slip"] > 0 for row in sliding)
    assert sum(row["iterations"] for row in sliding) <= 8 * len(sliding)
    for name in ("forces.png", "bodies.png"):
        assert (tmp_path / name).read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_dragging_by_four_times_the_die(tmp_path: Path) -> None:
    """V(1.5) and H(1.5) are in the published ranges."""
    computed = reference_values(run_demo("shallow_ironing", tmp_path, "--until", "1.5"))
    assert 337.0 < computed["V, t = 1.5"] < 421.0
    assert 102.0 < computed["H, t = 1.5"] < 189.0
