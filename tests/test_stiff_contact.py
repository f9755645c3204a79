"""Stiff contact with friction: Newton's method, and the primal-dual method where it fails.

References are solutions by minimum problems (method "alternating"), which have other matrices, line
search and friction bounds, and by continuation. All satisfy the law to 1e-9 of the forces; at
1e4 E/h the displacements of Γc are known to about a hundred times that: states agree to 1e-6.
"""

import dataclasses

import pytest
from mpi4py import MPI

import fenics_contact as fc
from scenes import problems, two_blocks
from scenes.block_on_ball import BlockOnBall, loaded_block, supporting_ball
from scenes.blocks import TOP, block, kirchhoff
from scenes.comparison import have_similar_iterations, is_close, nodal_values

pytestmark = pytest.mark.two_ranks

SERIAL = pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="the same on several ranks")


def coulomb(k, friction=0.3, **others):
    return fc.Coulomb(friction, fc.RelativeStiffness(k), fc.RelativeStiffness(k), **others)


@pytest.mark.parametrize("k", [1.0, 100.0, 1e4])
@pytest.mark.parametrize(
    ("cell", "degree"), [("triangle", 1), ("quadrilateral", 2), ("tetrahedron", 1)]
)
def test_solution_agrees_with_minimum_problems_at_any_stiffness(cell, degree, k):
    """At any stiffness Newton's method finds the solution of the minimum problems, to 1e-6."""
    states = []
    for method in ("newton", "alternating"):
        scene, problem, _ = loaded_block(cell, coulomb(k), method, degree=degree, n=3, side=0.06)
        assert (problem.solve().method == "alternating") == (method == "alternating")
        states.append(nodal_values(scene.u))
    assert is_close(*states, 1e-6)


@pytest.mark.each
@pytest.mark.parametrize(
    "law",
    [
        coulomb(300.0, modes=6),
        coulomb(300.0, transverse_friction=0.1, direction=(1.0, 1.0, 0.0)),
        fc.Tresca(0.3, 30.0, fc.RelativeStiffness(300.0), fc.RelativeStiffness(300.0)),
        fc.Coulomb(0.3, fc.RelativeStiffness(1000.0), fc.RelativeStiffness(30.0)),
    ],
    ids=["polygon", "ellipse", "Tresca", "soft along Γc"],
)
def test_other_laws_agree_with_minimum_problems(law):
    """Other friction surfaces and k_n ≠ k_t have the solution of the minimum problems, to 1e-6."""
    states = []
    for method in ("newton", "alternating"):
        scene, problem, _ = loaded_block("hexahedron", law, method, n=3, side=0.06)
        assert (problem.solve().method == "alternating") == (method == "alternating")
        states.append(nodal_values(scene.u))
    assert is_close(*states, 1e-6)


@pytest.mark.parametrize("condensation", [True, False])
def test_load_reversals_agree_with_continuation(condensation):
    """A history with load reversals agrees with that of continuation, to 1e-6."""
    ends = []
    for method in ("newton", "continuation"):
        setup = BlockOnBall(
            coulomb(1e3), mesh={"n": 8}, amplitude=0.05, method=method, condensation=condensation
        )
        steps = list(fc.increments(setup.problem, setup.load, 0.0, 4.0, steps=8, max_cuts=0))
        assert all(step.energy.dissipation >= 0 for step in steps)
        assert method in [step.method for step in steps]
        ends.append(nodal_values(setup.scene.u))
    assert is_close(*ends, 1e-6)


@SERIAL
def test_multigrid_in_space():
    """With multigrid L-BFGS, Newton and continuation agree on the force of a ball, to 1e-8."""
    ends = []
    for options in ({}, {"method": "newton"}, {"method": "continuation"}):
        body = dataclasses.replace(problems.ball_on_block(8), friction=0.3)
        problem, contact, _, load = problems.problem(
            body, 1, 1e3, condensation=False, linear_solver="multigrid", **options
        )
        load.value = body.final_load
        step = problem.solve()
        ends.append((step.method, contact.resultants().normal_force))
    assert [method for method, _ in ends] == ["lbfgs", "newton", "continuation"]
    assert is_close(ends[0][1], ends[1][1], 1e-8) and is_close(ends[2][1], ends[1][1], 1e-8)


@SERIAL
@pytest.mark.parametrize("k", [2e3, 2e4])
def test_multigrid_in_the_plane(k):
    """With multigrid Newton's method agrees with continuation, to 1e-6."""
    ends = []
    for method in ("newton", "continuation"):
        setup = BlockOnBall(
            coulomb(k),
            mesh={"n": 16},
            condensation=False,
            linear_solver="multigrid",
            method=method,
        )
        for side in (0.0, 0.005, 0.03, -0.03):
            setup.set_top_displacement(side, 0.01)
            step = setup.problem.solve()
            setup.problem.commit()
        assert step.method == method
        ends.append(nodal_values(setup.scene.u))
    assert is_close(*ends, 1e-6)


def test_sliding_between_two_bodies():
    """A block is pressed on another and dragged, with updates of pairs, until all points slip.

    Reference: forces by minimum problems, to 1e-7; both residuals are below 1e-9 of them.
    """
    forces = []
    for method in ("newton", "alternating"):
        slider = two_blocks.SlidingBlock("triangle", coulomb(300.0), start=1.0, method=method)
        steps = [slider.step(0.01, along) for along in (0.0, 0.002, 0.1)]
        assert all(step.method == method for step in steps)
        computed = [step.contacts["contact"] for step in steps]
        forces.append([value for r in computed for value in (r.normal_force, r.tangential_force)])
        assert computed[-1].stick == 0
    assert is_close(*forces, 1e-7)


def test_multipliers_with_stiff_springs():
    """Augmentations with springs of 300 E/h give the forces of those with 10 E/h, to 1e-4.

    The penalty part is 1e-7 of the tractions for both, but points slip differently during the
    augmentations, which changes friction by up to 1e-4.
    """
    computed = []
    for k in (10.0, 300.0):
        augmented = {"enforcement": "augmented", "tolerance": 1e-7}
        setup = BlockOnBall(coulomb(k), contact=augmented, method="newton")
        setup.set_top_displacement(0.06, 0.03)
        computed.append(setup.problem.solve().contacts["contact"])
    assert is_close(computed[0].normal_force, computed[1].normal_force, 1e-4)
    assert is_close(computed[0].tangential_force, computed[1].tangential_force, 1e-4)


def test_iterations_are_independent_of_units():
    """The iterations of all attempts are the same in N-mm and in SI units."""
    attempts_by_unit = []
    for length, pressure in ((1.0, 1.0), (1e-3, 1e6)):
        setup = BlockOnBall(
            coulomb(1e3), mesh={"n": 8}, length=length, pressure=pressure, method="newton"
        )
        setup.set_top_displacement(0.01 * length, 0.03 * length)
        attempts_by_unit.append(setup.problem.solve().attempts)
    assert have_similar_iterations(
        *([attempt.iterations for attempt in attempts] for attempts in attempts_by_unit)
    )


@pytest.mark.parametrize(
    ("cell", "k"), [("triangle", 1e3), ("triangle", 1e5), ("triangle", 1e9), ("tetrahedron", 1e3)]
)
def test_primal_dual_method_from_zero_initial_guess(cell, k):
    """The primal-dual method converges without fallback, in the plane at any stiffness.

    Reference: the force by minimum problems at 1e3 E/h, to 2e-2. The penetration there, a
    thousandth of a cell, changes the force by as much, and by up to 2e-2 if slip points stick.
    """
    forces = []
    for stiffness, method in ((1e3, "alternating"), (k, "primal_dual")):
        _, problem, _ = loaded_block(
            cell, coulomb(stiffness), method, n=3, side=0.06, fallback=False
        )
        step = problem.solve()
        assert [attempt.method for attempt in step.attempts] == [method]
        forces.append(step.contacts["contact"].normal_force)
    assert is_close(forces[1], forces[0], 2e-2)
    assert step.iterations <= 10  # measured: 3 at every stiffness in the plane, 8 in space


@pytest.mark.parametrize(
    "case", ["no friction", "an obstacle that is moved by a force", "a nonlinear bulk"]
)
def test_primal_dual_method_refuses_unsupported_problems(case):
    """Problems that the primal-dual method cannot solve are refused when they are created."""
    scene = block("triangle", n=2)
    law, obstacle, form = coulomb(10.0), supporting_ball(2), scene.F
    if case == "no friction":
        law = fc.Frictionless()
    elif case == "a nonlinear bulk":
        form = kirchhoff(scene)
    else:
        obstacle = fc.HalfSpace((0, 0), (0, 1), displacement=fc.Motion(force=(None, 1.0)))
    contact = scene.contact(law, obstacle=obstacle)
    bcs = [scene.dirichlet_bc(TOP, i) for i in range(2)]
    with pytest.raises(ValueError, match="method is 'primal_dual', which needs friction with"):
        fc.ContactProblem(form, scene.u, bcs=bcs, contacts=[contact], method="primal_dual")
