"""The error budget: every part against a known error, from a formula or a better solution."""

import basix.ufl
import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.estimates.errors import quantities
from scenes.block_on_ball import ObliqueBlockOnBall, supporting_ball
from scenes.blocks import BOTTOM, GRID, LEFT, TOP, block, block_mesh
from scenes.comparison import assert_raised_on_all_ranks, is_close, nodal_values, shared_folder
from scenes.elasticity import displacement_space, stress
from scenes.histories import BlockOnBallHistory

COMM = MPI.COMM_WORLD
# Accepted effectivity of an estimate: estimated over true error.
EFFECTIVITY_BOUNDS = (0.3, 3.0)


def budget(scene, problem, **kwargs):
    return fc.estimate_errors(problem, stress(scene.u, scene.E, scene.nu), **kwargs)


def press(*, n=8, k=1e4, friction=0.3, **options) -> ObliqueBlockOnBall:
    law = fc.Coulomb(friction, k, k) if friction else fc.Frictionless(k)
    return ObliqueBlockOnBall(law, mesh={"n": n}, **options)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize(("cell", "degree"), GRID)
def test_enforcement_of_uniform_pressure(cell, degree, method):
    """A block on a plane penetrates by p/k_n, which is the whole error and its estimate (1e-8).

    Pressure and force are prescribed and have no error. There is no discretisation error either.
    """
    p, k = 3.0, 2e3
    scene = block(cell, degree, n=2, up=-p)
    problem, _ = scene.problem(fc.Frictionless(k), scene.rollers(), method=method)
    problem.solve()
    computed = budget(scene, problem)
    assert is_close(computed.parts["enforcement"]["displacement"], p / k, 1e-8)
    size = computed.values
    for part in ("enforcement", "discretisation", "kinematics", "solver"):
        for name in ("normal force", "peak pressure"):
            assert abs(computed.parts[part][name]) <= 1e-8 * size[name], (part, name)
    assert abs(computed.parts["discretisation"]["displacement"]) <= 1e-8 * size["displacement"]
    assert is_close(size["peak pressure"], p, 1e-8)


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_enforcement(friction):
    """The reference has the same mesh, 300 times the stiffness and a 300th of the error."""
    soft, stiff = (press(friction=friction, k=k, n=16) for k in (1e4, 3e6))
    soft.run(steps=2)
    stiff.run(steps=2)
    computed, truth = budget(soft.scene, soft.problem), quantities(stiff.problem)
    for name in ("normal force", "peak pressure"):
        ratio = computed.parts["enforcement"][name] / (computed.values[name] - truth[name])
        assert EFFECTIVITY_BOUNDS[0] < ratio < EFFECTIVITY_BOUNDS[1], (name, ratio)


@pytest.mark.parametrize(("cell", "degree", "n"), [("quadrilateral", 1, 12), ("triangle", 1, 8)])
def test_discretisation(cell, degree, n):
    """The reference is the force of a prescribed displacement on a mesh four times as fine."""
    coarse, fine = (press(cell=cell, degree=degree, n=i, friction=0.0) for i in (n, 4 * n))
    coarse.run()
    fine.run()
    computed, truth = budget(coarse.scene, coarse.problem), quantities(fine.problem)
    name = "normal force"
    ratio = computed.parts["discretisation"][name] / (computed.values[name] - truth[name])
    assert EFFECTIVITY_BOUNDS[0] < ratio < EFFECTIVITY_BOUNDS[1], ratio


def test_discretisation_of_sliding():
    """If all closed points slip, the error of friction is μ times that of the normal force."""
    setup = press(friction=0.3)
    setup.push[-1].value, setup.push[0].value = -0.03, 0.2
    setup.problem.small_displacement_tolerance = np.inf  # it slides far over the ball
    setup.problem.solve()
    assert setup.contact.resultants().stick == 0
    computed = budget(setup.scene, setup.problem).parts["discretisation"]
    assert computed["normal force"] != 0
    assert is_close(computed["friction force"], 0.3 * computed["normal force"], 1e-6)


def test_increment_error():
    """The reference is the friction force of 32 increments, in a growing contact."""
    ends = {}
    for steps in (1, 2, 4, 32):
        setup = press(n=16)
        options = {"steps": steps, "estimate": steps < 32}
        end = list(fc.increments(setup.problem, setup.load, **options))
        assert len(end) == (2 * steps if steps < 32 else steps)
        assert [s.increment_error is None for s in end[:2]] == [True, steps == 32]
        ends[steps] = quantities(setup.problem), end[-1].increment_error
    truth, name = ends[32][0], "friction force"
    for steps in (1, 2, 4):
        values, error = ends[steps]
        ratio = error[name] / (values[name] - truth[name])
        assert EFFECTIVITY_BOUNDS[0] < ratio < EFFECTIVITY_BOUNDS[1], (steps, ratio)


@pytest.mark.parametrize("condensation", [None, False])
def test_solver_error(condensation):
    """The error due to a residual of 1e-3, left on purpose, is estimated to 1 %."""
    # Newton's method would end with the exact solution nevertheless.
    options = {"petsc_options": {"snes_rtol": 1e-3}, "method": "lbfgs"}
    rough = press(friction=0.0, condensation=condensation, **options)
    exact = press(friction=0.0, condensation=condensation)
    rough.run()
    exact.run()
    computed, truth = budget(rough.scene, rough.problem), quantities(exact.problem)
    name = "normal force"
    error = computed.values[name] - truth[name]
    assert abs(error) > 1e-7 * truth[name]
    assert is_close(computed.parts["solver"][name], error, 0.01)


def test_estimate_changes_no_state():
    """An estimate between increments changes neither state nor history nor the next increment.

    Tolerance 1e-9: it uses the solver of the tangent, and the next increment starts from H₀ again.
    """
    plain, estimated = press(), press()
    for setup in (plain, estimated):
        setup.load(0.5)
        setup.problem.solve()
        before = setup.scene.u.x.array.copy(), setup.contact.history.function.x.array.copy()
        if setup is estimated:
            budget(setup.scene, setup.problem)
            now = setup.scene.u.x.array, setup.contact.history.function.x.array
            assert all(COMM.allgather(all(map(np.array_equal, before, now))))
        setup.problem.commit()
        if setup is estimated:
            repeated = budget(setup.scene, setup.problem)
            assert set(repeated.parts) == {"enforcement", "discretisation", "kinematics", "solver"}
        setup.load(1.0)
        setup.problem.solve()
    assert is_close(nodal_values(estimated.scene.u), nodal_values(plain.scene.u), 1e-9)


def test_estimate_is_the_same_before_and_after_commit():
    """The springs of the increment and those committed give the same error, to 1e-6."""
    setup = press()
    setup.load(1.0)
    setup.problem.solve()
    before = budget(setup.scene, setup.problem)
    setup.problem.commit()
    after = budget(setup.scene, setup.problem)
    for part in before.parts:
        for name, value in before.parts[part].items():
            assert is_close(after.parts[part][name], value, 1e-6, scale=abs(before.values[name]))


def test_table_of_the_budget():
    """The table has five lines, one for each part, and the dominant part; contacts have names."""
    setup = press(k=1e3)
    step = setup.run(estimate=True)[-1]
    computed = budget(setup.scene, setup.problem, increment_error=step.increment_error)
    lines = str(computed).splitlines()
    assert [line.split()[0] for line in lines[1:6]] == list(computed.parts)
    assert computed.dominant in lines[6]
    total = computed.total["normal force"]
    squares = [computed.relative(p)["normal force"] ** 2 for p in computed.parts]
    assert is_close(total, np.sqrt(sum(squares)), 1e-14)
    assert "not estimated" in str(budget(setup.scene, setup.problem))

    scene = block("quadrilateral", 1, n=4, up=-1.0)
    contacts = [scene.contact(fc.Frictionless(k_n=1e3), name=name) for name in ("one", "other")]
    problem = fc.ContactProblem(scene.F, scene.u, bcs=scene.rollers(), contacts=contacts)
    problem.solve()
    assert set(quantities(problem)) == {
        f"{c}: {q}" for c in ("one", "other") for q in ("normal force", "peak pressure")
    } | {"displacement"}


@pytest.mark.parametrize(("cell", "n"), [("triangle", 3), ("triangle", 8), ("hexahedron", 2)])
def test_few_facets_in_contact_are_reported(cell, n):
    """All n, or n², facets of a block are in contact: the table warns below five in a row."""
    scene = block(cell, 1, n=n, up=-1.0)
    problem, _ = scene.problem(fc.Frictionless(k_n=1e3), scene.rollers())
    problem.solve()
    computed = budget(scene, problem)
    assert is_close(computed.across, n, 1e-12)
    assert ("unreliable with fewer" in str(computed)) == (n < 5)


def test_foundation_stiffness_is_not_an_error():
    """The stiffness of a foundation is physical: no part of the displacement is an error of it."""
    scene = block("quadrilateral", 1, n=2, up=-1.0)
    problem, _ = scene.problem(fc.Foundation(1e3), scene.rollers())
    problem.solve()
    assert budget(scene, problem).parts["enforcement"]["displacement"] == 0.0


def test_units_do_not_matter():
    """Relative errors in metres and pascals are those in mm and MPa, to 1e-8."""
    computed = []
    for length, pressure in ((1.0, 1.0), (1e-3, 1e6)):
        scene = block("triangle", 2, n=3, size=[length] * 2, E=1e3 * pressure)
        law = fc.Coulomb(0.3, fc.RelativeStiffness(10.0), fc.RelativeStiffness(10.0))
        bcs = [
            scene.dirichlet_bc(TOP, 0, 0.01 * length),
            scene.dirichlet_bc(TOP, 1, -0.03 * length),
        ]
        problem, _ = scene.problem(
            law, bcs, contact={"obstacle": supporting_ball(2, length=length)}, method="newton"
        )
        problem.solve()
        estimate = budget(scene, problem)
        computed.append([v for part in estimate.parts for v in estimate.relative(part).values()])
    assert is_close(computed[1], computed[0], 1e-8, scale=1.0)


def test_shapes_are_checked():
    """Stress and strain of different shapes are refused, on all ranks."""
    setup = press(n=2)
    setup.run()
    u = setup.scene.u
    assert_raised_on_all_ranks(
        lambda: fc.estimate_errors(setup.problem, ufl.Identity(3), strain=ufl.sym(ufl.grad(u))),
        ValueError,
        "shape",
    )
    assert_raised_on_all_ranks(lambda: fc.estimate_errors(setup.problem, u), ValueError, "shape")


@pytest.mark.parametrize("bulk", ["linear", "nonlinear"])
def test_estimate_with_an_unconstrained_obstacle_is_refused(bulk):
    """A refused estimate of an unconstrained obstacle does not affect the next solution.

    MUMPS' failure with the singular matrix once remained: the next solution ended in PETSc's error
    76. Reference: the same problem without an estimate, to 1e-8.
    """
    estimated, reference = (
        BlockOnBallHistory(obstacle="force", wall=True, bulk=bulk) for _ in range(2)
    )
    assert_raised_on_all_ranks(
        lambda: budget(estimated.scene, estimated.problem),
        ValueError,
        "not constrained",
        "obstacle",
    )
    for setup in (estimated, reference):
        setup.load(1.0)
        setup.problem.solve()
    assert is_close(nodal_values(estimated.scene.u), nodal_values(reference.scene.u), 1e-8)
    assert budget(estimated.scene, estimated.problem).values["floor: normal force"] > 0


def test_estimate_continues_from_a_checkpoint(tmp_path):
    """An interrupted and restarted history has the same error at its end, to 1e-7.

    A restart without the estimate is refused.
    """
    uninterrupted = press()
    end = uninterrupted.run(steps=3, estimate=True)[-1].increment_error
    path = shared_folder(tmp_path) / "state.npz"
    interrupted, after = press(), press()
    for step in fc.increments(
        interrupted.problem, interrupted.load, steps=3, estimate=True, checkpoint=path
    ):
        if step.increment == 4:
            break
    resumed = after.run(steps=3, estimate=True, checkpoint=path)[-1].increment_error
    values = quantities(uninterrupted.problem)
    for name, error in end.items():
        assert is_close(resumed[name], error, 1e-7, scale=abs(values[name]))
    assert_raised_on_all_ranks(
        lambda: press().run(steps=3, checkpoint=path), ValueError, "estimate", "remove it"
    )


def test_multipliers_have_no_enforcement_error():
    """With multipliers, to 1e-5 of the tractions, at most 1e-4 remains of some 10 %."""
    left = {}
    for enforcement in ("penalty", "augmented"):
        scene = block("quadrilateral", 1, n=8)
        bcs = [scene.dirichlet_bc(TOP, 0, 0.015), scene.dirichlet_bc(TOP, 1, -0.03)]
        contact = {"obstacle": supporting_ball(2), "enforcement": enforcement}
        problem, _ = scene.problem(fc.Coulomb(0.3, 1e4, 1e4), bcs, contact=contact)
        problem.solve()
        left[enforcement] = budget(scene, problem).relative("enforcement")["normal force"]
    assert left["penalty"] > 0.05
    assert left["augmented"] < 1e-4


def test_multigrid_gives_the_same_budget():
    """Budgets by V-cycles and by factors agree to 1e-6, as systems are solved to 1e-8."""
    computed = []
    for kind in ("direct", "multigrid"):
        setup = press(cell="hexahedron", n=4, condensation=False, linear_solver=kind)
        setup.run()
        computed.append(budget(setup.scene, setup.problem))
    direct, multigrid = computed
    for part in ("enforcement", "discretisation"):
        for name, value in direct.relative(part).items():
            assert is_close(multigrid.relative(part)[name], value, 1e-6, scale=1.0)


@pytest.mark.each
@pytest.mark.parametrize("kind", ["plane strain", "plane stress", "axisymmetric"])
@pytest.mark.parametrize("bulk", ["linear", "rubber", "mixed"])
def test_stresses_of_the_package(kind, bulk):
    """`estimate_errors(problem, body.stress)` finds the strain conjugate to a stress (3, 3).

    Reference: the strain of the body. In plane stress the out-of-plane strain does no work.
    Tolerance 1e-8 of the errors, to which the smoothing is solved.
    """
    if bulk != "linear" and kind == "plane stress":
        pytest.skip("there is no such rubber")
    mesh, tags = block_mesh("triangle", n=6)
    if bulk == "mixed":
        cell = mesh.basix_cell()
        parts = [("P", cell, 1), ("P", cell, 2, (2,))]
        elements = [basix.ufl.element(*p[:3], shape=p[3] if len(p) > 3 else ()) for p in parts]
        mixed_function = fem.Function(fem.functionspace(mesh, basix.ufl.mixed_element(elements)))
        (p, u), (q, v) = ufl.split(mixed_function), ufl.TestFunctions(mixed_function.function_space)
        body = fc.elasticity.NeoHookean(u, 1000.0, 0.45, kind, pressure=p)
        F, space = body.residual(v, q=q), mixed_function.function_space.sub(1)
    else:
        mixed_function = u = fem.Function(displacement_space(mesh, 2))
        v, space = ufl.TestFunction(u.function_space), u.function_space
        body_class = fc.elasticity.LinearElastic if bulk == "linear" else fc.elasticity.NeoHookean
        body = body_class(u, 1000.0, 0.3, kind)
        F = body.residual(v)
    weight = None if kind != "axisymmetric" else body.weight
    bcs = []
    for side, component, value in ((TOP, 1, -0.01), (LEFT, 0, 0.0)):
        dofs = fem.locate_dofs_topological(space.sub(component), 1, tags.find(side))
        bcs.append(fem.dirichletbc(value, dofs, space.sub(component)))
    surface = fc.ContactSurface(mesh, tags, BOTTOM)
    ball = fc.Ball((0.0, -2.0), 2.0)
    contact = fc.Contact(u, surface, ball, fc.Frictionless(1e4), weight=weight)
    problem = fc.ContactProblem(
        F, mixed_function, bcs=bcs, contacts=[contact], small_displacement_tolerance=np.inf
    )
    problem.solve()
    gradient = body.strain(u) if bulk == "linear" else ufl.sym(body.gradient(u))
    computed = fc.estimate_errors(problem, body.stress)
    expected = fc.estimate_errors(problem, body.stress, strain=gradient)
    assert is_close(computed.energy, expected.energy, 1e-8) and computed.energy > 1e-3
    for part, errors in expected.parts.items():
        for name, error in errors.items():
            assert is_close(computed.parts[part][name], error, 1e-8, scale=computed.values[name])


def test_remedy_of_the_small_displacement_error():
    """Finite kinematics are suggested, as they have no small-displacement error."""
    values = {"normal force": 1.0}
    text = str(fc.ErrorBudget(values, {"kinematics": {"normal force": 0.1}, "solver": {}}))
    assert 'kinematics dominates: Contact(kinematics="finite")' in text
