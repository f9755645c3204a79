"""PETSc options that hold where the caller and the command line say nothing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from petsc4py import PETSc

__all__ = ["Defaults"]


class Defaults:
    """Options that are in PETSc's database only while they are read.

    Solvers read their options when they are made, those inside them (the levels of multigrid) when
    they are set up. Left there, the options would hold for other problems of the same prefix.
    """

    def __init__(self) -> None:
        """None yet."""
        self._values: dict[str, Any] = {}

    def set(self, options: Mapping[str, Any], prefix: str) -> None:
        """Add options, given without prefix, that nothing has set; those added before win."""
        database = PETSc.Options()
        for name, value in options.items():
            key = prefix + name
            if key not in self._values and not database.hasName(key):
                self._values[key] = value

    def get(self, name: str) -> Any:
        """The value that holds for a name with prefix; None if there is none."""
        database = PETSc.Options()
        return database.getString(name) if database.hasName(name) else self._values.get(name)

    def make_snes(self, comm: Any, prefix: str, options: Mapping[str, Any]) -> PETSc.SNES:
        """A solver with a prefix and these options where nothing has set them. Collective."""
        snes = PETSc.SNES().create(comm)
        snes.setOptionsPrefix(prefix)
        self.set(options, prefix)
        with self.present():
            snes.setFromOptions()
        return snes

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
                database.delValue(key)
