"""ContactSurface: facets, measure and quadrature points; ghosts and ranks without contact."""

import basix
import dolfinx
import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx.mesh import GhostMode
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.surface.facets import facet_cells, facet_nodes
from scenes.blocks import (
    BACK,
    BOTTOM,
    CELLS,
    FRONT,
    GRID,
    LEFT,
    RIGHT,
    TOP,
    block_mesh,
    dimension,
    layer_partitioner,
)
from scenes.comparison import (
    assemble_scalar,
    assert_raised_on_all_ranks,
    compile_with_maps,
    gather,
    is_close,
    sort_by_coordinates,
)
from scenes.elasticity import displacement_space

pytestmark = [
    pytest.mark.hexahedra,
    pytest.mark.three_ranks,
    pytest.mark.timeout(120),
]
COMM = MPI.COMM_WORLD


def contact_on(surface: fc.ContactSurface, degree: int) -> fc.Contact:
    """Return a cheap contact, whose evaluation gives the coordinates of the points."""
    d = surface.mesh.geometry.dim
    u = fem.Function(displacement_space(surface.mesh, degree))
    up = np.eye(d)[-1]
    return fc.Contact(u, surface, fc.HalfSpace(np.zeros(d), up), fc.Frictionless(k_n=1.0))


def facet_rule(cell: str, degree: int) -> tuple[np.ndarray, np.ndarray, basix.CellType]:
    """Return Gauss points and weights on the reference facet from basix."""
    facet = {"triangle": "interval", "quadrilateral": "interval"}.get(
        cell, {"tetrahedron": "triangle", "hexahedron": "quadrilateral"}.get(cell)
    )
    kind = basix.CellType[facet]
    points, weights = basix.make_quadrature(kind, degree)
    return points, weights, kind


def facet_vertices(mesh: dolfinx.mesh.Mesh, facets: np.ndarray) -> np.ndarray:
    """Return the coordinates of the vertices of facets, shape (n_facets, n_vertices, gdim)."""
    d = mesh.geometry.dim
    mesh.topology.create_connectivity(d - 1, d)
    mesh.topology.create_connectivity(d, d - 1)
    if not facets.size:  # DOLFINx 0.9 crashes on an empty list
        return np.zeros((0, 2, d))
    return mesh.geometry.x[dolfinx.mesh.entities_to_geometry(mesh, d - 1, facets), :d]


def expected_points(
    mesh: dolfinx.mesh.Mesh, facets: np.ndarray, rule: tuple
) -> tuple[np.ndarray, np.ndarray]:
    """Map the rule to flat facets by their vertices, in numpy: points and weights of this rank."""
    points, weights, kind = rule
    d = mesh.geometry.dim
    shape = basix.create_element(basix.ElementFamily.P, kind, 1).tabulate(1, points)
    nodes = facet_vertices(mesh, facets)
    x, w = [], []
    for vertices in nodes:
        x.append(shape[0, :, :, 0] @ vertices)
        jacobian = np.stack([shape[1 + i, :, :, 0] @ vertices for i in range(d - 1)], axis=-1)
        gram = np.einsum("qia,qib->qab", jacobian, jacobian)
        w.append(weights * np.sqrt(np.linalg.det(gram)))
    n = len(points)
    return np.reshape(x, (len(nodes) * n, d)), np.reshape(w, len(nodes) * n)


@pytest.mark.parametrize("ghost_mode", [GhostMode.none, GhostMode.shared_facet])
@pytest.mark.parametrize(("cell", "degree"), GRID)
def test_points_and_weights_are_those_of_gauss(cell, degree, ghost_mode):
    """The points are the Gauss points of degree 2p, each once; reference: basix and numpy.

    Tolerance 1e-12: round-off of a quotient of two assembled sums of size one.
    """
    mesh, tags = block_mesh(cell, shuffled=True, ghost_mode=ghost_mode)
    surface = fc.ContactSurface(mesh, tags, [BOTTOM, RIGHT])
    contact = contact_on(surface, degree)
    assert contact.quadrature.degree == 2 * degree
    rule = facet_rule(cell, 2 * degree)
    x, w = expected_points(mesh, surface.facets, rule)
    assert COMM.allreduce(contact.quadrature.n_points) == COMM.allreduce(len(w))
    actual = sort_by_coordinates(
        gather(COMM, contact.points), gather(COMM, contact.quadrature.weights)
    )
    expected = sort_by_coordinates(gather(COMM, x), gather(COMM, w))
    assert is_close(actual, expected, 1e-12, scale=1.0)


@pytest.mark.parametrize("cell", CELLS)
def test_facets_are_those_with_the_tags(cell):
    """Every facet with one of the tags is owned by one rank; the area is that of the sides."""
    mesh, tags = block_mesh(cell, shuffled=True, ghost_mode=GhostMode.shared_facet)
    sides = {2: [BOTTOM, LEFT, RIGHT, TOP], 3: [BOTTOM, LEFT, RIGHT, TOP, FRONT, BACK]}
    per_side = {"triangle": 2, "quadrilateral": 2, "tetrahedron": 8, "hexahedron": 4}[cell]
    d = dimension(cell)
    n_owned = mesh.topology.index_map(d - 1).size_local
    for tags_wanted in (sides[d][:1], sides[d][1:3], sides[d]):
        surface = fc.ContactSurface(mesh, tags, tags_wanted)
        assert all(COMM.allgather(bool(np.all(surface.facets < n_owned))))
        assert COMM.allreduce(surface.facets.size) == per_side * len(tags_wanted)
        one = fem.Constant(mesh, 1.0)
        area = assemble_scalar(compile_with_maps(one * surface.measure(2)), COMM)
        assert abs(area - len(tags_wanted)) <= 1e-13 * len(tags_wanted)
        weights = gather(COMM, surface.quadrature(1).weights)
        # The weights sum to the area: 1e-13 is the round-off of a sum of 50 terms.
        assert abs(weights.sum() - len(tags_wanted)) <= 1e-13 * len(tags_wanted)


def test_tags_can_be_a_number_or_a_sequence():
    """A tag and a list of it give the same facets."""
    mesh, tags = block_mesh("triangle")
    one = fc.ContactSurface(mesh, tags, BOTTOM)
    listed = fc.ContactSurface(mesh, tags, [BOTTOM])
    assert all(COMM.allgather(bool(np.array_equal(one.facets, listed.facets))))


@pytest.mark.parametrize("cell", CELLS)
def test_quadrature_degree_is_settable(cell):
    """A degree given by the user replaces the default, and is exact for its polynomials.

    Reference: the integral of x^5 over the unit side, 1/6, by the weights; round-off 1e-13. The
    facets are affine here, so that the integrand has the degree of the polynomial.
    """
    mesh, tags = block_mesh(cell)
    contact = contact_on(fc.ContactSurface(mesh, tags, BOTTOM, quadrature_degree=5), 1)
    assert contact.quadrature.degree == 5
    rule = facet_rule(cell, 5)
    n_facets = COMM.allreduce(contact.surface.facets.size)
    assert COMM.allreduce(contact.quadrature.n_points) == len(rule[1]) * n_facets
    moment = COMM.allreduce(float(contact.quadrature.weights @ contact.points[:, 0] ** 5))
    assert abs(moment - 1 / 6) <= 1e-13
    # The default rule of degree 2 is not exact: the degree has an effect.
    coarse = contact_on(fc.ContactSurface(mesh, tags, BOTTOM), 1)
    moment = COMM.allreduce(float(coarse.quadrature.weights @ coarse.points[:, 0] ** 5))
    assert abs(moment - 1 / 6) > 1e-5


@pytest.mark.parametrize("cell", CELLS)
def test_vertex_scheme_has_its_points_at_the_vertices(cell):
    """Scheme "vertex": each facet has one point at each of its vertices, with equal weights."""
    mesh, tags = block_mesh(cell, shuffled=True)
    surface = fc.ContactSurface(mesh, tags, BOTTOM, quadrature_scheme="vertex")
    contact = contact_on(surface, 1)
    d = dimension(cell)
    vertices = facet_vertices(mesh, surface.facets).reshape(-1, d)
    actual = sort_by_coordinates(gather(COMM, contact.points))
    assert is_close(actual, sort_by_coordinates(gather(COMM, vertices)), 1e-12, scale=1.0)
    weights = gather(COMM, contact.quadrature.weights)
    assert abs(weights.sum() - 1.0) <= 1e-12
    assert weights.min() > 0


@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_ranks_without_contact_facets(cell):
    """If Γc is on one rank only, the others have no points, and all ranks the same results."""
    d = dimension(cell)
    counts = (1, 6) if d == 2 else (1, 1, 6)
    mesh, tags = block_mesh(cell, n=counts, partitioner=layer_partitioner(cell))
    surface = fc.ContactSurface(mesh, tags, BOTTOM)
    contact = contact_on(surface, 1)
    holders = COMM.allgather(contact.quadrature.n_points)
    assert sorted(holders) == [0] * (COMM.size - 1) + [2 if d == 2 else 4]
    contact.u.interpolate(lambda x: np.vstack([0 * x[0]] * (d - 1) + [0 * x[0] - 0.25]))
    contact.evaluate()
    # Pressure k_n * 0.25 on the unit side; exact but for the sum of the weights.
    results = COMM.allgather(contact.resultants())
    for r in results:
        assert abs(r.normal_force - 0.25) <= 1e-14
        assert abs(r.area - 1.0) <= 1e-14
        assert r.max_penetration == pytest.approx(0.25, rel=1e-14)
    contact.commit()
    form = compile_with_maps(contact.form(ufl.TestFunction(contact.u.function_space)), contact)
    vector = fem.Function(contact.u.function_space)
    fem.assemble_vector(vector.x.array, form)
    # The residual is minus the force on the body.
    total = COMM.allreduce(float(vector.x.array.reshape(-1, d)[:, -1].sum()))
    assert abs(total + 0.25) <= 1e-14


@pytest.mark.parametrize("cell", CELLS)
def test_curved_geometry(cell):
    """Points and area of cells of geometric degree 2 are those of a parabolic bottom.

    Quadratic cells of equal width represent the height y = c x² exactly: points agree to 1e-12. The
    arc length by the rule of degree 12 agrees with the formula to 1e-6, the error of the rule.
    """
    c, d = 0.3, dimension(cell)

    def bend(x):
        x = x.copy()
        x[:, -1] += c * (1 - x[:, -1]) * x[:, 0] ** 2
        return x

    mesh, tags = block_mesh(cell, bend=bend)
    surface = fc.ContactSurface(mesh, tags, BOTTOM, quadrature_degree=12)
    contact = contact_on(surface, 2)
    x = gather(COMM, contact.points)
    assert is_close(x[:, -1], c * x[:, 0] ** 2, 1e-12, scale=1.0)
    assert 0 < x[:, 0].min() < 0.1 and 0.9 < x[:, 0].max() < 1
    slope = 2 * c
    arc = (np.sqrt(1 + slope**2) + np.arcsinh(slope) / slope) / 2
    area = COMM.allreduce(float(contact.quadrature.weights.sum()))
    assert abs(area - arc) <= 1e-6
    # The gap above the floor y = 0 is the height, and a displacement is evaluated at the points.
    assert is_close(gather(COMM, contact.gap), x[:, -1], 1e-12, scale=1.0)
    contact.u.interpolate(lambda x: np.vstack([0.1 * x[0]] * d))
    contact.evaluate()
    assert is_close(gather(COMM, contact.gap), x[:, -1] + 0.1 * x[:, 0], 1e-12, scale=1.0)


# ---- invalid input -------------------------------------------------------------------------------


def test_unknown_tag_is_refused():
    """The message states the unknown tag and the existing ones."""
    mesh, tags = block_mesh("triangle")
    assert_raised_on_all_ranks(
        lambda: fc.ContactSurface(mesh, tags, 99), ValueError, "99", "[1, 2, 3, 4]"
    )
    assert_raised_on_all_ranks(
        lambda: fc.ContactSurface(mesh, tags, [BOTTOM, 99]), ValueError, "99"
    )


def test_empty_list_of_tags_is_refused():
    """An empty list of tags gives an empty Γc, which is an error."""
    mesh, tags = block_mesh("triangle")
    assert_raised_on_all_ranks(lambda: fc.ContactSurface(mesh, tags, []), ValueError, "empty")


@pytest.mark.parametrize("ghost_mode", [GhostMode.none, GhostMode.shared_facet])
@pytest.mark.parametrize("cell", CELLS)
def test_interior_facets_are_refused(cell, ghost_mode):
    """Interior facets of the body raise an error on all ranks, with and without ghost cells."""
    mesh, _ = block_mesh(cell, ghost_mode=ghost_mode)
    d = dimension(cell)
    facets = dolfinx.mesh.locate_entities(mesh, d - 1, lambda x: np.isclose(x[d - 1], 0.5))
    values = np.full(facets.size, 7, dtype=np.int32)
    tags = dolfinx.mesh.meshtags(mesh, d - 1, np.sort(facets), values)
    assert_raised_on_all_ranks(
        lambda: fc.ContactSurface(mesh, tags, 7), ValueError, "interior facets", "7"
    )


def test_one_interior_facet_on_one_rank_only():
    """One interior facet among exterior ones, tagged on its owner only, raises on all ranks."""
    mesh, tags = block_mesh("quadrilateral", n=(2, 6), ghost_mode=GhostMode.shared_facet)
    inside = dolfinx.mesh.locate_entities(
        mesh, 1, lambda x: np.isclose(x[1], 5 / 6) & (x[0] < 0.5 + 1e-9)
    )
    inside = inside[inside < mesh.topology.index_map(1).size_local]
    facets = np.concatenate([tags.find(BOTTOM), inside]).astype(np.int32)
    assert COMM.allreduce(inside.size) == 1
    tags = dolfinx.mesh.meshtags(mesh, 1, np.sort(facets), np.full(facets.size, 7, dtype=np.int32))
    assert_raised_on_all_ranks(
        lambda: fc.ContactSurface(mesh, tags, 7), ValueError, "interior facets"
    )


def test_wrong_surface_arguments():
    """Errors for cell tags, an unknown scheme and a degree below one name the argument."""
    mesh, tags = block_mesh("triangle")
    n_cells = mesh.topology.index_map(2).size_local
    cells = np.arange(n_cells, dtype=np.int32)
    cell_tags = dolfinx.mesh.meshtags(mesh, 2, cells, np.full(n_cells, BOTTOM, dtype=np.int32))
    surface = fc.ContactSurface
    assert_raised_on_all_ranks(lambda: surface(mesh, cell_tags, BOTTOM), ValueError, "facet_tags")
    assert_raised_on_all_ranks(
        lambda: surface(mesh, tags, BOTTOM, quadrature_scheme="lobatto"), ValueError, "lobatto"
    )
    assert_raised_on_all_ranks(
        lambda: surface(mesh, tags, BOTTOM, quadrature_degree=0), ValueError, "quadrature_degree"
    )


def test_surface_mesh_in_3d_is_refused():
    """Contact of the edges of a surface mesh in 3D is not supported."""
    mesh, _ = block_mesh("tetrahedron")
    mesh.topology.create_connectivity(2, 3)
    facets = dolfinx.mesh.exterior_facet_indices(mesh.topology)
    shell = dolfinx.mesh.create_submesh(mesh, 2, facets)[0]
    shell.topology.create_entities(1)
    edges = np.arange(shell.topology.index_map(1).size_local, dtype=np.int32)
    tags = dolfinx.mesh.meshtags(shell, 1, edges, np.full(edges.size, BOTTOM, dtype=np.int32))
    assert_raised_on_all_ranks(
        lambda: fc.ContactSurface(shell, tags, BOTTOM), ValueError, "dimension"
    )


def test_prisms_are_refused_by_name():
    """Prisms have facets of two types, which DOLFINx cannot tag: the error names the cell type."""
    unit = (np.zeros(3), np.ones(3))
    mesh = dolfinx.mesh.create_box(COMM, unit, (1, 1, 1), dolfinx.mesh.CellType.prism)
    none = np.zeros(0, dtype=np.int32)
    tags = dolfinx.mesh.meshtags(mesh, 2, none, none)
    assert_raised_on_all_ranks(
        lambda: fc.ContactSurface(mesh, tags, 1), ValueError, "prism", "hexahedron"
    )
    assert_raised_on_all_ranks(lambda: fc.join_meshes([mesh]), ValueError, "prism", "hexahedron")


@pytest.mark.parametrize(("cell", "degree"), GRID)
def test_cells_and_nodes_of_facets(cell, degree):
    """Cells and nodes of facets are those of DOLFINx, in the order of the given facets."""
    mesh, tags = block_mesh(cell, n=3, shuffled=True)
    fdim, space = mesh.topology.dim - 1, displacement_space(mesh, degree)
    facets = fc.ContactSurface(mesh, tags, [BOTTOM, RIGHT]).facets[::-1]
    cells, nodes = facet_cells(mesh, facets), facet_nodes(space, facets)
    mesh.topology.create_connectivity(fdim, mesh.topology.dim)
    to_cell = mesh.topology.connectivity(fdim, mesh.topology.dim)
    computed = [
        set(nodes[i]) == set(fem.locate_dofs_topological(space, fdim, facets[[i]], remote=False))
        and [cells[i]] == list(to_cell.links(facet))
        for i, facet in enumerate(facets)
    ]
    assert all(COMM.allgather(all(computed)))
    assert len(nodes) == len(cells) == len(facets)
