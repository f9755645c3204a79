"""Regression tests of combined features that had separate tests only."""

from __future__ import annotations

import numpy as np
import pytest
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from scenes.blocks import TOP, block
from scenes.comparison import is_close, nodal_values
from scenes.stacks import FLOOR, LOWER, ROOF, UPPER, stack
from scenes.two_blocks import SlidingBlock
from scenes.user_laws import AsperityFriction

COMM = MPI.COMM_WORLD
K_N = 1e7
pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]


def test_law_with_normal_compliance_is_solved_with_unpaired_points():
    """A wide block on a narrow one is solved with half of the points of Γc unpaired."""
    body = stack("quadrilateral", (3, 6), (0.5, 0.5), widths=[0.5, 1.0])
    surface = fc.ContactSurface(body.mesh, body.tags, 10 + UPPER)
    law = AsperityFriction(0.3, 0.5, 2e-3, fc.RelativeStiffness())
    contact = fc.Contact(body.u, surface, fc.DeformableBody(body.tags, 10 + LOWER), law)
    body.prescribe(FLOOR, 0, 1)
    body.prescribe(ROOF, 0)
    body.prescribe(ROOF, 1, value=-5e-3)
    problem = fc.ContactProblem(body.F, body.u, bcs=body.bcs, contacts=[contact])
    step = problem.solve()
    assert 0 < contact.pairs.n_unpaired and step.verdict.failures == []
    assert step.contacts["contact"].normal_force > 0


@pytest.mark.parametrize("release", [None, 0.0])
def test_restart_finds_the_same_pairs_of_penetrating_bodies(release, tmp_path):
    """A restart finds the pairs of the uninterrupted history, also of penetrating points.

    Displacement and force of the next increment agree to 1e-9. The penalty is soft, so that points
    penetrate deeply.
    """

    def load(setup):
        def move(t):
            setup.top_displacement[-1].value, setup.top_displacement[0].value = (
                -5e-3 * min(t, 1.0),
                0.1 * max(t - 1.0, 0.0),
            )

        return move

    def make():
        law = fc.Coulomb(0.2, K_N / 50, K_N / 50)
        return SlidingBlock("quadrilateral", law, start=0.4, max_initial_penetration=release)

    uninterrupted = make()
    list(fc.increments(uninterrupted.problem, load(uninterrupted), 0.0, 3.0, steps=3))
    path = tmp_path / "state"
    path = COMM.bcast(path)
    first = make()
    steps = fc.increments(first.problem, load(first), 0.0, 3.0, steps=3, checkpoint=path)
    next(steps), next(steps)
    steps.close()
    resumed = make()
    remaining = list(
        fc.increments(resumed.problem, load(resumed), 0.0, 3.0, steps=3, checkpoint=path)
    )
    assert len(remaining) == 1
    assert resumed.contact.pairs.n_unpaired == uninterrupted.contact.pairs.n_unpaired
    assert is_close(nodal_values(resumed.u), nodal_values(uninterrupted.u), 1e-9)
    assert is_close(
        remaining[0].contacts["contact"].force, uninterrupted.contact.resultants().force, 1e-9
    )


def test_commit_that_fails_in_the_pair_search_changes_no_state(monkeypatch):
    """After a pair search that fails, a solve gives the results of a restored twin, to 1e-9."""
    law = fc.Coulomb(0.2, K_N, K_N)
    setup, reference = (SlidingBlock("quadrilateral", law, start=0.4) for _ in range(2))
    for each in (setup, reference):
        each.step(2e-3, 0.0)
        each.top_displacement[0].value = 0.15
        each.problem.solve()
    with monkeypatch.context() as patch:

        def failing_search(*args, **kwargs):
            find_pairs(*args, **kwargs)
            raise MemoryError("on purpose")

        find_pairs = setup.contact.contact_kinematics.find_pairs
        patch.setattr(setup.contact.contact_kinematics, "find_pairs", failing_search)
        with pytest.raises(MemoryError):
            setup.problem.commit()
    for each in (setup, reference):
        if each is reference:
            each.problem.restore()
        each.problem.solve()
        each.problem.commit()
        each.step(2e-3, 0.3)
    assert is_close(nodal_values(setup.u), nodal_values(reference.u), 1e-9)
    assert is_close(setup.contact.resultants().force, reference.contact.resultants().force, 1e-9)


def test_foundation_without_tangential_stiffness_on_a_ball():
    """The small-displacement error is finite also where k_t is zero."""
    scene = block("quadrilateral", n=4)
    law = fc.Foundation(1e3, fem.Constant(scene.mesh, 0.0))
    push = [
        scene.dirichlet_bc(TOP, i, fem.Constant(scene.mesh, v)) for i, v in enumerate((0.01, -0.05))
    ]
    contact = {"obstacle": fc.Ball((0.5, -2.0), 2.0)}
    problem, _ = scene.problem(law, push, contact=contact, small_displacement_tolerance=np.inf)
    verdict = problem.solve().verdict
    assert verdict.failures == [] and np.isfinite(verdict.small_displacement_error["contact"].worst)


def test_law_without_potential_is_refused_by_the_alternating_method():
    """A foundation without tension is refused; as a fallback the method fails without an error."""
    scene = block("quadrilateral", n=2, up=-1.0)
    law = fc.Foundation(1e3, 1e2, tension=False)
    with pytest.raises(ValueError, match="Foundation has no potential"):
        scene.problem(law, scene.rollers(), method="alternating")
    problem, _ = scene.problem(law, scene.rollers(), method="newton")
    alternation = problem.solver.methods["alternating"]
    assert alternation.solve()[1] < 0
    assert problem.solve().verdict.failures == []


def test_fallback_without_contact_fails_without_an_error():
    """Without any contact the alternating method reports failure instead of raising."""
    scene = block("quadrilateral", n=2, up=-1.0)
    problem = fc.ContactProblem(
        scene.F, scene.u, bcs=[scene.dirichlet_bc(TOP, i) for i in (0, 1)], method="newton"
    )
    assert problem.solver.methods["alternating"].solve()[1] < 0


def test_contact_between_bodies_has_no_potential():
    """Contact between two bodies cannot be written as a potential in u on Γc: refused."""
    setup = SlidingBlock("quadrilateral", fc.Frictionless(K_N), start=0.4)
    with pytest.raises(ValueError, match="opposing body"):
        setup.contact.potential()
