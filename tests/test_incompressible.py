"""Rubber with the pressure as an unknown: tangents, closed-form solutions, and locking."""

from __future__ import annotations

import dolfinx
import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenics_contact as fc
from fenics_contact.elasticity import NeoHookean
from fenics_contact.parallel import global_max
from scenes.blocks import BOTTOM, block_mesh, dimension, rough_field
from scenes.comparison import (
    assemble_matrix,
    assemble_owned,
    compile_with_maps,
    is_close,
    owned_values,
)
from scenes.rubber import MIXED, disc, mixed_space, rubber, split

pytestmark = [pytest.mark.mpi, pytest.mark.timeout(300)]

E = 1000.0
KINDS = ("plane strain", "axisymmetric", "3D")


def mixed_body(
    w: fem.Function, nu: float, kind: str, isochoric: bool
) -> tuple[NeoHookean, ufl.Form]:
    """Return a body with the pressure as an unknown, and its residual."""
    (u, p), (v, q) = split(ufl.split(w)), split(ufl.TestFunctions(w.function_space))
    body = NeoHookean(u, E, nu, kind, isochoric=isochoric, pressure=p)
    dx = ufl.Measure("dx", w.function_space.mesh, metadata={"quadrature_degree": 4})
    return body, body.residual(v, dx, q=q)


@pytest.mark.each
@pytest.mark.parametrize("isochoric", [False, True])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("nu", [0.3, 0.5])
def test_tangent_is_the_symmetric_derivative_of_the_residual(nu, kind, isochoric):
    """The tangent at large strain is the derivative of the residual, to 1e-7, and symmetric.

    Reference: central differences. Symmetry, to 1e-12, implies a potential of displacement and
    pressure.
    """
    cell = "tetrahedron" if kind == "3D" else "triangle"
    mesh, _ = block_mesh(cell, n=2)
    mesh.geometry.x[:, 0] += 0.5
    w, direction, other = (fem.Function(mixed_space(mesh, "Taylor-Hood")) for _ in range(3))
    amplitude = 0.01 if kind == "3D" else 0.05  # of the waves, which are steep in three dimensions
    for function, seed, size in ((w, 0, amplitude), (direction, 1, 1.0), (other, 2, 1.0)):
        function.sub(0).interpolate(
            lambda x, s=seed, a=size: a * rough_field(dimension(cell), s)(x)
        )
        function.sub(1).interpolate(lambda x, s=seed, a=size: 300 * a * np.cos(3 * x[0] + s))
    _, F = mixed_body(w, nu, kind, isochoric)
    form, start = compile_with_maps(F), w.x.array.copy()

    def residual(step):
        w.x.array[:] = start + step * direction.x.array
        return assemble_owned(form, w.function_space)

    difference = (residual(1e-5) - residual(-1e-5)) / 2e-5
    w.x.array[:] = start
    tangent = assemble_matrix(compile_with_maps(ufl.derivative(F, w)))
    product, mirrored = tangent.createVecLeft(), tangent.createVecLeft()
    tangent.mult(direction.x.petsc_vec, product)
    tangent.multTranspose(direction.x.petsc_vec, mirrored)
    size = global_max(mesh.comm, np.abs(difference))
    assert size > 1.0
    assert global_max(mesh.comm, np.abs(product.array_r - difference)) < 1e-7 * size
    mirrored.axpy(-1.0, product)
    assert mirrored.norm() < 1e-12 * product.norm()


def stresses(along: float, nu: float, kind: str, isochoric: bool) -> tuple[float, float, float]:
    """Return transverse stretch, axial nominal stress and pressure of a column by axial stretch.

    They are closed forms if ν is 1/2, and otherwise found by bisection with hand-derived
    derivatives of W.
    """
    shear = E / (2 * (1 + nu))
    if nu == 0.5:
        across = 1 / along if kind == "plane strain" else along**-0.5
        nominal = shear * (along - across**2 / along)
        square = (across**2, 1.0 if kind == "plane strain" else across**2, along**2)
        true = shear * (np.array(square) - across**2)
        # Without ``isochoric`` the stress is G (F Fᵀ - I)/J - p I.
        return across, nominal, -true.mean() if isochoric else shear * (across**2 - 1)
    lame = 2 * shear * nu / (1 - 2 * nu)
    modulus = lame + 2 * shear / 3 if isochoric else lame

    def nominal(across):
        stretch = np.array([across, 1.0 if kind == "plane strain" else across, along])
        volume, square = stretch.prod(), stretch @ stretch
        pressure = -modulus / 2 * (volume - 1 / volume)
        part = shear * (stretch - 1 / stretch)
        if isochoric:
            part = shear * volume ** (-2 / 3) * (stretch - square / (3 * stretch))
        return part - pressure * volume / stretch, pressure

    low, high = 1.0, 1.6
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if nominal(middle)[0][0] < 0 else (low, middle)
    computed, pressure = nominal(low)
    return low, computed[2], pressure


@pytest.mark.each
@pytest.mark.parametrize("isochoric", [False, True])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("nu", [0.4, 0.4999, 0.5])
def test_column_at_large_strain(nu, kind, isochoric):
    """A column compressed to two thirds of its height between frictionless planes is uniform.

    Reference: force, pressure and stresses by `stresses`, to 1e-6; the penetration is p/k_n.
    """
    k_n, nominal = 1e6, 0.0
    for _ in range(30):  # until penetration and pressure are consistent
        across, nominal, pressure = stresses((2.0 - nominal / k_n) / 3.0, nu, kind, isochoric)
    d = 3 if kind == "3D" else 2
    cell = "tetrahedron" if d == 3 else "triangle"
    mesh, tags = block_mesh(cell, n=1 if d == 3 else 2, size=[2.0] * (d - 1) + [3.0])
    W = mixed_space(mesh, "Taylor-Hood")
    w = fem.Function(W)
    body, F = mixed_body(w, nu, kind, isochoric)
    push = fem.Constant(mesh, 0.0)
    bcs = []
    for i in range(d):
        part = W.sub(0).sub(i)
        side = dolfinx.mesh.locate_entities_boundary(
            mesh, d - 1, lambda x, i=i: np.isclose(x[i], 3.0 if i == d - 1 else 0.0)
        )
        value = push if i == d - 1 else fem.Constant(mesh, 0.0)
        bcs.append(fem.dirichletbc(value, fem.locate_dofs_topological(part, d - 1, side), part))
    floor = fc.HalfSpace((0.0,) * d, (0.0,) * (d - 1) + (1.0,))
    contact = fc.Contact(
        body.u,
        fc.ContactSurface(mesh, tags, BOTTOM),
        floor,
        fc.Frictionless(k_n),
        weight=body.weight,
        kinematics="finite",
    )
    problem = fc.ContactProblem(F, w, bcs=bcs, contacts=[contact])
    for factor in (0.25, 0.5, 0.75, 1.0):
        push.value = -factor
        step = problem.solve()
        problem.commit()
    area = {"plane strain": 2.0, "axisymmetric": np.pi * 4.0, "3D": 4.0}[kind]
    assert step.contacts["contact"].normal_force == pytest.approx(-nominal * area, rel=1e-6)
    computed = w.sub(1).collapse()
    assert is_close(
        owned_values(computed), np.full_like(owned_values(computed), pressure), 1e-6, scale=E
    )
    hoop = 1.0 if kind == "plane strain" else across
    axis = 2 if d == 3 else 1
    volume = mesh.comm.allreduce(fem.assemble_scalar(fem.form(fem.Constant(mesh, 1.0) * ufl.dx)))
    for value, expected in (
        (body.stress[axis, axis], nominal / (across * hoop)),
        (body.stress[0, 0], 0.0),
        (body.nominal[axis, axis], nominal),
    ):
        mean = mesh.comm.allreduce(fem.assemble_scalar(fem.form(value * ufl.dx))) / volume
        assert mean == pytest.approx(expected, abs=1e-6 * E)


def force_under_a_disc(n: int, nu: float, **options) -> float:
    """Return the force of a disc of radius 0.8, pressed by 0.1 into a block of 2 x 1."""
    scene = rubber("triangle", n=(2 * n, n), nu=nu, E=E, **options)
    shift = fem.Constant(scene.mesh, np.zeros(2))
    law = fc.Coulomb(0.3, 1e4, 1e4)
    problem, contact = scene.problem(disc(scene, 0.8, displacement=shift), law)
    for shift.value[1] in (-0.05, -0.1):
        problem.solve()
        problem.commit()
    return contact.resultants().normal_force


@pytest.mark.parametrize("isochoric", [False, True])
@pytest.mark.parametrize("nu", [0.3, 0.45])
def test_forms_with_and_without_pressure_converge_to_the_same_force(nu, isochoric):
    """Forces with and without pressure differ by 2.5e-3, on a finer mesh by a fifth of that.

    Displacements are quadratic in both; the pressure of degree 1 causes the difference.
    """
    errors = []
    for n in (8, 16):
        with_pressure = force_under_a_disc(n, nu, mixed="Taylor-Hood", isochoric=isochoric)
        without = force_under_a_disc(n, nu, degree=2, isochoric=isochoric)
        errors.append(abs(with_pressure / without - 1))
    assert errors[0] < 2.5e-3 and errors[1] < errors[0] / 5


def test_volumetric_locking_with_and_without_pressure():
    """At ν = 0.4999 linear elements lock, with three times the force; MINI elements do not.

    Errors of the force under a disc with 8 cells over the height: linear elements 240 %, MINI 3 %,
    quadratic ones 0.4 %, Taylor-Hood 0.04 %. Reference: Taylor-Hood elements with 32 cells, which
    have converged to 1e-4.
    """
    reference = force_under_a_disc(32, 0.4999, mixed="Taylor-Hood")
    computed = {
        "P1": force_under_a_disc(8, 0.4999, degree=1),
        "P2": force_under_a_disc(8, 0.4999, degree=2),
    } | {name: force_under_a_disc(8, 0.4999, mixed=name) for name in MIXED}
    errors = {name: force / reference - 1 for name, force in computed.items()}
    assert errors["P1"] > 2.0
    assert 2e-3 < errors["P2"] < 6e-3
    assert abs(errors["MINI"]) < 4e-2
    assert abs(errors["Taylor-Hood"]) < 1e-3


def test_invalid_pressure_and_poisson_ratio_are_refused():
    """A missing test function, a vector pressure and ν outside of its range are refused by name."""
    mesh, _ = block_mesh("triangle")
    w = fem.Function(mixed_space(mesh, "Taylor-Hood"))
    (u, p), (v, q) = ufl.split(w), ufl.TestFunctions(w.function_space)
    body = NeoHookean(u, E, 0.5, "plane strain", pressure=p)
    with pytest.raises(ValueError, match=r"residual\(v, q=q\)"):
        body.residual(v)
    with pytest.raises(ValueError, match="no pressure"):
        NeoHookean(u, E, 0.4, "plane strain").residual(v, q=q)
    with pytest.raises(ValueError, match=r"nu is 0\.5; .* between -1 and 0\.5"):
        NeoHookean(u, E, 0.5, "plane strain")
    for nu in (0.0, 0.6):
        with pytest.raises(ValueError, match=rf"nu is {nu}; .* \(included\)"):
            NeoHookean(u, E, nu, "plane strain", pressure=p)
    with pytest.raises(ValueError, match="pressure has shape"):
        NeoHookean(u, E, 0.5, "plane strain", pressure=u)
    with pytest.raises(ValueError, match="u is a ndarray"):
        NeoHookean(np.zeros(2), E, 0.5, "plane strain", pressure=p)
