"""The file of a checkpoint: an archive of NumPy arrays, its digest, and what is refused of it."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fenics_contact.results import files
from fenics_contact.types import Array

__all__ = ["FORMAT", "StoredCheckpoint", "check_finite", "read_file", "refuse", "write_file"]

FORMAT = 9
# The file's end: these words, and the digest of all before them.
_MARK = b"\nfenics_contact checkpoint, sha256 "
_REMEDY = "remove it to start again"


@dataclass(frozen=True)
class StoredCheckpoint:
    """The content of a checkpoint file, on every rank.

    Attributes:
        path: The file.
        scene: The fingerprint of the problem in words, and other data that are no arrays.
        arrays: Arrays by name.
    """

    path: Path
    scene: dict[str, Any]
    arrays: dict[str, Array]

    @property
    def numbers(self) -> list[float]:
        """The caller's numbers."""
        return [float(value) for value in self.arrays["numbers"]]

    @property
    def notes(self) -> Any:
        """The caller's notes."""
        return self.scene["notes"]


def write_file(path: Path, scene: dict[str, Any], arrays: dict[str, Array]) -> None:
    """Write the archive, read it back, and put it in place.

    Raises:
        OSError: It cannot be written, or is not what was written. The file before it stays.
    """
    content = _pack(scene, arrays)
    with files.atomic_write(path) as temporary:
        with open(temporary, "wb") as file:
            file.write(content)
        # Whether it can be gone on from is better known now than when it is needed.
        if temporary.read_bytes() != content:
            raise OSError(f"{path} differs from what was written: check the disk")


def _pack(scene: dict[str, Any], arrays: dict[str, Array]) -> bytes:
    """The archive, and how it ends."""
    words = np.frombuffer(json.dumps(scene).encode(), dtype=np.uint8)
    archive = io.BytesIO()
    np.savez(archive, allow_pickle=False, scene=words, **arrays)
    content = archive.getvalue()
    return content + _MARK + hashlib.sha256(content).hexdigest().encode()


def read_file(path: Path) -> tuple[dict[str, Any], dict[str, Array]]:
    """Scene and arrays of a file.

    Raises:
        ValueError: It is damaged, or none of this format, or no file at all.
        OSError: It cannot be read.
    """
    files.check_file(path)
    content = path.read_bytes()
    end = len(content) - len(_MARK) - 64
    if end < 0 or content[end : end + len(_MARK)] != _MARK:
        raise ValueError(
            f"{path} is no checkpoint of this version, or truncated: its end is missing; replace "
            f"it by a copy, or {_REMEDY}"
        )
    if hashlib.sha256(content[:end]).hexdigest().encode() != content[-64:]:
        raise ValueError(
            f"{path} is damaged: its checksum is wrong; replace it by a copy, or {_REMEDY}"
        )
    try:
        with np.load(io.BytesIO(content[:end]), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        scene = json.loads(arrays.pop("scene").tobytes())
        found = scene["format"]
    except Exception as error:  # whatever the archive's reader makes of it
        raise ValueError(f"{path} is no checkpoint ({error}); {_REMEDY}") from error
    if found != FORMAT:
        raise ValueError(
            f"{path} is a checkpoint of format {found!r}, but this version reads {FORMAT}; use "
            f"the version that wrote it, or {_REMEDY}"
        )
    missing = sorted({"notes", "contacts", "fixed", "data"} - set(scene))
    missing += ["numbers"] * ("numbers" not in arrays)
    if missing:
        raise ValueError(f"{path} is no checkpoint, it lacks {', '.join(missing)}; {_REMEDY}")
    for name, array in arrays.items():
        if array.dtype != np.float64 or array.ndim not in (1, 2):
            raise ValueError(
                f"{path}: {name!r} is of type {array.dtype}, with {array.ndim} axes; it must be of "
                f"float64, with 1 or 2 axes; {_REMEDY}"
            )
        check_finite(name, array, f"{path}, {_REMEDY}")
    return scene, arrays


def check_finite(name: str, array: Array, where: str) -> None:
    """Refuse values that are not finite: of a state all, of results and the caller's some.

    Raises:
        ValueError: It names the array, what it is of, and what follows.
    """
    # Where an increment is cut is infinite where none was; what is evaluated may be anything.
    wrong = np.isnan(array) if name == "numbers" else ~np.isfinite(array)
    if wrong.any() and not name.startswith("values "):
        raise ValueError(f"{name!r} has values that are not finite: {where}")


def refuse(stored: StoredCheckpoint, differences: Sequence[str], remedy: str = "") -> None:
    """Refuse a file that differs from what is wanted.

    Raises:
        ValueError: It lists the differences, if there are any, and the remedy.
    """
    if differences:
        what = "; ".join(differences)
        raise ValueError(f"{stored.path} is not of this problem: {what}; {_REMEDY}{remedy}")
