"""Obstacles with prescribed moment about an axis, whose angle of rotation is an unknown."""

from __future__ import annotations

import numpy as np
import pytest
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact import checkpoint
from fenics_contact.parallel import global_max, global_sum
from scenes.blocks import BOTTOM, LEFT, TOP, block, rough_field
from scenes.comparison import assert_raised_on_all_ranks, is_close, shared_folder
from scenes.histories import assert_restart_equals_uninterrupted
from scenes.rubber import TIGHT_TOLERANCE, DiscOnRubber, disc, rubber

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(300)]
COMM = MPI.COMM_WORLD

K = 1e3
RADIUS = 0.8
# Side, up and moment of the roller: pressed, dragged, driven, driven in the opposite direction.
PATH = [(0.0, -0.1, 0.0), (0.06, -0.1, 0.0), (0.1, -0.1, -8.0), (0.02, -0.1, 2.0)]


def increment_angle(contact, axis):
    """Return the moment of the contact forces on the body about the obstacle's displaced axis."""
    d = len(axis)
    motion = np.array(contact.values.shift[:1].sum(axis=0))
    motion = np.array([COMM.allreduce(float(v), op=MPI.SUM) for v in motion])
    motion /= max(1, COMM.allreduce(int(len(contact.points) > 0)))
    for i, constant in contact.free_motion.items():
        motion[i] += float(constant.value)
    moment = contact.moment(np.asarray(axis) + motion)
    return float(moment @ contact.obstacle.rotation.unit_axis(d)[-len(moment) :])


def moment_of(tool):
    """Return the moment of the contact forces of a `DiscOnRubber` about its axis."""
    return increment_angle(tool.contact, tool.vector(0.0, tool.scene.height + RADIUS))


def solve_with_moment(tool, side, up, moment):
    """Set the moment of a driven `DiscOnRubber` and solve an increment."""
    tool.moment.value = moment
    return tool.solve_increment(side, up)


# ---- derivatives ---------------------------------------------------------------------------------


def scene_of(cell, law, shape):
    """Return a block and an obstacle that penetrates it, with unknown translation and rotation."""
    scene = rubber(cell, 2 if cell == "triangle" else 1, n=(4, 2), shuffled=True)
    d = scene.dim
    side, middle = (0.0,) * (d - 1), (0.0,) * (d - 1) + (scene.height + 0.7,)
    move = {
        "displacement": fc.Motion(force=(1.0,) + (None,) * (d - 1)),
        "rotation": fc.Rotation(None, (0.2,) * d, None if d == 2 else (1.0, 2.0, 3.0), moment=0.5),
    }
    obstacles = {
        "plane": fc.HalfSpace((*side, scene.height), (*((0.3,) * (d - 1)), -1.0), **move),
        "ball": fc.Ball(middle, 0.8, **move),
        "cylinder": fc.Cylinder(middle, 0.8, None if d == 2 else (0.2, 1, 0.1), **move),
    }
    problem, contact = scene.problem(obstacles[shape], law, small_displacement_tolerance=np.inf)
    return problem, contact


def tangent_errors(problem, contact, state, direction):
    """Compare the tangent times a direction with central differences of the forces.

    Returns:
        Largest errors in all rows, and in the rows of the obstacle's unknowns, each relative to
        the largest entry of these rows.
    """
    operator, unknowns, step = problem.full.operators[0], problem.full.unknowns, 1e-6

    def force(factor):
        problem.full.set_state(state + factor * step * direction)
        vector = unknowns.vector()
        operator.add_force(vector)
        return vector.array_r.copy()

    expected = (force(1) - force(-1)) / (2 * step)
    problem.full.set_state(state)
    tangent = operator.tangent()
    vector, image = tangent.createVecs()
    vector.array[:] = direction
    tangent.mult(vector, image)
    rows = [(image.array_r, expected)]
    rows.append(tuple(unknowns.motions(v) for v in rows[0]))
    errors = [global_max(COMM, np.abs(a - b)) for a, b in rows]
    return [e / global_max(COMM, np.abs(b)) for e, (_, b) in zip(errors, rows, strict=True)]


@pytest.mark.parametrize(
    ("cell", "shape"), [("triangle", "plane"), ("triangle", "ball"), ("tetrahedron", "cylinder")]
)
def test_tangent_matches_central_differences(cell, shape):
    """Column and row of the angle, alone and with all other unknowns, over a history: 1e-6.

    Central differences of 1e-6 in a state of size 1 have an error of 1e-9. Open, sticking and
    slipping points occur. The matrix without friction is symmetric, to round-off.
    """
    n_by_status = np.zeros(3)
    for law in (fc.Frictionless(K), fc.Coulomb(0.3, K, K), fc.Coulomb(5.0, K, K)):
        problem, contact = scene_of(cell, law, shape)
        d, unknowns, u = contact.points.shape[1], problem.full.unknowns, problem.u
        n_motions = unknowns.n_motions
        assert n_motions == 2
        for seed in range(3):
            u.interpolate(lambda x, d=d, seed=seed: 0.06 * rough_field(d, seed)(x))
            moved = 0.1 * np.sin(seed + 1.0 + np.arange(n_motions))
            state = unknowns.joined(u.x.array[: unknowns.n_dofs], moved)
            problem.full.set_state(state)
            contact.evaluate()
            r = contact.resultants()
            n_by_status += [r.open, r.stick, r.slip]
            u.interpolate(rough_field(d, seed + 5))
            direction = u.x.array[: unknowns.n_dofs].copy()
            no_motion = np.zeros_like(direction)
            angle, shifts = np.eye(n_motions)[-1], 1.0 - np.eye(n_motions)[-1]
            directions = [unknowns.joined(no_motion, angle), unknowns.joined(no_motion, shifts)]
            directions += [unknowns.joined(direction, 0 * angle), unknowns.joined(direction, angle)]
            for perturbation in directions:
                assert max(tangent_errors(problem, contact, state, perturbation)) < 1e-6
            if contact.effective_law.has_potential:
                tangent = problem.full.operators[0].tangent()
                mirrored = tangent.copy().transpose()
                mirrored.axpy(-1.0, tangent)
                assert 0 < tangent.norm() and mirrored.norm() < 1e-13 * tangent.norm()
            contact.commit()
    assert n_by_status[0] > 0 and n_by_status[1] > 0 and n_by_status[2] > 0


# ---- balance -------------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_eccentrically_loaded_platen_tilts(cell):
    """The platen tilts until the contact forces have the moment, to 1e-9 of force times width.

    The opposite moment tilts it in the opposite direction, to 1e-7; without moment it does not
    tilt.
    """
    scene = rubber(cell, 1, n=(8, 4) if cell == "quadrilateral" else (4, 2))
    d, top = scene.dim, scene.height
    moment, about = fem.Constant(scene.mesh, 0.0), (0.0,) * (d - 1) + (top,)
    down = fc.Motion(force=(None,) * (d - 1) + (-40.0,))
    turn = fc.Rotation(None, about, None if d == 2 else (0, -1, 0), moment=moment)
    platen = fc.HalfSpace(about, (0.0,) * (d - 1) + (-1.0,), displacement=down, rotation=turn)
    problem, contact = scene.problem(platen, fc.Frictionless(1e4), petsc_options=TIGHT_TOLERANCE)
    angles = []
    for value in (0.0, 12.0, -12.0):
        moment.value = value
        problem.solve()
        problem.commit()
        assert contact.resultants().force[-1] == pytest.approx(-40.0, rel=1e-9)
        assert abs(increment_angle(contact, about) - value) < 1e-9 * 40.0 * 2.0
        angles.append(float(contact.free_angle.value))
    # A positive moment is that of a downward force left of the middle.
    assert abs(angles[0]) < 1e-12
    assert angles[1] > 1e-3
    assert angles[2] == pytest.approx(-angles[1], rel=1e-7)


@pytest.mark.parametrize(("cell", "force"), [("triangle", True), ("hexahedron", False)])
def test_roller_without_moment_rolls(cell, force):
    """A roller with moment 0, dragged by 0.2, an eighth of its diameter, and back, rolls.

    Friction has no moment about the axis, to 1e-9 of the force; the horizontal force is below 2 %
    of that of sliding. The angle is side/R, to 5 %: the surface under it is stretched, and it sinks
    in.
    """
    tool = DiscOnRubber(
        cell, by_moment=True, by_force=force, **({"n": (16, 6)} if cell == "triangle" else {})
    )
    sign = -1.0 if cell == "triangle" else 1.0  # in space the axis is y: positive to the right
    tool.down.value = -60.0
    tool.solve_increment(0.0, -0.1)
    for side in (0.05, 0.2, 0.1, 0.0):
        tool.side.value = side
        tool.solve_increment(side, -0.1)
        angle, normal = float(tool.contact.free_angle.value), -tool.resultant()[-1]
        assert abs(moment_of(tool)) < 1e-9 * normal
        if cell == "triangle":  # otherwise there are few facets, whose edges resist rolling
            assert abs(tool.resultant()[0]) < 0.02 * 0.3 * normal
            assert angle == pytest.approx(sign * side / RADIUS, rel=0.05, abs=2e-3)
        else:
            assert angle == pytest.approx(sign * side / RADIUS, rel=0.25, abs=5e-3)


def test_long_increments_reduce_the_rolling_angle():
    """Dragged by half its radius in one increment, a roller turns by less than in eight increments.

    By geometry the angle is between atan(s/R), because slip starts at the first contact of a point,
    and s/R; 3 % for the stretch of the surface under it.
    """
    turned = []
    for n in (1, 8):
        tool = DiscOnRubber(by_moment=True, by_force=True, n=(16, 6))
        tool.down.value = -20.0
        tool.solve_increment(0.0, 0.0)
        for tool.side.value in 0.4 * np.arange(1, n + 1) / n:
            tool.solve_increment(0.0, 0.0)
        turned.append(-float(tool.contact.free_angle.value))
    assert np.arctan(0.5) * 0.97 < turned[0] < turned[1] < 0.5 * 1.03
    assert turned[1] == pytest.approx(0.5, rel=0.03)


def test_driven_roller_exerts_traction():
    """A roller at a fixed position, driven by M, exerts a force of M/R, to 5 % because it sinks in.

    The force cannot exceed μ N: then there is no solution, and the state is as before.
    """
    tool = DiscOnRubber(by_moment=True, n=(16, 6))
    solve_with_moment(tool, 0.0, -0.1, 0.0)
    for moment in (2.0, 8.0, -8.0):
        solve_with_moment(tool, 0.0, -0.1, moment)
        assert moment_of(tool) == pytest.approx(moment, rel=1e-9)
        assert tool.resultant()[0] == pytest.approx(moment / RADIUS, rel=0.05)
    before, angle = tool.problem.full.state(), float(tool.contact.free_angle.value)
    tool.moment.value = 0.3 * RADIUS * -tool.resultant()[1] * 1.3
    assert_raised_on_all_ranks(tool.problem.solve, fc.NotConverged, "about its axis")
    assert np.array_equal(tool.problem.full.state(), before)
    assert float(tool.contact.free_angle.value) == angle


@pytest.mark.parametrize(
    ("cell", "enforcement"),
    [("triangle", "penalty"), ("triangle", "augmented"), ("tetrahedron", "augmented")],
)
def test_prescribed_moment_and_prescribed_angle_agree(cell, enforcement):
    """Moments are prescribed first; then the computed angles, with the tangent for known angles.

    Tractions agree to 1e-7 of the largest, the tolerance of the moments; work to 1e-6.
    """
    contact = {"enforcement": enforcement, "tolerance": 1e-9}
    options = {"contact": contact, "law": fc.Coulomb(0.2, 1e4, 1e4)}
    one, other = (DiscOnRubber(cell, by_moment=driven, **options) for driven in (True, False))
    n_by_status = np.zeros(2)
    for side, up, moment in PATH:
        step = solve_with_moment(one, side, up, moment)
        n_by_status += [one.contact.resultants().stick, one.contact.resultants().slip]
        angle_step = other.solve_increment(side, up, float(one.contact.free_angle.value))
        assert is_close(other.tractions(), one.tractions(), 1e-7)
        size = abs(step.energy.elastic) + abs(step.energy.work)
        assert abs(step.energy.work - angle_step.energy.work) < 1e-6 * size
        assert abs(step.energy.imbalance) < 1e-9 * size
    assert n_by_status[0] > 0
    assert n_by_status[1] > 0 or cell == "tetrahedron"  # few points, which all stick


def test_rotation_of_the_whole_scene_rotates_the_solution():
    """A roller rolls before and after a rotation of the whole scene by 1.2 rad about the origin.

    Tractions are those of the scene that is not rotated, rotated, and the computed angle is larger
    by the angle of the rotation: 1e-9.
    """
    unrotated, tool = (DiscOnRubber(by_moment=True) for _ in range(2))
    for side, up, moment in PATH[:3]:
        solve_with_moment(unrotated, side, up, moment)
        solve_with_moment(tool, side, up, moment)
    centre = tool.vector(0.0, tool.scene.height + RADIUS)
    half = tuple((a + b) / 2 for a, b in zip(PATH[2], PATH[3], strict=True))
    directions = [*((a, PATH[2]) for a in (0.3, 0.6, 0.9, 1.2)), (1.2, half), (1.2, PATH[3])]
    for angle, (side, up, moment) in directions:
        c, s = np.cos(angle), np.sin(angle)
        matrix = np.array([[c, -s], [s, c]])
        tool.scene.move_bottom(lambda x, matrix=matrix: matrix @ x)
        to = matrix @ (centre + tool.vector(side, up)) - centre
        tool.shift.value[:], tool.moment.value = to, moment
        tool.problem.solve()
        tool.problem.commit()
        if (side, up, moment) != PATH[2]:
            solve_with_moment(unrotated, side, up, moment)
        assert is_close(tool.tractions(), unrotated.tractions() @ matrix.T, 1e-9)
        computed = float(tool.contact.free_angle.value) - float(unrotated.contact.free_angle.value)
        assert computed == pytest.approx(angle, abs=1e-9)


def test_work_of_the_moment():
    """A drum is driven in small increments: the work in the energies is the moment's, to 2 %."""
    tool = DiscOnRubber(by_moment=True, n=(12, 6))
    solve_with_moment(tool, 0.0, -0.1, 0.0)
    work, moment, angle = 0.0, 0.0, float(tool.contact.free_angle.value)
    for value in (2.0, 4.0, 6.0, 8.0, 6.0, 2.0):
        step = solve_with_moment(tool, 0.0, -0.1, value)
        turned = float(tool.contact.free_angle.value) - angle
        work, moment, angle = (moment + value) / 2 * turned, value, angle + turned
        assert step.energy.work == pytest.approx(work, rel=0.02)


@pytest.mark.parametrize("options", [{"solver": {"method": "lbfgs"}}, {"mixed": "Taylor-Hood"}])
def test_moment_is_reached_by_lbfgs_and_mixed_elements(options):
    """With L-BFGS, and with the pressure as an unknown, the moment is as prescribed, to 1e-9."""
    tool = DiscOnRubber(by_moment=True, n=(8, 4), **options)
    for side, up, moment in PATH:
        solve_with_moment(tool, side, up, moment)
        assert moment_of(tool) == pytest.approx(moment, rel=1e-9, abs=1e-8)


def test_two_rollers_have_their_own_moments():
    """Rollers below a strip, pressed by a force, and above it are driven against each other.

    Moments agree to 1e-9 of force times radius; the scene is symmetric, and so are the angles:
    1e-9.
    """
    scene = block("quadrilateral", 1, n=6)
    force, *moments = (fem.Constant(scene.mesh, 0.0) for _ in range(3))
    law, rollers = fc.Coulomb(0.4, 2e4, 1e4), []
    up = fc.Motion(force=(None, force), displacement=(0.0, None))
    for tag, y, move, moment in ((BOTTOM, -0.6, up, 0), (TOP, 1.6, (0.0, -0.01), 1)):
        turn = fc.Rotation(None, (0.5, y), moment=moments[moment])
        roller = fc.Cylinder((0.5, y), 0.6, displacement=move, rotation=turn)
        surface = fc.ContactSurface(scene.mesh, scene.tags, tag)
        name = f"roller {tag}"
        rollers.append(fc.Contact(scene.u, surface, roller, law, kinematics="finite", name=name))
    problem = fc.ContactProblem(
        scene.F,
        scene.u,
        bcs=[scene.dirichlet_bc(LEFT, 0)],
        contacts=rollers,
        petsc_options=TIGHT_TOLERANCE,
    )
    for force.value, turning in ((10.0, 0.0), (20.0, 0.0), (20.0, 1.0), (20.0, -1.0)):
        moments[0].value, moments[1].value = turning, -turning
        problem.solve()
        problem.commit()
        assert rollers[0].resultants().force[1] == pytest.approx(force.value, rel=1e-9)
        for contact, y, sign in zip(rollers, (-0.6, 1.6), (1, -1), strict=True):
            assert abs(increment_angle(contact, (0.5, y)) - sign * turning) < 1e-9 * 20 * 0.6
        angles = [float(contact.free_angle.value) for contact in rollers]
        assert angles[0] == pytest.approx(-angles[1], rel=1e-9)
    assert abs(angles[0]) > 1e-3


# ---- systems, files, input -----------------------------------------------------------------------


def test_condensed_and_full_systems_agree():
    """Static condensation of a linear body onto contact dofs and angle changes nothing, to 1e-8."""
    computed = []
    for condensation in (True, False):
        solver = {"small_displacement_tolerance": np.inf, "condensation": condensation}
        solver |= {} if condensation else {"method": "newton"}
        tool = DiscOnRubber("hexahedron", by_moment=True, by_force=True, linear=True, solver=solver)
        for step in tool.increments(3.0):
            assert step.contacts["contact"].force[-1] == pytest.approx(tool.down.value, rel=1e-8)
        assert tool.problem.solver.condensed == condensation
        computed.append((tool.tractions(), float(tool.contact.free_angle.value)))
    assert is_close(computed[0][0], computed[1][0], 1e-8)
    assert computed[0][1] == pytest.approx(computed[1][1], rel=1e-8)


VARIANTS = {
    "augmented": {"contact": {"enforcement": "augmented"}},
    "by force": {
        "by_force": True,
        "linear": True,
        "shape": "profile",
        "solver": {"small_displacement_tolerance": np.inf},
    },
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_restart_from_a_checkpoint(variant, tmp_path):
    """A history that is interrupted and restarted has the same digits on one rank, 1e-7 on more."""
    folder = shared_folder(tmp_path)
    assert_restart_equals_uninterrupted(
        lambda: DiscOnRubber(by_moment=True, n=(8, 4), **VARIANTS[variant]), folder, stop=5
    )


def test_checkpoint_of_another_axis_or_moment_is_refused(tmp_path):
    """Restart with another axis, or a prescribed angle, is refused even before any rotation."""
    path = shared_folder(tmp_path) / "state.npz"

    def make(about=(0.0, 1.8), angle=None, moment=None):
        scene = rubber("triangle", 1, n=(8, 4))
        turn = fc.Rotation(angle, about, moment=moment)
        obstacle = fc.Ball((0, 1.8), 0.8, displacement=(0, -0.05), rotation=turn)
        return scene.problem(obstacle, fc.Coulomb(0.3, 1e4, 1e4))[0]

    for options, other in (({"angle": 0.0}, {"moment": 0.0}), ({"moment": 0.0}, {"angle": 0.0})):
        problem = make(**options)
        problem.solve()
        problem.commit()
        checkpoint.save(problem, path)
        checkpoint.load(make(**options), path)
        changed = dict.fromkeys(options, 0.1)
        for mismatched, word in (
            (make(**options, about=(0.1, 1.8)), "about"),
            (make(**changed), "turn of" if "angle" in options else "free obstacles"),
            (make(**other), "free motion"),
        ):
            assert_raised_on_all_ranks(
                lambda p=mismatched: checkpoint.load(p, path), ValueError, word
            )


def test_checkpoint_of_another_axis_direction_is_refused(tmp_path):
    """In space, restart with another direction of the axis is refused even before any rotation."""
    path = shared_folder(tmp_path) / "state.npz"
    problems = []
    for axis in ((0, 1, 0), (0, 2, 0), (0, 1, 0.1)):
        scene = rubber("tetrahedron", 1, n=(1, 1))
        turn = fc.Rotation(0.0, (0, 0, 1.8), axis)
        obstacle = fc.Ball((0, 0, 1.8), 0.8, rotation=turn)
        problems.append(scene.problem(obstacle, fc.Frictionless(1e4))[0])
    checkpoint.save(problems[0], path)
    checkpoint.load(problems[1], path)
    assert_raised_on_all_ranks(lambda: checkpoint.load(problems[2], path), ValueError, "axis")


def test_increments_are_cut_up_to_the_friction_limit():
    """A moment above the friction limit, in one increment that is cut, is reached up to the limit.

    The limit is μ p times the radius reduced by the penetration; within 5 % of it there is no next
    increment that is not cut too often. The last state has its moment, to 1e-9.
    """
    tool = DiscOnRubber(by_moment=True, n=(8, 3), degree=1)
    solve_with_moment(tool, 0.0, -0.1, 0.0)
    reached = []

    def drive():
        for step in fc.increments(tool.problem, tool.moment, 0.0, 25.0, steps=1):
            reached.append(step.load)

    assert_raised_on_all_ranks(drive, fc.NotConverged, "about its axis")
    contact = tool.contact
    arm = contact.measure * (RADIUS - contact.values.penetration)
    limit = 0.3 * COMM.allreduce(float(arm @ contact.pressure))
    assert len(reached) > 1
    assert 0.95 * limit < reached[-1] < limit
    assert moment_of(tool) == pytest.approx(reached[-1], rel=1e-9)


def test_rotation_by_more_than_a_right_angle_is_no_trial_state():
    """The residual of such a state is NaN, so that a line search takes a shorter step."""
    tool = DiscOnRubber(by_moment=True, n=(4, 2))
    solve_with_moment(tool, 0.0, -0.05, 0.0)
    system, unknowns = tool.problem.full, tool.problem.full.unknowns
    start = system.state()
    for angle, twisted in ((1.5, False), (-1.5, False), (1.6, True), (-7.0, True)):
        turned = angle * tool.contact.motions[-1].length
        system.set_state(start + unknowns.joined(np.zeros(unknowns.n_dofs), np.array([turned])))
        assert system.is_over_rotated() == twisted


def test_frictionless_roller_is_unconstrained():
    """Without friction no contact force on a disc has a moment about its centre."""
    scene = rubber(n=(4, 2))
    obstacle = disc(scene, RADIUS, displacement=(0, -0.1), moment=0.0)
    assert_raised_on_all_ranks(
        lambda: scene.problem(obstacle, fc.Frictionless(1e4)), ValueError, "rotation about its axis"
    )


FLAT = {"point": (0, 1), "normal": (0, -1)}


@pytest.mark.whole
@pytest.mark.parametrize(
    ("rotation", "options", "error", "text"),
    [
        (fc.Rotation(0.1, (0, 1), moment=1.0), {}, ValueError, "one of them"),
        (fc.Rotation(None, (0, 1)), {}, ValueError, "one of them"),
        (fc.Rotation(None, (0, 1), moment=(1.0, 2.0)), {}, TypeError, "moment of the Rotation"),
        (fc.Rotation(None, (0, 1), moment="1"), {}, TypeError, "moment of the Rotation"),
        (fc.Rotation(None, (0, 1, 0), moment=1.0), {}, ValueError, "about"),
        (fc.Rotation(None, (0, 1), (0, 0, 1), moment=1.0), {}, ValueError, "omit it"),
        (
            fc.Rotation(None, (0, 1), moment=1.0),
            {"kinematics": "small"},
            ValueError,
            'kinematics="finite"',
        ),
    ],
)
def test_invalid_rotations_are_refused(rotation, options, error, text):
    """Invalid rotations are refused before any work, on all ranks; the error states the remedy."""
    scene = rubber("triangle", 1, n=(2, 1))
    assert_raised_on_all_ranks(
        lambda: scene.contact(
            fc.HalfSpace(**FLAT, rotation=rotation), fc.Frictionless(K), **options
        ),
        error,
        text,
    )


def test_moment_given_as_a_number_can_be_changed():
    """A moment is a parameter of the contact, as an angle is."""
    scene = rubber("triangle", 1, n=(2, 1))
    contact = scene.contact(disc(scene, RADIUS, moment=0.5), fc.Coulomb(0.3, K, K))
    assert contact.applied_moment is contact.parameters["moment"]
    assert contact.motions[0].force * contact.motions[0].length == 0.5
    contact.parameters["moment"].value = -2.0
    assert contact.motions[0].force * contact.motions[0].length == -2.0


def test_moment_that_is_nan_is_refused():
    """NaN in the constant of the moment is refused; the state stays zero."""
    tool = DiscOnRubber(by_moment=True, n=(4, 2))
    tool.moment.value = np.nan
    assert_raised_on_all_ranks(tool.problem.solve, ValueError, "not finite")
    assert global_sum(COMM, np.count_nonzero(tool.problem.full.state())) == 0
