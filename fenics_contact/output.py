"""Results in files: ParaView collections of the body and of Γc, and JSON."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem, io
from mpi4py import MPI

from fenics_contact import compat
from fenics_contact.contact import Contact

__all__ = ["surface_fields", "write_body", "write_json", "write_surface"]

Array = npt.NDArray[np.float64]


def surface_fields(contact: Contact) -> dict[str, fem.Function]:
    """The results on Γc as functions on its submesh. Collective.

    On every facet the linear function that fits the values at the quadrature points best (a
    constant where the rule has too few points); the status is that of most of the facet's points.

    Args:
        contact: An evaluated contact.

    Returns:
        pressure, tangential_traction, gap, slip (length, sum of the modes) and status, by name.
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
        "gap": contact.gap,
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
    status = fem.Function(fem.functionspace(submesh, ("DG", 0)), name="status")
    counts = np.stack([(contact.status[rows] == s).sum(axis=1) for s in range(3)])
    status.x.array[status.function_space.dofmap.list[: cells.size_local, 0]] = counts.argmax(axis=0)
    status.x.scatter_forward()
    result["status"] = status
    return result


def write_surface(folder: str | os.PathLike[str], contact: Contact, time: float = 0.0) -> None:
    """Write `surface_fields` as one ParaView collection, ``NAME.pvd``. Collective."""
    _write(Path(folder) / f"{contact.name}.pvd", list(surface_fields(contact).values()), time)


def write_body(
    folder: str | os.PathLike[str], u: fem.Function, stress: Any = None, time: float = 0.0
) -> None:
    """Write ``displacement.pvd`` and, if a stress is given, ``stress.pvd``. Collective.

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


def write_json(path: str | os.PathLike[str], data: Mapping[str, Any], comm: MPI.Comm) -> None:
    """Write ``data`` on the first rank, to a temporary name that replaces the file. Collective."""
    if comm.rank == 0:
        path = Path(path)
        temporary = path.with_name(path.name + ".part")
        temporary.write_text(json.dumps(data, indent=2, default=float, allow_nan=False) + "\n")
        temporary.replace(path)
    comm.barrier()


def _write(path: Path, functions: list[fem.Function], time: float) -> None:
    comm = functions[0].function_space.mesh.comm
    if comm.rank == 0:
        path.parent.mkdir(parents=True, exist_ok=True)
    comm.barrier()
    with io.VTKFile(comm, str(path), "w") as file:
        file.write_function(functions, time)
