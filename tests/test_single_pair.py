"""One pair of surfaces: self-contact, interference, unequal and curved meshes, unpaired points.

References are closed-form solutions or invariants. Solutions agree to 1e-8, as the solver's
tolerance on forces is 1e-9; resultants cancel to 1e-12, round-off.
"""

import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenics_contact as fc
from scenes.bodies import Bodies, boxes
from scenes.comparison import is_close
from scenes.stacks import (
    FLOOR,
    LOWER,
    ROOF,
    SIDES,
    UPPER,
    E,
    force_resultants,
    is_uniform,
    joint,
    rings,
    stack,
)
from scenes.tags import at_coordinate, at_interface

pytestmark = pytest.mark.three_ranks


# ---- self-contact --------------------------------------------------------------------------------


def slit_ring(*, half, degree):
    """Return a ring of radii 1 and 1.5 with a slit of 0.02 along x > 0, or its upper half.

    It is clamped opposite to the slit. FLOOR is the upper face of the slit, ROOF the lower one (or
    the clamped cut of the half), SIDES the outer surface.
    """
    n = 24
    end = np.pi if half else 2 * np.pi
    axes = [[np.linspace(0, end, n // (2 if half else 1) + 1), np.linspace(1, 1.5, 4)]]

    def bend(x):
        offset = 0.01 * (1 - x[:, 0] / np.pi)
        return np.column_stack([x[:, 1] * np.cos(x[:, 0]), x[:, 1] * np.sin(x[:, 0]) + offset])

    sides = {FLOOR: at_coordinate(0, 0), ROOF: at_coordinate(0, end), SIDES: at_coordinate(1, 1.5)}
    body = Bodies(boxes(axes, sides, bend=bend, degree=2), E, 0.3, degree=degree)
    space = body.u.function_space
    cut = fem.locate_dofs_geometrical(space, lambda x: (x[0] < 0) & (np.abs(x[1]) < 1e-9))
    body.bcs = [fem.dirichletbc(np.zeros(2), cut, space)]
    return body


@pytest.mark.parametrize("degree", [1, 2])
def test_self_contact_of_a_slit_ring_equals_its_half_on_a_plane(degree):
    """Tractions of the slit faces are those of half the ring on a plane of twice the stiffness.

    Both have half the jump as penetration; forces agree to 1e-7, pressures to 1e-6. By symmetry the
    faces do not shear, so that friction, which only the ring has, carries no force.
    """
    k_n, contacts, first = 1e7, [], []
    for half in (False, True):
        body = slit_ring(half=half, degree=degree)
        squeeze = body.constant(0.0)
        body.F += squeeze * ufl.dot(ufl.FacetNormal(body.mesh), body.v) * body.ds(SIDES)
        if half:
            contact = body.contact(FLOOR, fc.HalfSpace((0, 0), (0, 1)), fc.Frictionless(2 * k_n))
        else:
            contact = body.contact(FLOOR, ROOF, fc.Coulomb(0.3, k_n=k_n, k_t=k_n))
            assert contact.pairs.n_unpaired == 0
        problem = body.problem(contact)
        few, *_ = list(fc.increments(problem, squeeze, 0.0, 1e3, steps=[200.0, 1e3]))
        assert few.contacts["contact"].open > 0, "first, only a part of the lips shall touch"
        contacts.append(contact)
        first.append(few.contacts["contact"].force)
    ring, half = contacts
    assert is_close(*first, 1e-7) and first[0][1] > 100.0
    assert is_close(ring.gather()["pressure"], half.gather()["pressure"], 1e-6)
    assert is_close(ring.resultants().force, half.resultants().force, 1e-7)
    assert ring.resultants().tangential_force <= 1e-6 * ring.resultants().normal_force
    total, _, size = force_resultants(ring)
    assert np.abs(total).max() <= 1e-12 * size


# ---- interference --------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_interference_has_the_closed_form_pressure(cell):
    """A gap of -0.01 between fixed blocks: p = (0.01 - w)/(H/E + 1/k_n) at opening w, to 1e-8."""
    k_n, oversize = 1e7, 0.01
    body = stack(cell, (3, 5), (0.5, 0.5))
    up = body.d - 1
    away = body.constant(0.0)
    body.prescribe(FLOOR, up)
    body.prescribe(ROOF, up, value=away)
    body.prescribe(SIDES, *range(up))
    contact = joint(body, 1, fc.Frictionless(k_n), gap=-oversize)
    problem = body.problem(contact)
    assert problem.initial_penetration == 0.0
    for opening in (0.0, 0.004, 0.0099):
        away.value = opening
        problem.solve()
        problem.commit()
        assert is_uniform(contact.pressure, (oversize - opening) / (1 / E + 1 / k_n), 1e-8)
    away.value = 0.015
    problem.solve()
    assert contact.resultants().normal_force == 0.0
    assert is_uniform(contact.gap, 0.005, 1e-8)


def test_interference_that_varies_along_the_joint():
    """A gap by UFL, linear along the joint, of undeformed blocks gives a pressure of -k_n gap."""
    body = stack("quadrilateral", (3, 5), (0.5, 0.5))
    contact = joint(body, 1, fc.Frictionless(1e7), gap=-0.01 * body.x[0])
    contact.evaluate()
    points = contact.gather()
    assert is_close(points["pressure"], 1e5 * points["x"][:, 0], 1e-12)


# ---- very different meshes -----------------------------------------------------------------------


@pytest.mark.parametrize("swap", [False, True])
@pytest.mark.parametrize(
    ("cell", "degree", "counts"),
    [
        (cell, degree, counts)
        for cell in ("triangle", "quadrilateral")
        for degree in (1, 2)
        for counts in ((1, 20), (20, 1), (19, 20))
    ]
    + [("hexahedron", 1, counts) for counts in ((1, 9), (9, 1), (8, 9))],
)
def test_patch_of_very_different_cells(counts, cell, degree, swap):
    """Pressure is uniform, to 1e-8, for one cell opposite to 20 and for nearly matching cells."""
    nu, k_n = 0.3, 1e7
    body = stack(cell, counts, (0.05, 0.05), degree=degree, nu=nu)
    body.prescribe(FLOOR, body.d - 1)
    body.prescribe(ROOF, body.d - 1, value=-0.001)
    body.prescribe(SIDES, *range(body.d - 1))
    contact = joint(body, 1, fc.Coulomb(0.3, k_n=k_n, k_t=k_n), swap=swap)
    body.problem(contact).solve()
    confined = E * (1 - nu) / ((1 + nu) * (1 - 2 * nu))
    p = 0.001 / (0.1 / confined + 1 / k_n)
    assert contact.pairs.n_unpaired == 0
    assert is_uniform(contact.pressure, p, 1e-8)
    assert is_uniform(contact.gap, -p / k_n, 1e-8)


# ---- action and reaction -------------------------------------------------------------------------


@pytest.mark.parametrize("swap", [False, True])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "hexahedron"])
def test_moment_of_tractions_across_a_gap(cell, swap):
    """Forces on faces 0.02 apart cancel; their moment is the shear force times 0.02, to 1e-10."""
    gap = 0.02
    body = stack(cell, (3, 5), (0.5, 0.5), gap=gap)
    contact = joint(body, 1, fc.Coulomb(0.3, k_n=1e6, k_t=1e6), swap=swap)
    up = body.d - 1
    # The upper block is moved down by more than the gap, and sideways.
    shape = np.zeros(body.d)
    shape[0], shape[-1] = 0.03, -0.06

    def moved(x):
        return np.outer(shape, x[up] > 0.51) + 0.005 * np.sin(
            np.vstack([4 * x[i] + 3 * x[0] for i in range(body.d)])
        )

    body.u.interpolate(moved)
    contact.evaluate()
    r = contact.resultants()
    assert r.slip > 0 and r.normal_force > 0
    total, moment, size = force_resultants(contact)
    assert np.abs(total).max() <= 1e-12 * size
    assert abs(r.force[0]) > 0.05 * size / 2
    # The shear forces on both bodies are opposite, at the distance of the gap.
    sign = 1 if swap else -1
    assert is_close(moment, sign * gap * r.force[0], 1e-10, scale=size * gap)


def inner(x):
    """Return which midpoints are of cells of the inner ring."""
    return np.linalg.norm(x, axis=1) < 20


@pytest.mark.parametrize("counts", [(7, 11), (14, 23)])
def test_torque_of_a_ring_rotated_in_a_ring(counts):
    """With an interference of 0.01 all points slip: N = k_n δ R θ, torque = μ N R, to 1e-5.

    With a prescribed gap, the only errors are those of length and normals of the arcs, of the order
    (h/R)⁴, below 1e-5 for 7 cells.
    """
    k_n, oversize, friction, angle = 1e5, 0.01, 0.2, 1.5
    law = fc.Coulomb(friction, k_n=k_n, k_t=1e6)
    body = rings(counts, angle=angle)
    contact = body.contact(LOWER, UPPER, law, gap=-oversize)
    assert contact.pairs.n_unpaired == 0
    body.set_displacement(lambda x: 0.01 * np.vstack([-x[1], x[0]]), inner)
    contact.evaluate()
    r, points = contact.resultants(), contact.gather()
    assert r.stick == r.open == 0
    assert is_close(r.normal_force, k_n * oversize * 20 * angle, 1e-5)
    x, t = points["x"], points["tangential_traction"]
    torque = points["measure"] @ (x[:, 0] * t[:, 1] - x[:, 1] * t[:, 0])
    assert is_close(torque, -friction * r.normal_force * 20, 1e-5)


def test_moments_of_curved_surfaces_cancel_as_the_meshes_are_refined():
    """Forces cancel to round-off, moments up to the distance between the arcs of the two meshes."""
    errors = []
    for counts in ((4, 7), (8, 14), (16, 28)):
        body = rings(counts)
        contact = body.contact(LOWER, UPPER, fc.Coulomb(0.2, k_n=1e5, k_t=1e6), gap=-0.01)
        body.set_displacement(lambda x: 0.005 * np.sin(np.vstack([x[0] / 5, x[1] / 7])), inner)
        contact.evaluate()
        total, moment, size = force_resultants(contact)
        assert np.abs(total).max() <= 1e-12 * size
        errors.append(abs(moment) / (20 * size))
    assert errors[0] <= 1e-6
    assert errors[2] <= errors[0] / 16, "second order or better"


# ---- unpaired points -----------------------------------------------------------------------------


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "hexahedron"])
def test_points_of_an_overhang_are_unpaired(cell):
    """Points of a slab that overhangs a pillar are unpaired, open, and without traction.

    The contact force is the load, and its centre that of the load, to 1e-8.
    """
    q = 1e3
    body = stack(cell, (5, 8), (0.5, 0.25), widths=[0.6, 1.0], nu=0.3)
    up = body.d - 1
    body.prescribe(FLOOR, *range(body.d))
    body.F += q * body.v[up] * body.ds(ROOF)
    contact = joint(body, 1, fc.Coulomb(0.5, k_n=1e7, k_t=1e7))
    points = contact.gather()
    outside = np.any(np.abs(points["x"][:, :up] - 0.5) > 0.3, axis=1)
    assert 0 < contact.pairs.n_unpaired == np.count_nonzero(outside)
    problem = body.problem(contact)
    problem.solve()
    points = contact.gather()
    assert np.all(points["status"][outside] == fc.Status.OPEN)
    assert np.all(points["pressure"][outside] == 0.0)
    assert is_close(contact.resultants().force, q * np.eye(body.d)[-1], 1e-8)
    total, moment, size = force_resultants(contact)
    assert np.abs(total).max() <= 1e-12 * size
    assert abs(moment) <= 1e-12 * size
    middle = points["measure"] * points["pressure"] @ points["x"][:, 0]
    assert is_close(middle, 0.5 * q, 1e-8)


def test_contact_without_opposite_points_has_no_force():
    """If the bodies do not face each other, all points of Γc are unpaired, and forces are zero."""
    axes = [
        [np.linspace(0, 1, 4), np.linspace(0, 1, 4)],
        [np.linspace(2, 3, 4), np.linspace(1, 2, 4)],
    ]
    sides = {LOWER: at_interface(1, 1, above=False), UPPER: at_interface(1, 1, above=True)}
    body = Bodies(boxes(axes, sides), E, 0.3)
    contact = body.contact(UPPER, LOWER, fc.Frictionless(1e6))
    body.u.interpolate(lambda x: 0.1 * np.sin([3 * x[0] + 5 * x[1] + i for i in range(2)]))
    contact.evaluate()
    assert contact.pairs.n_unpaired == len(contact.gather()["x"]) > 0
    assert contact.resultants().normal_force == 0.0
    assert force_resultants(contact)[2] == 0.0
