"""Gap and normal of obstacles at the points of Γc, against formulas in numpy."""

import logging

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from scenes.blocks import BOTTOM, LEFT, RIGHT, TOP, block, block_mesh
from scenes.comparison import assert_raised_on_all_ranks, gather, is_close
from scenes.elasticity import displacement_space

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]
COMM = MPI.COMM_WORLD

# Gap and normal are a few operations on coordinates of size one, evaluated as a quotient of
# assembled sums: round-off is about 1e-15, and 1e-12 leaves a margin for the sums.
EXACT = 1e-12

CELL = {2: "triangle", 3: "tetrahedron"}


def scene(d: int) -> tuple[fc.ContactSurface, fem.Function]:
    mesh, tags = block_mesh(CELL[d], shuffled=True)
    surface = fc.ContactSurface(mesh, tags, [BOTTOM, RIGHT])
    return surface, fem.Function(displacement_space(mesh, 1))


def normalise(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def half_space(x, shift, point, normal):
    n = normalise(np.asarray(normal, dtype=float))
    return (x - point - shift) @ n, np.broadcast_to(-n, x.shape)


def ball(x, shift, center, radius, inside):
    arm = x - center - shift
    distance = np.linalg.norm(arm, axis=1)
    if inside:
        return radius - distance, normalise(arm)
    return distance - radius, -normalise(arm)


def cylinder(x, shift, point, radius, inside, axis=None):
    arm = x - point - shift
    if axis is not None:
        a = normalise(np.asarray(axis, dtype=float))
        arm = arm - np.outer(arm @ a, a)
    distance = np.linalg.norm(arm, axis=1)
    if inside:
        return radius - distance, normalise(arm)
    return distance - radius, -normalise(arm)


def check_gap_and_normal(contact: fc.Contact, reference, shift=0.0) -> None:
    """Check gap, normal and initial gap at all points of all ranks against the reference."""
    contact.evaluate()
    x = gather(COMM, contact.points)
    gap, normal = reference(x, shift)
    assert is_close(gather(COMM, contact.values.initial_gap), gap, EXACT, scale=1.0)
    assert is_close(gather(COMM, contact.values.normal), normal, EXACT, scale=1.0)
    # With u = 0 the gap is the initial gap (eq. 6).
    assert is_close(gather(COMM, contact.gap), gap, EXACT, scale=1.0)


POINT = {2: (0.2, -0.4), 3: (0.2, 0.1, -0.4)}
SLOPE = {2: (0.3, 2.0), 3: (0.3, -0.2, 2.0)}
SHIFT = {2: (0.03, 0.11), 3: (0.03, -0.05, 0.11)}
AXIS = {2: None, 3: (0.2, 2.0, 0.3)}


def obstacles(d: int) -> dict:
    p, n, axis = POINT[d], SLOPE[d], AXIS[d]
    named = {
        "half-space": (
            lambda s: fc.HalfSpace(p, n, displacement=s),
            lambda x, s: half_space(x, s, p, n),
        )
    }
    for inside in (False, True):
        r = 3.0 if inside else 0.25
        place = " around" if inside else ""
        named["ball" + place] = (
            lambda s, r=r, inside=inside: fc.Ball(p, r, inside=inside, displacement=s),
            lambda x, s, r=r, inside=inside: ball(x, s, p, r, inside),
        )
        named["cylinder" + place] = (
            lambda s, r=r, inside=inside: fc.Cylinder(
                p, r, axis=axis, inside=inside, displacement=s
            ),
            lambda x, s, r=r, inside=inside: cylinder(x, s, p, r, inside, axis),
        )
    return named


@pytest.mark.each
@pytest.mark.parametrize("kind", obstacles(2))
@pytest.mark.parametrize("d", [2, 3])
def test_gap_and_normal(d, kind):
    """Gap and normal of every obstacle match formulas, at rest and displaced by a tuple."""
    make, reference = obstacles(d)[kind]
    surface, u = scene(d)
    law = fc.Frictionless(k_n=1.0)
    check_gap_and_normal(fc.Contact(u, surface, make(None), law), reference)
    shift = np.array(SHIFT[d])
    moved = fc.Contact(u, surface, make(SHIFT[d]), law)
    check_gap_and_normal(moved, reference, shift)
    # A displacement given by numbers is a parameter: a new value moves the obstacle.
    moved.parameters["displacement"].value[:] = -2 * shift
    check_gap_and_normal(moved, reference, -2 * shift)


@pytest.mark.each
@pytest.mark.parametrize("kind", obstacles(2))
@pytest.mark.parametrize("d", [2, 3])
def test_displacement_by_a_constant(d, kind):
    """A ``fem.Constant`` changed between two evaluations moves the obstacle."""
    make, reference = obstacles(d)[kind]
    surface, u = scene(d)
    motion = fem.Constant(surface.mesh, np.zeros(d))
    contact = fc.Contact(u, surface, make(motion), fc.Frictionless(k_n=1.0))
    for shift in (np.zeros(d), np.array(SHIFT[d]), -np.array(SHIFT[d])):
        motion.value[:] = shift
        check_gap_and_normal(contact, reference, shift)


@pytest.mark.parametrize("d", [2, 3])
def test_obstacle_by_ufl(d):
    """A gap given by UFL is used unchanged, a normal of any length is normalised."""
    surface, u = scene(d)
    x = ufl.SpatialCoordinate(surface.mesh)
    normal = ufl.as_vector([0.3 * x[0], *([x[0] * x[1]] if d == 3 else []), -4.0 - x[0]])
    gap = 0.1 + x[0] ** 2

    def reference(x, shift):
        columns = [0.3 * x[:, 0], *([x[:, 0] * x[:, 1]] if d == 3 else []), -4.0 - x[:, 0]]
        n = normalise(np.column_stack(columns))
        return 0.1 + x[:, 0] ** 2 + n @ np.broadcast_to(shift, d), n

    motion = fem.Constant(surface.mesh, np.zeros(d))
    obstacle = fc.PrescribedGap(gap, normal, displacement=motion)
    contact = fc.Contact(u, surface, obstacle, fc.Frictionless(k_n=1.0))
    check_gap_and_normal(contact, reference)
    motion.value[:] = SHIFT[d]
    check_gap_and_normal(contact, reference, np.array(SHIFT[d]))


@pytest.mark.parametrize("d", [2, 3])
def test_obstacle_by_a_function(d):
    """A gap given by a finite element function is evaluated at the points."""
    surface, u = scene(d)
    gap = fem.Function(fem.functionspace(surface.mesh, ("Lagrange", 1)))
    gap.interpolate(lambda x: 0.2 + 0.5 * x[0] - 0.1 * x[1])
    obstacle = fc.PrescribedGap(gap, np.eye(d)[-1] * -3.0)
    contact = fc.Contact(u, surface, obstacle, fc.Frictionless(k_n=1.0))
    check_gap_and_normal(
        contact, lambda x, s: (0.2 + 0.5 * x[:, 0] - 0.1 * x[:, 1], 0 * x - np.eye(d)[-1])
    )


@pytest.mark.each
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("kind", ["half-space", "ball", "cylinder"])
def test_prescribed_gap_does_not_depend_on_the_geometry(d, kind):
    """``gap=`` replaces the distance (paper, footnote 1); motion of the obstacle along n adds."""
    make, reference = obstacles(d)[kind]
    surface, u = scene(d)
    motion = fem.Constant(surface.mesh, np.zeros(d))
    contact = fc.Contact(u, surface, make(motion), fc.Frictionless(k_n=1.0), gap=0.07)

    def prescribed(value):
        # The normal is that of the geometry; the gap is prescribed.
        def expected(x, shift):
            normal = reference(x, shift)[1]
            return value + normal @ np.broadcast_to(shift, d), normal

        return expected

    check_gap_and_normal(contact, prescribed(0.07))
    contact.parameters["gap"].value = 0.21
    check_gap_and_normal(contact, prescribed(0.21))
    motion.value[:] = SHIFT[d]
    check_gap_and_normal(contact, prescribed(0.21), np.array(SHIFT[d]))


@pytest.mark.parametrize("d", [2, 3])
def test_length_of_the_normal_does_not_matter(d):
    """A normal a million times longer gives the same gap and unit normal to round-off."""
    surface, u = scene(d)
    law = fc.Frictionless(k_n=1.0)
    one = fc.Contact(u, surface, fc.HalfSpace(POINT[d], SLOPE[d]), law)
    long = fc.Contact(u, surface, fc.HalfSpace(POINT[d], 1e6 * np.array(SLOPE[d])), law)
    for name in ("initial_gap", "normal"):
        a, b = (gather(COMM, c.values.arrays[name]) for c in (one, long))
        assert is_close(a, b, EXACT, scale=1.0)
    assert is_close(np.linalg.norm(gather(COMM, one.values.normal), axis=1), a[:, 0] * 0 + 1, EXACT)


@pytest.mark.parametrize("d", [2, 3])
def test_common_translation_changes_no_gap(d):
    """A common translation of body and obstacle changes neither gap nor tangential jump, 1e-12."""
    surface, u = scene(d)
    shift = np.array(SHIFT[d])
    obstacle = fc.HalfSpace(POINT[d], SLOPE[d], displacement=SHIFT[d])
    contact = fc.Contact(u, surface, obstacle, fc.Coulomb(0.3, k_n=1.0, k_t=1.0))
    u.x.array[:] = np.tile(shift, u.x.array.size // d)
    contact.evaluate()
    gap, _ = half_space(gather(COMM, contact.points), 0.0, POINT[d], SLOPE[d])
    assert is_close(gather(COMM, contact.gap), gap, EXACT, scale=1.0)
    jump = gather(COMM, contact.tangential_displacement)
    assert is_close(jump, 0 * jump, EXACT, scale=1.0)


def test_initial_penetration_is_reported(caplog):
    """The problem has the largest initial penetration, and rank 0 alone logs one warning.

    Reference: R - |x - c|, the penetration at the point nearest to the axis of a disc of radius 2
    whose top is 0.125 above the bottom. Tolerance: round-off.
    """
    scene = block("quadrilateral")
    disc = fc.Ball((0.5, 0.125 - 2.0), 2.0)
    with caplog.at_level(logging.WARNING, logger="fenics_contact"):
        problem, contact = scene.problem(
            fc.Frictionless(k_n=1e3), [scene.dirichlet_bc(LEFT, 0)], contact={"obstacle": disc}
        )
    x = gather(COMM, contact.points)
    deepest = (2.0 - np.linalg.norm(x - [0.5, -1.875], axis=1)).max()
    assert 0.1 < deepest < 0.125
    assert abs(problem.initial_penetration - deepest) <= EXACT
    warnings = [r for r in caplog.records if r.name == "fenics_contact"]
    texts = COMM.allgather([r.getMessage() for r in warnings])
    assert len(texts[0]) == 1
    assert "penetrates" in texts[0][0] and f"{deepest:g}" in texts[0][0]
    assert not any(texts[1:])


def test_touching_body_has_no_initial_penetration(caplog):
    """Without negative gaps the initial penetration is zero, and nothing is logged."""
    scene = block("quadrilateral")
    with caplog.at_level(logging.WARNING, logger="fenics_contact"):
        problem, _ = scene.problem(fc.Frictionless(k_n=1e3), scene.rollers())
    assert problem.initial_penetration == 0.0
    assert not COMM.allreduce(len([r for r in caplog.records if r.name == "fenics_contact"]))


# ---- bad input -----------------------------------------------------------------------------------


@pytest.mark.whole
@pytest.mark.parametrize(
    ("obstacle", "words"),
    [
        (fc.HalfSpace((0, 0, 0), (0, 1)), ("point", "HalfSpace")),
        (fc.HalfSpace((0, 0), (0, 0, 1)), ("normal", "HalfSpace")),
        (fc.HalfSpace((0, 0), (0, 0)), ("normal", "zero")),
        (fc.HalfSpace((0, np.nan), (0, 1)), ("point", "finite")),
        (fc.HalfSpace((0, 0), (0, np.inf)), ("normal", "finite")),
        (fc.Ball((0, 0, 0), 1.0), ("center", "Ball")),
        (fc.Ball((0, 0), 0.0), ("radius", "Ball")),
        (fc.Ball((0, 0), -1.0), ("radius", "Ball")),
        (fc.Ball((0, 0), np.nan), ("radius", "Ball")),
        (fc.Cylinder((0, 0), -1.0), ("radius", "Cylinder")),
        (fc.Cylinder((0, 0), 1.0, axis=(0, 0, 1)), ("axis",)),
        (fc.PrescribedGap(0.1, (0, 0)), ("normal", "zero")),
        (fc.PrescribedGap((0.1, 0.2), (0, -1)), ("gap", "scalar")),
        (fc.HalfSpace((0, 0), (0, 1), displacement=(0, 0, 0)), ("displacement",)),
        (fc.HalfSpace((0, 0), (0, 1), displacement=1.0), ("displacement",)),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, fc.Obstacle) else None,
)
def test_bad_obstacle_in_the_plane_is_refused(obstacle, words):
    """The error names data of the wrong dimension, of length zero, or not finite."""
    surface, u = scene(2)
    assert_raised_on_all_ranks(
        lambda: fc.Contact(u, surface, obstacle, fc.Frictionless(k_n=1.0)), ValueError, *words
    )


@pytest.mark.whole
@pytest.mark.parametrize(
    ("obstacle", "words"),
    [
        (fc.Cylinder((0, 0, 0), 1.0), ("axis",)),
        (fc.Cylinder((0, 0, 0), 1.0, axis=(0, 0, 0)), ("axis", "zero")),
        (fc.HalfSpace((0, 0), (0, 0, 1)), ("point",)),
        (fc.Ball((0, 0), 1.0), ("center",)),
    ],
)
def test_bad_obstacle_in_space_is_refused(obstacle, words):
    """The error names data of the wrong dimension, and a missing or zero axis of a cylinder."""
    surface, u = scene(3)
    assert_raised_on_all_ranks(
        lambda: fc.Contact(u, surface, obstacle, fc.Frictionless(k_n=1.0)), ValueError, *words
    )


def test_only_displacement_of_an_obstacle_causes_friction():
    """Motion along Γc by ``displacement`` causes friction; by point or gap it does not."""
    force = {}
    for formulation in ("displacement", "point", "gap"):
        scene = block("quadrilateral", n=4)
        motion, up = fem.Constant(scene.mesh, np.zeros(2)), np.array([0.0, 1.0])
        place = motion if formulation == "point" else np.zeros(2)
        obstacle = fc.HalfSpace(
            place, up, displacement=motion if formulation == "displacement" else None
        )
        gap = -ufl.dot(motion, ufl.as_vector(up)) if formulation == "gap" else None
        bcs = [scene.dirichlet_bc(TOP, i) for i in range(2)]
        law, contact = fc.Coulomb(0.3), {"obstacle": obstacle, "gap": gap}
        problem, contact = scene.problem(law, bcs, contact=contact)
        motion.value[:] = 0.01, 0.01
        problem.solve()
        force[formulation] = contact.resultants().force
    assert force["displacement"][0] > 0.2 * force["displacement"][1]
    assert is_close(force["gap"], force["point"], 1e-9)
    assert abs(force["gap"][0]) < 1e-8 * force["gap"][1]
