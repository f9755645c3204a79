"""Finite kinematics at single states: derivatives, boundary form, invalid arguments."""

from __future__ import annotations

import dolfinx.fem.petsc
import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenics_contact as fc
from fenics_contact.compiling import compile_form
from fenics_contact.parallel import global_max
from scenes.blocks import CELLS, rough_field
from scenes.comparison import assert_raised_on_all_ranks
from scenes.rubber import disc, rubber
from scenes.surfaces import ball, circle, ring

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(240)]

K = 1e3
LAWS = {
    "frictionless": fc.Frictionless(K),
    "cone": fc.Coulomb(0.3, K, K),
    "nearly all stick": fc.Coulomb(5.0, K, K),
    "Tresca": fc.Tresca(0.3, 20.0, K, K),
}
SHAPES = ["plane", "ball", "cavity", "cylinder", "ellipsoid", "profile", "facets"]
IN_SPACE = {
    "polygon": fc.Coulomb(0.3, K, K, modes=5),
    "ellipse": fc.Coulomb(0.3, K, K, transverse_friction=0.6, direction=(1, 0, 0)),
}


def obstacles(scene, shift, angle):
    """Return obstacles that penetrate the top of the block, by name."""
    d, top = scene.dim, scene.height
    turn = fc.Rotation(angle, (0.2,) * d, None if d == 2 else (1.0, 2.0, 3.0))
    move = {"displacement": shift, "rotation": turn}
    side, middle = (0.0,) * (d - 1), (0.0,) * (d - 1) + (top + 0.7,)
    return {
        "plane": fc.HalfSpace((*side, top), (*((0.3,) * (d - 1)), -1.0), **move),
        "ball": fc.Ball(middle, 0.8, **move),
        "cavity": fc.Ball((*side, top - 1.5), 1.6, inside=True, **move),
        "cylinder": fc.Cylinder(middle, 0.8, None if d == 2 else (0.2, 1, 0.1), **move),
        "ellipsoid": fc.SignedDistance(lambda x: _ellipsoid(x, middle), **move),
        "profile": _lens(middle, move),
        "facets": _gem(middle, move),
    }


def _lens(middle, move):
    """Return a smooth bump that is not circular; in 3D a profile about an inclined axis."""
    t = np.linspace(-0.9, 0.9, 19)
    if len(middle) == 2:
        down = np.column_stack([t, 0.6 * t**2 + 0.1 * t**3 - 0.8])
        return fc.RigidProfile((np.array(middle) + down)[::-1], **move)
    axis = np.array([0.0, 0.6, 0.8])
    out = t[t > -1e-9]
    points = np.outer(out, [1, 0, 0]) + np.outer(0.6 * out**2 - 0.8, axis) + middle
    return fc.RigidProfile(points[::-1], turned=(middle, axis), **move)


def _gem(middle, move):
    """Return an obstacle of few large facets, with edges and corners in the middle of Γc."""
    if len(middle) == 2:
        return fc.RigidSurface(circle(7, 0.85, middle), ring(7), **move)
    return fc.RigidSurface(*ball(1, 0.85, middle), **move)


def _ellipsoid(x, middle):
    """Return a level set that is no distance, with a gradient of length 1 where it is zero."""
    axes = [1.0, 0.8, 0.9][: len(middle)]
    level = sum((x[i] - middle[i]) ** 2 / axes[i] ** 2 for i in range(len(middle)))
    slope = 2 * ufl.sqrt(sum((x[i] - middle[i]) ** 2 / axes[i] ** 4 for i in range(len(middle))))
    return (level - 1) / slope


def derivative_error(contact, scene, seed, step=1e-6):
    """Return the relative error of tangent times direction by central differences, and scale."""
    u, operator = scene.u, fc.ContactOperator(contact)
    direction = fem.Function(u.function_space)
    direction.interpolate(rough_field(scene.dim, seed))
    start = u.x.array.copy()

    def force(factor):
        u.x.array[:] = start + factor * step * direction.x.array
        return forces(operator).array_r.copy()

    difference = (force(1) - force(-1)) / (2 * step)
    u.x.array[:] = start
    tangent = operator.tangent()
    computed = tangent.createVecLeft()
    tangent.mult(direction.x.petsc_vec, computed)
    comm = scene.mesh.comm
    size = global_max(comm, np.abs(difference))
    return global_max(comm, np.abs(computed.array_r - difference)) / size, size


def forces(operator):
    """Return minus the contact forces at the dofs."""
    vector = operator.unknowns.vector()
    operator.add_force(vector)
    return vector


def states(scene, contact, shift, angle, n=3):
    """Yield states of a history in which block and obstacle move, and commit them."""
    for seed in range(n):
        scene.u.interpolate(lambda x, seed=seed: 0.06 * rough_field(scene.dim, seed)(x))
        shift.value[:] = 0.05 * np.cos(seed + np.arange(scene.dim))
        angle.value = 0.2 * np.sin(seed + 1.0)
        yield seed
        contact.commit()


@pytest.mark.each
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("cell", CELLS)
def test_tangent_agrees_with_finite_differences(cell, shape):
    """Tangents agree with differences over a history with open, sticking and slipping points.

    Tolerance 1e-6 of the largest entry; differences with a step of 1e-6 have an error of 1e-9 if no
    status changes.
    """
    n_by_status = np.zeros(3)
    laws = LAWS if cell in ("triangle", "quadrilateral") else LAWS | IN_SPACE
    for law in laws.values():
        scene = rubber(cell, 2 if cell == "triangle" else 1, n=(4, 2), shuffled=True)
        shift, angle = (fem.Constant(scene.mesh, v) for v in (np.zeros(scene.dim), 0.0))
        contact = scene.contact(obstacles(scene, shift, angle)[shape], law)
        for seed in states(scene, contact, shift, angle):
            error, size = derivative_error(contact, scene, seed)
            assert size > 1.0 and error < 1e-6
            contact.evaluate()
            r = contact.resultants()
            n_by_status += [r.open, r.stick, r.slip]
    assert np.all(n_by_status > 0)


@pytest.mark.each
@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
@pytest.mark.parametrize(
    ("shape", "enforcement"),
    [("ball", "penalty"), ("ball", "augmented"), ("profile", "penalty"), ("facets", "augmented")],
)
def test_boundary_form_agrees_with_the_operator(cell, shape, enforcement):
    """`Contact.form` and its tangent use expressions of the obstacle instead of point values.

    For obstacles from data they use the expansion about the last evaluation. Nodal forces and
    products with the tangent agree to round-off, 1e-11.
    """
    scene = rubber(cell, 1, n=(4, 2))
    v, du = (f(scene.u.function_space) for f in (ufl.TestFunction, ufl.TrialFunction))
    shift, angle = (fem.Constant(scene.mesh, x) for x in (np.zeros(scene.dim), 0.0))
    obstacle = obstacles(scene, shift, angle)[shape]
    contact = scene.contact(obstacle, fc.Coulomb(0.3, K, K), enforcement=enforcement)
    comm, operator = scene.mesh.comm, fc.ContactOperator(contact)
    maps = contact.entity_maps
    form, tangent = (compile_form(f, maps) for f in (contact.form(v), contact.tangent(v, du)))
    for _ in states(scene, contact, shift, angle):
        if contact.multipliers is not None:
            contact.augment()
        vector = forces(operator)
        n = vector.getLocalSize()
        assembled = fem.assemble_vector(form)
        assembled.scatter_reverse(dolfinx.la.InsertMode.add)
        size = global_max(comm, np.abs(vector.array_r))
        assert size > 0
        assert global_max(comm, np.abs(assembled.array[:n] - vector.array_r)) < 1e-11 * size
        from_operator, from_form = operator.tangent(), fem.petsc.assemble_matrix(tangent)
        from_form.assemble()
        probe = fem.Function(scene.u.function_space)
        probe.interpolate(rough_field(scene.dim, 3))
        ours, other = (m.createVecLeft() for m in (from_operator, from_form))
        from_operator.mult(probe.x.petsc_vec, ours)
        from_form.mult(probe.x.petsc_vec, other)
        size = global_max(comm, np.abs(ours.array_r))
        assert global_max(comm, np.abs(ours.array_r - other.array_r)) < 1e-11 * size


def test_frictionless_tangent_is_symmetric():
    """Forces are derivatives of the potential ½ k ⟨-d⟩² to 1e-6, the tangent symmetric to 1e-13."""
    scene = rubber("tetrahedron", 1, n=(4, 2))
    contact = scene.contact(disc(scene, 0.8, displacement=(0, 0, -0.2)), fc.Frictionless(K))
    assert contact.effective_law.has_potential
    comm, operator = scene.mesh.comm, fc.ContactOperator(contact)
    direction = fem.Function(scene.u.function_space)
    direction.interpolate(rough_field(3, 1))
    start = fem.Function(scene.u.function_space)
    start.interpolate(lambda x: 0.1 * rough_field(3, 0)(x))

    def energy(step):
        scene.u.x.array[:] = start.x.array + step * direction.x.array
        return comm.allreduce(contact.energy())

    slope = (energy(1e-5) - energy(-1e-5)) / 2e-5
    scene.u.x.array[:] = start.x.array
    vector = forces(operator)
    assert vector.dot(direction.x.petsc_vec) == pytest.approx(slope, rel=1e-6)
    tangent = operator.tangent()
    mirrored = tangent.copy().transpose()
    mirrored.axpy(-1.0, tangent)
    assert 0 < tangent.norm() and mirrored.norm() < 1e-13 * tangent.norm()
    tresca = scene.contact(disc(scene, 0.8), fc.Tresca(0.3, 1.0, K, K))
    assert not tresca.effective_law.has_potential


def _contact_maker(arguments, law=None, **options):
    scene = rubber("triangle", 1, n=(2, 1))

    def make():
        obstacle = arguments(scene) if callable(arguments) else arguments
        scene.contact(obstacle, law or fc.Frictionless(K), **options)

    return make


FLOOR = fc.HalfSpace((0, 1), (0, -1))


@pytest.mark.whole
@pytest.mark.parametrize(
    ("make", "error", "text"),
    [
        (_contact_maker(FLOOR, kinematics="large"), ValueError, "'small', 'finite'"),
        (_contact_maker(FLOOR, gap=0.1), ValueError, "gap is given"),
        (_contact_maker(FLOOR, law=fc.Foundation(K, K)), ValueError, "Foundation bonds"),
        (_contact_maker(fc.PrescribedGap(0.1, (0, 1))), ValueError, "SignedDistance(lambda x"),
        (
            _contact_maker(lambda s: fc.SignedDistance(lambda x: ufl.SpatialCoordinate(s.mesh)[1])),
            ValueError,
            "SignedDistance(lambda x",
        ),
        (
            _contact_maker(
                lambda s: fc.HalfSpace(
                    (0, 1), (0, -1), displacement=0.1 * ufl.SpatialCoordinate(s.mesh)
                )
            ),
            ValueError,
            "varies over Γc",
        ),
        (
            _contact_maker(fc.HalfSpace((0, 1), (0, -1), rotation=0.1)),
            ValueError,
            "must be a Rotation",
        ),
        (
            _contact_maker(
                fc.HalfSpace((0, 1), (0, -1), rotation=fc.Rotation(0.1, (0, 0), (0, 0, 1)))
            ),
            ValueError,
            "omit it",
        ),
        (
            _contact_maker(fc.HalfSpace((0, 1), (0, -1), rotation=fc.Rotation(0.1, (0, 0, 0)))),
            ValueError,
            "about",
        ),
        (
            _contact_maker(
                fc.HalfSpace((0, 1), (0, -1), rotation=fc.Rotation(0.1, (0, 0))),
                kinematics="small",
            ),
            ValueError,
            'kinematics="finite"',
        ),
    ],
)
def test_invalid_arguments_are_refused(make, error, text):
    """Creation of the contact raises on all ranks, and the error states a remedy."""
    assert_raised_on_all_ranks(make, error, text)
