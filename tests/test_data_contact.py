"""Contact with sampled and user-defined obstacles agrees with contact with analytic ones."""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.contact.obstacle_sampler import ObstacleSampler
from scenes.blocks import TOP, block
from scenes.comparison import (
    assert_raised_on_all_ranks,
    gather,
    is_close,
    shared_folder,
    sort_by_coordinates,
)
from scenes.rubber import TIGHT_TOLERANCE, bend_top, disc, rubber
from scenes.surfaces import ball, circle, ring

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(240)]
COMM = MPI.COMM_WORLD

HISTORY = [(0.0, -0.06, 0.0), (0.04, -0.12, 0.1), (-0.02, -0.1, 0.3)]


def tool_forces(cell, obstacle, *, law=None, unit=1.0, degree=1, cross_check=False, **contact):
    """Return the forces on the body while a tool is pressed, dragged and rotated, (n, gdim)."""
    scene = rubber(cell, degree, n=(8, 4) if cell == "triangle" else (4, 2), E=1000.0)
    scene.mesh.geometry.x[:] *= unit
    d = scene.dim
    shift, angle = fem.Constant(scene.mesh, np.zeros(d)), fem.Constant(scene.mesh, 0.0)
    tool = obstacle(shift, angle)
    law = law or fc.Coulomb(0.3, 1e4 / unit, 1e4 / unit)
    options = {"petsc_options": TIGHT_TOLERANCE, "cross_check": cross_check}
    problem, body_contact = scene.problem(tool, law, contact=contact, **options)
    forces = []
    for side, up, turn in HISTORY:
        shift.value[0], shift.value[-1], angle.value = unit * side, unit * up, turn
        problem.solve()
        problem.commit()
        forces.append(body_contact.resultants().force)
    return np.array(forces) / unit ** (d - 1)


def length(x):
    """Return the length of a vector (UFL)."""
    return ufl.sqrt(ufl.dot(x, x))


def tool_maker(d, shape, unit=1.0):
    """Return a function that makes a `disc` of radius 0.8 from its displacement and angle."""

    def make(shift, angle):
        centre = unit * np.array((0.0,) * (d - 1) + (1.8,))
        turn = fc.Rotation(angle, centre, None if d == 2 else (0, 1, 0))
        move = {"displacement": shift, "rotation": turn}
        away, reach = ufl.as_vector(list(centre)), 0.8 * unit
        if shape == "ball":
            return fc.Ball(centre, 0.8 * unit, **move)
        if shape == "distance":  # the quadrature of Γc is not adapted to its curvature
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
def test_spline_agrees_with_the_cylinder(cell, enforcement):
    """Forces over a history with friction are those of the `Cylinder`, to 1e-6 of the largest.

    The spline's distance differs by 1e-9 radii, its normal by 1e-6.
    """
    d = 2 if cell == "triangle" else 3
    options = {"enforcement": enforcement, "tolerance": 1e-8}
    one, other = (tool_forces(cell, tool_maker(d, s), **options) for s in ("cylinder", "spline"))
    assert np.abs(one[-1]).min() >= 0 and abs(one[1, 0]) > 1.0
    assert is_close(other, one, 1e-6)


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_faceted_ball_converges_to_the_ball(cell):
    """The error of the normal force is of second order in the facet size.

    Facets are refined twice, by four in the plane and by two in space: the error falls by 256 and
    16, of which half is required, because the positions of the facets are arbitrary. Their normals
    are of first order, and so are the tangential forces.
    """
    d = 2 if cell == "triangle" else 3
    law = fc.Frictionless(1e4)
    exact = tool_forces(cell, tool_maker(d, "distance"), law=law)
    sizes = (24, 96, 384) if d == 2 else (3, 4, 5)
    errors = [np.abs(tool_forces(cell, tool_maker(d, n), law=law) - exact) for n in sizes]
    up, tangential_error = (
        np.array([e[:, part].max() for e in errors]) for part in (-1, slice(0, -1))
    )
    assert up[0] / up[-1] > (128.0 if d == 2 else 8.0)
    assert tangential_error[0] / tangential_error[-1] > (8.0 if d == 2 else 2.0)
    assert up[-1] < 5e-3 * np.abs(exact).max()


@pytest.mark.parametrize("shape", ["spline", 30])
def test_forces_are_independent_of_the_unit_of_length(shape):
    """Forces by area agree between units of length, to 1e-7.

    Nodal forces of every solution with unit 1 agree with those assembled from the boundary form.
    """
    one = tool_forces("triangle", tool_maker(2, shape), cross_check=True)
    for unit in (1e-6, 1e6):
        assert is_close(tool_forces("triangle", tool_maker(2, shape, unit), unit=unit), one, 1e-7)


@pytest.mark.parametrize("kinematics", ["small", "finite"])
def test_spline_driven_by_a_force_agrees_with_the_cylinder(kinematics):
    """Displacements of a spline and a `Cylinder`, pressed by a force and dragged, agree to 1e-6."""
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
            petsc_options=TIGHT_TOLERANCE,
            small_displacement_tolerance=np.inf,
        )
        for side.value, down.value in ((0.0, -5.0), (0.0, -20.0), (0.02, -30.0)):
            problem.solve()
            problem.commit()
            went.append(float(contact.free_motion[1].value))
        assert contact.resultants().force[1] == pytest.approx(down.value, rel=1e-8)
    assert is_close(np.array(went[3:]), np.array(went[:3]), 1e-6)
    assert went[2] < went[0] < 0


class Bubble(fc.SampledObstacle):
    """A user-defined sampled ball: a class with three members."""

    gdim, fingerprint = 2, "bubble"

    def __init__(self, centre, radius, displacement, rotation):
        """Place the ball; the arguments are those of a `Ball`."""
        self.centre, self.radius = np.asarray(centre), radius
        self.displacement, self.rotation = displacement, rotation

    def sample(self, x):
        """Sample the ball, as `SampledObstacle.sample` requires."""
        arm = x - self.centre
        length = np.linalg.norm(arm, axis=1)
        out = arm / length[:, None]
        bend = (np.eye(2) - np.einsum("ni,nj->nij", out, out)) / length[:, None, None]
        return fc.Sample(length - self.radius, -out, bend)


def test_user_defined_sampled_ball_agrees_with_ball():
    """Forces are those of the `Ball`, to round-off and the tolerance of Newton's method, 1e-9."""

    def bubble(shift, angle):
        return Bubble((0.0, 1.8), 0.8, shift, fc.Rotation(angle, (0.0, 1.8)))

    assert is_close(
        tool_forces("triangle", bubble), tool_forces("triangle", tool_maker(2, "ball")), 1e-9
    )


class NoDistance(Bubble):
    """A ball whose distance or normal is wrong."""

    def __init__(self, scale, tilt, shift):
        """Scale the distance by ``scale`` and rotate the normal by ``tilt`` (radians)."""
        super().__init__((0.5, -0.8), 0.8, shift, None)
        self.scale, self.tilt = scale, tilt

    def sample(self, x):
        """Sample the ball with its wrong distance and normal."""
        c, s = np.cos(self.tilt), np.sin(self.tilt)
        sample = super().sample(x)
        normal = sample.normal @ np.array([[c, s], [-s, c]])
        return fc.Sample(self.scale * sample.distance, normal, sample.curvature)


@pytest.mark.whole
@pytest.mark.parametrize("kinematics", ["small", "finite"])
@pytest.mark.parametrize(("scale", "tilt"), [(1.0, 0.0), (2.0, 0.0), (0.9, 0.0), (1.0, 0.1)])
def test_samples_that_are_no_distance_are_refused(scale, tilt, kinematics):
    """Twice the distance was accepted, with twice the force, and so was an inclined normal."""
    scene = block("triangle", 1, n=6)
    up = fem.Constant(scene.mesh, np.zeros(2))
    options = {"obstacle": NoDistance(scale, tilt, up), "kinematics": kinematics}
    bcs = [scene.dirichlet_bc(TOP, 0), scene.dirichlet_bc(TOP, 1)]
    problem, _ = scene.problem(
        fc.Frictionless(1e3), bcs, contact=options, small_displacement_tolerance=np.inf
    )
    up.value[1] = 0.02
    if scale == 1.0 and tilt == 0.0:
        problem.solve()
    else:
        words = "the gradient of the gap of the NoDistance differs by", "it must be a distance"
        assert_raised_on_all_ranks(problem.solve, fc.NotConverged, *words)


@pytest.mark.parametrize("spread", [1e-2, 1e-6])
@pytest.mark.parametrize("shape", ["profile", "facets"])
def test_gradient_error_is_small_at_edges_and_corners(shape, spread):
    """Around edges and corners of an L in the plane and of a cube it is at most 4 % of the normal.

    Reference: the distance to a corner, which a step of 0.05 sideways changes by 2.5 % in each
    direction.
    """
    rng = np.random.default_rng(1)
    if shape == "profile":
        corners = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2.0]])
        obstacle: fc.SampledObstacle = fc.RigidProfile(corners, closed=True)
        fraction = rng.uniform(size=(500, 1)) * (rng.uniform(size=(500, 1)) < 0.7)
        k = rng.integers(len(corners), size=500)
        x = (1 - fraction) * corners[k] + fraction * np.roll(corners, -1, axis=0)[k]
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
    """A floor whose samples are wrong at places below it on the right."""

    gdim, fingerprint, displacement, rotation = 2, "faulty", None, None

    def __init__(self, fault):
        """Set the kind of the error, ``fault``."""
        self.fault = fault

    def sample(self, x):
        """Sample the floor with its fault."""
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
def test_error_of_a_sample_during_the_iteration_is_raised(fault, error, text):
    """A NaN does not count as an open gap, and the error of one rank is raised on all ranks."""
    scene = block("triangle", 1, n=4)
    down = fem.Constant(scene.mesh, 0.0)
    bcs = [scene.dirichlet_bc(TOP, 0), scene.dirichlet_bc(TOP, 1, down)]
    options = {"obstacle": Faulty(fault), "kinematics": "finite"}
    problem, contact = scene.problem(fc.Coulomb(0.3), bcs, contact=options)
    problem.solve()
    problem.commit()
    down.value = -0.01
    assert_raised_on_all_ranks(problem.solve, error, text)
    down.value = 0.01
    problem.solve()
    assert np.all(contact.pressure == 0.0)


@pytest.mark.parametrize("missing", ["gdim", "fingerprint", "sample"])
def test_missing_members_of_a_sampled_obstacle_are_named(missing):
    """The error names the missing member of a subclass when the contact is made."""
    members = {"gdim": 2, "fingerprint": "flat", "sample": Faulty.sample}
    del members[missing]
    obstacle = type("Floor", (fc.SampledObstacle,), members)()
    scene = block("triangle", 1)
    words = "Floor is no obstacle", f"must define {missing}"
    assert_raised_on_all_ranks(
        lambda: scene.contact(fc.Frictionless(), obstacle=obstacle, kinematics="finite"),
        ValueError,
        *words,
    )


def test_obstacle_without_place_is_refused():
    """A subclass of `Obstacle` without ``place`` is refused by name."""
    obstacle = type("Nowhere", (fc.Obstacle,), {})()
    scene = block("triangle", 1)
    assert_raised_on_all_ranks(
        lambda: scene.contact(fc.Frictionless(), obstacle=obstacle),
        ValueError,
        "Nowhere is no obstacle",
        "must define place",
    )


def test_sample_of_wrong_shape_is_refused():
    """The error states the required shape when the contact is first evaluated."""
    options = {"obstacle": Faulty("shape"), "kinematics": "finite"}
    scene = block("triangle", 1)
    words = "Faulty: distance of its sample has shape", "must be"
    assert_raised_on_all_ranks(
        scene.contact(fc.Frictionless(), **options).evaluate, ValueError, *words
    )


def test_checkpoint_of_another_profile_is_refused(tmp_path):
    """A history cannot be restarted on a profile with one more point."""
    path = shared_folder(tmp_path) / "state.npz"

    def make_setup(n):
        scene = rubber("triangle", 1, n=(4, 2))
        profile = fc.RigidProfile(circle(n, 0.8, (0, 1.75)), closed=True)
        return scene.problem(profile, fc.Frictionless(1e4))[0]

    problem = make_setup(60)
    problem.solve()
    problem.commit()
    fc.checkpoint.save(problem, path)
    fc.checkpoint.load(make_setup(60), path)
    assert_raised_on_all_ranks(
        lambda: fc.checkpoint.load(make_setup(61), path), ValueError, "RigidProfile"
    )


@pytest.mark.each
@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
@pytest.mark.parametrize("shape", ["ball", "profile", "facets"])
def test_tractions_rotate_with_the_whole_scene(cell, shape):
    """A common rigid motion of body and tool, over a history, only rotates tractions: 1e-9."""
    computed = []
    angle_, d = 2.1, 2 if cell == "triangle" else 3
    for moved in (False, True):
        scene = rubber(cell, 1, n=(6, 3) if d == 2 else (4, 2))
        shift, angle = fem.Constant(scene.mesh, np.zeros(d)), fem.Constant(scene.mesh, 0.0)
        obstacle = disc(scene, 0.8, displacement=shift, angle=angle, axis=(0, 0, 1), shape=shape)
        contact = scene.contact(obstacle, fc.Coulomb(0.3, 1e3, 1e3))
        centre = np.array((0.0,) * (d - 1) + (1.8,))
        for number in range(3):
            body_motion = 0.04 * np.cos(number + np.arange(d))
            a = angle_ * (number + 1) / 3 if moved else 0.0
            turn = np.eye(d)
            turn[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
            away = (number + 1) * np.arange(1.0, d + 1) if moved else np.zeros(d)
            pull = np.array([0.05 * np.sin(number), *(0.0,) * (d - 2), 0.1])

            def place(x, body_motion=pull, turn=turn, away=away, wave=0.02 * number):
                bent = x[:d] + body_motion[:, None] + wave * np.sin(3 * x[0])
                return turn @ bent + away[:, None] - x[:d]

            scene.u.interpolate(place)
            shift.value[:] = turn @ (centre + body_motion) + away - centre
            angle.value = a
            contact.evaluate()
            if number == 2:
                rows = gather(COMM, contact.points), gather(COMM, contact.traction @ turn)
                computed.append(sort_by_coordinates(*rows)[:, d:])
            contact.commit()
    assert np.abs(computed[0]).max() > 10.0
    assert is_close(computed[1], computed[0], 1e-9)


@pytest.mark.parametrize("law", [fc.Frictionless(1e4), fc.Coulomb(0.2, 1e4, 1e4)])
def test_small_and_finite_kinematics_agree_at_small_displacements(law):
    """With a spline that fits the domed block, the relative difference is of first order.

    Four times smaller displacements have a four times smaller relative difference; 25 % for the
    terms of higher order. Small kinematics of the spline agree with those of its cavity, to 1e-5 by
    the 1e-6 of its normals, and so do the small-displacement errors of the verdict, to 1 %.
    """
    t = np.linspace(0.2, np.pi - 0.2, 121)
    arc = np.column_stack([2 * np.cos(t), 2 * np.sin(t) - 1])[::-1]  # obstacle outside the arc
    relative_errors, reported = [], []
    for size in (4e-3, 1e-3):
        computed = []
        for kinematics, profile in (("finite", True), ("small", True), ("small", False)):
            scene = rubber("triangle", n=(12, 6), linear=True, bend=bend_top)
            shift = fem.Constant(scene.mesh, np.zeros(2))
            cavity = fc.Ball((0, -1), 2.0, inside=True, displacement=shift)
            spline = fc.RigidProfile(arc, displacement=shift)
            problem, contact = scene.problem(
                spline if profile else cavity,
                law,
                contact={"kinematics": kinematics},
                petsc_options=TIGHT_TOLERANCE,
                small_displacement_tolerance=np.inf,
            )
            for side, up in ((0.0, -1.0), (0.5, -1.5)):
                shift.value[:] = size * side, size * up
                step = problem.solve()
                problem.commit()
            computed.append(contact.resultants().force)
            reported.append(step.verdict.small_displacement_error["contact"].worst)
        relative_errors.append(
            np.linalg.norm(computed[0] - computed[1]) / np.linalg.norm(computed[1])
        )
        assert is_close(computed[1], computed[2], 1e-5)
        assert reported[-3] == 0.0 and reported[-2] == pytest.approx(reported[-1], rel=1e-2)
    assert relative_errors[0] > 1e-5
    assert relative_errors[0] / relative_errors[1] == pytest.approx(4.0, rel=0.25)
