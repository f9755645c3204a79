"""The capstan demo, run as its user runs it, against Euler's and Eytelwein's formula."""

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
OPTIONS = ("--thickness", "1", "0.5", "--cells", "12")


def test_tension_of_the_fixed_end(tmp_path: Path) -> None:
    """ln(T2/T1) is 0.3 π, less by 1 to 1.25 t/(2R) for bands 1 and 0.5 thick, R = 10.

    The linear extrapolation to t = 0 neglects the product of both t/R, 0.5 %. All points slip long
    before the end: the last increments change nothing.
    """
    result = run_demo("capstan", tmp_path, *OPTIONS)
    computed = reference_values(result)
    for t in (1.0, 0.5):
        deficit = 1 - computed[f"ln(T2/T1), t = {t:g}"] / (0.3 * math.pi)
        assert t / 20 < deficit < 1.25 * t / 20
    assert computed["ln(T2/T1), t to 0"] == pytest.approx(0.3 * math.pi, rel=5e-3)
    for path in result["paths"]:
        turns, ratios = zip(*path, strict=True)
        assert turns[-1] == pytest.approx(3.01)
        assert ratios[0] < 0.6 * ratios[-1]
        assert ratios[-5:] == pytest.approx([ratios[-1]] * 5, rel=1e-4)
    assert (tmp_path / "capstan.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_two_ranks_agree(tmp_path: Path) -> None:
    """Two ranks give the same values, to 1e-6: the solver stops at 1e-9 of the forces."""
    options = ("--thickness", "1", "--cells", "12")
    serial = run_demo("capstan", tmp_path / "1", *options)
    parallel = run_demo("capstan", tmp_path / "2", *options, ranks=2)
    for name, value in reference_values(serial).items():
        assert reference_values(parallel)[name] == pytest.approx(value, rel=1e-6)
