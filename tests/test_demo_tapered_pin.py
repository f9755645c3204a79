"""The tapered pin demo, run from the command line, against Lamé's rings and Coulomb's law."""

from __future__ import annotations

from pathlib import Path

import pytest
from mpi4py import MPI

from scenes.processes import reference_values, run_demo

pytestmark = [
    pytest.mark.demo,
    pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts processes of its own"),
]


@pytest.mark.slow
def test_insertion_release_and_extraction(tmp_path: Path) -> None:
    """Pressure 205.4 MPa (Q = 514 kN); insertion 82.6 kN and dry extraction 71.2 kN, to 0.5 %.

    After release the dry pin keeps its depth, and the lubricated one comes out. Its holding force
    is (0.01 - 0.005) / (0.01 + 0.005) of the insertion force; at half of it half of the depth
    remains, to 2 % (the end of the pin outside of the hub is a fortieth of the joint).
    """
    result = run_demo("tapered_pin", tmp_path, "--cells", "20")
    computed = reference_values(result)
    assert computed["mean pressure, insertion [MPa]"] == pytest.approx(205.4, rel=5e-3)
    assert computed["dry, insertion force [N]"] == pytest.approx(82.6e3, rel=5e-3)
    assert computed["dry, extraction force [N]"] == pytest.approx(71.2e3, rel=5e-3)
    assert computed["dry, relative depth after release"] > 0.995
    assert computed["dry, prescribed force: relative depth after release"] > 0.995
    assert computed["lubricated: relative depth, 0.5 of the holding force"] == pytest.approx(
        0.5, rel=0.02
    )
    assert computed["lubricated: relative depth after release"] == pytest.approx(0.0, abs=1e-6)
    dry, _, oiled = result["paths"]
    # The dry force changes its sign at the reversal; the lubricated one never does.
    (turned,) = [i for i, (s, _, _) in enumerate(dry) if abs(s - 2.0) < 1e-9]
    assert all(push > 0 for _, _, push in dry[: turned + 1])
    assert all(push < 0 for s, _, push in dry[turned:] if 0 < s < 1.98)
    assert all(push > 0 for _, _, push in oiled[:-1])
    assert (tmp_path / "tapered_pin.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_two_ranks_agree(tmp_path: Path) -> None:
    """Results on two ranks agree to 1e-6, relative or absolute; the solver's tolerance is 1e-9."""
    serial = run_demo("tapered_pin", tmp_path / "1", "--cells", "20")
    parallel = run_demo("tapered_pin", tmp_path / "2", "--cells", "20", ranks=2)
    assert reference_values(parallel) == pytest.approx(reference_values(serial), rel=1e-6, abs=1e-6)
