"""A rigid ball is pressed by a force on a cylindrical block meshed with gmsh: Hertz's pressure."""

import gmsh
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc

E, NU, R, FORCE = 1000.0, 0.3, 10.0, 10.0  # MPa, mm, N
a = (3 * FORCE * R * (1 - NU**2) / (4 * E)) ** (1 / 3)  # Hertz's radius of the contact zone
peak = 3 * FORCE / (2 * np.pi * a**2)  # and pressure at its centre
HELD, CONTACT = 1, 2

gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
if MPI.COMM_WORLD.rank == 0:  # top at z = 0, cells of size a/4 below the ball
    block = gmsh.model.occ.addCylinder(0, 0, -8 * a, 0, 0, 8 * a, 8 * a)
    gmsh.model.occ.synchronize()
    side, top, bottom = (face for _, face in gmsh.model.getBoundary([(3, block)], oriented=False))
    for dim, entity, tag in ((3, block, 1), (2, bottom, HELD), (2, top, CONTACT)):
        gmsh.model.addPhysicalGroup(dim, [entity], tag)
    gmsh.model.mesh.setSizeCallback(
        lambda dim, tag, x, y, z, size: a / 4 + max(0, np.linalg.norm((x, y, z)) - a) / 2
    )
    gmsh.model.mesh.generate(3)
mesh, _, tags = fc.model_to_mesh(gmsh.model, MPI.COMM_WORLD)
gmsh.finalize()

V = fem.functionspace(mesh, ("Lagrange", 2, (3,)))
u, v = fem.Function(V), ufl.TestFunction(V)
F = fc.elasticity.LinearElastic(u, E, NU, kind="3D").residual(v)
held = fem.locate_dofs_topological(V, 2, tags.find(HELD))
weight = fc.Motion(force=(None, None, -FORCE))  # the displacement along z is unknown
ball = fc.Ball(center=(0, 0, R), radius=R, displacement=weight)
contact = fc.Contact(u, fc.ContactSurface(mesh, tags, CONTACT), ball, fc.Frictionless())
fc.ContactProblem(F, u, bcs=[fem.dirichletbc(np.zeros(3), held, V)], contacts=[contact]).solve()
found = contact.resultants()
if mesh.comm.rank == 0:
    print(f"force {-found.force[2]:.6g} N, largest pressure {found.max_pressure:.4g} MPa")
    print(f"Hertz: {peak:.4g} MPa")
# Tolerance 3 %: cells of a/4 and their penalty cause an error of 1.6 %, those of a/8 below 0.1 %.
assert np.isclose(found.max_pressure, peak, rtol=0.03)
