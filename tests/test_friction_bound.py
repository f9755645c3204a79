"""Tests of laws with friction bounds of their own: c + μ p and μ(Δu_t) p."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.laws.return_maps import norm
from scenes.blocks import block, rough_field
from scenes.comparison import assert_raised_on_all_ranks, gather, is_close
from scenes.user_laws import SaturatingFriction

COMM = MPI.COMM_WORLD
pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]

MU, COHESION, RATE = 0.3, 1.0, 2.0
# A low, stiff block on an area of 1 in the plane: tractions are nearly uniform, and a force at its
# top leaves all of Γc closed.
LOW = {"E": 1e8, "size": (1.0, 0.1), "n": 4}


@dataclass(frozen=True)
class Cohesive(fc.Coulomb):
    """A friction bound c + μ p."""

    cohesion: Any = 0.0

    def friction_bound(self, kinematics, pressure, parameters):
        """Return c + μ p, as the page on user-defined laws does."""
        return parameters["cohesion"] + parameters["friction"] * pressure


@dataclass(frozen=True)
class Strengthening(fc.Coulomb):
    """A friction coefficient μ + a |Δu_t| that grows with the slip distance of an increment."""

    rate: Any = 0.0

    def friction_bound(self, kinematics, pressure, parameters):
        """Return (μ + a |Δu_t|) p, as the page on user-defined laws does."""
        distance = norm(kinematics.tangential_increment)
        return (parameters["friction"] + parameters["rate"] * distance) * pressure


def dragged_block(law, side, cell="quadrilateral", **options):
    """Return problem and contact of a block of weight 1, pulled along the floor at its top."""
    size = {"size": (1.0, 1.0, 0.1), "n": (2, 2, 1)} if cell == "hexahedron" else {}
    scene = block(cell, up=-1.0, side=side, **(LOW | size))
    return scene.problem(law, [], **options)


# ---- balance -------------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_cohesion_adds_to_the_friction_limit(cell):
    """With c on an area of 1 and weight N = 1 the friction limit is c + μ N = 1.3: 1.25 is solved.

    The tangential force is the load, to 1e-7; the solver stops at 1e-9 of the forces.
    """
    law = Cohesive(MU, k_n=1e5, k_t=1e5, cohesion=COHESION)
    problem, _ = dragged_block(law, 1.25, cell)
    step = problem.solve()
    assert step.verdict.failures == []
    assert step.contacts["contact"].force[0] == pytest.approx(-1.25, rel=1e-7)


def test_load_above_the_limit_with_cohesion_is_an_overload():
    """The error states the friction limit, 1.3, although the friction bound is not μ p."""
    law = Cohesive(MU, k_n=1e5, k_t=1e5, cohesion=COHESION)
    problem, _ = dragged_block(law, 1.35)
    assert_raised_on_all_ranks(problem.solve, fc.NotConverged, "overload", "at most 1.3")


K = {"k_n": 1e5, "k_t": 1e5}
RATIOS = {
    "friction": (fc.Coulomb(MU, **K), MU),
    "none": (fc.Coulomb(0.0, **K), 0.0),
    "polygon": (fc.Coulomb(MU, **K, modes=4), MU / np.cos(np.pi / 4)),
    "ellipse": (
        fc.Coulomb(MU, **K, transverse_friction=0.5, direction=(1.0, 0.0, 0.0)),
        0.5,
    ),
    "given bound": (fc.Tresca(MU, 2.0, **K), np.inf),
    "given bound of zero": (fc.Tresca(MU, 0.0, **K), 0.0),
    "foundation": (fc.Foundation(1e5, 1e5), np.inf),
    "no cohesion": (Cohesive(MU, **K), MU),
    "cohesion": (Cohesive(MU, **K, cohesion=1.0), np.inf),
    "motion": (Strengthening(MU, **K, rate=RATE), np.inf),
    "saturating": (SaturatingFriction(MU, 4.0, 1e5, 1e5), np.inf),
}


@pytest.mark.whole
@pytest.mark.parametrize("name", RATIOS)
def test_friction_bound_ratio_follows_from_the_friction_bound(name):
    """The ratio is μ times the shape of the yield surface if the bound is μ p, else infinite.

    It is zero without friction. The tolerance is 1e-14.
    """
    law, expected = RATIOS[name]
    contact = block("hexahedron", n=1).contact(law)
    contact.evaluate()
    ratio = contact.values.friction_bound_ratio
    assert np.array_equal(ratio, np.full_like(ratio, expected)) or is_close(
        ratio, np.full_like(ratio, expected), 1e-14
    )


def test_asymmetric_yield_surface_is_not_refused_as_overload():
    """With yield functions twice as large to one side, a load of 0.5 N is solved there only."""

    @dataclass(frozen=True)
    class OneSided(fc.Coulomb):
        def _sided(self, kinematics, bound):
            t = ufl.as_vector([-kinematics.normal[1], kinematics.normal[0]])
            return t, bound, 2 * bound

        def yield_functions(self, kinematics, traction, bound, parameters):
            t, more, less = self._sided(kinematics, bound)
            along = ufl.dot(traction, t)
            return along - more, -along - less

        def return_map(self, kinematics, bound, parameters):
            t, more, less = self._sided(kinematics, bound)
            trial = kinematics.traction - parameters["k_t"] * kinematics.tangential_increment
            along = ufl.dot(trial, t)
            bounded = ufl.min_value(ufl.max_value(along, -less), more)
            beyond = along - more, -along - less
            slip = tuple(ufl.max_value(b, 0) / parameters["k_t"] for b in beyond)
            return bounded * t, slip

    has_force, slips = [], []
    for side in (0.5, -0.5):
        problem, _ = dragged_block(OneSided(MU, **K), side)
        try:
            step = problem.solve()
        except fc.NotConverged:
            slips.append(side)
        else:
            has_force.append(step.contacts["contact"].force[0])
    assert len(has_force) == len(slips) == 1


# ---- friction that depends on the slip distance --------------------------------------------------


@pytest.mark.parametrize("method", [None, "newton"])
@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_friction_coefficient_that_grows_with_the_slip_distance(cell, method):
    """A force T > μ N moves the block by (T/N - μ)/a in every increment, to 1e-4.

    It is above the limit for constant μ. The block's deformation is some 1e-6 of the slip distance.
    """
    law = Strengthening(MU, k_n=1e6, k_t=1e6, rate=RATE)
    problem, contact = dragged_block(law, 0.4, cell, method=method)
    for _ in range(2):
        step = problem.solve()
        assert step.verdict.failures == [] and step.contacts["contact"].stick == 0
        moved = gather(COMM, contact.values.increment)[:, 0]
        assert is_close(moved, np.full_like(moved, (0.4 - MU) / RATE), 1e-4)
        problem.commit()


@pytest.mark.parametrize("kinematics", ["small", "finite"])
@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_tangent_includes_the_derivative_by_the_slip_distance(cell, kinematics):
    """The tangent at the points agrees with central differences of the tractions to 1e-6."""
    scene = block(cell, n=2, E=1e3, shuffled=True)
    law = Strengthening(MU, k_n=2e3, k_t=1e3, rate=RATE)
    contact = scene.contact(law, kinematics=kinematics)
    d = scene.dim

    def at(step):
        scene.u.interpolate(
            lambda x: (
                np.stack([0.05 + 0.02 * x[0]] * (d - 1) + [-0.01 - 0.01 * x[0]])
                + step * rough_field(d, 3)(x)
            )
        )
        return contact.effective_law.traction().copy()

    step = 1e-6
    change = (at(step) - at(-step)) / (2 * step)
    at(0.0)
    contact.evaluate()
    assert np.all(contact.status == 2)  # slip
    by_jump = contact.effective_law.tangent().by_jump
    jump = fem.Function(scene.u.function_space)
    jump.interpolate(rough_field(d, 3))
    scene.u.x.array[:] = jump.x.array
    direction = contact.contact_kinematics.present_jump()
    exact = np.einsum("qij,qj->qi", by_jump, direction)
    assert is_close(gather(COMM, change), gather(COMM, exact), 1e-6)
