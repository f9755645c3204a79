"""A rigid drum makes a full revolution on a rubber block: the torque of friction."""

import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

import fenics_contact as fc

FRICTION, RADIUS, DEPTH = 0.3, 0.8, 0.15  # mm; the block is 3 mm wide and 1 mm high
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

depth, angle = fem.Constant(msh, 0.0), fem.Constant(msh, 0.0)
axis = (0.0, 1.0 + RADIUS)
down = ufl.as_vector([0, -depth])
drum = fc.Cylinder(axis, RADIUS, displacement=down, rotation=fc.Rotation(angle, axis))
surface = fc.ContactSurface(msh, tags, TOP)
contact = fc.Contact(u, surface, drum, fc.Coulomb(FRICTION), kinematics="finite")
problem = fc.ContactProblem(rubber.residual(v), u, bcs=bcs, contacts=[contact])
list(fc.increments(problem, depth, 0, DEPTH, steps=5))
list(fc.increments(problem, angle, 0, 2 * np.pi, steps=12))
torque = contact.moment((0.0, axis[1] - DEPTH))[0]
# All points slip: the torque is that of the traction μ p at the radius of the drum.
normal_force = msh.comm.allreduce(contact.measure @ contact.pressure)
expected = FRICTION * RADIUS * normal_force
if msh.comm.rank == 0:
    print(f"torque {abs(torque):.6g} N mm/mm, μ R ∫p = {expected:.6g} N mm/mm")
assert np.isclose(abs(torque), expected, rtol=5e-3)  # the penetration is p/k_n
