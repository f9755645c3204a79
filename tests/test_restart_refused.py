"""Checkpoints of other data or load paths and damaged ones are refused without side effects."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact import checkpoint
from fenics_contact.histories import checkpoint_file
from scenes.bodies import boxes
from scenes.comparison import assert_raised_on_all_ranks, owned_values, shared_folder
from scenes.elasticity import dirichlet_bc, displacement_space, residual
from scenes.histories import BlockOnBallHistory, find_differences

COMM = MPI.COMM_WORLD

pytestmark = pytest.mark.mpi


# ---- another scene -------------------------------------------------------------------------------


@pytest.fixture
def saved_checkpoint(tmp_path):
    """Return the path of a checkpoint of a history stopped after increment 3."""
    path = shared_folder(tmp_path) / "state.npz"
    setup = BlockOnBallHistory(wall=True)
    for step in setup.increments(checkpoint=path):
        if step.increment == 3:
            break
    return path


OTHER = {
    "modulus": ({"E": 1001.0}, ["stiffness of the bulk"]),
    "modulus by 1e-8": ({"E": 1000.00001}, ["stiffness of the bulk"]),
    "friction": (
        {"law": lambda: fc.Coulomb(0.31, k_n=2e4, k_t=1e4)},
        ["friction of floor", "0.3 in", "0.31 here"],
    ),
    "k_n": (
        {"law": lambda: fc.Coulomb(0.3, k_n=2.1e4, k_t=1e4)},
        ["k_n of floor", "20000 in", "21000 here"],
    ),
    "law": (
        {"law": lambda: fc.Tresca(0.3, 5.0, k_n=2e4, k_t=1e4)},
        ["law of floor", "Coulomb()", "Tresca(unilateral=True)", "pressure"],
    ),
    "radius": ({"radius": 2.0001}, ["gap of floor"]),
    "tilt": ({"tilt": 0.001}, ["normal of floor"]),
    "weight": ({"contact": {"weight": 2.0}}, ["weight of floor", "1 in", "2 here"]),
    "obstacle": (
        {"obstacle": "moving"},
        ["prescribed by a Dirichlet condition", "shift of floor"],
    ),
}


@pytest.mark.whole
@pytest.mark.parametrize("other", OTHER)
def test_changed_data_are_refused(other, saved_checkpoint):
    """The error names the change, with both values of a number, and the problem is unchanged.

    With ``on_mismatch="continue"`` the history continues.
    """
    options, words = OTHER[other]
    options = {n: v() if callable(v) else v for n, v in options.items()}
    setup, fresh = (
        BlockOnBallHistory(wall=True, **options),
        BlockOnBallHistory(wall=True, **options),
    )
    before = saved_checkpoint.read_bytes()
    call = lambda: next(setup.increments(checkpoint=saved_checkpoint))  # noqa: E731
    assert_raised_on_all_ranks(
        call, ValueError, str(saved_checkpoint), *words, "remove it", "continue"
    )
    assert setup.problem.increment == 0 and saved_checkpoint.read_bytes() == before
    assert [c.value.max() for c in setup.push] == [0.0, 0.0]
    # The problem is as if there had been no file.
    for each in (setup, fresh):
        each.load(0.5)
        each.problem.solve()
        each.problem.commit()
    assert find_differences(setup, fresh, 0.0 if COMM.size == 1 else 1e-7) == []
    expected = BlockOnBallHistory(wall=True, **options)
    step = next(expected.increments(checkpoint=saved_checkpoint, on_mismatch="continue"))
    assert step.increment == 4 and step.load == 2.0


def test_other_loads_and_conditions_are_refused(saved_checkpoint):
    """An additional load, and another value or component of a condition, are refused."""
    setup = BlockOnBallHistory(wall=True)
    setup.scene.load(side=1.0)
    call = lambda: next(setup.increments(checkpoint=saved_checkpoint))  # noqa: E731
    assert_raised_on_all_ranks(call, ValueError, "loads of the bulk", "v·f")
    setup = BlockOnBallHistory(wall=True)
    load = setup.load
    setup.load = lambda t: load(1.01 * t)
    assert_raised_on_all_ranks(call, ValueError, "a value prescribed by a Dirichlet condition")
    setup = BlockOnBallHistory(wall=True, prescribed_components=[1])
    assert_raised_on_all_ranks(call, ValueError, "Dirichlet conditions", "components of nodes")


FIXED = {
    "n": ({"n": 5}, ["mesh is"]),
    "cell": ({"cell": "triangle"}, ["mesh is", "quadrilaterals", "triangles"]),
    "degree": ({"degree": 2}, ["element", "degree 1", "degree 2"]),
    "dimension": ({"cell": "hexahedron", "n": 2}, ["dimension is 2 in the file and 3 here"]),
    "history": ({"law": lambda: fc.Frictionless(k_n=2e4)}, ["history of floor", "slip"]),
    "multipliers": ({"contact": {"enforcement": "augmented"}}, ["history of floor", "multiplier"]),
    "name": ({"names": ("ground", "wall")}, ["contacts", "floor, wall", "ground, wall"]),
    "contacts": ({"wall": False}, ["contacts", "floor, wall"]),
    "rule": ({"surface": {"quadrature_degree": 5}}, ["quadrature of floor", "points"]),
    "motion": ({"obstacle": "force"}, ["free motion of floor"]),
}


@pytest.mark.whole
@pytest.mark.parametrize("other", FIXED)
def test_incompatible_checkpoints_are_always_refused(other, saved_checkpoint):
    """States of other meshes, elements, points or history fields cannot be transferred."""
    options, words = FIXED[other]
    options = {n: v() if callable(v) else v for n, v in options.items()}
    for changed in ("refuse", "continue"):
        setup = BlockOnBallHistory(**({"wall": True} | options))
        call = lambda setup=setup, changed=changed: next(  # noqa: E731
            setup.increments(checkpoint=saved_checkpoint, on_mismatch=changed)
        )
        assert_raised_on_all_ranks(call, ValueError, *words)
        assert setup.problem.increment == 0


def test_mesh_with_displaced_nodes_is_refused(saved_checkpoint):
    """The number of nodes is the same, but some are displaced by 1e-6 of the body's size."""
    setup = BlockOnBallHistory(wall=True)
    x = setup.scene.mesh.geometry.x
    x[np.all(np.abs(x[:, :2] - 0.5) < 1e-9, axis=1), 0] += 1e-6
    call = lambda: next(setup.increments(checkpoint=saved_checkpoint, on_mismatch="continue"))  # noqa: E731
    assert_raised_on_all_ranks(call, ValueError, "nodes", "locations")


def test_data_changed_by_the_load_are_accepted(tmp_path):
    """A friction coefficient and an obstacle set by the load are compared at the stored load."""
    path = shared_folder(tmp_path) / "state.npz"

    class Both(BlockOnBallHistory):
        def load(self, t):
            super().load(t)
            self.problem.contacts[0].parameters["friction"].value = 0.1 + 0.1 * t

    setup, after = Both(obstacle="moving"), Both(obstacle="moving")
    next(setup.increments(checkpoint=path))
    assert [s.increment for s in after.increments(checkpoint=path)] == list(range(2, 9))


def test_nonlinear_bulk_is_compared_at_the_stored_state(tmp_path):
    """Two bodies whose stiffness differs only when they are deformed are distinguished."""
    path = shared_folder(tmp_path) / "state.npz"
    setup = BlockOnBallHistory(bulk="nonlinear")
    next(setup.increments(checkpoint=path))
    other = BlockOnBallHistory(bulk="less stiffening")
    assert_raised_on_all_ranks(
        lambda: next(other.increments(checkpoint=path)), ValueError, "stiffness of the bulk"
    )


def test_uncommitted_state_is_not_saved(tmp_path):
    """Before `commit` or `restore` nothing is written; after it, the committed state is saved."""
    path = shared_folder(tmp_path) / "state.npz"
    for end in ("commit", "restore"):
        setup = BlockOnBallHistory()
        next(setup.increments())
        setup.load(1.0)
        setup.problem.solve(recover_interior=False)
        assert_raised_on_all_ranks(
            lambda m=setup: checkpoint.save(m.problem, path), ValueError, "commit()"
        )
        assert not checkpoint.exists(setup.problem, path)
        getattr(setup.problem, end)()
        checkpoint.save(setup.problem, path)
        COMM.barrier()
        after = BlockOnBallHistory()
        after.load(1.0)
        call = lambda after=after: checkpoint.load(after.problem, path)  # noqa: E731
        if end == "restore":
            assert_raised_on_all_ranks(call, ValueError, "Dirichlet")
            after.load(0.5)
        assert call() == []
        assert after.problem.increment == (2 if end == "commit" else 1)
        COMM.barrier()
        if COMM.rank == 0:
            path.unlink()
        COMM.barrier()


# ---- position in the load path -------------------------------------------------------------------


def test_other_load_paths_are_refused(saved_checkpoint):
    """The error states both load paths; the requested one must contain the stored loads."""
    for arguments in (
        {"end": 0.5, "steps": 1},  # ends before the stored load
        {"end": -1.0, "steps": 2},
        {"steps": 4},  # 1, 2, 3, 4; the stored increments are 0.5
        {"start": 0.25, "steps": 8},
        {"end": 5.0, "steps": 8},
    ):
        setup = BlockOnBallHistory(wall=True)
        call = lambda setup=setup, a=arguments: next(  # noqa: E731
            setup.increments(checkpoint=saved_checkpoint, **a)
        )
        text = assert_raised_on_all_ranks(
            call, ValueError, "another load path", "from 0 to 4 by 8", "1.5"
        )
        assert f"to {arguments.get('end', 4.0):g} by" in text
        assert setup.problem.increment == 0
    setup = BlockOnBallHistory(wall=True)
    setup.increments(estimate=True)
    call = lambda: next(setup.increments(checkpoint=saved_checkpoint, estimate=True))  # noqa: E731
    assert_raised_on_all_ranks(call, ValueError, "estimate")


# ---- damaged files -------------------------------------------------------------------------------


def test_flipped_bits_and_truncated_files_are_detected(saved_checkpoint):
    """Damage anywhere is refused; the problem is unchanged, and then reads the intact file."""
    content = saved_checkpoint.read_bytes()
    COMM.barrier()
    setup, n = BlockOnBallHistory(wall=True), len(content)
    rng = np.random.default_rng(1)
    places = [0, 3, 8, 26, n - 1, n - 64, n - 70, n - 120, *rng.integers(0, n, 30)]
    bad = [content[:i] for i in (0, 1, 100, n // 2, n - 1, n - 64, n - 200)]
    bad += [content + b"0", content + content, content[1:]]
    for i in places:
        bad.append(content[:i] + bytes([content[i] ^ 1 << int(rng.integers(8))]) + content[i + 1 :])
    for damaged in bad:
        write(saved_checkpoint, damaged)
        call = lambda: next(setup.increments(checkpoint=saved_checkpoint))  # noqa: E731
        assert_raised_on_all_ranks(call, ValueError, str(saved_checkpoint), "remove it")
    assert setup.problem.increment == 0 and not np.any(owned_values(setup.scene.u))
    write(saved_checkpoint, content)
    assert next(setup.increments(checkpoint=saved_checkpoint)).increment == 4


def write(path: Path, content: bytes) -> None:
    """Write a file on rank 0, visible to all ranks on return."""
    COMM.barrier()
    if COMM.rank == 0:
        path.write_bytes(content)
    COMM.barrier()


def test_other_file_formats_are_refused(tmp_path):
    """Texts, arrays, other archives and checkpoints of another format are refused."""
    path = shared_folder(tmp_path) / "state.npz"
    setup = BlockOnBallHistory()
    call = lambda: next(setup.increments(checkpoint=path))  # noqa: E731
    if COMM.rank == 0:
        path.write_text("not a checkpoint\n" * 100)
    assert_raised_on_all_ranks(call, ValueError, "no checkpoint")
    if COMM.rank == 0:
        with open(path, "wb") as file:
            np.save(file, np.ones(100))
    assert_raised_on_all_ranks(call, ValueError, "no checkpoint")
    if COMM.rank == 0:
        np.savez(path, numbers=np.ones(3), nodes=np.ones((100, 4)))
    assert_raised_on_all_ranks(call, ValueError, "no checkpoint")
    if COMM.rank == 0:
        checkpoint_file.write_file(path, {"format": 99}, {})
    assert_raised_on_all_ranks(call, ValueError, "format 99")
    if COMM.rank == 0:
        checkpoint_file.write_file(path, {"anything": 1}, {"nodes": np.ones(3)})
    assert_raised_on_all_ranks(call, ValueError, "no checkpoint")


def make_corruption(name):
    """Return a function that corrupts an array, or None if the array is to be removed."""

    def nan(array):
        array = array.copy()
        array.flat[array.size // 2] = np.nan
        return array

    return {
        "nan": nan,
        "complex": lambda array: array.astype(np.complex128),
        "single": lambda array: array.astype(np.float32),
        "words": lambda array: np.full(array.shape, "a"),
        "scalar": lambda array: np.float64(3.0),
        "short": lambda array: array[: len(array) // 2],
        "narrow": lambda array: array[..., : array.shape[-1] // 2],
        "none": None,
    }[name]


@pytest.mark.each
@pytest.mark.parametrize(
    "corruption", ["nan", "complex", "single", "words", "scalar", "short", "none"]
)
@pytest.mark.parametrize("array", ["nodes", "contact floor", "stiffness", "state", "numbers"])
def test_corrupted_arrays_are_refused(array, corruption, saved_checkpoint):
    """A file with a valid checksum is refused if an array is missing, not finite or mistyped."""
    if COMM.rank == 0:
        scene, arrays = checkpoint_file.read_file(saved_checkpoint)
        change = make_corruption(corruption)
        if change is None:
            del arrays[array]
        else:
            arrays[array] = np.asarray(change(arrays[array]))
        checkpoint_file.write_file(saved_checkpoint, scene, arrays)
    COMM.barrier()
    setup = BlockOnBallHistory(wall=True)
    call = lambda: next(setup.increments(checkpoint=saved_checkpoint))  # noqa: E731
    missing = ["it lacks numbers"] * ((array, corruption) == ("numbers", "none"))
    assert_raised_on_all_ranks(call, ValueError, str(saved_checkpoint), *missing)
    assert setup.problem.increment == 0 and not np.any(owned_values(setup.scene.u))
    assert [float(c.value) for c in setup.push] == [0.0, 0.0]


def test_unreadable_files_and_missing_folders_are_refused(saved_checkpoint, monkeypatch):
    """A folder or an unreadable file raises OSError; a missing folder is refused at the call."""
    setup, folder = BlockOnBallHistory(wall=True), saved_checkpoint.parent
    call = lambda path: next(setup.increments(checkpoint=path))  # noqa: E731
    assert_raised_on_all_ranks(lambda: call(folder), OSError)
    assert_raised_on_all_ranks(
        lambda: setup.increments(checkpoint=folder / "none" / "x.npz"), ValueError, "no folder"
    )

    def refuse(*args):
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "read_bytes", refuse)
        assert_raised_on_all_ranks(lambda: call(saved_checkpoint), OSError, "Permission denied")
    assert setup.problem.increment == 0


def test_failing_load_function_leaves_the_problem_unchanged(saved_checkpoint):
    """The function that sets the loads raises at the stored load."""
    setup = BlockOnBallHistory(wall=True)
    load = setup.load

    def raise_error(t):
        if t > 1.0:
            raise ValueError("no such load")
        load(t)

    setup.load = raise_error
    assert_raised_on_all_ranks(
        lambda: next(setup.increments(checkpoint=saved_checkpoint)), ValueError, "no such load"
    )
    assert setup.problem.increment == 0 and not np.any(owned_values(setup.scene.u))


def test_coinciding_cells_cannot_be_saved(tmp_path):
    """No file is written if values cannot be assigned: coinciding nodes in coinciding cells."""
    line = np.linspace(0.0, 1.0, 3)
    sides = {1: lambda x, _: np.isclose(x[:, 1], 0.0), 2: lambda x, _: np.isclose(x[:, 1], 1.0)}
    mesh, tags = boxes([[line, line]] * 2, sides)
    u, top = fem.Function(displacement_space(mesh, 1)), fem.Constant(mesh, -0.01)
    floor = fc.HalfSpace(point=(0, 0), normal=(0, 1))
    contact = fc.Contact(u, fc.ContactSurface(mesh, tags, 1), floor, fc.Coulomb(0.3))
    form = residual(u, ufl.TestFunction(u.function_space), 1000.0, 0.3)
    conditions = [dirichlet_bc(u, tags, 2, 0), dirichlet_bc(u, tags, 2, 1, top)]
    problem = fc.ContactProblem(form, u, bcs=conditions, contacts=[contact])
    path = shared_folder(tmp_path) / "state.npz"
    call = lambda: fc.increments(problem, top, 0, 1, steps=2, checkpoint=path)  # noqa: E731
    assert_raised_on_all_ranks(call, ValueError, "9 nodes", "cells that coincide")
    assert_raised_on_all_ranks(lambda: checkpoint.save(problem, path), ValueError, "9 nodes")
    problem.solve()
    assert contact.resultants().normal_force > 0.0 and not path.exists()


# ---- calls without effect ------------------------------------------------------------------------


def test_increments_without_iteration_warn(caplog):
    """A warning states that nothing was solved, unless an increment was or none was due.

    It is logged, too: FFCx hides Python's warnings if no logging has been set up.
    """
    setup = BlockOnBallHistory()
    with pytest.warns(RuntimeWarning, match="iterate over"):
        setup.increments()
    assert setup.problem.increment == 0
    assert caplog.text.count("nothing was solved") == (COMM.rank == 0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*assumed small")
        next(setup.increments(1.0))
    assert setup.problem.increment == 1


@pytest.mark.whole
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"steps": 0}, ["steps is 0"]),
        ({"steps": 2.5}, ["steps is 2.5"]),
        ({"end": "1"}, ["end is '1'"]),
        ({"end": float("nan")}, ["end is nan"]),
        ({"start": None}, ["start is None"]),
        ({"start": 1.0, "end": 1.0}, ["start", "end"]),
        ({"recover_interior": "never"}, ["recover_interior", "never"]),
        ({"max_cuts": -1}, ["max_cuts is -1"]),
        ({"checkpoint_every": 0}, ["checkpoint_every is 0"]),
        ({"on_mismatch": "yes"}, ["on_mismatch", "refuse", "continue"]),
        ({"checkpoint": 3}, ["checkpoint is 3"]),
        ({"state_fields": 3, "checkpoint": "x.npz"}, ["state_fields"]),
        ({"load": 3}, ["load is a int"]),
    ],
)
def test_arguments_are_checked_at_the_call(arguments, words):
    """Arguments are checked by the call of `increments`, not by its first increment."""
    setup = BlockOnBallHistory()
    arguments = {"load": setup.load, "start": 0.0, "end": 1.0} | arguments
    call = lambda: fc.increments(setup.problem, **arguments)  # noqa: E731
    assert_raised_on_all_ranks(call, ValueError, *words)
