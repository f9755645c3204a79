"""Extents of contact, stick and slip, compared with closed forms and with the points."""

import numpy as np
import pytest
from mpi4py import MPI

import fenics_contact as fc
from demos import two_cylinders as cylinders
from scenes.block_on_ball import PATH, BlockOnBall, solve_path
from scenes.blocks import CELLS, dimension
from scenes.comparison import is_close

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]

CELLS_IN_A = 20


def half_widths(extent):
    """Return the half-width by area, and by the coordinates along the line of contact."""
    return extent.area / 2, extent.size[0] / 2


def test_extents_of_hertz_and_cattaneo_mindlin():
    """Pressed: a of Hertz. Sheared: c of Cattaneo and Mindlin, and slip from c to a on both sides.

    Within one facet, a/20: the extents are those of points, and the state may end anywhere between
    two of them; half-discs of a/R = 0.085 instead of half-planes cause a fifth of that.
    """
    scene = cylinders.press(CELLS_IN_A, 2, 10.0)
    a, c, facet = cylinders.A, cylinders.C, cylinders.A / CELLS_IN_A
    pressed = scene.step.contacts["contact"].extents
    for width in half_widths(pressed["contact"]):
        assert abs(width - a) < facet
    assert pressed["stick"].area == 0.0 and np.isnan(pressed["stick"].size).all()
    (step,) = fc.increments(scene.problem, scene.shear, 0.0, cylinders.SHEAR)
    sheared = step.contacts["contact"].extents
    for state, expected in (("contact", a), ("stick", c)):
        for width in half_widths(sheared[state]):
            assert abs(width - expected) < facet, state
        middle = (sheared[state].low[0] + sheared[state].high[0]) / 2
        assert abs(middle) < facet / 2
    slip = sheared["slip"]
    assert abs(slip.area - 2 * (a - c)) < 2 * facet
    assert is_close([slip.low[0], slip.high[0]], [-a, a], facet / a)


@pytest.mark.parametrize("cell", CELLS)
def test_extents_agree_with_the_points(cell):
    """In the plane and in space, for all states, also without points: those of `gather`, to 1e-12.

    The extents do not depend on the number of ranks, some of which may have no points of a state.
    """
    setup, d = BlockOnBall(cell=cell), dimension(cell)
    setup.problem.small_displacement_tolerance = np.inf
    statuses = set()
    for step in solve_path(setup, path=[(0.0, -0.01), *PATH]):
        computed, points = step.contacts["contact"], setup.contact.gather()
        if step.increment < len(PATH) + 1:
            continue  # the points are those of the last step
        closed = points["status"] != fc.Status.OPEN
        states = {
            "contact": closed,
            "stick": points["status"] == fc.Status.STICK,
            "slip": points["status"] == fc.Status.SLIP,
        }
        for name, mask in states.items():
            extent = computed.extents[name]
            assert is_close([extent.area], [points["measure"] @ mask], 1e-12, scale=1.0)
            if mask.any():
                statuses.add(name)
                assert np.array_equal(extent.low, points["x"][mask].min(axis=0))
                assert np.array_equal(extent.high, points["x"][mask].max(axis=0))
            else:
                assert np.isnan(extent.low).all() and extent.low.shape == (d,)
        assert computed.area == computed.extents["contact"].area
    assert "contact" in statuses


def test_moment_of_a_step_is_about_the_origin():
    """The moment of a step is that of `Contact.moment` about the origin, on any number of ranks."""
    setup = BlockOnBall()
    setup.problem.small_displacement_tolerance = np.inf
    *_, step = fc.increments(setup.problem, setup.load, 0, 1.5, steps=3)
    assert is_close(step.contacts["contact"].moment, setup.contact.moment([0, 0]), 1e-12)
    assert MPI.COMM_WORLD.allreduce(abs(float(step.contacts["contact"].moment[0]))) > 0
