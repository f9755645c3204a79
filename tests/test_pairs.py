"""Several contacts in a problem: springs in series and in parallel, stacks, sliding joints.

References are closed-form solutions or invariants. The solver's tolerance on forces is 1e-9:
uniform values are accurate to 1e-9, other solutions to 1e-8, sums of forces to round-off, 1e-12.
"""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from scenes.comparison import gather, is_close
from scenes.stacks import (
    FLOOR,
    LOWER,
    ROOF,
    SIDES,
    UPPER,
    WALL,
    E,
    floor,
    force_resultants,
    is_uniform,
    joint,
    stack,
)
from scenes.tags import at_coordinate

COMM = MPI.COMM_WORLD

pytestmark = [pytest.mark.three_ranks, pytest.mark.hexahedra]


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "hexahedron"])
def test_uniform_pressure_of_three_blocks_on_a_floor(cell, degree):
    """Joints of different meshes and stiffnesses have the same pressure: springs in series."""
    q, stiffness, heights = 5e3, (1e7, 3e6, 2e7), (0.5, 0.25, 0.75)
    body = stack(cell, (3, 5, 4), heights, degree=degree)
    body.prescribe(SIDES, *range(body.d - 1))
    up = body.d - 1
    body.F += q * body.v[up] * body.ds(ROOF)
    contacts = [floor(body, fc.Frictionless(stiffness[0]))]
    contacts += [joint(body, j, fc.Frictionless(stiffness[j]), swap=j == 2) for j in (1, 2)]
    problem = body.problem(*contacts)
    step = problem.solve()
    assert list(step.contacts) == ["floor", "joint 1", "joint 2"]
    for contact, k in zip(contacts, stiffness, strict=True):
        assert contact.pairs.n_unpaired == 0
        assert is_uniform(contact.pressure, q)
        assert is_uniform(contact.gap, -q / k)
    top = fem.locate_dofs_topological(body.u.function_space.sub(up), up, body.tags.find(ROOF))
    sunk = q * (sum(heights) / E + sum(1 / k for k in stiffness))
    top = top[top < body.u.function_space.dofmap.index_map.size_local * body.d]
    assert is_uniform(body.u.x.array[top], -sunk)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_sheared_stack_constrained_by_friction_alone(method):
    """Without Dirichlet conditions all joints have the same force, 1e-8, and uneven pressures."""
    q, t = 5e3, 0.1 * 5e3
    body = stack("quadrilateral", (6, 9, 4), (0.3, 0.2, 0.3), nu=0.3)
    body.F += (q * body.v[1] - t * body.v[0]) * body.ds(ROOF)
    law = fc.Coulomb(0.4, k_n=1e7, k_t=1e7)
    contacts = [floor(body, law), joint(body, 1, law), joint(body, 2, law)]
    problem = body.problem(*contacts, method=method)
    problem.solve()
    for contact in contacts:
        assert is_close(contact.resultants().force, [-t, q], 1e-8)
        # Moment about the middle of the joint: the lever arm of the shear is the height above it.
        points = contact.gather()
        lever = points["measure"] * (points["x"][:, 0] - 0.5)
        moment = lever @ points["pressure"]
        height = 0.8 - points["x"][0, 1]
        assert is_close(moment, t * height, 1e-7)
        assert np.ptp(points["pressure"]) > 0.1 * q


def test_weakest_joint_slips_and_the_others_stick():
    """Of joints with μ = 0.5, 0.1, 0.5 the middle one slips everywhere: all have T = 0.1 N."""
    body = stack("triangle", (6, 9, 4), (0.3, 0.2, 0.3), nu=0.3)
    q, push = 5e3, body.constant(0.0)
    body.F += q * body.v[1] * body.ds(ROOF)
    body.prescribe(ROOF, 0, value=push)
    laws = [fc.Coulomb(mu, k_n=1e7, k_t=1e7) for mu in (0.5, 0.1, 0.5)]
    contacts = [floor(body, laws[0])] + [joint(body, j, laws[j]) for j in (1, 2)]
    problem = body.problem(*contacts)
    list(fc.increments(problem, push, 0.0, 0.02, steps=4))
    first, middle, last = (contact.resultants() for contact in contacts)
    assert middle.stick == 0 and first.stick > 0 and last.stick > 0
    for r in (first, middle, last):
        assert is_close(r.force, [-0.1 * q, q], 1e-7)


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_block_between_floor_and_wall(cell):
    """A block in a corner under two pressures: both contacts are exact, with an edge in common."""
    nu, q, side, k = 0.3, 3e3, 2e3, 1e7
    body = stack(
        cell, (4,), (1.0,), nu=nu, tags={WALL: at_coordinate(0, 0), 9: at_coordinate(0, 1)}
    )
    up = body.d - 1
    if body.d == 3:  # plane strain
        body.prescribe(SIDES, 1)
    body.F += q * body.v[up] * body.ds(ROOF) + side * body.v[0] * body.ds(9)
    upright = fc.HalfSpace(np.zeros(body.d), np.eye(body.d)[0])
    wall = body.contact(WALL, upright, fc.Frictionless(k), name="wall")
    base = floor(body, fc.Frictionless(k))
    body.problem(base, wall).solve()
    assert is_uniform(base.pressure, q)
    assert is_uniform(wall.pressure, side)
    modulus, ratio = E / (1 - nu**2), nu / (1 - nu)

    def exact(x):
        across = (-side + ratio * q) / modulus * x[0] - side / k
        along = (-q + ratio * side) / modulus * x[up] - q / k
        return np.vstack([across, *([0 * x[0]] * (body.d - 2)), along])

    reference = fem.Function(body.u.function_space)
    reference.interpolate(exact)
    n = body.u.function_space.dofmap.index_map.size_local * body.d
    assert is_close(gather(COMM, body.u.x.array[:n]), gather(COMM, reference.x.array[:n]), 1e-8)


def test_surface_with_a_body_and_a_rigid_obstacle():
    """Contacts of Γc with two obstacles are springs in parallel, one with a block in series."""
    q, k_1, k_2 = 5e3, 1e7, 4e5
    body = stack("quadrilateral", (3, 5), (0.5, 0.5))
    body.prescribe(FLOOR, 1)
    body.prescribe(SIDES, 0)
    body.F += q * body.v[1] * body.ds(ROOF)
    pair = joint(body, 1, fc.Frictionless(k_1))
    remaining_contact = fc.Contact(
        body.u, pair.surface, fc.HalfSpace((0, 0.5), (0, 1)), fc.Frictionless(k_2), name="rest"
    )
    body.problem(pair, remaining_contact).solve()
    series = 1 / (1 / k_1 + 0.5 / E)
    assert is_uniform(pair.pressure, q * series / (series + k_2))
    assert is_uniform(remaining_contact.pressure, q * k_2 / (series + k_2))


def test_symmetric_contacts_have_half_of_the_pressure_each():
    """Each surface is Γc of a contact with half of the stiffness: each has half of the pressure."""
    q = 5e3
    body = stack("triangle", (3, 5), (0.5, 0.5))
    body.prescribe(FLOOR, 1)
    body.prescribe(SIDES, 0)
    body.F += q * body.v[1] * body.ds(ROOF)
    one, other = (
        joint(body, 1, fc.Frictionless(5e6)),
        joint(body, 1, fc.Frictionless(5e6), swap=True),
    )
    other.name = "back"
    body.problem(one, other).solve()
    for contact in (one, other):
        assert is_uniform(contact.pressure, q / 2)
        assert is_uniform(contact.gap, -q / 1e7)


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_stack_under_a_loaded_free_obstacle(cell):
    """A floor, two bodies and a free obstacle: all contacts transfer the force on it, 1e-8."""
    body = stack(cell, (3, 4), (0.5, 0.5))
    up, k_n, weight = body.d - 1, 1e7, 5e3
    body.prescribe(SIDES, *range(up))
    down = np.eye(body.d)[-1]
    plate = fc.HalfSpace(down, -down, displacement=fc.Motion(force=[None] * up + [-weight]))
    lid = body.contact(ROOF, plate, fc.Frictionless(k_n), name="lid")
    contacts = [floor(body, fc.Frictionless(k_n)), joint(body, 1, fc.Frictionless(k_n)), lid]
    body.problem(*contacts).solve()
    for contact in contacts:
        assert is_uniform(contact.pressure, weight, 1e-8)
    assert is_close(lid.free_motion[up].value, -weight * (1 / E + 3 / k_n), 1e-8)


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "hexahedron"])
def test_bonded_stack_in_tension_and_shear(cell, degree):
    """Tension and shear of two elastic joints are uniform, 1e-9: springs in series.

    The sides have the tractions of pure shear: u_x = t (z/G + the number of joints below / k_t).
    """
    q, t, k_n, k_t = 5e3, 2e3, 1e7, 4e6
    counts = (2, 3, 4) if cell == "hexahedron" else (3, 5, 4)
    body = stack(
        cell,
        counts,
        (0.5, 0.25, 0.75),
        degree=degree,
        tags={8: at_coordinate(0, 0), 9: at_coordinate(0, 1)},
    )
    up = body.d - 1
    body.prescribe(FLOOR, *range(body.d))
    body.F -= (q * body.v[up] + t * body.v[0]) * body.ds(ROOF)
    body.F -= t * body.v[up] * body.ds(9) - t * body.v[up] * body.ds(8)
    law = fc.Foundation(k_n, k_t)
    contacts = [joint(body, 1, law), joint(body, 2, law, swap=True)]
    body.problem(*contacts).solve()
    for contact, upward in zip(contacts, (False, True), strict=True):
        # Γc of joint 1 is the bottom of the upper block, Γc of joint 2 the top of the lower one.
        assert is_uniform(contact.pressure, -q)
        side = gather(COMM, contact.tangential_traction)
        exact = np.zeros_like(side)
        exact[:, 0] = t if upward else -t
        assert is_close(side, exact, 1e-9)
    space = body.u.function_space
    top = fem.locate_dofs_topological(space, up, body.tags.find(ROOF))
    top = top[top < space.dofmap.index_map.size_local]
    moved = gather(COMM, body.u.x.array.reshape(-1, body.d)[top])
    shear = E / 2
    assert is_close(moved[:, 0], np.full(len(moved), t * (1.5 / shear + 2 / k_t)), 1e-8)
    assert is_close(moved[:, up], np.full(len(moved), q * (1.5 / E + 2 / k_n)), 1e-8)


@pytest.mark.parametrize("swap", [False, True])
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_uniform_pressure_of_axisymmetric_discs(cell, degree, swap):
    """Two discs of different meshes with weight 2πr, up to the axis: uniform pressure, N = q π."""
    q, k_n = 5e3, 1e7
    body = stack(cell, (3, 5), (0.5, 0.5), degree=degree)
    r, u, v = body.x[0], body.u, body.v
    strain, virtual = ufl.sym(ufl.grad(u)), ufl.sym(ufl.grad(v))
    F = 2 * np.pi * E * (r * ufl.inner(strain, virtual) + u[0] * v[0] / r) * ufl.dx
    F += 2 * np.pi * r * q * v[1] * body.ds(ROOF)
    body.prescribe(FLOOR, 1)
    body.prescribe(SIDES, 0)
    contact = joint(body, 1, fc.Frictionless(k_n), swap=swap, weight=2 * np.pi * r)
    fc.ContactProblem(F, u, bcs=body.bcs, contacts=[contact]).solve()
    assert is_uniform(contact.pressure, q)
    assert is_uniform(contact.gap, -q / k_n)
    assert is_close(contact.resultants().normal_force, q * np.pi, 1e-9)
    total, _, size = force_resultants(contact)
    assert np.abs(total).max() <= 1e-12 * size


def test_pairs_are_updated_only_in_the_sliding_joint():
    """Pairs are updated in one joint alone, while it slides over three facets with T = μN, 1e-8."""
    q = 5e3
    body = stack("quadrilateral", (8, 16, 5), (0.3, 0.2, 0.2), widths=[1.0, 1.0, 0.4], nu=0.3)
    slide = body.constant(0.0)
    body.prescribe(FLOOR, 0, 1)
    body.prescribe(ROOF, 0, value=slide)
    body.F += q * body.v[1] * body.ds(ROOF)
    glued = joint(body, 1, fc.Coulomb(0.5, k_n=1e7, k_t=1e7))
    obstacle = fc.DeformableBody(body.tags, 20 + LOWER, update_pairs="increment")
    slides = body.contact(20 + UPPER, obstacle, fc.Coulomb(0.2, k_n=1e7, k_t=1e7), name="slides")
    problem = body.problem(glued, slides)
    n = 0.4 * q
    for step in fc.increments(problem, slide, 0.0, 0.2, steps=10):
        r = step.contacts["slides"]
        assert is_close(r.normal_force, n, 1e-8)
        assert r.stick == 0
        assert is_close(r.force, [-0.2 * n, n], 1e-8)
        assert is_close(step.contacts["joint 1"].force, [-0.2 * n, n], 1e-7)
        assert step.contacts["joint 1"].stick > 0
    assert slides.pairs.n_updates > 1 and glued.pairs.n_updates == 1
    assert slides.pairs.n_unpaired == 0
