"""What is no file of this scene, of this path or of any state is refused, by name and undone."""

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
from scenes.comparing import owned, raised_everywhere, shared_folder
from scenes.elasticity import displacement_space, hold, residual
from scenes.histories import Press, differences

COMM = MPI.COMM_WORLD

pytestmark = pytest.mark.mpi


# ---- another scene -------------------------------------------------------------------------------


@pytest.fixture
def saved(tmp_path):
    """A file with half of a history."""
    path = shared_folder(tmp_path) / "state.npz"
    made = Press(wall=True)
    for step in made.increments(checkpoint=path):
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
def test_changed_data_are_refused(other, saved):
    """Each is named with both values; the problem is as before, and goes on if it is told to."""
    options, words = OTHER[other]
    options = {n: v() if callable(v) else v for n, v in options.items()}
    made, fresh = Press(wall=True, **options), Press(wall=True, **options)
    before = saved.read_bytes()
    call = lambda: next(made.increments(checkpoint=saved))  # noqa: E731
    raised_everywhere(call, ValueError, str(saved), *words, "remove it", "continue")
    assert made.problem.increment == 0 and saved.read_bytes() == before
    assert [c.value.max() for c in made.push] == [0.0, 0.0]
    # As if there had been no file.
    for each in (made, fresh):
        each.load(0.5)
        each.problem.solve()
        each.problem.commit()
    assert differences(made, fresh, 0.0 if COMM.size == 1 else 1e-7) == []
    told = Press(wall=True, **options)
    step = next(told.increments(checkpoint=saved, on_mismatch="continue"))
    assert step.increment == 4 and step.load == 2.0


def test_other_loads_and_conditions_are_refused(saved):
    """A load beside the one that is led, another value or component of a condition."""
    made = Press(wall=True)
    made.scene.load(side=1.0)
    call = lambda: next(made.increments(checkpoint=saved))  # noqa: E731
    raised_everywhere(call, ValueError, "loads of the bulk", "v·f")
    made = Press(wall=True)
    load = made.load
    made.load = lambda t: load(1.01 * t)
    raised_everywhere(call, ValueError, "a value prescribed by a Dirichlet condition")
    made = Press(wall=True, held=[1])
    raised_everywhere(call, ValueError, "Dirichlet conditions", "components of nodes")


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
def test_what_cannot_be_taken_over_is_refused_in_any_case(other, saved):
    """Other meshes, elements, points and histories have no place for the state."""
    options, words = FIXED[other]
    options = {n: v() if callable(v) else v for n, v in options.items()}
    for changed in ("refuse", "continue"):
        made = Press(**({"wall": True} | options))
        call = lambda made=made, changed=changed: next(  # noqa: E731
            made.increments(checkpoint=saved, on_mismatch=changed)
        )
        raised_everywhere(call, ValueError, *words)
        assert made.problem.increment == 0


def test_nodes_elsewhere_are_another_mesh(saved):
    """As many of them, and some a millionth of the body off."""
    made = Press(wall=True)
    x = made.scene.mesh.geometry.x
    x[np.all(np.abs(x[:, :2] - 0.5) < 1e-9, axis=1), 0] += 1e-6
    call = lambda: next(made.increments(checkpoint=saved, on_mismatch="continue"))  # noqa: E731
    raised_everywhere(call, ValueError, "nodes", "locations")


def test_data_that_the_load_changes_are_no_change(tmp_path):
    """A friction coefficient and an obstacle as loads: compared where the history stands."""
    path = shared_folder(tmp_path) / "state.npz"

    class Both(Press):
        def load(self, t):
            super().load(t)
            self.problem.contacts[0].parameters["friction"].value = 0.1 + 0.1 * t

    made, after = Both(obstacle="moving"), Both(obstacle="moving")
    next(made.increments(checkpoint=path))
    assert [s.increment for s in after.increments(checkpoint=path)] == list(range(2, 9))


def test_a_nonlinear_bulk_is_compared_at_the_state(tmp_path):
    """Two bodies that differ in what they make of a strain, and not when undeformed."""
    path = shared_folder(tmp_path) / "state.npz"
    made = Press(bulk="nonlinear")
    next(made.increments(checkpoint=path))
    other = Press(bulk="less stiffening")
    raised_everywhere(
        lambda: next(other.increments(checkpoint=path)), ValueError, "stiffness of the bulk"
    )


def test_a_state_that_is_not_committed_is_not_saved(tmp_path):
    """Solved and not committed: refused, and nothing is written; committed or restored it is."""
    path = shared_folder(tmp_path) / "state.npz"
    for end in ("commit", "restore"):
        made = Press()
        next(made.increments())
        made.load(1.0)
        made.problem.solve(recover_interior=False)
        raised_everywhere(lambda m=made: checkpoint.save(m.problem, path), ValueError, "commit()")
        assert not checkpoint.exists(made.problem, path)
        getattr(made.problem, end)()
        checkpoint.save(made.problem, path)
        COMM.barrier()
        after = Press()
        after.load(1.0)
        call = lambda after=after: checkpoint.load(after.problem, path)  # noqa: E731
        if end == "restore":
            raised_everywhere(call, ValueError, "Dirichlet")
            after.load(0.5)
        assert call() == []
        assert after.problem.increment == (2 if end == "commit" else 1)
        COMM.barrier()
        if COMM.rank == 0:
            path.unlink()
        COMM.barrier()


# ---- the place in the load path ------------------------------------------------------------------


def test_another_path_is_refused(saved):
    """Both paths are told; what is done must be what is asked for."""
    for arguments in (
        {"end": 0.5, "steps": 1},  # behind the place
        {"end": -1.0, "steps": 2},
        {"steps": 4},  # 1, 2, 3, 4: it went by halves
        {"start": 0.25, "steps": 8},
        {"end": 5.0, "steps": 8},
    ):
        made = Press(wall=True)
        call = lambda made=made, a=arguments: next(made.increments(checkpoint=saved, **a))  # noqa: E731
        text = raised_everywhere(call, ValueError, "another load path", "from 0 to 4 by 8", "1.5")
        assert f"to {arguments.get('end', 4.0):g} by" in text
        assert made.problem.increment == 0
    made = Press(wall=True)
    made.increments(estimate=True)
    call = lambda: next(made.increments(checkpoint=saved, estimate=True))  # noqa: E731
    raised_everywhere(call, ValueError, "estimate")


# ---- damaged files -------------------------------------------------------------------------------


def test_any_flipped_bit_and_any_cut_is_found(saved):
    """All over the file and at its ends; the problem is as before, and takes the whole file."""
    content = saved.read_bytes()
    COMM.barrier()
    made, n = Press(wall=True), len(content)
    rng = np.random.default_rng(1)
    places = [0, 3, 8, 26, n - 1, n - 64, n - 70, n - 120, *rng.integers(0, n, 30)]
    bad = [content[:i] for i in (0, 1, 100, n // 2, n - 1, n - 64, n - 200)]
    bad += [content + b"0", content + content, content[1:]]
    for i in places:
        bad.append(content[:i] + bytes([content[i] ^ 1 << int(rng.integers(8))]) + content[i + 1 :])
    for damaged in bad:
        write(saved, damaged)
        call = lambda: next(made.increments(checkpoint=saved))  # noqa: E731
        raised_everywhere(call, ValueError, str(saved), "remove it")
    assert made.problem.increment == 0 and not np.any(owned(made.scene.u))
    write(saved, content)
    assert next(made.increments(checkpoint=saved)).increment == 4


def write(path: Path, content: bytes) -> None:
    """By rank 0, seen by all."""
    COMM.barrier()
    if COMM.rank == 0:
        path.write_bytes(content)
    COMM.barrier()


def test_other_formats(tmp_path):
    """A text, an array, an archive of something else, and a checkpoint of another format."""
    path = shared_folder(tmp_path) / "state.npz"
    made = Press()
    call = lambda: next(made.increments(checkpoint=path))  # noqa: E731
    if COMM.rank == 0:
        path.write_text("not a checkpoint\n" * 100)
    raised_everywhere(call, ValueError, "no checkpoint")
    if COMM.rank == 0:
        with open(path, "wb") as file:
            np.save(file, np.ones(100))
    raised_everywhere(call, ValueError, "no checkpoint")
    if COMM.rank == 0:
        np.savez(path, numbers=np.ones(3), nodes=np.ones((100, 4)))
    raised_everywhere(call, ValueError, "no checkpoint")
    if COMM.rank == 0:
        checkpoint_file.write_file(path, {"format": 99}, {})
    raised_everywhere(call, ValueError, "format 99")
    if COMM.rank == 0:
        checkpoint_file.write_file(path, {"anything": 1}, {"nodes": np.ones(3)})
    raised_everywhere(call, ValueError, "no checkpoint")


def spoilt(name):
    """What a file's array is replaced by, whole but for that."""

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
@pytest.mark.parametrize("how", ["nan", "complex", "single", "words", "scalar", "short", "none"])
@pytest.mark.parametrize("what", ["nodes", "contact floor", "stiffness", "state", "numbers"])
def test_arrays_that_are_none_of_a_state(what, how, saved):
    """A file that is whole, with numbers that are none or of another kind."""
    if COMM.rank == 0:
        scene, arrays = checkpoint_file.read_file(saved)
        change = spoilt(how)
        if change is None:
            del arrays[what]
        else:
            arrays[what] = np.asarray(change(arrays[what]))
        checkpoint_file.write_file(saved, scene, arrays)
    COMM.barrier()
    made = Press(wall=True)
    call = lambda: next(made.increments(checkpoint=saved))  # noqa: E731
    missing = ["it lacks numbers"] * ((what, how) == ("numbers", "none"))
    raised_everywhere(call, ValueError, str(saved), *missing)
    assert made.problem.increment == 0 and not np.any(owned(made.scene.u))
    assert [float(c.value) for c in made.push] == [0.0, 0.0]


def test_what_cannot_be_read_or_written(saved, monkeypatch):
    """A folder, one that is not there, and no right to read: OSError, or refused at the call."""
    made, folder = Press(wall=True), saved.parent
    call = lambda path: next(made.increments(checkpoint=path))  # noqa: E731
    raised_everywhere(lambda: call(folder), OSError)
    raised_everywhere(
        lambda: made.increments(checkpoint=folder / "none" / "x.npz"), ValueError, "no folder"
    )

    def refuse(*args):
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "read_bytes", refuse)
        raised_everywhere(lambda: call(saved), OSError, "Permission denied")
    assert made.problem.increment == 0


def test_a_load_that_fails_leaves_the_problem(saved):
    """The function that sets the loads raises at the stored place."""
    made = Press(wall=True)
    load = made.load

    def failing(t):
        if t > 1.0:
            raise ValueError("no such load")
        load(t)

    made.load = failing
    raised_everywhere(lambda: next(made.increments(checkpoint=saved)), ValueError, "no such load")
    assert made.problem.increment == 0 and not np.any(owned(made.scene.u))


def test_bodies_that_cover_one_another(tmp_path):
    """Values at one place in cells of one middle: no file is begun that could not be read."""
    line = np.linspace(0.0, 1.0, 3)
    sides = {1: lambda x, _: np.isclose(x[:, 1], 0.0), 2: lambda x, _: np.isclose(x[:, 1], 1.0)}
    mesh, tags = boxes([[line, line]] * 2, sides)
    u, top = fem.Function(displacement_space(mesh, 1)), fem.Constant(mesh, -0.01)
    floor = fc.HalfSpace(point=(0, 0), normal=(0, 1))
    contact = fc.Contact(u, fc.ContactSurface(mesh, tags, 1), floor, fc.Coulomb(0.3))
    form = residual(u, ufl.TestFunction(u.function_space), 1000.0, 0.3)
    conditions = [hold(u, tags, 2, 0), hold(u, tags, 2, 1, top)]
    problem = fc.ContactProblem(form, u, bcs=conditions, contacts=[contact])
    path = shared_folder(tmp_path) / "state.npz"
    call = lambda: fc.increments(problem, top, 0, 1, steps=2, checkpoint=path)  # noqa: E731
    raised_everywhere(call, ValueError, "9 nodes", "cells that coincide")
    raised_everywhere(lambda: checkpoint.save(problem, path), ValueError, "9 nodes")
    problem.solve()
    assert contact.resultants().normal_force > 0.0 and not path.exists()


# ---- calls that are no use -----------------------------------------------------------------------


def test_increments_that_are_never_asked_for(caplog):
    """A warning says that nothing was solved; none where something was, or nothing was to be.

    It is in the log, too: FFCx hides Python's warnings where no logging has been set up.
    """
    made = Press()
    with pytest.warns(RuntimeWarning, match="iterate over"):
        made.increments()
    assert made.problem.increment == 0
    assert caplog.text.count("nothing was solved") == (COMM.rank == 0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*assumed small")
        next(made.increments(1.0))
    assert made.problem.increment == 1


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
    """Not when the first increment is asked for."""
    made = Press()
    arguments = {"load": made.load, "start": 0.0, "end": 1.0} | arguments
    call = lambda: fc.increments(made.problem, **arguments)  # noqa: E731
    raised_everywhere(call, ValueError, *words)
