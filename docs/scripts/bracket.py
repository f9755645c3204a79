"""A ball is pressed on a bracket meshed by gmsh: a part in 3D, its tags and its pictures."""

import logging
from pathlib import Path

import gmsh
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc

logging.basicConfig(level=logging.INFO)

E, NU, RADIUS, FORCE = 7e4, 0.33, 50.0, 2000.0  # MPa, mm, N
LENGTH, WIDTH, HEIGHT, THICK, FILLET, AT = 40.0, 30.0, 40.0, 6.0, 5.0, 28.0  # mm
a = (3 * FORCE * RADIUS * (1 - NU**2) / (4 * E)) ** (1 / 3)  # Hertz: the radius of the contact
BODY, WALL, ARM = 1, 2, 3

# begin part
gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
if MPI.COMM_WORLD.rank == 0:
    occ = gmsh.model.occ
    plate = occ.addBox(-THICK, 0, 0, THICK, WIDTH, HEIGHT)
    arm = occ.addBox(-THICK, 0, 0, LENGTH + THICK, WIDTH, THICK)
    ((_, part),), _ = occ.fuse([(3, plate)], [(3, arm)])
    occ.synchronize()
    corner = gmsh.model.getEntitiesInBoundingBox(
        -0.1, -1, THICK - 0.1, 0.1, WIDTH + 1, THICK + 0.1, 1
    )
    occ.fillet([part], [edge for _, edge in corner], [FILLET])
    occ.synchronize()
    faces = {face: occ.getCenterOfMass(2, face) for _, face in gmsh.model.getEntities(2)}
    wall = [face for face, c in faces.items() if np.isclose(c[0], -THICK)]
    top = [face for face, c in faces.items() if np.isclose(c[2], THICK)]
    for dim, entities, tag in ((3, [part], BODY), (2, wall, WALL), (2, top, ARM)):
        gmsh.model.addPhysicalGroup(dim, entities, tag)

    def cell_size(dim, tag, x, y, z, size):
        """Return a/2 up to 2 a from the point below the ball, growing beyond that."""
        away = np.linalg.norm([x - AT, y - WIDTH / 2, z - THICK])
        return min(4.0, a / 2 + max(0.0, away - 2 * a) / 3)

    gmsh.model.mesh.setSizeCallback(cell_size)
    gmsh.model.mesh.generate(3)
mesh, _, tags = fc.model_to_mesh(gmsh.model, MPI.COMM_WORLD)
gmsh.finalize()

# begin problem
V = fem.functionspace(mesh, ("Lagrange", 2, (3,)))
u, v = fem.Function(V), ufl.TestFunction(V)
body = fc.elasticity.LinearElastic(u, E, NU, kind="3D")
held = fem.locate_dofs_topological(V, 2, tags.find(WALL))
weight = fem.Constant(mesh, 0.0)
ball = fc.Ball(
    center=(AT, WIDTH / 2, THICK + RADIUS),
    radius=RADIUS,
    displacement=fc.Motion(force=(None, None, weight)),
)
contact = fc.Contact(u, fc.ContactSurface(mesh, tags, ARM), ball, fc.Coulomb(0.2))
bcs = [fem.dirichletbc(np.zeros(3), held, V)]
problem = fc.ContactProblem(body.residual(v), u, bcs=bcs, contacts=[contact])
for step in fc.increments(problem, weight, 0, -FORCE, steps=2):
    if mesh.comm.rank == 0:
        print(step.summary())

# begin pictures
Path("output").mkdir(exist_ok=True)
fc.plotting.plot_deformation("output/bracket.png", u, stress=body.stress, magnification=20)
fc.plotting.plot_pressure("output/pressure.png", contact, near=2 * a)
fc.Writer("output", problem, stress=body.stress).write(step)

# The arm rotates below the ball, so that all points slip: friction is μ N.
found = contact.resultants()
assert np.isclose(found.force[2], -FORCE, rtol=1e-6)
assert found.stick == 0 and np.isclose(found.tangential_force, 0.2 * found.normal_force)
