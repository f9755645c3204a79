"""A block of rubber, its bottom held and moved as a rigid body, under a rigid tool."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import dolfinx
import numpy as np
import ufl
from dolfinx import fem

import fenics_contact as fc
from fenics_contact.elasticity import LinearElastic, NeoHookean
from scenes.blocks import BOTTOM, TOP, block_mesh, dimension
from scenes.elasticity import displacement_space

Array = np.ndarray


@dataclass
class Rubber:
    """A block; its top is Γc, in the middle of which is the origin of x (and y).

    Attributes:
        F: Residual of the bulk.
        held: Displacement of the bottom.
    """

    mesh: dolfinx.mesh.Mesh
    tags: dolfinx.mesh.MeshTags
    u: fem.Function
    body: NeoHookean | LinearElastic
    F: ufl.Form
    held: fem.Function
    bcs: list[fem.DirichletBC]
    height: float

    @property
    def dim(self) -> int:
        """2 or 3."""
        return self.mesh.geometry.dim

    def place(self, motion: Callable[[Array], Array]) -> None:
        """Move the bottom: places (dim, n) -> places."""
        d = self.dim
        self.held.interpolate(lambda x: motion(x[:d]) - x[:d])

    def contact(self, support: fc.Support, law: Any, **options: Any) -> fc.Contact:
        """Of the top, by finite kinematics."""
        surface = fc.ContactSurface(self.mesh, self.tags, TOP)
        options = {"kinematics": "finite", "weight": self.body.weight} | options
        return fc.Contact(self.u, surface, support, law, **options)

    def problem(
        self, support: fc.Support, law: Any, *, contact: dict | None = None, **options: Any
    ) -> tuple[fc.ContactProblem, fc.Contact]:
        """The problem and its one contact; ``contact``: arguments of `Rubber.contact`."""
        made = self.contact(support, law, **(contact or {}))
        problem = fc.ContactProblem(self.F, self.u, bcs=self.bcs, contacts=[made], **options)
        return problem, made


def rubber(
    cell: str = "triangle",
    degree: int = 2,
    *,
    n: int | Sequence[int] = (8, 4),
    size: Sequence[float] | None = None,
    E: float = 1000.0,
    nu: float = 0.3,
    linear: bool = False,
    **mesh_arguments: Any,
) -> Rubber:
    """A `Rubber` of the last of the sizes in height; ``linear``: at small strains instead."""
    d = dimension(cell)
    size = np.asarray(size or [2.0] * (d - 1) + [1.0])
    n = n if np.ndim(n) == 0 or len(n) == d else (n[0], n[0], n[1])
    mesh, tags = block_mesh(cell, n=n, size=size, **mesh_arguments)
    mesh.geometry.x[:, : d - 1] -= size[: d - 1] / 2
    u = fem.Function(displacement_space(mesh, degree), name="u")
    kind = {2: "plane strain", 3: "3D"}[d]
    body = (LinearElastic if linear else NeoHookean)(u, E, nu, kind)
    held = fem.Function(u.function_space)
    dofs = fem.locate_dofs_topological(u.function_space, d - 1, tags.find(BOTTOM))
    bcs = [fem.dirichletbc(held, dofs)]
    F = body.residual(ufl.TestFunction(u.function_space), ufl.dx(mesh))
    return Rubber(mesh, tags, u, body, F, held, bcs, float(size[-1]))


def disc(
    scene: Rubber, radius: float, *, displacement: Any = None, angle: Any = None, **options: Any
) -> fc.Ball:
    """A rigid disc or ball that touches the middle of the top; it turns about its centre."""
    d = scene.dim
    centre = (0.0,) * (d - 1) + (scene.height + radius,)
    turn = None
    if angle is not None:
        turn = fc.Rotation(angle, centre, None if d == 2 else options.pop("axis", (0, 1, 0)))
    return fc.Ball(centre, radius, displacement=displacement, rotation=turn)
