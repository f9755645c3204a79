"""Several straight or bent boxes in one mesh, and their linear elasticity."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import dolfinx
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.types import Array
from scenes.elasticity import dirichlet_bc, displacement_space, strain, stress
from scenes.meshes import create_mesh
from scenes.tags import FacetSelector, tag_by_midpoints

COMM = MPI.COMM_WORLD


def graded(fine: float, cells: int, end: float, growth: float = 1.25) -> Array:
    """Return coordinates of ``cells`` equal cells up to ``fine`` and growing ones up to ``end``."""
    h = fine / cells
    more = [h * growth]
    while fine + sum(more) < end:
        more.append(more[-1] * growth)
    tail = np.cumsum(more) * (end - fine) / sum(more)
    return np.concatenate([np.linspace(0, fine, cells + 1), fine + tail])


def boxes(
    axes: Sequence[Sequence[Array]],
    sides: Mapping[int, FacetSelector],
    *,
    simplex: bool = False,
    bend: Callable[[Array], Array] | None = None,
    degree: int = 1,
    partitioner: Any = None,
) -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags]:
    """Return a mesh of tensor-product boxes without common nodes, and its tags. Collective.

    Args:
        axes: For every box, the ascending coordinates of its nodes in each direction.
        sides: Tags of facets and the functions that select them, evaluated before ``bend``.
        simplex: Triangles (in the plane) instead of quadrilaterals and hexahedra.
        bend: Map of the nodes, (n, d).
        degree: Geometric degree of the cells.
        partitioner: Partitioner for DOLFINx; the cells are all on the first rank.
    """
    d = len(axes[0])
    corners, cells, first = [], [], 0
    for lines in axes:
        counts = [len(line) for line in lines]
        grid = np.meshgrid(*lines, indexing="ij")
        corners.append(np.column_stack([g.ravel() for g in grid]))
        number = first + np.arange(np.prod(counts)).reshape(counts)
        found = []
        for corner in range(2**d):  # the first coordinate varies fastest
            cut = tuple(
                slice(corner >> i & 1, n - 1 + (corner >> i & 1)) for i, n in enumerate(counts)
            )
            found.append(number[cut].ravel())
        cells.append(np.column_stack(found))
        first += len(corners[-1])
    x, quads = np.concatenate(corners), np.concatenate(cells)
    kind = "quadrilateral" if d == 2 else "hexahedron"
    if simplex:
        kind, quads = "triangle", np.concatenate([quads[:, [0, 1, 3]], quads[:, [0, 3, 2]]])
    if degree > 1:
        serial = create_mesh(kind, x, quads, comm=MPI.COMM_SELF)
        nodes = fem.functionspace(serial, ("Lagrange", degree))
        x = nodes.tabulate_dof_coordinates()[:, :d]
        quads = nodes.dofmap.list
    mesh = create_mesh(kind, x, quads, degree=degree, partitioner=partitioner)
    tags = tag_by_midpoints(mesh, sides)
    if bend is not None:
        mesh.geometry.x[:, :d] = bend(mesh.geometry.x[:, :d])
    return mesh, tags


class Bodies:
    """Linear elastic bodies in one mesh, plane strain or three dimensions.

    Attributes:
        mesh, tags: The mesh and its facet tags.
        u: Displacement.
        v: Test function.
        stress: σ(u) (UFL).
        F: Residual; loads are subtracted from it by the caller.
        bcs: Dirichlet conditions added by `prescribe`.
    """

    def __init__(
        self,
        mesh_and_tags: tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags],
        E: Any,
        nu: float,
        *,
        degree: int = 1,
    ) -> None:
        """Create displacement and residual. Collective."""
        self.mesh, self.tags = mesh_and_tags
        self.d = self.mesh.geometry.dim
        space = displacement_space(self.mesh, degree)
        self.u, self.v = fem.Function(space, name="displacement"), ufl.TestFunction(space)
        if not isinstance(E, ufl.core.expr.Expr):
            E = fem.Constant(self.mesh, float(E))
        self.stress = stress(self.u, E, fem.Constant(self.mesh, float(nu)))
        self.F = ufl.inner(self.stress, strain(self.v)) * ufl.dx(self.mesh)
        self.bcs: list[fem.DirichletBC] = []

    @property
    def dofs(self) -> int:
        """The number of displacement dofs on all ranks."""
        dofmap = self.u.function_space.dofmap
        return int(dofmap.index_map.size_global * dofmap.index_map_bs)

    @property
    def x(self) -> Any:
        """The coordinates (UFL)."""
        return ufl.SpatialCoordinate(self.mesh)

    def constant(self, value: Any = 0.0) -> fem.Constant:
        """Return a constant scalar or vector whose value can be changed."""
        return fem.Constant(self.mesh, np.asarray(value, dtype=np.float64))

    def ds(self, tag: int) -> Any:
        """Return the measure of a side."""
        return ufl.ds(self.mesh, subdomain_data=self.tags)(tag)

    def prescribe(self, tag: int, *components: int, value: Any = 0.0) -> None:
        """Prescribe components of the displacement on a side. Collective."""
        if not isinstance(value, fem.Constant):  # one for all components
            value = self.constant(value)
        self.bcs += [dirichlet_bc(self.u, self.tags, tag, i, value) for i in components]

    def contact(
        self, tag: Any, obstacle: Any, law: Any, *, quadrature: int | None = None, **options: Any
    ) -> fc.Contact:
        """Return the contact of a side with an obstacle, or with tagged sides. Collective."""
        if not isinstance(obstacle, fc.Obstacle):
            obstacle = fc.DeformableBody(self.tags, obstacle)
        surface = fc.ContactSurface(self.mesh, self.tags, tag, quadrature_degree=quadrature)
        return fc.Contact(self.u, surface, obstacle, law, **options)

    def problem(self, *contacts: fc.Contact, **options: Any) -> fc.ContactProblem:
        """Return the problem with these contacts. Collective."""
        return fc.ContactProblem(self.F, self.u, bcs=self.bcs, contacts=list(contacts), **options)

    def cells(self, where: Callable[[Array], Array]) -> Array:
        """Return the cells of this rank, with ghosts, whose midpoints (n, d) ``where`` selects."""
        index_map = self.mesh.topology.index_map(self.d)
        cells = np.arange(index_map.size_local + index_map.num_ghosts, dtype=np.int32)
        middle = dolfinx.mesh.compute_midpoints(self.mesh, self.d, cells).reshape(-1, 3)
        return cells[where(middle[:, : self.d])]

    def set_displacement(
        self, field: Callable[[Array], Array], where: Callable[[Array], Array]
    ) -> None:
        """Set the displacement of the selected cells and update ghosts. Collective.

        The selected cells must have no node in common with the others.
        """
        self.u.interpolate(field, cells0=self.cells(where))
        self.u.x.scatter_forward()

    def reaction(self, tag: int) -> Array:
        """Return the reaction of the Dirichlet condition on a side, (d,) (force). Collective.

        It is assembled from the form, which has no contact forces.
        """
        space = self.u.function_space
        residual = fem.Function(space)
        fem.assemble_vector(residual.x.array, fem.form(self.F))
        residual.x.scatter_reverse(dolfinx.la.InsertMode.add)
        nodes = fem.locate_dofs_topological(space, self.d - 1, self.tags.find(tag))
        nodes = nodes[nodes < space.dofmap.index_map.size_local]
        forces = residual.x.array.reshape(-1, self.d)[nodes]
        return np.asarray(space.mesh.comm.allreduce(forces.sum(axis=0)))
