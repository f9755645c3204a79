"""The cases of the verification that have no demo: each meets its references.

References, tolerances and their reasons stand with the cases, in ``verification/``.
"""

import sys

import pytest
from mpi4py import MPI

from verification import effectivity, run, statics
from verification.cases import Case, Outcome, Row
from verification.run import CASES

pytestmark = pytest.mark.mpi


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(c, id=c.compute.__name__, marks=[pytest.mark.slow] if c.slow else [])
        for c in CASES
    ],
)
def test_case(case):
    """Every quantity within its tolerance."""
    made = case.run()
    missed = [row for row in made.rows if not row.passed]
    assert made.rows and not missed, missed


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1.1])
def test_what_is_off_or_no_number_is_a_miss(value):
    """A case cannot pass by breaking."""
    assert not Row("q", value, 1.0, "s", 0.05).passed
    assert Row("q", 1.04, 1.0, "s", 0.05).passed
    assert Row("q", 0.04, 0.0, "s", 0.05).error == 0.04


ONE_PROCESS = pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="the page is made by one process")


@ONE_PROCESS
def test_misses_and_failures_are_shown(tmp_path, monkeypatch, capsys):
    """They stand on the page and in the exit code, and the cases after them are still run."""

    def broken():
        raise RuntimeError("no answer")

    rows = {"good": Row("good", 1.0, 1.0, "s", 0.1), "bad": Row("bad", 2.0, 1.0, "s", 0.1)}
    cases = [Case("Broken", "none", broken)]
    cases += [
        Case(name, "none", lambda row=row: Outcome((row,), "a mesh", 7))
        for name, row in rows.items()
    ]
    monkeypatch.setattr(run, "DEMOS", [])
    monkeypatch.setattr(run, "CASES", cases)
    monkeypatch.setattr(run, "PAGE", tmp_path / "page.md")
    monkeypatch.setattr(sys, "argv", ["run.py"])
    assert run.main() == 1
    page = (tmp_path / "page.md").read_text()
    assert page == page.rstrip() + "\n"
    for text in (
        "1 of 2 quantities",
        "RuntimeError: no answer",
        "Missed: bad: bad",
        "failed: Broken",
    ):
        assert text in page
    assert page.count("| **MISSED** |") == 1 and page.count("| met |") == 1
    monkeypatch.setattr(run, "CASES", cases[1:2])
    assert run.main() == 0
    assert "MISSED" not in (tmp_path / "page.md").read_text()


@ONE_PROCESS
def test_the_page_has_all_cases():
    """The page that is kept is of these cases, and nothing on it is missed."""
    page = run.PAGE.read_text()
    titles = [line.removeprefix("## ") for line in page.splitlines() if line.startswith("## ")]
    assert titles == [case.name for case in [*run.DEMOS, *run.CASES]]
    assert "MISSED" not in page and "FAILED" not in page


def test_estimates_of_a_case():
    """The patch test's only error is that of enforcement; one round of it leaves its square."""
    found = list(statics.patch().estimates())
    assert len(found) == 6
    for e in found:
        assert abs(e.estimated + e.true) <= 1.1 * e.true**2 + 1e-9, e


@ONE_PROCESS
def test_the_page_of_estimates_has_all_cases():
    """Every case has a row or a reason; the demos' rows begin with the demo's name."""
    page = effectivity.PAGE.read_text()
    rows = [line for line in page.splitlines() if line.startswith("| ")]
    for case in CASES:
        assert any(row.startswith(f"| {case.name} | {case.budget}") for row in rows), case.name
    for case in run.DEMOS:
        assert not case.budget or f"| {case.name} | {case.budget} |" in rows, case.name
    for name, *_ in effectivity.WHOLES:
        assert any(row.startswith(f"| {name} ") for row in rows), name
