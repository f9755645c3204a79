"""Loads, conditions and values without a solution raise an error that names them, on every rank."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact import parallel
from scenes.blocks import BOTTOM, LEFT, RIGHT, TOP, block, block_mesh
from scenes.comparison import assert_raised_on_all_ranks
from scenes.elasticity import strain, stress
from scenes.valid_problem import LAYERED_MESH, coulomb_law, make_solve, pressed_block

pytestmark = [
    pytest.mark.newest,
    pytest.mark.two_ranks,
    pytest.mark.timeout(120),
]
COMM = MPI.COMM_WORLD


def test_valid_scene_is_solved():
    """The scene in which the tests below change one input is valid: it carries its load, 1."""
    step = make_solve(pressed_block())()
    # Equilibrium to the solver's tolerance, 1e-9 of the forces.
    assert step.contacts["contact"].normal_force == pytest.approx(1.0, rel=1e-8)


def test_load_that_is_zero_in_ufl_is_no_error():
    """The integral of the load is empty, and the only one over its kind of facets.

    The top moves down by 1e-3 of a height of 1, with rollers at x = 0 and the other side free:
    plane strain and a penalty of 1e4 in series, 1/(1/k_n + (1 - ν²)/E), to 1e-8.
    """
    scene = block("quadrilateral", 1, **LAYERED_MESH)
    v = ufl.TestFunction(scene.u.function_space)
    F = ufl.inner(stress(scene.u, scene.E, scene.nu), strain(v)) * ufl.dx
    F -= 0 * v[0] * ufl.ds(scene.mesh, subdomain_data=scene.tags)(TOP)
    bcs = [*scene.rollers(), scene.dirichlet_bc(TOP, 1, -1e-3)]
    contact = scene.contact(fc.Frictionless(k_n=1e4))
    step = fc.ContactProblem(F, scene.u, bcs=bcs, contacts=[contact]).solve()
    exact = 1e-3 / (1e-4 + (1 - 0.3**2) / 1000)
    assert step.contacts["contact"].normal_force == pytest.approx(exact, rel=1e-8)


def test_form_without_stiffness_is_refused():
    """A modulus of zero is detected before it leads to a singular matrix."""
    scene = pressed_block(E=0.0)
    assert_raised_on_all_ranks(make_solve(scene), ValueError, "stiffness")


# ---- not finite ----------------------------------------------------------------------------------


@pytest.mark.each
@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["traction", "body_force", "E", "nu"])
def test_constants_that_are_not_finite_are_refused(name, value):
    """A load or modulus that is not finite is refused by the first and by later solves."""
    scene = pressed_block()
    constant = getattr(scene, name)
    good = constant.value.copy()
    constant.value = np.full_like(constant.value, value)
    assert_raised_on_all_ranks(make_solve(scene), ValueError, "finite", "constant")
    constant.value = good
    problem, _ = scene.problem(coulomb_law(), scene.rollers())
    problem.solve()
    problem.commit()
    before = scene.u.x.array.copy()
    constant.value = np.full_like(constant.value, value)
    assert_raised_on_all_ranks(problem.solve, ValueError, "finite", "constant")
    assert all(COMM.allgather(bool(np.array_equal(scene.u.x.array, before))))
    # With a finite constant the problem is solved again.
    constant.value = good
    problem.solve()


def test_infinite_stiffness_is_refused():
    """ν = 0.5, set between increments, makes λ infinite: the error names ν = 0.5 as a cause."""
    scene = pressed_block()
    problem, _ = scene.problem(coulomb_law(), scene.rollers())
    problem.solve()
    problem.commit()
    scene.nu.value = 0.5
    assert_raised_on_all_ranks(problem.solve, ValueError, "F at u = 0", "not finite", "ν = 0.5")


@pytest.mark.parametrize("offset", [1e8, 1e9])
def test_mesh_too_far_from_the_origin_is_refused(offset):
    """If coordinates are round-off the mesh is refused; nearer to the origin the load is carried.

    At 1e8 coordinates have a round-off of 1e-8 of the mesh; forces balance to 1e-8 of the load.
    """
    mesh, tags = block_mesh("quadrilateral", **LAYERED_MESH)
    mesh.geometry.x[:, :2] += offset
    u = fem.Function(fem.functionspace(mesh, ("Lagrange", 1, (2,))))
    v = ufl.TestFunction(u.function_space)
    F = ufl.inner(stress(u, 1000.0, 0.3), strain(v)) * ufl.dx
    F += v[1] * ufl.ds(mesh, subdomain_data=tags)(TOP)
    obstacle = fc.HalfSpace((offset, offset), (0, 1))
    contact = fc.Contact(u, fc.ContactSurface(mesh, tags, BOTTOM), obstacle, coulomb_law())

    def call():
        return fc.ContactProblem(F, u, contacts=[contact]).solve()

    if offset > 1e8:
        assert_raised_on_all_ranks(call, ValueError, "contact", "origin", "1e+09")
    else:
        assert call().contacts["contact"].normal_force == pytest.approx(1.0, rel=1e-8)


@pytest.mark.parametrize("name", ["load", "modulus"])
def test_function_that_is_nan_on_one_rank_is_refused(name):
    """A coefficient function with NaN in cells of one rank is named on all ranks."""
    scene = pressed_block()
    field = fem.Function(fem.functionspace(scene.mesh, ("DG", 0)), name=f"the {name}")
    field.x.array[:] = 1.0
    centers = field.function_space.tabulate_dof_coordinates()
    field.x.array[(centers[:, 0] > 0.5) & (centers[:, 1] > 0.75)] = np.nan
    v = ufl.TestFunction(scene.u.function_space)
    dx = ufl.dx(scene.mesh)
    if name == "load":
        scene.F -= field * v[1] * dx
    else:
        scene.F += ufl.inner(field * strain(scene.u), strain(v)) * dx
    assert_raised_on_all_ranks(make_solve(scene), ValueError, f"the {name}", "finite")


@pytest.mark.whole
@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("kind", ["constant", "function"])
def test_dirichlet_value_that_is_not_finite_is_refused(kind, value):
    """The value is a constant, or a function with one such dof, and thus on one rank only."""
    scene = pressed_block()
    if kind == "constant":
        bc = scene.dirichlet_bc(TOP, 1, value)
    else:
        prescribed = fem.Function(scene.u.function_space)
        x = scene.u.function_space.tabulate_dof_coordinates()
        corner = np.flatnonzero(np.isclose(x[:, 0], 1.0) & np.isclose(x[:, 1], 1.0))
        prescribed.x.array[2 * corner] = value
        bc = fem.dirichletbc(prescribed, scene.facet_dofs(TOP))
    assert_raised_on_all_ranks(
        make_solve(scene, bcs=[*scene.rollers(), bc]), ValueError, "Dirichlet", "finite"
    )


def test_initial_displacement_that_is_nan_on_one_rank_is_refused():
    """An initial u with one NaN is refused on all ranks."""
    scene = pressed_block()
    x = scene.u.function_space.tabulate_dof_coordinates()
    corner = np.flatnonzero(np.isclose(x[:, 0], 1.0) & np.isclose(x[:, 1], 1.0))
    scene.u.x.array[2 * corner] = np.nan
    assert_raised_on_all_ranks(make_solve(scene), ValueError, "'u'", "finite")


@pytest.mark.parametrize("kinematics", ["small", "finite"])
def test_obstacle_displacement_that_is_nan_is_refused(kinematics):
    """An obstacle whose displacement becomes NaN between two increments is refused."""
    scene = pressed_block()
    motion = fem.Constant(scene.mesh, np.zeros(2))
    options = {"displacement": motion, "kinematics": kinematics}
    problem, _ = scene.problem(coulomb_law(), scene.rollers(), contact=options)
    problem.solve()
    motion.value[1] = np.nan
    assert_raised_on_all_ranks(problem.solve, ValueError, "displacement", "finite")


@pytest.mark.parametrize("kinematics", ["small", "finite"])
def test_tangential_obstacle_displacement_that_is_nan_is_refused(kinematics):
    """A tangential displacement of NaN is refused, although it need not enter the gap."""
    scene = pressed_block()
    motion = fem.Constant(scene.mesh, np.zeros(2))
    options = {"displacement": motion, "kinematics": kinematics}
    problem, _ = scene.problem(coulomb_law(), scene.rollers(), contact=options)
    problem.solve()
    motion.value[0] = np.nan
    assert_raised_on_all_ranks(problem.solve, ValueError, "finite")


# ---- Dirichlet conditions on Γc ------------------------------------------------------------------


def test_clamped_contact_surface_is_refused():
    """Γc with all displacements prescribed, by one condition or by components, is refused."""
    scene = pressed_block()
    dofs = scene.facet_dofs(BOTTOM)
    clamp = fem.dirichletbc(np.zeros(2), dofs, scene.u.function_space)
    for bcs in ([clamp], [scene.dirichlet_bc(BOTTOM, 0), scene.dirichlet_bc(BOTTOM, 1)]):
        assert_raised_on_all_ranks(
            lambda bcs=bcs: scene.problem(coulomb_law(), bcs), ValueError, "contact", "Dirichlet"
        )


def test_contact_surface_with_one_clamped_facet_is_refused():
    """One facet of Γc is clamped, on one rank: the error is raised on all ranks."""
    scene = pressed_block()
    surface = fc.ContactSurface(scene.mesh, scene.tags, [BOTTOM, RIGHT])
    contact = fc.Contact(scene.u, surface, scene.floor(), coulomb_law())
    x = scene.u.function_space.tabulate_dof_coordinates()
    n_owned = scene.u.function_space.dofmap.index_map.size_local
    ends = np.flatnonzero((x[:n_owned, 1] > 0.7) & (x[:n_owned, 0] > 0.9)).astype(np.int32)
    clamp = fem.dirichletbc(np.zeros(2), ends, scene.u.function_space)
    assert_raised_on_all_ranks(
        lambda: fc.ContactProblem(scene.F, scene.u, bcs=[clamp], contacts=[contact]),
        ValueError,
        "1 facets",
    )


def test_partly_constrained_contact_surface_is_solved():
    """Γc may have a prescribed tangential displacement, or share an edge with a clamped side."""
    scene = pressed_block()
    problem, _ = scene.problem(coulomb_law(), [scene.dirichlet_bc(BOTTOM, 0)])
    step = problem.solve()
    assert step.contacts["contact"].normal_force == pytest.approx(1.0, rel=1e-8)
    scene = pressed_block()
    clamp = fem.dirichletbc(np.zeros(2), scene.facet_dofs(LEFT), scene.u.function_space)
    problem, _ = scene.problem(coulomb_law(), [clamp])
    problem.solve()


# ---- unbalanced loads and unconstrained rigid-body modes -----------------------------------------


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_load_away_from_the_obstacle_is_refused(cell):
    """No contact force can balance a load away from the obstacle without a Dirichlet condition."""
    scene = block(cell, up=1.0)
    assert_raised_on_all_ranks(make_solve(scene), ValueError, "balance", "translation along")
    scene = block(cell, up=1.0)
    assert_raised_on_all_ranks(make_solve(scene, bcs=[]), ValueError, "balance")
    # With the normal displacement of the top prescribed elasticity balances the load.
    scene = block(cell, up=1.0)
    bcs = [*scene.rollers(), scene.dirichlet_bc(TOP, scene.dim - 1)]
    step = make_solve(scene, bcs=bcs)()
    assert step.contacts["contact"].normal_force <= 1e-8


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_sliding_modes_without_friction_are_refused(cell):
    """The error names the rigid-body modes that no contact force can ever balance."""
    scene = block(cell, up=-1.0, side=0.1)
    words = ["translation along x"] + (["translation along y"] if scene.dim == 3 else [])
    frictionless = fc.Frictionless(k_n=1e4)
    assert_raised_on_all_ranks(
        lambda: scene.problem(frictionless, []), ValueError, "constrain", *words
    )
    # μ = 0 is no friction either.
    assert_raised_on_all_ranks(
        lambda: scene.problem(coulomb_law(0.0), []), ValueError, "constrain", *words
    )
    problem, _ = scene.problem(coulomb_law(0.3), [])
    problem.solve()


def test_rotation_in_a_frictionless_cavity_is_refused():
    """A body inside a round cavity without friction can rotate about its axis, which is named."""
    scene = pressed_block()
    # The cavity's axis is the middle of the block: a rotation about it changes no gap.
    cavity = fc.Ball((0.5, 0.5), 2.0, inside=True)
    assert_raised_on_all_ranks(
        lambda: scene.problem(fc.Frictionless(k_n=1e4), [], contact={"obstacle": cavity}),
        ValueError,
        "rotation about z",
    )


def test_body_without_contact_or_conditions_is_refused():
    """A body without contact or Dirichlet conditions is unconstrained: all its modes are named."""
    scene = pressed_block()
    assert_raised_on_all_ranks(
        lambda: fc.ContactProblem(scene.F, scene.u),
        ValueError,
        "translation along x",
        "translation along y",
        "rotation about z",
    )


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_load_above_the_friction_limit_is_refused(cell):
    """A tangential load above μ times the normal one is refused without other constraints.

    It is larger by a sixth: in space the check encloses the cone by a polygon that is 8 % too wide.
    """
    scene = block(cell, up=-1.0, side=0.35)
    problem, _ = scene.problem(coulomb_law(0.3), [])
    assert_raised_on_all_ranks(problem.solve, ValueError, "balance", "translation along x")
    # More friction balances the load; its moment does not tip the block (0.35 < 0.5).
    below_limit, _ = scene.problem(coulomb_law(0.5), [])
    step = below_limit.solve()
    resultants = step.contacts["contact"]
    # Equilibrium; 1e-7 is a hundred times the solver's tolerance on forces.
    assert resultants.force == pytest.approx(-scene.vector(side=0.35, up=-1.0), abs=1e-7)


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_load_that_tips_the_body_is_refused(cell):
    """A load whose line of action leaves the base, with sufficient friction, names the rotation.

    A side force H at the top of a unit block tips it over the edge from H = V/2 on.
    """
    scene = block(cell, up=-1.0, side=0.6)
    problem, _ = scene.problem(coulomb_law(2.0), [])
    assert_raised_on_all_ranks(problem.solve, ValueError, "balance", "rotation")


def test_next_increment_is_solved_after_a_refused_load():
    """A refused load leaves the state unchanged: the next, valid one is solved."""
    scene = block("quadrilateral", up=1.0)
    problem, _ = scene.problem(coulomb_law(), scene.rollers())
    assert_raised_on_all_ranks(problem.solve, ValueError, "balance")
    assert all(COMM.allgather(bool(np.all(scene.u.x.array == 0.0))))
    scene.load(up=-1.0)
    step = problem.solve()
    assert step.contacts["contact"].normal_force == pytest.approx(1.0, rel=1e-8)


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_load_and_friction_limit_are_stated(cell):
    """The error states a load of 1 to 8 % above μN, and the limit. A load below μN is solved."""
    friction, pressure = 0.3, 2.0
    words = ["balance", "translation along x", "at most 0.6"]
    for over in (1.01, 1.08):
        scene = block(cell, up=-pressure, side=over * friction * pressure)
        expected = [*words, f"{over * friction * pressure:.6g}"]
        assert_raised_on_all_ranks(
            make_solve(scene, coulomb_law(friction), []), ValueError, *expected
        )
    scene = block(cell, up=-pressure, side=0.99 * friction * pressure)
    assert make_solve(scene, coulomb_law(friction), [])().verdict.failures == []


# ---- collective errors and sums ------------------------------------------------------------------


def test_error_of_one_rank_is_raised_on_all():
    """Type and text of an error on one rank reach all ranks; without an error nothing happens."""
    last = COMM.size - 1

    def fail(kind):
        with parallel.collective_errors(COMM):
            if COMM.rank == last:
                raise kind("here only")

    assert_raised_on_all_ranks(lambda: fail(ValueError), ValueError, "here only")
    assert_raised_on_all_ranks(lambda: fail(TypeError), TypeError, "here only")
    assert_raised_on_all_ranks(lambda: fail(OSError), (OSError, RuntimeError), "here only")
    with parallel.collective_errors(COMM):
        pass


def test_reductions_over_ranks():
    """NaN on one rank dominates, empty ranks do not count; without entries it is ``empty``."""
    one = np.array([1.0 + COMM.rank])
    assert parallel.global_max(COMM, one) == COMM.size
    assert parallel.global_min(COMM, one) == 1.0
    nothing = np.zeros(0)
    some = one if COMM.rank == 0 else nothing
    assert parallel.global_max(COMM, some) == parallel.global_min(COMM, some) == 1.0
    assert parallel.global_max(COMM, nothing, empty=7.0) == 7.0
    assert parallel.global_min(COMM, nothing, empty=7.0) == 7.0
    bad = np.array([np.nan]) if COMM.rank == COMM.size - 1 else one
    assert np.isnan(parallel.global_max(COMM, bad))
    assert np.isnan(parallel.global_min(COMM, bad))
    rows = parallel.gather_rows(COMM, np.full((COMM.rank + 1, 2), float(COMM.rank)))
    assert rows.shape == (COMM.size * (COMM.size + 1) // 2, 2)


@pytest.mark.parametrize("field", [True, False])
def test_mesh_moved_between_increments_is_refused(field):
    """Points, gaps and stiffness belong to the original nodes: moved nodes are refused."""
    scene = pressed_block()
    problem, contact = scene.problem(coulomb_law(), scene.rollers())
    problem.solve(recover_interior=field)
    problem.commit()
    before = contact.history.rows()
    scene.mesh.geometry.x[:, 0] *= 1.3
    assert_raised_on_all_ranks(
        lambda: problem.solve(recover_interior=field), ValueError, "moved", "0.3"
    )
    assert np.array_equal(contact.history.rows(), before) and problem.increment == 1
    scene.mesh.geometry.x[:, 0] /= 1.3
    fc.ContactSurface(scene.mesh, scene.tags, BOTTOM)  # the scaled mesh is reset
