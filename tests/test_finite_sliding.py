"""Finite sliding of two deformable bodies: pairs at deformed positions, forces and tangent.

`kinematics="finite"` with a `DeformableBody`. The first tests prescribe displacements: perturbed
nodal positions, so that nothing is symmetric, on bodies rotated by a large angle.
"""

from __future__ import annotations

import dolfinx
import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact import compat
from fenics_contact.checks.body_probe import OpposingBodyProbe
from fenics_contact.checks.tunnelling import TunnellingCheck
from fenics_contact.elasticity import NeoHookean
from fenics_contact.systems.operator import ContactOperator
from scenes.elasticity import dirichlet_bc, displacement_space, residual
from scenes.meshes import create_mesh
from scenes.stacks import FLOOR, ROOF, SIDES, floor, joint, stack
from scenes.tags import at_coordinate, tag_by_midpoints
from scenes.two_blocks import BOTTOM, LOWER_FACE, TOP, UPPER_FACE, two_blocks
from verification.extreme_bodies import TwoBlocks

pytestmark = [pytest.mark.three_ranks, pytest.mark.hexahedra]

COMM = MPI.COMM_WORLD
CELLS = ["triangle", "quadrilateral", "tetrahedron", "hexahedron"]
LAWS = {
    "frictionless": fc.Frictionless(k_n=1e3),
    "coulomb": fc.Coulomb(0.3, k_n=1e3, k_t=5e2),
    "tresca": fc.Tresca(0.3, 20.0, k_n=1e3, k_t=5e2),
}


class Pair:
    """A small block on a larger one with non-matching meshes; displacements are prescribed.

    Attributes:
        mesh, tags, u, contact: Mesh, facet tags, displacement and contact.
        d: Dimension of space.
    """

    def __init__(
        self,
        cell: str,
        law: fc.Law,
        *,
        degree: int = 1,
        n: tuple[int, int] = (4, 3),
        like: Pair | None = None,
        **options,
    ) -> None:
        """Create the blocks, or use the mesh of `like`: a new mesh may be partitioned differently.

        Collective.
        """
        widths, shift = ((1.0, 0.6), 0.17) if n == (4, 3) else ((1.0, 1.0), 0.0)
        mesh_and_tags = (
            two_blocks(cell, n, widths, shift) if like is None else (like.mesh, like.tags)
        )
        self.mesh, self.tags = mesh, tags = mesh_and_tags
        self.d = mesh.geometry.dim
        self.u = fem.Function(displacement_space(mesh, degree))
        surface = fc.ContactSurface(mesh, tags, UPPER_FACE)
        opposite = fc.DeformableBody(tags, LOWER_FACE)
        self.contact = fc.Contact(self.u, surface, opposite, law, **options)

    @property
    def nodes(self) -> np.ndarray:
        """Undeformed positions of the nodes, ghosts included, (n, d)."""
        return self.u.function_space.tabulate_dof_coordinates()[:, : self.d]

    def place(self, x: np.ndarray) -> None:
        """Set u such that the deformed positions of the nodes are x, (n, d)."""
        self.u.x.array[:] = (x - self.nodes).ravel()
        self.u.x.scatter_forward()

    def perturbed_nodes(self, size: float, seed: int) -> np.ndarray:
        """Return nodal positions perturbed by sine waves, equal on any number of ranks, (n, d)."""
        rng = np.random.default_rng(seed)
        k, phase = rng.uniform(3, 9, (self.d, self.d)), rng.uniform(0, 6, self.d)
        return self.nodes + size * np.sin(self.nodes @ k.T + phase)

    def pressed(self, x: np.ndarray, down: float, along: float) -> np.ndarray:
        """Return the positions x with those of the upper body translated."""
        upper = np.zeros(len(x), dtype=bool)
        space = self.u.function_space
        middles = dolfinx.mesh.compute_midpoints(
            self.mesh, self.d, np.arange(len(space.dofmap.list), dtype=np.int32)
        )
        upper[space.dofmap.list[middles[:, self.d - 1] > 0.5].ravel()] = True
        moved = x.copy()
        moved[upper, self.d - 1] -= down
        moved[upper, 0] += along
        return moved

    def force(self) -> np.ndarray:
        """Return the contact part of the residual at the dofs of this rank. Collective."""
        self.contact.contact_kinematics.update()
        operator = ContactOperator(self.contact)
        vector = operator.unknowns.vector()
        vector.set(0.0)
        operator.add_force(vector)
        return vector.array_r.copy()


def turn(d: int, angle: float) -> np.ndarray:
    """Return a rotation matrix, in 3D about an axis oblique to all coordinate axes."""
    if d == 2:
        c, s = np.cos(angle), np.sin(angle)
        return np.array([[c, -s], [s, c]])
    axis = np.array([1.0, 2.0, -1.0]) / np.sqrt(6)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def set_loaded_state(pair: Pair, along: float) -> None:
    """Commit a state of rotated bodies, then rotate, press and shear them further."""
    d = pair.d
    pair.place(pair.pressed(pair.perturbed_nodes(0.01, 1), 0.04, 0.0) @ turn(d, 0.7).T)
    pair.contact.commit()
    pair.place(pair.pressed(pair.perturbed_nodes(0.013, 2), 0.045, along) @ turn(d, 1.1).T)


@pytest.mark.each
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("along", [0.004, 0.08])
@pytest.mark.parametrize(("cell", "degree"), [*((c, 1) for c in CELLS), ("triangle", 2)])
def test_tangent_is_the_derivative_of_the_forces(cell, degree, along, law):
    """Central differences with steps of 1e-6 give the tangent to 1e-6 of the largest entry."""
    pair = Pair(cell, LAWS[law], degree=degree, kinematics="finite")
    set_loaded_state(pair, along)
    pair.contact.evaluate()
    resultants = pair.contact.resultants()
    assert resultants.max_penetration > 0.01
    operator = ContactOperator(pair.contact)
    tangent = operator.tangent()
    direction = pair.perturbed_nodes(1.0, 5) - pair.nodes
    positions = pair.nodes + pair.u.x.array.reshape(-1, pair.d)
    vector, product = operator.unknowns.vector(), operator.unknowns.vector()
    vector.array[:] = direction.ravel()[: vector.array.size]
    tangent.mult(vector, product)
    forces = []
    for step in (1e-6, -1e-6):
        pair.place(positions + step * direction)
        forces.append(pair.force())
    slope = (forces[0] - forces[1]) / 2e-6
    size = MPI.COMM_WORLD.allreduce(np.abs(slope).max(initial=0.0), op=MPI.MAX)
    assert np.abs(slope - product.array_r).max(initial=0.0) <= 1e-6 * size


def test_states_of_the_tangent_test_have_slip_and_stick():
    """The two states of the tangent test include sticking and slipping points."""
    states = set()
    for along in (0.004, 0.08):
        pair = Pair("triangle", LAWS["coulomb"], kinematics="finite")
        set_loaded_state(pair, along)
        pair.contact.evaluate()
        r = pair.contact.resultants()
        states |= {name for name in ("stick", "slip") if getattr(r, name)}
    assert states == {"stick", "slip"}


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron"])
def test_contact_forces_are_frame_invariant(cell):
    """Forces rotate with both bodies after the commit, to 1e-10, also if about the normal."""
    forces, pair = [], None
    for angle in (0.0, 0.9, -2.5):
        pair = Pair(cell, LAWS["coulomb"], like=pair, kinematics="finite")
        set_loaded_state(pair, 0.004)
        x = (pair.nodes + pair.u.x.array.reshape(-1, pair.d)) @ turn(pair.d, angle).T
        pair.place(x + 0.3)
        forces.append(pair.force().reshape(-1, pair.d) @ turn(pair.d, angle))
    size = MPI.COMM_WORLD.allreduce(np.abs(forces[0]).max(initial=0.0), op=MPI.MAX)
    assert size > 1.0
    for other in forces[1:]:
        assert np.abs(other - forces[0]).max(initial=0.0) <= 1e-10 * size


@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_forces_on_both_bodies_cancel(cell):
    """The resultant is round-off; the moment is at most gap times tangential traction, summed."""
    pair = Pair(cell, LAWS["coulomb"], kinematics="finite")
    set_loaded_state(pair, 0.08)
    force = pair.force().reshape(-1, pair.d)
    pair.contact.evaluate()
    comm = MPI.COMM_WORLD
    total = comm.allreduce(force.sum(axis=0))
    size = comm.allreduce(np.abs(force).sum())
    assert np.abs(total).max() <= 1e-14 * size
    x = (pair.nodes + pair.u.x.array.reshape(-1, pair.d))[: len(force)]
    moment = comm.allreduce(np.sum(x[:, 0] * force[:, 1] - x[:, 1] * force[:, 0]))
    c = pair.contact
    gap = np.abs(c.gap)
    torque = comm.allreduce(np.sum(c.measure * gap * np.linalg.norm(c.tangential_traction, axis=1)))
    assert abs(moment) <= torque + 1e-13 * size


def test_small_kinematics_are_the_limit_of_finite_kinematics():
    """On matching meshes the relative difference of the forces falls in proportion to the size."""
    errors, pair = [], None
    for size in (1e-3, 1e-4):
        tractions = []
        for kinematics in ("small", "finite"):
            pair = Pair("triangle", LAWS["coulomb"], n=(5, 5), like=pair, kinematics=kinematics)
            pair.place(pair.pressed(pair.perturbed_nodes(size, 2), 3 * size, 0.7 * size))
            tractions.append(pair.force() / size)
        errors.append(np.abs(tractions[0] - tractions[1]).max(initial=0.0))
    errors = np.array([MPI.COMM_WORLD.allreduce(e, op=MPI.MAX) for e in errors])
    assert 0 < errors[1] < 0.15 * errors[0]


class Blocks:
    """Two neo-Hookean blocks; the top of the upper one has a prescribed displacement.

    Attributes:
        contact, problem, u: Contact, problem and displacement.
    """

    def __init__(
        self,
        cell: str,
        law: fc.Law,
        n: tuple[int, int],
        *,
        size: float = 1.0,
        angle: float = 0.0,
        **options,
    ) -> None:
        """Create the unloaded blocks, scaled by size and rotated by angle. Collective."""
        widths, shift = ((2.0, 1.0), 0.3) if n[0] != n[1] else ((1.0, 1.0), 0.0)
        self.mesh, tags = two_blocks(cell, n, widths, shift)
        x, d = self.mesh.geometry.x, self.mesh.geometry.dim
        x[:, :d] = size * x[:, :d] @ turn(d, angle).T
        self.d = d = self.mesh.geometry.dim
        self.u = fem.Function(displacement_space(self.mesh, 1))
        v = ufl.TestFunction(self.u.function_space)
        self.top = [fem.Constant(self.mesh, 0.0) for _ in range(d)]
        bcs = [dirichlet_bc(self.u, tags, BOTTOM, i) for i in range(d)]
        bcs += [dirichlet_bc(self.u, tags, TOP, i, value) for i, value in enumerate(self.top)]
        self.contact = fc.Contact(
            self.u,
            fc.ContactSurface(self.mesh, tags, UPPER_FACE),
            fc.DeformableBody(tags, LOWER_FACE),
            law,
            kinematics="finite",
            **options,
        )
        body = NeoHookean(self.u, 100.0, 0.3, "plane strain" if d == 2 else "3D")
        self.problem = fc.ContactProblem(body.residual(v), self.u, bcs=bcs, contacts=[self.contact])

    def load(self, t: float) -> None:
        """Press the top down while t < 1, then drag it sideways."""
        self.top[-1].value = -0.05 * min(t, 1.0)
        self.top[0].value = 0.6 * max(t - 1.0, 0.0)

    def history(self, until: float, steps, **options) -> list[fc.Step]:
        """Solve and commit all increments. Collective."""
        return list(fc.increments(self.problem, self.load, 0.0, until, steps=steps, **options))


SLIDE_LOADS = [0.5, 1.0, 1.2, 1.4, 1.6, 1.8, 2.0]


@pytest.mark.parametrize("enforcement", ["penalty", "augmented"])
def test_block_slides_over_several_facets(enforcement):
    """Sliding over three facets: T = μ N to 1e-9 (augmented 1e-4), dissipation μ N w to 10 %."""
    blocks = Blocks("triangle", fc.Coulomb(0.2), (6, 4), enforcement=enforcement)
    steps = blocks.history(2.0, SLIDE_LOADS)
    force = steps[-1].contacts["contact"]
    assert force.slip > 0 and force.stick == 0
    # Resultants along and across the present normals: the tractions are on the friction cone.
    ratio = force.tangential_force / force.normal_force
    assert ratio == pytest.approx(0.2, rel=1e-9 if enforcement == "penalty" else 1e-4)
    taken = sum(step.energy.dissipation for step in steps[2:])
    assert taken == pytest.approx(0.6 * 0.2 * force.normal_force, rel=0.1)  # N is nearly constant


def test_sliding_and_load_reversal_take_few_newton_steps():
    """A predictor with the points that slipped before needs 34 and 31 steps; with stick 53 and 38.

    In the first increment after the load reversal all points stick, and so does the predictor.
    """
    blocks = Blocks("triangle", fc.Coulomb(0.3), (12, 6))
    forth = [step.iterations for step in blocks.history(2.0, SLIDE_LOADS)]
    remaining = fc.increments(blocks.problem, blocks.load, 2.0, 1.5, steps=10)
    back = [step.iterations for step in remaining]
    assert sum(forth) <= 40 and sum(back) <= 34 and back[0] <= 4


def test_resumed_history_equals_the_uninterrupted_one(tmp_path):
    """Contact forces of a history resumed from a checkpoint are those without a stop, to 1e-9."""
    path = MPI.COMM_WORLD.bcast(tmp_path) / "state"
    uninterrupted = Blocks("triangle", fc.Coulomb(0.2), (6, 4))
    steps = uninterrupted.history(2.0, SLIDE_LOADS)
    first = Blocks("triangle", fc.Coulomb(0.2), (6, 4))
    for step in fc.increments(
        first.problem, first.load, 0.0, 2.0, steps=SLIDE_LOADS, checkpoint=path
    ):
        if step.load >= 1.4:
            break
    resumed = Blocks("triangle", fc.Coulomb(0.2), (6, 4))
    remaining = list(
        fc.increments(resumed.problem, resumed.load, 0.0, 2.0, steps=SLIDE_LOADS, checkpoint=path)
    )
    assert len(remaining) == 3
    for step, other in zip(remaining, steps[-3:], strict=True):
        resumed_results, expected_results = step.contacts["contact"], other.contacts["contact"]
        np.testing.assert_allclose(resumed_results.force, expected_results.force, rtol=1e-9)


def test_rotated_patch_has_uniform_pressure():
    """Matching meshes rotated by half a radian and pressed have uniform pressure, to 1e-10."""
    pair = Pair("triangle", fc.Frictionless(k_n=1e3), n=(5, 5), kinematics="finite")
    x = pair.pressed(pair.nodes, 0.01, 0.0) @ turn(2, 0.5).T
    pair.place(x)
    pair.contact.evaluate()
    np.testing.assert_allclose(pair.contact.pressure, 10.0, rtol=1e-10)
    nodal = pair.force().reshape(-1, 2)
    along = nodal @ turn(2, 0.5)[:, 0]
    assert np.abs(along).max(initial=0.0) <= 1e-12


def _rotated_pair(cell, path):
    """Return two bodies rotated by 0.4 radians, the upper one translated from commit to commit."""
    pair = Pair(cell, fc.Coulomb(0.3, k_n=1e3, k_t=5e2), kinematics="finite")
    for down, along in path:
        pair.contact.commit()
        pair.before = pair.contact.u.copy()
        pair.place(pair.pressed(pair.nodes, down, along) @ turn(pair.d, 0.4).T)
        pair.contact.evaluate()
    return pair


def _tunnelling_point(pair):
    """Return a point that has crossed the other body since the last commit, or None."""
    return TunnellingCheck([pair.contact]).evaluate(pair.before)["contact"].crossed


def test_probe_of_rotated_bodies_has_the_deformed_positions():
    """A probe created for bodies rotated by 90° has the deformed positions of points, to 1e-12.

    The normals are then along the undeformed Γc.
    """
    pair = Pair("triangle", LAWS["coulomb"], kinematics="finite")
    pair.place(pair.pressed(pair.nodes, 0.05, 0.0) @ turn(2, np.pi / 2).T)
    pair.contact.evaluate()
    x = pair.contact.values.x
    probe = OpposingBodyProbe(pair.contact, None)
    assert probe.x[: len(x)] == pytest.approx(x, rel=0, abs=1e-12)


@pytest.mark.each
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
@pytest.mark.parametrize(
    ("path", "through"),
    [
        ([(0.05, 0.0)], False),  # penetration as the penalty allows it
        ([(0.2, 0.0)], False),  # penetration below the height of a cell: still paired
        ([(0.7, 0.1)], True),
        ([(1.2, -0.1)], True),  # out at the back
        ([(-2.0, 0.0), (0.7, 0.1)], True),  # from a large distance
        ([(0.0, 2.0), (1.2, 2.0), (1.2, 0.0)], False),  # around the edge, to below the body
        ([(0.05, 0.0), (0.05, 0.3), (-1.0, 0.0)], False),
    ],
)
def test_tunnelling_through_rotated_bodies_is_detected(cell, path, through):
    """Only points whose path in an increment enters the body too deep or leaves it are reported."""
    pair = _rotated_pair(cell, path)
    assert (_tunnelling_point(pair) is not None) == through


@pytest.mark.each
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
@pytest.mark.parametrize(
    ("path", "through"),
    [
        ([(-0.1, 0.0), (1.2, 1.0)], True),  # out at the back and to the side
        ([(-0.1, 0.0), (-0.1, 1.2), (1.2, 1.2)], False),  # around the edge
        ([(0.05, 0.0), (0.05, 1.2)], False),  # dragged off the end at constant penetration
        ([(0.05, 0.0), (0.3, 1.2)], False),  # over its edge, less deep than the height of a cell
    ],
)
def test_tunnelling_of_unpaired_points_is_detected(cell, path, through):
    """Tunnelling is detected although no point has an opposite point after the increment."""
    pair = _rotated_pair(cell, path)
    assert not MPI.COMM_WORLD.allreduce(int(pair.contact.values.paired.any()))
    assert (_tunnelling_point(pair) is not None) == through


def test_number_of_newton_steps_is_independent_of_units_and_rotation():
    """Initial gaps of bodies in touch that are round-off count as zero, and close no points.

    Otherwise, rotated or in another unit of length, the first increment takes at least 14 steps
    instead of 5.
    """
    computed = []
    for size, angle in ((1.0, 0.0), (1e-3, 0.0), (1.0, 0.9)):
        blocks = Blocks("triangle", fc.Coulomb(0.3), (12, 8), size=size, angle=angle)
        steps = []
        for down in (0.02, 0.04):
            for value, part in zip(blocks.top, turn(2, angle) @ [0.0, -size * down], strict=True):
                value.value = part
            steps.append(blocks.problem.solve().iterations)
            blocks.problem.commit()
        computed.append(steps)
    assert computed[1] == computed[0] and computed[2] == computed[0]


def test_increment_that_crosses_the_other_body_fails_or_is_cut():
    """An increment of two cells fails in `solve`; `increments` reaches the force of small ones.

    Without friction the force is independent of the increments, to 1e-8 (the residuals).
    """
    forces = []
    for steps in (1, 4):
        blocks = Blocks("triangle", fc.Frictionless(), (12, 8))

        def load(t, blocks=blocks):
            blocks.top[-1].value = 0.2 - 0.4 * t

        load(0.0)
        blocks.problem.solve()
        blocks.problem.commit()
        if steps == 1:
            load(1.0)
            with pytest.raises(fc.NotConverged, match="has crossed"):
                blocks.problem.solve()
        *_, step = fc.increments(blocks.problem, load, 0.0, 1.0, steps=steps)
        forces.append(step.contacts["contact"].force)
    assert forces[1][1] > 5.0
    np.testing.assert_allclose(forces[0], forces[1], atol=1e-8 * forces[1][1])


def test_separated_bodies_are_in_equilibrium_to_round_off():
    """Increments after a block is dragged off the end are accepted, with contact forces of zero.

    The residual of the unloaded body, 1e-15, is the round-off of I + ∇u: there is no force to
    compare it with.
    """
    blocks = Blocks("quadrilateral", fc.Coulomb(0.3), (12, 6))

    def load(t: float) -> None:
        blocks.top[1].value, blocks.top[0].value = -0.05 * min(t, 1.0), 2.0 * max(t - 1.0, 0.0)

    steps = list(fc.increments(blocks.problem, load, 0.0, 2.0, steps=[1.0, 1.4, 1.95, 1.98, 2.0]))
    forces = np.array([step.contacts["contact"].force for step in steps])
    assert forces[0, 1] > 1.0
    assert not forces[-3:].any()


def test_bodies_in_touch_can_rotate_by_a_full_turn():
    """Round-off between the quadrature points is not reported as penetration.

    Γc has two points, opposite to 20 facets of the other body; the penetration is 1e-14.
    """
    both = TwoBlocks("newton", mu=0.3, n=(40, 1), edge_gap=0.1)
    steps = (
        both.move_to(0.0, 0.1, 2)
        + both.move_to(0.05, 0.1, 2)
        + both.move_to(0.05, 0.1, 36, 2 * np.pi)
    )
    assert len(steps) == 40
    assert np.abs(both.force).max() < 1e-8


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_initial_overlap_of_several_cells_is_resolved(cell):
    """Two laterally constrained columns overlap by 0.2, twice the height of their cells.

    Closed form: both have the stretch l, and their stress (G + λ/2) (1/l - l) is that of the
    contact springs, k (l - 0.8), as their heights are 1/2. The force agrees to 1e-9.
    """
    body = stack(cell, (10, 10), (0.5, 0.5), gap=-0.2)
    u, k = body.u, 1e3
    body.prescribe(SIDES, 0)
    body.prescribe(FLOOR, 1)
    body.prescribe(ROOF, 1)
    contact = joint(body, 1, fc.Frictionless(k), kinematics="finite")
    bulk = NeoHookean(u, 100.0, 0.3, "plane strain")
    residual = bulk.residual(ufl.TestFunction(u.function_space))
    problem = fc.ContactProblem(residual, u, bcs=body.bcs, contacts=[contact])
    assert problem.initial_penetration == pytest.approx(0.2, abs=1e-12)
    problem.solve()
    problem.commit()
    modulus = 100 / 2.6 + 0.5 * 30 / (1.3 * 0.4)  # G + λ/2
    # (k + modulus) l² - 0.8 k l - modulus = 0
    a, b = k + modulus, 0.8 * k
    stretch = (b + np.sqrt(b**2 + 4 * a * modulus)) / (2 * a)
    assert contact.pairs.n_unpaired == 0
    assert contact.resultants().normal_force == pytest.approx(k * (stretch - 0.8), rel=1e-9)


def slotted_plate() -> tuple[dolfinx.mesh.Mesh, dolfinx.mesh.MeshTags]:
    """Return a plate slotted from its right side; tags of both slot faces, bottom and top."""
    rectangle = dolfinx.mesh.create_rectangle(
        MPI.COMM_SELF, [[0, 0], [2, 1.1]], (20, 11), dolfinx.mesh.CellType.quadrilateral
    )
    x, cells = rectangle.geometry.x[:, :2].copy(), compat.geometry_dofmap(rectangle)
    middle = x[cells].mean(axis=1)
    slot = (middle[:, 0] > 0.5) & (np.abs(middle[:, 1] - 0.55) < 0.05)
    mesh = create_mesh("quadrilateral", x, cells[~slot])
    chosen = {
        LOWER_FACE: lambda x, _: np.isclose(x[:, 1], 0.5) & (x[:, 0] > 0.5),
        UPPER_FACE: lambda x, _: np.isclose(x[:, 1], 0.6) & (x[:, 0] > 0.5),
        BOTTOM: at_coordinate(1, 0.0),
        TOP: lambda x, _: np.isclose(x[:, 1], 1.1) & (x[:, 0] > 1.4),
    }
    return mesh, tag_by_midpoints(mesh, chosen)


def test_self_contact_has_the_force_of_two_named_surfaces():
    """Self-contact of both faces of a slot has the force of a slave and a master face, to 1e-3.

    Both faces then have quadrature points, at different positions, each with half the stiffness.
    """
    forces = []
    for slave, opposite, stiffness_ratio in (
        (UPPER_FACE, LOWER_FACE, 20),
        ([LOWER_FACE, UPPER_FACE], [LOWER_FACE, UPPER_FACE], 10),
    ):
        mesh, tags = slotted_plate()
        u = fem.Function(displacement_space(mesh, 1))
        down = fem.Constant(mesh, 0.0)
        contact = fc.Contact(
            u,
            fc.ContactSurface(mesh, tags, slave),
            fc.DeformableBody(tags, opposite),
            fc.Coulomb(
                0.2, fc.RelativeStiffness(stiffness_ratio), fc.RelativeStiffness(stiffness_ratio)
            ),
            kinematics="finite",
        )
        body = NeoHookean(u, 100.0, 0.3, "plane strain")
        bcs = [dirichlet_bc(u, tags, BOTTOM, i) for i in range(2)] + [
            dirichlet_bc(u, tags, TOP, 1, down)
        ]
        form = body.residual(ufl.TestFunction(u.function_space))
        problem = fc.ContactProblem(form, u, bcs=bcs, contacts=[contact])
        *_, step = fc.increments(problem, down, 0.0, -0.2, steps=4)
        forces.append(step.contacts["contact"].normal_force)
    assert forces[0] > 5.0
    assert forces[1] == pytest.approx(forces[0], rel=1e-3)


def test_round_off_magnitude_covers_the_dofs_of_new_pairs():
    """Coordinates of size 1 count in the round-off of all coupled dofs, also after sliding."""
    pair = Pair("triangle", LAWS["coulomb"], kinematics="finite")
    bcs = [dirichlet_bc(pair.u, pair.tags, tag, i) for tag in (BOTTOM, TOP) for i in range(2)]
    form = residual(pair.u, ufl.TestFunction(pair.u.function_space), 100.0, 0.3)
    problem = fc.ContactProblem(form, pair.u, bcs=bcs, contacts=[pair.contact])
    system, at_rest = problem.full, np.zeros(problem.full.unknowns.n_local)
    touched = []
    for along in (0.0, 0.2):
        pair.place(pair.pressed(pair.nodes, 0.01, along))
        system.diagonal[:] = 1.0
        (operator,) = system.operators
        touched.append(operator.coupled_dofs)
        assert (system.roundoff_magnitude(at_rest)[operator.coupled_dofs] > 0.5).all()
    new = np.setdiff1d(touched[1], touched[0]).size
    assert system.unknowns.comm.allreduce(new) > 0


def test_residual_of_a_degenerate_surface_is_nan():
    """If Γc collapses to a line, the residual is NaN, and a line search shortens the step."""
    pair = Pair("tetrahedron", LAWS["coulomb"], kinematics="finite")
    bcs = [dirichlet_bc(pair.u, pair.tags, tag, i) for tag in (BOTTOM, TOP) for i in range(3)]
    form = residual(pair.u, ufl.TestFunction(pair.u.function_space), 100.0, 0.3)
    options = {"bcs": bcs, "contacts": [pair.contact], "condensation": False}
    problem = fc.ContactProblem(form, pair.u, **options)
    x = pair.nodes
    line = x.copy()
    line[np.isclose(x[:, 2], 0.5), 1] = 0.5
    for places, lost in ((x, False), (line, True), (x, False)):
        pair.place(places)
        norm = problem.solver.equations.residual_at(problem.full.state())
        assert problem.full.is_degenerate() == lost
        assert np.isnan(norm) == lost
        assert not problem.full.is_over_rotated()


@pytest.mark.parametrize("cell", CELLS)
def test_candidate_facets_include_those_crossed_in_the_increment(cell):
    """Candidates are found where bodies overlap or have crossed in the increment, else none."""
    pair = Pair(cell, LAWS["coulomb"], kinematics="finite")
    search, before = pair.contact.pairs.search, pair.u.copy()
    n_facets, counts = len(search.rays.slave.facets.cells), []
    # Apart by more than a cell; into each other; through each other; beyond and at rest.
    for old, new in ((-2.0, -3.0), (-2.0, 0.01), (-2.0, 3.0), (3.0, 3.0)):
        pair.place(pair.pressed(pair.nodes, old, 0.0))
        before.x.array[:] = pair.u.x.array
        pair.place(pair.pressed(pair.nodes, new, 0.0))
        candidates = search.find_candidate_facets(pair.u, before, 0.0)
        total = [COMM.allreduce(len(near)) for near in candidates]
        counts.append(total)
        if new > old:  # all of Γc is opposite to the other body
            assert total[0] == COMM.allreduce(n_facets) and total[1] > 0
    assert counts[0] == counts[3] == [0, 0]


@pytest.mark.parametrize(
    ("cell", "degree"), [("triangle", 1), ("quadrilateral", 2), ("tetrahedron", 1)]
)
def test_static_condensation_gives_the_full_solution(cell, degree):
    """Static condensation retains all nodes of both surfaces and gives the same history, to 1e-10.

    A block is pressed, and dragged over facets of the other one, with a single factorisation.
    """
    computed, pair = [], None
    for condensation in (True, False):
        pair = Pair(cell, fc.Coulomb(0.3), degree=degree, like=pair, kinematics="finite")
        mesh, tags, last = pair.mesh, pair.tags, pair.d - 1
        side, down = fem.Constant(mesh, 0.0), fem.Constant(mesh, 0.0)
        bcs = [dirichlet_bc(pair.u, tags, BOTTOM, i) for i in range(pair.d)]
        bcs += [
            dirichlet_bc(pair.u, tags, TOP, i, {0: side, last: down}.get(i, 0.0))
            for i in range(pair.d)
        ]
        problem = fc.ContactProblem(
            residual(pair.u, ufl.TestFunction(pair.u.function_space), 1e3, 0.3),
            pair.u,
            bcs=bcs,
            contacts=[pair.contact],
            condensation=condensation,
            petsc_options={"snes_rtol": 1e-12},
        )
        history = []
        for number, place in enumerate([(0, -1), (0, -2), (10, -2), (20, -3), (10, -2)]):
            side.value, down.value = 0.01 * np.array(place)
            step = problem.solve(recover_interior=False)
            problem.commit()
            assert step.complete  # the checks need all of u, so it is recovered
            assert not condensation or step.factorisations == (number == 0)
            history.append([*step.contacts["contact"].force, *step.contacts["contact"].moment])
        computed.append((np.array(history), pair.u.x.array.copy()))
    for condensed, full in zip(*computed, strict=True):
        assert condensed == pytest.approx(full, rel=0, abs=1e-10 * np.abs(full).max())


@pytest.mark.parametrize("constrained", [True, False])
def test_condensation_requires_constrained_bodies(constrained):
    """A body constrained by contact only may be ejected, and its check needs all dofs."""
    pair = Pair("triangle", fc.Coulomb(0.3), kinematics="finite")
    tags = (BOTTOM, TOP) if constrained else (BOTTOM,)
    bcs = [dirichlet_bc(pair.u, pair.tags, tag, i) for tag in tags for i in range(2)]
    form = residual(pair.u, ufl.TestFunction(pair.u.function_space), 1e3, 0.3)
    arguments = (form, pair.u), {"bcs": bcs, "contacts": [pair.contact]}
    assert fc.ContactProblem(*arguments[0], **arguments[1]).solver.condensed == constrained
    if not constrained:
        with pytest.raises(ValueError, match="constrained by contact only"):
            fc.ContactProblem(*arguments[0], **arguments[1], condensation=True)


def test_all_points_of_a_joint_slip_below_the_friction_limit() -> None:
    """Three unconstrained blocks, each wider than the one below, are on a floor tilted to 0.95 μ.

    Surfaces with different strain may slip at all points of a joint, in opposite directions, below
    the friction limit. The tangent along the slip then has only the slopes of the strained
    surfaces, 1e-4, and a Newton step is 1e4 times too long. By statics, the ratio of tangential to
    normal force is the tangent of the angle in every joint, to 1e-6.
    """
    body = stack("quadrilateral", (4, 6, 4), (0.2, 0.2, 0.2), widths=(0.7, 1.0, 1.4), nu=0.2)
    weight = body.constant(np.zeros(2))
    body.F -= ufl.dot(weight, body.v) * ufl.dx
    law, finite = fc.Coulomb(0.3), {"kinematics": "finite"}
    contacts = [
        floor(body, law, **finite),
        joint(body, 1, law, **finite),
        joint(body, 2, law, swap=True, **finite),
    ]
    problem = body.problem(*contacts)
    for factor in np.linspace(0.0, 0.95, 7):
        angle = np.arctan(0.3 * factor)
        weight.value[:] = 1e3 * np.sin(angle), -1e3 * np.cos(angle)
        step = problem.solve()
        problem.commit()
        assert [attempt.method for attempt in step.attempts] == ["newton"]
        for contact in contacts:
            force = contact.resultants().force
            assert abs(force[0]) == pytest.approx(0.3 * factor * abs(force[1]), rel=1e-6, abs=1e-6)
