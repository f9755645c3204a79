"""Values at nodes and quadrature points, comparison with references, and JSON files."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import basix
import dolfinx
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

from fenics_contact.compiling import compile_expression
from fenics_contact.parallel import collective_errors, gather_rows, global_max, global_min
from fenics_contact.results import files
from fenics_contact.tolerances import FLAT
from fenics_contact.types import Array

__all__ = [
    "at_node",
    "compare",
    "sample",
    "table",
    "write_json",
]


def at_node(u: fem.Function, point: Sequence[float]) -> Array:
    """Return the displacement of the node at an undeformed point, shape (gdim,). Collective.

    Args:
        u: Displacement.
        point: Coordinates of the node, gdim numbers (length).

    Raises:
        ValueError: No node is within 1e-6 of the mesh size of the point; raised on all ranks.
    """
    space = u.function_space
    gdim, n_owned = space.mesh.geometry.dim, space.dofmap.index_map.size_local
    distance = np.linalg.norm(
        space.tabulate_dof_coordinates()[:n_owned, :gdim] - np.asarray(point), axis=1
    )
    values = u.x.array.reshape(-1, len(u))[:n_owned]
    nearest = np.argsort(distance)[:1]
    rows = gather_rows(space.mesh.comm, np.column_stack([distance[nearest], values[nearest]]))
    row = rows[np.argmin(rows[:, 0])]
    comm, x = space.mesh.comm, space.mesh.geometry.x
    if row[0] > FLAT * (global_max(comm, x) - global_min(comm, x)):
        raise ValueError(
            f"no node at {list(point)}; the nearest is {row[0]:g} away: give coordinates of a node"
        )
    return row[1:]


def sample(expression: Any, mesh: dolfinx.mesh.Mesh, degree: int = 1) -> tuple[Array, Array]:
    """Evaluate a UFL expression at quadrature points of all cells. Collective.

    Args:
        expression: A scalar, vector or tensor on ``mesh``.
        mesh: The mesh.
        degree: Degree of the quadrature rule.

    Returns:
        Points (n, gdim) and values (n, …) of all ranks, sorted by coordinates, on every rank.
    """
    expression = ufl.as_ufl(expression)
    points, _ = basix.make_quadrature(mesh.basix_cell(), degree)
    cells = np.arange(mesh.topology.index_map(mesh.topology.dim).size_local, dtype=np.int32)
    gdim, shape = mesh.geometry.dim, expression.ufl_shape
    n = len(cells) * len(points)
    columns = [
        np.reshape(compile_expression(e, points).eval(mesh, cells), (n, math.prod(e.ufl_shape)))
        for e in (ufl.SpatialCoordinate(mesh), expression)
    ]
    rows = gather_rows(mesh.comm, np.column_stack(columns))
    rows = rows[np.lexsort(rows[:, :gdim].T[::-1])]
    return rows[:, :gdim], rows[:, gdim:].reshape(-1, *shape)


def compare(
    values: Mapping[str, float], references: Mapping[str, tuple[float, float]]
) -> dict[str, dict[str, Any]]:
    """Compare results with references.

    Args:
        values: Results by name.
        references: Reference and relative tolerance by name; the tolerance is absolute if the
            reference is zero.

    Returns:
        A dict with value, reference, error, tolerance and passed, by name.
    """
    entries = {}
    for name, (reference, tolerance) in references.items():
        error = abs(float(values[name]) - reference) / (abs(reference) or 1.0)
        entries[name] = {
            "value": float(values[name]),
            "reference": float(reference),
            "error": error,
            "tolerance": tolerance,
            "passed": bool(error <= tolerance),
        }
    return entries


def table(entries: Mapping[str, Mapping[str, Any]]) -> str:
    """Format the result of `compare` as a table, one line per entry."""
    lines = [f"{'':32}{'result':>14}{'reference':>14}{'error':>10}{'allowed':>10}"]
    for name, e in entries.items():
        line = f"{name:32}{e['value']:14.6g}{e['reference']:14.6g}"
        line += f"{e['error']:10.1e}{e['tolerance']:10.1e}"
        lines.append(line + ("" if e["passed"] else "  MISSED"))
    return "\n".join(lines)


def write_json(path: str | os.PathLike[str], data: Mapping[str, Any], comm: MPI.Comm) -> None:
    """Write data as JSON on the first rank. Collective.

    The file is replaced only when it is complete.

    Raises:
        OSError: The file cannot be written (on the other ranks RuntimeError).
        ValueError: ``data`` has numbers that are not finite.
    """
    with collective_errors(comm):
        if comm.rank == 0:
            text = json.dumps(data, indent=2, default=float, allow_nan=False) + "\n"
            with files.atomic_write(path) as temporary:
                temporary.write_text(text)
