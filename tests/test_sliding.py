"""Slip over many facets of the opposing body, with pairs updated at every increment."""

import numpy as np
import pytest
from mpi4py import MPI

import fenics_contact as fc
from scenes.comparison import assert_raised_on_all_ranks, gather, is_close, owned_values
from scenes.two_blocks import LOWER_FACE, SlidingBlock, two_blocks

COMM = MPI.COMM_WORLD
K_N = 1e7

pytestmark = pytest.mark.two_ranks


@pytest.mark.parametrize("update", ["increment", "auto"])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron", "hexahedron"])
def test_pairs_follow_a_displaced_body(cell, update):
    """A block displaced over the base and then pressed agrees with one meshed at that position.

    Both solve the same equations: pressures to 1e-7, by the solver's tolerance.
    """
    n = (14, 4) if cell in ("triangle", "quadrilateral") else (7, 2)
    law = fc.Frictionless(k_n=K_N)
    carried, standing = (
        SlidingBlock(cell, law, start=s, n=n, update_pairs=update) for s in (0.4, 1.73)
    )
    carried.step(-0.01, 1.33)  # lifted, without contact
    assert carried.contact.resultants().normal_force == 0.0
    carried.step(0.002, 1.33)
    standing.step(0.002, 0.0)
    assert standing.contact.resultants().normal_force > 0
    a, b = carried.contact.gather(), standing.contact.gather()
    assert is_close(a["pressure"], b["pressure"], 1e-7)
    # Without the update the pairs are those of the start: this is refused, or causes a warning.
    initial_pairs = SlidingBlock(cell, law, start=0.4, n=n, update_pairs="never")
    initial_pairs.step(-0.01, 1.33)
    with pytest.raises(fc.NotConverged, match="small-displacement"):
        initial_pairs.step(0.002, 1.33)
    initial_pairs.problem.small_displacement_tolerance = np.inf
    with pytest.warns(UserWarning, match="assumed small"):
        initial_pairs.step(0.002, 1.33)
    assert not is_close(initial_pairs.contact.gather()["pressure"], b["pressure"], 1e-3)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_steady_sliding_has_the_tangential_force_of_the_law(cell, method):
    """Dragged over five facets of the base: T = μN in every increment, and N is almost constant.

    Far from the ends of the base N changes only by its facets: 1 %.
    """
    setup = SlidingBlock(cell, fc.Coulomb(0.3, k_n=K_N, k_t=K_N), start=0.8, method=method)
    setup.step(0.002, 0.0)
    normal = []
    for along in np.linspace(0.1, 1.5, 15):
        step = setup.step(0.002, along)
        r = step.contacts["contact"]
        assert r.stick == 0
        assert is_close(r.tangential_force, 0.3 * r.normal_force, 1e-9)
        normal.append(r.normal_force)
        assert step.energy.dissipation > 0
    normal = np.array(normal[3:])
    assert np.abs(normal / normal.mean() - 1).max() < 0.01
    # In steady sliding slip equals the displacement: friction dissipates T times it per increment.
    assert is_close(step.energy.dissipation, 0.3 * normal[-1] * 0.1, 0.01)


def test_sticking_points_keep_their_traction_when_pairs_are_updated():
    """Sticking points keep their traction when their pairs are updated: there is no creep."""
    setup = SlidingBlock("quadrilateral", fc.Coulomb(5.0, k_n=K_N, k_t=K_N), start=1.1)
    setup.step(0.002, 0.0)
    setup.step(0.002, 1e-4)
    before = owned_values(setup.u).copy()
    shear = setup.contact.resultants().force[0]
    for _ in range(3):
        setup.step(0.002, 1e-4)
    assert is_close(gather(COMM, owned_values(setup.u)), gather(COMM, before), 1e-3)
    assert is_close(setup.contact.resultants().force[0], shear, 1e-2)
    assert setup.contact.resultants().stick > 0


def test_points_beyond_the_edge_are_open_and_counted():
    """Points displaced beyond the end of the base have no opposite point any more."""
    setup = SlidingBlock("quadrilateral", fc.Frictionless(k_n=K_N), start=2.7)
    setup.step(0.002, 0.0)
    assert setup.contact.pairs.n_unpaired == 0
    for along in (0.3, 0.6):
        setup.step(0.002, along)
    assert setup.contact.pairs.n_unpaired > 0
    assert setup.contact.resultants().normal_force > 0


@pytest.mark.parametrize("condensation", [None, False])
def test_default_updates_pairs_after_slip_by_a_facet(condensation):
    """Pairs are not updated while the slip is small, as with "never", and in every increment later.

    The facets of Γc are 0.25 long: a displacement of 0.2 is less than that, one of 0.3 is more.
    From then on the forces are those of pairs updated from the start, to 1e-3, the effect of
    different pairs in the first increments: the facets of both bodies are equal in size.
    """
    law = fc.Coulomb(0.3, k_n=K_N, k_t=K_N)
    slides = [0.0, 0.2, 0.3, 0.4, 0.5]
    blocks_by_option = {
        update: SlidingBlock(
            "quadrilateral",
            law,
            start=0.8,
            update_pairs=update,
            condensation=condensation,
            n=(14, 4),
        )
        for update in ("never", "auto", "increment")
    }
    numbers, forces = {}, {}
    for update, slider in blocks_by_option.items():
        slider.problem.small_displacement_tolerance = np.inf
        first = slider.contact.pairs.n_updates
        numbers[update], forces[update] = [], []
        for displacement in slides:
            step = slider.step(0.002, displacement)
            numbers[update].append(slider.contact.pairs.n_updates - first)
            forces[update].append(step.contacts["contact"].force)
    assert numbers == {"never": [0] * 5, "auto": [0, 0, 1, 2, 3], "increment": [1, 2, 3, 4, 5]}
    never, auto, increment = (np.array(forces[update]) for update in blocks_by_option)
    assert is_close(auto[:3], never[:3], 1e-12)
    assert is_close(auto[3:], increment[3:], 1e-3)


def test_pair_update_recovers_the_interior_displacement():
    """Without recovery in every increment, u is recovered for the search: equal forces, 1e-9."""
    law = fc.Coulomb(0.3, k_n=K_N, k_t=K_N)
    forces = []
    for field in (True, False):
        setup = SlidingBlock(
            "quadrilateral", law, start=0.8, update_pairs="auto", condensation=True
        )
        steps = []
        for displacement in [0.0, 0.2, 0.3, 0.4]:
            setup.top_displacement[-1].value, setup.top_displacement[0].value = -0.002, displacement
            steps.append(setup.problem.solve(recover_interior=field))
            setup.problem.commit()
        assert [step.complete for step in steps] == [True] * 4 if field else [False] * 3 + [True]
        assert setup.contact.pairs.n_updates > 1
        forces.append([step.contacts["contact"].force for step in steps])
    assert is_close(np.array(forces[1]), np.array(forces[0]), 1e-9)


def test_unknown_update_of_pairs_is_refused():
    """``update_pairs="step"`` is refused."""
    mesh, tags = two_blocks("triangle", (3, 4))
    assert mesh is not None
    assert_raised_on_all_ranks(
        lambda: fc.DeformableBody(tags, LOWER_FACE, update_pairs="step"), ValueError, "update_pairs"
    )
