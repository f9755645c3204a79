"""Random scenes of two bodies with finite sliding: a block pressed on a slab, slid and rotated.

A scene is a dictionary as in `fuzz_scenes`, with ``"kinematics": "finite sliding"``. The bottom of
the slab is fixed; the top of the block has a prescribed displacement, or is pressed by a force.
Stages also have the angle of the block ("turn") and that of both bodies together ("spin").
"""

from __future__ import annotations

from typing import Any

import numpy as np
from dolfinx import fem
from mpi4py import MPI

from verification.finite_scenes import FiniteSetup
from verification.fuzz_scenes import Scene, draw_element, draw_form, make_samplers
from verification.fuzz_setup import SceneSetup

__all__ = ["SlidingSetup", "draw", "rotation_matrix"]

Array = np.ndarray


def draw(
    seed: int,
    *,
    without: tuple[str, ...] = (),
    ranks: int = 1,
    family: int | None = None,
    extreme: bool = False,
) -> Scene:
    """Draw a random scene.

    Args:
        seed: Seed that determines the scene.
        without: Features to exclude: "space", "rubber", "bend", "spin", "rock", "multipliers",
            "units", "restart", "method", "max_iterations", "edge", "stiff", "fine", "form".
        ranks: Number of ranks, stored in the scene.
        family: Family of scenes with a common structure, as for `fuzz_scenes.draw`.
        extreme: Whether the bodies are made dissimilar by `_make_dissimilar`.
    """
    rng = np.random.default_rng([seed, 40])
    structure = rng if family is None else np.random.default_rng([family, 41])

    chance, pick, log, within = make_samplers(rng, structure, without)
    space, cell, degree = draw_element(chance, pick, 0.2)
    d = 3 if space else 2
    strain = log(-3, -0.9)

    # Either body may have the finer mesh or the higher modulus.
    most = 2 if space else (8 if degree == 1 else 5)
    coarse = int(rng.integers(1, 3))
    fine = int(rng.integers(2, most + 1))
    if not space and chance(0.15, "fine", of=rng):
        coarse, fine = 1, 20
    counts = [coarse, fine] if chance(0.5, of=rng) else [fine, coarse]
    size = [within(1.2, 2.0) for _ in range(d)]
    size[-1] = within(0.6, 1.2)
    slab = {"origin": [0.0] * d, "size": size, "n": [counts[0]] * (d - 1) + [2]}
    width = within(0.25, 0.6) * size[0]
    free_width = size[0] - width
    block = {"origin": [0.0] * d, "size": [width] * d, "n": [counts[1]] * (d - 1) + [2]}
    block["origin"] = [within(0.1, 0.9) * free_width] + [0.5 * (s - width) for s in size[1:]]
    clearance = within(-0.2, 1.0) * strain * width if chance(0.3, of=rng) else 0.0
    block["origin"][-1] = float(f"{size[-1] + clearance:.6g}")
    stiff = log(0, 3.5) if chance(0.3, "stiff", of=rng) else log(-0.5, 0.5)
    moduli = [1.0, stiff] if chance(0.5, of=rng) else [stiff, 1.0]
    for body, modulus in zip((slab, block), moduli, strict=True):
        body |= {"E": 100.0 * modulus, "jitter": 0}
        if chance(0.4, of=rng):
            body["jitter"] = int(rng.integers(1, 1000))

    law: Scene = {"kind": pick("frictionless", "coulomb", "coulomb", "coulomb", "tresca")}
    law["k_n"] = pick(["scaled", log(-0.5, 1.5)], ["number", log(-0.5, 2)])
    if law["kind"] != "frictionless":
        law["friction"] = pick(0.1, 0.3, 0.3, 0.6, of=rng)
        law["k_t"] = pick(["scaled", log(-0.5, 1.5)], ["number", log(-0.5, 2)])
    if law["kind"] == "tresca":
        law["pressure"] = float(f"{rng.uniform(0.1, 2) * strain:.3g}")
    upper = {"body": 1, "side": "bottom"}
    lower = {"body": 0, "side": "top"}
    own, other = (upper, lower) if chance(0.6) else (lower, upper)
    contact: Scene = own | {"law": law}
    contact["obstacle"] = {"kind": "body", "update_pairs": "never"} | other
    if chance(0.2):
        contact["quadrature"] = pick(2, 3, 5)
    if chance(0.2, "multipliers"):
        contact["enforcement"] = "augmented"

    drive = "force" if chance(0.2) else "prescribed"
    whole = list(range(d))
    conditions: list[list[Any]] = [[0, "bottom", whole, "fixed"]]
    conditions.append([1, "top", whole[:-1] if drive == "force" else whole, "moved"])
    scene: Scene = {
        "seed": seed,
        "kinematics": "finite sliding",
        "bulk": "rubber" if chance(0.6, "rubber") else "linear",
        "layout": "two",
        "cell": cell,
        "degree": degree,
        "nu": within(0.0, 0.45),
        "bodies": [slab, block],
        "ranks": ranks,
        "units": [1.0, 1.0],
        "drive": drive,
        "contacts": [contact],
        "dirichlet": conditions,
        "strain": strain,
        "load_ratio": 1.0,
        "cuts": pick(1, 3, 5, of=rng),
    }
    if chance(0.4, "bend") and cell != "hexahedron":
        scene["bend"] = [within(-0.05, 0.05), within(0.0, 0.15)]

    # Stages: strain of the block, sliding distance in its widths, and angles (radians).
    far = pick(strain, 0.1, 0.5, of=rng)
    if chance(0.2, "edge", of=rng):
        far = 1.5
    rocks, spins = (
        chance(share, feature, of=rng) and drive == "prescribed"
        for share, feature in ((0.3, "rock"), (0.3, "spin"))
    )
    stages, rock, spin = [], 0.0, 0.0
    for name in pick(
        ["press"],
        ["press", "shear"],
        ["press", "shear", "reverse"],
        ["press", "turn"],
        ["press", "shear", "turn"],
        ["press", "lift", "press"],
        ["press", "shear", "lift", "press"],
        ["both", "ease", "both"],
        of=rng,
    ):
        normal, side = {
            "press": (1.0, 0.0),
            "shear": (1.0, rng.uniform(0.2, 1.0)),
            "reverse": (1.0, -rng.uniform(0.2, 1.0)),
            "turn": (1.0, rng.uniform(-0.2, 0.2)),
            "lift": (-0.3 if drive != "force" else 0.3, 0.0),
            "ease": (0.4, rng.uniform(0, 0.3)),
            "both": (1.0, rng.uniform(-1, 1)),
        }[name]
        if name in ("turn", "both"):
            rock += strain * rng.uniform(-1, 1) * rocks
            # Rotation causes swelling of a linear body.
            spin += rng.uniform(-1.5, 1.5) * spins * (1.0 if scene["bulk"] == "rubber" else 0.2)
        stages.append(
            {
                "steps": int(rng.integers(2, 6)),
                "normal": normal,
                "side": float(f"{side * far:.3g}"),
                "across": float(f"{side * far * rng.uniform(-1, 1):.3g}") if space else 0.0,
                "turn": float(f"{rock:.3g}"),
                "spin": float(f"{spin:.3g}"),
            }
        )
    scene["stages"] = stages
    total = sum(s["steps"] for s in stages)
    if chance(0.3, "restart", of=rng):
        scene["restart"] = int(rng.integers(1, total))
    if chance(0.25, "units", of=rng):
        scene["units"] = [log(-4, 4), log(-6, 6)]
    if chance(0.2, "method", of=rng):
        scene["method"] = pick("newton", "lbfgs", "continuation", of=rng)
    if chance(0.1):
        scene["thickness"] = log(-2, 2)
    if chance(0.05, "max_iterations", of=rng):
        scene["max_iterations"] = int(rng.integers(4, 12))
    if extreme:
        _make_dissimilar(scene, np.random.default_rng([seed, 42]))
    return scene | draw_form(seed, family, without)


def _make_dissimilar(scene: Scene, rng: np.random.Generator) -> None:
    """Make facets up to 20 times as wide, and moduli 1e3 to 1e6 times as large, as the others.

    The block is nearly as wide as the slab, to limit the number of cells. The largest ratio of
    widths is 10 for degree 2, and 4 in 3D.
    """
    slab, block = scene["bodies"]
    block_size, slab_width = block["size"], slab["size"][0]
    block_size[0] = float(f"{rng.uniform(0.6, 0.9) * slab_width:.3g}")
    block["origin"][0] = float(f"{rng.uniform(0.0, 1.0) * (slab_width - block_size[0]):.3g}")
    fine, coarse = (slab, block) if rng.random() < 0.5 else (block, slab)
    most = 4 if len(block_size) == 3 else 20 / scene["degree"]
    ratio = most ** rng.uniform(0.5, 1.0)
    for body, n in ((coarse, 1), (fine, round(ratio * fine["size"][0] / coarse["size"][0]))):
        body["n"][:-1] = [max(n, 1)] * (len(block_size) - 1)
    soft, stiff = (slab, block) if rng.random() < 0.5 else (block, slab)
    soft["E"], stiff["E"] = 100.0, float(f"{100 * 10 ** rng.uniform(3.0, 6.0):.3g}")


def rotation_matrix(d: int, angle: float) -> Array:
    """Return the matrix of a rotation in the plane of the first and the last axis."""
    c, s = np.cos(angle), np.sin(angle)
    found = np.eye(d)
    found[0, 0], found[0, -1], found[-1, 0], found[-1, -1] = c, -s, s, c
    return found


class SlidingSetup(FiniteSetup):
    """Mesh, forms, conditions and constants of a scene of two bodies."""

    LEVELS = (*FiniteSetup.LEVELS, "spin")

    def __init__(self, scene: Scene, comm: MPI.Comm, *, bulk: Any = None) -> None:
        """Create mesh, forms, conditions and constants, as `FiniteSetup` does. Collective."""
        super().__init__(scene, comm, bulk=bulk)
        self._moved_bodies: list[tuple[int, Any]] = []
        if scene["drive"] == "prescribed":  # rotations vary in space
            self.bcs = list(self.unrelated_bcs)
            for body, side, *_ in scene["dirichlet"]:
                value = fem.Function(self.V)
                facets = self.facets_of(body, side)
                dofs = fem.locate_dofs_topological(self.V, self.d - 1, facets)
                self.bcs.append(fem.dirichletbc(value, dofs))
                self._moved_bodies.append((body, value))

    def apply(self, stage: int, t: float) -> None:
        """Set loads and Dirichlet values at a load parameter of a stage."""
        scene, d, now = self.scene, self.d, self.load_levels(stage, t)
        slab, block = scene["bodies"][:2]
        direction = np.zeros(d)
        direction[0] = now["side"] * block["size"][0]
        if d == 3:
            direction[1] = now["across"] * block["size"][1]
        down = now["normal"] * scene["strain"]
        if scene["drive"] == "force":
            rows = self.traction.x.array.reshape(-1, d)
            rows[self._cells] = -down * min(self.moduli[: self.n_scene_bodies]) * np.eye(d)[-1]
            for _, i, value in self.moved:
                value.value = direction[i] * self.length
            self.apply_additional_features(stage, t)
            return
        direction[-1] = -down * block["size"][-1]
        middle = 0.5 * np.array(slab["size"]) * self.length
        pivot = (np.array(block["origin"]) + 0.5 * np.array(block["size"])) * self.length
        whole, own = rotation_matrix(d, now["spin"]), rotation_matrix(d, now["turn"])
        x = self.V.tabulate_dof_coordinates()[:, :d]
        self.apply_additional_features(stage, t)
        for body, value in self._moved_bodies:
            place = x
            if body == 1:
                place = pivot + (x - pivot) @ own.T + direction * self.length
            moved = middle + (place - middle) @ whole.T + self.translation.value - x
            value.x.array[:] = moved.ravel()

    def obstacle(self, contact: Scene) -> Any:
        """Return the opposing body."""
        return SceneSetup.obstacle(self, contact)
