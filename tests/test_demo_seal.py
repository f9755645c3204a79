"""The seal demo, run from the command line, against Lindley's formula for O-rings."""

from __future__ import annotations

from pathlib import Path

import pytest
from mpi4py import MPI

from scenes.processes import reference_values, run_demo

pytestmark = [
    pytest.mark.demo,
    pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts processes of its own"),
]


def test_force_over_compression(tmp_path: Path) -> None:
    """Lindley's 1.25 c^1.5 + 50 c^6, times E D = 30: 2.196, 3.450, 5.054 at c = 0.15, 0.2, 0.25.

    They agree to 5 %: the formula is a fit. The groove has no effect (1e-6) until the ring touches
    its outer wall, and increases the final force by about half (at least 30 %).
    """
    result = run_demo("seal", tmp_path)
    computed = reference_values(result)
    for c, force in ((0.15, 2.196), (0.2, 3.450), (0.25, 5.054)):
        assert computed[f"force at c = {c:g} [N/mm]"] == pytest.approx(force, rel=0.05)
    free, in_groove = result["forces"]["between plates"], result["forces"]["in a groove"]
    assert in_groove[:2] == pytest.approx(free[:2], rel=1e-6)
    assert in_groove[-1] > 1.3 * free[-1]
    for name in ("seal.png", "section.png"):
        assert (tmp_path / name).read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_two_ranks_agree(tmp_path: Path) -> None:
    """Results on two ranks agree to 1e-6; the solver's tolerance is 1e-9 of the forces."""
    serial = run_demo("seal", tmp_path / "1")
    parallel = run_demo("seal", tmp_path / "2", ranks=2)
    for name, value in reference_values(serial).items():
        assert reference_values(parallel)[name] == pytest.approx(value, rel=1e-6)
