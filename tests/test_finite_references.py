"""Finite kinematics against numbers of another program."""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem

import fenics_contact as fc
from fenics_contact.elasticity import NeoHookean
from scenes.blocks import BOTTOM, LEFT, TOP, block_mesh
from scenes.elasticity import displacement_space, hold

pytestmark = pytest.mark.mpi

# Force on half of the disc at every 0.25 of its way: verification/getfem_disc.py, GetFEM 5.4.2.
GETFEM = (
    *(59.800408, 136.348555, 223.719622, 319.588569, 422.751726, 532.564461),
    *(649.491631, 772.146797, 900.426090, 1035.217694, 1174.778480, 1320.350256),
)


@pytest.mark.parametrize("second_route", [False, True])
def test_rubber_block_under_a_disc(second_route):
    """Half a block 5 x 10 pressed by 3 with a disc of radius 4, without friction.

    The mesh, elements and rules of the reference, which has the same penalty but no code in
    common. 1e-7 of the force: six digits behind the point are written down.
    """
    mesh, tags = block_mesh("quadrilateral", n=(10, 20), size=(5.0, 10.0))
    u = fem.Function(displacement_space(mesh, 2))
    body = NeoHookean(u, 1000.0, 0.3, "plane strain")
    bcs = [hold(u, tags, BOTTOM, 0), hold(u, tags, BOTTOM, 1), hold(u, tags, LEFT, 0)]
    shift = fem.Constant(mesh, np.zeros(2))
    disc = fc.Ball((0.0, 14.0), 4.0, displacement=shift)
    surface = fc.ContactSurface(mesh, tags, TOP)
    contact = fc.Contact(u, surface, disc, fc.Frictionless(1e4), kinematics="finite")
    dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": 4})
    F = body.residual(ufl.TestFunction(u.function_space), dx)
    problem = fc.ContactProblem(F, u, bcs=bcs, contacts=[contact], second_route=second_route)
    iterations = 0
    for number, expected in enumerate(GETFEM, 1):
        shift.value[1] = -0.25 * number
        step = problem.solve()
        problem.commit()
        assert -contact.resultants().force[1] == pytest.approx(expected, rel=1e-7)
        assert bool(step.verdict.routes) == second_route
        iterations += step.iterations
    assert iterations <= 45  # GetFEM, with its simplest line search: 125
