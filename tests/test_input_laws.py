"""Bad parameters of laws, gaps, normals and weights: an error that names them, on every rank."""

import basix.ufl
import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from scenes.blocks import Block, block
from scenes.comparing import close, raised_everywhere
from scenes.sound import build_and_solve, coulomb, pressed

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
    """μ < 0, k_n ≤ 0, k_t ≤ 0 and what is not finite, as numbers: refused by `Contact`."""
    scene = pressed()
    raised_everywhere(lambda: scene.contact(coulomb(**{name: value})), ValueError, name, "contact")


@pytest.mark.whole
@pytest.mark.parametrize(("name", "value"), BAD_NUMBERS)
def test_parameter_out_of_range_by_constant(name, value):
    """The same as a ``fem.Constant``: refused by `ContactProblem`."""
    scene = pressed()
    law = coulomb(**{name: fem.Constant(scene.mesh, float(value))})
    raised_everywhere(lambda: scene.problem(law, scene.rollers()), ValueError, name)


@pytest.mark.each
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


@pytest.mark.whole
@pytest.mark.parametrize("value", [2, 0, -4, 3.5, "5", True])
def test_polygon_of_too_few_sides(value):
    """A polygon has a whole number of sides, three or more: refused by the law itself."""
    for law in (fc.Coulomb, lambda mu, **kwargs: fc.Tresca(mu, 1.0, **kwargs)):
        raised_everywhere(
            lambda law=law: law(0.3, modes=value), ValueError, "modes", repr(value), "at least 3"
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


@pytest.mark.each
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


@pytest.mark.whole
@pytest.mark.parametrize(
    ("name", "value"),
    [("k_n", -1.0), ("k_n", np.inf), ("k_t", -1.0), ("k_t", np.nan)],
)
def test_foundation_out_of_range(name, value):
    """Stiffness of a foundation, k_n, k_t ≥ 0; a number is refused at once, else at a solve."""
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


@pytest.mark.whole
@pytest.mark.parametrize("value", ["rough", "0.3", True, 0.3 + 1j, {}, ["a", "b"], [[1.0], 2.0]])
def test_parameter_of_a_wrong_type(value):
    """What cannot be a coefficient is a TypeError that names the parameter."""
    scene = pressed()
    raised_everywhere(lambda: scene.contact(coulomb(value)), TypeError, "friction")


def test_whole_numbers_of_any_size():
    """Python's integers have no end; 10**30 is 1e30, and what no float can hold is refused."""
    scene = block(n=2, up=-1.0)
    _, contact = scene.problem(fc.Frictionless(k_n=10**30), scene.rollers())
    assert contact.parameters["k_n"].value == 1e30
    words = "k_n is 1000"
    raised_everywhere(lambda: scene.contact(fc.Frictionless(k_n=10**400)), TypeError, words)


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


@pytest.mark.whole
@pytest.mark.parametrize("factor", [0.0, -1.0, np.nan, np.inf, "10"])
def test_scaled_factor_out_of_range(factor):
    """A factor of E/h is a positive number."""
    raised_everywhere(lambda: fc.RelativeStiffness(factor), ValueError, "factor")


# ---- gap, normal, weight, modulus ----------------------------------------------------------------


@pytest.mark.whole
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


@pytest.mark.parametrize("kind", ["number", "constant", "ufl"])
def test_weight_of_zero(kind):
    """A contact without any thickness would let the body through, without a word."""
    scene = pressed()
    weight = {
        "number": 0.0,
        "constant": fem.Constant(scene.mesh, 0.0),
        "ufl": ufl.SpatialCoordinate(scene.mesh)[1],  # the height of the bottom
    }[kind]
    raised_everywhere(
        lambda: scene.problem(coulomb(), scene.rollers(), contact={"weight": weight}),
        ValueError,
        "weight is zero at every point",
    )


@pytest.mark.parametrize("obstacle", ["obstacle", "half-space"])
def test_normal_of_length_zero_at_a_point(obstacle):
    """A normal by UFL that vanishes over one half of Γc: refused, as a normal of length zero."""
    scene = pressed()
    x = ufl.SpatialCoordinate(scene.mesh)
    normal = ufl.as_vector([0, ufl.conditional(ufl.gt(x[0], 0.5), -1.0, 0.0)])
    made = {"obstacle": fc.PrescribedGap(0.0, normal), "half-space": fc.HalfSpace((0, 0), -normal)}
    raised_everywhere(
        lambda: scene.problem(coulomb(), scene.rollers(), contact={"obstacle": made[obstacle]}),
        ValueError,
        "normal",
        "length",
    )


def test_normal_not_finite():
    """A normal by UFL that is NaN somewhere."""
    scene = pressed()
    x = ufl.SpatialCoordinate(scene.mesh)
    obstacle = fc.PrescribedGap(0.0, ufl.as_vector([ufl.sqrt(x[0] - 0.5), -1.0]))
    raised_everywhere(
        lambda: scene.problem(coulomb(), scene.rollers(), contact={"obstacle": obstacle}),
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


@pytest.mark.whole
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


@pytest.mark.whole
@pytest.mark.parametrize("what", ["friction", "gap", "weight", "displacement", "normal"])
def test_data_that_depend_on_the_displacement(what):
    """Data are numbers while an increment is solved: what follows from u is none, and is named."""
    scene = pressed()
    part = scene.u.sub(1)  # its array is that of u
    grows = 0.3 + ufl.div(scene.u) ** 2
    contact = {
        "friction": {},
        "gap": {"gap": abs(part)},
        "weight": {"weight": 1 + grows},
        "displacement": {"displacement": ufl.as_vector([0.0, 0.1 * scene.u[1]])},
        "normal": {"obstacle": fc.PrescribedGap(0.0, ufl.as_vector([scene.u[0], -1.0]))},
    }[what]
    law = coulomb(friction=grows if what == "friction" else 0.3)
    raised_everywhere(lambda: scene.contact(law, **contact), ValueError, what, "the unknown", "u")


def test_data_of_another_mesh_or_form():
    """A function on another mesh, or a test function, has no value at the points of Γc."""
    scene, other = pressed(), pressed()
    far = coulomb(friction=0.3 + other.u[0] ** 2)
    raised_everywhere(lambda: scene.contact(far), ValueError, "friction", "another mesh")
    v = ufl.TestFunction(scene.u.function_space)
    raised_everywhere(lambda: scene.contact(coulomb(friction=v[0])), ValueError, "friction", "test")


DATA = ["friction", "gap", "weight"]


def with_data(scene, what, value):
    """A contact with one of its data given so."""
    contact = {} if what == "friction" else {what: value}
    return scene.contact(coulomb(friction=value if what == "friction" else 0.3), **contact)


@pytest.mark.whole
@pytest.mark.parametrize("what", DATA)
def test_data_in_single_precision(what):
    """A constant of np.float32 cannot stand in a form of doubles."""
    scene = pressed()
    value = fem.Constant(scene.mesh, np.float32(0.3))
    raised_everywhere(lambda: with_data(scene, what, value), ValueError, what, "float32", "double")


@pytest.mark.whole
@pytest.mark.parametrize("what", DATA)
def test_data_at_other_points(what):
    """Values at quadrature points of cells, or of Γc by another rule, are none at those of Γc.

    Those of its own rule are, and give the force of the same number.
    """
    scene = pressed()

    def at_points(mesh, cell, degree):
        element = basix.ufl.quadrature_element(cell, degree=degree)
        value = fem.Function(fem.functionspace(mesh, element))
        value.x.array[:] = 0.2
        return value

    facets = scene.surface.submesh
    for value in (at_points(scene.mesh, "quadrilateral", 2), at_points(facets, "interval", 4)):
        refused = ValueError, what, "quadrature element", "DG"
        raised_everywhere(lambda value=value: with_data(scene, what, value), *refused)
    forces = []
    for value in (at_points(facets, "interval", 2), 0.2):
        contact = with_data(scene, what, value)
        problem = fc.ContactProblem(scene.F, scene.u, bcs=scene.rollers(), contacts=[contact])
        problem.solve()
        forces.append(contact.resultants().force)
        scene.u.x.array[:] = 0.0
    assert close(*forces, 1e-12)


@pytest.mark.whole
@pytest.mark.parametrize("what", DATA)
def test_data_that_cannot_be_compiled(what):
    """Areas of facets of quadrilaterals are known to no form compiler: said of what, and why."""
    scene = pressed()
    value = 0.1 * ufl.FacetArea(scene.mesh)
    words = what, "cannot be compiled", "FacetArea", "fem.Function"
    raised_everywhere(lambda: with_data(scene, what, value), ValueError, *words)
