"""Elastic bodies of every kind in contact, against uniform stress and Lamé's ring."""

from __future__ import annotations

import dolfinx
import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import CellType
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.elasticity import LinearElastic, NeoHookean
from fenics_contact.parallel import global_max

E, NU, PRESSURE, K_N = 1000.0, 0.3, 10.0, 1e5
BOTTOM, TOP = 1, 2

pytestmark = [pytest.mark.two_ranks, pytest.mark.hexahedra]


def end_tags(mesh, axis: int, high: float, low: float = 0.0):
    """Return tags BOTTOM and TOP at the coordinates ``low`` and ``high``. Collective."""
    fdim = mesh.topology.dim - 1
    end_facets = [
        dolfinx.mesh.locate_entities_boundary(
            mesh, fdim, lambda x, value=value: np.isclose(x[axis], value)
        )
        for value in (low, high)
    ]
    facets = np.concatenate(end_facets)
    order = np.argsort(facets)
    values = np.repeat(np.int32([BOTTOM, TOP]), [len(f) for f in end_facets])
    return dolfinx.mesh.meshtags(mesh, fdim, facets[order], values[order])


def column(kind: str, degree: int = 2, **options):
    """Solve a column of height 3 and sides 2 on a frictionless rigid plane, pressed on its top.

    Normal displacements are zero at x = 0 (and y = 0), the axis if it is axisymmetric.
    """
    d = 3 if kind == "3D" else 2
    size = [2.0, 3.0] if d == 2 else [2.0, 2.0, 3.0]
    if d == 2:
        mesh = dolfinx.mesh.create_rectangle(
            MPI.COMM_WORLD, [np.zeros(2), np.array(size)], (3, 4), CellType.triangle
        )
    else:
        mesh = dolfinx.mesh.create_box(
            MPI.COMM_WORLD, [np.zeros(3), np.array(size)], (2, 2, 2), CellType.tetrahedron
        )
    tags = end_tags(mesh, d - 1, 3.0)
    V = fem.functionspace(mesh, ("Lagrange", degree, (d,)))
    u, v = fem.Function(V), ufl.TestFunction(V)
    body = LinearElastic(u, E, NU, kind, **options)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags)
    F = body.residual(v) + body.weight * PRESSURE * v[d - 1] * ds(TOP)
    bcs = []
    for i in range(d - 1):
        side = dolfinx.mesh.locate_entities_boundary(
            mesh, d - 1, lambda x, i=i: np.isclose(x[i], 0)
        )
        dofs = fem.locate_dofs_topological(V.sub(i), d - 1, side)
        bcs.append(fem.dirichletbc(dolfinx.default_scalar_type(0.0), dofs, V.sub(i)))
    floor = fc.HalfSpace(point=[0.0] * d, normal=[0.0] * (d - 1) + [1.0])
    contact = fc.Contact(
        u, fc.ContactSurface(mesh, tags, BOTTOM), floor, fc.Frictionless(K_N), weight=body.weight
    )
    fc.ContactProblem(F, u, bcs=bcs, contacts=[contact]).solve()
    return body, contact


def deviation(u: fem.Function, exact) -> float:
    """Return the largest difference from a displacement given as function of x. Collective."""
    other = fem.Function(u.function_space)
    other.interpolate(exact)
    return global_max(u.function_space.mesh.comm, np.abs(u.x.array - other.x.array))


# Kind, options, contact area (2 by thickness, 2πr or 2), axial and transverse strain per pressure.
UNIFORM = [
    ("plane strain", {}, 2.0, (1 - NU**2) / E, NU * (1 + NU) / E),
    ("plane strain", {"thickness": 5.0}, 10.0, (1 - NU**2) / E, NU * (1 + NU) / E),
    ("plane stress", {"thickness": 6.4}, 12.8, 1 / E, NU / E),
    ("axisymmetric", {}, 4 * np.pi, 1 / E, NU / E),
    ("3D", {}, 4.0, 1 / E, NU / E),
]


@pytest.mark.each
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize(("kind", "options", "area", "along", "across"), UNIFORM)
def test_column_under_uniform_pressure(kind, options, area, along, across, degree) -> None:
    """Force p·area, penetration p/k_n and strain by Hooke's law agree to 1e-8, pressure to 1e-7.

    Both degrees represent the linear solution; the solver stops at 1e-9 of the forces.
    """
    body, contact = column(kind, degree, **options)
    d = len(body.u)
    resultants = contact.resultants()
    assert resultants.normal_force == pytest.approx(PRESSURE * area, rel=1e-8)
    assert resultants.area == pytest.approx(area, rel=1e-12)
    assert contact.pressure == pytest.approx(np.full(len(contact.pressure), PRESSURE), rel=1e-7)

    def exact(x):
        sides = [PRESSURE * across * x[i] for i in range(d - 1)]
        return np.vstack([*sides, -PRESSURE * along * x[d - 1] - PRESSURE / K_N])

    assert deviation(body.u, exact) <= 1e-8 * PRESSURE * 3 / E


@pytest.mark.parametrize(("kind", "third"), [("plane strain", -NU * PRESSURE), ("plane stress", 0)])
def test_out_of_plane_stress(kind: str, third: float) -> None:
    """σ_zz is -νp in plane strain and 0 in plane stress, to 1e-7 of the pressure."""
    body, _ = column(kind)
    mesh = body.u.function_space.mesh
    wrong = ufl.sqrt((body.stress[2, 2] - third) ** 2 + (body.stress[1, 1] + PRESSURE) ** 2)
    total = mesh.comm.allreduce(fem.assemble_scalar(fem.form(wrong * ufl.dx)))
    assert total <= 1e-7 * PRESSURE


def test_axisymmetric_ring_on_a_mandrel() -> None:
    """A ring of radii 10/20, free along z, on a rigid mandrel with 0.01 interference: Lamé, 1e-4.

    The reference includes the compliance 1/k_n. Displacements are quadratic, cells 0.25 wide.
    """
    mesh = dolfinx.mesh.create_rectangle(
        MPI.COMM_WORLD, [(10.0, 0.0), (20.0, 2.0)], (40, 4), CellType.quadrilateral
    )
    tags = end_tags(mesh, 0, 20.0, low=10.0)
    V = fem.functionspace(mesh, ("Lagrange", 2, (2,)))
    u, v = fem.Function(V), ufl.TestFunction(V)
    modulus = fem.Constant(mesh, E)
    body = LinearElastic(u, modulus, NU, "axisymmetric")
    base = dolfinx.mesh.locate_entities_boundary(mesh, 1, lambda x: np.isclose(x[1], 0))
    dofs = fem.locate_dofs_topological(V.sub(1), 1, base)
    bc = fem.dirichletbc(dolfinx.default_scalar_type(0.0), dofs, V.sub(1))
    contact = fc.Contact(
        u,
        fc.ContactSurface(mesh, tags, BOTTOM),
        fc.HalfSpace(point=(10.0, 0.0), normal=(1.0, 0.0)),
        fc.Frictionless(K_N),
        gap=-0.01,
        weight=body.weight,
    )
    fc.ContactProblem(body.residual(v), u, bcs=[bc], contacts=[contact]).solve()
    compliance = 10 / E * ((20**2 + 10**2) / (20**2 - 10**2) + NU) + 1 / K_N
    points = contact.gather()
    exact = np.full(len(points["pressure"]), 0.01 / compliance)
    assert points["pressure"] == pytest.approx(exact, rel=1e-4)
    force = 0.01 / compliance * 2 * np.pi * 10 * 2
    assert contact.resultants().normal_force == pytest.approx(force, rel=1e-4)


@pytest.mark.parametrize("inner", [0.0, 1.0])
def test_uniform_pressure_under_axisymmetric_disc(inner: float) -> None:
    """A disc or ring loaded by PRESSURE has p = PRESSURE at every point with multipliers, to 1e-5.

    Linear cells represent the uniaxial stress exactly; 1e-5 is the tolerance of the augmentation.
    Vertex quadrature is refused for the disc, since the weight vanishes on the axis.
    """
    corners = [(inner, 0.0), (inner + 2.0, 1.0)]
    mesh = dolfinx.mesh.create_rectangle(MPI.COMM_WORLD, corners, (4, 3))
    tags = end_tags(mesh, 1, 1.0)
    V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
    u, v = fem.Function(V), ufl.TestFunction(V)
    body = LinearElastic(u, fem.Constant(mesh, E), NU, "axisymmetric")
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags)
    F = body.residual(v) + body.weight * PRESSURE * v[1] * ds(TOP)
    bcs = []
    if not inner:
        axis = dolfinx.mesh.locate_entities_boundary(mesh, 1, lambda x: np.isclose(x[0], 0))
        dofs = fem.locate_dofs_topological(V.sub(0), 1, axis)
        bcs = [fem.dirichletbc(dolfinx.default_scalar_type(0.0), dofs, V.sub(0))]
    floor = fc.HalfSpace((0, 0), (0, 1))

    def solve_contact(enforcement: str, **rule: str) -> fc.Contact:
        surface = fc.ContactSurface(mesh, tags, BOTTOM, **rule)
        disc_contact = fc.Contact(
            u, surface, floor, fc.Frictionless(), weight=body.weight, enforcement=enforcement
        )
        fc.ContactProblem(F, u, bcs=bcs, contacts=[disc_contact]).solve()
        return disc_contact

    points = solve_contact("augmented").gather()
    assert points["pressure"] == pytest.approx(np.full(len(points["pressure"]), PRESSURE), rel=1e-5)
    if not inner:
        with pytest.raises(ValueError, match="weight is 0 at a vertex"):
            solve_contact("penalty", quadrature_scheme="vertex")


def test_moduli_as_functions() -> None:
    """Compliances of two layers in series add up to 1e-7, and relative stiffness uses E/h."""
    mesh = dolfinx.mesh.create_rectangle(MPI.COMM_WORLD, [(0.0, 0.0), (1.0, 2.0)], (2, 4))
    V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
    u, v = fem.Function(V), ufl.TestFunction(V)
    modulus = fem.Function(fem.functionspace(mesh, ("DG", 0)))
    modulus.interpolate(lambda x: np.where(x[1] < 1, E, 3 * E))
    body = LinearElastic(u, modulus, 0.0, "plane stress", thickness=fem.Constant(mesh, 2.0))
    tags = end_tags(mesh, 1, 2.0)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags)
    F = body.residual(v) + body.weight * PRESSURE * v[1] * ds(TOP)
    corner = fem.locate_dofs_geometrical(
        (V.sub(0), V.sub(0).collapse()[0]), lambda x: np.isclose(x[0], 0)
    )[0]
    bc = fem.dirichletbc(dolfinx.default_scalar_type(0.0), corner, V.sub(0))
    contact = fc.Contact(
        u,
        fc.ContactSurface(mesh, tags, BOTTOM),
        fc.HalfSpace((0, 0), (0, 1)),
        fc.Frictionless(),
        weight=body.weight,
    )
    fc.ContactProblem(F, u, bcs=[bc], contacts=[contact]).solve()
    assert contact.resultants().normal_force == pytest.approx(2 * PRESSURE, rel=1e-8)
    lowest = -PRESSURE * (1 / E + 1 / (3 * E)) - PRESSURE / (10 * E / 0.5)
    assert -global_max(mesh.comm, -u.x.array) == pytest.approx(lowest, rel=1e-7)


def test_invalid_arguments_are_named() -> None:
    """Errors name invalid kinds, dimensions and numbers."""
    mesh = dolfinx.mesh.create_unit_square(MPI.COMM_WORLD, 2, 2)
    u = fem.Function(fem.functionspace(mesh, ("Lagrange", 1, (2,))))
    with pytest.raises(ValueError, match="kind is 'plane'"):
        LinearElastic(u, E, NU, "plane")
    with pytest.raises(ValueError, match="on a mesh in 2D"):
        LinearElastic(u, E, NU, "3D")
    with pytest.raises(ValueError, match="omit it"):
        LinearElastic(u, E, NU, "axisymmetric", thickness=2.0)
    with pytest.raises(ValueError, match=r"nu is 0\.5"):
        LinearElastic(u, E, 0.5, "plane strain")
    with pytest.raises(ValueError, match="E is -1"):
        LinearElastic(u, -1.0, NU, "plane strain")
    with pytest.raises(ValueError, match="thickness is 0"):
        LinearElastic(u, E, NU, "plane stress", thickness=0)
    LinearElastic(u, E, 0.5, "plane stress")  # incompressible sheets are valid


@pytest.mark.each
@pytest.mark.parametrize("isochoric", [False, True])
@pytest.mark.parametrize("kind", ["plane strain", "axisymmetric", "3D"])
def test_neo_hookean_column_at_large_strain(kind, isochoric):
    """A column compressed to two thirds of its height without friction has uniform stretches.

    Reference: bisection for the transverse stretch at zero transverse stress, with derivatives of W
    by hand. The force is the axial nominal stress times the area, to 1e-6; stretch and Cauchy
    stress to 1e-5. The penetration p/k_n is included.
    """
    shear, lame = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
    bulk, k_n = lame + 2 * shear / 3, 1e6

    def stresses(across, along):
        """Return transverse and axial nominal stress; plane strain has out-of-plane stretch 1."""
        stretch = np.array([across, 1.0 if kind == "plane strain" else across, along])
        volume, square = stretch.prod(), stretch @ stretch
        if isochoric:
            part = shear * volume ** (-2 / 3) * (stretch - square / (3 * stretch))
            part = part + bulk / 2 * (volume**2 - 1) / stretch
        else:
            part = shear * (stretch - 1 / stretch) + lame / 2 * (volume**2 - 1) / stretch
        return part[0], part[2]

    nominal = 0.0
    for _ in range(20):  # fixed-point iteration for the penetration
        along = (2.0 - nominal / k_n) / 3.0
        low, high = 1.0, 1.5
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if stresses(middle, along)[0] < 0 else (low, middle)
        across, nominal = stresses(low, along)
    d = 3 if kind == "3D" else 2
    size = [2.0] * (d - 1) + [3.0]
    cell = CellType.tetrahedron if d == 3 else CellType.triangle
    make = dolfinx.mesh.create_box if d == 3 else dolfinx.mesh.create_rectangle
    mesh = make(MPI.COMM_WORLD, [np.zeros(d), np.array(size)], [2] * d, cell)
    tags = end_tags(mesh, d - 1, 3.0)
    V = fem.functionspace(mesh, ("Lagrange", 2, (d,)))
    u, v = fem.Function(V), ufl.TestFunction(V)
    body = NeoHookean(u, E, NU, kind, isochoric=isochoric)
    push = fem.Constant(mesh, 0.0)
    bcs = []
    for i in range(d - 1):
        side = dolfinx.mesh.locate_entities_boundary(
            mesh, d - 1, lambda x, i=i: np.isclose(x[i], 0)
        )
        dofs = fem.locate_dofs_topological(V.sub(i), d - 1, side)
        bcs.append(fem.dirichletbc(0.0, dofs, V.sub(i)))
    dofs = fem.locate_dofs_topological(V.sub(d - 1), d - 1, tags.find(TOP))
    bcs.append(fem.dirichletbc(push, dofs, V.sub(d - 1)))
    floor = fc.HalfSpace((0.0,) * d, (0.0,) * (d - 1) + (1.0,))
    surface = fc.ContactSurface(mesh, tags, BOTTOM)
    contact = fc.Contact(
        u, surface, floor, fc.Frictionless(k_n), weight=body.weight, kinematics="finite"
    )
    problem = fc.ContactProblem(body.residual(v), u, bcs=bcs, contacts=[contact])
    for factor in (0.25, 0.5, 0.75, 1.0):
        push.value = -factor
        step = problem.solve()
        problem.commit()
    assert abs(across) < 1e-9 * E
    area = {"plane strain": 2.0, "axisymmetric": np.pi * 4.0, "3D": 4.0}[kind]
    assert step.contacts["contact"].normal_force == pytest.approx(-nominal * area, rel=1e-6)
    hoop = {"plane strain": 1.0, "axisymmetric": low, "3D": low}[kind]
    stretch = contact.area_stretch() * (hoop if kind == "axisymmetric" else 1.0)
    expected = low * hoop
    assert np.allclose(stretch, expected, rtol=1e-5)
    true = fem.form(body.stress[2 if d == 3 else 1, 2 if d == 3 else 1] * ufl.dx)
    volume = mesh.comm.allreduce(fem.assemble_scalar(fem.form(ufl.as_ufl(1.0) * ufl.dx(mesh))))
    mean = mesh.comm.allreduce(fem.assemble_scalar(true)) / volume
    assert mean == pytest.approx(nominal / expected, rel=1e-5)
