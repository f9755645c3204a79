"""A round bar is pressed on a rigid floor, axisymmetric: the contact force is the load."""

import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

import fenics_contact as fc

RADIUS, HEIGHT, PRESSURE, BOTTOM, TOP = 2.0, 1.0, 10.0, 1, 2  # mm, MPa
msh = mesh.create_rectangle(MPI.COMM_WORLD, [(0, 0), (RADIUS, HEIGHT)], (16, 8))  # r and z
facets = mesh.locate_entities_boundary(msh, 1, lambda x: np.isfinite(x[0]))
z = mesh.compute_midpoints(msh, 1, facets)[:, 1]
where = np.select([np.isclose(z, 0), np.isclose(z, HEIGHT)], [BOTTOM, TOP])
tags = mesh.meshtags(msh, 1, facets, where.astype(np.int32))

V = fem.functionspace(msh, ("Lagrange", 2, (2,)))
u, v = fem.Function(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=msh, subdomain_data=tags)
bar = fc.elasticity.LinearElastic(u, E=2e5, nu=0.3, kind="axisymmetric")
F = bar.residual(v) + bar.weight * PRESSURE * v[1] * ds(TOP)
axis = fem.locate_dofs_geometrical((V.sub(0), V.sub(0).collapse()[0]), lambda x: x[0] < 1e-9)[0]
bcs = [fem.dirichletbc(0.0, axis, V.sub(0))]
floor, surface = fc.HalfSpace((0, 0), (0, 1)), fc.ContactSurface(msh, tags, BOTTOM)
contact = fc.Contact(u, surface, floor, fc.Frictionless(), weight=bar.weight)
fc.ContactProblem(F, u, bcs=bcs, contacts=[contact]).solve()
force, expected = contact.resultants().normal_force, PRESSURE * np.pi * RADIUS**2
print(f"force {force:.6g} N, load {expected:.6g} N")
assert np.isclose(force, expected, rtol=1e-8)
# Uniform pressure: quadratic elements have the exact solution.
assert np.allclose(contact.gather()["pressure"], PRESSURE, rtol=1e-6)
