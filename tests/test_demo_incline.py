"""The demo of a block on an incline is compared with statics."""

from __future__ import annotations

from pathlib import Path

import pytest
from mpi4py import MPI

from scenes.processes import reference_values, run_demo

pytestmark = [
    pytest.mark.demo,
    pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts processes of its own"),
]


def test_friction_angle_and_wedge(tmp_path: Path) -> None:
    """The limit slope is tan α = μ, to 1e-4; F/G of NAFEMS CGS-4 is reproduced to all its digits.

    Both follow from statics on any mesh. While the slope grows, the slip part of the base grows.
    """
    result = run_demo("incline", tmp_path)
    assert result["tilted"]["limit"] == pytest.approx(0.3, rel=1e-4)
    for row in result["tilted"]["rows"]:
        assert row["T/N"] == pytest.approx(row["slope"], rel=1e-6)
    slips = [row["slip"] for row in result["tilted"]["rows"]]
    assert slips == sorted(slips) and 0 < slips[0] < 0.1 < 0.9 < slips[-1]
    assert "no contact force can balance" in result["tilted"]["message"]
    wedge = [run["rows"][-1]["F/G"] for run in result["pushed"]]
    assert wedge == pytest.approx([0.1, 0.202020, 0.306122, 0.412371], abs=5e-7)
    assert result["pushed"][-1]["rows"][1]["F/G"] < 0.3  # the block sticks before it slides
    for name in ("forces", "mesh"):
        assert (tmp_path / f"{name}.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_two_ranks_agree(tmp_path: Path) -> None:
    """One and two ranks agree to 1e-6; the solver's tolerance is 1e-9 of the forces."""
    options = ("--cells", "18", "--increments", "2")
    serial = run_demo("incline", tmp_path / "1", *options)
    parallel = run_demo("incline", tmp_path / "2", *options, ranks=2)
    assert reference_values(parallel) == pytest.approx(reference_values(serial), rel=1e-6, abs=1e-7)
    for one, two in zip(serial["pushed"], parallel["pushed"], strict=True):
        for a, b in zip(one["rows"], two["rows"], strict=True):
            assert b["F/G"] == pytest.approx(a["F/G"], rel=1e-6)
