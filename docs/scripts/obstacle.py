"""A crowned roller, defined by three kinds of obstacle, is pressed on a block."""

from pathlib import Path

import gmsh
import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

import fenics_contact as fc

RADIUS, CROWN, HALF, DEPTH = 2.0, 8.0, 2.0, 0.02  # mm; the axis is y, at the height RADIUS
Path("output").mkdir(exist_ok=True)


# begin distance
def to_roller(x):
    """Return the signed distance, positive outside, whose gradient has length 1."""
    off = ufl.sqrt(x[0] ** 2 + (x[2] - RADIUS) ** 2)  # from the axis
    return ufl.sqrt((off + CROWN - RADIUS) ** 2 + x[1] ** 2) - CROWN


# begin profile
y = np.linspace(-HALF, HALF, 41)  # upwards along the axis: the roller is on the left
low = np.sqrt(CROWN**2 - y**2) - CROWN + RADIUS  # its radius at y
crown = np.column_stack([low, y, np.full_like(y, RADIUS)])
axle = ((0, 0, RADIUS), (0, 1, 0))


# begin file
def write_stl(path, size):
    """Write the roller as triangles of a size, as other programs do."""
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    occ = gmsh.model.occ
    ends = [(0, -HALF), (low[0], -HALF), (low[-1], HALF), (0, HALF), (RADIUS - CROWN, 0)]
    a, b, c, d, middle = (occ.addPoint(r, along, RADIUS) for r, along in ends)
    lines = [occ.addLine(*ends) for ends in ((a, b), (c, d), (d, a))]
    lines.insert(1, occ.addCircleArc(b, middle, c))
    section = occ.addPlaneSurface([occ.addCurveLoop(lines)])
    occ.revolve([(2, section)], 0, 0, RADIUS, 0, 1, 0, 2 * np.pi)
    occ.remove([(2, section)])  # it is inside of the roller, not part of its surface
    occ.synchronize()
    gmsh.option.setNumber("Mesh.MeshSizeMax", size)
    gmsh.model.mesh.generate(2)
    gmsh.write(path)
    gmsh.finalize()


if MPI.COMM_WORLD.rank == 0:
    write_stl("output/coarse.stl", 0.2)
    write_stl("output/fine.stl", 0.1)
MPI.COMM_WORLD.Barrier()

# begin obstacles
msh = mesh.create_box(MPI.COMM_WORLD, [(0, 0, -0.5), (1, 1, 0)], (12, 12, 6))
depth = fem.Constant(msh, 0.0)
down = {"displacement": ufl.as_vector([0, 0, -depth])}
obstacles = {
    "distance": fc.SignedDistance(to_roller, **down),
    "profile": fc.RigidProfile(crown, turned=axle, **down),
    "coarse": fc.RigidSurface.from_stl("output/coarse.stl", **down),
    "halved": fc.RigidSurface.from_stl("output/coarse.stl", halvings=2, **down),
    "fine": fc.RigidSurface.from_stl("output/fine.stl", **down),
}

# begin block
TOP, FOOT = 1, 2
facets = mesh.locate_entities_boundary(msh, 2, lambda x: np.isfinite(x[0]))
middles = mesh.compute_midpoints(msh, 2, facets)
where = np.select([np.isclose(middles[:, 2], 0), np.isclose(middles[:, 2], -0.5)], [TOP, FOOT])
tags = mesh.meshtags(msh, 2, facets, where.astype(np.int32))
V = fem.functionspace(msh, ("Lagrange", 1, (3,)))
u, v = fem.Function(V), ufl.TestFunction(V)
body = fc.elasticity.LinearElastic(u, E=3e3, nu=0.3, kind="3D")  # MPa
bcs = [fem.dirichletbc(np.zeros(3), fem.locate_dofs_topological(V, 2, tags.find(FOOT)), V)]
for i in range(2):  # a quarter of the block: x = 0 and y = 0 are planes of symmetry
    plane = facets[np.isclose(middles[:, i], 0)]
    dofs = fem.locate_dofs_topological(V.sub(i), 2, plane)
    bcs.append(fem.dirichletbc(0.0, dofs, V.sub(i)))
surface = fc.ContactSurface(msh, tags, TOP)

# begin press
gaps, forces = {}, {}
for name, obstacle in obstacles.items():
    u.x.array[:], depth.value = 0, 0
    contact = fc.Contact(u, surface, obstacle, fc.Frictionless())
    gaps[name] = contact.gather()["gap"]  # before any load
    problem = fc.ContactProblem(body.residual(v), u, bcs=bcs, contacts=[contact])
    list(fc.increments(problem, depth, 0, DEPTH))
    forces[name] = contact.resultants().normal_force
    fc.plotting.plot_pressure(f"output/{name}.png", contact)

# begin compare
wrong = {name: abs(force / forces["distance"] - 1) for name, force in forces.items()}
for name, force in forces.items() if msh.comm.rank == 0 else ():
    off = np.abs(gaps[name] - gaps["distance"]).max()
    print(f"{name}: smallest gap {gaps[name].min():.1e} mm, difference {off:.0e} mm; ", end="")
    print(f"force {force:.4f} N, difference {100 * wrong[name]:.2g} %")
# begin checks
assert wrong["profile"] < 1e-4
assert wrong["fine"] < 0.4 * wrong["coarse"] and wrong["halved"] < 0.4 * wrong["coarse"]
