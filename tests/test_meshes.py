"""Meshes from gmsh models and arrays: valid input, and input that is refused on every rank."""

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
from scenes.comparison import assert_raised_on_all_ranks

COMM = MPI.COMM_WORLD
pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(120)]
LEFT, RIGHT, BOTTOM, TOP = 3, 4, 5, 6


@pytest.fixture
def model() -> Iterator[Any]:
    """Yield rectangles, 2 x 1 and 1 x 1, with a common side at x = 2; on the first rank."""
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
    """Return the lines of the model at y = ``height``."""
    box = (-1, height - 0.1, -1, 9, height + 0.1, 1)
    return [line for _, line in gmsh.model.getEntitiesInBoundingBox(*box, 1)]


def group(dim: int, entities: list[int], tag: int) -> None:
    if COMM.rank == 0:
        gmsh.model.addPhysicalGroup(dim, entities, tag)


def measure(form: ufl.Form) -> float:
    return COMM.allreduce(fem.assemble_scalar(fem.form(form)))


@pytest.mark.parametrize("order", [1, 2])
def test_tags_of_cells_and_facets(model: Any, order: int) -> None:
    """Each tag has the measure of the entities of its group."""
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
    """Without a group of facets no facet is tagged."""
    group(2, [1, 2], 1)
    if COMM.rank == 0:
        model.mesh.generate(2)
    _, _, facets = fc.model_to_mesh(model, COMM, 0, 2)
    assert facets.dim == 1 and facets.indices.size == 0


def test_rank_without_a_model_is_refused(model: Any) -> None:
    """A model on the first rank is refused if another rank is given."""
    group(2, [1, 2], 1)
    if COMM.rank == 0:
        model.mesh.generate(2)
    wrong = COMM.size - 1
    if wrong:
        assert_raised_on_all_ranks(
            lambda: fc.model_to_mesh(model, COMM, wrong, 2), ValueError, "addPhysicalGroup(2"
        )


def test_invalid_models_are_refused(model: Any) -> None:
    """Invalid models are refused on all ranks, before the mesh is created."""

    def refused(*words: str) -> None:
        assert_raised_on_all_ranks(
            lambda: fc.model_to_mesh(model, COMM, gdim=2), ValueError, *words
        )

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


# ---- arrays --------------------------------------------------------------------------------------

# Two squares, 1 x 1, with a common side at x = 1, and a point without a cell.
SQUARES = {
    "points": [[0, 0], [1, 0], [2, 0], [0, 1], [1, 1], [2, 1], [9, 9]],
    "cells": [[0, 1, 4, 3], [1, 2, 5, 4]],
    "cell_type": "quadrilateral",
    "facets": {BOTTOM: [[0, 1], [2, 1]], TOP: [[3, 4]], 0: [[1, 4]]},
    "cell_tags": [LEFT, RIGHT],
}


def from_arrays(rank: int = 0, **changes: Any) -> tuple[Any, Any, Any]:
    """Return the mesh of the squares, with these changes; the arrays are on one rank alone."""
    options = SQUARES | changes
    on_rank = COMM.rank == rank
    arrays = {
        name: options[name] if on_rank else None
        for name in ("points", "cells", "facets", "cell_tags")
    }
    others = {name: value for name, value in options.items() if name not in arrays}
    points, cells = arrays.pop("points"), arrays.pop("cells")
    return fc.mesh_from_arrays(COMM, points, cells, **arrays, **others, rank=rank)


@pytest.mark.parametrize("rank", [0, COMM.size - 1])
def test_arrays_with_tags(rank: int) -> None:
    """Every tag has the measure of its cells or facets, interior facets among them."""
    mesh, cells, facets = from_arrays(rank)
    assert mesh.topology.index_map(2).size_global == 2
    assert mesh.geometry.index_map().size_global == 6
    assert (cells.dim, facets.dim) == (2, 1)
    dx = ufl.Measure("dx", domain=mesh, subdomain_data=cells)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=facets)
    x = ufl.SpatialCoordinate(mesh)
    assert measure(x[0] * dx(LEFT)) == pytest.approx(0.5)
    assert measure(x[0] * dx(RIGHT)) == pytest.approx(1.5)
    assert measure(x[0] * ds(BOTTOM)) == pytest.approx(2.0)
    assert measure(x[0] * ds(TOP)) == pytest.approx(0.5)
    assert len(set(np.concatenate(COMM.allgather(facets.values))) - {BOTTOM, TOP, 0}) == 0
    assert any(COMM.allgather(len(facets.find(0)) == 1))


def test_arrays_in_the_order_of_dolfinx() -> None:
    """In DOLFINx's order the third node of a quadrilateral is opposite to the second."""
    cells = np.array(SQUARES["cells"])[:, [0, 1, 3, 2]]
    mesh, tags, _ = from_arrays(cells=cells, node_order="dolfinx")
    dx = ufl.Measure("dx", domain=mesh, subdomain_data=tags)
    assert measure(ufl.SpatialCoordinate(mesh)[0] * dx(RIGHT)) == pytest.approx(1.5)


def gmsh_grid(kind: str, order: int) -> tuple[Any, Any, Any]:
    """Return points, cells and facets at x = 0 of a unit square or cube, by gmsh on rank 0."""
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    occ, mesh = gmsh.model.occ, gmsh.model.mesh
    dim = 3 if kind in ("tetrahedron", "hexahedron") else 2
    if dim == 3:
        occ.addBox(0, 0, 0, 1, 1, 1)
    else:
        occ.addRectangle(0, 0, 0, 1, 1)
    occ.synchronize()
    for _, line in gmsh.model.getEntities(1):
        mesh.setTransfiniteCurve(line, 3)
    for _, face in gmsh.model.getEntities(2):
        mesh.setTransfiniteSurface(face)
        if kind in ("quadrilateral", "hexahedron"):
            mesh.setRecombine(2, face)
    if dim == 3:
        mesh.setTransfiniteVolume(1)
    mesh.generate(dim)
    mesh.setOrder(order)
    tags, coordinates, _ = mesh.getNodes()
    points = np.empty((int(tags.max()), 3))
    points[tags.astype(int) - 1] = coordinates.reshape(-1, 3)

    def elements(of: int, entity: int = -1) -> Any:
        kinds, _, nodes = mesh.getElements(of, entity)
        return nodes[0].astype(int).reshape(-1, mesh.getElementProperties(kinds[0])[3]) - 1

    box = (-0.1, -0.1, -0.1, 0.1, 1.1, 1.1, dim - 1)
    ((_, side),) = gmsh.model.getEntitiesInBoundingBox(*box)
    arrays = points[:, :dim], elements(dim), elements(dim - 1, side)
    gmsh.finalize()
    return arrays


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("kind", ["triangle", "quadrilateral", "tetrahedron", "hexahedron"])
def test_arrays_of_every_cell_type(kind: str, order: int) -> None:
    """Volume, and area and position of the tagged side, are right in gmsh's node order."""
    points, cells, side = gmsh_grid(kind, order) if COMM.rank == 0 else (None, None, None)
    facets = {LEFT: side, TOP: []} if COMM.rank == 0 else None
    mesh, tags, sides = fc.mesh_from_arrays(
        COMM, points, cells, cell_type=kind, facets=facets, node_order="gmsh"
    )
    dx = ufl.Measure("dx", domain=mesh, subdomain_data=tags)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=sides)
    x = ufl.SpatialCoordinate(mesh)
    assert measure(1.0 * dx(0)) == pytest.approx(1.0)
    assert measure(x[1] ** 2 * ds(LEFT)) == pytest.approx(1 / 3)
    assert measure(x[0] * ds(LEFT)) == pytest.approx(0.0, abs=1e-12)
    if order == 2 or kind in ("quadrilateral", "hexahedron"):
        assert_raised_on_all_ranks(
            lambda: fc.mesh_from_arrays(COMM, points, cells, cell_type=kind, node_order="dolfinx"),
            ValueError,
            "node_order='dolfinx'",
        )


def test_arrays_in_a_contact() -> None:
    """The contact force of two squares on a floor is their weight."""
    mesh, _, facets = from_arrays()
    V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
    u, v = fem.Function(V), ufl.TestFunction(V)
    body = fc.elasticity.LinearElastic(u, E=1e3, nu=0.0, kind="plane strain")
    F = body.residual(v) + 5.0 * v[1] * ufl.dx
    floor, law = fc.HalfSpace((0, 0), (0, 1)), fc.Coulomb(0.3)
    contact = fc.Contact(u, fc.ContactSurface(mesh, facets, BOTTOM), floor, law)
    fc.ContactProblem(F, u, contacts=[contact]).solve()
    assert contact.resultants().normal_force == pytest.approx(10.0)


def test_invalid_arrays_are_refused() -> None:
    """Invalid arrays are refused on all ranks; the error says what was given and what to give."""

    def refused(*words: str, **changes: Any) -> None:
        assert_raised_on_all_ranks(lambda: from_arrays(**changes), ValueError, *words)

    points, cells = SQUARES["points"], np.array(SQUARES["cells"])
    refused("'prism'", "quadrilateral", cell_type="prism")
    refused("'abaqus'", "vtk", node_order="abaqus")
    refused("(7, 3)", "points[:, :2]", points=[[*p, 0] for p in points])
    refused("not finite", "number 1", points=[[0, 0], [np.nan, 0], *points[2:]])
    refused("float64", "whole numbers", cells=cells * 1.0)
    refused("object", "whole numbers", cells=[[0, 1, 4, 3], [1, 2, 5]])
    refused("(0, 4)", "one cell at least", cells=cells[:0])
    refused("8 nodes", "(4, 9)", "serendipity", cells=np.hstack([cells, cells]))
    refused("0 to 9", "7 points", cells=[[0, 1, 4, 9]])
    refused("1 to 7", "subtract 1", cells=[[1, 2, 5, 7]])
    refused("cells[1] = [1, 2, 5, 5]", cells=[[0, 1, 4, 3], [1, 2, 5, 5]])
    refused("no volume", "cells[0]", points=[[x, 0] for x, _ in points])
    refused("2 of 2", "node_order='dolfinx'", node_order="dolfinx")
    refused("shape (1,)", "shape (2,)", cell_tags=[1])
    refused("float64", "whole number", cell_tags=[1.0, 2.0])
    refused("2147483647", cell_tags=[1, 2**31])
    refused("list", "{tag:", facets=[[0, 1]])
    refused("'floor'", "whole numbers", facets={"floor": [[0, 1]]})
    refused("facets[5]", "(2,)", facets={BOTTOM: [0, 1]})
    refused("facets[5]", "shape (n_facets, 2)", facets={BOTTOM: [[0]]})
    refused("facets[5]", "0 to 8", facets={BOTTOM: [[0, 8]]})
    refused("facets[5] has 1 facets", "[[0, 4]]", facets={BOTTOM: [[0, 1], [4, 0]]})
    refused("two tags", "[0, 1]", "[5, 6]", facets={BOTTOM: [[0, 1]], TOP: [[1, 0]]})
    assert_raised_on_all_ranks(
        lambda: fc.mesh_from_arrays(COMM, points, cells, cell_type="quadrilateral", rank=99),
        ValueError,
        "rank is 99",
    )


def test_arrays_by_meshio(tmp_path: Any) -> None:
    """Arrays that meshio reads from an Abaqus file are accepted, as the documentation shows."""
    meshio = pytest.importorskip("meshio")
    file = COMM.bcast(tmp_path / "squares.inp")
    arrays = (None, None, None)
    if COMM.rank == 0:
        blocks = [("quad", SQUARES["cells"]), ("line", SQUARES["facets"][BOTTOM])]
        data = {"tags": [[LEFT, RIGHT], [BOTTOM, BOTTOM]]}
        meshio_mesh = meshio.Mesh(np.array(SQUARES["points"], dtype=float), blocks, cell_data=data)
        meshio.write(file, meshio_mesh)
        read = meshio.read(file)
        arrays = read.points[:, :2], read.cells_dict["quad"], {BOTTOM: read.cells_dict["line"]}
    points, cells, facets = arrays
    mesh, _, tags = fc.mesh_from_arrays(
        COMM, points, cells, cell_type="quadrilateral", facets=facets
    )
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags)
    assert measure(1.0 * ds(BOTTOM)) == pytest.approx(2.0)
