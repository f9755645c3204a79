"""ContactProblem: equilibrium, failures, factorisations, methods, units, ranks, messages."""

import gc
import logging
import weakref
from dataclasses import replace

import dolfinx
import dolfinx.fem.petsc
import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from scenes.block_on_ball import PATH, BlockOnBall, copy_state, solve_path
from scenes.blocks import BOTTOM, GRID, LEFT, TOP, block, layer_partitioner
from scenes.comparison import (
    are_identical,
    compile_with_maps,
    gather,
    have_similar_iterations,
    is_close,
    is_interpolant,
    nodal_values,
    owned_values,
    point_values,
)
from scenes.stacks import FLOOR, ROOF, joint, stack

pytestmark = [
    pytest.mark.newest,
    pytest.mark.two_ranks,
    pytest.mark.timeout(240),
]
COMM = MPI.COMM_WORLD

# Solver tolerances for comparisons finer than the default of 1e-9 of the forces.
TIGHT = {"snes_rtol": 1e-13}


# ---- equilibrium and patch tests -----------------------------------------------------------------


@pytest.mark.parametrize(("cell", "degree"), GRID)
def test_patch(cell, degree):
    """Uniform compression on a shuffled mesh gives uniform stress and the penetration p/k_n.

    Reference: Hooke's law in plane strain or space, u_n = p/k_n exactly (references, 6). Tolerance
    1e-10 of the fields: round-off; the solver's tolerance is 1e-13 of the forces.
    """
    p, k_n = 2.0, 5e3
    scene = block(cell, degree, up=-p, shuffled=True)
    E, nu = 1000.0, 0.3
    problem, contact = scene.problem(fc.Frictionless(k_n=k_n), scene.rollers(), petsc_options=TIGHT)
    step = problem.solve()
    if scene.dim == 2:
        down, side = p * (1 - nu**2) / E, p * nu * (1 + nu) / E
    else:
        down, side = p / E, p * nu / E

    def exact(x):
        return np.vstack([side * x[i] for i in range(scene.dim - 1)] + [-down * x[scene.dim - 1]])

    up = np.zeros((scene.dim, 1))
    up[-1] = p / k_n
    assert is_interpolant(scene.u, lambda x: exact(x) - up, 1e-10)
    pressure = gather(COMM, contact.pressure)
    assert is_close(pressure, np.full(len(pressure), p), 1e-10)
    resultants = step.contacts["contact"]
    assert is_close(resultants.force, -scene.vector(up=-p), 1e-10)
    assert resultants.area == pytest.approx(1.0, rel=1e-12)
    assert resultants.open == resultants.stick == 0
    assert not step.verdict.failures


@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
@pytest.mark.parametrize("condensation", [None, False])
def test_block_far_above_its_floor_is_positioned(cell, condensation):
    """An unconstrained block above its floor is positioned and solved as if without a gap.

    Slip is measured from the rest position, so that positioning must add no tangential motion and
    no tilt. Reference: the tangential force without a gap, to 1e-6: residuals are 1e-9 of the
    forces and more, by round-off of the displacement. At most 21 iterations were needed, up to 293
    or no solution with positioning along the load.
    """
    computed = []
    for gap in (0.0, 0.05, 0.5):
        scene = block(cell, 1, side=0.05, up=-1.0, n=4 if cell == "triangle" else 2)
        obstacle = fc.HalfSpace(scene.vector(up=-gap), scene.vector(up=1.0))
        contact = scene.contact(fc.Coulomb(friction=0.3), obstacle=obstacle)
        problem = fc.ContactProblem(scene.F, scene.u, contacts=[contact], condensation=condensation)
        step = problem.solve()
        assert step.iterations <= 25
        computed.append(contact.resultants().tangential_force)
    assert is_close(computed[1], computed[0], 1e-6) and is_close(computed[2], computed[0], 1e-6)


@pytest.mark.parametrize("gaps", [(0.0, 0.05), (1e-4, 1e-5), (0.1, 0.05)])
def test_stack_of_unconstrained_blocks_is_positioned(gaps):
    """Two unconstrained blocks are positioned on each other so that no loaded point is open.

    Reference: the tangential forces without gaps, to 1e-6. 2 iterations were needed, up to 301
    where round-off decided which points are closed.
    """
    computed = []
    for low, high in ((0.0, 0.0), gaps):
        body = stack("triangle", (3, 4), (1.0, 1.0), gap=high)
        body.F -= ufl.dot(body.constant((0.05, -1.0)), body.v) * body.ds(ROOF)
        law = fc.Coulomb(friction=0.3)
        floor_contact = body.contact(
            FLOOR, fc.HalfSpace((0.0, -low), (0.0, 1.0)), law, name="floor"
        )
        contacts = [floor_contact, joint(body, 1, law)]
        step = fc.ContactProblem(body.F, body.u, contacts=contacts).solve()
        assert step.iterations <= 10
        computed.append([contact.resultants().tangential_force for contact in contacts])
    assert is_close(computed[1], computed[0], 1e-6)


@pytest.mark.parametrize("tilt", [-0.1, 0.003])
def test_block_above_tilted_floor_is_positioned(tilt):
    """A block above a tilted floor is positioned on its whole bottom, by a rotation with some slip.

    Reference: the load (0.02, -1), to 1e-8; the solver's tolerance is 1e-9. 63 and 52 iterations
    were needed; positioned on an edge, the tilt of -0.1 had no solution, the other took 275.
    """
    scene = block("triangle", 1, side=0.02, up=-1.0, n=4)
    normal = np.array([-np.sin(tilt), np.cos(tilt)])
    floor = fc.HalfSpace(np.array([float(tilt > 0), 0.0]) - 0.1 * normal, normal)
    problem, contact = scene.problem(fc.Coulomb(friction=0.2), [], contact={"obstacle": floor})
    step = problem.solve()
    assert step.iterations <= 100
    assert is_close(contact.resultants().force, [-0.02, 1.0], 1e-8)


def test_block_is_positioned_in_corner_of_floor_and_wall():
    """A block in front of a floor and a wall with friction is moved into their corner by its load.

    12 iterations were needed (27 with other releases); 157 if the block was rotated into the
    corner, the only motion without slip. Reference: both contact forces balance the load
    (-0.6, -1), to 1e-8; the solver's tolerance is 1e-9.
    """
    scene = block("triangle", 1, side=-0.6, up=-1.0, n=4)
    law, gap = fc.Coulomb(friction=0.2), 0.01
    contacts = [
        fc.Contact(
            scene.u,
            fc.ContactSurface(scene.mesh, scene.tags, tag),
            fc.HalfSpace(-gap * np.array(normal), normal),
            law,
            name=name,
        )
        for name, tag, normal in (("floor", BOTTOM, (0.0, 1.0)), ("wall", LEFT, (1.0, 0.0)))
    ]
    step = fc.ContactProblem(scene.F, scene.u, contacts=contacts).solve()
    assert step.iterations <= 60
    forces = [contact.resultants().force for contact in contacts]
    assert is_close(sum(forces), [0.6, 1.0], 1e-8)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_forces_balance_on_the_whole_path(method):
    """The contact force is minus the reaction of the top, and inside of the friction cone.

    Open, stick and slip points all occur. Reference: the bulk residual, summed over the dofs of
    the top. Tolerance 1e-7 of the force, as the solver's 1e-9 bounds the norm, not the sum.
    """
    setup = BlockOnBall(method=method)
    space = setup.scene.u.function_space
    bulk = compile_with_maps(setup.scene.F)
    n_by_status = np.zeros(3, dtype=int)
    for side, down in PATH:
        setup.set_top_displacement(side, down)
        step = setup.problem.solve()
        r = step.contacts["contact"]
        reaction = fem.Function(space)
        fem.assemble_vector(reaction.x.array, bulk)
        reaction.x.scatter_reverse(dolfinx.la.InsertMode.add)
        dofs = setup.scene.facet_dofs(TOP)
        n_owned = space.dofmap.index_map.size_local
        values = reaction.x.array.reshape(-1, 2)[dofs[dofs < n_owned]]
        total = COMM.allreduce(values.sum(axis=0))
        assert is_close(r.force, -total, 1e-7)
        assert r.tangential_force <= 0.3 * r.normal_force * (1 + 1e-10)
        n_by_status += [r.open, r.stick, r.slip]
        setup.problem.commit()
        assert setup.problem.increment == step.increment
    assert np.all(n_by_status > 0)


# ---- failure leaves no trace ---------------------------------------------------------------------


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_failed_increment_leaves_no_trace(method):
    """An increment stopped after one iteration raises, and u and history are bitwise unchanged.

    Afterwards the failed problem is solved without iterations under the loads of the last commit,
    and another problem with the same u and contact solves the increment as one that never failed,
    to 1e-12: the computation is the same except for sums over ranks.
    """
    setup, reference = BlockOnBall(method=method), BlockOnBall(method=method)
    scene, contact = setup.scene, setup.contact
    bcs = [scene.dirichlet_bc(TOP, i, c) for i, c in enumerate(setup.push)]
    for m in (setup, reference):
        solve_path(m, path=PATH[:2])
    limited = fc.ContactProblem(
        scene.F,
        scene.u,
        bcs=bcs,
        contacts=[contact],
        method=method,
        petsc_options={"snes_max_it": 1},
        prefix="limited_",
    )
    before = copy_state(setup)
    setup.set_top_displacement(*PATH[2])
    for _ in range(2):  # the second time with a solver that has failed
        with pytest.raises(fc.NotConverged) as caught:
            limited.solve()
        error = caught.value
        assert error.increment == 1
        assert error.reason == PETSc.SNES.ConvergedReason.DIVERGED_MAX_IT
        assert error.iterations == 1
        assert "increment 1" in str(error) and "1 iterations" in str(error)
        assert error.verdict.failures
        assert are_identical(copy_state(setup), before)
        assert limited.increment == 0
    setup.set_top_displacement(*PATH[1])
    assert limited.solve().iterations == 0
    scene.u.x.array[:] = before[0]
    for m in (setup, reference):
        solve_path(m, path=PATH[2:])
    assert is_close(nodal_values(scene.u), nodal_values(reference.scene.u), 1e-12)
    rows = (point_values(m.contact, m.contact.history.rows()) for m in (setup, reference))
    assert is_close(*rows, 1e-12)


def test_increments_restores_the_load():
    """A failing `increments` restores load, u and history of the last committed increment."""
    setup = BlockOnBall(method="newton")
    steps = fc.increments(setup.problem, setup.push[1], 0.0, -0.03, steps=3)
    done = []
    before = copy_state(setup)
    with pytest.raises(fc.NotConverged):
        for step in steps:
            done.append(step.load)
            before = copy_state(setup)
            if len(done) == 2:
                setup.push[0].value = 0.02
                setup.problem.snes.setTolerances(max_it=1)
    assert done == pytest.approx([-0.01, -0.02], rel=1e-14)
    assert float(setup.push[1].value) == done[-1]
    assert are_identical(copy_state(setup), before)
    assert setup.problem.increment == 2


def test_increments_apply_the_load_in_equal_steps():
    """`increments` applies equal load steps, each solved and committed, numbered from 1."""
    setup = BlockOnBall(fc.Frictionless(k_n=2e4))
    steps = list(fc.increments(setup.problem, setup.push[1], 0.0, -0.02, steps=4))
    assert [s.load for s in steps] == pytest.approx([-0.005, -0.01, -0.015, -0.02], rel=1e-14)
    assert [s.increment for s in steps] == [1, 2, 3, 4]
    forces = [s.contacts["contact"].normal_force for s in steps]
    assert np.all(np.diff(forces) > 0)
    assert "increment 4" in steps[-1].summary() and "-0.02" in steps[-1].summary()


@pytest.mark.parametrize("lift", [0.0, 1e-3])
def test_summary_without_forces(lift):
    """Before first touch the summary reports that there are no forces and no contact force."""
    scene = block("quadrilateral")
    problem, _ = scene.problem(
        fc.Coulomb(0.3, 1e4, 1e4),
        [*scene.rollers(), scene.dirichlet_bc(TOP, scene.dim - 1, lift)],
        contact={"gap": 0.1},
    )
    step = problem.solve()
    assert "; contact: no contact force" in step.summary()
    assert "; no forces; " in step.summary()
    assert "reason" not in step.summary()
    problem.commit()
    assert "solved by the predictor" in problem.solve().summary()


def test_reason_against_static_condensation_is_logged_once(caplog):
    """`increments` decides on static condensation again, but the reason is logged once."""
    with caplog.at_level("INFO", logger="fenics_contact"):
        setup = BlockOnBall(condensation=False)
        list(fc.increments(setup.problem, setup.push[1], 0.0, -0.01, steps=2))
    messages = [r.message for r in caplog.records if "no static condensation" in r.message]
    assert len(messages) == (COMM.rank == 0)


# ---- pairs and factorisations --------------------------------------------------------------------


def record_residual_norms(setup: BlockOnBall) -> list[float]:
    """Return a list to which SNES appends the residual norm of every iteration."""
    norms: list[float] = []
    setup.problem.snes.setMonitor(lambda snes, it, norm: norms.append(norm))
    return norms


def test_lbfgs_pairs_are_discarded_after_each_increment():
    """The iterations of an increment do not depend on the increments solved before.

    Without friction there is no history, and H₀ is not factorised again: retained L-BFGS pairs
    would be the only difference. Residual norms of every iteration agree to 1e-9 of the first,
    round-off of sums over ranks that has grown over some iterations.
    """
    setup = BlockOnBall(fc.Frictionless(k_n=1e3), method="lbfgs")
    runs = []
    for number, (side, down) in enumerate([(0.0, 0.05), (0.01, 0.02), (0.0, 0.05)]):
        setup.scene.u.x.array[:] = 0.0
        setup.set_top_displacement(side, down)
        norms = record_residual_norms(setup)
        step = setup.problem.solve()
        setup.problem.snes.cancelMonitor()
        assert step.factorisations == (number == 0)  # otherwise H₀ would differ too
        runs.append((step.iterations, np.array(norms), gather(COMM, owned_values(setup.scene.u))))
    first, _, repeated = runs
    assert first[0] == repeated[0] > 3
    assert first[1].shape == repeated[1].shape
    assert np.all(np.abs(repeated[1] - first[1]) <= 1e-9 * first[1][0])
    assert is_close(repeated[2], first[2], 1e-12)


def test_factorisation_is_reused_until_the_modulus_changes():
    """Increments reuse the factorisation of H₀; a change of E requires another."""
    setup = BlockOnBall(fc.Frictionless(k_n=1e3))
    setup.set_top_displacement(0.0, 0.05)
    assert setup.problem.solve().factorisations == 1
    setup.problem.commit()
    for down in (0.055, 0.06, 0.065):
        setup.set_top_displacement(0.0, down)
        assert setup.problem.solve().factorisations == 0
        setup.problem.commit()
    setup.scene.E.value *= 2
    stiffer = setup.problem.solve()
    assert stiffer.factorisations >= 1
    # The change takes effect: the contact force of a stiffer body is larger.
    setup.problem.commit()
    setup.scene.E.value /= 2
    softer = setup.problem.solve()
    assert stiffer.contacts["contact"].normal_force > softer.contacts["contact"].normal_force


def test_modulus_changed_between_increments():
    """After a change of E, u is the exact solution of the new modulus, to 1e-10."""
    scene = block("quadrilateral", up=-2.0, nu=0.0)
    problem, _ = scene.problem(fc.Frictionless(k_n=5e3), scene.rollers(), petsc_options=TIGHT)
    for E in (1000.0, 250.0):
        scene.E.value = E
        problem.solve()
        problem.commit()
        assert is_interpolant(
            scene.u, lambda x, E=E: np.vstack([0 * x[0], -2.0 / 5e3 - 2.0 / E * x[1]]), 1e-10
        )


def test_solving_twice_changes_nothing():
    """A converged increment that is solved again takes no iteration and does not change u.

    Without a commit the history is the same, so that the state is already a solution.
    """
    setup = BlockOnBall()
    solve_path(setup, path=PATH[:2])
    setup.set_top_displacement(*PATH[2])
    setup.problem.solve()
    before = gather(COMM, owned_values(setup.scene.u))
    step = setup.problem.solve()
    assert step.iterations == 0
    # Round-off of the conversion to dimensionless u and back.
    assert is_close(gather(COMM, owned_values(setup.scene.u)), before, 1e-14)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_constant_load_takes_no_iterations_and_adds_no_slip(method):
    """Increments without a change of load take no iteration and add no slip, along the whole path.

    Tolerance 1e-12 of the accumulated slip, about 0.01: round-off.
    """
    setup = BlockOnBall(method=method)
    for move in PATH:
        solve_path(setup, path=[move])
        before = gather(COMM, setup.contact.slip)
        step = setup.problem.solve()
        setup.problem.commit()
        assert step.iterations == 0
        assert is_close(gather(COMM, setup.contact.slip), before, 1e-12, scale=0.01)


# ---- methods, units, ranks -----------------------------------------------------------------------


@pytest.mark.parametrize(("cell", "degree"), [("quadrilateral", 1), ("triangle", 2)])
def test_methods_agree(cell, degree):
    """L-BFGS and Newton reach the same state at the end of the path.

    Tolerance 1e-7 of the largest value: 1e-9 of the forces per increment, accumulated.
    """
    fields = []
    for method in ("lbfgs", "newton"):
        setup = BlockOnBall(cell=cell, degree=degree, method=method)
        solve_path(setup)
        contact = setup.contact
        rows = (point_values(contact, x) for x in (contact.traction, contact.slip))
        fields.append((nodal_values(setup.scene.u), *rows))
    for a, b in zip(*fields, strict=True):
        assert is_close(a, b, 1e-7)
    assert np.abs(fields[0][2]).max() > 1e-3


@pytest.mark.parametrize("law", ["coulomb", "frictionless"])
@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_solution_is_independent_of_units(method, law):
    """Effort and solution are the same in N-mm, in SI and with units scaled by 1e-9 or 1e9.

    The stiffnesses are the default, relative to the computed E/h. Tolerance 1e-9 of the fields:
    the same iterations, with different round-off.
    """
    make = {"coulomb": fc.Coulomb(0.3), "frictionless": fc.Frictionless()}[law]
    path = PATH[:4] if law == "coulomb" else PATH[:1]
    results = []
    for length, pressure in [(1.0, 1.0), (1e-3, 1e6), (1e-9, 1.0), (1.0, 1e-9), (1e-9, 1e9)]:
        setup = BlockOnBall(make, length=length, pressure=pressure, method=method)
        steps = solve_path(setup, length, path)
        results.append(
            (
                [s.iterations for s in steps],
                nodal_values(setup.scene.u) / length,
                point_values(setup.contact, setup.contact.traction) / pressure,
            )
        )
    for iterations, u, traction in results[1:]:
        assert have_similar_iterations(iterations, results[0][0])
        assert is_close(u, results[0][1], 1e-9)
        assert is_close(traction, results[0][2], 1e-9)


MESHES = {
    "triangle": {},
    "hexahedron": {"n": 2},
    # Γc on the first rank only.
    "quadrilateral": {"n": (1, 6), "partitioner": layer_partitioner("quadrilateral")},
}


@pytest.mark.parametrize("cell", MESHES)
def test_resultants_do_not_depend_on_the_number_of_ranks(cell):
    """Resultants on all ranks agree with those that each rank computes alone.

    Tolerance 1e-8 of the normal force, ten times the solver's.
    """
    resultants = []
    for comm in (COMM, MPI.COMM_SELF):
        setup = BlockOnBall(cell=cell, mesh=MESHES[cell] | {"comm": comm})
        steps = solve_path(setup, path=PATH[1:5])
        resultants.append([s.contacts["contact"] for s in steps])
    for together, alone in zip(*resultants, strict=True):
        size = alone.normal_force
        assert is_close(together.force, alone.force, 1e-8, scale=size)
        assert abs(together.normal_force - alone.normal_force) <= 1e-8 * size
        assert abs(together.tangential_force - alone.tangential_force) <= 1e-8 * size
        assert together.max_pressure == pytest.approx(alone.max_pressure, rel=1e-7)
        counts = [(r.open, r.stick, r.slip) for r in (together, alone)]
        assert counts[0] == counts[1]
        assert together.area == pytest.approx(alone.area, rel=1e-12)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_ranks_without_cells(method):
    """A mesh of one cell, on one rank: the contact force equals the load, to 1e-8."""
    scene = block("quadrilateral", n=1, up=-1.0)
    assert COMM.allreduce(scene.mesh.topology.index_map(2).size_local) == 1
    problem, contact = scene.problem(fc.Coulomb(0.3), scene.rollers(), method=method)
    for side in (0.0, -0.05):
        scene.load(side=side, up=-1.0)
        step = problem.solve()
        problem.commit()
        assert step.contacts["contact"].normal_force == pytest.approx(1.0, rel=1e-8)
    assert np.all(gather(COMM, contact.pressure) > 0)


@pytest.mark.parametrize("condensation", [False, None])
@pytest.mark.parametrize("method", ["lbfgs", "continuation", "alternating"])
def test_methods_without_tangent_extrapolate_the_last_increment(method, condensation):
    """A sticking block is loaded and unloaded in unequal increments, without more iterations.

    Reference: the equations are linear, so that after the first increment the predictor is the
    solution for any increment size, and 0 iterations are needed; at the end u is 0.4 of that of
    the first increment, to 1e-8 (the solver's tolerance is 1e-9 of the forces).
    """
    scene = block("quadrilateral", n=4)
    displacement = fem.Constant(scene.mesh, 0.0)
    bcs = [*scene.rollers(), scene.dirichlet_bc(TOP, 1, displacement)]
    law = fc.Coulomb(10.0, 1e4, 1e4)
    problem, _ = scene.problem(law, bcs, method=method, condensation=condensation)
    computed = []
    for step in fc.increments(problem, displacement, 0.0, -0.03, steps=[-0.01, -0.015, -0.03]):
        computed.append((step.iterations, step.method))
        if len(computed) == 1:
            first = nodal_values(scene.u)
    for step in fc.increments(problem, displacement, -0.03, -0.004, steps=[-0.02, -0.004]):
        computed.append((step.iterations, step.method))
    assert [n for n, _ in computed[1:]] == [0, 0, 0, 0]
    assert {by for _, by in computed} == {method}
    assert is_close(nodal_values(scene.u), 0.4 * first, 1e-8)


# ---- messages, restored state and memory ---------------------------------------------------------


def test_sound_solve_logs_no_warning(caplog):
    """A successful solve logs no warning."""
    with caplog.at_level(logging.WARNING, logger="fenics_contact"):
        setup = BlockOnBall(fc.Frictionless(k_n=2e4))
        solve_path(setup, path=PATH[:1])
    assert not [r for r in caplog.records if r.name.startswith("fenics_contact")]


def test_problem_is_freed_without_garbage_collector() -> None:
    """A problem has no reference cycles: all ranks free its factorisations at the same `del`."""
    setup = BlockOnBall()
    setup.set_top_displacement(*PATH[1])
    setup.problem.solve()
    gc.collect()
    gc.disable()
    try:
        alive = weakref.ref(setup.problem)
        setup.problem = None
        assert alive() is None
    finally:
        if COMM.size == 1:
            gc.enable()


def test_restore_discards_the_uncommitted_increment() -> None:
    """`restore` resets u and history, after an uncommitted increment, to the last commit."""
    setup = BlockOnBall()
    setup.set_top_displacement(*PATH[1])
    setup.problem.solve()
    setup.problem.commit()
    before, u = copy_state(setup), setup.scene.u.x.array.copy()
    setup.set_top_displacement(*PATH[2])
    setup.problem.solve()
    assert not np.array_equal(
        gather(COMM, owned_values(setup.scene.u)),
        gather(COMM, u[: len(owned_values(setup.scene.u))]),
    )
    setup.problem.restore()
    assert are_identical(copy_state(setup), before)
    assert np.array_equal(setup.scene.u.x.array, u)


@pytest.mark.parametrize("condensation", [None, False])
def test_newton_after_increment_without_iterations(condensation):
    """An increment without load computes no tangent, and the next one starts without it."""
    setup = BlockOnBall(method="newton", condensation=condensation)
    setup.set_top_displacement(0.0, 0.0)
    setup.scene.u.x.array[:] = 0.0
    first = setup.problem.solve()
    setup.problem.commit()
    assert first.iterations == 0
    solve_path(setup, path=PATH[:2])


@pytest.mark.parametrize("condensation", [None, False])
def test_newton_predictor_reduces_iterations_on_slip_path(condensation):
    """Small increments with the predictor take less than 80 % of the iterations without it.

    The predictor is the last tangent or the last change of u. The states agree to 1e-7, as each
    increment is solved to 1e-9 of the forces.
    """
    taken, states = [], []
    for helped in (True, False):
        setup = BlockOnBall(method="newton", condensation=condensation, mesh={"n": 12})
        taken.append(0)
        for i in range(1, 13):
            setup.set_top_displacement(0.004 * i, 0.05)
            if not helped:
                setup.problem.restart_solver()
                state = setup.problem.state
                setup.problem.state = replace(state, change=None)
            taken[-1] += setup.problem.solve().iterations
            setup.problem.commit()
        assert setup.contact.resultants().slip > 0
        states.append(owned_values(setup.scene.u).copy())
    assert taken[0] < 0.8 * taken[1]
    assert is_close(*states, 1e-7)
