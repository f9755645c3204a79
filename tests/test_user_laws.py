"""User-defined laws: an exponential overclosure, with and without friction."""

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
from scenes.comparison import assert_raised_on_all_ranks, gather, is_close
from scenes.elasticity import stress
from scenes.user_laws import Adhesive, AsperityFriction, Overclosure, SaturatingFriction

COMM = MPI.COMM_WORLD
pytestmark = [pytest.mark.mpi, pytest.mark.timeout(120)]

E, NU = 1000.0, 0.3
P0, H = 0.5, 2e-3


# ---- closed-form solutions -----------------------------------------------------------------------

# Newton's method and L-BFGS converge to 1e-9 of the forces, so overclosures to 1e-9 of h.
EXACT = 1e-7
METHODS = ("lbfgs", "newton", "continuation", "alternating")


@pytest.mark.each
@pytest.mark.parametrize("condensation", [None, False])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_overclosure(cell, method, condensation):
    """A block under uniform pressure has δ = h ln(p/p0) everywhere, and energy is conserved.

    In the first increment p < p0, so that the law acts across an open gap; then p is larger.
    """
    scene = block(cell, E=E, nu=NU)
    law = Overclosure(P0, H)
    problem, contact = scene.problem(law, scene.rollers(), method=method, condensation=condensation)
    for p in (0.2, 3.0, 20.0):
        scene.load(up=-p)
        step = problem.solve()
        assert step.verdict.failures == []
        assert is_close(
            gather(COMM, contact.pressure), np.full_like(_ones_at_points(contact), p), EXACT
        )
        overclosure = -gather(COMM, contact.gap)
        assert is_close(overclosure, H * np.log(p / P0) * _ones_at_points(contact), EXACT, scale=H)
        problem.commit()
    # For a nonlinear law the trapezoidal work is inexact; the energy of its springs is exact.
    assert step.energy.springs == pytest.approx(H * (20.0 - 3.0), rel=1e-6)


def _ones_at_points(contact):
    return np.ones(len(gather(COMM, contact.pressure)))


@pytest.mark.parametrize("condensation", [None, False])
@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_softening_adhesive_is_unloaded(cell, condensation):
    """A softening adhesive is pulled, up to half of its strength, and unloaded several times.

    What remains are displacements of round-off, in which the law's potential has no correct digit.
    The tension is k o exp(-o/h) = p at every point, to 1e-7 of the forces, and zero without load.
    """
    scene = block(cell, E=E, nu=NU)
    bond = Adhesive(k_n=1e3, h=1e-2)
    problem, contact = scene.problem(bond, scene.rollers(), condensation=condensation)
    for pull in (1.0, 0.5 * bond.strength, 0.0, 0.0, 1.0, 0.0):
        scene.load(up=pull)
        step = problem.solve()
        assert step.verdict.failures == []
        problem.commit()
        assert is_close(
            -gather(COMM, contact.pressure), pull * _ones_at_points(contact), EXACT, scale=1.0
        )
        opening = gather(COMM, contact.gap)
        assert is_close(
            1e3 * opening * np.exp(-opening / 1e-2), pull * _ones_at_points(contact), EXACT, scale=1
        )


def test_newton_recovers_from_a_step_that_is_too_deep():
    """Loaded from a gap of H, the block ends tens of H too deep after the first step.

    From there an exponential pressure falls by a factor e in every iteration of Newton's method,
    which converges before other methods are tried. Reference: the closed form of the gap under a
    pressure, to 1e-8, as the residual is 1e-9 of the pressure.
    """
    scene = block("quadrilateral", E=1000.0, nu=0.0)
    options = {"obstacle": fc.HalfSpace((0.0, -H), (0.0, 1.0))}
    problem, contact = scene.problem(
        Overclosure(P0, H), scene.rollers(), contact=options, method="newton"
    )
    scene.load(up=-25.0 * P0)
    step = problem.solve()
    assert [each.method for each in step.attempts] == ["newton"]
    assert contact.gap == pytest.approx(-H * np.log(25.0), rel=1e-8)


def test_any_units():
    """Relative results are the same in MPa and Pa, in metres and micrometres, to 1e-7."""
    computed = []
    for force, length in ((1.0, 1.0), (1e6, 1.0), (1.0, 1e6)):
        size = [length, length]
        scene = block("quadrilateral", E=E * force, nu=NU, up=-3.0 * force, size=size)
        problem, contact = scene.problem(Overclosure(P0 * force, H * length), scene.rollers())
        problem.solve()
        computed.append(-gather(COMM, contact.gap) / length)
    assert is_close(computed[1], computed[0], EXACT) and is_close(computed[2], computed[0], EXACT)


@pytest.mark.each
@pytest.mark.parametrize("condensation", [None, False])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_overclosure_with_friction(cell, method, condensation):
    """All points of a block dragged back and forth slip: T = ±μN, p = p0 (exp(δ/h) - 1).

    The displacement of its top is prescribed.
    """
    mu = 0.3
    scene = block(cell, E=E, nu=NU, n=3)
    d = scene.dim
    push, press = (scene.dirichlet_bc(TOP, i) for i in (0, d - 1))
    bcs = [scene.dirichlet_bc(TOP, 1)] if d == 3 else []
    problem, contact = scene.problem(
        AsperityFriction(mu, P0, H, fc.RelativeStiffness()),
        [push, press, *bcs],
        method=method,
        condensation=condensation,
    )
    for side, down in ((0.0, 1e-2), (2e-2, 1e-2), (-2e-2, 1e-2)):
        push.g.value[...], press.g.value[...] = side, -down
        step = problem.solve()
        assert step.verdict.failures == []
        penetration = np.maximum(-gather(COMM, contact.gap), 0.0)
        expected = P0 * (np.exp(penetration / H) - 1)
        assert is_close(gather(COMM, contact.pressure), expected, 1e-10)
        if side:
            r = step.contacts["contact"]
            assert r.stick == 0
            assert r.tangential_force == pytest.approx(mu * r.normal_force, rel=1e-9)
            assert r.force[0] * side < 0.0
        problem.commit()
    assert step.energy.dissipation > 0


def slipping_block(law, cell="quadrilateral", **options):
    """Return a block pressed on a plane by its top and dragged until all points slip."""
    scene = block(cell, E=E, nu=NU, n=3)
    d = scene.dim
    push, press = (scene.dirichlet_bc(TOP, i) for i in (0, d - 1))
    bcs = [scene.dirichlet_bc(TOP, 1)] if d == 3 else []
    problem, contact = scene.problem(law, [push, press, *bcs], **options)
    push.g.value[...], press.g.value[...] = 4e-2, -2e-2
    return scene, problem, contact


@pytest.mark.parametrize("condensation", [None, False])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_friction_bound_nonlinear_in_the_pressure(cell, method, condensation):
    """All points slip: |τ| is the friction bound at their pressure, to the solver's 1e-9."""
    mu, strength = 0.5, 4.0
    law = SaturatingFriction(mu, strength, fc.RelativeStiffness(), fc.RelativeStiffness())
    _, problem, contact = slipping_block(law, cell, method=method, condensation=condensation)
    step = problem.solve()
    assert step.verdict.failures == [] and step.contacts["contact"].stick == 0
    p, tau = (gather(COMM, v) for v in (contact.pressure, contact.tangential_traction))
    assert mu * p.max() > 2 * strength  # far from Coulomb's law
    assert is_close(np.linalg.norm(tau, axis=1), strength * (1 - np.exp(-mu * p / strength)), 1e-9)


def test_enforcement_error_uses_the_derivative_of_the_friction_bound():
    """The error of the friction of a soft penalty is estimated within 30 %.

    Reference: a penalty 1000 times as stiff. With the pressure instead of the derivative of the
    friction bound, as for Coulomb's law, the estimate would be 5 times too large.
    """
    computed = []
    for factor in (3.0, 3e3):
        law = SaturatingFriction(
            0.5, 4.0, fc.RelativeStiffness(factor), fc.RelativeStiffness(factor)
        )
        scene, problem, _ = slipping_block(law)
        problem.solve()
        budget = fc.estimate_errors(problem, stress(scene.u, E, NU))
        computed.append(budget)
    soft, stiff = computed
    name = "friction force"
    error = soft.values[name] - stiff.values[name]
    assert soft.parts["enforcement"][name] == pytest.approx(error, rel=0.3)


# ---- refused input, and errors found by the verdict ----------------------------------------------


def test_multipliers_are_refused():
    """Multipliers would remove the stiffness that the law describes: they are refused."""
    scene = block()
    assert_raised_on_all_ranks(
        lambda: scene.contact(Overclosure(P0, H), enforcement="augmented"),
        ValueError,
        "Overclosure",
        "penalty",
    )
    assert scene.contact(Overclosure(P0, H), accuracy="standard").multipliers is None


def test_incomplete_laws_are_refused():
    """Without k_n a law needs a potential, with friction k_t; the error names it."""

    @dataclass(frozen=True)
    class Silent(Law):
        p0: Any

        def contact_traction(self, kinematics, parameters):
            return ContactTraction(-parameters["p0"] * positive_part(-kinematics.gap) ** 2)

    scene = block()
    assert_raised_on_all_ranks(
        lambda: scene.contact(Silent(1.0)), ValueError, "contact", "Silent", "normal_potential"
    )
    assert_raised_on_all_ranks(
        lambda: scene.contact(Law()), ValueError, "contact", "Law", "contact_traction"
    )

    @dataclass(frozen=True)
    class Slippery(FrictionLaw):
        friction: Any
        k_n: Any

        def contact_traction(self, kinematics, parameters):
            return None

    assert_raised_on_all_ranks(
        lambda: scene.contact(Slippery(0.3, 1.0)), ValueError, "contact", "Slippery", "k_t"
    )


def test_inconsistent_potential_is_caught():
    """The verdict detects a traction that is not the derivative of the potential."""

    class Wrong(Overclosure):
        """An overclosure whose energy is too large by a thousandth."""

        def normal_potential(self, kinematics, parameters):
            """Return ∫ p dδ, too large by a thousandth."""
            return 1.001 * super().normal_potential(kinematics, parameters)

    scene = block(up=-3.0)
    problem, _ = scene.problem(Wrong(P0, H), scene.rollers())
    with pytest.raises(fc.NotConverged, match="complementarity violated by"):
        problem.solve()


def test_inconsistent_friction_bound_is_caught():
    """The verdict detects a traction with another friction bound than `Law.friction_bound`."""

    class Wrong(SaturatingFriction):
        """A law that slips at the bound of another strength than that of its parameters."""

        def contact_traction(self, kinematics, parameters):
            """Return the traction of a layer of twice the strength."""
            more = {**parameters, "strength": 2 * parameters["strength"]}
            return super().contact_traction(kinematics, more)

    _, problem, _ = slipping_block(Wrong(0.5, 4.0, fc.RelativeStiffness(), fc.RelativeStiffness()))
    with pytest.raises(fc.NotConverged, match="friction bound violated by") as caught:
        problem.solve()
    # Smaller increments are no remedy.
    assert "contact_traction, friction_bound and normal_potential" in str(caught.value)
    assert "smaller increments" not in str(caught.value)


@dataclass(frozen=True)
class RootOfPenetration(fc.Law):
    """A pressure c √δ₋, whose derivative is infinite at first contact and NaN at open points."""

    c: Any

    def contact_traction(self, kinematics, parameters):
        """Return the pressure, without friction."""
        penetration = ufl.max_value(-kinematics.gap, 0)
        return ContactTraction(-parameters["c"] * penetration**0.5)

    def normal_potential(self, kinematics, parameters):
        """Return ∫ p dδ."""
        return parameters["c"] * ufl.max_value(-kinematics.gap, 0) ** 1.5 / 1.5


@pytest.mark.parametrize("condensation", [None, False])
def test_non_finite_derivative_is_refused(condensation):
    """A non-finite derivative on a curved obstacle is refused, and u and loads are restored.

    The verification evaluates the diverged state, whose points have no finite position.
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
    text = assert_raised_on_all_ranks(
        problem.solve, fc.NotConverged, "not finite", "user-defined law"
    )
    assert "its size" not in text  # NaN does not count as deformation
    assert problem.increment == 0 and np.all(scene.u.x.array == 0.0)
    assert np.isfinite(gather(COMM, contact.gap)).all()


def test_remedies_name_the_stiffnesses_of_the_law():
    """A lower k_n or k_t is suggested only if the law has this parameter."""
    for law, words in (
        (
            AsperityFriction(0.3, P0, H, fc.RelativeStiffness()),
            "Try smaller increments, then a lower k_t;",
        ),
        (Overclosure(P0, H), "Try smaller increments;"),
        (fc.Coulomb(0.3), "Try smaller increments, a lower k_t, then a lower k_n;"),
    ):
        _, problem, _ = slipping_block(law, petsc_options={"snes_max_it": 1})
        with pytest.raises(fc.NotConverged) as caught:
            problem.solve()
        assert words in str(caught.value)


def test_unknown_parameter_is_refused():
    """Before compilation the error names the unknown parameter and those of the law."""

    @dataclass(frozen=True)
    class Capped(fc.Coulomb):
        cap: float = 1.0

        def friction_bound(self, kinematics, pressure, parameters):
            return ufl.min_value(parameters["friction"] * pressure, parameters["capp"])

    assert_raised_on_all_ranks(
        lambda: block().contact(Capped(0.3)),
        ValueError,
        "Capped",
        "'capp'",
        "['cap', 'friction', 'k_n', 'k_t']",
    )


def test_parameter_with_a_name_of_the_contact_is_refused():
    """A law's parameter `weight` would be confused with the weight of the contact."""

    @dataclass(frozen=True)
    class Weighed(Overclosure):
        weight: Any = 1.0

    assert_raised_on_all_ranks(
        lambda: block().contact(Weighed(P0, H)), ValueError, "contact", "Weighed", "'weight'"
    )


@pytest.mark.parametrize(("name", "value"), [("p0", 0.0), ("h", -1.0), ("h", np.nan)])
def test_invalid_parameters_of_a_user_defined_law_are_refused(name, value):
    """Parameters of a user-defined law are checked as those of the package's laws."""
    scene = block()
    law = replace(Overclosure(P0, H), **{name: value})
    assert_raised_on_all_ranks(lambda: scene.contact(law), ValueError, "contact", name)


@dataclass(frozen=True)
class HiddenDependence(fc.Frictionless):
    """A law that depends on something that is not one of its parameters."""

    hidden: Any = None

    def parameters(self) -> dict[str, Any]:
        """Return the stiffness alone."""
        return {"k_n": self.k_n}

    def contact_traction(self, kinematics, parameters):
        """Return a larger pressure than that of the parameters."""
        traction = super().contact_traction(kinematics, parameters)
        return replace(traction, normal_traction=(1 + self.hidden) * traction.normal_traction)


def test_dependence_on_other_than_parameters_is_refused():
    """A law may not depend on position, u or constants except by its parameters.

    A checkpoint could not distinguish such laws.
    """
    scene = block("quadrilateral", E=E, nu=NU)
    x = ufl.SpatialCoordinate(scene.mesh)
    for hidden in (x[0], scene.u[0] ** 2, fem.Constant(scene.mesh, 0.1)):
        law = HiddenDependence(k_n=1e3, hidden=hidden)
        assert_raised_on_all_ranks(
            lambda law=law: scene.contact(law), ValueError, "HiddenDependence", "parameter"
        )
