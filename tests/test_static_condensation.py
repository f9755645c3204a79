"""Static condensation: Schur complement, results as on all dofs, one factorisation."""

import logging

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from fenics_contact.systems.candidate_dofs import find_coupled_dofs
from fenics_contact.systems.condensation import Condensation
from fenics_contact.systems.condensed import is_worthwhile
from fenics_contact.systems.unknowns import DofSubset
from scenes.block_on_ball import PATH, BlockOnBall, solve_path, supporting_ball
from scenes.blocks import CELLS, GRID, LEFT, RIGHT, TOP, block, kirchhoff
from scenes.comparison import (
    assert_raised_on_all_ranks,
    gather,
    have_similar_iterations,
    is_close,
    nodal_values,
    owned_values,
    point_values,
)
from scenes.two_blocks import SlidingBlock

pytestmark = [pytest.mark.timeout(240), pytest.mark.three_ranks]
COMM = MPI.COMM_WORLD

# Both systems are solved to 1e-9 of the forces; errors add up along a load path.
SAME = 1e-7
TIGHT = {"snes_rtol": 1e-12}


def with_and_without_condensation(make, run):
    """Return results of ``run`` for a scene with and without static condensation."""
    return [run(make(condensation=condensed)) for condensed in (True, False)]


def assert_same(condensed, full, rtol=SAME):
    for name, value in full.items():
        # Slip is a difference of displacements.
        scale = float(np.abs(full["u"] if name == "slip" else value).max(initial=1e-300))
        assert is_close(condensed[name], value, rtol, scale=scale), name


# ---- the Schur complement ------------------------------------------------------------------------


def dense(matrix):
    """Return the whole matrix on every rank."""
    pointers, columns, values = matrix.getValuesCSR()
    result = np.zeros((pointers.size - 1, matrix.getSize()[1]))
    result[np.repeat(np.arange(len(result)), np.diff(pointers)), columns] = values
    return gather(COMM, result)


@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize(("cell", "degree"), GRID)
def test_schur_complement(cell, degree, symmetric):
    """S, g and the recovered field agree with dense algebra to 1e-10 of the largest entry."""
    scene = block(cell, degree, shuffled=True, up=-1.0)
    if not symmetric:
        v = ufl.TestFunction(scene.u.function_space)
        turn = np.zeros((scene.dim, scene.dim))
        turn[0, 1], turn[1, 0] = 300.0, -300.0
        scene.F += ufl.dot(fem.Constant(scene.mesh, turn) * scene.u, v) * ufl.dx(scene.mesh)
    slide = fem.Constant(scene.mesh, 0.01)
    bcs = [scene.dirichlet_bc(LEFT, i, slide) for i in range(scene.dim)]
    problem, _ = scene.problem(fc.Frictionless(), bcs)
    assert problem.full.bulk.symmetric == symmetric
    K = dense(problem.full.bulk.stiffness)
    n, full = len(K), problem.full.unknowns
    touches = find_coupled_dofs(problem.full.operators, full)
    # Coupled dofs are all components of all nodes of the bottom, no others.
    y = scene.u.function_space.tabulate_dof_coordinates()[:, scene.dim - 1]
    bottom = np.flatnonzero(np.repeat(np.abs(y) < 1e-12, scene.dim))
    assert np.array_equal(touches, bottom[bottom < full.n_local])
    constrained_mask = np.zeros(full.n_local, dtype=bool)
    for i in range(scene.dim):
        dofs = scene.facet_dofs(LEFT, i)
        constrained_mask[dofs[dofs < full.n_local]] = True
    selection = DofSubset(full, touches)
    reduced = Condensation(
        problem.full.bulk.stiffness, problem.full.bulk, selection, constrained_mask
    )
    constrained, retained = gather(COMM, constrained_mask) > 0.5, gather(COMM, full.first + touches)
    assert np.array_equal(retained, selection.numbers)
    inside = np.setdiff1d(np.flatnonzero(~constrained), retained)
    inverse = np.linalg.inv(K[np.ix_(inside, inside)])
    away = K[np.ix_(retained, inside)] @ inverse
    schur = K[np.ix_(retained, retained)] - away @ K[np.ix_(inside, retained)]
    first = COMM.rank == 0
    assert reduced.schur.shape == ((retained.size, retained.size) if first else (0, 0))
    assert not first or is_close(reduced.schur, schur, 1e-10)

    def part(values):
        return values[full.first : full.first + full.n_local].copy()

    rng = np.random.default_rng(3)
    one, other = rng.normal(size=(2, n))
    # The third force is a linear combination of the first two.
    for force in (one, other, 2.5 * one - other, rng.normal(size=n)):
        state = rng.normal(size=n)
        if force is not other:
            state[constrained] = 0.0
        reduced.set_load(part(force), part(state))
        prescribed = np.where(constrained & ~np.isin(np.arange(n), retained), state, 0.0)
        lifted = force - K @ prescribed
        load = lifted[retained] - away @ lifted[inside]
        assert not first or is_close(reduced.particular.load, load, 1e-10)
        field = prescribed + 0.0
        field[retained] = state[retained]
        field[inside] = inverse @ (force - K @ field)[inside]
        boundary_values = state[retained] if first else np.zeros(0)
        computed = gather(COMM, reduced.particular.field + reduced.extend(boundary_values))
        assert is_close(computed, field, 1e-10)


def test_singular_interior_stiffness_is_refused():
    """A stiffness that is singular for fixed retained dofs is refused on all ranks."""
    scene = block("triangle")
    problem, _ = scene.problem(fc.Frictionless(), scene.rollers())
    none = DofSubset(problem.full.unknowns, np.zeros(0, dtype=np.int32))
    free = np.zeros(problem.full.unknowns.n_local, dtype=bool)
    scene.E.value = 0.0
    problem.full.bulk.update()
    assert_raised_on_all_ranks(
        lambda: Condensation(problem.full.bulk.stiffness, problem.full.bulk, none, free),
        RuntimeError,
        "singular",
    )


# ---- results with and without condensation -------------------------------------------------------


def final_fields(setup, steps=()):
    """Return the final state, and forces and energies of the increments."""
    contact = setup.contact
    computed = {
        "u": owned_values(setup.scene.u).copy(),
        "traction": contact.traction,
        "slip": contact.slip,
    }
    computed["force"] = np.array([s.contacts["contact"].force for s in steps])
    computed["work"] = np.array([[s.energy.work, s.energy.elastic] for s in steps])
    return computed


LAWS = {
    "frictionless": fc.Frictionless(k_n=2e4),
    "coulomb": fc.Coulomb(0.3, k_n=2e4, k_t=1e4),
    "tresca": fc.Tresca(0.3, 8.0, k_n=2e4, k_t=1e4),
}


@pytest.mark.each
@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize(("cell", "degree"), [("quadrilateral", 1), ("triangle", 2)])
def test_load_path(cell, degree, law, method):
    """States, forces and energies agree under load reversals, with one factorisation.

    The number of iterations is at most 1.5 times that without condensation, since method and start
    are the same.
    """
    iterations = {}

    def run(setup):
        steps = solve_path(setup)
        iterations[setup.problem.solver.condensed] = sum(s.iterations for s in steps)
        if setup.problem.solver.condensed:
            assert [s.factorisations for s in steps] == [1, 0, 0, 0, 0, 0]
        return final_fields(setup, steps)

    def make(**options):
        return BlockOnBall(LAWS[law], cell=cell, degree=degree, method=method, **options)

    assert_same(*with_and_without_condensation(make, run))
    assert iterations[True] <= 1.5 * iterations[False]


@pytest.mark.parametrize(("cell", "degree"), GRID)
def test_every_cell(cell, degree):
    """Results agree on all cells and degrees with Coulomb friction (start of the load path)."""
    mesh = {"n": 4 if cell in ("triangle", "quadrilateral") else 2}

    def make(**options):
        return BlockOnBall(cell=cell, degree=degree, mesh=mesh, **options)

    assert_same(
        *with_and_without_condensation(
            make, lambda setup: final_fields(setup, solve_path(setup, path=PATH[:4]))
        )
    )


@pytest.mark.parametrize("cell", CELLS)
def test_deformable_obstacle(cell):
    """Results agree for a block sliding over another, with updated pairs and retained dofs."""
    n = (7, 2)
    results = []
    for condensed in (True, False):
        law = fc.Coulomb(0.3, k_n=1e7, k_t=1e7)
        setup = SlidingBlock(cell, law, start=0.4, n=n, condensation=condensed)
        steps = [setup.step(0.002, along) for along in (0.0, 0.3, 0.6)]
        results.append(
            {
                # Sorted by position, since the partition may differ between the two meshes.
                "u": nodal_values(setup.u),
                "traction": point_values(setup.contact, setup.contact.traction),
                "force": np.array([s.contacts["contact"].force for s in steps]),
            }
        )
        if condensed:
            assert sum(s.factorisations for s in steps) <= 3
    assert_same(*results)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_driven_obstacle(cell, method):
    """The motion of a ball driven by a force and a displacement is a retained dof."""
    results = []
    for condensed in (True, False):
        scene = block(cell, n=4 if cell == "triangle" else 2)
        d = scene.dim
        slide = fem.Constant(scene.mesh, 0.0)
        motion = fc.Motion(
            force=[None] * (d - 1) + [5.0], displacement=[slide] + [0.0] * (d - 2) + [None]
        )
        problem, contact = scene.problem(
            fc.Coulomb(0.3, k_n=2e4, k_t=1e4),
            [scene.dirichlet_bc(TOP, i) for i in range(d)],
            contact={"obstacle": supporting_ball(d, motion)},
            method=method,
            condensation=condensed,
        )
        for slide.value in (0.0, 0.01):
            problem.solve()
            problem.commit()
        up = float(contact.free_motion[d - 1].value)
        results.append(
            {"u": owned_values(scene.u).copy(), "up": np.array([up]), "traction": contact.traction}
        )
    assert_same(*results)


def test_several_contacts_and_loads():
    """Results agree for a block without Dirichlet conditions on a floor and a wall, two loads."""
    results = []
    for condensed in (True, False):
        scene = block("triangle", 2, n=4)
        side = scene.add_traction(RIGHT, scene.vector(side=-1.0))
        wall = scene.wall(fc.Frictionless(k_n=2e4))
        floor = scene.contact(fc.Coulomb(0.2, k_n=2e4, k_t=1e4), name="floor")
        problem = fc.ContactProblem(
            scene.F, scene.u, contacts=[wall, floor], condensation=condensed
        )
        computed = []
        for push, up in ((-0.1, -2.0), (-1.0, -2.0), (-1.0, -3.0), (-0.3, -1.0)):
            side.value[0] = push
            scene.load(up=up)
            step = problem.solve()
            problem.commit()
            computed.append([r.force for r in step.contacts.values()])
        # The loads are combinations of two fields, so that two solutions suffice.
        if condensed:
            assert len(problem.solver.system.condensation.load_directions) == 2
        results.append({"u": owned_values(scene.u).copy(), "forces": np.array(computed)})
    assert_same(*results)


def test_changed_modulus_is_factored_anew():
    """A new modulus between increments causes one new factorisation, and results agree."""

    def run(setup):
        steps = []
        for E, move in zip((1000.0, 2000.0, 2000.0, 500.0), PATH[:4], strict=True):
            setup.scene.E.value = E
            steps += solve_path(setup, path=[move])
        if setup.problem.solver.condensed:
            assert [s.factorisations for s in steps] == [1, 1, 0, 1]
        return final_fields(setup, steps)

    assert_same(*with_and_without_condensation(BlockOnBall, run))


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_results_do_not_depend_on_units(method):
    """Number of iterations and fields are the same in other units, fields to 1e-9."""
    results = []
    for length, pressure in [(1.0, 1.0), (1e-3, 1e6), (1e-9, 1e9)]:
        setup = BlockOnBall(
            fc.Coulomb(0.3), length=length, pressure=pressure, method=method, condensation=True
        )
        steps = solve_path(setup, length, PATH[:4])
        iterations = [s.iterations for s in steps]
        results.append(
            (iterations, owned_values(setup.scene.u) / length, setup.contact.traction / pressure)
        )
    for iterations, u, traction in results[1:]:
        assert have_similar_iterations(iterations, results[0][0])
        assert is_close(u, results[0][1], 1e-9)
        assert is_close(traction, results[0][2], 1e-9)


def test_failed_recovery_of_the_interior_names_its_increment(monkeypatch):
    """A wrong interior displacement is refused, as of increment 2 before and after its commit."""
    setup = BlockOnBall(condensation=True)
    problem = setup.problem
    for displacement in PATH[:2]:
        if problem.present.interior is not None:
            problem.complete()
        setup.set_top_displacement(*displacement)
        step = problem.solve(recover_interior=False)
        if problem.increment == 0:
            problem.commit()
    assert not step.complete
    with monkeypatch.context() as patch:
        patch.setattr(problem.solver.system, "complete", lambda interior: None)
        for _ in range(2):  # the trial state, then the committed one
            assert_raised_on_all_ranks(problem.complete, fc.NotConverged, "increment 2:")
            problem.commit()
    assert problem.complete().failures == []


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_failed_increment_changes_nothing(method):
    """A failed increment changes neither u, nor the history, nor the following increments."""
    setup, reference = (BlockOnBall(method=method, condensation=True) for _ in range(2))
    for m in (setup, reference):
        solve_path(m, path=PATH[:2])
    before = setup.scene.u.x.array.copy(), setup.contact.history.function.x.array.copy()
    setup.set_top_displacement(*PATH[2])
    max_it = setup.problem.solver.main.max_it
    setup.problem.solver.main.max_it = 0
    setup.problem.snes.setTolerances(max_it=0)
    with pytest.raises(fc.NotConverged):
        setup.problem.solve()
    setup.problem.solver.main.max_it = max_it
    setup.problem.snes.setTolerances(max_it=max_it)
    after = setup.scene.u.x.array, setup.contact.history.function.x.array
    assert all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))
    for m in (setup, reference):
        solve_path(m, path=PATH[2:])
    assert_same(final_fields(setup), final_fields(reference))


def test_indefinite_bulk():
    """Results agree if neither K nor S is definite."""
    results = []
    for condensed in (True, False):
        scene = block("quadrilateral", up=-1.0)
        v = ufl.TestFunction(scene.u.function_space)
        pushed = fem.Constant(scene.mesh, 3e3) * scene.u[0].dx(0) * v[0].dx(0)
        scene.F -= pushed * ufl.dx(scene.mesh)
        problem, contact = scene.problem(
            fc.Frictionless(k_n=5e3), scene.rollers(), condensation=condensed, petsc_options=TIGHT
        )
        problem.solve()
        results.append({"u": owned_values(scene.u).copy(), "pressure": contact.pressure})
    assert_same(*results)


# ---- choice of condensation ----------------------------------------------------------------------


def test_default_of_condensation_is_logged(caplog):
    """Linear bulks are condensed by default, with a log entry; impossible requests raise."""
    scene = block("triangle", n=4, up=-1.0)
    law = fc.Frictionless(k_n=5e3)
    with caplog.at_level(logging.INFO, logger="fenics_contact"):
        problem, contact = scene.problem(law, scene.rollers())
    assert problem.solver.condensed
    if COMM.rank == 0:
        message = "static condensation onto 10 of 50"
        assert any(message in record.getMessage() for record in caplog.records)
    assert not scene.problem(law, scene.rollers(), condensation=False)[0].solver.condensed

    def condensed(F, contacts, **options):
        return fc.ContactProblem(
            F, scene.u, bcs=scene.rollers(), contacts=contacts, condensation=True, **options
        )

    options = PETSc.Options().getAll()

    def without_contact():
        bcs = [scene.dirichlet_bc(LEFT, i) for i in range(2)]
        fc.ContactProblem(scene.F, scene.u, bcs=bcs, condensation=True)

    assert_raised_on_all_ranks(without_contact, ValueError, "condensation", "no contact")
    F = kirchhoff(scene)
    assert_raised_on_all_ranks(
        lambda: condensed(F, [contact]), ValueError, "condensation", "not linear"
    )
    given = {"pc_type": "lu"}
    assert_raised_on_all_ranks(
        lambda: condensed(scene.F, [contact], petsc_options=given), ValueError, "pc_type"
    )
    assert PETSc.Options().getAll() == options


def test_condensation_depends_on_numbers_of_dofs():
    """Condensation is worthwhile for few retained dofs relative to all, if S fits in memory."""
    assert (
        is_worthwhile(50, 10, 2)
        and is_worthwhile(250_000, 1000, 2)
        and is_worthwhile(100_000, 1500, 3)
    )
    assert is_worthwhile(12_604, 736, 2) and not is_worthwhile(2000, 700, 2)
    assert not is_worthwhile(10_000, 3000, 2)
    assert not is_worthwhile(100_000, 6000, 3)
    assert not is_worthwhile(10**8, 20_000, 3)
    assert not is_worthwhile(1000, 0, 2)


@pytest.mark.mpi
def test_nonlinear_bulk_is_not_condensed():
    """A nonlinear bulk is solved on all dofs by default."""
    scene = block("quadrilateral", up=-1.0)
    scene.F = kirchhoff(scene)
    problem, _ = scene.problem(fc.Frictionless(k_n=5e4), scene.rollers())
    assert not problem.solver.condensed
    problem.solve()
