"""Candidate dofs: static condensation retains only the dofs that can come into contact.

Γc is tagged beyond the contact. References are the same scene on all dofs, or with a tight tag.
All are solved to 1e-12 of the forces and agree to 1e-8 of the largest entry, in successive
increments.
"""

import logging

import numpy as np
import pytest
from mpi4py import MPI

import fenics_contact as fc
from scenes.comparison import have_similar_iterations, is_close, nodal_values, shared_folder
from scenes.histories import assert_restart_equals_uninterrupted
from scenes.oversized_contact_surface import CELLS, BlockUnderShoe, IndentedBlock

pytestmark = [pytest.mark.timeout(240), pytest.mark.mpi]
COMM = MPI.COMM_WORLD
ON_ONE_RANK = pytest.mark.skipif(COMM.size > 1, reason="takes minutes there")

SAME = 1e-8
TIGHT = {"petsc_options": {"snes_rtol": 1e-12}}
# Retained dofs of negligible cost; the top has more than a thousand.
FEW = 500


def n_retained_dofs(setup):
    """Return the number of retained dofs."""
    system = setup.problem.solver.system
    assert setup.problem.solver.condensed
    return system.unknowns.n_global


def run(setup, end=1.0, steps=2, **options):
    """Run the increments to ``end``; return them and their results."""
    steps_taken = list(setup.increments(end, steps=steps, **options))
    forces = np.array([step.contacts["contact"].force for step in steps_taken])
    counts = [[s.contacts["contact"].stick, s.contacts["contact"].slip] for s in steps_taken]
    return steps_taken, {"u": nodal_values(setup.u), "forces": forces, "counts": np.array(counts)}


def assert_same(one, other, rtol=SAME):
    for name, value in other.items():
        assert is_close(one[name], value, rtol), name


def n_grown(steps):
    """Return how often contact has spread beyond the retained dofs."""
    return sum("spreads" in attempt.outcome for step in steps for attempt in step.attempts)


# ---- the same results ----------------------------------------------------------------------------


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_surface_tagged_beyond_the_contact(cell):
    """Results are those of all dofs and of a tight tag; few dofs are retained, condensed once."""
    setup = IndentedBlock(cell=cell, **TIGHT)
    steps, computed = run(setup)
    assert n_retained_dofs(setup) <= FEW
    assert sum(step.factorisations for step in steps) == 1
    assert n_grown(steps) == 0
    full = IndentedBlock(cell=cell, condensation=False, **TIGHT)
    assert_same(computed, run(full)[1])
    # The closed points cover a sixth of the tag at most.
    assert_same(computed, run(IndentedBlock(cell=cell, contact_half_width=0.5, **TIGHT))[1])


LAWS = {
    "frictionless": fc.Frictionless(k_n=1e5),
    "polygon": fc.Coulomb(0.3, k_n=1e5, k_t=1e5, modes=6),
    "layer": fc.Foundation(k_n=1e4, k_t=1e4, tension=False),
}


@pytest.mark.parametrize("law", LAWS)
def test_laws(law):
    """Results agree for laws of every kind, with the ball dragged a little."""
    cell = "tetrahedron" if law == "polygon" else "quadrilateral"
    setups = [IndentedBlock(LAWS[law], cell=cell, condensation=c, **TIGHT) for c in (None, False)]
    (steps, computed), (_, full) = (run(m, 1.2, 3) for m in setups)
    assert n_retained_dofs(setups[0]) <= FEW
    assert n_grown(steps) == 0
    assert_same(computed, full)


@pytest.mark.each
@pytest.mark.parametrize("method", ["lbfgs", "newton", "alternating", "continuation"])
def test_methods(method):
    """Results agree for all methods; L-BFGS has fewer digits, with and without condensation."""
    setups = [IndentedBlock(condensation=c, method=method, **TIGHT) for c in (None, False)]
    (_, computed), (_, full) = (run(m) for m in setups)
    assert n_retained_dofs(setups[0]) <= FEW
    assert_same(computed, full)


def test_multipliers():
    """Results agree with multipliers, which vanish at open points, to their tolerance."""
    tolerance = 1e-6
    options = {"cell": "tetrahedron", "contact": {"enforcement": "augmented"}} | TIGHT
    options["contact"]["tolerance"] = tolerance
    setups = [IndentedBlock(condensation=c, **options) for c in (None, False)]
    (steps, computed), (_, full) = (run(m, 1.5, 3) for m in setups)
    assert n_retained_dofs(setups[0]) <= FEW
    assert max(step.augmentations for step in steps) > 1
    assert_same(computed, full, tolerance)


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_ball_pushed_by_a_force(cell):
    """The motion of the ball is unknown: it could close points away from the contact unseen."""
    setups = [IndentedBlock(cell=cell, force=20.0, condensation=c, **TIGHT) for c in (None, False)]
    (_, computed), (_, full) = (run(m, 1.2, 3) for m in setups)
    assert n_retained_dofs(setups[0]) <= FEW + 1
    assert_same(computed, full)


@pytest.mark.parametrize("pressure", [5.0, 40.0])
def test_body_constrained_by_contact_alone(pressure):
    """A pressure pushes a block up against the ball: results agree.

    With the larger pressure contact spreads beyond the retained dofs.
    """
    setups = [IndentedBlock(pressure=pressure, condensation=c, **TIGHT) for c in (True, False)]
    (steps, computed), (_, full) = (run(m, 1.0, 4) for m in setups)
    assert n_grown(steps) >= 1 if pressure > 10 else n_retained_dofs(setups[0]) <= FEW
    assert_same(computed, full)


@pytest.mark.parametrize("update", ["never", pytest.param("increment", marks=ON_ONE_RANK)])
def test_two_bodies(update):
    """A round shoe, a body of its own, is pressed on the block and dragged: results agree.

    The pairs are those of the undeformed bodies, or updated.
    """
    end, steps = (1.0, 2) if update == "never" else (1.5, 6)
    setups = [BlockUnderShoe(update_pairs=update, condensation=c, **TIGHT) for c in (None, False)]
    (_, computed), (_, full) = (run(m, end, steps) for m in setups)
    assert n_retained_dofs(setups[0]) <= FEW
    assert_same(computed, full)


# ---- spreading contact ---------------------------------------------------------------------------


@pytest.mark.parametrize("condensation", [None, True])
@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_contact_moves_beyond_the_retained_dofs(cell, condensation):
    """Contact leaves the retained dofs: others are retained, or more, and results agree.

    More are retained if condensation is requested.
    """
    setups = [IndentedBlock(cell=cell, condensation=c, **TIGHT) for c in (condensation, False)]
    (steps, computed), (_, full) = (run(m, 3.5, 7) for m in setups)
    assert 1 <= n_grown(steps) <= 2
    assert sum(step.factorisations for step in steps) == 1 + n_grown(steps)
    if condensation is None:
        assert n_retained_dofs(setups[0]) <= FEW
    assert_same(computed, full)


@ON_ONE_RANK
def test_two_bodies_pressed_deep():
    """Results agree as the contact of the shoe grows wider than the dofs retained at first."""
    setups = [
        BlockUnderShoe(depth=0.05, condensation=c, small_displacement_tolerance=np.inf, **TIGHT)
        for c in (True, False)
    ]
    (steps, computed), (_, full) = (run(m, 1.0, 5) for m in setups)
    assert n_grown(steps) >= 1
    assert_same(computed, full)


@pytest.mark.parametrize("condensation", [None, True])
def test_pressed_deep(condensation):
    """Most of the top comes into contact: results agree.

    From then on all dofs are used, or all coupled dofs are retained if condensation is requested.
    """
    setups = [
        IndentedBlock(depth=0.12, condensation=c, small_displacement_tolerance=np.inf, **TIGHT)
        for c in (condensation, False)
    ]
    (steps, computed), (_, full) = (run(m, 1.0, 10) for m in setups)
    assert steps[0].attempts[-1].outcome == "converged"
    assert n_grown(steps) >= 1
    if condensation:
        assert n_retained_dofs(setups[0]) > 1.5 * FEW
    else:
        assert not setups[0].problem.solver.condensed
    assert_same(computed, full)


def test_recovering_only_the_last_interior_displacement():
    """Results do not change, serially bit for bit: no point closes undetected."""
    setups = [IndentedBlock(condensation=True) for _ in range(2)]
    (steps, computed), (others, complete) = (
        run(m, 3.0, 6, recover_interior=field)
        for m, field in zip(setups, ("last", "every"), strict=True)
    )
    assert n_grown(steps) == n_grown(others) >= 1
    assert all(step.complete for step in steps)
    assert_same(computed, complete, 0.0 if COMM.size == 1 else SAME)
    for one, other in zip(steps, others, strict=True):
        size = abs(other.energy.work) + abs(other.energy.elastic)
        for name in ("work", "elastic", "springs", "dissipation"):
            energy, expected = getattr(one.energy, name), getattr(other.energy, name)
            assert is_close(energy, expected, SAME, scale=size), name


@pytest.mark.parametrize("condensation", [None, True])
def test_restart(condensation, tmp_path):
    """A history restarted after more dofs are retained has the same digits."""
    make = lambda: IndentedBlock(condensation=condensation)  # noqa: E731
    assert_restart_equals_uninterrupted(make, shared_folder(tmp_path), stop=5, end=3.5)


def test_restart_on_all_dofs(tmp_path):
    """A restarted history has the same digits where contact is too wide to be condensed."""
    make = lambda: IndentedBlock(depth=0.12, small_displacement_tolerance=np.inf)  # noqa: E731
    assert_restart_equals_uninterrupted(make, shared_folder(tmp_path), stop=4, end=1.0, steps=5)


def test_failed_increment_has_no_effect():
    """A failed increment changes neither u nor history nor the next increment (1e-9)."""
    setup, reference = (IndentedBlock(condensation=True, fallback=False) for _ in range(2))
    for m in (setup, reference):
        run(m, 1.0)
    before = setup.u.x.array.copy()
    limits = setup.problem.solver.main.max_it
    setup.load(3.0)
    setup.problem.solver.main.max_it = 1
    with pytest.raises(fc.NotConverged):
        setup.problem.solve()
    setup.problem.solver.main.max_it = limits
    assert np.array_equal(setup.u.x.array, before)
    results = []
    for m in (setup, reference):
        m.load(1.5)
        m.problem.solve()
        m.problem.commit()
        results.append({"u": nodal_values(m.u)})
    assert_same(*results, rtol=1e-9)


def test_units():
    """Retained dofs, effort and digits are the same in other units, to 1e-9 of the field."""
    setups = [IndentedBlock(length=length) for length in (1.0, 1e-3)]
    (one, a), (other, b) = (run(m, 2.0, 4) for m in setups)
    assert n_retained_dofs(setups[0]) == n_retained_dofs(setups[1])
    assert have_similar_iterations([s.iterations for s in one], [s.iterations for s in other])
    assert is_close(b["u"] / 1e-3, a["u"], 1e-9)


# ---- selection of candidates ---------------------------------------------------------------------


def test_candidates_on_the_whole_surface(caplog):
    """Laws that act at open points, and prescribed gaps, make all dofs of Γc candidates."""
    everywhere = {
        "tresca": (fc.Tresca(0.3, 8.0, k_n=1e5, k_t=1e5), {}),
        "tension": (fc.Foundation(k_n=1e4, k_t=1e4), {}),
        "gap": (None, {"gap": 0.1}),
    }
    for law, contact in everywhere.values():
        caplog.clear()
        with caplog.at_level(logging.INFO, logger="fenics_contact"):
            setup = IndentedBlock(law, contact=contact)
        assert not setup.problem.solver.condensed
        if COMM.rank == 0:
            messages = [record.getMessage() for record in caplog.records]
            assert any("contact couples 1042 of" in text for text in messages)
        forced = IndentedBlock(law, contact=contact, condensation=True)
        assert n_retained_dofs(forced) == 2 * (CELLS["quadrilateral"][0] + 1)


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_any_number_of_ranks(cell):
    """Retained dofs, their growth, effort and forces are those on one rank."""
    setup, alone = (IndentedBlock(cell=cell, comm=comm, **TIGHT) for comm in (COMM, MPI.COMM_SELF))
    (steps, computed), (serial, expected) = (run(m, 3.0, 6) for m in (setup, alone))
    assert n_retained_dofs(setup) == n_retained_dofs(alone)
    assert have_similar_iterations([s.iterations for s in steps], [s.iterations for s in serial])
    assert n_grown(steps) == n_grown(serial)
    for name in ("forces", "counts"):
        assert is_close(computed[name], expected[name], SAME), name
