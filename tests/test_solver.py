"""ContactProblem: equilibrium, failures, units, methods, options, ranks, verdict, bulk forms."""

import gc
import logging
import weakref

import dolfinx
import dolfinx.fem.petsc
import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from scenes.blocks import BOTTOM, GRID, RIGHT, TOP, block, kirchhoff, layers
from scenes.comparing import (
    at_points,
    close,
    compiled,
    gathered,
    identical,
    nodal,
    owned,
    same_field,
)
from scenes.elasticity import strain
from scenes.rubbing import PATH, Rub, snapshot, walk

pytestmark = [pytest.mark.mpi, pytest.mark.timeout(240)]
COMM = MPI.COMM_WORLD

# Solver tolerances for comparisons finer than the default of 1e-9 of the forces.
TIGHT = {"snes_rtol": 1e-13}


# ---- equilibrium and patch tests -----------------------------------------------------------------


@pytest.mark.parametrize(("cell", "degree"), GRID)
def test_patch(cell, degree):
    """Uniform compression on a shuffled mesh: stress uniform, penetration p/k_n everywhere.

    Reference: Hooke's law in plane strain or space, u_n = p/k_n exactly (references, 6). Tolerance
    1e-10 of the fields: round-off of the solve, the solver's own being 1e-13 of the forces.
    """
    p, k_n = 2.0, 5e3
    scene = block(cell, degree, up=-p, shuffled=True)
    E, nu = 1000.0, 0.3
    problem, contact = scene.problem(fc.Frictionless(k_n=k_n), scene.rollers(), petsc_options=TIGHT)
    step = problem.solve()
    if scene.dim == 2:
        down, side = p * (1 - nu**2) / E, p * nu * (1 + nu) / E
    else:
        down, side = p / E, p * nu / E

    def exact(x):
        return np.vstack([side * x[i] for i in range(scene.dim - 1)] + [-down * x[scene.dim - 1]])

    up = np.zeros((scene.dim, 1))
    up[-1] = p / k_n
    assert same_field(scene.u, lambda x: exact(x) - up, 1e-10)
    pressure = gathered(COMM, contact.pressure)
    assert close(pressure, np.full(len(pressure), p), 1e-10)
    resultants = step.contacts["contact"]
    assert close(resultants.force, -scene.vector(up=-p), 1e-10)
    assert resultants.area == pytest.approx(1.0, rel=1e-12)
    assert resultants.open == resultants.stick == 0
    assert not step.verdict.failures


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
def test_forces_balance_on_the_whole_path(method):
    """Contact force = minus the reaction of the held top, from the bulk form alone; cone, status.

    Reference: the sum of the bulk residual over the top's dofs. Tolerance 1e-7 of the force: a
    hundred times the solver's, which bounds the norm and not the sum.
    """
    made = Rub(method=method)
    space = made.scene.u.function_space
    bulk = compiled(made.scene.F)
    seen = np.zeros(3, dtype=int)
    for side, down in PATH:
        made.move(side, down)
        step = made.problem.solve()
        r = step.contacts["contact"]
        reaction = fem.Function(space)
        fem.assemble_vector(reaction.x.array, bulk)
        reaction.x.scatter_reverse(dolfinx.la.InsertMode.add)
        dofs = made.scene.facet_dofs(TOP)
        n_owned = space.dofmap.index_map.size_local
        values = reaction.x.array.reshape(-1, 2)[dofs[dofs < n_owned]]
        total = COMM.allreduce(values.sum(axis=0))
        assert close(r.force, -total, 1e-7)
        assert r.tangential_force <= 0.3 * r.normal_force * (1 + 1e-10)
        seen += [r.open, r.stick, r.slip]
        made.problem.commit()
        assert made.problem.increment == step.increment
    assert np.all(seen > 0)


# ---- failure leaves no trace ---------------------------------------------------------------------


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_failed_increment_leaves_no_trace(method):
    """An increment stopped after one iteration raises, and u and history are as before to the bit.

    Then it goes on from there: the problem that failed is solved at once under the conditions of
    the last commit; and another on the same u and contact makes the increment, with the result of
    one that never failed. 1e-12: the very same computation, but for sums over ranks.
    """
    made, twin = Rub(method=method), Rub(method=method)
    scene, contact = made.scene, made.contact
    bcs = [scene.hold(TOP, i, c) for i, c in enumerate(made.push)]
    limited = fc.ContactProblem(
        scene.F,
        scene.u,
        bcs=bcs,
        contacts=[contact],
        method=method,
        petsc_options={"snes_max_it": 1},
        prefix="limited_",
    )
    for m in (made, twin):
        walk(m, path=PATH[:2])
    before = snapshot(made)
    made.move(*PATH[2])
    for _ in range(2):  # and a second time, from a solver that has failed
        with pytest.raises(fc.NotConverged) as caught:
            limited.solve()
        error = caught.value
        assert error.increment == 1
        assert error.reason == PETSc.SNES.ConvergedReason.DIVERGED_MAX_IT
        assert error.iterations == 1
        assert "increment 1" in str(error) and "1 iterations" in str(error)
        assert error.verdict.failures
        assert identical(snapshot(made), before)
        assert limited.increment == 0
    made.move(*PATH[1])
    assert limited.solve().iterations == 0
    scene.u.x.array[:] = before[0]
    for m in (made, twin):
        walk(m, path=PATH[2:])
    assert close(nodal(scene.u), nodal(twin.scene.u), 1e-12)
    rows = (at_points(m.contact, m.contact.history.rows()) for m in (made, twin))
    assert close(*rows, 1e-12)


def test_increments_restores_the_load():
    """`increments` that fails: load, u and history are those of the last committed increment."""
    made = Rub(method="newton")
    steps = fc.increments(made.problem, made.push[1], 0.0, -0.03, steps=3)
    done = []
    before = snapshot(made)
    with pytest.raises(fc.NotConverged):
        for step in steps:
            done.append(step.load)
            before = snapshot(made)
            if len(done) == 2:
                made.push[0].value = 0.02
                made.problem.snes.setTolerances(max_it=1)
    assert done == pytest.approx([-0.01, -0.02], rel=1e-14)
    assert float(made.push[1].value) == done[-1]
    assert identical(snapshot(made), before)
    assert made.problem.increment == 2


def test_increments_lead_the_load():
    """Loads in equal steps up to the end, each solved and committed, numbered from 1."""
    made = Rub(fc.Frictionless(k_n=2e4))
    steps = list(fc.increments(made.problem, made.push[1], 0.0, -0.02, steps=4))
    assert [s.load for s in steps] == pytest.approx([-0.005, -0.01, -0.015, -0.02], rel=1e-14)
    assert [s.increment for s in steps] == [1, 2, 3, 4]
    forces = [s.contacts["contact"].normal_force for s in steps]
    assert np.all(np.diff(forces) > 0)
    assert "increment 4" in steps[-1].summary() and "-0.02" in steps[-1].summary()


@pytest.mark.parametrize("lift", [0.0, 1e-3])
def test_summary_without_forces(lift):
    """Before anything touches there is no force that the residual could be a share of."""
    scene = block("quadrilateral")
    problem, _ = scene.problem(
        fc.Coulomb(0.3, 1e4, 1e4),
        [*scene.rollers(), scene.hold(TOP, scene.dim - 1, lift)],
        contact={"gap": 0.1},
    )
    step = problem.solve()
    assert "friction ∫|τ| 0," in step.summary()
    assert ("no forces" in step.summary()) == (step.verdict.force == 0.0)
    assert "reason" not in step.summary()
    problem.commit()
    assert "solved by its first guess" in problem.solve().summary()


def test_why_all_unknowns_is_said_once(caplog):
    """`increments` asks again whether to condense; the log has no news to tell."""
    with caplog.at_level("INFO", logger="fenics_contact"):
        made = Rub(condensation=False)
        list(fc.increments(made.problem, made.push[1], 0.0, -0.01, steps=2))
    said = [r.message for r in caplog.records if "iterating on all unknowns" in r.message]
    assert len(said) == (COMM.rank == 0)


# ---- pairs and factorisations --------------------------------------------------------------------


def recorded(made: Rub) -> list[float]:
    """Norms of the residual as SNES goes, from now on."""
    norms: list[float] = []
    made.problem.snes.setMonitor(lambda snes, it, norm: norms.append(norm))
    return norms


def test_pairs_do_not_outlive_an_increment():
    """The same increment from the same state takes the same iterations, whatever was solved before.

    Frictionless, so that there is no history, and short enough that H₀ is never made anew: the
    second run differs from the first by the pairs of L-BFGS alone, if any were kept. Residual norms
    of every iteration agree to 1e-9: round-off of a sum over ranks, grown over some iterations.
    """
    made = Rub(fc.Frictionless(k_n=1e3), method="lbfgs")
    runs = []
    for number, (side, down) in enumerate([(0.0, 0.05), (0.01, 0.02), (0.0, 0.05)]):
        made.scene.u.x.array[:] = 0.0
        made.move(side, down)
        norms = recorded(made)
        step = made.problem.solve()
        made.problem.snes.cancelMonitor()
        assert step.factorisations == (number == 0)  # else H₀ differs too
        runs.append((step.iterations, np.array(norms), gathered(COMM, owned(made.scene.u))))
    first, _, again = runs
    assert first[0] == again[0] > 3
    assert first[1].shape == again[1].shape
    assert np.all(np.abs(again[1] - first[1]) <= 1e-9 * first[1][0])
    assert close(again[2], first[2], 1e-12)


def test_factorisation_is_kept():
    """Increments that need no refresh of H₀ use the factorisation there is; a new E does not."""
    made = Rub(fc.Frictionless(k_n=1e3))
    made.move(0.0, 0.05)
    assert made.problem.solve().factorisations == 1
    made.problem.commit()
    for down in (0.055, 0.06, 0.065):
        made.move(0.0, down)
        assert made.problem.solve().factorisations == 0
        made.problem.commit()
    made.scene.E.value *= 2
    stiffer = made.problem.solve()
    assert stiffer.factorisations >= 1
    # The change got through: a stiffer body is pushed harder against the same cushion.
    made.problem.commit()
    made.scene.E.value /= 2
    softer = made.problem.solve()
    assert stiffer.contacts["contact"].normal_force > softer.contacts["contact"].normal_force


def test_modulus_changed_between_increments():
    """The patch after a change of E: u of the new modulus, 1e-10 as in `test_patch`."""
    scene = block("quadrilateral", up=-2.0, nu=0.0)
    problem, _ = scene.problem(fc.Frictionless(k_n=5e3), scene.rollers(), petsc_options=TIGHT)
    for E in (1000.0, 250.0):
        scene.E.value = E
        problem.solve()
        problem.commit()
        assert same_field(
            scene.u, lambda x, E=E: np.vstack([0 * x[0], -2.0 / 5e3 - 2.0 / E * x[1]]), 1e-10
        )


def test_solving_twice_changes_nothing():
    """A converged increment solved again takes no iteration and leaves u as it is.

    Without commit the history is the same, so the state is a solution already.
    """
    made = Rub()
    walk(made, path=PATH[:2])
    made.move(*PATH[2])
    made.problem.solve()
    before = gathered(COMM, owned(made.scene.u))
    step = made.problem.solve()
    assert step.iterations == 0
    # Through the dimensionless solution and back: round-off.
    assert close(gathered(COMM, owned(made.scene.u)), before, 1e-14)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_a_held_load(method):
    """Increments in which nothing changes take no iteration and add no slip, at every stage.

    Round-off only: 1e-12 of the accumulated slip, which is of size 0.01.
    """
    made = Rub(method=method)
    for move in PATH:
        walk(made, path=[move])
        before = gathered(COMM, made.contact.slip)
        step = made.problem.solve()
        made.problem.commit()
        assert step.iterations == 0
        assert close(gathered(COMM, made.contact.slip), before, 1e-12, scale=0.01)


# ---- methods, units, ranks -----------------------------------------------------------------------


@pytest.mark.parametrize(("cell", "degree"), [("quadrilateral", 1), ("triangle", 2)])
def test_methods_agree(cell, degree):
    """L-BFGS and Newton end every increment of the path in the same state.

    1e-7 of the largest value: both are solved to 1e-9 of the forces, and the path adds up.
    """
    fields = []
    for method in ("lbfgs", "newton"):
        made = Rub(cell=cell, degree=degree, method=method)
        walk(made)
        contact = made.contact
        rows = (at_points(contact, x) for x in (contact.traction, contact.slip))
        fields.append((nodal(made.scene.u), *rows))
    for a, b in zip(*fields, strict=True):
        assert close(a, b, 1e-7)
    assert np.abs(fields[0][2]).max() > 1e-3


@pytest.mark.parametrize("law", ["coulomb", "frictionless"])
@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_units_do_not_matter(method, law):
    """The same scene in N-mm, in SI and by factors of 1e-9: same iterations, same digits.

    Stiffnesses by `Scaled`, so that the measured E/h is in it too. Tolerance 1e-9 of the fields:
    the same iterations, with the round-off of other numbers.
    """
    make = {"coulomb": fc.Coulomb(0.3), "frictionless": fc.Frictionless()}[law]
    path = PATH[:4] if law == "coulomb" else PATH[:1]
    results = []
    for length, pressure in [(1.0, 1.0), (1e-3, 1e6), (1e-9, 1.0), (1.0, 1e-9), (1e-9, 1e9)]:
        made = Rub(make, length=length, pressure=pressure, method=method)
        steps = walk(made, length, path)
        results.append(
            (
                [s.iterations for s in steps],
                nodal(made.scene.u) / length,
                at_points(made.contact, made.contact.traction) / pressure,
            )
        )
    for iterations, u, traction in results[1:]:
        assert iterations == results[0][0]
        assert close(u, results[0][1], 1e-9)
        assert close(traction, results[0][2], 1e-9)


MESHES = {
    "triangle": {},
    "hexahedron": {"n": 2},
    # Γc on the first rank alone.
    "quadrilateral": {"n": (1, 6), "partitioner": layers("quadrilateral")},
}


@pytest.mark.parametrize("cell", MESHES)
def test_any_number_of_ranks(cell):
    """Resultants of the path on all ranks and on one alone, solved by each rank for itself.

    1e-8 of the largest force: ten times the solver's tolerance.
    """
    resultants = []
    for comm in (COMM, MPI.COMM_SELF):
        made = Rub(cell=cell, mesh=MESHES[cell] | {"comm": comm})
        steps = walk(made, path=PATH[1:5])
        resultants.append([s.contacts["contact"] for s in steps])
    for together, alone in zip(*resultants, strict=True):
        size = alone.normal_force
        assert close(together.force, alone.force, 1e-8, scale=size)
        assert abs(together.normal_force - alone.normal_force) <= 1e-8 * size
        assert abs(together.tangential_force - alone.tangential_force) <= 1e-8 * size
        assert together.max_pressure == pytest.approx(alone.max_pressure, rel=1e-7)
        counts = [(r.open, r.stick, r.slip) for r in (together, alone)]
        assert counts[0] == counts[1]
        assert together.area == pytest.approx(alone.area, rel=1e-12)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_ranks_without_cells(method):
    """One single cell: all ranks but one have nothing at all. Its load arrives; 1e-8, as above."""
    scene = block("quadrilateral", n=1, up=-1.0)
    assert COMM.allreduce(scene.mesh.topology.index_map(2).size_local) == 1
    problem, contact = scene.problem(fc.Coulomb(0.3), scene.rollers(), method=method)
    for side in (0.0, -0.05):
        scene.load(side=side, up=-1.0)
        step = problem.solve()
        problem.commit()
        assert step.contacts["contact"].normal_force == pytest.approx(1.0, rel=1e-8)
    assert np.all(gathered(COMM, contact.pressure) > 0)


# ---- options -------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_options_reach_the_solver(method):
    """A number of iterations given as an option is the limit; the database is clean afterwards."""
    database = PETSc.Options()
    before = database.getAll()
    made = Rub(method=method, petsc_options={"snes_max_it": 1, "snes_rtol": 1e-5})
    assert database.getAll() == before
    assert made.problem.snes.getTolerances()[0] == 1e-5
    made.move(0.02, 0.05)
    with pytest.raises(fc.NotConverged) as caught:
        made.problem.solve()
    assert caught.value.iterations == 1


def test_options_database_wins():
    """What stands in the database under the prefix wins over the arguments, and stays there."""
    database = PETSc.Options()
    key = "mine_snes_max_it"
    database.setValue(key, 1)
    try:
        before = database.getAll()
        made = Rub(petsc_options={"snes_max_it": 500}, prefix="mine_")
        assert database.getAll() == before
        made.move(0.02, 0.05)
        with pytest.raises(fc.NotConverged) as caught:
            made.problem.solve()
        assert caught.value.iterations == 1
    finally:
        database.delValue(key)


def test_options_database_changes_the_method():
    """``<prefix>snes_type`` and the type of the linear solver are the caller's if he wants."""
    database = PETSc.Options()
    given = {"other_snes_type": "newtonls", "other_tangent_pc_factor_mat_solver_type": "petsc"}
    if COMM.size > 1:  # PETSc's own factorisation is serial
        given.popitem()
    for key, value in given.items():
        database.setValue(key, value)
    try:
        made = Rub(prefix="other_")
    finally:
        for key in given:
            database.delValue(key)
    assert made.problem.snes.getType() == "newtonls"
    made.move(*PATH[0])
    made.problem.solve()
    if COMM.size == 1:
        assert made.problem.snes.getKSP().getPC().getFactorSolverType() == "petsc"


def test_two_prefixes_do_not_disturb_one_another():
    """Two problems with options of their own, made one after the other and used in turn."""
    database = PETSc.Options()
    before = database.getAll()
    short = Rub(prefix="short_", petsc_options={"snes_max_it": 3})
    long = Rub(prefix="long_")
    assert database.getAll() == before
    for made in (short, long):
        made.move(0.02, 0.03)
    with pytest.raises(fc.NotConverged):
        short.problem.solve()
    step = long.problem.solve()
    assert step.iterations > 3
    assert short.problem.snes.getOptionsPrefix() == "short_"
    assert long.problem.snes.getOptionsPrefix() == "long_"


# ---- a solver of one's own -----------------------------------------------------------------------


class OwnNewton:
    """What a user writes with DOLFINx and petsc4py alone: F + contact.form(v), SNES newtonls."""

    def __init__(self, F, contact, u, bcs) -> None:
        """Compile the sum of bulk and contact."""
        v = ufl.TestFunction(u.function_space)
        du = ufl.TrialFunction(u.function_space)
        total = F + contact.form(v)
        self.u, self.bcs = u, bcs
        self.F = fem.form(total, entity_maps=contact.entity_maps)
        self.J = fem.form(ufl.derivative(total, u, du), entity_maps=contact.entity_maps)
        self.matrix = fem.petsc.create_matrix(self.J)
        self.vector = u.x.petsc_vec.duplicate()
        self.x = u.x.petsc_vec.duplicate()
        self.snes = PETSc.SNES().create(u.function_space.mesh.comm)
        self.snes.setType("newtonls")
        self.snes.setOptionsPrefix("own_")
        PETSc.Options().setValue("own_snes_linesearch_type", "basic")
        self.snes.setFromOptions()
        PETSc.Options().delValue("own_snes_linesearch_type")
        self.snes.setFunction(self.residual, self.vector)
        self.snes.setJacobian(self.jacobian, self.matrix)
        self.snes.setTolerances(rtol=1e-12, atol=1e-11, stol=0.0, max_it=60)
        self.snes.getKSP().setType("preonly")
        self.snes.getKSP().getPC().setType("lu")
        self.snes.getKSP().getPC().setFactorSolverType("mumps")

    def set_u(self, x) -> None:
        """Ghosts included."""
        x.copy(self.u.x.petsc_vec)
        self.u.x.scatter_forward()

    def residual(self, snes, x, b) -> None:
        """With Dirichlet conditions, as in DOLFINx's demos."""
        self.set_u(x)
        with b.localForm() as local:
            local.set(0.0)
        fem.petsc.assemble_vector(b, self.F)
        fem.petsc.apply_lifting(b, [self.J], [self.bcs], x0=[self.u.x.petsc_vec], alpha=-1.0)
        b.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
        fem.petsc.set_bc(b, self.bcs, self.u.x.petsc_vec, alpha=-1.0)

    def jacobian(self, snes, x, J, P) -> None:
        """Likewise."""
        self.set_u(x)
        P.zeroEntries()
        fem.petsc.assemble_matrix(P, self.J, bcs=self.bcs)
        P.assemble()

    def solve(self) -> None:
        """From the present u."""
        self.u.x.petsc_vec.copy(self.x)
        self.snes.solve(None, self.x)
        assert self.snes.getConvergedReason() > 0
        self.set_u(self.x)


@pytest.mark.parametrize(("cell", "degree"), [("quadrilateral", 1), ("triangle", 2)])
def test_a_solver_of_ones_own(cell, degree):
    """`contact.form` in a plain SNES, commits by hand: the same u and slip as `ContactProblem`.

    1e-8 of the largest value over the whole path: ContactProblem to 1e-11 of the forces.
    """
    made = Rub(cell=cell, degree=degree, petsc_options={"snes_rtol": 1e-11})
    mine = Rub(cell=cell, degree=degree)
    scene = mine.scene
    bcs = [scene.hold(TOP, i, c) for i, c in enumerate(mine.push)]
    own = OwnNewton(scene.F, mine.contact, scene.u, bcs)
    for side, down in PATH:
        made.move(side, down)
        made.problem.solve()
        made.problem.commit()
        mine.move(side, down)
        own.solve()
        mine.contact.commit()
        for name in ("traction", "slip"):
            a, b = (at_points(m.contact, getattr(m.contact, name)) for m in (mine, made))
            assert close(a, b, 1e-7, scale=max(np.abs(b).max(), 1e-3)), (name, side, down)
        a, b = (nodal(m.scene.u) for m in (mine, made))
        assert close(a, b, 1e-8), (side, down)
    assert gathered(COMM, made.contact.slip).max() > 1e-3
    for thing in (own.matrix, own.vector, own.x, own.snes):
        thing.destroy()


# ---- the verdict ---------------------------------------------------------------------------------


class Changed(fc.Coulomb):
    """Coulomb's law with a response that breaks what it claims."""

    def __init__(self, what: str) -> None:
        """``what``: the claim to break."""
        super().__init__(0.3, k_n=2e4, k_t=1e4)
        object.__setattr__(self, "what", what)

    def parameters(self):
        """Those of Coulomb's law."""
        return {"friction": self.friction, "k_n": self.k_n, "k_t": self.k_t}

    def response(self, kinematics, parameters):
        """Coulomb's, with one entry changed."""
        r = super().response(kinematics, parameters)
        parts = {name: getattr(r, name) for name in r.__dataclass_fields__}
        if self.what == "cone":
            parts["traction"] = 1.01 * r.traction
        elif self.what == "limit":
            parts["limit"] = 0.99 * r.limit
        elif self.what == "stiffness":
            parts["normal_traction"] = 1.01 * r.normal_traction
        elif self.what == "adhesion":
            parts["normal_traction"] = r.normal_traction + parameters["k_n"] * r.opening
        elif self.what == "penetration":
            parts["penetration"] = r.penetration + 1e-4
        elif self.what == "slip":
            parts["slip"] = tuple(2 * s for s in r.slip)
        elif self.what == "direction":
            parts["traction"] = -r.traction
        return fc.Response(**parts)


def test_the_changed_law_is_sound_when_nothing_is_changed():
    """The same law with nothing broken passes: what fails below fails for its fault."""
    made = Rub(Changed("nothing"), method="newton")
    steps = walk(made, path=PATH[:3])
    assert steps[-1].contacts["contact"].slip > 0
    assert not any(s.verdict.failures for s in steps)


@pytest.mark.parametrize(
    "what", ["cone", "limit", "stiffness", "adhesion", "penetration", "slip", "direction"]
)
def test_a_law_that_lies_is_caught(what):
    """Reactions that break the cone, complementarity or the flow rule do not pass as a solution."""
    made = Rub(Changed(what), method="newton")
    before = snapshot(made)
    with pytest.raises(fc.NotConverged) as caught:
        walk(made, path=[PATH[2]])
    failures = "; ".join(caught.value.verdict.failures)
    assert "contact:" in failures, failures
    assert failures in str(caught.value)
    assert identical(snapshot(made), before)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize("factor", [0.9, 1.0 + 1e-4])
def test_a_wrong_contact_residual_is_caught(method, factor, monkeypatch):
    """A contact residual that is not the integral of the tractions: forces do not balance."""
    made = Rub(method=method)
    right = fc.ContactOperator.add_force

    def wrong(self, residual, traction=None):
        before = residual.copy()
        right(self, residual, traction)
        residual.axpby(1.0 - factor, factor, before)
        before.destroy()

    monkeypatch.setattr(fc.ContactOperator, "add_force", wrong)
    made.move(*PATH[1])
    with pytest.raises(fc.NotConverged) as caught:
        made.problem.solve()
    assert any("balance" in f for f in caught.value.verdict.failures)


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_forces_at_wrong_places_are_caught(cell, monkeypatch):
    """Forces of the right sum, each acting where another point of Γc is: moments do not balance."""
    made = Rub(cell=cell)
    right, contact = fc.ContactOperator.add_force, made.contact

    def wrong(self, residual, traction=None):
        contact.evaluate()
        force = contact.measure[:, None] * contact.traction
        right(self, residual, np.roll(force, 1, axis=0) / contact.measure[:, None])

    monkeypatch.setattr(fc.ContactOperator, "add_force", wrong)
    made.move(*PATH[1])
    with pytest.raises(fc.NotConverged) as caught:
        made.problem.solve()
    assert any("moments" in f for f in caught.value.verdict.failures)


@pytest.mark.parametrize("condensation", [None, False])
@pytest.mark.parametrize("factor", [1.0, 1.0 + 1e-9])
def test_forces_by_a_second_route(factor, condensation):
    """A map from u to the points that is wrong by 1e-9 differs from DOLFINx's assembly of the form.

    What the solver, the laws and the sums of forces make of it agrees, within their tolerances.
    """
    made = Rub(second_route=True, condensation=condensation if COMM.size == 1 else None)
    made.contact.pairs.own_map.scale(factor)
    made.move(*PATH[1])
    if factor == 1.0:
        steps = walk(made)
        assert all(step.verdict.routes["contact"].holds() for step in steps)
        assert all(step.verdict.routes["contact"].force > 0 for step in steps)
        return
    with pytest.raises(fc.NotConverged) as caught:
        made.problem.solve()
    assert [f for f in caught.value.verdict.failures if "DOLFINx assembles" in f]
    assert len(caught.value.verdict.failures) == 1


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_a_premature_end_is_caught(method, monkeypatch):
    """SNES that claims convergence at its first look is not believed; the state is as before."""
    made = Rub(method=method, fallback=False)
    walk(made, path=PATH[:1])
    before = snapshot(made)
    made.move(*PATH[2])
    claimed = PETSc.SNES.ConvergedReason.CONVERGED_FNORM_ABS
    monkeypatch.setattr(made.problem.solver.main, "converged", lambda: claimed)
    with pytest.raises(fc.NotConverged) as caught:
        made.problem.solve()
    assert any("residual" in f for f in caught.value.verdict.failures)
    assert identical(snapshot(made), before)


def test_the_verdict_of_a_solution():
    """A step carries its verdict: residual within tolerance, laws to 1e-10, forces balanced."""
    made = Rub()
    for step in walk(made):
        verdict = step.verdict
        assert not verdict.failures
        assert 0 < verdict.residual <= 2 * verdict.tolerance <= 1e-8 * verdict.force
        assert verdict.imbalance <= verdict.imbalance_tolerance <= 1e-6 * verdict.force
        assert set(verdict.laws["contact"]) >= {"complementarity", "cone", "slip", "dissipation"}
        assert max(verdict.laws["contact"].values()) <= 1e-10


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


# ---- other laws and settings ---------------------------------------------------------------------


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


# ---- other bulk forms ----------------------------------------------------------------------------


def test_nothing_in_reach():
    """A support out of reach: the problem is linear elasticity, and the contact force is zero."""
    scene = block("triangle", 2)
    push = fem.Constant(scene.mesh, -0.01)
    bcs = [*scene.rollers(), scene.hold(TOP, 1, push)]
    far = fc.HalfSpace((0, -1.0), (0, 1))
    problem, _ = scene.problem(fc.Coulomb(0.3), bcs, contact={"support": far})
    step = problem.solve()
    r = step.contacts["contact"]
    assert r.normal_force == 0.0 and r.area == 0.0 and r.stick == r.slip == 0
    # The block moves as a rigid body, up to the solver's 1e-9.
    assert same_field(scene.u, lambda x: np.vstack([0 * x[0], 0 * x[0] - 0.01]), 1e-8)


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_body_force(cell):
    """A heavy block on the floor: N = weight, and σ = ρ g (1 - y) to the element of degree 2.

    Reference: ν = 0, u_y = -ρg/k_n - ρg (y - y²/2)/E, which the element represents. 1e-9.
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

    assert same_field(scene.u, exact, 1e-9)


def test_condition_on_components():
    """The top pushed down, free to slide: N = d / (H/E' + 1/k_n), E' = E/(1 - ν²). 1e-9."""
    scene = block("quadrilateral", shuffled=True)
    push = fem.Constant(scene.mesh, -0.01)
    bcs = [*scene.rollers(), scene.hold(TOP, 1, push)]
    problem, _ = scene.problem(fc.Frictionless(k_n=5e3), bcs, petsc_options=TIGHT)
    for down in (0.01, 0.02):
        push.value = -down
        step = problem.solve()
        expected = down / ((1 - 0.3**2) / 1000 + 1 / 5e3)
        assert step.contacts["contact"].normal_force == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("kind", ["vector", "function", "component by function"])
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_conditions_of_every_kind(cell, kind):
    """The top displaced as a whole by each of DOLFINx's conditions: N = d / (H/E + 1/k_n), ν = 0.

    On several ranks too, where a condition holds dofs that are another rank's. 1e-9.
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
    """Plane stress of a plate of thickness 0.2, by the form and ``weight``: σ_x = σ_z = 0.

    Reference: u_x = ν p x/E, u_y = -p y/E - p/k_n; N = p · 0.2. 1e-10, as in `test_patch`.
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
    assert same_field(
        scene.u, lambda x: np.vstack([nu * p / E * x[0], -p / E * x[1] - p / k_n]), 1e-10
    )
    # E/h comes from the form, its thickness taken out: within the 10 % that the docstring of
    # `cell_modulus` allows for plane stress; without the weight it would be a fifth.
    law = fc.Frictionless(k_n=fc.Scaled(5.0))
    scene.problem(law, scene.rollers(), contact={"weight": t})
    _, scaled = scene.problem(law, scene.rollers(), contact={"weight": t})
    k = gathered(COMM, scaled.values.parameters["k_n"])
    given = scene.contact(law, modulus=E)
    reference = gathered(COMM, given.values.parameters["k_n"])
    assert np.all(np.abs(k / reference - 1) <= 0.1)
    assert np.array_equal(gathered(COMM, contact.status), np.full(len(k), fc.Status.SLIP))


@pytest.mark.parametrize("degree", [1, 2])
def test_axisymmetric(degree):
    """A cylinder under axial pressure, weight 2πr: σ_z = -p alone; N = p π R².

    Reference: u_r = ν p r/E, u_z = -p z/E - p/k_n, linear. Tolerance 1e-9: the hoop strain u_r/r
    is integrated as a quotient, exact here since it is constant; round-off near the axis.
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
    assert same_field(
        scene.u, lambda x: np.vstack([nu * p / E * x[0], -p / E * x[1] - p / k_n]), 1e-9
    )


@pytest.mark.parametrize("kind", ["function", "ufl"])
def test_variable_modulus(kind):
    """Two layers of moduli 1000 and 4000: u piecewise linear; `Scaled` takes E of the lower one.

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
        fc.Frictionless(k_n=fc.Scaled(5.0)), scene.rollers(), petsc_options=TIGHT
    )
    problem.solve()
    k_n = gathered(COMM, contact.values.parameters["k_n"])
    assert close(k_n, np.full(len(k_n), 5.0 * 1000.0 * 4), 1e-9)

    def exact(x):
        y = x[1]
        layers = np.minimum(y, 0.5) / 1000 + np.maximum(y - 0.5, 0) / 4000
        return np.vstack([0 * y, -p / 2e4 - p * layers])

    assert same_field(scene.u, exact, 1e-9)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_nonlinear_bulk(cell, method):
    """St Venant-Kirchhoff under a dead load of E/10: the stretch solves λ (λ² - 1) E/2 = -p.

    ν = 0, so that the state is uniaxial; the penetration is p/k_n. Reference: the cubic's root by
    numpy. Tolerance 1e-8: the solver's, 1e-11 of the forces, with room for the tangent's condition.
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
    assert not problem.bulk.linear
    for share in (0.5, 1.0):
        scene.load(up=-share * p)
        step = problem.solve()
        problem.commit()
        roots = np.roots([E / 2, 0, -E / 2, share * p])
        stretch = max(r.real for r in roots if abs(r.imag) < 1e-12)
        assert 0.5 < stretch < 1.0
        assert step.contacts["contact"].normal_force == pytest.approx(share * p, rel=1e-8)

        def exact(x, stretch=stretch, share=share):
            rows = [0 * x[0] for _ in range(scene.dim)]
            rows[-1] = (stretch - 1) * x[scene.dim - 1] - share * p / k_n
            return np.vstack(rows)

        assert same_field(scene.u, exact, 1e-8)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_impossible_increment_of_a_nonlinear_body(method):
    """A neo-Hookean block pushed through itself: NotConverged, not NaN; then it goes on.

    Reference for going on: an equal block that never failed; 1e-7 of the largest value.
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
        bcs = [*scene.rollers(), scene.hold(TOP, 1, push)]
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
            assert identical(before, after)
        push.value = -0.02
        step = problem.solve()
        assert step.increment == 2
        results.append((gathered(COMM, owned(scene.u)), gathered(COMM, contact.traction)))
    for a, b in zip(*results, strict=True):
        assert close(a, b, 1e-7)


def test_unsymmetric_bulk():
    """A bulk whose tangent is not symmetric is seen as such and solved: equilibrium.

    An elastic bedding in the bulk, to the side by a share of the settlement. Reference: the
    forces on the whole block sum to zero, 1e-8 of the load.
    """
    scene = block("quadrilateral", up=-1.0)
    v = ufl.TestFunction(scene.u.function_space)
    coupling = fem.Constant(scene.mesh, ((20.0, 15.0), (0.0, 0.0)))
    dx = ufl.dx(scene.mesh)
    scene.F += ufl.dot(coupling * scene.u, v) * dx
    problem, _ = scene.problem(fc.Coulomb(0.4, k_n=1e4, k_t=1e3), [])
    assert problem.bulk.linear and not problem.bulk.symmetric
    step = problem.solve()
    mean = [COMM.allreduce(fem.assemble_scalar(compiled(scene.u[i] * dx))) for i in range(2)]
    bedding = 20.0 * mean[0] + 15.0 * mean[1]
    force = step.contacts["contact"].force
    assert force[1] == pytest.approx(1.0, abs=1e-8)
    assert force[0] == pytest.approx(bedding, abs=1e-8)
    assert abs(bedding) > 1e-4


# ---- messages ------------------------------------------------------------------------------------


def test_silence(caplog):
    """A sound solve logs no warning and prints nothing that the caller did not ask for."""
    with caplog.at_level(logging.WARNING, logger="fenics_contact"):
        made = Rub(fc.Frictionless(k_n=2e4))
        walk(made, path=PATH[:1])
    assert not [r for r in caplog.records if r.name.startswith("fenics_contact")]


def test_a_problem_is_freed_without_the_garbage_collector() -> None:
    """No cycle of references: ranks free their factorisations together, where the name goes."""
    made = Rub()
    made.move(*PATH[1])
    made.problem.solve()
    gc.collect()
    gc.disable()
    try:
        alive = weakref.ref(made.problem)
        made.problem = None
        assert alive() is None
    finally:
        if COMM.size == 1:
            gc.enable()


def test_restore_drops_what_was_not_committed() -> None:
    """A solved increment that is not committed leaves nothing: u and history of the last commit."""
    made = Rub()
    made.move(*PATH[1])
    made.problem.solve()
    made.problem.commit()
    before, u = snapshot(made), made.scene.u.x.array.copy()
    made.move(*PATH[2])
    made.problem.solve()
    assert not np.array_equal(
        gathered(COMM, owned(made.scene.u)), gathered(COMM, u[: len(owned(made.scene.u))])
    )
    made.problem.restore()
    assert identical(snapshot(made), before)
    assert np.array_equal(made.scene.u.x.array, u)


@pytest.mark.parametrize("condensation", [None, False])
def test_newton_after_an_increment_of_no_iterations(condensation):
    """A first increment without load needs no tangent, and leaves none to start the next from."""
    if condensation is None and COMM.size > 1:
        pytest.skip("condensation takes one rank")
    made = Rub(method="newton", condensation=condensation)
    made.move(0.0, 0.0)
    made.scene.u.x.array[:] = 0.0
    first = made.problem.solve()
    made.problem.commit()
    assert first.iterations == 0
    walk(made, path=PATH[:2])


@pytest.mark.parametrize("condensation", [None, False])
def test_newton_starts_where_the_right_points_slip(condensation):
    """Small increments along a path take fewer steps than without the start from the last tangent.

    And lead to the same state: both solve to 1e-9 of the forces, 1e-7 over the path.
    """
    if condensation is None and COMM.size > 1:
        pytest.skip("condensation takes one rank")
    taken, states = [], []
    for helped in (True, False):
        made = Rub(method="newton", condensation=condensation, mesh={"n": 12})
        taken.append(0)
        for i in range(1, 13):
            made.move(0.004 * i, 0.05)
            if not helped:
                made.problem.solver.predicts = False
            taken[-1] += made.problem.solve().iterations
            made.problem.commit()
        assert made.contact.resultants().slip > 0
        states.append(owned(made.scene.u).copy())
    assert taken[0] < 0.8 * taken[1]
    assert close(*states, 1e-7)
