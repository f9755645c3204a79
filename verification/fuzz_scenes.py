"""Random scenes of contact as plain dictionaries, and what the package makes of them.

A scene is boxes that share no node, contacts between them or with rigid supports, and stages of
loads. It is JSON all through, so that an old failure can be played again whatever `draw` has become
since. Lengths and forces are drawn in the scene's own units and scaled by ``units`` when the scene
is made.
"""

from __future__ import annotations

import copy
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import basix.ufl
import dolfinx
import numpy as np
import scipy.spatial
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact import compat
from fenics_contact.types import Array
from verification import reference_solver as reference

__all__ = [
    "LAWS",
    "SUPPORTS",
    "Made",
    "dice",
    "draw",
    "element",
    "frictions",
    "history",
    "model",
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
            "ration", "space", "method", "accuracy".
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

    drive = pick("force", "force", "prescribed", "support")
    if layout in ("pair", "tower", "apart") and drive == "support":
        drive = "force"
    if "motion" in without and drive == "support":
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

    def contact(body: int, side: str, support: Scene) -> Scene:
        made: Scene = {"body": body, "side": side, "support": support, "law": law()}
        springs = chance(0.1)
        if springs:
            made["scheme"] = "vertex"
            for k in ("k_n", "k_t"):
                if made["law"].get(k) and chance(0.7):
                    made["law"][k] = ["springs", log(-1, 2)]
        elif chance(0.15):
            made["scheme"] = "vertex"
        elif chance(0.15):
            made["quadrature"] = pick(1, 3, 5)
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
        support: Scene = {"kind": "body", "update": update}
        if chance(0.6):
            contacts.append(contact(upper, "bottom", support | {"body": upper - 1, "side": "top"}))
        else:
            contacts.append(contact(upper - 1, "top", support | {"body": upper, "side": "bottom"}))
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
            if c["support"].get("update") == "increment":
                c["support"]["update"] = "never"
    if layout == "pair" and chance(0.12, "both"):
        first = contacts[0]
        other = copy.deepcopy(first)
        other |= {"body": first["support"]["body"], "side": first["support"]["side"]}
        other["support"] |= {"body": first["body"], "side": first["side"]}
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
        elif drive == "support":
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
    if drive == "support":
        moves = contacts[0]["support"]
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
    return scene


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


# ---- meshes --------------------------------------------------------------------------------------


def _arrays(scene: Scene) -> tuple[Array, Array, Array]:
    """Vertices, cells in DOLFINx's order, and the box of every cell."""
    d = len(scene["bodies"][0]["size"])
    length = scene["units"][0]
    points, cells, boxes, first = [], [], [], 0
    for b, body in enumerate(scene["bodies"]):
        n = body["n"]
        lines = [np.linspace(0, 1, k + 1) for k in n]
        grid = np.stack([g.ravel() for g in np.meshgrid(*lines, indexing="ij")], axis=1)
        if body["jitter"]:
            rng = np.random.default_rng(body["jitter"])
            move = 0.4 * rng.uniform(-1, 1, grid.shape) / np.array(n)
            grid = grid + np.where((grid > 0) & (grid < 1), move, 0.0)
        number = np.arange(len(grid)).reshape([k + 1 for k in n])
        bricks = []
        for corner in range(2**d):  # the first coordinate runs fastest
            cut = tuple(slice(corner >> i & 1, n[i] + (corner >> i & 1)) for i in range(d))
            bricks.append(number[cut].ravel())
        found = np.column_stack(bricks)
        if scene["cell"] == "triangle":
            found = np.concatenate([found[:, [0, 1, 3]], found[:, [0, 3, 2]]])
        elif scene["cell"] == "tetrahedron":
            six = [
                [0, 1, 3, 7],
                [0, 1, 7, 5],
                [0, 5, 7, 4],
                [0, 3, 2, 7],
                [0, 6, 4, 7],
                [0, 2, 6, 7],
            ]
            found = np.concatenate([found[:, s] for s in six])
        points.append((np.array(body["origin"]) + grid * body["size"]) * length)
        cells.append(found + first)
        boxes.append(np.full(len(found), b))
        first += len(grid)
    return np.concatenate(points), np.concatenate(cells).astype(np.int64), np.concatenate(boxes)


def _quadratic(cell: str, x: Array, cells: Array, boxes: Array) -> tuple[Array, Array, Array]:
    """The same mesh with nodes of degree 2."""
    element = basix.ufl.element("Lagrange", cell, 1, shape=(x.shape[1],))
    straight = dolfinx.mesh.create_mesh(MPI.COMM_SELF, cells=cells, x=x, e=ufl.Mesh(element))
    nodes = fem.functionspace(straight, ("Lagrange", 2))
    places = nodes.tabulate_dof_coordinates()[:, : x.shape[1]]
    return places, nodes.dofmap.list.astype(np.int64), boxes[straight.topology.original_cell_index]


_SIDES = {
    "bottom": (-1, 0.0),
    "top": (-1, 1.0),
    "left": (0, 0.0),
    "right": (0, 1.0),
    "front": (1, 0.0),
}


def _tag(scene: Scene, body: int, side: str) -> int:
    """Tag of a side: contacts are 11, 12 …; what lies opposite 21, 22 …; loaded tops `TOP`."""
    for i, contact in enumerate(scene["contacts"]):
        if (contact["body"], contact["side"]) == (body, side):
            return 11 + i
    for i, contact in enumerate(scene["contacts"]):
        support = contact["support"]
        if support["kind"] == "body" and (support["body"], support["side"]) == (body, side):
            return 21 + i
    return TOP if side == "top" else 100 + 10 * body + list(_SIDES).index(side)


class Made:
    """A scene as mesh, forms and constants, on any number of ranks."""

    def __init__(self, scene: Scene, comm: MPI.Comm) -> None:
        """Make mesh, bulk form and conditions. Collective."""
        self.scene, self.comm = scene, comm
        self.length, self.force = scene["units"]
        x, cells, boxes = _arrays(scene)
        self.d = d = x.shape[1]
        bent = any(scene.get("bend", ()))
        if bent:
            x, cells, boxes = _quadratic(scene["cell"], x, cells, boxes)
        element = basix.ufl.element("Lagrange", scene["cell"], 1 + bent, shape=(d,))
        element = ufl.Mesh(element)
        mine = slice(None) if comm.rank == 0 else slice(0, 0)
        self.mesh = dolfinx.mesh.create_mesh(comm, cells=cells[mine], x=x[mine], e=element)
        self.box = boxes[self.mesh.topology.original_cell_index]
        self.tags = self._tagged()
        if bent:
            self._bend()
        self.stress = self.force / self.length ** (d - 1)
        self.V = fem.functionspace(self.mesh, ("Lagrange", scene["degree"], (d,)))
        self.u = fem.Function(self.V, name="u")
        v = ufl.TestFunction(self.V)
        piecewise = fem.functionspace(self.mesh, ("DG", 0))
        vectors = fem.functionspace(self.mesh, ("DG", 0, (d,)))
        self.E = fem.Function(piecewise)
        n_cells = len(self.box)
        moduli = np.array([b["E"] for b in scene["bodies"]]) * self.stress
        self.moduli = moduli
        self.E.x.array[piecewise.dofmap.list[:n_cells, 0]] = moduli[self.box]
        self.traction, self.weight = fem.Function(vectors), fem.Function(vectors)
        self._cells = vectors.dofmap.list[:n_cells, 0]
        nu = fem.Constant(self.mesh, scene["nu"])
        strain = ufl.sym(ufl.grad(self.u))
        lame = self.E * nu / ((1 + nu) * (1 - 2 * nu))
        stress = self.E / (1 + nu) * strain + lame * ufl.tr(strain) * ufl.Identity(d)
        ds = ufl.ds(self.mesh, subdomain_data=self.tags)
        self.thickness = fem.Constant(self.mesh, float(scene.get("thickness", 1.0)))
        self.F = self.thickness * ufl.inner(stress, ufl.sym(ufl.grad(v))) * ufl.dx(self.mesh)
        self.F -= self.thickness * ufl.dot(self.traction, v) * ds(TOP)
        self.F -= self.thickness * ufl.dot(self.weight, v) * ufl.dx(self.mesh)
        self.bcs: list[fem.DirichletBC] = []
        self.moved: list[fem.Constant] = []
        for body, side, components, how in scene["holds"]:
            facets = self.facets_of(body, side)
            for i in components:
                value = fem.Constant(self.mesh, 0.0)
                space = self.V.sub(i)
                dofs = fem.locate_dofs_topological(space, d - 1, facets)
                self.bcs.append(fem.dirichletbc(value, dofs, space))
                if how == "moved":
                    self.moved.append((body, i, value))
        self.contacts: list[fc.Contact] = []
        self.shift = fem.Constant(self.mesh, np.zeros(d))
        self.push = [fem.Constant(self.mesh, 0.0) for _ in range(d)]
        self.pull = [fem.Constant(self.mesh, 0.0) for _ in range(d)]

    def outside(self) -> fem.Form:
        """Forces of the loads: what of -F is left without displacements."""
        return fem.form(-ufl.replace(self.F, {self.u: fem.Function(self.V)}))

    def facets_of(self, body: int, side: str) -> Array:
        """Facets of a side of a body; tops share a tag."""
        facets = self.tags.find(_tag(self.scene, body, side))
        return facets[np.isin(self.cell_of(facets), np.flatnonzero(self.box == body))]

    def _bend(self) -> None:
        """Move the nodes of bodies up by a parabola over x."""
        x = self.mesh.geometry.x
        done = np.zeros(len(x), dtype=bool)
        for b, (body, rise) in enumerate(
            zip(self.scene["bodies"], self.scene["bend"], strict=True)
        ):
            nodes = np.unique(compat.geometry_dofmap(self.mesh)[self.box == b])
            nodes = nodes[~done[nodes]]
            done[nodes] = True
            middle = (body["origin"][0] + 0.5 * body["size"][0]) * self.length
            width = body["size"][0] * self.length
            x[nodes, self.d - 1] += rise * width * (2 * (x[nodes, 0] - middle) / width) ** 2

    def cell_of(self, facets: Array) -> Array:
        """One of the cells of every facet."""
        to_cell = self.mesh.topology.connectivity(self.d - 1, self.d)
        return np.array([to_cell.links(f)[0] for f in facets], dtype=int)

    def _tagged(self) -> dolfinx.mesh.MeshTags:
        mesh, d = self.mesh, self.d
        mesh.topology.create_connectivity(d - 1, d)
        exterior = dolfinx.mesh.exterior_facet_indices(mesh.topology)
        box = self.box[self.cell_of(exterior)]
        middle = dolfinx.mesh.compute_midpoints(mesh, d - 1, exterior)[:, :d] / self.length
        values = np.zeros(len(exterior), dtype=np.int32)
        for b, body in enumerate(self.scene["bodies"]):
            for side, (axis, end) in _SIDES.items():
                if d == 2 and side == "front":
                    continue
                at = body["origin"][axis] + end * body["size"][axis]
                here = (box == b) & (np.abs(middle[:, axis] - at) < 1e-8)
                values[here] = _tag(self.scene, b, side)
        kept = values > 0
        return dolfinx.mesh.meshtags(mesh, d - 1, exterior[kept], values[kept])

    # ---- loads -------------------------------------------------------------------------------

    def drives(self, stage: int, t: float) -> dict[str, float]:
        """Normal, side and across at a value of the load parameter within a stage."""
        stages = self.scene["stages"]
        zero = {"normal": 0.0, "side": 0.0, "across": 0.0}
        before = stages[stage - 1] if stage else zero
        return {n: before[n] + t * (stages[stage][n] - before[n]) for n in zero}

    def apply(self, stage: int, t: float) -> None:
        """Set all loads."""
        scene, d = self.scene, self.d
        for contact, friction in zip(self.contacts, frictions(scene, stage), strict=False):
            if friction is not None:
                contact.parameters["friction"].value = friction
        now = self.drives(stage, t)
        way = np.zeros(d)
        way[0], way[-1] = now["side"], -now["normal"]
        if d == 3:
            way[1] = now["across"]
        strain, driven = scene["strain"], self.driven()
        tractions = np.zeros((len(scene["bodies"]), d))
        pulled = scene["drive"] == "force"
        for k, b in enumerate(driven):
            share = scene["share"] if k else 1.0
            if pulled:
                tractions[b] = way * strain * self.moduli[b] * share
        self.traction.x.array.reshape(-1, d)[self._cells] = tractions[self.box]
        heavy = np.zeros(d)
        heavy[-1] = -scene.get("weight", 0.0) * strain * self.stress / self.length
        self.weight.x.array.reshape(-1, d)[self._cells] = heavy * (t if stage == 0 else 1.0)
        for body, i, value in self.moved:
            share = scene["share"] if driven.index(body) else 1.0
            size = scene["bodies"][body]["size"][-1] * self.length
            value.value = way[i] * strain * size * share
        if scene["drive"] == "support":
            size = scene["bodies"][0]["size"][-1] * self.length
            self.shift.value[:] = -way * strain * size
            area = np.prod(scene["bodies"][0]["size"][:-1]) * self.length ** (d - 1)
            for i in range(d):
                self.push[i].value = -way[i] * strain * self.moduli[0] * area
                self.pull[i].value = -way[i] * strain * size

    def driven(self) -> list[int]:
        """Numbers of the bodies that the loads act on."""
        return [0, 1] if self.scene["layout"] == "apart" else [len(self.scene["bodies"]) - 1]

    # ---- the package -------------------------------------------------------------------------

    def surfaces(self) -> list[fc.ContactSurface]:
        """Γc of every contact."""
        return [
            fc.ContactSurface(
                self.mesh,
                self.tags,
                11 + i,
                quadrature_degree=c.get("quadrature"),
                quadrature_scheme=c.get("scheme"),
            )
            for i, c in enumerate(self.scene["contacts"])
        ]

    def law(self, contact: Scene) -> Any:
        """The package's law."""
        law, unit = contact["law"], self.stress / self.length
        body = self.scene["bodies"][contact["body"]]

        def stiffness(given: Any) -> Any:
            kind, value = given
            if kind == "scaled":
                return fc.Scaled(value)
            if kind == "springs":
                return fc.Springs(value * body["E"] * self.stress * self.length ** (self.d - 2))
            return value * body["E"] * unit

        k = {n: stiffness(law[n]) for n in ("k_n", "k_t") if law.get(n)}
        kind = law["kind"]
        if kind == "frictionless":
            return fc.Frictionless(**k)
        if kind in ("foundation", "tension"):
            return fc.Foundation(**k, tension=kind == "tension")
        shape = {n: law[m] for n, m in _SHAPE.items() if m in law}
        if kind in ("tresca", "prescribed"):
            pressure = law["pressure"] * body["E"] * self.stress
            return fc.Tresca(law["friction"], pressure, **k, unilateral=kind == "tresca")
        return fc.Coulomb(law["friction"], **k, **shape)

    def support(self, contact: Scene) -> Any:
        """The package's support."""
        given = contact["support"]
        if given["kind"] == "body":
            tag = _tag(self.scene, given["body"], given["side"])
            return fc.DeformableBody(self.tags, tag, update=given["update"])
        where = geometry(self.scene, contact)
        shift = None
        if given.get("moving") == "displacement":
            shift = self.shift
        elif given.get("moving") == "force":
            free = given["free"]
            shift = fc.Motion(
                force=[self.push[i] if i in free else None for i in range(self.d)],
                displacement=[None if i in free else self.pull[i] for i in range(self.d)],
            )
        kind = given["kind"].split()[0]
        if kind == "halfspace":
            return fc.HalfSpace(where["point"], where["normal"], displacement=shift)
        if kind == "obstacle":
            x = ufl.SpatialCoordinate(self.mesh)
            numbers = (fem.Constant(self.mesh, float(where[n])) for n in ("gap", "curve", "middle"))
            gap, curve, middle = numbers
            direction = fem.Constant(self.mesh, -np.asarray(where["normal"]))
            return fc.Obstacle(gap + curve * (x[0] - middle) ** 2, direction, displacement=shift)
        inside = given["kind"].endswith("inside")
        if kind == "ball":
            return fc.Ball(where["center"], where["radius"], inside=inside, displacement=shift)
        axis = None if self.d == 2 else (0.0, 1.0, 0.0)
        return fc.Cylinder(
            where["center"], where["radius"], axis, inside=inside, displacement=shift
        )

    def options(self, contact: Scene) -> dict[str, Any]:
        """More arguments of a contact."""
        return {}

    def problem(self) -> fc.ContactProblem:
        """The package's problem. Collective."""
        contacts = []
        for i, (c, surface) in enumerate(zip(self.scene["contacts"], self.surfaces(), strict=True)):
            gap = c.get("gap")
            contacts.append(
                fc.Contact(
                    self.u,
                    surface,
                    self.support(c),
                    self.law(c),
                    gap=None if gap is None else gap * self.length,
                    enforcement=c.get("enforcement"),
                    accuracy=c.get("accuracy"),
                    weight=self.thickness,
                    name=f"contact {i}",
                    **self.options(c),
                )
            )
        self.contacts = contacts
        options, scene = {}, self.scene
        if "ration" in scene:
            options["snes_max_it"] = scene["ration"]
        return fc.ContactProblem(
            self.F,
            self.u,
            bcs=self.bcs,
            contacts=contacts,
            method=scene.get("method"),
            condensation=scene.get("condensation"),
            petsc_options=options,
            fallback="ration" not in scene,
        )


_SHAPE = {"modes": "modes", "transverse_friction": "transverse", "direction": "direction"}


def geometry(scene: Scene, contact: Scene) -> dict[str, Any]:
    """Numbers of a rigid support, in units of length."""
    body, given = scene["bodies"][contact["body"]], contact["support"]
    length, d = scene["units"][0], len(body["size"])
    low = np.array(body["origin"], dtype=float)
    size = np.array(body["size"], dtype=float)
    if contact["side"] == "right":
        point = low + size * np.eye(d)[0] + given["clearance"] * np.eye(d)[0]
        return {"point": point * length, "normal": -np.eye(d)[0]}
    up, middle = np.eye(d)[-1], low + 0.5 * size
    middle[-1] = low[-1]
    clearance = given["clearance"]
    if given["kind"] == "halfspace":
        slope = given.get("slope", 0.0)
        normal = up - slope * np.eye(d)[0]
        normal /= np.linalg.norm(normal)
        # The plane touches the lower corner of the bottom.
        corner = low + (size[0] * np.eye(d)[0] if slope > 0 else 0.0)
        return {"point": (corner - clearance * normal) * length, "normal": normal}
    if given["kind"] == "obstacle":
        return {
            "gap": clearance * length,
            "curve": given["curve"] / length,
            "middle": middle[0] * length,
            "normal": up,
        }
    radius = given["radius"] * max(size[:-1])
    if not given["kind"].endswith("inside"):
        return {"center": (middle - (radius + clearance) * up) * length, "radius": radius * length}
    # The corners of the bottom touch the wall of the cavity.
    across = size[:-1] if given["kind"].startswith("ball") else size[:1]
    reach = 0.5 * float(np.linalg.norm(across))
    radius = max(radius, 1.2 * reach)
    height = np.sqrt(radius**2 - reach**2) - clearance
    return {"center": (middle + height * up) * length, "radius": radius * length}


# ---- what the package makes of it ----------------------------------------------------------------


def gathered(comm: MPI.Comm, rows: Array) -> Array:
    """Rows of all ranks on all ranks."""
    return np.concatenate(comm.allgather(np.asarray(rows)))


def _nodes(made: Made) -> tuple[Array, Array]:
    """Box and place of the owned displacement nodes."""
    dofmap = made.V.dofmap
    n = dofmap.index_map.size_local
    box = np.full(n + dofmap.index_map.num_ghosts, -1)
    box[dofmap.list[: len(made.box)]] = made.box[:, None]
    return box[:n], made.V.tabulate_dof_coordinates()[:n, : made.d]


def _record(
    made: Made, problem: fc.ContactProblem, step: Any, stage: int, t: float
) -> dict[str, Any]:
    """What of a committed step is judged. Collective."""
    comm, d = made.comm, made.d
    box, x = _nodes(made)
    n = len(box)
    u = gathered(comm, np.column_stack([box, x, made.u.x.array.reshape(-1, d)[:n]]))
    contacts = []
    for contact in problem.contacts:
        columns = [contact.points, contact.measure, contact.pressure, contact.tangential_traction]
        if contact.multipliers is not None:
            columns.append(contact.multipliers.fields.values("pressure"))
            if contact.law.has_friction:
                columns.append(contact.multipliers.fields.values("traction"))
                if "normal" in contact.multipliers.fields:
                    columns.append(contact.multipliers.fields.values("normal"))
        rows = gathered(comm, np.column_stack(columns))
        r = step.contacts[contact.name]
        contacts.append(
            {
                "points": rows[:, :d],
                "measure": rows[:, d],
                "pressure": rows[:, d + 1],
                "tangential": rows[:, d + 2 : 2 * d + 2],
                "lambda_n": rows[:, 2 * d + 2] if contact.multipliers is not None else None,
                "lambda_t": rows[:, 2 * d + 3 : 3 * d + 3]
                if contact.multipliers is not None
                else None,
                "lambda_at": rows[:, 3 * d + 3 :],
                "tolerance": contact.tolerance,
                "force": np.array(r.force),
                "normal_force": r.normal_force,
                "tangential_force": r.tangential_force,
                "area": r.area,
                "motion": {i: float(c.value) for i, c in contact.free_motion.items()},
                "unpaired": contact.n_unpaired,
                "error": contact.accuracy.error if contact.accuracy else None,
            }
        )
    return {
        "stage": stage,
        "load": t,
        "u": u,
        "contacts": contacts,
        "energy": step.energy,
        "rtol": problem.accuracy.rtol if problem.accuracy else 1e-9,
        "attempts": [str(r) for r in step.attempts],
        "method": step.method,
        "iterations": step.iterations,
        "summary": step.summary() if step.verdict.force > 0 else "",
    }


def history(
    scene: Scene,
    comm: MPI.Comm,
    done: Callable[[dict[str, Any]], None],
    changed: Any = None,
    make: type[Made] = Made,
) -> None:
    """Solve a scene by the package; ``done`` gets every committed increment. Collective.

    Args:
        scene: The scene.
        comm: Ranks.
        done: Called on all of them.
        changed: Function of the `Made` scene and its problem, to spoil them (tests).
        make: What makes the scene.
    """
    made = make(scene, comm)
    problem = made.problem()
    if changed is not None:
        changed(made, problem)
    stop, number = scene.get("restart"), 0
    with tempfile.TemporaryDirectory() as folder:
        folder = comm.bcast(folder)
        for stage, what in enumerate(scene["stages"]):
            file = Path(folder) / f"stage{stage}.npz"

            def steps(
                made: Made,
                problem: Any,
                stage: int = stage,
                n: int = what["steps"],
                file: Any = file,
            ) -> Any:
                return fc.increments(
                    problem,
                    lambda t: made.apply(stage, t),
                    steps=n,
                    max_cuts=scene.get("cuts", 1),
                    checkpoint=file if stop is not None else None,
                )

            run = steps(made, problem)
            while True:
                step = next(run, None)
                if step is None:
                    break
                done(_record(made, problem, step, stage, step.load))
                number += 1
                if number == stop:
                    run.close()
                    made = make(scene, comm)
                    problem = made.problem()
                    run = steps(made, problem)
        comm.barrier()


# ---- the same for the reference ------------------------------------------------------------------


def _scaled(value: float | None, contact: Scene) -> float:
    """Factor of E/h."""
    if value is not None:
        return value
    wanted = contact.get("accuracy")
    return fc.Accuracy.of(wanted).factor if wanted else 10.0


def body_of(made: Made) -> tuple[reference.Body, Callable[[int], reference.Surface]]:
    """Arrays of a made scene, and its surfaces by their tags. On one rank."""
    scene, d, V = made.scene, made.d, made.V
    tangent = ufl.derivative(made.F, made.u, ufl.TrialFunction(V))
    stiffness = fem.assemble_matrix(fem.form(tangent)).to_scipy().toarray()
    parts = np.zeros(len(V.tabulate_dof_coordinates()), dtype=int)
    parts[V.dofmap.list] = made.box[:, None]
    body = reference.Body(
        cell=scene["cell"],
        degree=scene["degree"],
        x=made.mesh.geometry.x[:, :d].copy(),
        vertices=np.array(compat.geometry_dofmap(made.mesh)),
        nodes=np.array(V.dofmap.list),
        places=V.tabulate_dof_coordinates()[:, :d].copy(),
        parts=parts,
        stiffness=0.5 * (stiffness + stiffness.T),
        bent=compat.geometry_element(made.mesh).degree,
    )
    made.mesh.topology.create_connectivity(d, d - 1)
    to_facet = made.mesh.topology.connectivity(d, d - 1)

    def surface(tag: int) -> reference.Surface:
        facets = made.tags.find(tag)
        cells = made.cell_of(facets)
        local = [
            int(np.flatnonzero(to_facet.links(c) == f)[0])
            for c, f in zip(cells, facets, strict=False)
        ]
        return reference.Surface(body, list(zip(cells.tolist(), local, strict=False)))

    return body, surface


def model(scene: Scene) -> tuple[reference.Problem, Made, Callable[[int, float], reference.Load]]:
    """The reference's problem, and its loads by stage and load parameter. On one rank."""
    made = Made(scene, MPI.COMM_SELF)
    d, outside = made.d, made.outside()
    body, surface = body_of(made)
    contacts = [
        _contact(
            made,
            contact,
            surface(11 + i),
            lambda c=contact["support"]: surface(_tag(scene, c["body"], c["side"])),
        )
        for i, contact in enumerate(scene["contacts"])
    ]
    fixed = [bc.dof_indices()[0] for bc in made.bcs]

    def load(stage: int, t: float) -> reference.Load:
        made.apply(stage, t)
        values = np.zeros(len(body.stiffness))
        for bc in made.bcs:
            bc.set(values)
        dofs = np.unique(np.concatenate([np.zeros(0, dtype=np.int32), *fixed]))
        shifts, pushes = [], []
        for contact in scene["contacts"]:
            moving = contact["support"].get("moving")
            shift, push = np.zeros(d), np.zeros(d)
            if moving == "displacement":
                shift = made.shift.value.copy()
            elif moving == "force":
                for i in range(d):
                    if i in contact["support"]["free"]:
                        push[i] = float(made.push[i].value)
                    else:
                        shift[i] = float(made.pull[i].value)
            shifts.append(shift)
            pushes.append(push)
        return reference.Load(
            fem.assemble_vector(outside).array.copy(), dofs, values[dofs], shifts, pushes
        )

    return reference.Problem(body, contacts), made, load


def contact_of(
    made: Made, contact: Scene, here: reference.Surface, kind_of: Any = reference.ContactModel
) -> tuple[Any, tuple[Array, Array]]:
    """Points, stiffness and law of a contact without its support; facet and place of points."""
    scene, law = made.scene, contact["law"]
    d, degree = made.d, scene["degree"]
    rigid = contact["support"]["kind"] != "body"
    wanted = contact.get("accuracy")
    augmented = contact.get("enforcement") == "augmented"
    physical = law["kind"] in ("foundation", "tension") or any(
        (law.get(k) or [""])[0] == "springs" for k in ("k_n", "k_t")
    )
    if wanted and "enforcement" not in contact and not physical:
        augmented = fc.Accuracy.of(wanted).enforcement == "augmented"
    scheme, rule = contact.get("scheme"), contact.get("quadrature")
    if scheme is None and rule is None and augmented and rigid and degree == 1:
        scheme = "vertex" if scene["cell"] != "hexahedron" else None
    facet, xi, weights = here.rule(rule or 2 * degree, scheme or "default")
    weights = weights * scene.get("thickness", 1.0)
    x, _ = here.place(facet, xi)
    owner = made.box[here.cells]
    stress = made.moduli[owner[0]]

    def stiffness(given: Any) -> Array:
        if not given:
            return np.zeros(len(x))
        kind, value = given
        if kind == "scaled":
            smooth = reference.smooth_modulus(here, made.moduli[owner], facet, xi)
            return _scaled(value, contact) * smooth
        if kind == "number":
            return np.full(len(x), value * stress / made.length)
        vertices = {}
        for f, own in enumerate(here.corner_vertices):
            for q, k in zip(np.flatnonzero(facet == f), own, strict=False):
                vertices[k] = vertices.get(k, 0.0) + weights[q]
        area = [vertices[k] for own in here.corner_vertices for k in own]
        return value * stress * made.length ** (d - 2) / np.array(area)

    kind = {"prescribed": "tresca", "tension": "foundation", "polygon": "coulomb"}.get(
        law["kind"], law["kind"]
    )
    the_law = reference.Law(
        kind="coulomb" if kind == "ellipse" else kind,
        friction=law.get("friction", 0.0),
        pressure=law.get("pressure", 0.0) * stress,
        transverse=law.get("transverse"),
        modes=law.get("modes"),
        direction=law.get("direction"),
        tension=law["kind"] == "tension",
        unilateral=law["kind"] != "prescribed",
    )
    free = (
        tuple(contact["support"].get("free", ()))
        if contact["support"].get("moving") == "force"
        else ()
    )
    made_model = kind_of(
        x=x,
        place=None,
        interpolation=here.interpolation(facet, xi),
        weights=weights,
        k_n=stiffness(law.get("k_n")),
        k_t=stiffness(law.get("k_t")),
        law=the_law,
        paired=np.ones(len(x), dtype=bool),
        free=free,
        project=_projection(here, facet, xi, weights, max(1, degree - 1)) if augmented else None,
    )
    return made_model, (facet, xi)


def _contact(made: Made, contact: Scene, here: reference.Surface, opposite: Any) -> Any:
    """A contact as the reference has it."""
    made_model, (facet, xi) = contact_of(made, contact, here)
    scene, given, x = made.scene, contact.get("gap"), made_model.x
    if contact["support"]["kind"] != "body":
        place = _placement(contact["support"]["kind"], geometry(scene, contact), x)
        if given is not None:
            bare = place

            def place(shift: Array) -> tuple[Array, Array]:
                normal = bare(shift)[1]
                return given * made.length + normal @ shift, normal

        made_model.place = place
        return made_model
    there, normal = opposite(), here.normal(facet, xi)
    interpolation = made_model.interpolation

    def repair(u: Array | None) -> None:
        matrix, gap, paired = reference.pair(here, there, (facet, xi), u=u)
        made_model.paired = paired
        made_model.interpolation = np.where(paired[:, None], interpolation - matrix, 0.0)
        gap = gap if given is None else np.full(len(x), given * made.length)
        made_model.place = lambda shift: (gap + normal @ shift, normal + 0 * shift)

    repair(None)
    if given is None and not made_model.law.tension:
        thickness = scene.get("thickness", 1.0)
        made_model.back = lambda u: reference.penetration(there, here, u, thickness)
    if contact["support"]["update"] == "increment":
        made_model.repair = repair
    return made_model


def _placement(kind: str, where: dict[str, Any], x: Array) -> Any:
    """Gap and normal at the points, as functions of the support's shift."""
    if kind == "halfspace":
        normal = np.asarray(where["normal"])
        return lambda s: ((x - where["point"] - s) @ normal, np.tile(-normal, (len(x), 1)) + 0 * s)
    if kind == "obstacle":
        normal = -np.asarray(where["normal"])
        gap = where["gap"] + where["curve"] * (x[:, 0] - where["middle"]) ** 2
        return lambda s: (gap + s @ normal, np.tile(normal, (len(x), 1)) + 0 * s)
    sign = -1.0 if kind.endswith("inside") else 1.0
    flat = np.ones(x.shape[1])
    if kind.startswith("cylinder") and len(flat) == 3:
        flat[1] = 0.0

    def place(s: Array) -> tuple[Array, Array]:
        arm = (x - where["center"] - s) * flat
        distance = np.sqrt(np.sum(arm * arm, axis=1))
        return sign * (distance - where["radius"]), -sign * arm / distance[:, None]

    return place


def _projection(
    here: reference.Surface, facet: Array, xi: Array, weights: Array, degree: int
) -> Array:
    """L2 projection at the points onto continuous functions of a degree on Γc."""
    import basix

    kind = "interval" if here.d == 2 else "triangle" if here.simplex else "quadrilateral"
    element = basix.create_element(
        basix.ElementFamily.P, basix.CellType[kind], degree, basix.LagrangeVariant.gll_warped
    )
    every = np.repeat(np.arange(len(here.facets)), element.dim)
    nodes, _ = here.place(every, np.tile(element.points, (len(here.facets), 1)))
    # Nodes at one place are one; facets of Γc that touch belong to one body here.
    size = np.ptp(nodes, axis=0).max()
    tree = scipy.spatial.cKDTree(nodes)
    number = np.array([min(tree.query_ball_point(p, 1e-8 * size)) for p in nodes])
    _, number = np.unique(number, return_inverse=True)
    number = number.reshape(len(here.facets), element.dim)
    table = element.tabulate(0, xi)[0, :, :, 0]
    basis = np.zeros((len(xi), number.max() + 1))
    for q, f in enumerate(facet):
        basis[q, number[f]] += table[q]
    gram = basis.T @ (weights[:, None] * basis)
    return basis @ np.linalg.pinv(gram, rcond=1e-11, hermitian=True) @ (basis.T * weights)
