"""The seal demo, run as its user runs it, against Lindley's formula for O-rings."""

from __future__ import annotations

from pathlib import Path

import pytest
from mpi4py import MPI

from scenes.processes import run_demo, values

pytestmark = [
    pytest.mark.demo,
    pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts processes of its own"),
]


def test_force_over_closing(tmp_path: Path) -> None:
    """Lindley's 1.25 c^1.5 + 50 c^6, times E D = 30: 2.196, 3.450, 5.054 at c = 0.15, 0.2, 0.25.

    5 %: the formula is a fit. The groove lets the ring alone until
    it meets the outer wall; in the end the lid needs half as much again.
    """
    result = run_demo("seal", tmp_path)
    found = values(result)
    for c, force in ((0.15, 2.196), (0.2, 3.450), (0.25, 5.054)):
        assert found[f"force at c = {c:g} [N/mm]"] == pytest.approx(force, rel=0.05)
    free, held = result["forces"]["between plates"], result["forces"]["in a groove"]
    assert held[:2] == pytest.approx(free[:2], rel=1e-6)
    assert held[-1] > 1.3 * free[-1]
    for name in ("seal.png", "section.png"):
        assert (tmp_path / name).read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_two_ranks_agree(tmp_path: Path) -> None:
    """The same on two ranks, to 1e-6: the solver stops at 1e-9 of the forces."""
    serial = run_demo("seal", tmp_path / "1")
    parallel = run_demo("seal", tmp_path / "2", ranks=2)
    for name, value in values(serial).items():
        assert values(parallel)[name] == pytest.approx(value, rel=1e-6)
