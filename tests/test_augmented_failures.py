"""Augmented enforcement where it fails: nothing is changed, and the reason is told."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.methods import augmented_lagrangian as module
from scenes.blocks import RIGHT, TOP, block, bulge
from scenes.comparing import raised_everywhere
from scenes.rubber import rubber

COMM = MPI.COMM_WORLD
E = 1000.0
pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]

# k h/E: springs no stiffer than a few layers of cells.
SOFT = fc.RelativeStiffness(10.0)
AUGMENTED = {"enforcement": "augmented"}


@pytest.mark.parametrize("what", ["iterations", "rounds"])
def test_failure_leaves_no_trace(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Too few iterations or rounds: `NotConverged`; u, history and multipliers bit for bit."""
    scene = block("quadrilateral", 1, n=4, up=-10.0)
    problem, contact = scene.problem(
        fc.Coulomb(0.3, k_n=1e4, k_t=1e4), [], contact={"obstacle": bulge(scene)} | AUGMENTED
    )
    problem.solve()
    problem.commit()

    def state() -> list[np.ndarray]:
        functions = (scene.u, contact.history.function, contact.multipliers.fields.function)
        return [f.x.array.copy() for f in functions]

    before = state()
    if what == "rounds":
        monkeypatch.setattr(module, "_MAX_AUGMENTATIONS", 2)
    else:
        problem.snes.setTolerances(max_it=0)
        problem.solver.main.max_it = 0
        problem.solver.predictor.predict = False  # that guess can be the solution
    scene.load(up=-30.0, side=5.0)
    words = (
        ("augmented Lagrangian method has not converged",) if what == "rounds" else ("increment 2",)
    )
    raised_everywhere(problem.solve, fc.NotConverged, *words)
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
def test_bad_arguments(case: str) -> None:
    """Refused by `Contact`, on all ranks, by name."""
    options, law, words = BAD[case]
    scene = block("quadrilateral", 1, surface={"quadrature_scheme": "vertex"})
    call = lambda: scene.contact(law, **(AUGMENTED | options))  # noqa: E731
    raised_everywhere(call, ValueError, "contact", *words)


def test_no_multipliers_under_penalty() -> None:
    """The penalty has none to update."""
    scene = block("quadrilateral", 1)
    contact = scene.contact(fc.Frictionless(k_n=1e3))
    raised_everywhere(contact.augment, ValueError, "augmented")
    assert contact.multipliers is None


def test_a_contact_that_only_the_first_round_touches() -> None:
    """A ledge that the top reaches while the springs below still give, and then no more.

    Reference: the load of 1, all of it on the floor, to the solver's tolerance of 1e-9; the block
    gives way by 0.91e-3, the first springs by 1e-2, and the ledge is 5e-3 away.
    """
    scene = block("quadrilateral", up=-1.0)
    floor = scene.contact(fc.Frictionless(100.0), name="floor", **AUGMENTED)
    top = fc.ContactSurface(scene.mesh, scene.tags, TOP)
    obstacle = fc.PrescribedGap(5e-3, (0.0, -1.0))
    ledge = fc.Contact(
        scene.u, top, obstacle, fc.Frictionless(100.0), name="ledge", enforcement="augmented"
    )
    errors = []
    kept = ledge.enforcement_error

    def noted() -> float:
        errors.append(kept())
        return errors[-1]

    ledge.enforcement_error = noted
    problem = fc.ContactProblem(scene.F, scene.u, bcs=scene.rollers(), contacts=[floor, ledge])
    step = problem.solve()
    assert errors[0] > 0.0  # it did touch
    assert step.contacts["floor"].normal_force == pytest.approx(1.0, rel=1e-8)
    assert step.contacts["ledge"].normal_force == 0.0
    assert step.verdict.enforcement["ledge"] == 0.0 and not step.verdict.failures


@pytest.mark.parametrize("kinematics", ["small", "finite"])
@pytest.mark.parametrize("method", ["newton", "lbfgs"])
def test_a_node_held_inside_of_the_obstacle_is_refused(kinematics, method):
    """A side of a block whose lower node a condition moves into a wall: nothing undoes that.

    Multipliers grew there from round to round, until what the springs bore was small beside them:
    a pressure of 1e15 and more passed. Moved away from the wall, or by springs alone, it is solved.
    """
    found = []
    for enforcement, way in (("augmented", 0.02), ("augmented", -0.02), ("penalty", 0.02)):
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
        scene.place(lambda x, way=way: x + np.array([[way], [0.0]]))
        if enforcement == "augmented" and way > 0:
            with pytest.raises(
                fc.NotConverged, match="prescribes a node of Γc inside of the obstacle"
            ):
                problem.solve()
        else:
            problem.solve()
            found.append(contact.resultants().normal_force)
    assert found[0] == 0.0 and 0.0 < found[1] < 1e3
