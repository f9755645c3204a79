"""A driven roller on an elastic block: creepage and traction against Carter's closed form.

python docs/scripts/driven_roller.py                      # one moment
python docs/scripts/driven_roller.py 0.25 0.5 0.75 0.9    # moments over μ P R, the picture
"""

import sys
from pathlib import Path

import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc

# begin data
E, NU, RADIUS, FRICTION = 1000.0, 0.499, 10.0, 0.3  # MPa, mm
A, CELLS = 0.25, 4  # half-width of the contact in mm, facets along it
E_STAR = E / (1 - NU**2)
FORCE = np.pi * A**2 * E_STAR / (4 * RADIUS)  # N per mm: Hertz
HEIGHT, ROLLED = 20 * A, 2 * A
BOTTOM, TOP = 1, 2

# begin mesh
h = A / CELLS
growing = np.cumsum(h * 1.5 ** np.arange(30))
growing = growing[: np.searchsorted(growing, HEIGHT) + 1]
fine = h * np.arange(-2 * CELLS, round((ROLLED + 1.5 * A) / h) + 1)
x = np.concatenate([fine[0] - growing[::-1], fine, fine[-1] + growing])
y = np.concatenate([-growing[::-1], [0.0]])
points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
at = np.arange(len(points)).reshape(len(y), len(x))
cells = np.stack([at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]], axis=-1).reshape(-1, 4)
low, high = (np.stack([row[:-1], row[1:]], axis=1) for row in (at[0], at[-1]))
msh, _, tags = fc.mesh_from_arrays(
    MPI.COMM_WORLD,
    points,
    cells,
    cell_type="quadrilateral",
    facets={BOTTOM: low, TOP: high},
)

# begin body
V = fem.functionspace(msh, ("Lagrange", 2, (2,)))
u, v = fem.Function(V), ufl.TestFunction(V)
body = fc.elasticity.LinearElastic(u, E, NU, kind="plane strain")
foot = fem.locate_dofs_topological(V, 1, tags.find(BOTTOM))
bcs = [fem.dirichletbc(np.zeros(2), foot, V)]
press, travel, moment = (fem.Constant(msh, 0.0) for _ in range(3))
roller = fc.Cylinder(
    (0, RADIUS),
    RADIUS,
    displacement=fc.Motion(force=(None, press), displacement=(travel, None)),
    rotation=fc.Rotation(None, about=(0, RADIUS), moment=moment),  # the angle is unknown
)
surface = fc.ContactSurface(msh, tags, TOP)
law = fc.Coulomb(FRICTION)


# begin rolling
def creepage(traction: float) -> tuple[float, fc.Contact]:
    """Roll with a moment of traction μ P R; return the final creepage and the contact."""
    u.x.array[:] = press.value = travel.value = moment.value = 0.0
    contact = fc.Contact(u, surface, roller, law, kinematics="finite")
    problem = fc.ContactProblem(body.residual(v), u, bcs=bcs, contacts=[contact])
    list(fc.increments(problem, press, 0, -FORCE))

    def load(rolled):
        """Increase the moment along the first third of the path."""
        travel.value = rolled
        moment.value = -traction * FRICTION * FORCE * RADIUS * min(1.0, 3 * rolled / ROLLED)

    path = [(0.0, 0.0)]
    for step in fc.increments(problem, load, 0, ROLLED, steps=round(ROLLED / h)):
        path.append((step.load, float(contact.free_angle.value)))
    (s, angle), (s_before, angle_before) = path[-1], path[-3]
    return -RADIUS * (angle - angle_before) / (s - s_before) - 1, contact


# begin compare
saturated = FRICTION * A / RADIUS  # where all points slip
ratios = [float(word) for word in sys.argv[1:]] or [0.75]
found = {}
for ratio in ratios:
    xi, contact = creepage(ratio)
    found[ratio] = xi / saturated
    expected = 1 - np.sqrt(1 - ratio)
    if msh.comm.rank == 0:
        print(f"Q/μP {ratio}: creepage {found[ratio]:.4f} μa/R, Carter {expected:.4f} μa/R")
    assert np.isclose(found[ratio], expected, atol=0.05)
    drag = -contact.resultants().force[0] / (FRICTION * FORCE)
    assert np.isclose(drag, ratio, atol=2e-3)

# begin picture
Path("output").mkdir(exist_ok=True)
if msh.comm.rank == 0:
    with fc.plotting.figure("output/driven_roller.png") as axes:
        xi = np.linspace(0, 1, 101)
        axes.plot(xi, 1 - (1 - xi) ** 2, "k-", label="Carter")
        axes.plot(list(found.values()), list(found), "o", label="computed")
        axes.set(xlabel="creepage ξ R / (μ a) [–]", ylabel="traction Q / (μ P) [–]")
        axes.set(title="Driven roller on an elastic block")
        axes.grid(alpha=0.25)
        axes.legend()
