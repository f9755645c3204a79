"""The friction bound: all that a law says of the strength of friction, c + μ p and μ(Δu_t) p."""

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
from scenes.blocks import block, wave
from scenes.comparing import close, gathered, raised_everywhere
from scenes.laws import Saturating

COMM = MPI.COMM_WORLD
pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]

MU, COHESION, RATE = 0.3, 1.0, 2.0
# A low block that hardly deforms, on an area of 1 in the plane: tractions are nearly even, and a
# pull at its top leaves all of Γc closed.
LOW = {"E": 1e8, "size": (1.0, 0.1), "n": 4}


@dataclass(frozen=True)
class Cohesive(fc.Coulomb):
    """A friction bound c + μ p."""

    cohesion: Any = 0.0

    def friction_bound(self, kinematics, pressure, parameters):
        """As the page on laws of one's own has it."""
        return parameters["cohesion"] + parameters["friction"] * pressure


@dataclass(frozen=True)
class Strengthening(fc.Coulomb):
    """A friction coefficient μ + a |Δu_t| that grows with the slip distance of an increment."""

    rate: Any = 0.0

    def friction_bound(self, kinematics, pressure, parameters):
        """As the page on laws of one's own has it."""
        distance = norm(kinematics.tangential_increment)
        return (parameters["friction"] + parameters["rate"] * distance) * pressure


def low_block(law, side, cell="quadrilateral", **options):
    """A block under its weight of 1, pulled along the floor by a force on its top."""
    size = {"size": (1.0, 1.0, 0.1), "n": (2, 2, 1)} if cell == "hexahedron" else {}
    scene = block(cell, up=-1.0, side=side, **(LOW | size))
    return scene.problem(law, [], **options)


# ---- balance -------------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_cohesion_bears_without_pressure(cell):
    """With c on an area of 1 and the weight N = 1 the floor bears c + μ N = 1.3: 1.25 is solved.

    The tangential force is the load, to the solver's 1e-9 of the forces.
    """
    law = Cohesive(MU, k_n=1e5, k_t=1e5, cohesion=COHESION)
    problem, _ = low_block(law, 1.25, cell)
    step = problem.solve()
    assert step.verdict.failures == []
    assert step.contacts["contact"].force[0] == pytest.approx(-1.25, rel=1e-7)


def test_more_than_cohesion_bears_is_an_overload():
    """What the floor bears, 1.3, is in the message, though no point's friction is μ p."""
    law = Cohesive(MU, k_n=1e5, k_t=1e5, cohesion=COHESION)
    problem, _ = low_block(law, 1.35)
    raised_everywhere(problem.solve, fc.NotConverged, "overload", "at most 1.3")


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
    "saturating": (Saturating(MU, 4.0, 1e5, 1e5), np.inf),
}


@pytest.mark.whole
@pytest.mark.parametrize("name", RATIOS)
def test_what_bounds_tangential_forces_follows_from_the_friction_bound(name):
    """μ times the shape of the yield surface where the bound is μ p; else nothing does."""
    law, expected = RATIOS[name]
    contact = block("hexahedron", n=1).contact(law)
    contact.evaluate()
    ratio = contact.values.friction_bound_ratio
    assert np.array_equal(ratio, np.full_like(ratio, expected)) or close(
        ratio, np.full_like(ratio, expected), 1e-14
    )


def test_a_yield_surface_of_ones_own_denies_no_balance():
    """Friction twice as strong to one side, by its own yield functions, bears 0.5 N there."""

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
            kept = ufl.min_value(ufl.max_value(along, -less), more)
            beyond = along - more, -along - less
            slip = tuple(ufl.max_value(b, 0) / parameters["k_t"] for b in beyond)
            return kept * t, slip

    bears, slips = [], []
    for side in (0.5, -0.5):
        problem, _ = low_block(OneSided(MU, **K), side)
        try:
            step = problem.solve()
        except fc.NotConverged:
            slips.append(side)
        else:
            bears.append(step.contacts["contact"].force[0])
    assert len(bears) == len(slips) == 1


# ---- friction that depends on the slip distance --------------------------------------------------


@pytest.mark.parametrize("method", [None, "newton"])
@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_friction_by_the_slip_distance(cell, method):
    """A force T > μ N drags the block by (T/N - μ)/a in every increment.

    No friction of μ alone bears it. The block's own deformation is some 1e-6 of the way.
    """
    law = Strengthening(MU, k_n=1e6, k_t=1e6, rate=RATE)
    problem, contact = low_block(law, 0.4, cell, method=method)
    for _ in range(2):
        step = problem.solve()
        assert step.verdict.failures == [] and step.contacts["contact"].stick == 0
        moved = gathered(COMM, contact.values.increment)[:, 0]
        assert close(moved, np.full_like(moved, (0.4 - MU) / RATE), 1e-4)
        problem.commit()


@pytest.mark.parametrize("kinematics", ["small", "finite"])
@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_the_tangent_has_the_slip_distance(cell, kinematics):
    """Tractions and their derivative at the points: central differences, to 1e-6."""
    scene = block(cell, n=2, E=1e3, shuffled=True)
    law = Strengthening(MU, k_n=2e3, k_t=1e3, rate=RATE)
    contact = scene.contact(law, kinematics=kinematics)
    d = scene.dim

    def at(step):
        scene.u.interpolate(
            lambda x: (
                np.stack([0.05 + 0.02 * x[0]] * (d - 1) + [-0.01 - 0.01 * x[0]])
                + step * wave(d, 3)(x)
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
    jump.interpolate(wave(d, 3))
    scene.u.x.array[:] = jump.x.array
    direction = contact.contact_kinematics.present_jump()
    exact = np.einsum("qij,qj->qi", by_jump, direction)
    assert close(gathered(COMM, change), gathered(COMM, exact), 1e-6)
