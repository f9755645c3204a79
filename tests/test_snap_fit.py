"""A rigid tool pushed by a force against a soft slope, as in a snap fit."""

from __future__ import annotations

import numpy as np
import pytest

import fenics_contact as fc
from scenes.blocks import LEFT, RIGHT, TOP
from scenes.unrelated_bodies import Box, SceneWithUnrelatedBodies

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(240)]
RADIUS, SLOPE, PRESCRIBED_DISPLACEMENT = 2.0, 0.5, 0.5


def push_along_cantilever(by, loads, *, friction):
    """Push a disc along x up a rising cantilever; return force, position, iterations, (3, n)."""

    def rising(x):
        return np.column_stack([x[:, 0], x[:, 1] + SLOPE * x[:, 0]])

    scene = SceneWithUnrelatedBodies(
        {"arm": Box(size=(5.0, 0.5), n=(60, 4), bend=rising)}, E=1e3, rubber=True
    )
    scene.prescribe("arm", LEFT, 0)
    scene.prescribe("arm", LEFT, 1)
    load = scene.bodies.constant(0.0)
    forces, displacements = (
        ((load, None), (None, 0.0)) if by == "force" else ((None, None), (load, 0.0))
    )
    motion = fc.Motion(force=forces, displacement=displacements)
    normal = np.array([-SLOPE, 1.0]) / np.hypot(SLOPE, 1.0)
    centre = np.array([3.0, 0.5 + 3.0 * SLOPE]) + RADIUS * normal
    tool = fc.Cylinder(centre, RADIUS, displacement=motion)
    law = fc.Coulomb(friction) if friction else fc.Frictionless()
    contact = scene.contact("arm", TOP, tool, law, kinematics="finite")
    problem = scene.problem(contact)
    computed = []
    for value in loads:
        load.value = value
        step = problem.solve()
        problem.commit()
        along = contact.motions[0].value if by == "force" else value
        computed.append((contact.resultants().force[0], along, step.iterations))
    return np.array(computed).T


@pytest.mark.parametrize("friction", [0.0, 0.2])
def test_force_and_displacement_control_agree(friction):
    """The force due to a prescribed displacement causes this displacement, to 1e-6.

    The tool has one or two closed points. An iterate without any once closed the gap by the
    deformation due to a closed point, a thousandth of it: "no progress", however small the
    increments.
    """
    displacements = np.linspace(0.1, 1.0, 10) * PRESCRIBED_DISPLACEMENT
    forces, _, _ = push_along_cantilever("displacement", displacements, friction=friction)
    assert np.all(np.diff(forces) > 0)
    computed, places, iterations = push_along_cantilever("force", forces, friction=friction)
    assert np.abs(computed - forces).max() <= 1e-8 * forces.max()
    assert np.abs(places - displacements).max() <= 1e-6 * PRESCRIBED_DISPLACEMENT
    assert iterations.max() <= 40  # 5 to 13


def first_newton_displacement(gap, force, other_gaps=(), *, along=None):
    """Return the first Newton displacement of a tool above an arm, by a force along y (length).

    ``other_gaps``: gap of a wall next to the arm, which the tool does not move. ``along``: a force
    along x on the tool; by default its displacement along x is prescribed.
    """
    scene = SceneWithUnrelatedBodies({"arm": Box(size=(1.0, 1.0), n=(4, 4))}, E=1e3)
    scene.prescribe("arm", LEFT, 0)
    scene.prescribe("arm", LEFT, 1)
    prescribed = 0.0 if along is None else None
    motion = fc.Motion(force=(along, force), displacement=(prescribed, None))
    tool = fc.HalfSpace((0.0, 1.0 + gap), (0, -1), displacement=motion)
    contacts = [scene.contact("arm", TOP, tool, fc.Coulomb(3.0), name="tool")]
    if other_gaps:
        wall = fc.HalfSpace((1.0 + other_gaps[0], 0.0), (-1, 0))
        contacts.append(scene.contact("arm", RIGHT, wall, fc.Frictionless(), name="parked"))
    problem = scene.problem(*contacts, condensation=False, method="newton")
    equations = problem.solver.equations
    equations.system.begin(problem.full.present_load())
    x = equations.solution
    x.array[:] = problem.full.state() / equations.length
    equations.residual(x, equations.function)
    matrix = equations.matrix(True)
    equations.assemble_tangent(x, matrix)
    change = equations.function.duplicate()
    equations.solvers[True].setOperators(matrix)
    equations.solvers[True].solve(-equations.function, change)
    motions = equations.system.unknowns.motions(change.array_r * equations.length)
    return float(motions[-1])


@pytest.mark.parametrize("gap", [1e-2, 1e-6])
@pytest.mark.parametrize("other_gaps", [(), (1e-7,)], ids=["alone", "next to a nearer wall"])
def test_newton_step_is_twice_the_gap(gap, other_gaps):
    """A tool above the arm, pressed down, moves by twice its gap, whatever other gaps there are.

    Tolerance 1e-3, as the arm deforms by force/E and a closed point carries the force, plus the gap
    by the size of the mesh, as any step is at most twice that size.
    """
    moved = first_newton_displacement(gap, -1e-7, other_gaps)
    assert moved == pytest.approx(-2 * gap, rel=1e-3 + gap)


def test_newton_step_with_a_larger_tangential_force():
    """A tool with a larger force along the surface nevertheless closes its gap."""
    moved = first_newton_displacement(1e-6, -1e-7, along=2e-7)
    assert moved == pytest.approx(-2e-6, rel=1e-3)


@pytest.mark.parametrize("other_gaps", [(), (1e-7,)], ids=["alone", "next to a nearer wall"])
def test_newton_step_away_from_the_surface(other_gaps):
    """A tool pushed away from an arm meets nothing, and moves by twice the mesh size, √2."""
    assert first_newton_displacement(1e-6, 1e-7, other_gaps) == pytest.approx(
        2 * np.sqrt(2), rel=1e-3
    )


def test_force_above_the_limit_of_the_arm():
    """The error suggests prescribing the displacement instead."""
    with pytest.raises(fc.NotConverged, match="displacement of the obstacle instead of the force"):
        push_along_cantilever("force", [1.0], friction=0.2)
