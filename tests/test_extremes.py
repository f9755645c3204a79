"""The study of the extremes, the short runs of it: nothing is wrong, and what is refused says why.

References and tolerances are those of ``verification/extremes.py``.
"""

import sys

import pytest
from mpi4py import MPI
from running import ROOT

sys.path.insert(0, str(ROOT / "verification"))

from extremes import Row, Trial, pressed, trials

# Some of every group; all of it takes minutes.
CHOSEN = {
    "stiffness k_n h/E, patch": ("1e-03", "1e+03", "1e+08"),
    "stiffness k_n h/E, cushion, μ = 0": ("1e+06",),
    "stiffness k_n h/E, cushion, μ = 0.3": ("1e+04",),
    "k_t/k_n, μ = 0.3": ("1e-06", "1e+03"),
    "friction μ": ("10",),
    "Poisson's ratio ν": ("0.4999, P2",),
    "units, E": ("1e-06", "1e+15"),
    "units, length": ("1e-09", "1e+06"),
    "gap, in body lengths": ("1000",),
    "increments": ("10",),
    "loads": ("reversed aside", "lifted off", "first increment without contact", "0 times"),
    "first touch of one node, down by": ("1e-12",),
    "free bodies": ("held by friction", "pushed beyond friction", "no friction"),
    "mesh size ratio": ("10000, patch",),
    "aspect ratio of cells": ("1000", "1/1000"),
    "degree": ("P3, patch",),
    "Γc all closed": ("μ = 0.3",),
    "Γc all open": ("nothing in reach",),
}
TRIALS = [t for t in trials() if t.case in CHOSEN.get(t.group, ())]
MORE = [Trial("loads", f"{load:g} times", pressed(10, load=load), "patch") for load in (1e3, -1.0)]


@pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="scenes of other tests run in parallel")
@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize("trial", TRIALS + MORE, ids=lambda t: f"{t.group} {t.case}")
def test_extreme(trial, method):
    """Verified within the tolerance of the reference, or refused in words."""
    trial.methods = (method,)
    (row,) = trial.run()
    assert not row.wrong, row
    refused = trial.case in ("pushed beyond friction", "no friction", "-1 times")
    assert row.outcome.startswith("refused: " if refused else "verified"), row


def test_nothing_of_the_list_is_missing():
    """Every name above is that of a trial."""
    assert len(TRIALS) == sum(len(cases) for cases in CHOSEN.values())


@pytest.mark.parametrize("error", [float("nan"), float("inf"), 1e-5])
def test_what_is_off_is_wrong(error):
    """A solution that misses its reference, or none to compare, does not pass; nor a crash."""
    assert Row("g", "c", "m", "verified", "", 1, error, "reference", 1e-6, 0.0).wrong
    assert Row("g", "c", "m", "KeyError: x", "", 1, 0.0, "reference", 1e-6, 0.0).wrong
