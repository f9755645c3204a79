"""Contact problems of the demos and of the benchmarks, described apart from their solution.

A `ContactScene` has mesh, obstacle and loads. `elasticity_problem` makes its displacement, residual
and Dirichlet conditions, `problem` the contact problem of this package, and
`reference_penalty_traction` the boundary form of a reference solution with DOLFINx alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import dolfinx
import numpy as np
import scipy.optimize
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from demos import greco_block as greco
from demos import hertz, shrink_fit, sphere
from fenics_contact import output
from fenics_contact.elasticity import LinearElastic
from scenes.elasticity import dirichlet_bc, displacement_space
from scenes.tags import plane, tag_by_nodes

ElasticityProblem = tuple[fem.Function, ufl.Form, fem.Constant, list[fem.DirichletBC]]


@dataclass(frozen=True)
class ContactScene:
    """An elastic body with its mesh, obstacle, boundary conditions and loads.

    Attributes:
        mesh, tags: The mesh and the tags of its facets.
        E, nu, kind: Arguments of `LinearElastic`.
        friction: Friction coefficient μ.
        surface: Tag of Γc.
        fixed_components: Pairs (component, tag) of displacement components that are fixed at zero.
        final_load: Final value of the load parameter.
        load_work: Virtual work of the loads (test function, load parameter, ds).
        contact: Function of the load parameter that returns the obstacle, and the gap if it is not
            given by the geometry, as arguments of `fc.Contact`.
        displacement: Function of u that returns the displacement to compare.
        linear_solve_fixed_facets: Facets fixed in a linear solve, whose duration is the unit of
            time.
        linear_solve_load_work: Virtual work of the loads of that solve (test function, ds), by
            default ``load_work`` at the final load.
        force_scale: Approximate contact force, the scale of residuals (force).
        h: Height of the cells at Γc; the reference form has k = stiffness E/h (length).
        reference_contact: Function of the position x and the load parameter that returns, for the
            reference form, the normal from the body to the obstacle, the gap and the obstacle's
            motion (UFL).
        initial_displacement: Initial displacement of the reference Newton method, if it must start
            in contact.
        is_path_dependent: Whether the result depends on the load increments.
    """

    mesh: dolfinx.mesh.Mesh
    tags: dolfinx.mesh.MeshTags
    E: float
    nu: float
    kind: str
    friction: float
    surface: int
    fixed_components: tuple[tuple[int, int], ...]
    final_load: float
    load_work: Callable[[Any, Any, ufl.Measure], Any]
    contact: Callable[[Any], dict[str, Any]]
    displacement: Callable[[fem.Function], float]
    linear_solve_fixed_facets: tuple[int, ...] = ()
    linear_solve_load_work: Callable[[Any, ufl.Measure], Any] | None = None
    force_scale: float = 0.0
    h: float = 0.0
    reference_contact: Callable[[Any, Any], tuple[Any, Any, Any]] | None = None
    initial_displacement: tuple[float, ...] = ()
    is_path_dependent: bool = False

    @property
    def ds(self) -> ufl.Measure:
        """The boundary measure with the facet tags."""
        return ufl.Measure("ds", domain=self.mesh, subdomain_data=self.tags)

    def elastic(self, u: fem.Function) -> LinearElastic:
        """Return the elastic law of the body for the displacement u."""
        return LinearElastic(u, self.E, self.nu, self.kind)


# ---- problem and reference form ------------------------------------------------------------------


def elasticity_problem(body: ContactScene, degree: int) -> ElasticityProblem:
    """Return displacement, residual without contact, load parameter (0) and Dirichlet values."""
    space = displacement_space(body.mesh, degree)
    u, v = fem.Function(space), ufl.TestFunction(space)
    load = fem.Constant(body.mesh, PETSc.ScalarType(0.0))
    residual = body.elastic(u).residual(v)
    residual -= body.load_work(v, load, body.ds)
    return (
        u,
        residual,
        load,
        [dirichlet_bc(u, body.tags, tag, i) for i, tag in body.fixed_components],
    )


def law(body: ContactScene, stiffness: float) -> fc.Coulomb | fc.Frictionless:
    """Return the law, Coulomb's or frictionless, with k_n = k_t = ``stiffness`` E/h."""
    k = fc.RelativeStiffness(stiffness)
    return fc.Coulomb(body.friction, k_n=k, k_t=k) if body.friction else fc.Frictionless(k_n=k)


def problem(
    body: ContactScene,
    degree: int,
    stiffness: float | fc.Law,
    *,
    elasticity: ElasticityProblem | None = None,
    contact_options: Mapping[str, Any] | None = None,
    surface_options: Mapping[str, Any] | None = None,
    **options: Any,
) -> tuple[fc.ContactProblem, fc.Contact, fem.Function, fem.Constant]:
    """Return this package's contact problem, its contact, displacement and load parameter (0).

    Args:
        body: The body.
        degree: Polynomial degree of the displacement.
        stiffness: k_n and k_t in units of E/h, or the law.
        elasticity: Result of `elasticity_problem`, if it has been called already.
        contact_options: More arguments of `fc.Contact`.
        surface_options: Arguments of `fc.ContactSurface`, such as its quadrature.
        **options: Arguments of `fc.ContactProblem`.
    """
    u, residual, load, bcs = elasticity or elasticity_problem(body, degree)
    surface = fc.ContactSurface(body.mesh, body.tags, body.surface, **(surface_options or {}))
    given = stiffness if isinstance(stiffness, fc.Law) else law(body, stiffness)
    contact = fc.Contact(u, surface, law=given, **(contact_options or {}), **body.contact(load))
    problem = fc.ContactProblem(residual, u, bcs=bcs, contacts=[contact], **options)
    return problem, contact, u, load


def reference_penalty_traction(
    body: ContactScene, u: fem.Function, load: Any, stiffness: float
) -> tuple[Any, Any]:
    """Return pressure and traction on Γc of the reference penalty form for one increment (UFL).

    Args:
        body: The body.
        u: Displacement of the body.
        load: The load parameter.
        stiffness: k_n and k_t in units of E/h.
    """
    assert body.reference_contact is not None
    k = fem.Constant(body.mesh, stiffness * body.E / body.h)
    n, gap, motion = body.reference_contact(ufl.SpatialCoordinate(body.mesh), load)
    pressure = k * ufl.max_value(ufl.dot(u, n) - gap, 0.0)
    if not body.friction:
        return pressure, -pressure * n
    jump = u - motion
    trial = -k * (jump - ufl.dot(jump, n) * n)
    size = ufl.sqrt(ufl.dot(trial, trial) + 1e-30)
    limit = fem.Constant(body.mesh, body.friction) * pressure
    return pressure, -pressure * n + ufl.conditional(ufl.lt(size, limit), 1.0, limit / size) * trial


def n_dofs(space: fem.FunctionSpace) -> int:
    """Return the number of dofs on all ranks."""
    return int(space.dofmap.index_map.size_global * space.dofmap.bs)


def n_facet_dofs(space: fem.FunctionSpace, facets: np.ndarray) -> int:
    """Return the number of dofs on the given facets of all ranks. Collective."""
    found = fem.locate_dofs_topological(space, space.mesh.topology.dim - 1, facets)
    owned = np.count_nonzero(found < space.dofmap.index_map.size_local)
    return int(space.mesh.comm.allreduce(owned) * space.dofmap.bs)


# ---- in the plane --------------------------------------------------------------------------------


@cache
def half_cylinder(
    friction: float, h: float, *, smooth: bool = False, **growth: float
) -> ContactScene:
    """Return the demo's half-cylinder on a plane.

    With ``smooth``, cells away from Γc are refined together with those on it; the error of the
    displacement of the top is then below 1e-6 at h = 0.02. Otherwise ``growth`` are the arguments
    of the demo's mesh for the cells away from Γc.
    """
    if smooth:
        growth = {"grading": min(0.3, 2.5 * h), "coarsest": min(hertz.R / 4, 12.5 * h)}
    mesh, tags = hertz.make_mesh(h, 1.3 * hertz.hertz(hertz.PAPER_LOAD)[0], **growth)
    return ContactScene(
        mesh=mesh,
        tags=tags,
        E=hertz.E,
        nu=hertz.NU,
        kind="plane strain",
        friction=friction,
        surface=hertz.CONTACT,
        linear_solve_fixed_facets=(hertz.CONTACT,),
        fixed_components=((0, hertz.AXIS),),
        final_load=hertz.PAPER_LOAD,
        load_work=lambda v, load, ds: -load * v[1] * ds(hertz.TOP),
        contact=lambda load: {"obstacle": fc.HalfSpace((0, 0), (0, 1))},
        displacement=lambda u: float(output.at_node(u, (0.0, hertz.R))[1]),
        force_scale=hertz.R * hertz.PAPER_LOAD,
        h=h,
        reference_contact=_reference_plane,
        # Only contact constrains the vertical rigid-body mode.
        initial_displacement=(0.0, -0.05),
        is_path_dependent=friction > 0,
    )


@cache
def greco_block(cells: int) -> ContactScene:
    """Return the demo's GRECO block; its displacement is u_x of the left bottom corner (µm)."""
    mesh, tags = greco.make_mesh(cells)
    return ContactScene(
        mesh=mesh,
        tags=tags,
        E=greco.E,
        nu=greco.NU,
        kind="plane strain",
        friction=greco.FRICTION,
        surface=greco.BOTTOM,
        linear_solve_fixed_facets=(greco.BOTTOM,),
        fixed_components=((0, greco.RIGHT),),
        final_load=1.0,
        load_work=lambda v, load, ds: (
            load
            * (
                greco.SIDE_PRESSURE * v[0] * ds(greco.LEFT)
                - greco.TOP_PRESSURE * v[1] * ds(greco.TOP)
            )
        ),
        contact=lambda load: {"obstacle": fc.HalfSpace((0, 0), (0, 1))},
        displacement=lambda u: 1e3 * float(output.at_node(u, (0.0, 0.0))[0]),
        force_scale=greco.SIZE * greco.TOP_PRESSURE,
        h=greco.SIZE / cells,
        reference_contact=_reference_plane,
        initial_displacement=(0.0, -0.02),
    )


def _reference_plane(x: Any, load: Any) -> tuple[Any, Any, Any]:
    """Return normal, gap and motion of the fixed plane y = 0."""
    return ufl.as_vector([0, -1]), x[1], ufl.as_vector([0, 0])


@cache
def rings(h: float) -> ContactScene:
    """Return the demo's shrink fit in plane strain; its displacement is u_x of the bore."""
    s = shrink_fit
    mesh, tags = s.make_mesh(h)
    return ContactScene(
        mesh=mesh,
        tags=tags,
        E=s.E,
        nu=s.NU,
        kind="plane strain",
        friction=0.0,
        surface=s.SHAFT,
        fixed_components=((1, s.FLAT), (0, s.UPRIGHT)),
        final_load=-s.OVERSIZE,
        load_work=lambda v, load, ds: 0 * v[0] * ds(s.SHAFT),
        contact=lambda load: {"obstacle": fc.DeformableBody(tags, s.HUB), "gap": load},
        displacement=lambda u: float(output.at_node(u, (s.INNER, 0))[0]),
        linear_solve_fixed_facets=(s.SHAFT, s.HUB),
    )


# ---- in space ------------------------------------------------------------------------------------


@cache
def ball_on_half_space(cells: int) -> ContactScene:
    """Return the demo's frictionless ball on a block of tetrahedra, ``cells`` per contact radius.

    The displacement is u_z below the centre of the ball.
    """
    depth = 4e-4
    mesh, tags = sphere.make_mesh("block", np.sqrt(sphere.R * depth), cells)
    return ContactScene(
        mesh=mesh,
        tags=tags,
        E=sphere.E,
        nu=sphere.NU,
        kind="3D",
        friction=0.0,
        surface=sphere.CONTACT,
        linear_solve_fixed_facets=(sphere.CONTACT,),
        fixed_components=(
            (0, sphere.AT_X),
            (1, sphere.AT_Y),
            *((i, sphere.HELD) for i in range(3)),
        ),
        final_load=-depth,
        load_work=lambda v, load, ds: 0 * v[0] * ds(sphere.HELD),
        contact=lambda load: _ball(sphere.R, load),
        displacement=lambda u: float(output.at_node(u, (0.0, 0.0, 0.0))[2]),
    )


# Radius and indentation depth of the ball: a = √(R d) = 0.1; the block has edges of length 1.
RADIUS, DEPTH = 8.0, 1.25e-3
WIDTH = 0.15  # width of Γc
AT_X, AT_Y, AT_Z, FAR_X, FAR_Y, CONTACT = range(1, 7)


@cache
def ball_on_block(cells: int, friction: float = 0.3) -> ContactScene:
    """Return a rigid ball pressed on a quarter of a block of hexahedra, ``cells`` along each edge.

    Half of the cells of an edge lie on Γc, which is 1.5 contact radii wide, and are cubes. The far
    sides are fixed. The displacement is u_z at the end of Γc on the x axis. Collective.
    """
    mesh = dolfinx.mesh.create_unit_cube(
        MPI.COMM_WORLD, *(cells,) * 3, dolfinx.mesh.CellType.hexahedron
    )
    x = mesh.geometry.x
    x[:] = np.interp(x, np.linspace(0, 1, cells + 1), graded_coordinates(cells))
    x[:, 2] *= -1
    where: dict[int, Any] = {
        AT_X: plane(0, 0.0),
        AT_Y: plane(1, 0.0),
        AT_Z: plane(2, -1.0),
        FAR_X: plane(0, 1.0),
        FAR_Y: plane(1, 1.0),
    }
    where[CONTACT] = lambda x: np.isclose(x[2], 0) & (np.max(x[:2], axis=0) < WIDTH + 1e-9)
    far = [(i, tag) for tag in (AT_Z, FAR_X, FAR_Y) for i in range(3)]
    return ContactScene(
        mesh=mesh,
        tags=tag_by_nodes(mesh, where),
        E=1.0,
        nu=0.3,
        kind="3D",
        friction=friction,
        surface=CONTACT,
        fixed_components=((0, AT_X), (1, AT_Y), *far),
        final_load=-DEPTH,
        load_work=lambda v, load, ds: 0 * v[2] * ds(CONTACT),
        linear_solve_load_work=lambda v, ds: -v[2] * ds(CONTACT),
        contact=lambda load: _ball(RADIUS, load),
        displacement=lambda u: float(output.at_node(u, (WIDTH, 0.0, 0.0))[2]),
        force_scale=hertz_force() / 4,
        h=WIDTH / (cells // 2),
        reference_contact=_reference_ball,
    )


# Radius and indentation depth of the ball on a cube: a = √(R d) = 0.14.
TAGGED_RADIUS, TAGGED_DEPTH = 2.0, 0.01


@cache
def ball_on_tagged_block(cells: int, friction: float = 0.3) -> ContactScene:
    """Return a rigid ball pressed on a unit cube of tetrahedra, ``cells`` along each edge.

    Γc is the whole top, of which a sixteenth is in contact; the base is fixed. The displacement is
    u_z below the centre of the ball. Collective.
    """
    mesh = dolfinx.mesh.create_box(
        MPI.COMM_WORLD, [[-0.5, -0.5, -1.0], [0.5, 0.5, 0.0]], (cells,) * 3
    )
    force = 4 / 3 / (1 - 0.3**2) * np.sqrt(TAGGED_RADIUS) * TAGGED_DEPTH**1.5
    return ContactScene(
        mesh=mesh,
        tags=tag_by_nodes(mesh, {AT_Z: plane(2, -1.0), CONTACT: plane(2, 0.0)}),
        E=1.0,
        nu=0.3,
        kind="3D",
        friction=friction,
        surface=CONTACT,
        fixed_components=tuple((i, AT_Z) for i in range(3)),
        final_load=-TAGGED_DEPTH,
        load_work=lambda v, load, ds: 0 * v[2] * ds(CONTACT),
        linear_solve_load_work=lambda v, ds: -v[2] * ds(CONTACT),
        contact=lambda load: _ball(TAGGED_RADIUS, load),
        displacement=lambda u: float(output.at_node(u, (0.0, 0.0, 0.0))[2]),
        force_scale=force,
        h=1 / cells,
        reference_contact=lambda x, load: _reference_ball(x, load, TAGGED_RADIUS),
    )


def hertz_force() -> float:
    """Return Hertz's force of the ball on a half-space of this material, F = 4/3 E* √R d^(3/2)."""
    return 4 / 3 / (1 - 0.3**2) * np.sqrt(RADIUS) * DEPTH**1.5


def graded_coordinates(cells: int) -> np.ndarray:
    """Return node coordinates of an edge: equal cells on Γc, then growth by a constant factor."""
    near = cells // 2
    h, away = WIDTH / near, np.arange(1, cells - near + 1)
    growth = scipy.optimize.brentq(lambda q: h * np.sum(q**away) - (1 - WIDTH), 1.0, 3.0)
    return np.concatenate([h * np.arange(near + 1), WIDTH + h * np.cumsum(growth**away)])


def _ball(radius: float, load: Any) -> dict[str, Any]:
    """Return a ball that touches z = 0 at the origin and moves along z by ``load``."""
    moved = ufl.as_vector([0, 0, load])
    return {"obstacle": fc.Ball((0, 0, radius), radius, displacement=moved)}


def _reference_ball(x: Any, load: Any, radius: float = RADIUS) -> tuple[Any, Any, Any]:
    """Return normal, gap and motion of that ball for the reference form."""
    arm = ufl.as_vector([0, 0, radius + load]) - x
    distance = ufl.sqrt(ufl.dot(arm, arm))
    return arm / distance, distance - radius, ufl.as_vector([0, 0, load])
