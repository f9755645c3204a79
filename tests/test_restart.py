"""Going on from a file: the digits of the run that went on, or a refusal that names the reason.

A history is solved whole, and again broken off and taken up by a problem made anew. Serially the
two are compared bit for bit; on several ranks MUMPS adds in the order in which messages come, and
two solutions within the tolerance of 1e-9 on the residual are compared: 1e-7, or what a preset
solves to.
"""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
import warnings
from pathlib import Path

import basix.ufl
import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI
from running import environment

import fenics_contact as fc
from fenics_contact import checkpoint, compat
from scenes.comparing import (
    close,
    gathered,
    owned,
    raised_everywhere,
    shared_folder,
)
from scenes.elasticity import strain
from scenes.histories import Press, Ramp, differences, goes_on

COMM = MPI.COMM_WORLD

pytestmark = pytest.mark.mpi


# ---- the same digits -----------------------------------------------------------------------------


@pytest.mark.parametrize("condensation", [None, False])
@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_pairs_found_anew(cell, condensation, tmp_path):
    """Up a ramp: the pairs, and the unknowns kept when condensed, are those of the slid block."""
    make = lambda: Ramp(  # noqa: E731
        cell=cell, condensation=condensation, n=(10, 4) if cell == "quadrilateral" else (6, 2)
    )
    goes_on(make, shared_folder(tmp_path), stop=5)


LAWS = {
    "coulomb": lambda: fc.Coulomb(0.3),
    "polygon": lambda: fc.Coulomb(0.3, k_n=2e4, k_t=1e4, modes=6),
    "tresca": lambda: fc.Tresca(0.3, 20.0),
    "frictionless": lambda: fc.Frictionless(),
    "foundation": lambda: fc.Foundation(k_n=2e4, k_t=1e4, tension=False),
    "springs": lambda: fc.Coulomb(0.3, fc.Springs(2e3), fc.Springs(1e3)),
}
HOW = {
    "penalty": {},
    "augmented": {"enforcement": "augmented"},
    "draft": {"accuracy": "draft"},
    "standard": {"accuracy": "standard"},
}


def products() -> list[tuple]:
    """A sample, the same every time, in which each choice occurs."""
    choices = itertools.product(
        ["fixed", "moving", "force", "ramp"],
        LAWS,
        HOW,
        [None, "lbfgs", "newton"],
        ["plain", "estimate", "last", "every 3", "wall", "nonlinear"],
    )
    sensible = [
        (support, law, how, method, extra)
        for support, law, how, method, extra in choices
        if not (law in ("foundation", "springs") and how != "penalty")
        and not (law == "springs" and support == "ramp")
        and not (law == "polygon" and support != "fixed")
        and not (support in ("ramp", "force") and extra in ("wall", "nonlinear"))
    ]
    picked = np.random.default_rng(3).choice(len(sensible), 26, replace=False)
    chosen = [sensible[i] for i in sorted(picked)]
    return chosen if COMM.size == 1 else chosen[::4]


@pytest.mark.parametrize(("support", "law", "how", "method", "extra"), products())
def test_products(support, law, how, method, extra, tmp_path):
    """Supports, laws, enforcement, methods and ways to lead a history, in combination."""
    options = {}
    if extra == "estimate":
        options["estimate"] = True
    elif extra == "last":
        options |= {"field": "last", "checkpoint_every": 2}
    elif extra == "every 3":
        options |= {"checkpoint_every": 3}

    def make():
        contact = dict(HOW[how])
        if support == "ramp":
            return Ramp(LAWS[law](), contact=contact, method=method)
        return Press(
            LAWS[law](),
            cell="hexahedron" if law == "polygon" else "triangle",
            n=2 if law == "polygon" else 4,
            support=support,
            surface={"quadrature_scheme": "vertex"} if law == "springs" else None,
            contact=contact,
            wall=extra == "wall",
            bulk="nonlinear" if extra == "nonlinear" else "linear",
            method=method,
        )

    # A preset solves to a hundredth of its error, the multipliers to a share of the tractions.
    tolerance = {"draft": 5e-3, "standard": 1e-3, "augmented": 1e-4}.get(how, 1e-6)
    goes_on(make, shared_folder(tmp_path), stop=5, tolerance=tolerance, **options)


@pytest.mark.parametrize("make", [Press, Ramp])
def test_cut_increments(make, tmp_path):
    """Where increments were cut, and how they grow again, is part of the place in the history.

    Increments above 0.3 fail: each of 0.5 is halved, and grows again after two.
    """

    def tamper(made):
        problem, load, now, at = made.problem, made.load, [0.0], []
        solve, commit = problem.solve, problem.commit

        def note(t):
            now[0] = t
            at[:] = at or [t]  # the first is where the history stands
            load(t)

        def choosy(**options):
            if now[0] - at[0] > 0.3:
                balance = {"the body": fc.Balance(1.0, 1.0, 0.0)}
                verdict = fc.Verdict(balance, balance)
                raise fc.NotConverged(problem.increment + 1, -1, verdict)
            return solve(**options)

        def keep():
            commit()
            at[0] = now[0]

        made.load, problem.solve, problem.commit = note, choosy, keep

    goes_on(make, shared_folder(tmp_path), stop=5, tamper=tamper)


def test_errors_are_estimated_of_a_state_taken_up(tmp_path):
    """The budget of a finished history is that of the run that solved it (1e-6, as solved)."""
    path, budgets = shared_folder(tmp_path) / "state.npz", []
    for condensation in (True, True, False) if COMM.size == 1 else (False, False):
        made = Press(condensation=condensation)
        list(made.increments(checkpoint=path))
        scene = made.scene
        sigma = ufl.variable(strain(scene.u))  # not that of the form: of both the same
        budget = fc.estimate_errors(made.problem, 1000.0 * sigma, strain=strain(scene.u))
        budgets.append(budget.relative("enforcement"))
    for budget in budgets[1:]:
        for name, value in budgets[0].items():
            assert close(budget[name], value, 1e-6, scale=1.0)


SCRIPT = """
import json
from scenes.histories import Press, Ramp, picture
made = {scene}
for step in made.increments(checkpoint={path!r}):
    if step.increment == {stop}:
        break
found = picture(made)
names = [n for n in found if n.split()[-1] in ("u", "history", "jump", "forces", "counts")]
if made.problem.u.function_space.mesh.comm.rank == 0:
    print(json.dumps({{n: found[n].tolist() for n in names}}))
"""


def run_script(ranks: int, **values) -> dict[str, np.ndarray]:
    """Run a history in a process of its own, and see where it ends."""
    script = SCRIPT.format(**values)
    launch = ["mpirun", "--oversubscribe", "-n", str(ranks)] if ranks > 1 else []
    done = subprocess.run(
        [*launch, sys.executable, "-c", script],
        env=environment(),
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return {n: np.array(v) for n, v in json.loads(done.stdout.splitlines()[-1]).items()}


@pytest.mark.skipif(COMM.size > 1, reason="starts its own processes")
@pytest.mark.parametrize(
    ("scene", "ranks"),
    [
        ("Ramp(n=(6, 2))", (1, 2)),
        pytest.param("Ramp(n=(6, 2))", (2, 3), marks=pytest.mark.slow),
        ("Press(support='force', contact={'enforcement': 'augmented'})", (2, 1)),
        ("Press(cell='tetrahedron', n=2, wall=True, support='moving')", (2, 1)),
    ],
)
def test_on_another_number_of_ranks(scene, ranks, tmp_path):
    """The state found by place: to the tolerance of the solver, or of the multipliers."""
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
            assert close(after[name], alone[name], 1e-4 if "augmented" in scene else 1e-6), name


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
    "support": (
        {"support": "moving"},
        ["prescribed by a Dirichlet condition", "shift of floor"],
    ),
}


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
    step = next(told.increments(checkpoint=saved, changed="continue"))
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
    "motion": ({"support": "force"}, ["free motion of floor"]),
}


@pytest.mark.parametrize("other", FIXED)
def test_what_cannot_be_taken_over_is_refused_in_any_case(other, saved):
    """Other meshes, elements, points and histories have no place for the state."""
    options, words = FIXED[other]
    options = {n: v() if callable(v) else v for n, v in options.items()}
    for changed in ("refuse", "continue"):
        made = Press(**({"wall": True} | options))
        call = lambda made=made, changed=changed: next(  # noqa: E731
            made.increments(checkpoint=saved, changed=changed)
        )
        raised_everywhere(call, ValueError, *words)
        assert made.problem.increment == 0


def test_nodes_elsewhere_are_another_mesh(saved):
    """As many of them, and some a millionth of the body off."""
    made = Press(wall=True)
    x = made.scene.mesh.geometry.x
    x[np.all(np.abs(x[:, :2] - 0.5) < 1e-9, axis=1), 0] += 1e-6
    call = lambda: next(made.increments(checkpoint=saved, changed="continue"))  # noqa: E731
    raised_everywhere(call, ValueError, "nodes", "places")


def test_data_that_the_load_changes_are_no_change(tmp_path):
    """A friction coefficient and a support as loads: compared where the history stands."""
    path = shared_folder(tmp_path) / "state.npz"

    class Both(Press):
        def load(self, t):
            super().load(t)
            self.problem.contacts[0].parameters["friction"].value = 0.1 + 0.1 * t

    made, after = Both(support="moving"), Both(support="moving")
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
        made.problem.solve(field=False)
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


def there_and_back(made, path, *, stop=0):
    """Down and along, back to the start, and there again; ended after ``stop`` increments."""
    loads = []
    for start, end, steps in ((0.0, 2.0, 4), (2.0, 1.0, 2), (1.0, 2.0, 2)):
        for step in made.increments(end, start, steps=steps, checkpoint=path):
            loads.append(step.load)
            if len(loads) == stop:
                return loads
    return loads


@pytest.mark.parametrize("stop", [1, 4, 5, 7])
@pytest.mark.parametrize("make", [Press, Ramp])
def test_several_calls_go_on_in_the_right_place(make, stop, tmp_path):
    """Loading, unloading, loading with one file, ended in any of them, also at their ends."""
    folder = shared_folder(tmp_path)
    whole, broken, after = make(), make(), make()
    loads = there_and_back(whole, folder / "whole.npz")
    there_and_back(broken, folder / "part.npz", stop=stop)
    assert there_and_back(after, folder / "part.npz") == loads[stop:]
    assert differences(after, whole, 0.0 if COMM.size == 1 else 1e-7) == []


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


def test_the_order_of_calls_counts(tmp_path):
    """The second call first, or a first one that leads elsewhere though the second is the same."""
    path = shared_folder(tmp_path) / "state.npz"
    there_and_back(Press(), path, stop=5)
    made = Press()
    call = lambda: next(made.increments(1.0, 2.0, steps=2, checkpoint=path))  # noqa: E731
    raised_everywhere(call, ValueError, "from 2 to 1 by 2", "from 0 to 2 by 4")
    call = lambda: next(made.increments(2.5, 0.0, steps=5, checkpoint=path), None)  # noqa: E731
    raised_everywhere(call, ValueError, "from 0 to 2.5 by 5", "from 0 to 2 by 4")


def test_a_longer_way_and_other_steps_ahead(tmp_path):
    """A finished history led further, and one whose rest is led otherwise: as led so at once."""
    folder = shared_folder(tmp_path)
    first, further, whole = Press(), Press(), Press()
    list(first.increments(2.0, checkpoint=folder / "state.npz"))
    rest = [s.load for s in further.increments(4.0, checkpoint=folder / "state.npz")]
    assert rest == [2.5, 3.0, 3.5, 4.0]
    list(whole.increments(4.0, checkpoint=folder / "whole.npz"))
    assert differences(further, whole, 0.0 if COMM.size == 1 else 1e-7) == []
    other = Press()
    steps = [0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.1]
    rest = [s.load for s in other.increments(4.1, steps=steps, checkpoint=folder / "state.npz")]
    assert rest == [4.1]


def test_a_loop_that_was_left_goes_on(tmp_path):
    """The same call on the same problem, after a failure with other steps, is no new one."""
    path = shared_folder(tmp_path) / "state.npz"
    made, whole = Press(), Press()
    for step in made.increments(2.0, checkpoint=path):
        if step.increment == 2:
            break
    rest = made.increments(2.0, steps=[0.5, 1.0, 1.25, 1.5, 2.0], checkpoint=path)
    assert [s.load for s in rest] == [1.25, 1.5, 2.0]
    list(whole.increments(2.0, steps=[0.5, 1.0, 1.25, 1.5, 2.0]))
    assert differences(made, whole, 1e-7) == []


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
        checkpoint._write(path, {"format": 99}, {})
    raised_everywhere(call, ValueError, "format 99")
    if COMM.rank == 0:
        checkpoint._write(path, {"anything": 1}, {"nodes": np.ones(3)})
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


@pytest.mark.parametrize("how", ["nan", "complex", "single", "words", "scalar", "short", "none"])
@pytest.mark.parametrize("what", ["nodes", "contact floor", "stiffness", "state", "numbers"])
def test_arrays_that_are_none_of_a_state(what, how, saved):
    """A file that is whole, with numbers that are none or of another kind."""
    if COMM.rank == 0:
        scene, arrays = checkpoint._read(saved)
        change = spoilt(how)
        if change is None:
            del arrays[what]
        else:
            arrays[what] = np.asarray(change(arrays[what]))
        checkpoint._write(saved, scene, arrays)
    COMM.barrier()
    made = Press(wall=True)
    call = lambda: next(made.increments(checkpoint=saved))  # noqa: E731
    raised_everywhere(call, ValueError, str(saved))
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


# ---- fields of the caller ------------------------------------------------------------------------


def more_fields(made: Press) -> list[fem.Function]:
    """Functions of all kinds that can be saved."""
    mesh, submesh = made.scene.mesh, made.problem.contacts[0].surface.submesh
    cell = mesh.basix_cell()
    d = mesh.geometry.dim
    spaces = {
        "strain": (mesh, basix.ufl.quadrature_element(cell, value_shape=(d, d), degree=2)),
        "hardening": (mesh, basix.ufl.quadrature_element(cell, degree=2)),
        "stress": (
            mesh,
            basix.ufl.element("DG", mesh.basix_cell(), 1, shape=(d, d), symmetry=True),
        ),
        "temperature": (mesh, basix.ufl.element("Lagrange", cell, 2)),
        "velocity": (mesh, basix.ufl.element("Lagrange", cell, 3, shape=(d,))),
        "wear": (submesh, basix.ufl.element("DG", submesh.basix_cell(), 0)),
    }
    return [fem.Function(fem.functionspace(m, e), name=n) for n, (m, e) in spaces.items()]


def wave(x: np.ndarray, k: float) -> np.ndarray:
    """Something that is nowhere the same, (n,)."""
    return np.sin(3.0 * k + x @ np.array([2.3, 5.1, 3.7]))


def fill(fields: list[fem.Function], k: float) -> None:
    """Values that follow from the place, the component, the cell beside and ``k``."""
    for i, field in enumerate(fields):
        places = checkpoint._node_places(field.function_space)
        d = places.shape[1] // 2
        x = np.zeros((len(places), 3))
        x[:, :d] = places[:, :d] + 0.1 * places[:, d:]
        values = checkpoint._rows(field)
        for j in range(values.shape[1]):
            values[:, j] = wave(x, k + i + 0.3 * j)
        field.x.scatter_forward()


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_fields_of_every_kind(cell, tmp_path):
    """Saved as the loop leaves them and set when the history goes on, ghosts included."""
    path = shared_folder(tmp_path) / "state.npz"
    made, after = Press(cell=cell, n=2), Press(cell=cell, n=2)
    fields = more_fields(made)
    for step in made.increments(checkpoint=path, fields=fields):
        fill(fields, step.increment)
        if step.increment == 3:
            break
    fields, expected = more_fields(after), more_fields(after)
    # The third was left in the middle of the loop: the file has the second.
    fill(expected, 2)
    steps = after.increments(checkpoint=path, fields=fields)
    assert next(steps).increment == 3
    for field, reference in zip(fields, expected, strict=True):
        found, wanted = field.x.array, reference.x.array
        assert close(gathered(COMM, found), gathered(COMM, wanted), 1e-12), field.name
    other = Press(cell=cell, n=2)
    fields = more_fields(other)
    for wrong in (fields[:-1], [], fields[::-1], [*fields, other.plastic]):
        call = lambda wrong=wrong: next(  # noqa: E731
            other.increments(checkpoint=path, fields=wrong, changed="continue")
        )
        raised_everywhere(call, ValueError, str(path))


@pytest.mark.parametrize("bulk", ["linear with plastic", "nonlinear"])
def test_plastic_strains_go_on(bulk, tmp_path):
    """A strain that the loop lets grow with the compression: same digits with it in the file."""
    folder = shared_folder(tmp_path)

    def run(made, path, stop=0):
        grown = fem.Expression(
            made.plastic + 0.1 * ufl.tr(strain(made.scene.u)),
            compat.interpolation_points(made.plastic.function_space.element),
        )
        for step in made.increments(2.0, checkpoint=path, fields=[made.plastic]):
            held = fem.Function(made.plastic.function_space)
            held.interpolate(grown)
            made.plastic.x.array[:] = held.x.array
            if step.increment == stop:
                break

    whole, broken, after = (Press(bulk=bulk, n=4) for _ in range(3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*taken as small")
        run(whole, folder / "whole.npz")
        run(broken, folder / "part.npz", stop=3)
        run(after, folder / "part.npz")
    assert np.abs(gathered(COMM, owned(whole.plastic))).max() > 1e-4
    tolerance = 0.0 if COMM.size == 1 else 1e-7
    assert differences(after, whole, tolerance) == []
    assert close(gathered(COMM, owned(after.plastic)), gathered(COMM, owned(whole.plastic)), 1e-7)


def test_fields_that_are_forgotten(tmp_path):
    """Changed by the loop and not in the file: a warning, once; going on is refused."""
    path = shared_folder(tmp_path) / "state.npz"
    made = Press(bulk="nonlinear")
    with pytest.warns(UserWarning, match="plastic in the bulk form") as warned:
        for step in made.increments(checkpoint=path):
            made.plastic.x.array[:] = -1e-3 * step.increment
            if step.increment == 4:
                break
    assert len([w for w in warned if "plastic" in str(w.message)]) == 1
    after = Press(bulk="nonlinear")
    raised_everywhere(lambda: next(after.increments(checkpoint=path)), ValueError, "bulk")


def test_fields_that_cannot_be_saved(tmp_path):
    """Refused at the call, by name."""
    path = shared_folder(tmp_path) / "state.npz"
    made = Press()
    mesh = made.scene.mesh
    edges = fem.Function(fem.functionspace(mesh, ("RTCE", 1)), name="edges")
    mixed = basix.ufl.mixed_element(
        [basix.ufl.element("Lagrange", mesh.basix_cell(), k) for k in (1, 2)]
    )
    mixed = fem.Function(fem.functionspace(mesh, mixed), name="mixed")
    for field, word in (
        (edges, "edges"),
        (mixed, "mixed"),
        (mixed.sub(0), "fields[0]"),
        (made.scene.u, "displacement"),
        (made.scene.E, "Constant"),
    ):
        call = lambda field=field: made.increments(checkpoint=path, fields=[field])  # noqa: E731
        raised_everywhere(call, ValueError, word)
    raised_everywhere(lambda: made.increments(fields=[made.plastic]), ValueError, "checkpoint")


# ---- calls that are no use -----------------------------------------------------------------------


def test_increments_that_are_never_asked_for():
    """A warning says that nothing was solved; none where something was, or nothing was to be."""
    made = Press()
    with pytest.warns(RuntimeWarning, match="iterate over"):
        made.increments()
    assert made.problem.increment == 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*taken as small")
        next(made.increments(1.0))
    assert made.problem.increment == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"steps": 0}, ["steps is 0"]),
        ({"steps": 2.5}, ["steps is 2.5"]),
        ({"end": "1"}, ["end is '1'"]),
        ({"end": float("nan")}, ["end is nan"]),
        ({"start": None}, ["start is None"]),
        ({"start": 1.0, "end": 1.0}, ["start", "end"]),
        ({"field": "never"}, ["field", "never"]),
        ({"max_cuts": -1}, ["max_cuts is -1"]),
        ({"checkpoint_every": 0}, ["checkpoint_every is 0"]),
        ({"changed": "yes"}, ["changed", "refuse", "continue"]),
        ({"checkpoint": 3}, ["checkpoint is 3"]),
        ({"fields": 3, "checkpoint": "x.npz"}, ["fields"]),
        ({"load": 3}, ["load is a int"]),
    ],
)
def test_arguments_are_checked_at_the_call(arguments, words):
    """Not when the first increment is asked for."""
    made = Press()
    arguments = {"load": made.load, "start": 0.0, "end": 1.0} | arguments
    call = lambda: fc.increments(made.problem, **arguments)  # noqa: E731
    raised_everywhere(call, ValueError, *words)
