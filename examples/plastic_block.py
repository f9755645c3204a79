"""A block pressed beyond its yield stress, with plastic strains as user-defined state fields."""

import sys

import basix
import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

import fenics_contact as fc

E, NU, YIELD, DEPTH, WIDTH = 210e3, 0.3, 250.0, 0.01, 2.0  # MPa and mm, plane strain, J2 flow
G, K = E / (2 * (1 + NU)), E / (3 * (1 - 2 * NU))
BOTTOM, TOP, LEFT = 1, 2, 3

msh = mesh.create_rectangle(MPI.COMM_WORLD, [(0, 0), (WIDTH, 1)], (8, 4))
facets = mesh.locate_entities_boundary(msh, 1, lambda x: np.isfinite(x[0]))
x, y = mesh.compute_midpoints(msh, 1, facets).T[:2]
where = np.select([np.isclose(y, 0), np.isclose(y, 1), np.isclose(x, 0)], [BOTTOM, TOP, LEFT])
tags = mesh.meshtags(msh, 1, facets, where.astype(np.int32))

V = fem.functionspace(msh, ("Lagrange", 2, (2,)))
u, v, depth = fem.Function(V), ufl.TestFunction(V), fem.Constant(msh, 0.0)
at_points = basix.ufl.quadrature_element("triangle", value_shape=(3, 3), degree=2)
plastic = fem.Function(fem.functionspace(msh, at_points), name="plastic")  # strains

shear = (u[0].dx(1) + u[1].dx(0)) / 2
strain = ufl.as_tensor([[u[0].dx(0), shear, 0], [shear, u[1].dx(1), 0], [0, 0, 0]])
trial = 2 * G * ufl.dev(strain - plastic)
size = ufl.sqrt(1.5 * ufl.inner(trial, trial) + (1e-9 * YIELD) ** 2)
flow = ufl.max_value(1 - YIELD / size, 0) * trial / (2 * G)  # strain increment of the radial return
stress = trial - 2 * G * flow + K * ufl.tr(strain) * ufl.Identity(3)
F = ufl.inner(stress, ufl.derivative(strain, u, v)) * ufl.dx(degree=2)
grown = fem.Expression(plastic + flow, basix.make_quadrature(basix.CellType.triangle, 2)[0])
ends = [fem.locate_dofs_topological(V.sub(i), 1, tags.find((LEFT, TOP)[i])) for i in (0, 1)]
bcs = [fem.dirichletbc(0.0, ends[0], V.sub(0)), fem.dirichletbc(depth, ends[1], V.sub(1))]

floor = fc.HalfSpace((0, 0), (0, 1))
contact = fc.Contact(u, fc.ContactSurface(msh, tags, BOTTOM), floor, fc.Frictionless())
problem = fc.ContactProblem(F, u, bcs=bcs, contacts=[contact])
checkpoint_options = {"checkpoint": sys.argv[1], "state_fields": [plastic]} if sys.argv[1:] else {}
for _ in fc.increments(problem, depth, 0, -DEPTH, steps=10, **checkpoint_options):
    plastic.interpolate(grown)
force, limit = contact.resultants().normal_force, 2 / np.sqrt(3) * YIELD * WIDTH
if msh.comm.rank == 0:
    print(f"force {force:.6g} N/mm, limit {limit:.6g} N/mm")
assert np.isclose(force, limit, rtol=1e-5)
