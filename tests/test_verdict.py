"""The verdict on a solution detects errors of laws, forces and their points of application."""

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from fenics_contact.checks.verdict import ForceBalance
from fenics_contact.laws.return_maps import positive_part
from scenes.block_on_ball import PATH, BlockOnBall, copy_state, solve_path
from scenes.comparison import are_identical

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(240)]
COMM = MPI.COMM_WORLD


class Changed(fc.Coulomb):
    """Coulomb's law with one result that violates it."""

    def __init__(self, quantity: str) -> None:
        """Store ``quantity``, the result to change."""
        super().__init__(0.3, k_n=2e4, k_t=1e4)
        object.__setattr__(self, "quantity", quantity)

    def parameters(self):
        """Return the parameters of Coulomb's law."""
        return {"friction": self.friction, "k_n": self.k_n, "k_t": self.k_t}

    def contact_traction(self, kinematics, parameters):
        """Return the traction of Coulomb's law with one entry changed."""
        r = super().contact_traction(kinematics, parameters)
        parts = {name: getattr(r, name) for name in r.__dataclass_fields__}
        if self.quantity == "cone":
            parts["traction"] = 1.01 * r.traction
        elif self.quantity == "friction bound":
            parts["friction_bound"] = 0.99 * r.friction_bound
        elif self.quantity == "stiffness":
            parts["normal_traction"] = 1.01 * r.normal_traction
        elif self.quantity == "adhesion":
            parts["normal_traction"] += parameters["k_n"] * positive_part(kinematics.gap)
        elif self.quantity == "slip":
            parts["slip"] = tuple(2 * s for s in r.slip)
        elif self.quantity == "direction":
            parts["traction"] = -r.traction
        return fc.ContactTraction(**parts)


def test_unchanged_law_passes():
    """The same law without a change passes: the failures below are due to the changes."""
    setup = BlockOnBall(Changed("nothing"), method="newton")
    steps = solve_path(setup, path=PATH[:3])
    assert steps[-1].contacts["contact"].slip > 0
    assert not any(s.verdict.failures for s in steps)


@pytest.mark.whole
@pytest.mark.parametrize(
    "quantity", ["cone", "friction bound", "stiffness", "adhesion", "slip", "direction"]
)
def test_violated_law_is_detected(quantity):
    """Tractions that violate cone, complementarity or flow rule do not pass as a solution."""
    setup = BlockOnBall(Changed(quantity), method="newton")
    before = copy_state(setup)
    with pytest.raises(fc.NotConverged) as caught:
        solve_path(setup, path=[PATH[2]])
    failures = "; ".join(caught.value.verdict.failures)
    assert "contact:" in failures, failures
    assert failures in str(caught.value)
    assert are_identical(copy_state(setup), before)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize("factor", [0.9, 1.0 + 1e-4])
def test_wrong_contact_residual_is_caught(method, factor, monkeypatch):
    """Forces do not balance if the contact residual is not the integral of the tractions."""
    setup = BlockOnBall(method=method)
    right = fc.ContactOperator.add_force

    def wrong(self, residual, traction=None):
        before = residual.copy()
        right(self, residual, traction)
        residual.axpby(1.0 - factor, factor, before)
        before.destroy()

    monkeypatch.setattr(fc.ContactOperator, "add_force", wrong)
    setup.set_top_displacement(*PATH[1])
    with pytest.raises(fc.NotConverged) as caught:
        setup.problem.solve()
    assert any("balance" in f for f in caught.value.verdict.failures)


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_forces_at_wrong_points_are_caught(cell, monkeypatch):
    """Moments do not balance if each force, of the right sum, acts at another point of Γc."""
    setup = BlockOnBall(cell=cell)
    right, contact = fc.ContactOperator.add_force, setup.contact

    def wrong(self, residual, traction=None):
        contact.evaluate()
        force = contact.measure[:, None] * contact.traction
        right(self, residual, np.roll(force, 1, axis=0) / contact.measure[:, None])

    monkeypatch.setattr(fc.ContactOperator, "add_force", wrong)
    setup.set_top_displacement(*PATH[1])
    with pytest.raises(fc.NotConverged) as caught:
        setup.problem.solve()
    assert any("moments" in f for f in caught.value.verdict.failures)


@pytest.mark.parametrize("condensation", [None, False])
@pytest.mark.parametrize("factor", [1.0, 1.0 + 1e-9])
def test_nodal_forces_agree_with_the_form(factor, condensation):
    """A map from u to the points that is wrong by 1e-9 differs from DOLFINx's assembly of the form.

    The results of the solver, the laws and the sums of forces agree with it within their
    tolerances.
    """
    setup = BlockOnBall(cross_check=True, condensation=condensation)
    setup.contact.pairs.own_map.scale(factor)
    setup.set_top_displacement(*PATH[1])
    if factor == 1.0:
        steps = solve_path(setup)
        assert all(step.verdict.cross_check["contact"].holds() for step in steps)
        assert all(step.verdict.cross_check["contact"].force > 0 for step in steps)
        return
    with pytest.raises(fc.NotConverged) as caught:
        setup.problem.solve()
    assert [f for f in caught.value.verdict.failures if "DOLFINx assembles" in f]
    assert len(caught.value.verdict.failures) == 1


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_premature_convergence_is_caught(method, monkeypatch):
    """Convergence claimed by SNES at its first check is refused; the state is as before."""
    setup = BlockOnBall(method=method, fallback=False)
    solve_path(setup, path=PATH[:1])
    before = copy_state(setup)
    setup.set_top_displacement(*PATH[2])
    claimed = PETSc.SNES.ConvergedReason.CONVERGED_FNORM_ABS
    monkeypatch.setattr(setup.problem.solver.main, "converged", lambda: claimed)
    with pytest.raises(fc.NotConverged) as caught:
        setup.problem.solve()
    assert any("residual" in f for f in caught.value.verdict.failures)
    assert are_identical(copy_state(setup), before)


def test_verdict_of_a_solution():
    """A step has its verdict: residual within tolerance, laws to 1e-10, balance of forces."""
    setup = BlockOnBall()
    for step in solve_path(setup):
        verdict = step.verdict
        assert not verdict.failures
        equation, resultant = verdict.worst_equation, verdict.worst_sum
        assert 0 < equation.residual <= 2 * equation.tolerance <= 1e-8 * equation.force
        assert resultant.residual <= resultant.tolerance <= 1e-6 * equation.force
        assert set(verdict.laws["contact"]) >= {"complementarity", "cone", "slip", "dissipation"}
        assert max(verdict.laws["contact"].values()) <= 1e-10


@pytest.mark.parametrize(
    ("residual", "tolerance", "holds"),
    [
        (0.0, 0.0, True),
        (1.0, 2.0, True),
        (1.0, 0.0, False),
        (3.0, 2.0, False),
        (np.nan, 1.0, False),
        (1.0, np.inf, False),
    ],
)
def test_force_balance_and_its_condition(residual, tolerance, holds):
    """Both hold if all numbers are finite and the residual is at most the tolerance, 0 included."""
    balance = ForceBalance(residual, 0.0, tolerance)
    assert (balance.excess() <= 1.0) == holds
    assert balance.holds() == balance.condition("", "").holds == holds
