"""Invalid parameters of laws, gaps, normals and weights are refused by name on all ranks."""

import basix.ufl
import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from scenes.blocks import Block, block
from scenes.comparison import assert_raised_on_all_ranks, is_close
from scenes.valid_problem import coulomb_law, make_solve, pressed_block

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]
COMM = MPI.COMM_WORLD


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


@pytest.mark.whole
@pytest.mark.parametrize(("name", "value"), BAD_NUMBERS)
def test_parameter_out_of_range_by_number(name, value):
    """`Contact` refuses the numbers μ < 0, k_n ≤ 0, k_t ≤ 0 and those that are not finite."""
    scene = pressed_block()
    assert_raised_on_all_ranks(
        lambda: scene.contact(coulomb_law(**{name: value})), ValueError, name, "contact"
    )


@pytest.mark.whole
@pytest.mark.parametrize(("name", "value"), BAD_NUMBERS)
def test_parameter_out_of_range_by_constant(name, value):
    """`ContactProblem` refuses a ``fem.Constant`` that is out of range."""
    scene = pressed_block()
    law = coulomb_law(**{name: fem.Constant(scene.mesh, float(value))})
    assert_raised_on_all_ranks(lambda: scene.problem(law, scene.rollers()), ValueError, name)


@pytest.mark.each
@pytest.mark.parametrize(("name", "value"), BAD_NUMBERS)
def test_parameter_out_of_range_after_a_change(name, value):
    """The next solve refuses a parameter set out of range, and leaves u unchanged."""
    scene = pressed_block()
    problem, contact = scene.problem(coulomb_law(), scene.rollers())
    problem.solve()
    before = scene.u.x.array.copy()
    contact.parameters[name].value = value
    assert_raised_on_all_ranks(problem.solve, ValueError, name)
    assert all(COMM.allgather(bool(np.array_equal(scene.u.x.array, before))))


@pytest.mark.whole
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
    """A UFL expression out of range at some points, in parallel on some ranks, is refused."""
    scene = pressed_block()
    law = coulomb_law(**{name: expression(ufl.SpatialCoordinate(scene.mesh))})
    assert_raised_on_all_ranks(lambda: scene.problem(law, scene.rollers()), ValueError, name)


@pytest.mark.parametrize("value", [-1.0, np.nan])
def test_parameter_out_of_range_at_one_point(value):
    """All ranks raise if a function is out of range in one cell, thus on one rank."""
    scene = pressed_block()
    mu = fem.Function(fem.functionspace(scene.mesh, ("DG", 0)))
    mu.x.array[:] = 0.3
    centers = mu.function_space.tabulate_dof_coordinates()
    mu.x.array[(centers[:, 0] < 0.5) & (centers[:, 1] < 0.25)] = value
    assert_raised_on_all_ranks(
        lambda: scene.problem(coulomb_law(mu), scene.rollers()), ValueError, "friction"
    )


def in_space() -> Block:
    """Return a block of tetrahedra under a downward load."""
    return block("tetrahedron", up=-1.0)


@pytest.mark.whole
@pytest.mark.parametrize("value", [2, 0, -4, 3.5, "5", True])
def test_number_of_polygon_sides_is_invalid(value):
    """The law refuses a number of polygon sides that is not an integer of at least 3."""
    for law in (fc.Coulomb, lambda mu, **kwargs: fc.Tresca(mu, 1.0, **kwargs)):
        assert_raised_on_all_ranks(
            lambda law=law: law(0.3, modes=value), ValueError, "modes", repr(value), "at least 3"
        )


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("modes", {"modes": 4}),
        ("transverse_friction", {"transverse_friction": 0.1, "direction": (1.0, 0.0)}),
    ],
)
def test_friction_directions_in_two_dimensions(name, options):
    """Polygonal and elliptic friction need a tangent plane: refused in two dimensions."""
    scene = pressed_block()
    law = fc.Coulomb(0.3, k_n=1e4, k_t=1e3, **options)
    assert_raised_on_all_ranks(
        lambda: scene.contact(law), ValueError, "contact", name, "two dimensions"
    )


def test_direction_of_friction_missing_or_unused():
    """An ellipse without direction, and a direction for a circular cone, are refused."""
    assert_raised_on_all_ranks(
        lambda: fc.Coulomb(0.3, transverse_friction=0.1), ValueError, "direction", "missing"
    )
    assert_raised_on_all_ranks(
        lambda: fc.Coulomb(0.3, direction=(1, 0, 0)), ValueError, "direction", "cone"
    )


def elliptic(friction=0.3, transverse_friction=0.1, direction=(1.0, 0.0, 0.0)) -> fc.Coulomb:
    return fc.Coulomb(
        friction, 1e4, 1e3, transverse_friction=transverse_friction, direction=direction
    )


def test_elliptic_friction_is_solved():
    """The valid input of the tests below is solved, with the load of 1 as the normal force."""
    step = make_solve(in_space(), elliptic())()
    # The residual is at most 1e-9 of the forces.
    assert step.contacts["contact"].normal_force == pytest.approx(1.0, rel=1e-8)


@pytest.mark.each
@pytest.mark.parametrize("value", [0.0, -0.1, np.nan, np.inf])
@pytest.mark.parametrize("name", ["friction", "transverse_friction"])
def test_axis_of_the_ellipse_out_of_range(name, value):
    """Both coefficients of an ellipse must be positive, as a number, a constant or UFL."""
    scene = in_space()
    assert_raised_on_all_ranks(
        lambda: scene.contact(elliptic(**{name: value})), ValueError, name, "greater than zero"
    )
    constant = fem.Constant(scene.mesh, float(value))
    law = elliptic(**{name: constant})
    assert_raised_on_all_ranks(lambda: scene.problem(law, scene.rollers()), ValueError, name)
    x = ufl.SpatialCoordinate(scene.mesh)
    law = elliptic(**{name: ufl.conditional(ufl.gt(x[0], 0.5), 0.2, constant)})
    assert_raised_on_all_ranks(lambda: scene.problem(law, scene.rollers()), ValueError, name)


@pytest.mark.whole
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
    """`Contact` refuses a direction of length zero, of the wrong shape, or not finite."""
    scene = in_space()
    law = elliptic(direction=value)
    assert_raised_on_all_ranks(
        lambda: scene.contact(law), ValueError, "contact", "direction", *words
    )


def test_direction_of_friction_parallel_to_the_normal():
    """A direction along the normal is refused, at all points, at some, or after a change.

    The normal of the floor is along z. In parallel only some ranks have such points.
    """
    scene = in_space()
    words = ("contact", "direction", "parallel")
    for law in (
        elliptic(direction=(0, 0, 2.0)),
        fc.Tresca(0.3, 1.0, k_n=1e4, k_t=1e3, modes=4, direction=(0, 0, -1)),
    ):
        assert_raised_on_all_ranks(
            lambda law=law: scene.problem(law, scene.rollers()), ValueError, *words
        )
    x = ufl.SpatialCoordinate(scene.mesh)
    somewhere = ufl.as_vector([ufl.conditional(ufl.gt(x[0], 0.5), 1.0, 0.0), 0.0, 1.0])
    assert_raised_on_all_ranks(
        lambda: scene.problem(elliptic(direction=somewhere), scene.rollers()), ValueError, *words
    )
    problem, contact = scene.problem(elliptic(), scene.rollers())
    problem.solve()
    for value in ((0, 0, 1.0), (0, 0, 0)):
        contact.parameters["direction"].value = value
        assert_raised_on_all_ranks(problem.solve, ValueError, *words)
    contact.parameters["direction"].value = (np.nan, 0, 0)
    assert_raised_on_all_ranks(problem.solve, ValueError, "direction", "finite")


@pytest.mark.whole
@pytest.mark.parametrize(
    ("name", "value"),
    [("k_n", -1.0), ("k_n", np.inf), ("k_t", -1.0), ("k_t", np.nan)],
)
def test_foundation_out_of_range(name, value):
    """A foundation needs k_n, k_t ≥ 0; `Contact` checks numbers, `ContactProblem` constants."""
    scene = pressed_block()
    numbers = {"k_n": 1e3, "k_t": 1e2}
    law = fc.Foundation(**numbers | {name: value})
    assert_raised_on_all_ranks(lambda: scene.contact(law), ValueError, "contact", name)
    law = fc.Foundation(**numbers | {name: fem.Constant(scene.mesh, float(value))})
    assert_raised_on_all_ranks(lambda: scene.problem(law, scene.rollers()), ValueError, name)


def test_foundation_with_constant_zero_tangential_stiffness():
    """A constant k_t = 0 is valid and equivalent to the number zero."""
    scene = pressed_block()
    law = fc.Foundation(1e3, fem.Constant(scene.mesh, 0.0))
    step = make_solve(scene, law)()
    assert step.contacts["contact"].normal_force == pytest.approx(1.0, rel=1e-8)
    assert step.contacts["contact"].tangential_force == 0.0


@pytest.mark.parametrize("pressure", [-1.0, np.nan])
def test_tresca_pressure_out_of_range(pressure):
    """The pressure of Tresca's law must be nonnegative and finite."""
    scene = pressed_block()
    law = fc.Tresca(0.3, pressure, k_n=1e4, k_t=1e3)
    assert_raised_on_all_ranks(lambda: scene.contact(law), ValueError, "pressure")


@pytest.mark.whole
@pytest.mark.parametrize("value", ["rough", "0.3", True, 0.3 + 1j, {}, ["a", "b"], [[1.0], 2.0]])
def test_parameter_of_a_wrong_type(value):
    """A value that cannot be a coefficient raises a TypeError that names the parameter."""
    scene = pressed_block()
    assert_raised_on_all_ranks(lambda: scene.contact(coulomb_law(value)), TypeError, "friction")


def test_large_integer_parameters():
    """The integer 10**30 is read as 1e30; an integer beyond the range of floats is refused."""
    scene = block(n=2, up=-1.0)
    _, contact = scene.problem(fc.Frictionless(k_n=10**30), scene.rollers())
    assert contact.parameters["k_n"].value == 1e30
    words = "k_n is 1000"
    assert_raised_on_all_ranks(
        lambda: scene.contact(fc.Frictionless(k_n=10**400)), TypeError, words
    )


def test_parameter_none():
    """A friction coefficient of None is refused."""
    scene = pressed_block()
    assert_raised_on_all_ranks(
        lambda: scene.problem(coulomb_law(None), scene.rollers()),
        (ValueError, TypeError),
        "friction",
    )


def test_parameter_of_a_wrong_shape():
    """A friction coefficient that is a vector is refused."""
    scene = pressed_block()
    assert_raised_on_all_ranks(
        lambda: scene.contact(coulomb_law((0.1, 0.2))), ValueError, "friction", "scalar"
    )
    x = ufl.SpatialCoordinate(scene.mesh)
    assert_raised_on_all_ranks(
        lambda: scene.contact(coulomb_law(x)), ValueError, "friction", "scalar"
    )


@pytest.mark.whole
@pytest.mark.parametrize("factor", [0.0, -1.0, np.nan, np.inf, "10"])
def test_scaled_factor_out_of_range(factor):
    """The factor of `RelativeStiffness` must be a positive finite number."""
    assert_raised_on_all_ranks(lambda: fc.RelativeStiffness(factor), ValueError, "factor")


# ---- gap, normal, weight, modulus ----------------------------------------------------------------


@pytest.mark.whole
@pytest.mark.parametrize("kind", ["number", "constant", "ufl"])
@pytest.mark.parametrize("name", ["gap", "weight"])
def test_gap_or_weight_not_finite(name, kind):
    """NaN in the prescribed gap or in the weight is refused."""
    scene = pressed_block()
    x = ufl.SpatialCoordinate(scene.mesh)
    value = {
        "number": np.nan,
        "constant": fem.Constant(scene.mesh, np.nan),
        "ufl": ufl.sqrt(x[0] - 0.5),
    }[kind]
    assert_raised_on_all_ranks(
        lambda: scene.problem(coulomb_law(), scene.rollers(), contact={name: value}),
        ValueError,
        name,
    )


def test_negative_weight():
    """A weight that is negative at some points is refused."""
    scene = pressed_block()
    weight = ufl.SpatialCoordinate(scene.mesh)[0] - 0.5
    assert_raised_on_all_ranks(
        lambda: scene.problem(coulomb_law(), scene.rollers(), contact={"weight": weight}),
        ValueError,
        "weight",
    )


@pytest.mark.parametrize("kind", ["number", "constant", "ufl"])
def test_weight_of_zero_at_every_point(kind):
    """A weight of zero at every point, which would transmit no contact force, is refused."""
    scene = pressed_block()
    weight = {
        "number": 0.0,
        "constant": fem.Constant(scene.mesh, 0.0),
        "ufl": ufl.SpatialCoordinate(scene.mesh)[1],  # the height of the bottom
    }[kind]
    assert_raised_on_all_ranks(
        lambda: scene.problem(coulomb_law(), scene.rollers(), contact={"weight": weight}),
        ValueError,
        "weight is zero at every point",
    )


@pytest.mark.parametrize("obstacle", ["obstacle", "half-space"])
def test_normal_of_length_zero_on_half_of_the_surface(obstacle):
    """A UFL normal that vanishes on one half of Γc is refused."""
    scene = pressed_block()
    x = ufl.SpatialCoordinate(scene.mesh)
    normal = ufl.as_vector([0, ufl.conditional(ufl.gt(x[0], 0.5), -1.0, 0.0)])
    obstacles_by_kind = {
        "obstacle": fc.PrescribedGap(0.0, normal),
        "half-space": fc.HalfSpace((0, 0), -normal),
    }
    assert_raised_on_all_ranks(
        lambda: scene.problem(
            coulomb_law(), scene.rollers(), contact={"obstacle": obstacles_by_kind[obstacle]}
        ),
        ValueError,
        "normal",
        "length",
    )


def test_normal_not_finite():
    """A UFL normal that is NaN at some points is refused."""
    scene = pressed_block()
    x = ufl.SpatialCoordinate(scene.mesh)
    obstacle = fc.PrescribedGap(0.0, ufl.as_vector([ufl.sqrt(x[0] - 0.5), -1.0]))
    assert_raised_on_all_ranks(
        lambda: scene.problem(coulomb_law(), scene.rollers(), contact={"obstacle": obstacle}),
        ValueError,
        "normal",
    )


def test_gap_of_a_wrong_shape():
    """A prescribed gap that is a vector is refused."""
    scene = pressed_block()
    assert_raised_on_all_ranks(
        lambda: scene.contact(coulomb_law(), gap=(0.1, 0.2)), ValueError, "gap"
    )


def test_weight_of_a_wrong_shape():
    """A weight that is a vector is refused."""
    scene = pressed_block()
    assert_raised_on_all_ranks(
        lambda: scene.problem(coulomb_law(), scene.rollers(), contact={"weight": (1.0, 2.0)}),
        ValueError,
        "weight",
    )


def test_missing_modulus():
    """`form` refuses a stiffness relative to E/h without E, and names the remedies."""
    scene = pressed_block()
    contact = scene.contact(fc.Coulomb(0.3))
    v = ufl.TestFunction(scene.u.function_space)
    assert_raised_on_all_ranks(lambda: contact.form(v), ValueError, "modulus", "k_n")


@pytest.mark.whole
@pytest.mark.parametrize("modulus", [0.0, -1.0, np.nan, np.inf, "E", True])
def test_modulus_out_of_range(modulus):
    """A modulus must be a positive finite number."""
    scene = pressed_block()
    assert_raised_on_all_ranks(
        lambda: scene.contact(fc.Coulomb(0.3), modulus=modulus), ValueError, "modulus"
    )


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_modulus_function_out_of_range(value):
    """A modulus function that is out of range in one cell at Γc is refused."""
    scene = pressed_block()
    modulus = fem.Function(fem.functionspace(scene.mesh, ("DG", 0)))
    modulus.x.array[:] = 1000.0
    centers = modulus.function_space.tabulate_dof_coordinates()
    modulus.x.array[(centers[:, 0] < 0.5) & (centers[:, 1] < 0.25)] = value
    assert_raised_on_all_ranks(
        lambda: scene.contact(fc.Coulomb(0.3), modulus=modulus), ValueError, "modulus"
    )


@pytest.mark.whole
@pytest.mark.parametrize("parameter", ["friction", "gap", "weight", "displacement", "normal"])
def test_data_that_depend_on_the_displacement(parameter):
    """Data of the contact that depend on the unknown u are refused by name."""
    scene = pressed_block()
    part = scene.u.sub(1)  # has the same array as u
    grows = 0.3 + ufl.div(scene.u) ** 2
    contact = {
        "friction": {},
        "gap": {"gap": abs(part)},
        "weight": {"weight": 1 + grows},
        "displacement": {"displacement": ufl.as_vector([0.0, 0.1 * scene.u[1]])},
        "normal": {"obstacle": fc.PrescribedGap(0.0, ufl.as_vector([scene.u[0], -1.0]))},
    }[parameter]
    law = coulomb_law(friction=grows if parameter == "friction" else 0.3)
    assert_raised_on_all_ranks(
        lambda: scene.contact(law, **contact), ValueError, parameter, "the unknown", "u"
    )


def test_data_of_another_mesh_or_form():
    """A function on another mesh, or a test function, is refused as friction coefficient."""
    scene, other = pressed_block(), pressed_block()
    far = coulomb_law(friction=0.3 + other.u[0] ** 2)
    assert_raised_on_all_ranks(lambda: scene.contact(far), ValueError, "friction", "another mesh")
    v = ufl.TestFunction(scene.u.function_space)
    assert_raised_on_all_ranks(
        lambda: scene.contact(coulomb_law(friction=v[0])), ValueError, "friction", "test"
    )


DATA = ["friction", "gap", "weight"]


def with_data(scene, parameter, value):
    """Return a contact with one of its data set to a value."""
    contact = {} if parameter == "friction" else {parameter: value}
    return scene.contact(coulomb_law(friction=value if parameter == "friction" else 0.3), **contact)


@pytest.mark.whole
@pytest.mark.parametrize("parameter", DATA)
def test_data_in_single_precision(parameter):
    """A constant of np.float32 is refused, as forms are in double precision."""
    scene = pressed_block()
    value = fem.Constant(scene.mesh, np.float32(0.3))
    assert_raised_on_all_ranks(
        lambda: with_data(scene, parameter, value), ValueError, parameter, "float32", "double"
    )


@pytest.mark.whole
@pytest.mark.parametrize("parameter", DATA)
def test_data_on_quadrature_elements(parameter):
    """Values at quadrature points of cells, or of another rule on Γc, are refused.

    Values at the points of the contact's own rule give the force of the same number, to 1e-12.
    """
    scene = pressed_block()

    def at_points(mesh, cell, degree):
        element = basix.ufl.quadrature_element(cell, degree=degree)
        value = fem.Function(fem.functionspace(mesh, element))
        value.x.array[:] = 0.2
        return value

    facets = scene.surface.submesh
    for value in (at_points(scene.mesh, "quadrilateral", 2), at_points(facets, "interval", 4)):
        refused = ValueError, parameter, "quadrature element", "DG"
        assert_raised_on_all_ranks(lambda value=value: with_data(scene, parameter, value), *refused)
    forces = []
    for value in (at_points(facets, "interval", 2), 0.2):
        contact = with_data(scene, parameter, value)
        problem = fc.ContactProblem(scene.F, scene.u, bcs=scene.rollers(), contacts=[contact])
        problem.solve()
        forces.append(contact.resultants().force)
        scene.u.x.array[:] = 0.0
    assert is_close(*forces, 1e-12)


@pytest.mark.whole
@pytest.mark.parametrize("parameter", DATA)
def test_data_that_cannot_be_compiled(parameter):
    """An expression that FFCx cannot compile, the area of a facet, is refused by name."""
    scene = pressed_block()
    value = 0.1 * ufl.FacetArea(scene.mesh)
    words = parameter, "cannot be compiled", "FacetArea", "fem.Function"
    assert_raised_on_all_ranks(lambda: with_data(scene, parameter, value), ValueError, *words)
