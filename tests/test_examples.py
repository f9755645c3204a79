"""The examples, run as their user runs them: each asserts a number, and is short enough to read."""

from __future__ import annotations

import ast
import re
import subprocess
from pathlib import Path

import pytest
from mpi4py import MPI

from scenes.processes import ROOT, command, environment

pytestmark = pytest.mark.whole
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
NAMES = [path.stem for path in EXAMPLES]
MOST_LINES = 40

# Those that take the most to compile.
LONG = ("cam", "roller")
# What is printed, {} standing for the result and the reference behind it, which are compared here
# again; and the relative error that the example allows itself.
NUMBER = r"(-?[\d.]+(?:e[-+]\d+)?)"
PRINTED = {
    "ball_on_block": (r"largest pressure {} MPa\s+Hertz: {} MPa", 0.03),
    "block_on_floor": (r"T = {} N/mm, μ N = {} N/mm; points that stick: 0", 1e-5),
    "cam": (r"work of the torque {} mJ/mm, stored {} mJ/mm", 5e-3),
    "drum": (r"torque {} N mm/mm, μ R ∫p = {} N mm/mm", 5e-3),
    "hysteresis": (r"friction takes {} mJ/mm a cycle; area of the loop {} mJ/mm", 1e-5),
    "own_law": (r"closed up by {} mm; h ln\(p/p0\) = {} mm", 1e-5),
    "plastic_block": (r"force {} N/mm, limit {} N/mm", 1e-5),
    "roller": (r"turned by {} rad, way / R = {} rad", 1e-2),
    "stack": (r"plastic-brass: {} N/mm, the load is {} N/mm", 1e-9),
    "two_bodies": (r"the blocks shorten by {} mm, two springs by {} mm", 1e-5),
}


def run(path: Path, folder: Path, ranks: int) -> str:
    """What the script prints; it must end with 0."""
    words = command(ranks, path)
    done = subprocess.run(
        words, cwd=folder, env=environment(), capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_each_is_run_and_named() -> None:
    """Each of them is run below, and named in the page of examples."""
    assert sorted(PRINTED) == NAMES
    page = (ROOT / "docs" / "learn" / "examples.md").read_text()
    assert all(f"`{name}.py`" in page for name in NAMES)
    demos = [path.stem for path in (ROOT / "demos").glob("[!_]*.py")]
    assert all(f"`{name}`" in page or f"demos/{name}.py" in page for name in demos)


@pytest.mark.parametrize("path", EXAMPLES, ids=NAMES)
def test_they_are_short(path: Path) -> None:
    """At most 40 lines that are not blank, and a docstring whose first line says what is shown."""
    text = path.read_text()
    assert sum(bool(line.strip()) for line in text.splitlines()) <= MOST_LINES
    docstring = ast.get_docstring(ast.parse(text))
    assert docstring is not None and docstring.splitlines()[0].endswith(".")


@pytest.mark.parametrize("path", EXAMPLES, ids=NAMES)
def test_they_use_public_names_alone(path: Path) -> None:
    """Of the package they import the package, and nothing with an underscore in front."""
    tree = ast.parse(path.read_text())
    imported = [
        alias.name for n in ast.walk(tree) if isinstance(n, ast.Import) for alias in n.names
    ]
    imported += [str(n.module) for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)]
    assert "fenics_contact" in imported
    ours = [name for name in imported if name.startswith("fenics_contact.")]
    hidden = [n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute) and n.attr[0] == "_"]
    assert ours == [] and hidden == []


@pytest.mark.demo
@pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts processes of its own")
@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.stem, marks=[pytest.mark.slow] * (path.stem in LONG))
        for path in EXAMPLES
    ],
)
def test_number(path: Path, tmp_path: Path) -> None:
    """The asserted number, on one rank and on two the same; nothing is written."""
    pattern, tolerance = PRINTED[path.stem]
    found = []
    for ranks in (1, 2):
        printed = run(path, tmp_path, ranks)
        assert len(printed.splitlines()) <= 2, printed
        match = re.search(pattern.replace("{}", NUMBER), printed)
        assert match is not None, printed
        value, reference = map(float, match.groups())
        assert value == pytest.approx(reference, rel=tolerance)
        found.append(value)
    assert found[1] == pytest.approx(found[0], rel=1e-5)
    assert list(tmp_path.iterdir()) == []
