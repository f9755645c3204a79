"""A block on an incline: it sticks up to the friction angle, and larger loads are refused.

An elastic block, 60 mm x 20 mm, plane strain, E = 1000 MPa, ν = 0.3, on a rigid plane.

Tilting. The block is loaded by its weight, and the plane is tilted. Only friction constrains the
block tangentially, μ = 0.3. Equilibrium requires

    tan α ≤ μ,    with  T/N = tan α  up to this limit.

Below it parts of the base slip, as the block deforms, but the block does not slide. Above it there
is no equilibrium, and the package refuses the load before the first iteration. The demo bisects the
interval between the steepest accepted slope and the smallest refused one.

Pushing (the sliding wedge, NAFEMS CGS-4). On a slope of tan α = 0.1 the block, of weight G, is
pushed uphill by a horizontal displacement of its lower end, until all of its base slips. Then

    F/G = (tan α + μ) / (1 - μ tan α):  0.1, 0.202020, 0.306122, 0.412371 for μ = 0, 0.1, 0.2, 0.3.

    python demos/incline.py
    python demos/incline.py --cells 60 --friction 0.5
    mpirun -n 2 python demos/incline.py

The exit code is 1 if the refused slope differs from μ, or the ratio T/N from the slope, by more
than 1e-4, or one of the forces F/G from its formula by more than 1e-6; statics is exact.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import dolfinx
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

import fenics_contact as fc
from fenics_contact import output, plotting
from fenics_contact.elasticity import LinearElastic

LENGTH, HEIGHT, E, NU, DENSITY = 60.0, 20.0, 1000.0, 0.3, 0.01  # mm, MPa, N/mm³
BASE, END = 1, 2
WEDGE_SLOPE, WEDGE_FRICTIONS = 0.1, (0.0, 0.1, 0.2, 0.3)
STATICS, SLIDING = 1e-4, 1e-6


class Block:
    """The block on a plane through the origin with the slope ``slope``, ascending along x."""

    def __init__(self, arguments: argparse.Namespace, slope: float, friction: float) -> None:
        """Create mesh, elasticity and contact. Collective."""
        cells = (arguments.cells, max(2, arguments.cells // 3))
        self.mesh = dolfinx.mesh.create_rectangle(MPI.COMM_WORLD, [(0, 0), (LENGTH, HEIGHT)], cells)
        on = {BASE: lambda x: np.isclose(x[1], 0), END: lambda x: np.isclose(x[0], 0)}
        found = [
            dolfinx.mesh.locate_entities_boundary(self.mesh, 1, where) for where in on.values()
        ]
        facets, marks = np.concatenate(found), np.repeat(np.int32(list(on)), [*map(len, found)])
        order = np.argsort(facets)
        self.tags = dolfinx.mesh.meshtags(self.mesh, 1, facets[order], marks[order])
        angle = np.arctan(slope)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        self.mesh.geometry.x[:, :2] = self.mesh.geometry.x[:, :2] @ turn.T

        V = fem.functionspace(self.mesh, ("Lagrange", arguments.degree, (2,)))
        self.u, v = fem.Function(V, name="displacement"), ufl.TestFunction(V)
        self.body = LinearElastic(self.u, E, NU, "plane strain")
        self.tilt = fem.Constant(self.mesh, PETSc.ScalarType(0.0))
        self.weight = fem.Constant(self.mesh, PETSc.ScalarType(0.0))
        gravity = self.weight * ufl.as_vector([ufl.sin(self.tilt), -ufl.cos(self.tilt)])
        self.F = self.body.residual(v) - ufl.dot(gravity, v) * ufl.dx
        surface = fc.ContactSurface(self.mesh, self.tags, BASE)
        floor = fc.HalfSpace(point=(0, 0), normal=(-np.sin(angle), np.cos(angle)))
        law = fc.Coulomb(friction) if friction else fc.Frictionless()
        self.contact = fc.Contact(self.u, surface, floor, law)

    def slipping(self) -> float:
        """Return the slipping fraction of the area of the base. Collective."""
        points = self.contact.gather()
        slip = points["measure"] @ (points["status"] == fc.Status.SLIP)
        return float(slip / points["measure"].sum())


def tilt(arguments: argparse.Namespace) -> dict[str, Any]:
    """Tilt the plane until the load is refused, and bisect the interval. Collective."""
    friction = arguments.friction
    block = Block(arguments, 0.0, friction)
    problem = fc.ContactProblem(block.F, block.u, contacts=[block.contact])
    list(fc.increments(problem, block.weight, 0.0, DENSITY))
    rows, holds, refused, message = [], 0.0, np.inf, ""
    steps = [0.25, 0.5, 0.75, 0.9, 0.95, 0.99]
    while refused - holds > STATICS:
        # First the given steps and a value above the limit, then bisection.
        share = steps.pop(0) if steps else 1.013 if refused > 2 else (holds + refused) / 2
        present = float(block.tilt.value)
        try:
            list(fc.increments(problem, block.tilt, present, np.arctan(share * friction)))
        except fc.NotConverged:
            raise
        except ValueError as error:
            refused, message = share, str(error)
            continue
        holds = share
        along, across = block.contact.resultants().force
        row = {"slope": share * friction, "T/N": float(-along / across)}
        rows.append(row | {"slip": block.slipping()})
    return {
        "friction": friction,
        "rows": rows,
        "limit": friction * (holds + refused) / 2,
        "ratio_error": max(abs(row["T/N"] / row["slope"] - 1) for row in rows),
        "message": message,
    }


def push(
    arguments: argparse.Namespace, friction: float
) -> tuple[fc.ContactProblem, Block, dict[str, Any]]:
    """Push the block uphill by a displacement of its lower end. Collective."""
    block = Block(arguments, WEDGE_SLOPE, friction)
    V = block.u.function_space
    pushed = fem.Constant(block.mesh, PETSc.ScalarType(0.0))
    end = fem.locate_dofs_topological(V.sub(0), 1, block.tags.find(END))
    bcs = [fem.dirichletbc(pushed, end, V.sub(0))]
    problem = fc.ContactProblem(block.F, block.u, bcs=bcs, contacts=[block.contact])
    list(fc.increments(problem, block.weight, 0.0, DENSITY))
    rows = []

    def record() -> None:
        force = block.contact.resultants().force
        row = {"displacement": float(pushed.value), "F/G": float(-force[0] / force[1])}
        rows.append(row | {"slip": block.slipping()})

    record()
    for _ in fc.increments(problem, pushed, 0.0, arguments.push, steps=arguments.increments):
        record()
    return problem, block, {"friction": friction, "rows": rows}


def draw(path: Path, tilted: dict[str, Any], pushed: list[dict[str, Any]]) -> None:
    """Plot T/N and slipping fraction over slope, and F/G over displacement. On this rank."""
    with plotting.figure(path, 2) as (left, right):
        slope, ratio, slip = (
            np.array([row[key] for row in tilted["rows"]]) for key in ("slope", "T/N", "slip")
        )
        limit = tilted["friction"]
        left.plot([0, limit], [0, limit], "k-", linewidth=1, label="T/N = tan α")
        left.plot(slope, ratio, "o", color="#1f5fa8", label="T/N, computed")
        left.axvline(limit, color="#2a8a3a", linestyle="--", label=f"tan α = μ = {limit:g}")
        left.axvspan(tilted["limit"], 1.15 * limit, color="#00000012", label="refused")
        left.set(xlabel="tan α", ylabel="T/N", title="Tilting: the block sticks up to μ")
        left.set(xlim=(0, 1.15 * limit), ylim=(0, 1.15 * limit))
        share = left.twinx()
        share.plot(slope, 100 * slip, "x:", color="#c8502a")
        share.set(ylabel="share of the base that slips [%]", ylim=(0, 115))
        share.yaxis.label.set_color("#c8502a")
        left.legend(loc="upper left")
        for i, run in enumerate(pushed):
            x, y = (1e3 * np.array([r["displacement"] for r in run["rows"]]), run["rows"])
            label = f"computed, μ = {run['friction']:g}"
            right.plot(x, [row["F/G"] for row in y], ".-", color=f"C{i}", label=label)
            exact = sliding(run["friction"])
            right.axhline(exact, color=f"C{i}", linestyle="--", linewidth=1)
        right.plot([], [], "k--", linewidth=1, label="(tan α + μ)/(1 - μ tan α)")
        right.set(xlabel="displacement of the lower end [µm]", ylabel="F/G")
        right.set(title="Pushing uphill, tan α = 0.1")
        right.legend(loc="lower right")
        for axes in (left, right):
            axes.grid(alpha=0.25)


def sliding(friction: float) -> float:
    """Return F/G of a block that slides uphill."""
    return (WEDGE_SLOPE + friction) / (1 - friction * WEDGE_SLOPE)


def main() -> int:
    """Tilt and push; return 0 if the results agree with statics."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--friction", type=float, default=0.3, help="μ of the tilted block")
    parser.add_argument("--cells", type=int, default=24, help="cells along the base")
    parser.add_argument("--degree", type=int, default=2, help="degree of the displacement")
    parser.add_argument("--push", type=float, default=0.01, help="push of the wedge, mm")
    parser.add_argument("--increments", type=int, default=10, help="increments of the push")
    parser.add_argument("--output", type=Path, default=Path("output/incline"), help="folder")
    arguments, _ = parser.parse_known_args()
    start, comm, folder = time.perf_counter(), MPI.COMM_WORLD, arguments.output

    tilted = tilt(arguments)
    values = {
        "slope at the friction limit": tilted["limit"],
        "T/N / tan α, error": tilted["ratio_error"],
    }
    references = {"slope at the friction limit": (arguments.friction, STATICS)}
    references["T/N / tan α, error"] = (0.0, STATICS)
    pushed = []
    for friction in WEDGE_FRICTIONS:
        problem, block, run = push(arguments, friction)
        pushed.append(run)
        name = f"F/G, μ = {friction:g}"
        values[name] = run["rows"][-1]["F/G"]
        references[name] = (sliding(friction), SLIDING)
    fc.Writer(folder, problem, stress=block.body.stress).write(arguments.push)
    title = "Pushed uphill, μ = 0.3"
    contacts = problem.contacts
    plotting.plot_deformation(
        folder / "mesh.png", block.u, title=title, magnification=200, contacts=contacts
    )
    result = {
        "references": output.compare(values, references),
        "tilted": tilted,
        "pushed": pushed,
        "wall_seconds": time.perf_counter() - start,
    }
    output.write_json(folder / "result.json", result, comm)
    if comm.rank == 0:
        draw(folder / "forces.png", tilted, pushed)
        print(f"{'tan α':>10}{'T/N':>10}{'slipping':>10}")
        for row in tilted["rows"]:
            print(f"{row['slope']:10.6f}{row['T/N']:10.6f}{row['slip']:10.1%}")
        print(f"Refused beyond: {tilted['message']}")
        print(output.table(result["references"]))
        print(f"{result['wall_seconds']:.2f} s")
    return 0 if all(e["passed"] for e in result["references"].values()) else 1


if __name__ == "__main__":
    sys.exit(main())
