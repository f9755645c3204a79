"""Solve problems with extreme parameters: each is verified, or refused with a reason.

python verification/extremes.py
python verification/extremes.py --only increments facets
python verification/extremes.py --only k_n --output /tmp/extremes.md
python verification/extremes.py --page

The problems are those of ``extreme_scenes.py``, ``extreme_finite.py`` and ``extreme_bodies.py``.
The script writes docs/extremes.csv, its page and figures; ``--only`` replaces the rows of some
groups, and ``--page`` writes page and figures of the stored rows. The exit code is 1 if a run
fails: if its error exceeds the tolerance or is not finite, or if it ends with neither a verified
solution nor an error that states a reason.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import fenics_contact as fc
from fenics_contact import plotting
from scenes.processes import ROOT
from verification import extreme_bodies as bodies
from verification import extreme_finite as finite
from verification import report
from verification.extreme_scenes import (
    E,
    Solve,
    compare_with_one_rank,
    cycle,
    flat_pair,
    graded_to,
    hertz,
    load_block,
    poisson,
    press_block,
    press_on_disc,
    proportional,
    rounded_pair,
    solve_in_other_units,
    solve_pair_in_units,
)

PAGE = ROOT / "docs" / "extremes.md"
METHODS = ("lbfgs", "newton")


@dataclass
class Row:
    """One problem solved by one method.

    Attributes:
        group: Model and the parameter that is varied.
        case: Value of the parameter.
        method: The method requested.
        outcome: "verified", or "refused: " and the error.
        attempts: Methods tried, with their iterations.
        iterations: SNES iterations of all increments.
        error: Error relative to the reference; NaN if there is no reference.
        reference: Reference of the error; empty if there is none.
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
    def has_failed(self) -> bool:
        """Whether the error is above its tolerance, or the run ended without a reason."""
        if self.outcome == "verified":
            return bool(self.reference) and not self.error <= self.tolerance
        return not self.outcome.startswith("refused: ")

    @property
    def is_compared(self) -> bool:
        """Whether a verified solution has a reference."""
        return bool(self.reference) and self.outcome == "verified"


@dataclass
class Trial:
    """A problem to be solved by each method.

    Attributes:
        group, case, reference, tolerance: As in `Row`.
        solve: Returns the steps and the error, None if there is no reference.
        methods: Methods to use.
        slow: Whether the solution takes more than about 20 s.
    """

    group: str
    case: str
    solve: Solve
    reference: str = ""
    tolerance: float = 1e-6
    methods: tuple[str, ...] = METHODS
    slow: bool = False

    def run(self) -> Iterator[Row]:
        """Solve the problem by every method, and yield the rows."""
        for method in self.methods:
            start = time.perf_counter()
            tried: tuple[Any, ...] = ()
            error, reference = float("nan"), self.reference
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
            except Exception as caught:  # any other exception is a defect
                outcome = f"{type(caught).__name__}: {caught}"
            names = list(dict.fromkeys(attempt.method for attempt in tried))
            sums = [(n, sum(r.iterations for r in tried if r.method == n)) for n in names]
            attempts = ", ".join(f"{name} {n}" if name != "cut" else "halved" for name, n in sums)
            yield Row(
                self.group,
                self.case,
                method,
                " ".join(outcome.split()),
                attempts,
                sum(n for _, n in sums),
                error,
                reference,
                self.tolerance,
                time.perf_counter() - start,
            )


def all_trials() -> Iterator[Trial]:
    """Yield all problems."""
    patch = "uniform compression (exact)"
    other = "method `alternating`"
    stiffnesses = [10.0**i for i in range(-3, 9)]
    for k in stiffnesses:
        yield Trial("block on a plane, k_n h/E", f"{k:.0e}", press_block(k), patch)
    for mu in (0.0, 0.3):
        for k in stiffnesses:
            name = f"block on a disc, μ = {mu:g}, k_n h/E"
            yield Trial(name, f"{k:.0e}", press_on_disc(k, mu), other, 1e-5)
    for ratio in [10.0**i for i in range(-6, 4)]:
        case = f"{ratio:.0e}"
        yield Trial(
            "block on a disc, μ = 0.3, k_t/k_n",
            case,
            press_on_disc(10, 0.3, ratio=ratio),
            other,
            1e-5,
        )
    for mu in (0.0, 0.01, 0.1, 0.5, 1.0, 2.0, 5.0, 10.0):
        yield Trial("block on a disc, μ", f"{mu:g}", press_on_disc(10, mu), other, 1e-5)
    fine = "force, P3, half the mesh size"
    for degree in (1, 2, 3):
        for nu in (0.0, 0.3, 0.45, 0.49, 0.499, 0.4999):
            # P1 elements lock: the error is reported without a tolerance.
            tolerance = np.inf if degree == 1 else 0.03
            yield Trial(
                "block on a disc, ν", f"{nu:g}, P{degree}", poisson(nu, degree), fine, tolerance
            )
    same = "N and mm, equal iterations"
    for modulus in (1e-6, 1e-3, 1.0, 1e6, 1e9, 1e12, 1e15):
        yield Trial(
            "block on a disc, unit of E",
            f"{modulus:.0e}",
            solve_in_other_units(modulus, 1.0),
            same,
            1e-9,
        )
    for length in (1e-9, 1e-6, 1e-3, 1e3, 1e6):
        yield Trial(
            "block on a disc, unit of length",
            f"{length:.0e}",
            solve_in_other_units(E, length),
            same,
            1e-9,
        )
    for gap in (0.0, 1e-9, 1e-3, 1.0, 10.0, 1000.0):
        yield Trial("block on a plane, gap / height", f"{gap:g}", press_block(10, gap=gap), patch)
    for steps in (1, 10, 100, 1000):
        yield Trial(
            "block on a plane, number of increments",
            f"{steps}",
            proportional(steps),
            "one increment",
        )
    back = "force before the cycle"
    down, up = (0.0, 0.01), (0.0, -0.01)
    yield Trial(
        "block on a plane, load path",
        "tangential load reversal",
        cycle([down, (0.02, 0.01), (-0.02, 0.01), up]),
        back,
    )
    yield Trial("block on a plane, load path", "lift-off", cycle([down, up]), back)
    yield Trial(
        "block on a plane, load path",
        "first increment without contact",
        cycle([up, down, up]),
        back,
    )
    for load in (0.0, 1e-6, 1e3):
        yield Trial(
            "block on a plane, load path", f"load × {load:g}", press_block(10, load=load), patch
        )
    yield Trial("block on a plane, load path", "tensile load", load_block(0.0, 1.0, 0.0, "sides"))
    for down_by in (1e-12, 1e-9, 1e-6, 1e-4, 1e-3):
        first = press_on_disc(10, 0.3, depth=down_by, lateral=0.0)
        yield Trial(
            "block on a disc, first contact of one node, approach",
            f"{down_by:g}",
            first,
            other,
            1e-5,
        )
    force = "applied load"
    yield Trial(
        "block without Dirichlet conditions",
        "constrained by friction",
        load_block(0.1, -1.0, 0.3, "free"),
        force,
    )
    yield Trial(
        "block without Dirichlet conditions",
        "load above the friction limit",
        load_block(0.5, -1.0, 0.3, "free"),
    )
    yield Trial(
        "block without Dirichlet conditions", "frictionless", load_block(0.0, -1.0, 0.0, "free")
    )
    for ratio in (1e1, 1e2, 1e4):
        meshes = {"node_map": graded_to(ratio), "n": (32, 8)}
        yield Trial("ratio of cell sizes", f"{ratio:g}, plane", press_block(10, **meshes), patch)
        yield Trial(
            "ratio of cell sizes", f"{ratio:g}, disc", press_on_disc(10, 0.3, **meshes), other, 1e-5
        )
    for aspect in (1e1, 1e2, 1e3):
        wide = {"size": (aspect, 1.0)}
        yield Trial(
            "block on a plane, aspect ratio of cells", f"{aspect:g}", press_block(10, **wide), patch
        )
        flat = {"size": (1.0, 1 / aspect)}
        yield Trial(
            "block on a plane, aspect ratio of cells",
            f"1/{aspect:g}",
            press_block(10, **flat),
            patch,
        )
    for degree in (1, 2, 3):
        case = f"P{degree}"
        yield Trial("polynomial degree", f"{case}, plane", press_block(10, degree=degree), patch)
        yield Trial(
            "polynomial degree", f"{case}, disc", press_on_disc(10, 0.3, degree=degree), other, 1e-5
        )
    yield Trial("all points of Γc closed", "μ = 0.3", press_block(10, 0.3), "applied load")
    yield Trial("all points of Γc open", "lifted block", cycle([up, up]), back)
    yield from trials_3d()
    yield from two_body_trials()
    yield from hertz_trials()
    yield from one_rank_trials()
    yield from finite_kinematics_trials()
    yield from finite_body_trials()


def one_rank_trials() -> Iterator[Trial]:
    """Yield problems with Γc on one of several ranks, in separate processes."""
    for ranks in (2, 3):
        for kind, k, mu in (("disc", 10.0, 0.3), ("two bodies", 1e5, 0.0)):
            case = f"{ranks} ranks, {kind}, k_n h/E = {k:g}, μ = {mu:g}"
            yield Trial(
                "Γc on one rank only",
                case,
                compare_with_one_rank(ranks, kind, k, mu),
                "one rank",
                1e-5,
                METHODS if kind == "disc" else ("newton",),  # L-BFGS needs hundreds of iterations
            )


def trials_3d() -> Iterator[Trial]:
    """Yield blocks of hexahedra on a plane and on a ball."""
    few, some = (2, 2, 2), (4, 4, 4)
    for k in (1e-3, 1.0, 1e3, 1e6, 1e8):
        name = "3D, block on a plane, k_n h/E"
        yield Trial(name, f"{k:.0e}", press_block(k, n=few), "uniform compression (exact)")
    other = "method `alternating`"
    for mu in (0.0, 0.3):
        for k in (1e-3, 1e-1, 1e1, 1e2, 1e3, 1e4, 1e6, 1e8):
            name = f"3D, block on a ball, μ = {mu:g}, k_n h/E"
            # `alternating` fails for stiffer friction; the solution changes by about 1e-6.
            limited = 1e6 if mu and k > 1e6 else k
            reference = other if limited == k else f"{other}, k_n h/E = {limited:.0e}"
            yield Trial(
                name,
                f"{k:.0e}",
                press_on_disc(k, mu, reference_stiffness=limited, n=some),
                reference,
                1e-5,
            )
    for mu in (0.01, 1.0, 10.0):
        yield Trial("3D, block on a ball, μ", f"{mu:g}", press_on_disc(10, mu, n=some), other, 1e-5)
    for nu, degree in ((0.4999, 1), (0.3, 2), (0.499, 2), (0.4999, 2)):
        fine = "force, degree 2, half the mesh size"
        tolerance = np.inf if degree == 1 else 0.05
        name, case = "3D, block on a ball, ν", f"{nu:g}, degree {degree}"
        yield Trial(name, case, poisson(nu, degree, 3), fine, tolerance)
    same = "N and mm, equal iterations"
    for modulus in (1e-6, 1e15):
        yield Trial(
            "3D, units", f"E {modulus:.0e}", solve_in_other_units(modulus, 1.0, some), same, 1e-9
        )
    for length in (1e-9, 1e6):
        yield Trial(
            "3D, units", f"length {length:.0e}", solve_in_other_units(E, length, some), same, 1e-9
        )
    free = load_block(0.1, -1.0, 0.3, "free", some)
    yield Trial(
        "3D, block without Dirichlet conditions", "constrained by friction", free, "applied load"
    )
    yield Trial(
        "3D, block without Dirichlet conditions",
        "load above the friction limit",
        load_block(0.5, -1.0, 0.3, "free", some),
    )


def two_body_trials() -> Iterator[Trial]:
    """Yield problems of two linear elastic blocks."""
    exact, other = "uniform compression (exact)", "method `alternating`"
    for k in (1e-3, 1.0, 1e3, 1e6, 1e8):
        yield Trial("two bodies, flat, k_n h/E", f"{k:.0e}", flat_pair(k), exact)
    for mu in (0.0, 0.3):
        for k in (1e-3, 1e-1, 1e1, 1e2, 1e3, 1e4, 1e6, 1e8):
            name = f"two bodies, rounded, μ = {mu:g}, k_n h/E"
            yield Trial(name, f"{k:.0e}", rounded_pair(k, mu), other, 1e-5)
    for contrast in (1e-6, 1e-3, 1e3, 1e6):
        name, case = "two bodies, ratio of moduli", f"{contrast:.0e}"
        yield Trial(name, f"{case}, flat", flat_pair(10, contrast=contrast), exact)
        round_ = rounded_pair(10, 0.3, contrast=contrast)
        yield Trial(name, f"{case}, rounded", round_, other, 1e-5)
    for gap in (1e-9, 1e-3, 1.0, 10.0, 1000.0):
        name = "two bodies, gap / width"
        yield Trial(name, f"{gap:g}", flat_pair(10, gap=gap), exact)
    same = "N and mm, equal iterations"
    for modulus, length in ((1e-6, 1.0), (1e15, 1.0), (E, 1e-9), (E, 1e6)):
        case = f"E {modulus:.0e}" if modulus != E else f"length {length:.0e}"
        units = solve_in_other_units(modulus, length, scene=solve_pair_in_units)
        yield Trial("two bodies, units", case, units, same, 1e-9)


def hertz_trials() -> Iterator[Trial]:
    """Yield a rigid cylinder on a half-plane; tolerance: 1 % for the mesh, plus penalty error."""
    name = "rigid cylinder on a half-plane, peak pressure, k_n h/E"
    for k in [10.0**i for i in range(-3, 9)]:
        solve, share = hertz(k)
        peak = "Hertz, 1 % + ε" if k > 0.1 else "elastic foundation, 1 % + 1/ε"
        yield Trial(name, f"{k:.0e}", solve, peak, 0.01 + share)
    solve, _ = hertz(10.0, enforcement="augmented")
    yield Trial(name, "1e+01, augmented", solve, "Hertz, 1 %", 0.01)


def finite_kinematics_trials() -> Iterator[Trial]:
    """Yield linear and hyperelastic bodies on moving and rotating obstacles, finite kinematics."""
    alone = ("newton",)
    moment, again = "friction moment at full slip (exact)", "tractions before the rotation"
    name = "finite kinematics, rotating disc, rotation and increments"
    full = 2 * np.pi
    for angle, steps in ((full, 1), (full, 4), (full, 36), (100 * full, 1000)):
        case = f"{angle / full * 360:.0f}° in {steps}"
        long = steps == 1000
        trial = Trial(name, case, finite.rotate_disc(angle, steps), moment, 1e-9, alone, slow=long)
        yield trial
    for mu in (1.0, 2.0):
        case = f"360° in 12, μ = {mu:g}"
        yield Trial(name, case, finite.rotate_disc(full, 12, mu), moment, 1e-9, alone)
    linear = finite.rotate_disc(full, 12, linear=True)
    yield Trial(name, "360° in 12, linear body", linear, moment, 1e-9)
    for steps in (4, 12, 36):
        case = f"body and disc together, 360° in {steps}"
        yield Trial(name, case, finite.rotate_together(steps), again, 1e-7, alone)
    name = "finite kinematics, sliding over facets"
    for n, steps in ((1000, 10), (4000, 40)):
        solve, slow = finite.slide_over_facets(2 * n, steps, 6.0), n > 1000
        case = f"plane of {n} facets, {steps} increments"
        yield Trial(name, case, solve, "`HalfSpace`", 1e-7, alone, slow)
    for n, steps in ((1000, 12), (1000, 100)):
        case = f"drum of {n} facets, 180° in {steps}"
        solve = finite.rotate_drum(2 * n, steps, np.pi)
        yield Trial(name, case, solve, "`Ball`", 1e-2, alone, steps == 100)
    name = "finite kinematics, sliding off the end of a plate"
    for mu, steps in ((0.0, 10), (0.0, 40), (0.3, 10), (0.3, 40), (1.0, 40)):
        reference = "zero force; initial force after return" if mu == 0 else "zero force"
        case = f"μ = {mu:g}, {steps} increments"
        yield Trial(name, case, finite.slide_off(mu, steps), reference, 1e-7)
    name = "finite kinematics, rubber column compressed to 60 %"
    exact = "uniform stretch (exact)"
    for k in [10.0**i for i in range(-3, 7)]:
        yield Trial(name, f"k_n h/E = {k:.0e}", finite.column(k), exact, 1e-6, alone)
    for share in (0.3, 0.1):
        case = f"to {100 * share:.0f} %, one increment"
        yield Trial(name, case, finite.column(10, share), exact, 1e-6, alone)
    yield Trial(name, "200 increments", finite.column(10, steps=200), exact, 1e-6, alone, True)
    yield Trial(name, "gap of 1000 heights", finite.column(10, gap=1e3), exact, 1e-6, alone)
    second = "independent solver"
    for mu in (0.0, 0.3, 1.0):
        name = f"finite kinematics, disc pressed, slid and rotated, μ = {mu:g}, k_n h/E"
        for k in [10.0**i for i in (range(-3, 7) if mu == 0.3 else range(-3, 7, 3))]:
            solve = finite.against_solver(k, mu)
            yield Trial(name, f"{k:.0e}, rubber", solve, second, 1e-5, alone, k > 1e2)
        for k in (1e-1, 1e1, 1e3):
            solve, methods = finite.against_solver(k, mu, "linear"), METHODS if k < 1e3 else alone
            yield Trial(name, f"{k:.0e}, linear body", solve, second, 1e-5, methods)
    name = "finite kinematics, first contact, gap / height"
    for gap in (0.01, 1.0, 1000.0):
        near = "force without the gap"
        yield Trial(name, f"{gap:g}", finite.close_gap(gap), near, 1e-7, alone)
        yield Trial(
            name,
            f"{gap:g}, prescribed force",
            finite.close_gap(gap, True),
            "applied load",
            1e-7,
            alone,
        )
    name = "finite kinematics, number of increments"
    for steps in (1, 2, 5, 200):
        case = f"frictionless indentation in {steps}"
        trial = Trial(name, case, finite.indent(steps), "16 increments", 1e-9, alone, steps == 200)
        yield trial
    for steps in (1, 10, 200):
        case = f"disc rotated by 90° in {steps}"
        yield Trial(
            name, case, finite.rotate_disc(full / 4, steps), moment, 1e-9, alone, steps == 200
        )


# Ratios of mesh size on Γc and of moduli.
_DISSIMILAR = {
    "equal bodies": {},
    "Γc 20 times finer": {"n": (2, 20)},
    "Γc 20 times coarser": {"n": (80, 2)},
    "lower body 1e3 times stiffer": {"moduli": (1e3 * E, E)},
    "lower body 1e6 times stiffer": {"moduli": (1e6 * E, E)},
    "upper body 1e6 times stiffer": {"moduli": (E, 1e6 * E)},
}


def finite_body_trials() -> Iterator[Trial]:
    """Yield finite sliding of two bodies of equal and of very different mesh and modulus."""
    alone, start = ("newton",), "two bodies, finite kinematics, "
    name, again = start + "both rotated by 360°, increments", "tractions before the rotation"
    for steps in (4, 12, 36):
        yield Trial(name, f"{steps}, μ = 0.3", bodies.rotate_together(steps), again, 1e-6, alone)
    for mu, (case, options) in (
        (m, u) for m in (0.3, 1.0) for u in list(_DISSIMILAR.items())[m < 1 :]
    ):
        solve = bodies.rotate_together(36, mu, **options)
        yield Trial(name, f"36, μ = {mu:g}, {case}", solve, again, 1e-6, alone)
    name, before = start + "sliding over facets", "force several facets before"
    for n, steps, mu, wide in (
        (200, 10, 0.0, 12),
        (200, 40, 0.3, 12),
        (1000, 20, 0.0, 50),
        (1000, 20, 0.3, 50),
        (1000, 10, 0.3, 12),
    ):
        case = f"{n * 11 // 20} in {steps}, {20 * wide / n:.2g} slave per master facet, μ = {mu:g}"
        solve = bodies.slide_over_facets(n, steps, mu, wide)
        yield Trial(name, case, solve, before, 1e-4, alone, n == 1000)
    name = start + "sliding off the end, increments"
    for mu, steps in ((0.0, 10), (0.3, 10), (0.3, 40), (1.0, 40)):
        reference = "zero force; initial force after return" if mu == 0 else "zero force"
        solve = bodies.slide_off(mu, steps)
        yield Trial(name, f"{steps}, μ = {mu:g}", solve, reference, 1e-7, alone)
    for case, options in list(_DISSIMILAR.items())[1:]:
        solve = bodies.slide_off(0.3, 10, **options)
        yield Trial(name, f"10, μ = 0.3, {case}", solve, "zero force", 1e-7, alone)
    name, nothing = start + "lift-off after sliding, μ", "zero force and strain"
    for mu in (0.0, 0.3, 1.0):
        yield Trial(name, f"{mu:g}", bodies.lift_off(mu), nothing, 1e-9, alone)
    for case, options in list(_DISSIMILAR.items())[1:]:
        yield Trial(name, f"0.3, {case}", bodies.lift_off(0.3, **options), nothing, 1e-9, alone)
    yield from _column_trials(start, alone)
    yield from _comparison_trials(start, alone)


def _column_trials(start: str, alone: tuple[str, ...]) -> Iterator[Trial]:
    """Yield uniform compression of two columns."""
    name, exact = start + "rubber columns compressed to 60 %", "uniform stretch (exact)"
    fine, coarse = {"n": (1, 20)}, {"n": (20, 1)}
    for k in [10.0**i for i in range(-3, 7)]:
        yield Trial(name, f"k_n h/E = {k:.0e}", bodies.column(k), exact, 1e-6, alone)
    for k in (1e-3, 10.0, 1e6):
        solve = bodies.column(k, **fine)
        yield Trial(name, f"k_n h/E = {k:.0e}, Γc 20 times finer", solve, exact, 1e-6, alone)
    for points in (2, 40, 80):
        solve = bodies.column(10, points=points, **coarse)
        # The integrand is not smooth: one slave facet spans 20 master facets.
        case = f"k_n h/E = 1e+01, Γc 20 times coarser, {points} points per facet"
        yield Trial(name, case, solve, exact, 2 / points, alone)
    for ratio in (1e-6, 1e-3, 1e3, 1e6):
        for k in (1e-3, 10.0, 1e6):
            solve = bodies.column(k, moduli=(E, ratio * E) if ratio > 1 else (E / ratio, E))
            case = f"k_n h/E = {k:.0e}, confined, ratio of moduli {ratio:.0e}"
            yield Trial(name, case, solve, exact, 1e-6, alone)
    for share in (0.3, 0.1):
        case = f"to {100 * share:.0f} %, one increment"
        yield Trial(name, case, bodies.column(10, share), exact, 1e-6, alone)
    yield Trial(name, "200 increments", bodies.column(10, steps=200), exact, 1e-6, alone)
    yield Trial(name, "gap of 1000 heights", bodies.column(10, gap=1e3), exact, 1e-6, alone)
    away = bodies.column(10, gap=1e3, cuts=14)
    yield Trial(name, "gap of 1000 heights, halved up to 14 times", away, exact, 1e-6, alone)


def _comparison_trials(start: str, alone: tuple[str, ...]) -> Iterator[Trial]:
    """Yield comparisons with the independent solver, a rigid plane, and other increments."""
    second = "independent solver"
    for mu in (0.0, 0.3, 1.0):
        name = start + f"block pressed, slid and rotated, μ = {mu:g}, k_n h/E"
        for k in [10.0**i for i in (range(-3, 7) if mu == 0.3 else range(-3, 7, 3))]:
            case, solve = f"{k:.0e}, rubber", bodies.against_solver(k, mu)
            yield Trial(name, case, solve, second, 1e-5, alone, k > 1e5)
        for k in (1e-1, 1e1, 1e3):
            solve = bodies.against_solver(k, mu, "linear")
            yield Trial(name, f"{k:.0e}, linear bodies", solve, second, 1e-5, alone)
        for case, options in (
            ("Γc 20 times finer", {"n": (1, 8)}),
            ("lower body slave, 20 times finer", {"n": (50, 1), "slave_tag": bodies.LOWER}),
            ("Γc 20 times coarser", {"n": (50, 1)}),
            ("lower body slave, 20 times coarser", {"n": (1, 8), "slave_tag": bodies.LOWER}),
            ("lower body 1e3 times stiffer", {"moduli": (1e3 * E, E)}),
            ("lower body 1e6 times stiffer", {"moduli": (1e6 * E, E)}),
            ("upper body 1e6 times stiffer", {"moduli": (E, 1e6 * E)}),
        ):
            solve = bodies.against_solver(10, mu, **options)
            yield Trial(name, f"1e+01, rubber, {case}", solve, second, 1e-5, alone)
    name = start + "stiff plate against a rigid plane, ratio of moduli"
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
            case = f"{ratio:.0e}, μ = {mu:g}, k_n h/E = {k:.0e}, {n[0]} facets on {n[1]}"
            # The slave normals rotate by the elastic deformation and by the penetration.
            tolerance = 1 / ratio + 0.01 / k
            solve = bodies.stiff_plate(ratio, mu, n, k)
            yield Trial(name, case, solve, "`HalfSpace`", tolerance, alone)
    name = start + "first contact, gap / height"
    for gap in (0.01, 1.0, 1000.0):
        near = "force without the gap"
        yield Trial(name, f"{gap:g}", bodies.close_gap(gap), near, 1e-7, alone)
        below = bodies.close_gap(gap, slave_tag=bodies.LOWER)
        yield Trial(name, f"{gap:g}, lower body slave", below, near, 1e-7, alone)
        pushed = bodies.close_gap(gap, True)
        yield Trial(name, f"{gap:g}, prescribed force", pushed, "applied load", 1e-7, alone)
    name = start + "number of increments"
    for steps in (1, 2, 5, 200):
        solve = bodies.indent(steps)
        case = f"frictionless indentation in {steps}"
        yield Trial(name, case, solve, "16 increments", 1e-9, alone)
    for case, options in list(_DISSIMILAR.items())[1:]:
        solve = bodies.indent(1, **options)
        # Round-off of the forces is proportional to the larger modulus.
        tolerance = max(1e-9, 1e-13 * max(options.get("moduli", (E,))) / E)
        yield Trial(
            name, f"frictionless indentation in 1, {case}", solve, "16 increments", tolerance, alone
        )


# ---- page and figures ----------------------------------------------------------------------------


def page(rows: list[Row]) -> str:
    """Return the page in Markdown."""
    verified = sum(row.outcome == "verified" for row in rows)
    failed = [row for row in rows if row.has_failed]
    refused = [row for row in rows if row.outcome.startswith("refused: ")]
    free = [row for row in rows if row.outcome == "verified" and not row.reference]
    locking = max(r.error for r in rows if r.is_compared and not np.isfinite(r.tolerance))
    lines = ["# Extreme parameters", ""]
    lines += report.text(
        f"**{len(rows)} runs: {verified} verified, {len(refused)} refused with a reason, "
        f"{len(failed)} wrong.** A run is wrong if its error exceeds the tolerance, or if it ends "
        "with neither a verified solution nor an error that states a reason.",
        "One parameter at a time is taken to its extremes: contact stiffness k_n h/E from 1e-3 to "
        "1e8, friction coefficients up to 10, Poisson's ratio up to 0.4999, units, gaps of up to "
        "1000 times the height, cells of aspect ratio 1000, ratios of moduli of 1e6, loads that "
        "cannot be balanced. The models are a linear elastic block on a rigid plane, disc or ball, "
        "two blocks, and a rigid cylinder on a half-plane; with finite kinematics, a rubber block "
        "under a rigid tool or on another rubber block. E = 1000 and ν = 0.3, if not varied. Each "
        "load is applied in one increment from the unloaded state, if not stated otherwise.",
        "The error is the relative difference of the displacement, or of the force or traction, "
        "from the reference. Linear bodies are solved by both direct methods, `newton` and "
        "`lbfgs`, with the usual fallbacks; finite kinematics mostly by `newton` alone. All runs, "
        "their references and tolerances are in [extremes.csv](extremes.csv).",
    )
    lines += ["![Errors of all runs and their tolerances, by group](extremes-errors.png)", ""]
    lines += report.text(
        "*Errors of all verified runs that have a reference. Errors below 1e-16 are drawn at "
        "1e-16. Linear elements (P1, hexahedra of degree 1) lock near ν = 0.5, with errors of "
        f"up to {locking:.2g}: these runs have no tolerance.*"
    )
    lines += ["![Effect of the contact stiffness](extremes-stiffness.png)", ""]
    lines += report.text(
        "*Left: SNES iterations of one increment, of all attempts. With μ = 0.3 and k_n h/E of 1e4 "
        "or more Newton's method and L-BFGS mostly fail from the unloaded state, and fallback "
        "methods follow. Right: a penalty ε = E\\*/(k_n a) changes Hertz's peak "
        "pressure by at most ε (contact half-width a); for ε > 1 the contact behaves as an elastic "
        "foundation, whose peak pressure is then the reference. The mesh has ten cells in a; the "
        "tolerance includes 1 % for its error.*"
    )
    lines += ["## Closest to the tolerance", ""]
    near = [r for r in rows if r.is_compared and 0 < r.tolerance < np.inf and r.method == "newton"]
    near.sort(key=lambda r: r.error / r.tolerance, reverse=True)
    lines += report.table(
        ("group", "case", "error", "tolerance", "reference"),
        [(r.group, r.case, f"{r.error:.1e}", f"{r.tolerance:.1e}", r.reference) for r in near[:8]],
    )
    lines += ["## Refused", ""]
    reasons: dict[tuple[str, str, str], list[str]] = {}
    for row in refused + [row for row in failed if row not in refused]:
        reason = row.outcome.removeprefix("refused: ").split(";")[0].split(". ")[0]
        reasons.setdefault((row.group, row.case, reason), []).append(row.method)
    lines += report.table(
        ("group", "case", "method", "error message (first sentence)"),
        [(g, c, ", ".join(methods), reason) for (g, c, reason), methods in reasons.items()],
    )
    lines += report.text(
        "Where one slave facet spans 20 master facets, 2 quadrature points per facet are too few; "
        "with 40 the error is 3.9e-2, with 80 it is 1.5e-2. The gap of 1000 heights is closed if "
        "the increment may be halved 14 times (`max_cuts=14`; 6 by default).",
        "Sliding off an end is refused if the corner of the last facet is deeper than "
        "extrapolated from the surrounding points, all of which are open: use finer facets, or "
        "more points.",
        f"{len(free)} verified runs have no reference, because the method or solver that would "
        "give it fails: " + "; ".join(dict.fromkeys(f"{r.group}: {r.case}" for r in free)) + ".",
    )
    lines += report.text(
        "Written by `python verification/extremes.py`; `--page` writes the page and its figures "
        "from the stored runs."
    )
    return "\n".join(lines).rstrip() + "\n"


def draw_errors(path: Path, rows: list[Row]) -> None:
    """Draw the errors of all runs with a reference, one line per group."""
    compared = [row for row in rows if row.is_compared]
    groups = list(dict.fromkeys(row.group for row in compared))
    with plotting.figure(path, size=(11.0, 0.19 * len(groups) + 1.2)) as axes:
        for method, marker, shift in (("newton", "o", 0.12), ("lbfgs", "x", -0.12)):
            mine = [row for row in compared if row.method == method]
            axes.semilogx(
                [max(row.error, 1e-16) for row in mine],
                [groups.index(row.group) + shift for row in mine],
                marker,
                markersize=3.5,
                alpha=0.7,
                label=method,
            )
        limits = {(row.tolerance, row.group) for row in compared if np.isfinite(row.tolerance)}
        axes.semilogx(
            [limit for limit, _ in limits],
            [groups.index(group) for _, group in limits],
            "k|",
            markersize=9,
            markeredgewidth=1.5,
            label="tolerance",
        )
        axes.set_yticks(range(len(groups)), groups, fontsize=7)
        axes.set(ylim=(len(groups) - 0.4, -0.6), xlim=(5e-17, 20))
        axes.set_xlabel("error relative to the reference")
        axes.grid(alpha=0.25)
        axes.legend(loc="upper right", fontsize=8)


def draw_stiffness(path: Path, rows: list[Row]) -> None:
    """Draw iterations and the error of the peak pressure over the contact stiffness."""
    models = {
        "2D, disc": "block on a disc, μ = 0.3, k_n h/E",
        "3D, ball": "3D, block on a ball, μ = 0.3, k_n h/E",
        "two bodies": "two bodies, rounded, μ = 0.3, k_n h/E",
    }
    with plotting.figure(path, 2, size=(5.6, 4.2)) as (left, right):
        for number, (label, group) in enumerate(models.items()):
            for method, line in (("newton", "o-"), ("lbfgs", "x--")):
                mine = [row for row in rows if (row.group, row.method) == (group, method)]
                left.loglog(
                    [float(row.case) for row in mine],
                    [row.iterations for row in mine],
                    line,
                    color=f"C{number}",
                    markersize=4,
                    label=f"{label}, {method}",
                )
        left.set(title="Iterations, μ = 0.3", xlabel="k_n h/E", ylabel="iterations, all attempts")
        peak = "rigid cylinder on a half-plane, peak pressure, k_n h/E"
        mine = [r for r in rows if r.group == peak and r.method == "newton"]
        for label, marker in (("Hertz", "o"), ("elastic foundation", "s")):
            some = [r for r in mine if r.reference.startswith(label) and "augm" not in r.case]
            at = [float(row.case) for row in some]
            right.loglog(at, [row.error for row in some], marker, label=f"error against {label}")
            right.loglog(at, [row.tolerance for row in some], "k:")
        (augmented,) = [row for row in mine if "augmented" in row.case]
        right.loglog([10.0], [augmented.error], "r*", markersize=10, label="augmented Lagrangian")
        right.plot([], [], "k:", label="1 % + ε, or 1 % + 1/ε (foundation)")
        right.set(title="Peak pressure, rigid cylinder on a half-plane", xlabel="k_n h/E")
        right.set_ylabel("relative error of the peak pressure")
        for axes in (left, right):
            axes.grid(alpha=0.25)
            axes.legend(fontsize=7)


def read_stored_rows(path: Path) -> dict[tuple[str, str, str], Row]:
    """Read stored rows, by group, case and method."""
    rows = [
        Row(
            **row
            | {name: float(row[name]) for name in ("error", "tolerance", "seconds")}
            | {"iterations": int(row["iterations"])}
        )
        for row in report.read(path)
    ]
    return {(row.group, row.case, row.method): row for row in rows}


def main() -> int:
    """Solve the problems and write the results; return 0 if no run has failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", metavar="WORD", help="groups with one of these words")
    parser.add_argument(
        "--output", type=Path, help="page to write; the CSV file is written to the same directory"
    )
    parser.add_argument("--page", action="store_true", help="only write the page of stored runs")
    arguments = parser.parse_args()
    words = [word.lower() for word in arguments.only or [""]]
    path = arguments.output or PAGE
    rows: list[Row] = []
    if arguments.page:
        rows += read_stored_rows(path.with_suffix(".csv")).values()
    stored = (
        read_stored_rows(path.with_suffix(".csv"))
        if arguments.only and not arguments.output
        else {}
    )
    for trial in all_trials() if not arguments.page else ():
        if not any(word in trial.group.lower() for word in words):
            keys = [(trial.group, trial.case, method) for method in trial.methods]
            rows += [stored[key] for key in keys if key in stored]
            continue
        for row in trial.run():
            rows.append(row)
            print(
                f"{'FAILED ' * row.has_failed}{row.group}; {row.case}; {row.method}: "
                f"{row.outcome[:150]}; {row.attempts}; error {row.error:.1e}; {row.seconds:.1f} s",
                flush=True,
            )
    report.save(path.with_suffix(".csv"), [vars(row) for row in rows])
    if path == PAGE:  # figures need all groups
        path.write_text(page(rows))
        draw_errors(path.with_name("extremes-errors.png"), rows)
        draw_stiffness(path.with_name("extremes-stiffness.png"), rows)
    return int(any(row.has_failed for row in rows))


if __name__ == "__main__":
    sys.exit(main())
