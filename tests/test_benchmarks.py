"""Tests of shared functions of the benchmarks, of their page, and short runs."""

from __future__ import annotations

import csv
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from mpi4py import MPI

from benchmarks import costs, page, run, timing
from scenes import problems
from scenes.processes import ROOT, subprocess_environment

pytestmark = pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="of one process")


def test_fit_finds_a_power_law() -> None:
    """The law y = 3 x^1.5 is found to 1e-12, the round-off of the logarithms."""
    x = [10.0, 100.0, 1e3, 1e5]
    assert timing.fit(x, [3 * v**1.5 for v in x]) == pytest.approx((3.0, 1.5), rel=1e-12)


def test_only_scripts_have_a_main_function() -> None:
    """Shared modules have no ``main`` and write no table."""
    texts = {path.stem: path.read_text() for path in (ROOT / "benchmarks").glob("*.py")}
    scripts = {name for name, text in texts.items() if "def main(" in text}
    assert scripts - {"run"} == set(texts) - set(run.HELPERS)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["half_cylinder", "ball", "tagged"])
def test_short_benchmark(name: str, tmp_path: Path) -> None:
    """The short benchmark succeeds and every method finds the solution."""
    command = [sys.executable, str(ROOT / "benchmarks" / "run.py"), name, "--short"]
    command += ["--repeat", "1", "--output", str(tmp_path)]
    done = subprocess.run(
        command, env=subprocess_environment(), capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "targets were not measured" in (tmp_path / "README.md").read_text()
    with open(tmp_path / name / f"{name}_sizes.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) > 10
    assert all(float(row["seconds"]) > 0 and row["iterations"] != "none" for row in rows)


@pytest.mark.slow
def test_bolted_joint_runs(tmp_path: Path) -> None:
    """Every increment is solved on one and two ranks, and the overload is refused."""
    command = [sys.executable, str(ROOT / "benchmarks" / "bolted_joint.py"), "--short"]
    command += ["--repeat", "1", "--output", str(tmp_path)]
    done = subprocess.run(
        command, env=subprocess_environment(), capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stdout + done.stderr
    with open(tmp_path / "bolted_joint.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    one, two = ([row for row in rows if row["ranks"] == ranks] for ranks in "12")
    assert len(one) == len(two) == 7
    assert [row["increment"] for row in one] == [row["increment"] for row in two]
    assert all(row[-1]["method"] == "refused: overload" for row in (one, two))


def test_monotonic_loading_takes_few_iterations() -> None:
    """With monotonic loading, increments start with the last tangent.

    Measured: 45 iterations in 40 increments; 78 if each starts from the last solution, and more on
    finer meshes.
    """
    case = costs.Case(problems.half_cylinder(0.0, 0.25), 2, 10.0)
    assert case.package(0.2, 40)["iterations"] <= 55


@pytest.mark.slow
def test_contact_at_large_strains_takes_few_newton_iterations(tmp_path: Path) -> None:
    """Newton iterations are at most 1.2 to 1.45 times those of SNES on the bulk alone.

    Measured: 1.07 and 1.19 under a disc, 1.22 and 1.35 between two bodies, without and with
    friction; relative to the package on the bulk alone 1.6 to 2.0.
    """
    command = [sys.executable, str(ROOT / "benchmarks" / "finite.py"), "--short"]
    subprocess.run(
        [*command, "--output", str(tmp_path)], check=True, env=subprocess_environment(), timeout=120
    )
    with open(tmp_path / "finite.csv", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["run"] == "contact"]
    ratios = {(row["problem"], float(row["μ"])): float(row["iterations / DOLFINx"]) for row in rows}
    assert ratios["disc", 0.0] < 1.2 and ratios["disc", 0.3] < 1.3
    assert ratios["two bodies", 0.0] < 1.3 and ratios["two bodies", 0.3] < 1.45
    assert max(float(row["iterations / package"]) for row in rows) < 2.2


def test_page_agrees_with_stored_results(tmp_path: Path) -> None:
    """The page in docs/ equals the one generated from the stored CSV files."""
    docs = tmp_path / "docs"
    shutil.copytree(ROOT / "docs" / "benchmarks", docs / "benchmarks")
    page.write(docs / "benchmarks", docs / "benchmarks.md")
    assert (docs / "benchmarks.md").read_text() == (ROOT / "docs" / "benchmarks.md").read_text()
