"""Adaptive refinement of meshes of straight-sided simplices by stress recovery."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import dolfinx
import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from fenics_contact import compat
from fenics_contact.estimates.errors import ErrorBudget, estimate_errors
from fenics_contact.parallel import gather_rows
from fenics_contact.problem import ContactProblem
from fenics_contact.types import Array

__all__ = ["AdaptationLevel", "adapt"]

_SIMPLICES = (dolfinx.mesh.CellType.triangle, dolfinx.mesh.CellType.tetrahedron)


@dataclass(frozen=True)
class AdaptationLevel:
    """The solution on one mesh of the adaptation.

    Attributes:
        mesh, facet_tags: The mesh and its facet tags.
        problem: The solved problem.
        budget: Its estimated errors.
        dofs: Number of dofs on all ranks.
    """

    mesh: dolfinx.mesh.Mesh
    facet_tags: dolfinx.mesh.MeshTags
    problem: ContactProblem
    budget: ErrorBudget
    dofs: int


def adapt(
    mesh: dolfinx.mesh.Mesh,
    facet_tags: dolfinx.mesh.MeshTags,
    solve: Callable[[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags], tuple[Any, ...]],
    *,
    levels: int = 8,
    share: float = 0.5,
    snap: Mapping[int, Callable[[Array], Array]] | None = None,
) -> Iterator[AdaptationLevel]:
    """Solve on successively refined meshes. Collective.

    Args:
        mesh: Initial mesh: triangles or tetrahedra with straight edges, without ghost cells.
        facet_tags: Tags of its boundary facets, which are transferred to all meshes.
        solve: Function of mesh and facet tags that creates the problem and solves its load history;
            it returns the problem, the stress σ(u) (UFL), and optionally the strain if the stress
            is (3, 3).
        levels: Number of solutions.
        share: Fraction of the squared error that the refined cells have together, > 0 and ≤ 1; 1
            refines all cells.
        snap: For tags of curved boundaries, a function that maps coordinates of new nodes (n, gdim)
            onto the boundary.

    Yields:
        An `AdaptationLevel` after every solution.

    Raises:
        ValueError: The cells cannot be refined, or arguments are invalid.
        NotConverged: An increment in ``solve`` failed.
    """
    degree = compat.geometry_element(mesh).degree
    if mesh.topology.cell_type not in _SIMPLICES or degree != 1:
        raise ValueError(
            f"the mesh has cells {mesh.topology.cell_type.name} of degree "
            f"{degree}; only triangles and tetrahedra with straight edges "
            "can be refined: use such a mesh, and snap= for curved boundaries"
        )
    if mesh.comm.allreduce(mesh.topology.index_map(mesh.topology.dim).num_ghosts):
        raise ValueError(
            "the mesh has ghost cells, with which DOLFINx does not transfer tags: create it with "
            "ghost_mode=dolfinx.mesh.GhostMode.none"
        )
    if not 0.0 < share <= 1.0 or levels < 1:
        raise ValueError(f"share is {share!r}, levels {levels!r}; use 0 < share <= 1, levels >= 1")
    budget: ErrorBudget | None = None
    for _ in range(levels):
        if budget is not None:
            assert budget.cells is not None
            cells = _mark_cells(mesh.comm, budget.cells, share)
            mesh, facet_tags = _refine(mesh, facet_tags, cells, snap or {})
        problem, stress, *strain = solve(mesh, facet_tags)
        budget = estimate_errors(problem, stress, strain=strain[0] if strain else None)
        dofmap = problem.u.function_space.dofmap
        dofs = dofmap.index_map.size_global * dofmap.index_map_bs
        yield AdaptationLevel(mesh, facet_tags, problem, budget, dofs)


def _mark_cells(comm: MPI.Comm, squares: Array, fraction: float) -> npt.NDArray[np.int32]:
    """Return this rank's cells by bulk (Dörfler) marking of squared errors. Collective."""
    all_squares = np.sort(gather_rows(comm, squares))[::-1]
    sums = np.cumsum(all_squares)
    last = int(np.searchsorted(sums, fraction * sums[-1])) if sums.size else 0
    threshold = all_squares[min(last, len(all_squares) - 1)]
    return np.flatnonzero(squares >= threshold).astype(np.int32)


def _refine(
    mesh: dolfinx.mesh.Mesh,
    tags: dolfinx.mesh.MeshTags,
    cells: npt.NDArray[np.int32],
    snap: Mapping[int, Callable[[Array], Array]],
) -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags]:
    """Bisect the edges of cells, and of neighbours for conformity; snap new nodes. Collective."""
    d = mesh.topology.dim
    mesh.topology.create_entities(1)
    mesh.topology.create_connectivity(d - 1, d)
    edges = dolfinx.mesh.compute_incident_entities(mesh.topology, cells, d, 1)
    # Without a partitioner: tags can only be transferred on the same rank.
    finer, parents, facets = dolfinx.mesh.refine(
        mesh, edges, partitioner=None, option=dolfinx.mesh.RefinementOption.parent_cell_and_facet
    )
    for dim in (d - 1, d):
        finer.topology.create_entities(dim)
    finer.topology.create_connectivity(d - 1, d)
    finer_tags = dolfinx.mesh.transfer_meshtag(tags, finer, parents, facets)
    for tag, project in snap.items():
        tagged = finer_tags.find(tag)
        if not tagged.size:
            continue  # DOLFINx 0.9 crashes without any
        nodes = np.unique(dolfinx.mesh.entities_to_geometry(finer, d - 1, tagged))
        finer.geometry.x[nodes, :d] = project(finer.geometry.x[nodes, :d])
    return finer, finer_tags
