"""The clutch demo, run as a script, compared with the textbook torque for uniform pressure."""

from __future__ import annotations

from pathlib import Path

import pytest
from mpi4py import MPI

from scenes.processes import reference_values, run_demo

pytestmark = [
    pytest.mark.demo,
    pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts processes of its own"),
]


def test_torque_of_full_slip(tmp_path: Path) -> None:
    """The torque is μ F 2/3 (b³ - a³)/(b² - a²) = 0.3 F 15.556 of textbooks, and ∫ μ p r dA.

    2 %: the ring has 32 sides, and pressures vary by some percent. 1e-6: cos(Δφ/2) due to straight
    slip is a part of it. Rotating the whole scene as well changes nothing, to 1e-7.
    """
    result = run_demo("clutch", tmp_path)
    computed, path = reference_values(result), result["path"]
    last = path[-1]
    assert last["angle"] == 90.0
    assert last["torque"] == pytest.approx(0.3 * last["force"] * 15.5556, rel=0.02)
    assert last["torque"] == pytest.approx(last["of all slipping"], rel=1e-6)
    assert last["torque"] == pytest.approx(last["held"], rel=1e-6)
    for name in ("force", "torque"):
        assert computed[f"{name}, rotating frame, relative change"] < 1e-7
    # Stick, then stick and slip, then slip of all points; the torque grows until then.
    assert path[1]["slip"] == 0 and path[4]["stick"] and path[4]["slip"]
    assert all(row["stick"] == 0 for row in path[5:])
    assert path[2]["torque"] < 0.4 * last["torque"]
    for name in ("clutch.png", "pressure.png"):
        assert (tmp_path / name).read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_demo_runs_on_two_ranks(tmp_path: Path) -> None:
    """The demo, which checks its own references, runs on two ranks."""
    assert run_demo("clutch", tmp_path, ranks=2)["path"][-1]["angle"] == 90.0
