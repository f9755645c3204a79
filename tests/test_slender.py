"""Slender bodies of rubber, which a step of Newton's method turns and thereby stretches."""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.elasticity import NeoHookean

COMM = MPI.COMM_WORLD
pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(300)]

E, NU, LENGTH, HEIGHT, CLEARANCE = 1000.0, 0.3, 20.0, 1.0, 3.0
BOTTOM = 1


@pytest.mark.parametrize("law", [fc.Frictionless(), fc.Coulomb(0.3)], ids=["smooth", "rough"])
def test_a_beam_sags_on_a_plane(law):
    """Clamped at one end, 20 times as long as high; its weight grows in ten increments.

    The first bends it by as much as it is high, the second lays it on the plane, the others press
    it down, on its tip alone: a propped cantilever under its weight q, the tip sunk by d, bears
    3 q L/8 - 3 E I d/L³ there, to 2 % (d is 15 % of L, and shear counts; 0.4 % measured), and by
    friction T that holds it back at most 3 T d/(2 L) more. Measured: 44 and 55 iterations; where
    the residual has to fall from step to step 353 and 252, none within 100 of the first increment.
    Allowed are a fifth more. Nothing falls back on another method.
    """
    msh = mesh.create_rectangle(
        COMM, [[0, 0], [LENGTH, HEIGHT]], (40, 2), mesh.CellType.quadrilateral
    )
    V = fem.functionspace(msh, ("Lagrange", 2, (2,)))
    u, v, weight = fem.Function(V), ufl.TestFunction(V), fem.Constant(msh, 0.0)
    F = NeoHookean(u, E, NU, "plane strain").residual(v, ufl.dx(msh))
    F += weight * v[1] * ufl.dx(msh)
    clamp = mesh.locate_entities_boundary(msh, 1, lambda x: np.isclose(x[0], 0))
    facets = mesh.locate_entities_boundary(msh, 1, lambda x: np.isclose(x[1], 0))
    tags = mesh.meshtags(msh, 1, facets, np.full(len(facets), BOTTOM, dtype=np.int32))
    contact = fc.Contact(
        u,
        fc.ContactSurface(msh, tags, BOTTOM),
        fc.HalfSpace((0, -CLEARANCE), (0, 1)),
        law,
        kinematics="finite",
    )
    bc = fem.dirichletbc(np.zeros(2), fem.locate_dofs_topological(V, 1, clamp), V)
    problem = fc.ContactProblem(F, u, bcs=[bc], contacts=[contact])

    def load(t):
        weight.value = 0.1 * t

    made = []
    for step in fc.increments(problem, load, steps=10, max_cuts=0):
        assert [attempt.method for attempt in step.attempts] == ["newton"]
        made.append(step.iterations)
    assert max(made[2:]) <= 6, made
    assert sum(made) <= (66 if law.has_friction else 53), made
    bending = E / (1 - NU**2) * HEIGHT**3 / 12
    tip = 3 * 0.1 * LENGTH / 8 - 3 * bending * CLEARANCE / LENGTH**3
    most = 3 * CLEARANCE / (2 * LENGTH) * contact.resultants().tangential_force
    force = contact.resultants().force[1]
    assert tip * 0.98 < force < tip * 1.02 + most
