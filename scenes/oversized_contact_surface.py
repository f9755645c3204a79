"""Blocks whose whole top is Γc, under a tool that touches only a part of it and is dragged."""

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
from fenics_contact.types import Array
from scenes.blocks import dimension
from scenes.elasticity import dirichlet_bc, displacement_space, residual
from scenes.histories import History
from scenes.meshes import create_mesh
from scenes.tags import at_coordinate, tag_by_midpoints

BASE, TOP, SOLE, SHOE_TOP, SIDE = 1, 2, 3, 4, 5
E, NU, RADIUS, DEPTH = 1000.0, 0.3, 4.0, 0.01
# Cells of the block, with edges 2 (and 2) and 0.4: its top has more than a thousand dofs.
CELLS = {"quadrilateral": (520, 4), "triangle": (520, 4), "tetrahedron": (19, 19, 2)}
HEIGHT = 0.4


class IndentedBlock(History):
    """A ball or disc that is pressed into the middle until t = 1, then dragged with velocity 0.25.

    Attributes:
        u: Displacement.
        contact, problem: The contact and its problem.
    """

    def __init__(
        self,
        law: Any = None,
        *,
        cell: str = "quadrilateral",
        contact_half_width: float = 1.0,
        depth: float = DEPTH,
        force: float = 0.0,
        pressure: float = 0.0,
        length: float = 1.0,
        contact: dict | None = None,
        comm: MPI.Comm = MPI.COMM_WORLD,
        **options: Any,
    ) -> None:
        """Create the unloaded problem. Collective.

        Args:
            law: Contact law, by default Coulomb's.
            cell: Cell type.
            contact_half_width: Half-width of Γc.
            depth: Displacement of the ball.
            force: Force on the ball; 0: its displacement is prescribed.
            pressure: Pressure on the base; if it is not 0, the base is free, and only the ball
                supports the block vertically.
            length: Unit of lengths.
            contact: Arguments of `fc.Contact`.
            comm: MPI communicator of the mesh.
            **options: Arguments of the problem.
        """
        d, up = dimension(cell), dimension(cell) - 1
        low, high = np.array([-1.0] * up + [-HEIGHT]), np.array([1.0] * up + [0.0])
        make = dolfinx.mesh.create_rectangle if d == 2 else dolfinx.mesh.create_box
        mesh = make(comm, [low * length, high * length], CELLS[cell], CellType[cell])

        def top(x: Array, cells: Array) -> Array:
            return at_coordinate(up, 0.0)(x, cells) & (
                np.abs(x[:, 0]) < contact_half_width * length
            )

        where = {
            SIDE: at_coordinate(0, -length),
            BASE: at_coordinate(up, -HEIGHT * length),
            TOP: top,
        }
        tags = tag_by_midpoints(mesh, where)
        self.u = fem.Function(displacement_space(mesh, 1))
        v = ufl.TestFunction(self.u.function_space)
        self._depth, self._force, self._length = depth * length, force * length**up, length
        self._pressure = pressure
        self.along, self.down, self.force, self.push = (fem.Constant(mesh, 0.0) for _ in range(4))
        zeros = [0.0] * (d - 2)
        motion: Any = ufl.as_vector([self.along, *zeros, self.down])
        if force:
            motion = fc.Motion(
                force=(*(None,) * up, self.force), displacement=(self.along, *zeros, None)
            )
        centre = (*(0.0,) * up, RADIUS * length)
        ball = fc.Ball(centre, RADIUS * length, displacement=motion)
        k = 1e5 / length
        law = law or fc.Coulomb(0.3, k_n=k, k_t=k)
        surface = fc.ContactSurface(mesh, tags, TOP)
        self.contact = fc.Contact(self.u, surface, ball, law, **(contact or {}))
        bcs = [dirichlet_bc(self.u, tags, BASE, i) for i in range(d)]
        F = residual(self.u, v, E, NU)
        if pressure:
            bcs = [dirichlet_bc(self.u, tags, SIDE, i) for i in range(up)]
            F -= self.push * v[up] * ufl.Measure("ds", mesh, subdomain_data=tags)(BASE)
        self.problem = fc.ContactProblem(F, self.u, bcs=bcs, contacts=[self.contact], **options)

    def load(self, t: float) -> None:
        """Set the displacement of the ball or the force on it, or the pressure on the base."""
        self.push.value = self._pressure * min(t, 1.0)
        if self._pressure:
            return
        self.down.value = -self._depth * min(t, 1.0)
        self.force.value = -self._force * min(t, 1.0)
        self.along.value = 0.25 * max(t - 1.0, 0.0) * self._length


class BlockUnderShoe(History):
    """A plane block under a rounded shoe, pressed until t = 1, then dragged with velocity 0.04.

    Attributes:
        u: Displacement of both bodies.
        contact, problem: The contact and its problem.
    """

    def __init__(
        self,
        law: Any = None,
        *,
        contact_half_width: float = 1.0,
        depth: float = DEPTH,
        update_pairs: str = "increment",
        contact: dict | None = None,
        **options: Any,
    ) -> None:
        """Create the unloaded problem. Collective.

        ``contact_half_width`` and ``depth`` are as in `IndentedBlock`.
        """
        self._depth = depth
        cell, x, cells, offset = "quadrilateral", [], [], 0
        for low, high, n in (
            ((-1.0, -HEIGHT), (1.0, 0.0), CELLS[cell]),
            ((-1.2, 0.0), (1.2, 0.3), (72, 4)),
        ):
            part = dolfinx.mesh.create_rectangle(MPI.COMM_SELF, [low, high], n, CellType[cell])
            x.append(part.geometry.x[:, :2].copy())
            cells.append(compat.geometry_dofmap(part) + offset)
            offset += len(x[-1])
        # The lower side of the shoe is a parabola with the radius of the ball in the middle.
        x[1][:, 1] += (1 - x[1][:, 1] / 0.3) * x[1][:, 0] ** 2 / (2 * RADIUS)
        mesh = create_mesh(cell, np.concatenate(x), np.concatenate(cells))

        def top(x: Array, cells: Array) -> Array:
            return (
                at_coordinate(1, 0.0)(x, cells)
                & (cells[:, 1] < 0)
                & (np.abs(x[:, 0]) < contact_half_width)
            )

        def sole(x: Array, cells: Array) -> Array:
            return (cells[:, 1] > 0) & (x[:, 1] < 0.2999) & (np.abs(x[:, 0]) < 1.1999)

        where = {
            BASE: at_coordinate(1, -HEIGHT),
            TOP: top,
            SOLE: sole,
            SHOE_TOP: at_coordinate(1, 0.3),
        }
        tags = tag_by_midpoints(mesh, where)
        self.u = fem.Function(displacement_space(mesh, 1))
        v = ufl.TestFunction(self.u.function_space)
        self.along, self.down = (fem.Constant(mesh, 0.0) for _ in range(2))
        bcs = [dirichlet_bc(self.u, tags, BASE, i) for i in range(2)]
        bcs += [
            dirichlet_bc(self.u, tags, SHOE_TOP, i, c)
            for i, c in enumerate((self.along, self.down))
        ]
        shoe = fc.DeformableBody(tags, SOLE, update_pairs=update_pairs)
        law = law or fc.Coulomb(0.3, k_n=1e5, k_t=1e5)
        surface = fc.ContactSurface(mesh, tags, TOP)
        self.contact = fc.Contact(self.u, surface, shoe, law, **(contact or {}))
        F = residual(self.u, v, E, NU)
        self.problem = fc.ContactProblem(F, self.u, bcs=bcs, contacts=[self.contact], **options)

    def load(self, t: float) -> None:
        """Set the displacement of the top of the shoe."""
        self.down.value = -self._depth * min(t, 1.0)
        self.along.value = 0.04 * max(t - 1.0, 0.0)
