"""Compare the default with every method without fallback on random scenes.

    python benchmarks/random_scenes.py               # 600 scenes
    python benchmarks/random_scenes.py --short       # 8 of each
    python benchmarks/random_scenes.py --only small  # one kind

The scenes are those of ``verification/``: small displacements without cut increments, some with
more cells and with stiffer contact; and finite kinematics on rigid obstacles and between two
bodies, with one cut. They do not prescribe method, condensation or linear solver. A scene is
complete if all its increments are verified. The table has the complete scenes of every method,
their iterations, and CPU time; the CSV has a row for every scene and method. Requirement: the
default completes at least as many scenes as the best single method, in at most 1.1 of its
iterations on the scenes that both complete.
"""

from __future__ import annotations

import logging
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import fenics_contact as fc
from benchmarks import timing
from verification import finite_scenes, fuzz_scenes, fuzz_setup, sliding_scenes

Scene = dict[str, Any]
# Not drawn: settings of the solution, and features that some methods do not support.
EXCLUDED_FEATURES = (
    "far",
    "multipliers",
    "motion",
    "accuracy",
    "method",
    "max_iterations",
    "restart",
    "units",
)
SOLVER_OPTIONS = ("method", "max_iterations", "restart", "condensation")
# Scenes of a family use the same compiled forms.
FAMILY = 8


@dataclass(frozen=True)
class Kind:
    """A kind of random scene.

    Attributes:
        draw: Draws a scene from its seed and its family.
        setup: Creates mesh, contacts and problem.
        methods: Methods that support these scenes.
        scenes: Number of scenes.
        first: First seed.
        cuts: Number of times that an increment may be halved.
    """

    draw: Callable[[int, int], Scene]
    setup: type[fuzz_setup.SceneSetup]
    methods: tuple[str, ...]
    scenes: int
    first: int
    cuts: int


def draw_small(seed: int, family: int) -> Scene:
    """Draw a scene with small displacements."""
    return fuzz_scenes.draw(seed, without=(*EXCLUDED_FEATURES, "increment"), family=family)


def draw_fine(seed: int, family: int, stiffer: float = 1.0) -> Scene:
    """Draw a scene of `draw_small` with 4 times (3D: twice) the cells along every edge."""
    scene = draw_small(seed, family)
    for body in scene["bodies"]:
        body["n"] = [n * (4 if len(body["n"]) == 2 else 2) for n in body["n"]]
    for contact in scene["contacts"]:
        law = contact["law"]
        for name in ("k_n", "k_t"):
            unit, value = law.get(name) or (None, None)
            if stiffer > 1.0 and unit in ("scaled", "number"):
                law[name] = ["scaled", stiffer * (value or 10.0)]
    return scene


def draw_stiff(seed: int, family: int) -> Scene:
    """Draw a scene of `draw_fine` with 30 times the contact stiffness, in units of E/h."""
    return draw_fine(seed, family, stiffer=30.0)


def draw_finite(seed: int, family: int) -> Scene:
    """Draw a scene with finite kinematics on rigid obstacles."""
    return finite_scenes.draw(seed, family=family)


def draw_bodies(seed: int, family: int) -> Scene:
    """Draw a scene with finite kinematics between two bodies."""
    return sliding_scenes.draw(seed, family=family)


FINITE = ("newton", "continuation")
SMALL = (*FINITE, "lbfgs", "primal_dual")
KINDS = {
    "small": Kind(draw_small, fuzz_setup.SceneSetup, SMALL, 400, 940000, 0),
    "fine": Kind(draw_fine, fuzz_setup.SceneSetup, SMALL, 50, 945000, 0),
    "stiff": Kind(draw_stiff, fuzz_setup.SceneSetup, SMALL, 50, 945000, 0),
    "finite": Kind(draw_finite, finite_scenes.FiniteSetup, FINITE, 60, 2000, 1),
    "bodies": Kind(draw_bodies, sliding_scenes.SlidingSetup, FINITE, 40, 3000, 1),
}


def solve_scenes(name: str, kind: Kind, scenes: int) -> Iterator[timing.Row]:
    """Yield the row of every scene by the default and by every method alone. Collective."""
    for seed in range(kind.first, kind.first + scenes):
        drawn = kind.draw(seed, seed // FAMILY) | {"cuts": kind.cuts}
        scene = {key: value for key, value in drawn.items() if key not in SOLVER_OPTIONS}
        for method in ("default", *kind.methods):
            alone = {} if method == "default" else {"method": method, "fallback": False}
            iterations: list[int] = []

            def count(record: dict[str, Any], made: list[int] = iterations) -> None:
                made.append(record["iterations"])

            start = time.process_time()
            try:
                fuzz_setup.run_history(scene | alone, MPI.COMM_WORLD, count, setup_class=kind.setup)
                outcome = "complete"
            except fc.NotConverged:
                outcome = "refused"
            except ValueError:  # invalid input, or not supported by the method
                outcome = "not taken"
            yield {
                "kind": name,
                "seed": seed,
                "method": method,
                "outcome": outcome,
                "iterations": sum(iterations),
                "seconds": time.process_time() - start,
            }


def summarise(rows: list[timing.Row]) -> list[timing.Row]:
    """Return the table of complete scenes and iterations by kind and method."""
    table = []
    for kind, method in dict.fromkeys((row["kind"], row["method"]) for row in rows):
        mine = [row for row in rows if (row["kind"], row["method"]) == (kind, method)]
        complete = {row["seed"]: row["iterations"] for row in mine if row["outcome"] == "complete"}
        default = {
            row["seed"]: row["iterations"]
            for row in rows
            if (row["kind"], row["method"], row["outcome"]) == (kind, "default", "complete")
        }
        both = complete.keys() & default.keys()
        table.append(
            {
                "kind": kind,
                "method": method,
                "scenes": len(mine),
                "complete": len(complete),
                "not taken": sum(row["outcome"] == "not taken" for row in mine),
                "iterations": sum(complete.values()),
                "default, same scenes": sum(default[seed] for seed in both),
                "same scenes": sum(complete[seed] for seed in both),
                "seconds": sum(row["seconds"] for row in mine),
            }
        )
    return table


def main() -> None:
    """Solve the scenes, and write rows and table."""
    parser = timing.parser(__doc__, "random_scenes")
    parser.add_argument("--only", choices=KINDS, help="one kind of scenes")
    parser.add_argument("--scenes", type=int, help="number of scenes of each kind")
    parser.add_argument("--start", type=int, default=0, help="added to the first seeds")
    arguments = parser.parse_args()
    logging.getLogger("fenics_contact").setLevel(logging.ERROR)
    warnings.simplefilter("ignore")
    rows = []
    for name, kind in KINDS.items():
        if arguments.only in (None, name):
            scenes = arguments.scenes or (FAMILY if arguments.short else kind.scenes)
            shifted = Kind(**{**vars(kind), "first": kind.first + arguments.start})
            rows += solve_scenes(name, shifted, scenes)
    timing.write(arguments.output, "scenes", "Random scenes", rows)
    timing.write(arguments.output, "methods", "The default and its methods alone", summarise(rows))


if __name__ == "__main__":
    main()
