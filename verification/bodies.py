"""Meshes of boxes, straight or bent, several in one mesh, and the elasticity in them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import basix.ufl
import dolfinx
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

__all__ = [
    "Bodies",
    "Where",
    "boxes",
    "graded",
]

Array = np.ndarray
Where = Callable[[Array, Array], Array]
COMM = MPI.COMM_WORLD


def graded(fine: float, cells: int, end: float, growth: float = 1.25) -> Array:
    """Coordinates from 0: ``cells`` equal cells up to ``fine``, then growing ones up to ``end``."""
    h = fine / cells
    more = [h * growth]
    while fine + sum(more) < end:
        more.append(more[-1] * growth)
    tail = np.cumsum(more) * (end - fine) / sum(more)
    return np.concatenate([np.linspace(0, fine, cells + 1), fine + tail])


def boxes(
    axes: Sequence[Sequence[Array]],
    sides: Mapping[int, Where],
    *,
    simplex: bool = False,
    bend: Callable[[Array], Array] | None = None,
    degree: int = 1,
    partitioner: Any = None,
) -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags]:
    """Boxes that share no node, each cut along its coordinates. Collective.

    Args:
        axes: Of every box, its coordinates along each direction, ascending.
        sides: Tags of facets, each by a function of the facets' midpoints and of the midpoints of
            the cells they bound, both (n, d), that tells which ones; before ``bend``.
        simplex: Triangles (in the plane) instead of quadrilaterals and hexahedra.
        bend: Moves the nodes, (n, d).
        degree: Of the cells' geometry.
        partitioner: DOLFINx's, of the cells, all of which the first rank has.
    """
    d = len(axes[0])
    corners, cells, first = [], [], 0
    for lines in axes:
        counts = [len(line) for line in lines]
        grid = np.meshgrid(*lines, indexing="ij")
        corners.append(np.column_stack([g.ravel() for g in grid]))
        number = first + np.arange(np.prod(counts)).reshape(counts)
        found = []
        for corner in range(2**d):  # the first coordinate runs fastest
            cut = tuple(
                slice(corner >> i & 1, n - 1 + (corner >> i & 1)) for i, n in enumerate(counts)
            )
            found.append(number[cut].ravel())
        cells.append(np.column_stack(found))
        first += len(corners[-1])
    x, quads = np.concatenate(corners), np.concatenate(cells).astype(np.int64)
    kind = "quadrilateral" if d == 2 else "hexahedron"
    if simplex:
        kind, quads = "triangle", np.concatenate([quads[:, [0, 1, 3]], quads[:, [0, 3, 2]]])
    if degree > 1:
        serial = dolfinx.mesh.create_mesh(
            MPI.COMM_SELF, cells=quads, x=x, e=ufl.Mesh(basix.ufl.element("P", kind, 1, shape=(d,)))
        )
        nodes = fem.functionspace(serial, ("Lagrange", degree))
        x = nodes.tabulate_dof_coordinates()[:, :d]
        quads = nodes.dofmap.list.astype(np.int64)
    if COMM.rank:
        x, quads = x[:0], quads[:0]
    element = ufl.Mesh(basix.ufl.element("Lagrange", kind, degree, shape=(d,)))
    mesh = dolfinx.mesh.create_mesh(COMM, cells=quads, x=x, e=element, partitioner=partitioner)
    tags = _tagged(mesh, sides)
    if bend is not None:
        mesh.geometry.x[:, :d] = bend(mesh.geometry.x[:, :d])
    return mesh, tags


def _tagged(mesh: dolfinx.mesh.Mesh, sides: Mapping[int, Where]) -> dolfinx.mesh.MeshTags:
    d = mesh.topology.dim
    mesh.topology.create_connectivity(d - 1, d)
    to_cell = mesh.topology.connectivity(d - 1, d)
    exterior = dolfinx.mesh.exterior_facet_indices(mesh.topology)
    owner = np.array([to_cell.links(f)[0] for f in exterior], dtype=np.int32)
    middle = dolfinx.mesh.compute_midpoints(mesh, d - 1, exterior).reshape(-1, 3)[:, :d]
    cell = dolfinx.mesh.compute_midpoints(mesh, d, owner).reshape(-1, 3)[:, :d]
    values = np.zeros(len(exterior), dtype=np.int32)
    for tag, where in sides.items():
        values[where(middle, cell)] = tag
    kept = values > 0
    return dolfinx.mesh.meshtags(mesh, d - 1, exterior[kept], values[kept])


class Bodies:
    """Linear elastic bodies in one mesh, plane strain or three dimensions.

    Attributes:
        mesh, tags: As given.
        u: Displacement.
        v: Test function.
        stress: σ(u) (UFL).
        F: Residual without loads, to be added to.
        bcs: Conditions made by `hold`.
    """

    def __init__(
        self,
        made: tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags],
        E: Any,
        nu: float,
        *,
        degree: int = 1,
    ) -> None:
        """Make displacement and residual. Collective."""
        self.mesh, self.tags = made
        self.d = d = self.mesh.geometry.dim
        space = fem.functionspace(self.mesh, ("Lagrange", degree, (d,)))
        self.u, self.v = fem.Function(space, name="displacement"), ufl.TestFunction(space)
        if not isinstance(E, ufl.core.expr.Expr):
            E = fem.Constant(self.mesh, float(E))
        ratio = fem.Constant(self.mesh, float(nu))
        strain = ufl.sym(ufl.grad(self.u))
        lame = E * ratio / ((1 + ratio) * (1 - 2 * ratio))
        self.stress = E / (1 + ratio) * strain + lame * ufl.tr(strain) * ufl.Identity(d)
        self.F = ufl.inner(self.stress, ufl.sym(ufl.grad(self.v))) * ufl.dx(self.mesh)
        self.bcs: list[fem.DirichletBC] = []

    @property
    def dofs(self) -> int:
        """Number of unknown displacements on all ranks."""
        dofmap = self.u.function_space.dofmap
        return int(dofmap.index_map.size_global * dofmap.index_map_bs)

    @property
    def x(self) -> Any:
        """Coordinates (UFL)."""
        return ufl.SpatialCoordinate(self.mesh)

    def constant(self, value: Any = 0.0) -> fem.Constant:
        """A number, or vector, to be changed later."""
        return fem.Constant(self.mesh, np.asarray(value, dtype=np.float64))

    def ds(self, tag: int) -> Any:
        """Measure of a side."""
        return ufl.ds(self.mesh, subdomain_data=self.tags)(tag)

    def hold(self, tag: int, *components: int, value: Any = 0.0) -> None:
        """Prescribe components of the displacement on a side. Collective."""
        if not isinstance(value, fem.Constant):
            value = self.constant(value)
        space = self.u.function_space
        for i in components:
            dofs = fem.locate_dofs_topological(space.sub(i), self.d - 1, self.tags.find(tag))
            self.bcs.append(fem.dirichletbc(value, dofs, space.sub(i)))
