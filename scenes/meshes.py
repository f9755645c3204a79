"""Meshes created from given nodes and cells."""

from __future__ import annotations

from typing import Any

import basix.ufl
import dolfinx
import numpy as np
import ufl
from mpi4py import MPI

from fenics_contact.types import Array, Index


def create_mesh(
    cell: str,
    x: Array,
    cells: Array,
    *,
    degree: int = 1,
    comm: MPI.Comm = MPI.COMM_WORLD,
    partitioner: Any = None,
) -> dolfinx.mesh.Mesh:
    """Create a distributed mesh from nodes (n, d) and cells of the first rank. Collective.

    Args:
        cell: Cell type.
        x: Coordinates of the nodes.
        cells: Node numbers of every cell, in DOLFINx's order.
        degree: Geometric degree.
        comm: MPI communicator.
        partitioner: Partitioner for DOLFINx.
    """
    if comm.rank:
        x, cells = x[:0], cells[:0]
    element = basix.ufl.element("Lagrange", cell, degree, shape=(x.shape[1],))
    return dolfinx.mesh.create_mesh(
        comm, cells=cells.astype(np.int64), x=x, e=ufl.Mesh(element), partitioner=partitioner
    )


def partition_from_owners(owner: Index) -> Any:
    """Return a partitioner's result that assigns every cell to its rank ``owner``, (n_cells,)."""
    owner = owner.astype(np.int32)
    lists = dolfinx.graph.adjacencylist(owner, np.arange(len(owner) + 1, dtype=np.int32))
    return getattr(lists, "_cpp_object", lists)
