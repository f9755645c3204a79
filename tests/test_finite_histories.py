"""Load histories with finite kinematics: frame invariance, work, rolling and rotation."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from scenes.comparison import is_close
from scenes.rubber import TIGHT_TOLERANCE, DiscOnRubber, bend_top, disc, rubber

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(300)]
COMM = MPI.COMM_WORLD
PATH = [(0.0, -0.06), (0.0, -0.12), (0.05, -0.15), (0.1, -0.15), (0.06, -0.14)]


@pytest.mark.each
@pytest.mark.parametrize(
    ("shape", "enforcement"),
    [
        ("ball", "penalty"),
        ("ball", "augmented"),
        ("profile", "penalty"),
    ],
)
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_moving_the_body_or_the_tool_is_equivalent(cell, shape, enforcement):
    """Moving the block by -a under a fixed disc is equivalent to moving the disc by a.

    Tractions agree to 1e-9 of the largest, due to round-off of positions times the stiffness; with
    multipliers, whose augmentations end at 1e-9, to 1e-7. Faceted tools are excluded: their
    solution is not unique.
    """
    options = {"contact": {"enforcement": enforcement, "tolerance": 1e-9}, "shape": shape}
    allowed = 1e-9 if enforcement == "penalty" else 1e-7
    one, other = DiscOnRubber(cell, **options), DiscOnRubber(cell, **options)
    for side, up in PATH:
        one.solve_increment(side, up)
        away = one.vector(side, up)[:, None]
        other.scene.move_bottom(lambda x, away=away: x - away)
        other.solve_increment(0.0, 0.0)
        assert one.contact.resultants().slip + one.contact.resultants().stick > 0
        assert is_close(other.tractions(), one.tractions(), allowed)


def _rotate_scene(tool, matrix, side, up):
    """Turn block and disc about the origin after displacing the disc by (side, up)."""
    centre = tool.vector(0.0, tool.scene.height + 0.8)
    tool.scene.move_bottom(lambda x: matrix @ x)
    return matrix @ (centre + tool.vector(side, up)) - centre


@pytest.mark.parametrize(
    ("cell", "shape", "enforcement"),
    [
        ("triangle", "ball", "penalty"),
        ("triangle", "ball", "augmented"),
        ("triangle", "profile", "penalty"),
        ("tetrahedron", "ball", "penalty"),
        ("tetrahedron", "ball", "augmented"),
        ("tetrahedron", "profile", "penalty"),
        ("tetrahedron", "facets", "penalty"),
    ],
)
def test_rotation_of_the_whole_scene_rotates_the_tractions(cell, shape, enforcement):
    """The scene is pressed and dragged, turned by 1.2 rad in four increments, and dragged on.

    In 3D the axis is oblique to the normal. The tractions are those of the scene without rotation,
    rotated, to 1e-9 of the largest, and with multipliers, whose augmentations end there, to 1e-7. A
    disc of 24 segments is excluded in 2D: a point at a corner has two solutions.
    """
    d = 2 if cell == "triangle" else 3
    axis = np.array([0.6, 0.0, 0.8])
    contact = {"enforcement": enforcement, "tolerance": 1e-9}
    allowed = 1e-9 if enforcement == "penalty" else 1e-7
    unrotated, tool = (DiscOnRubber(cell, contact=contact, shape=shape) for _ in range(2))
    if d == 3:
        obstacle = disc(
            tool.scene, 0.8, displacement=tool.shift, angle=tool.angle, axis=axis, shape=shape
        )
        tool.problem, tool.contact = tool.scene.problem(
            obstacle, fc.Coulomb(0.3, 1e4, 1e4), contact=contact, petsc_options=TIGHT_TOLERANCE
        )
    for side, up in PATH[:4]:
        unrotated.solve_increment(side, up)
        tool.solve_increment(side, up)
    before = unrotated.tractions()
    for angle, (side, up) in [*((a, PATH[3]) for a in (0.3, 0.6, 0.9, 1.2)), (1.2, PATH[4])]:
        c, s = np.cos(angle), np.sin(angle)
        matrix = np.array([[c, -s], [s, c]])
        if d == 3:
            x, y, z = axis
            across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            matrix = np.eye(3) + s * across + (1 - c) * across @ across
        tool.shift.value[:] = _rotate_scene(tool, matrix, side, up)
        tool.angle.value = angle
        tool.problem.solve()
        tool.problem.commit()
        if (side, up) == PATH[4]:
            unrotated.solve_increment(side, up)
            before = unrotated.tractions()
        assert is_close(tool.tractions(), before @ matrix.T, allowed)


@pytest.mark.parametrize("law", [fc.Frictionless(1e4), fc.Coulomb(0.2, 1e4, 1e4)])
def test_small_and_finite_agree_to_first_order(law):
    """A linear elastic block with a domed top is pressed into a cavity that it fits.

    The relative difference of the contact forces is proportional to the displacement: a quarter of
    it for a quarter of the displacement, to 25 % for terms of higher order.
    """
    relative_errors = []
    for size in (4e-3, 1e-3):
        computed = []
        for kinematics in ("finite", "small"):
            scene = rubber("triangle", n=(12, 6), linear=True, bend=bend_top)
            shift = fem.Constant(scene.mesh, np.zeros(2))
            problem, contact = scene.problem(
                fc.Ball((0, -1), 2.0, inside=True, displacement=shift),
                law,
                contact={"kinematics": kinematics},
                petsc_options=TIGHT_TOLERANCE,
                small_displacement_tolerance=np.inf,
            )
            for side, up in ((0.0, -1.0), (0.5, -1.5)):
                shift.value[:] = size * side, size * up
                problem.solve()
                problem.commit()
            computed.append(contact.resultants().force)
        relative_errors.append(
            np.linalg.norm(computed[0] - computed[1]) / np.linalg.norm(computed[1])
        )
    assert relative_errors[0] > 1e-5
    assert relative_errors[0] / relative_errors[1] == pytest.approx(4.0, rel=0.25)


def test_frictionless_loop_does_no_work():
    """The tool is pressed, dragged while it turns, and lifted along another path.

    Its work in 48 increments, by the mean of the forces at both ends of each, is at most 1e-3 of
    the largest work on the path. Without friction there is no history: the last force is 0.
    """
    tool = DiscOnRubber(law=fc.Frictionless(1e4), n=(8, 4))
    corners = [(0, 0, 0), (0, -0.15, 0), (0.2, -0.15, 1), (0.2, 0, 1)]
    work, peak = 0.0, 0.0
    for start, end in pairwise(corners):
        for fraction in np.arange(1, 17) / 16:
            side, up, angle = (1 - fraction) * np.array(start) + fraction * np.array(end)
            step = tool.solve_increment(side, up, angle)
            work += step.energy.work
            peak = max(peak, work)
    assert peak > 1.0
    assert abs(work) < 1e-3 * peak
    assert np.linalg.norm(tool.resultant()) < 1e-9


def test_rolling_disc_has_less_friction_than_a_sliding_one():
    """A disc that rolls, turning by side/R, has less than a third of the friction of sliding.

    After a displacement of 0.3 the friction force of sliding is μN to 10 %, and so is that of a
    disc that turns without displacement; a rolling disc has creep.
    """
    radius, push = 0.8, -0.1
    forces = {}
    for name, rate in {"slides": 0.0, "rolls": -1.0 / radius}.items():
        tool = DiscOnRubber(radius=radius, law=fc.Coulomb(0.3, 1e4, 1e4))
        tool.solve_increment(0.0, push)
        for side in np.arange(1, 9) * 0.3 / 8:
            step = tool.solve_increment(side, push, rate * side)
            assert step.energy.dissipation >= -1e-12
        forces[name] = tool.resultant()
    normal = -forces["slides"][1]
    assert forces["slides"][0] == pytest.approx(0.3 * normal, rel=0.1)
    assert abs(forces["rolls"][0]) < forces["slides"][0] / 3
    tool = DiscOnRubber(radius=radius, law=fc.Coulomb(0.3, 1e4, 1e4))
    tool.solve_increment(0.0, push)
    for angle in np.arange(1, 9) * 0.05:
        tool.solve_increment(0.0, push, angle)
    assert tool.resultant()[0] == pytest.approx(0.3 * -tool.resultant()[1], rel=0.1)


def test_friction_moment_of_a_full_turn():
    """A disc is pressed, then turned by 360° in 12 increments with all closed points slipping.

    The moment about its axis is that of friction μ p at the distance R - δ, to 1e-9. The forces
    after half a turn and a full turn agree to 1e-9.
    """
    radius, friction = 0.8, 0.3
    tool = DiscOnRubber(radius=radius, law=fc.Coulomb(friction, 1e4, 1e4))
    for push in (-0.05, -0.1):
        tool.solve_increment(0.0, push)
    forces = []
    for k in range(1, 13):
        tool.solve_increment(0.0, push, k * np.pi / 6)
        forces.append(tool.resultant())
    assert is_close(forces[-1], forces[5], 1e-9)
    contact = tool.contact
    arm = contact.measure * (radius - contact.values.penetration)
    expected = COMM.allreduce(friction * float(arm @ contact.pressure))
    moment = contact.moment((0.0, tool.scene.height + radius + push))
    assert abs(moment[0]) == pytest.approx(expected, rel=1e-9)
    assert contact.resultants().stick == 0


def test_no_solution_has_inverted_cells():
    """Newton's method without line search finds J < 0: the increment is refused, or has J > 0.

    The state with J < 0 has a force of 2397; smaller increments lead to 86.8.
    """
    tool = DiscOnRubber(n=(16, 8), law=fc.Coulomb(0.3))
    tool.problem, tool.contact = tool.scene.problem(
        disc(tool.scene, 0.8, displacement=tool.shift),
        fc.Coulomb(0.3),
        method="newton",
        petsc_options={"snes_linesearch_type": "basic"},
    )
    tool.solve_increment(0.0, -0.05)
    try:
        tool.solve_increment(0.0, -0.1)
    except fc.NotConverged:
        return
    volume = ufl.det(ufl.Identity(2) + ufl.grad(tool.scene.u))
    inside_out = fem.form(ufl.conditional(ufl.lt(volume, 0), 1.0, 0.0) * ufl.dx)
    assert COMM.allreduce(fem.assemble_scalar(inside_out)) == 0.0


def test_newton_converges_quadratically():
    """Once the active set is fixed, each residual is of the order of the square of the last.

    Asserted is an order of convergence above 1.7 for the last two residuals relative to the first,
    and fewer than 8 residuals in all.
    """
    tool = DiscOnRubber(law=fc.Frictionless(1e4))
    tool.problem, tool.contact = tool.scene.problem(
        disc(tool.scene, 0.8, displacement=tool.shift),
        fc.Frictionless(1e4),
        method="newton",
        petsc_options={"snes_rtol": 1e-10},
    )
    tool.solve_increment(0.0, -0.1)
    norms = []
    tool.problem.snes.setMonitor(lambda snes, i, norm: norms.append(norm))
    tool.solve_increment(0.0, -0.11)
    norms = [norm for norm in norms if norm > 0]  # zero may be reached exactly
    orders = np.log10(np.array(norms[-3:]) / norms[0])
    assert orders[2] < 1.7 * orders[1]
    assert len(norms) < 8


def test_area_and_moment_of_a_rotated_and_stretched_body():
    """With x = 1.25 R X the area is 1.25^(d-1) times as large; moments use present positions.

    Reference: sum over the points in numpy of the moments of forces at 1.25 R X, to 1e-12.
    """
    for cell in ("triangle", "tetrahedron"):
        tool = DiscOnRubber(cell, n=(4, 2))
        d = tool.scene.dim
        c, s = np.cos(0.7), np.sin(0.7)
        turn = np.eye(d)
        turn[:2, :2] = [[c, -s], [s, c]]
        tool.scene.u.interpolate(lambda x, d=d, turn=turn: 1.25 * turn @ x[:d] - x[:d])
        contact = tool.contact
        assert is_close(
            contact.area_stretch(), np.full(len(contact.points), 1.25 ** (d - 1)), 1e-12
        )
        # The tool follows the stretched block and penetrates it.
        tool.shift.value[:] = 1.95 * turn @ tool.vector(0.0, 1.0) - tool.vector(0.1, 1.8)
        contact.evaluate()
        about = np.arange(1.0, d + 1)
        force = contact.measure[:, None] * contact.traction
        arm = 1.25 * contact.points @ turn.T - about
        if d == 3:
            expected = np.cross(arm, force).sum(axis=0)
        else:
            expected = np.atleast_1d((arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0]).sum())
        expected = COMM.allreduce(expected)
        assert np.abs(expected).max() > 1.0
        assert is_close(contact.moment(about), expected, 1e-12)
