"""Contact on the displacement of a mixed function: nearly and fully incompressible bodies."""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem
from petsc4py import PETSc

import fenics_contact as fc
from fenics_contact import compat
from fenics_contact.compiling import compile_form
from fenics_contact.elasticity import NeoHookean
from fenics_contact.parallel import global_max
from scenes.blocks import BOTTOM, TOP, rough_field
from scenes.comparison import (
    assemble_matrix,
    assemble_owned,
    compile_with_maps,
    is_close,
    owned_values,
    point_values,
    set_owned,
    shared_folder,
)
from scenes.histories import assert_restart_equals_uninterrupted
from scenes.rubber import MIXED, TIGHT_TOLERANCE, DiscOnRubber, disc, rubber, split

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(300)]

# Nearly incompressible, incompressible, then linear at small strains.
VARIANTS = {
    "Taylor-Hood": {"mixed": "Taylor-Hood", "nu": 0.4999},
    "MINI": {"mixed": "MINI", "nu": 0.5},
    "isochoric": {"mixed": "Taylor-Hood", "nu": 0.5, "isochoric": True},
    "by force": {"mixed": "Taylor-Hood", "nu": 0.5, "by_force": True},
    "augmented": {"mixed": "MINI", "nu": 0.4999, "contact": {"enforcement": "augmented"}},
    "linear": {
        "mixed": "Taylor-Hood",
        "nu": 0.5,
        "linear": True,
        "solver": {"small_displacement_tolerance": np.inf},
    },
}


def tool(variant: str, cell: str = "triangle", **options) -> DiscOnRubber:
    """Return a coarse block under a disc that presses, drags and rotates."""
    n = {"n": (8, 4)} if cell == "triangle" else {"n": (3, 2)}
    return DiscOnRubber(cell, **n, **VARIANTS[variant], **options)


# ---- whole histories -----------------------------------------------------------------------------


@pytest.mark.each
@pytest.mark.parametrize("variant", VARIANTS)
def test_history_is_verified_and_balances(variant):
    """All verdicts of a tool pressed, dragged, moved back and rotated pass, with cross-checks.

    The reactions of the bottom, assembled here, balance the contact force to 1e-10.
    """
    solver = {"cross_check": True} | VARIANTS[variant].get("solver", {})
    setup = DiscOnRubber(
        "triangle",
        n=(8, 4),
        **{**VARIANTS[variant], "solver": {"petsc_options": TIGHT_TOLERANCE, **solver}},
    )
    scene, problem = setup.scene, setup.problem
    form, part = compile_with_maps(scene.F), problem.displacement
    bottom_value = fem.Function(part.u.function_space)
    for step in setup.increments():
        assert not step.verdict.failures and step.verdict.cross_check
        forces = assemble_owned(form, scene.u.function_space)
        forces[~problem.full.constrained[: forces.size]] = 0.0
        reaction = np.zeros(scene.dim)
        for i in range(scene.dim):
            bottom_value.x.array[:] = 0.0
            bottom_value.x.array[i :: scene.dim] = 1.0
            reaction[i] = scene.mesh.comm.allreduce(
                part.within(owned_values(bottom_value)) @ forces
            )
        assert is_close(-reaction, setup.resultant(), 1e-10)
    assert np.abs(setup.resultant()).min() > 0.1


@pytest.mark.each
@pytest.mark.parametrize("variant", ["Taylor-Hood", "MINI", "by force", "augmented", "linear"])
def test_restart_from_a_checkpoint(variant, tmp_path):
    """A history restarted while the tool rotates is the same, bitwise on one rank, 1e-7 on more."""
    assert_restart_equals_uninterrupted(lambda: tool(variant), shared_folder(tmp_path), stop=5)


@pytest.mark.parametrize("variant", ["Taylor-Hood", "linear"])
def test_lbfgs_agrees_with_newton(variant):
    """L-BFGS with the factored saddle point as H₀ needs no minimum: tractions of Newton, 1e-7."""
    computed = []
    for method in ("newton", "lbfgs"):
        solver = VARIANTS[variant].get("solver", {}) | {"method": method, "fallback": False}
        setup = DiscOnRubber("triangle", n=(8, 4), **{**VARIANTS[variant], "solver": solver})
        for step in setup.increments(2.0, steps=8, max_cuts=0):
            assert step.method == method
        computed.append(setup.tractions())
    assert np.abs(computed[0]).max() > 10.0
    assert is_close(computed[1], computed[0], 1e-7)


def test_tetrahedra_are_verified():
    """Verdicts pass for incompressible tetrahedra pressed and dragged with friction."""
    for variant in ("Taylor-Hood", "MINI"):
        setup = tool(variant, "tetrahedron")
        for step in setup.increments(1.5):
            assert not step.verdict.failures
        assert setup.resultant()[-1] < -1.0


def test_first_touch_with_cut_increments():
    """A distant disc is lowered in one increment, cut if needed: tractions of 10 increments, 1e-7.

    Without friction the solution is unique.
    """
    ends = []
    for steps in (1, 10):
        setup = DiscOnRubber("triangle", n=(8, 4), law=fc.Frictionless(1e4), **VARIANTS["MINI"])

        def load(t, setup=setup):
            setup.shift.value[:] = setup.vector(0.1, 0.5 - 0.8 * t)

        *_, last = fc.increments(setup.problem, load, 0.0, 1.0, steps=steps)
        assert last.increment >= steps
        ends.append(setup.tractions())
    assert np.abs(ends[1]).max() > 100.0
    assert is_close(ends[0], ends[1], 1e-7)


def test_contact_form_in_a_user_written_block_newton_method():
    """Displacement and pressure as two functions, in blocks: tractions of the mixed one, 1e-9.

    A disc presses a block with ν = 1/2 and drags it, in two increments. Newton's method solves
    F + contact.form(v) for functions of two spaces.
    """
    one = tool("isochoric", law=fc.Coulomb(0.3, 1e3, 1e3))
    mesh, tags, d = one.scene.mesh, one.scene.tags, one.scene.dim
    V = fem.functionspace(mesh, ("Lagrange", 2, (d,)))
    Q = fem.functionspace(mesh, ("Lagrange", 1))
    u, p, both = fem.Function(V), fem.Function(Q), ufl.MixedFunctionSpace(V, Q)
    (v, q), (du, dp) = ufl.TestFunctions(both), ufl.TrialFunctions(both)
    shift, angle = fem.Constant(mesh, np.zeros(d)), fem.Constant(mesh, 0.0)
    contact = fc.Contact(
        u,
        fc.ContactSurface(mesh, tags, TOP),
        disc(one.scene, 0.8, displacement=shift, angle=angle),
        one.contact.law,
        kinematics="finite",
    )
    body = NeoHookean(u, 1000.0, 0.5, "plane strain", isochoric=True, pressure=p)
    bulk = body.residual(v, q=q)
    residual = bulk + contact.form(v)
    tangent = ufl.derivative(bulk, u, du) + ufl.derivative(bulk, p, dp) + contact.tangent(v, du)
    forms = [compile_with_maps(part, contact) for part in ufl.extract_blocks(residual)]
    blocks = [[compile_with_maps(b, contact) for b in row] for row in ufl.extract_blocks(tangent)]
    dofs = fem.locate_dofs_topological(V, tags.dim, tags.find(BOTTOM))
    constrained, n_held = fem.dirichletbc(np.zeros(d), dofs, V).dof_indices()
    constrained = constrained[:n_held]
    solver = PETSc.KSP().create(mesh.comm)
    solver.setType("preonly")
    solver.getPC().setType("lu")
    solver.getPC().setFactorSolverType("mumps")
    for side, up in ((0.0, -0.03), (0.005, -0.035)):
        shift.value[:] = side, up
        size = 0.0
        for _ in range(30):
            A = PETSc.Mat().createNest([[assemble_matrix(b) for b in row] for row in blocks])
            A.convert("aij")
            A.zeroRows((A.getOwnershipRange()[0] + constrained).astype(PETSc.IntType), 1.0)
            b, step = A.createVecLeft(), A.createVecRight()
            forces, excess = assemble_owned(forms[0], V), assemble_owned(forms[1], Q)
            forces[constrained] = 0.0
            b.array[:] = np.concatenate([forces, excess])
            solver.setOperators(A)
            solver.solve(b, step)
            set_owned(u, owned_values(u) - step.array_r[: forces.size])
            set_owned(p, owned_values(p) - step.array_r[forces.size :])
            size = max(size, step.norm())
            if step.norm() < 1e-11 * size:
                break
        else:
            pytest.fail("Newton's method written here has not converged")
        contact.commit()
        one.solve_increment(side, up)
    assert np.abs(one.tractions()).max() > 10.0
    assert is_close(point_values(contact, contact.traction), one.tractions(), 1e-9)


# ---- single states -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MIXED)
@pytest.mark.parametrize("kinematics", ["small", "finite"])
def test_tangent_and_boundary_form_of_mixed_functions(name, kinematics):
    """With mixed dofs: tangent by differences, 1e-6; form and tangent by DOLFINx, 1e-11.

    Points of the state stick, slip and are open.
    """
    scene = rubber("triangle", n=(8, 4), mixed=name, nu=0.5)
    W, comm = scene.u.function_space, scene.mesh.comm
    obstacle = disc(scene, 0.8, displacement=(0.03, -0.1))
    contact = scene.contact(obstacle, fc.Coulomb(0.3, 1e3, 1e3), kinematics=kinematics)
    operator = fc.ContactOperator(contact)
    start, direction = (fem.Function(W) for _ in range(2))
    for function, seed, size in ((start, 0, 0.03), (direction, 1, 1.0)):
        function.sub(0).interpolate(lambda x, s=seed, a=size: a * rough_field(2, s)(x))

    def force(step):
        scene.u.x.array[:] = start.x.array + step * direction.x.array
        vector = operator.unknowns.vector()
        operator.add_force(vector)
        return vector.array_r.copy()

    difference = (force(1e-6) - force(-1e-6)) / 2e-6
    forces = force(0.0)
    tangent = operator.tangent()
    product = tangent.createVecLeft()
    tangent.mult(direction.x.petsc_vec, product)
    size = global_max(comm, np.abs(difference))
    assert size > 1.0
    assert global_max(comm, np.abs(product.array_r - difference)) < 1e-6 * size
    v, dw = split(ufl.TestFunctions(W))[0], ufl.TrialFunction(W)
    assembled = assemble_owned(compile_with_maps(contact.form(v), contact), W)
    assert global_max(comm, np.abs(assembled - forces)) < 1e-11 * global_max(comm, np.abs(forces))
    from_form = assemble_matrix(compile_with_maps(contact.tangent(v, dw), contact))
    other = from_form.createVecLeft()
    from_form.mult(direction.x.petsc_vec, other)
    assert global_max(comm, np.abs(other.array_r - product.array_r)) < 1e-11 * size
    contact.evaluate()
    r = contact.resultants()
    assert min(r.open, r.stick, r.slip) > 0


@pytest.mark.parametrize("variant", ["Taylor-Hood", "linear"])
def test_units_do_not_matter(variant):
    """A block in mm and MPa, and in m and GPa, has the same iterations, and tractions to 1e-9."""
    computed = []
    for length, stress in ((1.0, 1.0), (1e-3, 1e-3)):
        scene = rubber(
            "triangle",
            n=(8, 4),
            size=(2.0 * length, length),
            E=1e3 * stress,
            **{k: v for k, v in VARIANTS[variant].items() if k != "solver"},
        )
        shift = fem.Constant(scene.mesh, np.zeros(2))
        law = fc.Coulomb(0.3, 1e4 * stress / length, 1e4 * stress / length)
        problem, contact = scene.problem(
            disc(scene, 0.8 * length, displacement=shift), law, small_displacement_tolerance=np.inf
        )
        iterations = []
        for displacement in ((0.0, -0.05), (0.02, -0.1), (0.05, -0.1)):
            shift.value[:] = np.array(displacement) * length
            iterations.append(problem.solve().iterations)
            problem.commit()
        computed.append((iterations, point_values(contact, contact.traction) / stress))
    assert computed[0][0] == computed[1][0]
    assert np.abs(computed[0][1]).max() > 10.0
    assert is_close(computed[1][1], computed[0][1], 1e-9)


def test_cells_inverted_by_bubbles_are_detected():
    """The check of det(I + grad u) includes bubbles: they alone invert cells if large enough."""
    scene = rubber("triangle", n=(4, 2), mixed="MINI", nu=0.5)
    problem, _ = scene.problem(disc(scene, 0.8), fc.Frictionless(1e4))
    _, bubbles = compat.collapsed(scene.u.function_space.sub(1))
    for size, inverted in ((1e-3, False), (1.0, True)):
        scene.u.x.array[:] = 0.0
        scene.u.x.array[bubbles] = size
        assert problem.full.bulk.is_inverted() is inverted


def test_unit_of_pressure_dofs_scales_their_equations_to_forces():
    """The unit of pressures is E/h, of displacements and bubbles 1, each to a factor of 2.5.

    The residual of the problem is the assembled one times these units, to 1e-12 E.
    """
    E = 1e3
    for name in MIXED:
        scene = rubber("triangle", n=(8, 4), mixed=name, nu=0.4999, E=E)
        problem, _ = scene.problem(disc(scene, 0.8), fc.Frictionless(1e4))
        units, parts = problem.full.bulk.units, [problem.displacement.dofs]
        parts += [dofs for _, dofs in problem.displacement.others]
        for dofs, expected in zip(parts, [1.0, *[1.0] * (len(parts) - 2), 4 * E], strict=True):
            for unit in np.unique(units[dofs]):
                assert expected / 2.5 <= unit <= 2.5 * expected, (name, expected)
        owned_values(scene.u)[:] = 1e-3 * np.cos(np.arange(problem.full.unknowns.n_dofs) ** 2.0)
        scene.u.x.scatter_forward()
        raw = assemble_owned(compile_with_maps(scene.F), scene.u.function_space)
        expected = raw * units[: raw.size]
        assert np.abs(problem.full.bulk.assemble_residual() - expected).max(initial=0.0) < 1e-12 * E


def test_pressure_changes_are_not_displacements_of_bodies():
    """The displacement of a body does not include its pressure dofs."""
    scene = rubber("triangle", n=(4, 2), mixed="Taylor-Hood", nu=0.5)
    problem, _ = scene.problem(disc(scene, 0.8), fc.Frictionless(1e4))
    full, ((_, pressures),) = problem.full, problem.displacement.others
    for dofs, expected in ((pressures, 0.0), (problem.displacement.dofs, 2.0)):
        scene.u.x.array[dofs] = -2.0
        assert full.scales.largest(full.state()).tolist() == [expected]


def test_contact_stiffness_follows_the_shear_modulus():
    """E of a mixed form is 3 G, that of an incompressible body, for every ν, to 1e-9."""
    for nu in (0.3, 0.5):
        scene = rubber("triangle", n=(4, 2), mixed="Taylor-Hood", nu=nu, E=1e3)
        problem, contact = scene.problem(disc(scene, 0.8), fc.Frictionless())
        k_n, h = contact.values.parameters["k_n"], 0.5
        assert problem.full.bulk.displacement.is_mixed
        assert is_close(k_n, np.full_like(k_n, 10 * 3 * 1e3 / (2 * (1 + nu)) / h), 1e-9)


def test_problem_without_contacts_finds_its_displacement_field():
    """The only vector part is the displacement: a block with ν = 1/2 keeps its volume, to 1e-6."""
    scene = rubber("triangle", n=(6, 3), mixed="Taylor-Hood", nu=0.5)
    W = scene.u.function_space
    top = fem.Function(W.sub(0).collapse()[0])
    top.interpolate(lambda x: np.vstack([0 * x[0], np.full_like(x[0], -0.1)]))
    dofs = fem.locate_dofs_topological((W.sub(0), top.function_space), 1, scene.tags.find(TOP))
    bcs = [*scene.bcs, fem.dirichletbc(top, dofs, W.sub(0))]
    problem = fc.ContactProblem(scene.F, scene.u, bcs=bcs)
    problem.solve()
    volume = compile_form(scene.body.J * ufl.dx(scene.mesh))
    computed = scene.mesh.comm.allreduce(fem.assemble_scalar(volume))
    assert computed == pytest.approx(2.0, rel=1e-6)
    assert problem.displacement.u.x.array.size == top.x.array.size
    assert global_max(scene.mesh.comm, np.abs(problem.displacement.u.x.array)) > 0.1
