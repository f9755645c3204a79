"""PETSc options by arguments and by the database; user-written solvers and methods."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from fenics_contact.methods.method import SolverContext, StandaloneMethod
from fenics_contact.methods.solver import METHODS
from scenes.block_on_ball import PATH, BlockOnBall, have_equal_states, loaded_block, solve_path
from scenes.blocks import TOP
from scenes.comparison import (
    assert_raised_on_all_ranks,
    gather,
    is_close,
    nodal_values,
    point_values,
)

pytestmark = [
    pytest.mark.newest,
    pytest.mark.two_ranks,
    pytest.mark.timeout(240),
]
COMM = MPI.COMM_WORLD


# ---- options -------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_options_reach_the_solver(method):
    """Options set the tolerance and the iteration limit, and do not remain in the database."""
    database = PETSc.Options()
    before = database.getAll()
    setup = BlockOnBall(method=method, petsc_options={"snes_max_it": 1, "snes_rtol": 1e-5})
    assert database.getAll() == before
    assert setup.problem.snes.getTolerances()[0] == 1e-5
    setup.set_top_displacement(0.02, 0.05)
    with pytest.raises(fc.NotConverged) as caught:
        setup.problem.solve()
    assert caught.value.iterations == 1


def test_options_database_overrides_arguments():
    """Options in the database under the prefix override the arguments, and remain there."""
    database = PETSc.Options()
    key = "mine_snes_max_it"
    database.setValue(key, 1)
    try:
        before = database.getAll()
        setup = BlockOnBall(petsc_options={"snes_max_it": 500}, prefix="mine_")
        assert database.getAll() == before
        setup.set_top_displacement(0.02, 0.05)
        with pytest.raises(fc.NotConverged) as caught:
            setup.problem.solve()
        assert caught.value.iterations == 1
    finally:
        database.delValue(key)


def test_options_database_changes_the_method():
    """``<prefix>snes_type`` and the linear solver can be chosen in the options database."""
    database = PETSc.Options()
    entries = {"other_snes_type": "newtonls", "other_tangent_pc_factor_mat_solver_type": "petsc"}
    if COMM.size > 1:  # PETSc's own factorisation is serial
        entries.popitem()
    for key, value in entries.items():
        database.setValue(key, value)
    try:
        setup = BlockOnBall(prefix="other_")
    finally:
        for key in entries:
            database.delValue(key)
    assert setup.problem.snes.getType() == "newtonls"
    setup.set_top_displacement(*PATH[0])
    setup.problem.solve()
    if COMM.size == 1:
        assert setup.problem.snes.getKSP().getPC().getFactorSolverType() == "petsc"


def test_two_prefixes_are_independent():
    """Two problems with different prefixes each use their own options."""
    database = PETSc.Options()
    before = database.getAll()
    short = BlockOnBall(prefix="short_", petsc_options={"snes_max_it": 3})
    long = BlockOnBall(prefix="long_")
    assert database.getAll() == before
    for setup in (short, long):
        setup.set_top_displacement(0.02, 0.03)
    with pytest.raises(fc.NotConverged):
        short.problem.solve()
    step = long.problem.solve()
    assert step.iterations > 3
    assert short.problem.snes.getOptionsPrefix() == "short_"
    assert long.problem.snes.getOptionsPrefix() == "long_"


# ---- user-written solvers ------------------------------------------------------------------------


class OwnNewton:
    """A solver with DOLFINx and petsc4py only: F + contact.form(v), SNES newtonls."""

    def __init__(self, F, contact, u, bcs) -> None:
        """Compile the sum of bulk and contact forms, and create the SNES."""
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
        """Copy x to u, and update its ghosts."""
        x.copy(self.u.x.petsc_vec)
        self.u.x.scatter_forward()

    def residual(self, snes, x, b) -> None:
        """Assemble the residual with Dirichlet conditions, as in DOLFINx's demos."""
        self.set_u(x)
        with b.localForm() as local:
            local.set(0.0)
        fem.petsc.assemble_vector(b, self.F)
        fem.petsc.apply_lifting(b, [self.J], [self.bcs], x0=[self.u.x.petsc_vec], alpha=-1.0)
        b.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
        fem.petsc.set_bc(b, self.bcs, self.u.x.petsc_vec, alpha=-1.0)

    def jacobian(self, snes, x, J, P) -> None:
        """Assemble the Jacobian with Dirichlet conditions."""
        self.set_u(x)
        P.zeroEntries()
        fem.petsc.assemble_matrix(P, self.J, bcs=self.bcs)
        P.assemble()

    def solve(self) -> None:
        """Solve with the present u as initial guess."""
        self.u.x.petsc_vec.copy(self.x)
        self.snes.solve(None, self.x)
        assert self.snes.getConvergedReason() > 0
        self.set_u(self.x)


@pytest.mark.parametrize(("cell", "degree"), [("quadrilateral", 1), ("triangle", 2)])
def test_user_written_newton_solver_agrees(cell, degree):
    """`contact.form` in a plain SNES with explicit commits agrees with `ContactProblem`.

    Tolerances over the whole path, relative to the largest value: 1e-8 for u, 1e-7 for tractions
    and slip. `ContactProblem` is solved to 1e-11 of the forces.
    """
    setup = BlockOnBall(cell=cell, degree=degree, petsc_options={"snes_rtol": 1e-11})
    own_newton = BlockOnBall(cell=cell, degree=degree)
    scene = own_newton.scene
    bcs = [scene.dirichlet_bc(TOP, i, c) for i, c in enumerate(own_newton.push)]
    newton = OwnNewton(scene.F, own_newton.contact, scene.u, bcs)
    for side, down in PATH:
        setup.set_top_displacement(side, down)
        setup.problem.solve()
        setup.problem.commit()
        own_newton.set_top_displacement(side, down)
        newton.solve()
        own_newton.contact.commit()
        for name in ("traction", "slip"):
            a, b = (point_values(m.contact, getattr(m.contact, name)) for m in (own_newton, setup))
            assert is_close(a, b, 1e-7, scale=max(np.abs(b).max(), 1e-3)), (name, side, down)
        a, b = (nodal_values(m.scene.u) for m in (own_newton, setup))
        assert is_close(a, b, 1e-8), (side, down)
    assert gather(COMM, setup.contact.slip).max() > 1e-3
    for thing in (newton.matrix, newton.vector, newton.x, newton.snes):
        thing.destroy()


@pytest.mark.whole
@pytest.mark.parametrize("condensation", [None, False])
@pytest.mark.parametrize("kind", ["newtontr", "newtontrdc", "ngmres", "anderson", "ncg"])
def test_supported_snes_types_agree(kind, condensation):
    """Other types of SNES reach the state of the default type after three increments.

    Both are solved to 1e-9 of the forces; the states agree to 1e-6.
    """
    setup, usual = (
        BlockOnBall(method="newton", condensation=condensation, petsc_options=options)
        for options in ({"snes_type": kind}, {})
    )
    for one in (setup, usual):
        solve_path(one, path=PATH[:3])
    assert setup.problem.snes.getType() == kind
    assert have_equal_states(setup, usual, 1e-6)


@pytest.mark.whole
@pytest.mark.parametrize("kind", ["vinewtonrsls", "fas", "newton", "ksponly"])
def test_unsupported_snes_types_are_refused(kind):
    """Types of SNES that require bounds or a hierarchy, or that do not exist, are refused."""
    assert_raised_on_all_ranks(
        lambda: BlockOnBall(petsc_options={"snes_type": kind}),
        ValueError,
        "snes_type",
        kind,
        "newtonls",
    )


class Plain(StandaloneMethod):
    """Newton's method without a line search, as a minimal user-defined method."""

    def __init__(self, context: SolverContext) -> None:
        """Create one SNES."""
        options = {"snes_linesearch_type": "basic", "snes_max_it": 50}
        self._newton = context.newton("plain_", options)

    def solve(self) -> tuple[int, int]:
        """Solve with the consistent tangent; return what the SNES returns (`Method.solve`)."""
        self._newton.attach(consistent=True)
        return self._newton.solve()


@pytest.mark.parametrize("condensation", [True, False])
def test_user_defined_method_agrees(monkeypatch, condensation):
    """A class registered by name in `METHODS` reaches the state of the package's Newton's method.

    Both are solved to 1e-9 of the forces; the states agree to 1e-6.
    """
    monkeypatch.setitem(METHODS, "plain", Plain)
    law, states = fc.Coulomb(0.3, k_n=2e3, k_t=1e3), []
    for method in ("plain", "newton"):
        scene, problem, _ = loaded_block(
            "quadrilateral", law, method, n=3, condensation=condensation
        )
        step = problem.solve()
        assert (step.method, step.verdict.failures) == (method, [])
        states.append(nodal_values(scene.u))
    assert is_close(*states, 1e-6)
