"""Count Newton iterations at large strains, with contact and for the bulk alone.

    python benchmarks/finite.py

Two problems: a block 16 x 10 of neo-Hookean rubber under a rigid disc of radius 4 that is pressed
in by 3, rotated by 0.8 and slid by 2 (demos/rolling.py); and a rubber block that is pressed on
another one and slid along it by four fifths of its length (scenes/sliding_rubber_block.py). Each
history is solved three times: with contact; without contact, with the computed displacements of Γc
(and of the opposing surface) as Dirichlet conditions, by the same solver in the same increments;
and the latter by SNES on the form in plain DOLFINx. All have the same solutions; the last two
measure the bulk: Newton iterations, factorisations, and CPU time of all increments (median of
``--repeat``).

Newton iterations are given relative to both. The package needs fewer for the bulk: it follows
prescribed values by a step with the last factored tangent before Newton's method starts; in plain
DOLFINx this is the first iteration of each increment.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping, Sequence

import dolfinx
import dolfinx.fem.petsc  # noqa: F401
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from benchmarks import costs, timing
from fenics_contact.elasticity import NeoHookean
from fenics_contact.types import Array
from scenes import sliding_rubber_block
from scenes.blocks import BOTTOM, LEFT, TOP, block_mesh

N_INDENTATION, N_SLIDING = 12, 8  # increments of indentation, and of rotation and sliding each
RADIUS, DEPTH, ROTATION, SLIDING_DISTANCE = 4.0, 3.0, 0.8, 2.0
PATH = (
    *((0.0, DEPTH * i / N_INDENTATION, 0.0) for i in range(1, N_INDENTATION + 1)),
    *((0.0, DEPTH, ROTATION * i / N_SLIDING) for i in range(1, N_SLIDING + 1)),
    *((SLIDING_DISTANCE * i / N_SLIDING, DEPTH, ROTATION) for i in range(1, N_SLIDING + 1)),
)


class BlockUnderDisc:
    """A neo-Hookean rubber block under a rigid disc.

    Attributes:
        path: Positions of the disc, one per increment.
        parts: Increments of each part of the path.
        prescribed_tags: Tags of the facets with prescribed displacements in runs without contact.
        free: Tag of facets that are never in contact.
        bcs: Dirichlet conditions of the run with contact.
        contact: The contact.
    """

    path = PATH
    parts: Mapping[str, slice] = {
        "indentation": slice(N_INDENTATION),
        "rotation": slice(N_INDENTATION, -N_SLIDING),
        "sliding": slice(-N_SLIDING, None),
    }
    prescribed_tags = (BOTTOM, TOP)
    free = LEFT

    def __init__(self, friction: float, fine: int) -> None:
        """Create the block with ``fine`` cells per unit of length."""
        mesh, self.tags = block_mesh("quadrilateral", n=(16 * fine, 10 * fine), size=(16.0, 10.0))
        mesh.geometry.x[:, 0] -= 8
        self.u = fem.Function(fem.functionspace(mesh, ("Lagrange", 2, (2,))))
        V = self.u.function_space
        body = NeoHookean(self.u, 1000.0, 0.3, "plane strain")
        dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": 4})
        self.residual = body.residual(ufl.TestFunction(V), dx)
        foot = fem.locate_dofs_topological(V, 1, self.tags.find(BOTTOM))
        self.bcs = [fem.dirichletbc(np.zeros(2), foot, V)]
        self._shift, self._angle = fem.Constant(mesh, np.zeros(2)), fem.Constant(mesh, 0.0)
        axis = (0.0, 10.0 + RADIUS)
        turn = fc.Rotation(self._angle, about=axis)
        disc = fc.Cylinder(axis, RADIUS, displacement=self._shift, rotation=turn)
        law = fc.Coulomb(friction, 1e4, 1e3) if friction else fc.Frictionless(1e4)
        surface = fc.ContactSurface(mesh, self.tags, TOP)
        self.contact = fc.Contact(self.u, surface, disc, law, kinematics="finite")

    def set_top_displacement(self, side: float, depth: float, turn: float) -> None:
        """Move the disc sideways and down, and rotate it."""
        self._shift.value[:], self._angle.value = (side, -depth), turn


class BlockOnBlock(sliding_rubber_block.SlidingRubberBlock):
    """Two rubber blocks, with the attributes of `BlockUnderDisc`."""

    path = sliding_rubber_block.PATH
    parts: Mapping[str, slice] = {
        "indentation": slice(sliding_rubber_block.N_PRESSING),
        "sliding": slice(sliding_rubber_block.N_PRESSING, None),
    }
    prescribed_tags = (
        sliding_rubber_block.BOTTOM,
        sliding_rubber_block.TOP,
        sliding_rubber_block.LOWER,
        sliding_rubber_block.UPPER,
    )
    free = sliding_rubber_block.SIDE


Scene = Callable[[float, int], BlockUnderDisc | BlockOnBlock]
SCENES: Mapping[str, Scene] = {"disc": BlockUnderDisc, "two bodies": BlockOnBlock}


def solve_contact(made: BlockUnderDisc | BlockOnBlock) -> tuple[timing.Row, list[Array]]:
    """Solve with contact; return the row and the displacements of every increment."""
    problem = fc.ContactProblem(made.residual, made.u, bcs=made.bcs, contacts=[made.contact])
    steps, states, start = [], [], time.process_time()
    for place in made.path:
        made.set_top_displacement(*place)
        steps.append(problem.solve())
        problem.commit()
        states.append(made.u.x.array.copy())
    return tabulate_steps(made, steps, start), states


def prescribed_conditions(
    made: BlockUnderDisc | BlockOnBlock,
) -> tuple[fem.Function, list[fem.DirichletBC]]:
    """Return the function of prescribed values and the conditions of the runs without contact."""
    V = made.u.function_space
    values = fem.Function(V)
    faces = np.sort(np.concatenate([made.tags.find(tag) for tag in made.prescribed_tags]))
    return values, [fem.dirichletbc(values, fem.locate_dofs_topological(V, 1, faces))]


def solve_bulk(made: BlockUnderDisc | BlockOnBlock, states: Sequence[Array]) -> timing.Row:
    """Solve the bulk alone by the package, whose contact plane is never reached; return the row."""
    values, bcs = prescribed_conditions(made)
    far = fc.HalfSpace((0.0, 100.0), (0.0, -1.0))
    surface = fc.ContactSurface(made.u.function_space.mesh, made.tags, made.free)
    contact = fc.Contact(made.u, surface, far, fc.Frictionless(1e4), kinematics="finite")
    problem = fc.ContactProblem(made.residual, made.u, bcs=bcs, contacts=[contact])
    steps, start = [], time.process_time()
    for state in states:
        values.x.array[:] = state
        steps.append(problem.solve())
        problem.commit()
    check(made.u, states[-1])
    return tabulate_steps(made, steps, start)


def solve_bulk_dolfinx(made: BlockUnderDisc | BlockOnBlock, states: Sequence[Array]) -> timing.Row:
    """Solve the bulk alone by SNES, to the same residual; return the row."""
    values, bcs = prescribed_conditions(made)
    compiled = fem.form(made.residual)
    iterations, start = [], time.process_time()
    for state in states:
        before = made.u.x.array.copy()
        values.x.array[:] = made.u.x.array[:] = state
        forces = fem.petsc.assemble_vector(compiled)
        forces.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        made.u.x.array[:] = before
        row = costs.newton(made.residual, made.u, bcs, forces.norm(), lift=True)
        iterations.append(int(row["iterations"]))
    check(made.u, states[-1])
    return tabulate_iterations(made, iterations, iterations, start)


def check(u: fem.Function, state: Array) -> None:
    """Assert that u is the state with contact to 1e-5; residuals are 1e-9 of the largest force."""
    size = np.abs(state).max(initial=0.0)
    assert np.abs(u.x.array - state).max(initial=0.0) < 1e-5 * size


def tabulate_steps(
    made: BlockUnderDisc | BlockOnBlock, steps: Sequence[fc.Step], start: float
) -> timing.Row:
    """Return the row of a run by the package."""
    factorisations = [step.factorisations for step in steps]
    return tabulate_iterations(made, [step.iterations for step in steps], factorisations, start)


def tabulate_iterations(
    made: BlockUnderDisc | BlockOnBlock,
    steps: Sequence[int],
    factorisations: Sequence[int],
    start: float,
) -> timing.Row:
    """Return the row of a run: iterations by parts of the path, factorisations, CPU time."""
    row: timing.Row = {name: sum(steps[part]) for name, part in made.parts.items()}
    row |= {"Newton iterations": sum(steps), "factorisations": sum(factorisations)}
    return row | {"solving [s]": time.process_time() - start}  # CPU time


def main() -> None:
    """Run the benchmark and write its results."""
    arguments = timing.parser(__doc__, "finite").parse_args()
    fine = 1 if arguments.short else 2
    rows = []
    for name, scene in SCENES.items():
        for friction in (0.0, 0.3):

            def make(
                friction: float = friction, scene: Scene = scene
            ) -> BlockUnderDisc | BlockOnBlock:
                return scene(friction, fine)

            _, states = solve_contact(make())
            runs: dict[str, Callable[[], timing.Row]] = {
                "contact": lambda make=make: solve_contact(make())[0],
                "bulk only": functools.partial(lambda make, s: solve_bulk(make(), s), make, states),
                "bulk only, DOLFINx": functools.partial(
                    lambda make, s: solve_bulk_dolfinx(make(), s), make, states
                ),
            }
            made = timing.measure(runs, repeat=1 if arguments.short else arguments.repeat)
            _, alone, bare = made
            for row in made:
                ratio = {
                    "iterations / DOLFINx": row["Newton iterations"] / bare["Newton iterations"],
                    "iterations / package": row["Newton iterations"] / alone["Newton iterations"],
                    "time / bulk only": row["solving [s]"] / alone["solving [s]"],
                }
                head = {"problem": name, "μ": friction, "dofs": states[0].size}
                rows.append(head | {k: v for k, v in row.items() if k != "seconds"} | ratio)
                if MPI.COMM_WORLD.rank == 0:
                    print(*rows[-1].values(), sep="  ", flush=True)
    timing.write(
        arguments.output, "finite", "Newton iterations with contact and for the bulk alone", rows
    )


if __name__ == "__main__":
    main()
