"""A roller is pressed on rubber by a force and dragged without a moment on it: it rolls."""

import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

import fenics_contact as fc

RADIUS, FORCE, TRAVEL = 0.8, 0.5, 0.8  # mm, N/mm; the block is 3 mm wide and 1 mm high
BOTTOM, TOP = 1, 2

msh = mesh.create_rectangle(MPI.COMM_WORLD, [(-1.5, 0), (1.5, 1)], (36, 12))
facets = mesh.locate_entities_boundary(msh, 1, lambda x: np.isfinite(x[0]))
y = mesh.compute_midpoints(msh, 1, facets)[:, 1]
where = np.select([np.isclose(y, 0), np.isclose(y, 1)], [BOTTOM, TOP])
tags = mesh.meshtags(msh, 1, facets, where.astype(np.int32))

V = fem.functionspace(msh, ("Lagrange", 2, (2,)))
u, v = fem.Function(V), ufl.TestFunction(V)
rubber = fc.elasticity.NeoHookean(u, E=10.0, nu=0.4, kind="plane strain")  # MPa
foot = fem.locate_dofs_topological(V, 1, tags.find(BOTTOM))
bcs = [fem.dirichletbc(np.zeros(2), foot, V)]

press, travel, axis = fem.Constant(msh, 0.0), fem.Constant(msh, 0.0), (-TRAVEL / 2, 1.0 + RADIUS)
motion = fc.Motion(force=(None, press), displacement=(travel, None))
turn = fc.Rotation(None, about=axis, moment=0.0)  # the angle is unknown
roller = fc.Cylinder(axis, RADIUS, displacement=motion, rotation=turn)
surface = fc.ContactSurface(msh, tags, TOP)
contact = fc.Contact(u, surface, roller, fc.Coulomb(0.5), kinematics="finite")
problem = fc.ContactProblem(rubber.residual(v), u, bcs=bcs, contacts=[contact])
list(fc.increments(problem, press, 0, -FORCE))
before = float(contact.free_angle.value)
list(fc.increments(problem, travel, 0, TRAVEL, steps=8))
turned = before - float(contact.free_angle.value)
# It rolls by its displacement, apart from the stretch of the rubber below it.
if msh.comm.rank == 0:
    print(f"turned by {turned:.6g} rad, travel / R = {TRAVEL / RADIUS:.6g} rad")
assert np.isclose(turned, TRAVEL / RADIUS, rtol=1e-2)
