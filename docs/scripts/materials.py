"""A layered block on a floor: two materials in one mesh, by cell tags."""

import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

import fenics_contact as fc

STEEL, RUBBER, FLOOR, LOADED = 1, 2, 1, 2
HEIGHT, THICK, PRESSURE = 1.0, 0.25, 2.0  # mm, mm, MPa; the rubber is the lower layer
E, NU = {STEEL: 2.1e5, RUBBER: 10.0}, 0.0

msh = mesh.create_rectangle(MPI.COMM_WORLD, [(0, 0), (2, HEIGHT)], (16, 8))
facets = mesh.locate_entities_boundary(msh, 1, lambda x: np.isfinite(x[0]))
y = mesh.compute_midpoints(msh, 1, facets)[:, 1]
where = np.select([np.isclose(y, 0), np.isclose(y, HEIGHT)], [FLOOR, LOADED])
tags = mesh.meshtags(msh, 1, facets, where.astype(np.int32))

# begin cells
cells = msh.topology.index_map(2)
every = np.arange(cells.size_local + cells.num_ghosts, dtype=np.int32)
low = mesh.compute_midpoints(msh, 2, every)[:, 1] < THICK
cell_tags = mesh.meshtags(msh, 2, every, np.where(low, RUBBER, STEEL).astype(np.int32))

# begin form
V = fem.functionspace(msh, ("Lagrange", 1, (2,)))
u, v = fem.Function(V), ufl.TestFunction(V)
dx = ufl.Measure("dx", domain=msh, subdomain_data=cell_tags)
ds = ufl.Measure("ds", domain=msh, subdomain_data=tags)
F = PRESSURE * v[1] * ds(LOADED)
for tag, modulus in E.items():
    F += fc.elasticity.LinearElastic(u, modulus, NU, "plane strain").residual(v, dx(tag))

# begin contact
floor, surface = fc.HalfSpace((0, 0), (0, 1)), fc.ContactSurface(msh, tags, FLOOR)
contact = fc.Contact(u, surface, floor, fc.Coulomb(0.3))
fc.ContactProblem(F, u, contacts=[contact]).solve()

# begin compare
k_n = 10 * E[RUBBER] / (HEIGHT / 8)  # the default: 10 E/h of the cells at the floor
shortening = -msh.comm.allreduce(u.x.array[1::2].min(), op=MPI.MIN) - PRESSURE / k_n
expected = PRESSURE * (THICK / E[RUBBER] + (HEIGHT - THICK) / E[STEEL])
if msh.comm.rank == 0:
    print(f"shortening {shortening:.6g} mm, springs in series {expected:.6g} mm")
assert np.isclose(shortening, expected, rtol=1e-6)

# begin function
modulus = fem.Function(fem.functionspace(msh, ("Discontinuous Lagrange", 0)))
for tag, value in E.items():
    modulus.x.array[cell_tags.find(tag)] = value
w = fem.Function(V)
body = fc.elasticity.LinearElastic(w, modulus, NU, "plane strain")
contact = fc.Contact(w, surface, floor, fc.Coulomb(0.3))
F = body.residual(v) + PRESSURE * v[1] * ds(LOADED)
fc.ContactProblem(F, w, contacts=[contact]).solve()
assert np.allclose(w.x.array, u.x.array, atol=1e-9 * expected)
