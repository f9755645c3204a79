"""The rolling demo, run as users run it, against GetFEM and by a cross-check."""

from __future__ import annotations

from pathlib import Path

import pytest
from mpi4py import MPI

from scenes.processes import reference_values, run_demo

pytestmark = [
    pytest.mark.demo,
    pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts processes of its own"),
]


@pytest.mark.slow  # the same scene, numbers and digits: test_finite_references.py
def test_forces_and_torque(tmp_path: Path) -> None:
    """Forces and torque are GetFEM's after pressing, rotation and dragging, to 1e-6.

    The references have six decimals. The disc slips before it is dragged.
    """
    result = run_demo("rolling", tmp_path)
    computed = reference_values(result)
    expected = {
        "normal, t = 1": 3003.797966,
        "torque, t = 2": 4049.434181,
        "drag, t = 3": 800.943243,
    }
    for name, value in expected.items():
        assert computed[name] == pytest.approx(value, rel=1e-6)
    assert computed["moving block: change of force / force"] < 1e-10
    path = result["path"]
    assert [row["stick"] > 0 for row in path[12:14]] == [True, True]
    assert all(row["stick"] == 0 and row["slip"] > 0 for row in path[20:])
    for name in ("rolling.png", "block.png"):
        assert (tmp_path / name).read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_demo_on_two_ranks(tmp_path: Path) -> None:
    """The demo finishes on two ranks, where it checks its own references."""
    assert run_demo("rolling", tmp_path, ranks=2)["path"][-1]["time"] == pytest.approx(3.0)
