"""Augmented enforcement has no penetration and no creep, with springs as soft as the body."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact import checkpoint
from fenics_contact.elasticity import LinearElastic
from fenics_contact.parallel import global_sum
from scenes import problems, two_blocks
from scenes.blocks import FRONT, GRID, LEFT, TOP, block, parabolic_floor, rough_field
from scenes.comparison import gather, is_close, nodal_values, point_values, shared_folder

COMM = MPI.COMM_WORLD
E = 1000.0
pytestmark = [pytest.mark.mpi, pytest.mark.timeout(120)]

# k h/E: springs as stiff as a few layers of cells, and springs that are practically rigid.
SOFT, STIFF = fc.RelativeStiffness(10.0), fc.RelativeStiffness(1e5)
AUGMENTED = {"enforcement": "augmented"}


def values(contact: fc.Contact, name: str) -> np.ndarray:
    return gather(COMM, contact.values.arrays[name])


# ---- patch tests ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("cell", "degree"), GRID)
def test_patch(cell: str, degree: int) -> None:
    """Uniform compression on a shuffled mesh gives uniform pressure and no penetration.

    Reference: the load, and u_n = 0. The first solution has the exact pressure, which becomes the
    multiplier; the remaining penetration is round-off, 1e-10 of that of the penalty.
    """
    p, k_n = 2.0, 5e3
    scene = block(cell, degree, up=-p, shuffled=True)
    problem, contact = scene.problem(
        fc.Frictionless(k_n),
        scene.rollers(),
        contact=AUGMENTED | {"tolerance": 1e-9},
        petsc_options={"snes_rtol": 1e-12},
    )
    step = problem.solve()
    pressure = gather(COMM, contact.pressure)
    assert is_close(pressure, np.full_like(pressure, p), 1e-9)
    assert np.abs(gather(COMM, contact.gap)).max() <= 1e-9 * p / k_n
    assert step.augmentations <= 3
    assert step.verdict.enforcement["contact"] <= 1e-9 and not step.verdict.failures
    # The springs have no force: their energy is the square of round-off.
    assert abs(step.energy.springs) <= 1e-15 * p**2 / k_n


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_patch_of_two_bodies(cell: str, degree: int) -> None:
    """Non-matching meshes with Gauss points have uniform pressure and no jump.

    Reference: p = 0.01 M, with the confined modulus M and height 1; gap 0 to 1e-7 of p/k_n. Each
    augmentation leaves M/(M + k_n) = 1/8 of the jump.
    """
    nu, k_n = 0.3, 1e7
    problem, contact, _ = two_blocks.pressed_blocks(
        cell, degree, nu, fc.Coulomb(0.3, k_n, k_n), contact=AUGMENTED | {"tolerance": 1e-8}
    )
    problem.solve()
    p = 0.01 * two_blocks.E * (1 - nu) / (1 + nu) / (1 - 2 * nu)
    points = contact.gather()
    assert points["pressure"] == pytest.approx(np.full(len(points["x"]), p), rel=1e-7)
    assert np.abs(points["gap"]).max() <= 1e-7 * p / k_n
    assert contact.quadrature.degree == 2 * degree


# ---- the limit of the penalty --------------------------------------------------------------------

LAWS = {
    "frictionless": (2, lambda k: fc.Frictionless(k)),
    "coulomb": (2, lambda k: fc.Coulomb(0.3, k, k)),
    "tresca": (2, lambda k: fc.Tresca(0.3, 10.0, k, k)),
    "prescribed": (2, lambda k: fc.Tresca(0.3, 10.0, k_t=k, unilateral=False)),
    "cone": (3, lambda k: fc.Coulomb(0.3, k, k)),
    "polygon": (3, lambda k: fc.Coulomb(0.3, k, k, modes=6)),
    "ellipse": (3, lambda k: fc.Coulomb(0.3, k, k, transverse_friction=0.5, direction=(1, 1, 0))),
}
# (side, down): pressed, sheared until a part of Γc slips, reversed, and lifted off.
PATH = [(0.0, 0.02), (0.004, 0.02), (0.012, 0.02), (-0.002, 0.02), (-0.002, -0.01)]


def solve_path(law: str, stiffness: fc.RelativeStiffness, path=PATH, **options):
    """Solve a block whose top follows the path, on a convex floor; return results and contact."""
    d, make = LAWS[law]
    cell, n = ("quadrilateral", (6, 3)) if d == 2 else ("hexahedron", (3, 3, 2))
    scene = block(cell, 1, n=n, surface={"quadrature_scheme": "vertex"})
    move = fem.Constant(scene.mesh, np.zeros(d))
    bcs = [fem.dirichletbc(move, scene.facet_dofs(TOP), scene.u.function_space)]
    contact = {"obstacle": parabolic_floor(scene), **options}
    problem, contact = scene.problem(make(stiffness), bcs, contact=contact, method="newton")
    computed = []
    for side, down in path:
        move.value[:] = scene.vector(side=side, up=-down)
        if d == 3:
            move.value[1] = side / 2
        step = problem.solve()
        problem.commit()
        fields = contact.traction, contact.slip
        computed.append((step, *(point_values(contact, f) for f in fields)))
    return computed, contact


@pytest.mark.skipif(COMM.size > 1, reason="of the laws; ranks are compared below")
@pytest.mark.parametrize("law", LAWS)
def test_limit_of_the_penalty(law: str) -> None:
    """Every law agrees with very stiff springs on a path with slip, reversal and separation.

    There is one point per node, so that no projection occurs. Reference: the penalty at 1e5 E/h,
    whose error is its elastic displacement, about 1e-5 of the body's. Tolerance 1e-3 of the
    largest traction and slip of the path; the error of the penalty at 10 E/h is above 1e-2.
    """
    augmented, _ = solve_path(law, SOFT, **AUGMENTED)
    stiff, _ = solve_path(law, STIFF)
    soft, _ = solve_path(law, SOFT)
    for i in (1, 2):
        exact = [s[i] for s in stiff]
        scale = max(np.abs(e).max(initial=0.0) for e in exact)
        multiplier_force, penalty_force = (
            max(np.abs(s[i] - e).max(initial=0.0) for s, e in zip(run, exact, strict=True))
            for run in (augmented, soft)
        )
        if scale > 0:
            assert multiplier_force <= 1e-3 * scale
            assert penalty_force > 1e-2 * scale
    assert all(not step.verdict.failures for step, *_ in augmented)


@pytest.mark.skipif(COMM.size > 1, reason="of the condensed problem; ranks are compared below")
def test_half_cylinder() -> None:
    """The paper's half-cylinder with quadratic cells of a/21, without friction, is reproduced.

    References: an independent solution with exact complementarity (table 1), peak pressure 142.6
    and u_y = -0.5181 at the top, to their last digit; this package's solution on cells of a tenth
    of the size, 142.531 and -0.518147 (benchmarks/enforcement.py), to 1e-4 and 5e-5; u_y of the
    penalty at 1e6 E/h on the same mesh, to 5e-5, whereas the error at 10 E/h is above 1e-3. The
    iterations are at most 1.5 times those of the penalty at 10 E/h, and fewer than at 1e6 E/h.
    """
    body = problems.half_cylinder(0.0, 0.1, grading=0.1, coarsest=0.5)
    computed = []
    for k, options in ((10.0, {}), (10.0, AUGMENTED), (1e6, {})):
        problem, _, u, load = problems.problem(body, 2, k, contact_options=options)
        load.value = body.final_load
        step = problem.solve()
        computed.append(
            (body.displacement(u), step.contacts["contact"].max_pressure, step.iterations)
        )
    penalty, augmented, rigid = computed
    assert augmented[0] == pytest.approx(-0.5181, abs=1e-4)
    assert augmented[1] == pytest.approx(142.6, abs=0.1)
    assert augmented[0] == pytest.approx(-0.518147, rel=5e-5)
    assert augmented[1] == pytest.approx(142.531, rel=1e-4)
    assert augmented[0] == pytest.approx(rigid[0], rel=5e-5)
    assert abs(penalty[0] / rigid[0] - 1) > 1e-3
    assert augmented[2] <= 1.5 * penalty[2] and augmented[2] < rigid[2]


@pytest.mark.parametrize("degree", [1, 2])
def test_default_quadrature_of_multipliers(degree: int) -> None:
    """Multipliers of linear elements default to vertex quadrature, all others to Gauss points."""
    for degree_given, options, expected in (
        ({}, AUGMENTED, 2 if degree == 1 else 3),
        ({"quadrature_degree": 3}, AUGMENTED, 2),
        ({"quadrature_scheme": "default"}, AUGMENTED, degree + 1),
        ({}, {}, degree + 1),
    ):
        scene = block("quadrilateral", degree, surface=degree_given)
        contact = scene.contact(fc.Frictionless(k_n=1.0), **options)
        contact.evaluate()
        per_facet = COMM.allreduce(len(contact.points)) / COMM.allreduce(len(scene.surface.facets))
        assert per_facet == expected
        corner = np.abs(gather(COMM, contact.points)[:, 0]).min() < 1e-12
        assert corner == (not degree_given and bool(options) and degree == 1)


# ---- stick ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.two_ranks
def test_cyclic_shear_below_the_friction_bound_leaves_no_slip(degree: int) -> None:
    """A block under cyclic shear below the friction bound does not move, nor does slip accumulate.

    ν = 0, so that pressure causes no shear. The elastic slip of the penalty would be τ/k_t, 1e-4.
    Limit for linear elements: 2e-5 p/k_t, twice the tolerance of the augmentations, p ≤ 16 due to
    bending. Limit for quadratic ones: a twentieth of τ/k_t, due to the bubble of each edge, which
    multipliers of one degree less do not constrain. The largest displacement in the last six
    increments is at most 1.5 times that in the first six: the last augmentation may vary by half.
    """
    scene = block("quadrilateral", degree, nu=0.0, n=3, up=-10.0)
    k_t = 1e4
    problem, contact = scene.problem(fc.Coulomb(1.0, k_n=1e4, k_t=k_t), [], contact=AUGMENTED)
    moved, shear_forces = [], []
    for i in range(12):
        scene.load(up=-10.0, side=np.cos(i))
        problem.solve()
        problem.commit()
        moved.append(np.abs(gather(COMM, contact.tangential_displacement)).max())
        shear_forces.append(np.abs(gather(COMM, contact.tangential_traction)).max())
        assert np.all(gather(COMM, contact.status) == fc.Status.STICK)
    assert max(shear_forces) > 0.9
    assert max(moved) <= (2 * 1e-5 * 16.0 if degree == 1 else 0.05 * max(shear_forces)) / k_t
    assert max(moved[6:]) <= 1.5 * max(moved[:6])


def test_solving_a_committed_state_again_causes_no_creep() -> None:
    """Solving a committed state again changes tractions by at most 1e-4, and slip by 1e-4 of 1/E.

    With quadratic displacements the tractions at the points are not the multipliers; the history
    has to store data that reproduce them.
    """
    scene = block("triangle", 2, n=4, up=-10.0, side=4.0, surface={"quadrature_degree": 6})
    problem, contact = scene.problem(
        fc.Coulomb(0.3, k_n=1e4, k_t=1e4),
        [],
        contact=AUGMENTED,
        petsc_options={"snes_rtol": 1e-11},
    )
    scene.load(up=-10.0, side=1.0)
    problem.solve()
    before = contact.traction.copy()
    problem.commit()
    step = problem.solve()
    assert step.augmentations <= 2
    assert is_close(gather(COMM, contact.traction), gather(COMM, before), 1e-4)
    assert np.abs(gather(COMM, contact.slip_increment)).max() <= 1e-4 * 1.0 / E


# ---- forms, obstacles, ranks, files --------------------------------------------------------------


@pytest.mark.whole
@pytest.mark.parametrize("law", ["frictionless", "coulomb", "tresca", "cone", "ellipse"])
def test_force_and_tangent_with_multipliers(law: str) -> None:
    """The tangent is the derivative of the force, and the force that of the potential, to 1e-6.

    Reference: central differences along an irregular direction at an irregular state with λ ≠ 0.
    The step is 1e-6 of the displacements; no point changes its status within it.
    """
    d, make = LAWS[law]
    cell = "triangle" if d == 2 else "tetrahedron"
    scene = block(cell, 2, n=2, shuffled=True)
    contact = scene.contact(make(fc.RelativeStiffness(3.0)), modulus=E, **AUGMENTED)
    rows = contact.multipliers.fields.rows()
    rough = rough_field(d, 3)(contact.points.T).T
    rows[:, 0] = 0.01 * E * np.abs(rough[:, 0])
    rows[:, 1:] = 0.01 * E * rough[:, : rows.shape[1] - 1]
    contact.multipliers.fields.set_rows(rows)
    u, size = scene.u, 0.02
    base, direction = fem.Function(u.function_space), fem.Function(u.function_space)
    base.interpolate(lambda x: size * rough_field(d, 1)(x))
    direction.interpolate(rough_field(d, 2))
    n = u.function_space.dofmap.index_map.size_local * d
    operator = fc.ContactOperator(contact)

    def at(t: float) -> tuple[np.ndarray, float]:
        u.x.array[:] = base.x.array + t * direction.x.array
        force = operator.unknowns.vector()
        operator.add_force(force)
        energy = COMM.allreduce(contact.energy()) if contact.law.has_potential else 0.0
        return force.array.copy(), energy

    step = 1e-6 * size
    (f1, e1), (f0, e0) = at(step), at(-step)
    force, _ = at(0.0)
    tangent = operator.tangent()
    right, left = tangent.createVecs()
    right.array[:] = direction.x.array[:n]
    tangent.mult(right, left)
    assert is_close(gather(COMM, (f1 - f0) / (2 * step)), gather(COMM, left.array), 1e-6)
    if contact.law.has_potential:
        power = COMM.allreduce(float(force @ direction.x.array[:n]))
        assert (e1 - e0) / (2 * step) == pytest.approx(power, rel=1e-6)


@pytest.mark.mpi
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.two_ranks
def test_augmentation_with_very_soft_springs(degree: int) -> None:
    """Springs of 0.01 E/h give the forces of springs of 10 E/h under pressure and reversed shear.

    Each augmentation leaves 99 % of the penetration: without acceleration hundreds are needed, with
    it at most 60. With linear elements multipliers represent all displacements of a facet, so that
    the forces agree to 1e-4 (tolerance of the augmentations 1e-5); with quadratic ones they agree
    to 2e-3, as the projection leaves 1e-3 to the springs.
    """
    forces = []
    for k in (0.01, 10.0):
        scene = block("quadrilateral", degree, n=6)
        shift = fem.Constant(scene.mesh, np.zeros(2))
        law = fc.Coulomb(0.3, k_n=fc.RelativeStiffness(k), k_t=fc.RelativeStiffness(k))
        bcs = [scene.dirichlet_bc(TOP, i) for i in range(2)]
        options = AUGMENTED | {"displacement": shift}
        problem, contact = scene.problem(law, bcs, contact=options)
        for side in (0.0, 0.004, -0.004):
            shift.value[:] = side, 0.01
            step = problem.solve()
            problem.commit()
            assert step.augmentations <= 60
            forces.append(contact.resultants().force)
        assert contact.resultants().slip > 0
    assert is_close(np.array(forces[:3]), np.array(forces[3:]), 1e-4 if degree == 1 else 2e-3)


@pytest.mark.two_ranks
@pytest.mark.parametrize(
    ("cell", "n", "frictions", "load", "modulus", "gap"),
    [
        ("hexahedron", 2, (0.6, 0.0), (5.62, 10.6), 1e5, 0.0),
        ("hexahedron", 3, (0.3, 0.3), (0.75, 5.48), 1e3, 1e-3),
        ("tetrahedron", 2, (0.6, 0.3), (4.83, 9.78), 1e5, 1e-2),
        ("tetrahedron", 3, (0.6, 0.3), (2.76, 2.45), 1e3, 1e-2),
    ],
)
def test_block_in_corner_of_floor_and_wall(
    cell: str,
    n: int,
    frictions: tuple[float, float],
    load: tuple[float, float],
    modulus: float,
    gap: float,
) -> None:
    """A block on a floor with friction is pressed against a wall by loads that rise and fall.

    The multipliers of floor and wall are coupled at the common edge: accelerated separately, the
    augmentations of all four cases fail. References: both contact forces balance the loads, to 1e-8
    (penalty 1e-7, its round-off); displacements of the penalty at 1e4 E/h, to 2 % of the largest
    for cells of a half to a third of the block, as the forces at the common edge are not unique.
    """
    displacements = []
    for options in (AUGMENTED, {}):
        scene = block(cell, 1, n=n, E=modulus)
        springs = {} if options else dict.fromkeys(("k_n", "k_t"), fc.RelativeStiffness(1e4))
        laws = [fc.Coulomb(mu, **springs) for mu in frictions]
        floor = scene.contact(laws[0], **options)
        obstacle = fc.HalfSpace((-gap, 0.0, 0.0), (1.0, 0.0, 0.0))
        surface = fc.ContactSurface(scene.mesh, scene.tags, LEFT)
        wall = fc.Contact(scene.u, surface, obstacle, laws[1], name="wall", **options)
        bcs = [scene.dirichlet_bc(FRONT, 1)]
        problem = fc.ContactProblem(scene.F, scene.u, bcs=bcs, contacts=[floor, wall])
        for factor in (1 / 3, 2 / 3, 1.0, 0.8, 0.6, 0.4, 0.2):
            side, up = (-factor * part for part in load)
            scene.load(side=side, up=up)
            problem.solve()
            problem.commit()
            force = sum(contact.resultants().force for contact in (floor, wall))
            assert is_close(force[[0, 2]], [-side, -up], 1e-8 if options else 1e-7)
        displacements.append(nodal_values(scene.u))
    assert is_close(*displacements, 0.02)


def test_augment_called_directly_gives_the_same_multipliers() -> None:
    """Direct calls of `augment` give the pressure of the problem's own augmentations, to 1e-4."""
    pressures = []
    for by_hand in (False, True):
        scene = block("quadrilateral", 1, n=4, up=-10.0)
        problem, contact = scene.problem(
            fc.Frictionless(),
            scene.rollers(),
            contact={"obstacle": parabolic_floor(scene)} | AUGMENTED,
        )
        if by_hand:
            contact.tolerance = 0.999  # one augmentation per solve
            errors = []
            for _ in range(12):
                problem.solve()
                errors.append(contact.augment())
            assert errors[0] > 1e-3 and errors[-1] <= 1e-5
        else:
            problem.solve()
        pressures.append(gather(COMM, contact.pressure))
    assert is_close(pressures[1], pressures[0], 1e-4)


@pytest.mark.skipif(COMM.size > 1, reason="of the condensed problem; ranks are compared below")
def test_sliding_over_nonmatching_facets() -> None:
    """Slid over facets of another mesh, N is that of stiff springs and T = μN.

    Reference: the penalty at 1e4 E/h with the same updates of pairs, by Newton's method. Tolerance
    1 %: constraints by multipliers and by stiff springs differ by a discretisation error between
    two meshes; the error of the penalty at 10 E/h is 3.6 %. When all points slip, T = μN by the
    law, to 1e-6.
    """
    normal = []
    for k, options in ((10.0, AUGMENTED), (1e4, {}), (10.0, {})):
        law = fc.Coulomb(0.3, fc.RelativeStiffness(k), fc.RelativeStiffness(k))
        setup = two_blocks.SlidingBlock(
            "triangle", law, start=0.4, contact=options, method="newton"
        )
        steps = [setup.step(0.01, 0.0), *(setup.step(0.01, 0.1 * i) for i in range(1, 6))]
        last = steps[-1].contacts["contact"]
        assert last.tangential_force == pytest.approx(0.3 * last.normal_force, rel=1e-6)
        normal.append(last.normal_force)
    assert normal[0] == pytest.approx(normal[1], rel=1e-2)
    assert normal[2] < 0.97 * normal[1]


def test_obstacle_moved_by_a_force() -> None:
    """With multipliers an obstacle moved by a force has this contact force and no penetration.

    Reference: the top of the block is fixed and the floor pressed up by 10. With ν = 0 the block
    shortens by 10/E, which is the motion of the floor; the penalty would add p/k_n = 1e-3.
    """
    scene = block("quadrilateral", 1, nu=0.0)
    motion = fc.Motion(force=(None, 10.0), displacement=(0.0, None))
    bcs = [scene.dirichlet_bc(TOP, 1), *scene.rollers()]
    problem, contact = scene.problem(
        fc.Coulomb(0.3, k_n=1e4, k_t=1e4),
        bcs,
        contact={"obstacle": scene.floor(displacement=motion)} | AUGMENTED,
    )
    step = problem.solve()
    assert step.contacts["contact"].normal_force == pytest.approx(10.0, rel=1e-8)
    assert float(contact.free_motion[1].value) == pytest.approx(10.0 / E, rel=1e-5)


def test_multipliers_do_not_depend_on_the_number_of_ranks() -> None:
    """All ranks together find the tractions of one rank, to 1e-5, ten times `tolerance`."""
    computed = []
    for comm in (COMM, MPI.COMM_SELF):
        scene = block("triangle", 2, n=6, up=-10.0, side=1.0, comm=comm)
        law = fc.Coulomb(0.3)
        contact = {"obstacle": parabolic_floor(scene), "tolerance": 1e-6} | AUGMENTED
        problem, contact = scene.problem(law, [scene.dirichlet_bc(TOP, 0, 0.001)], contact=contact)
        problem.solve()
        computed.append(point_values(contact, contact.traction))
    assert is_close(computed[0], computed[1], 1e-5)


def test_restart_from_checkpoint_with_multipliers(tmp_path: Path) -> None:
    """A restarted history continues as the one that wrote the checkpoint, multipliers included.

    Tolerance 1e-9 of the tractions: both start from the same numbers.
    """
    folder = shared_folder(tmp_path)
    tractions = []
    for resumes in (False, True):
        scene = block("triangle", 2, n=3, up=-10.0)
        law = fc.Coulomb(0.3, k_n=1e4, k_t=1e4)
        problem, contact = scene.problem(law, [], contact=AUGMENTED)
        if resumes:
            scene.load(up=-10.0, side=1.0)
            checkpoint.load(problem, folder / "state.npz")
        else:
            scene.load(up=-10.0, side=1.0)
            problem.solve()
            problem.commit()
            checkpoint.save(problem, folder / "state.npz")
        scene.load(up=-10.0, side=2.0)
        problem.solve()
        tractions.append(point_values(contact, contact.traction))
    assert is_close(tractions[1], tractions[0], 1e-9)


@pytest.mark.parametrize("k", [10.0, 100.0])
@pytest.mark.parametrize("friction", [0.3, 0.8])
def test_symmetry_planes_replace_the_rest_of_the_block(friction, k):
    """A quarter of a block pressed on a floor with friction agrees with the unconstrained block.

    Next to the symmetry planes there are more multipliers than free displacements. Without the
    projection of multipliers without effect the solve failed, or friction was up to 30 % wrong.
    Tolerance 1e-4, as the tolerance of 1e-6 of the multipliers adds up over a row of facets.
    """
    stiff = {"k_n": fc.RelativeStiffness(k), "k_t": fc.RelativeStiffness(k)}
    forces = []
    for n in (1, 2):
        scene = block("hexahedron", n=(3 * n, 3 * n, 3), size=(n, n, 1), nu=0.45, up=-1.0)
        problem, contact = scene.problem(
            fc.Coulomb(friction, **stiff),
            scene.rollers() if n == 1 else [],
            contact={"enforcement": "augmented", "tolerance": 1e-6},
        )
        problem.solve()
        quarter = np.all(contact.values.x[:, :2] > n - 1, axis=1)
        force = contact.area[quarter] @ contact.traction[quarter]
        forces.append(global_sum(scene.mesh.comm, force))
    assert forces[1][2] == pytest.approx(1.0, rel=1e-4)
    assert forces[0] == pytest.approx(forces[1], abs=1e-4)


@pytest.mark.parametrize("shape", ["axisymmetric", "hexahedron"])
def test_augmentations_converge_next_to_dirichlet_nodes(shape):
    """With facets of different sizes next to a fixed side, fewer than 20 augmentations are needed.

    Once the change of the multipliers did not decrease in 80 augmentations, and the solve failed.
    Reference: the normal force balances the load, to 1e-8.
    """
    turned = shape == "axisymmetric"
    scene = block(
        "quadrilateral" if turned else shape, n=5 if turned else 2, shuffled=True, up=-1.0
    )
    x, v = ufl.SpatialCoordinate(scene.mesh), ufl.TestFunction(scene.u.function_space)
    around = 2 * ufl.pi * x[0] if turned else 1.0
    bulk = LinearElastic(scene.u, 1000.0, 0.45, "axisymmetric" if turned else "3D")
    ds = ufl.ds(scene.mesh, subdomain_data=scene.tags)
    F = bulk.residual(v) - around * ufl.dot(scene.traction, v) * ds(TOP)
    contact = scene.contact(fc.Coulomb(1.2), enforcement="augmented", weight=around)
    step = fc.ContactProblem(F, scene.u, bcs=scene.rollers(), contacts=[contact]).solve()
    assert step.augmentations < 20
    force = contact.resultants().normal_force
    assert force == pytest.approx(np.pi if turned else 1.0, rel=1e-8)


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_reloading_an_unconstrained_body_after_complete_unloading(cell):
    """An unconstrained body is solved when it is loaded again after complete unloading.

    Once round-off of the multipliers closed points that just touched, and no solution was found.
    References: the load, to 1e-9; the pressures of the first increment, to 1e-4, as the tolerance
    of the augmentations, 1e-5, affects where points stick.
    """
    scene = block(cell, 2, n=4)
    contact = scene.contact(fc.Coulomb(0.5), kinematics="finite", **AUGMENTED)
    problem = fc.ContactProblem(scene.F, scene.u, contacts=[contact])
    computed = []
    for up in (-10.0, 0.0, -10.0):
        scene.load(up=up)
        problem.solve()
        problem.commit()
        force = contact.resultants().force
        assert is_close(force, scene.vector(up=-up), 1e-9, scale=10.0)
        computed.append(values(contact, "normal_traction"))
    assert not computed[1].any()
    assert is_close(computed[2], computed[0], 1e-4)
