"""A rubber block with a curved lower side, pressed on a larger rubber block and dragged along it.

Plane strain. The lower block [0, 6] x [0, 2] is fixed at its bottom. The upper one is [0.6, 2.6] x
[2, 3], with a lower side raised by 0.3 at both ends, and a prescribed displacement of its top. Γc
is the lower side of the upper block, which has the finer cells. Both are neo-Hookean, W = G/2 (I₁ -
3 - 2 ln J) + λ/4 (J² - 1 - 2 ln J), the upper one twice as stiff. The geometry is simple, so that
other programs can reproduce it.
"""

from __future__ import annotations

import dolfinx
import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import CellType
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact import compat
from fenics_contact.elasticity import NeoHookean
from fenics_contact.types import Array
from scenes.meshes import create_mesh
from scenes.tags import at_coordinate, at_interface, tag_by_midpoints

BOTTOM, TOP, LOWER, UPPER, SIDE = 1, 2, 3, 4, 5
# Origin, size, cells along x and y, and Young's modulus of both blocks.
BLOCKS = (((0.0, 0.0), (6.0, 2.0), (24, 8), 1000.0), ((0.6, 2.0), (2.0, 1.0), (12, 6), 2000.0))
NU, ROUND = 0.3, 0.3
K_N, K_T = 2e4, 2e4
N_PRESSING, N_DRAGGING = 4, 20  # numbers of increments
DOWN, SLIDE = 0.2, 1.6
PATH = (
    *((0.0, DOWN * i / N_PRESSING) for i in range(1, N_PRESSING + 1)),
    *((SLIDE * i / N_DRAGGING, DOWN) for i in range(1, N_DRAGGING + 1)),
)


def sliding_block_mesh(refinement: int = 1) -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags]:
    """Return both blocks in one mesh, and the tags of their facets. Collective.

    Args:
        refinement: Refinement factor of the cells of `BLOCKS`.
    """
    x, cells, offset = [], [], 0
    for number, (origin, size, n, _) in enumerate(BLOCKS):
        corners = [np.array(origin), np.array(origin) + size]
        counts = tuple(refinement * k for k in n)
        block = dolfinx.mesh.create_rectangle(
            MPI.COMM_SELF, corners, counts, CellType.quadrilateral
        )
        places = block.geometry.x[:, :2].copy()
        if number:
            middle, high = origin[0] + size[0] / 2, origin[1] + size[1]
            fraction = (high - places[:, 1]) / size[1]
            places[:, 1] += ROUND * fraction * ((places[:, 0] - middle) / (size[0] / 2)) ** 2
        x.append(places)
        cells.append(compat.geometry_dofmap(block) + offset)
        offset += len(places)
    mesh = create_mesh("quadrilateral", np.concatenate(x), np.concatenate(cells))
    low, high = BLOCKS[0][1][1], BLOCKS[0][1][1] + BLOCKS[1][1][1]
    ends = BLOCKS[1][0][0], BLOCKS[1][0][0] + BLOCKS[1][1][0]

    def rounded(at: Array, cell: Array) -> Array:
        upright = np.any([np.abs(at[:, 0] - end) < 1e-9 for end in ends], axis=0)
        return (cell[:, 1] > low) & ~upright & (at[:, 1] < high - 1e-9)

    faces = {
        BOTTOM: at_coordinate(1, 0.0),
        TOP: at_coordinate(1, high),
        LOWER: at_interface(1, low, above=False),
        UPPER: rounded,
        SIDE: at_coordinate(0, 0.0),
    }
    return mesh, tag_by_midpoints(mesh, faces)


class SlidingRubberBlock:
    """The two blocks and the contact between them.

    Attributes:
        u: Displacement, quadratic.
        residual: Residual of the bulk.
        bcs: Dirichlet conditions at `BOTTOM` and `TOP`.
        contact: The contact.
        tags: Facet tags.
    """

    def __init__(self, friction: float, refinement: int = 1) -> None:
        """Create the blocks and the contact. Collective.

        Args:
            friction: Friction coefficient μ; 0: frictionless.
            refinement: Refinement factor, see `sliding_block_mesh`.
        """
        mesh, self.tags = sliding_block_mesh(refinement)
        V = fem.functionspace(mesh, ("Lagrange", 2, (2,)))
        self.u = fem.Function(V)
        modulus = fem.Function(fem.functionspace(mesh, ("DG", 0)))
        middles = dolfinx.mesh.compute_midpoints(
            mesh, 2, np.arange(modulus.x.array.size, dtype=np.int32)
        )
        # The dofs of `DG 0` are numbered like the cells.
        modulus.x.array[:] = np.where(middles[:, 1] < BLOCKS[0][1][1], BLOCKS[0][3], BLOCKS[1][3])
        body = NeoHookean(self.u, modulus, NU, "plane strain")
        dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": 4})
        self.residual = body.residual(ufl.TestFunction(V), dx)
        self._top = fem.Constant(mesh, np.zeros(2))
        self.bcs = [
            fem.dirichletbc(value, fem.locate_dofs_topological(V, 1, self.tags.find(tag)), V)
            for tag, value in ((BOTTOM, fem.Constant(mesh, np.zeros(2))), (TOP, self._top))
        ]
        law = fc.Coulomb(friction, K_N, K_T) if friction else fc.Frictionless(K_N)
        surface = fc.ContactSurface(mesh, self.tags, UPPER)
        opposite = fc.DeformableBody(self.tags, LOWER)
        self.contact = fc.Contact(self.u, surface, opposite, law, kinematics="finite")

    def set_top_displacement(self, along: float, down: float) -> None:
        """Set the displacement of the top of the upper block."""
        self._top.value[:] = along, -down
