"""Boxes of every cell type with tagged sides, and an elastic block in contact."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import dolfinx
import dolfinx.fem.petsc
import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import CellType, GhostMode
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact import compat
from fenics_contact.types import Array
from scenes.elasticity import dirichlet_bc, displacement_space, strain, stress
from scenes.meshes import create_mesh, partition_from_owners
from scenes.tags import tag_by_nodes

CELLS = ("triangle", "quadrilateral", "tetrahedron", "hexahedron")
GRID = [(cell, degree) for cell in CELLS for degree in (1, 2)]
BOTTOM, TOP, LEFT, RIGHT, FRONT, BACK = 1, 2, 3, 4, 5, 6

# ---- meshes --------------------------------------------------------------------------------------


def dimension(cell: str) -> int:
    """Return the dimension of a cell type, 2 or 3."""
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
    """Return a box [0, size_i] and the tags of its sides; the last coordinate is the height.

    ``shuffled``: vertices are renumbered, cells are rotated and reflected, and vertices are moved
    within their sides, all at random, so that facets of all orientations occur and cells differ.
    ``bend``: cells have geometric degree 2, and this map moves their nodes (n, d).
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
    cells = compat.geometry_dofmap(serial)
    if shuffled:
        x, cells = _shuffle(x, cells, cell)
    if bend is not None:
        nodes = fem.functionspace(serial, ("Lagrange", 2))
        x = nodes.tabulate_dof_coordinates()[:, :d]
        cells = nodes.dofmap.list
    if partitioner is None:
        partitioner = compat.cell_partitioner(ghost_mode)
    degree = 1 if bend is None else 2
    mesh = create_mesh(cell, x * size, cells, degree=degree, comm=comm, partitioner=partitioner)
    tags = side_tags(mesh, size)
    if bend is not None:  # after the sides have been located
        mesh.geometry.x[:, :d] = bend(mesh.geometry.x[:, :d])
    return mesh, tags


def layer_partitioner(cell: str) -> Callable:
    """Return a partitioner that gives every rank a contiguous range of the cells.

    In boxes one cell wide these ranges are layers, numbered from the bottom.
    """
    n_vertices = 4 if cell == "quadrilateral" else 8

    def partition(comm: MPI.Comm, n_parts: int, cell_types: Any, cells: Any) -> Any:
        n_cells = cells[0].size // n_vertices
        return partition_from_owners(np.arange(n_cells) * n_parts // max(n_cells, 1))

    return partition


def _shuffle(x: Array, cells: Array, cell: str) -> tuple[Array, Array]:
    rng = np.random.default_rng(5)
    d = x.shape[1]
    # The bubble of a coordinate vanishes at 0 and 1, so that vertices stay on their sides.
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
    """Return facet tags BOTTOM, TOP, LEFT, RIGHT and, in 3D, FRONT and BACK."""
    d = mesh.geometry.dim
    ends = {BOTTOM: (d - 1, 0.0), TOP: (d - 1, size[d - 1]), LEFT: (0, 0.0), RIGHT: (0, size[0])}
    if d == 3:
        ends |= {FRONT: (1, 0.0), BACK: (1, size[1])}
    off = 1e-8 * max(size)
    return tag_by_nodes(
        mesh, {t: lambda x, i=i, at=at: np.abs(x[i] - at) < off for t, (i, at) in ends.items()}
    )


# ---- fields --------------------------------------------------------------------------------------


def polynomial(d: int, degree: int, seed: int, size: float) -> Callable[[Array], Array]:
    """Return a polynomial field (d, n) -> (d, n) with random coefficients up to ``size``."""
    rng = np.random.default_rng(seed)
    linear = rng.uniform(-size, size, (d, d))
    quadratic = rng.uniform(-size, size, (d, d, d)) * (degree > 1)

    def value(x: Array) -> Array:
        x = x[:d]
        return linear @ x + np.einsum("ijk,jn,kn->in", quadratic, x, x)

    return value


def rough_field(d: int, seed: int) -> Callable[[Array], Array]:
    """Return a rough field, a direction for derivatives, the same on any number of ranks."""
    rng = np.random.default_rng(seed)
    phases, waves = rng.uniform(0, 6, (d, 1)), rng.uniform(3, 9, (d, d))
    return lambda x: np.sin(waves @ x[:d] + phases)


# ---- a block in contact --------------------------------------------------------------------------


@dataclass
class Block:
    """An elastic box whose bottom is Γc; all parameters of its forms are constants.

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
        """Create the residual."""
        v = ufl.TestFunction(self.u.function_space)
        ds = ufl.ds(self.mesh, subdomain_data=self.tags)
        dx = ufl.dx(self.mesh)
        self.F = ufl.inner(stress(self.u, self.E, self.nu), strain(v)) * dx
        self.F -= ufl.dot(self.body_force, v) * dx + ufl.dot(self.traction, v) * ds(TOP)

    @property
    def dim(self) -> int:
        """The geometric dimension, 2 or 3."""
        return self.mesh.geometry.dim

    def vector(self, *, side: float = 0.0, up: float = 0.0) -> Array:
        """Return the vector with components ``side`` along x and ``up`` along the height."""
        value = np.zeros(self.dim)
        value[0], value[-1] = side, up
        return value

    def load(self, *, side: float = 0.0, up: float = 0.0) -> None:
        """Set the traction on the top."""
        self.traction.value[:] = self.vector(side=side, up=up)

    def add_traction(self, tag: int, traction: Array) -> fem.Constant:
        """Add a traction on the side ``tag`` to the residual, and return its constant."""
        given = fem.Constant(self.mesh, traction)
        v = ufl.TestFunction(self.u.function_space)
        self.F -= ufl.dot(given, v) * ufl.ds(self.mesh, subdomain_data=self.tags)(tag)
        return given

    def facet_dofs(self, tag: int, component: int | None = None) -> Array:
        """Return the dofs of a side, of all components or of one."""
        space = self.u.function_space
        if component is not None:
            space = space.sub(component)
        fdim = self.dim - 1
        return fem.locate_dofs_topological(space, fdim, self.tags.find(tag))

    def dirichlet_bc(self, tag: int, component: int, value: Any = 0.0) -> fem.DirichletBC:
        """Return the Dirichlet condition for one component of u on a side."""
        return dirichlet_bc(self.u, self.tags, tag, component, value)

    def rollers(self) -> list[fem.DirichletBC]:
        """Return zero normal displacement on the planes x = 0 and, in 3D, y = 0."""
        bcs = [self.dirichlet_bc(LEFT, 0)]
        return bcs + ([self.dirichlet_bc(FRONT, 1)] if self.dim == 3 else [])

    def floor(self, *, displacement: Any = None) -> fc.HalfSpace:
        """Return a half-space whose plane touches the bottom."""
        return fc.HalfSpace((0.0,) * self.dim, self.vector(up=1.0), displacement=displacement)

    def contact(self, law: Any, *, displacement: Any = None, **kwargs: Any) -> fc.Contact:
        """Return the contact of the bottom, by default with the floor."""
        obstacle = kwargs.pop("obstacle", None) or self.floor(displacement=displacement)
        return fc.Contact(self.u, self.surface, obstacle, law, **kwargs)

    def wall(self, law: Any) -> fc.Contact:
        """Return the contact of the left side with a half-space whose plane touches it."""
        surface = fc.ContactSurface(self.mesh, self.tags, LEFT)
        obstacle = fc.HalfSpace((0.0,) * self.dim, self.vector(side=1.0))
        return fc.Contact(self.u, surface, obstacle, law, name="wall")

    def problem(
        self,
        law: Any,
        bcs: Sequence[fem.DirichletBC],
        *,
        contact: dict | None = None,
        **kwargs: Any,
    ) -> tuple[fc.ContactProblem, fc.Contact]:
        """Return the problem and its contact; ``contact`` has arguments of `Block.contact`."""
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
    """Return a `Block` with the traction (side, up) on its top."""
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


def parabolic_floor(scene: Block, depth: float = 0.01) -> fc.Obstacle:
    """Return a parabolic floor with the gap ``depth`` (x - 0.4)² below the bottom."""
    x = ufl.SpatialCoordinate(scene.mesh)
    return fc.PrescribedGap(depth * (x[0] - 0.4) ** 2, scene.vector(up=-1.0))


def kirchhoff(scene: Block) -> ufl.Form:
    """Return the residual for St Venant-Kirchhoff's law with ν = 0: S = E times Green's strain."""
    v = ufl.TestFunction(scene.u.function_space)
    F = ufl.Identity(scene.dim) + ufl.grad(scene.u)
    S = scene.E * (F.T * F - ufl.Identity(scene.dim)) / 2
    ds = ufl.ds(scene.mesh, subdomain_data=scene.tags)
    return ufl.inner(F * S, ufl.grad(v)) * ufl.dx(scene.mesh) - ufl.dot(scene.traction, v) * ds(TOP)
