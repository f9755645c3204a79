"""`RoundedCone`: a rigid cone (2D: a wedge) with a round tip."""

import numpy as np
import pytest
from mpi4py import MPI

import fenics_contact as fc
from scenes.blocks import TOP, block, dimension
from scenes.comparison import assert_raised_on_all_ranks, gather, is_close

COMM = MPI.COMM_WORLD
pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]

ANGLE, RADIUS = np.deg2rad(60), 0.3


def distance(x, tip, axis):
    """Return the signed distance, by a search among 10⁵ points of the generating curve in numpy."""
    axis = axis / np.linalg.norm(axis)
    arm = x - tip
    z = arm @ axis
    across = arm - np.outer(z, axis)
    rho = np.linalg.norm(across, axis=1)
    t = np.linspace(0, np.pi / 2 - ANGLE, 50_000)
    arc = RADIUS * np.column_stack([np.sin(t), 1 - np.cos(t)])
    along = np.linspace(0, 5, 50_001)[1:, None]
    curve = np.vstack([arc, arc[-1] + along * [np.sin(ANGLE), np.cos(ANGLE)]])
    computed, foot = np.empty(len(x)), np.empty((len(x), 2))
    for i, point in enumerate(np.column_stack([rho, z])):
        nearest = np.argmin(np.linalg.norm(curve - point, axis=1))
        foot[i] = curve[nearest]
        computed[i] = np.linalg.norm(point - foot[i])
    # Points above the curve z(ρ) are inside.
    inside = z > np.interp(rho, curve[:, 0], curve[:, 1])
    return np.where(inside, -computed, computed)


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_gap_and_normal_are_those_of_the_generating_curve(cell):
    """The gap is the distance from points of the generating curve, 1e-4 apart, to 1e-7.

    The normal has length 1 and points to the obstacle: half of the gap along it halves the gap, to
    1e-6.
    """
    scene = block(cell, n=5)
    d = scene.dim
    tip, axis = np.array([0.4] * (d - 1) + [-0.2]), np.array([0.3] * (d - 1) + [-1.0])
    obstacle = fc.RoundedCone(tip, axis, ANGLE, RADIUS)
    contact = scene.contact(fc.Frictionless(1e3), obstacle=obstacle)
    x = gather(COMM, contact.points)
    gap, normal = (gather(COMM, v) for v in (contact.gap, contact.values.normal))
    assert is_close(gap, distance(x, tip, axis), 1e-7, scale=1.0)
    assert is_close(np.linalg.norm(normal, axis=1), np.ones(len(x)), 1e-13)
    # A displacement of half the gap along the normal leaves half of the gap.
    halfway = x + gap[:, None] / 2 * normal
    assert is_close(distance(halfway, tip, axis), gap / 2, 1e-6, scale=1.0)
    assert np.ptp(np.arccos(np.clip(-normal @ axis / np.linalg.norm(axis), -1, 1))) > 0.3


def drag_forces(obstacle, cell, **options):
    """Return the forces on a block pressed onto an obstacle and dragged in small increments."""
    # By default there are more points if the radius is smaller.
    scene = block(cell, n=4, surface={"quadrature_degree": 4})
    d = scene.dim
    bcs = [scene.dirichlet_bc(TOP, i) for i in range(d)]
    problem, contact = scene.problem(
        fc.Coulomb(0.2), bcs, contact={"obstacle": obstacle, "kinematics": "finite"}, **options
    )
    forces = []
    for side, down in ((0.0, 0.02), (0.05, 0.02), (0.1, 0.02), (0.05, 0.02)):
        bcs[0].g.value[...], bcs[-1].g.value[...] = side, -down
        step = problem.solve()
        assert step.verdict.failures == []
        problem.commit()
        forces.append(contact.resultants().force)
    return np.array(forces)


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_contact_at_the_tip_has_the_forces_of_a_ball(cell):
    """With contact at the tip only the forces are those of a `Ball`, to 1e-7.

    The solver's tolerance is 1e-9 of the load.
    """
    up = np.eye(dimension(cell))[-1]
    tip, radius = 0.45 * (1 - up), 8.0
    cone = drag_forces(fc.RoundedCone(tip, -up, np.deg2rad(70), radius), cell)
    ball = drag_forces(fc.Ball(tip - radius * up, radius), cell)
    assert np.abs(ball).max() > 1.0 and is_close(cone, ball, 1e-7)


def test_contact_at_the_flank_has_the_forces_of_a_half_space():
    """With contact at the flank of a wide wedge the forces are those of a `HalfSpace`, to 1e-7."""
    angle = np.deg2rad(80)
    n = np.array([-np.cos(angle), np.sin(angle)])  # out of the left flank
    axis, radius = np.array([0.0, -1.0]), 0.1
    # The corner (1, 0) of the block touches the flank at a distance of 2 from the tip's circle.
    centre = np.array([1.0, 0.0]) - radius * n - 2.0 * np.array([-n[1], n[0]])
    wedge = drag_forces(
        fc.RoundedCone(centre - radius * axis, axis, angle, radius), "quadrilateral"
    )
    plane = drag_forces(fc.HalfSpace((1.0, 0.0), n), "quadrilateral")
    assert np.abs(plane).max() > 1.0 and is_close(wedge, plane, 1e-7)


def test_wedge_has_the_force_of_a_fine_profile():
    """A sharp wedge at the middle has a vertical force, that of a fine `RigidProfile`, to 1e-4."""
    tip, axis, radius, angle = np.array([0.5, -0.01]), np.array([0.0, -1.0]), 0.02, np.deg2rad(75)
    t = np.linspace(0, np.pi / 2 - angle, 50)
    arc = radius * np.column_stack([np.sin(t), np.cos(t) - 1])
    flank = arc[-1] + np.linspace(0, 2, 400)[1:, None] * [np.sin(angle), -np.cos(angle)]
    half = np.vstack([arc, flank])
    profile = tip + np.vstack([half[::-1], half[1:] * [-1, 1]])
    computed = [
        drag_forces(obstacle, "quadrilateral")[0]
        for obstacle in (fc.RoundedCone(tip, axis, angle, radius), fc.RigidProfile(profile))
    ]
    assert computed[0][1] > 1.0 and abs(computed[0][0]) < 1e-9 * computed[0][1]
    assert is_close(computed[0], computed[1], 1e-4)


def test_invalid_arguments_are_refused():
    """Errors for invalid half angles, radii, axes and tips state the name of the argument."""
    scene = block()
    arguments = {"tip": (0.5, -0.1), "axis": (0, -1), "half_angle": ANGLE, "radius": RADIUS}
    for name, value in (
        ("half_angle", 0.0),
        ("half_angle", 60.0),
        ("half_angle", np.pi / 2),
        ("radius", 0.0),
        ("axis", (0.0, 0.0)),
        ("axis", (0.0, 0.0, 1.0)),
        ("tip", (0.5, np.nan)),
    ):
        obstacle = fc.RoundedCone(**arguments | {name: value})
        assert_raised_on_all_ranks(
            lambda obstacle=obstacle: scene.contact(fc.Frictionless(), obstacle=obstacle),
            ValueError,
            name,
            "RoundedCone",
        )
