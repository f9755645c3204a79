"""The tube demo, run as a script, compared with a quarter on a rigid plane and Winkler's beam."""

from __future__ import annotations

from pathlib import Path

import pytest
from mpi4py import MPI

from scenes.processes import reference_values, run_demo

pytestmark = [
    pytest.mark.demo,
    pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts processes of its own"),
]


def test_forces_before_and_after_the_tube_closes(tmp_path: Path) -> None:
    """Forces are those of Winkler's beam, and of a quarter on a rigid plane after closing.

    1.5 %: half of (t/R)², as sections do not stay plane; 1e-3 between tube and quarter: normals of
    walls that are not flat do not end at mirror images. Without contact the walls would pass
    through each other under the force at closing, a twelfth of the last.
    """
    result = run_demo("tube", tmp_path)
    computed = reference_values(result)
    assert computed["compliance, vertical [mm²/N]"] == pytest.approx(64.368, rel=0.015)
    assert computed["compliance, horizontal [mm²/N]"] == pytest.approx(56.207, rel=0.015)
    full_tube, quarter = (result["forces"][name] for name in ("tube", "quarter"))
    assert full_tube == pytest.approx(quarter, rel=1e-3)
    closing, inside = result["closing"], result["inside"]["tube"]
    assert [f > 0 for f in inside] == [c > 18 for c in closing]
    assert full_tube[-1] > 10 * full_tube[closing.index(18)]
    # The bent loops carry the rest, slightly more than at closing.
    loops = full_tube[-1] - inside[-1]
    assert full_tube[closing.index(18)] < loops < 1.2 * full_tube[closing.index(18)]
    for name in ("tube.png", "section.png"):
        assert (tmp_path / name).read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_two_ranks_agree(tmp_path: Path) -> None:
    """Results on two ranks agree to 1e-6: the solver's tolerance is 1e-9 of the forces."""
    serial = run_demo("tube", tmp_path / "1")
    parallel = run_demo("tube", tmp_path / "2", ranks=2)
    for name, value in reference_values(serial).items():
        assert reference_values(parallel)[name] == pytest.approx(value, rel=1e-6)
