"""Multigrid for the systems of all dofs: its solutions are those of factorisation."""

import logging

import gmsh
import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc
from scipy.spatial.transform import Rotation

import fenics_contact as fc
from fenics_contact.surface.bodies import connected_bodies
from fenics_contact.systems import linear
from scenes.block_on_ball import PATH, BlockOnBall, solve_path, supporting_ball
from scenes.blocks import BOTTOM as FLOOR
from scenes.blocks import GRID, LEFT, TOP, block, layer_partitioner
from scenes.bodies import boxes
from scenes.comparison import assert_raised_on_all_ranks, is_close, nodal_values, point_values
from scenes.elasticity import residual
from scenes.stacks import ROOF, floor, joint, stack
from scenes.two_blocks import BOTTOM, LOWER_FACE, UPPER_FACE, E, two_blocks
from scenes.two_blocks import TOP as LID

pytestmark = [pytest.mark.three_ranks, pytest.mark.timeout(240)]
COMM = MPI.COMM_WORLD

# Residuals of 1e-12 of the forces: solutions differ by round-off times the condition, 1e4.
TIGHT = {"snes_rtol": 1e-12}
SAME = 1e-8


def results_of_both_solvers(make):
    """Return the results of ``make(**options)`` by factorisation and by multigrid, for all dofs."""
    return [
        make(linear_solver=kind, condensation=False, petsc_options=TIGHT) for kind in linear.KINDS
    ]


def assert_same_path(cell, degree, method, n, path):
    """Check that the fields by multigrid and by factorisation agree to 1e-8.

    A block, its top prescribed, is moved back and forth on a round cushion with friction.
    """

    def make(**options):
        setup = BlockOnBall(cell=cell, degree=degree, mesh={"n": n}, method=method, **options)
        steps = solve_path(setup, path=path)
        if options["linear_solver"] == "multigrid":
            assert [s.factorisations for s in steps] == [0] * len(path)
        assert setup.contact.resultants().slip > 0
        if options["linear_solver"] == "multigrid" and method != "alternating":
            assert setup.problem.snes.getKSP().getPC().getMGLevels() > 1
        return nodal_values(setup.scene.u), point_values(setup.contact, setup.contact.traction)

    direct, multigrid = results_of_both_solvers(make)
    for by_factors, by_cycles in zip(direct, multigrid, strict=True):
        assert is_close(by_cycles, by_factors, SAME)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize(("cell", "degree"), [case for case in GRID if case != ("hexahedron", 2)])
def test_multigrid_equals_factorisation(cell, degree, method):
    """Solutions agree for all cells, with Dirichlet values, which a V-cycle must not change."""
    n = (16 if cell in ("triangle", "quadrilateral") else 8) // degree
    assert_same_path(cell, degree, method, n, PATH[:3])


@pytest.mark.parametrize(("cell", "n"), [("triangle", 8), ("hexahedron", 4)])
def test_multigrid_in_the_tresca_fixed_point(cell, n):
    """Solutions agree for the Tresca fixed point, which has linear solvers of its own."""
    assert_same_path(cell, 1, "alternating", n, PATH[2:3])


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_body_constrained_by_contact_alone(cell, method):
    """Solutions agree for a block pressed and pushed on a floor with friction: K is singular."""

    def make(**options):
        scene = block(cell, n=16 if cell == "triangle" else 6, side=0.2, up=-1.0)
        law = fc.Coulomb(0.5, k_n=2e4, k_t=1e4)
        problem, contact = scene.problem(law, [], method=method, **options)
        problem.solve()
        assert is_close(contact.resultants().force, -scene.vector(side=0.2, up=-1.0), 1e-9)
        return nodal_values(scene.u)

    direct, multigrid = results_of_both_solvers(make)
    assert is_close(multigrid, direct, SAME)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_problem_without_contact(method):
    """Solutions agree for a block without any contact, whose levels need no updates."""

    def make(**options):
        scene = block("triangle", n=16, up=-1.0)
        bcs = [*scene.rollers(), scene.dirichlet_bc(FLOOR, 1)]
        fc.ContactProblem(scene.F, scene.u, bcs=bcs, method=method, **options).solve()
        return nodal_values(scene.u)

    direct, multigrid = results_of_both_solvers(make)
    assert is_close(multigrid, direct, SAME)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_two_bodies(cell, method):
    """Solutions agree for an unconstrained block on a block with friction and another mesh."""

    def make(**options):
        n = (12, 9) if cell == "quadrilateral" else (6, 5)
        mesh, tags = two_blocks(cell, n, widths=(1.0, 0.71), shift=0.1)  # no coincident nodes
        d = mesh.geometry.dim
        space = fem.functionspace(mesh, ("Lagrange", 1, (d,)))
        u, v = fem.Function(space), ufl.TestFunction(space)
        load = np.zeros(d)
        load[0], load[-1] = 300.0, -2000.0
        ds = ufl.ds(mesh, subdomain_data=tags)
        F = residual(u, v, E, 0.3) - ufl.dot(fem.Constant(mesh, load), v) * ds(LID)
        dofs = fem.locate_dofs_topological(space, d - 1, tags.find(BOTTOM))
        bcs = [fem.dirichletbc(np.zeros(d), dofs, space)]
        surface = fc.ContactSurface(mesh, tags, UPPER_FACE)
        contact = fc.Contact(u, surface, fc.DeformableBody(tags, LOWER_FACE), fc.Coulomb(0.3))
        problem = fc.ContactProblem(F, u, bcs=bcs, contacts=[contact], method=method, **options)
        problem.solve()
        return nodal_values(u)

    direct, multigrid = results_of_both_solvers(make)
    assert is_close(multigrid, direct, SAME)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_units(method):
    """Iterations and digits are the same in other units, to 1e-9 of the field.

    On several ranks the iterations agree to a tenth. The cells are distributed explicitly: the
    partitioner may distribute equal meshes differently, and the smoother depends on the cells of
    each rank.
    """
    computed = []
    for length, pressure in [(1.0, 1.0), (1e-3, 1e6), (1e-9, 1e9)]:
        setup = BlockOnBall(
            cell="hexahedron",
            mesh={
                "n": 6,
                "size": np.full(3, length),
                "partitioner": layer_partitioner("hexahedron"),
            },
            length=length,
            pressure=pressure,
            method=method,
            linear_solver="multigrid",
            petsc_options=TIGHT,
        )
        steps = solve_path(setup, length, PATH[:2])
        computed.append(([s.iterations for s in steps], nodal_values(setup.scene.u) / length))
    for iterations, u in computed[1:]:
        assert iterations == pytest.approx(computed[0][0], rel=0.1 if COMM.size > 1 else 0.0)
        assert is_close(u, computed[0][1], 1e-9)


def krylov_iterations(n: int, *, rotations: bool) -> int:
    """Return the conjugate gradient iterations for a slender cantilever with n cells across."""
    scene = block("hexahedron", n=(10 * n, n, n), size=(10.0, 1.0, 1.0))
    bcs = [scene.dirichlet_bc(LEFT, i) for i in range(3)]
    problem, _ = scene.problem(fc.Frictionless(), bcs, method="newton", linear_solver="multigrid")
    matrix, solver = problem.solver.equations.matrix(False), problem.solver.equations.solvers[False]
    problem.solver.system.fill(matrix, [])
    if not rotations:
        matrix.setNearNullSpace(PETSc.NullSpace())
    force, solution = matrix.createVecs()
    force.array[:] = np.where(problem.full.constrained, 0.0, 1.0)
    with problem.solver.options.present():
        solver.solve(force, solution)
    assert solver.getConvergedReason() > 0
    return solver.getIterationNumber()


def test_iterations_hardly_grow_with_the_mesh():
    """Rotations in the near null space of the levels keep the iterations nearly constant.

    Theory of smoothed aggregation: with them iterations do not depend on the mesh; without them
    they do.
    """
    coarse, fine = (krylov_iterations(n, rotations=True) for n in (2, 4))
    assert fine <= 1.5 * coarse
    assert krylov_iterations(4, rotations=False) > 1.5 * fine


# ---- solver selection ----------------------------------------------------------------------------


def log_messages(caplog) -> str:
    """Return the log messages of rank 0."""
    return COMM.bcast("\n".join(r.getMessage() for r in caplog.records))


def test_invalid_solver_options_are_refused():
    """Unknown names and condensation with multigrid are refused; PETSc's options are unchanged."""
    scene = block("triangle", up=-1.0)
    before = PETSc.Options().getAll()

    def make(**options):
        scene.problem(fc.Frictionless(), scene.rollers(), **options)

    for wrong in ("lu", "", 3):
        assert_raised_on_all_ranks(
            lambda w=wrong: make(linear_solver=w), ValueError, "linear_solver"
        )
    if COMM.size == 1:
        assert_raised_on_all_ranks(
            lambda: make(linear_solver="multigrid", condensation=True), ValueError, "multigrid"
        )
    assert PETSc.Options().getAll() == before


def test_multigrid_is_selected_if_memory_is_short(caplog, monkeypatch):
    """Neither condensation nor factors may need more than half of the memory; this is logged."""
    scene = block("quadrilateral", n=8, up=-1.0)
    with caplog.at_level(logging.INFO, logger="fenics_contact"):
        problem, _ = scene.problem(fc.Frictionless(), scene.rollers())
        assert problem.full.linear_kind == "direct"
        monkeypatch.setattr(linear, "find_available_memory", lambda comm: 1e4)
        problem, _ = scene.problem(fc.Frictionless(), scene.rollers())
    assert not problem.solver.condensed
    assert problem.full.linear_kind == "multigrid"
    assert "GiB of memory" in log_messages(caplog) and "multigrid" in log_messages(caplog)
    assert problem.solve().factorisations == 0
    requested, _ = scene.problem(fc.Frictionless(), scene.rollers(), linear_solver="direct")
    assert requested.full.linear_kind == "direct"


def test_multigrid_is_selected_if_it_is_faster():
    """Multigrid is faster in 3D for many dofs, for more of them if one factorisation is reused."""
    assert not linear.is_multigrid_faster(10_000, 3)
    assert linear.is_multigrid_faster(100_000, 3)
    assert linear.is_multigrid_faster(100_000, 3, condensed_for=1)
    assert not linear.is_multigrid_faster(100_000, 3, condensed_for=4)
    assert linear.is_multigrid_faster(1_000_000, 3, condensed_for=4)
    assert not linear.is_multigrid_faster(1_000_000, 2)


@pytest.mark.mpi
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("degree", [1, 2])
def test_cube_size_follows_the_cost_of_factorisation(turned, degree):
    """A body with w nodes in its least cross-section counts as a cube of w^(3/2) nodes.

    For several bodies w² is averaged over the nodes. A cross-section has the cells across a box
    times the nodes per cell of the lattice, exactly, independent of position and rotation of the
    bodies.
    """
    cells = np.array([[24, 12, 6], [8, 6, 7]])
    lines = [
        [np.linspace(0, n / 6, n + 1) + 10.0 * (body and axis == 0) for axis, n in enumerate(sides)]
        for body, sides in enumerate(cells)
    ]
    nodes = np.prod(degree * cells + 1, axis=1)
    across = np.array([12 * 6, 6 * 7]) * nodes / np.prod(cells, axis=1) / degree
    for number in (1, 2):
        mesh, _ = boxes(lines[:number], {})
        if turned:
            turn = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
            mesh.geometry.x[:] = mesh.geometry.x @ turn.T + 1e4
        space = fem.functionspace(mesh, ("Lagrange", degree, (3,)))
        size = linear.cube_size(space, connected_bodies(space)[1], degree)
        work = nodes[:number] @ across[:number] ** 2 / nodes[:number].sum()
        assert size == pytest.approx(3 * work ** (3 / 4), rel=1e-9)


def cube(size):
    """Return gmsh's tetrahedra of a cube, their size given by the distance from its centre."""
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 0)
        if COMM.rank == 0:
            body = gmsh.model.occ.addBox(-0.5, -0.5, -0.5, 1.0, 1.0, 1.0)
            gmsh.model.occ.synchronize()
            gmsh.model.addPhysicalGroup(3, [body], 1)
            gmsh.model.mesh.setSizeCallback(lambda d, t, *x_lc: size(np.linalg.norm(x_lc[:3])))
            gmsh.model.mesh.generate(3)
        return fc.model_to_mesh(gmsh.model, COMM, gdim=3)[0]
    finally:
        gmsh.finalize()


@pytest.mark.mpi
@pytest.mark.parametrize("graded", [False, True])
def test_small_cells_in_the_middle_increase_the_cube_size(graded):
    """The size follows from the cells cut by planes through the middle, to 15 %, a layer of planes.

    Reference: the cut cells counted one by one. A cube with small cells in the middle counts as
    larger than its own number of dofs.
    """
    mesh = cube((lambda r: 0.04 + 0.2 * r) if graded else (lambda r: 0.1))
    space = fem.functionspace(mesh, ("Lagrange", 1, (3,)))
    n = space.dofmap.index_map.size_global
    cells = mesh.topology.index_map(3)
    x = mesh.geometry.x[mesh.geometry.dofmap[: cells.size_local]]
    cut = np.sum((x.min(axis=1) < 0.0) & (x.max(axis=1) > 0.0), axis=0)
    section = COMM.allreduce(cut).min() * n / cells.size_global
    size = linear.cube_size(space, connected_bodies(space)[1], 1)
    assert size == pytest.approx(3 * section**1.5, rel=0.15)
    assert (size > 1.5 * 3 * n) == graded


def test_solver_selection_depends_on_the_number_of_increments(monkeypatch):
    """Few increments select multigrid, many condensation; the first solution fixes the choice."""
    scene = block("hexahedron", n=2)
    problem, _ = scene.problem(fc.Frictionless(), scene.rollers())
    monkeypatch.setattr(linear, "_MULTIGRID_SIZE", 0)
    monkeypatch.setattr(linear, "_SIZE_PER_INCREMENT", problem.full.size_to_factor / 2.5)
    assert problem.solver.condensed
    problem.expected_increments = 2
    assert not problem.solver.condensed and problem.full.linear_kind == "multigrid"
    with pytest.raises(ValueError, match="at least 1"):
        problem.expected_increments = 0
    few = problem.solve().contacts["contact"].normal_force
    problem.expected_increments = 40
    assert not problem.solver.condensed
    problem, _ = scene.problem(fc.Frictionless(), scene.rollers(), condensation=True)
    problem.expected_increments = 2
    assert problem.solver.condensed
    assert problem.solve().contacts["contact"].normal_force == pytest.approx(few, rel=1e-8)
    # `increments` sets the number.
    for steps, condensed in ((1, False), (3, True)):
        problem, _ = scene.problem(fc.Frictionless(), scene.rollers())
        list(fc.increments(problem, lambda t: None, steps=steps))
        assert problem.solver.condensed == condensed


def test_free_obstacle_is_solved_by_factorisation(caplog):
    """Motions of an obstacle are not nodal dofs: factors are used, and the log says why."""
    scene = block("triangle", n=4)
    motion = fc.Motion(force=(None, 5.0))
    with caplog.at_level(logging.INFO, logger="fenics_contact"):
        problem, contact = scene.problem(
            fc.Frictionless(k_n=2e4),
            [scene.dirichlet_bc(TOP, i) for i in range(2)],
            contact={"obstacle": supporting_ball(2, motion)},
            linear_solver="multigrid",
        )
    assert problem.full.linear_kind == "direct"
    assert "unknown motions" in log_messages(caplog)
    problem.solve()
    assert is_close(contact.resultants().force[1], 5.0, 1e-8)


def test_options_reach_the_multigrid_levels():
    """Options for nested solvers are applied, and do not remain in PETSc's database."""
    before = PETSc.Options().getAll()
    setup = BlockOnBall(
        method="lbfgs",
        linear_solver="multigrid",
        petsc_options={"mg_levels_pc_type": "jacobi", "mg_levels_ksp_max_it": 3},
        mesh={"n": 16},
    )
    solve_path(setup, path=PATH[:1])
    smoother = setup.problem.solver.equations.solvers[False].getPC().getMGSmoother(1)
    assert smoother.getPC().getType() == "jacobi"
    assert smoother.getTolerances()[3] == 3
    assert PETSc.Options().getAll() == before


# ---- memory, monitors and levels -----------------------------------------------------------------


@pytest.mark.skipif(COMM.size > 1, reason="MUMPS on one rank")
@pytest.mark.parametrize(("cell", "n"), [("hexahedron", 14), ("triangle", 100)])
@pytest.mark.parametrize("symmetric", [True, False])
def test_memory_of_factors(cell, n, symmetric):
    """The estimated memory is within a factor of 1.5 of that reported by MUMPS."""
    scene = block(cell, n=n)
    problem, _ = scene.problem(fc.Frictionless(), scene.rollers(), condensation=False)
    matrix = problem.full.stiffness.copy()
    constrained = np.flatnonzero(problem.full.constrained).astype(np.int32)
    matrix.zeroRowsColumns(constrained, diag=problem.full.bulk.scale)
    matrix.shift(problem.full.bulk.scale * 1e-6)  # the height is not constrained
    matrix.setOption(PETSc.Mat.Option.SYMMETRIC, symmetric)
    pc = PETSc.PC().create(COMM)
    pc.setOperators(matrix)
    pc.setType("cholesky" if symmetric else "lu")
    pc.setFactorSolverType("mumps")
    pc.setUp()
    taken = 1e6 * pc.getFactorMatrix().getMumpsInfog(22)
    estimate = linear.factor_bytes(problem.full.unknowns.n_local, scene.dim, symmetric=symmetric)
    assert taken / 1.5 < estimate < 1.5 * taken


def test_monitors_are_kept_when_the_solver_is_replaced(monkeypatch):
    """`increments` may create a new SNES: its monitors are called with the same arguments."""
    scene = block("hexahedron", n=2, up=-1.0)
    problem, _ = scene.problem(fc.Frictionless(), scene.rollers())
    monkeypatch.setattr(linear, "_MULTIGRID_SIZE", 0)
    monkeypatch.setattr(linear, "_SIZE_PER_INCREMENT", problem.full.size_to_factor / 2.5)
    before, monitored = problem.snes, []

    def watch(snes, iteration, norm, name, *, unit):
        monitored.append((iteration, norm, name, unit))

    def count(snes, iteration, norm):
        monitored.append((iteration, norm, "count", 1))

    before.setMonitor(watch, ("a name",), {"unit": 2.0})
    before.setMonitor(count)
    (step,) = fc.increments(problem, lambda t: None, steps=1)
    assert problem.snes is not before and not problem.solver.condensed
    for name, unit in (("a name", 2.0), ("count", 1)):
        iterations = [it for it, norm, n, u in monitored if (n, u) == (name, unit)]
        assert len(iterations) > step.iterations > 0  # and at the start of a solve


def levels_of(pc):
    """Return the matrices of all levels, finest first, and the maps from each to the one above."""
    top = pc.getMGLevels() - 1
    matrices = [pc.getMGSmoother(n).getOperators()[0] for n in range(top, -1, -1)]
    return matrices, [pc.getMGInterpolation(n) for n in range(top, 0, -1)]


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_level_matrices_are_galerkin_products(cell):
    """After a history every level is PᵀAP of the level above, to 1e-12.

    Reference: products of the whole matrices. The levels are set up once.
    """
    n = 24 if cell == "triangle" else 8
    options = {"linear_solver": "multigrid", "condensation": False, "method": "lbfgs"}
    setup = BlockOnBall(cell=cell, mesh={"n": n}, **options)
    solve_path(setup, path=PATH)
    assert setup.problem.solver.equations.hierarchy.set_ups == 1
    pc = setup.problem.snes.getKSP().getPC()
    matrices, maps = levels_of(pc)
    assert len(maps) >= 1
    for fine, coarse, prolongation in zip(matrices[:-1], matrices[1:], maps, strict=True):
        product = fine.PtAP(prolongation)
        size = product.norm()
        product.axpy(-1.0, coarse)
        assert product.norm() < 1e-12 * size


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_finite_sliding_pairs_rebuild_the_levels(cell):
    """Finite-sliding pairs change the pattern of the matrix: all levels are set up again.

    Two blocks on a floor are pressed and pushed back and forth, with L-BFGS. Reference:
    factorisation, with tight tolerances, to 1e-8.
    """

    def make(**options):
        body = stack(cell, (12, 15) if cell == "triangle" else (3, 4), (1.0, 1.0))
        traction = fem.Constant(body.mesh, np.zeros(body.d))
        body.F -= ufl.dot(traction, body.v) * body.ds(ROOF)
        law = fc.Coulomb(friction=0.4)
        contacts = [floor(body, law), joint(body, 1, law, kinematics="finite")]
        problem = fc.ContactProblem(body.F, body.u, contacts=contacts, method="lbfgs", **options)
        slips = []
        for factor in (0.0, 0.12, -0.1):
            traction.value[[0, -1]] = 1e3 * factor, -1e3
            problem.solve()
            problem.commit()
            slips.append(contacts[1].resultants().slip)
        return nodal_values(body.u), np.array(slips)

    direct, multigrid = results_of_both_solvers(make)
    for by_factors, by_cycles in zip(direct, multigrid, strict=True):
        assert is_close(by_cycles, by_factors, SAME)
