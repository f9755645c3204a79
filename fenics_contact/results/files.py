"""Atomic writing of files, and checks of files and folders."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["atomic_write", "check_file", "check_folder", "make_folder"]


def check_file(path: Path) -> None:
    """Raise ValueError for a device, a pipe or a socket. On the calling rank only."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise ValueError(
            f"{path} is a device, a pipe or a socket, which a file would replace; give the name of "
            "a file"
        )


def check_folder(name: str, path: Path) -> None:
    """Check that the folder of a file exists and is writable. On the calling rank only.

    Raises ValueError if it does not exist, OSError if it is not writable.
    """
    folder = path.parent
    if not folder.is_dir():
        raise ValueError(f"{name} is {path}, but there is no folder {folder}; create it")
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        text = f"{name} is {path}, but folder {folder} is not writable"
        raise OSError(f"{text}: {error.strerror}") from error


def make_folder(path: Path) -> None:
    """Create a folder and its parents, if necessary. On the calling rank only.

    Raises OSError if it cannot be created, or is not writable.
    """
    existing = next((p for p in (path, *path.parents) if p.exists()), None)
    if existing is not None and not existing.is_dir():
        raise NotADirectoryError(
            f"{path} must be a folder, but {existing} is a file; give another name, or remove it"
        )
    path.mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=path).close()


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Provide a temporary path, which replaces ``path`` if the block ends without an error.

    After an error ``path`` is unchanged. On the calling rank only. Raises FileNotFoundError without
    its folder, and ValueError if ``path`` is no regular file.
    """
    path = Path(path)
    check_file(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(
            f"{path} cannot be written, because there is no folder {path.parent}; create it"
        )
    # The suffix may determine the format.
    temporary = path.with_name(f".{os.getpid()}.part.{path.name}")
    try:
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())  # may be the first call to fail on a full disk
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
