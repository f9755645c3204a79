"""What contact adds to Newton's method at large strains, with and without friction.

    python benchmarks/finite.py

A block 16 x 10 of neo-Hookean rubber under a rigid disc of radius 4 that is pressed in by 3, turned
by 0.8 and dragged by 2: the scene of demos/rolling.py. Each history is solved twice: under the
disc; and with the displacements of Γc that were found prescribed there, without any contact, by the
same solver in the same increments. So both have the same solutions, and the second one has what the
bulk alone costs: Newton steps, and the time of all increments (medians of ``--repeat`` runs).
"""

from __future__ import annotations

import functools
import time

import dolfinx
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from benchmarks import timing
from fenics_contact.elasticity import NeoHookean
from scenes.blocks import BOTTOM, LEFT, TOP, block_mesh

PRESSED, MORE = 12, 8  # increments of the press, and of turn and drag each
RADIUS, DEPTH, TURN, WAY = 4.0, 3.0, 0.8, 2.0
PATH = (
    *((0.0, DEPTH * i / PRESSED, 0.0) for i in range(1, PRESSED + 1)),
    *((0.0, DEPTH, TURN * i / MORE) for i in range(1, MORE + 1)),
    *((WAY * i / MORE, DEPTH, TURN) for i in range(1, MORE + 1)),
)
PARTS = {"pressed": slice(PRESSED), "turned": slice(PRESSED, -MORE), "dragged": slice(-MORE, None)}


def block(fine: int) -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags, fem.Function, NeoHookean]:
    """The rubber, ``fine`` cells per unit of length."""
    mesh, tags = block_mesh("quadrilateral", n=(16 * fine, 10 * fine), size=(16.0, 10.0))
    mesh.geometry.x[:, 0] -= 8
    u = fem.Function(fem.functionspace(mesh, ("Lagrange", 2, (2,))))
    return mesh, tags, u, NeoHookean(u, 1000.0, 0.3, "plane strain")


def under_the_disc(friction: float, fine: int) -> tuple[timing.Row, list[np.ndarray]]:
    """With contact; what it took, and the displacements after every increment."""
    mesh, tags, u, body = block(fine)
    V = u.function_space
    foot = fem.locate_dofs_topological(V, 1, tags.find(BOTTOM))
    shift, angle = fem.Constant(mesh, np.zeros(2)), fem.Constant(mesh, 0.0)
    axis = (0.0, 10.0 + RADIUS)
    disc = fc.Cylinder(axis, RADIUS, displacement=shift, rotation=fc.Rotation(angle, about=axis))
    law = fc.Coulomb(friction, 1e4, 1e3) if friction else fc.Frictionless(1e4)
    contact = fc.Contact(u, fc.ContactSurface(mesh, tags, TOP), disc, law, kinematics="finite")
    dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": 4})
    F = body.residual(ufl.TestFunction(V), dx)
    bcs = [fem.dirichletbc(np.zeros(2), foot, V)]
    problem = fc.ContactProblem(F, u, bcs=bcs, contacts=[contact])
    iterations, states, start = [], [], time.perf_counter()
    for side, depth, turn in PATH:
        shift.value[:], angle.value = (side, -depth), turn
        iterations.append(problem.solve().iterations)
        problem.commit()
        states.append(u.x.array.copy())
    return told(iterations) | {"solving": time.perf_counter() - start}, states


def prescribed(states: list[np.ndarray], fine: int) -> timing.Row:
    """The bulk alone, Γc moved as it was; what it took. The plane that is there is never met."""
    mesh, tags, u, body = block(fine)
    V, held = u.function_space, fem.Function(u.function_space)
    faces = np.sort(np.concatenate([tags.find(BOTTOM), tags.find(TOP)]))
    bcs = [fem.dirichletbc(held, fem.locate_dofs_topological(V, 1, faces))]
    far = fc.HalfSpace((0.0, 100.0), (0.0, -1.0))
    surface = fc.ContactSurface(mesh, tags, LEFT)
    contact = fc.Contact(u, surface, far, fc.Frictionless(1e4), kinematics="finite")
    dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": 4})
    F = body.residual(ufl.TestFunction(V), dx)
    problem = fc.ContactProblem(F, u, bcs=bcs, contacts=[contact])
    iterations, start = [], time.perf_counter()
    for state in states:
        held.x.array[:] = state
        iterations.append(problem.solve().iterations)
        problem.commit()
    # Forces are met to 1e-9 of the largest, displacements to less.
    assert np.abs(u.x.array - states[-1]).max(initial=0.0) < 1e-5 * DEPTH
    return told(iterations) | {"solving": time.perf_counter() - start}


def told(iterations: list[int]) -> timing.Row:
    """Newton steps by parts of the path."""
    parts = {name: sum(iterations[part]) for name, part in PARTS.items()}
    return parts | {"Newton steps": sum(iterations)}


def main() -> None:
    """Measure and write."""
    arguments = timing.parser(__doc__, "finite").parse_args()
    fine = 1 if arguments.short else 2
    rows = []
    for friction in (0.0, 0.3):
        _, states = under_the_disc(friction, fine)
        runs = {
            "contact": lambda friction=friction: under_the_disc(friction, fine)[0],
            "prescribed": functools.partial(prescribed, states, fine),
        }
        made = timing.measure(runs, repeat=1 if arguments.short else arguments.repeat)
        alone = made[-1]
        for row in made:
            ratio = {
                "steps / prescribed": row["Newton steps"] / alone["Newton steps"],
                "time / prescribed": row["solving"] / alone["solving"],
            }
            rows.append({"μ": friction} | row | ratio)
            if MPI.COMM_WORLD.rank == 0:
                print(*rows[-1].values(), sep="  ", flush=True)
    timing.write(arguments.output, "finite", "Newton's method with contact and without it", rows)


if __name__ == "__main__":
    main()
