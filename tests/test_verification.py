"""Verification cases without a demo agree with their references; the pages are complete.

References, tolerances and their reasons are in ``verification/``.
"""

import sys

import pytest
from mpi4py import MPI

from verification import effectivity, report, run, statics
from verification.cases import Case, Outcome, Row
from verification.run import CASES

pytestmark = pytest.mark.mpi


@pytest.mark.each
@pytest.mark.parametrize(
    "case",
    [
        pytest.param(c, id=c.compute.__name__, marks=[pytest.mark.slow] if c.slow else [])
        for c in CASES
    ],
)
def test_quantities_agree_with_their_references(case):
    """Every quantity of a case is within its tolerance."""
    case_result = case.run()
    missed = [row for row in case_result.rows if not row.is_met]
    assert case_result.rows and not missed, missed


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1.1])
def test_errors_above_the_tolerance_do_not_pass(value):
    """NaN, infinity and errors above the tolerance do not pass."""
    assert not Row("q", value, 1.0, "s", 0.05).is_met
    assert Row("q", 1.04, 1.0, "s", 0.05).is_met
    assert Row("q", 0.04, 0.0, "s", 0.05).error == 0.04


ONE_PROCESS = pytest.mark.skipif(
    MPI.COMM_WORLD.size > 1, reason="the page is written by one process"
)


@ONE_PROCESS
def test_missed_references_and_failed_cases_are_reported(tmp_path, monkeypatch, capsys):
    """Both are reported on the page and by the exit code, and later cases are run."""

    def failing_case():
        raise RuntimeError("no answer")

    rows = {"good": Row("good", 1.0, 1.0, "s", 0.1), "bad": Row("bad", 2.0, 1.0, "s", 0.1)}
    cases = [Case("Broken", "none", failing_case)]
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
        "Failed cases: Broken",
        "**bad: missed**",
    ):
        assert text in page
    assert page.count("missed**") == 1 and page.count("FAILED") == 1
    monkeypatch.setattr(run, "CASES", cases[1:2])
    assert run.main() == 0
    assert "missed" not in (tmp_path / "page.md").read_text().lower()


@ONE_PROCESS
def test_page_is_generated_from_the_stored_values():
    """The page is that of the stored values of all cases, and all agree with their references."""
    rows = report.read(run.PAGE.with_suffix(".csv"))
    stored = list(dict.fromkeys(row["case"] for row in rows))
    assert stored == [case.name for case in [*run.DEMOS, *run.CASES]]
    assert all(map(run.is_met, rows))
    assert run.page(rows) == run.PAGE.read_text()


def test_error_estimates_of_the_patch_test():
    """The only error of the patch test is the penalty; estimates are exact to first order."""
    computed = list(statics.patch().estimates())
    assert len(computed) == 6
    for e in computed:
        assert abs(e.estimated + e.true_error) <= 1.1 * e.true_error**2 + 1e-9, e


@ONE_PROCESS
def test_effectivity_page_is_generated_from_the_stored_values():
    """Every case has a row or a reason for none; the rows of a demo begin with its name."""
    rows = report.read(effectivity.PAGE.with_suffix(".csv"))
    assert effectivity.page(rows) == effectivity.PAGE.read_text()
    stored = {row["case"] for row in rows}
    for case in CASES:
        assert case.reason_without_estimates or case.name in stored, case.name
    for name, *_ in effectivity.TOTAL_ERROR_DEMOS:
        assert any(case.startswith(f"{name} ") for case in stored), name
