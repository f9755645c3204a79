"""Errors on all ranks name arguments that are swapped, missing, mistyped or of another mesh."""

import subprocess
import sys
from collections.abc import Callable

import basix.ufl
import dolfinx
import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.elasticity import NeoHookean
from scenes.blocks import BOTTOM, TOP, Block, block
from scenes.comparison import assert_raised_on_all_ranks
from scenes.elasticity import displacement_space, strain, stress
from scenes.processes import subprocess_environment
from scenes.valid_problem import LAYERED_MESH, coulomb_law, pressed_block

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]
COMM = MPI.COMM_WORLD


# ---- the displacement ----------------------------------------------------------------------------


def contact_with(u, scene: Block) -> Callable:
    return lambda: fc.Contact(u, scene.surface, scene.floor(), coulomb_law())


@pytest.mark.whole
@pytest.mark.parametrize(
    ("element", "words"),
    [
        (("Lagrange", 1), ("u has shape ()",)),
        (("Lagrange", 1, (3,)), ("u has shape (3,)",)),
        (("Lagrange", 1, (2, 2)), ("u has shape (2, 2)",)),
        (("RT", 1), ("Lagrange",)),
        (("N1curl", 1), ("Lagrange",)),
        (("DG", 0, (2,)), ("degree 0",)),
        (("DG", 1, (2,)), ("Lagrange",)),
    ],
    ids=["scalar", "three components", "tensor", "RT", "N1curl", "DG0", "DG1"],
)
def test_displacement_must_be_vector_valued_lagrange(element, words):
    """A u is refused unless it is continuous, Lagrange and a vector of the mesh's dimension."""
    scene = block("triangle", **LAYERED_MESH)
    u = fem.Function(fem.functionspace(scene.mesh, element))
    assert_raised_on_all_ranks(contact_with(u, scene), ValueError, "u ", *words)


def test_crouzeix_raviart_displacement_is_refused():
    """Continuity at facet midpoints alone is not enough for a displacement on Γc."""
    scene = block("triangle", **LAYERED_MESH)
    u = fem.Function(fem.functionspace(scene.mesh, ("CR", 1, (2,))))
    assert_raised_on_all_ranks(contact_with(u, scene), ValueError, "u ", "Lagrange")


def test_single_precision_displacement_is_refused():
    """A u in single precision is refused: compiled forms and PETSc use double precision."""
    mesh = dolfinx.mesh.create_unit_square(COMM, 4, 4, dtype=np.float32)
    mesh.topology.create_connectivity(1, 2)
    facets = dolfinx.mesh.exterior_facet_indices(mesh.topology)
    tags = dolfinx.mesh.meshtags(mesh, 1, facets, np.ones(len(facets), dtype=np.int32))
    u = fem.Function(displacement_space(mesh, 1), dtype=np.float32)
    floor = fc.HalfSpace((0, 0), (0, 1))

    def call():
        return fc.Contact(u, fc.ContactSurface(mesh, tags, 1), floor, fc.Frictionless())

    assert_raised_on_all_ranks(call, ValueError, "float32", "float64")


def test_displacement_on_another_mesh_is_refused():
    """A u on a mesh other than that of the surface is refused."""
    scene, other = pressed_block(), pressed_block()
    assert_raised_on_all_ranks(contact_with(other.u, scene), ValueError, "mesh")


def test_displacement_must_be_a_function():
    """A trial function, an expression or an array is refused as u."""
    scene = pressed_block()
    for u in (ufl.TrialFunction(scene.u.function_space), 2 * scene.u, scene.u.x.array):
        assert_raised_on_all_ranks(contact_with(u, scene), ValueError, "u is a")


def test_displacement_of_contact_must_be_that_of_the_problem():
    """The u of a contact must be that of the problem, not another function of the same space."""
    scene = pressed_block()
    other = fem.Function(scene.u.function_space)
    contact = fc.Contact(other, scene.surface, scene.floor(), coulomb_law())
    assert_raised_on_all_ranks(
        lambda: fc.ContactProblem(scene.F, scene.u, bcs=scene.rollers(), contacts=[contact]),
        ValueError,
        "contact: its u",
    )


def test_wrong_uses_of_mixed_elements_are_refused():
    """A mixed function, its ``sub(i)``, expressions and scalars are refused with the correct call.

    So are forms, options and Dirichlet conditions that do not fit a mixed function.
    """
    scene = pressed_block()
    line = basix.ufl.element("P", "quadrilateral", 1)
    vector = basix.ufl.element("P", "quadrilateral", 2, shape=(2,))
    both = fem.Function(fem.functionspace(scene.mesh, basix.ufl.mixed_element([vector, line])))
    scalars = fem.Function(fem.functionspace(scene.mesh, basix.ufl.mixed_element([line, line])))
    split = "u, p = ufl.split(w)"
    u, p = ufl.split(both)
    for mixed in (both, scalars):
        assert_raised_on_all_ranks(contact_with(mixed, scene), ValueError, "a mixed element", split)
    assert_raised_on_all_ranks(contact_with(both.sub(0), scene), ValueError, "w.sub(i)", split)
    for none in (2 * u, u + scene.u, ufl.as_vector([both[1], both[0]])):
        assert_raised_on_all_ranks(contact_with(none, scene), ValueError, "u is a", split)
    assert_raised_on_all_ranks(contact_with(p, scene), ValueError, "shape ()")
    v, q = ufl.TestFunctions(both.function_space)
    F = ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx + p * q * ufl.dx
    contact = contact_with(u, scene)()

    def problem(F, u, **options):
        return lambda: fc.ContactProblem(F, u, contacts=[contact], **options)

    assert_raised_on_all_ranks(problem(F, u), ValueError, "the function that is solved for")
    assert_raised_on_all_ranks(
        problem([F, F], [scene.u]), ValueError, "its u is not the u of the problem"
    )
    assert_raised_on_all_ranks(problem([F, F], both), ValueError, "F is a list", "one function w")
    other = ufl.TestFunction(scene.u.function_space)
    assert_raised_on_all_ranks(
        problem(ufl.inner(ufl.grad(u), ufl.grad(other)) * ufl.dx, both),
        ValueError,
        "TestFunctions(W)",
    )
    outside = F + ufl.inner(both.sub(0), v) * ufl.dx
    assert_raised_on_all_ranks(problem(outside, both), ValueError, "ignores", "ufl.split")
    alternating = problem(F, both, method="alternating")
    assert_raised_on_all_ranks(alternating, ValueError, "alternating", "saddle-point")
    assert_raised_on_all_ranks(
        problem(F, both, linear_solver="multigrid"), ValueError, "multigrid", "saddle-point"
    )
    assert_raised_on_all_ranks(
        problem(F, both, condensation=True), ValueError, "condensation", "part of a mixed function"
    )
    part, _ = both.function_space.sub(0).collapse()
    stray = fem.dirichletbc(fem.Function(part), np.arange(2, dtype=np.int32))
    assert_raised_on_all_ranks(problem(F, both, bcs=[stray]), ValueError, "Dirichlet", "W.sub(0)")


def test_fields_as_a_list_of_functions_are_refused():
    """Blocked spaces are refused with the alternative, as are functions of two displacements."""
    scene = pressed_block()
    p = fem.Function(fem.functionspace(scene.mesh, ("Lagrange", 1)))
    F = scene.F
    both = (scene.u, p)
    assert_raised_on_all_ranks(
        contact_with(both, scene), ValueError, "u is a tuple", "mixed_element"
    )
    assert_raised_on_all_ranks(
        lambda: fc.ContactProblem(F, both), ValueError, "u is a tuple", "ufl.split"
    )
    space = ufl.MixedFunctionSpace(scene.u.function_space, p.function_space)
    v, _ = ufl.TestFunctions(space)
    parts = ufl.inner(ufl.grad(scene.u), ufl.grad(v)) * ufl.dx
    assert_raised_on_all_ranks(
        lambda: fc.ContactProblem(parts, scene.u), ValueError, "several spaces", "mixed"
    )
    vector = basix.ufl.element("P", "quadrilateral", 2, shape=(2,))
    twice = fem.Function(fem.functionspace(scene.mesh, basix.ufl.mixed_element([vector, vector])))
    v = ufl.TestFunction(twice.function_space)
    F = ufl.inner(ufl.grad(twice), ufl.grad(v)) * ufl.dx
    assert_raised_on_all_ranks(lambda: fc.ContactProblem(F, twice), ValueError, "of which 2 parts")
    first, second = ufl.split(twice)
    contacts = [
        fc.Contact(u, scene.surface, scene.floor(), coulomb_law(), name=name)
        for u, name in ((first, "one"), (second, "two"))
    ]
    assert_raised_on_all_ranks(
        lambda: fc.ContactProblem(F, twice, contacts=contacts), ValueError, "two: its u is another"
    )


# ---- arguments of wrong types --------------------------------------------------------------------


def test_wrong_arguments_of_a_contact_are_named():
    """Swapped or missing arguments and classes instead of objects are named, with the order."""
    scene = pressed_block()
    u, surface, floor, law = scene.u, scene.surface, scene.floor(), coulomb_law()
    for arguments, words in (
        (
            (u, surface, law, floor),
            ("obstacle is a Coulomb", "must be an Obstacle", "(u, surface,"),
        ),
        ((surface, u, floor, law), ("u is a ContactSurface", "must be a Function")),
        ((u, scene.mesh, floor, law), ("surface is a Mesh", "must be a ContactSurface")),
        ((u, surface, None, law), ("obstacle is a NoneType",)),
        ((u, surface, floor, 0.3), ("law is a float", "must be a Law")),
        ((u, surface, floor, fc.Frictionless), ("law is the class Frictionless", "(...)")),
        ((u, surface, fc.HalfSpace, law), ("obstacle is the class HalfSpace",)),
    ):
        assert_raised_on_all_ranks(
            lambda a=arguments: fc.Contact(*a), ValueError, "contact: ", *words
        )
    assert_raised_on_all_ranks(lambda: scene.contact(law, name=3), ValueError, "name is a int")
    assert_raised_on_all_ranks(
        lambda: scene.contact(law, tolerance="1e-3"), ValueError, "tolerance is '1e-"
    )


def test_wrong_arguments_of_a_problem_are_named():
    """Single objects instead of lists, wrong types in lists and non-mappings are named."""
    scene = pressed_block()
    contact, bcs = scene.contact(coulomb_law()), scene.rollers()
    for arguments, words in (
        ({"contacts": contact}, ("contacts is a single Contact", "contacts=[...]")),
        ({"contacts": None}, ("contacts is None", "list of Contact")),
        ({"contacts": [coulomb_law()]}, ("contacts[0] is a Coulomb",)),
        ({"bcs": bcs[0]}, ("bcs is a single DirichletBC", "bcs=[...]")),
        ({"bcs": [*bcs, 0]}, (f"bcs[{len(bcs)}] is a int",)),
        ({"petsc_options": "-snes_monitor"}, ("petsc_options is a str", "Mapping")),
        ({"prefix": None}, ("prefix is a NoneType",)),
        ({"method": ["newton"]}, ("method is ['newton']",)),
    ):
        call = {"bcs": bcs, "contacts": [contact]} | arguments
        assert_raised_on_all_ranks(
            lambda c=call: fc.ContactProblem(scene.F, scene.u, **c), ValueError, *words
        )
    assert_raised_on_all_ranks(
        lambda: fc.ContactProblem(scene.u, scene.F), ValueError, "u is a Form"
    )


def test_wrong_arguments_of_a_surface_are_named():
    """Swapped mesh and tags, facets instead of tags, and tags that are not integers are named."""
    scene = pressed_block()
    mesh, tags = scene.mesh, scene.tags
    for arguments, word in (
        ((tags, mesh, BOTTOM), "mesh is a MeshTags"),
        ((mesh, tags.find(BOTTOM), BOTTOM), "facet_tags is a ndarray"),
        ((mesh, tags, "bottom"), "tags is 'bottom'"),
        ((mesh, tags, 1.5), "tags is 1.5"),
        ((mesh, tags, None), "tags is None"),
        ((mesh, tags, []), "Γc is empty"),
    ):
        assert_raised_on_all_ranks(lambda a=arguments: fc.ContactSurface(*a), ValueError, word)
    for body, word in (((TOP, tags), "facet_tags is a int"), ((tags, "top"), "tags is 'top'")):
        obstacle = fc.DeformableBody(*body)
        assert_raised_on_all_ranks(
            lambda s=obstacle: scene.contact(coulomb_law(), obstacle=s), ValueError, word
        )
    assert_raised_on_all_ranks(
        lambda: fc.DeformableBody(tags, TOP, search_distance="far"),
        ValueError,
        "search_distance is 'f",
    )


@pytest.mark.whole
@pytest.mark.parametrize("degree", [1, 2.5, 2.0, "2", True, 0, -1])
def test_quadrature_degree_must_be_an_integer_of_at_least_two(degree):
    """The degree is an integer of at least 2: one point does not resist a tilt of its facet."""
    scene = pressed_block()
    assert_raised_on_all_ranks(
        lambda: fc.ContactSurface(scene.mesh, scene.tags, BOTTOM, quadrature_degree=degree),
        ValueError,
        f"quadrature_degree is {degree!r}",
        "an integer",
    )


def test_parameters_of_obstacles_must_be_numbers():
    """Strings as points, radii, forces or moduli are named, and a scalar instead of a list."""
    scene = pressed_block()
    for obstacle, word in (
        (fc.HalfSpace("origin", (0, 1)), "point of the HalfSpace is 'origin'"),
        (fc.HalfSpace((0, "0"), (0, 1)), "point of the HalfSpace is (0, '0')"),
        (fc.Ball((0, -1), "1"), "radius of the Ball is '1'"),
        (scene.floor(displacement=fc.Motion(5.0)), "Motion has 0 forces"),
        (scene.floor(displacement=fc.Motion((None, "5"))), "force 1 of the Motion is '5'"),
    ):
        assert_raised_on_all_ranks(
            lambda s=obstacle: scene.contact(coulomb_law(), obstacle=s),
            (ValueError, TypeError),
            word,
        )
    assert_raised_on_all_ranks(
        lambda: fc.elasticity.LinearElastic(scene.u, "E", 0.3, "plane strain"),
        ValueError,
        "E is 'E",
    )


@pytest.mark.parametrize("constrained", [True, False])
def test_reversed_obstacle_is_refused_or_warned_of(constrained, caplog):
    """The normal of a floor points down, or a ball is solid that should surround the body.

    If the body is inside the obstacle, it is refused. If a reversed floor just touches the
    body, there is a warning.
    """
    scene = pressed_block()
    bcs = [*scene.rollers(), scene.dirichlet_bc(TOP, 1)] if constrained else scene.rollers()
    for obstacle in (fc.HalfSpace((0, -0.5), (0, -1)), fc.Ball((0.5, 0.5), 2.0)):
        assert_raised_on_all_ranks(
            lambda s=obstacle: scene.problem(coulomb_law(), bcs, contact={"obstacle": s}),
            ValueError,
            "contact: the normal from the body to the obstacle points into the body",
            "inside of the obstacle",
        )
    with caplog.at_level("WARNING", logger="fenics_contact"):
        scene.problem(coulomb_law(), bcs, contact={"obstacle": fc.HalfSpace((0, 0), (0, -1))})
    assert ("points into the body" in caplog.text) == (COMM.rank == 0)
    caplog.clear()
    scene.problem(coulomb_law(), bcs, contact={"obstacle": fc.Ball((0.5, 0.5), 2.0, inside=True)})
    assert "points into the body" not in caplog.text


@pytest.mark.skipif(COMM.size > 1, reason="starts a process of its own")
@pytest.mark.parametrize("version", ["0.8.0", "0.5.2.dev0"])
def test_old_dolfinx_is_refused_at_import(version):
    """The import raises one sentence that states the required version of DOLFINx."""
    script = f"import dolfinx; dolfinx.__version__ = {version!r}; import fenics_contact"
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, env=subprocess_environment(), capture_output=True, text=True)
    last = done.stderr.strip().splitlines()[-1]
    assert "ImportError: fenics_contact needs DOLFINx 0.9 or later" in last and version in last


# ---- the form ------------------------------------------------------------------------------------


def with_form(scene: Block, F) -> Callable:
    return lambda: fc.ContactProblem(
        F, scene.u, bcs=scene.rollers(), contacts=[scene.contact(coulomb_law())]
    )


def test_form_must_be_a_residual_with_one_test_function():
    """F must be a residual in u and one test function of u's space; other forms are named."""
    scene = pressed_block()
    space = scene.u.function_space
    v, du = ufl.TestFunction(space), ufl.TrialFunction(space)
    dx = ufl.dx(scene.mesh)
    bilinear = ufl.inner(stress(du, scene.E, scene.nu), strain(v)) * dx
    energy = ufl.inner(stress(scene.u, scene.E, scene.nu), strain(scene.u)) * dx
    load = ufl.dot(scene.traction, v) * dx
    assert_raised_on_all_ranks(with_form(scene, bilinear), ValueError, "F ", "2 arguments")
    assert_raised_on_all_ranks(with_form(scene, energy), ValueError, "F ", "no TestFunction")
    assert_raised_on_all_ranks(with_form(scene, load), ValueError, "F ", "does not depend on u")
    assert_raised_on_all_ranks(with_form(scene, 0), ValueError, "F ", "int")
    assert_raised_on_all_ranks(with_form(scene, ufl.lhs(bilinear) == load), ValueError, "F ")
    other = ufl.TestFunction(displacement_space(scene.mesh, 2))
    mixed = ufl.inner(stress(scene.u, scene.E, scene.nu), strain(other)) * dx
    assert_raised_on_all_ranks(with_form(scene, mixed), ValueError, "TestFunction")


def test_form_in_another_function_is_refused():
    """F in a function of the same space other than u is refused."""
    scene = pressed_block()
    other = fem.Function(scene.u.function_space)
    assert_raised_on_all_ranks(
        with_form(scene, ufl.replace(scene.F, {scene.u: other})), ValueError, "depend on u"
    )


def test_condition_on_another_space_is_refused():
    """A Dirichlet condition of another, larger space is refused."""
    scene = pressed_block()
    other = displacement_space(scene.mesh, 3)
    facets = scene.tags.find(TOP)
    dofs = fem.locate_dofs_topological(other, 1, facets)
    bc = fem.dirichletbc(np.zeros(2), dofs, other)
    assert_raised_on_all_ranks(
        lambda: scene.problem(coulomb_law(), [bc]), ValueError, "Dirichlet", "space"
    )


def test_condition_on_a_scalar_space_is_refused():
    """A scalar space of the same nodes is refused: its dof numbers refer to other dofs of u."""
    scene = pressed_block()
    space = fem.functionspace(scene.mesh, ("Lagrange", 1))
    component, _ = scene.u.function_space.sub(0).collapse()
    for other in (space, component):
        dofs = fem.locate_dofs_topological(other, 1, scene.tags.find(TOP))
        bc = fem.dirichletbc(0.0, dofs, other)
        assert_raised_on_all_ranks(
            lambda bc=bc: scene.problem(coulomb_law(), [bc]), ValueError, "Dirichlet", "V.sub(i)"
        )


# ---- the problem ---------------------------------------------------------------------------------


def test_contact_names_must_be_unique():
    """Results are stored by name, so that two contacts of the same name are refused."""
    scene = pressed_block()
    contacts = [scene.contact(coulomb_law(), name="foot") for _ in range(2)]
    assert_raised_on_all_ranks(
        lambda: fc.ContactProblem(scene.F, scene.u, bcs=scene.rollers(), contacts=contacts),
        ValueError,
        "foot",
        "name",
    )


def test_unknown_method_is_refused():
    """The error lists the available methods."""
    scene = pressed_block()
    assert_raised_on_all_ranks(
        lambda: scene.problem(coulomb_law(), scene.rollers(), method="bfgs"),
        ValueError,
        "'bfgs'",
        "lbfgs",
        "newton",
    )


@pytest.mark.whole
@pytest.mark.parametrize("value", [-0.1, 1.1, np.nan, "1"])
@pytest.mark.parametrize("name", ["alpha", "phi"])
def test_alpha_and_phi_must_lie_between_zero_and_one(name, value):
    """α and φ are ratios between 0 and 1 (section 5)."""
    scene = pressed_block()
    assert_raised_on_all_ranks(
        lambda: scene.problem(coulomb_law(), scene.rollers(), **{name: value}), ValueError, name
    )


@pytest.mark.whole
@pytest.mark.parametrize("value", [0, -0.1, np.nan, "20 %", True])
def test_small_displacement_tolerance_must_be_positive(value):
    """The small-displacement tolerance is positive and may be infinite."""
    scene = pressed_block()
    assert_raised_on_all_ranks(
        lambda: scene.problem(coulomb_law(), scene.rollers(), small_displacement_tolerance=value),
        ValueError,
        "small_displacement_tolerance",
        "infinity",
    )


def ball(scene: Block, value) -> None:
    scene.contact(coulomb_law(), obstacle=fc.Ball((0.0, -1.0), 1.0, inside=value))


def cylinder(scene: Block, value) -> None:
    scene.contact(coulomb_law(), obstacle=fc.Cylinder((0.0, -1.0), 1.0, inside=value))


def profile(scene: Block, value) -> None:
    fc.RigidProfile([(0, 0), (1, 0), (0, 1)], closed=value)


def tresca(scene: Block, value) -> None:
    fc.Tresca(0.3, 1.0, unilateral=value)


def foundation(scene: Block, value) -> None:
    fc.Foundation(1e4, tension=value)


def neo_hookean(scene: Block, value) -> None:
    NeoHookean(scene.u, 1.0, 0.3, "plane strain", isochoric=value)


def pairs(scene: Block, value) -> None:
    fc.find_contact_pairs(scene.u, coulomb_law(), 0.1, self_contact=value)


def problem_with(name: str) -> Callable:
    return lambda scene, value: scene.problem(coulomb_law(), scene.rollers(), **{name: value})


def estimated(scene: Block, value) -> None:
    problem, _ = scene.problem(coulomb_law(), scene.rollers())
    fc.increments(problem, scene.E, 1, 2, estimate=value)


@pytest.mark.whole
@pytest.mark.parametrize("value", ["no", 1])
@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("inside of the Ball", ball),
        ("inside of the Cylinder", cylinder),
        ("closed of the RigidProfile", profile),
        ("unilateral of the Tresca", tresca),
        ("tension of the Foundation", foundation),
        ("isochoric", neo_hookean),
        ("self_contact", pairs),
        ("fallback", problem_with("fallback")),
        ("condensation", problem_with("condensation")),
        ("cross_check", problem_with("cross_check")),
        ("estimate", estimated),
    ],
)
def test_boolean_options_must_be_true_or_false(name, call, value):
    """Strings and numbers are refused, not converted to booleans: "no" would be true."""
    words = f"{name} is {value!r}", "True or False"
    assert_raised_on_all_ranks(lambda: call(pressed_block(), value), ValueError, *words)


def test_increments_need_a_scalar_load_and_a_step():
    """`increments` needs a scalar constant and at least one step."""
    scene = pressed_block()
    problem, _ = scene.problem(coulomb_law(), scene.rollers())
    assert_raised_on_all_ranks(
        lambda: list(fc.increments(problem, scene.traction, 0, 1)), ValueError, "load"
    )
    assert_raised_on_all_ranks(
        lambda: list(fc.increments(problem, scene.E, 1, 2, steps=0)), ValueError, "steps"
    )
