"""The ironing demo agrees with the solution of a sliding cylinder on a half-plane."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

from scenes.processes import reference_values, run_demo

pytestmark = [
    pytest.mark.demo,
    pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts processes of its own"),
]
OPTIONS = ("--cells", "6", "--increments", "12")


@pytest.mark.slow
def test_sliding_cylinder_agrees_with_johnson(tmp_path: Path) -> None:
    """Half-width and peak pressure agree with Johnson to 2 %, six cells per half-width.

    For γ = 0.0272, a = 0.2505 and p₀ = 11.445; without friction 0.2501 and 11.45. The vertical
    force is prescribed, and the height of the cylinder unknown.
    """
    result = run_demo("ironing", tmp_path, *OPTIONS)
    computed = reference_values(result)
    assert computed["half-width [mm]"] == pytest.approx(0.2505, rel=0.02)
    assert computed["peak pressure [MPa]"] == pytest.approx(11.445, rel=0.02)
    assert computed["vertical force [N/mm]"] == pytest.approx(4.5, rel=1e-6)
    assert len(result["path"]) == 12
    peaks = np.array([row["peak"] for row in result["path"][4:]])
    assert np.ptp(peaks) < 0.03 * peaks.mean()
    assert all(row["stick"] == 0 for row in result["path"][2:])
    assert (tmp_path / "ironing.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_two_ranks_agree(tmp_path: Path) -> None:
    """Results on two ranks agree to 1e-6; the solver stops at 1e-9 of the forces."""
    options = ("--cells", "5", "--increments", "4")
    serial = run_demo("ironing", tmp_path / "1", *options)
    parallel = run_demo("ironing", tmp_path / "2", *options, ranks=2)
    for name, value in reference_values(serial).items():
        assert reference_values(parallel)[name] == pytest.approx(value, rel=1e-6, abs=1e-6)
