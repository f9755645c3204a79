"""What happens where the model does not look: at the deformed positions, off the points of Γc.

Every scene is a state that the equations of its own kinematics hold in, at a force that is zero or
far too small; the reference is the geometry: what overlaps, or has passed through, is no solution.
Held against it are scenes of the same kind in which nothing overlaps.
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
from scenes.comparing import raised_everywhere
from scenes.elasticity import displacement_space, hold
from scenes.tags import between, either, near

pytestmark = pytest.mark.two_ranks
E = 1000.0
BOTTOM, TOP, FLOOR, HELD, SIDES = range(1, 6)
KINEMATICS = pytest.mark.parametrize("kinematics", ["small", "finite"])


def block(low=0.0, bend=None, length=1.0, n=(8, 4)):
    """A block over [0, length] that stands at a height; its top is held or led."""
    axes = [[np.linspace(0.0, length, n[0] + 1), low + np.linspace(0.0, 0.5, n[1] + 1)]]
    sides = {BOTTOM: near(1, low), TOP: near(1, low + 0.5)}
    return Bodies(boxes(axes, sides, bend=bend), E, 0.3)


def fails(problem, *words):
    """The next increment fails, on all ranks, for this reason."""
    raised_everywhere(problem.solve, fc.NotConverged, *words)


def plate(half):
    """A plate about y = 0, of twice that thickness."""
    return fc.SignedDistance(lambda x: abs(x[1]) - half)


@KINEMATICS
@pytest.mark.parametrize("body_of_ball", [0, 1])
def test_a_body_that_encloses_its_obstacle_is_refused(body_of_ball, kinematics):
    """A ball inside of one of two blocks, all of whose boundary is Γc; between them it is taken."""
    lines = np.linspace(0.0, 1.0, 5)
    axes = [[lines, lines], [2.0 + lines, lines]]
    around = either(*(near(0, x) for x in (0.0, 1.0, 2.0, 3.0)), near(1, 0.0))
    body = Bodies(boxes(axes, {SIDES: around, TOP: near(1, 1.0)}), E, 0.3)
    body.hold(TOP, 0, 1)

    def problem(x):
        ball = fc.Ball((x, 0.5), 0.2)
        return body.problem(body.contact(SIDES, ball, fc.Frictionless(), kinematics=kinematics))

    x = 0.5 + 2 * body_of_ball
    raised_everywhere(lambda: problem(x), ValueError, "the obstacle is inside of the undeformed")
    assert problem(1.5).solve().verdict.failures == []


@pytest.mark.parametrize("half", [0.01, 1e-4])
@pytest.mark.parametrize("steps", [1, 2])
def test_a_thin_plate_is_not_crossed(half, steps):
    """Led 1.5 through it, in one increment and in two: neither a point nor a sample is inside."""
    body = block(low=0.5)
    down = body.constant()
    body.hold(TOP, 0)
    body.hold(TOP, 1, value=down)
    contact = body.contact(BOTTOM, plate(half), fc.Frictionless(), kinematics="finite")
    problem = body.problem(contact)
    down.value = -1.5 / steps
    fails(problem, "has crossed")
    down.value = -0.4  # above it still
    assert problem.solve().verdict.failures == []


def test_a_thin_plate_is_not_crossed_slowly():
    """Springs so soft that a point comes to the plate's other side while it is pressed."""
    body = block()
    up = body.constant(np.zeros(2))
    body.hold(TOP, 0, 1)
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
def test_a_plate_does_not_change_sides_within_the_resolution(law):
    """A plate of 2 % of a facet, led towards it by 1.2 % in one increment.

    Such a path opens no gap that matters, but the points of Γc come out below the middle of the
    plate, which draws them down. In increments of 0.4 % it pushes them up, and more every time.
    """
    body = block(n=(1, 1))
    up = body.constant(np.zeros(2))
    body.hold(TOP, 0, 1)
    obstacle = fc.SignedDistance(lambda x: abs(x[1] + 0.0105) - 0.01, displacement=up)
    contact = body.contact(BOTTOM, obstacle, law, kinematics="finite")
    problem = body.problem(contact)
    problem.solve()
    problem.commit()
    up.value[1] = 0.012
    fails(problem, "has crossed")
    forces = []
    for up.value[1] in (0.004, 0.008, 0.012):
        problem.solve()
        problem.commit()
        forces.append(contact.resultants().force[1])
    assert forces[0] > 0
    assert np.all(np.diff(forces) > 0)


@KINEMATICS
def test_a_plate_is_not_crossed_after_a_cut(kinematics):
    """A trial state that was refused is no start of a path, though its displacement is zero."""
    body = block()
    up = body.constant(np.zeros(2))
    body.hold(TOP, 0, 1)
    obstacle = fc.SignedDistance(lambda x: abs(x[1] + 0.05) - 0.01, displacement=up)
    contact = body.contact(BOTTOM, obstacle, fc.Frictionless(), kinematics=kinematics)
    problem = body.problem(contact)
    up.value[1] = 0.7
    fails(problem, "has crossed")
    up.value[1] = 0.6
    fails(problem, "has crossed")
    up.value[1] = 0.03
    problem.solve()


@KINEMATICS
def test_a_ball_is_not_crossed_where_u_is_found_later(kinematics):
    """Of the radius 0.2, led by 0.9 until it is all in the block, and then on.

    Where u was left behind the first increment passed without a force, and the next one, of which
    all is found, began inside.
    """
    body = block()
    up = body.constant(np.zeros(2))
    body.hold(TOP, 0, 1)
    ball = fc.Ball((0.5, -0.65), 0.2, displacement=up)
    contact = body.contact(BOTTOM, ball, fc.Frictionless(), kinematics=kinematics)
    problem = body.problem(contact, condensation=True)
    up.value[1] = 0.9
    raised_everywhere(lambda: problem.solve(recover_interior=False), fc.NotConverged, "has crossed")
    up.value[1] = 0.44
    assert not problem.solve(recover_interior=False).complete
    assert contact.resultants().normal_force == 0.0


def ball_below(moved_by, kinematics, radius=0.2, gap=0.03):
    """A led block, its displacement, and a ball below it that a constant moves: problem and all."""
    body = block(n=(4, 2))
    shift, center = body.constant(np.zeros(2)), body.constant((0.3, -gap - radius))
    lead = body.constant()
    body.hold(TOP, 0)
    body.hold(TOP, 1, value=lead)
    if moved_by == "distance":
        ball = fc.SignedDistance(lambda x: ufl.sqrt(ufl.dot(x - center, x - center)) - radius)
    else:
        ball = fc.Ball(center, radius, displacement=shift)
    contact = body.contact(BOTTOM, ball, fc.Frictionless(), kinematics=kinematics)
    moved = shift if moved_by == "displacement" else center
    return body.problem(contact), contact, lead, moved.value


@KINEMATICS
@pytest.mark.parametrize("moved_by", ["center", "distance"])
@pytest.mark.parametrize("radius", [0.01, 0.2])
def test_an_obstacle_moved_by_its_constants_does_not_cross(radius, moved_by, kinematics):
    """All of a ball is in the block at the end, or beyond it; in its own frame Γc does not move.

    A refused state is not where the next path starts.
    """
    problem, _, _, place = ball_below(moved_by, kinematics, radius)
    start = place.copy()
    for way in (0.47, 0.47, 1.2):
        place[:] = start[0], start[1] + way
        fails(problem, "has crossed")
    place[:] = start[0] + 0.3, start[1] + 0.02  # below it still
    assert problem.solve().verdict.failures == []


def test_a_ball_moved_by_its_center_bears():
    """As much as one moved by its displacement, to 1e-9: pressed, led aside, and with the block."""
    forces = []
    for moved_by in ("displacement", "center"):
        problem, contact, lead, place = ball_below(moved_by, "finite", gap=0.0)
        found = []
        for way in ((0.0, 0.01), (0.4, 0.0), (0.0, -0.5)):
            place[:] += way
            lead.value = min(way[1], 0.0)
            problem.solve()
            problem.commit()
            found.append(contact.resultants().normal_force)
        forces.append(found)
    assert forces[1] == pytest.approx(forces[0], rel=1e-9)
    assert min(forces[1]) > 0


def refuse_pin(center, radius, ups, kinematics):
    """A pin that is led up into a held block through these displacements is refused at one."""
    body = block(n=(4, 2))
    up = body.constant(np.zeros(2))
    body.hold(TOP, 0, 1)
    pin = fc.Ball(center, radius, displacement=up)
    contact = body.contact(BOTTOM, pin, fc.Frictionless(), kinematics=kinematics)
    problem = body.problem(contact)
    with pytest.raises(fc.NotConverged):
        for up.value[1] in ups:
            problem.solve()
            problem.commit()


@pytest.mark.each
@KINEMATICS
@pytest.mark.parametrize("at", [0.07, 0.3, 0.55])
@pytest.mark.parametrize("steps", [1, 2, 4])
def test_a_pin_does_not_pass_between_places(steps, at, kinematics):
    """Of the radius 0.01, led 0.6 into facets of 0.25: no place of these is in it at either end."""
    refuse_pin((at, -0.03), 0.01, np.linspace(0.0, 0.6, steps + 1)[1:], kinematics)


@pytest.mark.each
@KINEMATICS
@pytest.mark.parametrize("at", [0.25, 0.3, 0.55])
@pytest.mark.parametrize("far", [0.03, 0.4])
def test_a_pin_thinner_than_what_is_allowed_does_not_pass_slowly(far, at, kinematics):
    """Of the diameter 0.008, into a facet of 0.25, by less than is allowed there; then far."""
    refuse_pin((at, -0.005), 0.004, [0.002, 0.004, 0.006, 0.008, 0.01, 0.012, far], kinematics)


@KINEMATICS
@pytest.mark.parametrize("at", [0.55, 0.6, 0.65])
@pytest.mark.parametrize("steps", [1, 2, 7])
def test_a_blade_does_not_pierce_a_facet(steps, at, kinematics):
    """Upright, 0.02 thick, led 0.3 into facets of 0.25: the way out of it is short aside alone.

    Where a point is in it its resistance ends, or it is refused as well: no increment in which the
    tip is deeper than 7 % of a facet passes.
    """
    body = block(n=(4, 2))
    up = body.constant(np.zeros(2))
    body.hold(TOP, 0, 1)

    def blade(x):
        along = ufl.max_value(-0.65, ufl.min_value(-0.05, x[1]))
        return ufl.sqrt((x[0] - at) ** 2 + (x[1] - along) ** 2) - 0.01

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
@pytest.mark.parametrize(("at", "aside"), [(0.3, 0.1), (0.35, -0.15), (0.7, -0.15)])
def test_a_pin_that_moves_aside_is_not_overlooked(kinematics, at, aside):
    """Of 8 % of a facet, led in by 35 % of it and aside: its place at the end was not pierced.

    It is above Γc at last by more than the 7 % that is allowed, and no point resists.
    """
    body = block(n=(2, 1))
    move = body.constant(np.zeros(2))
    body.hold(TOP, 0, 1)
    contact = body.contact(
        BOTTOM,
        fc.Ball((at, -0.04), 0.04, displacement=move),
        fc.Frictionless(),
        kinematics=kinematics,
        quadrature=2,
    )
    problem = body.problem(contact)
    move.value[:] = aside, 0.175
    fails(problem, "has crossed")


def capsule(center, half, radius):
    """A plate with round ends along x."""

    def distance(x):
        along = x[0] - center[0]
        along -= ufl.max_value(-half, ufl.min_value(half, along))
        return ufl.sqrt(along**2 + (x[1] - center[1]) ** 2) - radius

    return distance


@pytest.mark.parametrize("half", [0.07, 0.0])
def test_what_slides_past_a_thin_tip_has_not_crossed_it(half):
    """A plate of 0.14, and a pin, pressed in by 2 % of a facet and led aside in one increment.

    Places of Γc come from one end to the other at less than the radius below the tip. The force is
    that of three increments, to 1e-6: there is no friction.
    """
    forces = []
    for steps in (1, 3):
        body = block(n=(8, 2))
        move = body.constant(np.zeros(2))
        body.hold(TOP, 0, 1)
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


@KINEMATICS
@pytest.mark.parametrize("sides", [(BOTTOM,), (BOTTOM, SIDES)])
def test_a_blade_does_not_cut_a_body_off(kinematics, sides):
    """Upright beside the body, led 1.6 aside: all of it is beside the body again, and nothing cut.

    Also where the flanks, through which it enters and leaves, are not in Γc.
    """
    flanks = {SIDES: lambda x, cell: near(0, 0.0)(x, cell) | near(0, 1.0)(x, cell)}
    axes = [[np.linspace(0.0, 1.0, 9), np.linspace(0.0, 0.5, 5)]]
    body = Bodies(boxes(axes, {BOTTOM: near(1, 0.0), TOP: near(1, 0.5), **flanks}), E, 0.3)
    move = body.constant(np.zeros(2))
    body.hold(TOP, 0, 1)

    def blade(x):
        along = ufl.max_value(-0.65, ufl.min_value(0.2, x[1]))
        return ufl.sqrt((x[0] + 0.3) ** 2 + (x[1] - along) ** 2) - 0.01

    obstacle = fc.SignedDistance(blade, displacement=move)
    problem = body.problem(body.contact(sides, obstacle, fc.Frictionless(), kinematics=kinematics))
    move.value[0] = -0.2
    assert problem.solve().verdict.failures == []
    move.value[0] = 1.6
    fails(problem, "has crossed")


def test_a_bent_facet_is_not_taken_for_crossed():
    """A ball bends two quadratic facets by half of its radius, in one increment and in five.

    Their chords are crossed by 12 % of their length, they are not: the force is the same to 1e-6.
    """
    forces = []
    for steps in (1, 5):
        axes = [[np.linspace(0.0, 1.0, 3), np.linspace(0.0, 0.5, 3)]]
        body = Bodies(boxes(axes, {BOTTOM: near(1, 0.0), TOP: near(1, 0.5)}), E, 0.3, degree=2)
        move = body.constant(np.zeros(2))
        body.hold(TOP, 0, 1)
        ball = fc.Ball((0.25, -0.3), 0.3, displacement=move)
        contact = body.contact(BOTTOM, ball, fc.Frictionless(), kinematics="finite")
        problem = body.problem(contact)
        for move.value[1] in 0.15 * np.arange(1, steps + 1) / steps:
            problem.solve()
            problem.commit()
        forces.append(contact.resultants().normal_force)
    assert forces[0] == pytest.approx(forces[1], rel=1e-6)


@pytest.mark.parametrize("steps", [1, 4])
def test_a_blade_is_not_turned_through_a_body(steps):
    """By one radian: beneath it at first, above at last, and no point was in it at either end."""

    def blade(x):
        tip, grip = ufl.as_vector((1.5, -0.3)), ufl.as_vector((-1.0, -0.3))
        arm, along = x - grip, tip - grip
        share = ufl.dot(arm, along) / ufl.dot(along, along)
        share = ufl.conditional(share < 0, 0.0, ufl.conditional(share > 1, 1.0, share))
        off = arm - share * along
        return ufl.sqrt(ufl.dot(off, off)) - 0.01

    body = block()
    body.hold(TOP, 0, 1)
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
def test_a_blade_is_not_turned_around_through_a_body(length, angle):
    """Pivoted 0.5 beside a block on soft springs, in one increment: its place is clear at the end.

    The longer blade passes through the block. The shorter one does not reach it: no force.
    """
    all_around = either(*(near(i, value) for i in (0, 1) for value in (0.0, 1.0)))
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
        fails(problem, "has crossed")
    else:
        assert problem.solve().verdict.failures == []
        assert contact.resultants().normal_force == 0.0


def test_a_ball_turns_around_in_place():
    """Pressed in by 0.005 and turned twice about its centre: without friction nothing changes."""
    body = block()
    body.hold(TOP, 0, 1)
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
@pytest.mark.parametrize("at", [0.5, 0.53, 0.5625, 0.46])
def test_a_ball_between_two_points_is_seen(kinematics, at):
    """A ball of a fifth of a facet, pressed in by more than its diameter at any place of it."""
    body = block()
    body.hold(TOP, 0, 1)
    up = body.constant(np.zeros(2))
    ball = fc.Ball((at, -0.0125), 0.0125, displacement=up)
    problem = body.problem(body.contact(BOTTOM, ball, fc.Frictionless(), kinematics=kinematics))
    up.value[1] = -0.01
    assert problem.solve().verdict.failures == []
    problem.commit()
    with pytest.raises(fc.NotConverged, match=r"has crossed|penetrates|too large|exceeds half"):
        for up.value[1] in (0.01, 0.02, 0.03):
            problem.solve()
            problem.commit()


@pytest.mark.parametrize("kind", ["rests", "hovers"])
def test_open_points_are_looked_at(kind):
    """A raised part is driven over a bump, small displacements: its points stay open in the model.

    With finite kinematics the same body is lifted off, or meets the bump.
    """

    def step(x):
        x = x.copy()
        rise = np.clip((x[:, 0] - 0.9) / 0.2, 0.0, 1.0)
        x[:, 1] += 0.2 * rise * (1 - x[:, 1] / 0.5)
        return x

    rests = kind == "rests"
    body = block(bend=step if rests else None, low=0.0 if rests else 0.05, length=2.0, n=(20, 5))
    along = body.constant()
    body.hold(TOP, 1, value=-0.005 if rests else 0.0)
    body.hold(TOP, 0, value=along)
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
@pytest.mark.parametrize("way", [0.3, 0.7, 2.5])
def test_a_body_does_not_enter_another_from_aside(kinematics, way):
    """A hovering block, whose underside is Γc, is led into a post, or over it and beyond."""
    axes = [
        [np.linspace(0.0, 1.0, 9), 0.3 + np.linspace(0.0, 0.5, 5)],
        [np.linspace(0.0, 3.0, 13), np.linspace(-0.5, 0.0, 3)],
        [np.linspace(1.5, 1.8, 4), np.linspace(0.0, 0.5, 5)],
    ]

    def post(x, cell):
        return near(0, 1.5)(x, cell) | near(0, 1.8)(x, cell) | near(1, 0.5)(x, cell)

    sides = {
        BOTTOM: near(1, 0.3),
        TOP: near(1, 0.8),
        FLOOR: between(1, 0.0, above=False),
        HELD: near(1, -0.5),
        6: between(1, 0.0, above=True),
        SIDES: post,
    }
    body = Bodies(boxes(axes, sides), E, 0.3)
    along = body.constant()
    body.hold(HELD, 0, 1)
    body.hold(6, 0, 1)
    body.hold(TOP, 1)
    body.hold(TOP, 0, value=along)
    opposite = fc.DeformableBody(body.tags, (FLOOR, SIDES))
    problem = body.problem(body.contact(BOTTOM, opposite, fc.Frictionless(), kinematics=kinematics))
    along.value = way
    if way < 0.5:  # short of it
        assert problem.solve().verdict.failures == []
    else:
        fails(problem, "crossed")


@pytest.mark.parametrize("enforcement", ["penalty", "augmented"])
def test_what_slides_off_the_other_body_does_not_bear(enforcement):
    """Half off its plate, small displacements: the force of finite kinematics in one increment.

    As in ten, for it acts between the pairs where an increment ends: 1 % for the displacements,
    3 % of its thickness, and for multipliers 2 % more, their tolerance.
    """
    forces = []
    for kinematics, steps in (("finite", 10), ("small", 1), ("small", 10)):
        axes = [
            [np.linspace(0.0, 2.0, 17), np.linspace(0.0, 0.5, 5)],
            [np.linspace(1.0, 2.0, 9), 0.5 + np.linspace(0.0, 0.5, 5)],
        ]
        sides = {
            HELD: near(1, 0.0),
            FLOOR: between(1, 0.5, above=False),
            BOTTOM: between(1, 0.5, above=True),
            TOP: near(1, 1.0),
        }
        body = Bodies(boxes(axes, sides), E, 0.3)
        along = body.constant()
        body.hold(HELD, 0, 1)
        body.hold(TOP, 1, value=-0.01)
        body.hold(TOP, 0, value=along)
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


def test_the_end_face_of_a_slab_is_not_taken_for_deep():
    """A softer block is led over the end of a slab, with its end face tagged or not: one force.

    The corner of the slab is less deep than the block is pressed by, 0.01, but 0.1 along the end
    face's normal, which grazes the underside. To 1e-9: no point of Γc meets the end face.
    """
    forces = []
    for tags in ((FLOOR,), (FLOOR, SIDES)):
        axes = [
            [np.linspace(0.0, 2.0, 9), np.linspace(0.0, 1.0, 5)],
            [np.linspace(0.5, 1.5, 8), 1.0 + np.linspace(0.0, 1.0, 8)],
        ]
        sides = {
            HELD: near(1, 0.0),
            FLOOR: between(1, 1.0, above=False),
            SIDES: near(0, 2.0),
            BOTTOM: between(1, 1.0, above=True),
            TOP: near(1, 2.0),
        }
        mesh, facets = boxes(axes, sides)
        softer = ufl.conditional(ufl.SpatialCoordinate(mesh)[1] > 1.0, 0.5 * E, E)
        body = Bodies((mesh, facets), softer, 0.3)
        along = body.constant()
        body.hold(HELD, 0, 1)
        body.hold(TOP, 1, value=-0.01)
        body.hold(TOP, 0, value=along)
        contact = body.contact(BOTTOM, tags, fc.Coulomb(0.2), kinematics="finite")
        problem = body.problem(contact)
        found = []
        for along.value in (0.0, 0.48, 0.97):
            problem.solve()
            problem.commit()
            found.append(contact.resultants().normal_force)
        forces.append(found)
    assert forces[1] == pytest.approx(forces[0], rel=1e-9)


@KINEMATICS
def test_a_pin_is_seen_beside_what_closes_the_next_facet(kinematics):
    """A slab holds the facets around up, and a narrow pin enters between the points of one."""
    width = 0.04
    axes = [
        [np.linspace(0.0, 2.0, 5), np.linspace(0.0, 0.5, 3)],
        [np.linspace(0.0, 0.9, 4), 0.5 + np.linspace(0.0, 0.5, 3)],
        [1.25 + width * np.linspace(-0.5, 0.5, 3), 0.5 + np.linspace(0.0, 0.5, 4)],
    ]
    sides = {
        BOTTOM: between(1, 0.5, above=False),
        FLOOR: between(1, 0.5, above=True),
        HELD: near(1, 0.0),
        TOP: near(1, 1.0),
    }
    body = Bodies(boxes(axes, sides), E, 0.3)
    body.hold(HELD, 0, 1)
    body.hold(TOP, 0)
    body.hold(TOP, 1, value=-5e-3)
    problem = body.problem(
        body.contact(BOTTOM, FLOOR, fc.Frictionless(), kinematics=kinematics, quadrature=2)
    )
    fails(problem, "penetrates", "1.2")


@KINEMATICS
@pytest.mark.parametrize("both", [False, True])
def test_crossed_ridges_are_seen(kinematics, both):
    """Their edges cross, no point of a flank meets the other body: from one side and from both."""
    lines, rise = np.linspace(0.0, 1.0, 5), np.linspace(0.0, 0.5, 3)

    def ridges(x):
        x = x.copy()
        lower = 0.45 * (1 - abs(2 * x[:, 1] - 1)) * x[:, 2] / 0.5
        upper = -0.45 * (1 - abs(2 * x[:, 0] - 1)) * (1.9 - x[:, 2]) / 0.5
        x[:, 2] += np.where(x[:, 2] < 0.9, lower, upper)
        return x

    sides = {
        BOTTOM: between(2, 0.5, above=False),
        FLOOR: between(2, 1.4, above=True),
        HELD: near(2, 0.0),
        TOP: near(2, 1.9),
    }
    body = Bodies(
        boxes([[lines, lines, rise], [lines, lines, 1.4 + rise]], sides, bend=ridges), E, 0.3
    )
    down = body.constant()
    body.hold(HELD, 0, 1, 2)
    body.hold(TOP, 0, 1)
    body.hold(TOP, 2, value=down)
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
    fails(problem, "penetrates")


def test_the_undeformed_body_may_be_where_an_obstacle_has_no_normal():
    """A ball and a block go up together until the ball's centre is where a vertex was at first.

    Reference: the force before, to 1e-9.
    """
    body = block()
    lead, shift = body.constant(), body.constant((0.0, -0.25))
    body.hold(TOP, 0)
    body.hold(TOP, 1, value=lead)
    ball = fc.SignedDistance(lambda x: ufl.sqrt(x[1] ** 2 + (x[0] - 0.5) ** 2) - 0.2, shift)
    surface = fc.ContactSurface(body.mesh, body.tags, BOTTOM, quadrature_scheme="vertex")
    contact = fc.Contact(body.u, surface, ball, fc.Frictionless(), kinematics="finite")
    problem = body.problem(contact)
    forces = []
    for up in (-0.25, 0.0):
        lead.value, shift.value[1] = up + 0.19, up
        problem.solve()
        problem.commit()
        forces.append(contact.resultants().normal_force)
    assert forces[0] > 1.0
    assert forces[1] == pytest.approx(forces[0], rel=1e-9)


@pytest.mark.parametrize("tags", [(FLOOR, BOTTOM), (BOTTOM, FLOOR)])
def test_a_soft_contact_does_not_lose_the_other_body(tags):
    """Two columns with contact 1e-3 of E/h, which are in each other by most of the load.

    At twice the depth of the last commit normals meet nothing any more: force 0 for 2. Cut to half
    it is that of springs in series, p = d/(1/k + 2 (1 - ν²)/E), which strains of 1e-3 change by
    less than 1e-3.
    """
    axes = [[np.linspace(0.0, 1.0, 5), y + np.linspace(0.0, 1.0, 5)] for y in (0.0, 1.0)]
    sides = {
        HELD: near(1, 0.0),
        FLOOR: between(1, 1.0, above=False),
        BOTTOM: between(1, 1.0, above=True),
        TOP: near(1, 2.0),
        SIDES: near(0, 0.0),
    }
    bodies = Bodies(boxes(axes, sides), E, 0.3)
    down = bodies.constant()
    bodies.hold(HELD, 1)
    bodies.hold(SIDES, 0)
    bodies.hold(TOP, 1, value=down)
    k = 1e-3 * E / 0.25
    contact = bodies.contact(tags[0], (tags[1],), fc.Frictionless(k), kinematics="finite")
    problem = bodies.problem(contact)
    down.value = -0.2
    problem.solve()
    problem.commit()
    down.value = -0.5
    fails(problem, "penetrates")
    for down.value in (-0.35, -0.5):
        problem.solve()
        problem.commit()
    exact = 0.5 / (1 / k + 2 * (1 - 0.3**2) / E)
    assert contact.resultants().normal_force == pytest.approx(exact, rel=1e-3)


@KINEMATICS
@pytest.mark.parametrize("n", [(4, 4), (1, 1)])
def test_a_block_whose_sides_are_tagged_slides_on_a_floor(n, kinematics):
    """By a fifth of its width in one increment: its corner enters nothing but the floor.

    Reference: friction μ N in full slip, to 1e-9.
    """
    axes = [[np.linspace(0.0, 1.0, n[0] + 1), np.linspace(0.0, 0.5, n[1] + 1)]]
    tags = {BOTTOM: near(1, 0.0), TOP: near(1, 0.5), SIDES: either(near(0, 0.0), near(0, 1.0))}
    body = Bodies(boxes(axes, tags), E, 0.3)
    down, along = body.constant(-1e-3), body.constant()
    body.hold(TOP, 1, value=down)
    body.hold(TOP, 0, value=along)
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
def test_a_roller_goes_past_the_end_of_a_block_and_back(n):
    """Whose bottom and end are tagged, at a depth far below the size of a facet.

    Reference: the forces on the way out, to 1e-6: without friction it goes back through them.
    """
    axes = [[np.linspace(0.0, 1.0, n + 1), np.linspace(0.0, 1.0, n + 1)]]
    tags = {BOTTOM: near(1, 0.0), TOP: near(1, 1.0), SIDES: near(0, 1.0)}
    body = Bodies(boxes(axes, tags, simplex=True), E, 0.3)
    body.hold(TOP, 0, 1)
    shift = body.constant((0.0, 0.01))
    roller = fc.Ball((0.6, -0.3), 0.3, displacement=shift)
    surface = fc.ContactSurface(body.mesh, body.tags, [BOTTOM, SIDES])
    contact = fc.Contact(body.u, surface, roller, fc.Frictionless(), kinematics="finite")
    problem = body.problem(contact)
    forces = []
    for way in [*np.arange(0.0, 1.3, 0.2), *np.arange(1.0, -0.1, -0.2)]:
        shift.value[0] = way
        problem.solve()
        problem.commit()
        forces.append(contact.resultants().force)
    forces = np.array(forces)
    assert np.abs(forces[:7] - forces[::-1][:7]).max() <= 1e-6 * np.abs(forces).max()


@pytest.mark.parametrize(
    ("kinematics", "turned"), [("small", 0.0), ("finite", 0.0), ("finite", 2.5)]
)
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron", "hexahedron"])
def test_nodes_without_points_do_not_pass_through_the_floor(cell, kinematics, turned, caplog):
    """Vertex quadrature on quadratic elements: their other nodes pass through what is opposite.

    The points carry no more than linear displacements of a facet: by these nothing is deep, while
    the middles of edges are below the floor by a tenth of the facet. The floor may have turned.
    """
    d = dimension(cell)
    mesh, tags = block_mesh(cell, n=1)
    u = fem.Function(displacement_space(mesh, 2))
    body = LinearElastic(u, E, 0.45, {2: "plane strain", 3: "3D"}[d])
    F = body.residual(ufl.TestFunction(u.function_space), ufl.dx(mesh))
    down = fem.Constant(mesh, 0.0)
    bcs = [hold(u, tags, BLOCK_TOP, i) for i in range(d - 1)]
    bcs.append(hold(u, tags, BLOCK_TOP, d - 1, down))
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
    fails(problem, "penetrates between the quadrature points")
    u.x.array[:] = 0.0
    assert fc.ContactProblem(F, u, bcs=bcs, contacts=[contact(None)]).solve().verdict.failures == []
