"""Initial positioning of unconstrained bodies that have a gap to their obstacle.

References are the same scenes without a gap, or rotated as a whole: the initial position must not
affect the result. Iterations are bounded, because the start is tested: without positioning these
scenes took hundreds of iterations, or failed.
"""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.elasticity import LinearElastic, NeoHookean
from scenes.blocks import BOTTOM, LEFT, RIGHT, TOP, block_mesh, dimension
from scenes.comparison import gather, is_close
from scenes.elasticity import dirichlet_bc, displacement_space
from scenes.stacks import FLOOR, ROOF, joint, stack
from scenes.unrelated_bodies import Box, SceneWithUnrelatedBodies

pytestmark = [pytest.mark.two_ranks, pytest.mark.timeout(240)]
COMM = MPI.COMM_WORLD
FINITE = {"kinematics": "finite"}
BULKS = {"linear": LinearElastic, "rubber": NeoHookean}


class UnconstrainedBlock:
    """A block of size 1 constrained by contact alone, with a traction on its top."""

    def __init__(self, cell, bulk, traction, kind=None):
        """Create mesh, body and residual."""
        self.d = dimension(cell)
        mesh, self.tags = block_mesh(cell, n=4 if self.d == 2 else 2)
        self.u = fem.Function(displacement_space(mesh, 1))
        kind = kind or {2: "plane strain", 3: "3D"}[self.d]
        self.body = BULKS[bulk](self.u, 1000.0, 0.3, kind)
        v = ufl.TestFunction(self.u.function_space)
        self.traction = fem.Constant(mesh, self.vector(*traction))
        ds = ufl.ds(mesh, subdomain_data=self.tags)
        self.F = self.body.residual(v, ufl.dx(mesh))
        self.F -= ufl.dot(self.traction, v) * self.body.weight * ds(TOP)
        self.bcs = []

    def vector(self, side, up):
        """Return the vector with these components along x and along the height."""
        value = np.zeros(self.d)
        value[0], value[-1] = side, up
        return value

    def contact(self, obstacle, friction=0.3, tag=BOTTOM, **options):
        """Return a contact of one side, with finite kinematics by default."""
        surface = fc.ContactSurface(self.u.function_space.mesh, self.tags, tag)
        options = FINITE | {"weight": self.body.weight} | options
        return fc.Contact(self.u, surface, obstacle, fc.Coulomb(friction=friction), **options)

    def problem(self, *contacts, **options):
        """Return the problem with these contacts."""
        return fc.ContactProblem(self.F, self.u, bcs=self.bcs, contacts=contacts, **options)


def plane(scene, gap, tilt=0.0):
    """Return a floor below the bottom, tilted about one of its edges."""
    normal = scene.vector(-np.sin(tilt), np.cos(tilt))
    return fc.HalfSpace(scene.vector(float(tilt > 0), 0.0) - gap * normal, normal)


def distance_from_ball(x, centre, radius):
    """Return the distance from a ball (UFL)."""
    arm = x - ufl.as_vector(list(centre))
    return ufl.sqrt(ufl.dot(arm, arm)) - radius


def obstacle(scene, shape, gap):
    """Return an obstacle of this shape below the middle of the bottom."""
    centre = np.full(scene.d, 0.5)
    centre[-1] = -gap - 3.0
    if shape == "plane":
        return plane(scene, gap)
    if shape == "cylinder":
        return fc.Cylinder(centre, 3.0, None if scene.d == 2 else (0.0, 1.0, 0.0))
    if shape == "distance":
        return fc.SignedDistance(lambda x: distance_from_ball(x, centre, 3.0))
    centre[-1] = 4.94 - gap
    return fc.Ball(centre, 5.0, inside=True)


@pytest.mark.each
@pytest.mark.parametrize("bulk", BULKS)
@pytest.mark.parametrize("shape", ["plane", "cylinder", "distance", "bowl"])
@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_initial_gap_does_not_affect_forces(cell, shape, bulk):
    """Forces and friction do not depend on the initial gap: positioning causes no slip.

    A point above a cylinder reaches another position than the closest one from above. Reference: a
    gap of 1e-4; tolerance 1e-6 over a plane, 3e-2 over curved obstacles, where the rotation during
    positioning shifts the block by up to 0.007, on a mesh of 2 to 4 cells. If the positioning
    counted as slip, none of the curved cases would be solved.
    """
    tolerance = 1e-6 if shape == "plane" else 3e-2
    computed = []
    for gap in (1e-4, 0.05, 1.0):
        scene = UnconstrainedBlock(cell, bulk, (0.02, -1.0))
        contact = scene.contact(obstacle(scene, shape, gap))
        step = scene.problem(contact).solve()
        assert step.iterations <= 60
        resultants = contact.resultants()
        assert is_close(resultants.force, scene.vector(-0.02, 1.0), 1e-8)
        computed.append(resultants.tangential_force)
    assert is_close(computed[1:], computed[:1] * 2, tolerance)


@pytest.mark.parametrize("tilt", [-0.19, 0.1])
@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_rubber_block_rotates_onto_a_tilted_floor(cell, tilt):
    """The block rotates as a rigid body until its whole bottom is in contact.

    Reference: a flat floor and the load rotated with it, that is, the whole scene rotated: force
    and friction force, to 1e-6, which is the round-off of the rotation.
    """
    computed = []
    cosine, sine = np.cos(tilt), np.sin(tilt)
    for angle in (0.0, tilt):
        scene = UnconstrainedBlock(cell, "rubber", (0.1, -1.0))
        if angle:
            scene.traction.value[:] = scene.vector(0.1 * cosine + sine, 0.1 * sine - cosine)
        contact = scene.contact(plane(scene, 0.3, angle))
        step = scene.problem(contact).solve()
        assert step.iterations <= 20
        resultants = contact.resultants()
        assert is_close(resultants.force, -scene.traction.value, 1e-8)
        computed.append(resultants.tangential_force)
    assert is_close(computed[1], computed[0], 1e-6)


@pytest.mark.parametrize("bulk", BULKS)
def test_two_blocks_are_positioned_on_each_other(bulk):
    """Each of two blocks is positioned on its obstacle, with finite-sliding pairs.

    Reference: the friction forces without gaps, to 1e-6. It takes 2 to 6 iterations.
    """
    computed = []
    for low, high in ((0.0, 0.0), (0.2, 0.5), (1e-4, 1e-3)):
        body = stack("triangle", (3, 4), (1.0, 1.0), gap=high)
        if bulk == "rubber":
            body.F = NeoHookean(body.u, 1e3, 0.3, "plane strain").residual(
                body.v, ufl.dx(body.mesh)
            )
        body.F -= ufl.dot(body.constant((0.05, -1.0)), body.v) * body.ds(ROOF)
        law = fc.Coulomb(friction=0.3)
        floor_contact = body.contact(FLOOR, fc.HalfSpace((0.0, -low), (0.0, 1.0)), law, **FINITE)
        contacts = [floor_contact, joint(body, 1, law, **FINITE)]
        step = fc.ContactProblem(body.F, body.u, contacts=contacts).solve()
        assert step.iterations <= 20
        computed.append([contact.resultants().tangential_force for contact in contacts])
    assert is_close(computed[1], computed[0], 1e-6) and is_close(computed[2], computed[0], 1e-6)


@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_block_slides_on_the_floor_until_it_reaches_the_wall(cell):
    """A block whose load exceeds the friction limit of the floor slides on to the wall.

    Reference: the load, which in 3D has a small component along the corner. It takes 5 and 8
    iterations. Moved to first touch by its load, the block found no solution, and in 3D round-off
    moved it along the corner without limit.
    """
    scene = UnconstrainedBlock(cell, "linear", (0.0, 0.0))
    v, load = ufl.TestFunction(scene.u.function_space), scene.vector(-0.6, -1.0)
    load[1:-1] = 0.05
    scene.F -= ufl.dot(fem.Constant(scene.u.function_space.mesh, load), v) * ufl.dx
    sides = {"floor": (BOTTOM, (0.0, 1.0), 0.05), "wall": (LEFT, (1.0, 0.0), 0.3)}
    sides = {name: (tag, scene.vector(*normal), gap) for name, (tag, normal, gap) in sides.items()}
    contacts = [
        scene.contact(fc.HalfSpace(-gap * np.array(normal), normal), 0.2, tag, name=name)
        for name, (tag, normal, gap) in sides.items()
    ]
    step = scene.problem(*contacts).solve()
    assert step.iterations <= 20
    assert is_close(sum(contact.resultants().force for contact in contacts), -load, 1e-8)


@pytest.mark.parametrize("bulk", BULKS)
def test_axisymmetric_disc_is_positioned_on_a_ball(bulk):
    """The contact force on an axisymmetric disc is its load, π times the traction, to 1e-8."""
    scene = UnconstrainedBlock("triangle", bulk, (0.0, -1.0), "axisymmetric")
    scene.bcs = [dirichlet_bc(scene.u, scene.tags, LEFT, 0, 0.0)]
    contact = scene.contact(fc.Ball((0.0, -3.5), 3.0))
    step = scene.problem(contact).solve()
    assert step.iterations <= 20
    assert is_close(contact.resultants().force[1], np.pi, 1e-8)


@pytest.mark.parametrize("enforcement", ["penalty", "augmented"])
def test_restore_discards_the_positioning(enforcement):
    """`restore` discards the positioning: the history equals the one before, bit for bit."""
    scene = UnconstrainedBlock("triangle", "rubber", (0.1, -1.0))
    contact = scene.contact(plane(scene, 0.5, 0.1), enforcement=enforcement)
    problem = scene.problem(contact)
    before = contact.history.rows()
    forces = []
    for _ in range(2):
        problem.solve()
        forces.append(contact.resultants().tangential_force)
        assert not np.array_equal(contact.history.rows(), before) or not len(before)
        assert np.array_equal(contact.states.committed.history, before)
        problem.restore()
        assert np.array_equal(contact.history.rows(), before)
    scene.traction.value[:] = (5.0, -1.0)  # above the friction limit
    with pytest.raises(ValueError, match="translation along x"):
        problem.solve()
    assert np.array_equal(contact.history.rows(), before)
    scene.traction.value[:] = (0.1, -1.0)
    problem.solve()
    forces.append(contact.resultants().tangential_force)
    problem.commit()
    assert is_close(forces[1:], forces[:1] * 2, 1e-9)
    problem.solve()
    assert is_close(contact.resultants().force, [-0.1, 1.0], 1e-7)


def test_block_pulled_upwards_is_refused_unmoved():
    """No contact force can balance the load: it is refused, and u remains zero."""
    scene = UnconstrainedBlock("triangle", "linear", (0.0, 1.0))
    problem = scene.problem(scene.contact(plane(scene, 0.5)))
    with pytest.raises(ValueError, match="no contact force can balance the load"):
        problem.solve()
    assert not np.any(scene.u.x.array)


@pytest.mark.parametrize(
    ("bulk", "kinematics"), [("linear", "small"), ("linear", "finite"), ("rubber", "finite")]
)
def test_block_is_positioned_on_a_block_that_is_in_contact(bulk, kinematics):
    """The lower block overlaps the floor by 1e-4; the upper one has a gap to the lower one.

    Reference: the friction forces with the upper block just touching, to 1e-6. It takes 3 to 10
    iterations. When bodies were positioned only without any contact, all cases were refused.
    """
    computed = []
    for gap in (0.0, 0.4):
        body = stack("triangle", (3, 4), (1.0, 1.0), gap=gap)
        if bulk == "rubber":
            body.F = NeoHookean(body.u, 1e3, 0.3, "plane strain").residual(
                body.v, ufl.dx(body.mesh)
            )
        body.F -= ufl.dot(body.constant((0.05, -1.0)), body.v) * body.ds(ROOF)
        law, options = fc.Coulomb(friction=0.3), {"kinematics": kinematics}
        floor = fc.HalfSpace((0.0, 1e-4), (0.0, 1.0))
        contacts = [body.contact(FLOOR, floor, law, **options), joint(body, 1, law, **options)]
        step = fc.ContactProblem(body.F, body.u, contacts=contacts).solve()
        assert step.iterations <= 20
        computed.append([contact.resultants().tangential_force for contact in contacts])
    assert is_close(computed[1], computed[0], 1e-6)


@pytest.mark.parametrize("bulk", BULKS)
@pytest.mark.parametrize("gap", [0.0, 0.5])
def test_released_block_keeps_its_position(gap, bulk):
    """A block carried along by 5 on its floor, released and loaded again keeps its position.

    Reference: the position at its release, to 1e-3 of the displacement, as friction prevents
    sliding under the load. It was once positioned from its initial position, 5 away, without any
    slip.
    """
    scene = UnconstrainedBlock("quadrilateral", bulk, (0.0, 0.0))
    shift = fem.Constant(scene.u.function_space.mesh, np.zeros(2))
    floor = fc.HalfSpace((0.0, -gap), (0.0, 1.0), displacement=shift)
    contact = scene.contact(floor)
    problem = scene.problem(contact)
    displacements = []
    for press, along in ((1.0, 0.0), (1.0, 5.0), (0.0, 5.0), (1.0, 5.0)):
        scene.traction.value[:] = (0.0, -press)
        shift.value[:] = (along, 0.0)
        step = problem.solve()
        problem.commit()
        assert step.iterations <= 60
        assert is_close(contact.resultants().force, [0.0, press], 1e-8, scale=1.0)
        displacements.append(contact.pairs.own_displacement()[:, 0])
    comm = scene.u.function_space.mesh.comm
    pressed, carried, released, reloaded = gather(comm, np.column_stack(displacements)).T
    assert is_close(carried - pressed, np.full(len(pressed), 5.0), 1e-9)
    assert is_close(reloaded, np.full(len(reloaded), released.mean()), 1e-3)


@pytest.mark.parametrize("bulk", BULKS)
@pytest.mark.parametrize("shape", ["plane", "cylinder"])
@pytest.mark.parametrize("cell", ["triangle", "tetrahedron"])
def test_obstacles_carry_unconstrained_bodies(cell, shape, bulk):
    """A moving obstacle carries a block, down and sideways, farther than the penetration.

    Reference: the forces before the motion, to 1e-7. Linear bodies were refused, and on a cylinder
    all bodies.
    """
    scene = UnconstrainedBlock(cell, bulk, (0.02, -1.0))
    shift = fem.Constant(scene.u.function_space.mesh, np.zeros(scene.d))
    centre = np.full(scene.d, 0.5)
    centre[-1] = -3.1
    obstacles_below = {
        "plane": lambda: fc.HalfSpace(scene.vector(0.0, -0.1), scene.vector(0.0, 1.0), shift),
        "cylinder": lambda: fc.Cylinder(
            centre, 3.0, None if scene.d == 2 else (0.0, 1.0, 0.0), displacement=shift
        ),
    }[shape]()
    contact = scene.contact(obstacles_below)
    problem = scene.problem(contact)
    computed = []
    for displacement in ((0.0, 0.0), (0.3, 0.0), (0.3, -0.7)):
        shift.value[:] = scene.vector(*displacement)
        assert problem.solve().iterations <= 40
        problem.commit()
        resultants = contact.resultants()
        computed.append([*resultants.force, resultants.tangential_force])
    assert is_close(computed[1:], computed[:1] * 2, 1e-7)


@pytest.mark.parametrize("bulk", BULKS)
def test_obstacle_pushes_a_released_block(bulk):
    """The obstacle rises by a fifth of the block's height as the released block is loaded again.

    The block moves as a rigid body. Reference: the load, and the displacement of the obstacle, to
    1e-2, as the block may touch a round obstacle elsewhere. It took 4 iterations; loaded from
    inside the obstacle, the linear block was refused.
    """
    scene = UnconstrainedBlock("quadrilateral", bulk, (0.0, 0.0))
    shift = fem.Constant(scene.u.function_space.mesh, np.zeros(2))
    contact = scene.contact(fc.Cylinder((0.45, -3.001), 3.0, displacement=shift))
    problem = scene.problem(contact)
    displacements = []
    for press, up in ((1.0, 0.0), (0.0, -0.4), (0.5, -0.2)):
        scene.traction.value[:] = (0.0, -press)
        shift.value[:] = (0.0, up)
        assert problem.solve().iterations <= 60
        problem.commit()
        assert is_close(contact.resultants().force, [0.0, press], 1e-8, scale=1.0)
        displacements.append(contact.pairs.own_displacement()[:, 1])
    first, _, last = gather(scene.u.function_space.mesh.comm, np.column_stack(displacements)).T
    assert abs(last.mean() - first.mean() + 0.2) < 1e-2


def test_round_off_force_after_unloading_is_not_contact():
    """The floor moves sideways below a released block as this is loaded again.

    Their common displacement leaves forces of round-off, 3e-8 of the load, at one of the points.
    The slip of this point, too, is measured from the rest position. Reference: the same without
    that displacement, to 1e-5 of the forces because of the round-off.
    """
    computed = []
    for displacement in (0.0, 1e5):
        scene = UnconstrainedBlock("triangle", "linear", (0.0, 0.0))
        mesh = scene.u.function_space.mesh
        slide, floor = fem.Constant(mesh, 0.0), fem.Constant(mesh, np.zeros(2))
        scene.bcs = [dirichlet_bc(scene.u, scene.tags, LEFT, 0, slide)]
        half_space = fc.HalfSpace((0.0, 0.0), (0.0, 1.0), displacement=floor)
        contact = scene.contact(half_space, kinematics="small")
        problem = scene.problem(contact, small_displacement_tolerance=np.inf)
        for up, factor, slip in ((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 1.0, 0.1)):
            scene.traction.value[-1] = up
            slide.value, floor.value[0] = factor * displacement, factor * displacement + slip
            problem.solve()
            problem.commit()
        resultants = contact.resultants()
        computed.append([*resultants.force, resultants.tangential_force])
    assert is_close(computed[1], computed[0], 1e-5)


@pytest.mark.parametrize("kinematics", ["small", "finite"])
@pytest.mark.parametrize("slope", [0.0, -0.1])
@pytest.mark.parametrize("first", [True, False])
def test_slip_of_a_positioned_block_is_relative_to_the_floor(first, slope, kinematics):
    """Slip is the relative displacement of block and floor, whichever of them is moved.

    The block is positioned, with its left side displaced, in the first increment or after its
    release. Reference: the same without the common displacement, to 1e-6: the round-off of K u,
    4e-9, changes the position of a carried block.
    """
    computed = {}
    for both in (0.0, -4.0):
        for of_block in (0.003, 0.0):
            scene = UnconstrainedBlock("triangle", "linear", (0.0, 0.0))
            mesh = scene.u.function_space.mesh
            displacement, shift = fem.Constant(mesh, 0.0), fem.Constant(mesh, np.zeros(2))
            V = scene.u.function_space.sub(0)
            left = fem.locate_dofs_topological(V, 1, scene.tags.find(LEFT))
            scene.bcs = [fem.dirichletbc(displacement, left, V)]
            floor = fc.HalfSpace((0.0, -0.3), (-slope, 1.0), shift)
            contact = scene.contact(floor, kinematics=kinematics)
            problem = scene.problem(contact)
            for press in (1.0,) if first else (1.0, 0.0, 1.0):
                scene.traction.value[:] = (0.0, -press)
                if problem.increment == (0 if first else 2):
                    displacement.value = both + of_block
                    shift.value[:] = (both + of_block - 0.003, 0.0)
                problem.solve()
                problem.commit()
            resultants = contact.resultants()
            computed[both, of_block] = [*resultants.force, resultants.tangential_force]
    reference = computed.pop((0.0, 0.003))
    assert abs(reference[2]) > 0.05
    for forces in computed.values():
        assert is_close(forces, reference, 1e-6)


@pytest.mark.parametrize("kinematics", ["small", "finite"])
@pytest.mark.parametrize("bulk", BULKS)
def test_raised_floor_causes_no_slip(bulk, kinematics):
    """A floor rises in the first increment by less or more than the gap of a block fixed along x.

    Nothing slips after first touch. Reference: the floor at rest, to 1e-6 of the forces.
    """
    computed = []
    for up in (0.0, 0.2, 0.5):
        scene = UnconstrainedBlock("triangle", bulk, (0.0, -1.0))
        mesh = scene.u.function_space.mesh
        scene.bcs = [dirichlet_bc(scene.u, scene.tags, side, 0) for side in (LEFT, RIGHT)]
        shift = fem.Constant(mesh, np.array([0.0, up]))
        floor = fc.HalfSpace((0.0, -0.3), (0.2, 1.0), shift)
        contact = scene.contact(floor, friction=0.2, kinematics=kinematics)
        scene.problem(contact, small_displacement_tolerance=np.inf).solve()
        resultants = contact.resultants()
        computed.append([*resultants.force, resultants.tangential_force])
    assert is_close(computed[1:], computed[:1] * 2, 1e-6)


@pytest.mark.parametrize("bulk", BULKS)
def test_floor_rotates_while_a_block_is_positioned(bulk):
    """A block is positioned across a gap of 0.3 while the floor rotates about a distant axis.

    Reference: floor and axis 0.3 higher, to 1e-6: the slip of the block is the motion of the floor
    during their contact.
    """
    computed = []
    for gap in (1e-9, 0.3):
        scene = UnconstrainedBlock("triangle", bulk, (0.0, -1.0))
        mesh = scene.u.function_space.mesh
        scene.bcs = [dirichlet_bc(scene.u, scene.tags, side, 0) for side in (LEFT, RIGHT)]
        angle = fem.Constant(mesh, 4e-6)  # the points stick
        floor = fc.HalfSpace((0.0, -gap), (0.1, 1.0), rotation=fc.Rotation(angle, (2.0, 1.0 - gap)))
        contact = scene.contact(floor, friction=1.0)
        scene.problem(contact).solve()
        resultants = contact.resultants()
        computed.append([*resultants.force, resultants.tangential_force])
    assert abs(computed[0][2]) > 0.01
    assert is_close(computed[1], computed[0], 1e-6)


@pytest.mark.parametrize("kinematics", ["small", "finite"])
@pytest.mark.parametrize("bulk", BULKS)
@pytest.mark.parametrize("gap", [0.0, 0.2])
def test_floor_carries_a_block_while_it_is_positioned(gap, bulk, kinematics):
    """In one increment a floor carries a block, otherwise free along x, by a tenth of its width.

    Reference: the floor at rest, moved by the floor's displacement, to 1e-6.
    """
    computed = []
    for along in (0.0, 0.1):
        scene = UnconstrainedBlock("quadrilateral", bulk, (0.0, -1.0))
        shift = fem.Constant(scene.u.function_space.mesh, np.array([along, 0.0]))
        floor = fc.HalfSpace((0.0, -gap), (0.0, 1.0), shift)
        contact = scene.contact(floor, kinematics=kinematics)
        scene.problem(contact, small_displacement_tolerance=np.inf).solve()
        comm = scene.u.function_space.mesh.comm
        place = gather(comm, contact.pairs.own_displacement())[:, 0].mean() - along
        computed.append([place, contact.resultants().tangential_force])
    assert computed[0][1] > 0.1
    assert is_close(computed[1], computed[0], 1e-6)


@pytest.mark.each
@pytest.mark.parametrize("kinematics", ["small", "finite"])
@pytest.mark.parametrize("bulk", ["linear", "rubber"])
@pytest.mark.parametrize("other", ["hovering", "driven"])
def test_carried_block_does_not_depend_on_another_block(other, bulk, kinematics):
    """Friction alone carries a block by twenty times its deformation, with or without another.

    Reference: the load, and the block alone, to 1e-8; its position is that of the floor, to the
    strain of 1e-3. One secant step of the friction leads there, and a few more determine stick and
    slip: at most 6 iterations, alone or not. With the rigid-body modes of all bodies regularised by
    one measure it took 1068, and was refused.
    """
    places, counts = [], []
    for with_other_body in (False, True):
        boxes = {"carried": Box()}
        if with_other_body:
            boxes["other"] = Box(low=(3.0, 0.1 if other == "hovering" else 0.0))
        scene = SceneWithUnrelatedBodies(boxes, rubber=bulk == "rubber")
        down, displacement = scene.bodies.constant(-0.01), scene.bodies.constant()
        scene.load("carried", TOP, 1, down)
        shift = fem.Constant(scene.bodies.u.function_space.mesh, np.zeros(2))
        floor, law = fc.HalfSpace((0, 0), (0, 1), shift), fc.Coulomb(0.3)
        contacts = [
            scene.contact(name, BOTTOM, floor, law, kinematics=kinematics, name=name)
            for name in boxes
        ]
        if with_other_body and other == "driven":
            scene.prescribe("other", LEFT, 0, value=displacement)
            scene.load("other", TOP, 1, down)
        problem = scene.problem(*contacts, small_displacement_tolerance=np.inf)
        counts.append([])
        for factor in (0.0, 1.0, 2.0):
            shift.value[0], displacement.value = 0.02 * factor, 0.01 * factor
            counts[-1].append(problem.solve().iterations)
            problem.commit()
        comm = scene.bodies.u.function_space.mesh.comm
        places.append(gather(comm, contacts[0].pairs.own_displacement()).mean(axis=0))
        assert is_close(contacts[0].resultants().force, (0.0, 0.01), 1e-8)
    assert is_close(places[1], places[0], 1e-8) and abs(places[0][0] - 0.04) < 1e-3
    assert max(counts[0]) <= 10 and max(counts[1]) <= 10


@pytest.mark.parametrize("kinematics", ["small", "finite"])
def test_positioned_block_does_not_depend_on_a_carried_block(kinematics):
    """A block above a floor is positioned while this floor carries another block.

    Reference: the block alone, to 1e-8 of its displacement. Its position above the floor was once
    taken as its start.
    """
    places = []
    for with_other_body in (False, True):
        boxes = {"hovering": Box(low=(3.0, 0.1))} | ({"carried": Box()} if with_other_body else {})
        scene = SceneWithUnrelatedBodies(boxes)
        loads = {name: scene.bodies.constant() for name in boxes}
        for name, load in loads.items():
            scene.load(name, TOP, 1, load)
        shift = fem.Constant(scene.bodies.mesh, np.zeros(2))
        floor, law = fc.HalfSpace((0, 0), (0, 1), shift), fc.Coulomb(0.3)
        contacts = [
            scene.contact(name, BOTTOM, floor, law, kinematics=kinematics, name=name)
            for name in boxes
        ]
        problem = scene.problem(*contacts, small_displacement_tolerance=np.inf)
        for number in range(4):
            shift.value[0] = 0.02 * number
            loads["hovering"].value = -0.01 if number > 1 else 0.0
            if with_other_body:
                loads["carried"].value = -0.01
            problem.solve()
            problem.commit()
        places.append(gather(COMM, contacts[0].pairs.own_displacement()).mean(axis=0))
    assert is_close(places[1], places[0], 1e-8) and places[0][1] < -0.1


def test_unloaded_block_keeps_its_position_until_it_is_pushed():
    """A block comes 0.004 closer to an unloaded one, of a gap of 0.01, and bodies are positioned.

    Reference: its position before, to 1e-12. The linear programme left it undetermined, 1e7 away.
    """
    scene = SceneWithUnrelatedBodies({"pressed": Box(), "neighbour": Box(low=(1.01, 0.0))})
    scene.load("pressed", TOP, 1, scene.bodies.constant(-0.01))
    scene.prescribe("pressed", LEFT, 0)
    floor, law = fc.HalfSpace((0, 0), (0, 1)), fc.Coulomb(0.3)
    contacts = [
        scene.contact(box, BOTTOM, floor, law, name=box) for box in ("pressed", "neighbour")
    ]
    side = scene.contact("pressed", RIGHT, ("neighbour", LEFT), fc.Frictionless(), name="side")
    scene.problem(*contacts, side).solve()
    assert np.abs(contacts[1].pairs.own_displacement()).max(initial=0.0) < 1e-12


@pytest.mark.each
@pytest.mark.parametrize("gap", [0.01, 0.1])
@pytest.mark.parametrize("n_walls", [1, 2])
@pytest.mark.parametrize("n_steps", [1, 8])
@pytest.mark.parametrize("kinematics", ["small", "finite"])
def test_vertical_load_does_not_move_a_block_sideways(kinematics, n_steps, n_walls, gap):
    """Walls with friction squeeze a block and open; its weight is removed and applied again.

    Reference: statics, and no displacement along the floor. Positioned from gaps of round-off, or
    by a horizontal load of 1e-15 of the weight, the block moved to a wall, as far as
    that had opened, and the wall carried 15 % of its weight.
    """
    scene = SceneWithUnrelatedBodies({"block": Box(n=(4, 4))}, E=1e3)
    weight, round_off = scene.bodies.constant(0.0), scene.bodies.constant(0.0)
    scene.load("block", TOP, 1, weight)
    scene.load("block", TOP, 0, round_off)
    obstacles = {BOTTOM: fc.HalfSpace((0, 0), (0, 1))}
    walls = [scene.bodies.constant((0.0, 0.0)) for _ in range(n_walls)]
    for side, x, wall in zip((LEFT, RIGHT), (0.0, 1.0), walls, strict=False):
        obstacles[side] = fc.HalfSpace((x, 0), (1 - 2 * x, 0), displacement=wall)
    contacts = [
        scene.contact(
            "block", side, obstacle, fc.Coulomb(0.5), name=f"{side}", kinematics=kinematics
        )
        for side, obstacle in obstacles.items()
    ]
    problem = scene.problem(*contacts, small_displacement_tolerance=np.inf)

    def solve(load, squeeze):
        weight.value, round_off.value = -load, -1e-15 * load
        for wall, sign in zip(walls, (1, -1), strict=False):
            wall.value[0] = sign * squeeze
        problem.solve()
        problem.commit()
        return gather(COMM, contacts[0].pairs.own_displacement())[:, 0].mean()

    for squeeze in (0.0, 0.01, 0.0, -gap):
        place = solve(2.0, squeeze)
    for load in (*np.linspace(2.0, 0.0, n_steps + 1)[1:], 2.0):
        assert abs(solve(load, -gap) - place) < 1e-4  # its strain is 2e-3
    assert is_close(contacts[0].resultants().force, [0.0, 2.0], 1e-8)
    assert all(np.abs(wall.resultants().force).max() < 1e-9 for wall in contacts[1:])
