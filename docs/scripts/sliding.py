"""A plastic pad on a steel plate in cyclic sliding: the hysteresis loop of the friction force."""

from pathlib import Path

import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

import fenics_contact as fc

FRICTION, PRESSURE, WIDTH, AMPLITUDE = 0.3, 10.0, 1.0, 8e-3  # MPa, mm; forces in N per mm of depth
E, NU = {"plate": 2.1e5, "pad": 3e3}, 0.35
BELOW, ABOVE = 1, 2


# begin bodies
def block(low, high, cells):
    """Return mesh and facet tags of a rectangle between two corners."""
    msh = mesh.create_rectangle(MPI.COMM_WORLD, [low, high], cells)
    facets = mesh.locate_entities_boundary(msh, 1, lambda x: np.isfinite(x[0]))
    y = mesh.compute_midpoints(msh, 1, facets)[:, 1]
    where = np.select([np.isclose(y, low[1]), np.isclose(y, high[1])], [BELOW, ABOVE])
    return msh, None, mesh.meshtags(msh, 1, facets, where.astype(np.int32))


plate = block((-1, -0.5), (1, 0), (20, 5))
pad = block((-WIDTH / 2, 0), (WIDTH / 2, 0.3), (24, 8))
joined = fc.join_meshes({"plate": plate, "pad": pad})
V = fem.functionspace(joined.mesh, ("Lagrange", 2, (2,)))
u, v = fem.Function(V), ufl.TestFunction(V)
pressure, travel = fem.Constant(joined.mesh, 0.0), fem.Constant(joined.mesh, 0.0)
body = fc.elasticity.LinearElastic(u, joined.by_body(E), NU, kind="plane strain")
ds = ufl.Measure("ds", domain=joined.mesh, subdomain_data=joined.facets)
F = body.residual(v) + pressure * v[1] * ds(joined.facet("pad", ABOVE))
conditions = [("pad", ABOVE, 0, 0.0), ("plate", BELOW, 0, travel), ("plate", BELOW, 1, 0.0)]
bcs = []
for name, side, i, value in conditions:
    facets = joined.facets.find(joined.facet(name, side))
    dofs = fem.locate_dofs_topological(V.sub(i), 1, facets)
    bcs.append(fem.dirichletbc(value, dofs, V.sub(i)))

# begin contact
surface = fc.ContactSurface(joined.mesh, joined.facets, joined.facet("pad", BELOW))
obstacle = fc.DeformableBody(joined.facets, joined.facet("plate", ABOVE))
contact = fc.Contact(u, surface, obstacle, fc.Coulomb(FRICTION))
problem = fc.ContactProblem(F, u, bcs=bcs, contacts=[contact])

# begin history
list(fc.increments(problem, pressure, 0, PRESSURE))
displacements, forces, dissipation = [0.0], [0.0], 0.0
for start, end in ((0, AMPLITUDE), (AMPLITUDE, -AMPLITUDE), (-AMPLITUDE, AMPLITUDE)):
    for step in fc.increments(problem, travel, start, end, steps=10 if start == 0 else 20):
        displacements.append(step.load)
        forces.append(float(contact.resultants().force[0]))
        dissipation += step.energy.dissipation if start != 0 else 0.0  # in the cycle

# begin picture
loop = slice(10, None)  # from the first load reversal on
area = np.trapezoid(forces[loop], displacements[loop])
Path("output").mkdir(exist_ok=True)
if joined.mesh.comm.rank == 0:
    with fc.plotting.figure("output/hysteresis.png") as axes:
        axes.plot(1e3 * np.array(displacements), forces, ".-")
        axes.set(xlabel="displacement of the plate [µm]", ylabel="friction on the pad [N/mm]")
        axes.set(title=f"Friction dissipates {1e3 * dissipation:.3g} µJ/mm per cycle")
        axes.grid(alpha=0.25)
    print(f"loop {1e3 * area:.4g} µJ/mm, dissipation {1e3 * dissipation:.4g} µJ/mm")

limit = FRICTION * PRESSURE * WIDTH
assert np.isclose(forces[10], limit, rtol=1e-6) and np.isclose(forces[-1], limit, rtol=1e-6)
assert np.isclose(area, dissipation, rtol=1e-2)  # trapezoidal rule
