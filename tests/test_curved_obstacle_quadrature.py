"""Facets as long as the radius of a rigid obstacle have enough points to resolve its shape."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import ufl

import fenics_contact as fc
from scenes.bodies import Bodies, boxes
from scenes.comparison import is_close
from scenes.tags import at_coordinate

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(240)]
RADIUS = 1.0


def profile(middle):
    """Return a circle as a spline, with the obstacle to the left of its direction."""
    angle = np.linspace(0.0, 2 * np.pi, 40, endpoint=False)
    return fc.RigidProfile(
        middle + RADIUS * np.column_stack([np.cos(angle), np.sin(angle)]), closed=True
    )


def distance(middle):
    """Return the circle as a signed distance, whose radius of curvature is not given."""

    def to(x):
        return ufl.sqrt((x[0] - middle[0]) ** 2 + (x[1] - middle[1]) ** 2) - RADIUS

    return fc.SignedDistance(to)


SHAPES = {
    "cylinder": lambda middle: fc.Cylinder(middle, RADIUS),
    "ball": lambda middle: fc.Ball(middle, RADIUS),
    "profile": profile,
    "distance": distance,
}


def normal_forces_of_tool(shape, length, *, quadrature=None, degree=1, **options):
    """Return normal forces of a tool 0.3 deep at two positions along a facet, and the contact."""
    computed = []
    for factor in (0.0, 0.35):
        up = np.linspace(-5.0, 0.0, 4)
        sides = {1: at_coordinate(1, -5.0), 2: at_coordinate(1, 0.0)}
        across = length * np.arange(-4.0, 5.0)
        block = Bodies(boxes([[across, up]], sides), 1000.0, 0.3, degree=degree)
        block.prescribe(1, 0, 1)
        tool = SHAPES[shape](np.array([factor * length, RADIUS - 0.3]))
        options = {"kinematics": "finite"} | options
        contact = block.contact(2, tool, fc.Coulomb(0.3), quadrature=quadrature, **options)
        block.problem(contact).solve()
        computed.append(contact.resultants().normal_force)
    return np.array(computed), contact


@pytest.mark.each
@pytest.mark.parametrize("enforcement", ["penalty", "augmented"])
@pytest.mark.parametrize("length", [1.0, 2.0])
@pytest.mark.parametrize("shape", ["cylinder", "ball", "profile"])
def test_facets_resolve_a_round_tool(shape, length, enforcement):
    """Facets have the length of the tool's radius, or twice that.

    Reference: 40 points on a facet, to 4 %, the effect of one more or less of 4 or 8 closed points.
    With two points, or at nodes, the error was up to 26 % with penalty, and with multipliers no
    point was closed in the middle of the longer facets.
    """
    computed, contact = normal_forces_of_tool(shape, length, enforcement=enforcement)
    fine, _ = normal_forces_of_tool(shape, length, enforcement=enforcement, quadrature=78)
    assert contact.quadrature.degree // 2 + 1 >= 4 * length / RADIUS
    assert np.all(np.abs(computed / fine - 1) < 0.04)


def test_default_points_where_the_radius_is_resolved():
    """Facets of a quarter of the radius, in a bore or on a plane have the default points.

    References: p + 1 points on a facet, or its nodes with multipliers. A given degree is used.
    """

    def points(obstacle, length=0.25, **options):
        axes = [length * np.arange(5.0), np.linspace(-1.0, 0.0, 2)]
        block = Bodies(
            boxes([axes], {2: at_coordinate(1, 0.0)}), 1.0, 0.3, degree=options.pop("degree", 1)
        )
        return block.contact(2, obstacle, fc.Frictionless(), **options).quadrature

    tool = fc.Cylinder((0.0, RADIUS), RADIUS)
    assert points(tool).degree == 2 and points(tool, degree=2).degree == 4
    assert points(tool, enforcement="augmented").at_vertices
    assert points(tool, 1.0, quadrature=2).degree == 2
    for obstacle in (fc.Ball((0.0, -5.0), 6.0, inside=True), fc.HalfSpace((0, 0), (0, -1))):
        assert points(obstacle, 1.0).degree == 2
        assert points(obstacle, 1.0, enforcement="augmented").at_vertices
    assert points(tool, 100.0).degree == 78


@pytest.mark.parametrize("enforcement", ["penalty", "augmented"])
def test_insufficient_points_cause_a_warning(enforcement):
    """If the radius is not given, a warning proposes a degree; with enough points there is none.

    Reference: with the proposed degree the force is that of 40 points, to 4 %.
    """
    with pytest.warns(UserWarning, match="as long as the radius of curvature") as caught:
        normal_forces_of_tool("distance", 2.0, enforcement=enforcement)
    degree = int(str(caught[0].message).split("quadrature_degree=")[1].split(")")[0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        computed, _ = normal_forces_of_tool(
            "distance", 2.0, enforcement=enforcement, quadrature=degree
        )
        normal_forces_of_tool("cylinder", 2.0, enforcement=enforcement)
        if enforcement == "penalty":
            normal_forces_of_tool("distance", 0.5)
    fine, _ = normal_forces_of_tool("distance", 2.0, enforcement=enforcement, quadrature=78)
    assert is_close(computed, fine, 0.04)
