"""Options of PETSc, by arguments and by the database; a solver or a method of one's own."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from fenics_contact.methods.method import SolverContext, StandaloneMethod
from fenics_contact.methods.solver import METHODS
from scenes.blocks import TOP
from scenes.comparing import at_points, close, gathered, nodal, raised_everywhere
from scenes.rubbing import PATH, Rub, pressed, same_states, walk

pytestmark = [
    pytest.mark.newest,
    pytest.mark.two_ranks,
    pytest.mark.timeout(240),
]
COMM = MPI.COMM_WORLD


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


@pytest.mark.whole
@pytest.mark.parametrize("condensation", [None, False])
@pytest.mark.parametrize("kind", ["newtontr", "newtontrdc", "ngmres", "anderson", "ncg"])
def test_types_of_snes_that_work(kind, condensation):
    """Three increments, begun where the last one ended: the state of the package's own choice.

    Both to 1e-9 of the forces: states agree to 1e-6.
    """
    made, usual = (
        Rub(method="newton", condensation=condensation, petsc_options=options)
        for options in ({"snes_type": kind}, {})
    )
    for one in (made, usual):
        walk(one, path=PATH[:3])
    assert made.problem.snes.getType() == kind
    assert same_states(made, usual, 1e-6)


@pytest.mark.whole
@pytest.mark.parametrize("kind", ["vinewtonrsls", "fas", "newton", "ksponly"])
def test_types_of_snes_that_cannot_work(kind):
    """Some want bounds or a hierarchy, and without them end the program: refused by name."""
    raised_everywhere(
        lambda: Rub(petsc_options={"snes_type": kind}), ValueError, "snes_type", kind, "newtonls"
    )


class Plain(StandaloneMethod):
    """Newton's method without a line search: all that a new method has to say."""

    def __init__(self, context: SolverContext) -> None:
        """One SNES."""
        options = {"snes_linesearch_type": "basic", "snes_max_it": 50}
        self._newton = context.newton("plain_", options)

    def solve(self) -> tuple[int, int]:
        """See `Method.solve`."""
        self._newton.attach(consistent=True)
        return self._newton.solve()


@pytest.mark.parametrize("condensation", [True, False])
def test_a_method_of_ones_own(monkeypatch, condensation):
    """A class and its name are enough: the state is that of the package's Newton's method.

    Both satisfy the law to 1e-9 of the forces: states agree to 1e-6.
    """
    monkeypatch.setitem(METHODS, "plain", Plain)
    law, states = fc.Coulomb(0.3, k_n=2e3, k_t=1e3), []
    for method in ("plain", "newton"):
        scene, problem, _ = pressed("quadrilateral", law, method, n=3, condensation=condensation)
        step = problem.solve()
        assert (step.method, step.verdict.failures) == (method, [])
        states.append(nodal(scene.u))
    assert close(*states, 1e-6)
