"""Surfaces and profiles of rigid tools, given by points and facets."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fenics_contact.types import Array


def circle(n: int, radius: float = 1.0, centre: Sequence[float] = (0.0, 0.0)) -> Array:
    """Return n distinct points of a circle, anticlockwise, (n, 2)."""
    t = 2 * np.pi * np.arange(n) / n
    return np.asarray(centre) + radius * np.column_stack([np.cos(t), np.sin(t)])


def ring(n: int) -> Array:
    """Return the point numbers of the segments of a closed polyline with n points, (n, 2)."""
    return np.column_stack([np.arange(n), (np.arange(n) + 1) % n])


def ball(
    halvings: int, radius: float = 1.0, centre: Sequence[float] = (0.0, 0.0, 0.0)
) -> tuple[Array, Array]:
    """Return a triangulated sphere: an octahedron whose edges are halved ``halvings`` times.

    Returns:
        Points on the sphere, (3 n, 3), not shared between triangles, and the point numbers of the
        triangles, (n, 3), with n = 8 · 4^halvings.
    """
    x, y, z = np.eye(3)
    upper = [(x, y, z), (y, -x, z), (-x, -y, z), (-y, x, z)]
    corners = np.array([*upper, *((b, a, -c) for a, b, c in upper)])
    for _ in range(halvings):
        a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
        # Midpoints are projected to the sphere; both triangles of an edge get identical digits.
        ab, bc, ca = (p + q for p, q in ((a, b), (b, c), (c, a)))
        ab, bc, ca = (p / np.linalg.norm(p, axis=1, keepdims=True) for p in (ab, bc, ca))
        parts = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        corners = np.concatenate([np.stack(part, axis=1) for part in parts])
    points = np.asarray(centre) + radius * corners.reshape(-1, 3)
    return points, np.arange(len(points)).reshape(-1, 3)


def box(low: Sequence[float], high: Sequence[float]) -> tuple[Array, Array]:
    """Return points (8, 3) and outward triangles (12, 3) of the surface of a box."""
    bits = np.array([[i & 1, i >> 1 & 1, i >> 2 & 1] for i in range(8)])
    points = np.where(bits == 1, high, low).astype(float)
    squares = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    return points, np.array([t for a, b, c, d in squares for t in ((a, b, c), (a, c, d))])


def write_stl(path: Path, points: Array, facets: Array, *, binary: bool = True) -> Path:
    """Write the triangles to an STL file, and return its path."""
    corners = points[facets]
    if binary:
        rows = np.zeros(len(facets), [("normal", "<f4", 3), ("x", "<f4", (3, 3)), ("a", "<u2")])
        rows["x"] = corners
        head = b"solid made by a program that writes binary files".ljust(80)
        path.write_bytes(head + np.array(len(facets), "<u4").tobytes() + rows.tobytes())
        return path
    lines = ["solid vertex"]
    for triangle in corners:
        lines += ["  facet normal 0 0 0", "    outer loop"]
        lines += [f"      vertex {x:.17g} {y:.17g} {z:.17g}" for x, y, z in triangle]
        lines += ["    endloop", "  endfacet"]
    path.write_text("\n".join([*lines, "endsolid vertex", ""]))
    return path
