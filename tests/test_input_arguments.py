"""What is no argument at all: swapped, missing, of another mesh or kind; named, on every rank."""

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
from scenes.comparing import raised_everywhere
from scenes.elasticity import displacement_space, strain, stress
from scenes.processes import environment
from scenes.sound import MESH, coulomb, pressed

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]
COMM = MPI.COMM_WORLD


# ---- the displacement ----------------------------------------------------------------------------


def contact_with(u, scene: Block) -> Callable:
    return lambda: fc.Contact(u, scene.surface, scene.floor(), coulomb())


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
def test_displacement_of_a_wrong_space(element, words):
    """A u that is no continuous vector-valued Lagrange function of the mesh's dimension."""
    scene = block("triangle", **MESH)
    u = fem.Function(fem.functionspace(scene.mesh, element))
    raised_everywhere(contact_with(u, scene), ValueError, "u ", *words)


def test_displacement_of_crouzeix_raviart():
    """Continuity at the middle of facets alone is not enough for a displacement on Γc."""
    scene = block("triangle", **MESH)
    u = fem.Function(fem.functionspace(scene.mesh, ("CR", 1, (2,))))
    raised_everywhere(contact_with(u, scene), ValueError, "u ", "Lagrange")


def test_displacement_in_single_precision():
    """Compiled forms and PETSc are in double precision."""
    mesh = dolfinx.mesh.create_unit_square(COMM, 4, 4, dtype=np.float32)
    mesh.topology.create_connectivity(1, 2)
    facets = dolfinx.mesh.exterior_facet_indices(mesh.topology)
    tags = dolfinx.mesh.meshtags(mesh, 1, facets, np.ones(len(facets), dtype=np.int32))
    u = fem.Function(displacement_space(mesh, 1), dtype=np.float32)
    floor = fc.HalfSpace((0, 0), (0, 1))

    def call():
        return fc.Contact(u, fc.ContactSurface(mesh, tags, 1), floor, fc.Frictionless())

    raised_everywhere(call, ValueError, "float32", "float64")


def test_displacement_on_another_mesh():
    """A u of a mesh that is not that of the surface."""
    scene, other = pressed(), pressed()
    raised_everywhere(contact_with(other.u, scene), ValueError, "mesh")


def test_displacement_that_is_no_function():
    """A trial function, an expression or an array is no u."""
    scene = pressed()
    for u in (ufl.TrialFunction(scene.u.function_space), 2 * scene.u, scene.u.x.array):
        raised_everywhere(contact_with(u, scene), ValueError, "u is a")


def test_displacement_of_another_problem():
    """The contact's u and the problem's are the same function, not two of one space."""
    scene = pressed()
    other = fem.Function(scene.u.function_space)
    contact = fc.Contact(other, scene.surface, scene.floor(), coulomb())
    raised_everywhere(
        lambda: fc.ContactProblem(scene.F, scene.u, bcs=scene.rollers(), contacts=[contact]),
        ValueError,
        "contact: its u",
    )


def test_displacement_in_a_mixed_element():
    """The whole of it, parts that no derivative knows, no vector: told what to give instead."""
    scene = pressed()
    line = basix.ufl.element("P", "quadrilateral", 1)
    vector = basix.ufl.element("P", "quadrilateral", 2, shape=(2,))
    both = fem.Function(fem.functionspace(scene.mesh, basix.ufl.mixed_element([vector, line])))
    scalars = fem.Function(fem.functionspace(scene.mesh, basix.ufl.mixed_element([line, line])))
    split = "u, p = ufl.split(w)"
    u, p = ufl.split(both)
    for whole in (both, scalars):
        raised_everywhere(contact_with(whole, scene), ValueError, "a mixed element", split)
    raised_everywhere(contact_with(both.sub(0), scene), ValueError, "w.sub(i)", split)
    for none in (2 * u, u + scene.u, ufl.as_vector([both[1], both[0]])):
        raised_everywhere(contact_with(none, scene), ValueError, "u is a", split)
    raised_everywhere(contact_with(p, scene), ValueError, "shape ()")
    v, q = ufl.TestFunctions(both.function_space)
    F = ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx + p * q * ufl.dx
    contact = contact_with(u, scene)()

    def problem(F, u, **options):
        return lambda: fc.ContactProblem(F, u, contacts=[contact], **options)

    raised_everywhere(problem(F, u), ValueError, "the function that is solved for")
    raised_everywhere(problem([F, F], [scene.u]), ValueError, "its u is not the u of the problem")
    raised_everywhere(problem([F, F], both), ValueError, "F is a list", "one function w")
    other = ufl.TestFunction(scene.u.function_space)
    raised_everywhere(
        problem(ufl.inner(ufl.grad(u), ufl.grad(other)) * ufl.dx, both),
        ValueError,
        "TestFunctions(W)",
    )
    outside = F + ufl.inner(both.sub(0), v) * ufl.dx
    raised_everywhere(problem(outside, both), ValueError, "ignores", "ufl.split")
    alternating = problem(F, both, method="alternating")
    raised_everywhere(alternating, ValueError, "alternating", "saddle-point")
    raised_everywhere(
        problem(F, both, linear_solver="multigrid"), ValueError, "multigrid", "saddle-point"
    )
    raised_everywhere(
        problem(F, both, condensation=True), ValueError, "condensation", "part of a mixed function"
    )
    part, _ = both.function_space.sub(0).collapse()
    stray = fem.dirichletbc(fem.Function(part), np.arange(2, dtype=np.int32))
    raised_everywhere(problem(F, both, bcs=[stray]), ValueError, "Dirichlet", "W.sub(0)")


def test_fields_as_a_list_of_functions():
    """Blocked spaces are refused with the way there is; and a function with two displacements."""
    scene = pressed()
    p = fem.Function(fem.functionspace(scene.mesh, ("Lagrange", 1)))
    F = scene.F
    both = (scene.u, p)
    raised_everywhere(contact_with(both, scene), ValueError, "u is a tuple", "mixed_element")
    raised_everywhere(lambda: fc.ContactProblem(F, both), ValueError, "u is a tuple", "ufl.split")
    space = ufl.MixedFunctionSpace(scene.u.function_space, p.function_space)
    v, _ = ufl.TestFunctions(space)
    parts = ufl.inner(ufl.grad(scene.u), ufl.grad(v)) * ufl.dx
    raised_everywhere(
        lambda: fc.ContactProblem(parts, scene.u), ValueError, "several spaces", "mixed"
    )
    vector = basix.ufl.element("P", "quadrilateral", 2, shape=(2,))
    twice = fem.Function(fem.functionspace(scene.mesh, basix.ufl.mixed_element([vector, vector])))
    v = ufl.TestFunction(twice.function_space)
    F = ufl.inner(ufl.grad(twice), ufl.grad(v)) * ufl.dx
    raised_everywhere(lambda: fc.ContactProblem(F, twice), ValueError, "of which 2 parts")
    first, second = ufl.split(twice)
    contacts = [
        fc.Contact(u, scene.surface, scene.floor(), coulomb(), name=name)
        for u, name in ((first, "one"), (second, "two"))
    ]
    raised_everywhere(
        lambda: fc.ContactProblem(F, twice, contacts=contacts), ValueError, "two: its u is another"
    )


# ---- what is no argument at all ------------------------------------------------------------------


def test_arguments_of_a_contact():
    """Swapped, missing, a class for an object: named, with the order there is."""
    scene = pressed()
    u, surface, floor, law = scene.u, scene.surface, scene.floor(), coulomb()
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
        raised_everywhere(lambda a=arguments: fc.Contact(*a), ValueError, "contact: ", *words)
    raised_everywhere(lambda: scene.contact(law, name=3), ValueError, "name is a int")
    raised_everywhere(lambda: scene.contact(law, tolerance="1e-3"), ValueError, "tolerance is '1e-")


def test_arguments_of_a_problem():
    """One contact or condition for a list of them, other things in the list, no mapping."""
    scene = pressed()
    contact, bcs = scene.contact(coulomb()), scene.rollers()
    for arguments, words in (
        ({"contacts": contact}, ("contacts is a single Contact", "contacts=[...]")),
        ({"contacts": None}, ("contacts is None", "list of Contact")),
        ({"contacts": [coulomb()]}, ("contacts[0] is a Coulomb",)),
        ({"bcs": bcs[0]}, ("bcs is a single DirichletBC", "bcs=[...]")),
        ({"bcs": [*bcs, 0]}, (f"bcs[{len(bcs)}] is a int",)),
        ({"petsc_options": "-snes_monitor"}, ("petsc_options is a str", "Mapping")),
        ({"prefix": None}, ("prefix is a NoneType",)),
        ({"method": ["newton"]}, ("method is ['newton']",)),
    ):
        call = {"bcs": bcs, "contacts": [contact]} | arguments
        raised_everywhere(
            lambda c=call: fc.ContactProblem(scene.F, scene.u, **c), ValueError, *words
        )
    raised_everywhere(lambda: fc.ContactProblem(scene.u, scene.F), ValueError, "u is a Form")


def test_arguments_of_a_surface():
    """Mesh and tags swapped, facets for tags, a tag that is no whole number."""
    scene = pressed()
    mesh, tags = scene.mesh, scene.tags
    for arguments, word in (
        ((tags, mesh, BOTTOM), "mesh is a MeshTags"),
        ((mesh, tags.find(BOTTOM), BOTTOM), "facet_tags is a ndarray"),
        ((mesh, tags, "bottom"), "tags is 'bottom'"),
        ((mesh, tags, 1.5), "tags is 1.5"),
        ((mesh, tags, None), "tags is None"),
        ((mesh, tags, []), "Γc is empty"),
    ):
        raised_everywhere(lambda a=arguments: fc.ContactSurface(*a), ValueError, word)
    for body, word in (((TOP, tags), "facet_tags is a int"), ((tags, "top"), "tags is 'top'")):
        obstacle = fc.DeformableBody(*body)
        raised_everywhere(lambda s=obstacle: scene.contact(coulomb(), obstacle=s), ValueError, word)
    raised_everywhere(
        lambda: fc.DeformableBody(tags, TOP, search_distance="far"),
        ValueError,
        "search_distance is 'f",
    )


@pytest.mark.whole
@pytest.mark.parametrize("degree", [1, 2.5, 2.0, "2", True, 0, -1])
def test_quadrature_degree(degree):
    """A degree is an integer, at least 2: one point does not resist a tilt of its facet."""
    scene = pressed()
    raised_everywhere(
        lambda: fc.ContactSurface(scene.mesh, scene.tags, BOTTOM, quadrature_degree=degree),
        ValueError,
        f"quadrature_degree is {degree!r}",
        "an integer",
    )


def test_numbers_of_obstacles():
    """Texts for numbers in points, radii and forces; no list where one is wanted."""
    scene = pressed()
    for obstacle, word in (
        (fc.HalfSpace("origin", (0, 1)), "point of the HalfSpace is 'origin'"),
        (fc.HalfSpace((0, "0"), (0, 1)), "point of the HalfSpace is (0, '0')"),
        (fc.Ball((0, -1), "1"), "radius of the Ball is '1'"),
        (scene.floor(displacement=fc.Motion(5.0)), "Motion has 0 forces"),
        (scene.floor(displacement=fc.Motion((None, "5"))), "force 1 of the Motion is '5'"),
    ):
        raised_everywhere(
            lambda s=obstacle: scene.contact(coulomb(), obstacle=s), (ValueError, TypeError), word
        )
    raised_everywhere(
        lambda: fc.elasticity.LinearElastic(scene.u, "E", 0.3, "plane strain"),
        ValueError,
        "E is 'E",
    )


@pytest.mark.parametrize("held", [True, False])
def test_an_obstacle_turned_round(held, caplog):
    """The normal of a floor points down, a ball is outside of what it should surround.

    The body is inside: refused. A floor that just touches is one that the body leaves: warned.
    """
    scene = pressed()
    bcs = [*scene.rollers(), scene.hold(TOP, 1)] if held else scene.rollers()
    for obstacle in (fc.HalfSpace((0, -0.5), (0, -1)), fc.Ball((0.5, 0.5), 2.0)):
        raised_everywhere(
            lambda s=obstacle: scene.problem(coulomb(), bcs, contact={"obstacle": s}),
            ValueError,
            "contact: the normal from the body to the obstacle points into the body",
            "inside of the obstacle",
        )
    with caplog.at_level("WARNING", logger="fenics_contact"):
        scene.problem(coulomb(), bcs, contact={"obstacle": fc.HalfSpace((0, 0), (0, -1))})
    assert ("points into the body" in caplog.text) == (COMM.rank == 0)
    caplog.clear()
    scene.problem(coulomb(), bcs, contact={"obstacle": fc.Ball((0.5, 0.5), 2.0, inside=True)})
    assert "points into the body" not in caplog.text


@pytest.mark.skipif(COMM.size > 1, reason="starts a process of its own")
@pytest.mark.parametrize("version", ["0.8.0", "0.5.2.dev0"])
def test_a_release_that_is_too_old(version):
    """One sentence at import, with what to do."""
    script = f"import dolfinx; dolfinx.__version__ = {version!r}; import fenics_contact"
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True)
    last = done.stderr.strip().splitlines()[-1]
    assert "ImportError: fenics_contact needs DOLFINx 0.9 or later" in last and version in last


# ---- the form ------------------------------------------------------------------------------------


def with_form(scene: Block, F) -> Callable:
    return lambda: fc.ContactProblem(
        F, scene.u, bcs=scene.rollers(), contacts=[scene.contact(coulomb())]
    )


def test_forms_with_wrong_arguments():
    """F is a residual in u and one test function of u's space; everything else is named."""
    scene = pressed()
    space = scene.u.function_space
    v, du = ufl.TestFunction(space), ufl.TrialFunction(space)
    dx = ufl.dx(scene.mesh)
    bilinear = ufl.inner(stress(du, scene.E, scene.nu), strain(v)) * dx
    energy = ufl.inner(stress(scene.u, scene.E, scene.nu), strain(scene.u)) * dx
    load = ufl.dot(scene.traction, v) * dx
    raised_everywhere(with_form(scene, bilinear), ValueError, "F ", "2 arguments")
    raised_everywhere(with_form(scene, energy), ValueError, "F ", "no TestFunction")
    raised_everywhere(with_form(scene, load), ValueError, "F ", "does not depend on u")
    raised_everywhere(with_form(scene, 0), ValueError, "F ", "int")
    raised_everywhere(with_form(scene, ufl.lhs(bilinear) == load), ValueError, "F ")
    other = ufl.TestFunction(displacement_space(scene.mesh, 2))
    mixed = ufl.inner(stress(scene.u, scene.E, scene.nu), strain(other)) * dx
    raised_everywhere(with_form(scene, mixed), ValueError, "TestFunction")


def test_form_in_another_function():
    """F written with a function of the same space that is not u."""
    scene = pressed()
    other = fem.Function(scene.u.function_space)
    raised_everywhere(
        with_form(scene, ufl.replace(scene.F, {scene.u: other})), ValueError, "depend on u"
    )


def test_condition_on_another_space():
    """A Dirichlet condition of another, larger space is refused."""
    scene = pressed()
    other = displacement_space(scene.mesh, 3)
    facets = scene.tags.find(TOP)
    dofs = fem.locate_dofs_topological(other, 1, facets)
    bc = fem.dirichletbc(np.zeros(2), dofs, other)
    raised_everywhere(lambda: scene.problem(coulomb(), [bc]), ValueError, "Dirichlet", "space")


def test_condition_on_a_scalar_space():
    """One of as many nodes is another all the same: its numbers of dofs are other places of u."""
    scene = pressed()
    space = fem.functionspace(scene.mesh, ("Lagrange", 1))
    component, _ = scene.u.function_space.sub(0).collapse()
    for other in (space, component):
        dofs = fem.locate_dofs_topological(other, 1, scene.tags.find(TOP))
        bc = fem.dirichletbc(0.0, dofs, other)
        raised_everywhere(
            lambda bc=bc: scene.problem(coulomb(), [bc]), ValueError, "Dirichlet", "V.sub(i)"
        )


# ---- the problem ---------------------------------------------------------------------------------


def test_two_contacts_of_one_name():
    """Results are by name, so names are unique."""
    scene = pressed()
    contacts = [scene.contact(coulomb(), name="foot") for _ in range(2)]
    raised_everywhere(
        lambda: fc.ContactProblem(scene.F, scene.u, bcs=scene.rollers(), contacts=contacts),
        ValueError,
        "foot",
        "name",
    )


def test_unknown_method():
    """The message lists the methods there are."""
    scene = pressed()
    raised_everywhere(
        lambda: scene.problem(coulomb(), scene.rollers(), method="bfgs"),
        ValueError,
        "'bfgs'",
        "lbfgs",
        "newton",
    )


@pytest.mark.whole
@pytest.mark.parametrize("value", [-0.1, 1.1, np.nan, "1"])
@pytest.mark.parametrize("name", ["alpha", "phi"])
def test_shares_out_of_range(name, value):
    """α and φ are shares, 0 to 1 (section 5)."""
    scene = pressed()
    raised_everywhere(
        lambda: scene.problem(coulomb(), scene.rollers(), **{name: value}), ValueError, name
    )


@pytest.mark.whole
@pytest.mark.parametrize("value", [0, -0.1, np.nan, "20 %", True])
def test_small_displacement_tolerance_out_of_range(value):
    """A positive number, infinite included."""
    scene = pressed()
    raised_everywhere(
        lambda: scene.problem(coulomb(), scene.rollers(), small_displacement_tolerance=value),
        ValueError,
        "small_displacement_tolerance",
        "infinity",
    )


def ball(scene: Block, value) -> None:
    scene.contact(coulomb(), obstacle=fc.Ball((0.0, -1.0), 1.0, inside=value))


def cylinder(scene: Block, value) -> None:
    scene.contact(coulomb(), obstacle=fc.Cylinder((0.0, -1.0), 1.0, inside=value))


def profile(scene: Block, value) -> None:
    fc.RigidProfile([(0, 0), (1, 0), (0, 1)], closed=value)


def tresca(scene: Block, value) -> None:
    fc.Tresca(0.3, 1.0, unilateral=value)


def foundation(scene: Block, value) -> None:
    fc.Foundation(1e4, tension=value)


def neo_hookean(scene: Block, value) -> None:
    NeoHookean(scene.u, 1.0, 0.3, "plane strain", isochoric=value)


def pairs(scene: Block, value) -> None:
    fc.find_contact_pairs(scene.u, coulomb(), 0.1, self_contact=value)


def problem_with(name: str) -> Callable:
    return lambda scene, value: scene.problem(coulomb(), scene.rollers(), **{name: value})


def estimated(scene: Block, value) -> None:
    problem, _ = scene.problem(coulomb(), scene.rollers())
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
def test_neither_true_nor_false(name, call, value):
    """Text and numbers are not taken by their truth: "no" would be true."""
    words = f"{name} is {value!r}", "True or False"
    raised_everywhere(lambda: call(pressed(), value), ValueError, *words)


def test_increments_out_of_range():
    """`increments` needs a scalar constant and at least one step."""
    scene = pressed()
    problem, _ = scene.problem(coulomb(), scene.rollers())
    raised_everywhere(
        lambda: list(fc.increments(problem, scene.traction, 0, 1)), ValueError, "load"
    )
    raised_everywhere(
        lambda: list(fc.increments(problem, scene.E, 1, 2, steps=0)), ValueError, "steps"
    )
