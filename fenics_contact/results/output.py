"""Results in files, ParaView collections and JSON; values at points, tables of references met."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import basix
import dolfinx
import numpy as np
import ufl
from dolfinx import fem, io
from mpi4py import MPI

from fenics_contact import compat
from fenics_contact.contact.contact import Contact
from fenics_contact.parallel import collective_errors, gather_rows, global_max, global_min
from fenics_contact.results import files
from fenics_contact.types import Array

__all__ = [
    "at_node",
    "compare",
    "sample",
    "surface_fields",
    "table",
    "write_body",
    "write_json",
    "write_surface",
]


def surface_fields(contact: Contact) -> dict[str, fem.Function]:
    """The results on Γc as functions on its submesh. Collective.

    On every facet the linear function that fits the values at the quadrature points best (a
    constant where the rule has too few points); the status is that of most of the facet's points.

    Args:
        contact: An evaluated contact.

    Returns:
        pressure, tangential_traction, gap, slip (length, sum of the modes) and status, by name. A
        gap of 0 stands for points without an opposite, whose share of a facet is "unpaired", there
        if the support is deformable.
    """
    submesh = contact.surface.submesh
    points, weights = contact.quadrature.space().ufl_element().custom_quadrature()
    linear = fem.functionspace(submesh, ("DG", 1))
    n_basis = linear.dofmap.dof_layout.num_dofs
    degree = 1 if len(points) >= n_basis else 0
    cells = submesh.topology.index_map(submesh.topology.dim)
    rows = contact.quadrature.space().dofmap.list[: cells.size_local]

    values = {
        "pressure": contact.pressure,
        "tangential_traction": contact.tangential_traction,
        "gap": np.nan_to_num(contact.gap),
        "slip": contact.slip.sum(axis=1),
    }
    result = {}
    for name, value in values.items():
        shape = value.shape[1:]
        space = fem.functionspace(submesh, ("DG", degree, shape) if shape else ("DG", degree))
        if degree == 0:
            fit = (weights / weights.sum())[None, :]
        else:
            basis = linear.element.basix_element.tabulate(0, points)[0, :, :, 0]
            root = np.sqrt(weights)[:, None]
            fit = np.linalg.lstsq(root * basis, root * np.eye(len(points)), rcond=None)[0]
        function = fem.Function(space, name=name)
        # (facets, points, …) -> (facets, basis, …), then to the dofs of each facet.
        fitted = np.einsum("bq,fq...->fb...", fit, value[rows])
        dofs = space.dofmap.list[: cells.size_local]
        function.x.array.reshape((-1, *shape))[dofs] = fitted
        function.x.scatter_forward()
        result[name] = function
    if not contact.rigid:
        unpaired = fem.Function(fem.functionspace(submesh, ("DG", 0)), name="unpaired")
        dofs = unpaired.function_space.dofmap.list[: cells.size_local, 0]
        unpaired.x.array[dofs] = np.mean(~contact.paired[rows], axis=1)
        unpaired.x.scatter_forward()
        result["unpaired"] = unpaired
    status = fem.Function(fem.functionspace(submesh, ("DG", 0)), name="status")
    counts = np.stack([(contact.status[rows] == s).sum(axis=1) for s in range(3)])
    status.x.array[status.function_space.dofmap.list[: cells.size_local, 0]] = counts.argmax(axis=0)
    status.x.scatter_forward()
    result["status"] = status
    return result


def write_surface(folder: str | os.PathLike[str], contact: Contact, time: float = 0.0) -> None:
    """Write `surface_fields` as one ParaView collection, ``NAME.pvd``. Collective.

    It is one state, which replaces what was there: give every state of a series its own folder.

    Args:
        folder: Where to.
        contact: Evaluated.
        time: Time stamp, such as the load.
    """
    _write(Path(folder) / f"{contact.name}.pvd", list(surface_fields(contact).values()), time)


def write_body(
    folder: str | os.PathLike[str], u: fem.Function, stress: Any = None, time: float = 0.0
) -> None:
    """Write ``displacement.pvd`` and, if a stress is given, ``stress.pvd``. Collective.

    It is one state, as in `write_surface`.

    Args:
        folder: Where to.
        u: The displacement.
        stress: UFL tensor of shape (gdim, gdim); it is interpolated into discontinuous functions
            one degree below ``u``.
        time: Time stamp, such as the load.
    """
    _write(Path(folder) / "displacement.pvd", [u], time)
    if stress is None:
        return
    mesh = u.function_space.mesh
    degree = max(0, u.function_space.ufl_element().degree - 1)
    space = fem.functionspace(mesh, ("DG", degree, ufl.as_ufl(stress).ufl_shape))
    points = compat.interpolation_points(space.element)
    function = fem.Function(space, name="stress")
    function.interpolate(fem.Expression(stress, points))
    _write(Path(folder) / "stress.pvd", [function], time)


def at_node(u: fem.Function, point: Sequence[float]) -> Array:
    """Displacement of the node at ``point`` (before any displacement), shape (gdim,). Collective.

    Raises:
        ValueError: No node is nearer than 1e-6 of the mesh's size. On all ranks.
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
    if row[0] > 1e-6 * (global_max(comm, x) - global_min(comm, x)):
        raise ValueError(f"no node at {list(point)}; the nearest is {row[0]:g} away")
    return row[1:]


def sample(expression: Any, mesh: dolfinx.mesh.Mesh, degree: int = 1) -> tuple[Array, Array]:
    """Values of a UFL expression inside every cell, for curves and tables. Collective.

    Args:
        expression: A scalar, vector or tensor on ``mesh``.
        mesh: The mesh.
        degree: Of the quadrature rule whose points are taken.

    Returns:
        On all ranks, points (n, gdim) and values (n, …), ordered by coordinates.
    """
    expression = ufl.as_ufl(expression)
    points, _ = basix.make_quadrature(mesh.basix_cell(), degree)
    cells = np.arange(mesh.topology.index_map(mesh.topology.dim).size_local, dtype=np.int32)
    gdim, shape = mesh.geometry.dim, expression.ufl_shape
    columns = [
        np.asarray(fem.Expression(e, points).eval(mesh, cells)).reshape(
            len(cells) * len(points), -1
        )
        for e in (ufl.SpatialCoordinate(mesh), expression)
    ]
    rows = gather_rows(mesh.comm, np.column_stack(columns))
    rows = rows[np.lexsort(rows[:, :gdim].T[::-1])]
    return rows[:, :gdim], rows[:, gdim:].reshape(-1, *shape)


def compare(
    values: Mapping[str, float], references: Mapping[str, tuple[float, float]]
) -> dict[str, dict[str, Any]]:
    """Put results beside their references: value, reference, error, tolerance, passed, by name.

    Args:
        values: Results by name.
        references: By name, the reference and the tolerance relative to it (absolute where the
            reference is zero).
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
    """What `compare` returns, one line an entry."""
    lines = [f"{'':32}{'result':>14}{'reference':>14}{'error':>10}{'allowed':>10}"]
    for name, e in entries.items():
        line = f"{name:32}{e['value']:14.6g}{e['reference']:14.6g}"
        line += f"{e['error']:10.1e}{e['tolerance']:10.1e}"
        lines.append(line + ("" if e["passed"] else "  MISSED"))
    return "\n".join(lines)


def write_json(path: str | os.PathLike[str], data: Mapping[str, Any], comm: MPI.Comm) -> None:
    """Write ``data`` on the first rank; the file is complete or as before. Collective.

    Raises:
        OSError: It cannot be written (on the other ranks RuntimeError).
        ValueError: ``data`` holds numbers that are not finite.
    """
    with collective_errors(comm):
        if comm.rank == 0:
            text = json.dumps(data, indent=2, default=float, allow_nan=False) + "\n"
            with files.replacing(path) as temporary:
                temporary.write_text(text)


def _write(path: Path, functions: list[fem.Function], time: float) -> None:
    comm = functions[0].function_space.mesh.comm
    with files.replacing_set(comm, path, b"</VTKFile>") as temporary:
        with collective_errors(comm):
            failure = _write_vtk(comm, temporary, functions, time)
            if failure:
                raise OSError(f"{path} cannot be written: {failure}")


def _write_vtk(comm: MPI.Comm, path: Path, functions: list[fem.Function], time: float) -> str:
    """What went wrong. The error itself would keep the file, whose destructor writes again."""
    try:
        with io.VTKFile(comm, str(path), "w") as file:
            file.write_function(functions, time)
    except RuntimeError as error:
        return str(error)
    return ""
