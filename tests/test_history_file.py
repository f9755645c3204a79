"""The table of a history has one complete row per increment, none lost or duplicated.

Reference: the steps that `increments` yields; numbers are written with all digits.
"""

import csv
import os

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.results import files
from scenes.block_on_ball import BlockOnBall
from scenes.blocks import TOP, block
from scenes.comparison import assert_raised_on_all_ranks, is_close, shared_folder
from scenes.elasticity import strain, stress
from scenes.histories import BlockOnBallHistory
from scenes.rubber import DiscOnRubber

COMM = MPI.COMM_WORLD

pytestmark = [pytest.mark.three_ranks, pytest.mark.timeout(120)]


def read_rows(path):
    """Return the rows as dictionaries of text by column."""
    COMM.barrier()
    with open(path, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    COMM.barrier()
    return rows


def column_numbers(rows, column):
    return [float(row[column]) for row in rows]


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_every_row_contains_the_results_of_its_step(cell, tmp_path):
    """Each row equals its step, and is written before the step is yielded, in two calls."""
    path = shared_folder(tmp_path) / "history.csv"
    setup = BlockOnBallHistory(cell=cell, wall=True)
    steps, moments = [], []
    for start, end in ((0.0, 2.0), (2.0, 3.0)):
        for step in setup.increments(end, start, csv=path):
            steps.append(step)
            contacts = setup.problem.contacts
            moments.append({c.name: c.moment([0.0] * setup.scene.dim) for c in contacts})
            assert len(read_rows(path)) == len(steps)
    rows = read_rows(path)
    per = "" if setup.scene.dim == 3 else " per thickness"
    assert [int(row["increment"]) for row in rows] == [step.increment for step in steps]
    assert column_numbers(rows, "load") == [step.load for step in steps]
    for name in ("floor", "wall"):
        for i, axis in enumerate("xyz"[: setup.scene.dim]):
            forces = [step.contacts[name].force[i] for step in steps]
            assert column_numbers(rows, f"{name}: force {axis} (force{per})") == forces
        for i, axis in enumerate("xyz" if setup.scene.dim == 3 else "z"):
            column = column_numbers(
                rows, f"{name}: moment {axis} about the origin (force length{per})"
            )
            assert is_close(column, [moment[name][i] for moment in moments], 1e-12)
        for column, attribute in (
            (f"normal force (force{per})", "normal_force"),
            (f"friction as the sum of sizes (force{per})", "tangential_force"),
            (f"area in contact (area{per})", "area"),
            ("largest pressure (stress)", "max_pressure"),
            ("largest penetration (length)", "max_penetration"),
            ("open (points)", "open"),
            ("stick (points)", "stick"),
            ("slip (points)", "slip"),
        ):
            expected = [getattr(step.contacts[name], attribute) for step in steps]
            assert column_numbers(rows, f"{name}: {column}") == expected
        for state in ("contact", "stick", "slip"):
            extents = [step.contacts[name].extents[state] for step in steps]
            assert column_numbers(rows, f"{name}: area in {state} (area{per})") == [
                e.area for e in extents
            ]
            for i, axis in enumerate("xyz"[: setup.scene.dim]):
                for word, ends in (
                    ("from", [e.low for e in extents]),
                    ("to", [e.high for e in extents]),
                ):
                    computed = [row[f"{name}: {state} {word} {axis} (length)"] for row in rows]
                    texts = ["" if np.isnan(end[i]) else str(end[i]) for end in ends]
                    assert computed == texts
    for name in ("work", "elastic", "springs", "dissipation", "remainder"):
        expected = [getattr(step.energy, name) for step in steps]
        assert column_numbers(rows, f"{name} (force length{per})") == expected
    assert [row["method"] for row in rows] == [step.method for step in steps]
    assert column_numbers(rows, "iterations") == [step.iterations for step in steps]
    assert column_numbers(rows, "cuts") == [0.0] * len(steps)


def test_restart_replaces_the_rows_after_the_checkpoint(tmp_path):
    """A restart replaces the rows after the checkpoint and does not change those before it."""
    folder = shared_folder(tmp_path)
    uninterrupted, setup, resumed = BlockOnBallHistory(), BlockOnBallHistory(), BlockOnBallHistory()
    list(uninterrupted.increments(3.0, csv=folder / "whole.csv"))
    files = {"checkpoint": folder / "state.npz", "csv": folder / "parts.csv"}
    for step in setup.increments(3.0, checkpoint_every=2, **files):
        if step.increment == 5:
            break
    before = read_rows(folder / "parts.csv")
    assert [row["increment"] for row in before] == ["1", "2", "3", "4", "5"]
    if COMM.rank == 0:  # as if the run had been killed while it wrote a row
        with open(folder / "parts.csv", "a", encoding="utf-8") as file:
            file.write("6,3.0,12.")
    COMM.barrier()
    for step in resumed.increments(3.0, **files):
        if step.increment == 5:
            assert read_rows(folder / "parts.csv")[:4] == before[:4]
    rows, expected = read_rows(folder / "parts.csv"), read_rows(folder / "whole.csv")
    assert [row["increment"] for row in rows] == [row["increment"] for row in expected]
    for column in (
        "load",
        "floor: normal force (force per thickness)",
        "floor: force x (force per thickness)",
    ):
        assert is_close(
            column_numbers(rows, column), column_numbers(expected, column), uninterrupted.tolerance
        )
    # A completed history computes nothing and does not change the table.
    done = BlockOnBallHistory()
    assert list(done.increments(3.0, **files)) == []
    assert read_rows(folder / "parts.csv") == rows
    # A new history, without a checkpoint, replaces the table.
    next(iter(BlockOnBallHistory().increments(3.0, csv=files["csv"])))
    assert [row["increment"] for row in read_rows(folder / "parts.csv")] == ["1"]


def test_cuts_errors_and_failures(tmp_path, monkeypatch):
    """Rows contain the errors of `estimate` and the number of cuts, and remain after a failure."""
    folder = shared_folder(tmp_path)
    setup = BlockOnBallHistory()
    solve, calls = setup.problem.solve, []

    def raise_error(**options):
        calls.append(options)
        if len(calls) == 2:  # the second increment, before it is cut
            setup.problem.small_displacement_tolerance = 1e-12
        try:
            return solve(**options)
        finally:
            setup.problem.small_displacement_tolerance = 0.2

    with monkeypatch.context() as patch:
        patch.setattr(setup.problem, "solve", raise_error)
        list(setup.increments(1.5, steps=2, max_cuts=3, csv=folder / "cut.csv"))
    cuts = column_numbers(read_rows(folder / "cut.csv"), "cuts")
    assert cuts == [0.0, 1.0, 0.0]

    setup = BlockOnBallHistory()
    steps = list(setup.increments(1.0, steps=2, estimate=True, csv=folder / "errors.csv"))
    rows = read_rows(folder / "errors.csv")
    for name, unit in (("normal force", "force"), ("peak pressure", "stress")):
        errors = [row[f"error of {name} by the increments ({unit})"] for row in rows]
        expected = [s.increment_error and s.increment_error[name] for s in steps]
        assert errors == ["" if e is None else str(float(e)) for e in expected]
        assert errors[0] == "" != errors[1]

    setup = BlockOnBallHistory()
    path = folder / "failed.csv"
    history = setup.increments(1.5, steps=2, max_cuts=0, csv=path)
    next(history)
    setup.problem.small_displacement_tolerance = 1e-12
    with pytest.raises(fc.NotConverged):
        next(history)
    assert [row["increment"] for row in read_rows(path)] == ["1"]


def test_wrong_input(tmp_path):
    """Wrong input raises on all ranks before the first increment; existing files are unchanged."""
    folder = shared_folder(tmp_path)
    setup = BlockOnBall()
    if COMM.rank == 0:
        (folder / "letter.txt").write_text("Dear reader")
    COMM.barrier()

    def call(history, problem=setup, **options):
        return lambda: next(
            iter(fc.increments(problem.problem, problem.load, csv=history, **options))
        )

    assert_raised_on_all_ranks(call(3), ValueError, "csv", "name of a file")
    assert_raised_on_all_ranks(call(folder / "no" / "h.csv"), ValueError, "no folder", "create it")
    assert_raised_on_all_ranks(call(folder / "letter.txt"), ValueError, "letter.txt", "overwritten")
    assert_raised_on_all_ranks(call(folder), OSError, str(folder.name))
    assert sorted(os.listdir(folder)) == ["letter.txt"] and setup.problem.increment == 0
    assert (folder / "letter.txt").read_text() == "Dear reader"

    path = folder / "h.csv"
    call(path, steps=2)()
    other = BlockOnBall(contact={"name": "other"})
    call(folder / "other.csv", other, steps=2)()
    before = path.read_bytes()
    resume = lambda: next(  # noqa: E731
        iter(fc.increments(other.problem, other.load, 0.5, 1.0, csv=path))
    )
    assert_raised_on_all_ranks(resume, ValueError, "columns differ")
    assert path.read_bytes() == before
    COMM.barrier()
    if COMM.rank == 0:
        path.write_bytes(before + before.splitlines(keepends=True)[1][:20] + b"\n")
    COMM.barrier()
    resume = lambda: next(  # noqa: E731
        iter(fc.increments(setup.problem, setup.load, 0.5, 1.0, csv=path))
    )
    assert_raised_on_all_ranks(resume, ValueError, "damaged in line 3")


def test_paths_that_are_not_regular_files_are_refused(tmp_path):
    """A pipe is refused as table and checkpoint, and is not replaced.

    It represents all such paths: once /dev/zero was read endlessly as a table, a file replaced
    /dev/null as root, and a checkpoint waited for data from a pipe.
    """
    folder = shared_folder(tmp_path)
    pipe = folder / "pipe"
    setup = BlockOnBall()
    if COMM.rank == 0:
        os.mkfifo(pipe)
    COMM.barrier()

    def call(**options):
        return lambda: next(iter(fc.increments(setup.problem, setup.load, **options)))

    for options in ({"csv": pipe}, {"checkpoint": pipe}):
        assert_raised_on_all_ranks(call(**options), ValueError, "pipe", "give the name of a file")
    with pytest.raises(ValueError, match="would replace"), files.atomic_write(pipe) as path:
        path.write_bytes(b"")
    assert pipe.is_fifo() and os.listdir(folder) == ["pipe"]
    assert setup.problem.increment == 0


def test_failed_write_leaves_table_and_state_unchanged(tmp_path, monkeypatch):
    """A failed write raises on all ranks, leaves no partial row, and keeps the committed state."""
    path = shared_folder(tmp_path) / "h.csv"
    setup = BlockOnBall()
    history = fc.increments(setup.problem, setup.load, steps=3, csv=path)
    next(history)
    before = path.read_bytes()
    COMM.barrier()

    def fail_to_write(*_):
        raise OSError("no space left")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fail_to_write)
        assert_raised_on_all_ranks(lambda: next(history), OSError, "no space left")
    assert path.read_bytes() == before
    COMM.barrier()
    assert setup.problem.increment == 2


def test_moments_and_point_counts_with_finite_kinematics(tmp_path):
    """Moments use the deformed positions of Γc, and the numbers of points include all ranks."""
    path = shared_folder(tmp_path) / "h.csv"
    setup = DiscOnRubber(law=fc.Frictionless(1e4))
    (step,) = setup.increments(1.0, steps=1, csv=path)
    (row,) = read_rows(path)
    moment = float(row["contact: moment z about the origin (force length per thickness)"])
    assert is_close([moment], setup.contact.moment((0.0, 0.0)), 1e-12)
    points = sum(int(row[f"contact: {s} (points)"]) for s in ("open", "stick", "slip"))
    assert points == COMM.allreduce(len(setup.contact.points))
    # Reference: sum of lever arm times force; the origin is the middle of the block's bottom.
    x = setup.contact.points + setup.contact.pairs.own_displacement()
    force = setup.contact.measure[:, None] * setup.contact.traction
    lever = COMM.allreduce(np.sum(x[:, 0] * force[:, 1] - x[:, 1] * force[:, 0]))
    size = abs(step.contacts["contact"].normal_force)
    assert abs(moment - lever) <= 1e-9 * size


def test_units_with_a_thickness(tmp_path):
    """Forces and areas are per unit thickness without a weight, and of the body with one.

    Reference: with the thickness 2.5 as weight all integrals are 2.5 times as large (1e-8 for two
    solutions of the same equations), and only the columns of integrals have another name.
    """
    folder, thickness = shared_folder(tmp_path), 2.5
    computed = []
    for weight in (None, thickness):
        scene = block("quadrilateral", up=-3.0)
        v = ufl.TestFunction(scene.u.function_space)
        t = fem.Constant(scene.mesh, weight or 1.0)
        F = t * ufl.inner(stress(scene.u, scene.E, scene.nu), strain(v)) * ufl.dx(scene.mesh)
        F += t * 3.0 * v[1] * ufl.ds(scene.mesh, subdomain_data=scene.tags)(TOP)
        contact = scene.contact(fc.Frictionless(1e4), weight=weight and t)
        problem = fc.ContactProblem(F, scene.u, bcs=scene.rollers(), contacts=[contact])
        path = folder / f"{weight}.csv"
        (step,) = fc.increments(problem, lambda load: None, 0, 1, csv=path)
        computed.append((step, read_rows(path)[0]))
        note = "forces and areas per unit thickness"
        assert (note in step.summary()) == (weight is None)
        assert (note in step._repr_html_().lower().replace("are ", "")) == (weight is None)
        assert step.contacts["contact"].per_thickness == (weight is None)
    (plain, row), (thick, total_row) = computed
    one, all_of_it = plain.contacts["contact"], thick.contacts["contact"]
    assert is_close(
        [all_of_it.area, *all_of_it.force], thickness * np.r_[one.area, one.force], 1e-8
    )
    assert len(row) == len(total_row)
    for before, after in zip(row, total_row, strict=True):
        assert before.replace(" per thickness)", ")") == after
        integral = any(f"({unit}" in before for unit in ("force)", "force ", "area"))
        assert (before == after) == (not integral), before
    area = "contact: area in contact (area)"
    assert is_close(
        float(total_row[area]), thickness * float(row[area[:-1] + " per thickness)"]), 1e-8
    )
