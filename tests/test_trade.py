"""The study of speed for accuracy: what it stores survives, and the presets are on its front."""

from __future__ import annotations

import pytest
from mpi4py import MPI

from benchmarks import trade, trade_page, trade_scenes
from fenics_contact.contact.accuracy import PRESETS
from scenes.processes import ROOT

pytestmark = pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="of one process")


STUDY = ROOT / "docs" / "trade.csv"


@pytest.mark.parametrize("name", trade_scenes.all_scenes())
def test_references_meet_published_values(name: str) -> None:
    """Those the errors are against, to what the demos ask of the same values.

    0.4 % without friction; 1 % with it, where the published solution has 80 increments; 0.3 % for
    the block; 2 % for Hertz's ball, whose theory takes a/R = 0.02 for small. Lamé's is exact.
    """
    tolerance = {
        "half-cylinder": 0.004,
        "half-cylinder μ=0.2": 0.01,
        "GRECO block": 0.003,
        "ball on block": 0.02,
    }
    scene = trade_scenes.all_scenes()[name]
    rows = [r for r in trade.read(STUDY) if r["scene"] == name and r["role"] == "reference"]
    assert len(rows) == (1 if name in tolerance else 0)
    for row in rows:
        for quantity, value in scene.published.items():
            assert float(row[quantity]) == pytest.approx(value, rel=tolerance[name], abs=1e-9)


@pytest.mark.parametrize("name", trade_scenes.all_scenes())
@pytest.mark.parametrize("preset", PRESETS)
def test_no_preset_is_dominated(preset: str, name: str) -> None:
    """Nothing measured on the same mesh has both less error and less time.

    Each by a tenth: times are repeated to some per cent. And the error is as wanted, on a mesh
    whose own, found with multipliers to 1e-7, is less than that.
    """
    rows = trade.read(STUDY)
    row = next(r for r in rows if r["scene"] == name and r["accuracy"] == preset)
    assert trade_page.solved(row), row["failure"]
    others = trade_page.comparable(row, rows)
    assert len(others) > 30
    better = trade_page.dominating(row, others)
    base = trade_scenes.all_scenes()[name].base
    assert not better, [(trade_page.describe(r, base), r["error"], r["time"]) for r in better]
    assert float(row["error"]) <= PRESETS[preset]


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_solve_the_block(preset: str) -> None:
    """The GRECO block of 8 x 8 cells: with residuals as large as the tolerance rounds do not end.

    N = 2000 N/mm is equilibrium, held to ten times the residual allowed; T = 1405.36 is that of
    converged meshes, met here within 3 % (the mesh's own error is 1.2 %).
    """
    scene = trade_scenes.all_scenes()["GRECO block"]
    found = trade.solve(scene.make(5.0), trade.replace(scene.base, h=5.0, accuracy=preset))
    assert "failure" not in found, found["failure"]
    assert found["normal force"] == pytest.approx(2000.0, rel=1e-3)
    assert found["friction force"] == pytest.approx(1405.36, rel=0.03)
