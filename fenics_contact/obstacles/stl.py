"""Triangles out of STL files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from fenics_contact.types import Array

__all__ = ["read_stl"]


# A binary file: 80 bytes that mean nothing, the number of triangles, and these.
_HEADER = 84
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(path: Path) -> tuple[Array, npt.NDArray[np.intp]]:
    """The triangles of a binary or ASCII file: every one has corners of its own.

    The normals in the file are left: by the format's rule the order of the corners says the same.

    Returns:
        Corners, (3 n, 3), and their numbers, (n, 3).

    Raises:
        ValueError: It holds no triangles.
        OSError: It cannot be read.
    """
    corners: Array
    data = path.read_bytes()
    n = int(np.frombuffer(data[80:_HEADER], "<u4")[0]) if len(data) >= _HEADER else 0
    if n and len(data) == _HEADER + n * _TRIANGLE.itemsize:
        triangles = np.frombuffer(data, _TRIANGLE, offset=_HEADER)
        corners = triangles["corners"].astype(np.float64).reshape(-1, 3)
    else:
        corners = _from_text(path, data)
    return corners, np.arange(len(corners), dtype=np.intp).reshape(-1, 3)


def _from_text(path: Path, data: bytes) -> Array:
    """Corners of an ASCII file, (3 n, 3): lines that begin with "vertex"."""
    lines = [line.split() for line in data.splitlines()]
    try:
        rows = [[float(v) for v in words[1:]] for words in lines if words[:1] == [b"vertex"]]
    except ValueError:
        rows = []
    if not rows or {len(row) for row in rows} != {3} or len(rows) % 3:
        raise ValueError(
            f"{path} holds no triangles: its {len(data)} bytes are neither a binary STL file of "
            "the length in its header nor an ASCII one with complete facets"
        )
    return np.array(rows)
