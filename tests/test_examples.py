"""The examples are run as scripts; each asserts a number, and is short."""

from __future__ import annotations

import ast
import re
import subprocess
from pathlib import Path

import pytest
from mpi4py import MPI

from scenes.processes import ROOT, command, subprocess_environment

pytestmark = pytest.mark.whole
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
NAMES = [path.stem for path in EXAMPLES]
MOST_LINES = 40

# Examples with the longest compilation, and examples that run on two ranks by default.
LONG = ("cam", "roller")
ON_TWO_RANKS = ("ball_on_block", "two_bodies")
# The printed text, with {} for the result and then its reference, which are compared here again,
# and the relative tolerance of the example.
NUMBER = r"(-?[\d.]+(?:e[-+]\d+)?)"
PRINTED = {
    "ball_on_block": (r"largest pressure {} MPa\s+Hertz: {} MPa", 0.03),
    "block_on_floor": (r"T = {} N/mm, μ N = {} N/mm; points that stick: 0", 1e-5),
    "cam": (r"work of the torque {} mJ/mm, stored {} mJ/mm", 5e-3),
    "drum": (r"torque {} N mm/mm, μ R ∫p = {} N mm/mm", 5e-3),
    "hysteresis": (r"dissipation {} mJ/mm per cycle; area of the loop {} mJ/mm", 1e-5),
    "own_law": (r"closed up by {} mm; h ln\(p/p0\) = {} mm", 1e-5),
    "plastic_block": (r"force {} N/mm, limit {} N/mm", 1e-5),
    "roller": (r"turned by {} rad, travel / R = {} rad", 1e-2),
    "stack": (r"plastic-brass: {} N/mm, the load is {} N/mm", 1e-9),
    "two_bodies": (r"the blocks shorten by {} mm, two springs by {} mm", 1e-5),
}


def run(path: Path, folder: Path, ranks: int) -> str:
    """Return the output of the script, whose exit code must be 0."""
    words = command(ranks, path)
    done = subprocess.run(
        words, cwd=folder, env=subprocess_environment(), capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_every_example_is_tested_and_documented() -> None:
    """Every example is run below; examples and demos are listed in the page of examples."""
    assert sorted(PRINTED) == NAMES
    page = (ROOT / "docs" / "learn" / "examples.md").read_text()
    assert all(f"`{name}.py`" in page for name in NAMES)
    demos = [path.stem for path in (ROOT / "demos").glob("[!_]*.py")]
    assert all(f"`{name}`" in page or f"demos/{name}.py" in page for name in demos)


def test_examples_are_short_and_have_a_docstring() -> None:
    """Examples have at most 40 nonblank lines, and a docstring with a one-line summary."""
    for path in EXAMPLES:
        text = path.read_text()
        assert sum(bool(line.strip()) for line in text.splitlines()) <= MOST_LINES, path
        docstring = ast.get_docstring(ast.parse(text))
        assert docstring is not None and docstring.splitlines()[0].endswith("."), path


def test_examples_do_not_import_submodules() -> None:
    """Examples import `fenics_contact`, and none of its submodules."""
    for path in EXAMPLES:
        tree = ast.parse(path.read_text())
        imported = [
            alias.name for n in ast.walk(tree) if isinstance(n, ast.Import) for alias in n.names
        ]
        imported += [str(n.module) for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)]
        assert "fenics_contact" in imported, path
        assert not [name for name in imported if name.startswith("fenics_contact.")], path


@pytest.mark.demo
@pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts processes of its own")
@pytest.mark.parametrize(
    ("path", "ranks"),
    [
        pytest.param(path, ranks, id=f"{path.stem}-{len(ranks)}", marks=[pytest.mark.slow] * slow)
        for path in EXAMPLES
        for ranks, slow in (
            ((1,), path.stem in LONG + ON_TWO_RANKS),
            ((1, 2), path.stem not in ON_TWO_RANKS),
        )
    ],
)
def test_examples_print_the_references(path: Path, ranks: tuple[int, ...], tmp_path: Path) -> None:
    """The printed result equals its reference, on two ranks to 1e-5; no files are written."""
    pattern, tolerance = PRINTED[path.stem]
    computed = []
    for number in ranks:
        printed = run(path, tmp_path, number)
        assert len(printed.splitlines()) <= 2, printed
        match = re.search(pattern.replace("{}", NUMBER), printed)
        assert match is not None, printed
        value, reference = map(float, match.groups())
        assert value == pytest.approx(reference, rel=tolerance)
        computed.append(value)
    assert computed[-1] == pytest.approx(computed[0], rel=1e-5)
    assert list(tmp_path.iterdir()) == []
