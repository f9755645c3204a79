"""Bodies constrained by contact alone: their position after unloading, and if all points slip.

At a slipping point the tangent has no stiffness along the friction force: a body all of whose
points slip is unconstrained along its obstacle, and a body without load is in equilibrium at every
position.
"""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.elasticity import LinearElastic, NeoHookean
from fenics_contact.systems.ejected_bodies import find_ejected_bodies
from scenes.blocks import BOTTOM, LEFT, RIGHT, TOP, block_mesh, dimension
from scenes.bodies import Bodies, boxes
from scenes.comparison import gather, is_close, owned_values
from scenes.elasticity import dirichlet_bc, displacement_space, residual
from scenes.tags import at_coordinate, at_interface
from scenes.two_blocks import BOTTOM as BLOCKS_BOTTOM
from scenes.two_blocks import LOWER_FACE, UPPER_FACE, E, two_blocks
from scenes.two_blocks import TOP as BLOCKS_TOP
from scenes.unrelated_bodies import Box, SceneWithUnrelatedBodies

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(240)]
COMM = MPI.COMM_WORLD
BULKS = {"linear": LinearElastic, "rubber": NeoHookean}


class UnconstrainedBlock:
    """A block of size 1, with a traction on its top, on a floor that moves tangentially."""

    def __init__(self, cell, bulk, n=3, friction=0.3, size=1.0, modulus=1e3, gap=0.0, **options):
        """Build the block with n cells along each side, in the given units of length and stress."""
        d, self.size, self.unit = dimension(cell), size, modulus / 1e3
        mesh, tags = block_mesh(cell, n=n)
        mesh.geometry.x[:] *= size
        self.u = fem.Function(displacement_space(mesh, 1))
        v = ufl.TestFunction(self.u.function_space)
        body = BULKS[bulk](self.u, modulus, 0.3, {2: "plane strain", 3: "3D"}[d])
        self.traction = fem.Constant(mesh, np.zeros(d))
        self.shift = fem.Constant(mesh, np.zeros(d))
        F = body.residual(v, ufl.dx(mesh))
        F -= ufl.dot(self.traction, v) * ufl.ds(mesh, subdomain_data=tags)(TOP)
        point, normal = np.zeros(d), np.zeros(d)
        point[-1], normal[-1] = -gap * size, 1.0
        self.contact = fc.Contact(
            self.u,
            fc.ContactSurface(mesh, tags, BOTTOM),
            fc.HalfSpace(point, normal, displacement=self.shift),
            fc.Coulomb(friction=friction),
            **options,
        )
        self.problem = fc.ContactProblem(F, self.u, contacts=[self.contact])

    def solve_increment(self, side, press, along=0.0):
        """Solve an increment; return iterations and Γc's mean displacement along x by the size."""
        self.traction.value[[0, -1]] = side * self.unit, -press * self.unit
        self.shift.value[0] = along * self.size
        step = self.problem.solve()
        self.problem.commit()
        force = self.contact.resultants().force / (
            self.unit * self.size ** (len(self.shift.value) - 1)
        )
        assert is_close(force[[0, -1]], [-side, press], 1e-8, scale=1.0)
        comm = self.u.function_space.mesh.comm
        place = gather(comm, self.contact.pairs.own_displacement()[:, :1]) / self.size
        return step.iterations, place.mean()


@pytest.mark.each
@pytest.mark.parametrize(
    ("bulk", "kinematics"), [("linear", "small"), ("linear", "finite"), ("rubber", "finite")]
)
@pytest.mark.parametrize("along", [0.0, 5.0])
@pytest.mark.parametrize("side", [0.0, 0.1, 0.2])
@pytest.mark.parametrize("gap", [0.0, 0.5])
def test_released_block_keeps_its_position(gap, side, along, bulk, kinematics):
    """A block is pressed, pushed and moved by the floor, then released, and pressed again.

    Reference: the displacement of the floor, to 1e-3, the strain by which the block springs back.
    Rubber drifted by 0.1 to 35 times its size, in up to 65 iterations. With small displacements a
    linear block returned to its initial position and was pressed again from there, in 40 to 670
    iterations.
    """
    scene = UnconstrainedBlock("quadrilateral", bulk, gap=gap, kinematics=kinematics)
    first, _ = scene.solve_increment(side, 1.0)
    scene.solve_increment(side, 1.0, along)
    released, place = scene.solve_increment(0.0, 0.0, along)
    assert abs(place - along) < 1e-3
    assert first <= 10 and released <= 10
    reloaded, place = scene.solve_increment(side, 1.0, along)
    assert abs(place - along) < 2e-3
    assert reloaded <= 20


@pytest.mark.parametrize(
    ("bulk", "kinematics"), [("linear", "small"), ("linear", "finite"), ("rubber", "finite")]
)
@pytest.mark.parametrize("displacement", [(0.3, -0.05), (0.3, 0.1), (-0.3, -0.3)])
def test_block_moves_with_the_floor_while_it_is_unloaded(displacement, bulk, kinematics):
    """The block is unloaded and the floor moves in one increment; it sticks until the load is zero.

    Reference: the displacement of the floor, to the strain (0.02). With small displacements the
    block was left behind, or the increment was refused.
    """
    scene = UnconstrainedBlock("quadrilateral", bulk, kinematics=kinematics)
    scene.solve_increment(3.0, 20.0)
    scene.traction.value[:], scene.shift.value[:] = 0.0, displacement
    step = scene.problem.solve()
    displacements = gather(COMM, scene.contact.pairs.own_displacement())
    assert np.abs(displacements - displacement).max() < 0.02
    assert step.iterations <= 5


@pytest.mark.parametrize("size", [1.0, 1e-4])
@pytest.mark.parametrize("cell", ["triangle", "tetrahedron", "hexahedron"])
def test_released_rubber_block_keeps_its_position_in_any_units(cell, size):
    """Rubber blocks in the plane and in space keep their position when released, to 1e-3."""
    units = {"size": size, "modulus": 1e3 / size**2}
    scene = UnconstrainedBlock(cell, "rubber", n=2, gap=0.1, kinematics="finite", **units)
    scene.solve_increment(0.1, 1.0)
    _, pushed = scene.solve_increment(0.2, 1.0)
    released, place = scene.solve_increment(0.0, 0.0)
    assert abs(place) < 1e-3 and abs(place - pushed) < 1e-3
    assert released <= 15


@pytest.mark.parametrize("bulk", BULKS)
@pytest.mark.parametrize("friction", [0.02, 0.1])
@pytest.mark.parametrize("n", [1, 2, 3])
def test_block_is_constrained_if_all_points_slip(n, friction, bulk):
    """All points of a pressed block slip outwards: only their resultant constrains it tangentially.

    Reference: the load, and the position, to the strain of 1e-3. Rubber took up to 67 iterations,
    or was refused.
    """
    scene = UnconstrainedBlock("quadrilateral", bulk, n=n, friction=friction, kinematics="finite")
    for side, press in ((0.0, 1.0), (0.5 * friction, 1.0), (0.0, 0.0)):
        iterations, place = scene.solve_increment(side, press)
        assert iterations <= 30
        assert abs(place) < 1e-3


class BlockOnSlab:
    """A block of rubber of size 1, with a traction on its top, on a slab that moves."""

    def __init__(self, slab, block, *, simplex):
        """Mesh slab and block with the given grid coordinates along x and y."""
        (floor, lower), (upper, top) = (axes[1][[0, -1]] for axes in (slab, block))
        mesh, tags = boxes(
            [slab, block],
            {
                BOTTOM: at_interface(1, upper, above=True),
                TOP: at_coordinate(1, top),
                LEFT: at_interface(1, lower, above=False),
                RIGHT: at_coordinate(1, floor),
            },
            simplex=simplex,
        )
        u = fem.Function(displacement_space(mesh, 1))
        v, self.traction = ufl.TestFunction(u.function_space), fem.Constant(mesh, np.zeros(2))
        F = NeoHookean(u, 1e3, 0.3, "plane strain").residual(v, ufl.dx(mesh))
        F -= ufl.dot(self.traction, v) * ufl.ds(mesh, subdomain_data=tags)(TOP)
        surface, opposite = fc.ContactSurface(mesh, tags, BOTTOM), fc.DeformableBody(tags, LEFT)
        law = fc.Coulomb(friction=0.3)
        self.contact = fc.Contact(u, surface, opposite, law, kinematics="finite")
        self.place = [fem.Constant(mesh, 0.0) for _ in range(2)]
        bcs = [dirichlet_bc(u, tags, RIGHT, i, value) for i, value in enumerate(self.place)]
        self.problem = fc.ContactProblem(F, u, bcs=bcs, contacts=[self.contact])

    def solve_increment(self, side, press, place=(0.0, 0.0)):
        """Solve an increment with the slab displaced by ``place``, and commit."""
        self.traction.value[:] = side, -press
        for constant, value in zip(self.place, place, strict=True):
            constant.value = value
        step = self.problem.solve()
        self.problem.commit()
        return step


@pytest.mark.parametrize("bulk", BULKS)
@pytest.mark.parametrize("kinematics", ["small", "finite"])
def test_block_in_a_bowl_slips_on_both_edges(kinematics, bulk):
    """Only the curvature of the bowl prevents rolling; friction of 0.05 does not.

    Reference: statics of the outermost points, to 1 %, by which the bowl closes on the bent block.
    With finite kinematics the load was cut to 1/256, and refused.
    """
    radius, friction, load = 2.0, 0.05, 0.02
    edges = [np.linspace(-0.5, 0.5, 7), np.linspace(0.0, 1.0, 7)]
    body = Bodies(
        boxes([edges], {BOTTOM: at_coordinate(1, 0.0), TOP: at_coordinate(1, 1.0)}), 1.0, 0.3
    )
    if bulk == "rubber":
        body.F = NeoHookean(body.u, 1.0, 0.3, "plane strain").residual(body.v)
    down = body.constant()
    body.F += down * body.v[1] * body.ds(TOP)
    bowl = fc.Cylinder((0.0, np.sqrt(radius**2 - 0.25)), radius, inside=True)
    law = fc.Coulomb(friction)
    contact = body.contact(BOTTOM, bowl, law, kinematics=kinematics)
    problem = body.problem(contact, small_displacement_tolerance=np.inf)

    def press(value):
        down.value = value

    steps = list(fc.increments(problem, press, 0.0, load, steps=4, max_cuts=0))
    assert sum(step.iterations for step in steps) <= 40
    computed = contact.resultants()
    assert computed.stick + computed.slip == 2  # one may be at its friction bound, still sticking
    x = np.abs(gather(COMM, contact.points)[:, 0]).max()
    sine, cosine = x / radius, np.sqrt(1 - (x / radius) ** 2)
    assert is_close(computed.normal_force, load / (cosine - friction * sine), 0.01)


def test_released_rubber_block_keeps_its_contact():
    """A released block may penetrate by the round-off of its position; this is no failure.

    Reference: a gap of zero to the other block, to 1e-3. A solution was refused for a penetration
    of 1e-11 between two points of Γc.
    """
    block, slab = np.linspace(0, 1, 3), np.linspace(-1, 2, 7)
    scene = BlockOnSlab([slab, np.linspace(-1.1, -0.1, 3)], [block - 0.06, block], simplex=True)
    for side, press in ((0.081, 1.0), (0.135, 1.0), (0.0, 0.0)):
        scene.solve_increment(side, press)
    assert np.abs(scene.contact.gap).max(initial=0.0) < 1e-3


def test_released_block_is_positioned_on_the_slab_again():
    """A released block is above the slab and is loaded again. Reference: the load, to 1e-8.

    At first only those points constrained it that round-off had closed; Newton's method took 71
    iterations, or failed.
    """
    slab = [np.linspace(-1, 3, 17), np.linspace(0, 1, 5)]
    block = [np.linspace(0.5, 1.5, 7), np.linspace(1.4, 2.4, 5)]
    scene = BlockOnSlab(slab, block, simplex=False)
    scene.solve_increment(0.1, 1.0, (0.2, 0.1))
    scene.solve_increment(0.0, 0.0, (0.2, 0.1))
    step = scene.solve_increment(0.0, 1.0, (0.2, -0.2))
    assert step.iterations <= 10
    assert is_close(scene.contact.resultants().force, [0.0, 1.0], 1e-8, scale=1.0)


def _stack(
    blocks: list[tuple[float, float, int, float, float]], friction: float
) -> tuple[fc.ContactProblem, fem.Constant, fem.Constant, Bodies]:
    """Stack rubber blocks, E = 1000, each 2 cells high, with prescribed motion of the top.

    Args:
        blocks: Left and right end, cells along x, lower and upper end of each block, from below.
        friction: Coefficient of friction.

    Returns:
        The problem, the vertical and the horizontal displacement of the top, and the bodies.
    """
    axes = [[np.linspace(a, b, n + 1), np.linspace(*ends, 3)] for a, b, n, *ends in blocks]
    faces = {}
    for number, (_, _, _, low, high) in enumerate(blocks, 1):
        faces |= {2 * number - 1: at_coordinate(1, low), 2 * number: at_coordinate(1, high)}
    bodies = Bodies(boxes(axes, faces), 1e3, 0.3)
    bodies.F = NeoHookean(bodies.u, 1e3, 0.3, "plane strain").residual(bodies.v)
    up, slide = bodies.constant(), bodies.constant()
    bodies.prescribe(1, 0, 1)
    bodies.prescribe(2 * len(blocks), 0, value=slide)
    bodies.prescribe(2 * len(blocks), 1, value=up)
    law = fc.Coulomb(friction)
    contacts = [
        bodies.contact(2 * n + 1, 2 * n, law, name=f"joint {n}", kinematics="finite")
        for n in range(1, len(blocks))
    ]
    return bodies.problem(*contacts), up, slide, bodies


def _between_two(n: int, m: int) -> tuple[fc.ContactProblem, fem.Constant, Bodies]:
    """Stack a block m cells wide, 0.01 from both others, which are n and m + 2 cells wide."""
    blocks = [(0, 1, n, 0, 0.3), (0.2, 0.8, m, 0.31, 0.51), (0.3, 0.7, m + 2, 0.52, 0.72)]
    problem, up, _, bodies = _stack(blocks, 0.6)
    return problem, up, bodies


@pytest.mark.parametrize("kinematics", ["small", "finite"])
@pytest.mark.parametrize("law", [fc.Coulomb(0.3), fc.Tresca(0.3, 1e-3)])
def test_common_prescribed_displacement_causes_no_slip(law, kinematics):
    """A block on a slab slips equally, to 1e-6, whether both are at rest or displaced together.

    Both are displaced tangentially by Dirichlet values, the block by those of its left side, one
    node of which is on the slab. This node would slip by the whole displacement if the other nodes
    were assumed to stay behind.
    """
    forces = []
    for carried in (0.0, 2.0):
        axes = [
            [np.linspace(0.0, 1.0, 5), np.linspace(0.0, 0.5, 3)],
            [np.linspace(0.1, 0.9, 5), 0.5 + np.linspace(0.0, 0.5, 3)],
        ]
        sides = {
            BOTTOM: at_coordinate(1, 0.0),
            7: at_interface(1, 0.5, above=False),
            8: at_interface(1, 0.5, above=True),
            TOP: at_coordinate(1, 1.0),
            LEFT: at_coordinate(0, 0.1),
        }
        body = Bodies(boxes(axes, sides), 1000.0, 0.3)
        body.prescribe(BOTTOM, 0, value=carried)
        body.prescribe(BOTTOM, 1)
        body.prescribe(LEFT, 0, value=carried)
        load = body.constant([0.01, -0.1])
        body.F -= ufl.inner(load, body.v) * body.ds(TOP)
        contact = body.contact(7, 8, law, kinematics=kinematics)
        body.problem(contact).solve()
        forces.append(contact.resultants().force)
    assert forces[1] == pytest.approx(forces[0], rel=1e-6, abs=1e-9)


@pytest.mark.parametrize(("n", "m"), [(8, 4), (8, 5)])
def test_block_between_two_others_is_not_ejected(n, m):
    """A Newton step ejected the middle block sideways, and all forces balanced, at zero.

    References: the forces on both sides of the middle block, which has no load, are equal, to 1e-6,
    and agree, to 5 %, with those of other meshes on which it is not ejected: 0.0264 to 0.0267 E.
    The increment is not cut.
    """
    problem, down, _ = _between_two(n, m)
    (step,) = fc.increments(problem, down, 0.0, -0.05, steps=1, max_cuts=0)
    upper, lower = (step.contacts[f"joint {n}"].force for n in (2, 1))
    assert is_close(upper, lower, 1e-6)
    assert is_close(upper[1], 0.0265 * 1e3, 0.05)


def test_block_with_previous_contact_force_is_not_ejected():
    """Five blocks are pressed together, then the top moves sideways, in four increments.

    The middle block was ejected by 0.74 from between the others, and the solution was accepted
    without any force. Reference: (-3.967, 21.321) on the lowest joint in forty increments, to 1 %;
    the result depends on the load path.
    """
    blocks = [
        (0, 1, 4, 0, 0.184),
        (0.263, 0.853, 4, 0.187, 0.375),
        (0.381, 0.795, 5, 0.378, 0.694),
        (0.128, 0.757, 7, 0.697, 0.905),
        (0.290, 0.702, 5, 0.908, 1.199),
    ]
    problem, up, slide, _ = _stack(blocks, 0.3)

    def load(t):
        up.value, slide.value = -0.0607 * min(1, 2 * t), 0.05 * max(0, 2 * t - 1)

    *_, last = fc.increments(problem, load, 0.0, 1.0, steps=4, max_cuts=4)
    force = last.contacts["joint 1"].force
    assert np.linalg.norm(force - [-3.967, 21.321]) < 0.01 * 21.7


def test_ejected_body_is_reported():
    """An ejected body is named, with its displacement and the largest nearby; others are not.

    References: the prescribed displacements: the middle block moves by 2 sideways, where it touches
    nothing; the highest one is at rest, or moves up by 1, and then none is reported.
    """
    problem, _, blocks = _between_two(6, 4)
    u, before = problem.u, problem.full.state()
    for displacement, names in ((0.0, ["body 2"]), (1.0, [])):
        u.interpolate(
            lambda x, displacement=displacement: np.vstack(
                [2.0 * (x[1] < 0.515), displacement * (x[1] > 0.515)]
            )
        )
        blocks.set_displacement(lambda x: 0.0 * x[:2], lambda x: x[:, 1] < 0.305)
        for contact in problem.contacts:
            contact.evaluate()
        forces, start = problem.full.contact_forces(), problem.solver.equations.initial_forces
        ejected = find_ejected_bodies(problem.full, problem.motions, forces, before, start)
        assert [name.split(",")[0] for name in ejected] == names
        assert all(
            is_close(np.array(displacements)[[0, 2]], [2.0, 0.0], 1e-12)
            for displacements in ejected.values()
        )


@pytest.mark.parametrize(
    ("bulk", "kinematics"), [("linear", "small"), ("linear", "finite"), ("rubber", "finite")]
)
@pytest.mark.parametrize("n_steps", [1, 4])
def test_unloaded_stack_springs_back(n_steps, bulk, kinematics):
    """Three free blocks on a floor, soft, stiff and of medium stiffness, are pressed and released.

    All are displaced by the compression of the soft one, and no force remains on any; this is no
    ejection. References: the load on every joint, to 1e-8, and zero displacement, to 1e-6 of the
    size, due to residuals of 1e-9 on the soft block.
    """
    axes = [[np.linspace(-0.3, 0.3, 4), np.linspace(k, k + 1.0, 3)] for k in range(3)]
    faces = {1: at_coordinate(1, 0.0), 6: at_coordinate(1, 3.0)}
    for k in (1, 2):
        faces |= {2 * k: at_interface(1, k, above=False), 2 * k + 1: at_interface(1, k, above=True)}
    bodies = Bodies(boxes(axes, faces), 1.0, 0.3)
    modulus = fem.Function(fem.functionspace(bodies.mesh, ("DG", 0)))
    for k, value in enumerate((1e2, 1e4, 1e3)):
        cells = bodies.cells(lambda x, k=k: (x[:, -1] > k) & (x[:, -1] < k + 1))
        modulus.x.array[cells] = value
    bodies.F = BULKS[bulk](bodies.u, modulus, 0.3, "plane strain").residual(bodies.v)
    press = bodies.constant()
    bodies.F += press * bodies.v[1] * bodies.ds(6)
    law = fc.Coulomb(0.3)
    floor = fc.HalfSpace((0, 0), (0, 1))
    contacts = [bodies.contact(1, floor, law, name="floor", kinematics=kinematics)]
    contacts += [
        bodies.contact(2 * k + 1, 2 * k, law, name=f"joint {k}", kinematics=kinematics)
        for k in (1, 2)
    ]
    problem = bodies.problem(*contacts)
    (step,) = fc.increments(problem, press, 0.0, 1.0, steps=1, max_cuts=0)
    assert all(is_close(r.force[1], 0.6, 1e-8) for r in step.contacts.values())
    *_, step = fc.increments(problem, press, 1.0, 0.0, steps=n_steps, max_cuts=0)
    assert all(np.linalg.norm(r.force) < 1e-8 for r in step.contacts.values())
    assert np.abs(gather(COMM, owned_values(bodies.u))).max() < 1e-6


@pytest.mark.parametrize("slope", [0.1, 0.02])
@pytest.mark.parametrize("kinematics", ["small", "finite"])
def test_wedge_displaced_by_closing_jaws_is_not_taken_for_ejected(kinematics, slope):
    """A wedge without load is between rigid jaws that close by 0.1 times the slope each.

    Reference: geometry, 0.1 upwards in one increment, to 1e-4, ten and fifty times any other
    displacement.
    """
    lines = [[np.linspace(-0.3, 0.3, 4), np.linspace(0.0, 1.0, 5)]]
    faces = {LEFT: at_coordinate(0, -0.3), RIGHT: at_coordinate(0, 0.3)}
    bend = np.array([slope / 0.3, 0.0])
    mesh, tags = boxes(lines, faces, bend=lambda x: x * (1 + (x[:, 1:] - 0.5) * bend))
    wedge = Bodies((mesh, tags), 1e3, 0.3)
    shifts = [wedge.constant((0.0, 0.0)) for _ in range(2)]
    jaws = zip((LEFT, RIGHT), (1, -1), shifts, strict=True)
    problem = wedge.problem(
        *(
            wedge.contact(
                tag,
                fc.HalfSpace((-0.3 * side, 0.5), (side, slope), displacement=shift),
                fc.Coulomb(0.2 * slope),
                name=f"jaw {tag}",
                kinematics=kinematics,
            )
            for tag, side, shift in jaws
        ),
        small_displacement_tolerance=np.inf,
    )
    problem.solve()
    problem.commit()
    shifts[0].value[0], shifts[1].value[0] = 0.1 * slope, -0.1 * slope
    problem.solve()
    place = gather(COMM, problem.contacts[0].pairs.own_displacement())
    assert np.abs(place[:, 1] - 0.1).max() < 1e-4


@pytest.mark.parametrize("displacement", [2.5, 3.5])
def test_body_displaced_beyond_the_moving_floor_is_reported(displacement):
    """A block is reported if its displacement exceeds three times that of the floor.

    References: the prescribed displacements: the block moves by `way` along the floor, which moves
    by 1, and by 0.5 away from it.
    """
    scene = UnconstrainedBlock("quadrilateral", "linear", kinematics="finite")
    problem, u = scene.problem, scene.u
    scene.shift.value[0] = 1.0
    before = problem.full.state()
    u.interpolate(lambda x: np.vstack([displacement + 0.0 * x[0], 0.5 + 0.0 * x[0]]))
    scene.contact.evaluate()
    forces, start = problem.full.contact_forces(), problem.solver.equations.initial_forces
    ejected = find_ejected_bodies(problem.full, problem.motions, forces, before, start)
    assert len(ejected) == (displacement > 3.0)
    expected = np.hypot(displacement, 0.5), 3.0, 1.0
    assert all(
        is_close(np.array(displacements), expected, 1e-12) for displacements in ejected.values()
    )


def test_body_displaced_off_a_wall_by_a_ball_is_reported():
    """A block without force is displaced by 1 off a wall at rest; a ball moves into it by 0.02.

    Only a force can keep it at its initial position: no rigid-body motion resolves the penetration
    between ball and floor. References: the prescribed displacements, to 1e-12. All displacement
    along the wall's normal used to be attributed to the wall.
    """
    scene = SceneWithUnrelatedBodies({"block": Box(n=(4, 4))}, E=1e3)
    down = scene.bodies.constant((0.0, 0.0))
    sides = {
        BOTTOM: fc.HalfSpace((0, 0), (0, 1)),
        LEFT: fc.HalfSpace((0, 0), (1, 0)),
        TOP: fc.Ball((0.5, 3.0), 2.0, displacement=down),
    }
    options = {"law": fc.Coulomb(0.3), "kinematics": "finite"}
    contacts = [scene.contact("block", s, o, name=f"{s}", **options) for s, o in sides.items()]
    problem, u = scene.problem(*contacts), scene.bodies.u
    down.value[1] = -0.02
    before = problem.full.state()
    u.interpolate(lambda x: np.vstack([1.0 + 0.0 * x[0], 0.0 * x[0]]))
    for contact in contacts:
        contact.evaluate()
    forces, start = problem.full.contact_forces(), problem.solver.equations.initial_forces
    ejected = find_ejected_bodies(problem.full, problem.motions, forces, before, start)
    assert [
        is_close(np.array(displacements), (1.0, 0.06, 0.02), 1e-12)
        for displacements in ejected.values()
    ] == [True]


@pytest.mark.parametrize(("displacement", "is_ejected"), [(2.5, False), (3.5, True)])
def test_residual_of_an_ejected_body_is_nan(displacement, is_ejected):
    """After an increment with force, an unloaded block is displaced off its moving floor.

    Reference: the prescribed displacement, at most, or more than, three times that of the floor, 1;
    whether the residual is NaN.
    """
    scene = UnconstrainedBlock("quadrilateral", "rubber", kinematics="finite")
    scene.solve_increment(0.0, 1.0)
    problem, equations = scene.problem, scene.problem.solver.equations
    problem.full.load[:] = 0.0
    scene.shift.value[0] = 1.0
    start = problem.full.state()
    scene.u.x.array[::2] += displacement
    scene.u.x.array[1::2] += 0.5
    state = problem.full.state()
    problem.full.set_state(start)
    assert np.isnan(equations.residual_at(state)) == is_ejected


@pytest.mark.parametrize("bulk", ["linear", "rubber"])
@pytest.mark.parametrize("displacement", [0.003, 0.1])
def test_lifted_block_moves_at_most_with_the_floor(displacement, bulk):
    """The block is lifted in one increment; friction moves it by at most the floor's displacement.

    Reference: this interval, with 1e-3 of that displacement. The consistent tangent extrapolates
    friction beyond the loss of pressure, which displaced the block in the opposite direction by six
    times the displacement of the floor.
    """
    scene = SceneWithUnrelatedBodies({"block": Box()}, rubber=bulk == "rubber")
    up, shift = scene.bodies.constant(), fem.Constant(scene.bodies.mesh, np.zeros(2))
    scene.prescribe("block", TOP, 1, value=up)
    floor = fc.HalfSpace((0, 0), (0, 1), shift)
    contact = scene.contact("block", BOTTOM, floor, fc.Coulomb(0.3), kinematics="finite")
    problem = scene.problem(contact)
    for up.value, shift.value[0] in ((-0.01, 0.0), (0.05, displacement)):
        problem.solve()
        problem.commit()
    place = gather(COMM, contact.pairs.own_displacement())[:, 0]
    assert place.min() > -1e-3 * displacement and place.max() < 1.001 * displacement


def test_block_left_on_the_floor_does_not_slow_newtons_method():
    """The residual of a rigid-body mode without forces is round-off of other forces, and ignored.

    Taken for unbalanced forces it stiffened all open points: Newton's method took steps of a fifth,
    and another method needed 32 iterations.
    """
    mesh, tags = two_blocks("triangle", (3, 4))
    u = fem.Function(displacement_space(mesh, 1))
    F = residual(u, ufl.TestFunction(u.function_space), E, 0.3)
    grip = fem.Constant(mesh, np.zeros(2))
    upper, lower = (fc.ContactSurface(mesh, tags, tag) for tag in (UPPER_FACE, BLOCKS_BOTTOM))
    contacts = [
        fc.Contact(
            u,
            fc.ContactSurface(mesh, tags, BLOCKS_TOP),
            fc.HalfSpace((0, 1), (0, -1), displacement=grip),
            fc.Foundation(E, E),
            name="grip",
        ),
        fc.Contact(u, upper, fc.DeformableBody(tags, LOWER_FACE), fc.Coulomb(0.3), name="between"),
        fc.Contact(u, lower, fc.HalfSpace((0, 0), (0, 1)), fc.Coulomb(0.3), name="floor"),
    ]
    problem = fc.ContactProblem(F, u, contacts=contacts)
    pressed, lifted, sheared = (0.0, -1e-3), (0.0, 1e-3), (1e-3, 1e-3)
    for place in (pressed, lifted, sheared):
        grip.value[:] = place
        step = problem.solve()
        problem.commit()
        assert step.method == "newton"
        assert step.iterations <= 8
        carried_force = contacts[2].resultants().normal_force
        assert carried_force > 100.0 if place == pressed else carried_force < 1e-6


def test_block_in_a_bowl_is_unloaded_and_loaded_again():
    """The unloaded block is in equilibrium anywhere; a slight further displacement is no error.

    With small displacements contact is determined by the gap of the undeformed body, and the
    displaced block penetrates the bowl by 2e-8. The resulting force is round-off, because the block
    moves away.
    """
    mesh, tags = block_mesh("quadrilateral", n=4)
    u = fem.Function(displacement_space(mesh, 1))
    v = ufl.TestFunction(u.function_space)
    pressure = fem.Constant(mesh, 0.0)
    F = LinearElastic(u, 2e3, 0.2, "plane strain").residual(v, ufl.dx(mesh))
    F += pressure * v[1] * ufl.ds(mesh, subdomain_data=tags)(TOP)
    bowl = fc.Ball((0.6, 4.9), 4.9, inside=True)
    contact = fc.Contact(u, fc.ContactSurface(mesh, tags, BOTTOM), bowl, fc.Coulomb(0.1))
    problem = fc.ContactProblem(F, u, bcs=[dirichlet_bc(u, tags, LEFT, 0)], contacts=[contact])
    for load in (0.5, 0.25, 0.0, 0.25, 0.5):
        pressure.value = load
        step = problem.solve()
        problem.commit()
        assert step.verdict.failures == []
        assert contact.resultants().normal_force >= 0.95 * load
        assert contact.resultants().force[1] == pytest.approx(load, abs=1e-9)


@pytest.mark.each
@pytest.mark.parametrize(
    ("kinematics", "rubber"), [("small", False), ("finite", False), ("finite", True)]
)
@pytest.mark.parametrize(("n", "modulus"), [(2, 1e3), (4, 1e9)])
def test_friction_without_pressure_moves_the_block_with_the_floor(n, modulus, kinematics, rubber):
    """A floor moves off a block without load; Tresca friction acts at the open points, too.

    Nothing constrains the block along the normal: displaced by 1e10 times its size it was accepted
    with a force of 0.1. References: no equilibrium at such a state, relative to the forces there,
    which are at the friction bound; the tangential displacement of the floor and no normal one, to
    1e-3 of it (nothing constrains the block along the normal); zero force, as the load is, to 1e-8
    of the pressure.
    """
    scene = SceneWithUnrelatedBodies(
        {"block": Box(size=(1.0, 0.5), n=(2 * n, n))}, E=modulus, rubber=rubber
    )
    pressure, shift = 1e-3 * modulus, scene.bodies.constant((0.0, 0.0))
    load = scene.bodies.constant(-pressure)
    scene.load("block", TOP, 1, load)
    floor, law = fc.HalfSpace((0, 0), (0, 1), shift), fc.Tresca(0.3, 0.1 * pressure)
    contact = scene.contact("block", BOTTOM, floor, law, kinematics=kinematics)
    problem = scene.problem(contact)
    for load.value in (-pressure, 0.0):
        problem.solve()
        problem.commit()
    before, equations = problem.full.state(), problem.solver.equations
    shift.value[:] = 0.01, -0.01
    problem.solve()
    assert np.abs(contact.resultants().force).max() < 1e-8 * pressure
    displacement = gather(COMM, (problem.full.state() - before).reshape(-1, 2))
    assert np.abs(displacement - (0.01, 0.0)).max() < 1e-5
    if not rubber:  # rubber inverts by round-off at this distance
        away = before + 1e10 * problem.motions.of_bodies[1]
        assert np.isfinite(equations.residual_at(equations.system.restrict(away)))
        assert not equations.norms.is_within(1e-9)


class PushedBlock:
    """An unloaded block, a driven block at its left, a gap of 0.2 between them, and a ball.

    The ball, with finite kinematics only, is 0.1 above the block and has its centre at x = 1.15.
    The whole scene is rotated by an angle.
    """

    def __init__(
        self,
        place=0.0,
        *,
        kinematics="finite",
        rubber=False,
        law=None,
        angle=0.0,
        enforcement=None,
        far=None,
        **options,
    ):
        """Put the block at ``place``, and an unrelated one at the distance ``far`` if given."""
        c, s = np.cos(angle), np.sin(angle)
        self.turn = np.array([[c, -s], [s, c]])

        def box(low, size):
            low = np.array(low)
            return Box(low, size, n=(4, 4), bend=lambda x: (x + low) @ self.turn.T - low)

        boxes = {"pushed": box((place, 0.0), (1.0, 1.0)), "driven": box((-1.2, 0.1), (1.0, 0.8))}
        if far:
            boxes["unrelated"] = Box((far, far), n=(2, 2))
        scene = SceneWithUnrelatedBodies(boxes, E=1e3, rubber=rubber)
        if far:
            for component in range(2):
                scene.prescribe("unrelated", LEFT, component)
        self._driven = [scene.bodies.constant(0.0) for _ in range(2)]
        self.down = scene.bodies.constant((0.0, 0.0))
        for component, constant in enumerate(self._driven):
            scene.prescribe("driven", LEFT, component, value=constant)
        meets = {BOTTOM: fc.HalfSpace((0, 0), self.turn[:, 1]), LEFT: ("driven", RIGHT)}
        if kinematics == "finite":
            meets[TOP] = fc.Ball(self.turn @ (1.15, 3.1), 2.0, displacement=self.down)
        law = law or fc.Coulomb(0.3)
        more = {"kinematics": kinematics, "enforcement": enforcement}
        self.contacts = [
            scene.contact("pushed", side, obstacle, law, name=f"{side}", **more)
            for side, obstacle in meets.items()
        ]
        self.problem = scene.problem(*self.contacts, **options)

    def step(self, along=None):
        """Solve and commit an increment, with the driven block displaced to ``along`` if given."""
        if along is not None:
            for constant, component in zip(self._driven, self.turn[:, 0], strict=True):
                constant.value = component * along
        self.problem.solve()
        self.problem.commit()

    def push(self, n_steps):
        """Drive the one block 0.85 to the right and back by 0.7; the other must stay at 0.65."""
        for start, end in ((0.0, 0.85), (0.85, 0.15)):
            for along in start + (end - start) * np.arange(1, n_steps + 1) / n_steps:
                self.step(along)
            displacements = gather(COMM, self.contacts[0].pairs.own_displacement())
            assert np.abs(displacements - self.turn @ (0.65, 0.0)).max() < 1e-7


@pytest.mark.each
@pytest.mark.parametrize("n_steps", [4, 8])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"law": fc.Frictionless()},
        {"method": "lbfgs"},
        {"angle": 0.5},
        {"angle": 0.7, "law": fc.Frictionless()},
        {"enforcement": "augmented"},
        {"far": 1e4},
    ],
    ids=lambda options: ", ".join(options) or "plain",
)
@pytest.mark.parametrize(
    ("kinematics", "rubber"), [("small", False), ("finite", False), ("finite", True)]
)
def test_unloaded_block_stays_where_another_block_pushed_it(kinematics, rubber, options, n_steps):
    """Reference: geometry, the displacement of the other block minus the gap, to 1e-7.

    The block was moved back with the other one; and L-BFGS, to which all positions are equivalent,
    lifted it.
    """
    PushedBlock(kinematics=kinematics, rubber=rubber, **options).push(n_steps)


@pytest.mark.parametrize("rubber", [False, True])
def test_displaced_block_carries_the_force_of_a_ball(rubber):
    """Reference: the force on the ball if the block is meshed there, to 1e-6; it was zero."""
    forces = []
    for place in (0.0, 0.65):
        scene = PushedBlock(place, rubber=rubber)
        if place:
            scene.step()
        else:
            scene.push(8)
        for scene.down.value[1] in np.linspace(-0.012, -0.12, 10):
            scene.step()
        forces.append(scene.contacts[-1].resultants().force[1])
    assert forces[0] == pytest.approx(forces[1], rel=1e-6)
    assert abs(forces[1]) > 1.0
