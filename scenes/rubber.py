"""A block of rubber, its bottom held and moved as a rigid body, under a rigid tool."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import basix.ufl
import dolfinx
import numpy as np
import ufl
from dolfinx import fem

import fenics_contact as fc
from fenics_contact.elasticity import LinearElastic, NeoHookean
from fenics_contact.types import Array
from scenes.blocks import BOTTOM, TOP, block_mesh, dimension
from scenes.comparing import at_points
from scenes.elasticity import displacement_space, strain
from scenes.histories import History
from scenes.surfaces import ball, circle, ring

# So that results are compared, and not what the solver leaves.
TIGHT = {"snes_rtol": 1e-13}
# Of displacement and pressure.
MIXED = ("Taylor-Hood", "MINI")


@dataclass
class Rubber:
    """A block; its top is Γc, in the middle of which is the origin of x (and y).

    Attributes:
        u: What is solved for.
        displacement: In it (UFL).
        F: Residual of the bulk.
        held: Displacement of the bottom.
    """

    mesh: dolfinx.mesh.Mesh
    tags: dolfinx.mesh.MeshTags
    u: fem.Function
    displacement: Any
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

    def contact(
        self, obstacle: fc.Obstacle, law: Any, *, points_degree: int | None = None, **options: Any
    ) -> fc.Contact:
        """Of the top, by finite kinematics; ``points_degree``: of the rule on Γc."""
        surface = fc.ContactSurface(self.mesh, self.tags, TOP, quadrature_degree=points_degree)
        options = {"kinematics": "finite", "weight": self.body.weight} | options
        return fc.Contact(self.displacement, surface, obstacle, law, **options)

    def problem(
        self, obstacle: fc.Obstacle, law: Any, *, contact: dict | None = None, **options: Any
    ) -> tuple[fc.ContactProblem, fc.Contact]:
        """The problem and its one contact; ``contact``: arguments of `Rubber.contact`."""
        made = self.contact(obstacle, law, **(contact or {}))
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
    mixed: str | None = None,
    isochoric: bool = False,
    kind: str | None = None,
    **mesh_arguments: Any,
) -> Rubber:
    """A `Rubber` of the last of the sizes in height; ``linear``: at small strains instead.

    ``mixed``: with a pressure, in one of `MIXED` elements, of which ``degree`` is not asked.
    """
    d = dimension(cell)
    size = np.asarray(size or [2.0] * (d - 1) + [1.0])
    n = n if np.ndim(n) == 0 or len(n) == d else (n[0], n[0], n[1])
    mesh, tags = block_mesh(cell, n=n, size=size, **mesh_arguments)
    mesh.geometry.x[:, : d - 1] -= size[: d - 1] / 2
    kind = kind or {2: "plane strain", 3: "3D"}[d]
    if mixed:
        return _mixed(mesh, tags, mixed, E, nu, kind, float(size[-1]), isochoric, linear)
    u = fem.Function(displacement_space(mesh, degree), name="u")
    options = {} if linear else {"isochoric": isochoric}
    body = (LinearElastic if linear else NeoHookean)(u, E, nu, kind, **options)
    held = fem.Function(u.function_space)
    dofs = fem.locate_dofs_topological(u.function_space, d - 1, tags.find(BOTTOM))
    bcs = [fem.dirichletbc(held, dofs)]
    F = body.residual(ufl.TestFunction(u.function_space), ufl.dx(mesh))
    return Rubber(mesh, tags, u, u, body, F, held, bcs, float(size[-1]))


def mixed_space(mesh: dolfinx.mesh.Mesh, name: str) -> fem.FunctionSpace:
    """Displacement, bubbles if there are any, and pressure; the name is one of `MIXED`."""
    cell, d = mesh.topology.cell_name(), mesh.geometry.dim
    degree = 2 if name == "Taylor-Hood" else 1
    parts = [basix.ufl.element("P", cell, degree, shape=(d,))]
    if name == "MINI":
        parts.append(basix.ufl.element("Bubble", cell, d + 1, shape=(d,)))
    parts.append(basix.ufl.element("P", cell, 1))
    return fem.functionspace(mesh, basix.ufl.mixed_element(parts))


def split(fields: Sequence[Any]) -> tuple[Any, Any]:
    """Displacement and pressure of the parts of a function, or test functions of both."""
    first, *bubbles, last = fields
    return sum(bubbles, first), last


def _mixed(
    mesh: dolfinx.mesh.Mesh,
    tags: dolfinx.mesh.MeshTags,
    name: str,
    E: float,
    nu: float,
    kind: str,
    height: float,
    isochoric: bool,
    linear: bool,
) -> Rubber:
    """A `Rubber` with a pressure."""
    W = mixed_space(mesh, name)
    w = fem.Function(W, name="w")
    (u, p), (v, q) = split(ufl.split(w)), split(ufl.TestFunctions(W))
    body = NeoHookean(u, E, nu, kind, isochoric=isochoric, pressure=p)
    # UFL would take thousands of points a cell for bubbles in a nonlinear form.
    dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": 6} if name == "MINI" else {})
    if linear:
        G = E / (2 * (1 + nu))
        work = 2 * G * ufl.inner(strain(u), strain(v)) - p * ufl.div(v)
        F = (work - q * (ufl.div(u) + (1 - 2 * nu) / (2 * G * nu) * p)) * dx
    else:
        F = body.residual(v, dx, q=q)
    space, _ = W.sub(0).collapse()
    held = fem.Function(space)
    dofs = fem.locate_dofs_topological((W.sub(0), space), tags.dim, tags.find(BOTTOM))
    bcs = [fem.dirichletbc(held, dofs, W.sub(0))]
    return Rubber(mesh, tags, w, u, body, F, held, bcs, height)


SHAPES = ("ball", "profile", "facets")


def disc(
    scene: Rubber,
    radius: float,
    *,
    displacement: Any = None,
    angle: Any = None,
    moment: Any = None,
    axis: Sequence[float] = (0, 1, 0),
    shape: str = "ball",
) -> fc.Obstacle:
    """A rigid disc or ball that touches the middle of the top; it turns about its centre.

    By ``angle``, or by ``moment``, or not at all.

    ``shape``: "ball" is exact; "profile" is a spline through 60 points, turned in space; "facets"
    are 24 segments in the plane, 512 triangles in space.
    """
    d = scene.dim
    centre = np.array((0.0,) * (d - 1) + (scene.height + radius,))
    turn = None
    if angle is not None or moment is not None:
        turn = fc.Rotation(angle, centre, None if d == 2 else axis, moment)
    move = {"displacement": displacement, "rotation": turn}
    if shape == "ball":
        return fc.Ball(centre, radius, **move)
    if shape == "facets":
        if d == 2:
            return fc.RigidSurface(circle(24, radius, centre), ring(24), **move)
        return fc.RigidSurface(*ball(3, radius, centre), **move)
    if d == 2:
        return fc.RigidProfile(circle(60, radius, centre), closed=True, **move)
    t = np.linspace(-np.pi / 2, np.pi / 2, 31)
    half = centre + radius * np.column_stack([np.cos(t), np.zeros(31), np.sin(t)])
    return fc.RigidProfile(half, turned=(centre, (0, 0, 1)), **move)


class Tool(History):
    """A disc that presses, is dragged and turns, on a block of rubber.

    Attributes:
        shift, angle: Of the disc.
    """

    def __init__(
        self,
        cell: str = "triangle",
        *,
        law: Any = None,
        radius: float = 0.8,
        contact: dict | None = None,
        force: bool = False,
        driven: bool = False,
        shape: str = "ball",
        solver: dict | None = None,
        **options: Any,
    ) -> None:
        """Make the scene.

        Args:
            cell: Of the block.
            law: Of the contact.
            radius: Of the disc.
            contact: Arguments of the `Contact`.
            force: Whether the disc is pressed by a force, ``down``, instead of a displacement.
            driven: Whether the disc is turned by a ``moment``, instead of an angle.
            shape: Of the disc, see `disc`.
            solver: Arguments of the problem.
            options: Of `rubber`.
        """
        space = cell in ("tetrahedron", "hexahedron")
        options = {"n": (4, 2) if space else (12, 6), "degree": 1 if space else 2} | options
        self.scene = rubber(cell, options.pop("degree"), **options)
        mesh, d = self.scene.mesh, self.scene.dim
        self.shift, self.angle = fem.Constant(mesh, np.zeros(d)), fem.Constant(mesh, 0.0)
        self.down, self.side = fem.Constant(mesh, 0.0), fem.Constant(mesh, 0.0)
        self.moment = fem.Constant(mesh, 0.0)
        motion: Any = self.shift
        if force:
            still = (0.0,) * (d - 2)
            motion = fc.Motion(
                force=(*(None,) * (d - 1), self.down), displacement=(self.side, *still, None)
            )
        turn = {"moment": self.moment} if driven else {"angle": self.angle}
        obstacle = disc(self.scene, radius, displacement=motion, shape=shape, **turn)
        self.problem, self.contact = self.scene.problem(
            obstacle,
            law or fc.Coulomb(0.3, 1e4, 1e4),
            contact=contact,
            **{"petsc_options": TIGHT, **(solver or {})},
        )

    def load(self, t: float) -> None:
        """Down until 1, along and turned until 2, back and turned on until 4."""
        down, along = min(t, 1.0), np.interp(t, [1, 2, 4], [0, 0.1, -0.1])
        self.shift.value[:] = self.vector(along, -0.12 * down)
        self.down.value, self.side.value = -60.0 * down, along
        self.angle.value = 0.2 * max(t - 1, 0.0)
        self.moment.value = 3.0 * np.interp(t, [1, 2, 4], [0, 1, -1])

    def vector(self, side: float, up: float) -> Array:
        """Components along x and along the height."""
        value = np.zeros(self.scene.dim)
        value[0], value[-1] = side, up
        return value

    def go(self, side: float, up: float, angle: float = 0.0) -> fc.Step:
        """One increment of the disc to a place and angle."""
        self.shift.value[:], self.angle.value = self.vector(side, up), angle
        step = self.problem.solve()
        self.problem.commit()
        return step

    def resultant(self) -> Array:
        """The contact force on the body."""
        return self.contact.resultants().force

    def tractions(self) -> Array:
        """On the body at all points, ordered by their places in the undeformed body."""
        return at_points(self.contact, self.contact.traction)


def domed(x):
    """The top of a block [0, 2] x [0, 1] bent to a circle of radius 2 about (1, -1)."""
    top = np.sqrt(4 - (x[:, 0] - 1) ** 2) - 1
    return np.column_stack([x[:, 0], x[:, 1] * top])
