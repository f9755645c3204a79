"""Contact on rigid obstacles from data, and on obstacles of one's own: as by formulas."""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.contact.obstacle_sampler import ObstacleSampler
from scenes.blocks import TOP, block
from scenes.comparing import close, gathered, raised_everywhere, shared_folder, sorted_by_place
from scenes.rubber import TIGHT, disc, domed, rubber
from scenes.surfaces import ball, circle, ring

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(240)]
COMM = MPI.COMM_WORLD

HISTORY = [(0.0, -0.06, 0.0), (0.04, -0.12, 0.1), (-0.02, -0.1, 0.3)]


def pressed(cell, obstacle, *, law=None, unit=1.0, degree=1, cross_check=False, **contact):
    """The forces on the body when a tool presses, is dragged and turned, (n, gdim)."""
    scene = rubber(cell, degree, n=(8, 4) if cell == "triangle" else (4, 2), E=1000.0)
    scene.mesh.geometry.x[:] *= unit
    d = scene.dim
    shift, angle = fem.Constant(scene.mesh, np.zeros(d)), fem.Constant(scene.mesh, 0.0)
    tool = obstacle(shift, angle)
    law = law or fc.Coulomb(0.3, 1e4 / unit, 1e4 / unit)
    options = {"petsc_options": TIGHT, "cross_check": cross_check}
    problem, made = scene.problem(tool, law, contact=contact, **options)
    forces = []
    for side, up, turn in HISTORY:
        shift.value[0], shift.value[-1], angle.value = unit * side, unit * up, turn
        problem.solve()
        problem.commit()
        forces.append(made.resultants().force)
    return np.array(forces) / unit ** (d - 1)


def length(x):
    """Length of a vector (UFL)."""
    return ufl.sqrt(ufl.dot(x, x))


def tool(d, shape, unit=1.0):
    """`disc` of radius 0.8 as a function of its motion."""

    def make(shift, angle):
        centre = unit * np.array((0.0,) * (d - 1) + (1.8,))
        turn = fc.Rotation(angle, centre, None if d == 2 else (0, 1, 0))
        move = {"displacement": shift, "rotation": turn}
        away, reach = ufl.as_vector(list(centre)), 0.8 * unit
        if shape == "ball":
            return fc.Ball(centre, 0.8 * unit, **move)
        if shape == "distance":  # whose curvature the quadrature of Γc does not follow
            return fc.SignedDistance(
                lambda x: ufl.sqrt(ufl.dot(x - away, x - away)) - reach, **move
            )
        if shape == "cylinder":
            return fc.Cylinder(centre, 0.8 * unit, (0, 1, 0) if d == 3 else None, **move)
        if isinstance(shape, int):
            if d == 2:
                return fc.RigidSurface(circle(shape, 0.8 * unit, centre), ring(shape), **move)
            return fc.RigidSurface(*ball(shape, 0.8 * unit, centre), **move)
        points = circle(240, 0.8 * unit)
        if d == 2:
            return fc.RigidProfile(points + centre, closed=True, **move)
        points = np.column_stack([points[:, 0], 0 * points[:, 0], points[:, 1]])[::-1] + centre
        return fc.RigidProfile(points, closed=True, extruded=(0, 1, 0), **move)

    return make


@pytest.mark.parametrize("enforcement", ["penalty", "augmented"])
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_a_spline_presses_as_its_cylinder(cell, enforcement):
    """Forces in a history with friction: those of the `Cylinder` to 1e-6 of the largest.

    The spline's distance differs by 1e-9 radii, its normal by 1e-6.
    """
    d = 2 if cell == "triangle" else 3
    options = {"enforcement": enforcement, "tolerance": 1e-8}
    one, other = (pressed(cell, tool(d, s), **options) for s in ("cylinder", "spline"))
    assert np.abs(one[-1]).min() >= 0 and abs(one[1, 0]) > 1.0
    assert close(other, one, 1e-6)


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_facets_press_as_the_ball_that_they_approach(cell):
    """The force that presses, with an error of second order in the size of the facets.

    To four and twice finer ones: 256 and 16 times less after two, of which half is asked for,
    because facets come to lie by chance. Their directions are of first order: so is what is aside.
    """
    d = 2 if cell == "triangle" else 3
    law = fc.Frictionless(1e4)
    exact = pressed(cell, tool(d, "distance"), law=law)
    sizes = (24, 96, 384) if d == 2 else (3, 4, 5)
    errors = [np.abs(pressed(cell, tool(d, n), law=law) - exact) for n in sizes]
    up, aside = (np.array([e[:, part].max() for e in errors]) for part in (-1, slice(0, -1)))
    assert up[0] / up[-1] > (128.0 if d == 2 else 8.0)
    assert aside[0] / aside[-1] > (8.0 if d == 2 else 2.0)
    assert up[-1] < 5e-3 * np.abs(exact).max()


@pytest.mark.parametrize("shape", ["spline", 30])
def test_units_do_not_matter(shape):
    """Lengths in other units: the same forces by area to 1e-7.

    And at every solution what is assembled from the boundary form is what the points bear.
    """
    one = pressed("triangle", tool(2, shape), cross_check=True)
    for unit in (1e-6, 1e6):
        assert close(pressed("triangle", tool(2, shape, unit), unit=unit), one, 1e-7)


@pytest.mark.parametrize("kinematics", ["small", "finite"])
def test_a_spline_driven_by_a_force(kinematics):
    """It goes as far as the `Cylinder` does, pressed by a force and dragged: 1e-6 of the way."""
    went = []
    for shape in ("cylinder", "spline"):
        scene = rubber("triangle", n=(8, 4), linear=True)
        down, side = (fem.Constant(scene.mesh, 0.0) for _ in range(2))
        motion = fc.Motion(force=(None, down), displacement=(side, None))
        centre = (0.05, 1.8)
        obstacle = fc.Cylinder(centre, 0.8, displacement=motion)
        if shape == "spline":
            points = circle(240, 0.8, centre)
            obstacle = fc.RigidProfile(points, closed=True, displacement=motion)
        problem, contact = scene.problem(
            obstacle,
            fc.Coulomb(0.3, 1e4, 1e4),
            contact={"kinematics": kinematics},
            petsc_options=TIGHT,
            small_displacement_tolerance=np.inf,
        )
        for side.value, down.value in ((0.0, -5.0), (0.0, -20.0), (0.02, -30.0)):
            problem.solve()
            problem.commit()
            went.append(float(contact.free_motion[1].value))
        assert contact.resultants().force[1] == pytest.approx(down.value, rel=1e-8)
    assert close(np.array(went[3:]), np.array(went[:3]), 1e-6)
    assert went[2] < went[0] < 0


class Bubble(fc.SampledObstacle):
    """A ball as one's own obstacle in numbers: a class with three members."""

    gdim, fingerprint = 2, "bubble"

    def __init__(self, centre, radius, displacement, rotation):
        """See the arguments of a `Ball`."""
        self.centre, self.radius = np.asarray(centre), radius
        self.displacement, self.rotation = displacement, rotation

    def sample(self, x):
        """See `SampledObstacle.sample`."""
        arm = x - self.centre
        length = np.linalg.norm(arm, axis=1)
        out = arm / length[:, None]
        bend = (np.eye(2) - np.einsum("ni,nj->nij", out, out)) / length[:, None, None]
        return fc.Sample(length - self.radius, -out, bend)


def test_an_obstacle_of_ones_own_in_numbers():
    """A ball by numpy alone: the forces of the `Ball` to round-off and what Newton leaves, 1e-9."""

    def bubble(shift, angle):
        return Bubble((0.0, 1.8), 0.8, shift, fc.Rotation(angle, (0.0, 1.8)))

    assert close(pressed("triangle", bubble), pressed("triangle", tool(2, "ball")), 1e-9)


class NoDistance(Bubble):
    """A ball whose distance, or whose normal, is not one."""

    def __init__(self, scale, tilt, shift):
        """``scale`` times the distance, and the normal turned by ``tilt`` (radians)."""
        super().__init__((0.5, -0.8), 0.8, shift, None)
        self.scale, self.tilt = scale, tilt

    def sample(self, x):
        """See `SampledObstacle.sample`."""
        c, s = np.cos(self.tilt), np.sin(self.tilt)
        found = super().sample(x)
        normal = found.normal @ np.array([[c, s], [-s, c]])
        return fc.Sample(self.scale * found.distance, normal, found.curvature)


@pytest.mark.whole
@pytest.mark.parametrize("kinematics", ["small", "finite"])
@pytest.mark.parametrize(("scale", "tilt"), [(1.0, 0.0), (2.0, 0.0), (0.9, 0.0), (1.0, 0.1)])
def test_numbers_that_are_no_distance(scale, tilt, kinematics):
    """Twice the distance was verified, with twice the force, and so was a normal that leans."""
    scene = block("triangle", 1, n=6)
    up = fem.Constant(scene.mesh, np.zeros(2))
    given = {"obstacle": NoDistance(scale, tilt, up), "kinematics": kinematics}
    bcs = [scene.hold(TOP, 0), scene.hold(TOP, 1)]
    problem, _ = scene.problem(
        fc.Frictionless(1e3), bcs, contact=given, small_displacement_tolerance=np.inf
    )
    up.value[1] = 0.02
    if scale == 1.0 and tilt == 0.0:
        problem.solve()
    else:
        words = "the gradient of the gap of the NoDistance differs by", "it must be a distance"
        raised_everywhere(problem.solve, fc.NotConverged, *words)


@pytest.mark.parametrize("spread", [1e-2, 1e-6])
@pytest.mark.parametrize("shape", ["profile", "facets"])
def test_differences_across_edges(shape, spread):
    """Around the edges and corners of an L in the plane, and of a cube: at most 4 % of the normal.

    Reference: the distance to a corner, of which a step of 0.05 sideways takes 2.5 % in each
    direction.
    """
    rng = np.random.default_rng(1)
    if shape == "profile":
        corners = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2.0]])
        obstacle: fc.SampledObstacle = fc.RigidProfile(corners, closed=True)
        share = rng.uniform(size=(500, 1)) * (rng.uniform(size=(500, 1)) < 0.7)
        k = rng.integers(len(corners), size=500)
        x = (1 - share) * corners[k] + share * np.roll(corners, -1, axis=0)[k]
    else:
        corners = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1.0)])
        sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        facets = [f for a, b, c, d in sides for f in ((a, b, c), (a, c, d))]
        obstacle = fc.RigidSurface(corners, facets)
        x = rng.uniform(size=(500, 3)).clip(0.1, 0.9).round(2)
        x[np.arange(500), rng.integers(3, size=500)] = rng.integers(2, size=500)
        x[:100] = corners[rng.integers(8, size=100)]
    x += spread * rng.normal(size=x.shape)
    sampler = ObstacleSampler(block("triangle", 1).contact(fc.Frictionless()).quadrature, obstacle)
    assert sampler.gradient_error(x).max() < 0.04


class Faulty(fc.SampledObstacle):
    """A floor that says something wrong of places below it at the right."""

    gdim, fingerprint, displacement, rotation = 2, "faulty", None, None

    def __init__(self, fault):
        """``fault``: what is wrong."""
        self.fault = fault

    def sample(self, x):
        """See `SampledObstacle.sample`."""
        distance, normal = x[:, 1].copy(), np.tile([0.0, -1.0], (len(x), 1))
        wrong = (distance < -1e-6) & (x[:, 0] > 0.9)
        if wrong.any() and self.fault == "error":
            raise RuntimeError("beyond my data")
        distance[wrong] = np.nan if self.fault == "nan" else distance[wrong]
        x[:] = 7.0
        if self.fault == "shape":
            distance = distance[:, None]
        return fc.Sample(distance, normal, np.zeros((len(x), 2, 2)))


@pytest.mark.parametrize(
    ("fault", "error", "text"),
    [
        ("nan", ValueError, "Faulty: distance of its sample is not finite"),
        ("error", RuntimeError, "beyond my data"),
    ],
)
def test_an_obstacle_in_numbers_that_fails_on_the_way(fault, error, text):
    """A NaN is no open gap, and the error of one rank is raised on all of them."""
    scene = block("triangle", 1, n=4)
    down = fem.Constant(scene.mesh, 0.0)
    bcs = [scene.hold(TOP, 0), scene.hold(TOP, 1, down)]
    given = {"obstacle": Faulty(fault), "kinematics": "finite"}
    problem, contact = scene.problem(fc.Coulomb(0.3), bcs, contact=given)
    problem.solve()
    problem.commit()
    down.value = -0.01
    raised_everywhere(problem.solve, error, text)
    down.value = 0.01
    problem.solve()
    assert np.all(contact.pressure == 0.0)


@pytest.mark.parametrize("missing", ["gdim", "fingerprint", "sample"])
def test_an_obstacle_in_numbers_that_says_too_little(missing):
    """What a subclass leaves out is named where the contact is made."""
    said = {"gdim": 2, "fingerprint": "flat", "sample": Faulty.sample}
    del said[missing]
    obstacle = type("Floor", (fc.SampledObstacle,), said)()
    scene = block("triangle", 1)
    words = "Floor is no obstacle", f"must define {missing}"
    raised_everywhere(
        lambda: scene.contact(fc.Frictionless(), obstacle=obstacle, kinematics="finite"),
        ValueError,
        *words,
    )


def test_an_obstacle_that_says_nothing():
    """A subclass of `Obstacle` without a place is refused by name."""
    obstacle = type("Nowhere", (fc.Obstacle,), {})()
    scene = block("triangle", 1)
    raised_everywhere(
        lambda: scene.contact(fc.Frictionless(), obstacle=obstacle),
        ValueError,
        "Nowhere is no obstacle",
        "must define place",
    )


def test_an_obstacle_in_numbers_of_wrong_shape():
    """It is told what is expected, where the contact is first evaluated."""
    given = {"obstacle": Faulty("shape"), "kinematics": "finite"}
    scene = block("triangle", 1)
    words = "Faulty: distance of its sample has shape", "must be"
    raised_everywhere(scene.contact(fc.Frictionless(), **given).evaluate, ValueError, *words)


def test_a_file_of_other_data_is_refused(tmp_path):
    """A history cannot go on on a profile with one more point."""
    path = shared_folder(tmp_path) / "state.npz"

    def made(n):
        scene = rubber("triangle", 1, n=(4, 2))
        profile = fc.RigidProfile(circle(n, 0.8, (0, 1.75)), closed=True)
        return scene.problem(profile, fc.Frictionless(1e4))[0]

    problem = made(60)
    problem.solve()
    problem.commit()
    fc.checkpoint.save(problem, path)
    fc.checkpoint.load(made(60), path)
    raised_everywhere(lambda: fc.checkpoint.load(made(61), path), ValueError, "RigidProfile")


@pytest.mark.each
@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
@pytest.mark.parametrize("shape", ["ball", "profile", "facets"])
def test_a_scene_that_moves_and_turns_as_a_whole(cell, shape):
    """Body and tool moved by any amount, with a history: tractions only turn, 1e-9."""
    found = []
    angle_, d = 2.1, 2 if cell == "triangle" else 3
    for moved in (False, True):
        scene = rubber(cell, 1, n=(6, 3) if d == 2 else (4, 2))
        shift, angle = fem.Constant(scene.mesh, np.zeros(d)), fem.Constant(scene.mesh, 0.0)
        obstacle = disc(scene, 0.8, displacement=shift, angle=angle, axis=(0, 0, 1), shape=shape)
        contact = scene.contact(obstacle, fc.Coulomb(0.3, 1e3, 1e3))
        centre = np.array((0.0,) * (d - 1) + (1.8,))
        for number in range(3):
            own = 0.04 * np.cos(number + np.arange(d))
            a = angle_ * (number + 1) / 3 if moved else 0.0
            turn = np.eye(d)
            turn[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
            away = (number + 1) * np.arange(1.0, d + 1) if moved else np.zeros(d)
            pull = np.array([0.05 * np.sin(number), *(0.0,) * (d - 2), 0.1])

            def place(x, own=pull, turn=turn, away=away, wave=0.02 * number):
                bent = x[:d] + own[:, None] + wave * np.sin(3 * x[0])
                return turn @ bent + away[:, None] - x[:d]

            scene.u.interpolate(place)
            shift.value[:] = turn @ (centre + own) + away - centre
            angle.value = a
            contact.evaluate()
            if number == 2:
                rows = gathered(COMM, contact.points), gathered(COMM, contact.traction @ turn)
                found.append(sorted_by_place(*rows)[:, d:])
            contact.commit()
    assert np.abs(found[0]).max() > 10.0
    assert close(found[1], found[0], 1e-9)


@pytest.mark.parametrize("law", [fc.Frictionless(1e4), fc.Coulomb(0.2, 1e4, 1e4)])
def test_small_and_finite_agree_where_displacements_are_small(law):
    """A spline that fits the domed block: shares of the difference fall as the displacement does.

    Four times smaller, four times less; 25 % for the terms of higher order. And small kinematics
    of the spline are those of its cavity, to the 1e-6 of its normals, as is what the verdict says.
    """
    t = np.linspace(0.2, np.pi - 0.2, 121)
    arc = np.column_stack([2 * np.cos(t), 2 * np.sin(t) - 1])[::-1]  # the obstacle is outside
    share, told = [], []
    for size in (4e-3, 1e-3):
        found = []
        for kinematics, profile in (("finite", True), ("small", True), ("small", False)):
            scene = rubber("triangle", n=(12, 6), linear=True, bend=domed)
            shift = fem.Constant(scene.mesh, np.zeros(2))
            cavity = fc.Ball((0, -1), 2.0, inside=True, displacement=shift)
            spline = fc.RigidProfile(arc, displacement=shift)
            problem, contact = scene.problem(
                spline if profile else cavity,
                law,
                contact={"kinematics": kinematics},
                petsc_options=TIGHT,
                small_displacement_tolerance=np.inf,
            )
            for side, up in ((0.0, -1.0), (0.5, -1.5)):
                shift.value[:] = size * side, size * up
                step = problem.solve()
                problem.commit()
            found.append(contact.resultants().force)
            told.append(step.verdict.small_displacement_error["contact"].worst)
        share.append(np.linalg.norm(found[0] - found[1]) / np.linalg.norm(found[1]))
        assert close(found[1], found[2], 1e-5)
        assert told[-3] == 0.0 and told[-2] == pytest.approx(told[-1], rel=1e-2)
    assert share[0] > 1e-5
    assert share[0] / share[1] == pytest.approx(4.0, rel=0.25)
