"""Tests of ``accuracy``: its choices, arguments that override it, and the resulting error."""

import itertools

import numpy as np
import pytest
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.contact.accuracy import DEFAULT_FACTOR, PRESETS
from fenics_contact.estimates.errors import quantities
from scenes.block_on_ball import ObliqueBlockOnBall, supporting_ball
from scenes.blocks import TOP, block
from scenes.comparison import assert_raised_on_all_ranks
from scenes.elasticity import stress

COMM = MPI.COMM_WORLD


def press(law=None, **contact) -> ObliqueBlockOnBall:
    """Return a scene of quadratic cells, solved by Newton's method."""
    law = law or fc.Coulomb(0.3)
    return ObliqueBlockOnBall(law, degree=2, mesh={"n": 8}, contact=contact, method="newton")


@pytest.fixture(scope="module")
def truth():
    """Return reference quantities, with multipliers to 1e-8 and 200 increments."""
    setup = press(
        fc.Coulomb(0.3, fc.RelativeStiffness(10), fc.RelativeStiffness(10)),
        enforcement="augmented",
        tolerance=1e-8,
    )
    setup.run(steps=200)
    return quantities(setup.problem)


@pytest.mark.parametrize("requested_accuracy", [*PRESETS, 3e-3])
def test_error_is_within_the_requested_accuracy(requested_accuracy, truth):
    """Normal force, friction force and peak pressure have the requested error, on equal meshes."""
    setup = press(accuracy=requested_accuracy)
    steps = setup.run()
    accuracy = fc.Accuracy.of(requested_accuracy)
    assert len(steps) == accuracy.increments
    computed = quantities(setup.problem)
    for name in ("normal force", "friction force", "peak pressure"):
        assert abs(computed[name] / truth[name] - 1) <= accuracy.error, name


def test_choices_are_monotonic_in_the_requested_error():
    """Smaller errors relax no choice; multipliers are used where stiffness would be expensive."""
    chosen = [fc.Accuracy.of(error) for error in (0.5, 0.05, 0.01, 1e-3, 1e-6, 1e-8)]
    for rough, fine in itertools.pairwise(chosen):
        assert fine.factor >= rough.factor
        assert fine.rtol <= rough.rtol
        assert fine.tolerance <= rough.tolerance
        assert fine.increments >= rough.increments
    assert [c.enforcement for c in chosen] == ["penalty"] * 2 + ["augmented"] * 4
    assert all(fc.Accuracy.of(word) == fc.Accuracy.of(error) for word, error in PRESETS.items())
    assert "augmented" in str(chosen[-1]) and "1e-08" in str(chosen[-1])


def test_explicit_arguments_override_the_accuracy():
    """Stiffness, enforcement, tolerance and number of increments given by the caller are used."""
    setup = press(
        fc.Coulomb(0.3, k_n=fc.RelativeStiffness(7), k_t=1e3),
        accuracy="fine",
        enforcement="penalty",
    )
    assert setup.contact.multipliers is None
    assert float(setup.contact.parameters["k_n"].value) == 7.0
    assert float(setup.contact.parameters["k_t"].value) == 1e3
    assert setup.problem.snes.getTolerances()[0] == fc.Accuracy.of("fine").rtol
    assert len(setup.run(steps=2)) == 2
    plain = press()
    assert float(plain.contact.parameters["k_n"].value) == DEFAULT_FACTOR
    assert plain.problem.accuracy is None and plain.problem.default_increments == 1
    assert press(fc.Frictionless(), accuracy="fine").problem.default_increments == 1
    overridden = press(accuracy="fine", tolerance=1e-3).contact
    assert overridden.tolerance == 1e-3 and overridden.multipliers is not None


def test_accuracy_does_not_change_physical_stiffness():
    """A foundation is not a regularisation: it keeps its stiffness and has no multipliers."""
    setup = press(fc.Foundation(1e4, 1e3), accuracy="fine").contact
    assert setup.multipliers is None
    assert float(setup.parameters["k_n"].value) == 1e4


def test_strictest_contact_determines_the_solver_tolerance():
    """The solver's tolerance is that of the strictest contact, if all state an accuracy."""
    for words, error in ((("draft", "fine"), 1e-3), (("draft", None), None)):
        scene = block("triangle", 1, n=2, up=-1.0)
        contacts = [
            scene.contact(fc.Frictionless(), name=str(i), accuracy=w) for i, w in enumerate(words)
        ]
        problem = fc.ContactProblem(scene.F, scene.u, bcs=scene.rollers(), contacts=contacts)
        assert (problem.accuracy and problem.accuracy.error) == error
        rtol = fc.Accuracy.of(error).rtol if error else 1e-9
        assert problem.snes.getTolerances()[0] == rtol


def test_recommended_mesh_has_the_requested_error():
    """On the mesh that the budget recommends the error is at most twice the requested one.

    The estimated rates are those of a contact zone that ends in the middle of cells; for a given
    mesh the error may be smaller or larger.
    """
    requested_accuracy = 5e-3
    setup = press(fc.Frictionless(), accuracy=requested_accuracy)
    setup.run()
    scene = setup.scene
    budget = fc.estimate_errors(setup.problem, stress(scene.u, scene.E, scene.nu))
    assert budget.wanted == requested_accuracy
    assert budget.h == pytest.approx(1 / 8, rel=1e-12)
    assert 0 < budget.h_wanted < budget.h
    assert "use facets" in str(budget)
    worst = max(budget.relative("discretisation").values())
    n = int(np.ceil(1 / budget.h_wanted))
    finer = block("quadrilateral", 2, n=n)
    bcs = [finer.dirichlet_bc(TOP, 0, 0.015), finer.dirichlet_bc(TOP, 1, -0.03)]
    contact = {"obstacle": supporting_ball(2), "accuracy": requested_accuracy}
    problem, _ = finer.problem(fc.Frictionless(), bcs, contact=contact, method="newton")
    problem.solve()
    refined = fc.estimate_errors(problem, stress(finer.u, finer.E, finer.nu))
    assert max(refined.relative("discretisation").values()) < min(worst, 2 * requested_accuracy)


@pytest.mark.whole
@pytest.mark.parametrize("requested_accuracy", ["best", 0.0, -1.0, 2.0, float("nan"), [0.1, 0.2]])
def test_wrong_accuracies_are_refused(requested_accuracy):
    """Unknown words and invalid errors are refused on all ranks, with a list of the choices."""
    assert_raised_on_all_ranks(
        lambda: press(accuracy=requested_accuracy), ValueError, "standard", "between"
    )
