"""Files that are complete or not there, whenever and however writing them ends; folders."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["atomic_write", "check_file", "check_folder", "make_folder"]


def check_file(path: Path) -> None:
    """Refuse what is there and is no file, such as /dev/null. On the calling rank only.

    A device may be read without end, a pipe waits for another program, and either would be gone
    where a file took its place. A folder has an error of its own where it is opened.

    Raises:
        ValueError: It is a device, a pipe or a socket.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise ValueError(
            f"{path} is a device, a pipe or a socket, which a file would replace; give the name of "
            "a file"
        )


def check_folder(name: str, path: Path) -> None:
    """Refuse a file whose folder is not there, or takes no files. On the calling rank only.

    Raises:
        ValueError: There is no such folder; it names the argument.
        OSError: Nothing can be written to it.
    """
    folder = path.parent
    if not folder.is_dir():
        raise ValueError(f"{name} is {path}, but there is no folder {folder}; create it")
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        words = f"{name} is {path}, but folder {folder} is not writable"
        raise OSError(f"{words}: {error.strerror}") from error


def make_folder(path: Path) -> None:
    """Make a folder for files, and those above it, if it is not there. On the calling rank only.

    Raises:
        NotADirectoryError: Something else has its name, or that of one above it.
        OSError: It cannot be made, or nothing can be written to it.
    """
    there = next((p for p in (path, *path.parents) if p.exists()), None)
    if there is not None and not there.is_dir():
        raise NotADirectoryError(
            f"{path} must be a folder, but {there} is a file; give another name, or remove it"
        )
    path.mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=path).close()


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A name to write to, which takes the place of ``path`` once the block has ended well.

    Else ``path`` is as before. On the calling rank only.

    Raises:
        FileNotFoundError: Its folder is not there.
        ValueError: ``path`` is a device, a pipe or a socket.
    """
    path = Path(path)
    check_file(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(
            f"{path} cannot be written, because there is no folder {path.parent}; create it"
        )
    # The ending stays: it may tell the format.
    temporary = path.with_name(f".{os.getpid()}.part.{path.name}")
    try:
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())  # a full disk may show only here
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
