"""The bar of a history: what it counts, where it is silent, and what it leaves of a terminal."""

from __future__ import annotations

import io
import re
import sys

import pytest
from mpi4py import MPI

import fenics_contact as fc
from scenes.comparing import raised_everywhere
from scenes.sound import coulomb, pressed

pytest.importorskip("tqdm")
pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]
COMM = MPI.COMM_WORLD


class Terminal(io.StringIO):
    """What a program writes on a terminal."""

    def isatty(self) -> bool:
        """It is one."""
        return True

    def lines(self) -> list[str]:
        """What is seen of it at the end, without blanks behind."""
        seen = []
        for line in self.getvalue().split("\n"):
            shown = ""
            for part in line.split("\r"):  # each is written over what is there
                shown = part + shown[len(part) :]
            seen.append(shown.rstrip())
        return seen

    def shares(self) -> list[int]:
        """All percentages ever shown, each once, in their order."""
        return list(dict.fromkeys(map(int, re.findall(r"(\d+)%\|", self.getvalue()))))


def terminal_of(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """In place of what this rank writes errors and bars to, from now on."""
    made = Terminal()
    monkeypatch.setattr(sys, "stderr", made)
    return made


def history(ends: list[float], scene=None, **options) -> fc.Step:
    """Lead the modulus of a pressed block, which any of its loads would do for."""
    scene = scene or pressed()
    problem, _ = scene.problem(coulomb(), scene.rollers())
    start = float(scene.E.value)
    steps = [start * end for end in ends]
    return fc.increments(problem, scene.E, start, steps[-1], steps=steps, **options)


def test_it_counts_the_way_of_the_load(monkeypatch):
    """Not increments: of ways of 1, 3 and 4 an eighth, a half and all is done. First rank only."""
    terminal = terminal_of(monkeypatch)
    for step in history([1.1, 1.4, 1.8], progress="load"):
        assert step.load
    assert terminal.shares() == ([0, 12, 50, 100] if COMM.rank == 0 else [])
    last = terminal.lines()
    assert last == ([""] if COMM.rank else [last[0], ""])
    assert COMM.rank or re.match(r"load: 100%\|[█#]+\|, load 1800, 00:0\d<00:00$", last[0])


def test_it_is_silent_without_a_terminal(monkeypatch):
    """In a file, as a log of a queue is, and where nothing was asked for."""
    log = io.StringIO()
    monkeypatch.setattr(sys, "stderr", log)
    list(history([1.1, 1.4], progress=True))
    monkeypatch.setattr(sys, "stderr", Terminal())
    list(history([1.1, 1.4]))
    assert log.getvalue() == sys.stderr.getvalue() == ""


def test_bad_words():
    """Neither words nor a switch; and no tqdm."""
    raised_everywhere(lambda: history([1.1], progress=3), ValueError, "progress is 3")


def test_without_tqdm(monkeypatch):
    """It is said what is missing, on all ranks."""
    monkeypatch.setitem(sys.modules, "tqdm", None)
    raised_everywhere(lambda: history([1.1], progress=True), ValueError, "tqdm")
    list(history([1.1]))
