"""Laws, shares of H₀, rules on Γc, several contacts and none: solved as statics has it."""

import numpy as np
import pytest
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from scenes.blocks import BOTTOM, RIGHT, TOP, block
from scenes.comparing import close, gathered, nodal, owned, same_field
from scenes.rubbing import PATH, Rub, walk

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(240)]
COMM = MPI.COMM_WORLD

# Solver tolerances for comparisons finer than the default of 1e-9 of the forces.
TIGHT = {"snes_rtol": 1e-13}


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_two_contacts_and_no_condition(cell, method):
    """A block in a corner, pressed from two sides and held by nothing else: uniform stress.

    Reference: each wall carries the load opposite to it, 2 and 1; penetrations by p/k_n. In space
    friction on the floor is what holds the third direction. Tolerances: 1e-10, as in `test_patch`.
    """
    scene = block(cell, up=-2.0, nu=0.0)
    scene.pull(RIGHT, scene.vector(side=-1.0))
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

    assert same_field(scene.u, exact, 1e-10)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_all_points_stick(method):
    """A scene that sticks everywhere, with a traction in its history, is a solution like others."""
    scene = block("quadrilateral", up=-1.0)
    problem, _ = scene.problem(fc.Coulomb(5.0, k_n=1e4, k_t=1e3), [], method=method)
    for side in (0.0, 0.1, 0.2, 0.15, 0.0):
        scene.load(side=side, up=-1.0)
        step = problem.solve()
        problem.commit()
        r = step.contacts["contact"]
        assert r.slip == 0 and r.stick > 0
        # Equilibrium; ten times the solver's tolerance.
        assert close(r.force, -scene.vector(side=side, up=-1.0), 1e-8)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_prescribed_normal_traction(cell, method):
    """Duvaut-Lions: the traction on Γc is -p n and friction up to μ p, whatever the gap.

    The top is held and moved aside far beyond sliding; ν = 0, so that nothing rubs before that.
    Reference: N = p, T = μ p exactly, uniform. Tolerance 1e-8, ten times the solver's.
    """
    scene = block(cell, nu=0.0)
    aside = fem.Constant(scene.mesh, 0.0)
    bcs = [scene.hold(TOP, i, aside if i == 0 else 0.0) for i in range(scene.dim)]
    law = fc.Tresca(0.3, 4.0, k_t=1e4, unilateral=False)
    problem, contact = scene.problem(law, bcs, method=method, contact={"gap": 0.5})
    step = problem.solve()
    problem.commit()
    assert close(step.contacts["contact"].force, scene.vector(up=4.0), 1e-8)
    for side in (0.1, -0.1):
        aside.value = side
        r = problem.solve().contacts["contact"]
        problem.commit()
        assert r.normal_force == pytest.approx(4.0, rel=1e-8)
        assert r.tangential_force == pytest.approx(0.3 * 4.0, rel=1e-8)
        # Against the motion; in space each point slides a little askew, as the mesh is.
        against = scene.vector(side=-np.sign(side) * 1.2, up=4.0)
        assert close(r.force, against, 1e-8 if scene.dim == 2 else 2e-3)
    assert np.all(gathered(COMM, contact.slip).sum(axis=1) > 0.1)


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_tresca_friction(cell):
    """Unilateral contact with a given friction limit: both methods agree, and T ≤ μ p A.

    1e-7 of the largest value, as for Coulomb's law.
    """
    fields = []
    for method in ("lbfgs", "newton"):
        law = fc.Tresca(0.3, 8.0, k_n=2e4, k_t=1e4)
        made = Rub(law, cell=cell, method=method, mesh={"n": 4 if cell == "quadrilateral" else 2})
        steps = walk(made, path=PATH[:4])
        for step in steps:
            r = step.contacts["contact"]
            assert r.tangential_force <= 0.3 * 8.0 * (1 + 1e-10)
        fields.append(nodal(made.scene.u))
    assert close(*fields, 1e-7)


@pytest.mark.parametrize(("alpha", "phi"), [(1.0, 0.0), (0.5, 0.5), (0.0, 0.0)])
def test_shares_of_h0_do_not_change_the_solution(alpha, phi):
    """Whatever part of the contact stiffness is in H₀, the state is the same: 1e-7, as above."""
    reference, made = Rub(), Rub(alpha=alpha, phi=phi)
    for m in (reference, made):
        walk(m, path=PATH[:4])
    a, b = (nodal(m.scene.u) for m in (made, reference))
    assert close(a, b, 1e-7)


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron", "hexahedron"])
def test_patch_with_vertex_quadrature(cell):
    """Contact springs at the vertices (section 4): they too carry a uniform pressure, 1e-10.

    On facets of degree 1 the springs of a vertex sum to the integral of its hat function.
    """
    scene = block(cell, up=-2.0, surface={"quadrature_scheme": "vertex"})
    problem, contact = scene.problem(fc.Frictionless(k_n=5e3), scene.rollers(), petsc_options=TIGHT)
    step = problem.solve()
    assert step.contacts["contact"].normal_force == pytest.approx(2.0, rel=1e-10)
    pressure = gathered(COMM, contact.pressure)
    assert close(pressure, np.full(len(pressure), 2.0), 1e-10)


def test_two_laws_at_once():
    """Friction on the floor, none at the wall: forces of each, by equilibrium, 1e-8.

    The side load 1 is shared by wall and friction; the floor carries the vertical load 2.
    """
    scene = block("quadrilateral", up=-2.0)
    scene.pull(RIGHT, scene.vector(side=-1.0))
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
def test_loaded_and_unloaded(method):
    """A block that only its floor holds, loaded and unloaded: no force is left, u returns to zero.

    1e-8 of the displacement under load: what a residual of 1e-9 of the largest force leaves.
    """
    scene = block("quadrilateral", up=-1.0)
    problem, _ = scene.problem(fc.Frictionless(k_n=1e4), scene.rollers(), method=method)
    problem.solve()
    problem.commit()
    size = float(np.abs(gathered(COMM, owned(scene.u))).max())
    scene.load(up=0.0)
    step = problem.solve()
    assert step.contacts["contact"].normal_force <= 1e-8
    u = gathered(COMM, owned(scene.u)).reshape(-1, 2)
    strained = u - u.mean(axis=0)  # free to stand a little above the floor
    assert np.abs(strained).max() <= 1e-7 * size


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_no_contact_at_all(method):
    """Without contacts it is a linear solver: a clamped block under its load, ν = 0; 1e-9."""
    scene = block("quadrilateral", nu=0.0, up=-2.0)
    problem = fc.ContactProblem(
        scene.F, scene.u, bcs=[*scene.rollers(), scene.hold(BOTTOM, 1)], method=method
    )
    step = problem.solve()
    assert step.contacts == {} and step.factorisations <= 2
    assert same_field(scene.u, lambda x: np.vstack([0 * x[0], -2e-3 * x[1]]), 1e-9)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_lifted_off(method):
    """A held block pressed and then lifted off its floor: no force, no traction, and pressed again.

    Reference of the second pressing: the first, as the traction of before is forgotten; 1e-8.
    """
    scene = block("quadrilateral")
    push = [fem.Constant(scene.mesh, 0.0) for _ in range(2)]
    bcs = [scene.hold(TOP, i, c) for i, c in enumerate(push)]
    problem, contact = scene.problem(fc.Coulomb(0.3, k_n=1e4, k_t=5e3), bcs, method=method)
    forces = []
    # Straight down; aside, sliding; up and back while in the air; straight down again.
    for side, up in [(0, -0.01), (0.02, -0.01), (0.02, 0.01), (0, 0.01), (0, -0.01)]:
        push[0].value, push[1].value = side, up
        forces.append(problem.solve().contacts["contact"].force)
        problem.commit()
        if up > 0:
            assert np.all(forces[-1] == 0.0)
            assert np.all(gathered(COMM, contact.tangential_traction) == 0.0)
    assert abs(forces[1][0]) > 0.1
    assert close(forces[-1], forces[0], 1e-8)
