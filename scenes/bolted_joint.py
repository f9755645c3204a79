"""A bolted joint of two plates that transmits the load by friction until all contacts slip.

Plates of 40 x 20 x 4 mm overlap by 30 mm, each with a bore of 6.6 mm; the bolt has a shank of 6 mm
and, as head and nut, discs of 11 x 3 mm. It is tightened by an interference under its head. The
lower plate is fixed at one end; the upper one is guided at the other end and pulled along x. The
shank does not touch the bores: friction under head and nut constrains the bolt, and there is no
equilibrium above the friction limit of the three contacts.
"""

from __future__ import annotations

from typing import Any

import dolfinx
import gmsh
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from scenes.elasticity import dirichlet_bc, displacement_space, residual
from scenes.histories import History

LENGTH, WIDTH, THICKNESS, OVERLAP = 40.0, 20.0, 4.0, 30.0  # mm
BORE, SHANK, HEAD, HEIGHT = 3.3, 3.0, 5.5, 3.0  # radii, and the height of head and nut
E, NU, FRICTION, INTERFERENCE = 210e3, 0.3, 0.2, 0.02  # MPa, mm
# Tags: fixed and pulled end of the plates, both sides of the three contacts.
FIXED, PULLED, LOWER_PLATE, UPPER_PLATE, PLATE_UNDER_HEAD, HEAD_FACE, PLATE_ON_NUT, NUT_FACE = (
    range(1, 9)
)
_LOWER, _UPPER, _BOLT = 1, 2, 3
_JOINTS = {
    "plates": (LOWER_PLATE, UPPER_PLATE),
    "head": (HEAD_FACE, PLATE_UNDER_HEAD),
    "nut": (NUT_FACE, PLATE_ON_NUT),
}


def joint_mesh(size: float) -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags]:
    """Return tetrahedra of a size (mm), half of it at the bolt, and facet tags. Collective."""
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.add("bolted joint")
        if MPI.COMM_WORLD.rank == 0:
            occ = gmsh.model.occ
            shift, middle = LENGTH - OVERLAP, LENGTH - OVERLAP / 2
            top, volumes = 2 * THICKNESS, {}
            for body, x, z in ((_LOWER, 0.0, 0.0), (_UPPER, shift, THICKNESS)):
                plate = occ.addBox(x, -WIDTH / 2, z, LENGTH, WIDTH, THICKNESS)
                bore = occ.addCylinder(middle, 0, z, 0, 0, THICKNESS, BORE)
                volumes[body] = occ.cut([(3, plate)], [(3, bore)])[0][0]
            shank = occ.addCylinder(middle, 0, 0, 0, 0, top, SHANK)
            head = occ.addCylinder(middle, 0, top, 0, 0, HEIGHT, HEAD)
            nut = occ.addCylinder(middle, 0, -HEIGHT, 0, 0, HEIGHT, HEAD)
            volumes[_BOLT] = occ.fuse([(3, shank)], [(3, head), (3, nut)])[0][0]
            occ.synchronize()
            groups: dict[int, list[int]] = {tag: [] for tag in range(1, 9)}
            places = {
                _LOWER: {LOWER_PLATE: (2, THICKNESS), PLATE_ON_NUT: (2, 0.0), FIXED: (0, 0.0)},
                _UPPER: {
                    UPPER_PLATE: (2, THICKNESS),
                    PLATE_UNDER_HEAD: (2, top),
                    PULLED: (0, shift + LENGTH),
                },
                _BOLT: {HEAD_FACE: (2, top), NUT_FACE: (2, 0.0)},
            }
            for body, sides in places.items():
                gmsh.model.addPhysicalGroup(3, [volumes[body][1]], body)
                for _, face in gmsh.model.getBoundary([volumes[body]], oriented=False):
                    box = np.array(gmsh.model.getBoundingBox(2, face)).reshape(2, 3)
                    for tag, (axis, at) in sides.items():
                        if np.all(np.abs(box[:, axis] - at) < 1e-3):
                            groups[tag].append(face)
            for tag, faces in groups.items():
                gmsh.model.addPhysicalGroup(2, faces, tag)

            def cell_size(dim: int, tag: int, x: float, y: float, z: float, lc: float) -> float:
                return size * (0.5 + 0.1 * max(0.0, np.hypot(x - middle, y) - HEAD))

            gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 0)
            gmsh.model.mesh.setSizeCallback(cell_size)
            gmsh.model.mesh.generate(3)
        mesh, _, tags = fc.model_to_mesh(gmsh.model, MPI.COMM_WORLD)
        return mesh, tags
    finally:
        gmsh.finalize()


class BoltedJoint(History):
    """The joint: tightened until t = 1, then pulled by 1000 N per unit of t.

    Attributes:
        u: Displacement.
        tags: Facet tags.
        contacts: Contacts of plates, head and nut.
        interference: Interference under the head (length).
        pull: Load on the end of the upper plate (force).
        problem: Problem with the three contacts.
    """

    def __init__(
        self,
        size: float = 2.6,
        *,
        degree: int = 2,
        contact: dict | None = None,
        **options: Any,
    ) -> None:
        """Create the problem, not tightened. Collective.

        Args:
            size: Cell size, see `joint_mesh` (mm).
            degree: Polynomial degree of the displacement.
            contact: Arguments of every contact.
            options: Arguments of the problem.
        """
        mesh, tags = joint_mesh(size)
        self.tags = tags
        space = displacement_space(mesh, degree)
        self.u, v = fem.Function(space, name="displacement"), ufl.TestFunction(space)
        self.interference, self.pull = fem.Constant(mesh, 0.0), fem.Constant(mesh, 0.0)
        contact = {"accuracy": "standard"} | (contact or {})
        self.contacts = []
        for name, (mine, other) in _JOINTS.items():
            gap = {"gap": -self.interference} if name == "head" else {}
            surface = fc.ContactSurface(mesh, tags, mine)
            obstacle = fc.DeformableBody(tags, other)
            law = fc.Coulomb(FRICTION)
            made = fc.Contact(self.u, surface, obstacle, law, name=name, **gap, **contact)
            self.contacts.append(made)
        ds = ufl.Measure("ds", mesh, subdomain_data=tags)(PULLED)
        F = residual(self.u, v, E, NU) - self.pull / (WIDTH * THICKNESS) * v[0] * ds
        bcs = [dirichlet_bc(self.u, tags, FIXED, i) for i in range(3)]
        bcs += [dirichlet_bc(self.u, tags, PULLED, i) for i in (1, 2)]
        self.problem = fc.ContactProblem(F, self.u, bcs=bcs, contacts=self.contacts, **options)

    def load(self, t: float) -> None:
        """Set the interference and the load at t."""
        self.interference.value = INTERFERENCE * min(t, 1.0)
        self.pull.value = 1000.0 * max(t - 1.0, 0.0)
