"""Limit points are reported under force control and passed under displacement control."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pytest
import ufl
from dolfinx import fem
from ufl.core.expr import Expr

import fenics_contact as fc
from fenics_contact.laws.base import ContactTraction, Law, PointKinematics
from scenes.blocks import TOP, block
from scenes.comparison import assert_raised_on_all_ranks

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(240)]
PEAK, REACH = 2.0, 0.01


@dataclass(frozen=True)
class Separation(Law):
    """r_n = e t₀ (g/d) exp(-g/d) has the largest tension t₀ at the gap d (Xu and Needleman)."""

    strength: float
    reach: float

    @property
    def has_tension(self) -> bool:
        """The law has tension where the gap is open."""
        return True

    def contact_traction(
        self, kinematics: PointKinematics, parameters: Mapping[str, Expr]
    ) -> ContactTraction:
        """Return the normal traction, which depends on the gap only."""
        x = kinematics.gap / parameters["reach"]
        pull = np.e * parameters["strength"] * x * ufl.exp(-x)
        return ContactTraction(pull)

    def normal_potential(self, kinematics: PointKinematics, parameters: Mapping[str, Expr]) -> Expr:
        """Return the potential, whose derivative with respect to the gap is r_n."""
        d = parameters["reach"]
        return -np.e * parameters["strength"] * (kinematics.gap + d) * ufl.exp(-kinematics.gap / d)


def glued_block(loading):
    """Return a block of size 1 glued to a floor, pulled by "force" or else by displacement."""
    scene = block("quadrilateral", n=2, E=1e3, nu=0.0, up=0.0)
    displacement = fem.Constant(scene.mesh, 0.0)
    bcs = [] if loading == "force" else [scene.dirichlet_bc(TOP, 1, displacement)]
    options = {"small_displacement_tolerance": np.inf}
    problem, _ = scene.problem(Separation(PEAK, REACH), [*scene.rollers(), *bcs], **options)

    def load(value):
        scene.load(up=value) if loading == "force" else setattr(displacement, "value", value)

    return problem, load


def test_force_control_stops_at_the_maximum_load():
    """The last load is area times strength, to twice the smallest increment, 0.25/64."""
    problem, load = glued_block("force")
    reached = []

    def history():
        for step in fc.increments(problem, load, 0.0, 2.5, steps=10):
            reached.append(step.load)

    assert_raised_on_all_ranks(history, fc.NotConverged, "limit point", "prescribe a displacement")
    assert PEAK - 2 * 0.25 / 64 <= reached[-1] <= PEAK


def test_displacement_control_passes_the_maximum_load():
    """Column and glue in series have p = r_n(u - p/E), to 1e-6, before and after the peak."""
    problem, load = glued_block("displacement")
    forces = []
    for step in fc.increments(problem, load, 0.0, 5 * REACH, steps=25):
        force = step.contacts["contact"].force[1]
        gap = step.load + force / 1e3  # the force on the block is downwards
        assert -force == pytest.approx(np.e * PEAK * gap / REACH * np.exp(-gap / REACH), rel=1e-6)
        forces.append(-force)
    assert max(forces) == pytest.approx(PEAK, rel=2e-2) and forces[-1] < 0.3 * PEAK


def test_other_failures_are_not_reported_as_limit_point():
    """A failure below the maximum, here without iterations, is not reported as a limit point."""
    problem, load = glued_block("force")
    history = fc.increments(problem, load, 0.0, 1.0, steps=4)
    next(history)
    problem.solver.main.max_it = 0
    with pytest.raises(fc.NotConverged) as caught:
        list(history)
    assert "limit point" not in str(caught.value)
