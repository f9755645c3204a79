"""Load histories: loads as functions, cut increments, energies, and restart from checkpoints."""

import io
import json
import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.histories import checkpoint_file
from scenes.block_on_ball import (
    STATE_TOLERANCE,
    BlockOnBall,
    fail_increments_above,
    have_equal_states,
)
from scenes.blocks import TOP, block
from scenes.comparison import assert_raised_on_all_ranks, is_close, owned_values, shared_folder
from scenes.processes import command, subprocess_environment

pytestmark = pytest.mark.three_ranks

COMM = MPI.COMM_WORLD


# ---- loads ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_one_function_can_set_several_loads(cell):
    """In a cycle of two loads set by one function the friction force is reversed."""
    setup = BlockOnBall(cell=cell)
    shear = {}
    for step in fc.increments(setup.problem, setup.load, 0.0, 4.0, steps=8):
        shear[step.load] = setup.contact.resultants().force[0]
    assert list(shear) == pytest.approx(np.arange(1, 9) / 2)
    assert shear[2.0] < 0 < shear[4.0]
    end = setup.contact.resultants()
    assert end.slip > 0 and end.stick == 0
    assert is_close(end.tangential_force, 0.3 * end.normal_force, 1e-12)


def test_increments_end_at_the_given_loads():
    """Increments of unequal size end at the given loads."""
    setup = BlockOnBall()
    steps = fc.increments(setup.problem, setup.load, 0.0, 2.0, steps=[0.5, 1.0, 1.1, 2.0])
    assert [s.load for s in steps] == [0.5, 1.0, 1.1, 2.0]
    assert setup.push[0].value == 0.1


@pytest.mark.whole
@pytest.mark.parametrize(
    ("load", "steps", "word"),
    [
        ("load", 1, "function"),
        (None, 0, "at least 1"),
        (None, [0.5, 0.25, 1.0], "monotonic"),
        (None, [0.5], "end"),
        (None, [], "end"),
        (None, [[0.5, 1.0]], "ends of the increments"),
        (None, [[0.5], [0.7, 1.0]], "ends of the increments"),
        (None, ["half", 1.0], "ends of the increments"),
    ],
)
def test_invalid_histories_are_refused(load, steps, word):
    """Refused are a load that is no load, and increments that are not monotonic or miss the end."""
    setup = BlockOnBall()
    call = lambda: list(  # noqa: E731
        fc.increments(setup.problem, load or setup.load, 0.0, 1.0, steps=steps)
    )
    assert_raised_on_all_ranks(call, ValueError, word)


@pytest.mark.parametrize(("start", "end"), [(0.0, 5e-324), (1e16, 1e16 + 2), (-1e308, 1e308)])
def test_increments_below_round_off_are_refused(start, end):
    """Fewer than the three increments asked for would be another load path."""
    setup = BlockOnBall()
    call = lambda: fc.increments(setup.problem, setup.load, start, end, steps=3)  # noqa: E731
    assert_raised_on_all_ranks(call, ValueError, "steps is 3", "distinguished")


def test_same_file_for_checkpoint_and_csv_is_refused(tmp_path):
    """Each would overwrite the other; nothing is written."""
    setup, path = BlockOnBall(), shared_folder(tmp_path) / "state"
    names = {"checkpoint": path, "csv": path.parent / ".." / path.parent.name / "state"}
    call = lambda: fc.increments(setup.problem, setup.load, **names)  # noqa: E731
    assert_raised_on_all_ranks(call, ValueError, "checkpoint and csv are both")
    assert not path.exists()


# ---- cutting -------------------------------------------------------------------------------------


def test_failed_increments_are_cut_and_enlarged_again():
    """Increments are halved until they converge, doubled after two successes, and reach the end."""
    setup, plain = BlockOnBall(), BlockOnBall()
    tried = fail_increments_above(setup, 0.3)
    done = [s.load for s in fc.increments(setup.problem, setup.load, 0.0, 2.0, steps=2)]
    assert done[-1] == 2.0 and 1.0 in done
    assert np.all(np.diff([0.0, *done]) <= 0.3)
    assert len(tried) > len(done)  # increments failed, also after growth
    prescribed = list(fc.increments(plain.problem, plain.load, 0.0, 2.0, steps=done))
    assert setup.problem.increment == len(prescribed) == len(done)
    assert have_equal_states(setup, plain, 1e-7)


def test_number_of_cuts_is_limited():
    """An increment that never converges raises the error, and the committed state is unchanged."""
    setup = BlockOnBall()
    fail_increments_above(setup, 0.0)
    with pytest.raises(fc.NotConverged):
        list(fc.increments(setup.problem, setup.load, 0.0, 1.0, max_cuts=3))
    assert setup.problem.increment == 0
    assert setup.push[1].value == 0.0
    assert np.all(owned_values(setup.scene.u) == 0.0)


# ---- energy --------------------------------------------------------------------------------------


@pytest.mark.parametrize("law", [fc.Frictionless(k_n=2e4), fc.Coulomb(0.3, k_n=2e4, k_t=1e4)])
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_energy_is_balanced(cell, law):
    """With equilibrium at both ends the balance is exact, up to 1e-6 by the solver's 1e-9."""
    setup = BlockOnBall(law, cell=cell)
    for step in fc.increments(setup.problem, setup.load, 0.0, 4.0, steps=8):
        e = step.energy
        size = abs(e.work) + abs(e.elastic)
        assert abs(e.imbalance) <= 1e-6 * size
        assert e.dissipation >= -1e-14 * size
        assert is_close(
            e.elastic + e.springs + e.dissipation + e.remainder, e.work, 1e-12, scale=size
        )
        if not law.has_friction:
            assert e.dissipation == 0.0


def test_energy_remainder_converges_with_the_increments():
    """The sum of absolute remainders more than halves when the increments are halved."""
    remainders = []
    for n in (8, 16, 32):
        setup = BlockOnBall()
        steps = list(fc.increments(setup.problem, setup.load, 0.0, 4.0, steps=n))
        dissipated = sum(s.energy.dissipation for s in steps)
        assert dissipated > 0
        remainders.append(sum(abs(s.energy.remainder) for s in steps) / dissipated)
    assert remainders[2] < 0.5 * remainders[1] < 0.25 * remainders[0]
    assert remainders[2] < 0.01


@pytest.mark.parametrize("field", [True, False])
def test_energy_of_a_driven_obstacle(field):
    """The work of a weight is stored in the block and the springs: P²/2 (1/k_n + 1/E), to 1e-7."""
    scene = block("quadrilateral", 1, n=2, nu=0.0)
    force = fem.Constant(scene.mesh, 0.0)
    floor = scene.floor(displacement=fc.Motion(force=(None, force)))
    bcs = [scene.dirichlet_bc(TOP, i) for i in range(2)]
    problem, _ = scene.problem(fc.Frictionless(k_n=1e4), bcs, contact={"obstacle": floor})
    force.value = 6.0
    step = problem.solve(recover_interior=field)
    assert is_close(step.energy.work, 18.0 * (1 / 1e4 + 1 / 1000), 1e-7)
    assert is_close(step.energy.springs, 18.0 / 1e4, 1e-7)
    assert is_close(step.energy.elastic, 18.0 / 1000, 1e-7)


# ---- checkpoints ---------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
@pytest.mark.parametrize("checkpoint_every", [1, 3])
def test_restart_gives_identical_digits(cell, method, checkpoint_every, tmp_path):
    """A history interrupted after 5 of 8 increments is restarted by a new problem, bit for bit."""
    folder = shared_folder(tmp_path)
    uninterrupted, interrupted, after = (BlockOnBall(cell=cell, method=method) for _ in range(3))
    options = {"steps": 8, "checkpoint_every": checkpoint_every}
    history = fc.increments(
        uninterrupted.problem,
        uninterrupted.load,
        0.0,
        4.0,
        checkpoint=folder / "whole.npz",
        **options,
    )
    energies = {s.load: s.energy for s in history}
    path = folder / "broken.npz"
    for step in fc.increments(
        interrupted.problem, interrupted.load, 0.0, 4.0, checkpoint=path, **options
    ):
        if step.increment == 5:
            break
    remaining = list(fc.increments(after.problem, after.load, 0.0, 4.0, checkpoint=path, **options))
    assert remaining[0].increment == (6 if checkpoint_every == 1 else 4)
    assert have_equal_states(after, uninterrupted, STATE_TOLERANCE)
    for step in remaining:
        size = abs(energies[step.load].work) + abs(energies[step.load].elastic)
        assert is_close(
            step.energy.work, energies[step.load].work, max(STATE_TOLERANCE, 1e-12), scale=size
        )
    # A third start finds nothing left to do.
    resumed = BlockOnBall(cell=cell, method=method)
    assert not list(
        fc.increments(resumed.problem, resumed.load, 0.0, 4.0, checkpoint=path, **options)
    )
    assert have_equal_states(resumed, uninterrupted, STATE_TOLERANCE)


def test_checkpoint_of_another_problem_is_refused(tmp_path):
    """The checkpoint of another mesh is refused, and nothing is changed."""
    path = shared_folder(tmp_path) / "state.npz"
    setup = BlockOnBall()
    list(fc.increments(setup.problem, setup.load, 0.0, 1.0, checkpoint=path))
    other = BlockOnBall(cell="triangle")
    assert_raised_on_all_ranks(
        lambda: list(fc.increments(other.problem, other.load, checkpoint=path)), ValueError, "mesh"
    )
    assert other.problem.increment == 0


class LossyFile(io.FileIO):
    """A file that loses the last byte of everything written to it."""

    def write(self, content):
        """Write all bytes but the last."""
        super().write(bytes(content)[:-1])
        return len(content)


@pytest.mark.parametrize("output", [True, False])
def test_failed_write_keeps_the_previous_checkpoint(output, tmp_path, monkeypatch):
    """If the disk is full, all ranks raise the error, and the last file and state are unchanged.

    The same holds for a disk that loses a byte without an error, because the file is read back.
    """
    path = shared_folder(tmp_path) / "state.npz"
    setup = BlockOnBall()
    history = fc.increments(setup.problem, setup.load, 0.0, 2.0, steps=4, checkpoint=path)
    next(history)
    before = path.read_bytes()
    COMM.barrier()

    def fail_to_write(*args, **kwargs):
        raise OSError(28, "No space left on device")

    def lossy(path, mode):
        assert mode == "wb"
        return LossyFile(path, mode)

    if output:
        monkeypatch.setattr(np, "savez", fail_to_write)
    else:
        monkeypatch.setattr(checkpoint_file, "open", lossy, raising=False)
    words = "No space left" if output else "differs from what was written"
    assert_raised_on_all_ranks(lambda: next(history), (OSError, RuntimeError), words)
    assert path.read_bytes() == before
    assert COMM.allgather(os.listdir(path.parent)) == [["state.npz"]] * COMM.size
    assert setup.problem.increment == 2


SCRIPT = """
import json
import fenics_contact as fc
from scenes.block_on_ball import BlockOnBall
setup = BlockOnBall()
first = setup.scene.mesh.comm.rank == 0
for step in fc.increments(setup.problem, setup.load, 0.0, 4.0, steps=40, checkpoint={path!r}):
    if first:
        print(step.increment, flush=True)
pressure = setup.contact.gather()["pressure"].tolist()
if first:
    print(json.dumps(pressure), flush=True)
"""


def run_script(path: Path, ranks: int, *, kill_after: int | None = None) -> list[str]:
    """Run the history in a separate process, killed after ``kill_after`` increments if given.

    Only one rank prints, because lines of several ranks arrive in any order.
    """
    script = SCRIPT.format(path=str(path))
    words = command(ranks, "-c", script)
    process = subprocess.Popen(
        words, env=subprocess_environment(), stdout=subprocess.PIPE, text=True
    )
    lines = []
    for line in process.stdout:
        lines.append(line.strip())
        if kill_after is not None and line.startswith(f"{kill_after}"):
            process.send_signal(signal.SIGKILL)
            time.sleep(0.1)
            break
    process.stdout.close()
    process.wait()
    return lines


@pytest.mark.skipif(COMM.size > 1, reason="starts its own processes")
@pytest.mark.parametrize("ranks", [(1, 1), (1, 2)])
def test_restart_of_a_killed_process(ranks, tmp_path):
    """After SIGKILL the second run ends with the same digits as an uninterrupted one.

    On another number of ranks pressures agree to 1e-6, by the solver's tolerance of 1e-9.
    """
    first, second = ranks
    alone = run_script(tmp_path / "alone.npz", first)
    killed = run_script(tmp_path / "killed.npz", first, kill_after=17)
    after = run_script(tmp_path / "killed.npz", second)
    assert killed[-1] == "17"
    assert int(after[0]) >= 17
    if first == second:
        assert after[-1] == alone[-1]
    assert is_close(json.loads(after[-1]), json.loads(alone[-1]), 1e-6)
