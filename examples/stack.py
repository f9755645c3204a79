"""Three separate meshes joined into one: contact pairs are found, and each transmits the load."""

import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

import fenics_contact as fc

PRESSURE, HEIGHT, FLOOR, ROOF, LEFT = 2.0, 0.5, 1, 2, 3  # MPa, mm; the blocks are 1 mm wide
E = {"steel": 210e3, "plastic": 2e3, "brass": 100e3}  # MPa, from bottom to top


def block(low, cells):
    """Return mesh, None for the cell tags, and facet tags of a block above the height ``low``."""
    msh = mesh.create_rectangle(MPI.COMM_WORLD, [(0, low), (1, low + HEIGHT)], (cells, cells))
    sides = {FLOOR: (1, low), ROOF: (1, low + HEIGHT), LEFT: (0, 0.0)}
    found = [
        mesh.locate_entities_boundary(msh, 1, lambda x, i=i, at=at: np.isclose(x[i], at))
        for i, at in sides.values()
    ]
    facets, values = np.hstack(found), np.repeat(np.int32(list(sides)), [len(f) for f in found])
    order = np.argsort(facets)
    return msh, None, mesh.meshtags(msh, 1, facets[order], values[order])


counts = {"steel": 3, "plastic": 8, "brass": 5}
joined = fc.join_meshes({name: block(HEIGHT * i, n) for i, (name, n) in enumerate(counts.items())})
V = fem.functionspace(joined.mesh, ("Lagrange", 1, (2,)))
u, v = fem.Function(V), ufl.TestFunction(V)
body = fc.elasticity.LinearElastic(u, joined.by_body(E), nu=0.3, kind="plane stress")
ds = ufl.Measure("ds", domain=joined.mesh, subdomain_data=joined.facets)
F = body.residual(v) + PRESSURE * v[1] * ds(joined.facet("brass", ROOF))
held = [(0, joined.facet(name, LEFT)) for name in E] + [(1, joined.facet("steel", FLOOR))]
dofs = [fem.locate_dofs_topological(V.sub(i), 1, joined.facets.find(tag)) for i, tag in held]
bcs = [fem.dirichletbc(0.0, d, V.sub(i)) for (i, _), d in zip(held, dofs, strict=True)]
contacts = fc.find_contact_pairs(u, fc.Frictionless(), distance=0.05, bodies=joined)
fc.ContactProblem(F, u, bcs=bcs, contacts=contacts).solve()
forces = {contact.name: contact.resultants().normal_force for contact in contacts}
if joined.mesh.comm.rank == 0:
    for name, force in forces.items():
        print(f"{name}: {force:.6g} N/mm, the load is {PRESSURE:.6g} N/mm")
assert list(forces) == ["steel-plastic", "plastic-brass"]
assert np.allclose(list(forces.values()), PRESSURE, rtol=1e-9)
