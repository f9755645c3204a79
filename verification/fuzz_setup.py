"""Problems of the package for random scenes, and their solution."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import basix.ufl
import dolfinx
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact import compat
from fenics_contact.contact.contact_kinematics import ObstacleMotion
from fenics_contact.types import Array
from verification import fuzz_features, fuzz_forms
from verification.fuzz_scenes import TOP, Scene, frictions

__all__ = ["SceneSetup", "capsule_gap", "obstacle_geometry", "run_history", "tag_of"]


def _mesh_arrays(scene: Scene) -> tuple[Array, Array, Array]:
    """Return vertices, cells in DOLFINx's order, and the body of every cell."""
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
        for corner in range(2**d):  # the first coordinate varies fastest
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


def _make_quadratic(cell: str, x: Array, cells: Array, boxes: Array) -> tuple[Array, Array, Array]:
    """Return the arrays of the mesh with geometry of degree 2."""
    element = basix.ufl.element("Lagrange", cell, 1, shape=(x.shape[1],))
    straight = dolfinx.mesh.create_mesh(MPI.COMM_SELF, cells=cells, x=x, e=ufl.Mesh(element))
    nodes = fem.functionspace(straight, ("Lagrange", 2))
    node_coordinates = nodes.tabulate_dof_coordinates()[:, : x.shape[1]]
    return (
        node_coordinates,
        nodes.dofmap.list.astype(np.int64),
        boxes[straight.topology.original_cell_index],
    )


_SIDES = {
    "bottom": (-1, 0.0),
    "top": (-1, 1.0),
    "left": (0, 0.0),
    "right": (0, 1.0),
    "front": (1, 0.0),
}


def tag_of(scene: Scene, body: int, side: str) -> int:
    """Return the tag of a side: 11, … for Γc; 21, … for opposing sides; `TOP`; else above 99."""
    for i, contact in enumerate(scene["contacts"]):
        if (contact["body"], contact["side"]) == (body, side):
            return 11 + i
    for i, contact in enumerate(scene["contacts"]):
        obstacle = contact["obstacle"]
        if obstacle["kind"] == "body" and (obstacle["body"], obstacle["side"]) == (body, side):
            return 21 + i
    return TOP if side == "top" else 100 + 10 * body + list(_SIDES).index(side)


class SceneSetup:
    """Mesh, forms, conditions and constants of a scene, on any number of ranks.

    Attributes:
        n_scene_bodies: Number of bodies without the unrelated one, which is the last.
        translation: Translation of all bodies and obstacles of the scene (length).
        F: The residual with piecewise constant coefficients; the package gets an equivalent form
            (`fuzz_forms.make_form`).
        LEVELS: Names of the load factors of a stage.
        slip_resets: By contact, the slip reference set in this increment: "rigid", whether bodies
            were positioned; "u", as from `_gather_displacement`; "jump" at the points,
            (n_points, d); and "unloaded", the points with this reference, (n_points,).
        paired_at: By contact, the displacement at which its pairs were found in this increment, as
            from `_gather_displacement`.
    """

    LEVELS: tuple[str, ...] = ("normal", "side", "across")

    def __init__(self, scene: Scene, comm: MPI.Comm) -> None:
        """Create mesh, bulk form and conditions. Collective."""
        self.n_scene_bodies = len(scene["bodies"])
        scene = fuzz_features.with_unrelated_body(scene)
        self.scene, self.comm = scene, comm
        self.slip_resets: dict[str, dict[str, Any]] = {}
        self.paired_at: dict[str, Array] = {}
        self.length, self.force = scene["units"]
        x, cells, boxes = _mesh_arrays(scene)
        self.d = d = x.shape[1]
        bent = any(scene.get("bend", ()))
        if bent:
            x, cells, boxes = _make_quadratic(scene["cell"], x, cells, boxes)
        element = basix.ufl.element("Lagrange", scene["cell"], 1 + bent, shape=(d,))
        element = ufl.Mesh(element)
        mine = slice(None) if comm.rank == 0 else slice(0, 0)
        self.mesh = dolfinx.mesh.create_mesh(comm, cells=cells[mine], x=x[mine], e=element)
        self.cell_body = boxes[self.mesh.topology.original_cell_index]
        self.tags = self._make_tags()
        if bent:
            self._bend()
        self.stress = self.force / self.length ** (d - 1)
        self.V = fem.functionspace(self.mesh, ("Lagrange", scene["degree"], (d,)))
        self.u = fem.Function(self.V, name="u")
        self.v = ufl.TestFunction(self.V)
        piecewise = fem.functionspace(self.mesh, ("DG", 0))
        vectors = fem.functionspace(self.mesh, ("DG", 0, (d,)))
        self.E = fem.Function(piecewise)
        n_cells = len(self.cell_body)
        moduli = np.array([b["E"] for b in scene["bodies"]]) * self.stress
        self.moduli = moduli
        self.E.x.array[piecewise.dofmap.list[:n_cells, 0]] = moduli[self.cell_body]
        self.traction, self.weight = fem.Function(vectors), fem.Function(vectors)
        self._cells = vectors.dofmap.list[:n_cells, 0]
        self.nu = fem.Constant(self.mesh, scene["nu"])
        self.thickness = fem.Constant(self.mesh, float(scene.get("thickness", 1.0)))
        dx, ds = ufl.dx(self.mesh), ufl.ds(self.mesh, subdomain_data=self.tags)
        self.F = self.bulk(self.E, dx) - self.loads(dx, ds)
        self.bcs: list[fem.DirichletBC] = []
        self.moved: list[fem.Constant] = []
        self._fixed: list[tuple[int, fem.Constant]] = []
        self._unrelated: list[tuple[int, fem.Constant]] = []
        self.unrelated_bcs: list[fem.DirichletBC] = []
        for body, side, components, how in scene["dirichlet"]:
            facets = self.facets_of(body, side)
            for i in components:
                value = fem.Constant(self.mesh, 0.0)
                space = self.V.sub(i)
                dofs = fem.locate_dofs_topological(space, d - 1, facets)
                self.bcs.append(fem.dirichletbc(value, dofs, space))
                if how == "moved":
                    self.moved.append((body, i, value))
                elif how == "fixed":
                    self._fixed.append((i, value))
                else:
                    self._unrelated.append((i, value))
                    self.unrelated_bcs.append(self.bcs[-1])
        self.contacts: list[fc.Contact] = []
        self.shift = fem.Constant(self.mesh, np.zeros(d))
        self.translation = fem.Constant(self.mesh, np.zeros(d))
        self.obstacle_force = [fem.Constant(self.mesh, 0.0) for _ in range(d)]
        self.obstacle_motion = [fem.Constant(self.mesh, 0.0) for _ in range(d)]

    def energy(self, E: Any, dx: ufl.Measure) -> ufl.Form:
        """Return the elastic energy of a linear body."""
        strain, nu = ufl.sym(ufl.grad(self.u)), self.nu
        lame = E * nu / ((1 + nu) * (1 - 2 * nu))
        density = E / (1 + nu) * ufl.inner(strain, strain) + lame * ufl.tr(strain) ** 2
        return self.thickness / 2 * density * dx

    def bulk_of_energy(self, E: Any, dx: ufl.Measure) -> ufl.Form:
        """Return `bulk` as the derivative of `energy`."""
        return ufl.derivative(self.energy(E, dx), self.u, self.v)

    def bulk(self, E: Any, dx: ufl.Measure) -> ufl.Form:
        """Return the virtual work of the stresses."""
        strain, nu = ufl.sym(ufl.grad(self.u)), self.nu
        lame = E * nu / ((1 + nu) * (1 - 2 * nu))
        stress = E / (1 + nu) * strain + lame * ufl.tr(strain) * ufl.Identity(self.d)
        return self.thickness * ufl.inner(stress, ufl.sym(ufl.grad(self.v))) * dx

    def loads(self, dx: ufl.Measure, ds: ufl.Measure) -> ufl.Form:
        """Return the virtual work of the loads."""
        on_top = self.thickness * ufl.dot(self.traction, self.v) * ds(TOP)
        return on_top + self.thickness * ufl.dot(self.weight, self.v) * dx

    def external_force(self) -> fem.Form:
        """Return the compiled form of the loads, -F at u = 0."""
        return fem.form(-ufl.replace(self.F, {self.u: fem.Function(self.V)}))

    def facets_of(self, body: int, side: str) -> Array:
        """Return the facets of a side of one body; tops without contact share a tag."""
        facets = self.tags.find(tag_of(self.scene, body, side))
        return facets[np.isin(self.cells_of(facets), np.flatnonzero(self.cell_body == body))]

    def _bend(self) -> None:
        """Raise the nodes of the bodies by a parabola in x."""
        x = self.mesh.geometry.x
        is_displaced = np.zeros(len(x), dtype=bool)
        for b, (body, rise) in enumerate(
            zip(self.scene["bodies"], self.scene["bend"], strict=True)
        ):
            nodes = np.unique(compat.geometry_dofmap(self.mesh)[self.cell_body == b])
            nodes = nodes[~is_displaced[nodes]]
            is_displaced[nodes] = True
            middle = (body["origin"][0] + 0.5 * body["size"][0]) * self.length
            width = body["size"][0] * self.length
            x[nodes, self.d - 1] += rise * width * (2 * (x[nodes, 0] - middle) / width) ** 2

    def cells_of(self, facets: Array) -> Array:
        """Return a cell of every facet."""
        to_cell = self.mesh.topology.connectivity(self.d - 1, self.d)
        return np.array([to_cell.links(f)[0] for f in facets], dtype=int)

    def _make_tags(self) -> dolfinx.mesh.MeshTags:
        mesh, d = self.mesh, self.d
        mesh.topology.create_connectivity(d - 1, d)
        exterior = dolfinx.mesh.exterior_facet_indices(mesh.topology)
        box = self.cell_body[self.cells_of(exterior)]
        middle = dolfinx.mesh.compute_midpoints(mesh, d - 1, exterior)[:, :d] / self.length
        values = np.zeros(len(exterior), dtype=np.int32)
        for b, body in enumerate(self.scene["bodies"]):
            for side, (axis, end) in _SIDES.items():
                if d == 2 and side == "front":
                    continue
                at = body["origin"][axis] + end * body["size"][axis]
                on_side = (box == b) & (np.abs(middle[:, axis] - at) < 1e-8)
                values[on_side] = tag_of(self.scene, b, side)
        tagged = values > 0
        return dolfinx.mesh.meshtags(mesh, d - 1, exterior[tagged], values[tagged])

    # ---- loads -------------------------------------------------------------------------------

    def load_levels(self, stage: int, t: float) -> dict[str, float]:
        """Return the load factors `LEVELS` at a load parameter t in [0, 1] of a stage."""
        stages = self.scene["stages"]
        zero = dict.fromkeys(self.LEVELS, 0.0)
        before = stages[stage - 1] if stage else zero
        return {n: before[n] + t * (stages[stage][n] - before[n]) for n in zero}

    def set_friction(self, stage: int) -> None:
        """Set the friction coefficients that change in a stage."""
        for contact, friction in zip(self.contacts, frictions(self.scene, stage), strict=False):
            if friction is not None:
                contact.parameters["friction"].value = friction

    def obstacle_loads(self) -> tuple[list[Array], list[Array]]:
        """Return displacement and force of the obstacle of every contact, (gdim,) each."""
        shifts, forces = [], []
        for contact in self.scene["contacts"]:
            moving, free = contact["obstacle"].get("moving"), contact["obstacle"].get("free", ())
            shift, force = np.zeros(self.d), np.zeros(self.d)
            if moving == "displacement":
                shift = self.shift.value.copy()
            elif moving == "translated":
                shift = self.translation.value.copy()
            elif moving == "force":
                for i in range(self.d):
                    force[i] = float(self.obstacle_force[i].value) if i in free else 0.0
                    shift[i] = 0.0 if i in free else float(self.obstacle_motion[i].value)
            shifts.append(shift)
            forces.append(force)
        return shifts, forces

    def apply(self, stage: int, t: float) -> None:
        """Set loads, Dirichlet values and obstacle motions at a load parameter of a stage."""
        scene, d = self.scene, self.d
        self.set_friction(stage)
        now = self.load_levels(stage, t)
        direction = np.zeros(d)
        direction[0], direction[-1] = now["side"], -now["normal"]
        if d == 3:
            direction[1] = now["across"]
        strain, loaded_bodies = scene["strain"], self.loaded_bodies()
        tractions = np.zeros((len(scene["bodies"]), d))
        pulled = scene["drive"] == "force"
        for k, b in enumerate(loaded_bodies):
            load_factor = scene["load_ratio"] if k else 1.0
            if pulled:
                tractions[b] = direction * strain * self.moduli[b] * load_factor
        self.traction.x.array.reshape(-1, d)[self._cells] = tractions[self.cell_body]
        heavy = np.zeros(d)
        heavy[-1] = -scene.get("weight", 0.0) * strain * self.stress / self.length
        heavy = heavy * (t if stage == 0 else 1.0)
        own = (self.cell_body < self.n_scene_bodies)[:, None]
        self.weight.x.array.reshape(-1, d)[self._cells] = np.where(own, heavy, 0.0)
        for body, i, value in self.moved:
            load_factor = scene["load_ratio"] if loaded_bodies.index(body) else 1.0
            size = scene["bodies"][body]["size"][-1] * self.length
            value.value = direction[i] * strain * size * load_factor
        if scene["drive"] == "obstacle":
            size = scene["bodies"][0]["size"][-1] * self.length
            self.shift.value[:] = -direction * strain * size
            area = np.prod(scene["bodies"][0]["size"][:-1]) * self.length ** (d - 1)
            for i in range(d):
                self.obstacle_force[i].value = -direction[i] * strain * self.moduli[0] * area
                self.obstacle_motion[i].value = -direction[i] * strain * size
        self.apply_additional_features(stage, t)

    def apply_additional_features(self, stage: int, t: float) -> None:
        """Translate all bodies and obstacles, and load the unrelated body."""
        d, scene = self.d, self.scene
        self.translation.value[:] = 0.0
        if "translation" in scene:
            distance = (stage + t) / len(scene["stages"]) * self.length
            self.translation.value[[0, d - 1]] = distance * np.array(scene["translation"])
        for i, value in self._fixed:
            value.value = self.translation.value[i]
        for _, i, value in self.moved:
            value.value += self.translation.value[i]
        self.shift.value[:] += self.translation.value
        if "unrelated_body" not in scene:
            return
        # Its load is a function of the position on the load path.
        unrelated = fuzz_features.UNRELATED_BODIES[scene["unrelated_body"]]
        load_factor = abs(np.sin(1.3 * (stage + t)))
        direction, load = np.zeros(d), np.zeros(d)
        direction[[0, d - 1]] = unrelated.get("moved", [0.0, 0.0])
        load[[0, d - 1]] = unrelated.get("load", [0.0, 0.0])
        for i, value in self._unrelated:
            value.value = load_factor * direction[i] * self.length
        rows = self.traction.x.array.reshape(-1, d)
        rows[self._cells[self.cell_body == self.n_scene_bodies]] = (
            load_factor * load * self.moduli[-1]
        )

    def loaded_bodies(self) -> list[int]:
        """Return the numbers of the loaded bodies."""
        return [0, 1] if self.scene["layout"] == "apart" else [self.n_scene_bodies - 1]

    # ---- the package -------------------------------------------------------------------------

    def surfaces(self) -> list[fc.ContactSurface]:
        """Return Γc of every contact."""
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
        """Return the contact law."""
        law, unit = contact["law"], self.stress / self.length
        body = self.scene["bodies"][contact["body"]]

        def stiffness(given: Any) -> Any:
            kind, value = given
            if kind == "scaled":
                return fc.RelativeStiffness(value)
            if kind == "springs":
                return fc.NodalSprings(
                    value * body["E"] * self.stress * self.length ** (self.d - 2)
                )
            return value * body["E"] * unit

        k = {n: stiffness(law[n]) for n in ("k_n", "k_t") if law.get(n)}
        kind = law["kind"]
        if kind == "frictionless":
            return fc.Frictionless(**k)
        if kind in ("foundation", "tension"):
            return fc.Foundation(**k, tension=kind == "tension")
        shape = {n: law[m] for n, m in _CONE_PARAMETERS.items() if m in law}
        if kind in ("tresca", "prescribed"):
            pressure = law["pressure"] * body["E"] * self.stress
            return fc.Tresca(law["friction"], pressure, **k, unilateral=kind == "tresca")
        return fc.Coulomb(law["friction"], **k, **shape)

    def obstacle(self, contact: Scene) -> Any:
        """Return the obstacle."""
        given = contact["obstacle"]
        if given["kind"] == "body":
            tag = tag_of(self.scene, given["body"], given["side"])
            return fc.DeformableBody(self.tags, tag, update_pairs=given["update_pairs"])
        where = obstacle_geometry(self.scene, contact)
        shift = None
        if given.get("moving") == "displacement":
            shift = self.shift
        elif given.get("moving") == "translated":
            shift = self.translation
        elif given.get("moving") == "force":
            free = given["free"]
            shift = fc.Motion(
                force=[self.obstacle_force[i] if i in free else None for i in range(self.d)],
                displacement=[
                    None if i in free else self.obstacle_motion[i] for i in range(self.d)
                ],
            )
        kind = given["kind"].split()[0]
        if kind == "halfspace":
            return fc.HalfSpace(where["point"], where["normal"], displacement=shift)
        if kind == "obstacle":
            x = ufl.SpatialCoordinate(self.mesh)
            numbers = (fem.Constant(self.mesh, float(where[n])) for n in ("gap", "curve", "middle"))
            gap, curve, middle = numbers
            direction = fem.Constant(self.mesh, -np.asarray(where["normal"]))
            return fc.PrescribedGap(
                gap + curve * (x[0] - middle) ** 2, direction, displacement=shift
            )
        if kind == "rod":
            return fc.SignedDistance(lambda x: capsule_gap(self.mesh, where, x), displacement=shift)
        inside = given["kind"].endswith("inside")
        if kind == "ball":
            return fc.Ball(where["center"], where["radius"], inside=inside, displacement=shift)
        axis = None if self.d == 2 else (0.0, 1.0, 0.0)
        return fc.Cylinder(
            where["center"], where["radius"], axis, inside=inside, displacement=shift
        )

    def options(self, contact: Scene) -> dict[str, Any]:
        """Return additional arguments of a contact."""
        return {}

    def problem(self) -> fc.ContactProblem:
        """Create the problem. Collective."""
        contacts = []
        for i, (c, surface) in enumerate(zip(self.scene["contacts"], self.surfaces(), strict=True)):
            gap = c.get("gap")
            contacts.append(
                fc.Contact(
                    self.u,
                    surface,
                    self.obstacle(c),
                    self.law(c),
                    gap=None if gap is None else gap * self.length,
                    enforcement=c.get("enforcement"),
                    accuracy=c.get("accuracy"),
                    weight=self.thickness,
                    name=f"contact {i}",
                    **self.options(c),
                )
            )
        for contact in contacts:
            _record_slip_resets(self, contact)
        self.contacts = contacts
        options, scene = {}, self.scene
        if "max_iterations" in scene:
            options["snes_max_it"] = scene["max_iterations"]
        return fc.ContactProblem(
            fuzz_forms.make_form(self),
            self.u,
            bcs=self.bcs,
            contacts=contacts,
            method=scene.get("method"),
            condensation=scene.get("condensation"),
            petsc_options=options,
            fallback=scene.get("fallback", "max_iterations" not in scene),
        )


def capsule_gap(mesh: dolfinx.mesh.Mesh, where: dict[str, Any], x: Any) -> Any:
    """Return the distance from a capsule, extruded along the axes with zero "flat" (UFL)."""
    low, high = (np.array(end, dtype=float) for end in where["ends"])
    arm = x - fem.Constant(mesh, low)
    if (high != low).any():
        direction = fem.Constant(mesh, high - low)
        along = ufl.dot(arm, direction) / ufl.dot(direction, direction)
        arm = arm - ufl.max_value(0.0, ufl.min_value(1.0, along)) * direction
    parts = [arm[i] for i in range(len(low)) if where.get("flat", np.ones(len(low)))[i]]
    return ufl.sqrt(sum(part**2 for part in parts)) - fem.Constant(mesh, float(where["radius"]))


_CONE_PARAMETERS = {"modes": "modes", "transverse_friction": "transverse", "direction": "direction"}


def obstacle_geometry(scene: Scene, contact: Scene) -> dict[str, Any]:
    """Return the geometry of a rigid obstacle, scaled by the unit of length."""
    body, given = scene["bodies"][contact["body"]], contact["obstacle"]
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
        # Without clearance the plane touches the lower vertex of the bottom.
        corner = low + (size[0] * np.eye(d)[0] if slope > 0 else 0.0)
        return {"point": (corner - clearance * normal) * length, "normal": normal}
    if given["kind"] == "obstacle":
        return {
            "gap": clearance * length,
            "curve": given["curve"] / length,
            "middle": middle[0] * length,
            "normal": up,
        }
    if given["kind"] == "rod":
        half = np.zeros(d)
        half[[0, d - 1]] = given["half"] * np.array([np.cos(given["tilt"]), np.sin(given["tilt"])])
        centre = low + given["at"] * size * np.eye(d)[0]
        centre[-1] -= clearance + given["radius"] + abs(half[-1])
        flat = np.ones(d)
        flat[1:-1] = 0.0
        where = {"center": centre, "ends": np.stack([centre - half, centre + half])}
        where |= {"radius": given["radius"]}
        return {name: value * length for name, value in where.items()} | {"flat": flat}
    radius = given["radius"] * max(size[:-1])
    if not given["kind"].endswith("inside"):
        return {"center": (middle - (radius + clearance) * up) * length, "radius": radius * length}
    # Without clearance the corners of the bottom touch the wall of the cavity.
    across = size[:-1] if given["kind"].startswith("ball") else size[:1]
    reach = 0.5 * float(np.linalg.norm(across))
    radius = max(radius, 1.2 * reach)
    height = np.sqrt(radius**2 - reach**2) - clearance
    return {"center": (middle + height * up) * length, "radius": radius * length}


# ---- solution ------------------------------------------------------------------------------------


def gather_rows(comm: MPI.Comm, rows: Array) -> Array:
    """Gather the rows of all ranks on all ranks."""
    return np.concatenate(comm.allgather(np.asarray(rows)))


def _nodes(setup: SceneSetup) -> tuple[Array, Array]:
    """Return body and coordinates of the owned displacement nodes."""
    dofmap = setup.V.dofmap
    n = dofmap.index_map.size_local
    box = np.full(n + dofmap.index_map.num_ghosts, -1)
    box[dofmap.list[: len(setup.cell_body)]] = setup.cell_body[:, None]
    return box[:n], setup.V.tabulate_dof_coordinates()[:n, : setup.d]


def _gather_displacement(setup: SceneSetup, u: fem.Function | None = None) -> np.ndarray:
    """Return body, coordinates and displacement of all nodes, (n_nodes, 1 + 2 d). Collective."""
    box, x = _nodes(setup)
    u = (u or setup.u).x.array.reshape(-1, setup.d)[: len(box)]
    return gather_rows(setup.comm, np.column_stack([box, x, u]))


def _record_slip_resets(setup: SceneSetup, contact: fc.Contact) -> None:
    """Record the calls that set a contact's slip reference, or its pairs in an increment."""
    # Whether points move with obstacles: then bodies are positioned.
    is_positioning: list[bool] = []

    def displaced(by: Any) -> Any:
        is_positioning[:] = [isinstance(by, ObstacleMotion)]
        return displace(by)

    def set_slip_reference(points: Array) -> None:
        (rigid,) = is_positioning
        if rigid and not any(setup.comm.allgather(bool(points.any()))):
            original_set(points)  # only other bodies are positioned
            return
        unloaded = points & (contact.history.values("normal_traction") == 0.0)
        columns = [contact.points, contact.values.jump, unloaded]
        rows = gather_rows(setup.comm, np.column_stack(columns))
        setup.slip_resets[contact.name] = {
            "rigid": rigid,
            "u": _gather_displacement(setup),
            "jump": rows[:, setup.d : 2 * setup.d],
            "unloaded": rows[:, -1] > 0,
        }
        original_set(points)

    def start_with_pairs(opposite: Any) -> None:
        setup.paired_at[contact.name] = _gather_displacement(
            setup, opposite.pairs.pairing_displacement
        )
        original_start(opposite)

    original_start = contact.states.start_with_pairs
    contact.states.start_with_pairs = start_with_pairs  # type: ignore[method-assign]
    displace = contact.contact_kinematics.displaced
    contact.contact_kinematics.displaced = displaced  # type: ignore[method-assign]
    original_set = contact.states.set_slip_reference
    contact.states.set_slip_reference = set_slip_reference  # type: ignore[method-assign]


def _make_record(
    setup: SceneSetup, problem: fc.ContactProblem, step: Any, stage: int, t: float
) -> dict[str, Any]:
    """Return the results of a committed increment for the comparison. Collective."""
    comm, d = setup.comm, setup.d
    contacts = []
    for contact in problem.contacts:
        columns = [contact.points, contact.measure, contact.pressure, contact.tangential_traction]
        if contact.multipliers is not None:
            columns.append(contact.multipliers.fields.values("pressure"))
            if contact.law.has_friction:
                columns.append(contact.multipliers.fields.values("traction"))
                if "normal" in contact.multipliers.fields:
                    columns.append(contact.multipliers.fields.values("normal"))
        rows = gather_rows(comm, np.column_stack(columns))
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
                "unpaired": contact.pairs.n_unpaired,
                "error": contact.accuracy.error if contact.accuracy else None,
                "slip_reset": setup.slip_resets.get(contact.name),
                "paired_at": setup.paired_at.get(contact.name),
                "updates_pairs": contact.contact_kinematics.updates_pairs,
            }
        )
    return {
        "stage": stage,
        "load": t,
        "u": _gather_displacement(setup),
        "contacts": contacts,
        "energy": step.energy,
        "rtol": problem.accuracy.rtol if problem.accuracy else 1e-9,
        "attempts": [str(r) for r in step.attempts],
        "method": step.method,
        "iterations": step.iterations,
        "summary": step.summary() if step.verdict.worst_equation.force > 0 else "",
    }


def run_history(
    scene: Scene,
    comm: MPI.Comm,
    on_increment: Callable[[dict[str, Any]], None],
    modify: Any = None,
    setup_class: type[SceneSetup] = SceneSetup,
) -> None:
    """Solve a scene with the package. Collective.

    Args:
        scene: The scene.
        comm: Communicator.
        on_increment: Function of the record of every committed increment, called on all ranks.
        modify: Function of setup and problem that introduces an error (tests).
        setup_class: Class of the setup.
    """
    setup = setup_class(scene, comm)
    problem = setup.problem()
    if modify is not None:
        modify(setup, problem)
    stop, number = scene.get("restart"), 0
    with tempfile.TemporaryDirectory() as folder:
        folder = comm.bcast(folder)
        for stage, what in enumerate(scene["stages"]):
            file = Path(folder) / f"stage{stage}.npz"

            def steps(
                setup: SceneSetup,
                problem: Any,
                stage: int = stage,
                n: int = what["steps"],
                file: Any = file,
            ) -> Any:
                def apply(t: float) -> None:
                    setup.slip_resets.clear()
                    setup.paired_at.clear()
                    setup.apply(stage, t)

                return fc.increments(
                    problem,
                    apply,
                    steps=n,
                    max_cuts=scene.get("cuts", 1),
                    checkpoint=file if stop is not None else None,
                )

            run = steps(setup, problem)
            while True:
                step = next(run, None)
                if step is None:
                    break
                on_increment(_make_record(setup, problem, step, stage, step.load))
                number += 1
                if number == stop:
                    run.close()
                    setup = setup_class(scene, comm)
                    problem = setup.problem()
                    run = steps(setup, problem)
        comm.barrier()
