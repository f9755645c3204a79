"""Forces of very different sizes, one after another and side by side.

References are the forces applied: what the floor bears is the load, whatever was before and
whatever is beside it. A body held by contact alone bears it to the tolerance, 1e-9 of the forces of
this increment (of its own), or of what ``accuracy`` asks for. By methods whose iterations end with
a step that changes nothing it is far less.
"""

import numpy as np
import pytest
import ufl
from mpi4py import MPI

import fenics_contact as fc
from scenes.blocks import block
from scenes.bodies import Bodies, boxes
from scenes.comparing import at_points

COMM = MPI.COMM_WORLD
FLOOR, ROOF, FLOOR_2, ROOF_2 = 1, 2, 3, 4

pytestmark = pytest.mark.two_ranks


def may_take_long(*, refused: bool) -> None:
    """On all unknowns what may be refused takes thousands of iterations."""
    if refused and COMM.size > 1:
        pytest.skip("takes minutes on several ranks")


# ---- one after another ---------------------------------------------------------------------------


def touched_again(level, small, *, accuracy=None, cell="triangle", **options):
    """Press with ``level``, release, touch with ``small``, shear by a fifth of that: the forces.

    The material is such that the heavy load compresses it by 1 %. It stays where it is released,
    off its first place: forces of that displacement have the round-off that is returned last.
    """
    E = 100 * level
    scene = block(cell, n=4, E=E)
    problem, contact = scene.problem(fc.Coulomb(0.3), [], contact={"accuracy": accuracy}, **options)
    found = []
    for up, side in ((-level, 0.0), (0.0, 0.0), (-small, 0.0), (-small, 0.2 * small)):
        scene.load(up=up, side=side)
        problem.solve()
        problem.commit()
        force = contact.resultants().force
        found.append(np.array([force[0], force[-1]]))
        if up == 0.0:
            left = COMM.allreduce(np.abs(scene.u.x.array).max(initial=0.0), MPI.MAX)
    return found, np.finfo(float).eps * E * left


@pytest.mark.each
@pytest.mark.parametrize("accuracy", [None, "draft", "standard", "fine"])
@pytest.mark.parametrize("level", [10.0, 1e3, 1e7, 1e10])
def test_a_light_touch_after_a_heavy_one(level, accuracy):
    """The forces of earlier increments are no measure of those of this one.

    One that is 1e11 times lighter, near the round-off of what was before, may be refused. If not
    its forces are right to ten times the round-off of where the body was left.
    """
    may_take_long(refused=level >= 1e7)
    small = 1e-4
    try:
        (pressed, _, touched, sheared), rounded = touched_again(level, small, accuracy=accuracy)
    except fc.NotConverged:
        assert level >= 1e7
        return
    rtol = 1e-8 if accuracy is None else fc.Accuracy.of(accuracy).rtol * 10
    assert abs(pressed[1] - level) <= rtol * level
    allowed = rtol * small + 10 * rounded
    assert np.abs(touched - [0, small]).max() <= allowed
    assert np.abs(sheared - [-0.2 * small, small]).max() <= allowed


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize("condensation", [None, False])
def test_a_light_touch_by_every_method(method, condensation):
    (*_, sheared), _ = touched_again(1e3, 1e-4, method=method, condensation=condensation)
    assert np.abs(sheared - [-0.2e-4, 1e-4]).max() <= 1e-8 * 1e-4


@pytest.mark.parametrize("drop", [1e-3, 1e-8, 1e-12])
def test_a_load_that_falls_in_one_increment(drop):
    """With no release in between; where the increment's own round-off begins it may be refused."""
    may_take_long(refused=drop == 1e-12)
    scene = block("quadrilateral", n=4)
    problem, contact = scene.problem(fc.Coulomb(0.3), [])
    for up in (-1.0, -drop):
        scene.load(up=up, side=0.1 * up)
        try:
            problem.solve()
        except fc.NotConverged:
            assert up == -drop == -1e-12
            return
        problem.commit()
    force = contact.resultants().force
    assert np.abs(force - [0.1 * drop, drop]).max() <= 1e-8 * drop + 1e-14


# ---- side by side --------------------------------------------------------------------------------


def beside(ratio, *, one_contact=False, joined=False, friction=0.5, **options):
    """Two boxes on a floor, loaded by 10 and 10/ratio, then sheared by a fifth of that; forces.

    ``one_contact``: one Γc of both. ``joined``: one body with two feet instead.
    """
    axes = [
        [np.linspace(0, 1, 4), np.linspace(0, 1, 4)],
        [np.linspace(2, 3, 4), np.linspace(0, 1, 4)],
    ]
    sides = {
        FLOOR: lambda x, c: (np.abs(x[:, 1]) < 1e-9) & (c[:, 0] < 1.5),
        ROOF: lambda x, c: (np.abs(x[:, 1] - 1) < 1e-9) & (c[:, 0] < 1.5),
        FLOOR_2: lambda x, c: (np.abs(x[:, 1]) < 1e-9) & (c[:, 0] > 1.5),
        ROOF_2: lambda x, c: (np.abs(x[:, 1] - 1) < 1e-9) & (c[:, 0] > 1.5),
    }
    body = Bodies(boxes(axes, sides), 1e3, 0.3)
    loads = np.array([10.0, 10.0 / ratio])
    shear = body.constant()
    for load, roof in zip(loads, (ROOF, ROOF_2), strict=True):
        q = body.constant(load)
        body.F += q * body.v[1] * body.ds(roof) - shear * q * body.v[0] * body.ds(roof)
    floors = [[FLOOR, FLOOR_2]] if one_contact else [FLOOR, FLOOR_2]
    contacts = [
        body.contact(tags, fc.HalfSpace((0, 0), (0, 1)), fc.Coulomb(friction), name=f"floor {i}")
        for i, tags in enumerate(floors)
    ]
    problem = body.problem(*contacts, **options)
    for side in (0.0, 0.2):
        shear.value = side
        step = problem.solve()
        problem.commit()
    found = []
    for low, high in ((-1, 1.5), (1.5, 4)):
        force = np.zeros(2)
        for contact in contacts:
            rows = at_points(contact, np.hstack([contact.points, contact.traction]))
            measure = at_points(contact, contact.measure[:, None])
            mine = (rows[:, 0] > low) & (rows[:, 0] < high)
            force += measure[mine, 0] @ rows[mine, 2:]
        found.append(force)
    return loads, found, step


@pytest.mark.each
@pytest.mark.parametrize("one_contact", [False, True])
@pytest.mark.parametrize("method", [None, "lbfgs", "newton"])
@pytest.mark.parametrize("ratio", [1e3, 1e4, 1e8])
def test_a_light_body_beside_a_heavy_one(ratio, method, one_contact):
    """Every body bears its own load, as exactly as if it were alone."""
    loads, found, step = beside(ratio, method=method, one_contact=one_contact)
    for load, force in zip(loads, found, strict=True):
        assert np.abs(force - [-0.2 * load, load]).max() <= 1e-8 * load
    assert set(step.verdict.equations) >= {"body 1", "body 2"}
    assert set(step.verdict.sums) == {"body 1", "body 2"}
    assert not step.verdict.failures


def test_a_body_out_of_balance_is_named():
    """One whose residual is large by its own forces fails, small as it is beside the others'."""
    *_, step = beside(1e8)
    verdict = step.verdict
    light = verdict.equations["body 2"]  # they are numbered along x
    assert light.force < 1e-6
    broken = fc.ForceBalance(1e-3 * light.force, light.force, light.tolerance)
    equations = verdict.equations | {"body 2": broken}
    failures = fc.Verdict(equations, verdict.sums, verdict.laws).failures
    assert len(failures) == 1 and "body 2" in failures[0]


@pytest.mark.parametrize("condensation", [None, False])
def test_a_soft_body_beside_a_stiff_one(condensation):
    """What passes on a body is a share of its own forces, whatever is as stiff as 1e8 times it.

    Both are held at their tops and pressed on a floor by 1e-3 of their height. The solver is asked
    for 1e-9 of the forces; the round-off of the stiff body is more than that of the soft one's.
    """
    lines = np.linspace(0, 1, 4)
    sides = {
        FLOOR: lambda x, c: (np.abs(x[:, 1]) < 1e-9) & (c[:, 0] < 1.5),
        FLOOR_2: lambda x, c: (np.abs(x[:, 1]) < 1e-9) & (c[:, 0] > 1.5),
        ROOF: lambda x, c: np.abs(x[:, 1] - 1) < 1e-9,
    }
    made = boxes([[lines, lines], [lines + 2, lines]], sides)
    E = ufl.conditional(ufl.lt(ufl.SpatialCoordinate(made[0])[0], 1.5), 1e8, 1.0)
    body = Bodies(made, E, 0.3)
    body.hold(ROOF, 0)
    body.hold(ROOF, 1, value=-1e-3)
    floor = fc.HalfSpace((0, 0), (0, 1))
    contacts = [
        body.contact(tag, floor, fc.Coulomb(0.3), name=f"floor {tag}") for tag in (FLOOR, FLOOR_2)
    ]
    step = body.problem(*contacts, condensation=condensation).solve()
    soft = step.verdict.equations["body 2"]  # they are numbered along x
    assert 1e-4 < soft.force < 1e-2
    assert soft.tolerance == pytest.approx(1e-9 * soft.force, rel=1e-6)


# ---- numbers that are none -----------------------------------------------------------------------


@pytest.mark.each
@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("place", ["residual", "force", "tolerance"])
def test_what_is_not_finite_does_not_pass(place, value):
    """Not even an infinite residual below an infinite tolerance."""
    numbers = {"residual": np.inf if value == np.inf else 0.0, "force": 1.0, "tolerance": np.inf}
    numbers[place] = value
    broken = fc.ForceBalance(**numbers)
    sound = fc.ForceBalance(0.0, 1.0, 1e-9)
    assert fc.Verdict({"the body": broken}, {"the body": sound}).failures
    assert fc.Verdict({"the body": sound}, {"the body": broken}).failures
    assert not fc.Verdict({"the body": sound}, {"the body": sound}).failures


@pytest.mark.parametrize("E", [1e100, 1e200, 1e300])
def test_a_modulus_beyond_all_measure(E):
    """The load is borne, or the increment is refused; never an answer without force."""
    scene = block("quadrilateral", E=E, up=-1.0)
    problem, contact = scene.problem(fc.Frictionless(), scene.rollers())
    try:
        problem.solve()
    except (fc.NotConverged, ValueError):
        return
    assert abs(contact.resultants().force[1] - 1.0) <= 1e-8
