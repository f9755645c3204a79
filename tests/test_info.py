"""Information on the installation, against independent sources."""

import itertools
import logging
import sys
from pathlib import Path

import dolfinx
import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from fenics_contact import __main__ as program
from fenics_contact import compiling
from fenics_contact.installation import information
from scenes.comparison import assert_raised_on_all_ranks

COMM = MPI.COMM_WORLD

pytestmark = [pytest.mark.two_ranks, pytest.mark.newest]


def area_form():
    """Return a form that compiles fast."""
    return fem.Constant(dolfinx.mesh.create_unit_square(COMM, 1, 1), 1.0) * ufl.dx


def test_versions_and_paths_of_the_installation():
    """Versions and types are those of the imported packages, and reported paths exist."""
    compiling.compile_form(area_form())
    installation = information()
    assert installation["fenics_contact"] == fc.__version__
    assert (
        installation["DOLFINx"] == dolfinx.__version__ and installation["numpy"] == np.__version__
    )
    assert installation["Python"] == ".".join(map(str, sys.version_info[:3]))
    assert installation["scalars"] == np.zeros(1, PETSc.ScalarType).dtype.name
    assert int(installation["indices"].removeprefix("int")) == 8 * PETSc.IntType().itemsize
    assert f"{COMM.size} rank(s)" in installation["MPI"]
    for name in ("ufl", "basix", "ffcx", "scipy", "mpi4py", "petsc4py", "PETSc"):
        assert installation[name][0].isdigit(), installation[name]
    folder = Path(installation["compiled forms"].split(" (")[0])
    assert folder.is_dir() and any(folder.glob("*.so"))
    for path in installation["BLAS"].split("; ")[0].split(", "):
        assert Path(path).exists()


def test_available_orderings_of_mumps():
    """AMD, AMF and QAMD, parts of MUMPS, are found; no unknown ordering is reported."""
    orderings = information()["direct solver"]
    words = orderings.split(";")[0].removeprefix("MUMPS, orderings ").split(", ")
    assert {"AMD", "AMF", "QAMD"} <= set(words) <= {"AMD", "AMF", "QAMD", "PORD", "SCOTCH", "METIS"}


def test_info_command_prints_on_the_first_rank(capsys):
    """The command prints one line per entry on the first rank; an unknown command is refused."""
    assert program.main(["info"]) == 0
    printed = capsys.readouterr().out
    lines = COMM.bcast(printed).splitlines()
    assert any(line.split() == ["DOLFINx", dolfinx.__version__] for line in lines)
    assert (printed == "") == (COMM.rank != 0)
    assert_raised_on_all_ranks(lambda: run_program(["formation"]), RuntimeError, "2")


def run_program(words):
    try:
        program.main(words)
    except SystemExit as error:
        raise RuntimeError(f"exit {error.code}") from None


def test_compilation_is_reported_once(monkeypatch, caplog, capsys):
    """The log or else the terminal reports slow compilation, but not forms from the cache."""
    form = area_form()
    first = COMM.rank == 0

    def count_messages(level, *, terminal, seconds):
        """Return how often the compilation of two forms is reported in log and terminal."""
        caplog.clear()
        times = itertools.count(0.0, seconds)
        monkeypatch.setattr(compiling.time, "perf_counter", lambda: next(times))
        monkeypatch.setattr(compiling, "compile_timer", compiling.CompileTimer())
        monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal, raising=False)
        with caplog.at_level(level, "fenics_contact"):
            for _ in range(2):
                compiling.compile_form(form)
        printed = capsys.readouterr().err
        return caplog.text.count("compiling forms"), printed.count("compiling forms")

    assert count_messages(logging.INFO, terminal=True, seconds=4.0) == (first, 0)
    assert count_messages(logging.WARNING, terminal=True, seconds=4.0) == (0, first)
    assert count_messages(logging.WARNING, terminal=False, seconds=4.0) == (0, 0)
    assert count_messages(logging.INFO, terminal=True, seconds=0.01) == (0, 0)
