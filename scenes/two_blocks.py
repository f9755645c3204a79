"""Two stacked blocks in one mesh with non-matching cells, pressed together or sliding."""

from __future__ import annotations

from typing import Any

import dolfinx
import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import CellType
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact import compat
from scenes.blocks import dimension
from scenes.elasticity import dirichlet_bc, displacement_space, residual
from scenes.meshes import create_mesh
from scenes.tags import at_coordinate, at_interface, plane, tag_by_midpoints, tag_by_nodes

BOTTOM, TOP, LOWER_FACE, UPPER_FACE = 1, 2, 3, 4
E = 1e6


def two_blocks(
    cell: str, n: tuple[int, int], widths: tuple[float, float] = (1.0, 1.0), shift: float = 0.0
) -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags]:
    """Return two stacked blocks of height 1/2 with non-matching cells, and tags. Collective.

    A positive ``shift`` moves the upper block along x, and centres it across.
    """
    d = dimension(cell)
    x, cells, offset = [], [], 0
    for count, width, low in zip(n, widths, (0.0, 0.5), strict=True):
        counts = (count,) * (d - 1) + (max(1, round(count / width) // 2),)
        make = dolfinx.mesh.create_rectangle if d == 2 else dolfinx.mesh.create_box
        corners = [np.r_[np.zeros(d - 1), low], np.r_[np.full(d - 1, width), low + 0.5]]
        block = make(MPI.COMM_SELF, corners, counts, CellType[cell])
        x.append(block.geometry.x[:, :d].copy())
        if low > 0 and shift > 0:
            x[-1][:, 0] += shift
            x[-1][:, 1 : d - 1] += (widths[0] - width) / 2
        cells.append(compat.geometry_dofmap(block) + offset)
        offset += len(x[-1])
    mesh = create_mesh(cell, np.concatenate(x), np.concatenate(cells))
    up = d - 1
    faces = {
        BOTTOM: at_coordinate(up, 0.0),
        TOP: at_coordinate(up, 1.0),
        LOWER_FACE: at_interface(up, 0.5, above=False),
        UPPER_FACE: at_interface(up, 0.5, above=True),
    }
    return mesh, tag_by_midpoints(mesh, faces)


def pressed_blocks(
    cell: str,
    degree: int,
    nu: float,
    law: Any,
    *,
    n: tuple[int, int] = (3, 4),
    surface: int = LOWER_FACE,
    laterally_fixed: bool = True,
    contact: dict | None = None,
    **options: Any,
) -> tuple[fc.ContactProblem, fc.Contact, fem.Constant]:
    """Return two blocks on rollers, pressed by 0.01, as problem, contact and load. Collective.

    Both sides have zero normal displacement if ``laterally_fixed``, otherwise those at 0 only.
    """
    mesh, tags = two_blocks(cell, n)
    d = mesh.geometry.dim
    space = displacement_space(mesh, degree)
    u, v = fem.Function(space), ufl.TestFunction(space)
    down = fem.Constant(mesh, -0.01)
    ends = {10 * i + at: (i, at) for i in range(d - 1) for at in (0, 1)}
    upright = tag_by_nodes(mesh, {tag: plane(i, at) for tag, (i, at) in ends.items()})
    bcs = [dirichlet_bc(u, tags, BOTTOM, d - 1), dirichlet_bc(u, tags, TOP, d - 1, down)]
    bcs += [
        dirichlet_bc(u, upright, tag, i)
        for tag, (i, at) in ends.items()
        if laterally_fixed or at == 0
    ]
    opposite = UPPER_FACE if surface == LOWER_FACE else LOWER_FACE
    made = fc.Contact(
        u,
        fc.ContactSurface(mesh, tags, surface),
        fc.DeformableBody(tags, opposite),
        law,
        **(contact or {}),
    )
    problem = fc.ContactProblem(residual(u, v, E, nu), u, bcs=bcs, contacts=[made], **options)
    return problem, made, down


class SlidingBlock:
    """A block of width 1 at x = ``start`` on a block of width 4, with a prescribed top.

    Attributes:
        u: Displacement of both blocks.
        top_displacement: Displacement of the top, one constant per component.
        contact, problem: The contact and its problem.
    """

    def __init__(
        self,
        cell: str,
        law: Any,
        *,
        start: float,
        slope: float = 0.0,
        update_pairs: str = "increment",
        max_initial_penetration: float | None = None,
        n: tuple[int, int] = (14, 4),
        contact: dict | None = None,
        **options: Any,
    ) -> None:
        """Create the unloaded problem; both blocks rise along x by ``slope``. Collective."""
        mesh, tags = two_blocks(cell, n, (4.0, 1.0), start)
        d = mesh.geometry.dim
        mesh.geometry.x[:, d - 1] += slope * mesh.geometry.x[:, 0]
        space = displacement_space(mesh, 1)
        self.u, v = fem.Function(space), ufl.TestFunction(space)
        self.top_displacement = [fem.Constant(mesh, 0.0) for _ in range(d)]
        bcs = [dirichlet_bc(self.u, tags, BOTTOM, i) for i in range(d)]
        bcs += [
            dirichlet_bc(self.u, tags, TOP, i, value)
            for i, value in enumerate(self.top_displacement)
        ]
        surface = fc.ContactSurface(mesh, tags, UPPER_FACE)
        base = fc.DeformableBody(
            tags,
            LOWER_FACE,
            update_pairs=update_pairs,
            max_initial_penetration=max_initial_penetration,
        )
        self.contact = fc.Contact(self.u, surface, base, law, **(contact or {}))
        F = residual(self.u, v, E, 0.3)
        self.problem = fc.ContactProblem(F, self.u, bcs=bcs, contacts=[self.contact], **options)

    def step(self, down: float, along: float) -> fc.Step:
        """Set the displacement of the top, solve and commit."""
        self.top_displacement[-1].value, self.top_displacement[0].value = -down, along
        step = self.problem.solve()
        self.problem.commit()
        return step
