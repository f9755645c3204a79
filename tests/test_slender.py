"""Slender hyperelastic bodies: a Newton step with large rotation also stretches them."""

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
def test_cantilever_sags_onto_a_plane(law):
    """A cantilever, 20 times as long as high, has the tip force of beam theory, by Newton only.

    Its weight grows in ten increments. The first one bends it by its height, the second lays its
    tip on the plane, the others press it there. A propped cantilever with weight q and tip
    deflection d has the tip force 3 q L/8 - 3 E I d/L³, to 2 % (d is 15 % of L, and shear matters;
    measured 0.4 %), and friction T increases it by at most 3 T d/(2 L). Measured: 44 and 55
    iterations; 20 % more are allowed. If the residual has to decrease in every step: 353 and 252,
    none within 100 in the first increment. No other method is used.
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

    iterations = []
    for step in fc.increments(problem, load, steps=10, max_cuts=0):
        assert [attempt.method for attempt in step.attempts] == ["newton"]
        iterations.append(step.iterations)
    assert max(iterations[2:]) <= 6, iterations
    assert sum(iterations) <= (66 if law.has_friction else 53), iterations
    bending = E / (1 - NU**2) * HEIGHT**3 / 12
    tip = 3 * 0.1 * LENGTH / 8 - 3 * bending * CLEARANCE / LENGTH**3
    most = 3 * CLEARANCE / (2 * LENGTH) * contact.resultants().tangential_force
    force = contact.resultants().force[1]
    assert tip * 0.98 < force < tip * 1.02 + most
