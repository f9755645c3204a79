"""Additional features of random scenes, drawn by a separate random generator.

- ``"unrelated_body"``: a body in the same mesh with its own loads, motions and floor; the
  independent solver omits it.
- an obstacle of kind ``"rod"``: a plate, blade or pin (a capsule) thinner than a facet, which is
  pressed against the body, slid past an end, or moved through the body.
- ``"translation"``: a translation of all bodies and obstacles by many lengths.
- sliding past the end of the opposing surface.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from verification.fuzz_scenes import Scene, make_samplers

__all__ = ["UNRELATED_BODIES", "add_features", "feature_names", "with_unrelated_body"]

# Position of unrelated bodies along x, in units of length.
_UNRELATED_BODY_POSITION = 30.0
# Unrelated bodies: E relative to the scene, displacement of the top (length) or its traction
# divided by E, and whether the bottom is on a floor with friction.
UNRELATED_BODIES: dict[str, Scene] = {
    "moved": {"E": 1.0, "moved": [3.0, 0.0], "floor": False},
    "rubbed": {"E": 1.0, "moved": [3.0, -1e-2], "floor": True},
    "compressed": {"E": 1.0, "moved": [0.0, -0.1], "floor": True},
    "stiff": {"E": 1e6, "moved": [0.0, -1e-2], "floor": True},
    "soft": {"E": 1e-6, "load": [0.0, -1e-2], "floor": True},
    "light": {"E": 1.0, "load": [1e-8, -1e-7], "floor": True},
    "far away": {"E": 1.0, "load": [0.0, -1e-2], "floor": True, "position": 1e4},
}
_N_CELLS_PER_EDGE = 2


def add_features(scene: Scene, seed: int, without: tuple[str, ...] = ()) -> Scene:
    """Return a copy of a scene with additional features.

    Args:
        scene: The scene.
        seed: Seed that determines the features.
        without: Features to exclude: "unrelated_body", "rod", "translation", "ends".
    """
    scene = copy.deepcopy(scene)
    rng = np.random.default_rng([seed, 24])
    chance, pick, log, within = make_samplers(rng, rng, without)
    rigid = scene.get("kinematics") != "finite sliding"
    if chance(0.25, "rod") and rigid and "bend" not in scene and scene["layout"] != "apart":
        _add_rod(scene, chance, pick, log, within)
    elif chance(0.4, "ends"):
        _extend_sliding(scene, within)
    if chance(0.3, "translation") and _can_be_translated(scene):
        far = log(0, 1.5) * max(b["size"][0] for b in scene["bodies"])
        angle = within(-np.pi, np.pi) if scene["drive"] != "force" else pick(0.0, np.pi)
        scene["translation"] = [float(f"{far * f(angle):.3g}") for f in (np.cos, np.sin)]
        for contact in scene["contacts"]:
            if contact["obstacle"]["kind"] != "body":
                contact["obstacle"].setdefault("moving", "translated")
    if chance(0.35, "unrelated_body"):
        scene["unrelated_body"] = pick(*UNRELATED_BODIES)
    return scene


def _can_be_translated(scene: Scene) -> bool:
    """Whether Dirichlet conditions and obstacles can translate together with all bodies."""
    obstacles = [c["obstacle"] for c in scene["contacts"]]
    moving = [s.get("moving") for s in obstacles]
    if "kinematics" not in scene and {s["kind"] for s in obstacles} - {"halfspace", "body"}:
        return False  # normals of a translated curved obstacle change
    bodies = {h[0] for h in scene["dirichlet"] if 0 in h[2]}
    return "force" not in moving and len(bodies) == len(scene["bodies"])


def _extend_sliding(scene: Scene, within: Any) -> None:
    """Scale the sliding on obstacles with ends to between 0.5 and 2.5 widths of the body."""
    ends = {c["obstacle"]["kind"] for c in scene["contacts"]} & {"body", "box", "facets", "capsule"}
    sides = [abs(s["side"]) for s in scene["stages"]]
    if "kinematics" not in scene or not ends or not max(sides):
        return
    factor = within(0.5, 2.5) / max(sides)
    for stage in scene["stages"]:
        stage["side"] = float(f"{factor * stage['side']:.3g}")


def _add_rod(scene: Scene, chance: Any, pick: Any, log: Any, within: Any) -> None:
    """Reduce the scene to one body, with a moving rod as its obstacle."""
    finite = "kinematics" in scene
    body = scene["bodies"][0]
    d, width, height = len(body["size"]), body["size"][0], body["size"][-1]
    contact = scene["contacts"][0]
    contact |= {"body": 0, "side": "bottom"}
    contact.pop("gap", None)
    law = contact["law"]
    law["k_n"] = ["scaled", log(0.5, 2)]
    if law["kind"] in ("prescribed", "tension", "foundation"):
        for name in [n for n in law if n not in ("k_n",)]:
            law.pop(name)
        law["kind"] = "frictionless"
    shape = pick("plate", "plate", "blade", "pin", "slanted")
    radius = pick(0.01, 0.01, log(-2.3, -0.7))
    half = {"pin": 0.0, "blade": 0.3}.get(shape, within(0.2, 1.5) * width)
    tilt = {"plate": 0.0, "blade": 0.5 * np.pi, "pin": 0.0, "slanted": within(-1, 1)}[shape]
    clearance = within(0.0, 0.05) if chance(0.6) else 0.0
    obstacle = {"kind": "rod", "shape": shape, "radius": radius, "half": half, "tilt": tilt}
    obstacle |= {"clearance": clearance, "at": within(-0.1, 1.1), "moving": "displacement"}
    depth = (log(-4, -1.3) if finite else log(-5, -2.3)) * height
    extent = 2 * (radius + half * abs(np.sin(tilt)))
    reach = width + 2 * half * abs(np.cos(tilt))
    press = clearance + depth
    through = clearance + extent + within(0.05, 0.9) * height
    lateral = within(0.2, 1.3) * reach * pick(-1.0, 1.0)
    path = pick(
        [(press, 0.0)],
        [(press, 0.0), (press, lateral)],
        [(press, 0.0), (press, lateral), (press, 0.3 * lateral)],
        [(through, 0.0)],
        [(through, lateral)],
        [(press, 0.0), (through, 0.0)],
        [(press, 0.0), (0.0, lateral), (press, 0.0)],
        [(press, lateral)],
    )
    if chance(0.2):  # the rod approaches from the side
        sign = pick(-1.0, 1.0)
        obstacle["at"] = float(f"{0.5 - sign * (0.55 + 0.5 * (reach - width) / width):.4g}")
        obstacle["clearance"] = -depth
        path = [(0.0, -sign * within(0.1, 1.5) * reach)]
    rotates = finite and chance(0.3)
    if rotates:
        obstacle |= {"turn": "middle"} | ({"about": [0.0, 1.0, 0.0]} if d == 3 else {})
    contact["obstacle"] = obstacle
    strain = scene["strain"]
    stages = []
    for up, side in path:
        along = side / width if finite else side / (height * strain)
        stage = {"steps": pick(1, 1, 2, 4), "normal": up / (height * strain)}
        stage |= {"side": -along if finite else along, "across": 0.0}
        if finite:
            stage["turn"] = within(-1.0, 1.0) if rotates else 0.0
        stages.append({n: v if n == "steps" else float(f"{v:.4g}") for n, v in stage.items()})
    scene |= {"bodies": [body], "contacts": [contact], "layout": "floor", "drive": "obstacle"}
    scene |= {"dirichlet": [[0, "top", list(range(d)), "fixed"]], "load_ratio": 1.0}
    scene["stages"] = stages
    scene["cuts"] = pick(1, 3, 5)
    for name in ("restart", "thickness", "max_iterations"):
        scene.pop(name, None)


# ---- the unrelated body --------------------------------------------------------------------------


def with_unrelated_body(scene: Scene) -> Scene:
    """Return the scene with its unrelated body, if any, as the last body."""
    if "unrelated_body" not in scene:
        return scene
    unrelated = UNRELATED_BODIES[scene["unrelated_body"]]
    d, first = len(scene["bodies"][0]["size"]), scene["bodies"][0]
    body = {
        "origin": [unrelated.get("position", _UNRELATED_BODY_POSITION)] + [0.0] * (d - 1),
        "size": [1.0] * d,
    }
    n = [_N_CELLS_PER_EDGE if d == 2 else 1] * d
    body |= {"n": n, "E": first["E"] * unrelated["E"], "jitter": 0}
    number = len(scene["bodies"])
    found = scene | {"bodies": [*scene["bodies"], body]}
    conditions = list(scene["dirichlet"])
    if "moved" in unrelated:
        conditions.append([number, "top", list(range(d)), "unrelated_body"])
    elif d == 3:
        conditions.append([number, "front", [1], "unrelated_body"])
    if unrelated["floor"]:
        law = {"kind": "coulomb", "friction": 0.3, "k_n": ["scaled", 10.0], "k_t": ["scaled", 10.0]}
        floor = {"body": number, "side": "bottom", "law": law}
        floor["obstacle"] = {"kind": "halfspace", "clearance": 0.0}
        found["contacts"] = [*scene["contacts"], floor]
    if "bend" in scene:
        found["bend"] = [*scene["bend"], 0.0]
    return found | {"dirichlet": conditions}


def feature_names(scene: Scene) -> list[str]:
    """Return the names of additional features, for tables."""
    found = []
    if "unrelated_body" in scene:
        found += ["unrelated body", f"unrelated body {scene['unrelated_body']}"]
    found += ["translated"] * ("translation" in scene)
    shapes = [c["obstacle"]["shape"] for c in scene["contacts"] if "shape" in c["obstacle"]]
    return found + [f"rod {shape}" for shape in shapes]
