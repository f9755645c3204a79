"""Failures of augmented enforcement change nothing, and the error states the reason."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.methods import augmented_lagrangian as module
from scenes.blocks import RIGHT, TOP, block, parabolic_floor
from scenes.comparison import assert_raised_on_all_ranks
from scenes.rubber import rubber

COMM = MPI.COMM_WORLD
E = 1000.0
pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]

# k h/E: springs as stiff as a few layers of cells.
SOFT = fc.RelativeStiffness(10.0)
AUGMENTED = {"enforcement": "augmented"}


@pytest.mark.parametrize("limit", ["iterations", "augmentations"])
def test_failure_leaves_no_trace(limit: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Too few iterations or augmentations leave u, history and multipliers bitwise unchanged."""
    scene = block("quadrilateral", 1, n=4, up=-10.0)
    problem, contact = scene.problem(
        fc.Coulomb(0.3, k_n=1e4, k_t=1e4),
        [],
        contact={"obstacle": parabolic_floor(scene)} | AUGMENTED,
    )
    problem.solve()
    problem.commit()

    def state() -> list[np.ndarray]:
        functions = (scene.u, contact.history.function, contact.multipliers.fields.function)
        return [f.x.array.copy() for f in functions]

    before = state()
    if limit == "augmentations":
        monkeypatch.setattr(module, "_MAX_AUGMENTATIONS", 2)
    else:
        problem.snes.setTolerances(max_it=0)
        problem.solver.main.max_it = 0
        # The predicted state can be the solution.
        problem.solver.equations.has_solution_tangent = False
    scene.load(up=-30.0, side=5.0)
    words = (
        ("augmented Lagrangian method has not converged",)
        if limit == "augmentations"
        else ("increment 2",)
    )
    assert_raised_on_all_ranks(problem.solve, fc.NotConverged, *words)
    assert all(np.array_equal(a, b) for a, b in zip(before, state(), strict=True))
    monkeypatch.undo()


BAD = {
    "enforcement": ({"enforcement": "lagrange"}, fc.Frictionless(), ("enforcement", "lagrange")),
    "zero": ({"tolerance": 0.0}, fc.Frictionless(), ("tolerance", "0.0")),
    "nan": ({"tolerance": float("nan")}, fc.Frictionless(), ("tolerance", "nan")),
    "one": ({"tolerance": 1.0}, fc.Frictionless(), ("tolerance",)),
    "foundation": ({}, fc.Foundation(k_n=1e3), ("Foundation", "penalty")),
    "springs": ({}, fc.Coulomb(0.3, fc.NodalSprings(1e3), 1e3), ("NodalSprings", "penalty")),
}


@pytest.mark.whole
@pytest.mark.parametrize("case", BAD)
def test_invalid_arguments_are_refused(case: str) -> None:
    """`Contact` refuses invalid arguments on all ranks, and names them."""
    options, law, words = BAD[case]
    scene = block("quadrilateral", 1, surface={"quadrature_scheme": "vertex"})
    call = lambda: scene.contact(law, **(AUGMENTED | options))  # noqa: E731
    assert_raised_on_all_ranks(call, ValueError, "contact", *words)


def test_penalty_has_no_multipliers() -> None:
    """`augment` is refused for the penalty, which has no multipliers."""
    scene = block("quadrilateral", 1)
    contact = scene.contact(fc.Frictionless(k_n=1e3))
    assert_raised_on_all_ranks(contact.augment, ValueError, "augmented")
    assert contact.multipliers is None


def test_contact_closed_only_before_the_first_augmentation() -> None:
    """The top reaches a ledge while the springs of the floor are compressed, and later leaves it.

    Reference: the load of 1, all of it on the floor, to 1e-8 (the solver's tolerance is 1e-9). The
    block shortens by 0.91e-3, the springs by 1e-2 at first, and the gap to the ledge is 5e-3.
    """
    scene = block("quadrilateral", up=-1.0)
    floor = scene.contact(fc.Frictionless(100.0), name="floor", **AUGMENTED)
    top = fc.ContactSurface(scene.mesh, scene.tags, TOP)
    obstacle = fc.PrescribedGap(5e-3, (0.0, -1.0))
    ledge = fc.Contact(
        scene.u, top, obstacle, fc.Frictionless(100.0), name="ledge", enforcement="augmented"
    )
    errors = []
    error_before = ledge.enforcement_error

    def noted() -> float:
        errors.append(error_before())
        return errors[-1]

    ledge.enforcement_error = noted
    problem = fc.ContactProblem(scene.F, scene.u, bcs=scene.rollers(), contacts=[floor, ledge])
    step = problem.solve()
    assert errors[0] > 0.0  # the ledge was in contact
    assert step.contacts["floor"].normal_force == pytest.approx(1.0, rel=1e-8)
    assert step.contacts["ledge"].normal_force == 0.0
    assert step.verdict.enforcement["ledge"] == 0.0 and not step.verdict.failures


@pytest.mark.parametrize("kinematics", ["small", "finite"])
@pytest.mark.parametrize("method", ["newton", "lbfgs"])
def test_dirichlet_node_inside_the_obstacle_is_refused(kinematics, method):
    """A Dirichlet condition that moves a node of Γc into a wall is refused with multipliers.

    The penetration cannot be removed: once the multipliers grew until the penalty part was small
    relative to them, and pressures of 1e15 were accepted. If the node moves away from the wall, or
    with the penalty, the problem is solved.
    """
    computed = []
    for enforcement, displacement in (("augmented", 0.02), ("augmented", -0.02), ("penalty", 0.02)):
        scene = rubber("quadrilateral", 1, n=(4, 4), linear=True)
        surface = fc.ContactSurface(scene.mesh, scene.tags, RIGHT)
        wall = fc.HalfSpace((1.0, 0.0), (-1.0, 0.0))
        options = {"kinematics": kinematics, "enforcement": enforcement}
        contact = fc.Contact(scene.u, surface, wall, fc.Coulomb(0.3), **options)
        problem = fc.ContactProblem(
            scene.F,
            scene.u,
            bcs=scene.bcs,
            contacts=[contact],
            method=method,
            small_displacement_tolerance=np.inf,
        )
        scene.move_bottom(
            lambda x, displacement=displacement: x + np.array([[displacement], [0.0]])
        )
        if enforcement == "augmented" and displacement > 0:
            with pytest.raises(
                fc.NotConverged, match="prescribes a node of Γc inside of the obstacle"
            ):
                problem.solve()
        else:
            problem.solve()
            computed.append(contact.resultants().normal_force)
    assert computed[0] == 0.0 and 0.0 < computed[1] < 1e3
