"""Typical mistakes in scripts are refused or warned of on all ranks; none is ignored."""

from __future__ import annotations

import warnings
from functools import partial
from pathlib import Path

import basix
import dolfinx
import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact import output
from fenics_contact.histories.increments import depends_on
from fenics_contact.systems.measures import check_measures
from scenes.blocks import BOTTOM, TOP, block_mesh
from scenes.comparison import assert_raised_on_all_ranks
from scenes.stacks import LOWER, SIDES, UPPER, stack
from scenes.valid_problem import LAYERED_MESH, coulomb_law, pressed_block

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]
COMM = MPI.COMM_WORLD
MAX_COORDINATE = 77


def bulk(scene, ds, tag):
    """Return a bulk form with a unit pressure on a tag of the measure."""
    v = ufl.TestFunction(scene.u.function_space)
    eps = ufl.sym(ufl.grad(scene.u))
    return ufl.inner(1000 * eps, ufl.grad(v)) * ufl.dx + v[1] * ds(tag)


@pytest.mark.parametrize("scheme", ["default", "vertex"])
def test_quadrature_elements_do_not_depend_on_print_options(scheme):
    """Printed numbers in the names of quadrature elements do not depend on set_printoptions.

    Equal elements of different names in a form may cause a KeyError of FFCx: names are compared.
    """
    scene = pressed_block(surface={"quadrature_scheme": scheme})
    quadrature = scene.contact(coulomb_law()).quadrature
    for size in (None, 2):
        before = quadrature.space(size).ufl_element()
        with np.printoptions(precision=3, suppress=True, linewidth=20, floatmode="fixed"):
            after = quadrature.space(size).ufl_element()
        assert after == before and repr(after) == repr(before)


def test_samples_do_not_depend_on_print_options():
    """Rules of degree 3 and 4, both of six points, give values at their own points (1e-14).

    The points print alike. Of three ranks one has no cells.
    """
    mesh = dolfinx.mesh.create_unit_square(COMM, 1, 1)
    x = ufl.SpatialCoordinate(mesh)
    with np.printoptions(formatter={"float": lambda _: "."}):
        for degree in (3, 4):
            places, values = output.sample(x[0] ** 5, mesh, degree)
            # The reference is the same expression in NumPy, to round-off.
            assert values == pytest.approx(places[:, 0] ** 5, abs=1e-14)
            rule, _ = basix.make_quadrature(basix.CellType.triangle, degree)
            assert places[:, 0].min() == pytest.approx(rule.min(), abs=1e-14)


def problem_of(scene, F=None, bcs=None):
    """Return a problem with contact at the bottom and a given form."""
    bcs = scene.rollers() if bcs is None else bcs
    if F is None:
        return scene.problem(coulomb_law(), bcs)[0]
    return fc.ContactProblem(F, scene.u, bcs=bcs, contacts=[scene.contact(coulomb_law())])


def test_swapped_function_and_form_are_refused():
    """The error for swapped function and form states their order."""
    scene = pressed_block()
    F = bulk(scene, ufl.ds(scene.mesh, subdomain_data=scene.tags), TOP)
    assert_raised_on_all_ranks(
        lambda: fc.ContactProblem(scene.u, F), ValueError, "ContactProblem(F, u)"
    )


def test_energy_instead_of_a_residual_is_refused():
    """The error states how to derive a residual from the energy."""
    scene = pressed_block()
    energy = ufl.inner(ufl.grad(scene.u), ufl.grad(scene.u)) * ufl.dx
    assert_raised_on_all_ranks(
        lambda: problem_of(scene, energy), ValueError, "ufl.derivative(energy, u, v)"
    )


def test_wrong_arguments_of_increments_are_refused():
    """A contact is refused as problem, and a number as load: it is not taken for the start."""
    scene = pressed_block()
    contact = scene.contact(coulomb_law())
    assert_raised_on_all_ranks(
        lambda: fc.increments(contact, scene.E), ValueError, "problem is a Contact"
    )
    problem = problem_of(scene)
    assert_raised_on_all_ranks(lambda: fc.increments(problem, 0, 1), ValueError, "load is a int")


def test_measure_without_tags_is_refused():
    """DOLFINx evaluates ``ufl.ds(2)`` without tags to zero, so that the load would vanish."""
    scene = pressed_block()
    F = bulk(scene, ufl.ds(scene.mesh), TOP)
    assert_raised_on_all_ranks(
        lambda: problem_of(scene, F), ValueError, f"ds({TOP})", "subdomain_data=tags"
    )


@pytest.mark.parametrize("pairs", [False, True])
def test_tag_without_facets_in_a_measure_warns(pairs):
    """The bulk form has mesh tags, or pairs of a number and entities, as subdomain data."""
    scene = pressed_block()
    data = scene.tags
    if pairs:  # the entities are arbitrary: nothing is compiled
        data = [(TOP, np.zeros(2 * len(scene.tags.find(TOP)), dtype=np.int32))]
    ds = ufl.Measure("ds", scene.mesh, subdomain_data=data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_measures(bulk(scene, ds, TOP), scene.mesh)
    with pytest.warns(UserWarning, match=rf"over ds\({MAX_COORDINATE}\), but nothing"):
        check_measures(bulk(scene, ds, MAX_COORDINATE), scene.mesh)


def test_problem_with_a_tag_without_facets_warns():
    """The warning for a tag without facets is issued when the problem is created."""
    scene = pressed_block()
    ds = ufl.Measure("ds", scene.mesh, subdomain_data=scene.tags)
    with pytest.warns(UserWarning, match=rf"over ds\({MAX_COORDINATE}\), but nothing"):
        problem_of(scene, bulk(scene, ds, MAX_COORDINATE))


def test_condition_without_dofs_warns():
    """The warning states which Dirichlet condition has no effect, next to others that have."""
    scene = pressed_block()
    V = scene.u.function_space
    dofs = fem.locate_dofs_topological(V, 1, scene.tags.find(MAX_COORDINATE))
    empty = fem.dirichletbc(fem.Function(V), dofs)
    bcs = [*scene.rollers(), empty]
    with pytest.warns(UserWarning, match=rf"bcs\[{len(bcs) - 1}\] has no effect"):
        problem_of(scene, bcs=bcs)


def test_tags_of_another_mesh_are_refused():
    """Facet numbers of another mesh are refused, even if the meshes are created alike."""
    scene = pressed_block()
    mesh, other = block_mesh("quadrilateral", **LAYERED_MESH)
    fc.ContactSurface(mesh, other, BOTTOM)
    assert_raised_on_all_ranks(
        lambda: fc.ContactSurface(scene.mesh, other, BOTTOM), ValueError, "of another mesh"
    )
    assert_raised_on_all_ranks(
        lambda: scene.contact(coulomb_law(), obstacle=fc.DeformableBody(other, TOP)),
        ValueError,
        "of another mesh",
    )


def same_obstacle_warnings(make):
    """Return the warnings that contacts have the same obstacle."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        make()
    return [str(one.message) for one in caught if "same obstacle" in str(one.message)]


def warnings_of_second_contact(scene, obstacle, **options):
    """Return the same-obstacle warnings for a second contact of the bottom besides the floor."""
    contacts = [
        scene.contact(coulomb_law(), name="floor"),
        scene.contact(coulomb_law(), name="other", obstacle=obstacle, **options),
    ]
    return same_obstacle_warnings(
        lambda: fc.ContactProblem(scene.F, scene.u, bcs=scene.rollers(), contacts=contacts)
    )


def test_two_contacts_with_the_same_obstacle_warn():
    """Each contact would carry half of the force: one warning has both names and the two facets."""
    scene = pressed_block()
    plane = fc.HalfSpace(point=(0.3, 0.0), normal=(0.0, 2.0))
    for obstacle in (scene.floor(), plane):
        (caught,) = warnings_of_second_contact(scene, obstacle)
        assert caught.startswith("floor and other have the same obstacle at 2 facets")


def test_different_obstacles_of_one_surface_do_not_warn():
    """An obstacle with another point, normal, displacement or gap than the floor is different."""
    scene = pressed_block()
    moved = fem.Constant(scene.mesh, np.zeros(2))
    assert not warnings_of_second_contact(scene, fc.HalfSpace(point=(0.0, -0.1), normal=(0.0, 1.0)))
    assert not warnings_of_second_contact(scene, fc.HalfSpace(point=(0.0, 0.0), normal=(-0.1, 1.0)))
    assert not warnings_of_second_contact(scene, scene.floor(displacement=moved))
    assert not warnings_of_second_contact(scene, scene.floor(), gap=0.1)
    assert warnings_of_second_contact(scene, scene.floor(), gap=0.0)


@pytest.mark.parametrize("kinematics", ["small", "finite"])
def test_two_contacts_with_the_same_opposing_body_warn(kinematics):
    """The lowest of three blocks faces both others without a warning, but not one of them twice."""
    body = stack("quadrilateral", (2, 3, 4), (1.0, 1.0, 1.0), gap=0.1)
    body.prescribe(SIDES, 0, 1)
    for tags, n_told in (((10 + UPPER, 20 + UPPER), 0), ((10 + UPPER, 10 + UPPER), 1)):
        contacts = [
            body.contact(10 + LOWER, tag, fc.Frictionless(1e6), kinematics=kinematics, name=name)
            for tag, name in zip(tags, ("near", "other"), strict=True)
        ]
        assert len(same_obstacle_warnings(partial(body.problem, *contacts))) == n_told


@pytest.mark.parametrize("force", [(None, 1.0), np.array([None, 1.0])])
def test_obstacles_with_prescribed_forces_do_not_warn(force):
    """Each obstacle moves by its own force and carries all of it, given as tuple or array."""
    scene = pressed_block()
    contacts = [
        scene.contact(coulomb_law(), name=name, displacement=fc.Motion(force=force))
        for name in ("floor", "other")
    ]
    bcs = [*scene.rollers(), scene.dirichlet_bc(TOP, 1)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fc.ContactProblem(scene.F, scene.u, bcs=bcs, contacts=contacts)


def test_load_without_effect_warns():
    """A constant causes a warning if it does not occur in the problem, whatever its value."""
    scene = pressed_block()
    problem = problem_of(scene)
    with pytest.warns(UserWarning, match="neither F, nor a Dirichlet condition, nor a contact"):
        list(fc.increments(problem, fem.Constant(scene.mesh, 0.0), 0, 1))


@pytest.mark.whole
@pytest.mark.parametrize("where", ["form", "condition", "obstacle", "force", "friction", "gap"])
def test_load_is_found_wherever_it_occurs(where):
    """`depends_on` finds a load in any part of the problem and leaves its value unchanged."""
    scene = pressed_block()
    load = fem.Constant(scene.mesh, 0.25)
    bcs, F, law, options = scene.rollers(), scene.F, coulomb_law(), {}
    if where == "form":
        F = F + load * ufl.TestFunction(scene.u.function_space)[0] * ufl.dx
    elif where == "condition":
        V = scene.u.function_space
        dofs = fem.locate_dofs_topological(V.sub(1), 1, scene.tags.find(TOP))
        bcs = [*bcs, fem.dirichletbc(load, dofs, V.sub(1))]
    elif where == "obstacle":
        options["obstacle"] = fc.HalfSpace((0, 0), (0, 1), displacement=ufl.as_vector([load, 0.0]))
    elif where == "force":
        motion = fc.Motion(force=(None, load), displacement=(0.0, None))
        options["obstacle"] = fc.HalfSpace((0, 0), (0, 1), displacement=motion)
        bcs = [*bcs, scene.dirichlet_bc(TOP, 1)]
    elif where == "friction":
        law = coulomb_law(load)
    else:
        options["gap"] = load
    contact = scene.contact(law, **options)
    problem = fc.ContactProblem(F, scene.u, bcs=bcs, contacts=[contact])
    assert depends_on(problem, load)
    assert not depends_on(problem, fem.Constant(scene.mesh, 0.25))
    assert load.value == 0.25


def test_constant_in_a_tuple_is_refused():
    """The error for a constant among numbers states how to write the vector."""
    scene = pressed_block()
    displacement = fem.Constant(scene.mesh, 0.0)
    obstacle = fc.HalfSpace((0, 0), (0, 1), displacement=(displacement, 0.0))
    assert_raised_on_all_ranks(
        lambda: scene.contact(coulomb_law(), obstacle=obstacle),
        TypeError,
        "ufl.as_vector([displacement, 0.0])",
    )


def test_uncommitted_solution_warns_once():
    """A loop without ``commit`` warns once, but not after ``restore`` or without friction."""
    scene = pressed_block()
    problem = problem_of(scene)
    problem.solve()
    with pytest.warns(UserWarning, match="increment 1 was solved but not committed"):
        problem.solve()
    scene = pressed_block()
    smooth, _ = scene.problem(fc.Frictionless(k_n=1e4), scene.rollers())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        problem.solve()
        smooth.solve()
        smooth.solve()
        other = problem_of(pressed_block())
        other.solve()
        other.restore()
        other.solve()
        other.commit()
        other.solve()


def test_jump_of_the_load_warns():
    """A load path that starts again warns of the jump; one from the present load does not."""
    scene = pressed_block()
    problem = problem_of(scene)
    pull = scene.E  # any constant of the form
    value = float(pull.value)
    list(fc.increments(problem, pull, value, 2 * value))
    with pytest.warns(UserWarning, match="will not be solved"):
        list(fc.increments(problem, pull, value, 1.5 * value))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        list(fc.increments(problem, pull, 1.5 * value, value))


def test_missing_folder_of_a_picture_is_named(tmp_path: Path):
    """The error names the missing folder, not a temporary file in it."""
    scene = pressed_block()
    contact = scene.contact(coulomb_law())
    path = Path(COMM.bcast(str(tmp_path))) / "nowhere" / "pressure.png"
    assert_raised_on_all_ranks(
        lambda: fc.plotting.plot_pressure(path, contact), OSError, f"no folder {path.parent}"
    )


def test_checkpoint_in_a_read_only_folder_is_refused():
    """The call is refused before any work; /proc is not writable, even for root."""
    scene = pressed_block()
    problem = problem_of(scene)
    assert_raised_on_all_ranks(
        lambda: fc.increments(problem, scene.E, 1, 2, checkpoint="/proc/state.npz"),
        OSError,
        "folder /proc is not writable",
    )
