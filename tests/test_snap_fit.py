"""A rigid tool that a force drives against a soft slope, as in a snap fit."""

from __future__ import annotations

import numpy as np
import pytest

import fenics_contact as fc
from scenes.beside import Beside, Box
from scenes.blocks import LEFT, TOP

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(240)]
RADIUS, SLOPE, WAY = 2.0, 0.5, 0.5


def pushed(by, loads, *, friction):
    """A disc is pushed along x up a rising cantilever; force and place at every load, (n, 2)."""

    def rising(x):
        return np.column_stack([x[:, 0], x[:, 1] + SLOPE * x[:, 0]])

    scene = Beside({"arm": Box(size=(5.0, 0.5), n=(60, 4), bend=rising)}, E=1e3, rubber=True)
    scene.hold("arm", LEFT, 0)
    scene.hold("arm", LEFT, 1)
    load = scene.bodies.constant(0.0)
    forces, ways = ((load, None), (None, 0.0)) if by == "force" else ((None, None), (load, 0.0))
    motion = fc.Motion(force=forces, displacement=ways)
    normal = np.array([-SLOPE, 1.0]) / np.hypot(SLOPE, 1.0)
    centre = np.array([3.0, 0.5 + 3.0 * SLOPE]) + RADIUS * normal
    tool = fc.Cylinder(centre, RADIUS, displacement=motion)
    law = fc.Coulomb(friction) if friction else fc.Frictionless()
    contact = scene.contact("arm", TOP, tool, law, kinematics="finite")
    problem = scene.problem(contact)
    found = []
    for value in loads:
        load.value = value
        step = problem.solve()
        problem.commit()
        along = contact.motions[0].value if by == "force" else value
        found.append((contact.resultants().force[0], along, step.iterations))
    return np.array(found).T


@pytest.mark.parametrize("friction", [0.0, 0.2])
def test_by_force_as_by_displacement(friction):
    """As far as the tool has to be led for a force, so far the force drives it: to 1e-6.

    The tool bears on one or two points. An iterate that loses them closed the gap by what a closed
    point would yield, a thousandth of it: "no progress", in increments however small.
    """
    ways = np.linspace(0.1, 1.0, 10) * WAY
    forces, _, _ = pushed("displacement", ways, friction=friction)
    assert np.all(np.diff(forces) > 0)
    found, places, iterations = pushed("force", forces, friction=friction)
    assert np.abs(found - forces).max() <= 1e-8 * forces.max()
    assert np.abs(places - ways).max() <= 1e-6 * WAY
    assert iterations.max() <= 40  # 33, where continuation is needed; 5 to 9 elsewhere
