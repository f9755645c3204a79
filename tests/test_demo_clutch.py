"""The clutch demo, run as its user runs it, against the torque of textbooks for even pressure."""

from __future__ import annotations

from pathlib import Path

import pytest
from mpi4py import MPI

from scenes.processes import run_demo, values

pytestmark = [
    pytest.mark.demo,
    pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts processes of its own"),
]


def test_torque_of_full_slip(tmp_path: Path) -> None:
    """μ F 2/3 (b³ - a³)/(b² - a²) = 0.3 F 15.556 of textbooks; ∫ μ p r dA of the pressure found.

    2 %: the ring has 32 sides, and pressures are even to some percent. 1e-6: cos(Δφ/2) for slip
    that is straight is a part of it. Turning all of the scene as well changes nothing, to 1e-7.
    """
    result = run_demo("clutch", tmp_path)
    found, path = values(result), result["path"]
    last = path[-1]
    assert last["angle"] == 90.0
    assert last["torque"] == pytest.approx(0.3 * last["force"] * 15.5556, rel=0.02)
    assert last["torque"] == pytest.approx(last["of all slipping"], rel=1e-6)
    assert last["torque"] == pytest.approx(last["held"], rel=1e-6)
    for name in ("force", "torque"):
        assert found[f"{name}, rotating frame, relative change"] < 1e-7
    # Stick, then some of both, then slip all over, with a torque that grows until then.
    assert path[1]["slip"] == 0 and path[4]["stick"] and path[4]["slip"]
    assert all(row["stick"] == 0 for row in path[5:])
    assert path[2]["torque"] < 0.4 * last["torque"]
    for name in ("clutch.png", "pressure.png"):
        assert (tmp_path / name).read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_on_two_ranks(tmp_path: Path) -> None:
    """The demo's own references on two ranks."""
    assert run_demo("clutch", tmp_path, ranks=2)["path"][-1]["angle"] == 90.0
