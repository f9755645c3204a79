"""Bad input: an error that names the thing, on every rank."""

import subprocess
import sys
from collections.abc import Callable

import basix.ufl
import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI
from running import environment

import fenics_contact as fc
from fenics_contact import parallel
from scenes.blocks import BOTTOM, LEFT, RIGHT, TOP, Block, block
from scenes.comparing import raised_everywhere
from scenes.elasticity import displacement_space, strain, stress

pytestmark = [pytest.mark.mpi, pytest.mark.timeout(120)]
COMM = MPI.COMM_WORLD

# Four layers of cells, so that on two and three ranks some rank has no part in a fault.
MESH = {"n": (2, 4)}


def pressed(**kwargs) -> Block:
    """A block pressed down with a pressure of one."""
    return block("quadrilateral", up=-1.0, **MESH, **kwargs)


def coulomb(friction=0.3, k_n=1e4, k_t=1e3) -> fc.Coulomb:
    return fc.Coulomb(friction, k_n=k_n, k_t=k_t)


def build_and_solve(scene: Block, law=None, bcs=None, contact=None, **kwargs) -> Callable:
    """A call that makes the problem and solves it once."""

    def call() -> fc.Step:
        conditions = scene.rollers() if bcs is None else bcs
        problem, _ = scene.problem(law or coulomb(), conditions, contact=contact, **kwargs)
        return problem.solve()

    return call


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


# ---- parameters of the law -----------------------------------------------------------------------

BAD_NUMBERS = [
    ("friction", -0.1),
    ("friction", np.nan),
    ("friction", np.inf),
    ("k_n", 0.0),
    ("k_n", -1.0),
    ("k_n", np.nan),
    ("k_n", np.inf),
    ("k_t", 0.0),
    ("k_t", -1.0),
    ("k_t", np.nan),
]


@pytest.mark.parametrize(("name", "value"), BAD_NUMBERS)
def test_parameter_out_of_range_by_number(name, value):
    """μ < 0, k_n ≤ 0, k_t ≤ 0 and what is not finite, as numbers: refused by `Contact`."""
    scene = pressed()
    raised_everywhere(lambda: scene.contact(coulomb(**{name: value})), ValueError, name, "contact")


@pytest.mark.parametrize(("name", "value"), BAD_NUMBERS)
def test_parameter_out_of_range_by_constant(name, value):
    """The same as a ``fem.Constant``: refused by `ContactProblem`."""
    scene = pressed()
    law = coulomb(**{name: fem.Constant(scene.mesh, float(value))})
    raised_everywhere(lambda: scene.problem(law, scene.rollers()), ValueError, name)


@pytest.mark.parametrize(("name", "value"), BAD_NUMBERS)
def test_parameter_changed_to_out_of_range(name, value):
    """The same after a change of ``contact.parameters``: refused by the next solve, u unchanged."""
    scene = pressed()
    problem, contact = scene.problem(coulomb(), scene.rollers())
    problem.solve()
    before = scene.u.x.array.copy()
    contact.parameters[name].value = value
    raised_everywhere(problem.solve, ValueError, name)
    assert all(COMM.allgather(bool(np.array_equal(scene.u.x.array, before))))


@pytest.mark.parametrize(
    ("name", "expression"),
    [
        ("friction", lambda x: x[0] - 0.5),
        ("k_n", lambda x: 1e4 * (x[0] - 0.5)),
        ("k_t", lambda x: 1e3 * (0.5 - x[0])),
        ("friction", lambda x: ufl.sqrt(x[0] - 0.5)),
        ("k_n", lambda x: 1e4 / x[1]),
    ],
    ids=["friction", "k_n", "k_t", "friction nan", "k_n inf"],
)
def test_parameter_out_of_range_by_ufl(name, expression):
    """The same by UFL, at some points only; in parallel on some ranks only."""
    scene = pressed()
    law = coulomb(**{name: expression(ufl.SpatialCoordinate(scene.mesh))})
    raised_everywhere(lambda: scene.problem(law, scene.rollers()), ValueError, name)


@pytest.mark.parametrize("value", [-1.0, np.nan])
def test_parameter_out_of_range_at_one_point(value):
    """A function that is bad in one cell, so on one rank: all ranks raise."""
    scene = pressed()
    mu = fem.Function(fem.functionspace(scene.mesh, ("DG", 0)))
    mu.x.array[:] = 0.3
    centers = mu.function_space.tabulate_dof_coordinates()
    mu.x.array[(centers[:, 0] < 0.5) & (centers[:, 1] < 0.25)] = value
    raised_everywhere(lambda: scene.problem(coulomb(mu), scene.rollers()), ValueError, "friction")


def in_space() -> Block:
    """A block of tetrahedra, pressed down."""
    return block("tetrahedron", up=-1.0)


@pytest.mark.parametrize("value", [2, 0, -4, 3.5, "5", True])
def test_polygon_of_too_few_sides(value):
    """A polygon has a whole number of sides, three or more: refused by the law itself."""
    for law in (fc.Coulomb, lambda mu, **kwargs: fc.Tresca(mu, 1.0, **kwargs)):
        raised_everywhere(
            lambda law=law: law(0.3, modes=value), ValueError, "modes", repr(value), "3 or more"
        )


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("modes", {"modes": 4}),
        ("transverse_friction", {"transverse_friction": 0.1, "direction": (1.0, 0.0)}),
    ],
)
def test_directions_of_friction_in_the_plane(name, options):
    """Polygon and ellipse are of the tangent plane: none in two dimensions."""
    scene = pressed()
    law = fc.Coulomb(0.3, k_n=1e4, k_t=1e3, **options)
    raised_everywhere(lambda: scene.contact(law), ValueError, "contact", name, "two dimensions")


def test_direction_of_friction_missing_or_unused():
    """An ellipse without direction; a direction that the cone has no use for."""
    raised_everywhere(
        lambda: fc.Coulomb(0.3, transverse_friction=0.1), ValueError, "direction", "missing"
    )
    raised_everywhere(lambda: fc.Coulomb(0.3, direction=(1, 0, 0)), ValueError, "direction", "cone")


def elliptic(friction=0.3, transverse_friction=0.1, direction=(1.0, 0.0, 0.0)) -> fc.Coulomb:
    return fc.Coulomb(
        friction, 1e4, 1e3, transverse_friction=transverse_friction, direction=direction
    )


def test_elliptic_friction_is_solved():
    """What the tests below spoil in one respect is sound otherwise: it carries its load, 1."""
    step = build_and_solve(in_space(), elliptic())()
    # Equilibrium to the solver's tolerance, 1e-9 of the forces.
    assert step.contacts["contact"].normal_force == pytest.approx(1.0, rel=1e-8)


@pytest.mark.parametrize("value", [0.0, -0.1, np.nan, np.inf])
@pytest.mark.parametrize("name", ["friction", "transverse_friction"])
def test_axis_of_the_ellipse_out_of_range(name, value):
    """Both frictions of an ellipse are greater than zero: as a number, a constant, by UFL."""
    scene = in_space()
    raised_everywhere(
        lambda: scene.contact(elliptic(**{name: value})), ValueError, name, "greater than zero"
    )
    constant = fem.Constant(scene.mesh, float(value))
    law = elliptic(**{name: constant})
    raised_everywhere(lambda: scene.problem(law, scene.rollers()), ValueError, name)
    x = ufl.SpatialCoordinate(scene.mesh)
    law = elliptic(**{name: ufl.conditional(ufl.gt(x[0], 0.5), 0.2, constant)})
    raised_everywhere(lambda: scene.problem(law, scene.rollers()), ValueError, name)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ((0.0, 0.0, 0.0), ["length zero"]),
        ((1.0, 0.0), ["3 finite numbers"]),
        ((1.0, np.nan, 0.0), ["3 finite numbers"]),
        (1.0, ["3 finite numbers"]),
    ],
)
def test_direction_of_friction_by_number(value, words):
    """A direction that is none: refused by `Contact`."""
    scene = in_space()
    law = elliptic(direction=value)
    raised_everywhere(lambda: scene.contact(law), ValueError, "contact", "direction", *words)


def test_direction_of_friction_parallel_to_the_normal():
    """A direction with no part in the tangent plane, everywhere or at some points; later changed.

    The normal of the floor is along z. In parallel only some ranks have such points.
    """
    scene = in_space()
    words = ("contact", "direction", "parallel")
    for law in (
        elliptic(direction=(0, 0, 2.0)),
        fc.Tresca(0.3, 1.0, k_n=1e4, k_t=1e3, modes=4, direction=(0, 0, -1)),
    ):
        raised_everywhere(lambda law=law: scene.problem(law, scene.rollers()), ValueError, *words)
    x = ufl.SpatialCoordinate(scene.mesh)
    somewhere = ufl.as_vector([ufl.conditional(ufl.gt(x[0], 0.5), 1.0, 0.0), 0.0, 1.0])
    raised_everywhere(
        lambda: scene.problem(elliptic(direction=somewhere), scene.rollers()), ValueError, *words
    )
    problem, contact = scene.problem(elliptic(), scene.rollers())
    problem.solve()
    for value in ((0, 0, 1.0), (0, 0, 0)):
        contact.parameters["direction"].value = value
        raised_everywhere(problem.solve, ValueError, *words)
    contact.parameters["direction"].value = (np.nan, 0, 0)
    raised_everywhere(problem.solve, ValueError, "direction", "finite")


@pytest.mark.parametrize(
    ("name", "value"),
    [("k_n", 0.0), ("k_n", -1.0), ("k_n", np.inf), ("k_t", -1.0), ("k_t", np.nan)],
)
def test_foundation_out_of_range(name, value):
    """Stiffness of a foundation: k_n > 0, k_t ≥ 0; a number is refused at once, else at a solve."""
    scene = pressed()
    numbers = {"k_n": 1e3, "k_t": 1e2}
    law = fc.Foundation(**numbers | {name: value})
    raised_everywhere(lambda: scene.contact(law), ValueError, "contact", name)
    law = fc.Foundation(**numbers | {name: fem.Constant(scene.mesh, float(value))})
    raised_everywhere(lambda: scene.problem(law, scene.rollers()), ValueError, name)


def test_foundation_without_tangential_stiffness_at_some_points():
    """k_t = 0 by a constant is sound: it means what the number zero means."""
    scene = pressed()
    law = fc.Foundation(1e3, fem.Constant(scene.mesh, 0.0))
    step = build_and_solve(scene, law)()
    assert step.contacts["contact"].normal_force == pytest.approx(1.0, rel=1e-8)
    assert step.contacts["contact"].tangential_force == 0.0


@pytest.mark.parametrize("pressure", [-1.0, np.nan])
def test_tresca_pressure_out_of_range(pressure):
    """The prescribed pressure of Tresca's law is a pressure."""
    scene = pressed()
    law = fc.Tresca(0.3, pressure, k_n=1e4, k_t=1e3)
    raised_everywhere(lambda: scene.contact(law), ValueError, "pressure")


@pytest.mark.parametrize("value", ["rough", "0.3", True, 0.3 + 1j, {}, ["a", "b"], [[1.0], 2.0]])
def test_parameter_of_a_wrong_type(value):
    """What cannot be a coefficient is a TypeError that names the parameter."""
    scene = pressed()
    raised_everywhere(lambda: scene.contact(coulomb(value)), TypeError, "friction")


def test_parameter_none():
    """None is no friction coefficient."""
    scene = pressed()
    raised_everywhere(
        lambda: scene.problem(coulomb(None), scene.rollers()), (ValueError, TypeError), "friction"
    )


def test_parameter_of_a_wrong_shape():
    """A vector is no friction coefficient."""
    scene = pressed()
    raised_everywhere(lambda: scene.contact(coulomb((0.1, 0.2))), ValueError, "friction", "scalar")
    x = ufl.SpatialCoordinate(scene.mesh)
    raised_everywhere(lambda: scene.contact(coulomb(x)), ValueError, "friction", "scalar")


@pytest.mark.parametrize("factor", [0.0, -1.0, np.nan, np.inf, "10"])
def test_scaled_factor_out_of_range(factor):
    """A factor of E/h is a positive number."""
    raised_everywhere(lambda: fc.Scaled(factor), ValueError, "factor")


# ---- gap, normal, weight, modulus ----------------------------------------------------------------


@pytest.mark.parametrize("kind", ["number", "constant", "ufl"])
@pytest.mark.parametrize("name", ["gap", "weight"])
def test_gap_or_weight_not_finite(name, kind):
    """NaN in the prescribed gap or in the weight."""
    scene = pressed()
    x = ufl.SpatialCoordinate(scene.mesh)
    value = {
        "number": np.nan,
        "constant": fem.Constant(scene.mesh, np.nan),
        "ufl": ufl.sqrt(x[0] - 0.5),
    }[kind]
    raised_everywhere(
        lambda: scene.problem(coulomb(), scene.rollers(), contact={name: value}), ValueError, name
    )


def test_negative_weight():
    """A thickness is not negative, at any point."""
    scene = pressed()
    weight = ufl.SpatialCoordinate(scene.mesh)[0] - 0.5
    raised_everywhere(
        lambda: scene.problem(coulomb(), scene.rollers(), contact={"weight": weight}),
        ValueError,
        "weight",
    )


@pytest.mark.parametrize("support", ["obstacle", "half-space"])
def test_normal_of_length_zero_at_a_point(support):
    """A normal by UFL that vanishes over one half of Γc: refused, as a normal of length zero."""
    scene = pressed()
    x = ufl.SpatialCoordinate(scene.mesh)
    normal = ufl.as_vector([0, ufl.conditional(ufl.gt(x[0], 0.5), -1.0, 0.0)])
    made = {"obstacle": fc.Obstacle(0.0, normal), "half-space": fc.HalfSpace((0, 0), -normal)}
    raised_everywhere(
        lambda: scene.problem(coulomb(), scene.rollers(), contact={"support": made[support]}),
        ValueError,
        "normal",
        "length",
    )


def test_normal_not_finite():
    """A normal by UFL that is NaN somewhere."""
    scene = pressed()
    x = ufl.SpatialCoordinate(scene.mesh)
    obstacle = fc.Obstacle(0.0, ufl.as_vector([ufl.sqrt(x[0] - 0.5), -1.0]))
    raised_everywhere(
        lambda: scene.problem(coulomb(), scene.rollers(), contact={"support": obstacle}),
        ValueError,
        "normal",
    )


def test_gap_of_a_wrong_shape():
    """A prescribed gap is a scalar."""
    scene = pressed()
    raised_everywhere(lambda: scene.contact(coulomb(), gap=(0.1, 0.2)), ValueError, "gap")


def test_weight_of_a_wrong_shape():
    """A weight is a scalar."""
    scene = pressed()
    raised_everywhere(
        lambda: scene.problem(coulomb(), scene.rollers(), contact={"weight": (1.0, 2.0)}),
        ValueError,
        "weight",
    )


def test_missing_modulus():
    """A stiffness in units of E/h without E: `form` says so, with all the ways out."""
    scene = pressed()
    contact = scene.contact(fc.Coulomb(0.3))
    v = ufl.TestFunction(scene.u.function_space)
    raised_everywhere(lambda: contact.form(v), ValueError, "modulus", "k_n")


@pytest.mark.parametrize("modulus", [0.0, -1.0, np.nan, np.inf, "E", True])
def test_modulus_out_of_range(modulus):
    """A modulus is positive and finite."""
    scene = pressed()
    raised_everywhere(
        lambda: scene.contact(fc.Coulomb(0.3), modulus=modulus), ValueError, "modulus"
    )


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_modulus_function_out_of_range(value):
    """The same for a function that is bad in one cell at Γc."""
    scene = pressed()
    modulus = fem.Function(fem.functionspace(scene.mesh, ("DG", 0)))
    modulus.x.array[:] = 1000.0
    centers = modulus.function_space.tabulate_dof_coordinates()
    modulus.x.array[(centers[:, 0] < 0.5) & (centers[:, 1] < 0.25)] = value
    raised_everywhere(
        lambda: scene.contact(fc.Coulomb(0.3), modulus=modulus), ValueError, "modulus"
    )


# ---- the displacement ----------------------------------------------------------------------------


def contact_with(u, scene: Block) -> Callable:
    return lambda: fc.Contact(u, scene.surface, scene.floor(), coulomb())


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
    """A pressure beside it, whole or in part, or scalars for its components: the reason is told."""
    scene = pressed()
    line = basix.ufl.element("P", "quadrilateral", 1)
    vector = basix.ufl.element("P", "quadrilateral", 2, shape=(2,))
    both = fem.Function(fem.functionspace(scene.mesh, basix.ufl.mixed_element([vector, line])))
    scalars = fem.Function(fem.functionspace(scene.mesh, basix.ufl.mixed_element([line, line])))
    for u in (both, both.sub(0), scalars):
        raised_everywhere(contact_with(u, scene), ValueError, "contact: u is in a mixed element")
    v = ufl.TestFunction(both.function_space)
    F = ufl.inner(ufl.grad(both), ufl.grad(v)) * ufl.dx
    raised_everywhere(lambda: fc.ContactProblem(F, both), ValueError, "u is in a mixed element")


# ---- what is no argument at all ------------------------------------------------------------------


def test_arguments_of_a_contact():
    """Swapped, missing, a class for an object: named, with the order there is."""
    scene = pressed()
    u, surface, floor, law = scene.u, scene.surface, scene.floor(), coulomb()
    for arguments, words in (
        ((u, surface, law, floor), ("support is a Coulomb", "must be a Support", "(u, surface,")),
        ((surface, u, floor, law), ("u is a ContactSurface", "must be a Function")),
        ((u, scene.mesh, floor, law), ("surface is a Mesh", "must be a ContactSurface")),
        ((u, surface, None, law), ("support is a NoneType",)),
        ((u, surface, floor, 0.3), ("law is a float", "must be a Law")),
        ((u, surface, floor, fc.Frictionless), ("law is the class Frictionless", "(...)")),
        ((u, surface, fc.HalfSpace, law), ("support is the class HalfSpace",)),
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
        support = fc.DeformableBody(*body)
        raised_everywhere(lambda s=support: scene.contact(coulomb(), support=s), ValueError, word)
    raised_everywhere(
        lambda: fc.DeformableBody(tags, TOP, search_distance="far"),
        ValueError,
        "search_distance is 'f",
    )


@pytest.mark.parametrize("degree", [2.5, 2.0, "2", True, 0, -1])
def test_quadrature_degree(degree):
    """A degree is a whole number from 1."""
    scene = pressed()
    raised_everywhere(
        lambda: fc.ContactSurface(scene.mesh, scene.tags, BOTTOM, quadrature_degree=degree),
        ValueError,
        f"quadrature_degree is {degree!r}",
        "whole number",
    )


def test_numbers_of_supports():
    """Texts for numbers in points, radii and forces; no list where one is wanted."""
    scene = pressed()
    for support, word in (
        (fc.HalfSpace("origin", (0, 1)), "point of the HalfSpace is 'origin'"),
        (fc.HalfSpace((0, "0"), (0, 1)), "point of the HalfSpace is (0, '0')"),
        (fc.Ball((0, -1), "1"), "radius of the Ball is '1'"),
        (scene.floor(displacement=fc.Motion(5.0)), "Motion has 0 forces"),
        (scene.floor(displacement=fc.Motion((None, "5"))), "force 1 of the Motion is '5'"),
    ):
        raised_everywhere(
            lambda s=support: scene.contact(coulomb(), support=s), (ValueError, TypeError), word
        )
    raised_everywhere(
        lambda: fc.elasticity.LinearElastic(scene.u, "E", 0.3, "plane strain"),
        ValueError,
        "E is 'E",
    )


@pytest.mark.parametrize("held", [True, False])
def test_a_support_turned_round(held, caplog):
    """The normal of a floor points down, a ball is outside of what it should surround.

    The body is inside: refused. A floor that just touches is one that the body leaves: warned.
    """
    scene = pressed()
    bcs = [*scene.rollers(), scene.hold(TOP, 1)] if held else scene.rollers()
    for support in (fc.HalfSpace((0, -0.5), (0, -1)), fc.Ball((0.5, 0.5), 2.0)):
        raised_everywhere(
            lambda s=support: scene.problem(coulomb(), bcs, contact={"support": s}),
            ValueError,
            "contact: the normal from the body to the support points into the body",
            "inside of the support",
        )
    with caplog.at_level("WARNING", logger="fenics_contact"):
        scene.problem(coulomb(), bcs, contact={"support": fc.HalfSpace((0, 0), (0, -1))})
    assert ("points into the body" in caplog.text) == (COMM.rank == 0)
    caplog.clear()
    scene.problem(coulomb(), bcs, contact={"support": fc.Ball((0.5, 0.5), 2.0, inside=True)})
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
    raised_everywhere(with_form(scene, energy), ValueError, "F ", "0 arguments")
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


def test_form_without_stiffness():
    """A modulus of zero is found before it becomes a singular matrix."""
    scene = pressed(E=0.0)
    raised_everywhere(build_and_solve(scene), ValueError, "stiffness")


# ---- not finite ----------------------------------------------------------------------------------


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


def test_displacement_of_the_support_not_finite():
    """A support moved to NaN between two increments."""
    scene = pressed()
    motion = fem.Constant(scene.mesh, np.zeros(2))
    problem, _ = scene.problem(coulomb(), scene.rollers(), contact={"displacement": motion})
    problem.solve()
    motion.value[1] = np.nan
    raised_everywhere(problem.solve, ValueError, "gap", "finite")


def test_tangential_displacement_of_the_support_not_finite():
    """A support moved to NaN along itself only: the gap does not show it in every arrangement."""
    scene = pressed()
    motion = fem.Constant(scene.mesh, np.zeros(2))
    problem, _ = scene.problem(coulomb(), scene.rollers(), contact={"displacement": motion})
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


def test_condition_on_another_space():
    """A Dirichlet condition of another, larger space is refused."""
    scene = pressed()
    other = displacement_space(scene.mesh, 3)
    facets = scene.tags.find(TOP)
    dofs = fem.locate_dofs_topological(other, 1, facets)
    bc = fem.dirichletbc(np.zeros(2), dofs, other)
    raised_everywhere(lambda: scene.problem(coulomb(), [bc]), ValueError, "Dirichlet", "space")


# ---- loads and motions that nothing can hold -----------------------------------------------------


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_load_that_pulls_the_body_off(cell):
    """A load away from the support, nothing else holding: no contact force can balance it."""
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
    raised_everywhere(lambda: scene.problem(frictionless, []), ValueError, "hold", *words)
    # μ = 0 is no friction either.
    raised_everywhere(lambda: scene.problem(coulomb(0.0), []), ValueError, "hold", *words)
    problem, _ = scene.problem(coulomb(0.3), [])
    problem.solve()


def test_a_motion_along_a_cavity():
    """A body inside a round cavity without friction can turn about the axis: named."""
    scene = pressed()
    # The cavity's axis is the middle of the block: turning about it is felt by no point.
    cavity = fc.Ball((0.5, 0.5), 2.0, inside=True)
    raised_everywhere(
        lambda: scene.problem(fc.Frictionless(k_n=1e4), [], contact={"support": cavity}),
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


@pytest.mark.parametrize("value", [-0.1, 1.1, np.nan, "1"])
@pytest.mark.parametrize("name", ["alpha", "phi"])
def test_shares_out_of_range(name, value):
    """α and φ are shares, 0 to 1 (section 5)."""
    scene = pressed()
    raised_everywhere(
        lambda: scene.problem(coulomb(), scene.rollers(), **{name: value}), ValueError, name
    )


@pytest.mark.parametrize("value", [0, -0.1, np.nan, "20 %", True])
def test_share_of_the_kinematics_out_of_range(value):
    """A positive number, infinite included."""
    scene = pressed()
    raised_everywhere(
        lambda: scene.problem(coulomb(), scene.rollers(), kinematics=value),
        ValueError,
        "kinematics",
        "infinite",
    )


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
