"""The demo of a male-female fitting is compared with relations that hold for any geometry."""

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


def test_statics_and_homogeneity(tmp_path: Path) -> None:
    """Forces are those of a wedge, to 1e-7; the state is homogeneous in the load, to 1e-8.

    P = 0.02656 · 6.4 · 43 daN; the flank rises by 40 mm over 22 mm.
    """
    result = run_demo("fitting", tmp_path)
    computed = reference_values(result)
    half = 0.02656 * 6.4 * 43 / 2
    length = math.hypot(22, 40)
    sine, cosine = 22 / length, 40 / length
    assert computed["vertical force on a flank [daN]"] == pytest.approx(half, rel=1e-7)
    assert computed["half of the top reaction [daN]"] == pytest.approx(half, rel=1e-7)
    assert computed["normal force, μ = 0 [daN]"] == pytest.approx(half / sine, rel=1e-7)
    normal, tangential = result["normal_force"], result["tangential_force"]
    assert half / (sine + 0.2 * cosine) * (1 - 1e-7) <= normal <= half / (sine - 0.2 * cosine)
    # The closed flank slips in one direction, so that the sum of |τ| is also the resultant.
    assert result["lateral_thrust"] == pytest.approx(normal * cosine - tangential * sine, rel=1e-7)
    assert computed["twice the load, relative difference"] <= 1e-8
    assert computed["5 increments, relative difference"] <= 1e-8
    for name in ("flank", "mesh"):
        assert (tmp_path / f"{name}.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_steeper_flanks_and_more_friction(tmp_path: Path) -> None:
    """With steeper flanks and more friction the demo's own checks hold (exit code 0)."""
    result = run_demo("fitting", tmp_path, "--f", "60", "--friction", "0.3", "--h", "2")
    assert result["flank_angle_degrees"] == pytest.approx(math.degrees(math.atan2(22, 60)))


@pytest.mark.slow
def test_two_ranks_agree(tmp_path: Path) -> None:
    """One and two ranks agree to 1e-6; the solver's tolerance is 1e-12 of the forces."""
    serial = run_demo("fitting", tmp_path / "1", "--h", "2")
    parallel = run_demo("fitting", tmp_path / "2", "--h", "2", ranks=2)
    for name in ("normal_force", "tangential_force", "lateral_thrust", "closed_length"):
        assert parallel[name] == pytest.approx(serial[name], rel=1e-6), name
    assert parallel["largest_pressure"] == pytest.approx(serial["largest_pressure"], rel=1e-6)
