"""Condensation: the Schur complement, the same results as on all unknowns, one factorisation."""

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
from scenes.blocks import CELLS, GRID, LEFT, RIGHT, TOP, block, kirchhoff
from scenes.comparing import (
    at_points,
    close,
    gathered,
    nodal,
    owned,
    raised_everywhere,
    same_effort,
)
from scenes.rubbing import PATH, Rub, cushion, walk
from scenes.two_blocks import Slider

pytestmark = [pytest.mark.timeout(240), pytest.mark.three_ranks]
COMM = MPI.COMM_WORLD

# Both spaces solve to 1e-9 of the forces; a path adds up.
SAME = 1e-7
TIGHT = {"snes_rtol": 1e-12}


def both(make, run):
    """Results of ``run`` for a scene made with and without condensation."""
    return [run(make(condensation=condensed)) for condensed in (True, False)]


def assert_same(condensed, whole, rtol=SAME):
    for name, value in whole.items():
        # Slip is a difference of displacements.
        scale = float(np.abs(whole["u"] if name == "slip" else value).max(initial=1e-300))
        assert close(condensed[name], value, rtol, scale=scale), name


# ---- the Schur complement ------------------------------------------------------------------------


def dense(matrix):
    """All of a matrix, on every rank."""
    pointers, columns, values = matrix.getValuesCSR()
    result = np.zeros((pointers.size - 1, matrix.getSize()[1]))
    result[np.repeat(np.arange(len(result)), np.diff(pointers)), columns] = values
    return gathered(COMM, result)


@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize(("cell", "degree"), GRID)
def test_schur_complement(cell, degree, symmetric):
    """S, g and the recovered field against dense algebra: numpy, 1e-10 of the largest entry."""
    scene = block(cell, degree, shuffled=True, up=-1.0)
    if not symmetric:
        v = ufl.TestFunction(scene.u.function_space)
        turn = np.zeros((scene.dim, scene.dim))
        turn[0, 1], turn[1, 0] = 300.0, -300.0
        scene.F += ufl.dot(fem.Constant(scene.mesh, turn) * scene.u, v) * ufl.dx(scene.mesh)
    aside = fem.Constant(scene.mesh, 0.01)
    bcs = [scene.hold(LEFT, i, aside) for i in range(scene.dim)]
    problem, _ = scene.problem(fc.Frictionless(), bcs)
    assert problem.full.bulk.symmetric == symmetric
    K = dense(problem.full.bulk.stiffness)
    n, whole = len(K), problem.full.unknowns
    touches = find_coupled_dofs(problem.full.operators, whole)
    # All components of all nodes of the bottom, no others.
    y = scene.u.function_space.tabulate_dof_coordinates()[:, scene.dim - 1]
    bottom = np.flatnonzero(np.repeat(np.abs(y) < 1e-12, scene.dim))
    assert np.array_equal(touches, bottom[bottom < whole.n_local])
    mine = np.zeros(whole.n_local, dtype=bool)
    for i in range(scene.dim):
        dofs = scene.facet_dofs(LEFT, i)
        mine[dofs[dofs < whole.n_local]] = True
    selection = DofSubset(whole, touches)
    made = Condensation(problem.full.bulk.stiffness, problem.full.bulk, selection, mine)
    held, kept = gathered(COMM, mine) > 0.5, gathered(COMM, whole.first + touches)
    assert np.array_equal(kept, selection.numbers)
    inside = np.setdiff1d(np.flatnonzero(~held), kept)
    inverse = np.linalg.inv(K[np.ix_(inside, inside)])
    away = K[np.ix_(kept, inside)] @ inverse
    schur = K[np.ix_(kept, kept)] - away @ K[np.ix_(inside, kept)]
    first = COMM.rank == 0
    assert made.schur.shape == ((kept.size, kept.size) if first else (0, 0))
    assert not first or close(made.schur, schur, 1e-10)

    def part(values):
        return values[whole.first : whole.first + whole.n_local].copy()

    rng = np.random.default_rng(3)
    one, other = rng.normal(size=(2, n))
    # The third is a combination of those before.
    for force in (one, other, 2.5 * one - other, rng.normal(size=n)):
        state = rng.normal(size=n)
        if force is not other:
            state[held] = 0.0
        made.set_load(part(force), part(state))
        prescribed = np.where(held & ~np.isin(np.arange(n), kept), state, 0.0)
        lifted = force - K @ prescribed
        load = lifted[kept] - away @ lifted[inside]
        assert not first or close(made.particular.load, load, 1e-10)
        field = prescribed + 0.0
        field[kept] = state[kept]
        field[inside] = inverse @ (force - K @ field)[inside]
        given = state[kept] if first else np.zeros(0)
        found = gathered(COMM, made.particular.field + made.extend(given))
        assert close(found, field, 1e-10)


def test_nothing_holds_a_part():
    """A stiffness that is singular with the kept unknowns held is refused, on all ranks."""
    scene = block("triangle")
    problem, _ = scene.problem(fc.Frictionless(), scene.rollers())
    none = DofSubset(problem.full.unknowns, np.zeros(0, dtype=np.int32))
    free = np.zeros(problem.full.unknowns.n_local, dtype=bool)
    scene.E.value = 0.0
    problem.full.bulk.update()
    raised_everywhere(
        lambda: Condensation(problem.full.bulk.stiffness, problem.full.bulk, none, free),
        RuntimeError,
        "singular",
    )


# ---- the same results ----------------------------------------------------------------------------


def fields(made, steps=()):
    """All of the final state and what the increments came to."""
    contact = made.contact
    found = {"u": owned(made.scene.u).copy(), "traction": contact.traction, "slip": contact.slip}
    found["force"] = np.array([s.contacts["contact"].force for s in steps])
    found["work"] = np.array([[s.energy.work, s.energy.elastic] for s in steps])
    return found


LAWS = {
    "frictionless": fc.Frictionless(k_n=2e4),
    "coulomb": fc.Coulomb(0.3, k_n=2e4, k_t=1e4),
    "tresca": fc.Tresca(0.3, 8.0, k_n=2e4, k_t=1e4),
}


@pytest.mark.each
@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize(("cell", "degree"), [("quadrilateral", 1), ("triangle", 2)])
def test_path(cell, degree, law, method):
    """To and fro with prescribed values that change: states, forces, works; one factorisation.

    Iterations are of the same order: the condensed Newton method is the same one, and half as many
    again would be another one, or another start.
    """
    iterations = {}

    def run(made):
        steps = walk(made)
        iterations[made.problem.solver.condensed] = sum(s.iterations for s in steps)
        if made.problem.solver.condensed:
            assert [s.factorisations for s in steps] == [1, 0, 0, 0, 0, 0]
        return fields(made, steps)

    def make(**options):
        return Rub(LAWS[law], cell=cell, degree=degree, method=method, **options)

    assert_same(*both(make, run))
    assert iterations[True] <= 1.5 * iterations[False]


@pytest.mark.parametrize(("cell", "degree"), GRID)
def test_every_cell(cell, degree):
    """The start of the path with Coulomb friction on all cells and degrees."""
    mesh = {"n": 4 if cell in ("triangle", "quadrilateral") else 2}

    def make(**options):
        return Rub(cell=cell, degree=degree, mesh=mesh, **options)

    assert_same(*both(make, lambda made: fields(made, walk(made, path=PATH[:4]))))


@pytest.mark.parametrize("cell", CELLS)
def test_deformable_obstacle(cell):
    """A block slid over another, pairs found anew: the same, whatever was touched before."""
    n = (7, 2)
    results = []
    for condensed in (True, False):
        law = fc.Coulomb(0.3, k_n=1e7, k_t=1e7)
        made = Slider(cell, law, start=0.4, n=n, condensation=condensed)
        steps = [made.step(0.002, along) for along in (0.0, 0.3, 0.6)]
        results.append(
            {
                # In the order of places: a mesh may be divided otherwise when it is made again.
                "u": nodal(made.u),
                "traction": at_points(made.contact, made.contact.traction),
                "force": np.array([s.contacts["contact"].force for s in steps]),
            }
        )
        if condensed:
            assert sum(s.factorisations for s in steps) <= 3
    assert_same(*results)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_driven_obstacle(cell, method):
    """A ball driven by a force, dragged by a displacement: its motion is one of those kept."""
    results = []
    for condensed in (True, False):
        scene = block(cell, n=4 if cell == "triangle" else 2)
        d = scene.dim
        drag = fem.Constant(scene.mesh, 0.0)
        motion = fc.Motion(
            force=[None] * (d - 1) + [5.0], displacement=[drag] + [0.0] * (d - 2) + [None]
        )
        problem, contact = scene.problem(
            fc.Coulomb(0.3, k_n=2e4, k_t=1e4),
            [scene.hold(TOP, i) for i in range(d)],
            contact={"obstacle": cushion(d, motion)},
            method=method,
            condensation=condensed,
        )
        for drag.value in (0.0, 0.01):
            problem.solve()
            problem.commit()
        up = float(contact.free_motion[d - 1].value)
        results.append(
            {"u": owned(scene.u).copy(), "up": np.array([up]), "traction": contact.traction}
        )
    assert_same(*results)


def test_several_contacts_and_loads():
    """A floor with friction and a wall, side and top loads in turn, nothing else that holds."""
    results = []
    for condensed in (True, False):
        scene = block("triangle", 2, n=4)
        side = scene.pull(RIGHT, scene.vector(side=-1.0))
        wall = scene.wall(fc.Frictionless(k_n=2e4))
        floor = scene.contact(fc.Coulomb(0.2, k_n=2e4, k_t=1e4), name="floor")
        problem = fc.ContactProblem(
            scene.F, scene.u, contacts=[wall, floor], condensation=condensed
        )
        found = []
        for push, up in ((-0.1, -2.0), (-1.0, -2.0), (-1.0, -3.0), (-0.3, -1.0)):
            side.value[0] = push
            scene.load(up=up)
            step = problem.solve()
            problem.commit()
            found.append([r.force for r in step.contacts.values()])
        # Both loads are two fields times numbers: factored once, and solved for once each.
        if condensed:
            assert len(problem.solver.system.condensation.load_directions) == 2
        results.append({"u": owned(scene.u).copy(), "forces": np.array(found)})
    assert_same(*results)


def test_modulus_changed():
    """A new modulus between increments: a new factorisation, and the results with it."""

    def run(made):
        steps = []
        for E, move in zip((1000.0, 2000.0, 2000.0, 500.0), PATH[:4], strict=True):
            made.scene.E.value = E
            steps += walk(made, path=[move])
        if made.problem.solver.condensed:
            assert [s.factorisations for s in steps] == [1, 1, 0, 1]
        return fields(made, steps)

    assert_same(*both(Rub, run))


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_units(method):
    """The same effort and digits in other units, 1e-9 of the fields."""
    results = []
    for length, pressure in [(1.0, 1.0), (1e-3, 1e6), (1e-9, 1e9)]:
        made = Rub(
            fc.Coulomb(0.3), length=length, pressure=pressure, method=method, condensation=True
        )
        steps = walk(made, length, PATH[:4])
        iterations = [s.iterations for s in steps]
        results.append((iterations, owned(made.scene.u) / length, made.contact.traction / pressure))
    for iterations, u, traction in results[1:]:
        assert same_effort(iterations, results[0][0])
        assert close(u, results[0][1], 1e-9)
        assert close(traction, results[0][2], 1e-9)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_failure_leaves_no_trace(method):
    """An increment that fails leaves u, history and what comes next as if it had not been."""
    made, twin = (Rub(method=method, condensation=True) for _ in range(2))
    for m in (made, twin):
        walk(m, path=PATH[:2])
    before = made.scene.u.x.array.copy(), made.contact.history.function.x.array.copy()
    made.move(*PATH[2])
    kept = made.problem.solver.main.max_it
    made.problem.solver.main.max_it = 0
    made.problem.snes.setTolerances(max_it=0)
    with pytest.raises(fc.NotConverged):
        made.problem.solve()
    made.problem.solver.main.max_it = kept
    made.problem.snes.setTolerances(max_it=kept)
    after = made.scene.u.x.array, made.contact.history.function.x.array
    assert all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))
    for m in (made, twin):
        walk(m, path=PATH[2:])
    assert_same(fields(made), fields(twin))


def test_an_indefinite_bulk():
    """A bulk that gives way: neither K nor S is definite, and all is as on all unknowns."""
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
        results.append({"u": owned(scene.u).copy(), "pressure": contact.pressure})
    assert_same(*results)


# ---- the choice ----------------------------------------------------------------------------------


def test_the_choice(caplog):
    """By default for a linear bulk; it is logged; True where it cannot be raises."""
    scene = block("triangle", n=4, up=-1.0)
    law = fc.Frictionless(k_n=5e3)
    with caplog.at_level(logging.INFO, logger="fenics_contact"):
        problem, contact = scene.problem(law, scene.rollers())
    assert problem.solver.condensed
    if COMM.rank == 0:
        said = "static condensation onto 10 of 50"
        assert any(said in record.getMessage() for record in caplog.records)
    assert not scene.problem(law, scene.rollers(), condensation=False)[0].solver.condensed

    def condensed(F, contacts, **options):
        return fc.ContactProblem(
            F, scene.u, bcs=scene.rollers(), contacts=contacts, condensation=True, **options
        )

    options = PETSc.Options().getAll()

    def without_contact():
        bcs = [scene.hold(LEFT, i) for i in range(2)]
        fc.ContactProblem(scene.F, scene.u, bcs=bcs, condensation=True)

    raised_everywhere(without_contact, ValueError, "condensation", "no contact")
    F = kirchhoff(scene)
    raised_everywhere(lambda: condensed(F, [contact]), ValueError, "condensation", "not linear")
    given = {"pc_type": "lu"}
    raised_everywhere(
        lambda: condensed(scene.F, [contact], petsc_options=given), ValueError, "pc_type"
    )
    assert PETSc.Options().getAll() == options


def test_what_is_worth_it():
    """Small surfaces, and large ones of large bodies; not the whole of a body, nor gigabytes."""
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
def test_a_nonlinear_bulk_is_not_condensed():
    """By default it iterates on all unknowns and says why."""
    scene = block("quadrilateral", up=-1.0)
    scene.F = kirchhoff(scene)
    problem, _ = scene.problem(fc.Frictionless(k_n=5e4), scene.rollers())
    assert not problem.solver.condensed
    problem.solve()
