"""Injected faults: all ranks raise the error, and no state or file is lost or half written.

After every fault the state is exactly that of the last commit, and the same problem then solves the
increment with the result of one without a fault (1e-8: two solutions within the solver's tolerance
of 1e-9).
"""

import json
import os
import resource
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from fenics_contact import output, parallel, plotting
from fenics_contact.surface import surface
from fenics_contact.systems import dense
from scenes.block_on_ball import PATH, BlockOnBall, copy_state, solve_path
from scenes.comparison import (
    are_identical,
    assert_raised_on_all_ranks,
    is_close,
    nodal_values,
    shared_folder,
)
from scenes.elasticity import stress
from scenes.processes import command, subprocess_environment

COMM = MPI.COMM_WORLD
LAST = COMM.size - 1
METHODS = ("lbfgs", "newton", "continuation", "alternating")[: 4 if COMM.size == 1 else 2]

# The timeout is long enough for a loaded machine; a deadlock is ended.
pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]


class Fault(Exception):
    """An error that nothing in the package raises."""


def raise_after(function, after, error=Fault, *, rank=None):
    """Return the function such that it raises after ``after`` calls, on all ranks or on one."""
    calls = [0]

    def call(*args, **kwargs):
        calls[0] += 1
        if calls[0] > after and rank in (None, COMM.rank):
            raise error("put in on purpose")
        return function(*args, **kwargs)

    return call


def assert_state_unchanged(setup, call, kind, *words):
    """Check that the call raises on all ranks and leaves the state of the problem unchanged."""
    before, increment = copy_state(setup), setup.problem.increment
    assert_raised_on_all_ranks(call, kind, *words)
    assert are_identical(copy_state(setup), before)
    assert setup.problem.increment == increment
    assert setup.contact.inputs.stiffness_factor.value == 1.0


def expected_error_types(error):
    """Return the types that this rank may raise for an error on the first rank only."""
    return error if COMM.rank == 0 else (error, RuntimeError)


def assert_solves_like_reference(setup, reference):
    """Solve the increment, and compare u with that of the problem without faults, to 1e-8."""
    for m in (setup, reference):
        solve_path(m, path=PATH[2:3])
    assert is_close(nodal_values(setup.scene.u), nodal_values(reference.scene.u), 1e-8)


def pair(method="lbfgs", **kwargs):
    """Return two problems after two increments, with the load of the third."""
    both = [BlockOnBall(method=method, **kwargs) for _ in range(2)]
    for setup in both:
        solve_path(setup, path=PATH[:2])
        setup.set_top_displacement(*PATH[2])
    return both


# ---- in a solve ----------------------------------------------------------------------------------


@pytest.mark.each
@pytest.mark.parametrize("condensation", [None, False])
@pytest.mark.parametrize("method", METHODS)
def test_exception_in_a_callback_is_raised_unchanged(method, condensation, monkeypatch):
    """An exception in the residual or, if SNES evaluates it, the tangent is raised unchanged."""
    setup, reference = pair(method, condensation=condensation)
    equations = setup.problem.solver.equations
    names = {"newton": "assemble_tangent", "continuation": "assemble_tangent"}
    for name in filter(None, ("residual", names.get(method))):
        for after in (1, 3) if name == "residual" else (0,):
            with monkeypatch.context() as patch:
                patch.setattr(equations, name, raise_after(getattr(equations, name), after))
                assert_state_unchanged(setup, setup.problem.solve, Fault, "on purpose")
    assert_solves_like_reference(setup, reference)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_exception_on_one_rank_is_raised_on_all(method, monkeypatch):
    """A MemoryError in the assembly on one rank is raised there; the other ranks get its text."""
    setup, reference = pair(method)
    for after in (0, 4):
        with monkeypatch.context() as patch:
            failing_call = raise_after(fem.assemble_vector, after, MemoryError, rank=LAST)
            patch.setattr(surface.fem, "assemble_vector", failing_call)
            assert_state_unchanged(
                setup, setup.problem.solve, (MemoryError, RuntimeError), "on purpose"
            )
    assert_solves_like_reference(setup, reference)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_stopped_snes_restores_the_last_commit(method, monkeypatch):
    """SNES is stopped by an iteration limit of 0 or 1, and by KeyboardInterrupt in its test."""
    setup, reference = pair(method)
    limit = setup.problem.solver.main.max_it
    for allowed in (0, 1):
        setup.problem.solver.main.max_it = allowed
        assert_state_unchanged(
            setup, setup.problem.solve, fc.NotConverged, "iteration limit reached"
        )
    setup.problem.solver.main.max_it = limit
    equations = setup.problem.solver.equations
    monkeypatch.setattr(
        equations, "is_converged", raise_after(equations.is_converged, 1, KeyboardInterrupt)
    )
    before = copy_state(setup)
    with pytest.raises(KeyboardInterrupt):
        setup.problem.solve()
    assert are_identical(copy_state(setup), before)
    monkeypatch.undo()
    assert_solves_like_reference(setup, reference)


@pytest.mark.each
@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("kind", "name"),
    [
        (dense.UpdatedLU, "refactor"),
        (dense.UpdatedLU, "_solve"),
    ],
)
def test_exception_in_a_dense_solve_is_raised_unchanged(kind, name, method, error, monkeypatch):
    """An exception in any call of the dense factorisation or solve by PETSc is raised unchanged.

    The dense matrix is on the first rank; the other ranks get the text of the error.
    """
    setup, reference = pair(method)
    for after in (0, 1, 2, 5):
        with monkeypatch.context() as patch:
            failing_call = raise_after(getattr(kind, name), after, error)
            patch.setattr(kind, name, failing_call)
            before = copy_state(setup)
            try:
                setup.problem.solve()
            except expected_error_types(error):
                assert are_identical(copy_state(setup), before)
            else:  # there were fewer calls
                setup.problem.restore()
    assert_solves_like_reference(setup, reference)


@contextmanager
def interrupted_at(event: int):
    """Send Ctrl-C at the given call or return of a Python or C function; yield their count."""
    events = [0]

    def count(*_):
        events[0] += 1
        if events[0] == event:
            signal.raise_signal(signal.SIGINT)

    sys.setprofile(count)
    try:
        yield events
    finally:
        sys.setprofile(None)


@pytest.fixture
def python_is_interrupted():
    """Restore Python's handler of Ctrl-C: gmsh replaces it by one that ends the process."""
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, handler)


@pytest.mark.skipif(COMM.size > 1, reason="a signal to one rank")
@pytest.mark.usefixtures("python_is_interrupted")
@pytest.mark.skipif(
    "PYTEST_XDIST_WORKER" in os.environ, reason="the signal may end a worker: run it by itself"
)
@pytest.mark.parametrize("condensation", [True, False])
@pytest.mark.parametrize("method", METHODS)
def test_an_interrupt_at_any_time(method, condensation):
    """Ctrl-C in PETSc or its callbacks raises KeyboardInterrupt and restores the last commit.

    Interrupts are sent by the count of calls: a solve may take less than the tick of a timer.
    """
    setup, reference = pair(method, condensation=condensation)
    setup.problem.solve()  # compiles
    setup.problem.restore()
    with interrupted_at(0) as events:
        setup.problem.solve()
    solved = copy_state(setup)[0]
    setup.problem.restore()
    before, handler = copy_state(setup), signal.getsignal(signal.SIGINT)
    for fraction in np.linspace(0.01, 0.99, 50):
        with pytest.raises(KeyboardInterrupt), interrupted_at(int(fraction * events[0])):
            setup.problem.solve()
        if is_close(copy_state(setup)[0], solved, 1e-8):  # the solve was complete
            setup.problem.restore()
        assert are_identical(copy_state(setup), before)
        assert signal.getsignal(signal.SIGINT) is handler
    assert_solves_like_reference(setup, reference)


@pytest.mark.parametrize("name", ["product", "_solve"])
def test_exception_in_a_linearised_solve_is_raised_unchanged(name, monkeypatch):
    """An exception in a product or solve of the error estimate is raised; later solves succeed."""
    setup, reference = pair("newton")
    setup.problem.solve()
    kind = dense.SumOperator if name == "product" else dense.UpdatedLU
    with monkeypatch.context() as patch:
        patch.setattr(kind, name, raise_after(getattr(kind, name), 0))
        with pytest.raises(expected_error_types(Fault), match="on purpose"):
            fc.estimate_errors(setup.problem, stress(setup.scene.u, setup.scene.E, setup.scene.nu))
    setup.problem.restore()
    assert_solves_like_reference(setup, reference)


@pytest.mark.parametrize(
    ("method", "condensation", "prefix"),
    [
        ("lbfgs", False, "contact_"),
        ("newton", False, "contact_tangent_"),
        ("lbfgs", True, "contact_interior_"),
    ],
)
def test_mumps_out_of_memory_raises_memory_error(method, condensation, prefix):
    """MUMPS with a limit of 1 MB, too little for this mesh, gives MemoryError, not a solution."""
    setup = BlockOnBall(mesh={"n": 64}, method=method, condensation=condensation)
    setup.set_top_displacement(*PATH[0])
    options, key = PETSc.Options(), f"{prefix}mat_mumps_icntl_23"
    options[key] = 1
    try:
        assert_state_unchanged(setup, setup.problem.solve, MemoryError, "out of memory")
    finally:
        del options[key]
    assert setup.problem.solve().verdict.failures == []


ALONE = """
from scenes.block_on_ball import PATH, BlockOnBall
from fenics_contact import parallel
parallel.ABORT_TIMEOUT = 0.2
setup = BlockOnBall()
setup.set_top_displacement(*PATH[0])
name, rank = "{name}", setup.problem.u.function_space.mesh.comm.rank
equations = setup.problem.solver.equations
kept = getattr(equations, name)
setattr(equations, name, lambda *args: kept(*args) if rank == 0 else 1 / 0)
setup.problem.solve()
"""


@pytest.mark.skipif(COMM.size > 1, reason="starts ranks of its own")
@pytest.mark.parametrize("name", ["residual_at", "is_converged"])
def test_error_on_one_rank_without_communication_aborts_all(name):
    """If the other ranks wait for a failed one, all are aborted, and the error is printed."""
    words = command(2, "-c", ALONE.format(name=name))
    done = subprocess.run(words, env=subprocess_environment(), capture_output=True, timeout=60)
    output = done.stderr.decode(errors="replace")
    assert done.returncode != 0
    assert "rank 1 failed while the others were waiting" in output and "ZeroDivisionError" in output


def test_error_in_a_load_function_on_one_rank_is_raised_on_all():
    """The user's load function raises on one rank: all ranks raise, and the load is restored."""
    setup = BlockOnBall()

    def load(t):
        if t == 2.0 and COMM.rank == LAST:
            raise ValueError("no such load")
        setup.set_top_displacement(0.0, 0.01 * t)

    done = []

    def run():
        done.extend(s.load for s in fc.increments(setup.problem, load, 0.0, 2.0, steps=2))

    assert_raised_on_all_ranks(run, ValueError, "no such load")
    assert done == [1.0] and setup.problem.increment == 1
    assert setup.push[-1].value == -0.01


# ---- in a commit ---------------------------------------------------------------------------------


def test_failed_commit_restores_the_history():
    """An error after the history was written in `commit` restores the state before the solve."""
    setup, reference = pair()
    problem = setup.problem
    before = copy_state(setup)
    problem.solve()
    update = setup.contact.history.packed

    def fail(values):
        update(values)  # already written when it fails
        raise Fault("put in on purpose")

    setup.contact.history.packed = fail
    assert_raised_on_all_ranks(problem.commit, Fault, "on purpose")
    setup.contact.history.packed = update
    assert are_identical(copy_state(setup), before)
    assert problem.increment == 2
    assert_solves_like_reference(setup, reference)


# ---- a full disk ---------------------------------------------------------------------------------


@contextmanager
def full_disk(size: int):
    """Limit the size of every file that this process writes, in bytes."""
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, old[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)


def files(folder: Path) -> dict[str, bytes]:
    COMM.barrier()
    contents = {name: (folder / name).read_bytes() for name in sorted(os.listdir(folder))}
    COMM.barrier()
    return contents


@pytest.mark.each
@pytest.mark.skipif(COMM.size > 1, reason="the limit would hit what MPI keeps in files, too")
@pytest.mark.parametrize("kind", ["checkpoint", "json", "series", "picture"])
@pytest.mark.parametrize("first", [True, False])
def test_full_disk_leaves_files_unchanged(kind, first, tmp_path):
    """A file that could not be written is absent or unchanged; the next one is complete."""
    setup = BlockOnBall()
    solve_path(setup, path=PATH[:2])
    points = setup.contact.gather()
    write = {
        "checkpoint": lambda: fc.checkpoint.save(setup.problem, tmp_path / "state.npz"),
        "json": lambda: output.write_json(tmp_path / "r.json", {"x": [1.5] * 1000}, COMM),
        "series": lambda: fc.Writer(tmp_path, setup.problem).write(1),
        "picture": lambda: plotting.plot_tractions(tmp_path / "p.png", points),
    }[kind]
    if kind == "picture":
        write()  # the font cache is written once
        os.remove(tmp_path / "p.png")
    if not first:
        write()
    before, state = files(tmp_path), copy_state(setup)
    for size in (0, 500):
        with full_disk(size), pytest.raises((OSError, RuntimeError)):
            write()
        assert files(tmp_path) == before
        assert are_identical(copy_state(setup), state)
    write()
    after = files(tmp_path)
    assert after and set(before) <= set(after)
    if kind == "json":
        assert json.loads(after["r.json"])["x"] == [1.5] * 1000


@pytest.mark.parametrize("kind", ["json", "series"])
def test_failed_writing_leaves_no_files(kind, tmp_path, monkeypatch):
    """All ranks raise if a file cannot be renamed to its final name, and no part of it is left."""
    folder = shared_folder(tmp_path)
    setup = BlockOnBall()
    write = {
        "json": lambda: output.write_json(folder / "r.json", {"x": 1}, COMM),
        "series": lambda: fc.Writer(folder, setup.problem).write(1),
    }[kind]
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", raise_after(os.replace, 0, OSError))
        assert_raised_on_all_ranks(write, (OSError, RuntimeError), "on purpose")
    assert files(folder) == {}
    write()
    assert files(folder)


def test_collective_errors_raise_on_all_ranks():
    """The failing rank raises its error; the others its text, and its type where possible."""

    def call(kind):
        with parallel.collective_errors(COMM):
            if COMM.rank == LAST:
                raise kind("put in on purpose")

    assert_raised_on_all_ranks(lambda: call(ValueError), ValueError, "on purpose")
    assert_raised_on_all_ranks(lambda: call(Fault), (Fault, RuntimeError), "on purpose")
    assert np.all(COMM.allgather(1) == np.ones(COMM.size))
