"""The log is written to screen and file, for a contact too stiff for the chosen method."""

import logging
import sys

import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

import fenics_contact as fc

# begin file
log = logging.getLogger("fenics_contact")
log.setLevel(logging.DEBUG)
if MPI.COMM_WORLD.rank == 0:
    file = logging.FileHandler("run.log", mode="w", encoding="utf-8")
    file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    screen = logging.StreamHandler(sys.stdout)
    screen.setLevel(logging.INFO)
    log.addHandler(file)
    log.addHandler(screen)
else:
    log.addHandler(logging.NullHandler())
log.propagate = False

# begin problem
msh = mesh.create_rectangle(MPI.COMM_WORLD, [(0, 0), (2, 1)], (16, 8))  # mm
facets = mesh.locate_entities_boundary(msh, 1, lambda x: np.isfinite(x[0]))
y = mesh.compute_midpoints(msh, 1, facets)[:, 1]
where = np.select([np.isclose(y, 0), np.isclose(y, 1)], [1, 2])
tags = mesh.meshtags(msh, 1, facets, where.astype(np.int32))
V = fem.functionspace(msh, ("Lagrange", 2, (2,)))
u, v = fem.Function(V), ufl.TestFunction(V)
push = fem.Constant(msh, 0.0)
ds = ufl.Measure("ds", domain=msh, subdomain_data=tags)
steel = fc.elasticity.LinearElastic(u, E=2e5, nu=0.3, kind="plane strain")
F = steel.residual(v) + 10.0 * v[1] * ds(2)
top = fem.locate_dofs_topological(V.sub(0), 1, tags.find(2))
bcs = [fem.dirichletbc(push, top, V.sub(0))]
floor, law = (
    fc.HalfSpace((0, 0), (0, 1)),
    fc.Coulomb(0.3, k_n=fc.RelativeStiffness(1e4)),
)  # too stiff for L-BFGS
contact = fc.Contact(u, fc.ContactSurface(msh, tags, 1), floor, law)
problem = fc.ContactProblem(F, u, bcs=bcs, contacts=[contact], method="lbfgs")
for step in fc.increments(problem, push, 0, 1e-4, steps=2):
    if msh.comm.rank == 0:
        print(step.summary())
written = "" if msh.comm.rank else open("run.log", encoding="utf-8").read()
assert msh.comm.bcast("INFO lbfgs: no progress" in written)
