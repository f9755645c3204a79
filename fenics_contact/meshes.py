"""Meshes that gmsh has made."""

from __future__ import annotations

from typing import Any

import dolfinx
import numpy as np
from mpi4py import MPI

from fenics_contact import compat
from fenics_contact.parallel import collective_errors

__all__ = ["model_to_mesh"]


def model_to_mesh(
    model: Any, comm: MPI.Comm, rank: int = 0, gdim: int = 3
) -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags, dolfinx.mesh.MeshTags]:
    """Make a mesh of a gmsh model, distributed over the ranks. Collective.

    The same call with the same results on every DOLFINx release from 0.9 on, whose own functions
    differ in name, results and what they take without a word.

    Args:
        model: ``gmsh.model``, meshed, every cell in one physical group, and so every facet that is
            to have a tag. Only ``rank`` looks at it; on the others it may be anything.
        comm: The ranks that share the mesh.
        rank: The rank that has the model.
        gdim: Dimension of space and of the body, 2 or 3; in 2 dimensions z is dropped.

    Returns:
        The mesh, with coordinates in ``gdim`` dimensions and cells of the order that gmsh gave
        them; the tags of the cells, one for each; and the tags of the facets in physical groups,
        none where there are none. A tag is the number of the group.

    Raises:
        ValueError: Cells or facets without a mesh or a group, in two groups, or of several types;
            nodes whose numbers have holes. On all ranks.
    """
    with collective_errors(comm):
        if comm.rank == rank:
            _check(model, gdim)
    mesh, cell_tags, facet_tags = compat.gmsh_data(model, comm, rank, gdim)
    if facet_tags is None:
        nothing = np.empty(0, dtype=np.int32)
        facet_tags = dolfinx.mesh.meshtags(mesh, gdim - 1, nothing, nothing)
    return mesh, cell_tags, facet_tags


def _check(model: Any, gdim: int) -> None:
    """Refuse what DOLFINx would take in part, or stop at on this rank alone."""
    dimensions = sorted({dim for dim, _ in model.getPhysicalGroups()})
    if not dimensions or dimensions[-1] != gdim:
        raise ValueError(
            f"the physical groups of the gmsh model have the dimensions {dimensions}, and gdim is "
            f"{gdim}: put its cells into one by gmsh.model.addPhysicalGroup({gdim}, [...])"
        )
    for dim, what in ((gdim, "cells"), (gdim - 1, "facets")):
        types: set[int] = set()
        groups: dict[int, list[int]] = {}
        for _, group in model.getPhysicalGroups(dim):
            for entity in model.getEntitiesForPhysicalGroup(dim, group):
                groups.setdefault(entity, []).append(group)
        n_grouped = 0
        for entity in groups:
            kinds, numbers, _ = model.mesh.getElements(dim, entity)
            types.update(kinds)
            n_grouped += sum(len(some) for some in numbers)
        n_all = sum(len(some) for some in model.mesh.getElements(dim)[1])
        if dim == gdim and n_all == 0:
            raise ValueError(
                f"the gmsh model has no cells: call gmsh.model.mesh.generate({gdim}) before"
            )
        shared = next((some for some in groups.values() if len(some) > 1), None)
        if shared:
            names = [f"{group} {model.getPhysicalName(dim, group)!r}" for group in shared]
            raise ValueError(
                f"some {what} of the gmsh model are in two physical groups, "
                f"{' and '.join(names)}, and they have one tag only: leave them in one of these, "
                f"and name both where both are meant, as ContactSurface(mesh, tags, {shared}) and "
                f"dx({tuple(shared)}) do"
            )
        if dim == gdim and n_grouped < n_all:
            raise ValueError(
                f"{n_all - n_grouped} of the {n_all} cells of the gmsh model are in no physical "
                f"group, and would be missing: add gmsh.model.addPhysicalGroup({gdim}, [...])"
            )
        if len(types) > 1:
            names = [model.mesh.getElementProperties(kind)[0] for kind in sorted(types)]
            raise ValueError(
                f"the {what} of the gmsh model are of several types, {', '.join(names)}; the mesh "
                "must have one"
            )
    nodes = model.mesh.getNodes()[0]
    if len(nodes) != nodes.max():
        raise ValueError(
            f"the gmsh model has {len(nodes)} nodes with numbers up to {nodes.max()}: call "
            "gmsh.model.mesh.renumberNodes() before"
        )
