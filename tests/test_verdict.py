"""The verdict on a solution: what is wrong does not pass, be it in the law, forces or places."""

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from fenics_contact.checks.verdict import ForceBalance
from fenics_contact.laws.return_maps import positive_part
from scenes.comparing import identical
from scenes.rubbing import PATH, Rub, snapshot, walk

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(240)]
COMM = MPI.COMM_WORLD


class Changed(fc.Coulomb):
    """Coulomb's law with a response that breaks what it claims."""

    def __init__(self, what: str) -> None:
        """``what``: the claim to break."""
        super().__init__(0.3, k_n=2e4, k_t=1e4)
        object.__setattr__(self, "what", what)

    def parameters(self):
        """Those of Coulomb's law."""
        return {"friction": self.friction, "k_n": self.k_n, "k_t": self.k_t}

    def contact_traction(self, kinematics, parameters):
        """Coulomb's, with one entry changed."""
        r = super().contact_traction(kinematics, parameters)
        parts = {name: getattr(r, name) for name in r.__dataclass_fields__}
        if self.what == "cone":
            parts["traction"] = 1.01 * r.traction
        elif self.what == "friction bound":
            parts["friction_bound"] = 0.99 * r.friction_bound
        elif self.what == "stiffness":
            parts["normal_traction"] = 1.01 * r.normal_traction
        elif self.what == "adhesion":
            parts["normal_traction"] += parameters["k_n"] * positive_part(kinematics.gap)
        elif self.what == "slip":
            parts["slip"] = tuple(2 * s for s in r.slip)
        elif self.what == "direction":
            parts["traction"] = -r.traction
        return fc.ContactTraction(**parts)


def test_the_changed_law_is_sound_when_nothing_is_changed():
    """The same law with nothing broken passes: what fails below fails for its fault."""
    made = Rub(Changed("nothing"), method="newton")
    steps = walk(made, path=PATH[:3])
    assert steps[-1].contacts["contact"].slip > 0
    assert not any(s.verdict.failures for s in steps)


@pytest.mark.whole
@pytest.mark.parametrize(
    "what", ["cone", "friction bound", "stiffness", "adhesion", "slip", "direction"]
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
    made = Rub(cross_check=True, condensation=condensation)
    made.contact.pairs.own_map.scale(factor)
    made.move(*PATH[1])
    if factor == 1.0:
        steps = walk(made)
        assert all(step.verdict.cross_check["contact"].holds() for step in steps)
        assert all(step.verdict.cross_check["contact"].force > 0 for step in steps)
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
def test_a_balance_and_its_condition(residual, tolerance, holds):
    """Both hold where all is finite and the residual no larger than the tolerance, 0 included."""
    balance = ForceBalance(residual, 0.0, tolerance)
    assert (balance.excess() <= 1.0) == holds
    assert balance.holds() == balance.condition("", "").holds == holds
