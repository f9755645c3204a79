"""What the benchmarks share, and that they run."""

from __future__ import annotations

import csv
import math
import subprocess
import sys
from pathlib import Path

import pytest
from mpi4py import MPI

from benchmarks import costs, large, parallel, run, targets, timing
from scenes import problems
from scenes.processes import ROOT, environment

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


def test_long_runs_are_not_repeated() -> None:
    """What takes longer than `once` is timed once."""
    calls: list[str] = []
    runs = {"long": lambda: calls.append("long") or {}, "other": lambda: calls.append("o") or {}}
    timing.measure(runs, repeat=3, once=0.0)
    assert calls == ["long", "o"]


def made_up(folder: Path, slower: float) -> None:
    """CSV files as the benchmarks leave them, with times times ``slower`` for the package's."""
    cylinder = [
        {"run": "one linear solve", "iterations": 1, "seconds": 1.0},
        {"run": "μ = 0: plain DOLFINx, LU", "iterations": 9, "seconds": 9.0},
        {"run": "μ = 0.2: plain DOLFINx, LU", "iterations": 10, "seconds": 12.0},
        {"run": "μ = 0, 1 increments: by default", "iterations": 5, "seconds": 0.9 * slower},
        {"run": "μ = 0.2, 1 increments: by default", "iterations": 6, "seconds": 1.2 * slower},
        {"run": "μ = 0.2, 40 increments: by default", "iterations": 80, "seconds": 1.9 * slower},
    ]
    ball = [
        {"run": "one linear solve", "iterations": 1, "seconds": 10.0},
        {"run": "plain DOLFINx, LU", "iterations": 9, "seconds": 150.0},
        {"run": "plain DOLFINx, GMRES + GAMG", "iterations": 9, "seconds": 48.0},
        {"run": "by default", "iterations": 11, "seconds": 24.0 * slower, "error of peak [%]": 1.0},
    ]
    million = {"dofs": 1_029_000, "ranks": 1, "GiB": 5.4 * slower**2}
    big = [
        {"run": "linear, multigrid", "iterations": 30, "seconds": 60.0, **million},
        {"run": "contact", "iterations": 67, "seconds": 90.0 * slower, **million},
    ]
    ranks = [
        {"run": "contact, multigrid", "dofs": dofs, "ranks": p, "iterations": 50, "seconds": time}
        for dofs in (46_875, 107_811, 331_776)
        for p, time in ((1, 10.0), (2, 6.0 * slower))
    ]
    plane = [
        {"run": run, "dofs": 122_630, "ranks": p, "iterations": 9, "seconds": time}
        for run in ("μ = 0, 1 increments", "μ = 0.2, 1 increments", "μ = 0.2, 40 increments")
        for p, time in ((1, 10.0), (2, 5.0 * slower))
    ]
    tagged = [
        {"run": "one linear solve", "iterations": 1, "seconds": 10.0},
        {"run": "10 increments", "iterations": 66, "seconds": 18.0 * slower},
    ]
    common = {"dofs": 54_951, "iterations": 50}
    joint = [
        {"increment": "pulled", "way": way, "ranks": p, "linear solves": many} | common
        for p, most in ((1, 2.5 * slower), (2, 2.0 * slower))
        for way, many in (("lbfgs", most), ("newton", 0.5), ("refused: overload", 90.0))
    ]
    ratios = {"steps / plain": 1.1 * slower, "steps / prescribed": 1.2 * slower}
    rubber = [
        {"scene": scene, "μ": mu, "dofs": 5_330, "run": run, "Newton steps": 67, **ratios}
        for scene in ("disc", "two bodies")
        for mu in (0.0, 0.3)
        for run in ("contact", "prescribed")
    ]
    tables = {"half_cylinder": cylinder, "ball": ball, "large": big, "ranks": plane}
    tables |= {"tagged": tagged, "bolted_joint": joint, "finite": rubber}
    for name, rows in tables.items():
        (folder / name).mkdir(exist_ok=True)
        timing.save(folder / name / f"{name}.csv", rows)
    (folder / "parallel").mkdir(exist_ok=True)
    timing.save(folder / "parallel" / "parallel.csv", ranks)


def test_targets(tmp_path: Path) -> None:
    """All met by made-up times just below them, none by times and memory far above them."""
    assert {row["met"] for row in targets.table(tmp_path)} == {targets.NOT_MEASURED}
    made_up(tmp_path, 1.0)
    rows = targets.table(tmp_path)
    expected = [0.9, 0.1, 1.2, 0.1, 1.9, 2.4, 0.16, 0.5, 1.8, 2.5, 2.0]
    expected += [1.1, 1.2] * 4 + [1.5, 5.4, 2, 2, 2, 10 / 6, 10 / 6]
    assert [row["measured"] for row in rows] == pytest.approx(expected)
    assert {row["met"] for row in rows} == {"yes"}
    assert "error of peak [%] 1" in next(r["with"] for r in rows if r["scene"].startswith("ball"))
    made_up(tmp_path, 2.0)
    assert {row["met"] for row in targets.table(tmp_path)} == {"no"}


def test_failed_run_meets_no_target(tmp_path: Path) -> None:
    """A method that did not converge is not quick."""
    made_up(tmp_path, 1.0)
    path = tmp_path / "ball" / "ball.csv"
    path.write_text(path.read_text().replace("by default,11", "by default,none"))
    rows = {row["target"]: row["met"] for row in targets.table(tmp_path)}
    assert rows["time / one linear solve ≤ 2.5"] == "no"


def test_what_is_run_is_a_script() -> None:
    """Modules that the benchmarks share have no ``main`` and leave no table."""
    texts = {path.stem: path.read_text() for path in (ROOT / "benchmarks").glob("*.py")}
    scripts = {name for name, text in texts.items() if "def main(" in text}
    assert scripts - {"run"} == set(texts) - set(run.HELPERS)


def test_page_keeps_parts_of_earlier_runs(tmp_path: Path) -> None:
    """What has been run is joined, in order; what has not is left out, failures are told."""
    stamp = '{"machine": "m", "threads": "1", "date": "d", "seconds": 3, "load": 0.1, "failed": %d}'
    for name, failed in (("ball", 0), ("large", 1)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "stamp.json").write_text(stamp % failed)
        (tmp_path / name / "table.md").write_text(f"## the table of {name}\n")
    (tmp_path / "ball" / "a.png").write_bytes(b"")
    page = run.page(tmp_path, ["ball", "half_cylinder", "large"], tmp_path.parent)
    assert "### the table of ball" in page and "the table of large" not in page
    assert "failed with exit code 1" in page and "## half_cylinder" not in page
    assert f"![]({tmp_path.name}/ball/a.png)" in page
    assert len(timing.read(tmp_path / "targets.csv")) == len(targets.TARGETS)


def test_latency_and_bandwidth_are_fitted() -> None:
    """Of times that obey the law, exactly (1e-9: conditioning of the least squares)."""
    sizes = [8.0 * 4**k for k in range(10)]
    found = parallel.fit_message(sizes, [2e-6 + s / 5e9 for s in sizes])
    assert found == pytest.approx((2e-6, 5e9), rel=1e-9)


def test_model_of_ranks() -> None:
    """T = bus c n/p I + m α + s/β + r γ log₂ p of given counts; speed-up tends to p with n."""
    machine = parallel.Machine(alpha=1e-6, beta=1e9, gamma=2e-6, bus=1.25)
    one = {"run": "a", "dofs": 1000, "ranks": 1, "iterations": 10, "seconds": 0.05}
    two = {"ranks": 2, "messages": 300.0, "MB sent": 2.0, "reductions": 40.0, "seconds": 0.04}
    rows = [one, one | two]
    c = parallel.fit_operations(rows)
    assert c == pytest.approx(5e-6)
    assert parallel.predicted(c, one, machine) == pytest.approx(0.05)
    time = 1.25 * 0.025 + 300e-6 + 2e-3 + 40 * 2e-6
    assert parallel.predicted(c, one | two, machine) == pytest.approx(time)
    alone = parallel.Machine(1e-6, 1e9, 2e-6)
    assert parallel.speed_up(c, rows, 1000, 2, alone) == pytest.approx(0.05 / (time - 0.00625))
    assert parallel.speed_up(c, rows, 1e12, 64, alone) == pytest.approx(64, rel=0.01)


def test_tables_on_paper(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cuts through a square and a cube counted by hand; memory and too few unknowns are said."""
    monkeypatch.setattr(parallel, "SIZES", (2e6, 3e6))
    monkeypatch.setattr(parallel, "RANKS", (1, 4, 64, 1024))
    monkeypatch.setattr(parallel, "BEARABLE", math.inf)
    shared = {(r["body"], r["unknowns"], r["ranks"]): r for r in parallel.interfaces()}
    # Two lines of 1000 nodes; nine planes of 100² nodes.
    assert shared["square", "2e+06", 4]["shared unknowns"] == pytest.approx(2 * 1000 * 2)
    cube = shared["cube", "3e+06", 64]
    assert cube["shared unknowns"] == pytest.approx(9 * 100**2 * 3)
    assert cube["dense matrix [GiB]"] == pytest.approx(8 * 270e3**2 / 2**30)

    counts = {"messages": 0.0, "MB sent": 0.0, "reductions": 0.0}
    one = {"dofs": 1000, "ranks": 1, "iterations": 50, "seconds": 0.05, "GiB": 1.0}
    rows = [one, one | {"ranks": 2} | counts]
    bus = parallel.Machine(alpha=0.0, beta=1.0, gamma=0.0)
    row = parallel.by_multigrid(rows, 1e-6, bus)[0]
    assert row["1 rank [s]"] == row["64 ranks [s]"] == "memory"  # 1 MiB for an unknown
    assert row["1024 ranks [s]"] == "too few"
    monkeypatch.setattr(parallel, "NODE", math.inf)
    row = parallel.by_multigrid(rows, 1e-6, bus)[0]
    assert row["1 rank [s]"] == pytest.approx(50 * 2e6 * 1e-6)
    assert row["64 ranks [s]"] == pytest.approx(50 * 2e6 * 1e-6 / 64)


@pytest.mark.demo
def test_first_runs_begin_with_empty_caches(tmp_path: Path) -> None:
    """The README's script out of an empty folder: forms are compiled in its first run alone."""
    command = [sys.executable, str(ROOT / "benchmarks" / "tasks.py"), "--short", "--repeat", "1"]
    command += ["--output", str(tmp_path)]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    with open(tmp_path / "tasks.csv", newline="") as file:
        (row,) = csv.DictReader(file)
    assert row["script"] == "`README.md`" and row["pictures"] == "0"
    assert float(row["first run [s]"]) > float(row["again [s]"])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["half_cylinder", "ball", "tagged"])
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
def test_the_bolted_joint_runs(tmp_path: Path) -> None:
    """Every increment is solved, the same on two ranks, and what is beyond friction is named."""
    command = [sys.executable, str(ROOT / "benchmarks" / "bolted_joint.py"), "--short"]
    command += ["--repeat", "1", "--output", str(tmp_path)]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    with open(tmp_path / "bolted_joint.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    one, two = ([row for row in rows if row["ranks"] == ranks] for ranks in "12")
    assert len(one) == len(two) == 7
    assert [row["increment"] for row in one] == [row["increment"] for row in two]
    assert all(row[-1]["way"] == "refused: overload" for row in (one, two))


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
    command += ["--repeat", "1", "--output", str(tmp_path), "--runs", *large.RUNS]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    with open(tmp_path / "large.csv", newline="") as file:
        rows = {row["run"]: row for row in csv.DictReader(file)}
    assert all(row["iterations"] not in ("none", "failed") for row in rows.values())
    forces = [float(row["force"]) for row in rows.values() if row["force"]]
    assert len(forces) == 6
    assert forces == pytest.approx(forces[:1] * 6, rel=1e-6)


@pytest.mark.slow
def test_ranks_run(tmp_path: Path) -> None:
    """On one rank and on two: the same iterations of the package, the same forces to 1e-8."""
    command = [sys.executable, str(ROOT / "benchmarks" / "ranks.py"), "--short"]
    command += ["--repeat", "1", "--output", str(tmp_path)]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = timing.read(tmp_path / "ranks.csv")
    for name in {row["run"] for row in rows if "increments" in row["run"]}:
        for dofs in {row["dofs"] for row in rows}:
            one, two = (r for r in rows if (r["run"], r["dofs"]) == (name, dofs))
            assert one["iterations"] == two["iterations"]
            assert float(one["force"]) == pytest.approx(float(two["force"]), rel=1e-8)


@pytest.mark.slow
def test_parallel_runs(tmp_path: Path) -> None:
    """Small blocks on one rank and two: the same force to 1e-6, from residuals of 1e-9."""
    command = [sys.executable, str(ROOT / "benchmarks" / "run.py"), "parallel", "--short"]
    command += ["--repeat", "1", "--output", str(tmp_path)]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = timing.read(tmp_path / "parallel" / "parallel.csv")
    forces = [float(row["force"]) for row in rows if row["force"]]
    assert forces[::2] == pytest.approx(forces[1::2], rel=1e-6)
    assert float(rows[1]["messages"]) > 0
    assert "Where the time goes" in (tmp_path / "README.md").read_text()


def test_a_history_of_pressing_takes_few_iterations() -> None:
    """Contact that grows is no load that turns round: Newton's method goes on by the last tangent.

    Measured: 45 iterations in 40 increments; 78 if each starts where the last one ended, and the
    more the finer the mesh.
    """
    case = costs.Case(problems.half_cylinder(0.0, 0.25), 2, 10.0)
    assert case.package(0.2, 40)["iterations"] <= 55


def test_contact_at_large_strains_costs_few_newton_steps(tmp_path: Path) -> None:
    """Steps are counts, the same on every machine: over SNES on the bulk alone, a third more.

    Measured: 1.07 and 1.19 under a disc, 1.22 and 1.35 between two bodies, without friction and
    with it; over the package's own on the bulk alone 1.6 to 2.0.
    """
    command = [sys.executable, str(ROOT / "benchmarks" / "finite.py"), "--short"]
    subprocess.run(
        [*command, "--output", str(tmp_path)], check=True, env=environment(), timeout=120
    )
    with open(tmp_path / "finite.csv", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["run"] == "contact"]
    ratios = {(row["scene"], float(row["μ"])): float(row["steps / plain"]) for row in rows}
    assert ratios["disc", 0.0] < 1.2 and ratios["disc", 0.3] < 1.3
    assert ratios["two bodies", 0.0] < 1.3 and ratios["two bodies", 0.3] < 1.45
    assert max(float(row["steps / prescribed"]) for row in rows) < 2.2
