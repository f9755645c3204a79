"""Contacts between bodies that may touch, found by their distance.

References are closed-form solutions and equilibrium, to 1e-10: the solver's tolerance on forces is
1e-9, and linear problems are solved to round-off. Two solutions of one problem agree to 1e-8.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import dolfinx
import numpy as np
import pytest
import scipy.spatial
import ufl
from dolfinx import fem
from dolfinx.mesh import CellType
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact import compat
from fenics_contact.types import Array
from scenes.blocks import dimension
from scenes.comparison import assert_raised_on_all_ranks, gather
from scenes.elasticity import dirichlet_bc, displacement_space
from scenes.meshes import create_mesh
from scenes.tags import any_of, at_coordinate, tag_by_midpoints

COMM = MPI.COMM_WORLD
pytestmark = [
    pytest.mark.hexahedra,
    pytest.mark.three_ranks,
    pytest.mark.timeout(120),
]
FLOOR, ROOF, WEST, SOUTH = 1, 2, 3, 4

# ---- scenes --------------------------------------------------------------------------------------


def box(cell: str, low: Sequence[float], high: Sequence[float], n: Sequence[int]) -> tuple:
    """Return a box for `join_meshes`, with the tags FLOOR, ROOF, WEST and in 3D SOUTH."""
    d = dimension(cell)
    make = dolfinx.mesh.create_rectangle if d == 2 else dolfinx.mesh.create_box
    mesh = make(COMM, [np.array(low, float), np.array(high, float)], n, CellType[cell])
    sides = {
        FLOOR: at_coordinate(d - 1, low[-1]),
        ROOF: at_coordinate(d - 1, high[-1]),
        WEST: at_coordinate(0, low[0]),
    }
    if d == 3:
        sides[SOUTH] = at_coordinate(1, low[1])
    return mesh, None, tag_by_midpoints(mesh, sides)


def disc(centre: Sequence[float], radius: float, n: int) -> tuple:
    """Return a disc of triangles, (mesh, None, None)."""
    rings, places = np.arange(1, n + 1), [np.zeros((1, 2))]
    for ring in rings:
        angle = np.arange(6 * ring) * 2 * np.pi / (6 * ring)
        places.append(radius * ring / n * np.column_stack([np.cos(angle), np.sin(angle)]))
    x = np.concatenate(places)
    cells = scipy.spatial.Delaunay(x).simplices
    return create_mesh("triangle", x + np.asarray(centre, float), cells), None, None


class PressedBodies:
    """Joined bodies with ν = 0, some with pressure on the ROOF, some with a fixed FLOOR.

    All have rollers at WEST and SOUTH and are free on the other sides.
    """

    def __init__(
        self,
        parts: dict[str, tuple],
        pressed: dict[str, float],
        fixed_bodies: Sequence[str],
        moduli: dict[str, float] | None = None,
        degree: int = 1,
    ) -> None:
        """Join the bodies. Collective."""
        self.joined = joined = fc.join_meshes(parts)
        self.mesh, self.d = joined.mesh, joined.mesh.geometry.dim
        self.u = fem.Function(displacement_space(self.mesh, degree))
        self.v = ufl.TestFunction(self.u.function_space)
        E = joined.by_body(moduli or dict.fromkeys(joined.bodies, 1e3))
        kind = "plane strain" if self.d == 2 else "3D"
        self.body = fc.elasticity.LinearElastic(self.u, E, 0.0, kind)
        self.F = self.body.residual(self.v)
        ds = ufl.Measure("ds", domain=self.mesh, subdomain_data=joined.facets)
        for body, pressure in pressed.items():
            load = fem.Constant(self.mesh, pressure)
            self.F += load * self.v[self.d - 1] * ds(joined.facet(body, ROOF))
        self.bcs = [self.fix_component(body, FLOOR, self.d - 1) for body in fixed_bodies]
        for body in parts:
            self.bcs += [
                self.fix_component(body, side, i) for i, side in enumerate((WEST, SOUTH)[:-1])
            ]
            if self.d == 3:
                self.bcs.append(self.fix_component(body, SOUTH, 1))

    def fix_component(self, body: str, tag: int, component: int) -> fem.DirichletBC:
        """Return a condition that fixes one displacement component of a side."""
        return dirichlet_bc(self.u, self.joined.facets, self.joined.facet(body, tag), component)

    def solve(self, contacts: list[fc.Contact], **options: Any) -> fc.Step:
        """Solve and commit one increment with these contacts."""
        problem = fc.ContactProblem(self.F, self.u, bcs=self.bcs, contacts=contacts, **options)
        step = problem.solve()
        problem.commit()
        return step

    def roof_shortening(self, body: str) -> Array:
        """Return the downward displacements of the nodes of a body's ROOF."""
        facets = self.joined.facets.find(self.joined.facet(body, ROOF))
        space = self.u.function_space.sub(self.d - 1)
        dofs = fem.locate_dofs_topological(space, self.d - 1, facets)
        return gather(COMM, -self.u.x.array[dofs])


def three_blocks(cell: str) -> PressedBodies:
    """Return a stack of three blocks of height 0.5, 3, 5 (3D: 2) and 4 cells wide, pressed by 2."""
    d = dimension(cell)
    parts = {}
    for i, (body, n) in enumerate((("low", 3), ("mid", 5 if d == 2 else 2), ("top", 4))):
        low, high = [0.0] * (d - 1) + [0.5 * i], [1.0] * (d - 1) + [0.5 * (i + 1)]
        parts[body] = box(cell, low, high, [n] * (d - 1) + [2])
    moduli = {"low": 1e3, "mid": 2e3, "top": 5e2}
    return PressedBodies(parts, {"top": 2.0}, ["low"], moduli)


def vertical_force(contact: fc.Contact) -> float:
    """Return the vertical contact force on the slave body."""
    return float(contact.resultants().force[-1])


def n_facets_of(contact: fc.Contact) -> int:
    """Return the number of facets of Γc."""
    return COMM.allreduce(len(contact.surface.facets))


# ---- equilibrium ---------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron", "hexahedron"])
def test_stack_has_uniform_stress_and_the_load_in_every_joint(cell: str) -> None:
    """Every joint has the force of the load, to 1e-10; every block shortens by p h / E, to 1e-9."""
    scene = three_blocks(cell)
    contacts = fc.find_contact_pairs(
        scene.u, fc.Frictionless(fc.RelativeStiffness(1e3)), 0.1, bodies=scene.joined
    )
    assert [contact.name for contact in contacts] == ["low-mid", "mid-top"]
    scene.solve(contacts)
    bound = 0.0
    for contact in contacts:
        assert abs(vertical_force(contact)) == pytest.approx(2.0, rel=1e-10)
        pressure = gather(COMM, contact.pressure)
        assert pressure == pytest.approx(np.full(pressure.shape, 2.0), rel=1e-9)
        bound += contact.resultants().max_penetration
    expected = 2.0 * 0.5 * (1 / 1e3 + 1 / 2e3 + 1 / 5e2) + bound
    shortening = scene.roof_shortening("top")
    assert shortening == pytest.approx(np.full(shortening.shape, expected), rel=1e-9)


def test_found_pairs_equal_contacts_of_tagged_sides() -> None:
    """Contacts of tagged sides give the same displacements and forces, to 1e-8."""
    computed = []
    for by_hand in (False, True):
        scene = three_blocks("quadrilateral")
        law, tags, joined = fc.Coulomb(0.3), scene.joined.facets, scene.joined
        if by_hand:
            contacts = [
                fc.Contact(
                    scene.u,
                    fc.ContactSurface(scene.mesh, tags, joined.facet("mid", slave)),
                    fc.DeformableBody(tags, joined.facet(body, master)),
                    law,
                    name=body,
                )
                for body, slave, master in (("low", FLOOR, ROOF), ("top", ROOF, FLOOR))
            ]
        else:
            contacts = fc.find_contact_pairs(scene.u, law, 0.1, bodies=joined)
        scene.solve(contacts)
        computed.append(
            [scene.roof_shortening("top"), *(np.array([vertical_force(c)]) for c in contacts)]
        )
    for one, other in zip(*computed, strict=True):
        assert np.sort(one) == pytest.approx(np.sort(other), rel=1e-8)


@pytest.mark.parametrize("fine", ["base", "blocks"])
def test_two_blocks_on_one_base(fine: str) -> None:
    """Each of two adjacent blocks transfers its load, to 1e-10; facets below the gap serve both."""
    n = {"base": (30, 1), "blocks": (12, 8)}[fine]
    parts = {
        "base": box("quadrilateral", (0, 0), (2, 1), (n[0], 8)),
        "left": box("quadrilateral", (0, 1), (0.98, 2), (n[1], 2)),
        "right": box("quadrilateral", (1.02, 1), (2, 2), (n[1], 2)),
    }
    scene = PressedBodies(parts, {"left": 3.0, "right": 5.0}, ["base"])
    contacts = fc.find_contact_pairs(scene.u, fc.Frictionless(), 0.1, bodies=scene.joined)
    names = [contact.name for contact in contacts]
    # The blocks face each other across the gap, which stays open.
    assert names == ["base-left", "base-right", "left-right"]
    scene.solve(contacts)
    forces = dict(zip(names, (contact.resultants().force for contact in contacts), strict=True))
    assert abs(forces["base-left"][1]) == pytest.approx(3 * 0.98, rel=1e-10)
    assert abs(forces["base-right"][1]) == pytest.approx(5 * 0.98, rel=1e-10)
    if fine == "base":  # Γc of both contacts is on the base
        facets = [contact.surface.facets for contact in contacts[:2]]
        assert COMM.allreduce(len(np.intersect1d(*facets))) > 0


# ---- finite kinematics ---------------------------------------------------------------------------


def rubber_between_plates(by_hand: bool) -> list[fc.Contact]:
    """Return the solved contacts of a rubber disc, compressed by a tenth between two plates."""
    mesh, _, _ = disc((0, 0), 0.5, 6)
    around = tag_by_midpoints(mesh, {ROOF: lambda x, cell: np.ones(len(x), dtype=bool)})
    parts = {
        "below": box("triangle", (-1, -0.7), (1, -0.5), (10, 1)),
        "disc": (mesh, None, around),
        "above": box("triangle", (-1, 0.5), (1, 0.7), (10, 1)),
    }
    joined = fc.join_meshes(parts)
    u = fem.Function(displacement_space(joined.mesh, 1))
    space, tags = u.function_space, joined.facets
    E = joined.by_body({"below": 50.0, "disc": 1.0, "above": 50.0})
    body = fc.elasticity.NeoHookean(u, E, 0.3, "plane strain")
    down = fem.Constant(joined.mesh, -0.1)
    bcs = [dirichlet_bc(u, tags, joined.facet("below", FLOOR), i) for i in (0, 1)]
    bcs += [
        dirichlet_bc(u, tags, joined.facet("above", ROOF), i, c) for i, c in ((0, 0.0), (1, down))
    ]
    sideways, _ = space.sub(0).collapse()
    middle = fem.locate_dofs_geometrical(
        (space.sub(0), sideways), lambda x: (np.abs(x[0]) < 1e-9) & (np.abs(x[1]) < 0.49)
    )
    bcs.append(fem.dirichletbc(fem.Function(sideways), middle, space.sub(0)))
    # Stiffness as a number: multiples of E/h depend on all of Γc, which differs for tagged sides.
    law = fc.Coulomb(0.3, k_n=100.0, k_t=100.0)
    if by_hand:
        surface = fc.ContactSurface(joined.mesh, tags, joined.facet("disc", ROOF))
        contacts = [
            fc.Contact(
                u,
                surface,
                fc.DeformableBody(tags, joined.facet(plate, side)),
                law,
                kinematics="finite",
                name=plate,
            )
            for plate, side in (("below", ROOF), ("above", FLOOR))
        ]
    else:
        options = {"bodies": joined, "slave_bodies": ("disc",), "kinematics": "finite"}
        contacts = fc.find_contact_pairs(u, law, 0.3, **options)
    residual = body.residual(ufl.TestFunction(space))
    fc.ContactProblem(residual, u, bcs=bcs, contacts=contacts).solve()
    return contacts


def test_rubber_disc_between_plates() -> None:
    """At large strains both plates have equal forces (1e-8), those of tagged sides (1e-7).

    The disc is constrained laterally only. The plates are farther apart than the search distance
    and no pair.
    """
    computed, expected = rubber_between_plates(by_hand=False), rubber_between_plates(by_hand=True)
    assert [contact.name for contact in computed] == ["below-disc", "disc-above"]
    below, above = (vertical_force(contact) for contact in computed)
    assert below > 0.02 and below == pytest.approx(-above, rel=1e-8)
    for one, other in zip(computed, expected, strict=True):
        assert n_facets_of(one) < n_facets_of(other)
        assert vertical_force(one) == pytest.approx(vertical_force(other), rel=1e-7)


def slotted_square(seed: int | None = None) -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags]:
    """Return mesh and tags of a unit square with a slot 0.1 wide from its top down to y = 0.2.

    The order of its cells is random if a seed is given.
    """
    serial = dolfinx.mesh.create_rectangle(
        MPI.COMM_SELF, [(0.0, 0.0), (1.0, 1.0)], (20, 10), CellType.quadrilateral
    )
    x = serial.geometry.x[:, :2]
    cells = compat.geometry_dofmap(serial)
    middle = x[cells].mean(axis=1)
    cells = cells[(np.abs(middle[:, 0] - 0.5) > 0.05) | (middle[:, 1] < 0.2)]
    if seed is not None:
        cells = np.random.default_rng(seed).permutation(cells)
    used, number = np.unique(cells, return_inverse=True)
    mesh = create_mesh("quadrilateral", x[used], number.reshape(cells.shape))
    sides = {
        FLOOR: at_coordinate(1, 0.0),
        WEST: at_coordinate(0, 0.45),
        SOUTH: at_coordinate(0, 0.55),
        ROOF: any_of(at_coordinate(0, 0.0), at_coordinate(0, 1.0)),
    }
    return mesh, tag_by_midpoints(mesh, sides)


def test_self_contact_equals_contact_of_tagged_sides() -> None:
    """The legs of a fork pressed together have the force of tagged slot faces, to 1e-7."""
    computed = []
    for by_hand in (False, True):
        mesh, tags = slotted_square()
        u = fem.Function(displacement_space(mesh, 1))
        v = ufl.TestFunction(u.function_space)
        squeeze = fem.Constant(mesh, 0.7)
        ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags)
        F = fc.elasticity.NeoHookean(u, 50.0, 0.3, "plane strain").residual(v)
        F += squeeze * ufl.dot(ufl.FacetNormal(mesh), v) * ds(ROOF)
        bcs = [dirichlet_bc(u, tags, FLOOR, i) for i in (0, 1)]
        if by_hand:
            surface, other = fc.ContactSurface(mesh, tags, WEST), fc.DeformableBody(tags, SOUTH)
            contacts = [fc.Contact(u, surface, other, fc.Frictionless(), kinematics="finite")]
        else:
            assert fc.find_contact_pairs(u, fc.Frictionless(), 0.12) == []
            contacts = fc.find_contact_pairs(
                u, fc.Frictionless(), 0.12, self_contact=True, kinematics="finite"
            )
        (contact,) = contacts
        problem = fc.ContactProblem(F, u, bcs=bcs, contacts=contacts)
        for _ in fc.increments(problem, squeeze, 0.0, 0.7, steps=2):
            pass
        computed.append((contact, abs(contact.resultants().force[0])))
        assert n_facets_of(contact) == 8
    (first, one), (_, other) = computed
    assert first.name == "1-1"
    # Γc may be on the other leg, which is the mirror image.
    assert one > 0.05 and one == pytest.approx(other, rel=1e-7)


def test_slave_side_of_self_contact_is_independent_of_cell_numbering() -> None:
    """Γc is the left side of the slot for any numbering of cells and any number of ranks."""
    for seed in range(5):
        mesh, _ = slotted_square(seed)
        u = fem.Function(displacement_space(mesh, 1))
        (contact,) = fc.find_contact_pairs(u, fc.Frictionless(), 0.12, self_contact=True)
        assert np.allclose(gather(mesh.comm, contact.points)[:, 0], 0.45)


def test_all_facets_of_a_hole_are_slave_and_master(caplog: pytest.LogCaptureFixture) -> None:
    """The facets of a hole have no two sides: all are slave and master, and the log states it."""
    angle = 2 * np.pi * np.arange(16) / 16
    rings = [r * np.column_stack([np.cos(angle), np.sin(angle)]) for r in (1.0, 1.5)]
    i, j = np.arange(16), (np.arange(16) + 1) % 16
    mesh = create_mesh(
        "quadrilateral", np.concatenate(rings), np.column_stack([i, j, i + 16, j + 16])
    )
    u = fem.Function(displacement_space(mesh, 1))
    with caplog.at_level(logging.INFO, "fenics_contact"):
        assert fc.find_contact_pairs(u, fc.Frictionless(), 1.2, self_contact=True) == []
        (contact,) = fc.find_contact_pairs(
            u, fc.Frictionless(), 2.0, self_contact=True, kinematics="finite"
        )
    assert n_facets_of(contact) == 16
    points = gather(COMM, contact.gap)
    # The gap across the hole at the middle of facets is the diameter of the inscribed circle.
    assert points.min() == pytest.approx(2 * np.cos(np.pi / 16))
    if COMM.rank == 0:
        assert "all facets are on both sides" in caplog.text


# ---- pairs that are found, and choice of the slave side ------------------------------------------


def test_bodies_far_apart_are_not_paired(caplog: pytest.LogCaptureFixture) -> None:
    """Discs at distance 1 are paired above it only; the warning and the log state the distances."""
    joined = fc.join_meshes([disc((0, 0), 1, 4), disc((3, 0), 1, 5)])
    u = fem.Function(displacement_space(joined.mesh, 1))
    with pytest.warns(UserWarning, match=r"no two of the bodies \[1, 2\] are within 0.9"):
        assert fc.find_contact_pairs(u, fc.Frictionless(), 0.9) == []
    caplog.clear()
    with (
        caplog.at_level(logging.INFO, "fenics_contact"),
        pytest.warns(UserWarning, match="10 of the 16 points of Γc have no opposite"),
    ):
        (contact,) = fc.find_contact_pairs(u, fc.Frictionless(), 1.3)
    assert contact.name == "1-2"
    if COMM.rank == 0:
        # Γc is on the finer disc; its vertex is at distance 1 from the vertex of the other.
        assert "1-2: Γc on 2 with" in caplog.text and "; 1 to 1." in caplog.text
    x = gather(COMM, contact.points)
    assert np.all(x[:, 0] > 1.9) and n_facets_of(contact) > 3


def test_back_sides_are_not_paired() -> None:
    """In a stack of plates thinner than the search distance only facing sides are paired."""
    parts = [box("quadrilateral", (0, 0.1 * i), (1, 0.1 * (i + 1)), (8 + i, 1)) for i in range(3)]
    joined = fc.join_meshes(parts)
    u = fem.Function(displacement_space(joined.mesh, 1))
    contacts = fc.find_contact_pairs(u, fc.Frictionless(), 0.15, bodies=joined, self_contact=True)
    names = [contact.name for contact in contacts]
    # The outer plates also face each other across the middle one; this contact stays open.
    assert names == ["0-1", "0-2", "1-2"]
    for contact, y in zip(contacts, (0.1, 0.2, 0.2), strict=True):
        x = gather(COMM, contact.points)
        assert x[:, 1] == pytest.approx(np.full(len(x), y))
    close = fc.find_contact_pairs(u, fc.Frictionless(), 0.09, bodies=joined)
    assert [contact.name for contact in close] == ["0-1", "1-2"]


def test_initial_overlap_is_found_up_to_half_a_cell() -> None:
    """An overlap of a fifth of a cell is a contact; one of more than half a cell is not."""
    for depth, n_contacts in ((0.05, 1), (0.2, 0)):
        parts = [
            box("quadrilateral", (0, 0), (1, 1), (4, 4)),
            box("quadrilateral", (0, 1 - depth), (1, 2 - depth), (5, 4)),
        ]
        joined = fc.join_meshes(parts)
        u = fem.Function(displacement_space(joined.mesh, 1))
        contacts = fc.find_contact_pairs(u, fc.Frictionless(), 0.3, bodies=joined)
        assert len(contacts) == n_contacts
        for contact in contacts:
            gap = gather(COMM, contact.gap)
            assert n_facets_of(contact) == 5 and gap == pytest.approx(np.full(len(gap), -depth))


def test_choice_of_the_slave_side() -> None:
    """Γc is the finer side, of equal ones that with fewer facets, or given by `slave_bodies`."""
    law = fc.Frictionless()
    for n, width, expected in ((8, 1.0, 1), (3, 1.0, 0), (2, 0.5, 1), (1, 0.5, 0)):
        parts = [
            box("quadrilateral", (0, 0), (1, 0.5), (4, 2)),
            box("quadrilateral", (0, 0.5), (width, 1), (n, 2)),
        ]
        joined = fc.join_meshes(parts)
        u = fem.Function(displacement_space(joined.mesh, 1))
        (contact,) = fc.find_contact_pairs(u, law, 0.3, bodies=joined)
        on_upper = n_facets_of(contact) == n
        assert on_upper == bool(expected), (n, width)
        for order, chosen in (((0,), 0), ((1,), 1), ((1, 0), 1), ((0, 1), 0)):
            (contact,) = fc.find_contact_pairs(u, law, 0.3, bodies=joined, slave_bodies=order)
            looks = COMM.allreduce(contact.values.normal[:, 1].sum()) > 0
            assert looks == (chosen == 0)


def test_bodies_are_named_by_cell_tags_or_connected_parts() -> None:
    """Three ways to name the same two bodies give one contact; `tags` restricts the facets."""
    parts = {
        "a": box("triangle", (0, 0), (1, 1), (3, 3)),
        "b": box("triangle", (0, 1), (1, 2), (4, 4)),
    }
    joined = fc.join_meshes(parts)
    u = fem.Function(displacement_space(joined.mesh, 1))
    tags = dolfinx.mesh.meshtags(
        joined.mesh, 2, joined.cells.indices, 10 * joined.cells.values.astype(np.int32)
    )
    for bodies, name in ((None, "1-2"), (joined, "a-b"), (tags, "10-20")):
        (contact,) = fc.find_contact_pairs(u, fc.Frictionless(), 0.1, bodies=bodies)
        assert contact.name == name and n_facets_of(contact) == 4
    floors = [joined.facet(body, FLOOR) for body in "ab"]
    only = {"facet_tags": joined.facets, "tags": floors}
    assert fc.find_contact_pairs(u, fc.Frictionless(), 0.1, **only) == []
    only["tags"] = [*floors, joined.facet("a", ROOF)]
    assert len(fc.find_contact_pairs(u, fc.Frictionless(), 0.1, **only)) == 1


def test_law_can_be_a_function_of_the_pair() -> None:
    """A callable law is called with the names of both bodies."""
    scene = three_blocks("quadrilateral")
    calls = []

    def law(a: Any, b: Any) -> fc.Law:
        calls.append((a, b))
        return fc.Coulomb(0.3) if a == "low" else fc.Frictionless()

    contacts = fc.find_contact_pairs(
        scene.u, law, 0.1, bodies=scene.joined, enforcement="augmented"
    )
    assert calls == [("low", "mid"), ("mid", "top")]
    assert [contact.law.has_friction for contact in contacts] == [True, False]
    assert all(contact.multipliers is not None for contact in contacts)


def test_invalid_arguments_are_reported_on_every_rank() -> None:
    """Errors state the given and the expected argument, on every rank."""
    mesh, _, _ = box("triangle", (0, 0), (1, 1), (2, 2))
    joined = fc.join_meshes([mesh, box("triangle", (0, 1), (1, 2), (2, 2))[0]])
    u = fem.Function(displacement_space(joined.mesh, 1))
    law = fc.Frictionless()
    half = joined.cells.indices[joined.cells.values == 1]
    some = dolfinx.mesh.meshtags(joined.mesh, 2, half, np.ones(len(half), dtype=np.int32))
    ready: dict[str, Any] = {"u": u, "law": law, "distance": 0.1}
    for options, words in (
        ({"u": 3}, ["find_contact_pairs: u is"]),
        ({"distance": 0.0}, ["distance is 0.0", "greater than zero"]),
        ({"distance": "near"}, ["'near'"]),
        ({"law": 3}, ["law is a int", "Law"]),
        ({"law": fc.Frictionless}, ["law is the class Frictionless"]),
        ({"law": lambda a, b: None}, ["1-2", "law", "NoneType"]),
        ({"bodies": 2}, ["bodies is a int", "JoinedMesh"]),
        ({"bodies": fc.join_meshes([mesh])}, ["another mesh"]),
        ({"bodies": joined.facets}, ["dimension 1", "dimension 2"]),
        ({"bodies": some}, ["8 cells have no tag"]),
        ({"slave_bodies": ["ball"]}, ["'ball'", "[1, 2]"]),
        ({"slave_bodies": "ball"}, ["slave_bodies is 'ball'", "list", "[1, 2]"]),
        ({"slave_bodies": 2}, ["slave_bodies is 2", "list"]),
        ({"facet_tags": joined.facets}, ["together"]),
        ({"name": "joint"}, ["name is given"]),
        ({"obstacle": fc.HalfSpace((0, 0), (0, 1))}, ["obstacle given", "create a Contact"]),
        ({"surface": None, "opposite": 2}, ["surface and opposite given"]),
        ({"kinematics": "large"}, ["'large'"]),
        ({"update_pairs": "often"}, ["'often'"]),
    ):
        arguments = ready | options
        assert_raised_on_all_ranks(
            lambda a=arguments: fc.find_contact_pairs(**a), ValueError, *words
        )
