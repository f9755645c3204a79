"""Reader of STL files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from fenics_contact.types import Array

__all__ = ["read_stl"]


# Binary format: 80 bytes of comment, the number of triangles, and the triangles.
_HEADER_BYTES = 84
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(path: Path) -> tuple[Array, npt.NDArray[np.intp]]:
    """Read the triangles of a binary or ASCII file; normals follow from the order of corners.

    Returns:
        Corners, separate for every triangle, (3 n, 3), and their numbers, (n, 3).

    Raises:
        ValueError: The file contains no triangles.
        OSError: The file cannot be read.
    """
    corners: Array
    data = path.read_bytes()
    n = int(np.frombuffer(data[80:_HEADER_BYTES], "<u4")[0]) if len(data) >= _HEADER_BYTES else 0
    if n and len(data) == _HEADER_BYTES + n * _TRIANGLE.itemsize:
        triangles = np.frombuffer(data, _TRIANGLE, offset=_HEADER_BYTES)
        corners = triangles["corners"].astype(np.float64).reshape(-1, 3)
    else:
        corners = _parse_ascii(path, data)
    return corners, np.arange(len(corners), dtype=np.intp).reshape(-1, 3)


def _parse_ascii(path: Path, data: bytes) -> Array:
    """Return the corners of an ASCII file, (3 n, 3), from lines that begin with "vertex"."""
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
