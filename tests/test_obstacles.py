"""Verdict on rigid obstacles: invalid distances, large penetration, tunnelling, rotations.

Also tested: moduli and initial displacements set after creation, driving forces with rotation.
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
from scenes.comparison import assert_raised_on_all_ranks, gather, is_close
from scenes.elasticity import dirichlet_bc
from scenes.rubber import DiscOnRubber, rubber
from scenes.two_blocks import LOWER_FACE, UPPER_FACE, two_blocks

COMM = MPI.COMM_WORLD
pytestmark = pytest.mark.two_ranks


def roller(scene, radius, shift, **options):
    """Return a cylinder that just touches the middle of the top."""
    return fc.Cylinder((0.0, scene.height + radius), radius, displacement=shift, **options)


def cylinder_by_level_set(scene, radius, *, true, shift):
    """Return a cylinder as a level set, divided by the length of its gradient if ``true``."""
    top = scene.height + radius

    def distance(x):
        square = x[0] ** 2 + (x[1] - top) ** 2
        value = square - radius**2
        return value / (2 * ufl.sqrt(square)) if true else value

    return fc.SignedDistance(distance, displacement=shift)


@pytest.mark.parametrize("kinematics", ["small", "finite"])
def test_level_set_that_is_no_distance_is_refused(kinematics):
    """x² - R² has slope 2 R; divided by 2 |x| it is a distance up to d/2R for the depth d, 1e-3."""
    radius, forces = 2.0, []
    for true in (True, False, None):
        scene = rubber(n=(12, 4), linear=True)
        shift = fem.Constant(scene.mesh, (0.0, -0.01))
        obstacle = roller(scene, radius, shift)
        if true is not None:
            obstacle = cylinder_by_level_set(scene, radius, true=true, shift=shift)
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
    """A user-defined cylinder, its gap scaled and its direction rotated by an angle."""

    def __init__(self, center, radius, displacement, *, factor=1.0, angle=0.0):
        self.center, self.radius, self.displacement = center, radius, displacement
        self.factor, self.angle = factor, angle

    def place(self, x, to_ufl):
        """Return gap and direction at x, as `Obstacle` specifies."""
        arm = x - ufl.as_vector(self.center)
        distance = ufl.sqrt(ufl.dot(arm, arm))
        c, s = np.cos(self.angle), np.sin(self.angle)
        direction = (c * arm[0] - s * arm[1], s * arm[0] + c * arm[1])
        return fc.Placement(self.factor * (distance - self.radius), -ufl.as_vector(direction))


@pytest.mark.parametrize("kinematics", ["small", "finite"])
@pytest.mark.parametrize(
    ("wrong", "error"), [({}, None), ({"factor": 2.0}, "1"), ({"angle": 0.1}, r"0\.(1|0999)")]
)
def test_user_defined_obstacle_needs_distance_and_unit_normal(kinematics, wrong, error):
    """A `Roller` has the forces of `Cylinder` to 1e-9; a wrong gap or normal is refused.

    The error is |1 - factor|, or 2 sin(angle/2).
    """
    forces = []
    for has_gradient in (True, False):
        scene = rubber(n=(12, 4), linear=True)
        shift, radius = fem.Constant(scene.mesh, (0.0, -0.01)), 2.0
        obstacle = roller(scene, radius, shift)
        if has_gradient:
            obstacle = Roller((0.0, scene.height + radius), radius, shift, **wrong)
        problem, contact = scene.problem(
            obstacle, fc.Coulomb(0.2), contact={"kinematics": kinematics}
        )
        if has_gradient and error is not None:
            match = f"gap of the Roller differs by {error}"
            with pytest.raises(fc.NotConverged, match=match):
                problem.solve()
            return
        for displacement in (0.0, 0.02, 0.04):
            shift.value[0] = displacement
            problem.solve()
            problem.commit()
        forces.append(contact.resultants().force)
    assert np.allclose(*forces, rtol=1e-9)
    assert abs(forces[0][0]) > 0.1 * abs(forces[0][1])


@pytest.mark.parametrize("data", ["function", "coordinates"])
def test_gradient_of_distance_with_mesh_data_is_checked(data):
    """2 (level - x_1) with a function or an expression as level has a gradient of 2."""
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
def test_return_value_of_place_is_checked(place, words):
    """The error names the class, and is raised before compilation."""
    scene = rubber(n=(2, 2), linear=True)

    class Own(fc.Obstacle):
        def place(self, x, to_ufl):
            return place(x)

    assert_raised_on_all_ranks(
        lambda: scene.problem(Own(), fc.Coulomb(0.2)), ValueError, "Own.place", words
    )


@pytest.mark.parametrize("kinematics", ["small", "finite"])
@pytest.mark.parametrize(
    ("distance", "words"),
    [
        (lambda x: x[2], ["2 components", "out of bounds"]),  # an index for 3D on a mesh in 2D
        (lambda x: np.hypot(*x), ["hypot"]),
        (lambda x: None, ["None"]),
        (lambda x: 0.1, ["does not depend on x"]),
        (lambda x: ufl.as_ufl(1) + 2, ["does not depend on x"]),
    ],
    ids=["index", "numpy", "none", "number", "constant"],
)
def test_error_names_an_invalid_distance_function(distance, words, kinematics):
    """The error names the obstacle, unlike UFL's "Index out of bounds", "Division by zero"."""
    scene = block()
    obstacle = fc.SignedDistance(distance)
    assert_raised_on_all_ranks(
        lambda: scene.contact(fc.Frictionless(), obstacle=obstacle, kinematics=kinematics),
        ValueError,
        "distance of the SignedDistance",
        *words,
    )


@pytest.mark.parametrize("length", [1e-300, 1e-5, 1e200])
def test_normals_and_axes_of_any_length(length):
    """Gaps agree to 1e-14 although squares of normals or axes overflow or underflow."""
    scene = block("tetrahedron")
    for obstacle in (
        lambda size: fc.HalfSpace((0, 0, -0.1), (0.0, -0.3 * size, 0.7 * size)),
        lambda size: fc.Cylinder((0.4, 0.5, -1.1), 1.0, axis=(size, 0.2 * size, 0.0)),
    ):
        gaps = [
            gather(COMM, scene.contact(fc.Frictionless(), obstacle=obstacle(size)).gap)
            for size in (1.0, length)
        ]
        assert is_close(gaps[1], gaps[0], 1e-14, scale=1.0)


def test_penetration_beyond_half_the_radius_is_refused():
    """A small roller with low k_n is refused before points reach its far side.

    In every accepted increment the force increases, and no point is deeper than half of the radius.
    """
    radius, forces = 0.3, []
    scene = rubber(n=(8, 4), E=10.0, nu=0.49)
    shift = fem.Constant(scene.mesh, np.zeros(2))
    problem, contact = scene.problem(roller(scene, radius, shift), fc.Coulomb(0.2, 50.0, 50.0))

    def load(t):
        shift.value[1] = -t

    with pytest.raises(fc.NotConverged, match="half of the radius of curvature"):
        for _ in fc.increments(problem, load, 0.0, 0.9, steps=9, max_cuts=2):
            computed = contact.resultants()
            forces.append(computed.normal_force)
            assert computed.max_penetration <= 0.51 * radius
    assert len(forces) >= 3
    assert np.all(np.diff(forces) > 0)


def test_tunnelling_of_a_roller_in_one_increment_is_refused():
    """A roller moves down by 1.5 diameters, where no point of Γc touches it."""
    radius = 0.15
    scene = rubber(n=(16, 4), E=10.0)
    shift = fem.Constant(scene.mesh, (0.0, -0.45))
    problem, contact = scene.problem(roller(scene, radius, shift), fc.Frictionless(1e3))
    contact.evaluate()
    probe = RigidObstacleProbe(contact)
    gone, x = (
        gather(COMM, each)[:, 0] for each in (probe.find_crossed(np.zeros(len(probe.x))), probe.x)
    )
    # It has crossed all probe points below its middle half, and none beyond its radius.
    middle = x[np.abs(x) < 0.5 * radius]
    assert len(middle) and np.isin(middle.round(9), gone.round(9)).all()
    assert np.abs(gone).max() < radius + 1 / 32
    with pytest.raises(fc.NotConverged, match=r"has crossed|half of the radius"):
        problem.solve()


@pytest.mark.whole
@pytest.mark.parametrize(
    "distance", [lambda z: ufl.ln(z - 2.0), lambda z: ufl.sqrt(z**2) - 0.1], ids=["gap", "slope"]
)
def test_nan_in_gap_or_normal_is_refused(distance):
    """A NaN in the gap leaves points neither open nor closed; one in the slope, no normal."""
    scene = rubber(n=(4, 2), E=10.0)
    obstacle = fc.SignedDistance(lambda x: distance(scene.height - x[1]))
    problem, _ = scene.problem(obstacle, fc.Frictionless(1e3))
    assert_raised_on_all_ranks(problem.solve, fc.NotConverged, "is not a number")


def test_nan_gap_at_the_end_of_an_increment_is_refused():
    """A bump of finite extent leaves the body above it, so that the first touch is NaN."""
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
    assert_raised_on_all_ranks(problem.solve, fc.NotConverged, "is not a number")


def test_sliding_around_an_obstacle_is_not_tunnelling():
    """Points that move around a quarter of a roller, outside of it or on it, do not cross it."""
    scene = rubber(n=(16, 4), E=10.0)
    shift = fem.Constant(scene.mesh, np.zeros(2))
    _, contact = scene.problem(roller(scene, 1.0, shift), fc.Frictionless(1e3))
    for angle in (0.2, 0.8, 1.4):
        # All of the flat Γc rotates about the centre of the roller.
        c, s = np.cos(angle), np.sin(angle)
        centre = np.array([[0.0], [scene.height + 1.0]])
        turn = np.array([[c, -s], [s, c]])
        scene.u.interpolate(lambda x, t=turn, m=centre: t @ (x[:2] - m) + m - x[:2])
        contact.states.forget()
        assert TunnellingCheck([contact]).evaluate(contact.u)[contact.name].crossed is None


@pytest.mark.parametrize("shape", ["ball", "profile"])
def test_rotation_by_more_than_a_right_angle_is_refused(shape):
    """In one increment, 270° gave friction μ N backwards, and 360° gave no friction.

    With cut increments friction is that of steady sliding: μ times the pressure at the lever arm of
    the points, to 1e-9 (ball) or 1e-5 (profile). Without contact any rotation is accepted.
    """
    for angle in (1.5 * np.pi, 2 * np.pi):
        tool = DiscOnRubber(radius=0.8, law=fc.Coulomb(0.3, 1e4, 1e4), shape=shape)
        tool.solve_increment(0.0, 0.01)
        tool.solve_increment(0.0, 0.01, -angle)
        tool.solve_increment(0.0, -0.05, -angle)
        tool.solve_increment(0.0, -0.1, -angle)
        with pytest.raises(fc.NotConverged, match=r"rotates by .* rad in one increment"):
            tool.solve_increment(0.0, -0.1, 0.0)

        def turn(t, tool=tool, angle=angle):
            tool.angle.value = (t - 1) * angle

        for _ in fc.increments(tool.problem, turn, steps=1, max_cuts=2):
            pass
        contact, centre = tool.contact, (0.0, tool.scene.height + 0.7)
        x = contact.points + contact.pairs.own_displacement()
        lever = np.linalg.norm(x - np.array(centre), axis=1)
        expected = COMM.allreduce(0.3 * float((contact.measure * lever) @ contact.pressure))
        allowed = 1e-9 if shape == "ball" else 1e-5
        assert contact.moment(centre)[0] == pytest.approx(expected, rel=allowed)


def test_rotation_that_varies_over_the_surface_is_refused():
    scene = rubber(n=(4, 2))
    x = ufl.SpatialCoordinate(scene.mesh)
    for angle in (0.1 * x[0], scene.u[0]):
        turn = fc.Rotation(angle, about=(0.0, 2.0))
        obstacle = roller(scene, 1.0, (0.0, 0.0), rotation=turn)
        with pytest.raises(ValueError, match="Rotation varies over Γc"):
            scene.contact(obstacle, fc.Coulomb(0.2))


def test_work_of_a_driving_force_on_a_roller_with_rotation():
    """The work of the force on a roller with zero rotation is ½ (f₀ + f₁) Δv, to 1e-8."""
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
def test_relative_stiffness_follows_a_modulus_set_later(linear):
    """If E is set after creation of the problem, k_n is 10 E/h of the new E; to 1e-6."""
    forces = []
    for first in (1000.0, 1.0):
        scene = block("quadrilateral", n=(6, 3), E=first)
        shift = fem.Constant(scene.mesh, (0.0, 0.01))
        bcs = [scene.dirichlet_bc(TOP, i) for i in range(2)]
        law = {"displacement": shift}
        if not linear:
            scene.F = kirchhoff(scene)
        problem, contact = scene.problem(fc.Coulomb(0.3), bcs, contact=law)
        scene.E.value = 1000.0
        problem.solve()
        forces.append(contact.resultants().force)
    assert is_close(np.array(forces[0]), np.array(forces[1]), 1e-6)
    assert forces[0][1] > 1.0


@pytest.mark.parametrize("kinematics", ["small", "finite"])
@pytest.mark.parametrize("set_afterwards", [False, True])
def test_initial_displacement_is_the_slip_reference(kinematics, set_afterwards):
    """A body with an initial displacement along the plate, pressed straight down, does not slip.

    Forces are those from u = 0, to 1e-6, the round-off of the displacement. With ``set_afterwards``
    the displacement is set after creation of the problem.
    """
    forces = []
    for slide in (0.0, 0.3):
        scene = rubber(n=(8, 4), linear=True)
        plate = fc.HalfSpace((0.0, 1.0), (0.0, -1.0), displacement=(0.0, -0.001))
        if set_afterwards:
            problem, contact = scene.problem(
                plate, fc.Coulomb(0.2), contact={"kinematics": kinematics}
            )
        for field in (scene.u, scene.prescribed):
            field.interpolate(lambda x, a=slide: np.array([a + 0 * x[0], 0 * x[0]]))
        if not set_afterwards:
            problem, contact = scene.problem(
                plate, fc.Coulomb(0.2), contact={"kinematics": kinematics}
            )
        problem.solve()
        problem.commit()
        forces.append(contact.resultants().force)
    assert is_close(np.array(forces[0]), np.array(forces[1]), 1e-6)
    assert abs(forces[0][1]) > 1.0


def test_rubber_on_rubber_with_updated_pairs():
    """A nonlinear bulk whose top is moved, with pairs updated at every commit.

    The force agrees with that of one increment to 1 %, the effect of updated pairs.
    """
    ends = []
    for steps in (1, 4):
        mesh, tags = two_blocks("triangle", (8, 3), (2.0, 1.0), 0.5)
        space = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
        u, v = fem.Function(space), ufl.TestFunction(space)
        body = NeoHookean(u, 10.0, 0.3, "plane strain")
        move = [fem.Constant(mesh, 0.0) for _ in range(2)]
        bcs = [dirichlet_bc(u, tags, BOTTOM, i) for i in range(2)]
        bcs += [dirichlet_bc(u, tags, TOP, i, value) for i, value in enumerate(move)]
        base = fc.DeformableBody(tags, LOWER_FACE, update_pairs="increment")
        contact = fc.Contact(u, fc.ContactSurface(mesh, tags, UPPER_FACE), base, fc.Frictionless())
        problem = fc.ContactProblem(body.residual(v), u, bcs=bcs, contacts=[contact])
        for number in range(1, steps + 1):
            move[1].value = -0.05 * number / steps
            problem.solve()
            problem.commit()
        ends.append(contact.resultants().normal_force)
    assert ends[1] == pytest.approx(ends[0], rel=1e-2)
    assert ends[0] > 0.1
