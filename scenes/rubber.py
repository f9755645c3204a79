"""A block of rubber with a prescribed motion of its bottom, in contact with a rigid tool."""

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
from scenes.comparison import point_values
from scenes.elasticity import displacement_space, strain
from scenes.histories import History
from scenes.surfaces import ball, circle, ring

# Compared results must not differ by the residual of the solver.
TIGHT_TOLERANCE = {"snes_rtol": 1e-13}
# Mixed elements for displacement and pressure.
MIXED = ("Taylor-Hood", "MINI")


@dataclass
class Rubber:
    """A block whose top is Γc; the middle of the top is the origin of x (and y).

    Attributes:
        u: Function that is solved for, with the pressure if the element is mixed.
        displacement: Displacement, an expression of u (UFL).
        F: Residual of the bulk.
        prescribed: Prescribed displacement of the bottom.
    """

    mesh: dolfinx.mesh.Mesh
    tags: dolfinx.mesh.MeshTags
    u: fem.Function
    displacement: Any
    body: NeoHookean | LinearElastic
    F: ufl.Form
    prescribed: fem.Function
    bcs: list[fem.DirichletBC]
    height: float

    @property
    def dim(self) -> int:
        """2 or 3."""
        return self.mesh.geometry.dim

    def move_bottom(self, motion: Callable[[Array], Array]) -> None:
        """Move the bottom by a map of positions (dim, n) to positions."""
        d = self.dim
        self.prescribed.interpolate(lambda x: motion(x[:d]) - x[:d])

    def contact(
        self, obstacle: fc.Obstacle, law: Any, *, points_degree: int | None = None, **options: Any
    ) -> fc.Contact:
        """Return the contact of the top, by default with finite kinematics.

        ``points_degree`` is the quadrature degree on Γc.
        """
        surface = fc.ContactSurface(self.mesh, self.tags, TOP, quadrature_degree=points_degree)
        options = {"kinematics": "finite", "weight": self.body.weight} | options
        return fc.Contact(self.displacement, surface, obstacle, law, **options)

    def problem(
        self, obstacle: fc.Obstacle, law: Any, *, contact: dict | None = None, **options: Any
    ) -> tuple[fc.ContactProblem, fc.Contact]:
        """Return the problem and its contact; ``contact`` has arguments of `Rubber.contact`."""
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
    """Return a `Rubber` whose height is the last of the sizes; small strains if ``linear``.

    With ``mixed``, one of `MIXED`, the pressure is a second unknown, and ``degree`` is ignored.
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
    prescribed = fem.Function(u.function_space)
    dofs = fem.locate_dofs_topological(u.function_space, d - 1, tags.find(BOTTOM))
    bcs = [fem.dirichletbc(prescribed, dofs)]
    F = body.residual(ufl.TestFunction(u.function_space), ufl.dx(mesh))
    return Rubber(mesh, tags, u, u, body, F, prescribed, bcs, float(size[-1]))


def mixed_space(mesh: dolfinx.mesh.Mesh, name: str) -> fem.FunctionSpace:
    """Return the space of displacement, bubbles (MINI) and pressure; the name is in `MIXED`."""
    cell, d = mesh.topology.cell_name(), mesh.geometry.dim
    degree = 2 if name == "Taylor-Hood" else 1
    parts = [basix.ufl.element("P", cell, degree, shape=(d,))]
    if name == "MINI":
        parts.append(basix.ufl.element("Bubble", cell, d + 1, shape=(d,)))
    parts.append(basix.ufl.element("P", cell, 1))
    return fem.functionspace(mesh, basix.ufl.mixed_element(parts))


def split(fields: Sequence[Any]) -> tuple[Any, Any]:
    """Return displacement and pressure from the components of a function or test function."""
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
    """Return a `Rubber` with the pressure as second unknown."""
    W = mixed_space(mesh, name)
    w = fem.Function(W, name="w")
    (u, p), (v, q) = split(ufl.split(w)), split(ufl.TestFunctions(W))
    body = NeoHookean(u, E, nu, kind, isochoric=isochoric, pressure=p)
    # UFL would choose thousands of quadrature points per cell for bubbles in a nonlinear form.
    dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": 6} if name == "MINI" else {})
    if linear:
        G = E / (2 * (1 + nu))
        work = 2 * G * ufl.inner(strain(u), strain(v)) - p * ufl.div(v)
        F = (work - q * (ufl.div(u) + (1 - 2 * nu) / (2 * G * nu) * p)) * dx
    else:
        F = body.residual(v, dx, q=q)
    space, _ = W.sub(0).collapse()
    prescribed = fem.Function(space)
    dofs = fem.locate_dofs_topological((W.sub(0), space), tags.dim, tags.find(BOTTOM))
    bcs = [fem.dirichletbc(prescribed, dofs, W.sub(0))]
    return Rubber(mesh, tags, w, u, body, F, prescribed, bcs, height)


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
    """Return a rigid disc or ball that touches the middle of the top.

    Its rotation about its centre is given by ``angle``, or by ``moment``, or is zero.

    ``shape``: "ball" is exact; "profile" is a spline through 60 points in the plane, and a solid of
    revolution in space; "facets" are 24 segments in the plane and 512 triangles in space.
    """
    d = scene.dim
    centre = np.array((0.0,) * (d - 1) + (scene.height + radius,))
    rotation = None
    if angle is not None or moment is not None:
        rotation = fc.Rotation(angle, centre, None if d == 2 else axis, moment)
    motion = {"displacement": displacement, "rotation": rotation}
    if shape == "ball":
        return fc.Ball(centre, radius, **motion)
    if shape == "facets":
        if d == 2:
            return fc.RigidSurface(circle(24, radius, centre), ring(24), **motion)
        return fc.RigidSurface(*ball(3, radius, centre), **motion)
    if d == 2:
        return fc.RigidProfile(circle(60, radius, centre), closed=True, **motion)
    t = np.linspace(-np.pi / 2, np.pi / 2, 31)
    half = centre + radius * np.column_stack([np.cos(t), np.zeros(31), np.sin(t)])
    return fc.RigidProfile(half, turned=(centre, (0, 0, 1)), **motion)


class DiscOnRubber(History):
    """A disc that is pressed into a block of rubber, dragged and rotated.

    Attributes:
        shift, angle: Displacement and angle of rotation of the disc.
    """

    def __init__(
        self,
        cell: str = "triangle",
        *,
        law: Any = None,
        radius: float = 0.8,
        contact: dict | None = None,
        by_force: bool = False,
        by_moment: bool = False,
        shape: str = "ball",
        solver: dict | None = None,
        **options: Any,
    ) -> None:
        """Create block, disc and problem.

        Args:
            cell: Cell type of the block.
            law: Contact law, by default Coulomb's.
            radius: Radius of the disc.
            contact: Arguments of `Rubber.contact`.
            by_force: Whether the disc is pressed by a force, ``down``, instead of a displacement.
            by_moment: Whether the disc is rotated by a ``moment`` instead of an angle.
            shape: Shape of the disc, see `disc`.
            solver: Arguments of the problem.
            options: Arguments of `rubber`.
        """
        space = cell in ("tetrahedron", "hexahedron")
        options = {"n": (4, 2) if space else (12, 6), "degree": 1 if space else 2} | options
        self.scene = rubber(cell, options.pop("degree"), **options)
        mesh, d = self.scene.mesh, self.scene.dim
        self.shift, self.angle = fem.Constant(mesh, np.zeros(d)), fem.Constant(mesh, 0.0)
        self.down, self.side = fem.Constant(mesh, 0.0), fem.Constant(mesh, 0.0)
        self.moment = fem.Constant(mesh, 0.0)
        motion: Any = self.shift
        if by_force:
            zeros = (0.0,) * (d - 2)
            motion = fc.Motion(
                force=(*(None,) * (d - 1), self.down), displacement=(self.side, *zeros, None)
            )
        rotation = {"moment": self.moment} if by_moment else {"angle": self.angle}
        obstacle = disc(self.scene, radius, displacement=motion, shape=shape, **rotation)
        self.problem, self.contact = self.scene.problem(
            obstacle,
            law or fc.Coulomb(0.3, 1e4, 1e4),
            contact=contact,
            **{"petsc_options": TIGHT_TOLERANCE, **(solver or {})},
        )

    def load(self, t: float) -> None:
        """Press until t = 1, drag and rotate until 2, drag back and rotate further until 4."""
        down, along = min(t, 1.0), np.interp(t, [1, 2, 4], [0, 0.1, -0.1])
        self.shift.value[:] = self.vector(along, -0.12 * down)
        self.down.value, self.side.value = -60.0 * down, along
        self.angle.value = 0.2 * max(t - 1, 0.0)
        self.moment.value = 3.0 * np.interp(t, [1, 2, 4], [0, 1, -1])

    def vector(self, side: float, up: float) -> Array:
        """Return the vector with components ``side`` along x and ``up`` along the height."""
        value = np.zeros(self.scene.dim)
        value[0], value[-1] = side, up
        return value

    def solve_increment(self, side: float, up: float, angle: float = 0.0) -> fc.Step:
        """Solve and commit one increment with this displacement and angle of the disc."""
        self.shift.value[:], self.angle.value = self.vector(side, up), angle
        step = self.problem.solve()
        self.problem.commit()
        return step

    def resultant(self) -> Array:
        """Return the contact force on the body."""
        return self.contact.resultants().force

    def tractions(self) -> Array:
        """Return the tractions at all points, ordered by their undeformed coordinates."""
        return point_values(self.contact, self.contact.traction)


def bend_top(x):
    """Bend the top of a block [0, 2] x [0, 1] to a circle of radius 2 about (1, -1)."""
    top = np.sqrt(4 - (x[:, 0] - 1) ** 2) - 1
    return np.column_stack([x[:, 0], x[:, 1] * top])
