"""Contact springs of node pairs, elastic foundations, and anisotropic friction of whole bodies."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from fenics_contact.checks.verdict import check_laws
from scenes.blocks import BOTTOM, CELLS, LEFT, TOP, block, block_mesh, dimension
from scenes.comparison import assert_raised_on_all_ranks, gather, is_close, nodal_values
from scenes.elasticity import displacement_space, strain, stress
from scenes.tags import tag_by_nodes
from scenes.two_blocks import LOWER_FACE, UPPER_FACE, two_blocks

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]
COMM = MPI.COMM_WORLD

VERTEX = {"quadrature_scheme": "vertex"}
K_N, K_T = 7.0, 3.0
TIGHT = {"snes_rtol": 1e-13}


def rotate(d: int) -> np.ndarray:
    """Return a rotation matrix that changes the direction of every axis."""
    angle = 0.7
    c, s = np.cos(angle), np.sin(angle)
    plane = np.array([[c, -s], [s, c]])
    if d == 2:
        return plane
    one, other = np.eye(3), np.eye(3)
    one[np.ix_([0, 2], [0, 2])] = plane
    other[np.ix_([1, 2], [1, 2])] = plane
    return one @ other


def dense(matrix: PETSc.Mat, d: int) -> np.ndarray:
    """Return a matrix on every rank, shape (n_nodes, n_nodes, d, d), and destroy the original."""
    start, _ = matrix.getOwnershipRange()
    indptr, columns, values = matrix.getValuesCSR()
    rows = start + np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))
    n = matrix.getSize()[0]
    matrix.destroy()
    full = np.zeros((n, n))
    for i, j, a in zip(*(gather(COMM, x) for x in (rows, columns, values)), strict=True):
        full[i, j] += a
    return full.reshape(n // d, d, n // d, d).transpose(0, 2, 1, 3)


def nodes(space: fem.FunctionSpace) -> np.ndarray:
    """Return the coordinates of all nodes in the global order, on every rank."""
    n = space.dofmap.index_map.size_local
    return gather(COMM, space.tabulate_dof_coordinates()[:n, : space.mesh.geometry.dim])


@pytest.mark.parametrize("weight", ["none", "varying"])
@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize("cell", CELLS)
def test_springs_of_an_inclined_surface(cell, n, weight):
    """Every vertex of Γc has K_n = k_n n⊗n and K_t = k_t (1 - n⊗n); all other entries are zero.

    Section 4; on one inclined facet (n = 1) and on facets of different sizes around a vertex, with
    and without the contact's weight. Tolerance 1e-13, round-off.
    """
    d = dimension(cell)
    mesh, tags = block_mesh(cell, n=n, shuffled=True)
    q = rotate(d)
    space = displacement_space(mesh, 1)
    on_surface = np.abs(nodes(space)[:, -1]) < 1e-12
    mesh.geometry.x[:, :d] = mesh.geometry.x[:, :d] @ q.T
    normal = -q[:, -1]
    along = np.outer(normal, normal)
    u = fem.Function(space)
    x = ufl.SpatialCoordinate(mesh)
    contact = fc.Contact(
        u,
        fc.ContactSurface(mesh, tags, BOTTOM, **VERTEX),
        fc.PrescribedGap(0.1, normal),
        fc.Coulomb(0.3, k_n=fc.NodalSprings(K_N), k_t=fc.NodalSprings(K_T)),
        weight=None if weight == "none" else 3.0 + x[0] * x[1],
    )
    for factors, block_of_node in (((1, 0), K_N * along), ((0, 1), K_T * (np.eye(d) - along))):
        matrix = dense(fc.ContactOperator(contact).springs(contact.values.springs(*factors)), d)
        expected = np.zeros_like(matrix)
        for node in np.flatnonzero(on_surface):
            expected[node, node] = block_of_node
        assert is_close(matrix, expected, 1e-13)
    assert np.count_nonzero(on_surface) == (n + 1) ** (d - 1)
    # A uniform penetration of 0.2 causes a force of 0.2 k_n at every node.
    u.x.array[:] = np.tile(0.3 * normal, u.x.array.size // d)
    force = fem.Function(space)
    fc.ContactOperator(contact).add_force(force.x.petsc_vec)
    n_owned = space.dofmap.index_map.size_local
    force = gather(COMM, force.x.array.reshape(-1, d)[:n_owned])
    assert is_close(force, np.outer(on_surface, 0.2 * K_N * normal), 1e-12)


@pytest.mark.parametrize("cell", CELLS)
def test_springs_between_two_bodies(cell):
    """Opposite nodes have the springs k_n [[nn, -nn], [-nn, nn]] and k_t with 1 - n⊗n.

    Section 4, on an inclined interface. Tolerance 1e-9 of k, that of the coordinates in pairing.
    """
    d = dimension(cell)
    mesh, tags = two_blocks(cell, (2, 2))
    q = rotate(d)
    space = displacement_space(mesh, 1)
    middle = np.flatnonzero(np.abs(nodes(space)[:, -1] - 0.5) < 1e-12)
    mesh.geometry.x[:, :d] = mesh.geometry.x[:, :d] @ q.T
    x = nodes(space)
    contact = fc.Contact(
        fem.Function(space),
        fc.ContactSurface(mesh, tags, LOWER_FACE, **VERTEX),
        fc.DeformableBody(tags, UPPER_FACE),
        fc.Coulomb(0.3, k_n=fc.NodalSprings(K_N), k_t=fc.NodalSprings(K_T)),
    )
    assert contact.pairs.n_unpaired == 0
    along = np.outer(q[:, -1], q[:, -1])
    for factors, block_of_pair in (((1, 0), K_N * along), ((0, 1), K_T * (np.eye(d) - along))):
        matrix = dense(fc.ContactOperator(contact).springs(contact.values.springs(*factors)), d)
        expected = np.zeros_like(matrix)
        for i in middle:
            (j,) = (j for j in middle if j != i and np.allclose(x[i], x[j], atol=1e-12))
            expected[i, i] = block_of_pair
            expected[i, j] = -block_of_pair
        assert is_close(matrix, expected, 1e-9)
    assert len(middle) == 2 * 3 ** (d - 1)


def test_springs_use_the_present_parameters():
    """Springs use the present k for any weight; `check_input` refuses the weight 0."""
    mesh, tags = block_mesh("quadrilateral")
    u = fem.Function(displacement_space(mesh, 1))
    surface = fc.ContactSurface(mesh, tags, BOTTOM, **VERTEX)
    law = fc.Frictionless(fc.NodalSprings(K_N))
    contact = fc.Contact(u, surface, fc.HalfSpace((0, 0), (0, 1)), law, weight=2.0)
    contact.parameters["k_n"].value = 5.0
    contact.parameters["weight"].value = 11.0
    contact.check_input()
    matrix = dense(fc.ContactOperator(contact).springs(contact.values.springs(1, 0)), 2)
    assert np.count_nonzero(np.abs(matrix) > 1e-13) == 3
    assert matrix.max() == pytest.approx(5.0, rel=1e-13)
    contact.parameters["weight"].value = 0.0
    assert_raised_on_all_ranks(
        contact.check_input, ValueError, "contact", "area of a vertex", "weight"
    )


def test_nodal_springs_require_vertex_quadrature_and_positive_k():
    """`NodalSprings` are refused without vertex quadrature, or if k is not a positive number."""
    scene = block()
    for law in (fc.Frictionless(fc.NodalSprings(1.0)), fc.Coulomb(0.3, k_t=fc.NodalSprings(1.0))):
        assert_raised_on_all_ranks(
            lambda law=law: scene.contact(law), ValueError, "contact", "'default'", "vertex"
        )
    for value in (0.0, -1.0, np.nan, np.inf, "stiff", None):
        assert_raised_on_all_ranks(
            lambda value=value: fc.NodalSprings(value), ValueError, repr(value), "greater than zero"
        )


# ---- springs in the bulk form --------------------------------------------------------------------


@pytest.mark.parametrize("bulk", ["linear", "rubber"])
def test_bulk_spring_added_later_constrains_the_body(bulk):
    """A spring in F has zero stiffness in the first and third increment, and 100 in the second.

    Reference: the tangential load of 0.5 is balanced by friction, at most 0.3, and the spring, to
    1e-7; without the spring the solve is refused. Once a rigid-body mode stayed unconstrained
    after the first increment: "no contact force can balance".
    """
    scene = block("quadrilateral", E=1e3, up=-1.0)
    u, v, k = scene.u, scene.F.arguments()[0], fem.Constant(scene.mesh, 0.0)
    if bulk == "rubber":
        linear = ufl.inner(stress(u, scene.E, scene.nu), strain(v)) * ufl.dx(scene.mesh)
        rubber = fc.elasticity.NeoHookean(u, scene.E, scene.nu, "plane strain")
        scene.F += rubber.residual(v) - linear
    side = ufl.ds(scene.mesh, subdomain_data=scene.tags)(LEFT)
    scene.F += k * u[0] * v[0] * side
    problem, contact = scene.problem(fc.Coulomb(0.3), [])
    problem.solve()
    problem.commit()
    k.value = 100.0
    scene.load(up=-1.0, side=0.5)
    problem.solve()
    problem.commit()
    stretched = COMM.allreduce(fem.assemble_scalar(fem.form(k * u[0] * side)))
    assert is_close(contact.resultants().force[0] + 0.5, stretched, 1e-7)
    assert stretched > 0.19
    k.value = 0.0
    assert_raised_on_all_ranks(problem.solve, (ValueError, fc.NotConverged))


# ---- foundations ---------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize("cell", CELLS)
def test_block_on_foundation(cell, method):
    """A block constrained only by a foundation is pressed, pulled tangentially and lifted.

    Reference: equilibrium. The mean jump of the bottom is force/(area k), in both directions, and
    the contact force is minus the load. Tolerance 1e-7, a hundred times the solver's on forces.
    """
    scene = block(cell)
    problem, contact = scene.problem(fc.Foundation(50.0, 20.0), [], method=method)
    for side, up in ((0.0, -2.0), (0.5, -1.0), (0.5, 1.5), (0.0, 0.0)):
        scene.load(side=side, up=up)
        step = problem.solve()
        problem.commit()
        computed = step.contacts["contact"]
        assert is_close(computed.force, -scene.vector(side=side, up=up), 1e-7, scale=1.0)
        assert computed.normal_force == pytest.approx(-up, abs=1e-7)
        jump = gather(COMM, contact.values.jump)
        measure = gather(COMM, contact.measure)
        expected = scene.vector(side=side / 20.0, up=up / 50.0)
        assert is_close(measure @ jump, expected, 1e-7, scale=0.02)
        assert computed.open == computed.slip == 0 and computed.area == pytest.approx(
            1.0, rel=1e-12
        )
        assert set(step.verdict.laws["contact"]) == {"stiffness"}
        assert step.verdict.laws["contact"]["stiffness"] <= 1e-10


def test_foundation_without_tension():
    """A foundation without tension balances pressure and sticks; a lifting load is refused.

    Tolerance 1e-7, a hundred times the solver's on forces.
    """
    scene = block("quadrilateral", up=-2.0)
    law = fc.Foundation(50.0, 20.0, tension=False)
    problem, contact = scene.problem(law, [scene.dirichlet_bc(LEFT, 0)])
    step = problem.solve()
    assert step.contacts["contact"].normal_force == pytest.approx(2.0, abs=1e-7)
    assert set(step.verdict.laws["contact"]) == {"complementarity", "stiffness"}
    assert max(step.verdict.laws["contact"].values()) <= 1e-10
    assert np.all(gather(COMM, contact.status) == fc.Status.STICK)
    scene.load(up=0.5)
    assert_raised_on_all_ranks(problem.solve, ValueError, "balance")


def test_foundation_without_tangential_stiffness_has_no_slip_history():
    """With k_t = 0 there are no tangential tractions or history, nor is the body constrained."""
    scene = block("quadrilateral", up=0.5)
    assert_raised_on_all_ranks(
        lambda: scene.problem(fc.Foundation(50.0), []), ValueError, "translation along x"
    )
    problem, contact = scene.problem(fc.Foundation(50.0), [scene.dirichlet_bc(LEFT, 0)])
    step = problem.solve()
    assert step.contacts["contact"].normal_force == pytest.approx(-0.5, abs=1e-7)
    assert np.all(gather(COMM, contact.status) == fc.Status.SLIP)
    assert "traction" not in contact.history and "traction" not in contact.values.arrays
    assert not np.any(gather(COMM, contact.tangential_traction))


@pytest.mark.parametrize("tension", [True, False])
def test_foundation_on_half_of_the_surface(tension):
    """Zero stiffness by UFL on half of Γc gives the solution of Γc without that half, to 1e-8."""
    computed = []
    for everywhere in (True, False):
        scene = block("quadrilateral", n=4, up=-2.0)
        law = fc.Foundation(50.0, 20.0, tension=tension)
        if everywhere:
            x = ufl.SpatialCoordinate(scene.mesh)
            k_n, k_t = (ufl.conditional(ufl.lt(x[0], 0.5), k, 0.0) for k in (50.0, 20.0))
            law = fc.Foundation(k_n, k_t, tension=tension)
        else:
            left = {1: lambda x: np.isclose(x[1], 0.0) & (x[0] < 0.5 + 1e-9)}
            scene.surface = fc.ContactSurface(scene.mesh, tag_by_nodes(scene.mesh, left), 1)
        problem, _ = scene.problem(law, [scene.dirichlet_bc(LEFT, 0)], petsc_options=TIGHT)
        step = problem.solve()
        assert max(step.verdict.laws["contact"].values()) <= 1e-10
        force = step.contacts["contact"]
        computed.append((nodal_values(scene.u), np.append(force.force, force.max_pressure)))
    for one, other in zip(*computed, strict=True):
        assert is_close(one, other, 1e-8)


@pytest.mark.parametrize("tension", [True, False])
@pytest.mark.parametrize("constant", [False, True])
def test_foundation_of_zero_stiffness(tension, constant):
    """A foundation of zero stiffness, a number or a constant, has no force and no constraint.

    Reference: an unloaded block fixed at its top has u = 0 exactly. A vertical load on a block
    with no other vertical constraint is refused.
    """
    scene = block("quadrilateral")
    k = fem.Constant(scene.mesh, 0.0) if constant else 0.0
    bcs = [scene.dirichlet_bc(TOP, i) for i in range(2)]
    problem, _ = scene.problem(fc.Foundation(k, tension=tension), bcs)
    step = problem.solve()
    assert step.contacts["contact"].normal_force == 0.0
    assert not np.any(gather(COMM, scene.u.x.array))
    problem, _ = scene.problem(fc.Foundation(k, tension=tension), [scene.dirichlet_bc(LEFT, 0)])
    scene.load(up=-1.0)
    assert_raised_on_all_ranks(problem.solve, ValueError, "no contact force can balance", "along y")
    if constant:  # solvable with a positive stiffness
        k.value = 50.0
        assert problem.solve().contacts["contact"].normal_force == pytest.approx(1.0, abs=1e-7)


@pytest.mark.parametrize("traction_part", ["pull", "normal", "tangential"])
def test_verdict_rejects_wrong_foundation_tractions(traction_part):
    """The verdict rejects tractions that differ from those of the foundation's stiffness."""

    class Changed(fc.Foundation):
        """A foundation with one traction 1 % wrong, or without tension."""

        def parameters(self):
            """Return the stiffnesses of the foundation."""
            return {"k_n": 50.0, "k_t": 20.0}

        def contact_traction(self, kinematics, parameters):
            """Return the tractions of the foundation, modified."""
            r = super().contact_traction(kinematics, parameters)
            r_n, tau = r.normal_traction, r.traction
            if traction_part == "pull":
                r_n = ufl.min_value(r_n, 0.0)
            return fc.ContactTraction(
                1.01 * r_n if traction_part == "normal" else r_n,
                1.01 * tau if traction_part == "tangential" else tau,
            )

    scene = block("quadrilateral")
    contact = scene.contact(Changed(50.0, 20.0))
    scene.u.interpolate(lambda x: np.vstack([0.02 + 0 * x[0], 0.01 * (x[0] - 0.4)]))
    contact.evaluate()
    assert check_laws(contact)["stiffness"] > 1e-4
    sound = scene.contact(fc.Foundation(50.0, 20.0))
    sound.evaluate()
    assert check_laws(sound)["stiffness"] <= 1e-14


# ---- anisotropic friction ------------------------------------------------------------------------

ALONG = np.array([np.cos(0.5), np.sin(0.5)])
SLIDING = {
    # All slip is along e: τ is the point of the ellipse with the normal -e, a vertex of a polygon.
    "ellipse": (
        {"transverse_friction": 0.1, "direction": (1.0, 0.0, 5.0)},
        np.array([0.3, 0.1]) ** 2 * ALONG / np.linalg.norm(np.array([0.3, 0.1]) * ALONG),
    ),
    "square": ({"modes": 4, "direction": (1.0, 0.0, 5.0)}, np.array([0.3, 0.3])),
    "octagon": (
        {"modes": 8},
        0.3 / np.cos(np.pi / 8) * np.array([np.cos(np.pi / 8), np.sin(np.pi / 8)]),
    ),
}


@pytest.mark.each
@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize("kind", SLIDING)
@pytest.mark.parametrize("cell", ["tetrahedron", "hexahedron"])
def test_sliding_direction_of_anisotropic_friction(cell, kind, method):
    """A sliding block with anisotropic friction has a friction force not opposite to its motion.

    Reference: when all closed points slip, τ = -p times the point of the friction surface (for
    p = 1) whose normal is the direction of the motion, and so is the ratio of the forces. Tolerance
    1e-6: the elastic part is 1 % of an increment, and the error of the direction decreases by this
    factor in each of five increments.
    """
    options, expected = SLIDING[kind]
    scene = block(cell)
    push = [fem.Constant(scene.mesh, 0.0) for _ in range(3)]
    bcs = [scene.dirichlet_bc(TOP, i, c) for i, c in enumerate(push)]
    law = fc.Coulomb(0.3, k_n=2e4, k_t=1e4, **options)
    problem, _ = scene.problem(law, bcs, method=method)
    for number in range(5):
        push[0].value, push[1].value = 0.1 * (number + 1) * ALONG
        push[2].value = -0.01
        step = problem.solve()
        problem.commit()
    computed = step.contacts["contact"]
    assert computed.slip > 0 and computed.stick == 0
    assert is_close(computed.force[:2] / computed.normal_force, -expected, 1e-6)
    assert {"cone", "slip", "dissipation"} <= set(step.verdict.laws["contact"])


@pytest.mark.whole
@pytest.mark.parametrize(
    ("traction_part", "claim"),
    [("nothing", ""), ("metric", "slip"), ("friction", "cone"), ("modes", "dissipation")],
)
def test_verdict_rejects_wrong_anisotropic_law(traction_part, claim):
    """The verdict rejects tractions and slip of another friction surface or metric."""
    options = {"modes": 5} if traction_part == "modes" else {"transverse_friction": 0.1}

    class Changed(fc.Coulomb):
        """A law whose return map differs from its parameters or yield functions."""

        def parameters(self):
            """Return the parameters of Coulomb's law with the options of this test."""
            return fc.Coulomb(
                self.friction, self.k_n, self.k_t, direction=self.direction, **options
            ).parameters()

        def tangential_stiffness(self, kinematics, parameters):
            """Return the isotropic stiffness in the case "metric"."""
            if traction_part == "metric":
                return fc.Law.tangential_stiffness(self, kinematics, parameters)
            return super().tangential_stiffness(kinematics, parameters)

        def yield_functions(self, kinematics, traction, limit, parameters):
            """Return those of less transverse friction or permuted sides, in two cases."""
            if traction_part == "friction":
                less = 0.9 * parameters["transverse_friction"]
                parameters = dict(parameters) | {"transverse_friction": less}
            computed = super().yield_functions(kinematics, traction, limit, parameters)
            return (*computed[1:], computed[0]) if traction_part == "modes" else computed

    scene = block("tetrahedron")
    law = Changed(0.3, 1e4, 1e3, direction=(1.0, 0.0, 0.0), **options)
    contact = scene.contact(law)
    scene.u.interpolate(lambda x: np.vstack([0.1 + 0 * x[0], 0.07 + 0 * x[0], -0.01 + 0 * x[0]]))
    contact.evaluate()
    assert np.all(gather(COMM, contact.status) == fc.Status.SLIP)
    computed = check_laws(contact)
    if claim:
        assert computed[claim] > 1e-3
    else:
        assert max(computed.values()) <= 1e-13
