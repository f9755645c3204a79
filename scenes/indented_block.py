"""A rigid cylinder pressed into a block with a symmetry axis, for mesh adaptation."""

from __future__ import annotations

from typing import Any

import dolfinx
import ufl
from dolfinx import fem
from dolfinx.mesh import GhostMode
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.elasticity import LinearElastic
from scenes.elasticity import dirichlet_bc, displacement_space
from scenes.tags import plane, tag_by_nodes

BASE, TOP, AXIS = 1, 2, 3
RADIUS, DEPTH, STIFFNESS = 4.0, 0.01, 1e5


def half_block(n: int) -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags]:
    """Return the half [0, 1] x [-1, 0] of a block in triangles, and its tags. Collective."""
    mesh = dolfinx.mesh.create_rectangle(
        MPI.COMM_WORLD, [(0, -1), (1, 0)], (n, n), ghost_mode=GhostMode.none
    )
    return mesh, tag_by_nodes(mesh, {BASE: plane(1, -1), TOP: plane(1, 0), AXIS: plane(0, 0)})


def solve_indentation(
    mesh: dolfinx.mesh.Mesh, tags: dolfinx.mesh.MeshTags, friction: float = 0.0, steps: int = 1
) -> tuple[fc.ContactProblem, Any, Any]:
    """Solve in ``steps`` increments; return problem, stress and strain (UFL). Collective."""
    space = displacement_space(mesh, 2)
    u, v = fem.Function(space), ufl.TestFunction(space)
    body = LinearElastic(u, 1000.0, 0.3, "plane strain")
    bcs = [dirichlet_bc(u, tags, tag, i) for tag, i in ((BASE, 0), (BASE, 1), (AXIS, 0))]
    down = fem.Constant(mesh, 0.0)
    cylinder = fc.Cylinder((0.0, RADIUS), RADIUS, displacement=ufl.as_vector([0, down]))
    law: fc.Coulomb | fc.Frictionless = fc.Frictionless(STIFFNESS)
    if friction:
        law = fc.Coulomb(friction, STIFFNESS, STIFFNESS)
    contact = fc.Contact(u, fc.ContactSurface(mesh, tags, TOP), cylinder, law)
    problem = fc.ContactProblem(body.residual(v), u, bcs=bcs, contacts=[contact], method="newton")
    list(fc.increments(problem, down, 0.0, -DEPTH, steps=steps))
    return problem, body.stress, body.strain(u)
