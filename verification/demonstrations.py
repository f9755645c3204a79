"""Demos as verification cases: each is run in a new process, and its result.json is read."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scenes.processes import ROOT, command, subprocess_environment
from verification.cases import Case, Outcome, Row

__all__ = ["DEMOS"]


def run(name: str, *options: str) -> dict[str, Any]:
    """Run ``demos/NAME.py`` and return its results.

    Raises:
        RuntimeError: The demo wrote no results.
    """
    with tempfile.TemporaryDirectory() as folder:
        words = command(1, ROOT / "demos" / f"{name}.py", *options, "--output", folder)
        done = subprocess.run(words, capture_output=True, text=True, env=subprocess_environment())
        written = Path(folder) / "result.json"
        if not written.exists():
            raise RuntimeError(
                f"demos/{name}.py ended with {done.returncode}: {done.stderr[-500:]}"
            )
        return json.loads(written.read_text())


def runs(result: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the results of all runs of a demo."""
    return result.get("runs", [result])


def demo(
    title: str,
    reason: str,
    name: str,
    *options: str,
    source: Mapping[str, str],
    label: str = "",
    reason_without_estimates: str = "",
) -> Case:
    """Create a case from a demo that writes value, reference and tolerance under "references".

    Args:
        title: Title of the case.
        reason: Reason of the tolerances.
        name: Name of the demo.
        options: Options of the command line.
        source: Sources of the references by a word of the quantity; the first match is used.
        label: Key of the results that distinguishes the runs.
        reason_without_estimates: Why error estimates cannot be compared with a true error.
    """

    def compute() -> Outcome:
        made = runs(run(name, *options))
        rows = [
            Row(
                f"{quantity}, {one[label]}" if label else quantity,
                entry["value"],
                entry["reference"],
                next(text for word, text in source.items() if word in quantity),
                entry["tolerance"],
            )
            for one in made
            for quantity, entry in one["references"].items()
        ]
        dofs = max(one.get("dofs", 0) for one in made)
        return Outcome(tuple(rows), " ".join([f"demos/{name}.py", *options]), dofs)

    return Case(
        title, reason, compute, slow=True, reason_without_estimates=reason_without_estimates
    )


EXACT = "exact complementarity, converged"
FINE = ("--h", "0.05", "--degree", "2")


def _entries(one: dict[str, Any]) -> Iterator[Row]:
    """Yield the rows of the half-cylinder, whose tolerances are absolute."""
    for name, entry in one["references"].items():
        pairs = zip(np.atleast_1d(one[name]), np.atleast_1d(entry["value"]), strict=True)
        for i, (obtained, reference) in enumerate(pairs):
            if reference == 0 and np.ndim(entry["value"]) == 0:
                continue  # friction force of the frictionless run
            quantity = name.replace("_", " ") + (f" {'xy'[i]}" if np.ndim(entry["value"]) else "")
            size = abs(reference) or 1.0
            yield Row(
                f"{quantity}, μ = {one['friction']:g}",
                float(obtained),
                float(reference),
                entry["source"],
                entry["tolerance"] / size,
            )


def half_cylinder() -> Outcome:
    """Solve the half-cylinder of the source paper on a fine mesh."""
    made = runs(run("hertz", *FINE))
    rows = [row for one in made for row in _entries(one)]
    dofs = max(one["dofs"] for one in made)
    return Outcome(tuple(rows), "demos/hertz.py " + " ".join(FINE), dofs)


def half_cylinder_at_once() -> Outcome:
    """Solve the half-cylinder in one increment, a different load history."""
    options = (*FINE, "--friction", "0.2", "--increments", "1")
    (one,) = runs(run("hertz", *options))
    # The stick zone ends at 0.23 a, known to 0.01 a; quadrature points are h/3 apart.
    stick = 0.23 * one["half_width"]
    tolerance = (0.005 * one["half_width"] + 0.05 / 3) / stick
    rows = (
        Row("tangential resultant per half", one["tangential_resultant"], 38.99, EXACT, 0.01),
        Row("max tangential traction", one["max_tangential_traction"], 29.3, EXACT, 0.02),
        Row("stick half width", one["stick_half_width"], stick, EXACT, tolerance),
    )
    return Outcome(rows, "demos/hertz.py " + " ".join(options), one["dofs"])


def thin_half_cylinder() -> Outcome:
    """Solve the half-cylinder with a/R = 0.048, nearly a half-plane."""
    options = ("--h", "0.01", "--degree", "2", "--load", "1", "--friction", "0")
    (one,) = runs(run("hertz", *options))
    a = np.sqrt(8 * 8**2 / (np.pi * 1000 / (1 - 0.3**2)))
    rows = (
        Row("half-width", one["half_width"], float(a), "Hertz", 0.01),
        Row("peak pressure", one["peak_pressure"], 2 * 16 / (np.pi * float(a)), "Hertz", 0.01),
    )
    return Outcome(rows, "demos/hertz.py " + " ".join(options), one["dofs"])


def greco() -> Outcome:
    """Solve the GRECO block: displacements along the base, forces and zones."""
    (one,) = runs(run("greco_block"))
    converged = dict(
        zip((0.0, 1.25, 5.0, 7.5, 11.25), (28.603, 27.226, 22.868, 19.807, 15.414), strict=True)
    )
    published = dict(zip(converged, (28.6, 27.2, 22.8, 19.8, 15.0), strict=True))
    obtained = dict(zip(one["places_mm"], one["displacements_um"], strict=True))
    rows = [
        Row(f"u_x at x = {x:g} mm [µm]", obtained[x], value, EXACT, 0.003)
        for x, value in converged.items()
    ]
    rows += [
        Row(
            f"u_x at x = {x:g} mm [µm]",
            obtained[x],
            value,
            "mean of codes, Code_Aster SSNV128",
            0.05,
        )
        for x, value in published.items()
    ]
    zones = one["zones_mm"]
    slip = (zones["slip"][1] + zones["stick"][0]) / 2
    lift = (zones["open"][1] + zones["slip"][0]) / 2
    rows += [
        Row("normal force [N/mm]", one["normal_force"], 2000.0, "equilibrium", 1e-8),
        Row("friction force [N/mm]", one["tangential_force"], 1405.36, EXACT, 0.003),
        Row("end of the open zone [mm]", lift, 3.35, EXACT, 0.2 / 3.35),
        Row("end of the slip zone [mm]", slip, 29.8, EXACT, 0.6 / 29.8),
    ]
    return Outcome(tuple(rows), "demos/greco_block.py", one["dofs"])


DEMOS = [
    Case(
        "Half-cylinder on a plane, a/R = 0.26",
        "0.4 %; with friction 1 %, 2 % for the largest shear traction; plus the mesh error "
        "stated in the demo",
        half_cylinder,
        slow=True,
    ),
    Case(
        "Half-cylinder on a plane, friction in one increment",
        "1 % as for 80 increments, 2 % for the largest shear traction; zones: spacing of the "
        "quadrature points",
        half_cylinder_at_once,
        slow=True,
        reason_without_estimates="the single increment is prescribed, not an error",
    ),
    Case(
        "Half-cylinder on a plane, a/R = 0.048",
        "1 %: finite a/R, and h = a/38",
        thin_half_cylinder,
        slow=True,
    ),
    Case(
        "Block with friction (GRECO)",
        "0.3 % for converged values, 5 % for published ones, as stated there; zones: spacing of "
        "the quadrature points",
        greco,
        slow=True,
    ),
    demo(
        "Sphere on a block, ball on a plane",
        "2 %: cells of 1/8 of the contact radius, finite size of the bodies",
        "sphere",
        source={"": "Hertz"},
        label="case",
    ),
    demo(
        "Two cylinders, normal then tangential load",
        "2 %: a/R = 0.085 and spacing of the quadrature points; forces: equilibrium",
        "two_cylinders",
        source={
            "force": "equilibrium",
            "stick": "Cattaneo, Mindlin",
            "shear": "Cattaneo, Mindlin",
            "": "Hertz",
        },
    ),
    demo(
        "Fretting cycle of two cylinders",
        "1 % for energies; 3 % for the residual shear traction, a difference of two curves",
        "fretting",
        source={"closing": "closed loop", "": "Mindlin, Deresiewicz"},
        reason_without_estimates="energies and point values are not in the error budget",
    ),
    demo(
        "Shrink fit",
        "0.5 %: penalty and mesh; 1 % for the variation of the pressure",
        "shrink_fit",
        source={"variation": "axial symmetry", "": "Lamé"},
        label="kind",
    ),
    demo(
        "Cylinder sliding along a block",
        "2 % for width and peak, 1 % for the variation of the peak: spacing of the quadrature "
        "points; 1e-6: equilibrium; 1 % for the work: small displacements",
        "ironing",
        source={
            "tangential": "Coulomb",
            "work": "energy",
            "variation": "steady state",
            "force": "equilibrium",
            "": "Johnson, sliding cylinder",
        },
    ),
    demo(
        "Band on a rotating drum (capstan), finite kinematics",
        "1.25 t/(2R), as the formula is for zero thickness; extrapolated to t = 0: product of "
        "both t/R; 2 % for the pressure, 0.5 % for the torque: t/R",
        "capstan",
        source={"torque": "equilibrium", "p R": "equilibrium", "": "Eytelwein, μπ"},
        reason_without_estimates="the formula is accurate to t/(2R), which exceeds the error",
    ),
    demo(
        "O-ring between plates and in a groove, finite kinematics",
        "5 %: the formula is a fit; 3 % for Hertz: one facet; 1 % and 2 % between meshes; 1e-6: "
        "equilibrium",
        "seal",
        source={
            "c = 0.02": "Hertz",
            "c =": "Lindley",
            "reaction": "equilibrium",
            "": "half the mesh size",
        },
        reason_without_estimates="the formula is a fit, less accurate than the solution",
    ),
    demo(
        "Tapered pin: insertion, release, extraction, finite kinematics",
        "0.5 % at full depth: axial displacements of the flanks 0.2 %, mesh and penalty 0.1 %; "
        "at half depth: uncovered length; 1 % for the depth under a prescribed force: strain of "
        "the pin; 1 % for the work: trapezoidal rule",
        "tapered_pin",
        source={
            "work": "energy",
            "extracted": "no contact",
            "release": "self-locking: tan α and μ",
            "relative depth": "statics: tan α and μ",
            "insertion force": "Lamé, Coulomb",
            "extraction force": "Lamé, Coulomb",
            "": "Lamé",
        },
        reason_without_estimates="uncovered ends and axial displacements exceed the error",
    ),
    demo(
        "Screw in a rubber nut, finite kinematics",
        "1e-9 without friction: solver tolerance; with friction 3e-4 of F R: centre of "
        "pressure, and (width/R)²",
        "screw",
        source={"μ = 0": "work: M = F P", "": "square thread: tan(α ± φ)"},
        reason_without_estimates="results follow from statics",
    ),
    demo(
        "Rubber ring rotating on a disc (clutch), finite kinematics",
        "2 %: non-uniform pressure, 32 facets around the ring; 1e-6: radial slip; 1e-7: solver "
        "tolerance",
        "clutch",
        source={
            "uniform pressure": "uniform pressure: μ F 2/3 (b³ - a³)/(b² - a²)",
            "reaction": "equilibrium",
            "rotating": "frame indifference",
            "": "Coulomb",
        },
        reason_without_estimates="results follow from statics",
    ),
    demo(
        "Rubber tube compressed to self-contact, finite kinematics",
        "1e-3: projections on curved walls are not symmetric; 1 %: between meshes; 1.5 %: "
        "(t/R)²/2, as sections do not remain plane",
        "tube",
        source={
            "quarter": "half the mesh size",
            "compliance": "Winkler's curved beam, Timoshenko",
            "": "quarter model on a rigid plane",
        },
        reason_without_estimates="forces are compared between models with equal errors, "
        "compliances with beam theory, less accurate than the solution",
    ),
    demo(
        "Disc pressed into rubber, rotated and slid, finite kinematics",
        "1e-7 of the normal force: digits of the reference; 1e-10 between two models in one "
        "program; 2 % for the radius, reduced by the penetration",
        "rolling",
        source={
            "moving block": "relative motion",
            "full slip": "Coulomb",
            "": "GetFEM 5.4.2, same mesh",
        },
        reason_without_estimates="the other program has the same mesh and penalty, and the same "
        "errors",
    ),
    demo(
        "Male–female fitting",
        "1e-7: solver tolerance; 1e-8 for homogeneity",
        "fitting",
        source={"difference": "homogeneity", "": "statics"},
        reason_without_estimates="results follow from statics, up to round-off",
    ),
    demo(
        "Block on a rigid incline; wedge",
        "1e-4: resolution of the bisection; 1e-6 for the wedge: statics",
        "incline",
        source={"F/G": "NAFEMS CGS-4: (tan α + μ)/(1 - μ tan α)", "": "statics: tan α = μ"},
        reason_without_estimates="results follow from statics, up to round-off",
    ),
]
