"""`commit` stores the solution of `solve`; changes of constants, fields and calls have no effect.

The reference is the same history with no change in between. It is equal in all digits on one rank,
and to 1e-10 on several, where the order of summation in MUMPS is that of the messages.
"""

import numpy as np
import pytest
from mpi4py import MPI

import fenics_contact as fc
from scenes.blocks import block
from scenes.comparison import (
    assert_raised_on_all_ranks,
    is_close,
    nodal_values,
    point_values,
    shared_folder,
)
from scenes.stacks import FLOOR, LOWER, ROOF, UPPER, stack

COMM = MPI.COMM_WORLD
EXACT = 0.0 if COMM.size == 1 else 1e-10

pytestmark = pytest.mark.three_ranks


def drag_block(between, *, enforcement="penalty", recover_interior=True):
    """Return forces, u and history of a block on a floor dragged in three increments."""
    scene = block("quadrilateral", n=4, up=-10.0)
    contact = {"displacement": np.zeros(2), "enforcement": enforcement}
    problem, contact = scene.problem(fc.Coulomb(0.3), scene.rollers(), contact=contact)
    motion = contact.parameters["displacement"]
    forces = []
    for displacement in (0.0, 1e-3, 2e-3):
        motion.value[:] = displacement, 0.0
        problem.solve(recover_interior=recover_interior)
        between(problem, contact)
        problem.commit()
        problem.complete()
        forces.append(contact.resultants().force)
    return np.array(forces), nodal_values(scene.u), point_values(contact, contact.history.rows())


def do_nothing(problem, contact):
    pass


def change_parameters(problem, contact):
    """Change parameters of law and obstacle, which must not affect this commit."""
    saved = {name: c.value.copy() for name, c in contact.parameters.items()}
    contact.parameters["friction"].value = 0.01
    contact.parameters["displacement"].value[:] = 0.5, 0.1
    contact.evaluate()
    problem.commit()
    for name, value in saved.items():
        contact.parameters[name].value = value


def overwrite_displacement(problem, contact):
    """Overwrite the displacement."""
    problem.u.x.array[:] += 1.0
    contact.states.forget()


def commit_twice(problem, contact):
    problem.commit()


def fail_increment(problem, contact):
    """Solve an increment without a solution before the commit."""
    saved = contact.parameters["displacement"].value.copy()
    contact.parameters["displacement"].value[:] = np.nan
    with pytest.raises((fc.NotConverged, ValueError)):
        problem.solve()
    contact.parameters["displacement"].value[:] = saved


@pytest.mark.each
@pytest.mark.parametrize("recover_interior", [True, False])
@pytest.mark.parametrize("enforcement", ["penalty", "augmented"])
@pytest.mark.parametrize(
    "between", [change_parameters, overwrite_displacement, commit_twice, fail_increment]
)
def test_commit_stores_the_solution_of_solve(between, enforcement, recover_interior):
    options = {"enforcement": enforcement, "recover_interior": recover_interior}
    expected, computed = drag_block(do_nothing, **options), drag_block(between, **options)
    for a, b in zip(computed, expected, strict=True):
        assert is_close(a, b, EXACT)
    assert abs(expected[0][-1, 0]) > 0.1  # friction acts


def test_second_commit_does_not_update_the_pairs():
    """With pairs updated at commits, a commit without a new solution changes nothing."""
    body = stack("quadrilateral", (3, 4), (0.5, 0.5), widths=[1.5, 1.0])
    body.prescribe(FLOOR, 0, 1)
    slide = body.constant()
    body.prescribe(ROOF, 0, value=slide)
    body.F += 1e4 * body.v[1] * body.ds(ROOF)
    obstacle = fc.DeformableBody(body.tags, 10 + LOWER, update_pairs="increment")
    contact = body.contact(10 + UPPER, obstacle, fc.Coulomb(0.3))
    problem = body.problem(contact)
    for displacement in (0.0, 0.1):
        slide.value = displacement
        problem.solve()
        problem.commit()
    pairings, rows = contact.pairs.n_updates, contact.history.rows()
    before = contact.resultants()
    slide.value = 0.2
    problem.commit()
    assert (contact.pairs.n_updates, problem.increment) == (pairings, 2)
    assert is_close(contact.history.rows(), rows, 0.0)
    assert is_close(contact.resultants().force, before.force, 0.0)
    step = problem.solve()
    assert is_close(step.contacts["contact"].normal_force, 1e4, 1e-8)


def test_commit_before_any_solution_changes_nothing():
    scene = block("quadrilateral", up=-1.0)
    problem, contact = scene.problem(fc.Frictionless(), scene.rollers())
    before = contact.history.rows()
    problem.commit()
    assert problem.increment == 0
    assert is_close(contact.history.rows(), before, 0.0)


def press_and_drag(new_problem):
    """Return step and u of a block pressed by one problem, then dragged by it or by a new one."""
    scene = block("quadrilateral", n=4, up=-5.0)
    contact = scene.contact(fc.Coulomb(0.3), displacement=np.zeros(2))
    bcs = scene.rollers()

    def make():
        return fc.ContactProblem(scene.F, scene.u, bcs=bcs, contacts=[contact])

    problem = make()
    for up in (-5.0, -10.0):
        scene.load(up=up)
        problem.solve()
        problem.commit()
    if new_problem:
        problem = make()
    scene.load(up=-8.0)
    contact.parameters["displacement"].value[:] = 1e-3, 0.0
    step = problem.solve()
    problem.commit()
    return step, nodal_values(scene.u)


def test_new_problem_continues_a_history():
    """A problem that starts from a loaded state has u and energies of the previous one, to 1e-9.

    This is the solver's tolerance: the initial guess differs.
    """
    (one, u), (two, same) = press_and_drag(new_problem=False), press_and_drag(new_problem=True)
    assert is_close(same, u, 1e-9)
    scale = abs(one.energy.work)
    for name in ("work", "elastic", "springs", "dissipation", "remainder"):
        assert abs(getattr(two.energy, name) - getattr(one.energy, name)) < 1e-9 * scale, name


def test_history_continued_by_another_problem_is_refused(tmp_path):
    """Energies and predictors of the problem would be outdated. The error changes no state.

    A checkpoint would have the displacement of one problem and the tractions of the other.
    """
    scene = block("quadrilateral", n=4, up=-5.0)
    contact = scene.contact(fc.Coulomb(0.3))
    first, second = (
        fc.ContactProblem(scene.F, scene.u, bcs=scene.rollers(), contacts=[contact])
        for _ in range(2)
    )
    first.solve()
    first.commit()
    rows = contact.history.rows()
    words = ("another problem", "new ContactProblem")
    assert_raised_on_all_ranks(second.solve, ValueError, *words)
    second.restore()
    path = shared_folder(tmp_path) / "state.npz"
    assert_raised_on_all_ranks(lambda: fc.checkpoint.save(second, path), ValueError, *words)
    assert not path.exists()
    first.restore()
    assert is_close(contact.history.rows(), rows, 0.0)
    first.solve()
    first.commit()


@pytest.mark.parametrize("enforcement", ["penalty", "augmented"])
def test_results_after_a_restore_are_those_of_the_commit(enforcement):
    """The status of points is that of the committed increment, also after later solves."""
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
    assert_raised_on_all_ranks(problem.solve, ValueError, "finite")
    assert np.array_equal(contact.status, status)
