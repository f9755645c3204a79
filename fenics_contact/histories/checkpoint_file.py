"""Checkpoint files: an archive of NumPy arrays with its SHA-256 checksum, and their checks."""

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
# Trailer of a file, followed by the checksum of everything before it.
_TRAILER = b"\nfenics_contact checkpoint, sha256 "
_REMEDY = "remove it to start again"


@dataclass(frozen=True)
class StoredCheckpoint:
    """The content of a checkpoint file, on every rank.

    Attributes:
        path: The file.
        scene: Fingerprint of the problem (strings) and other data that are not arrays.
        arrays: Arrays by name.
    """

    path: Path
    scene: dict[str, Any]
    arrays: dict[str, Array]

    @property
    def numbers(self) -> list[float]:
        """Numbers of the caller."""
        return [float(value) for value in self.arrays["numbers"]]

    @property
    def notes(self) -> Any:
        """Notes of the caller."""
        return self.scene["notes"]


def write_file(path: Path, scene: dict[str, Any], arrays: dict[str, Array]) -> None:
    """Write a checkpoint file atomically, and read it back; raise OSError if it differs."""
    content = _pack(scene, arrays)
    with files.atomic_write(path) as temporary:
        with open(temporary, "wb") as file:
            file.write(content)
        if temporary.read_bytes() != content:
            raise OSError(f"{path} differs from what was written: check the disk")


def _pack(scene: dict[str, Any], arrays: dict[str, Array]) -> bytes:
    """Return the archive and its trailer."""
    words = np.frombuffer(json.dumps(scene).encode(), dtype=np.uint8)
    archive = io.BytesIO()
    np.savez(archive, allow_pickle=False, scene=words, **arrays)
    content = archive.getvalue()
    return content + _TRAILER + hashlib.sha256(content).hexdigest().encode()


def read_file(path: Path) -> tuple[dict[str, Any], dict[str, Array]]:
    """Read scene and arrays; raise ValueError for a damaged file, or one of another format."""
    files.check_file(path)
    content = path.read_bytes()
    end = len(content) - len(_TRAILER) - 64
    if end < 0 or content[end : end + len(_TRAILER)] != _TRAILER:
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
        version = scene["format"]
    except Exception as error:  # NumPy's reader raises errors of many types
        raise ValueError(f"{path} is no checkpoint ({error}); {_REMEDY}") from error
    if version != FORMAT:
        raise ValueError(
            f"{path} is a checkpoint of format {version!r}, but this version reads {FORMAT}; use "
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
    """Raise ValueError, with the text ``where``, if a state array has values that are not finite.

    Numbers of the caller may be infinite (the largest increment), results ("values ...") anything.
    """
    invalid = np.isnan(array) if name == "numbers" else ~np.isfinite(array)
    if invalid.any() and not name.startswith("values "):
        raise ValueError(f"{name!r} has values that are not finite: {where}")


def refuse(stored: StoredCheckpoint, differences: Sequence[str], remedy: str = "") -> None:
    """Raise ValueError with the differences and the remedy, if there are differences."""
    if differences:
        listed = "; ".join(differences)
        raise ValueError(f"{stored.path} is not of this problem: {listed}; {_REMEDY}{remedy}")
