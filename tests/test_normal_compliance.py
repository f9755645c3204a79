"""Normal compliance by a power law, p = p0 (δ/h)^m, with Coulomb friction."""

import numpy as np
import pytest
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from scenes.blocks import TOP, block
from scenes.comparison import assert_raised_on_all_ranks, gather, is_close, shared_folder
from scenes.histories import BlockOnBallHistory, assert_restart_equals_uninterrupted

COMM = MPI.COMM_WORLD
pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]

E, P0, H, MU = 1000.0, 5.0, 1e-2, 0.3
# Forces are solved to 1e-9 of the load; δ has 1/m of the relative error of p.
EXACT = 1e-7


@pytest.mark.parametrize("m", [1.0, 2.0, 3.3])
@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_approach_under_uniform_pressure(cell, m):
    """δ = h (p/p0)^(1/m) at every point, loading and unloading, and W = p δ/(m+1) per area.

    Without Poisson's effect the block has no tangential displacement, and friction is zero.
    """
    scene = block(cell, E=E, nu=0.0)
    problem, contact = scene.problem(fc.NormalCompliance(MU, P0, H, m), scene.rollers())
    stored = 0.0
    for p in (0.2, 3.0, 20.0, 1.0):
        scene.load(up=-p)
        step = problem.solve()
        assert step.verdict.failures == []
        problem.commit()
        delta = H * (p / P0) ** (1 / m)
        assert is_close(-gather(COMM, contact.gap), np.full(_n(contact), delta), EXACT, scale=delta)
        assert is_close(gather(COMM, contact.pressure), np.full(_n(contact), p), EXACT)
        energy = p * delta / (m + 1)  # the floor has area 1
        assert step.energy.springs == pytest.approx(energy - stored, rel=1e-6)
        stored = energy


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_friction_bound_of_sliding_points(cell):
    """Dragged until all points slip, and back: |τ| = μ p0 (δ/h)^m at every point, against slip."""
    scene = block(cell, E=E, nu=0.3, n=3)
    d = scene.dim
    push, press = (scene.dirichlet_bc(TOP, i) for i in (0, d - 1))
    bcs = [scene.dirichlet_bc(TOP, 1)] if d == 3 else []
    problem, contact = scene.problem(fc.NormalCompliance(MU, P0, H, 2.0), [push, press, *bcs])
    for side in (0.0, 2e-2, -2e-2):
        push.g.value[...], press.g.value[...] = side, -1e-2
        step = problem.solve()
        assert step.verdict.failures == []
        if side:
            delta = np.maximum(-gather(COMM, contact.gap), 0.0)
            tau = gather(COMM, contact.tangential_traction)
            assert step.contacts["contact"].stick == 0
            # Evaluated from the same displacement: round-off.
            assert is_close(np.linalg.norm(tau, axis=1), MU * P0 * (delta / H) ** 2, 1e-10)
            assert (tau[:, 0] * side < 0).all()
        problem.commit()
    assert step.energy.dissipation > 0


def test_solution_is_independent_of_units():
    """Approach and iterations are the same in N and mm, in N and µm, and with forces times 1e6."""
    computed = []
    for force, length in ((1.0, 1.0), (1e6, 1.0), (1.0, 1e3)):
        stress = force / length**2
        scene = block(E=E * stress, nu=0.3, up=-3 * stress, size=[length, length])
        law = fc.NormalCompliance(MU, P0 * stress, H * length, 2.5)
        problem, contact = scene.problem(law, scene.rollers())
        computed.append((problem.solve().iterations, -gather(COMM, contact.gap) / length))
    for iterations, delta in computed[1:]:
        assert iterations == computed[0][0] and is_close(delta, computed[0][1], EXACT)


def test_restarted_history_is_equal(tmp_path):
    """Pressed on a ball, dragged and back: a history restarted from its checkpoint is equal."""
    law = fc.NormalCompliance(MU, P0, H, k_t=1e3)
    assert_restart_equals_uninterrupted(
        lambda: BlockOnBallHistory(law, cell="triangle"),
        shared_folder(tmp_path),
        stop=5,
        tolerance=1e-6,
    )


def test_invalid_parameters_are_refused():
    """Exponents below 1, parameters that are not positive, and multipliers are refused by name."""
    scene = block()
    for m in (0.5, 0.0, -1.0, float("nan")):
        assert_raised_on_all_ranks(
            lambda m=m: fc.NormalCompliance(MU, P0, H, m), ValueError, "exponent"
        )
    parameters = {"friction": MU, "pressure": P0, "approach": H}
    for name in ("pressure", "approach"):
        for value in (0.0, -1.0):
            law = fc.NormalCompliance(**parameters | {name: value})
            assert_raised_on_all_ranks(
                lambda law=law: scene.contact(law), ValueError, "contact", name
            )
        law = fc.NormalCompliance(**parameters | {name: fem.Constant(scene.mesh, -1.0)})
        assert_raised_on_all_ranks(
            lambda law=law: scene.problem(law, scene.rollers()), ValueError, "contact", name
        )
    law = fc.NormalCompliance(**parameters)
    assert_raised_on_all_ranks(
        lambda: scene.contact(law, enforcement="augmented"),
        ValueError,
        "NormalCompliance",
        "penalty",
    )


def _n(contact):
    return len(gather(COMM, contact.gap))
