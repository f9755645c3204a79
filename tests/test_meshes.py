"""Meshes of gmsh models: what is read, and what is refused on every rank."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gmsh
import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from scenes.comparing import raised_everywhere

COMM = MPI.COMM_WORLD
pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]
LEFT, RIGHT, BOTTOM, TOP = 3, 4, 5, 6


@pytest.fixture
def model() -> Iterator[Any]:
    """Two rectangles, 2 x 1 and 1 x 1, that share the side at x = 2; on the first rank, meshed."""
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.model.add("plates")
    if COMM.rank == 0:
        occ = gmsh.model.occ
        occ.addRectangle(0, 0, 0, 2, 1, 1)
        occ.addRectangle(2, 0, 0, 1, 1, 2)
        occ.fragment([(2, 1)], [(2, 2)])
        occ.synchronize()
        gmsh.option.setNumber("Mesh.MeshSizeMax", 0.5)
    yield gmsh.model
    gmsh.finalize()


def lines_at(height: float) -> list[int]:
    """Lines of the model at y = ``height``."""
    box = (-1, height - 0.1, -1, 9, height + 0.1, 1)
    return [line for _, line in gmsh.model.getEntitiesInBoundingBox(*box, 1)]


def group(dim: int, entities: list[int], tag: int) -> None:
    if COMM.rank == 0:
        gmsh.model.addPhysicalGroup(dim, entities, tag)


def measure(form: ufl.Form) -> float:
    return COMM.allreduce(fem.assemble_scalar(fem.form(form)))


@pytest.mark.parametrize("order", [1, 2])
def test_tags_of_cells_and_facets(model: Any, order: int) -> None:
    """Each group has the measure of what was put into it."""
    group(2, [1], LEFT), group(2, [2], RIGHT)
    if COMM.rank == 0:
        group(1, lines_at(0), BOTTOM), group(1, lines_at(1), TOP)
        model.mesh.generate(2)
        model.mesh.setOrder(order)
    mesh, cells, facets = fc.model_to_mesh(model if COMM.rank == 0 else None, COMM, gdim=2)
    assert (mesh.topology.dim, mesh.geometry.dim) == (2, 2)
    assert (cells.dim, facets.dim) == (2, 1)
    dx = ufl.Measure("dx", domain=mesh, subdomain_data=cells)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=facets)
    one = fem.Constant(mesh, 1.0)
    for which, size in ((dx(LEFT), 2), (dx(RIGHT), 1), (ds(BOTTOM), 3), (ds(TOP), 3)):
        assert measure(one * which) == pytest.approx(size)
    n_cells = mesh.topology.index_map(2)
    assert np.array_equal(cells.indices, np.arange(n_cells.size_local + n_cells.num_ghosts))


def test_no_group_of_facets(model: Any) -> None:
    """Tags that no facet has."""
    group(2, [1, 2], 1)
    if COMM.rank == 0:
        model.mesh.generate(2)
    _, _, facets = fc.model_to_mesh(model, COMM, 0, 2)
    assert facets.dim == 1 and facets.indices.size == 0


def test_another_rank(model: Any) -> None:
    """The first rank has no model where another one is said to have it."""
    group(2, [1, 2], 1)
    if COMM.rank == 0:
        model.mesh.generate(2)
    wrong = COMM.size - 1
    if wrong:
        raised_everywhere(
            lambda: fc.model_to_mesh(model, COMM, wrong, 2), ValueError, "addPhysicalGroup(2"
        )


def test_what_is_refused(model: Any) -> None:
    """On all ranks, and before the mesh is made."""

    def refused(*words: str) -> None:
        raised_everywhere(lambda: fc.model_to_mesh(model, COMM, gdim=2), ValueError, *words)

    refused("dimensions []", "addPhysicalGroup(2")
    if COMM.rank == 0:
        group(1, lines_at(0), BOTTOM)
    refused("dimensions [1]", "addPhysicalGroup(2")
    group(2, [1], LEFT)
    refused("no cells", "generate(2)")
    if COMM.rank == 0:
        model.mesh.generate(2)
    refused("in no physical group")
    group(2, [1, 2], RIGHT)
    refused("cells", "two physical groups", f"{LEFT} ''", f"{RIGHT} ''", f"dx({LEFT, RIGHT})")
    if COMM.rank == 0:
        model.removePhysicalGroups([(2, LEFT)])
        group(1, lines_at(0), TOP)
        model.setPhysicalName(1, TOP, "lid")
    refused("facets", "two physical groups", f"{TOP} 'lid'", f"mesh, tags, {[BOTTOM, TOP]}")
    if COMM.rank == 0:
        model.removePhysicalGroups([(1, TOP)])
    fc.model_to_mesh(model, COMM, gdim=2)
    if COMM.rank == 0:
        numbers = model.mesh.getNodes()[0].tolist()
        model.mesh.renumberNodes(numbers, [n + 1 for n in numbers])
    refused("renumberNodes")
    if COMM.rank == 0:
        model.mesh.clear()
        model.mesh.setTransfiniteSurface(1)
        model.mesh.setRecombine(2, 1)
        model.mesh.generate(2)
    refused("several types", "Triangle 3", "Quadrilateral 4")
