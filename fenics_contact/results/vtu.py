"""VTK files for ParaView: unstructured grids (``.vtu``) and time series of them (``.pvd``).

Arrays are in base64. Cells share no nodes, so that fields may be discontinuous. Unlike DOLFINx's
writers these functions take values at quadrature points and on facets. On the calling rank only.
"""

from __future__ import annotations

import base64
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import basix
import dolfinx
import dolfinx.io.utils
import numpy as np
import numpy.typing as npt

from fenics_contact.types import Array

__all__ = ["CELLS", "Grid", "nodes", "read_series", "write_grid", "write_series"]


# VTK cell types of degree 1 and 2, by DOLFINx's names of cells.
CELLS = {
    "point": (1, 1),
    "interval": (3, 21),
    "triangle": (5, 22),
    "quadrilateral": (9, 28),
    "tetrahedron": (10, 24),
    "hexahedron": (12, 29),
}


def nodes(cell: str, degree: int) -> Array:
    """Return the reference nodes of a cell of degree 1 or 2 in VTK's order, (n_nodes, d)."""
    kind, equispaced = basix.CellType[cell], basix.LagrangeVariant.equispaced
    x = basix.create_element(basix.ElementFamily.P, kind, degree, equispaced).points
    order = dolfinx.io.utils.cell_perm_vtk(dolfinx.mesh.CellType[cell], len(x))
    return np.asarray(x[np.argsort(order)], dtype=np.float64)


@dataclass(frozen=True)
class Grid:
    """Cells of one type, which share no nodes.

    Attributes:
        kind: VTK cell type.
        points: Coordinates of the nodes, (n_cells, n_nodes, d).
        at_nodes: Nodal fields by name, (n_cells, n_nodes, …).
        in_cells: Cell fields by name, (n_cells, …).
        numbers: Global numbers by name (field data).
    """

    kind: int
    points: Array
    at_nodes: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)
    in_cells: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)
    numbers: Mapping[str, float] = field(default_factory=dict)


def write_grid(path: Path, grid: Grid) -> None:
    """Write a ``.vtu`` file. Vectors and tensors in the plane are extended by zeros."""
    n_cells, n_nodes = grid.points.shape[:2]
    n = n_cells * n_nodes
    topology: dict[str, npt.NDArray[Any]] = {
        "connectivity": np.arange(n, dtype=np.int64),
        "offsets": np.arange(1, n_cells + 1, dtype=np.int64) * n_nodes,
        "types": np.full(n_cells, grid.kind, dtype=np.uint8),
    }
    at_nodes = {name: _to_rows(values, 2) for name, values in grid.at_nodes.items()}
    in_cells = {name: _to_rows(values, 1) for name, values in grid.in_cells.items()}
    with open(path, "w", encoding="ascii", errors="xmlcharrefreplace") as file:
        file.write('<?xml version="1.0"?>\n<VTKFile type="UnstructuredGrid" version="1.0" ')
        file.write('byte_order="LittleEndian" header_type="UInt64">\n<UnstructuredGrid>\n')
        file.write("<FieldData>\n")
        for name, number in grid.numbers.items():
            file.write(_format_array(name, np.array([number]), ' NumberOfTuples="1"'))
        file.write("</FieldData>\n")
        file.write(f'<Piece NumberOfPoints="{n}" NumberOfCells="{n_cells}">\n')
        sections: dict[str, Mapping[str, npt.NDArray[Any]]] = {
            "Points": {"points": _to_rows(grid.points, 2)},
            "Cells": topology,
            "PointData": at_nodes,
            "CellData": in_cells,
        }
        for section, arrays in sections.items():
            file.write(f"<{section}>\n")
            for name, values in arrays.items():
                file.write(_format_array(name, values))
            file.write(f"</{section}>\n")
        file.write("</Piece>\n</UnstructuredGrid>\n</VTKFile>\n")


def write_series(path: Path, states: list[tuple[float, str]]) -> None:
    """Write a ``.pvd`` file with times and names of files in the same folder."""
    lines = [
        f'<DataSet timestep="{time!r}" part="0" file={quoteattr(name)}/>' for time, name in states
    ]
    head = '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n<Collection>'
    path.write_text("\n".join([head, *lines, "</Collection>\n</VTKFile>\n"]), encoding="utf-8")


def read_series(path: Path) -> list[tuple[float, str]]:
    """Read times and names of files from a ``.pvd`` file; empty if it does not exist.

    Raises:
        ValueError: The file is damaged, or was not written by `write_series`.
    """
    if not path.exists():
        return []
    try:
        sets = ElementTree.parse(path).getroot().iter("DataSet")
        return [(float(each.attrib["timestep"]), each.attrib["file"]) for each in sets]
    except (ElementTree.ParseError, KeyError, ValueError):
        raise ValueError(
            f"{path} is no series of this package, or damaged; remove it to start a new one"
        ) from None


def _to_rows(values: npt.NDArray[Any], axes: int) -> npt.NDArray[Any]:
    """Flatten the first axes, and pad scalars, vectors or tensors to 1, 3 or 9 numbers per row."""
    values = np.reshape(values, (-1, *values.shape[axes:]))
    missing = [(0, 0)] + [(0, 3 - size) for size in values.shape[1:]]
    return np.pad(values, missing).reshape(len(values), 3 ** (values.ndim - 1))


def _format_array(name: str, values: npt.NDArray[Any], attributes: str = "") -> str:
    """Return an array as XML: its length in bytes and its bytes, in base64."""
    values = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
    kind = {"f": "Float", "i": "Int", "u": "UInt"}[values.dtype.kind] + str(8 * values.itemsize)
    size = values.shape[1] if values.ndim > 1 else 1
    data = np.uint64(values.nbytes).astype("<u8").tobytes() + values.tobytes()
    return (
        f'<DataArray type="{kind}" Name={quoteattr(name)} NumberOfComponents="{size}"{attributes} '
        f'format="binary">{base64.b64encode(data).decode()}</DataArray>\n'
    )
