"""The bar of a history: what it counts, where it is silent, and what it leaves of a terminal."""

from __future__ import annotations

import io
import logging
import re
import sys

import pytest
from mpi4py import MPI

import fenics_contact as fc
from scenes.comparing import raised_everywhere, shared_folder
from scenes.sound import coulomb, pressed

pytest.importorskip("tqdm")
pytestmark = [pytest.mark.mpi, pytest.mark.timeout(120)]
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


def test_what_is_said_stands_on_lines_of_its_own(monkeypatch):
    """Prints of the script, and lines of the log while an increment is solved."""
    terminal = terminal_of(monkeypatch)
    monkeypatch.setattr(sys, "stdout", terminal)
    log, screen = logging.getLogger("fenics_contact"), logging.StreamHandler(terminal)
    level = log.level
    log.addHandler(screen)
    log.setLevel(logging.INFO)
    try:
        for number, _ in enumerate(history([1.1, 1.4], progress=True)):
            print(f"step {number}")
            log.warning("between %d", number)
    finally:
        log.removeHandler(screen)
        log.setLevel(level)
    said = [line for line in terminal.lines() if "100%" not in line]
    steps = [line for line in said if line.startswith(("step", "between"))]
    assert steps == ["step 0", "between 0", "step 1", "between 1"]
    assert not any("|" in line for line in said)
    assert log.filters == []


@pytest.mark.parametrize("way", ["break", "error"])
def test_a_loop_that_is_left(monkeypatch, way):
    """The bar is gone, so that what is written next begins a line."""
    terminal = terminal_of(monkeypatch)
    made = history([1.1, 1.4], progress=True)
    try:
        for _ in made:
            if way == "break":
                break
            raise RuntimeError
    except RuntimeError:
        pass
    made.close()
    assert terminal.lines()[-1] == ""
    assert not any("|" in line for line in terminal.lines())


def test_an_increment_that_fails(monkeypatch):
    """The bar stays where it was, and what is written next begins a line."""
    terminal = terminal_of(monkeypatch)
    scene = pressed()
    made = history([1.1, 1.4], scene, progress=True, max_cuts=0)
    next(made)
    scene.load(up=float("nan"))
    raised_everywhere(lambda: next(made), ValueError, "finite")
    assert terminal.lines()[-1] == ""
    assert COMM.rank or "25%" in terminal.lines()[0]


def test_a_history_that_goes_on(monkeypatch, tmp_path):
    """From a checkpoint at half of the way: it starts there."""
    terminal = terminal_of(monkeypatch)
    kept = {"checkpoint": shared_folder(tmp_path) / "state.npz", "progress": True}
    made = history([1.1, 1.2], **kept)
    next(made)
    made.close()
    terminal.truncate(0)
    list(history([1.1, 1.2], **kept))
    assert terminal.shares() == ([50, 100] if COMM.rank == 0 else [])


def test_bad_words():
    """Neither words nor a switch; and no tqdm."""
    raised_everywhere(lambda: history([1.1], progress=3), ValueError, "progress is 3")


def test_without_tqdm(monkeypatch):
    """It is said what is missing, on all ranks."""
    monkeypatch.setitem(sys.modules, "tqdm", None)
    raised_everywhere(lambda: history([1.1], progress=True), ValueError, "tqdm")
    list(history([1.1]))
