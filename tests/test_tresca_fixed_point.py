"""Tresca fixed-point method: the solution of the direct methods, and very stiff contact."""

from itertools import pairwise

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from scenes.block_on_ball import BlockOnBall, loaded_block, supporting_ball
from scenes.blocks import GRID, TOP, block, rough_field
from scenes.comparison import is_close, nodal_values, owned_values, point_values

pytestmark = pytest.mark.two_ranks

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize(("cell", "degree"), GRID)
def test_solution_equals_that_of_newton(cell, degree):
    """Both methods satisfy the law to the solver's tolerance of 1e-9: solutions agree to 1e-6."""
    law = fc.Coulomb(0.3, k_n=2e4, k_t=1e4)
    states = []
    for method in ("alternating", "newton"):
        scene, problem, contact = loaded_block(cell, law, method, degree=degree, n=3, side=0.06)
        step = problem.solve()
        assert step.method == method
        r = step.contacts["contact"]
        assert r.slip > 0 and not step.verdict.failures
        states.append((nodal_values(scene.u), r.force))
        assert contact.history.values("slip").max(initial=0.0) == 0.0  # not committed
    for a, b in zip(*states, strict=True):
        assert is_close(a, b, 1e-6)


@pytest.mark.whole
@pytest.mark.parametrize(
    "law",
    [
        fc.Frictionless(k_n=2e4),
        fc.Tresca(0.3, 10.0, k_n=2e4, k_t=1e4),
        fc.Coulomb(0.3, k_n=2e4, k_t=1e4, modes=6),
        fc.Coulomb(0.4, k_n=2e4, k_t=1e4, transverse_friction=0.2, direction=(1, 1, 0)),
        fc.Foundation(1e4, 1e3),
    ],
    ids=["frictionless", "tresca", "polygon", "ellipse", "foundation"],
)
def test_every_law_has_the_solution_of_newton(law):
    """Forces agree to 1e-6 for laws with a potential (one minimum problem) and with friction."""
    forces = []
    for method in ("alternating", "newton"):
        _, problem, _ = loaded_block("hexahedron", law, method)
        forces.append(problem.solve().contacts["contact"].force)
    assert is_close(*forces, 1e-6)


def test_load_cycle_has_the_same_history():
    """After a load cycle both methods have the same history, to 1e-5."""
    ends = []
    for method in ("alternating", "lbfgs"):
        law = fc.Coulomb(0.3, k_n=2e4, k_t=1e4)
        setup = BlockOnBall(law, amplitude=0.05, method=method)
        list(fc.increments(setup.problem, setup.load, 0.0, 4.0, steps=8))
        ends.append(point_values(setup.contact, setup.contact.history.rows()))
    assert is_close(*ends, 1e-5)


def test_block_constrained_by_friction_only():
    """Without friction the block has a rigid-body mode; forces are those of Newton, to 1e-6."""
    forces = []
    for method in ("alternating", "newton"):
        scene = block("triangle", 1, n=4, up=-1.0, side=0.15)
        problem, _ = scene.problem(fc.Coulomb(0.3, k_n=1e5, k_t=1e5), [], method=method)
        forces.append(problem.solve().contacts["contact"].force)
    assert is_close(*forces, 1e-6)


def test_force_driven_obstacle_has_the_motion_of_newton():
    """An obstacle pressed by a force, and then dragged by another, has the same motion, to 1e-6."""
    motions = []
    for method in ("alternating", "newton"):
        scene = block("quadrilateral", 1, n=4)
        slide = fem.Constant(scene.mesh, 0.0)
        obstacle = supporting_ball(2, fc.Motion(force=(slide, 5.0)))
        bcs = [scene.dirichlet_bc(TOP, i) for i in range(2)]
        law = fc.Coulomb(0.3, k_n=2e4, k_t=1e4)
        problem, contact = scene.problem(law, bcs, contact={"obstacle": obstacle}, method=method)
        for slide.value in (0.0, 0.4):
            problem.solve()
            problem.commit()
        motions.append([float(c.value) for c in contact.free_motion.values()])
    assert is_close(*motions, 1e-6)


@pytest.mark.parametrize("supported", [False, True])
@pytest.mark.parametrize("condensation", [False, None])
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_residual_is_the_gradient_of_the_energy(cell, condensation, supported):
    """At a fixed friction bound the residual is the central difference of the energy, to 1e-6.

    The equations are those of all dofs, or after static condensation by default, without and with
    springs against an overload.
    """
    law = fc.Coulomb(0.3, k_n=2e4, k_t=1e4)
    scene, problem, contact = loaded_block(
        cell, law, "newton", side=0.03, condensation=condensation
    )
    problem.solve()
    problem.commit()
    support = None
    if supported:
        support = np.broadcast_to(3e3 * np.eye(scene.dim), (len(contact.points), *2 * [scene.dim]))
    contact.effective_law.fix_friction_bound(contact.values.friction_bound, support)
    space = problem.solver.system
    equations = problem.solver.equations
    x = equations.solution.copy()
    f, y, z = x.duplicate(), x.duplicate(), x.duplicate()
    direction = fem.Function(scene.u.function_space)
    direction.interpolate(rough_field(scene.dim, 3))
    y.array[:] = np.where(space.constrained, 0.0, space.restrict(owned_values(direction)))
    x.axpy(0.02, y)  # away from the solution, where slopes are not zero
    equations.residual(x, f)
    slope, step = f.dot(y), 1e-5
    energies = []
    for sign in (1, -1):
        x.copy(z)
        z.axpy(sign * step, y)
        energies.append(equations.energy(z))
    assert slope != 0.0
    assert is_close((energies[0] - energies[1]) / (2 * step), slope, 1e-6)
    contact.effective_law.release_friction_bound()


@pytest.mark.parametrize(("factor", "friction"), [(1e6, 0.0), (1e8, 0.0), (1e4, 0.3)])
def test_stiff_contact_is_solved_in_one_increment(factor, friction):
    """Contact with k_n h/E up to 1e8, or 1e4 with friction, is solved in one increment.

    From 1e4 the solution is that of rigid contact: its force agrees with that of 1e3, whose error
    is of the order of 1e-3, to 1e-2.
    """
    peaks = []
    for scaled in (fc.RelativeStiffness(1e3), fc.RelativeStiffness(factor)):
        law = fc.Coulomb(friction, scaled, scaled) if friction else fc.Frictionless(scaled)
        _, problem, _ = loaded_block("quadrilateral", law, "alternating", n=8, side=0.0)
        step = problem.solve()
        r = step.contacts["contact"]
        peaks.append(r.normal_force)
    assert is_close(peaks[1], peaks[0], 1e-2)
    assert r.max_penetration < 1e-1 / factor


@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_convergence_is_linear_with_a_rate_proportional_to_friction(cell, monkeypatch):
    """The fixed point of the friction bound converges linearly, at a rate proportional to μ.

    The same points stick and slip with all three coefficients. The changes of the bound fall by a
    constant factor, to 5 %, as minimum problems are solved to a hundredth of the residual of the
    law. Twice the coefficient has twice the factor, to 10 %, as the pressure differs slightly.
    """
    factors, zones = [], []
    for friction in (0.1, 0.2, 0.4):
        law = fc.Coulomb(friction, k_n=2e4, k_t=1e4)
        n = 6 if cell == "triangle" else 3
        _, problem, contact = loaded_block(cell, law, "alternating", n=n, side=0.0)
        fix, bounds = contact.effective_law.fix_friction_bound, []

        def note(bound, support, fix=fix, bounds=bounds):
            assert support is None
            bounds.append(bound.copy())
            fix(bound, support)

        monkeypatch.setattr(contact.effective_law, "fix_friction_bound", note)
        r = problem.solve().contacts["contact"]
        zones.append((r.stick, r.slip))
        bounds.append(contact.values.friction_bound.copy())
        squares = [contact.measure @ np.diff(pair, axis=0)[0] ** 2 for pair in pairwise(bounds)]
        changes = np.sqrt([COMM.allreduce(float(square)) for square in squares])
        falls = changes[1:] / changes[:-1]
        assert falls[-2] == pytest.approx(falls[-1], rel=0.05)
        factors.append(falls[-1])
    assert zones[0] == zones[1] == zones[2] and min(zones[0]) > 0
    assert factors[1] == pytest.approx(2 * factors[0], rel=0.1)
    assert factors[2] == pytest.approx(2 * factors[1], rel=0.1)


def test_iteration_limit_of_the_user_prevents_the_fallback():
    """With an iteration limit by the user no other method is tried."""
    law = fc.Coulomb(0.3, k_n=2e4, k_t=1e4)
    _, problem, _ = loaded_block("triangle", law, "newton", petsc_options={"snes_max_it": 1})
    with pytest.raises(fc.NotConverged) as caught:
        problem.solve()
    assert caught.value.reason == PETSc.SNES.ConvergedReason.DIVERGED_MAX_IT


def test_petsc_options_of_the_subproblem_solver():
    """The solver of the subproblems takes options with the prefix `alternating_`."""
    law = fc.Coulomb(0.3, k_n=2e4, k_t=1e4)
    options = {"alternating_snes_max_it": 7}
    _, problem, _ = loaded_block("triangle", law, "alternating", petsc_options=options)
    assert problem.solver.methods["alternating"].snes.getTolerances()[3] == 7


def test_nonlinear_bulk_has_the_solution_of_newton():
    """Without an energy the line search uses the residual; displacements agree to 1e-6."""
    ends = []
    for method in ("alternating", "newton"):
        scene = block("quadrilateral", 1, n=4)
        v = ufl.TestFunction(scene.u.function_space)
        scene.F += 1e4 * ufl.dot(scene.u, scene.u) * ufl.dot(scene.u, v) * ufl.dx
        bcs = [scene.dirichlet_bc(TOP, 0, 0.005), scene.dirichlet_bc(TOP, 1, -0.03)]
        law = fc.Coulomb(0.3, k_n=2e4, k_t=1e4)
        problem, _ = scene.problem(
            law, bcs, contact={"obstacle": supporting_ball(2)}, method=method
        )
        problem.solve()
        ends.append(nodal_values(scene.u))
    assert is_close(*ends, 1e-6)
