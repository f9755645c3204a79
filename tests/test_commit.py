"""What is committed is what was solved: no constant, no field and no second call changes it.

The reference is the same history with nothing in between, to the last digit on one rank; on several
MUMPS adds in the order in which messages come: 1e-10.
"""

import numpy as np
import pytest
from mpi4py import MPI

import fenics_contact as fc
from scenes.blocks import block
from scenes.comparing import at_points, close, nodal, raised_everywhere
from scenes.stacks import FLOOR, LOWER, ROOF, UPPER, stack

COMM = MPI.COMM_WORLD
EXACT = 0.0 if COMM.size == 1 else 1e-10

pytestmark = pytest.mark.three_ranks


def slid(between, *, enforcement="penalty", recover_interior=True):
    """A block pressed on a floor that is drawn along, three increments; forces and field."""
    scene = block("quadrilateral", n=4, up=-10.0)
    contact = {"displacement": np.zeros(2), "enforcement": enforcement}
    problem, contact = scene.problem(fc.Coulomb(0.3), scene.rollers(), contact=contact)
    motion = contact.parameters["displacement"]
    forces = []
    for way in (0.0, 1e-3, 2e-3):
        motion.value[:] = way, 0.0
        problem.solve(recover_interior=recover_interior)
        between(problem, contact)
        problem.commit()
        problem.complete()
        forces.append(contact.resultants().force)
    return np.array(forces), nodal(scene.u), at_points(contact, contact.history.rows())


def nothing(problem, contact):
    pass


def changed(problem, contact):
    """Parameters of law and obstacle, which the next solve is to see and this commit is not."""
    kept = {name: c.value.copy() for name, c in contact.parameters.items()}
    contact.parameters["friction"].value = 0.01
    contact.parameters["displacement"].value[:] = 0.5, 0.1
    contact.evaluate()
    problem.commit()
    for name, value in kept.items():
        contact.parameters[name].value = value


def moved(problem, contact):
    """The displacement itself, set by hand."""
    problem.u.x.array[:] += 1.0
    contact.states.forget()


def twice(problem, contact):
    problem.commit()


def failed(problem, contact):
    """An increment that is tried before the commit, and has no solution."""
    kept = contact.parameters["displacement"].value.copy()
    contact.parameters["displacement"].value[:] = np.nan
    with pytest.raises((fc.NotConverged, ValueError)):
        problem.solve()
    contact.parameters["displacement"].value[:] = kept


@pytest.mark.each
@pytest.mark.parametrize("recover_interior", [True, False])
@pytest.mark.parametrize("enforcement", ["penalty", "augmented"])
@pytest.mark.parametrize("between", [changed, moved, twice, failed])
def test_commit_keeps_what_solve_found(between, enforcement, recover_interior):
    options = {"enforcement": enforcement, "recover_interior": recover_interior}
    expected, found = slid(nothing, **options), slid(between, **options)
    for a, b in zip(found, expected, strict=True):
        assert close(a, b, EXACT)
    assert abs(expected[0][-1, 0]) > 0.1  # there is friction to go wrong


def test_a_second_commit_finds_no_other_pairs():
    """With pairs found anew at commits, a commit that has nothing to commit changes nothing."""
    body = stack("quadrilateral", (3, 4), (0.5, 0.5), widths=[1.5, 1.0])
    body.hold(FLOOR, 0, 1)
    slide = body.constant()
    body.hold(ROOF, 0, value=slide)
    body.F += 1e4 * body.v[1] * body.ds(ROOF)
    obstacle = fc.DeformableBody(body.tags, 10 + LOWER, update_pairs="increment")
    contact = body.contact(10 + UPPER, obstacle, fc.Coulomb(0.3))
    problem = body.problem(contact)
    for way in (0.0, 0.1):
        slide.value = way
        problem.solve()
        problem.commit()
    pairings, rows = contact.pairs.n_updates, contact.history.rows()
    before = contact.resultants()
    slide.value = 0.2
    problem.commit()
    assert (contact.pairs.n_updates, problem.increment) == (pairings, 2)
    assert close(contact.history.rows(), rows, 0.0)
    assert close(contact.resultants().force, before.force, 0.0)
    step = problem.solve()
    assert close(step.contacts["contact"].normal_force, 1e4, 1e-8)


def test_a_commit_before_any_solution_changes_nothing():
    scene = block("quadrilateral", up=-1.0)
    problem, contact = scene.problem(fc.Frictionless(), scene.rollers())
    before = contact.history.rows()
    problem.commit()
    assert problem.increment == 0
    assert close(contact.history.rows(), before, 0.0)


def pressed_and_drawn(late):
    """A block pressed by one problem, then drawn aside, by another that is made then or by it."""
    scene = block("quadrilateral", n=4, up=-5.0)
    contact = scene.contact(fc.Coulomb(0.3), displacement=np.zeros(2))
    bcs = scene.rollers()

    def made():
        return fc.ContactProblem(scene.F, scene.u, bcs=bcs, contacts=[contact])

    problem = made()
    for up in (-5.0, -10.0):
        scene.load(up=up)
        problem.solve()
        problem.commit()
    if late:
        problem = made()
    scene.load(up=-8.0)
    contact.parameters["displacement"].value[:] = 1e-3, 0.0
    step = problem.solve()
    problem.commit()
    return step, nodal(scene.u)


def test_another_problem_goes_on_with_a_history():
    """Forces, field and energies are those of the one problem: what it starts from is loaded.

    To 1e-9, the solver's, which starts from elsewhere.
    """
    (one, u), (two, same) = pressed_and_drawn(late=False), pressed_and_drawn(late=True)
    assert close(same, u, 1e-9)
    scale = abs(one.energy.work)
    for name in ("work", "elastic", "springs", "dissipation", "remainder"):
        assert abs(getattr(two.energy, name) - getattr(one.energy, name)) < 1e-9 * scale, name


def test_a_history_that_another_problem_has_led_on_is_refused():
    """Its energies and starts would be of a state that is gone. The refusal changes nothing."""
    scene = block("quadrilateral", n=4, up=-5.0)
    contact = scene.contact(fc.Coulomb(0.3))
    first, second = (
        fc.ContactProblem(scene.F, scene.u, bcs=scene.rollers(), contacts=[contact])
        for _ in range(2)
    )
    first.solve()
    first.commit()
    rows = contact.history.rows()
    raised_everywhere(second.solve, ValueError, "another problem", "new ContactProblem")
    assert close(contact.history.rows(), rows, 0.0)
    first.solve()
    first.commit()


@pytest.mark.parametrize("enforcement", ["penalty", "augmented"])
def test_results_after_a_restore_are_those_of_the_commit(enforcement):
    """Points that slipped in the committed increment do so still, whatever was tried since."""
    scene = block("quadrilateral", n=4, up=-10.0)
    contact = {"displacement": np.zeros(2), "enforcement": enforcement}
    problem, contact = scene.problem(fc.Coulomb(0.3), scene.rollers(), contact=contact)
    contact.parameters["displacement"].value[:] = 5e-3, 0.0
    problem.solve()
    problem.commit()
    before, status = contact.resultants(), contact.status.copy()
    assert before.slip > 0
    scene.load(up=-11.0)
    problem.solve()
    problem.restore()
    assert np.array_equal(contact.status, status)
    assert contact.resultants().slip == before.slip
    scene.load(up=np.nan)
    raised_everywhere(problem.solve, ValueError, "finite")
    assert np.array_equal(contact.status, status)
