"""Mistakes of a first script: each is refused or warned of on all ranks, and nothing is silent."""

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
from scenes.comparing import raised_everywhere
from scenes.sound import MESH, coulomb, pressed
from scenes.stacks import LOWER, SIDES, UPPER, stack

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]
COMM = MPI.COMM_WORLD
MAX_COORDINATE = 77


def bulk(scene, ds, tag):
    """The scene's stiffness, and a pressure of one on a tag of the measure."""
    v = ufl.TestFunction(scene.u.function_space)
    eps = ufl.sym(ufl.grad(scene.u))
    return ufl.inner(1000 * eps, ufl.grad(v)) * ufl.dx + v[1] * ds(tag)


@pytest.mark.parametrize("scheme", ["default", "vertex"])
def test_numbers_printed_otherwise(scheme):
    """Quadrature elements have printed numbers in their names: no others after set_printoptions.

    Equal ones of two names in a form end, by chance, in a KeyError of FFCx: names are compared.
    """
    scene = pressed(surface={"quadrature_scheme": scheme})
    quadrature = scene.contact(coulomb()).quadrature
    for size in (None, 2):
        before = quadrature.space(size).ufl_element()
        with np.printoptions(precision=3, suppress=True, linewidth=20, floatmode="fixed"):
            after = quadrature.space(size).ufl_element()
        assert after == before and repr(after) == repr(before)


def test_points_that_are_printed_alike():
    """Those of degree 3 and 4, six a triangle: at each the values are those of its own places.

    Of three ranks one has no cells.
    """
    mesh = dolfinx.mesh.create_unit_square(COMM, 1, 1)
    x = ufl.SpatialCoordinate(mesh)
    with np.printoptions(formatter={"float": lambda _: "."}):
        for degree in (3, 4):
            places, values = output.sample(x[0] ** 5, mesh, degree)
            # The same expression in NumPy, to its round-off.
            assert values == pytest.approx(places[:, 0] ** 5, abs=1e-14)
            rule, _ = basix.make_quadrature(basix.CellType.triangle, degree)
            assert places[:, 0].min() == pytest.approx(rule.min(), abs=1e-14)


def problem_of(scene, F=None, bcs=None):
    """On the bottom, by any form."""
    bcs = scene.rollers() if bcs is None else bcs
    if F is None:
        return scene.problem(coulomb(), bcs)[0]
    return fc.ContactProblem(F, scene.u, bcs=bcs, contacts=[scene.contact(coulomb())])


def test_the_order_of_a_problem():
    """Function and form swapped."""
    scene = pressed()
    F = bulk(scene, ufl.ds(scene.mesh, subdomain_data=scene.tags), TOP)
    raised_everywhere(lambda: fc.ContactProblem(scene.u, F), ValueError, "ContactProblem(F, u)")


def test_an_energy_for_a_residual():
    """It is said how to make one of it."""
    scene = pressed()
    energy = ufl.inner(ufl.grad(scene.u), ufl.grad(scene.u)) * ufl.dx
    raised_everywhere(lambda: problem_of(scene, energy), ValueError, "ufl.derivative(energy, u, v)")


def test_increments_of_what():
    """Of a contact; of a number, which is not taken for the start."""
    scene = pressed()
    contact = scene.contact(coulomb())
    raised_everywhere(lambda: fc.increments(contact, scene.E), ValueError, "problem is a Contact")
    problem = problem_of(scene)
    raised_everywhere(lambda: fc.increments(problem, 0, 1), ValueError, "load is a int")


def test_a_measure_without_tags():
    """``ufl.ds(2)`` of no tags is zero for DOLFINx, and so would be the load."""
    scene = pressed()
    F = bulk(scene, ufl.ds(scene.mesh), TOP)
    raised_everywhere(lambda: problem_of(scene, F), ValueError, f"ds({TOP})", "subdomain_data=tags")


@pytest.mark.parametrize("pairs", [False, True])
def test_a_tag_of_nothing(pairs):
    """In the bulk form; tags as they are, and as pairs of a number and entities."""
    scene = pressed()
    data = scene.tags
    if pairs:  # what stands there does not matter here, nothing is compiled
        data = [(TOP, np.zeros(2 * len(scene.tags.find(TOP)), dtype=np.int32))]
    ds = ufl.Measure("ds", scene.mesh, subdomain_data=data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_measures(bulk(scene, ds, TOP), scene.mesh)
    with pytest.warns(UserWarning, match=rf"over ds\({MAX_COORDINATE}\), but nothing"):
        check_measures(bulk(scene, ds, MAX_COORDINATE), scene.mesh)


def test_a_problem_with_a_tag_of_nothing():
    """It is told when the problem is made."""
    scene = pressed()
    ds = ufl.Measure("ds", scene.mesh, subdomain_data=scene.tags)
    with pytest.warns(UserWarning, match=rf"over ds\({MAX_COORDINATE}\), but nothing"):
        problem_of(scene, bulk(scene, ds, MAX_COORDINATE))


def test_a_condition_on_nothing():
    """A tag that no facet has, with those that hold: it is told which."""
    scene = pressed()
    V = scene.u.function_space
    dofs = fem.locate_dofs_topological(V, 1, scene.tags.find(MAX_COORDINATE))
    empty = fem.dirichletbc(fem.Function(V), dofs)
    bcs = [*scene.rollers(), empty]
    with pytest.warns(UserWarning, match=rf"bcs\[{len(bcs) - 1}\] has no effect"):
        problem_of(scene, bcs=bcs)


def test_tags_of_another_mesh():
    """Numbers of facets mean others there, even if the meshes are made alike."""
    scene = pressed()
    mesh, other = block_mesh("quadrilateral", **MESH)
    fc.ContactSurface(mesh, other, BOTTOM)
    raised_everywhere(
        lambda: fc.ContactSurface(scene.mesh, other, BOTTOM), ValueError, "of another mesh"
    )
    raised_everywhere(
        lambda: scene.contact(coulomb(), obstacle=fc.DeformableBody(other, TOP)),
        ValueError,
        "of another mesh",
    )


def told_of_doubles(make):
    """What is warned of obstacles that are one."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        make()
    return [str(one.message) for one in told if "same obstacle" in str(one.message)]


def doubled(scene, obstacle, **options):
    """A contact of the bottom beside that with the floor, and what is warned of."""
    contacts = [
        scene.contact(coulomb(), name="floor"),
        scene.contact(coulomb(), name="other", obstacle=obstacle, **options),
    ]
    return told_of_doubles(
        lambda: fc.ContactProblem(scene.F, scene.u, bcs=scene.rollers(), contacts=contacts)
    )


def test_one_obstacle_twice():
    """Each would bear half of the force: warned of once, with names and facets, two of them."""
    scene = pressed()
    plane = fc.HalfSpace(point=(0.3, 0.0), normal=(0.0, 2.0))
    for obstacle in (scene.floor(), plane):
        (told,) = doubled(scene, obstacle)
        assert told.startswith("floor and other have the same obstacle at 2 facets")


def test_two_obstacles_of_one_surface():
    """Another place, another way to move, a gap of its own: none of them is the floor."""
    scene = pressed()
    moved = fem.Constant(scene.mesh, np.zeros(2))
    assert not doubled(scene, fc.HalfSpace(point=(0.0, -0.1), normal=(0.0, 1.0)))
    assert not doubled(scene, fc.HalfSpace(point=(0.0, 0.0), normal=(-0.1, 1.0)))
    assert not doubled(scene, scene.floor(displacement=moved))
    assert not doubled(scene, scene.floor(), gap=0.1)
    assert doubled(scene, scene.floor(), gap=0.0)


@pytest.mark.parametrize("kinematics", ["small", "finite"])
def test_two_bodies_over_one_surface(kinematics):
    """The lowest of three blocks sees both others, one behind the other; then one of them twice."""
    body = stack("quadrilateral", (2, 3, 4), (1.0, 1.0, 1.0), apart=0.1)
    body.hold(SIDES, 0, 1)
    for tags, n_told in (((10 + UPPER, 20 + UPPER), 0), ((10 + UPPER, 10 + UPPER), 1)):
        contacts = [
            body.contact(10 + LOWER, tag, fc.Frictionless(1e6), kinematics=kinematics, name=name)
            for tag, name in zip(tags, ("near", "other"), strict=True)
        ]
        assert len(told_of_doubles(partial(body.problem, *contacts))) == n_told


@pytest.mark.parametrize("force", [(None, 1.0), np.array([None, 1.0])])
def test_two_obstacles_each_pressed_by_a_force(force):
    """Each moves by its own force and bears all of that: not one obstacle, however it is given."""
    scene = pressed()
    contacts = [
        scene.contact(coulomb(), name=name, displacement=fc.Motion(force=force))
        for name in ("floor", "other")
    ]
    bcs = [*scene.rollers(), scene.hold(TOP, 1)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fc.ContactProblem(scene.F, scene.u, bcs=bcs, contacts=contacts)


def test_a_load_that_nothing_reads():
    """A constant whose value, not itself, stands in the form."""
    scene = pressed()
    problem = problem_of(scene)
    with pytest.warns(UserWarning, match="neither F, nor a Dirichlet condition, nor a contact"):
        list(fc.increments(problem, fem.Constant(scene.mesh, 0.0), 0, 1))


@pytest.mark.whole
@pytest.mark.parametrize("where", ["form", "condition", "obstacle", "force", "friction", "gap"])
def test_a_load_that_something_reads(where):
    """No warning, wherever it stands, and its value is as before."""
    scene = pressed()
    load = fem.Constant(scene.mesh, 0.25)
    bcs, F, law, options = scene.rollers(), scene.F, coulomb(), {}
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
        bcs = [*bcs, scene.hold(TOP, 1)]
    elif where == "friction":
        law = coulomb(load)
    else:
        options["gap"] = load
    contact = scene.contact(law, **options)
    problem = fc.ContactProblem(F, scene.u, bcs=bcs, contacts=[contact])
    assert depends_on(problem, load)
    assert not depends_on(problem, fem.Constant(scene.mesh, 0.25))
    assert load.value == 0.25


def test_components_in_a_tuple():
    """A constant among numbers: it is said how to write it."""
    scene = pressed()
    way = fem.Constant(scene.mesh, 0.0)
    obstacle = fc.HalfSpace((0, 0), (0, 1), displacement=(way, 0.0))
    raised_everywhere(
        lambda: scene.contact(coulomb(), obstacle=obstacle),
        TypeError,
        "ufl.as_vector([displacement, 0.0])",
    )


def test_a_solution_that_is_not_committed():
    """A loop without ``commit``: told once; not after ``restore``, and not where nothing rubs."""
    scene = pressed()
    problem = problem_of(scene)
    problem.solve()
    with pytest.warns(UserWarning, match="increment 1 was solved but not committed"):
        problem.solve()
    scene = pressed()
    smooth, _ = scene.problem(fc.Frictionless(k_n=1e4), scene.rollers())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        problem.solve()
        smooth.solve()
        smooth.solve()
        other = problem_of(pressed())
        other.solve()
        other.restore()
        other.solve()
        other.commit()
        other.solve()


def test_a_history_that_jumps():
    """Led to 1, and then from 0 anew: the way back is not solved for. From where it is: silent."""
    scene = pressed()
    problem = problem_of(scene)
    pull = scene.E  # any constant of the form
    value = float(pull.value)
    list(fc.increments(problem, pull, value, 2 * value))
    with pytest.warns(UserWarning, match="will not be solved"):
        list(fc.increments(problem, pull, value, 1.5 * value))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        list(fc.increments(problem, pull, 1.5 * value, value))


def test_folders_that_are_not_there(tmp_path: Path):
    """Of a picture: the folder is named, not a temporary file in it."""
    scene = pressed()
    contact = scene.contact(coulomb())
    path = Path(COMM.bcast(str(tmp_path))) / "nowhere" / "pressure.png"
    raised_everywhere(
        lambda: fc.plotting.plot_pressure(path, contact), OSError, f"no folder {path.parent}"
    )


def test_a_checkpoint_where_nothing_can_be_written():
    """Before any work; /proc is such a folder, for root, too."""
    scene = pressed()
    problem = problem_of(scene)
    raised_everywhere(
        lambda: fc.increments(problem, scene.E, 1, 2, checkpoint="/proc/state.npz"),
        OSError,
        "folder /proc is not writable",
    )
