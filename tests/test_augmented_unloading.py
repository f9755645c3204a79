"""Multipliers when the load decreases to a small fraction."""

from __future__ import annotations

import numpy as np
import pytest

import fenics_contact as fc
from scenes.blocks import block
from scenes.bodies import Bodies, boxes
from scenes.comparison import is_close, nodal_values

HEAVY, LIGHT, TOP, LIGHT_TOP = 1, 2, 3, 4
pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]


@pytest.mark.parametrize(
    ("friction", "factor"), [(0.0, 1e-1), (0.0, 1e-6), (0.5, 1e-3), (0.5, 1e-6)]
)
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_unloading_takes_at_most_twice_the_iterations_of_loading(cell, friction, factor):
    """Unloading in one increment takes at most twice the iterations of loading from zero.

    Starting from the multipliers of the previous load it takes up to a hundred times as many, or
    fails. The force equals the load to 1e-8. Without friction u is that of the small load alone, to
    1e-4 for the tolerance of 1e-5.
    """
    law = fc.Coulomb(friction) if friction else fc.Frictionless()

    def solve_loads(*loads):
        scene = block(cell, 1, n=4)
        contact = scene.contact(law, enforcement="augmented")
        problem = fc.ContactProblem(scene.F, scene.u, bcs=scene.rollers(), contacts=[contact])
        iterations = []
        for load in loads:
            scene.load(up=-load)
            iterations.append(problem.solve().iterations)
            problem.commit()
        assert contact.resultants().force[-1] == pytest.approx(loads[-1], rel=1e-8)
        return iterations, nodal_values(scene.u)

    (rise, fall), u = solve_loads(10.0, 10.0 * factor)
    assert fall <= 2 * rise
    if not friction:
        assert is_close(u, solve_loads(10.0 * factor)[1], 1e-4)


def test_unloading_of_one_body_with_constant_load_on_another():
    """Initial multipliers are reduced where the load has decreased, whatever the other load.

    Two boxes on two floors are loaded by a constant 1000, and by 10, then 1e-5. Contact forces
    equal the loads to 1e-8; the second increment takes at most twice the iterations of the first.
    """
    sides = {
        HEAVY: lambda x, c: (np.abs(x[:, 1]) < 1e-9) & (c[:, 0] < 1.5),
        TOP: lambda x, c: (np.abs(x[:, 1] - 1) < 1e-9) & (c[:, 0] < 1.5),
        LIGHT: lambda x, c: (np.abs(x[:, 1]) < 1e-9) & (c[:, 0] > 1.5),
        LIGHT_TOP: lambda x, c: (np.abs(x[:, 1] - 1) < 1e-9) & (c[:, 0] > 1.5),
    }
    lines = np.linspace(0, 1, 5)
    body = Bodies(boxes([[lines, lines], [lines + 2, lines]], sides), 1e3, 0.3)
    loads = [body.constant(1000.0), body.constant(10.0)]
    for load, tag in zip(loads, (TOP, LIGHT_TOP), strict=True):
        body.F += load * body.v[1] * body.ds(tag)
    floor = fc.HalfSpace((0, 0), (0, 1))
    contacts = [
        body.contact(tag, floor, fc.Coulomb(0.3), name=f"floor {tag}", enforcement="augmented")
        for tag in (HEAVY, LIGHT)
    ]
    problem = body.problem(*contacts)
    iterations = []
    for load in (10.0, 1e-5):
        loads[1].value = load
        iterations.append(problem.solve().iterations)
        problem.commit()
        for contact, expected in zip(contacts, (1000.0, load), strict=True):
            assert contact.resultants().force[1] == pytest.approx(expected, rel=1e-8)
    assert iterations[1] <= 2 * iterations[0]
