"""What the benchmarks share, and that they run."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import pytest
from mpi4py import MPI
from running import ROOT, environment

sys.path.insert(0, str(ROOT / "benchmarks"))

import timing

pytestmark = pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="of one process")


def test_fit_finds_a_power_law() -> None:
    """A law y = 3 x^1.5, exactly: logarithms of doubles, so that 1e-12 is left."""
    x = [10.0, 100.0, 1e3, 1e5]
    assert timing.fit(x, [3 * v**1.5 for v in x]) == pytest.approx((3.0, 1.5), rel=1e-12)


def test_times_are_medians_in_units_of_a_run(tmp_path: Path) -> None:
    """Every run is made once small and `repeat` times; the unit's own row is 1."""
    calls: list[str] = []

    def run(name: str) -> dict[str, int]:
        calls.append(name)
        return {"calls": len(calls)}

    runs = {name: lambda name=name: run(name) for name in ("one", "other")}
    rows = timing.measure(runs, repeat=3, first=runs)
    assert calls == ["one", "other"] * 4
    assert [row["calls"] for row in rows] == [7, 8]
    rows = timing.in_units_of(rows, "one", "units")
    assert rows[0]["units"] == 1.0
    assert rows[1]["units"] == pytest.approx(rows[1]["seconds"] / rows[0]["seconds"])
    timing.write(tmp_path, "table", "A table", rows)
    with open(tmp_path / "table.csv", newline="") as file:
        assert [row["run"] for row in csv.DictReader(file)] == ["one", "other"]
    assert "| one |" in (tmp_path / "table.md").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["half_cylinder", "ball"])
def test_short_benchmark(name: str, tmp_path: Path) -> None:
    """The short benchmark ends well, every method finds the solution, and plots are drawn."""
    command = [sys.executable, str(ROOT / "benchmarks" / "run.py"), name, "--short"]
    command += ["--repeat", "1", "--output", str(tmp_path)]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"![]({name}/{name}_dofs.png)" in (tmp_path / "README.md").read_text()
    with open(tmp_path / name / f"{name}_sizes.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) > 10
    assert all(float(row["seconds"]) > 0 and row["iterations"] != "none" for row in rows)


@pytest.mark.slow
def test_enforcement_and_quadrature_run(tmp_path: Path) -> None:
    """Their short forms end well, and multipliers are worth it on every scene.

    An error of the peak pressure a tenth of that of the penalty with the same springs (measured: a
    hundredth and less), with no more than twice its iterations.
    """
    command = [sys.executable, str(ROOT / "benchmarks" / "run.py"), "enforcement", "quadrature"]
    command += ["--short", "--repeat", "1", "--output", str(tmp_path)]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    tables = sorted((tmp_path / "enforcement").glob("*.csv"))
    assert len(tables) == 3
    for table in tables:
        with open(table, newline="") as file:
            rows = {row["run"]: row for row in csv.DictReader(file)}
        ours, theirs = rows["augmented 10"], rows["penalty 10"]
        assert float(ours["peak pressure, error"]) <= 0.1 * float(theirs["peak pressure, error"])
        assert int(ours["iterations"]) <= 2 * int(theirs["iterations"])
    assert len(list((tmp_path / "quadrature").glob("*.csv"))) == 2


@pytest.mark.slow
def test_large_runs(tmp_path: Path) -> None:
    """On a small block every run ends well, with one force to 1e-6: also the script by hand's."""
    command = [sys.executable, str(ROOT / "benchmarks" / "large.py"), "--cells", "8"]
    command += ["--repeat", "1", "--output", str(tmp_path)]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    with open(tmp_path / "large.csv", newline="") as file:
        rows = {row["run"]: row for row in csv.DictReader(file)}
    assert all(row["iterations"] not in ("none", "failed") for row in rows.values())
    forces = [float(row["force"]) for row in rows.values() if row["force"]]
    assert len(forces) == 6
    assert forces == pytest.approx(forces[:1] * 6, rel=1e-6)
