"""A user-defined obstacle, a rigid ring of round section, is pressed on a block."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

import fenics_contact as fc


@dataclass(frozen=True)
class Torus(fc.Obstacle):
    """A rigid torus about an axis along z."""

    center: Sequence[float]
    ring: float  # radius of the circle that the centres of the sections lie on, mm
    section: float  # radius of a section, mm
    displacement: Any = None
    rotation: Any = None

    @property
    def smallest_radius(self):
        """Facets that are long relative to this length get more quadrature points."""
        return self.section

    def place(self, x, to_ufl):
        """Return the signed distance from the torus at x, and the direction to it."""
        arm = x - to_ufl(np.asarray(self.center, dtype=float))
        rho = ufl.sqrt(arm[0] ** 2 + arm[1] ** 2)
        nearest = to_ufl(self.ring) / rho  # times (arm_x, arm_y): on the circle
        direction = ufl.as_vector([(nearest - 1) * arm[0], (nearest - 1) * arm[1], -arm[2]])
        gap = ufl.sqrt(ufl.dot(direction, direction)) - to_ufl(self.section)
        return fc.Placement(gap, direction)


E, NU, RING, SECTION, BOTTOM, TOP = 1e3, 0.3, 1.5, 0.5, 1, 2  # MPa, mm
box = [(0.25, 0.25, 0.0), (2.25, 2.25, 1.0)]  # a quarter of the ring; its axis is x = y = 0
msh = mesh.create_box(MPI.COMM_WORLD, box, (12, 12, 4), mesh.CellType.hexahedron)
facets = mesh.locate_entities_boundary(msh, 2, lambda x: np.isclose(x[2], 0) | np.isclose(x[2], 1))
z = mesh.compute_midpoints(msh, 2, facets)[:, 2]
tags = mesh.meshtags(msh, 2, facets, np.where(z < 0.5, BOTTOM, TOP).astype(np.int32))
V = fem.functionspace(msh, ("Lagrange", 1, (3,)))


def press(obstacle, push):
    """Return the force on the block after the ring is moved up into it."""
    push(0.0)
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = fc.elasticity.LinearElastic(u, E, NU, "3D").residual(v)
    top = fem.locate_dofs_topological(V, 2, tags.find(TOP))
    fixed = fem.dirichletbc(np.zeros(3), top, V)
    surface = fc.ContactSurface(msh, tags, BOTTOM, quadrature_degree=4)
    contact = fc.Contact(u, surface, obstacle, fc.Coulomb(0.2))
    problem = fc.ContactProblem(F, u, bcs=[fixed], contacts=[contact])
    for _ in fc.increments(problem, push, 0.0, 0.05, steps=2):
        pass
    return contact.resultants().force


travel = fem.Constant(msh, np.zeros(3))


def set_travel(depth):
    """Move the obstacle up."""
    travel.value[2] = depth


def to_torus(x):
    """Return the signed distance of the torus."""
    rho = ufl.sqrt(x[0] ** 2 + x[1] ** 2)
    return ufl.sqrt((rho - RING) ** 2 + (x[2] + SECTION) ** 2) - SECTION


ring = Torus((0, 0, -SECTION), RING, SECTION, displacement=travel)
found = press(ring, set_travel)
expected = press(fc.SignedDistance(to_torus, displacement=travel), set_travel)
if msh.comm.rank == 0:
    print(f"force {found[2]:.6g} N; by a SignedDistance {expected[2]:.6g} N")
    assert found[2] > 0 and np.allclose(found, expected, rtol=1e-7)
