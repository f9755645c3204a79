"""Three bodies and three contacts; one of the bodies is constrained by friction alone."""

from __future__ import annotations

import pytest

import fenics_contact as fc
from scenes.bolted_joint import FRICTION, BoltedJoint
from scenes.comparison import assert_raised_on_all_ranks

pytestmark = pytest.mark.two_ranks


def test_tightened_joint_is_pulled_to_the_friction_limit() -> None:
    """Bolt and upper plate are in equilibrium up to the friction limit, above which it is stated.

    The references are statics: the pull is carried by plates and bolt, and the forces on head and
    nut of the bolt cancel, to 1e-3 of the clamping force (the preset solves to 1e-4 of each body's
    forces). Linear elements, on which the clamping force itself depends, are sufficient for this.
    """
    setup = BoltedJoint(5.0, degree=1)
    for _ in setup.increments(3.5, steps=7):
        r = {c.name: c.resultants() for c in setup.contacts}
        clamped = r["head"].normal_force
        assert r["nut"].normal_force == pytest.approx(clamped, rel=1e-3)
        assert abs(r["nut"].force[0] + r["head"].force[0]) < 1e-3 * clamped
        plate_force = r["plates"].force[0] + r["head"].force[0]
        assert abs(plate_force - float(setup.pull.value)) < 1e-3 * clamped
        for resultants in r.values():
            assert resultants.tangential_force <= FRICTION * resultants.normal_force * (1 + 1e-9)
    # All points of the plates slip now; the bolt carries the rest.
    assert r["plates"].stick == 0
    assert r["plates"].force[0] == pytest.approx(FRICTION * r["plates"].normal_force, rel=1e-3)
    limit = FRICTION * (r["plates"].normal_force + clamped)
    assert limit > float(setup.pull.value) > 0.7 * limit
    setup.load(1.0 + 1.02 * limit / 1000.0)
    words = "overload: along the translation along x of body 2"
    failed: list[fc.NotConverged] = []

    def solve() -> None:
        try:
            setup.problem.solve()
        except fc.NotConverged as error:
            failed.append(error)
            raise

    assert_raised_on_all_ranks(solve, fc.NotConverged, words)
    # The fixed-point iteration detects the overload before and after the first augmentation, in 30
    # iterations. How many times L-BFGS makes 20 iterations before depends on round-off.
    first, *others = failed[0].attempts
    assert first.method == "lbfgs"
    assert {each.method for each in others} == {"alternating"}
    assert sum(each.iterations for each in others) < 60


def test_joint_is_tightened_if_all_points_of_head_and_nut_slip() -> None:
    """With quadratic elements the small-displacement error of the deformed faces is estimated.

    All points below head and nut slip: only the change of the friction's direction with the slip
    constrains the bolt. It was refused, as unconstrained. References: statics, as above; the
    small-displacement error, at most 1 %.
    """
    setup = BoltedJoint(5.0, degree=2)
    for load in (0.5, 1.0):
        setup.load(load)
        step = setup.problem.solve()
        setup.problem.commit()
        assert all(step.contacts[name].stick == 0 for name in ("head", "nut"))
        assert step.attempts[0].method == "lbfgs"  # default, although the bolt is free
        assert max(each.worst for each in step.verdict.small_displacement_error.values()) < 0.01
        forces = [contact.resultants().normal_force for contact in setup.contacts]
        assert forces == pytest.approx([forces[1]] * 3, rel=1e-3)
