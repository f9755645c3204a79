"""Penetration and tunnelling at the deformed positions, away from the quadrature points of Γc.

The equations of every scene hold within its kinematics, with a contact force that is zero or far
too small. The reference is the geometry: a state with overlapping bodies, or with a body that has
passed through another one, must be refused. Similar scenes without overlap must be solved.
"""

import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenics_contact as fc
from fenics_contact.elasticity import LinearElastic
from scenes.blocks import BOTTOM as BLOCK_BOTTOM
from scenes.blocks import TOP as BLOCK_TOP
from scenes.blocks import block_mesh, dimension
from scenes.bodies import Bodies, boxes
from scenes.comparison import assert_raised_on_all_ranks
from scenes.elasticity import dirichlet_bc, displacement_space
from scenes.tags import any_of, at_coordinate, at_interface

pytestmark = pytest.mark.two_ranks
E = 1000.0
BOTTOM, TOP, FLOOR, HELD, SIDES = range(1, 6)
KINEMATICS = pytest.mark.parametrize("kinematics", ["small", "finite"])


def block(low=0.0, bend=None, length=1.0, n=(8, 4)):
    """Return a block over [0, length] with its underside at a height."""
    axes = [[np.linspace(0.0, length, n[0] + 1), low + np.linspace(0.0, 0.5, n[1] + 1)]]
    sides = {BOTTOM: at_coordinate(1, low), TOP: at_coordinate(1, low + 0.5)}
    return Bodies(boxes(axes, sides, bend=bend), E, 0.3)


def assert_increment_refused(problem, *words):
    """Assert that the next increment fails on all ranks with these words."""
    assert_raised_on_all_ranks(problem.solve, fc.NotConverged, *words)


def plate(half):
    """Return a plate about y = 0 of thickness 2 ``half``."""
    return fc.SignedDistance(lambda x: abs(x[1]) - half)


@KINEMATICS
@pytest.mark.parametrize("body_of_ball", [0, 1])
def test_obstacle_inside_of_a_body_is_refused(body_of_ball, kinematics):
    """A ball inside of one of two blocks is refused; between the blocks it is accepted."""
    lines = np.linspace(0.0, 1.0, 5)
    axes = [[lines, lines], [2.0 + lines, lines]]
    around = any_of(*(at_coordinate(0, x) for x in (0.0, 1.0, 2.0, 3.0)), at_coordinate(1, 0.0))
    body = Bodies(boxes(axes, {SIDES: around, TOP: at_coordinate(1, 1.0)}), E, 0.3)
    body.prescribe(TOP, 0, 1)

    def problem(x):
        ball = fc.Ball((x, 0.5), 0.2)
        return body.problem(body.contact(SIDES, ball, fc.Frictionless(), kinematics=kinematics))

    x = 0.5 + 2 * body_of_ball
    assert_raised_on_all_ranks(
        lambda: problem(x), ValueError, "the obstacle is inside of the undeformed"
    )
    assert problem(1.5).solve().verdict.failures == []


@pytest.mark.parametrize("half", [0.01, 1e-4])
@pytest.mark.parametrize("steps", [1, 2])
def test_tunnelling_through_a_thin_plate_is_refused(half, steps):
    """A block moves by 1.5 through a plate in one or two increments; no point ends inside."""
    body = block(low=0.5)
    down = body.constant()
    body.prescribe(TOP, 0)
    body.prescribe(TOP, 1, value=down)
    contact = body.contact(BOTTOM, plate(half), fc.Frictionless(), kinematics="finite")
    problem = body.problem(contact)
    down.value = -1.5 / steps
    assert_increment_refused(problem, "has crossed")
    down.value = -0.4  # still above the plate
    assert problem.solve().verdict.failures == []


def test_soft_contact_does_not_tunnel_in_small_increments():
    """With soft springs a point in contact would reach the other side of the plate."""
    body = block()
    up = body.constant(np.zeros(2))
    body.prescribe(TOP, 0, 1)
    obstacle = fc.SignedDistance(lambda x: abs(x[1] + 0.01) - 0.01, displacement=up)
    contact = body.contact(BOTTOM, obstacle, fc.Frictionless(k_n=E), kinematics="finite")
    problem = body.problem(contact)
    forces = []
    with pytest.raises(fc.NotConverged, match="has crossed"):
        for up.value[1] in 0.003 * np.arange(30):
            problem.solve()
            problem.commit()
            forces.append(contact.resultants().normal_force)
    assert len(forces) > 3
    assert np.all(np.diff(forces) > 0)


@pytest.mark.parametrize("law", [fc.Frictionless(8000.0), fc.Tresca(0.2, 1.0, 8000.0, 4000.0)])
def test_plate_thinner_than_the_resolution_does_not_change_sides(law):
    """A plate, 2 % of a facet thick, moves by 1.2 % of a facet in one increment.

    The points of Γc end below the middle of the plate, which would push them down: refused. In
    increments of 0.4 % the force is upward and increases.
    """
    body = block(n=(1, 1))
    up = body.constant(np.zeros(2))
    body.prescribe(TOP, 0, 1)
    obstacle = fc.SignedDistance(lambda x: abs(x[1] + 0.0105) - 0.01, displacement=up)
    contact = body.contact(BOTTOM, obstacle, law, kinematics="finite")
    problem = body.problem(contact)
    problem.solve()
    problem.commit()
    up.value[1] = 0.012
    assert_increment_refused(problem, "has crossed")
    forces = []
    for up.value[1] in (0.004, 0.008, 0.012):
        problem.solve()
        problem.commit()
        forces.append(contact.resultants().force[1])
    assert forces[0] > 0
    assert np.all(np.diff(forces) > 0)


@KINEMATICS
def test_tunnelling_is_refused_again_after_a_refused_increment(kinematics):
    """A path starts from the committed state, not from a refused trial state."""
    body = block()
    up = body.constant(np.zeros(2))
    body.prescribe(TOP, 0, 1)
    obstacle = fc.SignedDistance(lambda x: abs(x[1] + 0.05) - 0.01, displacement=up)
    contact = body.contact(BOTTOM, obstacle, fc.Frictionless(), kinematics=kinematics)
    problem = body.problem(contact)
    up.value[1] = 0.7
    assert_increment_refused(problem, "has crossed")
    up.value[1] = 0.6
    assert_increment_refused(problem, "has crossed")
    up.value[1] = 0.03
    problem.solve()


@KINEMATICS
def test_tunnelling_is_refused_without_recovered_interior_displacement(kinematics):
    """A ball of radius 0.2 moves by 0.9 until it is entirely inside of the block.

    Unless this is verified without the interior displacement, the increment passes without a force
    and the next one begins inside.
    """
    body = block()
    up = body.constant(np.zeros(2))
    body.prescribe(TOP, 0, 1)
    ball = fc.Ball((0.5, -0.65), 0.2, displacement=up)
    contact = body.contact(BOTTOM, ball, fc.Frictionless(), kinematics=kinematics)
    problem = body.problem(contact, condensation=True)
    up.value[1] = 0.9
    assert_raised_on_all_ranks(
        lambda: problem.solve(recover_interior=False), fc.NotConverged, "has crossed"
    )
    up.value[1] = 0.44
    assert not problem.solve(recover_interior=False).complete
    assert contact.resultants().normal_force == 0.0


def ball_below(moved_by, kinematics, radius=0.2, gap=0.03):
    """Return problem, contact, displacement of the block, and constant that moves the ball."""
    body = block(n=(4, 2))
    shift, center = body.constant(np.zeros(2)), body.constant((0.3, -gap - radius))
    displacement = body.constant()
    body.prescribe(TOP, 0)
    body.prescribe(TOP, 1, value=displacement)
    if moved_by == "distance":
        ball = fc.SignedDistance(lambda x: ufl.sqrt(ufl.dot(x - center, x - center)) - radius)
    else:
        ball = fc.Ball(center, radius, displacement=shift)
    contact = body.contact(BOTTOM, ball, fc.Frictionless(), kinematics=kinematics)
    moved = shift if moved_by == "displacement" else center
    return body.problem(contact), contact, displacement, moved.value


@KINEMATICS
@pytest.mark.parametrize("moved_by", ["center", "distance"])
@pytest.mark.parametrize("radius", [0.01, 0.2])
def test_tunnelling_of_an_obstacle_moved_by_a_constant_is_refused(radius, moved_by, kinematics):
    """The ball ends entirely inside of the block or beyond it, without a `displacement`.

    The next path does not start from the refused state.
    """
    problem, _, _, place = ball_below(moved_by, kinematics, radius)
    start = place.copy()
    for displacement in (0.47, 0.47, 1.2):
        place[:] = start[0], start[1] + displacement
        assert_increment_refused(problem, "has crossed")
    place[:] = start[0] + 0.3, start[1] + 0.02  # still below the block
    assert problem.solve().verdict.failures == []


def test_center_and_displacement_of_a_ball_give_the_same_force():
    """Pressed, moved sideways, and moved with the block: the forces agree to 1e-9."""
    forces = []
    for moved_by in ("displacement", "center"):
        problem, contact, body_displacement, place = ball_below(moved_by, "finite", gap=0.0)
        computed = []
        for displacement in ((0.0, 0.01), (0.4, 0.0), (0.0, -0.5)):
            place[:] += displacement
            body_displacement.value = min(displacement[1], 0.0)
            problem.solve()
            problem.commit()
            computed.append(contact.resultants().normal_force)
        forces.append(computed)
    assert forces[1] == pytest.approx(forces[0], rel=1e-9)
    assert min(forces[1]) > 0


def refuse_pin(center, radius, ups, kinematics):
    """Assert that one of these upward displacements of a pin into a block is refused."""
    body = block(n=(4, 2))
    up = body.constant(np.zeros(2))
    body.prescribe(TOP, 0, 1)
    pin = fc.Ball(center, radius, displacement=up)
    contact = body.contact(BOTTOM, pin, fc.Frictionless(), kinematics=kinematics)
    problem = body.problem(contact)
    with pytest.raises(fc.NotConverged):
        for up.value[1] in ups:
            problem.solve()
            problem.commit()


@pytest.mark.each
@KINEMATICS
@pytest.mark.parametrize("position", [0.07, 0.3, 0.55])
@pytest.mark.parametrize("steps", [1, 2, 4])
def test_pin_does_not_pass_between_checked_positions(steps, position, kinematics):
    """A pin of radius 0.01 moves by 0.6 into facets of 0.25; no checked position ends in it."""
    refuse_pin((position, -0.03), 0.01, np.linspace(0.0, 0.6, steps + 1)[1:], kinematics)


@pytest.mark.each
@KINEMATICS
@pytest.mark.parametrize("position", [0.25, 0.3, 0.55])
@pytest.mark.parametrize("far", [0.03, 0.4])
def test_pin_thinner_than_the_allowed_penetration_does_not_pass(far, position, kinematics):
    """A pin of diameter 0.008 enters a facet of 0.25 by less than allowed, then moves farther."""
    refuse_pin(
        (position, -0.005), 0.004, [0.002, 0.004, 0.006, 0.008, 0.01, 0.012, far], kinematics
    )


@KINEMATICS
@pytest.mark.parametrize("position", [0.55, 0.6, 0.65])
@pytest.mark.parametrize("steps", [1, 2, 7])
def test_blade_does_not_penetrate_a_facet(steps, position, kinematics):
    """An upright blade, 0.02 thick, moves by 0.3 into facets of 0.25.

    The shortest path out of it is sideways, so that it may not resist points inside. No increment
    passes with the tip deeper than 7 % of a facet.
    """
    body = block(n=(4, 2))
    up = body.constant(np.zeros(2))
    body.prescribe(TOP, 0, 1)

    def blade(x):
        along = ufl.max_value(-0.65, ufl.min_value(-0.05, x[1]))
        return ufl.sqrt((x[0] - position) ** 2 + (x[1] - along) ** 2) - 0.01

    obstacle = fc.SignedDistance(blade, displacement=up)
    contact = body.contact(BOTTOM, obstacle, fc.Frictionless(), kinematics=kinematics)
    problem = body.problem(contact)
    reached = 0.0
    with pytest.raises(fc.NotConverged):
        for t in np.linspace(0.0, 0.35, steps + 1)[1:]:
            up.value[1] = t
            problem.solve()
            problem.commit()
            reached = t
    assert reached - 0.04 <= 0.07 * 0.25


@pytest.mark.each
@KINEMATICS
@pytest.mark.parametrize(("position", "slide"), [(0.3, 0.1), (0.35, -0.15), (0.7, -0.15)])
def test_pin_that_also_moves_sideways_is_detected(kinematics, position, slide):
    """A pin of radius 8 % of a facet moves in by 35 % and sideways, away from where it enters.

    It ends above Γc by more than the allowed 7 %, and no point resists.
    """
    body = block(n=(2, 1))
    move = body.constant(np.zeros(2))
    body.prescribe(TOP, 0, 1)
    contact = body.contact(
        BOTTOM,
        fc.Ball((position, -0.04), 0.04, displacement=move),
        fc.Frictionless(),
        kinematics=kinematics,
        quadrature=2,
    )
    problem = body.problem(contact)
    move.value[:] = slide, 0.175
    assert_increment_refused(problem, "has crossed")


def capsule(center, half, radius):
    """Return the distance of a plate along x with round ends."""

    def distance(x):
        along = x[0] - center[0]
        along -= ufl.max_value(-half, ufl.min_value(half, along))
        return ufl.sqrt(along**2 + (x[1] - center[1]) ** 2) - radius

    return distance


@pytest.mark.parametrize("half", [0.07, 0.0])
def test_sliding_past_a_thin_tip_is_not_tunnelling(half):
    """A plate of length 0.14, or a pin, is pressed in by 2 % of a facet and moved sideways.

    Points of Γc pass from one end to the other at less than the radius below the tip. Without
    friction, the force after one increment agrees with that after three to 1e-6.
    """
    forces = []
    for steps in (1, 3):
        body = block(n=(8, 2))
        move = body.constant(np.zeros(2))
        body.prescribe(TOP, 0, 1)
        obstacle = fc.SignedDistance(capsule((0.25, -0.01), half, 0.01), displacement=move)
        contact = body.contact(BOTTOM, obstacle, fc.Frictionless(), kinematics="finite")
        problem = body.problem(contact)
        for move.value[:] in [
            (0.0, 0.0025),
            *((x, 0.0025) for x in 0.3 * np.arange(1, steps + 1) / steps),
        ]:
            problem.solve()
            problem.commit()
        forces.append(contact.resultants().normal_force)
    assert forces[0] == pytest.approx(forces[1], rel=1e-6, abs=1e-9 * E)


def test_corners_in_a_cavity_are_accepted_as_the_points_predict():
    """A block is lowered into a cavity that fits its lower corners, without friction.

    At first the corners penetrate by 10 % of the facets, which the curved wall explains, and no
    point is in contact. Then points are, and the force balances the reaction, to 1e-7.
    """
    body = block(n=(2, 1))
    down = body.constant(0.0)
    body.prescribe(TOP, 0)
    body.prescribe(TOP, 1, value=down)
    centre = np.array([0.5, 0.374])
    wall = fc.Ball(centre, np.linalg.norm(centre), inside=True)
    contact = body.contact(BOTTOM, wall, fc.Frictionless(), kinematics="finite", quadrature=2)
    problem = body.problem(contact)
    down.value = -0.08
    problem.solve()
    problem.commit()
    corner = np.linalg.norm(np.array([0.0, -0.08]) - centre) - np.linalg.norm(centre)
    assert corner > 0.1 * 0.5
    assert contact.resultants().normal_force == 0.0
    down.value = -0.15
    problem.solve()
    force = contact.resultants().force[1]
    assert force > 0.0
    assert -body.reaction(TOP)[1] == pytest.approx(force, rel=1e-7)


@KINEMATICS
def test_slanted_plate_does_not_pass_through_a_corner(kinematics):
    """A plate, 0.02 thick, moves up by 0.018 where vertex quadrature has a point, at a corner.

    The corner ends in the upper half of the plate, which would press it out on the wrong side.
    """
    body = block(n=(3, 3))
    up = body.constant(np.zeros(2))
    body.prescribe(TOP, 0, 1)

    def slanted(x):
        along = ufl.max_value(0.1, ufl.min_value(1.3, x[0]))
        height = x[1] + 0.026 - 0.05 * (along - 0.7)
        return ufl.sqrt((x[0] - along) ** 2 + height**2) - 0.01

    obstacle = fc.SignedDistance(slanted, displacement=up)
    surface = fc.ContactSurface(body.mesh, body.tags, BOTTOM, quadrature_scheme="vertex")
    contact = fc.Contact(body.u, surface, obstacle, fc.Frictionless(), kinematics=kinematics)
    problem = body.problem(contact)
    up.value[1] = 0.018
    assert_increment_refused(problem, "has crossed")


@KINEMATICS
@pytest.mark.parametrize("sides", [(BOTTOM,), (BOTTOM, SIDES)])
def test_blade_does_not_pass_sideways_through_a_body(kinematics, sides):
    """An upright blade moves by 1.6 from one side of the body to the other: refused.

    The flanks, through which it enters and leaves, need not belong to Γc.
    """
    flanks = {
        SIDES: lambda x, cell: at_coordinate(0, 0.0)(x, cell) | at_coordinate(0, 1.0)(x, cell)
    }
    axes = [[np.linspace(0.0, 1.0, 9), np.linspace(0.0, 0.5, 5)]]
    body = Bodies(
        boxes(axes, {BOTTOM: at_coordinate(1, 0.0), TOP: at_coordinate(1, 0.5), **flanks}), E, 0.3
    )
    move = body.constant(np.zeros(2))
    body.prescribe(TOP, 0, 1)

    def blade(x):
        along = ufl.max_value(-0.65, ufl.min_value(0.2, x[1]))
        return ufl.sqrt((x[0] + 0.3) ** 2 + (x[1] - along) ** 2) - 0.01

    obstacle = fc.SignedDistance(blade, displacement=move)
    problem = body.problem(body.contact(sides, obstacle, fc.Frictionless(), kinematics=kinematics))
    move.value[0] = -0.2
    assert problem.solve().verdict.failures == []
    move.value[0] = 1.6
    assert_increment_refused(problem, "has crossed")


def test_bending_of_a_facet_is_not_tunnelling():
    """A ball bends two quadratic facets by half of its radius, in one increment and in five.

    It crosses their chords by 12 % of their length, but not the facets. The forces agree to 1e-6.
    """
    forces = []
    for steps in (1, 5):
        axes = [[np.linspace(0.0, 1.0, 3), np.linspace(0.0, 0.5, 3)]]
        body = Bodies(
            boxes(axes, {BOTTOM: at_coordinate(1, 0.0), TOP: at_coordinate(1, 0.5)}),
            E,
            0.3,
            degree=2,
        )
        move = body.constant(np.zeros(2))
        body.prescribe(TOP, 0, 1)
        ball = fc.Ball((0.25, -0.3), 0.3, displacement=move)
        contact = body.contact(BOTTOM, ball, fc.Frictionless(), kinematics="finite")
        problem = body.problem(contact)
        for move.value[1] in 0.15 * np.arange(1, steps + 1) / steps:
            problem.solve()
            problem.commit()
        forces.append(contact.resultants().normal_force)
    assert forces[0] == pytest.approx(forces[1], rel=1e-6)


@pytest.mark.parametrize("steps", [1, 4])
def test_rotation_of_a_blade_through_a_body_is_refused(steps):
    """The blade turns by 1 rad from below the body to above; no point ends inside of it."""

    def blade(x):
        tip, grip = ufl.as_vector((1.5, -0.3)), ufl.as_vector((-1.0, -0.3))
        arm, along = x - grip, tip - grip
        fraction = ufl.dot(arm, along) / ufl.dot(along, along)
        fraction = ufl.conditional(fraction < 0, 0.0, ufl.conditional(fraction > 1, 1.0, fraction))
        off = arm - fraction * along
        return ufl.sqrt(ufl.dot(off, off)) - 0.01

    body = block()
    body.prescribe(TOP, 0, 1)
    angle = body.constant()
    obstacle = fc.SignedDistance(blade, rotation=fc.Rotation(angle, (-1.0, -0.3)))
    problem = body.problem(body.contact(BOTTOM, obstacle, fc.Frictionless(), kinematics="finite"))
    with pytest.raises(fc.NotConverged, match=r"has crossed|penetrates"):
        for angle.value in np.linspace(0.0, 1.0, steps + 1)[1:]:
            problem.solve()
            problem.commit()


@pytest.mark.each
@pytest.mark.parametrize("angle", [1.5 * np.pi, 2 * np.pi, -4 * np.pi])
@pytest.mark.parametrize("length", [1.2, 0.45])
def test_full_turn_of_a_blade_through_a_body_is_refused(length, angle):
    """The pivot is 0.5 away from a block on soft springs; the blade ends outside of the block.

    In one increment the longer blade passes through the block. The shorter one does not reach it:
    no force.
    """
    all_around = any_of(*(at_coordinate(i, value) for i in (0, 1) for value in (0.0, 1.0)))
    body = Bodies(boxes([[np.linspace(0.0, 1.0, 5)] * 2], {SIDES: all_around}), E, 0.3)
    body.F += 0.01 * E * ufl.dot(body.u, body.v) * ufl.dx
    turned = body.constant()

    def blade(x):
        along = ufl.max_value(0.5 - length, ufl.min_value(0.5, x[1]))
        return ufl.sqrt((x[0] + 0.5) ** 2 + (x[1] - along) ** 2) - 0.01

    obstacle = fc.SignedDistance(blade, rotation=fc.Rotation(turned, (-0.5, 0.5)))
    contact = body.contact(SIDES, obstacle, fc.Frictionless(), kinematics="finite")
    problem = body.problem(contact)
    turned.value = angle
    if length > 0.5:
        assert_increment_refused(problem, "has crossed")
    else:
        assert problem.solve().verdict.failures == []
        assert contact.resultants().normal_force == 0.0


def test_rotation_of_a_frictionless_ball_changes_no_force():
    """A ball is pressed in by 0.005 and turned twice about its centre: same force to 1e-9."""
    body = block()
    body.prescribe(TOP, 0, 1)
    turned = body.constant()
    ball = fc.Ball((0.5, -0.295), 0.3, rotation=fc.Rotation(turned, (0.5, -0.295)))
    contact = body.contact(BOTTOM, ball, fc.Frictionless(), kinematics="finite")
    problem = body.problem(contact)
    problem.solve()
    problem.commit()
    force = contact.resultants().normal_force
    turned.value = 4 * np.pi
    problem.solve()
    assert contact.resultants().normal_force == pytest.approx(force, rel=1e-9)
    assert force > 0


@pytest.mark.each
@KINEMATICS
@pytest.mark.parametrize("position", [0.5, 0.53, 0.5625, 0.46])
def test_ball_between_quadrature_points_is_detected(kinematics, position):
    """A ball of a fifth of a facet is pressed in by more than its diameter, anywhere on a facet."""
    body = block()
    body.prescribe(TOP, 0, 1)
    up = body.constant(np.zeros(2))
    ball = fc.Ball((position, -0.0125), 0.0125, displacement=up)
    problem = body.problem(body.contact(BOTTOM, ball, fc.Frictionless(), kinematics=kinematics))
    up.value[1] = -0.01
    assert problem.solve().verdict.failures == []
    problem.commit()
    with pytest.raises(fc.NotConverged, match=r"has crossed|penetrates|too large|exceeds half"):
        for up.value[1] in (0.01, 0.02, 0.03):
            problem.solve()
            problem.commit()


@pytest.mark.parametrize("kind", ["rests", "hovers"])
def test_penetration_of_open_points_is_detected(kind):
    """With small displacements the points of a raised part stay open when it moves over a bump.

    With finite kinematics the body is lifted off, or meets the bump.
    """

    def step(x):
        x = x.copy()
        rise = np.clip((x[:, 0] - 0.9) / 0.2, 0.0, 1.0)
        x[:, 1] += 0.2 * rise * (1 - x[:, 1] / 0.5)
        return x

    rests = kind == "rests"
    body = block(bend=step if rests else None, low=0.0 if rests else 0.05, length=2.0, n=(20, 5))
    along = body.constant()
    body.prescribe(TOP, 1, value=-0.005 if rests else 0.0)
    body.prescribe(TOP, 0, value=along)
    floor = [[5, 0], [3.2, 0], [2.9, 0.12], [2.6, 0.25], [2.3, 0.12], [2, 0], [1, 0], [-3, 0]]
    contact = body.contact(BOTTOM, fc.RigidProfile(np.array(floor, dtype=float)), fc.Frictionless())
    problem = body.problem(contact)
    with pytest.raises(
        fc.NotConverged, match=r"too large for the small-displacement|penetrates|crossed"
    ):
        for along.value in np.linspace(0.0, 0.8, 21):
            problem.solve()
            problem.commit()


@pytest.mark.each
@KINEMATICS
@pytest.mark.parametrize("displacement", [0.3, 0.7, 2.5])
def test_body_does_not_enter_another_one_sideways(kinematics, displacement):
    """A block above a floor, with its underside as Γc, moves into a post, or past it."""
    axes = [
        [np.linspace(0.0, 1.0, 9), 0.3 + np.linspace(0.0, 0.5, 5)],
        [np.linspace(0.0, 3.0, 13), np.linspace(-0.5, 0.0, 3)],
        [np.linspace(1.5, 1.8, 4), np.linspace(0.0, 0.5, 5)],
    ]

    def post(x, cell):
        return (
            at_coordinate(0, 1.5)(x, cell)
            | at_coordinate(0, 1.8)(x, cell)
            | at_coordinate(1, 0.5)(x, cell)
        )

    sides = {
        BOTTOM: at_coordinate(1, 0.3),
        TOP: at_coordinate(1, 0.8),
        FLOOR: at_interface(1, 0.0, above=False),
        HELD: at_coordinate(1, -0.5),
        6: at_interface(1, 0.0, above=True),
        SIDES: post,
    }
    body = Bodies(boxes(axes, sides), E, 0.3)
    along = body.constant()
    body.prescribe(HELD, 0, 1)
    body.prescribe(6, 0, 1)
    body.prescribe(TOP, 1)
    body.prescribe(TOP, 0, value=along)
    opposite = fc.DeformableBody(body.tags, (FLOOR, SIDES))
    problem = body.problem(body.contact(BOTTOM, opposite, fc.Frictionless(), kinematics=kinematics))
    along.value = displacement
    if displacement < 0.5:  # ends before the post
        assert problem.solve().verdict.failures == []
    else:
        assert_increment_refused(problem, "crossed")


@pytest.mark.parametrize("enforcement", ["penalty", "augmented"])
def test_points_that_slide_off_the_other_body_carry_no_force(enforcement):
    """A block slides half off its plate: small displacements give the force of finite kinematics.

    One increment suffices, because contact acts between the pairs at its end. Tolerance 1 % for the
    displacements, 3 % of the thickness, and for multipliers 2 % more, their tolerance.
    """
    forces = []
    for kinematics, steps in (("finite", 10), ("small", 1), ("small", 10)):
        axes = [
            [np.linspace(0.0, 2.0, 17), np.linspace(0.0, 0.5, 5)],
            [np.linspace(1.0, 2.0, 9), 0.5 + np.linspace(0.0, 0.5, 5)],
        ]
        sides = {
            HELD: at_coordinate(1, 0.0),
            FLOOR: at_interface(1, 0.5, above=False),
            BOTTOM: at_interface(1, 0.5, above=True),
            TOP: at_coordinate(1, 1.0),
        }
        body = Bodies(boxes(axes, sides), E, 0.3)
        along = body.constant()
        body.prescribe(HELD, 0, 1)
        body.prescribe(TOP, 1, value=-0.01)
        body.prescribe(TOP, 0, value=along)
        contact = body.contact(
            BOTTOM, FLOOR, fc.Frictionless(), kinematics=kinematics, enforcement=enforcement
        )
        problem = body.problem(contact)
        problem.solve()
        problem.commit()
        for along.value in np.linspace(0.0, 0.5, steps + 1)[1:]:
            problem.solve()
            problem.commit()
        forces.append(contact.resultants().normal_force)
    bound = 0.01 if enforcement == "penalty" else 0.03
    assert forces[1:] == pytest.approx([forces[0]] * 2, rel=bound)


def test_end_face_of_a_slab_is_not_taken_for_penetration():
    """A softer block slides over the end of a slab, whose end face is tagged or not.

    The corner of the slab penetrates by less than the 0.01 of the prescribed displacement, but by
    0.1 along the normal of the end face, which grazes the underside. The forces agree to 1e-9, as
    no point of Γc meets the end face.
    """
    forces = []
    for tags in ((FLOOR,), (FLOOR, SIDES)):
        axes = [
            [np.linspace(0.0, 2.0, 9), np.linspace(0.0, 1.0, 5)],
            [np.linspace(0.5, 1.5, 8), 1.0 + np.linspace(0.0, 1.0, 8)],
        ]
        sides = {
            HELD: at_coordinate(1, 0.0),
            FLOOR: at_interface(1, 1.0, above=False),
            SIDES: at_coordinate(0, 2.0),
            BOTTOM: at_interface(1, 1.0, above=True),
            TOP: at_coordinate(1, 2.0),
        }
        mesh, facets = boxes(axes, sides)
        softer = ufl.conditional(ufl.SpatialCoordinate(mesh)[1] > 1.0, 0.5 * E, E)
        body = Bodies((mesh, facets), softer, 0.3)
        along = body.constant()
        body.prescribe(HELD, 0, 1)
        body.prescribe(TOP, 1, value=-0.01)
        body.prescribe(TOP, 0, value=along)
        contact = body.contact(BOTTOM, tags, fc.Coulomb(0.2), kinematics="finite")
        problem = body.problem(contact)
        computed = []
        for along.value in (0.0, 0.48, 0.97):
            problem.solve()
            problem.commit()
            computed.append(contact.resultants().normal_force)
        forces.append(computed)
    assert forces[1] == pytest.approx(forces[0], rel=1e-9)


@KINEMATICS
def test_pin_next_to_closed_facets_is_detected(kinematics):
    """A slab closes the adjacent facets, and a narrow pin enters between the points of one."""
    width = 0.04
    axes = [
        [np.linspace(0.0, 2.0, 5), np.linspace(0.0, 0.5, 3)],
        [np.linspace(0.0, 0.9, 4), 0.5 + np.linspace(0.0, 0.5, 3)],
        [1.25 + width * np.linspace(-0.5, 0.5, 3), 0.5 + np.linspace(0.0, 0.5, 4)],
    ]
    sides = {
        BOTTOM: at_interface(1, 0.5, above=False),
        FLOOR: at_interface(1, 0.5, above=True),
        HELD: at_coordinate(1, 0.0),
        TOP: at_coordinate(1, 1.0),
    }
    body = Bodies(boxes(axes, sides), E, 0.3)
    body.prescribe(HELD, 0, 1)
    body.prescribe(TOP, 0)
    body.prescribe(TOP, 1, value=-5e-3)
    problem = body.problem(
        body.contact(BOTTOM, FLOOR, fc.Frictionless(), kinematics=kinematics, quadrature=2)
    )
    assert_increment_refused(problem, "penetrates", "1.2")


@KINEMATICS
@pytest.mark.parametrize("both", [False, True])
def test_crossing_ridges_are_detected(kinematics, both):
    """Ridges cross at their edges, and no point of a flank meets the other body."""
    lines, rise = np.linspace(0.0, 1.0, 5), np.linspace(0.0, 0.5, 3)

    def ridges(x):
        x = x.copy()
        lower = 0.45 * (1 - abs(2 * x[:, 1] - 1)) * x[:, 2] / 0.5
        upper = -0.45 * (1 - abs(2 * x[:, 0] - 1)) * (1.9 - x[:, 2]) / 0.5
        x[:, 2] += np.where(x[:, 2] < 0.9, lower, upper)
        return x

    sides = {
        BOTTOM: at_interface(2, 0.5, above=False),
        FLOOR: at_interface(2, 1.4, above=True),
        HELD: at_coordinate(2, 0.0),
        TOP: at_coordinate(2, 1.9),
    }
    body = Bodies(
        boxes([[lines, lines, rise], [lines, lines, 1.4 + rise]], sides, bend=ridges), E, 0.3
    )
    down = body.constant()
    body.prescribe(HELD, 0, 1, 2)
    body.prescribe(TOP, 0, 1)
    body.prescribe(TOP, 2, value=down)
    faces = [(BOTTOM, FLOOR), (FLOOR, BOTTOM)][: 1 + both]
    contacts = [
        body.contact(*face, fc.Frictionless(), kinematics=kinematics, name=f"side {i}")
        for i, face in enumerate(faces)
    ]
    problem = body.problem(*contacts)
    down.value = 0.1  # apart
    assert problem.solve().verdict.failures == []
    problem.commit()
    down.value = -0.05
    assert_increment_refused(problem, "penetrates")


def test_undeformed_vertex_at_a_singular_distance_is_accepted():
    """A ball and a block move up until the ball's centre is at an undeformed vertex.

    There the distance has no gradient. Reference: the force before the motion, to 1e-9.
    """
    body = block()
    displacement, shift = body.constant(), body.constant((0.0, -0.25))
    body.prescribe(TOP, 0)
    body.prescribe(TOP, 1, value=displacement)
    ball = fc.SignedDistance(lambda x: ufl.sqrt(x[1] ** 2 + (x[0] - 0.5) ** 2) - 0.2, shift)
    surface = fc.ContactSurface(body.mesh, body.tags, BOTTOM, quadrature_scheme="vertex")
    contact = fc.Contact(body.u, surface, ball, fc.Frictionless(), kinematics="finite")
    problem = body.problem(contact)
    forces = []
    for up in (-0.25, 0.0):
        displacement.value, shift.value[1] = up + 0.19, up
        problem.solve()
        problem.commit()
        forces.append(contact.resultants().normal_force)
    assert forces[0] > 1.0
    assert forces[1] == pytest.approx(forces[0], rel=1e-9)


@pytest.mark.parametrize("tags", [(FLOOR, BOTTOM), (BOTTOM, FLOOR)])
def test_soft_contact_with_large_penetration_keeps_its_pairs(tags):
    """Two columns with contact stiffness 1e-3 E/h penetrate by most of the prescribed displacement.

    At twice the penetration of the last commit the normals find no opposite point, and the force is
    0 instead of 2: refused. With half the increment the pressure is that of springs in series,
    d/(1/k + 2 (1 - ν²)/E), to 1e-3, as strains are 1e-3.
    """
    axes = [[np.linspace(0.0, 1.0, 5), y + np.linspace(0.0, 1.0, 5)] for y in (0.0, 1.0)]
    sides = {
        HELD: at_coordinate(1, 0.0),
        FLOOR: at_interface(1, 1.0, above=False),
        BOTTOM: at_interface(1, 1.0, above=True),
        TOP: at_coordinate(1, 2.0),
        SIDES: at_coordinate(0, 0.0),
    }
    bodies = Bodies(boxes(axes, sides), E, 0.3)
    down = bodies.constant()
    bodies.prescribe(HELD, 1)
    bodies.prescribe(SIDES, 0)
    bodies.prescribe(TOP, 1, value=down)
    k = 1e-3 * E / 0.25
    contact = bodies.contact(tags[0], (tags[1],), fc.Frictionless(k), kinematics="finite")
    problem = bodies.problem(contact)
    down.value = -0.2
    problem.solve()
    problem.commit()
    down.value = -0.5
    assert_increment_refused(problem, "penetrates")
    for down.value in (-0.35, -0.5):
        problem.solve()
        problem.commit()
    exact = 0.5 / (1 / k + 2 * (1 - 0.3**2) / E)
    assert contact.resultants().normal_force == pytest.approx(exact, rel=1e-3)


@KINEMATICS
@pytest.mark.parametrize("n", [(4, 4), (1, 1)])
def test_block_with_its_sides_in_the_contact_surface_slides(n, kinematics):
    """A block with sides in Γc slides on a floor by a fifth of its width in one increment.

    Reference: friction μ N in full slip, to 1e-9.
    """
    axes = [[np.linspace(0.0, 1.0, n[0] + 1), np.linspace(0.0, 0.5, n[1] + 1)]]
    tags = {
        BOTTOM: at_coordinate(1, 0.0),
        TOP: at_coordinate(1, 0.5),
        SIDES: any_of(at_coordinate(0, 0.0), at_coordinate(0, 1.0)),
    }
    body = Bodies(boxes(axes, tags), E, 0.3)
    down, along = body.constant(-1e-3), body.constant()
    body.prescribe(TOP, 1, value=down)
    body.prescribe(TOP, 0, value=along)
    surface = fc.ContactSurface(body.mesh, body.tags, [BOTTOM, SIDES])
    floor = fc.HalfSpace((0.0, 0.0), (0.0, 1.0))
    contact = fc.Contact(body.u, surface, floor, fc.Coulomb(0.3), kinematics=kinematics)
    problem = body.problem(contact)
    for along.value in (0.0, 0.2):
        problem.solve()
        problem.commit()
    force = contact.resultants().force
    assert -force[0] == pytest.approx(0.3 * force[1], rel=1e-9)


@pytest.mark.parametrize("n", [1, 2])
def test_roller_passes_the_end_of_a_block_and_returns(n):
    """Γc is the bottom and the end of a block; the penetration is far below the facet size.

    Without friction the forces of the return agree with those of the outward motion to 1e-6.
    """
    axes = [[np.linspace(0.0, 1.0, n + 1), np.linspace(0.0, 1.0, n + 1)]]
    tags = {BOTTOM: at_coordinate(1, 0.0), TOP: at_coordinate(1, 1.0), SIDES: at_coordinate(0, 1.0)}
    body = Bodies(boxes(axes, tags, simplex=True), E, 0.3)
    body.prescribe(TOP, 0, 1)
    shift = body.constant((0.0, 0.01))
    roller = fc.Ball((0.6, -0.3), 0.3, displacement=shift)
    surface = fc.ContactSurface(body.mesh, body.tags, [BOTTOM, SIDES])
    contact = fc.Contact(body.u, surface, roller, fc.Frictionless(), kinematics="finite")
    problem = body.problem(contact)
    forces = []
    for displacement in [*np.arange(0.0, 1.3, 0.2), *np.arange(1.0, -0.1, -0.2)]:
        shift.value[0] = displacement
        problem.solve()
        problem.commit()
        forces.append(contact.resultants().force)
    forces = np.array(forces)
    assert np.abs(forces[:7] - forces[::-1][:7]).max() <= 1e-6 * np.abs(forces).max()


@pytest.mark.parametrize(
    ("kinematics", "turned"), [("small", 0.0), ("finite", 0.0), ("finite", 2.5)]
)
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron", "hexahedron"])
def test_penetration_of_nodes_off_quadrature_points_is_refused(cell, kinematics, turned, caplog):
    """With vertex quadrature the edge nodes of quadratic elements pass through the floor.

    The points resist only displacements that are linear on a facet, and penetrate little, while the
    midpoints of edges penetrate by a tenth of the facet. The floor may have turned.
    """
    d = dimension(cell)
    mesh, tags = block_mesh(cell, n=1)
    u = fem.Function(displacement_space(mesh, 2))
    body = LinearElastic(u, E, 0.45, {2: "plane strain", 3: "3D"}[d])
    F = body.residual(ufl.TestFunction(u.function_space), ufl.dx(mesh))
    down = fem.Constant(mesh, 0.0)
    bcs = [dirichlet_bc(u, tags, BLOCK_TOP, i) for i in range(d - 1)]
    bcs.append(dirichlet_bc(u, tags, BLOCK_TOP, d - 1, down))
    centre, up = np.full(d, 0.5), np.eye(d)[-1]
    centre[-1] = -100.0
    angle = fem.Constant(mesh, 0.0)
    floor = fc.HalfSpace(np.zeros(d), up)
    if turned:
        axis = None if d == 2 else (0, 1, 0)
        floor = fc.Cylinder(centre, 100.0, axis, rotation=fc.Rotation(angle, centre, axis))

    def contact(scheme):
        surface = fc.ContactSurface(mesh, tags, BLOCK_BOTTOM, quadrature_scheme=scheme)
        return fc.Contact(u, surface, floor, fc.Frictionless(), kinematics=kinematics)

    problem = fc.ContactProblem(F, u, bcs=bcs, contacts=[contact("vertex")])
    assert ("too soft" in caplog.text) == (mesh.comm.rank == 0)
    down.value, angle.value = -0.1, turned
    assert_increment_refused(problem, "penetrates between the quadrature points")
    u.x.array[:] = 0.0
    assert fc.ContactProblem(F, u, bcs=bcs, contacts=[contact(None)]).solve().verdict.failures == []
