"""The half-cylinder demo, run from the command line, agrees with its references."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import pytest
from mpi4py import MPI

from scenes.processes import run_demo

pytestmark = [
    pytest.mark.newest,
    pytest.mark.demo,
    pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts processes of its own"),
]


def run(folder: Path, *options: str, ranks: int = 1) -> dict[str, Any]:
    return run_demo("hertz", folder, *options, ranks=ranks)


FIGURES = (
    "peak_pressure half_width tangential_resultant stick_half_width max_tangential_traction "
    "top_centre_displacement top_corner_displacement"
).split()


@pytest.fixture(scope="module")
def paper(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """Run the command without options and return its result and folder."""
    folder = tmp_path_factory.mktemp("paper")
    return run(folder), folder


def test_default_command_writes_all_results(paper: tuple[dict[str, Any], Path]) -> None:
    """The defaults are the paper's method and both frictions; all files and keys exist."""
    result, written = paper
    keys = "iterations converged_reasons solve_seconds wall_seconds dofs references".split()
    keys += FIGURES
    assert [case["friction"] for case in result["runs"]] == [0.0, 0.2]
    for case in result["runs"]:
        assert set(keys) <= set(case)
        assert (case["solver"], case["methods"]) == ("lbfgs", ["lbfgs"])
        assert all(reason > 0 for reason in case["converged_reasons"])
        assert all(entry["passed"] for entry in case["references"].values())
    for friction in ("0", "0.2"):
        folder = written / f"friction-{friction}"
        for name in ("traction.png", "mesh.png"):
            assert (folder / name).read_bytes()[:4] == b"\x89PNG"
        for name in ("body", "contact", "contact_points"):
            assert (folder / f"{name}.pvd").exists()


def test_auto_solver_saves_iterations(tmp_path: Path, paper: tuple[dict[str, Any], Path]) -> None:
    """``--solver auto`` yields the same results to 1e-6 in fewer iterations than L-BFGS.

    This is why Newton's method and continuation are preferred to L-BFGS.
    """
    result = run(tmp_path, "--solver", "auto")
    for case, same in zip(result["runs"], paper[0]["runs"], strict=True):
        assert case["solver"] == "auto" and set(case["methods"]) <= {"continuation", "newton"}
        assert all(entry["passed"] for entry in case["references"].values())
        assert sum(case["iterations"]) < sum(same["iterations"])
        for name in FIGURES:
            assert case[name] == pytest.approx(same[name], rel=1e-6, abs=1e-9), name


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["newton", "continuation", "alternating"])
def test_solvers_agree(tmp_path: Path, solver: str) -> None:
    """Results agree with the paper's method to 1e-6, and name the chosen solver."""
    options = ("--friction", "0.2", "--increments", "5")
    paper = run(tmp_path / "lbfgs", *options)
    result = run(tmp_path / solver, *options, "--solver", solver)
    assert (result["solver"], result["methods"]) == (solver, [solver])
    for name in FIGURES:
        assert result[name] == pytest.approx(paper[name], rel=1e-6, abs=1e-9), name


def test_frictionless_against_exact_contact(tmp_path: Path) -> None:
    """Reference with exact complementarity, converged: a = 2.127, p₀ = 142.6, within 1 %."""
    result = run(tmp_path, "--h", "0.05", "--degree", "2", "--friction", "0")
    assert result["half_width"] == pytest.approx(2.127, rel=0.01)
    assert result["peak_pressure"] == pytest.approx(142.6, rel=0.01)
    # Displacements converge twice as fast as tractions, so the tolerances are smaller.
    assert result["top_centre_displacement"][1] == pytest.approx(-0.5181, rel=1e-3)
    assert result["top_corner_displacement"] == pytest.approx([0.3332, -0.9947], rel=2e-3)


def test_friction_against_exact_contact(tmp_path: Path) -> None:
    """The incremental solution with exact complementarity and its stick zone agree to 2 %."""
    result = run(
        tmp_path, "--h", "0.05", "--degree", "2", "--friction", "0.2", "--increments", "80"
    )
    assert result["tangential_resultant"] == pytest.approx(34.17, rel=0.02)
    assert result["peak_pressure"] == pytest.approx(150.8, rel=0.02)
    assert result["half_width"] == pytest.approx(2.0855, rel=0.02)
    assert result["stick_half_width"] == pytest.approx(0.737 * 2.0855, rel=0.02)


def test_one_increment_yields_a_different_stick_zone(tmp_path: Path) -> None:
    """One increment yields T = 38.99, 14 % from the history, and a stick zone of 0.23 a."""
    result = run(tmp_path, "--h", "0.1", "--degree", "2", "--friction", "0.2", "--increments", "1")
    assert result["tangential_resultant"] == pytest.approx(38.99, rel=0.01)
    assert result["max_tangential_traction"] == pytest.approx(29.3, rel=0.02)
    # The reference 0.23 has two digits; half of the point spacing is 0.017 mm.
    assert result["stick_half_width"] / result["half_width"] == pytest.approx(0.23, abs=0.015)


def test_narrow_contact_agrees_with_hertz(tmp_path: Path) -> None:
    """For a/R = 0.048 half-width and peak pressure agree with Hertz within 1 %."""
    result = run(tmp_path, "--load", "1", "--h", "0.02", "--degree", "2", "--friction", "0")
    reference = {k: v["value"] for k, v in result["references"].items()}
    assert reference["half_width"] / 8 < 0.05
    for name in ("half_width", "peak_pressure"):
        assert result[name] == pytest.approx(reference[name], rel=0.01)


@pytest.mark.slow
def test_pressure_error_decreases_with_h(tmp_path: Path) -> None:
    """The fitted rate is 1 ± 0.3; the square-root edge of the pressure limits it to 1."""
    study = run(tmp_path, "--convergence", "--degree", "2")
    assert "fitted rate" in study["stdout"]
    errors = [row["pressure_error"] for row in study["rows"]]
    assert all(fine < coarse for coarse, fine in itertools.pairwise(errors))
    assert 0.7 < study["rate"] < 1.3


@pytest.mark.parametrize("ranks", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_ranks_agree(tmp_path: Path, ranks: int) -> None:
    """Results on 2 and 3 ranks agree with those on one rank to 1e-6."""
    options = ("--h", "0.4", "--degree", "2", "--friction", "0.2", "--increments", "2")
    serial = run(tmp_path / "serial", *options)
    parallel = run(tmp_path / "parallel", *options, ranks=ranks)
    for name in FIGURES:
        assert parallel[name] == pytest.approx(serial[name], rel=1e-6, abs=1e-9), name
    assert parallel["dofs"] == serial["dofs"]
