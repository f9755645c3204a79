"""Random scenes of contact, as dictionaries that can be stored as JSON.

A scene has boxes without common nodes, contacts between them or with rigid obstacles, Dirichlet
conditions (body, side, components, kind) and stages of loads. `fuzz_setup` and `fuzz_reference`
create its problems. Lengths and forces are scaled by ``units``. Stored scenes do not change with
`draw`.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np

__all__ = [
    "FORMS",
    "LAWS",
    "RIGID_OBSTACLES",
    "TOP",
    "Scene",
    "draw",
    "draw_element",
    "draw_form",
    "frictions",
    "load_path",
    "make_samplers",
]

Scene = dict[str, Any]

CELLS = ("triangle", "quadrilateral", "tetrahedron", "hexahedron")
LAWS = (
    "frictionless",
    "coulomb",
    "tresca",
    "prescribed",
    "foundation",
    "tension",
    "polygon",
    "ellipse",
)
RIGID_OBSTACLES = ("halfspace", "ball", "cylinder", "obstacle", "ball inside", "cylinder inside")
# Equivalent bulk forms, see `fuzz_forms`.
FORMS = (
    "plain",
    "tags",  # one measure with a material per tag, loads on several tags
    "pairs",  # the same with tags as a list of (number, cells)
    "measures",  # a measure per material with common tags
    "energy",  # derivative of energies over tags
    "loads",  # piecewise constant coefficients, tagged measure
    "beside",  # an untagged measure of the bulk, a tagged one of the loads
)
TOP = 1
NU_MAX = 0.45


# ---- drawing -------------------------------------------------------------------------------------


def make_samplers(
    rng: np.random.Generator, structure: np.random.Generator, without: tuple[str, ...]
) -> tuple[
    Callable[..., bool],
    Callable[..., Any],
    Callable[[float, float], float],
    Callable[[float, float], float],
]:
    """Return functions that draw random properties of a scene.

    Args:
        rng: Generator of numbers.
        structure: Default generator of features and choices.
        without: Features to exclude.

    Returns:
        Functions that draw whether a scene has a feature, by probability and name; one of several
        values; a number between two powers of ten; and one between two numbers, to three digits.
    """

    def chance(p: float, feature: str = "", of: np.random.Generator = structure) -> bool:
        return bool(of.random() < p) and feature not in without

    def pick(*values: Any, of: np.random.Generator = structure) -> Any:
        return values[int(of.integers(len(values)))]

    def log(low: float, high: float) -> float:
        return float(f"{10 ** rng.uniform(low, high):.3g}")

    def within(low: float, high: float) -> float:
        return float(f"{rng.uniform(low, high):.3g}")

    return chance, pick, log, within


def draw_element(
    chance: Callable[..., bool], pick: Callable[..., Any], in_space: float
) -> tuple[bool, str, int]:
    """Draw whether a scene is in space, its cell type and its degree."""
    space = chance(in_space, "space")
    cell = pick("tetrahedron", "hexahedron") if space else pick("triangle", "quadrilateral")
    return space, cell, 1 if chance(0.55) else 2


def draw(
    seed: int, *, without: tuple[str, ...] = (), ranks: int = 1, family: int | None = None
) -> Scene:
    """Draw a random scene.

    Args:
        seed: Seed that determines the scene.
        without: Features to exclude: "levels", "apart", "increment" (updated pairs), "units",
            "restart", "bend", "both", "narrow", "changes", "multipliers", "motion", "gap",
            "max_iterations", "space", "method", "accuracy", "form".
        ranks: Number of ranks, stored in the scene.
        family: Family of scenes with a common structure, so that few forms are compiled; by
            default the seed determines the structure.
    """
    rng = np.random.default_rng([seed, 20])
    structure = rng if family is None else np.random.default_rng([family, 21])

    chance, pick, log, within = make_samplers(rng, structure, without)
    space, cell, degree = draw_element(chance, pick, 0.35)
    d = 3 if space else 2
    layout = pick("floor", "floor", "floor", "corner", "pair", "pair", "pair", "tower", "apart")
    if layout == "apart" and "apart" in without:
        layout = "floor"
    few = degree == 2 or layout in ("pair", "tower", "apart")
    most = (1 if few else 2) if space else (3 if few else 5)
    strain = log(-6, -2)

    def box(origin: list[float], scale: float = 1.0) -> Scene:
        n = [int(rng.integers(1, most + 1)) for _ in range(d)]
        size = [float(f"{scale * rng.uniform(0.7, 1.6):.3g}") for _ in range(d)]
        jitter = int(rng.integers(1, 1000)) if chance(0.4, of=rng) and not (space and few) else 0
        return {"origin": origin, "size": size, "n": n, "E": log(2, 4), "jitter": jitter}

    n_bodies = {"floor": 1, "corner": 1, "pair": 2, "tower": 3, "apart": 2}[layout]
    bodies = [box([0.0] * d)]
    if layout == "apart":
        bodies.append(box([5.0] + [0.0] * (d - 1)))
    for _ in range(1, n_bodies if layout in ("pair", "tower") else 1):
        below = bodies[-1]
        top = below["origin"][-1] + below["size"][-1]
        above = box([0.0] * d)
        side = within(-0.3, 0.3) if chance(0.5, of=rng) else 0.0
        above["origin"] = [below["origin"][0] + side, *below["origin"][1:-1], top]
        if chance(0.5, of=rng):
            above["size"][:-1] = below["size"][:-1]
        bodies.append(above)
    scene: Scene = {
        "seed": seed,
        "layout": layout,
        "cell": cell,
        "degree": degree,
        "nu": within(0, NU_MAX),
        "bodies": bodies,
        "ranks": ranks,
        "units": [1.0, 1.0],
    }

    drive = pick("force", "force", "prescribed", "obstacle")
    if layout in ("pair", "tower", "apart") and drive == "obstacle":
        drive = "force"
    if "motion" in without and drive == "obstacle":
        drive = "prescribed"
    scene["drive"] = drive

    def law() -> Scene:
        kind = pick("frictionless", "frictionless", *["coulomb"] * 5, *LAWS[2:])
        if kind == "prescribed" and (drive == "force" or chance(0.5)):
            kind = "tresca"
        if not space and kind in ("polygon", "ellipse"):
            kind = "coulomb"
        drawn: Scene = {"kind": kind}
        if kind not in ("frictionless", "foundation", "tension"):
            drawn["friction"] = (
                pick(0.0, 0.1, 0.3, 0.3, 0.6, 1.2, of=rng) if kind not in ("ellipse",) else 0.3
            )
        if kind in ("tresca", "prescribed"):
            drawn["pressure"] = float(f"{rng.uniform(0.1, 2) * strain:.3g}")
        if kind == "polygon":
            drawn["modes"] = pick(3, 4, 6, 8)
        if kind == "ellipse" or (kind == "polygon" and chance(0.4)):
            drawn["friction"] = drawn["friction"] or 0.2
            drawn["transverse"] = pick(0.1, 0.3, 0.7, of=rng)
            drawn["direction"] = [1.0, 0.4, 0.1]
        drawn["k_n"] = pick(["scaled", log(0, 2)], ["number", log(-1, 3)], ["scaled", None])
        if kind == "prescribed":
            drawn["k_n"] = None
        if kind != "frictionless":
            drawn["k_t"] = pick(["scaled", log(0, 2)], ["number", log(-1, 3)], drawn["k_n"])
            drawn["k_t"] = drawn["k_t"] or ["number", log(0, 2)]
        return drawn

    def contact(body: int, side: str, obstacle: Scene) -> Scene:
        drawn: Scene = {"body": body, "side": side, "obstacle": obstacle, "law": law()}
        springs = chance(0.1)
        if springs:
            drawn["scheme"] = "vertex"
            for k in ("k_n", "k_t"):
                if drawn["law"].get(k) and chance(0.7):
                    drawn["law"][k] = ["springs", log(-1, 2)]
        elif chance(0.15):
            drawn["scheme"] = "vertex"
        elif chance(0.15):
            drawn["quadrature"] = pick(2, 3, 5)
        if chance(0.15, "gap"):
            drawn["gap"] = float(f"{rng.uniform(-2, 2) * strain:.3g}")
        if chance(0.2, "multipliers") and drawn["law"]["kind"] not in ("foundation", "tension"):
            physical = any((drawn["law"].get(k) or [""])[0] == "springs" for k in ("k_n", "k_t"))
            if not physical:
                drawn["enforcement"] = "augmented"
        if chance(0.12, "accuracy") and "enforcement" not in drawn:
            drawn["accuracy"] = pick("draft", "standard", "fine", 1e-4)
        return drawn

    def rigid() -> Scene:
        kind = pick("halfspace", "halfspace", "halfspace", *RIGID_OBSTACLES[1:])
        drawn: Scene = {"kind": kind, "clearance": 0.0}
        if chance(0.2, of=rng):
            drawn["clearance"] = float(f"{rng.uniform(-0.5, 3) * strain:.3g}")
        if kind == "halfspace" and chance(0.3, of=rng):
            drawn["slope"] = pick(0.1, -0.2, 3 * strain, of=rng)
        if kind == "obstacle":
            drawn["curve"] = float(f"{rng.uniform(0, 3) * strain:.3g}")
        if kind not in ("halfspace", "obstacle"):
            drawn["radius"] = log(0, 2)
        return drawn

    contacts: list[Scene] = []
    if layout in ("floor", "corner", "apart"):
        contacts.append(contact(0, "bottom", rigid()))
    if layout == "corner":
        contacts.append(contact(0, "right", {"kind": "halfspace", "clearance": 0.0}))
    if layout == "apart":
        contacts.append(contact(1, "bottom", rigid()))
    for upper in range(1, n_bodies if layout in ("pair", "tower") else 1):
        update = (
            "increment"
            if degree == 1 and cell != "hexahedron" and chance(0.3, "increment")
            else "never"
        )
        obstacle: Scene = {"kind": "body", "update_pairs": update}
        if chance(0.6):
            contacts.append(contact(upper, "bottom", obstacle | {"body": upper - 1, "side": "top"}))
        else:
            contacts.append(contact(upper - 1, "top", obstacle | {"body": upper, "side": "bottom"}))
    standing = layout in ("pair", "tower") and chance(0.4)
    if standing:
        contacts.append(contact(0, "bottom", rigid()))
    scene["contacts"] = contacts

    rigid_alone = layout in ("floor", "corner", "apart")
    if chance(0.15, "bend") and cell != "hexahedron" and (rigid_alone or degree == 2):
        scale = pick(3 * strain, 3 * strain, 0.03, of=rng)
        scene["bend"] = [float(f"{rng.uniform(-1, 1) * scale:.3g}") for _ in bodies]
        for c in contacts:
            c["law"]["k_n"] = c["law"]["k_n"] and ["number", 20.0]
            if "k_t" in c["law"]:
                c["law"]["k_t"] = ["number", 10.0]
            if c["obstacle"].get("update_pairs") == "increment":
                c["obstacle"]["update_pairs"] = "never"
    if layout == "pair" and chance(0.12, "both"):
        first = contacts[0]
        other = copy.deepcopy(first)
        other |= {"body": first["obstacle"]["body"], "side": first["obstacle"]["side"]}
        other["obstacle"] |= {"body": first["body"], "side": first["side"]}
        contacts.insert(1, other)
    if layout == "pair" and chance(0.08, "narrow", of=rng):
        bodies[1]["size"][0] = float(f"{rng.uniform(0.03, 0.3) * bodies[0]['size'][0]:.3g}")
        free_width = bodies[0]["size"][0] - bodies[1]["size"][0]
        bodies[1]["origin"][0] = float(f"{rng.uniform(0.02, 0.98) * free_width:.3g}")
    if chance(0.1):
        scene["thickness"] = log(-2, 2)

    # Dirichlet conditions, prescribed motions and loads.
    conditions: list[list[Any]] = []
    if layout in ("pair", "tower") and not standing:
        conditions.append([0, "bottom", list(range(d)), "fixed"])
    last = n_bodies - 1
    driven = [0, 1] if layout == "apart" else [last]
    for b in driven:
        if drive == "prescribed":
            conditions.append([b, "top", list(range(d)), "moved"])
        elif drive == "obstacle":
            conditions.append([b, "top", list(range(d)), "fixed"])
    if drive == "force":
        for b in range(n_bodies):
            if [b, "bottom", list(range(d)), "fixed"] in conditions:
                continue
            if chance(0.8):
                conditions.append([b, "left", [0], "fixed"])
            if space and chance(0.9):
                conditions.append([b, "front", [1], "fixed"])
    scene["dirichlet"] = conditions
    if drive == "obstacle":
        moves = contacts[0]["obstacle"]
        if chance(0.5):
            moves["moving"] = "displacement"
        else:
            moves["moving"] = "force"  # loaded by a force, with prescribed sideways motion
            moves["free"] = pick([d - 1], [d - 1], [0, d - 1])

    # Stages: pressure and shear at their end, in units of strain times E.
    levels = [1.0]
    if chance(0.25, "levels", of=rng):
        levels = [1.0, pick(1e-2, 1e-4, 1e-6, of=rng)]
        if chance(0.3, of=rng):
            levels.reverse()
    load_ratio = pick(1.0, 1.0, 1e-3, 1e-6, of=rng) if layout == "apart" else 1.0
    stages = []
    frictions = [c["law"].get("friction", 0.3) for c in contacts]
    smallest_friction = max(min(frictions), 0.05)
    for level in levels:
        for kind in pick(
            ["press"],
            ["press", "shear"],
            ["press", "shear", "reverse"],
            ["press", "lift", "press"],
            ["press", "shear", "lift", "press"],
            ["press", "shear", "ease"],
            ["both"],
            ["both", "off", "both"],
            of=rng,
        ):
            normal, side = {
                "press": (1.0, 0.0),
                "shear": (1.0, rng.uniform(0.2, 1.4)),
                "reverse": (1.0, -rng.uniform(0.2, 1.4)),
                "lift": (-0.3 if drive != "force" else 0.0, 0.0),
                "ease": (0.3, rng.uniform(0, 0.3)),
                "both": (1.0, rng.uniform(-1, 1)),
                "off": (0.0, 0.0),
            }[kind]
            if drive == "force" and not any(h[1] == "left" for h in conditions):
                side *= 0.6
            across = within(-1, 1) if space else 0.0
            side = float(f"{side * smallest_friction * level:.3g}")
            stages.append(
                {
                    "steps": int(rng.integers(1, 4)),
                    "normal": float(f"{normal * level:.3g}"),
                    "side": side,
                    "across": side * across,
                }
                | (
                    {"friction": pick(0.5, 1.5, of=rng)}
                    if stages and chance(0.1, "changes", of=rng)
                    else {}
                )
            )
    scene["strain"] = strain
    scene["load_ratio"] = load_ratio
    scene["stages"] = stages
    if chance(0.15):
        scene["weight"] = log(-2, 1)  # body force
    total = sum(s["steps"] for s in stages)
    if chance(0.25, "restart", of=rng) and total > 1:
        scene["restart"] = int(rng.integers(1, total))
    if chance(0.35, "units", of=rng):
        scene["units"] = [log(-6, 6), log(-12, 12)]
    if chance(0.4, "method", of=rng):
        scene["method"] = pick("lbfgs", "newton", "continuation", "alternating", of=rng)
    if chance(0.2, of=rng):
        scene["condensation"] = False
    if chance(0.1, of=rng):
        scene["cuts"] = 4
    if chance(0.08, "max_iterations", of=rng):
        scene["max_iterations"] = int(rng.integers(3, 9))
    if "far" not in without:
        _extend_block_sliding(scene, np.random.default_rng([seed, 29]))
    return scene | draw_form(seed, family, without)


def _extend_block_sliding(scene: Scene, rng: np.random.Generator) -> None:
    """Let a driven block slide by 0.02 to 0.6 of its height, across facets or past an end."""
    pairs = [c["obstacle"] for c in scene["contacts"] if c["obstacle"]["kind"] == "body"]
    small = scene["strain"] < 0.02 and "bend" not in scene
    searched = scene["degree"] == 1 and scene["cell"] != "hexahedron"
    is_driven = scene["layout"] == "pair" and scene["drive"] == "prescribed" and len(pairs) == 1
    if not (small and searched and is_driven) or rng.random() > 0.4:
        return
    pairs[0]["update_pairs"] = "auto" if rng.random() < 0.7 else "increment"
    for stage in scene["stages"]:
        distance = np.sign(stage["side"]) * rng.uniform(0.02, 0.6) / scene["strain"]
        stage["side"] = float(f"{distance:.3g}")
        # The contact force of surfaces that just touch would be round-off, or zero.
        stage["normal"] = stage["normal"] or -0.3


def draw_form(seed: int, family: int | None, without: tuple[str, ...]) -> dict[str, str]:
    """Draw the bulk form of a scene from a separate random generator.

    Args:
        seed: Seed of the scene.
        family: Family of the scene, whose scenes have the same form.
        without: Features to exclude; with "form" the form is the plain one.
    """
    rng = np.random.default_rng([seed if family is None else family, 23])
    form = FORMS[int(rng.integers(len(FORMS)))]
    return {} if form == "plain" or "form" in without else {"form": form}


def load_path(scene: Scene) -> list[tuple[int, float]]:
    """Return stage and load parameter, in (0, 1], of every increment."""
    return [
        (i, (k + 1) / stage["steps"])
        for i, stage in enumerate(scene["stages"])
        for k in range(stage["steps"])
    ]


def frictions(scene: Scene, stage: int) -> list[float | None]:
    """Return the friction coefficient of every contact in a stage; None without friction."""
    factor = scene["stages"][stage].get("friction", 1.0)
    given = [c["law"].get("friction") for c in scene["contacts"]]
    return [None if f is None else factor * f for f in given]
