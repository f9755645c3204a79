"""Finite kinematics where they meet histories, files, cuts, free obstacles and error budgets."""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.fem import petsc
from petsc4py import PETSc

import fenics_contact as fc
from fenics_contact import checkpoint
from scenes.comparing import close, raised_everywhere, shared_folder
from scenes.histories import goes_on
from scenes.rubber import Tool, rubber

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(300)]

HOW = {
    "penalty": {},
    "augmented": {"contact": {"enforcement": "augmented"}},
    "by force": {"force": True},
    "linear": {"linear": True, "solver": {"small_displacement_tolerance": np.inf}},
    "frictionless": {"law": fc.Frictionless(1e4)},
    "profile": {"shape": "profile"},
    "facets": {"shape": "facets", "force": True},
}


@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_going_on_from_a_file(cell, how, tmp_path):
    """Broken off while the tool turns, and taken up: the same digits on one rank, 1e-7 on more."""
    options = {"n": (8, 4)} if cell == "triangle" else {}
    goes_on(lambda: Tool(cell, **options, **HOW[how]), shared_folder(tmp_path), stop=5)


def test_a_file_of_another_kinematics_or_angle_is_refused(tmp_path):
    """What was small cannot go on as finite; nor with the tool at another angle."""
    path = shared_folder(tmp_path) / "state.npz"
    law = fc.Frictionless(1e4)
    tool = Tool(n=(4, 2), law=law)
    tool.go(0.0, -0.05, 0.3)
    checkpoint.save(tool.problem, path)
    other = Tool(n=(4, 2), law=law)
    other.shift.value[:], other.angle.value = tool.shift.value, 0.3
    checkpoint.load(other.problem, path)
    other = Tool(n=(4, 2), law=law)
    other.shift.value[:] = tool.shift.value
    raised_everywhere(lambda: checkpoint.load(other.problem, path), ValueError, "turn")
    scene = rubber(n=(4, 2))
    problem, _ = scene.problem(
        fc.Ball((0, 1.8), 0.8, displacement=(0, -0.05)), law, contact={"kinematics": "small"}
    )
    raised_everywhere(lambda: checkpoint.load(problem, path), ValueError, "kinematics")


@pytest.mark.parametrize("shape", ["ball", "profile"])
def test_first_touch_from_afar_in_increments_that_are_cut(shape):
    """A disc half a block away comes down by 0.7 in one increment: cut until it is followed.

    The end is that of 20 equal increments: without friction there is one answer. 1e-7.
    """
    ends = []
    for steps in (1, 20):
        tool = Tool(n=(16, 8), law=fc.Frictionless(1e4), shape=shape)

        def load(t, tool=tool):
            tool.shift.value[:] = tool.vector(0.1, 0.5 - 0.7 * t)

        *_, _ = fc.increments(tool.problem, load, 0.0, 1.0, steps=steps)
        ends.append(tool.tractions())
    assert np.abs(ends[1]).max() > 100.0
    assert close(ends[0], ends[1], 1e-7)


def test_an_obstacle_that_a_force_presses_bears_it():
    """N is the force, whatever the tool's angle, and the body follows the tool: 1e-8."""
    for cell in ("triangle", "tetrahedron"):
        tool = Tool(cell, force=True, **({"n": (8, 4)} if cell == "triangle" else {}))
        for step in tool.increments(2.0):
            r = step.contacts["contact"]
            assert r.force[-1] == pytest.approx(tool.down.value, rel=1e-8)
        assert abs(r.force[0]) > 1.0


def test_nothing_is_left_out_by_finite_kinematics():
    """The error budget's line "kinematics" is 0, to round-off, and so is the verdict's."""
    tool = Tool(n=(8, 4))
    for step in tool.increments(2.0):
        assert all(k.worst == 0.0 for k in step.verdict.small_displacement_error.values())
    body = tool.scene.body
    budget = fc.estimate_errors(tool.problem, body.nominal, strain=body.gradient(tool.scene.u))
    assert all(abs(value) < 1e-12 for value in budget.parts["kinematics"].values())


def test_the_budget_of_small_displacements_predicts_the_difference():
    """What the verdict says that small displacements leave out is the difference of the two: 30 %.

    A linear elastic block pressed into by a disc; both with the same springs.
    """
    found = {}
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
        found[kinematics] = contact.resultants().force
        if kinematics == "small":
            told = step.verdict.small_displacement_error["contact"].force
    difference = np.linalg.norm(found["finite"] - found["small"])
    share = difference / np.linalg.norm(found["small"])
    assert share > 0.01
    assert told == pytest.approx(share, rel=0.3)


@pytest.mark.parametrize("shape", ["ball", "profile"])
def test_the_form_in_a_problem_of_ones_own(shape):
    """`Contact.form` and `tangent` in a Newton iteration written with DOLFINx alone: same u, 1e-9.

    A hyperelastic body with friction, two increments; what is solved is F + contact.form(v). A
    obstacle from data is sampled by `Contact.evaluate` wherever u has changed.
    """
    own, reference = (Tool("triangle", n=(8, 4), shape=shape) for _ in range(2))
    scene, contact = own.scene, own.contact
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
        own.shift.value[:] = side, up
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
        reference.go(side, up)
    assert np.abs(reference.resultant()[0]) > 0.1
    assert close(own.tractions(), reference.tractions(), 1e-9)
