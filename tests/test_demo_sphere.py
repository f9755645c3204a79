"""The sphere demo, run as users run it, against Hertz."""

from __future__ import annotations

from pathlib import Path

import pytest
from mpi4py import MPI

from scenes.processes import reference_values, run_demo

pytestmark = [
    pytest.mark.demo,
    pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts processes of its own"),
]


def test_force_radius_and_peak_pressure_of_hertz(tmp_path: Path) -> None:
    """Force, radius and peak pressure are within 2 % of Hertz's formulas, at a/R = 0.007.

    d = 5e-5: a = 0.00707107, F = 0.108786, p₀ = 1038.83. The error due to a/R is negligible; a
    stiffness of 30 E/h and eight cells per radius cause half a per cent.
    """
    result = run_demo("sphere", tmp_path)
    block, ball = result["runs"]
    assert reference_values(block)["force [N]"] == pytest.approx(0.108786, rel=0.02)
    assert reference_values(block)["radius [mm]"] == pytest.approx(0.00707107, rel=0.02)
    assert reference_values(block)["peak pressure [MPa]"] == pytest.approx(1038.83, rel=0.02)
    radius = (0.75 * ball["force"] / 230769) ** (1 / 3)
    assert ball["force"] == pytest.approx(0.108786, rel=0.02)
    assert reference_values(ball)["radius [mm]"] == pytest.approx(radius, rel=0.02)
    assert (tmp_path / "pressure.png").read_bytes()[:4] == b"\x89PNG"
    for case in ("block", "ball"):
        for name in ("body", "contact", "contact_points"):
            assert (tmp_path / case / f"{name}.pvd").exists()


@pytest.mark.slow
def test_two_ranks_agree(tmp_path: Path) -> None:
    """Results on two ranks agree to 1e-6; the solver's tolerance is 1e-9 of the forces."""
    options = ("--cases", "ball", "--cells", "6")
    serial = run_demo("sphere", tmp_path / "1", *options)
    parallel = run_demo("sphere", tmp_path / "2", *options, ranks=2)
    for one, two in zip(serial["runs"], parallel["runs"], strict=True):
        assert reference_values(two) == pytest.approx(reference_values(one), rel=1e-6)
        assert two["force"] == pytest.approx(one["force"], rel=1e-6)
