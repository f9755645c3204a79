"""Read VTK files for ParaView (XML with base64 arrays), independently of the package."""

from __future__ import annotations

import base64
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fenics_contact.types import Array


@dataclass
class VtuData:
    """The contents of a VTK file.

    Attributes:
        kind: VTK's number of the cell type, the same for all cells.
        x: Coordinates of the nodes, (n_cells, n_nodes, 3).
        at_nodes: Point data, (n_cells, n_nodes) or (n_cells, n_nodes, k).
        in_cells: Cell data, (n_cells,).
        numbers: Field data of the whole file.
    """

    kind: int
    x: Array
    at_nodes: dict[str, Array]
    in_cells: dict[str, Array]
    numbers: dict[str, float]


def read_collection(path: Path) -> list[tuple[float, str]]:
    """Return times and file names of a collection."""
    root = ElementTree.parse(path).getroot()
    assert root.tag == "VTKFile" and root.get("type") == "Collection"
    return [(float(e.get("timestep")), e.get("file")) for e in root.iter("DataSet")]


def read_vtu(path: Path) -> VtuData:
    """Read an unstructured grid of one piece."""
    root = ElementTree.parse(path).getroot()
    assert root.get("type") == "UnstructuredGrid" and root.get("header_type") == "UInt64"
    assert root.get("byte_order") == "LittleEndian"
    (piece,) = root.iter("Piece")
    n, n_cells = int(piece.get("NumberOfPoints")), int(piece.get("NumberOfCells"))
    cells = _arrays(piece.find("Cells"))
    (kind,) = set(cells["types"].tolist())
    per_cell = n // n_cells
    assert cells["offsets"].tolist() == [per_cell * (i + 1) for i in range(n_cells)]
    nodes = cells["connectivity"].reshape(n_cells, per_cell)
    (x,) = _arrays(piece.find("Points")).values()
    at_nodes = _arrays(piece.find("PointData"))
    assert all(len(values) == n for values in (x, *at_nodes.values()))
    in_cells = _arrays(piece.find("CellData"))
    assert all(len(values) == n_cells for values in in_cells.values())
    numbers = _arrays(root.find(".//FieldData"))
    return VtuData(
        kind,
        x[nodes],
        {name: values[nodes] for name, values in at_nodes.items()},
        in_cells,
        {name: float(values[0]) for name, values in numbers.items()},
    )


def _arrays(section: ElementTree.Element) -> dict[str, Array]:
    found = {}
    for each in section:
        assert each.get("format") == "binary"
        data = base64.b64decode(each.text, validate=True)
        assert int.from_bytes(data[:8], "little") == len(data) - 8
        name = each.get("type")
        kind = np.dtype({"Float": "f", "UInt": "u", "Int": "i"}[name.rstrip("0123456789")] + "8")
        bits = int("".join(c for c in name if c.isdigit()))
        values = np.frombuffer(data[8:], dtype=f"<{kind.kind}{bits // 8}")
        size = int(each.get("NumberOfComponents"))
        found[each.get("Name")] = values.reshape(-1, size) if size > 1 else values
    return found
