"""An oval cam rotates on rubber: the work of its torque equals the stored energy."""

import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

import fenics_contact as fc

LONG, SHORT, STEPS = 0.9, 0.7, 24  # mm; the block is 3 mm wide and 1 mm high
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

t = np.linspace(0, 2 * np.pi, 120, endpoint=False)
axle = np.array([0.0, 1.0 + SHORT])
oval = axle + np.column_stack([LONG * np.cos(t), SHORT * np.sin(t)])
angle = fem.Constant(msh, 0.0)
cam = fc.RigidProfile(oval, closed=True, rotation=fc.Rotation(angle, axle))
surface = fc.ContactSurface(msh, tags, TOP)
contact = fc.Contact(u, surface, cam, fc.Frictionless(), kinematics="finite")
problem = fc.ContactProblem(rubber.residual(v), u, bcs=bcs, contacts=[contact])
torque = [0.0]
for _ in fc.increments(problem, angle, 0, np.pi / 2, steps=STEPS):
    torque.append(contact.moment(axle)[0])
work = (sum(torque) - (torque[0] + torque[-1]) / 2) * np.pi / 2 / STEPS  # trapezoidal rule
energy = fem.assemble_scalar(fem.form(rubber.energy * ufl.dx))
stored = msh.comm.allreduce(
    energy + contact.energy()
)  # in the rubber, and in the springs of the penalty
if msh.comm.rank == 0:
    print(f"work of the torque {work:.6g} mJ/mm, stored {stored:.6g} mJ/mm")
assert np.isclose(work, stored, rtol=5e-3)
