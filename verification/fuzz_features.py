"""What random scenes of all kinds may have in addition, drawn by numbers of its own.

- ``"busy"``: an unrelated body in the same mesh, with loads, motions and a floor of its own. The
  second solution is that of the scene without it.
- an obstacle of kind ``"rod"``: a thin plate, a blade or a pin, all of them capsules, which is
  pressed against the body, dragged past an end, or led through it.
- ``"carry"``: a translation of all bodies and obstacles by many lengths.
- longer ways along the surface, past the end of what lies opposite.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from verification.fuzz_scenes import Scene, dice

__all__ = ["BUSY", "add_features", "feature_names", "with_busy_body"]

# Where unrelated bodies stand along x, in units of length.
_PLACE = 30.0
# What they do: E by that of the scene, motion of the top (length) or its traction by E, and whether
# the bottom is on a floor with friction.
BUSY: dict[str, Scene] = {
    "led aside": {"E": 1.0, "moved": [3.0, 0.0], "floor": False},
    "rubbed": {"E": 1.0, "moved": [3.0, -1e-2], "floor": True},
    "compressed": {"E": 1.0, "moved": [0.0, -0.1], "floor": True},
    "stiff": {"E": 1e6, "moved": [0.0, -1e-2], "floor": True},
    "soft": {"E": 1e-6, "load": [0.0, -1e-2], "floor": True},
    "light": {"E": 1.0, "load": [1e-8, -1e-7], "floor": True},
    "far away": {"E": 1.0, "load": [0.0, -1e-2], "floor": True, "place": 1e4},
}
_FEW_UNKNOWNS = 2


def add_features(scene: Scene, seed: int, without: tuple[str, ...] = ()) -> Scene:
    """A drawn scene with additional features, each by chance.

    Args:
        scene: The scene; it stays as it is.
        seed: The same gives the same.
        without: Features to leave out: "busy", "rod", "carry", "ends".
    """
    scene = copy.deepcopy(scene)
    rng = np.random.default_rng([seed, 24])
    chance, pick, log, within = dice(rng, rng, without)
    rigid = scene.get("kinematics") != "present"
    if chance(0.25, "rod") and rigid and "bend" not in scene and scene["layout"] != "apart":
        _add_rod(scene, chance, pick, log, within)
    elif chance(0.4, "ends"):
        _drag_farther(scene, within)
    if chance(0.3, "carry") and _can_be_carried(scene):
        far = log(0, 1.5) * max(b["size"][0] for b in scene["bodies"])
        angle = within(-np.pi, np.pi) if scene["drive"] != "force" else pick(0.0, np.pi)
        scene["carry"] = [float(f"{far * f(angle):.3g}") for f in (np.cos, np.sin)]
        for contact in scene["contacts"]:
            if contact["obstacle"]["kind"] != "body":
                contact["obstacle"].setdefault("moving", "carried")
    if chance(0.35, "busy"):
        scene["busy"] = pick(*BUSY)
    return scene


def _can_be_carried(scene: Scene) -> bool:
    """Whether conditions and obstacles can lead all bodies along."""
    obstacles = [c["obstacle"] for c in scene["contacts"]]
    moving = [s.get("moving") for s in obstacles]
    if "kinematics" not in scene and {s["kind"] for s in obstacles} - {"halfspace", "body"}:
        return False  # where a curved obstacle has gone its normals are others
    kept = {h[0] for h in scene["holds"] if 0 in h[2]}
    return "force" not in moving and len(kept) == len(scene["bodies"])


def _drag_farther(scene: Scene, within: Any) -> None:
    """Ways aside up to two and a half times the width of the body, where obstacles have ends."""
    ends = {c["obstacle"]["kind"] for c in scene["contacts"]} & {"body", "box", "facets", "capsule"}
    sides = [abs(s["side"]) for s in scene["stages"]]
    if "kinematics" not in scene or not ends or not max(sides):
        return
    factor = within(0.5, 2.5) / max(sides)
    for stage in scene["stages"]:
        stage["side"] = float(f"{factor * stage['side']:.3g}")


def _add_rod(scene: Scene, chance: Any, pick: Any, log: Any, within: Any) -> None:
    """Put a rod in the place of the obstacles, and let it be led along."""
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
    whole = 2 * (radius + half * abs(np.sin(tilt)))
    reach = width + 2 * half * abs(np.cos(tilt))
    press = clearance + depth
    through = clearance + whole + within(0.05, 0.9) * height
    aside = within(0.2, 1.3) * reach * pick(-1.0, 1.0)
    ways = pick(
        [(press, 0.0)],
        [(press, 0.0), (press, aside)],
        [(press, 0.0), (press, aside), (press, 0.3 * aside)],
        [(through, 0.0)],
        [(through, aside)],
        [(press, 0.0), (through, 0.0)],
        [(press, 0.0), (0.0, aside), (press, 0.0)],
        [(press, aside)],
    )
    if chance(0.2):  # it comes from beside the body
        sign = pick(-1.0, 1.0)
        obstacle["at"] = float(f"{0.5 - sign * (0.55 + 0.5 * (reach - width) / width):.4g}")
        obstacle["clearance"] = -depth
        ways = [(0.0, -sign * within(0.1, 1.5) * reach)]
    turns = finite and chance(0.3)
    if turns:
        obstacle |= {"turn": "middle"} | ({"about": [0.0, 1.0, 0.0]} if d == 3 else {})
    contact["obstacle"] = obstacle
    strain = scene["strain"]
    stages = []
    for up, side in ways:
        along = side / width if finite else side / (height * strain)
        stage = {"steps": pick(1, 1, 2, 4), "normal": up / (height * strain)}
        stage |= {"side": -along if finite else along, "across": 0.0}
        if finite:
            stage["turn"] = within(-1.0, 1.0) if turns else 0.0
        stages.append({n: v if n == "steps" else float(f"{v:.4g}") for n, v in stage.items()})
    scene |= {"bodies": [body], "contacts": [contact], "layout": "floor", "drive": "obstacle"}
    scene |= {"stages": stages, "holds": [[0, "top", list(range(d)), "still"]], "share": 1.0}
    scene["cuts"] = pick(1, 3, 5)
    for name in ("restart", "thickness", "ration"):
        scene.pop(name, None)


# ---- the unrelated body --------------------------------------------------------------------------


def with_busy_body(scene: Scene) -> Scene:
    """The scene with its unrelated body as the last one, if there is any."""
    if "busy" not in scene:
        return scene
    busy = BUSY[scene["busy"]]
    d, first = len(scene["bodies"][0]["size"]), scene["bodies"][0]
    body = {"origin": [busy.get("place", _PLACE)] + [0.0] * (d - 1), "size": [1.0] * d}
    body |= {"n": [_FEW_UNKNOWNS if d == 2 else 1] * d, "E": first["E"] * busy["E"], "jitter": 0}
    number = len(scene["bodies"])
    found = scene | {"bodies": [*scene["bodies"], body]}
    holds = list(scene["holds"])
    if "moved" in busy:
        holds.append([number, "top", list(range(d)), "busy"])
    elif d == 3:
        holds.append([number, "front", [1], "busy"])
    if busy["floor"]:
        law = {"kind": "coulomb", "friction": 0.3, "k_n": ["scaled", 10.0], "k_t": ["scaled", 10.0]}
        floor = {"body": number, "side": "bottom", "law": law}
        floor["obstacle"] = {"kind": "halfspace", "clearance": 0.0}
        found["contacts"] = [*scene["contacts"], floor]
    if "bend" in scene:
        found["bend"] = [*scene["bend"], 0.0]
    return found | {"holds": holds}


def feature_names(scene: Scene) -> list[str]:
    """What of this a scene has, for tables."""
    found = [f"{n} {scene[n]}" for n in ("busy",) if n in scene] + ["busy"] * ("busy" in scene)
    found += ["carried"] * ("carry" in scene)
    shapes = [c["obstacle"]["shape"] for c in scene["contacts"] if "shape" in c["obstacle"]]
    return found + [f"rod {shape}" for shape in shapes]
