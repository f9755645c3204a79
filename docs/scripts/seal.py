"""A rubber bead under a lid: the force that closes it, its width and its pressure."""

from pathlib import Path

import gmsh
import numpy as np
import ufl
from basix.ufl import element, mixed_element
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc

RADIUS, E, FRICTION, CLOSING, STEPS = 2.5, 6.0, 0.3, 0.6, 12  # mm, MPa
CELLS = 10  # per radius at the rim
FOOT, RIM = 1, 2

# begin section
gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
if MPI.COMM_WORLD.rank == 0:  # half a disc on its flat side
    occ = gmsh.model.occ
    disc, box = occ.addDisk(0, 0, 0, RADIUS, RADIUS), occ.addRectangle(-9, 0, 0, 18, 9)
    ((_, section),), _ = occ.intersect([(2, disc)], [(2, box)])
    occ.synchronize()
    edges = [edge for _, edge in gmsh.model.getBoundary([(2, section)], oriented=False)]
    foot = [edge for edge in edges if np.isclose(occ.getCenterOfMass(1, edge)[1], 0)]
    gmsh.model.addPhysicalGroup(2, [section], 1)
    gmsh.model.addPhysicalGroup(1, foot, FOOT)
    gmsh.model.addPhysicalGroup(1, [edge for edge in edges if edge not in foot], RIM)
    gmsh.option.setNumber("Mesh.MeshSizeMax", RADIUS / CELLS)
    gmsh.model.mesh.generate(2)
    gmsh.model.mesh.setOrder(2)  # the rim stays round
mesh, _, tags = fc.model_to_mesh(gmsh.model, MPI.COMM_WORLD, gdim=2)
gmsh.finalize()

# begin rubber
P2, P1 = element("P", "triangle", 2, shape=(2,)), element("P", "triangle", 1)
W = fem.functionspace(mesh, mixed_element([P2, P1]))
w = fem.Function(W)
(u, p), (v, q) = ufl.split(w), ufl.TestFunctions(W)
rubber = fc.elasticity.NeoHookean(u, E, nu=0.5, kind="plane strain", pressure=p)
dofs = fem.locate_dofs_topological((W.sub(0), W.sub(0).collapse()[0]), 1, tags.find(FOOT))
bonded = fem.dirichletbc(fem.Function(W.sub(0).collapse()[0]), dofs, W.sub(0))

# begin lid
closing = fem.Constant(mesh, 0.0)
lid = fc.HalfSpace((0, RADIUS), (0, -1), displacement=ufl.as_vector([0, -closing]))
surface = fc.ContactSurface(mesh, tags, RIM)
contact = fc.Contact(
    u, surface, lid, fc.Coulomb(FRICTION), kinematics="finite", enforcement="augmented"
)
dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": 4})
problem = fc.ContactProblem(rubber.residual(v, dx, q=q), w, bcs=[bonded], contacts=[contact])

# begin history
Path("output").mkdir(exist_ok=True)
force, peak, dissipation = [0.0], [0.0], 0.0
output_options = {"csv": "output/history.csv"}
for step in fc.increments(problem, closing, 0, CLOSING, steps=STEPS, **output_options):
    found = contact.resultants()
    force.append(found.normal_force)
    peak.append(found.max_pressure)
    dissipation += step.energy.dissipation
    if mesh.comm.rank == 0:
        print(f"closed by {step.load:.2f} mm: force {force[-1]:.3f} N/mm, ", end="")
        print(f"pressure up to {peak[-1]:.3f} MPa over {found.extents['contact'].area:.2f} mm")

# begin pictures
fc.plotting.plot_deformation("output/seal.png", problem.displacement.u, stress=rubber.stress)
fc.plotting.plot_along("output/lid.png", contact)

# begin checks
at = np.linspace(0, CLOSING, STEPS + 1)
work = np.trapezoid(force, at)
stored = mesh.comm.allreduce(fem.assemble_scalar(fem.form(rubber.energy * dx)))
volume = fem.form((ufl.det(ufl.Identity(2) + ufl.grad(u)) - 1) * dx)
grown = mesh.comm.allreduce(fem.assemble_scalar(volume)) / (np.pi * RADIUS**2 / 2)
if mesh.comm.rank == 0:
    print(f"work {work:.4f} mJ/mm, stored {stored:.4f}, friction dissipation {dissipation:.4f}")
    print(f"volume has grown by {grown:.1e}")
assert np.isclose(work, stored + dissipation, rtol=1e-2)  # trapezoidal rule
assert abs(grown) < 1e-6
