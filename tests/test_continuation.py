"""Tests of continuation in stiffness, stiff contact from a cold start, and lists of attempts."""

import logging

import pytest
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from scenes.block_on_ball import BlockOnBall, loaded_block
from scenes.blocks import TOP, block
from scenes.comparison import is_close, nodal_values

pytestmark = pytest.mark.two_ranks

COMM = MPI.COMM_WORLD
SERIAL = pytest.mark.skipif(COMM.size > 1, reason="the same on several ranks, and slow there")


@pytest.mark.parametrize(
    ("cell", "degree"), [("triangle", 2), ("quadrilateral", 1), ("hexahedron", 1)]
)
def test_continuation_agrees_with_newton(cell, degree):
    """If Newton's method converges, too, both have residuals of 1e-9 and states agree to 1e-6."""
    law = fc.Coulomb(0.3, k_n=2e4, k_t=1e4)
    states = []
    for method in ("continuation", "newton"):
        scene, problem, contact = loaded_block(cell, law, method, degree=degree, n=3, side=0.06)
        step = problem.solve()
        assert [attempt.method for attempt in step.attempts] == [method]
        assert contact.inputs.stiffness_factor.value == 1.0
        states.append(nodal_values(scene.u))
    assert is_close(*states, 1e-6)


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_start_at_a_solution_takes_no_iterations(cell):
    """Solving the same increment again takes no iterations and keeps the state, to 1e-9.

    Softened contact would move away from it, and not back if an obstacle had carried a body.
    """
    scene, problem, _ = loaded_block(cell, fc.Coulomb(0.3, k_n=2e4, k_t=1e4), "continuation", n=3)
    problem.solve()
    problem.commit()
    before = nodal_values(scene.u)
    assert problem.solve().iterations == 0
    assert is_close(nodal_values(scene.u), before, 1e-9)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize(("factor", "friction"), [(1e6, 0.0), (1e8, 0.0), (1e4, 0.3), (1e6, 0.3)])
def test_stiff_contact_from_a_cold_start(method, factor, friction):
    """One increment from zero has negligible penetration and the force of hard contact.

    Reference: the force at k_n h/E = 1e3, to 1e-3, the effect of its penetration of 1e-3 of a cell;
    to 2e-2 with friction, where points that slipped may stick.
    """
    forces = []
    for scaled in (fc.RelativeStiffness(1e3), fc.RelativeStiffness(factor)):
        law = fc.Coulomb(friction, scaled, scaled) if friction else fc.Frictionless(scaled)
        _, problem, _ = loaded_block("quadrilateral", law, method, n=8)
        step = problem.solve()
        forces.append(step.contacts["contact"].normal_force)
    assert is_close(forces[1], forces[0], 2e-2 if friction else 1e-3)
    assert step.contacts["contact"].max_penetration < 1e-1 / factor
    # Full Newton steps solve the frictionless problem, which is piecewise linear.
    fallbacks = [] if method == "newton" else ["continuation"]
    if friction:  # the primal-dual method is for friction; at 1e6 E/h it fails
        fallbacks = ["primal_dual"] if factor < 1e5 else ["primal_dual", "continuation"]
    assert [a.method for a in step.attempts] == [method, *fallbacks]
    assert [a.outcome == "converged" for a in step.attempts] == [False] * len(fallbacks) + [True]
    assert step.iterations == sum(attempt.iterations for attempt in step.attempts)


def test_failure_without_fallback_names_chattering_points(caplog):
    """Newton's method with full steps cycles, and the error names the points that change status.

    By the geometry they lie under the middle of the ball, where contact is.
    """
    stiff = fc.RelativeStiffness(1e4)
    law = fc.Coulomb(0.3, stiff, stiff)
    options = {"snes_linesearch_type": "basic"}
    _, problem, contact = loaded_block(
        "quadrilateral", law, "newton", n=8, fallback=False, petsc_options=options
    )
    with caplog.at_level(logging.INFO, "fenics_contact"), pytest.raises(fc.NotConverged) as caught:
        problem.solve()
    (attempt,) = caught.value.attempts
    # The maximum number of iterations: a cycle does not end by itself.
    assert attempt.method == "newton" and attempt.iterations == caught.value.iterations == 100
    for text in (attempt.outcome, str(caught.value)):
        assert "contact chatters" in text and "16 points keep changing between" in text
    x = float(attempt.outcome.split("at (")[1].split(",")[0])
    assert 0.25 < x < 0.75
    assert contact.inputs.stiffness_factor.value == 1.0


def test_every_failure_is_logged(caplog):
    """Every failed method is in the log and, in order, in the attempts of the step."""
    stiff = fc.RelativeStiffness(1e6)
    law = fc.Coulomb(0.3, stiff, stiff)
    _, problem, _ = loaded_block("quadrilateral", law, "newton", n=8)
    with caplog.at_level(logging.INFO, "fenics_contact"):
        step = problem.solve()
    texts = [record.getMessage() for record in caplog.records]
    (first, *_) = COMM.allgather(texts)  # rank 0 logs
    *failed, last = step.attempts
    assert [a.method for a in failed] == ["newton", "primal_dual"]
    assert (last.method, last.outcome) == ("continuation", "converged")
    for attempt in failed:
        assert any(str(attempt) in text for text in first)


def test_continuation_does_not_affect_the_history():
    """Softened problems leave nothing in the history of a load cycle with friction.

    Reference: L-BFGS, which solves the increments directly, to 1e-5: both solutions are within the
    solver's tolerance. Friction dissipates energy in every increment.
    """
    ends = []
    for method in ("continuation", "lbfgs"):
        law = fc.Coulomb(0.3, fc.RelativeStiffness(100), fc.RelativeStiffness(100))
        setup = BlockOnBall(law, mesh={"n": 8}, amplitude=0.05, method=method)
        steps = list(fc.increments(setup.problem, setup.load, 0.0, 4.0, steps=8))
        assert all(step.energy.dissipation >= 0 for step in steps)
        ends.append(nodal_values(setup.scene.u))
    assert is_close(*ends, 1e-5)


def test_cut_increments_list_all_attempts():
    """The attempts are all failures, all cuts and the success, in order."""
    scene = block("triangle", up=0.0)
    push = fem.Constant(scene.mesh, 0.0)
    bcs = [*scene.rollers(), scene.dirichlet_bc(TOP, 1, push)]
    problem, _ = scene.problem(fc.Frictionless(k_n=1e4), bcs, method="lbfgs", fallback=False)
    solve, fail = problem.solve, [True, True, False]

    def raise_error(**kwargs):
        problem.solver.main.max_it, max_it = (
            (0 if fail.pop(0) else problem.solver.main.max_it),
            problem.solver.main.max_it,
        )
        try:
            return solve(**kwargs)
        finally:
            problem.solver.main.max_it = max_it
            fail.append(False)

    problem.solve = raise_error
    first, *remaining = fc.increments(problem, push, 0.0, -0.01)
    names = [attempt.method for attempt in first.attempts]
    assert names == ["lbfgs", "cut", "lbfgs", "cut", "lbfgs"]
    assert [attempt.outcome for attempt in first.attempts[1::2]] == ["to 0.005", "to 0.0025"]
    assert first.load == -0.0025 and all(len(step.attempts) == 1 for step in remaining)


def test_finite_kinematics_with_friction_start_with_newton():
    """Finite kinematics with friction exclude the alternating method: Newton's method is used.

    On a flat floor small and finite kinematics are the same problem: the forces agree to 1e-7, with
    residuals of 1e-9.
    """
    forces, attempts = [], ()
    for kinematics in ("small", "finite"):
        scene = block("triangle", 1, n=6, E=100.0)
        bcs = [scene.dirichlet_bc(TOP, i, value) for i, value in enumerate((0.005, -0.01))]
        law, options = fc.Coulomb(0.3, k_n=1e3, k_t=1e3), {"kinematics": kinematics}
        step = scene.problem(law, bcs, contact=options)[0].solve()
        forces.append(step.contacts["contact"].force)
        attempts = step.attempts
    assert [a.method for a in attempts] == ["newton"]
    assert is_close(forces[1], forces[0], 1e-7)
