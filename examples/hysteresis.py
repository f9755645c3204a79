"""A fixed block is pressed on an oscillating floor: the energy dissipated in a cycle."""

import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

import fenics_contact as fc

FRICTION, PRESSURE, LENGTH, HEIGHT = 0.3, 10.0, 2.0, 1.0  # MPa, mm; forces in N per mm of depth
K_T, AMPLITUDE = 1e3, 0.01  # tangential penalty stiffness, MPa/mm; mm
BOTTOM, TOP = 1, 2

msh = mesh.create_rectangle(MPI.COMM_WORLD, [(0, 0), (LENGTH, HEIGHT)], (16, 8))
facets = mesh.locate_entities_boundary(msh, 1, lambda x: np.isfinite(x[0]))
y = mesh.compute_midpoints(msh, 1, facets)[:, 1]
where = np.select([np.isclose(y, 0), np.isclose(y, HEIGHT)], [BOTTOM, TOP])
tags = mesh.meshtags(msh, 1, facets, where.astype(np.int32))

V = fem.functionspace(msh, ("Lagrange", 1, (2,)))
u, v = fem.Function(V), ufl.TestFunction(V)
pressure, travel = fem.Constant(msh, 0.0), fem.Constant(msh, 0.0)
ds = ufl.Measure("ds", domain=msh, subdomain_data=tags)
block = fc.elasticity.LinearElastic(u, E=2e5, nu=0.0, kind="plane strain")
F = block.residual(v) + pressure * v[1] * ds(TOP)
foot = fem.locate_dofs_topological(V.sub(0), 1, tags.find(BOTTOM))
bcs = [fem.dirichletbc(0.0, foot, V.sub(0))]  # u_x = 0 only; uniform pressure, since ν = 0

floor = fc.HalfSpace((0, 0), (0, 1), displacement=ufl.as_vector([travel, 0]))
surface = fc.ContactSurface(msh, tags, BOTTOM)
contact = fc.Contact(u, surface, floor, fc.Coulomb(FRICTION, k_t=K_T))
problem = fc.ContactProblem(F, u, bcs=bcs, contacts=[contact])
list(fc.increments(problem, pressure, 0, PRESSURE))
list(fc.increments(problem, travel, 0, AMPLITUDE, steps=5))
dissipation = 0.0  # in the following cycle
for start, end in ((AMPLITUDE, -AMPLITUDE), (-AMPLITUDE, AMPLITUDE)):
    for step in fc.increments(problem, travel, start, end, steps=10):
        dissipation += step.energy.dissipation
# Springs of stiffness k that slip at ±μN: the loop of force over displacement is a parallelogram.
limit, k = FRICTION * PRESSURE * LENGTH, K_T * LENGTH
loop = 4 * limit * (AMPLITUDE - limit / k)
if msh.comm.rank == 0:
    print(f"dissipation {dissipation:.6g} mJ/mm per cycle; area of the loop {loop:.6g} mJ/mm")
assert np.isclose(dissipation, loop, rtol=1e-7)  # exact; solver tolerance 1e-9 of the forces
