"""The one place that knows that releases differ, by feature: DOLFINx 0.9 to 0.11, PETSc with it."""

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
    "LONGEST_STEP",
    "NOT_FINITE",
    "cell_partitioner",
    "collapsed",
    "contains",
    "create_facet_submesh",
    "entities_of",
    "geometry_dofmap",
    "geometry_element",
    "gmsh_data",
    "interpolation_points",
    "option_was_read",
    "sparse_matrix",
]

if tuple(map(int, dolfinx.__version__.split(".")[:2])) < (0, 9):
    raise ImportError(
        f"fenics_contact needs DOLFINx 0.9 or later, and this is {dolfinx.__version__}: install a "
        "later one, or use the container (docker/run)"
    )

# The longest step of a line search, renamed in PETSc 3.24, like the line search SECANT; both are
# bound to Python since 3.23.
_line_searches = getattr(getattr(PETSc, "SNESLineSearch", None), "Type", None)
_RENAMED = hasattr(_line_searches, "SECANT")
LONGEST_STEP = "snes_linesearch_maxlambda" if _RENAMED else "snes_linesearch_maxstep"
# The reason of SNES where the residual is not finite, renamed in 3.25 (the number is the same).
_reasons = PETSc.SNES.ConvergedReason
NOT_FINITE = int(
    _reasons.DIVERGED_FUNCTION_NANORINF
    if hasattr(_reasons, "DIVERGED_FUNCTION_NANORINF")
    else _reasons.DIVERGED_FNORM_NAN
)


def create_facet_submesh(
    mesh: dolfinx.mesh.Mesh, facets: npt.NDArray[np.int32]
) -> tuple[dolfinx.mesh.Mesh, Any, npt.NDArray[np.int32]]:
    """Make a mesh of some facets of ``mesh``. Collective.

    Args:
        mesh: The parent mesh.
        facets: Facets of this rank (local indices), shape (n_facets,).

    Returns:
        The submesh; what ``dolfinx.fem.form`` takes as ``entity_maps`` for it; and the parent
        facet of each local cell of the submesh, shape (n_cells,).
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
    """Whether tags are of the entities of this mesh: numbers of another one mean others here."""
    # Some releases wrap what is compared, and make the wrapper anew each time.
    mine, theirs = tags.topology, mesh.topology
    return getattr(mine, "_cpp_object", mine) is getattr(theirs, "_cpp_object", theirs)


def option_was_read(name: str) -> bool:
    """Whether anything has asked PETSc's database for an option, given without dash."""
    options = PETSc.Options()
    if hasattr(options, "used"):  # petsc4py >= 3.23
        return bool(options.used(name))
    read = ctypes.c_int(0)
    library = ctypes.CDLL(PETSc.__file__)
    library.PetscOptionsUsed(None, name.encode(), ctypes.byref(read))
    return bool(read.value)


def sparse_matrix(
    comm: MPI.Comm, n_columns: int, pointers: Any, columns: Any, values: Array
) -> PETSc.Mat:
    """A matrix of this rank's rows, with the integers of this PETSc. Collective.

    Args:
        comm: The ranks.
        n_columns: Number of the columns that this rank owns.
        pointers: Where the entries of each row begin and end, (n_rows + 1,).
        columns: Global columns of the entries, (n_entries,).
        values: The entries, (n_entries,).
    """
    csr = *(np.asarray(numbers, dtype=PETSc.IntType) for numbers in (pointers, columns)), values
    return PETSc.Mat().createAIJ(((len(pointers) - 1, None), (n_columns, None)), csr=csr, comm=comm)


def cell_partitioner(ghost_mode: dolfinx.mesh.GhostMode) -> Any:
    """What ``dolfinx.mesh.create_mesh`` distributes cells by: a facet has up to two of them."""
    try:
        return dolfinx.mesh.create_cell_partitioner(ghost_mode, 2)
    except TypeError:  # DOLFINx < 0.11
        return dolfinx.mesh.create_cell_partitioner(ghost_mode)


def collapsed(space: fem.FunctionSpace) -> tuple[fem.FunctionSpace, npt.NDArray[np.int32]]:
    """A subspace as a space of its own, and the dof of the whole for each of its dofs. Collective.

    The dofs come as a list of numbers, since 0.11 as a list of one array.
    """
    own, dofs = space.collapse()
    return own, np.asarray(dofs, dtype=np.int32).ravel()


def geometry_element(mesh: dolfinx.mesh.Mesh) -> Any:
    """The scalar Basix element of the geometry, over the nodes of `geometry_dofmap`."""
    geometry = mesh.geometry
    cmap = geometry.cmaps[0] if hasattr(geometry, "cmaps") else geometry.cmap
    kind, variant = basix.CellType[mesh.topology.cell_name()], basix.LagrangeVariant(cmap.variant)
    return basix.create_element(basix.ElementFamily.P, kind, cmap.degree, variant)


def geometry_dofmap(mesh: dolfinx.mesh.Mesh) -> npt.NDArray[np.int32]:
    """Geometry nodes of every local cell, shape (n_cells, n_nodes)."""
    geometry = mesh.geometry
    return geometry.dofmaps[0] if hasattr(geometry, "dofmaps") else geometry.dofmap


def contains(space: fem.FunctionSpace, other: Any) -> bool:
    """Whether the space of a Dirichlet condition, bare in some releases, is in another one."""
    whole, part = (getattr(each, "_cpp_object", each) for each in (space, other))
    return bool(whole.contains(part))


def interpolation_points(element: Any) -> Array:
    """Interpolation points of a DOLFINx element: a method in 0.9, a property since."""
    points = element.interpolation_points
    return points() if callable(points) else points


def gmsh_data(model: Any, comm: Any, rank: int, gdim: int) -> tuple[dolfinx.mesh.Mesh, Any, Any]:
    """Mesh of the gmsh model of ``rank``, tags of its cells and facets (or None). Collective."""
    try:
        from dolfinx.io import gmsh as gmshio  # DOLFINx >= 0.10
    except ImportError:
        from dolfinx.io import gmshio
    data = gmshio.model_to_mesh(model, comm, rank, gdim=gdim)
    if isinstance(data, tuple):  # a named one from 0.10 on, which has more behind these
        return data[0], data[1], data[2]
    return data.mesh, data.cell_tags, data.facet_tags
