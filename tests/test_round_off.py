"""Bodies displaced far, much stiffer than their obstacle: only round-off is accepted.

A displacement u of a body of stiffness k has a round-off of its forces of about 1e-16 k u, which
may exceed all contact forces on a softer body.
"""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from benchmarks import random_scenes
from fenics_contact.elasticity import LinearElastic
from fenics_contact.types import Array
from scenes.blocks import BOTTOM, LEFT, TOP
from scenes.bodies import Bodies, boxes
from scenes.comparison import assert_raised_on_all_ranks, is_close
from scenes.tags import at_coordinate, at_interface
from scenes.unrelated_bodies import Box, SceneWithUnrelatedBodies
from verification.fuzz_setup import run_history

COMM = MPI.COMM_WORLD
TIMES = np.linspace(0.25, 2.0, 8)
pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(300)]
SOLVER_OPTIONS = [
    {},
    {"method": "lbfgs", "condensation": False},
    {"method": "newton", "condensation": False},
]


def press_block_on_slab(stiffness: float, carried: float, **options) -> tuple[Array, fc.Step]:
    """Return the contact force of a block, and the step.

    The block, E = 1, is on a slab ``stiffness`` times as stiff; both are displaced by ``carried``.
    """
    slab = Box((-0.5, -0.5), (2.0, 0.5), (6, 2), stiffness)
    scene = SceneWithUnrelatedBodies({"slab": slab, "block": Box(n=(4, 4))})
    along = scene.bodies.constant(carried)
    scene.prescribe("slab", BOTTOM, 0, value=along)
    scene.prescribe("slab", BOTTOM, 1)
    scene.prescribe("block", TOP, 0, value=along)
    scene.prescribe("block", TOP, 1, value=-1e-2)
    contact = scene.contact("block", BOTTOM, ("slab", TOP), fc.Coulomb(0.3), name="joint")
    step = scene.problem(contact, **options).solve()
    return step.contacts["joint"].force, step


@pytest.mark.each
@pytest.mark.parametrize("options", SOLVER_OPTIONS, ids=["condensed", "lbfgs", "newton"])
@pytest.mark.parametrize(
    ("stiffness", "carried"), [(1e6, 10.0), (1e8, 10.0), (1e9, 10.0), (1e12, 0.3)]
)
def test_soft_block_on_a_displaced_stiff_slab(stiffness, carried, options):
    """The block's force is as without displacement, to 1e-8; an inexact slab is warned of.

    A residual of 1e-2 of the force at 1e9, and of more than all of it at 1e12, once passed: the
    force was off by 0.25 to 6 %. The tolerance is 1e-9 of the forces; displacements of 10 have a
    round-off of 1e-15, and the block is pressed by 1e-2.
    """
    expected, undisplaced = press_block_on_slab(stiffness, 0.0, **options)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        computed, step = press_block_on_slab(stiffness, carried, **options)
    assert is_close(computed, expected, 1e-8)
    inexact = step.verdict.inexact
    assert set(inexact) <= {"body 1"}
    messages = [
        str(w.message) for w in caught if "round-off of its displacements" in str(w.message)
    ]
    assert len(messages) == len(inexact)
    assert bool(inexact) == (stiffness > 1e7)
    # Translation costs no iterations. Measured: 3 of 3 by Newton's method, 2 or 3 of 7 by L-BFGS.
    assert step.iterations <= undisplaced.iterations + 1


def test_unconstrained_stiff_slab_between_blocks():
    """A displaced slab between two blocks is refused if its equilibrium is round-off.

    The forces on its two sides cannot be determined then, and the error states the reason. With the
    stiffness of the blocks the forces balance, to 1e-8.
    """

    def press_between_bodies(stiffness):
        slab = Box((-0.5, -0.2), (2.0, 0.2), (6, 2), stiffness)
        scene = SceneWithUnrelatedBodies({"low": Box((0.0, -1.2)), "slab": slab, "high": Box()})
        along = scene.bodies.constant(0.3)
        scene.prescribe("low", BOTTOM, 0, value=along)
        scene.prescribe("low", BOTTOM, 1)
        scene.prescribe("high", TOP, 0, value=along)
        scene.prescribe("high", TOP, 1, value=-1e-2)
        joints = [
            scene.contact(box, side, ("slab", other), fc.Coulomb(0.3), name=box)
            for box, side, other in (("high", BOTTOM, TOP), ("low", TOP, BOTTOM))
        ]
        step = scene.problem(*joints, fallback=False, method="newton").solve()
        return [step.contacts[joint.name].force for joint in joints]

    high, low = press_between_bodies(1.0)
    assert is_close(high + low, 0 * high, 1e-8 * np.linalg.norm(high), scale=1.0)
    assert_raised_on_all_ranks(
        lambda: press_between_bodies(1e12), fc.NotConverged, "with a round-off of"
    )


@pytest.mark.each
@pytest.mark.parametrize("E", [1.0, 2e11])
@pytest.mark.parametrize("kinematics", ["small", "finite"])
def test_round_off_of_a_load_counts_as_zero(kinematics, E):
    """A load of 1e-16 of its amplitude, at a zero of a sine, counts as zero.

    It acts on a body displaced by 0.3. Its residual was once compared with this load itself, and
    refused. Reference: a load of 0, to 1e-12 of the forces, the round-off of those before.
    """

    def forces(loads):
        scene = SceneWithUnrelatedBodies({"block": Box()}, E=E)
        load, along = scene.bodies.constant(0.0), scene.bodies.constant(0.0)
        scene.load("block", TOP, 1, load)
        scene.prescribe("block", LEFT, 0, value=along)
        scene.prescribe("block", LEFT, 1)
        floor = fc.HalfSpace((0, -1e-3), (0, 1))
        contact = scene.contact("block", BOTTOM, floor, fc.Coulomb(0.3), kinematics=kinematics)
        problem = scene.problem(contact, small_displacement_tolerance=np.inf)
        computed = []
        for time, value in zip(TIMES, loads, strict=True):
            load.value, along.value = -1e-2 * E * value, 0.3 * time
            problem.solve()
            problem.commit()
            computed.append(contact.resultants().force)
        return np.array(computed)

    sine = np.sin(np.pi * TIMES)
    exact = np.where(np.isclose(sine, 0.0), 0.0, sine)
    assert np.any((sine != 0) & (exact == 0))
    computed, expected = forces(sine), forces(exact)
    assert np.abs(expected).max() > 1e-3 * E
    assert np.abs(computed - expected).max() <= 1e-12 * np.abs(expected).max()


def test_round_off_forces_after_unloading_are_accepted():
    """A block between a cylinder and a floor is moved back until forces are 1e-12.

    They result from errors of the forces before, pass as round-off without a warning, and do not
    grow when the block stays there. Reference: zero, to 1e-9 of the forces before.
    """
    scene = random_scenes.draw_small(940025, 940025 // random_scenes.FAMILY)
    scene = {
        name: value for name, value in scene.items() if name not in random_scenes.SOLVER_OPTIONS
    }
    forces = []

    def take(record):
        forces.append(max(np.linalg.norm(contact["force"]) for contact in record["contacts"]))

    back = next(stage for stage in scene["stages"] if stage["normal"] == 0.0)
    scene["stages"] = [scene["stages"][0], back, back | {"steps": 1}, scene["stages"][-1]]
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*round-off of its displacements")
        alone = {"cuts": 0, "method": "newton", "fallback": False}
        run_history(scene | alone, MPI.COMM_WORLD, take)
    assert len(forces) == 6
    assert max(forces[3:5]) < 1e-9 * forces[1]


@pytest.mark.parametrize("E", [1.0, 1e3, 1e9])
@pytest.mark.parametrize("kinematics", ["small", "finite"])
def test_round_off_forces_supply_no_energy(kinematics, E):
    """A block moves back and forth on a floor, pressed by the round-off of its position.

    Friction of 1e-14 at one end of an increment, and zero at the other, was reported as energy
    supplied, 100 % of the energy exchanged. Reference: zero forces, to 1e-12 of E.
    """
    scene = SceneWithUnrelatedBodies({"block": Box(n=(4, 4))}, E=E)
    place = [scene.bodies.constant(0.0) for _ in range(2)]
    for component, value in enumerate(place):
        scene.prescribe("block", TOP, component, value=value)
    floor = fc.HalfSpace((0, 0), (0, 1))
    contact = scene.contact("block", BOTTOM, floor, fc.Coulomb(0.3), kinematics=kinematics)
    problem = scene.problem(contact)
    for number, along in enumerate(0.1 * np.random.default_rng(0).normal(size=12)):
        place[0].value, place[1].value = along, -1e-17 if number % 2 else 0.0
        step = problem.solve()
        problem.commit()
        assert step.energy.friction_energy_gain == 0.0
        assert np.abs(contact.resultants().force).max() < 1e-12 * E


@pytest.mark.parametrize("options", SOLVER_OPTIONS, ids=["condensed", "lbfgs", "newton"])
def test_a_load_is_removed_after_a_restart(options):
    """The top of a block above the floor is moved back: u is zero, to 40 eps of the motion.

    The exact solution is zero, so that all forces at the end are round-off of the forces at the
    start, 40 eps of these. If the round-off is estimated as zero after a restart, the tolerance is
    1e-9 of the remaining forces and shrinks with them.
    """
    box = Box((0.0, 0.5), n=(4, 4), bend=lambda x: x + 0.05 * np.sin(7 * x[:, ::-1]))
    scene = SceneWithUnrelatedBodies({"block": box})
    top = scene.bodies.constant(0.0)
    scene.prescribe("block", TOP, 0)
    scene.prescribe("block", TOP, 1, value=top)
    problem = scene.problem(
        scene.contact("block", BOTTOM, fc.HalfSpace((0, 0), (0, 1)), fc.Frictionless()), **options
    )
    for top.value in (-0.03, -0.1):
        problem.solve()
        problem.commit()
    problem.restart_solver()
    top.value = 0.0
    assert problem.solve().iterations <= 2
    left = COMM.allreduce(np.abs(problem.u.x.array).max(initial=0.0), op=MPI.MAX)
    assert left <= 40 * np.finfo(float).eps * 0.1


@pytest.mark.parametrize("load", [1e-3, 1e-8, 1e-10])
@pytest.mark.parametrize("method", [None, "lbfgs"])
def test_stiff_free_blocks_carry_the_small_load_of_a_soft_one(method, load):
    """Four free blocks on a floor, the uppermost 1e6 times softer, with a load on it.

    Reference: statics, to 1e-6. The round-off of the positions of stiff bodies, as a force, is as
    large as the least load, but bears none of it.
    """
    n = 4
    axes = [
        [np.linspace(-0.4 + 0.05 * k, 0.4 - 0.05 * k, 4), np.linspace(k, k + 1.0, 4)]
        for k in range(n)
    ]
    faces = {1: at_coordinate(1, 0.0), 2: at_coordinate(1, float(n))}
    for k in range(1, n):
        faces |= {10 + k: at_interface(1, k, above=True), 20 + k: at_interface(1, k, above=False)}
    stack = Bodies(boxes(axes, faces), 1.0, 0.3)
    modulus = fem.Function(fem.functionspace(stack.mesh, ("DG", 0)))
    for k in range(n):
        cells = stack.cells(lambda x, k=k: (x[:, -1] > k) & (x[:, -1] < k + 1))
        modulus.x.array[cells] = 1e6 if k < n - 1 else 1.0
    stack.F = LinearElastic(stack.u, modulus, 0.3, "plane strain").residual(stack.v)
    traction = load * ufl.as_vector((0.05, -1.0))
    stack.F -= ufl.dot(traction, stack.v) * stack.ds(2)
    law = fc.Coulomb(0.3)
    contacts = [stack.contact(1, fc.HalfSpace((0, 0), (0, 1)), law, name="floor")]
    for k in range(1, n):
        contacts.append(stack.contact(10 + k, 20 + k, law, name=f"joint {k}"))
    step = stack.problem(*contacts, method=method).solve()
    for result in step.contacts.values():
        assert result.normal_force == pytest.approx(0.5 * load, rel=1e-6)
