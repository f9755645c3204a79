"""Histories with finite kinematics: what must not change the answer, and what must."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from scenes.comparing import close
from scenes.rubber import TIGHT, Tool, disc, domed, rubber

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
def test_body_or_tool_dragged(cell, shape, enforcement):
    """The block moved by -a under a disc at rest feels what it does under a disc moved by +a.

    Tractions to 1e-9 of the largest: round-off in places, times the stiffness; with multipliers,
    whose rounds end at 1e-9, to 1e-7. Between flat facets there is more than one answer.
    """
    options = {"contact": {"enforcement": enforcement, "tolerance": 1e-9}, "shape": shape}
    allowed = 1e-9 if enforcement == "penalty" else 1e-7
    one, other = Tool(cell, **options), Tool(cell, **options)
    for side, up in PATH:
        one.go(side, up)
        away = one.vector(side, up)[:, None]
        other.scene.place(lambda x, away=away: x - away)
        other.go(0.0, 0.0)
        assert one.contact.resultants().slip + one.contact.resultants().stick > 0
        assert close(other.tractions(), one.tractions(), allowed)


def _turned(tool, matrix, side, up):
    """Have block and disc turned about the origin, the disc displaced by (side, up) before."""
    centre = tool.vector(0.0, tool.scene.height + 0.8)
    tool.scene.place(lambda x: matrix @ x)
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
def test_turning_the_whole_scene_only_turns_the_answer(cell, shape, enforcement):
    """Pressed and dragged, then all turned by 1.2 rad in four increments, then dragged on.

    Not on 24 segments, where a point at a corner finds either of two answers, as steps have it.
    In space about an axis oblique to the normal. Tractions are those of the scene that was not
    turned, turned: 1e-9 of the largest, with multipliers whose rounds end there 1e-7.
    """
    d = 2 if cell == "triangle" else 3
    axis = np.array([0.6, 0.0, 0.8])
    contact = {"enforcement": enforcement, "tolerance": 1e-9}
    allowed = 1e-9 if enforcement == "penalty" else 1e-7
    still, tool = (Tool(cell, contact=contact, shape=shape) for _ in range(2))
    if d == 3:
        obstacle = disc(
            tool.scene, 0.8, displacement=tool.shift, angle=tool.angle, axis=axis, shape=shape
        )
        tool.problem, tool.contact = tool.scene.problem(
            obstacle, fc.Coulomb(0.3, 1e4, 1e4), contact=contact, petsc_options=TIGHT
        )
    for side, up in PATH[:4]:
        still.go(side, up)
        tool.go(side, up)
    before = still.tractions()
    for angle, (side, up) in [*((a, PATH[3]) for a in (0.3, 0.6, 0.9, 1.2)), (1.2, PATH[4])]:
        c, s = np.cos(angle), np.sin(angle)
        matrix = np.array([[c, -s], [s, c]])
        if d == 3:
            x, y, z = axis
            across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            matrix = np.eye(3) + s * across + (1 - c) * across @ across
        tool.shift.value[:] = _turned(tool, matrix, side, up)
        tool.angle.value = angle
        tool.problem.solve()
        tool.problem.commit()
        if (side, up) == PATH[4]:
            still.go(side, up)
            before = still.tractions()
        assert close(tool.tractions(), before @ matrix.T, allowed)


@pytest.mark.parametrize("law", [fc.Frictionless(1e4), fc.Coulomb(0.2, 1e4, 1e4)])
def test_small_and_finite_agree_to_first_order(law):
    """Linear elastic block with a domed top in the cavity that it fits.

    Tractions differ by a share that is proportional to the displacement: four times smaller, four
    times less; 25 % for the terms of higher order.
    """
    share = []
    for size in (4e-3, 1e-3):
        found = []
        for kinematics in ("finite", "small"):
            scene = rubber("triangle", n=(12, 6), linear=True, bend=domed)
            shift = fem.Constant(scene.mesh, np.zeros(2))
            problem, contact = scene.problem(
                fc.Ball((0, -1), 2.0, inside=True, displacement=shift),
                law,
                contact={"kinematics": kinematics},
                petsc_options=TIGHT,
                small_displacement_tolerance=np.inf,
            )
            for side, up in ((0.0, -1.0), (0.5, -1.5)):
                shift.value[:] = size * side, size * up
                problem.solve()
                problem.commit()
            found.append(contact.resultants().force)
        share.append(np.linalg.norm(found[0] - found[1]) / np.linalg.norm(found[1]))
    assert share[0] > 1e-5
    assert share[0] / share[1] == pytest.approx(4.0, rel=0.25)


def test_a_loop_without_friction_gives_all_work_back():
    """Pressed, dragged, turned and lifted on another way, back to the start.

    Work of the tool over the loop, by means of forces at both ends of 48 increments: 1e-3 of what
    it takes to press. Without friction nothing remembers the way: the last force is 0.
    """
    tool = Tool(law=fc.Frictionless(1e4), n=(8, 4))
    corners = [(0, 0, 0), (0, -0.15, 0), (0.2, -0.15, 1), (0.2, 0, 1)]
    work, peak = 0.0, 0.0
    for start, end in pairwise(corners):
        for share in np.arange(1, 17) / 16:
            side, up, angle = (1 - share) * np.array(start) + share * np.array(end)
            step = tool.go(side, up, angle)
            work += step.energy.work
            peak = max(peak, work)
    assert peak > 1.0
    assert abs(work) < 1e-3 * peak
    assert np.linalg.norm(tool.resultant()) < 1e-9


def test_a_free_roller_rolls():
    """A disc that turns as it moves, by side/R, is held by less friction than one that slides.

    Pulled along by 0.3: sliding takes μN, rolling (and creeping) less than a third of it; one that
    turns on the spot takes μN too.
    """
    radius, push = 0.8, -0.1
    forces = {}
    for name, rate in {"slides": 0.0, "rolls": -1.0 / radius}.items():
        tool = Tool(radius=radius, law=fc.Coulomb(0.3, 1e4, 1e4))
        tool.go(0.0, push)
        for side in np.arange(1, 9) * 0.3 / 8:
            step = tool.go(side, push, rate * side)
            assert step.energy.dissipation >= -1e-12
        forces[name] = tool.resultant()
    normal = -forces["slides"][1]
    assert forces["slides"][0] == pytest.approx(0.3 * normal, rel=0.1)
    assert abs(forces["rolls"][0]) < forces["slides"][0] / 3
    tool = Tool(radius=radius, law=fc.Coulomb(0.3, 1e4, 1e4))
    tool.go(0.0, push)
    for angle in np.arange(1, 9) * 0.05:
        tool.go(0.0, push, angle)
    assert tool.resultant()[0] == pytest.approx(0.3 * -tool.resultant()[1], rel=0.1)


def test_a_drum_that_turns_all_the_way_round():
    """Pressed, then turned by 360° in 12 increments: it slides, and nothing changes any more.

    The moment about its axis is that of friction μ p at the distance R - δ, 1e-9; forces after the
    first half turn stay, 1e-9.
    """
    radius, friction = 0.8, 0.3
    tool = Tool(radius=radius, law=fc.Coulomb(friction, 1e4, 1e4))
    for push in (-0.05, -0.1):
        tool.go(0.0, push)
    forces = []
    for k in range(1, 13):
        tool.go(0.0, push, k * np.pi / 6)
        forces.append(tool.resultant())
    assert close(forces[-1], forces[5], 1e-9)
    contact = tool.contact
    arm = contact.measure * (radius - contact.values.penetration)
    expected = COMM.allreduce(friction * float(arm @ contact.pressure))
    moment = contact.moment((0.0, tool.scene.height + radius + push))
    assert abs(moment[0]) == pytest.approx(expected, rel=1e-9)
    assert contact.resultants().stick == 0


def test_no_solution_is_turned_inside_out():
    """An increment in which Newton's method without a line search finds J < 0: refused, or right.

    Verified, it was a force of 2397 where smaller increments lead to 86.8.
    """
    tool = Tool(n=(16, 8), law=fc.Coulomb(0.3))
    tool.problem, tool.contact = tool.scene.problem(
        disc(tool.scene, 0.8, displacement=tool.shift),
        fc.Coulomb(0.3),
        method="newton",
        petsc_options={"snes_linesearch_type": "basic"},
    )
    tool.go(0.0, -0.05)
    try:
        tool.go(0.0, -0.1)
    except fc.NotConverged:
        return
    volume = ufl.det(ufl.Identity(2) + ufl.grad(tool.scene.u))
    inside_out = fem.form(ufl.conditional(ufl.lt(volume, 0), 1.0, 0.0) * ufl.dx)
    assert COMM.allreduce(fem.assemble_scalar(inside_out)) == 0.0


def test_newton_converges_quadratically():
    """Where no status changes any more the residual r becomes at most of the order of r².

    Of the last three above round-off each is below the square root of the last but one's share.
    """
    tool = Tool(law=fc.Frictionless(1e4))
    tool.problem, tool.contact = tool.scene.problem(
        disc(tool.scene, 0.8, displacement=tool.shift),
        fc.Frictionless(1e4),
        method="newton",
        petsc_options={"snes_rtol": 1e-10},
    )
    tool.go(0.0, -0.1)
    norms = []
    tool.problem.snes.setMonitor(lambda snes, i, norm: norms.append(norm))
    tool.go(0.0, -0.11)
    norms = [norm for norm in norms if norm > 0]  # what is left may be round-off alone
    shares = np.log10(np.array(norms[-3:]) / norms[0])
    assert shares[2] < 1.7 * shares[1]
    assert len(norms) < 8


def test_area_and_moment_of_a_body_that_turns_and_grows():
    """A block moved by x = 1.25 R X: area grows by 1.25^(d-1), moments are of present places.

    Reference: the moment of the forces at R X, by their sum over the points in plain numpy; 1e-12.
    """
    for cell in ("triangle", "tetrahedron"):
        tool = Tool(cell, n=(4, 2))
        d = tool.scene.dim
        c, s = np.cos(0.7), np.sin(0.7)
        turn = np.eye(d)
        turn[:2, :2] = [[c, -s], [s, c]]
        tool.scene.u.interpolate(lambda x, d=d, turn=turn: 1.25 * turn @ x[:d] - x[:d])
        contact = tool.contact
        assert close(contact.area_stretch(), np.full(len(contact.points), 1.25 ** (d - 1)), 1e-12)
        # The tool is where the block has grown to, and cuts into it.
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
        assert close(contact.moment(about), expected, 1e-12)
