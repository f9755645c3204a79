"""The cases of the verification that have no demo: each meets its references.

References, tolerances and their reasons stand with the cases, in ``verification/``.
"""

import sys

import pytest
from running import ROOT

sys.path.insert(0, str(ROOT / "verification"))

import half_planes  # noqa: F401
import solids  # noqa: F401
import statics  # noqa: F401
from cases import CASES, Row

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
