"""Files that are complete or not there, whenever and however writing them ends."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mpi4py import MPI

from fenics_contact.parallel import collective_errors

__all__ = ["replacing", "replacing_set"]


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A name to write to, which takes the place of ``path`` once the block has ended well.

    Else ``path`` is as before. On the calling rank only.
    """
    path = Path(path)
    # The ending stays: it may tell the format.
    temporary = path.with_name(f".{os.getpid()}.part.{path.name}")
    try:
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())  # a full disk may show only here
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def replacing_set(comm: MPI.Comm, path: Path, end: bytes) -> Iterator[Path]:
    """The same for a file and those that it names, written by all ranks together. Collective.

    Args:
        comm: The ranks.
        path: The file that names the others, which are beside it.
        end: How each of them ends: their writer does not tell whether the disk was full.

    Yields:
        The name to write to, in a folder of its own.

    Raises:
        OSError: A file is not complete, or cannot be put in place (on other ranks RuntimeError);
            where it could not be written at all, whatever the block raises.
    """
    folder = path.with_name(f".{comm.bcast(os.getpid())}.part.{path.stem}")
    try:
        with collective_errors(comm):
            if comm.rank == 0:
                folder.mkdir(parents=True, exist_ok=True)
        yield folder / path.name
        comm.barrier()
        with collective_errors(comm):
            if comm.rank == 0:
                written = sorted(folder.iterdir(), key=lambda file: file.name == path.name)
                for file in written:
                    _check_end(file, end)
                for file in written:  # the one that names the others comes last
                    os.replace(file, path.with_name(file.name))
    finally:
        if comm.rank == 0:
            shutil.rmtree(folder, ignore_errors=True)


def _check_end(path: Path, end: bytes) -> None:
    with open(path, "rb") as file:
        file.seek(max(0, path.stat().st_size - len(end) - 2))
        if not file.read().rstrip().endswith(end):
            raise OSError(f"{path.name} was not written completely: is the disk full?")
