"""A selection of extreme parameters: solutions agree with references, refusals state a reason.

References and tolerances are those of ``verification/extremes.py``.
"""

import dataclasses

import numpy as np
import pytest
from mpi4py import MPI

from scenes.comparison import is_close
from verification.extreme_scenes import press_block, solve_on_ranks
from verification.extremes import METHODS, PAGE, Row, Trial, all_trials, page, read_stored_rows

COMM = MPI.COMM_WORLD
# A quick selection of every group; all groups take minutes.
CHOSEN = {
    "block on a plane, k_n h/E": (
        "1e-03",
        "1e+08",
    ),
    "block on a disc, μ = 0, k_n h/E": ("1e+06",),
    "block on a disc, μ = 0.3, k_n h/E": ("1e+03",),
    "block on a disc, μ = 0.3, k_t/k_n": ("1e+03",),
    "block on a disc, μ": ("10",),
    "block on a disc, ν": ("0.4999, P2",),
    "block on a disc, unit of E": ("1e+15",),
    "block on a disc, unit of length": ("1e-09",),
    "block on a plane, gap / height": ("1000",),
    "block on a plane, number of increments": ("10",),
    "block on a plane, load path": (
        "tangential load reversal",
        "lift-off",
        "first increment without contact",
        "load × 0",
    ),
    "block on a disc, first contact of one node, approach": ("1e-12",),
    "block without Dirichlet conditions": (
        "constrained by friction",
        "load above the friction limit",
        "frictionless",
    ),
    "ratio of cell sizes": ("10000, plane",),
    "block on a plane, aspect ratio of cells": (
        "1000",
        "1/1000",
    ),
    "polynomial degree": ("P3, plane",),
    "all points of Γc closed": ("μ = 0.3",),
    "all points of Γc open": ("lifted block",),
    "3D, block on a plane, k_n h/E": ("1e+08",),
    "3D, block on a ball, μ = 0.3, k_n h/E": ("1e+04",),
    "3D, units": ("E 1e-06",),
    "3D, block without Dirichlet conditions": ("constrained by friction",),
    "two bodies, flat, k_n h/E": ("1e+08",),
    "two bodies, rounded, μ = 0, k_n h/E": ("1e+04",),
    "two bodies, ratio of moduli": (
        "1e-06, rounded",
        "1e+06, flat",
    ),
    "two bodies, gap / width": ("1000",),
    "rigid cylinder on a half-plane, peak pressure, k_n h/E": (
        "1e-03",
        "1e+01",
        "1e+08",
        "1e+01, augmented",
    ),
}
# With finite kinematics, with the methods of each.
FINITE = {
    "rotating disc, rotation and increments": (
        "360° in 1",
        "360° in 4",
        "360° in 12, μ = 1",
    ),
    "sliding over facets": ("plane of 1000 facets, 10 increments",),
    "sliding off the end of a plate": ("μ = 0, 10 increments",),
    "rubber column compressed to 60 %": (
        "k_n h/E = 1e-03",
        "k_n h/E = 1e+06",
        "to 10 %, one increment",
        "gap of 1000 heights",
    ),
    "disc pressed, slid and rotated, μ = 1, k_n h/E": ("1e+00, rubber",),
    "first contact, gap / height": (
        "1000",
        "1000, prescribed force",
    ),
    "number of increments": (
        "frictionless indentation in 1",
        "disc rotated by 90° in 1",
    ),
}
# Two bodies with finite kinematics.
BODIES = {
    "both rotated by 360°, increments": ("36, μ = 1, Γc 20 times finer",),
    "sliding over facets": ("110 in 10, 1.2 slave per master facet, μ = 0",),
    "sliding off the end, increments": (
        "10, μ = 0.3",
        "10, μ = 0.3, Γc 20 times finer",
    ),
    "lift-off after sliding, μ": ("0.3, upper body 1e6 times stiffer",),
    "rubber columns compressed to 60 %": (
        "k_n h/E = 1e-03",
        "k_n h/E = 1e+06, Γc 20 times finer",
        "k_n h/E = 1e+01, Γc 20 times coarser, 40 points per facet",
        "k_n h/E = 1e+01, confined, ratio of moduli 1e+06",
    ),
    "block pressed, slid and rotated, μ = 1, k_n h/E": (
        "1e+00, rubber",
        "1e+01, rubber, Γc 20 times finer",
        "1e+01, rubber, lower body 1e3 times stiffer",
    ),
    "stiff plate against a rigid plane, ratio of moduli": (
        "1e+06, μ = 0, k_n h/E = 1e+03, 8 facets on 4",
        "1e+06, μ = 0.3, k_n h/E = 1e+01, 20 facets on 2",
    ),
    "first contact, gap / height": (
        "1000",
        "1000, prescribed force",
    ),
    "number of increments": ("frictionless indentation in 1",),
}
REFUSED = ("load above the friction limit", "frictionless", "load × -1")
FAST = [t for t in all_trials() if t.case in CHOSEN.get(t.group, ())]
LARGE = [
    dataclasses.replace(t, methods=(method,))
    for t in all_trials()
    for start, chosen in (("finite", FINITE), ("two bodies, finite", BODIES))
    for method in t.methods
    if t.case in chosen.get(t.group.removeprefix(f"{start} kinematics, "), ()) and not t.slow
]
MORE = [
    Trial("load path", f"load × {load:g}", press_block(10, load=load), "patch")
    for load in (1e3, -1.0)
]


@pytest.mark.each
@pytest.mark.skipif(COMM.size > 1, reason="scenes of other tests run in parallel")
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("trial", FAST + MORE, ids=lambda t: f"{t.group} {t.case}")
def test_extreme_parameters(trial, method):
    """The solution is within the tolerance of the reference, or the error states a reason."""
    (row,) = dataclasses.replace(trial, methods=(method,)).run()
    assert not row.has_failed, row
    refused = trial.case in REFUSED
    assert row.outcome.startswith("refused: " if refused else "verified"), row


@pytest.mark.skipif(COMM.size > 1, reason="scenes of other tests run in parallel")
@pytest.mark.parametrize("trial", LARGE, ids=lambda t: f"{t.group} {t.case} {t.methods[0]}")
def test_extreme_parameters_with_finite_kinematics(trial):
    """The solution is verified and within the tolerance of the reference."""
    (row,) = trial.run()
    assert not row.has_failed, row
    assert row.outcome == "verified" and row.reference, row


def test_selected_trials_exist():
    """Every selected name is the name of a trial."""
    assert len(FAST) == sum(len(cases) for cases in CHOSEN.values())
    selected_cases = [cases for chosen in (FINITE, BODIES) for cases in chosen.values()]
    assert len({(t.group, t.case) for t in LARGE}) == sum(map(len, selected_cases))


@pytest.mark.mpi
@pytest.mark.skipif(COMM.size == 1, reason="needs several ranks")
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", ["disc", "two bodies"])
def test_contact_on_one_rank_only(kind, method):
    """The solution does not depend on the partition, within 1e-8 (solver tolerance 1e-9)."""
    _, rows, facets = solve_on_ranks(kind, 10.0, 0.3, method)
    assert np.count_nonzero(facets) == 1
    _, spread, _ = solve_on_ranks(kind, 10.0, 0.3, method, separate_ranks=False)
    assert is_close(rows, spread, 1e-8, scale=np.abs(rows[:, 2:]).max())


def test_page_agrees_with_stored_rows():
    """The page agrees with the stored rows, which contain all trials."""
    rows = read_stored_rows(PAGE.with_suffix(".csv"))
    assert list(rows) == [(t.group, t.case, method) for t in all_trials() for method in t.methods]
    assert page(list(rows.values())) == PAGE.read_text(encoding="utf-8")


@pytest.mark.parametrize("error", [float("nan"), float("inf"), 1e-5])
def test_errors_above_the_tolerance_fail(error):
    """A run fails if its error is above the tolerance or not finite, or if it raises KeyError."""
    assert Row("g", "c", "m", "verified", "", 1, error, "reference", 1e-6, 0.0).has_failed
    assert Row("g", "c", "m", "KeyError: x", "", 1, 0.0, "reference", 1e-6, 0.0).has_failed
