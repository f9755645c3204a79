"""The study of the extremes, the short runs of it: nothing is wrong, and what is refused says why.

References and tolerances are those of ``verification/extremes.py``.
"""

import dataclasses

import numpy as np
import pytest
from mpi4py import MPI

from scenes.comparing import close
from verification.extreme_scenes import pressed, ranked
from verification.extremes import METHODS, PAGE, Row, Trial, known, page, trials

COMM = MPI.COMM_WORLD
# Some of every group, and what is cheap; all of it takes minutes.
CHOSEN = {
    "stiffness k_n h/E, patch": ("1e-03", "1e+08"),
    "stiffness k_n h/E, cushion, μ = 0": ("1e+06",),
    "stiffness k_n h/E, cushion, μ = 0.3": ("1e+03",),
    "k_t/k_n, μ = 0.3": ("1e+03",),
    "friction μ": ("10",),
    "Poisson's ratio ν": ("0.4999, P2",),
    "units, E": ("1e+15",),
    "units, length": ("1e-09",),
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
    "3D, stiffness k_n h/E, patch": ("1e+08",),
    "3D, stiffness k_n h/E, ball, μ = 0.3": ("1e+04",),
    "3D, units": ("E 1e-06",),
    "3D, free bodies": ("held by friction",),
    "two bodies, stiffness k_n h/E, patch": ("1e+08",),
    "two bodies, stiffness k_n h/E, round, μ = 0": ("1e+04",),
    "two bodies, stiffness of one over that of the other": ("1e-06, round", "1e+06, patch"),
    "two bodies, gap, in body lengths": ("1000",),
    "peak pressure of a roller, k_n h/E": ("1e-03", "1e+01", "1e+08", "1e+01, multipliers"),
}
# Of those with finite kinematics, by methods of their own.
FINITE = {
    "a disc turned, in increments": ("360° in 1", "360° in 4", "360° in 12, μ = 1"),
    "facets slid over": ("1000 of a plane, in 10",),
    "a block dragged off the end of a plate": ("μ = 0, in 10",),
    "a column of rubber, to 60 % of its height": (
        "k_n h/E = 1e-03",
        "k_n h/E = 1e+06",
        "10 %, in one increment",
        "from 1000 heights away",
    ),
    "a disc pressed in, dragged and turned, k_n h/E, μ = 1": ("1e+00, rubber",),
    "first touch from afar, in body heights": ("1000", "1000, by force"),
    "increments": ("pressed in without friction in 1", "a disc turned by 90° in 1"),
}
# Of two bodies with finite kinematics.
BODIES = {
    "both turned by 360°, in increments": ("36, μ = 1, Γc 20 times as fine",),
    "facets slid over": ("110 in 10, 1.2 of Γc on each, μ = 0",),
    "dragged off the end, in increments": ("10, μ = 0.3",),
    "lifted off after a drag, μ": ("0.3, upper 1e6 times as stiff",),
    "columns of rubber, to 60 % of their height": (
        "k_n h/E = 1e-03",
        "k_n h/E = 1e+06, Γc 20 times as fine",
        "k_n h/E = 1e+01, Γc 20 times as coarse, 40 points a facet",
        "k_n h/E = 1e+01, sides held, upper 1e+06 times as stiff",
    ),
    "a block pressed, dragged and rocked, k_n h/E, μ = 1": (
        "1e+00, rubber",
        "1e+01, rubber, Γc 20 times as fine",
        "1e+01, rubber, lower 1e3 times as stiff",
    ),
    "under a plate, so many times as stiff, against a rigid one": (
        "1e+06, μ = 0, k_n h/E = 1e+03, 8 facets under 4",
        "1e+06, μ = 0.3, k_n h/E = 1e+01, 20 facets under 2",
    ),
    "first touch from afar, in body heights": ("1000", "1000, by force"),
    "increments": ("pressed in without friction in 1",),
}
REFUSED = ("pushed beyond friction", "no friction", "-1 times")
FAST = [t for t in trials() if t.case in CHOSEN.get(t.group, ())]
LARGE = [
    dataclasses.replace(t, methods=(method,))
    for t in trials()
    for start, chosen in (("finite", FINITE), ("two bodies, finite", BODIES))
    for method in t.methods
    if t.case in chosen.get(t.group.removeprefix(f"{start} kinematics, "), ()) and not t.slow
]
MORE = [Trial("loads", f"{load:g} times", pressed(10, load=load), "patch") for load in (1e3, -1.0)]


@pytest.mark.skipif(COMM.size > 1, reason="scenes of other tests run in parallel")
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("trial", FAST + MORE, ids=lambda t: f"{t.group} {t.case}")
def test_extreme(trial, method):
    """Verified within the tolerance of the reference, or refused in words."""
    (row,) = dataclasses.replace(trial, methods=(method,)).run()
    assert not row.wrong, row
    refused = trial.case in REFUSED
    assert row.outcome.startswith("refused: " if refused else "verified"), row


@pytest.mark.skipif(COMM.size > 1, reason="scenes of other tests run in parallel")
@pytest.mark.parametrize("trial", LARGE, ids=lambda t: f"{t.group} {t.case} {t.methods[0]}")
def test_extreme_of_finite_kinematics(trial):
    """Verified within the tolerance of the reference."""
    (row,) = trial.run()
    assert not row.wrong, row
    assert row.outcome == "verified" and row.reference, row


def test_nothing_of_the_list_is_missing():
    """Every name above is that of a trial."""
    assert len(FAST) == sum(len(cases) for cases in CHOSEN.values())
    wanted = [cases for chosen in (FINITE, BODIES) for cases in chosen.values()]
    assert len({(t.group, t.case) for t in LARGE}) == sum(map(len, wanted))


@pytest.mark.mpi
@pytest.mark.skipif(COMM.size == 1, reason="there is one rank only")
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", ["cushion", "pair"])
def test_contact_on_one_rank_only(kind, method):
    """The same as distributed otherwise: 1e-8, two solutions within the solver's 1e-9."""
    _, rows, facets = ranked(kind, 10.0, 0.3, method)
    assert np.count_nonzero(facets) == 1
    _, spread, _ = ranked(kind, 10.0, 0.3, method, apart=False)
    assert close(rows, spread, 1e-8, scale=np.abs(rows[:, 2:]).max())


def test_rows_of_some_groups_take_the_place_of_those_before():
    """What is read back of the table is what it was made of, to the digit."""
    rows = known(PAGE.with_suffix(".csv"))
    text = PAGE.read_text(encoding="utf-8")
    assert page(list(rows.values())) == text


@pytest.mark.parametrize("error", [float("nan"), float("inf"), 1e-5])
def test_what_is_off_is_wrong(error):
    """A solution that misses its reference, or none to compare, does not pass; nor a crash."""
    assert Row("g", "c", "m", "verified", "", 1, error, "reference", 1e-6, 0.0).wrong
    assert Row("g", "c", "m", "KeyError: x", "", 1, 0.0, "reference", 1e-6, 0.0).wrong
