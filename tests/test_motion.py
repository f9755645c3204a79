"""Free obstacles: the force on them is given, their translation is unknown."""

import dolfinx
import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from scenes.block_on_ball import supporting_ball
from scenes.blocks import BOTTOM, LEFT, TOP, block
from scenes.comparison import assert_raised_on_all_ranks, gather, is_close, nodal_values

pytestmark = [pytest.mark.three_ranks, pytest.mark.newest]

COMM = MPI.COMM_WORLD


def pressed_block(cell, law, motion, method="lbfgs"):
    scene = block(cell, 1, n=4)
    d = scene.dim
    bcs = [scene.dirichlet_bc(TOP, i) for i in range(d)]
    obstacle = supporting_ball(d, motion)
    problem, contact = scene.problem(law, bcs, contact={"obstacle": obstacle}, method=method)
    return scene, problem, contact


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_given_force_and_given_displacement_have_the_same_state(cell, method):
    """Press by a force, drag by a displacement; then prescribe the resulting motion.

    The contact force is the given one to 1e-8 (the solver's tolerance is 1e-9), the states agree to
    1e-7.
    """
    d = 2 if cell == "triangle" else 3
    law = fc.Coulomb(0.3, k_n=2e4, k_t=1e4)
    force, slide = 5.0, 0.01
    across = [None] * (d - 1) + [force]
    motion = fc.Motion(force=across, displacement=[slide] + [0.0] * (d - 2) + [None])
    scene, problem, contact = pressed_block(cell, law, motion, method)
    problem.solve()
    problem.commit()
    assert is_close(contact.resultants().force[-1], force, 1e-8)
    assert contact.resultants().slip > 0
    up = float(contact.free_motion[d - 1].value)
    assert up > 0

    prescribed_displacement = np.zeros(d)
    prescribed_displacement[0], prescribed_displacement[-1] = slide, up
    other, problem, same_contact = pressed_block(cell, law, prescribed_displacement, method)
    problem.solve()
    assert is_close(same_contact.resultants().force, contact.resultants().force, 1e-7)
    assert is_close(nodal_values(other.u), nodal_values(scene.u), 1e-7)


def test_newton_converges_quadratically_with_a_rotating_normal():
    """The tangent includes the derivative of a ball's normal with respect to its motion."""
    motion = fc.Motion(force=(0.5, 5.0))
    _, problem, contact = pressed_block(
        "quadrilateral", fc.Coulomb(1.0, k_n=2e4, k_t=1e4), motion, "newton"
    )
    problem.solve()
    problem.commit()
    contact.applied_force[0] = 0.6
    step = problem.solve()
    # Measured: 1 iteration, and 3 without the derivative of the normal.
    assert step.iterations <= 2
    assert is_close(contact.resultants().force, [0.6, 5.0], 1e-8)


def test_tangential_force_below_and_above_the_friction_limit():
    """A vertical force, then a tangential one: above the friction limit the solve fails."""
    scene = block("quadrilateral", 1, n=4)
    pull = fem.Constant(scene.mesh, 0.0)
    motion = fc.Motion(force=(pull, 5.0))
    bcs = [scene.dirichlet_bc(TOP, i) for i in range(2)]
    problem, contact = scene.problem(
        fc.Coulomb(0.3, k_n=2e4, k_t=1e4), bcs, contact={"obstacle": supporting_ball(2, motion)}
    )
    problem.solve()
    problem.commit()
    pull.value = 1.0
    problem.solve()
    problem.commit()
    assert is_close(contact.resultants().force, [1.0, 5.0], 1e-8)
    before = problem.full.state()
    pull.value = 3.0
    assert_raised_on_all_ranks(problem.solve, (ValueError, fc.NotConverged))
    assert np.array_equal(problem.full.state(), before)


def test_block_between_floor_and_loaded_obstacle():
    """A free body on a floor, pressed by a free obstacle with force P: p = P everywhere, 1e-8."""
    scene = block("triangle", 1, n=3, nu=0.0)
    floor = scene.contact(fc.Frictionless(k_n=1e4), name="floor")
    lid = fc.ContactSurface(scene.mesh, scene.tags, TOP)
    weight = fc.HalfSpace((0, 1), (0, -1), displacement=fc.Motion(force=(None, -7.0)))
    top = fc.Contact(scene.u, lid, weight, fc.Frictionless(k_n=1e4), name="weight")
    problem = fc.ContactProblem(
        scene.F, scene.u, bcs=[scene.dirichlet_bc(LEFT, 0)], contacts=[floor, top]
    )
    problem.solve()
    pressure = gather(COMM, floor.pressure)
    assert is_close(pressure, np.full(len(pressure), 7.0), 1e-8)
    # Both springs and the block in series: 7 (1/k_n + 1/E + 1/k_n).
    assert is_close(top.free_motion[1].value, -7.0 * (2 / 1e4 + 1 / 1000), 1e-8)


def test_distant_loaded_obstacle_reaches_the_body():
    """A distant obstacle is moved to first touch by its force; force and motion to 1e-8."""
    scene = block("quadrilateral", 1, n=4, nu=0.0)
    away = fc.HalfSpace((0, -30.0), (0, 1), displacement=fc.Motion(force=(None, 4.0)))
    bcs = [scene.dirichlet_bc(TOP, i) for i in range(2)]
    problem, contact = scene.problem(fc.Frictionless(k_n=1e4), bcs, contact={"obstacle": away})
    problem.solve()
    assert is_close(contact.resultants().force[1], 4.0, 1e-8)
    assert is_close(contact.free_motion[1].value, 30.0 + 4.0 * (1 / 1e4 + 1 / 1000), 1e-8)


@pytest.mark.parametrize(
    ("motion", "word"),
    [
        (fc.Motion(force=(1.0,)), "2 of each"),
        (fc.Motion(force=(1.0, 1.0), displacement=(0.0, None)), "one of them"),
        (fc.Motion(force=(1.0, 0.0, 0.0)), "2 of each"),
    ],
)
def test_wrong_motions_are_refused(motion, word):
    """Components with both force and displacement, or a wrong number of them, raise an error."""
    scene = block("triangle", 1)
    assert_raised_on_all_ranks(
        lambda: scene.contact(fc.Frictionless(), displacement=motion), ValueError, word
    )


@pytest.mark.parametrize("turned", [False, True])
def test_free_motion_of_two_contacts_is_refused(turned):
    """Each contact has its own unknowns: the load on an obstacle of two contacts would act twice.

    In one contact with both surfaces it acts once, to 1e-8 (the solver's tolerance is 1e-9).
    """
    scene = block("triangle", 1)
    motion = fc.Motion(force=(None, -5.0))
    rotation = fc.Rotation(None, (0.5, 1.0), moment=0.0) if turned else None
    kinematics = {"kinematics": "finite" if turned else "small"}

    def tool(displacement):
        return fc.HalfSpace((0, 1), (0, -1), displacement=displacement, rotation=rotation)

    halves = dolfinx.mesh.locate_entities_boundary(scene.mesh, 1, lambda x: np.isclose(x[1], 1))
    left = dolfinx.mesh.compute_midpoints(scene.mesh, 1, halves)[:, 0] < 0.5
    tags = dolfinx.mesh.meshtags(scene.mesh, 1, halves, np.where(left, 1, 2).astype(np.int32))
    bcs = [scene.dirichlet_bc(BOTTOM, i) for i in range(2)]

    def problem(surfaces):
        contacts = [
            fc.Contact(
                scene.u,
                fc.ContactSurface(scene.mesh, tags, tag),
                tool(None if turned and len(surfaces) > 1 else motion),
                fc.Coulomb(0.2, k_n=1e4, k_t=1e4),
                name=f"on {tag}",
                **kinematics,
            )
            for tag in surfaces
        ]
        return fc.ContactProblem(scene.F, scene.u, bcs=bcs, contacts=contacts)

    assert_raised_on_all_ranks(lambda: problem([1, 2]), ValueError, "on 1 and on 2", "act twice")
    step = problem([[1, 2]]).solve()
    assert is_close(step.contacts["on [1, 2]"].force[1], -5.0, 1e-8)


def test_boundary_form_refuses_an_unknown_motion():
    """The boundary form without a problem has no unknowns for the obstacle's motion: an error."""
    scene = block("triangle", 1)
    contact = scene.contact(fc.Frictionless(k_n=1.0), displacement=fc.Motion(force=(None, 1.0)))
    assert_raised_on_all_ranks(
        lambda: contact.form(ufl.TestFunction(scene.u.function_space)), ValueError, "ContactProblem"
    )
