"""Incompressible rubber is pressed between smooth plates: the force has a closed form."""

import numpy as np
import ufl
from basix.ufl import element, mixed_element
from dolfinx import fem, mesh
from mpi4py import MPI

import fenics_contact as fc

E, PRESSED, BOTTOM, TOP, LEFT = 10.0, 0.2, 1, 2, 3  # MPa, mm; a block of 1 mm x 1 mm
msh = mesh.create_unit_square(MPI.COMM_WORLD, 4, 4)
facets = mesh.locate_entities_boundary(msh, 1, lambda x: np.isfinite(x[0]))
x, y = mesh.compute_midpoints(msh, 1, facets).T[:2]
where = np.select([np.isclose(y, 0), np.isclose(y, 1), np.isclose(x, 0)], [BOTTOM, TOP, LEFT])
tags = mesh.meshtags(msh, 1, facets, where.astype(np.int32))

# begin body
P2, P1 = element("P", "triangle", 2, shape=(2,)), element("P", "triangle", 1)
W = fem.functionspace(msh, mixed_element([P2, P1]))
w = fem.Function(W)
(u, p), (v, q) = ufl.split(w), ufl.TestFunctions(W)
rubber = fc.elasticity.NeoHookean(u, E, nu=0.5, kind="plane strain", pressure=p)
F = rubber.residual(v, q=q)
# end body

depth = fem.Constant(msh, 0.0)
ends = [(1, BOTTOM, 0.0), (0, LEFT, 0.0)]
bcs = [
    fem.dirichletbc(
        value, fem.locate_dofs_topological(W.sub(0).sub(i), 1, tags.find(tag)), W.sub(0).sub(i)
    )
    for i, tag, value in ends
]
plate = fc.HalfSpace((0, 1), (0, -1), displacement=ufl.as_vector([0, -depth]))
surface = fc.ContactSurface(msh, tags, TOP)
contact = fc.Contact(
    u, surface, plate, fc.Frictionless(), kinematics="finite", enforcement="augmented"
)
problem = fc.ContactProblem(F, w, bcs=bcs, contacts=[contact])
list(fc.increments(problem, depth, 0, PRESSED, steps=4))
# At constant volume the length grows by 1 / low; ν = 1/2 means G = E/3.
low, force = 1 - PRESSED, contact.resultants().normal_force
expected = E / 3 * (1 / low**3 - low)
print(f"force {force:.6g} N/mm, closed form {expected:.6g} N/mm")
assert np.isclose(force, expected, rtol=1e-4)
