"""Fretting: two pressed cylinders under cyclic shear, and the energy dissipated by friction.

The cylinders of ``two_cylinders.py``: R = 8 mm, E = 200 MPa, ν = 0.3, plane strain, μ = 0.2, both
deformable, pressed by P = 10 N/mm. The shear force is then 0 → Q → -Q → Q, with Q = 0.7 μP: the
contact slips at its ends only.

    python demos/fretting.py
    python demos/fretting.py --share 0.5 --increments 20
    mpirun -n 2 python demos/fretting.py

Reference: Cattaneo and Mindlin for first loading by the force q, with c = a √(1 - q/(μP)),

    t(x; q) = μ p₀ [√(1 - x²/a²) - c/a √(1 - x²/c²)]    (the second term inside c alone),

and Masing's rule for unloading: from Q to q the traction is t(x; Q) - 2 t(x; (Q - q)/2), and the
displacement follows the loading curve scaled by two. In the plane this curve depends on the bodies
only by a term that is linear in q,

    δ(q) = C q + (μP/πE*) (1 - s) ln(1 - s),    s = q/(μP),    1/E* = 2(1 - ν²)/E.

The elastic compliance C is taken from the computed amplitude; the energy per cycle is independent
of it:

    W = 8 (μP)²/(πE*) [ s (1 - s) ln(1 - s)/2 - ∫₀ˢ (1 - t) ln(1 - t) dt ].

W is computed twice: as the area of the loop, by the trapezoidal rule, and as the work of
friction at the points of the contact, |τ| times the slip. The exit code is 1 if either differs from
W by more than 1 %, if the loop does not close to 1e-4 of its width, or if the residual shear in the
centre at q = 0 in unloading differs from its reference by more than 3 %.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from tqdm import tqdm
from two_cylinders import FRICTION, NU, PEAK, A, E, P, Pressed, R, press

import fenics_contact as fc
from fenics_contact import output, plotting

LIMIT = FRICTION * P
E_STAR = E / (2 * (1 - NU**2))
ENERGY, SHEAR, CLOSURE = 0.01, 0.03, 1e-4


def loading(x: np.ndarray, force: float) -> np.ndarray:
    """Return the shear traction of first loading by ``force``."""
    c = A * np.sqrt(1 - force / LIMIT)
    full = np.sqrt(np.maximum(0, 1 - (x / A) ** 2))
    return FRICTION * PEAK * (full - c / A * np.sqrt(np.maximum(0, 1 - (x / c) ** 2)))


def residual_shear(x: np.ndarray, force: float) -> np.ndarray:
    """Return the residual shear traction after unloading from ``force`` to zero."""
    return loading(x, force) - 2 * loading(x, force / 2)


def nonlinear_displacement(force: np.ndarray) -> np.ndarray:
    """Return the nonlinear part of the displacement in first loading by ``force``."""
    s = force / LIMIT
    return LIMIT / (np.pi * E_STAR) * (1 - s) * np.log(1 - s)


def energy(force: float) -> float:
    """Return the energy per cycle between ±``force``, per length of the cylinders."""
    r = 1 - force / LIMIT
    area = (1 - r) * r * np.log(r) / 2 + 1 / 4 + r**2 / 2 * np.log(r) - r**2 / 4
    return 8 * LIMIT**2 / (np.pi * E_STAR) * area


def solve(arguments: argparse.Namespace) -> tuple[Pressed, dict[str, Any]]:
    """Press, apply cyclic shear, and compare with the references. Collective."""
    start = time.perf_counter()
    scene = press(arguments.cells, arguments.degree, arguments.stiffness)
    contact, comm = scene.contact, MPI.COMM_WORLD
    amplitude, steps = arguments.share * LIMIT, arguments.increments
    origin = comm.allreduce(fem.assemble_scalar(scene.deflection))
    before = contact.gather()["slip"]
    rows = [{"force": 0.0, "displacement": 0.0, "work": 0.0, "iterations": 0}]
    left: dict[str, np.ndarray] = {}
    # A reversal has two phases, so that an increment ends at zero force.
    turns = np.array([0, 1, 0, -1, 0, 1]) * amplitude / (2 * R)
    bar = tqdm(total=5 * steps, disable=None if comm.rank == 0 else True, unit="increment")
    for phase, (first, last) in enumerate(itertools.pairwise(turns)):
        for step in fc.increments(scene.problem, scene.shear, first, last, steps=steps):
            points = contact.gather()
            friction_force = (
                np.linalg.norm(points["tangential_traction"], axis=1) * points["measure"]
            )
            moved = comm.allreduce(fem.assemble_scalar(scene.deflection)) - origin
            row = {"force": 2 * R * float(scene.shear.value), "displacement": moved}
            work = float(friction_force @ (points["slip"] - before))
            rows.append(row | {"work": work, "iterations": step.iterations})
            before = points["slip"]
            bar.update()
        if phase == 1:
            left = points
    bar.close()

    force, moved, work, _ = (np.array([row[k] for row in rows]) for k in rows[0])
    cycle = slice(steps, None)  # from the first reversal
    area = float(np.trapezoid(force[cycle], moved[cycle]))
    top, bottom = moved[steps], moved[3 * steps]
    shear = -left["tangential_traction"][:, 0]
    kept = left["status"] != fc.Status.OPEN
    values = {
        "loop area [mJ/mm]": area,
        "dissipated energy [mJ/mm]": float(work[steps + 1 :].sum()),
        "closing error of the loop / width": abs(moved[-1] - top) / (top - bottom),
        "residual shear traction at q = 0, centre [MPa]": float(
            np.interp(0, left["x"][kept, 0], shear[kept])
        ),
    }
    exact, centre = energy(amplitude), float(residual_shear(np.zeros(1), amplitude)[0])
    expected = ((exact, ENERGY), (exact, ENERGY), (0.0, CLOSURE), (centre, SHEAR))
    references = dict(zip(values, expected, strict=True))
    result = {
        "references": output.compare(values, references),
        "rows": rows,
        "left": {"x": left["x"][kept, 0].tolist(), "shear": shear[kept].tolist()},
        "amplitude": amplitude,
        "dofs": contact.u.function_space.dofmap.index_map.size_global * 2,
        "wall_seconds": time.perf_counter() - start,
    }
    return scene, result


def draw(path: Path, result: dict[str, Any]) -> None:
    """Plot the loop and the residual shear with the theory. On this rank."""
    force, moved = (np.array([r[k] for r in result["rows"]]) for k in ("force", "displacement"))
    most, steps = result["amplitude"], (len(force) - 1) // 5
    # The elastic displacement of a fully sticking contact is subtracted to show the loop.
    stuck = (moved[steps] - nonlinear_displacement(np.array(most))) / most - 1 / (np.pi * E_STAR)
    q = np.linspace(0, most, 200)
    first = nonlinear_displacement(q) + q / (np.pi * E_STAR)
    swing = 2 * first  # displacement between reversals, at twice the force
    with plotting.figure(path, 2) as (left, right):
        left.plot(1e3 * first, q, "k--", linewidth=1, label="Mindlin, Masing")
        left.plot(1e3 * (first[-1] - swing), most - 2 * q, "k--", linewidth=1)
        left.plot(1e3 * (swing - first[-1]), 2 * q - most, "k--", linewidth=1)
        beyond = 1e3 * (moved - stuck * force)
        left.plot(beyond, force, "o", color="#1f5fa8", markersize=4, label="computed")
        title = f"Fretting loop, Q = {most / LIMIT:g} μP, W = {1e3 * energy(most):.3f} µJ/mm"
        left.set(xlabel="displacement by slip [µm]", ylabel="shear force [N/mm]", title=title)
        left.legend(loc="upper left")
        x = np.linspace(-A, A, 801)
        right.plot(x, residual_shear(x, most), "k--", linewidth=1, label="Mindlin")
        right.plot(
            result["left"]["x"],
            result["left"]["shear"],
            ".",
            color="#c8502a",
            label="computed",
        )
        right.set(xlabel="x [mm]", ylabel="shear traction [MPa]", title="Shear left at q = 0")
        right.legend(loc="lower center")
        for axes in (left, right):
            axes.grid(alpha=0.25)


def main() -> int:
    """Run the demo; return 0 if every reference is met."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--share", type=float, default=0.7, help="amplitude Q over μP, below 1")
    parser.add_argument("--cells", type=int, default=20, help="cells per half-width a")
    parser.add_argument("--degree", type=int, default=2, help="degree of the displacement")
    parser.add_argument("--increments", type=int, default=8, help="increments from 0 to Q")
    parser.add_argument("--stiffness", type=float, default=10, help="contact stiffness over E/h")
    parser.add_argument("--output", type=Path, default=Path("output/fretting"), help="folder")
    arguments, _ = parser.parse_known_args()
    if not 0 < arguments.share < 1:
        parser.error("--share must lie between 0 and 1: beyond, the cylinders slide off")
    scene, result = solve(arguments)
    comm, folder = MPI.COMM_WORLD, arguments.output
    fc.Writer(folder, scene.problem, stress=scene.body.stress).write(scene.problem.increment)
    output.write_json(folder / "result.json", result, comm)
    if comm.rank == 0:
        draw(folder / "loop.png", result)
        print(f"{result['dofs']} dofs, {len(result['rows']) - 1} increments, ", end="")
        print(f"{result['wall_seconds']:.2f} s")
        print(output.table(result["references"]))
    return 0 if all(e["passed"] for e in result["references"].values()) else 1


if __name__ == "__main__":
    sys.exit(main())
