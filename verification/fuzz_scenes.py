"""Random scenes of contact as plain dictionaries; `fuzz_made` and `fuzz_models` make them.

A scene is boxes that share no node, contacts between them or with rigid obstacles, and stages of
loads. It is JSON all through, so that an old failure can be played again whatever `draw` has become
since. Lengths and forces are drawn in the scene's own units and scaled by ``units`` when the scene
is made.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np

__all__ = [
    "FORMS",
    "LAWS",
    "SUPPORTS",
    "TOP",
    "Scene",
    "dice",
    "draw",
    "draw_form",
    "element",
    "frictions",
    "path",
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
SUPPORTS = ("halfspace", "ball", "cylinder", "obstacle", "ball inside", "cylinder inside")
# How a bulk form is written; see `fuzz_forms`.
FORMS = (
    "plain",
    "tags",  # a material for each tag of one measure, loads over several tags at once
    "pairs",  # the same, its tags as a list of (number, cells)
    "measures",  # a measure for each material, with one object of tags
    "energy",  # the derivative of energies over tags
    "loads",  # coefficients by cell and a measure with tags, which the loads are over
    "beside",  # a plain measure beside that of the loads
)
TOP = 1
NU_MAX = 0.45


# ---- drawing -------------------------------------------------------------------------------------


def dice(
    rng: np.random.Generator, built: np.random.Generator, without: tuple[str, ...]
) -> tuple[
    Callable[..., bool],
    Callable[..., Any],
    Callable[[float, float], float],
    Callable[[float, float], float],
]:
    """What scenes are drawn by.

    Args:
        rng: For numbers.
        built: For what a scene is built of, unless another is said.
        without: Features that are never chosen.

    Returns:
        Whether something of a probability, with a feature's name, is so; one of some values; a
        number between two powers of ten, and one between two numbers, to three digits.
    """

    def chance(p: float, feature: str = "", of: np.random.Generator = built) -> bool:
        return bool(of.random() < p) and feature not in without

    def pick(*values: Any, of: np.random.Generator = built) -> Any:
        return values[int(of.integers(len(values)))]

    def log(low: float, high: float) -> float:
        return float(f"{10 ** rng.uniform(low, high):.3g}")

    def within(low: float, high: float) -> float:
        return float(f"{rng.uniform(low, high):.3g}")

    return chance, pick, log, within


def element(
    chance: Callable[..., bool], pick: Callable[..., Any], in_space: float
) -> tuple[bool, str, int]:
    """Whether a scene is in space, with this probability; its cells, and their degree."""
    space = chance(in_space, "space")
    cell = pick("tetrahedron", "hexahedron") if space else pick("triangle", "quadrilateral")
    return space, cell, 1 if chance(0.55) else 2


def draw(
    seed: int, *, without: tuple[str, ...] = (), ranks: int = 1, family: int | None = None
) -> Scene:
    """A random scene.

    Args:
        seed: The same gives the same.
        without: Features to leave out: "levels", "apart", "increment" (pairs anew), "units",
            "restart", "bend", "both", "narrow", "changes", "multipliers", "motion", "gap",
            "ration", "space", "method", "accuracy", "form".
        ranks: Kept in the scene.
        family: Scenes of one family differ in their numbers, loads, methods and histories, and
            share what they are built of, so that few forms are compiled; by default a scene is its
            own family.
    """
    rng = np.random.default_rng([seed, 20])
    built = rng if family is None else np.random.default_rng([family, 21])

    chance, pick, log, within = dice(rng, built, without)
    space, cell, degree = element(chance, pick, 0.35)
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
        made: Scene = {"kind": kind}
        if kind not in ("frictionless", "foundation", "tension"):
            made["friction"] = (
                pick(0.0, 0.1, 0.3, 0.3, 0.6, 1.2, of=rng) if kind not in ("ellipse",) else 0.3
            )
        if kind in ("tresca", "prescribed"):
            made["pressure"] = float(f"{rng.uniform(0.1, 2) * strain:.3g}")
        if kind == "polygon":
            made["modes"] = pick(3, 4, 6, 8)
        if kind == "ellipse" or (kind == "polygon" and chance(0.4)):
            made["friction"] = made["friction"] or 0.2
            made["transverse"] = pick(0.1, 0.3, 0.7, of=rng)
            made["direction"] = [1.0, 0.4, 0.1]
        made["k_n"] = pick(["scaled", log(0, 2)], ["number", log(-1, 3)], ["scaled", None])
        if kind == "prescribed":
            made["k_n"] = None
        if kind != "frictionless":
            made["k_t"] = pick(["scaled", log(0, 2)], ["number", log(-1, 3)], made["k_n"])
            made["k_t"] = made["k_t"] or ["number", log(0, 2)]
        return made

    def contact(body: int, side: str, obstacle: Scene) -> Scene:
        made: Scene = {"body": body, "side": side, "obstacle": obstacle, "law": law()}
        springs = chance(0.1)
        if springs:
            made["scheme"] = "vertex"
            for k in ("k_n", "k_t"):
                if made["law"].get(k) and chance(0.7):
                    made["law"][k] = ["springs", log(-1, 2)]
        elif chance(0.15):
            made["scheme"] = "vertex"
        elif chance(0.15):
            made["quadrature"] = pick(2, 3, 5)
        if chance(0.15, "gap"):
            made["gap"] = float(f"{rng.uniform(-2, 2) * strain:.3g}")
        if chance(0.2, "multipliers") and made["law"]["kind"] not in ("foundation", "tension"):
            physical = any((made["law"].get(k) or [""])[0] == "springs" for k in ("k_n", "k_t"))
            if not physical:
                made["enforcement"] = "augmented"
        if chance(0.12, "accuracy") and "enforcement" not in made:
            made["accuracy"] = pick("draft", "standard", "fine", 1e-4)
        return made

    def rigid() -> Scene:
        kind = pick("halfspace", "halfspace", "halfspace", *SUPPORTS[1:])
        made: Scene = {"kind": kind, "clearance": 0.0}
        if chance(0.2, of=rng):
            made["clearance"] = float(f"{rng.uniform(-0.5, 3) * strain:.3g}")
        if kind == "halfspace" and chance(0.3, of=rng):
            made["slope"] = pick(0.1, -0.2, 3 * strain, of=rng)
        if kind == "obstacle":
            made["curve"] = float(f"{rng.uniform(0, 3) * strain:.3g}")
        if kind not in ("halfspace", "obstacle"):
            made["radius"] = log(0, 2)
        return made

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
        obstacle: Scene = {"kind": "body", "update": update}
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
            if c["obstacle"].get("update") == "increment":
                c["obstacle"]["update"] = "never"
    if layout == "pair" and chance(0.12, "both"):
        first = contacts[0]
        other = copy.deepcopy(first)
        other |= {"body": first["obstacle"]["body"], "side": first["obstacle"]["side"]}
        other["obstacle"] |= {"body": first["body"], "side": first["side"]}
        contacts.insert(1, other)
    if layout == "pair" and chance(0.08, "narrow", of=rng):
        bodies[1]["size"][0] = float(f"{rng.uniform(0.03, 0.3) * bodies[0]['size'][0]:.3g}")
        room = bodies[0]["size"][0] - bodies[1]["size"][0]
        bodies[1]["origin"][0] = float(f"{rng.uniform(0.02, 0.98) * room:.3g}")
    if chance(0.1):
        scene["thickness"] = log(-2, 2)

    # What holds the bodies, and what drives them.
    holds: list[list[Any]] = []
    if layout in ("pair", "tower") and not standing:
        holds.append([0, "bottom", list(range(d)), "still"])
    last = n_bodies - 1
    driven = [0, 1] if layout == "apart" else [last]
    for b in driven:
        if drive == "prescribed":
            holds.append([b, "top", list(range(d)), "moved"])
        elif drive == "obstacle":
            holds.append([b, "top", list(range(d)), "still"])
    if drive == "force":
        for b in range(n_bodies):
            if [b, "bottom", list(range(d)), "still"] in holds:
                continue
            if chance(0.8):
                holds.append([b, "left", [0], "still"])
            if space and chance(0.9):
                holds.append([b, "front", [1], "still"])
    scene["holds"] = holds
    if drive == "obstacle":
        moves = contacts[0]["obstacle"]
        if chance(0.5):
            moves["moving"] = "displacement"
        else:
            moves["moving"] = "force"  # pressed by force, pulled by displacement
            moves["free"] = pick([d - 1], [d - 1], [0, d - 1])

    # Stages: of every driven body the pressure and shear at their end, in units of strain times E.
    levels = [1.0]
    if chance(0.25, "levels", of=rng):
        levels = [1.0, pick(1e-2, 1e-4, 1e-6, of=rng)]
        if chance(0.3, of=rng):
            levels.reverse()
    share = pick(1.0, 1.0, 1e-3, 1e-6, of=rng) if layout == "apart" else 1.0
    stages = []
    frictions = [c["law"].get("friction", 0.3) for c in contacts]
    grip = max(min(frictions), 0.05)
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
            if drive == "force" and not any(h[1] == "left" for h in holds):
                side *= 0.6
            across = within(-1, 1) if space else 0.0
            side = float(f"{side * grip * level:.3g}")
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
    scene["share"] = share
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
    if chance(0.08, "ration", of=rng):
        scene["ration"] = int(rng.integers(3, 9))
    return scene | draw_form(seed, family, without)


def draw_form(seed: int, family: int | None, without: tuple[str, ...]) -> dict[str, str]:
    """What a scene says of its form; by numbers of its own, so that nothing else is drawn anew.

    Args:
        seed: Of the scene.
        family: Whose scenes have one form; see `fuzz_scenes.draw`.
        without: With "form" it is written in the plain way.
    """
    rng = np.random.default_rng([seed if family is None else family, 23])
    way = FORMS[int(rng.integers(len(FORMS)))]
    return {} if way == "plain" or "form" in without else {"form": way}


def path(scene: Scene) -> list[tuple[int, float]]:
    """All values of the load parameter that are asked for: stage and value in (0, 1]."""
    return [
        (i, (k + 1) / stage["steps"])
        for i, stage in enumerate(scene["stages"])
        for k in range(stage["steps"])
    ]


def frictions(scene: Scene, stage: int) -> list[float | None]:
    """Friction coefficient of every contact in a stage; None without."""
    factor = scene["stages"][stage].get("friction", 1.0)
    given = [c["law"].get("friction") for c in scene["contacts"]]
    return [None if f is None else factor * f for f in given]
