"""Two stacked blocks of different mesh and stiffness shorten like two springs in series."""

import gmsh
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc

E_LOWER, E_UPPER, HEIGHT, PRESSURE = 1000.0, 300.0, 1.0, 2.0  # MPa, mm; the blocks are 1 mm wide
BOTTOM, TOP, LEFT, BELOW, ABOVE = 1, 2, 3, 4, 5  # BELOW and ABOVE are the contact surfaces
gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
if MPI.COMM_WORLD.rank == 0:
    for block in (0, 1):  # lines 1 to 4 and 5 to 8: bottom, right, top, left
        gmsh.model.occ.addRectangle(0, block * HEIGHT, 0, 1, HEIGHT)
    gmsh.model.occ.synchronize()
    for line in range(1, 9):  # 5 cells along the lines of the lower block, 8 of the upper one
        gmsh.model.mesh.setTransfiniteCurve(line, 6 if line <= 4 else 9)
    for tag, lines in ((BOTTOM, [1]), (BELOW, [3]), (ABOVE, [5]), (TOP, [7]), (LEFT, [4, 8])):
        gmsh.model.addPhysicalGroup(1, lines, tag)
    gmsh.model.addPhysicalGroup(2, [1, 2], 1)
    gmsh.model.mesh.generate(2)
mesh, _, tags = fc.model_to_mesh(gmsh.model, MPI.COMM_WORLD, gdim=2)
gmsh.finalize()

V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
u, v = fem.Function(V), ufl.TestFunction(V)
E = ufl.conditional(ufl.lt(ufl.SpatialCoordinate(mesh)[1], HEIGHT), E_LOWER, E_UPPER)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags)
body = fc.elasticity.LinearElastic(u, E, nu=0.3, kind="plane stress")
F = body.residual(v) + PRESSURE * v[1] * ds(TOP)
held = [(V.sub(i), tags.find(tag)) for i, tag in ((0, LEFT), (1, BOTTOM))]
bcs = [fem.dirichletbc(0.0, fem.locate_dofs_topological(W, 1, f), W) for W, f in held]
surface, obstacle = fc.ContactSurface(mesh, tags, ABOVE), fc.DeformableBody(tags, BELOW)
contact = fc.Contact(u, surface, obstacle, fc.Frictionless(), enforcement="augmented")
fc.ContactProblem(F, u, bcs=bcs, contacts=[contact]).solve()
shortening = mesh.comm.allreduce(fem.assemble_scalar(fem.form(-u[1] * ds(TOP))))  # mean, on 1 mm
expected = PRESSURE * HEIGHT * (1 / E_LOWER + 1 / E_UPPER)
if mesh.comm.rank == 0:
    print(f"the blocks shorten by {shortening:.6g} mm, two springs by {expected:.6g} mm")
# Linear elements are exact; the multipliers reduce the penalty's penetration to 1e-5 of it.
assert np.isclose(shortening, expected, rtol=1e-5)
