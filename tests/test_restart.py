"""Restarted histories agree with uninterrupted ones and continue at the stored load.

A history is solved in one run, and again interrupted and restarted by a new problem. Serially the
two are compared bit for bit; on several ranks MUMPS adds in the order in which messages arrive, and
two solutions within the tolerance of 1e-9 on the residual are compared: to 1e-7, or to the accuracy
of a preset.
"""

from __future__ import annotations

import itertools
import json
import subprocess

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact import checkpoint
from scenes.block_on_ball import BlockOnBall
from scenes.blocks import TOP, block
from scenes.comparison import (
    assert_raised_on_all_ranks,
    is_close,
    owned_values,
    point_values,
    shared_folder,
)
from scenes.elasticity import strain
from scenes.histories import (
    BlockOnBallHistory,
    BlockOnRamp,
    assert_restart_equals_uninterrupted,
    find_differences,
)
from scenes.processes import command, subprocess_environment

COMM = MPI.COMM_WORLD

pytestmark = pytest.mark.mpi


# ---- agreement with uninterrupted histories ------------------------------------------------------


@pytest.mark.each
@pytest.mark.parametrize(("update", "stop"), [("increment", 5), ("auto", 2), ("auto", 6)])
@pytest.mark.parametrize("condensation", [None, False])
@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_restart_with_updated_pairs(cell, condensation, update, stop, tmp_path):
    """On a ramp, pairs and retained dofs after the restart are those of the slid block.

    By default pairs are updated only after the block has slid: interrupted before and after that.
    """
    make = lambda: BlockOnRamp(  # noqa: E731
        cell=cell,
        condensation=condensation,
        update_pairs=update,
        n=(10, 4) if cell == "quadrilateral" else (6, 2),
    )
    assert_restart_equals_uninterrupted(make, shared_folder(tmp_path), stop=stop)


LAWS = {
    "coulomb": lambda: fc.Coulomb(0.3),
    "polygon": lambda: fc.Coulomb(0.3, k_n=2e4, k_t=1e4, modes=6),
    "tresca": lambda: fc.Tresca(0.3, 20.0),
    "frictionless": lambda: fc.Frictionless(),
    "foundation": lambda: fc.Foundation(k_n=2e4, k_t=1e4, tension=False),
    "springs": lambda: fc.Coulomb(0.3, fc.NodalSprings(2e3), fc.NodalSprings(1e3)),
}
ENFORCEMENTS = {
    "penalty": {},
    "augmented": {"enforcement": "augmented"},
    "draft": {"accuracy": "draft"},
    "standard": {"accuracy": "standard"},
}


def sample_of_options() -> list[tuple]:
    """Return a reproducible sample of combinations in which each choice occurs."""
    choices = itertools.product(
        ["fixed", "moving", "force", "ramp"],
        LAWS,
        ENFORCEMENTS,
        [None, "lbfgs", "newton"],
        ["plain", "estimate", "last", "every 3", "wall", "nonlinear"],
    )
    sensible = [
        (obstacle, law, enforcement, method, extra)
        for obstacle, law, enforcement, method, extra in choices
        if not (law in ("foundation", "springs") and enforcement != "penalty")
        and not (law == "springs" and obstacle == "ramp")
        and not (law == "polygon" and obstacle != "fixed")
        and not (obstacle in ("ramp", "force") and extra in ("wall", "nonlinear"))
    ]
    picked = np.random.default_rng(3).choice(len(sensible), 26, replace=False)
    chosen = [sensible[i] for i in sorted(picked)]
    return chosen if COMM.size == 1 else chosen[::4]


@pytest.mark.each
@pytest.mark.newest
@pytest.mark.parametrize(("obstacle", "law", "variant", "method", "extra"), sample_of_options())
def test_restart_of_combined_options(obstacle, law, variant, method, extra, tmp_path):
    """Restarts agree for combined obstacles, laws, enforcement, methods and history options."""
    options = {}
    if extra == "estimate":
        options["estimate"] = True
    elif extra == "last":
        options |= {"recover_interior": "last", "checkpoint_every": 2}
    elif extra == "every 3":
        options |= {"checkpoint_every": 3}

    def make():
        contact = dict(ENFORCEMENTS[variant])
        if obstacle == "ramp":
            return BlockOnRamp(LAWS[law](), contact=contact, method=method)
        return BlockOnBallHistory(
            LAWS[law](),
            cell="hexahedron" if law == "polygon" else "triangle",
            n=2 if law == "polygon" else 4,
            obstacle=obstacle,
            surface={"quadrature_scheme": "vertex"} if law == "springs" else None,
            contact=contact,
            wall=extra == "wall",
            bulk="nonlinear" if extra == "nonlinear" else "linear",
            method=method,
        )

    # A preset solves to 1e-2 of its error, multipliers to a fraction of the tractions.
    tolerance = {"draft": 5e-3, "standard": 1e-3, "augmented": 1e-4}.get(variant, 1e-6)
    assert_restart_equals_uninterrupted(
        make, shared_folder(tmp_path), stop=5, tolerance=tolerance, **options
    )


@pytest.mark.parametrize("make", [BlockOnBallHistory, BlockOnRamp])
def test_restart_after_cut_increments(make, tmp_path):
    """Cut increments and their later growth are part of the stored position in the load path.

    Increments above 0.3 fail: those of 0.5 are halved, and grow again after two.
    """

    def tamper(setup):
        problem, load, current, committed = setup.problem, setup.load, [0.0], []
        solve, commit = problem.solve, problem.commit

        def record_load(t):
            current[0] = t
            committed[:] = committed or [t]  # the first is the committed load
            load(t)

        def solve_small_increments(**options):
            if current[0] - committed[0] > 0.3:
                balance = {"the body": fc.ForceBalance(1.0, 1.0, 0.0)}
                verdict = fc.Verdict(balance, balance)
                raise fc.NotConverged(problem.increment + 1, -1, verdict)
            return solve(**options)

        def commit_load():
            commit()
            committed[0] = current[0]

        setup.load, problem.solve, problem.commit = record_load, solve_small_increments, commit_load

    assert_restart_equals_uninterrupted(make, shared_folder(tmp_path), stop=5, modify=tamper)


def test_error_estimate_of_a_restarted_state(tmp_path):
    """The error budget of a restarted history is that of the run that solved it (1e-6)."""
    path, budgets = shared_folder(tmp_path) / "state.npz", []
    for condensation in (True, True, False):
        setup = BlockOnBallHistory(condensation=condensation)
        list(setup.increments(checkpoint=path))
        scene = setup.scene
        sigma = ufl.variable(strain(scene.u))  # not that of the form, but the same in all runs
        budget = fc.estimate_errors(setup.problem, 1000.0 * sigma, strain=strain(scene.u))
        budgets.append(budget.relative("enforcement"))
    for budget in budgets[1:]:
        for name, value in budgets[0].items():
            assert is_close(budget[name], value, 1e-6, scale=1.0)


@pytest.mark.skipif(COMM.size > 1, reason="MUMPS adds in the order in which messages come")
def test_repeated_histories_are_bit_identical():
    """L-BFGS does not depend on the memory addresses of its vectors, which other arrays shift."""
    histories, between = [], []
    options = {"cell": "triangle", "n": 3, "method": "lbfgs", "contact": ENFORCEMENTS["standard"]}
    for n in range(8):
        between.append([np.empty(13 * (n + 1) + i) for i in range(5)])
        histories.append(BlockOnBallHistory(fc.Tresca(0.3, 20.0), **options))
        list(histories[-1].increments(1.0))
    for repeated in histories[1:]:
        assert find_differences(repeated, histories[0], 0.0) == []


SCRIPT = """
import json
from scenes.histories import BlockOnBallHistory, BlockOnRamp, collect_state
setup = {scene}
for step in setup.increments(checkpoint={path!r}):
    if step.increment == {stop}:
        break
state = collect_state(setup)
names = [n for n in state if n.split()[-1] in ("u", "history", "jump", "forces", "counts")]
if setup.problem.u.function_space.mesh.comm.rank == 0:
    print(json.dumps({{n: state[n].tolist() for n in names}}))
"""


def run_script(ranks: int, **values) -> dict[str, np.ndarray]:
    """Run a history in a process of its own and return its final values."""
    script = SCRIPT.format(**values)
    words = command(ranks, "-c", script)
    done = subprocess.run(
        words, env=subprocess_environment(), capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return {n: np.array(v) for n, v in json.loads(done.stdout.splitlines()[-1]).items()}


@pytest.mark.skipif(COMM.size > 1, reason="starts its own processes")
@pytest.mark.parametrize(
    ("scene", "ranks"),
    [
        ("BlockOnRamp(n=(6, 2))", (1, 2)),
        pytest.param("BlockOnRamp(n=(6, 2))", (2, 3), marks=pytest.mark.slow),
        ("BlockOnBallHistory(obstacle='force', contact={'enforcement': 'augmented'})", (2, 1)),
        ("BlockOnBallHistory(cell='tetrahedron', n=2, wall=True, obstacle='moving')", (2, 1)),
    ],
)
def test_restart_on_another_number_of_ranks(scene, ranks, tmp_path):
    """The state is assigned by location (tolerance 1e-6, or 1e-4 with multipliers)."""
    first, second = ranks
    alone = run_script(second, scene=scene, path=str(tmp_path / "alone.npz"), stop=0)
    path = str(tmp_path / "state.npz")
    run_script(first, scene=scene, path=path, stop=5)
    after = run_script(second, scene=scene, path=path, stop=0)
    assert after.keys() == alone.keys()
    for name in alone:
        if name.endswith("counts"):
            assert np.array_equal(after[name], alone[name])
        else:
            assert is_close(after[name], alone[name], 1e-4 if "augmented" in scene else 1e-6), name


# ---- position in the load path -------------------------------------------------------------------


def load_cycle(setup, path, *, stop=0):
    """Load to 2, unload to 1, reload to 2, stop after ``stop`` increments; return the loads."""
    loads = []
    for start, end, steps in ((0.0, 2.0, 4), (2.0, 1.0, 2), (1.0, 2.0, 2)):
        for step in setup.increments(end, start, steps=steps, checkpoint=path):
            loads.append(step.load)
            if len(loads) == stop:
                return loads
    return loads


@pytest.mark.parametrize("stop", [1, 4, 5, 7])
@pytest.mark.parametrize("make", [BlockOnBallHistory, BlockOnRamp])
def test_restart_within_several_calls_of_increments(make, stop, tmp_path):
    """Loading, unloading, reloading with one file are interrupted in and at the end of a call."""
    folder = shared_folder(tmp_path)
    uninterrupted, interrupted, after = make(), make(), make()
    loads = load_cycle(uninterrupted, folder / "whole.npz")
    load_cycle(interrupted, folder / "part.npz", stop=stop)
    assert load_cycle(after, folder / "part.npz") == loads[stop:]
    assert find_differences(after, uninterrupted, 0.0 if COMM.size == 1 else 1e-7) == []


def test_calls_in_another_order_are_refused(tmp_path):
    """The second call is refused as the first one, and so is a first call with another end."""
    path = shared_folder(tmp_path) / "state.npz"
    load_cycle(BlockOnBallHistory(), path, stop=5)
    setup = BlockOnBallHistory()
    call = lambda: next(setup.increments(1.0, 2.0, steps=2, checkpoint=path))  # noqa: E731
    assert_raised_on_all_ranks(call, ValueError, "from 2 to 1 by 2", "from 0 to 2 by 4")
    call = lambda: next(setup.increments(2.5, 0.0, steps=5, checkpoint=path), None)  # noqa: E731
    assert_raised_on_all_ranks(call, ValueError, "from 0 to 2.5 by 5", "from 0 to 2 by 4")


def test_restart_with_later_end_or_other_remaining_steps(tmp_path):
    """A finished history is extended as if solved in one run; its remaining steps may differ."""
    folder = shared_folder(tmp_path)
    first, further, uninterrupted = BlockOnBallHistory(), BlockOnBallHistory(), BlockOnBallHistory()
    list(first.increments(2.0, checkpoint=folder / "state.npz"))
    remaining = [s.load for s in further.increments(4.0, checkpoint=folder / "state.npz")]
    assert remaining == [2.5, 3.0, 3.5, 4.0]
    list(uninterrupted.increments(4.0, checkpoint=folder / "whole.npz"))
    assert find_differences(further, uninterrupted, 0.0 if COMM.size == 1 else 1e-7) == []
    other = BlockOnBallHistory()
    steps = [0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.1]
    remaining = [
        s.load for s in other.increments(4.1, steps=steps, checkpoint=folder / "state.npz")
    ]
    assert remaining == [4.1]


def test_restart_with_a_modulus_changed_by_the_load(tmp_path):
    """Contact stiffnesses of 10 E/h follow E in the form, here that of the stored load (1e-12)."""
    folder = shared_folder(tmp_path)

    def run(stop, path):
        scene = block("quadrilateral", n=4)
        top = fem.Constant(scene.mesh, 0.0)
        contact = scene.contact(fc.Coulomb(0.3))
        bcs = [scene.dirichlet_bc(TOP, 0), scene.dirichlet_bc(TOP, 1, top)]
        problem = fc.ContactProblem(scene.F, scene.u, bcs=bcs, contacts=[contact])

        def load(t):
            top.value, scene.E.value = -0.01 * t, 1000.0 * (1.0 + 0.3 * t)

        for step in fc.increments(problem, load, 0.0, 1.0, steps=4, checkpoint=path):
            if step.load >= stop:
                break
        return contact.resultants().force

    uninterrupted = run(1.0, folder / "whole.npz")
    run(0.5, folder / "two.npz")
    assert run(1.0, folder / "two.npz") == pytest.approx(uninterrupted, rel=1e-12, abs=1e-12)


def test_interrupted_loop_continues_with_other_steps(tmp_path):
    """The same call on the same problem, with other steps, continues the history (1e-7)."""
    path = shared_folder(tmp_path) / "state.npz"
    setup, uninterrupted = BlockOnBallHistory(), BlockOnBallHistory()
    for step in setup.increments(2.0, checkpoint=path):
        if step.increment == 2:
            break
    remaining = setup.increments(2.0, steps=[0.5, 1.0, 1.25, 1.5, 2.0], checkpoint=path)
    assert [s.load for s in remaining] == [1.25, 1.5, 2.0]
    list(uninterrupted.increments(2.0, steps=[0.5, 1.0, 1.25, 1.5, 2.0]))
    assert find_differences(setup, uninterrupted, 1e-7) == []


@pytest.mark.each
@pytest.mark.parametrize("enforcement", ["penalty", "augmented"])
@pytest.mark.parametrize("obstacle", ["rigid", "body", "body, pairs found anew"])
def test_restart_restores_results_of_a_finished_history(obstacle, enforcement, tmp_path):
    """Counts of open, sticking and slipping points are those of the last increment.

    After the commit all closed points stick: the counts require the values evaluated before it.
    They are restored by the same call of `increments`, and by `checkpoint.load`.
    """

    def make():
        contact_options = {"contact": {"enforcement": enforcement}}
        if obstacle == "rigid":
            return BlockOnBallHistory(**contact_options)
        return BlockOnRamp(
            update_pairs="increment" if "anew" in obstacle else "never", **contact_options
        )

    end = 1.9  # at 2 the slip distance reaches a facet, the limit without pair updates
    path = shared_folder(tmp_path) / "state.npz"
    one, called, loaded = make(), make(), make()
    *_, step = one.increments(end, checkpoint=path)
    assert not list(called.increments(end, checkpoint=path))
    loaded.load(end)
    checkpoint.load(loaded.problem, path)
    (last,) = step.contacts.values()
    assert last.slip > 0
    tolerance = 0.0 if COMM.size == 1 else 1e-12
    (first,) = one.problem.contacts
    slid = point_values(first, first.slip_increment)
    for setup in (one, called, loaded):
        (contact,) = setup.problem.contacts
        computed = contact.resultants()
        assert (computed.open, computed.stick, computed.slip) == (last.open, last.stick, last.slip)
        for name in ("force", "normal_force", "tangential_force", "area", "max_pressure"):
            assert is_close(getattr(computed, name), getattr(last, name), tolerance), name
        assert is_close(point_values(contact, contact.slip_increment), slid, tolerance)


def test_restart_with_ranks_without_nodes(tmp_path):
    """A body of one cell, so that only one rank has nodes, agrees after the restart (1e-7)."""
    folder = shared_folder(tmp_path)
    uninterrupted, stopped, after = (BlockOnBall(mesh={"n": 1}) for _ in range(3))
    for _ in fc.increments(uninterrupted.problem, uninterrupted.load, 0.0, 2.0, steps=4):
        pass
    options = {"steps": 4, "checkpoint": folder / "one.npz"}
    for step in fc.increments(stopped.problem, stopped.load, 0.0, 2.0, **options):
        if step.increment == 2:
            break
    remaining = list(fc.increments(after.problem, after.load, 0.0, 2.0, **options))
    assert [step.increment for step in remaining] == [3, 4]
    assert is_close(owned_values(after.scene.u), owned_values(uninterrupted.scene.u), 1e-7)
    assert is_close(
        after.contact.resultants().force, uninterrupted.contact.resultants().force, 1e-7
    )
