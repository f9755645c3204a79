"""Histories whose interior is recovered at the end, at some increments, or on request."""

import numpy as np
import pytest
from mpi4py import MPI

import fenics_contact as fc
from scenes.block_on_ball import (
    STATE_TOLERANCE,
    BlockOnBall,
    fail_increments_above,
    have_equal_states,
)
from scenes.blocks import BOTTOM, TOP
from scenes.comparison import assert_raised_on_all_ranks, is_close, owned_values, shared_folder
from scenes.unrelated_bodies import Box, SceneWithUnrelatedBodies

pytestmark = pytest.mark.three_ranks

COMM = MPI.COMM_WORLD


def run_history(field, tmp_path=None, *, law=None, steps=8, **kwargs):
    """Run the history with ``recover_interior=field``."""
    setup = BlockOnBall(law, cell="hexahedron", condensation=True)
    options = {"steps": steps, "recover_interior": field} | kwargs
    return setup, list(fc.increments(setup.problem, setup.load, 0.0, 4.0, **options))


@pytest.mark.parametrize("law", [fc.Frictionless(k_n=2e4), fc.Coulomb(0.3, k_n=2e4, k_t=1e4)])
def test_interior_recovered_at_the_last_increment(law):
    """Forces, energies and the final field are those with the interior of all increments.

    Both are solved to 1e-9 of the forces, and errors of eight increments add up: 1e-7, relative to
    work plus elastic energy for energies. The top moves, so that prescribed values do work.
    """
    eager, all_steps = run_history("every", law=law)
    last, steps = run_history("last", law=law)
    assert [s.complete for s in all_steps] == [True] * 8
    assert [s.complete for s in steps] == [False] * 7 + [True]
    assert have_equal_states(last, eager, 1e-7)
    for a, b in zip(steps, all_steps, strict=True):
        assert is_close(a.contacts["contact"].force, b.contacts["contact"].force, 1e-7)
        size = abs(b.energy.work) + abs(b.energy.elastic)
        for name in ("work", "elastic", "springs", "dissipation", "remainder"):
            assert is_close(getattr(a.energy, name), getattr(b.energy, name), 1e-7, scale=size), (
                name
            )
        assert abs(a.energy.imbalance) <= 1e-6 * size
        assert a.verdict.failures == [] and a.verdict.laws.keys() == {"contact"}


def test_complete_recovers_the_interior_on_request():
    """`complete` sets u to that of a history with all interiors (1e-7); a second call does nothing.

    The status of the contact in the increment is unchanged: points that slipped do not stick.
    """
    eager, lazy = (
        BlockOnBall(cell="triangle", condensation=True),
        BlockOnBall(cell="triangle", condensation=True),
    )
    compared = 0
    for step in fc.increments(eager.problem, eager.load, 0.0, 4.0, steps=8):
        problem = lazy.problem
        lazy.load(step.load)
        assert not problem.solve(recover_interior=False).complete
        problem.commit()
        status = lazy.contact.status.copy()
        assert np.array_equal(status, eager.contact.status)
        behind = owned_values(lazy.scene.u).copy()
        if step.increment % 3 == 0:
            verdict = problem.complete()
            assert verdict.failures == [] and problem.complete() is None
            assert not is_close(behind, owned_values(eager.scene.u), 1e-3)
            assert is_close(owned_values(lazy.scene.u), owned_values(eager.scene.u), 1e-7)
            assert np.array_equal(lazy.contact.status, status)
            compared += 1
    assert compared == 2


def run_history_with_stiffening(field: str) -> tuple[BlockOnBall, list[fc.Step]]:
    """Run a history in which the stiffness of bulk and contact changes with the load."""
    setup = BlockOnBall(cell="triangle", condensation=True)

    def load(t: float) -> None:
        setup.load(t)
        setup.scene.E.value = 1000.0 * (1 + 0.2 * t)
        setup.contact.parameters["k_n"].value = 2e4 * (1 + 0.2 * t)

    return setup, list(
        fc.increments(setup.problem, load, 0.0, 2.0, steps=4, recover_interior=field)
    )


def test_pending_interior_uses_the_data_of_its_increment():
    """A pending interior is recovered with bulk and law of its increment: forces and u, 1e-7."""
    (eager, all_found), (lazy, lagging) = (
        run_history_with_stiffening("every"),
        run_history_with_stiffening("last"),
    )
    assert not any(attempt.method == "cut" for s in lagging for attempt in s.attempts)
    assert not lagging[0].complete
    for a, b in zip(all_found, lagging, strict=True):
        one, other = a.contacts["contact"].force, b.contacts["contact"].force
        assert is_close(one, other, 1e-7)
        assert np.isclose(a.energy.elastic, b.energy.elastic, rtol=1e-6)
    assert is_close(owned_values(lazy.scene.u), owned_values(eager.scene.u), 1e-7)


@pytest.mark.parametrize("last", [True, False], ids=["recovered", "pending"])
def test_uncommitted_solution_is_discarded_after_bulk_changes(last):
    """The committed interior is pending, a solution was not committed, and then the bulk changes.

    Reference: the same increments with all interiors recovered, 1e-7.
    """
    states = []
    for first, second in ((True, True), (False, last)):
        setup = BlockOnBall(cell="triangle", condensation=True)
        setup.load(1.0)
        setup.problem.solve(recover_interior=first)
        setup.problem.commit()
        setup.load(1.5)
        setup.problem.solve(recover_interior=second)
        setup.scene.E.value *= 1.5
        setup.load(2.0)
        step = setup.problem.solve(recover_interior=first)
        setup.problem.commit()
        setup.problem.complete()
        states.append([setup, step.energy])
    (eager, one), (lazy, other) = states
    assert is_close(owned_values(lazy.scene.u), owned_values(eager.scene.u), 1e-7)
    assert np.isclose(one.work, other.work, rtol=1e-6)
    assert np.isclose(one.elastic, other.elastic, rtol=1e-6)


def test_interior_recovered_every_third_increment():
    """With ``recover_interior=3`` every third increment and the last one are complete."""
    _, steps = run_history(3)
    assert [s.complete for s in steps] == [False, False, True, False, False, True, False, True]


def test_checkpoint_with_a_pending_interior(tmp_path):
    """A history restarted from a checkpoint has the states of an uninterrupted one."""
    folder = shared_folder(tmp_path)
    uninterrupted, _ = run_history("last", checkpoint=folder / "whole.npz", checkpoint_every=3)
    setup = BlockOnBall(cell="hexahedron", condensation=True)
    options = {"steps": 8, "recover_interior": "last", "checkpoint": folder / "part.npz"}
    options["checkpoint_every"] = 3
    for step in fc.increments(setup.problem, setup.load, 0.0, 4.0, **options):
        if step.increment == 5:
            break
    after = BlockOnBall(cell="hexahedron", condensation=True)
    remaining = list(fc.increments(after.problem, after.load, 0.0, 4.0, **options))
    assert remaining[0].increment == 4
    assert have_equal_states(after, uninterrupted, STATE_TOLERANCE)


def test_failed_increment_recovers_the_committed_interior():
    """When an increment fails, the interior of u is recovered for the last commit, 1e-7."""
    eager, lazy = (
        BlockOnBall(cell="triangle", condensation=True),
        BlockOnBall(cell="triangle", condensation=True),
    )
    fail_increments_above(lazy, 0.6)
    for setup in (eager, lazy):
        options = {
            "steps": [0.5, 4.0] if setup is lazy else [0.5],
            "max_cuts": 0,
            "recover_interior": "last",
        }
        history = fc.increments(setup.problem, setup.load, 0.0, options["steps"][-1], **options)
        if setup is eager:
            list(history)
        else:
            next(history)
            assert not is_close(owned_values(lazy.scene.u), owned_values(eager.scene.u), 1e-3)
            with pytest.raises(fc.NotConverged):
                next(history)
    assert is_close(owned_values(lazy.scene.u), owned_values(eager.scene.u), 1e-7)


def test_failed_solve_keeps_the_uncommitted_solution():
    """A failed solve keeps an uncommitted solution; its interior can be recovered, 1e-7."""
    eager, lazy = (
        BlockOnBall(cell="triangle", condensation=True),
        BlockOnBall(cell="triangle", condensation=True),
    )
    for setup in (eager, lazy):
        for t in (0.5, 1.5):
            setup.load(t)
            setup.problem.solve(recover_interior=setup is eager)
            if t == 0.5:
                setup.problem.commit()
    pressure = lazy.contact.pressure.copy()
    lazy.push[-1].value = np.nan
    with pytest.raises(ValueError, match="finite"):
        lazy.problem.solve(recover_interior=False)
    assert np.array_equal(lazy.contact.pressure, pressure)
    lazy.load(1.5)
    lazy.problem.complete()
    assert is_close(owned_values(lazy.scene.u), owned_values(eager.scene.u), 1e-7)


def test_wrong_recovered_interior_is_refused(monkeypatch):
    """A recovered interior is verified by the product with K, not by its own factors."""
    setup = BlockOnBall(cell="triangle", condensation=True)
    setup.load(1.0)
    setup.problem.solve(recover_interior=False)
    setup.problem.commit()
    field = setup.problem.solver.system.pending_field
    field[field != 0.0] *= 1.001
    with pytest.raises(fc.NotConverged, match="residual"):
        setup.problem.complete()


def test_wrong_recover_interior_is_refused():
    """An unknown value of ``recover_interior`` raises an error."""
    setup = BlockOnBall()
    for field in ("never", 0, 1.5):
        call = lambda field=field: list(  # noqa: E731
            fc.increments(setup.problem, setup.load, recover_interior=field)
        )
        assert_raised_on_all_ranks(call, ValueError, "every")


def test_body_without_contact_balances_with_a_pending_interior():
    """A body without retained dofs, whose forces on these are 0 of 0, balances before and after."""
    scene = SceneWithUnrelatedBodies({"block": Box(), "other": Box((3.0, 0.0))})
    scene.prescribe("block", TOP, 0, 1, value=-1e-3)
    scene.prescribe("other", BOTTOM, 0, 1)
    scene.load("other", TOP, 0, scene.bodies.constant(1e-3))
    floor = fc.HalfSpace((0.0, 0.0), (0.0, 1.0))
    contact = scene.contact("block", BOTTOM, floor, fc.Frictionless(), name="floor")
    problem = scene.problem(contact, condensation=True)
    step = problem.solve(recover_interior=False)
    assert not step.complete and step.verdict.failures == []
    completed = problem.complete()
    assert completed is not None and completed.failures == []
