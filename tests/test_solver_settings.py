"""Laws, H₀, quadrature on Γc, several contacts and none, against references from statics."""

import numpy as np
import pytest
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from scenes.block_on_ball import PATH, BlockOnBall, solve_path
from scenes.blocks import BOTTOM, RIGHT, TOP, block
from scenes.comparison import gather, is_close, is_interpolant, nodal_values, owned_values

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(240)]
COMM = MPI.COMM_WORLD

# Solver tolerance for comparisons below the default of 1e-9 of the forces.
TIGHT = {"snes_rtol": 1e-13}


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_two_contacts_without_dirichlet_conditions_along_the_load(cell, method):
    """A block in a corner, pressed from two sides, has uniform stress.

    Reference: floor and wall carry the opposite loads, 2 and 1, with penetrations p/k_n. In 3D a
    Dirichlet condition constrains the third direction. Tolerance 1e-10, as in `test_patch`.
    """
    scene = block(cell, up=-2.0, nu=0.0)
    scene.add_traction(RIGHT, scene.vector(side=-1.0))
    wall = scene.wall(fc.Frictionless(k_n=500.0))
    floor = scene.contact(fc.Frictionless(k_n=5e3), name="floor")
    bcs = scene.rollers()[1:]
    problem = fc.ContactProblem(
        scene.F, scene.u, bcs=bcs, contacts=[wall, floor], method=method, petsc_options=TIGHT
    )
    step = problem.solve()
    assert step.contacts["floor"].normal_force == pytest.approx(2.0, rel=1e-10)
    assert step.contacts["wall"].normal_force == pytest.approx(1.0, rel=1e-10)

    def exact(x):
        rows = [0 * x[0] for _ in range(scene.dim)]
        rows[0] = -1.0 / 500 - 1.0 / 1000 * x[0]
        rows[-1] = -2.0 / 5e3 - 2.0 / 1000 * x[scene.dim - 1]
        return np.vstack(rows)

    assert is_interpolant(scene.u, exact, 1e-10)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_all_points_stick(method):
    """Solutions in which all points stick, with traction histories, are in equilibrium to 1e-8."""
    scene = block("quadrilateral", up=-1.0)
    problem, _ = scene.problem(fc.Coulomb(5.0, k_n=1e4, k_t=1e3), [], method=method)
    for side in (0.0, 0.1, 0.2, 0.15, 0.0):
        scene.load(side=side, up=-1.0)
        step = problem.solve()
        problem.commit()
        r = step.contacts["contact"]
        assert r.slip == 0 and r.stick > 0
        # Equilibrium, to ten times the tolerance of the solver.
        assert is_close(r.force, -scene.vector(side=side, up=-1.0), 1e-8)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_prescribed_normal_traction(cell, method):
    """Duvaut-Lions: Γc has the normal traction -p n and friction up to μ p, whatever the gap.

    The top is moved sideways far beyond the onset of slip; ν = 0, so that nothing slips before.
    Reference: N = p, T = μ p, uniform. Tolerance 1e-8, ten times that of the solver.
    """
    scene = block(cell, nu=0.0)
    slide = fem.Constant(scene.mesh, 0.0)
    bcs = [scene.dirichlet_bc(TOP, i, slide if i == 0 else 0.0) for i in range(scene.dim)]
    law = fc.Tresca(0.3, 4.0, k_t=1e4, unilateral=False)
    problem, contact = scene.problem(law, bcs, method=method, contact={"gap": 0.5})
    step = problem.solve()
    problem.commit()
    assert is_close(step.contacts["contact"].force, scene.vector(up=4.0), 1e-8)
    for side in (0.1, -0.1):
        slide.value = side
        r = problem.solve().contacts["contact"]
        problem.commit()
        assert r.normal_force == pytest.approx(4.0, rel=1e-8)
        assert r.tangential_force == pytest.approx(0.3 * 4.0, rel=1e-8)
        # Friction opposes the motion; in 3D slip directions vary a little with the mesh.
        against = scene.vector(side=-np.sign(side) * 1.2, up=4.0)
        assert is_close(r.force, against, 1e-8 if scene.dim == 2 else 2e-3)
    assert np.all(gather(COMM, contact.slip).sum(axis=1) > 0.1)


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_tresca_friction(cell):
    """Both methods agree for unilateral contact with a given friction bound, and T ≤ μ p A.

    Tolerance 1e-7 of the largest value, as for Coulomb's law.
    """
    fields = []
    for method in ("lbfgs", "newton"):
        law = fc.Tresca(0.3, 8.0, k_n=2e4, k_t=1e4)
        setup = BlockOnBall(
            law, cell=cell, method=method, mesh={"n": 4 if cell == "quadrilateral" else 2}
        )
        steps = solve_path(setup, path=PATH[:4])
        for step in steps:
            r = step.contacts["contact"]
            assert r.tangential_force <= 0.3 * 8.0 * (1 + 1e-10)
        fields.append(nodal_values(setup.scene.u))
    assert is_close(*fields, 1e-7)


@pytest.mark.parametrize(("alpha", "phi"), [(1.0, 0.0), (0.5, 0.5), (0.0, 0.0)])
def test_contact_stiffness_in_h0_does_not_change_the_solution(alpha, phi):
    """Solutions do not depend on the contact stiffness that H₀ contains, to 1e-7."""
    reference, setup = BlockOnBall(), BlockOnBall(alpha=alpha, phi=phi)
    for m in (reference, setup):
        solve_path(m, path=PATH[:4])
    a, b = (nodal_values(m.scene.u) for m in (setup, reference))
    assert is_close(a, b, 1e-7)


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron", "hexahedron"])
def test_patch_with_vertex_quadrature(cell):
    """Vertex quadrature (section 4) yields a uniform pressure to 1e-10.

    On facets of degree 1 the weights of a vertex sum to the integral of its hat function.
    """
    scene = block(cell, up=-2.0, surface={"quadrature_scheme": "vertex"})
    problem, contact = scene.problem(fc.Frictionless(k_n=5e3), scene.rollers(), petsc_options=TIGHT)
    step = problem.solve()
    assert step.contacts["contact"].normal_force == pytest.approx(2.0, rel=1e-10)
    pressure = gather(COMM, contact.pressure)
    assert is_close(pressure, np.full(len(pressure), 2.0), 1e-10)


def test_two_contact_laws_in_one_problem():
    """Forces of a floor with friction and a frictionless wall are in equilibrium to 1e-8.

    Wall and friction balance the side load 1, the floor the vertical load 2.
    """
    scene = block("quadrilateral", up=-2.0)
    scene.add_traction(RIGHT, scene.vector(side=-1.0))
    wall = scene.wall(fc.Frictionless(k_n=500.0))
    floor = scene.contact(fc.Coulomb(0.2, k_n=5e3, k_t=1e3), name="floor")
    problem = fc.ContactProblem(scene.F, scene.u, contacts=[wall, floor])
    contacts = problem.solve().contacts
    assert contacts["floor"].normal_force == pytest.approx(2.0, rel=1e-8)
    assert abs(contacts["floor"].force[0]) <= 0.4 * (1 + 1e-10)
    assert contacts["wall"].normal_force + contacts["floor"].force[0] == pytest.approx(
        1.0, rel=1e-8
    )
    assert 0.5 < contacts["wall"].normal_force < 1.0


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_no_force_remains_after_unloading(method):
    """Force and deformation of a block that only the floor supports vanish after unloading.

    The force is at most 1e-8; u minus its mean is at most 1e-7 of the displacement under load.
    """
    scene = block("quadrilateral", up=-1.0)
    problem, _ = scene.problem(fc.Frictionless(k_n=1e4), scene.rollers(), method=method)
    problem.solve()
    problem.commit()
    size = float(np.abs(gather(COMM, owned_values(scene.u))).max())
    scene.load(up=0.0)
    step = problem.solve()
    assert step.contacts["contact"].normal_force <= 1e-8
    u = gather(COMM, owned_values(scene.u)).reshape(-1, 2)
    strained = u - u.mean(axis=0)  # the block may be a little above the floor
    assert np.abs(strained).max() <= 1e-7 * size


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_problem_without_contacts_is_linear(method):
    """A block without contacts, under its load with ν = 0, has the exact u to 1e-9."""
    scene = block("quadrilateral", nu=0.0, up=-2.0)
    problem = fc.ContactProblem(
        scene.F, scene.u, bcs=[*scene.rollers(), scene.dirichlet_bc(BOTTOM, 1)], method=method
    )
    step = problem.solve()
    assert step.contacts == {} and step.factorisations <= 2
    assert is_interpolant(scene.u, lambda x: np.vstack([0 * x[0], -2e-3 * x[1]]), 1e-9)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_lifting_off_resets_friction(method):
    """A block lifted off the floor has no contact force and no tangential traction.

    Pressed again, it has the force of the first pressing to 1e-8: earlier tractions are forgotten.
    """
    scene = block("quadrilateral")
    push = [fem.Constant(scene.mesh, 0.0) for _ in range(2)]
    bcs = [scene.dirichlet_bc(TOP, i, c) for i, c in enumerate(push)]
    problem, contact = scene.problem(fc.Coulomb(0.3, k_n=1e4, k_t=5e3), bcs, method=method)
    forces = []
    # Down; sideways, slipping; up; back without contact; down again.
    for side, up in [(0, -0.01), (0.02, -0.01), (0.02, 0.01), (0, 0.01), (0, -0.01)]:
        push[0].value, push[1].value = side, up
        forces.append(problem.solve().contacts["contact"].force)
        problem.commit()
        if up > 0:
            assert np.all(forces[-1] == 0.0)
            assert np.all(gather(COMM, contact.tangential_traction) == 0.0)
    assert abs(forces[1][0]) > 0.1
    assert is_close(forces[-1], forces[0], 1e-8)
