"""The demo of the GRECO block, run as a script, against the converged solution."""

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
    """u_x and T agree with converged values to 0.3 %, and N with equilibrium, 2000, to 1e-8."""
    result = run_demo("greco_block", tmp_path)
    converged = [28.603, 27.226, 22.868, 19.807, 15.414]
    assert result["displacements_um"] == pytest.approx(converged, rel=0.003)
    assert result["normal_force"] == pytest.approx(2000.0, rel=1e-8)
    assert result["tangential_force"] == pytest.approx(1405.36, rel=0.003)
    zones = result["zones_mm"]
    # The points are 0.2 mm apart at the end of the open zone and 0.6 mm at the end of slip.
    assert zones["open"][1] == pytest.approx(3.3, abs=0.3)
    assert zones["slip"] == pytest.approx([3.4, 29.8], abs=0.6)
    assert zones["stick"][0] == pytest.approx(29.8, abs=0.6)
    for name in ("traction.png", "mesh.png"):
        assert (tmp_path / name).read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_result_does_not_depend_on_the_number_of_increments(tmp_path: Path) -> None:
    """With zero gap and a proportional load one and ten increments give the same state, to 1e-7.

    Residuals of 1e-9 of the forces cause errors of some 1e-8 in the displacements.
    """
    once = run_demo("greco_block", tmp_path / "1", "--cells", "20")
    ten_increments = run_demo("greco_block", tmp_path / "10", "--cells", "20", "--increments", "10")
    assert ten_increments["displacements_um"] == pytest.approx(once["displacements_um"], rel=1e-7)
    assert ten_increments["tangential_force"] == pytest.approx(once["tangential_force"], rel=1e-7)


@pytest.mark.slow
def test_two_ranks_agree(tmp_path: Path) -> None:
    """Two ranks give the displacements of one to 1e-7, for residuals of 1e-9 of the forces."""
    serial = run_demo("greco_block", tmp_path / "1", "--cells", "20")
    parallel = run_demo("greco_block", tmp_path / "2", "--cells", "20", ranks=2)
    assert parallel["displacements_um"] == pytest.approx(serial["displacements_um"], rel=1e-7)
