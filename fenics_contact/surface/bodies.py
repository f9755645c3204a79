"""Bodies of a mesh: the parts of it that its displacements connect."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.sparse.csgraph
from dolfinx import fem
from mpi4py import MPI

from fenics_contact.tolerances import by_place

__all__ = ["connected_bodies"]


def connected_bodies(space: fem.FunctionSpace) -> tuple[int, npt.NDArray[np.intp]]:
    """Number of bodies, and the body of every node of this rank, its ghosts last. Collective.

    Returns:
        The number over all ranks, and the numbers from 0, (n_owned + n_ghosts,): the same body has
        the same number on every rank, and on any number of ranks: by their places, x first.
    """
    comm, dofmap = space.mesh.comm, space.dofmap
    n_owned = dofmap.index_map.size_local
    n_nodes = n_owned + dofmap.index_map.num_ghosts
    cells = dofmap.list
    first = np.repeat(cells[:, 0], cells.shape[1] - 1)
    links = scipy.sparse.coo_matrix(
        (np.ones(first.size, dtype=np.int8), (first, cells[:, 1:].ravel())), (n_nodes, n_nodes)
    )
    # Nodes that no cell here has, all of them ghosts, are parts of their own.
    n_parts, part = scipy.sparse.csgraph.connected_components(links, directed=False)
    offset = comm.scan(n_parts) - n_parts
    # A ghost belongs to a part here and to one on its owner: the two are one body.
    label = fem.Function(space)
    label.x.array.reshape(n_nodes, dofmap.bs)[:, 0] = offset + part
    label.x.scatter_forward()
    owner = label.x.array.reshape(n_nodes, dofmap.bs)[n_owned:, 0].astype(np.int64)
    pairs = np.unique(np.column_stack([owner, offset + part[n_owned:]]), axis=0)
    pairs = np.concatenate(comm.allgather(pairs))
    total = comm.allreduce(n_parts)
    graph = scipy.sparse.coo_matrix((np.ones(len(pairs)), pairs.T), (total, total))
    _, merged = scipy.sparse.csgraph.connected_components(graph, directed=False)
    # Numbered by the parts that own nodes: every body has one.
    used = np.zeros(total, dtype=np.int64)
    np.add.at(used, offset + part[:n_owned], 1)
    comm.Allreduce(MPI.IN_PLACE, used, op=MPI.SUM)
    bodies = np.unique(merged[used > 0])
    body = np.searchsorted(bodies, merged[offset + part])
    if len(bodies) > 1:
        body = _ordered(space, len(bodies), body)
    return len(bodies), body


def _ordered(space: fem.FunctionSpace, n: int, body: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
    """Numbers by the corners of the bodies' boxes, the lower ones first. Collective."""
    x = space.tabulate_dof_coordinates()
    corners = np.full((2, n, x.shape[1]), np.inf)
    for corner, sign in zip(corners, (1.0, -1.0), strict=True):
        np.minimum.at(corner, body, sign * x)
    space.mesh.comm.Allreduce(MPI.IN_PLACE, corners, op=MPI.MIN)
    keys = np.concatenate([corners[0], -corners[1]], axis=1)
    number = np.empty(n, dtype=np.intp)
    number[by_place(keys)] = np.arange(n)
    return number[body]
