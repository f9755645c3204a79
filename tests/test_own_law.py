"""A law of the user's own: an exponential overclosure, with friction and without."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.laws.base import ContactTraction, Law
from fenics_contact.laws.friction import FrictionLaw
from fenics_contact.laws.return_maps import positive_part
from scenes.blocks import TOP, block
from scenes.comparing import close, gathered, raised_everywhere
from scenes.elasticity import stress
from scenes.laws import Asperities, Bond, Overclosure, Saturating

COMM = MPI.COMM_WORLD
pytestmark = [pytest.mark.mpi, pytest.mark.timeout(120)]

E, NU = 1000.0, 0.3
P0, H = 0.5, 2e-3


# ---- against closed answers ----------------------------------------------------------------------

# Newton's method and L-BFGS to 1e-9 of the forces; of the overclosure that is as much of h.
EXACT = 1e-7
METHODS = ("lbfgs", "newton", "continuation", "alternating")


@pytest.mark.each
@pytest.mark.parametrize("condensation", [None, False])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_overclosure(cell, method, condensation):
    """A block pressed uniformly: δ = h ln(p/p0) everywhere, and the energy is conserved.

    With the first increment p < p0, so that the law acts at a distance, then more.
    """
    scene = block(cell, E=E, nu=NU)
    law = Overclosure(P0, H)
    problem, contact = scene.problem(law, scene.rollers(), method=method, condensation=condensation)
    for p in (0.2, 3.0, 20.0):
        scene.load(up=-p)
        step = problem.solve()
        assert step.verdict.failures == []
        assert close(gathered(COMM, contact.pressure), np.full_like(_ones(contact), p), EXACT)
        overclosure = -gathered(COMM, contact.gap)
        assert close(overclosure, H * np.log(p / P0) * _ones(contact), EXACT, scale=H)
        problem.commit()
    # Work of the load by the trapezoidal rule is not that of a nonlinear law; its springs are.
    assert step.energy.springs == pytest.approx(H * (20.0 - 3.0), rel=1e-6)


def _ones(contact):
    return np.ones(len(gathered(COMM, contact.pressure)))


@pytest.mark.parametrize("condensation", [None, False])
@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_a_bond_led_back_to_no_load(cell, condensation):
    """An adhesive that softens, pulled to half of its strength and let go, twice over, and again.

    What is left are displacements of round-off, in which the law's potential has no digit right.
    The pull is k o exp(-o/h) = p at every point (1e-7 of the forces); without load nothing is left.
    """
    scene = block(cell, E=E, nu=NU)
    bond = Bond(k_n=1e3, h=1e-2)
    problem, contact = scene.problem(bond, scene.rollers(), condensation=condensation)
    for pull in (1.0, 0.5 * bond.strength, 0.0, 0.0, 1.0, 0.0):
        scene.load(up=pull)
        step = problem.solve()
        assert step.verdict.failures == []
        problem.commit()
        assert close(-gathered(COMM, contact.pressure), pull * _ones(contact), EXACT, scale=1.0)
        opening = gathered(COMM, contact.gap)
        assert close(1e3 * opening * np.exp(-opening / 1e-2), pull * _ones(contact), EXACT, scale=1)


def test_pressures_that_fall_by_a_factor_in_each_iteration():
    """Loaded from a gap of H: the first step ends tens of H too deep.

    From there an exponential falls by e in every iteration of Newton's method, which ends before
    other methods are tried. Reference: the closed form of the gap under a pressure, to the
    residual's 1e-9 of it.
    """
    scene = block("quadrilateral", E=1000.0, nu=0.0)
    apart = {"obstacle": fc.HalfSpace((0.0, -H), (0.0, 1.0))}
    problem, contact = scene.problem(
        Overclosure(P0, H), scene.rollers(), contact=apart, method="newton"
    )
    scene.load(up=-25.0 * P0)
    step = problem.solve()
    assert [each.method for each in step.attempts] == ["newton"]
    assert contact.gap == pytest.approx(-H * np.log(25.0), rel=1e-8)


def test_any_units():
    """The same in MPa and in Pa, in metres and in micrometres: relative results are equal."""
    found = []
    for force, length in ((1.0, 1.0), (1e6, 1.0), (1.0, 1e6)):
        size = [length, length]
        scene = block("quadrilateral", E=E * force, nu=NU, up=-3.0 * force, size=size)
        problem, contact = scene.problem(Overclosure(P0 * force, H * length), scene.rollers())
        problem.solve()
        found.append(-gathered(COMM, contact.gap) / length)
    assert close(found[1], found[0], EXACT) and close(found[2], found[0], EXACT)


@pytest.mark.each
@pytest.mark.parametrize("condensation", [None, False])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_overclosure_with_friction(cell, method, condensation):
    """Pressed by its top, dragged until all slips, and back: T = ±μN, p = p0 (exp(δ/h) - 1)."""
    mu = 0.3
    scene = block(cell, E=E, nu=NU, n=3)
    d = scene.dim
    push, press = (scene.hold(TOP, i) for i in (0, d - 1))
    held = [scene.hold(TOP, 1)] if d == 3 else []
    problem, contact = scene.problem(
        Asperities(mu, P0, H, fc.RelativeStiffness()),
        [push, press, *held],
        method=method,
        condensation=condensation,
    )
    for side, down in ((0.0, 1e-2), (2e-2, 1e-2), (-2e-2, 1e-2)):
        push.g.value[...], press.g.value[...] = side, -down
        step = problem.solve()
        assert step.verdict.failures == []
        penetration = np.maximum(-gathered(COMM, contact.gap), 0.0)
        expected = P0 * (np.exp(penetration / H) - 1)
        assert close(gathered(COMM, contact.pressure), expected, 1e-10)
        if side:
            r = step.contacts["contact"]
            assert r.stick == 0
            assert r.tangential_force == pytest.approx(mu * r.normal_force, rel=1e-9)
            assert r.force[0] * side < 0.0
        problem.commit()
    assert step.energy.dissipation > 0


def dragged(law, cell="quadrilateral", **options):
    """A block pressed on a plane by its top and dragged until all slips."""
    scene = block(cell, E=E, nu=NU, n=3)
    d = scene.dim
    push, press = (scene.hold(TOP, i) for i in (0, d - 1))
    held = [scene.hold(TOP, 1)] if d == 3 else []
    problem, contact = scene.problem(law, [push, press, *held], **options)
    push.g.value[...], press.g.value[...] = 4e-2, -2e-2
    return scene, problem, contact


@pytest.mark.parametrize("condensation", [None, False])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_friction_that_does_not_grow_as_the_pressure(cell, method, condensation):
    """All slips: |τ| is the limit under the pressure at every point, to the solver's 1e-9."""
    mu, strength = 0.5, 4.0
    law = Saturating(mu, strength, fc.RelativeStiffness(), fc.RelativeStiffness())
    _, problem, contact = dragged(law, cell, method=method, condensation=condensation)
    step = problem.solve()
    assert step.verdict.failures == [] and step.contacts["contact"].stick == 0
    p, tau = (gathered(COMM, v) for v in (contact.pressure, contact.tangential_traction))
    assert mu * p.max() > 2 * strength  # far from Coulomb's
    assert close(np.linalg.norm(tau, axis=1), strength * (1 - np.exp(-mu * p / strength)), 1e-9)


def test_its_error_is_estimated_by_its_derivative():
    """Friction of a soft penalty against that of one 1000 times as stiff: estimated within 30 %.

    With the pressure itself for measure, as Coulomb's would have it, it would be 5 times too large.
    """
    found = []
    for factor in (3.0, 3e3):
        law = Saturating(0.5, 4.0, fc.RelativeStiffness(factor), fc.RelativeStiffness(factor))
        scene, problem, _ = dragged(law)
        problem.solve()
        budget = fc.estimate_errors(problem, stress(scene.u, E, NU))
        found.append(budget)
    soft, stiff = found
    name = "friction force"
    error = soft.values[name] - stiff.values[name]
    assert soft.parts["enforcement"][name] == pytest.approx(error, rel=0.3)


# ---- what is refused, and what is found out ------------------------------------------------------


def test_multipliers_are_refused():
    """They would take the stiffness away that the law is about."""
    scene = block()
    raised_everywhere(
        lambda: scene.contact(Overclosure(P0, H), enforcement="augmented"),
        ValueError,
        "Overclosure",
        "penalty",
    )
    assert scene.contact(Overclosure(P0, H), accuracy="standard").multipliers is None


def test_a_law_that_does_not_say_enough():
    """Without k_n a potential is wanted, and k_t where there is friction; each by its name."""

    @dataclass(frozen=True)
    class Silent(Law):
        p0: Any

        def contact_traction(self, kinematics, parameters):
            return ContactTraction(-parameters["p0"] * positive_part(-kinematics.gap) ** 2)

    scene = block()
    raised_everywhere(
        lambda: scene.contact(Silent(1.0)), ValueError, "contact", "Silent", "normal_potential"
    )
    raised_everywhere(
        lambda: scene.contact(Law()), ValueError, "contact", "Law", "contact_traction"
    )

    @dataclass(frozen=True)
    class Slippery(FrictionLaw):
        friction: Any
        k_n: Any

        def contact_traction(self, kinematics, parameters):
            return None

    raised_everywhere(
        lambda: scene.contact(Slippery(0.3, 1.0)), ValueError, "contact", "Slippery", "k_t"
    )


def test_a_potential_of_another_law():
    """A response and a potential that do not belong together are found by the verdict."""

    class Wrong(Overclosure):
        """Its energy is too large by a thousandth."""

        def normal_potential(self, kinematics, parameters):
            """∫ p dδ, nearly."""
            return 1.001 * super().normal_potential(kinematics, parameters)

    scene = block(up=-3.0)
    problem, _ = scene.problem(Wrong(P0, H), scene.rollers())
    with pytest.raises(fc.NotConverged, match="complementarity violated by"):
        problem.solve()


def test_a_limit_of_another_law():
    """A response with another friction bound than `Law.friction_bound` is found by the verdict."""

    class Wrong(Saturating):
        """It slides at the limit of another strength than the one that it tells."""

        def contact_traction(self, kinematics, parameters):
            """That of a layer as strong again."""
            more = {**parameters, "strength": 2 * parameters["strength"]}
            return super().contact_traction(kinematics, more)

    _, problem, _ = dragged(Wrong(0.5, 4.0, fc.RelativeStiffness(), fc.RelativeStiffness()))
    with pytest.raises(fc.NotConverged, match="friction bound violated by") as caught:
        problem.solve()
    # Smaller increments would not mend it.
    assert "contact_traction, friction_bound and normal_potential" in str(caught.value)
    assert "smaller increments" not in str(caught.value)


@dataclass(frozen=True)
class RootOfPenetration(fc.Law):
    """A pressure c √δ₋, whose derivative is infinite at first contact and NaN where it is open."""

    c: Any

    def contact_traction(self, kinematics, parameters):
        """The pressure, without friction."""
        penetration = ufl.max_value(-kinematics.gap, 0)
        return ContactTraction(-parameters["c"] * penetration**0.5)

    def normal_potential(self, kinematics, parameters):
        """∫ p dδ."""
        return parameters["c"] * ufl.max_value(-kinematics.gap, 0) ** 1.5 / 1.5


@pytest.mark.parametrize("condensation", [None, False])
def test_a_derivative_that_is_not_finite(condensation):
    """On a curved obstacle it makes a diverged state: refused as such, with u and loads restored.

    The verification looks at that state, at points that are nowhere.
    """
    scene = block(E=E, nu=NU, n=3)
    ball = fc.Ball((0.5, -2.0), 2.0)
    problem, contact = scene.problem(
        RootOfPenetration(5.0),
        scene.rollers(),
        contact={"obstacle": ball},
        condensation=condensation,
    )
    scene.load(up=-0.2)
    text = raised_everywhere(problem.solve, fc.NotConverged, "not finite", "user-defined law")
    assert "its size" not in text  # NaN is no deformation
    assert problem.increment == 0 and np.all(scene.u.x.array == 0.0)
    assert np.isfinite(gathered(COMM, contact.gap)).all()


def test_what_to_try_is_what_the_law_has():
    """No lower k_n of a law that has none; of the package's own there are both."""
    for law, words in (
        (
            Asperities(0.3, P0, H, fc.RelativeStiffness()),
            "Try smaller increments, then a lower k_t;",
        ),
        (Overclosure(P0, H), "Try smaller increments;"),
        (fc.Coulomb(0.3), "Try smaller increments, a lower k_t, then a lower k_n;"),
    ):
        _, problem, _ = dragged(law, petsc_options={"snes_max_it": 1})
        with pytest.raises(fc.NotConverged) as caught:
            problem.solve()
        assert words in str(caught.value)


def test_a_parameter_that_the_law_does_not_have():
    """Its name, and those that there are, before anything is compiled."""

    @dataclass(frozen=True)
    class Capped(fc.Coulomb):
        cap: float = 1.0

        def friction_bound(self, kinematics, pressure, parameters):
            return ufl.min_value(parameters["friction"] * pressure, parameters["capp"])

    raised_everywhere(
        lambda: block().contact(Capped(0.3)),
        ValueError,
        "Capped",
        "'capp'",
        "['cap', 'friction', 'k_n', 'k_t']",
    )


def test_a_parameter_with_a_name_of_the_contact():
    """The weight of the contact would be that of the law, and the other way round."""

    @dataclass(frozen=True)
    class Weighed(Overclosure):
        weight: Any = 1.0

    raised_everywhere(
        lambda: block().contact(Weighed(P0, H)), ValueError, "contact", "Weighed", "'weight'"
    )


@pytest.mark.parametrize(("name", "value"), [("p0", 0.0), ("h", -1.0), ("h", np.nan)])
def test_parameters_of_an_own_law(name, value):
    """They are checked as those of the others."""
    scene = block()
    law = replace(Overclosure(P0, H), **{name: value})
    raised_everywhere(lambda: scene.contact(law), ValueError, "contact", name)


@dataclass(frozen=True)
class Beside(fc.Frictionless):
    """A law that takes what it depends on past its parameters."""

    hidden: Any = None

    def parameters(self) -> dict[str, Any]:
        """The stiffness alone."""
        return {"k_n": self.k_n}

    def contact_traction(self, kinematics, parameters):
        """More pressure than the parameters say."""
        told = super().contact_traction(kinematics, parameters)
        return replace(told, normal_traction=(1 + self.hidden) * told.normal_traction)


def test_what_is_no_parameter_is_refused():
    """A place, a function of the body, u, or a constant, which no checkpoint would tell apart."""
    scene = block("quadrilateral", E=E, nu=NU)
    x = ufl.SpatialCoordinate(scene.mesh)
    for hidden in (x[0], scene.u[0] ** 2, fem.Constant(scene.mesh, 0.1)):
        law = Beside(k_n=1e3, hidden=hidden)
        raised_everywhere(lambda law=law: scene.contact(law), ValueError, "Beside", "parameter")
