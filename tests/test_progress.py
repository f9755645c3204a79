"""Progress bar of `increments`: its percentage, its output on a terminal, and when it is off."""

from __future__ import annotations

import io
import re
import sys

import pytest
from mpi4py import MPI

import fenics_contact as fc
from scenes.comparison import assert_raised_on_all_ranks
from scenes.valid_problem import coulomb_law, pressed_block

pytest.importorskip("tqdm")
pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]
COMM = MPI.COMM_WORLD


class Terminal(io.StringIO):
    """A stream that records the output to a terminal."""

    def isatty(self) -> bool:
        """Return True, as a terminal does."""
        return True

    def lines(self) -> list[str]:
        """Return the lines visible at the end, without trailing blanks."""
        seen = []
        for line in self.getvalue().split("\n"):
            shown = ""
            for part in line.split("\r"):  # each part overwrites the previous one
                shown = part + shown[len(part) :]
            seen.append(shown.rstrip())
        return seen

    def shares(self) -> list[int]:
        """Return all percentages that were shown, each once, in order."""
        return list(dict.fromkeys(map(int, re.findall(r"(\d+)%\|", self.getvalue()))))


def terminal_of(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """Replace `sys.stderr` of this rank, and return the replacement."""
    stream = Terminal()
    monkeypatch.setattr(sys, "stderr", stream)
    return stream


def history(ends: list[float], scene=None, **options) -> fc.Step:
    """Return the increments of a pressed block with its modulus as the load."""
    scene = scene or pressed_block()
    problem, _ = scene.problem(coulomb_law(), scene.rollers())
    start = float(scene.E.value)
    steps = [start * end for end in ends]
    return fc.increments(problem, scene.E, start, steps[-1], steps=steps, **options)


def test_bar_shows_the_fraction_of_the_load_path(monkeypatch):
    """Increments of length 1, 3 and 4 end at 12, 50 and 100 %; only the first rank has a bar."""
    terminal = terminal_of(monkeypatch)
    for step in history([1.1, 1.4, 1.8], progress="load"):
        assert step.load
    assert terminal.shares() == ([0, 12, 50, 100] if COMM.rank == 0 else [])
    last = terminal.lines()
    assert last == ([""] if COMM.rank else [last[0], ""])
    assert COMM.rank or re.match(r"load: 100%\|[█#]+\|, load 1800, 00:0\d<00:00$", last[0])


def test_no_bar_without_a_terminal_or_by_default(monkeypatch):
    """There is no output to a file with `progress=True`, nor to a terminal by default."""
    log = io.StringIO()
    monkeypatch.setattr(sys, "stderr", log)
    list(history([1.1, 1.4], progress=True))
    monkeypatch.setattr(sys, "stderr", Terminal())
    list(history([1.1, 1.4]))
    assert log.getvalue() == sys.stderr.getvalue() == ""


def test_invalid_progress_is_refused():
    """`progress` is neither a text nor a bool: the error states its value."""
    assert_raised_on_all_ranks(lambda: history([1.1], progress=3), ValueError, "progress is 3")


def test_missing_tqdm_is_reported(monkeypatch):
    """Without tqdm `progress=True` raises an error that names it on all ranks."""
    monkeypatch.setitem(sys.modules, "tqdm", None)
    assert_raised_on_all_ranks(lambda: history([1.1], progress=True), ValueError, "tqdm")
    list(history([1.1]))
