"""Three bodies and three contacts, one of the bodies held by friction alone."""

from __future__ import annotations

import pytest

import fenics_contact as fc
from scenes.bolted_joint import FRICTION, BoltedJoint
from scenes.comparing import raised_everywhere

pytestmark = pytest.mark.two_ranks


def test_tightened_and_pulled_until_it_slips() -> None:
    """The bolt and the upper plate are in equilibrium, friction bears what it can, and no more.

    The references are statics: what pulls is borne by plates and bolt, and what the bolt takes at
    its head it gives at its nut, to 1e-3 of the clamping force (the preset solves to 1e-4 of each
    body's forces). Linear elements, on which the clamping force itself depends, serve for that.
    """
    made = BoltedJoint(5.0, degree=1)
    for _ in made.increments(3.5, steps=7):
        r = {c.name: c.resultants() for c in made.contacts}
        clamped = r["head"].normal_force
        assert r["nut"].normal_force == pytest.approx(clamped, rel=1e-3)
        assert abs(r["nut"].force[0] + r["head"].force[0]) < 1e-3 * clamped
        borne = r["plates"].force[0] + r["head"].force[0]
        assert abs(borne - float(made.pull.value)) < 1e-3 * clamped
        for found in r.values():
            assert found.tangential_force <= FRICTION * found.normal_force * (1 + 1e-9)
    # The plates slip as a whole by now; what is more goes through the bolt.
    assert r["plates"].stick == 0
    assert r["plates"].force[0] == pytest.approx(FRICTION * r["plates"].normal_force, rel=1e-3)
    limit = FRICTION * (r["plates"].normal_force + clamped)
    assert limit > float(made.pull.value) > 0.7 * limit
    made.load(1.0 + 1.02 * limit / 1000.0)
    words = "overload: along the translation along x of body 2"
    failed: list[fc.NotConverged] = []

    def solve() -> None:
        try:
            made.problem.solve()
        except fc.NotConverged as error:
            failed.append(error)
            raise

    raised_everywhere(solve, fc.NotConverged, words)
    # In the first round of multipliers the last method tells of it, in 10 iterations; in the second
    # it is asked alone, in 11. How many rounds of 20 iterations L-BFGS makes before is decided by
    # round-off.
    tried = failed[0].attempts
    every = ["lbfgs", "primal_dual", "continuation", "alternating", "alternating"]
    assert [each.method for each in tried] == every
    assert all(each.iterations < 20 for each in tried[3:])


def test_tightened_where_all_points_of_a_joint_slip() -> None:
    """Quadratic elements, whose deformed faces call for the estimate of what that changes.

    All points below head and nut slip: what turns with their slip alone holds the bolt. It was
    refused, as loose. References: statics, as above; what is said to change, 1 % at most.
    """
    made = BoltedJoint(5.0, degree=2)
    for load in (0.5, 1.0):
        made.load(load)
        step = made.problem.solve()
        made.problem.commit()
        assert all(step.contacts[name].stick == 0 for name in ("head", "nut"))
        assert step.attempts[0].method == "lbfgs"  # the default though contact holds the bolt
        assert max(each.worst for each in step.verdict.small_displacement_error.values()) < 0.01
        forces = [contact.resultants().normal_force for contact in made.contacts]
        assert forces == pytest.approx([forces[1]] * 3, rel=1e-3)
