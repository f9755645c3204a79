"""Files that are complete or not there, whenever and however writing them ends; folders."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["check_file", "make_folder", "replacing"]


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


def make_folder(path: Path) -> None:
    """Make a folder, and those above it, where they are not there. On the calling rank only.

    Raises:
        NotADirectoryError: Something else has its name, or that of one above it.
        OSError: It cannot be made.
    """
    there = next((p for p in (path, *path.parents) if p.exists()), None)
    if there is not None and not there.is_dir():
        raise NotADirectoryError(
            f"{path} must be a folder, but {there} is a file; give another name, or remove it"
        )
    path.mkdir(parents=True, exist_ok=True)


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
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
