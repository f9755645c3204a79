"""A bar hits a wall: Newmark's method is in the form, and the force is that of a wave."""

import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

import fenics_contact as fc

E, DENSITY, SPEED, WIDTH, WALL = 1000.0, 2.0, 0.5, 0.1, 1
msh = mesh.create_rectangle(
    MPI.COMM_WORLD, [(0, 0), (WIDTH, 1)], (1, 40), mesh.CellType.quadrilateral
)
facets = mesh.locate_entities_boundary(msh, 1, lambda x: np.isclose(x[1], 0))
tags = mesh.meshtags(msh, 1, facets, np.full(facets.size, WALL, dtype=np.int32))
V = fem.functionspace(msh, ("Lagrange", 1, (2,)))
side = fem.locate_dofs_geometrical(
    (V.sub(0), V.sub(0).collapse()[0]), lambda x: np.isclose(x[0], 0)
)[0]

# begin form
BETA, GAMMA = 0.3025, 0.6  # damps the highest frequencies
celerity = float(np.sqrt(E / DENSITY))
dt = fem.Constant(msh, 0.025 / celerity)
u, before, velocity, acceleration = (fem.Function(V) for _ in range(4))
v = ufl.TestFunction(V)
predicted = before + dt * velocity + dt**2 * (0.5 - BETA) * acceleration
bar = fc.elasticity.LinearElastic(u, E, nu=0.0, kind="plane strain")
F = bar.residual(v) + DENSITY * ufl.dot((u - predicted) / (BETA * dt**2), v) * ufl.dx
# begin steps
wall, surface = fc.HalfSpace((0, 0), (0, 1)), fc.ContactSurface(msh, tags, WALL)
contact = fc.Contact(u, surface, wall, fc.Frictionless())
problem = fc.ContactProblem(F, u, bcs=[fem.dirichletbc(0.0, side, V.sub(0))], contacts=[contact])
velocity.x.array[1::2] = -SPEED
times, forces = 0.025 * np.arange(1, 121), []
for _ in times:
    step = problem.solve()
    problem.commit()
    forces.append(step.contacts["contact"].normal_force)
    a, t = acceleration.x.array.copy(), float(dt.value)
    acceleration.x.array[:] = (u.x.array - before.x.array - t * velocity.x.array) / (BETA * t**2)
    acceleration.x.array[:] -= (0.5 / BETA - 1) * a
    velocity.x.array[:] += t * ((1 - GAMMA) * a + GAMMA * acceleration.x.array)
    before.x.array[:] = u.x.array
# begin compare
wave = DENSITY * celerity * SPEED * WIDTH  # until the wave returns from the free end
while_there = np.array(forces)[(times > 0.4) & (times < 1.6)]
impulse = np.sum(forces) * float(dt.value) / (2 * DENSITY * WIDTH * SPEED)
print(f"force {while_there.mean():.4g}, of a wave {wave:.4g}; impulse / 2 m v = {impulse:.3f}")
assert np.allclose(while_there.mean(), wave, rtol=0.01)
assert 0.95 < impulse < 1.0 and max(np.array(forces)[times > 2.2]) == 0.0
