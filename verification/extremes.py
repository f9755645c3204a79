"""What becomes of scenes at the extremes: solved and verified, or refused with a reason.

python verification/extremes.py
python verification/extremes.py --only stiffness --output /tmp/extremes.md

A block is pressed on a floor, or on a round cushion and dragged along it, cold, in one increment
where nothing else is said, by both direct methods with all that takes over where they fail. Writes
docs/extremes.md and a CSV. The exit code is 1 if anything is wrong: an error above its tolerance, a
number that is none, or an end that is neither a verified solution nor an error that says why.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dolfinx
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc

PAGE = Path(__file__).resolve().parent.parent / "docs" / "extremes.md"
METHODS = ("lbfgs", "newton")
BOTTOM, TOP, LEFT = 1, 2, 3
E, NU, PRESSURE = 1000.0, 0.3, 1.0
Array = np.ndarray


class Block:
    """A rectangle (0, a) × (0, b), its bottom Γc, plane strain."""

    def __init__(
        self,
        degree: int = 1,
        *,
        n: tuple[int, int] = (8, 8),
        size: tuple[float, float] = (1.0, 1.0),
        modulus: float = E,
        nu: float = NU,
        place: Callable[[Array], Array] | None = None,
        cell: str = "quadrilateral",
    ) -> None:
        """Mesh it; ``place`` moves the nodes (2, n) of the unit square before they are scaled."""
        kind = dolfinx.mesh.CellType[cell]
        self.mesh = mesh = dolfinx.mesh.create_unit_square(MPI.COMM_WORLD, *n, kind)
        if place is not None:
            mesh.geometry.x[:, :2] = place(mesh.geometry.x[:, :2].T).T
        sides = ((BOTTOM, 1, 0.0), (TOP, 1, 1.0), (LEFT, 0, 0.0))
        found = [
            dolfinx.mesh.locate_entities_boundary(
                mesh, 1, lambda x, i=i, at=at: np.abs(x[i] - at) < 1e-12
            )
            for _, i, at in sides
        ]
        facets = np.concatenate(found)
        values = np.repeat(np.array([s[0] for s in sides], np.int32), [len(f) for f in found])
        order = np.argsort(facets)
        self.tags = dolfinx.mesh.meshtags(mesh, 1, facets[order], values[order])
        mesh.geometry.x[:, :2] *= size
        self.size, self.modulus, self.nu = size, modulus, nu
        self.V = fem.functionspace(mesh, ("Lagrange", degree, (2,)))
        self.u, v = fem.Function(self.V), ufl.TestFunction(self.V)
        self.traction = fem.Constant(mesh, np.zeros(2))
        body = fc.elasticity.LinearElastic(self.u, modulus, nu, "plane strain")
        ds = ufl.ds(mesh, subdomain_data=self.tags)
        self.F = body.residual(v) - ufl.dot(self.traction, v) * ds(TOP)
        self.surface = fc.ContactSurface(mesh, self.tags, BOTTOM)

    def hold(self, tag: int, component: int, value: Any = 0.0) -> fem.DirichletBC:
        """Prescribe a component on a side."""
        if not isinstance(value, fem.Constant):
            value = fem.Constant(self.mesh, float(value))
        space = self.V.sub(component)
        dofs = fem.locate_dofs_topological(space, 1, self.tags.find(tag))
        return fem.dirichletbc(value, dofs, space)

    def problem(
        self, law: Any, support: Any, bcs: list[fem.DirichletBC], **options: Any
    ) -> fc.ContactProblem:
        """The problem with one contact."""
        self.contact = fc.Contact(self.u, self.surface, support, law)
        return fc.ContactProblem(self.F, self.u, bcs=bcs, contacts=[self.contact], **options)

    def floor(self, gap: float = 0.0) -> fc.HalfSpace:
        """A floor below the bottom."""
        return fc.HalfSpace((0.0, -gap), (0.0, 1.0))

    def cushion(self) -> fc.Cylinder:
        """A cylinder of twice the block's width that touches the middle of its bottom."""
        a = self.size[0]
        return fc.Cylinder((0.5 * a, -2.0 * a), 2.0 * a)

    def compressed(self, k_n: float, gap: float = 0.0, pressure: float = PRESSURE) -> float:
        """Error of the displacement under a uniform pressure, sides free, relative to its size.

        σ_y = -p alone, u_y = -gap - p/k_n - (1 - ν²) p y/E, u_x = ν (1 + ν) p x/E.
        """
        exact = fem.Function(self.V)
        p, nu = pressure / self.modulus, self.nu
        exact.interpolate(
            lambda x: np.vstack(
                [nu * (1 + nu) * p * x[0], -gap - pressure / k_n - (1 - nu**2) * p * x[1]]
            )
        )
        return difference(self.u, exact)


def difference(f: fem.Function, g: fem.Function) -> float:
    """Largest difference of two functions, relative to the second. Collective."""
    comm = f.function_space.mesh.comm
    n = f.function_space.dofmap.index_map.size_local * f.function_space.dofmap.bs
    both = [float(np.abs(x).max(initial=0.0)) for x in ((f.x.array - g.x.array)[:n], g.x.array[:n])]
    error, size = comm.allreduce(np.array(both), op=MPI.MAX)
    return error / size if size else error


@dataclass
class Row:
    """One scene by one method.

    Attributes:
        group: What is extreme.
        case: How much.
        method: The method asked for.
        outcome: "verified", or "refused:" and the error.
        rungs: What was tried and its iterations.
        iterations: SNES iterations of all increments.
        error: Against the reference, relative; NaN where nothing is compared.
        reference: What it was compared with.
        tolerance: Largest error that passes.
        seconds: Wall time.
    """

    group: str
    case: str
    method: str
    outcome: str
    rungs: str
    iterations: int
    error: float
    reference: str
    tolerance: float
    seconds: float

    @property
    def wrong(self) -> bool:
        """Whether this is what must never be."""
        if self.outcome == "verified":
            return bool(self.reference) and not self.error <= self.tolerance
        return not self.outcome.startswith("refused: ")


Solve = Callable[[str], tuple[list[fc.problem.Step], float | None]]


@dataclass
class Trial:
    """A scene to be solved by each method: steps, and the error, None if nothing is compared."""

    group: str
    case: str
    solve: Solve
    reference: str = ""
    tolerance: float = 1e-6
    methods: tuple[str, ...] = METHODS

    def run(self) -> Iterator[Row]:
        """Solve by every method."""
        for method in self.methods:
            start = time.perf_counter()
            tried: tuple[Any, ...] = ()
            iterations, error, reference = 0, float("nan"), self.reference
            try:
                steps, found = self.solve(method)
                error, reference = (error, "") if found is None else (found, reference)
                outcome = "verified"
                if any(step.verdict.failures or step.reason <= 0 for step in steps):
                    outcome = "NOT VERIFIED"
                tried = tuple(rung for step in steps for rung in step.rungs)
            except (fc.NotConverged, ValueError) as caught:
                outcome = f"refused: {caught}"
                tried = getattr(caught, "rungs", ())
            except Exception as caught:  # what is seen here is to be mended
                outcome = f"{type(caught).__name__}: {caught}"
            names = list(dict.fromkeys(rung.method for rung in tried))
            sums = [(n, sum(r.iterations for r in tried if r.method == n)) for n in names]
            iterations = sum(n for _, n in sums)
            rungs = ", ".join(f"{name} {n}" if name != "cut" else "cut" for name, n in sums)
            seconds = time.perf_counter() - start
            yield Row(
                self.group,
                self.case,
                method,
                " ".join(outcome.split()),
                rungs,
                iterations,
                error,
                reference,
                self.tolerance,
                seconds,
            )


# ---- scenes --------------------------------------------------------------------------------------


def friction_law(mu: float, k_n: Any, k_t: Any = None) -> Any:
    """Coulomb's law, or none without friction."""
    return fc.Coulomb(mu, k_n, k_n if k_t is None else k_t) if mu else fc.Frictionless(k_n)


def pressed(
    kappa: float,
    mu: float = 0.0,
    *,
    gap: float = 0.0,
    held: bool = True,
    load: float = 1.0,
    history: int = 1,
    **block: Any,
) -> Solve:
    """A block pressed on a floor by a uniform load; held aside unless by friction alone."""

    def solve(method: str) -> tuple[list[fc.problem.Step], float]:
        body = Block(**block)
        h = body.size[1] / block.get("n", (8, 8))[1]
        k_n = kappa * body.modulus / h
        # A load in proportion to the modulus strains the block alike in all units.
        p = PRESSURE * load * body.modulus / E
        bcs = [body.hold(LEFT, 0)] if held else []
        problem = body.problem(friction_law(mu, k_n), body.floor(gap), bcs, method=method)

        def apply(t: float) -> None:
            body.traction.value[1] = -p * t

        steps = list(fc.increments(problem, apply, steps=history))
        return steps, body.compressed(k_n, gap, p) if mu == 0.0 else abs(
            steps[-1].contacts["contact"].normal_force / (p * body.size[0]) - 1
        )

    return solve


def dragged(
    kappa: float,
    mu: float,
    *,
    ratio: float = 1.0,
    down: float = 0.03,
    aside: float = 0.02,
    against: str = "alternating",
    **block: Any,
) -> Solve:
    """The block's top moved down on the cushion and aside; error of u against another method's."""

    def state(method: str, **options: Any) -> tuple[list[fc.problem.Step], Block]:
        body = Block(**block)
        length = body.size[0]
        bcs = [body.hold(TOP, 0, aside * length), body.hold(TOP, 1, -down * length)]
        law = friction_law(mu, fc.Scaled(kappa), fc.Scaled(kappa * ratio))
        problem = body.problem(law, body.cushion(), bcs, method=method, **options)
        return [problem.solve()], body

    def solve(method: str) -> tuple[list[fc.problem.Step], float | None]:
        steps, body = state(method)
        try:
            _, other = state(against, fallback=False)
        except fc.NotConverged:
            return steps, None
        return steps, difference(body.u, other.u)

    return solve


def in_units(modulus: float, length: float) -> Solve:
    """The dragged block in other units: the iterations and digits of the first ones."""

    def state(method: str, modulus: float, length: float) -> tuple[fc.problem.Step, Array]:
        body = Block(modulus=modulus, size=(length, length))
        bcs = [body.hold(TOP, 0, 0.02 * length), body.hold(TOP, 1, -0.03 * length)]
        problem = body.problem(fc.Coulomb(0.3), body.cushion(), bcs, method=method)
        return problem.solve(), body.u.x.array / length

    def solve(method: str) -> tuple[list[fc.problem.Step], float]:
        step, u = state(method, modulus, length)
        first, v = state(method, E, 1.0)
        same = step.iterations == first.iterations
        return [step], float(np.abs(u - v).max() / np.abs(v).max()) if same else np.inf

    return solve


def poisson(nu: float, degree: int) -> Solve:
    """The force of the pressed cushion against that of cubic elements on a mesh twice as fine."""

    def force(method: str, degree: int, n: int) -> fc.problem.Step:
        body = Block(degree, n=(n, n), nu=nu, cell="triangle")
        bcs = [body.hold(TOP, 0), body.hold(TOP, 1, -0.03)]
        return body.problem(fc.Frictionless(), body.cushion(), bcs, method=method).solve()

    def solve(method: str) -> tuple[list[fc.problem.Step], float]:
        step, fine = force(method, degree, 16), force("newton", 3, 32)
        ours, theirs = (s.contacts["contact"].normal_force for s in (step, fine))
        return [step], abs(ours / theirs - 1)

    return solve


def proportional(steps: int) -> Solve:
    """Load aside and down in proportion, no gap: any number of increments has one state."""

    def state(method: str, steps: int) -> tuple[list[fc.problem.Step], Block]:
        body = Block(n=(4, 4))
        problem = body.problem(fc.Coulomb(0.5), body.floor(), [], method=method)

        def load(t: float) -> None:
            body.traction.value[:] = 0.2 * t, -1.0 * t

        return list(fc.increments(problem, load, steps=steps)), body

    def solve(method: str) -> tuple[list[fc.problem.Step], float]:
        made, body = state(method, steps)
        _, once = state(method, 1)
        return made, difference(body.u, once.u)

    return solve


def cycle(path: list[tuple[float, float]], mu: float = 0.3) -> Solve:
    """The top led along (aside, down), and back down to the first place, without friction's trace.

    Reference: the force at the first place, found again after the last.
    """

    def solve(method: str) -> tuple[list[fc.problem.Step], float]:
        body = Block()
        move = [fem.Constant(body.mesh, 0.0) for _ in range(2)]
        bcs = [body.hold(TOP, i, c) for i, c in enumerate(move)]
        problem = body.problem(friction_law(mu, fc.Scaled(10)), body.floor(), bcs, method=method)
        steps = []
        for aside, down in [path[0], *path, path[0]]:
            move[0].value, move[1].value = aside, -down
            steps.append(problem.solve())
            problem.commit()
        forces = [step.contacts["contact"].normal_force for step in (steps[0], steps[-1])]
        opened = [s for s, (_, down) in zip(steps[1:], path, strict=False) if down < 0]
        if any(s.contacts["contact"].normal_force != 0.0 for s in opened):
            return steps, float("inf")
        return steps, abs(forces[1] / forces[0] - 1) if forces[0] else abs(forces[1])

    return solve


def loaded(side: float, up: float, mu: float, bcs: str) -> Solve:
    """A load on a block on its floor, with what holds it; the force is that of the load."""

    def solve(method: str) -> tuple[list[fc.problem.Step], float]:
        body = Block()
        held = {"free": [], "sides": [body.hold(LEFT, 0)]}[bcs]
        problem = body.problem(friction_law(mu, fc.Scaled(10)), body.floor(), held, method=method)
        body.traction.value[:] = side, up
        step = problem.solve()
        force = step.contacts["contact"].force - [0.0 if bcs == "sides" else -side, -up]
        return [step], float(np.abs(force).max() / max(abs(up), abs(side), 1e-300) if up else 0.0)

    return solve


def graded(ratio: float) -> Callable[[Array], Array]:
    """Cells along x whose widths grow by ``ratio`` from the middle of Γc to its ends."""

    def place(x: Array) -> Array:
        s = 2 * x[0] - 1
        growth = np.log(ratio)
        moved = np.sign(s) * np.expm1(growth * np.abs(s)) / np.expm1(growth)
        return np.vstack([0.5 + 0.5 * moved, x[1]])

    return place


def trials() -> Iterator[Trial]:
    """All of them."""
    patch = "uniform compression, exact"
    other = "the alternation's solution"
    stiffnesses = [10.0**i for i in range(-3, 9)]
    for k in stiffnesses:
        yield Trial("stiffness k_n h/E, patch", f"{k:.0e}", pressed(k), patch)
    for mu in (0.0, 0.3):
        for k in stiffnesses:
            name = f"stiffness k_n h/E, cushion, μ = {mu:g}"
            yield Trial(name, f"{k:.0e}", dragged(k, mu), other, 1e-5)
    for ratio in [10.0**i for i in range(-6, 4)]:
        case = f"{ratio:.0e}"
        yield Trial("k_t/k_n, μ = 0.3", case, dragged(10, 0.3, ratio=ratio), other, 1e-5)
    for mu in (0.0, 0.01, 0.1, 0.5, 1.0, 2.0, 5.0, 10.0):
        yield Trial("friction μ", f"{mu:g}", dragged(10, mu), other, 1e-5)
    fine = "force of P3 elements of half the size"
    for degree in (1, 2, 3):
        for nu in (0.0, 0.3, 0.45, 0.49, 0.499, 0.4999):
            # P1 locks: what it gives is the solution of a stiffer body, and reported as it is.
            tolerance = np.inf if degree == 1 else 0.03
            yield Trial(
                "Poisson's ratio ν", f"{nu:g}, P{degree}", poisson(nu, degree), fine, tolerance
            )
    same = "units N–mm; same iterations"
    for modulus in (1e-6, 1e-3, 1.0, 1e6, 1e9, 1e12, 1e15):
        yield Trial("units, E", f"{modulus:.0e}", in_units(modulus, 1.0), same, 1e-9)
    for length in (1e-9, 1e-6, 1e-3, 1e3, 1e6):
        yield Trial("units, length", f"{length:.0e}", in_units(E, length), same, 1e-9)
    for gap in (0.0, 1e-9, 1e-3, 1.0, 10.0, 1000.0):
        yield Trial("gap, in body lengths", f"{gap:g}", pressed(10, gap=gap), patch)
    for steps in (1, 10, 100, 1000):
        yield Trial("increments", f"{steps}", proportional(steps), "one increment")
    back = "the first force, found again"
    down, up = (0.0, 0.01), (0.0, -0.01)
    yield Trial("loads", "reversed aside", cycle([down, (0.02, 0.01), (-0.02, 0.01), up]), back)
    yield Trial("loads", "lifted off", cycle([down, up]), back)
    yield Trial("loads", "first increment without contact", cycle([up, down, up]), back)
    for load in (0.0, 1e-6, 1e3):
        yield Trial("loads", f"{load:g} times", pressed(10, load=load), patch)
    yield Trial("loads", "pulled off", loaded(0.0, 1.0, 0.0, "sides"))
    for down_by in (1e-12, 1e-9, 1e-6, 1e-4, 1e-3):
        first = dragged(10, 0.3, down=down_by, aside=0.0)
        yield Trial("first touch of one node, down by", f"{down_by:g}", first, other, 1e-5)
    force = "the load"
    yield Trial("free bodies", "held by friction", loaded(0.1, -1.0, 0.3, "free"), force)
    yield Trial("free bodies", "pushed beyond friction", loaded(0.5, -1.0, 0.3, "free"))
    yield Trial("free bodies", "no friction", loaded(0.0, -1.0, 0.0, "free"))
    for ratio in (1e1, 1e2, 1e4):
        meshes = {"place": graded(ratio), "n": (32, 8)}
        yield Trial("mesh size ratio", f"{ratio:g}, patch", pressed(10, **meshes), patch)
        yield Trial(
            "mesh size ratio", f"{ratio:g}, cushion", dragged(10, 0.3, **meshes), other, 1e-5
        )
    for aspect in (1e1, 1e2, 1e3):
        wide = {"size": (aspect, 1.0)}
        yield Trial("aspect ratio of cells", f"{aspect:g}", pressed(10, **wide), patch)
        flat = {"size": (1.0, 1 / aspect)}
        yield Trial("aspect ratio of cells", f"1/{aspect:g}", pressed(10, **flat), patch)
    for degree in (1, 2, 3):
        case = f"P{degree}"
        yield Trial("degree", f"{case}, patch", pressed(10, degree=degree), patch)
        yield Trial("degree", f"{case}, cushion", dragged(10, 0.3, degree=degree), other, 1e-5)
    yield Trial("Γc all closed", "μ = 0.3", pressed(10, 0.3), "the load")
    yield Trial("Γc all open", "nothing in reach", cycle([up, up]), back)


# ---- the page ------------------------------------------------------------------------------------


def page(rows: list[Row]) -> str:
    """The table in Markdown."""
    verified = sum(row.outcome == "verified" for row in rows)
    wrong = [row for row in rows if row.wrong]
    lines = [
        "# The extremes",
        "",
        "Written by `python verification/extremes.py`: a block on a floor or a round cushion, "
        "E = 1000, cold, in one increment where nothing else is said. A solution is *verified* "
        "when it passed the package's own checks; its error is that of the displacement (or force) "
        "against the reference, relative. Behind every rung its iterations; “cut” is a halved "
        "increment.",
        "",
        f"**{len(rows)} runs: {verified} verified, {len(rows) - verified - len(wrong)} refused "
        f"with a reason, {len(wrong)} wrong.**",
        "",
    ]
    head = ["case", "method", "outcome", "rungs", "error", "tolerance", "reference"]
    group = ""
    for row in rows:
        if row.group != group:
            group = row.group
            lines += ["", f"## {group}", "", "| " + " | ".join(head) + " |", "|---" * 7 + "|"]
        compared = bool(row.reference) and row.outcome == "verified"
        cells = [
            row.case,
            row.method,
            ("**WRONG** " if row.wrong else "") + row.outcome[:300],
            row.rungs,
            ("–" if np.isnan(row.error) else f"{row.error:.1e}") if compared else "",
            f"{row.tolerance:.0e}" if compared and np.isfinite(row.tolerance) else "",
            row.reference if compared else "",
        ]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def main() -> int:
    """Run and write; 0 if nothing is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", metavar="WORD", help="groups with one of these words")
    parser.add_argument("--output", type=Path, help="page to write, a .csv beside it")
    arguments = parser.parse_args()
    if arguments.only and not arguments.output:
        parser.error("a page of some groups alone wants another --output")
    words = [word.lower() for word in arguments.only or [""]]
    rows: list[Row] = []
    for trial in trials():
        if any(word in trial.group.lower() for word in words):
            for row in trial.run():
                rows.append(row)
                mark = "WRONG " if row.wrong else ""
                print(
                    f"{mark}{row.group}; {row.case}; {row.method}: {row.outcome[:150]}; "
                    f"{row.rungs}; error {row.error:.1e}; {row.seconds:.1f} s",
                    flush=True,
                )
    path = arguments.output or PAGE
    path.write_text(page(rows))
    with open(path.with_suffix(".csv"), "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*vars(rows[0])])
        writer.writerows([*vars(row).values()] for row in rows)
    return int(any(row.wrong for row in rows))


if __name__ == "__main__":
    sys.exit(main())
