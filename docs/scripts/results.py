"""A block is pressed and pushed on a floor: results for ParaView, a table, pictures and a page."""

import logging

import numpy as np
import ufl
from dolfinx import fem, io, mesh
from mpi4py import MPI

import fenics_contact as fc

logging.basicConfig(level=logging.INFO)

BOTTOM, TOP = 1, 2
msh = mesh.create_rectangle(MPI.COMM_WORLD, [(0, 0), (2, 1)], (16, 8))  # mm
facets = mesh.locate_entities_boundary(msh, 1, lambda x: np.isfinite(x[0]))
y = mesh.compute_midpoints(msh, 1, facets)[:, 1]
where = np.select([np.isclose(y, 0), np.isclose(y, 1)], [BOTTOM, TOP])
tags = mesh.meshtags(msh, 1, facets, where.astype(np.int32))

V = fem.functionspace(msh, ("Lagrange", 2, (2,)))
u, v = fem.Function(V), ufl.TestFunction(V)
push = fem.Constant(msh, 0.0)  # mm
ds = ufl.Measure("ds", domain=msh, subdomain_data=tags)
steel = fc.elasticity.LinearElastic(u, E=2e5, nu=0.3, kind="plane strain")
F = steel.residual(v) + 10.0 * v[1] * ds(TOP)
top = fem.locate_dofs_topological(V.sub(0), 1, tags.find(TOP))
bcs = [fem.dirichletbc(push, top, V.sub(0))]
floor = fc.HalfSpace(point=(0, 0), normal=(0, 1))
contact = fc.Contact(u, fc.ContactSurface(msh, tags, BOTTOM), floor, fc.Coulomb(0.3))
problem = fc.ContactProblem(F, u, bcs=bcs, contacts=[contact])

# begin results
writer = fc.Writer("output", problem, stress=steel.stress)
film = fc.Animation("output/film.gif", problem, stress=steel.stress, magnification=1000)
for step in fc.increments(problem, push, 0, 1e-4, steps=5, csv="output/history.csv"):
    print(step.summary())
    writer.write(step)
    film.add(step)
film.save()
budget = fc.estimate_errors(problem, steel.stress)
print(budget)
fc.report(problem, step, "output", csv="output/history.csv", stress=steel.stress, budget=budget)
fc.plotting.plot_pressure("output/pressure.png", contact)
fc.plotting.plot_status("output/status.png", contact)
fc.plotting.plot_deformation("output/deformation.png", u, magnification=1000, contacts=[contact])

# begin function
pressure = contact.function("pressure")
form = fem.form(pressure * ds(BOTTOM), entity_maps=contact.entity_maps)
force = msh.comm.allreduce(fem.assemble_scalar(form))
assert np.isclose(force, contact.resultants().normal_force)
with io.VTKFile(msh.comm, "output/pressure.pvd", "w") as file:
    file.write_function(pressure)
