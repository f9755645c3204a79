"""Bulk forms, Dirichlet conditions and loads with contact, against closed-form solutions."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.elasticity import LinearElastic
from scenes.blocks import BOTTOM, LEFT, TOP, block, block_mesh, kirchhoff
from scenes.comparison import (
    are_identical,
    assert_raised_on_all_ranks,
    compile_with_maps,
    gather,
    is_close,
    is_interpolant,
    nodal_values,
    owned_values,
)
from scenes.elasticity import dirichlet_bc, displacement_space, strain
from scenes.rubber import rubber

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(240)]
COMM = MPI.COMM_WORLD

# Solver tolerances for comparisons finer than the default of 1e-9 of the forces.
TIGHT = {"snes_rtol": 1e-13}


def test_distant_obstacle_has_no_contact_force():
    """With a distant obstacle the problem is linear elasticity, and the contact force is zero."""
    scene = block("triangle", 2)
    push = fem.Constant(scene.mesh, -0.01)
    bcs = [*scene.rollers(), scene.dirichlet_bc(TOP, 1, push)]
    far = fc.HalfSpace((0, -1.0), (0, 1))
    problem, _ = scene.problem(fc.Coulomb(0.3), bcs, contact={"obstacle": far})
    step = problem.solve()
    r = step.contacts["contact"]
    assert r.normal_force == 0.0 and r.area == 0.0 and r.stick == r.slip == 0
    # The block moves as a rigid body, up to the solver's tolerance of 1e-9.
    assert is_interpolant(scene.u, lambda x: np.vstack([0 * x[0], 0 * x[0] - 0.01]), 1e-8)


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_body_force(cell):
    """A block under its weight has N = weight and σ = ρ g (1 - y), with elements of degree 2.

    Reference: ν = 0, u_y = -ρg/k_n - ρg (y - y²/2)/E, which the element represents, to 1e-9.
    """
    weight, k_n = 3.0, 5e3
    scene = block(cell, 2, nu=0.0)
    scene.body_force.value[:] = scene.vector(up=-weight)
    problem, _ = scene.problem(fc.Frictionless(k_n=k_n), scene.rollers(), petsc_options=TIGHT)
    step = problem.solve()
    assert step.contacts["contact"].normal_force == pytest.approx(weight, rel=1e-10)

    def exact(x):
        y = x[scene.dim - 1]
        rows = [0 * y for _ in range(scene.dim)]
        rows[-1] = -weight / k_n - weight * (y - y**2 / 2) / 1000.0
        return np.vstack(rows)

    assert is_interpolant(scene.u, exact, 1e-9)


def test_dirichlet_condition_on_one_component():
    """A top pressed down by d has N = d / (H/E' + 1/k_n), E' = E/(1 - ν²), to 1e-9."""
    scene = block("quadrilateral", shuffled=True)
    push = fem.Constant(scene.mesh, -0.01)
    bcs = [*scene.rollers(), scene.dirichlet_bc(TOP, 1, push)]
    problem, _ = scene.problem(fc.Frictionless(k_n=5e3), bcs, petsc_options=TIGHT)
    for down in (0.01, 0.02):
        push.value = -down
        step = problem.solve()
        expected = down / ((1 - 0.3**2) / 1000 + 1 / 5e3)
        assert step.contacts["contact"].normal_force == pytest.approx(expected, rel=1e-9)


@pytest.mark.each
@pytest.mark.parametrize("kind", ["vector", "function", "component by function"])
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_dirichlet_conditions_of_all_kinds(cell, kind):
    """All kinds of DOLFINx's Dirichlet conditions on the top give N = d / (H/E + 1/k_n), ν = 0.

    On several ranks a condition includes dofs owned by another rank. Tolerance 1e-9.
    """
    scene = block(cell, nu=0.0, n=3)
    space = scene.u.function_space
    down = scene.vector(up=-0.01)
    if kind == "vector":
        bcs = [fem.dirichletbc(down, scene.facet_dofs(TOP), space)]
    elif kind == "function":
        value = fem.Function(space)
        value.interpolate(lambda x: np.outer(down, np.ones(x.shape[1])))
        bcs = [fem.dirichletbc(value, scene.facet_dofs(TOP))]
    else:
        bcs = []
        for i in range(scene.dim):
            part, _ = space.sub(i).collapse()
            value = fem.Function(part)
            value.x.array[:] = down[i]
            facets = scene.tags.find(TOP)
            dofs = fem.locate_dofs_topological((space.sub(i), part), scene.dim - 1, facets)
            bcs.append(fem.dirichletbc(value, dofs, space.sub(i)))
    problem, _ = scene.problem(fc.Coulomb(0.3, k_n=5e3, k_t=5e3), bcs, petsc_options=TIGHT)
    step = problem.solve()
    expected = 0.01 / (1 / 1000 + 1 / 5e3)
    assert step.contacts["contact"].normal_force == pytest.approx(expected, rel=1e-9)


def test_plane_stress_with_thickness():
    """A plate of thickness 0.2, in the form and as ``weight``, is in plane stress, σ_x = σ_z = 0.

    Reference: u_x = ν p x/E, u_y = -p y/E - p/k_n; N = p · 0.2, to 1e-10.
    """
    E, nu, p, k_n, thickness = 1000.0, 0.3, 2.0, 5e3, 0.2
    scene = block("triangle", up=-p, shuffled=True)
    v = ufl.TestFunction(scene.u.function_space)
    t = fem.Constant(scene.mesh, thickness)
    e = strain(scene.u)
    sigma = (
        scene.E / (1 - scene.nu**2) * ((1 - scene.nu) * e + scene.nu * ufl.tr(e) * ufl.Identity(2))
    )
    scene.F = t * ufl.inner(sigma, strain(v)) * ufl.dx(scene.mesh)
    scene.F -= t * ufl.dot(scene.traction, v) * ufl.ds(scene.mesh, subdomain_data=scene.tags)(TOP)
    problem, contact = scene.problem(
        fc.Frictionless(k_n=k_n), scene.rollers(), contact={"weight": t}, petsc_options=TIGHT
    )
    step = problem.solve()
    assert step.contacts["contact"].normal_force == pytest.approx(p * thickness, rel=1e-10)
    assert step.contacts["contact"].max_pressure == pytest.approx(p, rel=1e-10)
    assert is_interpolant(
        scene.u, lambda x: np.vstack([nu * p / E * x[0], -p / E * x[1] - p / k_n]), 1e-10
    )
    # E/h is computed from the form, divided by the thickness: within the 10 % that the docstring of
    # `cell_modulus` states for plane stress; without the weight it would be a fifth.
    law = fc.Frictionless(k_n=fc.RelativeStiffness(5.0))
    scene.problem(law, scene.rollers(), contact={"weight": t})
    _, scaled = scene.problem(law, scene.rollers(), contact={"weight": t})
    k = gather(COMM, scaled.values.parameters["k_n"])
    with_modulus = scene.contact(law, modulus=E)
    reference = gather(COMM, with_modulus.values.parameters["k_n"])
    assert np.all(np.abs(k / reference - 1) <= 0.1)
    assert np.array_equal(gather(COMM, contact.status), np.full(len(k), fc.Status.SLIP))


@pytest.mark.parametrize("degree", [1, 2])
def test_axisymmetric(degree):
    """A cylinder under axial pressure, weight 2πr, has σ_z = -p as only stress, and N = p π R².

    Reference: u_r = ν p r/E, u_z = -p z/E - p/k_n, linear. Tolerance 1e-9, round-off near the
    axis: the hoop strain u_r/r is constant, so that its quadrature is exact.
    """
    E, nu, p, k_n, radius = 1000.0, 0.3, 2.0, 5e3, 1.5
    scene = block("quadrilateral", degree, up=-p, size=(radius, 1.0), shuffled=True)
    x = ufl.SpatialCoordinate(scene.mesh)
    ring = 2 * ufl.pi * x[0]

    def strain3(w):
        e = strain(w)
        return ufl.as_tensor([[e[0, 0], e[0, 1], 0], [e[0, 1], e[1, 1], 0], [0, 0, w[0] / x[0]]])

    mu, lam = (
        scene.E / (2 * (1 + scene.nu)),
        scene.E * scene.nu / (1 + scene.nu) / (1 - 2 * scene.nu),
    )
    e = strain3(scene.u)
    sigma = 2 * mu * e + lam * ufl.tr(e) * ufl.Identity(3)
    v = ufl.TestFunction(scene.u.function_space)
    dx = ufl.dx(scene.mesh, metadata={"quadrature_degree": 4})
    ds = ufl.ds(scene.mesh, subdomain_data=scene.tags)
    scene.F = ring * ufl.inner(sigma, strain3(v)) * dx - ring * ufl.dot(scene.traction, v) * ds(TOP)
    problem, _ = scene.problem(
        fc.Frictionless(k_n=k_n),
        scene.rollers(),
        contact={"weight": ring},
        petsc_options=TIGHT,
    )
    step = problem.solve()
    force = step.contacts["contact"].normal_force
    assert force == pytest.approx(p * np.pi * radius**2, rel=1e-9)
    assert is_interpolant(
        scene.u, lambda x: np.vstack([nu * p / E * x[0], -p / E * x[1] - p / k_n]), 1e-9
    )


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.0, 1e3), (1e3, 0.0)])
def test_mass_term_does_not_change_the_relative_stiffness(offset):
    """A term 5 u, of inertia or a soft foundation, does not change k_n, wherever the body is.

    Reference: k_n = 5 E/h of the elastic part, E = 1000, h = 1/4. Once E depended on the distance
    from the origin and was 0.3, 16 and 35 % too large. Tolerance 1e-9: round-off of coordinates
    1e3 times as large as cells.
    """
    mesh, tags = block_mesh("quadrilateral", n=4)
    mesh.geometry.x[:, :2] += offset
    u = fem.Function(displacement_space(mesh, 1))
    v = ufl.TestFunction(u.function_space)
    F = LinearElastic(u, 1000.0, 0.3, "plane strain").residual(v)
    F += fem.Constant(mesh, 5.0) * ufl.dot(u, v) * ufl.dx
    law = fc.Frictionless(k_n=fc.RelativeStiffness(5.0))
    surface = fc.ContactSurface(mesh, tags, BOTTOM)
    contact = fc.Contact(u, surface, fc.HalfSpace(offset, (0.0, 1.0)), law)
    fc.ContactProblem(F, u, bcs=[dirichlet_bc(u, tags, LEFT, 0)], contacts=[contact]).solve()
    k_n = gather(COMM, contact.values.parameters["k_n"])
    assert is_close(k_n, np.full(len(k_n), 5.0 * 1000.0 * 4), 1e-9)


@pytest.mark.parametrize("kind", ["function", "ufl"])
def test_variable_modulus(kind):
    """Layers with E = 1000 and 4000 give a piecewise linear u; k_n is relative to the lower E.

    Reference: ν = 0, u_y(y) = -p/k_n - p ∫ dy/E; k_n = 5 · 1000 / (1/4). Tolerance 1e-9.
    """
    p = 2.0
    scene = block("quadrilateral", up=-p, n=4, nu=0.0)
    if kind == "function":
        E = fem.Function(fem.functionspace(scene.mesh, ("DG", 0)))
        E.interpolate(lambda x: np.where(x[1] < 0.5, 1000.0, 4000.0))
    else:
        y = ufl.SpatialCoordinate(scene.mesh)[1]
        E = ufl.conditional(ufl.lt(y, 0.5), scene.E, 4 * scene.E)
    v = ufl.TestFunction(scene.u.function_space)
    scene.F = ufl.inner(E * strain(scene.u), strain(v)) * ufl.dx(scene.mesh)
    ds = ufl.ds(scene.mesh, subdomain_data=scene.tags)
    scene.F -= ufl.dot(scene.traction, v) * ds(TOP)
    problem, contact = scene.problem(
        fc.Frictionless(k_n=fc.RelativeStiffness(5.0)), scene.rollers(), petsc_options=TIGHT
    )
    problem.solve()
    k_n = gather(COMM, contact.values.parameters["k_n"])
    assert is_close(k_n, np.full(len(k_n), 5.0 * 1000.0 * 4), 1e-9)

    def exact(x):
        y = x[1]
        layers = np.minimum(y, 0.5) / 1000 + np.maximum(y - 0.5, 0) / 4000
        return np.vstack([0 * y, -p / 2e4 - p * layers])

    assert is_interpolant(scene.u, exact, 1e-9)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_nonlinear_bulk(cell, method):
    """St Venant-Kirchhoff under a dead load of E/10 has a stretch with λ (λ² - 1) E/2 = -p.

    ν = 0, so that the state is uniaxial; the penetration is p/k_n. Reference: the root of the cubic
    by numpy. Tolerance 1e-8: the solver's 1e-11 of the forces, times the condition of the tangent.
    """
    E, p, k_n = 1000.0, 100.0, 5e4
    scene = block(cell, up=-p)
    scene.F = kirchhoff(scene)
    problem, _ = scene.problem(
        fc.Frictionless(k_n=k_n),
        scene.rollers(),
        method=method,
        petsc_options={"snes_rtol": 1e-11},
    )
    assert not problem.full.bulk.linear
    for load_factor in (0.5, 1.0):
        scene.load(up=-load_factor * p)
        step = problem.solve()
        problem.commit()
        roots = np.roots([E / 2, 0, -E / 2, load_factor * p])
        stretch = max(r.real for r in roots if abs(r.imag) < 1e-12)
        assert 0.5 < stretch < 1.0
        assert step.contacts["contact"].normal_force == pytest.approx(load_factor * p, rel=1e-8)

        def exact(x, stretch=stretch, load_factor=load_factor):
            rows = [0 * x[0] for _ in range(scene.dim)]
            rows[-1] = (stretch - 1) * x[scene.dim - 1] - load_factor * p / k_n
            return np.vstack(rows)

        assert is_interpolant(scene.u, exact, 1e-8)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_failed_increment_of_nonlinear_bulk_is_recoverable(method):
    """A neo-Hookean block compressed to negative height raises NotConverged and can be continued.

    Reference for the next increment: an equal block that never failed, to 1e-7 of the largest
    value.
    """
    results = []
    for fails in (True, False):
        scene = block("quadrilateral")
        v = ufl.TestFunction(scene.u.function_space)
        F = ufl.Identity(2) + ufl.grad(scene.u)
        J = ufl.det(F)
        P = scene.E / 2 * (F - ufl.inv(F).T) + scene.E / 4 * ufl.ln(J) * ufl.inv(F).T
        scene.F = ufl.inner(P, ufl.grad(v)) * ufl.dx(scene.mesh)
        push = fem.Constant(scene.mesh, 0.0)
        bcs = [*scene.rollers(), scene.dirichlet_bc(TOP, 1, push)]
        problem, contact = scene.problem(fc.Coulomb(0.2, k_n=2e4, k_t=1e4), bcs, method=method)
        push.value = -0.01
        problem.solve()
        problem.commit()
        if fails:
            before = scene.u.x.array.copy(), contact.history.function.x.array.copy()
            push.value = -3.0
            with pytest.raises(fc.NotConverged) as caught:
                problem.solve()
            assert caught.value.increment == 2
            after = scene.u.x.array, contact.history.function.x.array
            assert are_identical(before, after)
        push.value = -0.02
        step = problem.solve()
        assert step.increment == 2
        results.append((gather(COMM, owned_values(scene.u)), gather(COMM, contact.traction)))
    for a, b in zip(*results, strict=True):
        assert is_close(a, b, 1e-7)


def test_collapsed_cells_do_not_loosen_later_tolerances():
    """After a failed increment with collapsed cells, rubber is solved as if it had not failed.

    The allowed round-off depends on the last assembled stiffness, which is unbounded for collapsed
    cells: once residuals of 1e-4 of the forces were accepted in the next increment. Reference:
    Newton's method to 1e-12, without the failure; to 1e-8 of the largest displacement, for 1e-9 of
    the forces.
    """
    computed = []
    for displacements, options in (
        ((0.1, 1.5, 0.12), {"method": "lbfgs", "linear_solver": "multigrid"}),
        ((0.1, 0.12), {"method": "newton", "petsc_options": {"snes_rtol": 1e-12}}),
    ):
        body = rubber(degree=1, n=(12, 8))
        ball = fc.Ball((0.0, 2.0), 1.0)
        problem, _ = body.problem(ball, fc.Coulomb(0.3), **options)
        for up in displacements:
            body.move_bottom(lambda x, up=up: x + up * np.array([[0.0], [1.0]]))
            if up > 1.0:
                assert_raised_on_all_ranks(problem.solve, fc.NotConverged)
                continue
            problem.solve()
            problem.commit()
        computed.append(nodal_values(body.u))
    assert is_close(*computed, 1e-8)


def test_inverted_corner_is_detected_by_any_quadrature():
    """The inversion of one bilinear cell at a corner that moves by a (1, 1) is detected.

    det(I + grad u) = 1 + a (x + y) is 1 + 2a at that corner and larger at all Gauss points.
    Reference: its sign, for a = -1/2 with 5 % of the size of the cell on either side.
    """
    scene = rubber("quadrilateral", degree=1, n=(1, 1), size=[1.0, 1.0])
    problem, _ = scene.problem(fc.HalfSpace((0, 2.0), (0, -1.0)), fc.Frictionless(1e4))
    for a, inverted in ((-0.45, False), (-0.55, True)):
        scene.u.interpolate(lambda x, a=a: a * (x[0] + 0.5) * x[1] * np.ones((2, 1)))
        assert problem.full.bulk.is_inverted() is inverted


def test_unsymmetric_bulk():
    """A bulk with an unsymmetric tangent is recognised as unsymmetric, and solved.

    An elastic bedding in the bulk has a lateral force that also depends on the settlement.
    Reference: the forces on the block sum to zero, to 1e-8 of the load.
    """
    scene = block("quadrilateral", up=-1.0)
    v = ufl.TestFunction(scene.u.function_space)
    coupling = fem.Constant(scene.mesh, ((20.0, 15.0), (0.0, 0.0)))
    dx = ufl.dx(scene.mesh)
    scene.F += ufl.dot(coupling * scene.u, v) * dx
    problem, _ = scene.problem(fc.Coulomb(0.4, k_n=1e4, k_t=1e3), [])
    assert problem.full.bulk.linear and not problem.full.bulk.symmetric
    step = problem.solve()
    mean = [
        COMM.allreduce(fem.assemble_scalar(compile_with_maps(scene.u[i] * dx))) for i in range(2)
    ]
    bedding = 20.0 * mean[0] + 15.0 * mean[1]
    force = step.contacts["contact"].force
    assert force[1] == pytest.approx(1.0, abs=1e-8)
    assert force[0] == pytest.approx(bedding, abs=1e-8)
    assert abs(bedding) > 1e-4


def test_load_with_a_jump_in_the_displacement():
    """A load that jumps with the displacement makes the bulk nonlinear, with zero derivative.

    It is 3 until the top has sunk by 1e-4, and 2 afterwards; the solution has sunk by 2e-3.
    Reference: N = 2, to 1e-8, the solver's tolerance times the condition of the tangent.
    """
    E, k_n = 1000.0, 5e4
    scene = block("quadrilateral", E=E, nu=0.0, n=2)
    v = ufl.TestFunction(scene.u.function_space)
    sunk = ufl.lt(scene.u[1], -1e-4)
    scene.F += (
        ufl.conditional(sunk, 2.0, 3.0) * v[1] * ufl.ds(scene.mesh, subdomain_data=scene.tags)(TOP)
    )
    problem, _ = scene.problem(fc.Frictionless(k_n=k_n), scene.rollers())
    assert not problem.full.bulk.linear
    step = problem.solve(recover_interior=False)
    assert step.complete
    assert step.contacts["contact"].normal_force == pytest.approx(2.0, rel=1e-8)
