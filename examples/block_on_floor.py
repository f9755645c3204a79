"""A block is pressed on a rigid floor and pushed until it slides: the friction force is μ N."""

import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

import fenics_contact as fc

FRICTION, PRESSURE, LENGTH, HEIGHT = 0.3, 10.0, 2.0, 1.0  # MPa, mm; forces in N per mm of depth
BOTTOM, TOP = 1, 2

msh = mesh.create_rectangle(MPI.COMM_WORLD, [(0, 0), (LENGTH, HEIGHT)], (16, 8))
facets = mesh.locate_entities_boundary(msh, 1, lambda x: np.isfinite(x[0]))
y = mesh.compute_midpoints(msh, 1, facets)[:, 1]
where = np.select([np.isclose(y, 0), np.isclose(y, HEIGHT)], [BOTTOM, TOP])
tags = mesh.meshtags(msh, 1, facets, where.astype(np.int32))

V = fem.functionspace(msh, ("Lagrange", 2, (2,)))
u, v = fem.Function(V), ufl.TestFunction(V)
pressure, push = fem.Constant(msh, 0.0), fem.Constant(msh, 0.0)
ds = ufl.Measure("ds", domain=msh, subdomain_data=tags)
steel = fc.elasticity.LinearElastic(u, E=2e5, nu=0.3, kind="plane strain")
F = steel.residual(v) + pressure * v[1] * ds(TOP)
top = fem.locate_dofs_topological(V.sub(0), 1, tags.find(TOP))
bcs = [fem.dirichletbc(push, top, V.sub(0))]

floor = fc.HalfSpace(point=(0, 0), normal=(0, 1))
surface = fc.ContactSurface(msh, tags, BOTTOM)
contact = fc.Contact(u, surface, floor, fc.Coulomb(FRICTION))
problem = fc.ContactProblem(F, u, bcs=bcs, contacts=[contact])
for load, end, steps in ((pressure, PRESSURE, 1), (push, 1e-4, 5)):  # push in mm
    for step in fc.increments(problem, load, 0, end, steps=steps):
        forces = step.contacts["contact"]
friction, expected = -forces.force[0], FRICTION * PRESSURE * LENGTH
if msh.comm.rank == 0:
    print(f"T = {friction:.6g} N/mm, μ N = {expected:.6g} N/mm; points that stick: {forces.stick}")
# By equilibrium N is the load on the top, and T = μ N; the solver tolerance is 1e-9 of the forces.
assert forces.stick == 0
assert np.isclose(friction, expected, rtol=1e-7)
