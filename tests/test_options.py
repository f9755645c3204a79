"""Tests of command-line options, which reach PETSc without code in the script."""

from __future__ import annotations

import subprocess
import sys

import pytest
from mpi4py import MPI
from petsc4py import PETSc

from scenes.block_on_ball import BlockOnBall, solve_path
from scenes.comparison import assert_raised_on_all_ranks
from scenes.processes import command, subprocess_environment

COMM = MPI.COMM_WORLD
pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]

SCRIPT = """
from scenes.block_on_ball import PATH, BlockOnBall
setup = BlockOnBall({arguments})
setup.set_top_displacement(*PATH[0])
setup.problem.solve()
if setup.problem.u.function_space.mesh.comm.rank == 0:
    print("at most", setup.problem.solver.main.max_it)
"""


@pytest.fixture
def command_line(monkeypatch):
    """Set the command line, and remove its options from the database after the test."""
    before = PETSc.Options().getAll()

    def say(*arguments: str) -> None:
        monkeypatch.setattr(sys, "argv", ["script.py", *arguments])

    yield say
    for name in set(PETSc.Options().getAll()) - set(before):
        PETSc.Options().delValue(name)


@pytest.mark.skipif(COMM.size > 1, reason="starts ranks of its own")
@pytest.mark.parametrize("ranks", [1, 2])
@pytest.mark.parametrize("arguments", ["", "condensation=False"])
def test_script_takes_options_of_the_command_line(ranks: int, arguments: str) -> None:
    """Monitors print, whichever method solves the first increment, and values take effect."""
    words = command(ranks, "-c", SCRIPT.format(arguments=arguments), "mesh.msh", "-n", "3")
    words += ["-contact_snes_monitor", "-contact_snes_max_it", "737"]
    done = subprocess.run(words, env=subprocess_environment(), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "SNES Function norm" in done.stdout
    assert "at most 737" in done.stdout
    assert "unused options" not in done.stderr


def test_values_of_options_are_parsed(command_line) -> None:
    """The value of an option may be negative or have several words; the last of two applies."""
    command_line(
        *("-x", "--tb", "short", "-mine_snes_max_it", "7", "--mine_snes_max_it", "8", "mesh.msh"),
        *("-mine_number", "-1e-3", "-mine_snes_monitor", "-mine_own", "two words", "-mine_"),
    )
    setup = BlockOnBall(prefix="mine_")
    options = PETSc.Options()
    taken = {n: options.getString(n) for n in options.getAll() if n.startswith("mine_")}
    assert taken == {
        "mine_snes_max_it": "8",
        "mine_number": "-1e-3",
        "mine_snes_monitor": "",
        "mine_own": "two words",
    }
    assert not {"x", "tb"} & set(options.getAll())
    assert setup.problem.snes.getTolerances()[3] == 8


def test_precedence_of_options(command_line) -> None:
    """The command line overrides ``petsc_options``, and the script's own options override both.

    Only options with the problem's own prefix are taken, and none without a prefix.
    """
    command_line("-mine_snes_max_it", "7", "-mine_snes_type", "qn", "-snes_max_it", "9")
    PETSc.Options().setValue("mine_snes_type", "newtonls")
    setup = BlockOnBall(prefix="mine_", petsc_options={"snes_max_it": 8, "snes_type": "ngmres"})
    assert setup.problem.snes.getTolerances()[3] == 7
    assert setup.problem.snes.getType() == "newtonls"
    usual = BlockOnBall(prefix="").problem.snes.getTolerances()[3]
    assert usual == BlockOnBall().problem.snes.getTolerances()[3] != 9


@pytest.mark.whole
@pytest.mark.parametrize("message", ["command line", "petsc_options"])
@pytest.mark.parametrize(
    ("name", "value", "why"),
    [
        ("snes_max_it", "many", "Input string many"),
        ("snes_rtol", "-3", "must be non-negative"),
        ("tangent_ksp_type", "gmresss", "KSP type gmresss"),
        ("continuation_snes_max_it", "-5", "must be non-negative"),
        ("snes_qn_m", "-1", "must be a non-negative integer"),  # checked when it is set up
    ],
)
def test_values_refused_by_petsc_are_named(command_line, message, name, value, why) -> None:
    """The error names the option and PETSc's message, wherever the option was given."""
    options = {"petsc_options": {name: value}} if message == "petsc_options" else {}
    if not options:
        command_line(f"-contact_{name}", value)
    words = "PETSc refuses an option with prefix", why, f"-contact_{name} {value}"
    method = "lbfgs" if "_qn_" in name else "newton"
    assert_raised_on_all_ranks(lambda: BlockOnBall(method=method, **options), ValueError, *words)


def test_command_line_of_first_rank_is_used_on_all_ranks(command_line) -> None:
    """If the ranks have different command lines, that of the first rank is used."""
    command_line("-mine_snes_max_it", str(7 + COMM.rank))
    setup = BlockOnBall(prefix="mine_")
    assert set(COMM.allgather(setup.problem.snes.getTolerances()[3])) == {7}


GOOD = {
    "snes_monitor_cancel": None,
    "snes_converged_reason": "ascii:/dev/null",
    "snes_view": "ascii:/dev/null",
    "snes_linesearch_order": 2,
    "snes_linesearch_damping": 1.0,
    "snes_max_it": 500,
    "ksp_error_if_not_converged": False,
    "continuation_snes_max_it": 20,
    "alternating_snes_max_it": 150,
    "interior_mat_mumps_icntl_14": 300,
    "tangent_mat_mumps_icntl_14": 50,
}


@pytest.mark.each
@pytest.mark.parametrize("method", [None, "newton", "continuation"])
@pytest.mark.parametrize("condensation", [None, False])
def test_unused_options_are_named(command_line, method, condensation, caplog) -> None:
    """Misspelt options are named once, wherever they were given, and no others are named."""
    line = ["-mine_snes_monitr", "-mine_ksp_typ", "cg", "-yours_snes_type", "qn"]
    for name, value in GOOD.items():
        line += [f"-mine_{name}", *([] if value is None else [str(value).lower()])]
    command_line(*line)
    database = {"snes_maxit": 3, "snes_force_iteration": False}
    setup = BlockOnBall(
        prefix="mine_", method=method, condensation=condensation, petsc_options=database
    )
    with caplog.at_level("WARNING", logger="fenics_contact"):
        solve_path(setup)
    message = [r.message for r in caplog.records if "unused options" in r.message]
    assert len(message) == (COMM.rank == 0)
    if message:
        (message,) = message
        assert "-mine_ksp_typ, -mine_snes_maxit, -mine_snes_monitr;" in message
