"""Loads, conditions and values that have no solution: an error that names them, on every rank."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact import parallel
from scenes.blocks import BOTTOM, LEFT, RIGHT, TOP, block, block_mesh
from scenes.comparing import raised_everywhere
from scenes.elasticity import strain, stress
from scenes.sound import MESH, build_and_solve, coulomb, pressed

pytestmark = [
    pytest.mark.newest,
    pytest.mark.two_ranks,
    pytest.mark.timeout(120),
]
COMM = MPI.COMM_WORLD


def test_the_good_scene_is_solved():
    """What the tests below spoil in one respect is sound otherwise: it carries its load, 1."""
    step = build_and_solve(pressed())()
    # Equilibrium to the solver's tolerance, 1e-9 of the forces.
    assert step.contacts["contact"].normal_force == pytest.approx(1.0, rel=1e-8)


def test_a_load_that_is_zero_in_ufl():
    """Its integral is empty, and the only one over its kind of facets: no load, no error.

    The top moves down by 1e-3 of a height of 1, held aside at x = 0 and free at the other side:
    plane strain and a penalty of 1e4 in series, 1/(1/k_n + (1 - ν²)/E), to the solver's 1e-9.
    """
    scene = block("quadrilateral", 1, **MESH)
    v = ufl.TestFunction(scene.u.function_space)
    F = ufl.inner(stress(scene.u, scene.E, scene.nu), strain(v)) * ufl.dx
    F -= 0 * v[0] * ufl.ds(scene.mesh, subdomain_data=scene.tags)(TOP)
    bcs = [*scene.rollers(), scene.hold(TOP, 1, -1e-3)]
    contact = scene.contact(fc.Frictionless(k_n=1e4))
    step = fc.ContactProblem(F, scene.u, bcs=bcs, contacts=[contact]).solve()
    exact = 1e-3 / (1e-4 + (1 - 0.3**2) / 1000)
    assert step.contacts["contact"].normal_force == pytest.approx(exact, rel=1e-8)


def test_form_without_stiffness():
    """A modulus of zero is found before it becomes a singular matrix."""
    scene = pressed(E=0.0)
    raised_everywhere(build_and_solve(scene), ValueError, "stiffness")


# ---- not finite ----------------------------------------------------------------------------------


@pytest.mark.each
@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["traction", "body_force", "E", "nu"])
def test_constants_not_finite(name, value):
    """A load or modulus constant that is not finite: refused at once, and by a later solve."""
    scene = pressed()
    constant = getattr(scene, name)
    good = constant.value.copy()
    constant.value = np.full_like(constant.value, value)
    raised_everywhere(build_and_solve(scene), ValueError, "finite", "constant")
    constant.value = good
    problem, _ = scene.problem(coulomb(), scene.rollers())
    problem.solve()
    problem.commit()
    before = scene.u.x.array.copy()
    constant.value = np.full_like(constant.value, value)
    raised_everywhere(problem.solve, ValueError, "finite", "constant")
    assert all(COMM.allgather(bool(np.array_equal(scene.u.x.array, before))))
    # Once it is mended the problem goes on.
    constant.value = good
    problem.solve()


def test_a_stiffness_without_bound():
    """ν = 0.5, set between increments, makes λ infinite: the message says where to look."""
    scene = pressed()
    problem, _ = scene.problem(coulomb(), scene.rollers())
    problem.solve()
    problem.commit()
    scene.nu.value = 0.5
    raised_everywhere(problem.solve, ValueError, "F at u = 0", "not finite", "ν = 0.5")


@pytest.mark.parametrize("way", [1e8, 1e9])
def test_a_mesh_far_from_the_origin(way):
    """Where coordinates are round-off the mesh is refused; nearer the load is borne.

    Coordinates have 1e-8 of the mesh there; forces are in balance to 1e-8 of the load.
    """
    mesh, tags = block_mesh("quadrilateral", **MESH)
    mesh.geometry.x[:, :2] += way
    u = fem.Function(fem.functionspace(mesh, ("Lagrange", 1, (2,))))
    v = ufl.TestFunction(u.function_space)
    F = ufl.inner(stress(u, 1000.0, 0.3), strain(v)) * ufl.dx
    F += v[1] * ufl.ds(mesh, subdomain_data=tags)(TOP)
    obstacle = fc.HalfSpace((way, way), (0, 1))
    contact = fc.Contact(u, fc.ContactSurface(mesh, tags, BOTTOM), obstacle, coulomb())

    def call():
        return fc.ContactProblem(F, u, contacts=[contact]).solve()

    if way > 1e8:
        raised_everywhere(call, ValueError, "contact", "origin", "1e+09")
    else:
        assert call().contacts["contact"].normal_force == pytest.approx(1.0, rel=1e-8)


@pytest.mark.parametrize("what", ["load", "modulus"])
def test_function_not_finite_on_one_rank(what):
    """One NaN in a coefficient function, in one cell of one rank: named, on all ranks."""
    scene = pressed()
    field = fem.Function(fem.functionspace(scene.mesh, ("DG", 0)), name=f"the {what}")
    field.x.array[:] = 1.0
    centers = field.function_space.tabulate_dof_coordinates()
    field.x.array[(centers[:, 0] > 0.5) & (centers[:, 1] > 0.75)] = np.nan
    v = ufl.TestFunction(scene.u.function_space)
    dx = ufl.dx(scene.mesh)
    if what == "load":
        scene.F -= field * v[1] * dx
    else:
        scene.F += ufl.inner(field * strain(scene.u), strain(v)) * dx
    raised_everywhere(build_and_solve(scene), ValueError, f"the {what}", "finite")


@pytest.mark.whole
@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("kind", ["constant", "function"])
def test_dirichlet_value_not_finite(kind, value):
    """A prescribed displacement that is not finite; by a function at one dof, so on one rank."""
    scene = pressed()
    if kind == "constant":
        bc = scene.hold(TOP, 1, value)
    else:
        given = fem.Function(scene.u.function_space)
        x = scene.u.function_space.tabulate_dof_coordinates()
        corner = np.flatnonzero(np.isclose(x[:, 0], 1.0) & np.isclose(x[:, 1], 1.0))
        given.x.array[2 * corner] = value
        bc = fem.dirichletbc(given, scene.facet_dofs(TOP))
    raised_everywhere(
        build_and_solve(scene, bcs=[*scene.rollers(), bc]), ValueError, "Dirichlet", "finite"
    )


def test_start_not_finite_on_one_rank():
    """A u that starts with one NaN."""
    scene = pressed()
    x = scene.u.function_space.tabulate_dof_coordinates()
    corner = np.flatnonzero(np.isclose(x[:, 0], 1.0) & np.isclose(x[:, 1], 1.0))
    scene.u.x.array[2 * corner] = np.nan
    raised_everywhere(build_and_solve(scene), ValueError, "'u'", "finite")


@pytest.mark.parametrize("kinematics", ["small", "finite"])
def test_displacement_of_the_obstacle_not_finite(kinematics):
    """An obstacle moved to NaN between two increments."""
    scene = pressed()
    motion = fem.Constant(scene.mesh, np.zeros(2))
    options = {"displacement": motion, "kinematics": kinematics}
    problem, _ = scene.problem(coulomb(), scene.rollers(), contact=options)
    problem.solve()
    motion.value[1] = np.nan
    raised_everywhere(problem.solve, ValueError, "displacement", "finite")


@pytest.mark.parametrize("kinematics", ["small", "finite"])
def test_tangential_displacement_of_the_obstacle_not_finite(kinematics):
    """An obstacle moved to NaN along itself only: the gap does not show it in every arrangement."""
    scene = pressed()
    motion = fem.Constant(scene.mesh, np.zeros(2))
    options = {"displacement": motion, "kinematics": kinematics}
    problem, _ = scene.problem(coulomb(), scene.rollers(), contact=options)
    problem.solve()
    motion.value[0] = np.nan
    raised_everywhere(problem.solve, ValueError, "finite")


# ---- Dirichlet conditions on Γc ------------------------------------------------------------------


def test_contact_surface_clamped():
    """Γc with all displacements prescribed, by one condition or by components: refused."""
    scene = pressed()
    dofs = scene.facet_dofs(BOTTOM)
    clamp = fem.dirichletbc(np.zeros(2), dofs, scene.u.function_space)
    for bcs in ([clamp], [scene.hold(BOTTOM, 0), scene.hold(BOTTOM, 1)]):
        raised_everywhere(
            lambda bcs=bcs: scene.problem(coulomb(), bcs), ValueError, "contact", "Dirichlet"
        )


def test_contact_surface_overlapping_in_part():
    """One facet of Γc clamped, on one rank: found by all."""
    scene = pressed()
    surface = fc.ContactSurface(scene.mesh, scene.tags, [BOTTOM, RIGHT])
    contact = fc.Contact(scene.u, surface, scene.floor(), coulomb())
    x = scene.u.function_space.tabulate_dof_coordinates()
    n_owned = scene.u.function_space.dofmap.index_map.size_local
    ends = np.flatnonzero((x[:n_owned, 1] > 0.7) & (x[:n_owned, 0] > 0.9)).astype(np.int32)
    clamp = fem.dirichletbc(np.zeros(2), ends, scene.u.function_space)
    raised_everywhere(
        lambda: fc.ContactProblem(scene.F, scene.u, bcs=[clamp], contacts=[contact]),
        ValueError,
        "1 facets",
    )


def test_contact_surface_held_in_one_component():
    """Γc held along itself only is ordinary, and so is one that shares an edge with a clamp."""
    scene = pressed()
    problem, _ = scene.problem(coulomb(), [scene.hold(BOTTOM, 0)])
    step = problem.solve()
    assert step.contacts["contact"].normal_force == pytest.approx(1.0, rel=1e-8)
    scene = pressed()
    clamp = fem.dirichletbc(np.zeros(2), scene.facet_dofs(LEFT), scene.u.function_space)
    problem, _ = scene.problem(coulomb(), [clamp])
    problem.solve()


# ---- loads and motions that nothing can hold -----------------------------------------------------


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_load_that_pulls_the_body_off(cell):
    """A load away from the obstacle, nothing else holding: no contact force can balance it."""
    scene = block(cell, up=1.0)
    raised_everywhere(build_and_solve(scene), ValueError, "balance", "translation along")
    scene = block(cell, up=1.0)
    raised_everywhere(build_and_solve(scene, bcs=[]), ValueError, "balance")
    # Held at the top it is a matter of elasticity.
    scene = block(cell, up=1.0)
    held = [*scene.rollers(), scene.hold(TOP, scene.dim - 1)]
    step = build_and_solve(scene, bcs=held)()
    assert step.contacts["contact"].normal_force <= 1e-8


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_no_friction_against_a_free_motion(cell):
    """A body that can slide: the motions that nothing will ever hold are named."""
    scene = block(cell, up=-1.0, side=0.1)
    words = ["translation along x"] + (["translation along y"] if scene.dim == 3 else [])
    frictionless = fc.Frictionless(k_n=1e4)
    raised_everywhere(lambda: scene.problem(frictionless, []), ValueError, "constrain", *words)
    # μ = 0 is no friction either.
    raised_everywhere(lambda: scene.problem(coulomb(0.0), []), ValueError, "constrain", *words)
    problem, _ = scene.problem(coulomb(0.3), [])
    problem.solve()


def test_a_motion_along_a_cavity():
    """A body inside a round cavity without friction can turn about the axis: named."""
    scene = pressed()
    # The cavity's axis is the middle of the block: turning about it is felt by no point.
    cavity = fc.Ball((0.5, 0.5), 2.0, inside=True)
    raised_everywhere(
        lambda: scene.problem(fc.Frictionless(k_n=1e4), [], contact={"obstacle": cavity}),
        ValueError,
        "rotation about z",
    )


def test_a_body_without_contact_or_conditions():
    """Nothing holds it at all: every motion is named."""
    scene = pressed()
    raised_everywhere(
        lambda: fc.ContactProblem(scene.F, scene.u),
        ValueError,
        "translation along x",
        "translation along y",
        "rotation about z",
    )


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_load_that_slides_the_body(cell):
    """A tangential load beyond μ times the normal one, nothing else holding; below it is held.

    By a sixth beyond: in space the check encloses the cone by a polygon that is 8 % too wide.
    """
    scene = block(cell, up=-1.0, side=0.35)
    problem, _ = scene.problem(coulomb(0.3), [])
    raised_everywhere(problem.solve, ValueError, "balance", "translation along x")
    # By more friction, not by less load: the load at the top turns the block over (0.35 < 0.5).
    held, _ = scene.problem(coulomb(0.5), [])
    step = held.solve()
    resultants = step.contacts["contact"]
    # Equilibrium; 1e-7 is a hundred times the solver's tolerance on forces.
    assert resultants.force == pytest.approx(-scene.vector(side=0.35, up=-1.0), abs=1e-7)


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_load_that_tips_the_body(cell):
    """A load whose line of action leaves the base, with friction enough: the rotation is named.

    On a unit block the side force H at the top tips it over the edge from H = V/2 on.
    """
    scene = block(cell, up=-1.0, side=0.6)
    problem, _ = scene.problem(coulomb(2.0), [])
    raised_everywhere(problem.solve, ValueError, "balance", "rotation")


def test_balanced_after_a_bad_load():
    """A refused load leaves no trace: the next, sound one is solved."""
    scene = block("quadrilateral", up=1.0)
    problem, _ = scene.problem(coulomb(), scene.rollers())
    raised_everywhere(problem.solve, ValueError, "balance")
    assert all(COMM.allgather(bool(np.all(scene.u.x.array == 0.0))))
    scene.load(up=-1.0)
    step = problem.solve()
    assert step.contacts["contact"].normal_force == pytest.approx(1.0, rel=1e-8)


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_load_beyond_friction(cell):
    """Pushed along by 1 to 8 % more than μN: both are named. What friction can bear is solved."""
    friction, pressure = 0.3, 2.0
    words = ["balance", "translation along x", "at most 0.6"]
    for over in (1.01, 1.08):
        scene = block(cell, up=-pressure, side=over * friction * pressure)
        told = [*words, f"{over * friction * pressure:.6g}"]
        raised_everywhere(build_and_solve(scene, coulomb(friction), []), ValueError, *told)
    scene = block(cell, up=-pressure, side=0.99 * friction * pressure)
    assert build_and_solve(scene, coulomb(friction), [])().verdict.failures == []


# ---- errors and sums of all ranks ----------------------------------------------------------------


def test_collective_errors_on_one_rank():
    """An error of one rank reaches all of them, kind and text; without one nothing happens."""
    last = COMM.size - 1

    def fail(kind):
        with parallel.collective_errors(COMM):
            if COMM.rank == last:
                raise kind("here only")

    raised_everywhere(lambda: fail(ValueError), ValueError, "here only")
    raised_everywhere(lambda: fail(TypeError), TypeError, "here only")
    raised_everywhere(lambda: fail(OSError), (OSError, RuntimeError), "here only")
    with parallel.collective_errors(COMM):
        pass


def test_reductions_over_ranks():
    """NaN on one rank wins, a rank without entries does not count, none at all gives ``empty``."""
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
def test_nodes_that_are_moved(field):
    """Points, gaps and the stiffness are of where nodes were: moved ones are refused, not mixed."""
    scene = pressed()
    problem, contact = scene.problem(coulomb(), scene.rollers())
    problem.solve(recover_interior=field)
    problem.commit()
    before = contact.history.rows()
    scene.mesh.geometry.x[:, 0] *= 1.3
    raised_everywhere(lambda: problem.solve(recover_interior=field), ValueError, "moved", "0.3")
    assert np.array_equal(contact.history.rows(), before) and problem.increment == 1
    scene.mesh.geometry.x[:, 0] /= 1.3
    fc.ContactSurface(scene.mesh, scene.tags, BOTTOM)  # of the mesh as it is now
