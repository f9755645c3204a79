"""What becomes of scenes at the extremes: solved and verified, or refused with a reason.

python verification/extremes.py
python verification/extremes.py --only increments facets
python verification/extremes.py --only stiffness --output /tmp/extremes.md

The scenes are those of ``extreme_scenes.py``, ``extreme_finite.py`` and ``extreme_bodies.py``, by
both direct methods with all that takes over where they fail. Writes docs/extremes.md and a CSV;
of some groups alone their rows into these, where the others stay. The exit code is 1 if anything is
wrong: an error above its tolerance, a number that is none, or an end that is neither a
verified solution nor an error that says why.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import fenics_contact as fc
from scenes.processes import ROOT
from verification import extreme_bodies as bodies
from verification import extreme_finite as finite
from verification.extreme_scenes import (
    E,
    Solve,
    cycle,
    dragged,
    dragged_pair,
    graded_to,
    hertz,
    in_units,
    loaded,
    on_one_rank,
    pair_in_units,
    poisson,
    pressed,
    pressed_pair,
    proportional,
)

PAGE = ROOT / "docs" / "extremes.md"
METHODS = ("lbfgs", "newton")


@dataclass
class Row:
    """One scene by one method.

    Attributes:
        group: What is extreme.
        case: How much.
        method: The method asked for.
        outcome: "verified", or "refused:" and the error.
        attempts: What was tried and its iterations.
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
    attempts: str
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


@dataclass
class Trial:
    """A scene to be solved by each method: steps, and the error, None if nothing is compared.

    ``slow``: it takes more than 20 s or so.
    """

    group: str
    case: str
    solve: Solve
    reference: str = ""
    tolerance: float = 1e-6
    methods: tuple[str, ...] = METHODS
    slow: bool = False

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
                tried = tuple(attempt for step in steps for attempt in step.attempts)
            except (fc.NotConverged, ValueError) as caught:
                outcome = f"refused: {caught}"
                tried = getattr(caught, "attempts", ())
            except Exception as caught:  # what is seen here is to be mended
                outcome = f"{type(caught).__name__}: {caught}"
            names = list(dict.fromkeys(attempt.method for attempt in tried))
            sums = [(n, sum(r.iterations for r in tried if r.method == n)) for n in names]
            iterations = sum(n for _, n in sums)
            attempts = ", ".join(f"{name} {n}" if name != "cut" else "cut" for name, n in sums)
            seconds = time.perf_counter() - start
            yield Row(
                self.group,
                self.case,
                method,
                " ".join(outcome.split()),
                attempts,
                iterations,
                error,
                reference,
                self.tolerance,
                seconds,
            )


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
        meshes = {"place": graded_to(ratio), "n": (32, 8)}
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
    yield from in_space()
    yield from two_bodies()
    yield from against_hertz()
    yield from one_rank_alone()
    yield from finite_kinematics()
    yield from finite_bodies()


def one_rank_alone() -> Iterator[Trial]:
    """Γc on one of several ranks, in processes of their own."""
    for ranks in (2, 3):
        for kind, k, mu in (("cushion", 10.0, 0.3), ("pair", 1e5, 0.0)):
            case = f"{ranks} ranks, {kind}, k_n h/E = {k:g}, μ = {mu:g}"
            yield Trial(
                "Γc on one rank only",
                case,
                on_one_rank(ranks, kind, k, mu),
                "the same on one rank",
                1e-5,
                METHODS if kind == "cushion" else ("newton",),  # L-BFGS takes hundreds of steps
            )


def in_space() -> Iterator[Trial]:
    """Blocks of bricks on floors and on a ball."""
    few, some = (2, 2, 2), (4, 4, 4)
    for k in (1e-3, 1.0, 1e3, 1e6, 1e8):
        name = "3D, stiffness k_n h/E, patch"
        yield Trial(name, f"{k:.0e}", pressed(k, n=few), "uniform compression, exact")
    other = "the alternation's solution"
    for mu in (0.0, 0.3):
        for k in (1e-3, 1e-1, 1e1, 1e2, 1e3, 1e4, 1e6, 1e8):
            name = f"3D, stiffness k_n h/E, ball, μ = {mu:g}"
            # Stiffer friction is beyond the alternation; the state changes by some 1e-6.
            kept = 1e6 if mu and k > 1e6 else k
            reference = other if kept == k else f"{other} for {kept:.0e}"
            yield Trial(name, f"{k:.0e}", dragged(k, mu, known=kept, n=some), reference, 1e-5)
    for mu in (0.01, 1.0, 10.0):
        yield Trial("3D, friction μ", f"{mu:g}", dragged(10, mu, n=some), other, 1e-5)
    for nu, degree in ((0.4999, 1), (0.3, 2), (0.499, 2), (0.4999, 2)):
        fine = "force of bricks of half the size, degree 2"
        tolerance = np.inf if degree == 1 else 0.05
        name, case = "3D, Poisson's ratio ν", f"{nu:g}, degree {degree}"
        yield Trial(name, case, poisson(nu, degree, 3), fine, tolerance)
    same = "units N–mm; same iterations"
    for modulus in (1e-6, 1e15):
        yield Trial("3D, units", f"E {modulus:.0e}", in_units(modulus, 1.0, some), same, 1e-9)
    for length in (1e-9, 1e6):
        yield Trial("3D, units", f"length {length:.0e}", in_units(E, length, some), same, 1e-9)
    free = loaded(0.1, -1.0, 0.3, "free", some)
    yield Trial("3D, free bodies", "held by friction", free, "the load")
    yield Trial("3D, free bodies", "pushed beyond friction", loaded(0.5, -1.0, 0.3, "free", some))


def two_bodies() -> Iterator[Trial]:
    """One block on another, both elastic."""
    exact, other = "uniform compression, exact", "the alternation's solution"
    for k in (1e-3, 1.0, 1e3, 1e6, 1e8):
        yield Trial("two bodies, stiffness k_n h/E, patch", f"{k:.0e}", pressed_pair(k), exact)
    for mu in (0.0, 0.3):
        for k in (1e-3, 1e-1, 1e1, 1e2, 1e3, 1e4, 1e6, 1e8):
            name = f"two bodies, stiffness k_n h/E, round, μ = {mu:g}"
            yield Trial(name, f"{k:.0e}", dragged_pair(k, mu), other, 1e-5)
    for contrast in (1e-6, 1e-3, 1e3, 1e6):
        name, case = "two bodies, stiffness of one over that of the other", f"{contrast:.0e}"
        yield Trial(name, f"{case}, patch", pressed_pair(10, contrast=contrast), exact)
        round_ = dragged_pair(10, 0.3, contrast=contrast)
        yield Trial(name, f"{case}, round", round_, other, 1e-5)
    for gap in (1e-9, 1e-3, 1.0, 10.0, 1000.0):
        name = "two bodies, gap, in body lengths"
        yield Trial(name, f"{gap:g}", pressed_pair(10, gap=gap), exact)
    same = "units N–mm; same iterations"
    for modulus, length in ((1e-6, 1.0), (1e15, 1.0), (E, 1e-9), (E, 1e6)):
        case = f"E {modulus:.0e}" if modulus != E else f"length {length:.0e}"
        units = in_units(modulus, length, scene=pair_in_units)
        yield Trial("two bodies, units", case, units, same, 1e-9)


def against_hertz() -> Iterator[Trial]:
    """A roller on a half-plane: to 1 % for the mesh, and to what the springs predict."""
    name = "peak pressure of a roller, k_n h/E"
    for k in [10.0**i for i in range(-3, 9)]:
        solve, share = hertz(k)
        peak = "Hertz, 1 % + ε" if k > 0.1 else "springs alone, 1 % + 1/ε"
        yield Trial(name, f"{k:.0e}", solve, peak, 0.01 + share)
    solve, _ = hertz(10.0, enforcement="augmented")
    yield Trial(name, "1e+01, multipliers", solve, "Hertz, 1 %", 0.01)


def finite_kinematics() -> Iterator[Trial]:
    """Obstacles that move and turn by any amount, linear bodies and rubber."""
    alone = ("newton",)  # of rubber
    moment, again = "moment of friction at all points, exact", "the tractions before"
    name = "finite kinematics, a disc turned, in increments"
    full = 2 * np.pi
    for angle, steps in ((full, 1), (full, 4), (full, 36), (100 * full, 1000)):
        case = f"{angle / full * 360:.0f}° in {steps}"
        long = steps == 1000
        trial = Trial(name, case, finite.drum(angle, steps), moment, 1e-9, alone, slow=long)
        yield trial
    for mu in (1.0, 2.0):
        case = f"360° in 12, μ = {mu:g}"
        yield Trial(name, case, finite.drum(full, 12, mu), moment, 1e-9, alone)
    linear = finite.drum(full, 12, linear=True)
    yield Trial(name, "360° in 12, linear body", linear, moment, 1e-9)
    for steps in (4, 12, 36):
        case = f"body and disc, 360° in {steps}"
        yield Trial(name, case, finite.turned_with_all(steps), again, 1e-7, alone)
    name = "finite kinematics, facets slid over"
    for n, steps in ((1000, 10), (4000, 40)):
        solve, slow = finite.over_facets(2 * n, steps, 6.0), n > 1000
        case = f"{n} of a plane, in {steps}"
        yield Trial(name, case, solve, "a half-space", 1e-7, alone, slow)
    for n, steps in ((1000, 12), (1000, 100)):
        case = f"{n} of a drum, half round in {steps}"
        solve = finite.over_drum(2 * n, steps, np.pi)
        yield Trial(name, case, solve, "a round one", 1e-2, alone, steps == 100)
    name = "finite kinematics, a block dragged off the end of a plate"
    for mu, steps in ((0.0, 10), (0.0, 40), (0.3, 10), (0.3, 40), (1.0, 40)):
        reference = "no force, and the first force, back" if mu == 0 else "no force"
        case = f"μ = {mu:g}, in {steps}"
        yield Trial(name, case, finite.off_the_edge(mu, steps), reference, 1e-7)
    name = "finite kinematics, a column of rubber, to 60 % of its height"
    exact = "uniform stretches by bisection"
    for k in [10.0**i for i in range(-3, 7)]:
        yield Trial(name, f"k_n h/E = {k:.0e}", finite.column(k), exact, 1e-6, alone)
    for share in (0.3, 0.1):
        case = f"{100 * share:.0f} %, in one increment"
        yield Trial(name, case, finite.column(10, share), exact, 1e-6, alone)
    yield Trial(name, "in 200", finite.column(10, steps=200), exact, 1e-6, alone, True)
    yield Trial(name, "from 1000 heights away", finite.column(10, gap=1e3), exact, 1e-6, alone)
    second = "the second solution of the random scenes"
    for mu in (0.0, 0.3, 1.0):
        name = f"finite kinematics, a disc pressed in, dragged and turned, k_n h/E, μ = {mu:g}"
        for k in [10.0**i for i in (range(-3, 7) if mu == 0.3 else range(-3, 7, 3))]:
            solve = finite.rubbed(k, mu)
            yield Trial(name, f"{k:.0e}, rubber", solve, second, 1e-5, alone, k > 1e2)
        for k in (1e-1, 1e1, 1e3):
            solve, methods = finite.rubbed(k, mu, "linear"), METHODS if k < 1e3 else alone
            yield Trial(name, f"{k:.0e}, linear body", solve, second, 1e-5, methods)
    name = "finite kinematics, first touch from afar, in body heights"
    for gap in (0.01, 1.0, 1000.0):
        near = "from where it touches"
        yield Trial(name, f"{gap:g}", finite.from_afar(gap), near, 1e-7, alone)
        yield Trial(
            name, f"{gap:g}, by force", finite.from_afar(gap, True), "the load", 1e-7, alone
        )
    name = "finite kinematics, increments"
    for steps in (1, 2, 5, 200):
        case = f"pressed in without friction in {steps}"
        trial = Trial(name, case, finite.pressed_in(steps), "16 of them", 1e-9, alone, steps == 200)
        yield trial
    for steps in (1, 10, 200):
        case = f"a disc turned by 90° in {steps}"
        yield Trial(name, case, finite.drum(full / 4, steps), moment, 1e-9, alone, steps == 200)


# How unlike two bodies are: meshes by the width of facets, and moduli.
_UNLIKE = {
    "alike": {},
    "Γc 20 times as fine": {"n": (2, 20)},
    "Γc 20 times as coarse": {"n": (80, 2)},
    "lower 1e3 times as stiff": {"moduli": (1e3 * E, E)},
    "lower 1e6 times as stiff": {"moduli": (1e6 * E, E)},
    "upper 1e6 times as stiff": {"moduli": (E, 1e6 * E)},
}


def finite_bodies() -> Iterator[Trial]:
    """Two bodies that deform and slide far, alike and as unlike as can be."""
    alone, start = ("newton",), "two bodies, finite kinematics, "
    name, again = start + "both turned by 360°, in increments", "the tractions before"
    for steps in (4, 12, 36):
        yield Trial(name, f"{steps}, μ = 0.3", bodies.turned_with_all(steps), again, 1e-6, alone)
    for mu, (case, unlike) in ((m, u) for m in (0.3, 1.0) for u in list(_UNLIKE.items())[m < 1 :]):
        solve = bodies.turned_with_all(36, mu, **unlike)
        yield Trial(name, f"36, μ = {mu:g}, {case}", solve, again, 1e-6, alone)
    name, before = start + "facets slid over", "the force whole facets before"
    for n, steps, mu, wide in (
        (200, 10, 0.0, 12),
        (200, 40, 0.3, 12),
        (1000, 20, 0.0, 50),
        (1000, 20, 0.3, 50),
        (1000, 10, 0.3, 12),
    ):
        case = f"{n * 11 // 20} in {steps}, {20 * wide / n:.2g} of Γc on each, μ = {mu:g}"
        solve = bodies.over_facets(n, steps, mu, wide)
        yield Trial(name, case, solve, before, 1e-4, alone, n == 1000)
    name = start + "dragged off the end, in increments"
    for mu, steps in ((0.0, 10), (0.3, 10), (0.3, 40), (1.0, 40)):
        reference = "no force, and the first force, back" if mu == 0 else "no force"
        solve = bodies.off_the_edge(mu, steps)
        yield Trial(name, f"{steps}, μ = {mu:g}", solve, reference, 1e-7, alone)
    for case, unlike in list(_UNLIKE.items())[1:]:
        solve = bodies.off_the_edge(0.3, 10, **unlike)
        yield Trial(name, f"10, μ = 0.3, {case}", solve, "no force", 1e-7, alone)
    name, nothing = start + "lifted off after a drag, μ", "no force, no strain"
    for mu in (0.0, 0.3, 1.0):
        yield Trial(name, f"{mu:g}", bodies.lifted(mu), nothing, 1e-9, alone)
    for case, unlike in list(_UNLIKE.items())[1:]:
        yield Trial(name, f"0.3, {case}", bodies.lifted(0.3, **unlike), nothing, 1e-9, alone)
    yield from _columns_of_two(start, alone)
    yield from _against_others(start, alone)


def _columns_of_two(start: str, alone: tuple[str, ...]) -> Iterator[Trial]:
    """Uniform stretches."""
    name, exact = start + "columns of rubber, to 60 % of their height", "exact, by bisection"
    fine, coarse = {"n": (1, 20)}, {"n": (20, 1)}
    for k in [10.0**i for i in range(-3, 7)]:
        yield Trial(name, f"k_n h/E = {k:.0e}", bodies.column(k), exact, 1e-6, alone)
    for k in (1e-3, 10.0, 1e6):
        solve = bodies.column(k, **fine)
        yield Trial(name, f"k_n h/E = {k:.0e}, Γc 20 times as fine", solve, exact, 1e-6, alone)
    for points in (2, 40, 80):
        solve = bodies.column(10, points=points, **coarse)
        # Its points are all that the opposite's facets, kinks between them, have for integrals.
        case = f"k_n h/E = 1e+01, Γc 20 times as coarse, {points} points a facet"
        yield Trial(name, case, solve, exact, 2 / points, alone)
    for ratio in (1e-6, 1e-3, 1e3, 1e6):
        for k in (1e-3, 10.0, 1e6):
            solve = bodies.column(k, moduli=(E, ratio * E) if ratio > 1 else (E / ratio, E))
            case = f"k_n h/E = {k:.0e}, sides held, upper {ratio:.0e} times as stiff"
            yield Trial(name, case, solve, exact, 1e-6, alone)
    for share in (0.3, 0.1):
        case = f"{100 * share:.0f} %, in one increment"
        yield Trial(name, case, bodies.column(10, share), exact, 1e-6, alone)
    yield Trial(name, "in 200", bodies.column(10, steps=200), exact, 1e-6, alone)
    yield Trial(name, "from 1000 heights away", bodies.column(10, gap=1e3), exact, 1e-6, alone)
    away = bodies.column(10, gap=1e3, cuts=14)
    yield Trial(name, "from 1000 heights away, cut 14 times", away, exact, 1e-6, alone)


def _against_others(start: str, alone: tuple[str, ...]) -> Iterator[Trial]:
    """Other routes to the same forces."""
    second = "the second solution of the random scenes"
    for mu in (0.0, 0.3, 1.0):
        name = start + f"a block pressed, dragged and rocked, k_n h/E, μ = {mu:g}"
        for k in [10.0**i for i in (range(-3, 7) if mu == 0.3 else range(-3, 7, 3))]:
            case, solve = f"{k:.0e}, rubber", bodies.rubbed(k, mu)
            yield Trial(name, case, solve, second, 1e-5, alone, k > 1e5)
        for k in (1e-1, 1e1, 1e3):
            solve = bodies.rubbed(k, mu, "linear")
            yield Trial(name, f"{k:.0e}, linear bodies", solve, second, 1e-5, alone)
        for case, unlike in (
            ("Γc 20 times as fine", {"n": (1, 8)}),
            ("Γc, below, 20 times as fine", {"n": (50, 1), "own": bodies.LOWER}),
            ("Γc 20 times as coarse", {"n": (50, 1)}),
            ("Γc, below, 20 times as coarse", {"n": (1, 8), "own": bodies.LOWER}),
            ("lower 1e3 times as stiff", {"moduli": (1e3 * E, E)}),
            ("lower 1e6 times as stiff", {"moduli": (1e6 * E, E)}),
            ("upper 1e6 times as stiff", {"moduli": (E, 1e6 * E)}),
        ):
            solve = bodies.rubbed(10, mu, **unlike)
            yield Trial(name, f"1e+01, rubber, {case}", solve, second, 1e-5, alone)
    name = start + "under a plate, so many times as stiff, against a rigid one"
    for ratio in (1e3, 1e6):
        for mu, k, n in (
            (0.0, 1e1, (8, 4)),
            (0.0, 1e3, (8, 4)),
            (0.3, 1e1, (8, 4)),
            (0.3, 1e3, (8, 4)),
            (0.3, 1e1, (20, 2)),
            (0.3, 1e1, (1, 40)),
            (1.0, 1e1, (8, 4)),
        ):
            case = f"{ratio:.0e}, μ = {mu:g}, k_n h/E = {k:.0e}, {n[0]} facets under {n[1]}"
            # Γc looks along its own normals, turned by what springs give way.
            tolerance = 1 / ratio + 0.01 / k
            solve = bodies.like_rigid(ratio, mu, n, k)
            yield Trial(name, case, solve, "a half-space", tolerance, alone)
    name = start + "first touch from afar, in body heights"
    for gap in (0.01, 1.0, 1000.0):
        near = "from where it touches"
        yield Trial(name, f"{gap:g}", bodies.from_afar(gap), near, 1e-7, alone)
        below = bodies.from_afar(gap, own=bodies.LOWER)
        yield Trial(name, f"{gap:g}, Γc below", below, near, 1e-7, alone)
        pushed = bodies.from_afar(gap, True)
        yield Trial(name, f"{gap:g}, by force", pushed, "the load", 1e-7, alone)
    name = start + "increments"
    for steps in (1, 2, 5, 200):
        solve = bodies.pressed_in(steps)
        case = f"pressed in without friction in {steps}"
        yield Trial(name, case, solve, "16 of them", 1e-9, alone)
    for case, unlike in list(_UNLIKE.items())[1:]:
        solve = bodies.pressed_in(1, **unlike)
        # Of the stiffer body forces have a round-off of 1e-16 of its modulus.
        tolerance = max(1e-9, 1e-13 * max(unlike.get("moduli", (E,))) / E)
        yield Trial(name, f"pressed in in 1, {case}", solve, "16 of them", tolerance, alone)


# ---- the page ------------------------------------------------------------------------------------


def page(rows: list[Row]) -> str:
    """The table in Markdown."""
    verified = sum(row.outcome == "verified" for row in rows)
    wrong = [row for row in rows if row.wrong]
    lines = [
        "# The extremes",
        "",
        "Written by `python verification/extremes.py`: a block on a floor or a round cushion, in "
        "the plane or in space, one block on another, a roller on a half-plane; with finite "
        "kinematics a block of rubber under a rigid tool or on another one; E = 1000, cold, in one "
        "increment where nothing else is said. A solution is *verified* when it "
        "passed the package's own checks; its error is that of the displacement (or force) "
        "against the reference, relative. Behind every attempt its iterations; “cut” is a halved "
        "increment.",
        "",
        f"**{len(rows)} runs: {verified} verified, {len(rows) - verified - len(wrong)} refused "
        f"with a reason, {len(wrong)} wrong.**",
        "",
    ]
    head = ["case", "method", "outcome", "attempts", "error", "tolerance", "reference"]
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
            row.attempts,
            ("–" if np.isnan(row.error) else f"{row.error:.1e}") if compared else "",
            f"{row.tolerance:.0e}" if compared and np.isfinite(row.tolerance) else "",
            row.reference if compared else "",
        ]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def known(path: Path) -> dict[tuple[str, str, str], Row]:
    """Rows of a table written before, by group, case and method."""
    with open(path, newline="") as file:
        rows = list(csv.reader(file))[1:]
    made = [Row(*r[:5], int(r[5]), float(r[6]), r[7], float(r[8]), float(r[9])) for r in rows]
    return {(row.group, row.case, row.method): row for row in made}


def main() -> int:
    """Run and write; 0 if nothing is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", metavar="WORD", help="groups with one of these words")
    parser.add_argument("--output", type=Path, help="page to write, a .csv beside it")
    arguments = parser.parse_args()
    words = [word.lower() for word in arguments.only or [""]]
    path = arguments.output or PAGE
    kept = known(path.with_suffix(".csv")) if arguments.only and not arguments.output else {}
    rows: list[Row] = []
    for trial in trials():
        if not any(word in trial.group.lower() for word in words):
            rows += [
                kept[key] for m in trial.methods if (key := (trial.group, trial.case, m)) in kept
            ]
            continue
        for row in trial.run():
            rows.append(row)
            mark = "WRONG " if row.wrong else ""
            print(
                f"{mark}{row.group}; {row.case}; {row.method}: {row.outcome[:150]}; "
                f"{row.attempts}; error {row.error:.1e}; {row.seconds:.1f} s",
                flush=True,
            )
    path.write_text(page(rows))
    with open(path.with_suffix(".csv"), "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*vars(rows[0])])
        writer.writerows([*vars(row).values()] for row in rows)
    return int(any(row.wrong for row in rows))


if __name__ == "__main__":
    sys.exit(main())
