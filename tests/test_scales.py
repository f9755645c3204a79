"""Forces of very different magnitude, in successive increments and on bodies in one mesh.

References are the applied forces: the contact force is the load, independently of earlier
increments and of other bodies. On a body constrained by contact alone it agrees to the tolerance,
1e-9 of the body's forces in this increment, or to that set by ``accuracy``. With methods whose
iterations end with a step of zero the error is far smaller.
"""

import numpy as np
import pytest
import ufl
from mpi4py import MPI

import fenics_contact as fc
from scenes.blocks import block
from scenes.bodies import Bodies, boxes
from scenes.comparison import point_values

COMM = MPI.COMM_WORLD
FLOOR, ROOF, FLOOR_2, ROOF_2 = 1, 2, 3, 4

pytestmark = pytest.mark.two_ranks


def skip_if_slow(*, refused: bool) -> None:
    """Skip on several ranks: a refusal by the uncondensed system takes thousands of iterations."""
    if refused and COMM.size > 1:
        pytest.skip("takes minutes on several ranks")


# ---- successive increments -----------------------------------------------------------------------


def repress(level, small, *, accuracy=None, cell="triangle", **options):
    """Press with ``level``, release, press with ``small``, shear by a fifth; return the forces.

    The material is such that the heavy load compresses it by 1 %. The body stays where it is
    released, displaced from its initial position; the round-off of the forces there is returned,
    too.
    """
    E = 100 * level
    scene = block(cell, n=4, E=E)
    problem, contact = scene.problem(fc.Coulomb(0.3), [], contact={"accuracy": accuracy}, **options)
    computed = []
    for up, side in ((-level, 0.0), (0.0, 0.0), (-small, 0.0), (-small, 0.2 * small)):
        scene.load(up=up, side=side)
        problem.solve()
        problem.commit()
        force = contact.resultants().force
        computed.append(np.array([force[0], force[-1]]))
        if up == 0.0:
            left = COMM.allreduce(np.abs(scene.u.x.array).max(initial=0.0), MPI.MAX)
    return computed, np.finfo(float).eps * E * left


@pytest.mark.each
@pytest.mark.parametrize("accuracy", [None, "draft", "standard", "fine"])
@pytest.mark.parametrize("level", [10.0, 1e3, 1e7, 1e10])
def test_small_load_after_a_large_one(level, accuracy):
    """Tolerances do not depend on the forces of earlier increments.

    A load 1e11 times smaller, near the round-off of the earlier one, may be refused. Otherwise its
    forces are correct to the tolerance and ten times the round-off of the body's position.
    """
    skip_if_slow(refused=level >= 1e7)
    small = 1e-4
    try:
        (pressed, _, touched, sheared), rounded = repress(level, small, accuracy=accuracy)
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
def test_small_load_after_a_large_one_with_every_method(method, condensation):
    (*_, sheared), _ = repress(1e3, 1e-4, method=method, condensation=condensation)
    assert np.abs(sheared - [-0.2e-4, 1e-4]).max() <= 1e-8 * 1e-4


@pytest.mark.parametrize("drop", [1e-3, 1e-8, 1e-12])
def test_load_reduced_in_one_increment(drop):
    """The load is not released in between; at the round-off of the increment it may be refused."""
    skip_if_slow(refused=drop == 1e-12)
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


# ---- bodies in one mesh --------------------------------------------------------------------------


def press_two_boxes(ratio, *, one_contact=False, joined=False, friction=0.5, **options):
    """Press two boxes on a floor by 10 and 10/ratio, shear by a fifth; return loads, forces, step.

    ``one_contact``: one Γc of both. ``joined``: unused.
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
    computed = []
    for low, high in ((-1, 1.5), (1.5, 4)):
        force = np.zeros(2)
        for contact in contacts:
            rows = point_values(contact, np.hstack([contact.points, contact.traction]))
            measure = point_values(contact, contact.measure[:, None])
            of_box = (rows[:, 0] > low) & (rows[:, 0] < high)
            force += measure[of_box, 0] @ rows[of_box, 2:]
        computed.append(force)
    return loads, computed, step


@pytest.mark.each
@pytest.mark.parametrize("one_contact", [False, True])
@pytest.mark.parametrize("method", [None, "lbfgs", "newton"])
@pytest.mark.parametrize("ratio", [1e3, 1e4, 1e8])
def test_lightly_loaded_body_next_to_a_heavily_loaded_one(ratio, method, one_contact):
    """The contact force on every body is its own load, to 1e-8 of this load."""
    loads, computed, step = press_two_boxes(ratio, method=method, one_contact=one_contact)
    for load, force in zip(loads, computed, strict=True):
        assert np.abs(force - [-0.2 * load, load]).max() <= 1e-8 * load
    assert set(step.verdict.equations) >= {"body 1", "body 2"}
    assert set(step.verdict.sums) == {"body 1", "body 2"}
    assert not step.verdict.failures


def test_unbalanced_body_is_named():
    """A residual that is large relative to the body's own forces, not to others', fails."""
    *_, step = press_two_boxes(1e8)
    verdict = step.verdict
    light = verdict.equations["body 2"]  # bodies are numbered along x
    assert light.force < 1e-6
    unbalanced = fc.ForceBalance(1e-3 * light.force, light.force, light.tolerance)
    equations = verdict.equations | {"body 2": unbalanced}
    failures = fc.Verdict(equations, verdict.sums, verdict.laws).failures
    assert len(failures) == 1 and "body 2" in failures[0]


@pytest.mark.parametrize("condensation", [None, False])
def test_tolerance_of_a_soft_body_next_to_a_stiff_one(condensation):
    """The tolerance of a body is relative to its own forces, next to one 1e8 times as stiff.

    Both have Dirichlet conditions at their tops and are pressed on a floor by 1e-3 of their height.
    The tolerance is 1e-9 of the forces; the round-off of the stiff body exceeds this fraction of
    the forces on the soft one.
    """
    lines = np.linspace(0, 1, 4)
    sides = {
        FLOOR: lambda x, c: (np.abs(x[:, 1]) < 1e-9) & (c[:, 0] < 1.5),
        FLOOR_2: lambda x, c: (np.abs(x[:, 1]) < 1e-9) & (c[:, 0] > 1.5),
        ROOF: lambda x, c: np.abs(x[:, 1] - 1) < 1e-9,
    }
    mesh_and_tags = boxes([[lines, lines], [lines + 2, lines]], sides)
    E = ufl.conditional(ufl.lt(ufl.SpatialCoordinate(mesh_and_tags[0])[0], 1.5), 1e8, 1.0)
    body = Bodies(mesh_and_tags, E, 0.3)
    body.prescribe(ROOF, 0)
    body.prescribe(ROOF, 1, value=-1e-3)
    floor = fc.HalfSpace((0, 0), (0, 1))
    contacts = [
        body.contact(tag, floor, fc.Coulomb(0.3), name=f"floor {tag}") for tag in (FLOOR, FLOOR_2)
    ]
    step = body.problem(*contacts, condensation=condensation).solve()
    soft = step.verdict.equations["body 2"]  # bodies are numbered along x
    assert 1e-4 < soft.force < 1e-2
    assert soft.tolerance == pytest.approx(1e-9 * soft.force, rel=1e-6)


# ---- numbers that are not finite -----------------------------------------------------------------


@pytest.mark.each
@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("place", ["residual", "force", "tolerance"])
def test_residuals_that_are_not_finite_fail(place, value):
    """Even an infinite residual below an infinite tolerance fails."""
    numbers = {"residual": np.inf if value == np.inf else 0.0, "force": 1.0, "tolerance": np.inf}
    numbers[place] = value
    unbalanced = fc.ForceBalance(**numbers)
    sound = fc.ForceBalance(0.0, 1.0, 1e-9)
    assert fc.Verdict({"the body": unbalanced}, {"the body": sound}).failures
    assert fc.Verdict({"the body": sound}, {"the body": unbalanced}).failures
    assert not fc.Verdict({"the body": sound}, {"the body": sound}).failures


@pytest.mark.parametrize("E", [1e100, 1e200, 1e300])
def test_huge_modulus_is_solved_or_refused(E):
    """The contact force is the load, to 1e-8, or the increment is refused."""
    scene = block("quadrilateral", E=E, up=-1.0)
    problem, contact = scene.problem(fc.Frictionless(), scene.rollers())
    try:
        problem.solve()
    except (fc.NotConverged, ValueError):
        return
    assert abs(contact.resultants().force[1] - 1.0) <= 1e-8
