"""Heat through two bars in contact: conductance of the interface as an elastic foundation."""

import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

import fenics_contact as fc

LENGTH, CONDUCTIVITY = {"hot": 0.03, "cold": 0.05}, {"hot": 50.0, "cold": 15.0}  # m, W/(m K)
T_HOT, T_COLD = 400.0, 300.0  # K
E, PRESSURE, H_PER_PRESSURE = 2e11, 5e6, 4e-4  # Pa, Pa, W/(m² K) per Pa
WIDTH, LOW, HIGH = 0.01, 1, 2
ANGLE = np.pi / 6  # of the bars: the interface may have any direction
AXIS = np.array([-np.sin(ANGLE), np.cos(ANGLE)])


# begin bodies
def bar(low: float, high: float, cells: tuple[int, int]):
    """Return the mesh of a bar between two heights along its axis, and the tags of its ends."""
    msh = mesh.create_rectangle(MPI.COMM_WORLD, [(0, low), (WIDTH, high)], cells)
    facets = mesh.locate_entities_boundary(msh, 1, lambda x: np.isfinite(x[0]))
    y = mesh.compute_midpoints(msh, 1, facets)[:, 1]
    where = np.select([np.isclose(y, low), np.isclose(y, high)], [LOW, HIGH])
    tags = mesh.meshtags(msh, 1, facets, where.astype(np.int32))
    across, along = msh.geometry.x[:, :2].T
    msh.geometry.x[:, :2] = np.outer(across, [AXIS[1], -AXIS[0]]) + np.outer(along, AXIS)
    return msh, None, tags


bars = {"cold": bar(-LENGTH["cold"], 0, (3, 6)), "hot": bar(0, LENGTH["hot"], (5, 6))}
joined = fc.join_meshes(bars)
msh, tags = joined.mesh, joined.facets
top, bottom = joined.facet("hot", HIGH), joined.facet("cold", LOW)
surface = fc.ContactSurface(msh, tags, joined.facet("hot", LOW))
opposite = fc.DeformableBody(tags, joined.facet("cold", HIGH), update_pairs="never")
V = fem.functionspace(msh, ("Lagrange", 1, (2,)))
v = ufl.TestFunction(V)

# begin mechanics
u = fem.Function(V)
body = fc.elasticity.LinearElastic(u, E, 0.3, "plane strain")
ds = ufl.Measure("ds", domain=msh, subdomain_data=tags)
foot = fem.locate_dofs_topological(V, 1, tags.find(bottom))
pressed = fc.Contact(u, surface, opposite, fc.Coulomb(0.3))
problem = fc.ContactProblem(
    body.residual(v) + PRESSURE * ufl.dot(ufl.as_vector(AXIS.tolist()), v) * ds(top),
    u,
    bcs=[fem.dirichletbc(np.zeros(2), foot, V)],
    contacts=[pressed],
)
problem.solve()
pressure = pressed.resultants().normal_force / WIDTH

# begin heat
w = fem.Function(V, name="temperature")  # (T, 0)
k = joined.by_body(CONDUCTIVITY)
h = H_PER_PRESSURE * pressure
conductance = fc.Contact(w, surface, opposite, fc.Foundation(h, h), gap=0, name="conductance")
hot, cold = (fem.locate_dofs_topological(V.sub(0), 1, tags.find(tag)) for tag in (top, bottom))
ends = np.concatenate([tags.find(top), tags.find(bottom)])
second = fem.locate_dofs_topological(V.sub(1), 1, ends)
heat = fc.ContactProblem(
    k * ufl.inner(ufl.grad(w), ufl.grad(v)) * ufl.dx,
    w,
    bcs=[
        fem.dirichletbc(T_HOT, hot, V.sub(0)),
        fem.dirichletbc(T_COLD, cold, V.sub(0)),
        fem.dirichletbc(0.0, second, V.sub(1)),
    ],
    contacts=[conductance],
    small_displacement_tolerance=np.inf,  # the jump is a temperature
    prefix="heat_",
)
heat.solve()

# begin compare
flux = -conductance.resultants().force[0] / WIDTH
resistance = sum(LENGTH[name] / CONDUCTIVITY[name] for name in LENGTH) + 1 / h
expected = (T_HOT - T_COLD) / resistance
if msh.comm.rank == 0:
    print(f"h = {h:.6g} W/(m² K), heat flux {flux:.6g} W/m², closed form {expected:.6g} W/m²")
assert np.isclose(flux, expected, rtol=1e-6)
