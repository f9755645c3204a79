"""The screw demo agrees with the textbook torque of a square thread."""

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


def test_torque_over_axial_force(tmp_path: Path) -> None:
    """The torque is F P without friction, and F R tan(α ± φ) with μ = 0.2.

    The first follows from the normals at all points, to round-off (1e-9). The second holds to 3e-4
    of F R: a centre of pressure off the middle by a hundredth of the width of the block changes the
    contribution of friction by a thousandth.
    """
    result = run_demo("screw", tmp_path, "--friction", "0.2", "--cells", "3")
    computed = reference_values(result)
    alpha, phi = np.arctan(0.3), np.arctan(0.2)
    assert computed["μ = 0: largest |M / (F P) - 1|"] < 1e-9
    assert computed["raising, M / (F R)"] == pytest.approx(np.tan(alpha + phi), abs=3e-4)
    assert computed["lowering, M / (F R)"] == pytest.approx(np.tan(alpha - phi), abs=3e-4)
    assert all(row["force"] > 0.5 for row in result["path"][1:])
    assert [result["path"][i]["stick"] for i in (13, -1)] == [0, 0]
    for name in ("screw.png", "pressure.png"):
        assert (tmp_path / name).read_bytes()[:4] == b"\x89PNG"
