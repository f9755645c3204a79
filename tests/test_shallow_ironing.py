"""The study of shallow ironing: its limits and bars, what it stores, and what the page says."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
from mpi4py import MPI

from demos import shallow_ironing as demo
from scenes.processes import ROOT
from verification import shallow_ironing as study
from verification import shallow_ironing_page as page

pytestmark = pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="of one process")

SIZES = np.array([0.4, 0.283, 0.2, 0.141])


# ---- limits and bars -----------------------------------------------------------------------------


@pytest.mark.parametrize("order", [0.8, 1.0, 2.0, 3.5])
def test_the_limit_of_one_order(order: float) -> None:
    """Exact but for round-off; the bar is 1.25 times the finest mesh's error."""
    found = page.richardson(SIZES, 300.0 - 7.0 * SIZES**order)
    assert found.order == pytest.approx(order, rel=1e-9)
    assert found.value == pytest.approx(300.0, rel=1e-12)
    assert found.error == pytest.approx(1.25 * 7.0 * SIZES[-1] ** order, rel=1e-6)


@pytest.mark.parametrize("second", [-3.0, 0.0, 9.0])
@pytest.mark.parametrize("order", [1.0, 1.5, 2.0])
def test_the_bar_covers_a_second_order(order: float, second: float) -> None:
    """The next term is no part of the fit: the limit moves, by less than the bar."""
    values = 300.0 + 7.0 * SIZES**order + second * SIZES ** (order + 1)
    found = page.richardson(SIZES, values)
    assert np.isfinite(found.order) and abs(found.value - 300.0) <= found.error


@pytest.mark.parametrize("values", [(1.0, 1.2, 1.1, 1.3), (1.0, 1.1, 1.3, 1.7), (1, 1, 1, 1)])
def test_no_order_no_extrapolation(values: tuple[float, ...]) -> None:
    """To and fro, growing, the same: the finest value, and a bar by the range of all."""
    found = page.richardson(SIZES, values)
    assert np.isnan(found.order) and found.value == values[-1]
    expected = 3 * (max(values) - min(values)) / (SIZES[0] / SIZES[-1] - 1)
    assert found.error == pytest.approx(expected)


def test_ripple_is_taken_off() -> None:
    """A cosine of ten waves on a parabola: the parabola, to a fifth of the cosine that is seen."""
    t = np.linspace(0.0, 1.6, 401)
    smooth = 100.0 + 20.0 * (t - 1.5) - 30.0 * (t - 1.5) ** 2
    V = smooth + 2.0 * np.cos(2 * np.pi * (t - 1.5) / 0.02)
    path = [{"time": a, "V": b, "H": 0.3 * b} for a, b in zip(t, V, strict=True)]
    found = study.evaluate(path)
    assert found["V(1.5)"] == pytest.approx(102.0)
    for name, part in (("V", 1.0), ("H", 0.3)):
        assert found[f"fitted {name}(1.5)"] == pytest.approx(100.0 * part, abs=0.4 * part)
        assert found[f"ripple of {name}"] == pytest.approx(2.0 * part, rel=0.2)
    assert study.evaluate(path[:260]).keys() == {"V(1)"}


EXACT = {"V(1)": 300.0, "V(1.5)": 380.0, "H(1.5)": 120.0}


def made_up(setting: demo.Setting) -> dict[str, float]:
    """What a run would find whose errors are known, each of one factor: in the limit `EXACT`."""
    give = 0.0 if setting.enforcement == "augmented" else 4.0 * setting.size / 0.2
    give /= setting.stiffness
    points = 0.3 if setting.quadrature is None else 0.3 * 4.0 / setting.quadrature
    steps = 0.1 * 250 * setting.size / 0.2 / setting.increments
    off = 20.0 * setting.size**1.5 - give + points + steps + 0.4 * 20 / setting.pressing
    off += 0.2 if setting.side == "slab" else 0.0
    found = {page.QUANTITIES[name]: value + off for name, value in EXACT.items()}
    return found | {"ripple of V": 0.1, "ripple of H": 0.1}


def test_the_bars_cover_the_truth() -> None:
    """Of runs with known errors; they are less than what the springs give way, taken off."""
    rows = {name: made_up(setting) for name, setting in study.settings().items()}
    for name, exact in EXACT.items():
        value, error = page.converged(rows, name)
        assert abs(value - exact) <= error < 4.0


# ---- what is stored ------------------------------------------------------------------------------


def test_every_run_is_there() -> None:
    """As it is asked for, once, and none failed."""
    rows = study.read(study.STUDY)
    assert {row["name"] for row in rows} == set(study.settings()) and not any(
        row["failure"] for row in rows
    )
    assert len(rows) == len(study.settings())
    for row in rows:
        for name, value in asdict(study.settings()[row["name"]]).items():
            assert row[name] == ("" if value is None else str(value)), (row["name"], name)


def test_rows_are_those_of_their_curves() -> None:
    """What is evaluated anew is in the rows: 1e-4 N/mm, curves have seven digits."""
    curves = study.curves()
    for row in study.read(study.STUDY):
        path = [dict(zip(("time", "V", "H"), point, strict=True)) for point in curves[row["name"]]]
        assert len(path) == int(row["increments done"])
        for name, value in study.evaluate(path).items():
            assert value == pytest.approx(float(row[name]), abs=1e-4)


def test_the_page_says_what_was_found() -> None:
    """All its tables are those of the rows."""
    text = (ROOT / "docs" / "finite.md").read_text()
    for made in (page.answers, page.budget, page.factors):
        assert made(study.results()) in text, made.__name__


@pytest.mark.parametrize("times", ["twice", "half"])
@pytest.mark.parametrize("quantity", page.QUANTITIES)
def test_meshes_apart_move_no_more_than_the_error(quantity: str, times: str) -> None:
    """The die's alone, coarser and finer than where both are refined together."""
    rows = study.results()
    moved = page.differences(rows, quantity)[f"cells of the die {times} as large{page.COARSE}"]
    _, error = page.converged(rows, quantity)
    assert 0.0 < abs(moved) < error


def test_the_demo_has_the_spread_that_is_published() -> None:
    """Least and largest of the five."""
    for i, key in enumerate([(1.0, "V"), (1.5, "V"), (1.5, "H")]):
        values = [points[i] for points in page.PUBLISHED.values()]
        assert demo.PUBLISHED[key] == (min(values), max(values))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["size 0.4", f"80 increments of pressing{page.COARSE}"])
def test_runs_are_repeated(name: str) -> None:
    """1e-6 of the forces: residuals end at 1e-9 of them."""
    (row,) = (row for row in study.read(study.STUDY) if row["name"] == name)
    found, _ = study.run(study.settings()[name])
    if found["dofs"] != int(row["dofs"]):
        pytest.skip("another gmsh makes another mesh")
    for quantity in study.QUANTITIES:
        if row[quantity]:
            assert found[quantity] == pytest.approx(float(row[quantity]), rel=1e-6)
