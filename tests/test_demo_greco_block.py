"""The GRECO block, run as its user runs it, against the converged solution."""

from __future__ import annotations

from pathlib import Path

import pytest
from mpi4py import MPI

from scenes.processes import run_demo

pytestmark = [
    pytest.mark.demo,
    pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts processes of its own"),
]


def test_displacements_forces_and_zones(tmp_path: Path) -> None:
    """u_x within 0.3 % of the converged values; N = 2000 by equilibrium, T within 0.3 %."""
    result = run_demo("greco_block", tmp_path)
    converged = [28.603, 27.226, 22.868, 19.807, 15.414]
    assert result["displacements_um"] == pytest.approx(converged, rel=0.003)
    assert result["normal_force"] == pytest.approx(2000.0, rel=1e-8)
    assert result["tangential_force"] == pytest.approx(1405.36, rel=0.003)
    zones = result["zones_mm"]
    # The spacing of the points is 0.2 mm at the lift-off and 0.6 mm at the end of the slip.
    assert zones["open"][1] == pytest.approx(3.3, abs=0.3)
    assert zones["slip"] == pytest.approx([3.4, 29.8], abs=0.6)
    assert zones["stick"][0] == pytest.approx(29.8, abs=0.6)
    for name in ("traction.png", "mesh.png"):
        assert (tmp_path / name).read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_increments_do_not_matter(tmp_path: Path) -> None:
    """Zero gap and a proportional load: ten increments give the state of one, to the solver's 1e-9.

    Residuals of 1e-9 of the forces are displacements of some 1e-8.
    """
    once = run_demo("greco_block", tmp_path / "1", "--cells", "20")
    often = run_demo("greco_block", tmp_path / "10", "--cells", "20", "--increments", "10")
    assert often["displacements_um"] == pytest.approx(once["displacements_um"], rel=1e-7)
    assert often["tangential_force"] == pytest.approx(once["tangential_force"], rel=1e-7)


@pytest.mark.slow
def test_two_ranks_agree(tmp_path: Path) -> None:
    """The same on two ranks, to 1e-7 for the same reason."""
    serial = run_demo("greco_block", tmp_path / "1", "--cells", "20")
    parallel = run_demo("greco_block", tmp_path / "2", "--cells", "20", ranks=2)
    assert parallel["displacements_um"] == pytest.approx(serial["displacements_um"], rel=1e-7)
