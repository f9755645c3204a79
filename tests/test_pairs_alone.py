"""One pair of surfaces: self-contact, interference, unequal and curved meshes, unpaired points.

References are closed answers or invariants. What is uniform is met to 1e-9 and what is solved for
to 1e-8, as the solver's tolerance on the forces is 1e-9; sums of forces to 1e-12, round-off.
"""

import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenics_contact as fc
from scenes.bodies import Bodies, boxes
from scenes.comparing import close
from scenes.stacks import FLOOR, LOWER, ROOF, SIDES, UPPER, E, balance, joint, rings, stack, uniform
from scenes.tags import between, near

pytestmark = pytest.mark.three_ranks


# ---- self-contact --------------------------------------------------------------------------------


def slit_ring(*, half, degree):
    """A ring from 1 to 1.5, slit along x > 0 by 0.02; or its upper half. Clamped opposite the slit.

    FLOOR is the upper lip, ROOF the lower one (or the clamped cut of the half), SIDES the outside.
    """
    n = 24
    end = np.pi if half else 2 * np.pi
    axes = [[np.linspace(0, end, n // (2 if half else 1) + 1), np.linspace(1, 1.5, 4)]]

    def bend(x):
        offset = 0.01 * (1 - x[:, 0] / np.pi)
        return np.column_stack([x[:, 1] * np.cos(x[:, 0]), x[:, 1] * np.sin(x[:, 0]) + offset])

    sides = {FLOOR: near(0, 0), ROOF: near(0, end), SIDES: near(1, 1.5)}
    body = Bodies(boxes(axes, sides, bend=bend, degree=2), E, 0.3, degree=degree)
    space = body.u.function_space
    cut = fem.locate_dofs_geometrical(space, lambda x: (x[0] < 0) & (np.abs(x[1]) < 1e-9))
    body.bcs = [fem.dirichletbc(np.zeros(2), cut, space)]
    return body


@pytest.mark.parametrize("degree", [1, 2])
def test_a_slit_ring_closes(degree):
    """Lips of one body against each other: as its half on a rigid plane of twice the stiffness.

    Both sink by half the jump. By symmetry the lips do not shear, so that friction, which the ring
    has and the half has not, bears nothing.
    """
    k_n, made, first = 1e7, [], []
    for half in (False, True):
        body = slit_ring(half=half, degree=degree)
        squeeze = body.constant(0.0)
        body.F += squeeze * ufl.dot(ufl.FacetNormal(body.mesh), body.v) * body.ds(SIDES)
        if half:
            contact = body.contact(FLOOR, fc.HalfSpace((0, 0), (0, 1)), fc.Frictionless(2 * k_n))
        else:
            contact = body.contact(FLOOR, ROOF, fc.Coulomb(0.3, k_n=k_n, k_t=k_n))
            assert contact.n_unpaired == 0
        problem = body.problem(contact)
        few, *_ = list(fc.increments(problem, squeeze, 0.0, 1e3, steps=[200.0, 1e3]))
        assert few.contacts["contact"].open > 0, "first, only a part of the lips shall touch"
        made.append(contact)
        first.append(few.contacts["contact"].force)
    ring, half = made
    assert close(*first, 1e-7) and first[0][1] > 100.0
    assert close(ring.gather()["pressure"], half.gather()["pressure"], 1e-6)
    assert close(ring.resultants().force, half.resultants().force, 1e-7)
    assert ring.resultants().tangential_force <= 1e-6 * ring.resultants().normal_force
    total, _, size = balance(ring)
    assert np.abs(total).max() <= 1e-12 * size


# ---- interference --------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_interference(cell):
    """A gap of -0.01 between blocks that are held: p = (0.01 - w)/(H/E + 1/k_n), and w opens it."""
    k_n, oversize = 1e7, 0.01
    body = stack(cell, (3, 5), (0.5, 0.5))
    up = body.d - 1
    away = body.constant(0.0)
    body.hold(FLOOR, up)
    body.hold(ROOF, up, value=away)
    body.hold(SIDES, *range(up))
    contact = joint(body, 1, fc.Frictionless(k_n), gap=-oversize)
    problem = body.problem(contact)
    assert problem.initial_penetration == 0.0
    for opening in (0.0, 0.004, 0.0099):
        away.value = opening
        problem.solve()
        problem.commit()
        assert uniform(contact.pressure, (oversize - opening) / (1 / E + 1 / k_n), 1e-8)
    away.value = 0.015
    problem.solve()
    assert contact.resultants().normal_force == 0.0
    assert uniform(contact.gap, 0.005, 1e-8)


def test_interference_that_varies_along_the_joint():
    """A gap by UFL, linear along the joint, between rigid blocks: the pressure is k_n times it."""
    body = stack("quadrilateral", (3, 5), (0.5, 0.5))
    contact = joint(body, 1, fc.Frictionless(1e7), gap=-0.01 * body.x[0])
    contact.evaluate()
    points = contact.gather()
    assert close(points["pressure"], 1e5 * points["x"][:, 0], 1e-12)


# ---- meshes that have nothing in common ----------------------------------------------------------


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
    """One cell opposite twenty, either of them Γc; and cells that nearly match: still uniform."""
    nu, k_n = 0.3, 1e7
    body = stack(cell, counts, (0.05, 0.05), degree=degree, nu=nu)
    body.hold(FLOOR, body.d - 1)
    body.hold(ROOF, body.d - 1, value=-0.001)
    body.hold(SIDES, *range(body.d - 1))
    contact = joint(body, 1, fc.Coulomb(0.3, k_n=k_n, k_t=k_n), swap=swap)
    body.problem(contact).solve()
    confined = E * (1 - nu) / ((1 + nu) * (1 - 2 * nu))
    p = 0.001 / (0.1 / confined + 1 / k_n)
    assert contact.n_unpaired == 0
    assert uniform(contact.pressure, p, 1e-8)
    assert uniform(contact.gap, -p / k_n, 1e-8)


# ---- action and reaction -------------------------------------------------------------------------


@pytest.mark.parametrize("swap", [False, True])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "hexahedron"])
def test_moment_of_a_gap(cell, swap):
    """Equal forces on faces 0.02 apart: they cancel, and their moment is the shear times 0.02."""
    gap = 0.02
    body = stack(cell, (3, 5), (0.5, 0.5), apart=gap)
    contact = joint(body, 1, fc.Coulomb(0.3, k_n=1e6, k_t=1e6), swap=swap)
    up = body.d - 1
    # The upper block moved down by more than the gap, and along.
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
    total, moment, size = balance(contact)
    assert np.abs(total).max() <= 1e-12 * size
    assert abs(r.force[0]) > 0.05 * size / 2
    # On the body the shear, on the other one its opposite, a gap away.
    sign = 1 if swap else -1
    assert close(moment, sign * gap * r.force[0], 1e-10, scale=size * gap)


def inner(x):
    """Midpoints of the inner ring's cells."""
    return np.linalg.norm(x, axis=1) < 20


@pytest.mark.parametrize("counts", [(7, 11), (14, 23)])
def test_turning_a_ring_in_a_ring(counts):
    """The inner ring turned, an interference of 0.01: N = k_n δ R θ, torque = μ N R, all slips.

    With a prescribed gap, length and normals of the arcs are all that the cells can miss: their
    error is of the order (h/R)⁴, and that of 7 cells below 1e-5.
    """
    k_n, oversize, friction, angle = 1e5, 0.01, 0.2, 1.5
    law = fc.Coulomb(friction, k_n=k_n, k_t=1e6)
    body = rings(counts, angle=angle)
    contact = body.contact(LOWER, UPPER, law, gap=-oversize)
    assert contact.n_unpaired == 0
    body.displace(lambda x: 0.01 * np.vstack([-x[1], x[0]]), inner)
    contact.evaluate()
    r, points = contact.resultants(), contact.gather()
    assert r.stick == r.open == 0
    assert close(r.normal_force, k_n * oversize * 20 * angle, 1e-5)
    x, t = points["x"], points["tangential_traction"]
    torque = points["measure"] @ (x[:, 0] * t[:, 1] - x[:, 1] * t[:, 0])
    assert close(torque, -friction * r.normal_force * 20, 1e-5)


def test_moments_of_curved_surfaces_cancel_as_the_meshes_are_refined():
    """Forces cancel to round-off, moments up to the distance of the two meshes' arcs."""
    errors = []
    for counts in ((4, 7), (8, 14), (16, 28)):
        body = rings(counts)
        contact = body.contact(LOWER, UPPER, fc.Coulomb(0.2, k_n=1e5, k_t=1e6), gap=-0.01)
        body.displace(lambda x: 0.005 * np.sin(np.vstack([x[0] / 5, x[1] / 7])), inner)
        contact.evaluate()
        total, moment, size = balance(contact)
        assert np.abs(total).max() <= 1e-12 * size
        errors.append(abs(moment) / (20 * size))
    assert errors[0] <= 1e-6
    assert errors[2] <= errors[0] / 16, "second order or better"


# ---- points without an opposite ------------------------------------------------------------------


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "hexahedron"])
def test_overhang(cell):
    """A slab on a narrower pillar: the points that look past it are counted, open, and free.

    What the pillar bears is the load, and its middle is the load's.
    """
    q = 1e3
    body = stack(cell, (5, 8), (0.5, 0.25), widths=[0.6, 1.0], nu=0.3)
    up = body.d - 1
    body.hold(FLOOR, *range(body.d))
    body.F += q * body.v[up] * body.ds(ROOF)
    contact = joint(body, 1, fc.Coulomb(0.5, k_n=1e7, k_t=1e7))
    points = contact.gather()
    outside = np.any(np.abs(points["x"][:, :up] - 0.5) > 0.3, axis=1)
    assert 0 < contact.n_unpaired == np.count_nonzero(outside)
    problem = body.problem(contact)
    problem.solve()
    points = contact.gather()
    assert np.all(points["status"][outside] == fc.Status.OPEN)
    assert np.all(points["pressure"][outside] == 0.0)
    assert close(contact.resultants().force, q * np.eye(body.d)[-1], 1e-8)
    total, moment, size = balance(contact)
    assert np.abs(total).max() <= 1e-12 * size
    assert abs(moment) <= 1e-12 * size
    middle = points["measure"] * points["pressure"] @ points["x"][:, 0]
    assert close(middle, 0.5 * q, 1e-8)


def test_no_opposite_at_all():
    """A body beside the other one: all of Γc is unpaired, and nothing acts."""
    axes = [
        [np.linspace(0, 1, 4), np.linspace(0, 1, 4)],
        [np.linspace(2, 3, 4), np.linspace(1, 2, 4)],
    ]
    sides = {LOWER: between(1, 1, above=False), UPPER: between(1, 1, above=True)}
    body = Bodies(boxes(axes, sides), E, 0.3)
    contact = body.contact(UPPER, LOWER, fc.Frictionless(1e6))
    body.u.interpolate(lambda x: 0.1 * np.sin([3 * x[0] + 5 * x[1] + i for i in range(2)]))
    contact.evaluate()
    assert contact.n_unpaired == len(contact.gather()["x"]) > 0
    assert contact.resultants().normal_force == 0.0
    assert balance(contact)[2] == 0.0
