"""The bearing demo, run as a script."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

from scenes.processes import reference_values, run_demo


@pytest.mark.demo
@pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts processes of its own")
def test_roller_loads(tmp_path: Path) -> None:
    """Loads follow Palmgren's δ^(10/9), 3 %, and all forces are in balance, 1e-6.

    Four rollers, on which the rings do not close, have no load. It takes 110 iterations; where they
    regularised all bodies, the third increment was refused after thousands.
    """
    result = run_demo("bearing", tmp_path)
    computed, last = reference_values(result), result["path"][-1]
    assert computed["load ratio / Palmgren"] == pytest.approx(1.0, abs=0.03)
    assert computed["reaction / shaft force"] == pytest.approx(1.0, abs=1e-6)
    # Σ Q cos ψ of the rollers at ±22.5° and ±67.5°, up to friction.
    loads = np.array(last["roller loads"])[[0, 1, -2, -1]]
    cosines = np.cos(np.radians([22.5, 67.5, 67.5, 22.5]))
    assert float(loads @ cosines) == pytest.approx(abs(last["reaction"]), rel=0.01)
    assert sum(row["iterations"] for row in result["path"]) < 300
    assert (tmp_path / "bearing.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.demo
@pytest.mark.slow
@pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts processes of its own")
def test_demo_runs_on_two_ranks(tmp_path: Path) -> None:
    """The demo, which checks its own references, runs on two ranks."""
    assert len(run_demo("bearing", tmp_path, ranks=2)["path"]) == 5
