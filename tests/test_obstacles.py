"""What the verdict says of rigid obstacles: no distance, too deep, on the other side.

And how they meet what was given late: E, a start, a motion by force beside a turn.
"""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.checks.obstacle_probe import RigidObstacleProbe
from fenics_contact.checks.tunnelling import TunnellingCheck
from fenics_contact.elasticity import NeoHookean
from scenes.blocks import BOTTOM, TOP, block, kirchhoff
from scenes.comparing import close, gathered, raised_everywhere
from scenes.elasticity import hold
from scenes.rubber import Tool, rubber
from scenes.two_blocks import LOWER, UPPER, two_blocks

COMM = MPI.COMM_WORLD
pytestmark = pytest.mark.two_ranks


def roller(scene, radius, shift, **options):
    """A cylinder that just touches the middle of the top."""
    return fc.Cylinder((0.0, scene.height + radius), radius, displacement=shift, **options)


def level_set(scene, radius, *, true, shift):
    """The same by a function that is zero on it, divided by the length of its gradient if true."""
    top = scene.height + radius

    def distance(x):
        square = x[0] ** 2 + (x[1] - top) ** 2
        value = square - radius**2
        return value / (2 * ufl.sqrt(square)) if true else value

    return fc.SignedDistance(distance, displacement=shift)


@pytest.mark.parametrize("kinematics", ["small", "finite"])
def test_what_is_no_distance_is_refused(kinematics):
    """x² - R² in place of |x| - R has slope 2 R; over twice |x| it is one to p/2R, 1e-3 here."""
    radius, forces = 2.0, []
    for true in (True, False, None):
        scene = rubber(n=(12, 4), linear=True)
        shift = fem.Constant(scene.mesh, (0.0, -0.01))
        obstacle = roller(scene, radius, shift)
        if true is not None:
            obstacle = level_set(scene, radius, true=true, shift=shift)
        options = {"kinematics": kinematics}
        problem, contact = scene.problem(obstacle, fc.Coulomb(0.2), contact=options)
        if true is False:
            match = r"gap of the SignedDistance differs by (2\.9|3)\d* from minus its unit normal"
            with pytest.raises(fc.NotConverged, match=match):
                problem.solve()
        else:
            problem.solve()
            forces.append(contact.resultants().force[1])
    assert forces[0] == pytest.approx(forces[1], rel=1e-2)


class Roller(fc.Obstacle):
    """A cylinder as a user writes it, its gap times a factor, its direction off by an angle."""

    def __init__(self, center, radius, displacement, *, factor=1.0, angle=0.0):
        self.center, self.radius, self.displacement = center, radius, displacement
        self.factor, self.angle = factor, angle

    def place(self, x, to_ufl):
        """See `Obstacle`."""
        arm = x - ufl.as_vector(self.center)
        distance = ufl.sqrt(ufl.dot(arm, arm))
        c, s = np.cos(self.angle), np.sin(self.angle)
        direction = (c * arm[0] - s * arm[1], s * arm[0] + c * arm[1])
        return fc.Placement(self.factor * (distance - self.radius), -ufl.as_vector(direction))


@pytest.mark.parametrize("kinematics", ["small", "finite"])
@pytest.mark.parametrize(
    ("wrong", "error"), [({}, None), ({"factor": 2.0}, "1"), ({"angle": 0.1}, r"0\.(1|0999)")]
)
def test_an_own_obstacle_must_be_a_distance(kinematics, wrong, error):
    """Moved while pressed, it bears as `Cylinder` does to 1e-9; a wrong gap or normal is refused.

    By |1 - factor|, and 2 sin(angle/2).
    """
    forces = []
    for own in (True, False):
        scene = rubber(n=(12, 4), linear=True)
        shift, radius = fem.Constant(scene.mesh, (0.0, -0.01)), 2.0
        obstacle = roller(scene, radius, shift)
        if own:
            obstacle = Roller((0.0, scene.height + radius), radius, shift, **wrong)
        problem, contact = scene.problem(
            obstacle, fc.Coulomb(0.2), contact={"kinematics": kinematics}
        )
        if own and error is not None:
            match = f"gap of the Roller differs by {error}"
            with pytest.raises(fc.NotConverged, match=match):
                problem.solve()
            return
        for way in (0.0, 0.02, 0.04):
            shift.value[0] = way
            problem.solve()
            problem.commit()
        forces.append(contact.resultants().force)
    assert np.allclose(*forces, rtol=1e-9)
    assert abs(forces[0][0]) > 0.1 * abs(forces[0][1])


@pytest.mark.parametrize("data", ["function", "coordinates"])
def test_a_distance_with_data_on_the_mesh_must_be_one(data):
    """2 (level - x_1) has a gradient of 2, level a function or an expression of coordinates."""
    forces = []
    for factor in (1.0, 2.0):
        scene = rubber(n=(4, 2), linear=True)
        level = fem.Function(fem.functionspace(scene.mesh, ("Lagrange", 1)))
        level.x.array[:] = scene.height - 0.01
        if data == "coordinates":
            level = scene.height - 0.01 + 0 * ufl.SpatialCoordinate(scene.mesh)[0]

        def distance(x, factor=factor, level=level):
            return factor * (level - x[1])

        small = {"kinematics": "small"}
        obstacle = fc.SignedDistance(distance)
        problem, contact = scene.problem(obstacle, fc.Frictionless(), contact=small)
        if factor == 2.0:
            with pytest.raises(fc.NotConverged, match="SignedDistance differs by 1 from"):
                problem.solve()
        else:
            problem.solve()
            forces.append(contact.resultants().normal_force)
    assert forces[0] > 0


@pytest.mark.parametrize(
    ("place", "words"),
    [
        (lambda x: (x[1], -x), "returns a tuple"),
        (lambda x: fc.Placement(x, -x), "gap of shape (2,)"),
        (
            lambda x: fc.Placement(x[1], ufl.as_vector([0.0, -1.0, 0.0])),
            "direction of shape (3,)",
        ),
        (lambda x: fc.Placement(x[1], x + ufl.as_vector([0.0, -1.0, 0.0])), "shapes"),
        (lambda x: {}["center"], "KeyError: 'center'"),
        (lambda x: fc.Placement(None, -x), "conver"),
        (lambda x: fc.Placement(x[1], 1.0), "Expecting"),
        (lambda x: fc.Placement(x[1], ufl.as_vector([0.0, 0.0])), "zero"),
    ],
)
def test_what_place_returns_is_checked(place, words):
    """In words that name the class, before anything is compiled."""
    scene = rubber(n=(2, 2), linear=True)

    class Own(fc.Obstacle):
        def place(self, x, to_ufl):
            return place(x)

    raised_everywhere(lambda: scene.problem(Own(), fc.Coulomb(0.2)), ValueError, "Own.place", words)


@pytest.mark.parametrize("kinematics", ["small", "finite"])
@pytest.mark.parametrize(
    ("distance", "words"),
    [
        (lambda x: x[2], ["2 components", "out of bounds"]),  # of a mesh in space, in the plane
        (lambda x: np.hypot(*x), ["hypot"]),
        (lambda x: None, ["None"]),
        (lambda x: 0.1, ["does not depend on x"]),
        (lambda x: ufl.as_ufl(1) + 2, ["does not depend on x"]),
    ],
    ids=["index", "numpy", "none", "number", "constant"],
)
def test_a_function_that_is_no_distance_is_named(distance, words, kinematics):
    """UFL's own words for these, "Index out of bounds" or "Division by zero", name no obstacle."""
    scene = block()
    obstacle = fc.SignedDistance(distance)
    raised_everywhere(
        lambda: scene.contact(fc.Frictionless(), obstacle=obstacle, kinematics=kinematics),
        ValueError,
        "distance of the SignedDistance",
        *words,
    )


@pytest.mark.parametrize("length", [1e-300, 1e-5, 1e200])
def test_a_normal_of_any_length(length):
    """The normal of a plane and the axis of a cylinder: their squares overflow, or are zero."""
    scene = block("tetrahedron")
    for made in (
        lambda size: fc.HalfSpace((0, 0, -0.1), (0.0, -0.3 * size, 0.7 * size)),
        lambda size: fc.Cylinder((0.4, 0.5, -1.1), 1.0, axis=(size, 0.2 * size, 0.0)),
    ):
        gaps = [
            gathered(COMM, scene.contact(fc.Frictionless(), obstacle=made(size)).gap)
            for size in (1.0, length)
        ]
        assert close(gaps[1], gaps[0], 1e-14, scale=1.0)


def test_an_obstacle_that_sinks_in_is_refused():
    """Soft springs, a small roller: refused before it comes out on its other side.

    Every increment that passes has more force than the one before, and no point is deeper than
    half of the radius.
    """
    radius, forces = 0.3, []
    scene = rubber(n=(8, 4), E=10.0, nu=0.49)
    shift = fem.Constant(scene.mesh, np.zeros(2))
    problem, contact = scene.problem(roller(scene, radius, shift), fc.Coulomb(0.2, 50.0, 50.0))

    def load(t):
        shift.value[1] = -t

    with pytest.raises(fc.NotConverged, match="half of the radius of curvature"):
        for _ in fc.increments(problem, load, 0.0, 0.9, steps=9, max_cuts=2):
            found = contact.resultants()
            forces.append(found.normal_force)
            assert found.max_penetration <= 0.51 * radius
    assert len(forces) >= 3
    assert np.all(np.diff(forces) > 0)


def test_an_obstacle_that_goes_through_in_one_increment_is_refused():
    """A roller as thick as half of what it goes down by: nothing of Γc touches it there."""
    radius = 0.15
    scene = rubber(n=(16, 4), E=10.0)
    shift = fem.Constant(scene.mesh, (0.0, -0.45))
    problem, contact = scene.problem(roller(scene, radius, shift), fc.Frictionless(1e3))
    contact.evaluate()
    probe = RigidObstacleProbe(contact)
    gone, x = (
        gathered(COMM, each)[:, 0] for each in (probe.find_crossed(np.zeros(len(probe.x))), probe.x)
    )
    # It has passed straight down over all halves of facets below its middle half, and over none
    # aside of it.
    middle = x[np.abs(x) < 0.5 * radius]
    assert len(middle) and np.isin(middle.round(9), gone.round(9)).all()
    assert np.abs(gone).max() < radius + 1 / 32
    with pytest.raises(fc.NotConverged, match=r"has crossed|half of the radius"):
        problem.solve()


@pytest.mark.whole
@pytest.mark.parametrize(
    "distance", [lambda z: ufl.ln(z - 2.0), lambda z: ufl.sqrt(z**2) - 0.1], ids=["gap", "slope"]
)
def test_a_distance_that_is_no_number_is_refused(distance):
    """Its points are neither open nor closed; or they are closed, and have no normal."""
    scene = rubber(n=(4, 2), E=10.0)
    obstacle = fc.SignedDistance(lambda x: distance(scene.height - x[1]))
    problem, _ = scene.problem(obstacle, fc.Frictionless(1e3))
    raised_everywhere(problem.solve, fc.NotConverged, "is not a number")


def test_an_obstacle_that_is_no_number_at_the_end_of_an_increment_is_refused():
    """A bump that ends, moved aside from under a body that hovers over it: first touch is asked."""
    scene = rubber(n=(4, 2), E=10.0)
    shift = fem.Constant(scene.mesh, np.zeros(2))
    bump = fc.SignedDistance(
        lambda x: scene.height + 0.5 - x[1] - 0.4 * ufl.sqrt(1.0 - x[0] ** 2 / 9.0), shift
    )
    problem, _ = scene.problem(bump, fc.Coulomb(0.2))
    for shift.value[0] in (0.5, 1.5):
        problem.solve()
        problem.commit()
    shift.value[0] = 3.5
    raised_everywhere(problem.solve, fc.NotConverged, "is not a number")


def test_sliding_round_an_obstacle_is_no_passage():
    """Points that go a quarter of the way round a roller, outside of it or on it."""
    scene = rubber(n=(16, 4), E=10.0)
    shift = fem.Constant(scene.mesh, np.zeros(2))
    _, contact = scene.problem(roller(scene, 1.0, shift), fc.Frictionless(1e3))
    for angle in (0.2, 0.8, 1.4):
        # Γc is flat: all of it turned about the middle of the roller.
        c, s = np.cos(angle), np.sin(angle)
        centre = np.array([[0.0], [scene.height + 1.0]])
        turn = np.array([[c, -s], [s, c]])
        scene.u.interpolate(lambda x, t=turn, m=centre: t @ (x[:2] - m) + m - x[:2])
        contact.states.forget()
        assert TunnellingCheck([contact]).evaluate(contact.u)[contact.name].crossed is None


@pytest.mark.parametrize("shape", ["ball", "profile"])
def test_a_turn_by_more_than_a_right_angle_is_refused(shape):
    """A drum turned by 270° at once rubbed backwards, with all of μ N, and by 360° not at all.

    Cut into halves until they pass, it rubs forwards: μ times the pressure, at the lever of the
    points, 1e-9; as a drum that has slid for long. One that no point touches turns as it likes.
    """
    for angle in (1.5 * np.pi, 2 * np.pi):
        tool = Tool(radius=0.8, law=fc.Coulomb(0.3, 1e4, 1e4), shape=shape)
        tool.go(0.0, 0.01)
        tool.go(0.0, 0.01, -angle)
        tool.go(0.0, -0.05, -angle)
        tool.go(0.0, -0.1, -angle)
        with pytest.raises(fc.NotConverged, match=r"rotates by .* rad in one increment"):
            tool.go(0.0, -0.1, 0.0)

        def turn(t, tool=tool, angle=angle):
            tool.angle.value = (t - 1) * angle

        for _ in fc.increments(tool.problem, turn, steps=1, max_cuts=2):
            pass
        contact, centre = tool.contact, (0.0, tool.scene.height + 0.7)
        x = contact.points + contact.own_displacement()
        lever = np.linalg.norm(x - np.array(centre), axis=1)
        expected = COMM.allreduce(0.3 * float((contact.measure * lever) @ contact.pressure))
        allowed = 1e-9 if shape == "ball" else 1e-5
        assert contact.moment(centre)[0] == pytest.approx(expected, rel=allowed)


def test_a_turn_that_differs_from_point_to_point_is_refused():
    scene = rubber(n=(4, 2))
    x = ufl.SpatialCoordinate(scene.mesh)
    for angle in (0.1 * x[0], scene.u[0]):
        turn = fc.Rotation(angle, about=(0.0, 2.0))
        obstacle = roller(scene, 1.0, (0.0, 0.0), rotation=turn)
        with pytest.raises(ValueError, match="Rotation varies over Γc"):
            scene.contact(obstacle, fc.Coulomb(0.2))


def test_work_of_a_force_beside_a_turn():
    """A roller driven by a force that may turn, and does not: the work is force times way.

    By hand ½ (f₀ + f₁) Δv; to the solver's tolerance.
    """
    scene = rubber(n=(8, 4), linear=True)
    force, angle = fem.Constant(scene.mesh, 0.0), fem.Constant(scene.mesh, 0.0)
    motion = fc.Motion(force=(None, force), displacement=(0.0, None))
    turn = fc.Rotation(angle, about=(0.0, 2.0))
    problem, contact = scene.problem(roller(scene, 1.0, motion, rotation=turn), fc.Coulomb(0.3))
    before = 0.0
    for number in (1, 2):
        force.value = -20.0 * number
        energy = problem.solve().energy
        problem.commit()
        now = float(contact.free_motion[1].value)
        work = -10.0 * (2 * number - 1) * (now - before)
        before = now
        assert energy.work == pytest.approx(work, rel=1e-8)
        assert abs(energy.imbalance) <= 1e-8 * work


@pytest.mark.parametrize("linear", [True, False])
def test_stiffness_follows_a_modulus_that_is_set_late(linear):
    """E set after the problem was made: as if it had been there, 10 E/h; 1e-6."""
    forces = []
    for first in (1000.0, 1.0):
        scene = block("quadrilateral", n=(6, 3), E=first)
        shift = fem.Constant(scene.mesh, (0.0, 0.01))
        held = [scene.hold(TOP, i) for i in range(2)]
        law = {"displacement": shift}
        if not linear:
            scene.F = kirchhoff(scene)
        problem, contact = scene.problem(fc.Coulomb(0.3), held, contact=law)
        scene.E.value = 1000.0
        problem.solve()
        forces.append(contact.resultants().force)
    assert close(np.array(forces[0]), np.array(forces[1]), 1e-6)
    assert forces[0][1] > 1.0


@pytest.mark.parametrize("kinematics", ["small", "finite"])
@pytest.mark.parametrize("late", [False, True])
def test_slip_is_counted_from_the_start(kinematics, late):
    """A body that stands aside at first, without load, and is pressed straight down: no slip.

    As from u = 0, to the round-off of so large a displacement. ``late``: it is moved after the
    problem was made.
    """
    forces = []
    for aside in (0.0, 0.3):
        scene = rubber(n=(8, 4), linear=True)
        plate = fc.HalfSpace((0.0, 1.0), (0.0, -1.0), displacement=(0.0, -0.001))
        if late:
            problem, contact = scene.problem(
                plate, fc.Coulomb(0.2), contact={"kinematics": kinematics}
            )
        for field in (scene.u, scene.held):
            field.interpolate(lambda x, a=aside: np.array([a + 0 * x[0], 0 * x[0]]))
        if not late:
            problem, contact = scene.problem(
                plate, fc.Coulomb(0.2), contact={"kinematics": kinematics}
            )
        problem.solve()
        problem.commit()
        forces.append(contact.resultants().force)
    assert close(np.array(forces[0]), np.array(forces[1]), 1e-6)
    assert abs(forces[0][1]) > 1.0


def test_rubber_on_rubber_with_pairs_found_anew():
    """A nonlinear bulk whose top is moved, and pairs that change with every commit.

    The force is that of one increment to what pairs found anew change, 1 %.
    """
    ends = []
    for steps in (1, 4):
        mesh, tags = two_blocks("triangle", (8, 3), (2.0, 1.0), 0.5)
        space = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
        u, v = fem.Function(space), ufl.TestFunction(space)
        body = NeoHookean(u, 10.0, 0.3, "plane strain")
        move = [fem.Constant(mesh, 0.0) for _ in range(2)]
        bcs = [hold(u, tags, BOTTOM, i) for i in range(2)]
        bcs += [hold(u, tags, TOP, i, value) for i, value in enumerate(move)]
        base = fc.DeformableBody(tags, LOWER, update_pairs="increment")
        contact = fc.Contact(u, fc.ContactSurface(mesh, tags, UPPER), base, fc.Frictionless())
        problem = fc.ContactProblem(body.residual(v), u, bcs=bcs, contacts=[contact])
        for number in range(1, steps + 1):
            move[1].value = -0.05 * number / steps
            problem.solve()
            problem.commit()
        ends.append(contact.resultants().normal_force)
    assert ends[1] == pytest.approx(ends[0], rel=1e-2)
    assert ends[0] > 0.1
