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
from scenes.elasticity import displacement_space, hold, residual
from scenes.meshes import mesh_of
from scenes.tags import between, near, plane, sides, tagged

BOTTOM, TOP, LOWER, UPPER = 1, 2, 3, 4
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
    mesh = mesh_of(cell, np.concatenate(x), np.concatenate(cells))
    up = d - 1
    faces = {
        BOTTOM: near(up, 0.0),
        TOP: near(up, 1.0),
        LOWER: between(up, 0.5, above=False),
        UPPER: between(up, 0.5, above=True),
    }
    return mesh, tagged(mesh, faces)


def pressed(
    cell: str,
    degree: int,
    nu: float,
    law: Any,
    *,
    n: tuple[int, int] = (3, 4),
    surface: int = LOWER,
    confined: bool = True,
    contact: dict | None = None,
    **options: Any,
) -> tuple[fc.ContactProblem, fc.Contact, fem.Constant]:
    """Return two blocks on rollers, pressed by 0.01, as problem, contact and load. Collective.

    Both sides have zero normal displacement if ``confined``, otherwise those at 0 only.
    """
    mesh, tags = two_blocks(cell, n)
    d = mesh.geometry.dim
    space = displacement_space(mesh, degree)
    u, v = fem.Function(space), ufl.TestFunction(space)
    down = fem.Constant(mesh, -0.01)
    ends = {10 * i + at: (i, at) for i in range(d - 1) for at in (0, 1)}
    upright = sides(mesh, {tag: plane(i, at) for tag, (i, at) in ends.items()})
    bcs = [hold(u, tags, BOTTOM, d - 1), hold(u, tags, TOP, d - 1, down)]
    bcs += [hold(u, upright, tag, i) for tag, (i, at) in ends.items() if confined or at == 0]
    opposite = UPPER if surface == LOWER else LOWER
    made = fc.Contact(
        u,
        fc.ContactSurface(mesh, tags, surface),
        fc.DeformableBody(tags, opposite),
        law,
        **(contact or {}),
    )
    problem = fc.ContactProblem(residual(u, v, E, nu), u, bcs=bcs, contacts=[made], **options)
    return problem, made, down


class Slider:
    """A block of width 1 at x = ``start`` on a block of width 4, with a prescribed top.

    Attributes:
        u: Displacement of both blocks.
        move: Displacement of the top, one constant per component.
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
        self.move = [fem.Constant(mesh, 0.0) for _ in range(d)]
        bcs = [hold(self.u, tags, BOTTOM, i) for i in range(d)]
        bcs += [hold(self.u, tags, TOP, i, value) for i, value in enumerate(self.move)]
        surface = fc.ContactSurface(mesh, tags, UPPER)
        base = fc.DeformableBody(
            tags, LOWER, update_pairs=update_pairs, max_initial_penetration=max_initial_penetration
        )
        self.contact = fc.Contact(self.u, surface, base, law, **(contact or {}))
        F = residual(self.u, v, E, 0.3)
        self.problem = fc.ContactProblem(F, self.u, bcs=bcs, contacts=[self.contact], **options)

    def step(self, down: float, along: float) -> fc.Step:
        """Set the displacement of the top, solve and commit."""
        self.move[-1].value, self.move[0].value = -down, along
        step = self.problem.solve()
        self.problem.commit()
        return step
