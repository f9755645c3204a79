"""Differences between DOLFINx 0.9 to 0.11 and the PETSc releases used with them."""

from __future__ import annotations

import ctypes
from typing import Any

import basix
import dolfinx
import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

from fenics_contact.types import Array

__all__ = [
    "DIVERGED_NOT_FINITE",
    "MAX_STEP_OPTION",
    "cell_partitioner",
    "collapsed",
    "contains",
    "create_csr_matrix",
    "create_facet_submesh",
    "entities_of",
    "geometry_dofmap",
    "geometry_element",
    "gmsh_data",
    "interpolation_points",
    "is_option_used",
]

if tuple(map(int, dolfinx.__version__.split(".")[:2])) < (0, 9):
    raise ImportError(
        f"fenics_contact needs DOLFINx 0.9 or later, and this is {dolfinx.__version__}: install a "
        "later one, or use the container (docker/run)"
    )

# Option of the maximum step length of a line search. PETSc 3.24 renamed it, and the line search
# SECANT, by which the release is recognised.
_line_search_types = getattr(getattr(PETSc, "SNESLineSearch", None), "Type", None)
_HAS_MAX_LAMBDA = hasattr(_line_search_types, "SECANT")
MAX_STEP_OPTION = "snes_linesearch_maxlambda" if _HAS_MAX_LAMBDA else "snes_linesearch_maxstep"
# SNES converged reason for a residual that is not finite, renamed in PETSc 3.25 (same number).
_reasons = PETSc.SNES.ConvergedReason
DIVERGED_NOT_FINITE = int(
    _reasons.DIVERGED_FUNCTION_NANORINF
    if hasattr(_reasons, "DIVERGED_FUNCTION_NANORINF")
    else _reasons.DIVERGED_FNORM_NAN
)


def create_facet_submesh(
    mesh: dolfinx.mesh.Mesh, facets: npt.NDArray[np.int32]
) -> tuple[dolfinx.mesh.Mesh, Any, npt.NDArray[np.int32]]:
    """Create a submesh of facets of this rank (local indices), shape (n_facets,). Collective.

    Returns:
        The submesh; its ``entity_maps`` for ``dolfinx.fem.form``; and the parent facet of each
        local cell of the submesh, shape (n_cells,).
    """
    fdim = mesh.topology.dim - 1
    submesh, facet_map, *_ = dolfinx.mesh.create_submesh(mesh, fdim, facets)
    cells = submesh.topology.index_map(fdim)
    n_cells = cells.size_local + cells.num_ghosts
    if isinstance(facet_map, np.ndarray):
        parents = np.asarray(facet_map[:n_cells], dtype=np.int32)
        index_map = mesh.topology.index_map(fdim)
        parent_to_sub = np.full(index_map.size_local + index_map.num_ghosts, -1, dtype=np.int32)
        parent_to_sub[parents] = np.arange(n_cells, dtype=np.int32)
        return submesh, {submesh: parent_to_sub}, parents
    local = np.arange(n_cells, dtype=np.int32)
    return submesh, [facet_map], facet_map.sub_topology_to_topology(local, False)


def entities_of(tags: dolfinx.mesh.MeshTags, mesh: dolfinx.mesh.Mesh) -> bool:
    """Return whether mesh tags belong to this mesh."""
    # Some releases create a new Python wrapper of the topology at each access.
    of_tags, of_mesh = tags.topology, mesh.topology
    return getattr(of_tags, "_cpp_object", of_tags) is getattr(of_mesh, "_cpp_object", of_mesh)


def is_option_used(name: str) -> bool:
    """Return whether an option (without dash) has been queried from PETSc's options database."""
    options = PETSc.Options()
    if hasattr(options, "used"):  # petsc4py >= 3.23
        return bool(options.used(name))
    read = ctypes.c_int(0)
    library = ctypes.CDLL(PETSc.__file__)
    library.PetscOptionsUsed(None, name.encode(), ctypes.byref(read))
    return bool(read.value)


def create_csr_matrix(
    comm: MPI.Comm, n_columns: int, pointers: Any, columns: Any, values: Array
) -> PETSc.Mat:
    """Create a sparse matrix from this rank's rows in CSR format, with global columns. Collective.

    ``n_columns`` is the number of columns that this rank owns.
    """
    csr = *(np.asarray(numbers, dtype=PETSc.IntType) for numbers in (pointers, columns)), values
    return PETSc.Mat().createAIJ(((len(pointers) - 1, None), (n_columns, None)), csr=csr, comm=comm)


def cell_partitioner(ghost_mode: dolfinx.mesh.GhostMode) -> Any:
    """Return a partitioner for ``dolfinx.mesh.create_mesh``, with up to two cells per facet."""
    try:
        return dolfinx.mesh.create_cell_partitioner(ghost_mode, 2)
    except TypeError:  # DOLFINx < 0.11
        return dolfinx.mesh.create_cell_partitioner(ghost_mode)


def collapsed(space: fem.FunctionSpace) -> tuple[fem.FunctionSpace, npt.NDArray[np.int32]]:
    """Collapse a subspace: return the space and the parent dof of each of its dofs. Collective."""
    collapsed_space, dofs = space.collapse()
    return collapsed_space, np.asarray(dofs, dtype=np.int32).ravel()  # nested since 0.11


def geometry_element(mesh: dolfinx.mesh.Mesh) -> Any:
    """Return the scalar Basix element of the mesh geometry, on the nodes of `geometry_dofmap`."""
    geometry = mesh.geometry
    cmap = geometry.cmaps[0] if hasattr(geometry, "cmaps") else geometry.cmap
    kind, variant = basix.CellType[mesh.topology.cell_name()], basix.LagrangeVariant(cmap.variant)
    return basix.create_element(basix.ElementFamily.P, kind, cmap.degree, variant)


def geometry_dofmap(mesh: dolfinx.mesh.Mesh) -> npt.NDArray[np.int32]:
    """Return the geometry nodes of every local cell, shape (n_cells, n_nodes)."""
    geometry = mesh.geometry
    return geometry.dofmaps[0] if hasattr(geometry, "dofmaps") else geometry.dofmap


def contains(space: fem.FunctionSpace, other: Any) -> bool:
    """Return whether the space of a Dirichlet condition is a subspace of ``space``."""
    parent, subspace = (getattr(each, "_cpp_object", each) for each in (space, other))
    return bool(parent.contains(subspace))


def interpolation_points(element: Any) -> Array:
    """Return the interpolation points of a DOLFINx element."""
    points = element.interpolation_points  # a method in 0.9, a property since
    return points() if callable(points) else points


def gmsh_data(model: Any, comm: Any, rank: int, gdim: int) -> tuple[dolfinx.mesh.Mesh, Any, Any]:
    """Return the mesh of the gmsh model of ``rank``, and cell and facet tags. Collective."""
    try:
        from dolfinx.io import gmsh as gmshio  # DOLFINx >= 0.10
    except ImportError:
        from dolfinx.io import gmshio
    data = gmshio.model_to_mesh(model, comm, rank, gdim=gdim)
    if isinstance(data, tuple):  # a named tuple since 0.10, with more items
        return data[0], data[1], data[2]
    return data.mesh, data.cell_tags, data.facet_tags
