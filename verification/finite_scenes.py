"""Random scenes with finite kinematics: one body on moving and rotating rigid obstacles.

A scene is a dictionary as in `fuzz_scenes`, with ``"kinematics": "finite"``. Contacts are at the
bottom and the right of the body; stages also have the angle of the lower obstacle ("turn").
"""

from __future__ import annotations

from typing import Any

import numpy as np
import ufl
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.elasticity import NeoHookean
from fenics_contact.types import Array
from scenes.surfaces import ball, box, ring
from verification.fuzz_scenes import Scene, draw_element, draw_form, make_samplers
from verification.fuzz_setup import SceneSetup, capsule_gap, obstacle_geometry

__all__ = ["DEGREE", "KINDS", "FiniteSetup", "draw", "initial_geometry", "obstacle_points"]

KINDS = (
    *("halfspace", "ball", "cylinder", "ball inside", "cylinder inside"),
    *("capsule", "torus", "profile", "turned profile", "facets", "box"),
)
# Quadrature degree of the nonlinear bulk, for both solvers.
DEGREE = 4
# Obstacles that may rotate about their centre without additional penetration.
_ROUND = ("ball", "cylinder", "ball inside", "cylinder inside")


def draw(
    seed: int, *, without: tuple[str, ...] = (), ranks: int = 1, family: int | None = None
) -> Scene:
    """Draw a random scene.

    Args:
        seed: Seed that determines the scene.
        without: Features to exclude: "space", "rubber", "turn", "motion", "multipliers",
            "units", "restart", "corner", "method", "accuracy", "changes", "max_iterations", "form".
        ranks: Number of ranks, stored in the scene.
        family: Family of scenes with a common structure, as for `fuzz_scenes.draw`.
    """
    rng = np.random.default_rng([seed, 30])
    structure = rng if family is None else np.random.default_rng([family, 31])

    chance, pick, log, within = make_samplers(rng, structure, without)
    space, cell, degree = draw_element(chance, pick, 0.3)
    d = 3 if space else 2
    most = (2 if degree == 1 else 1) if space else (6 if degree == 1 else 4)
    kinds = [k for k in KINDS if (space or k not in ("torus", "turned profile"))]
    kind = pick("halfspace", *kinds)
    # Round obstacles need a larger strain to touch more than one point.
    rounded = kind not in ("halfspace", "box") and not kind.endswith("inside")
    strain = log(-1.7, -0.6) if rounded else log(-2.7, -0.8)
    n = [int(rng.integers(1, most + 1)) for _ in range(d)]
    if rounded:
        n[:-1] = [max(2, k) for k in n[:-1]]
    jitter = int(rng.integers(1, 1000)) if chance(0.4, of=rng) else 0
    body = {"origin": [0.0] * d, "size": [within(0.7, 1.6) for _ in range(d)], "n": n}
    body |= {"E": log(2, 4), "jitter": jitter}
    bulk = "rubber" if chance(0.5, "rubber") else "linear"
    drive = pick("prescribed", "prescribed", "obstacle", "obstacle", "force")
    law_kind = pick("frictionless", "frictionless", *["coulomb"] * 5, "tresca", "tension")
    if space and chance(0.3):
        law_kind = pick("polygon", "ellipse")

    def law() -> Scene:
        drawn: Scene = {"kind": law_kind}
        drawn["k_n"] = pick(["scaled", log(0, 2)], ["number", log(0.5, 3)], ["scaled", None])
        if law_kind not in ("frictionless", "tension"):
            drawn["friction"] = pick(0.1, 0.3, 0.3, 0.6, 1.0, of=rng)
            drawn["k_t"] = pick(["scaled", log(0, 2)], ["number", log(0, 2.5)])
        if law_kind == "tresca":
            drawn["pressure"] = float(f"{rng.uniform(0.1, 2) * strain:.3g}")
        if law_kind == "polygon":
            drawn["modes"] = pick(3, 4, 6, 8)
        if law_kind == "ellipse":
            drawn |= {"transverse": pick(0.1, 0.3, 0.7, of=rng), "direction": [1.0, 0.4, 0.1]}
        return drawn

    def contact(side: str, obstacle: Scene) -> Scene:
        drawn: Scene = {"body": 0, "side": side, "obstacle": obstacle, "law": law()}
        if chance(0.15):
            drawn["scheme"] = "vertex"
        elif chance(0.15):
            drawn["quadrature"] = pick(2, 3, 5)
        if chance(0.2, "multipliers") and law_kind != "tension":
            drawn["enforcement"] = "augmented"
        elif chance(0.1, "accuracy") and law_kind != "tension":
            drawn["accuracy"] = pick("draft", "standard", 1e-4)
        return drawn

    obstacle: Scene = {"kind": kind, "clearance": 0.0, "radius": log(-0.3, 0.7)}
    if chance(0.3, of=rng):
        obstacle["clearance"] = float(f"{rng.uniform(-0.3, 2) * strain:.3g}")
    if kind == "halfspace" and chance(0.3, of=rng):
        obstacle["slope"] = pick(0.1, -0.2, of=rng)
    if "cylinder" in kind and space and chance(0.5, of=rng):
        obstacle["axis"] = [0.2, 1.0, 0.1]
    if kind in ("profile", "turned profile"):
        obstacle["points"] = pick(24, 40, 90, of=rng)
        obstacle["flat"] = within(0.6, 1.0)
    if kind == "facets":
        obstacle["points"] = pick(12, 24, 60, of=rng)
    rotates = chance(0.6, "turn")
    if rotates:
        obstacle["turn"] = "middle" if kind in _ROUND and chance(0.6, of=rng) else "aside"
        if space:
            obstacle["about"] = pick([0.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.3, 1.0, 0.2], of=rng)
            if drive != "force" and chance(0.2, of=rng):
                obstacle["about"] = [0.0, 0.0, 1.0]
    if drive == "obstacle":
        obstacle["moving"] = "displacement"
        if chance(0.35, "motion"):
            obstacle["moving"], obstacle["free"] = "force", [d - 1]
    elif chance(0.3):
        obstacle["moving"] = "displacement"  # lateral, while the body is pressed
    contacts = [contact("bottom", obstacle)]
    if chance(0.1, "corner") and drive != "force":
        contacts.append(contact("right", {"kind": "halfspace", "clearance": 0.3 * strain}))
    for wall in contacts[1:]:
        wall["obstacle"]["moving"] = obstacle.get("moving") and "displacement"
        if not wall["obstacle"]["moving"]:
            wall["obstacle"].pop("moving")

    whole = list(range(d))
    conditions: list[list[Any]] = [[0, "top", whole, "moved" if drive == "prescribed" else "fixed"]]
    if drive == "force":
        conditions = [[0, "left", [0], "fixed"]] + ([[0, "front", [1], "fixed"]] if space else [])

    # Stages: strain at their end, sliding distance in widths of the body, angle in radians.
    far = pick(strain, strain, 0.1, 0.4, of=rng)
    most_turned = 0.5 * strain
    if rotates and obstacle["turn"] == "middle":
        most_turned = pick(0.3, 1.5, 6.3, of=rng)
    elif rotates and obstacle.get("about") == [0.0, 0.0, 1.0]:
        most_turned = pick(0.3, 1.0, of=rng)
    stages, angle = [], 0.0
    for name in pick(
        ["press"],
        ["press", "shear"],
        ["press", "turn"],
        ["press", "shear", "reverse"],
        ["press", "shear", "turn"],
        ["press", "turn", "back"],
        ["press", "lift", "press"],
        ["press", "shear", "lift", "press"],
        ["both"],
        ["both", "off", "both"],
        ["press", "both", "both", "ease"],
        of=rng,
    ):
        normal, side = {
            "press": (1.0, 0.0),
            "shear": (1.0, rng.uniform(0.2, 1.0)),
            "reverse": (1.0, -rng.uniform(0.2, 1.0)),
            "turn": (1.0, rng.uniform(-0.2, 0.2)),
            "back": (0.8, 0.0),
            "lift": (-0.3 if drive != "force" else 0.0, 0.0),
            "ease": (0.4, rng.uniform(0, 0.3)),
            "both": (1.0, rng.uniform(-1, 1)),
            "off": (0.1, 0.0),
        }[name]
        if rotates and name in ("turn", "both"):
            angle += most_turned * rng.uniform(-1, 1)
        if name == "back":
            angle *= 0.3
        changes = chance(0.08, "changes", of=rng) and bool(stages)
        steps = int(rng.integers(1, 5)) + 2 * (name == "turn")
        stages.append(
            {
                "steps": steps,
                "normal": normal,
                "side": float(f"{side * far:.3g}"),
                "across": float(f"{side * far * rng.uniform(-1, 1):.3g}") if space else 0.0,
                "turn": float(f"{angle:.3g}") if rotates else 0.0,
            }
            | ({"friction": pick(0.5, 1.5, of=rng)} if changes else {})
        )
    scene: Scene = {
        "seed": seed,
        "kinematics": "finite",
        "bulk": bulk,
        "layout": "corner" if len(contacts) > 1 else "floor",
        "cell": cell,
        "degree": degree,
        "nu": within(0.0, 0.45),
        "bodies": [body],
        "ranks": ranks,
        "units": [1.0, 1.0],
        "drive": drive,
        "contacts": contacts,
        "dirichlet": conditions,
        "strain": strain,
        "load_ratio": 1.0,
        "stages": stages,
        "cuts": pick(1, 3, 5, of=rng),
    }
    total = sum(s["steps"] for s in stages)
    if chance(0.3, "restart", of=rng) and total > 1:
        scene["restart"] = int(rng.integers(1, total))
    if chance(0.25, "units", of=rng):
        scene["units"] = [log(-4, 4), log(-6, 6)]
    if chance(0.3, "method", of=rng):
        scene["method"] = pick("newton", "newton", "lbfgs", "continuation", of=rng)
    if chance(0.2, of=rng):
        scene["condensation"] = False
    if chance(0.1):
        scene["thickness"] = log(-2, 2)
    if chance(0.05, "max_iterations", of=rng):
        scene["max_iterations"] = int(rng.integers(4, 12))
    return scene | draw_form(seed, family, without)


# ---- obstacles -----------------------------------------------------------------------------------


def initial_geometry(scene: Scene, contact: Scene) -> dict[str, Any]:
    """Return the geometry of an obstacle in its first position, scaled by the unit of length."""
    body, given = scene["bodies"][contact.get("body", 0)], contact["obstacle"]
    length, d = scene["units"][0], len(body["size"])
    if given["kind"] == "rod":
        return obstacle_geometry(scene, contact)
    size, kind = np.array(body["size"], dtype=float), given["kind"]
    unit = np.eye(d)
    if contact["side"] == "right":
        point = (size[0] + given["clearance"]) * unit[0]
        return {"point": point * length, "normal": -unit[0]}
    up, middle = unit[-1], 0.5 * size * (1 - unit[-1])
    clearance = given["clearance"]
    if kind == "halfspace":
        slope = given.get("slope", 0.0)
        normal = (up - slope * unit[0]) / np.hypot(1.0, slope)
        corner = np.array(body["origin"]) + (size[0] * unit[0] if slope > 0 else 0.0)
        return {"point": (corner - clearance * normal) * length, "normal": normal}
    radius = given["radius"] * max(size[:-1])
    if kind.endswith("inside"):
        # The vertices of the bottom touch the cavity.
        across = size[:-1] if kind.startswith("ball") else size[:1]
        reach = 0.5 * float(np.linalg.norm(across))
        radius = max(radius, 1.2 * reach)
        height = np.sqrt(radius**2 - reach**2) - clearance
        where = {"center": middle + height * up, "radius": radius}
    elif kind == "capsule":  # along x, below the middle of the body
        half = 0.5 * radius * unit[0]
        centre = middle - (radius + clearance) * up
        where = {
            "center": centre,
            "radius": radius,
            "ends": np.stack([centre - half, centre + half]),
        }
    elif kind == "torus":
        where = {"ring": 1.5 * radius, "radius": 0.5 * radius + 0.3}
        where["center"] = middle - (where["radius"] + clearance) * up
    elif kind == "box":  # with one end below the body
        low, high = np.full(d, -2.0), np.full(d, 2.0)
        low[0], low[-1], high[-1] = -3.0, -2.0, -clearance
        high[0] = 0.3 * size[0] + min(given["radius"], 1.0) * size[0] / 2
        centre = np.zeros(d)
        where = {"low": low, "high": high, "center": centre}
    else:
        where = {"radius": radius}
        drop = radius * given.get("flat", 1.0) if "profile" in kind else radius
        where["center"] = middle - (drop + clearance) * up
    where["center"] = where["center"].astype(float)
    return {name: value * length for name, value in where.items()}


def obstacle_points(scene: Scene, contact: Scene) -> tuple[Array, Array]:
    """Return points and, if any, outward facets of an obstacle from data."""
    given, where = contact["obstacle"], initial_geometry(scene, contact)
    kind, d = given["kind"], len(scene["bodies"][0]["size"])
    if kind == "box":
        low, high = where["low"], where["high"]
        if d == 3:
            return box(low, high)
        return np.array([low, [high[0], low[1]], high, [low[0], high[1]]]), ring(4)
    radius, centre = where["radius"], where["center"]
    n = given["points"]
    if kind == "facets":
        if d == 3:
            return ball(1 if n < 24 else 2, radius, centre)
        t = 2 * np.pi * (np.arange(n) + 0.3) / n
        return centre + radius * np.column_stack([np.cos(t), np.sin(t)]), ring(n)
    flat = given["flat"]
    if kind == "turned profile":
        t = np.linspace(-np.pi / 2, np.pi / 2, n // 2 + 1)
    else:
        t = 2 * np.pi * np.arange(n) / n
    points = np.zeros((len(t), d))
    points[:, 0], points[:, -1] = radius * np.cos(t), flat * radius * np.sin(t)
    if kind == "turned profile":  # exactly on the axis
        points[[0, -1], 0] = 0.0
    return centre + points, np.zeros((0, d), dtype=int)


class FiniteSetup(SceneSetup):
    """Mesh, forms, conditions and constants of a scene.

    Attributes:
        angle: Angle of the lower obstacle (radians).
    """

    LEVELS = (*SceneSetup.LEVELS, "turn")

    def __init__(self, scene: Scene, comm: MPI.Comm, *, bulk: Any = None) -> None:
        """Create mesh, forms, conditions and constants. Collective.

        Args:
            scene: The scene.
            comm: Communicator.
            bulk: Function of u, v, E and ν: virtual work of rubber per volume (UFL); by default
                that of the package.
        """
        self._rubber = scene["bulk"] == "rubber"
        self._density = bulk
        super().__init__(scene, comm)
        self.angle = _constant(self.mesh, 0.0)

    def bulk(self, E: Any, dx: ufl.Measure) -> ufl.Form:
        """Return the virtual work of the stresses."""
        if not self._rubber:
            return super().bulk(E, dx)
        dx = dx(metadata={"quadrature_degree": DEGREE})
        if self._density is not None:
            return self.thickness * self._density(self.u, self.v, E, self.nu) * dx
        kind = "plane strain" if self.d == 2 else "3D"
        return self.thickness * NeoHookean(self.u, E, self.nu, kind).residual(self.v, dx)

    def bulk_of_energy(self, E: Any, dx: ufl.Measure) -> ufl.Form:
        """Return `bulk` as the derivative of an energy."""
        return self.bulk(E, dx) if self._rubber else super().bulk_of_energy(E, dx)

    def apply(self, stage: int, t: float) -> None:
        """Set all loads for a stage and a load parameter."""
        scene, d = self.scene, self.d
        self.set_friction(stage)
        now, size = self.load_levels(stage, t), np.array(scene["bodies"][0]["size"])
        direction = np.zeros(d)
        direction[0] = now["side"] * size[0]
        if d == 3:
            direction[1] = now["across"] * size[1]
        down = now["normal"] * scene["strain"] * size[-1]
        up = np.eye(d)[-1]
        self.angle.value = now["turn"]
        by_body, by_obstacle = np.zeros(d), np.zeros(d)
        if scene["drive"] == "prescribed":
            by_body = -down * up
            moving = {c["obstacle"].get("moving") for c in scene["contacts"]}
            if not moving & {"displacement", "force"}:
                by_body = by_body + direction
            else:
                by_obstacle = -direction
        elif scene["drive"] == "obstacle":
            by_obstacle = down * up - direction
        else:
            pull = -now["normal"] * scene["strain"] * up
            rows = self.traction.x.array.reshape(-1, d)
            rows[self._cells] = pull * self.moduli[0]
            by_obstacle = -direction
        for _, i, value in self.moved:
            value.value = by_body[i] * self.length
        self.shift.value[:] = by_obstacle * self.length
        area = np.prod(size[:-1]) * self.length ** (d - 1) * self.thickness.value
        force = now["normal"] * scene["strain"] * self.moduli[0] * area
        for i in range(d):
            self.obstacle_force[i].value = max(
                force, 0.02 * scene["strain"] * self.moduli[0] * area
            )
            self.obstacle_motion[i].value = by_obstacle[i] * self.length
        self.apply_additional_features(stage, t)

    def rotation_axis(self, contact: Scene) -> tuple[Array, Array | None] | None:
        """Return a point on the axis of rotation and its direction, or None without rotation."""
        given = contact["obstacle"]
        if "turn" not in given:
            return None
        where = initial_geometry(self.scene, contact)
        if given["turn"] == "middle":
            about = where["center"]
        else:  # a point near the middle of the bottom
            size = np.array(self.scene["bodies"][0]["size"])
            about = (size * (0.4 - 0.5 * np.eye(self.d)[-1])) * self.length
        axis = None if self.d == 2 else np.array(given["about"])
        if axis is not None and given["turn"] == "middle" and given["kind"].startswith("cylinder"):
            axis = np.array(given.get("axis", (0.0, 1.0, 0.0)))
        return about, axis

    def obstacle(self, contact: Scene) -> Any:
        """Return the obstacle of a contact."""
        given, where, d = contact["obstacle"], initial_geometry(self.scene, contact), self.d
        move: dict[str, Any] = {}
        if given.get("moving") == "displacement":
            move["displacement"] = self.shift
        elif given.get("moving") == "translated":
            move["displacement"] = self.translation
        elif given.get("moving") == "force":
            free = given["free"]
            move["displacement"] = fc.Motion(
                force=[self.obstacle_force[i] if i in free else None for i in range(d)],
                displacement=[None if i in free else self.obstacle_motion[i] for i in range(d)],
            )
        rotation = self.rotation_axis(contact)
        if rotation is not None:
            about, axis = rotation
            move["rotation"] = fc.Rotation(
                self.angle, about.tolist(), None if axis is None else axis.tolist()
            )
        kind = given["kind"]
        if kind == "halfspace":
            return fc.HalfSpace(where["point"], where["normal"], **move)
        inside = kind.endswith("inside")
        if kind.startswith("ball"):
            return fc.Ball(where["center"], where["radius"], inside=inside, **move)
        if kind.startswith("cylinder"):
            axis = None if d == 2 else given.get("axis", (0.0, 1.0, 0.0))
            return fc.Cylinder(where["center"], where["radius"], axis, inside=inside, **move)
        if kind in ("capsule", "rod", "torus"):
            shape = _torus if kind == "torus" else capsule_gap
            return fc.SignedDistance(lambda x: shape(self.mesh, where, x), **move)
        points, numbers = obstacle_points(self.scene, contact)
        if kind in ("facets", "box"):
            return fc.RigidSurface(points, numbers, **move)
        if d == 2:
            return fc.RigidProfile(points, closed=True, **move)
        if kind == "profile":  # viewed along -y, where x points to the left
            return fc.RigidProfile(points[::-1], closed=True, extruded=(0.0, 1.0, 0.0), **move)
        return fc.RigidProfile(points, turned=(where["center"].tolist(), (0.0, 0.0, 1.0)), **move)

    def options(self, contact: Scene) -> dict[str, Any]:
        """Return additional arguments of a contact."""
        return {"kinematics": "finite"}


def _constant(mesh: Any, value: Any) -> Any:
    from dolfinx import fem

    return fem.Constant(mesh, value)


def _torus(mesh: Any, where: dict[str, Any], x: Any) -> Any:
    """Return the signed distance from a torus about z (UFL)."""
    # The centreline passes below the middle of the body.
    centre = where["center"].copy()
    centre[0] -= where["ring"]
    c = _constant(mesh, centre)
    around, tube = (_constant(mesh, float(where[n])) for n in ("ring", "radius"))
    out = ufl.sqrt((x[0] - c[0]) ** 2 + (x[1] - c[1]) ** 2) - around
    return ufl.sqrt(out**2 + (x[2] - c[2]) ** 2) - tube
