"""Small meshes and scenes that the tests share, and comparisons that fail on all ranks together.

Every assertion looks at gathered data: a rank that failed alone would leave the others waiting.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import basix.ufl
import dolfinx
import dolfinx.fem.petsc
import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import CellType, GhostMode
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from fenics_contact import compat

CELLS = ("triangle", "quadrilateral", "tetrahedron", "hexahedron")
GRID = [(cell, degree) for cell in CELLS for degree in (1, 2)]
BOTTOM, TOP, LEFT, RIGHT, FRONT, BACK = 1, 2, 3, 4, 5, 6

Array = np.ndarray


# ---- meshes --------------------------------------------------------------------------------------


def dimension(cell: str) -> int:
    return 2 if cell in ("triangle", "quadrilateral") else 3


def block_mesh(
    cell: str,
    *,
    n: int | Sequence[int] = 2,
    size: Sequence[float] | None = None,
    comm: MPI.Comm = MPI.COMM_WORLD,
    shuffled: bool = False,
    bend: Callable[[Array], Array] | None = None,
    partitioner: Callable | None = None,
    ghost_mode: GhostMode = GhostMode.none,
) -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags]:
    """A box [0, size_i] with its sides tagged; the last coordinate is the height.

    ``shuffled``: vertices are renumbered at random, cells turned and mirrored at random, vertices
    moved inside the sides, so that facets of all orientations occur and no cell is like another.
    ``bend``: cells of geometric degree 2, their nodes (n, d) moved by this map.
    """
    d = dimension(cell)
    n = (n,) * d if np.ndim(n) == 0 else tuple(n)
    size = np.ones(d) if size is None else np.asarray(size, dtype=np.float64)
    kind = CellType[cell]
    if d == 2:
        serial = dolfinx.mesh.create_unit_square(MPI.COMM_SELF, *n, kind)
    else:
        serial = dolfinx.mesh.create_unit_cube(MPI.COMM_SELF, *n, kind)
    x = serial.geometry.x[:, :d].copy()
    cells = compat.geometry_dofmap(serial).astype(np.int64)
    if shuffled:
        x, cells = _shuffle(x, cells, cell)
    if bend is not None:
        nodes = fem.functionspace(serial, ("Lagrange", 2))
        x = nodes.tabulate_dof_coordinates()[:, :d]
        cells = nodes.dofmap.list.astype(np.int64)
    element = basix.ufl.element("Lagrange", cell, 1 if bend is None else 2, shape=(d,))
    if comm.rank:
        x, cells = x[:0], cells[:0]
    if partitioner is None:
        partitioner = compat.cell_partitioner(ghost_mode)
    mesh = dolfinx.mesh.create_mesh(
        comm, cells=cells, x=x * size, e=ufl.Mesh(element), partitioner=partitioner
    )
    tags = side_tags(mesh, size)
    if bend is not None:  # when the sides are found
        mesh.geometry.x[:, :d] = bend(mesh.geometry.x[:, :d])
    return mesh, tags


def layers(cell: str) -> Callable:
    """A partitioner that gives every rank its share of the cells in their order.

    Of boxes one cell wide these are layers, from the bottom.
    """
    n_vertices = 4 if cell == "quadrilateral" else 8

    def partition(comm: MPI.Comm, n_parts: int, cell_types: Any, cells: Any) -> Any:
        n_cells = cells[0].size // n_vertices
        destination = (np.arange(n_cells) * n_parts // max(n_cells, 1)).astype(np.int32)
        offsets = np.arange(n_cells + 1, dtype=np.int32)
        adjacency = dolfinx.graph.adjacencylist(destination, offsets)
        return getattr(adjacency, "_cpp_object", adjacency)

    return partition


def _shuffle(x: Array, cells: Array, cell: str) -> tuple[Array, Array]:
    rng = np.random.default_rng(5)
    d = x.shape[1]
    # Along a side only: the bubble of a coordinate vanishes where the coordinate is 0 or 1.
    bubble = x * (1 - x)
    x = x + 0.3 * bubble * rng.uniform(-1, 1, size=x.shape)
    number = rng.permutation(len(x))
    moved = np.empty_like(x)
    moved[number] = x
    cells = number[cells]
    corners = np.arange(2**d).reshape((2,) * d)
    for row in cells:
        if cell in ("triangle", "tetrahedron"):
            row[:] = rng.permutation(row)
        else:
            turned = corners.transpose(rng.permutation(d))
            turned = np.flip(turned, axis=np.flatnonzero(rng.integers(0, 2, d)))
            row[:] = row[turned.ravel()]
    return moved, cells


def side_tags(mesh: dolfinx.mesh.Mesh, size: Sequence[float]) -> dolfinx.mesh.MeshTags:
    """Tags BOTTOM, TOP, LEFT, RIGHT and, in 3D, FRONT, BACK."""
    d = mesh.geometry.dim
    sides = {BOTTOM: (d - 1, 0.0), TOP: (d - 1, size[d - 1]), LEFT: (0, 0.0), RIGHT: (0, size[0])}
    if d == 3:
        sides |= {FRONT: (1, 0.0), BACK: (1, size[1])}
    facets, values = [], []
    for tag, (i, at) in sides.items():
        found = dolfinx.mesh.locate_entities_boundary(
            mesh, d - 1, lambda x, i=i, at=at: np.abs(x[i] - at) < 1e-8 * max(size)
        )
        facets.append(found)
        values.append(np.full(found.size, tag, dtype=np.int32))
    facets, values = np.concatenate(facets), np.concatenate(values)
    order = np.argsort(facets)
    return dolfinx.mesh.meshtags(mesh, d - 1, facets[order], values[order])


def displacement_space(mesh: dolfinx.mesh.Mesh, degree: int) -> fem.FunctionSpace:
    return fem.functionspace(mesh, ("Lagrange", degree, (mesh.geometry.dim,)))


def polynomial(d: int, degree: int, seed: int, size: float) -> Callable[[Array], Array]:
    """A vector field of points (d, n) -> (d, n) with random coefficients up to ``size``."""
    rng = np.random.default_rng(seed)
    linear = rng.uniform(-size, size, (d, d))
    quadratic = rng.uniform(-size, size, (d, d, d)) * (degree > 1)

    def value(x: Array) -> Array:
        x = x[:d]
        return linear @ x + np.einsum("ijk,jn,kn->in", quadratic, x, x)

    return value


def wave(d: int, seed: int) -> Callable[[Array], Array]:
    """A rough field for directions of derivatives, the same on any number of ranks."""
    rng = np.random.default_rng(seed)
    phases, waves = rng.uniform(0, 6, (d, 1)), rng.uniform(3, 9, (d, d))
    return lambda x: np.sin(waves @ x[:d] + phases)


# ---- assembly ------------------------------------------------------------------------------------


def compiled(form: ufl.Form, contact: fc.Contact | None = None) -> fem.Form:
    return compat.compile_form(form, contact.entity_maps if contact else None)


def assemble_number(form: fem.Form, comm: MPI.Comm) -> float:
    return comm.allreduce(fem.assemble_scalar(form))


def assemble_owned(form: fem.Form, space: fem.FunctionSpace) -> Array:
    """Assembled linear form at this rank's owned dofs."""
    f = fem.Function(space)
    fem.assemble_vector(f.x.array, form)
    f.x.scatter_reverse(dolfinx.la.InsertMode.add)
    return owned(f).copy()


def assemble_matrix(form: fem.Form) -> PETSc.Mat:
    matrix = fem.petsc.create_matrix(form)
    fem.petsc.assemble_matrix(matrix, form)
    matrix.assemble()
    return matrix


def owned(f: fem.Function) -> Array:
    """Values at this rank's owned dofs."""
    dofmap = f.function_space.dofmap
    return f.x.array[: dofmap.index_map.size_local * dofmap.index_map_bs]


def set_owned(f: fem.Function, values: Array) -> None:
    owned(f)[:] = values
    f.x.scatter_forward()


# ---- comparisons ---------------------------------------------------------------------------------


def gathered(comm: MPI.Comm, rows: Array) -> Array:
    """The rows of all ranks on all ranks."""
    return np.concatenate(comm.allgather(np.asarray(rows)), axis=0)


def sorted_by_place(places: Array, *columns: Array) -> Array:
    """Rows (place, columns) in the order of the places, to 1e-9 of their extent.

    For comparisons between meshes: two equal ones may be distributed differently.
    """
    size = float(np.abs(places).max(initial=0.0)) or 1.0
    order = np.lexsort(np.round(places / size, 9).T)
    return np.column_stack([places, *columns])[order]


def nodal(u: fem.Function) -> Array:
    """Values (all nodes, bs) at the owned nodes of all ranks, in the order of their places."""
    space = u.function_space
    d, bs = space.mesh.geometry.dim, space.dofmap.index_map_bs
    n = space.dofmap.index_map.size_local
    x, values = space.tabulate_dof_coordinates()[:n, :d], u.x.array.reshape(-1, bs)[:n]
    comm = space.mesh.comm
    return sorted_by_place(gathered(comm, x), gathered(comm, values))[:, d:]


def at_points(contact: fc.Contact, rows: Array) -> Array:
    """Rows (points, …) of all ranks, in the order of the points' places."""
    comm = contact.surface.mesh.comm
    d = contact.points.shape[1]
    return sorted_by_place(gathered(comm, contact.points), gathered(comm, rows))[:, d:]


def close(actual: Any, expected: Any, rtol: float, *, scale: float | None = None) -> bool:
    """Largest difference within ``rtol`` of the largest expected entry (or ``scale``)."""
    actual, expected = np.asarray(actual, dtype=float), np.asarray(expected, dtype=float)
    assert actual.shape == expected.shape
    if not actual.size:
        return True
    scale = float(np.abs(expected).max()) if scale is None else scale
    error = float(np.abs(actual - expected).max())
    if not error <= rtol * scale:
        print(f"largest difference {error:.3e} at scale {scale:.3e}: {error / scale:.3e}")
        return False
    return True


def raised_everywhere(
    call: Callable[[], Any],
    kind: type[Exception] | tuple[type[Exception], ...],
    *words: str,
    comm: MPI.Comm = MPI.COMM_WORLD,
) -> str:
    """Assert that every rank raises ``kind`` and that the text names all of ``words``."""
    error: Exception | None = None
    try:
        call()
    except Exception as caught:
        error = caught
    reports = comm.allgather(None if error is None else (type(error).__name__, str(error)))
    assert all(report is not None for report in reports), f"not raised on all ranks: {reports}"
    flags = comm.allgather(isinstance(error, kind))
    assert all(flags), f"wrong kind of error: {reports}"
    for word in words:
        assert all(word in text for _, text in reports), f"{word!r} is not named in {reports}"
    assert len({text for _, text in reports}) == 1, f"the ranks tell different stories: {reports}"
    return reports[0][1]


def same_field(
    f: fem.Function, expected: Callable[[Array], Array], rtol: float, *, scale: float | None = None
) -> bool:
    """Whether ``f`` is the interpolant of ``expected``, all ranks together."""
    reference = fem.Function(f.function_space)
    reference.interpolate(expected)
    comm = f.function_space.mesh.comm
    return close(gathered(comm, owned(f)), gathered(comm, owned(reference)), rtol, scale=scale)


# ---- a block in contact --------------------------------------------------------------------------


def strain(u: Any) -> Any:
    return ufl.sym(ufl.grad(u))


def stress(u: Any, E: Any, nu: Any) -> Any:
    """Linear elasticity; in two dimensions plane strain."""
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    return 2 * mu * strain(u) + lam * ufl.tr(strain(u)) * ufl.Identity(len(u))


@dataclass
class Block:
    """An elastic box, its bottom Γc; every number in its forms is a constant.

    Attributes:
        traction: Force per area on the top.
        body_force: Force per volume.
        F: Bulk residual with these loads.
    """

    mesh: dolfinx.mesh.Mesh
    tags: dolfinx.mesh.MeshTags
    u: fem.Function
    E: fem.Constant
    nu: fem.Constant
    traction: fem.Constant
    body_force: fem.Constant
    surface: fc.ContactSurface
    F: ufl.Form = field(init=False)

    def __post_init__(self) -> None:
        """Make the residual."""
        v = ufl.TestFunction(self.u.function_space)
        ds = ufl.ds(self.mesh, subdomain_data=self.tags)
        dx = ufl.dx(self.mesh)
        self.F = ufl.inner(stress(self.u, self.E, self.nu), strain(v)) * dx
        self.F -= ufl.dot(self.body_force, v) * dx + ufl.dot(self.traction, v) * ds(TOP)

    @property
    def dim(self) -> int:
        """2 or 3."""
        return self.mesh.geometry.dim

    def vector(self, *, side: float = 0.0, up: float = 0.0) -> Array:
        """Components along x and along the height, zeros else."""
        value = np.zeros(self.dim)
        value[0], value[-1] = side, up
        return value

    def load(self, *, side: float = 0.0, up: float = 0.0) -> None:
        """Set the traction on the top."""
        self.traction.value[:] = self.vector(side=side, up=up)

    def facet_dofs(self, tag: int, component: int | None = None) -> Array:
        """Dofs of a side, of all components or of one."""
        space = self.u.function_space
        if component is not None:
            space = space.sub(component)
        fdim = self.dim - 1
        return fem.locate_dofs_topological(space, fdim, self.tags.find(tag))

    def hold(self, tag: int, component: int, value: Any = 0.0) -> fem.DirichletBC:
        """Prescribe one component on a side."""
        if not isinstance(value, fem.Constant):
            value = fem.Constant(self.mesh, float(value))
        dofs = self.facet_dofs(tag, component)
        return fem.dirichletbc(value, dofs, self.u.function_space.sub(component))

    def rollers(self) -> list[fem.DirichletBC]:
        """No displacement across the planes x = 0 and, in 3D, y = 0."""
        bcs = [self.hold(LEFT, 0)]
        return bcs + ([self.hold(FRONT, 1)] if self.dim == 3 else [])

    def floor(self, *, displacement: Any = None) -> fc.HalfSpace:
        """A floor that just touches the bottom."""
        return fc.HalfSpace((0.0,) * self.dim, self.vector(up=1.0), displacement=displacement)

    def contact(self, law: Any, *, displacement: Any = None, **kwargs: Any) -> fc.Contact:
        """Contact of the bottom, by default with the floor."""
        support = kwargs.pop("support", None) or self.floor(displacement=displacement)
        return fc.Contact(self.u, self.surface, support, law, **kwargs)

    def problem(
        self,
        law: Any,
        bcs: Sequence[fem.DirichletBC],
        *,
        contact: dict | None = None,
        **kwargs: Any,
    ) -> tuple[fc.ContactProblem, fc.Contact]:
        """The problem and its one contact; ``contact``: arguments of `Block.contact`."""
        made = self.contact(law, **(contact or {}))
        return fc.ContactProblem(self.F, self.u, bcs=bcs, contacts=[made], **kwargs), made


def block(
    cell: str = "quadrilateral",
    degree: int = 1,
    *,
    E: float = 1000.0,
    nu: float = 0.3,
    side: float = 0.0,
    up: float = 0.0,
    surface: dict | None = None,
    **mesh_arguments: Any,
) -> Block:
    """A `Block` with the traction (side, up) on its top."""
    mesh, tags = block_mesh(cell, **mesh_arguments)
    zero = np.zeros(mesh.geometry.dim)
    made = Block(
        mesh=mesh,
        tags=tags,
        u=fem.Function(displacement_space(mesh, degree), name="u"),
        E=fem.Constant(mesh, float(E)),
        nu=fem.Constant(mesh, float(nu)),
        traction=fem.Constant(mesh, zero),
        body_force=fem.Constant(mesh, zero),
        surface=fc.ContactSurface(mesh, tags, BOTTOM, **(surface or {})),
    )
    made.load(side=side, up=up)
    return made
