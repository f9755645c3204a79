"""Tags of boundary facets, selected by the coordinates of their nodes or midpoints."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import dolfinx
import numpy as np

from fenics_contact.types import Array

# Selects facets by the midpoints of the facets and of their cells, both (n, d).
FacetSelector = Callable[[Array, Array], Array]


# ---- by nodes ------------------------------------------------------------------------------------


def tag_by_nodes(
    mesh: dolfinx.mesh.Mesh, where: Mapping[int, Callable[[Array], Array]]
) -> dolfinx.mesh.MeshTags:
    """Return tags of the facets all of whose nodes (3, n) are selected. Collective."""
    dim = mesh.topology.dim - 1
    mesh.topology.create_entities(dim)
    found = {t: dolfinx.mesh.locate_entities_boundary(mesh, dim, at) for t, at in where.items()}
    facets = np.concatenate(list(found.values()))
    values = np.repeat(np.array(list(found), dtype=np.int32), [len(f) for f in found.values()])
    # A facet that is selected several times has the last of its tags.
    facets, first = np.unique(facets[::-1], return_index=True)
    return dolfinx.mesh.meshtags(mesh, dim, facets, values[::-1][first])


def plane(i: int, value: float) -> Callable[[Array], Array]:
    """Return a selector of the nodes with x_i = ``value``."""
    return lambda x: np.isclose(x[i], value)


# ---- by midpoints --------------------------------------------------------------------------------


def tag_by_midpoints(
    mesh: dolfinx.mesh.Mesh, where: Mapping[int, FacetSelector]
) -> dolfinx.mesh.MeshTags:
    """Return tags of facets selected by midpoints; the last selector has priority. Collective."""
    d = mesh.topology.dim
    mesh.topology.create_connectivity(d - 1, d)
    to_cell = mesh.topology.connectivity(d - 1, d)
    exterior = dolfinx.mesh.exterior_facet_indices(mesh.topology)
    owner = np.array([to_cell.links(f)[0] for f in exterior], dtype=np.int32)
    middle = dolfinx.mesh.compute_midpoints(mesh, d - 1, exterior).reshape(-1, 3)[:, :d]
    cell = dolfinx.mesh.compute_midpoints(mesh, d, owner).reshape(-1, 3)[:, :d]
    values = np.zeros(len(exterior), dtype=np.int32)
    for tag, chosen in where.items():
        values[chosen(middle, cell)] = tag
    kept = values > 0
    return dolfinx.mesh.meshtags(mesh, d - 1, exterior[kept], values[kept])


def at_coordinate(i: int, value: float) -> FacetSelector:
    """Return a selector of the facets whose midpoints have x_i = ``value``, within 1e-9."""
    return lambda x, cell: np.abs(x[:, i] - value) < 1e-9


def at_interface(i: int, value: float, *, above: bool) -> FacetSelector:
    """Return a selector of the facets at x_i = ``value`` whose cells are on one side of it."""
    side = 1 if above else -1
    return lambda x, cell: at_coordinate(i, value)(x, cell) & (side * (cell[:, i] - value) > 0)


def any_of(*choices: FacetSelector) -> FacetSelector:
    """Return a selector of the facets that at least one of the given selectors selects."""
    return lambda x, cell: np.any([choice(x, cell) for choice in choices], axis=0)
