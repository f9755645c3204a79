"""Compare the default selection with every linear solver and method on random problems.

    OMP_NUM_THREADS=1 python benchmarks/selection.py               # 60 scenes, hours
    OMP_NUM_THREADS=1 python benchmarks/selection.py --short       # 4 small ones
    OMP_NUM_THREADS=1 python benchmarks/selection.py --start 20 --scenes 10

A scene is drawn from its seed: a stack of blocks of simplices, quadrilaterals or hexahedra, graded
towards the contact or not; a rigid ball is pressed on the uppermost block and then moved along it.
Some scenes have friction, some a nonlinear bulk; Γc is the contact zone or the whole top. Each
configuration of the solver runs in a new process, after a small problem that compiles its forms.
Measured are the time to create and solve the problem, and the growth of the process's memory up to
its peak. A configuration that takes much longer than the default is terminated. Requirement: the
default takes at most 1.25 times the time of the fastest configuration in 95 % of the scenes and at
most twice that time in all, and at most twice the least memory of the configurations within 1.25.
"""

from __future__ import annotations

import json
import logging
import os
import subprocess
import time
import warnings
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import dolfinx
import gmsh
import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import CellType
from mpi4py import MPI

import fenics_contact as fc
from benchmarks import timing
from fenics_contact.elasticity import LinearElastic, NeoHookean
from scenes.elasticity import dirichlet_bc, displacement_space
from scenes.problems import n_dofs
from scenes.processes import run_json
from scenes.tags import tag_by_nodes
from verification import report

COMM = MPI.COMM_WORLD
BASE, TOP, SIDE = 1, 2, 3
E, NU, RADIUS, DEPTH = 1000.0, 0.3, 4.0, 0.01
HALF_WIDTH = (RADIUS * DEPTH) ** 0.5  # of the contact, approximately
DEFAULT = "default"
CONFIGURATIONS: dict[str, dict[str, Any]] = {
    DEFAULT: {},
    "condensed": {"condensation": True},
    "direct, Newton": {"condensation": False, "linear_solver": "direct", "method": "newton"},
    "direct, L-BFGS": {"condensation": False, "linear_solver": "direct", "method": "lbfgs"},
    "multigrid, Newton": {"condensation": False, "linear_solver": "multigrid", "method": "newton"},
    "multigrid, L-BFGS": {"condensation": False, "linear_solver": "multigrid", "method": "lbfgs"},
}
# Time limit of the other configurations: TIME_LIMIT_RATIO times the default's time, or
# MIN_TIME_LIMIT if that is larger, plus MIN_TIME_LIMIT (s).
TIME_LIMIT_RATIO, MIN_TIME_LIMIT = 4.0, 30.0
DEFAULT_TIME_LIMIT = 1500.0  # time limit of the default (s)


@dataclass(frozen=True)
class Scene:
    """Parameters of a random problem.

    Attributes:
        cell: Cell type.
        graded: Whether cells are larger away from the contact.
        degree: Polynomial degree of the displacement.
        dofs: Approximate number of dofs.
        bodies: Number of blocks.
        height: Height of a block, whose width is 1.
        generous: Whether Γc of the ball is the whole top face.
        friction: Coefficient μ.
        linear: Whether the bulk is linear elastic.
        steps: Number of increments.
        ranks: Number of ranks.
    """

    cell: str
    graded: bool
    degree: int
    dofs: int
    bodies: int
    height: float
    generous: bool
    friction: float
    linear: bool
    steps: int
    ranks: int


def draw(seed: int, fewest: float = 1e3, most: float = 2e5) -> Scene:
    """Draw a scene from a seed."""
    rng = np.random.default_rng(seed)
    plane = rng.uniform() < 0.4
    cells = ("triangle", "quadrilateral") if plane else ("tetrahedron", "hexahedron")
    return Scene(
        cell=cells[int(rng.integers(2))],
        graded=bool(rng.uniform() < 0.6),
        degree=int(rng.choice([1, 1, 2])),
        dofs=int(fewest * (most / fewest) ** rng.uniform()),
        bodies=int(rng.choice([1, 1, 1, 2, 2, 3, 5])),
        height=float(np.round(rng.uniform(0.3, 1.0), 2)),
        generous=bool(rng.uniform() < 0.5),
        friction=float(rng.choice([0.0, 0.2, 0.5])),
        linear=bool(rng.uniform() < 0.8),
        steps=int(rng.choice([1, 1, 3, 10, 30])),
        ranks=int(rng.choice([1, 1, 1, 2])),
    )


# ---- the problem ---------------------------------------------------------------------------------


def block(scene: Scene, number: int, dofs: float) -> tuple[dolfinx.mesh.Mesh, Any, Any]:
    """Mesh a block whose top is at z = -number · height, and tag its sides. Collective."""
    d = 2 if scene.cell in ("triangle", "quadrilateral") else 3
    high = -number * scene.height
    low = np.array([-0.5] * (d - 1) + [high - scene.height])
    size = np.array([1.0] * (d - 1) + [scene.height])
    h = scene.degree * (scene.height / (dofs / d)) ** (1 / d)  # if all cells are equal
    simplices = scene.cell in ("triangle", "tetrahedron")
    if simplices and scene.graded:
        mesh = _by_gmsh(low, size, h)
    else:
        counts = [max(2, round(s / h)) for s in size]
        make = dolfinx.mesh.create_rectangle if d == 2 else dolfinx.mesh.create_box
        mesh = make(COMM, [low, low + size], counts, CellType[scene.cell])
        if scene.graded:  # refine towards the middle of the top
            x = mesh.geometry.x
            x[:, : d - 1] = 0.5 * np.sign(x[:, : d - 1]) * np.abs(2 * x[:, : d - 1]) ** 1.7
            below = np.abs(high - x[:, d - 1]) / scene.height  # x may exceed high by round-off
            x[:, d - 1] = high - scene.height * below**1.7
    reach = np.inf if scene.generous or number else 1.5 * (HALF_WIDTH + h)
    where = {
        SIDE: lambda x: np.isclose(x[0], -0.5),
        BASE: lambda x: np.isclose(x[d - 1], high - scene.height),
        TOP: lambda x: np.isclose(x[d - 1], high) & (np.hypot(x[0], x[1] * (d > 2)) < reach),
    }
    return mesh, None, tag_by_nodes(mesh, where)


def _by_gmsh(low: np.ndarray, size: np.ndarray, h: float) -> dolfinx.mesh.Mesh:
    """Mesh a block by simplices of 0.4 h at the middle of the top to 2.4 h. Collective."""
    d = len(low)
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 0)
        if COMM.rank == 0:
            occ = gmsh.model.occ
            if d == 2:
                body = occ.addRectangle(*low, 0.0, *size)
            else:
                body = occ.addBox(*low, *size)
            occ.synchronize()
            gmsh.model.addPhysicalGroup(d, [body], 1)
            top = np.append(np.zeros(d - 1), low[-1] + size[-1])

            def length(_d: int, _t: int, x: float, y: float, z: float, _l: float) -> float:
                away = np.linalg.norm(np.array([x, y, z])[:d] - top)
                return float(h * np.clip(0.4 + 2.0 * (away - HALF_WIDTH), 0.4, 2.4))

            gmsh.model.mesh.setSizeCallback(length)
            gmsh.model.mesh.generate(d)
        return fc.model_to_mesh(gmsh.model, COMM, gdim=d)[0]
    finally:
        gmsh.finalize()


@dataclass(frozen=True)
class MeshedScene:
    """Mesh, displacement, Dirichlet conditions and loads of a scene, created by `mesh_scene`."""

    u: fem.Function
    joined: fc.JoinedMesh
    bcs: list[fem.DirichletBC]
    indentation: fem.Constant
    sliding: fem.Constant


def mesh_scene(scene: Scene, dofs: float) -> MeshedScene:
    """Create meshes and conditions of a scene, which is not timed. Collective."""
    joined = fc.join_meshes([block(scene, n, dofs / scene.bodies) for n in range(scene.bodies)])
    u = fem.Function(displacement_space(joined.mesh, scene.degree))
    d, last = len(u), scene.bodies - 1
    bcs = [dirichlet_bc(u, joined.facets, joined.facet(last, BASE), i) for i in range(d)]
    for body in range(last):  # friction need not constrain them
        bcs += [dirichlet_bc(u, joined.facets, joined.facet(body, SIDE), i) for i in range(d - 1)]
    indentation, sliding = (fem.Constant(joined.mesh, 0.0) for _ in range(2))
    return MeshedScene(u, joined, bcs, indentation, sliding)


def solve(scene: Scene, made: MeshedScene, options: dict[str, Any]) -> tuple[float, int]:
    """Solve all increments; return normal force on the ball and iterations. Collective."""
    u, joined, mesh = made.u, made.joined, made.joined.mesh
    d = len(u)
    v = ufl.TestFunction(u.function_space)
    kind = "plane strain" if d == 2 else "3D"
    body = LinearElastic(u, E, NU, kind) if scene.linear else NeoHookean(u, E, NU, kind)
    moved = ufl.as_vector([made.sliding, *[0.0] * (d - 2), made.indentation])
    ball = fc.Ball((0.0,) * (d - 1) + (RADIUS,), RADIUS, displacement=moved)
    law = fc.Coulomb(scene.friction) if scene.friction else fc.Frictionless()
    contacts = [
        fc.Contact(u, fc.ContactSurface(mesh, joined.facets, joined.facet(0, TOP)), ball, law)
    ]
    for n in range(1, scene.bodies):
        surface = fc.ContactSurface(mesh, joined.facets, joined.facet(n, TOP))
        other = fc.DeformableBody(joined.facets, joined.facet(n - 1, BASE))
        contacts.append(fc.Contact(u, surface, other, law, name=f"joint {n}"))
    # UFL's estimated degree takes up to 95 times as long for rubber (`bulk_quadrature.py`).
    dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": 2 * scene.degree + 1})
    problem = fc.ContactProblem(
        body.residual(v, dx=dx), u, bcs=made.bcs, contacts=contacts, **options
    )

    def load(t: float) -> None:
        made.indentation.value = -DEPTH * min(1.0, 2.0 * t)
        made.sliding.value = 0.2 * DEPTH * max(0.0, 2.0 * t - 1.0)

    steps = fc.increments(problem, load, steps=scene.steps)
    iterations = sum(step.iterations for step in steps)
    return float(contacts[0].resultants().normal_force), iterations


# ---- one configuration in a new process ----------------------------------------------------------


def run_in_process(scene: Scene, configuration: str) -> None:
    """Solve with one configuration, and print its row as JSON on rank 0."""
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore")
    row: dict[str, Any] = {"outcome": "solved"}
    start, before = time.perf_counter(), _process_memory("VmRSS")
    try:
        solve(
            scene, mesh_scene(replace(scene, generous=True), 300.0), CONFIGURATIONS[configuration]
        )  # compiles the forms
        made = mesh_scene(scene, float(scene.dofs))
        row["dofs"] = n_dofs(made.u.function_space)
        COMM.Barrier()
        start, before = time.perf_counter(), _process_memory("VmRSS")
        row["force"], row["iterations"] = solve(scene, made, CONFIGURATIONS[configuration])
    except fc.NotConverged:
        row["outcome"] = "refused"
    except ValueError as error:
        row["outcome"], row["why"] = "not taken", str(error)[:80]
    row["seconds"] = COMM.allreduce(time.perf_counter() - start, op=MPI.MAX)
    row["GiB"] = COMM.allreduce(_process_memory("VmHWM") - before)
    if COMM.rank == 0:
        print(json.dumps(row))


def _process_memory(name: str) -> float:
    """Return the present (VmRSS) or the peak memory (VmHWM) of this process (GiB)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(name)).split()[1]) / 2**20


def run(scene: Scene, seed: int, configuration: str, limit: float) -> timing.Row:
    """Run a configuration in a new process, which is terminated after ``limit`` (s)."""
    words = ["-m", "benchmarks.selection", "--child", configuration, json.dumps(asdict(scene))]
    try:
        row = run_json(scene.ranks, *words, seconds=limit)
    except subprocess.TimeoutExpired:
        row = {"outcome": "slow", "seconds": limit}
    except subprocess.CalledProcessError:
        row = {"outcome": "failed"}
    return {"seed": seed, "configuration": configuration} | row


# ---- evaluation ----------------------------------------------------------------------------------


def compare_with_fastest(rows: list[timing.Row]) -> list[timing.Row]:
    """Compare the default with the fastest other configuration of every scene."""
    table = []
    for seed in dict.fromkeys(row["seed"] for row in rows):
        mine = {row["configuration"]: row for row in rows if row["seed"] == seed}
        solved = {
            configuration: row for configuration, row in mine.items() if row["outcome"] == "solved"
        }
        default = solved.get(DEFAULT)
        if default is None or len(solved) < 2:
            outcome = mine[DEFAULT]["outcome"]
            table.append({"seed": seed, "default": outcome, "solved by": ", ".join(solved)})
            continue
        others = {
            configuration: row for configuration, row in solved.items() if configuration != DEFAULT
        }
        best = min(others, key=lambda configuration: float(others[configuration]["seconds"]))
        quick = [r for r in solved.values() if r["seconds"] <= 1.25 * others[best]["seconds"]]
        least = min(float(row["GiB"]) for row in quick)
        table.append(
            {
                "seed": seed,
                "dofs": default["dofs"],
                "default [s]": default["seconds"],
                "best": best,
                "best [s]": others[best]["seconds"],
                "time ratio": default["seconds"] / others[best]["seconds"],
                "GiB": default["GiB"],
                "memory ratio": default["GiB"] / max(least, 0.02),
            }
        )
    return table


def main() -> None:
    """Run the benchmark and write its results."""
    parser = timing.parser(__doc__, "selection")
    parser.add_argument("--scenes", type=int, default=60)
    parser.add_argument("--start", type=int, default=0, help="first seed")
    parser.add_argument("--most", type=float, default=2e5, help="largest number of dofs, about")
    parser.add_argument("--child", nargs=2, help="for the processes inside")
    arguments = parser.parse_args()
    if arguments.child:
        configuration, drawn = arguments.child
        return run_in_process(Scene(**json.loads(drawn)), configuration)
    scenes, most = (4, 3e3) if arguments.short else (arguments.scenes, arguments.most)
    rows: list[timing.Row] = []
    for seed in range(arguments.start, arguments.start + scenes):
        scene = draw(seed, most=most)
        print(seed, scene, flush=True)
        limit = DEFAULT_TIME_LIMIT
        for configuration in CONFIGURATIONS:
            row = run(scene, seed, configuration, limit)
            print(
                "   ",
                configuration,
                {k: v for k, v in row.items() if k not in ("seed", "configuration")},
                flush=True,
            )
            rows.append(row | asdict(scene) | {"dofs": row.get("dofs", scene.dofs)})
            if configuration == DEFAULT:
                limit = (
                    max(MIN_TIME_LIMIT, TIME_LIMIT_RATIO * row.get("seconds", DEFAULT_TIME_LIMIT))
                    + MIN_TIME_LIMIT
                )
        arguments.output.mkdir(parents=True, exist_ok=True)
        report.save(arguments.output / "selection.csv", rows)  # after every scene
    title = "The default against the fastest configuration"
    timing.write(arguments.output, "regret", title, compare_with_fastest(rows))


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    np.seterr(all="ignore")
    main()
