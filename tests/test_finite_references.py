"""Finite kinematics compared with numbers of another program."""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenics_contact as fc
from fenics_contact.elasticity import NeoHookean
from scenes import sliding_rubber_block
from scenes.blocks import BOTTOM, LEFT, TOP, block_mesh
from scenes.elasticity import dirichlet_bc, displacement_space
from verification.extreme_finite import rotate_together

pytestmark = pytest.mark.two_ranks

# Force on half of the disc at every 0.25 of its path: verification/getfem_disc.py, GetFEM 5.4.2.
GETFEM = (
    *(59.800408, 136.348555, 223.719622, 319.588569, 422.751726, 532.564461),
    *(649.491631, 772.146797, 900.426090, 1035.217694, 1174.778480, 1320.350256),
)

# The same with friction: force on the block along x and y, and torque about the disc's centre,
# while it is pressed (12 increments), rotated (8) and dragged (8).
GETFEM_FRICTION = (
    (0.000000, -128.252858, 0.000000),
    (0.000000, -294.985949, 0.000000),
    (0.000000, -487.481012, 0.000000),
    (0.000000, -700.188558, 0.000000),
    (0.000000, -931.171957, 0.000000),
    (0.000000, -1179.464781, 0.000000),
    (0.000000, -1443.844559, 0.000000),
    (0.000000, -1724.533611, 0.000000),
    (0.000000, -2020.519543, 0.000000),
    (0.000000, -2333.395668, 0.000000),
    (0.000000, -2661.294160, 0.000000),
    (0.000000, -3003.797966, 0.000000),
    (152.018274, -3006.437537, 667.198978),
    (303.723859, -3010.496242, 1336.488938),
    (453.798958, -3019.588988, 1987.582505),
    (600.685993, -3033.256798, 2639.076742),
    (740.062718, -3053.108965, 3261.193471),
    (865.177708, -3085.086115, 3844.828316),
    (902.597361, -3106.755292, 4049.434181),
    (902.597361, -3106.755291, 4049.434181),
    (894.571227, -3095.099253, 4028.534407),
    (885.129706, -3080.725957, 4002.624884),
    (873.218342, -3064.520434, 3973.758993),
    (861.669398, -3046.685071, 3942.683215),
    (849.071904, -3027.732668, 3910.575643),
    (833.515830, -3006.389971, 3873.988838),
    (817.355759, -2983.315215, 3834.884139),
    (800.943243, -2959.589109, 3796.018173),
)

# Force on the upper one of two blocks of rubber, pressed (4 increments) and dragged (20):
# verification/getfem_two_bodies.py, GetFEM 5.4.2; without friction the first five alone.
GETFEM_TWO = {
    0.0: (
        (-0.036800, 20.774303),
        (-0.080402, 51.335716),
        (-0.212960, 88.163853),
        (-0.450409, 130.210783),
        (-0.468474, 130.743930),
    ),
    0.3: (
        (-0.391611, 20.787631),
        (-1.099645, 51.393293),
        (-2.084633, 88.255139),
        (-3.273903, 130.410141),
        (-29.902359, 132.464154),
        (-39.101052, 133.224776),
        (-39.103988, 133.395997),
        (-39.064817, 133.361777),
        (-39.176574, 133.338769),
        (-39.197099, 133.535408),
        (-39.122956, 133.439929),
        (-39.186249, 133.356338),
        (-39.242173, 133.579321),
        (-39.135419, 133.444666),
        (-39.186856, 133.362778),
        (-39.238505, 133.549076),
        (-39.127415, 133.407929),
        (-39.183694, 133.362922),
        (-39.229859, 133.473675),
        (-39.114699, 133.328366),
        (-39.136417, 133.276731),
        (-39.186887, 133.315081),
        (-39.078466, 133.180799),
        (-39.025378, 133.079172),
    ),
}


@pytest.mark.parametrize("cross_check", [False, True])
def test_rubber_block_under_a_disc(cross_check):
    """Half a block 5 x 10 is pressed by 3 with a disc of radius 4, without friction.

    Mesh, elements, quadrature and penalty are those of the reference, which shares no code. 1e-7 of
    the force: six decimals are recorded.
    """
    mesh, tags = block_mesh("quadrilateral", n=(10, 20), size=(5.0, 10.0))
    u = fem.Function(displacement_space(mesh, 2))
    body = NeoHookean(u, 1000.0, 0.3, "plane strain")
    bcs = [
        dirichlet_bc(u, tags, BOTTOM, 0),
        dirichlet_bc(u, tags, BOTTOM, 1),
        dirichlet_bc(u, tags, LEFT, 0),
    ]
    shift = fem.Constant(mesh, np.zeros(2))
    disc = fc.Ball((0.0, 14.0), 4.0, displacement=shift)
    surface = fc.ContactSurface(mesh, tags, TOP)
    contact = fc.Contact(u, surface, disc, fc.Frictionless(1e4), kinematics="finite")
    dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": 4})
    F = body.residual(ufl.TestFunction(u.function_space), dx)
    problem = fc.ContactProblem(F, u, bcs=bcs, contacts=[contact], cross_check=cross_check)
    iterations = 0
    for number, expected in enumerate(GETFEM, 1):
        shift.value[1] = -0.25 * number
        step = problem.solve()
        problem.commit()
        assert -contact.resultants().force[1] == pytest.approx(expected, rel=1e-7)
        assert bool(step.verdict.cross_check) == cross_check
        iterations += step.iterations
    assert iterations <= 42  # GetFEM, with its simplest line search: 125


def test_rubber_block_pressed_turned_and_dragged():
    """A block 16 x 10 with μ = 0.3: pressed by 3, the disc rotated by 0.8, then dragged by 2.

    During the rotation points stick, then slip, until all of them slip; dragging adds only slip
    distance. 1e-7 of the normal force, also for the torque over the radius: six decimals are
    recorded.
    """
    mesh, tags = block_mesh("quadrilateral", n=(32, 20), size=(16.0, 10.0))
    mesh.geometry.x[:, 0] -= 8
    u = fem.Function(displacement_space(mesh, 2))
    body = NeoHookean(u, 1000.0, 0.3, "plane strain")
    bcs = [dirichlet_bc(u, tags, BOTTOM, 0), dirichlet_bc(u, tags, BOTTOM, 1)]
    shift, angle = fem.Constant(mesh, np.zeros(2)), fem.Constant(mesh, 0.0)
    turn = fc.Rotation(angle, about=(0.0, 14.0))
    disc = fc.Ball((0.0, 14.0), 4.0, displacement=shift, rotation=turn)
    surface = fc.ContactSurface(mesh, tags, TOP)
    law = fc.Coulomb(0.3, 1e4, 1e3)
    contact = fc.Contact(u, surface, disc, law, kinematics="finite")
    dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": 4})
    F = body.residual(ufl.TestFunction(u.function_space), dx)
    problem = fc.ContactProblem(
        F, u, bcs=bcs, contacts=[contact], petsc_options={"snes_rtol": 1e-11}
    )
    iterations = 0
    for number, expected in enumerate(GETFEM_FRICTION, 1):
        shift.value[1] = -0.25 * min(number, 12)
        angle.value = 0.1 * np.clip(number - 12, 0, 8)
        shift.value[0] = 0.25 * max(number - 20, 0)
        iterations += problem.solve().iterations
        problem.commit()
        (x, y), centre = contact.resultants().force, (shift.value[0], 14.0 + shift.value[1])
        computed = np.array([x, y, contact.moment(centre)[0] / 4.0])
        reference = np.array(expected) / (1.0, 1.0, 4.0)
        assert computed == pytest.approx(reference, abs=1e-7 * abs(expected[1]))
    # GetFEM: 282; without the tractions of sticking points in the predictor 170.
    assert iterations <= 115


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_rubber_block_dragged_over_another(friction):
    """Mesh, elements, points, penalty and friction are the reference's, which shares no code.

    There opposite points are found by GetFEM's raytracing, and derivatives are those of its
    language. 1e-7 of the largest force: six decimals are recorded. Its brick for large sliding,
    with multipliers linear along the side, has forces of 137.7 and 40.35 at the end, 3.5 % more:
    nothing penetrates, here by up to 4 % of the depth.
    """
    setup = sliding_rubber_block.SlidingRubberBlock(friction)
    problem = fc.ContactProblem(
        setup.residual,
        setup.u,
        bcs=setup.bcs,
        contacts=[setup.contact],
        petsc_options={"snes_rtol": 1e-11},
    )
    iterations, size = 0, 135.0
    for place, expected in zip(sliding_rubber_block.PATH, GETFEM_TWO[friction], strict=False):
        setup.set_top_displacement(*place)
        iterations += problem.solve().iterations
        problem.commit()
        computed = setup.contact.resultants().force
        assert computed == pytest.approx(np.array(expected), abs=1e-7 * size)
    # GetFEM with full steps, to 1e-9: 200 with friction, 27 in five increments without it.
    assert iterations <= (125 if friction else 30)


def test_body_rotated_with_its_tool_takes_few_iterations():
    """A full rotation in 36 increments restores the first tractions, to 1e-9, the tolerance.

    The predictor follows body and tool: 228 iterations; 335 if it assumed the tool to be at rest,
    and 344 without following tools at all.
    """
    steps, error = rotate_together(36)("newton")
    assert error < 1e-9
    assert sum(step.iterations for step in steps) <= 250
