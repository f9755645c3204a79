"""Tests of joined meshes: their cells and facets, their tags, and refused parts.

Volumes and areas equal those of the parts, summed in another order, to 1e-12.
"""

from __future__ import annotations

from typing import Any

import basix.ufl
import dolfinx
import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import CellType, GhostMode
from mpi4py import MPI

import fenics_contact as fc
from scenes.blocks import BOTTOM, CELLS, LEFT, TOP, block_mesh, dimension
from scenes.comparison import assert_raised_on_all_ranks
from scenes.meshes import create_mesh, partition_from_owners

COMM = MPI.COMM_WORLD
pytestmark = [
    pytest.mark.hexahedra,
    pytest.mark.three_ranks,
    pytest.mark.timeout(120),
]
EXACT = 1e-12
LOWER_HALF, REST = 7, 3


def measure_arguments(
    mesh: dolfinx.mesh.Mesh, tags: dolfinx.mesh.MeshTags, tag: Any
) -> dict[str, Any]:
    """Return measure arguments for one or several tags, renumbered to 1 so that forms are equal."""
    selected = tags.indices[np.isin(tags.values, tag)]
    ones = dolfinx.mesh.meshtags(mesh, tags.dim, selected, np.ones(len(selected), dtype=np.int32))
    return {"subdomain_data": ones, "subdomain_id": 1}


def measure(mesh: dolfinx.mesh.Mesh, tags: dolfinx.mesh.MeshTags, tag: Any) -> float:
    """Return the length, area or volume of the entities with a tag."""
    kind = "dx" if tags.dim == mesh.topology.dim else "ds"
    return integrate(
        fem.Constant(mesh, 1.0)
        * ufl.Measure(kind, domain=mesh, **measure_arguments(mesh, tags, tag))
    )


def integrate(form: ufl.Form) -> float:
    """Return the integral of a form over all ranks."""
    return COMM.allreduce(fem.assemble_scalar(fem.form(form)))


def volume(mesh: dolfinx.mesh.Mesh) -> float:
    """Return the volume of all cells."""
    return integrate(fem.Constant(mesh, 1.0) * ufl.dx)


def centre(mesh: dolfinx.mesh.Mesh, tags: dolfinx.mesh.MeshTags, tag: Any) -> np.ndarray:
    """Return the integral of the coordinates over the cells with a tag."""
    x = ufl.SpatialCoordinate(mesh)
    dx = ufl.Measure("dx", domain=mesh, **measure_arguments(mesh, tags, tag))
    return np.array([integrate(x[i] * dx) for i in range(mesh.geometry.dim)])


def lower_half(mesh: dolfinx.mesh.Mesh, *, all_cells: bool = True) -> dolfinx.mesh.MeshTags:
    """Tag cells with a low midpoint as LOWER_HALF, and the others as REST or not at all."""
    d = mesh.topology.dim
    cells = mesh.topology.index_map(d)
    cell_indices = np.arange(cells.size_local + cells.num_ghosts, dtype=np.int32)
    middle = dolfinx.mesh.compute_midpoints(mesh, d, cell_indices).reshape(-1, 3)[:, d - 1]
    values = np.where(middle < 0.45, LOWER_HALF, REST).astype(np.int32)
    selected = all_cells | (values == LOWER_HALF)
    return dolfinx.mesh.meshtags(mesh, d, cell_indices[selected], values[selected])


def bend(x: np.ndarray) -> np.ndarray:
    """Bulge the top by a parabola."""
    moved = x.copy()
    moved[:, -1] += 0.2 * x[:, -1] * x[:, 0] * (1 - x[:, 0])
    return moved


@pytest.mark.parametrize(
    ("curved", "ghost_mode"),
    [(False, GhostMode.shared_facet), (True, GhostMode.none)],
    ids=["straight", "curved"],
)
@pytest.mark.parametrize("cell", CELLS)
def test_measures_by_tag_agree_with_those_of_the_parts(
    cell: str, curved: bool, ghost_mode: GhostMode
) -> None:
    """Two blocks coincide, and in one of them only half of the cells are tagged."""
    options = {"shuffled": not curved, "ghost_mode": ghost_mode, "bend": bend if curved else None}
    parts = {}
    for name, n in (("coarse", 2), ("fine", 3)):
        mesh, sides = block_mesh(cell, n=n, **options)
        parts[name] = mesh, lower_half(mesh, all_cells=name == "fine"), sides
    joined = fc.join_meshes(parts)
    d = dimension(cell)
    assert joined.bodies == ("coarse", "fine")
    assert joined.mesh.topology.index_map(d).num_ghosts == 0
    for kind, numbers in (
        (joined.cells, joined.cell_numbers),
        (joined.facets, joined.facet_numbers),
    ):
        tags_of_parts = [number for body in joined.bodies for number in numbers[body].values()]
        assert tags_of_parts == list(range(1, len(tags_of_parts) + 1))
        present = np.unique(np.concatenate(COMM.allgather(kind.values)))
        assert present.tolist() == tags_of_parts
    for name, (mesh, halves, sides) in parts.items():
        for tag in (LOWER_HALF, REST) if name == "fine" else (LOWER_HALF,):
            new = joined.cell(name, tag)
            expected = measure(mesh, halves, tag)
            assert measure(joined.mesh, joined.cells, new) == pytest.approx(expected, rel=EXACT)
            computed = centre(joined.mesh, joined.cells, new)
            assert computed == pytest.approx(centre(mesh, halves, tag), rel=EXACT)
        for tag in (BOTTOM, TOP, LEFT):
            expected = measure(mesh, sides, tag)
            computed = measure(joined.mesh, joined.facets, joined.facet(name, tag))
            assert computed == pytest.approx(expected, rel=EXACT)
        total = volume(mesh)
        assert total > 1 if curved else total == pytest.approx(1)
        computed = measure(joined.mesh, joined.cells, joined.body(name))
        assert computed == pytest.approx(total, rel=EXACT)


@pytest.mark.parametrize("cell", CELLS)
def test_coinciding_nodes_are_not_merged(cell: str) -> None:
    """A mesh joined with itself has twice its nodes, vertices and boundary facets."""
    mesh, _ = block_mesh(cell)
    d = mesh.topology.dim
    joined = fc.join_meshes([mesh, mesh]).mesh
    sizes = []
    for one in (mesh, joined):
        one.topology.create_connectivity(d - 1, d)
        exterior = dolfinx.mesh.exterior_facet_indices(one.topology)
        owned = exterior[exterior < one.topology.index_map(d - 1).size_local]
        nodes, vertices = one.geometry.index_map().size_global, one.topology.index_map(0)
        sizes.append([nodes, vertices.size_global, COMM.allreduce(len(owned))])
    assert sizes[1] == [2 * size for size in sizes[0]]


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_interior_facets_keep_their_tag(cell: str) -> None:
    """Tags of a line in the middle, given on one rank for each facet, are known on all ranks."""
    mesh, _ = block_mesh(cell, n=4)
    inner = dolfinx.mesh.locate_entities(mesh, 1, lambda x: np.isclose(x[1], 0.5))
    inner = inner[inner < mesh.topology.index_map(1).size_local]
    tags = dolfinx.mesh.meshtags(mesh, 1, inner, np.full(len(inner), 5, dtype=np.int32))
    other, sides = block_mesh(cell, n=3)
    joined = fc.join_meshes([(other, None, sides), (mesh, None, tags)])
    new = joined.facet(1, 5)
    tagged = joined.facets.find(new)
    n_owned = joined.mesh.topology.index_map(1).size_local
    assert COMM.allreduce(np.count_nonzero(tagged < n_owned)) == 4
    # Every rank that has such a facet knows its tag.
    interior_facets = dolfinx.mesh.locate_entities(joined.mesh, 1, lambda x: np.isclose(x[1], 0.5))
    assert np.all(COMM.allgather(np.array_equal(np.sort(tagged), np.sort(interior_facets))))


def test_cubic_geometry_keeps_its_volume() -> None:
    """The order of the nodes on edges is kept, so that the volume of each part is the same."""
    nodes = np.array([[0.0, 0], [1, 0], [0, 1], [1, 1]])
    cells = np.array([[0, 1, 2], [3, 2, 1]])
    serial = create_mesh("triangle", nodes, cells, comm=MPI.COMM_SELF)
    places = fem.functionspace(serial, ("Lagrange", 3))
    x = places.tabulate_dof_coordinates()[:, :2]
    bent = x.copy()
    bent[:, 1] *= 1 + 0.3 * x[:, 0] * (1 - x[:, 0] ** 2)  # a cubic top, area 1 + 0.3 / 4
    mesh = create_mesh("triangle", bent, places.dofmap.list, degree=3)
    one = volume(mesh)
    joined = fc.join_meshes([mesh, mesh])
    for i in (0, 1):
        computed = measure(joined.mesh, joined.cells, joined.body(i))
        assert computed == pytest.approx(one, rel=EXACT)
    assert one == pytest.approx(1.075)


def test_values_by_body() -> None:
    """The integral of values by body is the sum over the bodies; wrong values are refused."""
    meshes = [block_mesh("triangle", n=n, size=(1, h))[0] for n, h in ((2, 1.0), (3, 2.0))]
    joined = fc.join_meshes(meshes)
    assert joined.bodies == (0, 1)
    field = joined.by_body({0: 5.0, 1: 7.0})
    assert integrate(field * ufl.dx) == pytest.approx(5 * 1 + 7 * 2)
    for values, words in (
        ({0: 5.0}, ["[0]", "[0, 1]"]),
        (5.0, ["5.0", "dict"]),
        ({0: 5.0, 1: "7"}, ["body 1", "'7'"]),
    ):
        assert_raised_on_all_ranks(lambda values=values: joined.by_body(values), ValueError, *words)


def test_cells_are_redistributed_over_the_ranks() -> None:
    """Cells that are all on the last rank are redistributed; ranks without cells are allowed."""

    def on_the_last(comm: MPI.Comm, n: int, types: Any, cells: Any) -> Any:
        return partition_from_owners(np.full(cells[0].size // 4, n - 1))

    mesh, sides = block_mesh("quadrilateral", n=6, partitioner=on_the_last)
    joined = fc.join_meshes({"a": (mesh, None, sides), "b": (mesh, None, sides)})
    for body in "ab":
        for tag in (BOTTOM, TOP, LEFT):
            size = measure(joined.mesh, joined.facets, joined.facet(body, tag))
            assert size == pytest.approx(1)
    if COMM.size > 1:
        assert min(COMM.allgather(joined.mesh.topology.index_map(2).size_local)) > 0


def test_unknown_bodies_and_tags_are_refused() -> None:
    """The error lists the existing bodies or tags."""
    mesh, sides = block_mesh("triangle")
    joined = fc.join_meshes({"block": (mesh, None, sides)})
    assert_raised_on_all_ranks(lambda: joined.facet("ball", 1), ValueError, "'ball'", "['block']")
    assert_raised_on_all_ranks(
        lambda: joined.facet("block", 9), ValueError, "tag 9", "[1, 2, 3, 4]"
    )
    several: Any = [1, 2]
    assert_raised_on_all_ranks(lambda: joined.facet("block", several), ValueError, "tag [1, 2]")
    assert_raised_on_all_ranks(lambda: joined.cell("block", 1), ValueError, "cell", "tag 1", "[]")
    assert_raised_on_all_ranks(lambda: joined.body(0), ValueError, "body 0", "['block']")


def quadratic(cell: str) -> dolfinx.mesh.Mesh:
    """Return a block of geometric degree 2."""
    return block_mesh(cell, bend=lambda x: x)[0]


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (lambda: block_mesh("quadrilateral")[0], ["triangle", "quadrilateral"]),
        (lambda: quadratic("triangle"), ["degree 1", "degree 2"]),
        (lambda: block_mesh("tetrahedron")[0], ["2 dimensions", "3 dimensions"]),
    ],
    ids=["cell", "degree", "dimension"],
)
def test_incompatible_meshes_are_refused(other: Any, words: list[str]) -> None:
    """The error names both meshes and their difference."""
    parts = {"upper": block_mesh("triangle")[0], "lower": other()}
    assert_raised_on_all_ranks(
        lambda: fc.join_meshes(parts), ValueError, "'upper'", "'lower'", *words
    )


@pytest.mark.skipif(COMM.size == 1, reason="one rank is all ranks")
def test_meshes_of_another_communicator_are_refused() -> None:
    """A mesh of one rank alone cannot be joined with a mesh of all ranks."""
    serial_mesh = dolfinx.mesh.create_unit_square(MPI.COMM_SELF, 1, 1, CellType.triangle)
    parts = [block_mesh("triangle")[0], serial_mesh]
    words = f"{COMM.size} ranks", "on 1", "communicator"
    assert_raised_on_all_ranks(lambda: fc.join_meshes(parts), ValueError, *words)


def test_wrong_parts_are_refused() -> None:
    """The error names the given argument and the expected one."""
    mesh, sides = block_mesh("triangle")
    cells = mesh.topology.index_map(2)
    cell_indices = np.arange(cells.size_local + cells.num_ghosts, dtype=np.int32)
    halves = dolfinx.mesh.meshtags(mesh, 2, cell_indices, np.full(len(cell_indices), 0.5))
    other, far = block_mesh("triangle", n=20)[0], None
    n = other.topology.index_map(1)
    last = np.array([n.size_local + n.num_ghosts - 1], dtype=np.int32)
    far = dolfinx.mesh.meshtags(other, 1, last, np.ones(1, dtype=np.int32))
    for parts, words in (
        ([], ["empty"]),
        (3, ["parts is a int"]),
        ([None], ["body 0 is a NoneType", "facet_tags"]),
        ([(mesh, None, sides, 1)], ["tuple of (Mesh, NoneType, MeshTags, int)"]),
        ([(sides,)], ["mesh of body 0", "MeshTags"]),
        ([(mesh, sides)], ["cell_tags", "dimension 1", "dimension 2", "(mesh, cell_tags"]),
        ([(mesh, None, 4)], ["facet_tags of body 0", "int"]),
        ([(mesh, halves)], ["float64", "integers"]),
    ):
        assert_raised_on_all_ranks(lambda parts=parts: fc.join_meshes(parts), ValueError, *words)
    with pytest.raises(ValueError, match=r"facet_tags of body 0 have the index .* of this mesh"):
        fc.join_meshes([(mesh, None, far)])


def test_meshes_with_different_node_variants_are_refused() -> None:
    """Nodes of degree 3 depend on the variant: the meshes are refused, the nodes not moved."""
    x, cells = np.array([[0.0, 0], [1, 0], [0, 1]]), np.array([[0, 1, 2]])
    serial = create_mesh("triangle", x, cells, comm=MPI.COMM_SELF)
    meshes = []
    for variant in (basix.LagrangeVariant.gll_warped, basix.LagrangeVariant.equispaced):
        element = basix.ufl.element("Lagrange", "triangle", 3, lagrange_variant=variant)
        space = fem.functionspace(serial, element)
        nodes, list_ = space.tabulate_dof_coordinates()[:, :2], space.dofmap.list
        if COMM.rank:
            nodes, list_ = nodes[:0], list_[:0]
        vector = basix.ufl.blocked_element(element, shape=(2,))
        meshes.append(
            dolfinx.mesh.create_mesh(
                COMM, cells=list_.astype(np.int64), x=nodes, e=ufl.Mesh(vector)
            )
        )
    assert_raised_on_all_ranks(
        lambda: fc.join_meshes(meshes), ValueError, "gll_warped", "equispaced"
    )
