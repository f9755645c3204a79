"""Bodies of a mesh: the connected components of its graph of nodes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.sparse.csgraph
from dolfinx import fem
from mpi4py import MPI

from fenics_contact.tolerances import sort_by_coordinates

__all__ = ["connected_bodies"]


def connected_bodies(space: fem.FunctionSpace) -> tuple[int, npt.NDArray[np.intp]]:
    """Number the bodies of a mesh by the nodes that its cells connect. Collective.

    Returns:
        Number of bodies on all ranks, and the body of every node of this rank, ghosts last,
        (n_owned + n_ghosts,). The numbering, by position, does not depend on the partition.
    """
    comm, dofmap = space.mesh.comm, space.dofmap
    n_owned = dofmap.index_map.size_local
    n_nodes = n_owned + dofmap.index_map.num_ghosts
    cells = dofmap.list
    first = np.repeat(cells[:, 0], cells.shape[1] - 1)
    links = scipy.sparse.coo_matrix(
        (np.ones(first.size, dtype=np.int8), (first, cells[:, 1:].ravel())), (n_nodes, n_nodes)
    )
    # Ghost nodes without a cell on this rank are components of their own.
    n_components, component = scipy.sparse.csgraph.connected_components(links, directed=False)
    offset = comm.scan(n_components) - n_components
    # The component of a ghost on this rank and that on its owner are one body.
    label = fem.Function(space)
    label.x.array.reshape(n_nodes, dofmap.bs)[:, 0] = offset + component
    label.x.scatter_forward()
    owner = label.x.array.reshape(n_nodes, dofmap.bs)[n_owned:, 0].astype(np.int64)
    pairs = np.unique(np.column_stack([owner, offset + component[n_owned:]]), axis=0)
    pairs = np.concatenate(comm.allgather(pairs))
    total = comm.allreduce(n_components)
    graph = scipy.sparse.coo_matrix((np.ones(len(pairs)), pairs.T), (total, total))
    _, merged = scipy.sparse.csgraph.connected_components(graph, directed=False)
    # Only components with owned nodes are numbered: every body has one.
    used = np.zeros(total, dtype=np.int64)
    np.add.at(used, offset + component[:n_owned], 1)
    comm.Allreduce(MPI.IN_PLACE, used, op=MPI.SUM)
    bodies = np.unique(merged[used > 0])
    body = np.searchsorted(bodies, merged[offset + component])
    if len(bodies) > 1:
        body = _renumber(space, len(bodies), body)
    return len(bodies), body


def _renumber(space: fem.FunctionSpace, n: int, body: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
    """Number bodies in the order of their bounding boxes, lowest first. Collective."""
    x = space.tabulate_dof_coordinates()
    corners = np.full((2, n, x.shape[1]), np.inf)
    for corner, sign in zip(corners, (1.0, -1.0), strict=True):
        np.minimum.at(corner, body, sign * x)
    space.mesh.comm.Allreduce(MPI.IN_PLACE, corners, op=MPI.MIN)
    keys = np.concatenate([corners[0], -corners[1]], axis=1)
    number = np.empty(n, dtype=np.intp)
    number[sort_by_coordinates(keys)] = np.arange(n)
    return number[body]
