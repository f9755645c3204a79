"""Impact and rebound by Newmark and HHT: a bar on a rigid wall, a mass on a spring.

python docs/scripts/rebound.py              # HHT, α = -0.3
python docs/scripts/rebound.py 0 0.6 40     # α, γ and cells: here Newmark's method with γ = 0.6
"""

import sys
from pathlib import Path

import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

import fenics_contact as fc

DENSITY, SPEED, WIDTH, LENGTH, WALL = 2.0, 0.5, 0.1, 1.0, 1
ALPHA, GAMMA = map(float, sys.argv[1:3]) if len(sys.argv) > 2 else (-0.3, 0.8)
BETA = (GAMMA + 0.5) ** 2 / 4


# begin form
def impact(modulus: float, cells: int, law: fc.Law, dt: float, steps: int):
    """Return force, and relative kinetic energy, elastic energy and momentum at every step."""
    n = (1, cells)
    msh = mesh.create_rectangle(
        MPI.COMM_WORLD, [(0, 0), (WIDTH, LENGTH)], n, mesh.CellType.quadrilateral
    )
    facets = mesh.locate_entities_boundary(msh, 1, lambda x: np.isclose(x[1], 0))
    tags = mesh.meshtags(msh, 1, facets, np.full(facets.size, WALL, dtype=np.int32))
    V = fem.functionspace(msh, ("Lagrange", 1, (2,)))
    axis = (V.sub(0), V.sub(0).collapse()[0])
    side = fem.locate_dofs_geometrical(axis, lambda x: np.isclose(x[0], 0))[0]
    v = ufl.TestFunction(V)
    u, u_old, velocity, acceleration = (fem.Function(V) for _ in range(4))
    predicted = u_old + dt * velocity + dt**2 * (0.5 - BETA) * acceleration
    now, old = (fc.elasticity.LinearElastic(w, modulus, 0.0, "plane strain") for w in (u, u_old))
    F = (1 + ALPHA) * now.residual(v) - ALPHA * old.residual(v)
    F += DENSITY * ufl.dot((u - predicted) / (BETA * dt**2), v) * ufl.dx
    surface = fc.ContactSurface(msh, tags, WALL)
    contact = fc.Contact(u, surface, fc.HalfSpace((0, 0), (0, 1)), law)
    bcs = [fem.dirichletbc(0.0, side, V.sub(0))]
    problem = fc.ContactProblem(F, u, bcs=bcs, contacts=[contact])

    # begin steps
    strain = ufl.sym(ufl.grad(u_old))
    kinetic = fem.form(DENSITY / 2 * ufl.dot(velocity, velocity) * ufl.dx)
    elastic = fem.form(modulus / 2 * ufl.inner(strain, strain) * ufl.dx)  # ν = 0
    momentum = fem.form(DENSITY * velocity[1] * ufl.dx)
    velocity.x.array[1::2] = -SPEED
    mass = DENSITY * WIDTH * LENGTH
    scales = np.array([mass * SPEED**2 / 2, mass * SPEED**2 / 2, mass * SPEED])
    forces, states = [], []
    for _ in range(steps):
        step = problem.solve()
        problem.commit()
        forces.append(step.contacts["contact"].normal_force)
        a = acceleration.x.array.copy()
        acceleration.x.array[:] = (u.x.array - u_old.x.array - dt * velocity.x.array) / (
            BETA * dt**2
        ) - (0.5 / BETA - 1) * a
        velocity.x.array[:] += dt * ((1 - GAMMA) * a + GAMMA * acceleration.x.array)
        u_old.x.array[:] = u.x.array
        sums = [msh.comm.allreduce(fem.assemble_scalar(f)) for f in (kinetic, elastic, momentum)]
        states.append(sums / scales)
    return np.array(forces), np.array(states)


# begin bar
E, CELLS = 1000.0, int(sys.argv[3]) if len(sys.argv) > 3 else 40
c = float(np.sqrt(E / DENSITY))
dt = LENGTH / CELLS / c  # a wave passes one cell in a step
forces, states = impact(E, CELLS, fc.Frictionless(), dt, 3 * CELLS)
time = dt * np.arange(1, len(forces) + 1) * c / LENGTH
plateau = forces / (DENSITY * c * SPEED * WIDTH)
inside, touching = (time > 0.4) & (time < 1.6), time[plateau > 0.02]
mean, scatter, last = plateau[inside].mean(), plateau[inside].std(), touching[-1]
energy = states[-1, :2].sum()
if MPI.COMM_WORLD.rank == 0:
    print(f"bar: force {mean:.4f} ρcvA, scatter {scatter:.4f}, largest {plateau.max():.2f}")
    print(f"bar: contact ends at {last:.3f} L/c, momentum {states[-1, 2]:.4f}, energy {energy:.4f}")

# begin spring
K = 50.0  # of the spring, stress per length
omega = float(np.sqrt(K / (DENSITY * LENGTH)))
spring = fc.Foundation(K, tension=False)
spring_dt = np.pi / omega / 40
spring_forces, spring_states = impact(1e7, 1, spring, spring_dt, 50)
t = spring_dt * np.arange(1, 51)
peak = SPEED * WIDTH * np.sqrt(K * DENSITY * LENGTH)
exact = peak * np.maximum(0, np.sin(omega * t)) * (t < np.pi / omega)
error = np.abs(spring_forces - exact).max() / peak
if MPI.COMM_WORLD.rank == 0:
    print(f"spring: force off by {error:.4f} of v √(km), momentum {spring_states[-1, 2]:.4f}")

# begin picture
Path("output").mkdir(exist_ok=True)
if MPI.COMM_WORLD.rank == 0:
    with fc.plotting.figure("output/rebound.png", 2) as (left, right):
        left.plot(time, plateau, ".-", ms=3, label="computed")
        left.plot([0, 0, 2, 2, 3], [0, 1, 1, 0, 0], "k--", label="wave")
        left.set(xlabel="time t c / L [–]", ylabel="contact force / (ρ c v A) [–]")
        left.set(title="Bar on a rigid wall")
        right.plot(time, states[:, 0], label="kinetic")
        right.plot(time, states[:, 1], label="elastic")
        right.plot(time, states[:, :2].sum(axis=1), "k", label="sum")
        right.set(xlabel="time t c / L [–]", ylabel="energy / initial kinetic energy [–]")
        right.set(title="Energy of the bar")
        for axes in (left, right):
            axes.grid(alpha=0.25)
            axes.legend()
# begin assert
if len(sys.argv) < 3:
    assert abs(mean - 1) < 1e-3 and abs(last - 2) < 0.05 and 0.96 < energy < 1
    assert error < 0.03
