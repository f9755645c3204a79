"""PETSc options: the command line's, and those that hold where nobody says anything.

petsctools has the like; it takes the command line only where it initialises PETSc itself, which
DOLFINx has done when a problem is made.
"""

from __future__ import annotations

import logging
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

from fenics_contact import compat

__all__ = ["Defaults", "take_command_line"]

logger = logging.getLogger("fenics_contact")

# Read when something is factored, set up or done; in the first solve that may not be.
_READ_LATE = re.compile("view|converged_reason|mat_|mg_|gamg|interior_")


def take_command_line(prefix: str, comm: MPI.Comm) -> None:
    """Put options of the command line into PETSc's database, with their values. Collective.

    PETSc looks there itself only if it is initialised with ``sys.argv``, which no script need do.
    What the database has already stays.

    Args:
        prefix: What their names begin with; without one there are none.
        comm: The ranks; the first one's command line is taken.
    """
    database = PETSc.Options()
    arguments = comm.bcast(getattr(sys, "argv", [])[1:])
    # Of equal names the last one counts, and is found first here.
    for argument, following in reversed(list(pairwise([*arguments, None]))):
        name = argument.removeprefix("-").removeprefix("-")
        mine = prefix and _is_option(argument) and name.startswith(prefix) and name != prefix
        if mine and not database.hasName(name):
            has_value = following is not None and not _is_option(following)
            database.setValue(name, following if has_value else None)


def _is_option(argument: str) -> bool:
    """Whether it is the name of an option and no value, told apart as PETSc does."""
    if not re.match("--?[A-Za-z]", argument):
        return False
    try:
        float(argument)
    except ValueError:
        return True
    return False  # -inf


class Defaults:
    """Options that are in PETSc's database only while they are read.

    Solvers read their options when they are made, those inside them (the levels of multigrid) when
    they are set up. Left there, the options would hold for other problems of the same prefix.
    """

    def __init__(self) -> None:
        self._values: dict[str, Any] = {}
        self._given: set[str] = set()  # by the caller
        self._unread: set[str] = set()  # of those
        self._told = False

    def set(self, options: Mapping[str, Any], prefix: str) -> None:
        """Add options, given without prefix, that nothing has set; those added before win."""
        database = PETSc.Options()
        for name, value in options.items():
            key = prefix + name
            if key not in self._values and not database.hasName(key):
                self._values[key] = value

    def give(self, options: Mapping[str, Any], prefix: str) -> None:
        """`set` what the caller says, who is told if nothing reads it."""
        self.set(options, prefix)
        names = {prefix + name for name in options}
        self._given |= names
        self._unread |= names

    def warn_of_unread(self, prefix: str) -> None:
        """Name, once, the options that the caller or the database has and no solver has read."""
        if self._told or not prefix:
            return
        self._told = True
        unread = set(self._unread)
        for name in PETSc.Options().getAll():
            if name.startswith(prefix):
                unread.discard(name)
                if not compat.option_was_read(name):
                    unread.add(name)
        names = [f"-{name}" for name in sorted(unread) if not _READ_LATE.search(name, len(prefix))]
        if names:
            logger.warning(
                "unused options: %s; check their spelling, or whether their solver is in use",
                ", ".join(names),
            )

    def get(self, name: str) -> Any:
        """The value that holds for a name with prefix; None if there is none."""
        database = PETSc.Options()
        return database.getString(name) if database.hasName(name) else self._values.get(name)

    def let_read(self, solver: PETSc.SNES | PETSc.KSP) -> None:
        """Let a solver take the options of its prefix. Collective.

        Raises:
            ValueError: PETSc refuses one of them; the text has all that were given.
        """
        self._read(solver, solver.setFromOptions)

    def set_up(self, snes: PETSc.SNES) -> None:
        """Set up a solver that has read its options; some are looked at only then. Collective.

        Raises:
            ValueError: As in `let_read`.
        """
        self._read(snes, snes.setUp)

    def _read(self, solver: PETSc.SNES | PETSc.KSP, read: Callable[[], None]) -> None:
        with self.present():
            try:
                read()
            except PETSc.Error as error:
                prefix = solver.getOptionsPrefix() or ""
                here = PETSc.Options().getAll().items()
                mine = {k: v for k, v in here if k in self._given or k not in self._values}
                told = [f"-{k} {v}" for k, v in sorted(mine.items()) if k.startswith(prefix)]
                why = str(error).splitlines()[-1].split("] ", 1)[-1]
                raise ValueError(
                    f"PETSc refuses an option with prefix {prefix!r}: {why}; the options given are "
                    f"{', '.join(told) or 'none'}"
                ) from error

    @contextmanager
    def present(self) -> Iterator[None]:
        """Have the options in the database inside the block."""
        database = PETSc.Options()
        added = {k: v for k, v in self._values.items() if not database.hasName(k)}
        for key, value in added.items():
            database.setValue(key, value)
        try:
            yield
        finally:
            for key in added:
                if key in self._unread and compat.option_was_read(key):
                    self._unread.remove(key)
                database.delValue(key)
