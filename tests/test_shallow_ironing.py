"""The study of shallow ironing: limits, stored rows, and the page."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
from mpi4py import MPI

from demos import shallow_ironing as demo
from verification import shallow_ironing as study
from verification import shallow_ironing_page as page

pytestmark = pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="of one process")

SIZES = np.array([0.4, 0.283, 0.2, 0.141])


# ---- limits and bars -----------------------------------------------------------------------------


EXACT = {"V(1)": 300.0, "V(1.5)": 380.0, "H(1.5)": 120.0}


# ---- stored runs ---------------------------------------------------------------------------------


def test_every_setting_has_a_stored_run() -> None:
    """Every setting has one row without failure."""
    rows = study.read_rows(study.STUDY)
    assert {row["name"] for row in rows} == set(study.settings()) and not any(
        row["failure"] for row in rows
    )
    assert len(rows) == len(study.settings())
    for row in rows:
        for name, value in asdict(study.settings()[row["name"]]).items():
            assert row[name] == ("" if value is None else str(value)), (row["name"], name)


def test_rows_are_those_of_their_curves() -> None:
    """Evaluation of the curves gives the rows, to 1e-4 N/mm; curves have seven digits."""
    curves = study.curves()
    for row in study.read_rows(study.STUDY):
        path = [dict(zip(("time", "V", "H"), point, strict=True)) for point in curves[row["name"]]]
        assert len(path) == int(row["increments done"])
        for name, value in study.evaluate(path).items():
            assert value == pytest.approx(float(row[name]), abs=1e-4)


def test_page_follows_from_stored_rows() -> None:
    """The page is that of the stored rows."""
    assert page.page(study.results()) == study.PAGE.read_text()


@pytest.mark.parametrize("times", ["twice", "half"])
@pytest.mark.parametrize("quantity", page.QUANTITIES)
def test_mesh_of_the_die_changes_forces_less_than_the_error(quantity: str, times: str) -> None:
    """Refining or coarsening the die alone changes the forces by less than their errors."""
    rows = study.results()
    moved = page.differences(rows, quantity)[f"cells of the die {times} as large{page.COARSE}"]
    _, error = page.converged_value(rows, quantity)
    assert 0.0 < abs(moved) < error


def test_demo_has_the_published_range() -> None:
    """The range of the five published results is that of the demo."""
    for i, key in enumerate([(1.0, "V"), (1.5, "V"), (1.5, "H")]):
        values = [points[i] for points in page.PUBLISHED.values()]
        assert demo.PUBLISHED[key] == (min(values), max(values))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["size 0.4", f"80 increments of pressing{page.COARSE}"])
def test_runs_are_reproduced(name: str) -> None:
    """Forces are reproduced to 1e-6, with residuals of 1e-9."""
    (row,) = (row for row in study.read_rows(study.STUDY) if row["name"] == name)
    computed, _ = study.run(study.settings()[name])
    if computed["dofs"] != int(row["dofs"]):
        pytest.skip("another gmsh makes another mesh")
    for quantity in study.QUANTITIES:
        if row[quantity]:
            assert computed[quantity] == pytest.approx(float(row[quantity]), rel=1e-6)
