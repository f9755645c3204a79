"""PETSc options: those of the command line, and defaults.

petsctools offers the same, but reads the command line only if it initialises PETSc itself, which
DOLFINx has done before.
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

# Options read in a factorisation, a set-up or at the end, perhaps not in the first solve.
_READ_LATE = re.compile("view|converged_reason|mat_|mg_|gamg|interior_")


def take_command_line(prefix: str, comm: MPI.Comm) -> None:
    """Put options of the command line into PETSc's database, with their values. Collective.

    PETSc itself reads them only if it is initialised with ``sys.argv``. Existing options are not
    overwritten.

    Args:
        prefix: Prefix of the option names; if empty, there are none.
        comm: The communicator; the command line is that of its first rank.
    """
    database = PETSc.Options()
    arguments = comm.bcast(getattr(sys, "argv", [])[1:])
    # The last one of equal names counts.
    for argument, following in reversed(list(pairwise([*arguments, None]))):
        name = argument.removeprefix("-").removeprefix("-")
        is_own = prefix and _is_option(argument) and name.startswith(prefix) and name != prefix
        if is_own and not database.hasName(name):
            has_value = following is not None and not _is_option(following)
            database.setValue(name, following if has_value else None)


def _is_option(argument: str) -> bool:
    """Return whether an argument is the name of an option, not a value, as PETSc decides."""
    if not re.match("--?[A-Za-z]", argument):
        return False
    try:
        float(argument)
    except ValueError:
        return True
    return False  # -inf


class Defaults:
    """Default options, in PETSc's database only while solvers read them.

    Solvers read options when they are created, inner ones (multigrid levels) when they are set up.
    Left in the database, the options would apply to other problems with the same prefix.
    """

    def __init__(self) -> None:
        self._values: dict[str, Any] = {}
        self._caller_keys: set[str] = set()
        self._unused: set[str] = set()  # subset of `_caller_keys`
        self._has_warned = False

    def set(self, options: Mapping[str, Any], prefix: str) -> None:
        """Add options, given without prefix, unless they are already in here or the database."""
        database = PETSc.Options()
        for name, value in options.items():
            key = prefix + name
            if key not in self._values and not database.hasName(key):
                self._values[key] = value

    def set_caller_options(self, options: Mapping[str, Any], prefix: str) -> None:
        """Add options of the caller, with a warning if they remain unused."""
        self.set(options, prefix)
        names = {prefix + name for name in options}
        self._caller_keys |= names
        self._unused |= names

    def warn_of_unused(self, prefix: str) -> None:
        """Warn once of options, of the caller or the database, that no solver has read."""
        if self._has_warned or not prefix:
            return
        self._has_warned = True
        unused = set(self._unused)
        for name in PETSc.Options().getAll():
            if name.startswith(prefix):
                unused.discard(name)
                if not compat.is_option_used(name):
                    unused.add(name)
        names = [f"-{name}" for name in sorted(unused) if not _READ_LATE.search(name, len(prefix))]
        if names:
            logger.warning(
                "unused options: %s; check their spelling, or whether their solver is in use",
                ", ".join(names),
            )

    def get(self, name: str) -> Any:
        """Return the value of an option, by its name with prefix; None if it is not set."""
        database = PETSc.Options()
        return database.getString(name) if database.hasName(name) else self._values.get(name)

    def set_from_options(self, solver: PETSc.SNES | PETSc.KSP) -> None:
        """Set a solver from the options with its prefix. Collective.

        Raises:
            ValueError: PETSc refuses an option; the text has all that were given.
        """
        self._read(solver, solver.setFromOptions)

    def set_up(self, snes: PETSc.SNES) -> None:
        """Set up a solver, which reads further options. Collective.

        Raises:
            ValueError: PETSc refuses an option.
        """
        self._read(snes, snes.setUp)

    def _read(self, solver: PETSc.SNES | PETSc.KSP, read: Callable[[], None]) -> None:
        with self.present():
            try:
                read()
            except PETSc.Error as error:
                prefix = solver.getOptionsPrefix() or ""
                items = PETSc.Options().getAll().items()
                shown = {k: v for k, v in items if k in self._caller_keys or k not in self._values}
                given = [f"-{k} {v}" for k, v in sorted(shown.items()) if k.startswith(prefix)]
                why = str(error).splitlines()[-1].split("] ", 1)[-1]
                raise ValueError(
                    f"PETSc refuses an option with prefix {prefix!r}: {why}; the options given are "
                    f"{', '.join(given) or 'none'}"
                ) from error

    @contextmanager
    def present(self) -> Iterator[None]:
        """Have the options in PETSc's database inside the block."""
        database = PETSc.Options()
        added = {k: v for k, v in self._values.items() if not database.hasName(k)}
        for key, value in added.items():
            database.setValue(key, value)
        try:
            yield
        finally:
            for key in added:
                if key in self._unused and compat.is_option_used(key):
                    self._unused.remove(key)
                database.delValue(key)
