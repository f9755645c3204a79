"""HTML tables for notebooks are well-formed, have the object's values, and escape names."""

import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pytest

import fenics_contact as fc
from fenics_contact.methods.attempt import Attempt
from scenes.block_on_ball import BlockOnBall
from scenes.elasticity import stress

pytestmark = pytest.mark.two_ranks

NAME = "<b>one & two</b>"


@pytest.fixture(scope="module")
def solved_block():
    """Return a block moved back and forth, with markup as contact name, and its last step."""
    setup = BlockOnBall(contact={"name": NAME}, degree=2)
    setup.problem.small_displacement_tolerance = np.inf
    *_, step = fc.increments(setup.problem, setup.load, 0, 2, steps=4, estimate=True)
    return setup, step


def parse_table(thing):
    """Return title, rows and paragraphs of the table of an object, by an XML parser."""
    root = ElementTree.fromstring(f"<div>{thing._repr_html_()}</div>")
    rows = [[cell.text for cell in row] for row in root.iter("tr")]
    assert len({len(row) for row in rows}) == 1
    assert {e.tag for e in root.iter()} <= set("div table caption thead tbody tr th td p".split())
    return root.find(".//caption").text, rows, [p.text for p in root.iter("p")]


def test_table_of_a_step(solved_block):
    """Summary and table of a step have both the resultant and the integral of friction ∫|τ|."""
    _, step = solved_block
    r = step.contacts[NAME]
    title, (header, row), (remark, *left_out, units) = parse_table(step)
    assert all("assumed small" in text for text in left_out)
    assert units == "Forces and areas are per unit thickness."
    assert title == f"Increment {step.increment}, load 2"
    shown = dict(zip(header, row, strict=True))
    assert shown["contact"] == NAME
    assert shown["friction ∫|τ|"] == f"{r.tangential_force:.6g}"
    assert shown["∫ pressure"] == f"{r.normal_force:.6g}"
    force = [float(v) for v in shown["resultant on the body"].strip("()").split(", ")]
    assert force == pytest.approx(r.force.tolist(), rel=1e-5)
    assert [shown[s] for s in ("stick", "slip", "open")] == [
        str(n) for n in (r.stick, r.slip, r.open)
    ]
    assert remark.startswith(f"{step.method}: ")
    # Friction opposes the motion everywhere, and the ball's flanks have horizontal pressure.
    text = step.summary()
    assert (
        f"friction ∫|τ| {r.tangential_force:.6g}, resultant {shown['resultant on the body']}"
        in text
    )
    assert abs(abs(force[0]) - r.tangential_force) > 1e-3 * r.tangential_force


@pytest.mark.parametrize(
    ("iterations", "expected"),
    [
        (0, "solved by the predictor"),
        (1, "1 iteration"),
        (7, "7 iterations"),
    ],
)
def test_iterations_of_a_step_in_words(solved_block, iterations, expected):
    """Summary and table state the number of iterations in the same words."""
    step = replace(solved_block[1], iterations=iterations, method="newton")
    for text in (step.summary(), parse_table(step)[2][0]):
        assert f"newton: {expected}; residual" in text


def test_table_of_a_verdict(solved_block):
    """The table has every condition with its error and limit, and failures below."""
    setup, step = solved_block
    title, rows, remarks = parse_table(step.verdict)
    assert title == "Verdict: holds" and remarks == []
    names = [name for name, *_ in rows]
    assert f"cone, {NAME}" in names
    for checked in ("tunnelling", "gradient of the gap"):
        assert f"{checked}, {NAME}" in names
    assert names[1:] == [each.name for each in step.verdict.conditions]
    for _, error, limit in rows[1:]:
        assert float(error) <= float(limit)
    setup.problem.small_displacement_tolerance = 1e-12
    setup.load(2.5)
    with pytest.raises(fc.NotConverged) as error:
        setup.problem.solve()
    setup.problem.small_displacement_tolerance = np.inf
    title, _, remarks = parse_table(error.value.verdict)
    assert title == "Verdict: does not hold" and remarks == error.value.verdict.failures


def test_table_of_an_error_budget(solved_block):
    """The cells are those of the text; the last row is the total of all parts."""
    setup, step = solved_block
    scene = setup.scene
    tensor = stress(scene.u, scene.E, scene.nu)
    budget = fc.estimate_errors(setup.problem, tensor, increment_error=step.increment_error)
    title, (header, *rows), remarks = parse_table(budget)
    assert title == "Error budget" and header[1:] == list(budget.values)
    lines = str(budget).splitlines()
    for line, row in zip(lines[1:], rows[:-1], strict=False):
        assert " ".join(line.split()) == " ".join(row)
    assert rows[-1][0] == "together"
    assert [float(c.removesuffix(" %")) for c in rows[-1][1:]] == pytest.approx(
        [100 * t for t in budget.total.values()], rel=0.06
    )
    assert remarks == lines[len(rows) :]


@pytest.mark.parametrize(("number", "words"), [(0, "0 iterations"), (1, "1 iteration")])
def test_iterations_of_an_attempt_in_words(number, words):
    """The text of an attempt has the singular for one iteration."""
    assert str(Attempt("newton", number, "converged")) == f"newton: converged ({words})"
