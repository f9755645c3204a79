"""Faults put in on purpose: all ranks end with the error, and nothing is lost or half done.

After every fault the state is that of the last commit, to the bit; and the same problem then makes
the increment with the result of one that never failed (1e-8: two solutions within the solver's
tolerance of 1e-9).
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
from scenes.comparing import close, identical, nodal, raised_everywhere, shared_folder
from scenes.elasticity import stress
from scenes.processes import command, environment
from scenes.rubbing import PATH, Rub, snapshot, walk

COMM = MPI.COMM_WORLD
LAST = COMM.size - 1
METHODS = ("lbfgs", "newton", "continuation", "alternating")[: 4 if COMM.size == 1 else 2]

# Long enough for a loaded machine; what hangs is ended.
pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]


class Fault(Exception):
    """What nothing in the package raises."""


def failing(function, after, error=Fault, *, rank=None):
    """The function, that raises at a call later than ``after``, on all ranks or on one."""
    calls = [0]

    def call(*args, **kwargs):
        calls[0] += 1
        if calls[0] > after and rank in (None, COMM.rank):
            raise error("put in on purpose")
        return function(*args, **kwargs)

    return call


def survives(made, call, kind, *words):
    """The call raises on all ranks, leaves no trace, and what comes after is as without it."""
    before, increment = snapshot(made), made.problem.increment
    raised_everywhere(call, kind, *words)
    assert identical(snapshot(made), before)
    assert made.problem.increment == increment
    assert made.contact.inputs.stiffness_factor.value == 1.0


def told(error):
    """What comes of an error on the first rank alone."""
    return error if COMM.rank == 0 else (error, RuntimeError)


def goes_on(made, twin):
    """The increment is made after all."""
    for m in (made, twin):
        walk(m, path=PATH[2:3])
    assert close(nodal(made.scene.u), nodal(twin.scene.u), 1e-8)


def pair(method="lbfgs", **kwargs):
    """Two that have made two increments and are loaded for the third."""
    both = [Rub(method=method, **kwargs) for _ in range(2)]
    for made in both:
        walk(made, path=PATH[:2])
        made.move(*PATH[2])
    return both


# ---- in a solve ----------------------------------------------------------------------------------


@pytest.mark.each
@pytest.mark.parametrize("condensation", [None, False])
@pytest.mark.parametrize("method", METHODS)
def test_an_exception_in_a_callback(method, condensation, monkeypatch):
    """It comes out as it is, from the residual, and from the matrix where SNES asks for one."""
    made, twin = pair(method, condensation=condensation)
    equations = made.problem.solver.equations
    names = {"newton": "assemble_tangent", "continuation": "assemble_tangent"}
    for name in filter(None, ("residual", names.get(method))):
        for after in (1, 3) if name == "residual" else (0,):
            with monkeypatch.context() as patch:
                patch.setattr(equations, name, failing(getattr(equations, name), after))
                survives(made, made.problem.solve, Fault, "on purpose")
    goes_on(made, twin)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_one_rank_raises(method, monkeypatch):
    """In the assembly on its own cells or facets, as if its memory were at an end.

    The other ranks get the text.
    """
    made, twin = pair(method)
    for after in (0, 4):
        with monkeypatch.context() as patch:
            broken = failing(fem.assemble_vector, after, MemoryError, rank=LAST)
            patch.setattr(surface.fem, "assemble_vector", broken)
            survives(made, made.problem.solve, (MemoryError, RuntimeError), "on purpose")
    goes_on(made, twin)


@pytest.mark.parametrize("method", ["lbfgs", "newton"])
def test_snes_is_stopped(method, monkeypatch):
    """By a limit that somebody set, in whichever iteration; and by an interrupt from outside."""
    made, twin = pair(method)
    limit = made.problem.solver.main.max_it
    for allowed in (0, 1):
        made.problem.solver.main.max_it = allowed
        survives(made, made.problem.solve, fc.NotConverged, "iteration limit reached")
    made.problem.solver.main.max_it = limit
    equations = made.problem.solver.equations
    monkeypatch.setattr(
        equations, "is_converged", failing(equations.is_converged, 1, KeyboardInterrupt)
    )
    before = snapshot(made)
    with pytest.raises(KeyboardInterrupt):
        made.problem.solve()
    assert identical(snapshot(made), before)
    monkeypatch.undo()
    goes_on(made, twin)


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
def test_an_exception_in_a_dense_solve(kind, name, method, error, monkeypatch):
    """It comes out as it is from the matrix and the solver that PETSc calls, at whichever call.

    The dense matrix is on the first rank; the others get the text.
    """
    made, twin = pair(method)
    for after in (0, 1, 2, 5):
        with monkeypatch.context() as patch:
            broken = failing(getattr(kind, name), after, error)
            patch.setattr(kind, name, broken)
            before = snapshot(made)
            try:
                made.problem.solve()
            except told(error):
                assert identical(snapshot(made), before)
            else:  # there were fewer calls
                made.problem.restore()
    goes_on(made, twin)


@contextmanager
def interrupted_at(event: int):
    """Ctrl-C at a call or return of any function, Python's or C's, counted; it yields the count."""
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
    """By Ctrl-C, as at its start: gmsh has the process ended instead, from its first use on."""
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
    """Ctrl-C while PETSc runs or calls back: KeyboardInterrupt and no trace of the increment.

    By the count of calls, not by the clock: a solution may be over within a tick of a timer.
    """
    made, twin = pair(method, condensation=condensation)
    made.problem.solve()  # compiles
    made.problem.restore()
    with interrupted_at(0) as events:
        made.problem.solve()
    solved = snapshot(made)[0]
    made.problem.restore()
    before, handler = snapshot(made), signal.getsignal(signal.SIGINT)
    for share in np.linspace(0.01, 0.99, 50):
        with pytest.raises(KeyboardInterrupt), interrupted_at(int(share * events[0])):
            made.problem.solve()
        if close(snapshot(made)[0], solved, 1e-8):  # all was done
            made.problem.restore()
        assert identical(snapshot(made), before)
        assert signal.getsignal(signal.SIGINT) is handler
    goes_on(made, twin)


@pytest.mark.parametrize("name", ["product", "_solve"])
def test_an_exception_in_a_linearised_solve(name, monkeypatch):
    """In the products and solutions of the error estimate: it comes out, and none comes after."""
    made, twin = pair("newton")
    made.problem.solve()
    kind = dense.SumOperator if name == "product" else dense.UpdatedLU
    with monkeypatch.context() as patch:
        patch.setattr(kind, name, failing(getattr(kind, name), 0))
        with pytest.raises(told(Fault), match="on purpose"):
            fc.estimate_errors(made.problem, stress(made.scene.u, made.scene.E, made.scene.nu))
    made.problem.restore()
    goes_on(made, twin)


@pytest.mark.parametrize(
    ("method", "condensation", "prefix"),
    [
        ("lbfgs", False, "contact_"),
        ("newton", False, "contact_tangent_"),
        ("lbfgs", True, "contact_interior_"),
    ],
)
def test_memory_refused(method, condensation, prefix):
    """MUMPS may take 1 MB, which is not enough for this mesh: MemoryError, not a wrong answer."""
    made = Rub(mesh={"n": 64}, method=method, condensation=condensation)
    made.move(*PATH[0])
    options, key = PETSc.Options(), f"{prefix}mat_mumps_icntl_23"
    options[key] = 1
    try:
        survives(made, made.problem.solve, MemoryError, "out of memory")
    finally:
        del options[key]
    assert made.problem.solve().verdict.failures == []


ALONE = """
from scenes.rubbing import PATH, Rub
from fenics_contact import parallel
parallel.ABORT_TIMEOUT = 0.2
made = Rub()
made.move(*PATH[0])
name, rank = "{name}", made.problem.u.function_space.mesh.comm.rank
equations = made.problem.solver.equations
kept = getattr(equations, name)
setattr(equations, name, lambda *args: kept(*args) if rank == 0 else 1 / 0)
made.problem.solve()
"""


@pytest.mark.skipif(COMM.size > 1, reason="starts ranks of its own")
@pytest.mark.parametrize("name", ["residual_at", "is_converged"])
def test_one_rank_fails_alone(name):
    """Where nothing tells the other ranks, which wait: all are ended, with the error shown."""
    words = command(2, "-c", ALONE.format(name=name))
    done = subprocess.run(words, env=environment(), capture_output=True, timeout=60)
    said = done.stderr.decode(errors="replace")
    assert done.returncode != 0
    assert "rank 1 failed while the others were waiting" in said and "ZeroDivisionError" in said


def test_a_load_fails_on_one_rank():
    """The user's own function raises on one rank: all end, the load is that of before."""
    made = Rub()

    def load(t):
        if t == 2.0 and COMM.rank == LAST:
            raise ValueError("no such load")
        made.move(0.0, 0.01 * t)

    done = []

    def run():
        done.extend(s.load for s in fc.increments(made.problem, load, 0.0, 2.0, steps=2))

    raised_everywhere(run, ValueError, "no such load")
    assert done == [1.0] and made.problem.increment == 1
    assert made.push[-1].value == -0.01


# ---- in a commit ---------------------------------------------------------------------------------


def test_a_commit_fails():
    """The second contact's evaluation fails: the first one's history is as before, too."""
    made, twin = pair()
    problem = made.problem
    before = snapshot(made)
    problem.solve()
    update = made.contact.history.packed

    def broken(values):
        update(values)  # already written when it fails
        raise Fault("put in on purpose")

    made.contact.history.packed = broken
    raised_everywhere(problem.commit, Fault, "on purpose")
    made.contact.history.packed = update
    assert identical(snapshot(made), before)
    assert problem.increment == 2
    goes_on(made, twin)


# ---- a full disk ---------------------------------------------------------------------------------


@contextmanager
def full_disk(size: int):
    """No file of this process can grow beyond so many bytes, whoever writes it."""
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, old[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)


def files(folder: Path) -> dict[str, bytes]:
    COMM.barrier()
    found = {name: (folder / name).read_bytes() for name in sorted(os.listdir(folder))}
    COMM.barrier()
    return found


@pytest.mark.each
@pytest.mark.skipif(COMM.size > 1, reason="the limit would hit what MPI keeps in files, too")
@pytest.mark.parametrize("kind", ["checkpoint", "json", "series", "picture"])
@pytest.mark.parametrize("first", [True, False])
def test_a_full_disk(kind, first, tmp_path):
    """A file that could not be written is not there, or as it was; the next one is whole."""
    made = Rub()
    walk(made, path=PATH[:2])
    points = made.contact.gather()
    write = {
        "checkpoint": lambda: fc.checkpoint.save(made.problem, tmp_path / "state.npz"),
        "json": lambda: output.write_json(tmp_path / "r.json", {"x": [1.5] * 1000}, COMM),
        "series": lambda: fc.Writer(tmp_path, made.problem).write(1),
        "picture": lambda: plotting.plot_tractions(tmp_path / "p.png", points),
    }[kind]
    if kind == "picture":
        write()  # the fonts' cache is written once
        os.remove(tmp_path / "p.png")
    if not first:
        write()
    before, state = files(tmp_path), snapshot(made)
    for size in (0, 500):
        with full_disk(size), pytest.raises((OSError, RuntimeError)):
            write()
        assert files(tmp_path) == before
        assert identical(snapshot(made), state)
    write()
    after = files(tmp_path)
    assert after and set(before) <= set(after)
    if kind == "json":
        assert json.loads(after["r.json"])["x"] == [1.5] * 1000


@pytest.mark.parametrize("kind", ["json", "series"])
def test_writing_fails_on_one_rank(kind, tmp_path, monkeypatch):
    """All ranks end, and no half of it is there."""
    folder = shared_folder(tmp_path)
    made = Rub()
    write = {
        "json": lambda: output.write_json(folder / "r.json", {"x": 1}, COMM),
        "series": lambda: fc.Writer(folder, made.problem).write(1),
    }[kind]
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", failing(os.replace, 0, OSError))
        raised_everywhere(write, (OSError, RuntimeError), "on purpose")
    assert files(folder) == {}
    write()
    assert files(folder)


def test_errors_are_shared():
    """The rank that raises keeps its error; the others get its text, and its type if it can be."""

    def call(kind):
        with parallel.collective_errors(COMM):
            if COMM.rank == LAST:
                raise kind("put in on purpose")

    raised_everywhere(lambda: call(ValueError), ValueError, "on purpose")
    raised_everywhere(lambda: call(Fault), (Fault, RuntimeError), "on purpose")
    assert np.all(COMM.allgather(1) == np.ones(COMM.size))
