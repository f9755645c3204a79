"""Scenes of boxes, and unrelated loaded bodies in the same mesh.

The outcome of a scene must not depend on motion, stiffness and loads of the unrelated bodies.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import dolfinx
import numpy as np
from dolfinx import fem

import fenics_contact as fc
from fenics_contact.elasticity import NeoHookean
from fenics_contact.types import Array
from scenes.blocks import BOTTOM, RIGHT, TOP, block_mesh
from scenes.bodies import Bodies

# Distance of the unrelated bodies from the origin.
DISTANCE = 30.0


@dataclass(frozen=True)
class Box:
    """A box of quadrilaterals, and its Young's modulus.

    Attributes:
        low, size: Its lowest corner and the lengths of its edges (length).
        n: Cells along both edges.
        E: Young's modulus relative to that of the scene.
        bend: Map of the nodes, (n, 2).
    """

    low: tuple[float, float] = (0.0, 0.0)
    size: tuple[float, float] = (1.0, 1.0)
    n: tuple[int, int] = (3, 3)
    E: float = 1.0
    bend: Callable[[Array], Array] | None = None

    def mesh(self) -> tuple[dolfinx.mesh.Mesh, None, dolfinx.mesh.MeshTags]:
        """Return the mesh, None for the cell tags, and the tags of the sides. Collective."""
        mesh, tags = block_mesh("quadrilateral", n=self.n, size=self.size)
        x = mesh.geometry.x[:, :2]
        x[:] = (self.bend(x) if self.bend else x) + self.low
        return mesh, None, tags


@dataclass(frozen=True)
class UnrelatedBody:
    """An unrelated block, by default on a floor, whose top is displaced or loaded.

    Attributes:
        E: Young's modulus relative to that of the scene.
        place: Its position along x (length).
        top_displacement: Displacement of its top along x and y (length); None: it is loaded.
        load: Traction on its top along x and y, relative to E.
        floor: Whether it stands on a floor; otherwise its bottom is free.
        wall: Distance to a wall that it may touch (length); None: no wall.
    """

    E: float = 1.0
    place: float = DISTANCE
    top_displacement: tuple[float, float] | None = None
    load: tuple[float, float] = (0.0, 0.0)
    floor: bool = True
    wall: float | None = None


UNRELATED_BODIES = {
    "displaced": UnrelatedBody(top_displacement=(3.0, 0.0), floor=False),
    "sliding": UnrelatedBody(top_displacement=(3.0, -1e-2)),
    "compressed": UnrelatedBody(top_displacement=(0.0, -0.1)),
    "stiff": UnrelatedBody(E=1e6, top_displacement=(0.0, -1e-2)),
    "soft": UnrelatedBody(E=1e-6, load=(0.0, -1e-2)),
    "light": UnrelatedBody(load=(1e-8, -1e-7)),
    "heavy": UnrelatedBody(E=1e8, load=(0.0, -1e-2)),
    "far away": UnrelatedBody(place=1e4, load=(0.0, -1e-2), wall=1e3),
}


@dataclass
class SceneWithUnrelatedBodies:
    """Boxes and unrelated bodies in one mesh: elastic, plane strain, ν = 0.3.

    Attributes:
        boxes: Boxes of the scene, by name.
        unrelated: The unrelated bodies.
        rubber: Whether all bodies are neo-Hookean.
        E: Young's modulus to which those of all bodies are relative (stress).
        bodies: Mesh, tags, displacement, residual and Dirichlet conditions.
    """

    boxes: Mapping[str, Box]
    unrelated: Sequence[UnrelatedBody] = ()
    rubber: bool = False
    E: float = 1.0
    bodies: Bodies = field(init=False)

    def __post_init__(self) -> None:
        """Create mesh and residual. Collective."""
        more = {
            f"unrelated {i}": Box((b.place, 0.0), n=(2, 2), E=b.E)
            for i, b in enumerate(self.unrelated)
        }
        self._all = {**self.boxes, **more}
        self._joined = fc.join_meshes({name: box.mesh() for name, box in self._all.items()})
        modulus = self._joined.by_body({name: box.E * self.E for name, box in self._all.items()})
        self.bodies = Bodies((self._joined.mesh, self._joined.facets), modulus, 0.3)
        if self.rubber:
            elastic = NeoHookean(self.bodies.u, modulus, 0.3, "plane strain")
            self.bodies.F = elastic.residual(self.bodies.v)
        self._load_factor = self.bodies.constant(0.0)  # load factor of the unrelated bodies
        self._prescribed: list[tuple[fem.Constant, Array]] = []
        self._contacts: list[fc.Contact] = []

    def tag(self, box: str, side: int) -> int:
        """Return the tag of a side of a box in the common mesh."""
        return self._joined.facet(box, side)

    def prescribe(self, box: str, side: int, *components: int, value: Any = 0.0) -> None:
        """Prescribe components of the displacement on a side. Collective."""
        self.bodies.prescribe(self.tag(box, side), *components, value=value)

    def load(self, box: str, side: int, component: int, value: Any) -> None:
        """Apply a traction to a side."""
        self.bodies.F -= value * self.bodies.v[component] * self.bodies.ds(self.tag(box, side))

    def contact(self, box: str, side: int, obstacle: Any, law: Any, **options: Any) -> fc.Contact:
        """Return the contact of a side with an obstacle or a side of another box. Collective."""
        if isinstance(obstacle, tuple):
            obstacle = fc.DeformableBody(self.bodies.tags, self.tag(*obstacle))
        return self.bodies.contact(self.tag(box, side), obstacle, law, **options)

    def problem(self, *contacts: fc.Contact, **options: Any) -> fc.ContactProblem:
        """Return the problem, including contacts of the unrelated bodies. Collective."""
        return self.bodies.problem(*contacts, *self._add_unrelated(contacts), **options)

    def _add_unrelated(self, contacts: Sequence[fc.Contact]) -> list[fc.Contact]:
        """Apply conditions and loads of the unrelated bodies; return their contacts. Collective."""
        unrelated_contacts = []
        finite = (
            {"kinematics": "finite"}
            if any(c.contact_kinematics.is_finite for c in contacts)
            else {}
        )
        for i, body in enumerate(self.unrelated):
            name, floor = f"unrelated {i}", fc.HalfSpace((0, 0), (0, 1))
            law = fc.Coulomb(0.3)
            if body.floor:
                unrelated_contacts.append(
                    self.contact(name, BOTTOM, floor, law, name=f"{name}, floor", **finite)
                )
            if body.wall is not None:
                wall = fc.HalfSpace((body.place + 1 + body.wall, 0), (-1, 0))
                unrelated_contacts.append(
                    self.contact(name, RIGHT, wall, law, name=f"{name}, wall", **finite)
                )
            for component in range(2):
                if body.top_displacement is None:
                    value = self._load_factor * (body.load[component] * body.E * self.E)
                    self.load(name, TOP, component, value)
                else:
                    constant = self.bodies.constant(0.0)
                    self._prescribed.append((constant, np.array(body.top_displacement[component])))
                    self.prescribe(name, TOP, component, value=constant)
        return unrelated_contacts

    def set_unrelated_load(self, factor: float) -> None:
        """Set the load factor, from 0 to 1, of the unrelated bodies."""
        self._load_factor.value = factor
        for constant, final in self._prescribed:
            constant.value = factor * final
