"""Balance of a load by contact forces: whether it is in the cone of rays, or outside."""

import numpy as np
import pytest

import fenics_contact as fc
from fenics_contact.methods.load_balance import unbalanced
from scenes.blocks import block
from scenes.comparison import assert_raised_on_all_ranks
from scenes.stacks import ROOF, floor, stack

pytestmark = pytest.mark.two_ranks


@pytest.mark.parametrize("m", [1, 2, 3, 6])
def test_forces_inside_and_outside_of_a_cone(m):
    """Sums of rays in a half-space are balanced, forces that point out of it are not.

    The remainder of a force outside is at least its component along the half-space's normal w over
    max|w|, because Σ|w·rest| ≤ max|w| Σ|rest|.
    """
    rng = np.random.default_rng(m)
    for _ in range(100):
        w = rng.normal(size=m)
        w /= np.linalg.norm(w)
        rays = rng.normal(size=(m, 40 * m))
        rays *= np.where(w @ rays > 0, -1.0, 1.0)
        rays /= np.linalg.norm(rays, axis=0)
        inside = rays @ rng.exponential(size=rays.shape[1]) ** 8
        inside /= np.abs(inside).max()
        assert unbalanced(rays, inside) < 1e-9
        outside = inside + (abs(w @ inside) + 10.0 ** rng.uniform(-6, 0)) * w
        assert unbalanced(rays, outside) >= 0.99 * (w @ outside) / np.abs(w).max()


@pytest.mark.each
@pytest.mark.parametrize("needed", range(7))
def test_single_balancing_ray_of_many_is_found(needed):
    """A part of the rays is tried first; the only one along the force may be any of them.

    Without it no ray has a component along the third axis, and the whole force remains.
    """
    rng = np.random.default_rng(needed)
    rays = np.vstack([rng.normal(size=(2, 50_001)), np.zeros(50_001)])
    rays /= np.linalg.norm(rays, axis=0)
    force = np.array([0.0, 0.0, 1.0])
    assert unbalanced(rays, force) == pytest.approx(1.0)
    rays[:, -1 - needed] = force
    assert unbalanced(rays, force) == 0.0


@pytest.mark.parametrize("n", [3, 5, 12])
@pytest.mark.parametrize("above", [0.9, 1.01])
def test_block_below_and_above_the_friction_limit(n, above):
    """A force of less than μ times its weight on a block is balanced, a larger one is refused."""
    # A low block, so that it does not tip: the push acts at half its height.
    scene = block("quadrilateral", up=-1.0, side=0.3 * above, n=n, size=[1.0, 0.1])
    problem, _ = scene.problem(fc.Coulomb(0.3, k_n=1e5, k_t=1e5), [])
    if above < 1:
        problem.solve()
    else:
        assert_raised_on_all_ranks(problem.solve, ValueError, "balance")


@pytest.mark.parametrize("n", [1, 2, 4])
def test_tipping_limit_of_a_block(n):
    """A block of height 2 on n facets with two Gauss points each is pushed at its top.

    By statics it tips, to 1 %, when the resultant leaves the outermost points, 0.2113 of a facet
    from the edges.
    """
    body = stack("quadrilateral", (n,), (2.0,))
    push, weight = body.constant(0.0), 1e3
    body.F += (weight * body.v[1] - push * body.v[0]) * body.ds(ROOF)
    problem = body.problem(floor(body, fc.Coulomb(0.9)))
    limit = 0.25 * weight * (1.0 - 2.0 * (0.5 - 0.5 / np.sqrt(3.0)) / n)
    push.value = 0.99 * limit
    problem.solve()
    problem.commit()
    push.value = 1.01 * limit
    assert_raised_on_all_ranks(problem.solve, ValueError, "no contact force can balance")
