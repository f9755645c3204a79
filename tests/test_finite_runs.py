"""Finite kinematics in histories, checkpoints, cuts, free obstacles and error budgets."""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.fem import petsc
from petsc4py import PETSc

import fenics_contact as fc
from fenics_contact import checkpoint
from scenes.comparison import assert_raised_on_all_ranks, is_close, shared_folder
from scenes.histories import assert_restart_equals_uninterrupted
from scenes.rubber import DiscOnRubber, rubber

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(300)]

VARIANTS = {
    "penalty": {},
    "augmented": {"contact": {"enforcement": "augmented"}},
    "by force": {"by_force": True},
    "linear": {"linear": True, "solver": {"small_displacement_tolerance": np.inf}},
    "frictionless": {"law": fc.Frictionless(1e4)},
    "profile": {"shape": "profile"},
    "facets": {"shape": "facets", "by_force": True},
}


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_restart(cell, variant, tmp_path):
    """A history restarted while the tool rotates has the same digits on one rank, 1e-7 on more."""
    options = {"n": (8, 4)} if cell == "triangle" else {}
    assert_restart_equals_uninterrupted(
        lambda: DiscOnRubber(cell, **options, **VARIANTS[variant]), shared_folder(tmp_path), stop=5
    )


def test_checkpoint_of_other_kinematics_or_angle_is_refused(tmp_path):
    """A restart with small displacements, or with another angle of the tool, is refused."""
    path = shared_folder(tmp_path) / "state.npz"
    law = fc.Frictionless(1e4)
    tool = DiscOnRubber(n=(4, 2), law=law)
    tool.solve_increment(0.0, -0.05, 0.3)
    checkpoint.save(tool.problem, path)
    other = DiscOnRubber(n=(4, 2), law=law)
    other.shift.value[:], other.angle.value = tool.shift.value, 0.3
    checkpoint.load(other.problem, path)
    other = DiscOnRubber(n=(4, 2), law=law)
    other.shift.value[:] = tool.shift.value
    assert_raised_on_all_ranks(lambda: checkpoint.load(other.problem, path), ValueError, "turn")
    scene = rubber(n=(4, 2))
    problem, _ = scene.problem(
        fc.Ball((0, 1.8), 0.8, displacement=(0, -0.05)), law, contact={"kinematics": "small"}
    )
    assert_raised_on_all_ranks(lambda: checkpoint.load(problem, path), ValueError, "kinematics")


@pytest.mark.parametrize("shape", ["ball", "profile"])
def test_first_touch_across_a_large_gap_with_cut_increments(shape):
    """A disc half a block away comes down by 0.7 in one increment, cut until it converges.

    Reference: the end of 20 equal increments, to 1e-7; without friction the solution is unique.
    """
    ends = []
    for steps in (1, 20):
        tool = DiscOnRubber(n=(16, 8), law=fc.Frictionless(1e4), shape=shape)

        def load(t, tool=tool):
            tool.shift.value[:] = tool.vector(0.1, 0.5 - 0.7 * t)

        *_, _ = fc.increments(tool.problem, load, 0.0, 1.0, steps=steps)
        ends.append(tool.tractions())
    assert np.abs(ends[1]).max() > 100.0
    assert is_close(ends[0], ends[1], 1e-7)


def test_free_obstacle_is_in_equilibrium_with_its_force():
    """N is the force on the tool at any angle, to 1e-8, and the body follows the tool."""
    for cell in ("triangle", "tetrahedron"):
        tool = DiscOnRubber(cell, by_force=True, **({"n": (8, 4)} if cell == "triangle" else {}))
        for step in tool.increments(2.0):
            r = step.contacts["contact"]
            assert r.force[-1] == pytest.approx(tool.down.value, rel=1e-8)
        assert abs(r.force[0]) > 1.0


def test_finite_kinematics_have_no_small_displacement_error():
    """The error budget's part "kinematics" is 0, to round-off, and so is the verdict's error."""
    tool = DiscOnRubber(n=(8, 4))
    for step in tool.increments(2.0):
        assert all(k.worst == 0.0 for k in step.verdict.small_displacement_error.values())
    body = tool.scene.body
    budget = fc.estimate_errors(tool.problem, body.nominal, strain=body.gradient(tool.scene.u))
    assert all(abs(value) < 1e-12 for value in budget.parts["kinematics"].values())


def test_small_displacement_error_is_that_to_finite_kinematics():
    """The verdict's small-displacement error is the difference to finite kinematics: to 30 %.

    A disc is pressed into a linear elastic block, with the same penalty in both cases.
    """
    computed = {}
    for kinematics in ("small", "finite"):
        scene = rubber("triangle", n=(16, 8), linear=True)
        shift = fem.Constant(scene.mesh, np.zeros(2))
        problem, contact = scene.problem(
            fc.Ball((0, 1.8), 0.8, displacement=shift),
            fc.Coulomb(0.3, 1e4, 1e4),
            contact={"kinematics": kinematics},
            small_displacement_tolerance=np.inf,
        )
        shift.value[:] = 0.0, -0.05
        for shift.value[0] in (0.0, 0.02, 0.04):
            step = problem.solve()
            problem.commit()
        computed[kinematics] = contact.resultants().force
        if kinematics == "small":
            estimate = step.verdict.small_displacement_error["contact"].force
    difference = np.linalg.norm(computed["finite"] - computed["small"])
    relative_error = difference / np.linalg.norm(computed["small"])
    assert relative_error > 0.01
    assert estimate == pytest.approx(relative_error, rel=0.3)


@pytest.mark.parametrize("shape", ["ball", "profile"])
def test_form_in_a_user_defined_problem(shape):
    """`Contact.form` and `tangent` in a Newton iteration of DOLFINx alone give the same u, to 1e-9.

    The body is hyperelastic, with friction, in two increments; the residual is F + contact.form(v).
    An obstacle from data is sampled by `Contact.evaluate` whenever u has changed.
    """
    user_problem, reference = (DiscOnRubber("triangle", n=(8, 4), shape=shape) for _ in range(2))
    scene, contact = user_problem.scene, user_problem.contact
    space = scene.u.function_space
    v, du = ufl.TestFunction(space), ufl.TrialFunction(space)
    residual = scene.F + contact.form(v)
    tangent = ufl.derivative(scene.F, scene.u, du) + contact.tangent(v, du)
    maps = contact.entity_maps
    residual, tangent = (fem.form(f, entity_maps=maps) for f in (residual, tangent))
    solver = PETSc.KSP().create(scene.mesh.comm)
    solver.setType("preonly")
    solver.getPC().setType("lu")
    solver.getPC().setFactorSolverType("mumps")
    for side, up in ((0.0, -0.03), (0.02, -0.04)):
        user_problem.shift.value[:] = side, up
        for _ in range(30):
            if shape == "profile":
                contact.evaluate()
            A = petsc.assemble_matrix(tangent, bcs=scene.bcs)
            A.assemble()
            b = petsc.assemble_vector(residual)
            b.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
            petsc.set_bc(b, scene.bcs, scene.u.x.petsc_vec, -1.0)
            solver.setOperators(A)
            step = A.createVecLeft()
            solver.solve(b, step)
            scene.u.x.petsc_vec.axpy(-1.0, step)
            scene.u.x.scatter_forward()
            if step.norm() < 1e-13:
                break
        contact.commit()
        reference.solve_increment(side, up)
    assert np.abs(reference.resultant()[0]) > 0.1
    assert is_close(user_problem.tractions(), reference.tractions(), 1e-9)
