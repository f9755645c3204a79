"""The demos as cases: each is run in a process of its own, and its result.json is read."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scenes.processes import ROOT, command, environment
from verification.cases import Case, Outcome, Row

__all__ = ["DEMOS"]


def run(name: str, *options: str) -> dict[str, Any]:
    """Run ``demos/NAME.py``; what it wrote.

    Raises:
        RuntimeError: It wrote nothing.
    """
    with tempfile.TemporaryDirectory() as folder:
        words = command(1, ROOT / "demos" / f"{name}.py", *options, "--output", folder)
        done = subprocess.run(words, capture_output=True, text=True, env=environment())
        written = Path(folder) / "result.json"
        if not written.exists():
            raise RuntimeError(
                f"demos/{name}.py ended with {done.returncode}: {done.stderr[-500:]}"
            )
        return json.loads(written.read_text())


def runs(result: dict[str, Any]) -> list[dict[str, Any]]:
    """A demo's runs; it may have but one."""
    return result.get("runs", [result])


def demo(
    title: str,
    reason: str,
    name: str,
    *options: str,
    source: Mapping[str, str],
    label: str = "",
    budget: str = "",
) -> Case:
    """A demo that puts value, reference and relative tolerance under "references".

    Args:
        title: Of the case.
        reason: For the tolerance.
        name: Of the demo.
        options: Of its command line.
        source: Of its references: of those whose name has the word, the first that fits.
        label: Key of what tells its runs apart.
        budget: As a `Case` has it.
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

    return Case(title, reason, compute, slow=True, budget=budget)


EXACT = "exact complementarity, converged"
FINE = ("--h", "0.05", "--degree", "2")


def _entries(one: dict[str, Any]) -> Iterator[Row]:
    """Rows of the half-cylinder: pairs by component, tolerances there are absolute."""
    for name, entry in one["references"].items():
        pairs = zip(np.atleast_1d(one[name]), np.atleast_1d(entry["value"]), strict=True)
        for i, (obtained, reference) in enumerate(pairs):
            if reference == 0 and np.ndim(entry["value"]) == 0:
                continue  # friction of the frictionless run
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
    """The half-cylinder of the source paper, fine."""
    made = runs(run("hertz", *FINE))
    rows = [row for one in made for row in _entries(one)]
    dofs = max(one["dofs"] for one in made)
    return Outcome(tuple(rows), "demos/hertz.py " + " ".join(FINE), dofs)


def half_cylinder_at_once() -> Outcome:
    """The same in one increment: another load history, another state."""
    options = (*FINE, "--friction", "0.2", "--increments", "1")
    (one,) = runs(run("hertz", *options))
    # Stick ends at 0.23 a: given to 0.01 a, and points are h/3 apart.
    stick = 0.23 * one["half_width"]
    place = (0.005 * one["half_width"] + 0.05 / 3) / stick
    rows = (
        Row("tangential resultant per half", one["tangential_resultant"], 38.99, EXACT, 0.01),
        Row("max tangential traction", one["max_tangential_traction"], 29.3, EXACT, 0.02),
        Row("stick half width", one["stick_half_width"], stick, EXACT, place),
    )
    return Outcome(rows, "demos/hertz.py " + " ".join(options), one["dofs"])


def thin_half_cylinder() -> Outcome:
    """a/R = 0.048, where the half-cylinder is nearly a half-plane."""
    options = ("--h", "0.01", "--degree", "2", "--load", "1", "--friction", "0")
    (one,) = runs(run("hertz", *options))
    a = np.sqrt(8 * 8**2 / (np.pi * 1000 / (1 - 0.3**2)))
    rows = (
        Row("half-width", one["half_width"], float(a), "Hertz", 0.01),
        Row("peak pressure", one["peak_pressure"], 2 * 16 / (np.pi * float(a)), "Hertz", 0.01),
    )
    return Outcome(rows, "demos/hertz.py " + " ".join(options), one["dofs"])


def greco() -> Outcome:
    """Displacements along the base, forces and zones."""
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
        "0.4 %, with friction 1 % (2 % for the largest shear), and what h leaves: see the demo",
        half_cylinder,
        slow=True,
    ),
    Case(
        "Half-cylinder on a plane, friction in one increment",
        "1 % as for 80 increments, 2 % for the largest shear; the zone to the spacing of points",
        half_cylinder_at_once,
        slow=True,
        budget="one increment is what is computed here, no error; the table has two",
    ),
    Case(
        "Half-cylinder on a plane, a/R = 0.048",
        "1 %: what a/R leaves between the body and a half-plane, and h = a/38",
        thin_half_cylinder,
        slow=True,
    ),
    Case(
        "Block with friction (GRECO)",
        "0.3 % against the converged values, 5 % against the published ones as stated for them; "
        "zones to the spacing of the points",
        greco,
        slow=True,
    ),
    demo(
        "Sphere on a block, ball on a plane",
        "2 %: cells of an eighth of the contact's radius, bodies of finite size",
        "sphere",
        source={"": "Hertz"},
        label="case",
    ),
    demo(
        "Two cylinders pressed, then sheared",
        "2 %: a/R = 0.085, and the points of the cells; forces are equilibrium",
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
        "1 % for energies, 3 % for the shear that is left: a difference of two curves",
        "fretting",
        source={"gap": "closed loop", "": "Mindlin, Deresiewicz"},
        budget="energies and the shear at a point are not among the budget's quantities; the "
        "contact is that of the two cylinders",
    ),
    demo(
        "Shrink fit",
        "0.5 %: the penalty's share of the interference and the cells; evenness to 1 %",
        "shrink_fit",
        source={"uneven": "axial symmetry", "": "Lamé"},
        label="kind",
    ),
    demo(
        "Cylinder dragged along a block",
        "2 % for width and peak, the peak even to 1 %: the points of the cells; 1e-6: equilibrium; "
        "1 % for the work: small displacements",
        "ironing",
        source={
            "force": "equilibrium",
            "over normal": "Coulomb",
            "work": "energy",
            "spread": "steady state",
            "": "Johnson, sliding cylinder",
        },
    ),
    demo(
        "Band on a drum that turns (capstan), finite",
        "1.25 t/(2R): the formula is that of a band without thickness, and 1.0 of it is the arm of "
        "the tension; extrapolated to t = 0 the product of both t/R; 2 % of the pressure and 0.5 % "
        "of the torque: t/R",
        "capstan",
        source={"torque": "equilibrium", "p R": "equilibrium", "": "Eytelwein, μπ"},
        budget="the formula is known to t/(2R), more than the error",
    ),
    demo(
        "O-ring between plates and in a groove, finite",
        "5 %: the formula is a fit; 3 % for Hertz: a facet; 1 % and 2 % between meshes; 1e-6: "
        "equilibrium",
        "seal",
        source={"c = 0.02": "Hertz", "c =": "Lindley", "bed": "equilibrium", "": "half the cells"},
        budget="the formula is a fit, known to less than the error",
    ),
    demo(
        "Tapered pin pressed in, released, pulled out, finite",
        "0.5 % where pin and hub are level: axial displacements of the flanks 0.2 %, cells and "
        "penalty 0.1 %; before that, bare ends over length; 1 % for the way by a dry force: strain "
        "of the pin; 1 % for the work: trapezia",
        "tapered_pin",
        source={
            "work": "energy",
            "out": "no contact",
            "released": "self-locking: tan α and μ",
            "left": "statics: tan α and μ",
            "dry, pu": "Lamé, Coulomb",
            "": "Lamé",
        },
        budget="ends that are not covered and axial displacements weigh more than the error",
    ),
    demo(
        "Screw turned under a nut of rubber, finite",
        "1e-9 without friction: the work of torque and force, to the solver's tolerance; with it "
        "3e-4 of F R: the middle of the pressure, and the square of the width over R",
        "screw",
        source={"no friction": "work: M = F P", "": "square thread: tan(α ± φ)"},
        budget="torque over force follows from statics",
    ),
    demo(
        "Ring of rubber turned on a disc, finite",
        "2 %: the pressure is not even, the ring has 32 sides; 1e-6: slip along the radius that is "
        "left; 1e-7: the solver's tolerance",
        "clutch",
        source={
            "even pressure": "textbooks: μ F 2/3 (b³ - a³)/(b² - a²)",
            "plate": "equilibrium",
            "turned": "frame indifference",
            "": "Coulomb",
        },
        budget="torque over force follows from statics, the rest from equilibrium",
    ),
    demo(
        "Tube of rubber pinched until it touches itself, finite",
        "1e-3: normals of curved walls do not end at mirror images; 1 %: between meshes; 1.5 %: "
        "(t/R)²/2, as sections do not stay plane",
        "tube",
        source={
            "quarter": "half the cells",
            "by the force": "Winkler's curved beam, Timoshenko",
            "": "a quarter on a rigid plane",
        },
        budget="forces here are compared between routes with the same errors, slopes with a beam, "
        "known to less than the error",
    ),
    demo(
        "Disc pressed into rubber, turned and dragged, finite",
        "1e-7 of the force that presses, the digits that are written down; 1e-10 between two "
        "routes of one program; 2 % for what penetration takes off the radius",
        "rolling",
        source={"instead": "relative motion", "slipping": "Coulomb", "": "GetFEM 5.4.2, same mesh"},
        budget="the second program has the same mesh and penalty, and with them the same errors",
    ),
    demo(
        "Male–female fitting",
        "1e-7: equilibrium to the solver's tolerance; 1e-8 for homogeneity",
        "fitting",
        source={"difference": "homogeneity", "": "statics"},
        budget="forces follow from statics and are met to round-off",
    ),
    demo(
        "Block on a rigid incline; wedge",
        "1e-4, to which the limit is searched; 1e-6 for the wedge: statics",
        "incline",
        source={"F/G": "NAFEMS CGS-4: (tan α + μ)/(1 - μ tan α)", "": "statics: tan α = μ"},
        budget="forces follow from statics and are met to round-off",
    ),
]
